"""An echo is known or it is not there: what errors that hold more than noise leave of a decomposition."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.decompose.solve import CLUSTER, FACTOR, _find_unknown
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.noise import pooled

N, SIGMA, STD = 600, 2.0, float(np.hypot(1, 1 / np.sqrt(12)))
SYSTEM = SystemPulse(SIGMA, noise=ReceiverNoise(baseline=20.0, std=STD))


def record(*echoes, seed=1, first=40):
    """Waveforms of echoes (height, widths after the first), noise of 1 count."""
    rng = np.random.default_rng(seed)
    place, x = first + rng.random(N), np.arange(96)
    y = 20 + rng.standard_normal((N, 96))
    for height, after in echoes:
        y += height * np.exp(-0.5 * ((x - place[:, None]) / SIGMA - after) ** 2)
    return WaveformBlock.from_samples(np.rint(y).astype(np.uint16))


def find(block, system=SYSTEM, level_err=None):
    noise = pooled(block, system)
    noise = noise if level_err is None else replace(noise, baseline_err=np.full(len(block), level_err, np.float32))
    return adaptive(block, noise, system, maximum(block, noise, system))


@pytest.mark.parametrize(("height", "variance", "number"), [(12.0, 0.0, 2), (12.0, 400.0, 1), (5.0, 12.0, 1)])
def test_an_echo_that_more_than_noise_explains_is_left_out(height, variance, number):
    """Beside 200 counts: sure in noise, but not where as much is left beside strong echoes."""
    block, system = record((200.0, 0.0), (height, 3.0)), replace(SYSTEM, beside=((-20.0, variance), (20.0, variance)))
    found = find(block, system)
    assert (found.count(N) == number).mean() > 0.9
    assert (found.amplitude >= found.amplitude_err).all() and found.count(N).min() >= 1
    lone = found.alone(N)
    assert not (found.flags[lone] & int(EchoFlag.OVERLAPPED)).any()
    # What the level's error does to a fit it does to the fit again, too.
    known, free = (np.median(one.amplitude_err[one.amplitude > 100]) for one in (found, find(block, system, 5.0)))
    assert abs(free / known - 1) > 0.04 and known < 4
    # The fit again has its own covariances: an energy is at most as sure as its amplitude.
    strong = found.take(found.amplitude > 100)
    assert np.median(strong.relative_energy_err * strong.amplitude / strong.amplitude_err) > 0.99


def test_echoes_are_asked_again_where_their_errors_grew_by_more_than_a_tenth():
    """Since they were asked: by 5 and 20 %, and by 5 % in noise 20 % larger. The strong echo beside each is known."""
    table = EchoTable.build(np.repeat(np.arange(3), 2), np.arange(6.0), np.resize([100.0, 2.0], 6), np.full(6, SIGMA),
                            amplitude_err=np.full(6, 2.5))  # fmt: skip
    table = table.with_attributes(**{CLUSTER: table.waveform, FACTOR: np.repeat([1.05, 1.2, 1.26], 2)})
    settings = SimpleNamespace(known=1.0)
    assert _find_unknown(table, settings, np.array([1.0, 1.0, 1.2])).tolist() == [0.0, 1.2, 0.0]


def test_rows_stay_sorted_and_other_waveforms_as_they_are():
    """Half of the waveforms hold echoes that are asked again: the others are those of a block without them."""
    system = replace(SYSTEM, beside=((-20.0, 400.0), (20.0, 400.0)))
    pairs, lone = record((200.0, 0.0), (12.0, 3.0)), record((200.0, 0.0), (150.0, 9.0), seed=2)
    both = WaveformBlock.from_samples(np.stack([pairs.samples, lone.samples], axis=1).reshape(2 * N, -1))
    found, alone = find(both, system), find(lone, system)
    assert (np.diff(found.waveform) >= 0).all()
    assert (np.diff(found.time)[np.diff(found.waveform) == 0] > 0).all()
    own = found.take(found.waveform % 2 == 1)
    for name in ("time", "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err", "flags"):
        np.testing.assert_array_equal(getattr(own, name), getattr(alone, name))
    assert found.attributes == {}


def test_no_pulse_loses_its_only_echo():
    """Clipped or far from the pulse, with errors above the amplitude: a cluster's last echo stays."""
    block = record((300.0, 0.0), (300.0, 1.0), (300.0, 2.0), (300.0, 3.0))
    clipped = replace(SYSTEM, saturation=60.0, beside=((-20.0, 1e4), (20.0, 1e4)), misfit=0.2)
    cut = WaveformBlock.from_samples(np.minimum(block.samples, 60))
    assert find(cut, clipped).count(N).min() >= 1


