"""What sensor and scene are: noise, system pulse, saturation, and which parts of a chain this strip needs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.order import quantile
from wavebatch.core.units import LEAST_PULSE_WIDTH
from wavebatch.core.waveforms import Defects, LevelWidths, SystemPulse, WaveformBlock
from wavebatch.files.toml_file import list_entries
from wavebatch.kernels.signal.defects import find_seam
from wavebatch.stages.clean import clean_block, mark_seam, measure_defects
from wavebatch.stages.flags import RINGING_REACH
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.surveying.look import compare_levels, describe_level, join_digitizers, kind_of, pool_blocks, weigh
from wavebatch.surveying.measuring.choose_pulse import JOINTLY, STACKED, SUMMED, bear, choose_pulse, learn_alone, settle
from wavebatch.surveying.measuring.joint_pulse import LEAST_CHANGE
from wavebatch.surveying.measuring.judge import SURE
from wavebatch.surveying.measuring.learn_pulse import find_clear, find_isolated, learn_pulse, measure_skew
from wavebatch.surveying.measuring.misfit import (
    MISFIT_PEAK,
    MOST_FAINT,
    limit_faint,
    raise_misfit,
    share_fixed,
    share_placed,
)
from wavebatch.surveying.measuring.noise_and_width import (
    ENOUGH_TO_LEARN,
    FEW,
    FIRST_WIDTH,
    LEAST_HELD,
    MIN_SNR,
    RESIDUAL_LOOK,
    SMALL,
    measure_again,
    measure_begin,
    measure_gaussian,
    measure_once_more,
    measure_quiet,
    measure_scatter,
    measure_whole,
    thin_empty,
    thin_samples,
)
from wavebatch.surveying.measuring.residuals import decompose_again, decompose_sample, guess_growth, measure_residuals
from wavebatch.surveying.measuring.tails import find_parts, measure_beside, measure_tail
from wavebatch.surveying.measuring.whitening import choose_whitening, lower_noise
from wavebatch.surveying.predict_error import measure_hidden
from wavebatch.surveying.systems.figures import Figures, Kind, describe_scene, note_counts
from wavebatch.surveying.systems.known_systems import MOST_DOUBTED, guess_width, list_known
from wavebatch.surveying.systems.survey_result import Decision, Part, Survey, Tried

NARROWER = 0.85
"""Width of the chosen pulse, over that of isolated echoes, below which quiet samples are looked for once more if there
were none: those next to signal are not quiet, by widths of the pulse. Without isolated echoes they were found with a
guess of it."""

LEAST_RINGING = 0.01
"""Share of an echo from which what a Gaussian leaves after each one is an after-pulse, whose echoes get a flag."""


def survey_blocks(blocks: Iterable[WaveformBlock], *, learn: bool = True, errors: bool = True) -> Survey:
    """Survey of a strip from blocks sampled over it.

    Parameters
    ----------
    blocks : iterable of WaveformBlock
        Of any descriptors and lengths, in any order.
    learn : bool
        Also learn the pulse's shape; without it the pulse is the Gaussian of the isolated echoes' width.
    errors : bool
        Also measure what neighbours that are not found do to echoes, which only errors hold.

    Returns
    -------
    Survey
        Of the digitizer with the most samples; others have pulse and noise of their own in `system.digitizers`.

    Notes
    -----
    A descriptor is not a digitizer: descriptors that differ in the number of samples only are surveyed together,
    unless their level, noise or clipping differ by more than chance (`find_strangers`).
    """
    blocks = list(blocks)
    joined = join_digitizers(blocks)
    if not joined:
        return Survey(SystemPulse(sigma_ref=FIRST_WIDTH), 0)
    places = {block.digitizer.n_samples: find_seam(block.samples) for block in joined}
    seams = {length: at for length, at in places.items() if at}
    # Descriptors that differ in length only are pooled, the largest first.
    kinds: dict[Kind, list[WaveformBlock]] = {}
    for block in joined:
        kinds.setdefault(kind_of(block), []).append(mark_seam(block, seams))
    groups = [(pool_blocks(members), members) for members in kinds.values()]
    groups.sort(key=lambda group: weigh(group[0]), reverse=True)
    (main, members), *others = groups
    begin = measure_begin(main)
    strangers = find_strangers(members, begin) if len(members) > 1 else {}
    if strangers:
        others = [*((block, [block]) for block in members if block.digitizer.index in strangers), *others]
        members = [block for block in members if block.digitizer.index not in strangers]
        main = pool_blocks(members)
        begin = measure_begin(main)
    raw = main
    main, plain = clean_sample(raw, begin)
    found = _survey(main, plain, learn=learn, errors=errors)
    note_counts(found.figures, raw)
    found.figures.descriptors_pooled = float(len(members))
    if others:
        # What each of the others records otherwise, and the scene that all see.
        own_systems, counts, scenes, named = {}, [found.waveforms], [found.figures], []
        for block, members in others:
            own = found.system
            strange = strangers.get(block.digitizer.index)
            if strange or not _records_alike(plain, main, block):
                own = _survey_other(found.system, block, learn=learn, errors=errors)
                own_systems.update({member.digitizer.index: own for member in members})
                reason = strange or "its bits, spacing, gain, offset, level, noise or pulse differ from the main one's"
                named.append(Decision(f"digitizer {block.digitizer.index}", True, reason))
            counts.append(len(block))
            scenes.append(describe_scene(Figures(), block, own, decompose_sample(block, own), MIN_SNR))
        names = [one.field for one in list_entries(Figures) if one.key.averaged]
        shares: dict[str, Any] = {
            name: float(np.average([getattr(scene, name) for scene in scenes], weights=counts)) for name in names
        }
        figures = replace(found.figures, **shares)
        kept = (*_decide(found.system, main.spacing, figures, found.candidates), *named)
        whole = replace(found.system, digitizers=own_systems)
        found = Survey(whole, sum(counts), figures, kept, found.candidates)
    systems = {index: replace(own, seams=seams) for index, own in found.system.digitizers.items()}
    decisions = list(found.decisions)
    for length, at in sorted(seams.items()):
        reason = f"packets of {length} samples are interpolated at sample {at}: two recordings meet there"
        decisions.append(Decision("seam left out", True, reason))
    given = sum(map(len, blocks))
    if copies := given - sum(map(len, joined)):
        reason = f"{copies} of {given} waveforms are copies of others, and show nothing more"
        decisions.append(Decision("copies count once", True, reason))
    system = replace(found.system, seams=seams, digitizers=systems)
    return replace(found, system=system, decisions=tuple(decisions))


def find_strangers(members: list[WaveformBlock], plain: SystemPulse) -> dict[int, str]:
    """Descriptors whose waveforms cannot come from the digitizer of the others, by index, with the reason.

    Parameters
    ----------
    members : list of WaveformBlock
        One block per descriptor; all have the same bits, spacing, gain and offset.
    plain : SystemPulse
        Noise of all of them together.

    Notes
    -----
    The level of a waveform is that of its own quiet samples. A descriptor is a stranger if its mean level is both
    STRANGE standard errors and half the noise away from that of the others, if its noise differs by STRANGE standard
    errors and a factor STRANGE_NOISE, or if it is clipped at another count. STRANGE is 6: among 24 descriptors chance
    does so once in 10^7 strips. Widths are no evidence: long packets see other targets.
    """
    facts = {block.digitizer.index: describe_level(block, plain) for block in members}
    strangers = {}
    # The rarest first; the commonest is never a stranger to the few.
    for index in list(facts)[:0:-1]:
        own = facts[index]
        rest = [fact for other, fact in facts.items() if other != index and other not in strangers]
        reason = compare_levels(own, rest, plain.noise.std)
        if reason:
            strangers[index] = reason
    return strangers


def _records_alike(plain: SystemPulse, main: WaveformBlock, block: WaveformBlock) -> bool:
    """Whether a block's digitizer has level, noise, pulse width and clipping of the main one.

    plain: Gaussian and noise of the main one, without its defects.
    """
    if block.digitizer.bits != main.digitizer.bits:
        return False
    other = measure_gaussian(block, plain.sigma_ref / block.spacing)
    slack = 0.25 * plain.noise.std + 3 * plain.noise.baseline_spread / np.sqrt(len(block))
    alike = abs(other.noise.baseline - plain.noise.baseline) < slack
    for ratio, most in ((other.noise.std / plain.noise.std, 1.2), (other.sigma_ref / plain.sigma_ref, 1.04)):
        alike &= 1 / most < ratio < most
    # Where an amplifier clips, its level is measured: to a hundredth.
    clips = (other.saturation or main.digitizer.max_count) / clip_level(main, plain)
    return bool(alike and abs(clips - 1) < 0.01)


def _survey_other(system: SystemPulse, block: WaveformBlock, *, learn: bool, errors: bool) -> SystemPulse:
    """The system of another digitizer; where its echoes are too few for a pulse, the main one's with its noise."""
    own = survey_block(block, learn=learn, errors=errors)
    if not learn or (own.figures.isolated_echoes or 0.0) >= FEW:
        return own.system
    measured = measure_gaussian(block, system.sigma_ref / block.spacing)
    other = replace(system, noise=measured.noise, saturation=measured.saturation)
    # The main one's pulse, but what echoes must exceed beside strong ones follows from this one's noise too.
    echoes = decompose_sample(block, other)
    return limit_faint(replace(other, faint_share=MOST_FAINT), system.faint_share / MISFIT_PEAK, echoes)


