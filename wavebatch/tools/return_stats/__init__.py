"""Statistics of the returns of point clouds, for `wavebatch stats`: `returns` counts, `areas` splits by area."""
