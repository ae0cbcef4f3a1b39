"""CRS of strips, clouds, areas and GeoJSON: read, compared, written, and projected."""

import json
import re
import shutil
import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from batch_tools import run_one
from commands import fail, refuses, run_command, succeed
from helpers_scenes import simulated
from hypothesis import given
from hypothesis import strategies as st
from strips import add_record, descriptor, make_raw, place_header, vlr
from writer_tools import data_file, plan_output, write_source

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.geojson import AreaFile, describe_miss, load_polygons, place_rings, plan_crs, read_area_file
from wavebatch.files.las.crs import (
    METRES,
    CrsUnits,
    GeoKeys,
    build_utm,
    convert_geotiff,
    find_code,
    parse_wkt,
    read_crs,
    read_crs_definition,
    repair_records,
    repair_wkt,
)
from wavebatch.files.las.header import WKT_ID, Vlr, build_wkt, find_evlrs, is_projection, read_header
from wavebatch.files.strip.packets import find_facts
from wavebatch.files.strip.reader import StripReader, measure_scale
from wavebatch.stages.attribute.basic import position
from wavebatch.tools.scan_slices import Segment
from wavebatch.tools.simulate import find_scene, simulate_strip
from wavebatch.tools.simulate.render import FlightLine
from wavebatch.tools.simulate.strip import WKT
from wavebatch.tools.slice_output import SegmentWriter

US = 1200 / 3937
GEOG = 'GEOGCS["NAD83",DATUM["D",SPHEROID["GRS 1980",6378137,298.257222101]],UNIT["degree",0.0174532925199433]]'
FEET = f'PROJCS["NY (ftUS)",{GEOG},PROJECTION["Lambert"],PARAMETER["x",1],UNIT["US survey foot",0.3048006096012192]]'
UTM = f'PROJCS["UTM",{GEOG},PROJECTION["TM"],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["E",EAST],AXIS["N",NORTH]]'
HEIGHT = 'VERT_CS["NAVD88",VERT_DATUM["N",2005],UNIT["foot",0.3048],AXIS["Up",UP]]'
WKT2 = (
    'PROJCRS["u",BASEGEOGCRS["ETRS89",DATUM["D",ELLIPSOID["GRS 1980",6378137,298.2,LENGTHUNIT["metre",1]]]],'
    'CONVERSION["c",METHOD["Transverse Mercator"],PARAMETER["k",0.9996,SCALEUNIT["unity",1]]],CS[Cartesian,2],'
    'AXIS["(E)",east,ORDER[1],LENGTHUNIT["foot",0.3048]],AXIS["(N)",north,ORDER[2],LENGTHUNIT["foot",0.3048]]]'
)
THREE = (
    'PROJCRS["3D",CS[Cartesian,3],AXIS["E",east],AXIS["N",north],AXIS["h",up,LENGTHUNIT["foot",0.3048]],'
    'LENGTHUNIT["metre",1]]'
)
GEODETIC = 'GEODCRS["WGS 84",DATUM["W",ELLIPSOID["e",6378137,298]],CS[{}],AXIS["a",north]]'


def parse_geotiff(*records):
    """Kind and units of GeoTIFF keys, as `read_crs` gives them."""
    keys = GeoKeys.parse(*records)
    return CrsUnits(keys.kind, *keys.read_units())


@pytest.mark.parametrize(
    ("text", "units"),
    [
        (WKT, CrsUnits("projected", 1.0)),
        (UTM, CrsUnits("projected", 1.0)),
        (FEET, CrsUnits("projected", 0.3048006096012192)),
        (GEOG, CrsUnits("geographic")),
        (f'COMPD_CS["both",{UTM},{HEIGHT}]', CrsUnits("projected", 1.0, 0.3048)),
        (f'COMPD_CS["both",{GEOG},{HEIGHT}]', CrsUnits("geographic", None, 0.3048)),
        (f"BOUNDCRS[SOURCECRS[{FEET}],TARGETCRS[{GEOG}]]", CrsUnits("projected", 0.3048006096012192)),
        (WKT2, CrsUnits("projected", 0.3048)),
        (THREE, CrsUnits("projected", 1.0, 0.3048)),
        (GEODETIC.format("ellipsoidal,2"), CrsUnits("geographic")),
        (GEODETIC.format("Cartesian,3"), CrsUnits("geocentric")),
        (f'GEOCCS["WGS 84",{GEOG},UNIT["metre",1]]', CrsUnits("geocentric")),
        ('LOCAL_CS["site",UNIT["m",1.0]]', CrsUnits("projected", 1.0)),
        (FEET.replace("[", "(").replace("]", ")"), CrsUnits("projected", 0.3048006096012192)),
        (UTM.replace("[", " [\n"), CrsUnits("projected", 1.0)),
        ("", CrsUnits()),
        ("EPSG:25832", CrsUnits()),
        (UTM[:-1], CrsUnits()),
        ("A[" * 5000 + "]" * 5000, CrsUnits()),
    ],
)
def test_units_of_wkt(text, units):
    assert parse_wkt(text) == units


