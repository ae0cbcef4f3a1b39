"""Score of found echoes against true ones: completeness, correctness, and errors in units of the Cramer-Rao bound."""

from dataclasses import asdict, dataclass

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.stages.score import QUANTITIES, TOLERANCE_NS, ErrorStats, find_isolated_echoes, match_echoes

_CLASS_FLAGS = {
    "overlapped": EchoFlag.OVERLAPPED,
    "edge": EchoFlag.NEAR_EDGE,
    "saturated": EchoFlag.SATURATED,
    "weak": EchoFlag.WEAK,
}


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


def _classify(truth: EchoTable) -> dict[str, np.ndarray]:
    return {
        "all": np.ones(len(truth), bool),
        "isolated": find_isolated_echoes(truth),
        **{name: (truth.flags & np.uint16(flag)) != 0 for name, flag in _CLASS_FLAGS.items()},
    }


def _share(hits: np.ndarray) -> float:
    return int(hits.sum()) / len(hits) if len(hits) else float("nan")
