"""How much of a pulse's light is caught where: the reflectance ratio of canopy and ground, given or estimated.

`strip.voxelize_strip` calls `find_rule` before rays are summed. Without the right ratio, the share of a voxel is no
interception: leaves of .5 over ground of .15 hide a gap probability of .61 as one of .41.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio
from wavebatch.tools.voxels.rays import Rays

LEAST_CANOPY = 0.01
"""Share of the light from the canopy below which its ratio to the ground does not matter."""

ASSUMED_ERROR = float(np.log(2.0))
"""Standard deviation of the logarithm of a ratio that the strip does not show: leaves and soils of .15 to .5."""

WEAKEST = 0.05
"""Quantile of the light in packets that is stated as the most that a gap between packets hides."""


@dataclass(frozen=True, slots=True)
class LightRule:
    """How signal along a ray becomes light that was caught there."""

    ratio: float = 1.0
    """Reflectance of canopy over that of ground."""
    error: float | None = None
    """Its standard deviation; None where it was given or assumed."""
    source: str = "assumed"
    """`given`, `strip`, `assumed` (1, because the strip does not show it), or `no canopy`."""
    usual: float = 0.0
    """Light of a pulse, in the mean: that of pulses of which a packet was lost."""
    hidden_light: float | None = None
    """Share of a pulse's light that may hide between two of its packets; None without pulses of several packets."""

    @property
    def log_error(self) -> float:
        """Standard deviation of the logarithm of the ratio."""
        return ASSUMED_ERROR if self.source == "assumed" else (self.error or 0.0) / self.ratio

    def weigh(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """Share of its ray's light that was caught at each sample, and the part of it that the ground caught, f8 (m,).

        0 where it is not known.
        """
        owner, known = rays.owner, rays.table["known"]
        ground = np.where(rays.samples["time"] < known[owner], self.ratio * rays.samples["ground"], 0.0)
        light = ground + np.where(rays.samples["time"] < known[owner], rays.samples["canopy"], 0.0)
        whole = np.bincount(owner, light, minlength=len(known))
        whole = np.where(known < np.inf, np.maximum(whole, self.usual), whole)
        whole = np.where(whole > 0, whole, 1.0)[owner]
        return light / whole, ground / whole


def find_rule(sample: Iterable[Rays], given: float | None) -> LightRule:
    """The rule by which signal counts as light, from the rays of a sample of the pulses."""
    pulses, packets = [np.zeros((2, 0))], [np.zeros((4, 0))]
    for rays in sample:
        owner, n = rays.owner, len(rays.table)
        complete = rays.table["known"] == np.inf
        whole = np.stack([np.bincount(owner, rays.samples[name], n) for name in ("canopy", "ground")])
        pulses.append(whole[:, complete])
        # Packets of a ray follow each other.
        first = np.flatnonzero(np.diff(rays.samples["packet"], prepend=-1))
        if len(first):
            part = np.stack([np.add.reduceat(rays.samples[name], first) for name in ("canopy", "ground")])
            used = (complete & (rays.table["packets"] > 1))[owner[first]]
            packets.append(np.concatenate([part, whole[:, owner[first]]])[:, used])
    canopy, ground = np.concatenate(pulses, axis=1)
    rule = LightRule(1.0 if given is None else given, None, "assumed" if given is None else "given")
    if given is None and canopy.sum() < LEAST_CANOPY * (canopy.sum() + ground.sum()):
        rule = replace(rule, source="no canopy")
    elif given is None and (found := estimate_canopy_ratio(canopy, ground)) is not None:
        rule = LightRule(found.ratio, found.error, "strip")
    light = canopy + rule.ratio * ground
    part, part_ground, whole, whole_ground = np.concatenate(packets, axis=1)
    share = (part + rule.ratio * part_ground) / (whole + rule.ratio * whole_ground)
    return replace(
        rule,
        usual=float(light[light > 0].mean()) if (light > 0).any() else 0.0,
        hidden_light=float(np.quantile(share, WEAKEST)) if len(share) else None,
    )
