"""What a chain works on, as frozen dataclasses of arrays: waveforms with their returns, their noise, the system pulse.

Readers and the simulator make blocks, the survey makes the SystemPulse, stages read both. Arrays may be views of files:
never write into them. The meaning, dtype and unit of a field stand below it, and only there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from wavebatch.core.errors import StageError
from wavebatch.core.units import AIR_ATTENUATION, HALF_C, QUANTISATION_STD


@dataclass(frozen=True, slots=True)
class Digitizer:
    """How samples were made: one LAS wave packet descriptor, in nanoseconds and volts."""

    index: int
    """Index of the descriptor in the file, 1 to 255."""
    bits: int
    """Bits per sample."""
    n_samples: int
    """Samples per waveform."""
    spacing: float
    """Time between two samples [ns]."""
    gain: float = 1.0
    """Volts per count [V]."""
    offset: float = 0.0
    """Volts at count zero [V]."""
    inverted: bool = False
    """Whether the counts of the file go down where the light rises; blocks hold mirrored counts, with this gain."""

    @property
    def width(self) -> int:
        """Bytes of the smallest integer that holds a sample."""
        return 1 if self.bits <= 8 else 2 if self.bits <= 16 else 4

    @property
    def max_count(self) -> int:
        """Largest raw value that the bits can hold."""
        return (1 << self.bits) - 1

    def mirrored(self) -> Digitizer:
        """The digitizer of mirrored counts, largest count - count: the same volts, with the other sign of the gain."""
        return replace(self, gain=-self.gain, offset=self.offset + self.gain * self.max_count, inverted=True)


@dataclass(frozen=True, slots=True, eq=False)
class ReturnTable:
    """The k returns of the input that refer to the packets of a block, sorted by waveform, then point."""

    waveform: np.ndarray
    """Row of the block that holds the packet, int32 (k,)."""
    time: np.ndarray
    """Return location after sample 0, float64 (k,), ns."""
    point: np.ndarray
    """Index of the point in its file, int64 (k,)."""
    xyz: np.ndarray
    """Coordinates of the return, float64 (k, 3), m."""

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.waveform)


@dataclass(frozen=True, slots=True, eq=False)
class WaveformBlock:
    """n waveforms of one digitizer with s samples each, and where they lie in space."""

    digitizer: Digitizer
    """How the samples were made."""
    samples: np.ndarray
    """Raw counts, uint8, uint16 or uint32 (n, s), read-only."""
    first: int
    """Address of the block: index in the file of the point that its first waveform belongs to."""
    point: np.ndarray
    """Index in the file of the first point that refers to the packet, int64 (n,)."""
    gps_time: np.ndarray
    """Time of the pulse, float64 (n,), s."""
    origin: np.ndarray
    """Position of sample 0 from the raw return location, float64 (n, 3), m."""
    direction: np.ndarray
    """Away from the sensor, float64 (n, 3), m/ns: its length is the one-way distance per two-way travel time."""
    returns: ReturnTable | None = None
    """Returns of the input in these packets; None for simulated waveforms without returns."""
    sensor: np.ndarray | None = None
    """Position of the sensor at each pulse, float64 (n, 3), m; None where it is not known."""
    scanner: np.ndarray | None = None
    """Scanner channel of each pulse, uint8 (n,); None where the points have no such field: all are channel 0."""
    missing: np.ndarray | None = None
    """Samples that were not recorded (fill between two recordings of a packet), bool (n, s); None where all were.
    `samples` then hold a low count of the waveform there, which is no signal.
    """
    pulse_energy: np.ndarray | None = None
    """Energy of each emitted pulse over the mean of the strip, float64 (n,), NaN where unknown; None without any."""
    pulse_energy_err: np.ndarray | None = None
    """Standard deviation of the energy, float64 (n,); None where it is not known."""

    def __len__(self) -> int:
        """Number of waveforms."""
        return len(self.samples)

    @property
    def spacing(self) -> float:
        """Time between two samples [ns]."""
        return self.digitizer.spacing

    @classmethod
    def from_samples(
        cls, samples: np.ndarray, *, spacing: float = 1.0, bits: int | None = None, first: int = 0
    ) -> WaveformBlock:
        """A block without geometry, for simulation, tests and use from Python.

        Parameters
        ----------
        samples : uint8, uint16 or uint32 (n, s), count
            Raw counts.
        spacing : float, ns
            Time between two samples.
        bits : int, optional
            Bits of the digitizer; those of the dtype if not given.
        first : int
            Address of the block.

        Returns
        -------
        WaveformBlock
            At the origin of the coordinates, looking straight down.

        Raises
        ------
        StageError
            The samples are not unsigned integers, or not two-dimensional.
        """
        samples = np.ascontiguousarray(samples)
        if samples.ndim != 2 or samples.dtype.kind != "u":
            raise StageError(f"samples must be unsigned integers (n, s), got {samples.dtype} {samples.shape}")
        n, s = samples.shape
        samples = samples.view()
        samples.flags.writeable = False
        return cls(
            digitizer=Digitizer(1, bits or 8 * samples.dtype.itemsize, s, spacing),
            samples=samples,
            first=first,
            point=np.arange(first, first + n, dtype=np.int64),
            gps_time=np.zeros(n),
            origin=np.zeros((n, 3)),
            direction=np.tile([0.0, 0.0, -HALF_C], (n, 1)),
        )

    @classmethod
    def concatenate(cls, blocks: Sequence[WaveformBlock]) -> WaveformBlock:
        """Join blocks of one digitizer and one length; the result has no sensor and no scanner channels."""
        if len(blocks) == 1:
            return blocks[0]
        names = ("samples", "point", "gps_time", "origin", "direction")
        arrays = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
        arrays["samples"].flags.writeable = False
        return replace(blocks[0], **arrays, returns=_join_returns(blocks), sensor=None, scanner=None)

    def rows(self, rows: np.ndarray | slice) -> WaveformBlock:
        """The block restricted to the waveforms at `rows` (indices, mask or slice), with the returns of these."""
        index = np.arange(len(self))[rows]
        returns = self.returns
        if returns is not None:
            place = np.full(len(self), -1, np.int32)
            place[index] = np.arange(len(index), dtype=np.int32)
            at = place[returns.waveform]
            keep = np.flatnonzero(at >= 0)
            keep = keep[np.argsort(at[keep], kind="stable")]
            returns = ReturnTable(at[keep], returns.time[keep], returns.point[keep], returns.xyz[keep])
        samples = self.samples[index]
        samples.flags.writeable = False
        names = ("point", "gps_time", "origin", "direction", "sensor", "scanner", "missing", "pulse_energy",
                 "pulse_energy_err")  # fmt: skip
        given = {name: getattr(self, name) for name in names}
        parts = {name: values if values is None else values[index] for name, values in given.items()}
        first = int(self.point[index[0]]) if len(index) else self.first
        return replace(self, samples=samples, first=first, returns=returns, **parts)

    def without_samples(self) -> WaveformBlock:
        """The block with waveforms of no samples: their place, time and sensor are left."""
        return replace(self, samples=np.empty((len(self), 0), self.samples.dtype), missing=None)


def _join_returns(blocks: Sequence[WaveformBlock]) -> ReturnTable | None:
    if any(block.returns is None for block in blocks):
        return None
    starts = np.cumsum([0, *(len(block) for block in blocks[:-1])])
    waveform = [block.returns.waveform + start for block, start in zip(blocks, starts, strict=True)]
    others = [np.concatenate([getattr(b.returns, name) for b in blocks]) for name in ("time", "point", "xyz")]
    return ReturnTable(np.concatenate(waveform).astype(np.int32), *others)


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Level without signal, and its spread, for each of n waveforms."""

    baseline: np.ndarray
    """Level without signal, float32 (n,), count."""
    std: np.ndarray
    """Standard deviation of one recorded sample, float32 (n,), count; never below QUANTISATION_STD."""
    of_sample: np.ndarray | None = None
    """Level at each sample, float32 (n, s), count, where recordings of one packet differ in level; else None."""

    def __len__(self) -> int:
        """Number of waveforms."""
        return len(self.baseline)

    @property
    def level(self) -> np.ndarray:
        """Level without signal, float32 (n, 1), or (n, s) where it differs between the recordings of a packet."""
        return self.baseline[:, None] if self.of_sample is None else self.of_sample

    @property
    def for_fits(self) -> np.ndarray:
        """The same as `kernels.fit.decompose.Samples` takes it, float32 (n,) or (n, s)."""
        return self.baseline if self.of_sample is None else self.of_sample

    def rows(self, rows: np.ndarray) -> Noise:
        """The noise of the waveforms at `rows`."""
        return Noise(self.baseline[rows], self.std[rows], None if self.of_sample is None else self.of_sample[rows])


