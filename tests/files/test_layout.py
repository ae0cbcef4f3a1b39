"""Headers, extra bytes and names of columns of files that are read and written."""

import dataclasses

import laspy
import numpy as np
import pytest
from commands import refuses
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.recfunctions import repack_fields
from writer_tools import facts_of, plan_output, random_points, write_source, write_strip

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.column_names import _SHORT as SHORT
from wavebatch.files.cloud.column_names import STYLES, describe, describe_roundings, normalise, resolve, style_columns
from wavebatch.files.las import header as las

VERSIONS = {4: (1, 3), 5: (1, 3), 9: (1, 4), 10: (1, 4)}
GEOTIFF = las.Vlr(b"LASF_Projection", 34735, bytes(8))
WKT = las.Vlr(b"LASF_Projection", 2112, b"PROJCRS\0")


def fields_of(rows, point_format):
    """Every field of the point format by laspy's own unpacking."""
    record = laspy.PackedPointRecord(rows, laspy.PointFormat(point_format))
    return {name: np.array(record[name]) for name in laspy.PointFormat(point_format).dimension_names}


def plain(rows, point_format):
    """The standard part of rows, as an array of the bare point format."""
    return repack_fields(rows[list(las.STANDARD_DTYPES[point_format].names)])


@pytest.mark.parametrize(
    ("old", "new"), [(4, 3), (4, 6), (4, 7), (4, 8), (5, 7), (5, 8), (9, 7), (9, 8), (1, 6), (3, 8), (0, 6)]
)
def test_promotion_keeps_every_field(tmp_path, old, new):
    points = write_source(tmp_path / "a.las", old, VERSIONS.get(old, (1, 3)), vlrs=[WKT])
    points["bit_fields"] = np.arange(200)
    layout = plan_output(tmp_path / "a.las", ["amplitude"], point_format=new)
    assert layout.version == (1, 4)
    rows = plain(layout.rows(points), new)
    before, after = fields_of(points, old), fields_of(rows, new)
    for name in set(after) & set(before) - {"overlap"}:
        np.testing.assert_array_equal(after[name], before[name], name)
    for name in set(after) - set(before) - {"scan_angle", "overlap"}:
        assert not after[name].any(), name
    if old < 6 <= new:
        np.testing.assert_array_equal(after["scan_angle"], np.rint(before["scan_angle_rank"] / 0.006))
        np.testing.assert_array_equal(after["overlap"], before["classification"] == 12)


@pytest.mark.parametrize(("old", "new", "keep"), [(5, 6, 0), (10, 7, 0), (9, 1, 0), (4, 9, 0), (4, 6, 1)])
def test_ways_that_lose_something_are_refused(tmp_path, old, new, keep):
    write_source(tmp_path / "a.las", old, VERSIONS[old])
    with pytest.raises(ConfigError, match=f"point format {old} cannot be written as {new}.* possible are"):
        facts = facts_of(tmp_path / "a.las") if keep else None
        plan_output(tmp_path / "a.las", [], point_format=new, packets=facts)


def test_geotiff_cannot_be_promoted_but_wkt_can(tmp_path):
    for name, vlrs in (("geo", [GEOTIFF]), ("both", [GEOTIFF, WKT]), ("none", [])):
        write_source(tmp_path / f"{name}.las", 4, (1, 3), vlrs=vlrs)
    with pytest.raises(InputError, match="geo.las: its CRS is given by GeoTIFF keys only, point formats 6 to 10 need"):
        plan_output(tmp_path / "geo.las", [], point_format=6)
    old = plan_output(tmp_path / "geo.las", [])
    assert (old.version, old.point_format) == ((1, 4), 1)
    assert "to try that format, give --point-format 6" in old.notes[0]
    for name in ("both", "none"):
        for wanted in (None, 6):
            layout = plan_output(tmp_path / f"{name}.las", [], point_format=wanted)
            assert (layout.version, layout.point_format, layout.notes) == ((1, 4), 6, ())


def test_coordinates_are_rounded_kept_or_refused(tmp_path):
    points = write_source(tmp_path / "a.las", 9, (1, 4), n=3)
    layout = plan_output(tmp_path / "a.las", [])
    assert np.array_equal(layout.rows(points)["X"], points["X"])
    xyz = np.array([[1000.014, 2000.016, 30.0], [np.nan] * 3, [999.99, 1999.98, 29.97]])
    rows = layout.rows(points, xyz=xyz)
    assert rows["X"].tolist() == [1, points["X"][1], -1]
    assert rows["Y"].tolist() == [2, points["Y"][1], -2]
    assert rows["Z"].tolist() == [0, points["Z"][1], -3]
    edge = np.array([[1000 + 0.01 * (2**31 - 1), 2000.0, 30.0]] * 3)
    assert layout.rows(points, xyz=edge)["X"][0] == 2**31 - 1
    for axis, value in ((0, 3e7), (1, -3e7), (2, np.inf), (2, np.nan)):
        bad = edge.copy()
        bad[2, axis] = value
        with pytest.raises(InputError, match=rf"{'xyz'[axis]} = .* of output row 2 does not fit .* scale 0.01"):
            layout.rows(points, xyz=bad)


