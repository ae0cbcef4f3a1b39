"""Flight, scan and terrain: the ray of each pulse from its number alone, without random numbers.

`blocks` traces the rays of a scene. A scene names its terrain by a key of TERRAINS.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.units import HALF_C

AIR_SPEED = 0.9997 * HALF_C
"""One-way metres per two-way ns in air, as vendors store it."""

EAST, NORTH, GROUND = 500_000.0, 5_400_000.0, 120.0
"""South-west corner and height of the simulated land [m], UTM zone 32 north."""

START_TIME = 300_000_000.0
"""Adjusted standard GPS time of the first pulse [s]."""


@dataclass(frozen=True, slots=True)
class FlightLine:
    """How the aircraft flies and scans."""

    height: float = 800.0
    """Height above the lowest ground [m]."""
    speed: float = 60.0
    """[m/s], towards the east."""
    pulse_rate: float = 100_000.0
    """Pulses per second."""
    line_rate: float = 50.0
    """Scan lines per second, all swept from north to south."""
    half_angle: float = 25.0
    """Largest angle off nadir across the flight [deg]."""
    look_ahead: float = 4.0
    """Angle off nadir along the flight [deg]."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneRays:
    """Pulses in space: sensor, point on the ground, direction away from the sensor."""

    gps_time: np.ndarray
    """f8 (n,) [s]."""
    ground: np.ndarray
    """Where the ray meets the ground, f8 (n, 3) [m]."""
    direction: np.ndarray
    """f8 (n, 3) [m/ns], away from the sensor; length AIR_SPEED."""
    distance: np.ndarray
    """Sensor to ground [m], f8 (n,)."""
    incidence: np.ndarray
    """Angle between ray and the ground's normal [rad], f8 (n,)."""
    scan_angle: np.ndarray
    """Degrees off nadir, positive to the left of the flight (north), f8 (n,)."""


def trace_rays(flight: FlightLine, terrain: str, pulse: np.ndarray) -> SceneRays:
    """Rays of the pulses with the given numbers (n,) over the terrain."""
    seconds = pulse / flight.pulse_rate
    phase = (seconds * flight.line_rate) % 1.0
    sensor_x = EAST + flight.speed * seconds
    sensor_y = NORTH + 2.0 * np.sin(0.21 * seconds)
    sensor_z = GROUND + flight.height + 3.0 * np.sin(0.13 * seconds)
    angle = np.radians(flight.half_angle) * (1.0 - 2.0 * phase)
    x = sensor_x + flight.height * np.tan(np.radians(flight.look_ahead))
    y = sensor_y + flight.height * np.tan(angle)
    height, slope_x, slope_y = TERRAINS[terrain](x, y)
    z = GROUND + height
    dx, dy, dz = x - sensor_x, y - sensor_y, z - sensor_z
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    unit = np.stack([dx / distance, dy / distance, dz / distance], axis=1)
    facing = (slope_x * unit[:, 0] + slope_y * unit[:, 1] - unit[:, 2]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    return SceneRays(
        gps_time=START_TIME + seconds,
        ground=np.stack([x, y, z], axis=1),
        direction=unit * AIR_SPEED,
        distance=distance,
        incidence=np.arccos(np.clip(facing, 0.0872, 1.0)),
        scan_angle=np.degrees(np.arctan2(dy, -dz)),
    )


def _flat(x: np.ndarray, y: np.ndarray):
    zero = np.zeros_like(x)
    return zero, zero, zero


def _blocks(x: np.ndarray, y: np.ndarray):
    """Houses 8 to 20 m high, 25 m wide, every 60 m, on level ground."""
    i, j = np.floor(x / 60.0), np.floor(y / 60.0)
    roof = (x - 60.0 * i < 25.0) & (y - 60.0 * j < 25.0)
    zero = np.zeros_like(x)
    return np.where(roof, 8.0 + (7.0 * i + 11.0 * j) % 13.0, 0.0), zero, zero


def _hills(x: np.ndarray, y: np.ndarray):
    """Rolling ground: slopes up to 9 degrees."""
    a, b = (x - EAST) / 150.0, (y - NORTH) / 110.0
    return 12.0 * (np.sin(a) + np.cos(b)), 0.08 * np.cos(a), -12.0 / 110.0 * np.sin(b)


def _facets(x: np.ndarray, y: np.ndarray):
    """A zigzag roof along the scan: planes 40 m wide that rise and fall by 0, 10, 20, 30 and 40 degrees."""
    i = np.floor((y - NORTH) / 80.0)
    steep = np.tan(np.radians(10.0 * (i % 5)))
    across = (y - NORTH) - 80.0 * i
    rising = across < 40.0
    return steep * np.where(rising, across, 80.0 - across), np.zeros_like(x), np.where(rising, steep, -steep)


def _beach(x: np.ndarray, y: np.ndarray):
    """A beach that rises by 3 % to the north, with ripples."""
    ripple = (x - EAST) / 1.5
    return 0.03 * (y - NORTH) + 15.0 + 0.03 * np.sin(ripple), 0.02 * np.cos(ripple), np.full_like(x, 0.03)


def _village(x: np.ndarray, y: np.ndarray):
    """Houses 12 m wide every 24 m, eaves 4 m high, gable roofs of 0, 10, 20 ... 60 degrees, ridges along or across."""
    i, j = np.floor((x - EAST) / 24.0), np.floor((y - NORTH) / 24.0)
    along, across = (x - EAST) - 24.0 * i - 6.0, (y - NORTH) - 24.0 * j - 12.0
    roof = (np.abs(along) < 6.0) & (np.abs(across) < 6.0)
    steep = np.where(roof, np.tan(np.radians(10.0 * ((i + 3.0 * j) % 7))), 0.0)
    turned = (i + j) % 2 == 1
    from_ridge = np.where(turned, along, across)
    slope = -steep * np.sign(from_ridge)
    height = np.where(roof, 4.0 + steep * (6.0 - np.abs(from_ridge)), 0.0)
    return height, np.where(turned, slope, 0.0), np.where(turned, 0.0, slope)


TERRAINS = {
    "flat": _flat, "blocks": _blocks, "hills": _hills, "facets": _facets, "beach": _beach, "village": _village,
}  # fmt: skip
"""Ground by name: coordinates [m] to height above GROUND [m] and the two slopes."""
