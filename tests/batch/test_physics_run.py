"""`wavebatch run` with calibration, trajectory and neither: columns, report, the same bytes for any jobs and blocks."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from commands import run_command, succeed
from strips import take_turns, true_sensor, write_positions

from wavebatch.surveying.calibrating.calibration_files import format_calibration
from wavebatch.surveying.calibration import Calibration
from wavebatch.surveying.flat_ground import GroundReference
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.render import START_TIME

FOUND = Calibration(2.6e-8, 0.02, 0.3, divergence=1.1, strip="strip.laz", date="2026-11-21",
                    conditions="said by a test")  # fmt: skip


def run(*arguments):
    return run_command("run", *arguments)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("cal") / "cal.toml"
    path.write_text(format_calibration(FOUND))
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory, tiny_strip, calibration):
    folder = tmp_path_factory.mktemp("plain")
    succeed("run", tiny_strip, "-o", folder, "--profile", "fast", "--calibration", calibration)
    return folder


def columns(folder, *names):
    cloud = laspy.read(next(folder.glob("*.laz")))
    return [np.asarray(cloud[name], np.float64) for name in names]


def report(folder):
    return json.loads(next(folder.glob("*.report.json")).read_text())


def test_a_calibration_adds_columns_and_the_strips_own_vectors_serve(plain):
    ranges, section, gamma, rho, angle = columns(
        plain, "range", "cross_section", "backscatter_coefficient", "level_reflectance", "incidence_angle"
    )
    known = ranges != -9999
    assert 0.9 < known.mean() < 1.0
    assert (ranges[known] > 750).all() and (ranges[known] < 1000).all()
    square = np.pi / 4 * (1.1e-3 * ranges) ** 2
    lit = gamma != -9999  # widths at a bound give none
    assert 0.9 < np.mean(lit[known]) <= 1.0
    assert section[lit] == pytest.approx((gamma * square)[lit], rel=1e-4)
    assert np.isin(section[~lit], -9999).all() and not lit[~known].any()
    assert 0.0 < (rho != -9999).mean() < known.mean()
    assert ((angle == -9999) | ((angle >= 0) & (angle <= 80))).all()
    told = report(plain)
    assert told["strip"]["sensor"]["source"] == "direction vectors"
    assert told["strip"]["sensor"]["range_error_m"] < 0.15
    assert told["request"]["calibration"]["constant"] == 2.6e-8


@pytest.mark.parametrize(("measured", "used"), [(33.33, 33.3), (85.0, 80.0)])
def test_errors_of_level_reflectances_take_the_slopes_of_the_strip(
    tmp_path, tiny_strip, calibration, monkeypatch, measured, used
):
    monkeypatch.setattr("wavebatch.surveying.flat_ground.measure_slope", lambda reader, scan: measured)
    succeed("run", tiny_strip, "-o", tmp_path, "--profile", "fast", "--calibration", calibration)
    assert f"slope = {used}\n" in report(tmp_path)["chain"]


def test_the_divergence_of_the_chain_is_compared_with_the_widths(tmp_path, tiny_strip, calibration, monkeypatch):
    """The widths agree with the calibration, whose divergence the chain replaces."""
    monkeypatch.setattr("wavebatch.surveying.flat_ground.sample_reference",
                        lambda *arguments: GroundReference(arguments[3], 100, 1.1, 0.1))  # fmt: skip
    chain = tmp_path / "c.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.gaussian", "attribute.position",
              "attribute.incidence_angle")  # fmt: skip
    chain.write_text("".join(f'[[chain]]\nstage = "{name}"\n' for name in stages) + "divergence = 3.0\n")
    done = succeed("run", tiny_strip, "-o", tmp_path / "out", "-c", chain, "--calibration", calibration, "-q")
    assert "a beam of 3 mrad contradicts" in done.stderr


@pytest.mark.slow
def test_the_same_bytes_for_any_jobs_and_blocks(tmp_path, tmp_path_factory, edit_points, wide_strip, calibration):
    plain = tmp_path_factory.mktemp("wide")
    strip = take_turns(Path(shutil.copy(wide_strip, plain / "s.las")), edit_points)
    for folder, options in ((plain, ()), (tmp_path, ("--jobs", "2", "--block-size", "999"))):
        succeed("run", strip, "-o", folder, "--profile", "fast", "--calibration", calibration, *options)
    assert next(tmp_path.glob("*.laz")).read_bytes() == next(plain.glob("*.laz")).read_bytes()
    told = report(plain)
    for name, counts in told["counts"]["no_data"].items():
        assert sum(counts.values()) == told["counts"]["echoes"], name
    assert set(told["counts"]["no_data"]) >= {"range", "incidence_angle", "reflectance"}
    again = report(tmp_path)
    assert {key: again[key] for key in ("counts", "remarks")} == {key: told[key] for key in ("counts", "remarks")}


@pytest.mark.slow
def test_a_beam_that_tells_no_angle_is_told_in_words_and_numbers(tmp_path):
    strip, cal = tmp_path / "flat.las", tmp_path / "cal.toml"
    simulate_strip("flat", strip, pulses=12_000, seed=2)
    cal.write_text(format_calibration(replace(FOUND, divergence=0.3)))
    done = succeed("run", strip, "-o", tmp_path / "out", "--profile", "fast", "--calibration", cal, "-v")
    counts = report(tmp_path / "out")["counts"]
    angle = counts["no_data"]["incidence_angle"]
    # An echo of ten thousand is widened by more than four errors.
    known = angle.get("KNOWN", 0)
    assert known <= 3 and angle["UNCERTAIN"] > 0.9 * counts["echoes"]
    (remark,) = [line for line in report(tmp_path / "out")["remarks"] if line.startswith("incidence_angle:")]
    share = f"{known} of {counts['echoes']} echoes have one" if known else f"none of {counts['echoes']} echoes has one"
    assert f"incidence_angle: {share}" in remark
    for number in ("a beam of 0.3 mrad on a slope of 30 degrees", "widens the pulse from", "max_error is 10"):
        assert number in remark
    assert remark in done.stderr
    told = f"no-data for {angle['UNCERTAIN']} of {counts['echoes']} echoes: more uncertain than max_error"
    assert told in done.stderr
    quiet = run(strip, "-o", tmp_path / "more", "--profile", "fast", "--calibration", cal)
    assert remark in quiet.stderr and "no-data for" not in quiet.stderr


def write_trajectory(path, first=-1.0, last=2.0, step=0.05):
    time = START_TIME + np.arange(first, last, step)
    return write_positions(path, time, true_sensor(time))


@pytest.mark.slow
def test_a_trajectory_gives_the_same_as_the_vectors(tmp_path, plain, tiny_strip, calibration):
    path = write_trajectory(tmp_path / "t.csv")
    folder = tmp_path / "out"
    succeed("run", tiny_strip, "-o", folder, "--profile", "fast", "--calibration", calibration, "--trajectory", path)
    a, b = columns(folder, "cross_section")[0], columns(plain, "cross_section")[0]
    known = a != -9999
    np.testing.assert_array_equal(known, b != -9999)
    assert np.abs(a[known] / b[known] - 1).max() < 0.002
    assert report(folder)["strip"]["sensor"]["share_covered"] == 1.0


def test_heights_of_another_kind_are_told(tmp_path, tiny_strip):
    path = write_trajectory(tmp_path / "t.csv")
    head, *rows = path.read_text().splitlines()
    raised = [f"{left},{float(height) + 45.0}" for left, _, height in (row.rpartition(",") for row in rows)]
    path.write_text("\n".join([head, *raised]))
    arguments = (tiny_strip, "-o", tmp_path / "out", "--profile", "fast", "--trajectory", path)
    done = succeed("run", *arguments)
    (remark,) = report(tmp_path / "out")["remarks"]
    assert remark.startswith("range: by the trajectory echoes are 4") and "geoid" in remark and remark in done.stderr
    write_trajectory(path)  # under the same name
    assert run(*arguments, "--resume").exit_code == 0 and not report(tmp_path / "out")["remarks"]


@pytest.mark.slow
def test_verbose_says_where_the_sensor_was(tmp_path, wide_strip, calibration):
    done = run(wide_strip, "-o", tmp_path / "out", "--profile", "fast", "--calibration", calibration, "-v")
    (line,) = [line for line in done.stderr.splitlines() if "sensor from direction vectors: " in line]
    for words in ("m above the points", "60.0 m/s", "heading 90 degrees", "smooth to", "ranges to"):
        assert words in line
    assert "sensor from" not in run(wide_strip, "-o", tmp_path / "bare", "--profile", "fast", "-v").stderr


def test_resume_makes_it_anew_when_the_calibration_changes(tmp_path, tiny_strip):
    path = tmp_path / "cal.toml"
    arguments = (tiny_strip, "-o", tmp_path / "out", "--profile", "fast", "--calibration", path, "--resume", "-v")
    path.write_text(format_calibration(FOUND))
    assert run(*arguments).exit_code == 0
    first = columns(tmp_path / "out", "backscatter_coefficient")[0]
    path.write_text(format_calibration(replace(FOUND, constant=5.2e-8)))
    assert run(*arguments).exit_code == 0
    second = columns(tmp_path / "out", "backscatter_coefficient")[0]
    known = first != -9999
    assert known.any()
    assert second[known] == pytest.approx(2 * first[known], rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), {"range": "no stage attribute.range", "reflectance": "not calibrated", "incidence_angle": "divergence"}),
        (("--flight-height", "800"), {"cross_section": "not calibrated", "backscatter_coefficient": "not calibrated"}),
    ],
)
def test_columns_that_are_not_written_have_a_reason_in_the_report(tmp_path, tiny_strip, arguments, expected):
    succeed("run", tiny_strip, "-o", tmp_path / "out", "--profile", "fast", *arguments)
    told = report(tmp_path / "out")["output"]
    for column, words in expected.items():
        assert column not in told["columns"] and words in told["not_computed"][column]
    assert not set(told["not_computed"]) & set(told["columns"])


def test_relative_columns_are_written_on_request_and_say_so_in_the_file(tmp_path, tiny_strip):
    chain = tmp_path / "c.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.gaussian", "attribute.position", "attribute.range",
              "attribute.relative_backscatter", "attribute.relative_cross_section",
              "attribute.incidence_angle_normals", "attribute.relative_reflectance",
              "attribute.cross_section")  # fmt: skip
    chain.write_text("".join(f'[[chain]]\nstage = "{name}"\n' for name in stages))
    succeed("run", tiny_strip, "-o", tmp_path / "out", "-c", chain, "--points", "returns")
    cloud = laspy.read(next((tmp_path / "out").glob("*.laz")))
    ranges, gamma, section = columns(tmp_path / "out", "range", "relative_backscatter", "relative_cross_section")
    known = gamma != -9999
    assert known.mean() > 0.9 and (gamma[known] > 0).all()
    assert (section / gamma)[known] == pytest.approx(ranges[known] ** 2, rel=1e-5)
    said = {entry.name: entry.description for entry in cloud.point_format.extra_dimensions}
    for name in ("relative_backscatter", "relative_cross_section", "relative_reflectance"):
        assert "relative" in said[name] and "DN ns m" in said[name]
    told = report(tmp_path / "out")
    assert (columns(tmp_path / "out", "cross_section")[0] == -9999).all()
    assert set(told["counts"]["no_data"]["cross_section"]) == {"NOT_CALIBRATED"}
    assert any("cross_section: none of" in line and "relative_backscatter" in line for line in told["remarks"])


@pytest.mark.quick_cases("-1.0-0.25-55")
@pytest.mark.parametrize(("first", "last", "share"), [(-1.0, 0.25, 55), (0.1, 3.0, 18), (-1.0, 0.7, 0)])
def test_a_trajectory_that_does_not_cover_the_strip_is_told_with_counts(tmp_path, wide_strip, first, last, share):
    path, out = write_trajectory(tmp_path / "t.csv", first, last + 1e-9, 0.0005), tmp_path / "out"
    done = succeed("run", wide_strip, "-o", out, "--profile", "fast", "--trajectory", path)
    lines = [line for line in done.stderr.splitlines() if "has no position" in line]
    (ranges,) = columns(out, "range")
    if not share:
        assert not lines
        return
    (line,) = lines
    counts = report(out)["counts"]["no_data"]["range"]
    assert sum(counts.values()) - counts["NO_SENSOR"] == np.count_nonzero(ranges != -9999)
    assert 100 * counts["NO_SENSOR"] / sum(counts.values()) == pytest.approx(share, abs=2)
    assert f"{counts['NO_SENSOR']} of {sum(counts.values())} echoes" in line and "t.csv" in line
    told = float(line.split("there (")[1].split(" %")[0])
    assert told == pytest.approx(share, abs=2)
    assert f"{START_TIME + last:.2f} to" in line or f"to {START_TIME + first:.2f} s" in line


def test_returns_off_their_ray_are_in_the_error_and_in_a_line(tmp_path, edit_points):
    """Vendors of bathymetry bend light at the water: bottoms were .8 m below their returns, with errors of 3 mm."""

    def bend(points):
        second = np.flatnonzero((points["bit_fields"] & 7) == 2)
        for axis in "XYZ":
            points[axis][second] = points[axis][second - 1] + 0.75 * (points[axis][second] - points[axis][second - 1])
        return points

    simulate_strip("urban", tmp_path / "a.las", pulses=6000, seed=3)
    edit_points(tmp_path / "a.las", tmp_path / "b.las", bend)
    lines = {}
    for name in "ab":
        done = succeed("run", tmp_path / f"{name}.las", "-o", tmp_path / name, "--profile", "fast")
        lines[name] = "second lies off its ray" in done.stderr
    assert lines == {"a": False, "b": True}
    clouds = [laspy.read(tmp_path / name / f"{name}.laz") for name in "ab"]
    number, before, after = clouds[0].return_number, *(cloud["range_err"] for cloud in clouds)
    assert (before[number == 1] == after[number == 1]).all()
    assert np.median(after[number == 2]) > 10.0 * np.median(before[number == 2])


@pytest.mark.quick_cases("later", "mirrored")
@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("return_point_wave_location", lambda part: part["return_point_wave_location"] + 5000.0, "where their packets"),
        ("return_point_wave_location", lambda part: part["return_point_wave_location"] - 3000.0, "where their packets"),
        ("y_t", lambda part: -part["y_t"], "the second lies off its ray"),
        ("x_t", lambda part: part["x_t"], ""),
    ],
    ids=["later", "earlier", "mirrored", "sound"],
)
def test_a_stretch_of_wrong_locations_or_vectors_is_named(tmp_path, edit_points, name, change, said):
    """A fifth of the strip had echoes .4 to .8 m off, in silence."""

    def spoil(points):
        part = slice(int(0.4 * len(points)), int(0.6 * len(points)))
        points[name][part] = change(points[part])

    simulate_strip("forest", tmp_path / "a.las", pulses=6000, seed=4)
    edit_points(tmp_path / "a.las", tmp_path / "b.las", spoil)
    done = succeed("run", tmp_path / "b.las", "-o", tmp_path, "--profile", "fast")
    texts = ("where their packets", "the second lies off its ray")
    assert [text for text in texts if text in done.stderr] == [said] * bool(said)