@pytest.mark.parametrize("size", ["nan", "0", "-1", "1e999", "x"])
def test_sizes_that_are_none_are_no_metres(size):
    units = parse_wkt(f'PROJCS["p",UNIT["u",{size}]]')
    assert np.isnan(units.horizontal) and not units.is_metric


def keys(*entries):
    """A GeoKeyDirectory of (key, place, count, value)."""
    return struct.pack("<4H", 1, 1, 0, len(entries)) + b"".join(struct.pack("<4H", *entry) for entry in entries)


def short(key, value):
    return key, 0, 1, value


@pytest.mark.parametrize(
    ("directory", "doubles", "citation", "units"),
    [
        (keys(short(1024, 1), short(3072, 25832), short(3076, 9001)), b"", b"", CrsUnits("projected", 1.0)),
        (keys(short(1024, 1), short(3076, 9002)), b"", b"", CrsUnits("projected", 0.3048)),
        (keys(short(1024, 1), short(3076, 9003), short(4099, 9001)), b"", b"", CrsUnits("projected", US, 1.0)),
        (keys(short(1024, 1), short(3076, 9001), short(4099, 9003)), b"", b"", CrsUnits("projected", 1.0, US)),
        (keys(short(1024, 2), short(2048, 4326), short(2054, 9102)), b"", b"", CrsUnits("geographic")),
        (keys(short(1024, 3)), b"", b"", CrsUnits("geocentric")),
        (keys(short(1024, 1), short(3072, 2263)), b"", b"NAD83 / New York (ftUS)|", CrsUnits("projected", US)),
        (keys(short(1024, 1)), b"", b"State plane, feet|", CrsUnits("projected", 0.3048)),
        (keys(short(1024, 1), short(3072, 2263)), b"", b"", CrsUnits("projected", US)),
        (keys(short(1024, 1), short(3072, 2222)), b"", b"", CrsUnits("projected", 0.3048)),
        (keys(short(1024, 1), short(3072, 3492)), b"", b"", CrsUnits("projected", US)),
        (keys(short(1024, 1), short(3072, 3491)), b"", b"", CrsUnits("projected")),
        (keys(short(1024, 1), short(3072, 25832), short(4096, 6360)), b"", b"", CrsUnits("projected", None, US)),
        (keys(short(1024, 1), short(3072, 2263), short(3076, 9001)), b"", b"", CrsUnits("projected", 1.0)),
        (keys(short(1024, 1), short(3072, 32767), short(4096, 32767)), b"", b"", CrsUnits("projected")),
        (keys(short(1024, 1)), b"", b"UTM zone 32N, Fort Lee|", CrsUnits("projected")),
        (keys(short(3076, 32767), (3077, 34736, 1, 1)), struct.pack("<2d", 7.0, 0.5), b"", CrsUnits(None, 0.5)),
        (keys(short(1024, 1), short(3076, 32632), short(4099, 9001)), b"", b"", CrsUnits("projected", None, 1.0)),
        (b"", b"", b"", CrsUnits()),
    ],
)
def test_units_of_geotiff_keys(directory, doubles, citation, units):
    assert parse_geotiff(directory, doubles, citation) == units


@pytest.mark.parametrize(
    ("directory", "doubles"),
    [
        (keys(short(3076, 9099)), b""),
        (keys(short(3076, 32767)), b""),
        (keys(short(3076, 32767), (3077, 34736, 1, 9)), struct.pack("<d", 0.5)),
        (keys(short(3076, 32767), (3077, 34736, 1, 0)), struct.pack("<d", np.inf)),
        (keys(short(4099, 9199), short(3076, 9001)), b""),
    ],
)
def test_units_that_nobody_knows_are_no_metres(directory, doubles):
    units = parse_geotiff(directory, doubles)
    assert not units.is_metric
    assert "an unknown unit" in units.describe()


