"""What an echo returns: distance, energy, backscatter and their errors. The physical stages are built on it.

`radiometry` and `width_angle` use it, and so do the calibration and the reference of level ground in `surveying`.
Before you change it: calibration and run must measure the energy of an echo in the same way (`echo_light`).
Source: docs/algorithms.md 5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.no_data import SUFFIX, NoData, explain_no_data
from wavebatch.core.units import FWHM_PER_SIGMA, SQRT_2PI
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.physics import radiometry
from wavebatch.stages.pulse_tables import BROADEST, describe_fitted, model_parameters, pulse_shape, shape_limits

POSITION = ("x", "y", "z")

Cases = tuple[tuple[NoData, np.ndarray | bool], ...]
"""Why values (m,) may be missing, in the order in which the reasons are tried."""


def sensor_distance(block: WaveformBlock, echoes: EchoTable) -> np.ndarray:
    """Measure the distance from the sensor to each echo.

    Parameters
    ----------
    block : WaveformBlock
        With the sensor's positions, where they are known.
    echoes : EchoTable
        With columns x, y and z; m echoes.

    Returns
    -------
    float64 array, shape (m,)
        Distance [m]; NaN where it is not known.
    """
    if block.sensor is None:
        return np.full(len(echoes), np.nan)
    sensor = block.sensor[echoes.waveform]
    squares = np.zeros(len(echoes))
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate(POSITION):
            off = echoes.attributes[name] - sensor[:, axis]
            squares += off * off
    return radiometry.known_distance(np.sqrt(squares))


def echo_light(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> np.ndarray:
    """Measure the energy of each echo as the amplitude times sigma of a Gaussian.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms.
    system : SystemPulse
        With the pulse that was fitted.
    echoes : EchoTable
        m fitted echoes.

    Returns
    -------
    float64 array, shape (m,)
        [count ns]. Of an echo of a surface that faces the sensor it is amplitude times sigma, whatever the pulse.

    Notes
    -----
    A slope widens a learned pulse as a whole and leaves its integral, but the height of its peak and the width of its
    main lobe do not change in proportion: their product grows by up to 6 % towards 75 degrees. The integral of each
    component is proportional to amplitude times width of the main one, which is used here (docs/algorithms.md 5).
    """
    amplitude, sigma = echoes.amplitude.astype(np.float64), echoes.sigma.astype(np.float64)
    shape, limits = pulse_shape(system, block.spacing), shape_limits(system, block.spacing, most=BROADEST)
    if not shape.components:
        return amplitude * sigma * area_factor(system, echoes) / exp(0.5 * system.kappa**2)
    whole = np.stack([amplitude, np.zeros(len(sigma)), sigma / block.spacing], axis=1)
    height, _, width = model_parameters(shape, limits, whole).T
    facing, _ = describe_fitted(shape, limits, np.array([[1.0, 0.0, limits.ref]]), np.ones((1, 3)), np.zeros((1, 2)))
    return height * width * (facing[0, 0] * facing[0, 2] / limits.ref) * block.spacing


def area_factor(system: SystemPulse, echoes: EchoTable) -> np.ndarray:
    """Area of each echo over that of a Gaussian of the same amplitude and sigma.

    Parameters
    ----------
    system : SystemPulse
        With the pulse that was fitted, none that was learned.
    echoes : EchoTable
        m fitted echoes.

    Returns
    -------
    float64 array, shape (m,)
        exp(kappa^2 / 2) of a skewed pulse, which may differ from echo to echo; of exp(-|z|^p / 2) by its exponent.
    """
    if "power" in echoes.attributes:
        import scipy.special  # here, because most runs need none of it

        power = echoes.attributes["power"].astype(np.float64)
        half_width = 2 * (2 * log(2)) ** (1 / power) / FWHM_PER_SIGMA
        return 2 ** (1 + 1 / power) * scipy.special.gamma(1 + 1 / power) / half_width / SQRT_2PI
    skew = np.asarray(echoes.attributes.get("skew", system.kappa), np.float64)
    return np.broadcast_to(exp(0.5 * skew**2), len(echoes))


def light_error(echoes: EchoTable) -> np.ndarray:
    """Relative standard deviation of `echo_light`, from the fit's covariance of amplitude and width.

    Parameters
    ----------
    echoes : EchoTable
        m fitted echoes.

    Returns
    -------
    float64 array, shape (m,)
        Where the decomposer gave no covariance, that of a lone Gaussian echo with the same errors.
    """
    fitted = echoes.relative_energy_err.astype(np.float64)
    if not np.isnan(fitted).any():
        return fitted
    lone = radiometry.energy_error(echoes.amplitude, echoes.sigma, echoes.amplitude_err, echoes.sigma_err)
    return np.where(np.isnan(fitted), lone, fitted)


AIR_DOUBT = 0.5
"""Relative error of the attenuation of the air where none is given: clear air has 0.1 to 0.5 dB/km."""

BOUND_ERROR = 0.5
"""Least relative error of the light of an echo whose fit ended at a bound: what it lacks its neighbours have, so that
sums over a pulse stay right."""


class Light(NamedTuple):
    """What m echoes of a block return; arrays (m,)."""

    distance: np.ndarray
    """[m]."""
    gamma: np.ndarray
    relative_error: np.ndarray
    """Of a quantity that grows with R^power."""
    bound: np.ndarray
    """Whether the fit ended at a bound: the light is an estimate."""
    cases: Cases
    """Why gamma may be missing."""


def measure_light(block: WaveformBlock, system: SystemPulse, echoes: EchoTable, power: int) -> Light:
    """Measure the backscatter coefficient of each echo.

    Parameters
    ----------
    block : WaveformBlock
        With the sensor's positions, where they are known.
    system : SystemPulse
        With the calibration.
    echoes : EchoTable
        m fitted echoes with positions.
    power : int
        Power of the range in the quantity that the error is for: 2 for gamma, 4 for the cross section.

    Returns
    -------
    Light
    """
    given = system.radiometry
    distance = sensor_distance(block, echoes)
    constant, constant_err = (values[echoes.waveform] for values in system.calibrate(block))
    guess = (echoes.flags & np.uint16(EchoFlag.AMPLITUDE_UNRELIABLE)) != 0
    bound = (echoes.flags & np.uint16(EchoFlag.AT_BOUND)) != 0
    energy, shot_error = (values[echoes.waveform] for values in _emitted(block, system))
    light = np.where(guess, np.nan, echo_light(block, system, echoes))
    with np.errstate(over="ignore", invalid="ignore"):
        gamma = radiometry.backscatter(constant, distance, light, 1.0, given.attenuation) / energy
    away = np.hypot(given.sensor_error, fit_range_error(echoes))
    relative = radiometry.backscatter_error(
        np.hypot(light_error(echoes), shot_error), distance, away, constant_err, given.attenuation,
        power=power, attenuation_err=given.attenuation_error,
    )  # fmt: skip
    relative = np.where(bound, np.hypot(relative, BOUND_ERROR), relative)
    cases = (
        (NoData.NO_SENSOR, np.isnan(distance)),
        (NoData.NOT_CALIBRATED, np.isnan(constant)),
        (NoData.NO_PULSE_ENERGY, np.isnan(energy)),
        (NoData.SATURATED, guess),
    )
    return Light(distance, gamma, relative, bound, cases)


def normalize_amplitude(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, reference: float
) -> tuple[np.ndarray, np.ndarray, Cases]:
    """Compute the amplitudes that echoes would have at a reference range.

    Parameters
    ----------
    block, system, echoes
        As for `measure_light`.
    reference : float
        Range [m].

    Returns
    -------
    value, relative : float64 array, shape (m,)
        Amplitudes [count] and their relative errors.
    cases : Cases
        Why values may be missing.
    """
    given = system.radiometry
    distance = sensor_distance(block, echoes)
    energy, shot_error = (values[echoes.waveform] for values in _emitted(block, system))
    guess = (echoes.flags & np.uint16(EchoFlag.AMPLITUDE_UNRELIABLE)) != 0
    bound = (echoes.flags & np.uint16(EchoFlag.AT_BOUND)) != 0
    amplitude = np.where(guess | bound, np.nan, echoes.amplitude.astype(np.float64))
    air = radiometry.transmit(np.asarray(reference), given.attenuation)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        value = radiometry.backscatter(air / reference**2, distance, amplitude, 1.0, given.attenuation) / energy
        fit = echoes.amplitude_err.astype(np.float64) / amplitude
    away = np.hypot(given.sensor_error, fit_range_error(echoes))
    relative = radiometry.backscatter_error(np.hypot(fit, shot_error), distance, away, 0.0, given.attenuation)
    # An error of the attenuation counts over the way by which the range differs from the reference.
    air_error = given.attenuation_error or AIR_DOUBT * given.attenuation
    beyond = 2.0e-4 * log(10.0) * air_error * np.abs(distance - reference)
    cases = (
        (NoData.NO_SENSOR, np.isnan(distance)),
        (NoData.NO_PULSE_ENERGY, np.isnan(energy)),
        (NoData.SATURATED, guess),
        (NoData.UNSETTLED, bound),
    )
    return value, np.hypot(relative, beyond), cases


def fit_range_error(echoes: EchoTable) -> np.ndarray:
    """Error of the range by the fit [m], f8 (m,); 0 where no stage has computed it."""
    return echoes.attributes.get("range_err", np.zeros(len(echoes), np.float32)).astype(np.float64)


def _emitted(block: WaveformBlock, system: SystemPulse) -> tuple[np.ndarray, np.ndarray]:
    """Energy of each emitted pulse over the strip's mean, NaN where unknown, and its relative error: f8 (n,)."""
    n = len(block)
    if block.pulse_energy is None:
        return np.ones(n), np.full(n, system.radiometry.shot_error)
    error = np.zeros(n) if block.pulse_energy_err is None else block.pulse_energy_err / block.pulse_energy
    return block.pulse_energy, error


