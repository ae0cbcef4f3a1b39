"""Scan lines, and the straight lines in slices of them: called by tools/scan_slices.

`find_sweeps`: a scan line ends where the mirror turns, jumps back or pauses, seen in the angles of consecutive pulses.
Oscillating and rotating mirrors look different: the first turn, the second jump.

`find_lines`: straight lines in a slice of intensities, by a weighted Hough transform, refined by weighted total least
squares (Jutzi and Stilla, docs/algorithms.md 1.3). A pixel belongs to one line at most.

`find_bend`: where a row of points that was fitted by one line is two lines: the ridge of a shallow roof, a break of
slope. A bend must show in the residuals far beyond their noise, and a smooth curve must fit them worse: a hill stays
one line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LAG = 16
"""Pulses over which the direction of the mirror is judged: turns closer together than that are noise."""
_JUMP = 20.0
"""Steps of the angle above this many usual ones ..."""
_JUMP_SHARE = 0.25
"""... and above this share of its range are jumps."""
_PAUSE = 20.0
"""Times between pulses above this many usual ones are pauses."""


def find_sweeps(angle: np.ndarray, time: np.ndarray) -> np.ndarray:
    """First pulse of every scan line.

    Parameters
    ----------
    angle : float (n,)
        Across the flight direction, in any unit.
    time : float (n,), s
        Of the pulses.

    Returns
    -------
    int64 (k,)
        0 included; empty for no pulses. A line begins after a jump of the angle (a quarter of its range and 20 usual
        steps), after a pause (20 usual intervals, or a time that runs backwards), and where the angle turns.
    """
    n = len(angle)
    if n < 2:
        return np.arange(min(n, 1))
    step, interval = np.abs(np.diff(angle)), np.diff(time)
    usual = np.median(step[step > 0]) if (step > 0).any() else np.inf
    pause = _PAUSE * np.median(interval[interval > 0]) if (interval > 0).any() else np.inf
    jump = step > max(_JUMP * usual, _JUMP_SHARE * np.ptp(angle))
    cuts = np.flatnonzero(jump | (interval > pause) | (interval < 0)) + 1
    edges = np.concatenate([[0], cuts, [n]])
    parts = [a + _find_turns(angle[a:b]) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    return np.unique(np.concatenate([edges[:-1], *parts]))


def _find_turns(angle: np.ndarray) -> np.ndarray:
    """Pulses at which the angle turns, within one run without jumps."""
    if len(angle) <= 2 * LAG:
        return np.empty(0, np.int64)
    rising = angle[LAG:] > angle[:-LAG]
    changes = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    # Runs shorter than LAG are joined with their two neighbours, the shortest first.
    bounds = np.concatenate([[0], changes, [len(rising)]])
    while len(bounds) > 2:
        lengths = np.diff(bounds)
        shortest = int(np.argmin(lengths))
        if lengths[shortest] >= LAG:
            break
        gone = [number for number in (shortest, shortest + 1) if 0 < number < len(bounds) - 1]
        bounds = np.delete(bounds, gone)
    edges = bounds[1:-1]
    turns = []
    for edge in edges.tolist():
        low, high = max(edge - LAG, 0), min(edge + 2 * LAG, len(angle))
        part = angle[low:high]
        turns.append(low + int(np.argmax(part) if rising[edge - 1] else np.argmin(part)))
    return np.array(turns, np.int64)


LEAST_POINTS, LEAST_BEYOND = 8, 2
"""Smallest number of points, and of those beyond a bend on each side."""

LEAST_BEND = np.radians(2.0)
"""Smallest change of direction [rad]: both sides of a road whose middle is 2 % higher differ by 2.3 degrees."""

LARGEST_CHANCE = 1e-4
"""Largest chance that noise about one line looks like the bend. Roughness of neighbouring points is alike, so that the
test is less strict than it looks.
"""

LEAST_SHARE = 0.5
"""Smallest share of the squared residuals that a bend must explain: a wavy surface is not cut at each wave."""


def find_bend(place: np.ndarray, off: np.ndarray) -> float | None:
    """Where points near a line bend.

    Parameters
    ----------
    place : float (n,)
        Positions along the line.
    off : float (n,)
        Distances across it, in the same unit.

    Returns
    -------
    float or None
        The place of the bend; None where one line, or a smooth curve, does as well.

    Notes
    -----
    Least squares of a + b x + c max(x - t, 0) for every t at a point, against a + b x by an F test, and against
    a + b x + c x^2 (docs/algorithms.md 1.3).
    """
    n = len(place)
    if n < LEAST_POINTS:
        return None
    order = np.argsort(place, kind="stable")
    middle = 0.5 * float(place[order[0]] + place[order[-1]])
    half = 0.5 * float(place[order[-1]] - place[order[0]])
    if half <= 0:
        return None
    x, y = (place[order] - middle) / half, off[order] / half
    centre = x.mean()
    x, y = x - centre, y - y.mean()
    square = float(x @ x)
    y = y - x * (x @ y / square)
    number, sum_x, sum_xx, sum_y, sum_xy = (
        np.cumsum(values[::-1])[::-1] for values in (np.ones(len(x)), x, x * x, y, x * y)
    )
    total = sum_x - x * number
    along = sum_xx - x * sum_x
    size = sum_xx - 2 * x * sum_x + x * x * number - total**2 / len(x) - along**2 / square
    size = np.maximum(size, 1e-12)
    with_y = sum_xy - x * sum_y
    gains, changes = with_y**2 / size, with_y / size
    at = LEAST_BEYOND + int(np.argmax(gains[LEAST_BEYOND : n - LEAST_BEYOND]))
    whole, gain = float(y @ y), float(gains[at])
    left = max(whole - gain, 1e-12 * n)
    chance = (1.0 + gain / left) ** (-0.5 * (n - 4.0))  # of F with 2 and n - 4 degrees of freedom
    bent = chance < LARGEST_CHANCE and gain >= LEAST_SHARE * whole
    curve = x * x - (x * x).mean()
    curve = curve - x * (x @ curve / square)
    smooth = float((curve @ y) ** 2 / max(curve @ curve, 1e-12))  # what a parabola takes off the sum of squares
    bent &= abs(np.arctan(changes[at])) >= LEAST_BEND and gain > smooth
    return middle + half * float(x[at] + centre) if bent else None


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
            middle = found.middle + centre
            normal = _across(found.along)
            theta = np.degrees(np.arctan2(normal[1], normal[0]))
            if not -90 <= theta < 90:
                normal, theta = -normal, (theta + 270) % 180 - 90
            start, end = (tuple((middle + place * found.along).tolist()) for place in found.ends)
            light = float(weight[found.rows].sum())
            lines.append(HoughLine(float(theta), float(middle @ normal), start, end, light, found.rows))
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
            middle, along = _fit(self.points[inside], self.weight[inside])
            normal = _across(along)
            start = float(np.arctan2(normal[1], normal[0])), float(middle @ normal)

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
        # The median of its four quarters, so that one bright spot does not decide.
        apart, weight = self.points[tried] - middle, self.weight[tried]
        place, off = apart @ along, apart @ _across(along)
        low, high = place.min(), place.max()
        part = np.minimum(4 * (place - low) / max(high - low, 1e-12), 3).astype(np.int64)
        sums = np.bincount(part, weight, 4)
        spread = float(np.sqrt(np.median(np.bincount(part, weight * off**2, 4)[sums > 0] / sums[sums > 0])))
        if ends[1] - ends[0] < self.shortest or spread > CROWD * self.band / BAND:
            return None, np.union1d(first, tried)
        return _Run(middle, along, ends, tried), tried


def _across(along: np.ndarray) -> np.ndarray:
    """A direction turned left by 90 degrees."""
    return np.array([-along[1], along[0]])


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