def survey_block(block: WaveformBlock, *, learn: bool = True, errors: bool = True) -> Survey:
    """Survey of one block: noise and width of isolated echoes, the pulse's shape, noise again, the threshold."""
    if not len(block):
        return Survey(SystemPulse(sigma_ref=FIRST_WIDTH), 0)
    found = _survey(*clean_sample(block, measure_begin(block)), learn=learn, errors=errors)
    note_counts(found.figures, block)
    return found


def clean_sample(block: WaveformBlock, begin: SystemPulse) -> tuple[WaveformBlock, SystemPulse]:
    """The block without its defects, and its noise and width with them, from where `measure_begin` ended."""
    guessed = begin.sigma_ref == FIRST_WIDTH * block.spacing
    if guessed:  # too few echoes stand alone to know how far signal reaches
        begin = measure_whole(block, begin)
    found = measure_defects(block, begin)
    if not found.defects:
        return block, begin if guessed else measure_whole(block, begin)
    block = clean_block(block, found)
    return block, replace(measure_whole(block, begin, cleaned=True), defects=found.defects)


def _survey(
    block: WaveformBlock,
    system: SystemPulse,
    *,
    learn: bool,
    errors: bool,
    guessed: bool | None = None,
    shown: float = 1.0,
) -> Survey:
    """As survey_block, from noise and width by `clean_sample`; once more where noise grows with the signal.

    guessed: whether the growth of noise in `system` is a guess, or False where fits showed it; None before both.
    shown: share of it that fits without it showed: at the limit of chance tiles would have none of it, or all.
    """
    first, figures, repeated, lowered, fixed_share = system, Figures(), [], 0.0, 0.0
    candidates: tuple[Tried, ...] = ()
    if learn:
        clear = find_clear(block, system)
        growth = guess_growth(block, system, clear) if guessed is None else 0.0
        if growth > 0:
            return _survey(block, measure_again(block, first, growth), learn=learn, errors=errors, guessed=True)
        main = find_isolated(block, system, clear)
        figures.isolated_echoes = len(main)
        # What is clear is an echo also beside the strongest ones: else the pulse that is learned has it in its tail.
        if len(clear):
            share = MIN_SNR * system.noise.std / quantile(clear.amplitude, 0.99)
            system = replace(system, faint_share=min(max(share, LEAST_CHANGE), MOST_FAINT))
        starts, plain = _list_starts(block, system, clear, main, figures)
        known, many = list_known(block, system), len(main) >= SMALL
        choice = choose_pulse(thin_empty(block, system), starts, known, plain=plain, many=many)
        # Starts of guessed widths are measured from nothing, and know no defects.
        system = replace(choice.best.system, defects=first.defects, faint_share=MOST_FAINT)
        candidates = choice.tried
        figures.description_nats, figures.pulse_change = choice.best.typical, choice.best.change
        gaussians = (one.nats for one in choice.tried if one.name.startswith("gaussian"))
        figures.gaussian_nats = min(gaussians, default=None)
        part = thin_samples(block, RESIDUAL_LOOK)
        narrower = not first.noise.by_kind["quiet"] and system.sigma_ref < NARROWER * first.sigma_ref
        if narrower or len(main) < ENOUGH_TO_LEARN:
            noise = measure_once_more(block, system)
            if narrower or noise.by_kind["quiet"]:
                system = replace(system, noise=replace(noise, gain=first.noise.gain))
        borne = bear(system, choice.best.change)
        echoes = decompose_sample(part, borne)
        system, share = measure_residuals(part, system, echoes, shown)
        if guessed or (guessed is None and system.noise.gain > 0):
            again, shown = measure_again(block, first, system.noise.gain), 1.0 if guessed else share
            return _survey(block, again, learn=learn, errors=errors, guessed=False, shown=shown)
        noise, looked = lower_noise(part, replace(borne, noise=system.noise))
        if noise is not system.noise:
            lowered = system.noise.std
            system, borne = replace(system, noise=noise), replace(borne, noise=noise)
            echoes = decompose_sample(part, borne)
        tailed = measure_tail(block, system, clear)
        system = find_parts(part, tailed, echoes)
        repeated = sorted(set(system.tail_misfit) - set(tailed.tail_misfit))
        if not (system.components or system.kappa):  # a plain Gaussian: what it leaves after each echo
            tail = (share for lag, share in system.tail_misfit if 0 < lag <= RINGING_REACH * system.sigma_ref)
            system = replace(system, ringing=max((share for share in tail if share >= LEAST_RINGING), default=0.0))
        # With the misfit that the change asks for whitened fits make no echoes of it, without it they keep close pairs:
        # either will do, as the misfit is chosen after it: first the one that was looked at.
        borne = replace(borne, noise=system.noise)
        tried = (borne, system) if borne.misfit > system.misfit else (system,)
        noises = (choose_whitening(part, one, choice.best.change, looked).noise for one in tried)
        system = replace(system, noise=next((noise for noise in noises if noise.whitening), system.noise))
        system, mirror, doubt = settle(block, system, echoes, choice.best.seen, choice.best.missed, choice.best.change)
        figures.false_in_noise_share = min(mirror.quiet / max(mirror.echoes, 1), 1.0)
        figures.false_by_misfit_share = min(mirror.beside / max(mirror.mains, 1), 1.0)
        echoes = decompose_again(part, system, borne, echoes)
        most = bear(system, choice.best.change).misfit if choice.best.change else 0.0
        mirrored = mirror.beside / max(mirror.echoes, 1)  # of another sample
        system, echoes, doubts = raise_misfit(part, system, echoes, most, mirrored)
        figures.placed_share = share_placed(echoes, system.sigma_ref, len(part))
        fixed_share = share_fixed(echoes, len(part), block.spacing)
        figures.width_in_doubt = choice.spread
        # Neighbours too close to be found stay in the mirror too, but never beside so many of the strong echoes.
        beside = mirror.beside - float(np.sqrt(mirror.beside)) if mirror.beside >= LEAST_HELD else 0.0
        missed = beside / max(mirror.mains, 1)
        shares = choice.doubt, doubt, *doubts, fixed_share, missed if missed > MOST_DOUBTED else 0.0
        figures.echoes_in_doubt = min(max(shares), 1.0)
    else:
        part = thin_samples(block, RESIDUAL_LOOK)
        echoes = decompose_sample(part, system)
    system = measure_hidden(part, measure_beside(part, system, echoes), echoes) if errors else system
    system = replace(system, widths=LevelWidths(scatter=measure_scatter(part, system, echoes)))
    system = measure_skew(part, system, echoes) if learn else system
    figures = describe_scene(figures, part, system, echoes, MIN_SNR)
    decisions = (*_decide(system, block.spacing, figures, candidates), *_decide_defects(system.defects))
    if fixed_share:
        reason = f"{100 * fixed_share:.0f} % of the echoes stand at one sample of most waveforms and are as high: "
        reason += "they may be the receiver's, as a start pulse that leaks: look at some with `wavebatch plot waveform`"
        decisions = (*decisions, Decision("echoes at one sample", True, reason))
    if lowered:
        reason = f"noise is {system.noise.std:.2f} DN without them, {lowered:.2f} with them; the echoes found "
        reason += "with less noise describe the waveforms shorter, and few of them are false"
        decisions = (*decisions, Decision("echoes hidden in the noise", True, reason))
    if repeated:
        share, lags = max(share for _, share in repeated), f"{repeated[0][0]:+.1f} to {repeated[-1][0]:+.1f} ns"
        reason = f"every strong echo has one of up to {100 * share:.1f} % of it at {lags}: echoes there must be higher"
        decisions = (*decisions, Decision("part of the pulse", True, reason))
    return Survey(system, len(block), figures, decisions, candidates)


