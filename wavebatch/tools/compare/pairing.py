"""What two sides have in common: pairs within pulses or by place, counted and measured bucket by bucket."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.stages.score import ErrorStats, list_pairs, pair_nearest
from wavebatch.tools.compare.breakdown import Breakdown, Table
from wavebatch.tools.compare.differences import SPEED, Differences, Spread

MOST_PER_PULSE = 64
"""Echoes of one GPS time beyond which it is no pulse's."""

MOST_PAIRS = 20_000_000
"""Of such echoes: about 100 bytes each."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """What cloud a has in common with b (another cloud, or the truth). Shares are NaN where nothing is to be shared."""

    a: str
    b: str
    matched_by: str
    """`gps_time`: within pulses of equal time; `position`: nearest neighbours of each other; `waveform`: within each
    waveform of the strip, by time after its first sample."""
    tolerance_ns: float
    pulses: int
    """Pulses of either (of the truth: its packets); 0 when matched by position."""
    echoes_a: int
    echoes_b: int
    matched: int
    missed: int
    """Echoes of b that a lacks."""
    extra: int
    """Echoes of a that b lacks."""
    completeness: float
    """Share of b's echoes that a has."""
    correctness: float
    """Share of a's echoes that b has."""
    exact_count: float
    """Share of the pulses with as many echoes in a as in b."""
    counts_a: dict[int, int]
    """Pulses by number of echoes in a; those with none are known from b."""
    counts_b: dict[int, int]
    differences: dict[str, Spread]
    """time along the ray [ns, later is positive]; echo_time [ns], amplitude [DN], echo_width [ns] if both have it."""
    errors: dict[str, dict[str, ErrorStats]] = field(default_factory=dict)
    """Against truth only: per class (all, isolated, overlapped) and quantity, with error / bound and calibration.

    `time` is the error of the position; `echo_time`, where the cloud has it, that of the fit alone.
    Medians and errors of more than a million pairs are those of an even sample."""

    missed_by: dict[str, Table] = field(default_factory=dict)
    """What the missed echoes are: per kind (return, amplitude or intensity, pulse, flag) and class of it, those missed
    and all of b's. An echo counts for each of its flags. Intensity stands in where b has no amplitudes."""
    extra_by: dict[str, Table] = field(default_factory=dict)
    """What the extra echoes are, as `missed_by`."""

    @property
    def identical(self) -> float:
        """Share of the echoes of both that the other side has too (Wagner et al., tables 1 and 2)."""
        return _share(2 * self.matched, self.echoes_a + self.echoes_b)

    @property
    def gain(self) -> float:
        """How many more echoes a has than b, as a share of b's."""
        return _share(self.echoes_a - self.echoes_b, self.echoes_b)

    def to_json(self) -> dict:
        """Plain numbers, lists and dictionaries for JSON."""
        return {**asdict(self), "identical": self.identical, "gain": self.gain}


class Pairing:
    """Pairs echoes of a and b (records of io.cloud.CLOUD_DTYPE), part by part, and sums up what they have in common.

    tolerance_ns: largest distance of the same echo along the ray. meta: of the truth where b is one. limit: most pairs
    that are kept for medians.
    """

    def __init__(self, tolerance_ns: float, meta: dict | None = None, limit: int | None = None) -> None:
        self.tolerance, self.tolerance_ns = tolerance_ns * SPEED, tolerance_ns
        self.meta = meta
        self.pulses = self.exact = self.matched = 0
        self.echoes = [0, 0]
        self.counts = [np.zeros(1, np.int64), np.zeros(1, np.int64)]
        self.differences = Differences(limit)
        self.breakdowns = (Breakdown(), Breakdown())

    def pair_by_time(self, a: np.ndarray, b: np.ndarray, packets: np.ndarray) -> None:
        """Takes in pulses that are whole: echoes of equal gps_time are of one.

        packets: records with the gps_time of every pulse that counts, those without an echo too; where there is none,
        all pulses with an echo count.
        """
        times = np.concatenate([a["gps_time"], b["gps_time"], packets["gps_time"]])
        known, group = np.unique(times, return_inverse=True)
        in_a, in_b = group[: len(a)], group[len(a) : len(a) + len(b)]
        number_a, number_b = (np.bincount(g, minlength=len(known)) for g in (in_a, in_b))
        counted = slice(None)
        if self.meta or len(packets):
            counted = np.unique(group[len(a) + len(b) :])
        self.pulses += len(number_a[counted])
        self.exact += int((number_a[counted] == number_b[counted]).sum())
        self.counts = [_add_counts(old, n[counted]) for old, n in zip(self.counts, (number_a, number_b), strict=True)]
        left, right = pair_echoes(in_a, a["xyz"], in_b, b["xyz"], self.tolerance)
        self.differences.add(a[left], b[right])
        self._count(0, a, left, number_b[in_a])
        self._count(1, b, right, number_a[in_b])
        self.matched += len(left)

    def pair_by_place(self, a: np.ndarray, b: np.ndarray, own: tuple[np.ndarray, np.ndarray]) -> None:
        """Takes in a region: nearest neighbours of each other are pairs.

        own: echoes that count, bool (k,) for a and b; the others are there as neighbours only.
        """
        none = np.empty(0, np.int64)
        left = right = none
        if len(a) and len(b):
            to_b, nearest_b = cKDTree(b["xyz"]).query(a["xyz"], distance_upper_bound=self.tolerance)
            _, nearest_a = cKDTree(a["xyz"]).query(b["xyz"], distance_upper_bound=self.tolerance)
            left = np.flatnonzero(np.isfinite(to_b))
            right = nearest_b[left]
            mutual = nearest_a[right] == left
            left, right = left[mutual], right[mutual]
        self._count(0, a, left, None, own[0])
        self._count(1, b, right, None, own[1])
        # A pair across a border belongs to the region of its echo of a.
        inside = own[0][left]
        self.differences.add(a[left[inside]], b[right[inside]])
        self.matched += int(inside.sum())

    def finish(self, name_a: str, name_b: str, matched_by: str) -> Comparison:
        """What all parts have in common."""
        a, b = self.echoes
        return Comparison(
            a=name_a,
            b=name_b,
            matched_by=matched_by,
            tolerance_ns=self.tolerance_ns,
            pulses=self.pulses,
            echoes_a=a,
            echoes_b=b,
            matched=self.matched,
            missed=b - self.matched,
            extra=a - self.matched,
            completeness=_share(self.matched, b),
            correctness=_share(self.matched, a),
            exact_count=_share(self.exact, self.pulses),
            counts_a=_list_counts(self.counts[0]),
            counts_b=_list_counts(self.counts[1]),
            differences=self.differences.spreads(),
            errors=self.differences.errors(self.meta) if self.meta else {},
            missed_by=self.breakdowns[1].tables(),
            extra_by=self.breakdowns[0].tables(),
        )

    def _count(
        self, side: int, rows: np.ndarray, paired: np.ndarray, others: np.ndarray | None, own: np.ndarray | None = None
    ) -> None:
        """Echoes of one side: those that are paired, and how many the other side has in their pulses."""
        alone = np.ones(len(rows), bool)
        alone[paired] = False
        if own is not None:
            rows, alone = rows[own], alone[own]
        self.echoes[side] += len(rows)
        self.breakdowns[side].add(rows, alone, others)


