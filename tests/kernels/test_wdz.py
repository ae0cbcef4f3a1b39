"""Compressed packets: the C decoder against its slow twin, the twin against lazrs, and damaged bytes."""

import struct

import numpy as np
import pytest
from commands import refuses
from naive_wdz import Decoder, Differences, compress

from wavebatch.kernels.packets import MOST_BYTES, decode_packets


def _pack(rows, bits):
    packets = [compress(row, bits) for row in rows]
    ends = np.cumsum([len(packet) for packet in packets])
    starts = ends - [len(packet) for packet in packets]
    return np.frombuffer(b"".join(packets), np.uint8), starts, ends


def _waveforms(rng, kind, bits, number=12, length=90):
    top = (1 << bits) - 1
    if kind == "noise":
        return rng.integers(0, top + 1, (number, length))
    if kind == "jumps":
        return rng.integers(0, 2, (number, length)) * top
    if kind == "still":
        return np.full((number, length), 3)
    time = np.arange(length)
    pulse = 0.8 * top * np.exp(-0.5 * ((time - rng.uniform(10, 80, (number, 1))) / 3) ** 2)
    return np.clip(np.round(5 + pulse + rng.normal(0, 1, pulse.shape)), 0, top).astype(int)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("kind", ["echoes", "noise", "jumps", "still"])
@pytest.mark.parametrize("length", [1, 2, 90, 700])
def test_samples_come_back(rng, bits, kind, length):
    rows = _waveforms(rng, kind, bits, 4, length)
    data, starts, ends = _pack(rows, bits)
    samples, good = decode_packets(data, starts, ends, length, bits // 8)
    assert good.all() and np.array_equal(samples, rows)
    assert len(data) <= len(rows) * (MOST_BYTES * length + 16)
    # The size is not needed: what follows a packet does not change it.
    samples, good = decode_packets(data, starts, np.full(4, len(data)), length, bits // 8)
    assert good.all() and np.array_equal(samples, rows)


def test_the_twin_decodes_what_lazrs_encodes(tmp_path):
    """The chunk table of LAZ has the same coder: sizes of chunks, differences of 32 bits in the second context."""
    lazrs = pytest.importorskip("lazrs")
    rng, chunk = np.random.default_rng(4), 50
    vlr = lazrs.LazVlr.new_for_compression(1, 0)
    path = tmp_path / "chunks.laz"
    with open(path, "w+b") as file:
        writer = lazrs.LasZipCompressor(file, vlr)
        sizes = []
        for k in range(40):
            count = chunk * (1 + 7 * (k % 3))
            before = file.tell()
            points = np.zeros((count, 28), np.uint8)
            points[:, : 4 * (k % 5)] = rng.integers(0, 255, (count, 4 * (k % 5)))
            writer.compress_many(points.reshape(-1))
            writer.finish_current_chunk()
            sizes.append(file.tell() - before)
        writer.done()
    data = path.read_bytes()
    table = struct.unpack_from("<q", data)[0]
    _, number = struct.unpack_from("<II", data, table)
    decoder, differences, found, last = Decoder(data[table + 8 :] + bytes(8)), Differences(32, 2), [], 0
    for _ in range(number):
        last = differences.decode(decoder, last, 1)
        found.append(last)
    assert sum(found) == table - 8 and len(set(found)) > 5
    assert found[1 : len(sizes)] == sizes[1:]


@pytest.mark.parametrize("bits", [8, 16])
def test_damaged_packets_are_flagged_or_decode_to_something(rng, bits):
    rows = _waveforms(rng, "echoes", bits, 300, 60)
    data, starts, ends = _pack(rows, bits)
    cut, good = decode_packets(data, starts, np.maximum(ends - rng.integers(1, 30, 300), starts), 60, bits // 8)
    assert good.mean() < 0.05 and cut.shape == (300, 60)  # the last bytes of some say nothing
    for _ in range(20):
        hurt = data.copy()
        hurt[rng.integers(0, len(data), 400)] = rng.integers(0, 256, 400)
        samples, good = decode_packets(hurt, starts, ends, 60, bits // 8)
        assert samples.shape == (300, 60) and 0 < good.sum() < 300
    noise = rng.integers(0, 256, 100_000).astype(np.uint8)
    at = rng.integers(0, 99_000, 500)
    decode_packets(noise, at, at + rng.integers(0, 900, 500), 300, bits // 8)


def test_places_outside_the_bytes_are_refused():
    data = np.zeros(100, np.uint8)
    for start, end in ((-1, 50), (0, 101), (60, 50)):
        refuses(ValueError, "inside", decode_packets, data, np.array([start]), np.array([end]), 10, 1)
    refuses(ValueError, "1 or 2", decode_packets, data, np.array([0]), np.array([50]), 10, 4)