@pytest.mark.parametrize(
    ("directory", "citation", "crs", "definition"),
    [
        (keys(short(1024, 1), short(3072, 2263), short(4096, 6360)), b"x|", "EPSG:2263+6360", "EPSG:2263"),
        (keys(short(1024, 1), short(3072, 25832)), b"", "EPSG:25832", "EPSG:25832"),
        (keys(short(1024, 2), short(2048, 4326)), b"", "EPSG:4326", "EPSG:4326"),
        (keys(short(1024, 1), short(3072, 1024)), b"", "EPSG:1024", "EPSG:1024"),  # the least code
        (keys(short(1024, 1), short(3072, 32767)), b"mine|", "GeoTIFF: mine", None),
        (keys(short(1024, 1)), b"", "GeoTIFF keys", None),
        # Leica's ALSPP: the code of the CRS stands where that of the unit belongs.
        (keys(short(1024, 1), short(3076, 32632)), b"", "GeoTIFF keys", "EPSG:32632"),
    ],
)
def test_the_code_of_geotiff_keys_is_the_name_of_the_crs(tmp_path, directory, citation, crs, definition):
    raw = make_raw(60)
    raw.vlrs = [descriptor(1), projection(34735, directory), projection(34737, citation)]
    with StripReader(raw.write(tmp_path / "s.las")) as reader:
        assert reader.facts.crs == crs
        found = [read_crs_definition(reader.facts.path, reader.facts.header, heights=both) for both in (False, True)]
        assert found == [definition, crs if crs.startswith("EPSG") else definition]


@given(st.binary(max_size=200), st.binary(max_size=64), st.binary(max_size=64))
def test_any_bytes_give_units_or_none(directory, doubles, citation):
    for front in (b"", struct.pack("<4H", 1, 1, 0, 20)):
        units = parse_geotiff(front + directory, doubles, citation)
        assert units.horizontal is None or not units.horizontal <= 0
    parse_wkt(directory.decode("utf-8", "replace"))


@given(st.lists(st.sampled_from([*'[](),"', "PROJCS", "UNIT", "GEOGCS", "1", "-.e", "COMPD_CS", "AXIS"]), max_size=80))
def test_any_heap_of_wkt_words_gives_units(words):
    assert isinstance(parse_wkt("".join(words)), CrsUnits)


def test_foot_and_metre_have_their_codes():
    assert METRES[9001] == 1.0 and METRES[9002] == 0.3048 and METRES[9003] == pytest.approx(0.3048006096, rel=1e-10)


def projection(record_id, payload):
    return vlr(b"LASF_Projection", record_id, payload)


@pytest.mark.parametrize(
    ("records", "message"),
    [
        ([projection(34735, keys(short(1024, 2)))], "coordinates are degrees"),
        ([projection(34735, keys(short(1024, 1), short(3076, 9003)))], "coordinates are US survey feet"),
        ([projection(34735, keys(short(3076, 9001), short(4099, 9002)))], "metres with heights in international feet"),
        ([projection(2112, UTM.encode()), projection(34735, keys(short(3076, 9002)))], "are international feet"),
        ([vlr(b"lasf_projection", 34735, keys(short(1024, 2)))], "coordinates are degrees"),
        ([projection(34735, b"\xff" * 40)], None),
        ([projection(34735, keys(short(1024, 1), short(3076, 9001)))], None),
    ],
)
def test_strips_that_are_not_in_metres_get_no_physics(tmp_path, records, message):
    raw = make_raw(60)
    raw.vlrs = [descriptor(1), *records]
    strip = raw.write(tmp_path / "s.las")
    with StripReader(strip) as reader:
        assert len(reader.facts.units) == len(records)
    arguments = ["run", str(strip), "-o", str(tmp_path / "out"), "--profile", "fast"]
    done = run_command(*arguments, "--flight-height", "500")
    if message is None:
        assert done.exit_code == 0, done.output
        return
    assert done.exit_code == 4
    assert message in done.stderr and "project the strip to metres" in done.stderr
    assert run_command(*arguments).exit_code == 0


