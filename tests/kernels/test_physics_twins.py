"""Kernels of physics against slow twins: one echo after the other, on usual, extreme and impossible values."""

import itertools
import math

import naive_physics
import naive_signal
import numpy as np
import pytest

from wavebatch.kernels.physics import incidence, radiometry
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio
from wavebatch.kernels.physics.radiometry import judge_energies

HOSTILE = [math.nan, math.inf, -math.inf, 0.0, -5.0, 1e-30, 1e30]
BETA = 5e-4


def mixed(rng, low, high, n=60):
    """Values of a range, and hostile ones in random places."""
    values = rng.uniform(low, high, n)
    values[rng.permutation(n)[: len(HOSTILE)]] = HOSTILE
    return values


def one_by_one(twin, *columns):
    """The twin of every row; NaN where plain arithmetic has no answer."""
    found = []
    for row in zip(*(np.broadcast_to(column, (60,)).tolist() for column in columns), strict=True):
        try:
            found.append(twin(*row))
        except (ValueError, OverflowError, ZeroDivisionError):
            found.append(math.nan)
    return np.array(found)


def assert_equal(found, expected, rel=1e-9):
    """Where both are finite, equal; elsewhere neither is a plausible number."""
    finite = np.isfinite(expected)
    assert finite.sum() > 25
    np.testing.assert_allclose(found[finite], expected[finite], rtol=rel)
    assert (~np.isfinite(found) | (np.abs(found) > 1e25) | (found == 0))[~finite].all()


@pytest.fixture
def echoes(rng):
    return {
        "distance": mixed(rng, 50, 4000), "amplitude": mixed(rng, 3, 4000), "sigma": mixed(rng, 0.5, 9),
        "error": mixed(rng, 0.01, 2), "gamma": mixed(rng, 0, 3), "angle": rng.uniform(0, 1.7, 60),
    }  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
def test_radiometry_is_that_of_single_echoes(echoes):
    distance, amplitude, sigma, error, gamma, angle = echoes.values()
    usual = np.where(np.isfinite(distance) & (distance > 0), distance, 700.0).clip(1, 1e4)
    pairs = [
        ("transmit", (usual, 0.3)),
        ("backscatter", (2e-8, distance, amplitude, sigma, 0.3)),
        ("compute_cross_section", (gamma, distance, BETA)),
        ("diffuse_reflectance", (gamma, angle)),
        ("energy_error", (amplitude, sigma, 0.7, 0.02)),
        ("reflectance_error", (np.abs(error), angle, 0.03)),
    ]
    for name, columns in pairs:
        assert_equal(getattr(radiometry, name)(*columns), one_by_one(getattr(naive_physics, name), *columns))
    for power, air in ((2, 0.0), (4, 0.05)):
        found = radiometry.backscatter_error(0.02, usual, 3.0, 0.05, 0.2, power=power, attenuation_err=air)
        twin = naive_physics.backscatter_error
        assert_equal(found, one_by_one(twin, 0.02, usual, 3.0, 0.05, 0.2, power, air), rel=1e-6)


def test_received_power_is_that_of_light_on_its_way(rng):
    distance, section = rng.uniform(10, 5000, 60), rng.uniform(1e-4, 10, 60)
    device = {"transmitted": 3.0, "aperture": 0.1, "divergence": BETA, "efficiency": 0.7, "attenuation": 0.4}
    found = radiometry.receive_power(section, distance, **device)
    assert_equal(found, one_by_one(naive_physics.receive_power, section, distance, *device.values()))
    found = radiometry.spread_cross_section(0.3, distance, BETA)
    assert_equal(found, one_by_one(naive_physics.spread_cross_section, 0.3, distance, BETA))


@pytest.mark.parametrize("slope", [0.02, 0.2, 0.6])
@pytest.mark.parametrize("angle", [0.0, 0.1, 0.5])
def test_the_error_of_an_unknown_slope_is_that_over_its_directions(slope, angle):
    expected = naive_physics.slope_error(angle, slope)
    assert radiometry.slope_error(np.array([angle]), slope) == pytest.approx(expected, rel=1e-5)


def test_air_between_known_wavelengths_scatters_as_haze():
    """The ratio to 1064 nm is that of the power law, whose exponent is 1.3 for usual visibility."""
    for wavelength in (532.0, 905.0, 1064.0, 1550.0):
        expected = radiometry.AIR_ATTENUATION * (wavelength / 1064.0) ** -1.3
        assert radiometry.usual_attenuation(wavelength) == pytest.approx(expected)


def test_angles_and_spreads_are_those_of_single_echoes(rng):
    angle, distance = rng.uniform(0, 1.5, 60), rng.uniform(10, 4000, 60)
    spread = incidence.spread_of_angle(angle, distance, BETA)
    assert_equal(spread, one_by_one(naive_physics.spread_of_angle, angle, distance, BETA))
    assert_equal(incidence.angle_of_spread(spread, distance, BETA), angle)
    turned = incidence.angle_of_spread(-spread, distance, BETA)
    assert_equal(turned, one_by_one(naive_physics.angle_of_spread, -spread, distance, BETA))


