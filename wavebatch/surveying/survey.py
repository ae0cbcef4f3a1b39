"""What sensor and scene are: noise, system pulse, saturation, and which parts of a chain this strip needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable
from wavebatch.core.units import LEAST_PULSE_WIDTH, SQUARED_NORMAL_MEDIAN
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.surveying.learn_pulse import find_isolated, find_strong, learn_pulse
from wavebatch.surveying.measure import (
    ENOUGH_TO_LEARN,
    FEW,
    FIRST_WIDTH,
    MIN_SNR,
    RESIDUAL_LOOK,
    choose_acceptance,
    choose_misfit,
    decompose_sample,
    measure_gaussian,
    measure_residuals,
    thin_block,
)

SAMPLE = 8192
"""Waveforms that a survey looks at."""

COUNTED = 256
"""Samples of a waveform that count where the main digitizer is chosen."""


class Part(StrEnum):
    """Parts of a chain that a survey decides on; the values stand in files and reports."""

    PULSE = "learned pulse"
    SKEW = "skewed pulse"
    GROWTH = "growth of fits"
    PRIOR = "width prior"
    CENSORED = "censored fit"
    WEIGHTS = "signal-dependent weights"
    WIDTH = "echo width"
    ANGLE = "incidence angle"


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether the strip needs a part of the chain, and why."""

    part: str
    """A Part; any text where a file of another version has it."""
    needed: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Survey:
    """What a sample of a strip says of sensor and scene."""

    system: SystemPulse
    waveforms: int
    figures: Mapping[str, float]
    """Shares of the scene, isolated echoes, amplitudes, and the misfit of every pulse model tried."""
    decisions: tuple[Decision, ...]


def survey_blocks(blocks: Iterable[WaveformBlock], *, learn: bool = True) -> Survey:
    """Survey of a strip from blocks sampled over it; the digitizer with the most samples decides.

    Others that record otherwise get pulse and noise of their own, and count in the shares of the scene.
    learn: also learn the pulse's shape; without it the pulse is the Gaussian of the isolated echoes' width.
    """
    main, *others = join_digitizers(blocks) or [None]
    if main is None:
        return Survey(SystemPulse(sigma_ref=FIRST_WIDTH), 0, {}, ())
    plain = measure_gaussian(main)
    found = _survey(main, plain, learn=learn)
    return _add_digitizers(found, plain, main, others, learn=learn) if others else found


def join_digitizers(blocks: Iterable[WaveformBlock]) -> list[WaveformBlock]:
    """The samples of each digitizer as one block, cut to one length; the largest first.

    Samples of long waveforms count up to 256 each: it takes many waveforms to learn a pulse.
    """
    groups: dict[int, list[WaveformBlock]] = {}
    for block in blocks:
        if len(block):
            groups.setdefault(block.digitizer.index, []).append(block)
    joined = [_join(group) for _, group in sorted(groups.items())]
    return sorted(joined, key=lambda block: -_weigh(block.samples.shape[1], len(block)))


def _join(group: list[WaveformBlock]) -> WaveformBlock:
    """Waveforms of one digitizer as one block: those of the length with most samples, if these are half of all.

    Otherwise those that are long enough, cut to the length that keeps most samples.
    """
    lengths = np.repeat([block.samples.shape[1] for block in group], [len(block) for block in group])
    kinds, numbers = np.unique(lengths, return_counts=True)
    weights = [_weigh(*kind) for kind in zip(kinds.tolist(), numbers.tolist(), strict=True)]
    length = int(kinds[np.argmax(weights)])
    if 2 * max(weights) >= sum(weights):
        kept = [block for block in group if block.samples.shape[1] == length]
    else:
        weights = [_weigh(s, int(np.count_nonzero(lengths >= s))) for s in kinds.tolist()]
        length = int(kinds[np.argmax(weights)])
        kept = [block for block in group if block.samples.shape[1] >= length]
    digitizer = replace(group[0].digitizer, n_samples=length)
    samples = np.concatenate([block.samples[:, :length] for block in kept])
    block = WaveformBlock.from_samples(samples, spacing=digitizer.spacing, bits=digitizer.bits)
    return replace(block, digitizer=digitizer)


def _weigh(length: int, number: int) -> int:
    """Samples that count for a survey."""
    return min(length, COUNTED) * number


