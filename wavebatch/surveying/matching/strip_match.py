"""Whether a calibration fits the strip that it is used for: channel, recording, pulse, chain, day, distance.

`batch.unit` and `tools.voxels` call `match_strip` once per strip. A constant belongs to one channel of one sensor with
its settings: for anything else it is wrong by any factor. A contradiction is an error, with the reason; what only makes
the constant less certain gives a warning and a larger error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN
from wavebatch.core.errors import InputError
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Digitizer, SystemPulse, WaveformBlock
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.surveying.angle_limits import sample_reference
from wavebatch.surveying.calibration import Calibration, ChannelConstant, StripConstant
from wavebatch.surveying.matching.setting import measure_setting, read_day, see_channels
from wavebatch.surveying.matching.strip_conditions import (
    compare_air,
    compare_divergence,
    compare_setting,
    doubt_calibration,
    find_growth,
    judge_fading,
    refuse_zone,
)
from wavebatch.surveying.sensor import SensorSource

OTHER_PULSE, NEAR_PULSE = 1.25, 1.03
"""Ratios of the pulse widths of calibration and strip: above the first it is another pulse, above the second it may be
one, and the error grows by the difference. Surveys of a sensor's strips agree within 2 % where ground is not steep."""

SAME = 1e-3
"""Relative difference up to which spacings and gains are equal: headers round them."""

_CHAIN_SAMPLE = 2048
"""Waveforms on which two chains are compared."""

_LEAST_SHARED = 50
"""Echoes that both chains must have for a comparison."""


def match_strip(
    calibration: Calibration,
    reader: StripReader,
    scan: StripScan,
    system: SystemPulse,
    sensor: SensorSource,
    chain: Chain | None = None,
    attenuation: float | None = None,
    energy: float | None = None,
) -> tuple[Calibration, tuple[str, ...]]:
    """Fit a calibration to a strip.

    Parameters
    ----------
    calibration : Calibration
    reader : StripReader
    scan : StripScan
    system : SystemPulse
        Of the strip's own survey.
    sensor : SensorSource
    chain : Chain, optional
        That the strip runs with.
    attenuation : float, optional
        Of the air [dB/km], where it is not that of the calibration.
    energy : float, optional
        Mean of its pulses over that of the calibration, where it is known.

    Returns
    -------
    fitted : Calibration
        With the constants of the strip's channels; its common constant is NaN where the channels are known.
    warnings : tuple of str
        One line each.

    Raises
    ------
    InputError
        Where none of the strip's channels has a constant, with the reasons.

    Notes
    -----
    docs/algorithms.md 5.2.
    """
    warnings = list(doubt_calibration(calibration))
    if not any(row.is_described for row in calibration.channels):
        return calibration, tuple(warnings)
    growth, reasons = find_growth(calibration, reader, sensor, attenuation)
    if calibration.haze and attenuation is None:
        calibration = replace(calibration, attenuation=calibration.attenuation / calibration.haze * sensor.haze)
    own_strip = take_fingerprint(reader.facts.path, reader.facts.packets.file)["sha256_sampled"]
    chance = calibration.change_chance
    setting = measure_setting(reader, scan, sensor, calibration.attenuation, energy or 1.0, chance=chance)
    refuse_zone(calibration, setting, sensor.distance, reader.facts.path)
    notes: list[str] = []
    measured = {calibration.fingerprint.get("sha256_sampled"), *(row.sha256 for row in calibration.strips)}
    if own_strip not in measured:
        more, lines, notes = compare_setting(calibration, setting, system)
        growth, reasons = math.hypot(growth, more), [*reasons, *lines]
        if not (calibration.flight and read_day(reader)):
            which = "the calibration" if not calibration.flight else "this strip"
            notes.append(
                f"calibration: the day of {which} is not known (GPS times that are seconds of a week show none): it "
                "counts as the same day; lasers, receivers and air of another day would add to the error"
            )
    if energy is None:
        more, lines, hidden = judge_fading(calibration, setting, other=own_strip not in measured)
        growth, reasons, notes = math.hypot(growth, more), [*reasons, *lines], [*notes, *hidden]
    warnings += [*reasons, *compare_divergence(calibration, system)]
    growth = math.hypot(growth, _compare_decomposers(calibration, reader, scan, system, chain, warnings))
    rows: list[ChannelConstant] = []
    missing: dict[int, str] = {}
    pulses = _find_pulses(calibration, reader, scan, system, sensor)
    for index in sorted(scan.by_descriptor):
        pulse = pulses.get(index, pulses[0])
        found, missing[index] = _match_digitizer(calibration, reader.facts.digitizers[index], pulse, warnings)
        rows += found
    have, seen = {(row.digitizer, row.scanner) for row in rows}, see_channels(reader, scan)
    problems = {
        f"{missing[index] or f'scanner channel {scanner} of digitizer {index} was not calibrated'}": share
        for (index, scanner), share in seen.items()
        if (index, scanner) not in have
    }
    if not have & seen.keys():
        raise InputError(
            f"{reader.facts.path}: --calibration: none of the strip's channels is calibrated: {'; '.join(problems)}; "
            "measure this sensor with `wavebatch calibrate`"
        )
    warnings += [
        f"calibration: no calibrated values for {share:.0%} of the waveforms: {problem}"
        for problem, share in problems.items()
    ]
    rows = [replace(row, relative_error=math.hypot(row.relative_error, growth)) for row in rows]
    if calibration.strips:
        rows = list(_take_strip_constants(calibration.strips, rows, own_strip))
    air = compare_air(calibration, reader, sensor, attenuation, warnings)
    fitted = replace(
        calibration, right=setting.right, constant=math.nan, channels=tuple(rows), strips=(), notes=tuple(notes)
    )
    return fitted.widened(air), tuple(dict.fromkeys(warnings))


