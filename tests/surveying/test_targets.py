"""Calibration from targets: files of targets, what lies in them, and a constant that gives their reflectance back."""

import json
from dataclasses import asdict, replace

import laspy
import numpy as np
import pytest
from commands import fail, succeed
from commands import run_command as call
from helpers_scenes import simulated
from strips import true_sensor, write_positions

from wavebatch.core.units import MAD_TO_STD
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.geometry.planes import fit_planes
from wavebatch.surveying.calibrating import targets as targets_module
from wavebatch.surveying.calibrating.calibration_files import (
    Target,
    format_calibration,
    load_calibration,
    load_targets,
    parse_calibration,
)
from wavebatch.surveying.calibrating.strip_echoes import CLEAN_ECHO
from wavebatch.tools.simulate import find_scene, strip
from wavebatch.tools.simulate.render import EAST, GROUND, NORTH, START_TIME
from wavebatch.tools.simulate.scenes import GROUND_REFLECTS

pytestmark = pytest.mark.kept_surveys


def test_what_lies_in_a_polygon():
    corners = np.array([[0, 0], [10, 0], [10, 10], [5, 3], [0, 10.0]])
    xyz = np.array([[1.0, 9, 5, 5, -1, 5], [1.0, 8, 1, 8, 5, 20], [0.0] * 6]).T
    assert Target("w", 0.2, corners).contains(xyz).tolist() == [True, True, True, False, False, False]
    many = np.random.default_rng(1).uniform(-2, 12, (2, 100_000))
    assert Target("w", 0.2, corners).contains(many.T).mean() * 14**2 == pytest.approx(65.0, rel=0.02)


def test_long_packets_of_the_digitizer_have_its_constant(riegl, tmp_path):
    """Descriptor 2 of this strip differs in the number of samples only: a run takes the constant of the other."""
    (tmp_path / "t.csv").write_text("reflectance,x,y,radius\n0.3,548355,5389940,3\n")
    cal = tmp_path / "cal.toml"
    assert "has no constant" not in succeed("calibrate", riegl, "--targets", tmp_path / "t.csv", "-o", cal).stderr
    assert [row.digitizer for row in load_calibration(cal).channels] == [1]
    call("run", riegl, "-o", tmp_path, "--calibration", cal, "-q")
    cloud = laspy.read(tmp_path / f"{riegl.stem}.laz")
    echoes = np.asarray(cloud["echo_width"]) > 0
    assert (np.asarray(cloud["backscatter_coefficient"])[echoes] > 0).all()
    meaning = {one.name: one.description for one in cloud.point_format.extra_dimensions}
    assert meaning["reflectance"] == "reflectance at true angle [-]"


def test_circles_and_polygons_of_csv_and_geojson(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("name,reflectance,x,y,radius,incidence\ngrey,0.25,100,200,5,\nwhite,0.8,300,400,2,12.5\n")
    grey, white = load_targets(path)
    assert (grey.name, grey.reflectance, grey.incidence, white.incidence) == ("grey", 0.25, None, 12.5)
    assert grey.contains(np.array([[104.9, 200.0], [105.1, 200.0]])).tolist() == [True, False]
    path.write_text("reflectance,vertices\n0.5,0 0 10 0 10 10\n")
    assert load_targets(path)[0].corners.shape == (3, 2)
    ring = [[0, 0], [10, 0], [10, 10], [0, 0]]
    feature = {"type": "Feature", "properties": {"reflectance": 0.4, "name": "a"},
               "geometry": {"type": "Polygon", "coordinates": [ring]}}  # fmt: skip
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    assert load_targets(path)[0].contains(np.array([[8.0, 2.0], [2.0, 8.0]])).tolist() == [True, False]


def test_normals_are_not_bent_by_outliers():
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 10, (300, 2))
    z = 0.5 * xy[:, 0] + 0.01 * rng.standard_normal(300)
    z[:30] += 3.0
    xyz = np.column_stack([xy, z])
    (normal,) = fit_planes(xyz - xyz.mean(axis=0), np.zeros(len(xyz), np.int64), 1).normal
    assert abs(normal @ np.array([-0.5, 0, 1]) / np.sqrt(1.25)) == pytest.approx(1.0, abs=1e-4)


