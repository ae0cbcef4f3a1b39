"""LAZ files of rows and of chunks that others compressed: the bytes that lazrs writes, and points that others read.

And what a decoder says past Python.
"""

import io
import os
import pickle
import struct
from concurrent.futures import ThreadPoolExecutor

import laspy
import lazrs
import numpy as np
import pytest
from numpy.lib import recfunctions
from writer_tools import BACKENDS, read_raw

from wavebatch.core.errors import InputError
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.disk import raw_bytes
from wavebatch.files.disk.raw_bytes import hiding_panics
from wavebatch.files.las import read_points
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.header import LasHeader, read_header
from wavebatch.files.las.write_points import CHUNK_POINTS, PointFile, Statistics, compress_rows

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


@pytest.mark.quick_cases("100017-[16]", "50000-[038]", "1-*", "0-*")
@pytest.mark.parametrize("point_format", [0, 1, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("n", [0, 1, CHUNK_POINTS, 2 * CHUNK_POINTS + 17])
def test_rows_become_the_chunks_that_lazrs_writes(tmp_path, point_format, n):
    rows = make_rows(point_format, n)
    for pieces in 1, 11:
        with open_file(tmp_path / f"{pieces}.laz", point_format) as file:
            for part in np.array_split(rows, pieces):
                file.write(part)
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
            file.count_rows(statistics)
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
    with pytest.raises(InputError, match="several scanner channels"):
        compress_rows(rows[-200:], 9)


def test_statistics_do_not_depend_on_how_rows_are_cut():
    """Also where 0.0 and -0.0 are the extremes: which one a minimum returns depends on the order of the rows."""
    rows = make_rows(6, 1000)
    width = rows.dtype.names[-1]
    rows[width] = np.where(np.arange(1000) % 3, 0.0, -0.0)
    rows["gps_time"] = -0.0
    rows["gps_time"][500:] = 0.0
    seen = set()
    for pieces in 1, 2, 3, 10:
        whole = Statistics(rows.dtype, RECORDS)
        for part in np.array_split(rows, pieces):
            whole.add(part)
        joined = Statistics(rows.dtype, RECORDS)
        for part in np.array_split(rows, pieces):
            other = Statistics(rows.dtype, RECORDS)
            other.add(part)
            joined.join(pickle.loads(pickle.dumps(other)))
        assert joined.ranged()[0].data == whole.ranged()[0].data and joined.count == whole.count
        header = LasHeader.new((1, 5), 6, (0.01,) * 3, (0.0,) * 3)
        whole.fill(header)
        seen.add((header.point_count, header.by_return, header.mins, header.maxs, str(header.gps_range),
                  whole.ranged()[0].data))  # fmt: skip
    assert len(seen) == 1


def test_rows_of_another_layout_are_refused(tmp_path):
    with open_file(tmp_path / "a.laz", 6) as file:
        other = recfunctions.drop_fields(make_rows(6, 3), "X")
        with pytest.raises(InputError, match="another layout"):
            file.write(other)


def _panic(*_):
    os.write(2, b"thread '<unnamed>' panicked at decoders.rs:171: index out of bounds\n")
    raise type("PanicException", (BaseException,), {})("index out of bounds")


def test_a_panic_of_the_decoder_is_one_line_and_says_nothing_itself(tmp_path, monkeypatch, capfd):
    path = tmp_path / "a.laz"
    with open_file(path, 1) as file:
        file.write(make_rows(1, 10))
        file.commit()
    monkeypatch.setattr(read_points.LazPoints, "_decode", _panic)
    with CloudReader(path) as reader, pytest.raises(InputError, match="cannot be decompressed .index out of bounds.;"):
        list(reader.read_pieces())
    assert capfd.readouterr().err == ""


def test_what_others_write_to_stderr_while_points_are_decoded_is_not_lost(capfd):
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(KeyError), hiding_panics():
        os.write(2, b"from another thread\n")
        raise KeyError
    with ThreadPoolExecutor() as pool:
        pool.submit(_write_hidden).result()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "from another thread\nin a thread\nafter\n"
    assert len(os.listdir("/proc/self/fd")) == files


def _write_hidden():
    with hiding_panics():
        os.write(2, b"in a thread\n")


def test_an_interrupt_while_stderr_is_taken_gives_it_back(monkeypatch, capfd):
    def interrupt(held):
        raw_bytes_hold(held)
        raise KeyboardInterrupt

    raw_bytes_hold = raw_bytes._hold_stderr
    monkeypatch.setattr(raw_bytes, "_hold_stderr", interrupt)
    with pytest.raises(KeyboardInterrupt), hiding_panics():
        pass
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
