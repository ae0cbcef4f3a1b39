"""Planes of small surfaces along rays: errors that hold, outliers that do not pull, lines that know no angle."""

import math

import naive
import numpy as np
import pytest

from wavebatch.kernels.geometry.planes import LINE_ERROR, fit_facet

DOWN = np.array([[0.0, 0.0, -1.0]])


def test_without_outliers_it_is_the_least_squares_plane(rng):
    uv = rng.uniform(-5, 5, (200, 2)) * [1.0, 0.3]
    w = 0.3 * uv[:, 0] - 0.2 * uv[:, 1] + 0.02 * rng.uniform(-1, 1, 200)
    facet = fit_facet(np.column_stack([uv, -w]), np.repeat(DOWN, 200, axis=0))
    slope, variance = naive.fit_slope(uv, w, LINE_ERROR)
    assert facet.kept.all()
    assert facet.normal[:2] / facet.normal[2] == pytest.approx(slope, abs=1e-9)
    steep = math.hypot(*slope)
    error = math.sqrt(slope @ variance @ slope) / steep / (1 + steep**2)
    assert facet.angle_error == pytest.approx(error, rel=0.02)
    assert facet.facing_error == pytest.approx(steep * error, rel=0.05)


@pytest.mark.slow
def test_the_error_of_a_plane_holds_its_error(rng):
    """Two scan lines at any distance, each a centimetre off: the angle's error in units of the stated one."""
    ratios = []
    for _ in range(300):
        apart, k = rng.uniform(0.1, 3.0), 20
        line = np.arange(2 * k) % 2
        u, v = rng.uniform(-3, 3, 2 * k), apart * line
        slope = rng.uniform(-0.6, 0.6, 2)
        w = slope[0] * u + slope[1] * v + rng.normal(0, 0.01, 2)[line] / math.sqrt(2) + rng.normal(0, 0.02, 2 * k)
        facet = fit_facet(np.column_stack([u, v, -w]), np.tile([0.0, 0.0, -1.0], (2 * k, 1)))
        true = math.atan(math.hypot(*slope))
        if np.isfinite(facet.angle_error):
            ratios.append((facet.angles(DOWN)[0] - true) / facet.angle_error)
    within = np.mean(np.abs(ratios) < 1)
    assert len(ratios) > 250 and 0.6 < within < 0.92


def test_rays_in_a_line_know_no_angle(rng):
    u = rng.uniform(-3, 3, 100)
    xyz = np.column_stack([u, 0.3 * u, 0.1 * u + rng.normal(0, 0.02, 100)])
    facet = fit_facet(xyz, np.tile([0.0, 0.0, -1.0], (100, 1)))
    assert math.isinf(facet.angle_error) and math.isinf(facet.facing_error)


def test_a_car_on_the_target_does_not_tilt_it(rng):
    uv = rng.uniform(-5, 5, (400, 2))
    car = (uv[:, 0] > 1) & (np.abs(uv[:, 1]) < 3)
    w = 0.2 * uv[:, 0] + rng.normal(0, 0.01, 400) - 1.5 * car
    facet = fit_facet(np.column_stack([uv, -w]), np.tile([0.0, 0.0, -1.0], (400, 1)))
    assert not facet.kept[car].any() and facet.kept[~car].mean() > 0.99
    assert facet.angles(DOWN)[0] == pytest.approx(math.atan(0.2), abs=2e-3)
