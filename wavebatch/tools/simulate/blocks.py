"""A scene as blocks of waveforms in memory, each with the table of its true echoes.

Tests, benchmarks and examples call `simulate_block(s)`; `strip` stores the same pulses in files. All random numbers of
a pulse are drawn here, from the scene, the seed and the number of its seed block: that keeps pulse k of a seed the same
however many pulses are made and however they are cut into blocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.tools.simulate.geometry import FlightLine, SceneRays, trace_rays
from wavebatch.tools.simulate.render import Recording, paint_echoes, record_counts
from wavebatch.tools.simulate.scenes import Scene, find_scene

SEED_BLOCK = 8192
"""Pulses that share one random generator, at most. Another value makes other strips of the same seed."""

SEED_SAMPLES = SEED_BLOCK * 2048
"""Most samples of these pulses: waveforms of more than 2048 samples have smaller blocks, so that memory suffices."""

NEIGHBOUR = 4.0
"""Echoes closer than this many sigma (of the wider one) count as overlapped (docs/algorithms.md 2.2)."""

EDGE = 2.0
"""Echoes closer than this many sigma to an end of the window count as near the edge (docs/algorithms.md H8)."""

WEAK = 5.0
"""Echoes below this many standard deviations of the noise count as weak, as EchoFlag.WEAK states."""


@dataclass(frozen=True, slots=True, eq=False)
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
        rays = SceneRays(**{field.name: getattr(self.rays, field.name)[start:stop] for field in fields(SceneRays)})
        truth = replace(truth, waveform=truth.waveform - np.int32(start))
        return Simulated(self.block.rows(slice(start, stop)), truth, rays)


def simulate_block(
    scene: Scene | str, n: int, rng: np.random.Generator, *, recording: Recording | None = None
) -> tuple[WaveformBlock, EchoTable]:
    """A block of n waveforms of the scene and the truth: an EchoTable of the echoes in it.

    scene: a Scene or the name of one. recording: replaces the scene's receiver.
    In the truth, time is the datum of the pulse [ns after sample 0], amplitude the height of the peak above the
    baseline [count] and sigma the standard deviation of the main lobe [ns]; the flags are those of `flag_truth`. The
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
        yield _join(parts, start)


def seed_block(scene: Scene) -> int:
    """Pulses of the scene that share one random generator."""
    return min(SEED_BLOCK, SEED_SAMPLES // scene.recording.n_samples)


def simulate_seed_block(scene: Scene, seed: int, number: int, flight: FlightLine | None = None) -> Simulated:
    """Pulses [k number, k (number + 1)) of the scene with this seed, k from `seed_block`."""
    n = seed_block(scene)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    return simulate_pulses(scene, n, rng, first=number * n, flight=flight)


def simulate_pulses(
    scene: Scene, n: int, rng: np.random.Generator, *, first: int = 0, flight: FlightLine | None = None
) -> Simulated:
    """Block, truth and rays of pulses [first, first + n)."""
    recording = scene.recording
    rays = trace_rays(flight or scene.flight or FlightLine(), scene.terrain, first + np.arange(n))
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
    sigma = truth.sigma.astype(np.float64)
    close = np.diff(truth.time) < NEIGHBOUR * np.maximum(sigma[1:], sigma[:-1])
    close &= np.diff(truth.waveform) == 0
    overlapped = np.zeros(len(truth), bool)
    overlapped[1:] |= close
    overlapped[:-1] |= close
    depth = np.minimum(truth.time, recording.duration - truth.time)
    truth = truth.with_flags(EchoFlag.OVERLAPPED, overlapped)
    truth = truth.with_flags(EchoFlag.NEAR_EDGE, depth < EDGE * sigma)
    truth = truth.with_flags(EchoFlag.SATURATED, truth.amplitude + recording.baseline > recording.clip)
    return truth.with_flags(EchoFlag.WEAK, truth.amplitude < WEAK * recording.recorded_noise)


def _join(parts: list[Simulated], first: int) -> tuple[WaveformBlock, EchoTable]:
    shifts = np.cumsum([0, *(len(part.block) for part in parts[:-1])]).tolist()
    truth = EchoTable.concatenate((part.truth, shift) for part, shift in zip(parts, shifts, strict=True))
    return replace(WaveformBlock.concatenate([part.block for part in parts]), first=first), truth
