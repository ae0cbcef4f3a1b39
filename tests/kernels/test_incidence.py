"""Angles from widths: the tables of docs/algorithms.md 1.4 (T9), the footprint by Monte Carlo, errors that are kept."""

import numpy as np
import pytest

from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.physics import incidence

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
