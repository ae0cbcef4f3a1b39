"""Distances are metres whatever the unit of the coordinates is: state planes are in feet."""

import json
import re

import numpy as np
import pytest
from commands import refuses, run_command, succeed
from strips import add_record, place_header

from wavebatch.core.errors import ConfigError
from wavebatch.files.las.crs import build_utm
from wavebatch.files.las.header import build_wkt
from wavebatch.tools.plots.charts import picture_cloud
from wavebatch.tools.plots.sections import cut_section, measure_profile
from wavebatch.tools.simulate import simulate_strip

FOOT = 1200 / 3937
GEOCENTRIC = 'GEOCCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257]],UNIT["metre",1]]'
FEET = build_utm(32614).replace('UNIT["metre",1,AUTHORITY["EPSG","9001"]]', f'UNIT["US survey foot",{FOOT!r}]')
DEGREES = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257]],UNIT["degree",0.0174532925]]'


@pytest.fixture(scope="module")
def clouds(tiny_strip, tmp_path_factory):
    """The same cloud in metres, in feet (the same places), and with a CRS in degrees."""
    folder = tmp_path_factory.mktemp("units")
    succeed("run", tiny_strip, "-o", folder, "--profile", "balanced", "--format", "las", "-q")  # fmt: skip
    metres = folder / tiny_strip.name
    found = {"m": metres}
    for name, wkt, factor in (("ft", FEET, 1 / FOOT), ("deg", DEGREES, 1.0)):
        found[name] = place_header(metres, lambda old, factor=factor: old * factor, folder / f"{name}.las")
        add_record(found[name], build_wkt(wkt))
    return found


def _print(*words, code=0):
    result = run_command(*words)
    assert result.exit_code == code, result.output
    return result


def test_distances_of_returns_are_metres(clouds):
    found = {name: json.loads(_print("stats", path, "--json").stdout)["total"] for name, path in clouds.items()}
    metres, feet, degrees = (found[name] for name in ("m", "ft", "deg"))
    assert metres["separations"]["all"]["pairs"] >= 10 and metres["several"] >= 10
    for one, other in zip(metres["separations"].values(), feet["separations"].values(), strict=True):
        assert other == pytest.approx(one, rel=1e-6)
    assert feet["depth"] == pytest.approx(metres["depth"], rel=1e-6)
    assert degrees["separations"]["all"] == {"pairs": 0, "mean": None, "least": None}
    assert "coordinates are US survey feet: distances and depths are converted" in _print("stats", clouds["ft"]).output
    assert "coordinates are degrees: returns have no distances" in _print("stats", clouds["deg"]).output
    area = json.loads(_print("stats", clouds["ft"], "--area", 1e6, "--json").stdout)["files"][0]["areas"][0]
    assert area["mean"] == pytest.approx(metres["separations"]["all"]["mean"], rel=1e-6)


def test_clouds_in_feet_are_compared_in_metres(clouds, tmp_path):
    # 0.1 ft are 0.2 ns; as metres they would be 0.67 ns
    shifted = place_header(clouds["ft"], lambda old: old + 0.1 * (np.arange(12) == 5), tmp_path / "shifted.las")
    found = json.loads(_print("compare", clouds["ft"], shifted, "--within", 0.3, "--json").stdout)
    assert found["identical"] == 1.0
    line = _print("compare", clouds["deg"], clouds["deg"], code=2).stderr
    assert "coordinates are degrees, which have no length; project it to metres" in line and line.count("\n") == 1


def test_the_summary_of_a_map_names_the_unit(clouds, tmp_path):
    result = _print("plot", "map", clouds["ft"], "--statistic", "count", "-o", tmp_path / "m.png", "--json")
    assert " us-ft\n" in result.stderr and json.loads(result.stdout)["unit"] == "us-ft"


@pytest.mark.parametrize("named", [True, False])
def test_packet_vectors_in_metres_do_not_place_echoes_in_feet(named, tmp_path):
    """The spacing of the returns shows it, with a CRS and without: added echoes were metres from their place."""
    simulate_strip("forest", tmp_path / "strip.las", pulses=1500, seed=1)
    place_header(tmp_path / "strip.las", lambda old: old / FOOT)
    if named:
        add_record(tmp_path / "strip.las", build_wkt(FEET))
    line = _print("run", tmp_path / "strip.las", "-o", tmp_path / "o", "--profile", "fast", code=4).stderr
    assert "returns of one pulse lie 3.28 times as far apart" in line and "--points returns" in line
    _print("run", tmp_path / "strip.las", "-o", tmp_path / "o", "--profile", "fast", "--points", "returns")


def test_times_in_nanoseconds_in_place_of_picoseconds_are_said(tmp_path, edit_points):
    """Widths were 1000 times too small and added echoes lay on their neighbours, in silence."""
    simulate_strip("forest", tmp_path / "strip.las", pulses=1500, seed=1)

    def change(points):
        points["return_point_wave_location"] /= 1000

    path = edit_points(tmp_path / "strip.las", tmp_path / "ns.las", change)
    content = path.read_bytes()
    path.write_bytes(content.replace((1000).to_bytes(4, "little"), (1).to_bytes(4, "little"), 1))
    lines = _print("run", path, "-o", tmp_path / "o", "--profile", "fast", "--quiet").stderr
    assert "samples 0.001 ns apart" in lines and "100% of " in lines and "the second lies off its ray" in lines


