"""The energy of each emitted pulse, as sensors log it: an extra byte of the points, or a text file by GPS time.

`batch.unit` finds it once per strip and fills it into each block. Energies count relative to their mean over the strip,
so their unit does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.suggest import nearest
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.files.text_file import read_text

SAMPLED_UNITS = 8
"""Units of a strip over whose points the mean is taken."""

LEAST_KNOWN = 0.5
"""Least share of the sampled points whose energy must be known."""

NEAR = 0.3
"""A pulse has the energy logged at most this share of the usual interval of the log before or after it."""

LARGEST = 1e30
"""Energies from here on count as unknown: their squares overflow, and no unit is so small."""


@dataclass(frozen=True, slots=True, eq=False)
class PulseEnergy:
    """Where the energies of a strip's pulses come from; picklable."""

    source: str
    """Name of the extra byte, or of the text file."""
    field: str | None = None
    """Field of the point records; None for a text file."""
    scaling: tuple[float, float] = (1.0, 0.0)
    """Scale and offset of stored values."""
    empty: float | None = None
    """Stored value that means none."""
    time: np.ndarray | None = None
    """Times of a text file, ascending, f8 (k,) [s]."""
    energy: np.ndarray | None = None
    """Energies at these times, f8 (k,)."""
    reach: float = 0.0
    """Largest distance in time between a pulse and its entry in the file [s]."""
    mean: float = 1.0
    """Of the strip, in the unit of the source."""
    spread: float = 0.0
    """Standard deviation from shot to shot, relative."""
    known: float = 1.0
    """Share of the sampled points whose energy is known."""

    def read(self, points: np.ndarray) -> np.ndarray:
        """Return the energies of the pulses of point records (n,), f8, NaN where unknown, in the unit of the source."""
        if self.field is not None:
            stored = points[self.field]
            values = stored.astype(np.float64) * self.scaling[0] + self.scaling[1]
            known = (values < LARGEST) & (values > 0) & (True if self.empty is None else stored != self.empty)
            return np.where(known, values, np.nan)
        time = points["gps_time"].astype(np.float64)
        after = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        place = after - (time - self.time[after - 1] < self.time[after] - time)
        return np.where(np.abs(self.time[place] - time) <= self.reach, self.energy[place], np.nan)

    def fill(self, block: WaveformBlock, unit: Unit) -> WaveformBlock:
        """Return a block of the unit with the energies of its pulses over their mean."""
        place = block.point - unit.start
        inside = (place >= 0) & (place < len(unit.points))
        records = np.empty(len(block), unit.points.dtype)
        records[inside] = unit.points[place[inside]]
        if not inside.all():
            records[~inside] = unit.context[np.searchsorted(unit.context_index, block.point[~inside])]
        return replace(block, pulse_energy=self.read(records) / self.mean)

    def describe(self) -> dict[str, Any]:
        """Return source, mean and spread for reports."""
        return {
            "source": self.source,
            "mean": float(f"{self.mean:.6g}"),
            "spread": round(self.spread, 6),
            "share_known": round(self.known, 6),
        }


def find_pulse_energy(reader: StripReader, scan: StripScan, request: str) -> PulseEnergy:
    """Find the energies of a strip's pulses.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    request : str
        Name of an extra byte of the strip, or path of a text file with columns time and energy.

    Returns
    -------
    PulseEnergy

    Raises
    ------
    InputError
        Where there is no such extra byte and no such file, or where it does not know half of the strip's pulses.
    """
    path = reader.facts.path
    found = _find_column(reader, request) or _read_file(reader, request)
    units = reader.unit_count()
    chosen = np.unique(np.linspace(0, units - 1, min(units, SAMPLED_UNITS)).round().astype(int)) if units else []
    # Points of one pulse follow each other: each pulse counts once.
    values = np.concatenate([np.empty(0), *(_once(found, reader.read_unit(int(number), scan)) for number in chosen)])
    there = values[np.isfinite(values)]
    if len(values) and len(there) < LEAST_KNOWN * len(values):
        raise InputError(
            f"{path}: --pulse-energy {request} knows {len(there)} of {len(values)} pulses of the strip; it must have "
            "positive energies, a text file those at the GPS times of the points"
        )
    mean = float(there.mean()) if len(there) else 1.0
    spread = float(there.std() / mean) if len(there) else 0.0
    return replace(found, mean=mean, spread=spread, known=len(there) / max(len(values), 1))


def _once(found: PulseEnergy, unit: Unit) -> np.ndarray:
    """Energies of the pulses of a unit."""
    points = unit.points
    new = np.append(True, np.diff(points["gps_time"]) != 0)[: len(points)]
    return found.read(points[new])


def _find_column(reader: StripReader, request: str) -> PulseEnergy | None:
    """The extra byte of this name; None where there is none."""
    facts = reader.facts
    fields = facts.dtype.names[len(facts.dtype.names) - len(facts.records) :] if facts.records else ()
    for field, record in zip(fields, facts.records, strict=True):
        if record.name == request and 1 <= record.code <= 10:
            empty = None if record.no_data is None else float(record.no_data[0])
            return PulseEnergy(request, field, record.scaling or (1.0, 0.0), empty)
    return None


def _read_file(reader: StripReader, request: str) -> PulseEnergy:
    if not Path(request).is_file():
        names = [record.name for record in reader.facts.records]
        hint = nearest(request, names) if names else "the strip has no extra bytes"
        path = reader.facts.path
        raise InputError(f"{path}: --pulse-energy: no extra byte and no file is called {request!r}; {hint}")
    time, energy = _parse(read_text(request, "file of pulse energies", 1 << 30).splitlines(), request)
    order = np.argsort(time, kind="stable")
    time, energy = time[order], energy[order]
    step = np.diff(time)
    reach = NEAR * float(np.median(step[step > 0])) if (step > 0).any() else 1e-6
    return PulseEnergy(Path(request).name, time=time, energy=energy, reach=reach)


def _parse(lines: Iterable[str], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Columns time and energy of a text file with a header line; InputError where they are not there."""
    rows = [line.replace(",", " ").replace(";", " ").split() for line in lines if line.strip()]
    header = [word.casefold() for word in rows[0]] if rows else []
    if not {"time", "energy"} <= set(header):
        raise InputError(f"{name}: its first line must name the columns time and energy; it is {' '.join(header)!r}")
    try:
        columns = [np.array([float(row[header.index(key)]) for row in rows[1:]]) for key in ("time", "energy")]
    except (IndexError, ValueError) as error:
        raise InputError(f"{name}: a row has no number for time or energy: {error}") from error
    time, energy = columns
    good = np.isfinite(time) & (energy < LARGEST) & (energy > 0)
    if np.count_nonzero(good) < 2:
        raise InputError(f"{name}: fewer than two rows have a time and a positive energy")
    return time[good], energy[good]