def _list_starts(
    block: WaveformBlock, system: SystemPulse, clear: EchoTable, main: EchoTable, figures: Figures
) -> tuple[dict[str, SystemPulse], bool]:
    """Pulses that lone echoes teach, by name, and whether a Gaussian is all that they show.

    main: the isolated ones of the clear echoes. Figures get what is left of them.
    """
    starts = {"gaussian": system}
    if len(main) >= ENOUGH_TO_LEARN:
        starts |= dict(zip((STACKED, SUMMED), learn_pulse(block, system, clear, main, figures), strict=False))
    else:
        guess = guess_width(block, system)
        starts |= {} if guess is None else {"single echoes": guess}
        # From the narrowest that a sample can show to an eighth of a waveform: a wider pulse leaves no quiet sample.
        most = max(block.samples.shape[1] / 8, 1.0)
        widths = [0.75 * 2.0**step for step in range(int(np.log2(most / 0.75)) + 1)]
        starts |= {f"gaussian of {width:g} samples": measure_quiet(block, width) for width in widths}
    # Where a Gaussian misses the lone echoes by less than noise shows, there is nothing to learn but its width.
    plain = len(block) >= SMALL and figures.misfit_gaussians.get(1, np.inf) <= (figures.misfit_goal or 0.0)
    if STACKED in starts and not plain:
        starts[JOINTLY] = learn_alone(block.rows(main.waveform), starts[STACKED])
    return starts, plain


