"""Physical attributes: range, backscatter and reflectance. NaN where a value cannot be known, with the reason.

They need the sensor's position (`--trajectory`, or the packets' vectors), the calibration (`--calibration`) and the
beam's divergence (SYSTEM.toml). Without these a value is no-data, never a guess. Relative quantities have stages of
their own: amplitudes as they would be at one range compare within a flight without any calibration. Source:
docs/algorithms.md 5.

Reflectance is that of surfaces that fill the beam, so it needs the angle at which the surface was struck. It comes
from the points around an echo (known after the second pass over the strip), or from the echo's width. Where neither is
known, a column of another name takes the surface as level, with an error for its unknown slope.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.no_data import SUFFIX, NoData
from wavebatch.core.system import angle_to_vertical
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.kernels.physics import radiometry
from wavebatch.stages.attribute.light import (
    POSITION,
    Light,
    add_column,
    add_reason,
    fit_range_error,
    measure_light,
    normalize_amplitude,
    sensor_distance,
    without_calibration,
)
from wavebatch.stages.chain import Range, stage

RETURNS = 0.02
"""Scatter of vendors' returns along the ray [m], by data sheets: echoes are placed relative to these, and where a
packet has one return nothing shows how far it is off."""


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

    The error holds that of the fit (range_err), of the sensor's position and mounting, and the scatter of the vendor's
    returns (2 cm). It is no-data where nothing shows how well the sensor's position is known.
    """
    distance = sensor_distance(block, echoes)
    error = np.hypot(np.hypot(fit_range_error(echoes), system.radiometry.sensor_error), RETURNS)
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


def hide_edges(echoes: EchoTable) -> EchoTable:
    """Leave out the level reflectance of echoes with the attribute `edge`: it is computed before edges are known."""
    name, edge = "level_reflectance", echoes.attributes["edge"]
    if name not in echoes.attributes:
        return echoes
    hidden = edge & np.isfinite(echoes.attributes[name])
    changed = {key: np.where(hidden, np.float32(np.nan), echoes.attributes[key]) for key in (name, f"{name}_err")}
    changed[f"{name}{SUFFIX}"] = np.where(hidden, np.uint8(NoData.EDGE), echoes.attributes[f"{name}{SUFFIX}"])
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
