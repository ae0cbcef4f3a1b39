"""What strong echoes leave before and after them, as parts of their pulse, and by how much echoes there are off.

An echo beside a strong one must be higher by these figures, and has a larger error (docs/algorithms.md R3).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import distinct, draw, median, quantile, quantiles
from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.fit.learn_pulse import ONSET
from wavebatch.kernels.signal.filters import filter_energy, filter_symmetric, gaussian_taps
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.flags import list_neighbours
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.stages.score import match_echoes
from wavebatch.surveying.measuring.judge import SURE
from wavebatch.surveying.measuring.learn_pulse import MOST_STRONG, part_strong
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, FEW, MIN_SNR, find_strongest
from wavebatch.surveying.measuring.residuals import decompose_sample, render_own, subtract_echoes

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
    error: float
    """Standard error of what they have in common."""


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
        return LagShares(1, 0.0, 0.0, 0.0, 0.0, np.inf, np.inf)
    lowest, low, middle, high = quantiles(shares, (*NORMAL_BELOW, 0.5, 1 - NORMAL_BELOW[1]))
    # Where the lowest quantile is that of a single echo, the next one may be close to it by chance.
    spread = max(low - lowest if NORMAL_BELOW[0] * number > 1 else (middle - lowest) / 2, noise)
    return LagShares(number, lowest, low + spread, middle, high, spread, COMMON_ERROR * spread / np.sqrt(number))


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
