"""Compares two clouds, or a cloud with the truth of its simulated strip, echo by echo.

`wavebatch compare` calls `compare_clouds` and `compare_truth`: files go in, a Comparison comes out. Rows go to buckets
on disk (CloudTask: by GPS time, or by x if times do not separate pulses), then bucket by bucket to a Pairing, so that
memory does not grow with the clouds. A Pairing finds pairs, within pulses or by position, and adds them to Differences,
and the echoes without a partner to Breakdowns; `finish` gives the Comparison. A part that it gets must hold whole
pulses (`pair_by_time`) or all neighbours of its echoes (`pair_by_place`), or pairs are lost. `compare_chains` uses
Pairing for two chains, and CloudTask for a chain and a cloud.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, field, replace
from pathlib import Path

import numpy as np
import scipy  # parts of it load when they are first asked for

from wavebatch.core.echoes import PASSED_THROUGH, EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import EvenSample
from wavebatch.core.units import AIR_SPEED, FWHM_PER_SIGMA, MAD_TO_STD
from wavebatch.files.cloud.cloud_reader import CLOUD_DTYPE, CloudReader
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.disk.temp_store import BUCKET_ROWS, Spool, count_buckets, spread_keys, time_keys
from wavebatch.files.las.header import CLASS_NAMES
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.stages.score import ErrorStats, list_pairs, pair_nearest
from wavebatch.tools.return_stats import times_separate_pulses
from wavebatch.tools.simulate.render import full_sigma
from wavebatch.tools.simulate.strip import TruthReader

ClassCounts = dict[str, tuple[int, int]]
"""Per class: echoes without a partner, and all echoes."""


@frozen
class Comparison:
    """What side a has in common with side b (another cloud or chain, or the truth). A share of nothing is NaN."""

    a: str
    b: str
    matched_by: str
    """`gps_time`: within pulses of equal time; `position`: mutual nearest neighbours; `waveform`: within each waveform
    of the strip, by time after its first sample."""
    tolerance_ns: float
    pulses: int
    """Pulses of both sides together (with a truth: its packets); 0 when matched by position."""
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
    """Pulses by number of echoes in a; pulses without an echo in a are known from b."""
    counts_b: dict[int, int]
    differences: dict[str, ErrorSpread]
    """time along the ray [ns, later is positive]; echo_time [ns], amplitude [DN], echo_width [ns] if both have it."""
    differences_by: dict[str, dict[str, dict[str, ErrorSpread]]] = field(default_factory=dict)
    """The same by `class` (LAS classes of b, or of a if b has none) and by `echoes` (of the pulse, likewise)."""
    errors: dict[str, dict[str, ErrorStats]] = field(default_factory=dict)
    """Only with a truth: errors by class (all, isolated, overlapped) and quantity.

    `time` is the error of the position; `echo_time`, if the cloud has it, the error of the fit alone.
    Medians and errors of more than a million pairs come from an even sample."""
    missed_by: dict[str, ClassCounts] = field(default_factory=dict)
    """Missed echoes by kind (return, class, amplitude or intensity, pulse, flag) and name: number missed, number in b.
    An echo counts for each of its flags. Intensity is used if b has no amplitudes."""
    extra_by: dict[str, ClassCounts] = field(default_factory=dict)
    """Extra echoes, as `missed_by`."""
    left_out_a: int = 0
    """Points of a that do not meet the condition of --where; they are not compared."""
    left_out_b: int = 0

    @property
    def identical(self) -> float:
        """Share of the echoes of both sides that the other side has too (Wagner et al., tables 1 and 2)."""
        return _share(2 * self.matched, self.echoes_a + self.echoes_b)

    @property
    def gain(self) -> float:
        """Additional echoes of a, as a share of those of b."""
        return _share(self.echoes_a - self.echoes_b, self.echoes_b)

    def to_json(self) -> dict:
        """Plain numbers, lists and dictionaries for JSON."""
        return {**asdict(self), "identical": self.identical, "gain": self.gain}


def compare_clouds(
    a: Path, b: Path, *, tolerance_ns: float = 1.0, selection: PointFilter = EVERY, in_memory: int = BUCKET_ROWS
) -> Comparison:
    """Compares the echoes of two clouds of one strip; b may be the strip itself, with the vendor's returns.

    Echoes of a pulse (equal GPS time) are the same if they are at most `tolerance_ns` apart along the ray, one to one,
    nearest first. If GPS times do not separate pulses, mutual nearest neighbours are the same. Points passed through
    without an echo are ignored. selection: only these points are compared, in both clouds. in_memory: rows at a time;
    large clouds need room in TMPDIR.
    Raises InputError for a file that cannot be read, ConfigError for a wrong tolerance, an unknown column, or
    coordinates without a length.
    """
    with CloudReader(a) as first, CloudReader(b) as second, open_task(first, second, tolerance_ns, in_memory) as task:
        for reader, side in ((first, 0), (second, 1)):
            reader.select(selection)
            for rows in read_echoes(reader):
                task.add(side, rows)
        found = task.finish(str(a), str(b))
    return replace(found, left_out_a=first.left_out, left_out_b=second.left_out)


def read_echoes(reader: CloudReader) -> Iterator[np.ndarray]:
    """Pieces of a cloud, without the points that were passed through."""
    for rows in reader.read_pieces():
        yield rows[(rows["flags"] & np.uint16(PASSED_THROUGH)) == 0]


_TRUTH_DTYPE = np.dtype([*((name, CLOUD_DTYPE[name]) for name in CLOUD_DTYPE.names), ("isolated", "?")])
PACKET_DTYPE = np.dtype([("gps_time", "<f8")])
"""A pulse that counts even if neither side has an echo in it."""


def compare_truth(
    a: Path, truth: Path, *, tolerance_ns: float = 1.5, selection: PointFilter = EVERY, in_memory: int = BUCKET_ROWS
) -> Comparison:
    """Compares the echoes of a cloud with the truth of its simulated strip; raises as compare_clouds does.

    selection: only these points of the cloud; the truth is whole, so that true echoes of other points are missed.
    in_memory: rows at a time.
    """
    with CloudReader(a) as cloud, TruthReader(truth) as reference:
        cloud.select(selection)
        points = max(cloud.point_count, reference.meta.get("packets", 0))
        names = ("gps_time", "x", "y", "z", "time", "amplitude", "sigma", "flags", "isolated")
        buckets = count_buckets(points, in_memory)
        with CloudTask(True, check_tolerance(tolerance_ns), buckets, reference.meta) as task:
            for rows in read_echoes(cloud):
                task.add(0, rows)
            for piece in reference.read_pieces(*names):
                rows = np.zeros(len(piece["gps_time"]), _TRUTH_DTYPE)
                rows["xyz"] = np.stack([piece[name] for name in "xyz"], axis=1)
                for name in ("gps_time", "amplitude", "flags", "isolated"):
                    rows[name] = piece[name]
                # The truth has the main lobe's width; a target never narrows a pulse.
                sigma, pulse = piece["sigma"].astype(np.float64), reference.pulse
                whole = (sigma > 0.25 * pulse.sigma) & (sigma < 25 * pulse.sigma)
                sigma[whole] = full_sigma(pulse, sigma[whole])
                rows["echo_time"], rows["echo_width"] = piece["time"], sigma * FWHM_PER_SIGMA
                task.add(1, rows)
            for piece in reference.read_pieces("packet_gps_time"):
                task.add(2, piece["packet_gps_time"].view(PACKET_DTYPE))
            return replace(task.finish(str(a), str(truth)), left_out_a=cloud.left_out)


def check_tolerance(tolerance_ns: float) -> float:
    """The tolerance; ConfigError if it is not above 0, or longer than any waveform."""
    if not 0 < tolerance_ns < 1e6:
        raise ConfigError(f"tolerance {tolerance_ns:g} ns (--within): must be above 0 and below 1e6")
    return tolerance_ns


# Rows of both sides, in buckets on disk

LEAST_SHARED = 0.05
"""Share of the pulses that two clouds of one strip have in common at least; else echoes are matched by position."""


def open_task(first: CloudReader, second: CloudReader, tolerance_ns: float, in_memory: int = BUCKET_ROWS) -> CloudTask:
    """A comparison by GPS time if both clouds have times that separate pulses and share some, else by position."""
    by_time = times_separate_pulses(first) and times_separate_pulses(second)
    if by_time:
        # Formats round times differently: those of one flight in two formats are equal by chance only. So enough pulses
        # of the first piece of the shorter cloud must be in the other cloud.
        short, long = sorted((first, second), key=lambda reader: reader.point_count)
        times = np.unique(next(short.read_pieces(), np.empty(0, CLOUD_DTYPE))["gps_time"])
        found = np.zeros(len(times), bool)
        for piece in long.read_pieces():
            found |= np.isin(times, piece["gps_time"])
            if np.count_nonzero(found) > LEAST_SHARED * len(times):
                break
        else:
            by_time = not len(times)
    for reader in (first, second):
        reader.measure_in_metres()
    points = max(first.point_count, second.point_count)
    task = CloudTask(by_time, check_tolerance(tolerance_ns), count_buckets(points, in_memory))
    if not by_time and task.number > 1:
        # Borders along x, so that all buckets have about the same number of points.
        some = np.concatenate([rows["xyz"][::100, 0] for rows in first.read_pieces()])
        task.borders = np.quantile(some, np.arange(1, task.number) / task.number)
    return task


class CloudTask(Closing):
    """One comparison: `add` puts rows of both sides into buckets, `finish` compares bucket by bucket.

    A context manager, because temporary files hold the rows.
    """

    def __init__(self, by_time: bool, tolerance_ns: float, buckets: int, meta: dict | None = None) -> None:
        self.by_time, self.pairing = by_time, Pairing(tolerance_ns, meta)
        self.number = buckets
        dtypes = (CLOUD_DTYPE, _TRUTH_DTYPE if meta else CLOUD_DTYPE, PACKET_DTYPE)
        self.buckets = [Spool(self.number, dtype) for dtype in dtypes]
        self.borders = np.empty(0)

    def close(self) -> None:
        """Removes the temporary files."""
        for bucket in self.buckets:
            bucket.close()

    def add(self, side: int, rows: np.ndarray) -> None:
        """Adds rows of a (side 0), of b (1) or of the truth's packets (2)."""
        if self.by_time:
            self.buckets[side].append(spread_keys(time_keys(rows["gps_time"]), self.number), rows)
        else:
            # Each point goes to its slab, and to the neighbouring slabs that it is close to.
            low = np.searchsorted(self.borders, rows["xyz"][:, 0] - 2 * self.pairing.tolerance)
            high = np.searchsorted(self.borders, rows["xyz"][:, 0] + 2 * self.pairing.tolerance)
            steps = range(int((high - low).max(initial=0)) + 1)
            inside = [np.flatnonzero(low + step <= high) for step in steps]
            bucket = [low[near] + step for step, near in zip(steps, inside, strict=True)]
            self.buckets[side].append(np.concatenate(bucket), rows[np.concatenate(inside)])

    def finish(self, name_a: str, name_b: str) -> Comparison:
        """Compares bucket by bucket and sums up."""
        for number in range(self.number):
            a, b, packets = (bucket.read(number) for bucket in self.buckets)
            if self.by_time:
                self.pairing.pair_by_time(a, b, packets)
            else:
                inside = (np.searchsorted(self.borders, rows["xyz"][:, 0]) == number for rows in (a, b))
                self.pairing.pair_by_place(a, b, *inside)
        return self.pairing.finish(name_a, name_b, "gps_time" if self.by_time else "position")


