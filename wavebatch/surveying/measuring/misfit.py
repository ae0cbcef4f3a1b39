"""How far strong echoes may be from their pulse: what neither the description of waveforms nor the mirror shows of it.

`settle` in choose_pulse.py chooses the misfit; `raise_misfit` raises it, each step for one thing that false echoes have
and targets have not. The shares of doubtful echoes are also what a survey says of them (docs/algorithms.md R2, R3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.order import distinct, median, quantile
from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.stages.decompose.solve import PROVEN
from wavebatch.stages.flags import find_unexplained
from wavebatch.surveying.measuring.judge import SURE
from wavebatch.surveying.measuring.noise_and_width import FEW, MIN_SNR
from wavebatch.surveying.measuring.residuals import decompose_sample
from wavebatch.surveying.measuring.tails import PART, PLACES, REPEATED, TAIL_AFTER, list_lags
from wavebatch.surveying.systems.known_systems import MOST_DOUBTED

MISFIT_PEAK, ABOVE_NOISE = 4.0, 3.0
"""Largest difference of a pulse from its model over the misfit, which is a mean over the echo; and noises that an echo
must be high beside the strip's strongest ones, which taught the pulse."""

UNEXPLAINED, NEIGHBOURS = 0.05, 0.8
"""Share of clear echoes that may miss their samples in a dense canopy, whose echoes have so many neighbours APART:
neighbours too close to be found change the shape of some. Where neighbours are rare these are, in proportion."""

JUST, APART, MOST_PROVEN = 1.05, (1.5, 4.0), 0.5
"""How much more than PROVEN errors of its amplitude an echo may have that chi2 alone proves. Distances, in widths of
the pulse, between which most pairs are known as two. And nearer echoes that chi2 alone proves, over pairs so far apart,
beyond which some are none: in simulated scenes .15 at most, with pulses whose shape changes .6 to 5."""

WEAKER, REACH = 0.5, 15
"""Height over that of a stronger echo, and distance from it [system widths], up to which one may be a part of it."""

NEAREST, SAME_LAG, ASIDE, MERGED = 2.0, 0.25, (-1.0, -0.5, 0.5, 1.0), 2.75
"""Distance from which echoes of one lag, half as high as WEAKER at most, are counted: nearer ones merge. Distance up to
which lags are the same, as errors of the faintest echoes scatter them, and lags beside it where others are as often:
layers of a scene that scatter by .3 are there too. And distance below which the nearer of these merge [system
widths]."""

SAME_RATIO, CHANCE_RATIO = 0.3, 0.35
"""Difference of the logarithms of two ratios up to which they are alike, and share of ratios that are so by chance."""

MOST_REPEATED, MOST_LACKED = 0.05, 0.016
"""Share of the echoes that may repeat beside stronger ones once a misfit covers what does: of real strips .03 do. And
the largest misfit that does: more is a second target, as rows of crops have, and no error of six Gaussians."""

NOT_TOLD, AS_NARROW, MOST_MERGED = 0.5, 1.25, 0.01
"""Distance [system widths] below which no two echoes of less than thousands of noises are told apart, by any fit: with
free widths they differ from one by the cube of the distance. Width of either, over the system's, from which they are
targets of any shape: plants in a large footprint, 1.6 to 3 on LVIS. And share of the echoes that may be so near: in
simulated strips with the right pulse, of any scene, up to .009 are."""

MOST_HAVE, FIXED, ONE_PLACE, EQUAL, TRIGGERED = 0.5, 4.0, 1.2, 0.12, 12**-0.5
"""Share of the waveforms that have an echo at one sample, and at least one elsewhere, where the receiver makes the
first; errors of a time by which these lie apart; and scatter of times and amplitudes over their errors that shows no
target: behind a trigger it is 2.8 at an amplitude of 10 noises. And scatter of the amplitudes, as a share; and of times
behind a trigger [samples]."""

LEAST_MISFIT, MOST_MISFIT, STEP_OF_MISFITS = 0.0005, 0.128, 2**0.5
"""Misfits of a pulse: half a noise at 1,000 noises up to an eighth of the pulse, beyond which it is no pulse of this
strip; and step by which they are raised."""

