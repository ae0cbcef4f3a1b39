"""Points of any LAS and LAZ file, and the echoes of clouds."""

import io
import json
import os
import pickle
import struct
from concurrent.futures import ThreadPoolExecutor

import laspy
import lazrs
import numpy as np
import pytest
from commands import refuses
from numpy.lib import recfunctions
from strips import make_raw, refused
from writer_tools import BACKENDS, data_file, read_raw, write_points

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import CLOUD_DTYPE, RETURN_DTYPE, CloudReader, ColumnReader, read_cloud
from wavebatch.files.disk import raw_bytes
from wavebatch.files.disk.raw_bytes import hiding_failures
from wavebatch.files.las import read_points
from wavebatch.files.las.header import ExtraRecord, LasHeader, build_dtype, read_header
from wavebatch.files.las.read_points import open_points, read_checked_header
from wavebatch.files.las.write_points import CHUNK_POINTS, PointFile, Statistics, compress_rows
from wavebatch.files.strip.reader import StripReader
from wavebatch.tools.simulate import simulate_strip


def read(path, *ranges):
    source = open_points(read_checked_header(path))
    try:
        return [source.read(start, stop) for start, stop in ranges]
    finally:
        source.close()


def laz_of(tmp_path, point_format=4, chunk=50, n=60, variable=False):
    """A LAZ strip of small chunks."""
    raw = make_raw(n, point_format=point_format)
    path = raw.write(tmp_path / "a.laz")
    data = path.read_bytes()
    at = data.index(b"laszip encoded") - 2
    begin = struct.unpack_from("<I", data, 96)[0]
    payload = bytearray(data[at + 54 : begin])
    payload[12:16] = struct.pack("<I", 2**32 - 1 if variable else chunk)
    with open(path, "wb") as file:
        file.write(data[: at + 54] + bytes(payload))
        compressor = lazrs.LasZipCompressor(file, lazrs.LazVlr(bytes(payload)))
        for start in range(0, len(raw.points), chunk):
            compressor.compress_many(raw.points[start : start + chunk].view(np.uint8))
            if variable:
                compressor.finish_current_chunk()
        compressor.done()
        file.seek(0, 2)
        record = file.tell()
        file.write(struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, len(raw.packets), b"") + raw.packets)
        file.seek(227)
        file.write(struct.pack("<Q", record))
    return raw, path


@pytest.mark.parametrize("point_format", [4, 5, 9, 10])
@pytest.mark.parametrize("variable", [False, True])
def test_any_range_of_chunks_is_the_points_that_were_written(tmp_path, point_format, variable):
    raw, path = laz_of(tmp_path, point_format, variable=variable)
    n = len(raw.points)
    ranges = [(0, n), (0, 10), (10, 20), (40, 60), (3, 117), (100, 100), (7, 9), (n - 1, n)]
    for (start, stop), rows in zip(ranges, read(path, *ranges), strict=True):
        assert rows.tobytes() == raw.points[start:stop].tobytes()
        assert rows.flags.writeable


@pytest.mark.parametrize("name", ["fullwave", "pdrf4-1.3", "pdrf5-1.3", "pdrf9-1.4", "pdrf10-1.4"])
def test_real_laz_files_are_read_as_laspy_reads_them(name):
    path = data_file(f"no-packets/{name}.laz")
    expected = read_raw(path)
    (rows,) = read(path, (0, len(expected)))
    assert rows.tobytes() == expected.tobytes()
    assert rows.dtype.names[:8] == expected.dtype.names[:8]


def test_the_coding_of_las_1_5_is_one_line_with_a_remedy():
    path = data_file("no-packets/pdrf9-1.5.laz")
    refuses(InputError, r"pdrf9-1.5.laz: has the compression of LAS 1.5.* laszip -i IN.laz", StripReader, path)


def patch(path, at, data):
    content = bytearray(path.read_bytes())
    at = at if at >= 0 else len(content) + at
    content[at : at + len(data)] = data
    path.write_bytes(content)
    return path


def payload_at(path):
    return path.read_bytes().index(b"laszip encoded") - 2 + 54


