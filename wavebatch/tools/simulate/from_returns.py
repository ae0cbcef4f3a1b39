"""A cloud of discrete returns as a strip with modelled waveforms: a Gaussian per return, from range and intensity.

`wavebatch synthesize` calls `synthesize_strip`. The cloud is read once in pieces that cut no pulse, and once before to
choose the gain where none is given. Heights, widths and shares of the beam are those of `return_light`. The other
modules of this folder invent echoes; this one takes them from a file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.units import HALF_C, SQRT_2PI
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.cloud.cloud_reader import RETURN_DTYPE, CloudReader
from wavebatch.files.disk.publish import protecting
from wavebatch.files.las.crs import repair_records
from wavebatch.files.las.header import field_names, is_projection, read_header
from wavebatch.files.strip.writer import FullwaveWriter
from wavebatch.kernels.geometry.group_returns import fit_rays, group_pulses
from wavebatch.tools.simulate.render import Recording, paint_echoes, record_counts
from wavebatch.tools.simulate.returns import LightCounts, LightModel, ReturnLight, SynthesisOptions, fill_packets

MARGIN = 6.0
"""Time before the first and after the last return of a pulse, in standard deviations of the pulse."""

FULL_SHARE = 0.8
"""Share of the digitizer's range that the 99.9 % quantile of the strengths fills where no gain is given."""

_FORMATS = {0: 4, 1: 4, 2: 5, 3: 5, 4: 4, 5: 5, 6: 9, 7: 10, 8: 10, 9: 9, 10: 10}
_PACKET_FIELDS = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location")
_LENGTHS = tuple(64 << number for number in range(8))
"""Lengths of the waveforms [samples], a digitizer for each. Pulses that need more keep their points without packet."""
_PIECE = 50_000
"""Points read at a time. Random numbers are drawn per piece: another value gives other noise."""
_PAINTED = 1 << 22
"""Samples painted at a time."""
_LEVELS = np.geomspace(1e-12, 1e12, 4801)
"""Edges of the histogram of strengths, 1.2 % apart, from which the gain is chosen."""



@dataclass(slots=True)
class SynthesisSummary:
    """Counts of a synthesized strip."""

    points: int = 0
    packets: int = 0
    without_packet: int = 0
    """Points without a packet: their pulse is longer than the longest waveform."""
    saturated: int = 0
    """Returns whose amplitude leaves the digitizer's range."""
    scattered: int = 0
    """Pulses whose number of points in a row is not the number of returns that the points state."""
    gain: float = 1.0
    """DN per unit of intensity, or per W."""
    energy: float = 0.0
    """Of the echoes of all returns, as modelled [DN ns]."""
    energy_without_packet: float = 0.0
    """Of those without a packet."""
    energy_recorded: float = 0.0
    """Sum of the samples above the baseline [DN ns]: less than modelled where the digitizer saturates, and where echoes
    are lower than half a count; more or less by about `energy_of_level`, and by the sum of the noise, which is 0 on
    average. Compare it with `energy_in_packets`."""
    level: float = 0.0
    """Mean of the samples without an echo [DN]: above the baseline where noise below 0 is cut off, and not on it where
    rounding without noise cannot hold a fraction."""
    energy_of_level: float = 0.0
    """What this adds to `energy_recorded`, if no echo covers it [DN ns]."""
    light: LightCounts = field(default_factory=LightCounts)
    """Whose widths and shares were known."""

    @property
    def energy_in_packets(self) -> float:
        """Of the modelled echoes with a packet [DN ns]."""
        return self.energy - self.energy_without_packet

    @property
    def light_used(self) -> float:
        """Mean share of the beam that the returns of a pulse take together; NaN without shares."""
        return self.light.shares / self.light.pulses if self.light.pulses else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return {**asdict(self), "light_used": self.light_used}


@dataclass(frozen=True, slots=True, eq=False)
class _Pulses:
    """n whole pulses with k returns, and the echoes that model them."""

    pulse: np.ndarray
    """Pulse of each return, i8 (k,)."""
    time: np.ndarray
    """Time of each return after sample 0 [ns], f8 (k,)."""
    amplitude: np.ndarray
    """[DN], f8 (k,)."""
    sigma: np.ndarray
    """Standard deviation of each echo [ns], f8 (k,)."""
    ray: np.ndarray
    """Unit vector of each pulse away from the sensor, f8 (n, 3)."""
    kind: np.ndarray
    """Index in _LENGTHS of the waveform of each pulse, i8 (n,); len(_LENGTHS) where none is long enough."""
    is_scattered: np.ndarray
    """Pulses whose points state another number of returns, bool (n,)."""


