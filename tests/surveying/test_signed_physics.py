"""Physical columns against geometry: strips of footprints traced sub-ray by sub-ray onto roofs and hillsides."""

import json
import re
from dataclasses import replace

import footprints
import laspy
import numpy as np
import pytest
from commands import run_command
from commands import succeed as call
from footprints import Flight, Plane, match, roofs, write_strip

from wavebatch.surveying.systems.survey_result import load_survey

pytestmark = pytest.mark.kept_surveys

GREEN = Flight()
HILLSIDE = Plane(slope=(np.tan(np.radians(22.0)), 0.1))


def write_calibration(path, flight, *, divergence=None, shot_energy=0.0):
    path.write_text(
        f'schema = "wavebatch.calibration/1"\nconstant = {float(flight.constant)!r}\nrelative_error = 1e-9\n'
        f"attenuation_db_km = {flight.air}\ndivergence_mrad = {float(divergence or flight.divergence)}\n"
        f"[[channel]]\ndigitizer = 1\nconstant = {float(flight.constant)!r}\nrelative_error = 1e-9\n"
        f"shot_energy = {float(shot_energy)}\n"
    )
    return path


def fly(folder, planes, flight, pulses=12_000, *options, seed=1, calibration=None):
    """Columns of the cloud, NaN where no-data, the truth of each of its points, and its report."""
    folder.mkdir(exist_ok=True)
    truth = write_strip(folder / "strip.las", planes, flight, pulses, seed)
    calibration = calibration or write_calibration(folder / "cal.toml", flight)
    call("run", folder / "strip.las", "-o", folder / "out", "--calibration", calibration, "-q", *options)
    return read(folder / "out", truth)


def read(folder, truth):
    cloud = laspy.read(folder / "strip.laz")
    rows = match(np.asarray(cloud.gps_time), truth)
    names = [name for name in cloud.point_format.extra_dimension_names if name != "echo_flags"]
    columns = {name: np.asarray(cloud[name], np.float64) for name in names}
    columns = {name: np.where(values == -9999, np.nan, values) for name, values in columns.items()}
    wanted = ("range", "incidence", "reflectance", "plane", "pure", "gamma")
    true = {name: getattr(truth, name)[rows] for name in wanted}
    return columns, true, json.loads((folder / "strip.report.json").read_text())


def check(columns, name, true, rows, *, bias=0.02, known=0.95):
    """Bias below 2 % (of 1 deg for angles, or more), 60 to 76 % of the errors within one standard deviation."""
    value, error = columns[name][rows], columns[f"{name}_err"][rows]
    there = np.isfinite(value)
    assert there.mean() > known, name
    off = value[there] - true[rows][there]
    scale = np.median(true[rows]) if "angle" not in name else max(0.02 * np.median(true[rows]), 0.3) / bias
    assert abs(np.median(off)) < bias * scale, name
    # Planes of neighbouring points share their errors, so that a roof counts as few independent ones; and their errors
    # hold that vectors may be turned against the points, which these are not.
    most = 0.85 if name == "incidence_angle_normals" else 0.77
    assert 0.60 < np.mean(np.abs(off) <= error[there]) < most, name


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    planes = [*roofs([0, 20, 38, 55]), Plane(0.25)]
    return fly(tmp_path_factory.mktemp("town"), planes, GREEN, 16_000)


@pytest.mark.slow
@pytest.mark.parametrize("plane", range(5))
def test_roofs_have_right_numbers_with_right_errors(town, plane):
    columns, true, _ = town
    rows = (true["plane"] == plane) & true["pure"]
    section = true["gamma"] * np.pi / 4 * (1e-3 * GREEN.divergence * true["range"]) ** 2
    check(columns, "backscatter_coefficient", true["gamma"], rows)
    check(columns, "cross_section", section, rows)
    check(columns, "reflectance", true["reflectance"], rows)
    check(columns, "incidence_angle", true["incidence"], rows)
    check(columns, "incidence_angle_normals", true["incidence"], rows)


