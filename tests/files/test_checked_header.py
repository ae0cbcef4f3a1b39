"""Headers: what they may claim, and the one line that each lie gets."""

import struct

import numpy as np
import pytest
from strips import make_raw, read_all, vlr

from wavebatch.core.errors import InputError
from wavebatch.files.las import header
from wavebatch.files.strip.reader import StripReader


def refused(path, pattern):
    with pytest.raises(InputError, match=pattern) as caught, StripReader(path) as reader:
        reader.scan()
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text


def patched(tmp_path, at, data, raw=None, name="a.las"):
    path = (raw or make_raw()).write(tmp_path / name)
    content = bytearray(path.read_bytes())
    content[at : at + len(data)] = data
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("content", [b"", b"LASF", b"LASF" + bytes(100), b"not a strip" * 100])
def test_files_that_are_no_las(tmp_path, content):
    path = tmp_path / "a.las"
    path.write_bytes(content)
    refused(path, "LASF|version")


def test_a_missing_file_and_a_folder(tmp_path):
    refused(tmp_path / "none.las", "cannot be read: No such file")
    refused(tmp_path, "cannot be read: it is a folder, a pipe or a device")


@pytest.mark.parametrize(("minor", "pattern"), [(2, "version 1.2 has no waveforms"), (6, "version 1.6")])
def test_versions_without_waveforms(tmp_path, minor, pattern):
    refused(patched(tmp_path, 25, bytes([minor])), pattern)


@pytest.mark.parametrize("number", [0, 1, 3, 6, 7, 8, 11, 63])
def test_formats_without_waveforms(tmp_path, number):
    refused(patched(tmp_path, 104, bytes([number])), f"point format {number} has no waveforms")


def test_format_9_needs_las_1_4(tmp_path):
    refused(patched(tmp_path, 104, bytes([9])), "needs LAS 1.4")


def test_records_shorter_than_their_format(tmp_path):
    refused(patched(tmp_path, 105, struct.pack("<H", 56)), "too short for format 4")


@pytest.mark.parametrize("count", [53_000, 2**32 - 1])
def test_more_points_than_the_file_has_room_for(tmp_path, count):
    refused(patched(tmp_path, 107, struct.pack("<I", count)), f"claims {count} points")


def test_points_that_would_run_into_the_packets(tmp_path):
    raw = make_raw()
    raw.count = len(raw.points) + 1
    refused(raw.write(tmp_path / "a.las"), "waveform record begins at byte")


def test_points_that_would_run_into_the_evlrs(tmp_path):
    raw = make_raw(point_format=9, internal=False)
    raw.behind = bytes(100)
    raw.evlr = (1000, 1)
    refused(raw.write(tmp_path / "a.las"), "EVLRs begin at byte 1000")


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
        assert "legacy point count" in reader.facts.warnings[0]


@pytest.mark.parametrize("offset", [0, 10, 226, 2**32 - 1])
def test_offset_to_points_that_cannot_be(tmp_path, offset):
    refused(patched(tmp_path, 96, struct.pack("<I", offset)), "but points at byte")


@pytest.mark.parametrize("size", [0, 100, 234, 65535])
def test_header_size_that_cannot_be(tmp_path, size):
    refused(patched(tmp_path, 94, struct.pack("<H", size)), "but points at byte|VLR")


@pytest.mark.parametrize("count", [2, 1000, 2**32 - 1])
def test_vlr_counts_that_lie(tmp_path, count):
    refused(patched(tmp_path, 100, struct.pack("<I", count)), "VLR")


def test_a_vlr_that_runs_into_the_points(tmp_path):
    refused(patched(tmp_path, 235 + 20, struct.pack("<H", 65535)), "VLR 0 of 1")


@pytest.mark.parametrize("scale", [0.0, float("nan"), float("inf")])
def test_scales_that_give_no_coordinates(tmp_path, scale):
    refused(patched(tmp_path, 139, struct.pack("<d", scale)), "scale .* of y")


def test_offsets_that_give_no_coordinates(tmp_path):
    refused(patched(tmp_path, 171, struct.pack("<d", float("nan"))), "offset nan of z")


def test_a_front_that_does_not_fit_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(header, "MAX_FRONT", 200)
    refused(make_raw().write(tmp_path / "a.las"), r"header with 1 VLRs in .* bytes \(at most")


def test_user_ids_and_descriptions_that_are_no_text(tmp_path):
    raw = make_raw()
    raw.vlrs.append(vlr(b"\xff\xfe\x00\x80", 5, b"\xff" * 30, reserved=0xAABB))
    assert len(read_all(raw.write(tmp_path / "a.las"))) == 40


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
