"""`measure_real`: everything that `make bench-real` reports about one strip.

The tables of injected echoes are made here: the share that is found, and how right the reported errors are.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from bench.real.agreement import (
    LEAST,
    Agreement,
    Pulse,
    compare_halves,
    compare_models,
    find_sensor,
    survey_limited,
)
from bench.real.false_echoes import FalseEchoes, count_false
from bench.real.inject import Injected, inject_echoes
from bench.real.noise import QuietNoise, measure_noise
from bench.real.pool import Pool, Solver, read_pool
from bench.real.templates import TemplateSummary, learn_templates, summarize

from wavebatch.core.errors import InputError
from wavebatch.surveying.systems.known_systems import Trial

INJECTIONS = 8000

SIGMAS = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 40.0, 80.0)
"""Borders of amplitude classes [noise standard deviations]."""

COUNTS = (2.0, 3.0, 4.0, 6.0, 9.0, 15.0, 30.0, 60.0, 120.0, 240.0)
"""Borders of amplitude classes [DN]."""

APART = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)
"""Borders of the classes of separation [FWHM]."""

NEAR_SIGMAS = (5.0, 10.0, 20.0, 40.0)
"""Borders of amplitude classes near other echoes [noise standard deviations]."""

CALIBRATED = (8.0, 15.0, 30.0, 60.0)
"""Borders of amplitude classes of the reported errors: weaker echoes are found or not by their error."""

RESOLVED = 1.5
"""Separation from which errors near other echoes are looked at [FWHM]."""

GROSS = 5.0
"""Errors of more reported standard deviations are counted, and left out of the root mean square."""

SPLIT = 20.0
"""Injected echoes from here on [noise standard deviations] that are found as several count as split."""


@dataclass(frozen=True, slots=True)
class Class:
    """Injected echoes of one class of amplitude, and one of separation where it is set."""

    low: float
    high: float
    injected: int
    found: int
    extra: int
    """Echoes found in their waveforms that neither were there before nor were injected."""
    apart: tuple[float, float] | None = None
    """Separation from the strongest echo [FWHM]."""
    ratio: tuple[float, float, float] | None = None
    """Error / reported error of those found, as in Calibration, where separations are classed."""

    @property
    def recall(self) -> float:
        """Share that is found; NaN without any."""
        return self.found / self.injected if self.injected else float("nan")


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of found echoes against what the chain reports; per quantity time, amplitude, sigma."""

    where: str
    low: float
    high: float
    """Amplitudes [noise standard deviations]."""
    echoes: int
    ratio: tuple[float, float, float]
    """Root mean square of error / reported error, without gross ones."""
    bias: tuple[float, float, float]
    """Median error [ns, DN, ns]."""
    scatter: tuple[float, float, float]
    """Half the width of the central 68 % of the errors [ns, DN, ns]."""
    gross: float
    """Share with an error of more than 5 reported ones in any quantity."""


@dataclass(frozen=True, slots=True)
class RealReport:
    """How well the echoes of one strip are found."""

    strip: str
    left_out: str
    """Shipped pulse that the surveys did not use, as if the sensor were unknown; empty: none."""
    seed: int
    waveforms: int
    echoes: int
    survey: Pulse
    agreement: list[Agreement]
    noise: QuietNoise
    templates: TemplateSummary | None
    """None where too few echoes are clear to inject any."""
    quiet_by_sigma: list[Class]
    quiet_by_count: list[Class]
    near_by_separation: list[Class]
    split: Class | None
    """Strong injected echoes in quiet stretches; `extra` echoes are splits."""
    clipped: Class | None
    """The same of echoes that are clipped."""
    calibration: list[Calibration]
    false_echoes: FalseEchoes
    seconds: dict[str, float]

    @property
    def title(self) -> str:
        """The strip, and what its surveys did without."""
        return f"{self.strip} as an unknown sensor: without {self.left_out}" if self.left_out else self.strip


