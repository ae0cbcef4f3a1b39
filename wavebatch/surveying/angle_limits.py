"""Whether the echo widths of a sensor can measure slopes at all: the error to expect, with the numbers it comes from.

`wavebatch survey --divergence` asks before a run, the report of a run asks afterwards.
Before you change it: stage attribute.incidence_angle must use the same limits, or predictions and columns disagree.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from wavebatch.core.frozen import frozen
from wavebatch.core.no_data import REASONS, NoData
from wavebatch.core.units import LEAST_PULSE_WIDTH
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.physics.incidence import angle_of_spread, angles_of_variance, spread_of_angle
from wavebatch.stages.chain import Chain
from wavebatch.surveying import Decision, Part, Survey
from wavebatch.surveying.choose_chain import sample_size
from wavebatch.surveying.flat_ground import GroundReference, measure_reference, sample_slopes
from wavebatch.surveying.sensor import SensorRequest, SensorSource, find_sensor

SLOPE = 30.0
"""Slope at which the error is predicted [deg]: widths are most sensitive there (docs/algorithms.md 1.4)."""

REFERENCE_ERROR = 0.003
"""Error of the system pulse's width, relative: the default of stage attribute.incidence_angle."""


@frozen
class AngleOutlook:
    """How good angles from widths will be on a strip."""

    error: float
    """Standard deviation of the angle of a plane at SLOPE [deg]; inf where widths say nothing about it."""
    max_error: float
    """Largest error, for a surface that faces the sensor, with which angles are written [deg]."""
    reason: str
    """The numbers as a sentence."""
    facing: float = np.inf
    """Standard deviation of the angle of a surface that faces the sensor [deg]: it decides what is written."""

    @property
    def possible(self) -> bool:
        """Whether angles would be written."""
        return self.facing <= self.max_error


def angle_parameters(chain: Chain) -> dict[str, Any] | None:
    """Return the parameters of a chain's last stage attribute.incidence_angle; None where it has none."""
    steps = [step for step in chain.steps if step.stage.name == "attribute.incidence_angle"]
    return steps[-1].effective() if steps else None


def predict_angles(
    system: SystemPulse, spacing: float, distance: float, divergence: float, amplitude: float, max_error: float = 10.0
) -> AngleOutlook:
    """Predict the error of angles from widths for echoes of a typical amplitude.

    Parameters
    ----------
    system : SystemPulse
    spacing : float
        Between samples [ns].
    distance : float
        Sensor to ground [m].
    divergence : float
        Full angle of the beam between the 1/e^2 points [mrad].
    amplitude : float
        Of a typical echo [count].
    max_error : float
        Largest error of an angle that is written [deg].

    Returns
    -------
    AngleOutlook

    Notes
    -----
    Width errors are the Cramer-Rao bound with the system's noise (docs/algorithms.md 2.1); the angle is that of 1.4.
    """
    width = system.sigma_ref / spacing
    own = float(np.sqrt(max(system.sigma_ref**2 + system.widths.variance, 1e-12)))
    if np.isinf(system.widths.error or 0.0):
        return AngleOutlook(np.inf, max_error, REASONS[NoData.NO_LEVEL][0])
    if width < LEAST_PULSE_WIDTH:
        needed = f"{LEAST_PULSE_WIDTH} are needed for widths to mean a slope"
        reason = f"the system pulse is {width:.2f} samples wide, {needed}"
        return AngleOutlook(np.inf, max_error, reason)
    added = float(spread_of_angle(np.radians(SLOPE), distance, 1e-3 * divergence))
    sigma = float(np.hypot(own, added))
    bound = float(bound_time(max(amplitude, 1e-3), sigma, system.noise.std, spacing))
    width_err = float(np.hypot(bound, system.widths.scatter))
    variance_err = np.hypot(2.0 * np.hypot(sigma * width_err, own * own * REFERENCE_ERROR), system.widths.error or 0.0)
    given, given_err, away = (np.array([value]) for value in (added * added, variance_err, distance))
    error = float(np.degrees(angles_of_variance(given, given_err, away, 1e-3 * divergence)[1][0]))
    flat_err = float(np.hypot(bound_time(max(amplitude, 1e-3), own, system.noise.std, spacing), system.widths.scatter))
    least = np.sqrt(np.hypot(2.0 * np.hypot(own * flat_err, own * own * REFERENCE_ERROR), system.widths.error or 0.0))
    facing = float(np.degrees(angle_of_spread(least, distance, 1e-3 * divergence)))
    reason = (
        f"at {distance:.0f} m, a beam of {divergence:g} mrad on a slope of {SLOPE:g} degrees widens the pulse from "
        f"{own:.3g} ns to {sigma:.4g} ns; echoes of {amplitude:.0f} DN with a noise of {system.noise.std:.3g} DN "
        f"give this width to {width_err:.2g} ns, so the angle to {error:.1f} degrees ({facing:.1f} where the surface "
        f"faces the sensor); max_error is {max_error:g}"
    )
    return AngleOutlook(error, max_error, reason, facing)


def sample_reference(
    reader: StripReader, scan: StripScan, source: SensorSource, system: SystemPulse, spacing: float
) -> GroundReference:
    """Measure the widths of surfaces of known slope on a sample of a strip; see `flat_ground.measure_reference`.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    source : SensorSource
        Positions of the sensor.
    system : SystemPulse
        With the beam's divergence, where it is known.
    spacing : float
        Of the samples that are used [ns].

    Returns
    -------
    Reference
    """
    return measure_reference(sample_slopes(reader, scan, source, sample_size(reader, scan)), system, spacing)


def survey_angles(reader: StripReader, scan: StripScan, survey: Survey, divergence: float | None) -> Survey:
    """Add the divergence, the variance of surfaces that face the sensor, and a decision about angles to a survey.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    survey : Survey
    divergence : float or None
        Full angle of the beam between the 1/e^2 points [mrad]; None: only the figure `divergence_seen_mrad` is added,
        where the widths of the strip show it.

    Returns
    -------
    Survey

    Raises
    ------
    InputError
        Where the coordinates are not in metres.
    """
    system = survey.system.with_radiometry(divergence=divergence)
    source = find_sensor(reader, scan, SensorRequest())
    spacing, figures = survey.figures.spacing_ns or 0.0, survey.figures
    seen = None if source.distance is None else sample_reference(reader, scan, source, system, spacing)
    if seen is not None and seen.divergence is not None:
        error = seen.divergence * seen.divergence_error
        figures = replace(figures, divergence_seen_mrad=seen.divergence, divergence_seen_error_mrad=error)
    if divergence is None:
        return replace(survey, figures=figures)
    if seen is None:
        outlook = AngleOutlook(np.inf, 0.0, "the sensor's position is unknown: give --trajectory to `wavebatch run`")
    else:
        system = seen.system
        outlook = predict_angles(system, spacing, source.distance or 0.0, divergence, figures.amplitude_50 or 0.0)
        if seen.doubt():
            outlook = replace(outlook, reason=f"{seen.doubt()}; {outlook.reason}")
    others = (decision for decision in survey.decisions if decision.part != Part.ANGLE)
    decisions = (*others, Decision(Part.ANGLE, outlook.possible, outlook.reason))
    return replace(survey, system=system, figures=figures, decisions=decisions)
