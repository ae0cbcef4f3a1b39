"""Point clouds with echo columns: layout, writer, and readers of echoes, returns, angles and single columns."""