SEVERAL = [
    las.ExtraRecord.build("Amplitude", "u2", "dB", scale=0.01).with_range(np.array([0]), np.array([10000])),
    las.ExtraRecord.build("real", "f8", ""),
    las.ExtraRecord.build("declared", "i4", "", no_data=-5),
    las.ExtraRecord.build("bare", "u1", ""),
    las.ExtraRecord(bytes([0, 0, 29, 0]) + b"normal".ljust(188, b"\0")),  # three floats, a deprecated type
    las.ExtraRecord.undocumented("ExtraBytes", 5),
]


def write_several(path):
    points = write_source(path, 9, (1, 4), n=6, records=SEVERAL)
    # what the file declares, not what it holds, is what plan_output has to go by
    data = bytearray(path.read_bytes())
    at = data.index(SEVERAL[0].data[:36])
    data[at : at + 192] = SEVERAL[0].data
    at = data.index(SEVERAL[3].data[4:36]) - 4
    data[at : at + 192] = SEVERAL[3].data
    path.write_bytes(data)
    return points


def test_a_name_that_is_no_utf_8_is_carried_as_one(tmp_path):
    write_source(tmp_path / "a.las", 9, (1, 4), n=6, records=[las.ExtraRecord.build("Ta", "u2", "")])
    data = (tmp_path / "a.las").read_bytes()
    assert data.count(b"Ta\0") == 1
    (tmp_path / "a.las").write_bytes(data.replace(b"Ta\0", b"T\xb0\0"))
    layout = plan_output(tmp_path / "a.las", ["amplitude"], points="returns")
    assert layout.extra_records[0].name == "T\N{DEGREE SIGN}"


@pytest.mark.parametrize("name", [b"", b"same", b"intensity", b"x" * 32])
def test_carried_names_are_told_apart(tmp_path, name):
    """laspy opens no file in which a name is there twice, or is that of a field."""
    records = [las.ExtraRecord.build(one, "u2", "") for one in ("Ta", "Tb", "Tc")]
    write_source(tmp_path / "a.las", 9, (1, 4), n=6, records=records)
    data = (tmp_path / "a.las").read_bytes()
    for one in (b"Ta", b"Tb", b"Tc"):
        assert data.count(one.ljust(32, b"\0")) == 1
        data = data.replace(one.ljust(32, b"\0"), name.ljust(32, b"\0"))
    (tmp_path / "a.las").write_bytes(data)
    layout = plan_output(tmp_path / "a.las", ["amplitude"])
    names = [record.name for record in layout.extra_records]
    assert len(set(names)) == 4 and "" not in names and not set(names) & set(las.STANDARD_DTYPES[9].names)
    assert names == list(layout.extra_fields)
    begin = name[:30].decode()
    assert names[0] == (name.decode() if name in (b"same", b"x" * 32) else f"{begin} 2") and names[1].startswith(begin)


def test_echoes_carry_every_extra_byte_and_mark_added_rows_where_a_value_is_free(tmp_path):
    points = write_several(tmp_path / "a.las")
    layout = plan_output(tmp_path / "a.las", ["amplitude"])
    assert layout.copied == ("bare", "ExtraBytes")
    assert layout.extra_fields == (*points.dtype.names[-6:], "wb_amplitude")
    matched = np.array([True, False, True, True, False, True])
    rows = layout.rows(points, matched=matched)
    for name, record in zip(layout.extra_fields[:-1], layout.extra_records, strict=False):
        assert rows[name][matched].tobytes() == points[name][matched].tobytes(), name
        if name in layout.copied:
            assert rows[name].tobytes() == points[name].tobytes() and record.no_data is None, name
            continue
        expected = np.broadcast_to(record.no_data.reshape(record.dtype.shape), rows[name][~matched].shape)
        np.testing.assert_array_equal(rows[name][~matched], expected, name)
    assert layout.rows(points)["real"].tobytes() == points["real"].tobytes()


