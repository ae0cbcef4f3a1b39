"""What any LAS or LAZ file holds, for `wavebatch info`."""
