"""Forest metrics of cells from voxels, against forests of discs whose leaf area is known."""

import json
import re
from dataclasses import replace

import laspy
import numpy as np
import pytest
from commands import refuses, run_command, succeed
from forest_scenes import fly, grow
from strips import voxel_job

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse
from wavebatch.kernels.physics.gap_probability import measure_attenuation
from wavebatch.surveying import Survey
from wavebatch.surveying.sensor import SensorRequest
from wavebatch.surveying.systems.survey_result import SavedSurvey, format_survey
from wavebatch.tools.raster import COLUMNS, Forest, ForestOptions, GridOptions, write_grid
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.voxels.rays import Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions, voxelize_strip

SAVED = SavedSurvey(Survey(SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, baseline_spread=0.1, std=0.58)), 1000))
SIDE, CELL = 20.0, 10.0
QUICK = Deconvolution(iterations=2)
"""Where light itself is not looked at."""


def voxelize(strip, target, ratio=None):
    options = VoxelOptions(1.0, forest=True, reflectance_ratio=ratio)
    voxelize_strip(voxel_job(strip, system=SAVED, force=True), target, options, overwrite=True)
    return target


def measure(voxels, folder, size=CELL, box=(0.0, 0.0, SIDE, SIDE), in_memory=2_000_000, **options):
    """The result, and each band by its name, rows from the north."""
    rasterio = pytest.importorskip("rasterio", reason="rasterio (extra gis) is not installed")
    paths = voxels if isinstance(voxels, list) else [voxels]
    how = GridOptions(size=size, bbox=box, no_data=np.nan, forest=ForestOptions(**options))
    result = write_grid(paths, folder / "f.tif", how, overwrite=True, in_memory=in_memory)
    with rasterio.open(folder / "f.tif") as file:
        assert set(file.dtypes) == {"float32"} and file.tags()["LEAF_PROJECTION"] == f"{how.forest.leaf_projection:g}"
        return result, dict(zip(file.descriptions, file.read().astype(float), strict=True))


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    """Leaves, and voxels of a strip over a layer of them from 4 to 14 m."""
    folder, rng = tmp_path_factory.mktemp("even"), np.random.default_rng(1)
    leaves = grow(rng, SIDE, crowns=None, density=0.3)
    fly(folder / "s.las", rng, leaves, SIDE, pulses=4.0)
    return leaves, voxelize(folder / "s.las", folder / "v.laz")


def test_an_even_layer_of_leaves_is_measured_within_its_error(even, tmp_path):
    leaves, voxels = even
    result, found = measure(voxels, tmp_path)
    true = np.array([[leaves.area_index(x, y, CELL) for x in (0, 10)] for y in (10, 0)])
    index, error = found["leaf_area_index"], found["leaf_area_index_err"]
    assert (np.abs(index - true) < 2 * error).all() and (error < 0.06 * true).all()
    # The light of an even layer falls off as exp(-G times the leaf area above): half of 1 - exp(-1.5) is caught below.
    assert np.abs(found["cover"] - (1 - np.exp(-0.5 * true))).max() < 2 * found["cover_err"].max() < 0.06
    for part in (25, 50, 75, 95):
        gone = (1 - 0.01 * part) * (1 - np.exp(-0.5 * true))
        height = 14.0 + np.log(1 - gone) / (0.5 * 0.3)
        assert np.abs(found[f"light_height_{part}"] - height).max() < 0.5  # half a voxel
    density = [found[f"leaf_area_density {low}-{low + 5} m"].mean() for low in (0, 5, 10, 15)]
    np.testing.assert_allclose(density, [0.06, 0.3, 0.24, 0.0], atol=0.04)
    assert result.reasons == (4, 0, 0) and (found["no_data_reason"] == 0).all()


