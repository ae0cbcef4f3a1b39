"""LAZ files that several threads compressed: the bytes are those of a file that one thread compressed.

And what a decoder says past Python.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.lib import recfunctions
from writer_tools import BACKENDS, read_raw

from wavebatch.core.errors import InputError
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.disk import raw_bytes
from wavebatch.files.disk.raw_bytes import hiding_panics
from wavebatch.files.las import laz_decode
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.header import LasHeader
from wavebatch.files.las.laz_encode import CHUNK_POINTS
from wavebatch.files.las.write_points import PointFile, Statistics

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
    return rows


def open_file(target, point_format, threads=1):
    version = (1, 4) if point_format > 5 else (1, 3)
    header = LasHeader.new(version, point_format, (0.01,) * 3, (0.0,) * 3)
    return PointFile(target, header, build_dtype(point_format, RECORDS), RECORDS, overwrite=True, threads=threads)


@pytest.mark.quick_cases("100017-[16]", "50000-[038]", "1-*", "0-*")
@pytest.mark.parametrize("point_format", [0, 1, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("n", [0, 1, CHUNK_POINTS, 2 * CHUNK_POINTS + 17])
def test_threads_give_the_bytes_of_one(tmp_path, point_format, n):
    rows = make_rows(point_format, n)
    with open_file(tmp_path / "whole.laz", point_format) as file:
        for part in np.array_split(rows, 7):
            file.write(part)
        file.commit()
    with open_file(tmp_path / "chunks.laz", point_format, threads=2) as file:
        for part in np.array_split(rows, 11):
            file.write(part)
        file.commit()
    assert (tmp_path / "chunks.laz").read_bytes() == (tmp_path / "whole.laz").read_bytes()
    for backend in BACKENDS if n else ():
        assert read_raw(tmp_path / "chunks.laz", backend).tobytes() == rows.tobytes()


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
    monkeypatch.setattr(laz_decode.LazPoints, "_decode", _panic)
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
