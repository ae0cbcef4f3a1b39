"""How light is shared between canopy and ground: the reflectance ratio of both, given or estimated from the strip.

`strip.voxelize_strip` calls `find_rule` before the rays are traced. Without the right ratio, the share of a voxel is no
interception: leaves of .5 over ground of .15 hide a gap probability of .61 as one of .41.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio
from wavebatch.tools.voxels.floor import Floor
from wavebatch.tools.voxels.profile import Deconvolution, deconvolve_block
from wavebatch.tools.voxels.rays import LightRule

SAMPLED = 4096
"""Waveforms from which the ratio is estimated."""

LEAST_CANOPY = 0.01
"""Share of the light from the canopy below which its ratio to the ground does not matter."""


def find_rule(
    blocks: Iterable[WaveformBlock],
    pulse: SystemPulse,
    deconvolution: Deconvolution,
    floor: Floor,
    ground_height: float,
    given: float | None,
) -> LightRule:
    """The rule by which signal counts as light, from a sample of the waveforms with their sensor's positions."""
    if given is not None:
        return LightRule(floor, ground_height, given, None, "given")
    rule = LightRule(floor, ground_height)
    energies = []
    for block in blocks:
        parts = [part.sum(axis=1) for part in rule.split(block, deconvolve_block(block, pulse, deconvolution))]
        if block.sensor is not None:  # others are not normalised by range
            parts = [part[np.isfinite(block.sensor).all(axis=1)] for part in parts]
        energies.append(np.stack(parts))
    canopy, ground = np.concatenate(energies, axis=1) if energies else np.zeros((2, 0))
    if canopy.sum() < LEAST_CANOPY * (canopy.sum() + ground.sum()):
        return replace(rule, source="no canopy")
    found = estimate_canopy_ratio(canopy, ground)
    return rule if found is None else replace(rule, ratio=found.ratio, error=found.error, source="strip")
