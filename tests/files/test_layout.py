"""Output rows: the input's fields, our columns, and nothing else."""


import laspy
import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields
from writer_tools import facts_of, plan_output, random_points, write_source, write_strip

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.las.header import STANDARD_DTYPES, ExtraRecord, Vlr

VERSIONS = {4: (1, 3), 5: (1, 3), 9: (1, 4), 10: (1, 4)}
GEOTIFF = Vlr(b"LASF_Projection", 34735, bytes(8))
WKT = Vlr(b"LASF_Projection", 2112, b"PROJCRS\0")


def fields_of(rows, point_format):
    """Every field of the point format by laspy's own unpacking."""
    record = laspy.PackedPointRecord(rows, laspy.PointFormat(point_format))
    return {name: np.array(record[name]) for name in laspy.PointFormat(point_format).dimension_names}


def plain(rows, point_format):
    """The standard part of rows, as an array of the bare point format."""
    return repack_fields(rows[list(STANDARD_DTYPES[point_format].names)])


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


def test_points_are_echoes_or_returns(tmp_path):
    write_source(tmp_path / "a.las", 6, (1, 4))
    with pytest.raises(ConfigError, match="points 'all': must be echoes or returns"):
        plan_output(tmp_path / "a.las", [], points="all")


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
    ExtraRecord.build("Amplitude", "u2", "dB", scale=0.01).with_range(np.array([0]), np.array([10000])),
    ExtraRecord.build("real", "f8", ""),
    ExtraRecord.build("declared", "i4", "", no_data=-5),
    ExtraRecord.build("bare", "u1", ""),
    ExtraRecord(bytes([0, 0, 29, 0]) + b"normal".ljust(188, b"\0")),  # three floats, a deprecated type
    ExtraRecord.undocumented("ExtraBytes", 5),
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
    write_source(tmp_path / "a.las", 9, (1, 4), n=6, records=[ExtraRecord.build("Ta", "u2", "")])
    data = (tmp_path / "a.las").read_bytes()
    assert data.count(b"Ta\0") == 1
    (tmp_path / "a.las").write_bytes(data.replace(b"Ta\0", b"T\xb0\0"))
    layout = plan_output(tmp_path / "a.las", ["amplitude"], points="returns")
    assert layout.extra_records[0].name == "T\N{DEGREE SIGN}"


@pytest.mark.parametrize("name", [b"", b"same", b"intensity", b"x" * 32])
def test_carried_names_are_told_apart(tmp_path, name):
    """laspy opens no file in which a name is there twice, or is that of a field."""
    records = [ExtraRecord.build(one, "u2", "") for one in ("Ta", "Tb", "Tc")]
    write_source(tmp_path / "a.las", 9, (1, 4), n=6, records=records)
    data = (tmp_path / "a.las").read_bytes()
    for one in (b"Ta", b"Tb", b"Tc"):
        assert data.count(one.ljust(32, b"\0")) == 1
        data = data.replace(one.ljust(32, b"\0"), name.ljust(32, b"\0"))
    (tmp_path / "a.las").write_bytes(data)
    layout = plan_output(tmp_path / "a.las", ["amplitude"])
    names = [record.name for record in layout.extra_records]
    assert len(set(names)) == 4 and "" not in names and not set(names) & set(STANDARD_DTYPES[9].names)
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
    points = random_points(STANDARD_DTYPES[6], 1)
    write_source(tmp_path / "a.las", 6, (1, 4), points=points)
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[105:107], data[247:255] = (65535).to_bytes(2, "little"), bytes(8)
    data[107:111] = bytes(4)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match="leave no room for the columns"):
        plan_output(tmp_path / "a.las", ["amplitude"], points="returns")
    data[105:107] = (29).to_bytes(2, "little")
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match="point records of 29 bytes are too short for format 6"):
        plan_output(tmp_path / "a.las", [])
    data[104] = 11
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match="point format 11 is not known"):
        plan_output(tmp_path / "a.las", [])
