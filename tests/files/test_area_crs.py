"""Areas of GeoJSON lie where its standard, or its member `crs`, says; without pyproj one line says what to do.

GeoJSON lies where the strip lies, by what RFC 7946 and GDAL make of its coordinates.
"""

import json
import shutil
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
from commands import run_command, succeed
from strips import add_record
from writer_tools import data_file

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.geojson import AreaFile, describe_miss, load_polygons, place_rings, plan_crs, read_area_file
from wavebatch.files.las.crs import build_utm, read_crs, read_crs_definition
from wavebatch.files.las.header import Vlr, build_wkt, read_header
from wavebatch.tools.scan_slices import Segment
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.slice_output import SegmentWriter

ZONE = build_utm(32633)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A strip without a CRS."""
    path = tmp_path_factory.mktemp("areas") / "plain.las"
    simulate_strip("flat", path, pulses=400, seed=1)
    return path


@pytest.fixture(scope="module")
def strip(plain):
    """The same strip in UTM zone 33."""
    path = plain.with_name("utm.las")
    shutil.copy(plain, path)
    add_record(path, build_wkt(ZONE))
    return path


def _box(strip, part=(0.25, 0.75)):
    """Corners of a box in the middle of a strip, f8 (4, 2)."""
    header = read_header(strip)
    low, high = np.array(header.mins[:2]), np.array(header.maxs[:2])
    west, south = low + part[0] * (high - low)
    east, north = low + part[1] * (high - low)
    return np.array([[west, south], [east, south], [east, north], [west, north]])


def _write(path, ring, crs=None):
    shape = {"type": "Polygon", "coordinates": [ring.tolist()]}
    document = {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": shape}]}
    if crs is not None:
        document["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(document))
    return path


def _project(ring, source, target):
    pyproj = pytest.importorskip("pyproj", reason="pyproj (extra gis) is not installed")
    return np.stack(pyproj.Transformer.from_crs(source, target, always_xy=True).transform(*ring.T), axis=1)


@pytest.mark.parametrize("crs", [None, "urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326"])
def test_degrees_are_projected_into_the_strip(strip, tmp_path, crs):
    box = _box(strip)
    (polygon,) = load_polygons(_write(tmp_path / "a.geojson", _project(box, "EPSG:32633", "EPSG:4326"), crs))
    (ring,) = polygon.place(strip, read_header(strip)).rings
    # Every corner is there, and more between them where an edge is long.
    assert all(np.hypot(*(ring - corner).T).min() < 1e-4 for corner in box)
    assert np.hypot(*np.diff(ring, axis=0).T).max() < 120


def test_a_long_edge_is_straight_in_degrees_as_the_standard_says(strip):
    pyproj = pytest.importorskip("pyproj", reason="pyproj (extra gis) is not installed")
    header = replace(read_header(strip), mins=(3e5, 5e6, 0.0), maxs=(3.5e5, 5.1e6, 0.0))
    file = read_area_file("a.geojson", None, [np.zeros((1, 2))])
    edge = np.array([[13.0, 48.0], [14.0, 48.0], [14.0, 48.1]])
    (ring,) = place_rings(file, [edge], strip, header)
    back = np.stack(pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(*ring.T), axis=1)
    south = back[: np.flatnonzero(np.isclose(back[:, 0], 14.0, atol=1e-9))[0]]
    np.testing.assert_allclose(south[:, 1], 48.0, atol=1e-9)
    assert len(south) > 500 and np.ptp(ring[: len(south), 1]) > 100  # in UTM it bends by more than 100 m
    # A neighbour that has the edge in the other direction has the same corners: no gap, no overlap.
    (other,) = place_rings(file, [edge[::-1]], strip, header)
    assert {tuple(row) for row in ring.tolist()} == {tuple(row) for row in other.tolist()}


def test_a_named_crs_is_projected_and_the_strips_own_is_not(strip, tmp_path):
    box = _box(strip)
    (same,) = load_polygons(_write(tmp_path / "a.geojson", box, "urn:ogc:def:crs:EPSG::32633"))
    assert same.place(strip, read_header(strip)).rings[0].tolist() == box.tolist()
    other = _project(box, "EPSG:32633", "EPSG:32632")
    (far,) = load_polygons(_write(tmp_path / "b.geojson", other, "urn:ogc:def:crs:EPSG::32632"))
    np.testing.assert_allclose(far.place(strip, read_header(strip)).rings[0], box, atol=1e-3)


def test_coordinates_of_the_strip_stay(strip, plain, tmp_path):
    for path in (strip, plain):
        (polygon,) = load_polygons(_write(tmp_path / "a.geojson", _box(path)))
        assert polygon.place(path, read_header(path)).rings[0].tolist() == _box(path).tolist()
    # A strip with local coordinates near the origin has areas there: they are no degrees.
    near = type("H", (), {"mins": (0, 0, 0), "maxs": (80, 60, 9), "vlrs": ()})()
    file = read_area_file("a.geojson", None, [np.eye(2)])
    assert place_rings(file, [np.eye(2)], strip, near)[0].tolist() == np.eye(2).tolist()


def _local(path, low=0.0, high=400.0):
    """The header of a strip as if it lay in a local grid, and were larger than degrees are."""
    return replace(read_header(path), mins=(low, low, low), maxs=(high, high, high))


@pytest.mark.parametrize("has_crs", [False, True])
def test_small_coordinates_inside_of_a_strip_are_those_of_the_strip(strip, plain, has_crs):
    path = strip if has_crs else plain
    boxes = [_square(10, 80), _square(-50, -10)]
    file = read_area_file("a.geojson", None, boxes)
    for box in boxes:  # the second misses the strip; all areas of a file are in one CRS
        assert place_rings(file, [box], path, _local(path))[0].tolist() == box.tolist()
    alone = read_area_file("a.geojson", None, boxes[1:])  # can only be in degrees
    if has_crs:
        assert np.abs(place_rings(alone, boxes[1:], path, _local(path))[0]).max() > 1e6
    else:
        with pytest.raises(InputError, match="is in degrees"):
            place_rings(alone, boxes[1:], path, _local(path))


def test_one_point_at_the_origin_does_not_make_degrees_coordinates_of_the_strip(strip):
    header = read_header(strip)
    box = _project(_box(strip), "EPSG:32633", "EPSG:4326")
    file = read_area_file("a.geojson", None, [box])
    placed = place_rings(file, [box], strip, replace(header, mins=(0.0, 0.0, 0.0)))[0]
    assert placed.tolist() == place_rings(file, [box], strip, header)[0].tolist() and placed.min() > 1e5


def _square(low, high):
    return np.array([[low, low], [high, low], [high, high], [low, high]], np.float64)


def test_what_cannot_be_placed_is_one_line(strip, plain, tmp_path, monkeypatch):
    degrees = np.array([[15.6, 48.6], [15.7, 48.6], [15.7, 48.7]])
    (polygon,) = load_polygons(_write(tmp_path / "a.geojson", degrees))
    with pytest.raises(InputError, match=r"a.geojson: is in degrees \(OGC:CRS84\), and .*plain.las has no CRS"):
        polygon.place(plain, read_header(plain))
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(ConfigError, match=r"a.geojson: is in OGC:CRS84, .*needs pyproj: .*pip install .*; or write"):
        polygon.place(strip, read_header(strip))
    with pytest.raises(ConfigError, match="its member crs has no name"):
        read_area_file("c.geojson", {"type": "link"}, [])


def test_without_pyproj_only_the_strips_own_code_is_taken(strip, tmp_path, monkeypatch):
    """Two CRS of the same zone differ by hundreds of metres: that the areas lie in the strip says nothing."""
    monkeypatch.setitem(sys.modules, "pyproj", None)
    header, box = read_header(strip), _box(strip)
    names = ("EPSG:32633", "epsg:32633", "urn:ogc:def:crs:EPSG::32633", "urn:x-ogc:def:crs:EPSG:6.9:32633",
             "http://www.opengis.net/def/crs/EPSG/0/32633", ZONE)  # fmt: skip
    for name in names:
        (polygon,) = load_polygons(_write(tmp_path / "a.geojson", box, name))
        assert polygon.place(strip, header).rings[0].tolist() == box.tolist()
    for name in ("EPSG:23033", "EPSG:25833", "my grid", "x" * 10_000):
        (polygon,) = load_polygons(_write(tmp_path / "a.geojson", box, name))
        with pytest.raises(ConfigError, match=r"is in EPSG:32633; .*needs pyproj: .*pip install .*; or") as caught:
            polygon.place(strip, header)
        assert name[:60] in str(caught.value) and len(str(caught.value)) < 600


def test_a_strip_without_a_crs_takes_no_small_coordinates_of_a_named_one(plain):
    """They could be degrees of that CRS; large ones can only be metres."""
    header = read_header(plain)
    for name in ("EPSG:4258", "EPSG:31467"):
        file = AreaFile("a.geojson", name, (10, 10, 80, 80))
        with pytest.raises(InputError, match=f"a.geojson: is in {name}, and .*plain.las has no CRS"):
            place_rings(file, [_square(10, 80)], plain, _local(plain))
    file = read_area_file("a.geojson", {"properties": {"name": "EPSG:31467"}}, [_box(plain)])
    assert place_rings(file, [_box(plain)], plain, header)[0].tolist() == _box(plain).tolist()


def test_degrees_of_a_strip_in_degrees_stay(plain, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    path = shutil.copy(plain, tmp_path / "degrees.las")
    keys = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 2, 2048, 0, 1, 4326)
    add_record(path, Vlr(b"LASF_Projection", 34735, keys))
    file = read_area_file("a.geojson", {"properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}, [_square(10, 80)])
    assert place_rings(file, [_square(10, 80)], path, _local(path))[0].tolist() == _square(10, 80).tolist()


def test_an_unknown_crs_is_one_line(strip, tmp_path):
    (polygon,) = load_polygons(_write(tmp_path / "a.geojson", _box(strip), "my grid"))
    with pytest.raises(InputError, match="a.geojson: cannot be projected into the CRS of .*utm.las") as caught:
        polygon.place(strip, read_header(strip))
    assert "\n" not in str(caught.value)


def test_a_crs_counts_wherever_it_stands(tmp_path):
    """GDAL names it in the document, PostGIS in each geometry."""
    member = {"type": "name", "properties": {"name": "EPSG:32632"}}
    shape = {"type": "Polygon", "coordinates": [_square(10, 80).tolist()]}
    parts = {"type": "MultiPolygon", "coordinates": [shape["coordinates"]]}
    named = {"geometry": {**shape, "crs": member}, "type": "Feature"}
    documents = [{**shape, "crs": member}, {**parts, "crs": member}, named,
                 {"type": "Feature", "geometry": shape, "crs": member},
                 {"type": "FeatureCollection", "features": [named, named]},
                 {"type": "FeatureCollection", "features": [{"geometry": shape}, named], "crs": member},
                 {"type": "FeatureCollection", "features": [{"geometry": shape}], "crs": member}]  # fmt: skip
    for document in documents:
        (tmp_path / "a.geojson").write_text(json.dumps(document))
        assert {polygon.file.crs for polygon in load_polygons(tmp_path / "a.geojson")} == {"EPSG:32632"}
    other = {"type": "name", "properties": {"name": "EPSG:4326"}}
    for more in ({"geometry": shape}, {"geometry": shape, "crs": other}):
        (tmp_path / "a.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [named, more]}))
        with pytest.raises(ConfigError, match=r"its areas name more than one CRS \(EPSG:32632, (none|EPSG:4326)\)"):
            load_polygons(tmp_path / "a.geojson")


def test_resume_sees_another_crs_of_the_same_corners(strip, tmp_path):
    file, words = tmp_path / "a.geojson", ["run", strip, "-o", tmp_path / "o", "--polygon", tmp_path / "a.geojson"]
    said = []
    for crs in ("EPSG:32633", "urn:ogc:def:crs:EPSG::32633", "EPSG:23033", "EPSG:23033"):
        _write(file, _box(strip), crs)
        result = succeed(*words, "--resume")
        report = json.loads((tmp_path / "o" / "utm.report.json").read_text())
        said.append(("skipped" in result.stderr, report["request"]["selection"]["polygon"]["crs"]))
    assert said == [(False, "EPSG:32633"), (True, "EPSG:32633"), (False, "EPSG:23033"), (True, "EPSG:23033")]


def test_run_stats_and_calibrate_use_placed_areas(strip, tmp_path):
    """The same points, areas and echoes by degrees as by coordinates of the strip."""
    box = _box(strip)
    degrees = _write(tmp_path / "deg.geojson", _project(box, "EPSG:32633", "EPSG:4326"))
    own = _write(tmp_path / "own.geojson", box)
    numbers, counted = [], []
    for name, file in (("a", degrees), ("b", own)):
        result = succeed("run", strip, "-o", tmp_path / name, "--polygon", file, "-q")
        numbers.append(read_header(tmp_path / name / "utm.laz").point_count)
        result = run_command("stats", strip, "--polygon", file, "--json")
        counted.append([area["points"] for area in json.loads(result.stdout)["files"][0]["areas"]])
        again = ["run", str(strip), "-o", str(tmp_path / name), "--polygon", str(file), "--resume"]
        assert "skipped" in run_command(*again).stderr  # the report has the corners of the file
    # An edge that is straight in degrees bends by a centimetre in UTM.
    assert 20 < numbers[0] < read_header(strip).point_count and abs(numbers[0] - numbers[1]) < 5
    assert len(counted[0]) == len(counted[1]) == 2 and abs(counted[0][0] - counted[1][0]) < 5
    targets = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"reflectance": 0.3}, "geometry": {"type": "Polygon", "coordinates": [
            _project(_box(strip, (-0.2, 1.2)), "EPSG:32633", "EPSG:4326").tolist()]}}]}  # fmt: skip
    (tmp_path / "t.geojson").write_text(json.dumps(targets))
    words = ["calibrate", strip, "--targets", tmp_path / "t.geojson", "-o", tmp_path / "cal.toml"]
    result = run_command(*words)
    assert "lies outside" not in result.output and "0 clean single echoes" not in result.output


def test_an_area_that_misses_the_strip_is_named_with_both_extents(strip, tmp_path):
    away = _write(tmp_path / "away.geojson", _box(strip) + 1e4)
    result = run_command("run", strip, "-o", tmp_path / "o", "--polygon", away, "-q")
    assert "no point is written" in result.stderr
    assert "lies outside the strip, which by its header has x " in result.stderr
    result = run_command("stats", strip, "--polygon", away)
    assert "lies outside the strip, which by its header has x " in result.output


POINTS = np.array([[500000.0, 5400000.0, 312.3456], [500010.0, 5400020.5, 301.0]])


def test_longitude_and_latitude():
    for code, longitude in ((32632, 9.0), (25833, 15.0)):
        crs = plan_crs("a.las", build_utm(code), "wgs84")
        (x, y, z), (other, _, _) = crs.place(POINTS)
        assert (x, y, z) == (pytest.approx(longitude, abs=1e-8), pytest.approx(48.7528, abs=1e-3), 312.3456)
        # 10 m east at this latitude
        assert (other - x) * np.cos(np.radians(y)) * 111320 == pytest.approx(10, rel=0.01)
        assert crs.member is None
    with pytest.raises(InputError, match="a.las: its CRS is not understood"):
        plan_crs("a.las", "PROJCS[nothing]", "wgs84")


def test_riegls_metres_in_the_geographic_crs_are_degrees():
    path = data_file("riegl-q680i/100429_152240_2535pt_UTM.las")
    header = read_header(path)
    text, _ = read_crs(path, header)
    found = read_crs_definition(path, header)
    assert text.count("Meter") == 2 and found.count("Meter") == 1 and found.count('UNIT["degree"') == 1
    ((longitude, latitude, _),) = plan_crs(path, found, "wgs84").place(np.array([header.mins]))
    assert (longitude, latitude) == (pytest.approx(15.656, abs=0.01), pytest.approx(48.66, abs=0.01))


@pytest.mark.parametrize(
    ("crs", "name"),
    [
        (build_utm(32632), "urn:ogc:def:crs:EPSG::32632"),
        ("EPSG:31468", "urn:ogc:def:crs:EPSG::31468"),
        ('PROJCRS["x",ID["EPSG",25832]]', "urn:ogc:def:crs:EPSG::25832"),
        ('PROJCS["x",AUTHORITY["EPSG","0"]]', 'PROJCS["x"]'),
        ('PROJCS["x",UNIT["m",1,AUTHORITY["EPSG","9001"]]]', 'PROJCS["x",UNIT["m",1,AUTHORITY["EPSG","9001"]]]'),
    ],
)
def test_the_strips_crs_is_named(crs, name):
    found = plan_crs("a.las", crs, "keep")
    assert found.member == {"type": "name", "properties": {"name": name}}
    assert found.place(POINTS) == POINTS.tolist()


def test_what_cannot_be_placed_is_said(monkeypatch):
    with pytest.raises(InputError, match="a.las: has no CRS, .* write .csv, or --geojson-crs keep"):
        plan_crs("a.las", None, "wgs84")
    assert plan_crs("a.las", None, "keep").member is None
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(ConfigError, match="needs pyproj: .*pip install .pyproj>=3.6.; or write .csv"):
        plan_crs("a.las", "EPSG:32632", "wgs84")
    with pytest.raises(ConfigError, match="must be one of wgs84, keep"):
        plan_crs("a.las", None, "epsg")


@pytest.mark.parametrize("mode", ["wgs84", "keep"])
def test_gdal_finds_segments_where_they_are(tmp_path, mode):
    pyogrio, pyproj = pytest.importorskip("pyogrio"), pytest.importorskip("pyproj")
    segment = Segment.__new__(Segment)
    for crs in (build_utm(32632), build_utm(32632).replace('AUTHORITY["EPSG","32632"]', 'AUTHORITY["EPSG","0"]')):
        values = dict.fromkeys(Segment.__slots__, 1)
        values |= {"start": tuple(POINTS[0]), "end": tuple(POINTS[1])}
        for name, value in values.items():
            object.__setattr__(segment, name, value)
        target = tmp_path / "a.geojson"
        with SegmentWriter(target, crs=plan_crs("a.las", crs, mode), overwrite=True) as writer:
            writer.write([segment])
            writer.commit()
        info = pyogrio.read_info(target)
        west, south, *_ = info["total_bounds"]
        to_degrees = pyproj.Transformer.from_crs(info["crs"], "EPSG:4326", always_xy=True)
        assert to_degrees.transform(west, south) == pytest.approx((9.0, 48.753013), abs=1e-5)
        assert json.loads(target.read_text())["type"] == "FeatureCollection"


def test_both_extents_are_named(strip):
    header = read_header(strip)
    assert describe_miss([_box(strip)], header) == "" == describe_miss([], header)
    text = describe_miss([_box(strip) + 1e5], header)
    assert f"{_box(strip)[0, 0] + 1e5:.10g}" in text and f"{header.mins[0]:.10g}" in text and "another CRS" in text
