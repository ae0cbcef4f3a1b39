"""Extra bytes that are copied unchanged from a strip to its output cloud.

`layout.plan_output` calls it. Rows of new echoes have no extra bytes, so a dimension is copied only if it has a free
value for "no data".
"""

from __future__ import annotations

from dataclasses import dataclass

from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.extra_bytes import ExtraRecord, choose_no_data
from wavebatch.files.las.header import STANDARD_DTYPES


@dataclass(frozen=True, slots=True)
class Carried:
    """An extra dimension of the input that is copied to the output."""

    record: ExtraRecord
    source: int
    """Byte offset in the input record; the output's dtype has the offset there."""


def plan_carried(checked: CheckedHeader, whole: bool) -> tuple[tuple[Carried, ...], dict[str, str]]:
    """Return the extra dimensions to copy, and for the others the reason why not.

    whole: every output row comes from an input point, so no value for "no data" is needed.
    """
    at = STANDARD_DTYPES[checked.header.point_format].itemsize
    carried, dropped = [], {}
    for record in checked.records:
        empty = choose_no_data(record)
        if whole:
            carried.append(Carried(record, at))
        elif empty is None:
            dropped[record.name] = "no value is free to mark echoes that the input does not have as a return"
        else:
            carried.append(Carried(record.with_no_data(empty), at))
        at += record.dtype.itemsize
    return tuple(carried), dropped
