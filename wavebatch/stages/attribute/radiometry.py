"""Physical attributes: range, backscatter and reflectance. NaN where a value cannot be known, with the reason.

Chains name the stages. They need the sensor's position (`--trajectory`, or the packets' vectors), the calibration
(`--calibration`) and the beam's divergence (SYSTEM.toml). Without these a value is no-data, never a guess. Relative
quantities have stages of their own: amplitudes as they would be at one range compare within a flight without any
calibration. Source: docs/algorithms.md 5.

What an echo returns, its distance, energy and backscatter with their errors (`measure_light`), is also what the
calibration, the reference of level ground in `surveying` and `basic` use. Before you change it:
calibration and run must measure the energy of an echo in the same way (`echo_light`).

Reflectance is that of surfaces that fill the beam, so it needs the angle at which the surface was struck. It comes
from the points around an echo (known after the second pass over the strip), or from the echo's width. Where neither is
known, a column of another name takes the surface as level, with an error for its unknown slope.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import SUFFIX, EchoFlag, EchoTable, NoData, explain_no_data
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.units import FWHM_PER_SIGMA, SQRT_2PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock, angle_to_vertical
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.physics import radiometry
from wavebatch.stages.chain import Range, stage
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
        [DN ns]. Of an echo of a surface that faces the sensor it is amplitude times sigma, whatever the pulse.

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
        Amplitudes [DN] and their relative errors.
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
    # Of one energy, a wider pulse is lower.
    fit = np.hypot(np.hypot(fit, shot_error), system.widths.scatter / system.sigma_ref)
    relative = radiometry.backscatter_error(fit, distance, away, 0.0, given.attenuation)
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


DECIBEL = 10.0 / math.log(10.0)
"""Decibel per unit of the natural logarithm."""


@stage("attribute", makes=("amplitude_normalized", "amplitude_normalized_err"), needs=POSITION)
def amplitude_normalized(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    reference_range: Annotated[float, Range(1.0, 1e5)] = 1000.0,
) -> EchoTable:  # fmt: skip
    """Amplitude that each echo would have at the reference range [DN], and its error: no calibration is needed.

    amplitude (R / R0)^2 eta(R0) / eta(R), divided by the energy of its pulse where that is given. Only echoes of
    surfaces that fill the beam fall with R^2; those of wires and leaves fall faster.

    Parameters
    ----------
    reference_range : float
        R0 [m]. Use the same one for all strips that shall compare.

    References
    ----------
    docs/algorithms.md 5.
    """
    value, relative, cases = normalize_amplitude(block, system, echoes, reference_range)
    return add_column(echoes, "amplitude_normalized", value, relative, *cases)


@stage("attribute", makes=("amplitude_normalized_db", "amplitude_normalized_db_err"), needs=POSITION)
def amplitude_normalized_db(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    reference_range: Annotated[float, Range(1.0, 1e5)] = 1000.0,
) -> EchoTable:  # fmt: skip
    """Amplitude that each echo would have at the reference range, in decibel over 1 DN, and its error.

    10 log10 of what attribute.amplitude_normalized gives.

    Parameters
    ----------
    reference_range : float
        R0 [m]. Use the same one for all strips that shall compare.

    References
    ----------
    docs/algorithms.md 5.
    """
    value, relative, cases = normalize_amplitude(block, system, echoes, reference_range)
    with np.errstate(invalid="ignore", divide="ignore"):
        decibel = DECIBEL * log(value)
        share = DECIBEL * relative / np.maximum(np.abs(decibel), 1e-30)
    return add_column(echoes, "amplitude_normalized_db", decibel, share, *cases)


@stage("attribute", makes=("range", "range_error"), needs=POSITION)
def range(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Distance from the sensor to each echo [m], and its error; no-data where the sensor's position is not known.

    Distances count from where the rays meet, or from the trajectory. The error holds that of the echo's place
    (range_err) and that of the sensor's; it is no-data where nothing shows how well the latter is known.
    """
    distance = sensor_distance(block, echoes)
    error = np.hypot(fit_range_error(echoes), system.radiometry.sensor_error)
    error[np.isnan(distance) | (system.radiometry.sensor_error <= 0)] = np.nan
    columns = {"range": distance.astype(np.float32), "range_error": error.astype(np.float32)}
    return add_reason(echoes.with_attributes(**columns), "range", (NoData.NO_SENSOR, np.isnan(distance)))


