"""Strips in, clouds out: what `wavebatch run` does.

`inputs` says which strips, `plan` what will be done, `run` gives out the units of `task`s, one per strip, to `workers`
or a `cluster`. There `work` reads a unit, runs the chain and has `assemble` make rows of its echoes; `secondpass` adds
columns that need a point's neighbours. `report` counts, `remarks` explains, `record` is the file beside the cloud.
"""
