"""Results as sheets of facts and tables: `sheet` makes text and CSV of them, `page` the file of `--html`.

`survey` (also of `calibrate`), `compare` and `run` make the sheets of these commands; that of `bench` is in
`tools.bench.command`, those of `info` and `stats`, which have no page, beside their commands in `cli`.
"""
