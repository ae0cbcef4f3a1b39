"""Echoes of mirrored residuals: how many of those that were found are false (docs/algorithms.md R2).

`settle` in choose_pulse.py calls it. Before you change it: it must need no truth and no second pulse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.frozen import frozen
from wavebatch.core.order import distinct
from wavebatch.core.units import FWHM_PER_SIGMA, SQRT_PI
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.filters import filter_energy, filter_symmetric, gaussian_taps
from wavebatch.stages.detect.direct import matched_filter, maximum
from wavebatch.stages.flags import RINGING_REACH
from wavebatch.stages.score import match_echoes
from wavebatch.surveying.measuring.judge import SEARCH, SURE, Explained
from wavebatch.surveying.measuring.misfit import MOST_FAINT
from wavebatch.surveying.measuring.noise_and_width import HOLDS
from wavebatch.surveying.measuring.residuals import find_echoes

STRONG = 30.0
"""Amplitude of a main echo, over the noise: a misfit of 3 % is then no more than noise."""

ZONE, SAME = 2.0, 1.0
"""Distance from a main echo up to which what is false is its misfit, and distance up to which an echo of the mirror is
that of the waveform [full widths at half maximum]."""

WORTH = 0.2
"""Echoes in the mirror per echo that is false: misfit that leaves an echo of one sign has no twin there."""

FALSE_QUIET = 0.0075
"""Share of the echoes that mirrored residuals may add in quiet stretches. A survey's user loses more points to a higher
threshold than these add: echoes of 4 to 6 noises are some 2 % of a scene's."""

HAIR = 0.05
"""Noises from a whole count up to which a sample of the mirror is one. In noise of less than a count few patterns of
counts are near a threshold, and a level .01 counts from a half put 57 that were found just below it in the mirror."""

FINE, STEP = 0.45, 1.5
"""Noise of quiet samples below which counts hardly change, and amplitude up to which an echo is one count high
[counts]: a bell through a row of equal counts is up to 1.3 times as high. Slow noise only steps up where its level lies
a quarter above a count. Such steps have no mirror, but all are one count high; of echoes as many are twice as high."""

LACK = 0.3
"""Share of the echoes within ZONE that a hole must be deeper than: neighbours that are not told apart leave less."""


@frozen
class Mirror:
    """Counts of echoes, and of those in the mirror that match none."""

    mains: int
    """Echoes above STRONG noises that are the strongest of their waveform."""
    beside: int
    """Unmatched ones within ZONE of a main echo."""
    echoes: int
    quiet: int
    """Unmatched ones further than ZONE from any echo."""

    @property
    def worth(self) -> float:
        """Echoes that are found, less those that are false by the mirror."""
        return self.echoes - (self.beside + self.quiet) / WORTH


def look_in_mirror(
    block: WaveformBlock, system: SystemPulse, explained: Explained, levels: Sequence[float] = (0.0,)
) -> Iterator[tuple[float, Mirror]]:
    """Decompose samples less twice their residual, and count the echoes that match none of the waveforms' own.

    Noise makes as many echoes up as down; so does a pulse that misses its echoes. Close targets are in the mirror too.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    explained : Explained
        The block decomposed with it.
    levels : sequence of float
        Least energies of an echo that are tried [standard deviations].

    Yields
    ------
    level : float
    mirror : Mirror
        Of the echoes that have this energy, by the detector that is worse off.
    """
    echoes = explained.echoes
    samples = (block.samples - 2 * explained.sums.left).astype(np.float32)
    whole = np.rint(samples)
    mirrored = replace(block, samples=np.where(np.abs(samples - whole) <= HAIR * system.noise.std, whole, samples))
    width = system.sigma_ref * FWHM_PER_SIGMA
    top = np.zeros(len(block), np.float32)
    np.maximum.at(top, echoes.waveform, echoes.amplitude)
    strong = (echoes.amplitude == top[echoes.waveform]) & (echoes.amplitude > STRONG * system.noise.std)
    mains = echoes.take(np.flatnonzero(strong))
    # Of the energy of echoes, as a decomposition asks for it, in standard deviations of noise.
    unit, false = np.sqrt(SQRT_PI / block.spacing) / system.noise.std, []
    # Chains find candidates by either detector, and the smoothing of one is broader than a narrow pulse. And their fits
    # have free levels: in short waveforms of wide pulses what known ones lack became wide echoes.
    options, steps = SEARCH | {"free_levels": True}, [(np.empty(0), np.empty(0))]
    for detect in (matched_filter, maximum):
        other = find_echoes(mirrored, system, detect, **options)[2]
        alone = np.ones(len(other), bool)
        alone[match_echoes(other, echoes, SAME * width).found] = False
        rest = other.take(np.flatnonzero(alone))
        energy = rest.amplitude * np.sqrt(rest.sigma) * unit
        near, far = ~_lie_far(rest, mains, ZONE * width), _lie_far(rest, echoes, ZONE * width)
        down = up = energy[far]
        # Only where it decides: the waveforms are decomposed once more.
        many = len(down) > FALSE_QUIET * len(echoes)
        if many or system.noise.quiet < FINE:
            own = find_echoes(block, system, detect, **options)[2]
            found = own.amplitude * np.sqrt(own.sigma) * unit
            up = found if many else up
            if system.noise.quiet < FINE:
                low = own.amplitude < STEP
                steps.append((found[low], found[~low & (own.amplitude < 2 * STEP)]))
        false.append((energy[near], down, up))
    energy = echoes.amplitude * np.sqrt(echoes.sigma) * unit
    for level in levels:
        quiet = max(int(np.count_nonzero(low >= level) - np.count_nonzero(high >= level)) for low, high in steps)
        for _, down, up in false:
            # Noise makes no more than there are of that size, within a factor of two and an error: what only goes down
            # makes none, as tails of echoes of 10,000 noises, far from them.
            lower, upper = (np.frexp(one[one >= level] / (level or 1.0))[1] for one in (down, up))
            pairs = [[np.count_nonzero(one == octave) for one in (lower, upper)] for octave in distinct(lower)]
            quiet = max(quiet, int(sum(min(below, above + above**0.5) for below, above in pairs)))
        beside = max(int(np.count_nonzero(one >= level)) for one, _, _ in false)
        yield level, Mirror(len(mains), beside, int(np.count_nonzero(energy >= level)), quiet)


