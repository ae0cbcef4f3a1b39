"""Forests of discs with random normals, and the strips of a lidar above them: leaf area is known, ray by ray.

A pulse is a cone of sub-rays; each goes on to the first leaf in its way, or to the ground. Nothing here knows voxels.
"""

from typing import NamedTuple

import numpy as np
from packet_strips import record, render, write_recorded
from scipy.spatial import cKDTree

from wavebatch.core.units import HALF_C

RADIUS = 0.1
"""Of a leaf [m]."""

LEAF, SOIL = 0.5, 0.25
"""Reflectances."""

MARGIN = 14.0
"""Forest around the plot [m], for rays that come in from the side."""


EDGE = 7.0
"""Strip around the plot [m]: at a border without ground below it, the canopy is taken for ground."""


class Leaves(NamedTuple):
    """Discs above a plane that rises along x."""

    place: np.ndarray
    """Centres (n, 3) [m]."""
    normal: np.ndarray
    slope: float
    """Rise per metre."""

    def area_index(self, west, south, size):
        """Leaf area per ground area of a square."""
        x, y = self.place[:, 0], self.place[:, 1]
        inside = (x >= west) & (x < west + size) & (y >= south) & (y < south + size)
        return inside.sum() * np.pi * RADIUS**2 / size**2


def grow(rng, side, *, crowns, density, slope=0.0):
    """Leaves over a plot of `side` [m]; crowns: trees per m2 with ellipsoids of leaves, or None for an even layer.

    density: leaf area per volume [1/m], inside of a crown or of the layer from 4 to 14 m.
    """
    low, high = -MARGIN, side + MARGIN
    if crowns is None:
        number = rng.poisson(density * 10.0 * (high - low) ** 2 / (np.pi * RADIUS**2))
        place = np.column_stack([rng.uniform(low, high, (number, 2)), rng.uniform(4.0, 14.0, number)])
    else:
        trees = rng.poisson(crowns * (high - low) ** 2)
        parts = []
        for stem, tall, wide in zip(rng.uniform(low, high, (trees, 2)), rng.uniform(8, 20, trees),
                                    rng.uniform(1.5, 3.0, trees), strict=True):  # fmt: skip
            half = 0.35 * tall
            number = rng.poisson(density * 4 / 3 * np.pi * wide**2 * half / (np.pi * RADIUS**2))
            ball = rng.standard_normal((number, 3))
            ball *= (rng.random(number) ** (1 / 3) / np.linalg.norm(ball, axis=1))[:, None]
            parts.append(ball * [wide, wide, half] + [*stem, tall - half])
        place = np.concatenate(parts)
    place[:, 2] += 100.0 + slope * place[:, 0]
    normal = rng.standard_normal((len(place), 3))
    return Leaves(place, normal / np.linalg.norm(normal, axis=1)[:, None], slope)


def fly(path, rng, leaves, side, *, pulses=8.0, angle=0.0, footprint=0.3, split=False, rays=20, light=900.0):
    """A strip over the plot; `pulses` per m2, all at `angle` [deg] off the vertical, `split` into several packets.

    light: height of the echo of a white surface [count]; the noise is 0.6.
    """
    direction = np.array([np.sin(np.radians(angle)), 0.0, -np.cos(np.radians(angle))])
    n = int(pulses * (side + 2 * EDGE) ** 2)
    aim = rng.uniform(-EDGE, side + EDGE, (n, 2))  # where the middle of a pulse meets the height of 108 m
    across, along = np.array([np.cos(np.radians(angle)), 0.0, np.sin(np.radians(angle))]), np.array([0.0, 1.0, 0.0])
    centre = np.column_stack([aim, np.full(n, 108.0) + leaves.slope * aim[:, 0]])
    spread = footprint / 4.0 * rng.standard_normal((n, rays, 2))
    start = centre[:, None] + spread[..., :1] * across + spread[..., 1:] * along
    way, hit = _trace(start.reshape(-1, 3), direction, leaves)
    way = way.reshape(n, rays)  # from the plane through `centre`
    high = (centre[:, 2] + 26.0 + rng.uniform(0, 0.3, n) - centre[:, 2]) / -direction[2]  # back to the first sample [m]
    begin = centre - high[:, None] * direction
    pulse = np.repeat(np.arange(n), rays)
    energy = light * np.exp(0.05 * rng.standard_normal(n))[pulse] / rays
    amplitude = energy * np.where(hit, LEAF, SOIL)
    distance = (high[:, None] + way).ravel()
    top = np.full(n, 1000.0)
    counts = render(np.column_stack([pulse, top[pulse] - distance, amplitude]), top, 480, rng)
    ends = np.stack([way.min(axis=1), way.max(axis=1)], axis=1) + high[:, None]
    points = np.column_stack([np.repeat(np.arange(n), 2), (begin[:, None, 2] + ends * direction[2]).ravel()])
    packets = record(counts, 4) if split else None
    step = np.tile(direction * HALF_C, (n, 1))
    return write_recorded(path, counts, begin[:, 2], begin[:, :2], points, packets, direction=step)


def _trace(start, direction, leaves):
    """Way of each ray from its start to the first leaf or to the ground (n,), and whether it is a leaf."""
    level = np.array([-leaves.slope, 0.0, 1.0])
    ground = (100.0 - start @ level) / (direction @ level)
    axes = np.linalg.svd(direction[None])[2][1:]  # across the rays
    near = cKDTree(start @ axes.T).sparse_distance_matrix(
        cKDTree(leaves.place @ axes.T), RADIUS, output_type="ndarray"
    )
    ray, leaf = near["i"], near["j"]
    off = leaves.place[leaf] - start[ray]
    normal = leaves.normal[leaf]
    way = (off * normal).sum(axis=1) / (normal @ direction)
    inside = ((way[:, None] * direction - off) ** 2).sum(axis=1) <= RADIUS**2
    first = ground.copy()
    np.minimum.at(first, ray[inside], way[inside])
    return first, first < ground
