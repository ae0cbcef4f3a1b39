"""GeoJSON lies where the strip lies, by what RFC 7946 and GDAL make of its coordinates."""

import json
import sys

import numpy as np
import pytest
from writer_tools import data_file

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.geojson import plan_crs
from wavebatch.files.las.crs import read_crs, read_crs_definition
from wavebatch.files.las.geo_keys import build_utm
from wavebatch.files.las.header import read_header
from wavebatch.tools.slices.output import SegmentWriter
from wavebatch.tools.slices.segments import Segment

POINTS = np.array([[500000.0, 5400000.0, 312.3456], [500010.0, 5400020.5, 301.0]])


def test_longitude_and_latitude():
    pytest.importorskip("pyproj")
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
    pytest.importorskip("pyproj")
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
