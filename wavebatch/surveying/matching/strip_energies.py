"""The energies of a strip's pulses beside those of its calibration, and what the strip's own light says of both.

`run`, `calibrate` and `voxelize` call `take_energies` once per strip. What a strip lacks against its calibration goes
into the errors: the scatter of energies that are not logged, a log that drifts alone, two lasers without a mark.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.order import even_places
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.pulse_energy import PulseEnergy, find_pulse_energy
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.physics.pulse_energies import judge_energies
from wavebatch.surveying.calibration import Calibration
from wavebatch.surveying.matching.setting import sum_light

OTHER_UNIT = 3.0
"""Ratio of mean energies from which a log is in another unit: lasers lose a half of their energy at most."""

NEIGHBOURS = 4096
"""Neighbouring pulses whose light is compared."""

PERIODS = (2, 3, 4)
"""Lasers, or heads, that may take turns."""

LEAST_APART, LIKE = 0.04, 0.5
"""Light alternates where that of neighbours differs by more than the first (median of the logarithm), and that of
pulses one period apart by this share of it at most: surfaces make pulses that lie further apart differ more."""

LEAST_COMPARED = 200
"""Pairs of pulses that show it."""

PLACES, OF_PLACE, LEAST_PLACES = 32, 128, 8
"""Places along the strip at which slow changes of the log are compared with light, pulses at each, and the fewest."""

LEAST_SAID = 0.01
"""Smaller errors are not named."""


@dataclass(frozen=True, slots=True)
class StripEnergies:
    """What is known of the energies of a strip's pulses."""

    energy: PulseEnergy | None
    """None where nothing is."""
    shot_error: float = 0.0
    """Scatter from shot to shot that the calibration's energies held and the strip's do not, relative."""
    growth: float = 0.0
    """Error of the strip's level, relative."""
    notes: tuple[str, ...] = ()

    def widen(self, calibration: Calibration) -> Calibration:
        """Return a calibration with these errors."""
        rows = (replace(row, shot_energy=math.hypot(row.shot_energy, self.shot_error)) for row in calibration.channels)
        return replace(calibration, channels=tuple(rows)).widened(self.growth)

    def describe(self) -> dict[str, Any]:
        """Return the fields of a Calibration that say what it was measured with."""
        sent = self.energy
        if sent is None:
            return {}
        mean, names = sent.reference or sent.mean, {"energy_source": sent.source, "energy_unit": sent.unit}
        return {"energy_mean": mean, "energy_spread": sent.shots, **names}


class _Pulses(NamedTuple):
    """Waveforms in the order of time; arrays (n,)."""

    time: np.ndarray
    light: np.ndarray
    energy: np.ndarray
    """Over its mean; 1 where nothing is known."""
    channel: np.ndarray


def take_energies(
    reader: StripReader, scan: StripScan, request: str | None, calibration: Calibration | None = None
) -> StripEnergies:
    """Find the energies of a strip's pulses, and compare them with its light and its calibration.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    request : str or None
        As `find_pulse_energy`.
    calibration : Calibration, optional
        That the strip runs with, or of the strip that was calibrated before it in one flight.

    Returns
    -------
    StripEnergies
        Energies count relative to the mean of the calibration, or of the strip where the calibration has none.

    Raises
    ------
    InputError
        Where the energies cannot be read, contradict the strip's light, or are in another unit than the calibration's.

    Notes
    -----
    docs/algorithms.md 5.2.
    """
    energy, notes = find_pulse_energy(reader, scan, request), []
    pulses = _read_neighbours(reader, scan, energy)
    growth = 0.0
    if energy is not None and request is not None:
        doubt = judge_energies(pulses.light, pulses.energy)
        if doubt:
            raise InputError(
                f"{reader.facts.path}: --energy {energy.source} contradicts the strip: {doubt}; check its times, or "
                "leave it out"
            )
        growth = _compare_drift(reader, scan, energy)
        if growth > LEAST_SAID:
            notes.append(
                f"--energy {energy.source}: its slow changes along the strip are not proved by the strip's brightness: "
                f"the error of the constant grows by {100 * growth:.1f} %"
            )
    apart = _find_alternation(pulses)
    if apart:
        notes.append(
            f"the light of neighbouring pulses alternates by a factor of {math.exp(-apart):.2f}, as of two lasers or "
            f"gains without a mark: the error of the constant grows by {100 * apart * 0.5**0.5:.0f} %; give --energy"
        )
        growth = math.hypot(growth, apart * 0.5**0.5)
    if calibration is None:
        return StripEnergies(energy, 0.0, growth, tuple(notes))
    energy = energy and _refer(reader, energy, calibration)
    lacks = _find_lack(energy, calibration)
    notes += _name_lack(energy, calibration, lacks)
    if energy is not None:
        return StripEnergies(replace(energy, missed=lacks), 0.0, growth, tuple(notes))
    return StripEnergies(None, lacks, growth, tuple(notes))


