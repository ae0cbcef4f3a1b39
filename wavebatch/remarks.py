"""What to tell about a strip that is written: columns in which no echo has a value, why, and what to do."""

from __future__ import annotations

from wavebatch.angles import AngleOutlook, angle_parameters, predict_angles
from wavebatch.nodata import REASONS, NoData
from wavebatch.report import AMPLITUDE_BINS, RunReport
from wavebatch.work import Prepared

_ANGLE = "incidence_angle"


def find_remarks(prepared: Prepared, report: RunReport) -> tuple[str, ...]:
    """One line per column that was asked for and that no echo has, with the commonest reason and its remedy."""
    return tuple(
        _explain(prepared, report, column, counts)
        for column, counts in sorted(report.no_data.items())
        if counts and not counts.get(NoData.KNOWN.name)
    )


def _explain(prepared: Prepared, report: RunReport, column: str, counts: dict[str, int]) -> str:
    total = sum(counts.values())
    first = max(NoData, key=lambda reason: (counts.get(reason.name, 0), -reason))
    meaning, remedy = REASONS[first]
    share = f"{counts[first.name]} of them: " if counts[first.name] < total else ""
    if column == _ANGLE and first in (NoData.UNCERTAIN, NoData.SHORT_PULSE, NoData.TOO_STEEP):
        outlook = _look_out(prepared, report)
        meaning = f"{meaning}: {outlook.reason}" if outlook is not None else meaning
    return f"{column}: none of {total} echoes has one; {share}{meaning}; {remedy}"


def _look_out(prepared: Prepared, report: RunReport) -> AngleOutlook | None:
    """What the strip's widths are worth; None where distance or divergence is not known."""
    parameters = angle_parameters(prepared.job.chain) or {}
    divergence = parameters.get("divergence") or prepared.system.divergence
    distance = prepared.sensor.describe().get("distance_m")
    amplitude = AMPLITUDE_BINS.quantile(report.amplitude, 0.5)
    spacing = prepared.choice.survey.figures.get("spacing_ns")
    if not (divergence and distance and amplitude and spacing):
        return None
    return predict_angles(prepared.system, spacing, distance, divergence, amplitude, parameters["max_error"])