@stage("attribute", makes=("backscatter_coefficient", "backscatter_coefficient_err"), needs=POSITION)
def backscatter_coefficient(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Cross section of each echo per illuminated area (gamma), and its error; no-data without sensor or calibration.

    gamma = C' R^2 A sigma / eta(R). Echoes of one pulse share its light: only the sum over the pulse is then a gamma.
    Unreliable (saturated) amplitudes give no-data; fits that ended at a bound (AT_BOUND) give an estimate with an error
    of 50 % at least, which sums over pulses need. The error holds that of the fit (with the covariance of amplitude and
    width), range, air and constant, and the energy's scatter from shot to shot that the calibration measured.

    References
    ----------
    docs/algorithms.md 5.
    """
    light = measure_light(block, system, echoes, 2)
    return add_column(echoes, "backscatter_coefficient", light.gamma, light.relative_error, *light.cases)


@stage("attribute", makes=("cross_section", "cross_section_err"), needs=POSITION)
def cross_section(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Backscatter cross section of each echo [m2], and its error; no-data without sensor, calibration or divergence.

    C' pi divergence^2 / 4 R^4 A sigma / eta(R): an error of the range counts four times, one of the divergence twice.

    References
    ----------
    docs/algorithms.md 5.
    """
    light = measure_light(block, system, echoes, 4)
    divergence = np.nan if system.radiometry.divergence is None else 1e-3 * system.radiometry.divergence
    section = radiometry.compute_cross_section(light.gamma, light.distance, divergence)
    unknown = (NoData.NO_DIVERGENCE, system.radiometry.divergence is None)
    relative = np.hypot(light.relative_error, 2.0 * system.radiometry.divergence_error)
    return add_column(echoes, "cross_section", section, relative, *light.cases[:2], unknown, *light.cases[2:])


@stage("attribute", makes=("relative_backscatter", "relative_backscatter_err"), needs=POSITION)
def relative_backscatter(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Backscatter of each echo in units of its strip [DN ns m2], and its error: for strips without calibration.

    R^2 A sigma / eta(R): gamma without the constant C'. Echoes of one strip compare with each other only.
    """
    light = measure_light(block, without_calibration(system), echoes, 2)
    return add_column(echoes, "relative_backscatter", light.gamma, light.relative_error, *light.cases)


@stage("attribute", makes=("relative_cross_section", "relative_cross_section_err"), needs=POSITION)
def relative_cross_section(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Cross section of each echo in units of its strip [DN ns m4], and its error: for strips without calibration.

    R^4 A sigma / eta(R): the cross section without C' pi divergence^2 / 4.
    """
    light = measure_light(block, without_calibration(system), echoes, 4)
    section = light.gamma * (light.distance * light.distance)
    return add_column(echoes, "relative_cross_section", section, light.relative_error, *light.cases)


REFLECTANCES = ("level_reflectance", "reflectance", "relative_reflectance")
"""Columns that footprints over an edge do not have."""

_ANGLE = {"normals": "incidence_angle_normals", "echo": "incidence_angle"}
"""Column of the angle, by the parameter `surface`."""


def _needs(parameters: Mapping[str, Any]) -> tuple[str, ...]:
    angle = _ANGLE[parameters["surface"]]
    return (*POSITION, "range_err", angle, f"{angle}_err")


@stage("attribute", makes=("reflectance", "reflectance_err", "facing_reflectance"), needs=_needs)
def reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    surface: Literal["normals", "echo"] = "normals",
) -> EchoTable:  # fmt: skip
    """Diffuse reflectance of each echo that is alone in its waveform, and its error; no-data for all others.

    gamma / (4 cos(alpha)): only a target that fills the beam has a reflectance. Its error holds that of the angle. With
    `normals`, `run` computes it in the second pass; a block alone gives no-data.

    Parameters
    ----------
    surface : {"normals", "echo"}
        Where alpha comes from: the points around the echo (column incidence_angle_normals of an earlier stage), or its
        width (column incidence_angle of an earlier stage). No-data where that column has none.

    References
    ----------
    docs/algorithms.md 5.
    """
    light = measure_light(block, system, echoes, 2)
    facing = _divide(block, echoes, "reflectance", light, np.zeros(len(echoes)), light.relative_error)
    echoes = echoes.with_attributes(facing_reflectance=facing.attributes["reflectance"])
    return _reflectance(block, echoes, "reflectance", light, surface)


@stage("attribute", makes=("relative_reflectance", "relative_reflectance_err"), needs=_needs)
def relative_reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    surface: Literal["normals", "echo"] = "normals",
) -> EchoTable:  # fmt: skip
    """Reflectance of each echo that is alone in its waveform, in units of its strip [DN ns m2], and its error.

    R^2 A sigma / (4 cos(alpha) eta(R)): the reflectance without the constant C', for strips without calibration.

    Parameters
    ----------
    surface : {"normals", "echo"}
        Where alpha comes from: the points around the echo (column incidence_angle_normals of an earlier stage), or its
        width (column incidence_angle of an earlier stage). No-data where that column has none.
    """
    light = measure_light(block, without_calibration(system), echoes, 2)
    return _reflectance(block, echoes, "relative_reflectance", light, surface)