def synthesize_strip(
    cloud: Path,
    target: Path,
    options: SynthesisOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> SynthesisSummary:
    """Writes the points of `cloud` with modelled waveforms to `target` (.las or .laz); returns the counts.

    A pulse is a run of points of equal GPS time. Its waveform is a Gaussian per return, at the return's distance from
    the first one. The ray runs from the first to the last return; lone returns take the direction that the pulses
    around them have at their scan angle. All points keep their coordinates and fields (extra bytes are left out); point
    formats 0 to 3 become 4 and 5, 6 to 8 become 9 and 10. Memory does not grow with the cloud.
    Raises InputError where the cloud cannot be read, has no GPS times or is not in metres, or the target exists,
    ConfigError where it lacks a column, or a column holds no widths or shares; no file remains then.
    """
    options = options or SynthesisOptions()
    recordings = [options.recording(length) for length in _LENGTHS]
    with protecting([cloud]), CloudReader(cloud, RETURN_DTYPE) as reader:
        if not reader.has_gps_time:
            raise InputError(
                f"{cloud}: point format {reader.point_format} has no GPS times, which are needed to group points into "
                "pulses; give a cloud of another point format"
            )
        if reader.metres != (1.0, 1.0, 1.0):
            raise InputError(
                f"{cloud}: coordinates are {reader.unit}, but times along a ray need metres; project it to metres first"
            )
        light = LightModel(reader.path, options)
        # A model counts what it sees: each pass over the cloud has one.
        gain = _choose_gain(reader, LightModel(reader.path, options)) if options.gain is None else options.gain
        summary = SynthesisSummary(gain=gain, light=light.counts, level=recordings[0].empty_level)
        rise = options.spacing * (summary.level - options.baseline)
        with _open_writer(reader, Path(target), options, overwrite) as writer:
            for number, (rows, records) in enumerate(_read_pulses(reader)):
                rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(number,)))
                pulses = _model_pulses(rows, records, gain, light, rng)
                offset, energy = _write_packets(writer, recordings, pulses, rng)
                summary.energy_recorded += energy
                summary.energy_of_level += rise * float(np.append(_LENGTHS, 0)[pulses.kind].sum())
                writer.write_points(_fill_points(writer.dtype, records, pulses, offset, options))
                _count(summary, pulses, recordings[0])
                if progress:
                    progress(len(rows))
            light.check_widths()
            writer.commit()
    return summary