@pytest.mark.quick_cases("flat")
@pytest.mark.parametrize("scene", ["urban", "flat"])
def test_feet_with_metric_vectors_and_no_crs_are_found(tmp_path, scene):
    slow = replace(find_scene(scene), flight=FlightLine(pulse_rate=50_000))
    simulate_strip(slow, tmp_path / "m.las", pulses=30_000, seed=3)
    feet = place_header(tmp_path / "m.las", lambda metres: metres / 0.3048, tmp_path / "feet.las")
    chain = tmp_path / "chain.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.closed_form", "attribute.position", "attribute.range")
    chain.write_text("".join(f'[[chain]]\nstage = "{name}"\n' for name in stages))
    done = {
        strip.stem: run_command("run", strip, "-o", tmp_path / "out", "--chain", chain)
        for strip in (tmp_path / "m.las", feet)
    }
    assert done["m"].exit_code == 0 and "in feet" not in done["m"].stderr
    with StripReader(feet) as reader, reader.scan() as scan:
        scale = measure_scale(reader, scan).scale
    if scene == "urban":
        assert scale == pytest.approx(1 / 0.3048, rel=0.001)
        assert done["feet"].exit_code == 4
        assert "coordinates are in feet, packet vectors in metres" in done["feet"].stderr
    else:  # single returns show no distance: only the flight does
        assert scale is None and done["feet"].exit_code == 0
        assert "197 m/s" in done["feet"].stderr and "are they in feet?" in done["feet"].stderr


@pytest.mark.parametrize(
    ("middle", "geocentric"),
    [
        ((4_194_000, 1_162_000, 4_647_000), True),  # Munich
        ((-2_700_000, -4_290_000, 3_855_000), True),  # San Francisco
        ((-4_646_000, 2_553_000, -3_534_000), True),  # Sydney
        ((1_500_000, 6_193_000, 150_000), True),  # 1.4 degrees north
        ((500_000, 5_400_000, 120), False),
        ((500_000, 6_350_000, 120), False),  # UTM in Scotland: as far from its origin
        ((500_000, 6_350_000, 29_000), False),  # the same in feet, on Everest
        ((0, 0, 0), False),
        ((np.nan, 0, 0), False),
        ((6.37e306, 1e308, 1e308), False),
    ],
)
def test_geocentric_coordinates_are_told_by_their_size(middle, geocentric):
    middle = np.array(middle, float)
    with np.errstate(over="ignore"):
        places = {"version": (1, 3), "evlr_count": 0, "compressed": True, "offset_to_points": 0}
        header = SimpleNamespace(vlrs=(), mins=middle - 2000, maxs=middle + 2000, **places)
        assert bool(read_crs(Path("s.las"), header)[1]) is geocentric


@pytest.mark.parametrize("records", [[], [projection(34735, b"\xff" * 40)]], ids=["no CRS", "a broken one"])
def test_geocentric_strips_without_a_crs_get_no_ranges(tmp_path, records):
    raw = make_raw(60)
    raw.vlrs = [descriptor(1), *records]
    strip = place_header(raw.write(tmp_path / "s.las"), lambda old: (
        *old[:3], 4_194e3, 1_162e3, 4_647e3, 4_195e3, 4_193e3, 1_163e3, 1_161e3, 4_648e3, 4_646e3))  # fmt: skip
    arguments = "run", strip, "-o", tmp_path / "out", "--profile", "fast"
    fail(4, "coordinates are geocentric", *arguments, "--flight-height", "500")
    assert run_command(*arguments).exit_code == 0


def test_degrees_with_metric_vectors_get_no_new_echoes(tmp_path):
    strip = place_header(make_raw(200).write(tmp_path / "s.las"), lambda old: (
        1e-7, 1e-7, 0.001, *old[3:6], 15.7, 15.6, 48.7, 48.6, 400.0, 300.0))  # fmt: skip
    arguments = "run", strip, "-o", tmp_path / "out", "--profile", "fast"
    fail(4, "coordinates are degrees, packet vectors metres", *arguments)
    assert run_command(*arguments, "--points", "returns").exit_code == 0


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


def test_so_do_rasters_and_voxels(strip, tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="rasterio (extra gis) is not installed")
    for words in (["grid", strip, "--statistic", "count", "--size", 5, "-o", tmp_path / "x.tif"],
                  ["voxelize", strip, "--size", 5, "-o", tmp_path / "v.las"]):  # fmt: skip
        succeed(*words)
    with rasterio.open(tmp_path / "x.tif") as raster:
        assert raster.crs.is_projected and _longitude(raster.crs) == pytest.approx(15.6567, abs=1e-3)
    voxels = tmp_path / "v.las"
    assert _longitude(read_crs_definition(voxels, read_header(voxels))) == pytest.approx(15.6567, abs=1e-3)


def geo_keys(**values):
    """A GeoKeyDirectory with these keys, by number with a k in front."""
    rows = [(int(key[1:]), 0, 1, value) for key, value in values.items()]
    flat = [number for row in [(1, 1, 0, len(rows)), *rows] for number in row]
    return [Vlr(b"LASF_Projection", 34735, struct.pack(f"<{len(flat)}H", *flat))]