@pytest.mark.quick_cases("None")
@pytest.mark.parametrize("ratio", [None, 2.0])
def test_light_that_noise_hides_is_in_the_errors(tmp_path, ratio):
    """Ground below leaves is 2 to 3 noises high: 4 % more cover and a sixth more leaves, with errors of 1 and 5 %."""
    rng = np.random.default_rng(3)
    leaves = grow(rng, SIDE, crowns=None, density=0.3)
    fly(tmp_path / "s.las", rng, leaves, SIDE, pulses=5.0, light=30.0)
    _, found = measure(voxelize(tmp_path / "s.las", tmp_path / "v.laz", ratio=ratio), tmp_path)
    true = np.array([[leaves.area_index(x, y, CELL) for x in (0, 10)] for y in (10, 0)])
    for name, right in (("leaf_area_index", true), ("cover", 1 - np.exp(-0.5 * true))):
        off = np.abs(found[name] - right) / found[f"{name}_err"]
        assert 0.3 < np.median(off) < 1.9, name


@pytest.mark.parametrize(("slope", "height", "divergence", "named"), [
    (0.84, 0.5, None, True), (0.84, 0.9, None, False), (0.4, 0.5, None, False), (0.84, 0.5, 1.0, True),
    (0.84, 0.5, 0.3, False),
])  # fmt: skip
def test_ground_that_slopes_within_footprints_is_named(tmp_path, slope, height, divergence, named):
    """On 40 degrees, ground in footprints of 1 m was .07 of the cover, with an error of .01, and a third of leaves."""
    rng = np.random.default_rng(4)
    fly(tmp_path / "s.las", rng, grow(rng, 8.0, crowns=None, density=0.2, slope=slope), 8.0, pulses=2.0, footprint=1.0)
    survey = replace(SAVED.survey, system=SAVED.survey.system.with_radiometry(divergence=divergence))
    sensor = SensorRequest(height=1000.0)
    options = VoxelOptions(1.0, QUICK, forest=True, ground_height=height)
    saved = replace(SAVED, survey=survey)
    job = voxel_job(tmp_path / "s.las", system=saved, sensor=sensor, force=True)
    summary = voxelize_strip(job, tmp_path / "v.laz", options)
    lines = [line for line in summary.warnings if "ground in footprints of" in line]
    assert len(lines) == named
    if named:
        assert "footprints of 1 m" in lines[0]
        assert re.match("on slopes of 4[01] degrees", lines[0]) and lines[0].endswith("give --ground-height 0.9")
        assert ("assumed" in lines[0]) == (divergence is None)


def test_roofs_are_no_slopes_of_the_ground(tmp_path):
    """Roofs that fill cells of the map are the lowest returns there: a level village had slopes of 32 degrees."""
    simulate_strip("village", tmp_path / "s.las", pulses=4000)
    summary = voxelize_strip(voxel_job(tmp_path / "s.las"), tmp_path / "v.laz", VoxelOptions(1.0, QUICK, forest=True))
    assert summary.voxels and not [line for line in summary.warnings if "slopes" in line]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["hillside", "packets"])
def test_crowns_on_hillsides_and_in_several_packets_are_within_the_error(tmp_path, how):
    """Trees leave gaps that voxels do not resolve, and hide leaves: the error says what that may hide."""
    rng = np.random.default_rng(2)
    leaves = grow(rng, SIDE, crowns=0.04, density=0.7, slope=0.4 if how == "hillside" else 0.0)
    fly(tmp_path / "s.las", rng, leaves, SIDE, angle=12.0, split=how == "packets")
    _, found = measure(voxelize(tmp_path / "s.las", tmp_path / "v.laz"), tmp_path)
    true = np.array([[leaves.area_index(x, y, CELL) for x in (0, 10)] for y in (10, 0)])
    off = np.abs(found["leaf_area_index"] - true)
    assert (off < 2 * found["leaf_area_index_err"]).all() and (found["leaf_area_index_err"] < 0.35 * true + 0.1).all()
    assert np.abs(off / true).mean() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("footprint", [1.5, 2.0])
