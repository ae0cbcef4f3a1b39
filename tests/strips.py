"""Full-waveform strips made byte by byte, so that any byte can be wrong, and a slow, plain reading of them."""

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import lazrs
import numpy as np
import pytest

from wavebatch.batch.job import StripJob
from wavebatch.batch.options import RunOptions
from wavebatch.core.errors import InputError
from wavebatch.files.las.header import STANDARD_DTYPES, Vlr, read_header
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.choose_chain import Request, widest_chain
from wavebatch.tools.simulate.render import AIR_SPEED, START_TIME, FlightLine, trace_rays

HEADER_SIZES = {3: 235, 4: 375, 5: 393}
TOWARD = np.array([0.02, -0.01, 0.148]) / 1000.0
"""Vector of every pulse toward the sensor [m/ps], 0.9997 of c/2 long or so."""


def voxel_job(strip, *, system=None, force=False, energy=None, **more) -> StripJob:
    """What `voxelize_strip` needs to know of a strip, for any survey of it; more: fields of StripJob."""
    options, request = RunOptions(energy=energy), Request(auto=True, system=system, force=force)
    return StripJob(Path(strip), widest_chain(), options, request=request, **more)


def true_sensor(time: np.ndarray, flight: FlightLine | None = None) -> np.ndarray:
    """Position of the sensor of simulated strips (n, 3) at GPS times (n,)."""
    flight = flight or FlightLine()
    rays = trace_rays(flight, "flat", (time - START_TIME) * flight.pulse_rate)
    return rays.ground - rays.direction / AIR_SPEED * rays.distance[:, None]


def write_positions(path: Path, time: np.ndarray, xyz: np.ndarray, names: str = "time,x,y,z") -> Path:
    """A trajectory as text: times (n,) and positions (n, 3), or (n, 6) with three angles."""
    rows = np.column_stack([time, xyz])
    path.write_text("\n".join([names, *(",".join(f"{value:.6f}" for value in row) for row in rows)]) + "\n")
    return path


def vlr(user: bytes, record_id: int, payload: bytes, reserved: int = 0) -> bytes:
    """A record as it stands in a file."""
    return struct.pack("<H16sHH32s", reserved, user, record_id, len(payload), b"") + payload


def descriptor(index: int, bits=8, samples=32, spacing=1000, gain=1.0, offset=0.0, compression=0) -> bytes:
    """A wave packet descriptor VLR."""
    payload = struct.pack("<BBIIdd", bits, compression, samples, spacing, gain, offset)
    return vlr(b"LASF_Spec", 99 + index, payload)


def record_head(length: int, user: bytes = b"LASF_Spec", record_id: int = 65535, reserved: int = 0) -> bytes:
    """The 60 bytes in front of the packets."""
    return struct.pack("<H16sHQ32s", reserved, user, record_id, length, b"")