@pytest.mark.parametrize(
    ("code", "name", "meridian", "northing"),
    [(32601, "WGS 84 / UTM zone 1N", -177, 0), (32760, "WGS 84 / UTM zone 60S", 177, 10000000),
     (25832, "ETRS89 / UTM zone 32N", 9, 0), (26910, "NAD83 / UTM zone 10N", -123, 0)],
)  # fmt: skip
def test_utm_zones(code, name, meridian, northing):
    text = build_utm(code)
    assert text.startswith(f'PROJCS["{name}"') and text.endswith(f'AUTHORITY["EPSG","{code}"]]')
    assert f'"central_meridian",{meridian}]' in text and f'"false_northing",{northing}]' in text


@pytest.mark.parametrize(
    ("records", "named"),
    [
        ((geo_keys(k1024=1, k3072=32633),), "(EPSG:25832 and EPSG:32633) contradict"),
        ((geo_keys(k1024=1, k3072=2263),), "(EPSG:25832 and EPSG:2263) contradict"),
        (([build_wkt(build_utm(25833))],), "records of the CRS contradict"),
        ((geo_keys(k1024=1, k3072=32632), [build_wkt(build_utm(25832))]), ""),
        (([build_wkt(build_utm(25832).replace(",", ", ") + "\n")], [build_wkt("")]), ""),
    ],
)
def test_records_that_give_two_places_are_named(tmp_path, records, named):
    """A strip that was projected, and kept the keys of the old zone, lay there for half of all programs."""
    path = tmp_path / "s.las"
    simulate_strip("flat", path, pulses=300, seed=1)
    add_record(path, build_wkt(build_utm(25832)))
    for (record,) in records:
        add_record(path, record)
    done = run_command("check", str(path))
    assert (done.exit_code, named in done.stdout) == (int(bool(named)), True), done.output


@pytest.mark.parametrize(
    ("wkt", "code", "named"),
    [
        ('COMPD_CS["c",{25833},VERT_CS["h",VERT_DATUM["d",2005],AUTHORITY["EPSG","5783"]]]', 25832, True),
        ('COMPD_CS["c",{25832},VERT_CS["h",VERT_DATUM["d",2005],AUTHORITY["EPSG","5783"]]]', 25832, False),
        ('PROJCS["n",UNIT["US survey foot",0.3048006],AUTHORITY["EPSG","2263"]]', 2263, False),
        ('PROJCS["n",UNIT["foot",0.3048],AUTHORITY["EPSG","2263"]]', 2263, True),
    ],
)
def test_compound_records_and_feet_are_compared(tmp_path, wkt, code, named):
    path = tmp_path / "s.las"
    simulate_strip("flat", path, pulses=300, seed=1)
    add_record(path, build_wkt(re.sub(r"{(\d+)}", lambda found: build_utm(int(found[1])), wkt)))
    add_record(path, *geo_keys(k1024=1, k3072=code))
    assert any("contradict" in line for line in find_facts(path, "auto", False).warnings) == named


@pytest.mark.parametrize(("zones", "named"), [((32632, 32633), True), ((32632, 32632), False)])
def test_a_record_after_the_points_is_compared_with_that_in_the_header(tmp_path, zones, named):
    """laspy takes the one after the points, wavebatch that in the header; spelling is no contradiction."""
    front, back = (build_utm(zone) for zone in zones)
    evlrs = [(b"LASF_Projection", WKT_ID, back.replace(",", ", ").encode() + b"\0")]
    _with_record(tmp_path / "s.las", (1, 4), 9, vlrs=[build_wkt(front)], evlrs=evlrs)
    with StripReader(tmp_path / "s.las") as reader:
        assert reader.facts.crs == front
        assert any("records of the CRS contradict" in line for line in reader.facts.warnings) == named


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
    assert find_code(geo_keys(**values)) == code


def test_leicas_own_place_of_the_code():
    path = data_file("leica-als/simple1_3_full_internal.las")
    assert '"WGS 84 / UTM zone 32N"' in convert_geotiff(path, read_header(path).vlrs, asked=False)


def test_a_crs_that_only_pyproj_knows(tmp_path, monkeypatch):
    other = geo_keys(k1024=1, k3072=31468)
    assert convert_geotiff(tmp_path, other, asked=False) is None  # the same bytes with and without pyproj
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pyproj", None)
        with pytest.raises(
            InputError, match=r"EPSG:31468, which pyproj would convert: .*pip install .pyproj"
        ):
            convert_geotiff(tmp_path, other, asked=True)
    assert '"31468"' in convert_geotiff(tmp_path, other, asked=True)


