"""Strips into voxels: energy, places, light, pulses of several packets, and the same bytes however it was cut."""

import json
import subprocess
import sys
import textwrap
from dataclasses import replace

import laspy
import numpy as np
import pytest
from commands import refuses
from packet_strips import LENGTHS, draw_canopy, record, render, write_recorded
from strips import voxel_job

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import HALF_C, SQRT_2PI
from wavebatch.core.waveforms import Digitizer, ReceiverNoise, SystemPulse
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.las.header import read_header
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.physics.radiometry import backscatter, compute_cross_section
from wavebatch.surveying import Survey, survey_block
from wavebatch.surveying.calibration import Calibration
from wavebatch.surveying.sensor import SensorRequest
from wavebatch.surveying.systems.survey_result import SavedSurvey
from wavebatch.tools.simulate import find_scene, simulate_strip
from wavebatch.tools.simulate.render import FlightLine, Recording, find_pulse
from wavebatch.tools.simulate.returns import fill_packets
from wavebatch.tools.simulate.scenes import simulate_block
from wavebatch.tools.simulate.strip import WKT, StripOptions
from wavebatch.tools.voxels import rays
from wavebatch.tools.voxels.grid import VoxelGrid
from wavebatch.tools.voxels.rays import Ceiling, Deconvolution, Floor, _pulse_taps, deconvolve_block
from wavebatch.tools.voxels.strip import VoxelOptions, _doubt_returns, voxelize_strip

SYSTEM = SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, baseline_spread=0.4, std=1.05))
SAVED = SavedSurvey(Survey(SYSTEM, 1000))
DOWN = np.array([0.0, 0.0, -HALF_C])
QUICK = Deconvolution(iterations=2)
"""Where it does not matter how sharp the light is."""


