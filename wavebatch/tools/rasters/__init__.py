"""Rasters for GIS: a statistic of columns of clouds in the cells of a grid, as GeoTIFF. For `wavebatch grid`."""
