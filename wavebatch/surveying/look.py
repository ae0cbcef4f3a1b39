"""What a strip records, without a learned pulse, and whether two records are of one sensor.

`flight` compares the strips of a flight so, `survey` the descriptors of one strip; all commands with `--system` call
`check_saved`: another sensor, other settings, another unit. It compares what `flight` compares, except the level, which
the noise stage finds for every waveform. Before you change it: nothing may depend on the order in which blocks are
given. Slopes and forest widen echoes, so a strip of the same sensor must never be refused for its scene. All echoes of
a hillside are wider by the same: that is a doubt.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import quantile
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.elementary import log
from wavebatch.kernels.signal.noise import find_levels
from wavebatch.kernels.signal.signal import accumulate, quiet_mean, transpose_samples
from wavebatch.surveying.measuring.noise_and_width import (
    FAR_OFF,
    FEW,
    find_edge,
    find_saturation,
    measure_gaussian,
    measure_quiet,
)
from wavebatch.surveying.systems.figures import Kind, Level, Look
from wavebatch.surveying.systems.known_systems import compare_pulses, find_lone, fit_alone, with_pulse
from wavebatch.surveying.systems.survey_result import Survey

MOST_ECHOES = 200
"""Echoes, the strongest ones, in which pulses are compared; more do not change the answer."""

COUNTED = 256
"""Samples of a waveform that count where the main digitizer is chosen."""

LEAST_RISE = 16
"""Counts from the lowest to the highest sample of a waveform from which no other one is the same by chance: noise of a
quarter of a count moves some sample of its flanks."""

LEAST_QUIET_SAMPLES = 4
"""Samples before the strongest echo from which a waveform has a level."""

LEAST_LEVELS = 5
"""Waveforms of a descriptor from which on its level is compared with that of others."""

STRANGE, STRANGE_NOISE = 6.0, 1.3
"""Standard errors, and ratio of the noise, from which a descriptor is a digitizer of its own."""

NARROWER = 0.06
"""How much narrower than those of the flight the echoes of a strip may be, as a share of the width: find_edge gives it
to 1 to 3 %."""

WIDER, STEADY = 0.10, 0.5
"""How much wider they may be, where more than this share of them have nearly one width. Slopes and forest widen echoes
by any amount, but never most of them by the same."""

OTHER_NOISE = 1.5
"""Ratio of the noise of two strips from which they are of two sensors: that of one sensor grows with the light of the
scene, on strips of one RIEGL from .62 to .89 DN."""

SAME_WIDTH = 0.06
"""How far from the edge a width may be to count as the same, as a share of it."""

SHAPE = 0.008
"""How much worse than in the flight the common pulse may fit the better quarter of a strip's strong echoes, as a share
of the amplitude. A Gaussian misses the echoes of the shipped sensors by 0.02 to 0.06."""

ALIKE_PULSES, PULSE_ERROR = 0.02, 0.3
"""Difference of two pulses (`compare_pulses`) up to which surveys of single strips agree, and what is added to it, over
the root of the number of isolated echoes: pulses of two simulated strips with 200 of them differ by 0.03."""

ALIKE_NOISE, ALIKE_LEVEL = 1.15, 0.5
"""The same for the ratio of the noise, and for the difference of the level over the noise."""


def join_digitizers(blocks: Iterable[WaveformBlock]) -> list[WaveformBlock]:
    """The samples of each descriptor as one block; the largest first.

    Waveforms of several lengths are filled up to the longest, with the fill marked as missing; copies of waveforms are
    left out. Samples of long waveforms count up to 256 each: it takes many waveforms to learn a pulse.
    """
    groups: dict[int, list[WaveformBlock]] = {}
    for block in blocks:
        if len(block):
            groups.setdefault(block.digitizer.index, []).append(block)
    joined = []
    for _, group in sorted(groups.items()):
        block = pool_blocks(group)
        # Some files hold a waveform for each return of a pulse: what is seen three times is known no better, but looks
        # as if it were. Flat waveforms may be alike by chance.
        rising = np.flatnonzero(np.ptp(block.samples, axis=1) >= LEAST_RISE)
        rows = np.ascontiguousarray(block.samples[rising])
        _, first = np.unique(rows.view(f"V{rows.itemsize * rows.shape[1]}")[:, 0], return_index=True)
        copies = np.delete(rising, first)
        joined.append(block.rows(np.delete(np.arange(len(block)), copies)) if len(copies) else block)
    return sorted(joined, key=weigh, reverse=True)


def pool_blocks(group: list[WaveformBlock]) -> WaveformBlock:
    """Waveforms of blocks (of one kind of digitizer) as one block, without geometry; short ones are filled up."""
    length = max(block.samples.shape[1] for block in group)
    digitizer = replace(max(group, key=weigh).digitizer, n_samples=length)
    filled, gone = [], []
    for block in group:
        lack = length - block.samples.shape[1]
        # With the waveform's least count, which is no signal.
        fill = np.repeat(block.samples.min(axis=1)[:, None], lack, axis=1)
        filled.append(np.hstack([block.samples, fill]))
        missing = np.ones((len(block), length), bool)
        missing[:, : block.samples.shape[1]] = False if block.missing is None else block.missing
        gone.append(missing)
    pooled = WaveformBlock.from_samples(np.concatenate(filled), spacing=digitizer.spacing, bits=digitizer.bits)
    missing = np.concatenate(gone)
    return replace(pooled, digitizer=digitizer, missing=missing if missing.any() else None)


def weigh(block: WaveformBlock) -> int:
    """Samples of a block that count for a survey."""
    return min(block.samples.shape[1], COUNTED) * len(block)


def describe_level(block: WaveformBlock, plain: SystemPulse) -> Level:
    """Level and noise of one descriptor, from each waveform's own quiet samples."""
    signal = transpose_samples(block.samples)
    reach = int(np.ceil(3 * plain.sigma_ref / block.spacing))
    quiet = find_levels(signal, plain.noise.std, reach).quiet
    if block.missing is not None:
        quiet &= ~block.missing.T
    # Only what comes before the first signal: long packets have more echoes, and what lies between them is no level.
    quiet = accumulate(np.logical_and, quiet)
    level, number = quiet_mean(signal, quiet)
    used = number >= LEAST_QUIET_SAMPLES
    # From differences of neighbours: a variance about the mean of so few correlated samples depends on their number.
    pairs = quiet[1:] & quiet[:-1]
    step = np.where(pairs, signal[1:] - signal[:-1], np.float32(0))
    freedom = max(int(np.count_nonzero(pairs)), 1)
    unlike = 2 * max(1 - (plain.noise.correlation[0] if plain.noise.correlation else 0.0), 0.1)
    std = float(np.sqrt(np.sum(step * step, dtype=np.float64) / (unlike * freedom)))
    mean, spread = (float(np.mean(level[used])), float(np.std(level[used]))) if used.any() else (0.0, 0.0)
    clip = find_saturation(block.samples, block.digitizer.max_count)
    return Level(int(used.sum()), mean, spread, max(std, QUANTISATION_STD), freedom, clip)


