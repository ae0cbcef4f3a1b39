"""Straight lines in a slice of intensities: weighted Hough transform, refined by weighted total least squares.

Used by the slices tool (Jutzi and Stilla, docs/algorithms.md 1.3). A pixel belongs to one line at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.kernels.geometry.bends import find_bend

THETA_STEP = 0.5
"""Step of the accumulator [deg]; the step of rho is one pixel."""
BAND = 3.0
"""Half width of the band around a line whose pixels are the line's, in sigma of the pulse."""
CROWD = 1.4
"""Largest spread of a line's pixels about it, in sigma: that of a pulse is 1, that of noise in the band 1.73."""
ROUNDS = 5
"""Rounds of refinement of a line."""
_FAILURES = 5
"""Largest sums in a row that belong to no segment before the search ends."""
_CHUNK = 65_536
"""Votes that are computed at a time."""
_REACH = 16_384
"""Largest number of steps of rho on each side: larger slices have coarser steps, so that memory is bounded."""


@dataclass(frozen=True, slots=True)
class HoughLine:
    """A segment of the line x cos(theta) + y sin(theta) = rho, in pixels."""

    theta: float
    """Direction of the normal [deg], in [-90, 90)."""
    rho: float
    """Distance of the line from the origin [pixels]."""
    start: tuple[float, float]
    """End of the segment with the smaller x (of a vertical one, the smaller y) [pixels]."""
    end: tuple[float, float]
    """The other end [pixels]."""
    weight: float
    """Sum of the intensities of its pixels."""
    rows: np.ndarray
    """Its pixels, as indices into the input, int64 (k,), ascending."""

    @property
    def length(self) -> float:
        """Distance between the ends [pixels]."""
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))


def find_lines(
    x: np.ndarray,
    y: np.ndarray,
    weight: np.ndarray,
    *,
    sigma: float,
    gap: float = 10.0,
    shortest: float = 20.0,
    most: int = 20,
    pulse: np.ndarray | None = None,
) -> list[HoughLine]:
    """Line segments among pixels, the strongest first.

    A line is the largest sum in the accumulator of intensities, refined by weighted total least squares of the pixels
    within BAND sigma. A segment is its longest run without a larger gap. Where the centroids of pulses show a bend, it
    is the stronger side of the bend. Its pixels are removed, and the search goes on.

    Parameters
    ----------
    x, y : float (n,), pixels
        Positions; they may be fractions.
    weight : float (n,)
        Intensities, positive.
    sigma : float, pixels
        Standard deviation of the pulse.
    gap : float, pixels
        Largest gap within a segment.
    shortest : float, pixels
        Smallest length of a segment.
    most : int
        Largest number of segments.
    pulse : int64 (n,), optional
        Pulse of each pixel, from 0; without it segments are not cut at bends.

    Returns
    -------
    list of HoughLine
    """
    if len(x) < 2:
        return []
    centre = np.array([x.mean(), y.mean()])
    points = np.stack([x, y], axis=1) - centre
    image, sheet = _Image(points, weight, pulse, BAND * sigma, gap, shortest), _Accumulator(points)
    sheet.vote(np.arange(len(x)), weight)
    left = np.ones(len(x), bool)
    lines: list[HoughLine] = []
    failures = 0
    while len(lines) < most and failures < _FAILURES:
        rows = np.flatnonzero(left)
        start = sheet.strongest()
        if start is None or len(rows) < 2:
            break
        found, used = image.settle(rows, start)
        if found is None:
            failures += 1
        else:
            lines.append(_describe(found, centre, weight))
        if not len(used):
            break
        left[used] = False
        sheet.vote(used, -weight[used])
    return lines


