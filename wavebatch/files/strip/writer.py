"""Full-waveform strips written from arrays: points with packets, inside the file or in a .wdp beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.disk.publish import Draft, publish_together, refuse_existing, reporting
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    WKT_BIT,
    LasHeader,
    Vlr,
    build_wkt,
)
from wavebatch.files.las.write_points import PointFile, waveform_head

_FORMATS = {(1, 3): (4, 5), (1, 4): (4, 5, 9, 10), (1, 5): (9, 10)}
_DESCRIPTOR = np.dtype(
    [("bits", "u1"), ("compression", "u1"), ("samples", "<u4"), ("ps", "<u4"), ("gain", "<f8"), ("offset", "<f8")]
)
_CREATION = (1, 2025)
"""Day and year in every header: the same input gives the same bytes on any day."""


class FullwaveWriter:
    """Streams a full-waveform strip: `write_packets`, `write_points` with the offsets it returned, then `commit`.

    target: its suffix says LAS or LAZ. version: "1.3", "1.4" or "1.5". point_format: 4, 5, 9 or 10 (9, 10 from 1.4 on).
    internal: packets in the file itself (spooled beside it until commit), else in a .wdp of its name.
    digitizers: with 8, 16 or 32 bits; the index of one is what its points carry. wkt: CRS, or None.
    extra_bytes: one ExtraRecord per extra dimension. records: further VLRs, as they are. toward: how the vectors
    x_t, y_t, z_t are stored; points are always handed in with vectors toward the sensor, and turned round here when
    this is False.
    As a context manager it aborts itself unless committed. Raises ConfigError and InputError as CloudWriter does.
    """

    def __init__(
        self,
        target: Path,
        *,
        version: str = "1.4",
        point_format: int,
        internal: bool,
        digitizers: Sequence[Digitizer],
        scales: Sequence[float] = (0.001, 0.001, 0.001),
        offsets: Sequence[float] = (0.0, 0.0, 0.0),
        wkt: str | None = None,
        extra_bytes: Sequence[ExtraRecord] = (),
        records: Sequence[Vlr] = (),
        toward: bool = True,
        overwrite: bool = False,
    ) -> None:
        self.target = Path(target)
        numbers = _check_version(self.target, version, point_format)
        self._digitizers = {digitizer.index: digitizer for digitizer in _check_digitizers(self.target, digitizers)}
        self.dtype = build_dtype(point_format, extra_bytes)
        self._internal, self._toward = internal, toward
        header = _build_header(numbers, point_format, internal, digitizers, wkt)
        header.vlrs += records
        header.scales, header.offsets = tuple(map(float, scales)), tuple(map(float, offsets))
        self._file = PointFile(self.target, header, self.dtype, extra_bytes, overwrite=overwrite)
        beside = self.target.with_suffix(".wdp")
        try:
            if not (internal or overwrite):
                refuse_existing(beside)
            self._packets = Draft(beside, overwrite=overwrite)
        except InputError:
            self._file.abort()
            raise
        with reporting(self.target):
            self._packets.file.write(waveform_head(0))
        self._end = EVLR_HEADER_SIZE
        self._open = True

    def __enter__(self) -> FullwaveWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.abort()

    def write_packets(self, samples: np.ndarray, digitizer: int) -> np.ndarray:
        """Appends packets of raw counts (n, s), s at most the digitizer's samples; returns byte offsets, u8 (n,).

        The size to put in a point is s times the digitizer's bytes per sample.
        """
        known = self._digitizers.get(digitizer)
        samples = np.asarray(samples)
        if known is None or samples.ndim != 2 or samples.shape[1] > known.n_samples:
            raise ConfigError(f"{self.target}: samples {samples.shape} do not suit digitizer {digitizer}")
        if samples.size and (samples.dtype.kind not in "ui" or samples.min() < 0 or samples.max() > known.max_count):
            raise ConfigError(f"{self.target}: samples must be whole numbers from 0 to {known.max_count}")
        stored = np.ascontiguousarray(samples, dtype=f"<u{known.bits // 8}")
        size = stored.shape[1] * stored.itemsize
        with reporting(self.target):
            self._packets.file.write(stored.view(np.uint8).data)
            self._packets.file.flush()
        offsets = np.uint64(self._end) + np.arange(len(stored), dtype=np.uint64) * np.uint64(size)
        self._end += stored.nbytes
        return offsets

    def write_points(self, points: np.ndarray) -> None:
        """Appends points of `dtype`, their vectors toward the sensor."""
        if not self._toward:
            points = points.copy()
            for name in ("x_t", "y_t", "z_t"):
                points[name] = -points[name]
        self._file.write(points)

    def commit(self) -> None:
        """Completes and publishes the strip (and its .wdp, first); on an error nothing of it remains."""
        length = self._end - EVLR_HEADER_SIZE
        try:
            self._file.finish_points()
            with reporting(self.target):
                self._packets.file.seek(0)
                self._packets.file.write(waveform_head(length))
            if self._internal:
                source = self._packets.file
                self._file.append_record(waveform_head(length), source, EVLR_HEADER_SIZE, self._end, waveforms=True)
            self._file.finish()
        except BaseException:
            self.abort()
            raise
        if self._internal:
            self._packets.discard()
            publish_together([self._file.draft])
        else:
            publish_together([self._packets, self._file.draft])
        self._open = False

    def abort(self) -> None:
        """Removes what was written so far; harmless after commit."""
        if self._open:
            self._packets.discard()
            self._file.abort()
            self._open = False


def _check_version(target: Path, version: str, point_format: int) -> tuple[int, int]:
    numbers = tuple(int(part) for part in version.split(".") if part.isdigit())
    if point_format not in _FORMATS.get(numbers, ()):
        raise ConfigError(
            f"{target}: LAS {version} with point format {point_format} is no waveform file; 1.3 takes 4 and 5, "
            "1.4 takes 4, 5, 9 and 10, 1.5 takes 9 and 10"
        )
    return numbers


def _check_digitizers(target: Path, digitizers: Sequence[Digitizer]) -> Sequence[Digitizer]:
    indices = [digitizer.index for digitizer in digitizers]
    if not indices or len(set(indices)) < len(indices) or not all(1 <= index <= 255 for index in indices):
        raise ConfigError(f"{target}: digitizers need different indices from 1 to 255, got {indices}")
    for digitizer in digitizers:
        if digitizer.bits not in (8, 16, 32):
            raise ConfigError(f"{target}: digitizer {digitizer.index} has {digitizer.bits} bits, not 8, 16 or 32")
    return digitizers


def _build_header(
    version: tuple[int, int], point_format: int, internal: bool, digitizers: Sequence[Digitizer], wkt: str | None
) -> LasHeader:
    encoding = 1 | (WAVES_INTERNAL if internal else WAVES_EXTERNAL)
    return LasHeader(
        version=version,
        point_format=point_format,
        point_length=0,
        scales=(0.001,) * 3,
        offsets=(0.0,) * 3,
        vlrs=_build_vlrs(digitizers, wkt),
        global_encoding=encoding | (WKT_BIT if point_format >= 6 or (wkt and version >= (1, 4)) else 0),
        system_identifier=b"OTHER",
        generating_software=f"wavebatch {__version__}".encode(),
        creation=_CREATION,
    )


def _build_vlrs(digitizers: Sequence[Digitizer], wkt: str | None) -> list[Vlr]:
    vlrs = []
    for digitizer in digitizers:
        spacing = round(digitizer.spacing * PS_PER_NS)
        values = (digitizer.bits, 0, digitizer.n_samples, spacing, digitizer.gain, digitizer.offset)
        payload = np.array([values], _DESCRIPTOR).tobytes()
        vlrs.append(Vlr(b"LASF_Spec", 99 + digitizer.index, payload, b"wave packet descriptor"))
    if wkt:
        vlrs.append(build_wkt(wkt))
    return vlrs
