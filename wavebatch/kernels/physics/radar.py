"""The lidar equation: power that comes back from what the pulse meets (ALGORITHMS.md 1.5, equation 3)."""

from __future__ import annotations

import numpy as np


def pass_atmosphere(distance: np.ndarray, attenuation: float) -> np.ndarray:
    """Share of the light that gets through `distance` [m], one way; attenuation in dB per km."""
    return 10.0 ** (-distance * attenuation / 10_000.0)


def receive_power(
    cross_section: np.ndarray,
    distance: np.ndarray,
    *,
    transmitted: float,
    aperture: float,
    divergence: float,
    efficiency: float,
    attenuation: float,
) -> np.ndarray:
    """P = P_t D^2 Q T^2 sigma / (4 pi beta^2 R^4), in the unit of `transmitted`.

    cross_section [m2]; distance R from the sensor [m]; aperture D [m]; divergence beta: the full angle [rad];
    efficiency Q of the optics; attenuation of the air [dB/km], of which T is what is left after one way.
    """
    transmission = pass_atmosphere(distance, attenuation)
    whole = transmitted * aperture**2 * efficiency * transmission**2 * cross_section
    return whole / (4.0 * np.pi * divergence**2 * distance**4)


def spread_cross_section(reflectance: np.ndarray, distance: np.ndarray, divergence: float) -> np.ndarray:
    """Cross section [m2] of a diffuse surface of the reflectance that fills the footprint: 4 rho pi R^2 beta^2 / 4."""
    return 4.0 * reflectance * np.pi * (distance * divergence) ** 2 / 4.0
