"""Angles from widths, cross sections, reflectances, air, and their errors."""

import numpy as np
import pytest

from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.physics import incidence, radiometry
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio

HEIGHT, BETA, LENGTH = 640.0, 1.1e-3, 1.5
DEGREES = np.array([5, 10, 20, 30, 45, 60, 75.0])
SPREADS = incidence.spread_of_angle(np.radians(DEGREES), HEIGHT, BETA)


def widths(table):
    """Widths at e^-2 [ns] that a table has for the spreads of DEGREES."""
    return 4 * np.interp(SPREADS, table.spread, table.width)


def test_spread_is_that_of_a_footprint_full_of_photons():
    rng = np.random.default_rng(3)
    n, w = 200_000, HEIGHT * BETA / 2
    x, y = rng.normal(0.0, w / 2, (2, n))
    table = {5: 0.1027, 10: 0.2069, 20: 0.4274, 30: 0.678, 45: 1.172, 60: 2.036, 80: 6.67}
    for degrees, printed in table.items():
        slope = np.tan(np.radians(degrees))
        ray = np.stack([x / HEIGHT, y / HEIGHT, np.ones(n)])
        distance = HEIGHT / (1.0 - slope * ray[0]) * np.sqrt((ray**2).sum(axis=0))
        spread = float(incidence.spread_of_angle(np.radians(degrees), HEIGHT, BETA))
        assert spread == pytest.approx(np.std(2 * distance / 0.299792458), rel=0.01)
        assert spread == pytest.approx(printed, rel=0.01)


def test_angle_is_the_inverse_of_spread():
    assert np.degrees(incidence.angle_of_spread(SPREADS, HEIGHT, BETA)) == pytest.approx(DEGREES)


def test_widths_of_the_corrected_pulse():
    time, curves = incidence.spread_pulse(2, SPREADS, LENGTH / 3.3946780749849567)
    direct = [incidence.direct_width(time, curve, np.exp(-2.0)) for curve in curves]
    assert direct == pytest.approx([2.6815, 2.8070, 3.2490, 3.9250, 5.5356, 8.6708, 17.7907], rel=0.005)


def test_table_of_fitted_widths():
    table = incidence.pulse_table(2.5364 / 4, 0.05)
    assert not table.cut
    assert widths(table)[1:] == pytest.approx([2.7000, 3.1547, 3.8598, 5.5076, 8.6620, 17.7894], rel=0.005)


def test_table_of_the_printed_formulas():
    expected = [1.9259, 1.9725, 2.1257, 2.3534, 2.8934, 3.9601, 7.1218]
    assert widths(incidence.paper_table(LENGTH / 2.3548200450309493)) == pytest.approx(expected, rel=0.005)


def test_gaussian_closed_form():
    closed = 4 * np.hypot(LENGTH / 2.3548200450309493, SPREADS)
    assert closed == pytest.approx([2.5809, 2.6792, 3.0683, 3.7209, 5.3432, 8.5244, 17.7121], rel=0.005)


@pytest.mark.parametrize("spacing", [0.5, 1.0])
def test_widths_lead_back_to_the_spread(spacing):
    table = incidence.pulse_table(1.3, spacing)
    assert table.width[0] == pytest.approx(1.3)
    wide = np.array([0.5, 1.0, 3.0, 10.0, 25.0])
    found = np.sqrt(incidence.spread_variance(table, np.interp(wide, table.spread, table.width)))
    assert found == pytest.approx(wide, rel=0.002)
    assert incidence.spread_variance(table, np.array([1.2]))[0] < 0
    assert np.sqrt(incidence.spread_variance(table, np.array([300.0]))[0]) == pytest.approx(300.0, rel=1e-3)


def test_a_table_that_falls_is_cut():
    spread = np.arange(6.0)
    table = incidence.build_table(spread, np.array([1.0, 1.2, 1.5, 1.4, 1.6, 2.0]))
    assert table.cut
    assert table.spread.tolist() == [0, 1, 2]
    assert np.isnan(incidence.spread_variance(table, np.array([1.45, 1.55]))).tolist() == [False, True]
    # The literal h: the wider the angle, the shorter the pulse.
    assert incidence.build_table(spread, 2.0 - 0.1 * spread).width.tolist() == [2.0]


def test_no_angle_where_nothing_is_known_or_beyond_80_degrees():
    variance = np.array([np.nan, 1.0, 1.0, 1.0, 1e6, -0.3])
    error = np.array([0.1, np.nan, 0.1, 0.1, 0.1, 0.1])
    distance = np.array([640.0, 640.0, np.nan, -1.0, 640.0, 640.0])
    angle, angle_err = incidence.angles_of_variance(variance, error, distance, BETA)
    assert np.isfinite(angle).tolist() == np.isfinite(angle_err).tolist() == [False] * 5 + [True]
    assert angle[5] == 0.0
    assert angle_err[5] == pytest.approx(float(incidence.angle_of_spread(0.543 * np.sqrt(0.1), 640.0, BETA)))


