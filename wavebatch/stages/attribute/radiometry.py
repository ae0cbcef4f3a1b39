"""Physical attributes: range and backscatter. NaN where a value cannot be known, with the reason.

They need the sensor's position (`--trajectory`, or the packets' vectors), the calibration (`--calibration`) and the
beam's divergence (SYSTEM.toml). Without these a value is no-data, never a guess; relative quantities have stages of
their own. Source: docs/algorithms.md 5.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.no_data import NoData
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.physics import radiometry
from wavebatch.stages.attribute.light import (
    POSITION,
    add_column,
    add_reason,
    fit_range_error,
    measure_light,
    sensor_distance,
    without_calibration,
)
from wavebatch.stages.chain import stage

RETURNS = 0.02
"""Scatter of vendors' returns along the ray [m], by data sheets: echoes are placed relative to these, and where a
packet has one return nothing shows how far it is off."""


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