# Pairs

MOST_PER_PULSE = 64
"""More echoes than this with one GPS time are not a pulse: such times are missing or rounded."""
MOST_PAIRS = 20_000_000
"""Most pairs of such echoes that are looked at; each needs about 100 bytes."""


class Pairing:
    """Pairs echoes of a and b (CLOUD_DTYPE) part by part, and sums up counts and differences.

    tolerance_ns: largest distance of the same echo along the ray. meta: metadata of the truth, if b is one. limit: most
    pairs that are kept for medians.
    """

    def __init__(self, tolerance_ns: float, meta: dict | None = None, limit: int | None = None) -> None:
        self.tolerance, self.tolerance_ns = tolerance_ns * AIR_SPEED, tolerance_ns
        self.meta = meta
        self.pulses = self.exact = self.matched = 0
        self.echoes = [0, 0]
        self.counts = [np.zeros(1, np.int64), np.zeros(1, np.int64)]
        self.differences = Differences(limit)
        self.breakdowns = (Breakdown(), Breakdown())

    def pair_by_time(self, a: np.ndarray, b: np.ndarray, packets: np.ndarray) -> None:
        """Adds whole pulses: echoes of equal gps_time belong to one pulse.

        packets: gps_time of each pulse that counts, with or without echoes; if empty, all pulses with an echo count.
        Raises InputError if too many echoes of one pulse lie within reach of each other.
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
        for side, number in enumerate((number_a, number_b)):
            new = np.bincount(number[counted], minlength=len(self.counts[side]))
            new[: len(self.counts[side])] += self.counts[side]
            self.counts[side] = new
        # The same echo: of one pulse and at most `tolerance` apart, one to one, nearest first.
        xyz_a, xyz_b = a["xyz"], b["xyz"]
        crowd = np.maximum(number_a, number_b) > MOST_PER_PULSE
        calm_a, calm_b = (np.flatnonzero(~crowd[pulse]) for pulse in (in_a, in_b))
        # The difference in height is never larger than the distance: a fast first choice of pairs.
        left, right = list_pairs(in_a[calm_a], xyz_a[calm_a, 2], in_b[calm_b], xyz_b[calm_b, 2], self.tolerance)
        left, right = calm_a[left], calm_b[right]
        if crowd.any():
            # Among points with one GPS time, heights would leave too many pairs to check.
            rows_a, rows_b = (np.flatnonzero(crowd[pulse]) for pulse in (in_a, in_b))
            if len(rows_a) and len(rows_b):
                trees = scipy.spatial.cKDTree(xyz_a[rows_a]), scipy.spatial.cKDTree(xyz_b[rows_b])
                if trees[0].count_neighbors(trees[1], self.tolerance) > MOST_PAIRS:
                    raise InputError(
                        f"{len(rows_a)} and {len(rows_b)} points share their GPS times with more than {MOST_PER_PULSE} "
                        "others and lie too close together to be paired; remove the points without a valid GPS time"
                    )
                near = trees[0].sparse_distance_matrix(trees[1], self.tolerance, output_type="ndarray")
                near_a, near_b = rows_a[near["i"]], rows_b[near["j"]]
                same = in_a[near_a] == in_b[near_b]
                left, right = np.append(left, near_a[same]), np.append(right, near_b[same])
        distance = np.linalg.norm(xyz_a[left] - xyz_b[right], axis=1)
        near = np.flatnonzero(distance <= self.tolerance)
        left, right = left[near], right[near]
        kept = pair_nearest(left, right, distance[near], len(xyz_a), len(xyz_b))
        left, right = left[kept], right[kept]
        self.differences.add(a[left], b[right])
        self._count(0, a, left, number_b[in_a])
        self._count(1, b, right, number_a[in_b])
        self.matched += len(left)

    def pair_by_place(self, a: np.ndarray, b: np.ndarray, inside_a: np.ndarray, inside_b: np.ndarray) -> None:
        """Adds a region: mutual nearest neighbours are pairs.

        inside_a, inside_b: echoes in the region, bool (k,); the others are only neighbours of these.
        """
        left = right = np.empty(0, np.int64)
        if len(a) and len(b):
            to_b, nearest_b = scipy.spatial.cKDTree(b["xyz"]).query(a["xyz"], distance_upper_bound=self.tolerance)
            _, nearest_a = scipy.spatial.cKDTree(a["xyz"]).query(b["xyz"], distance_upper_bound=self.tolerance)
            left = np.flatnonzero(np.isfinite(to_b))
            right = nearest_b[left]
            mutual = nearest_a[right] == left
            left, right = left[mutual], right[mutual]
        self._count(0, a, left, None, inside_a)
        self._count(1, b, right, None, inside_b)
        # A pair across a border belongs to the region of its echo of a, so that it counts once.
        inside = inside_a[left]
        self.differences.add(a[left[inside]], b[right[inside]])
        self.matched += int(inside.sum())

    def finish(self, name_a: str, name_b: str, matched_by: str) -> Comparison:
        """The comparison of all parts."""
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
            counts_a={number: int(pulses) for number, pulses in enumerate(self.counts[0]) if pulses},
            counts_b={number: int(pulses) for number, pulses in enumerate(self.counts[1]) if pulses},
            differences=self.differences.spreads(),
            differences_by={
                kind: {name_class(number) if kind == "class" else str(number): one for number, one in group.items()}
                for kind, group in self.differences.groups().items()
            },
            errors=self.differences.errors(self.meta) if self.meta else {},
            missed_by=self.breakdowns[1].tables(),
            extra_by=self.breakdowns[0].tables(),
        )

    def _count(
        self,
        side: int,
        rows: np.ndarray,
        paired: np.ndarray,
        others: np.ndarray | None,
        inside: np.ndarray | slice = slice(None),
    ) -> None:
        """Counts echoes of one side; others: number of echoes of the other side in the pulse of each."""
        alone = np.ones(len(rows), bool)
        alone[paired] = False
        rows, alone = rows[inside], alone[inside]
        self.echoes[side] += len(rows)
        self.breakdowns[side].add(rows, alone, others)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


# Differences of pairs

_BOTH = ("echo_time", "amplitude", "echo_width")
"""Columns that are compared if both sides have them."""
GROUPED_BY = {"class": "classification", "echoes": "total"}
"""By what differences are grouped: the LAS class, and the number of echoes of the pulse."""


@frozen
class ErrorSpread:
    """Differences a minus b of one quantity, over the echoes that both sides have."""

    number: int
    median: float
    mean: float
    rms: float
    nmad: float


class Differences:
    """Collects pairs of echoes (CLOUD_DTYPE): sums of all pairs, and an even sample of them for medians."""

    def __init__(self, limit: int | None = None) -> None:
        self._sample = EvenSample(limit)
        self.sums = {name: np.zeros(3) for name in ("time", *_BOTH)}
        self._grouped = {
            (kind, side, name): np.zeros((256, 3)) for kind in GROUPED_BY for side in "ab" for name in self.sums
        }

    def add(self, a: np.ndarray, b: np.ndarray) -> None:
        """Adds pairs: a[i] with b[i]."""
        part = {name: a[name].astype(np.float64) - b[name] for name in _BOTH}
        # Distance of a after b along the ray [m], positive away from the sensor. The ray is the packet vector of b, or
        # of a; without both, the lower point counts as the farther one.
        step = a["xyz"] - b["xyz"]
        ray = np.where(np.any(b["ray"] != 0, axis=1)[:, None], b["ray"], a["ray"]).astype(np.float64)
        length = np.linalg.norm(ray, axis=1)
        known = length > 0
        down = -np.sign(ray[:, 2]) / np.where(known, length, 1.0)
        along = np.einsum("ij,ij->i", step, ray) * down
        by_height = np.linalg.norm(step, axis=1) * -np.sign(step[:, 2])
        part["time"] = np.where(known & (down != 0), along, by_height) / AIR_SPEED
        for name, values in part.items():
            good = values[~np.isnan(values)]
            self.sums[name] += [len(good), good.sum(), np.square(good).sum()]
            for kind, column in GROUPED_BY.items():
                for side, rows in (("a", a), ("b", b)):
                    group = rows[column][~np.isnan(values)]
                    sums = self._grouped[kind, side, name]
                    for place, weights in enumerate((None, good, np.square(good))):
                        sums[:, place] += np.bincount(group, weights, len(sums))
        for name in ("amplitude_err", "echo_width_err", "range_err"):
            part[name] = a[name]
        for name in ("amplitude", "echo_width", "flags"):
            part[f"true_{name}"] = b[name]
        for kind, column in GROUPED_BY.items():
            part |= {f"{kind}_a": a[column], f"{kind}_b": b[column]}
        part["isolated"] = b["isolated"] if "isolated" in b.dtype.names else np.zeros(len(b), bool)
        self._sample.add(part)

    def spreads(self) -> dict[str, ErrorSpread]:
        """Median, mean, rms and NMAD of a minus b, for each quantity that both sides have."""
        data = self._sample.read()
        return {name: _spread(sums, data[name]) for name, sums in self.sums.items() if sums[0]}

    def groups(self) -> dict[str, dict[int, dict[str, ErrorSpread]]]:
        """The same by kind of GROUPED_BY and by number: of the class, and of the echoes that the pulse has.

        A pair belongs to the group of its echo of b; where b has no groups (all are 0), to that of its echo of a.
        Kinds in which both sides have none are left out. Medians of rare groups are NaN if the sample has none of them.
        """
        data, result = self._sample.read(), {}
        for kind in GROUPED_BY:
            side = next((side for side in "ba" if self._grouped[kind, side, "time"][1:, 0].any()), None)
            if side is None:
                continue
            result[kind] = {
                group: {
                    name: _spread(sums[group], data[name][data[f"{kind}_{side}"] == group])
                    for name in self.sums if (sums := self._grouped[kind, side, name])[group, 0]
                }
                for group in np.flatnonzero(self._grouped[kind, side, "time"][:, 0]).tolist()
            }  # fmt: skip
        return result

    def errors(self, meta: dict) -> dict[str, dict[str, ErrorStats]]:
        """Errors of time [ns], amplitude [DN] and sigma [ns], in units of the bound and of the reported errors."""
        data = self._sample.read()
        if not data:
            return {}
        sigma = data["true_echo_width"].astype(np.float64) / FWHM_PER_SIGMA
        amplitude = data["true_amplitude"].astype(np.float64)
        sigma[~(sigma > 0)] = amplitude[~(amplitude > 0)] = np.nan  # of a damaged truth: there is no bound
        reported = {name: data[name].astype(np.float64) for name in ("range_err", "amplitude_err", "echo_width_err")}
        bounds = crlb(amplitude, sigma, meta["noise_std"], meta["spacing"])
        columns = {
            "time": (data["time"], bounds[0], reported["range_err"] / AIR_SPEED),
            "echo_time": (data["echo_time"], bounds[0], reported["range_err"] / AIR_SPEED),
            "amplitude": (data["amplitude"], bounds[1], reported["amplitude_err"]),
            "sigma": (data["echo_width"] / FWHM_PER_SIGMA, bounds[2], reported["echo_width_err"] / FWHM_PER_SIGMA),
        }
        classes = {
            "all": np.ones(len(sigma), bool),
            "isolated": data["isolated"],
            "overlapped": (data["true_flags"] & np.uint16(EchoFlag.OVERLAPPED)) != 0,
        }
        found: dict[str, dict[str, ErrorStats]] = {kind: {} for kind in classes}
        for kind, rows in classes.items():
            for name, (error, bound, expected) in columns.items():
                known = rows & ~np.isnan(error)
                found[kind][name] = ErrorStats.compute(error[known], bound[known], expected[known])
        return found


def _spread(sums: np.ndarray, values: np.ndarray) -> ErrorSpread:
    """The spread from number, sum and sum of squares of all pairs, and from the differences of a sample of them."""
    number, total, squares = sums.tolist()
    values = values[~np.isnan(values)]
    median = np.median(values) if len(values) else np.nan
    nmad = MAD_TO_STD * np.median(np.abs(values - median)) if len(values) else np.nan
    return ErrorSpread(int(number), float(median), total / number, float(np.sqrt(squares / number)), float(nmad))


# Echoes without a partner, by possible reasons

_OCTAVES = 18
"""Classes of amplitude: below 1, then one per doubling; the last one holds everything larger."""
_NUMBERS = 16
"""Return numbers that a LAS point can hold, 0 to 15."""


def name_class(number: int) -> str:
    """A LAS class with its name, if the standard has one."""
    return f"{number} {CLASS_NAMES[number]}" if number in CLASS_NAMES else str(number)


_OCTAVE_NAMES = ["below 1", *(f"{1 << n}-{2 << n}" for n in range(_OCTAVES - 2)), f"from {1 << (_OCTAVES - 2)}"]
_NAMES = {
    "return": [f"{number} of {total}" for total in range(_NUMBERS) for number in range(_NUMBERS)],
    "class": [name_class(number) for number in range(256)],
    "amplitude": _OCTAVE_NAMES,
    "intensity": _OCTAVE_NAMES,
    "pulse": ["nothing of the other side", "other echoes of the other side"],
    "flag": [*(flag.name for flag in EchoFlag), "none"],
}
"""Per kind of class the names of its classes."""


class Breakdown:
    """Counts echoes of one side, with and without a partner on the other side, by possible reasons."""

    def __init__(self) -> None:
        self._tallies = {kind: np.zeros((len(names), 2), np.int64) for kind, names in _NAMES.items()}

    def add(self, rows: np.ndarray, alone: np.ndarray, others: np.ndarray | None) -> None:
        """Adds echoes (k,), CLOUD_DTYPE.

        alone: echoes without a partner, bool (k,). others: number of echoes of the other side in the pulse of each
        echo, (k,); None if unknown.
        """
        numbered = rows["number"] > 0
        code = np.minimum(rows["total"], _NUMBERS - 1) * np.int64(_NUMBERS) + np.minimum(rows["number"], _NUMBERS - 1)
        self._count("return", code[numbered], alone[numbered])
        self._count("class", rows["classification"], alone)
        known = ~np.isnan(rows["amplitude"])
        for kind, kept in (("amplitude", known), ("intensity", slice(None))):
            values = np.clip(rows[kind][kept].astype(np.float64), 0.0, 1e9)
            self._count(kind, np.clip(np.frexp(values)[1], 0, _OCTAVES - 1).astype(np.int64), alone[kept])
        if others is not None:
            self._count("pulse", (others > 0).astype(np.int64), alone)
        flags = [*((rows["flags"] & np.uint16(flag)) != 0 for flag in EchoFlag), rows["flags"] == 0]
        for place, has in enumerate(flags):
            self._count("flag", np.full(int(has.sum()), place), alone[has])

    def _count(self, kind: str, code: np.ndarray, alone: np.ndarray) -> None:
        tally = self._tallies[kind]
        tally[:, 0] += np.bincount(code[alone], minlength=len(tally))
        tally[:, 1] += np.bincount(code, minlength=len(tally))

    def tables(self) -> dict[str, ClassCounts]:
        """For each kind the classes that have an echo; kinds without data are left out.

        `intensity` is there only without amplitudes and if not all are 0; `flag` and `class` only if any echo has one.
        """
        tables = {}
        for kind, tally in self._tallies.items():
            rows = np.flatnonzero(tally[:, 1]).tolist()
            tables[kind] = {_NAMES[kind][row]: (int(tally[row, 0]), int(tally[row, 1])) for row in rows}
        if tables["amplitude"] or set(tables["intensity"]) <= {_OCTAVE_NAMES[0]}:
            del tables["intensity"]
        if set(tables["flag"]) <= {"none"}:
            del tables["flag"]
        if set(tables["class"]) <= {name_class(0)}:
            del tables["class"]
        return {kind: table for kind, table in tables.items() if table}
