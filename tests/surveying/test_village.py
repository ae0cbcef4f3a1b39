"""The whole way on a simulated village: targets, calibration, run; angles, cross sections and reflectances recovered,
each with an error that holds."""

from dataclasses import replace

import laspy
import numpy as np
import pytest
from commands import succeed as call
from helpers_scenes import make_scene
from strips import true_sensor, write_positions

from wavebatch.core.waveforms import Radiometry, SystemPulse
from wavebatch.surveying import survey_block
from wavebatch.surveying.flat_ground import (
    LEAST_NEIGHBOURS,
    RADII,
    GroundReference,
    Slopes,
    choose_radius,
    measure_reference,
)
from wavebatch.tools.simulate import find_scene, simulate_strip
from wavebatch.tools.simulate.render import AIR_SPEED, GROUND, NORTH, START_TIME, FlightLine
from wavebatch.tools.simulate.scenes import GROUND_REFLECTS, ROOFS_REFLECT, simulate_seed_block

pytestmark = pytest.mark.kept_surveys

SCENE = find_scene("village")


@pytest.mark.parametrize(("seen", "error"), [(2.0, 1.2 * 1.6), (0.5, 0.55)])
def test_the_error_of_a_beam_that_the_widths_contradict_is_that_of_the_farther_end(seen, error):
    """A beam of 1 mrad, and one of 2 +- 0.2 or of 0.5 +- 0.05 by the widths: it may be 2.2 or 0.45 times as wide."""
    system = SystemPulse(sigma_ref=2.0, radiometry=Radiometry(divergence=1.0))
    assert GroundReference(system, 100, seen, 0.1).doubt_error() == pytest.approx(error)


