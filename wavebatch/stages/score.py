"""Found echoes against true ones: one-to-one matching, completeness, correctness, errors in units of the bound."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
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


class Match(NamedTuple):
    """Pairs of found and true echoes, one to one, sorted by the true ones."""

    found: np.ndarray
    """Rows of the found table, i8 (k,)."""
    truth: np.ndarray
    """Rows of the true table, i8 (k,)."""


def match_echoes(found: EchoTable, truth: EchoTable, tolerance_ns: float = TOLERANCE_NS) -> Match:
    """Pairs of the same waveform at most `tolerance_ns` apart: the closest pair first, each echo once."""
    left, right = list_pairs(found.waveform, found.time, truth.waveform, truth.time, tolerance_ns)
    distance = np.abs(found.time[left] - truth.time[right])
    kept = pair_nearest(left, right, distance, len(found), len(truth))
    order = np.argsort(right[kept], kind="stable")
    return Match(left[kept][order], right[kept][order])


def list_pairs(
    group_a: np.ndarray, value_a: np.ndarray, group_b: np.ndarray, value_b: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Every pair (row of a, row of b) of one group whose values differ by at most `tolerance`.

    group_a, group_b: whole numbers; value_a, value_b: finite. Neither needs to be sorted.
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
    # A little more than the tolerance, because keys are rounded; the exact test follows.
    reach = tolerance + 1e-9 * max(abs(ordered[0]), abs(ordered[-1]), 1.0)
    start = np.searchsorted(ordered, key_b - reach, side="left")
    number = np.searchsorted(ordered, key_b + reach, side="right") - start
    right = np.repeat(np.arange(len(group_b)), number)
    within = np.arange(len(right)) - np.repeat(np.cumsum(number) - number, number)
    left = order[np.repeat(start, number) + within]
    same = (group_a[left] == group_b[right]) & (np.abs(value_a[left] - value_b[right]) <= tolerance)
    return left[same], right[same]


def pair_nearest(left: np.ndarray, right: np.ndarray, distance: np.ndarray, n_left: int, n_right: int) -> np.ndarray:
    """Indices of the pairs that a greedy matching keeps: by distance, then right, then left; each row once.

    In every round the pairs that are the best of both their rows are kept, and the others of these rows leave:
    the same result as going through all pairs in order, without a loop over them.
    """
    order = np.lexsort((left, right, distance))
    kept = []
    while len(order):
        place = np.arange(len(order))
        best_left = np.full(n_left, len(order))
        best_right = np.full(n_right, len(order))
        # Written in reverse, so that the first of a row is what remains.
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
    """Errors of one quantity over matched echoes, in its unit; NaN where there is nothing to say."""

    number: int
    bias: float
    """Mean of found minus true."""
    rmse: float
    nmad: float
    """1.4826 times the median absolute deviation from the median: the spread without outliers."""
    rms_per_bound: float
    """Root mean square of error / Cramer-Rao bound of an isolated echo."""
    nmad_per_bound: float
    calibration: float
    """Root mean square of error / reported error: 1 when the reported errors are right."""
    calibration_nmad: float

    @classmethod
    def compute(cls, error: np.ndarray, bound: np.ndarray, reported: np.ndarray) -> ErrorStats:
        """Statistics of errors (k,) with their bounds and reported standard deviations (NaN: none)."""
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
        """Plain numbers, lists and dictionaries for JSON."""
        return asdict(self)


@dataclass(slots=True)
class Scorer:
    """Collects blocks of found and true echoes; `result` is the Score of all of them."""

    noise_std: float
    """Standard deviation of one recorded sample [count]; sets the bounds."""
    spacing: float = 1.0
    tolerance_ns: float = TOLERANCE_NS
    _waveforms: int = 0
    _found: int = 0
    _tallies: np.ndarray = field(default_factory=lambda: np.zeros(5, np.int64))
    _parts: list[dict[str, np.ndarray]] = field(default_factory=list)

    def add(self, found: EchoTable, truth: EchoTable, n: int) -> Match:
        """Take in a block of n waveforms; returns its match."""
        match = match_echoes(found, truth, self.tolerance_ns)
        count_found, count_true = found.count(n), truth.count(n)
        one, none = count_true == 1, count_true == 0
        self._tallies += [
            (count_found == count_true).sum(),
            one.sum(),
            (one & (count_found > 1)).sum(),
            none.sum(),
            (none & (count_found > 0)).sum(),
        ]
        self._waveforms += n
        self._found += len(found)
        self._parts.append(self._collect(found, truth, match))
        return match

    def _collect(self, found: EchoTable, truth: EchoTable, match: Match) -> dict[str, np.ndarray]:
        bounds = crlb(truth.amplitude, truth.sigma.astype(np.float64), self.noise_std, self.spacing)
        part = {"matched": np.zeros(len(truth), bool), "flags": truth.flags, "isolated": find_isolated(truth)}
        part["matched"][match.truth] = True
        for name, bound in zip(QUANTITIES, bounds, strict=True):
            true = getattr(truth, name)[match.truth].astype(np.float64)
            part[name] = getattr(found, name)[match.found] - true
            part[f"{name}_bound"] = bound[match.truth]
            part[f"{name}_err"] = getattr(found, f"{name}_err")[match.found].astype(np.float64)
        return part

    def result(self) -> Score:
        """The Score of all that was added."""
        names = self._parts[0] if self._parts else {}
        data = {name: np.concatenate([part[name] for part in self._parts]) for name in names}
        matched = data.get("matched", np.zeros(0, bool))
        classes = _classify(data) if data else {}
        exact, one, split, none, alarm = self._tallies.tolist()
        hits = int(matched.sum())
        return Score(
            waveforms=self._waveforms,
            true=len(matched),
            found=self._found,
            matched=hits,
            completeness=_share(hits, len(matched)),
            correctness=_share(hits, self._found),
            exact_count=_share(exact, self._waveforms),
            false_splits=_share(split, one),
            false_alarms=_share(alarm, none),
            completeness_by_class={
                name: _share(int((matched & rows).sum()), int(rows.sum())) for name, rows in classes.items()
            },
            errors={
                name: {quantity: _measure(data, classes[name][matched], quantity) for quantity in QUANTITIES}
                for name in ("all", "isolated", "overlapped")
                if name in classes
            },
        )


def score(
    found: EchoTable,
    truth: EchoTable,
    n: int,
    *,
    noise_std: float,
    spacing: float = 1.0,
    tolerance_ns: float = TOLERANCE_NS,
) -> Score:
    """Completeness, correctness and errors of the echoes found in n waveforms.

    noise_std: standard deviation of one recorded sample [count] (Recording.recorded_noise); spacing [ns].
    truth.flags as simulate sets them: OVERLAPPED, NEAR_EDGE and SATURATED echoes are not isolated.
    """
    scorer = Scorer(noise_std, spacing, tolerance_ns)
    scorer.add(found, truth, n)
    return scorer.result()


def find_isolated(truth: EchoTable) -> np.ndarray:
    """True for echoes whose errors the closed bounds describe: alone, inside the window, not clipped; bool (m,)."""
    sigma = truth.sigma.astype(np.float64)
    close = np.diff(truth.time) < ISOLATED * np.maximum(sigma[1:], sigma[:-1])
    close &= np.diff(truth.waveform) == 0
    bad = (truth.flags & np.uint16(EchoFlag.OVERLAPPED | EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) != 0
    bad[1:] |= close
    bad[:-1] |= close
    return ~bad


def _classify(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    def has(flag: EchoFlag) -> np.ndarray:
        return (data["flags"] & np.uint16(flag)) != 0

    return {
        "all": np.ones(len(data["flags"]), bool),
        "isolated": data["isolated"],
        "overlapped": has(EchoFlag.OVERLAPPED),
        "edge": has(EchoFlag.NEAR_EDGE),
        "saturated": has(EchoFlag.SATURATED),
        "weak": has(EchoFlag.WEAK),
    }


def _measure(data: dict[str, np.ndarray], rows: np.ndarray, quantity: str) -> ErrorStats:
    return ErrorStats.compute(data[quantity][rows], data[f"{quantity}_bound"][rows], data[f"{quantity}_err"][rows])


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _nmad(values: np.ndarray) -> float:
    if not len(values):
        return float("nan")
    return float(MAD_TO_STD * np.median(np.abs(values - np.median(values))))
