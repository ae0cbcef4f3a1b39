"""Calibration, backscatter and reflectance against the numbers of docs/algorithms.md 5 (T18), and their errors."""

import numpy as np
import pytest

from wavebatch.kernels.physics import radiometry
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio

BETA = 0.5e-3


@pytest.mark.parametrize(
    ("attenuation", "expected"),
    [
        (0.0, (2.626154e-8, 5.156441e-15, 1.389761, 0.401189, 0.133711, 1.203568)),
        (0.22, (2.496435e-8, 4.901738e-15, 1.418208, 0.409401, 0.136448, 1.228204)),
    ],
)
def test_the_numbers_of_the_specification(attenuation, expected):
    light = 500.0**2 * 60.0 * 2.0
    constant = 4 * 0.2 * np.cos(np.radians(10)) * float(radiometry.transmit(500.0, attenuation)) / light
    gamma = float(radiometry.backscatter(constant, 700.0, 45.0, 2.4, attenuation))
    angle = np.radians(30)
    found = (
        constant,
        constant * np.pi * BETA**2 / 4,
        gamma,
        float(radiometry.diffuse_reflectance(gamma, angle)),
        float(radiometry.compute_cross_section(gamma, 700.0, BETA)),
        gamma * np.cos(angle),
    )
    assert [f"{value:.6e}" for value in found[:2]] == [f"{value:.6e}" for value in expected[:2]]
    assert [f"{value:.6f}" for value in found[2:]] == [f"{value:.6f}" for value in expected[2:]]


@pytest.mark.parametrize(
    ("attenuation", "shares"),
    [(0.1, (0.977, 0.955, 0.871)), (0.22, (0.951, 0.904, 0.738)), (0.5, (0.891, 0.794, 0.501))],
)
def test_transmission(attenuation, shares):
    assert radiometry.transmit(np.array([500.0, 1000.0, 3000.0]), attenuation) == pytest.approx(shares, abs=6e-4)


def test_what_is_not_known_is_nan():
    distance = np.array([np.nan, 0.0, -5.0, np.inf, 700.0])
    gamma = radiometry.backscatter(2.6e-8, distance, np.full(5, 45.0), np.full(5, 2.4), 0.0)
    assert np.isfinite(gamma).tolist() == [False] * 4 + [True]
    assert np.isnan(radiometry.compute_cross_section(gamma, distance, BETA)[:4]).all()
    assert np.isnan(radiometry.diffuse_reflectance(1.0, np.radians([86.0, 90.0, 120.0]))).all()
    assert np.isnan(radiometry.energy_error(np.array([0.0, -3.0, 9.0]), np.array([2.0, 2.0, 0.0]), 0.1, 0.1)).all()


def test_float32_input_keeps_the_fourth_power():
    wide = radiometry.compute_cross_section(np.float32(1.0), np.float32(3000.0), BETA)
    assert wide.dtype == np.float64 and wide == pytest.approx(np.pi / 4 * 1.5**2, rel=1e-12)


def test_a_wrong_range_counts_four_times():
    none = np.zeros(1)
    section = radiometry.backscatter_error(none, np.array([500.0]), 1.0, 0.0, 0.0, power=4)
    gamma = radiometry.backscatter_error(none, np.array([500.0]), 1.0, 0.0, 0.0)
    assert section[0] == pytest.approx(0.008) and gamma[0] == pytest.approx(0.004)
    per_db = 2e-4 * np.log(10)  # air that is thicker than thought, and light that a wrong range sends through it
    in_air = radiometry.backscatter_error(none, np.array([500.0]), 1.0, 0.0, 0.5, attenuation_err=0.01)
    assert in_air[0] == pytest.approx(np.hypot(0.004 + 0.5 * per_db, 0.01 * 500 * per_db))


def test_errors_are_those_of_repeated_measurements():
    rng = np.random.default_rng(7)
    n, amplitude, sigma, distance, angle = 200_000, 60.0, 2.0, 500.0, np.radians(35)
    a_err, s_err, r_err, c_err, angle_err = 0.9, 0.03, 2.0, 0.02, np.radians(1.0)
    draw = rng.multivariate_normal(np.zeros(2), [[1, -1 / np.sqrt(3)], [-1 / np.sqrt(3), 1]], n)
    a, s = amplitude + a_err * draw[:, 0], sigma + s_err * draw[:, 1]
    r = distance + r_err * rng.standard_normal(n)
    gamma = radiometry.backscatter(2.6e-8 * (1 + c_err * rng.standard_normal(n)), r, a, s, 0.5)
    rho = radiometry.diffuse_reflectance(gamma, angle + angle_err * rng.standard_normal(n))
    energy = radiometry.energy_error(amplitude, sigma, a_err, s_err)
    relative = radiometry.backscatter_error(energy, distance, r_err, c_err, 0.5)
    assert relative == pytest.approx(np.std(gamma) / np.mean(gamma), rel=0.02)
    stated = radiometry.reflectance_error(relative, angle, angle_err)
    assert stated == pytest.approx(np.std(rho) / np.mean(rho), rel=0.02)
    section = radiometry.compute_cross_section(gamma, r, BETA)
    assert radiometry.backscatter_error(energy, distance, r_err, c_err, 0.5, power=4) == pytest.approx(
        np.std(section) / np.mean(section), rel=0.02
    )


