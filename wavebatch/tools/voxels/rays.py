"""The pulses of a strip as rays: the signal of all packets of a pulse on one axis, and how far light is known on it.

`strip.voxelize_strip` lists the signal of every block, joins the packets of each pulse and adds the rays to the grid.
Between two packets of a pulse nothing was recorded, because no light came back that triggers the digitizer: it counts
as empty air. Nothing here may depend on other pulses than the ray's.

A pulse's packets lie in one unit or in two that follow each other, in any order: `read_batches` gives them together.
Batches do not depend on processes, and results must not depend on batches.

`find_rule` finds the reflectance ratio of canopy and ground. Without the right one, the share of a voxel is no
interception: leaves of .5 over ground of .15 hide a gap probability of .61 as one of .41.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.cloud.point_filter import PlannedFilter
from wavebatch.files.las.header import locate
from wavebatch.files.strip.reader import StripReader, StripScan, Unit, read_scanner
from wavebatch.files.strip.shared_packets import expand
from wavebatch.kernels.geometry.group_returns import LONGEST_PULSE, along_ray, find_rays, group_times, on_ray
from wavebatch.kernels.physics import radiometry
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio
from wavebatch.tools.voxels.floor import Floor
from wavebatch.tools.voxels.profile import Profiles

BATCH_SAMPLES = 1 << 20
"""Samples read at a time."""

LOST = np.dtype([("time", "f8"), ("group", "i8"), ("scanner", "u1"), ("place", "f8", 3)])
"""Returns whose packet is missing or broken."""


class Batch(NamedTuple):
    """Packets of whole pulses."""

    parts: list[tuple[Unit, np.ndarray, np.ndarray, np.ndarray]]
    """Units, rows of their packets, the index in the file of the first packet of equal time of each, and whether `keep`
    keeps a point of it.
    """
    lost: np.ndarray
    """Returns of these pulses whose packet is missing or broken, LOST (k,)."""


def read_batches(
    reader: StripReader,
    scan: StripScan,
    *,
    numbers: Sequence[int] | None = None,
    choose: Callable[[np.ndarray], np.ndarray] | None = None,
    keep: PlannedFilter | None = None,
    block_size: int | None = None,
) -> Iterator[Batch]:
    """Yield all packets of a strip, or of the units `numbers`, in batches.

    choose: of the groups of a unit, those to read. keep: of points; only groups with such a point are read.
    block_size: packets per batch; as many as have BATCH_SAMPLES if not given. A batch ends with its last pulse.
    """
    units: dict[int, Unit] = {}
    lost: dict[int, np.ndarray] = {}
    taken = np.empty(0, np.int64)
    for number in range(reader.unit_count()) if numbers is None else numbers:
        near = [one for one in (number, number + 1) if one < reader.unit_count()]
        units = {one: units.get(one) or reader.read_unit(one, scan) for one in near}
        lost = {one: lost.get(one, np.empty(0, LOST)) for one in (number - 1, *near)}
        lost |= {one: _list_lost(reader, unit) for one, unit in units.items() if not len(lost[one])}
        rows = [np.flatnonzero(unit.packets.owned) for unit in units.values()]
        rows[0] = rows[0][~np.isin(units[number].packets.owner[rows[0]], taken)]
        tables = list(zip(units.values(), rows, strict=True))
        owner = np.concatenate([unit.packets.owner[some] for unit, some in tables])
        time = np.concatenate([unit.points["gps_time"][unit.packets.owner[some] - unit.start] for unit, some in tables])
        group = group_times(time)
        here = np.flatnonzero(group < len(rows[0]))
        taken = owner[here[here >= len(rows[0])]]
        known = _match_lost(np.concatenate(list(lost.values())), time, owner)
        kept = np.ones(len(owner), bool)
        if keep is not None:
            kept = np.concatenate([_choose_packets(unit, keep)[some] for unit, some in tables])
            here = here[np.isin(group[here], group[kept])]
        if choose is not None:
            here = here[np.isin(group[here], choose(np.unique(group[here])))]
        here = here[np.argsort(group[here], kind="stable")]
        cost = np.concatenate([unit.packets.n_samples[some] for unit, some in tables])[here]
        cost, limit = (np.maximum(cost, 1), BATCH_SAMPLES) if block_size is None else (np.ones(len(here)), block_size)
        starts = np.append(True, np.diff(group[here]) != 0)[: len(here)]
        before = (np.cumsum(cost) - cost)[np.flatnonzero(starts)] // limit
        for some in np.split(here, np.flatnonzero(np.diff(before[np.cumsum(starts) - 1])) + 1):
            groups = owner[group[some]]
            parts = []
            for (unit, mine), shift in zip(tables, (0, len(rows[0])), strict=False):
                inside = (some >= shift) & (some < shift + len(mine))
                parts.append((unit, mine[some[inside] - shift], groups[inside], kept[some[inside]]))
            if len(some):
                yield Batch(parts, known[np.isin(known["group"], groups)])


def _list_lost(reader: StripReader, unit: Unit) -> np.ndarray:
    """The returns of a unit without a packet that can be read."""
    points = unit.points[unit.packet_of_point < 0]
    lost = np.zeros(len(points), LOST)
    lost["time"], lost["place"] = points["gps_time"], locate(points, reader.facts.header)
    scanner = read_scanner(points)
    lost["scanner"] = 0 if scanner is None else scanner
    return lost


def _match_lost(lost: np.ndarray, time: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Those of equal time with packets, with their group."""
    values, first, count = np.unique(time, return_index=True, return_counts=True)
    if not len(values):
        return lost[:0]
    at = np.minimum(np.searchsorted(values, lost["time"]), len(values) - 1)
    lost["group"] = owner[first[at]]
    return lost[(values[at] == lost["time"]) & (lost["time"] != 0) & (count[at] < LONGEST_PULSE)]


