"""WKT from GeoTIFF keys: UTM zones to the letter of EPSG, and nothing that is not sure."""

import struct
import sys

import pytest
from writer_tools import data_file

from wavebatch.core.errors import InputError
from wavebatch.files.las.crs import parse_wkt
from wavebatch.files.las.geo_keys import build_utm, convert_geotiff, find_code
from wavebatch.files.las.header import Vlr, read_header


def keys(**values):
    """A GeoKeyDirectory with these keys, by number with a k in front."""
    rows = [(int(key[1:]), 0, 1, value) for key, value in values.items()]
    flat = [number for row in [(1, 1, 0, len(rows)), *rows] for number in row]
    return [Vlr(b"LASF_Projection", 34735, struct.pack(f"<{len(flat)}H", *flat))]


@pytest.mark.parametrize(
    ("code", "name", "meridian", "northing", "datum"),
    [
        (32601, "WGS 84 / UTM zone 1N", -177, 0, "6326"),
        (32760, "WGS 84 / UTM zone 60S", 177, 10000000, "6326"),
        (25832, "ETRS89 / UTM zone 32N", 9, 0, "6258"),
        (26910, "NAD83 / UTM zone 10N", -123, 0, "6269"),
    ],
)
def test_utm_zones(code, name, meridian, northing, datum):
    text = build_utm(code)
    assert text.startswith(f'PROJCS["{name}"') and text.endswith(f'AUTHORITY["EPSG","{code}"]]')
    assert f'"central_meridian",{meridian}]' in text and f'"false_northing",{northing}]' in text
    assert f'AUTHORITY["EPSG","{datum}"]' in text and text.count("[") == text.count("]")
    assert parse_wkt(text).is_metric and parse_wkt(text).kind == "projected"


@pytest.mark.parametrize("code", [32600, 32661, 25827, 25839, 26924, 31468, 4326, 0])
def test_other_codes_are_not_guessed(code):
    assert build_utm(code) is None


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ({"k1024": 1, "k3072": 32633}, 32633),
        ({"k1024": 1, "k3072": 32633, "k3076": 9001, "k4099": 9001}, 32633),
        ({"k1024": 1, "k3072": 32633, "k4096": 5030}, 32633),  # heights above the ellipsoid
        ({"k1024": 1, "k3072": 32633, "k4096": 5703}, None),  # NAVD88: a compound CRS
        ({"k1024": 1, "k3072": 32633, "k3076": 9002}, None),  # feet
        ({"k1024": 1, "k3072": 32633, "k4099": 9003}, None),
        ({"k1024": 2, "k2048": 4326}, None),  # degrees
        ({"k1024": 1, "k3072": 32767}, None),  # user-defined
        ({"k1024": 1, "k3076": 32632}, 32632),  # Leica's
        ({}, None),
    ],
)
def test_only_sure_codes_are_found(values, code):
    assert find_code(keys(**values)) == code


def test_keys_of_any_bytes():
    for payload in (b"", b"abc", bytes(7), b"\xff" * 64, struct.pack("<4H", 1, 1, 0, 9)):
        assert find_code([Vlr(b"LASF_Projection", 34735, payload)]) is None


def test_leicas_own_place_of_the_code():
    path = data_file("leica-als/simple1_3_full_internal.las")
    assert '"WGS 84 / UTM zone 32N"' in convert_geotiff(path, read_header(path).vlrs, asked=False)


def test_a_crs_that_only_pyproj_knows(tmp_path, monkeypatch):
    other = keys(k1024=1, k3072=31468)
    assert convert_geotiff(tmp_path, other, asked=False) is None  # the same bytes with and without pyproj
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pyproj", None)
        with pytest.raises(
            InputError, match=r"EPSG:31468, which pyproj would convert: .*pip install .pyproj"
        ):
            convert_geotiff(tmp_path, other, asked=True)
    pytest.importorskip("pyproj")
    assert '"31468"' in convert_geotiff(tmp_path, other, asked=True)