def _refer(reader: StripReader, energy: PulseEnergy, calibration: Calibration) -> PulseEnergy:
    """The energies relative to the mean of the calibration's; InputError for another unit."""
    known = calibration.energy_mean
    if known is None:
        return energy
    ratio = energy.mean / known
    if max(ratio, 1 / ratio) > OTHER_UNIT:
        raise InputError(
            f"{reader.facts.path}: the mean energy of its pulses is {energy.mean:.4g} ({energy.source}), that of the "
            f"calibration {known:.4g} {calibration.energy_unit} ({calibration.energy_source}): another unit? Then give "
            "the calibration's mean in this unit as energy_mean in CAL.toml, or leave energies out with --energy none"
        )
    return replace(energy, reference=known)


def _find_lack(energy: PulseEnergy | None, calibration: Calibration) -> float:
    """Scatter of the energy from shot to shot that nothing of the strip tells, relative: what the calibration had
    beyond that of the strip's own log, so that a log that stands still proves nothing."""
    if calibration.energy_mean is not None:
        scatter = calibration.energy_spread
    else:
        scatter = max((row.shot_energy for row in calibration.channels), default=0.0) if energy is not None else 0.0
    known = 0.0 if energy is None else energy.shots
    return math.sqrt(max(scatter**2 - known**2, 0.0))


def _name_lack(energy: PulseEnergy | None, calibration: Calibration, lacks: float) -> Iterator[str]:
    if energy is None and calibration.energy_mean is not None:
        yield (
            f"calibration: measured with the energy of each pulse ({calibration.energy_source}), this strip has none: "
            f"its pulses scatter by {100 * lacks:.1f} % from shot to shot, which is in the error"
        )
    elif energy is not None and calibration.energy_mean is None:
        yield (
            f"calibration: measured without the energies of the pulses, this strip has them ({energy.source}): they "
            "count relative to their mean, which may be another than that of the calibration's strip"
        )
    elif energy is not None and lacks > LEAST_SAID:
        yield (
            f"--energy {energy.source}: its values scatter by {100 * energy.shots:.1f} % from shot to shot, those of "
            f"the calibration by {100 * calibration.energy_spread:.1f} %: is the log stuck? The rest is in the error"
        )


def _read_neighbours(reader: StripReader, scan: StripScan, energy: PulseEnergy | None) -> _Pulses:
    """Neighbouring waveforms in the middle of the strip."""
    if not reader.unit_count():
        return _join([])
    unit = reader.read_unit(reader.unit_count() // 2, scan)
    rows = np.flatnonzero(unit.packets.owned)[:NEIGHBOURS]
    blocks = [block for block, _ in reader.read_rows(unit, rows, NEIGHBOURS)]
    return _join([block if energy is None else energy.fill(block, unit) for block in blocks])


def _join(blocks: list[WaveformBlock]) -> _Pulses:
    parts = [np.empty((4, 0))]
    for block in blocks:
        sent = np.ones(len(block)) if block.pulse_energy is None else block.pulse_energy
        scanner = 0 if block.scanner is None else block.scanner
        channel = np.full(len(block), 4 * block.digitizer.index) + scanner
        parts.append(np.stack([block.gps_time, sum_light(block), sent, channel]))
    rows = np.concatenate(parts, axis=1)
    return _Pulses(*rows[:, np.argsort(rows[0], kind="stable")])


def _find_alternation(pulses: _Pulses) -> float:
    """By how much the logarithm of the light of neighbouring pulses of one channel differs in turns; 0 where not."""
    with np.errstate(invalid="ignore", divide="ignore"):
        light = np.log(pulses.light / pulses.energy)
    apart = []
    for channel in np.unique(pulses.channel):
        own = light[pulses.channel == channel]
        if len(own) > LEAST_COMPARED:
            near, *far = (float(np.nanmedian(np.abs(own[k:] - own[:-k]))) for k in (1, *PERIODS))
            apart.append(near if near > LEAST_APART and min(far) < LIKE * near else 0.0)
    return max(apart, default=0.0)


def _compare_drift(reader: StripReader, scan: StripScan, energy: PulseEnergy) -> float:
    """Error by slow changes of the log that the strip's brightness does not follow, relative."""
    sent, light = [], []
    numbers = even_places(reader.unit_count(), PLACES).tolist()
    for number in numbers:
        unit = reader.read_unit(number, scan)
        rows = np.flatnonzero(unit.packets.owned)
        for part in np.array_split(rows, -(-PLACES // len(numbers))):
            chosen = part[even_places(len(part), OF_PLACE)]
            pulses = _join([energy.fill(block, unit) for block, _ in reader.read_rows(unit, chosen, OF_PLACE)])
            with np.errstate(invalid="ignore", divide="ignore"):
                sent.append(np.median(np.log(pulses.energy)))
                light.append(np.nanmedian(np.log(pulses.light)))
    known = np.isfinite(sent) & np.isfinite(light)
    sent, light = np.array(sent)[known], np.array(light)[known]
    if len(sent) < LEAST_PLACES:
        return 0.0
    sent, light = sent - sent.mean(), light - light.mean()
    # Medians of OF_PLACE pulses scatter by themselves: only what is beyond that is slow.
    slow = math.sqrt(max(float(np.mean(sent**2)) - 1.57 * energy.shots**2 / OF_PLACE, 0.0))
    if not slow:
        return 0.0
    slope = float(sent @ light / (sent @ sent))
    error = math.sqrt(float(np.sum((light - slope * sent) ** 2)) / (len(sent) - 2) / float(sent @ sent))
    return slow * min(math.hypot(1.0 - slope, error), 1.0)
