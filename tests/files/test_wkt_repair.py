"""RIEGL's RiPROCESS writes metres as the unit of longitudes: whatever wavebatch writes lies where the strip lies."""

import json
import struct

import pytest
from batch_tools import run_one
from click.testing import CliRunner
from strips import add_record
from writer_tools import plan_output, write_source

from wavebatch.cli import main
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.las.crs import parse_wkt, read_crs_definition, repair_records, repair_wkt
from wavebatch.files.las.geo_keys import build_utm
from wavebatch.files.las.header import WKT_ID, Vlr, build_wkt, find_evlrs, is_projection, read_header
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
    records = [build_wkt(RIPROCESS), build_wkt(build_utm(32633)), Vlr(b"other", WKT_ID, RIPROCESS.encode(), b"")]
    first, *rest = repair_records(records)
    assert first.payload == found.encode() + b"\0"
    assert all(one is old for one, old in zip(rest, records[1:], strict=True))


GEOGCS = (
    'GEOGCS["NAD83",DATUM["North_American_Datum_1983",SPHEROID["GRS 1980",6378137,298.257222101]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4269"]]'
)
TM = 'PROJECTION["Transverse_Mercator"],PARAMETER["central_meridian",-123]'
HEIGHTS = 'VERT_CS["EGM",VERT_DATUM["EGM",2005],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
PLAIN = 'UNIT["metre",1,AUTHORITY["EPSG","9001"]]'
RIGHT = {
    "empty": "",
    "code": "EPSG:32633",
    "ours": build_utm(32633),
    "geographic": GEOGCS,
    "local": f'LOCAL_CS["site",{METRE},AUTHORITY["EPSG","0"]]',
    "unit first": f'PROJCS["NAD83 / UTM zone 10N",{GEOGCS},{PLAIN},{TM},AUTHORITY["EPSG","26910"]]',
    "unit before all": f'PROJCS["NAD83 / UTM zone 10N",{PLAIN},{GEOGCS},{TM}]',
    "degrees with heights": f'COMPD_CS["x",{GEOGCS},{HEIGHTS}]',
    "projected with heights": f'COMPD_CS["x",PROJCS["y",{GEOGCS},{TM},{PLAIN},AUTHORITY["EPSG","0"]],{HEIGHTS}]',
    "heights first": f'COMPD_CS["x",{HEIGHTS},PROJCS["y",{GEOGCS},{PLAIN},{TM}]]',
    "ESRI": 'PROJCS["NAD_1983_UTM_Zone_10N",GEOGCS["GCS",DATUM["D",SPHEROID["S",6378137.0,298.257222101]],PRIMEM["G",'
    '0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["Meter",1.0]]',
    "ESRI in 3D": 'GEOGCS["GCS",DATUM["D",SPHEROID["S",6378137.0,298.2]],UNIT["Degree",0.0174532925199433],'
    'LINUNIT["Meter",1.0]]',
    "radians": GEOGCS.replace('"degree",0.01745329251994328', '"radian",1'),
    "WKT2": 'PROJCRS["y",BASEGEOGCRS["WGS 84",DATUM["W",ELLIPSOID["W",6378137,298.2,LENGTHUNIT["metre",1]]],PRIMEM["G",'
    '0,ANGLEUNIT["degree",0.0174532925199433]]],CONVERSION["z",METHOD["Transverse Mercator"]],CS[Cartesian,2],'
    'AXIS["(E)",east],AXIS["(N)",north],LENGTHUNIT["metre",1],ID["EPSG",32633]]',
    "WKT2 in 3D": 'GEOGCRS["WGS 84",DATUM["W",ELLIPSOID["W",6378137,298.2]],CS[ellipsoidal,3],AXIS["lat",north,'
    'UNIT["degree",0.0174532925199433]],AXIS["h",up,UNIT["metre",1]]]',
    "brackets in names": f'PROJCS["a]b",{GEOGCS.replace("NAD83", "GEOGCS[ ""x"" ]")},{PLAIN},{TM}]',
    "not closed": RIPROCESS[:-1],
    "closed twice": "]" + RIPROCESS,
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_wkt_stays(name):
    assert repair_wkt(RIGHT[name]) == RIGHT[name]


@pytest.mark.parametrize("name", [name for name, text in RIGHT.items() if GEOGCS in text])
def test_only_a_unit_inside_of_the_geographic_crs_changes(name):
    """The other units stay what they are, wherever they stand."""
    right = RIGHT[name]
    assert repair_wkt(right.replace("GEOGCS[", "GEOGCS [")) == right.replace("GEOGCS[", "GEOGCS [")
    for unit in (METRE, PLAIN, 'UNIT["metre",1]', 'UNIT ( "Meter" , 1.0 )', 'UNIT["meters",1e0,AUTHORITY["EPSG","1"]]'):
        wrong = right.replace('UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9122"]]', unit)
        assert wrong != right
        found = repair_wkt(wrong)
        expected = right.replace("0.01745329251994328", "0.0174532925199433")
        assert found == expected.replace(',AUTHORITY["EPSG","0"]', "")
        assert parse_wkt(found) == parse_wkt(right)


def test_a_hostile_wkt_takes_no_time():
    for text in ("GEOGCS[" * 100_000, '"' * 1_000_001, "a" * 1_000_000, " [" * 300_000, 'UNIT["m",1' * 50_000):
        assert repair_wkt(text) == text


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


def _with_record(path, version, point_format, *, vlrs=(), evlrs=()):
    points = write_source(path, point_format, version, vlrs=list(vlrs), evlrs=list(evlrs))
    return points, plan_output(path, [], las_version="1.3" if version < (1, 4) else "1.4")


def _write(layout, target, rows):
    with CloudWriter(layout, target, provenance={}) as cloud:
        cloud.write(rows)
        cloud.commit()


def test_an_extended_record_is_right_in_the_cloud_too(tmp_path):
    """All else of the extended records stays, also after one that has become longer."""
    others = [(b"mine", WKT_ID, RIPROCESS.encode()), (b"last", 6, bytes(1000))]
    for name, wkt in (("wrong", RIPROCESS), ("right", build_utm(32633))):
        evlrs = [others[0], (b"LASF_Projection", WKT_ID, wkt.encode() + b"\0"), others[1]]
        points, layout = _with_record(tmp_path / f"{name}.las", (1, 4), 9, evlrs=evlrs)
        target = tmp_path / f"{name}.laz"
        _write(layout, target, layout.rows(points))
        header = read_header(target)
        found, missing = find_evlrs(target, header)
        payloads = [target.read_bytes()[evlr.start + 60 :][: evlr.length] for evlr in found]
        assert payloads == [others[0][2], repair_wkt(wkt).encode() + b"\0", others[1][2]] and missing == 0
        assert [(evlr.user, evlr.record_id) for evlr in found] == [(user.decode(), key) for user, key, _ in evlrs]
        assert any("as RiPROCESS writes it" in note for note in layout.notes) == (name == "wrong")
        assert read_crs_definition(target, header) == repair_wkt(wkt)


def test_las_1_3_has_no_wrong_wkt_beside_its_keys(tmp_path):
    keys = Vlr(b"LASF_Projection", 34735, struct.pack("<8H", 1, 1, 0, 1, 3072, 0, 1, 32633))
    points, layout = _with_record(tmp_path / "a.las", (1, 3), 4, vlrs=[keys, build_wkt(RIPROCESS)])
    _write(layout, tmp_path / "b.las", layout.rows(points))
    header = read_header(tmp_path / "b.las")
    assert header.version == (1, 3) and any("as RiPROCESS writes it" in note for note in layout.notes)
    payloads = [vlr.payload for vlr in header.vlrs if is_projection(vlr)]
    assert payloads == [keys.payload, repair_wkt(RIPROCESS).encode() + b"\0"]


def test_so_do_synthetic_strips(strip, tmp_path):
    words = ["synthesize", strip, "-o", tmp_path / "s.las"]
    result = CliRunner().invoke(main, list(map(str, words)))
    assert result.exit_code == 0, result.output
    definition = read_crs_definition(tmp_path / "s.las", read_header(tmp_path / "s.las"))
    assert definition == repair_wkt(RIPROCESS)
    records = [vlr.payload for vlr in read_header(tmp_path / "s.las").vlrs if vlr.record_id == WKT_ID]
    assert records == [repair_wkt(RIPROCESS).encode() + b"\0"]


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