def write_strip(path, echoes, *, sigma=2.0, height=110.0, directions=None, xy=None, point_format=4, wkt=None, bits=8,
                noise=0.5, seed=1, returns=True):  # fmt: skip
    """A strip of pulses whose echoes are lists of (height [m], amplitude); sample 0 lies at `height` (n,)."""
    rng, s = np.random.default_rng(seed), 160
    n = len(echoes)
    height = np.broadcast_to(height, n)
    xy = np.stack([np.arange(n) * 0.3 + 0.1, np.full(n, 0.4)], axis=1) if xy is None else np.asarray(xy)
    directions = np.tile(DOWN, (n, 1)) if directions is None else np.asarray(directions)
    time = np.arange(s)
    signal = np.full((n, s), 12.0)
    points = []
    for row, pairs in enumerate(echoes):
        shift = rng.uniform(-0.5, 0.5) if returns else 0.0
        for number, (z, amplitude) in enumerate(pairs or [(100.0, 0.0)]):
            at = (z - height[row]) / directions[row, 2]
            signal[row] += amplitude * np.exp(-0.5 * ((time - at) / sigma) ** 2)
            points.append((row, number + 1, max(len(pairs), 1), at, at + shift))
    counts = np.clip(np.rint(signal + noise * rng.standard_normal(signal.shape)), 0, 2**bits - 1)
    version = "1.4" if point_format > 5 else "1.3"
    writer = FullwaveWriter(
        path, version=version, point_format=point_format, internal=True, digitizers=[Digitizer(1, bits, s, 1.0)],
        wkt=wkt,
    )  # fmt: skip
    with writer:
        offset = writer.write_packets(counts.astype(f"<u{bits // 8}"), 1)
        rows = np.zeros(len(points), writer.dtype)
        table = np.array(points)
        row = table[:, 0].astype(int)
        start = np.column_stack([xy, height])
        place = start[row] + directions[row] * table[:, 3:4]
        for axis, name in enumerate("XYZ"):
            rows[name] = np.rint(place[:, axis] / 0.001)
        shift = 4 if point_format > 5 else 3
        rows["bit_fields"] = table[:, 1].astype(int) | (table[:, 2].astype(int) << shift)
        rows["gps_time"] = 1000.0 + row * 1e-5
        fill_packets(rows, np.ones(len(row)), offset[row], s * bits // 8, table[:, 4], directions[row])
        writer.write_points(rows)
        writer.commit()
    return path


def load(path):
    with np.load(path) as file:
        return {name: file[name] for name in file}


def take_job(strip, options, saved):
    """The job of a strip with those of the options that are its own, which are taken out."""
    names = ("calibration", "sensor", "unit_points", "selection")
    known = {name: options.pop(name) for name in names if name in options}
    return voxel_job(strip, system=options.pop("system", saved), force=True, **known)


def voxelize(strip, target, size, *, headroom=None, all_crossed=False, deconvolution=None, ratio=None, **options):
    settings = VoxelOptions(size, deconvolution or Deconvolution(), headroom, all_crossed, reflectance_ratio=ratio)
    summary = voxelize_strip(take_job(strip, options, SAVED), target, settings, **options)
    return summary, load(target) if target.suffix == ".npz" else laspy.read(target)


def energy_near(xyz, found):
    """Energy of the voxels that hold one of these places or touch one that does."""
    index = np.floor((xyz - found["origin"]) / found["size"]).astype(int)
    near = {tuple(one + off) for one in index for off in np.ndindex(3, 3, 3)}
    return found["energy"][[tuple(one) in near for one in (found["index"] + 1).tolist()]].sum()


def sum_by_layer(found):
    """Energy by height of the layer's lower face."""
    z = found["origin"][2] + found["index"][:, 2] * found["size"]
    return {round(float(one), 6): float(found["energy"][z == one].sum()) for one in np.unique(z)}


@pytest.fixture(scope="module")
def forest(tmp_path_factory):
    """1500 pulses over a forest, and the truth."""
    folder = tmp_path_factory.mktemp("voxels")
    scene = replace(find_scene("forest"), flight=FlightLine(half_angle=3.0, pulse_rate=50_000.0))
    simulate_strip(scene, folder / "forest.las", pulses=1500, seed=8, truth=folder / "truth.npz")
    return folder / "forest.las", folder / "truth.npz"


@pytest.mark.parametrize(
    ("scene", "method", "seed", "least", "most"),
    [("flat", "richardson_lucy", 1, 0.997, 1.01), ("forest", "richardson_lucy", 2, 0.995, 1.01),
     ("flat", "gold", 4, 0.97, 1.06), ("flat", "wiener", 4, 0.97, 1.06)],
)  # fmt: skip
def test_energy_is_that_of_the_echoes(scene, method, seed, least, most):
    block, truth = simulate_block(scene, 3000, np.random.default_rng(seed))
    profiles = deconvolve_block(block, SYSTEM, Deconvolution(method))
    energy = profiles.value.sum() * profiles.area
    assert least < energy / np.sum(truth.amplitude * truth.sigma * SQRT_2PI) < most


@pytest.mark.quick_cases("1-leica")
@pytest.mark.parametrize("name", ["riegl", "leica"])
@pytest.mark.parametrize("seed", [1, 2])
def test_energy_of_learned_pulses_is_that_of_the_waveforms(name, seed):
    recording = Recording(n_samples=160, pulse=find_pulse(name), baseline_spread=0.0)
    block, truth = simulate_block("flat", 3000, np.random.default_rng(seed), recording=recording)
    system = survey_block(block).system
    assert len(system.components) > 1
    profiles = deconvolve_block(block, system, Deconvolution())
    energy = profiles.value.sum() * profiles.area
    assert energy == pytest.approx(float((block.samples - 12.0).sum()), rel=0.04)
    off = np.arange(160) - truth.time[:, None]
    near = profiles.value[truth.waveform][np.abs(off) < 3].sum()
    assert near > 0.97 * profiles.value.sum()


def test_a_learned_pulse_ends_where_nothing_was_measured():
    wide = replace(SYSTEM, sigma_ref=1.86, components=((1.0, 0.0, 1.83), (0.025, -0.3, 13.6), (0.03, 10.9, 1.2)))
    taps, area = _pulse_taps(wide, 1.0)
    lag = np.flatnonzero(taps) - len(taps) // 2
    assert lag.min() == -9 and lag.max() == 40 and taps.max() == pytest.approx(1.0, abs=0.01)
    assert area == pytest.approx(taps.sum())


def test_noise_is_no_signal():
    block, truth = simulate_block("empty", 6000, np.random.default_rng(5))
    empty = truth.count(len(block)) == 0
    seen = deconvolve_block(block, SYSTEM, Deconvolution()).seen
    assert seen[empty].mean() < 0.005 and seen[~empty].mean() > 0.98
    louder = deconvolve_block(block, SYSTEM, Deconvolution(), np.random.default_rng(5)).seen
    assert louder[empty].mean() < 0.005, "nor where noise is added"
    loose = deconvolve_block(block, SYSTEM, Deconvolution(threshold=1.0)).seen
    assert loose[empty].mean() > 0.05


def test_profiles_do_not_depend_on_the_block():
    block, _ = simulate_block("forest", 300, np.random.default_rng(7))
    for options in (Deconvolution(), Deconvolution("gold", iterations=20), Deconvolution("wiener")):
        whole = deconvolve_block(block, SYSTEM, options)
        for rows in (slice(0, 1), slice(1, 4), slice(250, 300)):
            part = deconvolve_block(block.rows(rows), SYSTEM, options)
            for name in ("value", "offset", "seen", "clipped"):
                assert np.array_equal(getattr(whole, name)[rows], getattr(part, name)), name
    with pytest.raises(ValueError, match="read-only"):
        block.samples[0, 0] = 1


def test_voxels_hold_all_energy_and_lie_where_the_echoes_are(forest, tmp_path):
    strip, truth = forest
    summary, found = voxelize(strip, tmp_path / "v.npz", 1.0)
    true = load(truth)
    energy = true["amplitude"] * true["sigma"] * SQRT_2PI
    assert summary.energy == pytest.approx(float(np.sum(found["energy"], dtype=np.float64)), rel=1e-6)
    assert summary.energy == pytest.approx(energy.sum(), rel=0.015)
    # Within one voxel of a true echo: their steps and widths reach over faces.
    assert energy_near(np.stack([true[name] for name in "xyz"], axis=1), found) > 0.99 * summary.energy
    assert summary.voxels == len(found["index"]) and summary.shape == tuple(found["index"].max(axis=0) + 1)
    assert (found["energy"] > 0).all() and (found["index"].min(axis=0) == 0).all()
    assert np.array_equal(found["index"], found["index"][np.lexsort(found["index"].T[::-1])])
    assert len(np.unique(found["index"], axis=0)) == len(found["index"])


@pytest.mark.parametrize("size", [1.0, 0.5, 0.05])
def test_a_plane_fills_the_voxels_of_its_layer(tmp_path, size):
    strip = write_strip(tmp_path / "plane.las", [[(100.0 + size / 2 if size > 0.2 else 100.02, 80.0)]] * 200)
    summary, found = voxelize(strip, tmp_path / "v.npz", size)
    assert summary.anchored == summary.with_signal == 200
    layers = sum_by_layer(found)
    assert summary.energy == pytest.approx(200 * 80 * 2.0 * SQRT_2PI, rel=0.01)
    if size > 0.2:
        assert layers[100.0] > 0.97 * summary.energy if size == 1.0 else layers[100.0] > 0.8 * summary.energy
        low = found["index"][np.rint(found["origin"][2] / size) + found["index"][:, 2] == np.rint(100.0 / size)]
        assert np.array_equal(np.unique(low[:, 0]), np.arange(round(60.0 / size)))
        return
    # Smaller than a sample's way: a column of voxels without holes.
    for x in np.unique(found["index"][:, 0]).tolist():
        z = np.sort(found["index"][found["index"][:, 0] == x, 2])
        assert (np.diff(z) == 1).all() and len(z) >= 3
    centre = sum(z * e for z, e in layers.items()) / summary.energy + size / 2
    assert centre == pytest.approx(100.02, abs=0.02)


@pytest.mark.parametrize(("iterations", "least", "most"), [(None, 0.37, 0.18), (200, 0.46, 0.04)])
def test_two_surfaces_that_the_waveform_shows_as_one_are_two_layers(tmp_path, iterations, least, most):
    pulse = replace(SYSTEM, sigma_ref=4.2)
    separation = 1.2
    strip = write_strip(tmp_path / "two.las", [[(101.35, 60.0), (101.35 - separation, 60.0)]] * 150, sigma=4.2)
    with StripReader(strip) as reader:
        block, _ = next(reader.read_blocks(reader.read_unit(0, reader.scan()), 500, True))
    mean = block.samples.mean(axis=0)
    assert np.count_nonzero((mean[1:-1] > mean[:-2]) & (mean[1:-1] >= mean[2:]) & (mean[1:-1] > 20)) == 1
    saved = SavedSurvey(Survey(pulse, 150))
    method = Deconvolution(iterations=iterations)
    _, found = voxelize(strip, tmp_path / "v.npz", 0.3, system=saved, deconvolution=method)
    layers = sum_by_layer(found)
    energy = sum(layers.values())
    heights = np.array(sorted(layers))
    values = np.array([layers[h] for h in heights]) / energy

    def near(z):
        return values[np.abs(heights + 0.15 - z) < 0.35].sum()

    assert near(101.35) > least and near(101.35 - separation) > least
    assert near(101.35 - separation / 2) < most


def naive_voxels(strip, size, headroom):
    """Rays per voxel, by small steps along every ray: what each crosses from its begin to its last signal."""
    rays = {}
    with StripReader(strip) as reader, reader.scan() as scan:
        for number in range(reader.unit_count()):
            for block, _ in reader.read_blocks(reader.read_unit(number, scan), 1000, True):
                profiles = deconvolve_block(block, SYSTEM, Deconvolution())
                for row in range(len(block)):
                    signal = np.flatnonzero(profiles.value[row])
                    end = (signal[-1] if len(signal) else block.samples.shape[1] - 1) + 0.5
                    speed = np.linalg.norm(block.direction[row])
                    time, offset = np.arange(-0.5 - headroom / speed, end, 0.008), profiles.offset[row]
                    place = block.origin[row] + (time[:, None] - offset) * block.direction[row]
                    for cell in np.unique(np.floor(place / size), axis=0).tolist():
                        rays[tuple(cell)] = rays.get(tuple(cell), 0) + 1
    return rays


@pytest.mark.quick_cases("4.0")
@pytest.mark.parametrize("headroom", [0.0, 4.0])
def test_rays_through_voxels_are_those_of_a_slow_tracer(tmp_path, headroom):
    rng = np.random.default_rng(12)
    directions = DOWN + rng.normal(0, 0.02, (40, 3)) * [1, 1, 0]
    echoes = [[(103.0, 40.0), (100.0, 50.0)] if i % 3 else [] for i in range(40)]
    strip = write_strip(tmp_path / "s.las", echoes, directions=directions, xy=rng.uniform(0, 3, (40, 2)))
    _, found = voxelize(strip, tmp_path / "v.npz", 0.7, headroom=headroom, all_crossed=True)
    slow = naive_voxels(strip, 0.7, headroom)
    base = np.rint(found["origin"] / 0.7)
    mine = {tuple(one): int(n) for one, n in zip((found["index"] + base).tolist(), found["rays"], strict=True)}
    assert set(slow) <= set(mine)
    # What small steps miss are corners that a ray only cuts.
    off = [one for one in mine if mine[one] != slow.get(one, 0)]
    assert all(mine[one] - slow.get(one, 0) == 1 for one in off) and len(off) < 0.03 * len(mine)
    top = found["index"][:, 2].max() * 0.7 + found["origin"][2]
    assert top <= 110.2 + headroom <= top + 0.85


def test_every_ray_that_crossed_a_voxel_with_signal_counts(tmp_path):
    """A tree of 20 m between oblique rays whose waveforms begin 4 m above the ground."""
    tree, ground = [[(120.5, 60.0)]] * 30, [[(100.5, 60.0)]] * 30
    unit = np.array([0.3, 0.0, -1.0]) / np.hypot(0.3, 1.0) * HALF_C
    x = np.concatenate([np.full(30, 0.5), np.full(30, 0.5 + 0.3 * (120.5 - 104.0))])
    strip = write_strip(
        tmp_path / "tree.las", tree + ground, xy=np.column_stack([x, np.full(60, 0.5)]),
        height=[125.0] * 30 + [104.0] * 30, directions=[DOWN] * 30 + [unit] * 30,
    )  # fmt: skip
    crowns = []
    for headroom in (0.0, None, 300.0):
        _, found = voxelize(strip, tmp_path / "v.npz", 1.0, headroom=headroom, overwrite=True)
        z = found["origin"][2] + found["index"][:, 2]
        row = np.flatnonzero((z == 120.0) & (found["index"][:, 0] == -found["origin"][0]))
        assert len(row) == 1
        crowns.append({name: float(found[name][row[0]]) for name in ("rays", "light", "path", "share")})
    assert crowns[0]["rays"] == 30 and crowns[1]["rays"] == 60 and crowns[1] == crowns[2]
    assert crowns[0]["share"] > 0.9 and crowns[1]["share"] == pytest.approx(crowns[0]["share"] / 2, abs=0.01)


@pytest.mark.parametrize("most", [8, 100, 1 << 18])
def test_ceilings_are_those_of_a_slow_search(most):
    rng = np.random.default_rng(9)
    points = rng.uniform(0, 120, (300, 3)) * [1, 1, 0.3]
    ceiling = Ceiling(np.array([60.0, 60.0, 0.0]), 1.0, most)
    for part in (points[:100], points[100:101], points[101:]):
        ceiling.add(part)
    ceiling.add(np.array([[np.nan, 0, 1], [1e300, 0, 1], [0, 0, np.inf]]))
    ceiling.finish()
    assert len(ceiling._key) <= 9 * most
    start = np.column_stack([rng.uniform(0, 120, (80, 2)), np.zeros(80)])
    step = np.column_stack([rng.normal(0, 0.05, (80, 2)), np.full(80, -0.1)])
    start[0, 0], step[1], step[2, 2] = np.nan, 0.0, 0.001
    headroom = ceiling.measure_headroom(start, step)
    assert headroom[:3].tolist() == [0.0, 0.0, 0.0]
    unit = -step / np.linalg.norm(np.where(step == 0, 1e-30, step), axis=1)[:, None]
    for row in range(3, 80):
        way = np.arange(0, 60, 0.25)
        place = start[row] + unit[row] * way[:, None]
        gap = np.abs(place[:, None, :2] - points[None, :, :2]).max(axis=2)
        # Whatever lies in the same cell lies within a cell; whatever is higher there needs the ray.
        needed = (np.where(gap < 0.5 * ceiling.cell, points[:, 2], -np.inf).max(axis=1) > place[:, 2])
        assert headroom[row] >= (way[needed].max() if needed.any() else 0.0)
        assert headroom[row] <= 39.0 / unit[row, 2] + 2 * ceiling.cell


def test_strips_in_degrees_are_refused(tmp_path):
    wkt = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],' \
        'UNIT["degree",0.0174532925199433]]'  # fmt: skip
    strip = write_strip(tmp_path / "s.las", [[(100.0, 50.0)]] * 30, point_format=9, wkt=wkt)
    refuses(InputError, "degrees", voxelize, strip, tmp_path / "v.npz", 1.0)


