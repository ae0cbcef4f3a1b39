"""The pulses of a strip as rays: the signal of all packets of a pulse on one axis, and how far light is known on it.

`strip.voxelize_strip` lists the signal of every block, joins the packets of each pulse and adds the rays to the grid.
Between two packets of a pulse nothing was recorded, because no light came back that triggers the digitizer: it counts
as empty air. Nothing here may depend on other pulses than the ray's.

A pulse's packets lie in one unit or in two that follow each other, in any order: `read_batches` gives them together.
Batches do not depend on processes, and results must not depend on batches.

`find_rule` finds the reflectance ratio of canopy and ground. Without the right one, the share of a voxel is no
interception: leaves of .5 over ground of .15 hide a gap probability of .61 as one of .41.

`deconvolve_block` makes profiles of the waveforms: deconvolved, noise removed, placed by the returns of their packets.
A profile does not depend on the other waveforms of its block.

`Floor` and `Ceiling` are maps of the lowest and of the highest returns of a strip. The floor divides the signal of
a ray into ground and canopy, without any classification: light of a ray is shared between them, so signal that is
wrongly taken for ground changes gap probabilities by the ratio of both reflectances only. Above the ceiling rays cross
only air; without --headroom each ray is counted from there, so that voxels near the surface get all light that crossed
them, whether recorded or not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import join_ranges, quantile
from wavebatch.core.schema import Above, Range, check_options, option
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.cloud.point_filter import PlannedFilter
from wavebatch.files.las.header import locate, read_scanner
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.kernels.geometry.group_returns import LONGEST_PULSE, along_ray, find_rays, group_times, on_ray
from wavebatch.kernels.geometry.planes import fit_planes
from wavebatch.kernels.physics import radiometry
from wavebatch.kernels.physics.gap_probability import ASSUMED_ERROR, estimate_canopy_ratio
from wavebatch.kernels.signal import deconvolve
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, smooth_121, widen
from wavebatch.stages.detect.direct import signal_above
from wavebatch.stages.noise import pooled
from wavebatch.stages.pulse_tables import clip_level, reference_pulse
from wavebatch.surveying.measuring.learn_pulse import AFTER, BEFORE

ITERATIONS = {"richardson_lucy": 40, "gold": 100}
"""Default iterations: Gold converges more slowly (docs/algorithms.md 2.5)."""

SNR = 20.0
"""Default ratio of amplitude to noise for the Wiener filter."""

SUPPORT = 2.0
"""Smoothed samples above this many standard deviations of their noise may hold signal."""

LEAST_TO_KEEP = 0.1
"""Deconvolved samples below this share of the least signal, spread over the pulse, are set to zero."""

ADDED_LEVEL = 3.0
"""Level added to waveform and model of the Richardson-Lucy iteration, which needs positive values [noise std]."""

TOLERANCE = 2.5
"""Largest distance between the location of a return and its signal [ns], beyond half a sample."""

AT_A_TIME = 1024
"""Waveforms deconvolved together: few enough for the cache."""

_PULSE_REACH = 4.0
"""Half length of a Gaussian pulse, and margin around signal, in widths of the system pulse."""


@frozen
class Deconvolution:
    """How waveforms are deconvolved, and how much signal counts as noise."""

    method: Literal["richardson_lucy", "gold", "wiener"] = option(
        "richardson_lucy", "How waveforms are deconvolved with the system pulse."
    )
    iterations: Annotated[int | None, Range(1, 10_000)] = option(
        None, "Iterations: more resolve closer surfaces, but take longer.", form="N", unset="40; gold: 100"
    )
    snr: Annotated[float | None, Above(0.0, 1e9)] = option(
        None, "wiener: amplitude over noise for which the filter is designed.", form="RATIO", unset="20"
    )
    threshold: Annotated[float, Range(0.0, 1e9)] = option(
        4.27, "Ignore signal weaker than a single echo of this many standard deviations of the noise.", form="STD"
    )

    def __post_init__(self) -> None:
        check_options(self)
        if self.iterations is not None and self.method == "wiener":
            raise ConfigError("--method wiener has no --iterations")
        if self.snr is not None and self.method != "wiener":
            raise ConfigError("--snr needs --method wiener")

    @property
    def steps(self) -> int | None:
        """Iterations; None for the linear filter."""
        return self.iterations or ITERATIONS.get(self.method)


@frozen(eq=False)
class Profiles:
    """Signal of n waveforms along their rays."""

    value: np.ndarray
    """Heights of system pulses, one at every sample, whose sum is the waveform, f8 (n, s) [DN]; 0: no signal."""
    area: float
    """Integral of a system pulse of height 1 [ns]."""
    seen: np.ndarray
    """Waveforms with any signal, bool (n,)."""
    offset: np.ndarray
    """Delay of the signal after the returns of its packet, f8 (n,) [ns]; 0 where unknown."""
    anchored: np.ndarray
    """Waveforms with a known offset, bool (n,)."""
    clipped: np.ndarray
    """Waveforms with samples at the digitizer's limit, bool (n,)."""


