"""A receiver that records discrete returns and is blind for a while after each (ALGORITHMS.md 1.5), and its strips."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.units import HALF_C
from wavebatch.files.cloud.return_io import ReturnWriter
from wavebatch.files.las.point_formats import WITHOUT_WAVES
from wavebatch.tools.simulate.blocks import SEED_BLOCK, Simulated, simulate_seed_block
from wavebatch.tools.simulate.geometry import EAST, NORTH, Flight
from wavebatch.tools.simulate.returns import Returns
from wavebatch.tools.simulate.scenes import Scene, find_scene
from wavebatch.tools.simulate.strip import WKT, StripOptions, cut_pulses, locate, place_points, set_returns


@dataclass(frozen=True, slots=True)
class DiscreteReceiver:
    """A return fires at the first echo whose amplitudes, summed over one dead zone from it, exceed the threshold."""

    dead_zone: float = 0.65
    """Least distance of two returns of a pulse [m]."""
    threshold: float = 12.0
    """[count]."""
    most: int = 4
    """Returns per pulse."""

    def __post_init__(self) -> None:
        if not (self.dead_zone > 0 and self.threshold >= 0 and 1 <= self.most <= 15):
            raise ConfigError(
                f"receiver: dead zone {self.dead_zone} m must be above 0, threshold {self.threshold} not below it, "
                f"and {self.most} returns must be 1 to 15"
            )

    def fire(
        self, pulse: np.ndarray, distance: np.ndarray, amplitude: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Echoes (m,), sorted by pulse, then distance [m], to returns: row of the echo that fired, i8 (k,), return
        number from 1, i8 (k,), and summed amplitude, f8 (k,); sorted by pulse, then number."""
        m = len(pulse)
        first = np.searchsorted(pulse, pulse, side="left")
        behind = np.searchsorted(pulse, pulse, side="right")
        reach = _advance(distance, distance + self.dead_zone, behind)
        sums = np.concatenate([[0.0], np.cumsum(amplitude, dtype=np.float64)])
        energy = sums[reach] - sums[:m]
        loud = energy > self.threshold
        following = np.where(loud, np.arange(m), m)
        following = np.minimum.accumulate(following[::-1])[::-1] if m else following
        following = np.append(following, m)
        rows, numbers = [], []
        at = np.unique(first)
        for number in range(1, self.most + 1):
            end = behind[at]
            hit = following[at]
            hit = hit[hit < end]
            rows.append(hit)
            numbers.append(np.full(len(hit), number))
            more = reach[hit] < behind[hit]
            at = reach[hit[more]]
        row, number = np.concatenate(rows), np.concatenate(numbers)
        order = np.argsort(row, kind="stable")
        return row[order], number[order], energy[row[order]]


def _advance(distance: np.ndarray, limit: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """First row of the same pulse that is not nearer than the limit, else the row behind the pulse, i8 (m,)."""
    reach = np.arange(len(distance))
    moving = reach.copy()
    while len(moving):
        reach[moving] += 1
        moving = moving[reach[moving] < behind[moving]]
        moving = moving[distance[reach[moving]] < limit[moving]]
    return reach


@dataclass(frozen=True, slots=True)
class ReturnSummary:
    """What a simulated cloud of discrete returns holds."""

    pulses: int
    points: int
    empty: int
    """Pulses without any return."""


def simulate_returns(
    scene: Scene | str,
    target: Path,
    *,
    pulses: int,
    seed: int = 0,
    receiver: DiscreteReceiver | None = None,
    options: StripOptions | None = None,
    flight: Flight | None = None,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> ReturnSummary:
    """Writes the returns that a discrete receiver has of the scene to `target` (.las or .laz); returns the counts.

    Pulse k of a scene and seed meets the echoes that simulate_strip puts in its waveform. A return lies at the first
    echo that fires it; its intensity is ten times the summed amplitude. Of `options`, point_format (4, 5, 9, 10 become
    1, 3, 6, 8) and scale count. Errors as in simulate_strip.
    """
    scene = find_scene(scene) if isinstance(scene, str) else scene
    options, receiver = options or StripOptions(), receiver or DiscreteReceiver()
    if pulses < 1:
        raise ConfigError(f"a cloud needs at least one pulse, not {pulses}")
    points = empty = 0
    with ReturnWriter(
        target,
        point_format=WITHOUT_WAVES[options.point_format],
        scales=(options.scale,) * 3,
        offsets=(EAST, NORTH, 0.0),
        wkt=WKT,
        overwrite=overwrite,
    ) as writer:
        for number in range(-(-pulses // SEED_BLOCK)):
            n = min(SEED_BLOCK, pulses - number * SEED_BLOCK)
            simulated = cut_pulses(simulate_seed_block(scene, seed, number, flight), n)
            returns = _receive(receiver, simulated, 7 if options.point_format < 6 else 15)
            writer.write(_fill_points(writer.dtype, simulated, returns, options))
            points += len(returns.pulse)
            empty += n - len(np.unique(returns.pulse))
            if progress:
                progress(n)
        writer.commit()
    return ReturnSummary(pulses, points, empty)


def _receive(receiver: DiscreteReceiver, simulated: Simulated, most: int) -> Returns:
    truth = simulated.truth
    if receiver.most > most:
        raise ConfigError(
            f"point formats 4 and 5 number {most} returns, the receiver has {receiver.most}; take 9 or 10"
        )
    row, number, amplitude = receiver.fire(truth.waveform, truth.time * HALF_C, truth.amplitude)
    pulse = truth.waveform[row].astype(np.int64)
    total = np.bincount(pulse, minlength=len(simulated.block))[pulse]
    return Returns(pulse, truth.time[row], amplitude, number, total)


def _fill_points(dtype: np.dtype, simulated: Simulated, returns: Returns, options: StripOptions) -> np.ndarray:
    block, pulse = simulated.block, returns.pulse
    points = np.zeros(len(pulse), dtype)
    place_points(points, locate(block, pulse, returns.time), options)
    points["intensity"] = np.clip(np.rint(10 * returns.amplitude), 0, 65535)
    points["gps_time"] = block.gps_time[pulse]
    points["point_source_id"] = 1
    last = returns.number == returns.total
    set_returns(points, returns, np.where(last, 2, 5), simulated.rays.scan_angle[pulse])
    for number, name in enumerate(("red", "green", "blue", "nir")):
        if name in dtype.names:
            points[name] = 20_000 + 9_000 * number + 20 * (pulse % 256)
    return points
