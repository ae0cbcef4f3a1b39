"""What the pulse's model leaves unexplained of strong single echoes, at the echo and in its tail.

Growth and detection ask more of an echo beside a strong one by these figures (docs/algorithms.md R3, R5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import distinct, draw, median, quantile, quantiles
from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.fit.learn_pulse import ONSET
from wavebatch.kernels.signal.filters import filter_energy, filter_symmetric, gaussian_taps
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.decompose.solve import PROVEN
from wavebatch.stages.flags import find_unexplained, list_neighbours
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.stages.score import match_echoes
from wavebatch.surveying.measuring.judge import SURE
from wavebatch.surveying.measuring.learn_pulse import MOST_STRONG, part_strong
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, FEW, MIN_SNR, find_strongest
from wavebatch.surveying.measuring.residuals import decompose_sample, render_own, subtract_echoes

CLIPPED = 0.1
"""Share of clipped waveforms from which the bound is what a Gaussian leaves in common, and no learned pulse can exceed:
what is clipped misses the pulse by more than the rest."""

NORMAL_BELOW = 0.0228, 0.1587
"""Shares of normal values that lie two standard deviations, and one, or more below their mean."""

TAIL_BEFORE, TAIL_AFTER = 15, 40
"""Widths of the pulse before and after an echo in which its tail is measured."""

BESIDE, NOT_ABSORBED = 10, 3
"""Widths of the pulse beside an echo up to which what is left is measured, and from which."""

ADDED, TURNS, MOST_ADDED = 1024, (8, 32), 4 << 20
"""Echoes that are added and found, some 200 within two widths of each lag, and how often they are tried: in a canopy
hardly a place is free. With 8 turns 54 to 65 % of NEON's waveforms were exact by the seed alone; more than these read
this many samples at most, as 32 turns of packets that are long and full took half a minute."""

HEIGHTS = 10.0, 40.0
"""Amplitudes over noise of echoes that are added: found beside strong ones too, small enough to be moved by them."""

MEAN_OFF, MOST_OFF = 0.7979, 4.0
"""Mean size of a normal value, and most that one counts: an echo that is off by more is another one. A mean varies
less from part to part than a quantile: most echoes are hardly off, some by much."""

CONSTANT, COMMON_ERROR, LOWEST_ERROR = 2.0, 3.3, 2.8
"""What comes before or after a pulse belongs to it where its mean share is so many times its scatter: else it is
neighbours, too weak to be found or taken for a part of the pulse. Unless even the lowest quantile of NORMAL_BELOW shows
it. Errors of the mean, which both quantiles tell, and of the lowest one, over the scatter of values and the root of the
number of echoes: what chance makes is no tail."""

LOW_ERROR, FAR = 1.5, 5
"""Error of the higher of these quantiles, over the scatter and the root of the number of echoes; and widths of the
pulse from which what is below nothing is its own: nearer, fits of two echoes as one leave it."""

LARGER = 1.5
"""Standard errors by which what most echoes have more of is a larger share of weaker ones: chance takes one lag of
fifteen from a tail, whose others stay. Else SURE."""

EVEN, FAINT, ALIKE = 1.5, 0.01, 0.1
"""How much further above the median a sixth of the echoes may lie than a sixth lies below it (of neighbours, whose
shares are exponential, 2.2 times), and the largest share there, where a ringing moves from shot to shot: leaves in most
waveforms return more. And part of itself by which a tail may be larger on weaker echoes: targets widen some."""

ENOUGH_FOR_TAIL = 8
"""Strong echoes that show a tail beyond chance: where three in ten have a neighbour at some lag, all of so many do once
in 15,000 lags."""

LEAST_TAIL = 0.002
"""Share of an echo below which its tail is as the pulse says; less where the strip's echoes are so high that twice the
noise is less."""


PART, SAME_SHARE, LESS = 0.15, 0.35, 0.7
"""Largest share of an echo that may be a part of its pulse; difference of the logarithms of two shares up to which they
are the same, as noise moves them; and share over that of a part below which it is not this part."""

SURELY, REPEATED, OFTEN = 6.0, 5, 2.0
"""Errors of its amplitude by which an echo that has room is found, whatever the noise. Echoes that show a part, at
least, and over those that would and do not: where one strong echo in ten has a neighbour of the same lag and share, as
in dense canopies, five do so once in 100,000 such places."""

VARIES = 0.3
"""Scatter of the logarithms of a part's shares beyond that of noise. A ringing that varies by a quarter of itself from
shot to shot was found as echoes, 45 % of all. Targets at one distance before or behind all others, as a film or a net,
differ by more: reflectances on one surface do by .4."""

PLACES = 3
"""Tenths of the strip in which it must be seen: an object with another one behind it lies in one, or in two beside
each other. Twelve hits of a bright sign were 1.5 % of a strip, and its second echoes were lost."""

ROOM = 2.5
"""Widths of the pulse within which a higher echo hides a lower one."""

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


def list_lags(echoes: EchoTable, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of echoes that have a neighbour, its row, and how much later they are than it [widths]: from both sides."""
    pairs = [(row, other, lag / width) for row, other, lag in list_neighbours(echoes)]
    if not pairs:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    row, other, lag = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return row, other, lag


