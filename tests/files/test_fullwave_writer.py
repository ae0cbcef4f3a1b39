"""Full-waveform strips: what was handed in is in the file, by both readers and by the bytes."""

import os

import laspy
import numpy as np
import pytest
from commands import refuses
from writer_tools import BACKENDS, random_points, read_raw, write_strip

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.las.header import ExtraRecord, find_evlrs, read_header
from wavebatch.files.strip.packets import FullwaveWriter

FORMATS = [(4, "1.3"), (5, "1.3"), (4, "1.4"), (5, "1.4"), (9, "1.4"), (10, "1.4"), (9, "1.5"), (10, "1.5")]
ONE = (Digitizer(1, 8, 80, 1.0),)


def packet_file(path):
    """Bytes of the file that holds the packets, and where their record begins in it."""
    header = read_header(path)
    if header.global_encoding & 0b100:
        assert header.waveform_start == 0 and not header.global_encoding & 0b10
        return path.with_suffix(".wdp").read_bytes(), 0
    assert header.global_encoding & 0b10
    return path.read_bytes(), header.waveform_start


@pytest.mark.parametrize(("point_format", "version"), FORMATS)
@pytest.mark.parametrize("internal", [True, False])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_points_and_packets_come_back(tmp_path, point_format, version, internal, suffix):
    path = tmp_path / f"strip{suffix}"
    bits = {1: 8, 5: 16, 200: 32}
    digitizers = [Digitizer(index, n, 10 * index, 0.5 * index, 0.25, -1.0) for index, n in bits.items()]
    rng = np.random.default_rng(5)
    samples = {index: rng.integers(0, 1 << n, (7, 10 * index), f"u{n // 8}") for index, n in bits.items()}
    options = {"internal": internal, "digitizers": digitizers, "scales": (0.1, 0.2, 0.5), "offsets": (1, 2, 3)}
    with FullwaveWriter(path, version=version, point_format=point_format, wkt="WKT", **options) as writer:
        points = random_points(writer.dtype, 21)
        for row, (index, values) in enumerate(samples.items()):
            mine = slice(7 * row, 7 * row + 7)
            points["wavepacket_index"][mine] = index
            points["wavepacket_offset"][mine] = writer.write_packets(values, index)
            points["wavepacket_size"][mine] = values[0].nbytes
            writer.write_points(points[mine])
        writer.commit()
    for backend in BACKENDS:
        assert read_raw(path, backend).tobytes() == points.tobytes()
    data, base = packet_file(path)
    for point, values in zip(points, (row for v in samples.values() for row in v), strict=True):
        at = base + int(point["wavepacket_offset"])
        assert data[at : at + int(point["wavepacket_size"])] == values.tobytes()
    assert int(points["wavepacket_offset"][0]) == 60
    assert data[base + 2 : base + 11] == b"LASF_Spec" and data[base + 18 : base + 20] == b"\xff\xff"
    assert int.from_bytes(data[base + 20 : base + 28], "little") == sum(v.nbytes for v in samples.values())
    with laspy.open(path, laz_backend=laspy.LazBackend.Laszip, read_evlrs=False) as reader:
        header = reader.header
    described = {vlr.record_id - 99: vlr.parsed_record for vlr in header.vlrs.get("WaveformPacketVlr")}
    for digitizer in digitizers:
        record = described[digitizer.index]
        assert (record.bits_per_sample, record.number_of_samples) == (digitizer.bits, digitizer.n_samples)
        assert record.temporal_sample_spacing == round(digitizer.spacing * 1000)
        assert (record.digitizer_gain, record.digitizer_offset) == (0.25, -1.0)
    assert header.vlrs.get("WktCoordinateSystemVlr")[0].string == "WKT"
    assert header.global_encoding.wkt == (version != "1.3")
    assert sorted(os.listdir(tmp_path)) == [path.name] + ["strip.wdp"] * (not internal)
    found, _ = find_evlrs(path, read_header(path))
    assert len(found) == (internal and version != "1.3") and (not found or found[0].start == base)


def test_vectors_are_turned_round_where_asked(tmp_path):
    for name, toward, sign in (("a", True, 1), ("b", False, -1)):
        points = write_strip(tmp_path / f"{name}.las", toward=toward)
        seen = read_raw(tmp_path / f"{name}.las")
        for axis in ("x_t", "y_t", "z_t"):
            np.testing.assert_array_equal(seen[axis], sign * points[axis])
        np.testing.assert_array_equal(seen["return_point_wave_location"], points["return_point_wave_location"])


