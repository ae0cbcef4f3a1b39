"""Simulated waveforms for tests: blocks with their truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.surveying.systems.known_systems import draw_pulse
from wavebatch.surveying.systems.survey_result import Survey
from wavebatch.tools.simulate import Scene, find_scene, simulate_blocks, simulate_strip

CANOPY_SAMPLES, CANOPY_BEGIN, CANOPY_SIGMA, CANOPY_NOISE = 60, 5, 2.0, 1.2


def make_scene(name: str, **recording) -> Scene:
    """The scene with parts of its recording replaced."""
    scene = find_scene(name)
    return replace(scene, recording=replace(scene.recording, **recording))


def make_block(scene: str | Scene, n: int, seed: int = 0) -> tuple[WaveformBlock, EchoTable]:
    """One block of n waveforms and its truth."""
    return next(simulate_blocks(scene, n, seed=seed, size=n))


def simulated(name: str, scene: str | Scene, *, pulses: int, seed: int, **options: Any) -> Callable:
    """A fixture of a test module: a simulated strip in a file of this name; options: of `simulate_strip`."""

    @pytest.fixture(scope="module")
    def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
        path = tmp_path_factory.mktemp("simulated") / name
        simulate_strip(scene, path, pulses=pulses, seed=seed, **options)
        return path

    return strip


def survey_file(path: Path) -> Survey:
    """The survey of a strip, as every command makes it."""
    with StripReader(path) as reader, reader.scan() as scan:
        return survey_blocks(read_sample(reader, scan))


def half_width(system: SystemPulse) -> float:
    """Full width of a pulse at half of its height [ns]."""
    height = draw_pulse(system, np.arange(-40.0, 60.0, 0.01))
    return 0.01 * np.count_nonzero(height > 0.5 * height.max())


def grow_canopy(seed, n=8000, density=0.5, tail=0.0):
    """Packets that begin a few samples before their first echo: layers of leaves, each of which takes some light."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(15, CANOPY_SAMPLES - CANOPY_BEGIN - 10, n)
    number = rng.poisson(density * depth) + 1
    waveform, last = np.repeat(np.arange(n), number), np.cumsum(number) - 1
    first = np.r_[0, last[:-1] + 1]
    time = rng.random(len(waveform)) * depth[waveform]
    taken = rng.beta(1.0, 2.5, len(waveform))
    time[last] = depth
    time = time[np.lexsort((time, waveform))]
    taken[last] = rng.uniform(0.3, 1, n)
    passed = np.log1p(-np.minimum(taken, 0.999))
    before = np.cumsum(passed) - passed
    left = np.exp(before - np.repeat(before[first], number))
    amplitude = 150.0 * rng.lognormal(0, 0.4, n)[waveform] * taken * left
    time += CANOPY_BEGIN + rng.random(n)[waveform] - time[first][waveform]
    away = np.arange(CANOPY_SAMPLES) - time[:, None]
    pulse = np.exp(-0.5 * (away / CANOPY_SIGMA) ** 2) + tail * np.exp(-0.5 * ((away - 5) / (1.5 * CANOPY_SIGMA)) ** 2)
    signal = np.add.reduceat(amplitude[:, None] * pulse, first, axis=0)
    counts = np.rint(12 + signal + CANOPY_NOISE * rng.standard_normal(signal.shape))
    return WaveformBlock.from_samples(np.clip(counts, 0, 255).astype(np.uint8))