def _add_digitizers(
    found: Survey, plain: SystemPulse, main: WaveformBlock, others: list[WaveformBlock], *, learn: bool
) -> Survey:
    """The survey of the main digitizer with the others: what each records otherwise, and the scene that all see.

    plain: of the main one, as `measure_gaussian` finds it.
    """
    systems, counts, scenes = {}, [len(main)], [found.figures]
    for block in others:
        own = found.system
        if not _records_alike(plain, main, block):
            systems[block.digitizer.index] = own = _survey_other(found.system, block, learn=learn)
        counts.append(len(block))
        scenes.append(_describe(block, own, decompose_sample(block, own)))
    figures = dict(found.figures)
    for name in ("empty_share", "single_share", "overlapped_share", "echoes_per_waveform", "saturated_share"):
        figures[name] = float(np.average([scene[name] for scene in scenes], weights=counts))
    system = replace(found.system, digitizers=systems)
    return Survey(system, sum(counts), figures, _decide(system, main.spacing, figures))


def _records_alike(plain: SystemPulse, main: WaveformBlock, block: WaveformBlock) -> bool:
    """Whether a block's digitizer has level, noise, pulse width and clipping of the main one.

    plain: of the main one, as `measure_gaussian` finds it.
    """
    if block.digitizer.bits != main.digitizer.bits:
        return False
    other = measure_gaussian(block, plain.sigma_ref / block.spacing)
    slack = 0.25 * plain.noise_std + 3 * plain.baseline_spread / np.sqrt(len(block))
    alike = abs(other.baseline - plain.baseline) < slack
    for quantity, most in (("noise_std", 1.2), ("sigma_ref", 1.04)):
        ratio = getattr(other, quantity) / getattr(plain, quantity)
        alike &= 1 / most < ratio < most
    return bool(alike and (other.saturation or main.digitizer.max_count) == clip_level(main, plain))


def _survey_other(system: SystemPulse, block: WaveformBlock, *, learn: bool) -> SystemPulse:
    """The system of another digitizer; where its echoes are too few for a pulse, the main one's with its noise."""
    own = survey_block(block, learn=learn)
    if own.figures.get("isolated_echoes", 0) >= FEW or not learn:
        return own.system
    noise = measure_gaussian(block, system.sigma_ref / block.spacing)
    kept = ("baseline", "baseline_spread", "noise_std", "noise_by_kind", "saturation")
    return replace(system, noise_gain=0.0, **{name: getattr(noise, name) for name in kept})


def survey_block(block: WaveformBlock, *, learn: bool = True) -> Survey:
    """Survey of one block: noise and width of isolated echoes, the pulse's shape, noise again, the threshold."""
    if not len(block):
        return Survey(SystemPulse(sigma_ref=FIRST_WIDTH), 0, {}, ())
    return _survey(block, measure_gaussian(block), learn=learn)


def _survey(block: WaveformBlock, system: SystemPulse, *, learn: bool) -> Survey:
    """As survey_block, from noise and width as `measure_gaussian` finds them."""
    figures: dict[str, float] = {}
    if learn:
        main = find_isolated(block, system)
        figures["isolated_echoes"] = len(main)
        if len(main) >= ENOUGH_TO_LEARN:
            system = learn_pulse(block, system, main, figures)
        part = thin_block(block, RESIDUAL_LOOK)
        system = measure_residuals(part, system, decompose_sample(part, system))
        system = choose_acceptance(block, system, main)
        system = choose_misfit(block, system, *find_strong(block, system))
    echoes = decompose_sample(block, system)
    system = replace(system, width_scatter=_measure_scatter(block, system, echoes))
    figures.update(_describe(block, system, echoes))
    return Survey(system, len(block), figures, _decide(system, block.spacing, figures))


