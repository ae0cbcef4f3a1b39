"""Units of coordinates from WKT and GeoTIFF keys, right, contradictory and hostile; strips that are not in metres."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from commands import run_command
from hypothesis import given
from hypothesis import strategies as st
from strips import descriptor, make_raw, vlr

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.las.crs import CrsUnits, looks_geocentric, parse_wkt, read_crs_definition
from wavebatch.files.las.geo_keys import METRES, GeoKeys, find_unit
from wavebatch.files.strip.ray_sample import measure_scale
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.attribute.basic import position
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.geometry import FlightLine
from wavebatch.tools.simulate.strip import WKT

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
    ("code", "unit"),
    # NAD27 / New York, NAD83(2011) / Oregon (both), Palestine 1923, ETRS89 / UTM, Web Mercator, Texas, and no code.
    [(32017, US), (6886, None), (6885, 0.3048), (28191, None), (25832, None), (3857, None), (2277, US), (0, None)],
)
def test_codes_of_crs_give_their_unit(code, unit):
    assert find_unit(code) == (None if unit is None else pytest.approx(unit, rel=1e-7))


def test_heights_have_codes_of_their_own():
    assert find_unit(6360, vertical=True) == pytest.approx(US) and find_unit(5703, vertical=True) is None
    assert find_unit(8228, vertical=True) == 0.3048 and find_unit(6360) is None


@pytest.mark.parametrize(
    ("directory", "citation", "crs", "definition"),
    [
        (keys(short(1024, 1), short(3072, 2263), short(4096, 6360)), b"x|", "EPSG:2263+6360", "EPSG:2263"),
        (keys(short(1024, 1), short(3072, 25832)), b"", "EPSG:25832", "EPSG:25832"),
        (keys(short(1024, 2), short(2048, 4326)), b"", "EPSG:4326", "EPSG:4326"),
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


def test_more_keys_than_bytes_are_cut():
    directory = bytearray(keys(short(1024, 1), short(3076, 9002)))
    struct.pack_into("<H", directory, 6, 65535)
    assert parse_geotiff(bytes(directory)[:-1]) == CrsUnits("projected")


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


@pytest.mark.parametrize("scale", [1.0, 1 / 0.3048, 1e-5])
def test_errors_along_the_ray_are_metres_in_any_unit(scale):
    block = WaveformBlock.from_samples(np.zeros((1, 8), np.uint8))
    block = replace(block, direction=block.direction * scale)
    echoes = EchoTable.build(np.zeros(1), np.full(1, 4.0), np.ones(1), np.ones(1), time_err=np.full(1, 0.1))
    noise = Noise(np.zeros(1, np.float32), np.ones(1, np.float32))
    done = position(block, noise, SystemPulse(1.0), echoes)
    assert done.attributes["range_err"][0] == pytest.approx(0.1 * HALF_C, rel=1e-3)


def in_feet(source, target):
    """A strip without CRS whose coordinates are feet, but whose packet vectors are metres."""
    content = bytearray(source.read_bytes())
    for place in (131, 155, 179):
        values = struct.unpack_from("<6d" if place > 155 else "<3d", content, place)
        struct.pack_into(f"<{len(values)}d", content, place, *(value / 0.3048 for value in values))
    target.write_bytes(content)
    return target


@pytest.mark.quick_cases("flat")
@pytest.mark.parametrize("scene", ["urban", "flat"])
def test_feet_with_metric_vectors_and_no_crs_are_found(tmp_path, scene):
    simulate_strip(scene, tmp_path / "m.las", pulses=30_000, seed=3, flight=FlightLine(pulse_rate=50_000))
    feet = in_feet(tmp_path / "m.las", tmp_path / "feet.las")
    chain = tmp_path / "chain.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.closed_form", "attribute.position", "attribute.range")
    chain.write_text("".join(f'[[chain]]\nstage = "{name}"\n' for name in stages))
    done = {
        strip.stem: run_command("run", strip, "-o", tmp_path / "out", "--chain", chain)
        for strip in (tmp_path / "m.las", feet)
    }
    assert done["m"].exit_code == 0 and "in feet" not in done["m"].stderr
    with StripReader(feet) as reader, reader.scan() as scan:
        scale = measure_scale(reader, scan)
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
        assert bool(looks_geocentric(middle - 2000, middle + 2000)) is geocentric


@pytest.mark.parametrize("records", [[], [projection(34735, b"\xff" * 40)]], ids=["no CRS", "a broken one"])
def test_geocentric_strips_without_a_crs_get_no_ranges(tmp_path, records):
    raw = make_raw(60)
    raw.vlrs = [descriptor(1), *records]
    strip = raw.write(tmp_path / "s.las")
    content = bytearray(strip.read_bytes())
    struct.pack_into("<3d", content, 155, 4_194_000.0, 1_162_000.0, 4_647_000.0)
    struct.pack_into("<6d", content, 179, 4_195e3, 4_193e3, 1_163e3, 1_161e3, 4_648e3, 4_646e3)
    strip.write_bytes(content)
    arguments = ["run", str(strip), "-o", str(tmp_path / "out"), "--profile", "fast"]
    done = run_command(*arguments, "--flight-height", "500")
    assert done.exit_code == 4 and "coordinates are geocentric" in done.stderr
    assert run_command(*arguments).exit_code == 0


def test_degrees_with_metric_vectors_get_no_new_echoes(tmp_path):
    strip = make_raw(200).write(tmp_path / "s.las")
    content = bytearray(strip.read_bytes())
    struct.pack_into("<3d", content, 131, 1e-7, 1e-7, 0.001)
    struct.pack_into("<6d", content, 179, 15.7, 15.6, 48.7, 48.6, 400.0, 300.0)
    strip.write_bytes(content)
    arguments = ["run", str(strip), "-o", str(tmp_path / "out"), "--profile", "fast"]
    done = run_command(*arguments)
    assert done.exit_code == 4 and "coordinates are degrees, packet vectors metres" in done.stderr
    assert run_command(*arguments, "--points", "returns").exit_code == 0