def measure_tail(block: WaveformBlock, system: SystemPulse, clear: EchoTable) -> SystemPulse:
    """The system with what its pulse leaves before and after strong single echoes: `tail_misfit`, as shares of them."""
    strong, weaker = part_strong(clear)
    if len(strong) < ENOUGH_FOR_TAIL:
        return system
    left, parts = ResidualShares(block, system, strong), {}
    others = ResidualShares(block, system, weaker) if len(weaker) >= ENOUGH_FOR_TAIL else None
    for half in (*range(-2 * TAIL_BEFORE, -5), *range(6, 2 * TAIL_AFTER)):
        seen = left.look(half / 2)
        if seen.number < ENOUGH_FOR_TAIL:
            continue
        # Other targets only add, and in a canopy most waveforms have some: what the lowest echoes show is the tail.
        scatter = 2 * np.sqrt(seen.spread**2 - left.noise**2)
        share, sure = abs(seen.common) + scatter, abs(seen.common) > SURE * seen.error
        is_part = sure and abs(seen.common) > CONSTANT * scatter
        # What varies about nothing is no neighbour either: light only adds.
        many = NORMAL_BELOW[0] * seen.number > 1
        deep = left.noise * max(CONSTANT, 1 + SURE * LOW_ERROR / np.sqrt(seen.number))
        is_part |= many and abs(half) >= 2 * FAR and seen.spread - seen.common > deep
        higher, all_have = seen.median > seen.common + seen.spread, False
        if not higher:
            # A tail that changes from shot to shot scatters, but hardly any echo is without it, as without a neighbour.
            all_have = many and seen.lowest > LOWEST_ERROR * left.noise * SURE / np.sqrt(seen.number)
            # Or it moves, so that some are without it: it is faint then, and as often lower than higher.
            below, above = seen.median - seen.common + seen.spread, seen.high - seen.median
            moves = sure and abs(seen.median) > SURE * seen.error and above < EVEN * below and seen.high < FAINT
            if moves and not (is_part or all_have):
                share = abs(seen.median) + 2 * np.sqrt(max((above + below) ** 2 / 4 - left.noise**2, 0.0))
            is_part |= all_have or moves
        if is_part and others:
            # A tail is the same share of weaker echoes, neighbours are a larger one.
            other = others.look(half / 2)
            more = np.sign(seen.common) * other.common - abs(seen.common)
            chance = (SURE if all_have else LARGER) * np.hypot(seen.error, other.error) + ALIKE * abs(seen.common)
            is_part = more <= chance and (not higher or (-more <= chance and other.number >= ENOUGH_FOR_TAIL))
        elif higher:  # most echoes have a neighbour there, perhaps all of them
            is_part = False
        # Higher ones are targets: rows of crops, and roofs over the ground, have one distance.
        if is_part and PART > share > min(LEAST_TAIL, 2 * left.noise):
            parts[half] = share
    # A ringing is higher between two steps than at them.
    highest = {place: max(parts.get(2 * place + beside, 0.0) for beside in (-1, 0, 1))
               for place in range(-TAIL_BEFORE, TAIL_AFTER) if abs(place) >= 3}  # fmt: skip
    profile = ((float(place * system.sigma_ref), float(share)) for place, share in highest.items() if share)
    return replace(system, tail_misfit=tuple(profile))


