"""Attributes that mean something outside the file: range, backscatter, incidence angle; NaN where it cannot be known.

They need the sensor's position (`--trajectory`, or the packets' own vectors), the calibration (`--calibration`) and the
beam's divergence (SYSTEM.toml); without what they need they are no-data, never a guess. Source: ALGORITHMS 1.4, 5.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from wavebatch.blocks import EchoFlag, EchoTable, Noise, SystemPulse, WaveformBlock
from wavebatch.chain import stage
from wavebatch.kernels import radiometry
from wavebatch.kernels.incidence import angles_of_variance, paper_table, pulse_table, spread_variance
from wavebatch.stages.shapes import model_parameters, pulse_shape, shape_limits

LEAST_WIDTH = 0.85
"""Width of the system pulse [samples] below which fitted widths depend on where the samples lie (1.4)."""

_POSITION = ("x", "y", "z")
_UNCLEAN = EchoFlag.OVERLAPPED | EchoFlag.MERGED | EchoFlag.SATURATED | EchoFlag.NEAR_EDGE | EchoFlag.NOT_CONVERGED


@stage("attribute", makes=("range",), needs=_POSITION)
def range(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Distance from the sensor to each echo [m]; no-data where the sensor's position is not known."""
    return echoes.with_attributes(range=_distance(block, echoes).astype(np.float32))