def test_strict_refuses_what_cannot_be_marked(tmp_path):
    write_several(tmp_path / "a.las")
    with pytest.raises(InputError, match="a.las: --strict: no value is free .* bare, ExtraBytes; leave --strict out"):
        plan_output(tmp_path / "a.las", ["amplitude"], strict=True)
    assert plan_output(tmp_path / "a.las", ["amplitude"], strict=True, points="returns").copied == ()


def test_kept_packets_keep_pointers_and_take_new_locations(tmp_path):
    points = write_strip(tmp_path / "a.las", n=4)
    layout = plan_output(tmp_path / "a.las", ["echo_time"], packets=facts_of(tmp_path / "a.las"))
    xyz = np.full((4, 3), 0.5)
    xyz[1] = np.nan
    time = np.array([12.5, 13.0, np.nan, 14.0])
    rows = layout.rows(points, xyz=xyz, columns={"echo_time": time}, time=time)
    location = points["return_point_wave_location"]
    assert rows["return_point_wave_location"].tolist() == [12500.0, location[1], location[2], 14000.0]
    for name in ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "x_t", "y_t", "z_t"):
        np.testing.assert_array_equal(rows[name], points[name])
    kept = layout.rows(points, columns={"echo_time": time})  # no new positions: locations stay too
    np.testing.assert_array_equal(kept["return_point_wave_location"], location)


def test_records_that_leave_no_room_are_refused(tmp_path):
    points = random_points(las.STANDARD_DTYPES[6], 1)
    write_source(tmp_path / "a.las", 6, (1, 4), points=points)
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[105:107], data[247:255] = (65535).to_bytes(2, "little"), bytes(8)
    data[107:111] = bytes(4)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match="leave no room for the columns"):
        plan_output(tmp_path / "a.las", ["amplitude"], points="returns")
    data[105:107] = (29).to_bytes(2, "little")
    (tmp_path / "a.las").write_bytes(data)
    refuses(InputError, "point records of 29 bytes are too short for format 6", plan_output, tmp_path / "a.las", [])
    data[104] = 11
    (tmp_path / "a.las").write_bytes(data)
    refuses(InputError, "point format 11 is not known", plan_output, tmp_path / "a.las", [])


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
        las.read_header(tmp_path / "a.las")
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
    assert las.decode_text(stored.ljust(32, b"\0")) == text


def test_evlrs_end_where_the_file_does(tmp_path):
    path = tmp_path / "a.las"
    write_source(path, 6, (1, 4), evlrs=[(b"one", 1, b"1" * 10), (b"two", 2, b"")])
    found, missing = las.find_evlrs(path, las.read_header(path))
    assert [(evlr.user, evlr.record_id, evlr.length) for evlr in found] == [("one", 1, 10), ("two", 2, 0)]
    assert missing == 0
    with open(path, "ab") as file:
        file.write(las.encode_evlr_header(b"three", 3, 2**63, b""))
    header = las.read_header(path)
    header.evlr_count = 2**32 - 1
    found, missing = las.find_evlrs(path, header)
    assert len(found) == 2 and missing == 2**32 - 3
    header.evlr_start = header.offset_to_points + 1
    assert las.find_evlrs(path, header) == ([], 2**32 - 1)
    assert las.find_evlrs(path, dataclasses.replace(header, version=(1, 3), evlr_count=0)) == ([], 0)


@pytest.mark.parametrize("number", range(11))
def test_fields_and_dimensions_are_those_of_laspy(number):
    known = laspy.PointFormat(number)
    assert las.STANDARD_DTYPES[number] == known.dtype()
    assert las.list_dimensions(number) == tuple(known.dimension_names)


TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


def as_laspy(record):
    return laspy.vlrs.known.ExtraBytesStruct.from_buffer_copy(record.data)


@pytest.mark.parametrize("dtype", TYPES)
def test_laspy_reads_what_we_declare(dtype):
    record = las.ExtraRecord.build("name", dtype, "what it is [m]", no_data=7, scale=0.25)
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
    record = las.ExtraRecord(bytes([0, 0, code]) + bytes(189))
    assert record.dtype == as_laspy(record).dtype()
    length = (code - 1) // 10 + 1
    no_data = record.with_no_data(np.arange(length) + 1).no_data
    assert list(no_data) == list(range(1, length + 1))


def test_texts_longer_than_the_record_are_refused():
    refuses(ValueError, "32 bytes", las.ExtraRecord.build, "n" * 33, "f4", "")
    refuses(ValueError, "32 bytes", las.ExtraRecord.build, "n", "f4", "\N{MICRO SIGN}" * 17)


