"""Pulses of known sensors, measured on real strips and shipped as SYSTEM.toml files in this folder.

`survey` takes one where a strip has too few echoes to learn a pulse from; `wavebatch survey` names the one that a
strip's pulse looks like. Before you change it: a wrong pulse is worse than none, so the margins must keep simulated
strips of other sensors from getting one (tests/surveying/test_known_systems.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA, MAD_TO_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.toml_file import parse_toml, read_toml_text
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.decompose.fit import adaptive, closed_form
from wavebatch.stages.detect.maximum import maximum
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import pulse_shape, shape_limits
from wavebatch.surveying.measure import MIN_SNR, find_strongest, keep_lone, subtract_echoes
from wavebatch.surveying.systems.system_table import read_system

LEAST_ECHOES = 8
"""Strong single echoes below which no pulse is taken: eight that all agree are chance once in 256 times."""

MOST_ECHOES = 200
"""Echoes, the strongest ones, in which pulses are compared; more do not change the answer."""

CLEARLY_BETTER = 0.75
"""Misfit of a known pulse, over that of a Gaussian, at which it is taken; the median over the echoes."""

MOSTLY = 0.75
"""Share of the echoes that the known pulse must fit better than a Gaussian does."""

BEFORE, AFTER = 4.0, 9.0
"""Widths of the pulse before and after an echo in which the misfit is measured: both shipped pulses with their
after-pulses lie within."""

SAME_SPACING = 0.01
"""How far the spacing of a strip may be from that of a known sensor, as a share of it."""

NEAR_WIDTH = 0.15
"""The same for the width of the Gaussian that fits the pulse best; that of few echoes is right to some 5 %."""

ALIKE = 0.05
"""Difference of two pulses, as `compare_pulses` measures it, up to which one looks like the other."""

LARGEST_RINGING = 0.12
"""Largest share of an echo that is taken for an after-pulse where no pulse is known: what is higher is a target."""


@dataclass(frozen=True, slots=True)
class KnownSystem:
    """A shipped pulse."""

    name: str
    """Of the file, for example riegl-q680i."""
    sensor: str
    """For people, for example RIEGL LMS-Q680i."""
    spacing: float
    """Of the samples that it was measured with [ns]."""
    system: SystemPulse


@cache
def known_systems() -> tuple[KnownSystem, ...]:
    """Return the shipped pulses by name."""
    return tuple(_load(path) for path in sorted(Path(__file__).parent.glob("*.toml")))


def _load(path: Path) -> KnownSystem:
    table = parse_toml(read_toml_text(path, "system file"), str(path))
    spacing = table.table("figures").number("spacing_ns", 1e-3, 1e3)
    return KnownSystem(path.stem, table.get("sensor", str), spacing, read_system(table.table("system")))


def find_lone(block: WaveformBlock, system: SystemPulse) -> EchoTable:
    """The strongest single echoes of a block by Gaussian fits: at most MOST_ECHOES, one per waveform, not clipped."""
    noise = pooled_noise(block, system)
    echoes = closed_form(block, noise, system, maximum(block, noise, system), fraction=0.5, steps=4)
    rows, second = find_strongest(echoes, len(block))
    echoes = echoes.take(rows)
    good = echoes.amplitude > MIN_SNR * system.noise_std
    good &= (echoes.flags & int(EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) == 0
    rows = np.flatnonzero(keep_lone(good, echoes.amplitude, second))
    return echoes.take(np.sort(rows[np.argsort(-echoes.amplitude[rows], kind="stable")[:MOST_ECHOES]]))


def fit_alone(block: WaveformBlock, system: SystemPulse, lone: EchoTable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit the pulse of a system to single echoes.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    lone : EchoTable
        m echoes, one per waveform.

    Returns
    -------
    misfit : float64 (m,)
        Root mean square of what is left from BEFORE to AFTER the echo, as a share of the amplitude; inf without a fit.
    left : float64 (m, s)
        What is left of the waveform, as a share of the amplitude.
    lag : float64 (m, s)
        Of the samples after the echo [ns].
    """
    part, m = block.rows(lone.waveform), len(lone)
    start = replace(lone, waveform=np.arange(m, dtype=np.int32))
    fitted = adaptive(part, pooled_noise(part, system), system, start, max_echoes=1, significance=0.0)
    fitted = fitted.take(find_strongest(fitted, m)[0])
    left = np.full(part.samples.shape, np.nan)
    lag = np.full(part.samples.shape, np.inf)
    rows = fitted.waveform
    left[rows] = subtract_echoes(part, system, fitted)[rows] / fitted.amplitude[:, None]
    lag[rows] = np.arange(part.samples.shape[1]) * part.spacing - fitted.time[:, None].astype(np.float64)
    near = (lag > -BEFORE * system.sigma_ref) & (lag < AFTER * system.sigma_ref) & np.isfinite(left)
    number = near.sum(axis=1)
    power = np.where(near, left, 0.0) ** 2
    return np.where(number > 0, np.sqrt(power.sum(axis=1) / np.maximum(number, 1)), np.inf), left, lag
