"""Comparison of two clouds of one strip, or of a cloud and the truth of a simulation.

`wavebatch compare` calls `compare_clouds` and `compare_truth`; `chains` uses `CloudTask` for a chain and a cloud. Rows
go to buckets on disk (by GPS time, or by x if times do not separate pulses), then bucket by bucket to `Pairing`, so
that memory does not grow with the clouds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import PASSED_THROUGH
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.files.cloud.cloud_reader import CLOUD_DTYPE, CloudReader
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.disk.temp_store import Spool, count_buckets, spread_times
from wavebatch.tools.compare.pairing import Comparison, Pairing, check_tolerance
from wavebatch.tools.return_stats import pulses_told_apart
from wavebatch.tools.simulate.truth import TruthReader

_TRUTH_DTYPE = np.dtype([*((name, CLOUD_DTYPE[name]) for name in CLOUD_DTYPE.names), ("isolated", "?")])
LEAST_SHARED = 0.05
"""Share of the pulses that two clouds of one strip have in common at least; else echoes are matched by position."""

PACKET_DTYPE = np.dtype([("gps_time", "<f8")])
"""A pulse that counts even if neither side has an echo in it."""


def compare_clouds(a: Path, b: Path, *, tolerance_ns: float = 1.0, chosen: PointFilter = EVERY) -> Comparison:
    """Compares the echoes of two clouds of one strip; b may be the strip itself, with the vendor's returns.

    Echoes of a pulse (equal GPS time) are the same if they are at most `tolerance_ns` apart along the ray, one to one,
    nearest first. If GPS times do not separate pulses, mutual nearest neighbours are the same. Points passed through
    without an echo are ignored. chosen: only these points are compared, in both clouds. Memory is bounded; large
    clouds need room in TMPDIR.
    Raises InputError for a file that cannot be read, ConfigError for a wrong tolerance, an unknown column, or
    coordinates without a length.
    """
    with CloudReader(a) as first, CloudReader(b) as second, open_task(first, second, tolerance_ns) as task:
        for reader, side in ((first, 0), (second, 1)):
            reader.select(chosen)
            for rows in read_echoes(reader):
                task.add(side, rows)
        found = task.finish(str(a), str(b))
    return replace(found, left_out_a=first.left_out, left_out_b=second.left_out)


def open_task(first: CloudReader, second: CloudReader, tolerance_ns: float) -> CloudTask:
    """A comparison by GPS time if both clouds have times that separate pulses and share some, else by position."""
    by_time = pulses_told_apart(first) and pulses_told_apart(second) and _share_times(first, second)
    for reader in (first, second):
        reader.measure_in_metres()
    task = CloudTask(by_time, check_tolerance(tolerance_ns), max(first.point_count, second.point_count))
    if not by_time and task.number > 1:
        # Borders along x, so that all buckets have about the same number of points.
        some = np.concatenate([rows["xyz"][::100, 0] for rows in first.read_pieces()])
        task.borders = np.quantile(some, np.arange(1, task.number) / task.number)
    return task


def read_echoes(reader: CloudReader) -> Iterator[np.ndarray]:
    """Pieces of a cloud, without the points that were passed through."""
    for rows in reader.read_pieces():
        yield rows[(rows["flags"] & np.uint16(PASSED_THROUGH)) == 0]


def compare_truth(a: Path, truth: Path, *, tolerance_ns: float = 1.5, chosen: PointFilter = EVERY) -> Comparison:
    """Compares the echoes of a cloud with the truth of its simulated strip; raises as compare_clouds does.

    chosen: only these points of the cloud; the truth is whole, so that true echoes of other points are missed.
    """
    with CloudReader(a) as cloud, TruthReader(truth) as reference:
        cloud.select(chosen)
        points = max(cloud.point_count, reference.meta.get("packets", 0))
        names = ("gps_time", "x", "y", "z", "time", "amplitude", "sigma", "flags", "isolated")
        with CloudTask(True, check_tolerance(tolerance_ns), points, reference.meta) as task:
            for rows in read_echoes(cloud):
                task.add(0, rows)
            for piece in reference.read_pieces(*names):
                rows = np.zeros(len(piece["gps_time"]), _TRUTH_DTYPE)
                rows["xyz"] = np.stack([piece[name] for name in "xyz"], axis=1)
                for name in ("gps_time", "amplitude", "flags", "isolated"):
                    rows[name] = piece[name]
                rows["echo_time"], rows["echo_width"] = piece["time"], piece["sigma"] * FWHM_PER_SIGMA
                task.add(1, rows)
            for piece in reference.read_pieces("packet_gps_time"):
                task.add(2, piece["packet_gps_time"].view(PACKET_DTYPE))
            return replace(task.finish(str(a), str(truth)), left_out_a=cloud.left_out)


def _share_times(first: CloudReader, second: CloudReader) -> bool:
    """Whether enough pulses of the first piece of the shorter cloud are in the other cloud.

    Formats round times differently: those of one flight in two formats are equal by chance only.
    """
    short, long = sorted((first, second), key=lambda reader: reader.point_count)
    rows = next(short.read_pieces(), np.empty(0, CLOUD_DTYPE))
    times = np.unique(rows["gps_time"])
    found = np.zeros(len(times), bool)
    for piece in long.read_pieces():
        found |= np.isin(times, piece["gps_time"])
        if found.mean() > LEAST_SHARED:
            return True
    return not len(rows)


class CloudTask(Closing):
    """One comparison: `add` puts rows of both sides into buckets, `finish` compares bucket by bucket.

    A context manager, because temporary files hold the rows.
    """

    def __init__(self, by_time: bool, tolerance_ns: float, points: int, meta: dict | None = None) -> None:
        self.by_time, self.pairing = by_time, Pairing(tolerance_ns, meta)
        self.number = count_buckets(points)
        dtypes = (CLOUD_DTYPE, _TRUTH_DTYPE if meta else CLOUD_DTYPE, PACKET_DTYPE)
        self.buckets = [Spool(self.number, dtype) for dtype in dtypes]
        self.borders = np.empty(0)

    def close(self) -> None:
        """Removes the temporary files."""
        for bucket in self.buckets:
            bucket.close()

    def add(self, side: int, rows: np.ndarray) -> None:
        """Adds rows of a (side 0), of b (1) or of the truth's packets (2)."""
        if self.by_time:
            self.buckets[side].append(spread_times(rows["gps_time"], self.number), rows)
        else:
            index, bucket = self._sort_by_place(rows)
            self.buckets[side].append(bucket, rows[index])

    def _sort_by_place(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The slab of each point, and the neighbouring slabs that it is close to."""
        index, bucket = [], []
        low = np.searchsorted(self.borders, rows["xyz"][:, 0] - 2 * self.pairing.tolerance)
        high = np.searchsorted(self.borders, rows["xyz"][:, 0] + 2 * self.pairing.tolerance)
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
                self.pairing.pair_by_time(a, b, packets)
            else:
                inside = (np.searchsorted(self.borders, rows["xyz"][:, 0]) == number for rows in (a, b))
                self.pairing.pair_by_place(a, b, *inside)
        return self.pairing.finish(name_a, name_b, "gps_time" if self.by_time else "position")
