"""Point clouds with echo columns: layout, writer, and readers of points, echoes, returns and angles."""
