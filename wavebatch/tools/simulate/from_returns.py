"""Waveforms modelled from discrete returns: a Gaussian per return, from its range and intensity."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, PS_PER_NS
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.cloud.return_io import ReturnReader
from wavebatch.files.las.header import is_projection, read_header
from wavebatch.files.strip.writer import FullwaveWriter
from wavebatch.kernels.geometry.pulse_rays import fit_rays, group_pulses
from wavebatch.kernels.physics.radar import receive_power, spread_cross_section
from wavebatch.tools.simulate.pulses import PulseModel
from wavebatch.tools.simulate.render import Recording, paint_echoes, record_counts

INTENSITIES = ("peak", "reflectance")
MARGIN = 6.0
"""Time before the first and behind the last return of a pulse, in standard deviations of the pulse."""
FULL_SHARE = 0.8
"""Without a gain, the strongest return but one in a thousand gets this share of the digitizer's range."""

_FORMATS = {0: 4, 1: 4, 2: 5, 3: 5, 4: 4, 5: 5, 6: 9, 7: 10, 8: 10, 9: 9, 10: 10}
_OWN_FIELDS = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location")
_LENGTHS = tuple(64 << number for number in range(8))
"""Samples of the waveforms, a digitizer for each: pulses that need more keep their points, without a packet."""
_PIECE = 50_000
_PAINTED = 1 << 22
_LEVELS = np.geomspace(1e-12, 1e12, 4801)


@dataclass(frozen=True, slots=True)
class Radar:
    """What the lidar equation needs besides range and reflectance."""

    height: float
    """Of the sensor, in the heights of the cloud [m]."""
    power: float = 1.0
    """Peak power of the pulse [W]; matters only with a gain."""
    aperture: float = 0.1
    """Diameter of the receiver [m]."""
    divergence: float = 0.5e-3
    """Full angle of the beam [rad]."""
    efficiency: float = 0.5
    attenuation: float = 0.22
    """Of the air [dB/km]."""

    def __post_init__(self) -> None:
        positive = (self.power, self.aperture, self.divergence, self.efficiency)
        if not (min(positive) > 0 and self.attenuation >= 0):
            raise ConfigError("power, aperture, divergence and efficiency must be above 0, attenuation not below")


@dataclass(frozen=True, slots=True)
class SynthesisOptions:
    """How returns become waveforms."""

    intensity: str = "peak"
    """`peak`: intensities are peak amplitudes; `reflectance`: they are reflectances, weakened by the lidar equation."""
    gain: float | None = None
    """`peak`: DN per unit of intensity; `reflectance`: DN per W, intensity 65535 being reflectance 1. None: chosen so
    that the strongest returns fill FULL_SHARE of the digitizer's range."""
    radar: Radar | None = None
    """For `reflectance`."""
    width: float = 4.7
    """Full width at half maximum of an echo [ns]; a column echo_width of the cloud comes first."""
    spacing: float = 1.0
    bits: int = 8
    baseline: float = 12.0
    noise: float = 0.0
    """Standard deviation before rounding [DN]."""
    seed: int = 0
    internal: bool = True

    def __post_init__(self) -> None:
        if self.intensity not in INTENSITIES:
            raise ConfigError(f"intensity {self.intensity!r} is unknown; choose peak or reflectance")
        if (self.radar is None) != (self.intensity == "peak"):
            raise ConfigError("intensities that are reflectances, and only they, need the sensor's height")
        if not (self.width > 0 and (self.gain is None or self.gain > 0)):
            raise ConfigError("width and gain must be above 0")
        if self.sigma < 0.5 * self.spacing:
            raise ConfigError(f"a pulse of {self.width} ns is too short for samples every {self.spacing} ns")

    @property
    def sigma(self) -> float:
        """Standard deviation of an echo [ns]."""
        return self.width / FWHM_PER_SIGMA

    def recording(self, n_samples: int) -> Recording:
        """The receiver; ConfigError for what none can be."""
        return Recording(
            n_samples=n_samples,
            spacing=self.spacing,
            bits=self.bits,
            baseline=self.baseline,
            baseline_spread=0.0,
            noise_std=self.noise,
            pulse=PulseModel(self.sigma),
        )


@dataclass(frozen=True, slots=True)
class SynthesisSummary:
    """What a synthesized strip holds."""

    points: int
    packets: int
    without_packet: int
    """Points without a packet: their pulse is longer than the longest waveform."""
    saturated: int
    """Returns whose amplitude leaves the digitizer's range."""
    scattered: int
    """Pulses with another number of points in a row than their points say."""
    gain: float
    """DN per unit of intensity, or per W."""