def _choose_packets(unit: Unit, keep: PlannedFilter) -> np.ndarray:
    """Whether a point of each packet of the unit is kept, bool (packets,)."""
    chosen = np.zeros(len(unit.packets.owned) + 1, bool)
    chosen[unit.packet_of_point[keep.test(unit.points, len(unit.points)) == 0]] = True
    if len(unit.context):
        chosen[unit.packet_of_context[keep.test(unit.context, len(unit.context)) == 0]] = True
    return chosen[:-1]  # the last one is that of points without a packet, -1


MOST_SECTION = 2.0**14
"""Larger cross sections of a waveform count as unknown: no target has them [m2]."""

PACKET = np.dtype(
    [("point", "i8"), ("group", "i8"), ("scanner", "u1"), ("gps_time", "f8"), ("start", "f8", 3), ("step", "f8", 3),
     ("begin", "f8"), ("end", "f8"), ("seen", "?"), ("anchored", "?"), ("clipped", "?"), ("unknown", "?"),
     ("kept", "?")]
)  # fmt: skip
"""A packet: its first point; position of sample 0 [m] and direction [m/ns]; when it begins and ends after sample 0
[ns], half a sample before and after what was recorded; whether --where keeps a point of it."""

SAMPLE = np.dtype(
    [("packet", "i8"), ("time", "f8"), ("spacing", "f8"), ("energy", "f8"), ("canopy", "f8"), ("ground", "f8"),
     ("section", "f8")]
)  # fmt: skip
"""A sample with signal: row of its packet, time after sample 0 and to the next sample [ns], energy [DN ns], the same as
light from canopy or from ground (times the square of the range, where it is known), cross section [m2]."""

RAY = np.dtype(
    [*((name, *PACKET[name].subdtype) if PACKET[name].subdtype else (name, PACKET[name]) for name in PACKET.names),
     ("known", "f8"), ("first", "i8"), ("count", "i8"), ("packets", "i8")]
)  # fmt: skip
"""A pulse: what its first packet along the ray has, but `begin` and `end` of all of them; the time up to which its
light is known (infinite, unless a packet was lost); its samples; its packets."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of n pulses."""

    table: np.ndarray
    """RAY (n,)."""
    samples: np.ndarray
    """SAMPLE (m,), ray after ray, in the order of time after sample 0 of the ray's first packet."""

    @property
    def owner(self) -> np.ndarray:
        """Ray of each sample."""
        return np.repeat(np.arange(len(self.table)), self.table["count"])

    def take(self, rows: np.ndarray | slice) -> Rays:
        """Some of the rays."""
        table = self.table[rows]
        samples = self.samples[expand(table["first"], table["count"])]
        table["first"] = np.cumsum(table["count"]) - table["count"]
        return Rays(table, samples)