@pytest.mark.parametrize("scale", [1.0, 1 / 0.3048, 1e-5])
def test_errors_along_the_ray_are_metres_in_any_unit(scale):
    block = WaveformBlock.from_samples(np.zeros((1, 8), np.uint8))
    block = replace(block, direction=block.direction * scale)
    echoes = EchoTable.build(np.zeros(1), np.full(1, 4.0), np.ones(1), np.ones(1), time_err=np.full(1, 0.1))
    noise = Noise(np.zeros(1, np.float32), np.ones(1, np.float32))
    done = position(block, noise, SystemPulse(1.0), echoes)
    assert done.attributes["range_err"][0] == pytest.approx(0.1 * HALF_C, rel=1e-3)


def test_so_do_synthetic_strips(strip, tmp_path):
    words = ["synthesize", strip, "-o", tmp_path / "s.las"]
    succeed(*words)
    definition = read_crs_definition(tmp_path / "s.las", read_header(tmp_path / "s.las"))
    assert definition == repair_wkt(RIPROCESS)
    records = [vlr.payload for vlr in read_header(tmp_path / "s.las").vlrs if vlr.record_id == WKT_ID]
    assert records == [repair_wkt(RIPROCESS).encode() + b"\0"]


ZONE = build_utm(32633)


plain = simulated("plain.las", "flat", pulses=400, seed=1)
"""A strip without a CRS."""


@pytest.fixture(scope="module")
def placed_strip(plain):
    """The same strip in UTM zone 33."""
    path = plain.with_name("utm.las")
    shutil.copy(plain, path)
    add_record(path, build_wkt(ZONE))
    return path


def _box(placed_strip, part=(0.25, 0.75)):
    """Corners of a box in the middle of a strip, f8 (4, 2)."""
    header = read_header(placed_strip)
    low, high = np.array(header.mins[:2]), np.array(header.maxs[:2])
    west, south = low + part[0] * (high - low)
    east, north = low + part[1] * (high - low)
    return np.array([[west, south], [east, south], [east, north], [west, north]])


def _write_area(path, ring, crs=None):
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
def test_degrees_are_projected_into_the_strip(placed_strip, tmp_path, crs):
    box = _box(placed_strip)
    (polygon,) = load_polygons(_write_area(tmp_path / "a.geojson", _project(box, "EPSG:32633", "EPSG:4326"), crs))
    (ring,) = polygon.place(placed_strip, read_header(placed_strip)).rings
    # Every corner is there, and more between them where an edge is long.
    assert all(np.hypot(*(ring - corner).T).min() < 1e-4 for corner in box)
    assert np.hypot(*np.diff(ring, axis=0).T).max() < 120


def test_a_long_edge_is_straight_in_degrees_as_the_standard_says(placed_strip):
    pyproj = pytest.importorskip("pyproj", reason="pyproj (extra gis) is not installed")
    header = replace(read_header(placed_strip), mins=(3e5, 5e6, 0.0), maxs=(3.5e5, 5.1e6, 0.0))
    file = read_area_file("a.geojson", None, [np.zeros((1, 2))])
    edge = np.array([[13.0, 48.0], [14.0, 48.0], [14.0, 48.1]])
    (ring,) = place_rings(file, [edge], placed_strip, header)
    back = np.stack(pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(*ring.T), axis=1)
    south = back[: np.flatnonzero(np.isclose(back[:, 0], 14.0, atol=1e-9))[0]]
    np.testing.assert_allclose(south[:, 1], 48.0, atol=1e-9)
    assert len(south) > 500 and np.ptp(ring[: len(south), 1]) > 100  # in UTM it bends by more than 100 m
    # A neighbour that has the edge in the other direction has the same corners: no gap, no overlap.
    (other,) = place_rings(file, [edge[::-1]], placed_strip, header)
    assert {tuple(row) for row in ring.tolist()} == {tuple(row) for row in other.tolist()}


def test_a_named_crs_is_projected_and_the_strips_own_is_not(placed_strip, tmp_path):
    box = _box(placed_strip)
    (same,) = load_polygons(_write_area(tmp_path / "a.geojson", box, "urn:ogc:def:crs:EPSG::32633"))
    assert same.place(placed_strip, read_header(placed_strip)).rings[0].tolist() == box.tolist()
    other = _project(box, "EPSG:32633", "EPSG:32632")
    (far,) = load_polygons(_write_area(tmp_path / "b.geojson", other, "urn:ogc:def:crs:EPSG::32632"))
    np.testing.assert_allclose(far.place(placed_strip, read_header(placed_strip)).rings[0], box, atol=1e-3)


