"""The scenes by name: how many echoes their waveforms hold, how strong, wide and far apart, over which terrain.

`wavebatch simulate` lists them, `simulate_block(s)` draws from them. A scene is data; tools.bench adds scenes with
another `draw`.

Amplitudes, widths and times have distributions, each a small object that is called. Their order of calls to the random
generator is part of the result: changing it changes every simulated strip.

Tests, benchmarks and examples call `simulate_block(s)`; `strip` stores the same pulses in files. All random numbers of
a pulse are drawn here, from the scene, the seed and the number of its seed block: that keeps pulse k of a seed the same
however many pulses are made and however they are cut into blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import field, fields, replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.core.units import AIR_SPEED, FWHM_PER_SIGMA, C
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.kernels.physics.radiometry import transmit
from wavebatch.stages.score import has_neighbour
from wavebatch.tools.simulate.render import (
    GROUND,
    FlightLine,
    PulseModel,
    Recording,
    SceneRays,
    paint_echoes,
    record_counts,
    trace_rays,
)

END_MARGIN = 6.0
"""Distance that echoes keep from the ends of the window, in sigma of the pulse."""


@frozen
class Canopy:
    """Scatterers at random heights: each takes a random part of the light that is left, the ground the rest."""

    height: float
    """Height of the stand [m]."""
    density: float
    """Scatterers that a pulse meets per metre."""
    cover: float
    """Share of the pulses that meet plants; the others see the ground only."""
    full: float = 200.0
    """Amplitude of the echo that takes a whole pulse [DN]."""

    @property
    def duration(self) -> float:
        """Two-way travel time through the stand [ns]."""
        return self.height / AIR_SPEED

    def draw(self, rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
        """Echoes of n waveforms, the ground's last."""
        plants = np.where(rng.random(n) < self.cover, rng.poisson(self.density * self.height, n), 0)
        count = plants + 1
        waveform = np.repeat(np.arange(n), count)
        ground = np.cumsum(count) - 1
        depth = self.duration * rng.random(len(waveform))
        depth[ground] = self.duration
        taken = rng.random(len(waveform))
        depth = depth[np.lexsort((depth, waveform))]
        passed = np.log1p(-taken)
        passed[ground] = 0.0
        before = np.cumsum(passed) - passed
        left = np.exp(before - np.repeat(before[ground - plants], count))
        taken[ground] = 1.0
        sigma = recording.pulse.sigma
        room = max(recording.duration - self.duration - 2 * END_MARGIN * sigma, 0.0)
        start = END_MARGIN * sigma + room * rng.random(n)
        return Drawn(waveform, start[waveform] + depth, self.full * taken * left, np.full(len(waveform), sigma))


CANOPIES: dict[str, tuple[str, Canopy]] = {
    "corn": ("a cornfield 2.2 m high", Canopy(2.2, 2.0, 0.9)),
    "orion-6": ("trees 6 m high, as the Orion's table of 6 m", Canopy(6.0, 0.3, 0.85)),
    "orion-20": ("trees 20 m high, as the Orion's table of 20 m", Canopy(20.0, 0.6, 0.9)),
    "orion-22": ("trees 22.5 m high, as the Orion's table of 22.5 m", Canopy(22.5, 0.3, 0.85)),
    "gemini-6": ("thin trees 6.5 m high, as the Gemini's table of 6 to 7 m (dead zone 2 m)", Canopy(6.5, 0.06, 0.9)),
    "gemini-24": ("trees 24.5 m high, as the Gemini's table of 22 to 27 m (dead zone 2 m)", Canopy(24.5, 0.16, 1.0)),
}
"""Meaning and model of every stand: `canopy.<name>` is its scene. Fitted to return-number tables with a threshold of
6 % of a whole pulse. Density and threshold can replace each other in the fit: do not read the density of real plants
from them."""


@frozen(eq=False)
class Drawn:
    """Echoes of n waveforms, sorted by waveform, and lobes that are painted but are no echo."""

    waveform: np.ndarray
    """Row of the waveform, i8 (m,)."""
    time: np.ndarray
    """Peak after sample 0 [ns], f8 (m,)."""
    amplitude: np.ndarray
    """[DN], f8 (m,)."""
    sigma: np.ndarray
    """Of the main lobe [ns], f8 (m,)."""
    ghost: np.ndarray | None = None
    """True for lobes that are no echo (ringing); None when all are echoes."""
    constant: np.ndarray | None = None
    """Level of waveforms whose samples are all equal [DN], NaN for the others, (n,); None when there is none."""


