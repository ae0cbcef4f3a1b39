"""A calibration as a sheet: constants, targets, channels, strips and how they agree; for `wavebatch calibrate`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from wavebatch import __version__
from wavebatch.core.system import swath_columns
from wavebatch.core.units import format_relative
from wavebatch.surveying.calibrating.calibrate_flight import FlightCalibration
from wavebatch.surveying.calibrating.calibration_file import format_calibration
from wavebatch.surveying.calibration import Calibration, TargetResult
from wavebatch.tools.sheets.sheet import Cell, Code, Fact, Later, Note, Picture, Sheet, Table

UNIT = "1/(m2 DN ns)"

MOST_DRAWN = 60
"""Pairs that are drawn; more would be too small to read."""


def calibration_sheet(flight: FlightCalibration) -> Sheet:
    """The sheet of a calibration of one strip or of several, without its notes, which are warnings."""
    found = flight.calibration
    drawn = Later(partial(_draw, flight))
    return Sheet("Calibration", [*_list_facts(found), *_list_tables(flight), drawn])


def write_calibrate_page(target: Path, flight: FlightCalibration) -> None:
    """Write the page of a calibration of one strip or of several."""
    from wavebatch.tools.sheets.page import write_page

    found = flight.calibration
    days = [Fact("day of the flight", found.flight or "not in the strip"), Fact("calibrated on", found.date)]
    provenance = Sheet("Provenance", [Fact("wavebatch", __version__), *days, Code(format_calibration(found))])
    parts = [*(Note(words, "warning") for words in found.notes), *calibration_sheet(flight).parts, provenance]
    write_page(target, f"wavebatch calibrate: {found.strip or 'strips'}", parts)


def _list_facts(found: Calibration) -> Iterator[Fact]:
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


def _list_tables(flight: FlightCalibration) -> Iterator[Table]:
    found = flight.calibration
    tilted = any(one.incidence_deg is not None for one in found.targets)  # a column of reflectances has no angle
    rows = [(one.label, one.reflectance, one.echoes, _constant(one.constant, one.relative_error or one.spread),
             one.spread, *[_incidence(one)] * tilted,
             "used" if one.constant is not None else one.refused or "refused") for one in found.targets]  # fmt: skip
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


def _incidence(target: TargetResult) -> Cell:
    if target.incidence_deg is None:
        return Cell("-", "")
    error = "" if target.incidence_error_deg is None else f" +- {target.incidence_error_deg:.1f}"
    return Cell(f"{target.incidence_deg:.1f}{error}", target.incidence_deg)


def _draw(flight: FlightCalibration) -> Iterator[Picture]:
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
    some = flight.pairs[:MOST_DRAWN]
    if some:
        light, spread = zip(*((100 * (one.after - 1), 100 * one.spread) for one in some), strict=True)
        names = [f"{one.a} / {one.b}" for one in some]
        yield from draw_values(names, light, spread, title="Calibrated light of the first over the second", label="%")