def list_signal(
    block: WaveformBlock,
    profiles: Profiles,
    group: np.ndarray,
    floor: Floor,
    ground_height: float,
    system: SystemPulse | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The packets of a block, PACKET (n,), and their samples with signal, SAMPLE (m,).

    group: equal for packets of equal time. system: calibrated, for cross sections; None: without them.
    """
    packets = np.zeros(len(block), PACKET)
    packets["point"], packets["group"], packets["gps_time"] = block.point, group, block.gps_time
    packets["scanner"] = 0 if block.scanner is None else block.scanner
    packets["start"] = block.origin - block.direction * profiles.offset[:, None]
    packets["step"], packets["begin"] = block.direction, -0.5 * block.spacing
    packets["end"] = (block.samples.shape[1] - 0.5) * block.spacing
    packets["seen"], packets["anchored"], packets["clipped"] = profiles.seen, profiles.anchored, profiles.clipped
    row, sample = np.nonzero(profiles.value)
    value = profiles.value[row, sample]
    samples = np.zeros(len(row), SAMPLE)
    samples["packet"], samples["time"], samples["spacing"] = row, sample * block.spacing, block.spacing
    samples["energy"] = light = value * profiles.area
    place = packets["start"][row] + block.direction[row] * samples["time"][:, None]
    away = None
    if block.sensor is not None:
        away = measure_lengths(place - block.sensor[row])
        light = light * np.where(np.isfinite(away), away**2, 1.0)
    ground = floor.measure_height(place) <= ground_height
    samples["canopy"], samples["ground"] = np.where(ground, 0.0, light), np.where(ground, light, 0.0)
    if system is not None:
        samples["section"], packets["unknown"] = _measure_sections(block, row, value, away, system)
    return packets, samples


def join_packets(packets: np.ndarray, samples: np.ndarray, lost: np.ndarray) -> Rays:
    """The rays of pulses with all of their packets, in any order, and their returns without a packet."""
    order = np.argsort(packets["point"], kind="stable")
    packets = packets[order]
    head = find_rays(packets["group"], packets["scanner"], packets["start"], packets["step"])
    shift = along_ray(packets["start"], packets["start"][head], packets["step"][head])
    shift = np.where(head == np.arange(len(head)), 0.0, shift)
    along = np.lexsort((shift + packets["begin"], head))
    packets, head, shift, order = packets[along], head[along], shift[along], order[along]
    new = np.append(True, np.diff(head) != 0)[: len(head)]
    ray, first = np.cumsum(new) - 1, np.flatnonzero(new)
    shift = shift - shift[first][ray]
    begin, end = packets["begin"] + shift, packets["end"] + shift
    low, high = _share_overlaps(ray, first, begin, end)

    table = np.zeros(len(first), RAY)
    for name in PACKET.names:
        table[name] = packets[name][first]
    table["point"] = np.minimum.reduceat(packets["point"], first)
    table["packets"] = np.bincount(ray, minlength=len(first))
    for name in ("seen", "clipped", "unknown", "kept"):
        table[name] = np.logical_or.reduceat(packets[name], first)
    table["anchored"] = np.logical_and.reduceat(packets["anchored"] | ~packets["seen"], first) & table["seen"]
    table["known"] = _find_known(packets, ray, begin, end, table, lost)

    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    samples = samples.copy()
    samples["packet"] = row[samples["packet"]]
    samples["time"] += shift[samples["packet"]]
    samples = samples[(samples["time"] >= low[samples["packet"]]) & (samples["time"] < high[samples["packet"]])]
    samples = samples[np.lexsort((samples["time"], ray[samples["packet"]]))]
    owner = ray[samples["packet"]]
    table["count"] = np.bincount(owner, minlength=len(first))
    table["first"] = np.cumsum(table["count"]) - table["count"]
    # No light is known to have gone further than the last signal.
    last = np.maximum.reduceat(end, first)
    some = np.flatnonzero(table["count"])
    final = samples[table["first"][some] + table["count"][some] - 1]
    last[some] = final["time"] + 0.5 * final["spacing"]
    table["end"] = np.where(table["known"] < np.inf, np.maximum(last, table["known"]), last)
    return Rays(table, samples)


def _share_overlaps(
    ray: np.ndarray, first: np.ndarray, begin: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The times between which each packet counts, where packets of a ray, sorted by `begin`, overlap.

    Of two that overlap, each counts to the middle of what both recorded: there, echoes are far from the ends of both. A
    packet inside another one does not count.
    """
    low, high, last = begin.copy(), end.copy(), first.copy()
    rank = np.arange(len(ray)) - first[ray]
    for number in range(1, int(rank.max(initial=0)) + 1):
        row = np.flatnonzero(rank == number)
        before = last[ray[row]]
        inside, apart = end[row] <= end[before], begin[row] >= end[before]
        middle = 0.5 * (begin[row] + end[before])
        low[row] = np.where(inside, np.inf, np.where(apart, begin[row], middle))
        high[before] = np.where(inside | apart, high[before], middle)
        last[ray[row]] = np.where(inside, before, row)
    return low, high


def _find_known(
    packets: np.ndarray, ray: np.ndarray, begin: np.ndarray, end: np.ndarray, table: np.ndarray, lost: np.ndarray
) -> np.ndarray:
    """Time up to which the light of each ray is known: the end of the last packet before a lost one, f8 (n,) [ns].

    A return inside another packet of its ray lost nothing.
    """
    known = np.full(len(table), np.inf)
    group = np.sort(packets["group"])
    number = np.searchsorted(group, lost["group"], "right") - (low := np.searchsorted(group, lost["group"]))
    one = np.repeat(np.arange(len(lost)), number)
    packet = np.argsort(packets["group"], kind="stable")[expand(low, number)]
    own = ray[packet]
    start, step = table["start"][own], table["step"][own]
    near = (lost["scanner"][one] == table["scanner"][own]) & on_ray(lost["place"][one], start, step)
    one, packet, own = one[near], packet[near], own[near]
    time = along_ray(lost["place"][one], start[near], step[near])
    pair, at = np.unique(one * len(table) + own, return_inverse=True)
    covered, before = np.zeros(len(pair), bool), np.full(len(pair), -np.inf)
    np.logical_or.at(covered, at, (begin[packet] <= time) & (time <= end[packet]))
    np.maximum.at(before, at, np.where(end[packet] < time, end[packet], -np.inf))
    np.minimum.at(known, pair % max(len(table), 1), np.where(covered, np.inf, before))
    return known


def measure_lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (n,) of vectors (n, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = (vectors[:, axis] * vectors[:, axis] for axis in range(3))
        return np.sqrt(x + y + z)


def _measure_sections(
    block: WaveformBlock, row: np.ndarray, value: np.ndarray, away: np.ndarray | None, system: SystemPulse
) -> tuple[np.ndarray, np.ndarray]:
    """Cross section of each sample (m,) [m2], and waveforms where it is unknown, bool (n,).

    C' pi divergence^2 / 4 R^4 A sigma / eta(R) of a system pulse as high as the profile (docs/algorithms.md 5), with C'
    and pulse of the waveform's channel. away: range of each sample [m].
    """
    system = system.of(block)
    if away is None:
        return np.zeros(len(row)), np.bincount(row, minlength=len(block)) > 0
    constant, _ = system.calibrate(block)
    distance = radiometry.known_distance(away)
    with np.errstate(over="ignore", invalid="ignore"):
        attenuation = system.radiometry.attenuation
        gamma = radiometry.backscatter(constant[row], distance, value, system.sigma_ref, attenuation)
        section = radiometry.compute_cross_section(gamma, distance, 1e-3 * system.radiometry.divergence)
    # A sample without range makes the sum of its waveform NaN, which the comparison counts as unknown.
    with np.errstate(invalid="ignore", over="ignore"):
        unknown = ~(np.bincount(row, section, minlength=len(block)) <= MOST_SECTION)
    return np.where(unknown[row], 0.0, section), unknown


LEAST_CANOPY = 0.01
"""Share of the light from the canopy below which its ratio to the ground does not matter."""

ASSUMED_ERROR = float(np.log(2.0))
"""Standard deviation of the logarithm of a ratio that the strip does not show: leaves and soils of .15 to .5."""

WEAKEST = 0.05
"""Quantile of the light in packets that is stated as the most that a gap between packets hides."""


@dataclass(frozen=True, slots=True)
class LightRule:
    """How signal along a ray becomes light that was caught there."""

    ratio: float = 1.0
    """Reflectance of canopy over that of ground."""
    error: float | None = None
    """Its standard deviation; None where it was given or assumed."""
    source: str = "assumed"
    """`given`, `strip`, `assumed` (1, because the strip does not show it), or `no canopy`."""
    usual: float = 0.0
    """Light of a pulse, in the mean: that of pulses of which a packet was lost."""
    hidden_light: float | None = None
    """Share of a pulse's light that may hide between two of its packets; None without pulses of several packets."""

    @property
    def log_error(self) -> float:
        """Standard deviation of the logarithm of the ratio."""
        return ASSUMED_ERROR if self.source == "assumed" else (self.error or 0.0) / self.ratio

    def weigh(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """Share of its ray's light that was caught at each sample, and the part of it that the ground caught, f8 (m,).

        0 where it is not known.
        """
        owner, known = rays.owner, rays.table["known"]
        ground = np.where(rays.samples["time"] < known[owner], self.ratio * rays.samples["ground"], 0.0)
        light = ground + np.where(rays.samples["time"] < known[owner], rays.samples["canopy"], 0.0)
        whole = np.bincount(owner, light, minlength=len(known))
        whole = np.where(known < np.inf, np.maximum(whole, self.usual), whole)
        whole = np.where(whole > 0, whole, 1.0)[owner]
        return light / whole, ground / whole


def find_rule(sample: Iterable[Rays], given: float | None) -> LightRule:
    """The rule by which signal counts as light, from the rays of a sample of the pulses."""
    pulses, packets = [np.zeros((2, 0))], [np.zeros((4, 0))]
    for rays in sample:
        owner, n = rays.owner, len(rays.table)
        complete = rays.table["known"] == np.inf
        whole = np.stack([np.bincount(owner, rays.samples[name], n) for name in ("canopy", "ground")])
        pulses.append(whole[:, complete])
        # Packets of a ray follow each other.
        first = np.flatnonzero(np.diff(rays.samples["packet"], prepend=-1))
        if len(first):
            part = np.stack([np.add.reduceat(rays.samples[name], first) for name in ("canopy", "ground")])
            used = (complete & (rays.table["packets"] > 1))[owner[first]]
            packets.append(np.concatenate([part, whole[:, owner[first]]])[:, used])
    canopy, ground = np.concatenate(pulses, axis=1)
    rule = LightRule(1.0 if given is None else given, None, "assumed" if given is None else "given")
    if given is None and canopy.sum() < LEAST_CANOPY * (canopy.sum() + ground.sum()):
        rule = replace(rule, source="no canopy")
    elif given is None and (found := estimate_canopy_ratio(canopy, ground)) is not None:
        rule = LightRule(found.ratio, found.error, "strip")
    light = canopy + rule.ratio * ground
    part, part_ground, whole, whole_ground = np.concatenate(packets, axis=1)
    share = (part + rule.ratio * part_ground) / (whole + rule.ratio * whole_ground)
    return replace(
        rule,
        usual=float(light[light > 0].mean()) if (light > 0).any() else 0.0,
        hidden_light=float(np.quantile(share, WEAKEST)) if len(share) else None,
    )
