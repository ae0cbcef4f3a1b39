"""Why an echo has no value in a column: one code per echo, beside the column, so that reports can say how many and why.

The codes of column `c` are the attribute `c_reason`, u1; they never leave the program. What is unknown is NaN in arrays
and null in JSON.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np


class NoData(IntEnum):
    """Why an echo has no value; the first of them that holds, in this order."""

    KNOWN = 0
    NO_SENSOR = 1
    NOT_CALIBRATED = 2
    NO_DIVERGENCE = 3
    SHORT_PULSE = 4
    SHARED_PULSE = 5
    OVERLAPPED = 6
    SATURATED = 7
    CUT = 8
    UNSETTLED = 9
    NO_ANGLE = 10
    TOO_STEEP = 11
    UNCERTAIN = 12
    OTHER = 13
    NO_RAY = 14
    FEW_NEIGHBOURS = 15
    NO_PLANE = 16


REASONS: dict[NoData, tuple[str, str]] = {
    NoData.NO_SENSOR: ("nobody knows where the sensor was", "give --trajectory, or --flight-height"),
    NoData.NOT_CALIBRATED: (
        "the strip is not calibrated",
        "give --calibration (of `wavebatch calibrate`), or ask for relative_backscatter instead",
    ),
    NoData.NO_DIVERGENCE: (
        "the beam's divergence is not known",
        "put divergence_mrad of the data sheet into SYSTEM.toml or CAL.toml",
    ),
    NoData.SHORT_PULSE: (
        "the system pulse is shorter than 0.85 samples, so that widths depend on where the samples lie",
        "nothing mends that; leave the stage out",
    ),
    NoData.SHARED_PULSE: ("shares its pulse with other echoes, and so the light", "sum the echoes of a pulse instead"),
    NoData.OVERLAPPED: ("overlaps another echo, or was merged with one", "its width is not that of one surface"),
    NoData.SATURATED: ("saturated", "fly higher, or with less power"),
    NoData.CUT: ("cut by the start or the end of its waveform", "record longer waveforms"),
    NoData.UNSETTLED: ("its fit did not converge, or ended at a bound", "try a slower decompose stage"),
    NoData.NO_ANGLE: ("its incidence angle is not known", "see why incidence_angle is not, or set surface"),
    NoData.TOO_STEEP: ("struck at more than 80 degrees, or widened by more than a slope", "nothing mends that"),
    NoData.UNCERTAIN: (
        "more uncertain than max_error",
        "raise max_error, or take angles from the points around (stage attribute.incidence_angle_normals)",
    ),
    NoData.OTHER: ("its fit gave no usable value", "see its flags"),
    NoData.NO_RAY: ("its packet has no direction, or it is no point of the cloud", "write --points echoes"),
    NoData.FEW_NEIGHBOURS: ("fewer points around it than min_points", "raise radius"),
    NoData.NO_PLANE: ("the points around it are no plane that it lies in", "lower radius; plants have none"),
}
"""Per reason what it means, and what can be done about it."""

SUFFIX = "_reason"


def explain(values: np.ndarray, *cases: tuple[NoData, np.ndarray | bool]) -> np.ndarray:
    """Code of the first case that holds for each value that is not finite, KNOWN for the others, u1 (m,)."""
    codes = np.zeros(len(values), np.uint8)
    rows = np.flatnonzero(~np.isfinite(values))
    if not len(rows):
        return codes
    left = np.full(len(rows), NoData.OTHER, np.uint8)
    for reason, where in reversed(cases):
        holds = where if np.ndim(where) == 0 else where[rows]
        left[np.broadcast_to(holds, len(rows))] = reason
    codes[rows] = left
    return codes


def without_nan(value: Any) -> Any:
    """The same numbers, lists and dictionaries for JSON: None for what is no finite number, names as text."""
    if isinstance(value, Mapping):
        return {str(key): without_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def count_reasons(attributes: Mapping[str, np.ndarray]) -> dict[str, dict[str, int]]:
    """Echoes per column that has reasons, and per reason that occurs, KNOWN among them."""
    counts = {}
    for name, codes in attributes.items():
        if name.endswith(SUFFIX):
            numbers = np.bincount(codes, minlength=len(NoData)).tolist()
            counts[name.removesuffix(SUFFIX)] = {reason.name: numbers[reason] for reason in NoData if numbers[reason]}
    return counts