def test_gaps_that_wide_footprints_hide_are_in_the_error(tmp_path, footprint):
    """Leaf areas of crowns were 10 and 19 % too small, with errors of 12 and 9 %, which shrank as footprints grew."""
    rng = np.random.default_rng(8)
    leaves = grow(rng, SIDE, crowns=0.04, density=0.7)
    fly(tmp_path / "s.las", rng, leaves, SIDE, pulses=6.0, footprint=footprint)
    system = SAVED.survey.system.with_radiometry(divergence=footprint)
    saved = replace(SAVED, survey=replace(SAVED.survey, system=system))
    options, sensor = VoxelOptions(1.0, forest=True), SensorRequest(height=1000.0)
    job = voxel_job(tmp_path / "s.las", system=saved, sensor=sensor, force=True)
    voxelize_strip(job, tmp_path / "v.laz", options)
    _, found = measure(tmp_path / "v.laz", tmp_path)
    true = np.array([[leaves.area_index(x, y, CELL) for x in (0, 10)] for y in (10, 0)])
    off, error = found["leaf_area_index"] - true, found["leaf_area_index_err"]
    assert np.mean(np.abs(off) < error) >= 0.75 and np.abs(np.mean(off / true)) < 0.09 * footprint
    assert (error > 0.08 * true).all() and (error < 0.4 * true).all()


@pytest.mark.parametrize(("footprint", "named"), [(None, "of unknown width"), (1.0, None), (3.0, "of 3 m")])
def test_footprints_that_show_no_gaps_are_named_and_kept_with_the_voxels(tmp_path, forest_strip, footprint, named):
    system = SAVED.survey.system.with_radiometry(divergence=footprint)
    saved = replace(SAVED, survey=replace(SAVED.survey, system=system))
    target, sensor, options = tmp_path / "v.laz", SensorRequest(height=1000.0), VoxelOptions(1.0, QUICK, forest=True)
    done = voxelize_strip(voxel_job(forest_strip, system=saved, sensor=sensor, force=True), target, options)
    lines = [line for line in done.warnings if line.startswith("leaf areas:")]
    assert len(lines) == bool(named) and (not named or f"footprints {named} " in lines[0])
    found = Forest([target], 10.0, ForestOptions())
    assert (found.block, round(found.reach, 2)) == {None: (2, 1.0), 1.0: (3, 0.81), 3.0: (6, 0.89)}[footprint]


def test_voxels_that_laspy_writes_again_keep_what_is_not_known(tmp_path):
    """laspy drops the declarations of no-data: a leaf area of 1.1 was 0 +- 6969, in layers up to 150 m."""
    simulate_strip("forest", tmp_path / "s.las", pulses=3000)
    voxelize_strip(voxel_job(tmp_path / "s.las"), tmp_path / "v.laz", VoxelOptions(1.0, QUICK, forest=True))
    voxels = laspy.read(tmp_path / "v.laz")
    assert (voxels["attenuation"] == -9999).any()
    voxels.add_extra_dim(laspy.ExtraBytesParams("mine", np.float32))
    voxels.write(tmp_path / "again.laz")
    (_, right), (_, found) = (measure(tmp_path / name, tmp_path, box=None) for name in ("v.laz", "again.laz"))
    assert list(found) == list(right)
    for name, band in right.items():
        np.testing.assert_array_equal(found[name], band)


def test_leaves_that_show_more_of_themselves_are_fewer(even, tmp_path):
    _, spherical = measure(even[1], tmp_path)
    _, level = measure(even[1], tmp_path, leaf_projection=1.0, layer=10.0)
    np.testing.assert_allclose(level["leaf_area_index"], 0.5 * spherical["leaf_area_index"], rtol=1e-5)
    whole = 10 * sum(band for name, band in level.items() if name.startswith("leaf_area_density "))
    np.testing.assert_allclose(whole, level["leaf_area_index"], rtol=1e-5)


