"""Strips in, clouds out: the work of `wavebatch run`.

How one strip flows through the modules:

1. `files.text_file` lists the strips; a `job` says what is asked of one.
2. `run` checks memory and the names of the outputs before anything is read. It keeps the `workers` busy: processes of
   this machine, or a dask cluster. It opens a `strip_task` per strip, writes results in order, and keeps a strip that
   fails from stopping the others.
3. `strip_task` sends the preparation, then unit after unit, to the workers, writes their rows and publishes
   the cloud.
4. `unit` is what runs in a worker: scan and survey of the strip, then one unit from packets to rows, and the
   compression of rows. `output_rows` makes the rows of the unit's echoes.
5. `neighbour_pass` fills columns that need the points around an echo, tile by tile, once all rows are there.
6. `counts` adds up what was read and written; a cloud whose counts do not add up is not written.
   `report_file` adds remarks and writes the report next to the cloud: it means that the cloud is complete.
"""