def test_light_goes_out_along_the_ray_and_empty_voxels_are_written_on_request(tmp_path):
    echoes = [[(105.5, 60.0), (102.5, 20.0)]] * 40 + [[]] * 10
    xy = np.column_stack([np.full(50, 0.5), np.full(50, 0.5)])
    strip = write_strip(tmp_path / "s.las", echoes, xy=xy)
    _, some = voxelize(strip, tmp_path / "a.npz", 1.0)
    _, every = voxelize(strip, tmp_path / "b.npz", 1.0, all_crossed=True)
    height = {round(float(z)): row for row, z in enumerate(every["origin"][2] + every["index"][:, 2])}
    rays, light, share, energy = (every[name] for name in ("rays", "light", "share", "energy"))
    for z in (109, 108, 107):
        row = height[z]
        assert (rays[row], light[row], share[row], energy[row]) == (50, 50, 0, 0)
    top, middle, low = height[105], height[104], height[102]
    assert rays[top] == 50 and share[top] == pytest.approx(40 * 0.75 / 50, abs=0.03)
    assert rays[middle] == 50 and light[middle] == pytest.approx(10 + 40 * 0.25, abs=1.5)
    assert share[low] == pytest.approx(0.5, abs=0.05) and light[height[101]] == pytest.approx(10, abs=0.5)
    assert rays[height[100]] == 10 and every["path"][height[108]] == pytest.approx(50, abs=0.01)
    assert height[min(height)] == 0 and min(height) < 90
    kept = every["energy"] > 0
    for name in ("energy", "rays", "light", "share", "path"):
        assert np.array_equal(some[name], every[name][kept])


@pytest.mark.quick_cases("v.laz")
@pytest.mark.parametrize("target", ["v.npz", "v.laz"])
def test_the_same_bytes_for_any_block_and_any_memory(forest, tmp_path, target):
    """Of voxels and of profiles."""
    strip, _ = forest
    options = {"all_crossed": target == "v.npz", "overwrite": True, "profiles": tmp_path / "p.npz",
               "deconvolution": QUICK}  # fmt: skip
    made = set()
    for block_size, held in ((None, 400_000), (97, 1 << 20), (600, 500), (1500, 3)):
        voxelize(strip, tmp_path / target, 0.8, block_size=block_size, in_memory=held, **options)
        made.add((tmp_path / target).read_bytes() + (tmp_path / "p.npz").read_bytes())
    assert len(made) == 1