def _decide(
    system: SystemPulse, spacing: float, figures: Figures, candidates: tuple[Tried, ...]
) -> tuple[Decision, ...]:
    """The table of docs/algorithms.md 4.4: what this scene needs, and the reason for each part left out."""
    width = system.sigma_ref / spacing
    share, strongest = figures.overlapped_share or 0.0, figures.amplitude_99 or 0.0
    saturated, system_like = figures.saturated_share or 0.0, figures.system_width_share or 0.0
    learned = len(system.components)
    inverted = "the signal goes down from its baseline: counts are mirrored when they are read"
    pulse = "no pulse was looked for"
    if candidates:
        chosen = next(one for one in candidates if one.chosen)
        others = [one for one in candidates if not one.chosen]
        pulse = f"{chosen.name}: {chosen.nats:.1f} nats describe a waveform"
        pulse += "".join(f", {one.nats:.1f} with {one.name}" for one in others[:2])
        if any(one.longer_by < -SURE for one in others):
            pulse += "; a shorter one saves too little per echo, or needs more echoes"
    skew = "no pulse was learned"
    if figures.misfit_skewed is not None:
        misfit = f"it misses the stacked echoes by {figures.misfit_skewed:.4f} of the amplitude"
        misfit += "" if figures.misfit_goal is None else f"; noise hides {figures.misfit_goal:.4f}"
        skew = f"with kappa {figures.kappa:z.3f} {misfit}"
    return (
        *((Decision(Part.INVERTED, True, inverted),) if figures.inverted else ()),
        Decision(Part.PULSE, learned > 1, pulse),
        Decision(Part.SKEW, system.kappa != 0, skew),
        Decision(Part.GROWTH, share >= 0.02, f"{100 * share:.1f} % of the waveforms hold overlapping echoes"),
        Decision(Part.PRIOR, share > 0.4, f"{100 * share:.1f} % of the waveforms hold overlapping echoes (limit 40 %)"),
        Decision(
            Part.CENSORED,
            system.saturation is not None and saturated > 0,
            f"{100 * saturated:.2f} % of the waveforms are saturated",
        ),
        Decision(
            Part.WEIGHTS,
            system.noise.gain > 0,
            f"variance grows by {system.noise.gain * strongest:.2f} DN2 up to {strongest:.0f} DN, "
            f"against {system.noise.std**2:.2f} DN2 without signal",
        ),
        Decision(
            Part.WIDTH,
            width >= LEAST_PULSE_WIDTH,
            f"the system pulse is {width:.2f} samples wide (limit {LEAST_PULSE_WIDTH})",
        ),
        Decision(
            Part.ANGLE,
            width >= LEAST_PULSE_WIDTH and system_like < 0.95,
            f"{100 * system_like:.0f} % of the clear echoes have the width of the system pulse; a "
            "chain has angles only where the beam's divergence is given",
        ),
    )


def _decide_defects(defects: Defects) -> Iterator[Decision]:
    """What is taken off the waveforms before anything else, of those that have it."""
    if defects.pattern:
        offsets = ", ".join(f"{offset:+.2f}" for offset in defects.pattern)
        yield Decision("pattern taken off", True, f"samples differ in turn by {offsets} DN: several converters")
    if defects.slope_spread:
        yield Decision("slopes taken off", True, f"baselines rise or fall, by {defects.slope_spread:.3g} DN/ns (std)")
    if defects.spikes:
        yield Decision("spikes taken off", True, f"{defects.spikes:.3g} spikes of one sample per waveform")
    if defects.transient:
        yield Decision("start left out", True, f"the first {defects.transient:g} ns of the waveforms jump")