@pytest.mark.slow
def test_a_level_reflectance_is_wrong_on_roofs_by_its_error(town):
    columns, true, report = town
    level = true["pure"] & (true["plane"] == 4)
    assert np.nanmedian(columns["level_reflectance"][level]) == pytest.approx(0.25, rel=0.02)
    roof = true["pure"] & (true["plane"] == 2)
    off = np.abs(columns["level_reflectance"] - true["reflectance"])[roof]
    assert np.nanmedian(off / columns["level_reflectance_err"][roof]) < 2.5
    counts = report["counts"]["no_data"]
    for name in ("reflectance", "level_reflectance", "incidence_angle_normals"):
        assert sum(counts[name].values()) == report["counts"]["echoes"]
    assert counts["reflectance"]["KNOWN"] == np.isfinite(columns["reflectance"]).sum()


@pytest.mark.slow
def test_reflectance_alone_needs_no_written_angle(tmp_path, town):
    planes = [*roofs([0, 20, 38, 55]), Plane(0.25)]
    columns, _, report = fly(tmp_path, planes, GREEN, 16_000, "--columns", "reflectance")
    assert set(columns) == {"reflectance"}
    np.testing.assert_array_equal(columns["reflectance"], town[0]["reflectance"])
    assert set(report["output"]["columns"]) == {"reflectance"}


@pytest.mark.slow
@pytest.mark.parametrize("slope", [(0.4, 0.1), (-0.2, 0.65)])
def test_a_hillside_without_level_ground_has_right_angles(tmp_path, slope):
    columns, true, _ = fly(tmp_path, [Plane(slope=slope)], GREEN, seed=2)
    everywhere = np.ones(len(true["plane"]), bool)
    for name in ("incidence_angle", "incidence_angle_normals"):
        check(columns, name, true["incidence"], everywhere)
    check(columns, "reflectance", true["reflectance"], everywhere)


@pytest.mark.parametrize("rough", [0.0, 0.05])
def test_rough_ground_that_reads_as_a_slope_is_in_the_errors(tmp_path, monkeypatch, rough):
    """Grass 5 cm high on half of a level field made angles 10 degrees too large, with errors of .8."""
    rng, meet, calls = np.random.default_rng(4), footprints.meet, []

    def ruffle(origin, unit, planes):
        distance, facing, plane = meet(origin, unit, planes)
        calls.append(0)
        # Only the light is scattered by it, not where the middle of the footprint is.
        high = rough * rng.standard_normal(distance.shape) * (plane == 0) if len(calls) == 1 else 0.0
        return distance + high, facing, plane

    monkeypatch.setattr(footprints, "meet", ruffle)
    planes = [Plane(0.25, inside=lambda x, y: np.sin(y / 9) > 0), Plane(0.25)]
    columns, true, _ = fly(tmp_path, planes, GREEN, 6000, "--columns", "incidence_angle,incidence_angle_err")
    angle, error = columns["incidence_angle"], columns["incidence_angle_err"]
    off = np.abs(angle - true["incidence"])
    for plane in (0, 1):
        rows = (true["plane"] == plane) & true["pure"] & np.isfinite(angle)
        assert rows.sum() > 2000 and np.mean(off[rows] < error[rows]) > 0.55
        assert (np.median(error[rows]) < 2.5) == (rough == 0)


def test_without_surfaces_of_known_slope_there_is_no_angle_but_a_sentence(tmp_path):
    """One scan line: no point has a plane around it."""
    columns, _, report = fly(tmp_path, [HILLSIDE], GREEN, 600)
    assert np.isnan(columns["incidence_angle"]).all()
    assert set(report["counts"]["no_data"]["incidence_angle"]) == {"NO_LEVEL"}
    (line,) = [line for line in report["remarks"] if line.startswith("incidence_angle:")]
    assert "too few points of the strip lie on planes" in line and "--system" in line


@pytest.mark.slow
def test_the_survey_of_another_strip_proves_the_reference(tmp_path):
    write_strip(tmp_path / "level.las", [*roofs([15, 30]), Plane()], GREEN, 12_000, 5)
    system = tmp_path / "s.toml"
    call("survey", tmp_path / "level.las", "--divergence", GREEN.divergence, "-o", system)
    saved = load_survey(system).survey.system
    assert saved.widths.error is not None and 0 < saved.widths.error < 0.01
    columns, true, _ = fly(tmp_path, [HILLSIDE], GREEN, 600, "--system", system)
    check(columns, "incidence_angle", true["incidence"], np.ones(len(true["plane"]), bool))


