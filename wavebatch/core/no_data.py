"""Why an echo has no value in a column: one code per echo and column, so that reports can count the reasons.

Stages write the codes of column `c` as attribute `c_reason` (uint8); the report counts them; clouds do not hold them.
Unknown values are NaN in arrays and null in JSON. The order of the codes is the order in which reasons are tried.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from wavebatch.core.units import LEAST_PULSE_WIDTH

_UNSETTLED_REMEDY = "try a slower decompose stage, or a larger most_width: steep surfaces make echoes wider than that"


class NoData(IntEnum):
    """Why an echo has no value: the first reason that applies, in this order."""

    meaning: str
    remedy: str

    def __new__(cls, value: int, meaning: str, remedy: str) -> NoData:
        """A code with its meaning, and what the user can do about it."""
        code = int.__new__(cls, value)
        code._value_, code.meaning, code.remedy = value, meaning, remedy
        return code

    KNOWN = 0, "", ""
    NO_SENSOR = 1, "the position of the sensor is not known", "give --trajectory, or --flight-height"
    NOT_CALIBRATED = (
        2,
        "the strip is not calibrated",
        "give --calibration (of `wavebatch calibrate`), or ask for relative_backscatter instead",
    )
    NO_DIVERGENCE = (
        3,
        "the beam's divergence is not known",
        "give --system with the SYSTEM.toml of `wavebatch survey STRIP --divergence MRAD -o SYSTEM.toml`",
    )
    SHORT_PULSE = (
        4,
        f"the system pulse is shorter than {LEAST_PULSE_WIDTH} samples: widths depend on where the samples lie",
        "there is no remedy; leave the stage out",
    )
    SHARED_PULSE = 5, "shares the light of its pulse with other echoes", "sum the echoes of a pulse instead"
    OVERLAPPED = (
        6,
        "overlaps another echo, or was merged with one",
        "there is no remedy; its width is not that of one surface",
    )
    SATURATED = 7, "saturated", "fly higher, or with less power"
    CUT = 8, "cut by the start or the end of its waveform", "record longer waveforms"
    UNSETTLED = 9, "its fit did not converge, or ended at a bound", _UNSETTLED_REMEDY
    NO_ANGLE = 10, "its incidence angle is not known", "see why incidence_angle is not, or set surface"
    TOO_STEEP = 11, "incidence angle above 80 degrees, or broader than any slope explains", "there is no remedy"
    UNCERTAIN = (
        12,
        "more uncertain than max_error",
        "raise max_error, or take angles from the points around (stage attribute.incidence_angle_normals)",
    )
    OTHER = 13, "its fit gave no usable value", "see its flags"
    NO_RAY = 14, "its packet has no direction, or it is not a point of the cloud", "write --points echoes"
    FEW_NEIGHBOURS = 15, "fewer points around it than min_points, or only two scan lines", "raise radius"
    NO_PLANE = 16, "the points around it do not form a plane that it lies in", "lower radius; plants have no plane"
    OTHER_PULSE = (
        17,
        "its width was fitted with another pulse than mode compares it with",
        'fit the pulse of the survey (decompose.adaptive), or Gaussians with mode = "pulse"',
    )
    NO_PULSE_ENERGY = 18, "the energy of its pulse is not known", "complete the file of --energy, or leave it out"
    NO_LEVEL = (
        19,
        "the width of an echo that no slope widens is not known: too few points of the strip lie on planes",
        "give --system with the SYSTEM.toml of a strip of the same sensor that has them (`survey --divergence`)",
    )
    EDGE = (
        20,
        "its footprint may reach over an edge, to a surface after the end of its packet",
        "record longer waveforms; backscatter_coefficient holds what comes from its surface",
    )


REASONS: dict[NoData, tuple[str, str]] = {code: (code.meaning, code.remedy) for code in NoData if code.meaning}
"""Meaning of each reason, and what the user can do about it."""

SUFFIX = "_reason"
"""Ending of the names of attributes that hold codes."""


def explain_no_data(values: np.ndarray, *cases: tuple[NoData, np.ndarray | bool]) -> np.ndarray:
    """The reason code of each value of a column.

    Parameters
    ----------
    values : float (n,)
        The column; finite values are KNOWN.
    *cases : (NoData, bool or bool (n,))
        Reasons in order, with where they apply. The first one that applies counts; OTHER where none does.

    Returns
    -------
    uint8 (n,)
        Codes of NoData.
    """
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
    """Numbers, lists and dictionaries made ready for JSON: None for NaN and infinity, dictionary keys as text."""
    if isinstance(value, Mapping):
        return {str(key): without_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def count_reasons(attributes: Mapping[str, np.ndarray]) -> dict[str, dict[str, int]]:
    """Number of echoes per reason, for each column of a table that has reasons.

    Parameters
    ----------
    attributes : mapping of arrays (m,)
        Attributes of an EchoTable.

    Returns
    -------
    dict of dict of int
        By column, then by the name of the code; codes that do not occur are left out, KNOWN is counted too.
    """
    counts = {}
    for name, codes in attributes.items():
        if name.endswith(SUFFIX):
            numbers = np.bincount(codes, minlength=len(NoData)).tolist()
            counts[name.removesuffix(SUFFIX)] = {reason.name: numbers[reason] for reason in NoData if numbers[reason]}
    return counts
