"""Headers and records are the bytes they were; damaged ones give one line.

Point records are written out in wavebatch: they are laspy's, and a run needs no laspy.
"""

import dataclasses

import laspy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from writer_tools import facts_of, plan_output, write_source, write_strip

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.las.header import (
    STANDARD_DTYPES,
    decode_text,
    encode_evlr_header,
    find_evlrs,
    list_dimensions,
    read_header,
)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a LAS or LAZ file"),
        (b"LASF" + bytes(100), "not a LAS or LAZ file"),
        (b"PK" + bytes(400), "not a LAS or LAZ file"),
        (b"LASF" + bytes(20) + b"\x01\x09" + bytes(400), "LAS version 1.9 is not known"),
        (b"LASF" + bytes(20) + b"\x01\x04" + bytes(400), "but points at byte 0"),
    ],
)
def test_what_is_no_las_file_is_one_line(tmp_path, data, message):
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_header(tmp_path / "a.las")
    assert str(caught.value).startswith(str(tmp_path / "a.las")) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("stored", "text"),
    [
        ("Zürich".encode(), "Zürich"),
        ("Zürich".encode("latin-1"), "Zürich"),
        (b"Caf\xe9", "Café"),  # the first byte of a letter of UTF-8 that is not cut, for the field has room
        (("ü" + "s" * 29 + "ü").encode()[:32], "ü" + "s" * 29),
        (("s" * 29 + "üü").encode()[:32], "s" * 29 + "ü"),
        (b"s" * 28 + b"Caf\xe9", "s" * 28 + "Café"),
    ],
)
def test_texts_of_headers_are_utf_8_or_latin_1(stored, text):
    assert decode_text(stored.ljust(32, b"\0")) == text


def test_evlrs_end_where_the_file_does(tmp_path):
    path = tmp_path / "a.las"
    write_source(path, 6, (1, 4), evlrs=[(b"one", 1, b"1" * 10), (b"two", 2, b"")])
    found, missing = find_evlrs(path, read_header(path))
    assert [(evlr.user, evlr.record_id, evlr.length) for evlr in found] == [("one", 1, 10), ("two", 2, 0)]
    assert missing == 0
    with open(path, "ab") as file:
        file.write(encode_evlr_header(b"three", 3, 2**63, b""))
    header = read_header(path)
    header.evlr_count = 2**32 - 1
    found, missing = find_evlrs(path, header)
    assert len(found) == 2 and missing == 2**32 - 3
    header.evlr_start = header.offset_to_points + 1
    assert find_evlrs(path, header) == ([], 2**32 - 1)
    assert find_evlrs(path, dataclasses.replace(header, version=(1, 3), evlr_count=0)) == ([], 0)


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    path = tmp_path_factory.mktemp("strip") / "a.las"
    write_strip(path, wkt="PROJCRS[...]")
    return path


@given(changes=st.lists(st.tuples(st.integers(0, 700), st.integers(0, 255)), min_size=1, max_size=6))
def test_any_damage_of_the_header_is_one_line_or_a_plan(strip, tmp_path, changes):
    data = bytearray(strip.read_bytes())
    for at, value in changes:
        data[at] = value
    path = tmp_path / "damaged.las"
    path.write_bytes(data)
    for keep in (False, True):
        try:
            plan_output(path, ["amplitude"], packets=facts_of(path) if keep else None)
        except (InputError, ConfigError) as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("number", range(11))
def test_fields_and_dimensions_are_those_of_laspy(number):
    known = laspy.PointFormat(number)
    assert STANDARD_DTYPES[number] == known.dtype()
    assert list_dimensions(number) == tuple(known.dimension_names)
