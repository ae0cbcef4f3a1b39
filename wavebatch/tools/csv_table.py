"""Tables as CSV text: `stats`, `compare`, `survey --angles` and `plot waveform` write theirs with `format_csv`."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Any


def format_csv(head: Sequence[str], rows: Iterable[Iterable[Any]], *, digits: int = 10) -> str:
    """Return the table as text; empty cells are no data: None, NaN and infinity.

    digits: significant ones of floating-point numbers.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(head)
    table.writerows([_cell(value, digits) for value in row] for row in rows)
    return text.getvalue()


def _cell(value: Any, digits: int) -> Any:
    if value is None or isinstance(value, float) and not math.isfinite(value):
        return ""
    return f"{value:.{digits}g}" if isinstance(value, float) else value
