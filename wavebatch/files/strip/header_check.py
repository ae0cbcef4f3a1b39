"""Check of the header's claims about the points (counts and bounds) against the points themselves.

`wavebatch inspect` calls it; it reads all points. wavebatch itself uses none of these claims.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.files.las.header import LasHeader, read_header
from wavebatch.files.las.write_points import Statistics

if TYPE_CHECKING:
    from wavebatch.files.strip.reader import StripReader
    from wavebatch.files.strip.scan_result import StripScan


def audit_header(reader: StripReader, scan: StripScan) -> Iterator[str]:
    """Yield a line for each count or bound of the header that the points contradict."""
    facts = reader.facts
    claimed = read_header(facts.path)
    true = LasHeader(claimed.version, claimed.point_format, claimed.point_length, claimed.scales, claimed.offsets)
    statistics = Statistics(facts.dtype, ())
    for start, stop in zip(scan.borders[:-1].tolist(), scan.borders[1:].tolist(), strict=True):
        statistics.add(reader.read_points(start, stop))
    statistics.fill(true)
    if not true.point_count:
        return
    known = 15 if claimed.version >= (1, 4) else 5
    if claimed.by_return[:known] != true.by_return[:known]:
        first, really = claimed.by_return[0], true.by_return[0]
        yield f"counts by return in the header are wrong (first returns: {first}, counted: {really})"
    slack = 1.5 * np.abs(claimed.scales)
    outside = (np.array(true.mins) < np.array(claimed.mins) - slack) | (np.array(true.maxs) > claimed.maxs + slack)
    if not np.all(~outside):
        axes = ", ".join(np.array(list("xyz"))[outside].tolist())
        yield f"points lie outside the bounds that the header claims ({axes})"