def test_a_survey_file_that_never_looked_for_the_reference_proves_nothing(tmp_path):
    write_strip(tmp_path / "level.las", [HILLSIDE], GREEN, 600, 5)
    system = tmp_path / "s.toml"
    call("survey", tmp_path / "level.las", "-o", system)
    assert "level_error" not in system.read_text()
    columns, _, _ = fly(tmp_path, [HILLSIDE], GREEN, 600, "--system", system)
    assert np.isnan(columns["incidence_angle"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_divergence_is_named_and_in_the_errors(tmp_path, factor):
    planes = [*roofs([0, 20, 38]), Plane()]
    wrong = write_calibration(tmp_path / "cal.toml", GREEN, divergence=factor * GREEN.divergence)
    columns, true, report = fly(tmp_path, planes, GREEN, 16_000, calibration=wrong)
    (line,) = [one["text"] for one in report["warnings"] if "contradicts the echo widths" in one["text"]]
    assert f"a beam of {factor * GREEN.divergence:g} mrad" in line
    assert re.search(r"a beam of 1\.[01]\d* \+- 0\.0\d\d mrad", line)
    section = true["gamma"] * np.pi / 4 * (1e-3 * GREEN.divergence * true["range"]) ** 2
    rows = true["pure"] & np.isfinite(columns["cross_section"])
    off = np.abs(columns["cross_section"] - section)[rows] / columns["cross_section_err"][rows]
    assert 0.6 < np.median(off) < 1.1
    # Voxels name it as well; they have factor^2 of the true cross section.
    voxels = call("voxelize", tmp_path / "strip.las", "--size", 5, "--calibration", wrong, "-o", tmp_path / "v.npz")
    assert f"a beam of {factor * GREEN.divergence:g} mrad contradicts" in voxels.output
    shared = json.loads(str(np.load(tmp_path / "v.npz")["meta"]))["cross_section_error"]
    assert shared == pytest.approx(3.0 if factor == 0.5 else 1.0, rel=0.1)
    # A saved survey that has seen the beam knows it, too.
    call("survey", tmp_path / "strip.las", "--divergence", wide := factor * GREEN.divergence, "-o", tmp_path / "s.toml")
    options = ("--calibration", wrong, "--system", tmp_path / "s.toml", "--columns", "cross_section,cross_section_err")
    call("run", tmp_path / "strip.las", "-o", tmp_path / "again", "-q", *options)
    report = json.loads((tmp_path / "again" / "strip.report.json").read_text())
    assert any(f"a beam of {wide:g} mrad contradicts" in one["text"] for one in report["warnings"])
    cloud = laspy.read(tmp_path / "again" / "strip.laz")
    again = np.asarray(cloud.cross_section_err) / np.asarray(cloud.cross_section)
    assert np.nanmedian(again) == pytest.approx(np.nanmedian(columns["cross_section_err"] / columns["cross_section"]))


@pytest.mark.slow
@pytest.mark.parametrize("divergence", [0.8, 1.6])
def test_the_survey_finds_the_divergence(tmp_path, divergence):
    flight = Flight(divergence=divergence, half_angle=20.0, n_samples=160)
    write_strip(tmp_path / "s.las", [*roofs([10, 30]), Plane()], flight, 16_000, 3)
    call("survey", tmp_path / "s.las", "-o", tmp_path / "s.toml")
    figures = load_survey(tmp_path / "s.toml").survey.figures
    seen, error = figures.divergence_seen_mrad, figures.divergence_seen_error_mrad
    assert abs(seen - divergence) < 3 * error < 0.3 * divergence


@pytest.mark.slow
def test_errors_hold_the_energy_from_shot_to_shot(tmp_path):
    flight = Flight(energy_spread=0.03)
    calibration = write_calibration(tmp_path / "cal.toml", flight, shot_energy=0.03)
    columns, true, _ = fly(tmp_path, [Plane()], flight, 8000, calibration=calibration)
    everywhere = np.ones(len(true["plane"]), bool)
    for name, right in (("backscatter_coefficient", true["gamma"]), ("reflectance", true["reflectance"])):
        check(columns, name, right, everywhere)


@pytest.mark.slow
def test_a_weak_beam_has_no_survivor_bias(tmp_path):
    """Where only some echoes of a roof have an angle, these are not the ones that noise has widened."""
    flight = Flight(divergence=0.4)
    columns, true, _ = fly(tmp_path, [*roofs([18, 25, 35]), Plane(0.1)], flight, 24_000, seed=5)
    for plane in range(3):
        rows = (true["plane"] == plane) & true["pure"]
        value, error = (columns[f"incidence_angle{end}"][rows] for end in ("", "_err"))
        there = np.isfinite(value)
        if there.sum() < 30:
            continue
        off = value[there] - true["incidence"][rows][there]
        assert np.median(off) < 0.5 and np.mean(off) > -1.5
        assert (value[there] > 0).all()  # an echo that only noise makes known has no angle of 0
        assert np.mean(np.abs(off) <= error[there]) > 0.58


@pytest.fixture(scope="module")
def flickering(tmp_path_factory):
    """A strip whose shots scatter by 8 %, with their energies as an extra byte and as a text file, and its truth."""
    folder = tmp_path_factory.mktemp("shots")
    flight = Flight(energy_spread=0.08, store_energy=True)
    truth = write_strip(folder / "strip.las", [Plane()], flight, 6000)
    lines = [f'"{time:.9f}",{energy:.9f}' for time, energy in zip(truth.gps_time, 7.5 * truth.energy, strict=True)]
    # Units may have spaces, columns after those that count may be empty, and fields may be quoted.
    header = "\"time [GPS s]\",energy [nJ of a shot],temperature (deg C)\n"
    (folder / "shots.csv").write_text(header + "\n".join(f"{line},{'20' * (i % 2)}" for i, line in enumerate(lines)))
    return folder, flight, truth


@pytest.mark.slow
@pytest.mark.quick_cases("shots.csv")
@pytest.mark.parametrize("source", ["shot_energy", "shots.csv"])
def test_the_energy_of_each_shot_is_divided_out(tmp_path, flickering, source):
    folder, flight, truth = flickering
    calibration = write_calibration(tmp_path / "cal.toml", flight, shot_energy=0.08)
    given = folder / source if source.endswith(".csv") else source
    options = ("--calibration", calibration, "--energy", given)
    call("run", folder / "strip.las", "-o", tmp_path / "out", "-q", *options)
    columns, true, report = read(tmp_path / "out", truth)
    check(columns, "backscatter_coefficient", true["gamma"], np.ones(len(true["plane"]), bool))
    assert np.nanmedian(columns["backscatter_coefficient_err"] / true["gamma"]) < 0.02
    told = report["strip"]["pulse_energy"]
    assert told["source"] == source and told["spread"] == pytest.approx(0.08, rel=0.05)
    assert told["mean"] == pytest.approx(7.5, rel=0.01) and told["share_known"] == 1.0


@pytest.mark.quick_cases("<lambda>-knows 0 of 6000 pulses of the strip")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: "shot_enrgy", "no extra byte and no file is called 'shot_enrgy'; did you mean 'shot_energy'"),
        (lambda path: write(path, "time,power\n1,2\n"), "first line must name the columns time and energy"),
        (lambda path: write(path, "time,energy\n1,2\n2,x\n"), "a row has no number for time or energy"),
        (lambda path: write(path, "Time [s],Energy [uJ]\n1,2\n2,3\n"), "knows 0 of 6000 pulses of the strip"),
        (lambda path: write(path, "time,pulse energy,temperature\n1,2,20\n"), "it is 'time pulse energy temperature'"),
        (lambda path: write(path, "time,energy,temperature\n1,,20\n"), "a row has no number for time or energy"),
    ],
)
def test_energies_that_cannot_be_used_are_refused_in_one_line(tmp_path, flickering, make, message):
    folder, flight, _ = flickering
    options = ["--columns", "+amplitude_normalized", "--energy", str(make(tmp_path / "e.csv"))]
    done = run_command("run", folder / "strip.las", "-o", tmp_path / "out", *options)
    assert done.exit_code == 4 and message in done.stderr and "Traceback" not in done.stderr


