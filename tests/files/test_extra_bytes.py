"""Extra-byte records, and no-data values that no real value has."""

import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavebatch.files.las.header import ExtraRecord, build_dtype, choose_no_data, read_records

TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


def as_laspy(record):
    return laspy.vlrs.known.ExtraBytesStruct.from_buffer_copy(record.data)


@pytest.mark.parametrize("dtype", TYPES)
def test_laspy_reads_what_we_declare(dtype):
    record = ExtraRecord.build("name", dtype, "what it is [m]", no_data=7, scale=0.25)
    record = record.with_range(np.array([1]), np.array([100]))
    seen = as_laspy(record)
    assert (seen.format_name(), seen.description, seen.dtype()) == ("name", b"what it is [m]", np.dtype(dtype))
    assert list(seen.no_data) == [7] and list(seen.scale) == [0.25] and list(seen.offset) == [0]
    assert list(seen._raw_min()) == [1] and list(seen._raw_max()) == [100]
    assert record.no_data[0] == 7 and [values[0] for values in record.declared_range] == [1, 100]
    bare = record.with_range(None, None)
    assert bare.declared_range is None and not as_laspy(bare).min_is_relevant()


@pytest.mark.parametrize("code", range(1, 31))
def test_every_type_of_the_specification(code):
    record = ExtraRecord(bytes([0, 0, code]) + bytes(189))
    assert record.dtype == as_laspy(record).dtype()
    length = (code - 1) // 10 + 1
    no_data = record.with_no_data(np.arange(length) + 1).no_data
    assert list(no_data) == list(range(1, length + 1))


def test_texts_longer_than_the_record_are_refused():
    with pytest.raises(ValueError, match="32 bytes"):
        ExtraRecord.build("n" * 33, "f4", "")
    with pytest.raises(ValueError, match="32 bytes"):
        ExtraRecord.build("n", "f4", "\N{MICRO SIGN}" * 17)


@pytest.mark.parametrize(
    ("stored", "name"),
    [(b"T\xb0", "T\N{DEGREE SIGN}"), (b"\xb0" * 32, "\N{DEGREE SIGN}" * 16), (b"a" * 31 + b"\xb0", "a" * 31),
     (b"a" * 31 + b"\xc3", "a" * 31)],
)
def test_latin_1_texts_become_utf_8(stored, name):
    record = ExtraRecord(bytes([0, 0, 3, 0]) + stored.ljust(32, b"\0") + bytes(124) + stored.ljust(32, b"\0"))
    with pytest.raises(UnicodeDecodeError):
        as_laspy(record).format_name()
    readable = record.with_readable_texts()
    assert as_laspy(readable).format_name() == readable.name == readable.description == name
    assert readable.with_readable_texts() == readable and len(readable.data) == 192


def test_undescribed_bytes_get_records_of_their_own():
    known = ExtraRecord.build("a", "u2", "")
    assert [(r.name, r.dtype.itemsize) for r in read_records(known.data, 2)] == [("a", 2)]
    found = read_records(known.data, 302)
    assert [(r.name, r.code, r.dtype.itemsize) for r in found] == [
        ("a", 3, 2), ("ExtraBytes", 0, 231), ("ExtraBytes 2", 0, 69),
    ]  # fmt: skip
    assert read_records(known.data, 1)[0].dtype == np.dtype("u1")  # described, but not there
    unknown = ExtraRecord(bytes([0, 0, 31]) + bytes(189))
    assert [(r.name, r.dtype.itemsize) for r in read_records(unknown.data + known.data, 4)] == [("ExtraBytes", 4)]
    named = ExtraRecord.build("ExtraBytes", "u1", "")
    assert [r.name for r in read_records(named.data, 3)] == ["ExtraBytes", "ExtraBytes 2"]


def test_fields_have_different_names_whatever_the_records_say():
    records = [ExtraRecord.build(name, "u1", "") for name in ("", "", "intensity", "a", "a")]
    assert build_dtype(1, records).names[-5:] == (" 2", " 3", "intensity 2", "a", "a 2")


@given(
    dtype=st.sampled_from([t for t in TYPES if t[0] in "ui"]),
    ends=st.tuples(st.integers(-(2**63), 2**64), st.integers(-(2**63), 2**64)),
)
def test_chosen_no_data_lies_outside_the_values(dtype, ends):
    info = np.iinfo(dtype)
    least, largest = (int(np.clip(end, info.min, info.max)) for end in sorted(ends))
    record = ExtraRecord.build("a", dtype, "")
    empty = choose_no_data(record.with_range(np.array([least], dtype), np.array([largest], dtype)))
    if empty is None:
        assert largest - least >= info.max - info.min - 1 or least == largest
    else:
        assert empty.dtype == np.dtype(dtype) and not least <= int(empty[0]) <= largest
        again = record.with_no_data(empty).no_data
        assert again[0] == empty[0]


def test_vendors_amplitude_keeps_clear_of_values_that_wrapped():
    record = ExtraRecord.build("Amplitude", "u2", "", scale=0.01).with_range(np.array([0]), np.array([10000]))
    empty = int(choose_no_data(record)[0])
    assert 10000 + 20000 < empty < 65536 - 20000


def test_no_data_without_any_evidence():
    assert np.isnan(choose_no_data(ExtraRecord.build("a", "f4", ""))[0])
    assert choose_no_data(ExtraRecord.build("a", "u2", "")) is None
    same = ExtraRecord.build("a", "u2", "").with_range(np.array([5]), np.array([5]))
    assert choose_no_data(same) is None, "no writer filled equal extremes in"
    assert choose_no_data(ExtraRecord.undocumented("a", 3)) is None
    assert list(choose_no_data(ExtraRecord.build("a", "u2", "", no_data=5))) == [5]
    vector = ExtraRecord(bytes([0, 0, 29]) + bytes(189))
    assert np.isnan(choose_no_data(vector)).tolist() == [True] * 3
