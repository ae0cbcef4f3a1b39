"""Who makes the calls of a run: processes of this machine (`processes`), or the workers of a dask cluster.

`Workers` and `Cluster` have the same methods. Nothing here knows what the calls do.
"""
