"""Sensor positions, rays and return numbers against slow twins, on random, weak and hostile pulses."""

import naive_geometry
import numpy as np
import pytest

from wavebatch.kernels.geometry.group_returns import fit_rays, number_returns
from wavebatch.kernels.geometry.ray_convergence import fit_best, fit_sensor, range_error, sensor_at


def fly(rng, pulses, noise=3e-4, view=50.0, height=700.0):
    """Times, points, directions and weights of pulses in a quarter of a second; every tenth direction is noisier."""
    time = np.sort(rng.uniform(3.0, 3.25, pulses))
    sensor = np.array([4e5, 5.2e6, height + 100]) + np.outer(time - 3.1, [55.0, 20.0, 0.5])
    side, ahead = np.radians(view / 2) * rng.uniform(-1, 1, pulses), np.radians(view / 16) * rng.uniform(-1, 1, pulses)
    direction = np.stack([np.tan(ahead), np.tan(side), -np.ones(pulses)], axis=1)
    point = sensor + direction * rng.uniform(0.9, 1.0, pulses)[:, None] * height
    spread = np.where(np.arange(pulses) % 10 == 0, 4.0, 1.0) * noise
    return time, point, direction + spread[:, None] * rng.standard_normal((pulses, 3)), (noise / spread) ** 2


def assert_same_fit(found, expected):
    for name in ("centre", "half", "distance", "residual", "condition", "spread"):
        assert getattr(found, name) == pytest.approx(expected[name], rel=2e-3), name
    error = np.sqrt(np.diag(found.covariance)).reshape(found.coefficients.shape)
    assert (np.abs(found.coefficients - expected["coefficients"]) < 0.02 * error).all()
    np.testing.assert_allclose(found.covariance, expected["covariance"], rtol=0.01, atol=1e-3 * error.max() ** 2)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_a_path_is_that_of_scipy(rng, order):
    """With outliers, opposite signs, pulses that know nothing, and lengths of directions as in a file."""
    time, point, direction, weight = fly(rng, 150)
    point[::25] += 30 * rng.standard_normal((6, 3))
    direction *= rng.choice([-1.5e-4, 1.5e-4], 150)[:, None]
    direction[7], point[8, 1], direction[9, 2], time[10] = 0.0, np.nan, np.inf, np.nan
    found = fit_sensor(time, point, direction, weight, order)
    expected = naive_geometry.fit_sensor(time, point, direction, weight, order)
    assert found.pulses == 146 and found.is_sound
    assert_same_fit(found, expected)
    unit = direction[:5] / np.linalg.norm(direction[:5], axis=1)[:, None]
    position, velocity = sensor_at(found, time[:5])
    errors = range_error(found, time[:5], unit)
    for row in range(5):
        place, speed = naive_geometry.sensor_at(expected, time[row])
        assert position[row] == pytest.approx(place, abs=0.02 * errors[row])
        assert velocity[row] == pytest.approx(speed, abs=0.1 * errors[row] / found.half)
        assert errors[row] == pytest.approx(naive_geometry.range_error(expected, time[row], unit[row]), rel=0.01)


@pytest.mark.parametrize(
    ("noise", "view", "order"),
    [(1e-5, 50.0, 2), (3e-4, 50.0, 1), (8e-3, 50.0, 1), (0.02, 20.0, None), (1e-5, 1.0, None)],
)
def test_the_order_is_that_of_the_least_error(rng, noise, view, order):
    """Exact directions show an acceleration, noisy ones a speed at most, and noise or parallel ones nothing."""
    time, point, direction, weight = fly(rng, 120, noise, view)
    found = fit_best(time, point, direction, weight)
    expected = naive_geometry.fit_best(time, point, direction, weight)
    assert (None if found is None else len(found.coefficients) - 1) == expected
    assert expected == order


def test_numbers_along_rays_are_those_of_a_loop(rng):
    """Two rays of a pulse that differ (the first one counts), equal places, and pulses without any ray."""
    for _ in range(20):
        m = int(rng.integers(1, 25))
        pulse = rng.integers(0, 7, m)
        direction = rng.normal(size=(m, 3)) * (rng.random(m) < 0.6)[:, None]
        xyz = np.array([4e5, 5e6, 300.0]) + rng.integers(0, 3, (m, 3))
        found = list(zip(*(values.tolist() for values in number_returns(pulse, xyz, direction)), strict=True))
        assert found == naive_geometry.number_returns(pulse, xyz, direction)


@pytest.mark.parametrize("pulses", [10, 120])
def test_rays_follow_their_pulse_or_the_scan_angles_of_their_line(rng, pulses):
    """Two flight lines with pitches of their own; one pulse goes sideways, one upwards, and two are far off."""
    count = np.tile([1, 2, 3, 2], pulses // 2)
    starts, line = np.cumsum(count) - count, np.arange(len(count)) // pulses
    angle, ahead = rng.uniform(-30, 30, len(count)), np.array([0.1, -0.2])[line]
    angle[4] = 89.0  # counts as 80
    way = np.stack([0.9 * np.tan(np.radians(angle.clip(-80, 80))), ahead, -np.ones(len(count))], axis=1)
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    apart = np.where(np.arange(len(count)) % 3, 3.0, 0.2)  # between returns [m]; rays of their own from .5 m on
    unit[1], unit[5] = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    unit[7], unit[9] = [0.8, 0.0, -0.6], [0.0, 0.8, -0.6]
    pulse = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(pulse)) - starts[pulse]
    xyz = np.array([4e5, 5e6, 300.0]) + unit[pulse] * (apart[pulse] * number)[:, None]
    found = fit_rays(xyz, starts, angle[pulse], line[pulse])
    own = (count - 1) * apart >= 0.5
    np.testing.assert_allclose(found[own], unit[own], atol=1e-6)
    fitted = way / np.linalg.norm(way, axis=1)[:, None] if pulses > 20 else [[0.0, 0.0, -1.0]] * len(count)
    np.testing.assert_allclose(found[~own], np.array(fitted)[~own], atol=1e-6)
    assert 0.3 < own.mean() < 0.7
