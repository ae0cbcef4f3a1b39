"""Candidates for the system pulse, then one judge: the length of a description of waveforms (docs/algorithms.md R2).

`survey` calls `choose_pulse` with the noise and the Gaussian of the isolated echoes, and `settle` with what it chose.
Before you change it: no sensor's name and no threshold of one strip decides here; a candidate wins because waveforms
that it was not learned from are shorter to describe with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import distinct, quantile
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.fit.describe import Left, describe_left
from wavebatch.stages.pulse_tables import clip_level, shape_limits
from wavebatch.surveying.measuring.joint_pulse import MOST_ECHOES, learn_jointly
from wavebatch.surveying.measuring.judge import (
    SURE,
    Explained,
    count_errors,
    describe_waveforms,
    exceed,
    explain,
    find_changed,
    find_own_width,
    measure_change,
    replace_rows,
    sample_noise,
)
from wavebatch.surveying.measuring.mirror import FALSE_QUIET, Mirror, count_holes, look_in_mirror
from wavebatch.surveying.measuring.misfit import LEAST_MISFIT, limit_faint
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, HALVED, spread_rows, thin_block
from wavebatch.surveying.systems.known_systems import MOST_SPREAD
from wavebatch.surveying.systems.survey_result import Tried

STRICT = 0.92
"""Least width of an echo where a pulse is judged, over the pulse's: nothing reflects narrower, and widths scatter by up
to 4 %."""

SAMPLES, MOST, LEAST = 60_000, 384, 96
"""Samples that candidates are judged on, as many waveforms at most, and as many at least where they are long."""

MORE = 4
"""Times as many waveforms on which candidates are judged where another one costs the same as the best."""

CHANGES, STEP_OF_CHANGES = (0.0, 0.003, 0.01, 0.03), 3.4
"""Changes of the pulse from shot to shot that are tried, as shares of the amplitude: in steps of a factor 3.4 at most,
since the length changes little within a factor 2 of the best."""

COVERED = 3.2
"""Misfit over the change from shot to shot: two directions of change promise more than this squared to one echo in
200 (chi2 with two degrees of freedom exceeds 10.6 so often)."""

HOPELESS = 5.0
"""Standard errors by which a description is longer where a pulse is not looked at any further: chance makes so many
once in three million times."""

HINT = 1.5
"""Standard errors by which a rival must describe shorter, in place of SURE, where what was taken is doubtful itself: a
learned pulse of several Gaussians that needs as many echoes as the rival (AS_FEW), or one that is known to miss the
stacked echoes by more than the change from shot to shot. Chance makes so many once in fifteen times."""

FEWER = 0.95
"""Share of the echoes with which a rival wins by SURE - HINT. With the same number it needs SURE, with 5 % more
SURE + HINT, and in proportion between: at a step, halves of a strip fall on either side. Each echo is a claim too; one
in twenty is what `run` calls a doubt."""

LEAST_SAVED, LEAST_OF_KNOWN, OTHER_WIDTH = 0.25, 2.0, 0.1
"""Nats per echo that other pulses must save in place of a Gaussian, and learned ones in place of one from elsewhere:
chi2 of a half and of 4, of which an echo alone tells nothing. What a strip's scene has in common is in a pulse that is
learned from it and in all of its waveforms, and saves some (.2 in a canopy, .3 on RIEGL, 1.1 on LVIS), however many
tell it. It widens the pulse a little (6 % on LVIS): one that differs by a tenth is that of another sensor."""

LEAST_REPEATED = 1.005 * STRICT
"""Width that strong echoes repeat, over the pulse's, from which it may be theirs: most of those of a pulse that is too
wide are STRICT. They may repeat OTHER_WIDTH more: in a canopy hardly one is level. Of pulses half as wide as the right
one, which describe canopies as short, they repeat 1.5 to 4 times the width."""

BLIND = 2 / 3
"""Waveforms in which a pulse finds an echo, over those of another one, from which that it needs fewer echoes says
nothing: it does not see them. Gaussians of 24 to 192 samples saw 3 to 20 % of the echoes of pulses that lasted one."""

OWN = 2.0
"""Standard errors by which a pulse looks too good to the waveforms that it was learned from: a nat for each of its 18
parameters, where fifty waveforms scatter by one or two."""

SHOWN = 0.7
"""Standard errors, over the root of the waveforms with an echo, that there are where each of them gains, by amounts
that scatter as much as they are large: 24 such waveforms never show the 4.5 that another number of echoes asks for."""

AS_FEW = 0.98
"""Share of its echoes to which another number of them is the same: a fiftieth of them comes and goes with the noise."""

FEWEST = 48
"""Waveforms on which each candidate is judged first. By half of them pulses of some strips were learned from a worse
start: they had 3 to 5 % of false echoes in place of 1 to 2."""

MISFITS = LEAST_MISFIT * 2.0 ** np.arange(9)
"""Misfits of the chosen pulse that are tried, up to MOST_MISFIT."""

FINEST = 0.25
"""Part of a doubling to which the least misfit is looked for where descriptions begin to be as short: between misfits
further apart their standard errors are no line, and no parabola."""

STACKED, SUMMED, JOINTLY = "lone echoes", "lone echoes, as a sum", "lone echoes, jointly"
OF_ALL, OF_ANY, AGAIN = "gaussian of all echoes", "all echoes", ", again"
ROUNDS: dict[str, dict[str, Any]] = {"one echo per cluster": {"max_echoes": 1}, OF_ANY: {}}
"""Rounds in which a pulse is learned from all waveforms, and how these are decomposed."""

ALONE = 256
"""Waveforms with one echo from which the pulse is learned jointly, at most: as many as judge candidates by half."""

MORE_ROUNDS = 8
"""Further rounds of all echoes, at most: each goes a part of the way, and five reached a pulse that was a sixth off."""

COUNTED = 0.3
"""Weight of errors of the pulse that echoes may absorb in these."""

FIRST_CHANGE = 0.01
"""Change of the pulse from shot to shot, at least, in the first round of each: what the pulse of a stack misses must
not become echoes, which would keep the shoulders of the next one as wrong."""

SIGNIFICANCE, FINER, MOST_SIGNIFICANT = 4.5, 0.5, 6.5
"""Least energy of an echo to begin with, step by which it grows, and where it ends [standard deviations]."""

GAINED = 0.01
"""Share of the echoes that a higher significance must be worth: in canopies, whose mirrors hold neighbours that stay
there, it gains less, and a canopy lost 3.5 % of its clear echoes."""


@frozen(eq=False)
class Candidate:
    """A pulse with its noise and its change from shot to shot, and what waveforms cost with it."""

    name: str
    system: SystemPulse
    change: float
    """Of the shape, from shot to shot, as a share of the amplitude."""
    length: np.ndarray
    """Of the description of each waveform [nats], float64 (n,)."""
    echoes: int
    answered: int
    """Waveforms in which it finds an echo."""
    known: bool
    """From elsewhere, not learned."""
    gaussians: int
    """Of the pulse, as far as they had to be learned: 2 for one that is known, so that a plain Gaussian goes first."""
    seen: float
    """Change of the shape that the median of the strongest echoes shows."""
    repeated: float = 1.0
    """Narrowest width that strong echoes repeat, over that of the pulse: 1 where it is their pulse."""
    as_likely: tuple[float, ...] = ()
    """Echoes with other changes of the shape that cost the same, over its own."""

    @property
    def missed(self) -> float:
        """What its model misses of the stacked echoes, as a share of the amplitude; one from elsewhere has no stack."""
        return 0.0 if self.known else self.system.misfit

    @property
    def typical(self) -> float:
        """Mean length of a waveform's description; one in twenty, which no pulse explains, counts as the next lower."""
        return float(np.minimum(self.length, quantile(self.length, 0.95)).mean())

    def exceeds(self, other: Candidate) -> float:
        """Standard errors by which descriptions are longer than with another candidate."""
        return exceed(self.length, other.length)