def without_calibration(system: SystemPulse) -> SystemPulse:
    """Replace the calibration by a constant of exactly 1, for quantities in units of the strip."""
    return system.with_radiometry(constant=1.0, constant_error=0.0, channels={}, swath=())


def add_column(
    echoes: EchoTable, name: str, values: np.ndarray, relative: np.ndarray, *cases: tuple[NoData, np.ndarray | bool]
) -> EchoTable:
    """Add a column, its error, and the reason where it is no-data.

    Parameters
    ----------
    echoes : EchoTable
        m echoes.
    name : str
        Of the column; the error is `name`_err.
    values, relative : float64 array, shape (m,)
        Values and their relative errors.
    *cases : (NoData, bool or bool array)
        Why values may be missing.

    Returns
    -------
    EchoTable
    """
    with np.errstate(over="ignore", invalid="ignore"):
        error = (np.abs(values) * relative).astype(np.float32)
        echoes = echoes.with_attributes(**{name: values.astype(np.float32), f"{name}_err": error})
    return add_reason(echoes, name, *cases)


def add_reason(echoes: EchoTable, name: str, *cases: tuple[NoData, np.ndarray | bool]) -> EchoTable:
    """Add the reason why values of a column are missing; arguments as for `add_column`."""
    return echoes.with_attributes(**{f"{name}{SUFFIX}": explain_no_data(echoes.attributes[name], *cases)})