@pytest.mark.parametrize(
    ("visibility", "wavelength", "expected"),
    # Koschmieder: 3.912 / V at 550 nm, 4.343 dB per unit; Kruse's exponents for haze, clear and very clear air.
    [(23.0, 550.0, 0.7387), (23.0, 1064.0, 0.3133), (100.0, 1064.0, 0.0591), (4.0, 1064.0, 2.3052)],
)
def test_attenuation_by_visibility(visibility, wavelength, expected):
    assert radiometry.attenuation_of_visibility(visibility, wavelength) == pytest.approx(expected, rel=2e-3)


@pytest.mark.quick_cases("any-0.3", "dense-1.0", "open-3.3")
@pytest.mark.parametrize("ratio", [0.3, 1.0, 3.3])
@pytest.mark.parametrize("cover", ["any", "dense", "open"])
def test_the_ratio_of_canopy_and_ground_is_told_from_shared_light(ratio, cover):
    """Pulse energy, leaves and soil vary from pulse to pulse; weak parts are not seen."""
    off = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        gap = rng.beta(*{"any": (1, 1), "dense": (0.6, 4), "open": (4, 0.6)}[cover], 2000)
        energy = 1000 * np.exp(0.05 * rng.standard_normal(2000))
        canopy = 0.3 * energy * (1 - gap) * np.exp(0.2 * rng.standard_normal(2000))
        ground = 0.3 / ratio * energy * gap * np.exp(0.15 * rng.standard_normal(2000))
        found = estimate_canopy_ratio(np.where(canopy < 12, 0, canopy), np.where(ground < 12, 0, ground))
        off.append((found.ratio - ratio) / found.error)
        assert found.error < 0.2 * ratio
    assert np.sqrt(np.mean(np.square(off))) < 2.5


def test_light_that_is_shared_alike_tells_no_ratio(rng):
    canopy, ground = np.full(500, 60.0), np.full(500, 40.0)
    assert estimate_canopy_ratio(canopy, ground) is None
    assert estimate_canopy_ratio(canopy + rng.standard_normal(500), ground + rng.standard_normal(500)) is None
    assert estimate_canopy_ratio(np.arange(50.0), 50 - np.arange(50.0)) is None
    assert estimate_canopy_ratio(np.zeros(0), np.zeros(0)) is None
    assert estimate_canopy_ratio(np.full(500, np.nan), ground) is None
    assert estimate_canopy_ratio(np.zeros(500), ground) is None


def test_received_power_is_that_of_light_on_its_way():
    """Light on the footprint, scattered over the sphere, caught by the lens."""
    distance, reflectance, air = 900.0, 0.3, 0.4
    footprint = np.pi * (distance * BETA / 2) ** 2
    section = radiometry.spread_cross_section(reflectance, distance, BETA)
    assert section == pytest.approx(4 * reflectance * footprint)
    caught = 3.0 / footprint * section / (4 * np.pi * distance**2) * np.pi * (0.1 / 2) ** 2
    found = radiometry.receive_power(section, distance, transmitted=3.0, aperture=0.1, divergence=BETA, efficiency=0.7,
                          attenuation=air)  # fmt: skip
    assert found == pytest.approx(caught * 0.7 * 10 ** (-2 * distance / 1000 * air / 10))


def test_haze_is_the_mean_of_its_layers():
    z = np.linspace(1200.0, 4400.0, 20_001)
    usual = np.exp(-np.linspace(0.0, 700.0, 20_001) / 2000.0).mean()
    assert radiometry.mean_haze(1200.0, 4400.0) == pytest.approx(np.exp(-z / 2000.0).mean() / usual, rel=1e-4)
    assert radiometry.mean_haze(0.0, 700.0) == pytest.approx(1.0)
    assert radiometry.mean_haze(-300.0, 0.0) == radiometry.mean_haze(0.0, 0.0) > 1.0
