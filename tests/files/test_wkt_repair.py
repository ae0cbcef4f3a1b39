"""RIEGL's RiPROCESS writes metres as the unit of longitudes: whatever wavebatch writes lies where the strip lies."""

import json

import pytest
from batch_tools import run_one
from click.testing import CliRunner
from strips import add_record

from wavebatch.cli import main
from wavebatch.files.las.crs import parse_wkt, read_crs_definition, repair_records, repair_wkt
from wavebatch.files.las.geotiff_wkt import build_utm
from wavebatch.files.las.header import WKT_ID, Vlr, build_wkt, is_projection, read_header
from wavebatch.tools.simulate import simulate_strip

METRE = 'UNIT["Meter",1.00000000000000000000,AUTHORITY["EPSG","9001"]]'
RIPROCESS = (
    'PROJCS["UTM_North zone 33",GEOGCS["UTM_North zone 33",DATUM["WGS84",SPHEROID["WGS84",6378137.000,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0.0,AUTHORITY["EPSG","8901"]],'
    f'{METRE},AUTHORITY["EPSG","0"]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0.0],'
    'PARAMETER["central_meridian",15.0],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000.000],'
    f'PARAMETER["false_northing",0.000],{METRE},AXIS["Easting",EAST],AXIS["Northing",NORTH],AUTHORITY["EPSG","0"]]'
)  # fmt: skip


def test_only_the_unit_of_the_longitudes_changes():
    found = repair_wkt(RIPROCESS)
    assert found.count(METRE) == 1 and found.index('UNIT["degree"') < found.index("PROJECTION[")
    assert '"EPSG","0"' not in found and parse_wkt(found).horizontal == 1.0
    for right in (build_utm(32633), 'GEOGCS["WGS 84",UNIT["degree",0.0174532925199433]]', "EPSG:32633", "",
                  'LOCAL_CS["site",UNIT["metre",1,AUTHORITY["EPSG","9001"]],AUTHORITY["EPSG","0"]]'):  # fmt: skip
        assert repair_wkt(right) == right
    records = [build_wkt(RIPROCESS), build_wkt(build_utm(32633)), Vlr(b"other", WKT_ID, RIPROCESS.encode(), b"")]
    first, *rest = repair_records(records)
    assert first.payload == found.encode() + b"\0"
    assert all(one is old for one, old in zip(rest, records[1:], strict=True))


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """A strip with such a WKT in zone 33, whose longitude is 15.66 degrees."""
    path = tmp_path_factory.mktemp("wkt") / "s.las"
    simulate_strip("flat", path, pulses=300, seed=1)
    add_record(path, build_wkt(RIPROCESS))
    return path


def _longitude(definition):
    warp = pytest.importorskip("rasterio.warp", reason="rasterio (extra gis) is not installed")
    crs = pytest.importorskip("rasterio.crs").CRS.from_user_input(definition)
    return warp.transform(crs, "EPSG:4326", [548355.0], [5389944.0])[0][0]


def test_the_cloud_lies_where_the_strip_lies_and_says_what_changed(strip, tmp_path):
    for number, options in enumerate(({}, {"keep_packets": True}, {"las_version": "keep"})):
        outcome = run_one(strip, tmp_path / str(number), profile="fast", **options)
        assert outcome.error is None
        cloud = next((tmp_path / str(number)).glob("s.la[sz]"))
        header = read_header(cloud)
        (record,) = [vlr for vlr in header.vlrs if is_projection(vlr) and vlr.record_id == WKT_ID]
        assert record.payload == repair_wkt(RIPROCESS).encode() + b"\0"
        report = json.loads((tmp_path / str(number) / "s.report.json").read_text())
        assert any("as RiPROCESS writes it" in line for line in report["remarks"])
    assert _longitude(read_crs_definition(cloud, header)) == pytest.approx(15.6567, abs=1e-3)


def test_so_do_rasters_and_voxels(strip, tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="rasterio (extra gis) is not installed")
    for words in (["grid", strip, "--statistic", "count", "--size", 5, "-o", tmp_path / "x.tif"],
                  ["voxelize", strip, "--size", 5, "-o", tmp_path / "v.las"]):  # fmt: skip
        result = CliRunner().invoke(main, list(map(str, words)))
        assert result.exit_code == 0, result.output
    with rasterio.open(tmp_path / "x.tif") as raster:
        assert raster.crs.is_projected and _longitude(raster.crs) == pytest.approx(15.6567, abs=1e-3)
    voxels = tmp_path / "v.las"
    assert _longitude(read_crs_definition(voxels, read_header(voxels))) == pytest.approx(15.6567, abs=1e-3)
