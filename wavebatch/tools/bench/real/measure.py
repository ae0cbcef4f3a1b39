"""`measure_real`: everything that `wavebatch bench --real` reports about one strip."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import InputError
from wavebatch.surveying import survey_blocks
from wavebatch.tools.bench.real.agreement import Agreement, Pulse, compare_parts
from wavebatch.tools.bench.real.false_echoes import FalseEchoes, count_false
from wavebatch.tools.bench.real.inject import Injected, inject_echoes
from wavebatch.tools.bench.real.noise import QuietNoise, measure_noise
from wavebatch.tools.bench.real.pool import Pool, Solver, SurveyOf, read_pool
from wavebatch.tools.bench.real.recall import (
    COUNTS,
    SIGMAS,
    Calibration,
    Class,
    calibrate,
    count_classes,
    count_separations,
)
from wavebatch.tools.bench.real.templates import Template, TemplateSummary, learn_templates, summarize

INJECTIONS = 8000

SPLIT = 20.0
"""Injected echoes from here on [noise standard deviations] that are found as several count as split."""


@dataclass(frozen=True, slots=True)
class RealReport:
    """How well the echoes of one strip are found."""

    strip: str
    seed: int
    waveforms: int
    echoes: int
    survey: Pulse
    noise: QuietNoise
    templates: TemplateSummary
    quiet_by_sigma: list[Class]
    quiet_by_count: list[Class]
    near_by_separation: list[Class]
    split: Class | None
    """Strong injected echoes in quiet stretches; `extra` echoes are splits."""
    clipped: Class | None
    """The same of echoes that are clipped."""
    calibration: list[Calibration]
    false_echoes: FalseEchoes
    agreement: list[Agreement]
    seconds: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, lists and dictionaries."""
        return asdict(self)


def measure_real(
    path: Path | str,
    *,
    seed: int = 0,
    injections: int = INJECTIONS,
    waveforms: int | None = None,
    stability: bool = True,
    survey_of: SurveyOf = survey_blocks,
    solver: Solver | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> RealReport:
    """Injects echoes into a strip's waveforms, counts false ones, and compares surveys of its parts.

    Parameters
    ----------
    path : strip with wave packets.
    seed : of everything random; the same seed gives the same figures.
    injections : number of echoes to inject, about; half in quiet stretches, half near strong echoes.
    waveforms : how many to read, spread over the strip; None: twice as many as a survey looks at.
    stability : also survey halves, tiles and shuffled waveforms, which takes seven more surveys.
    survey_of : makes a survey from a list of blocks: another one than the program's, for experiments.
    solver : survey and chain to use in place of those that the strip gives.
    say : gets a line for each step.

    Raises
    ------
    InputError
        Where the strip cannot be read or has too few clear echoes.
    """
    seconds: dict[str, float] = {}
    clock = _Clock(seconds, say)
    pool = read_pool(path, waveforms)
    if not len(pool):
        raise InputError(f"{path}: holds no waveform to measure; `wavebatch check` says what it holds")
    clock.note("read", f"{pool.path.name}: {len(pool)} waveforms read")
    solver = solver or Solver.of_blocks(pool.surveyed, survey_of)
    clock.note("survey", f"{pool.path.name}: surveyed")
    echoes = [solver.run(block) for block in pool.blocks]
    noise = measure_noise(pool, solver, echoes)
    templates = learn_templates(pool, solver, echoes, noise.std, np.random.default_rng((seed, 0)))
    injected = inject_echoes(pool, solver, echoes, templates, noise, injections, np.random.default_rng((seed, 1)))
    clock.note("inject", f"{pool.path.name}: {len(injected)} echoes injected")
    false = count_false(pool, solver, echoes, noise, np.random.default_rng((seed, 2)))
    clock.note("false", f"{pool.path.name}: residuals mirrored")
    agreement = compare_parts(pool, solver, survey_of, np.random.default_rng((seed, 3))) if stability else []
    clock.note("stability", f"{pool.path.name}: parts surveyed")
    return _collect(pool, seed, solver, echoes, noise, templates, injected, false, agreement, seconds)


class _Clock:
    """Notes how long each step took."""

    def __init__(self, seconds: dict[str, float], say: Callable[[str], None]) -> None:
        self._seconds, self._say, self._last = seconds, say, time.process_time()

    def note(self, step: str, text: str) -> None:
        now = time.process_time()
        self._seconds[step], self._last = now - self._last, now
        self._say(text)


def _collect(
    pool: Pool,
    seed: int,
    solver: Solver,
    echoes: Sequence[EchoTable],
    noise: QuietNoise,
    templates: Sequence[Template],
    injected: Injected,
    false: FalseEchoes,
    agreement: list[Agreement],
    seconds: dict[str, float],
) -> RealReport:
    quiet = ~injected.near & ~injected.clipped
    strong = count_classes(injected, noise.std, (SPLIT,), quiet)
    clipped = count_classes(injected, noise.std, (SPLIT,), ~injected.near & injected.clipped)
    return RealReport(
        strip=pool.path.name,
        seed=seed,
        waveforms=len(pool),
        echoes=sum(map(len, echoes)),
        survey=Pulse.of(solver),
        noise=noise,
        templates=summarize(templates),
        quiet_by_sigma=count_classes(injected, noise.std, SIGMAS, quiet),
        quiet_by_count=count_classes(injected, 1.0, COUNTS, quiet),
        near_by_separation=count_separations(injected, noise.std),
        split=strong[0] if strong else None,
        clipped=clipped[0] if clipped else None,
        calibration=calibrate(injected, noise.std),
        false_echoes=false,
        agreement=agreement,
        seconds=seconds,
    )
