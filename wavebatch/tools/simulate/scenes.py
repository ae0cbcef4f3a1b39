"""The scenes by name: how many echoes their waveforms hold, how strong, wide and far apart, over which terrain.

`wavebatch simulate` lists them, `blocks` draws from them. A scene is data; tools.bench adds scenes with another `draw`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.kernels.physics.radiometry import transmit
from wavebatch.tools.simulate.draws import (
    CANOPIES,
    Canopy,
    Drawn,
    FoldedWidth,
    HalfBroadened,
    LogNormal,
    LogUniform,
    Mixture,
    WithGaps,
    WithinDepth,
    draw_numbers,
    tabulate_echoes,
    widen_on_slope,
)
from wavebatch.tools.simulate.geometry import GROUND, FlightLine, SceneRays
from wavebatch.tools.simulate.render import PulseModel, Recording

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


def draw_hazards(rng: np.random.Generator, n: int, recording: Recording, names: tuple[str, ...]) -> Drawn:
    """Each waveform one of the named hazards, evenly at random."""
    kind = rng.integers(0, len(names), n)
    parts = []
    constant = np.full(n, np.nan)
    for number, name in enumerate(names):
        rows = np.flatnonzero(kind == number)
        part = HAZARDS[name](rng, len(rows), recording)
        if part.constant is not None:
            constant[rows] = part.constant
        ghost = np.zeros(len(part.time), bool) if part.ghost is None else part.ghost
        parts.append((rows[part.waveform], part.time, part.amplitude, part.sigma, ghost))
    waveform, time, amplitude, sigma, ghost = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.lexsort((time, waveform))
    return Drawn(waveform[order], time[order], amplitude[order], sigma[order], ghost[order], constant)


GROUND_REFLECTS, ROOFS_REFLECT = 0.2, 0.4
"""Diffuse reflectances in scenes with light."""

LEAST_ROOF = 1.0
"""Height above the ground from which a surface is a roof [m]."""

AIR_ATTENUATION = 0.22
"""Attenuation by the air in scenes with light, one way [dB/km]."""


@dataclass(frozen=True, slots=True)
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
    """A key of geometry.TERRAINS."""
    divergence: float = 0.0
    """Full angle of the beam between the 1/e^2 points [mrad]; above 0, slopes widen the echoes."""
    light: float = 0.0
    """amplitude sigma range^2 of a white surface that faces the sensor, without attenuation by the air [count ns m2].
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
            return draw_hazards(rng, n, self.recording, self.hazards)
        if self.canopy:
            return self.canopy.draw(rng, n, self.recording)
        count = draw_numbers(rng, n, self.counts)
        waveform = np.repeat(np.arange(n), count)
        time = self.times(rng, count, self.recording)
        amplitude = self.amplitude(rng, len(waveform))
        sigma = self.width(rng, np.repeat(count == 1, count), self.recording.pulse.sigma)
        if self.light:
            amplitude = _light_surfaces(self.light, rays)[waveform] / self.recording.pulse.sigma
        if self.divergence:
            radius = (0.5e-3 * self.divergence * rays.distance)[waveform]
            sigma, amplitude = widen_on_slope(sigma, amplitude, rays.incidence[waveform], radius)
        order = np.lexsort((time, waveform)) if len(self.counts) > 2 else slice(None)
        return Drawn(waveform, time[order], amplitude[order], sigma[order])


def _light_surfaces(light: float, rays: SceneRays) -> np.ndarray:
    """amplitude times sigma of surfaces that face their ray [count ns], (n,)."""
    high = rays.ground[:, 2] > GROUND + LEAST_ROOF
    reflectance = np.where(high, ROOFS_REFLECT, GROUND_REFLECTS)
    return light * reflectance * transmit(rays.distance, AIR_ATTENUATION) / rays.distance**2


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