MOST_FAINT = SystemPulse(1.0).faint_share
"""What a pulse of which no more is known may leave beside strong echoes."""

FAINT_REACH, NEARER, MIRRORED = 4.0, 2.0, 32
"""Widths of the pulse within which echoes may be faint, as in `stages.flags.unproven`; how many more of them than as
far beyond are no targets: of targets some half are so near, as they are found less often there; and most of them for
each that the mirror has beside strong ones: tails that change have 3 to 26, the bottom of shallow water hundreds."""

CELLS = (0.3, 0.4), (0.5, 0.7)
"""Half a place: in lags [widths of the pulse] and in logarithms of shares. Strong echoes show parts of a pulse in the
first, weak ones in the second."""

ASIDE_PLACES = -6, -4, -3, 3, 4, 6
"""How many half places beside it others are compared: targets are at other lags too, or of higher shares."""

LEAST_SHARE = 1e-4
"""Of an echo, below which none is found beside it."""


def limit_faint(system: SystemPulse, change: float, echoes: EchoTable) -> SystemPulse:
    """The system with the `faint_share` that its misfit and its noise leave, where that is less than it has.

    Parameters
    ----------
    system : SystemPulse
        With the misfit by the description.
    change : float
        Of the pulse from shot to shot or below the least misfit that is tried, as a share of the amplitude.
    echoes : EchoTable
        Of a sample.

    Returns
    -------
    SystemPulse
    """
    if not len(echoes):
        return system
    seen = ABOVE_NOISE * system.noise.std / max(quantile(echoes.amplitude, 0.99), 1e-9)
    return replace(system, faint_share=min(max(MISFIT_PEAK * max(system.misfit, change), seen), system.faint_share))


def raise_misfit(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, most: float, mirrored: float
) -> tuple[SystemPulse, EchoTable, tuple[float, float]]:
    """Raise the misfit for what neither the description of waveforms nor the mirror shows.

    From where it was chosen on the misfit alone is raised: twice or four times of it as `faint_share` lost echoes of
    canopies.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
        With the misfit by the description.
    echoes : EchoTable
        The block decomposed with it.
    most : float
        Misfit that the change of the pulse from shot to shot asks for.
    mirrored : float
        Echoes beside strong ones in the mirror, over those of its waveforms.

    Returns
    -------
    system : SystemPulse
    echoes : EchoTable
        The block decomposed with it.
    doubts : tuple of float
        Share of the clear echoes whose samples no misfit explains, and of all that repeated beside stronger ones.
    """
    misfit, left = cover_fits(system, echoes, block.spacing)
    if misfit > system.misfit:
        system = replace(system, misfit=misfit)
        echoes = decompose_sample(block, system)
    # Neither the description nor what fits leave shows a shape that changes, where two echoes describe it as well.
    while system.misfit < most and suspect_pairs(echoes, system.sigma_ref):
        system = replace(system, misfit=min(max(STEP_OF_MISFITS * system.misfit, LEAST_MISFIT), most))
        echoes = decompose_sample(block, system)
    repeated = share_repeated(echoes, system.sigma_ref)
    if repeated > MOST_DOUBTED:
        system, echoes = cover_share(block, system, echoes, share_repeated, MOST_REPEATED, MOST_LACKED)
    system, echoes = cover_share(block, system, echoes, share_merged, MOST_MERGED, MOST_MISFIT)
    covered = cover_faint(system, echoes, mirrored)
    if covered is not system:
        system, echoes = covered, decompose_sample(block, covered)
    return system, echoes, (left, repeated)


