"""Place of a strip's packets, their descriptors, and the samples of many packets at a time; and the writer of strips.

`find_facts` locates packets and reads descriptors; `StripReader` reads samples through `PacketFile`. Offsets given to
`PacketFile` must have been checked by `packet_check.Judge`.

`StripFacts` is all that a strip's checked headers contain, found once and then passed on, also to other processes. Keep
it picklable, and add nothing to it that needs a pass over the points: that belongs into `StripScan`.

`FullwaveWriter` writes strips from arrays: points with packets, in the file itself or in a .wdp next to it. `wavebatch
import`, `export`, `simulate` and `synthesize` write strips with it, and so do the tests. Vectors of points are passed
toward the sensor; `toward=False` stores them the other way round.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from io import FileIO
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.disk.publish import Draft, list_packet_files, refuse_existing, reporting
from wavebatch.files.disk.raw_bytes import damaged, open_regular, read_exactly, reporting_reads, undoing
from wavebatch.files.las import header as las
from wavebatch.files.las.crs import LONGEST_WKT, CrsUnits, build_utm, find_code, find_epsg, read_crs
from wavebatch.files.las.read_points import CheckedHeader, open_points, read_checked_header
from wavebatch.files.las.write_points import PointFile, waveform_head
from wavebatch.kernels.packets import MOST_BYTES, decode_packets

_FIRST_POINTS = 10_000
"""Points that show from where a .wdp without header counts its byte offsets."""


@frozen(eq=False)
class StripFacts(CheckedHeader):
    """Facts of a strip after all checks: its header, and what follows from it; picklable."""

    digitizers: Mapping[int, Digitizer]
    """All descriptors by index, also unused and empty ones."""
    compression: Mapping[int, int]
    """Compression type of every descriptor."""
    packets: PacketPlace
    direction_option: str
    crs: str | None
    units: tuple[CrsUnits, ...]
    """Units of the coordinates, one entry from the WKT and one from the GeoTIFF keys, if these are there."""

    @property
    def compressed(self) -> frozenset[int]:
        """Indices of descriptors with compressed packets."""
        return frozenset(index for index, kind in self.compression.items() if kind == COMPRESSED)


def find_facts(path: Path, direction: str, headerless: bool) -> StripFacts:
    """Return the facts of a strip; reads its headers, descriptors and CRS, not its points.

    direction, headerless: as for `StripReader`. Raises InputError if the strip cannot be what it claims to be.
    """
    checked = read_checked_header(path)
    header = checked.header
    # All descriptors among the VLRs count, also unused and empty ones; `packet_check` checks those that are used.
    digitizers: dict[int, Digitizer] = {}
    compression: dict[int, int] = {}
    odd = []
    for vlr in header.vlrs:
        if vlr.user != "LASF_Spec" or not _FIRST_ID <= vlr.record_id <= _LAST_ID:
            continue
        index = vlr.record_id - _FIRST_ID + 1
        if len(vlr.payload) < DESCRIPTOR.size:
            odd.append(f"descriptor {index} has {len(vlr.payload)} bytes instead of 26 and is ignored")
            continue
        bits, kind, samples, spacing, gain, offset = DESCRIPTOR.unpack_from(vlr.payload)
        for name, value in ("gain", gain), ("offset", offset):
            if not abs(value) <= MOST_VOLTS:
                reason = "which no digitizer has; it counts as not given, and counts are used as they are"
                odd.append(f"descriptor {index} has {name} {value:g} V, {reason}")
        gain, offset = (value if abs(value) <= MOST_VOLTS else 0.0 for value in (gain, offset))
        digitizer = Digitizer(index, bits, samples, spacing / PS_PER_NS, gain, offset)
        if index not in digitizers:
            digitizers[index], compression[index] = digitizer, kind
        elif digitizers[index] != digitizer:
            odd.append(f"descriptor {index} is there twice with different content; the first one is used")
    place = locate_packets(checked, compression, headerless)
    if place.base < 0:
        with contextlib.closing(open_points(checked)) as points:
            first = points.read(0, min(header.point_count, _FIRST_POINTS))
        offsets = first["wavepacket_offset"][(first["wavepacket_index"] > 0) & (first["wavepacket_size"] > 0)]
        if len(offsets) and int(offsets.min()) < las.EVLR_HEADER_SIZE:
            place = replace(place, base=0)  # in a .wdp without header such offsets count from its first byte
    crs, units = read_crs(path, header)
    # Programs that convert a strip may leave the record of the kind that they do not write as it was.
    codes = [find_epsg(crs or ""), find_code(header.vlrs)]
    # A compound CRS has the code of the zone inside.
    every = {codes[1] or 0, *map(int, re.findall(r'"EPSG"\s*,\s*"?(\d{4,5})\b', crs or ""))}
    zones = {wkt.partition("PROJECTION")[2].rpartition(",AUTHORITY")[0] for wkt in map(build_utm, every) if wkt}
    wkts = [vlr.payload for vlr in header.vlrs if las.is_projection(vlr) and vlr.record_id == las.WKT_ID]
    # laspy and others take the WKT after the points where there are two.
    wkts += [las.read_evlr(path, evlr) for evlr in las.find_evlrs(path, header)[0] if las.is_projection(evlr)
             and evlr.record_id == las.WKT_ID and evlr.length <= LONGEST_WKT]  # fmt: skip
    words = ["".join(payload.split(b"\0")[0].decode("latin-1").split()) for payload in wkts]
    texts = {find_epsg(text) or text for text in words if text}
    # Survey feet are written with 7 digits too; international feet differ in the sixth.
    sizes = {round(unit.horizontal, 7) for unit in units if unit.horizontal and np.isfinite(unit.horizontal)}
    if max(len(zones), len(texts), len(sizes)) > 1:
        said = f" (EPSG:{codes[0]} and EPSG:{codes[1]})" if all(codes) else ""
        odd.append(f"WKT and GeoTIFF records of the CRS{said} contradict each other: some programs show the strip in "
                   "another place, or in another unit; remove the wrong ones")  # fmt: skip
    values = {entry.name: getattr(checked, entry.name) for entry in fields(checked)}
    values["warnings"] = (*checked.warnings, *odd, *place.warnings)
    return StripFacts(**values, digitizers=digitizers, compression=compression, packets=place,
                      direction_option=direction, crs=crs, units=units)  # fmt: skip


MAX_SAMPLES = 1 << 16
"""Longer waveforms are damage: digitizers record a few hundred samples."""
BLOCK_BYTES = 1 << 25
"""Most bytes of samples in one block, for any number of waveforms."""
COMPRESSED = 1
"""Compression type of LAStools."""
MOST_VOLTS = 1e6
"""Largest gain [V per count] and offset [V] of a descriptor; digitizers have a few volts, larger ones are damage."""

DESCRIPTOR = struct.Struct("<BBIIdd")
_FIRST_ID, _LAST_ID = 100, 354
_SPARSE = 4
"""A span of bytes is read in one piece if it is at most this many times as long as the wanted packets,"""
_SPAN = 1 << 22
"""or at most this long."""
_GAP = 1 << 14
"""Gap between packets [bytes] that is read over: a seek costs more than 16 KiB."""


@frozen
class PacketPlace:
    """Bytes [start, end) of `file` that packets may use; a packet begins at `base` + its offset. None: no packets."""

    file: Path | None
    internal: bool
    base: int
    start: int
    end: int
    warnings: tuple[str, ...] = ()

    @property
    def offsets(self) -> tuple[int, int]:
        """Limits of the byte offsets that points may have."""
        return self.start - self.base, self.end - self.base

    @property
    def shift(self) -> int:
        """What a copy of the packets adds to byte offsets that count from the first byte of a .wdp without header."""
        return max(0, las.EVLR_HEADER_SIZE - self.offsets[0])


def locate_packets(checked: CheckedHeader, compression: dict[int, int], headerless: bool) -> PacketPlace:
    """Return the place of the packets: in the strip itself, or in the .wdp next to it.

    Packets of LAStools may be compressed, in a .wdz.
    headerless: accept a .wdp without its 60-byte header; `find_facts` finds how its offsets count.
    Raises InputError if packets are missing, compressed, or in a file that is not a .wdp.
    """
    header, path = checked.header, checked.path
    if compression and min(compression.values()) > COMPRESSED:
        raise refuse_compressed(path, next(iter(compression.values())))
    said = header.global_encoding & (las.WAVES_INTERNAL | las.WAVES_EXTERNAL)
    if said == las.WAVES_INTERNAL:
        return _locate_internal(checked)
    external = said == las.WAVES_EXTERNAL
    packet_file, packed = (
        next(filter(Path.is_file, list_packet_files(path, (f".{end}", f".{end.upper()}"))), None)
        for end in ("wdp", "wdz")
    )
    if COMPRESSED in compression.values() and packed is not None:
        packet_file = packed
    given = "a wrong place" if external else "two places" if said else "no place"
    warning = f"the header gives {given} of the packets (global encoding bits 1 and 2)"
    # Where both bits or none are set, or the .wdp is not there, what is there decides.
    evlrs = las.find_evlrs(path, header)[0] if external and packet_file is None and packed is None else []
    if header.waveform_start and (not external or any(one.record_id == las.WAVEFORM_RECORD_ID for one in evlrs)):
        place, where = _locate_internal(checked), "the record in the file"
    elif packet_file is not None:
        place, where = _locate_external(checked, packet_file, headerless), packet_file.name
    elif packed is not None:
        raise InputError(
            f"{path}: its packets are in {packed.name}, which holds compressed ones, but its descriptors say that they "
            f"are not compressed: get {path.with_suffix('.wdp').name}, or the strip that belongs to {packed.name}"
        )
    elif external:
        name = path.with_suffix(".wdz" if COMPRESSED in compression.values() else ".wdp").name
        if path.with_name(name).exists():
            raise InputError(f"{path}: its packets are missing: {name} is no file; put them there")
        raise InputError(f"{path}: its packets are missing: put {name} next to the strip")
    else:
        return PacketPlace(None, False, 0, 0, 0, (f"{warning}, and there is no .wdp next to the strip",))
    if external and not place.internal:
        return place
    return replace(place, warnings=(*place.warnings, f"{warning}; they are read from {where}"))


def refuse_compressed(path: Path, kind: int) -> InputError:
    """Return the error for packets of an unknown compression, with the command that may decompress them."""
    return InputError(
        f"{path}: its packets are compressed (type {kind}), which LAS does not define; wavebatch reads type 1 with 8 "
        f"or 16 bits; decompress them first: laszip -i {path.name} -o {path.stem}_raw.las -waveform"
    )


def _locate_internal(checked: CheckedHeader) -> PacketPlace:
    header, path, size = checked.header, checked.path, checked.size
    evlrs, _ = las.find_evlrs(path, header)
    at, warnings = header.waveform_start, []
    if not at:
        at = next((evlr.start for evlr in evlrs if evlr.record_id == las.WAVEFORM_RECORD_ID), 0)
        warnings.append(f"the header does not point at the waveform record; it was found as an EVLR at byte {at}")
    least = header.offset_to_points if header.compressed else checked.points_end
    if not least <= at <= size - las.EVLR_HEADER_SIZE:
        raise damaged(path, f"waveform record at byte {at}, but the points end at {least} and the file at {size}")
    with open(path, "rb") as file:
        file.seek(at)
        head = file.read(las.EVLR_HEADER_SIZE)
    record_id, length = struct.unpack_from("<HQ", head, 18)
    if record_id != las.WAVEFORM_RECORD_ID:
        raise InputError(
            f"{path}: no waveform record at byte {at} (record id {record_id} instead of 65535); the pointer in the "
            "header (byte 227) is wrong: get the file again"
        )
    end = min([size, *(evlr.start for evlr in evlrs if evlr.start > at)])
    if at + las.EVLR_HEADER_SIZE + length != end:
        warnings.append(f"the waveform record claims {length} bytes, {end - at - las.EVLR_HEADER_SIZE} are there")
    return PacketPlace(path, True, at, at + las.EVLR_HEADER_SIZE, end, tuple(warnings))


def _locate_external(checked: CheckedHeader, packet_file: Path, headerless: bool) -> PacketPlace:
    size = packet_file.stat().st_size
    with open_regular(packet_file) as file:
        head = file.read(las.EVLR_HEADER_SIZE)
    warnings = []
    if len(head) < las.EVLR_HEADER_SIZE or not head[2:].startswith(b"LAS") or head[18:20] != b"\xff\xff":
        if not headerless:
            raise InputError(
                f"{checked.path}: {packet_file.name} does not begin with the 60-byte header of a waveform record; "
                "if it has no header, run again with --headerless, else get it again"
            )
        return PacketPlace(packet_file, False, -las.EVLR_HEADER_SIZE, 0, size, (f"{packet_file.name} has no header",))
    (length,) = struct.unpack_from("<Q", head, 20)
    if length not in (0, size - las.EVLR_HEADER_SIZE):
        warnings.append(f"{packet_file.name} claims {length} bytes of packets, {size - las.EVLR_HEADER_SIZE} are there")
    return PacketPlace(packet_file, False, 0, las.EVLR_HEADER_SIZE, size, tuple(warnings))


class PacketFile:
    """Reads the samples of many packets at once.

    compressed: indices of descriptors with compressed packets. span: bytes up to which all between the packets is read
    in one piece; gap: bytes between two packets that are read over.
    """

    def __init__(
        self, place: PacketPlace, compressed: Collection[int] = (), *, span: int = _SPAN, gap: int = _GAP
    ) -> None:
        self._place, self._compressed, self._span, self._gap = place, compressed, span, gap
        self._file: FileIO | None = None
        self._buffer = np.empty(0, np.uint8)
        if place.file is not None:
            with reporting_reads(place.file):
                self._file = open(place.file, "rb", buffering=0)  # noqa: SIM115 - closed by close()

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._file is not None:
            self._file.close()

    def read(self, offsets: np.ndarray, n_samples: int, bits: int, descriptor: int = 0) -> np.ndarray:
        """Return raw counts of packets that were checked before.

        Parameters
        ----------
        offsets : u8 (n,)
            Byte offsets as points have them.
        n_samples, bits : int
            Samples per packet, and bits per sample: 8, 16 or 32.
        descriptor : int
            Index of their descriptor.

        Returns
        -------
        u1, u2 or u4 (n, n_samples), read-only
        """
        if descriptor in self._compressed:
            samples, _ = self.decode(offsets, np.full(len(offsets), MOST_BYTES * n_samples + 16), n_samples, bits)
        else:
            samples = self.read_bytes(offsets, n_samples * (bits // 8)).view(f"<u{bits // 8}")
        samples.flags.writeable = False
        return samples

    def read_bytes(self, offsets: np.ndarray, width: int) -> np.ndarray:
        """Return the first `width` bytes of packets that were checked before, u1 (n, width)."""
        starts = (offsets + np.uint64(self._place.base % 2**64)).astype(np.int64)
        with reporting_reads(self._place.file or Path(), "packets ", "; check the disk"):
            if not len(starts):
                return np.empty((0, width), np.uint8)
            first, last = int(starts.min()), int(starts.max())
            if last - first == (len(starts) - 1) * width and (len(starts) == 1 or np.all(np.diff(starts) == width)):
                rows = np.empty((len(starts), width), np.uint8)
                self._fill(rows.reshape(-1), first)
                return rows
            span = last - first + width
            if span <= max(_SPARSE * len(starts) * width, self._span):
                buffer = self._take_buffer(span)
                self._fill(buffer, first)
                return np.lib.stride_tricks.sliding_window_view(buffer, width)[starts - first]
            order = np.argsort(starts, kind="stable")
            ordered = starts[order]
            found = _find_runs(ordered, width, self._gap)
            runs = [(a, z, int(ordered[a]), int(ordered[z - 1]) + width) for a, z in found]
            buffer = self._take_buffer(sum(end - begin for _, _, begin, end in runs))
            place = np.empty(len(starts), np.int64)
            at = 0
            for a, z, begin, end in runs:
                self._fill(buffer[at : at + end - begin], begin)
                place[order[a:z]] = ordered[a:z] - begin + at
                at += end - begin
            return np.lib.stride_tricks.sliding_window_view(buffer, width)[place]

    def decode(
        self, offsets: np.ndarray, sizes: np.ndarray, n_samples: int, bits: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return counts of compressed packets, and which of them are whole, bool (n,).

        sizes: bytes of the packets, or more; i8 (n,).
        """
        if not len(offsets):
            return np.empty((0, n_samples), f"<u{bits // 8}"), np.empty(0, bool)
        starts = (offsets + np.uint64(self._place.base % 2**64)).astype(np.int64)
        order = np.argsort(starts, kind="stable")
        ends = np.minimum(starts + sizes, self._place.end)[order]
        samples, good = np.zeros((len(starts), n_samples), f"<u{bits // 8}"), np.zeros(len(starts), bool)
        with reporting_reads(self._place.file or Path(), "packets ", "; check the disk"):
            for a, z in _find_runs(starts[order], int(sizes.max(initial=0)), self._gap, BLOCK_BYTES):
                first, last = int(starts[order[a]]), int(ends[a:z].max())
                buffer = self._take_buffer(last - first)
                self._fill(buffer, first)
                here = starts[order[a:z]] - first
                rows = order[a:z]
                samples[rows], good[rows] = decode_packets(buffer, here, ends[a:z] - first, n_samples, bits // 8)
        return samples, good

    def _fill(self, target: np.ndarray, at: int) -> None:
        if self._file is None:
            raise InputError("the strip has no packets")
        read_exactly(self._file.fileno(), target, at)

    def _take_buffer(self, size: int) -> np.ndarray:
        if len(self._buffer) < size:
            self._buffer = np.empty(size, np.uint8)
        return self._buffer[:size]


def _find_runs(ordered: np.ndarray, width: int, gap: int, most: int = 2**62) -> Iterator[tuple[int, int]]:
    """Slices of sorted starts with only small gaps, and at most about so many bytes long."""
    cut = np.diff(ordered) > width + gap
    cut |= np.diff((ordered - ordered[:1]) // most) > 0
    cuts = np.flatnonzero(cut) + 1
    edges = [0, *cuts.tolist(), len(ordered)]
    return zip(edges[:-1], edges[1:], strict=True)


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
        with undoing(self.abort):
            refuse_existing(packet_file, internal or overwrite)
            self._packets = Draft(packet_file, overwrite=overwrite)
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
