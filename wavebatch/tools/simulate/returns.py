"""From true echoes to discrete returns: those of a vendor's software, and those of a receiver with a dead zone.

`strip.simulate_strip` stores the returns of `list_returns` with the waveforms; `strip.simulate_returns` stores those of
a DiscreteReceiver, which has no waveforms. Both models give a Returns table. For `synthesize_strip` it also says how
much light each return of a cloud sends back, how wide its echo is, and which share of the beam it takes.

`synthesize_strip` makes a strip of a cloud of discrete returns, with modelled waveforms: a Gaussian per return, from
range and intensity. The cloud is read once in pieces that cut no pulse, and once before to choose the gain where none
is given. Heights, widths and shares of the beam are those of `LightModel`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Above, CheckedOptions, Range, check_options, option
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, PS_PER_NS, SQRT_2PI
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.cloud.cloud_reader import RETURN_DTYPE, CloudReader, ColumnReader
from wavebatch.files.disk.publish import protecting
from wavebatch.files.las.crs import repair_records
from wavebatch.files.las.header import field_names, is_projection, read_header
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.kernels.geometry.group_returns import fit_rays, group_pulses
from wavebatch.kernels.physics.radiometry import receive_power, spread_cross_section
from wavebatch.tools.simulate.render import MOST_NOISE, PulseModel, Recording, paint_echoes, record_counts

EQUAL = "equal"
"""Word in place of a column of shares: the returns of a pulse take the same share each, as many as it had."""

WIDEST = 50.0
"""Largest standard deviation of an echo [ns]; the least is half a sample."""

_MOST_LIMITED = 0.5
"""Largest share of the widths of a column that may be limited: with more, the column is not what was meant."""

_TOLERANCE = 1e-4
"""Shares that are stored as float32 or in steps of 1e-4 may be above 1 by so much."""


@frozen
class Radar(CheckedOptions):
    """Parameters of the lidar equation besides range and reflectance, see kernels.physics.radiometry."""

    height: Annotated[float, Range(-1e6, 1e6)] = option(
        MISSING, "Reflectance: height of the sensor, in the heights of CLOUD [m].", form="M", name="sensor-height"
    )
    power: Annotated[float, Range(1e-6, 1e12)] = option(
        1.0, "Reflectance: peak power of the pulse [W].", form="W", unset="1"
    )  # matters only with a gain
    aperture: Annotated[float, Range(1e-4, 100.0)] = option(
        0.1, "Reflectance: diameter of the receiver [m].", form="M", unset="0.1"
    )
    divergence: Annotated[float, Range(0.001, 100.0)] = option(
        0.5, "Reflectance: full angle of the beam [mrad].", form="MRAD", unset="0.5"
    )
    efficiency: Annotated[float, Range(1e-6, 1.0)] = option(
        0.5, "Reflectance: efficiency of the optics.", form="SHARE", unset="0.5"
    )
    attenuation: Annotated[float, Range(0.0, 100.0)] = option(
        0.22, "Reflectance: attenuation of the air [dB/km].", form="DB_KM", unset="0.22"
    )


@frozen
class SynthesisOptions:
    """How returns become waveforms."""

    intensity: Literal["peak", "reflectance"] = option(
        "peak", "Meaning of the intensities: peak amplitudes, or reflectances (65535 is 1), from which the lidar "
        "equation computes amplitudes.",
    )  # fmt: skip
    gain: Annotated[float | None, Above(0.0, 1e20)] = option(
        None, "DN per unit of intensity, or per W.", form="DN", unset="fills 80 % of the digitizer"
    )  # amplitudes must stay numbers in float32
    radar: Radar | None = None
    """Needed for `reflectance`, and only there."""
    width: Annotated[float, Above(0.0, 1000.0)] = option(
        4.7, "Full width of the pulse at half maximum [ns], and of echoes without a width.", form="NS"
    )
    widths: str | None = option(
        None, "Column with the full width of each echo at half maximum [ns].", form="COLUMN",
        unset="echo_width, if present",
    )  # fmt: skip
    shares: str | None = option(
        None, "Reflectance: column with the share of the footprint that each return takes, 0 to 1, or equal. Returns "
        "without data take evenly what the others of their pulse leave; shares above 1 together are scaled to 1.",
        form="COLUMN|equal", unset="each return fills it",
    )  # fmt: skip
    spacing: Annotated[float, Range(0.001, 4000.0)] = option(1.0, "Time between samples [ns].", form="NS")
    bits: Literal[8, 16, 32] = option(8, "Bits per sample.")
    baseline: float = option(12.0, "Level without signal [DN].", form="DN")
    noise: Annotated[float, Range(0.0, MOST_NOISE)] = option(
        0.0, "Standard deviation of the noise before rounding [DN].", form="DN"
    )
    seed: int = 0
    internal: bool = option(True, "Store packets in the file or in a .wdp file.", opposite="external", unset="internal")

    def __post_init__(self) -> None:
        check_options(self)
        if (self.radar is None) != (self.intensity == "peak"):
            raise ConfigError("the sensor's height is needed for intensity reflectance, and only there")
        if self.shares is not None and self.radar is None:
            raise ConfigError(
                "shares of the beam need intensity reflectance: the peaks of returns hold their shares already"
            )
        if self.sigma < 0.5 * self.spacing:
            raise ConfigError(f"a pulse of {self.width} ns is too short for samples every {self.spacing} ns")

    @property
    def sigma(self) -> float:
        """Standard deviation of an echo [ns]."""
        return self.width / FWHM_PER_SIGMA

    def recording(self, n_samples: int) -> Recording:
        """The receiver with waveforms of that length; raises ConfigError for values that none can have."""
        pulse = PulseModel(self.sigma)
        return Recording(n_samples, self.spacing, self.bits, self.baseline, 0.0, self.noise, pulse=pulse)


@dataclass(slots=True)
class LightCounts:
    """What was assumed about widths and shares."""

    own_width: int = 0
    """Returns with a width in the cloud; the others have the width of the pulse."""
    limited_width: int = 0
    """Of these, returns whose width lies outside of half a sample to WIDEST, and was set to that limit."""
    assumed_unit: bool = False
    """Whether the column of the widths states no unit, and its values were taken as ns."""
    own_share: int = 0
    """Returns with a share in the cloud."""
    assumed_share: int = 0
    """Returns that take, together and evenly, what the others of their pulse leave."""
    over_one: int = 0
    """Pulses whose shares were more than 1 together, and were divided by their sum."""
    pulses: int = 0
    """Pulses with shares."""
    shares: float = 0.0
    """Sum of all shares."""


class LightModel:
    """The light of the returns of one cloud; counts what is assumed.

    Raises ConfigError if the cloud lacks a column of the options, or has it in another unit, or if it is a field that
    LAS itself defines: none of these is a width or a share, and integers such as the class pass for both.
    """

    def __init__(self, path: Path, options: SynthesisOptions) -> None:
        self.path, self.options, self.counts = path, options, LightCounts()
        self._read_width = self._open("widths", ("-", "ns"), "the width of each echo in ns")
        self._read_share = None
        if options.shares != EQUAL:
            self._read_share = self._open("shares", ("-",), "the share of each return, 0 to 1")

    def _open(self, option: str, units: tuple[str, ...], needed: str) -> Callable[[np.ndarray], np.ndarray] | None:
        """From raw records to the values of an option's column; None where none is named."""
        column = getattr(self.options, option)
        if column is None:
            return None
        with ColumnReader(self.path, column) as reader:
            facts = reader.facts[0]
            if facts.unit not in units:
                raise ConfigError(f"{self.path}: --{option} {column}: is in [{facts.unit}], needed is [{units[-1]}]")
            if facts.is_standard:
                raise ConfigError(
                    f"{self.path}: --{option} {column}: is the LAS field {facts.name}; give an extra dimension with "
                    f"{needed}"
                )
            self.counts.assumed_unit |= option == "widths" and facts.unit == "-"
            return reader.find_column(column)[1]

    def measure(self, rows: np.ndarray, records: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Peak of each return (k,) before the gain (intensity, or received power [W]) and deviation of its echo [ns].

        rows: RETURN_DTYPE; records: the same as raw records; starts: first return of each pulse.

        Raises InputError for shares that are none, and for points above the sensor.
        """
        width = rows["echo_width"] if self._read_width is None else self._read_width(records)
        known = width > 0
        measured = np.where(known, width, 0.0) / FWHM_PER_SIGMA
        limited = np.clip(measured, 0.5 * self.options.spacing, WIDEST)
        self.counts.own_width += int(np.count_nonzero(known))
        self.counts.limited_width += int(np.count_nonzero(known & (limited != measured)))
        sigma = np.where(known, limited, self.options.sigma)
        intensity = rows["intensity"].astype(np.float64)
        if self.options.radar is None:
            return intensity, sigma
        radar = self.options.radar
        distance = (radar.height - rows["xyz"][:, 2]) / np.cos(np.radians(np.clip(rows["scan_angle"], -80, 80)))
        if len(distance) and distance.min() <= 0:
            highest = rows["xyz"][:, 2].max()
            raise InputError(f"{self.path}: points as high as {highest:g} m lie above the sensor at {radar.height:g} m")
        # Received power of surfaces that fill the beam [W].
        power = receive_power(
            spread_cross_section(intensity / 65535, distance, 1e-3 * radar.divergence),
            distance,
            transmitted=radar.power,
            aperture=radar.aperture,
            divergence=1e-3 * radar.divergence,
            efficiency=radar.efficiency,
            attenuation=radar.attenuation,
        )
        # The power is that of an echo as short as the pulse: a wider one spreads the same energy over a longer time.
        power *= self.options.sigma / sigma
        if self.options.shares is not None:
            known_shares = over = 0
            if self._read_share is None:
                # Returns that the cloud lacks, by the numbers that the points state, take their share, too.
                number = np.diff(np.append(starts, len(rows)))
                share = 1.0 / np.maximum(np.repeat(number, number), rows["total"])
            else:
                share = self._read_share(records).astype(float)
                wrong = np.flatnonzero((share < 0) | (share > 1 + _TOLERANCE))
                if len(wrong):
                    raise InputError(
                        f"{self.path}: {self.options.shares} holds {share[wrong[0]]:g}, which is no share of a "
                        "footprint: shares are 0 to 1; give a column with such values to --shares"
                    )
                known_shares = int(np.count_nonzero(np.isfinite(share)))
                share, over = fill_shares(share, starts)
            self.counts.own_share += known_shares
            self.counts.assumed_share += len(share) - known_shares
            self.counts.over_one += over
            self.counts.pulses += len(starts)
            self.counts.shares += float(share.sum())
            power *= share
        return power, sigma

    def check_widths(self) -> None:
        """Raises ConfigError where most widths of the named column had to be limited: they are no widths in ns."""
        counts = self.counts
        if self.options.widths is not None and counts.limited_width > _MOST_LIMITED * counts.own_width:
            least, most = 0.5 * self.options.spacing * FWHM_PER_SIGMA, WIDEST * FWHM_PER_SIGMA
            raise ConfigError(
                f"{self.path}: --widths {self.options.widths}: {counts.limited_width} of {counts.own_width} values are "
                f"outside of {least:.2g} to {most:.0f} ns; give a column with the width of each echo in ns"
            )


def fill_shares(share: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, int]:
    """Shares of the returns of whole pulses, at most 1 together, without gaps.

    share: f8 (k,), NaN for no data: such returns take, evenly, what the others of their pulse leave. starts: first
    return of each pulse. Returns the shares, and the number of pulses with more than 1, divided by their sum.
    """
    if not len(starts):
        return share, 0
    known = np.isfinite(share)
    pulse = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(share))))
    total = np.add.reduceat(np.where(known, share, 0.0), starts)
    unknown = np.add.reduceat((~known).astype(np.float64), starts)
    rest = np.clip(1.0 - total, 0.0, 1.0) / np.maximum(unknown, 1.0)
    filled = np.where(known, share, rest[pulse]) / np.maximum(total, 1.0)[pulse]
    return filled, int(np.count_nonzero(total > 1.0 + _TOLERANCE))


WEAKEST_RETURN = 3.0
"""Echoes below this many standard deviations of the noise give no return."""

DISTINCT = 1.0
"""Echoes closer than this many full widths at half maximum give one return, that of the strongest."""


@frozen(eq=False)
class Returns:
    """Discrete returns sorted by pulse, then time."""

    pulse: np.ndarray
    """Row of the pulse, i8 (k,)."""
    time: np.ndarray
    """True time after sample 0 [ns], f8 (k,)."""
    amplitude: np.ndarray
    """[DN], (k,); 0 for the stand-in return of a pulse without echo."""
    number: np.ndarray
    """Return number from 1, i8 (k,)."""
    total: np.ndarray
    """Number of returns of the pulse, i8 (k,)."""


@frozen
class DiscreteReceiver(CheckedOptions):
    """A receiver that is blind for one dead zone after each return (docs/algorithms.md 1.5).

    A return fires at the first echo from which the amplitudes, summed over one dead zone, exceed the threshold.
    """

    dead_zone: Annotated[float, Above(0.0, 1e6)] = option(
        0.65, "Discrete: least distance of two returns [m].", form="M", unset="0.65"
    )
    threshold: Annotated[float, Range(0.0, 1e10)] = option(
        12.0, "Discrete: amplitude that triggers a return [DN].", form="DN", unset="12"
    )
    most: Annotated[int, Range(1, 15)] = option(
        4, "Discrete: most returns per pulse.", form="N", name="most-returns", unset="4"
    )

    def list_returns(self, truth: EchoTable, n: int) -> Returns:
        """The returns that the echoes of n pulses fire."""
        row, number, amplitude = self.fire(truth.waveform, truth.time * HALF_C, truth.amplitude)
        pulse = truth.waveform[row].astype(np.int64)
        return Returns(pulse, truth.time[row], amplitude, number, np.bincount(pulse, minlength=n)[pulse])

    def fire(
        self, pulse: np.ndarray, distance: np.ndarray, amplitude: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which echoes fire a return.

        Parameters
        ----------
        pulse, distance, amplitude : echoes (m,), sorted by pulse, then distance [m]; amplitude [DN]

        Returns
        -------
        row of the echo that fired, i8 (k,); return number from 1, i8 (k,); summed amplitude, f8 (k,)
        """
        m = len(pulse)
        first = np.searchsorted(pulse, pulse, side="left")
        end = np.searchsorted(pulse, pulse, side="right")
        # End of the dead zone: the first row of the same pulse at or beyond it, else the row after the pulse.
        limit = distance + self.dead_zone
        reach = np.arange(m)
        moving = reach.copy()
        while len(moving):
            reach[moving] += 1
            moving = moving[reach[moving] < end[moving]]
            moving = moving[distance[reach[moving]] < limit[moving]]
        sums = np.concatenate([[0.0], np.cumsum(amplitude, dtype=np.float64)])
        energy = sums[reach] - sums[:m]
        loud = np.where(energy > self.threshold, np.arange(m), m)
        next_loud = np.append(np.minimum.accumulate(loud[::-1])[::-1], m)
        rows, numbers = [], []
        at = np.unique(first)
        for number in range(1, self.most + 1):
            hit = next_loud[at]
            hit = hit[hit < end[at]]
            rows.append(hit)
            numbers.append(np.full(len(hit), number))
            at = reach[hit[reach[hit] < end[hit]]]
        row = np.concatenate(rows)
        order = np.argsort(row, kind="stable")
        return row[order], np.concatenate(numbers)[order], energy[row[order]]


def list_returns(truth: EchoTable, n: int, recording: Recording, most: int, *, keep_empty: bool) -> Returns:
    """Returns of n pulses as a vendor delivers them with waveforms.

    One per distinguishable echo inside the window, at its true time, at most `most` per pulse. keep_empty: a pulse
    without echo gets one stand-in return in the middle of its window.
    """
    inside = (truth.time >= 0) & (truth.time <= recording.duration)
    inside &= truth.amplitude >= WEAKEST_RETURN * recording.recorded_noise
    echoes = truth.take(np.flatnonzero(inside))
    if len(echoes):  # the strongest of every run of echoes that a discrete receiver cannot separate
        width = FWHM_PER_SIGMA * echoes.sigma
        apart = np.diff(echoes.time) >= DISTINCT * 0.5 * (width[1:] + width[:-1])
        starts = np.concatenate([[True], apart | (np.diff(echoes.waveform) != 0)])
        order = np.lexsort((-echoes.amplitude, np.cumsum(starts) - 1))
        echoes = echoes.take(order[np.flatnonzero(starts)])
    # Waveforms ascend: the place of an echo less that of the first one of its waveform is its number.
    number = np.arange(len(echoes)) - np.searchsorted(echoes.waveform, echoes.waveform)
    echoes = echoes.take(np.flatnonzero(number < most))
    pulse, time, amplitude = echoes.waveform.astype(np.int64), echoes.time, echoes.amplitude
    if keep_empty:
        empty = np.flatnonzero(np.bincount(pulse, minlength=n) == 0)
        pulse = np.concatenate([pulse, empty])
        order = np.argsort(pulse, kind="stable")
        pulse = pulse[order]
        time = np.append(time, np.full(len(empty), recording.duration / 2))[order]
        amplitude = np.append(amplitude, np.zeros(len(empty), np.float32))[order]
    total = np.bincount(pulse, minlength=n)[pulse]
    number = 1 + np.arange(len(pulse)) - np.searchsorted(pulse, pulse)
    return Returns(pulse, time, amplitude, number, total)


def fill_packets(
    points: np.ndarray, index: np.ndarray, offset: np.ndarray, size: np.ndarray, time: np.ndarray, step: np.ndarray
) -> None:
    """Writes where the packets of points (k,) are, and how the points lie in them.

    index: of the descriptor, 0 without packet; offset, size [bytes]; time: after sample 0 [ns]; step: away from the
    sensor (k, 3) [m/ns].
    """
    has = index > 0
    points["wavepacket_index"] = index
    points["wavepacket_offset"] = np.where(has, offset, 0)
    points["wavepacket_size"] = np.where(has, size, 0)
    points["return_point_wave_location"] = np.where(has, time * PS_PER_NS, 0)
    for axis, name in enumerate(("x_t", "y_t", "z_t")):
        points[name] = np.where(has, -step[:, axis] / PS_PER_NS, 0)


END_MARGIN = 6.0
"""Time before the first and after the last return of a pulse, in standard deviations of the pulse."""

FULL_SHARE = 0.8
"""Share of the digitizer's range that the 99.9 % quantile of the strengths fills where no gain is given."""

_FORMATS = {0: 4, 1: 4, 2: 5, 3: 5, 4: 4, 5: 5, 6: 9, 7: 10, 8: 10, 9: 9, 10: 10}
_PACKET_FIELDS = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location")
_LENGTHS = tuple(64 << number for number in range(8))
"""Lengths of the waveforms [samples], a digitizer for each. Pulses that need more keep their points without packet."""
PIECE = 50_000
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
    average. Compare it with `energy` less `energy_without_packet`."""
    level: float = 0.0
    """Mean of the samples without an echo [DN]: above the baseline where noise below 0 is cut off, and not on it where
    rounding without noise cannot hold a fraction."""
    energy_of_level: float = 0.0
    """What this adds to `energy_recorded`, if no echo covers it [DN ns]."""
    light: LightCounts = field(default_factory=LightCounts)
    """Whose widths and shares were known."""

    @property
    def light_used(self) -> float:
        """Mean share of the beam that the returns of a pulse take together; NaN without shares."""
        return self.light.shares / self.light.pulses if self.light.pulses else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return {**asdict(self), "light_used": self.light_used}


def synthesize_strip(
    cloud: Path,
    target: Path,
    options: SynthesisOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] = lambda points: None,
    piece: int = PIECE,
) -> SynthesisSummary:
    """Writes the points of `cloud` with modelled waveforms to `target` (.las or .laz); returns the counts.

    A pulse is a run of points of equal GPS time. Its waveform is a Gaussian per return, at the return's distance from
    the first one. The ray runs from the first to the last return; lone returns take the direction that the pulses
    around them have at their scan angle. All points keep their coordinates and fields (extra bytes are left out); point
    formats 0 to 3 become 4 and 5, 6 to 8 become 9 and 10. piece: points in memory at a time.
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
        point_format = _FORMATS[reader.point_format]
        with FullwaveWriter(
            Path(target), version="1.3" if point_format < 6 else "1.4", point_format=point_format,
            internal=options.internal, scales=reader.scales, offsets=reader.offsets, overwrite=overwrite,
            digitizers=[Digitizer(i, options.bits, length, options.spacing) for i, length in enumerate(_LENGTHS, 1)],
            records=repair_records(vlr for vlr in read_header(reader.path).vlrs if is_projection(vlr)),
        ) as writer:  # fmt: skip
            for number, (rows, records) in enumerate(_read_pulses(reader, piece)):
                rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(number,)))
                # Echoes of the returns, with sample 0 a margin and a random part of a sample before the first of each
                # pulse.
                starts = group_pulses(rows["gps_time"], rows["number"])
                count = np.diff(np.append(starts, len(rows)))
                pulse = np.repeat(np.arange(len(starts)), count)
                ray = fit_rays(rows["xyz"], starts, rows["scan_angle"], rows["source"])
                strength, sigma = light.measure(rows, records, starts)
                delay = np.einsum("ij,ij->i", rows["xyz"] - rows["xyz"][starts][pulse], ray[pulse]) / HALF_C
                margin = END_MARGIN * np.maximum.reduceat(sigma, starts)
                phase = options.spacing * rng.random(len(starts))
                time = delay + (margin + phase - np.minimum.reduceat(delay, starts))[pulse]
                n_samples = np.ceil((np.maximum.reduceat(time, starts) + margin) / options.spacing) + 1
                # Index in _LENGTHS of the waveform of each pulse; len(_LENGTHS) where none is long enough.
                kind, amplitude = np.searchsorted(_LENGTHS, n_samples), gain * strength
                offset, energy = _write_packets(writer, recordings, kind, (pulse, time, amplitude, sigma), rng)
                summary.energy_recorded += energy
                summary.energy_of_level += rise * float(np.append(_LENGTHS, 0)[kind].sum())
                # Fields of the input, and where their packets are.
                points = np.zeros(len(records), writer.dtype)
                for name in set(field_names(writer.dtype)) & set(field_names(records.dtype)) - set(_PACKET_FIELDS):
                    points[name] = records[name]
                index = np.where(kind < len(_LENGTHS), kind + 1, 0)[pulse]
                size = np.append(_LENGTHS, 0)[kind[pulse]] * (options.bits // 8)
                fill_packets(points, index, offset[pulse], size, time, ray[pulse] * HALF_C)
                writer.write_points(points)
                too_long, modelled = kind == len(_LENGTHS), SQRT_2PI * amplitude * sigma
                summary.energy += float(modelled.sum())
                summary.energy_without_packet += float(modelled[too_long[pulse]].sum())
                summary.points += len(points)
                summary.packets += int(np.count_nonzero(~too_long))
                summary.without_packet += int(np.count_nonzero(too_long[pulse]))
                most = recordings[0].clip - recordings[0].baseline
                summary.saturated += int(np.count_nonzero(amplitude > most))
                summary.scattered += int(np.count_nonzero(rows["total"][starts] != count))
                progress(len(rows))
            light.check_widths()
            writer.commit()
    return summary


def _read_pulses(reader: CloudReader, size: int = PIECE) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and raw records in pieces that cut no pulse."""
    rows: np.ndarray | None = None
    records: np.ndarray | None = None
    for piece in reader.read_pieces(size):
        rows = piece if rows is None else np.concatenate([rows, piece])
        records = reader.records if records is None else np.concatenate([records, reader.records])
        starts = group_pulses(rows["gps_time"], rows["number"])
        if len(starts) > 1:
            yield rows[: starts[-1]], records[: starts[-1]]
            rows, records = rows[starts[-1] :], records[starts[-1] :]
    if rows is not None and records is not None and len(rows):
        yield rows, records


def _choose_gain(reader: CloudReader, light: LightModel) -> float:
    """The gain that fills the digitizer; reads all points."""
    counts, options = np.zeros(len(_LEVELS) + 1, np.int64), light.options
    for rows, records in _read_pulses(reader):
        strength = light.measure(rows, records, group_pulses(rows["gps_time"], rows["number"]))[0]
        counts += np.bincount(np.searchsorted(_LEVELS, strength[strength > 0]), minlength=len(counts))
    total = int(counts.sum())
    if reader.point_count and not total:
        rest = " or share 0" if options.shares else ""
        raise InputError(f"{reader.path}: all returns have intensity 0{rest}, so there is nothing to model")
    light.check_widths()
    level = int(np.searchsorted(np.cumsum(counts), 0.999 * total))
    room = FULL_SHARE * ((1 << options.bits) - 1 - options.baseline)
    return float(room / _LEVELS[min(level, len(_LEVELS) - 1)])


def _write_packets(
    writer: FullwaveWriter, recordings: list[Recording], kind: np.ndarray, echoes: tuple[np.ndarray, ...],
    rng: np.random.Generator,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Byte offset of every pulse's packet, u8 (n,), 0 where it has none; and the energy of the samples [DN ns].

    kind: which of the recordings each pulse (n,) has, if any. echoes: pulse, time after sample 0 [ns], amplitude [DN]
    and standard deviation [ns] of each echo (k,).
    """
    energy = 0.0
    offset = np.zeros(len(kind), np.uint64)
    for number, recording in enumerate(recordings):
        same = np.flatnonzero(kind == number)
        step = max(_PAINTED // recording.n_samples, 1)
        for begin in range(0, len(same), step):
            chosen = same[begin : begin + step]
            place = np.full(len(offset), -1)
            place[chosen] = np.arange(len(chosen))
            waveform = place[echoes[0]]
            inside = waveform >= 0
            columns = (values[inside] for values in (waveform, *echoes[1:]))
            signal = paint_echoes(recording, len(chosen), *columns)
            counts = record_counts(recording, signal, rng)
            energy += recording.spacing * (float(counts.sum(dtype=np.float64)) - recording.baseline * counts.size)
            offset[chosen] = writer.write_packets(counts, number + 1)
    return offset, energy
