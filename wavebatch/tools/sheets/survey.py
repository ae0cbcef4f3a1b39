"""What a survey or a calibration found, as sheets: commands print them, and they are on the pages of `--html`.

`survey --angles` also gives the lookup table of a sensor: which echo width means which incidence angle, and how sure
that is, as .csv or drawn. The widths go through the functions of stage attribute.incidence_angle, so that the table is
what a run writes for surfaces that fill the beam.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.units import FWHM_PER_SIGMA, count, format_measure, format_relative
from wavebatch.core.waveforms import SystemPulse, WaveformBlock, swath_columns
from wavebatch.files.figure_file import open_picture, plain_text, set_head
from wavebatch.files.text_file import write_text
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.physics.incidence import angle_of_spread, spread_of_angle
from wavebatch.stages.attribute.basic import added_variance
from wavebatch.surveying.flat_ground import REFERENCE_ERROR
from wavebatch.surveying.systems.survey_result import Survey, name_model
from wavebatch.tools.sheets import sheet as sheets
from wavebatch.tools.sheets.sheet import Cell, Code, Fact, Later, Note, Picture, Sheet, SheetPart, Table, list_facts

if TYPE_CHECKING:
    from wavebatch.surveying.calibrating.calibrate_flight import FlightCalibration

NOISE_KINDS = {
    "quiet": "quiet samples",
    "quiet_pulse": "quiet samples, as a pulse sees it",
    "core": "left by fits in strong echoes",
    "weak_echoes": "left by fits in weak echoes",
}
"""Names of the ways in which noise is measured; as a pulse sees it: noise of its amplitude, as that of one sample."""

MOST_DRAWN = 6
"""Strips of a flight whose waveforms are on a page."""


def survey_sheet(survey: Survey, document: Mapping[str, Any]) -> Sheet:
    """The sheet of a survey; document: what `survey --json` prints, or its `decisions` alone for the page of a run."""
    rows = [["yes" if one["needed"] else "no", one["part"], one["reason"]] for one in document["decisions"]]
    decisions = Table(("decisions", "part of the chain", "reason"), rows)
    chosen = [decisions] if rows else [Note("The survey did not choose the chain: the user gave it.")]
    pictures = Later(partial(_draw_survey, survey))
    return Sheet("Survey", [*_list_survey(survey, document), pictures, Sheet("Decisions", chosen)])


def list_doubts(document: Mapping[str, Any]) -> list[Note]:
    """What is doubtful, also of single strips of a flight."""
    strips = [f"{strip['strip']}: {one['text']}" for strip in document.get("strips", ()) for one in strip["warnings"]]
    return [Note(words, "warning") for words in (*strips, *(one["text"] for one in document["warnings"]))]


def _list_survey(survey: Survey, document: Mapping[str, Any]) -> Iterator[SheetPart]:
    """What was surveyed, noise, pulse, and what the waveforms hold; figures that an old file lacks are left out."""
    system, figures = survey.system, survey.figures
    if "points" in document:
        size = f"{count(document['points'], 'point')}, {count(document['packets'], 'packet')}"
        strips = document.get("strips")
        if strips is None:
            yield Fact("strip", f"{document['strip']}: {size}")
        else:
            yield Fact("strips", f"{sum(one['fits'] for one in strips)} of {len(strips)} belong together: {size}")
            odd = [f"{one['strip']}: does not belong to them: {one['reason']}" for one in strips if not one["fits"]]
            yield from (Note(f"  {words}") for words in odd)
    yield Fact("surveyed", count(survey.waveforms, "waveform") if survey.waveforms else "not known")
    if figures.samples:
        yield Fact("samples", figures.samples)
    if figures.least_count is not None and figures.largest_count is not None:
        yield Fact("ADC range", f"counts {round(figures.least_count)} to {round(figures.largest_count)}")
    if "direction" in document:
        yield Fact("vectors", f"{document['direction']['sign']} the sensor: {document['direction']['evidence']}")
    # Noise
    noise, strong = system.noise, figures.amplitude_99
    yield Fact("baseline", f"{noise.baseline:.3f} DN, +-{noise.baseline_spread:.3f} DN between waveforms")
    yield Fact("noise", f"{noise.std:.3f} DN for thresholds and errors" + (", chosen from" if noise.by_kind else ""))
    for kind, value in noise.by_kind.items():
        known = f"{value:.3f} DN" if value > 0 else "not known: too few samples"
        yield Fact(f"  {NOISE_KINDS.get(kind, kind.replace('_', ' '))}", known)
    grown = "" if strong is None else f", {noise.gain * strong:.2f} DN2 at {strong:.0f} DN"
    yield Fact("signal noise", f"variance grows by {noise.gain:.4f} DN2 per DN{grown}" if noise.gain > 0 else "none")
    # Pulse
    width = f"s_ref {system.sigma_ref:.4f} ns, full width at half maximum {system.sigma_ref * FWHM_PER_SIGMA:.3f} ns"
    yield Fact("system pulse", f"{name_model(system)}; {width}")
    yield Table(("Gaussians: weight", "delay ns", "sigma ns"), system.components, (".4f", ".3f", ".3f"))
    if figures.sent_fwhm_ns is not None:
        width = f"full width at half maximum {figures.sent_fwhm_ns:.3f} ns, as import found it"
        yield Fact("outgoing pulses", width)
    like = document.get("looks_like")
    if like is not None:
        taken = f"{like['sensor']}: its shipped pulse is used"
        yield Fact("sensor", taken if like["taken"] else like["sentence"])
    heads = ("pulses tried", "nats per waveform", "full width ns", "change", "echoes each", "longer by errors")
    rows = [(one.name, one.nats, one.fwhm_ns, one.change, one.echoes_per_waveform,
             Cell("chosen" if one.chosen else f"{one.longer_by:.1f}", one.longer_by)) for one in survey.candidates]
    # The fewest nats describe a waveform best; the change is that of the pulse from shot to shot.
    yield Table(heads, rows, ("", ".2f", ".3f", ".1%", ".3f", ""))
    if any(one.longer_by < 0 for one in survey.candidates):
        yield Note("  below 0: describes the waveforms shorter, but saves too little per echo, or needs more echoes")
    if figures.false_in_noise_share is not None:
        shares = figures.false_in_noise_share, figures.false_by_misfit_share
        by_noise, misfit = (f"{100 * share:.2g}" for share in shares)
        words = f"of 100 echoes about {by_noise} noise (in quiet); beside 100 strong ones about {misfit} of misfit"
        words += f"; {100 * figures.placed_share:.2g} repeat beside stronger ones" if figures.placed_share else ""
        yield Fact("false echoes", words)
    yield Fact("kappa", f"{figures.kappa:z.4f}" if figures.kappa is not None else "not known")
    yield Fact("ringing", f"{100 * system.ringing:.2f} % of the amplitude at most")
    yield Fact("acceptance", f"one more echo must lower chi2 by {system.acceptance:g}")
    if system.misfit:
        yield Fact("misfit", f"{100 * system.misfit:.2g} % of the amplitude; residuals below it add no echo")
    if figures.divergence_seen_mrad is not None:
        seen = format_measure(figures.divergence_seen_mrad, figures.divergence_seen_error_mrad)
        words = "mrad by the widths of echoes over the slopes of their surfaces, if these are plane"
        yield Fact("beam", f"{seen} {words}")
    for index, one in system.digitizers.items():
        levels = f"baseline {one.noise.baseline:.3f} DN, noise {one.noise.std:.3f} DN"
        yield Fact(f"digitizer {index}", f"{levels}; {name_model(one)}; s_ref {one.sigma_ref:.4f} ns")
    # Saturation and scene
    clipped = "none found"
    if system.saturation is not None:
        share = figures.saturated_share
        often = "" if share is None else f", in {100 * share:.2f} % of the waveforms"
        clipped = f"at {system.saturation:.0f} DN{often}"
    yield Fact("saturation", clipped)
    kinds = {"empty": figures.empty_share, "single": figures.single_share, "overlapped": figures.overlapped_share}
    shares = [f"{100 * share:.2f} % {kind}" for kind, share in kinds.items() if share is not None]
    if shares and figures.echoes_per_waveform is not None:
        yield Fact("waveforms", f"{', '.join(shares)}; {figures.echoes_per_waveform:.3f} echoes each")
    yield from list_facts(figures)
    if figures.system_width_share is not None:
        share = 100 * figures.system_width_share
        yield Fact("widths", f"{share:.1f} % of the clear echoes have the width of the system pulse")


def _draw_survey(survey: Survey) -> Iterator[Picture]:
    """The pulses, and what the waveforms hold."""
    from wavebatch.tools.plots.charts import chart_pulse, draw_counts

    system, found, spacing = survey.system, survey.figures, survey.figures.spacing_ns or 1.0
    yield from chart_pulse(system, spacing)
    for index, one in system.digitizers.items():
        yield from chart_pulse(one, spacing, f"Pulse of digitizer {index}")
    shares = {"empty": found.empty_share, "single": found.single_share, "overlapped": found.overlapped_share}
    if None not in shares.values():
        counts = {name: round(value * survey.waveforms) for name, value in shares.items()}
        counts["several apart"] = survey.waveforms - sum(counts.values())
        yield from draw_counts(counts, title="Waveforms of the survey", label="echoes in them")


def survey_page(
    survey: Survey, document: Mapping[str, Any], strips: Sequence[Path], **reading: Any
) -> Iterator[SheetPart]:
    """Yield the parts of the page of a survey.

    document: as `survey --json` prints it. strips: those that were surveyed. reading: direction and headerless.
    """
    from wavebatch.surveying.choose_chain import choose_chain
    from wavebatch.tools.plots.charts import draw_waveforms

    yield from list_doubts(document)
    if "strips" in document:
        rows = [[one["strip"], "belongs to the others" if one["fits"] else "does not belong to them",
                 one.get("reason") or ""] for one in document["strips"]]  # fmt: skip
        failed = [Note(f"{path}: cannot be surveyed", "warning") for path in document["failed"]]
        yield Sheet("Strips", [Table(("strip", "", "reason"), rows, sortable=True), *failed])
    yield survey_sheet(survey, document)
    chain = choose_chain(survey)
    for strip in strips[:MOST_DRAWN]:
        draw = partial(draw_waveforms, strip, chain, survey.system, chain.name, **reading)
        yield Sheet(strip.name, [Later(draw, "waveforms")])
    if len(strips) > MOST_DRAWN:
        yield Note(f"Waveforms of the first {MOST_DRAWN} of {len(strips)} strips are drawn.")
    paths = (Fact(f"strip {n + 1}", path) for n, path in enumerate(strips))
    chain_text = Sheet("Chain that the strip needs", [Code(document["chain"])])
    yield Sheet("Provenance", [Fact("wavebatch", document["version"]), *paths, chain_text])


UNIT = "1/(m2 DN ns)"

MOST_PAIRS = 60
"""Pairs that are drawn; more would be too small to read."""


def calibration_sheet(flight: FlightCalibration) -> Sheet:
    """The sheet of a calibration of one strip or of several, without its notes, which are warnings."""
    drawn = Later(partial(_draw_calibration, flight))
    return Sheet("Calibration", [*_list_calibration(flight), drawn])


def calibration_page(flight: FlightCalibration) -> list[SheetPart]:
    """Return the parts of the page of a calibration of one strip or of several."""
    from wavebatch.surveying.calibrating.calibration_files import format_calibration

    found = flight.calibration
    days = [Fact("day of the flight", found.flight or "not in the strip"), Fact("calibrated on", found.date)]
    provenance = Sheet("Provenance", [Fact("wavebatch", __version__), *days, Code(format_calibration(found))])
    return [*(Note(words, "warning") for words in found.notes), *calibration_sheet(flight).parts, provenance]


def _list_calibration(flight: FlightCalibration) -> Iterator[SheetPart]:
    """Constant, air, beam and swath; tables of targets, channels, strips and overlaps."""
    found = flight.calibration
    constant = format_relative(found.constant, found.relative_error)
    yield Fact("constant", f"{constant} +- {100 * found.relative_error:.1f} % {UNIT}")
    yield Fact("attenuation", f"{found.attenuation:g} dB/km one way")
    yield Fact("divergence", "not given" if found.divergence is None else f"{found.divergence:g} mrad")
    if found.swath:
        most, square, fourth, odd = found.swath
        left, right = (100 * math.expm1(-square - fourth - side * odd) for side in (-1, 1))
        sides = f"{left:+.1f} % light to the left and {right:+.1f} % to the right"
        yield Fact("scan angle", f"{sides}, at {math.degrees(most):.1f} deg against straight down")
    yield Fact("conditions", found.conditions)
    tilted = any(one.incidence_deg is not None for one in found.targets)  # a column of reflectances has no angle
    rows = []
    for one in found.targets:
        incidence, error = one.incidence_deg, one.incidence_error_deg
        known = "" if incidence is None else f"{incidence:.1f}" + ("" if error is None else f" +- {error:.1f}")
        angle = Cell(known or "-", "" if incidence is None else incidence)
        constant = _constant(one.constant, one.relative_error or one.spread)
        state = "used" if one.constant is not None else one.refused or "refused"
        rows.append((one.label, one.reflectance, one.echoes, constant, one.spread, *[angle] * tilted, state))
    head = ("target", "reflectance", "echoes", "constant", "spread", *["incidence deg"] * tilted, "")
    yield Table(head, rows, ("", ".4g", "", "", ".1%", *[""] * tilted, ""), sortable=True)
    rows = [(f"digitizer {one.digitizer}, scanner channel {one.scanner}", one.echoes or "by overlap",
             _constant(one.constant, one.relative_error), one.relative_error,
             *((one.spread, one.shot_energy) if one.echoes else (None, None))) for one in found.channels]  # fmt: skip
    yield Table(("channel", "echoes", "constant", "error", "spread", "without fit errors"), rows, ".1%")
    rows = [(one.strip, f"{one.digitizer}/{one.scanner}", _constant(one.constant, one.relative_error),
             one.relative_error, one.drift, one.drift_error, one.ties) for one in found.strips]  # fmt: skip
    head = ("strip", "digitizer/channel", "constant", "error", "drift", "drift error", "tie cells")
    yield Table(head, rows, ("", "", "", ".1%", "+.2%", ".2%", ""), sortable=True)
    rows = [(f"{one.a} over {one.b}", one.cells, one.ratio - 1, one.after - 1, one.spread, one.height)
            for one in flight.pairs]  # fmt: skip
    head = ("overlap", "cells", "light", "calibrated", "spread", "height m")
    yield Table(head, rows, ("", "", "+.2%", "+.2%", ".2%", "+.3f"), sortable=True)


def _constant(value: float | None, relative_error: float | None) -> Cell:
    """A constant with as many digits as its error allows."""
    return Cell("-", "") if value is None else Cell(format_relative(value, relative_error or 0.0), value)


def _draw_calibration(flight: FlightCalibration) -> Iterator[Picture]:
    """Constants of the targets, light by scan angle, drifts of the strips, and what is left in overlaps."""
    from wavebatch.tools.plots.charts import draw_values

    found = flight.calibration
    used = [(one.label, one.constant, one.constant * (one.relative_error or one.spread or 0.0))
            for one in found.targets if one.constant is not None]  # fmt: skip
    if used:
        names, constants, errors = zip(*used, strict=True)
        yield from draw_values(names, constants, errors, title="Constant of each target with its error", label=UNIT)
    if found.swath:
        angles = np.linspace(-found.swath[0], found.swath[0], 13)
        light = 100 * np.exp(-swath_columns(angles, found.swath[0]) @ found.swath[1:])
        names = [f"{angle:.1f}" for angle in np.degrees(angles)]
        title = f"Light from {names[0]} (left of the flight) to {names[-1]} deg"
        yield from draw_values(names, light, np.zeros(13), title=title, label="% of straight down")
    if found.strips:
        names = [f"{one.strip} {one.digitizer}/{one.scanner}" for one in found.strips]
        drifts, errors = zip(*((100 * one.drift, 100 * one.drift_error) for one in found.strips), strict=True)
        yield from draw_values(names, drifts, errors, title="Drift of each strip with its error", label="%")
    some = flight.pairs[:MOST_PAIRS]
    if some:
        light, spread = zip(*((100 * (one.after - 1), 100 * one.spread) for one in some), strict=True)
        names = [f"{one.a} / {one.b}" for one in some]
        yield from draw_values(names, light, spread, title="Calibrated light of the first over the second", label="%")


ANGLES = np.arange(0.0, 81.0)
"""Angles of the table [deg]."""

DRAWN = (1.0, 0.25, 4.0)
"""Amplitudes over that of the table for which a picture has errors."""

_DRAWS = 2000
"""Measured widths, evenly drawn from their law, from which the error of an angle is computed."""

_WIDEST, _FINE = 40.0, 20_000
"""Largest width that is tried [system widths], and number of widths."""


@frozen(eq=False)
class AngleTable:
    """Widths by angle at one distance and amplitude; NaN where no width means the angle."""

    distance: float
    """Sensor to echo [m]."""
    divergence: float
    """Full angle of the beam between the 1/e^2 points [mrad]."""
    amplitude: float
    """Of the echoes whose errors are given [DN]."""
    angle: np.ndarray
    """f8 (a,) [deg]."""
    spread: np.ndarray
    """What the surface adds to the pulse, as a standard deviation, f8 (a,) [ns]."""
    width: np.ndarray
    """Column echo_width, f8 (a,) [ns]."""
    error: np.ndarray
    """Root mean square error of the angle that a run gives one echo of a surface with this angle, f8 (a,) [deg]."""


def tabulate_angles(
    system: SystemPulse, spacing: float, distance: float, divergence: float, amplitude: float
) -> AngleTable:
    """The table of a system; amplitude: of the echoes for whose noise errors are given [DN]."""
    beam = 1e-3 * divergence
    spread = spread_of_angle(np.radians(ANGLES), distance, divergence=beam)
    tried = np.linspace(0.3, _WIDEST, _FINE) * system.sigma_ref
    variance, _ = _add_variance(system, spacing, tried, np.zeros(_FINE))
    sigma = np.interp(spread**2, variance, tried, left=np.nan, right=np.nan)
    bound = np.array([bound_time(max(amplitude, 1e-3), max(one, 1e-6), system.noise.std, spacing)
                      for one in np.nan_to_num(sigma, nan=1.0)])  # fmt: skip
    variance, variance_err = _add_variance(system, spacing, sigma, bound)
    # Root mean square error of the angles of many echoes of each surface. The error column of a run belongs to one
    # measured width: over the widths it jumps near 0, where half of the echoes are read as 0. What a surface gives on
    # average does not.
    from scipy.special import erfinv  # every survey comes by this module

    normal = np.sqrt(2.0) * erfinv(np.arange(-_DRAWS + 1, _DRAWS, 2) / _DRAWS)
    measured = variance[:, None] + variance_err[:, None] * normal
    angle = angle_of_spread(np.sqrt(np.maximum(measured, 0.0)), distance, beam)
    error = np.degrees(np.sqrt(np.mean((angle - np.radians(ANGLES)[:, None]) ** 2, axis=1)))
    smooth = angle_of_spread(np.sqrt(np.maximum(spread**2 - (system.widths.rough or 0.0), 0.0)), distance, beam)
    error = np.hypot(error, ANGLES - np.degrees(smooth))
    width = FWHM_PER_SIGMA * sigma
    return AngleTable(distance, divergence, amplitude, ANGLES, spread, width, np.where(np.isnan(sigma), np.nan, error))


def _add_variance(
    system: SystemPulse, spacing: float, sigma: np.ndarray, sigma_err: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Variance that a surface added to echoes of these widths, as the stage computes it [ns2]."""
    block = WaveformBlock.from_samples(np.zeros((1, 2), np.uint8), bits=8, spacing=spacing)
    zero = np.zeros(len(sigma))
    echoes = EchoTable.build(zero.astype(int), zero, zero + 1.0, sigma, sigma_err=sigma_err)
    return added_variance(block, system, echoes, "system", REFERENCE_ERROR)