def write(path, text):
    path.write_text(text)
    return path


def test_columns_that_are_asked_for_get_their_stages(tmp_path, flickering):
    folder, flight, truth = flickering
    call("run", folder / "strip.las", "-o", tmp_path / "out", "-q", "--columns", "amplitude_normalized,reflectance")
    columns, true, report = read(tmp_path / "out", truth)
    assert set(columns) == {"amplitude_normalized", "reflectance", "shot_energy"}  # the last one is the input's
    expected = flight.light * true["gamma"] / 4 / 1e6 * 10 ** (-2e-4 * 0.22 * 1000.0)
    there = np.isfinite(columns["amplitude_normalized"])
    # The flat ground widens the pulse by its slope to the rays, which lowers the peak by up to 3 %.
    assert np.median((columns["amplitude_normalized"] / expected)[there]) == pytest.approx(1.0, abs=0.03)
    assert report["counts"]["no_data"]["reflectance"].keys() == {"NOT_CALIBRATED"}
    assert report["strip"]["air"]["from"].startswith("the default")


@pytest.mark.slow
def test_the_air_of_the_flight_replaces_that_of_the_calibration(tmp_path, flickering):
    folder, flight, truth = flickering
    calibration = write_calibration(tmp_path / "cal.toml", flight)
    arguments = ("run", folder / "strip.las", "-q", "--calibration", calibration, "-o")
    call(*arguments, tmp_path / "a", "--columns", "backscatter_coefficient")
    call(*arguments, tmp_path / "b", "--columns", "backscatter_coefficient", "--visibility", 10, "--wavelength", 550)
    a, b = (read(tmp_path / name, truth) for name in "ab")
    extra = 4.342945 * 0.3912 - flight.air
    ratio = b[0]["backscatter_coefficient"] / a[0]["backscatter_coefficient"]
    assert np.nanmedian(ratio) == pytest.approx(10 ** (2e-4 * np.median(a[1]["range"]) * extra), rel=1e-3)
    assert b[2]["strip"]["air"]["attenuation_db_km"] == pytest.approx(4.342945 * 0.3912, rel=1e-4)
    assert a[2]["strip"]["air"]["from"] == "the calibration"