def deconvolve_block(
    block: WaveformBlock, system: SystemPulse, options: Deconvolution, louder: np.random.Generator | None = None
) -> Profiles:
    """Profiles of a block: waveforms without baseline and noise, deconvolved with the system pulse.

    Runs of samples whose sum is less than `threshold` standard deviations of a lone echo's amplitude are dropped.
    louder: adds as much noise as there is.
    """
    system = system.of(block)
    taps, area = _pulse_taps(system, block.spacing)
    noise = pooled(block, system)
    signal = signal_above(block, noise)
    if louder is not None:
        signal += noise.std * louder.standard_normal(signal.shape, np.float32)
        noise = replace(noise, std=np.float32(2.0**0.5) * noise.std)
    n, s = block.samples.shape
    support = widen(smooth_121(signal) > np.float32(SUPPORT * SMOOTH_GAIN) * noise.std, 1)
    width = system.sigma_ref / block.spacing
    first, length = deconvolve.window_signal(support, int(np.ceil(_PULSE_REACH * width)))
    # Standard deviation of the sum of a lone echo's profile, in units of that of a sample: of the iterations near that
    # of the matched filter, of the linear filter by its taps.
    error = 1.0 / np.sqrt(np.sum(taps**2))
    if options.method == "wiener":
        inverse = deconvolve.wiener_taps(taps, (options.snr or SNR) ** -2.0, 4 * len(taps))
        box = np.ones(2 * max(int(round(width)), 1) + 1)
        error = np.sqrt(np.sum(np.convolve(inverse, box) ** 2))
    least = options.threshold * float(error)
    floor = LEAST_TO_KEEP * max(least, 1e-3) / max(width, 1.0)
    value, seen = np.zeros((n, s)), np.zeros(n, bool)
    # Waveforms with windows of equal length together; those without signal are left out.
    order = np.argsort(length, kind="stable")
    edges = np.append(np.flatnonzero(np.diff(length[order], prepend=0)), n)
    groups = (order[at : min(at + AT_A_TIME, high)] for low, high in pairwise(edges.tolist())
              for at in range(low, high, AT_A_TIME))  # fmt: skip
    for rows in groups:
        place = first[rows] + np.arange(length[rows[0]])[:, None]
        std = noise.std[rows].astype(np.float64)
        part = signal[place, rows]
        if options.method == "wiener":
            profile = deconvolve.deconvolve_wiener(part, taps, (options.snr or SNR) ** -2.0)
        elif options.method == "gold":
            profile = deconvolve.deconvolve_gold(part, taps, options.steps)
        else:
            level = np.float32(ADDED_LEVEL) * noise.std[rows]
            profile = deconvolve.deconvolve_richardson_lucy(part, taps, level, options.steps)
        near = np.ascontiguousarray(support[place, rows].T)
        kept, seen[rows] = deconvolve.keep_signal(np.ascontiguousarray(profile.T), near, least * std, floor * std)
        if options.method != "richardson_lucy":  # that iteration keeps the energy, the others do not
            kept = deconvolve.fit_height(kept, part, taps, near)
        if block.missing is not None:
            kept = np.where(block.missing[rows[:, None], place.T], 0.0, kept)
        value[rows[:, None], place.T] = kept
    offset, anchored = np.zeros(n), np.zeros(n, bool)
    if block.returns is not None and len(block.returns):
        reach = int(np.ceil(TOLERANCE / block.spacing + 0.5))
        row = block.returns.waveform.astype(np.int64)
        offset, anchored = deconvolve.measure_offsets(value, row, block.returns.time / block.spacing, reach)
        offset = offset * block.spacing
    clipped = (block.samples >= clip_level(block, system)).any(axis=1)
    return Profiles(value, area, seen, offset, anchored, clipped)


