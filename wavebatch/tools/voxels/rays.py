"""The rays of a block in space: where they begin and end, and the running sum of their signal.

`strip.voxelize_strip` traces the profiles of every block and adds the rays to the grid.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.geometry.voxels import accumulate_profile
from wavebatch.kernels.physics import radiometry
from wavebatch.tools.voxels.floor import Floor
from wavebatch.tools.voxels.profile import Profiles

MOST_SECTION = 2.0**14
"""Larger cross sections of a ray count as unknown: no target has them [m2]."""


@dataclass(frozen=True, slots=True, eq=False)
class RayTable:
    """n rays; times are in ns after sample 0."""

    start: np.ndarray
    """Position at time 0, f8 (n, 3) [m]."""
    step: np.ndarray
    """Direction away from the sensor, f8 (n, 3) [m/ns]."""
    begin: np.ndarray
    """Time at which the ray begins, f8 (n,) [ns]."""
    end: np.ndarray
    """Time at which it ends, f8 (n,) [ns]."""
    energy: np.ndarray
    """Energy up to the end of each sample, f8 (n, s + 1) [DN ns]."""
    caught: np.ndarray
    """The same as light: normalised by range, that of the ground counted as much as that of canopy, f8 (n, s + 1)."""
    section: np.ndarray
    """Cross section up to the end of each sample, f8 (n, s + 1) [m2]; (n, 0) without calibration."""
    unknown: np.ndarray
    """Rays with signal of unknown cross section, bool (n,)."""

    def take(self, rows: np.ndarray) -> RayTable:
        """Some of the rays."""
        return RayTable(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


@dataclass(frozen=True, slots=True, eq=False)
class LightRule:
    """How signal along a ray becomes light that was caught there."""

    floor: Floor
    ground_height: float
    """Height above the ground up to which signal counts as ground [m]."""
    ratio: float = 1.0
    """Reflectance of canopy over that of ground."""
    error: float | None = None
    """Its standard deviation; None where it was given or assumed."""
    source: str = "assumed"
    """`given`, `strip`, `assumed` (1, because the strip does not show it), or `no canopy`."""

    def split(self, block: WaveformBlock, profiles: Profiles) -> tuple[np.ndarray, np.ndarray]:
        """Signal of each sample from canopy and from ground, f8 (n, s) each.

        Times the square of its range where the sensor's position is known.
        """
        row, sample = np.nonzero(profiles.value)
        place = block.origin[row] + block.direction[row] * (sample * block.spacing - profiles.offset[row])[:, None]
        ground = self.floor.measure_height(place) <= self.ground_height
        light = profiles.value[row, sample] * profiles.area
        if block.sensor is not None:
            away = measure_lengths(place - block.sensor[row])
            light = light * np.where(np.isfinite(away), away**2, 1.0)
        parts = np.zeros((2, *profiles.value.shape))
        parts[ground.astype(int), row, sample] = light
        return parts[0], parts[1]

    def weigh(self, block: WaveformBlock, profiles: Profiles) -> np.ndarray:
        """Light caught at each sample, f8 (n, s), in units that are the same along a ray."""
        canopy, ground = self.split(block, profiles)
        return canopy + self.ratio * ground


def trace_profiles(
    block: WaveformBlock,
    profiles: Profiles,
    rule: LightRule,
    *,
    headroom: np.ndarray | float = 0.0,
    system: SystemPulse | None = None,
) -> RayTable:
    """The rays of a block with the signal of their profiles.

    A ray begins half a sample before sample 0, or `headroom` [m] (n,) earlier, and ends after its last signal, because
    no light is known to have gone further. Rays without any signal end with their waveform.
    system: calibrated, for cross sections; None: without them.
    """
    n, s = profiles.value.shape
    start = block.origin - block.direction * profiles.offset[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        begin = -0.5 * block.spacing - headroom / measure_lengths(block.direction)
    last = s - np.argmax(profiles.value[:, ::-1] > 0, axis=1)
    section, unknown = np.empty((n, 0)), np.zeros(n, bool)
    if system is not None:
        section, unknown = _measure_sections(block, profiles, system, start)
        section = accumulate_profile(section)
    return RayTable(
        start=start,
        step=block.direction,
        begin=begin,
        end=(np.where(profiles.seen, last, s) - 0.5) * block.spacing,
        energy=accumulate_profile(profiles.value * profiles.area),
        caught=accumulate_profile(rule.weigh(block, profiles)),
        section=section,
        unknown=unknown,
    )


def measure_lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (n,) of vectors (n, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = (vectors[:, axis] * vectors[:, axis] for axis in range(3))
        return np.sqrt(x + y + z)


def _measure_sections(
    block: WaveformBlock, profiles: Profiles, system: SystemPulse, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cross section of each sample, f8 (n, s) [m2], and waveforms where it is unknown, bool (n,).

    C' pi divergence^2 / 4 R^4 A sigma / eta(R) of a system pulse as high as the profile (docs/algorithms.md 5), with C'
    and pulse of the waveform's channel.
    """
    system = system.of(block)
    section = np.zeros(profiles.value.shape)
    if block.sensor is None:
        return section, profiles.seen
    row, sample = np.nonzero(profiles.value)
    constant, _ = system.calibrate(block)
    off = start[row] + block.direction[row] * (sample * block.spacing)[:, None] - block.sensor[row]
    distance = radiometry.known_distance(measure_lengths(off))
    with np.errstate(over="ignore", invalid="ignore"):
        gamma = radiometry.backscatter(
            constant[row], distance, profiles.value[row, sample], system.sigma_ref, system.radiometry.attenuation
        )
        value = radiometry.cross_section(gamma, distance, 1e-3 * system.radiometry.divergence)
    # A sample without range makes the sum of its ray NaN, which the comparison counts as unknown.
    with np.errstate(invalid="ignore", over="ignore"):
        unknown = ~(np.bincount(row, value, minlength=len(section)) <= MOST_SECTION)
    section[row, sample] = np.where(unknown[row], 0.0, value)
    return section, unknown
