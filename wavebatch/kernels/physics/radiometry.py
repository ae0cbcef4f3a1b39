"""The light of an echo: the stages of radiometry, the calibration, the voxels and the simulator call it.

From amplitude and width to backscatter: calibration, cross section, reflectance and their errors (docs/algorithms.md
5). Everything is float64, because the range enters with its fourth power (docs/algorithms.md H13). Unknown inputs are
NaN and give NaN. `receive_power` is the lidar equation: the power that a pulse returns (docs/algorithms.md 1.5,
equation 3). `judge_energies` says whether the light of a strip follows the energies of `--energy`;
`matching.strip_energies` asks it.
"""

from __future__ import annotations

import math

import numpy as np

from wavebatch.core.units import AIR_ATTENUATION

ENERGY_CORRELATION = -1.0 / math.sqrt(3.0)
"""Correlation of the errors of amplitude and sigma of an isolated Gaussian echo (docs/algorithms.md 2.1)."""

STEEPEST = math.radians(85.0)
"""Angle of incidence above which no reflectance is given: an error of 0.5 degrees changes it by 10 % there."""


def transmit(distance: np.ndarray, attenuation: float) -> np.ndarray:
    """Share of the light that the atmosphere leaves on the way to a target and back.

    Parameters
    ----------
    distance : float (m,), m
        Sensor to target.
    attenuation : float, dB/km
        One way.

    Returns
    -------
    float64 (m,)
        eta_atm = 10^(-2 R a / 10000) (docs/algorithms.md 5).
    """
    return 10.0 ** (-2.0e-4 * attenuation * np.asarray(distance, np.float64))


def attenuation_of_visibility(visibility: float, wavelength: float) -> float:
    """Attenuation of hazy air by its meteorological visibility.

    Parameters
    ----------
    visibility : float, km
        Largest distance at which a dark object is seen (contrast 2 %).
    wavelength : float, nm
        Of the laser.

    Returns
    -------
    float, dB/km
        One way. Scattering by haze only: absorption, as that of water vapour near 940, 1130 and 1400 nm, is not in it.

    References
    ----------
    Kruse, McGlauchlin, McQuistan (1962): 3.912 / V (wavelength / 550)^-q, q = 1.6 above 50 km, 1.3 above 6 km, else
    0.585 V^(1/3); docs/algorithms.md 5.
    """
    exponent = 1.6 if visibility > 50.0 else 1.3 if visibility > 6.0 else 0.585 * visibility ** (1.0 / 3.0)
    return 10.0 / math.log(10.0) * 3.912 / visibility * (wavelength / 550.0) ** -exponent


def usual_attenuation(wavelength: float) -> float:
    """Attenuation of clear air that nothing is known of.

    Parameters
    ----------
    wavelength : float, nm
        Of the laser.

    Returns
    -------
    float, dB/km
        One way: AIR_ATTENUATION at 1064 nm, elsewhere as haze scatters (`attenuation_of_visibility`).
    """
    visibility = 23.0  # km; the ratio is the same from 6 to 50
    ratio = attenuation_of_visibility(visibility, wavelength) / attenuation_of_visibility(visibility, 1064.0)
    return AIR_ATTENUATION * ratio


HAZE_HEIGHT, USUAL_HEIGHT = 2000.0, 700.0
"""Height over which haze falls to 1/e [m], 1000 to 3000 m by weather and season; and that of usual flights, up to which
AIR_ATTENUATION is the mean."""


def mean_haze(low: float, high: float) -> float:
    """Mean of the haze between two heights, over that of a usual flight above a coast.

    Parameters
    ----------
    low, high : float, m
        Of the ground and of the sensor above sea level; below it counts as sea level.

    Returns
    -------
    float
        1 up to 700 m, 0.93 up to 1000 m, 0.59 up to 3200 m.
    """
    ends, usual = -np.maximum([low, high], 0.0) / HAZE_HEIGHT, USUAL_HEIGHT / HAZE_HEIGHT
    layer = ends[0] - ends[1]
    mean = -math.expm1(-layer) / layer if layer > 0 else 1.0
    return float(math.exp(ends[0]) * mean * usual / -math.expm1(-usual))