@pytest.mark.quick_cases(".las-4-0", ".laz-10-6")
@pytest.mark.parametrize(("point_format", "output"), [(4, 0), (5, 0), (9, 6), (10, 6)])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_point_cloud_holds_what_the_npz_holds(tmp_path, point_format, output, suffix):
    wkt = WKT if output == 6 else None
    strip = write_strip(tmp_path / "s.las", [[(104.0, 50.0), (100.3, 40.0)]] * 50, point_format=point_format, wkt=wkt)
    _, found = voxelize(strip, tmp_path / "v.npz", 0.3)
    summary, cloud = voxelize(strip, tmp_path / f"v{suffix}", 0.3)
    assert cloud.header.point_format.id == output and summary.voxels == len(cloud.points) == len(found["index"])
    centre = found["origin"] + (found["index"] + 0.5) * 0.3
    assert np.stack([cloud.x, cloud.y, cloud.z], axis=1) == pytest.approx(centre, abs=1e-9)
    names = list(cloud.point_format.extra_dimension_names)
    assert names == ["energy", "rays", "path", "light", "share", "share_error"]
    for name in names:
        assert np.array_equal(np.asarray(cloud[name]), found[name])
    assert (np.asarray(cloud.return_number) == 1).all() and (np.asarray(cloud.number_of_returns) == 1).all()
    assert str(found["crs"]) == (wkt or "")
    header = read_header(tmp_path / f"v{suffix}")
    kept = [vlr for vlr in header.vlrs if vlr.user == "LASF_Projection"]
    assert [vlr.payload.rstrip(b"\0").decode() for vlr in kept] == ([wkt] if wkt else [])
    assert bool(header.global_encoding & 16) == (output == 6)
    meta = [json.loads(vlr.payload) for vlr in header.vlrs if vlr.user == "wavebatch"]
    assert meta == [json.loads(str(found["meta"]))] and meta[0]["deconvolution"]["iterations"] == 40


CALIBRATION = Calibration(2.5e-8, 0.03, 0.22, divergence=0.5)


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    """500 pulses over level ground, echoes of the system's width."""
    path = tmp_path_factory.mktemp("level") / "flat.las"
    simulate_strip(
        "flat", path, pulses=500, seed=2, truth=path.with_suffix(".npz"), options=StripOptions(without_waveform=0.0)
    )
    return path


def test_cross_sections_are_those_of_the_echoes(level, tmp_path):
    summary, found = voxelize(level, tmp_path / "v.npz", 1.0, calibration=CALIBRATION)
    truth = load(level.with_suffix(".npz"))
    gamma = backscatter(2.5e-8, truth["range"], truth["amplitude"], truth["sigma"], 0.22)
    expected = compute_cross_section(gamma, truth["range"], 0.5e-3)
    assert summary.sensor == "direction vectors" and summary.unknown == 0
    assert np.sum(found["cross_section"], dtype=np.float64) == pytest.approx(expected.sum(), rel=0.02)
    assert list(found)[:3] == ["index", "energy", "cross_section"]
    assert 0.03 < summary.cross_section_error < 0.032  # the constant's, and what ranges add
    # The area that a beam lights grows with its square.
    survey = replace(SAVED.survey, system=SAVED.survey.system.with_radiometry(divergence_error=0.1))
    saved = replace(SAVED, survey=survey)
    wide, _ = voxelize(level, tmp_path / "x.npz", 1.0, calibration=CALIBRATION, system=saved)
    assert wide.cross_section_error == pytest.approx(np.hypot(summary.cross_section_error, 0.2), rel=0.01)
    again, _ = voxelize(level, tmp_path / "w.npz", 1.0)
    assert again.sensor is None and again.energy == summary.energy and again.cross_section_error is None


@pytest.fixture(scope="module")
def half_known(level):
    """The position of the sensor for half of the flight over `level`."""
    path = level.with_name("trajectory.txt")
    with StripReader(level) as reader:
        block, _ = next(reader.read_blocks(reader.read_unit(0, reader.scan()), 5000, True))
    rows = ["time x y z"]
    for time in np.linspace(block.gps_time.min() - 0.01, np.median(block.gps_time), 30):
        ray = np.argmin(np.abs(block.gps_time - time))
        rows.append(" ".join(map(repr, map(float, (time, *(block.origin[ray] - block.direction[ray] * 5000.0))))))
    path.write_text("\n".join(rows) + "\n")
    return {"calibration": CALIBRATION, "sensor": SensorRequest(trajectory=path)}


def test_what_is_not_known_is_no_data_never_zero(level, half_known, tmp_path):
    for target in ("v.npz", "v.las"):
        summary, found = voxelize(level, tmp_path / target, 1.0, **half_known)
        assert 0 < summary.unknown < summary.with_signal
        section = np.asarray(found["cross_section"])
        none = np.isnan(section) if target == "v.npz" else section == -9999.0
        assert 0 < none.sum() < len(none) and (section[~none] > 0).all()


def test_calibration_without_divergence_or_sensor_is_refused(level, tmp_path):
    with pytest.raises(ConfigError, match="divergence"):
        voxelize(level, tmp_path / "v.npz", 1.0, calibration=replace(CALIBRATION, divergence=None))
    strip = write_strip(tmp_path / "s.las", [[(100.0, 50.0)]] * 30)
    with pytest.raises(InputError, match="the sensor's position is unknown: give --trajectory"):
        voxelize(strip, tmp_path / "v.npz", 1.0, calibration=CALIBRATION)
    assert not (tmp_path / "v.npz").exists()
    summary, _ = voxelize(
        strip, tmp_path / "v.npz", 1.0, calibration=CALIBRATION, sensor=SensorRequest(height=500.0)
    )
    assert summary.sensor == "flight height" and summary.unknown == 0


def test_rays_far_from_all_others_are_counted_and_left_out(forest, tmp_path, edit_points):
    strip, _ = forest

    def throw(points):
        points["X"][:40] = 2_147_000_000
        points["Z"][40:60] = -2_147_000_000

    bent = edit_points(strip, tmp_path / "bent.las", throw)
    summary, found = voxelize(bent, tmp_path / "v.npz", 0.2)
    assert 30 < summary.outside <= 60 and summary.waveforms > 1450
    assert np.ptp(found["index"], axis=0).max() < 5000


def test_a_strip_without_any_signal_gives_no_voxel(tmp_path):
    strip = write_strip(tmp_path / "s.las", [[]] * 20)
    for target in ("v.npz", "v.laz", "v.las"):
        summary, found = voxelize(strip, tmp_path / target, 1.0)
        assert summary.voxels == summary.with_signal == 0 and summary.waveforms == 20 and summary.shape == (0, 0, 0)
        assert len(found["energy"]) == 0


def write_canopy(path, rng, *, leaf, soil, slope=0.0, n=900, full=180.0, layers=(109.3,)):
    """Leaves in layers above a plane; each pulse leaves a part of its light to the ground. Returns that part's mean."""
    xy = rng.uniform(0, 30, (n, 2))
    ground = 100.0 + np.tan(np.radians(slope)) * xy[:, 0]
    left, echoes = np.ones(n), [[] for _ in range(n)]
    energy = full * np.exp(0.05 * rng.standard_normal(n))
    for layer in layers:
        taken = left * (1 - rng.beta(1.5, 1.0, n))
        for row in range(n):
            echoes[row].append((layer + ground[row] - 100.0, energy[row] * leaf * taken[row] / 0.5))
        left = left - taken
    for row in range(n):
        echoes[row].append((ground[row], energy[row] * soil * left[row] / 0.5))
    write_strip(path, [[one for one in some if one[1] > 4] for some in echoes], height=ground + 14.0, xy=xy, seed=3)
    return left.mean()


