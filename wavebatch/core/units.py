"""Physical and statistical constants that several rooms use, none to be tuned, and numbers with errors as text."""

import math
from collections.abc import Sequence
from datetime import datetime, timedelta

C = 0.299792458
"""Speed of light in vacuum [m/ns]."""

HALF_C = C / 2
"""One-way distance per two-way travel time [m/ns]."""

PS_PER_NS = 1000.0
"""LAS waveform packets count time in picoseconds; everything else here is in nanoseconds."""

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian, in standard deviations (2.354820)."""

SQRT_PI = math.sqrt(math.pi)
"""Integral of a Gaussian squared, in amplitude squared times sigma."""
SQRT_2PI = math.sqrt(2.0 * math.pi)
"""Integral of a Gaussian, in amplitude times sigma."""

AIR_SPEED = 0.9997 * HALF_C
"""One-way metres per two-way ns in air, whose refractive index is 1.0003, as vendors store it."""

WEEK, ADJUSTED = 604_800.0, 1e9
"""Length of a GPS week, and what adjusted standard GPS time lacks of seconds since 1980 [s] (LAS 1.4, global encoding
bit 0)."""

QUANTISATION_STD = 1.0 / math.sqrt(12.0)
"""Standard deviation of rounding to whole counts (0.2887): no noise estimate may be lower."""

SQUARED_NORMAL_MEDIAN = 0.455
"""Median of the square of a standard normal number."""

LEAST_PULSE_WIDTH = 0.85
"""Width of the system pulse [samples] below which fitted widths depend on where samples lie.

Source: docs/algorithms.md 1.4.
"""

AIR_ATTENUATION = 0.22
"""Attenuation of the air, one way [dB/km].

The default that others use: a visibility of 28 km at 1064 nm (docs/algorithms.md 5, 9).
"""

INSET = 1.5
"""1/e2 radii from a straight edge at which all of a footprint counts as inside: 0.13 % of its light lies beyond."""

ASSUMED_DIVERGENCE = 1.0
"""Full angle of the beam [mrad] for such distances where none is given: as wide as topographic lasers have."""

MEDIAN_ERROR = math.sqrt(math.pi / 2.0)
"""Standard deviation of the median of many normal numbers, in that of their mean."""

_MOST_DECIMALS = 6
"""Numbers that need more are hard to read; `format_measure` then writes powers of ten."""

MAD_TO_STD = 1.4826
"""Median absolute deviation of a normal distribution times this is its standard deviation."""


def date_gps(time: float) -> datetime:
    """Return the date of an adjusted standard GPS time [s], without leap seconds."""
    return datetime(1980, 1, 6) + timedelta(seconds=time + ADJUSTED)


def format_measure(value: float, error: float, sign: str = "+-") -> str:
    """Return `12.34 +- 0.05`: a value with as many digits as its error, which has two.

    Parameters
    ----------
    value, error : float
        In one unit. Where the error is not above 0 and finite, the value stands alone.
    sign : str
        Between the two.

    Returns
    -------
    str
        `-` for a value that is not finite. Errors below 1e-5 are `1.0e-08`, and small values have powers of ten too.
    """
    if not math.isfinite(value):
        return "-"
    if not (math.isfinite(error) and error > 0):
        return f"{value:.7g}"
    digits = max(1 - math.floor(math.log10(error)), 0)
    if round(error, digits) >= 10.0 ** (2 - digits) and digits:  # 0.0996 is 0.10
        digits -= 1
    if digits > _MOST_DECIMALS:
        places = digits + 1 + math.floor(math.log10(abs(value))) if value else 1
        shown = f"{value:#.{places}g}" if places > 1 else f"{value:.1g}"
        return f"{shown} {sign} {error:#.2g}"
    return f"{value:.{digits}f} {sign} {error:.{digits}f}"


def format_relative(value: float, relative_error: float) -> str:
    """Return `2.857e-08`: a value with as many digits as its relative error allows, which then has two.

    Parameters
    ----------
    value, relative_error : float
        The error over the value. Where it is not above 0 and finite, six digits are given.

    Returns
    -------
    str
    """
    if not (math.isfinite(relative_error) and relative_error > 0):
        return f"{value:.6g}"
    digits = 2 - math.floor(math.log10(relative_error))
    return f"{value:.{min(max(digits, 2), 10)}g}"


def count(number: int, name: str) -> str:
    """`1 echo`, `2 echoes`: a number of things in a message."""
    if number == 1:
        return f"1 {name}"
    return f"{number} {name}{'es' if name.endswith(('o', 's', 'x', 'ch')) else 's'}"


def name_first(names: Sequence[str]) -> str:
    """`a.las`, `a.las (and 5 others)`: the things that a message is about, if one sentence holds for all of them."""
    return names[0] + (f" (and {count(len(names) - 1, 'other')})" if len(names) > 1 else "")
