"""Echoes beside others of their waveform, and over their samples: the loops of stages/flags.py and decompose/merge.py.

They are compiled (kernels/c/neighbours.h, finish.h): an echo has few neighbours, so arrays of pairs cost more than the
pairs. Laws say which echoes are faint, or what fits leave unexplained; stages make them from what the survey knows.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels import library
from wavebatch.kernels.library import Samples, call, place

Points = tuple[tuple[float, float], ...]
"""Lag [ns] and value, ascending: lines between them."""

_FLOATS = "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err", "relative_energy_err", "residual"
COLUMNS = {"waveform": np.int32, "time": np.float64, **dict.fromkeys(_FLOATS, np.float32), "flags": np.uint16}
"""Core columns of an EchoTable, in the order of `Table` of kernels/c/echoes.h."""


class Faintness(NamedTuple):
    """Which echoes are faint beside a stronger one; times in ns."""

    share: float = 0.0
    """Below this share of one that lies between the next two before them."""
    nearest: float = 0.0
    furthest: float = -1.0
    after: bool = False
    """Or so far after them."""
    top: float = np.inf
    """Below `clipped` of one from this amplitude on, wherever it is [DN]."""
    clipped: float = 0.0
    tail: Points = ()
    """What a stronger echo leaves unexplained by how much later they are, as a share of its amplitude."""
    close: float = 0.0
    """The curve is known so far from a point."""
    apart: float = 0.0
    """And between two that are less than this apart."""
    beside: float = 0.0
    """They must have `factor` of the curve up to here, `far_factor` beyond, and be `known` errors above it."""
    factor: float = 0.0
    far_factor: float = 0.0
    known: float = 0.0


class Unexplained(NamedTuple):
    """What fits leave unexplained; times in ns."""

    core: float
    """An echo leaves `misfit` of its amplitude up to here."""
    misfit: float
    clear: float
    """From this amplitude on [DN] one leaves `left` up to `beside` away, by how much later the other is."""
    beside: float
    energy: float
    """What an echo of amplitude 1 leaves counts so much, in the variance of the other."""
    left: Points
    unit: float
    """Energy of an echo: amplitude^2 sigma times this, over `spacing` and `variance`."""
    spacing: float
    variance: float
    misfit2: float
    """chi2 per sample is expected to be 1, and this share of the energy over `samples`."""
    samples: float
    limit: float
    """chi2 per sample above which it is no chance."""


class Flagging(NamedTuple):
    """Limits of the flags that need no fit; times in ns."""

    spacing: float
    """Time between two samples."""
    last: float
    """Time of the last sample."""
    sigma_ref: float
    """NARROW: three errors below this."""
    narrow: float
    """And below this."""
    level: float
    """SATURATED: a sample within `reach` widths is at least this [DN]."""
    reach: float
    unreliable: float
    """AMPLITUDE_UNRELIABLE: this share of the amplitude is above the level."""


def weigh_fits(echoes: dict[str, np.ndarray], law: Unexplained, *, others: bool) -> tuple[np.ndarray, np.ndarray]:
    """Find by how much fits miss their samples, and what echoes leave beside others.

    Parameters
    ----------
    echoes : dict of arrays (m,)
        The core columns of an EchoTable, sorted by waveform, then time.
    law : Unexplained
    others : bool
        Whether others of the waveform leave anything.

    Returns
    -------
    unexplained : float64 (m,)
        chi2 per sample over what is expected; 1 where chance explains it.
    beside : float64 (m,)
        Largest of what the others leave, in the variance of the echo; 0 without `others`.
    """
    table, (unexplained, beside) = _as_table(echoes), np.zeros((2, len(echoes["time"])))
    call("weigh_fits", table, _as_structure(library.CUnexplained, law, "left"), unexplained, beside if others else None)
    return unexplained, beside


class Finishing(NamedTuple):
    """Steps from echoes of fits to a table, in their order; what has its default is left out."""

    sort: bool = False
    """Echoes are sorted by waveform, then time; few may be far from their place."""
    gaps: float = 0.0
    """Time between two samples [ns]: echoes inside of gaps are left out."""
    twins: float = 0.0
    """Of two neighbours of separate fits that are closer than so many widths of the narrower one, the weaker goes."""
    overlap: float = 0.0
    """Two of one fit that are closer than so many widths become one, where ..."""
    unresolved: float = 0.0
    """... they are closer than so many errors of their distance."""
    unproven: Faintness | None = None
    """Echoes that errors of a stronger one explain go."""
    unexplained: Unexplained | None = None
    """Errors grow by what fits leave unexplained."""
    others: bool = False
    """And by what others of the waveform leave."""
    lone: bool = False
    """OVERLAPPED goes where no other echo of the waveform has it."""
    flagging: Flagging | None = None
    """WEAK, NEAR_EDGE, NARROW, SATURATED and AMPLITUDE_UNRELIABLE are set."""
    ringing: Faintness | None = None
    """RINGING_SUSPECT is set."""


def finish_echoes(
    columns: dict[str, np.ndarray],
    row: np.ndarray,
    samples: Samples,
    steps: Finishing,
    factors: np.ndarray | None = None,
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray | None]:
    """Take echoes through the steps, in the arrays that are given: these hold anything afterwards.

    Parameters
    ----------
    columns : dict of arrays (m,)
        The core columns of an EchoTable, sorted by waveform, then time, unless `sort` is asked for.
    row : int64 (m,)
        A number of each echo, for other columns.
    samples : Samples
        Of n waveforms, with one level each.
    steps : Finishing
    factors : float64 (k, 4), optional
        By `row`: on the errors of the fits, for `grown`.

    Returns
    -------
    columns, row
        Of the echoes that are left, views of the arrays.
    grown : float32 array, optional
        With `factors`, of the amplitudes' errors: the factor, up to 1, times that of `unexplained`.
    """
    samples, m = samples.checked(finite=False), len(row)
    if samples.baseline.ndim != 1:
        raise ValueError("a waveform has more than one level")
    if m and not 0 <= columns["waveform"].min() <= columns["waveform"].max() < len(samples.counts):
        raise ValueError("an echo lies in no waveform")
    table = _as_table(columns, row)
    rows = 0 if factors is None or factors.shape[1:] != (4,) or steps.unexplained is None else len(factors)
    if factors is not None and m and not 0 <= row.min() <= row.max() < rows:
        raise ValueError("an echo has no factors, or nothing says how errors grow")
    laws = {
        "unproven": steps.unproven and _as_structure(library.CFaintness, steps.unproven, "tail"),
        "unexplained": steps.unexplained and _as_structure(library.CUnexplained, steps.unexplained, "left"),
        "flagging": steps.flagging and library.CFlagging(*steps.flagging),
        "ringing": steps.ringing and _as_structure(library.CFaintness, steps.ringing, "tail"),
    }
    given = steps._asdict() | {name: law and ctypes.addressof(law) for name, law in laws.items()}
    structure = library.CFinishing(**given, factors=None if factors is None else place(factors, np.float64))
    grown = None if factors is None else np.empty(m, np.float32)
    call("finish_echoes", table, samples.as_block(), structure, grown)
    found = {name: column[: table.m] for name, column in table.arrays.items()}
    return found, row[: table.m], None if grown is None else grown[: table.m]


def _as_table(echoes: dict[str, np.ndarray], row: np.ndarray | None = None) -> library.CTable:
    """The structure, which holds the columns to which it points."""
    columns = {name: np.ascontiguousarray(echoes[name], kind) for name, kind in COLUMNS.items()}
    m = len(columns["time"])
    if {len(column) for column in columns.values()} != {m} or (row is not None and len(row) != m):
        raise ValueError("columns of echoes differ in length")
    table = library.CTable(m, *map(library.address, columns.values()), None if row is None else place(row, np.int64))
    table.arrays = columns
    return table


def _as_structure(kind: Any, law: Any, points: str) -> Any:
    """The structure of a law whose curve has this name; it holds the arrays to which it points."""
    curve = np.array(getattr(law, points), np.float64).reshape(-1, 2)
    arrays = [np.ascontiguousarray(column) for column in curve.T]
    places = (place(array, np.float64) for array in arrays)
    structure = kind(**law._asdict() | {points: library.CCurve(len(curve), *places)})
    structure.arrays = arrays
    return structure