def _measure_scatter(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> float:
    """Scatter of the widths of clear echoes of one and the same width beyond the errors of their fits [ns].

    From those narrower than the system pulse: slopes and plants only widen. 0 with too few of them.
    """
    clear = (echoes.count(len(block))[echoes.waveform] == 1) & (echoes.amplitude > MIN_SNR * system.noise_std)
    clear &= (echoes.flags & np.uint16(UNCLEAN)) == 0
    below = clear & (echoes.sigma < system.sigma_ref)
    if np.count_nonzero(below) < ENOUGH_TO_LEARN:
        return 0.0
    lack = (system.sigma_ref - echoes.sigma[below]).astype(np.float64)
    excess = np.median(lack**2) / SQUARED_NORMAL_MEDIAN - np.median(echoes.sigma_err[below].astype(np.float64) ** 2)
    return float(np.sqrt(max(excess, 0.0)))


def _describe(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> dict[str, float]:
    """Shares and amplitudes of the scene."""
    n = len(block)
    number = echoes.count(n)
    overlapped = np.zeros(n, bool)
    overlapped[echoes.waveform[(echoes.flags & int(EchoFlag.OVERLAPPED)) != 0]] = True
    saturated = 0.0
    if system.saturation is not None:
        saturated = float((block.samples >= system.saturation).any(axis=1).mean())
    narrow = (number[echoes.waveform] == 1) & (echoes.amplitude > MIN_SNR * system.noise_std)
    deviation = (echoes.sigma - system.sigma_ref) / np.maximum(echoes.sigma_err, 1e-6)
    return {
        "spacing_ns": block.spacing,
        "n_samples": float(block.samples.shape[1]),
        "bits": float(block.digitizer.bits),
        "least_count": float(block.samples.min(initial=block.digitizer.max_count)),
        "largest_count": float(block.samples.max(initial=0)),
        "empty_share": float((number == 0).mean()),
        "single_share": float((number == 1).mean()),
        "overlapped_share": float(overlapped.mean()),
        "echoes_per_waveform": float(number.mean()),
        "amplitude_50": float(np.median(echoes.amplitude)) if len(echoes) else 0.0,
        "amplitude_99": float(np.quantile(echoes.amplitude, 0.99)) if len(echoes) else 0.0,
        "saturated_share": saturated,
        "system_width_share": float((np.abs(deviation[narrow]) < 3).mean()) if narrow.any() else 0.0,
    }


def _decide(system: SystemPulse, spacing: float, figures: Mapping[str, float]) -> tuple[Decision, ...]:
    """The table of docs/algorithms.md 4.4: what this scene needs, and the reason for each part left out."""
    width = system.sigma_ref / spacing
    share = figures["overlapped_share"]
    strongest = figures["amplitude_99"]
    learned = len(system.components)
    return (
        Decision(Part.PULSE, learned > 1, _explain_pulse(system, figures)),
        Decision(Part.SKEW, system.kappa != 0, _explain_skew(system, figures)),
        Decision(Part.GROWTH, share >= 0.02, f"{100 * share:.1f} % of the waveforms hold overlapping echoes"),
        Decision(Part.PRIOR, share > 0.4, f"{100 * share:.1f} % of the waveforms hold overlapping echoes (40 %)"),
        Decision(
            Part.CENSORED,
            system.saturation is not None and figures["saturated_share"] > 0,
            f"{100 * figures['saturated_share']:.2f} % of the waveforms are saturated",
        ),
        Decision(
            Part.WEIGHTS,
            system.noise_gain > 0,
            f"variance grows by {system.noise_gain * strongest:.2f} DN2 up to {strongest:.0f} DN, "
            f"against {system.noise_std**2:.2f} DN2 without signal",
        ),
        Decision(
            Part.WIDTH,
            width >= LEAST_PULSE_WIDTH,
            f"the system pulse is {width:.2f} samples wide ({LEAST_PULSE_WIDTH})",
        ),
        Decision(
            Part.ANGLE,
            width >= LEAST_PULSE_WIDTH and figures["system_width_share"] < 0.95,
            f"{100 * figures['system_width_share']:.0f} % of the clear echoes have the width of the system pulse",
        ),
    )


def _explain_pulse(system: SystemPulse, figures: Mapping[str, float]) -> str:
    """Why the pulse is, or is not, a sum of Gaussians."""
    if "misfit_1_gaussians" not in figures:
        return f"{int(figures.get('isolated_echoes', 0))} isolated echoes are too few to learn from ({ENOUGH_TO_LEARN})"
    one = figures["misfit_1_gaussians"]
    number = len(system.components)
    if number > 1:
        best = figures.get(f"misfit_{number}_gaussians", 0.0)
        return f"{number} Gaussians miss the stacked echoes by {best:.4f} of the amplitude, one by {one:.4f}"
    return f"one Gaussian misses the stacked echoes by {one:.4f} of the amplitude; a simple pulse is enough"


def _explain_skew(system: SystemPulse, figures: Mapping[str, float]) -> str:
    """Why the pulse is, or is not, skewed."""
    if "misfit_skewed" not in figures:
        return "no pulse was learned"
    misfit, kappa = figures["misfit_skewed"], figures["kappa"]
    return f"with kappa {kappa:.3f} it misses the stacked echoes by {misfit:.4f} of the amplitude"