def measure_real(
    path: Path | str,
    *,
    seed: int = 0,
    injections: int = INJECTIONS,
    waveforms: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> list[RealReport]:
    """Injects echoes into a strip's waveforms, counts false ones, and compares surveys.

    Parameters
    ----------
    path : strip with wave packets.
    seed : of everything random; the same seed gives the same figures.
    injections : number of echoes to inject, about; half in quiet stretches, half near strong echoes.
    waveforms : how many to read, spread over the strip; None: twice as many as a survey looks at.
    say : gets a line for each step.

    Returns
    -------
    list of RealReport
        One, and where the survey takes a shipped pulse another one without it.

    Raises
    ------
    InputError
        Where the strip cannot be read or has too few waveforms and clear echoes.
    """
    pool = read_pool(path, waveforms)
    if not len(pool):
        raise InputError(f"{path}: holds no waveform to measure; `wavebatch check` says what it holds")
    solver = Solver.of_blocks(pool.surveyed)
    report = _measure(pool, solver, "", seed, injections, say)
    sensor = find_sensor(solver)
    report = replace(report, agreement=[*report.agreement, *compare_models(pool, solver, sensor)])
    say(f"{pool.path.name}: surveys compared")
    if not sensor:
        return [report]
    stranger = survey_limited(pool, Trial(sensor))
    if stranger.survey.system == solver.survey.system:
        return [report]
    return [report, _measure(pool, stranger, sensor, seed, injections, say)]


def _measure(
    pool: Pool, solver: Solver, left_out: str, seed: int, injections: int, say: Callable[[str], None]
) -> RealReport:
    """The report of one survey of a strip; left_out: the shipped pulse that it did without."""
    seconds: dict[str, float] = {}
    begin = time.process_time()

    def note(step: str, text: str) -> None:
        seconds[step] = time.process_time() - begin - sum(seconds.values())
        say(f"{pool.path.name}: {f'without {left_out}: ' if left_out else ''}{text}")

    echoes = [solver.run(block) for block in pool.blocks]
    noise = measure_noise(pool, solver, echoes)
    draw = [np.random.default_rng((seed, number)) for number in range(3)]
    try:
        templates = learn_templates(pool, solver, echoes, noise.std, draw[0])
    except InputError:
        if len(pool) < 2 * LEAST:
            raise
        templates = []
    injected = inject_echoes(pool, solver, echoes, templates, noise, injections, draw[1])
    note("inject", f"{len(injected)} echoes injected")
    false = count_false(pool, solver, echoes, noise, draw[2])
    note("false", "residuals mirrored")
    halves = compare_halves(pool, left_out)
    note("agreement", "halves compared")
    quiet = ~injected.near & ~injected.clipped
    strong = _count_classes(injected, noise.std, (SPLIT,), quiet)
    clipped = _count_classes(injected, noise.std, (SPLIT,), ~injected.near & injected.clipped)
    return RealReport(
        strip=pool.path.name,
        left_out=left_out,
        seed=seed,
        waveforms=len(pool),
        echoes=sum(map(len, echoes)),
        survey=Pulse.of(solver),
        agreement=halves,
        noise=noise,
        templates=summarize(templates) if templates else None,
        quiet_by_sigma=_count_classes(injected, noise.std, SIGMAS, quiet),
        quiet_by_count=_count_classes(injected, 1.0, COUNTS, quiet),
        near_by_separation=_count_separations(injected, noise.std),
        split=strong[0] if strong else None,
        clipped=clipped[0] if clipped else None,
        calibration=_calibrate(injected, noise.std),
        false_echoes=false,
        seconds=seconds,
    )


def between(borders: Sequence[float]) -> list[tuple[float, float]]:
    """The classes between borders, and the one above the last."""
    return list(pairwise((*borders, math.inf)))


def _count(injected: Injected, part: np.ndarray, low: float, high: float, **more: Any) -> Class:
    """The class of the echoes at `part` (mask)."""
    found, extra = int(injected.found[part].sum()), int(injected.extra[part].sum())
    return Class(low, high, int(part.sum()), found, extra, **more)


def _count_classes(injected: Injected, unit: float, borders: Sequence[float], where: np.ndarray) -> list[Class]:
    """Classes of amplitude / unit of the echoes at `where` (mask)."""
    size = injected.amplitude / unit
    classes = [_count(injected, where & (size >= a) & (size < b), a, b) for a, b in between(borders)]
    return [row for row in classes if row.injected]


def _count_separations(injected: Injected, noise: float) -> list[Class]:
    """Recall and errors near the strongest echoes by separation, before and after them, and amplitude."""
    rows = []
    size = injected.amplitude / noise
    for side, (near, far) in product((-1.0, 1.0), pairwise(APART)):
        apart = side * injected.separation
        inside = injected.near & (apart >= near) & (apart < far)
        for low, high in between(NEAR_SIGMAS):
            part = inside & (size >= low) & (size < high)
            errors = _measure_errors("near", low, high, injected, part & injected.found & ~injected.clipped)
            rows.append(_count(injected, part, low, high, apart=(side * near, side * far), ratio=errors.ratio))
    return rows


def _calibrate(injected: Injected, noise: float) -> list[Calibration]:
    """Errors in quiet stretches by amplitude, and near other echoes from a separation that fits can tell apart."""
    clean = injected.found & ~injected.clipped & (injected.extra <= 0)
    whole = (CALIBRATED[0], math.inf)
    classes = [("quiet", *span, clean & ~injected.near) for span in (*between(CALIBRATED), whole)]
    classes.append(("near", *whole, clean & injected.near & (np.abs(injected.separation) >= RESOLVED)))
    size = injected.amplitude / noise
    rows = [_measure_errors(*row[:3], injected, row[3] & (size >= row[1]) & (size < row[2])) for row in classes]
    return [row for row in rows if row.echoes >= 10]


def _measure_errors(where: str, low: float, high: float, injected: Injected, part: np.ndarray) -> Calibration:
    errors, reported = injected.errors[part], injected.reported[part]
    known = (np.isfinite(reported) & (reported > 0)).all(axis=1)
    errors, scaled = errors[known], errors[known] / reported[known]
    gross = (np.abs(scaled) > GROSS).any(axis=1)
    if gross.all():
        return Calibration(where, low, high, 0, *((float("nan"),) * 3,) * 3, 0.0)
    ratio = np.sqrt(np.mean(scaled[~gross] ** 2, axis=0))
    lower, middle, upper = np.quantile(errors[~gross], [0.1587, 0.5, 0.8413], axis=0)
    figures = (tuple(map(float, values)) for values in (ratio, middle, 0.5 * (upper - lower)))
    return Calibration(where, low, high, len(errors), *figures, float(gross.mean()))
