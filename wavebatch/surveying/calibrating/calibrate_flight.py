"""The calibration of several strips and channels together: on targets where they lie, on tie cells everywhere else.

`wavebatch calibrate` calls `calibrate_flight` for any number of strips. Before you change it: a strip that nothing ties
to a target has no constant, and a constant never goes from one channel to another without ties.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.units import MAD_TO_STD
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.calibrating.adjust_flight import LEAST_TIES, Adjustment, adjust_constants
from wavebatch.surveying.calibrating.strip_echoes import ECHO, SCANNERS, EchoSource, see_channels
from wavebatch.surveying.calibrating.target_file import Target
from wavebatch.surveying.calibrating.tie_cells import TIE, Ties, choose_size, hash_squares, measure_ties
from wavebatch.surveying.calibration import Calibration, ChannelConstant, StripConstant, TargetResult
from wavebatch.surveying.targets import (
    CalibrationOptions,
    build_calibration,
    describe_channel,
    measure_ranging,
    open_strip_source,
)

MOST_TIES = 200_000
"""Most waveforms of a strip that are decomposed for ties; they come from whole squares of 10 m, spread by chance."""

HEIGHT_DOUBT, LEAST_HEIGHT = 5.0, 0.05
"""Height differences of two strips are named from so many standard errors, and this [m]."""

LEAST_DRIFT = 4.0
"""Drifts of this many standard deviations are named."""


@dataclass(frozen=True, slots=True)
class PairOverlap:
    """What two sources have in common."""

    a: str
    b: str
    cells: int
    ratio: float
    """Light of a over that of b in the same cells, median: what differs before the calibration."""
    after: float
    """The same with their constants: 1 where the adjustment brings them together."""
    spread: float
    """Robust standard deviation of the ratio between cells, relative."""
    height: float
    """Median height of a over b [m]."""
    height_spread: float


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
    boxes = [_find_box(path) for path in paths]
    origin = boxes[0][0]
    strips = [_read_strip(path, i, boxes, targets, options) for i, path in enumerate(paths)]
    good = [strip for strip in strips if strip.found is not None]
    if not good:
        raise InputError(strips[0].refused if len(strips) == 1 else "; ".join(strip.refused for strip in strips))
    sources = [(i, channel) for i, strip in enumerate(strips) for channel in strip.channels]
    if len(sources) == 1:
        return FlightCalibration(good[0].found)
    ties = _tie(strips, sources, origin)
    given, given_error = _list_given(strips, sources, options)
    adjusted = adjust_constants(ties, given, given_error)
    calibration = _assemble(strips, sources, adjusted, options)
    pairs = tuple(_compare_pairs(ties, adjusted, [_name(strips, source) for source in sources]))
    notes = [*calibration.notes, *_list_notes(strips, sources, adjusted, calibration, pairs)]
    return FlightCalibration(replace(calibration, notes=tuple(notes)), pairs, ties.size)


def _find_box(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a strip in x and y by its header."""
    with StripReader(path) as reader:
        header = reader.facts.header
        return np.array(header.mins[:2]), np.array(header.maxs[:2])


