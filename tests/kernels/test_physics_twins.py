"""Kernels of physics against slow twins: one echo after the other, on usual, extreme and impossible values."""

import math

import naive_physics
import numpy as np
import pytest

from wavebatch.kernels.physics import incidence
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio
from wavebatch.kernels.physics.radiometry import judge_energies


@pytest.mark.parametrize("threshold", [2.0, 4.0])
def test_angles_above_a_threshold_are_those_of_the_conditional_law(rng, threshold):
    over, error = np.r_[0.01, 0.05, rng.uniform(0.1, 7.9, 20), 9.0, 40.0, 1e4], rng.uniform(0.1, 1.0, 25)
    variance, distance = error * (threshold + over), rng.uniform(300, 900, 25)
    found = incidence.angles_above(variance, error, distance, 1.1e-3, threshold)
    for row in range(25):
        expected = naive_physics.angle_above(variance[row], error[row], distance[row], 1.1e-3, threshold)
        assert (found[0][row], found[1][row]) == pytest.approx(expected, nan_ok=True, rel=2e-3), row


def shared_light(rng, n, ratio, scatter):
    gap = rng.beta(0.7, 1.0, n)
    energy = 500 * np.exp(scatter * rng.standard_normal(n))
    canopy, ground = energy * (1 - gap), energy / ratio * gap
    canopy[::40], ground[7::40] = 30 * canopy[::40], 0.0
    canopy[3::90], ground[5::70] = np.nan, -1.0
    return canopy, ground


@pytest.mark.quick_cases("80-*", "130-*")
@pytest.mark.parametrize(("n", "ratio", "scatter"), [(160, 0.4, 0.1), (160, 2.5, 0.3), (80, 1.0, 0.1), (130, 1.0, 2.5)])
def test_the_ratio_of_canopy_and_ground_is_that_of_a_loop(rng, n, ratio, scatter):
    """Outliers, pulses that know nothing, too few of them, and light that is all chance."""
    canopy, ground = shared_light(rng, n, ratio, scatter)
    found, expected = estimate_canopy_ratio(canopy, ground), naive_physics.estimate_canopy_ratio(canopy, ground)
    assert (found is None) == (expected is None) == (n == 80 or scatter > 1)
    if found is not None:
        assert found.ratio == pytest.approx(expected[0], rel=2e-3)
        assert found.error == pytest.approx(expected[1], rel=0.015)


def test_energies_are_judged_as_by_a_loop(rng):
    """True ones, logs that are a pulse early or late, shuffled ones, constant ones; some pulses are not known."""
    seen = set()
    for turn in range(30):
        energy = np.exp(rng.choice([0.002, 0.05, 0.3]) * rng.standard_normal(200))
        light = energy * np.repeat(rng.uniform(1, 5, 20), 10) * np.exp(0.03 * rng.standard_normal(200))
        light[rng.permutation(200)[:6]] = 0.0, math.nan, math.inf, -3.0, 1e-9, 1e9
        given = [energy, np.roll(energy, 1), np.roll(energy, -1), rng.permutation(energy), np.ones(200)][turn % 5]
        given = np.where(rng.random(200) < 0.05, np.nan, given)
        with np.errstate(invalid="ignore"):
            found = judge_energies(light, given)
        expected = naive_physics.judge_energies(light.tolist(), given.tolist())
        assert {"": "", "early": "too early", "late": "too late", "others": "other pulses"}[expected] in found
        assert bool(found) == bool(expected)
        seen.add(expected)
    assert seen == {"", "early", "late", "others"}
