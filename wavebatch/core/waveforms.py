"""What a chain works on, as frozen dataclasses of arrays: waveforms with their returns and noise, the system pulse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from wavebatch.core.errors import StageError
from wavebatch.core.units import QUANTISATION_STD


@dataclass(frozen=True, slots=True)
class Digitizer:
    """How samples were made: one LAS wave packet descriptor in nanoseconds and volts."""

    index: int
    bits: int
    n_samples: int
    spacing: float
    """Time between two samples [ns]."""
    gain: float = 1.0
    """Volts per count."""
    offset: float = 0.0
    """Volts at count zero."""

    @property
    def width(self) -> int:
        """Bytes of a sample that is stored in whole ones."""
        return 1 if self.bits <= 8 else 2 if self.bits <= 16 else 4

    @property
    def max_count(self) -> int:
        """Largest raw value that the bits can hold."""
        return (1 << self.bits) - 1


@dataclass(frozen=True, slots=True, eq=False)
class ReturnTable:
    """The input's returns that share the packets of a block, sorted by waveform, then point."""

    waveform: np.ndarray
    """Row of the block that holds the packet, i4 (k,)."""
    time: np.ndarray
    """Return location after sample 0 [ns], f8 (k,)."""
    point: np.ndarray
    """Index of the point in its file, i8 (k,)."""
    xyz: np.ndarray
    """Coordinates of the return [m], f8 (k, 3)."""

    def __len__(self) -> int:
        return len(self.waveform)


@dataclass(frozen=True, slots=True, eq=False)
class WaveformBlock:
    """n waveforms of one digitizer and one length, with where they lie in space."""

    digitizer: Digitizer
    samples: np.ndarray
    """Raw counts, u1/u2/u4 (n, s), read-only."""
    first: int
    """Address of the block: the point that owns its first waveform."""
    point: np.ndarray
    """Index in the file of the first point that refers to the packet, i8 (n,)."""
    gps_time: np.ndarray
    """f8 (n,) [s]."""
    origin: np.ndarray
    """Position of sample 0 from the raw return location, f8 (n, 3) [m]."""
    direction: np.ndarray
    """Away from the sensor, as long as the light's one-way path per two-way ns, f8 (n, 3) [m/ns]."""
    returns: ReturnTable | None = None
    """The input's returns in these packets; None for waveforms that never had any."""
    sensor: np.ndarray | None = None
    """Position of the sensor at each pulse, f8 (n, 3) [m]; None where nobody knows it."""
    scanner: np.ndarray | None = None
    """Scanner channel of each pulse, u1 (n,); None where points have none: all are 0."""

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def spacing(self) -> float:
        """Time between two samples [ns]."""
        return self.digitizer.spacing

    @classmethod
    def from_samples(
        cls, samples: np.ndarray, *, spacing: float = 1.0, bits: int | None = None, first: int = 0
    ) -> WaveformBlock:
        """A block without geometry from raw counts (n, s): for simulation, tests and use from Python."""
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
            direction=np.tile([0.0, 0.0, -0.149896229], (n, 1)),
        )

    def rows(self, rows: np.ndarray | slice) -> WaveformBlock:
        """The block restricted to `rows`; returns are kept with their waveforms."""
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
        return replace(
            self,
            samples=samples,
            first=int(self.point[index[0]]) if len(index) else self.first,
            point=self.point[index],
            gps_time=self.gps_time[index],
            origin=self.origin[index],
            direction=self.direction[index],
            returns=returns,
            sensor=None if self.sensor is None else self.sensor[index],
            scanner=None if self.scanner is None else self.scanner[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Level without signal, and its spread, per waveform [count]."""

    baseline: np.ndarray
    """f4 (n,)."""
    std: np.ndarray
    """f4 (n,): standard deviation of one recorded sample, never below QUANTISATION_STD."""

    def __len__(self) -> int:
        return len(self.baseline)


@dataclass(frozen=True, slots=True)
class SystemPulse:
    """What the strip's survey says of sensor and scene; the same for every block of one digitizer."""

    sigma_ref: float
    """Gaussian standard deviation of the echo of a flat target [ns]."""
    baseline: float = 0.0
    """Typical level without signal [count]."""
    baseline_spread: float = 0.0
    """Standard deviation of the true baseline between waveforms [count]."""
    noise_std: float = QUANTISATION_STD
    """Noise of one sample that thresholds and errors use [count]."""
    noise_by_kind: Mapping[str, float] = field(default_factory=dict)
    """The estimates noise_std was chosen from: quiet, smoothed, tail, core ... [count]."""
    noise_gain: float = 0.0
    """Signal-dependent variance per count of signal (H12) [count]."""
    kappa: float = 0.0
    """Skew of the system pulse (0 = Gaussian)."""
    components: tuple[tuple[float, float, float], ...] = ()
    """Learned pulse: (weight, delay [ns], sigma [ns]) per component; empty when not learned."""
    ringing: float = 0.0
    """Largest after-pulse as a share of the amplitude."""
    saturation: float | None = None
    """Count at which the survey saw samples clipped; None: only the digitizer's largest count is."""
    acceptance: float = 15.0
    """Least fall of chi2 for which an echo is added."""
    misfit: float = 0.0
    """How far strong echoes deviate from the pulse, as a share of them: falls of chi2 that this explains add none."""
    level_variance: float = 0.0
    """Of level ground's echoes seen from above, less the system pulse's [ns2]; not positive: surveys see slopes too."""
    width_scatter: float = 0.0
    """Scatter of echo widths of one and the same surface beyond what fits say [ns]: no model of a pulse is right."""
    divergence: float | None = None
    """Full angle of the beam between the 1/e^2 points [mrad]; None where nobody knows it."""
    calibration: float | None = None
    """C' of kernels/radiometry [1/(m2 count ns)]; None where the strip is not calibrated."""
    calibration_err: float = 0.0
    """Standard deviation of the calibration, relative."""
    channels: Mapping[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    """The same two of channels that have a calibration of their own, by index of the digitizer and scanner channel."""
    attenuation: float = 0.22
    """Of the light on its way through the air, one way [dB/km]."""
    sensor_error: float = 0.0
    """Standard deviation of the distance to the sensor's position [m]."""
    digitizers: Mapping[int, SystemPulse] = field(default_factory=dict)
    """Pulse and noise of digitizers that record otherwise than the strip's commonest one, by their index."""

    def __post_init__(self) -> None:
        if not self.sigma_ref > 0:
            raise ValueError(f"sigma_ref must be positive, got {self.sigma_ref}")

    def of(self, block: WaveformBlock) -> SystemPulse:
        """The system of the block's digitizer: its own pulse and noise, with what is known of the strip as a whole."""
        own = self.digitizers.get(block.digitizer.index)
        if own is None:
            return self
        whole = ("divergence", "calibration", "calibration_err", "channels", "attenuation", "sensor_error")
        return replace(own, **{name: getattr(self, name) for name in whole})

    def calibrate(self, block: WaveformBlock) -> tuple[np.ndarray, np.ndarray]:
        """Calibration of each waveform's channel, NaN where it has none, and its relative error, f8 (n,)."""
        n = len(block)
        constant = np.full(n, np.nan if self.calibration is None else self.calibration)
        error = np.full(n, self.calibration_err)
        for (digitizer, scanner), (own, own_err) in self.channels.items():
            if digitizer == block.digitizer.index:
                same = np.full(n, scanner == 0) if block.scanner is None else block.scanner == scanner
                constant[same], error[same] = own, own_err
        return constant, error
