"""Whether a saved survey contradicts the strip that it is used for: another sensor, other settings, another unit.

All commands with `--system` call `check_saved`. It compares what `flight` compares for strips of a flight, except the
level, which the noise stage finds for every waveform. Before you change it: slopes and forest widen echoes, so a strip
of the same sensor must never be refused for its scene. All echoes of a hillside are wider by the same: that is a doubt.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from wavebatch.core.errors import InputError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.surveying.choose_chain import sample_size
from wavebatch.surveying.look import STEADY, compare_looks, kind_of, look_at, read_flight
from wavebatch.surveying.systems.figures import Look
from wavebatch.surveying.systems.survey_result import Survey

HELD = 512
"""Waveforms of a strip that are compared with a survey, also with that of its flight. Their width scatters by 0.6 %,
far less than NARROWER and WIDER of `look`, and each 100 take 2 to 6 ms."""

LARGEST_WIDTH, LEAST_WIDTH, LARGEST_MISFIT, LARGEST_NOISE = 1.4, 0.7, 0.15, 3.0
"""Limits for files without the figures of a look, such as shipped or hand-written ones: width of a Gaussian fit over
that of the saved pulse, whose lobes widen either; misfit as a share of the amplitude; ratio of the noise, which such
files give for thresholds and not of quiet samples."""

NARROWEST, WIDEST = 0.1, 1.0
"""Limits that hold with `force` too: the saved pulse in samples, and as a share of the waveform. No sensor samples so
that an echo lies on one sample, or is longer than its waveforms: a damaged descriptor does."""

Form = tuple[float, float]
"""Bits and spacing [ns] of samples."""


def with_look(survey: Survey, blocks: Iterable[WaveformBlock]) -> Survey:
    """Return a survey with the figures by which `check_saved` and `hold_strip` know other strips of the sensor.

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
        too narrow or too wide for the strip's samples.
    """
    if survey is not None and force:
        used = [digitizer for index, digitizer in reader.facts.digitizers.items() if index in scan.by_descriptor]
        sigma = survey.system.sigma_ref
        if used and not any(NARROWEST * one.spacing <= sigma <= WIDEST * one.n_samples * one.spacing for one in used):
            raise InputError(
                f"{reader.facts.path}: its waveforms ({used[0].n_samples} samples {used[0].spacing:g} ns apart) cannot "
                f"show the pulse of --system, {sigma:.3g} ns (Gaussian sigma); leave --system out to survey the strip"
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
    blocks = tuple(reader.sample_blocks(scan, min(HELD, sample_size(reader, scan))))
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
    if figures.look is None:
        reason = _compare_system(look, survey)
        return reason, bool(reason)
    look = replace(look, level=replace(look.level, mean=whole.level.mean))
    surely = compare_looks(look, whole, survey.system, wider=LARGEST_WIDTH - 1)
    reason = surely or compare_looks(look, whole, survey.system)
    return reason.replace("the flight", "the survey"), bool(surely)


def _compare_system(look: Look, survey: Survey) -> str:
    """Why echoes and noise are not of the saved pulse, with wide limits."""
    system = survey.system
    noises = [system.noise.std, *(value for value in system.noise.by_kind.values() if value > 0)]
    if not min(noises) / LARGEST_NOISE < look.level.std < max(noises) * LARGEST_NOISE:
        return f"its noise is {look.level.std:.2f} DN, that of the survey {system.noise.std:.2f}"
    if not look.width:
        return ""
    ratio = look.width / system.sigma_ref
    if ratio < LEAST_WIDTH or (ratio > LARGEST_WIDTH and look.steady > STEADY):
        pulse = f"the saved pulse {system.sigma_ref:.2f} ns" + "; steep slopes widen echoes as well" * (ratio > 1)
        return f"its echoes are {look.width:.2f} ns wide (Gaussian sigma), {pulse}"
    if look.misfit > LARGEST_MISFIT:
        return f"the saved pulse misses its strong echoes by {100 * look.misfit:.0f} % of the amplitude"
    return ""
