"""A survey that knows the beam: how wide level ground's echoes are, and whether widths tell angles at all."""

from __future__ import annotations

from dataclasses import replace

from wavebatch.angles import predict_angles
from wavebatch.auto import ANGLE
from wavebatch.choice import sample_size
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.sensor import SensorRequest, find_sensor
from wavebatch.survey import Decision, Survey
from wavebatch.survey.levels import measure_level


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
