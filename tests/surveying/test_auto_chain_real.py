"""The chain chosen for real strips against what their vendors found (point 3 of the release's judgement)."""

from typing import NamedTuple

import numpy as np
import pytest

from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import choose_chain, read_sample

AFTER_PULSE = (9.0, 12.0)
"""Where the RIEGL's after-pulse lies behind an echo [ns]; it has 4 % of its amplitude."""


class Found(NamedTuple):
    """What was found in a strip, per waveform (n,) and per return of the vendor (k,)."""

    returns: np.ndarray
    echoes: np.ndarray
    late: np.ndarray
    """An echo lies AFTER_PULSE behind one at least three times as strong, bool (n,)."""
    later_return: np.ndarray
    """Not the first of its packet, bool (k,)."""
    ghost: np.ndarray
    """The vendor's own after-pulse: AFTER_PULSE behind a return, where the samples reach no 8 % of it, bool (k,)."""
    matched: np.ndarray
    """An echo was found for it, bool (k,)."""


def _run(path) -> Found:
    parts = []
    with StripReader(path) as reader, reader.scan() as scan:
        survey = survey_blocks(read_sample(reader, scan))
        assert survey.system.components, "a learned pulse is what real strips need"
        chain = choose_chain(survey)
        for number in range(reader.unit_count()):
            for block, _ in reader.read_blocks(reader.read_unit(number, scan), 8192, owned_only=True):
                parts.append(_compare(block, chain.run(block, survey.system), survey.system.noise.baseline))
    return Found(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _compare(block, echoes, baseline) -> Found:
    n, returns = len(block), block.returns
    late = np.zeros(n, bool)
    for step in range(1, 6):
        gap = echoes.time[step:] - echoes.time[:-step]
        hit = (echoes.waveform[step:] == echoes.waveform[:-step]) & (gap > AFTER_PULSE[0]) & (gap < AFTER_PULSE[1])
        late[echoes.waveform[step:][hit & (echoes.amplitude[:-step] > 3 * echoes.amplitude[step:])]] = True
    order = np.lexsort((returns.time, returns.waveform))
    waveform, time = returns.waveform[order], returns.time[order]
    later = np.r_[False, waveform[1:] == waveform[:-1]]
    height = _height(block, waveform, time) - baseline
    behind = np.r_[0.0, np.diff(time)]
    ghost = later & (behind > AFTER_PULSE[0]) & (behind < AFTER_PULSE[1]) & (height < 0.08 * np.r_[1.0, height[:-1]])
    matched = np.isin(returns.point[order], echoes.attributes["point"])
    return Found(np.bincount(waveform, minlength=n), echoes.count(n), late, later, ghost, matched)


def _height(block, waveform, time) -> np.ndarray:
    """Largest of the samples within 1.5 ns of the times."""
    at = np.rint(time / block.spacing).astype(int)[:, None] + np.arange(-1, 2)
    return block.samples[waveform[:, None], np.clip(at, 0, block.samples.shape[1] - 1)].max(axis=1).astype(float)


def test_riegl(riegl):
    """Measured: exactly one echo in 95.5 % of 2,223 single-return packets, after-pulses in 0.1 % of them.

    Of 160 later returns 11 are not found, and every one of them is the vendor's own after-pulse of a strong echo.
    """
    found = _run(riegl)
    single = found.returns == 1
    assert single.sum() > 2000
    assert (found.echoes[single] == 1).mean() >= 0.93
    assert found.late[single].mean() < 0.005
    later = found.later_return
    assert later.sum() > 150 and found.ghost.sum() <= 0.08 * later.sum()
    assert found.matched[later & ~found.ghost].mean() >= 0.98
    assert found.matched[later].mean() >= 0.92
    assert found.matched.mean() >= 0.99


@pytest.mark.slow
def test_leica(leica):
    """Measured: exactly one echo in 97.8 % of 999 waveforms, where a Gaussian fit that grows splits almost all."""
    found = _run(leica)
    assert (found.returns == 1).all()
    assert (found.echoes == 1).mean() >= 0.97
    assert found.matched.mean() >= 0.995