def _read_pulses(reader: CloudReader) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and raw records in pieces that cut no pulse."""
    rows: np.ndarray | None = None
    records: np.ndarray | None = None
    for piece in reader.read_pieces(_PIECE):
        rows = piece if rows is None else np.concatenate([rows, piece])
        records = reader.records if records is None else np.concatenate([records, reader.records])
        starts = group_pulses(rows["gps_time"], rows["number"])
        if len(starts) > 1:
            yield rows[: starts[-1]], records[: starts[-1]]
            rows, records = rows[starts[-1] :], records[starts[-1] :]
    if rows is not None and records is not None and len(rows):
        yield rows, records


def _open_writer(reader: CloudReader, target: Path, options: SynthesisOptions, overwrite: bool) -> FullwaveWriter:
    point_format = _FORMATS[reader.point_format]
    lengths = enumerate(_LENGTHS, 1)
    return FullwaveWriter(
        target,
        version="1.3" if point_format < 6 else "1.4",
        point_format=point_format,
        internal=options.internal,
        digitizers=[Digitizer(number, options.bits, length, options.spacing) for number, length in lengths],
        scales=reader.scales,
        offsets=reader.offsets,
        records=repair_records(vlr for vlr in read_header(reader.path).vlrs if is_projection(vlr)),
        overwrite=overwrite,
    )


def _choose_gain(reader: CloudReader, light: LightModel) -> float:
    """The gain that fills the digitizer; reads all points."""
    counts, options = np.zeros(len(_LEVELS) + 1, np.int64), light.options
    for rows, records in _read_pulses(reader):
        strength = light.measure(rows, records, group_pulses(rows["gps_time"], rows["number"])).strength
        counts += np.bincount(np.searchsorted(_LEVELS, strength[strength > 0]), minlength=len(counts))
    total = int(counts.sum())
    if reader.point_count and not total:
        rest = " or share 0" if options.shares else ""
        raise InputError(f"{reader.path}: all returns have intensity 0{rest}, so there is nothing to model")
    light.check_widths()
    level = int(np.searchsorted(np.cumsum(counts), 0.999 * total))
    room = FULL_SHARE * ((1 << options.bits) - 1 - options.baseline)
    return float(room / _LEVELS[min(level, len(_LEVELS) - 1)])


def _model_pulses(
    rows: np.ndarray, records: np.ndarray, gain: float, light: LightModel, rng: np.random.Generator
) -> _Pulses:
    """Echoes of the returns, with sample 0 a margin and a random part of a sample before the first of each pulse."""
    spacing, starts = light.options.spacing, group_pulses(rows["gps_time"], rows["number"])
    count = np.diff(np.append(starts, len(rows)))
    pulse = np.repeat(np.arange(len(starts)), count)
    ray = fit_rays(rows["xyz"], starts, rows["scan_angle"], rows["source"])
    seen: ReturnLight = light.measure(rows, records, starts)
    sigma = seen.sigma
    delay = np.einsum("ij,ij->i", rows["xyz"] - rows["xyz"][starts][pulse], ray[pulse]) / HALF_C
    margin = MARGIN * np.maximum.reduceat(sigma, starts)
    phase = spacing * rng.random(len(starts))
    time = delay + (margin + phase - np.minimum.reduceat(delay, starts))[pulse]
    n_samples = np.ceil((np.maximum.reduceat(time, starts) + margin) / spacing) + 1
    return _Pulses(
        pulse=pulse,
        time=time,
        amplitude=gain * seen.strength,
        sigma=sigma,
        ray=ray,
        kind=np.searchsorted(_LENGTHS, n_samples),
        is_scattered=rows["total"][starts] != count,
    )


def _write_packets(
    writer: FullwaveWriter, recordings: list[Recording], pulses: _Pulses, rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """Byte offset of every pulse's packet, u8 (n,), 0 where it has none; and the energy of the samples [DN ns]."""
    energy = 0.0
    offset = np.zeros(len(pulses.kind), np.uint64)
    for number, recording in enumerate(recordings):
        same = np.flatnonzero(pulses.kind == number)
        step = max(_PAINTED // recording.n_samples, 1)
        for begin in range(0, len(same), step):
            chosen = same[begin : begin + step]
            place = np.full(len(offset), -1)
            place[chosen] = np.arange(len(chosen))
            waveform = place[pulses.pulse]
            echoes = waveform >= 0
            columns = (values[echoes] for values in (waveform, pulses.time, pulses.amplitude, pulses.sigma))
            signal = paint_echoes(recording, len(chosen), *columns)
            counts = record_counts(recording, signal, rng)
            energy += recording.spacing * (float(counts.sum(dtype=np.float64)) - recording.baseline * counts.size)
            offset[chosen] = writer.write_packets(counts, number + 1)
    return offset, energy


def _fill_points(
    dtype: np.dtype, records: np.ndarray, pulses: _Pulses, offset: np.ndarray, options: SynthesisOptions
) -> np.ndarray:
    """Output points: fields of the input, and where their packets are."""
    points = np.zeros(len(records), dtype)
    for name in set(field_names(dtype)) & set(field_names(records.dtype)) - set(_PACKET_FIELDS):
        points[name] = records[name]
    kind = pulses.kind[pulses.pulse]
    index = np.where(kind < len(_LENGTHS), kind + 1, 0)
    size = np.append(_LENGTHS, 0)[kind] * (options.bits // 8)
    fill_packets(points, index, offset[pulses.pulse], size, pulses.time, pulses.ray[pulses.pulse] * HALF_C)
    return points


def _count(summary: SynthesisSummary, pulses: _Pulses, recording: Recording) -> None:
    too_long = pulses.kind == len(_LENGTHS)
    energy = SQRT_2PI * pulses.amplitude * pulses.sigma
    summary.energy += float(energy.sum())
    summary.energy_without_packet += float(energy[too_long[pulses.pulse]].sum())
    summary.points += len(pulses.pulse)
    summary.packets += int(np.count_nonzero(~too_long))
    summary.without_packet += int(np.count_nonzero(too_long[pulses.pulse]))
    summary.saturated += int(np.count_nonzero(pulses.amplitude > recording.clip - recording.baseline))
    summary.scattered += int(np.count_nonzero(pulses.is_scattered))