def backscatter(
    constant: np.ndarray | float,
    distance: np.ndarray,
    amplitude: np.ndarray,
    sigma: np.ndarray | float,
    attenuation: float,
) -> np.ndarray:
    """Backscatter coefficient gamma: cross section per illuminated area, 4 rho cos(alpha) for a Lambertian target.

    Parameters
    ----------
    constant : float, 1/(m2 count ns)
        Calibration constant C' (docs/algorithms.md 5).
    distance : float (m,), m
        Sensor to echo.
    amplitude, sigma : float (m,), count, ns
        Of the echo.
    attenuation : float, dB/km
        Of the air, one way.

    Returns
    -------
    float64 (m,)
        NaN where the distance is not positive.
    """
    distance = known_distance(distance)
    light = distance * distance * np.asarray(amplitude, np.float64) * np.asarray(sigma, np.float64)
    return constant * light / transmit(distance, attenuation)


def compute_cross_section(gamma: np.ndarray, distance: np.ndarray, divergence: float) -> np.ndarray:
    """Backscatter cross section: gamma times the area that the beam illuminates.

    Parameters
    ----------
    gamma : float (m,)
        From `backscatter`.
    distance : float (m,), m
        Sensor to echo.
    divergence : float, rad
        Full angle between the 1/e^2 points.

    Returns
    -------
    float64 (m,), m2
    """
    distance = known_distance(distance)
    return np.asarray(gamma, np.float64) * (0.25 * math.pi * divergence * divergence) * (distance * distance)


def diffuse_reflectance(gamma: np.ndarray, incidence: np.ndarray) -> np.ndarray:
    """Reflectance of a Lambertian target that fills the beam.

    Parameters
    ----------
    gamma : float (m,)
        From `backscatter`.
    incidence : float (m,), rad
        Angle of incidence.

    Returns
    -------
    float64 (m,)
        NaN above 85 degrees.
    """
    facing = np.cos(incidence)
    return np.asarray(gamma, np.float64) / (4.0 * np.where(facing > math.cos(STEEPEST), facing, np.nan))


def energy_error(
    amplitude: np.ndarray, sigma: np.ndarray, amplitude_err: np.ndarray, sigma_err: np.ndarray
) -> np.ndarray:
    """Relative standard deviation of amplitude times sigma of a lone echo: errors with the correlation -1/sqrt(3).

    Parameters
    ----------
    amplitude, sigma, amplitude_err, sigma_err : float (m,)
        Values and their standard deviations.

    Returns
    -------
    float64 (m,)
    """
    values = (np.asarray(value, np.float64) for value in (amplitude, sigma))
    a, s = (np.asarray(error, np.float64) / np.where(value > 0, value, np.nan)
            for error, value in zip((amplitude_err, sigma_err), values, strict=True))  # fmt: skip
    return np.sqrt(a * a + s * s + 2.0 * ENERGY_CORRELATION * a * s)


def backscatter_error(
    energy_err: np.ndarray,
    distance: np.ndarray,
    distance_err: np.ndarray | float,
    constant_err: np.ndarray | float,
    attenuation: float,
    *,
    power: int = 2,
    attenuation_err: float = 0.0,
) -> np.ndarray:
    """Relative standard deviation of gamma, or of the cross section.

    Parameters
    ----------
    energy_err : float (m,)
        From `energy_error`.
    distance, distance_err : float (m,), m
        Sensor to echo, and its standard deviation.
    constant_err : float
        Relative standard deviation of C'.
    attenuation : float, dB/km
        Of the air, one way.
    power : int
        Power of the distance: 2 for gamma, 4 for the cross section.
    attenuation_err : float, dB/km
        Standard deviation of the attenuation.

    Returns
    -------
    float64 (m,)
    """
    distance = known_distance(distance)
    per_db = 2.0e-4 * math.log(10.0)
    ranging = (power / distance + per_db * attenuation) * np.asarray(distance_err, np.float64)
    air = per_db * attenuation_err * distance
    return np.sqrt(energy_err * energy_err + ranging * ranging + constant_err * constant_err + air * air)


