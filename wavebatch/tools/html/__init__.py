"""Report pages: one HTML file that needs no network, for `--html` of run, survey, bench, calibrate and compare.

`*_page.py` hold one page each and are imported only when `--html` is given. `page` writes the file, `markup` makes
tables and text, `charts` the pictures, with matplotlib where it is installed.
"""
