"""The lidar equation: the power that a pulse returns (docs/algorithms.md 1.5, equation 3).

Used by the simulator.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.physics.radiometry import transmit


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
    """Received power P = P_t D^2 Q T^2 sigma / (4 pi beta^2 R^4).

    Parameters
    ----------
    cross_section : float (m,), m2
        sigma.
    distance : float (m,), m
        R, from the sensor.
    transmitted : float
        P_t, in any unit.
    aperture : float, m
        Diameter D of the receiver.
    divergence : float, rad
        Full angle beta of the beam.
    efficiency : float
        Q of the optics, 0 to 1.
    attenuation : float, dB/km
        Of the air; T is the share left after one way.

    Returns
    -------
    float64 (m,), unit of `transmitted`
    """
    whole = transmitted * aperture**2 * efficiency * transmit(distance, attenuation) * cross_section
    return whole / (4.0 * np.pi * divergence**2 * distance**4)


def spread_cross_section(reflectance: np.ndarray, distance: np.ndarray, divergence: float) -> np.ndarray:
    """Cross section of a diffuse surface that fills the footprint: 4 rho pi R^2 beta^2 / 4.

    Parameters
    ----------
    reflectance : float
        rho.
    distance : float (m,), m
        R, from the sensor.
    divergence : float, rad
        Full angle beta of the beam.

    Returns
    -------
    float64 (m,), m2
    """
    return 4.0 * reflectance * np.pi * (distance * divergence) ** 2 / 4.0
