"""Two clouds of one strip, or a cloud and the truth: which echoes both have, and how far apart they are."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from wavebatch.blocks import EchoFlag
from wavebatch.differences import SPEED, Differences, Spread
from wavebatch.errors import ConfigError
from wavebatch.evaluate import ErrorStats, list_pairs, pair_nearest
from wavebatch.io.buckets import Buckets
from wavebatch.io.cloud import CLOUD_DTYPE, CloudReader
from wavebatch.simulate.truth import TruthReader
from wavebatch.units import FWHM_PER_SIGMA

PASSED_THROUGH = np.uint16(EchoFlag.NO_WAVEFORM | EchoFlag.BROKEN_PACKET | EchoFlag.NO_ECHO)
"""Points with one of these flags are not echoes that somebody found."""

BUCKET_POINTS = 400_000
"""Points of a cloud that are held at a time, as long as MOST_BUCKETS are enough."""

MOST_BUCKETS = 72
"""Every bucket is an open file for each side: systems allow 256 at least."""

_MOST_PER_PULSE = 32
"""More points per GPS time than this, on average, and it does not tell pulses apart."""

_TRUTH_DTYPE = np.dtype([*((name, CLOUD_DTYPE[name]) for name in CLOUD_DTYPE.names), ("isolated", "?")])
_PACKET_DTYPE = np.dtype([("gps_time", "<f8")])


@dataclass(frozen=True, slots=True)
class Comparison:
    """What cloud a has in common with b (another cloud, or the truth). Shares are NaN where nothing is to be shared."""

    a: str
    b: str
    matched_by: str
    """`gps_time`: within pulses of equal time; `position`: nearest neighbours of each other."""
    tolerance_ns: float
    pulses: int
    """Pulses of either (of the truth: its packets); 0 when matched by position."""
    echoes_a: int
    echoes_b: int
    matched: int
    missed: int
    """Echoes of b that a lacks."""
    extra: int
    """Echoes of a that b lacks."""
    completeness: float
    """Share of b's echoes that a has."""
    correctness: float
    """Share of a's echoes that b has."""
    exact_count: float
    """Share of the pulses with as many echoes in a as in b."""
    counts_a: dict[int, int]
    """Pulses by number of echoes in a; those with none are known from b."""
    counts_b: dict[int, int]
    differences: dict[str, Spread]
    """time along the ray [ns, later is positive]; echo_time [ns], amplitude [DN], echo_width [ns] if both have it."""
    errors: dict[str, dict[str, ErrorStats]] = field(default_factory=dict)
    """Against truth only: per class (all, isolated, overlapped) and quantity, with error / bound and calibration.

    `time` is the error of the position; `echo_time`, where the cloud has it, that of the fit alone.
    Medians and errors of more than a million pairs are those of an even sample."""

    def to_dict(self) -> dict:
        """Plain numbers, lists and dictionaries for JSON."""
        return asdict(self)


def compare_clouds(a: Path, b: Path, *, tolerance_ns: float = 1.0) -> Comparison:
    """Echoes of two clouds of one strip; b may be the strip itself, whose points are the vendor's returns.

    Echoes of a pulse (equal GPS time) at most `tolerance_ns` apart along the ray are identical, one to one, nearest
    first. Where GPS times cannot tell pulses apart, points that are nearest neighbours of each other are.
    Points passed through without an echo do not count. Memory is bounded; large clouds need room in TMPDIR.
    Raises InputError for a file that cannot be read, ConfigError for a wrong tolerance.
    """
    with CloudReader(a) as first, CloudReader(b) as second:
        by_time = _can_group(first) and _can_group(second) and _share_times(first, second)
        task = _Task(by_time, _check(tolerance_ns), max(first.point_count, second.point_count))
        if not by_time:
            task.place_borders(first)
        for reader, side in ((first, 0), (second, 1)):
            for rows in reader.read_pieces():
                task.add(side, rows[(rows["flags"] & PASSED_THROUGH) == 0])
        return task.finish(str(a), str(b))


