"""The energy of each emitted pulse, as sensors log it: an extra byte of the points, or a text file by GPS time.

Runs, calibrations and voxels find it once per strip and fill it into each block. Energies count relative to the mean of
the calibration, or of the strip where there is none: see `matching.strip_energies`.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.core.order import even_places
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.las.header import ExtraRecord
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.files.text_file import read_text

COLUMN = "pulse_energy"
"""Extra byte that is used without being asked for: `wavebatch import` writes it."""

NONE = "none"
"""Request for no energies."""

SAMPLED_UNITS = 8
"""Units of a strip over whose points the mean is taken."""

LEAST_SHARE = 0.5
"""Least share of the sampled points whose energy a log that was asked for must know."""

LEAST_KNOWN = 20
"""Pulses of known energy that show the mean: where they scatter by a tenth, it is known to a fiftieth."""

NEAR = 0.3
"""A pulse has the energy logged at most this share of the usual interval of the log before or after it."""

LARGEST_ENERGY = 1e30
"""Energies from here on count as unknown: their squares overflow, and no unit is so small."""


@frozen(eq=False)
class PulseEnergy:
    """Where the energies of a strip's pulses come from; picklable."""

    source: str
    """Name of the extra byte, or of the text file."""
    field: str | None = None
    """Field of the point records; None for a text file."""
    record: ExtraRecord | None = None
    """Of the extra byte."""
    time: np.ndarray | None = None
    """Times of a text file, ascending, f8 (k,) [s]."""
    energy: np.ndarray | None = None
    """Energies at these times, f8 (k,)."""
    reach: float = 0.0
    """Largest distance in time between a pulse and its entry in the file [s]."""
    mean: float = 1.0
    """Of the strip, in the unit of the source."""
    spread: float = 0.0
    """Standard deviation over the strip, relative."""
    shots: float = 0.0
    """Standard deviation from shot to shot, relative: without what changes slowly, or stands still."""
    reference: float | None = None
    """The energy that counts as 1; None: the mean."""
    missed: float = 0.0
    """Scatter of the true energies that these do not tell, relative."""
    unit: str = ""
    """What the description of the extra byte says."""
    known: float = 1.0
    """Share of the sampled points whose energy is known."""
    error_field: str | None = None
    """Field of the standard deviations, in the unit of the source; None where they are not known."""
    fills: float | None = None
    """A pulse of unknown energy counts as one of mean energy, as it would without energies, with this relative error;
    None: it has no data."""

    @property
    def level(self) -> float:
        """The mean over the reference."""
        return self.mean / (self.reference or self.mean)

    def read_column(self, points: np.ndarray) -> np.ndarray:
        """Return the extra byte of point records (n,), f8; raises ValueError for energies of a text file."""
        if self.field is None or self.record is None:
            raise ValueError(f"{self.source} is no extra byte")
        return self.record.read(points[self.field])

    def read(self, points: np.ndarray) -> np.ndarray:
        """Return the energies of the pulses of point records (n,), f8, NaN where unknown, in the unit of the source."""
        if self.field is not None:
            values = self.read_column(points)
            return np.where(values > 0, values, np.nan)
        time, known = points["gps_time"].astype(np.float64), np.asarray(self.time)
        after = np.clip(np.searchsorted(known, time), 1, len(known) - 1)
        place = after - (time - known[after - 1] < known[after] - time)
        return np.where(np.abs(known[place] - time) <= self.reach, np.asarray(self.energy)[place], np.nan)

    def fill(self, block: WaveformBlock, unit: Unit) -> WaveformBlock:
        """Return a block of the unit with the energies of its pulses over the reference."""
        records, whole = take_records(block, unit), self.reference or self.mean
        energy, error = self.read(records) / whole, None
        if self.error_field is not None:
            error = records[self.error_field].astype(np.float64) / whole
            error = np.where((error >= 0) & (error < LARGEST_ENERGY), error, 0.0)
        if self.fills is not None and np.isnan(energy).any():
            unknown = np.isnan(energy)
            error = np.where(unknown, self.fills * self.level, 0.0 if error is None else error)
            energy = np.where(unknown, self.level, energy)
        if self.missed:
            error = np.hypot(0.0 if error is None else error, self.missed * energy)
        return replace(block, pulse_energy=energy, pulse_energy_err=error)

    def describe(self) -> dict[str, Any]:
        """Return source, mean and spread for reports."""
        return {
            "source": self.source,
            "mean": float(f"{self.mean:.6g}"),
            "reference": float(f"{self.reference or self.mean:.6g}"),
            "spread": round(self.spread, 6),
            "share_known": round(self.known, 6),
        }


