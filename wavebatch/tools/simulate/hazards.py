"""Hazards: ways to draw echoes that break careless decomposers (docs/algorithms.md 3).

Scene `stiff` mixes them, scene `stiff.<name>` holds one. tools.bench.cases uses some of them at stated values.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wavebatch.tools.simulate.draws import Drawn, LogUniform, tabulate_echoes
from wavebatch.tools.simulate.render import Recording

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
