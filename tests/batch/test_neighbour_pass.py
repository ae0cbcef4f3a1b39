"""The second pass: the same bytes for any tiles, jobs, blocks and deaths; known surfaces; bounded memory."""

import json
import signal
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from commands import run_command
from strips import descriptor, make_raw, take_turns, vlr

from wavebatch.batch.counts import RunReport
from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.neighbour_pass import ENTRY, SecondPass, process_tile
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.kernels.geometry.normals import Gap
from wavebatch.stages.chain import STAGES, Stage, Step, parse_chain
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.render import START_TIME, FlightLine, trace_rays

STAGE = "attribute.incidence_angle_normals"
COLUMNS = ["incidence_angle_normals", "incidence_angle_normals_err"]
STAGES_OF_CHAIN = ("noise.pooled", "detect.maximum", "decompose.gaussian", "attribute.position")
CHAIN = "".join(f'[[chain]]\nstage = "{name}"\n' for name in (*STAGES_OF_CHAIN, STAGE)) + "radius = 2.5\n"


@pytest.fixture(scope="module")
def strips(tmp_path_factory, edit_points):
    """A slope, whose pulses have one of two digitizers in turn, and a town of known surfaces, and the chain."""
    folder = tmp_path_factory.mktemp("strips")
    (folder / "chain.toml").write_text(CHAIN)
    for scene in ("slope", "urban"):
        simulate_strip(scene, folder / f"{scene}.las", pulses=12_000, seed=5)
    take_turns(folder / "slope.las", edit_points)
    return folder


def run_strip(path, folder, *, columns=None, chain=None, batch=None, known=None, **options):
    chain = chain or parse_chain(CHAIN, "test")
    job = StripJob(Path(path), chain, RunOptions(**options), choose_columns(chain, columns), **known or {})
    outcome = run_batch([job], RunOptions(Path(folder), **(batch or {}))).outcomes[0]
    assert outcome.error is None, outcome.error
    return outcome.report


@pytest.fixture(scope="module")
def clouds(strips, tmp_path_factory):
    folder = tmp_path_factory.mktemp("clouds")
    return folder, {scene: run_strip(strips / f"{scene}.las", folder) for scene in ("slope", "urban")}


@pytest.mark.parametrize(("scene", "terrain"), [("slope", "facets"), ("urban", "blocks")])
def test_angles_of_known_surfaces(clouds, scene, terrain):
    folder, reports = clouds
    cloud = laspy.read(folder / f"{scene}.laz")
    line = FlightLine()
    rays = trace_rays(line, terrain, np.rint((np.asarray(cloud.gps_time) - START_TIME) * line.pulse_rate))
    angle, error = (np.asarray(cloud[name], np.float64) for name in COLUMNS)
    known = angle != -9999
    np.testing.assert_array_equal(known, error != -9999)
    off = (angle - np.degrees(rays.incidence))[known]
    assert known.mean() > 0.7
    assert np.median(np.abs(off)) < 0.02
    assert abs(np.median(off)) < 0.01
    assert (np.abs(off) <= error[known]).mean() > 0.68
    assert (np.abs(off) > 5).mean() < 0.004
    passed = (np.asarray(cloud["echo_flags"]) & 1792) != 0
    assert passed.any() and not known[passed].any()
    counts = reports[scene].no_data["incidence_angle_normals"]
    assert counts["KNOWN"] == known.sum() and sum(counts.values()) == reports[scene].count("echoes")
    assert counts["NO_PLANE"] > 0 and "NO_RAY" not in counts


@pytest.mark.slow
def test_plants_are_no_surface(tmp_path):
    simulate_strip("forest", tmp_path / "s.las", pulses=16_000, seed=2)
    run_strip(tmp_path / "s.las", tmp_path / "out")
    cloud = laspy.read(tmp_path / "out" / "s.laz")
    line = FlightLine()
    rays = trace_rays(line, "hills", np.rint((np.asarray(cloud.gps_time) - START_TIME) * line.pulse_rate))
    above = np.linalg.norm(np.asarray(cloud.xyz) - rays.ground, axis=1)
    known = np.asarray(cloud[COLUMNS[0]]) != -9999
    assert known[above < 0.2].mean() > 0.4
    assert known[above > 1.0].mean() < 0.005