def compare_levels(own: Level, rest: list[Level], noise: float, most: float = STRANGE_NOISE) -> str:
    """Why a descriptor is a stranger among the rest, or empty; most: ratio of two noises of one sensor."""
    rest = [level for level in rest if level.waveforms]
    if own.waveforms < LEAST_LEVELS or not rest:
        return ""
    weights = np.array([level.waveforms for level in rest], np.float64)
    mean = float(np.average([level.mean for level in rest], weights=weights))
    spread = float(np.sqrt(np.average([level.spread**2 for level in rest], weights=weights)))
    error = float(np.hypot(own.spread, 0.5 * noise) / np.sqrt(own.waveforms) + spread / np.sqrt(weights.sum()))
    if abs(own.mean - mean) > max(STRANGE * error, 0.5 * noise):
        return f"its level is {own.mean:.2f} DN, that of the others {mean:.2f} "
    std = float(np.sqrt(np.average([level.std**2 for level in rest], weights=weights)))
    ratio = own.std / std
    # Quiet samples of one waveform are correlated, so that a tenth of them count. The standard deviation of n free
    # samples has a relative error of sqrt(1 / (2 n)).
    if abs(log(ratio)) > max(log(most), STRANGE / np.sqrt(0.2 * own.samples)):
        return f"its noise is {own.std:.2f} DN, that of the others {std:.2f}"
    clips = {level.clip for level in rest if level.clip is not None}
    if own.clip is not None and clips and own.clip < min(clips):
        return f"it is clipped at {own.clip:.0f} DN, the others at {min(clips):.0f}"
    return ""