@frozen(eq=False)
class Choice:
    """The candidate that was taken, and those that lost."""

    best: Candidate
    tried: tuple[Tried, ...]
    """The shortest first."""
    doubt: float
    """Share by which the number of echoes differs between candidates that cost the same."""
    spread: float
    """Share by which their widths differ from that of the best one, as likely as each of them is (root mean square)."""
    tied: bool
    """Whether another pulse, or one that needs another number of echoes, costs the same."""


def choose_pulse(
    block: WaveformBlock,
    starts: Mapping[str, SystemPulse],
    given: Mapping[str, SystemPulse] | None = None,
    *,
    plain: bool = False,
    many: bool = False,
) -> Choice:
    """Choose the pulse that describes waveforms in the fewest words.

    Parameters
    ----------
    block : WaveformBlock
        Cleaned waveforms.
    starts : mapping of SystemPulse by name
        Pulses learned from lone echoes. From the best of them pulses are learned from all echoes: first with one echo
        per cluster, so that false echoes do not eat the pulse's tail, then with as many as it needs.
    given : mapping of SystemPulse by name
        Pulses known from elsewhere: shipped ones, the strip's outgoing pulse.
    plain : bool
        Whether lone echoes show no more than the start "gaussian": where all echoes have its width too, nothing else is
        tried.
    many : bool
        Whether lone echoes are so many that what they teach jointly is known as well as a pulse of all echoes.

    Returns
    -------
    Choice

    Notes
    -----
    Pulses are learned on one half of the waveforms and judged on the other, where the pulse has to be written down too:
    half the logarithm of the samples for each of its parameters; one from elsewhere is known. Of those that cost the
    same, by SURE standard errors, the simplest pulse is taken, then the one with the fewest echoes: what is claimed
    must be proven. By HINT one is taken in place of a learned pulse that needs more echoes or misses the stacked ones.
    """
    number = int(np.clip(SAMPLES // block.samples.shape[1], LEAST, MOST))
    rows = spread_rows(len(block), 2 * number)
    small = len(rows) < HALVED
    part = block.rows(rows)
    taught, judged = (part, part) if small else (part.rows(slice(0, None, 2)), part.rows(slice(1, None, 2)))
    few = thin_block(judged, FEWEST)
    if plain:
        own = _find_gaussian(taught, starts["gaussian"], CHANGES[1])
        plain = abs(own.sigma_ref / starts["gaussian"].sigma_ref - 1) < MOST_SPREAD
    given = {} if plain else given or {}
    every: dict[tuple, tuple[str, SystemPulse]] = {}  # by pulse: the first that has it
    for one in {**starts, **given}.items():
        every.setdefault(one[1].pulse, one)
    looked = [_judge(few, name, system, CHANGES[1], known=name in given) for name, system in every.values()]
    stacked = [one for one in looked if one.name in (STACKED, SUMMED)]
    jointly = next((one for one in looked if one.name == JOINTLY), None)
    # The stack may show as much, with less freedom.
    if jointly and min((_save(jointly, one) for one in stacked), default=np.inf) <= LEAST_OF_KNOWN:
        looked.remove(jointly)
    leader = min(looked, key=lambda one: one.typical)
    ahead = {one.name: one.exceeds(leader) for one in looked}
    hopeful = [one for one in looked if ahead[one.name] < HOPELESS]
    begin = min((one for one in looked if one.name in starts), key=lambda one: one.typical)
    # All echoes teach no other pulse than many alone in their waveforms do, with the same freedom.
    gaussian = not (begin.system.components or begin.system.kappa)
    if jointly in looked and many and gaussian and _saves_little(jointly, begin):
        plain, own = True, _find_gaussian(taught, begin.system, CHANGES[1])
        hopeful = [one for one in hopeful if one is not jointly]
    learned = [] if plain else _learn(taught, judged, begin)
    # Where too few echoes teach further, what lone echoes teach jointly stands for itself.
    tried = {one.name: one.system for one in hopeful if one.name != JOINTLY or not learned}
    tried |= {OF_ALL: own} if plain else {}
    found: list[Candidate] = []
    for name, system in tried.items():
        best = min(learned + found, key=lambda one: one.typical, default=None)
        longer = ahead.get(name, 0.0)
        # One that is far from the strip's takes five times as long: first the waveforms that would show it as hopeless.
        some = spread_rows(len(judged), int(FEWEST * ((HOPELESS + 1) / max(longer, 1.0)) ** 2))
        if best and name in given and 2 * len(some) < len(judged):
            length = _judge(judged.rows(some), name, system, CHANGES[1], known=True).length
            if exceed(length, best.length[some]) >= HOPELESS:
                continue
        found.append(_judge(judged, name, system, CHANGES[1], known=name in given))
    found = _try_changes(judged, found + learned)
    choice = _decide(found, small=small)
    if choice.best.name in starts and not _is_as_wide(choice.best, begin):
        # Few waveforms showed another start: what was learned from it may be of another pulse.
        again = [replace(one, name=one.name + AGAIN) for one in _learn(taught, judged, choice.best)]
        found += _try_changes(judged, again)
        choice = _decide(found, small=small)
    if choice.tied and len(rows) < len(block):
        others = np.delete(np.arange(len(block)), rows[::2])
        choice = _decide_by_more(block.rows(others[spread_rows(len(others), MORE * number)]), found, choice)
    return choice if small else replace(choice, best=_learn_from_all(part, choice.best))


def learn_alone(block: WaveformBlock, system: SystemPulse) -> SystemPulse:
    """Learn the pulse from waveforms with one echo each, in two rounds from one that a stack of them shows.

    Parameters
    ----------
    block : WaveformBlock
        Of isolated echoes.
    system : SystemPulse
        With a pulse learned from their stack, which lies as a Gaussian fits each of them: the shape of a skewed pulse,
        or of one hardly wider than the samples, moves that from echo to echo.

    Returns
    -------
    SystemPulse
        With the new pulse. What it misses has become no further echo: each waveform has one.
    """
    part = thin_block(block, ALONE)
    for _ in range(2):
        explained = explain(part, bear(system, CHANGES[1]), max_echoes=1)
        system = learn_jointly(part, system, explained, CHANGES[1])
    return system


def _learn_from_all(block: WaveformBlock, best: Candidate) -> Candidate:
    """The chosen pulse, where it was learned from half of these waveforms, learned from all of them."""
    name = best.name.removesuffix(AGAIN)
    if name == OF_ALL:
        return replace(best, system=_find_gaussian(block, best.system, best.change))
    if name not in ROUNDS:
        return best
    explained = explain(block, bear(best.system, best.change), **ROUNDS[name])
    return replace(best, system=learn_jointly(block, best.system, explained, best.change))


def _find_gaussian(block: WaveformBlock, system: SystemPulse, change: float) -> SystemPulse:
    """A Gaussian of the width that strong echoes of a block repeat, decomposed with another one."""
    explained = explain(block, bear(system, change), width_prior=0.0)
    own = find_own_width(explained, shape_limits(system, block.spacing).ref)
    return replace(system, sigma_ref=system.sigma_ref * own)


def _learn(taught: WaveformBlock, judged: WaveformBlock, begin: Candidate) -> list[Candidate]:
    """Pulses learned from some waveforms and judged on others; of all echoes the round that is described shortest.

    Where echoes are close, the first rounds end far from the pulse.
    """
    found = [_judge(judged, name, system, CHANGES[1], known=False) for name, system in _list_rounds(taught, begin)]
    if not found or found[-1].name != OF_ANY:
        return found
    rounds = found[-2:]
    while len(rounds) < 2 + MORE_ROUNDS:
        before, last = rounds[-2:]
        if _save(last, before) <= LEAST_SAVED or before.exceeds(last) <= HINT:
            break
        explained = explain(taught, bear(last.system, begin.change))
        system = learn_jointly(taught, last.system, explained, begin.change, COUNTED)
        rounds.append(_judge(judged, OF_ANY, system, CHANGES[1], known=False))
    return [*found[:-1], min(rounds[1:], key=lambda one: one.typical)]


def _list_rounds(block: WaveformBlock, begin: Candidate) -> Iterator[tuple[str, SystemPulse]]:
    """Pulses learned from one echo per cluster and from all echoes, two rounds each; before them a Gaussian."""
    system = begin.system
    if not (system.components or system.kappa):
        yield OF_ALL, _find_gaussian(block, system, begin.change)
    for name, options in ROUNDS.items():
        for change in (max(begin.change, FIRST_CHANGE), begin.change):
            explained = explain(block, bear(system, change), **options)
            number = np.diff(explained.sums.first)
            if number[number <= MOST_ECHOES].sum() < ENOUGH_TO_LEARN:  # echoes of waveforms that say something of it
                return
            system = learn_jointly(block, system, explained, begin.change)
        yield name, system


def bear(system: SystemPulse, change: float) -> SystemPulse:
    """Return the system with the misfit that a change of the pulse asks for, or what its model misses."""
    misfit = max(COVERED * change, system.misfit)
    return replace(system, misfit=misfit, tail_misfit=(), beside=(), hidden=(), hidden_light=(), hidden_width=())


def _judge(block: WaveformBlock, name: str, system: SystemPulse, change: float, *, known: bool) -> Candidate:
    """A pulse judged on waveforms; echoes narrower than the pulse are forbidden: nothing reflects so."""
    borne = bear(system, change)
    explained = explain(block, borne, least_width=STRICT, width_prior=0.0)
    gaussians = max(len(system.components), 1)
    used = max(int(np.count_nonzero(explained.sums.used)), 1)
    written = 0.0 if known else 3 * gaussians * 0.5 * log(used) / len(block)
    left = describe_left(explained.sums, sample_noise(borne), [change], strongest=True)
    length = describe_waveforms(block, borne, explained, [change], left)[0] + written
    return Candidate(
        name, system, change, length, len(explained.echoes), len(distinct(explained.echoes.waveform)), known,
        2 if known else gaussians, measure_change(left),
        find_own_width(explained, shape_limits(borne, block.spacing).ref),
    )


def _try_changes(block: WaveformBlock, found: list[Candidate]) -> list[Candidate]:
    """Candidates, each with the change of its shape that serves it better: that of the best one, or as it was."""
    best = min(found, key=lambda one: one.typical)
    tuned = {best.name: _find_change(block, {best.change: best})}
    rivals = [one for one in found if one is not best and one.exceeds(best) < HOPELESS]
    change, judged = tuned[best.name].change, {}
    for one in rivals:
        other = one if one.change == change else _judge(block, one.name, one.system, change, known=one.known)
        tuned[one.name] = min(one, other, key=lambda each: each.typical)
        judged[one.name] = {one.change: one, other.change: other}
    first = min(tuned.values(), key=lambda one: one.typical)
    if first.name != best.name:
        tuned[first.name] = _find_change(block, judged[first.name])
    return [tuned.get(one.name, one) for one in found]


def _find_change(block: WaveformBlock, judged: Mapping[float, Candidate]) -> Candidate:
    """The pulse with the least change of shape that no other one beats by HINT, of those that its echoes show.

    Its length is that with the best change: by that of the least one, which was within HINT of it or not, two pulses
    changed places.
    By SURE one half of a strip had a change that the other, as likely, had not: its echoes were described by more.
    Neighbours too close to be found change the shape of some echoes, which is no change from shot to shot.
    """
    some = next(iter(judged.values()))  # of this pulse, by its changes

    def at(change: float) -> Candidate:
        return judged.get(change) or _judge(block, some.name, some.system, change, known=some.known)

    none, near, more, most = CHANGES
    tried = [at(near), at(more)]
    # Less of it splits more echoes, more of it loses them: no further either way than is longer for sure.
    if tried[0].exceeds(tried[1]) <= SURE or more > STEP_OF_CHANGES * tried[1].seen:
        tried.insert(0, at(none))
    if tried[-1].exceeds(tried[-2]) <= SURE:
        tried.append(at(most))
    tried = [one for one in tried if one.change <= STEP_OF_CHANGES * one.seen]
    best = min(tried, key=lambda one: one.typical)
    found = next(one for one in tried if one.exceeds(best) < HINT)
    as_likely = tuple(one.echoes / max(found.echoes, 1) for one in tried if one.exceeds(best) < SURE)
    return replace(found, length=best.length, as_likely=as_likely)


def _decide(found: list[Candidate], *, small: bool = False) -> Choice:
    """The candidate with the simplest pulse that no other one beats surely.

    Of pulses as simple the one with the fewest echoes, or the shortest description of those within AS_FEW of it.
    """
    # Echoes that repeat another width than that of their pulse contradict it, unless it is shorter for sure than all
    # that agree with theirs. Hardly an echo is seen by one that is far too wide: it says nothing. And a known pulse may
    # be that of a canopy without any level target.
    agreed = [one for one in found if LEAST_REPEATED < one.repeated < 1 + OTHER_WIDTH]
    contradicted = [one for one in found if one not in agreed and any(
        each.exceeds(one) < SURE and each.answered >= BLIND * one.answered for each in agreed)]  # fmt: skip
    every, found = found, [one for one in found if one.known or one not in contradicted]
    ordered = []
    for number in sorted({one.gaussians for one in found}):
        alike = [one for one in found if one.gaussians == number]
        shortest = min(alike, key=lambda one: (one.typical, one.name))
        level = [one for one in alike if not _beats(shortest, one)]
        level = [one for one in level if one.answered >= BLIND * max(other.answered for other in level)]
        fewest = min(one.echoes for one in level)
        first = min((one for one in level if AS_FEW * one.echoes <= fewest), key=lambda one: (one.typical, one.name))
        ordered += [first, *(one for one in alike if one is not first)]
    best = ordered[0]
    replaced: list[Candidate] = []
    for one in 2 * ordered:  # twice: that one beats the next, and this a third, says nothing of the first and the third
        if _beats(one, best):
            replaced.append(best)
            best = one
    # One of its width must beat a known pulse itself: a wide one did, and this one beat that.
    best = next((one for one in replaced if one.known and _is_as_wide(one, best) and not _beats(best, one)), best)
    ordered = [one for one in ordered if one is best or one not in contradicted]
    tied = [one for one in ordered if one.exceeds(best) < SURE]
    # Fewer echoes lost by less than many waveforms would ask for, or than waveforms that were learned from can show.
    most = SURE + HINT if SHOWN * np.sqrt(best.answered) < SURE + HINT else SURE
    most = HOPELESS + OWN if small else most
    rivals = (one for one in ordered if one.echoes < FEWER * best.echoes and one.answered >= BLIND * best.answered)
    tied += [one for one in rivals if SURE <= one.exceeds(best) < most]
    echoes = [*best.as_likely, *(one.echoes / max(best.echoes, 1) for one in tied)]
    doubt = max(echoes) - min(echoes)
    off = np.array([abs(one.system.sigma_ref / best.system.sigma_ref - 1) for one in tied])
    longer = np.array([one.exceeds(best) for one in tied])
    weight = exp(-0.5 * (longer - longer.min()) ** 2)
    spread = float(np.sqrt(np.sum(weight * off**2) / np.sum(weight)))
    tried = [
        Tried(
            one.name, one.system.sigma_ref * FWHM_PER_SIGMA, max(len(one.system.components), 1), one.change,
            one.typical, one.exceeds(best), one.echoes / len(one.length), one is best,
        )
        for one in sorted(every, key=lambda one: one.typical)
    ]  # fmt: skip
    other = any(one.gaussians != best.gaussians and not _saves_little(one, best) for one in tied)
    other |= off.max() > MOST_SPREAD or doubt > 1 - AS_FEW
    return Choice(best, tuple(tried), doubt, spread, other)


def _decide_by_more(block: WaveformBlock, found: list[Candidate], first: Choice) -> Choice:
    """The choice among the candidates that are not hopeless by other waveforms; the others keep their distance."""
    left = [one for one in found if one.exceeds(first.best) < HOPELESS]
    left = [_judge(block, one.name, one.system, one.change, known=one.known) for one in left]
    choice = _decide(_try_changes(block, left) if len(first.best.as_likely) > 1 else left)
    again = {one.name: one.typical for one in left}
    shift = again[first.best.name] - first.best.typical
    lost = [one._replace(nats=one.nats + shift) for one in first.tried if one.name not in again]
    return replace(choice, tried=tuple(sorted([*choice.tried, *lost], key=lambda one: one.nats)))


def _save(shorter: Candidate, longer: Candidate) -> float:
    """Nats per echo that one candidate saves in place of another."""
    return (longer.typical - shorter.typical) * len(longer.length) / max(longer.echoes, 1)


def _saves_little(shorter: Candidate, longer: Candidate) -> bool:
    """Whether a candidate surely saves too little to be taken in place of another: more waveforms change nothing."""
    error = np.std(shorter.length - longer.length) * np.sqrt(len(longer.length)) / max(longer.echoes, 1)
    return bool(_save(shorter, longer) + SURE * error < _need_saved(shorter, longer))


def _is_as_wide(one: Candidate, other: Candidate) -> bool:
    return abs(one.system.sigma_ref / other.system.sigma_ref - 1) <= OTHER_WIDTH


def _need_saved(shorter: Candidate, longer: Candidate) -> float:
    """Nats per echo that a candidate must save to be taken in place of another."""
    if longer.known and not shorter.known and _is_as_wide(shorter, longer):
        return LEAST_OF_KNOWN
    return LEAST_SAVED if longer.gaussians == 1 < shorter.gaussians else 0.0


def _beats(shorter: Candidate, longer: Candidate) -> bool:
    """Whether a candidate describes so much shorter, in nats per echo and in standard errors, that it is taken in place
    of the other."""
    if _save(shorter, longer) <= _need_saved(shorter, longer):
        return False
    most = max(SHOWN * float(np.sqrt(max(shorter.answered, longer.answered))), HINT)
    fewer = float(np.clip((1 - shorter.echoes / max(longer.echoes, 1)) / (1 - FEWER), -1.0, 1.0))
    doubtful = AS_FEW * shorter.echoes <= longer.echoes and longer.gaussians > 1
    doubtful |= longer.missed > max(COVERED * longer.change, shorter.missed)
    blind = longer.answered < BLIND * shorter.answered
    if blind or (doubtful and not longer.known):
        errors = HINT
    else:
        errors = min(SURE - HINT * (min(fewer, 0.0) if longer.known else fewer), most)
    return longer.exceeds(shorter) > errors


def settle(
    block: WaveformBlock,
    system: SystemPulse,
    echoes: EchoTable,
    seen: float = 1.0,
    missed: float = 0.0,
    change: float = 0.0,
) -> tuple[SystemPulse, Mirror, float]:
    """Choose the misfit by the length of descriptions, then raise the significance until noise adds no echoes.

    Parameters
    ----------
    block : WaveformBlock
        Cleaned waveforms.
    system : SystemPulse
        With the pulse that the judge chose.
    echoes : EchoTable
        Of a sample, decomposed with this pulse.
    seen : float
        Change of the pulse from shot to shot that its strongest echoes show, as a share of the amplitude.
    missed : float
        What the pulse is known to miss of the strip's stacked echoes, as a share of the amplitude: the least misfit.
    change : float
        Change of the pulse from shot to shot that describes waveforms best, from which misfits are looked for.

    Returns
    -------
    system : SystemPulse
        With `misfit`, the `faint_share` that goes with it, and `significance`.
    mirror : Mirror
        Echoes of mirrored residuals that are left.
    doubt : float
        Share by which the number of echoes differs between misfits that cost the same.
    """
    part = thin_block(block, int(np.clip(4 * SAMPLES // block.samples.shape[1], 2 * LEAST, 2048)))
    # What clipped echoes hide is no misfit, and has no mirror.
    whole = np.flatnonzero((part.samples < clip_level(part, system)).all(axis=1))
    part = part.rows(whole) if len(whole) >= FEWEST else part

    def at(misfit: float) -> SystemPulse:
        """What a misfit leaves beside strong echoes is tried with it: else it explains faint targets."""
        return limit_faint(replace(system, misfit=misfit), max(seen, LEAST_MISFIT), echoes)

    system, doubt, explained = _choose_misfit(part, at, seen, change, missed)
    harder = np.arange(SIGNIFICANCE + FINER, MOST_SIGNIFICANT + FINER, FINER)
    tried = []
    for significance, mirror in look_in_mirror(part, system, explained, [0.0, *map(float, harder)]):
        tried.append((replace(system, significance=significance), mirror))
        allowed = FALSE_QUIET * mirror.echoes
        if mirror.quiet <= allowed + np.sqrt(allowed):  # no more than chance: one standard deviation
            break
    best = max(tried, key=lambda one: one[1].worth)
    first = tried[0][1]
    found, mirror = best if best[1].worth - first.worth > GAINED * first.echoes else tried[0]
    # White noise has so many peaks in all waveforms together, twice as many with free widths, of which exp(-u^2 / 2)
    # are above u. The mirror of a few long waveforms does not show them.
    peaks = np.count_nonzero(explained.sums.used) * part.spacing / (np.sqrt(2) * np.pi * system.sigma_ref)
    least = float(np.sqrt(2 * log(max(peaks / (FALSE_QUIET * max(len(explained.echoes), 1)), 1.0))))
    if least > max(SIGNIFICANCE, found.significance):
        found = replace(found, significance=least)
    return found, replace(mirror, quiet=max(mirror.quiet, count_holes(system, explained, part.spacing))), doubt


def _choose_misfit(
    block: WaveformBlock, at: Callable[[float], SystemPulse], seen: float, change: float, missed: float = 0.0
) -> tuple[SystemPulse, float, Explained]:
    """The system by `at` with the least misfit that describes in at most one standard error more than the shortest, or
    the shortest where fits are whitened; its doubt, and its echoes.

    It decides what is split beside strong echoes: with too little of it echoes describe what the pulse misses, with too
    much of it neighbours are not found, and both lengthen the description. Where it begins to be as short, steps are
    halved down to FINEST; between the last two it is found by their standard errors: halves of a strip then agree.
    The doubt is the share by which the number of echoes differs between misfits whose descriptions are longer by at
    most one.
    """
    changes = [change for change in CHANGES if change <= STEP_OF_CHANGES * seen]
    found: dict[float, Looked] = {}
    lengths: dict[float, np.ndarray] = {}
    plain = at(0.0)

    def look(*places: float) -> tuple[float, list[float]]:
        """The best place of those tried, and by how many standard errors each of them is longer, by the best change."""
        for place in places:
            if place not in found:
                found[place] = _explain_between(block, at(float(MISFITS[0] * 2.0**place)), changes, found, place)
            if place not in lengths:
                looked = found[place]
                lengths[place] = describe_waveforms(block, plain, looked.explained, changes, looked.left)
        tried = product(sorted(lengths), range(len(changes)))
        best, change = min(tried, key=lambda one: lengths[one[0]][one[1]].mean())
        least = lengths[best][change]
        return best, [count_errors(lengths[place][change] - least) for place in sorted(lengths)]

    # Places in MISFITS. From coarse to fine, and no further down or up than echoes are false, or lost, for sure. Each
    # step looks first at its ends: what they explain alike is not fitted again.
    middle = 6 if COVERED * change > MISFITS[5] else 2
    for end in (0, len(MISFITS) - 1):
        if middle == 2:  # the largest is nearly always looked at, and few waveforms lie between the two
            found[end] = _explain_between(block, at(float(MISFITS[end])), changes, found, end)
    best, longer = look(middle - 2, middle + 2, middle)
    while longer[0] < SURE and min(lengths) > 0:
        best, longer = look(min(lengths) - 2)
    while longer[-1] < SURE and max(lengths) + 4 < len(MISFITS):
        best, longer = look(max(lengths) + 4, max(lengths) + 2)
    if longer[0] > 1:
        best, longer = look(*(place for place in (best - 1, best + 1) if place < len(MISFITS)))
        first = next(place for place, errors in zip(sorted(lengths), longer, strict=True) if errors <= 1)
        if first:
            best, longer = look(first - 1)
    while longer[0] <= 1 and min(lengths) > 0:  # what was looked at last may be the shortest
        best, longer = look(min(lengths) - 1)
    places, misfit = sorted(lengths), 0.0
    # A filter for noise makes echoes of what the pulse lacks: with less misfit than the best, whitened fits add them.
    most = 0.0 if plain.noise.whitening else 1.0
    while longer[0] > most:
        first = next(place for place, errors in enumerate(longer) if errors <= most)
        (before, after), (over, under) = places[first - 1 : first + 1], longer[first - 1 : first + 1]
        if after - before <= FINEST:
            misfit = float(MISFITS[0] * 2.0 ** (before + (over - most) / (over - under) * (after - before)))
            break
        best, longer = look((before + after) / 2)
        places = sorted(lengths)
    between = np.linspace(places[0], places[-1], 8 * len(MISFITS))
    numbers = np.interp(between, places, [len(found[place].explained.echoes) for place in places])
    as_likely = numbers[np.interp(between, places, longer) <= 1]
    doubt = float(np.ptp(as_likely)) / max(len(found[best].explained.echoes), 1) if len(as_likely) else 0.0
    # In a canopy neighbours are in the stack too: no more than descriptions allow.
    allowed = between[np.interp(between, places, longer) <= SURE]
    misfit = max(misfit, min(missed, float(MISFITS[0] * 2.0 ** max(allowed, default=0.0))))
    place = float(np.log2(max(misfit / MISFITS[0], 1.0)))  # none is taken where the least one was looked at
    return at(misfit), doubt, _explain_between(block, at(misfit), changes, found, place).explained


class Looked(NamedTuple):
    """Waveforms decomposed with one misfit."""

    explained: Explained
    left: Left
    """What `describe_left` says of each of them."""


def _explain_between(
    block: WaveformBlock, system: SystemPulse, changes: list[float], found: Mapping[float, Looked], place: float
) -> Looked:
    """Echoes of a block with a misfit. What the next smaller and the next larger one explain alike, it does too."""
    below = max((one for one in found if one <= place), default=None)
    above = min((one for one in found if one >= place), default=None)
    if below is None or above is None:
        explained = explain(block, system)
        return Looked(explained, describe_left(explained.sums, sample_noise(system), changes))
    near = found[below]
    rows = find_changed(near.explained, found[above].explained)
    if not len(rows):
        return near
    part = explain(block.rows(rows), system)
    length, volume = (one.copy() for one in near.left[:2])
    length[:, rows], volume[rows] = describe_left(part.sums, sample_noise(system), changes)[:2]
    return Looked(replace_rows(near.explained, rows, part), near.left._replace(length=length, volume=volume))
