"""Dense canopies: the survey takes no scene for noise, misfit, tail, slope or pulse."""

import numpy as np
import pytest

from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.surveying import survey_block
from wavebatch.surveying.auto_chain import choose_chain

SAMPLES, BEGIN, SIGMA, NOISE = 60, 5, 2.0, 1.2


def grow_canopy(seed, n=8000, density=0.5, tail=0.0):
    """Packets that begin BEGIN samples before their first echo: layers of leaves, each of which takes some light."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(15, SAMPLES - BEGIN - 10, n)
    number = rng.poisson(density * depth) + 1
    waveform, last = np.repeat(np.arange(n), number), np.cumsum(number) - 1
    first = np.r_[0, last[:-1] + 1]
    time = rng.random(len(waveform)) * depth[waveform]
    taken = rng.beta(1.0, 2.5, len(waveform))
    time[last] = depth
    time = time[np.lexsort((time, waveform))]
    taken[last] = rng.uniform(0.3, 1, n)
    passed = np.log1p(-np.minimum(taken, 0.999))
    before = np.cumsum(passed) - passed
    left = np.exp(before - np.repeat(before[first], number))
    amplitude = 150.0 * rng.lognormal(0, 0.4, n)[waveform] * taken * left
    time += BEGIN + rng.random(n)[waveform] - time[first][waveform]
    away = np.arange(SAMPLES) - time[:, None]
    pulse = np.exp(-0.5 * (away / SIGMA) ** 2) + tail * np.exp(-0.5 * ((away - 5) / (1.5 * SIGMA)) ** 2)
    signal = np.add.reduceat(amplitude[:, None] * pulse, first, axis=0)
    counts = np.rint(12 + signal + NOISE * rng.standard_normal(signal.shape))
    return WaveformBlock.from_samples(np.clip(counts, 0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def surveys():
    """The canopy, and the surveys of all of it and of a tile."""
    block = grow_canopy(1)
    half = len(block) // 2
    return block, [survey_block(part) for part in (block, block.rows(slice(0, half)))]


def test_a_canopy_is_no_noise_and_no_pulse(surveys):
    for survey in surveys[1]:
        system = survey.system
        assert system.sigma_ref * FWHM_PER_SIGMA == pytest.approx(SIGMA * FWHM_PER_SIGMA, rel=0.05)
        assert system.noise.std < 1.25 * NOISE and system.defects.slope_spread == 0 and not system.components
        assert system.misfit < 0.055 and max(share for _, share in system.tail_misfit) < 0.05


def test_echoes_of_a_canopy_are_found_with_the_survey_of_any_tile(surveys):
    """Of 2.8 that the true pulse and noise show; before, 2.1 were found."""
    block, found = surveys
    part = block.rows(slice(None, None, 4))
    for one in found:
        assert choose_chain(one).run(part, one.system).count(len(part)).mean() > 2.3


def test_a_tail_stays_in_the_pulse_of_a_canopy():
    system = survey_block(grow_canopy(1, n=4000, tail=0.06)).system
    assert len(system.components) > 1
