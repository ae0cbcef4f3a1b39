"""`compare --angles`: the figures against NumPy on whole columns, one cloud or two, and what is refused."""

import json

import laspy
import numpy as np
import pytest
from click.testing import CliRunner

from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.cli import main
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk import buckets
from wavebatch.stages.chain_file import parse_chain
from wavebatch.surveying.sensor import SensorRequest
from wavebatch.tools.compare.angles import compare_angles
from wavebatch.tools.simulate import simulate_strip

NAMES = ("incidence_angle", "incidence_angle_normals")
CHAIN = "".join(
    f'[[chain]]\nstage = "{name}"\n'
    for name in ("noise.pooled", "detect.maximum", "decompose.adaptive", "attribute.position",
                 "attribute.incidence_angle", "attribute.incidence_angle_normals")
).replace('incidence_angle"\n', 'incidence_angle"\ndivergence = 1.1\n') + "radius = 2.5\n"  # fmt: skip


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """One cloud with both angles, and one with each, of a village; whose echoes tell angles by their width."""
    folder = tmp_path_factory.mktemp("village")
    simulate_strip("village", folder / "village.las", pulses=6000, seed=4)
    chain = parse_chain(CHAIN, "test")
    for name, columns in (("both", "+echo_flags"), ("widths", ",".join([NAMES[0], f"{NAMES[0]}_err"])),
                          ("normals", ",".join([NAMES[1], f"{NAMES[1]}_err"]))):  # fmt: skip
        options, written = RunOptions(format="las"), choose_columns(chain, columns)
        job = StripJob(folder / "village.las", chain, options, written, sensor=SensorRequest(height=640.0))
        outcome = run_batch([job], RunOptions(folder / name)).outcomes[0]
        assert outcome.error is None, outcome.error
    return {name: folder / name / "village.las" for name in ("both", "widths", "normals")}


@pytest.fixture(scope="module")
def columns(clouds):
    cloud = laspy.read(clouds["both"])
    values = [np.asarray(cloud[f"{name}{tail}"], np.float64) for name in NAMES for tail in ("", "_err")]
    return [np.where(column == -9999, np.nan, column) for column in values]


def test_one_cloud(clouds, columns):
    a, a_err, b, b_err = columns
    off = (a - b)[~np.isnan(a - b)]
    found = compare_angles(clouds["both"])
    assert found.points == len(a) and found.number == len(off) > 3000
    assert found.with_widths == np.isfinite(a).sum() and found.with_normals == np.isfinite(b).sum()
    assert found.bias == pytest.approx(off.mean(), abs=1e-9)
    assert found.mae == pytest.approx(np.abs(off).mean(), abs=1e-9)
    assert found.rms == pytest.approx(np.sqrt((off**2).mean()), abs=1e-9)
    assert found.median_absolute == pytest.approx(np.median(np.abs(off)), abs=0.0011)
    both = np.hypot(a_err, b_err)[~np.isnan(a - b)]
    assert found.within_error == pytest.approx((np.abs(off) <= both).mean())
    known = ~np.isnan(a - b)
    np.testing.assert_array_equal(found.histogram_widths, np.histogram(a[known], found.edges)[0])
    np.testing.assert_array_equal(found.histogram_normals, np.histogram(b[known], found.edges)[0])
    np.testing.assert_array_equal(found.histogram_difference, np.histogram(off, found.difference_edges)[0])


def test_angles_of_a_simulated_village_agree(clouds):
    found = compare_angles(clouds["both"])
    assert abs(found.bias) < 2.0
    assert found.mae < 2.5 and found.median_absolute < 2.0
    assert 0.4 < found.within_error < 0.85


@pytest.mark.parametrize("order", [("widths", "normals"), ("normals", "widths")])
@pytest.mark.parametrize("points", [400_000, 3000])
def test_two_clouds_are_matched(clouds, monkeypatch, order, points):
    monkeypatch.setattr(buckets, "BUCKET_ROWS", points)
    whole, found = compare_angles(clouds["both"]), compare_angles(*(clouds[name] for name in order))
    assert found.points == whole.points and found.number == whole.number
    for name in ("bias", "mae", "rms"):
        assert getattr(found, name) == pytest.approx(getattr(whole, name), rel=1e-9)
    assert found.median_absolute == whole.median_absolute
    assert found.histogram_difference == whole.histogram_difference


def test_what_is_missing_is_said(clouds, tiny_strip):
    with pytest.raises(InputError, match="has no column incidence_angle_normals; run the strip with stage attribute"):
        compare_angles(clouds["widths"])
    with pytest.raises(InputError, match="tiny.las: has no column incidence_angle"):
        compare_angles(clouds["both"], tiny_strip)
    with pytest.raises(ConfigError, match="tolerance 0 ns"):
        compare_angles(clouds["both"], tolerance_ns=0)


def run(*arguments):
    return CliRunner().invoke(main, ["compare", *map(str, arguments)])


def test_text_and_json(clouds):
    done = run(clouds["both"], "--angles")
    assert done.exit_code == 0, done.output
    for word in ("bias", "MAE", "median abs", "within errors", "from width", "from normals", "width less normals"):
        assert word in done.stdout
    found = compare_angles(clouds["both"])
    assert f"{found.mae:.3f}" in done.stdout and "####" in done.stdout
    told = json.loads(run(clouds["widths"], clouds["normals"], "--angles", "--json").stdout)
    assert told["number"] == found.number and sum(told["histogram_difference"]) == found.number


def test_no_point_with_both(clouds, tmp_path):
    cloud = laspy.read(clouds["both"])
    cloud[NAMES[0]][:] = -9999
    cloud.write(tmp_path / "c.las")
    done = run(tmp_path / "c.las", "--angles")
    assert done.exit_code == 0 and "no point has both angles" in done.stdout
    told = json.loads(run(tmp_path / "c.las", "--angles", "--json").stdout)
    assert told["number"] == 0 and told["mae"] is None and told["median_absolute"] is None


@pytest.mark.parametrize("more", [("--truth", "t.npz"), ("--max-rmse", "1"), ("--strip", "s.las"), ("--limit", "5")])
def test_options_without_meaning_are_refused(clouds, more):
    done = run(clouds["both"], "--angles", *more)
    assert done.exit_code == 2 and f"{more[0]} has no meaning with --angles" in done.stderr
