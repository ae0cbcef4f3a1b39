"""What a chain works on, as frozen dataclasses of arrays: waveforms with their returns, their noise, the system pulse.

Readers and the simulator make blocks, the survey makes the SystemPulse, stages read both. Arrays may be views of files:
never write into them. The meaning, dtype and unit of a field stand below it, and only there.

The parts of a SystemPulse beside the pulse come first: noise and defects of the receiver and the widths of level
ground, which the survey measures, and the light, which `surveying.calibration` and options of a run give. Fields with a
Key stand in system files (`surveying/systems/survey_result.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, field, replace
from typing import Annotated, Any

import numpy as np

from wavebatch.core.errors import StageError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Key, Range
from wavebatch.core.units import AIR_ATTENUATION, HALF_C, QUANTISATION_STD


@frozen
class ReceiverNoise:
    """What a receiver records without signal."""

    baseline: Annotated[float, Range(-1e10, 1e10), Key("baseline_dn", "level without signal", needed=True)] = 0.0
    """Typical level without signal [DN]."""
    baseline_spread: Annotated[
        float, Range(0.0, 1e10), Key("baseline_spread_dn", "its standard deviation between waveforms", needed=True)
    ] = 0.0
    """Standard deviation of the true baseline between waveforms [DN]."""
    recovery: Annotated[float, Range(0.0, 1e9), Key("recovery_ns", "after strong signal, until the level is back")] = (
        0.0
    )
    """Time after a strong signal until the level is back to what it was before it [ns]."""
    std: Annotated[
        float, Range(1e-3, 1e10), Key("noise_std_dn", "noise of one sample, for thresholds and errors", needed=True)
    ] = QUANTISATION_STD
    """Noise of one sample that thresholds and errors use [DN]."""
    by_kind: Annotated[Mapping[str, Annotated[float, Range(0.0, 1e30)]], Key("noise_by_kind_dn", needed=True)] = field(
        default_factory=dict
    )
    """The estimates that `std` was chosen from: quiet, outside of echoes, core ... [DN]."""
    correlation: Annotated[
        tuple[Annotated[float, Range(-1.0, 1.0)], ...],
        Key("correlation", "of the noise of two samples 1, 2, ... spacings apart; empty: white noise", blank=True),
    ] = ()
    """Correlation of the noise of two samples 1, 2, ... spacings apart; empty where it is white."""
    gain: Annotated[
        float, Range(0.0, 1e6), Key("noise_gain", "growth of the noise's variance per count of signal", needed=True)
    ] = 0.0
    """Signal-dependent noise variance per count of signal [DN] (docs/algorithms.md H12)."""
    whitening: Annotated[
        tuple[Annotated[float, Range(-2.0, 2.0)], ...],
        Key(
            "whitening", "what predicts the noise of a sample from the two before it; empty: fits take noise for white"
        ),
    ] = ()
    """What predicts the noise of a sample from the two before it; empty where fits take noise for white."""

    @property
    def quiet(self) -> float:
        """Noise of a quiet sample [DN]: `std` is larger where noise is coloured."""
        return min(self.std, self.by_kind.get("quiet") or self.std)


@frozen
class Defects:
    """What waveforms have before any signal, and what is taken off them before they are read."""

    pattern: Annotated[
        tuple[Annotated[float, Range(-1e6, 1e6)], ...],
        Key("pattern_dn", "offsets that repeat along the samples, taken off; empty: none", blank=True),
    ] = ()
    """Offsets that repeat along the samples, of converters that take samples in turn [DN]; empty for none."""
    slope_spread: Annotated[
        float, Range(0.0, 1e9), Key("slope_spread_dn_ns", "of baselines within a waveform, taken off")
    ] = 0.0
    """Standard deviation of the slopes of baselines [DN/ns]; 0 where baselines are level."""
    spikes: Annotated[float, Range(0.0, 1e6), Key("spikes", "of one sample, per waveform, taken off")] = 0.0
    """Spikes of one sample per waveform; 0 where they are not taken off."""
    transient: Annotated[float, Range(0.0, 1e9), Key("transient_ns", "at the start of waveforms, left out")] = 0.0
    """Time at the start of every waveform in which its receiver is not at rest [ns]."""

    def __bool__(self) -> bool:
        """Whether waveforms must be cleaned before they are read."""
        return bool(self.pattern or self.slope_spread or self.spikes or self.transient)


@frozen
class LevelWidths:
    """How wide the echoes of level ground are, seen from above."""

    variance: Annotated[
        float, Range(-1e8, 0.0), Key("level_variance_ns2", "of level ground's echoes less the pulse's")
    ] = 0.0
    """Their variance minus that of the system pulse [ns2]: zero or negative, because the echoes that the pulse was
    learned from come from slopes too.
    """
    error: Annotated[float | None, Range(0.0, 1e8), Key("level_error_ns2", "standard deviation of level_variance")] = (
        None
    )
    """Standard deviation of `variance` [ns2]; None where it was not measured, infinite where surfaces of known slope
    were sought and not found: widths give no angle then.
    """
    scatter: Annotated[
        float, Range(0.0, 1e4), Key("width_scatter_ns", "of echo widths beyond the errors of their fits")
    ] = 0.0
    """Scatter of the echo widths of one surface beyond their fit errors [ns]: no pulse model is exact."""
    rough: Annotated[
        float | None, Range(0.0, 1e8), Key("level_roughness_ns2", "variance that 84 % of rough ground adds at most")
    ] = None
    """Variance that rough ground adds as slopes do, at most on 84 % of the surfaces [ns2]; None where none is seen."""


@frozen
class Radiometry:
    """What turns amplitudes and times into light: beam, calibration, air, and the errors of each."""

    divergence: Annotated[
        float | None,
        Range(1e-3, 100.0),
        Key("divergence_mrad", "full angle of the beam, 1/e^2, from its data sheet"),
    ] = None
    """Full angle of the beam between the 1/e^2 points [mrad]; None where it is not known."""
    divergence_error: Annotated[
        float, Range(0.0, 1.0), Key("divergence_error", "standard deviation of the divergence, relative")
    ] = 0.0
    """Relative standard deviation of the divergence."""
    constant: float | None = None
    """Constant C' of kernels/physics/radiometry [1/(m2 count ns)]; None where the strip is not calibrated."""
    constant_error: float = 0.0
    """Relative standard deviation of the constant."""
    shot_error: float = 0.0
    """Relative standard deviation of the emitted energy from shot to shot, where the block does not hold it."""
    channels: Mapping[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    """Constant and its relative error of single channels, by (index of the digitizer, scanner channel)."""
    swath: tuple[float, ...] = ()
    """How the constant grows with the angle t of the ray across the flight: largest angle T [rad], a, b and c of
    exp(a u^2 + b u^4 + c u), u = t / T from -1 to 1; empty where it does not.
    """
    right: tuple[float, float] = (0.0, 0.0)
    """Unit vector to the right of the strip's flight."""
    attenuation: float = AIR_ATTENUATION
    """Attenuation of the light in the air, one way [dB/km]."""
    attenuation_error: float = 0.0
    """Standard deviation of the attenuation [dB/km]."""
    sensor_error: float = 0.0
    """Standard deviation of the distance to the sensor's position [m]."""
    returns: float = 0.0
    """Standard deviation of the vendor's returns along the ray [m], which echoes are placed by."""
    phase: float = 0.0
    """Root mean square difference of return locations and echoes [m]: the error of echoes without a return."""


def angle_to_vertical(direction: np.ndarray) -> np.ndarray:
    """Angle of rays to the vertical, at which they strike level ground; direction: f8 (n, 3), angle: f8 (n,) [rad]."""
    x, y, z = direction.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        down = -z / np.sqrt(x * x + y * y + z * z)
    return np.arccos(np.clip(down, -1.0, 1.0))


def angle_across(direction: np.ndarray, right: np.ndarray | tuple[float, float]) -> np.ndarray:
    """Angle of rays f8 (n, 3) across the flight, from the vertical to its right, f8 (n,) [rad]; right: unit vector
    (2,), or one for each ray (n, 2)."""
    return np.arctan2((direction[:, :2] * right).sum(axis=1), -direction[:, 2])


def swath_columns(angle: np.ndarray, most: float) -> np.ndarray:
    """u^2, u^4 and u of angles (n,) [rad], f8 (n, 3), u = angle / most from -1 to 1: see `Radiometry.swath`."""
    share = np.clip(angle / most, -1.0, 1.0)
    return np.stack([share**2, share**4, share], axis=1)


@frozen
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


@frozen(eq=False)
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


@frozen(eq=False)
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

    def __repr__(self) -> str:
        """One line: how many waveforms of how many samples."""
        n, s = self.samples.shape
        return f"<WaveformBlock: {n} waveforms of {s} samples of {self.spacing:g} ns, digitizer {self.digitizer.index}>"

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
            The samples are not unsigned integers, not two-dimensional, or masked; spacing or bits cannot be.
        """
        if isinstance(getattr(samples, "mask", None), np.ndarray | np.bool_):  # a table of pandas has a method `mask`
            raise StageError("samples are a masked array, and its mask would be ignored; give a plain array")
        samples = np.ascontiguousarray(samples)
        if samples.ndim != 2 or not samples.shape[1] or samples.dtype.kind != "u" or samples.dtype.itemsize > 4:
            kind = f"{samples.dtype} {samples.shape}"
            raise StageError(f"samples must be unsigned integers (n, s) of up to 32 bits, got {kind}; shift "
                             "and round them, e.g. np.rint(samples).astype(np.uint16)")  # fmt: skip
        if not (isinstance(spacing, int | float | np.number) and 0 < spacing < np.inf):
            raise StageError(f"spacing must be above 0 ns, got {spacing!r}")
        if not (bits is None or isinstance(bits, int | np.integer) and 1 <= bits <= 32):
            raise StageError(f"bits must be a whole number from 1 to 32, got {bits!r}")
        n, s = samples.shape
        samples = samples.astype(samples.dtype.newbyteorder("="), copy=False).view()
        samples.flags.writeable = False
        return cls(
            digitizer=Digitizer(1, bits or 8 * samples.dtype.itemsize, s, float(spacing)),
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
        arrays: dict[str, Any] = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
        arrays["samples"].flags.writeable = False
        returns, tables = None, [block.returns for block in blocks if block.returns is not None]
        if len(tables) == len(blocks):
            starts = np.cumsum([0, *(len(block) for block in blocks[:-1])])
            waveform = [table.waveform + start for table, start in zip(tables, starts, strict=True)]
            others = [np.concatenate([getattr(table, name) for table in tables]) for name in ("time", "point", "xyz")]
            returns = ReturnTable(np.concatenate(waveform).astype(np.int32), *others)
        return replace(blocks[0], **arrays, returns=returns, sensor=None, scanner=None)

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
        parts: dict[str, Any] = {name: values if values is None else values[index] for name, values in given.items()}
        first = int(self.point[index[0]]) if len(index) else self.first
        return replace(self, samples=samples, first=first, returns=returns, **parts)

    @property
    def gaps(self) -> np.ndarray:
        """Samples that were not recorded, bool (n, samples): `missing`, or none."""
        return np.zeros(self.samples.shape, bool) if self.missing is None else self.missing


@frozen(eq=False)
class Noise:
    """Level without signal, and its spread, for each of n waveforms."""

    baseline: np.ndarray
    """Level without signal, float32 (n,), count."""
    std: np.ndarray
    """Standard deviation of one recorded sample, float32 (n,), count; never below QUANTISATION_STD."""
    of_sample: np.ndarray | None = None
    """Level at each sample, float32 (n, s), count, where recordings of one packet differ in level; else None."""
    baseline_err: np.ndarray | None = None
    """Standard deviation of the baseline's error, float32 (n,), count; None where levels do not differ."""

    def __len__(self) -> int:
        """Number of waveforms."""
        return len(self.baseline)

    @property
    def level(self) -> np.ndarray:
        """Level without signal, float32 (n, 1), or (n, s) where it differs between the recordings of a packet."""
        return self.baseline[:, None] if self.of_sample is None else self.of_sample

    def rows(self, rows: np.ndarray) -> Noise:
        """The noise of the waveforms at `rows`."""
        further = (None if one is None else one[rows] for one in (self.of_sample, self.baseline_err))
        return Noise(self.baseline[rows], self.std[rows], *further)


_Lag = Annotated[float, Range(-1e5, 1e5)]
"""Time after the peak of an echo [ns]."""
_Times = Annotated[float, Range(0.0, 10.0)]
"""How many times another value."""
_Gaussian = tuple[Annotated[float, Range(-10.0, 10.0)], Annotated[float, Range(-1e4, 1e4)],
                  Annotated[float, Range(1e-3, 1e4)]]  # fmt: skip
"""Weight, delay and sigma."""


@frozen
class SystemPulse:
    """What the survey found out about sensor and scene of a strip: the same for every block of one digitizer.

    A field with a Key stands in system files, in this order: `systems/survey_result.py` writes and reads them.
    """

    sigma_ref: Annotated[
        float, Range(1e-3, 1e4), Key("sigma_ref_ns", "Gaussian standard deviation of the echo of a flat target")
    ]
    """Gaussian standard deviation of the echo of a flat target [ns]."""
    _: KW_ONLY
    noise: Annotated[ReceiverNoise, Key()] = ReceiverNoise()
    kappa: Annotated[float, Range(-0.9, 0.9), Key("kappa", "skew of the pulse; 0 is a Gaussian", needed=True)] = 0.0
    """Skew of the system pulse; 0 for a Gaussian."""
    skew: Annotated[
        float | None, Range(-0.9, 0.9), Key("skew", "of the best skewed pulse, whichever pulse was chosen")
    ] = None
    """Skew of the best skewed pulse, whichever pulse the survey chose; None where it was not measured."""
    skew_spread: Annotated[float, Range(0.0, 10.0), Key("skew_spread", "of the skews of single echoes about it")] = 0.0
    """Standard deviation of the skews of single echoes about it: ground and plants differ; 0 where not measured."""
    defects: Annotated[Defects, Key()] = Defects()
    ringing: Annotated[
        float, Range(0.0, 1.0), Key("ringing", "largest after-pulse, as a share of the amplitude", needed=True)
    ] = 0.0
    """Largest after-pulse as a share of the amplitude."""
    saturation: Annotated[
        float | None, Range(1.0, 1e10), Key("saturation_dn", "count at which the digitizer clips")
    ] = None
    """Count from which samples are clipped, as the survey saw; None if only the digitizer's largest count is."""
    acceptance: Annotated[
        float, Range(1.0, 1e6), Key("acceptance", "least fall of chi2 for which an echo is added", needed=True)
    ] = 15.0
    """Smallest fall of chi2 for which an echo is added."""
    significance: Annotated[
        float, Range(0.0, 1e3), Key("significance", "least energy of an echo, where that is more than the chain's")
    ] = 0.0
    """Least energy of an echo [standard deviations of the noise's], where that is more than the chain asks for: a
    survey raises it where noise makes more echoes than expected.
    """
    misfit: Annotated[float, Range(0.0, 1.0), Key("misfit", "of strong echoes to the pulse, as a share of them")] = 0.0
    """How far strong echoes deviate from the pulse, as a share of their amplitude. A fall of chi2 that this explains
    does not add an echo.
    """
    widths: Annotated[LevelWidths, Key()] = LevelWidths()
    radiometry: Annotated[Radiometry, Key()] = Radiometry()
    components: Annotated[
        tuple[_Gaussian, ...],
        Key("components", "(weight, delay [ns], sigma [ns]) of each Gaussian of a learned pulse, the main one first",
            needed=True, blank=True, form="[weight, delay, sigma]"),
    ] = ()  # fmt: skip
    """Learned pulse: (weight, delay [ns], sigma [ns]) per component; empty when no pulse was learned."""
    tail_misfit: Annotated[
        tuple[tuple[_Lag, _Times], ...],
        Key("tail_misfit", "(lag [ns], share of the amplitude) that the pulse leaves before and after strong echoes",
            blank=True, form="[lag, share]"),
    ] = ()  # fmt: skip
    """(lag after the peak [ns], share of the amplitude): what the pulse leaves unexplained around strong echoes."""
    faint_share: Annotated[
        float, Range(0.0, 1.0), Key("faint_share", "of a stronger echo that one beside it must exceed")
    ] = 0.02
    """Share of a stronger echo that one beside it must exceed where the pulse was learned: no more is known of it."""
    beside: Annotated[
        tuple[tuple[_Lag, Annotated[float, Range(0.0, 1e4)]], ...],
        Key("beside", "(lag [ns], variance over that of the noise) of what fits leave beside strong echoes",
            form="[lag, variance]"),
    ] = ()  # fmt: skip
    """(lag after a strong echo [ns], variance of what a pulse sees there beyond noise, over that of the noise)."""
    seams: Annotated[
        Mapping[Annotated[int, Range(3, 1e9)], Annotated[int, Range(1, 1e9)]],
        Key("seams", "(samples of a packet, sample of it that was interpolated between two recordings)",
            form="[samples, sample]"),
    ] = field(default_factory=dict)  # fmt: skip
    """Sample between two recordings of a packet that was interpolated, by the number of samples of such packets."""
    hidden: Annotated[
        tuple[tuple[Annotated[float, Range(0.0, 1e4)], _Times, _Times], ...],
        Key("hidden",
            "(excess variance of a width, that of times over it for lone and other echoes) by unseen neighbours",
            blank=True, form="[excess, lone, others]"),
    ] = ()  # fmt: skip
    """What neighbours that were not found do to times: variance of an echo over that of the pulse, less 1; and the
    variance of its time over that excess, of lone echoes and of others (docs/algorithms.md 2.2). Empty for none.
    """
    hidden_light: Annotated[
        tuple[tuple[Annotated[float, Range(0.0, 1e4)], _Times, _Times], ...],
        Key("hidden_light",
            "(excess variance of a width, share of light over its root of lone and other echoes) by unseen neighbours",
            form="[excess, lone, others]"),
    ] = ()  # fmt: skip
    """What they add to light: excess variance; share of light over the excess's root that 68 % stay within."""
    hidden_width: Annotated[
        tuple[tuple[Annotated[float, Range(0.0, 1e4)], _Times, _Times], ...],
        Key("hidden_width",
            "(excess variance of a width, share of width over its root of lone and other echoes) by unseen neighbours",
            form="[excess, lone, others]"),
    ] = ()  # fmt: skip
    """What they add to widths, in the same way."""
    other_pulse: bool = False
    """Whether the echoes of a block were fitted with another pulse than the survey's; set while a chain runs."""
    digitizers: Mapping[int, SystemPulse] = field(default_factory=dict)
    """Pulse and noise of digitizers that record differently from the commonest one of the strip, by their index."""

    def __post_init__(self) -> None:
        """Checks the one value that everything divides by, and the types of its parts: a wrong one would fail late."""
        if not self.sigma_ref > 0:
            raise ValueError(f"sigma_ref must be positive, got {self.sigma_ref}")
        for name in ("noise", "defects", "widths", "radiometry"):
            value, kind = getattr(self, name), type(self.__dataclass_fields__[name].default)
            if not isinstance(value, kind):
                raise TypeError(f"{name} of SystemPulse must be a {kind.__module__}.{kind.__name__}, got {value!r}")

    def __repr__(self) -> str:
        """One line: kind and width of the pulse, and the noise."""
        skew = f" of skew {self.kappa:g}" if self.kappa else ""
        kind = f"{len(self.components)} Gaussians" if self.components else f"a Gaussian{skew}"
        return f"<SystemPulse: {kind}, s_ref {self.sigma_ref:.4f} ns, noise {self.noise.std:.3f} DN>"

    @property
    def pulse(self) -> tuple[Any, ...]:
        """Its pulse alone: systems have one pulse where these are equal."""
        return self.components, self.kappa, self.sigma_ref

    def of(self, block: WaveformBlock) -> SystemPulse:
        """The system of the block's digitizer: its pulse and noise, and the radiometry of the whole strip."""
        other = self.digitizers.get(block.digitizer.index)
        return self if other is None else replace(other, radiometry=self.radiometry)

    def with_radiometry(self, **values: Any) -> SystemPulse:
        """The system with other values of its radiometry, by field."""
        return replace(self, radiometry=replace(self.radiometry, **values))

    def calibrate(self, block: WaveformBlock) -> tuple[np.ndarray, np.ndarray]:
        """Calibration of each waveform's channel.

        Returns
        -------
        constant : float64 (n,), 1/(m2 count ns)
            NaN where the channel is not calibrated.
        error : float64 (n,)
            Relative standard deviation.
        """
        n, given = len(block), self.radiometry
        constant = np.full(n, np.nan if given.constant is None else given.constant)
        error = np.full(n, given.constant_error)
        for (digitizer, scanner), (value, value_err) in given.channels.items():
            if digitizer == block.digitizer.index:
                same = np.full(n, scanner == 0) if block.scanner is None else block.scanner == scanner
                constant[same], error[same] = value, value_err
        if given.swath:
            angle = angle_across(block.direction, given.right)
            columns = swath_columns(angle, given.swath[0])
            constant *= np.exp(columns @ given.swath[1:])
            # Beyond the edge of the swath that showed it, the term stays or goes on: the error is the difference.
            share = np.clip(angle / given.swath[0], -3.0, 3.0)
            further = np.stack([share**2, share**4, share], axis=1) - columns
            error = np.hypot(error, np.expm1(np.abs(further @ given.swath[1:])))
        return constant, error