@pytest.mark.parametrize(
    ("snr", "expected"),
    [
        (20, (7.2, 5.9, 6.4, 6.2, 5.3, 4.6, 5.4, 8.5)),
        (50, (4.5, 3.9, 3.4, 2.2, 1.9, 1.7, 2.0, 2.7, 6.1)),
        (100, (3.2, 2.7, 1.5, 1.1, 0.9, 0.9, 1.0, 1.3, 2.1)),
        (300, (1.8, 1.0, 0.5, 0.4, 0.3, 0.3, 0.3, 0.4, 0.7)),
    ],
)
def test_errors_of_angles(snr, expected):
    rng = np.random.default_rng(snr)
    n, own = 20_000, 0.637
    for degrees, rms in zip((0, 5, 10, 15, 20, 30, 45, 60, 75), expected, strict=False):
        true = np.radians(degrees)
        sigma = np.hypot(own, incidence.spread_of_angle(true, HEIGHT, BETA))
        amplitude = snr * np.cos(true) * own / sigma
        found = sigma + bound_time(amplitude, sigma, 1.0, 1.0) * rng.standard_normal(n)
        error = bound_time(amplitude, np.maximum(found, 0.2), 1.0, 1.0)
        angle, angle_err = incidence.angles_of_variance(found**2 - own**2, 2 * found * error, np.full(n, HEIGHT), BETA)
        off = angle - true
        # The published table has one digit after the point: what rounding hides is not held against it.
        assert np.degrees(np.sqrt(np.nanmean(off**2))) == pytest.approx(rms, rel=0.2, abs=0.05)
        if snr >= 50 and degrees <= 60:
            assert np.mean(np.abs(off) <= angle_err) == pytest.approx(0.683, abs=0.02)


@pytest.mark.parametrize("root", np.r_[np.linspace(0.0, 3.0, 31), 4.0, 6.0])
def test_errors_hold_whatever_the_true_angle_is(root):
    """By quadrature over the normal law of the variance: no bin of angles pays for another, not even that of 0."""
    u = np.linspace(root**2 - 6.0, root**2 + 6.0, 20_001)
    weight = np.exp(-0.5 * (u - root**2) ** 2)
    # A tiny beam, so that angles are as good as proportional to the spread.
    near = 1e-3 / float(incidence.spread_of_angle(1.0, HEIGHT, BETA))
    known = u * near**2, np.full(len(u), near**2), np.full(len(u), HEIGHT), BETA
    angle, angle_err = incidence.angles_of_variance(*known)
    inside = np.abs(angle - float(incidence.angle_of_spread(root * near, HEIGHT, BETA))) <= angle_err
    assert weight[inside].sum() / weight.sum() == pytest.approx(0.683, abs=0.012)


@pytest.mark.parametrize("root", [1.5, 1.8, 2.0, 2.5, 4.0])
def test_angles_above_a_threshold_hold_for_the_echoes_that_are_seen(root):
    """True variances of root^2 errors, of which 2 % to all lie above 4: plain angles are off by up to 1.9 errors."""
    u = np.linspace(4.0, root**2 + 8.0, 40_001)[1:]
    weight = np.exp(-0.5 * (u - root**2) ** 2)
    near = 1e-3 / float(incidence.spread_of_angle(1.0, HEIGHT, BETA))
    one, height = np.full(len(u), near**2), np.full(len(u), HEIGHT)
    angle, error = incidence.angles_above(u * near**2, one, height, BETA, 4.0)
    true = float(incidence.angle_of_spread(root * near, HEIGHT, BETA))
    share = weight[angle < true].sum() / weight.sum()
    assert share == pytest.approx(0.5, abs=0.01)
    assert 0.6 < weight[np.abs(angle - true) <= error].sum() / weight.sum() < 0.77
    plain = incidence.angles_of_variance(u * near**2, one, height, BETA)[0]
    if root < 1.9:
        assert weight[plain < true].sum() / weight.sum() < 0.01
    assert (error > 0).all()


BEAM = 0.5e-3


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
        constant * np.pi * BEAM**2 / 4,
        gamma,
        float(radiometry.diffuse_reflectance(gamma, angle)),
        float(radiometry.compute_cross_section(gamma, 700.0, BEAM)),
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
    assert np.isnan(radiometry.compute_cross_section(gamma, distance, BEAM)[:4]).all()
    assert np.isnan(radiometry.diffuse_reflectance(1.0, np.radians([86.0, 90.0, 120.0]))).all()
    assert np.isnan(radiometry.energy_error(np.array([0.0, -3.0, 9.0]), np.array([2.0, 2.0, 0.0]), 0.1, 0.1)).all()


def test_float32_input_keeps_the_fourth_power():
    wide = radiometry.compute_cross_section(np.float32(1.0), np.float32(3000.0), BEAM)
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
    section = radiometry.compute_cross_section(gamma, r, BEAM)
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
    footprint = np.pi * (distance * BEAM / 2) ** 2
    section = radiometry.spread_cross_section(reflectance, distance, BEAM)
    assert section == pytest.approx(4 * reflectance * footprint)
    caught = 3.0 / footprint * section / (4 * np.pi * distance**2) * np.pi * (0.1 / 2) ** 2
    found = radiometry.receive_power(section, distance, transmitted=3.0, aperture=0.1, divergence=BEAM, efficiency=0.7,
                          attenuation=air)  # fmt: skip
    assert found == pytest.approx(caught * 0.7 * 10 ** (-2 * distance / 1000 * air / 10))


def test_haze_is_the_mean_of_its_layers():
    z = np.linspace(1200.0, 4400.0, 20_001)
    usual = np.exp(-np.linspace(0.0, 700.0, 20_001) / 2000.0).mean()
    assert radiometry.mean_haze(1200.0, 4400.0) == pytest.approx(np.exp(-z / 2000.0).mean() / usual, rel=1e-4)
    assert radiometry.mean_haze(0.0, 700.0) == pytest.approx(1.0)
    assert radiometry.mean_haze(-300.0, 0.0) == radiometry.mean_haze(0.0, 0.0) > 1.0