@pytest.mark.parametrize(("at", "data", "pattern"), [
    (-52, b"other", "missing or wrong"),
    (0, struct.pack("<H", 1), "without chunks"),
    (2, struct.pack("<H", 7), "missing or wrong"),
    (12, struct.pack("<I", 0), "without chunks"),
    (12, struct.pack("<I", 2**31), "do not fit into memory"),
    (12, struct.pack("<I", 7), "LAZ chunks hold"),
    (32, struct.pack("<H", 0), "missing or wrong"),
    (32, struct.pack("<H", 9999), "missing or wrong"),
    (34, struct.pack("<H", 10), "missing or wrong"),
    (36, struct.pack("<H", 65535), "missing or wrong"),
    (38, struct.pack("<H", 77), "compression of LAS 1.5"),
])  # fmt: skip
def test_lies_of_the_laszip_record(tmp_path, at, data, pattern):
    _, path = laz_of(tmp_path)
    refused(patch(path, payload_at(path) + at, data), pattern)


@pytest.mark.parametrize("place", [0, 1, -2, 2**62, -(2**63)])
def test_a_chunk_table_that_is_not_there(tmp_path, place):
    _, path = laz_of(tmp_path)
    begin = struct.unpack_from("<I", path.read_bytes(), 96)[0]
    refused(patch(path, begin, struct.pack("<q", place)), "table of LAZ chunks")


@pytest.mark.parametrize("count", [0, 1, 2**31, 2**32 - 1])
def test_a_chunk_table_that_lies_about_its_length(tmp_path, count):
    _, path = laz_of(tmp_path)
    data = path.read_bytes()
    table = struct.unpack_from("<q", data, struct.unpack_from("<I", data, 96)[0])[0]
    refused(patch(path, table + 4, struct.pack("<I", count)), "chunk")


def test_a_chunk_table_at_the_end_of_a_streamed_file(tmp_path):
    raw = make_raw(60, internal=False)
    path = raw.write(tmp_path / "a.laz")
    data = path.read_bytes()
    begin = struct.unpack_from("<I", data, 96)[0]
    streamed = data[:begin] + struct.pack("<q", -1) + data[begin + 8 :] + data[begin : begin + 8]
    path.write_bytes(streamed)
    assert read(path, (0, len(raw.points)))[0].tobytes() == raw.points.tobytes()


def test_layers_that_claim_more_than_their_chunk_holds(tmp_path):
    _, path = laz_of(tmp_path, 9)
    begin = struct.unpack_from("<I", path.read_bytes(), 96)[0]
    refused(patch(path, begin + 8 + 59 + 4, struct.pack("<I", 2**32 - 1)), "a LAZ chunk of .* claims")


@pytest.mark.parametrize("cut", [0.3, 0.6, 0.9, 0.999])
@pytest.mark.parametrize("point_format", [4, 10])
def test_cut_laz_files(tmp_path, cut, point_format):
    _, path = laz_of(tmp_path, point_format)
    data = path.read_bytes()
    begin = struct.unpack_from("<I", data, 96)[0]
    table = struct.unpack_from("<q", data, begin)[0]
    path.write_bytes(data[: int(begin + (table + 8 - begin) * cut)])
    refused(path, "LAZ chunks|waveform record at byte")


def test_a_chunk_that_does_not_fit_memory_is_refused(tmp_path):
    """All points in one chunk of half a gigabyte, by the table."""
    raw, path = laz_of(tmp_path, variable=True)
    data, at = path.read_bytes(), payload_at(path)
    begin = struct.unpack_from("<I", data, 96)[0]
    with open(path, "r+b") as file:
        file.seek(struct.unpack_from("<q", data, begin)[0])
        lazrs.write_chunk_table(file, [(len(raw.points), 2**29)], lazrs.LazVlr(data[at:begin]))
    refused(path, "chunks are too large|table of LAZ chunks")


RECORDS = [ExtraRecord.build("width", "<f4", "a test", no_data=-9999.0)]


def make_rows(point_format, n, seed=0):
    rng = np.random.default_rng(seed)
    dtype = build_dtype(point_format, RECORDS)
    rows = rng.integers(0, 256, (n, dtype.itemsize), dtype=np.uint8).view(dtype)[:, 0]
    for axis in "XYZ":
        rows[axis] = np.cumsum(rng.integers(-50, 60, n))
    if "gps_time" in dtype.names:
        rows["gps_time"] = np.arange(n) * 1e-5
    rows[dtype.names[-1]] = rng.normal(0, 1, n)
    if point_format in (9, 10):
        rows["classification_flags"] &= 0b11001111
    return rows