def take_records(block: WaveformBlock, unit: Unit) -> np.ndarray:
    """Return the point record of each waveform (n,) of a block of the unit."""
    place = block.point - unit.start
    inside = (place >= 0) & (place < len(unit.points))
    records = np.empty(len(block), unit.points.dtype)
    records[inside] = unit.points[place[inside]]
    if not inside.all():
        records[~inside] = unit.context[np.searchsorted(unit.context_index, block.point[~inside])]
    return records


def find_pulse_energy(reader: StripReader, scan: StripScan, request: str | None) -> PulseEnergy | None:
    """Find the energies of a strip's pulses.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    request : str or None
        Name of an extra byte of the strip, or path of a text file with columns time and energy. None: the extra byte
        COLUMN, if the strip has it and it knows LEAST_KNOWN pulses; NONE: no energies.

    Returns
    -------
    PulseEnergy or None

    Raises
    ------
    InputError
        Where there is no such extra byte and no such file, or where it does not know half of the strip's pulses.
    """
    path = reader.facts.path
    if request == NONE:
        return None
    found = find_column(reader, request or COLUMN)
    if found is None and request is None:
        return None
    if found is None:  # a text file
        name = request or ""
        if not Path(name).is_file():
            hint = name_columns(reader, name)
            raise InputError(f"{path}: --energy: no extra byte and no file is called {name!r}; {hint}")
        text = read_text(name, "file of pulse energies", 1 << 30).replace('"', "")
        lines = [line for line in text.splitlines() if line.strip()]
        lines[:1] = [re.sub(r"[\[(][^\])]*[\])]", " ", line.casefold()) for line in lines[:1]]  # units, as in time [s]
        # A name may have spaces, and a value may be missing: neither moves the columns after it.
        rows = [re.split("[,;]", line) if "," in line or ";" in line else line.split() for line in lines]
        header = [word.strip() for word in rows[0]] if rows else []
        if not {"time", "energy"} <= set(header):
            words = "its first line must name the columns time and energy"
            raise InputError(f"{name}: {words}; it is {' '.join(header)!r}")
        try:
            columns = [np.array([float(row[header.index(key)]) for row in rows[1:]]) for key in ("time", "energy")]
        except (IndexError, ValueError) as error:
            raise InputError(f"{name}: a row has no number for time or energy: {error}") from error
        time, energy = columns
        good = np.isfinite(time) & (energy < LARGEST_ENERGY) & (energy > 0)
        if np.count_nonzero(good) < 2:
            raise InputError(f"{name}: fewer than two rows have a time and a positive energy")
        time, energy = time[good], energy[good]
        order = np.argsort(time, kind="stable")
        time, energy = time[order], energy[order]
        step = np.diff(time)
        reach = NEAR * float(np.median(step[step > 0])) if (step > 0).any() else 1e-6
        found = PulseEnergy(Path(name).name, time=time, energy=energy, reach=reach)
    chosen = even_places(reader.unit_count(), SAMPLED_UNITS)
    values = np.empty(0)
    for number in chosen:
        points = reader.read_unit(int(number), scan).points
        # Points of one pulse follow each other: each pulse counts once.
        new = np.append(True, points["gps_time"][1:] != points["gps_time"][:-1])[: len(points)]
        values = np.append(values, found.read(points[new]))
    there = values[np.isfinite(values)]
    if request is None and len(there) < min(LEAST_KNOWN, len(values)):
        return None
    if request is not None and len(there) < LEAST_SHARE * len(values):
        raise InputError(
            f"{path}: --energy {request} knows {len(there)} of {len(values)} pulses of the strip; it must have "
            "positive energies, a text file those at the GPS times of the points"
        )
    mean = float(there.mean()) if len(there) else 1.0
    spread = float(there.std() / mean) if len(there) else 0.0
    known = len(there) / max(len(values), 1)
    shots = float(np.sqrt(0.5 * np.mean(np.diff(there) ** 2)) / mean) if len(there) > 1 else 0.0
    return replace(found, mean=mean, spread=spread, shots=shots, known=known, fills=None if request else spread)


def find_column(reader: StripReader, request: str) -> PulseEnergy | None:
    """Find the extra byte of this name; None where there is none."""
    known = {record.name: (field, record) for field, record in reader.facts.extra.items()}
    field, record = known.get(request, (None, None))
    if record is None or not 1 <= record.code <= 10:
        return None
    error, described = known.get(f"{request}_err", (None, None))
    plain = described is not None and 1 <= described.code <= 10 and described.scaling is None
    return PulseEnergy(request, field, record, error_field=error if plain else None, unit=record.description)


def name_columns(reader: StripReader, request: str) -> str:
    """Return the extra byte that is called nearly so, or what there is, for a message."""
    names = [record.name for record in reader.facts.records]
    return nearest(request, names) if names else "the strip has no extra bytes"