@pytest.mark.quick_cases("20.0-0.15-0.5")
@pytest.mark.parametrize(("leaf", "soil"), [(0.5, 0.15), (0.3, 0.3), (0.15, 0.5)])
@pytest.mark.parametrize("slope", [0.0, 20.0])
def test_gap_probability_does_not_depend_on_what_leaf_and_ground_reflect(tmp_path, leaf, soil, slope):
    """Signal from leaf and ground counted alike: .41 for .61 at .5 over .15."""
    true = write_canopy(tmp_path / "s.las", np.random.default_rng(4), leaf=leaf, soil=soil, slope=slope)
    summary, found = voxelize(tmp_path / "s.las", tmp_path / "v.npz", 2.0)
    assert summary.reflectance_ratio_source == "strip"
    assert abs(summary.reflectance_ratio - leaf / soil) < 2 * summary.reflectance_ratio_err < 0.3 * leaf / soil
    assert json.loads(str(found["meta"]))["reflectance_ratio"]["source"] == "strip"
    caught = found["share"] * found["light"].astype(float)
    x, z = ((found["origin"][axis] + 2.0 * (found["index"][:, axis] + 0.5)) for axis in (0, 2))
    high = z - np.tan(np.radians(slope)) * x - 100.0 > 5.0
    assert 1 - caught[high].sum() / summary.with_signal == pytest.approx(true, abs=0.03)
    plain, alike = voxelize(tmp_path / "s.las", tmp_path / "w.npz", 2.0, ratio=1.0)
    assert plain.reflectance_ratio_source == "given" and plain.energy == summary.energy
    np.testing.assert_array_equal(alike["energy"], found["energy"])
    wrong = 1 - (alike["share"] * alike["light"].astype(float))[high].sum() / plain.with_signal
    assert abs(wrong - true) > 0.1 or leaf == soil


def test_where_nothing_shows_the_ratio_it_is_one_and_said(tmp_path):
    strip = write_strip(tmp_path / "same.las", [[(109.0, 60.0), (100.0, 40.0)]] * 300)
    assert voxelize(strip, tmp_path / "a.npz", 1.0)[0].reflectance_ratio_source == "assumed"
    few = write_strip(tmp_path / "few.las", [[(109.0, 20.0 + i), (100.0, 90.0 - i)] for i in range(60)])
    assert voxelize(few, tmp_path / "b.npz", 1.0)[0].reflectance_ratio_source == "assumed"
    bare = write_strip(tmp_path / "bare.las", [[(100.0, 40.0)]] * 300)
    summary, _ = voxelize(bare, tmp_path / "c.npz", 1.0)
    assert (summary.reflectance_ratio_source, summary.reflectance_ratio) == ("no canopy", 1.0)


def test_light_is_normalised_by_range(tmp_path):
    """Leaves 60 m and ground 80 m below the sensor: without it, the share of the leaves is .64 for .5."""
    canopy, ground, n = 120.0, 100.0, 60
    near, far = 180.0 - canopy, 180.0 - ground
    pairs = [(canopy, 50.0 / near**2 * far**2), (ground, 50.0)]
    strip = write_strip(tmp_path / "s.las", [pairs] * n, height=122.0, xy=np.full((n, 2), 0.5))
    request = SensorRequest(height=80.0)
    _, found = voxelize(strip, tmp_path / "v.npz", 1.0, calibration=CALIBRATION, sensor=request, ratio=1.0)
    z = found["origin"][2] + found["index"][:, 2]
    share = (found["share"] * found["light"])[np.abs(z - canopy) < 3].sum() / n
    assert share == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("most", [20, 1 << 18])
def test_the_floor_is_the_ground_below_plants(most):
    rng = np.random.default_rng(5)
    xyz = rng.uniform(0, 60, (6000, 3)) * [1, 1, 0]
    ground = 0.3 * xyz[:, 0] - 0.1 * xyz[:, 1] + 0.05 * rng.standard_normal(6000)
    xyz[:, 2] = ground + np.where(rng.random(6000) < 0.7, rng.uniform(1, 20, 6000), 0)
    floor = Floor(np.array([30.0, 30.0, 0.0]), most)
    for part in (xyz[:2000], xyz[2000:2001], xyz[2001:], np.array([[np.nan, 0, 1], [1e300, 0, 1], [0, 0, np.inf]])):
        floor.add(part)
    floor.finish()
    place = rng.uniform(5, 55, (500, 3))
    height = floor.measure_height(place)
    off = height - (place[:, 2] - 0.3 * place[:, 0] + 0.1 * place[:, 1])
    assert np.abs(np.median(off)) < 0.15 and np.quantile(np.abs(off), 0.95) < 0.4
    assert np.isinf(floor.measure_height(np.array([[1e6, 0, 0], [np.nan, 0, 0]]))).all()
    assert np.isinf(Floor(np.zeros(3)).finish().measure_height(place)).all()


def test_32_bit_samples_do_not_overflow(tmp_path):
    strip = write_strip(tmp_path / "s.las", [[(100.5, 4e9)]] * 60, bits=32, xy=np.full((60, 2), 0.5), noise=0.0)
    summary, found = voxelize(strip, tmp_path / "v.npz", 1.0)
    assert summary.energy == pytest.approx(60 * 4e9 * 2 * SQRT_2PI, rel=0.03)
    assert found["energy"].max() > 0.9 * summary.energy


@pytest.mark.slow
def test_real_strips(riegl, leica, tmp_path):
    for path, waveforms in ((riegl, 2375), (leica, 999)):
        summary, found = voxelize(path, tmp_path / "v.npz", 0.5, system=None, overwrite=True)
        assert summary.waveforms == waveforms and summary.with_signal > 0.99 * waveforms
        assert summary.anchored > 0.98 * summary.with_signal and summary.outside == 0
        with StripReader(path) as reader:
            points = reader.read_points(0, reader.facts.header.point_count)
            scales, offsets = np.array(reader.facts.header.scales), np.array(reader.facts.header.offsets)
        xyz = np.stack([points[name] for name in "XYZ"], axis=1) * scales + offsets
        assert energy_near(xyz, found) > 0.97 * summary.energy


@pytest.mark.slow
def test_memory_does_not_grow_with_the_strip(tmp_path):
    peaks = []
    for pulses in (60_000, 600_000):
        strip = tmp_path / f"{pulses}.las"
        simulate_strip("urban", strip, pulses=pulses, seed=1)
        script = f"""
            from pathlib import Path
            from wavebatch.tools.bench.command import peak_memory
            from wavebatch.batch.job import StripJob
            from wavebatch.surveying.choose_chain import Request, widest_chain
            from wavebatch.tools.voxels.strip import VoxelOptions, voxelize_strip
            job = StripJob(Path({str(strip)!r}), widest_chain(), request=Request(auto=True))
            voxelize_strip(job, job.path.with_suffix(".npz"), VoxelOptions(0.25))
            print(peak_memory())
        """
        result = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True
        )
        peaks.append(int(result.stdout) / 2**20)
    assert peaks[1] < 400 and peaks[1] < peaks[0] + 120


def profiles_of(strip, folder, name="p", **options):
    summary, found = voxelize(strip, folder / f"{name}.vox.npz", 1.0, profiles=folder / f"{name}.npz", **options)
    return summary, found, load(folder / f"{name}.npz")


