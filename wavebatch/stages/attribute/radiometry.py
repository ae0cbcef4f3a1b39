"""Physical attributes: range and backscatter. NaN where a value cannot be known, with the reason.

They need the sensor's position (`--trajectory`, or the packets' vectors), the calibration (`--calibration`) and the
beam's divergence (SYSTEM.toml). Without these a value is no-data, never a guess; relative quantities have stages of
their own. LAS packets have no place for the emitted pulse, so its energy, which varies from shot to shot, cannot be
divided out. Source: docs/algorithms.md 5.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.no_data import SUFFIX, NoData, explain
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.physics import radiometry
from wavebatch.stages.chain import stage

_POSITION = ("x", "y", "z")


@stage("attribute", makes=("range",), needs=_POSITION)
def range(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Distance from the sensor to each echo [m]; no-data where the sensor's position is not known."""
    distance = sensor_distance(block, echoes)
    return _with_reason(echoes.with_attributes(range=distance.astype(np.float32)), "range", _no_sensor(distance))


@stage("attribute", makes=("backscatter_coefficient", "backscatter_coefficient_err"), needs=_POSITION)
def backscatter_coefficient(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Cross section of each echo per illuminated area (gamma), and its error; no-data without sensor or calibration.

    gamma = C' R^2 A sigma / eta(R). Echoes of one pulse share its light: only the sum over the pulse is then a gamma.
    Unreliable (saturated) amplitudes give no-data.

    References
    ----------
    docs/algorithms.md 5.
    """
    light = _measure_light(block, system, echoes, 2)
    return _finish(echoes, "backscatter_coefficient", light.gamma, light.relative_error, *light.cases)


@stage("attribute", makes=("cross_section", "cross_section_err"), needs=_POSITION)
def cross_section(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Backscatter cross section of each echo [m2], and its error; no-data without sensor, calibration or divergence.

    C' pi divergence^2 / 4 R^4 A sigma / eta(R): an error of the range counts four times.

    References
    ----------
    docs/algorithms.md 5.
    """
    light = _measure_light(block, system, echoes, 4)
    divergence = np.nan if system.divergence is None else 1e-3 * system.divergence
    section = radiometry.cross_section(light.gamma, light.distance, divergence)
    unknown = (NoData.NO_DIVERGENCE, system.divergence is None)
    return _finish(echoes, "cross_section", section, light.relative_error, *light.cases[:2], unknown, *light.cases[2:])


@stage("attribute", makes=("reflectance", "reflectance_err"), needs=_POSITION)
def reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    surface: Literal["level", "echo", "facing"] = "level",
) -> EchoTable:  # fmt: skip
    """Diffuse reflectance of each echo that is alone in its waveform, and its error; no-data for all others.

    gamma / (4 cos(alpha)): only a target that fills the beam has a reflectance.

    Parameters
    ----------
    surface : {"level", "echo", "facing"}
        Where alpha comes from: level ground, the column incidence_angle of an earlier stage (no-data where it has
        none), or every surface taken as facing the sensor.

    References
    ----------
    docs/algorithms.md 5.
    """
    return _reflectance(block, echoes, "reflectance", _measure_light(block, system, echoes, 2), surface)


@stage("attribute", makes=("relative_backscatter", "relative_backscatter_err"), needs=_POSITION)
def relative_backscatter(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Backscatter of each echo in units of its strip [DN ns m2], and its error: for strips without calibration.

    R^2 A sigma / eta(R): gamma without the constant C'. Echoes of one strip compare with each other only.
    """
    light = _measure_light(block, _relative(system), echoes, 2)
    return _finish(echoes, "relative_backscatter", light.gamma, light.relative_error, *light.cases)


@stage("attribute", makes=("relative_cross_section", "relative_cross_section_err"), needs=_POSITION)
def relative_cross_section(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Cross section of each echo in units of its strip [DN ns m4], and its error: for strips without calibration.

    R^4 A sigma / eta(R): the cross section without C' pi divergence^2 / 4.
    """
    light = _measure_light(block, _relative(system), echoes, 4)
    section = light.gamma * (light.distance * light.distance)
    return _finish(echoes, "relative_cross_section", section, light.relative_error, *light.cases)


@stage("attribute", makes=("relative_reflectance", "relative_reflectance_err"), needs=_POSITION)
def relative_reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    surface: Literal["level", "echo", "facing"] = "level",
) -> EchoTable:  # fmt: skip
    """Reflectance of each echo that is alone in its waveform, in units of its strip [DN ns m2], and its error.

    R^2 A sigma / (4 cos(alpha) eta(R)): the reflectance without the constant C', for strips without calibration.

    Parameters
    ----------
    surface : {"level", "echo", "facing"}
        Where alpha comes from: level ground, the column incidence_angle of an earlier stage (no-data where it has
        none), or every surface taken as facing the sensor.
    """
    light = _measure_light(block, _relative(system), echoes, 2)
    return _reflectance(block, echoes, "relative_reflectance", light, surface)


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
        for axis, name in enumerate(_POSITION):
            off = echoes.attributes[name] - sensor[:, axis]
            squares += off * off
    return radiometry.known_distance(np.sqrt(squares))