def test_coordinates_of_the_strip_stay(placed_strip, plain, tmp_path):
    for path in (placed_strip, plain):
        (polygon,) = load_polygons(_write_area(tmp_path / "a.geojson", _box(path)))
        assert polygon.place(path, read_header(path)).rings[0].tolist() == _box(path).tolist()
    # A strip with local coordinates near the origin has areas there: they are no degrees.
    near = type("H", (), {"mins": (0, 0, 0), "maxs": (80, 60, 9), "vlrs": ()})()
    file = read_area_file("a.geojson", None, [np.eye(2)])
    assert place_rings(file, [np.eye(2)], placed_strip, near)[0].tolist() == np.eye(2).tolist()


def _local(path, low=0.0, high=400.0):
    """The header of a strip as if it lay in a local grid, and were larger than degrees are."""
    return replace(read_header(path), mins=(low, low, low), maxs=(high, high, high))


@pytest.mark.parametrize("has_crs", [False, True])
def test_small_coordinates_inside_of_a_strip_are_those_of_the_strip(placed_strip, plain, has_crs):
    path = placed_strip if has_crs else plain
    boxes = [_square(10, 80), _square(-50, -10)]
    file = read_area_file("a.geojson", None, boxes)
    for box in boxes:  # the second misses the strip; all areas of a file are in one CRS
        assert place_rings(file, [box], path, _local(path))[0].tolist() == box.tolist()
    alone = read_area_file("a.geojson", None, boxes[1:])  # can only be in degrees
    if has_crs:
        assert np.abs(place_rings(alone, boxes[1:], path, _local(path))[0]).max() > 1e6
    else:
        refuses(InputError, "is in degrees", place_rings, alone, boxes[1:], path, _local(path))


def test_one_point_at_the_origin_does_not_make_degrees_coordinates_of_the_strip(placed_strip):
    header = read_header(placed_strip)
    box = _project(_box(placed_strip), "EPSG:32633", "EPSG:4326")
    file = read_area_file("a.geojson", None, [box])
    placed = place_rings(file, [box], placed_strip, replace(header, mins=(0.0, 0.0, 0.0)))[0]
    assert placed.tolist() == place_rings(file, [box], placed_strip, header)[0].tolist() and placed.min() > 1e5


def _square(low, high):
    return np.array([[low, low], [high, low], [high, high], [low, high]], np.float64)


def test_what_cannot_be_placed_is_one_line(placed_strip, plain, tmp_path, monkeypatch):
    degrees = np.array([[15.6, 48.6], [15.7, 48.6], [15.7, 48.7]])
    (polygon,) = load_polygons(_write_area(tmp_path / "a.geojson", degrees))
    with pytest.raises(InputError, match=r"a.geojson: is in degrees \(OGC:CRS84\), and .*plain.las has no CRS"):
        polygon.place(plain, read_header(plain))
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(ConfigError, match=r"a.geojson: is in OGC:CRS84, .*needs pyproj: .*pip install .*; or write"):
        polygon.place(placed_strip, read_header(placed_strip))
    refuses(ConfigError, "its member crs has no name", read_area_file, "c.geojson", {"type": "link"}, [])


def test_without_pyproj_only_the_strips_own_code_is_taken(placed_strip, tmp_path, monkeypatch):
    """Two CRS of the same zone differ by hundreds of metres: that the areas lie in the strip says nothing."""
    monkeypatch.setitem(sys.modules, "pyproj", None)
    header, box = read_header(placed_strip), _box(placed_strip)
    names = ("EPSG:32633", "epsg:32633", "urn:ogc:def:crs:EPSG::32633", "urn:x-ogc:def:crs:EPSG:6.9:32633",
             "http://www.opengis.net/def/crs/EPSG/0/32633", ZONE)  # fmt: skip
    for name in names:
        (polygon,) = load_polygons(_write_area(tmp_path / "a.geojson", box, name))
        assert polygon.place(placed_strip, header).rings[0].tolist() == box.tolist()
    for name in ("EPSG:23033", "EPSG:25833", "my grid", "x" * 10_000):
        (polygon,) = load_polygons(_write_area(tmp_path / "a.geojson", box, name))
        with pytest.raises(ConfigError, match=r"is in EPSG:32633; .*needs pyproj: .*pip install .*; or") as caught:
            polygon.place(placed_strip, header)
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


