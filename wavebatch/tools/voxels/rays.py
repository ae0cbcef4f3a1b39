"""The pulses of a strip as rays: the signal of all packets of a pulse on one axis, and how far light is known on it.

`strip.voxelize_strip` lists the signal of every block, joins the packets of each pulse and adds the rays to the grid.
Between two packets of a pulse nothing was recorded, because no light came back that triggers the digitizer: it counts
as empty air. Nothing here may depend on other pulses than the ray's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.shared_packets import expand
from wavebatch.kernels.geometry.group_returns import along_ray, find_rays, on_ray
from wavebatch.kernels.physics import radiometry
from wavebatch.tools.voxels.floor import Floor
from wavebatch.tools.voxels.profile import Profiles

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