def cover_faint(system: SystemPulse, echoes: EchoTable, mirrored: float) -> SystemPulse:
    """The system with a `faint_share` above that of echoes that stand nearer to far stronger ones than targets do.

    A tail that changes from shot to shot leaves such echoes, all within FAINT_REACH, and dips as well, which the mirror
    shows. Targets are as often further off, or, as grass or the bottom of shallow water, make no dips.

    Parameters
    ----------
    system : SystemPulse
        With the `faint_share` that misfit and noise leave.
    echoes : EchoTable
        Of a sample, decomposed with it.
    mirrored : float
        Echoes beside strong ones in the mirror, over those of its waveforms.

    Returns
    -------
    SystemPulse
    """
    row, other, lag = list_lags(echoes, system.sigma_ref)
    distance = np.abs(lag)
    ratio = echoes.amplitude[row] / echoes.amplitude[other]
    faint = ratio < MOST_FAINT
    nearest = np.full(len(echoes), np.inf)
    np.minimum.at(nearest, row[faint], distance[faint])
    near = np.count_nonzero(nearest <= FAINT_REACH)
    far = np.count_nonzero(nearest <= 2 * FAINT_REACH) - near
    sure = near - NEARER * far >= SURE * np.sqrt(near + NEARER**2 * far)
    if near < FEW or not sure or near > MIRRORED * mirrored * len(echoes):
        return system
    share = quantile(ratio[faint & (distance <= FAINT_REACH)], 0.95)
    return replace(system, faint_share=min(max(share, system.faint_share), MOST_FAINT))


def cover_fits(system: SystemPulse, echoes: EchoTable, spacing: float) -> tuple[float, float]:
    """Find the misfit, from the system's own on, that explains what the fits of clear echoes leave.

    The description of waveforms alone does not see it where false echoes describe what the pulse misses of strong ones.
    Unless echoes alone in their waveform, where there are FEW, are explained: in a canopy neighbours too close to be
    found are left too.

    Parameters
    ----------
    system : SystemPulse
        With the misfit by the description.
    echoes : EchoTable
        Of a sample, decomposed with it.
    spacing : float
        Of the samples [ns].

    Returns
    -------
    misfit : float
    left : float
        Share of the clear echoes, or of those alone, whose samples it does not explain; 0 with too few of them.
    """
    clear = echoes.amplitude > MIN_SNR * system.noise.std
    if np.count_nonzero(clear) < FEW:
        return system.misfit, 0.0
    row, _, lag = list_lags(echoes, system.sigma_ref)
    distance = np.abs(lag)
    apart = np.count_nonzero(clear[row] & (distance >= APART[0]) & (distance < APART[1]))
    hidden = UNEXPLAINED * min(apart / np.count_nonzero(clear) / NEIGHBOURS, 1.0)
    alone = clear & echoes.alone(int(echoes.waveform.max()) + 1)
    groups = [alone, clear] if np.count_nonzero(alone) >= FEW else [clear]
    while True:
        missed = find_unexplained(echoes, system, spacing) > 1
        for group in groups:
            number, expected = np.count_nonzero(missed[group]), hidden * np.count_nonzero(group)
            left = number / np.count_nonzero(group)
            if left <= UNEXPLAINED and number <= expected + SURE * np.sqrt(expected + 1):
                return system.misfit, left
        if system.misfit >= MOST_MISFIT:
            return system.misfit, left
        system = replace(system, misfit=max(STEP_OF_MISFITS * system.misfit, LEAST_MISFIT))
        groups = [clear]


def suspect_pairs(echoes: EchoTable, width: float) -> bool:
    """Say whether more close echoes are proven by chi2 alone than targets of this strip can be.

    Parameters
    ----------
    echoes : EchoTable
        Of a sample.
    width : float
        Of the system pulse [ns].

    Notes
    -----
    Two echoes nearer than a width are of two targets, or of one whose pulse has another shape: chi2 cannot tell. But
    where targets are so near, others are a little further APART, where each of them is known.
    """
    doubtful = (echoes.flags & np.uint16(EchoFlag.OVERLAPPED)) != 0
    doubtful &= echoes.amplitude < JUST * PROVEN * echoes.amplitude_err
    row, _, lag = list_lags(echoes, width)
    distance = np.abs(lag)
    proven = np.count_nonzero(doubtful[row] & (distance < APART[0]))
    apart = np.count_nonzero((distance >= APART[0]) & (distance < APART[1]))
    return bool(proven > MOST_PROVEN * apart / 2)


