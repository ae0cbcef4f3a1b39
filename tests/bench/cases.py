"""The stiff cases: the hazards H1 to H16 of docs/algorithms.md 3 that can be simulated, each at fixed values.

`stability` runs every chain on them. tools.simulate.scenes draws at random values instead, for the scene `stiff`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.tools.simulate import PulseModel, Recording, Scene, scenes, shape_pulse

SIGMA = 2.0
"""Width of the system pulse in all cases [ns]."""


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the stability section."""

    hazard: str
    """H1 ... H16."""
    name: str
    draw: scenes.Draw
    recording: Recording = field(default_factory=Recording)


@frozen
class CaseScene(Scene):
    """A scene that holds one case."""

    case: Case | None = None

    def draw(self, rng: np.random.Generator, n: int, incidence: np.ndarray) -> scenes.Drawn:
        """Echoes of n waveforms."""
        return self.case.draw(rng, n, self.recording)


def make_scene(case: Case) -> CaseScene:
    """The scene of a case."""
    return CaseScene(f"{case.hazard} {case.name}", case.name, recording=case.recording, case=case)


def draw_echoes(
    rng: np.random.Generator, n: int, recording: Recording, *, heights: tuple[float, ...], gap: float = 0.0
) -> scenes.Drawn:
    """Echoes of the system's width and the given heights [count], `gap` widths apart, away from the ends."""
    s, k = recording.pulse.sigma, len(heights)
    middle = rng.uniform(12 * s, recording.duration - 12 * s, (n, 1))
    time = middle + gap * s * (np.arange(k) - 0.5 * (k - 1))
    return scenes.tabulate_echoes(time, np.array(heights, np.float64), s)


def draw_between(rng: np.random.Generator, n: int, recording: Recording, *, low: float, high: float) -> scenes.Drawn:
    """One echo of the system's width between two heights [count], evenly over their logarithm."""
    s = recording.pulse.sigma
    time = rng.uniform(12 * s, recording.duration - 12 * s, (n, 1))
    return scenes.tabulate_echoes(time, np.exp(rng.uniform(np.log(low), np.log(high), (n, 1))), s)


def draw_at_edge(rng: np.random.Generator, n: int, recording: Recording, *, inside: float) -> scenes.Drawn:
    """One echo of 100 counts whose centre lies `inside` widths, plus or minus half a sample, from an end."""
    distance = inside * recording.pulse.sigma + rng.uniform(-0.5, 0.5, (n, 1)) * recording.spacing
    time = np.where(rng.random((n, 1)) < 0.5, distance, recording.duration - distance)
    return scenes.tabulate_echoes(time, 100.0, recording.pulse.sigma)


def draw_clipped(rng: np.random.Generator, n: int, recording: Recording, *, level: float) -> scenes.Drawn:
    """One echo of which the receiver records only the share `level` of its height."""
    return draw_echoes(rng, n, recording, heights=((recording.clip - recording.baseline) / level,))


def _list_cases() -> Iterator[Case]:
    base = Recording(n_samples=96, pulse=PulseModel(SIGMA))
    deep = replace(base, bits=16, baseline=200.0)
    clipping = replace(base, saturation=255)
    one = partial(partial, draw_echoes)
    for gap in (0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5):
        yield Case("H1", f"pair {gap:g} s apart, SNR 50", one(heights=(52.0, 52.0), gap=gap), base)
    yield Case("H1", "pair 1.75 s apart, 52 and 10 DN", one(heights=(52.0, 10.4), gap=1.75), base)
    for gap in (0.25, 1):
        yield Case("H2", f"pair {gap:g} s apart, 20000 DN", one(heights=(2e4, 2e4), gap=gap), deep)
    for snr in (3, 4, 5):
        yield Case("H3", f"weak: SNR {snr}", one(heights=(1.041 * snr,)), base)
    for kappa in (0.06, 0.10, 0.15):
        skewed = replace(base, pulse=PulseModel(SIGMA, kappa))
        yield Case("H4", f"skew {kappa:g}, SNR 100", one(heights=(104.0,)), skewed)
    yield Case("H5", "50 to 50000 DN in 16 bit", partial(draw_between, low=50.0, high=5e4), deep)
    for level in (0.95, 0.8, 0.64, 0.5, 0.3):
        yield Case("H6", f"clipped at {level:.0%} of its height", partial(draw_clipped, level=level), clipping)
    yield Case("H6", "clipped at 50%, none in the survey", partial(draw_clipped, level=0.5), base)
    yield Case("H6", "5 to 500 times the range", scenes.draw_huge, clipping)
    for ring in (0.01, 0.02, 0.03):
        ringing = replace(base, pulse=shape_pulse(base.pulse, ringing=ring))
        yield Case("H7", f"ringing {ring:.0%}", one(heights=(200.0,)), ringing)
    for inside in (2.0, 1.5, 1.0, 0.5, 0.0, -0.5):
        yield Case("H8", f"centre {inside:g} s inside", partial(draw_at_edge, inside=inside), base)
    quiet = replace(base, noise_std=0.5, baseline_spread=0.1)
    yield Case("H9", "2 to 6 DN, noise 0.5", partial(draw_between, low=2.0, high=6.0), quiet)
    yield Case("H10", "constant 0, 12 or 255", scenes.draw_constant, base)
    yield Case("H10", "noise only", one(heights=()), base)
    for rho in (0.5, 0.667, 0.8):
        yield Case("H11", f"noise of rho {rho:.2g}", one(heights=(60.0,)), replace(base, rho=rho))
    for gain in (0.05, 0.1):
        yield Case("H12", f"variance +{gain:g} per DN", one(heights=(150.0,)), replace(base, noise_gain=gain))
    yield Case("H16", "2.5 to 4 times as wide", scenes.draw_broad, base)
    yield Case("H16", "weak beside strong", scenes.draw_contrast, base)
    yield Case("H16", "eight echoes", scenes.draw_crowd, base)


CASES: tuple[Case, ...] = tuple(_list_cases())
"""Every case, in the order of the hazards. H13 to H15 concern range and angle, not waveforms."""


def list_cases(hazards: Sequence[str]) -> tuple[Case, ...]:
    """The cases of the given hazards, all where none is given; raises ConfigError for a hazard without cases."""
    known = list(dict.fromkeys(case.hazard for case in CASES))
    for name in hazards:
        if name not in known:
            raise ConfigError(f"hazard {name!r} cannot be simulated; {nearest(name, known)}")
    return tuple(case for case in CASES if not hazards or case.hazard in hazards)