def _read_strip(
    path: Path,
    number: int,
    boxes: Sequence[tuple[np.ndarray, np.ndarray]],
    targets: Sequence[Target],
    options: CalibrationOptions,
) -> _Strip:
    """Decompose what lies on targets or in the overlap with other strips, in one pass."""
    with open_strip_source(path, options) as source:
        channels = tuple(
            SCANNERS * digitizer + scanner for digitizer, scanner in see_channels(source.reader, source.scan)
        )
        others = [box for i, box in enumerate(boxes) if i != number]
        tied = [boxes[number]] if len(channels) > 1 else others
        corners = np.concatenate([target.corners for target in targets])
        low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
        share = _thin(source, boxes[number], tied)
        on_targets: list[list[np.ndarray]] = [[np.empty(0, ECHO)] for _ in targets]
        parts = [np.empty(0, TIE)]

        def near(xyz: np.ndarray) -> np.ndarray:
            return ((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)

        def tying(xyz: np.ndarray) -> np.ndarray:
            inside = np.zeros(len(xyz), bool)
            for bottom, top in tied:
                inside |= ((xyz[:, :2] >= bottom) & (xyz[:, :2] <= top)).all(axis=1)
            return inside & (hash_squares(xyz) < share)

        for rows in source.echoes(lambda xyz: near(xyz) | tying(xyz)):
            for target, some in zip(targets, on_targets, strict=True):
                some.append(rows[target.contains(rows["xyz"][:, 0], rows["xyz"][:, 1])])
            parts.append(_shorten(rows[tying(rows["xyz"])], boxes[0][0]))
        found, refused = None, ""
        try:
            found = build_calibration(source, targets, [np.concatenate(some) for some in on_targets], options)
        except InputError as error:
            refused = str(error)
        blank = [ChannelConstant(channel // SCANNERS, channel % SCANNERS, 1.0, 0.0) for channel in channels]
        distance = np.array([source.sensor.distance or math.inf])
        return _Strip(
            path,
            take_fingerprint(path, source.reader.facts.packets.file)["sha256_sampled"],
            found,
            refused,
            channels,
            tuple(describe_channel(row, source) for row in blank),
            measure_ranging(source.sensor, distance, options.attenuation),
            np.concatenate(parts),
        )


def _thin(source: EchoSource, own: tuple[np.ndarray, np.ndarray], tied: Sequence) -> float:
    """Share of the squares that are used, so that about MOST_TIES waveforms are decomposed."""
    area = float(np.prod(np.maximum(own[1] - own[0], 1.0)))
    common = [np.maximum(np.minimum(own[1], top) - np.maximum(own[0], low), 0.0) for low, top in tied]
    shared = min(sum(float(np.prod(edge)) for edge in common), area)
    return MOST_TIES / max(source.scan.packets * shared / area, MOST_TIES)


def _shorten(rows: np.ndarray, origin: np.ndarray) -> np.ndarray:
    short = np.empty(len(rows), TIE)
    short["xyz"] = rows["xyz"] - [*origin, 0.0]
    short["ray"], short["light"], short["source"] = rows["ray"], rows["light"], rows["channel"]
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
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the constants by targets, f8 (n,), NaN without, and their errors without that of the reflectance,
    which strips that see the same targets share."""
    value, error = np.full((2, len(sources)), np.nan)
    for number, (i, channel) in enumerate(sources):
        found = strips[i].found
        for row in found.channels if found else ():
            if SCANNERS * row.digitizer + row.scanner == channel:
                rest = row.relative_error**2 - _reflectance_error([found], options) ** 2
                value[number], error[number] = math.log(row.constant), math.sqrt(max(rest, 1e-6))
    return value, error


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
        drift = adjusted.value[mine] - mean
        # A channel of one strip says nothing of its drift: it is credited with that of the others.
        apart = float(np.std(drift, ddof=1)) if len(mine) > 1 else scatter
        ranging = float(np.mean([strips[sources[k][0]].ranging for k in mine]))
        error = float(np.sqrt(np.std(trials.mean(axis=1), ddof=1) ** 2 + shared**2 + apart**2 + ranging**2))
        channels.append(_describe_row(strips, sources, mine, math.exp(mean), error))
        off = np.std(trials - trials.mean(axis=1)[:, None], axis=0, ddof=1) if len(mine) > 1 else np.zeros(1)
        for k, own, own_error in zip(mine, drift, off, strict=True):
            strip = strips[sources[k][0]]
            whole = float(np.sqrt(adjusted.error[k] ** 2 + shared**2 + strip.ranging**2))
            rows.append(
                StripConstant(
                    strip.path.name, strip.sha256, channel // SCANNERS, channel % SCANNERS,
                    math.exp(adjusted.value[k]), whole, math.expm1(own), float(own_error), int(adjusted.ties[k]),
                )
            )  # fmt: skip
    constants = np.array([row.constant for row in channels])
    error = float(np.hypot(np.std(constants) / constants.mean(), max(row.relative_error for row in channels)))
    notes = tuple(f"{strip.path.name}: {note}" for strip in strips if strip.found for note in strip.found.notes)
    return replace(
        good[0],
        constant=float(np.median(constants)),
        relative_error=error,
        strip=", ".join(strip.path.name for strip in strips),
        conditions=f"{len(strips)} strips, {len(rows)} constants of strips and channels, {good[0].conditions}",
        targets=tuple(_name_target(row, strip) for strip in strips if strip.found for row in strip.found.targets),
        channels=tuple(channels),
        strips=tuple(rows),
        notes=notes,
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


def _name_target(row: TargetResult, strip: _Strip) -> TargetResult:
    return replace(row, name=f"{row.name} on {strip.path.name}")


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


def _compare_pairs(ties: Ties, adjusted: Adjustment, names: Sequence[str]):
    """What each two sources have in common, where they share enough cells."""
    order = np.argsort(ties.source, kind="stable")
    rows = {k: order[ties.source[order] == k] for k in range(len(names))}
    for a in range(len(names)):
        for b in range(a):
            _, left, right = np.intersect1d(ties.cell[rows[a]], ties.cell[rows[b]], return_indices=True)
            if len(left) < LEAST_TIES:
                continue
            i, j = rows[a][left], rows[b][right]
            value, height = ties.value[i] - ties.value[j], ties.height[i] - ties.height[j]
            middle, level = float(np.median(value)), float(np.median(height))
            yield PairOverlap(
                names[a],
                names[b],
                len(i),
                math.exp(middle),
                math.exp(middle + adjusted.value[a] - adjusted.value[b]),
                MAD_TO_STD * float(np.median(np.abs(value - middle))),
                level,
                MAD_TO_STD * float(np.median(np.abs(height - level))),
            )


def _list_notes(
    strips: Sequence[_Strip],
    sources: Sequence[tuple[int, int]],
    adjusted: Adjustment,
    calibration: Calibration,
    pairs: Sequence[PairOverlap],
):
    """Sources without a constant, drifts, heights that do not fit."""
    for number, source in enumerate(sources):
        if not np.isfinite(adjusted.value[number]):
            yield (
                f"{_name(strips, source)}: has no constant: no target lies on it, and fewer than {LEAST_TIES} flat "
                "cells tie it to a strip or channel that has one"
            )
    for row in calibration.strips:
        if row.drift_error > 0 and abs(row.drift) > max(LEAST_DRIFT * row.drift_error, 0.01):
            yield (
                f"{row.strip}: its constant is {100 * row.drift:+.2f} +- {100 * row.drift_error:.2f} % off the mean of "
                f"digitizer {row.digitizer}, scanner channel {row.scanner}"
            )
    for pair in pairs:
        error = pair.height_spread / math.sqrt(pair.cells)
        if abs(pair.height) > max(HEIGHT_DOUBT * error, LEAST_HEIGHT):
            yield f"{pair.a} lies {pair.height:+.2f} m over {pair.b}: check boresight, trajectory and heights"
