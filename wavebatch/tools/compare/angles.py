"""Agreement of incidence angles from echo widths with those from surface normals.

`wavebatch compare --angles` calls `compare_angles`, which reads one or two clouds and sums differences and histograms
as in Fig. 6 of Rhomberg-Kauert et al. 2024. Sums are kept per piece, so that memory is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.cloud.echo_reader import CloudReader
from wavebatch.files.disk.buckets import count_buckets, spread_times
from wavebatch.files.disk.spool import Spool
from wavebatch.tools.compare.differences import SPEED
from wavebatch.tools.compare.pairing import check_tolerance, pair_echoes

WIDTHS, NORMALS = "incidence_angle", "incidence_angle_normals"
_COLUMNS = (WIDTHS, f"{WIDTHS}_err", NORMALS, f"{NORMALS}_err")
ANGLE_DTYPE = np.dtype([("gps_time", "<f8"), ("xyz", "<f8", 3), *((name, "<f8") for name in _COLUMNS)])
"""What is read of clouds: angles and their errors [deg]."""

BIN, DIFFERENCE_BIN = 5.0, 2.0
"""Bin widths of the histograms [deg]: of angles, and of their differences."""

_FINE = 1000
"""Bins per degree for the median of absolute differences, which is exact to 0.001 deg."""


@dataclass(frozen=True, slots=True)
class AngleAgreement:
    """Angles from widths less those from normals [deg], of the points that have both; NaN if there are none."""

    a: str
    b: str | None
    """The second cloud; None if one cloud has both angles."""
    points: int
    """All points; for two clouds, the matched points."""
    with_widths: int
    with_normals: int
    number: int
    """Points with both angles."""
    bias: float
    """Mean difference."""
    mae: float
    """Mean absolute difference."""
    median_absolute: float
    """Median absolute difference, to 0.001 deg."""
    rms: float
    within_error: float
    """Share of the points whose difference is at most one standard deviation of the difference."""
    edges: tuple[float, ...]
    """Bin edges of both histograms of angles [deg]."""
    histogram_widths: tuple[int, ...]
    """Points per bin, of the points with both angles."""
    histogram_normals: tuple[int, ...]
    difference_edges: tuple[float, ...]
    histogram_difference: tuple[int, ...]


def compare_angles(a: Path, b: Path | None = None, *, tolerance_ns: float = 1.0) -> AngleAgreement:
    """Compares both kinds of angle of one cloud, or one kind of `a` with the other kind of `b`.

    Echoes of two clouds are the same if they have the same GPS time and are at most `tolerance_ns` apart, nearest
    first. Memory is bounded; large pairs of clouds need room in TMPDIR.
    Raises InputError if a file cannot be read or lacks a column, ConfigError for a wrong tolerance.
    """
    check_tolerance(tolerance_ns)
    tally = _Tally()
    if b is None:
        with CloudReader(a, ANGLE_DTYPE) as cloud:
            _demand(cloud, WIDTHS, NORMALS)
            for rows in cloud.read_pieces():
                tally.add(rows, rows)
        return tally.finish(str(a), None)
    with CloudReader(a, ANGLE_DTYPE) as first, CloudReader(b, ANGLE_DTYPE) as second:
        turned = WIDTHS not in first.columns or NORMALS not in second.columns
        widths, normals = (second, first) if turned else (first, second)
        _demand(widths, WIDTHS)
        _demand(normals, NORMALS)
        _pair(widths, normals, tolerance_ns * SPEED, tally)
    return tally.finish(str(a), str(b))


def _demand(cloud: CloudReader, *columns: str) -> None:
    missing = [name for name in columns if name not in cloud.columns]
    if missing:
        stages = " and ".join(f"attribute.{name}" for name in missing)
        raise InputError(f"{cloud.path}: has no column {' nor '.join(missing)}; run the strip with stage {stages}")


def _pair(widths: CloudReader, normals: CloudReader, reach: float, tally: _Tally) -> None:
    """Adds the echoes that both clouds have; pulses are sorted into buckets, so that memory is bounded."""
    for cloud in (widths, normals):
        if not cloud.has_gps_time:
            raise InputError(f"{cloud.path}: has no GPS times to match echoes of two clouds; write both to one cloud")
    number = count_buckets(max(widths.point_count, normals.point_count))
    with Spool(number, ANGLE_DTYPE) as first, Spool(number, ANGLE_DTYPE) as second:
        for cloud, buckets in ((widths, first), (normals, second)):
            for rows in cloud.read_pieces():
                finite = np.isfinite(rows["gps_time"]) & np.isfinite(rows["xyz"]).all(axis=1)
                buckets.append(spread_times(rows["gps_time"][finite], number), rows[finite])
        for bucket in range(number):
            a, b = first.read(bucket), second.read(bucket)
            pulse = np.unique(np.concatenate([a["gps_time"], b["gps_time"]]), return_inverse=True)[1]
            left, right = pair_echoes(pulse[: len(a)], a["xyz"], pulse[len(a) :], b["xyz"], reach)
            tally.add(a[left], b[right])


class _Tally:
    """Sums and histograms of pieces; the median comes from counts, so that the order of the points does not matter."""

    def __init__(self) -> None:
        self.points = self.widths = self.normals = self.number = self.within = self.errors = 0
        self.sums = np.zeros(3)
        self.fine = np.zeros(90 * _FINE + 1, np.int64)
        self.angles = np.zeros((2, round(90 / BIN)), np.int64)
        self.differences = np.zeros(round(180 / DIFFERENCE_BIN), np.int64)

    def add(self, widths: np.ndarray, normals: np.ndarray) -> None:
        """Adds points (n,), ANGLE_DTYPE: the angle from width of the first, the angle from normals of the second."""
        a, b = widths[WIDTHS], normals[NORMALS]
        valid = [(values >= 0) & (values <= 90) for values in (a, b)]
        both = np.flatnonzero(valid[0] & valid[1])
        self.points += len(a)
        self.widths += int(valid[0].sum())
        self.normals += int(valid[1].sum())
        self.number += len(both)
        a, b = a[both], b[both]
        off = a - b
        self.sums += [off.sum(), np.abs(off).sum(), np.square(off).sum()]
        self.fine += np.bincount(np.rint(np.abs(off) * _FINE).astype(np.int64), minlength=len(self.fine))
        for side, values in enumerate((a, b)):
            self.angles[side] += _bins(values / BIN, self.angles.shape[1])
        self.differences += _bins((off + 90.0) / DIFFERENCE_BIN, len(self.differences))
        error = np.hypot(widths[f"{WIDTHS}_err"][both], normals[f"{NORMALS}_err"][both])
        self.errors += int(np.isfinite(error).sum())
        self.within += int((np.abs(off) <= error).sum())

    def finish(self, a: str, b: str | None) -> AngleAgreement:
        """The figures."""
        bias, mae, square = self.sums / self.number if self.number else np.full(3, np.nan)
        middle = np.searchsorted(np.cumsum(self.fine), 0.5 * self.number) / _FINE if self.number else np.nan
        return AngleAgreement(
            a=a,
            b=b,
            points=self.points,
            with_widths=self.widths,
            with_normals=self.normals,
            number=self.number,
            bias=float(bias),
            mae=float(mae),
            median_absolute=float(middle),
            rms=float(np.sqrt(square)),
            within_error=self.within / self.errors if self.errors else float("nan"),
            edges=tuple((BIN * np.arange(self.angles.shape[1] + 1)).tolist()),
            histogram_widths=tuple(self.angles[0].tolist()),
            histogram_normals=tuple(self.angles[1].tolist()),
            difference_edges=tuple((DIFFERENCE_BIN * np.arange(len(self.differences) + 1) - 90.0).tolist()),
            histogram_difference=tuple(self.differences.tolist()),
        )


def _bins(place: np.ndarray, number: int) -> np.ndarray:
    return np.bincount(np.clip(place.astype(np.int64), 0, number - 1), minlength=number)
