"""What to tell about a strip that is written: columns without any value, why, and what to do; doubtful waveforms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from wavebatch.batch.counts import AMPLITUDE_BINS, RunReport
from wavebatch.batch.unit import Prepared
from wavebatch.core.no_data import REASONS, NoData
from wavebatch.surveying.angle_limits import AngleOutlook, angle_parameters, predict_angles
from wavebatch.surveying.sensor import SensorSource

_ANGLE = "incidence_angle"

LEAST_JUDGED = 20
"""Waveforms, or returns in waveforms with echoes, below which nothing is said about the strip."""

LEAST_MATCHED = 0.5
"""Share of those returns that an echo should match."""

INVERTED = 5.0
"""How much further counts reach below the baseline than above it, or than the noise, where signals go down."""

_NEEDS: dict[str, tuple[NoData, ...]] = {
    "range": (),
    "backscatter_coefficient": (NoData.NOT_CALIBRATED,),
    "cross_section": (NoData.NOT_CALIBRATED, NoData.NO_DIVERGENCE),
    "reflectance": (NoData.NOT_CALIBRATED,),
    _ANGLE: (NoData.NO_DIVERGENCE,),
}
"""Columns that mean something outside the file, and what they need beside the sensor's position."""

LEAST_DOUBT = 2.0
"""Median difference of ranges by the trajectory and by the packets' vectors that is told [m]."""


def find_remarks(prepared: Prepared, report: RunReport) -> tuple[str, ...]:
    """One line per column that was asked for and that no echo has, with the commonest reason and its remedy; one on
    angles where the beam tells next to none; one where waveforms and returns have next to nothing in common,
    and one on a trajectory at odds with the packets' vectors."""
    lines = [*_doubt_waveforms(prepared, report), *_doubt_trajectory(prepared.sensor)]
    for column, counts in sorted(report.no_data.items()):
        known, total = counts.get(NoData.KNOWN.name, 0), sum(counts.values())
        if total and not known:
            lines.append(_explain(prepared, report, column, counts))
        elif total and column == _ANGLE:
            outlook = _look_out(prepared, report)
            if outlook is not None and not outlook.possible:
                remedy = REASONS[NoData.UNCERTAIN][1]
                lines.append(f"{column}: {known} of {total} echoes have one, the widest: {outlook.reason}; {remedy}")
    return tuple(lines)


def _doubt_waveforms(prepared: Prepared, report: RunReport) -> Iterator[str]:
    """What speaks against the strip's waveforms, or against where its returns are said to lie in them."""
    waveforms, echoes, matched = (report.count(name) for name in ("waveforms", "echoes", "matched_returns"))
    near = matched + report.count("unmatched_returns")
    if waveforms >= LEAST_JUDGED and not echoes:
        figures, system = prepared.choice.survey.figures, prepared.system
        down = system.baseline - figures.get("least_count", system.baseline)
        up = figures.get("largest_count", system.baseline) - system.baseline
        reason = "nothing rises far enough above the noise"
        if down > INVERTED * max(up, system.noise_std):
            reason = f"the signal falls from {system.baseline:.0f} to {system.baseline - down:.0f} DN: it is inverted"
        yield f"none of {waveforms} waveforms holds an echo: {reason}; `wavebatch survey` says what the strip records"
    elif near >= LEAST_JUDGED and matched < LEAST_MATCHED * near:
        yield (
            f"only {matched} of {near} returns lie where their packet has an echo: the strip's return locations (which "
            "should be picoseconds after the first sample) are doubtful, and so are the positions of added echoes"
        )


def _doubt_trajectory(sensor: SensorSource) -> Iterator[str]:
    """What the packets' vectors say against a trajectory."""
    told = sensor.describe()
    farther, sure = told.get("farther_than_by_vectors_m"), told.get("by_vectors_error_m")
    if farther is not None and sure is not None and abs(farther) > max(LEAST_DOUBT, 5.0 * sure):
        which = "farther" if farther > 0 else "nearer"
        yield (
            f"range: by the trajectory echoes are {abs(farther):.1f} m {which} than by the packets' vectors, which "
            f"are sure to {sure:.2g} m; are the heights of one above the geoid, of the other above the ellipsoid?"
        )


def explain_absence(prepared: Prepared) -> dict[str, str]:
    """Why columns that need sensor, calibration or beam are not computed, by their names."""
    chain, system = prepared.job.chain, prepared.system
    lacks = {
        NoData.NOT_CALIBRATED: system.calibration is None,
        NoData.NO_DIVERGENCE: system.divergence is None,
    }
    told = {}
    for column, needs in _NEEDS.items():
        if column not in chain.makes:
            reason = next((REASONS[need][0] for need in needs if lacks[need]), None)
            told[column] = reason or f"the chain has no stage attribute.{column}"
    return told


def _explain(prepared: Prepared, report: RunReport, column: str, counts: Mapping[str, int]) -> str:
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