def compare_truth(a: Path, truth: Path, *, tolerance_ns: float = 1.5) -> Comparison:
    """Echoes of a cloud against the truth of the simulated strip it was made from; errors and tolerance as in
    compare_clouds."""
    with CloudReader(a) as cloud, TruthReader(truth) as reference:
        task = _Task(
            True, _check(tolerance_ns), max(cloud.point_count, reference.meta.get("packets", 0)), reference.meta
        )
        for rows in cloud.read_pieces():
            task.add(0, rows[(rows["flags"] & PASSED_THROUGH) == 0])
        names = ("gps_time", "x", "y", "z", "time", "amplitude", "sigma", "flags", "isolated")
        for piece in reference.read_pieces(*names):
            task.add(1, _shape_truth(piece))
        for piece in reference.read_pieces("packet_gps_time"):
            task.add(2, piece["packet_gps_time"].view(_PACKET_DTYPE))
        return task.finish(str(a), str(truth))


def _check(tolerance_ns: float) -> float:
    if not 0 < tolerance_ns < 1e6:
        raise ConfigError(f"tolerance {tolerance_ns} ns must be above 0")
    return tolerance_ns


def _can_group(reader: CloudReader) -> bool:
    """Whether the first points' GPS times tell pulses apart."""
    if not reader.has_gps_time:
        return False
    rows = next(reader.read_pieces(), None)
    return rows is None or not len(rows) or len(np.unique(rows["gps_time"])) * _MOST_PER_PULSE >= len(rows)


def _share_times(first: CloudReader, second: CloudReader) -> bool:
    """Whether any pulse of the shorter cloud's beginning is in the other one."""
    short, long = sorted((first, second), key=lambda reader: reader.point_count)
    rows = next(short.read_pieces(), np.empty(0, CLOUD_DTYPE))
    times = np.unique(rows["gps_time"])
    return not len(rows) or any(np.isin(piece["gps_time"], times).any() for piece in long.read_pieces())


def _shape_truth(piece: dict[str, np.ndarray]) -> np.ndarray:
    rows = np.zeros(len(piece["gps_time"]), _TRUTH_DTYPE)
    for axis, name in enumerate("xyz"):
        rows["xyz"][:, axis] = piece[name]
    for name in ("gps_time", "amplitude", "flags", "isolated"):
        rows[name] = piece[name]
    rows["echo_time"] = piece["time"]
    rows["echo_width"] = piece["sigma"] * FWHM_PER_SIGMA
    return rows