def test_no_faint_tail_hides_weak_echoes_of_a_broad_pulse():
    """2 counts in noise of 1 under a pulse of 8 samples: 8 standard deviations, 70 samples after an echo of 60.

    The tail there is a thousandth of a count. Such echoes were left out: they had to be 2.2 noises of one sample high.
    """
    rng, x = np.random.default_rng(3), np.arange(200)
    system = replace(SYSTEM, sigma_ref=8.6, components=((1.0, 0.0, 8.0), (0.1, 14.0, 14.0)))
    y, place = 20 + rng.standard_normal((N, 200)), 60 + rng.random(N)[:, None]
    for height, after in ((60.0, 0), (2.0, 70)):
        for weight, delay, sigma in system.components:
            y += height * weight * np.exp(-0.5 * ((x - place - after - delay) / sigma) ** 2)
    found = find(WaveformBlock.from_samples(np.rint(y).astype(np.uint16)), system)
    assert (found.count(N) >= 2).mean() > 0.95


def test_an_echo_alone_that_its_neighbour_explains_is_left_out():
    """In a cluster of its own, 9 widths after the strong one, and no higher than its error there."""
    block = record((200.0, 0.0), (8.0, 9.0))
    found = find(block, replace(SYSTEM, beside=((-40.0, 900.0), (40.0, 900.0))))
    assert (found.count(N) == 1).mean() > 0.95 and (found.amplitude >= found.amplitude_err).all()
    assert (find(block).count(N) == 2).mean() > 0.95


def test_an_echo_alone_stays_where_only_noise_hides_its_amplitude():
    """Half a width of it is recorded, and no stronger echo explains it."""
    found = find(record((20.0, 0.0), first=-4.0))
    assert np.count_nonzero(found.amplitude < found.amplitude_err) > 10


def test_noise_that_cuts_a_broad_faint_echo_makes_no_two():
    """It may have two maxima with a gap between their runs: 4 % were two echoes, narrow and at the bound."""
    rng, n, x = np.random.default_rng(1), 1000, np.arange(160)
    height, place = np.exp(rng.uniform(np.log(1.8), np.log(6), (n, 1))), 80 + rng.random((n, 1))
    y = 20 + 2 * (height * np.exp(-0.5 * ((x - place) / 7) ** 2) + rng.standard_normal((n, 160)))
    system = SystemPulse(7.0, noise=ReceiverNoise(baseline=20.0, std=2.02))
    block = WaveformBlock.from_samples(np.rint(y).astype(np.uint16))
    noise = pooled(block, system)
    found = maximum(block, noise, system)
    assert np.count_nonzero(found.count(n) > 1) > 80
    number = find(block, system).count(n)
    assert np.count_nonzero(number > 1) < 5 and np.count_nonzero(number == 0) < 5


def test_no_echo_is_left_out_for_a_broad_one_that_is_none():
    """Pulses that rise slowly, in noise that grows: of two 11 widths apart 93 % became the first one alone."""
    rng, x = np.random.default_rng(4), np.arange(200.0)
    place, y = 90 + rng.random((N, 1)), 60 + 2 * rng.standard_normal((N, 200))
    for height, after in ((17_000, 0), (4700, 68)):
        lag = x - place - after
        y += height * np.where(lag < 0, np.exp(lag / 10), np.exp(-0.5 * (lag / 3) ** 2))
    system = SystemPulse(6.3, noise=ReceiverNoise(baseline=60.0, std=2.0, gain=11.0), misfit=0.0077)
    found = find(WaveformBlock.from_samples(np.rint(y).astype(np.uint16)), system)
    assert (found.count(N) >= 2).all()
