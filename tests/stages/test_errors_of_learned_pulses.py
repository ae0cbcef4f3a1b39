"""Errors of amplitude, time and width against the scatter of fits, for learned pulses, alone and in pairs."""

import numpy as np
import pytest

from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.pulse_tables import error_factors, shape_limits
from wavebatch.surveying import survey_block

BASELINE, NOISE = 48.0, 4.0
SHAPES = {
    "gaussian": ((1.0, 0.0, 1.0),),
    "tailed": ((1.0, 0.0, 1.0), (0.55, 1.1, 1.32), (-0.25, -0.6, 0.7), (0.05, 4.0, 2.0)),
}
"""Weight, delay and sigma per component, in widths of the first."""


def pulse(shape, x, width):
    return sum(w * np.exp(-0.5 * ((x - d * width) / (s * width)) ** 2) for w, d, s in SHAPES[shape])


def measures(shape, width):
    """Peak, delay of the datum, and sigma of the main lobe, from a fine grid."""
    fine = np.linspace(-4 * width, 4 * width, 40_001)
    values = pulse(shape, fine, width)
    above = fine[values >= values.max() / 2]
    return values.max(), fit_one_gaussian(fine, values)[0], (above[-1] - above[0]) / FWHM_PER_SIGMA


def draw(shape, width, n, seed, apart=0.0, rho=0.0, unit=1.0):
    """Waveforms of an echo each, half of them with a second one `apart` FWHM later, and their truth (n, 2).

    unit: noise is NOISE, and a count one of these.
    """
    rng = np.random.default_rng(seed)
    peak, delay, sigma = measures(shape, width)
    x = np.arange(int(max(80, 36 * width)))
    time = rng.uniform(8 * width, len(x) - 22 * width, n)[:, None] + [0.0, apart * sigma * FWHM_PER_SIGMA]
    amplitude = np.exp(rng.uniform(np.log(240), np.log(480), (n, 1))) * np.c_[np.ones(n), rng.uniform(0.3, 0.7, n)]
    amplitude[:, 1] *= (apart > 0) & (np.arange(n) % 2 == 0)
    white = rng.standard_normal((n, len(x) + 1))
    y = BASELINE + NOISE * (white[:, 1:] + rho * white[:, :-1]) / np.sqrt(1 + rho * rho)
    for echo in range(2):
        y += amplitude[:, echo, None] / peak * pulse(shape, x - time[:, echo, None], width)
    block = WaveformBlock.from_samples(np.clip(np.rint(y / unit), 0, 65535).astype(np.uint16))
    return block, amplitude, time + delay, sigma


def scatter(block, system, amplitude, time, sigma, number):
    """Scatter of the fits of waveforms with `number` echoes over their errors: amplitude, time, sigma."""
    n = len(block)
    noise = Noise(np.full(n, system.noise.baseline, np.float32), np.full(n, system.noise.std, np.float32))
    echoes = adaptive(block, noise, system, maximum(block, noise, system))
    true = (amplitude > 0).sum(axis=1)
    right = (echoes.count(n) == number) & (true == number)
    echoes = echoes.take(np.flatnonzero(right[echoes.waveform]))
    assert len(echoes) > 0.9 * number * (true == number).sum()
    row, spacing = echoes.waveform, block.spacing
    place = np.arange(len(echoes)) % number
    off = (
        (echoes.amplitude - amplitude[row, place]) / echoes.amplitude_err,
        (echoes.time / spacing - time[row, place]) / (echoes.time_err / spacing),
        (echoes.sigma / spacing - sigma) / (echoes.sigma_err / spacing),
    )
    return [1.4826 * np.median(np.abs(value - np.median(value))) for value in off]


@pytest.mark.parametrize(("apart", "number"), [(0.0, 1), (1.0, 2), (1.5, 2)])
@pytest.mark.parametrize("width", [1.5, 5.0])
def test_errors_of_a_known_pulse_are_the_scatter_of_fits(width, apart, number):
    """The peak changes with the width: lone errors of the amplitude were up to 14 % small, those of pairs 20 %."""
    _, _, sigma = measures("tailed", width)
    first, *others = SHAPES["tailed"]
    components = tuple((w, d * width, s * width) for w, d, s in (first, *others))
    system = SystemPulse(sigma, noise=ReceiverNoise(baseline=BASELINE, std=NOISE), components=components)
    block, *truth = draw("tailed", width, 3000, 4, apart)
    assert scatter(block, system, *truth, number) == pytest.approx(np.ones(3), abs=0.1)


@pytest.mark.quick_cases("tailed-5.0-0.8")
@pytest.mark.parametrize("rho", [0.0, 0.8])
@pytest.mark.parametrize(("shape", "width"), [("gaussian", 2.0), ("gaussian", 6.0), ("tailed", 2.0), ("tailed", 5.0)])
def test_the_survey_finds_the_colour_of_the_noise(shape, width, rho):
    """It comes from the calm half of the waveforms, which lacks power: white noise had values of -0.05 to -0.02."""
    block, *truth = draw(shape, width, 4000, 5, rho=rho)
    system = survey_block(block).system
    correlation = np.array(system.noise.correlation)
    assert correlation[0] == pytest.approx(rho / (1 + rho * rho), abs=0.015)
    assert correlation[1:] == pytest.approx(np.zeros(len(correlation) - 1), abs=0.012)
    assert system.noise.by_kind["quiet"] == pytest.approx(NOISE, rel=0.015)
    assert scatter(block, system, *truth, 1) == pytest.approx(np.ones(3), abs=0.12)


@pytest.mark.quick_cases("5.4")
@pytest.mark.parametrize("unit", [5.0, 5.2, 5.4, 5.5])
def test_whole_counts_are_no_correlation_no_tail_and_no_less_noise(unit):
    """Where a count is more than the noise, medians are up to half a count off, and quantiles half of the spread."""
    block, *_ = draw("gaussian", 2.0, 4000, 6, unit=unit)
    system = survey_block(block).system
    assert not system.components
    assert system.noise.std == pytest.approx(np.hypot(NOISE / unit, 0.2887), rel=0.02)
    assert system.noise.correlation == pytest.approx(np.zeros(len(system.noise.correlation)), abs=0.02)
    assert system.noise.by_kind["quiet"] == pytest.approx(np.hypot(NOISE / unit, 0.2887), rel=0.02)


def test_factors_of_a_width_do_not_depend_on_the_others():
    """They are made only at the places of a table that lie beside a width."""
    system = SystemPulse(2.0, noise=ReceiverNoise(std=NOISE, correlation=(0.7, 0.4, 0.2)))
    limits = shape_limits(system, 1.0)
    widths = np.geomspace(limits.low, limits.high, 40)
    every = error_factors(system, 1.0, widths, np.full(40, 0.1))
    alone = [error_factors(system, 1.0, widths[i : i + 1], np.full(1, 0.1))[0] for i in range(40)]
    np.testing.assert_array_equal(alone, every)
    assert np.ptp(every, axis=0).min() > 0.1
