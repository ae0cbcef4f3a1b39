"""Whether echo widths of a sensor can tell angles of surfaces at all: the error to expect, and a sentence on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wavebatch.core.units import LEAST_PULSE_WIDTH
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.physics.incidence import angle_of_spread, angles_of_variance, spread_of_angle
from wavebatch.stages.chain import Chain
from wavebatch.surveying import Decision, Survey
from wavebatch.surveying.auto_chain import ANGLE
from wavebatch.surveying.choose_chain import sample_size
from wavebatch.surveying.flat_ground import measure_level
from wavebatch.surveying.sensor import SensorRequest, find_sensor

SLOPE = 30.0
"""Angle at which the error is predicted [deg]: where widths tell most (ALGORITHMS 1.4)."""

REFERENCE_ERROR = 0.003
"""Of the system pulse's width, relative, as stage incidence_angle takes it."""


@dataclass(frozen=True, slots=True)
class AngleOutlook:
    """What angles from widths are worth on a strip."""

    error: float
    """Standard deviation of the angle of a plane at SLOPE [deg]; inf where nothing is learned from a width."""
    max_error: float
    """Largest one that is written [deg]."""
    reason: str
    """All of it in numbers."""

    @property
    def possible(self) -> bool:
        """Whether angles at SLOPE would be written."""
        return self.error <= self.max_error


def angle_parameters(chain: Chain) -> dict[str, Any] | None:
    """Parameters with which a chain takes angles from widths; None where it takes none."""
    steps = [step for step in chain.steps if step.stage.name == "attribute.incidence_angle"]
    return steps[-1].effective() if steps else None


def predict_angles(
    system: SystemPulse, spacing: float, distance: float, divergence: float, amplitude: float, max_error: float = 10.0
) -> AngleOutlook:
    """The outlook for echoes of a typical amplitude [count] from `distance` [m] under a beam of `divergence` [mrad].

    spacing: between samples [ns]; max_error [deg]. Errors are those of the Cramer-Rao bound, in the system's noise.
    """
    width = system.sigma_ref / spacing
    own = float(np.sqrt(max(system.sigma_ref**2 + system.level_variance, 1e-12)))
    if width < LEAST_PULSE_WIDTH:
        needed = f"{LEAST_PULSE_WIDTH} are needed for widths to mean a slope"
        reason = f"the system pulse is {width:.2f} samples wide, {needed}"
        return AngleOutlook(np.inf, max_error, reason)
    added = float(spread_of_angle(np.radians(SLOPE), distance, 1e-3 * divergence))
    sigma = float(np.hypot(own, added))
    bound = float(bound_time(max(amplitude, 1e-3), sigma, system.noise_std, spacing))
    width_err = float(np.hypot(bound, system.width_scatter))
    variance_err = 2.0 * np.hypot(sigma * width_err, own * own * REFERENCE_ERROR)
    values = (np.array([value]) for value in (added * added, variance_err, distance))
    error = float(np.degrees(angles_of_variance(*values, 1e-3 * divergence)[1][0]))
    least = np.sqrt(2.0 * np.hypot(own * width_err, own * own * REFERENCE_ERROR))
    facing = float(np.degrees(angle_of_spread(least, distance, 1e-3 * divergence)))
    reason = (
        f"from {distance:.0f} m a beam of {divergence:g} mrad on a slope of {SLOPE:g} degrees widens the pulse of "
        f"{own:.3g} ns to {sigma:.4g} ns, which echoes of {amplitude:.0f} DN over a noise of {system.noise_std:.3g} DN "
        f"tell to {width_err:.2g} ns: that is an angle to {error:.1f} degrees ({facing:.1f} where it "
        f"faces the sensor), and max_error is {max_error:g}"
    )
    return AngleOutlook(error, max_error, reason)


def survey_angles(reader: StripReader, scan: StripScan, survey: Survey, divergence: float) -> Survey:
    """The survey with a beam of `divergence` [mrad], the variance of level ground, and a decision about angles.

    Raises InputError for strips that are not in metres.
    """
    system = replace(survey.system, divergence=divergence)
    source = find_sensor(reader, scan, SensorRequest())
    distance = source.describe().get("distance_m")
    if distance is None:
        reason = "nobody knows where the sensor was: give --trajectory to `wavebatch run`"
        return _decide(replace(survey, system=system), needed=False, reason=reason)
    spacing = survey.figures["spacing_ns"]
    blocks = (source.fill(block) for block in reader.sample_blocks(scan, sample_size(reader, scan)))
    system = measure_level(blocks, system, spacing)
    outlook = predict_angles(system, spacing, distance, divergence, survey.figures["amplitude_50"])
    return _decide(replace(survey, system=system), needed=outlook.possible, reason=outlook.reason)


def _decide(survey: Survey, *, needed: bool, reason: str) -> Survey:
    """The survey with this decision about angles in place of its own."""
    others = tuple(decision for decision in survey.decisions if decision.part != ANGLE)
    return replace(survey, decisions=(*others, Decision(ANGLE, needed, reason)))
