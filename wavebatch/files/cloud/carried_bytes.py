"""Extra bytes that are copied unchanged from a strip to its output cloud.

`layout.plan_output` calls it. Every dimension is kept. An added echo has no extra bytes in the input: it gets the "no
data" value of a dimension, or, where no value is free for that, the value of the nearest return of its packet, as the
standard fields do. Before you change it: a dimension must never be dropped, vendors have no other place for their data.
"""

from __future__ import annotations

from dataclasses import dataclass

from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.extra_bytes import ExtraRecord, choose_no_data, tell_apart
from wavebatch.files.las.header import STANDARD_DTYPES


@dataclass(frozen=True, slots=True)
class Carried:
    """An extra dimension of the input that is copied to the output."""

    record: ExtraRecord
    source: int
    """Byte offset in the input record; the output's dtype has the offset there."""
    copied: bool = False
    """Whether added echoes get the value of the nearest return, because no value is free for "no data"."""


def plan_carried(checked: CheckedHeader, whole: bool) -> tuple[Carried, ...]:
    """Return the extra dimensions of the input; all are copied.

    whole: every output row comes from an input point, so no value for "no data" is needed.
    """
    at = STANDARD_DTYPES[checked.header.point_format].itemsize
    carried = []
    readable = [record.with_readable_texts() for record in checked.records]
    for record in tell_apart(readable, checked.header.point_format):
        empty = None if whole else choose_no_data(record)
        marked = record if empty is None else record.with_no_data(empty)
        carried.append(Carried(marked, at, copied=not whole and empty is None))
        at += record.dtype.itemsize
    return tuple(carried)