@dataclass
class Raw:
    """Everything that goes into a strip; change what should be wrong, then write."""

    points: np.ndarray
    packets: bytes
    """What follows the 60 bytes of the waveform record."""
    point_format: int = 4
    minor: int = 3
    internal: bool = True
    vlrs: list[bytes] = field(default_factory=lambda: [descriptor(1)])
    scales: tuple = (0.001, 0.001, 0.001)
    offsets: tuple = (0.0, 0.0, 0.0)
    encoding: int | None = None
    waveform_start: int | None = None
    evlr: tuple[int, int] | None = None
    count: int | None = None
    legacy: int | None = None
    point_length: int | None = None
    head: bytes | None = None
    behind: bytes = b""
    """Bytes behind the packets."""

    def front(self, extra_vlrs: list[bytes] = (), compressed: bool = False, packets_at: int = 0) -> bytes:
        """Header and VLRs."""
        vlrs = b"".join([*self.vlrs, *extra_vlrs])
        size = HEADER_SIZES[self.minor]
        n = len(self.points) if self.count is None else self.count
        encoding = (2 if self.internal else 4) if self.encoding is None else self.encoding
        legacy = (n if self.minor == 3 else 0) if self.legacy is None else self.legacy
        data = struct.pack(
            "<4sHH16sBB32s32sHHHIIBHI5I12d", b"LASF", 0, encoding, b"", 1, self.minor, b"", b"", 1, 2025, size,
            size + len(vlrs), len(self.vlrs) + len(extra_vlrs), self.point_format | (0x80 if compressed else 0),
            self.point_length or self.points.dtype.itemsize, legacy, *(0,) * 5, *self.scales, *self.offsets, *[0.0] * 6,
        )  # fmt: skip
        start = packets_at if self.waveform_start is None else self.waveform_start
        data += struct.pack("<Q", start if self.internal or self.waveform_start else 0)
        if self.minor >= 4:
            evlr = ((packets_at, 1) if self.internal else (0, 0)) if self.evlr is None else self.evlr
            data += struct.pack("<QIQ15Q", *evlr, n, *(0,) * 15)
        if self.minor >= 5:
            data += struct.pack("<ddH", 0.0, 0.0, 0)
        return data + vlrs

    def write(self, path: Path) -> Path:
        """The strip at `path`; a name that ends in .laz is compressed. External packets go into the .wdp beside it."""
        compressed = path.suffix == ".laz"
        head = record_head(len(self.packets)) if self.head is None else self.head
        if compressed:
            points, extra = self._compress()
        else:
            points, extra = self.points.tobytes(), []
        at = len(self.front(extra, compressed)) + len(points)
        data = self.front(extra, compressed, at) + points
        if self.internal:
            data += head + self.packets + self.behind
        else:
            path.with_suffix(".wdp").write_bytes(head + self.packets + self.behind)
        path.write_bytes(data)
        return path

    def _compress(self) -> tuple[bytes, list[bytes]]:
        """Points as lazrs writes them, with the offset of the chunk table right for this file."""
        length = self.points.dtype.itemsize - STANDARD_DTYPES[self.point_format].itemsize
        laz = lazrs.LazVlr.new_for_compression(self.point_format, length)
        extra = [vlr(b"laszip encoded", 22204, bytes(laz.record_data()))]
        target = io.BytesIO()
        target.write(self.front(extra, True))
        begin = target.tell()
        compressor = lazrs.LasZipCompressor(target, laz)
        compressor.compress_many(np.ascontiguousarray(self.points).view(np.uint8))
        compressor.done()
        return target.getvalue()[begin:], extra


def make_raw(
    n_packets: int = 40,
    *,
    seed: int = 1,
    n_samples: int = 32,
    bits: int = 8,
    point_format: int = 4,
    minor: int | None = None,
    internal: bool = True,
    toward: bool = True,
    most_returns: int = 3,
    first_offset: int = 60,
) -> Raw:
    """A strip of pulses with 1 to `most_returns` returns each, one packet per pulse, of one descriptor."""
    rng = np.random.default_rng(seed)
    returns = rng.integers(1, most_returns + 1, n_packets)
    pulse = np.repeat(np.arange(n_packets), returns)
    samples = rng.integers(0, 1 << min(bits, 12), (n_packets, n_samples)).astype(f"<u{bits // 8}")
    width = samples.dtype.itemsize * n_samples
    points = np.zeros(len(pulse), STANDARD_DTYPES[point_format])
    number = np.concatenate([np.arange(k) for k in returns])
    location = np.float32(3000 + 9000 * number + rng.integers(0, 2000, len(pulse)))
    start = np.stack([pulse * 0.5, np.zeros(len(pulse)), np.full(len(pulse), 500.0)], axis=1)
    xyz = start - location[:, None].astype(float) * TOWARD
    for axis, name in enumerate("XYZ"):
        points[name] = np.rint(xyz[:, axis] / 0.001)
    points["bit_fields"] = number + 1
    points["gps_time"] = 1000.0 + pulse * 1e-5
    points["wavepacket_index"] = 1
    points["wavepacket_offset"] = first_offset + pulse * width
    points["wavepacket_size"] = width
    points["return_point_wave_location"] = location
    for axis, name in enumerate(("x_t", "y_t", "z_t")):
        points[name] = TOWARD[axis] if toward else -TOWARD[axis]
    minor = minor or (3 if point_format < 9 else 4)
    packets = bytes(first_offset - 60) + samples.tobytes()
    return Raw(points, packets, point_format, minor, internal, [descriptor(1, bits=bits, samples=n_samples)])


def add_record(path: Path, record: Vlr) -> None:
    """Puts a record before those that the header of a LAS file has."""
    content = bytearray(path.read_bytes())
    size = struct.unpack_from("<H", content, 94)[0]
    new = vlr(record.user_id, record.record_id, record.payload)
    places = [("<I", 96)] + [("<Q", place) for place in (227, 235) if place < size]
    for kind, place in places:  # points, packets and extended records move
        (start,) = struct.unpack_from(kind, content, place)
        struct.pack_into(kind, content, place, start + len(new) if start else 0)
    struct.pack_into("<I", content, 100, struct.unpack_from("<I", content, 100)[0] + 1)
    path.write_bytes(content[:size] + new + content[size:])