def pair_echoes(
    pulse_a: np.ndarray, xyz_a: np.ndarray, pulse_b: np.ndarray, xyz_b: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a and b that are the same echo: of one pulse and at most `reach` [m] apart, one to one, nearest first.

    pulse_a, pulse_b: whole numbers from 0 on (k,); xyz_a, xyz_b: positions f8 (k, 3) [m]. Raises InputError where
    very many echoes of one pulse lie within reach of each other.
    """
    number = max(pulse_a.max(initial=0), pulse_b.max(initial=0)) + 1
    most = np.maximum(*(np.bincount(pulse, minlength=number) for pulse in (pulse_a, pulse_b)))
    crowd = most > MOST_PER_PULSE
    calm_a, calm_b = (np.flatnonzero(~crowd[pulse]) for pulse in (pulse_a, pulse_b))
    # Heights differ by less than distances along the ray do: a cheap first choice of pairs.
    left, right = list_pairs(pulse_a[calm_a], xyz_a[calm_a, 2], pulse_b[calm_b], xyz_b[calm_b, 2], reach)
    left, right = calm_a[left], calm_b[right]
    if crowd.any():
        more = _list_crowded(pulse_a, xyz_a, pulse_b, xyz_b, crowd, reach)
        left, right = (np.concatenate(both) for both in zip((left, right), more, strict=True))
    distance = np.linalg.norm(xyz_a[left] - xyz_b[right], axis=1)
    near = np.flatnonzero(distance <= reach)
    left, right = left[near], right[near]
    kept = pair_nearest(left, right, distance[near], len(xyz_a), len(xyz_b))
    return left[kept], right[kept]


def _list_crowded(
    pulse_a: np.ndarray, xyz_a: np.ndarray, pulse_b: np.ndarray, xyz_b: np.ndarray, crowd: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs within reach of pulses that are none: of points without a time of their own heights choose too few."""
    rows_a, rows_b = (np.flatnonzero(crowd[pulse]) for pulse in (pulse_a, pulse_b))
    if not len(rows_a) or not len(rows_b):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    trees = cKDTree(xyz_a[rows_a]), cKDTree(xyz_b[rows_b])
    if trees[0].count_neighbors(trees[1], reach) > MOST_PAIRS:
        raise InputError(
            f"{len(rows_a)} and {len(rows_b)} points share their GPS times with more than {MOST_PER_PULSE} others, and "
            "lie too close together to be told apart; leave out the points without a time of their own"
        )
    near = trees[0].sparse_distance_matrix(trees[1], reach, output_type="ndarray")
    left, right = rows_a[near["i"]], rows_b[near["j"]]
    same = pulse_a[left] == pulse_b[right]
    return left[same], right[same]


def check_tolerance(tolerance_ns: float) -> float:
    """The tolerance; ConfigError where it is none."""
    if not 0 < tolerance_ns < 1e6:
        raise ConfigError(f"tolerance {tolerance_ns} ns must be above 0")
    return tolerance_ns


def _add_counts(old: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    new = np.bincount(numbers, minlength=len(old))
    new[: len(old)] += old
    return new


def _list_counts(counts: np.ndarray) -> dict[int, int]:
    return {number: int(pulses) for number, pulses in enumerate(counts) if pulses}


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
