"""Which way a strip's packet vectors point and how long they are: decided from the points, never assumed.

The LAS text has been read both ways. Returns that share a packet settle it: P + L v, the position of sample 0, must be
the same for all of them where v points toward the sensor, P - L v where it points away. Heights are the second witness:
an airborne sensor is above its returns.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from wavebatch.errors import ConfigError
from wavebatch.units import HALF_C, PS_PER_NS

OPTIONS = ("auto", "toward", "away")
VECTORS = ("x_t", "y_t", "z_t")
LEAST_RATIO, LARGEST_RATIO = 0.7, 1.02
RANGE_RATIO = 100.0
"""Vectors longer than this many times c/2 are not speeds: Optech wrote the vector from sample 0 to the return."""
_FORMS = ("stored", "range")
_APART = 2.0 * PS_PER_NS
_PER_CALL = 256
_CLEAR, _MOSTLY = 0.95, 0.8
_ENOUGH = 3


@dataclass(frozen=True, slots=True)
class Decision:
    """What the vectors of a strip mean."""

    direction: str
    """`toward` or `away`: where the vectors point (those as long as the range: once divided by minus the location)."""
    form: str
    """`stored`: metres per picosecond as they stand; `range`: as long as the path they cover (divide by -location)."""
    ratio: float
    """Median length over c/2; NaN without waveforms."""
    evidence: str
    warnings: tuple[str, ...]
    problems: tuple[str, ...]


@dataclass(slots=True)
class DirectionTally:
    """Votes for either direction, collected part by part; each part counts with at most a few hundred points."""

    votes: dict[str, list[int]] = field(default_factory=lambda: {form: [0, 0] for form in _FORMS})
    """Per form: pairs of returns that say toward, away."""
    heights: list[int] = field(default_factory=lambda: [0, 0])
    """Stored vectors that point up, down."""
    ratios: dict[str, list[np.ndarray]] = field(default_factory=lambda: {form: [] for form in _FORMS})

    def add_points(self, points: np.ndarray) -> None:
        """Takes usable points into account: length and height of their vectors."""
        points = _spread(points)
        vectors = stack_vectors(points)
        location = points["return_point_wave_location"].astype(np.float64)
        self.heights[0] += int((vectors[:, 2] > 0).sum())
        self.heights[1] += int((vectors[:, 2] < 0).sum())
        length = np.sqrt((vectors * vectors).sum(axis=1)) * (PS_PER_NS / HALF_C)
        self.ratios["stored"].append(length)
        self.ratios["range"].append(length[location != 0] / np.abs(location[location != 0]))

    def add_pairs(self, xyz: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
        """Takes pairs of points that share a packet into account: xyz f8 (2, n, 3) [m], records (n,) each."""
        a, b = first["return_point_wave_location"], second["return_point_wave_location"]
        use = np.flatnonzero(np.abs(a.astype(np.float64) - b) > _APART)
        use = use[:: max(1, len(use) // _PER_CALL)]
        if not len(use):
            return
        step = xyz[0, use] - xyz[1, use]
        plain = _paths(first[use], scaled=True) - _paths(second[use], scaled=True)
        whole = _paths(second[use], scaled=False) - _paths(first[use], scaled=False)
        for form, paths in (("stored", plain), ("range", whole)):
            toward = np.sqrt(((step + paths) ** 2).sum(axis=1))
            away = np.sqrt(((step - paths) ** 2).sum(axis=1))
            large, small = np.maximum(toward, away), np.minimum(toward, away)
            clear = (large > 0.1) & (small < 0.5 * large)
            self.votes[form][0] += int((clear & (toward < away)).sum())
            self.votes[form][1] += int((clear & (away < toward)).sum())


def check_option(option: str) -> str:
    """The option itself; raises ConfigError where it is none."""
    if option not in OPTIONS:
        raise ConfigError(f"direction {option!r}: must be {', '.join(OPTIONS)}")
    return option


def stack_vectors(points: np.ndarray) -> np.ndarray:
    """The vectors of the records as they stand, f8 (n, 3)."""
    return np.stack([points[name].astype(np.float64) for name in VECTORS], axis=1)


def read_toward(points: np.ndarray, direction: str, form: str) -> np.ndarray:
    """Vectors toward the sensor, metres per picosecond, f8 (n, 3), length as the file has it."""
    vectors = stack_vectors(points)
    if form == "range":
        location = points["return_point_wave_location"].astype(np.float64)
        vectors /= -np.where(location == 0, 1.0, location)[:, None]
    return vectors if direction == "toward" else -vectors


def decide(tally: DirectionTally, option: str) -> Decision:
    """What the votes say. Where they contradict each other or say nothing, `auto` leaves a problem."""
    if not any(len(part) for part in tally.ratios["stored"]):
        chosen = "toward" if option == "auto" else option
        return Decision(chosen, "stored", float("nan"), "no waveform to judge by", (), ())
    form, ratio, warnings = _judge_length(tally)
    problems: list[str] = []
    toward, away = tally.votes[form]
    up, down = tally.heights if form == "stored" else tally.heights[::-1]
    pairs, heights = _verdict(toward, away, _MOSTLY), _verdict(up, down, _CLEAR)
    evidence = f"{toward} of {toward + away} pairs that share a packet and {up} of {up + down} heights say toward"
    if toward + away < _ENOUGH and heights:
        pairs = ""
    chosen = pairs or heights or "toward"
    if pairs and heights and pairs != heights:
        problems.append(f"packet vectors contradict each other: {evidence}; pass --direction toward or away")
    elif not (pairs or heights):
        problems.append(f"where packet vectors point cannot be told: {evidence}; pass --direction toward or away")
    if option != "auto":
        if chosen != option or problems:
            warnings.append(f"--direction {option} overrides what the file says: {evidence}")
        chosen, problems, evidence = option, [], f"given; {evidence}"
    return Decision(chosen, form, ratio, evidence, tuple(warnings), tuple(problems))


def _judge_length(tally: DirectionTally) -> tuple[str, float, list[str]]:
    ratio = float(np.median(np.concatenate(tally.ratios["stored"])))
    form, warnings = "stored", []
    if ratio > RANGE_RATIO and sum(len(part) for part in tally.ratios["range"]):
        divided = float(np.median(np.concatenate(tally.ratios["range"])))
        form, stored, ratio = "range", ratio, divided
        warnings.append(
            f"packet vectors are {stored:.4g} times c/2 long, so they are taken for whole paths (as Optech wrote them) "
            "and divided by minus the return location"
        )
    if not LEAST_RATIO <= ratio <= LARGEST_RATIO:
        warnings.append(
            f"packet vectors are {ratio:.4g} times c/2 long (usual: 0.96 to 1.00); new echoes may lie wrong"
        )
    return form, ratio, warnings


def _verdict(toward: int, away: int, share: float) -> str:
    total = toward + away
    if total and toward >= share * total:
        return "toward"
    return "away" if total and away >= share * total else ""


def _paths(points: np.ndarray, *, scaled: bool) -> np.ndarray:
    vectors = stack_vectors(points)
    return vectors * points["return_point_wave_location"].astype(np.float64)[:, None] if scaled else vectors


def _spread(points: np.ndarray) -> np.ndarray:
    return points[:: max(1, len(points) // _PER_CALL)]
