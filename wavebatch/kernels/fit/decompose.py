"""Decomposition of waveforms into echoes by the compiled library: its types, clusters of candidates, the call, echoes.

stages/decompose and the survey make Settings, group candidates before the fit (kernels/c/signal.h does it) and read
Solution: the library fits one cluster after the other (kernels/c/decompose.h). All widths and times are in samples. A
cluster of overlapping echoes has a window of samples; windows of neighbouring clusters must not overlap: a window that
reaches into its neighbour finds false echoes there (9 % false splits instead of 0.9 %).

At the end fits become echoes of the whole pulse, with errors (kernels/c/echoes.h).
"""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels import library
from wavebatch.kernels.fit.neighbours import COLUMNS
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, NO_SKEW, TAIL_STEP, PulseShape, PulseTail
from wavebatch.kernels.library import Samples, call, place


class Candidates(NamedTuple):
    """Candidate echoes sorted by waveform, then time."""

    waveform: np.ndarray
    """Row of the block, int64 (m,)."""
    time: np.ndarray
    """Place of the peak, float64 (m,), samples."""
    amplitude: np.ndarray
    """Height above the baseline, float64 (m,), count."""
    width: np.ndarray
    """Gaussian standard deviation, float64 (m,), samples."""


class Clusters(NamedTuple):
    """Candidates that are fitted together, sorted by waveform."""

    waveform: np.ndarray
    """Row of the block, int64 (c,)."""
    low: np.ndarray
    """First sample of the window, int64 (c,)."""
    high: np.ndarray
    """End of the window: one after its last sample, int64 (c,)."""
    first: np.ndarray
    """First candidate of the cluster, int64 (c,)."""
    number: np.ndarray
    """Number of its candidates, int64 (c,)."""


def cluster_candidates(
    samples: Samples,
    candidates: Candidates,
    *,
    margin: int,
    reach: int,
    most: int,
    tail: np.ndarray | None = None,
) -> Clusters:
    """Joins candidates that stand on one run of signal above the noise, and gives each cluster its window.

    Parameters
    ----------
    samples : Samples
        Waveforms with their levels; smoothed with [1 2 1]/4, a run lies above 2 standard deviations.
    candidates : Candidates
        Sorted by waveform, then time.
    margin : int, samples
        Added on both sides of a run.
    reach : int, samples
        Smallest distance between the outer candidates and the ends of the window.
    most : int
        Largest number of candidates per cluster.
    tail : int (m,), samples, optional
        How far the after-pulses of each candidate reach.

    Returns
    -------
    Clusters
        With windows that do not overlap.
    """
    samples, m = samples.checked(), len(candidates.waveform)
    waveform = np.ascontiguousarray(candidates.waveform, np.int64)
    time = np.ascontiguousarray(candidates.time, np.float64)
    if m and not (waveform.min() >= 0 and waveform.max() < len(samples.counts) and np.isfinite(time).all()):
        raise ValueError("a candidate lies in no waveform")
    columns = [np.empty(m, np.int64) for _ in Clusters._fields]
    tail = None if tail is None else np.ascontiguousarray(tail, np.int64)
    grouping = library.Grouping(margin, reach, most, None if tail is None else place(tail, np.int64))
    groups = library.CGroups(*(place(column, np.int64) for column in columns))
    c = call("group_candidates", samples.as_block(), ctypes.c_int64(m), waveform, time, grouping, groups)
    return Clusters(*(column[:c] for column in columns))