def write_angles(
    target: Path, survey: Survey, distance: float | None, *, strip: str = "", overwrite: bool = False
) -> None:
    """Writes the table of a strip as .csv, or draws it; distance: of the sensor [m]; strip: its name, for the title.

    A picture has the angles, and their errors for echoes of each table's amplitude. Empty cells of a .csv are no data.
    Raises ConfigError where the beam is not known, InputError where the sensor's position is not known or no width of
    this system means an angle; and as figure_file.open_picture does.
    """
    system, figures = survey.system, survey.figures
    if not system.radiometry.divergence:
        raise ConfigError(f"--angles {target}: the beam is not known; give --divergence")
    if distance is None:
        raise InputError(f"--angles {target}: the distance of the sensor is not known, so no width means an angle")
    if math.isinf(system.widths.error or 0.0):
        raise InputError(f"--angles {target}: the strip does not show which width a surface has that faces the sensor")
    tables = [
        tabulate_angles(system, figures.spacing_ns, distance, system.radiometry.divergence, part * figures.amplitude_50)
        for part in DRAWN
    ]
    found = tables[0]
    if target.suffix.lower() == ".csv":
        head = ("angle_deg", "spread_ns", "echo_width_ns", "angle_err_deg", "distance_m", "divergence_mrad",
                "amplitude_DN")  # fmt: skip
        same = (np.full(len(found.angle), float(one)) for one in (found.distance, found.divergence, found.amplitude))
        columns = found.angle, found.spread, found.width, found.error, *same
        write_text(target, sheets.format_csv(head, zip(*columns, strict=True), digits=6), overwrite=overwrite)
        return
    from wavebatch.tools.plots.draw_cloud import SERIES_COLORS

    with open_picture(target, (7.0, 6.0), overwrite=overwrite) as figure:
        axes, errors = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        axes.plot(found.width, found.angle, color=SERIES_COLORS[0], linewidth=1.5)
        axes.set(ylim=(0, 90), ylabel="incidence angle [deg]")
        for one, color in zip(tables, SERIES_COLORS, strict=False):
            errors.plot(one.width, one.error, color=color, linewidth=1.2, label=f"echoes of {one.amplitude:.0f} DN")
        errors.set_yscale("log")
        errors.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        errors.set(xlabel="echo_width [ns]", ylabel="rms error [deg]")
        parts = [plain_text(strip), f"{found.distance:.0f} m, {found.divergence:g} mrad"]
        set_head(figure, [part for part in parts if part], size=10.5)
        errors.legend(loc="upper right")