@frozen(eq=False)
class Glance:
    """What a look finds before it tries the flight's pulse; most of a look's time goes into this."""

    plain: SystemPulse
    """A Gaussian, and the noise."""
    lone: EchoTable
    look: Look
    """Without a misfit."""


def glance_at(blocks: Iterable[WaveformBlock], system: SystemPulse) -> Glance | None:
    """Measure level, noise and width; arguments and result as for `look_at`."""
    block = _pool_main(blocks, system)
    if block is None:
        return None
    # With the flight's width this takes half as long as with a measured one, which only echoes of another width need.
    plain = measure_quiet(block, system.sigma_ref / block.spacing)
    for measured in False, True:
        if measured:
            plain = measure_gaussian(block, system.sigma_ref / block.spacing)
        lone = find_lone(block, plain)
        width = find_edge(lone.sigma) if len(lone) >= FEW else 0.0
        if abs(width / plain.sigma_ref - 1.0) <= FAR_OFF:
            break
    level = describe_level(block, plain)
    quiet = plain.noise.by_kind.get("quiet", 0.0)
    if quiet:
        # The mean square of all quiet samples holds weak echoes too: 2.2 DN in a RIEGL strip, 1.6 in a part of it.
        level = replace(level, std=max(quiet, QUANTISATION_STD))
    steady = float(np.mean(np.abs(np.log(lone.sigma / width)) < SAME_WIDTH)) if width else 0.0
    return Glance(plain, lone, Look(level, width, steady, 0.0))


def _pool_main(blocks: Iterable[WaveformBlock], system: SystemPulse) -> WaveformBlock | None:
    """The waveforms of the main digitizer; None without any."""
    kinds: dict[Kind, list[WaveformBlock]] = {}
    for block in blocks:
        if block.digitizer.index not in system.digitizers:
            kinds.setdefault(kind_of(block), []).append(block)
    return pool_blocks(max(kinds.values(), key=lambda group: sum(map(len, group)))) if kinds else None


def look_at(blocks: Sequence[WaveformBlock], system: SystemPulse, seen: Glance | None = None) -> Look | None:
    """Measure what waveforms record, without learning a pulse.

    Parameters
    ----------
    blocks : sequence of WaveformBlock
        Of any descriptors; only those of the main digitizer are used.
    system : SystemPulse
        Of the flight: its pulse is tried on the strong echoes.
    seen : Glance, optional
        At these waveforms, for a system of the same digitizers.

    Returns
    -------
    Look or None
        None without waveforms of the main digitizer.
    """
    seen = glance_at(blocks, system) if seen is None else seen
    block = _pool_main(blocks, system)
    if seen is None or block is None or not seen.look.width:
        return None if seen is None else seen.look
    strong = seen.lone.take(np.sort(np.argsort(-seen.lone.amplitude, kind="stable")[:MOST_ECHOES]))
    noise = seen.look.level.std / strong.amplitude.astype(np.float64)
    left = quantile(fit_alone(block, with_pulse(seen.plain, system), strong)[0] ** 2 - noise**2, 0.25)
    return replace(seen.look, misfit=float(np.sqrt(max(left, 0.0))))


def compare_looks(own: Look, whole: Look, system: SystemPulse, wider: float = WIDER) -> str:
    """Return why a strip does not belong to the flight, the pulse first; empty where it does.

    wider: how much wider than the flight's most echoes may be, as a share of the width.
    """
    level = compare_levels(own.level, [whole.level], system.noise.std, OTHER_NOISE)
    level = level.strip().replace("the others", "the flight")
    return "; ".join(filter(None, (compare_echoes(own, whole, wider), level)))


