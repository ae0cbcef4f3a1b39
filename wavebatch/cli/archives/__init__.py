"""Commands that import and export strips."""
