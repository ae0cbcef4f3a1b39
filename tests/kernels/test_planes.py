"""Robust planes, neighbourhoods and tiles: against slow twins, known surfaces, and whatever points there may be."""

import naive
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.special import fdtrc

from wavebatch.core.units import MAD_TO_STD
from wavebatch.kernels.geometry import normals
from wavebatch.kernels.geometry.planes import (
    DOUBTFUL,
    LEAST_SPREAD,
    OUTLYING,
    SMOOTH,
    SURE,
    TIGHT,
    chance_of_ratio,
    compare_halves,
    fit_planes,
    measure_angles,
    misfit_of_angles,
)

SETTINGS = {"radius": 1.5, "min_points": 8, "max_error": 5.0}


def slope(rng, n, degrees, noise=0.02, side=1.5):
    """Points of a plane that rises towards the east, around 0."""
    xyz = rng.uniform(-side, side, (n, 3))
    xyz[:, 2] = np.tan(np.radians(degrees)) * xyz[:, 0] + noise * rng.standard_normal(n)
    return xyz


def naive_plane(xyz):
    """fit_planes of one set: points that count, by a loop with singular values and sorted distances; their limit."""
    kept = np.ones(len(xyz), bool)
    for number in range(8):
        centre = xyz[kept].mean(axis=0)
        _, singular, axes = np.linalg.svd(xyz[kept] - centre, full_matrices=False)
        variance = singular**2 / kept.sum()
        off = np.abs((xyz - centre) @ axes[2])
        middle = max(sorted(off)[len(off) // 2], LEAST_SPREAD)
        tight = number < 3 and variance[2] > SMOOTH * variance[1]
        factor = TIGHT if tight else OUTLYING * MAD_TO_STD * (1 + 5 / max(len(xyz) - 3, 1))
        near = off <= factor * middle
        if (near == kept).all() and not tight:
            break
        kept = near
    centre = xyz[kept].mean(axis=0)
    _, singular, axes = np.linalg.svd(xyz[kept] - centre, full_matrices=False)
    return kept.sum(), axes[2], np.sort(singular**2 / kept.sum()), factor * middle


def test_many_planes_at_once_are_those_of_a_loop(rng):
    sets = [slope(rng, rng.integers(8, 60), rng.uniform(0, 70)) for _ in range(150)]
    for xyz in sets[::2]:
        xyz[: len(xyz) // 4, 2] += rng.uniform(0.5, 2)
    sets += [rng.uniform(-1, 1, (30, 3)) for _ in range(20)]
    group = np.repeat(np.arange(len(sets)), [len(xyz) for xyz in sets])
    planes = fit_planes(np.concatenate(sets), group, len(sets))
    for number, xyz in enumerate(sets):
        kept, normal, spreads, limit = naive_plane(xyz)
        assert planes.kept[number] == kept
        assert abs(planes.normal[number] @ normal) == pytest.approx(1, abs=1e-9)
        assert planes.spreads[number] == pytest.approx(spreads, rel=1e-6, abs=1e-12)
        assert planes.limit[number] == pytest.approx(limit, rel=1e-6)


@pytest.mark.parametrize("degrees", [0, 1, 10, 60])
@pytest.mark.parametrize("seed", range(2))
def test_errors_are_what_they_say(degrees, seed):
    rng = np.random.default_rng(seed)
    n, k = 1500, 30
    xyz = np.concatenate([slope(rng, k, degrees, noise=0.05) for _ in range(n)])
    planes = fit_planes(xyz, np.repeat(np.arange(n), k), n)
    angle, error = measure_angles(planes, np.tile([0, 0, -1.0], (n, 1)))
    off = np.degrees(angle) - degrees
    assert 0.58 < (np.abs(off) <= np.degrees(error)).mean() < 0.80
    assert abs(np.median(off)) < 0.3 or degrees < 2


def test_chance_of_two_planes_is_that_of_f():
    freedom, ratio = np.repeat(np.arange(1.0, 120), 50), np.tile(np.r_[0, np.geomspace(1e-4, 1e3, 49)], 119)
    np.testing.assert_allclose(chance_of_ratio(ratio, freedom), fdtrc(3, freedom, ratio), rtol=0, atol=1e-13)


def _neighbours_by_loop(around, points, radius):
    found = []
    for number, place in enumerate(points):
        found += [(number, *step) for step in around - place if (step * step).sum() <= radius * radius]
    return np.array(found)


def test_neighbours_are_those_of_a_loop(rng):
    """Also for another radius afterwards, and where some points are too far away for cells of their own."""
    around, points = rng.uniform(0, 5, (400, 3)).round(1), rng.uniform(0, 5, (70, 3)).round(1)
    far = [[0, 0, 9e9], [0, 0, 9e9], [-9e9, 0, 0], [3e6, 2, 2]]
    around, points = np.concatenate([around, far]), np.concatenate([points, far])
    found = normals.Surroundings(around)
    for radius in (1.0, 0.3):
        point, offset = found.find(points, radius)
        np.testing.assert_array_equal(np.column_stack([point, offset]), _neighbours_by_loop(around, points, radius))


def gable(rng, degrees, noise, density, half=6.0, length=40.0):
    """Points of two slopes that meet in a ridge along y, rays onto them, and the true angles [deg]."""
    n = int(density * 2 * half * length)
    xyz = rng.uniform([-half, 0, 0], [half, length, 0], (n, 3))
    rise = np.tan(np.radians(degrees))
    xyz[:, 2] = -rise * np.abs(xyz[:, 0]) + noise * rng.standard_normal(n)
    ray = np.array([0.1, 0.05, -1.0]) / np.sqrt(1.0125)
    cosine = np.abs(rise * np.sign(xyz[:, 0]) * ray[0] + ray[2]) / np.hypot(rise, 1)
    return xyz, np.tile(ray, (n, 1)), np.degrees(np.arccos(cosine))


@pytest.mark.quick_cases("*-4-*", "0.02-10-10")
@pytest.mark.parametrize("degrees", [5, 10, 15, 20])
@pytest.mark.parametrize(("noise", "density"), [(0.01, 4), (0.02, 4), (0.02, 10), (0.05, 20)])
def test_at_a_ridge_the_error_grows_or_there_is_no_angle(degrees, noise, density):
    """One plane through both slopes is off by the slope: it was off by 3 to 8 errors."""
    xyz, ray, true = gable(np.random.default_rng(degrees), degrees, noise, density, length=80.0)
    (angle, error), gap = normals.measure_normals(xyz, ray, normals.Surroundings(xyz), **SETTINGS)
    near, known = np.abs(xyz[:, 0]) < 1.5, np.isfinite(angle)
    ratio = np.abs(angle - true) / error
    assert (ratio[near & known] > 3).mean() < 0.05
    assert (ratio[near & known] <= 1).mean() > 0.58
    at_ridge = np.abs(xyz[:, 0]) < 0.3
    assert (known & (ratio > 3))[at_ridge].mean() < 0.05
    if degrees > 5:
        assert (gap[at_ridge] == normals.Gap.NO_PLANE).mean() > 0.75
    plain = (np.abs(xyz[:, 0]) > 1.6) & (np.abs(xyz[:, 0]) < 4.4)
    assert known[plain].mean() > 0.98
    assert 0.62 < (ratio[plain & known] <= 1).mean() < 0.78


def test_two_halves_are_those_of_a_loop(rng):
    sets = [slope(rng, rng.integers(10, 60), rng.uniform(0, 40)) for _ in range(60)]
    for xyz in sets[::2]:
        xyz[:, 2] += rng.uniform(0, 0.2) * np.abs(xyz[:, 0] - rng.uniform(-0.5, 0.5))
    group = np.repeat(np.arange(len(sets)), [len(xyz) for xyz in sets])
    planes = fit_planes(np.concatenate(sets), group, len(sets))._replace(limit=np.full(len(sets), np.inf))
    found = [naive.compare_halves(xyz) for xyz in sets]
    flat = planes._replace(
        axes=np.stack([np.linalg.svd(xyz - xyz.mean(axis=0))[2][::-1].T for xyz in sets]),
        centre=np.stack([xyz.mean(axis=0) for xyz in sets]),
    )
    halves = compare_halves(np.concatenate(sets), group, flat)
    np.testing.assert_allclose(halves.chance, [chance for chance, _ in found], rtol=1e-6, atol=1e-12)
    assert (halves.chance < SURE).sum() > 10 and (halves.chance > DOUBTFUL).sum() > 10


@pytest.mark.parametrize("count", [9, 15, 40, 120])
def test_a_plane_is_seldom_taken_for_two(count):
    rng = np.random.default_rng(count)
    n = 2000
    xyz = np.concatenate([slope(rng, count, 20) for _ in range(n)])
    group = np.repeat(np.arange(n), count)
    planes = fit_planes(xyz, group, n)
    halves = compare_halves(xyz, group, planes)
    assert (halves.chance < SURE).mean() < 0.06
    assert (halves.chance < 0.001).mean() < 0.003
    ray = np.tile([0, 0.6, -0.8], (n, 1))
    off = misfit_of_angles(halves, planes, ray)
    assert (off == 0).mean() > 0.8 and (off >= 0).all()


def test_a_ridge_on_two_scan_lines_is_no_plane():
    """What is no surface is not called too few neighbours, however they lie."""
    x, y = np.tile(np.linspace(-1.5, 1.5, 14), 2), np.repeat([0.0, 1.28], 14)
    points = np.stack([x, y, 0.1 * np.abs(x)], axis=1)
    ray, around = np.array([[0.0, 0.1, -1.0]]), normals.Surroundings(points)
    gap = [normals.measure_normals(points[7:8], ray, around, radius=2.0, min_points=5, max_error=most)[1][0]
           for most in (2.0, 20.0)]  # fmt: skip
    assert gap == [normals.Gap.NO_PLANE, normals.Gap.FEW_NEIGHBOURS]


def test_reasons():
    rng = np.random.default_rng(5)
    flat = np.column_stack([rng.uniform(0, 20, (1500, 2)), 0.01 * rng.standard_normal(1500)])
    plants = rng.uniform(0, 6, (600, 3)) + [0, 40, 0]
    sweep = np.column_stack([np.full(300, 60.0), rng.uniform(0, 10, 300), rng.uniform(0, 10, 300)])
    line = np.column_stack([np.linspace(0, 10, 100), np.full(100, 80.0), np.zeros(100)])
    above, lonely = [[10, 10, 0.8]], [[100, 100, 0]]
    parts = [flat, plants, sweep, line, above, lonely, [[np.nan, 0, 0]], flat[:2]]
    points = np.concatenate(parts)
    ray = np.tile([0, 0.2, -1.0], (len(points), 1))
    ray[-2:] = [[0, 0, 0], [np.nan, 0, 1]]
    around = normals.Surroundings(points[np.isfinite(points).all(axis=1)])
    (angle, error), gap = normals.measure_normals(points, ray, around, **SETTINGS)
    gaps = np.split(gap, np.cumsum([len(part) for part in parts])[:-1])
    assert (gaps[0] == normals.Gap.KNOWN).mean() > 0.95
    assert (gaps[1] == normals.Gap.NO_PLANE).mean() > 0.95
    assert (gaps[2] == normals.Gap.TOO_STEEP).mean() > 0.9
    assert (gaps[3] == normals.Gap.FEW_NEIGHBOURS).all()
    sharp = normals.measure_normals(flat, ray[: len(flat)], around, **SETTINGS | {"max_error": 0.01})[1]
    assert (sharp == normals.Gap.UNCERTAIN).mean() > 0.9
    assert gaps[4] == normals.Gap.NO_PLANE and gaps[5] == normals.Gap.FEW_NEIGHBOURS and gaps[6] == normals.Gap.NO_RAY
    assert (gaps[7] == normals.Gap.NO_RAY).all()
    np.testing.assert_array_equal(np.isnan(angle), gap != normals.Gap.KNOWN)
    np.testing.assert_array_equal(np.isnan(error), gap != normals.Gap.KNOWN)
    assert angle.dtype == error.dtype == np.float32
    assert np.nanmedian(angle) == pytest.approx(np.degrees(np.arctan(0.2)), abs=0.1)


def test_dense_points_are_thinned_alike_whatever_else_is_there(rng):
    xyz, row = rng.uniform(0, 4, (20_000, 3)), np.arange(20_000)
    kept = normals.thin_out(xyz, row, 1.0)
    cells, number = np.unique(np.floor(xyz[kept] / 0.25), axis=0, return_counts=True)
    assert number.max() == normals.MOST_PER_CELL and len(cells) == len(np.unique(np.floor(xyz / 0.25), axis=0))
    part = np.flatnonzero(xyz[:, 0] < 2.0)
    np.testing.assert_array_equal(normals.thin_out(xyz[part], row[part], 1.0), kept[part])
    assert normals.thin_out(xyz[:200], row[:200], 0.1).all()


def test_every_point_lies_in_one_tile_and_its_neighbours_are_listed(rng):
    xyz = np.concatenate([rng.uniform(0, 100, (4000, 3)), rng.normal(50, 0.5, (2000, 3)), [[1e7, -1e7, 0]]])
    xyz[:500, 0] = 10.0
    tiles = normals.cut_tiles(xyz[::2], 60, 8.0)
    inside = np.array([normals.is_inside(tiles, number, xyz) for number in range(len(tiles))])
    assert len(tiles) > 20
    np.testing.assert_array_equal(inside.sum(axis=0), 1)
    rows, numbers = normals.sort_into_tiles(tiles, xyz, 1.0)
    assert len(rows) < 8 * len(xyz)
    whole = np.floor(xyz[:4000])  # many lie on the borders of their tiles
    assert len(normals.sort_into_tiles(normals.cut_tiles(whole, 60, 0.0), whole, 0.0)[0]) == len(whole)
    pairs = cKDTree(xyz).query_pairs(1.0, output_type="ndarray")
    listed = np.unique(numbers * len(xyz) + rows)
    own = inside.argmax(axis=0)
    for i, j in (pairs.T, pairs[:, ::-1].T):
        assert np.isin(own[i] * len(xyz) + j, listed).all()


def test_points_that_cannot_be_cut_apart_are_one_tile():
    assert len(normals.cut_tiles(np.zeros((1000, 3)), 10, 0.0)) == 1
    assert len(normals.cut_tiles(np.empty((0, 3)), 10, 1.0)) == 1
    assert len(normals.cut_tiles(np.repeat([[0, 0, 0], [0, 0, 9.0]], [1000, 1], axis=0), 10, 0.0)) == 2


@pytest.mark.parametrize(("gap", "edges"), [(0.0, 20), (1.2, 4)])
def test_edges_are_found_by_the_pulses_around(gap, edges):
    """Roofs 25 m above ground, in packets that reach 5 m: by brute force, and one lone echo is no surface.

    Also where the nearest ground lies almost as far from a roof as is looked for.
    """
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0, 20, (2, 900))
    x = np.where((x >= 9) & (x < 9 + gap), x + 2, x)
    level = np.stack([x, y, np.where(x < 9, 25.0, 0.0)], axis=1)
    ray = np.array([0.2, -0.1, -1.0]) / np.sqrt(1.05)
    points = level + (level[:, 2:] - 20.0) / ray[2] * ray * [1, 1, 0]
    points[0] = [points[0, 0], points[0, 1], -60.0]
    before, after = np.full(900, 2.0), np.full(900, 5.0)
    found = normals.find_edges(points, np.tile(ray, (900, 1)), np.arange(900.0), before, after, 0.5)
    flat = points[:, :2] - (points[:, 2:] - np.median(points[:, 2])) * ray[:2] / ray[2]
    apart = np.linalg.norm(flat[:, None] - flat, axis=2)
    most = 1.0 + np.median(np.sort(apart, axis=1)[:, 4])
    deeper = (points @ ray)[None] - (points @ ray)[:, None] > 5.0
    assert (found == ((deeper & (apart <= most)).sum(axis=1) > 1)).all() and edges < found.sum() < 200
    assert not found[points[:, 2] < 1].any()


def test_echoes_of_one_pulse_in_two_packets_share_its_light():
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(100)], axis=1)
    points = np.concatenate([points, points[[44]] + [0, 0, 30]])
    time = np.append(np.arange(100.0), 44.0)
    found = normals.find_edges(points, np.tile([0.0, 0, -1], (101, 1)), time, np.full(101, 2.0), np.full(101, 5.0), 0.2)
    assert np.flatnonzero(found).tolist() == [44, 100]


def test_a_step_is_no_tilt(rng):
    """A kerb of 15 cm: the plane through both levels rises by 5 degrees."""
    xyz = np.column_stack([rng.uniform(-6, 6, (4000, 2)), 0.02 * rng.standard_normal(4000)])
    xyz[:, 2] += 0.15 * (xyz[:, 0] > 0)
    down = np.tile([0, 0, -1.0], (len(xyz), 1))
    (angle, error), _ = normals.measure_normals(xyz, down, normals.Surroundings(xyz), **SETTINGS)
    near = np.isfinite(angle) & (np.abs(xyz[:, 0]) < 1.5) & (np.abs(xyz[:, 1]) < 4.4)
    assert np.sqrt(np.mean((angle[near] / error[near]) ** 2)) < 1.4