def explain_tails(
    candidates: Candidates, std: np.ndarray, tail: PulseTail, most: int, quiet: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which candidates are more than after-pulses of others of their waveform.

    Parameters
    ----------
    candidates : Candidates
        m, sorted by waveform, then time.
    std : float32 (n,)
        Noise of each waveform [DN].
    tail : PulseTail
        Of the system pulse.
    most : int
        Candidates on each side whose tails count.
    quiet : float
        Tails below so many noises explain nothing.

    Returns
    -------
    kept : bool (m,)
    reach : int64 (m,), samples
        How far the tail of each exceeds the noise.
    """
    m, std = len(candidates.waveform), np.ascontiguousarray(std, np.float32)
    waveform = np.ascontiguousarray(candidates.waveform, np.int64)
    time, amplitude = (np.ascontiguousarray(values, np.float64) for values in (candidates.time, candidates.amplitude))
    if not len(time) == len(amplitude) == m or (m and not 0 <= waveform.min() <= waveform.max() < len(std)):
        raise ValueError("a candidate lies in no waveform")
    kept, reach, n = np.empty(m, np.bool_), np.empty(m, np.int64), len(tail.value)
    value, highest = (place(values, np.float64) for values in (tail.value, tail.highest))
    given = library.CTail(n, n - len(tail.highest), tail.first, TAIL_STEP, value, highest)
    limits = ctypes.c_int64(most), ctypes.c_float(quiet)
    call("explain_tails", ctypes.c_int64(m), waveform, time, amplitude, std, given, *limits, kept, reach)
    return kept, reach


class Settings(NamedTuple):
    """Options of a decomposition; widths in samples."""

    width_ref: float
    """Width of the system pulse: that of new echoes."""
    width_low: float
    """Smallest width allowed."""
    width_high: float
    """Largest width allowed."""
    shape: PulseShape = GAUSSIAN
    """Model of the pulse."""
    clip: float | None = None
    """Raw count from which samples are clipped; None where none is."""
    floor: float | None = None
    """Raw count up to which samples are cut off below; None where none is."""
    noise_gain: float = 0.0
    """Noise variance per count of signal (docs/algorithms.md H12) [DN]."""
    tolerance: float = 1e-2
    """A fit has converged when the next step promises a fall of chi2 below this."""
    max_iterations: int = 40
    """Largest number of iterations of one fit; 40 at least where samples are clipped."""
    grow: bool = True
    """Whether echoes are added where the residual shows more than noise."""
    thorough: bool = False
    """Whether missed echoes are searched again, and one broad echo may stand for several (docs/algorithms.md 2.3)."""
    free_levels: bool = False
    """Whether levels are known only to their errors (docs/algorithms.md H10)."""
    acceptance: float = 15.0
    """Smallest fall of chi2 for which an echo is added (docs/algorithms.md 2.3)."""
    misfit: float = 0.0
    """Deviation of the pulse from its model as a share of the amplitude: raises the acceptance of strong echoes."""
    max_echoes: int = 6
    """Largest number of echoes of one cluster that growth may reach."""
    prior_spread: float = 0.0
    """Standard deviation of a one-sided prior on widths of overlapping echoes below `width_ref`; 0 for none. Without
    it, close echoes trade width against amplitude (docs/algorithms.md H1)."""
    gate_residual: float = 4.2
    """Limit of the smoothed residual [noise standard deviations] (docs/algorithms.md 4.2)."""
    gate_hermite: float = 8.5
    """Limit of h3^2 + h4^2 (docs/algorithms.md 4.2)."""
    known: float = 0.0
    """Errors that the amplitude of an echo needs beside others, or chi2 must rise enough without it; 0: any will do."""
    whitening: np.ndarray | None = None
    """Filter that makes the noise white, float64 (3, 3), `whitening_filter`; None where fits take it for white."""
    undamped: bool = False
    """Gauss-Newton steps without damping or limits, for comparison (docs/algorithms.md 1.3)."""
    skew_mean: float = 0.0
    """Mean of the normal prior on the skew of each echo (docs/algorithms.md 1.2)."""
    skew_spread: float = 0.0
    """Its standard deviation; 0 for echoes without a skew of their own."""


class Solution(NamedTuple):
    """Echoes of c clusters, m in all, sorted by cluster."""

    number: np.ndarray
    """Number of echoes of each cluster, int64 (c,)."""
    converged: np.ndarray
    """Whether the fit of each cluster has converged, bool (c,)."""
    cost: np.ndarray
    """chi2 plus prior of each cluster, float64 (c,)."""
    misfit: np.ndarray
    """Root mean square residual within four widths of the pulse of each echo [noise standard deviations], of its window
    where it is alone there, float64 (m,)."""
    parameters: np.ndarray
    """Amplitude [DN], time [samples of the waveform], width [samples], skew of each echo, float64 (m, 4)."""
    errors: np.ndarray
    """One standard deviation of each parameter, float64 (m, 4)."""
    shared: np.ndarray
    """Covariance of the width of each echo with its amplitude, and with its time, float64 (m, 2)."""
    at_bound: np.ndarray
    """Whether a parameter of the echo lies on its limit, bool (m,)."""

    @property
    def cluster(self) -> np.ndarray:
        """Cluster of each echo, int64 (m,)."""
        return np.repeat(np.arange(len(self.number)), self.number)


    def take(self, rows: np.ndarray) -> Solution:
        """The clusters `rows`, int (r,), in that order, with their echoes."""
        first = np.cumsum(self.number) - self.number
        number = self.number[rows]
        echo = np.arange(number.sum()) + np.repeat(first[rows] - (np.cumsum(number) - number), number)
        return Solution(*(one.take(rows) for one in self[:3]), *(one.take(echo, axis=0) for one in self[3:]))


def choose(solutions: list[Solution], chosen: np.ndarray) -> Solution:
    """For each cluster the solution number `chosen`, int (c,), of solutions of the same clusters."""
    per_cluster = (np.choose(chosen, fields) for fields in zip(*(s[:3] for s in solutions), strict=True))
    kept = [np.flatnonzero(chosen[solution.cluster] == i) for i, solution in enumerate(solutions)]
    cluster = np.concatenate([s.cluster[rows] for s, rows in zip(solutions, kept, strict=True)])
    order = np.argsort(cluster, kind="stable")
    per_echo = (
        np.concatenate([field[rows] for field, rows in zip(fields, kept, strict=True)])[order]
        for fields in zip(*(s[3:] for s in solutions), strict=True)
    )
    return Solution(*per_cluster, *per_echo)


def decompose_clusters(samples: Samples, candidates: Candidates, clusters: Clusters, settings: Settings) -> Solution:
    """Fits and grows all clusters.

    Parameters
    ----------
    samples : Samples
        Waveforms.
    candidates : Candidates
        Start values.
    clusters : Clusters
        Windows, and which candidates belong to each.
    settings : Settings
        Options.

    Returns
    -------
    Solution
        In the order of the clusters.

    References
    ----------
    docs/algorithms.md 2.3 and 4.2.
    """
    problem = _as_problem(samples, candidates, clusters, settings)
    c = len(clusters.number)
    number, converged = np.zeros(c, np.int64), np.zeros(c, bool)
    cost = np.zeros(c)
    parts: list[list[np.ndarray]] = []
    room, done = int(clusters.number.sum()) + c // 4 + 64, 0
    while done < c or not parts:
        echoes = np.empty(room), np.empty((room, 4)), np.empty((room, 4)), np.empty((room, 2)), np.empty(room, bool)
        columns = (number, converged, cost, *echoes)
        out = library.Echoes(room, *map(library.address, columns))
        found = ctypes.c_int64()
        reached = call("decompose_clusters", *problem, ctypes.c_int64(done), out, ctypes.byref(found))
        parts.append([column[: found.value] for column in echoes])
        room, done = 2 * room, reached
    joined = parts[0] if len(parts) == 1 else map(np.concatenate, zip(*parts, strict=True))
    return Solution(number, converged, cost, *joined)


def _as_problem(
    samples: Samples, candidates: Candidates, clusters: Clusters, settings: Settings
) -> tuple[library.Block, library.CClusters, library.CSettings]:
    """The structures of one call; each holds the arrays to which it points.

    Raises ValueError where the library would read outside of an array.
    """
    samples = samples.checked()
    n, s = samples.counts.shape
    waveform, low, high, first, number = clusters
    m = len(candidates.time)
    if {len(column) for column in clusters} != {len(number)} or {len(column) for column in candidates[1:]} != {m}:
        raise ValueError("the columns of clusters or candidates differ in length")
    inside = (waveform >= 0) & (waveform < n) & (low >= 0) & (low < high) & (high <= s)
    if not (inside & (number > 0) & (first >= 0) & (first + number <= m)).all():
        raise ValueError("a window lies outside of its waveform, or its candidates outside of their table")
    if not all(np.isfinite(column).all() for column in candidates[1:]):
        raise ValueError("candidates must be finite")
    candidates = Candidates(*(np.ascontiguousarray(field, np.float64) for field in candidates))
    clusters = Clusters(*(np.ascontiguousarray(field, np.int64) for field in clusters))
    windows = library.CClusters(
        len(clusters.number), *(place(field, np.int64) for field in clusters),
        *(place(field, np.float64) for field in (candidates.amplitude, candidates.time, candidates.width)),
    )  # fmt: skip
    windows.arrays = candidates, clusters
    if not 0 < settings.width_ref < np.inf:
        raise ValueError("the width of the pulse must be above 0")
    pulse = as_pulse(settings.shape)
    values = settings._asdict() | {
        "pulse": pulse,
        "clip": np.inf if settings.clip is None else settings.clip,
        "floor": -np.inf if settings.floor is None else settings.floor,
    }
    del values["shape"]
    table = np.zeros((3, 3)) if settings.whitening is None else np.asarray(settings.whitening, np.float64)
    if table.shape != (3, 3) or not np.isfinite(table).all():
        raise ValueError("a whitening filter has three finite rows of three")
    values |= {"whitened": settings.whitening is not None, "whitening": (ctypes.c_double * 9)(*table.ravel())}
    structure = library.CSettings(**values)
    structure.arrays = pulse.arrays
    return samples.as_block(), windows, structure


def as_pulse(shape: PulseShape) -> library.Pulse:
    """The pulse for the library; the structure holds the arrays to which it points."""
    components = np.array(shape.components, np.float64).reshape(-1, 3)
    rows = (np.zeros(2, np.float32),) * 2 if shape.table is None else (shape.table.value, shape.table.slope)
    if not 2 <= len(rows[0]) == len(rows[1]):
        raise ValueError("the table of a pulse must have a slope for each of its rows")
    first, step = (0.0, 1.0) if shape.table is None else shape.table[:2]
    pulse = library.Pulse(
        _kind(shape), shape.kappa, shape.power, len(components), place(components, np.float64),
        len(rows[0]), first, step, *(place(row, np.float32) for row in rows), shape.origin == "waveform",
    )  # fmt: skip
    pulse.arrays = components, *rows
    return pulse


def _kind(shape: PulseShape) -> int:
    """Number of the model in the library."""
    if shape.origin:
        return library.Pulse.LOG_NORMAL
    if shape.components:
        return library.Pulse.SUM_OF_GAUSSIANS
    if shape.table is not None:
        return library.Pulse.TABLE
    if shape.power != 2.0:
        return library.Pulse.POWER
    return library.Pulse.SKEWED if abs(shape.kappa) >= NO_SKEW else library.Pulse.SUM_OF_GAUSSIANS


AS_FITTED, STRETCHED, SUMMED = range(3)
"""The parameters are those of the echo; the pulse is stretched; it is a sum, described by tables."""

NO_ROWS = np.empty((0, 5))


class WholePulse(NamedTuple):
    """How a fit becomes the echo of the whole pulse: datum, peak and sigma, by the fitted width [samples]."""

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
        Of its main component [DN, samples, samples], and their standard deviations.
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
    level_err: np.ndarray | None = None,
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
        Noise of each waveform [DN].
    spacing : float
        Time between two samples [ns].
    length : int
        Samples of a waveform.
    significance : float
        Least energy of an echo [standard deviations].
    level_err : float32 (n,), optional
        Standard deviations of the levels that fits left free [DN]; None where they took them as known.

    Returns
    -------
    columns : dict of arrays (k,)
        The core columns of an EchoTable, in the order of the fits.
    row : int64 (k,)
        Of each echo among the m fitted ones.
    """
    m, n = len(solution.parameters), len(solution.number)
    factors, std = np.ascontiguousarray(factors, np.float64), np.ascontiguousarray(std, np.float32)
    level_err = None if level_err is None else np.ascontiguousarray(level_err, np.float32)
    waveform, low, high = (np.ascontiguousarray(column, np.int64) for column in clusters[:3])
    fits: list[np.ndarray] = [
        np.ascontiguousarray(column, kind) for column, kind in zip(solution, _SOLUTION, strict=True)
    ]
    shapes = [(n,)] * 3 + [(m,), (m, 4), (m, 4), (m, 2), (m,), (m, 4), (n,)]
    if [column.shape for column in (*fits, factors, waveform)] != shapes or fits[0].sum() != m or (fits[0] < 0).any():
        raise ValueError("columns of fits, clusters or factors differ in length")
    if n and not 0 <= waveform.min() <= waveform.max() < len(std):
        raise ValueError("a cluster lies in no waveform")
    columns = {name: np.empty(m, kind) for name, kind in (COLUMNS | {"row": np.int64}).items()}
    kept = call(
        "keep_echoes", library.CClusters(n, library.address(waveform), library.address(low), library.address(high)),
        library.Echoes(m, *map(library.address, fits)), whole.as_structure(fits[4][:, 2]),
        library.CKeeping(
            library.address(std), None if level_err is None else library.address(level_err), library.address(factors),
            spacing, length - 1, significance,
        ),
        library.CTable(m, *map(library.address, columns.values())),
    )  # fmt: skip
    found = {name: column[:kept] for name, column in columns.items()}
    return found, found.pop("row")


_SOLUTION = (np.int64, np.bool_, *[np.float64] * 5, np.bool_)
