"""Sensor positions from rays: the table of docs/algorithms.md 5.1 (T19), flipped vectors, pairs, unknowns."""

import numpy as np
import pytest

from wavebatch.kernels.geometry.ray_convergence import fit_best, fit_sensor, range_error, sensor_at

START = np.array([5e5, 5.4e6, 1000.0])


def fly(pulses, window=0.5, view=60.0):
    """Times, sensor, direction and ground of pulses in a window: 60 m/s, a triangular scan of 50 Hz, 1000 m high."""
    time = np.linspace(0.0, window, pulses)
    late = (time - window / 2)[:, None]
    sensor = START + np.array([60.0, 0.0, 0.0]) * time[:, None] + 0.5 * np.array([0.3, 0.2, 0.3]) * late**2
    angle = np.radians(view / 2) * (4 * np.abs(time * 50 % 1 - 0.5) - 1)
    direction = np.stack([np.zeros(pulses), np.sin(angle), -np.cos(angle)], axis=1)
    return time, sensor, direction, sensor + direction * (sensor[:, 2] / np.cos(angle))[:, None]


def stored(direction):
    """As in a file: metres per ps in float32."""
    return (direction * 1.4986e-4).astype(np.float32).astype(np.float64)


def rms(values, axis=None):
    return np.sqrt(np.mean(np.square(values), axis=axis))


def score(order, points, pulses=10_000, repeats=1, view=60.0):
    """Root mean square errors of position (3,) and range, mean error of the height, predicted range error."""
    position, ranges, predicted = [], [], []
    for _ in range(repeats):
        time, sensor, direction, ground = fly(pulses, view=view)
        given = points(direction, ground)
        fit = fit_sensor(time, *given, order=order)
        found, _ = sensor_at(fit, time)
        position.append(found - sensor)
        ranges.append(np.linalg.norm(given[0] - found, axis=1) - np.linalg.norm(ground - sensor, axis=1))
        predicted.append(range_error(fit, time, direction))
    position = np.concatenate(position)
    return rms(position, axis=0), rms(ranges), float(np.mean(position[:, 2])), rms(predicted)


def assert_within(found, position, distance):
    """No error is more than 30 % above that of the table."""
    assert (found[0] < 1.3 * np.array(position)).all(), found[0]
    assert found[1] < 1.3 * distance


@pytest.mark.parametrize(
    ("order", "rounding", "position", "distance"),
    [(1, 0.001, (0.0028, 0.0019, 0.0028), 0.003), (2, 0.001, None, 0.0003), (2, 0.01, None, 0.003)],
)
def test_vectors_of_a_file(order, rounding, position, distance):
    found = score(order, lambda direction, ground: (np.round(ground / rounding) * rounding, stored(direction)))
    assert_within(found, position or 3 * (2e-5 if rounding == 0.001 else 2e-4,), distance)


def test_a_sensor_at_rest_is_the_only_large_error_and_says_so():
    found = score(0, lambda direction, ground: (ground, stored(direction)))
    assert found[0][0] == pytest.approx(8.7, rel=0.3)
    assert 0.5 < found[1] < 3.0
    assert found[3] > found[1]


@pytest.mark.parametrize(
    ("noise", "position", "distance"), [(1e-4, (0.003, 0.003, 0.007), 0.012), (1e-3, (0.015, 0.016, 0.059), 0.057)]
)
def test_noisy_directions(noise, position, distance):
    rng = np.random.default_rng(1)

    def points(direction, ground):
        return ground + 0.01 * rng.standard_normal(ground.shape), direction + noise * rng.standard_normal(ground.shape)

    assert_within(score(1, points, repeats=12), position, distance)


def pairs_of_returns(first, last):
    """Point, direction and weight of pulses with two returns; errors of the middle do not depend on the direction."""
    apart = last - first
    return 0.5 * (first + last), apart, np.einsum("ni,ni->n", apart, apart)