def slope_error(incidence: np.ndarray, slope: float) -> np.ndarray:
    """Relative error of a reflectance for which a surface of unknown slope was taken as level, of its value.

    Parameters
    ----------
    incidence : float (m,), rad
        Angle at which the ray strikes level ground.
    slope : float, rad
        Slope of the surface, in any direction.

    Returns
    -------
    float64 (m,)
        Root mean square over the directions of cos(incidence) / cos(true angle) - 1; for slopes that some rays graze
        it is large, not infinite.

    Notes
    -----
    A surface of slope d whose steepest direction is turned by p from the ray has cos(true angle) = cos(a) cos(d) -
    sin(a) sin(d) cos(p), a the angle to level ground; the true reflectance is the value times cos(a) / cos(true angle).
    """
    mean, turning = math.cos(slope), np.tan(incidence) * math.sin(slope)
    square = np.maximum(mean * mean - turning * turning, 0.01)
    return np.sqrt(np.maximum(mean / square**1.5 - 2.0 / np.sqrt(square) + 1.0, 0.0))


def reflectance_error(relative: np.ndarray, incidence: np.ndarray, incidence_err: np.ndarray) -> np.ndarray:
    """Relative standard deviation of the reflectance.

    Parameters
    ----------
    relative : float (m,)
        That of gamma.
    incidence, incidence_err : float (m,), rad
        Angle of incidence and its standard deviation.

    Returns
    -------
    float64 (m,)
    """
    return np.hypot(relative, np.tan(incidence) * incidence_err)


def known_distance(distance: np.ndarray) -> np.ndarray:
    """The distance in float64; NaN where it is not a positive number."""
    distance = np.asarray(distance, np.float64)
    return np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)


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


LEAST_SLOPE = 0.5
"""Light grows with the energy itself, slope 1; a shuffled log has 0, one that is off by a pulse -0.5."""

MOST_ERROR = 0.15
"""Slopes less certain than this say nothing: energies that hardly scatter, or plants."""


LOST_SLOPE = 0.05
"""What the slope of right energies lacks of 1, since steps between surfaces are clipped: .02 to .055 simulated."""


def judge_energies(light: np.ndarray, energy: np.ndarray) -> tuple[str, float]:
    """Find what contradicts the energies of pulses.

    Parameters
    ----------
    light : float (n,)
        Light that each pulse returned, in any unit, in the order of the pulses.
    energy : float (n,)
        Energy of each pulse; NaN where it is not known.

    Returns
    -------
    doubt : str
        Empty where light follows the energies, or where nothing shows it.
    noise : float
        Share of the variance of the energies' steps that light does not follow: an error of the log.

    Notes
    -----
    Neighbouring pulses mostly hit one surface, so that the logarithm of their light differs by that of their energies.
    The slope of the one over the other is fitted with steps between surfaces clipped, also for energies of the next
    pulse and of the one before.
    """
    slope, error = _fit_slope(light, energy)
    if not error <= MOST_ERROR or slope + 3.0 * error > LEAST_SLOPE:
        return "", max(1.0 - LOST_SLOPE - slope, 0.0) * (error <= MOST_ERROR)
    early, late = (_fit_slope(light, np.roll(energy, shift))[0] > LEAST_SLOPE for shift in (1, -1))
    cause = "come one pulse too early" if early else "come one pulse too late" if late else "are of other pulses"
    return f"light follows them with a slope of {slope:.2f} +- {error:.2f} where 1 is right; they {cause}", 1.0


def _fit_slope(light: np.ndarray, energy: np.ndarray) -> tuple[float, float]:
    """Slope of the steps of the logarithms from pulse to pulse, and its error; (0, inf) where nothing is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rise, step = np.diff(np.log(light))[1:-1], np.diff(np.log(energy))[1:-1]
    known = np.isfinite(rise) & np.isfinite(step)
    rise, step = rise[known], step[known]
    whole = float(np.sum(step * step))
    if not whole > 0:
        return 0.0, np.inf
    limit = 4.0 * float(np.median(np.abs(rise)))
    rise = np.clip(rise, -limit, limit)
    slope = float(np.sum(rise * step)) / whole
    # Steps of neighbours share a pulse, which makes the error larger by up to sqrt(2) than that of independent ones.
    return slope, float(np.sqrt(2.0 * np.mean((rise - slope * step) ** 2) / whole))
