"""Rays of the pulses, shapes of the simulated echo, and echoes to raw counts: lobes, noise, clipping, rounding.

`trace_rays` has the flight, the scan and the terrain (a key of TERRAINS): the ray of each pulse from its number alone,
without random numbers. `scenes` and `returns` call `paint_echoes`, then `record_counts`. This is the slow part of a
simulation: lobes of equal length are painted together, noise is drawn in cache-sized parts.
"""

from __future__ import annotations

from dataclasses import field, replace
from functools import cache
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Range, check_options, option
from wavebatch.core.units import AIR_SPEED, FWHM_PER_SIGMA, QUANTISATION_STD
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.strip.packets import MAX_SAMPLES
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian
from wavebatch.kernels.signal.runs import lobe_edges

EAST, NORTH, GROUND = 500_000.0, 5_400_000.0, 120.0
"""South-west corner and height of the simulated land [m], UTM zone 32 north."""

START_TIME = 300_000_000.0
"""Adjusted standard GPS time of the first pulse [s]."""


@frozen
class FlightLine:
    """How the aircraft flies and scans."""

    height: float = 800.0
    """Height above the lowest ground [m]."""
    speed: float = 60.0
    """[m/s], towards the east."""
    pulse_rate: float = 100_000.0
    """Pulses per second."""
    line_rate: float = 50.0
    """Scan lines per second, all swept from north to south."""
    half_angle: float = 25.0
    """Largest angle off nadir across the flight [deg]."""
    look_ahead: float = 4.0
    """Angle off nadir along the flight [deg]."""


@frozen(eq=False)
class SceneRays:
    """Pulses in space: sensor, point on the ground, direction away from the sensor."""

    gps_time: np.ndarray
    """f8 (n,) [s]."""
    ground: np.ndarray
    """Where the ray meets the ground, f8 (n, 3) [m]."""
    direction: np.ndarray
    """f8 (n, 3) [m/ns], away from the sensor; length AIR_SPEED."""
    distance: np.ndarray
    """Sensor to ground [m], f8 (n,)."""
    incidence: np.ndarray
    """Angle between ray and the ground's normal [rad], f8 (n,)."""
    scan_angle: np.ndarray
    """Degrees off nadir, positive to the left of the flight (north), f8 (n,)."""