def test_angles_of_variances_are_those_of_single_echoes(rng):
    error, distance = mixed(rng, 0.01, 1.0), mixed(rng, 300, 900)
    variance = rng.normal(0, 1, 60) * rng.choice([0.03, 1.0, 40.0], 60)
    variance[rng.permutation(60)[:3]] = math.nan, math.inf, 1e7
    found = incidence.angles_of_variance(variance, error, distance, 1.1e-3)
    for row in range(60):
        expected = naive_physics.angle_of_variance(variance[row], error[row], distance[row], 1.1e-3)
        assert (found[0][row], found[1][row]) == pytest.approx(expected, nan_ok=True, rel=1e-9), row


@pytest.mark.parametrize("threshold", [2.0, 4.0])
def test_angles_above_a_threshold_are_those_of_the_conditional_law(rng, threshold):
    over, error = np.r_[0.01, 0.05, rng.uniform(0.1, 7.9, 20), 9.0, 40.0, 1e4], rng.uniform(0.1, 1.0, 25)
    variance, distance = error * (threshold + over), rng.uniform(300, 900, 25)
    found = incidence.angles_above(variance, error, distance, 1.1e-3, threshold)
    for row in range(25):
        expected = naive_physics.angle_above(variance[row], error[row], distance[row], 1.1e-3, threshold)
        assert (found[0][row], found[1][row]) == pytest.approx(expected, nan_ok=True, rel=2e-3), row


@pytest.mark.parametrize(("exponent", "causal"), [(1, True), (2, False)])
def test_spread_pulses_are_those_of_an_integral(exponent, causal):
    spread, tau = np.array([0.3, 1.0, 6.0]), 0.8
    time, curves = incidence.spread_pulse(exponent, spread, tau, causal=causal)
    for wide, curve in zip(spread, curves, strict=True):
        top = int(np.argmax(curve))
        rows = np.linspace(np.flatnonzero(curve > 0.02)[0], np.flatnonzero(curve > 0.02)[-1], 12).astype(int)
        slow = [naive_physics.spread_pulse(time[i], exponent, wide, tau, causal) for i in (top, *rows)]
        # The half Gaussian counts its first sample whole: an error of a step of tau / 40.
        assert curve[rows] == pytest.approx(np.array(slow[1:]) / slow[0], abs=0.02 if causal else 1e-4)
        begin, end = naive_signal.lobe_edges(time, curve, 0.3)
        assert incidence.direct_width(time, curve, 0.3) == pytest.approx(end - begin)


@pytest.mark.parametrize("spacing", [0.5, 1.0])
def test_a_table_of_widths_is_that_of_scipy(spacing):
    """The pulse's length is such that its own fit has the width of the system."""
    table, tau = incidence.pulse_table(1.1, spacing), 0.7
    rows = [0, 15, 40, 60]
    for _ in range(3):
        time, curves = incidence.spread_pulse(2, table.spread[rows], tau)
        widths = [naive_physics.fitted_width(time, curve, spacing) for curve in curves]
        tau *= 1.1 / widths[0]
    assert table.width[rows] == pytest.approx(widths, rel=2e-3)


def test_the_printed_table_is_that_of_crossings():
    table, rows = incidence.paper_table(1.1), [0, 20, 50, 79]
    tau = 1.1 * 2.3548200450309493 / 3.5
    time, curves = incidence.spread_pulse(1, table.spread / math.sqrt(2), tau, causal=True)
    for row in rows:
        begin, end = naive_signal.lobe_edges(time, curves[row], math.exp(-2))
        assert table.width[row] == pytest.approx((end - begin) / 4)


def test_variances_by_tables_are_those_of_a_loop(rng):
    """Whole tables and those that end where widths stop growing; widths below, within and beyond them."""
    for falling in (False, True):
        spread = np.cumsum(rng.uniform(0.1, 1.0, 12))
        width = np.sqrt(1.3 + spread**2 * rng.uniform(0.9, 1.0, 12))
        width = np.maximum.accumulate(width) + 1e-3 * np.arange(12)
        if falling:
            width[7] = width[6]
        table = incidence.build_table(spread, width)
        end = next((i + 1 for i, (a, b) in enumerate(itertools.pairwise(width)) if b <= a), 12)
        assert table.spread.tolist() == spread[:end].tolist() and table.cut == falling == (end < 12)
        measured = np.r_[rng.uniform(0.1, 1.5 * width[-1], 60), width[0], table.width[-1]]
        found = incidence.spread_variance(table, measured)
        expected = [naive_physics.spread_variance(*table, one) for one in measured]
        assert found == pytest.approx(expected, nan_ok=True)


def shared_light(rng, n, ratio, scatter):
    gap = rng.beta(0.7, 1.0, n)
    energy = 500 * np.exp(scatter * rng.standard_normal(n))
    canopy, ground = energy * (1 - gap), energy / ratio * gap
    canopy[::40], ground[7::40] = 30 * canopy[::40], 0.0
    canopy[3::90], ground[5::70] = np.nan, -1.0
    return canopy, ground


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
