"""Simulated waveforms for tests: blocks with their truth."""

from __future__ import annotations

from dataclasses import replace

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.tools.simulate import Scene, find_scene, simulate_blocks


def make_scene(name: str, **recording) -> Scene:
    """The scene with parts of its recording replaced."""
    scene = find_scene(name)
    return replace(scene, recording=replace(scene.recording, **recording))


def make_block(scene: str | Scene, n: int, seed: int = 0) -> tuple[WaveformBlock, EchoTable]:
    """One block of n waveforms and its truth."""
    return next(simulate_blocks(scene, n, seed=seed, size=n))