def count_holes(system: SystemPulse, explained: Explained, spacing: float) -> int:
    """Count places where waveforms lie further below their echoes than noise or an error of the pulse can.

    Light only adds. Interference and bipolar spikes go down as often as up, where the mirror does not see them: beside
    the echoes that their upper halves became.

    Parameters
    ----------
    system : SystemPulse
    explained : Explained
        Waveforms decomposed with it.
    spacing : float
        Of their samples [ns].
    """
    sums, width = explained.sums, system.sigma_ref / spacing
    taps = gaussian_taps(width)
    energy = filter_energy(taps)
    left = np.where(sums.used, sums.left, np.float32(0))
    depth = np.pad(filter_symmetric(left.T, taps).T / np.float32(-energy), ((0, 0), (1, 1)))
    top = sums.model.max(axis=1, keepdims=True)
    least = np.maximum(HOLDS * system.noise.std / np.sqrt(energy), MOST_FAINT * top)
    middle = depth[:, 1:-1]
    row, place = np.nonzero((middle > least) & (middle >= depth[:, :-2]) & (middle > depth[:, 2:]))
    reach = int(np.ceil(ZONE * FWHM_PER_SIGMA * width))
    near = np.clip(place[:, None] + np.arange(-reach, reach + 1), 0, middle.shape[1] - 1)
    highest = sums.model[row[:, None], near].max(axis=1, initial=0.0)
    noise = HOLDS * np.sqrt((system.noise.std**2 + system.noise.gain * highest) / energy)
    deep = middle[row, place] > np.maximum(noise, LACK * highest)
    # Undershoots follow the strong echo that makes them, as near as ringing and as the filter reaches. Noise makes as
    # many holes elsewhere: more are not counted.
    at = np.arange(middle.shape[1])
    strong = np.maximum.accumulate(np.where((sums.model >= 0.5 * top) & (top > 0), at, -np.inf), axis=1)
    elsewhere = at - strong > RINGING_REACH * width + len(taps) - 1
    number = np.count_nonzero(deep & elsewhere[row, place])
    most = (number + SURE * np.sqrt(number + 1)) * middle.size / max(np.count_nonzero(elsewhere), 1)
    return int(min(np.count_nonzero(deep), most))


def _lie_far(rest: EchoTable, echoes: EchoTable, reach: float) -> np.ndarray:
    """Which echoes of the mirror lie beyond reach of all of these (m,)."""
    if not len(rest) or not len(echoes):
        return np.ones(len(rest), bool)
    span = float(max(rest.time.max(), echoes.time.max()) + 4 * reach)
    place = np.sort(echoes.waveform * span + echoes.time)
    at = rest.waveform * span + rest.time
    after = np.searchsorted(place, at)
    nearest = np.minimum(np.abs(place[np.minimum(after, len(place) - 1)] - at), np.abs(place[after - 1] - at))
    return nearest > reach
