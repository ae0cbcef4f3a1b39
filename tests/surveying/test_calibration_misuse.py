"""What contradicts a calibration shows: brightness over the swath, other settings, options that do not fit the strip."""

import numpy as np
import pytest
from click.testing import CliRunner

import wavebatch as wb
from tests.facet_strips import EAST, NORTH, START, Facet, Sensor, box, write_strip
from wavebatch.cli import main
from wavebatch.surveying.calibrating.calibration_file import format_calibration, load_calibration, parse_calibration

LIGHT = 1.2e8
BASE = {"speed": 30.0, "rate": 10_000.0, "half_angle": 12.0}


def call(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments)))


def fields(x, y):
    """Fields of 20 m with reflectances of 0.1 to 0.6."""
    i, j = np.floor(x / 20), np.floor(y / 20)
    return 0.1 + 0.5 * np.abs(np.sin(12.9898 * i + 78.233 * j) * 43758.5453 % 1.0)


GROUND = [Facet(0.3, inside=box(40, 0, 60, 20)), Facet(fields)]


def write_targets(path, more=""):
    x0, y0 = EAST + 41, NORTH + 1
    corners = f"{x0} {y0} {x0 + 18} {y0} {x0 + 18} {y0 + 18} {x0} {y0 + 18}"
    name, value = more.split("=") if more else ("", "")
    path.write_text(f"name,reflectance,vertices{more and ',' + name}\nfield,0.3,{corners}{more and ',' + value}\n")
    return path


@pytest.fixture(scope="module")
def dim_edges(tmp_path_factory):
    """Two strips that overlap by two thirds, whose light falls by 25 % to the edge of the swath; a target near a's nadir."""
    folder = tmp_path_factory.mktemp("edges")
    write_strip(folder / "a.las", GROUND, Sensor(**BASE, light=LIGHT, falloff=0.25), 18_000, seed=11)
    other = Sensor(**BASE, light=LIGHT, falloff=0.25, start=(128, 100), heading=270.0, time=START + 600)
    write_strip(folder / "b.las", GROUND, other, 18_000, seed=12)
    write_targets(folder / "t.csv")
    return folder


def calibrate(folder, *options, strips=("a.las", "b.las")):
    paths = [folder / name for name in strips]
    done = call("calibrate", *paths, "--targets", folder / "t.csv", "-o", folder / "cal.toml", "--overwrite", *options)
    assert done.exit_code == 0, done.output
    return load_calibration(folder / "cal.toml"), done.stderr


def offsets(folder, out):
    """Reflectance of level ground in both strips over the truth, less 1, and the error that gamma states; f8 (2, n)."""
    columns = "level_reflectance,backscatter_coefficient,backscatter_coefficient_err"
    run(folder, out, "a.las", "b.las", "--columns", columns)
    parts = []
    for name in "ab":
        cloud = wb.read_cloud(out / f"{name}.laz")
        x, y = cloud["x"] - EAST, cloud["y"] - NORTH
        inside = (np.abs(x % 20 - 10) < 9) & (np.abs(y % 20 - 10) < 9)
        target = (x >= 40) & (x < 60) & (y >= 0) & (y < 20)
        off = cloud["level_reflectance"] / np.where(target, 0.3, fields(x, y)) - 1
        stated = cloud["backscatter_coefficient_err"] / cloud["backscatter_coefficient"]
        parts.append(np.stack([off, stated])[:, inside & np.isfinite(off)])
    return np.concatenate(parts, axis=1)


def run(folder, out, *arguments):
    strips = [folder / one if str(one).endswith(".las") else one for one in arguments]
    done = call("run", *strips, "-o", out, "--calibration", folder / "cal.toml", "--overwrite")
    assert done.exit_code == 0, done.output
    return done.stderr


def test_brightness_that_falls_across_the_swath_is_named_and_in_the_errors(tmp_path, dim_edges):
    found, said = calibrate(dim_edges)
    assert "brightness changes with the scan angle by" in said and "fit it with --scan-angle" in said
    assert found.channels[0].relative_error > 0.1 and all(row.relative_error > 0.1 for row in found.strips)
    off, stated = offsets(dim_edges, tmp_path)
    assert off.min() < -0.15
    assert 0.5 < np.mean(np.abs(off) < stated) < 0.9


def test_the_term_over_the_scan_angle_is_fitted_kept_drawn_and_applied(tmp_path, dim_edges):
    page = tmp_path / "page.html"
    found, said = calibrate(dim_edges, "--scan-angle", "--html", page)
    assert "scan angle: -2" in said and "brightness changes" not in said
    assert "Light from 0 to 12" in page.read_text()
    assert np.degrees(found.swath[0]) == pytest.approx(12.3, abs=0.2)
    assert np.exp(-sum(found.swath[1:])) == pytest.approx(0.75, abs=0.03)
    assert parse_calibration(format_calibration(found), "again").swath == pytest.approx(found.swath)
    assert found.channels[0].relative_error < 0.04
    off, _ = offsets(dim_edges, tmp_path)
    assert abs(np.median(off)) < 0.01 and np.quantile(np.abs(off), 0.9) < 0.03


def test_a_term_over_the_scan_angle_needs_overlap(dim_edges):
    done = call("calibrate", dim_edges / "a.las", "--targets", dim_edges / "t.csv", "-o", dim_edges / "none.toml",
                "--scan-angle")  # fmt: skip
    assert done.exit_code == 1 and "the overlaps do not show it at the edge of the swath" in done.stderr
