"""Results as sheets of facts and tables: `sheet` makes text and CSV of them, `page` the file of `--html`.

`survey` (also of `calibrate`) and `run` make the sheets of these commands; those of `compare`, `info` and `stats` stand
beside their commands in `cli`, that of `bench` in `tools.bench.command`.
"""
