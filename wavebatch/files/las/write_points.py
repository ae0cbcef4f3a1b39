"""One LAS or LAZ file being written: points in order, then extended records, then a header that tells the truth."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.publish import Draft, refuse_existing, reporting
from wavebatch.files.las.extra_bytes import EXTRA_BYTES_RECORD_ID, ExtraRecord
from wavebatch.files.las.header import WAVEFORM_RECORD_ID, LasHeader, Vlr, encode_evlr_header, has_record
from wavebatch.files.las.laz_encode import open_encoder

_COPY_SIZE = 1 << 22
_EXTRA_BYTES = ("LASF_Spec", EXTRA_BYTES_RECORD_ID)


class PointFile:
    """Writes points of one dtype to `target`; what ends in `.laz` is compressed.

    header: of the output; counts, bounds and starts are filled in here. records: one per extra dimension of dtype; the
    VLR that holds them takes the place of one in `header.vlrs`, or is appended.
    """

    def __init__(
        self, target: Path, header: LasHeader, dtype: np.dtype, records: Sequence[ExtraRecord], *, overwrite: bool
    ) -> None:
        self.target = Path(target)
        self.dtype = dtype
        self._header = header
        self._records = list(records)
        header.compressed = is_compressed(self.target)
        header.point_length = dtype.itemsize
        header.vlrs = [vlr for vlr in header.vlrs if not has_record([vlr], "laszip encoded", 22204)]
        self._place_extra_bytes()
        self._statistics = Statistics(dtype, self._records)
        if not overwrite:
            refuse_existing(self.target)
        self.draft = Draft(self.target, overwrite=overwrite)
        try:
            with self._guarded():
                self._encoder = open_encoder(self.draft.file, header)
        except BaseException:
            self.draft.discard()
            raise

    def write(self, rows: np.ndarray) -> None:
        """Appends records (m,) of `dtype`."""
        if rows.dtype != self.dtype:
            raise InputError(f"{self.target}: rows of another layout than the file's; a bug, please report it")
        if not len(rows):
            return
        rows = np.ascontiguousarray(rows)
        self._statistics.add(rows)
        if self._statistics.count >= 2**32 and self._header.version < (1, 4):
            raise InputError(f"{self.target}: LAS {self._header.version[0]}.{self._header.version[1]} holds at most "
                             "4294967295 points; promote with --point-format 6")  # fmt: skip
        with self._guarded():
            self._encoder.write(rows)
            self.draft.file.flush()  # a worker forked now must not inherit bytes that it would write once more

    def finish_points(self) -> None:
        """Ends the points; extended records may follow."""
        with self._guarded():
            self._encoder.finish()
            self.draft.file.seek(0, 2)

    def append_record(self, head: bytes, source: BinaryIO, start: int, end: int, *, waveforms: bool = False) -> None:
        """Copies bytes [start, end) of `source` behind what is there, after the 60 bytes of `head`."""
        with self._guarded():
            at = self.draft.file.tell()
            self.draft.file.write(head)
            copy_bytes(source, start, end, self.draft.file)
        if waveforms:
            self._header.waveform_start = at
        if self._header.version >= (1, 4):
            self._header.evlr_start = self._header.evlr_start or at
            self._header.evlr_count += 1

    def finish(self) -> None:
        """Writes the final header; the draft is then ready to be published."""
        self._statistics.fill(self._header)
        self._place_extra_bytes(self._statistics.ranged())
        with self._guarded():
            self.draft.file.seek(0)
            self.draft.file.write(self._header.encode())

    def abort(self) -> None:
        """Removes what was written."""
        self.draft.discard()

    def _place_extra_bytes(self, records: Sequence[ExtraRecord] | None = None) -> None:
        records = self._records if records is None else records
        vlrs = self._header.vlrs
        places = [index for index, vlr in enumerate(vlrs) if has_record([vlr], *_EXTRA_BYTES)]
        payload = b"".join(record.data for record in records)
        if len(payload) > 65535:
            raise InputError(f"{self.target}: {len(records)} extra bytes are more than a LAS file can describe")
        if places and records:
            old = vlrs[places[0]]
            vlrs[places[0]] = Vlr(old.user_id, old.record_id, payload, old.description, old.reserved)
            places = places[1:]
        elif records:
            vlrs.append(Vlr(b"LASF_Spec", EXTRA_BYTES_RECORD_ID, payload, b"Extra bytes"))
        self._header.vlrs = [vlr for index, vlr in enumerate(vlrs) if index not in places]

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """One InputError line that names the target, whatever compressor or disk say."""
        try:
            with reporting(self.target):
                yield
        except InputError as error:
            if str(error).startswith(str(self.target)):
                raise
            raise InputError(f"{self.target}: {error}") from error


class Statistics:
    """Counts, bounds and extremes over all rows written, for header and extra-bytes records."""

    def __init__(self, dtype: np.dtype, records: Sequence[ExtraRecord]) -> None:
        self.count = 0
        fields = dtype.names[len(dtype.names) - len(records) :]
        self._records = dict(zip(fields, records, strict=True))
        self._bits = np.zeros(256, np.int64)
        self._format_bits = 4 if "classification_flags" in dtype.names else 3
        self._axes = [name for name in ("X", "Y", "Z", "gps_time") if name in dtype.names]
        self._extremes: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def add(self, rows: np.ndarray) -> None:
        """Takes the rows into account."""
        self.count += len(rows)
        self._bits += np.bincount(rows["bit_fields"], minlength=256)
        for name in self._axes:
            self._widen(name, rows[name])
        for field, record in self._records.items():
            if record.code:
                self._widen(field, rows[field], record.no_data)

    def _widen(self, name: str, values: np.ndarray, no_data: np.ndarray | None = None) -> None:
        values = np.ascontiguousarray(values)
        if values.ndim > 1:
            for element in range(values.shape[1]):
                empty = None if no_data is None else no_data[element : element + 1]
                self._widen(f"{name}\0{element}", values[:, element], empty)
            return
        good = np.ones(len(values), bool) if no_data is None else values != no_data[0]
        if values.dtype.kind == "f":
            good &= np.isfinite(values)
        if not good.all():
            values = values[good]
        if len(values):
            least, largest = values.min(), values.max()
            if name in self._extremes:
                old = self._extremes[name]
                least, largest = min(least, old[0]), max(largest, old[1])
            self._extremes[name] = (least, largest)

    def fill(self, header: LasHeader) -> None:
        """Sets counts and bounds of the header; those of an empty file are 0."""
        header.point_count = self.count
        number = np.arange(256) & ((1 << self._format_bits) - 1)
        by_return = np.bincount(number, self._bits, 16).astype(np.int64)
        header.by_return = tuple(int(n) for n in by_return[1:16])
        bounds = []
        for axis, name in enumerate("XYZ"):
            scale, offset = header.scales[axis], header.offsets[axis]
            least, largest = self._extremes.get(name, (None, None))
            bounds.append((0.0, 0.0) if least is None else sorted((least * scale + offset, largest * scale + offset)))
        header.mins, header.maxs = tuple(b[0] for b in bounds), tuple(b[1] for b in bounds)
        if header.version >= (1, 5):
            least, largest = self._extremes.get("gps_time", (0.0, 0.0))
            header.gps_range = (float(largest), float(least))

    def ranged(self) -> list[ExtraRecord]:
        """The records with the extremes of what was written; without any value they declare none."""
        return [self._range(field, record) for field, record in self._records.items()]

    def _range(self, field: str, record: ExtraRecord) -> ExtraRecord:
        shape = record.dtype.shape
        names = [f"{field}\0{element}" for element in range(shape[0])] if shape else [field]
        if any(name not in self._extremes for name in names):
            return record.with_range(None, None)
        least, largest = zip(*(self._extremes[name] for name in names), strict=True)
        return record.with_range(np.array(least), np.array(largest))


def is_compressed(target: Path) -> bool:
    """Whether the name says LAZ; raises ConfigError where it says neither LAS nor LAZ."""
    suffix = target.suffix.lower()
    if suffix not in (".las", ".laz"):
        raise ConfigError(f"{target}: an output's name must end in .las or .laz")
    return suffix == ".laz"


def copy_bytes(source: BinaryIO, start: int, end: int, target: BinaryIO) -> None:
    """Copies bytes [start, end) of one open file to the place where the other stands, in bounded memory."""
    source.seek(start)
    left = end - start
    while left:
        piece = source.read(min(left, _COPY_SIZE))
        if not piece:
            raise InputError(f"{source.name}: ends {left} bytes too early; it changed while it was read")
        target.write(piece)
        left -= len(piece)


def waveform_head(length: int) -> bytes:
    """The 60 bytes in front of the packets, in the cloud itself or in a `.wdp`."""
    return encode_evlr_header(b"LASF_Spec", WAVEFORM_RECORD_ID, length, b"wave packets")