class _Accumulator:
    """Sums of intensities over theta and rho; each vote is split linearly between the two nearest rho."""

    def __init__(self, points: np.ndarray) -> None:
        reach = float(np.hypot(*np.abs(points).max(axis=0)))
        self._step = max(1.0, reach / _REACH)
        self._points = points / self._step
        self._angles = np.radians(np.arange(-90.0, 90.0, THETA_STEP))
        self._reach = int(np.ceil(reach / self._step)) + 1
        self._width = 2 * self._reach + 2
        self._sums = np.zeros((len(self._angles), self._width))
        self._whole = 0.0

    def vote(self, rows: np.ndarray, weight: np.ndarray) -> None:
        """Adds the intensities of pixels `rows`; negative ones take votes back."""
        self._whole += float(weight.sum())
        cells = self._sums.reshape(-1)
        step = max(_CHUNK // max(len(rows), 1), 1)
        x, y = self._points[rows].T
        for first in range(0, len(self._angles), step):
            angles = self._angles[first : first + step, None]
            rho = np.cos(angles) * x
            rho += np.sin(angles) * y
            rho += self._reach
            cell = rho.astype(np.int64)
            rho -= cell
            rho *= weight
            cell += self._width * np.arange(first, first + len(angles))[:, None]
            cell, above = cell.reshape(-1), rho.reshape(-1)
            np.add.at(cells, cell, (weight - rho).reshape(-1))
            cell += 1
            np.add.at(cells, cell, above)

    def strongest(self) -> tuple[float, float] | None:
        """Angle [rad] and rho of the largest sum; None when nothing is left."""
        if self._whole <= 0:
            return None
        number, bin_ = np.unravel_index(int(np.argmax(self._sums)), self._sums.shape)
        return float(self._angles[number]), self._step * (float(bin_) - self._reach)


@dataclass(frozen=True, slots=True)
class _Run:
    """A refined segment, in centred pixels."""

    middle: np.ndarray
    along: np.ndarray
    ends: tuple[float, float]
    rows: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    """All pixels (n,), centred, and the limits of a segment."""

    points: np.ndarray
    weight: np.ndarray
    pulse: np.ndarray | None
    band: float
    gap: float
    shortest: float

    def settle(self, rows: np.ndarray, start: tuple[float, float]) -> tuple[_Run | None, np.ndarray]:
        """The segment of `rows` near the line `start`, or None, and the pixels to remove."""
        while True:
            run, used = self._follow(rows, start)
            other = None if run is None or self.pulse is None else self._other_side(run)
            if run is None or self.pulse is None or other is None:
                return run, used
            # Whole pulses: pixels of half a pulse would turn the line.
            rows = rows[~np.isin(self.pulse[rows], other)]
            inside = np.intersect1d(run.rows, rows, assume_unique=True)
            start = _normal_form(*_fit(self.points[inside], self.weight[inside]))

    def _other_side(self, run: _Run) -> np.ndarray | None:
        """Pulses on the weaker side of a run's bend; None where it has no bend."""
        apart, light = self.points[run.rows] - run.middle, self.weight[run.rows]
        pulse = np.asarray(self.pulse)[run.rows]
        sums = np.bincount(pulse, light)
        seen = np.flatnonzero(sums)
        axes = (run.along, _across(run.along))
        place, off = (np.bincount(pulse, light * (apart @ axis))[seen] / sums[seen] for axis in axes)
        bend = find_bend(place, off)
        if bend is None:
            return None
        later = place > bend
        stronger = 2 * sums[seen[later]].sum() > sums.sum()
        return seen[later != stronger]

    def _follow(self, rows: np.ndarray, start: tuple[float, float]) -> tuple[_Run | None, np.ndarray]:
        """The straight run of `rows` near the line `start`, or None, and the pixels to remove."""
        angle, rho = start
        normal = np.array([np.cos(angle), np.sin(angle)])
        middle, along = rho * normal, _across(normal)
        first = tried = rows[np.abs((self.points[rows] - middle) @ normal) <= self.band]
        ends = (0.0, 0.0)
        for _ in range(ROUNDS):
            inside = rows[np.abs((self.points[rows] - middle) @ _across(along)) <= self.band]
            inside, ends = _longest_run(inside, (self.points[inside] - middle) @ along, self.gap)
            if len(inside) < 2:
                return None, first
            tried = inside
            old = middle
            middle, along = _fit(self.points[inside], self.weight[inside])
            shift = float((old - middle) @ along)
            ends = (ends[0] + shift, ends[1] + shift)
        spread = _measure_spread(self.points[tried] - middle, self.weight[tried], along)
        if ends[1] - ends[0] < self.shortest or spread > CROWD * self.band / BAND:
            return None, np.union1d(first, tried)
        return _Run(middle, along, ends, tried), tried


def _normal_form(middle: np.ndarray, along: np.ndarray) -> tuple[float, float]:
    """Angle [rad] and rho of a line."""
    normal = _across(along)
    return float(np.arctan2(normal[1], normal[0])), float(middle @ normal)


def _across(along: np.ndarray) -> np.ndarray:
    """A direction turned left by 90 degrees."""
    return np.array([-along[1], along[0]])


def _measure_spread(apart: np.ndarray, weight: np.ndarray, along: np.ndarray) -> float:
    """Spread of pixels about their line: the median of its four quarters, so that one bright spot does not decide."""
    place, off = apart @ along, apart @ _across(along)
    low, high = place.min(), place.max()
    part = np.minimum(4 * (place - low) / max(high - low, 1e-12), 3).astype(np.int64)
    sums = np.bincount(part, weight, 4)
    return float(np.sqrt(np.median(np.bincount(part, weight * off**2, 4)[sums > 0] / sums[sums > 0])))


def _fit(points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted centre and main axis: the line of least weighted squared distances."""
    total = weight.sum()
    middle = weight @ points / total
    apart = points - middle
    _, axes = np.linalg.eigh((apart * weight[:, None]).T @ apart)
    along = axes[:, 1]
    sign = along[0] if abs(along[0]) > 1e-12 else along[1]
    return middle, along if sign > 0 else -along


def _longest_run(rows: np.ndarray, place: np.ndarray, gap: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Rows, ascending, of the longest run of places without a larger gap, and the places of its ends."""
    if not len(rows):
        return rows, (0.0, 0.0)
    order = np.argsort(place, kind="stable")
    sorted_ = place[order]
    breaks = np.flatnonzero(np.diff(sorted_) > gap) + 1
    first, last = np.concatenate([[0], breaks]), np.concatenate([breaks, [len(rows)]]) - 1
    best = int(np.argmax(sorted_[last] - sorted_[first]))
    a, b = int(first[best]), int(last[best])
    return np.sort(rows[order[a : b + 1]]), (float(sorted_[a]), float(sorted_[b]))


def _describe(run: _Run, centre: np.ndarray, weight: np.ndarray) -> HoughLine:
    middle = run.middle + centre
    normal = _across(run.along)
    theta = np.degrees(np.arctan2(normal[1], normal[0]))
    if not -90 <= theta < 90:
        normal, theta = -normal, (theta + 270) % 180 - 90
    start, end = (tuple((middle + place * run.along).tolist()) for place in run.ends)
    return HoughLine(float(theta), float(middle @ normal), start, end, float(weight[run.rows].sum()), run.rows)
