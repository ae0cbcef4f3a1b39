"""From amplitude and width to backscatter: calibration, cross section, reflectance and their errors (ALGORITHMS.md 5).

Everything in float64: the range enters with its fourth power (H13). Whatever is not known is NaN, and stays NaN.
"""

from __future__ import annotations

import math

import numpy as np

ENERGY_CORRELATION = -1.0 / math.sqrt(3.0)
"""Of the errors of amplitude and sigma of an isolated Gaussian echo (2.1)."""

STEEPEST = math.radians(85.0)
"""Angle of incidence from which on nothing is said about reflectance."""


def transmit(distance: np.ndarray, attenuation: float) -> np.ndarray:
    """Share of the light that the atmosphere leaves on its way to a target at `distance` [m] and back.

    attenuation: one way [dB/km]. Source: ALGORITHMS.md 5, eta_atm = 10^(-2 R a / 10000).
    """
    return 10.0 ** (-2.0e-4 * attenuation * np.asarray(distance, np.float64))


def calibrate_echoes(
    reflectance: np.ndarray | float,
    incidence: np.ndarray | float,
    distance: np.ndarray,
    amplitude: np.ndarray,
    sigma: np.ndarray,
    attenuation: float,
) -> np.ndarray:
    """Calibration constant C' of each echo of a Lambertian reference of known reflectance [1/(m2 count ns)].

    incidence [rad]; distance [m]; amplitude [count]; sigma [ns]; attenuation [dB/km]. C_cal is C' pi divergence^2 / 4.
    Source: Wagner et al. 2010; ALGORITHMS.md 5.
    """
    distance = known_distance(distance)
    light = distance * distance * np.asarray(amplitude, np.float64) * np.asarray(sigma, np.float64)
    return 4.0 * np.asarray(reflectance) * np.cos(incidence) * transmit(distance, attenuation) / _positive(light)


def backscatter(
    constant: np.ndarray | float, distance: np.ndarray, amplitude: np.ndarray, sigma: np.ndarray, attenuation: float
) -> np.ndarray:
    """Backscatter coefficient gamma of each echo: cross section per illuminated area, 4 rho cos(alpha) if Lambertian.

    constant: C' of `calibrate_echoes`; the rest as there. NaN where the distance is not positive.
    """
    distance = known_distance(distance)
    light = distance * distance * np.asarray(amplitude, np.float64) * np.asarray(sigma, np.float64)
    return constant * light / transmit(distance, attenuation)


def cross_section(gamma: np.ndarray, distance: np.ndarray, divergence: float) -> np.ndarray:
    """Backscatter cross section [m2]: gamma times the area that the beam illuminates.

    distance [m]; divergence: full angle between the 1/e^2 points [rad].
    """
    distance = known_distance(distance)
    return np.asarray(gamma, np.float64) * (0.25 * math.pi * divergence * divergence) * (distance * distance)


def diffuse_reflectance(gamma: np.ndarray, incidence: np.ndarray) -> np.ndarray:
    """Reflectance of a Lambertian target that fills the beam, struck at `incidence` [rad]; NaN beyond 85 degrees."""
    facing = np.cos(incidence)
    return np.asarray(gamma, np.float64) / (4.0 * np.where(facing > math.cos(STEEPEST), facing, np.nan))


def energy_error(
    amplitude: np.ndarray, sigma: np.ndarray, amplitude_err: np.ndarray, sigma_err: np.ndarray
) -> np.ndarray:
    """Relative standard deviation of amplitude times sigma, whose errors are correlated by -1/sqrt(3)."""
    a = np.asarray(amplitude_err, np.float64) / _positive(amplitude)
    s = np.asarray(sigma_err, np.float64) / _positive(sigma)
    return np.sqrt(a * a + s * s + 2.0 * ENERGY_CORRELATION * a * s)


def backscatter_error(
    energy_err: np.ndarray,
    distance: np.ndarray,
    distance_err: np.ndarray | float,
    constant_err: np.ndarray | float,
    attenuation: float,
    *,
    power: int = 2,
) -> np.ndarray:
    """Relative standard deviation of gamma (power 2) or of the cross section (power 4).

    energy_err: from `energy_error`; distance and its error [m]; constant_err: of C', relative; attenuation [dB/km].
    """
    slope = power / known_distance(distance) + 2.0e-4 * attenuation * math.log(10.0)
    ranging = slope * np.asarray(distance_err, np.float64)
    return np.sqrt(energy_err * energy_err + ranging * ranging + constant_err * constant_err)


def reflectance_error(relative: np.ndarray, incidence: np.ndarray, incidence_err: np.ndarray) -> np.ndarray:
    """Relative standard deviation of the reflectance from that of gamma and the error of the angle [rad]."""
    return np.hypot(relative, np.tan(incidence) * incidence_err)


def known_distance(distance: np.ndarray) -> np.ndarray:
    """The distance in float64, NaN where it is not a positive number."""
    distance = np.asarray(distance, np.float64)
    return np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)


def _positive(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float64)
    return np.where(values > 0, values, np.nan)