def compare_echoes(own: Look, whole: Look, wider: float = WIDER) -> str:
    """Why the echoes of a strip are not of the flight's sensor; empty where they may be."""
    if own.width and whole.width:
        ratio = own.width / whole.width
        if ratio < 1 - NARROWER or (ratio > 1 + wider and own.steady > STEADY):
            slope = "; steep slopes widen echoes as well" if ratio > 1 else ""
            widths = f"{own.width:.2f} ns wide (Gaussian sigma), those of the flight {whole.width:.2f} ns{slope}"
            return f"its echoes are {widths}"
        if own.misfit > whole.misfit + SHAPE:
            misfits = f"by {100 * own.misfit:.1f} % of the amplitude, those of the flight by {100 * whole.misfit:.1f} %"
            return f"the flight's pulse misses its strong echoes {misfits}"
    return ""


def kind_of(block: WaveformBlock) -> Kind:
    """How the samples of a block were made."""
    digitizer = block.digitizer
    return Kind(float(digitizer.bits), digitizer.spacing, digitizer.gain, digitizer.offset)


def read_flight(survey: Survey) -> tuple[Look, dict[int, Kind]]:
    """Return what a surveyed flight records, and its descriptors; raises ConfigError for a survey of no flight."""
    look, kinds = survey.figures.look, survey.figures.kinds
    if look is None or not kinds:
        raise ConfigError("holds no survey of a flight")
    return look, dict(sorted(kinds.items()))


def surveys_agree(surveys: Sequence[Survey]) -> bool:
    """Return whether surveys of single strips agree so well that one survey of all of them would serve.

    Parameters
    ----------
    surveys : sequence of Survey

    Returns
    -------
    bool
        False for fewer than two, and where one has too few echoes for a pulse.
    """
    if len(surveys) < 2 or any((survey.figures.isolated_echoes or 0) < FEW for survey in surveys):
        return False
    first, *others = surveys
    for other in others:
        if (first.figures.spacing_ns, first.figures.bits) != (other.figures.spacing_ns, other.figures.bits):
            return False
        a, b = first.system, other.system
        noise = min(a.noise.std, b.noise.std)
        echoes = min(first.figures.isolated_echoes or 0.0, other.figures.isolated_echoes or 0.0)
        alike = max(a.noise.std, b.noise.std) < ALIKE_NOISE * noise
        alike &= abs(a.noise.baseline - b.noise.baseline) < ALIKE_LEVEL * noise
        alike &= a.digitizers.keys() == b.digitizers.keys()
        if not (alike and compare_pulses(a, b) < ALIKE_PULSES + PULSE_ERROR / np.sqrt(echoes)):
            return False
    return True


COMPARED = 512
"""Waveforms of a strip that are compared with a survey, also with that of its flight. Their width scatters by 0.6 %,
far less than NARROWER and WIDER, and each 100 take 2 to 6 ms."""

LARGEST_WIDTH, LEAST_WIDTH, LARGEST_MISFIT, LARGEST_NOISE = 1.4, 0.7, 0.15, 3.0
"""Limits for files without the figures of a look, such as shipped or hand-written ones: width of a Gaussian fit over
that of the saved pulse, whose lobes widen either; misfit as a share of the amplitude; ratio of the noise, which such
files give for thresholds and not of quiet samples."""

NARROWEST, WIDEST = 0.1, 1.0
"""Limits that hold with `force` too: the saved pulse in samples, and as a share of the waveform. No sensor samples so
that an echo lies on one sample, or is longer than its waveforms: a damaged descriptor does."""


def with_look(survey: Survey, blocks: Iterable[WaveformBlock]) -> Survey:
    """Return a survey with the figures by which `check_saved` and `compare_flight` know other strips of the sensor.

    Parameters
    ----------
    survey : Survey
    blocks : iterable of WaveformBlock
        The sample that it was made on.

    Returns
    -------
    Survey
    """
    blocks = list(blocks)
    look = look_at(blocks, survey.system)
    if look is None:
        return survey
    kinds = {block.digitizer.index: kind_of(block) for block in blocks}
    return replace(survey, figures=replace(survey.figures, look=look, kinds=kinds))