def tabulate_echoes(time: np.ndarray, amplitude, sigma, ghost: np.ndarray | None = None) -> Drawn:
    """Arrays (n, k), or values broadcast to them, as a flat list sorted by waveform, then time, without NaN times."""
    n, k = time.shape
    order = np.argsort(time, axis=1, kind="stable")
    keep = ~np.isnan(np.take_along_axis(time, order, 1)).ravel()
    columns = (time, amplitude, sigma, *([] if ghost is None else [ghost]))
    flat = (np.take_along_axis(np.broadcast_to(values, (n, k)), order, 1).ravel()[keep] for values in columns)
    return Drawn(np.repeat(np.arange(n), k)[keep], *flat)


@frozen
class LogUniform:
    """Amplitudes between low and high [DN], evenly spread over their logarithm."""

    low: float
    high: float

    def __call__(self, rng: np.random.Generator, m: int | tuple[int, ...]) -> np.ndarray:
        return np.exp(rng.uniform(np.log(self.low), np.log(self.high), m))


@frozen
class LogNormal:
    """Amplitudes around a median [DN], cut at low and high."""

    median: float
    spread: float
    low: float
    high: float

    def __call__(self, rng: np.random.Generator, m: int) -> np.ndarray:
        return np.clip(self.median * np.exp(self.spread * rng.standard_normal(m)), self.low, self.high)


@frozen
class Mixture:
    """Amplitudes from the first law with probability `share`, else from the second."""

    share: float
    first: LogUniform | LogNormal
    second: LogUniform | LogNormal

    def __call__(self, rng: np.random.Generator, m: int) -> np.ndarray:
        return np.where(rng.random(m) < self.share, self.first(rng, m), self.second(rng, m))


@frozen
class FoldedWidth:
    """sigma = sigma_ref sqrt(1 + g |N|): g = several for echoes in company, g = single for lone ones."""

    several: float
    single: float

    def __call__(self, rng: np.random.Generator, alone: np.ndarray, reference: float) -> np.ndarray:
        growth = np.where(alone, self.single, self.several)
        return reference * np.sqrt(1.0 + growth * np.abs(rng.standard_normal(len(alone))))


@frozen
class HalfBroadened:
    """Half of the echoes at sigma_ref with a relative scatter, half evenly between sigma_ref and `top` times it."""

    scatter: float
    top: float

    def __call__(self, rng: np.random.Generator, alone: np.ndarray, reference: float) -> np.ndarray:
        m = len(alone)
        near = 1.0 + self.scatter * rng.standard_normal(m)
        wide = rng.uniform(1.0, self.top, m)
        return reference * np.where(rng.random(m) < 0.5, near, wide)


@frozen
class WithinDepth:
    """Times evenly within a layer `depth` ns deep that lies anywhere in the window."""

    depth: float

    def __call__(self, rng: np.random.Generator, count: np.ndarray, recording: Recording) -> np.ndarray:
        low, high = _find_room(recording)
        depth = min(self.depth, high - low)
        start = np.repeat(rng.uniform(low, high - depth, len(count)), count)
        return start + depth * rng.random(len(start))


@frozen
class WithGaps:
    """Times whose gaps are log-uniform between low and high [ns]; series that leave the window are drawn again."""

    low: float
    high: float

    def __call__(self, rng: np.random.Generator, count: np.ndarray, recording: Recording) -> np.ndarray:
        low, high = _find_room(recording)
        most = int(count.max(initial=1)) - 1
        top = min(self.high, (high - low) / max(most, 1)) if most * self.low < high - low else self.low
        # Gaps (n, most), 0 after the last echo. After 32 draws that did not fit, gaps are at most `top`.
        used = np.arange(1, most + 1) < count[:, None]
        gaps = np.zeros((len(count), most))
        todo = np.flatnonzero(count > 1)
        for attempt in range(33):
            largest = self.high if attempt < 32 else top
            drawn = np.exp(rng.uniform(np.log(self.low), np.log(max(largest, self.low)), (len(todo), most)))
            drawn *= used[todo]
            gaps[todo] = drawn
            todo = todo[drawn.sum(axis=1) > high - low]
            if not len(todo):
                break
        ends = np.cumsum(gaps, axis=1)
        span = ends[:, -1] if most > 0 else np.zeros(len(count))
        start = low + rng.random(len(count)) * np.maximum(high - low - span, 0)
        times = np.concatenate([start[:, None], start[:, None] + ends], axis=1)
        return times[np.arange(most + 1) < np.maximum(count, 0)[:, None]]