def cover_share(
    block: WaveformBlock,
    system: SystemPulse,
    echoes: EchoTable,
    share: Callable[[EchoTable, float], float],
    allowed: float,
    most: float,
) -> tuple[SystemPulse, EchoTable]:
    """Find the least misfit with which no larger share of the echoes is doubtful than allowed.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    echoes : EchoTable
        The block decomposed with it.
    share : callable
        `share_repeated` or `share_merged`.
    allowed : float
    most : float
        The largest misfit that is tried.

    Returns
    -------
    system : SystemPulse
        As it was where no misfit helps: a part of the pulse far from its peak is none (`find_parts`).
    echoes : EchoTable

    Notes
    -----
    Six Gaussians miss the onset of a skewed pulse by a thousandth. Of 10,000 noises two echoes in place of each
    describe that far shorter, and fits miss nothing.
    """
    higher, found = system, echoes
    while share(found, system.sigma_ref) > allowed:
        if higher.misfit >= most:
            return system, echoes
        higher = replace(higher, misfit=min(max(STEP_OF_MISFITS**2 * higher.misfit, LEAST_MISFIT), most))
        found = decompose_sample(block, higher)
    return higher, found


def share_merged(echoes: EchoTable, width: float) -> float:
    """Share of echoes, beyond chance, that lie nearer to another one than two can be told, both as narrow as a pulse.

    A pulse that changes from shot to shot, or that is stretched where its model is made rounder, is described by two.
    """
    row, other, lag = list_lags(echoes, width)
    near = (np.abs(lag) < NOT_TOLD) & (np.maximum(echoes.sigma[row], echoes.sigma[other]) < AS_NARROW * width)
    number = len(distinct(row[near]))
    return max(number - SURE * float(np.sqrt(number)), 0.0) / max(len(echoes), 1)


def share_repeated(echoes: EchoTable, width: float) -> float:
    """Twice the share of the echoes that, beyond chance, stand beside stronger ones, all at one lag and one ratio; or
    the share that does at one lag, whatever the ratio, where that is more.

    A pulse that few echoes show only roughly leaves such parts of it, each at its place; so does a part so far before
    the peak that no pulse is learned there. Two layers of one distance do not scatter as one. A part that changes from
    shot to shot has one lag, within a fraction of a width; layers of a scene have others beside it too.
    """
    row, other, lag = list_lags(echoes, width)
    ratio = echoes.amplitude[row] / echoes.amplitude[other]
    near = (ratio < WEAKER) & (np.abs(lag) < REACH)
    lags, ratios, most = lag[near], log(ratio[near]), 0.0
    for centre in np.arange(-REACH, REACH, 0.5):
        here = np.abs(lags - centre) <= 1
        if np.count_nonzero(here) >= FEW:
            alike = np.abs(ratios - median(ratios[here])) < SAME_RATIO
            chance = max(np.mean(alike[~here]), 0.1) if np.count_nonzero(~here) >= FEW else CHANCE_RATIO
            most = max(most, 2 * float(np.count_nonzero(alike & here) - chance * np.count_nonzero(here)))
    lag = np.sort(lag[ratio < WEAKER / 2])
    first, last = (lag[0], lag[-1]) if len(lag) else (0.0, 0.0)
    centre = np.arange(first, last + SAME_LAG, SAME_LAG / 2)
    centre = centre[np.abs(centre) >= NEAREST]
    place = centre[:, None] + np.array([0.0, *ASIDE])
    number = np.searchsorted(lag, place + SAME_LAG) - np.searchsorted(lag, place - SAME_LAG)
    beside = variance = number[:, 1:].max(axis=1)
    # Nearer ones merge there. Plants right over the ground are as many more as these are than those a step further.
    first, second = np.where(centre > 0, number[:, 3:].T, number[:, 2:0:-1].T)
    fallen = first**2 / np.maximum(second, 1)
    beside, variance = np.where(
        (np.abs(centre) < MERGED) & (fallen > beside),
        (fallen, fallen**2 * (4 / np.maximum(first, 1) + 1 / np.maximum(second, 1))),
        (beside, variance),
    )
    more = number[:, 0] - beside
    more = more[(more >= FEW) & (more > SURE * np.sqrt(number[:, 0] + variance))]
    return max(most, float(more.max(initial=0))) / max(len(echoes), 1)


