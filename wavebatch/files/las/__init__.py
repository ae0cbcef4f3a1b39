"""LAS and LAZ point files: headers, CRS, extra bytes, points in and out."""