@pytest.mark.quick_cases("*-4000-*")
@pytest.mark.parametrize(
    ("apart", "rate", "position", "distance"),
    [
        (15.0, 4000, (0.033, 0.037, 0.108), 0.10),
        (15.0, 20_000, (0.013, 0.013, 0.057), 0.055),
        (5.0, 4000, (0.09, 0.09, 0.35), 0.33),
    ],
)
def test_pairs_of_returns(apart, rate, position, distance):
    rng = np.random.default_rng(int(apart))

    def points(direction, ground):
        first, last = (g + 0.01 * rng.standard_normal(ground.shape) for g in (ground - apart * direction, ground))
        return pairs_of_returns(first, last)

    found = score(1, points, pulses=rate // 2, repeats=40 if rate == 4000 else 25)
    assert found[0] == pytest.approx(position, rel=0.3)
    # The middle of a pair is half of their distance nearer: the error that the fit predicts is compared.
    assert found[3] == pytest.approx(distance, rel=0.3)


@pytest.mark.parametrize(("noise", "limit"), [(0.03, 0.5), (0.1, 1.6)])
def test_noise_does_not_pull_the_sensor_down(noise, limit):
    rng = np.random.default_rng(2)

    def points(direction, ground):
        first, last = (g + noise * rng.standard_normal(ground.shape) for g in (ground - 5.0 * direction, ground))
        return pairs_of_returns(first, last)

    assert abs(score(1, points, pulses=2000, repeats=30)[2]) < limit


def test_the_predicted_error_is_that_found():
    rng = np.random.default_rng(3)
    time, sensor, direction, ground = fly(2000)
    errors, predicted = [], []
    for _ in range(60):
        fit = fit_sensor(time, ground, direction + 1e-3 * rng.standard_normal(ground.shape), order=2)
        found, _ = sensor_at(fit, time)
        errors.append(np.linalg.norm(ground - found, axis=1) - np.linalg.norm(ground - sensor, axis=1))
        predicted.append(range_error(fit, time, direction))
    assert rms(predicted) == pytest.approx(rms(errors), rel=0.2)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_flipped_vectors(share):
    time, sensor, direction, ground = fly(4000)
    turned = np.random.default_rng(4).random(4000) < share
    fit = fit_sensor(time, np.round(ground, 2), stored(np.where(turned[:, None], -direction, direction)))
    assert np.abs(sensor_at(fit, time)[0] - sensor).max() < 0.009


def test_outliers_are_left_out():
    rng = np.random.default_rng(5)
    time, sensor, direction, ground = fly(2000)
    wrong = rng.choice(2000, 100, replace=False)
    direction = direction.copy()
    direction[wrong] += rng.normal(0.0, 0.3, (100, 3))
    fit = fit_sensor(time, ground, direction)
    assert np.abs(sensor_at(fit, time)[0] - sensor).max() < 0.01


def test_velocity():
    time, _, direction, ground = fly(2000)
    _, velocity = sensor_at(fit_sensor(time, ground, direction), np.array([0.25]))
    assert velocity[0] == pytest.approx([60.0, 0.0, 0.0], abs=1e-3)


def test_the_best_order_follows_what_the_data_can_tell():
    time, sensor, direction, ground = fly(4000)
    exact = fit_best(time, ground, stored(direction))
    assert len(exact.coefficients) == 3
    short = fit_best(time[:4], ground[:4], stored(direction[:4]))
    assert short is None
    noisy = fit_best(time, ground, direction + 2e-2 * np.random.default_rng(6).standard_normal(ground.shape))
    assert noisy is None or np.abs(sensor_at(noisy, time)[0] - sensor).max() < 30


@pytest.mark.parametrize("view", [0.0, 0.5])
def test_parallel_rays_meet_nowhere(view):
    time, _, direction, ground = fly(2000, view=view)
    assert not fit_sensor(time, ground, direction + 1e-5).is_sound
    assert fit_best(time, ground, direction) is None


def test_hostile_input_says_nothing():
    nothing = np.full((5, 3), np.nan)
    for time, point, direction in [
        (np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))),
        (np.zeros(5), np.zeros((5, 3)), np.zeros((5, 3))),
        (np.zeros(5), nothing, nothing),
        (np.zeros(500), np.zeros((500, 3)), np.ones((500, 3))),
        (np.full(500, np.inf), np.ones((500, 3)), np.ones((500, 3))),
    ]:
        assert not fit_sensor(time, point, direction).is_sound
        assert fit_best(time, point, direction) is None
