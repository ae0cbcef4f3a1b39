"""What receivers do to waveforms besides noise: tails, spikes, transients, patterns, slopes, clipped tops."""

import numpy as np
import pytest

from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import STAGES
from wavebatch.stages.chain_file import load_profile
from wavebatch.stages.score import match_echoes
from wavebatch.surveying import survey_block, survey_blocks

BASE = 12.0


def bell(x):
    return np.exp(-0.5 * x * x)


def render(pulse, seed, *, n=3000, s=80, amplitude=(15, 200), place=(0.3, 0.55), width=2.0, second=0.0):
    """Signal (n, s) of one echo per waveform and of a second one in a share of them; their rows, times, amplitudes."""
    rng = np.random.default_rng(seed)
    rows = np.r_[np.arange(n), np.flatnonzero(rng.random(n) < second)]
    time = rng.uniform(place[0] * s, place[1] * s, len(rows))
    time[n:] = time[rows[n:]] + rng.uniform(6 * width, 0.9 * s - time[rows[n:]])
    height = np.exp(rng.uniform(*np.log(amplitude), len(rows)))
    signal = np.zeros((n, s))
    np.add.at(signal, rows, height[:, None] * pulse((np.arange(s) - time[:, None]) / width))
    return signal, rows, time, height


def digitize(signal, seed, *, noise=0.7, base=BASE, top=255):
    """Counts of a signal with white noise; base: broadcasts to (n, s)."""
    exact = signal + base + noise * np.random.default_rng(seed + 1000).standard_normal(signal.shape)
    return WaveformBlock.from_samples(np.clip(np.rint(exact), 0, top).astype(np.uint8 if top < 256 else np.uint16))


def decompose(block):
    """System and echoes of the default chain."""
    system = survey_block(block).system
    return system, load_profile("accurate").run(block, system)


def compare(echoes, rows, time, tolerance=2.0):
    """Shares of the true echoes that are found and of the found ones that are true, and the matches."""
    order = np.lexsort((time, rows))
    truth = type(echoes).build(rows[order].astype(np.int32), time[order], np.ones(len(rows)), np.ones(len(rows)))
    match = match_echoes(echoes, truth, tolerance)
    return len(match.found) / len(rows), len(match.found) / max(len(echoes), 1), match


def error_before(block, system, echoes, widths=7.0):
    """Mean of the samples before the first echo, less the baseline."""
    baseline = STAGES["noise.pooled"].function(block, system).baseline
    first = np.full(len(block), np.inf)
    np.minimum.at(first, echoes.waveform, echoes.time)
    before = np.arange(block.samples.shape[1]) * block.spacing < (first - widths * system.sigma_ref)[:, None]
    return float((block.samples - baseline[:, None])[before].mean())


def tailed(share, length):
    """A pulse with an exponential tail of `length` widths, smooth where it begins."""
    return lambda x: bell(x) + share * np.exp(-np.maximum(x - 2, 0) / length) / (1 + np.exp(-3 * (x - 1.5)))


@pytest.mark.parametrize(("share", "length"), [(0.012, 30.0), (0.03, 8.0), (-0.012, 30.0)])
def test_tails_are_no_baseline(share, length):
    """Long tails, positive and negative: the level is that before the pulse, the tail the pulse's."""
    signal, rows, time, _ = render(tailed(share, length), 1, amplitude=(60, 200))
    block = digitize(signal, 1)
    system, echoes = decompose(block)
    assert abs(error_before(block, system, echoes)) < 0.2 and abs(system.baseline - BASE) < 0.2
    found, true, _ = compare(echoes, rows, time)
    assert found > 0.995 and true > 0.985


@pytest.mark.parametrize("strip", ["riegl", "leica"])
def test_samples_before_the_pulse_agree_with_the_baseline(strip, request):
    with StripReader(request.getfixturevalue(strip)) as reader, reader.scan() as scan:
        blocks = list(reader.sample_blocks(scan, 4000))
    system = survey_blocks(blocks).system
    block = max(blocks, key=len)
    assert abs(error_before(block, system, load_profile("accurate").run(block, system))) < 0.2


def test_ordinary_strips_keep_all_quiet_samples():
    signal, *_ = render(bell, 2, second=0.5)
    assert survey_block(digitize(signal, 2)).system.recovery == 0


def optech(x):
    """A steep front and a tail, as Optech's receivers give."""
    return (bell(x) + 0.15 * bell((x - 1.6) / 1.2) + 0.02 * bell((x - 4.2) / 1.6)) / 1.04


@pytest.mark.parametrize("seed", [3, 4])
def test_clipped_tops_stay_one_echo(seed):
    """Amplitudes to four times the range of the digitizer, noise that rounding nearly hides, widened echoes too."""
    plain, rows, time, height = render(optech, seed, n=3000, s=100, width=3.0, amplitude=(8, 980))
    wide = render(optech, seed, n=3000, s=100, width=3.25, amplitude=(8, 980))[0]
    widened = np.random.default_rng(seed).random((3000, 1)) < 0.3
    block = digitize(np.where(widened, wide, plain), seed, noise=0.3, base=10)
    system, echoes = decompose(block)
    number, clipped = echoes.count(3000), height > 250
    assert system.saturation == 255 and len(system.components) > 1
    assert (number[clipped] == 1).mean() > 0.95 and (number[~clipped] == 1).mean() > 0.98