def check_saved(reader: StripReader, scan: StripScan, survey: Survey | None, *, force: bool = False) -> str:
    """Check that a saved survey can be that of a strip.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    survey : Survey or None
        None, as without --system, is never contradicted.
    force : bool
        Return the contradiction, where there is one, in place of an error.

    Returns
    -------
    str
        The contradiction, with `force`, or a doubt: echoes that are wider by less than LARGEST_WIDTH, as on a hillside.
        Else empty.

    Raises
    ------
    InputError
        If bits, spacing, noise or width of the strip contradict the survey; with `force`, only if the saved pulse is
        too narrow or too wide for the strip's samples (picoseconds in a file of nanoseconds find no echo to compare).
    """
    if survey is not None:
        used = [digitizer for index, digitizer in reader.facts.digitizers.items() if index in scan.by_descriptor]
        sigma = survey.system.sigma_ref
        if used and not any(NARROWEST * one.spacing <= sigma <= WIDEST * one.n_samples * one.spacing for one in used):
            raise InputError(
                f"{reader.facts.path}: its waveforms ({used[0].n_samples} samples {used[0].spacing:g} ns apart) cannot "
                f"show the pulse of --system, {sigma:g} ns (Gaussian sigma); leave --system out to survey the strip"
            )
    reason, sure = ("", False) if survey is None else find_contradiction(reader, scan, survey)
    if sure and not force:
        raise InputError(
            f"{reader.facts.path}: the survey given by --system is not of this sensor: {reason}; leave --system out to "
            "survey the strip, or use it all the same with --force"
        )
    return reason


def find_contradiction(reader: StripReader, scan: StripScan, survey: Survey) -> tuple[str, bool]:
    """Return what contradicts the survey in a strip.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    survey : Survey

    Returns
    -------
    reason : str
        Empty if nothing does, or if the strip has too few echoes.
    sure : bool
        Whether no scene of the survey's sensor can explain it.
    """
    blocks = tuple(reader.sample_blocks(scan, min(COMPARED, reader.sample_size(scan))))
    if not blocks:
        return "", False
    figures = survey.figures
    forms = {(float(block.digitizer.bits), float(block.spacing)) for block in blocks}
    if figures.look is not None:
        whole, kinds = read_flight(survey)
        known = {(kind.bits, kind.spacing_ns) for kind in kinds.values()}
    else:
        known = {(figures.bits, figures.spacing_ns)} if figures.bits and figures.spacing_ns else forms
    if not forms & known:
        mine, others = (
            " or ".join(f"{bits:g} bits, {step:g} ns apart" for bits, step in sorted(some)) for some in (forms, known)
        )
        return f"its samples have {mine}, those of the survey {others}", True
    look = look_at(blocks, survey.system)
    if look is None:
        return "", False
    # Of coloured noise a pulse sees four times what samples scatter by. Only one that was edited is of no kind.
    noise, seen, other = survey.system.noise, look.level.std, ""
    noises = [value for value in noise.by_kind.values() if value > 0] or [noise.std]
    if not all(min(noises) / LARGEST_NOISE < one < max(noises) * LARGEST_NOISE for one in (seen, noise.std)):
        other = f"its noise is {seen:.2f} DN, that of the survey {noise.std:.2f}"
    if figures.look is None:
        reason = other or _compare_system(look, survey)
        return reason, bool(reason)
    look = replace(look, level=replace(look.level, mean=whole.level.mean))
    surely = compare_looks(look, whole, survey.system, wider=LARGEST_WIDTH - 1)
    reason = surely or other or compare_looks(look, whole, survey.system)
    return reason.replace("the flight", "the survey"), bool(surely)


def _compare_system(look: Look, survey: Survey) -> str:
    """Why echoes are not of the saved pulse, with wide limits."""
    system = survey.system
    if not look.width:
        return ""
    ratio = look.width / system.sigma_ref
    if ratio < LEAST_WIDTH or (ratio > LARGEST_WIDTH and look.steady > STEADY):
        pulse = f"the saved pulse {system.sigma_ref:.2f} ns" + "; steep slopes widen echoes as well" * (ratio > 1)
        return f"its echoes are {look.width:.2f} ns wide (Gaussian sigma), {pulse}"
    if look.misfit > LARGEST_MISFIT:
        return f"the saved pulse misses its strong echoes by {100 * look.misfit:.0f} % of the amplitude"
    return ""
