"""The points of any LAS or LAZ file as laspy presents them, read by wavebatch's own readers, which trust no byte."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from laspy.point.dims import DimensionInfo, DimensionKind

from wavebatch.files.las.checked_header import CheckedHeader, read_checked_header
from wavebatch.files.las.extra_bytes import ExtraRecord
from wavebatch.files.las.header import STANDARD_DTYPES
from wavebatch.files.las.read_points import open_points


@dataclass(frozen=True, slots=True)
class CloudHeader:
    """What a cloud's header says, under laspy's names."""

    point_format: laspy.PointFormat
    point_count: int
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]


class CloudPoints:
    """Reads the points of the LAS or LAZ file at `path` by their index; packets and extended records are not touched.

    Raises InputError where the file is damaged or coded as nobody here can read it.
    """

    def __init__(self, path: Path) -> None:
        checked = read_checked_header(path, waveforms=False)
        header = checked.header
        self.header = CloudHeader(_describe(checked), header.point_count, header.scales, header.offsets)
        self._source = open_points(checked)

    def read(self, start: int, stop: int) -> laspy.ScaleAwarePointRecord:
        """Points [start, stop)."""
        header = self.header
        raw = self._source.read(start, stop)
        return laspy.ScaleAwarePointRecord(raw, header.point_format, header.scales, header.offsets)

    def close(self) -> None:
        """Ends the reading; harmless twice."""
        self._source.close()


def _describe(checked: CheckedHeader) -> laspy.PointFormat:
    """The point format with the extra dimensions that the checked records tell of, named as the fields are."""
    point_format = laspy.PointFormat(checked.header.point_format)
    fields = checked.dtype.names[len(STANDARD_DTYPES[checked.header.point_format].names) :]
    for field, record in zip(fields, checked.records, strict=True):
        point_format.dimensions.append(_describe_dimension(field, record))
    return point_format


def _describe_dimension(field: str, record: ExtraRecord) -> DimensionInfo:
    dtype, scaling = record.dtype, record.scaling
    return DimensionInfo(
        field,
        DimensionKind.from_letter(dtype.base.kind),
        8 * dtype.itemsize,
        dtype.shape[0] if dtype.shape else 1,
        is_standard=False,
        description=record.description,
        scales=None if scaling is None else np.array(scaling[:1]),
        offsets=None if scaling is None else np.array(scaling[1:]),
        no_data=record.no_data,
    )
