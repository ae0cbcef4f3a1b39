"""The types that flow through a chain: frozen dataclasses of arrays, and the one table of columns and flags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntFlag

import numpy as np

from wavebatch.errors import StageError
from wavebatch.units import QUANTISATION_STD


class EchoFlag(IntFlag):
    """What is known to be wrong or special about an echo; the bits of the `echo_flags` column."""

    NOT_CONVERGED = 1
    AT_BOUND = 2
    NEAR_EDGE = 4
    SATURATED = 8
    OVERLAPPED = 16
    WEAK = 32
    RINGING_SUSPECT = 64
    NARROW = 128
    NO_WAVEFORM = 256
    BROKEN_PACKET = 512
    NO_ECHO = 1024
    UNANCHORED = 2048
    MERGED = 4096
    ADDED = 8192
    AMPLITUDE_UNRELIABLE = 16384
    RETURN_LIMIT = 32768


FLAG_MEANINGS: dict[EchoFlag, str] = {
    EchoFlag.NOT_CONVERGED: "the fit stopped before it converged; values are the last accepted ones",
    EchoFlag.AT_BOUND: "a fitted parameter lies at the edge of its allowed range",
    EchoFlag.NEAR_EDGE: "the echo is cut by the start or the end of the waveform",
    EchoFlag.SATURATED: "samples under the echo are at the digitizer's limit",
    EchoFlag.OVERLAPPED: "fitted together with at least one neighbouring echo",
    EchoFlag.WEAK: "amplitude below 5 noise standard deviations",
    EchoFlag.RINGING_SUSPECT: "may be ringing or an after-pulse of a stronger echo before it",
    EchoFlag.NARROW: "narrower than the system pulse",
    EchoFlag.NO_WAVEFORM: "point has no waveform (descriptor index 0 or packet size 0); passed through",
    EchoFlag.BROKEN_PACKET: "packet lies outside the file or does not fit its descriptor; point passed through",
    EchoFlag.NO_ECHO: "waveform holds no echo for this point; point passed through",
    EchoFlag.UNANCHORED: "no return of the packet matches an echo; position from the raw return location",
    EchoFlag.MERGED: "two echoes too close to be told apart were merged into this one",
    EchoFlag.ADDED: "echo that the input does not have as a return",
    EchoFlag.AMPLITUDE_UNRELIABLE: "so much of the echo is saturated that its amplitude is a guess",
    EchoFlag.RETURN_LIMIT: "return number exceeds what the point format can hold; written as the largest",
}


@dataclass(frozen=True, slots=True)
class Column:
    """Declaration of one per-echo quantity: it feeds the README table, the LAS extra bytes and the report."""

    name: str
    dtype: str
    unit: str
    meaning: str
    no_data: float | None = -9999.0
    extra_bytes: bool = True
    """False for quantities that are LAS fields of their own (x, y, z) or never leave the program."""


def _columns(*columns: Column) -> dict[str, Column]:
    return {column.name: column for column in columns}


COLUMNS: dict[str, Column] = _columns(
    Column("amplitude", "f4", "DN", "peak of the echo above the baseline"),
    Column("echo_time", "f4", "ns", "centre of the echo after the first sample of its packet"),
    Column("echo_width", "f4", "ns", "full width at half maximum"),
    Column("energy", "f4", "DN ns", "integral of the echo over time"),
    Column("range", "f4", "m", "sensor to echo"),
    Column("cross_section", "f4", "m2", "backscatter cross section"),
    Column("backscatter_coefficient", "f4", "-", "cross section per illuminated area (gamma)"),
    Column("reflectance", "f4", "-", "diffuse reflectance"),
    Column("relative_backscatter", "f4", "DN ns m2", "not calibrated: backscatter in units of its own strip"),
    Column("relative_cross_section", "f4", "DN ns m4", "not calibrated: cross section in units of its own strip"),
    Column("relative_reflectance", "f4", "DN ns m2", "not calibrated: reflectance in units of its own strip"),
    Column("incidence_angle", "f4", "deg", "angle between ray and surface normal"),
    Column("incidence_angle_normals", "f4", "deg", "angle between ray and normal of the plane of the points around"),
    Column("range_err", "f4", "m", "one standard deviation of the echo along the ray, from the fit"),
    Column("amplitude_err", "f4", "DN", "one standard deviation of amplitude, from the fit"),
    Column("echo_width_err", "f4", "ns", "one standard deviation of echo_width, from the fit"),
    Column("incidence_angle_err", "f4", "deg", "one standard deviation of incidence_angle"),
    Column("incidence_angle_normals_err", "f4", "deg", "one standard deviation of incidence_angle_normals"),
    Column("cross_section_err", "f4", "m2", "one standard deviation of cross_section"),
    Column("backscatter_coefficient_err", "f4", "-", "one standard deviation of gamma"),
    Column("reflectance_err", "f4", "-", "one standard deviation of reflectance"),
    Column("relative_backscatter_err", "f4", "DN ns m2", "one standard deviation of relative_backscatter"),
    Column("relative_cross_section_err", "f4", "DN ns m4", "one standard deviation of relative_cross_section"),
    Column("relative_reflectance_err", "f4", "DN ns m2", "one standard deviation of relative_reflectance"),
    Column("pulse_deviation", "f4", "-", "Gauss-Hermite deviation from the system pulse, sqrt(h3^2 + h4^2)"),
    Column("echo_flags", "u2", "bits", "see the table of flags", no_data=None),
    Column("x", "f8", "m", "easting of the echo", extra_bytes=False),
    Column("y", "f8", "m", "northing of the echo", extra_bytes=False),
    Column("z", "f8", "m", "height of the echo", extra_bytes=False),
    Column("ray_x", "f4", "-", "east component of the unit vector away from the sensor", extra_bytes=False),
    Column("ray_y", "f4", "-", "north component of the unit vector away from the sensor", extra_bytes=False),
    Column("ray_z", "f4", "-", "upward component of the unit vector away from the sensor", extra_bytes=False),
)

RAY = ("ray_x", "ray_y", "ray_z")
"""Columns of a stage with a second pass: the direction in which each echo was seen."""


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
        cls,
        samples: np.ndarray,
        *,
        spacing: float = 1.0,
        bits: int | None = None,
        first: int = 0,
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


_FIELDS: dict[str, type] = {
    "waveform": np.int32,
    "time": np.float64,
    "amplitude": np.float32,
    "sigma": np.float32,
    "time_err": np.float32,
    "amplitude_err": np.float32,
    "sigma_err": np.float32,
    "residual": np.float32,
    "flags": np.uint16,
}


@dataclass(frozen=True, slots=True, eq=False)
class EchoTable:
    """m echoes sorted by waveform, then time: found, fitted or true. Errors that nobody computed are NaN."""

    waveform: np.ndarray
    """Row of the block, i4 (m,)."""
    time: np.ndarray
    """Centre of the echo after sample 0 [ns], f8 (m,)."""
    amplitude: np.ndarray
    """Peak above the baseline [count], f4 (m,)."""
    sigma: np.ndarray
    """Gaussian standard deviation [ns], f4 (m,)."""
    time_err: np.ndarray
    amplitude_err: np.ndarray
    sigma_err: np.ndarray
    residual: np.ndarray
    """Root mean square of the fit's residuals in the echo's cluster [noise std], f4 (m,)."""
    flags: np.ndarray
    """EchoFlag bits, u2 (m,)."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Optional columns by name (see COLUMNS), each (m,)."""

    def __len__(self) -> int:
        return len(self.waveform)

    @classmethod
    def build(
        cls,
        waveform: np.ndarray,
        time: np.ndarray,
        amplitude: np.ndarray,
        sigma: np.ndarray,
        *,
        time_err: np.ndarray | None = None,
        amplitude_err: np.ndarray | None = None,
        sigma_err: np.ndarray | None = None,
        residual: np.ndarray | None = None,
        flags: np.ndarray | None = None,
        attributes: Mapping[str, np.ndarray] | None = None,
    ) -> EchoTable:
        """A table with the right dtypes, sorted by waveform, then time; what is not given is NaN, or no flag."""
        m = len(waveform)
        nan = np.full(m, np.nan, np.float32)
        given = {
            "waveform": waveform,
            "time": time,
            "amplitude": amplitude,
            "sigma": sigma,
            "time_err": nan if time_err is None else time_err,
            "amplitude_err": nan if amplitude_err is None else amplitude_err,
            "sigma_err": nan if sigma_err is None else sigma_err,
            "residual": nan if residual is None else residual,
            "flags": np.zeros(m, np.uint16) if flags is None else flags,
        }
        table = cls(
            **{name: np.ascontiguousarray(given[name], dtype=dtype) for name, dtype in _FIELDS.items()},
            attributes=dict(attributes or {}),
        )
        step = np.diff(table.waveform)
        if np.any(step < 0) or np.any((step == 0) & (np.diff(table.time) < 0)):
            table = table.take(np.lexsort((table.time, table.waveform)))
        return table

    @classmethod
    def empty(cls) -> EchoTable:
        """A table without echoes."""
        none = np.empty(0)
        return cls.build(none, none, none, none)

    def take(self, rows: np.ndarray) -> EchoTable:
        """The echoes at `rows` (indices or mask), in that order."""
        core = {name: getattr(self, name)[rows] for name in _FIELDS}
        return EchoTable(**core, attributes={name: values[rows] for name, values in self.attributes.items()})

    def with_attributes(self, **columns: np.ndarray) -> EchoTable:
        """A new table with `columns` added or replaced."""
        for name, values in columns.items():
            if len(values) != len(self):
                raise StageError(f"column {name} has {len(values)} values for {len(self)} echoes")
        return replace(self, attributes={**self.attributes, **columns})

    def with_flags(self, flag: EchoFlag, where: np.ndarray) -> EchoTable:
        """A new table in which `flag` is set too for the echoes `where` is true."""
        flags = self.flags | np.where(where, np.uint16(flag), np.uint16(0))
        return replace(self, flags=flags.astype(np.uint16))

    def count(self, n: int) -> np.ndarray:
        """Echoes per waveform of a block of n, i8 (n,)."""
        return np.bincount(self.waveform, minlength=n)

    @staticmethod
    def concatenate(tables: Iterable[tuple[EchoTable, int]]) -> EchoTable:
        """Tables one behind the other; each comes with what is added to its waveform rows."""
        tables = [(table, shift) for table, shift in tables]
        if not tables:
            return EchoTable.empty()
        names = list(tables[0][0].attributes)
        if any(set(table.attributes) != set(names) for table, _ in tables):
            raise StageError("tables with different columns cannot be joined")
        core = {name: np.concatenate([getattr(table, name) for table, _ in tables]) for name in _FIELDS}
        core["waveform"] = np.concatenate([table.waveform + np.int32(shift) for table, shift in tables])
        attributes = {name: np.concatenate([table.attributes[name] for table, _ in tables]) for name in names}
        return EchoTable(**core, attributes=attributes)