def open_file(target, point_format):
    version = (1, 4) if point_format > 5 else (1, 3)
    header = LasHeader.new(version, point_format, (0.01,) * 3, (0.0,) * 3)
    return PointFile(target, header, build_dtype(point_format, RECORDS), RECORDS, overwrite=True)


@pytest.mark.quick_cases("100017-6", "50000-8", "1-*", "0-*")
@pytest.mark.parametrize("point_format", [0, 1, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("n", [0, 1, CHUNK_POINTS, 2 * CHUNK_POINTS + 17])
def test_rows_become_the_chunks_that_lazrs_writes(tmp_path, point_format, n):
    rows = make_rows(point_format, n)
    for pieces in 1, 11:
        with open_file(tmp_path / f"{pieces}.laz", point_format) as file:
            for part in np.array_split(rows.copy(), pieces):
                file.write(part)
                part[:] = 0  # who writes may use the array again
            file.commit()
    assert (tmp_path / "1.laz").read_bytes() == (tmp_path / "11.laz").read_bytes()
    expected = io.BytesIO()
    header = read_header(tmp_path / "1.laz")
    coding = next(vlr.payload for vlr in header.vlrs if vlr.record_id == 22204)
    compressor = lazrs.LasZipCompressor(expected, lazrs.LazVlr(coding))
    compressor.compress_many(rows.view(np.uint8))
    compressor.done()
    made = (tmp_path / "1.laz").read_bytes()[header.offset_to_points :]
    if n:  # lazrs writes a chunk without points
        # The place of the table is in front: from the start of the file, and of the points.
        assert made[8:] == expected.getvalue()[8:]
        place = struct.unpack_from("<q", made)[0] - header.offset_to_points
        assert place == struct.unpack_from("<q", expected.getvalue())[0]
    for backend in BACKENDS:
        assert read_raw(tmp_path / "1.laz", backend).tobytes() == rows.tobytes()


@pytest.mark.quick_cases("1", "10")
@pytest.mark.parametrize("point_format", [1, 5, 6, 10])
def test_chunks_from_elsewhere_are_joined_to_the_same_file(tmp_path, point_format):
    """As from workers: compressed in any order, pickled on their way."""
    rows = make_rows(point_format, 2 * CHUNK_POINTS + 17)
    parts = np.split(rows, [CHUNK_POINTS, 2 * CHUNK_POINTS])
    packed = [pickle.dumps(compress_rows(part, point_format)) for part in reversed(parts)]
    with open_file(tmp_path / "a.laz", point_format) as file, open_file(tmp_path / "b.laz", point_format) as whole:
        for part, chunk in zip(parts, reversed(packed), strict=True):
            statistics = Statistics(rows.dtype, RECORDS)
            statistics.add(part)
            file.statistics.join(statistics)
            file.append(pickle.loads(chunk))
        whole.write(rows)
        file.commit()
        whole.commit()
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
    for backend in BACKENDS:
        with laspy.open(tmp_path / "a.laz", laz_backend=backend) as reader:
            reader.seek(CHUNK_POINTS - 5)
            assert reader.read_points(40).array.tobytes() == rows[CHUNK_POINTS - 5 : CHUNK_POINTS + 35].tobytes()


@pytest.mark.parametrize("counts", [[3, 1], [CHUNK_POINTS + 1]])
def test_chunks_of_another_number_of_points_are_refused(tmp_path, counts):
    """lazrs 0.8 seeks the wrong points in a file of such chunks."""
    with open_file(tmp_path / "a.laz", 1) as file, pytest.raises(ValueError, match="only the last LAZ chunk"):
        for count in counts:
            file.append(compress_rows(make_rows(1, CHUNK_POINTS), 1)._replace(points=count))


def test_chunks_of_one_scanner_channel_each_are_written_and_others_refused(tmp_path):
    rows = make_rows(9, CHUNK_POINTS + 100)
    rows["classification_flags"][CHUNK_POINTS:] |= 1 << 4
    with open_file(tmp_path / "a.laz", 9) as file:
        file.write(rows)
        file.commit()
    for backend in BACKENDS:
        assert read_raw(tmp_path / "a.laz", backend).tobytes() == rows.tobytes()
    refuses(InputError, "several scanner channels", compress_rows, rows[-200:], 9)


def test_rows_of_another_layout_are_refused(tmp_path):
    with open_file(tmp_path / "a.laz", 6) as file:
        other = recfunctions.drop_fields(make_rows(6, 3), "X")
        refuses(InputError, "another layout", file.write, other)


def _panic(*_):
    os.write(2, b"thread '<unnamed>' panicked at decoders.rs:171: index out of bounds\n")
    raise type("PanicException", (BaseException,), {})("index out of bounds")


def test_a_panic_of_the_decoder_is_one_line_and_says_nothing_itself(tmp_path, monkeypatch, capfd):
    path = tmp_path / "a.laz"
    with open_file(path, 1) as file:
        file.write(make_rows(1, 10))
        file.commit()
    monkeypatch.setattr(read_points.lazrs, "decompress_points", _panic)
    with CloudReader(path) as reader, pytest.raises(InputError, match="cannot be decompressed .index out of bounds.;"):
        list(reader.read_pieces())
    assert capfd.readouterr().err == ""


def test_what_others_write_to_stderr_while_points_are_decoded_is_not_lost(capfd):
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(KeyError), hiding_failures():
        os.write(2, b"from another thread\n")
        raise KeyError
    with ThreadPoolExecutor() as pool:
        pool.submit(_write_hidden).result()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "from another thread\nin a thread\nafter\n"
    assert len(os.listdir("/proc/self/fd")) == files


def _write_hidden():
    with hiding_failures():
        os.write(2, b"in a thread\n")


def test_an_interrupt_while_stderr_is_taken_gives_it_back(monkeypatch, capfd):
    def interrupt(held):
        raw_bytes_hold(held)
        raise KeyboardInterrupt

    raw_bytes_hold = raw_bytes._hold_stderr
    monkeypatch.setattr(raw_bytes, "_hold_stderr", interrupt)
    with pytest.raises(KeyboardInterrupt), hiding_failures():
        pass
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"


def test_a_missing_file_and_a_folder(tmp_path):
    refused(tmp_path / "none.las", "cannot be read: No such file")
    refused(tmp_path, "cannot be read: it is a folder, a pipe or a device")


LIES = [
    *((25, "B", minor, text) for minor, text in ((2, "version 1.2 has no waveforms"), (6, "version 1.6"))),
    *((104, "B", number, f"point format {number} has no waveforms") for number in (0, 1, 3, 6, 7, 8, 11, 63)),
    (104, "B", 9, "needs LAS 1.4"),
    (105, "<H", 56, "too short for format 4"),
    *((107, "<I", count, f"claims {count} points") for count in (53_000, 2**32 - 1)),
    *((96, "<I", offset, "but points at byte") for offset in (0, 10, 226, 2**32 - 1)),
    *((94, "<H", size, "but points at byte|VLR") for size in (0, 100, 234, 65535)),
    *((100, "<I", count, "VLR") for count in (2, 1000, 2**32 - 1)),
    (235 + 20, "<H", 65535, "VLR 0 of 1"),
    *((139, "<d", scale, "scale .* of y") for scale in (0.0, float("nan"), float("inf"))),
    (171, "<d", float("nan"), "offset nan of z"),
]
"""Place, form and value of a field of the header, and what is said of it."""


@pytest.mark.parametrize(("at", "form", "value", "pattern"), LIES)
def test_lies_of_the_header(tmp_path, at, form, value, pattern):
    refused(patch(make_raw().write(tmp_path / "a.las"), at, struct.pack(form, value)), pattern)


@pytest.mark.parametrize(("made", "name", "changes", "pattern"), [
    ({"point_format": 9}, "a.laz", {"count": 2**60}, "the header claims 1152921504606846976 points in"),
    ({}, "a.las", {"count": 1 + len(make_raw().points)}, "waveform record begins at byte"),
    ({"point_format": 9, "internal": False}, "a.las", {"behind": bytes(100), "evlr": (1000, 1)},
     "EVLRs begin at byte 1000"),
])  # fmt: skip
def test_points_that_cannot_be_there_are_refused(tmp_path, made, name, changes, pattern):
    """More than any compression holds, or where packets or extended records are."""
    raw = make_raw(**made)
    for field, value in changes.items():
        setattr(raw, field, value)
    refused(raw.write(tmp_path / name), pattern)


@pytest.mark.parametrize(("internal", "before"), [(True, "its waveform record begins"), (False, "it ends")])
def test_points_beyond_the_number_in_the_header_are_named(tmp_path, internal, before):
    """3 of them were lost without a word."""
    raw = make_raw(internal=internal)
    raw.count = len(raw.points) - 3
    with StripReader(raw.write(tmp_path / "a.las")) as reader:
        (line,) = reader.facts.warnings
    assert f"claims {raw.count} points, which leaves room for 3 more before {before}; what is there is not read" in line


@pytest.mark.parametrize("count", [0, 1, 2**64 - 1])
def test_counts_of_1_4(tmp_path, count):
    raw = make_raw(point_format=4, minor=4)
    raw.count, raw.legacy = count, len(raw.points)
    path = raw.write(tmp_path / "a.las")
    if count > 1:
        refused(path, "claims 18446744073709551615 points")
        return
    with StripReader(path) as reader, reader.scan() as scan:
        assert scan.points == (count or len(raw.points))
        assert "legacy point count" in reader.facts.warnings[-1]


def test_a_front_that_does_not_fit_memory(tmp_path):
    path = patch(make_raw().write(tmp_path / "a.las"), 96, struct.pack("<I", 1 << 27))
    os.truncate(path, 1 << 28)  # a hole, which takes no room on the disk
    refused(path, r"header with 1 VLRs in .* bytes \(at most")


def test_unexplained_extra_bytes_are_kept(tmp_path):
    raw = make_raw()
    wide = np.zeros(len(raw.points), [*raw.points.dtype.descr, ("x", "u1", (3,))])
    for name in raw.points.dtype.names:
        wide[name] = raw.points[name]
    wide["x"] = 7
    raw.points = wide
    with StripReader(raw.write(tmp_path / "a.las")) as reader:
        assert [record.name for record in reader.facts.records] == ["ExtraBytes"]
        assert (reader.read_points(0, 3)["ExtraBytes"] == 7).all()


def write_cloud(path, point_format, n=300, extra=()):
    """A cloud of random points; extra: names of f4 dimensions."""
    rng = np.random.default_rng(point_format)
    xyz = [5.0, 6.0, 7.0] + 0.01 * rng.integers(-1000, 1000, (n, 3))
    return write_points(path, xyz, point_format=point_format, scale=0.01, offsets=(5, 6, 7),
                        extra=[(name, "f4") for name in extra],
                        intensity=rng.integers(0, 65535, n), **{name: rng.random(n) for name in extra})  # fmt: skip


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_clouds_of_every_format_without_waveforms_are_read(tmp_path, point_format, suffix):
    path = tmp_path / f"a{suffix}"
    cloud = write_cloud(path, point_format, extra=("amplitude",))
    with CloudReader(path) as reader:
        assert reader.columns == ("amplitude",) and reader.has_gps_time == (point_format not in (0, 2))
        pieces = list(reader.read_pieces(70))
    rows = np.concatenate(pieces)
    assert [len(piece) for piece in pieces] == [70, 70, 70, 70, 20]
    assert np.allclose(rows["xyz"], np.stack([cloud.x, cloud.y, cloud.z], axis=1), atol=1e-9)
    assert np.array_equal(rows["amplitude"], cloud.points.array["amplitude"])
    assert np.array_equal(rows["intensity"], cloud.points.array["intensity"])


def test_extra_bytes_that_are_no_column_of_that_name_are_left_alone(tmp_path):
    """A vector called amplitude, flags that are numbers, a scale that is none: no data, no warning."""
    extra = [("amplitude", "3f4"), ("echo_flags", "f4"), ("pulse width", "u2", None, 1e308), ("range_err", "f8")]
    raw = [("echo_flags", [np.nan, 1e30, -1]), ("pulse width", 5), ("range_err", [1e300, np.inf, 0.25])]
    write_points(tmp_path / "a.las", np.zeros((3, 3)), extra=extra, raw=raw)
    with CloudReader(tmp_path / "a.las") as reader:
        assert reader.columns == ("echo_width", "range_err")
        (rows,) = reader.read_pieces()
    assert not rows["flags"].any() and np.isnan(rows["amplitude"]).all() and np.isnan(rows["echo_width"]).all()
    assert np.array_equal(rows["range_err"], np.float32([np.nan, np.nan, 0.25]), equal_nan=True)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_packet_vectors_that_are_no_numbers_are_none(tmp_path, value):
    raw = make_raw(100, point_format=10)
    raw.points["y_t"][::3] = value
    with CloudReader(raw.write(tmp_path / "a.las")) as reader:
        (rows,) = reader.read_pieces()
    damaged = ~np.isfinite(raw.points["y_t"][raw.points["wavepacket_index"] != 0])
    assert damaged.any() and not rows["ray"][damaged].any() and rows["ray"][~damaged].all()


def write_renamed(path, types, columns):
    """A cloud with an account of the run that names `columns`, whose extra bytes are of `types`."""
    account = laspy.VLR("wavebatch", 1, record_data=json.dumps({"columns": columns}).encode())
    write_points(path, np.zeros((4, 3)), extra=types.items(), vlrs=[account], raw=[(name, 2) for name in types])
    return path


ARRAYS = ("2f4", "3u2", "2f8")


@pytest.mark.parametrize("kind", ARRAYS)
def test_no_reader_takes_several_numbers_for_a_column_that_the_account_names(tmp_path, kind):
    """Other programs store what they like under the names of the account; a KeyError or a broadcast would follow."""
    names = ("amplitude", "echo_width", "amplitude_err", "range_err", "incidence_angle", "reflectance", "echo_flags")
    types = dict.fromkeys(names, kind) | {"echo_time": "f4"}
    path = write_renamed(tmp_path / "a.las", types, {name: name for name in types} | {"not_known": "echo_time"})
    for dtype in (CLOUD_DTYPE, RETURN_DTYPE):
        with CloudReader(path, dtype) as cloud:
            (rows,) = cloud.read_pieces()
            assert len(rows) == 4 and set(cloud.written) <= {"echo_time", "not_known"}
    assert "echo_time" in read_cloud(path).dtype.names
    with ColumnReader(path, "echo_time") as cloud:
        (rows,) = cloud.read_pieces()
        assert (rows["values"] == 2).all()
    for name in ("amplitude", "echo_flags", "not_known"):
        refuses(ConfigError, f"has no column {name!r}", ColumnReader, path, name)


def test_numbers_of_points_that_no_file_could_hold_are_refused_at_once(tmp_path):
    path = tmp_path / "a.laz"
    write_cloud(path, 6)
    data = bytearray(path.read_bytes())
    data[247:255] = struct.pack("<Q", 2**40)
    path.write_bytes(data)
    refuses(InputError, "claims 1099511627776 points", CloudReader, path)


def test_flags_of_the_account_that_are_no_unsigned_integers_are_no_flags(tmp_path):
    names = {"amplitude": "f4", "echo_flags": "f4"}
    path = write_renamed(tmp_path / "a.las", names, {name: name for name in names})
    with CloudReader(path) as cloud:
        (rows,) = cloud.read_pieces()
    assert set(cloud.written) == {"amplitude"} and (rows["amplitude"] == 2).all() and not rows["flags"].any()


def test_a_laz_that_claims_too_few_points_is_named(tmp_path):
    """Its last chunk does not say how many it holds: 41 of 60 points were left out without a word."""
    strip = tmp_path / "a.laz"
    simulate_strip("flat", strip, pulses=60, seed=1)
    assert not read_checked_header(strip).warnings
    data = bytearray(strip.read_bytes())
    for number in (19, 59):
        data[107:111] = number.to_bytes(4, "little")
        strip.write_bytes(data)
        (line,) = read_checked_header(strip).warnings
        assert line.startswith(f"the header claims {number} points, but 60 by return number")