@pytest.mark.parametrize(
    ("stored", "name"),
    [(b"T\xb0", "T\N{DEGREE SIGN}"), (b"\xb0" * 32, "\N{DEGREE SIGN}" * 16), (b"a" * 31 + b"\xb0", "a" * 31),
     (b"a" * 31 + b"\xc3", "a" * 31)],
)
def test_latin_1_texts_become_utf_8(stored, name):
    record = las.ExtraRecord(bytes([0, 0, 3, 0]) + stored.ljust(32, b"\0") + bytes(124) + stored.ljust(32, b"\0"))
    refuses(UnicodeDecodeError, "", as_laspy(record).format_name)
    readable = record.with_readable_texts()
    assert as_laspy(readable).format_name() == readable.name == readable.description == name
    assert readable.with_readable_texts() == readable and len(readable.data) == 192


def test_undescribed_bytes_get_records_of_their_own():
    known = las.ExtraRecord.build("a", "u2", "")
    assert [(r.name, r.dtype.itemsize) for r in las.read_records(known.data, 2)] == [("a", 2)]
    found = las.read_records(known.data, 302)
    assert [(r.name, r.code, r.dtype.itemsize) for r in found] == [
        ("a", 3, 2), ("ExtraBytes", 0, 231), ("ExtraBytes 2", 0, 69),
    ]  # fmt: skip
    assert las.read_records(known.data, 1)[0].dtype == np.dtype("u1")  # described, but not there
    unknown = las.ExtraRecord(bytes([0, 0, 31]) + bytes(189))
    assert [(r.name, r.dtype.itemsize) for r in las.read_records(unknown.data + known.data, 4)] == [("ExtraBytes", 4)]
    named = las.ExtraRecord.build("ExtraBytes", "u1", "")
    assert [r.name for r in las.read_records(named.data, 3)] == ["ExtraBytes", "ExtraBytes 2"]


def test_fields_have_different_names_whatever_the_records_say():
    records = [las.ExtraRecord.build(name, "u1", "") for name in ("", "", "intensity", "a", "a")]
    assert las.build_dtype(1, records).names[-5:] == (" 2", " 3", "intensity 2", "a", "a 2")


@given(
    dtype=st.sampled_from([t for t in TYPES if t[0] in "ui"]),
    ends=st.tuples(st.integers(-(2**63), 2**64), st.integers(-(2**63), 2**64)),
)
def test_chosen_no_data_lies_outside_the_values(dtype, ends):
    info = np.iinfo(dtype)
    least, largest = (int(np.clip(end, info.min, info.max)) for end in sorted(ends))
    record = las.ExtraRecord.build("a", dtype, "")
    empty = las.choose_no_data(record.with_range(np.array([least], dtype), np.array([largest], dtype)))
    if empty is None:
        assert largest - least >= info.max - info.min - 1 or least == largest
    else:
        assert empty.dtype == np.dtype(dtype) and not least <= int(empty[0]) <= largest
        again = record.with_no_data(empty).no_data
        assert again[0] == empty[0]


def test_vendors_amplitude_keeps_clear_of_values_that_wrapped():
    record = las.ExtraRecord.build("Amplitude", "u2", "", scale=0.01).with_range(np.array([0]), np.array([10000]))
    empty = int(las.choose_no_data(record)[0])
    assert 10000 + 20000 < empty < 65536 - 20000


def test_no_data_without_any_evidence():
    assert np.isnan(las.choose_no_data(las.ExtraRecord.build("a", "f4", ""))[0])
    assert las.choose_no_data(las.ExtraRecord.build("a", "u2", "")) is None
    same = las.ExtraRecord.build("a", "u2", "").with_range(np.array([5]), np.array([5]))
    assert las.choose_no_data(same) is None, "no writer filled equal extremes in"
    assert las.choose_no_data(las.ExtraRecord.undocumented("a", 3)) is None
    assert list(las.choose_no_data(las.ExtraRecord.build("a", "u2", "", no_data=5))) == [5]
    vector = las.ExtraRecord(bytes([0, 0, 29]) + bytes(189))
    assert np.isnan(las.choose_no_data(vector)).tolist() == [True] * 3


ALL = tuple(COLUMNS)
WRITTEN = tuple(name for name, column in COLUMNS.items() if column.extra_bytes)
NUMBERS = tuple(name for name in WRITTEN if name != "echo_flags")


@pytest.mark.parametrize("style", STYLES)
def test_every_style_writes_every_column_under_a_name_of_its_own(style):
    columns = style_columns(ALL, style, ())
    assert tuple(column.column for column in columns) == WRITTEN
    names = [column.record.name for column in columns]
    assert len({normalise(name) for name in names}) == len(names)
    assert all(len(name.encode()) <= 32 for name in names)


