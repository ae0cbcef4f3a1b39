"""Which strips of a flight differ from the others: for the index of a run's page.

The figures of a strip come from its report. A mark is a hint to look at the strip, not a fault.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from wavebatch.core.order import robust_std
from wavebatch.core.units import FWHM_PER_SIGMA

FIGURES: dict[str, tuple[str, str, float]] = {
    "echoes": ("echoes per waveform", ".3f", 0.02),
    "passed": ("passed through %", ".2f", 1.0),
    "added": ("added %", ".2f", 1.0),
    "weak": ("weak %", ".2f", 1.0),
    "amplitude": ("median amplitude DN", ".1f", 0.0),
    "width": ("median width ns", ".3f", 0.0),
    "pulse": ("pulse width ns", ".3f", 0.0),
    "noise": ("noise DN", ".3f", 0.0),
}
"""By key: head of the column, form of the number, and the smallest difference that counts."""

FEWEST = 5
"""Fewer strips than this have no usual value."""

FARTHEST = 3.5
"""Largest usual distance from the median in robust standard deviations (Iglewicz and Hoaglin 1993)."""

LEAST_SHARE = 0.05
"""Smallest difference that counts, as a share of the median: strips may agree so well that any is many deviations."""


def measure_strip(report: Mapping[str, Any]) -> dict[str, float]:
    """The FIGURES of a strip's report; NaN where one is not known."""
    counts, quality = report["counts"], report["quality"]
    system = report["strip"]["system"]
    passed = sum(counts["passed_through"].values())
    rows = counts["points_out"] + sum(counts["left_out"].values())

    def percent(number: float, whole: float) -> float:
        return 100 * number / whole if whole else math.nan

    return {
        "echoes": counts["echoes"] / counts["waveforms"] if counts["waveforms"] else math.nan,
        "passed": percent(passed, rows),
        "added": percent(counts["added_echoes"], counts["echoes"]),
        "weak": percent(counts["flags"]["WEAK"], counts["points_out"]),
        "amplitude": _known(quality["amplitude_dn"]["p50"]),
        "width": _known(quality["echo_width_ns"]["p50"]),
        "pulse": FWHM_PER_SIGMA * system["sigma_ref_ns"],
        "noise": system["noise_std_dn"],
    }


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def describe_sensor(report: Mapping[str, Any]) -> str:
    """How a strip was recorded: only strips of one sensor have the same usual values."""
    found = report["strip"]["survey"]["figures"]
    return f"{found.get('bits', 0):.0f} bits, {found.get('spacing_ns', 0):g} ns"


def find_outliers(strips: Sequence[Mapping[str, float]], sensors: Sequence[str]) -> list[dict[str, str]]:
    """For each strip: the keys of the figures in which it differs from the others of its sensor, and how, in words."""
    found: list[dict[str, str]] = [{} for _ in strips]
    for sensor in dict.fromkeys(sensors):
        _mark(strips, [place for place, one in enumerate(sensors) if one == sensor], found)
    return found


def _mark(strips: Sequence[Mapping[str, float]], places: Sequence[int], found: list[dict[str, str]]) -> None:
    """Marks the strips at these places."""
    for key, (_, form, least) in FIGURES.items():
        values = np.array([strips[place].get(key, math.nan) for place in places], np.float64)
        known = values[np.isfinite(values)]
        if len(known) < FEWEST:
            continue
        median = float(np.median(known))
        limit = max(FARTHEST * robust_std(known), LEAST_SHARE * abs(median), least)
        for place, value in zip(places, values, strict=True):
            if abs(value - median) > limit:
                found[place][key] = f"{value:{form}}; usual is {median:{form}} \u00b1 {limit:{form}}"
