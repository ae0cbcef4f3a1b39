"""The provenance of a cloud: JSON in VLRs of the user id "wavebatch", one per run, the latest with the largest
number.

`CloudWriter` writes it; all readers of clouds find wavebatch's columns with it, `wavebatch info` shows it. Before you
change it: the bytes may come from any program, so whatever is not as expected counts as no provenance.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any

from wavebatch.files.las.header import LasHeader

USER_ID = "wavebatch"
"""User id of the records."""


def read_provenance(header: LasHeader) -> list[dict[str, Any]]:
    """Return the runs that made a cloud, by its header, oldest first; empty for a file that is not of wavebatch."""
    records = sorted((vlr for vlr in header.vlrs if vlr.user == USER_ID), key=lambda vlr: vlr.record_id)
    runs = []
    for record in records:
        try:
            run = json.loads(record.payload)
        except (ValueError, RecursionError):
            continue
        if isinstance(run, dict):
            runs.append(run)
    return runs


def find_written(header: LasHeader, extra: Collection[str]) -> dict[str, str]:
    """Return the file's name of each wavebatch column, by the latest run.

    extra: names of the extra dimensions of the file. Another program may have renamed or left out some since then; if
    none of the columns is left the provenance does not describe this file, and the result is empty.
    """
    runs = read_provenance(header)
    columns = runs[-1].get("columns") if runs else None
    if not isinstance(columns, dict):
        return {}
    return {column: name for column, name in columns.items() if isinstance(name, str) and name in extra}