def test_profiles_of_pulses_add_up_to_the_voxels(level, tmp_path):
    summary, voxels, made = profiles_of(level, tmp_path, calibration=CALIBRATION)
    assert len(made["point"]) == summary.with_signal and len(made["time"]) == summary.profile_samples
    assert made["count"].sum() == len(made["energy"]) and (made["count"] > 0).all()
    np.testing.assert_array_equal(made["first"], np.cumsum(made["count"]) - made["count"])
    for name in ("energy", "cross_section"):
        total = np.sum(voxels[name], dtype=np.float64)
        assert np.sum(made[name], dtype=np.float64) == pytest.approx(total, rel=1e-3)
    # Each pulse has the cross section of its one echo, and it lies on the ground.
    truth = load(level.with_suffix(".npz"))
    gamma = backscatter(2.5e-8, truth["range"], truth["amplitude"], truth["sigma"], 0.22)
    each = np.add.reduceat(made["cross_section"].astype(float), made["first"])
    assert np.median(each) == pytest.approx(np.median(compute_cross_section(gamma, truth["range"], 0.5e-3)), rel=0.03)
    pulse = np.repeat(np.arange(len(made["point"])), made["count"])
    height = (made["start"][pulse] + made["step"][pulse] * made["time"][:, None])[:, 2]
    centre = np.bincount(pulse, made["energy"] * height) / np.bincount(pulse, made["energy"])
    assert np.ptp(centre) < 0.5
    meta = json.loads(str(made["meta"]))
    assert set(meta["columns"]) == set(made) - {"crs", "meta"} and meta["strip"] == level.name


def test_two_surfaces_are_two_parts_of_one_profile(tmp_path):
    strip = write_strip(tmp_path / "two.las", [[(104.0, 60.0), (101.0, 90.0)]] * 40)
    _, _, made = profiles_of(strip, tmp_path)
    assert len(made["point"]) == 40 and "cross_section" not in made
    for pulse in range(40):
        part = slice(made["first"][pulse], made["first"][pulse] + made["count"][pulse])
        height = made["start"][pulse, 2] + made["time"][part] * made["step"][pulse, 2]
        upper = height > 102.5
        energy = [made["energy"][part][side].sum() for side in (upper, ~upper)]
        assert np.array(energy) == pytest.approx(np.array([60, 90]) * 2.0 * SQRT_2PI, rel=0.1)


def test_unknown_cross_sections_of_profiles_are_no_data(level, half_known, tmp_path):
    """Energy is known there, cross sections are not."""
    summary, _, made = profiles_of(level, tmp_path, **half_known)
    unknown = np.isnan(np.add.reduceat(made["cross_section"].astype(float), made["first"]))
    assert unknown.sum() == summary.unknown > 100 and np.isfinite(made["energy"]).all()


NOISE = ReceiverNoise(baseline=12.0, baseline_spread=0.1, std=0.58)
QUIET = SavedSurvey(Survey(SystemPulse(2.0, noise=NOISE), 1000))
N = 1500


def voxelize_pulses(strip, folder, *, how=None, size=1.0, ratio=2.0, where=None, **options):
    options["selection"] = PointFilter.build(where=where)
    job = take_job(strip, options, QUIET)
    how = how or Deconvolution()
    settings = VoxelOptions(size, how, headroom=50.0, reflectance_ratio=ratio, all_crossed=True)
    summary = voxelize_strip(job, folder / "v.npz", settings, overwrite=True, **options)
    with np.load(folder / "v.npz") as file:
        return summary, {name: file[name] for name in file}


def shares(found, layers):
    """Share of all light that is caught in layers given as (low, high) [m]."""
    z = found["origin"][2] + (found["index"][:, 2] + 0.5) * found["size"]
    caught = np.nan_to_num(found["share"]) * found["light"].astype(float)
    rays = max(found["light"][z == one].sum(dtype=float) for one in np.unique(z))
    return np.array([caught[(z > low) & (z < high)].sum() / rays for low, high in layers])


def layer_of(found):
    """Lower face of each voxel of 1 m."""
    return np.floor(found["origin"][2] + found["index"][:, 2] + 0.5)


LAYERS = ((120, 124), (114, 118), (108, 112), (98, 102))


@pytest.fixture(scope="module")
def canopy():
    """Counts, heights, positions, echoes, and the light that each layer catches."""
    rng = np.random.default_rng(5)
    echoes, xy, caught = draw_canopy(rng, N, density=0.2)
    begin = 128.0 + rng.uniform(0, 0.3, N)
    return render(echoes, begin, 224, rng), begin, xy, echoes, caught.mean(axis=0)


@pytest.fixture(scope="module")
def strips(canopy, tmp_path_factory):
    """The same pulses with one packet each, and with a packet per stretch above the threshold."""
    folder = tmp_path_factory.mktemp("packets")
    *pulses, _ = canopy
    packets = record(canopy[0], 4)
    assert {1, 2, 3} == {len(one) for one in packets}
    return write_recorded(folder / "joined.las", *pulses), write_recorded(folder / "split.las", *pulses, packets)


@pytest.fixture(scope="module")
def whole(strips, tmp_path_factory):
    """What the pulses with one packet each give."""
    return voxelize_pulses(strips[0], tmp_path_factory.mktemp("whole"))


@pytest.mark.quick_cases("None")
@pytest.mark.parametrize("ratio", [2.0, None])
def test_split_pulses_are_joined_ones(strips, canopy, whole, tmp_path, ratio):
    """As pulses of their own, packets make the shares of the canopy half as large again."""
    (_, joined), (summary, split) = whole, voxelize_pulses(strips[1], tmp_path, ratio=ratio)
    assert summary.pulses == N and summary.waveforms > 1.8 * N and summary.several_packets > 0.7 * N
    assert shares(split, LAYERS) == pytest.approx(shares(joined, LAYERS), rel=0.005)
    assert shares(split, LAYERS) == pytest.approx(canopy[-1], abs=0.01)
    assert summary.reflectance_ratio == pytest.approx(2.0, abs=0.15) and 0.01 < summary.hidden_light < 0.06
    # What lies between two packets was seen to be empty.
    between = [one["path"][layer_of(one) == 105].sum() for one in (split, joined)]
    assert between[0] == pytest.approx(between[1], rel=0.002) and between[1] > 0.8 * N