@stage("attribute", makes=("level_reflectance", "level_reflectance_err"), needs=POSITION)
def level_reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    slope: Annotated[float, Range(0.0, 80.0)] = 30.0,
) -> EchoTable:  # fmt: skip
    """Diffuse reflectance of each echo alone in its waveform if its surface is level, and its error.

    gamma / (4 cos(angle of the ray to the vertical)). It needs no neighbours, but roofs and hillsides are not level:
    the error holds what a slope of `slope` degrees in an unknown direction does to it.

    Parameters
    ----------
    slope : float
        Slope of surfaces that the error shall cover [deg]; 0 where all of them are known to be level.

    References
    ----------
    docs/algorithms.md 5.
    """
    light, angle = measure_light(block, system, echoes, 2), angle_to_vertical(block.direction)[echoes.waveform]
    relative = np.hypot(light.relative_error, radiometry.slope_error(angle, np.radians(slope)))
    return _divide(block, echoes, "level_reflectance", light, angle, relative)


def hide_values(echoes: EchoTable, name: str, where: np.ndarray, reason: NoData) -> EchoTable:
    """Leave out the values of a column where that turns out to be no data only later, bool (m,)."""
    if name not in echoes.attributes:
        return echoes
    hidden = where & np.isfinite(echoes.attributes[name])
    changed = {key: np.where(hidden, np.float32(np.nan), echoes.attributes[key]) for key in (name, f"{name}_err")}
    changed[f"{name}{SUFFIX}"] = np.where(hidden, np.uint8(reason), echoes.attributes[f"{name}{SUFFIX}"])
    return echoes.with_attributes(**changed)


def _reflectance(block: WaveformBlock, echoes: EchoTable, name: str, light: Light, surface: str) -> EchoTable:
    """The column for surfaces struck at the angle that another column has."""
    unknown = np.full(len(echoes), np.nan)
    known = (echoes.attributes.get(key, unknown) for key in (_ANGLE[surface], f"{_ANGLE[surface]}_err"))
    angle, angle_err = (np.radians(values.astype(np.float64)) for values in known)
    relative = radiometry.reflectance_error(light.relative_error, angle, angle_err)
    edge = echoes.attributes.get("edge", np.zeros(len(echoes), bool))
    return _divide(block, echoes, name, light, angle, relative, edge)


def _divide(
    block: WaveformBlock, echoes: EchoTable, name: str, light: Light, angle: np.ndarray, relative: np.ndarray,
    edge: np.ndarray | bool = False,
) -> EchoTable:  # fmt: skip
    """The column gamma / (4 cos(angle)) of echoes that are alone, with relative errors (m,); edge: they may not be."""
    alone = echoes.alone(len(block))
    rho = np.where(alone & ~light.bound & ~np.asarray(edge), radiometry.diffuse_reflectance(light.gamma, angle), np.nan)
    steep = angle >= radiometry.STEEPEST
    more = (
        (NoData.UNSETTLED, light.bound), (NoData.SHARED_PULSE, ~alone), (NoData.NO_ANGLE, np.isnan(angle)),
        (NoData.TOO_STEEP, steep), (NoData.EDGE, edge),
    )  # fmt: skip
    return add_column(echoes, name, rho, relative, *light.cases, *more)