def share_fixed(echoes: EchoTable, number: int, spacing: float) -> float:
    """Share of the echoes that stand at one sample of most waveforms, all of one height; 0 where these are the scene.

    The receiver makes them: a start pulse that leaks, a window before it. Noise alone moves them, so that times scatter
    as their errors say, and amplitudes hardly more. Behind a trigger first echoes move by half a sample too: where
    errors of times are so large that they hide it, as of wide or weak echoes, nothing tells them apart.

    Parameters
    ----------
    echoes : EchoTable
        Of a sample.
    number : int
        Of its waveforms.
    spacing : float
        Of their samples [ns].
    """
    ordered = np.sort(echoes.time)
    after = np.searchsorted(ordered, ordered + spacing + FIXED * median(echoes.time_err)) if len(ordered) else ordered
    many = after - np.arange(len(ordered))
    if not len(many) or many.max() < MOST_HAVE * number:
        return 0.0
    first = int(np.argmax(many))
    here = (echoes.time >= ordered[first]) & (echoes.time <= ordered[int(after[first]) - 1])
    moved = np.hypot(1, TRIGGERED * spacing / median(echoes.time_err[here]))
    if moved < ONE_PLACE * (1 + SURE * MEDIAN_ERROR / np.sqrt(np.count_nonzero(here))):
        return 0.0
    varies = np.hypot(echoes.amplitude_err, EQUAL * echoes.amplitude)
    for value, error in ((echoes.time, echoes.time_err), (echoes.amplitude, varies)):
        off = np.abs(value[here] - median(value[here])) / error[here]
        if not MAD_TO_STD * median(off) < ONE_PLACE:
            return 0.0
    others = len(distinct(echoes.waveform[~here])) >= MOST_HAVE * number
    return float(np.mean(here)) if others else 0.0


def share_placed(echoes: EchoTable, width: float, waveforms: int) -> float:
    """Share of the echoes at places, of lag and share, that have more than twice as many as any beside them, for sure.

    Parameters
    ----------
    echoes : EchoTable
        Of a sample.
    width : float
        Of the system pulse [ns].
    waveforms : int
        Of the sample: a place must be seen in three tenths of it, as an object lies in one or two.
    """
    row, other, lag = list_lags(echoes, width)
    ratio = echoes.amplitude[row] / echoes.amplitude[other]
    near = (ratio < 1) & (ratio > LEAST_SHARE) & (np.abs(lag) < TAIL_AFTER)
    row, lag, depth = row[near], lag[near], -log(ratio[near])
    tenth = 10 * echoes.waveform[row].astype(np.int64) // waveforms
    placed = np.zeros(len(row), bool)
    for long, deep in CELLS:
        begin = int(TAIL_AFTER / long) + 1 + ASIDE_PLACES[-1]
        at, below = np.floor(lag / long).astype(np.int64) + begin, np.floor(depth / deep).astype(np.int64)
        count = np.zeros((2 * begin + 1, int(-log(LEAST_SHARE) / deep) + 2))
        np.add.at(count, (at, below), 1)
        place = count[:-1, :-1] + count[1:, :-1] + count[:-1, 1:] + count[1:, 1:]
        higher = np.pad(place, ((0, 0), (2, 0)))[:, :-2]
        most = np.max([higher, *(np.roll(place, step, axis=0) for step in ASIDE_PLACES)], axis=0)
        # Roots of counts scatter by a half, whatever the counts.
        sure = 2 * (np.sqrt(place + 0.375) - np.sqrt(2 * most + 0.375)) >= SURE
        sure[:, : int(np.ceil(-log(PART) / deep))] = False
        for first, second in np.argwhere(sure & (place >= REPEATED)):
            here = (at - first) // 2 == 0
            here &= (below - second) // 2 == 0
            if len(distinct(tenth[here])) >= PLACES:
                placed |= here
    return len(distinct(row[placed])) / max(len(echoes), 1)