def test_an_unknown_crs_is_one_line(placed_strip, tmp_path):
    (polygon,) = load_polygons(_write_area(tmp_path / "a.geojson", _box(placed_strip), "my grid"))
    with pytest.raises(InputError, match="a.geojson: cannot be projected into the CRS of .*utm.las") as caught:
        polygon.place(placed_strip, read_header(placed_strip))
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


def test_resume_sees_another_crs_of_the_same_corners(placed_strip, tmp_path):
    file = tmp_path / "a.geojson"
    words = ["run", placed_strip, "-o", tmp_path / "o", "--polygon", file]
    said = []
    for crs in ("EPSG:32633", "urn:ogc:def:crs:EPSG::32633", "EPSG:23033", "EPSG:23033"):
        _write_area(file, _box(placed_strip), crs)
        result = succeed(*words, "--resume")
        report = json.loads((tmp_path / "o" / "utm.report.json").read_text())
        said.append(("skipped" in result.stderr, report["request"]["selection"]["polygon"]["crs"]))
    assert said == [(False, "EPSG:32633"), (True, "EPSG:32633"), (False, "EPSG:23033"), (True, "EPSG:23033")]


def test_run_stats_and_calibrate_use_placed_areas(placed_strip, tmp_path):
    """The same points, areas and echoes by degrees as by coordinates of the strip."""
    box = _box(placed_strip)
    degrees = _write_area(tmp_path / "deg.geojson", _project(box, "EPSG:32633", "EPSG:4326"))
    own = _write_area(tmp_path / "own.geojson", box)
    numbers, counted = [], []
    for name, file in (("a", degrees), ("b", own)):
        result = succeed("run", placed_strip, "-o", tmp_path / name, "--polygon", file, "-q")
        numbers.append(read_header(tmp_path / name / "utm.laz").point_count)
        result = run_command("stats", placed_strip, "--polygon", file, "--json")
        counted.append([area["points"] for area in json.loads(result.stdout)["files"][0]["areas"]])
        again = ["run", str(placed_strip), "-o", str(tmp_path / name), "--polygon", str(file), "--resume"]
        assert "skipped" in run_command(*again).stderr  # the report has the corners of the file
    # An edge that is straight in degrees bends by a centimetre in UTM.
    assert 20 < numbers[0] < read_header(placed_strip).point_count and abs(numbers[0] - numbers[1]) < 5
    assert len(counted[0]) == len(counted[1]) == 2 and abs(counted[0][0] - counted[1][0]) < 5
    targets = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"reflectance": 0.3}, "geometry": {"type": "Polygon", "coordinates": [
            _project(_box(placed_strip, (-0.2, 1.2)), "EPSG:32633", "EPSG:4326").tolist()]}}]}  # fmt: skip
    (tmp_path / "t.geojson").write_text(json.dumps(targets))
    words = ["calibrate", placed_strip, "--targets", tmp_path / "t.geojson", "-o", tmp_path / "cal.toml"]
    result = run_command(*words)
    assert "lies outside" not in result.output and "0 clean single echoes" not in result.output


def test_an_area_that_misses_the_strip_is_named_with_both_extents(placed_strip, tmp_path):
    away = _write_area(tmp_path / "away.geojson", _box(placed_strip) + 1e4)
    result = run_command("run", placed_strip, "-o", tmp_path / "o", "--polygon", away, "-q")
    assert "no point is written" in result.stderr
    assert "lies outside the strip, which by its header has x " in result.stderr
    result = run_command("stats", placed_strip, "--polygon", away)
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
    refuses(InputError, "a.las: its CRS is not understood", plan_crs, "a.las", "PROJCS[nothing]", "wgs84")


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
    refuses(InputError, "a.las: has no CRS, .* write .csv, or --geojson-crs keep", plan_crs, "a.las", None, "wgs84")
    assert plan_crs("a.las", None, "keep").member is None
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(ConfigError, match="needs pyproj: .*pip install .pyproj>=3.6.; or write .csv"):
        plan_crs("a.las", "EPSG:32632", "wgs84")


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


def test_both_extents_are_named(placed_strip):
    header = read_header(placed_strip)
    assert describe_miss([_box(placed_strip)], header) == "" == describe_miss([], header)
    text = describe_miss([_box(placed_strip) + 1e5], header)
    west = _box(placed_strip)[0, 0] + 1e5
    assert f"{west:.10g}" in text and f"{header.mins[0]:.10g}" in text and "another CRS" in text
