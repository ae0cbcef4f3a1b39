"""Whether a calibration fits the strip that it is used for: channel, recording, pulse, chain, day, distance.

`batch.unit` and `tools.voxels` call `match_strip` once per strip. A constant belongs to one channel of one sensor with
its settings: for anything else it is wrong by any factor. What contradicts is refused by name; what only makes the
constant less sure is warned about, and widens its error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from wavebatch.core.echoes import UNCLEAN
from wavebatch.core.errors import InputError
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Digitizer, SystemPulse, WaveformBlock
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.surveying.calibrating.strip_channels import read_day, read_sensor_name, see_channels
from wavebatch.surveying.calibration import Calibration, ChannelConstant, StripConstant
from wavebatch.surveying.sensor import SensorSource

OTHER_PULSE, NEAR_PULSE = 1.25, 1.03
"""Ratios of the pulse widths of calibration and strip: above the first it is another pulse, above the second it may be
one, and the error grows by the difference. Surveys of a sensor's strips agree within 2 % where ground is not steep."""

SAME = 1e-3
"""Relative difference up to which spacings and gains are equal: headers round them."""

OTHER_DAY, OTHER_MONTH = 0.02, 0.05
"""Errors for strips of another day than the calibration, and for more than 30 days: lasers and receivers drift. These
are assumptions; `wavebatch calibrate` of several strips measures the drift of a flight."""

AIR_DOUBT = 0.5
"""Relative error of the attenuation of the air, for strips at other distances than the targets."""

FAR = 1.3
"""Ratio of distances from which the strip's and the targets' are named."""

_CHAIN_SAMPLE = 2048
"""Waveforms on which two chains are compared."""

_LEAST_SHARED = 50
"""Echoes that both chains must have for a comparison."""


@dataclass(frozen=True, slots=True)
class StripMatch:
    """A calibration as it holds for one strip."""

    calibration: Calibration
    """With the constants of the strip's channels; its common constant is NaN where the channels are known."""
    warnings: tuple[str, ...] = ()
    """One line each."""


def match_strip(
    calibration: Calibration,
    reader: StripReader,
    scan: StripScan,
    system: SystemPulse,
    sensor: SensorSource,
    chain: Chain | None = None,
) -> StripMatch:
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

    Returns
    -------
    StripMatch

    Raises
    ------
    InputError
        Where none of the strip's channels has a constant, with the reasons.

    Notes
    -----
    docs/algorithms.md 5.2.
    """
    warnings: list[str] = []
    if not any(row.is_described for row in calibration.channels):
        warnings.append(
            "calibration: the file does not say which sensor it was measured with (an earlier version wrote it), so "
            "that nothing shows whether it fits this strip; measure it again with `wavebatch calibrate`"
        )
        return StripMatch(calibration, tuple(warnings))
    growth, reasons = _find_growth(calibration, reader, sensor)
    warnings += [*reasons, *_compare_divergence(calibration, system)]
    growth = math.hypot(growth, _compare_decomposers(calibration, reader, scan, system, chain, warnings))
    rows, reasons = [], {}
    for index in sorted(scan.by_descriptor):
        own = system.digitizers.get(index, system)
        pulse = own.sigma_ref * FWHM_PER_SIGMA
        found, reasons[index] = _match_digitizer(calibration, reader.facts.digitizers[index], pulse, warnings)
        rows += found
    have, seen = {(row.digitizer, row.scanner) for row in rows}, see_channels(reader, scan)
    problems = {
        f"{reasons[index] or f'scanner channel {scanner} of digitizer {index} was not calibrated'}": share
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
        rows = list(_take_strip_constants(calibration.strips, rows, reader.facts))
    fitted = replace(calibration, constant=math.nan, channels=tuple(rows), strips=())
    return StripMatch(fitted, tuple(dict.fromkeys(warnings)))


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
        return f"its pulse is {pulse:.3g} ns wide, that of the calibration {row.pulse_ns:.3g} ns"
    return ""


def _pool_lengths(rows: list[ChannelConstant], digitizer: Digitizer) -> list[ChannelConstant]:
    """Constants for a descriptor that differs from all calibrated ones in the number of samples only.

    Some sensors have a descriptor per packet length for one and the same digitizer. A descriptor of the same length is
    another channel: nobody knows its gain.
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


def _find_growth(calibration: Calibration, reader: StripReader, sensor: SensorSource) -> tuple[float, list[str]]:
    """Error that day, distance and sensor add to the constant, relative, and the warnings."""
    parts, lines = [], []
    day = read_day(reader)
    if day and calibration.flight and day != calibration.flight:
        apart = abs((date.fromisoformat(day) - date.fromisoformat(calibration.flight)).days)
        parts.append(OTHER_MONTH if apart > 30 else OTHER_DAY)
        lines.append(
            f"calibration: measured on {calibration.flight}, this strip was flown on {day}: the error of the constant "
            f"grows by {100 * parts[-1]:.0f} %"
        )
    if calibration.distance and sensor.distance:
        slope = 2.0e-4 * math.log(10.0) * AIR_DOUBT * calibration.attenuation
        parts.append(slope * abs(sensor.distance - calibration.distance))
        ratio = sensor.distance / calibration.distance
        if max(ratio, 1 / ratio) > FAR:
            lines.append(
                f"calibration: measured at {calibration.distance:.0f} m, this strip is {sensor.distance:.0f} m away: "
                f"the air between adds {100 * parts[-1]:.1f} % to the error of the constant"
            )
    name = read_sensor_name(reader.facts)
    if calibration.sensor and name and name != calibration.sensor:
        lines.append(
            f"calibration: measured with sensor {calibration.sensor!r}, the header of this strip names {name!r}; "
            "bits, spacing, gain and pulse agree"
        )
    return float(np.sqrt(np.sum(np.square(parts)))), lines


def _compare_divergence(calibration: Calibration, system: SystemPulse) -> Iterator[str]:
    own, other = system.divergence, calibration.divergence
    if own is not None and other is not None and abs(own / other - 1.0) > NEAR_PULSE - 1.0:
        yield (
            f"calibration: measured with a divergence of {other:g} mrad, the survey has {own:g} mrad, which is used: "
            f"one of the two makes cross sections {100 * abs((own / other) ** 2 - 1):.0f} % wrong"
        )


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
    if own is None or other is None or own == calibration.decomposer:
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
        clean = (echoes.count(len(block))[echoes.waveform] == 1) & ((echoes.flags & np.uint16(UNCLEAN)) == 0)
        energy = np.full(len(block), np.nan)
        energy[echoes.waveform[clean]] = echoes.attributes["energy"][clean]
        found.append(energy)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = found[0] / found[1]
    return ratio[np.isfinite(ratio)]


def _take_strip_constants(
    strips: tuple[StripConstant, ...], rows: list[ChannelConstant], facts: StripFacts
) -> Iterator[ChannelConstant]:
    """The rows; where the strip itself was calibrated, with the constants of the strip."""
    key = take_fingerprint(facts.path, facts.packets.file)["sha256_sampled"]
    own = {(row.digitizer, row.scanner): row for row in strips if row.sha256 == key}
    for row in rows:
        found = own.get((row.digitizer, row.scanner))
        if found is None:
            yield row
        else:
            yield replace(row, constant=found.constant, relative_error=found.relative_error)
