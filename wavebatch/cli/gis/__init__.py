"""Commands that need the optional extra `gis` (rasterio)."""
