"""The calibration of several strips and channels together: on targets where they lie, on tie cells everywhere else.

`wavebatch calibrate` calls `calibrate_flight` for any number of strips. Before you change it: a strip that nothing ties
to a target has no constant, and a constant never goes from one channel to another without ties.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.waveforms import angle_to_vertical, swath_columns
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.calibrating.adjust_flight import Adjustment, Anchors, adjust_constants
from wavebatch.surveying.calibrating.flight_overlaps import PairOverlap, compare_pairs, find_doubts
from wavebatch.surveying.calibrating.strip_channels import SCANNERS, see_channels
from wavebatch.surveying.calibrating.strip_echoes import ECHO, EchoSource
from wavebatch.surveying.calibrating.target_file import Target
from wavebatch.surveying.calibrating.targets import (
    MOST_ECHOES,
    CalibrationOptions,
    build_calibration,
    describe_channel,
    measure_ranging,
    open_strip_source,
)
from wavebatch.surveying.calibrating.tie_cells import TIE, VIEW, Ties, choose_size, hash_squares, measure_ties
from wavebatch.surveying.calibrating.trends import LEAST_SPREAD, Trend, find_trend, fit_swath
from wavebatch.surveying.calibration import Calibration, ChannelConstant, StripConstant, TargetResult, check_attenuation

MOST_TIES = 200_000
"""Most waveforms of a strip that are decomposed for ties; they come from whole squares of 10 m, spread by chance."""

_UNEXPLAINED = (
    "the strips' light from one place differs by more than their constants explain: check targets, trajectory and "
    "whether the overlaps are wet, rough or planted"
)

_Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper corner in x and y [m]."""


@dataclass(frozen=True, slots=True)
class FlightCalibration:
    """A calibration of several strips, and how they agree."""

    calibration: Calibration
    pairs: tuple[PairOverlap, ...] = ()
    cell: float = 0.0
    """Edge of the tie cells [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Strip:
    """What is kept of one strip."""

    path: Path
    sha256: str
    found: Calibration | None
    """The calibration by targets on this strip."""
    refused: str
    channels: tuple[int, ...]
    described: tuple[ChannelConstant, ...]
    """How each of the channels records."""
    ranging: float
    """Relative error of a constant from the error of the sensor's position."""
    ties: np.ndarray
    """Array of TIE, with channels as sources."""
    seen: Mapping[int, np.void]
    """How the targets were seen by each channel, as VIEW."""


def calibrate_flight(
    paths: Sequence[Path], targets: Sequence[Target], options: CalibrationOptions | None = None
) -> FlightCalibration:
    """Calibrate all channels of one or more strips, so that they agree on targets and where they overlap.

    Parameters
    ----------
    paths : sequence of Path
        Strips of one flight.
    targets : sequence of Target
        Each may lie on any of the strips.
    options : CalibrationOptions, optional

    Returns
    -------
    FlightCalibration

    Raises
    ------
    InputError
        Where no target on any strip gives a constant, a strip cannot be read, or strips have different descriptors of
        one number.

    Notes
    -----
    docs/algorithms.md 5.3.
    """
    options = options or CalibrationOptions()
    check_attenuation(options.attenuation)
    boxes = [_find_box(path) for path in paths]
    origin = boxes[0][0]
    strips = [_read_strip(path, i, boxes, targets, options) for i, path in enumerate(paths)]
    good = [strip for strip in strips if strip.found is not None]
    if not good:
        raise InputError(strips[0].refused if len(strips) == 1 else "; ".join(strip.refused for strip in strips))
    sources = [(i, channel) for i, strip in enumerate(strips) for channel in strip.channels]
    if len(sources) == 1 and not options.scan_angle:
        return FlightCalibration(good[0].found)
    ties = _tie(strips, sources, origin)
    anchors, seen = _list_given(strips, sources, options)
    swath: tuple[float, ...] = ()
    if options.scan_angle:
        adjusted, swath = fit_swath(ties, anchors, seen)
        ties = replace(ties, value=ties.value + swath_columns(ties.view["angle"], swath[0]) @ swath[1:])
        anchors = replace(anchors, value=anchors.value - swath_columns(seen["angle"], swath[0]) @ swath[1:])
    else:
        adjusted = adjust_constants(ties, anchors)
    calibration = replace(_assemble(strips, sources, adjusted, options), swath=swath)
    names = [_name(strips, source) for source in sources]
    pairs = tuple(compare_pairs(ties, adjusted, names))
    notes = [*calibration.notes, *find_doubts(names, adjusted, calibration.strips, pairs)]
    calibration, more = _widen(calibration, adjusted, find_trend(ties, anchors, seen, adjusted))
    return FlightCalibration(replace(calibration, notes=(*notes, *more)), pairs, ties.size)