def find_parts(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """The system with the parts of its pulse that were decomposed as echoes: `tail_misfit`, where it has less.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    echoes : EchoTable
        The block decomposed with its pulse, without any tail.

    Notes
    -----
    Neighbours differ in lag and share from echo to echo. A part of the pulse is found with every echo that is so strong
    that it must be, unless another echo is in its place (docs/algorithms.md R3). What varies, and has a share above
    FAINT, is no part, and no tail either, whatever samples show.
    """
    ref = system.sigma_ref
    found = SURELY * system.noise.std / float(np.sqrt(filter_energy(gaussian_taps(ref / block.spacing))))
    strong = np.argsort(-echoes.amplitude, kind="stable")[:MOST_STRONG]
    strong = strong[echoes.amplitude[strong] * LESS * PART > found]
    number = np.full(len(echoes), -1)
    number[strong] = np.arange(len(strong))
    row, other, lag = list_lags(echoes, ref)
    known = number[other] >= 0
    owner, lag = number[other[known]], lag[known]
    share = echoes.amplitude[row[known]] / echoes.amplitude[other[known]]
    least, time = found / echoes.amplitude[strong], echoes.time[strong]
    tenth = 10 * echoes.waveform[strong].astype(np.int64) // len(block)
    low, high = -time / ref, ((block.samples.shape[1] - 1) * block.spacing - time) / ref
    must = (share < PART) & (least[owner] < share)
    profile = dict(system.tail_misfit)
    for place in range(-TAIL_BEFORE, TAIL_AFTER):
        away = np.abs(lag - place)
        here, near = np.flatnonzero(away <= 1), np.flatnonzero(away <= ROOM)
        if abs(place) < 3 or np.count_nonzero(must[here]) < REPEATED:
            continue
        highest, beside = np.zeros((2, len(strong)))
        np.maximum.at(highest, owner[here], share[here])
        np.maximum.at(beside, owner[near], share[near])
        whole = (low < place - 2) & (high > place + 2)
        level = log(np.maximum(highest, 1e-9))
        likely: list[tuple[float, np.ndarray]] = []
        varying: list[tuple[float, np.ndarray]] = []
        middles = distinct(np.round(log(share[here[must[here]]]), 1))
        for middle, part in zip(middles, exp(middles).tolist(), strict=True):
            seen = whole & (least < LESS * part)
            alike = seen & (np.abs(level - middle) < SAME_SHARE)
            with_it = np.count_nonzero(alike)
            if with_it < REPEATED:
                continue
            without = np.count_nonzero(seen & (highest < LESS * part) & (beside < part / LESS))
            if with_it < OFTEN * without:  # nearly always
                continue
            # Higher echoes there are neighbours, and others of them are as high as the part: as many as in equal steps
            # of the logarithm, or as in the next one.
            above = level[seen & (highest > part / LESS)] - middle
            chance = max(len(above) * 2 * SAME_SHARE / -np.log(part / LESS), np.count_nonzero(above < 3 * SAME_SHARE))
            if with_it < chance + SURE * np.sqrt(chance + 1) or len(distinct(tenth[alike])) < PLACES:
                continue
            # Of all that may be it: those near one share hardly differ, however far the others reach.
            wide = seen & (np.abs(level - middle) < 3 * SAME_SHARE)
            scatter = MAD_TO_STD * median(np.abs(level[wide] - median(level[wide])))
            usual = np.hypot(VARIES, median(least[alike] / highest[alike]) / SURELY)
            steady = scatter < usual * (1 + SURE * MEDIAN_ERROR / np.sqrt(np.count_nonzero(wide)))
            if steady or part > FAINT:
                (likely if steady else varying).append((float(with_it - without), alike))
        if likely or varying:
            alike = max(likely or varying, key=lambda one: one[0])[1]
            part = quantile(highest[alike], 1 - NORMAL_BELOW[1])  # targets and noise move it
            around = distinct((np.rint(lag[here[alike[owner[here]]]])[:, None] + (-1, 0, 1)).ravel())
            for at in around[np.abs(around) >= 3]:
                profile[at * ref] = max(profile.get(at * ref, 0.0), part) if likely else 0.0
    parts = ((float(lag), float(share)) for lag, share in profile.items() if share)
    return replace(system, tail_misfit=tuple(sorted(parts)))


class LagShares(NamedTuple):
    """What echoes have in common at a lag, as shares of them."""

    number: int
    """Of the echoes whose waveforms reach there."""
    lowest: float
    common: float
    """The mean of the lower half of them, as normal values have it."""
    median: float
    high: float
    """What a sixth of them exceed."""
    spread: float
    """Standard deviation, that of noise at least."""

    @property
    def error(self) -> float:
        """Standard error of what they have in common."""
        return COMMON_ERROR * self.spread / np.sqrt(self.number)


class ResidualShares:
    """What a pulse leaves of single echoes, before and after them, as shares of their amplitudes."""

    def __init__(self, block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> None:
        part = block.rows(echoes.waveform)
        echoes = replace(echoes, waveform=np.arange(len(echoes), dtype=np.int32))
        fitted = adaptive(part, pooled_noise(part, system), system, echoes, max_echoes=1, significance=0.0)
        fitted = fitted.take(find_strongest(fitted, len(part))[0])
        ref = system.sigma_ref / part.spacing
        taps = gaussian_taps(ref)
        energy = filter_energy(taps)
        residual = subtract_echoes(part, system, fitted)[fitted.waveform]
        self.time, self.step = fitted.time / part.spacing, ref
        # What broad parts of the model have there is not taken off an echo before it, in a cluster of its own.
        whole = subtract_echoes(part, system, fitted.take(np.empty(0, np.int64)))[fitted.waveform]
        residual = np.where(np.arange(residual.shape[1]) < (self.time - ONSET * ref)[:, None], whole, residual)
        share = filter_symmetric(np.nan_to_num(residual).T.astype(np.float32), taps).T / np.float32(energy)
        self.share = np.where(np.isfinite(residual), share / fitted.amplitude[:, None], np.nan)
        self.noise = float(system.noise.std / median(fitted.amplitude) / np.sqrt(energy))

    def look(self, place: float) -> LagShares:
        """What is left at this lag [widths of the pulse]: between samples, so that a part's slope is no scatter."""
        at = self.time + place * self.step
        row = np.flatnonzero((at >= 0) & (at < self.share.shape[1] - 1))
        before = at[row].astype(np.int64)
        part = at[row] - before
        here = (1 - part) * self.share[row, before] + part * self.share[row, before + 1]
        return summarize_shares(here[np.isfinite(here)], self.noise)


def summarize_shares(shares: np.ndarray, noise: float) -> LagShares:
    """What echoes leave at one lag, from the lowest of them: neighbours only add; noise: of one share."""
    number = len(shares)
    if not number:
        return LagShares(1, 0.0, 0.0, 0.0, 0.0, np.inf)
    lowest, low, middle, high = quantiles(shares, (*NORMAL_BELOW, 0.5, 1 - NORMAL_BELOW[1]))
    # Where the lowest quantile is that of a single echo, the next one may be close to it by chance.
    spread = max(low - lowest if NORMAL_BELOW[0] * number > 1 else (middle - lowest) / 2, noise)
    return LagShares(number, lowest, low + spread, middle, high, spread)


def measure_beside(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """Measure how much further than noise an echo is off beside strong ones, by echoes that are added to waveforms.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    echoes : EchoTable
        The block decomposed with it.

    Returns
    -------
    SystemPulse
        `beside`: by lag, the variance of an amplitude there beyond that of noise, over that of noise.

    Notes
    -----
    Beside the strongest echo of each waveform, where no other echo is near (docs/algorithms.md R3). What a pulse leaves
    there is not all error: echoes and levels of a fit absorb some of it. Echoes that are added and found show the rest.
    Nearer than NOT_ABSORBED the strong echo's own fit takes what is left.
    """
    strongest, _ = find_strongest(echoes, len(block))
    strong = echoes.take(strongest[echoes.amplitude[strongest] > MIN_SNR * system.noise.std])
    strong = strong.take(np.arange(0, len(strong), max(len(strong) // ADDED, 1)))
    if len(strong) < FEW:
        return system
    most = int(np.clip(MOST_ADDED // (len(strong) * block.samples.shape[1]), *TURNS))
    lags, offs, turn, number = [np.empty(0)], [np.empty(0)], 0, 0
    while turn < most:
        # As many turns together as are missing, if the next ones are like those before: a call takes as long as 50 do.
        missing = (2 * ADDED - number) / max(number / turn if turn else 2 * len(strong), 1)
        turns = range(turn, min(turn + int(np.rint(missing if turn else max(missing, 1))), most))
        if not turns:  # less than half of one
            break
        for lag, off in _add_beside(block, system, echoes, strong, turns):
            if number < 2 * ADDED:
                lags, offs, number = [*lags, lag], [*offs, off], number + len(lag)
        turn = turns.stop
    lag, off = np.concatenate(lags), np.concatenate(offs)
    profile = []
    for place in range(-BESIDE, BESIDE + 1):
        here = np.abs(off[np.abs(lag - place) <= 2])
        if abs(place) >= NOT_ABSORBED and len(here) >= ENOUGH_TO_LEARN:
            variance = (float(np.mean(np.minimum(here, MOST_OFF))) / MEAN_OFF) ** 2 - 1
            profile.append((float(place * system.sigma_ref), max(variance, 0.0)))
    return replace(system, beside=tuple(profile))


def _add_beside(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, strong: EchoTable, turns: range
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Lags of echoes that were added and found [widths], and how far their times and amplitudes are off [errors].

    For each turn, in which every strong echo gets another neighbour.
    """
    ref, each = system.sigma_ref, len(strong)
    low, high = log(np.array(HEIGHTS)).tolist()
    drawn_by_turn = []
    for turn in turns:
        place, height = draw(turn, 2, each)
        lag = (BESIDE + 2 - NOT_ABSORBED) * (2 * place - 1)  # of both signs
        drawn_by_turn.append((lag + (NOT_ABSORBED - 1) * np.sign(lag), low + (high - low) * height))
    lag, height = (np.concatenate(values) for values in zip(*drawn_by_turn, strict=True))
    height = system.noise.std * exp(height)
    block = block.rows(np.tile(strong.waveform, len(turns)))
    n, s = block.samples.shape
    added = EchoTable.build(np.arange(n), np.tile(strong.time, len(turns)) + lag * ref, height, np.full(n, ref))
    owner = np.full(int(max(echoes.waveform.max(), strong.waveform.max())) + 1, -1)
    owner[strong.waveform] = np.arange(each)
    here = echoes.take(np.flatnonzero(owner[echoes.waveform] >= 0))
    here = replace(here, waveform=owner[here.waveform].astype(here.waveform.dtype))
    here = EchoTable.concatenate((here, turn * each) for turn in range(len(turns)))
    # The strong one itself is so near at most; any other is nearer than a fit takes apart from the one that is added.
    crowded = match_echoes(here, added, (NOT_ABSORBED - 1) * ref).truth
    place = np.rint(added.time / block.spacing).astype(np.int64)
    drawn = render_own(block, system, added, np.arange(n), n)
    inside = (place >= 0) & (place < s)
    inside[crowded] = False
    summed = block.samples + drawn
    inside &= (summed < clip_level(block, system)).all(axis=1)
    if block.missing is not None:
        inside &= ~(block.missing & (drawn > 0.01 * height[:, None])).any(axis=1)
    rows = np.flatnonzero(inside)
    found = decompose_sample(replace(block, samples=summed.astype(np.float32)).rows(rows), replace(system, beside=()))
    added = replace(added.take(rows), waveform=np.arange(len(rows), dtype=added.waveform.dtype))
    pair = match_echoes(found, added, ref)
    found, truth = found.take(pair.found), added.take(pair.truth)
    late, high = (found.time - truth.time) / found.time_err, (found.amplitude - truth.amplitude) / found.amplitude_err
    lag, turn = lag[rows][pair.truth], rows[pair.truth] // each
    for one in range(len(turns)):
        own = turn == one
        yield np.tile(lag[own], 2), np.concatenate([late[own], high[own]])
