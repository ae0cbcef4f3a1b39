"""A small simulator of strips over tilted planes: sub-rays of the footprint, each traced by itself, and summed.

Widths, energies and angles come out of geometry here, not out of the formulas that the physical columns use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from facet_strips import C_AIR, EAST, NORTH, START, Sensor, Stored, meet, render, write_pulses
from facet_strips import Facet as Plane

__all__ = ["EAST", "NORTH", "Flight", "Plane", "Truth", "match", "roofs", "write_strip"]


def roofs(degrees: Sequence[float], *, reflectance: float = 0.4, south: float = -100.0) -> list[Plane]:
    """Roofs that fall towards the east, each 16 m wide, one after the other from south to north, 2 m apart."""
    planes = []
    for number, degree in enumerate(degrees):
        low, slope = south + 18.0 * number, -np.tan(np.radians(degree))

        def inside(x: np.ndarray, y: np.ndarray, low: float = low) -> np.ndarray:
            return (y >= low) & (y < low + 16)

        planes.append(Plane(reflectance, (slope, 0.0), 3.0 + 50.0 * abs(slope), (0.0, low), inside))
    return planes


@dataclass(frozen=True)
class Flight:
    """Sensor, flight and recording."""

    pulse: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.64),)
    """Weight, delay [ns] and sigma [ns] of the Gaussians of the emitted pulse, weights of their heights."""
    divergence: float = 1.1
    """Full angle, 1/e2 [mrad]."""
    light: float = 1.4e8
    """Height of the echo of a white surface that faces the sensor at 1 m [DN m2]."""
    noise: float = 0.8
    height: float = 640.0
    half_angle: float = 12.0
    spacing: float = 0.5
    n_samples: int = 128
    bits: int = 16
    speed: float = 60.0
    rate: float = 100_000.0
    line_rate: float = 160.0
    air: float = 0.22
    """Attenuation [dB/km]."""
    energy_spread: float = 0.0
    """Relative standard deviation of the energies of the shots."""
    point_error: float = 0.01
    """Standard deviation of the vendor's points along the ray [m]."""
    store_energy: bool = False
    """Write the energy of each shot as the extra byte `shot_energy`."""

    @property
    def constant(self) -> float:
        """C' of these waveforms for a Gaussian pulse."""
        return 4.0 / (self.light * self.pulse[0][2])


@dataclass(frozen=True)
class Truth:
    """What is true of each pulse, arrays (n,), by GPS time."""

    gps_time: np.ndarray
    range: np.ndarray
    incidence: np.ndarray
    """[deg]."""
    reflectance: np.ndarray
    plane: np.ndarray
    """Number of the plane that the middle of the footprint meets."""
    pure: np.ndarray
    """Whether all of the footprint lies on this plane."""
    energy: np.ndarray
    """Of the shot, over its mean."""

    @property
    def gamma(self) -> np.ndarray:
        """Backscatter coefficient of a Lambertian surface."""
        return 4 * self.reflectance * np.cos(np.radians(self.incidence))


def write_strip(path: Path, planes: Sequence[Plane], flight: Flight, pulses: int, seed: int = 1) -> Truth:
    """Writes a strip; the first plane that a sub-ray meets counts."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(pulses) / flight.rate
    origin, ray = _fly(flight, seconds)
    share, unit = _split(ray, flight)
    distance, facing, plane = meet(origin, unit, planes)
    assert (plane >= 0).all(), "every sub-ray must meet a plane"
    hit, middle_facing, middle = meet(origin, ray[:, None], planes)
    reflect = np.array([one.reflectance for one in planes])
    energy = 1 + flight.energy_spread * rng.standard_normal(pulses)
    strength = flight.light * share * reflect[plane] * facing * 10.0 ** (-2e-4 * flight.air * distance) / distance**2
    strength *= energy[:, None]
    first = distance.min(axis=1) / C_AIR - 12.0 - rng.uniform(0, 1, pulses)
    wave = render(distance / C_AIR - first[:, None], strength, flight)
    counts = np.rint(20.0 + wave + flight.noise * rng.standard_normal(wave.shape))
    counts = np.clip(counts, 0, (1 << flight.bits) - 1).astype(np.uint16 if flight.bits > 8 else np.uint8)
    noisy = hit[:, 0] + flight.point_error * rng.standard_normal(pulses)
    sensor = Sensor(bits=flight.bits, n_samples=flight.n_samples, spacing=flight.spacing, energy_column="shot_energy",
                    store_energy=flight.store_energy)  # fmt: skip
    stored = Stored(origin, ray, first, noisy, facing)
    write_pulses(path, sensor, stored, seconds, np.ones(pulses, int), counts, 7.5 * energy)
    incidence = np.degrees(np.arccos(np.clip(middle_facing[:, 0], -1, 1)))
    pure = (plane == middle).all(axis=1)
    return Truth(START + seconds, hit[:, 0], incidence, reflect[middle[:, 0]], middle[:, 0], pure, energy)


def match(cloud_time: np.ndarray, truth: Truth) -> np.ndarray:
    """Row of the truth for each point of a cloud."""
    return np.searchsorted(truth.gps_time, cloud_time - 1e-7)


def _fly(flight: Flight, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the sensor and unit rays (n, 3); east is ahead, lines are swept from north to south."""
    origin = np.stack([flight.speed * seconds, 0.5 * np.sin(0.3 * seconds), flight.height + np.sin(0.2 * seconds)], 1)
    angle = np.radians(flight.half_angle) * (1.0 - 2.0 * ((seconds * flight.line_rate) % 1.0))
    ray = np.stack([np.full(len(angle), 0.03), np.tan(angle), np.full(len(angle), -1.0)], axis=1)
    return origin, ray / np.linalg.norm(ray, axis=1)[:, None]


def _split(ray: np.ndarray, flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the energy (k,), and unit vectors (n, k, 3), of the sub-rays of a Gaussian beam.

    Rings at Gauss-Laguerre nodes and evenly spaced turns: moments of the beam up to the eleventh are exact.
    """
    nodes, weights = np.polynomial.laguerre.laggauss(6)
    turns = np.arange(12) * (2 * np.pi / 12)
    radius = 0.5e-3 * flight.divergence * np.sqrt(nodes / 2)
    side = np.cross(ray, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=1)[:, None]
    up = np.cross(ray, side)
    off_side, off_up = (np.outer(radius, wave(turns)).ravel() for wave in (np.cos, np.sin))
    unit = ray[:, None] + off_side[:, None] * side[:, None] + off_up[:, None] * up[:, None]
    return np.repeat(weights / 12, 12), unit / np.linalg.norm(unit, axis=2)[..., None]