def roof_strips(a, width=9.0):
    return lambda x, y: (y >= a) & (y < a + width)


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "seed"), [(64, 71), (90, 72)])
def test_footprints_that_reach_over_an_edge_to_what_no_packet_holds_have_no_reflectance(tmp_path, samples, seed):
    """Roofs 25 m above ground, packets of 5 m: a tenth of the echoes at their edges was a quarter too dark."""
    planes = [*(Plane(0.4, z0=25.0, inside=roof_strips(-90.0 + 18 * i)) for i in range(10)), Plane(0.25)]
    columns, true, report = fly(tmp_path, planes, replace(GREEN, n_samples=samples), 12_000, seed=seed)
    roof, known = true["plane"] < 10, np.isfinite(columns["reflectance"])
    off = columns["reflectance"] / true["reflectance"] - 1
    assert known[true["pure"]].mean() > 0.98 and report["counts"]["no_data"]["reflectance"]["EDGE"] > 200
    edge = roof & ~true["pure"] & known
    assert np.quantile(off[edge], 0.1) > -0.06 and edge.sum() > 0.5 * (roof & ~true["pure"]).sum()
    assert (known & ~roof & ~true["pure"] & (off < -0.3)).sum() < 10
    level = columns["level_reflectance"] / true["reflectance"] - 1
    assert report["counts"]["no_data"]["level_reflectance"]["EDGE"] > 200
    assert np.nanquantile(level[roof & ~true["pure"]], 0.1) > -0.06
    alone, _, said = fly(tmp_path / "alone", planes, replace(GREEN, n_samples=samples), 12_000,
                         "--columns", "level_reflectance", seed=seed)  # fmt: skip
    np.testing.assert_array_equal(alone["level_reflectance"], columns["level_reflectance"])
    assert said["counts"]["no_data"]["level_reflectance"] == report["counts"]["no_data"]["level_reflectance"]


@pytest.mark.slow
def test_edges_that_packets_hold_are_not_taken_for_others(tmp_path):
    planes = [*(Plane(0.4, z0=6.0, inside=roof_strips(-90.0 + 18 * i)) for i in range(10)), Plane(0.25)]
    _, _, report = fly(tmp_path, planes, replace(GREEN, n_samples=200), 6000, seed=73)
    assert not report["counts"]["no_data"]["reflectance"].get("EDGE", 0)
