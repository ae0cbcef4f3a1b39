"""Where the sensor was at any time: positions over time, interpolated where they are dense, NaN elsewhere.

Made by the reader of trajectory files and by the survey from packet vectors; used for ranges. LAS files and
trajectories use different GPS clocks: `solve_offset` finds the difference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import median
from wavebatch.core.units import ADJUSTED, WEEK

LONGEST_GAP = 1.0
"""Gaps between two positions up to this are always bridged [s]."""

FARTHEST, LATEST = 1e9, 1e12
"""Largest coordinate [m] and time [s] of a position; damaged files have larger ones, whose squares overflow."""

LEAST_STEP = 1e-9
"""Positions that follow sooner [s] are dropped: clocks of sensors are not finer, and velocities would overflow."""

GAP_STEPS = 5.0
"""Gaps up to this many usual steps are bridged too."""

ACCELERATION = 30.0
"""Most that a sensor is accelerated [m/s2]: three times gravity."""

LEAST_JUMP, JUMP_SCATTER = 1.0, 10.0
"""A position jumps that is off the line between its neighbours by so much [m], and so many times what most are, beyond
what ACCELERATION explains."""


@frozen(eq=False)
class Trajectory:
    """Positions of the sensor over time. It can be pickled, so that worker processes can use it."""

    time: np.ndarray
    """Ascending times on the clock of the strip, float64 (k,), s."""
    xyz: np.ndarray
    """Positions, float64 (k, 3), m."""
    velocity: np.ndarray
    """Velocities, float64 (k, 3), m/s."""
    gap: float
    """Longest step between positions that is bridged [s]."""

    @classmethod
    def build(
        cls, time: np.ndarray, xyz: np.ndarray, velocity: np.ndarray | None = None, gap: float | None = None
    ) -> Trajectory:
        """A trajectory from positions in any order.

        Rows with NaN, rows beyond FARTHEST and LATEST, and rows less than LEAST_STEP after another are left out.

        Parameters
        ----------
        time : float (n,), s
            Times of the positions.
        xyz : float (n, 3), m
            Positions.
        velocity : float (n, 3), m/s, optional
            Velocities; from differences of the positions if not given.
        gap : float, s, optional
            Longest step that is bridged; LONGEST_GAP or GAP_STEPS usual steps, whichever is longer, if not given.

        Raises
        ------
        InputError
            There are fewer than two different times with positions.
        """
        time, xyz = np.asarray(time, np.float64), np.asarray(xyz, np.float64)
        near = (np.abs(xyz) <= FARTHEST).all(axis=1)  # False for NaN
        good = np.flatnonzero((np.abs(time) <= LATEST) & near)
        _, first = np.unique(time[good], return_index=True)
        rows = good[first]
        rows = rows[np.diff(time[rows], prepend=-np.inf) >= LEAST_STEP]
        if len(rows) < 2:
            raise InputError(
                f"{len(rows)} usable positions of the sensor; at least two are needed, with different times in seconds "
                f"(up to {LATEST:g}) and coordinates in metres (up to {FARTHEST:g})"
            )
        time, xyz = time[rows], np.ascontiguousarray(xyz[rows])
        step = np.diff(time)
        gap = max(LONGEST_GAP, GAP_STEPS * float(np.median(step))) if gap is None else gap
        velocity = _differentiate(time, xyz, step > gap) if velocity is None else velocity[rows]
        return cls(time, xyz, np.ascontiguousarray(velocity, np.float64), gap)

    def shifted(self, seconds: float) -> Trajectory:
        """The same positions `seconds` later."""
        return replace(self, time=self.time + seconds)

    def between(self, start: float, stop: float, step: float = 0.04) -> Trajectory:
        """The part that covers [start, stop], thinned.

        Parameters
        ----------
        start, stop : float, s
            One position beyond each end is kept.
        step : float, s
            Wanted time between positions.

        Returns
        -------
        Trajectory
        """
        first = max(int(np.searchsorted(self.time, start, side="right")) - 1, 0)
        last = min(int(np.searchsorted(self.time, stop)) + 1, len(self.time))
        first = max(min(first, last - 2), 0)  # two positions at least, also beyond an end of the trajectory
        usual = float(np.median(np.diff(self.time[first:last]))) if last - first > 1 else step
        every = max(1, int(step / usual))
        rows = np.unique(np.r_[np.arange(first, max(last, first + 2), every), max(last, first + 2) - 1])
        return replace(self, time=self.time[rows], xyz=self.xyz[rows], velocity=self.velocity[rows])

    def at(self, time: np.ndarray) -> np.ndarray:
        """Positions at times (n,) by cubic Hermite interpolation, f8 (n, 3); NaN outside and in gaps."""
        time = np.asarray(time, np.float64)
        late = np.clip(np.searchsorted(self.time, time, side="right"), 1, len(self.time) - 1)
        early = late - 1
        step = self.time[late] - self.time[early]
        u = (time - self.time[early]) / step
        known = (u >= 0) & (u <= 1) & (step <= self.gap)
        u = np.where(known, u, np.nan)
        a, b = u * u * (3 - 2 * u), u * (1 - u)
        weights = (1 - a, a, b * (1 - u) * step, -b * u * step)
        values = (self.xyz[early], self.xyz[late], self.velocity[early], self.velocity[late])
        return sum(weight[:, None] * value for weight, value in zip(weights, values, strict=True))

    def gaps(self, start: float, stop: float) -> list[tuple[float, float]]:
        """Parts of [start, stop] without a position, as (from, to) [s]."""
        wide = np.flatnonzero(np.diff(self.time) > self.gap)
        empty = [(-np.inf, float(self.time[0])), *zip(self.time[wide], self.time[wide + 1], strict=True)]
        empty.append((float(self.time[-1]), np.inf))
        cut = [(max(a, start), min(b, stop)) for a, b in empty]
        return [(float(a), float(b)) for a, b in cut if b > a]

    def find_jump(self, start: float, stop: float) -> tuple[float, float] | None:
        """Time [s] and size [m] of the largest jump between two times [s]; None where no position jumps."""
        step = np.diff(self.time)
        before, after = step[:-1], step[1:]
        line = (after[:, None] * self.xyz[:-2] + before[:, None] * self.xyz[2:]) / (before + after)[:, None]
        off = np.sqrt(((self.xyz[1:-1] - line) ** 2).sum(axis=1))
        near = (self.time[2:] >= start) & (self.time[:-2] <= stop) & (np.maximum(before, after) <= self.gap)
        if not near.any():
            return None
        beyond = off - 0.5 * ACCELERATION * before * after - LEAST_JUMP - JUMP_SCATTER * float(median(off[near]))
        worst = int(np.argmax(np.where(near, beyond, -np.inf)))
        return (float(self.time[worst + 1]), float(off[worst])) if beyond[worst] > 0 else None

    def share_known(self, start: float, stop: float) -> float:
        """Share of [start, stop] that has positions, 0 to 1."""
        length = max(stop - start, 1e-9)
        return 1.0 - sum(b - a for a, b in self.gaps(start, stop)) / length


def _differentiate(time: np.ndarray, xyz: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Velocities from the neighbours, weighted so that they are exact for constant acceleration; not across gaps."""
    slope = np.diff(xyz, axis=0) / np.diff(time)[:, None]
    step = np.where(broken, np.inf, np.diff(time))
    before, after = np.r_[np.inf, step], np.r_[step, np.inf]
    share = 1.0 / before + 1.0 / after
    weight = np.where(share > 0, (1.0 / before) / np.where(share > 0, share, 1.0), 0.0)
    padded = np.concatenate([slope[:1], slope, slope[-1:]])
    velocity = padded[:-1] * weight[:, None] + padded[1:] * (1.0 - weight)[:, None]
    velocity[share == 0] = 0.0
    return velocity