def place_header(path: Path, change: Callable[[np.ndarray], object], target: Path | None = None) -> Path:
    """The file, or a copy, with other scales, offsets (x, y, z) and bounds (most and least of x, y, z), f8 (12,)."""
    content = bytearray(path.read_bytes())
    content[131:227] = np.array(change(np.frombuffer(bytes(content[131:227]), "<f8")), "<f8").tobytes()
    target = target or path
    target.write_bytes(content)
    return target


def take_turns(path: Path, edit_points: Callable) -> Path:
    """Gives the pulses one of two equal digitizers in turn: blocks have them in another order than the file."""

    def change(points: np.ndarray) -> None:
        points["wavepacket_index"] *= 1 + np.unique(points["gps_time"], return_inverse=True)[1].astype(np.uint8) % 2

    edit_points(path, path, change)
    (first,) = [vlr for vlr in read_header(path).vlrs if vlr.record_id == 100]
    add_record(path, replace(first, record_id=101))
    return path


def cut_strip(source: Path, target: Path, points: int) -> Path:
    """A copy of a LAS file with its first points only; all its packets stay."""
    header = read_header(source)
    data = bytearray(source.read_bytes())
    if data[25] >= 4:
        struct.pack_into("<Q", data, 247, points)
    if struct.unpack_from("<I", data, 107)[0]:
        struct.pack_into("<I", data, 107, points)
    left_out = (header.point_count - points) * header.point_length
    end = header.offset_to_points + header.point_count * header.point_length
    for place in (227, 235)[: data[25] - 2]:  # of the packets in the file, and of EVLRs
        if at := struct.unpack_from("<Q", data, place)[0]:
            struct.pack_into("<Q", data, place, at - left_out)
    del data[end - left_out : end]
    if source.with_suffix(".wdp").exists():
        target.with_suffix(".wdp").write_bytes(source.with_suffix(".wdp").read_bytes())
    target.write_bytes(data)
    return target


def read_plainly(points: np.ndarray, data: bytes, kinds: dict[int, tuple[int, int]]) -> dict:
    """Packets by (descriptor, offset): their samples and the indices of their points; one point at a time.

    data: bytes that offsets count in. kinds: bits and samples by descriptor.
    """
    packets: dict = {}
    for index, point in enumerate(points):
        kind, offset, size = (int(point[f"wavepacket_{name}"]) for name in ("index", "offset", "size"))
        if kind == 0 or size == 0:
            continue
        if (kind, offset) in packets:
            packets[kind, offset][1].append(index)
            continue
        bits, n = kinds[kind]
        n = min(n, size * 8 // bits)
        samples = np.frombuffer(data[offset : offset + n * bits // 8], f"<u{bits // 8}")
        packets[kind, offset] = (samples, [index])
    return packets


def assert_same(found: dict, plain: dict) -> None:
    """Packets of `read_all` have the samples and points of those of `read_plainly`."""
    assert found.keys() == plain.keys()
    for key, (samples, members) in plain.items():
        np.testing.assert_array_equal(found[key][0], samples)
        assert found[key][1] == members


def refused(path: Path, pattern: str) -> None:
    """The strip must be refused in one line that begins with its path and holds the pattern."""
    with pytest.raises(InputError, match=pattern) as caught, StripReader(path) as reader:
        reader.scan()
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text, text


def read_all(path: Path, *, size: int = 7, owned_only: bool = True, **options) -> dict:
    """Packets by (descriptor, owner's offset) as StripReader gives them: samples, point indices, origin, direction."""
    found: dict = {}
    with StripReader(path, **options) as reader, reader.scan() as scan:
        for number in range(reader.unit_count()):
            unit = reader.read_unit(number, scan)
            for block, rows in reader.read_blocks(unit, size, owned_only):
                ends = np.searchsorted(block.returns.waveform, np.arange(len(block) + 1))
                for row in range(len(block)):
                    key = (int(unit.packets.digitizer[rows[row]]), int(unit.packets.offset[rows[row]]))
                    members = block.returns.point[ends[row] : ends[row + 1]].tolist()
                    entry = (block.samples[row], members, block.origin[row], block.direction[row])
                    if owned_only:
                        assert key not in found, f"packet {key} came twice"
                    found.setdefault(key, entry)
                    assert found[key][1] == members
    return found
