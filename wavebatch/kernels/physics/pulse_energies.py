"""Whether the light of a strip follows the energies that are said to be those of its pulses.

`matching.setting` asks it for the energies of `--energy`.
"""

from __future__ import annotations

import numpy as np

LEAST_SLOPE = 0.5
"""Light grows with the energy itself, slope 1; a shuffled log has 0, one that is off by a pulse -0.5."""

MOST_ERROR = 0.15
"""Slopes less certain than this say nothing: energies that hardly scatter, or plants."""


def judge_energies(light: np.ndarray, energy: np.ndarray) -> str:
    """Find what contradicts the energies of pulses.

    Parameters
    ----------
    light : float (n,)
        Light that each pulse returned, in any unit, in the order of the pulses.
    energy : float (n,)
        Energy of each pulse; NaN where it is not known.

    Returns
    -------
    str
        Empty where light follows the energies, or where nothing shows it.

    Notes
    -----
    Neighbouring pulses mostly hit one surface, so that the logarithm of their light differs by that of their energies.
    The slope of the one over the other is fitted with steps between surfaces clipped, also for energies of the next
    pulse and of the one before.
    """
    slope, error = _fit_slope(light, energy)
    if not error <= MOST_ERROR or slope + 3.0 * error > LEAST_SLOPE:
        return ""
    early, late = (_fit_slope(light, np.roll(energy, shift))[0] > LEAST_SLOPE for shift in (1, -1))
    cause = "come one pulse too early" if early else "come one pulse too late" if late else "are of other pulses"
    return f"light follows them with a slope of {slope:.2f} +- {error:.2f} where 1 is right; they {cause}"


def _fit_slope(light: np.ndarray, energy: np.ndarray) -> tuple[float, float]:
    """Slope of the steps of the logarithms from pulse to pulse, and its error; (0, inf) where nothing is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rise, step = np.diff(np.log(light))[1:-1], np.diff(np.log(energy))[1:-1]
    known = np.isfinite(rise) & np.isfinite(step)
    rise, step = rise[known], step[known]
    whole = float(np.sum(step * step))
    if not whole > 0:
        return 0.0, np.inf
    limit = 4.0 * float(np.median(np.abs(rise)))
    rise = np.clip(rise, -limit, limit)
    slope = float(np.sum(rise * step)) / whole
    # Steps of neighbours share a pulse, which makes the error larger by up to sqrt(2) than that of independent ones.
    return slope, float(np.sqrt(2.0 * np.mean((rise - slope * step) ** 2) / whole))