def solve_offset(known: Trajectory, start: float, stop: float) -> tuple[float, str]:
    """Seconds to add to the trajectory's times so that it covers the strip, and which clocks the two use.

    Tries standard GPS time, adjusted standard GPS time (1e9 s less) and seconds of the week; takes what covers most.

    Parameters
    ----------
    known : Trajectory
        Positions with the times of their file.
    start, stop : float, s
        First and last time of the strip.

    Returns
    -------
    (float, str)
        The offset [s], and a few words for the report.

    Raises
    ------
    InputError
        No pair of clocks makes them overlap.
    """
    middle, half = 0.5 * (start + stop), 0.5 * (float(known.time[-1]) + float(known.time[0]))
    candidates = [(0.0, "the same clock")]
    candidates += [(-ADJUSTED, "standard to adjusted GPS time"), (ADJUSTED, "adjusted to standard GPS time")]
    in_weeks: list[tuple[float, str]] = []
    if -WEEK < known.time[0] < 2 * WEEK:
        in_weeks += [(0.0, "seconds of the week to standard GPS time")]
        in_weeks += [(-ADJUSTED, "seconds of the week to adjusted GPS time")]
    if 0 <= start <= WEEK < known.time[0]:
        in_weeks += [(shift, "GPS time to seconds of the week") for shift in (0.0, ADJUSTED)]
    for shift, clocks in in_weeks:  # each plus a whole number of weeks
        week = np.rint((middle - half - shift) / WEEK)
        candidates += [(float(shift + (week + k) * WEEK), clocks) for k in (-1, 0, 1)]
    best, least = (0.0, ""), 0.0
    for offset, clocks in candidates:
        share = known.shifted(offset).share_known(start, stop)
        if share > least + 1e-6:
            best, least = (offset, clocks), share
    if least <= 0:
        raise InputError(
            f"the trajectory runs from {known.time[0]:.3f} to {known.time[-1]:.3f} s, the strip from {start:.3f} to "
            f"{stop:.3f} s: they do not overlap on any clock (same, adjusted, seconds of the week)"
        )
    return best


def apply_lever_arm(xyz: np.ndarray, attitude: np.ndarray, arm: tuple[float, float, float]) -> np.ndarray:
    """Positions of the scanner from positions of the trajectory.

    Parameters
    ----------
    xyz : float64 (n, 3), m
        Positions of the trajectory: east, north, up.
    attitude : float64 (n, 3), rad
        Roll, pitch, heading; heading clockwise from north.
    arm : three floats, m
        From the trajectory's point to the scanner: forward, right, down.

    Returns
    -------
    float64 (n, 3), m
        Positions of the scanner.
    """
    roll, pitch, heading = np.where(np.isfinite(attitude), attitude, np.nan).T
    forward, right, down = arm
    # Body to level: roll about the forward axis, then pitch about the right one.
    side = right * np.cos(roll) - down * np.sin(roll)
    under = right * np.sin(roll) + down * np.cos(roll)
    ahead = forward * np.cos(pitch) + under * np.sin(pitch)
    lower = under * np.cos(pitch) - forward * np.sin(pitch)
    north = ahead * np.cos(heading) - side * np.sin(heading)
    east = ahead * np.sin(heading) + side * np.cos(heading)
    return xyz + np.stack([east, north, -lower], axis=1)
