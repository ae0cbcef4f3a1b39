"""Writer of full-waveform strips from arrays: points with packets, in the file itself or in a .wdp next to it.

`wavebatch simulate` and `wavebatch slice` write strips with it, and so do the tests. Vectors of points are passed
toward the sensor; `toward=False` stores them the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.disk.publish import Draft, refuse_existing, reporting
from wavebatch.files.las import header as las
from wavebatch.files.las.write_points import PointFile, waveform_head
from wavebatch.files.strip.packets import DESCRIPTOR

_FORMATS = {(1, 3): (4, 5), (1, 4): (4, 5, 9, 10), (1, 5): (9, 10)}


class FullwaveWriter(PointFile):
    """Writes a full-waveform strip: `write_packets`, `write_points` with the offsets it returned, then `commit`.

    Parameters
    ----------
    target : Path
        The strip; its suffix selects LAS or LAZ.
    version : str
        "1.3", "1.4" or "1.5".
    point_format : int
        4, 5, 9 or 10; 9 and 10 need version 1.4 or 1.5.
    internal : bool
        Packets go into the strip itself (until `commit` they are in a file next to it), else into a .wdp of its name.
    digitizers : sequence of Digitizer
        With 8, 16 or 32 bits; points refer to a digitizer by its index.
    scales, offsets : sequence of 3 floats
        Of the stored coordinates [m].
    wkt : str or None
        The CRS.
    extra_bytes : sequence of ExtraRecord
        One per extra dimension.
    records : sequence of Vlr
        Further VLRs, written unchanged.
    toward : bool
        Whether the vectors x_t, y_t, z_t are stored toward the sensor.
    week : bool
        Whether GPS times are seconds of the week, not standard GPS time less 1e9 s.
    system : str
        The sensor, for the header.
    source : int
        File source id.

    Raises
    ------
    ConfigError
        For a version, point format or digitizer that no strip can have.
    InputError
        If the target exists (without overwrite) or cannot be written.
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
        extra_bytes: Sequence[las.ExtraRecord] = (),
        records: Sequence[las.Vlr] = (),
        toward: bool = True,
        week: bool = False,
        system: str = "OTHER",
        source: int = 0,
        overwrite: bool = False,
    ) -> None:
        target = Path(target)
        numbers = next((known for known in _FORMATS if version == ".".join(map(str, known))), None)
        if numbers is None or point_format not in _FORMATS[numbers]:
            raise ConfigError(
                f"{target}: LAS {version} has no waveforms in point format {point_format}; choose format 4 or 5 for "
                "1.3; 4, 5, 9 or 10 for 1.4; 9 or 10 for 1.5"
            )
        indices, descriptors = [digitizer.index for digitizer in digitizers], []
        if not indices or len(set(indices)) < len(indices) or not all(1 <= index <= 255 for index in indices):
            raise ConfigError(f"{target}: digitizers need different indices from 1 to 255, got {indices}")
        for one in digitizers:
            if one.bits not in (8, 16, 32):
                raise ConfigError(f"{target}: digitizer {one.index} has {one.bits} bits, not 8, 16 or 32")
            payload = DESCRIPTOR.pack(one.bits, 0, one.n_samples, round(one.spacing * PS_PER_NS), one.gain, one.offset)
            descriptors.append(las.Vlr(b"LASF_Spec", 99 + one.index, payload, b"wave packet descriptor"))
        self._digitizers = {digitizer.index: digitizer for digitizer in digitizers}
        self._internal, self._toward = internal, toward
        header = las.LasHeader.new(
            numbers, point_format, scales, offsets, wkt, las.WAVES_INTERNAL if internal else las.WAVES_EXTERNAL
        )
        header.vlrs = [*descriptors, *header.vlrs, *records]
        header.system_identifier, header.file_source_id = system.encode("latin-1", "replace")[:32], source
        if week:
            header.global_encoding &= ~las.STANDARD_TIME
        self.scales, self.offsets = header.scales, header.offsets
        super().__init__(target, header, las.build_dtype(point_format, extra_bytes), extra_bytes, overwrite=overwrite)
        packet_file = target if internal else target.with_suffix(".wdp")
        try:
            refuse_existing(packet_file, internal or overwrite)
            self._packets = Draft(packet_file, overwrite=overwrite)
        except BaseException:
            self.abort()
            raise
        self.drafts.insert(0, self._packets)
        with reporting(self.target):
            self._packets.file.write(waveform_head(0))
        self._end = las.EVLR_HEADER_SIZE

    def write_packets(self, samples: np.ndarray, digitizer: int) -> np.ndarray:
        """Append packets of raw counts (n, s), s at most the digitizer's samples; return their byte offsets, u8 (n,).

        The packet size of a point is s times the digitizer's bytes per sample.
        """
        known = self._digitizers.get(digitizer)
        samples = np.asarray(samples)
        if known is None or samples.ndim != 2 or samples.shape[1] > known.n_samples:
            raise ConfigError(f"{self.target}: samples of shape {samples.shape} do not fit digitizer {digitizer}")
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
        """Append points (n,) of `dtype`, with vectors toward the sensor."""
        if not self._toward:
            points = points.copy()
            for name in ("x_t", "y_t", "z_t"):
                points[name] = -points[name]
        self.write(points)

    def _append_records(self) -> None:
        head = waveform_head(self._end - las.EVLR_HEADER_SIZE)
        with reporting(self.target):
            self._packets.file.seek(0)
            self._packets.file.write(head)
        if self._internal:
            self.append_record(head, self._packets.file, las.EVLR_HEADER_SIZE, self._end, waveforms=True)
            self._packets.discard()
            self.drafts.remove(self._packets)