def _widen(calibration: Calibration, adjusted: Adjustment, trend: Trend | None) -> tuple[Calibration, list[str]]:
    """The calibration with what the overlaps leave unexplained in its errors, and the sentence about it where it is
    more than these."""
    spread = adjusted.scatter if trend is None else max(adjusted.scatter, trend.spread)
    if spread < LEAST_SPREAD:
        return calibration, []
    stated = max(row.relative_error for row in calibration.strips)
    reason = _UNEXPLAINED if trend is None else trend.doubt
    note = f"{reason}; the error of the constants grows from {100 * stated:.1f} by {100 * spread:.1f} %"
    channels, strips = (
        tuple(replace(row, relative_error=math.hypot(row.relative_error, spread)) for row in rows)
        for rows in (calibration.channels, calibration.strips)
    )
    whole = math.hypot(calibration.relative_error, spread)
    notes = [note] if spread > stated else []
    return replace(calibration, relative_error=whole, channels=channels, strips=strips), notes


def _find_box(path: Path) -> _Box:
    """Lower and upper corner of a strip in x and y by its header."""
    with StripReader(path) as reader:
        header = reader.facts.header
        return np.array(header.mins[:2]), np.array(header.maxs[:2])


def _read_strip(
    path: Path,
    number: int,
    boxes: Sequence[_Box],
    targets: Sequence[Target],
    options: CalibrationOptions,
) -> _Strip:
    """Decompose what lies on targets or in the overlap with other strips, in one pass."""
    with open_strip_source(path, options) as source:
        header = source.reader.facts.header
        targets = [target.place(path, header) for target in targets]
        seen = see_channels(source.reader, source.scan)
        known = source.reader.facts.digitizers  # points may name others: they have no waveform
        channels = tuple(SCANNERS * digitizer + scanner for digitizer, scanner in seen if digitizer in known)
        others = [box for i, box in enumerate(boxes) if i != number]
        area = _TieArea(
            boxes[number], boxes[0][0], [boxes[number]] if len(channels) > 1 else others, source.scan.packets
        )
        on_targets, ties = _collect(source, targets, area)
        found, refused = None, ""
        try:
            found = build_calibration(source, targets, on_targets, options)
        except InputError as error:
            refused = str(error)
        blank = [ChannelConstant(channel // SCANNERS, channel % SCANNERS, 1.0, 0.0) for channel in channels]
        distance = np.array([source.sensor.distance or math.inf])
        return _Strip(
            path=path,
            sha256=take_fingerprint(path, source.reader.facts.packets.file)["sha256_sampled"],
            found=found,
            refused=refused,
            channels=channels,
            described=tuple(describe_channel(row, source) for row in blank),
            ranging=measure_ranging(source.sensor, distance, options.attenuation),
            ties=ties,
            seen=_see_targets(on_targets),
        )


def _see_targets(on_targets: Sequence[np.ndarray]) -> dict[int, np.void]:
    """How each channel saw the targets in the middle, as VIEW; good targets are level."""
    rows, seen = np.concatenate(on_targets), {}
    for channel in np.unique(rows["channel"]).tolist():
        mine, view = rows[rows["channel"] == channel], np.zeros(1, VIEW)[0]
        view["angle"] = view["incidence"] = np.median(angle_to_vertical(mine["ray"]))
        view["distance"], view["time"] = np.median(mine["distance"]), np.median(mine["time"])
        seen[channel] = view
    return seen


class _TieArea:
    """Where a strip is decomposed for ties: squares in the boxes of those that it is tied to."""

    def __init__(self, own: _Box, origin: np.ndarray, tied: Sequence[_Box], packets: int) -> None:
        self.origin, self._tied = origin, tied
        area = float(np.prod(np.maximum(own[1] - own[0], 1.0)))
        common = [np.maximum(np.minimum(own[1], top) - np.maximum(own[0], low), 0.0) for low, top in tied]
        shared = min(sum(float(np.prod(edge)) for edge in common), area)
        self._share = MOST_TIES / max(packets * shared / area, MOST_TIES)
        """Of the squares, so that about MOST_TIES waveforms are decomposed."""

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        """Return which positions f8 (n, 3) count, bool (n,)."""
        inside = np.zeros(len(xyz), bool)
        for low, top in self._tied:
            inside |= ((xyz[:, :2] >= low) & (xyz[:, :2] <= top)).all(axis=1)
        return inside & (hash_squares(xyz) < self._share)


def _collect(source: EchoSource, targets: Sequence[Target], area: _TieArea) -> tuple[list[np.ndarray], np.ndarray]:
    """Echoes on each target (ECHO), and those for ties (TIE, with channels as sources)."""
    corners = np.concatenate([target.corners for target in targets])
    low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
    on_targets: list[list[np.ndarray]] = [[np.empty(0, ECHO)] for _ in targets]
    parts = [np.empty(0, TIE)]

    def wanted(xyz: np.ndarray) -> np.ndarray:
        return ((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1) | area.contains(xyz)

    for rows in source.echoes(wanted):
        x, y = rows["xyz"][:, 0], rows["xyz"][:, 1]
        for target, some in zip(targets, on_targets, strict=True):
            if sum(map(len, some)) < MOST_ECHOES:
                some.append(rows[target.contains(x, y)])
        parts.append(_shorten(rows[area.contains(rows["xyz"])], area.origin))
    return [np.concatenate(some)[:MOST_ECHOES] for some in on_targets], np.concatenate(parts)


def _shorten(rows: np.ndarray, origin: np.ndarray) -> np.ndarray:
    short = np.empty(len(rows), TIE)
    short["xyz"] = rows["xyz"] - [*origin, 0.0]
    short["source"] = rows["channel"]
    for name in ("ray", "light", "distance", "time"):
        short[name] = rows[name]
    return short


def _tie(strips: Sequence[_Strip], sources: Sequence[tuple[int, int]], origin: np.ndarray) -> Ties:
    """The tie cells of all sources."""
    parts = [np.empty(0, TIE)]
    for number, (i, channel) in enumerate(sources):
        rows = strips[i].ties[strips[i].ties["source"] == channel]
        rows["source"] = number
        parts.append(rows)
    rows = np.concatenate(parts)
    return measure_ties(rows, choose_size(rows))


def _list_given(
    strips: Sequence[_Strip], sources: Sequence[tuple[int, int]], options: CalibrationOptions
) -> tuple[Anchors, np.ndarray]:
    """Constants by targets with their errors without that of the reflectance, which strips that see the same targets
    share; and how each source saw its targets, array of VIEW (n,), NaN without."""
    value, error = np.full((2, len(sources)), np.nan)
    seen = np.full(len(sources), np.nan, VIEW)
    for number, (i, channel) in enumerate(sources):
        found = strips[i].found
        for row in found.channels if found else ():
            if SCANNERS * row.digitizer + row.scanner == channel:
                rest = row.relative_error**2 - _reflectance_error([found], options) ** 2
                value[number], error[number] = math.log(row.constant), math.sqrt(max(rest, 1e-6))
                seen[number] = strips[i].seen[channel]
    return Anchors(value, error), seen


def _reflectance_error(found: Sequence[Calibration], options: CalibrationOptions) -> float:
    """What the reflectance's error does to the constants: targets that several strips saw count once."""
    names = {(row.name, row.reflectance) for one in found for row in one.targets if row.constant is not None}
    return options.reflectance_error / math.sqrt(len(names))


def _assemble(
    strips: Sequence[_Strip], sources: Sequence[tuple[int, int]], adjusted: Adjustment, options: CalibrationOptions
) -> Calibration:
    """The calibration of the flight: a constant per channel, and one per channel and strip."""
    good = [strip.found for strip in strips if strip.found is not None]
    shared = _reflectance_error(good, options)
    channels, rows, scatter = [], [], _drift_scatter(sources, adjusted)
    for channel in sorted({channel for _, channel in sources}):
        mine = [k for k, (_, other) in enumerate(sources) if other == channel and np.isfinite(adjusted.value[k])]
        if not mine:
            continue
        mean, trials = float(adjusted.value[mine].mean()), adjusted.trials[:, mine]
        # A channel of one strip says nothing of its drift: it is credited with that of the others.
        apart = float(np.std(adjusted.value[mine], ddof=1)) if len(mine) > 1 else scatter
        ranging = float(np.mean([strips[sources[k][0]].ranging for k in mine]))
        error = float(np.sqrt(np.std(trials.mean(axis=1), ddof=1) ** 2 + shared**2 + apart**2 + ranging**2))
        channels.append(_describe_row(strips, sources, mine, math.exp(mean), error))
        rows += _list_strips(strips, sources, mine, adjusted, shared)
    constants = np.array([row.constant for row in channels])
    error = float(np.hypot(np.std(constants) / constants.mean(), max(row.relative_error for row in channels)))
    return replace(
        good[0],
        constant=float(np.median(constants)),
        relative_error=error,
        strip=", ".join(strip.path.name for strip in strips),
        conditions=good[0].conditions if len(strips) == 1 else f"{len(strips)} strips, {good[0].conditions}",
        targets=tuple(_list_targets(strips)),
        channels=tuple(channels),
        strips=tuple(rows),
        notes=tuple(
            note if len(strips) == 1 else f"{strip.path.name}: {note}"
            for strip in strips
            if strip.found
            for note in strip.found.notes
        ),
    )


def _list_strips(
    strips: Sequence[_Strip],
    sources: Sequence[tuple[int, int]],
    mine: Sequence[int],
    adjusted: Adjustment,
    shared: float,
) -> Iterator[StripConstant]:
    """The constants of one channel on each strip; mine: its sources, shared: error of the targets' reflectance."""
    values, trials = adjusted.value[mine], adjusted.trials[:, mine]
    errors = np.std(trials - trials.mean(axis=1)[:, None], axis=0, ddof=1)
    for k, drift, error in zip(mine, np.expm1(values - values.mean()), errors, strict=True):
        strip, channel = strips[sources[k][0]], sources[k][1]
        yield StripConstant(
            strip=strip.path.name,
            sha256=strip.sha256,
            digitizer=channel // SCANNERS,
            scanner=channel % SCANNERS,
            constant=math.exp(adjusted.value[k]),
            relative_error=float(np.sqrt(adjusted.error[k] ** 2 + shared**2 + strip.ranging**2)),
            drift=float(drift),
            drift_error=float(error),
            ties=int(adjusted.ties[k]),
        )


def _drift_scatter(sources: Sequence[tuple[int, int]], adjusted: Adjustment) -> float:
    """Standard deviation of the logarithms of a channel's constants between strips; 0 where no channel has two."""
    channel = np.array([other for _, other in sources])
    squares, freedom = 0.0, 0
    for one in np.unique(channel):
        values = adjusted.value[(channel == one) & np.isfinite(adjusted.value)]
        squares += float(np.sum((values - values.mean()) ** 2)) if len(values) else 0.0
        freedom += max(len(values) - 1, 0)
    return math.sqrt(squares / freedom) if freedom else 0.0


def _list_targets(strips: Sequence[_Strip]) -> Iterator[TargetResult]:
    """What the targets gave on each strip; those without any echo on a strip of several are left out."""
    for strip in strips:
        for row in strip.found.targets if strip.found else ():
            if len(strips) == 1:
                yield row
            elif row.echoes:
                yield replace(row, name=f"{row.name} on {strip.path.name}")


def _describe_row(
    strips: Sequence[_Strip], sources: Sequence[tuple[int, int]], mine: Sequence[int], constant: float, error: float
) -> ChannelConstant:
    """The row of a channel with how it records, and what targets say of its scatter; InputError for two recordings."""
    i, channel = sources[mine[0]]
    kinds = [strips[sources[k][0]].described[strips[sources[k][0]].channels.index(channel)] for k in mine]
    first = kinds[0]
    for k, kind in zip(mine, kinds, strict=True):
        if (kind.bits, kind.spacing_ns, kind.gain) != (first.bits, first.spacing_ns, first.gain):
            raise InputError(
                f"{strips[sources[k][0]].path}: digitizer {kind.digitizer} records in another way than that of "
                f"{strips[i].path.name}: another sensor or other settings; calibrate these strips separately"
            )
    seen = [
        row
        for k in mine
        if strips[sources[k][0]].found
        for row in strips[sources[k][0]].found.channels
        if SCANNERS * row.digitizer + row.scanner == channel
    ]
    return replace(
        first,
        constant=constant,
        relative_error=error,
        spread=max((row.spread for row in seen), default=0.0),
        echoes=sum(row.echoes for row in seen),
        shot_energy=max((row.shot_energy for row in seen), default=0.0),
        pulse_ns=float(np.median([kind.pulse_ns for kind in kinds])),
    )


def _name(strips: Sequence[_Strip], source: tuple[int, int]) -> str:
    i, channel = source
    if len(strips[i].channels) == 1:
        return strips[i].path.name
    return f"{strips[i].path.name} digitizer {channel // SCANNERS} scanner channel {channel % SCANNERS}"
