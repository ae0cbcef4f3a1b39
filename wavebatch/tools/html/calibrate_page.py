"""The page of `wavebatch calibrate --html`: constants, targets, channels, strips and how they agree."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wavebatch import __version__
from wavebatch.core.system import swath_columns
from wavebatch.core.units import format_relative
from wavebatch.surveying.calibrating.calibrate_flight import FlightCalibration
from wavebatch.surveying.calibrating.calibration_file import format_calibration
from wavebatch.surveying.calibration import Calibration
from wavebatch.tools.html import markup
from wavebatch.tools.html.charts import draw_values, figures
from wavebatch.tools.html.page import write_page

UNIT = "1/(m2 DN ns)"

MOST_DRAWN = 60
"""Pairs that are drawn; more would be too small to read."""


def write_calibrate_page(target: Path, flight: FlightCalibration) -> None:
    """Write the page of a calibration of one strip or of several."""
    found = flight.calibration
    title = f"wavebatch calibrate: {found.strip or 'strips'}"
    write_page(target, title, _parts(flight, found))


def _parts(flight: FlightCalibration, found: Calibration) -> Iterator[str]:
    constant = format_relative(found.constant, found.relative_error)
    rows = {
        "constant": f"{constant} {UNIT} \u00b1 {100 * found.relative_error:.1f} %",
        "attenuation of the air": f"{found.attenuation:g} dB/km one way",
        "divergence": "not given" if found.divergence is None else f"{found.divergence:g} mrad",
        "conditions": found.conditions,
    }
    yield markup.section("Summary", markup.facts(rows), markup.bullets(found.notes, "warning"))
    yield _list_targets(found)
    if found.channels:
        channels = [[one.digitizer, one.scanner, one.echoes, _constant(one.constant, one.relative_error),
                     markup.percent(one.relative_error), markup.percent(one.spread)]
                    for one in found.channels]  # fmt: skip
        head = ["digitizer", "scanner channel", "echoes", "constant", "error %", "spread %"]
        yield markup.section("Channels", markup.table(head, channels))
    if found.swath:
        yield markup.section("Scan angle", figures([_draw_swath(found.swath)]))
    if found.strips:
        yield _list_strips(found)
    if flight.pairs:
        pairs = [[one.a, one.b, one.cells, markup.percent(one.ratio - 1), markup.percent(one.after - 1),
                  markup.percent(one.spread), markup.rounded(one.height, ".3f")]
                 for one in flight.pairs]  # fmt: skip
        head = ["a", "over b", "cells", "light %", "calibrated %", "spread %", "height m"]
        some = flight.pairs[:MOST_DRAWN]
        light, spread = zip(*((100 * (one.after - 1), 100 * one.spread) for one in some), strict=True)
        chart = draw_values([f"{one.a} / {one.b}" for one in some], light, spread,
                            title="Calibrated light of the first over the second", label="%")  # fmt: skip
        yield markup.section("Overlaps", markup.table(head, pairs, sortable=True), figures([chart]))
    days = {"day of the flight": found.flight or "not in the strip", "calibrated on": found.date}
    provenance = {"wavebatch": __version__, "strip": found.strip, **days}
    yield markup.section("Provenance", markup.facts(provenance), markup.code(format_calibration(found)))


def _draw_swath(swath: tuple[float, ...]) -> str:
    """How the light falls with the scan angle, which the calibration takes off."""
    angles = np.linspace(-swath[0], swath[0], 13)
    light = 100 * np.exp(-swath_columns(angles, swath[0]) @ swath[1:])
    names = [f"{angle:.1f}" for angle in np.degrees(angles)]
    title = f"Light from {names[0]} (left of the flight) to {names[-1]} deg"
    return draw_values(names, light, np.zeros(13), title=title, label="% of straight down")


def _list_targets(found: Calibration) -> str:
    rows = [[one.label, one.reflectance, one.echoes, _constant(one.constant, one.relative_error or one.spread),
             markup.percent(one.spread), markup.rounded(one.incidence_deg, ".1f"),
             "used" if one.constant is not None else one.refused or "refused"] for one in found.targets]  # fmt: skip
    head = ["target", "reflectance", "echoes", "constant", "spread %", "incidence deg", ""]
    used = [(one.label, one.constant, one.constant * (one.relative_error or one.spread or 0.0))
            for one in found.targets if one.constant is not None]  # fmt: skip
    charts = [draw_values(*map(list, zip(*used, strict=True)), title="Constant of each target with its error",
                          label=UNIT)] if used else []  # fmt: skip
    return markup.section("Targets", markup.table(head, rows, sortable=True), figures(charts))


def _list_strips(found: Calibration) -> str:
    rows = [[one.strip, one.digitizer, one.scanner, _constant(one.constant, one.relative_error),
             markup.percent(one.relative_error), markup.percent(one.drift), markup.percent(one.drift_error), one.ties]
            for one in found.strips]  # fmt: skip
    names = [f"{one.strip} {one.digitizer}/{one.scanner}" for one in found.strips]
    drifts, errors = zip(*((100 * one.drift, 100 * one.drift_error) for one in found.strips), strict=True)
    chart = draw_values(names, drifts, errors, title="Drift of each strip with its error", label="%")
    head = ["strip", "digitizer", "scanner channel", "constant", "error %", "drift %", "drift error %", "tie cells"]
    return markup.section("Strips", markup.table(head, rows, sortable=True), figures([chart]))


def _constant(value: float | None, relative_error: float | None) -> markup.Cell:
    """A constant with as many digits as its error allows."""
    words = markup.NO_VALUE if value is None else format_relative(value, relative_error or 0.0)
    return markup.Cell(words, "" if value is None else value)