@dataclass(frozen=True, slots=True)
class SystemPulse:
    """What the survey found out about sensor and scene of a strip: the same for every block of one digitizer."""

    sigma_ref: float
    """Gaussian standard deviation of the echo of a flat target [ns]."""
    baseline: float = 0.0
    """Typical level without signal [count]."""
    baseline_spread: float = 0.0
    """Standard deviation of the true baseline between waveforms [count]."""
    recovery: float = 0.0
    """Time after a strong signal until the level is back to what it was before it [ns]."""
    noise_std: float = QUANTISATION_STD
    """Noise of one sample that thresholds and errors use [count]."""
    noise_by_kind: Mapping[str, float] = field(default_factory=dict)
    """The estimates that noise_std was chosen from: quiet, outside of echoes, core ... [count]."""
    correlation: tuple[float, ...] = ()
    """Correlation of the noise of two samples 1, 2, ... spacings apart; empty where it is white."""
    noise_gain: float = 0.0
    """Signal-dependent noise variance per count of signal [count] (docs/algorithms.md H12)."""
    kappa: float = 0.0
    """Skew of the system pulse; 0 for a Gaussian."""
    components: tuple[tuple[float, float, float], ...] = ()
    """Learned pulse: (weight, delay [ns], sigma [ns]) per component; empty when no pulse was learned."""
    other_pulse: bool = False
    """Whether the echoes of a block were fitted with another pulse than the survey's; set while a chain runs."""
    skew: float | None = None
    """Skew of the best skewed pulse, whichever pulse the survey chose; None where it was not measured."""
    skew_spread: float = 0.0
    """Standard deviation of the skews of single echoes about it: ground and plants differ; 0 where not measured."""
    pattern: tuple[float, ...] = ()
    """Offsets that repeat along the samples, of converters that take samples in turn [count]; empty for none."""
    slope_spread: float = 0.0
    """Standard deviation of the slopes of baselines [count/ns]; 0 where baselines are level."""
    spikes: float = 0.0
    """Spikes of one sample per waveform; 0 where they are not taken off."""
    transient: float = 0.0
    """Time at the start of every waveform in which its receiver is not at rest [ns]."""
    seams: Mapping[int, int] = field(default_factory=dict)
    """Sample between two recordings of a packet that was interpolated, by the number of samples of such packets."""
    ringing: float = 0.0
    """Largest after-pulse as a share of the amplitude."""
    saturation: float | None = None
    """Count from which samples are clipped, as the survey saw; None if only the digitizer's largest count is."""
    acceptance: float = 15.0
    """Smallest fall of chi2 for which an echo is added."""
    tail_misfit: tuple[tuple[float, float], ...] = ()
    """(lag after the peak [ns], share of the amplitude): what the pulse leaves unexplained around strong echoes."""
    misfit: float = 0.0
    """How far strong echoes deviate from the pulse, as a share of their amplitude. A fall of chi2 that this explains
    does not add an echo.
    """
    level_variance: float = 0.0
    """Variance of echoes of level ground seen from above, minus that of the system pulse [ns2]: zero or negative,
    because the echoes that the pulse was learned from come from slopes too.
    """
    level_error: float | None = None
    """Standard deviation of `level_variance` [ns2]; None where it was not measured, infinite where surfaces of known
    slope were sought and not found, so that widths mean no angle.
    """
    hidden: tuple[tuple[float, float, float], ...] = ()
    """What neighbours that were not found do to times: variance of an echo over that of the pulse, less 1; and the
    variance of its time over that excess, of lone echoes and of others (docs/algorithms.md 2.2). Empty for none.
    """
    width_scatter: float = 0.0
    """Scatter of the echo widths of one surface beyond their fit errors [ns]: no pulse model is exact."""
    divergence: float | None = None
    """Full angle of the beam between the 1/e^2 points [mrad]; None where it is not known."""
    divergence_error: float = 0.0
    """Relative standard deviation of the divergence."""
    calibration: float | None = None
    """Constant C' of kernels/physics/radiometry [1/(m2 count ns)]; None where the strip is not calibrated."""
    calibration_err: float = 0.0
    """Relative standard deviation of the calibration."""
    shot_error: float = 0.0
    """Relative standard deviation of the emitted energy from shot to shot, where the block does not hold it."""
    channels: Mapping[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    """Calibration and its relative error of single channels, by (index of the digitizer, scanner channel)."""
    swath: tuple[float, ...] = ()
    """How the calibration grows with the angle t of the ray to the vertical: largest angle T [rad], a and b of
    exp(a u^2 + b u^4), u = min(t / T, 1); empty where it does not.
    """
    attenuation: float = AIR_ATTENUATION
    """Attenuation of the light in the air, one way [dB/km]."""
    attenuation_error: float = 0.0
    """Standard deviation of the attenuation [dB/km]."""
    sensor_error: float = 0.0
    """Standard deviation of the distance to the sensor's position [m]."""
    digitizers: Mapping[int, SystemPulse] = field(default_factory=dict)
    """Pulse and noise of digitizers that record differently from the commonest one of the strip, by their index."""

    def __post_init__(self) -> None:
        """Checks the one value that everything divides by."""
        if not self.sigma_ref > 0:
            raise ValueError(f"sigma_ref must be positive, got {self.sigma_ref}")

    @property
    def has_defects(self) -> bool:
        """Whether waveforms must be cleaned before they are read."""
        return bool(self.pattern or self.slope_spread or self.spikes or self.transient)

    def of(self, block: WaveformBlock) -> SystemPulse:
        """The system of the block's digitizer: its pulse and noise, and what is known of the whole strip."""
        other = self.digitizers.get(block.digitizer.index)
        if other is None:
            return self
        whole = (
            "divergence", "divergence_error", "calibration", "calibration_err", "channels", "swath",
            "shot_error", "attenuation", "attenuation_error", "sensor_error",
        )  # fmt: skip
        return replace(other, **{name: getattr(self, name) for name in whole})

    def calibrate(self, block: WaveformBlock) -> tuple[np.ndarray, np.ndarray]:
        """Calibration of each waveform's channel.

        Returns
        -------
        constant : float64 (n,), 1/(m2 count ns)
            NaN where the channel is not calibrated.
        error : float64 (n,)
            Relative standard deviation.
        """
        n = len(block)
        constant = np.full(n, np.nan if self.calibration is None else self.calibration)
        error = np.full(n, self.calibration_err)
        for (digitizer, scanner), (value, value_err) in self.channels.items():
            if digitizer == block.digitizer.index:
                same = np.full(n, scanner == 0) if block.scanner is None else block.scanner == scanner
                constant[same], error[same] = value, value_err
        if self.swath:
            constant *= np.exp(swath_columns(angle_to_vertical(block.direction), self.swath[0]) @ self.swath[1:])
        return constant, error


def angle_to_vertical(direction: np.ndarray) -> np.ndarray:
    """Angle of rays to the vertical, at which they strike level ground; direction: f8 (n, 3), angle: f8 (n,) [rad]."""
    x, y, z = direction.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        down = -z / np.sqrt(x * x + y * y + z * z)
    return np.arccos(np.clip(down, -1.0, 1.0))


def swath_columns(angle: np.ndarray, most: float) -> np.ndarray:
    """u^2 and u^4 of angles (n,) [rad], f8 (n, 2), u = min(angle / most, 1): see `SystemPulse.swath`."""
    square = np.minimum(angle / most, 1.0) ** 2
    return np.stack([square, square**2], axis=1)