def synthesize_strip(
    cloud: Path,
    target: Path,
    options: SynthesisOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> SynthesisSummary:
    """Writes the points of `cloud` with modelled waveforms to `target` (.las or .laz); returns the counts.

    A pulse is a run of points of equal GPS time. Its waveform is a Gaussian per return, at the return's distance behind
    the first one. The ray runs from the first to the last return; lone returns take the direction that the pulses
    around them have at their scan angle. All points keep their coordinates and fields (extra bytes are left out); point
    formats 0 to 3 become 4 and 5, 6 to 8 become 9 and 10. Memory does not grow with the cloud.
    Raises InputError where the cloud cannot be read or has no GPS times, or the target exists; nothing remains then.
    """
    options = options or SynthesisOptions()
    with ReturnReader(cloud) as reader:
        if not reader.has_gps_time:
            raise InputError(f"{cloud}: point format {reader.point_format} has no gps times, which tell pulses apart")
        gain = _choose_gain(reader, options) if options.gain is None else options.gain
        job = _Job(reader, options, gain)
        with _open_writer(reader, Path(target), options, overwrite) as writer:
            for rows, records in _read_pulses(reader):
                job.write(writer, rows, records)
                if progress:
                    progress(len(rows))
            writer.commit()
    return SynthesisSummary(**job.counts, gain=gain)


def _read_pulses(reader: ReturnReader) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and raw records in pieces that cut no pulse."""
    rows, records = None, None
    for piece in reader.read_pieces(_PIECE):
        rows = piece if rows is None else np.concatenate([rows, piece])
        records = reader.records if records is None else np.concatenate([records, reader.records])
        starts = group_pulses(rows["gps_time"], rows["number"])
        if len(starts) > 1:
            yield rows[: starts[-1]], records[: starts[-1]]
            rows, records = rows[starts[-1] :], records[starts[-1] :]
    if rows is not None and len(rows):
        yield rows, records


def _open_writer(reader: ReturnReader, target: Path, options: SynthesisOptions, overwrite: bool) -> FullwaveWriter:
    point_format = _FORMATS[reader.point_format]
    recording = options.recording(_LENGTHS[0])
    return FullwaveWriter(
        target,
        version="1.3" if point_format < 6 else "1.4",
        point_format=point_format,
        internal=options.internal,
        digitizers=[
            Digitizer(number, options.bits, length, recording.spacing) for number, length in enumerate(_LENGTHS, 1)
        ],
        scales=reader.scales,
        offsets=reader.offsets,
        records=[vlr for vlr in read_header(reader.path).vlrs if is_projection(vlr)],
        overwrite=overwrite,
    )


def _measure_strength(rows: np.ndarray, options: SynthesisOptions, path: Path) -> np.ndarray:
    """Peak of each return before the gain: intensity, or received power [W]."""
    intensity = rows["intensity"].astype(np.float64)
    radar = options.radar
    if radar is None:
        return intensity
    distance = (radar.height - rows["xyz"][:, 2]) / np.cos(np.radians(np.clip(rows["angle"], -80, 80)))
    if len(distance) and distance.min() <= 0:
        highest = rows["xyz"][:, 2].max()
        raise InputError(f"{path}: points as high as {highest:g} m lie above the sensor at {radar.height:g} m")
    return receive_power(
        spread_cross_section(intensity / 65535, distance, radar.divergence),
        distance,
        transmitted=radar.power,
        aperture=radar.aperture,
        divergence=radar.divergence,
        efficiency=radar.efficiency,
        attenuation=radar.attenuation,
    )


def _choose_gain(reader: ReturnReader, options: SynthesisOptions) -> float:
    """The gain that fills the digitizer, from one look at all points."""
    counts = np.zeros(len(_LEVELS) + 1, np.int64)
    for rows in reader.read_pieces():
        strength = _measure_strength(rows, options, reader.path)
        counts += np.bincount(np.searchsorted(_LEVELS, strength[strength > 0]), minlength=len(counts))
    total = int(counts.sum())
    if reader.point_count and not total:
        raise InputError(f"{reader.path}: all intensities are 0, so there is nothing to model")
    level = int(np.searchsorted(np.cumsum(counts), 0.999 * total))
    room = FULL_SHARE * ((1 << options.bits) - 1 - options.baseline)
    return float(room / _LEVELS[min(level, len(_LEVELS) - 1)])


class _Job:
    """Pieces of a cloud to points and packets, with their counts."""

    def __init__(self, reader: ReturnReader, options: SynthesisOptions, gain: float) -> None:
        self._path, self._options, self._gain = reader.path, options, gain
        self._recordings = [options.recording(length) for length in _LENGTHS]
        self._piece = 0
        self.counts = {"points": 0, "packets": 0, "without_packet": 0, "saturated": 0, "scattered": 0}

    def write(self, writer: FullwaveWriter, rows: np.ndarray, records: np.ndarray) -> None:
        """Points and packets of whole pulses."""
        rng = np.random.default_rng(np.random.SeedSequence(self._options.seed, spawn_key=(self._piece,)))
        self._piece += 1
        starts = group_pulses(rows["gps_time"], rows["number"])
        count = np.diff(np.append(starts, len(rows)))
        pulse = np.repeat(np.arange(len(starts)), count)
        rays = fit_rays(rows["xyz"], starts, rows["angle"], rows["source"])
        sigma = self._choose_sigma(rows)
        time, duration = self._place(rows, rays, pulse, starts, sigma, rng)
        strength = self._gain * _measure_strength(rows, self._options, self._path)
        samples = np.ceil(duration / self._options.spacing) + 1
        kind = np.searchsorted(_LENGTHS, samples)
        offset = self._write_packets(writer, kind, pulse, time, strength, sigma, rng)
        self._count(rows, count, starts, strength, kind, pulse)
        writer.write_points(self._fill(writer.dtype, records, kind[pulse], offset[pulse], time, rays[pulse]))

    def _choose_sigma(self, rows: np.ndarray) -> np.ndarray:
        """Standard deviation of every echo [ns]: that of the cloud where it has one."""
        known = rows["echo_width"] > 0
        measured = np.where(known, rows["echo_width"], 0) / FWHM_PER_SIGMA
        return np.where(known, np.clip(measured, 0.5 * self._options.spacing, 50.0), self._options.sigma)

    def _place(self, rows, rays, pulse, starts, sigma, rng) -> tuple[np.ndarray, np.ndarray]:
        """Time of every return after sample 0 [ns], and time that each pulse's waveform must last."""
        behind = np.einsum("ij,ij->i", rows["xyz"] - rows["xyz"][starts][pulse], rays[pulse]) / HALF_C
        margin = MARGIN * np.maximum.reduceat(sigma, starts)
        phase = self._options.spacing * rng.random(len(starts))
        time = behind + (margin + phase - np.minimum.reduceat(behind, starts))[pulse]
        return time, np.maximum.reduceat(time, starts) + margin

    def _write_packets(self, writer, kind, pulse, time, strength, sigma, rng) -> np.ndarray:
        """Byte offset of every pulse's packet, u8; 0 where it has none."""
        offset = np.zeros(len(kind), np.uint64)
        for number, recording in enumerate(self._recordings):
            same = np.flatnonzero(kind == number)
            step = max(_PAINTED // recording.n_samples, 1)
            for begin in range(0, len(same), step):
                chosen = same[begin : begin + step]
                place = np.full(len(kind), -1)
                place[chosen] = np.arange(len(chosen))
                echoes = np.flatnonzero(place[pulse] >= 0)
                waveform = place[pulse[echoes]]
                signal = paint_echoes(recording, len(chosen), waveform, time[echoes], strength[echoes], sigma[echoes])
                offset[chosen] = writer.write_packets(record_counts(recording, signal, rng), number + 1)
        return offset

    def _count(self, rows, count, starts, strength, kind, pulse) -> None:
        limit = (1 << self._options.bits) - 1 - self._options.baseline
        self.counts["points"] += len(rows)
        self.counts["packets"] += int(np.count_nonzero(kind < len(_LENGTHS)))
        self.counts["without_packet"] += int(np.count_nonzero(kind[pulse] == len(_LENGTHS)))
        self.counts["saturated"] += int(np.count_nonzero(strength > limit))
        self.counts["scattered"] += int(np.count_nonzero(rows["total"][starts] != count))

    def _fill(self, dtype, records, kind, offset, time, rays) -> np.ndarray:
        """Output points: fields of the input, and where their packets are."""
        points = np.zeros(len(records), dtype)
        for name in dtype.names:
            if name in records.dtype.names and name not in _OWN_FIELDS:
                points[name] = records[name]
        has = kind < len(_LENGTHS)
        size = np.append(_LENGTHS, 0)[kind] * (self._options.bits // 8)
        points["wavepacket_index"] = np.where(has, kind + 1, 0)
        points["wavepacket_offset"] = np.where(has, offset, 0)
        points["wavepacket_size"] = size
        points["return_point_wave_location"] = np.where(has, time * PS_PER_NS, 0)
        for axis, name in enumerate(("x_t", "y_t", "z_t")):
            points[name] = np.where(has, -rays[:, axis] * HALF_C / PS_PER_NS, 0)
        return points