def _find_pulses(
    calibration: Calibration, reader: StripReader, scan: StripScan, system: SystemPulse, sensor: SensorSource
) -> dict[int, float]:
    """Widths at half maximum of the pulses of all digitizers that have one of their own, and of the others as 0 [ns].

    A hillside widens every echo, so that the survey of its strip finds a wider pulse than the sensor has: where a pulse
    is wider than the calibration's, what the slopes of the strip's surfaces add to it is taken off.
    """
    systems = {0: system, **system.digitizers}
    known = [row.pulse_ns for row in calibration.channels if row.pulse_ns]
    divergence = system.radiometry.divergence or calibration.divergence
    widest = max(one.sigma_ref for one in systems.values()) * FWHM_PER_SIGMA
    if known and divergence and widest > NEAR_PULSE * min(known):
        main = max(scan.by_descriptor, key=lambda index: (index not in system.digitizers, scan.by_descriptor[index]))
        spacing = reader.facts.digitizers[main].spacing
        seen = sample_reference(reader, scan, sensor, system.with_radiometry(divergence=divergence), spacing).system
        systems = {0: seen, **seen.digitizers}
    return {
        index: FWHM_PER_SIGMA * math.sqrt(max(one.sigma_ref**2 + one.widths.variance, 0.0))
        for index, one in systems.items()
    }


def _match_digitizer(
    calibration: Calibration, digitizer: Digitizer, pulse: float, warnings: list[str]
) -> tuple[list[ChannelConstant], str]:
    """Constants of all scanner channels of a digitizer, or why there is none; pulse: width at half maximum [ns]."""
    known = [row for row in calibration.channels if row.is_described]
    reason = ""
    fitting = []
    for row in known:
        contradiction = _contradict(row, digitizer, pulse)
        if not contradiction:
            fitting.append(row)
        elif not reason or row.digitizer == digitizer.index:
            reason = contradiction
    if not fitting:
        return [], reason
    exact = [row for row in fitting if row.digitizer == digitizer.index]
    found = exact or _pool_lengths(fitting, digitizer)
    if not found:
        numbers = ", ".join(sorted({str(row.digitizer) for row in fitting}, key=int))
        return [], f"digitizer {digitizer.index} was not calibrated, only {numbers}, which may have another gain"
    ratio = pulse / (found[0].pulse_ns or pulse)
    if max(ratio, 1 / ratio) > NEAR_PULSE:
        warnings.append(
            f"calibration: the pulse of this strip is {pulse:.3g} ns wide, that of the calibration "
            f"{found[0].pulse_ns:.3g} ns: the error of the constant grows by {100 * abs(math.log(ratio)):.0f} %"
        )
        found = [replace(row, relative_error=math.hypot(row.relative_error, math.log(ratio))) for row in found]
    return found, ""