@pytest.mark.quick_cases("3.0-*", "*-100")
@pytest.mark.parametrize(
    ("degrees", "scale", "step"), [(0.0, 0.001, 1), (0.0, 0.1, 1), (0.0, 0.001, 100), (3.0, 0.01, 1)]
)
def test_points_that_were_turned_without_their_vectors_are_said(tmp_path, edit_points, degrees, scale, step):
    """From one zone to another: added echoes lay 30 cm aside, in silence. Coarse coordinates are no turn, nor are those
    that a program wrote again in finer steps."""
    succeed("simulate", "forest", "-o", tmp_path / "strip.las", "--pulses", 1500, "--seed", 1, "--scale", scale, "-q")

    def change(points):
        place = (points["X"] + 1j * points["Y"]) * np.exp(1j * np.radians(degrees))
        points["X"], points["Y"] = np.rint(place.real), np.rint(place.imag)
        for name in "XYZ":
            points[name] = points[name] // step * step

    path = edit_points(tmp_path / "strip.las", tmp_path / "turned.las", change)
    lines = _print("run", path, "-o", tmp_path / "o", "--profile", "fast", "--quiet").stderr
    assert ("half lie aside of its ray" in lines) == (degrees > 0)


def test_a_foot_in_the_crs_of_a_strip_in_metres_does_not_stop_it(tmp_path):
    """Spacing and vectors agree: only the label is wrong, and echoes lie where they should."""
    simulate_strip("forest", tmp_path / "strip.las", pulses=1500, seed=1)
    add_record(tmp_path / "strip.las", build_wkt(FEET))
    _print("run", tmp_path / "strip.las", "-o", tmp_path / "o", "--profile", "fast")


@pytest.mark.parametrize(("unit", "name"), [("m", "m"), ("ft", "us-ft"), ("deg", "deg")])
def test_maps_of_report_pages_name_the_unit(clouds, unit, name):
    maps = list(picture_cloud(clouds[unit], ["amplitude"]))[1].parts
    drawn = [one.svg for one in maps]
    assert len(maps) == 2 and all(re.search(rf"Cells of \S+ {name};", one.words) for one in maps)
    assert all(f"east [{name}]" in one for one in drawn) and f"[1/{name}2]" in drawn[0]


@pytest.mark.parametrize("unit", ["ft", "deg"])
def test_no_waveforms_are_modelled_with_distances_in_another_unit(clouds, tmp_path, unit):
    """Echoes of a cloud in feet were 3.3 times too far apart in time."""
    said = _print("synthesize", clouds[unit], "-o", tmp_path / "a.las", code=1).stderr
    assert said.count("\n") == 1 and "project it to metres first" in said and not list(tmp_path.iterdir())
    _print("synthesize", clouds["m"], "-o", tmp_path / "a.las", "-q")


def test_pictures_name_the_unit_of_heights(clouds):
    made = {name: measure_profile([path], "z", "count") for name, path in clouds.items()}
    units = {name: (found.facts.unit, found.label.split(" of ")[0].split()[-1]) for name, found in made.items()}
    assert units == {"m": ("m", "m"), "ft": ("us-ft", "us-ft"), "deg": ("m", "m")}
    assert "of height" in made["m"].label
    refuses(ConfigError, "coordinates are degrees, heights are not", cut_section, [clouds["deg"]], "z")


def test_bands_of_rasters_name_the_unit_of_heights(clouds, tmp_path):
    """A raster of heights in feet said that they are metres; a column of bits can be counted, as in a map."""
    rasterio = pytest.importorskip("rasterio")
    _print("grid", clouds["ft"], "--column", "z", "--size", 50, "-o", tmp_path / "z.tif")
    _print("grid", clouds["ft"], "--column", "echo_flags", "--statistic", "count", "--size", 50, "-o",
           tmp_path / "n.tif")  # fmt: skip
    for name, unit in (("z", "us-ft"), ("n", None)):
        with rasterio.open(tmp_path / f"{name}.tif") as found:
            assert found.units == (unit,)


def test_geocentric_coordinates_have_no_height(clouds, tmp_path):
    cloud = tmp_path / "g.las"
    cloud.write_bytes(clouds["m"].read_bytes())
    add_record(cloud, build_wkt(GEOCENTRIC))
    found = measure_profile([cloud], "z", "count")
    assert found.upright == "z" and found.label.endswith(" m of z")
    assert "coordinates       geocentric (ECEF)" in _print("info", cloud).stdout
    assert "first to last is along Z, which is no height" in _print("stats", cloud).stdout
    simulate_strip("flat", tmp_path / "strip.las", pulses=200)
    add_record(tmp_path / "strip.las", build_wkt(GEOCENTRIC))
    said = _print("slice", tmp_path / "strip.las", "-o", tmp_path / "s.csv", code=1).stderr
    assert "strip.las: coordinates are geocentric (ECEF); slices need heights: project the strip\n" in said
    assert not (tmp_path / "s.csv").exists()
