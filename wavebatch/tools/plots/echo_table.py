"""The parameters of the echoes of waveforms: as lines of text below a picture, and as rows of a CSV file.

`wavebatch plot waveform` writes both. Nothing here needs matplotlib.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence

import numpy as np

from wavebatch.core.echoes import COLUMNS, EchoFlag
from wavebatch.core.units import FWHM_PER_SIGMA, format_measure
from wavebatch.tools.plots.waveform import WaveformView
from wavebatch.tools.sheets.sheet import format_csv

MOST_LISTED = 40
"""Most echoes in the table of a picture; the CSV has all."""

_FLAGS_WIDE = 50
_NAMES = {"time": "echo_time", "amplitude": "amplitude", "sigma": "echo_width"}


def name_flags(flags: int) -> str:
    """Names of EchoFlag bits, separated by commas; empty without any."""
    return ", ".join(flag.name for flag in EchoFlag(flags))


def list_echoes(views: Sequence[WaveformView], most: int = MOST_LISTED) -> str:
    """A table of the echoes, for a monospaced font: time, amplitude, width, range if it is known, and flags."""
    several, ranged = len(views) > 1, any(np.isfinite(_column(view, "range")).any() for view in views)
    head = [*["packet"] * several, "echo", "time [ns]", "amplitude [DN]", "width [ns]", *["range [m]"] * ranged]
    every = [(view, row) for view in views for row in range(len(view.echoes))]
    if not every:
        return "no echo"
    rows = [[head, ["flags"]]]
    for view, row in every[:most]:
        front = [str(view.packet) if view.packet >= 0 else "-"] * several + [str(row + 1)]
        front += [_measure(*pair) for pair in _measures(view, row)]
        front += [_measure(*(_column(view, name)[row] for name in ("range", "range_error")))] * ranged
        rows.append([front, textwrap.wrap(name_flags(int(view.echoes.flags[row])) or "-", _FLAGS_WIDE)])
    widths = [max(len(front[place]) for front, _ in rows) for place in range(len(head))]
    lines = []
    for front, flags in rows:
        text = "  ".join(f"{word:>{width}}" for word, width in zip(front, widths, strict=True))
        lines += [f"{text if number == 0 else ' ' * len(text)}  {more}" for number, more in enumerate(flags)]
    if len(every) > most:
        lines.append(f"and {len(every) - most} more: -o FILE.csv writes all")
    return "\n".join(lines)


def _measures(view: WaveformView, row: int) -> Iterator[tuple[float, float]]:
    """Time, amplitude and full width of an echo, each with its error."""
    for name in _NAMES:
        factor = FWHM_PER_SIGMA if name == "sigma" else 1.0
        yield tuple(factor * float(getattr(view.echoes, name + end)[row]) for end in ("", "_err"))


def _column(view: WaveformView, name: str) -> np.ndarray:
    """An attribute column of the echoes; NaN if the chain does not compute it."""
    return np.asarray(view.echoes.attributes.get(name, np.full(len(view.echoes), np.nan)), np.float64)


def _measure(value: float, error: float) -> str:
    return format_measure(value, error, "\N{PLUS-MINUS SIGN}")


def _cell(value: float, digits: int) -> str:
    """The value with so many digits; empty for no data."""
    return f"{value:.{digits}g}" if math.isfinite(value) else ""


def format_echoes(views: Sequence[WaveformView]) -> str:
    """CSV with one row per echo; a waveform without echoes has one row without values. Empty cells are no data."""
    extra = list(dict.fromkeys(name for view in views for name in view.echoes.attributes))
    head = ["packet", "point", "gps_time [s]", "echo"]
    head += [f"{name}{end} [{COLUMNS[name].unit}]" for name in _NAMES.values() for end in ("", "_err")]
    shown = (*_NAMES.values(), "point")
    rest = [name for name in extra if name.removesuffix("_err") not in shown and not name.endswith("_reason")]
    head += [f"{name} [{COLUMNS[name].unit}]" if name in COLUMNS else name for name in rest]
    table = []
    for view in views:
        place = [view.packet if view.packet >= 0 else "", view.point, f"{view.gps_time:.9f}"]
        for row in range(len(view.echoes)):
            texts = [_cell(value, 9) for pair in _measures(view, row) for value in pair]
            texts += [_cell(_column(view, name)[row], 9 if name not in ("x", "y", "z") else 13) for name in rest]
            flags = name_flags(int(view.echoes.flags[row])).replace(", ", " ")
            table.append([*place, row + 1, *texts, flags])
        if not len(view.echoes):
            table.append([*place, *[""] * (len(head) - 2)])
    return format_csv([*head, "flags"], table)