def trace_rays(flight: FlightLine, terrain: str, pulse: np.ndarray) -> SceneRays:
    """Rays of the pulses with the given numbers (n,) over the terrain."""
    seconds = pulse / flight.pulse_rate
    phase = (seconds * flight.line_rate) % 1.0
    sensor_x = EAST + flight.speed * seconds
    sensor_y = NORTH + 2.0 * np.sin(0.21 * seconds)
    sensor_z = GROUND + flight.height + 3.0 * np.sin(0.13 * seconds)
    angle = np.radians(flight.half_angle) * (1.0 - 2.0 * phase)
    x = sensor_x + flight.height * np.tan(np.radians(flight.look_ahead))
    y = sensor_y + flight.height * np.tan(angle)
    height, slope_x, slope_y = TERRAINS[terrain](x, y)
    z = GROUND + height
    dx, dy, dz = x - sensor_x, y - sensor_y, z - sensor_z
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    unit = np.stack([dx / distance, dy / distance, dz / distance], axis=1)
    facing = (slope_x * unit[:, 0] + slope_y * unit[:, 1] - unit[:, 2]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    return SceneRays(
        gps_time=START_TIME + seconds,
        ground=np.stack([x, y, z], axis=1),
        direction=unit * AIR_SPEED,
        distance=distance,
        incidence=np.arccos(np.clip(facing, 0.0872, 1.0)),
        scan_angle=np.degrees(np.arctan2(dy, -dz)),
    )


def _blocks(x: np.ndarray, y: np.ndarray):
    """Houses 8 to 20 m high, 25 m wide, every 60 m, on level ground."""
    i, j = np.floor(x / 60.0), np.floor(y / 60.0)
    roof = (x - 60.0 * i < 25.0) & (y - 60.0 * j < 25.0)
    zero = np.zeros_like(x)
    return np.where(roof, 8.0 + (7.0 * i + 11.0 * j) % 13.0, 0.0), zero, zero


def _hills(x: np.ndarray, y: np.ndarray):
    """Rolling ground: slopes up to 9 degrees."""
    a, b = (x - EAST) / 150.0, (y - NORTH) / 110.0
    return 12.0 * (np.sin(a) + np.cos(b)), 0.08 * np.cos(a), -12.0 / 110.0 * np.sin(b)


def _facets(x: np.ndarray, y: np.ndarray):
    """A zigzag roof along the scan: planes 40 m wide that rise and fall by 0, 10, 20, 30 and 40 degrees."""
    i = np.floor((y - NORTH) / 80.0)
    steep = np.tan(np.radians(10.0 * (i % 5)))
    across = (y - NORTH) - 80.0 * i
    rising = across < 40.0
    return steep * np.where(rising, across, 80.0 - across), np.zeros_like(x), np.where(rising, steep, -steep)


def _beach(x: np.ndarray, y: np.ndarray):
    """A beach that rises by 3 % to the north, with ripples."""
    ripple = (x - EAST) / 1.5
    return 0.03 * (y - NORTH) + 15.0 + 0.03 * np.sin(ripple), 0.02 * np.cos(ripple), np.full_like(x, 0.03)


def _village(x: np.ndarray, y: np.ndarray):
    """Houses 12 m wide every 24 m, eaves 4 m high, gable roofs of 0, 10, 20 ... 60 degrees, ridges along or across."""
    i, j = np.floor((x - EAST) / 24.0), np.floor((y - NORTH) / 24.0)
    along, across = (x - EAST) - 24.0 * i - 6.0, (y - NORTH) - 24.0 * j - 12.0
    roof = (np.abs(along) < 6.0) & (np.abs(across) < 6.0)
    steep = np.where(roof, np.tan(np.radians(10.0 * ((i + 3.0 * j) % 7))), 0.0)
    turned = (i + j) % 2 == 1
    from_ridge = np.where(turned, along, across)
    slope = -steep * np.sign(from_ridge)
    height = np.where(roof, 4.0 + steep * (6.0 - np.abs(from_ridge)), 0.0)
    return height, np.where(turned, slope, 0.0), np.where(turned, 0.0, slope)


TERRAINS = {
    "flat": lambda x, y: 3 * (np.zeros_like(x),),
    "blocks": _blocks, "hills": _hills, "facets": _facets, "beach": _beach, "village": _village,
}  # fmt: skip
"""Ground by name: coordinates [m] to height above GROUND [m] and the two slopes."""


@frozen
class PulseModel:
    """The system pulse: a main lobe, Gaussian or skewed, and further lobes.

    The time of an echo is the datum of the pulse: the centre of the Gaussian that fits the echo of a flat target best.
    A target that broadens the main lobe from `sigma` to s adds the variance s^2 - sigma^2 to every lobe, and lobes lose
    height as they widen. A skewed main lobe is stretched instead, and placed as such a target would place it.
    The amplitude of an echo is the height of the peak of all lobes together.
    """

    sigma: float = 2.0
    """Standard deviation of the main lobe for a flat target [ns]."""
    kappa: float = 0.0
    """Skew of the main lobe (docs/algorithms.md 0); its height is the amplitude."""
    lobes: tuple[tuple[float, float, float], ...] = ()
    """(height relative to the main lobe, delay [ns], sigma [ns]) of every further lobe."""


LEAST_SIGMA = 0.001
"""Shortest pulse [ns]: no detector shows 1 ps, and times in units of far shorter ones overflow."""

PULSES: dict[str, PulseModel] = {
    "gaussian": PulseModel(),
    "skewed": PulseModel(kappa=0.1),
    "riegl": PulseModel(1.85, 0.0, ((0.16, 2.4, 2.2), (0.04, 10.5, 2.2), (0.016, 20.0, 4.0), (0.008, 40.0, 8.0))),
    "leica": PulseModel(3.0, 0.0, ((0.22, 7.2, 4.0), (0.03, 15.0, 5.0))),
}
"""Named pulses: riegl has the after-pulse of +4 % at 10.5 ns and the tail of the Q680i, leica the skew of the ALS."""


def find_pulse(name: str) -> PulseModel:
    """The pulse called `name`; ConfigError when there is none."""
    if name not in PULSES:
        raise ConfigError(f"pulse {name!r} is unknown; {nearest(name, PULSES)}")
    return PULSES[name]


def shape_pulse(
    old: PulseModel,
    *,
    pulse: str | None = None,
    sigma: float | None = None,
    kappa: float | None = None,
    ringing: float = 0.0,
) -> PulseModel:
    """The system pulse `old` with the given values replaced.

    pulse: name of a shape in PULSES; those of real sensors replace sigma too. sigma [ns], kappa: width and skew of the
    main lobe. ringing: share of the amplitude in lobes 4 (below the level) and 8 sigma after the peak.
    Raises ConfigError for an unknown name or a value out of range.
    """
    shape = old if pulse is None else find_pulse(pulse)
    width = sigma or (shape.sigma if shape.lobes else old.sigma)
    skew = shape.kappa if kappa is None else kappa
    if not (LEAST_SIGMA <= width < 1000 and abs(skew) <= 0.5 and abs(ringing) <= 0.5):
        limits = f"above 0 ({LEAST_SIGMA} to 1000)"
        raise ConfigError(f"pulse: sigma {width} ns must be {limits}, kappa {skew} and ringing {ringing} within +-0.5")
    ring = ((-ringing, 4 * width, width), (ringing, 8 * width, width)) if ringing else ()
    return replace(shape, sigma=width, kappa=skew, lobes=shape.lobes + ring)


def spread_lobes(
    pulse: PulseModel, time: np.ndarray, amplitude: np.ndarray, sigma: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Lobes of echoes, the main lobe first: (time [ns], height [DN], sigma [ns]) of each, (m,).

    time, amplitude, sigma: (m,) as in the truth table. Heights are scaled so that all lobes together peak at
    `amplitude`.
    """
    # The datum lies after the main lobe's peak: of a flat target's echo, and later where a skewed lobe is stretched.
    delay: np.ndarray | float = _find_flat(pulse) if pulse.lobes or pulse.kappa else 0.0
    if pulse.kappa:
        ratio = np.maximum(sigma / pulse.sigma, 0.7)
        delay = delay + _find_flat(replace(pulse, lobes=())) * (ratio + ratio**-2 - 2)
    start = time - delay
    if not pulse.lobes:
        return [(start, amplitude, sigma)]
    grid = np.linspace(sigma.min(initial=pulse.sigma), sigma.max(initial=pulse.sigma), 129)
    main = amplitude / np.interp(sigma, grid, _paint(pulse, grid)[1].max(axis=0))
    parts = [(start, main, sigma)]
    for share, later, width, scale in _widen(pulse, sigma):
        parts.append((start + later, main * share * scale, width))
    return parts


def _widen(pulse: PulseModel, sigma: np.ndarray):
    """(share, delay, width, relative height) of every further lobe when a target broadens the main lobe to sigma."""
    extra = sigma**2 - pulse.sigma**2
    for share, delay, flat in pulse.lobes:
        width = np.sqrt(np.maximum(flat**2 + extra, 0.01 * flat**2))
        yield share, delay, width, flat / width * sigma / pulse.sigma


@cache
def _find_flat(pulse: PulseModel) -> float:
    """Datum after the main lobe's peak of a flat target's echo [ns]."""
    x, total = _paint(pulse, np.array([pulse.sigma]))
    return fit_one_gaussian(x, total[:, 0])[0]


def _paint(pulse: PulseModel, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times after the main lobe's peak [ns], (r,), and the pulse there per unit of its main lobe, (r, m)."""
    x = np.arange(-1200, 1201) * (pulse.sigma / 200)
    total = main_lobe(x[:, None] / sigma, pulse.kappa)
    for share, delay, width, scale in _widen(pulse, sigma):
        total = total + share * scale * np.exp(-0.5 * ((x[:, None] - delay) / width) ** 2)
    return x, total


def full_sigma(pulse: PulseModel, sigma: np.ndarray) -> np.ndarray:
    """Full width at half maximum over 2.354820 of true echoes of all lobes [ns], (m,); sigma: of the main lobe."""
    if not pulse.lobes:
        skew = abs(pulse.kappa)
        wider = 2 * np.sinh(skew * FWHM_PER_SIGMA / 2) / (skew * FWHM_PER_SIGMA) if skew > 1e-6 else 1.0
        return sigma * wider
    if not len(sigma):
        return sigma
    grid = np.linspace(sigma.min(), max(sigma.max(), 1.001 * sigma.min()), 49)
    step = grid[0] / 100
    x = np.arange(-int(4 * grid[-1] / step), int(6 * grid[-1] / step))[:, None] * step
    ones = np.ones(len(grid))
    total = np.zeros((len(x), len(grid)))
    for number, (start, height, width) in enumerate(spread_lobes(pulse, 0 * ones, ones, grid)):
        total += height * main_lobe((x - start) / width, pulse.kappa if number == 0 else 0.0)
    edges = np.array([lobe_edges(x[:, 0], curve, 0.5 * curve.max()) for curve in total.T])
    return np.interp(sigma, grid, np.diff(edges, axis=1)[:, 0] / FWHM_PER_SIGMA)


def main_lobe(z: np.ndarray, kappa: float) -> np.ndarray:
    """Height of the unit pulse at z = (time - peak)/sigma: exp(-L^2/2) with L = log1p(kappa z)/kappa.

    Source: docs/algorithms.md 0.
    """
    if abs(kappa) < 1e-6:
        return np.exp(-0.5 * z * z)
    inside = kappa * z
    gone = inside <= -1 + 1e-6
    level = np.log1p(np.where(gone, 0, inside)) / kappa
    return np.where(gone, 0, np.exp(-0.5 * level * level)).astype(z.dtype)


LOBE_REACH = 5.5
"""Lobes are painted this many sigma to both sides: beyond it they are below 3e-7 of their height."""

MOST_NOISE = 1e10
"""More noise than any digitizer shows, as in the files of surveys: beyond it float32 overflows."""

_ROWS = 2048
"""Waveforms that get noise at a time: few enough for the cache."""


@frozen
class Recording:
    """How the simulated receiver records: window, levels, noise and system pulse."""

    n_samples: Annotated[int, Range(8, MAX_SAMPLES)] = option(
        80, "Samples per waveform.", form="N", name="samples", unset="the scene's, 80 or 96"
    )
    spacing: Annotated[float, Range(0.001, 4000.0)] = option(
        1.0, "Time between samples [ns].", form="NS", unset="1"
    )  # descriptors hold it in 32 bits of picoseconds
    bits: Literal[8, 16, 32] = option(8, "Bits per sample.", unset="8")
    baseline: float = option(12.0, "Level without signal [DN].", form="DN", unset="12")
    baseline_spread: float = 0.4
    """Standard deviation of the level between waveforms [DN]."""
    noise_std: Annotated[float, Range(0.0, MOST_NOISE)] = option(
        1.0, "Standard deviation of the noise before rounding [DN].", form="DN", name="noise",
        unset="the scene's, 1 or 1.2",
    )  # fmt: skip
    rho: float = option(
        0.0, "Correlation of the noise of neighbouring samples: 0, .5, .667, .75 or .8.", form="RHO", unset="0"
    )  # m/(m+1), m = 1, 2, ...: binomial filters
    noise_gain: Annotated[float, Range(0.0, 1e6)] = option(
        0.0, "Noise variance that the signal adds [DN2 per DN].", form="DN", unset="0"
    )
    saturation: int | None = option(
        None, "Count at which the receiver saturates [DN].", form="DN", unset="the largest that the bits can hold"
    )
    pulse: PulseModel = field(default_factory=PulseModel)

    def __post_init__(self) -> None:
        check_options(self)
        check = {
            f"the pulse's sigma, {self.pulse.sigma:g} ns, must be no longer than the "
            f"waveform, {self.n_samples} samples {self.spacing:g} ns apart": self.pulse.sigma
            <= self.n_samples * self.spacing,
            "rho must be 0 or m/(m+1): .5, .667, .75, .8 ...": 0 <= self.rho < 0.95
            and abs(self.rho - self.color / (self.color + 1)) < 0.006,
            "baseline must lie from 0 to below the largest count": 0 <= self.baseline < self.clip,
            "saturation must be a count that the bits can hold": 0 < self.clip < 1 << self.bits,
        }
        for message, good in check.items():
            if not good:
                raise ConfigError(f"simulated recording: {message}")

    @property
    def color(self) -> int:
        """Order m of the binomial filter that gives the noise its correlation."""
        return round(self.rho / (1 - self.rho))

    @property
    def clip(self) -> int:
        """Largest count that is ever recorded."""
        return (1 << self.bits) - 1 if self.saturation is None else self.saturation

    @property
    def recorded_noise(self) -> float:
        """Standard deviation of one recorded sample without signal [DN]: noise and rounding."""
        return float(np.hypot(self.noise_std, QUANTISATION_STD))

    @property
    def empty_level(self) -> float:
        """Mean of the recorded samples without signal [DN]: clipping and rounding may move it off the baseline."""
        spread = float(np.hypot(self.noise_std, self.baseline_spread))
        place = np.linspace(-8.0, 8.0, 16_000)  # an even number: a baseline on a whole count has no ties
        counts = np.clip(np.floor(self.baseline + 0.5 + spread * place), 0, self.clip)
        return float(np.average(counts, weights=np.exp(-0.5 * place**2)))

    @property
    def duration(self) -> float:
        """Time of the last sample [ns]."""
        return (self.n_samples - 1) * self.spacing

    @property
    def digitizer(self) -> Digitizer:
        """The wave packet descriptor of the waveforms."""
        return Digitizer(1, self.bits, self.n_samples, self.spacing)


def paint_echoes(
    recording: Recording, n: int, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """Signal without baseline and noise, float32 (n, s) [DN].

    waveform (m,) must be sorted; time [ns], amplitude [DN] and sigma [ns] per echo, (m,).
    """
    first = np.searchsorted(waveform, np.arange(n))
    rank = np.arange(len(waveform)) - first[waveform]
    jobs = []
    for number, (start, height, width) in enumerate(spread_lobes(recording.pulse, time, amplitude, sigma)):
        kappa = recording.pulse.kappa if number == 0 else 0.0
        long_side = (np.expm1(LOBE_REACH * abs(kappa)) / abs(kappa) if abs(kappa) > 1e-6 else LOBE_REACH) * width
        left = np.ceil((long_side if kappa < 0 else LOBE_REACH * width) / recording.spacing).astype(np.int64)
        right = np.ceil((long_side if kappa > 0 else LOBE_REACH * width) / recording.spacing).astype(np.int64)
        length = -(-(left + right + 1) // 8) * 8
        jobs.append((start, height, width, left, length, kappa))
    pad = max((int(job[4].max(initial=8)) for job in jobs), default=8)
    stride = recording.n_samples + pad
    canvas = np.zeros(n * stride + pad, np.float32)
    # Echoes of equal rank lie in different waveforms, so that a gather, an add and a scatter lose nothing. Neighbouring
    # waveforms share only the padding between them, which is not read.
    for start, height, width, left, length, kappa in jobs:
        position = start / recording.spacing
        sample = np.floor(position).astype(np.int64) - left
        inside = (sample > -pad) & (sample < recording.n_samples)
        key = rank * 4096 + length
        for value in np.unique(key[inside]):
            rows = np.flatnonzero(inside & (key == value))
            w = int(length[rows[0]])
            windows = np.lib.stride_tricks.as_strided(canvas, (len(canvas) - w + 1, w), (4, 4))
            offset = (sample[rows] - position[rows]).astype(np.float32)
            z = np.arange(w, dtype=np.float32) + offset[:, None]
            z *= (recording.spacing / width[rows]).astype(np.float32)[:, None]
            if kappa:
                z = main_lobe(z, kappa)
            else:
                z *= z
                z *= np.float32(-0.5)
                np.exp(z, out=z)
            z *= height[rows].astype(np.float32)[:, None]
            at = pad + waveform[rows].astype(np.int64) * stride + sample[rows]
            z += windows[at]
            windows[at] = z
    return canvas[pad:].reshape(n, stride)[:, : recording.n_samples]


def record_counts(
    recording: Recording, signal: np.ndarray, rng: np.random.Generator, constant: np.ndarray | None = None
) -> np.ndarray:
    """Raw counts, unsigned (n, s): baseline plus signal [DN] plus noise, clipped and rounded.

    constant: level of the waveforms whose samples are all equal, NaN for the others, (n,).
    """
    n, s = signal.shape
    dtype = {8: np.uint8, 16: np.uint16, 32: np.uint32}[recording.bits]
    counts = np.empty((n, s), dtype)
    # Adding half a count makes the cast round to nearest, which is faster than np.rint.
    level = recording.baseline_spread * np.asarray(rng.standard_normal(n))
    level = (recording.baseline + 0.5 + level).astype(np.float32)
    top = recording.clip + 0.5
    for a in range(0, n, _ROWS):
        part = signal[a : a + _ROWS]
        values = rng.standard_normal((len(part), s + recording.color), dtype=np.float32)
        for _ in range(recording.color):
            values = values[:, 1:] + values[:, :-1]
        if recording.color:
            taps = np.array([1.0])
            for _ in range(recording.color):
                taps = np.convolve(taps, [1.0, 1.0])
            values /= np.float32(np.sqrt((taps**2).sum()))
        if recording.noise_gain:
            variance = np.float32(recording.noise_std**2) + np.float32(recording.noise_gain) * np.maximum(part, 0)
            values *= np.sqrt(variance)
        else:
            values *= np.float32(recording.noise_std)
        values += part
        values += level[a : a + _ROWS, None]
        if recording.bits == 32:
            values = values.astype(np.float64)
        np.clip(values, 0, top, out=values)
        counts[a : a + _ROWS] = values
    if constant is not None:
        rows = np.flatnonzero(~np.isnan(constant))
        counts[rows] = np.clip(constant[rows], 0, recording.clip).astype(dtype)[:, None]
    return counts