ground = simulated("flat.las", "flat", pulses=6000, seed=8)
"""Flat ground whose echoes all are of one target."""


def test_targets_get_their_reflectance_back(tmp_path, ground):
    cloud = laspy.read(ground)
    x, y = float(np.median(cloud.x)), float(np.median(cloud.y))
    targets, cal, folder = tmp_path / "t.csv", tmp_path / "cal.toml", tmp_path / "out"
    targets.write_text(f"name,reflectance,x,y,radius\nnear,0.2,{x},{y},40\nnowhere,0.5,{x + 1e5},{y},40\n")
    done = succeed("calibrate", ground, "--targets", targets, "-o", cal, "--divergence", 0.5)
    (row,) = [line for line in done.stderr.splitlines() if line.startswith("  nowhere ")]
    assert row.split()[1] == "0.5" and "  0 clean single echoes" in row and "warning" not in done.stderr
    found = load_calibration(cal)
    assert found.divergence == 0.5 and 0.03 <= found.relative_error < 0.1
    assert found.strip == "flat.las" and "direction vectors" in found.conditions
    assert found.conditions.endswith("even light across the swath assumed")
    done = succeed("run", ground, "-o", folder, "--profile", "balanced", "--calibration", cal)
    cloud = laspy.read(next(folder.glob("*.laz")))
    inside = np.hypot(cloud.x - x, cloud.y - y) < 40
    rho = np.asarray(cloud["reflectance"])[inside]
    assert np.median(rho[rho != -9999]) == pytest.approx(0.2, rel=0.03)
    fail(1, "exists", "calibrate", ground, "--targets", targets, "-o", cal)
    targets.write_text(f"reflectance,x,y,radius\n0.2,{x},{y + 30},20\n0.5,{x},{y - 30},20\n")
    done = call("calibrate", ground, "--targets", targets, "-o", tmp_path / "two.toml")
    assert done.exit_code == 0 and "warning: constants of the targets differ by a factor of 2." in done.stderr
    targets.write_text(f"name,reflectance,x,y,radius\nnear,0.002,{x},{y},40\n")  # 100 times too small
    done = call("calibrate", ground, "--targets", targets, "-o", tmp_path / "dark.toml")
    assert done.exit_code == 0 and "near: no dry surface has a reflectance of 0.002" in done.stderr


def test_targets_off_the_strip(tmp_path, ground):
    targets = tmp_path / "t.csv"
    targets.write_text(f"reflectance,x,y,radius\n0.2,{EAST + 9e5},{NORTH},40\n")
    done = call("calibrate", ground, "--targets", targets, "-o", tmp_path / "cal.toml")
    assert done.exit_code == 1
    assert "no target gives a constant (the area (x 1399960 to " in done.stderr
    assert "lies outside the strip, which by its header has x 500055." in done.stderr
    assert "is it in another CRS?" in done.stderr
    assert not (tmp_path / "cal.toml").exists()


def test_a_lever_arm_leads_from_the_trajectory_to_the_scanner(tmp_path, ground):
    time = START_TIME + np.arange(-1.0, 2.0, 0.05)
    # Heading east, the trajectory's antenna is 30 m above the scanner and 2 m behind it.
    antenna = true_sensor(time) + [-2.0, 0.0, 30.0]
    turned = np.tile([0.0, 0.0, 90.0], (len(time), 1))
    write_positions(tmp_path / "t.csv", time, np.hstack([antenna, turned]), "time,x,y,z,roll,pitch,heading")
    cloud = laspy.read(ground)
    target = f"reflectance,x,y,radius\n0.2,{np.median(cloud.x)},{np.median(cloud.y)},40\n"
    (tmp_path / "g.csv").write_text(target)
    constants = []
    for number, options in enumerate([(), ("--trajectory", tmp_path / "t.csv"), ("--lever-arm", "2,0,30")]):
        cal = tmp_path / f"{number}.toml"
        options = ("--trajectory", tmp_path / "t.csv", *options) if number == 2 else options
        succeed("calibrate", ground, "--targets", tmp_path / "g.csv", "-o", cal, *options)
        constants.append(load_calibration(cal).constant)
    vectors, antenna, scanner = constants
    assert scanner == pytest.approx(vectors, rel=1e-4)
    assert antenna < 0.95 * vectors