def test_vendor_like_extra_bytes(tmp_path):
    records = [ExtraRecord.build("Amplitude", "u2", "Echo signal amplitude [dB]", scale=0.01)]
    write_strip(tmp_path / "a.laz", extra_bytes=records)
    with laspy.open(tmp_path / "a.laz", read_evlrs=False) as reader:
        points = reader.read_points(-1)
    raw = points.array["Amplitude"]
    np.testing.assert_allclose(np.array(points["Amplitude"]), raw * 0.01)
    struct = reader.header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs[0]
    assert (struct._raw_min()[0], struct._raw_max()[0]) == (raw.min(), raw.max())


def test_the_same_bytes_every_time(tmp_path):
    for name in ("a", "b"):
        write_strip(tmp_path / f"{name}.laz", internal=False)
    for suffix in (".laz", ".wdp"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.parametrize("internal", [True, False])
def test_a_strip_without_anything(tmp_path, internal):
    with FullwaveWriter(tmp_path / "a.laz", point_format=9, internal=internal, digitizers=ONE) as writer:
        assert len(writer.write_packets(np.zeros((0, 80), np.uint8), 1)) == 0
        writer.write_points(np.zeros(0, writer.dtype))
        writer.commit()
    for backend in BACKENDS:
        assert len(read_raw(tmp_path / "a.laz", backend)) == 0
    assert read_header(tmp_path / "a.laz").mins == (0.0, 0.0, 0.0)


def test_packets_shorter_than_their_descriptor_and_wider_numbers(tmp_path):
    with FullwaveWriter(tmp_path / "a.las", point_format=9, internal=False, digitizers=ONE) as writer:
        first = writer.write_packets(np.full((2, 30), 255), 1)
        second = writer.write_packets(np.ones((1, 80), np.uint32), 1)
        writer.commit()
    assert (first.dtype, first.tolist(), second.tolist()) == (np.uint64, [60, 90], [120])
    assert (tmp_path / "a.wdp").read_bytes()[60:] == b"\xff" * 60 + b"\x01" * 80


@pytest.mark.parametrize(
    "samples",
    [*(np.full((1, 80), value) for value in (256, -1, 0.5)), np.zeros((1, 81), "u1"), np.zeros(80, "u1")],
)
def test_samples_that_do_not_fit_are_refused(tmp_path, samples):
    with (
        FullwaveWriter(tmp_path / "a.las", point_format=9, internal=True, digitizers=ONE) as writer,
        pytest.raises(ConfigError, match="samples"),
    ):
        writer.write_packets(samples, 1)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"version": "1.3", "point_format": 9}, "LAS 1.3 has no waveforms in point format 9; choose format 4 or 5"),
        ({"version": "1.5", "point_format": 4}, "no waveforms in point format 4; .* 9 or 10 for 1.5"),
        ({"point_format": 6}, "has no waveforms in point format 6"),
        ({"version": "1.x"}, "LAS 1.x has no waveforms in"),
        ({"digitizers": ()}, "digitizers need different indices from 1 to 255, got"),
        ({"digitizers": ONE * 2}, "digitizers need different indices"),
        ({"digitizers": [Digitizer(0, 8, 10, 1.0)]}, "from 1 to 255"),
        ({"digitizers": [Digitizer(1, 12, 10, 1.0)]}, "has 12 bits, not 8, 16 or 32"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path, options, message):
    options = {"point_format": 9, "internal": True, "digitizers": ONE, **options}
    refuses(ConfigError, message, FullwaveWriter, tmp_path / "a.las", **options)
    with pytest.raises(ConfigError, match="must end in .las or .laz"):
        FullwaveWriter(tmp_path / "a.xyz", point_format=9, internal=True, digitizers=ONE)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("existing", ["a.las", "a.wdp"])
def test_nothing_is_replaced_unless_asked(tmp_path, existing):
    (tmp_path / existing).write_bytes(b"old")
    refuses(InputError, f"{existing}: exists already", write_strip, tmp_path / "a.las", internal=False)
    assert os.listdir(tmp_path) == [existing] and (tmp_path / existing).read_bytes() == b"old"
    points = write_strip(tmp_path / "a.las", internal=False, overwrite=True)
    assert read_raw(tmp_path / "a.las").tobytes() == points.tobytes()


def test_a_strip_that_appears_meanwhile_is_kept(tmp_path):
    with FullwaveWriter(tmp_path / "a.las", point_format=9, internal=False, digitizers=ONE) as writer:
        (tmp_path / "a.las").write_bytes(b"other")
        refuses(InputError, "a.las: exists already", writer.commit)
    assert os.listdir(tmp_path) == ["a.las"] and (tmp_path / "a.las").read_bytes() == b"other"
