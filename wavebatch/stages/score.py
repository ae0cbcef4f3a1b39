"""Score of found echoes against true ones: completeness, correctness, and errors in units of the Cramer-Rao bound.

Called by `bench`, `compare --truth` and the accuracy tests. Found and true echoes are matched one to one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import MAD_TO_STD
from wavebatch.kernels.fit.bounds import crlb

TOLERANCE_NS = 1.5
"""A found and a true echo further apart than this are not the same echo."""

ISOLATED = 6.0
"""An echo without a neighbour within this many sigma (of the wider one) is isolated: the closed bounds hold for it."""

QUANTITIES = ("time", "amplitude", "sigma")

_CLASS_FLAGS = {
    "overlapped": EchoFlag.OVERLAPPED,
    "edge": EchoFlag.NEAR_EDGE,
    "saturated": EchoFlag.SATURATED,
    "weak": EchoFlag.WEAK,
}


class Match(NamedTuple):
    """Pairs of found and true echoes, one to one, sorted by the true ones."""

    found: np.ndarray
    """Rows of the found table, i8 (k,)."""
    truth: np.ndarray
    """Rows of the true table, i8 (k,)."""


def match_echoes(found: EchoTable, truth: EchoTable, tolerance_ns: float = TOLERANCE_NS) -> Match:
    """Match found and true echoes of the same waveform one to one, the closest pair first.

    Parameters
    ----------
    found, truth : EchoTable
        Echoes of the same waveforms.
    tolerance_ns : float
        Largest distance in time of a pair [ns].

    Returns
    -------
    Match
        Rows of both tables, sorted by the true ones.
    """
    left, right = list_pairs(found.waveform, found.time, truth.waveform, truth.time, tolerance_ns)
    distance = np.abs(found.time[left] - truth.time[right])
    kept = pair_nearest(left, right, distance, len(found), len(truth))
    order = np.argsort(right[kept], kind="stable")
    return Match(left[kept][order], right[kept][order])


def list_pairs(
    group_a: np.ndarray, value_a: np.ndarray, group_b: np.ndarray, value_b: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """List every pair (row of a, row of b) of one group whose values differ by at most `tolerance`.

    Parameters
    ----------
    group_a, group_b : int array, shape (m,) and (k,)
        Groups, in any order.
    value_a, value_b : float array, shape (m,) and (k,)
        Finite values.
    tolerance : float
        Largest difference.

    Returns
    -------
    left, right : int64 array
        Rows of a and rows of b.
    """
    none = np.empty(0, np.int64)
    if not len(group_a) or not len(group_b):
        return none, none
    low = min(value_a.min(), value_b.min())
    span = max(value_a.max(), value_b.max()) - low + 4 * tolerance + 1.0
    key_a = group_a * span + (value_a - low)
    key_b = group_b * span + (value_b - low)
    order = np.argsort(key_a, kind="stable")
    ordered = key_a[order]
    # Keys are rounded, so the search reaches a little further; the exact test follows.
    reach = tolerance + 1e-9 * max(abs(ordered[0]), abs(ordered[-1]), 1.0)
    start = np.searchsorted(ordered, key_b - reach, side="left")
    number = np.searchsorted(ordered, key_b + reach, side="right") - start
    right = np.repeat(np.arange(len(group_b)), number)
    within = np.arange(len(right)) - np.repeat(np.cumsum(number) - number, number)
    left = order[np.repeat(start, number) + within]
    same = (group_a[left] == group_b[right]) & (np.abs(value_a[left] - value_b[right]) <= tolerance)
    return left[same], right[same]


def pair_nearest(left: np.ndarray, right: np.ndarray, distance: np.ndarray, n_left: int, n_right: int) -> np.ndarray:
    """Choose pairs greedily by distance, then right row, then left row, so that each row is used once.

    Parameters
    ----------
    left, right : int array, shape (k,)
        Rows of each pair.
    distance : float array, shape (k,)
        Distance of each pair.
    n_left, n_right : int
        Number of rows on each side.

    Returns
    -------
    int64 array
        Indices of the chosen pairs.

    Notes
    -----
    Each round keeps the pairs that are the best of both their rows and drops all other pairs of these rows. This
    gives the same result as a loop over all pairs in order.
    """
    order = np.lexsort((left, right, distance))
    kept = []
    while len(order):
        place = np.arange(len(order))
        best_left = np.full(n_left, len(order))
        best_right = np.full(n_right, len(order))
        # Reversed, so that the first pair of each row is written last and stays.
        best_left[left[order][::-1]] = place[::-1]
        best_right[right[order][::-1]] = place[::-1]
        chosen = (best_left[left[order]] == place) & (best_right[right[order]] == place)
        winners = order[chosen]
        kept.append(winners)
        done_left = np.zeros(n_left, bool)
        done_right = np.zeros(n_right, bool)
        done_left[left[winners]] = True
        done_right[right[winners]] = True
        order = order[~done_left[left[order]] & ~done_right[right[order]]]
    return np.concatenate(kept) if kept else np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class ErrorStats:
    """Errors of one quantity over matched echoes, in its unit; NaN without echoes."""

    number: int
    bias: float
    """Mean of found minus true."""
    rmse: float
    nmad: float
    """MAD_TO_STD times the median absolute deviation from the median: the spread without outliers."""
    rms_per_bound: float
    """Root mean square of error / Cramer-Rao bound of an isolated echo."""
    nmad_per_bound: float
    calibration: float
    """Root mean square of error / reported error: 1 when the reported errors are right."""
    calibration_nmad: float

    @classmethod
    def compute(cls, error: np.ndarray, bound: np.ndarray, reported: np.ndarray) -> ErrorStats:
        """Compute statistics of errors (k,) with their bounds and reported standard deviations (NaN: none)."""
        known = np.isfinite(reported) & (reported > 0)
        scaled = error[known] / reported[known]
        return cls(
            number=len(error),
            bias=float(error.mean()) if len(error) else float("nan"),
            rmse=_rms(error),
            nmad=_nmad(error),
            rms_per_bound=_rms(error / bound),
            nmad_per_bound=_nmad(error / bound),
            calibration=_rms(scaled),
            calibration_nmad=_nmad(scaled),
        )


@dataclass(frozen=True, slots=True)
class Score:
    """How well the echoes of a number of waveforms were found. Shares are NaN where their denominator is 0."""

    waveforms: int
    true: int
    found: int
    matched: int
    completeness: float
    """Share of the true echoes that were found."""
    correctness: float
    """Share of the found echoes that are true."""
    exact_count: float
    """Share of the waveforms in which as many echoes were found as there are."""
    false_splits: float
    """Share of the waveforms with one true echo in which more were found."""
    false_alarms: float
    """Share of the waveforms without an echo in which any was found."""
    completeness_by_class: dict[str, float]
    """Completeness of isolated, overlapped, edge, saturated and weak echoes."""
    errors: dict[str, dict[str, ErrorStats]]
    """Per class (all, isolated, overlapped) and quantity (time [ns], amplitude [count], sigma [ns])."""

    def to_json(self) -> dict:
        """Return plain numbers, lists and dictionaries for JSON."""
        return asdict(self)


def score(
    found: EchoTable,
    truth: EchoTable,
    n: int,
    *,
    noise_std: float,
    spacing: float = 1.0,
    tolerance_ns: float = TOLERANCE_NS,
) -> Score:
    """Measure completeness, correctness and errors of the echoes found in n waveforms.

    Parameters
    ----------
    found, truth : EchoTable
        Found and true echoes. OVERLAPPED, NEAR_EDGE and SATURATED true echoes do not count as isolated.
    n : int
        Number of waveforms.
    noise_std : float
        Standard deviation of one recorded sample [count]; sets the bounds.
    spacing : float
        Time between two samples [ns].
    tolerance_ns : float
        Largest distance of a found from a true echo [ns].

    Returns
    -------
    Score
        Shares and errors, in all and by class.
    """
    match = match_echoes(found, truth, tolerance_ns)
    matched, right = np.zeros(len(truth), bool), np.zeros(len(found), bool)
    matched[match.truth] = True
    right[match.found] = True
    count_found, count_true = found.count(n), truth.count(n)
    one, none = count_true == 1, count_true == 0
    classes = _classify(truth)
    errors: dict[str, dict[str, ErrorStats]] = {name: {} for name in ("all", "isolated", "overlapped")}
    bounds = crlb(truth.amplitude, truth.sigma.astype(np.float64), noise_std, spacing)
    for quantity, bound in zip(QUANTITIES, bounds, strict=True):
        error = getattr(found, quantity)[match.found] - getattr(truth, quantity)[match.truth].astype(np.float64)
        reported = getattr(found, f"{quantity}_err")[match.found].astype(np.float64)
        for name, stats in errors.items():
            rows = classes[name][matched]
            stats[quantity] = ErrorStats.compute(error[rows], bound[match.truth][rows], reported[rows])
    return Score(
        waveforms=n,
        true=len(truth),
        found=len(found),
        matched=len(match.truth),
        completeness=_share(matched),
        correctness=_share(right),
        exact_count=_share(count_found == count_true),
        false_splits=_share(count_found[one] > 1),
        false_alarms=_share(count_found[none] > 0),
        completeness_by_class={name: _share(matched[rows]) for name, rows in classes.items()},
        errors=errors,
    )


def find_isolated(truth: EchoTable) -> np.ndarray:
    """Find echoes to which the closed bounds apply: alone, inside the window, not clipped.

    Parameters
    ----------
    truth : EchoTable
        True echoes, m of them.

    Returns
    -------
    bool array, shape (m,)
        True for isolated echoes.
    """
    sigma = truth.sigma.astype(np.float64)
    close = np.diff(truth.time) < ISOLATED * np.maximum(sigma[1:], sigma[:-1])
    close &= np.diff(truth.waveform) == 0
    bad = (truth.flags & np.uint16(EchoFlag.OVERLAPPED | EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) != 0
    bad[1:] |= close
    bad[:-1] |= close
    return ~bad


def _classify(truth: EchoTable) -> dict[str, np.ndarray]:
    return {
        "all": np.ones(len(truth), bool),
        "isolated": find_isolated(truth),
        **{name: (truth.flags & np.uint16(flag)) != 0 for name, flag in _CLASS_FLAGS.items()},
    }


def _share(hits: np.ndarray) -> float:
    return int(hits.sum()) / len(hits) if len(hits) else float("nan")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _nmad(values: np.ndarray) -> float:
    if not len(values):
        return float("nan")
    return float(MAD_TO_STD * np.median(np.abs(values - np.median(values))))