def _contradict(row: ChannelConstant, digitizer: Digitizer, pulse: float) -> str:
    """Why a channel's constant cannot hold for a digitizer; empty where it can. What is not known is not checked."""
    if row.bits is not None and row.bits != digitizer.bits:
        return f"digitizer {digitizer.index} has {digitizer.bits} bits, the calibration {row.bits}"
    for name, unit, own, other in (
        ("spacing", "ns", digitizer.spacing, row.spacing_ns),
        ("gain", "V per count", digitizer.gain, row.gain),
    ):
        if other is not None and abs(own - other) > SAME * max(abs(own), abs(other)):
            return f"digitizer {digitizer.index} has a {name} of {own:g} {unit}, the calibration {other:g}"
    ratio = pulse / (row.pulse_ns or pulse)
    if max(ratio, 1 / ratio) > OTHER_PULSE:
        slopes = " (if slopes widen it, put divergence_mrad of the data sheet into CAL.toml)" if ratio > 1 else ""
        return f"its pulse is {pulse:.3g} ns wide, that of the calibration {row.pulse_ns:.3g} ns{slopes}"
    return ""


def _pool_lengths(rows: list[ChannelConstant], digitizer: Digitizer) -> list[ChannelConstant]:
    """Constants for a descriptor that differs from all calibrated ones in the number of samples only.

    Some sensors have a descriptor per packet length for one and the same digitizer. A descriptor of the same length is
    another channel: its gain is not known.
    """
    if any(row.samples in (None, digitizer.n_samples) for row in rows):
        return []
    pooled = []
    for scanner in sorted({row.scanner for row in rows}):
        some = [row for row in rows if row.scanner == scanner]
        constants = np.array([row.constant for row in some])
        apart = float(np.std(constants) / constants.mean())
        error = math.hypot(max(row.relative_error for row in some), apart)
        pooled.append(
            replace(some[0], digitizer=digitizer.index, constant=float(constants.mean()), relative_error=error)
        )
    return pooled


def _compare_decomposers(
    calibration: Calibration,
    reader: StripReader,
    scan: StripScan,
    system: SystemPulse,
    chain: Chain | None,
    warnings: list[str],
) -> float:
    """By how much energies of the strip's chain differ from those of the calibration's, relative; 0 for one chain."""
    own = None if chain is None else chain.steps[2].stage.name
    other = STAGES.get(calibration.decomposer)
    if chain is None or other is None or own == calibration.decomposer:
        return 0.0
    steps = chain.steps[:3] + (Step(STAGES["attribute.energy"]),)
    pair = (Chain(steps), Chain((*steps[:2], Step(other), steps[3])))
    blocks = list(reader.sample_blocks(scan, _CHAIN_SAMPLE))
    ratios = [_compare_energies(block, system, pair) for block in blocks]
    ratio = np.concatenate(ratios) if ratios else np.empty(0)
    off = float(np.median(ratio)) - 1.0 if len(ratio) >= _LEAST_SHARED else 0.0
    if abs(off) > 0.002:
        warnings.append(
            f"calibration: measured with {calibration.decomposer}, this strip runs {own}, whose energies are "
            f"{100 * off:+.1f} % off: the error of the constant grows by that; calibrate with the same --chain or "
            "--profile"
        )
    return abs(off)


def _compare_energies(block: WaveformBlock, system: SystemPulse, pair: tuple[Chain, Chain]) -> np.ndarray:
    """Energies of clean single echoes by the first chain over those by the second."""
    found = []
    for chain in pair:
        echoes = chain.run(block, system)
        clean = echoes.alone(len(block)) & ((echoes.flags & np.uint16(UNCLEAN)) == 0)
        energy = np.full(len(block), np.nan)
        energy[echoes.waveform[clean]] = echoes.attributes["energy"][clean]
        found.append(energy)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = found[0] / found[1]
    return ratio[np.isfinite(ratio)]


def _take_strip_constants(
    strips: tuple[StripConstant, ...], rows: list[ChannelConstant], key: str
) -> Iterator[ChannelConstant]:
    """The rows; where the strip itself, known by its fingerprint, was calibrated, with the constants of the strip."""
    own = {(row.digitizer, row.scanner): row for row in strips if row.sha256 == key}
    for row in rows:
        found = own.get((row.digitizer, row.scanner))
        if found is None:
            yield row
        else:
            yield replace(row, constant=found.constant, relative_error=found.relative_error)
