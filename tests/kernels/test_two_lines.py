"""Points on two scan lines: any two parallel lines are in a plane, so their plane proves nothing."""

import numpy as np
import pytest
from commands import refuses

from wavebatch.kernels.geometry.normals import Gap, Surroundings, measure_normals
from wavebatch.kernels.geometry.planes import in_two_lines

DOWN = np.array([0.0, 0.0, -1.0])


def lines(rng, number, *, apart=1.2, turned=0.0, jitter=0.03, n=16, sets=300):
    """u, v and set of points on parallel lines."""
    along = rng.uniform(-1.5, 1.5, (sets, n))
    across = apart * (np.arange(n) % number) + rng.normal(0, jitter, (sets, n))
    a, b = np.cos(turned), np.sin(turned)
    return (a * along - b * across).ravel(), (b * along + a * across).ravel(), np.repeat(np.arange(sets), n)


def on_two_lines(u, v):
    """Whether coordinates across one of 24 directions have hardly more than two values, or hardly any breadth."""
    least = np.inf
    for angle in np.pi * np.arange(24) / 24:
        across = np.cos(angle) * (u - u.mean()) + np.sin(angle) * (v - v.mean())
        variance = np.mean(across**2)
        least = min(least, np.mean(across**4) / variance**2 - np.mean(across**3) ** 2 / variance**3 - 1)
    narrow, long = np.linalg.eigvalsh(np.cov(u, v, bias=True))
    return least < 0.1 or narrow < 0.01 * long


def test_sets_on_two_lines_are_those_of_a_loop(rng):
    n = rng.integers(4, 20, 400)
    number, group = np.repeat(rng.integers(1, 5, 400), n), np.repeat(np.arange(400), n)
    turned = np.repeat(rng.uniform(0, np.pi, 400), n)
    along, across = rng.uniform(-1.5, 1.5, n.sum()), rng.integers(0, number) + rng.normal(0, 0.1, n.sum())
    u, v = np.cos(turned) * along - np.sin(turned) * across, np.sin(turned) * along + np.cos(turned) * across
    found = in_two_lines(u, v, group, 401)  # the last set has no point
    expected = [on_two_lines(u[group == one], v[group == one]) for one in range(400)]
    assert found.tolist() == [*expected, False]
    assert 50 < sum(expected) < 350
    refuses(ValueError, "no set", in_two_lines, u, v, group, 399)


@pytest.mark.parametrize("degrees", range(0, 180, 13))
def test_two_lines_are_found_in_any_direction_and_three_are_not(rng, degrees):
    assert in_two_lines(*lines(rng, 2, turned=np.radians(degrees)), 300).mean() > 0.98
    for number in (3, 4, 7):
        assert in_two_lines(*lines(rng, number, turned=np.radians(degrees)), 300).mean() < 0.01


@pytest.mark.parametrize("degrees", range(0, 180, 13))
def test_one_line_is_found_in_any_direction(rng, degrees):
    assert in_two_lines(*lines(rng, 1, turned=np.radians(degrees)), 300).all()


def test_one_scan_line_has_no_plane(rng):
    """Level ground, seen by one sweep: the plane through its noise stood upright, 70 degrees off with an error of 4."""
    along, across = np.arange(300) * 0.2, np.full(300, 0.0)
    points = np.stack([along, across + 2e-3 * rng.standard_normal(300), 0.02 * rng.standard_normal(300)], axis=1)
    ray = np.tile([0.0, 0.25, -1.0], (300, 1))
    _, gap = measure_normals(points, ray, Surroundings(points), radius=1.5, min_points=8, max_error=5.0)
    assert (gap == Gap.FEW_NEIGHBOURS).mean() > 0.9 and not (gap == Gap.KNOWN).any()


@pytest.mark.parametrize(("n", "most"), [(8, 0.04), (10, 0.01), (16, 0.001)])
def test_points_at_random_are_rarely_two_lines(rng, n, most):
    u, v = rng.uniform(-1, 1, (2, 5000 * n))
    assert in_two_lines(u, v, np.repeat(np.arange(5000), n), 5000).mean() <= most


def gable(spacing):
    """Points on a roof of 40 degrees, in scan lines along its ridge, 0.3 m apart in them; the rest is far away."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(-8.5, 9) * spacing, np.arange(-30, 31) * 0.3))
    return np.stack([x, y, -np.abs(x) * np.tan(np.radians(40))], axis=1)


def test_the_lines_on_both_sides_of_a_ridge_are_no_level_plane():
    points = gable(1.2)
    inner = np.abs(points[:, 1]) < 6
    ridge = points[inner & (np.abs(points[:, 0]) < 1)]
    (angle, error), gap = measure_normals(
        ridge, np.tile(DOWN, (len(ridge), 1)), Surroundings(points), radius=1.5, min_points=8, max_error=5.0
    )
    known = gap == Gap.KNOWN
    assert (np.abs(angle[known] - 40) < 5 * error[known]).all(), "it was level, with an error below a degree"
    wide = points[inner & (np.abs(points[:, 0]) > 3) & (np.abs(points[:, 0]) < 6)]
    (angle, error), gap = measure_normals(
        wide, np.tile(DOWN, (len(wide), 1)), Surroundings(points), radius=2.5, min_points=8, max_error=5.0
    )
    assert (gap == Gap.KNOWN).all() and angle == pytest.approx(40, abs=0.5)