class _Task:
    """One comparison: rows of a, b (and of the truth's packets) in buckets, then bucket by bucket."""

    def __init__(self, by_time: bool, tolerance_ns: float, points: int, meta: dict | None = None) -> None:
        self.by_time, self.tolerance, self.tolerance_ns = by_time, tolerance_ns * SPEED, tolerance_ns
        self.meta = meta
        self.number = min(-(-max(points, 1) // BUCKET_POINTS), MOST_BUCKETS)
        dtypes = (CLOUD_DTYPE, _TRUTH_DTYPE if meta else CLOUD_DTYPE, _PACKET_DTYPE)
        self.buckets = [Buckets(dtype, self.number) for dtype in dtypes]
        self.borders = np.empty(0)
        self.pulses = self.exact = self.matched = 0
        self.echoes = [0, 0]
        self.counts = [np.zeros(1, np.int64), np.zeros(1, np.int64)]
        self.differences = Differences()

    def place_borders(self, reader: CloudReader) -> None:
        """Borders along x of slabs with about the same number of points."""
        if self.number > 1:
            some = np.concatenate([rows["xyz"][::100, 0] for rows in reader.read_pieces()])
            self.borders = np.quantile(some, np.arange(1, self.number) / self.number)

    def add(self, side: int, rows: np.ndarray) -> None:
        """Takes in rows of a (side 0), b (1) or the truth's packets (2)."""
        self.buckets[side].add(rows, self._sort_by_time if self.by_time else self._sort_by_place)

    def _sort_by_time(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bits = np.ascontiguousarray(rows["gps_time"]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        return np.arange(len(rows)), ((bits >> np.uint64(40)) % np.uint64(self.number)).astype(np.int64)

    def _sort_by_place(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The slab of every point, and the neighbouring ones that it is close to."""
        index, bucket = [], []
        low = np.searchsorted(self.borders, rows["xyz"][:, 0] - 2 * self.tolerance)
        high = np.searchsorted(self.borders, rows["xyz"][:, 0] + 2 * self.tolerance)
        for step in range(int((high - low).max(initial=0)) + 1):
            inside = np.flatnonzero(low + step <= high)
            index.append(inside)
            bucket.append(low[inside] + step)
        return np.concatenate(index), np.concatenate(bucket)

    def finish(self, name_a: str, name_b: str) -> Comparison:
        """Compares bucket by bucket and sums up."""
        for number in range(self.number):
            a, b, packets = (bucket.read(number) for bucket in self.buckets)
            if self.by_time:
                self._compare_by_time(a, b, packets)
            else:
                self._compare_by_place(a, b, number)
        for bucket in self.buckets:
            bucket.close()
        a, b = self.echoes
        return Comparison(
            a=name_a,
            b=name_b,
            matched_by="gps_time" if self.by_time else "position",
            tolerance_ns=self.tolerance_ns,
            pulses=self.pulses,
            echoes_a=a,
            echoes_b=b,
            matched=self.matched,
            missed=b - self.matched,
            extra=a - self.matched,
            completeness=self.matched / b if b else float("nan"),
            correctness=self.matched / a if a else float("nan"),
            exact_count=self.exact / self.pulses if self.pulses else float("nan"),
            counts_a=_list_counts(self.counts[0]),
            counts_b=_list_counts(self.counts[1]),
            differences=self.differences.spreads(),
            errors=self.differences.errors(self.meta) if self.meta else {},
        )

    def _compare_by_time(self, a: np.ndarray, b: np.ndarray, packets: np.ndarray) -> None:
        times = np.concatenate([a["gps_time"], b["gps_time"], packets["gps_time"]])
        known, group = np.unique(times, return_inverse=True)
        in_a, in_b = group[: len(a)], group[len(a) : len(a) + len(b)]
        number_a, number_b = (np.bincount(g, minlength=len(known)) for g in (in_a, in_b))
        counted = slice(None)
        if self.meta:
            counted = np.unique(group[len(a) + len(b) :])
        self.pulses += len(number_a[counted])
        self.exact += int((number_a[counted] == number_b[counted]).sum())
        self.counts = [_add_counts(old, n[counted]) for old, n in zip(self.counts, (number_a, number_b), strict=True)]
        # Heights differ by less than distances along the ray do: a cheap first choice of pairs.
        left, right = list_pairs(in_a, a["xyz"][:, 2], in_b, b["xyz"][:, 2], self.tolerance)
        distance = np.linalg.norm(a["xyz"][left] - b["xyz"][right], axis=1)
        near = np.flatnonzero(distance <= self.tolerance)
        left, right, distance = left[near], right[near], distance[near]
        kept = pair_nearest(left, right, distance, len(a), len(b))
        self._count(len(a), len(b), a[left[kept]], b[right[kept]])

    def _compare_by_place(self, a: np.ndarray, b: np.ndarray, number: int) -> None:
        own = [np.searchsorted(self.borders, rows["xyz"][:, 0]) == number for rows in (a, b)]
        none = np.empty(0, np.int64)
        left = right = none
        if len(a) and len(b):
            to_b, nearest_b = cKDTree(b["xyz"]).query(a["xyz"], distance_upper_bound=self.tolerance)
            _, nearest_a = cKDTree(a["xyz"]).query(b["xyz"], distance_upper_bound=self.tolerance)
            left = np.flatnonzero(np.isfinite(to_b) & own[0])
            right = nearest_b[left]
            mutual = nearest_a[right] == left
            left, right = left[mutual], right[mutual]
        self._count(int(own[0].sum()), int(own[1].sum()), a[left], b[right])

    def _count(self, echoes_a: int, echoes_b: int, a: np.ndarray, b: np.ndarray) -> None:
        self.echoes[0] += echoes_a
        self.echoes[1] += echoes_b
        self.matched += len(a)
        self.differences.add(a, b)


def _add_counts(old: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    new = np.bincount(numbers, minlength=len(old))
    new[: len(old)] += old
    return new


def _list_counts(counts: np.ndarray) -> dict[int, int]:
    return {number: int(pulses) for number, pulses in enumerate(counts) if pulses}