def test_cells_do_not_depend_on_memory_and_twice_the_same_voxels_are_the_same(even, tmp_path):
    _, once = measure(even[1], tmp_path)
    _, twice = measure([even[1], even[1]], tmp_path)
    _, parts = measure(even[1], tmp_path, in_memory=3000)
    for name, band in once.items():
        np.testing.assert_array_equal(parts[name], band)
        if "err" not in name:
            np.testing.assert_allclose(twice[name], band, rtol=0.02, atol=0.02)


def test_cells_that_show_too_little_have_no_data_and_a_reason(tmp_path):
    rng = np.random.default_rng(3)
    leaves = grow(rng, 8.0, crowns=None, density=1.0)
    fly(tmp_path / "s.las", rng, leaves, 8.0, pulses=2.0, rays=10)
    voxels = voxelize(tmp_path / "s.las", tmp_path / "v.laz", ratio=2.0)
    result, found = measure(voxels, tmp_path, size=4.0, box=(0.0, 0.0, 8.0, 8.0))
    assert (found["no_data_reason"] == 2).all() and result.reasons == (0, 0, 4)
    assert all(np.isnan(band).all() for name, band in found.items() if name != "no_data_reason")
    few = fly(tmp_path / "few.las", rng, grow(rng, SIDE, crowns=None, density=0.1), SIDE, pulses=0.15)
    result, found = measure(voxelize(few, tmp_path / "w.laz"), tmp_path, size=5.0)
    assert result.reasons[1] > 8 and np.nanmax(found["no_data_reason"]) >= 1


def test_attenuation_of_few_rays_has_no_bias_and_its_error_is_right():
    """Rays through leaves at random, until they hit or leave a voxel of 1 m: hits over path alone are 12 % too many."""
    rng = np.random.default_rng(4)
    for rays, rate in ((4, 0.7), (10, 0.3), (10, 1.5)):
        way = rng.exponential(1.0 / rate, (40_000, rays))
        hit, free = (way < 1.0).mean(axis=1), np.minimum(way, 1.0).mean(axis=1)
        found, error = measure_attenuation(hit, np.full(len(hit), float(rays)), free)
        assert abs(found.mean() / rate - 1) < 0.03 < (hit / free).mean() / rate - 1
        assert np.sqrt((error**2).mean()) == pytest.approx(found.std(), rel=0.35)
    none = measure_attenuation(np.array([0.5, 0.5]), np.array([1.9, 5.0]), np.array([0.5, 0.0]))
    assert np.isnan(none).all()


def test_voxels_have_what_forests_need(even, tmp_path):
    voxels = laspy.read(even[1])
    names = list(voxels.point_format.extra_dimension_names)
    assert names[-5:] == ["height", "ground", "free_path", "attenuation", "attenuation_error"]
    assert set(COLUMNS[2:]) <= set(names)
    inside = (voxels["height"] > 5) & (voxels["height"] < 13) & (voxels["attenuation"] >= 0)
    assert np.mean(voxels["attenuation"][inside]) == pytest.approx(0.15, rel=0.1)
    np.testing.assert_allclose(voxels["height"], voxels.z - 100.0, atol=0.1)
    assert (voxels["free_path"] <= voxels["path"] * (1 + 1e-6)).all()
    shown = run_command("info", even[1]).output
    assert "command           wavebatch voxelize s.las --size 1 --forest" in shown and "{" not in shown


def test_other_clouds_sizes_and_cells_are_refused(even, tmp_path, forest_strip):
    plain = tmp_path / "plain.laz"
    voxelize_strip(voxel_job(forest_strip, system=SAVED, force=True), plain, VoxelOptions(1.0, QUICK))
    refuses(ConfigError, "--forest needs voxels: wavebatch voxelize", Forest, [plain], 10.0, ForestOptions())
    for options, words in (
        (VoxelOptions(2.0, QUICK, forest=True), "has other voxels than .*, of --size 1"),
        (VoxelOptions(1.0, QUICK, forest=True, ground_height=0.9), "of --ground-height 0.5; give one"),
    ):
        voxelize_strip(voxel_job(forest_strip, system=SAVED, force=True), plain, options, overwrite=True)
        refuses(ConfigError, words, Forest, [even[1], plain], 10.0, ForestOptions())
    refuses(ConfigError, "cells need 4 voxels along a side; give 4 or more", Forest, [even[1]], 3.0, ForestOptions())
    with pytest.raises(ConfigError, match="layers are thinner than the voxels, .*; give 1 or more"):
        Forest([even[1]], 10.0, ForestOptions(layer=0.5))
    for wrong in ({"leaf_projection": 0.0}, {"layer": 0.0}, {"layer": np.nan}):
        refuses(ConfigError, "", ForestOptions, **wrong)


