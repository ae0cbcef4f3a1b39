"""Where the sensor was at any time: positions over time, interpolated where they are dense enough, NaN elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from wavebatch.core.errors import InputError

WEEK = 604_800.0
"""Seconds of a GPS week."""

ADJUSTED = 1e9
"""What LAS takes off standard GPS time [s]."""

LONGEST_GAP = 1.0
"""Time between two positions that is always bridged [s]."""

GAP_STEPS = 5.0
"""Usual steps between positions that are bridged too."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Positions of the sensor over time; picklable."""

    time: np.ndarray
    """Ascending, as in the strip [s], f8 (k,)."""
    xyz: np.ndarray
    """f8 (k, 3) [m]."""
    velocity: np.ndarray
    """f8 (k, 3) [m/s]."""
    gap: float
    """Steps longer than this are not bridged [s]."""

    @classmethod
    def build(
        cls, time: np.ndarray, xyz: np.ndarray, velocity: np.ndarray | None = None, gap: float | None = None
    ) -> Trajectory:
        """A trajectory from positions in any order; velocities by differences where they are not given.

        Raises InputError where there are fewer than two different times with positions.
        """
        time, xyz = np.asarray(time, np.float64), np.asarray(xyz, np.float64)
        good = np.flatnonzero(np.isfinite(time) & np.isfinite(xyz).all(axis=1))
        _, first = np.unique(time[good], return_index=True)
        rows = good[first]
        if len(rows) < 2:
            raise InputError(f"{len(rows)} usable positions of the sensor; at least two are needed")
        time, xyz = time[rows], np.ascontiguousarray(xyz[rows])
        step = np.diff(time)
        gap = max(LONGEST_GAP, GAP_STEPS * float(np.median(step))) if gap is None else gap
        velocity = _differentiate(time, xyz, step > gap) if velocity is None else velocity[rows]
        return cls(time, xyz, np.ascontiguousarray(velocity, np.float64), gap)

    def shifted(self, seconds: float) -> Trajectory:
        """The same positions `seconds` later."""
        return replace(self, time=self.time + seconds)

    def between(self, start: float, stop: float, step: float = 0.04) -> Trajectory:
        """The part within [start, stop] and one position beyond either end, no denser than about `step` [s]."""
        first = max(int(np.searchsorted(self.time, start, side="right")) - 1, 0)
        last = min(int(np.searchsorted(self.time, stop)) + 1, len(self.time))
        first = max(min(first, last - 2), 0)
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
        rise = (b * (1 - u) * step, -b * u * step)
        parts = (1 - a, self.xyz[early]), (a, self.xyz[late]), (rise[0], self.velocity[early]), (
            rise[1], self.velocity[late])  # fmt: skip
        return sum(weight[:, None] * values for weight, values in parts)

    def gaps(self, start: float, stop: float) -> list[tuple[float, float]]:
        """Stretches of [start, stop] without a position, as (from, to) [s]."""
        wide = np.flatnonzero(np.diff(self.time) > self.gap)
        empty = [(-np.inf, float(self.time[0])), *zip(self.time[wide], self.time[wide + 1], strict=True)]
        empty.append((float(self.time[-1]), np.inf))
        cut = [(max(a, start), min(b, stop)) for a, b in empty]
        return [(float(a), float(b)) for a, b in cut if b > a]

    def share_known(self, start: float, stop: float) -> float:
        """Share of [start, stop] that has positions."""
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
    """Seconds to add to the trajectory's times so that it covers the strip's [start, stop], and which clocks they are.

    Standard GPS time, the same less 1e9 (adjusted), and seconds of the week are told apart by what overlaps.
    Raises InputError where nothing does.
    """
    middle, half = 0.5 * (start + stop), 0.5 * (float(known.time[-1]) + float(known.time[0]))
    candidates = [(0.0, "the same clock")]
    candidates += [(-ADJUSTED, "standard to adjusted GPS time"), (ADJUSTED, "adjusted to standard GPS time")]
    if -WEEK < known.time[0] < 2 * WEEK:
        for shift, clock in ((0.0, "standard"), (-ADJUSTED, "adjusted")):
            said = f"seconds of the week to {clock} GPS time"
            candidates += [(offset, said) for offset in _whole_weeks(shift, middle - half)]
    if 0 <= start <= WEEK < known.time[0]:
        for shift in (0.0, ADJUSTED):
            candidates += [(offset, "GPS time to seconds of the week") for offset in _whole_weeks(shift, middle - half)]
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


def _whole_weeks(shift: float, wanted: float) -> list[float]:
    """Offsets near the wanted one that are `shift` and a whole number of weeks."""
    week = np.rint((wanted - shift) / WEEK)
    return [float(shift + (week + k) * WEEK) for k in (-1, 0, 1)]


def apply_lever_arm(xyz: np.ndarray, attitude: np.ndarray, arm: tuple[float, float, float]) -> np.ndarray:
    """Positions of the scanner (n, 3) from those of the trajectory.

    attitude: roll, pitch, heading [rad] (n, 3), heading clockwise from north; arm: forward, right, down [m].
    """
    roll, pitch, heading = attitude.T
    forward, right, down = arm
    # Body to level: roll about the forward axis, then pitch about the right one.
    side = right * np.cos(roll) - down * np.sin(roll)
    under = right * np.sin(roll) + down * np.cos(roll)
    ahead = forward * np.cos(pitch) + under * np.sin(pitch)
    lower = under * np.cos(pitch) - forward * np.sin(pitch)
    north = ahead * np.cos(heading) - side * np.sin(heading)
    east = ahead * np.sin(heading) + side * np.cos(heading)
    return xyz + np.stack([east, north, -lower], axis=1)
