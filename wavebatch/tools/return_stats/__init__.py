"""What `wavebatch stats` counts: return numbers, separations and flags, by file and area."""