@pytest.fixture
def forest_strip(tmp_path):
    rng = np.random.default_rng(5)
    return fly(tmp_path / "p.las", rng, grow(rng, 4.0, crowns=None, density=0.1), 4.0, pulses=1.0)


@pytest.mark.slow
def test_strips_of_a_forest_become_one_raster_with_two_commands(tmp_path):
    """Each strip sees half of the plot; voxels in a folder are clouds, which grid reads as one."""
    rng = np.random.default_rng(7)
    leaves = grow(rng, SIDE, crowns=None, density=0.3)
    strips = [fly(tmp_path / f"{name}.las", rng, leaves, SIDE, pulses=1.5) for name in "ab"]
    (tmp_path / "system.toml").write_text(format_survey(SAVED))
    made = ["voxelize", *strips, "--size", 1, "--forest", "--system", tmp_path / "system.toml", "--force", "-o",
            tmp_path / "v"]  # fmt: skip
    for words in (made, ["grid", tmp_path / "v", "--forest", "--size", CELL, "-o", tmp_path / "f.tif"]):
        succeed(*words)
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == ["a.laz", "b.laz"]
    both = [tmp_path / "v" / f"{name}.laz" for name in "ab"]
    _, found = measure(both, tmp_path)
    one = measure(both[:1], tmp_path)[1]
    true = np.array([[leaves.area_index(x, y, CELL) for x in (0, 10)] for y in (10, 0)])
    assert (np.abs(found["leaf_area_index"] - true) < 2 * found["leaf_area_index_err"]).all()
    assert found["leaf_area_index_err"].mean() < one["leaf_area_index_err"].mean()


def test_the_command_says_what_it_wrote(even, tmp_path):
    arguments = ["grid", even[1], "--forest", "--size", 10, "--bbox", "0,0,20,20", "-o", tmp_path / "f.tif"]
    assert "2 x 2 cells of 10 m: 4 with metrics, 0 with fewer" in succeed(*arguments).output


@pytest.mark.parametrize(("option", "words"), [
    (["--where", "height > 3"], "metrics need all voxels of a cell"),
    (["--crs", "EPSG:4326"], "coordinates are in degree"),
])  # fmt: skip
def test_parts_of_the_voxels_and_degrees_are_refused(even, tmp_path, option, words):
    """Of voxels above 3 m all cells became no-data, of those below the ground cells had metrics; both in silence."""
    arguments = ["grid", str(even[1]), "--forest", "--size", "10", *option, "-o", str(tmp_path / "f.tif")]
    result = run_command(*arguments)
    assert result.exit_code == 2 and words in result.output and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("facts", [
    {}, {"size_m": "1", "reflectance_ratio": {"ratio": 1.0}}, {"size_m": 1.0, "reflectance_ratio": None},
    {"size_m": 1.0, "reflectance_ratio": {"ratio": 0.0}},
])  # fmt: skip
def test_a_damaged_record_of_voxels_is_one_line(even, tmp_path, facts):
    voxels = laspy.read(even[1])
    (record,) = [vlr for vlr in voxels.vlrs if vlr.user_id == "wavebatch" and vlr.record_id == 1]
    record.record_data = json.dumps({"forest": True} | facts).encode()
    voxels.write(tmp_path / "v.laz")
    refuses(ConfigError, "its record of voxels is damaged", Forest, [tmp_path / "v.laz"], 10.0, ForestOptions())
