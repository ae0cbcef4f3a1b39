"""Points by index from LAS and LAZ, and what happens when the compression lies."""

import struct

import lazrs
import numpy as np
import pytest
from strips import make_raw, vlr
from writer_tools import data_file, read_raw

from wavebatch.core.errors import InputError
from wavebatch.files.las import read_points
from wavebatch.files.las.read_points import open_points, read_checked_header
from wavebatch.files.strip.reader import StripReader


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
    with pytest.raises(InputError, match=r"pdrf9-1.5.laz: has the compression of LAS 1.5.* laszip -i IN.laz"):
        StripReader(path)


def patch(path, at, data):
    content = bytearray(path.read_bytes())
    at = at if at >= 0 else len(content) + at
    content[at : at + len(data)] = data
    path.write_bytes(content)
    return path


def payload_at(path):
    return path.read_bytes().index(b"laszip encoded") - 2 + 54


def refused(path, pattern):
    with pytest.raises(InputError, match=pattern) as caught, StripReader(path) as reader:
        reader.scan()
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("at", "data", "pattern"), [
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


def test_a_missing_laszip_record(tmp_path):
    _, path = laz_of(tmp_path)
    refused(patch(path, payload_at(path) - 52, b"other"), "missing or wrong")


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


def test_more_points_than_any_compression_holds(tmp_path):
    raw = make_raw(point_format=9)
    raw.count = 2**60
    refused(raw.write(tmp_path / "a.laz"), "the header claims 1152921504606846976 points in")


@pytest.mark.parametrize("cut", [0.3, 0.6, 0.9, 0.999])
@pytest.mark.parametrize("point_format", [4, 10])
def test_cut_laz_files(tmp_path, cut, point_format):
    _, path = laz_of(tmp_path, point_format)
    data = path.read_bytes()
    begin = struct.unpack_from("<I", data, 96)[0]
    table = struct.unpack_from("<q", data, begin)[0]
    path.write_bytes(data[: int(begin + (table + 8 - begin) * cut)])
    refused(path, "LAZ chunks|waveform record at byte")


def test_a_chunk_that_does_not_fit_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(read_points, "MAX_CHUNK_BYTES", 100)
    refused(laz_of(tmp_path)[1], "chunks are too large|table of LAZ chunks")


def test_other_vlrs_do_not_confuse(tmp_path):
    raw = make_raw(60)
    raw.vlrs.append(vlr(b"other", 22204, b"x" * 10))
    path = raw.write(tmp_path / "a.laz")
    assert read(path, (0, 5))[0].tobytes() == raw.points[:5].tobytes()