def _pulse_taps(system: SystemPulse, spacing: float) -> tuple[np.ndarray, float]:
    """Samples of the system pulse of height 1, with tail and after-pulses, and its integral [ns].

    A learned pulse is cut where the echoes it was learned from were cut: beyond, its Gaussians are extrapolated.
    """
    if not system.components:
        taps = reference_pulse(system, spacing, "system", _PULSE_REACH).taps
        return taps, float(np.sum(taps)) * spacing
    width = system.sigma_ref / spacing
    unit = max(width / 2, 1.0)
    given = reference_pulse(system, spacing, "system", AFTER * unit / width)
    lag = np.arange(len(given.taps)) - given.middle
    taps = np.where((lag >= -BEFORE * unit) & (lag <= AFTER * unit), given.taps, 0.0)
    return taps, float(np.sum(taps)) * spacing


MOST_CELLS = 1 << 18
"""Largest number of cells."""

_REACH = 1 << 28
_SHIFT = np.int64(1 << 30)
AROUND = np.array([a * _SHIFT + b for a in (-1, 0, 1) for b in (-1, 0, 1)])
"""From the key of a cell to those of the cell and of the eight around it, i8 (9,)."""


class CellMap:
    """The lowest or the highest return of each cell.

    middle: a position in the strip; returns more than 2^28 cells from it are ignored. cell: side of the cells [m];
    it is doubled where there are more cells than `most`. highest: keep the highest returns.
    """

    def __init__(self, middle: np.ndarray, cell: float, *, highest: bool, most: int = MOST_CELLS) -> None:
        self._most = most
        self._middle = np.array([middle[0], middle[1], 0.0])
        self.cell = cell
        self._sign = -1.0 if highest else 1.0
        self._key = np.empty(0, np.int64)
        self._kept = np.empty((0, 3))
        """Returns from the middle, one per key, f8 (n, 3) [m]."""

    def add(self, xyz: np.ndarray) -> None:
        """Adds returns (m, 3) [m]."""
        local = xyz - self._middle
        index = np.floor(local[:, :2] / self.cell)
        good = (np.abs(index) < _REACH).all(axis=1) & np.isfinite(xyz[:, 2])
        self._kept = np.concatenate([self._kept, local[good]])
        while True:  # the outermost one of each cell stays
            local, key = self._kept, self._key_of(self._kept)
            order = np.lexsort((local[:, 1], local[:, 0], self._sign * local[:, 2], key))
            first = np.append(True, np.diff(key[order]) != 0)[: len(key)]
            self._key, self._kept = key[order][first], local[order][first]
            if len(self._key) <= self._most:
                break
            self.cell *= 2.0

    @property
    def places(self) -> np.ndarray:
        """Positions of the returns that are kept, f8 (n, 3) [m]."""
        return self._kept + self._middle

    def _key_of(self, local: np.ndarray) -> np.ndarray:
        """Keys of the cells, i8 (m,), of positions from the middle (m, 3)."""
        index = np.clip(np.nan_to_num(np.floor(local[:, :2] / self.cell)), -_REACH, _REACH).astype(np.int64)
        return index[:, 0] * _SHIFT + index[:, 1]

    def _row_of(self, key: np.ndarray) -> np.ndarray:
        """Rows of cells, -1 where there is none."""
        if not len(self._key):
            return np.full(key.shape, -1)
        at = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        return np.where(self._key[at] == key, at, -1)


GROUND_CELL = 5.0
"""Cell of the map [m]: in each, some return should have reached the ground."""

STEEPEST_GROUND = 0.5
"""Least vertical part of the normal of a cell's ground: steeper planes are no ground, the cell is level."""