def test_the_radius_of_neighbourhoods_holds_enough_points(tmp_path):
    sparse = replace(SCENE.flight, pulse_rate=0.1 * SCENE.flight.pulse_rate)
    simulate_strip(replace(SCENE, flight=sparse), tmp_path / "v.las", pulses=900, seed=3)
    xyz = laspy.read(tmp_path / "v.las").xyz
    apart = np.sort(np.linalg.norm(xyz[:, None] - xyz, axis=2), axis=1)[:, LEAST_NEIGHBOURS * 3 // 2 - 1]
    assert choose_radius(xyz) == pytest.approx(np.ceil(10 * np.quantile(apart, 0.9)) / 10)
    assert choose_radius(100 * xyz) == RADII[1], "as large as it may be, where too few are near"


def write_targets(path, strip):
    """Level ground between two rows of houses."""
    x = float(np.median(laspy.read(strip).x))
    corners = f"{x - 80} {NORTH + 0.2} {x + 80} {NORTH + 0.2} {x + 80} {NORTH + 5.8} {x - 80} {NORTH + 5.8}"
    path.write_text(f"reflectance,vertices\n{GROUND_REFLECTS},{corners}\n")
    return path


def write_trajectory(path, stop):
    time = START_TIME + np.arange(-1.0, stop + 1.0, 0.05)
    return write_positions(path, time, true_sensor(time, SCENE.flight))


def fly(folder, seed, pulses):
    """Cloud and truth of echoes alone in their packet, by columns; the cloud's folder has the calibration beside."""
    strip, truth = folder / f"v{seed}.las", folder / f"v{seed}.npz"
    simulate_strip("village", strip, pulses=pulses, seed=seed, truth=truth)
    targets, cal = write_targets(folder / "t.csv", strip), folder / f"cal{seed}.toml"
    call("calibrate", strip, "--targets", targets, "-o", cal, "--divergence", SCENE.divergence)
    call("run", strip, "-o", folder / "out", "--profile", "balanced", "--calibration", cal, "-q")
    return match(folder / "out" / f"v{seed}.laz", truth)


def match(cloud, truth):
    cloud, true = laspy.read(cloud), np.load(truth, allow_pickle=False)
    times, first = np.unique(true["gps_time"], return_index=True)
    at = np.minimum(np.searchsorted(times, cloud.gps_time), len(times) - 1)
    alone = (times[at] == cloud.gps_time) & (np.asarray(cloud.number_of_returns) == 1)
    found = {name: np.asarray(cloud[name], np.float64)[alone] for name in cloud.point_format.extra_dimension_names}
    found = {name: np.where(values == -9999, np.nan, values) for name, values in found.items()}
    rows = first[at[alone]]
    return found, {name: true[name][rows].astype(np.float64) for name in ("incidence_angle", "range", "z")}


def check_angles(found, true, coverage):
    known = np.isfinite(found["incidence_angle"])
    assert known.mean() > 0.85
    off = np.abs(found["incidence_angle"] - true["incidence_angle"])[known]
    error = found["incidence_angle_err"][known]
    assert np.mean(off <= error) == pytest.approx(0.683, abs=coverage)
    assert np.median(off / error) == pytest.approx(0.6745, rel=0.2)
    return off, error, true["incidence_angle"][known]


def check_light(found, true):
    roof = true["z"] > GROUND + 1
    reflectance = np.where(roof, ROOFS_REFLECT, GROUND_REFLECTS)
    facing = np.cos(np.radians(true["incidence_angle"]))
    section = 4 * reflectance * facing * np.pi / 4 * (1e-3 * SCENE.divergence * true["range"]) ** 2
    for rows in (roof, ~roof):
        assert np.nanmedian((found["cross_section"] / section)[rows]) == pytest.approx(1.0, abs=0.03)
    level = found["reflectance"][~roof] / GROUND_REFLECTS
    assert np.nanmedian(level) == pytest.approx(1.0, abs=0.03)
    assert 1.4826 * np.nanmedian(np.abs(level - 1)) < 0.03


@pytest.fixture(scope="module")
def village(tmp_path_factory):
    folder = tmp_path_factory.mktemp("village")
    return folder, *fly(folder, 1, 9000)


@pytest.mark.slow
def test_angles_of_the_village_hold(village):
    check_angles(*village[1:], coverage=0.05)


def test_cross_sections_and_reflectances_are_recovered(village):
    check_light(*village[1:])


@pytest.mark.slow
def test_a_trajectory_changes_cross_sections_by_a_fifth_of_a_percent_at_most(village):
    folder, _, _ = village
    given = write_trajectory(folder / "t.txt", 0.1)
    call("run", folder / "v1.las", "-o", folder / "given", "--profile", "balanced", "--calibration",
         folder / "cal1.toml", "--trajectory", given, "-q")  # fmt: skip
    a, b = (laspy.read(folder / name / "v1.laz")["cross_section"] for name in ("out", "given"))
    known = np.asarray((a != -9999) & (b != -9999))
    assert known.mean() > 0.9
    assert np.abs(np.asarray(b / a)[known] - 1).max() < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_every_bin_of_angles_holds_on_longer_strips(tmp_path, seed):
    found, true = fly(tmp_path, seed, 40_000)
    check_light(found, true)
    off, error, angle = check_angles(found, true, coverage=0.04)
    for low in range(0, 60, 10):
        inside = (angle >= low) & (angle < low + 10)
        assert inside.sum() > 300
        assert np.mean(off[inside] <= error[inside]) == pytest.approx(0.683, abs=0.08), low


def see_swath(half_angle):
    """Level ground seen across a swath as slopes, and its survey with the beam's divergence."""
    made = simulate_seed_block(replace(SCENE, flight=FlightLine(640.0, half_angle=half_angle, look_ahead=0.0)), 6, 0)
    back = made.rays.direction / AIR_SPEED * made.rays.distance[:, None]
    block = replace(made.block, sensor=made.rays.ground - back)
    surveyed = survey_block(block).system.with_radiometry(divergence=SCENE.divergence)
    rows = np.repeat(np.arange(len(block))[:, None], 3, axis=1)  # in the place of places
    angles = made.rays.incidence, np.full(len(block), np.radians(0.3))
    return Slopes(block, rows, lambda place, _: tuple(values[place[:, 0]] for values in angles)), surveyed


@pytest.mark.parametrize("half_angle", [10.0, 25.0])
def test_level_ground_is_told_from_the_swath(half_angle):
    """The survey's pulse holds the rays' own slopes; what is left without them is the true pulse."""
    known, surveyed = see_swath(half_angle)
    true = SCENE.recording.pulse.sigma
    assert surveyed.sigma_ref / true > 1.005
    seen = measure_reference([known], surveyed, known.block.spacing).system
    assert np.sqrt(seen.sigma_ref**2 + seen.widths.variance) == pytest.approx(true, rel=0.002)
    assert seen.widths.scatter < 0.01 * true


def test_slopes_are_seen_in_samples_of_a_few_waveforms():
    """Without a divergence some waveforms of each tell whether any slope is known."""
    known, surveyed = see_swath(25.0)
    cuts = [slice(row, row + 2) for row in range(0, 1000, 2)]
    parts = [known._replace(block=known.block.rows(cut), place=known.place[cut]) for cut in cuts]
    pulse = surveyed.with_radiometry(divergence=None)
    whole = measure_reference([known._replace(block=known.block.rows(slice(0, 1000)))], pulse, known.block.spacing)
    found = measure_reference(parts, pulse, known.block.spacing)
    assert whole.echoes > 0 and found.echoes == whole.echoes


def test_a_digitizer_has_the_beam_of_its_strip_and_its_error():
    known, pulse = see_swath(10.0)
    doubtful = pulse.with_radiometry(divergence_error=0.2)
    index, spacing = known.block.digitizer.index, known.block.spacing
    certain, main = (measure_reference([known], system, spacing).system.widths for system in (pulse, doubtful))
    assert main.error > 2.0 * certain.error
    blind = pulse.with_radiometry(divergence=None)
    both = measure_reference([known], replace(doubtful, digitizers={index: blind}), spacing).system
    assert both.digitizers[index].widths == main


@pytest.mark.slow
def test_a_reference_that_no_surface_shows_is_no_reference():
    block = simulate_seed_block(make_scene("empty"), 1, 0).block
    system = SystemPulse(2.0, radiometry=Radiometry(divergence=0.5))
    place = block.origin
    unknown = Slopes(replace(block, sensor=place), place, lambda places, _: np.full((2, len(places)), np.nan))
    for samples in ([], [unknown], [unknown._replace(block=block)]):
        seen = measure_reference(samples, system, 1.0)
        assert np.isinf(seen.system.widths.error) and seen.divergence is None and seen.echoes == 0
    blind = system.with_radiometry(divergence=None)
    assert measure_reference([unknown], blind, 1.0).system == blind


@pytest.mark.slow
def test_survey_says_what_angles_the_beam_tells(village):
    strip = village[0] / "v1.las"
    wide = call("survey", strip, "--divergence", "1.1", "-o", village[0] / "s.toml").stdout
    assert "yes      incidence angle" in wide and "a beam of 1.1 mrad on a slope of 30 degrees" in wide
    assert "divergence_mrad = 1.1" in (village[0] / "s.toml").read_text()
    narrow = call("survey", strip, "--divergence", "0.05").stdout
    assert "no       incidence angle" in narrow
