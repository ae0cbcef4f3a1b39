"""Simulated waveforms for tests: blocks with their truth, and the SystemPulse that a perfect survey would find."""

from __future__ import annotations

from dataclasses import replace

from wavebatch.blocks import EchoTable, SystemPulse, WaveformBlock
from wavebatch.simulate import Recording, Scene, find_scene, simulate_blocks


def make_scene(name: str, **recording) -> Scene:
    """The scene with parts of its recording replaced."""
    scene = find_scene(name)
    return replace(scene, recording=replace(scene.recording, **recording))


def make_block(scene: str | Scene, n: int, seed: int = 0) -> tuple[WaveformBlock, EchoTable]:
    """One block of n waveforms and its truth."""
    return next(simulate_blocks(scene, n, seed=seed, size=n))


def perfect_system(recording: Recording) -> SystemPulse:
    """What a survey without error would say of the recording."""
    return SystemPulse(
        sigma_ref=recording.pulse.sigma,
        baseline=recording.baseline,
        baseline_spread=recording.baseline_spread,
        noise_std=recording.recorded_noise,
        noise_gain=recording.noise_gain,
        kappa=recording.pulse.kappa,
    )