LEAST_AROUND = 4
"""Least number of lowest returns in a cell and the eight around it for a slope."""

LEAST_WIDTH = 0.1
"""Least standard deviation of these returns across their longest direction [cells]: a single row has no slope."""


class Floor(CellMap):
    """Ground below a strip: a plane through the lowest returns of each cell and of the eight around it.

    middle, most: as for CellMap.
    """

    def __init__(self, middle: np.ndarray, most: int = MOST_CELLS) -> None:
        super().__init__(middle, GROUND_CELL, highest=False, most=most)
        self._slope = np.empty((0, 2))
        self.steep = 0.0
        """Rise per metre that half of the planes exceed: roofs, where they are the lowest returns, are fewer."""

    def finish(self) -> Floor:
        """Fits the planes; returns the map."""
        row = self._row_of(self._key[:, None] + AROUND)
        cell, number = np.nonzero(row >= 0)
        offset = self._kept[row[cell, number]] - self._kept[cell]
        planes = fit_planes(offset, cell, len(row))
        normal = np.where(planes.normal[:, 2:] < 0, -planes.normal, planes.normal)
        usable = (planes.kept >= LEAST_AROUND) & (normal[:, 2] >= STEEPEST_GROUND)
        usable &= planes.spreads[:, 1] > (LEAST_WIDTH * self.cell) ** 2
        up = np.where(usable, normal[:, 2], 1.0)[:, None]
        self._slope = np.where(usable[:, None], -normal[:, :2] / up, 0.0)
        if usable.any():
            self.steep = quantile(np.hypot(*self._slope[usable].T), 0.5)
        # The plane, not the lowest return itself: that may lie below the ground.
        base = planes.centre[:, 2] - (self._slope * planes.centre[:, :2]).sum(axis=1)
        self._kept[:, 2] += np.where(usable, base, 0.0)
        return self

    def measure_height(self, place: np.ndarray) -> np.ndarray:
        """Height (n,) of positions (n, 3) above the ground [m]; infinite where there is no map."""
        local = place - self._middle
        row = self._row_of(self._key_of(local))
        if not len(self._key):
            return np.full(len(place), np.inf)
        low, slope = self._kept[row], self._slope[row]
        ground = low[:, 2] + ((local[:, :2] - low[:, :2]) * slope).sum(axis=1)
        height = local[:, 2] - ground
        return np.where((row >= 0) & np.isfinite(height), height, np.inf)


LEAST_CELL = 4.0
"""Least cell of the map [m]."""

VOXELS_PER_CELL = 4.0
"""Least cell of the map, in voxels."""

ABOVE_RETURNS = 3.0
"""Height above the highest return up to which there can be signal without a return [m]."""

FLATTEST_RAY = 0.1
"""Least vertical part of a ray: flatter rays are not followed upwards."""

MOST_STEPS = 1024
"""Cells over which a ray is followed at most."""


