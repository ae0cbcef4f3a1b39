"""Echoes beside others of their waveform, and over their samples: the loops of stages/flags.py and decompose/merge.py.

They are compiled (kernels/c/neighbours.h): an echo has few neighbours, so arrays of pairs cost more than the pairs.
Laws say which echoes are faint, or what fits leave unexplained; stages make them from what the survey knows.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.library import Samples, call, place

Points = tuple[tuple[float, float], ...]
"""Lag [ns] and value, ascending: lines between them."""

_COLUMNS = {"waveform": np.int32, "time": np.float64, "amplitude": np.float32, "sigma": np.float32,
            "time_err": np.float32, "amplitude_err": np.float32, "sigma_err": np.float32, "residual": np.float32,
            "flags": np.uint16}  # fmt: skip


class Faintness(NamedTuple):
    """Which echoes are faint beside a stronger one; times in ns."""

    share: float = 0.0
    """Below this share of one that lies between the next two before them."""
    nearest: float = 0.0
    furthest: float = -1.0
    after: bool = False
    """Or so far after them."""
    top: float = np.inf
    """Below `clipped` of one from this amplitude on, wherever it is [count]."""
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
    """From this amplitude on [count] one leaves `left` up to `beside` away, by how much later the other is."""
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
    """SATURATED: a sample within `reach` widths is at least this [count]."""
    reach: float
    unreliable: float
    """AMPLITUDE_UNRELIABLE: this share of the amplitude is above the level."""


def find_faint(echoes: Any, law: Faintness) -> np.ndarray:
    """Find echoes that an error of a stronger one of their waveform explains.

    Parameters
    ----------
    echoes : with the core columns of an EchoTable, arrays (m,)
        Sorted by waveform, then time.
    law : Faintness

    Returns
    -------
    bool (m,)
    """
    table, faint = _as_table(echoes), np.empty(len(echoes.time), np.bool_)
    curve = _as_curve(law.tail)
    call("find_faint", table, library.CFaintness(**law._asdict() | {"tail": curve}), faint)
    return faint


def weigh_fits(echoes: Any, law: Unexplained, *, others: bool) -> tuple[np.ndarray, np.ndarray]:
    """Find by how much fits miss their samples, and what echoes leave beside others.

    Parameters
    ----------
    echoes
        As for `find_faint`.
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
    table, (unexplained, beside) = _as_table(echoes), np.zeros((2, len(echoes.time)))
    curve = _as_curve(law.left or ((0.0, 0.0),))
    given = library.CUnexplained(**law._asdict() | {"left": curve})
    call("weigh_fits", table, given, unexplained, beside if others else None)
    return unexplained, beside


def set_flags(echoes: Any, samples: Samples, law: Flagging) -> np.ndarray:
    """Set the flags WEAK, NEAR_EDGE (of the waveform), NARROW, SATURATED and AMPLITUDE_UNRELIABLE.

    Parameters
    ----------
    echoes
        As for `find_faint`.
    samples : Samples
        Of n waveforms, with one level each.
    law : Flagging

    Returns
    -------
    uint16 (m,)
        The flags that they had, and these.
    """
    samples, table, flags = samples.checked(), _as_table(echoes), np.empty(len(echoes.time), np.uint16)
    if samples.baseline.ndim != 1:
        raise ValueError("a waveform has more than one level")
    if len(flags) and not 0 <= echoes.waveform.min() <= echoes.waveform.max() < len(samples.counts):
        raise ValueError("an echo lies in no waveform")
    call("set_flags", table, samples.as_block(), library.CFlagging(*law), flags)
    return flags


def find_pairs(echoes: Any, width: float, error: float = 0.0) -> np.ndarray:
    """Find neighbours that are one echo.

    Parameters
    ----------
    echoes
        As for `find_faint`.
    width : float
        They are closer than so many widths of the narrower one.
    error : float
        They were fitted together, and are closer than so many errors of their distance; no echo is in two pairs. Of 0:
        they were fitted apart.

    Returns
    -------
    int64 (k,)
        First row of each pair.
    """
    first = np.empty(len(echoes.time), np.int64)
    return first[: call("find_pairs", _as_table(echoes), ctypes.c_double(width), ctypes.c_double(error), first)]


def _as_table(echoes: Any) -> library.CTable:
    """The structure, which points into the columns."""
    columns = [np.ascontiguousarray(getattr(echoes, name), kind) for name, kind in _COLUMNS.items()]
    if {len(column) for column in columns} != {len(columns[0])}:
        raise ValueError("columns of echoes differ in length")
    table = library.CTable(len(columns[0]), *map(library.address, columns))
    table.arrays = columns
    return table


def _as_curve(points: Points) -> library.CCurve:
    arrays = [np.ascontiguousarray(column) for column in np.array(points, np.float64).reshape(-1, 2).T]
    curve = library.CCurve(len(arrays[0]), *(place(array, np.float64) for array in arrays))
    curve.arrays = arrays
    return curve
