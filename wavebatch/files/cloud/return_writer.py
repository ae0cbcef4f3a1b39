"""Discrete returns written to a file without packets: `wavebatch simulate` does so."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wavebatch.core.errors import ConfigError
from wavebatch.files.las.extra_bytes import build_dtype
from wavebatch.files.las.header import LasHeader
from wavebatch.files.las.point_formats import WITHOUT_WAVES
from wavebatch.files.las.write_points import PointFile


class ReturnWriter(PointFile):
    """Writes a cloud of discrete returns without packets: `write` records of `dtype`, then `commit`.

    target: its suffix selects LAS or LAZ. point_format: 1 or 3 (LAS 1.2), 6 or 8 (LAS 1.4). wkt: CRS for LAS 1.4.
    Raises ConfigError for another point format, and errors as PointFile does.
    """

    def __init__(
        self,
        target: Path,
        *,
        point_format: int,
        scales: Sequence[float],
        offsets: Sequence[float],
        wkt: str | None = None,
        overwrite: bool = False,
    ) -> None:
        if point_format not in WITHOUT_WAVES.values():
            raise ConfigError(f"{target}: returns are written in point format 1, 3, 6 or 8, not {point_format}")
        version = (1, 4) if point_format >= 6 else (1, 2)
        header = LasHeader.new(version, point_format, scales, offsets, wkt if point_format >= 6 else None)
        super().__init__(target, header, build_dtype(point_format, ()), (), overwrite=overwrite)