@stage("attribute", makes=("backscatter_coefficient", "backscatter_coefficient_err"), needs=_POSITION)
def backscatter_coefficient(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Cross section of each echo per illuminated area (gamma), and its error; no-data without sensor or calibration.

    C' R^2 A sigma / eta(R). Echoes that share a pulse share its light: of those only the sum over the pulse is a gamma.
    Amplitudes that are guesses (saturated) give no-data.
    """
    gamma, relative = _backscatter(block, system, echoes, 2)
    return _with_error(echoes, "backscatter_coefficient", gamma, relative)


@stage("attribute", makes=("cross_section", "cross_section_err"), needs=_POSITION)
def cross_section(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Backscatter cross section of each echo [m2], and its error; no-data without sensor, calibration or divergence.

    C' pi divergence^2 / 4 R^4 A sigma / eta(R): an error of the range counts four times.
    """
    gamma, relative = _backscatter(block, system, echoes, 4)
    divergence = np.nan if system.divergence is None else 1e-3 * system.divergence
    section = radiometry.cross_section(gamma, _distance(block, echoes), divergence)
    return _with_error(echoes, "cross_section", section, relative)


@stage("attribute", makes=("reflectance", "reflectance_err"), needs=_POSITION)
def reflectance(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    *,
    surface: Literal["level", "echo", "facing"] = "level",
) -> EchoTable:
    """Diffuse reflectance of each echo that is alone in its waveform, and its error; no-data for all others.

    gamma / (4 cos(alpha)): only a target that fills the beam has a reflectance.

    surface: where alpha comes from: level ground, the column incidence_angle of a stage before (no-data where there is
        none), or every surface taken as facing the sensor.
    """
    gamma, relative = _backscatter(block, system, echoes, 2)
    angle, angle_err = _surface_angle(block, echoes, surface)
    alone = _is_alone(block, echoes)
    rho = np.where(alone, radiometry.diffuse_reflectance(gamma, angle), np.nan)
    return _with_error(echoes, "reflectance", rho, radiometry.reflectance_error(relative, angle, angle_err))


@stage("attribute", makes=("incidence_angle", "incidence_angle_err"), needs=_POSITION)
def incidence_angle(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    *,
    mode: Literal["system", "pulse", "paper"] = "system",
    divergence: float = 0.0,
    max_error: float = 10.0,
    reference_error: float = 0.003,
    alone: bool = True,
) -> EchoTable:
    """Angle between ray and surface normal of each echo [deg], from its width beyond the system pulse's; its error.

    A plane spreads the pulse by R divergence tan(alpha) / (2 c). No-data where the system pulse is shorter than 0.85
    samples, where sensor or divergence are not known, and where the angle is more uncertain than max_error: with a
    narrow beam and a long pulse that is everywhere. Echoes narrower than the system pulse have angle 0.
    Source: Rhomberg-Kauert et al. 2024 as corrected by ALGORITHMS 1.4.

    mode: system takes the pulse that the strip was fitted with; pulse a Gaussian fitted to t^2 exp(-t / tau) at the
        file's sampling; paper the printed formulas, which read angles too high.

    divergence: full angle of the beam between the 1/e^2 points [mrad]; 0 takes that of the system.

    max_error: largest standard deviation of an angle that is written [deg].

    reference_error: standard deviation of the system pulse's width, relative.

    alone: only echoes that are alone in their waveform; others fill a part of the beam, whose size nobody knows.
    """
    beam = divergence or system.divergence or np.nan
    if system.sigma_ref < LEAST_WIDTH * block.spacing:
        beam = np.nan
    variance, variance_err = _added_variance(block, system, echoes, mode, reference_error)
    angle, error = angles_of_variance(variance, variance_err, _distance(block, echoes), 1e-3 * beam)
    good = (echoes.flags & np.uint16(_UNCLEAN)) == 0
    if alone:
        good &= _is_alone(block, echoes)
    with np.errstate(invalid="ignore"):
        good &= error <= np.radians(max_error)
    angle, error = (np.degrees(np.where(good, values, np.nan)).astype(np.float32) for values in (angle, error))
    return echoes.with_attributes(incidence_angle=angle, incidence_angle_err=error)


def _distance(block: WaveformBlock, echoes: EchoTable) -> np.ndarray:
    """Sensor to echo [m], f8 (m,); NaN where it is not known."""
    if block.sensor is None:
        return np.full(len(echoes), np.nan)
    sensor = block.sensor[echoes.waveform]
    squares = np.zeros(len(echoes))
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate(_POSITION):
            off = echoes.attributes[name] - sensor[:, axis]
            squares += off * off
    return radiometry.known_distance(np.sqrt(squares))


def _is_alone(block: WaveformBlock, echoes: EchoTable) -> np.ndarray:
    return echoes.count(len(block))[echoes.waveform] == 1


def _backscatter(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, power: int
) -> tuple[np.ndarray, np.ndarray]:
    """gamma of each echo, and the relative error of what goes with R^power, f8 (m,)."""
    distance = _distance(block, echoes)
    constant = np.nan if system.calibration is None else system.calibration
    guess = (echoes.flags & np.uint16(EchoFlag.AMPLITUDE_UNRELIABLE)) != 0
    amplitude = np.where(guess, np.nan, echoes.amplitude.astype(np.float64))
    with np.errstate(over="ignore", invalid="ignore"):
        gamma = radiometry.backscatter(constant, distance, amplitude, echoes.sigma, system.attenuation)
    energy = radiometry.energy_error(amplitude, echoes.sigma, echoes.amplitude_err, echoes.sigma_err)
    fit = echoes.attributes.get("range_err", np.zeros(len(echoes), np.float32)).astype(np.float64)
    away = np.hypot(system.sensor_error, fit)
    relative = radiometry.backscatter_error(
        energy, distance, away, system.calibration_err, system.attenuation, power=power
    )
    return gamma, relative


def _with_error(echoes: EchoTable, name: str, values: np.ndarray, relative: np.ndarray) -> EchoTable:
    with np.errstate(over="ignore", invalid="ignore"):
        error = (np.abs(values) * relative).astype(np.float32)
        return echoes.with_attributes(**{name: values.astype(np.float32), f"{name}_err": error})


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
    x, y, z = block.direction.T
    with np.errstate(divide="ignore", invalid="ignore"):
        down = -z / np.sqrt(x * x + y * y + z * z)
    return np.arccos(np.clip(down, -1.0, 1.0))[echoes.waveform], none


def _added_variance(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, mode: str, reference_error: float
) -> tuple[np.ndarray, np.ndarray]:
    """Variance that the target adds to the pulse [ns2] and its standard deviation, f8 (m,)."""
    width, error = echoes.sigma.astype(np.float64), echoes.sigma_err.astype(np.float64)
    reference = system.sigma_ref
    if mode == "pulse":
        variance = spread_variance(pulse_table(system.sigma_ref, block.spacing), width)
    elif mode == "paper":
        variance = spread_variance(paper_table(system.sigma_ref), width)
    else:
        width, error, reference = _model_width(block.spacing, system, width, error)
        variance = width * width - reference * reference
    return variance, 2.0 * np.hypot(width * error, reference * reference * reference_error)


def _model_width(
    spacing: float, system: SystemPulse, sigma: np.ndarray, error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Width of the part of the fitted pulse that a target widens as a Gaussian does [ns], its error, the system's."""
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    if not shape.components:
        return sigma, error, system.sigma_ref
    one = np.ones_like(sigma)
    near = 1e-3 * system.sigma_ref / spacing
    whole = sigma / spacing
    low, middle, high = (
        model_parameters(shape, limits, np.stack([one, one, whole + step], axis=1))[:, 2] for step in (-near, 0.0, near)
    )
    return middle * spacing, error * (high - low) / (2.0 * near), limits.ref * spacing