@pytest.fixture(scope="module")
def two_channels(tmp_path_factory, edit_points):
    """A village whose every third pulse was recorded by a second digitizer, with half the gain."""
    folder = tmp_path_factory.mktemp("channels")
    path, copy = folder / "one.las", folder / "two.las"
    scene = find_scene("village")
    writer = strip.FullwaveWriter

    def open_with_two(*names, digitizers, **options):
        return writer(*names, digitizers=[*digitizers, replace(digitizers[0], index=2)], **options)

    strip.FullwaveWriter = open_with_two
    try:
        kind = strip.StripOptions(version="1.3", point_format=4, internal=True)
        strip.simulate_strip(scene, path, pulses=9000, seed=5, options=kind)
    finally:
        strip.FullwaveWriter = writer
    with StripReader(path) as reader:
        base = reader.facts.packets.base
    length = scene.recording.n_samples
    weak: set[int] = set()

    def change(points):
        second = (points["wavepacket_offset"] // length % 3 == 0) & (points["wavepacket_index"] > 0)
        points["wavepacket_index"][second] = 2
        weak.update(points["wavepacket_offset"][second].tolist())

    edit_points(path, copy, change)
    content = bytearray(copy.read_bytes())
    for offset in weak:
        samples = np.frombuffer(content[base + offset : base + offset + length], np.uint8).astype(float)
        content[base + offset : base + offset + length] = np.rint(12 + (samples - 12) / 2).astype(np.uint8).tobytes()
    copy.write_bytes(content)
    return copy


@pytest.mark.slow
def test_every_digitizer_gets_its_constant_and_is_run_with_it(tmp_path, two_channels):
    cloud = laspy.read(two_channels)
    x, y = float(np.median(cloud.x)), NORTH
    targets, cal, folder = tmp_path / "t.csv", tmp_path / "cal.toml", tmp_path / "out"
    ground = f"{GROUND_REFLECTS},{x - 60} {y + 0.2} {x + 60} {y + 0.2} {x + 60} {y + 5.8} {x - 60} {y + 5.8}"
    targets.write_text(f"reflectance,vertices\n{ground}\n")
    done = succeed("calibrate", two_channels, "--targets", targets, "-o", cal)
    assert "digitizer 1, scanner channel 0 " in done.stderr and "digitizer 2, scanner" in done.stderr
    found = load_calibration(cal)
    strong, weak = found.channels
    assert (strong.digitizer, weak.digitizer) == (1, 2)
    true = 4 / find_scene("village").light
    assert strong.constant == pytest.approx(true, rel=0.01)
    assert weak.constant == pytest.approx(2 * true, rel=0.02)
    assert 0 < strong.spread < 0.05 and strong.echoes > weak.echoes >= 10
    assert found.relative_error > 0.2
    assert parse_calibration(format_calibration(found), "cal").channels == found.channels
    assert found.describe()["channels"] == [asdict(strong), asdict(weak)]
    assert call("run", two_channels, "-o", folder, "--profile", "fast", "--calibration", cal).exit_code == 0
    cloud = laspy.read(next(folder.glob("*.laz")))
    rho, index = np.asarray(cloud["reflectance"]), np.asarray(cloud.z) < GROUND + 0.5
    assert np.median(rho[index & (rho != -9999)]) == pytest.approx(GROUND_REFLECTS, rel=0.02)
    level = rho[index & (rho != -9999)]
    assert MAD_TO_STD * np.median(np.abs(level / GROUND_REFLECTS - 1)) < 0.05


def test_the_error_of_an_outline_of_another_surface_is_over_the_constant_of_all_echoes():
    """Five times as dark outside: 4 in place of 1.33 said that nothing is known."""
    depth = np.linspace(0.0, 1.0, 200)
    constant = np.where(depth < 0.5, 5.0, 1.0) / 3.0 * (1 + 0.01 * np.random.default_rng(1).standard_normal(200))
    edge, error = targets_module._compare_edge(constant, depth)
    assert edge == pytest.approx(4.0, rel=0.02) and error == pytest.approx(4.0 / 3.0, rel=0.02)


@pytest.mark.parametrize(("middle", "found"), [(5.0, -0.8), (1.0, None)])
def test_one_echo_of_another_surface_in_the_middle_of_an_outline_is_the_target(middle, found, rng):
    """A target of 1.6 m that was declared as 12 m: the constant was 5.5 times too large, with an error of 3 %."""
    depth = np.linspace(0.0, 1.0, 100)
    constant = np.where(depth < 1.0, 1.0, middle) * (1 + 0.01 * rng.standard_normal(100))
    edge, error = targets_module._compare_edge(constant, depth)
    assert edge == (found if found is None else pytest.approx(found, abs=0.02))
    assert error == pytest.approx(0.0 if found is None else 4.0, rel=0.05)
    constant[::10] = 1.0 + 1.2 * (middle - 1.0)  # one of several spots: 5 % of sound targets have one there
    assert targets_module._compare_edge(constant, depth) == (None, 0.0)


@pytest.mark.parametrize(("other", "apart"), [(2.0, 0.5), (1.0, 0.0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_halves_of_a_small_target_are_compared(other, apart, axis, rng):
    """An outline half on a field had twice the constant, with an error of 17 %: too few echoes for more parts."""
    xyz = rng.uniform(-1, 1, (30, 3))
    constant = np.where(xyz[:, axis] > 0.0, other, 1.0) * (1 + 0.02 * rng.standard_normal(30))
    assert targets_module._compare_parts(constant, xyz) == pytest.approx(apart, abs=0.05)
    assert targets_module._compare_parts(constant[:19], xyz[:19]) == 0.0


@pytest.mark.parametrize(("few", "apart"), [(4, 2.3), (12, 0.5), (4, 1.0)])
def test_a_small_target_in_a_large_outline_shows_on_uneven_ground(few, apart, rng):
    """A target of 2.4 m that was declared as 6 m: the constant was 57 % too small, with an error of 8 %."""
    depth = np.linspace(0.0, 1.0, 30)
    constant = np.where(np.arange(30) >= 30 - few, apart, 1.0) * np.exp(0.1 * rng.uniform(-1, 1, 30))
    edge, error = targets_module._compare_edge(constant, depth)
    true = abs(apart - np.median(constant))
    assert edge is None if apart == 1.0 else error == pytest.approx(true / np.median(constant), rel=0.25)


@pytest.mark.parametrize("hole", [0.0, 0.5, 1.5])
def test_a_middle_without_an_echo_is_said_with_its_size(hole, rng):
    """A target of 1.2 m in an outline of 6 m whose middle no pulse met: 71 % off, with 3 % stated, in silence."""
    rows = np.zeros(400, CLEAN_ECHO)
    rows["xyz"][:, :2] = rng.uniform(-3, 3, (400, 2))
    rows = rows[np.abs(rows["xyz"]).max(axis=1) > hole]
    rows["ray"], rows["distance"] = (0.0, 0.0, -1.0), 700.0
    rows["light"], rows["light_err"] = 1e4 * (1 + 0.02 * rng.standard_normal(len(rows))), 1.0
    target = Target("t", 0.3, np.array([(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)]))
    result, *_ = targets_module.measure_target(target, rows, 0.1, 0.03)
    assert result.hidden_m == (pytest.approx(2 * hole, abs=0.3) if hole > 1.0 else None)


@pytest.mark.parametrize(("number", "hole", "least", "most"), [(30, 0.0, 0, 2), (60, 0.0, 0, 2), (60, 1.0, 50, 50)])
def test_a_middle_without_an_echo_by_chance_is_not_said(number, hole, least, most):
    """Of sound targets with 30 echoes one in seven was named."""
    said = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        rows = np.zeros(4 * number, CLEAN_ECHO)
        rows["xyz"][:, :2] = rng.uniform(-3, 3, (len(rows), 2))
        rows = rows[np.abs(rows["xyz"]).max(axis=1) > hole][:number]
        rows["ray"], rows["distance"] = (0.0, 0.0, -1.0), 700.0
        rows["light"], rows["light_err"] = 1e4 * (1 + 0.02 * rng.standard_normal(number)), 1.0
        target = Target("t", 0.3, np.array([(-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0)]))
        said += targets_module.measure_target(target, rows, 0.1, 0.03)[0].hidden_m is not None
    assert least <= said <= most