@pytest.mark.slow
def test_the_strip_may_be_in_any_order_and_cut_anywhere(strips, canopy, tmp_path):
    *pulses, _ = canopy
    expected = voxelize_pulses(strips[1], tmp_path, profiles=tmp_path / "a.npz")[1]
    made = [(tmp_path / name).read_bytes() for name in ("v.npz", "a.npz")]
    for block_size, held in ((40, 1 << 18), (97, 400)):
        voxelize_pulses(strips[1], tmp_path, block_size=block_size, in_memory=held, profiles=tmp_path / "a.npz")
        assert [(tmp_path / name).read_bytes() for name in ("v.npz", "a.npz")] == made
    mixed = write_recorded(
        tmp_path / "mixed.las", *pulses, record(canopy[0], 4),
        order=lambda n, pulse: np.lexsort((np.random.default_rng(1).random(n), pulse // 100)),
    )  # fmt: skip
    # Packets of most pulses at borders lie in two units.
    for strip in (strips[1], mixed):
        summary, found = voxelize_pulses(strip, tmp_path, unit_points=600)
        assert summary.pulses == N
        # The cells of the ground's map are placed by a sample of the points, which depends on their order.
        assert shares(found, LAYERS) == pytest.approx(shares(expected, LAYERS), rel=0.01)
        names = ("index", "energy", "light", "share")
        assert strip == mixed or all(np.array_equal(found[name], expected[name]) for name in names)


def test_five_packets_are_one_pulse(tmp_path):
    rng = np.random.default_rng(2)
    echoes, xy, caught = draw_canopy(rng, 600, layers=(140.0, 130.0, 120.0, 110.0), density=0.15)
    begin = np.full(600, 145.0)
    counts = render(echoes, begin, 352, rng)
    packets = record(counts, 4)
    assert max(map(len, packets)) == 5
    split = write_recorded(tmp_path / "s.las", counts, begin, xy, echoes, packets)
    summary, found = voxelize_pulses(split, tmp_path, profiles=tmp_path / "p.npz")
    layers = [(z - 2, z + 2) for z in (140, 130, 120, 110, 100)]
    assert shares(found, layers) == pytest.approx(caught.mean(axis=0), abs=0.01)
    with np.load(tmp_path / "p.npz") as made:
        assert len(made["point"]) == summary.pulses == 600 and made["packets"].tolist() == [len(p) for p in packets]
        assert np.isinf(made["known"]).all() and (np.diff(made["gps_time"]) > 0).all()
        height = np.repeat(made["start"][:, 2], made["count"]) - HALF_C * made["time"]
        pulse = np.repeat(np.arange(600), made["count"])
        ground = np.bincount(pulse, np.where(height < 102, made["energy"], 0), minlength=600)
    true = np.zeros(600)
    low = echoes[:, 1] < 102
    true[echoes[low, 0].astype(int)] = echoes[low, 2] * 2.0 * np.sqrt(2 * np.pi)
    assert ground == pytest.approx(true, abs=60)


def test_packets_that_overlap_count_once(canopy, whole, tmp_path):
    """All samples twice, in packets that overlap by half or lie inside another."""
    *pulses, _ = canopy
    twice = write_recorded(tmp_path / "s.las", *pulses, [[(0, 159), (96, 223), (100, 131)]] * N)
    summary, found = voxelize_pulses(twice, tmp_path)
    whole, joined = whole
    assert summary.pulses == N and summary.waveforms == 3 * N and max(LENGTHS) > 224
    assert summary.energy == pytest.approx(whole.energy, rel=0.002)
    assert shares(found, LAYERS) == pytest.approx(shares(joined, LAYERS), rel=0.005)


def test_of_two_packets_that_overlap_each_counts_to_the_middle_of_what_both_recorded():
    """Samples 0 to 9 and 6 to 19 of a ray, 1 ns apart; the middle of 5.5 to 9.5 is 7.5."""
    packets, samples = np.zeros(2, rays.PACKET), np.zeros(24, rays.SAMPLE)
    packets["point"], packets["seen"], packets["begin"], packets["end"] = (0, 1), True, -0.5, (9.5, 13.5)
    packets["step"] = 0.0, 0.0, -HALF_C
    packets["start"][1] = 6.0 * packets["step"][0]
    samples["packet"], samples["time"] = np.repeat((0, 1), (10, 14)), [*range(10), *range(14)]
    samples["energy"] = 100.0 * samples["packet"] + samples["time"]
    joined = rays.join_packets(packets, samples, np.zeros(0, rays.LOST))
    assert joined.samples["time"].tolist() == list(range(20))
    assert joined.samples["energy"].tolist() == [*range(8), *range(102, 114)]


def test_light_is_known_up_to_a_lost_packet(canopy, strips, tmp_path):
    """A quarter of the pulses lack their last packet: without a rule, their canopy would catch all of their light."""
    *pulses, true = canopy
    packets = record(canopy[0], 4)
    several = [pulse for pulse in range(N) if len(packets[pulse]) > 1]
    wrong = {(pulse, len(packets[pulse]) - 1) for pulse in several[::4]}
    lossy = write_recorded(tmp_path / "s.las", *pulses, packets, wrong=wrong)
    summary, found = voxelize_pulses(lossy, tmp_path, profiles=tmp_path / "p.npz")
    assert summary.lost_packets == len(wrong) and summary.pulses == N
    assert shares(found, LAYERS[:3]) == pytest.approx(true[:3], abs=0.01)
    low = layer_of(found) == 103
    assert found["rays"][low].sum() < N - 0.9 * len(wrong)
    with np.load(tmp_path / "p.npz") as made:
        assert np.isfinite(made["known"]).sum() == len(wrong)
    first = write_recorded(tmp_path / "f.las", *pulses, packets, wrong={(pulse, 0) for pulse in several[::4]})
    summary, found = voxelize_pulses(first, tmp_path)
    assert summary.lost_packets == len(wrong)
    z = layer_of(found)
    assert found["rays"][z == 126].sum() == N - len(wrong)
    # Beyond the lost packet light is not known, energy is.
    whole = voxelize_pulses(strips[1], tmp_path)[1]
    expected = whole["energy"][layer_of(whole) == 100].sum()
    assert found["energy"][z == 100].sum() == pytest.approx(expected, rel=0.001)


def test_returns_that_are_missing_or_stand_far_apart_are_named(strips, canopy, edit_points, tmp_path):
    """Sorted by return number, packets of a pulse were pulses of their own; of first returns alone light is missing."""
    *pulses, _ = canopy
    with StripReader(strips[1]) as reader:
        time = reader.read_points(0, reader.facts.header.point_count)["gps_time"]
    totals = np.unique(time, return_counts=True)[1]

    def number(points):
        _, first, pulse = np.unique(points["gps_time"], return_index=True, return_inverse=True)
        points["bit_fields"] = np.arange(len(points)) - first[pulse] + 1 | totals[pulse] << 3

    def sort(points):
        return points[np.argsort(points["bit_fields"] & 7, kind="stable")]

    whole = edit_points(strips[1], tmp_path / "whole.las", number)
    by_number = edit_points(whole, tmp_path / "sorted.las", sort)
    first = write_recorded(
        tmp_path / "f.las", *pulses, record(canopy[0], 4), order=lambda n, pulse: np.unique(pulse, return_index=True)[1]
    )
    thinned = edit_points(first, tmp_path / "thinned.las", number)
    for strip, unit_points, words in (
        (whole, None, ""), (whole, 600, ""), (by_number, None, ""), (by_number, 600, "stand far apart in the file"),
        (thinned, None, f"{len(time) - N} of {len(time)} returns that"),
    ):  # fmt: skip
        summary, _ = voxelize_pulses(strip, tmp_path, how=QUICK, unit_points=unit_points)
        said = [line for line in summary.warnings if "in the file" in line]
        assert len(said) == bool(words) and all(words in line for line in said), (strip, unit_points)


def test_last_returns_that_are_missing_are_named():
    """Of a forest without the class of the ground, the lowest leaves were taken for the ground, without a line."""
    shown = np.zeros((16, 16), int)
    shown[1, 1], shown[2, 1:3], shown[3, 1:4] = 900, 80, 20
    assert not list(_doubt_returns(shown, 1000, split=False))
    shown[2, 2] = shown[3, 3] = 0
    (line,) = _doubt_returns(shown, 1000, split=False)
    assert "the last returns of 100 of 1000 pulses are not in the file" in line


@pytest.mark.parametrize("apart", ["direction", "scanner", "place"])
def test_pulses_of_equal_time_are_not_one(canopy, tmp_path, apart):
    """Two channels, or two scanners: each pulse has the time of its neighbour."""
    counts, begin, xy, echoes, _ = canopy
    n = 400
    counts, begin, xy, echoes = counts[:n], begin[:n], xy[:n].copy(), echoes[echoes[:, 0] < n]
    xy[1::2] = xy[::2] + (5.0 if apart == "place" else 0.0)
    direction = np.tile([0.0, 0.0, -HALF_C], (n, 1))
    if apart == "direction":
        direction[1::2, 0] = 0.06 * HALF_C
    scanner = np.arange(n) % 2 if apart == "scanner" else np.zeros(n, int)
    time = 1000.0 + np.arange(n) // 2 * 1e-5
    strip = write_recorded(tmp_path / "s.las", counts, begin, xy, echoes, record(counts, 4), time=time,
                           direction=direction, scanner=scanner)  # fmt: skip
    summary, found = voxelize_pulses(strip, tmp_path, how=QUICK)
    assert summary.pulses == n
    assert found["light"][layer_of(found) == 126].sum() == pytest.approx(n, abs=12 if apart == "direction" else 0)
    if apart == "scanner":
        summary, _ = voxelize_pulses(strip, tmp_path, how=QUICK, where="scanner_channel == 1")
        assert summary.pulses == n / 2 and summary.left_out + summary.waveforms > n


def test_times_of_many_packets_are_no_pulse(canopy, tmp_path):
    """A constant time is none, nor is 0: each packet stays a pulse."""
    *pulses, _ = canopy
    for time in (0.0, 77.0):
        strip = write_recorded(tmp_path / f"{time}.las", *pulses, record(canopy[0], 4), time=np.full(N, time))
        summary, _ = voxelize_pulses(strip, tmp_path, how=QUICK)
        assert summary.pulses == summary.waveforms > N and summary.several_packets == summary.lost_packets == 0


def test_errors_of_shares_are_those_of_voxels_with_as_many_rays():
    """Two rays per voxel that leaves catch one by one, or forty that one clump catches together: no surer than one."""
    rng, each = np.random.default_rng(1), np.repeat([2, 40], 800)
    column = np.repeat(np.arange(1600), each)
    caught = np.where(each[column] == 2, rng.random(len(column)), rng.random(1600)[column]) < 0.5
    table, samples = np.zeros(len(column), rays.RAY), np.zeros(len(column), rays.SAMPLE)
    table["start"] = np.column_stack([*divmod(column, 40), np.full(len(column), 9.0)]) + [0.5, 0.5, 0.0]
    table["step"], table["end"], table["known"], table["count"] = (0.0, 0.0, -1.0), 9.0, np.inf, 1
    table["first"] = samples["packet"] = np.arange(len(column))
    samples["time"], samples["spacing"] = np.where(caught, 3.5, 8.5), 0.1
    samples["energy"] = samples["canopy"] = 1.0
    with VoxelGrid(1.0, np.zeros(3, np.int64), 2.0**-20, sections=False, everything=True) as grid:
        grid.add(rays.Rays(table, samples), rays.LightRule())
        grid.measure_spread()
        (index, found), = grid.pieces()
    high = index[:, 2] == 5
    few, many = (found["share_error"][high & (found["rays"] == number)] for number in (2, 40))
    assert len(few) == len(many) == 800 and few.mean() == pytest.approx(0.33, abs=0.04)
    assert many.mean() == pytest.approx(0.67, abs=0.04)


def test_errors_of_shares_hold_that_of_the_ratio():
    """By as much as the share moves with the logarithm of the ratio of reflectances."""
    table, samples = np.zeros(40, rays.RAY), np.zeros(80, rays.SAMPLE)
    table["start"], table["step"], table["end"] = (0.5, 0.5, 9.0), (0.0, 0.0, -1.0), 9.0
    table["known"], table["count"], table["first"] = np.inf, 2, 2 * np.arange(40)
    samples["packet"], samples["time"], samples["spacing"] = np.arange(80) // 2, np.resize([3.5, 8.5], 80), 0.1
    samples["canopy"][::2], samples["ground"][1::2], samples["energy"] = 0.6, 0.4, 1.0

    def measure(ratio, *log_error):
        with VoxelGrid(1.0, np.zeros(3, np.int64), 2.0**-20, sections=False, everything=True) as grid:
            grid.add(rays.Rays(table, samples), rays.LightRule(ratio))
            grid.measure_spread()
            (index, found), = grid.pieces(*log_error)
        return (found[name][index[:, 2] == 5].item() for name in ("share", "share_error"))

    share, alone = measure(2.0)
    _, error = measure(2.0, 0.25)
    step = 0.01
    (less, _), (more, _) = (measure(2.0 * np.exp(sign * step)) for sign in (-1, 1))
    assert share == pytest.approx(0.6 / (0.6 + 2.0 * 0.4), rel=1e-4)
    assert error**2 - alone**2 == pytest.approx((0.25 * (more - less) / (2 * step)) ** 2, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("clumps", "density"), [(None, 0.25), (0.35, 0.3), (0.35, 0.7)])
def test_errors_of_shares_cover_the_truth(tmp_path, clumps, density):
    """Leaves spread evenly, and in clumps of .35 m that cover a part of each voxel: two of three within an error."""
    rng = np.random.default_rng(3)
    parts = []
    for _ in range(2):
        echoes, xy, _ = draw_canopy(rng, 3000, layers=(119.0, 113.0), density=density, width=28.0, clumps=clumps)
        counts = render(echoes, np.full(3000, 122.0), 170, rng)
        strip = write_recorded(tmp_path / "s.las", counts, np.full(3000, 122.0), xy, echoes)
        _, found = voxelize_pulses(strip, tmp_path, size=2.0, ratio=None)
        centre = found["origin"] + (found["index"] + 0.5) * 2.0
        used = (np.abs(centre[:, 2, None] - (119.0, 113.0)) < 0.5).any(axis=1) & (found["light"] > 2)
        parts.append((found["share"][used] - density) / found["share_error"][used])
        (tmp_path / "s.las").unlink()
    off = np.concatenate(parts)
    assert 0.6 < np.mean(np.abs(off) < 1) < 0.8 and len(off) > 600 and abs(np.mean(off)) < 0.25


@pytest.mark.slow
def test_a_wrong_ratio_is_within_the_errors(tmp_path):
    """Two kinds of soil: the ratio is that of one of them, and its error says how much the other differs."""
    rng = np.random.default_rng(4)
    echoes, xy, caught = draw_canopy(rng, 3000, density=0.3)
    low, bright = echoes[:, 1] < 102, xy[:, 0] % 8 < 4
    echoes[low, 2] *= np.where(bright, 1.5, 0.5)[echoes[low, 0].astype(int)]
    begin = np.full(3000, 128.0)
    strip = write_recorded(tmp_path / "s.las", render(echoes, begin, 224, rng), begin, xy, echoes)
    summary, found = voxelize_pulses(strip, tmp_path, ratio=None)
    assert summary.reflectance_ratio_source == "strip"
    assert abs(summary.reflectance_ratio - 2.0) < 2 * summary.reflectance_ratio_err
    assert abs(shares(found, LAYERS)[3] / caught.mean(axis=0)[3] - 1) > 0.02
    _, given = voxelize_pulses(strip, tmp_path, ratio=summary.reflectance_ratio)
    assert (found["share_error"] >= given["share_error"] - 1e-7).all()
    partly = (found["share"] > 0.1) & (found["share"] < 0.9)
    assert np.mean(found["share_error"][partly] - given["share_error"][partly]) > 1e-3


def test_where_takes_whole_pulses(strips, tmp_path):
    """The ground's return chooses the pulse, with its canopy."""
    summary, found = voxelize_pulses(strips[1], tmp_path, how=QUICK, where="z < 102")
    whole, _ = voxelize_pulses(strips[1], tmp_path, how=QUICK)
    assert 0.8 * N < summary.pulses < N and summary.waveforms + summary.left_out == whole.waveforms
    assert shares(found, LAYERS)[0] > 0.1