@pytest.mark.quick_cases("batch1")
@pytest.mark.parametrize("batch", [{"jobs": 2}, {"block_size": 700}])
def test_the_same_bytes_for_any_jobs_and_blocks(strips, clouds, tmp_path, batch):
    run_strip(strips / "urban.las", tmp_path, batch=batch)
    assert (tmp_path / "urban.laz").read_bytes() == (clouds[0] / "urban.laz").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def energy(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Twice the angle."""
    assert block.samples.shape == (len(block), 0) or np.isnan(echoes.attributes[COLUMNS[0]]).all()
    return echoes.with_attributes(energy=2 * echoes.attributes[COLUMNS[0]])


@pytest.mark.parametrize("points", ["echoes", "returns"])
def test_stages_after_it_see_its_columns_whatever_the_units(strips, clouds, tmp_path, points):
    """They are ordinary stages, and their columns decide what is written."""
    after = Stage("attribute.energy", "attribute", energy, {}, ("energy",), (COLUMNS[0],))
    chain = parse_chain(CHAIN, "test")
    chain = replace(chain, steps=(*chain.steps, Step(after)))
    known = {"selection": PointFilter.build(where="energy < 40 and z > 0"), "unit_points": 3000}
    report = run_strip(strips / "slope.las", tmp_path, chain=chain, known=known, points=points)
    cloud = laspy.read(tmp_path / "slope.laz")
    angle = np.asarray(cloud[COLUMNS[0]])
    assert len(cloud) > 2000 and (angle < 20).all()
    np.testing.assert_array_equal(cloud["energy"], 2 * angle)
    if points == "echoes":
        assert report.no_data[COLUMNS[0]]["KNOWN"] == clouds[1]["slope"].no_data[COLUMNS[0]]["KNOWN"]
        whole = np.asarray(laspy.read(clouds[0] / "slope.laz")[COLUMNS[0]])
        np.testing.assert_array_equal(angle, whole[(whole != -9999) & (whole < 20)])


def test_without_its_columns_there_is_no_second_pass(strips, tmp_path):
    report = run_strip(strips / "slope.las", tmp_path, columns="echo_flags")
    assert not report.no_data and not {"tiles", f"{STAGE}, second pass"} & report.timing.keys()
    assert COLUMNS[0] not in laspy.read(tmp_path / "slope.laz").point_format.dimension_names


_DIE = """
import os, sys
from wavebatch.batch import neighbour_pass
def die(*arguments):
    os.kill(os.getpid(), 9)
neighbour_pass.SecondPass.{method} = die
from wavebatch.cli import main
main(sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
@pytest.mark.parametrize("method", ["take", pytest.param("next_call", marks=pytest.mark.slow)])
def test_killed_in_the_second_pass_resume_gives_what_an_undisturbed_run_gives(strips, clouds, tmp_path, method):
    arguments = ["run", str(strips / "slope.las"), "-o", str(tmp_path), "-c", str(strips / "chain.toml"), "-q"]
    done = subprocess.run([sys.executable, "-c", _DIE.format(method=method), *arguments], capture_output=True)
    assert done.returncode == -signal.SIGKILL
    assert not list(tmp_path.glob("*.laz")) and list(tmp_path.glob(".wavebatch-*.tmp"))
    assert run_command(*arguments, "--resume").exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["slope.laz", "slope.report.json"]
    cloud, undisturbed = (laspy.read(folder / "slope.laz").points.array for folder in (tmp_path, clouds[0]))
    assert cloud.tobytes() == undisturbed.tobytes()
    assert json.loads((tmp_path / "slope.report.json").read_text())["counts"]["no_data"][COLUMNS[0]]["KNOWN"] > 0


def test_a_failure_in_the_second_pass_leaves_nothing(strips, tmp_path, monkeypatch):
    def fail(*arguments):
        raise ConfigError("no")

    monkeypatch.setattr(SecondPass, "take", fail)
    chain = parse_chain(CHAIN, "test")
    job = StripJob(strips / "slope.las", chain, columns=choose_columns(chain))
    assert run_batch([job], RunOptions(tmp_path)).failed == 1
    assert not list(tmp_path.iterdir())


SCALES = (0.001, 0.001, 0.001)


def make_rows(xyz, ray=(0, 0.1, -1)):
    entries = np.zeros(len(xyz), ENTRY)
    entries["xyz"] = np.rint(np.asarray(xyz, float).reshape(-1, 3) / SCALES)
    entries["ray"] = ray
    return entries


def fill(parts, folder, **options):
    """Values and gaps of all rows after a second pass."""
    second = SecondPass(Step(STAGES[STAGE]), SCALES, folder / "cloud.laz", **options)
    try:
        for rows in parts:
            second.add(rows, np.zeros(3, np.uint8))
        return take_all(second, sum(map(len, parts)))
    finally:
        second.close()
        assert not list(folder.iterdir())


def take_all(second, number):
    """The values of `number` rows, in the order of the units."""
    second.cut()
    found, units = [], 0
    while second.has_more:
        function, arguments = second.next_call(b"")
        if function is process_tile:
            assert isinstance(second.take(function(*arguments)), RunReport)
        else:
            found.append(arguments[2])
            second.take((None, None))
            units += 1
    assert second.is_complete and sum(map(len, found)) == number
    return np.concatenate(found)


def test_no_rows_one_row_and_rows_without_a_ray(tmp_path):
    for count in (0, 1):
        found = fill([make_rows(np.zeros((count, 3)))], tmp_path)
        assert (found["gap"] == Gap.FEW_NEIGHBOURS).all() and len(found) == count
    flat = np.random.default_rng(1).uniform(0, 8, (500, 3)) * [1, 1, 0]
    for ray in ((0, 0, 0), (np.nan, 0, 0)):
        assert (fill([make_rows(flat, ray)], tmp_path)["gap"] == Gap.NO_RAY).all()


@pytest.mark.parametrize("seed", range(2))
def test_any_tiles_give_the_same_bits_on_any_points(tmp_path, seed):
    rng = np.random.default_rng(seed)
    spread = rng.uniform(0, 60, (2500, 3)) * [1, 1, 0.001]
    dense = rng.uniform(20, 22, (2500, 3)) * [1, 1, 0.001]
    grid = np.stack(np.meshgrid(np.arange(0, 20, 0.5), np.arange(0, 20, 0.5), [0.0]), -1).reshape(-1, 3) + [80, 0, 0]
    xyz = np.concatenate([spread, dense, grid, np.tile([[5, 5, 0]], (600, 1)), [[2e6, -2e6, 0], [0, 0, 1000]]])
    rows = make_rows(rng.permutation(xyz))
    whole = fill([rows], tmp_path, tile_points=10**9)
    assert np.count_nonzero(whole["gap"] == Gap.KNOWN) > 4000
    again = fill(np.array_split(rows, 7), tmp_path, tile_points=200, part_points=300, sample=1000)
    assert again.tobytes() == whole.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("place", ["one place", "a long strip"])
def test_memory_does_not_grow_with_the_points(tmp_path, place):
    peaks = []
    sizes = {"tile_points": 10_000, "sample": 4000, "part_points": 20_000, "spooled": 1 << 20}
    for n in (60_000, 240_000):
        rng = np.random.default_rng(3)
        second = SecondPass(Step(STAGES[STAGE]), SCALES, tmp_path / "cloud.laz", **sizes)
        for start in range(0, n, 20_000):
            xyz = rng.normal(0, 0.05, (20_000, 3))
            if place == "a long strip":
                xyz = rng.uniform(0, 100, (20_000, 3)) * [1, 1, 0.001] + [start / 200, 0, 0]
            second.add(make_rows(xyz), np.zeros(3, np.uint8))
        tracemalloc.start()
        take_all(second, n)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        second.close()
    assert peaks[1] < 1.3 * peaks[0]
    assert peaks[0] < 150e6


def test_strips_that_are_not_in_metres_are_refused(tmp_path):
    raw = make_raw(60)
    raw.vlrs = [descriptor(1), vlr(b"LASF_Projection", 34735, np.array([1, 1, 0, 1, 1024, 0, 1, 2], "<u2").tobytes())]
    raw.write(tmp_path / "s.las")
    chain = parse_chain(CHAIN, "test")
    job = StripJob(tmp_path / "s.las", chain, columns=choose_columns(chain))
    error = run_batch([job], RunOptions(tmp_path / "out")).outcomes[0].error
    assert "coordinates are degrees" in str(error) and "project the strip to metres" in str(error)