class Ceiling(CellMap):
    """Highest return of each cell of a map and its eight neighbours.

    middle, most: as for CellMap. size: of the voxels [m].
    """

    def __init__(self, middle: np.ndarray, size: float, most: int = MOST_CELLS) -> None:
        super().__init__(middle, max(LEAST_CELL, VOXELS_PER_CELL * size), highest=True, most=most)
        self._top = np.empty(0)

    def finish(self) -> Ceiling:
        """Raises every cell to the highest around it; returns the map."""
        self._key, row = np.unique(self._key[:, None] + AROUND, return_inverse=True)
        self._top = np.full(len(self._key), -np.inf)
        np.maximum.at(self._top, row.ravel(), np.repeat(self._kept[:, 2] + ABOVE_RETURNS, len(AROUND)))
        return self

    def measure_headroom(self, start: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Distance (n,) [m] from positions (n, 3) back along the rays to where they are above all returns."""
        with np.errstate(invalid="ignore", divide="ignore"):
            up = -step / np.sqrt((step * step).sum(axis=1))[:, None]
        headroom = np.zeros(len(start))
        rows = np.flatnonzero((up[:, 2] >= FLATTEST_RAY) & np.isfinite(start).all(axis=1))
        for number in range(MOST_STEPS):
            way = number * self.cell
            place = start[rows] + up[rows] * way
            rows, place = (values[place[:, 2] < self._top.max(initial=-np.inf)] for values in (rows, place))
            if not len(rows):
                break
            row = self._row_of(self._key_of(place - self._middle))
            below = place[:, 2] < np.where(row >= 0, self._top[row], -np.inf)
            headroom[rows[below]] = way + self.cell
        return headroom


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
        lost = {one: found for one, found in lost.items() if one >= number - 1}
        for one, unit in units.items():
            if one not in lost:  # the returns of the unit whose packet is missing or broken
                points = unit.points[unit.packet_of_point < 0]
                channel = read_scanner(points)
                lost[one] = np.zeros(len(points), LOST)
                lost[one]["time"], lost[one]["place"] = points["gps_time"], locate(points, reader.facts.header)
                lost[one]["scanner"] = 0 if channel is None else channel
        rows = [np.flatnonzero(unit.packets.owned) for unit in units.values()]
        rows[0] = rows[0][~np.isin(units[number].packets.owner[rows[0]], taken)]
        tables = list(zip(units.values(), rows, strict=True))
        owner = np.concatenate([unit.packets.owner[some] for unit, some in tables])
        time = np.concatenate([unit.points["gps_time"][unit.packets.owner[some] - unit.start] for unit, some in tables])
        group = group_times(time)
        here = np.flatnonzero(group < len(rows[0]))
        taken = owner[here[here >= len(rows[0])]]
        # Lost returns of equal time with packets, with their group.
        known = np.concatenate(list(lost.values()))
        values, first, count = np.unique(time, return_index=True, return_counts=True)
        known = known[np.isin(known["time"], values) & (known["time"] != 0)]
        at = np.searchsorted(values, known["time"])
        known["group"] = owner[first[at]]
        known = known[count[at] < LONGEST_PULSE]
        kept = np.ones(len(owner), bool)
        if keep is not None:
            kept = np.concatenate([unit.choose_packets(keep)[some] for unit, some in tables])
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


@frozen(eq=False)
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
        samples = self.samples[join_ranges(table["first"], table["count"])]
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
    # Of two packets that overlap, each counts to the middle of what both recorded: there, echoes are far from the ends
    # of both. A packet inside another one does not count.
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
    packet = np.argsort(packets["group"], kind="stable")[join_ranges(low, number)]
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

LEAST_LEFT = 0.01
"""Light that is lost to a hundredth is not known at all."""

HIDDEN_QUANTILE = 0.05
"""Quantile of the light in packets that is stated as the most that a gap between packets hides."""


@frozen
class LightRule:
    """How signal along a ray becomes light that was caught there."""

    ratio: float = 1.0
    """Reflectance of canopy over that of ground."""
    error: float | None = None
    """Its standard deviation, with what noise hides; None where it was assumed."""
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


def find_rule(sample: Sequence[Rays], given: float | None, louder: Sequence[Rays] = ()) -> LightRule:
    """The rule by which signal counts as light, from the rays of a sample of the pulses.

    louder: the same rays in more noise; the error of the ratio then holds the light that noise hides. Weak ground below
    leaves, or weak leaves, are lost in the noise, which then counts as light of the other, and moves the ratio.
    Simulated, noise 1.4 times as strong loses about as much as is lost already.
    """
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
    rule = replace(
        rule,
        usual=float(light[light > 0].mean()) if (light > 0).any() else 0.0,
        hidden_light=float(np.quantile(share, HIDDEN_QUANTILE)) if len(share) else None,
    )
    if not louder or rule.source not in ("strip", "given"):
        return rule
    sums = [[sum(one.samples[name].sum() for one in traced) for name in ("canopy", "ground")]
            for traced in (sample, louder)]  # fmt: skip
    before, after = np.array([[*sums[0], rule.ratio], [*sums[1], find_rule(louder, given).ratio]])
    known = before > 0
    lost = np.log(np.maximum(after[known] / before[known], LEAST_LEFT))
    return replace(rule, error=rule.ratio * math.hypot(rule.log_error, *lost.tolist()))
