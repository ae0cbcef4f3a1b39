"""Amplitude, time and width of whole echoes, with their errors, from the parameters of fits: kernels/c/echoes.h.

stages/pulse_tables.py makes the tables; stages/decompose/solve.py makes its table of echoes with it.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.fit.decompose import Clusters, Solution
from wavebatch.kernels.library import call, place

AS_FITTED, STRETCHED, SUMMED = range(3)
"""The parameters are those of the echo; the pulse is stretched; it is a sum, described by tables."""

NO_ROWS = np.empty((0, 5))


class WholePulse(NamedTuple):
    """A pulse by its fitted width [samples]."""

    kind: int = AS_FITTED
    near: np.ndarray = NO_ROWS
    """SUMMED, for usual widths, float64 (k, 5): width, ascending; peak and its slope; sigma and its slope."""
    wide: np.ndarray = NO_ROWS
    """The same for wider ones; without rows where there is none."""
    datum: float = 0.0
    """SUMMED: after the fitted time [samples]. STRETCHED: of width 1."""
    ref: float = 1.0
    """STRETCHED: width of the system pulse."""
    least: float = 0.0
    """STRETCHED: over `ref`, width below which the datum stays."""

    def as_structure(self, widths: np.ndarray) -> library.CWhole:
        """The structure, which points into its arrays; raises ValueError where a table has no row for a width."""
        near, wide = (np.asarray(table, np.float64).reshape(-1, 5) for table in (self.near, self.wide))
        if self.kind == SUMMED and (not len(near) or (not len(wide) and (widths > near[-1, 0]).any())):
            raise ValueError("the pulse has no table for these widths")
        tables = [np.ascontiguousarray(part) for table in (near, wide) for part in (table[:, 0], table[:, 1:])]
        whole = library.CWhole(self.kind, len(near), len(wide), *(place(part, np.float64) for part in tables),
                               self.datum, self.ref, self.least)  # fmt: skip
        whole.arrays = tables
        return whole


def describe_whole(
    whole: WholePulse, parameters: np.ndarray, errors: np.ndarray, shared: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude, time and width of the whole pulse.

    Parameters
    ----------
    whole : WholePulse
    parameters, errors : float64 (m, 3)
        Of its main component [count, samples, samples], and their standard deviations.
    shared : float64 (m, 2)
        Covariance of the width with the amplitude, and with the time.

    Returns
    -------
    parameters, errors : float64 (m, 3)
    """
    values, spreads = (np.array(array, np.float64, order="C") for array in (parameters, errors))
    shared = np.ascontiguousarray(shared, np.float64)
    if not (values.shape == spreads.shape == (len(shared), 3) and shared.shape[1:] == (2,)):
        raise ValueError(f"parameters of shape {values.shape} need as many errors and covariances")
    structure = whole.as_structure(values[:, 2])
    call("describe_echoes", ctypes.c_int64(len(values)), structure, values, spreads, shared)
    return values, spreads


def keep_echoes(
    clusters: Clusters,
    solution: Solution,
    whole: WholePulse,
    factors: np.ndarray,
    std: np.ndarray,
    spacing: float,
    length: int,
    significance: float,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Echoes of fits that noise does not explain and that lie in their waveform, as columns of a table.

    Parameters
    ----------
    clusters : Clusters
    solution : Solution
        Their fits.
    whole : WholePulse
    factors : float64 (m, 4)
        On the errors of amplitude, time, sigma and energy.
    std : float32 (n,)
        Noise of each waveform [count].
    spacing : float
        Time between two samples [ns].
    length : int
        Samples of a waveform.
    significance : float
        Least energy of an echo [standard deviations].

    Returns
    -------
    columns : dict of arrays (k,)
        The core columns of an EchoTable, in the order of the fits.
    row : int64 (k,)
        Of each echo among the m fitted ones.
    """
    m, n = len(solution.parameters), len(solution.number)
    factors, std = np.ascontiguousarray(factors, np.float64), np.ascontiguousarray(std, np.float32)
    waveform = np.ascontiguousarray(clusters.waveform, np.int64)
    fits: list[np.ndarray] = [
        np.ascontiguousarray(column, kind) for column, kind in zip(solution, _SOLUTION, strict=True)
    ]
    shapes = [(n,)] * 4 + [(m, 4), (m, 4), (m, 2), (m,), (m, 4), (n,)]
    if [column.shape for column in (*fits, factors, waveform)] != shapes or fits[0].sum() != m or (fits[0] < 0).any():
        raise ValueError("columns of fits, clusters or factors differ in length")
    if n and not 0 <= waveform.min() <= waveform.max() < len(std):
        raise ValueError("a cluster lies in no waveform")
    columns = {name: np.empty(m, kind) for name, kind in _COLUMNS.items()}
    kept = call(
        "keep_echoes", library.CClusters(n, library.address(waveform)),
        library.Echoes(m, *map(library.address, fits)), whole.as_structure(fits[4][:, 2]),
        library.CKeeping(library.address(std), library.address(factors), spacing, length - 1, significance),
        library.CKept(*map(library.address, columns.values())),
    )  # fmt: skip
    found = {name: column[:kept] for name, column in columns.items()}
    return found, found.pop("row")


_SOLUTION = (np.int64, np.bool_, *[np.float64] * 5, np.bool_)
_FLOATS = ("amplitude", "sigma", "time_err", "amplitude_err", "sigma_err", "relative_energy_err", "residual")
_COLUMNS = {"waveform": np.int32, "time": np.float64, **dict.fromkeys(_FLOATS, np.float32), "flags": np.uint16,
            "row": np.int64}  # fmt: skip
