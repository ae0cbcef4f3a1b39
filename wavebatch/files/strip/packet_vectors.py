"""Direction and length of a strip's packet vectors: decided from the points, never assumed.

Vendors understood the LAS text in two ways (docs/las-waveforms.md 1.4). Returns that share a packet show which: the
position of sample 0 must be equal for all of them; it is P + L v if v points toward the sensor, P - L v if away.
Heights are the second evidence: an airborne sensor is above its returns. The scan collects the votes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from wavebatch.core.order import quantile
from wavebatch.core.units import HALF_C, PS_PER_NS
from wavebatch.files.disk.raw_bytes import widen_integers

OPTIONS = ("auto", "toward", "away")
VECTORS = ("x_t", "y_t", "z_t")
LEAST_RATIO, LARGEST_RATIO = 0.7, 1.02
"""Outside these limits the length of vectors over c/2 gives a warning; usual files have 0.96 to 1.00."""
RANGE_RATIO = 100.0
"""Longer vectors, over c/2, are not speeds: Optech wrote the whole path from sample 0 to the return."""
_APART = 2.0 * PS_PER_NS
"""Least difference of return locations of a pair [ps]; closer returns give no evidence."""
_PER_CALL = 256
"""Most votes of one part, so that each part of the strip counts about the same."""
_CLEAR, _MOSTLY = 0.95, 0.8
"""Share of votes that decides: of heights, which terrestrial strips break, and of pairs."""
_ENOUGH = 3
"""Fewer pairs than this decide nothing if heights do."""


@dataclass(frozen=True, slots=True)
class VectorDecision:
    """Meaning of the packet vectors of a strip."""

    direction: str
    """`toward` or `away` from the sensor (for the form `range`: after division by minus the location)."""
    form: str
    """`stored`: metres per picosecond; `range`: the whole path, to be divided by minus the location."""
    ratio: float
    """Median length over c/2; NaN without waveforms."""
    evidence: str
    warnings: tuple[str, ...]
    problems: tuple[str, ...]


@dataclass(slots=True)
class DirectionTally:
    """Votes for both directions, collected in parts; each part counts with at most a few hundred points."""

    form: str
    """See `VectorDecision`."""
    pairs: list[int] = field(default_factory=lambda: [0, 0])
    """Pairs of returns that vote for toward, for away."""
    heights: list[int] = field(default_factory=lambda: [0, 0])
    """Vectors that point up, down."""
    ratios: list[np.ndarray] = field(default_factory=list)
    """Lengths over c/2."""

    def join(self, other: DirectionTally) -> None:
        """Add the votes of further points."""
        self.pairs = [mine + more for mine, more in zip(self.pairs, other.pairs, strict=True)]
        self.heights = [mine + more for mine, more in zip(self.heights, other.heights, strict=True)]
        self.ratios += other.ratios

    def add_points(self, points: np.ndarray) -> None:
        """Add the votes of usable points (n,): length and height of their vectors."""
        some = points[:: max(1, len(points) // _PER_CALL)]
        height = read_toward(some, "toward", self.form)[:, 2]
        self.heights[0] += int((height > 0).sum())
        self.heights[1] += int((height < 0).sum())
        self.ratios.append(measure_ratio(some, self.form))

    def add_pairs(self, xyz: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
        """Add the votes of pairs of usable points that share a packet: xyz f8 (2, n, 3) [m], records (n,)."""
        a, b = widen_integers(first["return_point_wave_location"]), widen_integers(second["return_point_wave_location"])
        use = np.flatnonzero(np.abs(a - b) > _APART)
        use = use[:: max(1, len(use) // _PER_CALL)]
        if not len(use):
            return
        step = xyz[0, use] - xyz[1, use]
        paths = read_toward(first[use], "toward", self.form) * a[use, None]
        paths -= read_toward(second[use], "toward", self.form) * b[use, None]
        toward = np.sqrt(((step + paths) ** 2).sum(axis=1))
        away = np.sqrt(((step - paths) ** 2).sum(axis=1))
        large, small = np.maximum(toward, away), np.minimum(toward, away)
        clear = (large > 0.1) & (small < 0.5 * large)
        self.pairs[0] += int((clear & (toward < away)).sum())
        self.pairs[1] += int((clear & (away < toward)).sum())


def find_form(points: np.ndarray) -> str:
    """Return the form of the vectors, `stored` or `range`, from the first points of a strip."""
    ratio = measure_ratio(points, "stored")
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    return "range" if len(ratio) and quantile(ratio, 0.5) > RANGE_RATIO else "stored"


def measure_ratio(points: np.ndarray, form: str) -> np.ndarray:
    """Return the length of the vectors over c/2, f8 (n,); not finite if it cannot be computed."""
    vectors = stack_vectors(points)
    length = np.sqrt((vectors * vectors).sum(axis=1)) * (PS_PER_NS / HALF_C)
    if form == "range":
        with np.errstate(divide="ignore", invalid="ignore"):
            length = length / np.abs(widen_integers(points["return_point_wave_location"]))
    return length


def stack_vectors(points: np.ndarray) -> np.ndarray:
    """Return the vectors of records (n,) as stored, f8 (n, 3)."""
    return np.stack([widen_integers(points[name]) for name in VECTORS], axis=1)


def read_toward(points: np.ndarray, direction: str, form: str) -> np.ndarray:
    """Return vectors toward the sensor [m/ps], f8 (n, 3), with the length of the file."""
    vectors = stack_vectors(points)
    if form == "range":
        vectors /= -widen_integers(points["return_point_wave_location"])[:, None]
    return vectors if direction == "toward" else -vectors


def decide_direction(tally: DirectionTally, option: str, metres: float = 1.0) -> VectorDecision:
    """Return the decision by the votes; with `auto`, contradicting or missing votes are a problem of the strip.

    metres: of a unit of the coordinates, in which vectors may be, too.
    """
    if not any(len(part) for part in tally.ratios):
        chosen = "toward" if option == "auto" else option
        return VectorDecision(chosen, tally.form, float("nan"), "no waveform to decide from", (), ())
    ratio = quantile(np.concatenate(tally.ratios), 0.5)
    warnings, problems = list(_judge_length(ratio, tally.form, metres)), []
    (toward, away), (up, down) = tally.pairs, tally.heights
    pairs, heights = _verdict(toward, away, _MOSTLY), _verdict(up, down, _CLEAR)
    evidence = f"{toward} of {toward + away} pairs that share a packet and {up} of {up + down} heights say toward"
    if toward + away < _ENOUGH and heights:
        pairs = ""
    chosen = pairs or heights or "toward"
    if pairs and heights and pairs != heights:
        problems.append(f"packet vectors contradict each other: {evidence}; pass --direction toward or away")
    elif not (pairs or heights):
        problems.append(f"the direction of packet vectors is not clear: {evidence}; pass --direction toward or away")
    if option != "auto":
        if chosen != option or problems:
            warnings.append(f"--direction {option} overrides the evidence of the file: {evidence}")
        chosen, problems, evidence = option, [], f"given; {evidence}"
    return VectorDecision(chosen, tally.form, ratio, evidence, tuple(warnings), tuple(problems))


def _judge_length(ratio: float, form: str, metres: float) -> Iterator[str]:
    if form == "range":
        yield (
            f"packet vectors are more than {RANGE_RATIO:g} times c/2 long; they are read as whole paths (as Optech "
            "wrote them) and divided by minus the return location"
        )
    if not any(LEAST_RATIO <= length <= LARGEST_RATIO for length in (ratio, metres * ratio)):
        yield f"packet vectors are {ratio:.4g} times c/2 long (usual: 0.96 to 1.00); new echoes may lie wrong"


def _verdict(toward: int, away: int, share: float) -> str:
    total = toward + away
    if total and toward >= share * total:
        return "toward"
    return "away" if total and away >= share * total else ""