@pytest.mark.parametrize("column", COLUMNS.values(), ids=COLUMNS)
def test_descriptions_fit_and_end_with_the_unit(column):
    text = describe(column)
    assert len(text.encode()) <= 32 and text.endswith(f"[{column.unit}]")
    meaning = text.rpartition(" [")[0]
    error = f"1 sigma of {column.name.removesuffix('_err')}"
    assert not column.extra_bytes or meaning in (SHORT.get(column.name), column.meaning, error), "the meaning is cut"
    assert column.name != "range_err" or meaning == "1 sigma of place along ray"  # that of range is range_error


@pytest.mark.parametrize("style", STYLES)
def test_styles_name_columns_that_exist(style):
    assert set(STYLES[style]) <= set(COLUMNS)


def test_collisions_with_prefixed_names_separators_and_standard_fields():
    def named(columns, style, taken):
        return [column.record.name for column in style_columns(columns, style, taken)]

    assert named(["amplitude"], "wavebatch", ["Amplitude", "wb_amplitude"]) == ["wb2_amplitude"]
    assert named(["echo_width"], "wavebatch", ["Echo Width"]) == ["wb_echo_width"]
    assert named(["echo_width"], "asprs", ["Pulse width"]) == ["wb_pulse_width"]
    assert named(["echo_width"], "pdal", ["echo_width"]) == ["wb_EchoWidth"]
    assert named(["amplitude", "amplitude"], "opals", []) == ["Amplitude"]
    assert named(["x", "y", "z", "range"], "wavebatch", ["X"]) == ["range"]
    assert named(["range"], "pdal", []) == ["EchoRange"]


def test_no_data_of_floating_point_columns_can_be_nan():
    plain, nan = (
        {column.column: column.record for column in style_columns(list(COLUMNS), "asprs", [], no_data)}
        for no_data in ("-9999", "nan")
    )
    for name, record in plain.items():
        if record.dtype.kind == "f":
            assert record.no_data[0] == -9999 and np.isnan(nan[name].no_data[0]), name
        else:
            assert record == nan[name]


def test_styles_that_round_say_so_with_step_and_limits():
    (line,) = describe_roundings(style_columns(list(COLUMNS), "asprs", []))
    assert line.startswith("echo_width: written as 'pulse width', rounded to 0.1 ns and kept within 0 to 6553.5 ns")
    assert [line.split(":")[0] for line in describe_roundings(style_columns(list(COLUMNS), "riegl", []))] == [
        "echo_width",
        "reflectance",
    ]
    for style in ("wavebatch", "pdal", "opals"):
        assert describe_roundings(style_columns(list(COLUMNS), style, [])) == []


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("name", NUMBERS)
def test_what_is_no_number_becomes_the_declared_no_data(style, name):
    (column,) = style_columns([name], style, ())
    empty = column.record.no_data
    assert empty is not None
    stored = column.encode(np.array([np.nan, np.inf, -np.inf, 5.0]))
    assert list(stored[:3]) == [empty[0]] * 3 and stored[3] != empty[0]


def test_values_beyond_the_stored_type_become_its_nearest_value_never_no_data():
    (width,) = style_columns(["echo_width"], "asprs", ())
    assert list(width.encode(np.array([0.0, 0.01, 1e9, np.nan]))) == [1, 1, 65535, 0]
    (reflectance,) = style_columns(["reflectance"], "riegl", ())
    assert list(reflectance.encode(np.array([1.0, 0.1, 1e-300, 1e300, 0.0, -1.0]))) == [
        0, -1000, -32767, 32767, -32768, -32768,
    ]  # fmt: skip
    (amplitude,) = style_columns(["amplitude"], "wavebatch", ())
    assert list(amplitude.encode(np.array([1e300, 1.0]))) == [-9999.0, 1.0]


def test_exact_names_come_before_those_that_are_alike_and_kinds_count_in_order():
    ours, file = {"echo_width": "Pulse width", "amplitude": "wb_amplitude"}, {"Amplitude": "Amplitude", "z": "z"}
    assert resolve("Amplitude", ours, file) == "Amplitude"
    assert resolve("amplitude", ours, file) == "wb_amplitude"
    assert resolve("AMPLITUDE", ours, file) == "wb_amplitude"
    assert resolve("Echo Width", ours, file) == "Pulse width"
    assert resolve("Z", ours, file) == "z"
    assert resolve("width", ours, file) is None