def _find_room(recording: Recording) -> tuple[float, float]:
    """First and last time at which echoes may lie [ns]: 4 sigma_ref from the ends of the window."""
    keep = min(4.0 * recording.pulse.sigma, recording.duration / 3)
    return keep, recording.duration - keep


Draw = Callable[[np.random.Generator, int, Recording], Drawn]


def _middle(rng: np.random.Generator, n: int, recording: Recording, room: float = 10.0) -> np.ndarray:
    """Times (n, 1) at least `room` sigma_ref from both ends, or as far as the window allows."""
    keep = min(room * recording.pulse.sigma, 0.4 * recording.duration)
    return rng.uniform(keep, recording.duration - keep, (n, 1))


def draw_near(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """Two echoes of the system's width 0.5 to 2 sigma apart, amplitude 30 to 150, the second 0.2 to 1 of the first."""
    s = recording.pulse.sigma
    gap = s * rng.uniform(0.5, 2.0, (n, 1))
    start = _middle(rng, n, recording)
    first = LogUniform(30, 150)(rng, (n, 1))
    amplitude = np.hstack([first, first * rng.uniform(0.2, 1.0, (n, 1))])
    return tabulate_echoes(np.hstack([start - gap / 2, start + gap / 2]), amplitude, s)


def draw_saturated(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """One echo 1.05 to 3.3 times as high as the receiver can record; in a third of the waveforms a weak one before."""
    s = recording.pulse.sigma
    strong = (recording.clip - recording.baseline) / rng.uniform(0.3, 0.95, (n, 1))
    time = _middle(rng, n, recording)
    before = np.where(rng.random((n, 1)) < 1 / 3, time - rng.uniform(6, 9, (n, 1)) * s, np.nan)
    return tabulate_echoes(np.hstack([before, time]), np.hstack([LogUniform(15, 60)(rng, (n, 1)), strong]), s)


def draw_huge(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """One echo 5 to 500 times as high as the receiver can record: a flat top hides its amplitude."""
    strong = (recording.clip - recording.baseline) * LogUniform(5, 500)(rng, (n, 1))
    return tabulate_echoes(_middle(rng, n, recording), strong, recording.pulse.sigma)


def draw_ringing(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """One strong echo with lobes of -r at 4 and +r at 8 sigma after it, r = 1 to 5 %: one target only."""
    s = recording.pulse.sigma
    time = _middle(rng, n, recording)
    strong = rng.uniform(100, 220, (n, 1))
    share = rng.uniform(0.01, 0.05, (n, 1))
    times = np.hstack([time, time + 4 * s, time + 8 * s])
    heights = np.hstack([strong, -share * strong, share * strong])
    return tabulate_echoes(times, heights, s, ghost=np.array([False, True, True]))


def draw_edge(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """One echo cut by the start or the end of the window: centre from 0.5 sigma outside to 2 sigma inside."""
    s = recording.pulse.sigma
    inside = s * rng.uniform(-0.5, 2.0, (n, 1))
    time = np.where(rng.random((n, 1)) < 0.5, inside, recording.duration - inside)
    return tabulate_echoes(time, LogUniform(20, 200)(rng, (n, 1)), s)


def draw_tiny(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """One echo of 2 to 6 counts."""
    return tabulate_echoes(_middle(rng, n, recording), LogUniform(2, 6)(rng, (n, 1)), recording.pulse.sigma)


def draw_contrast(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """A strong echo and one of 6 to 12 counts 3.5 to 8 sigma before or after it."""
    s = recording.pulse.sigma
    time = _middle(rng, n, recording)
    gap = s * rng.uniform(3.5, 8, (n, 1)) * rng.choice([-1, 1], (n, 1))
    heights = np.hstack([rng.uniform(150, 220, (n, 1)), LogUniform(6, 12)(rng, (n, 1))])
    return tabulate_echoes(np.hstack([time, time + gap]), heights, s)


def draw_broad(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """One echo 2.5 to 4 times as wide as the system pulse: steep ground, dense crown."""
    wide = recording.pulse.sigma * rng.uniform(2.5, 4.0, (n, 1))
    return tabulate_echoes(_middle(rng, n, recording, 12), LogUniform(20, 120)(rng, (n, 1)), wide)


def draw_crowd(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """Eight echoes evenly over the window: more than most decomposers fit."""
    s = recording.pulse.sigma
    at = np.linspace(4 * s, recording.duration - 4 * s, 8) + 0.3 * s * rng.standard_normal((n, 8))
    return tabulate_echoes(at, LogUniform(15, 150)(rng, (n, 8)), s)


def draw_constant(rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
    """No echo: all samples 0, at the baseline, or at the receiver's limit."""
    levels = np.array([0.0, round(recording.baseline), recording.clip])[rng.integers(0, 3, n)]
    none = np.empty(0)
    return Drawn(np.empty(0, np.int64), none, none, none, constant=levels)


HAZARDS: dict[str, Draw] = {
    draw.__name__.removeprefix("draw_"): draw
    for draw in (
        *(draw_near, draw_saturated, draw_huge, draw_ringing, draw_edge),
        *(draw_tiny, draw_contrast, draw_broad, draw_crowd, draw_constant),
    )
}
"""Every hazard by name; scene `stiff` mixes them evenly, scene `stiff.<name>` holds one of them."""


GROUND_REFLECTS, ROOFS_REFLECT = 0.2, 0.4
"""Diffuse reflectances in scenes with light."""

LEAST_ROOF = 1.0
"""Height above the ground from which a surface is a roof [m]."""

AIR_ATTENUATION = 0.22
"""Attenuation by the air in scenes with light, one way [dB/km]."""


@frozen
class Scene:
    """A kind of land: how many echoes its waveforms hold, how strong, wide and far apart they are."""

    name: str
    meaning: str
    counts: tuple[float, ...] = (0.0, 1.0)
    """Probabilities of 0, 1, 2 ... echoes."""
    amplitude: LogUniform | LogNormal | Mixture = LogNormal(25.0, 0.8, 5.0, 230.0)
    width: FoldedWidth | HalfBroadened = FoldedWidth(0.35, 0.105)
    times: WithinDepth | WithGaps = WithinDepth(24.0)
    """With 24 ns, the decomposer of docs/algorithms.md 4.3 gets the share of exact counts stated there (.96, .61)."""
    terrain: str = "flat"
    """A key of TERRAINS."""
    divergence: float = 0.0
    """Full angle of the beam between the 1/e^2 points [mrad]; above 0, slopes widen the echoes."""
    light: float = 0.0
    """amplitude sigma range^2 of a white surface that faces the sensor, without attenuation by the air [DN ns m2].
    Above 0, amplitudes are those of Lambertian surfaces with GROUND_REFLECTS and ROOFS_REFLECT."""
    flight: FlightLine | None = None
    """None: the default Flight."""
    hazards: tuple[str, ...] = ()
    """Names of hazards that replace all of the above."""
    canopy: Canopy | None = None
    """A stand of plants that replaces counts, amplitude, width and times."""
    recording: Recording = field(default_factory=Recording)
    """The receiver."""

    def draw(self, rng: np.random.Generator, n: int, rays: SceneRays) -> Drawn:
        """Echoes of n waveforms along n rays."""
        if self.hazards:
            # Each waveform has one of them, evenly at random.
            kind = rng.integers(0, len(self.hazards), n)
            parts = []
            constant = np.full(n, np.nan)
            for number, name in enumerate(self.hazards):
                rows = np.flatnonzero(kind == number)
                part = HAZARDS[name](rng, len(rows), self.recording)
                if part.constant is not None:
                    constant[rows] = part.constant
                ghost = np.zeros(len(part.time), bool) if part.ghost is None else part.ghost
                parts.append((rows[part.waveform], part.time, part.amplitude, part.sigma, ghost))
            waveform, time, amplitude, sigma, ghost = (np.concatenate(columns) for columns in zip(*parts, strict=True))
            rows = np.lexsort((time, waveform))
            return Drawn(waveform[rows], time[rows], amplitude[rows], sigma[rows], ghost[rows], constant)
        if self.canopy:
            return self.canopy.draw(rng, n, self.recording)
        edges = np.cumsum(self.counts)
        count = np.searchsorted(edges[:-1] / edges[-1], rng.random(n), side="right")
        waveform = np.repeat(np.arange(n), count)
        time = self.times(rng, count, self.recording)
        amplitude = self.amplitude(rng, len(waveform))
        sigma = self.width(rng, np.repeat(count == 1, count), self.recording.pulse.sigma)
        if self.light:
            # Of surfaces that face their ray, as bright as roofs or as ground.
            reflectance = np.where(rays.ground[:, 2] > GROUND + LEAST_ROOF, ROOFS_REFLECT, GROUND_REFLECTS)
            energy = self.light * reflectance * transmit(rays.distance, AIR_ATTENUATION) / rays.distance**2
            amplitude = energy[waveform] / self.recording.pulse.sigma
        if self.divergence:
            # A tilted plane: s_alpha = w tan(alpha)/c, with w the 1/e^2 radius of the footprint (docs/algorithms.md
            # 1.4). The energy falls with cos(alpha) and is spread over the longer echo.
            radius, incidence = (0.5e-3 * self.divergence * rays.distance)[waveform], rays.incidence[waveform]
            wide = np.hypot(sigma, radius * np.tan(incidence) / C)
            sigma, amplitude = wide, amplitude * np.cos(incidence) * sigma / wide
        order = np.lexsort((time, waveform)) if len(self.counts) > 2 else slice(None)
        return Drawn(waveform, time[order], amplitude[order], sigma[order])


_SCENES = (
    Scene(
        "flat",
        "bare, level ground: one echo of the system's width in every waveform",
        amplitude=LogNormal(60.0, 0.5, 10.0, 220.0),
        width=FoldedWidth(0.0, 0.02),
    ),
    Scene(
        "urban",
        "streets, roofs, few trees: 0, 1, 2, 3 echoes at 5, 85, 8, 2 % (`open/urban` of docs/algorithms.md 4.3)",
        counts=(0.05, 0.85, 0.08, 0.02),
        terrain="blocks",
    ),
    Scene(
        "forest",
        "canopy over ground: 0 to 5 echoes at 2, 25, 35, 25, 10, 3 % (docs/algorithms.md 4.3)",
        counts=(0.02, 0.25, 0.35, 0.25, 0.10, 0.03),
        terrain="hills",
    ),
    Scene(
        "slope",
        "bare slopes of 0 to 40 degrees: one echo, widened and weakened by the angle of incidence",
        amplitude=LogNormal(80.0, 0.3, 20.0, 220.0),
        width=FoldedWidth(0.0, 0.0),
        terrain="facets",
        divergence=1.0,
    ),
    Scene(
        "village",
        "gable roofs of 0 to 60 degrees on level ground under a green laser: pulse of 1.5 ns, sampled every 0.5 ns, "
        "beam of 1.1 mrad, 640 m, so that widths depend on the angle; the ground reflects 20 %, roofs 40 %, "
        "the air takes 0.22 dB/km, the calibration constant is 4 / 1.4e8",
        width=FoldedWidth(0.0, 0.0),
        terrain="village",
        divergence=1.1,
        light=1.4e8,
        flight=FlightLine(height=640.0, half_angle=10.0, look_ahead=0.0),
        recording=Recording(n_samples=128, spacing=0.5, pulse=PulseModel(sigma=1.5 / FWHM_PER_SIGMA)),
    ),
    Scene(
        "shore",
        "water-free shore: wet sand that returns 4 to 25 counts next to dry sand, empty waveforms over pools, "
        "few reeds",
        counts=(0.25, 0.67, 0.07, 0.01),
        amplitude=Mixture(0.5, LogUniform(4.0, 25.0), LogNormal(90.0, 0.4, 30.0, 230.0)),
        width=FoldedWidth(0.2, 0.03),
        times=WithinDepth(15.0),
        terrain="beach",
    ),
    Scene(
        "empty",
        "water or sky: 80 % of the waveforms hold nothing, the others one echo, seldom more",
        counts=(0.80, 0.185, 0.012, 0.003),
    ),
    Scene(
        "mixed",
        "the strip of the release test: 1 to 4 echoes at 60, 24, 12, 4 %, amplitude 8 to 220 log-uniform, "
        "half of them broadened up to 4 ns, gaps log-uniform 2.5 to 40 ns, noise 1.2",
        counts=(0.0, 0.60, 0.24, 0.12, 0.04),
        amplitude=LogUniform(8.0, 220.0),
        width=HalfBroadened(0.02, 4.0 / 1.9),
        times=WithGaps(2.5, 40.0),
        terrain="hills",
        recording=Recording(noise_std=1.2, pulse=PulseModel(sigma=1.9)),
    ),
    Scene(
        "stiff",
        "every hazard in equal shares: " + ", ".join(HAZARDS) + "; `stiff.near` and so on hold one of them",
        hazards=tuple(HAZARDS),
        recording=Recording(n_samples=96),
    ),
)

SCENES: dict[str, Scene] = {scene.name: scene for scene in _SCENES}
"""Every scene by name."""

OTHER_NAMES = {"open": "urban"}
"""Other names of scenes, which tables of the benchmark use."""


def find_scene(name: str | Scene) -> Scene:
    """The scene of that name, also `stiff.<hazard>` and `canopy.<stand>`; a Scene is returned as it is.

    Raises ConfigError, with the nearest name, for an unknown name.
    """
    if isinstance(name, Scene):
        return name
    if name in SCENES:
        return SCENES[name]
    if name in OTHER_NAMES:
        return replace(SCENES[OTHER_NAMES[name]], name=name)
    head, _, hazard = name.partition(".")
    if head == "stiff" and hazard in HAZARDS:
        doc = (HAZARDS[hazard].__doc__ or "").strip()
        return replace(SCENES["stiff"], name=name, meaning=doc, hazards=(hazard,))
    if head == "canopy" and hazard in CANOPIES:
        meaning, canopy = CANOPIES[hazard]
        window = Recording(n_samples=8 * -(-int(canopy.duration + 48.0) // 8))
        return Scene(name, meaning, canopy=canopy, recording=window)
    parts = [*(f"stiff.{known}" for known in HAZARDS), *(f"canopy.{known}" for known in CANOPIES)]
    names = [*SCENES, *OTHER_NAMES, *parts]
    raise ConfigError(f"scene {name!r} is unknown; {nearest(name, names)}")


SEED_BLOCK = 8192
"""Pulses that share one random generator, at most. Another value makes other strips of the same seed."""

SEED_SAMPLES = SEED_BLOCK * 2048
"""Most samples of these pulses: waveforms of more than 2048 samples have smaller blocks, so that memory suffices."""

NEIGHBOUR = 4.0
"""Echoes closer than this many sigma (of the wider one) count as overlapped (docs/algorithms.md 2.2)."""

EDGE_REACH = 2.0
"""Echoes closer than this many sigma to an end of the window count as near the edge (docs/algorithms.md H8)."""

WEAK = 5.0
"""Echoes below this many standard deviations of the noise count as weak, as EchoFlag.WEAK states."""


@frozen(eq=False)
class Simulated:
    """Waveforms, the echoes in them, and the rays along which they came."""

    block: WaveformBlock
    truth: EchoTable
    rays: SceneRays

    def cut(self, start: int, stop: int) -> Simulated:
        """Pulses [start, stop)."""
        if start == 0 and stop == len(self.block):
            return self
        a, b = np.searchsorted(self.truth.waveform, [start, stop])
        truth = self.truth.take(np.arange(a, b))
        rays = {one.name: getattr(self.rays, one.name)[start:stop] for one in fields(SceneRays)}
        truth = replace(truth, waveform=truth.waveform - np.int32(start))
        return Simulated(self.block.rows(slice(start, stop)), truth, SceneRays(**rays))


def simulate_block(
    scene: Scene | str, n: int, rng: np.random.Generator, *, recording: Recording | None = None
) -> tuple[WaveformBlock, EchoTable]:
    """A block of n waveforms of the scene and the truth: an EchoTable of the echoes in it.

    scene: a Scene or the name of one. recording: replaces the scene's receiver.
    In the truth, time is the datum of the pulse [ns after sample 0], amplitude the height of the peak above the
    baseline [DN] and sigma the standard deviation of the main lobe [ns]; the flags are those of `flag_truth`. The
    block's origin is the true position of sample 0. Raises ConfigError for an unknown scene.
    """
    scene = find_scene(scene)
    simulated = simulate_pulses(replace(scene, recording=recording) if recording else scene, n, rng)
    return simulated.block, simulated.truth


def simulate_blocks(
    scene: Scene | str, n: int, *, seed: int = 0, size: int = SEED_BLOCK
) -> Iterator[tuple[WaveformBlock, EchoTable]]:
    """Blocks of at most `size` waveforms, n in all, and their truth.

    Waveform k depends on scene and seed only: two calls with other n or size agree in the waveforms that both make.
    """
    scene = find_scene(scene)
    if n < 0 or size < 1:
        raise ConfigError(f"cannot simulate {n} waveforms in blocks of {size}; give numbers above 0")
    block = seed_block(scene)
    for start in range(0, n, size):
        stop = min(start + size, n)
        parts = []
        for number in range(start // block, -(-stop // block)):
            low = number * block
            parts.append(simulate_seed_block(scene, seed, number).cut(max(start - low, 0), min(stop - low, block)))
        shifts = np.cumsum([0, *(len(part.block) for part in parts[:-1])]).tolist()
        truth = EchoTable.concatenate((part.truth, shift) for part, shift in zip(parts, shifts, strict=True))
        yield replace(WaveformBlock.concatenate([part.block for part in parts]), first=start), truth


def seed_block(scene: Scene) -> int:
    """Pulses of the scene that share one random generator."""
    return min(SEED_BLOCK, SEED_SAMPLES // scene.recording.n_samples)


def simulate_seed_block(scene: Scene, seed: int, number: int) -> Simulated:
    """Pulses [k number, k (number + 1)) of the scene with this seed, k from `seed_block`."""
    n = seed_block(scene)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    return simulate_pulses(scene, n, rng, first=number * n)


def simulate_pulses(scene: Scene, n: int, rng: np.random.Generator, *, first: int = 0) -> Simulated:
    """Block, truth and rays of pulses [first, first + n)."""
    recording = scene.recording
    rays = trace_rays(scene.flight or FlightLine(), scene.terrain, first + np.arange(n))
    drawn = scene.draw(rng, n, rays)
    signal = paint_echoes(recording, n, drawn.waveform, drawn.time, drawn.amplitude, drawn.sigma)
    counts = record_counts(recording, signal, rng, drawn.constant)
    real = slice(None) if drawn.ghost is None else ~drawn.ghost
    truth = EchoTable.build(drawn.waveform[real], drawn.time[real], drawn.amplitude[real], drawn.sigma[real])
    truth = flag_truth(truth, recording)
    counts.flags.writeable = False
    # Each ray meets the ground at its last echo, or in the middle of the window without one.
    ground_time = np.full(n, recording.duration / 2)
    ground_time[truth.waveform] = truth.time
    block = WaveformBlock(
        digitizer=recording.digitizer,
        samples=counts,
        first=first,
        point=first + np.arange(n),
        gps_time=rays.gps_time,
        origin=rays.ground - ground_time[:, None] * rays.direction,
        direction=rays.direction,
    )
    return Simulated(block, truth, rays)


def flag_truth(truth: EchoTable, recording: Recording) -> EchoTable:
    """The truth with flags for what makes an echo hard to find: OVERLAPPED, NEAR_EDGE, SATURATED, WEAK."""
    depth = np.minimum(truth.time, recording.duration - truth.time)
    truth = truth.with_flags(EchoFlag.OVERLAPPED, has_neighbour(truth, NEIGHBOUR))
    truth = truth.with_flags(EchoFlag.NEAR_EDGE, depth < EDGE_REACH * truth.sigma.astype(np.float64))
    truth = truth.with_flags(EchoFlag.SATURATED, truth.amplitude + recording.baseline > recording.clip)
    return truth.with_flags(EchoFlag.WEAK, truth.amplitude < WEAK * recording.recorded_noise)