def is_alone(block: WaveformBlock, echoes: EchoTable) -> np.ndarray:
    """Find echoes that are the only one of their waveform.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms.
    echoes : EchoTable
        m echoes.

    Returns
    -------
    bool array, shape (m,)
        True for single echoes.
    """
    return echoes.count(len(block))[echoes.waveform] == 1


class _Light(NamedTuple):
    """What m echoes of a block return; arrays (m,)."""

    distance: np.ndarray
    """[m]."""
    gamma: np.ndarray
    relative_error: np.ndarray
    """Of a quantity that grows with R^power."""
    cases: tuple[tuple[NoData, np.ndarray | bool], ...]
    """Why gamma may be missing."""


def _measure_light(block: WaveformBlock, system: SystemPulse, echoes: EchoTable, power: int) -> _Light:
    distance = sensor_distance(block, echoes)
    constant, constant_err = (values[echoes.waveform] for values in system.calibrate(block))
    guess = (echoes.flags & np.uint16(EchoFlag.AMPLITUDE_UNRELIABLE)) != 0
    amplitude = np.where(guess, np.nan, echoes.amplitude.astype(np.float64))
    with np.errstate(over="ignore", invalid="ignore"):
        gamma = radiometry.backscatter(constant, distance, amplitude, echoes.sigma, system.attenuation)
    energy = radiometry.energy_error(amplitude, echoes.sigma, echoes.amplitude_err, echoes.sigma_err)
    fit = echoes.attributes.get("range_err", np.zeros(len(echoes), np.float32)).astype(np.float64)
    away = np.hypot(system.sensor_error, fit)
    relative = radiometry.backscatter_error(energy, distance, away, constant_err, system.attenuation, power=power)
    cases = (_no_sensor(distance), (NoData.NOT_CALIBRATED, np.isnan(constant)), (NoData.SATURATED, guess))
    return _Light(distance, gamma, relative, cases)


def _relative(system: SystemPulse) -> SystemPulse:
    """Replace the calibration by a constant of exactly 1."""
    return replace(system, calibration=1.0, calibration_err=0.0, channels={})


def _no_sensor(distance: np.ndarray) -> tuple[NoData, np.ndarray]:
    return NoData.NO_SENSOR, np.isnan(distance)


def _reflectance(block: WaveformBlock, echoes: EchoTable, name: str, light: _Light, surface: str) -> EchoTable:
    angle, angle_err = _surface_angle(block, echoes, surface)
    alone = is_alone(block, echoes)
    rho = np.where(alone, radiometry.diffuse_reflectance(light.gamma, angle), np.nan)
    relative = radiometry.reflectance_error(light.relative_error, angle, angle_err)
    steep = angle >= radiometry.STEEPEST
    more = (NoData.SHARED_PULSE, ~alone), (NoData.NO_ANGLE, np.isnan(angle)), (NoData.TOO_STEEP, steep)
    return _finish(echoes, name, rho, relative, *light.cases, *more)


def _finish(
    echoes: EchoTable, name: str, values: np.ndarray, relative: np.ndarray, *cases: tuple[NoData, np.ndarray | bool]
) -> EchoTable:
    """Add a column, its error, and the reason where it is no-data."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = (np.abs(values) * relative).astype(np.float32)
        echoes = echoes.with_attributes(**{name: values.astype(np.float32), f"{name}_err": error})
    return _with_reason(echoes, name, *cases)


def _with_reason(echoes: EchoTable, name: str, *cases: tuple[NoData, np.ndarray | bool]) -> EchoTable:
    return echoes.with_attributes(**{f"{name}{SUFFIX}": explain(echoes.attributes[name], *cases)})


def _surface_angle(block: WaveformBlock, echoes: EchoTable, surface: str) -> tuple[np.ndarray, np.ndarray]:
    """Angle between ray and normal [rad] and its error, f8 (m,)."""
    none = np.zeros(len(echoes))
    if surface == "facing":
        return none, none
    if surface == "echo":
        unknown = np.full(len(echoes), np.nan)
        angle = echoes.attributes.get("incidence_angle", unknown)
        error = echoes.attributes.get("incidence_angle_err", unknown)
        return np.radians(angle.astype(np.float64)), np.radians(error.astype(np.float64))
    return level_angle(block)[echoes.waveform], none


def level_angle(block: WaveformBlock) -> np.ndarray:
    """Compute the angle at which each ray strikes level ground.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms with directions.

    Returns
    -------
    float64 array, shape (n,)
        Angle [rad].
    """
    x, y, z = block.direction.T
    with np.errstate(divide="ignore", invalid="ignore"):
        down = -z / np.sqrt(x * x + y * y + z * z)
    return np.arccos(np.clip(down, -1.0, 1.0))
