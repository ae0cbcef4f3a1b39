"""The calibration of several strips and channels together: on targets where they lie, on tie cells everywhere else.

`wavebatch calibrate` calls `calibrate_flight` for any number of strips. Before you change it: a strip that nothing ties
to a target has no constant, and a constant never goes from one channel to another without ties.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import even_places
from wavebatch.core.system import swath_columns
from wavebatch.files.las.crs import describe_crs
from wavebatch.surveying.calibrating.adjust_flight import Adjustment, Anchors, adjust_constants
from wavebatch.surveying.calibrating.flight_overlaps import PairOverlap, compare_pairs, find_doubts
from wavebatch.surveying.calibrating.flight_strips import FlightStrip, Source, find_box, read_strip
from wavebatch.surveying.calibrating.strip_echoes import CalibrationOptions
from wavebatch.surveying.calibrating.target_file import Target
from wavebatch.surveying.calibrating.tie_cells import TIE, VIEW, Ties, choose_size, measure_ties
from wavebatch.surveying.calibrating.trends import LEAST_SPREAD, Trend, find_trend, fit_swath
from wavebatch.surveying.calibration import Calibration, ChannelConstant, StripConstant, TargetResult, check_attenuation
from wavebatch.surveying.matching.setting import PLACES, number_channel

_UNEXPLAINED = (
    "the strips' light from one place differs by more than their constants explain: check targets, trajectory and "
    "whether the overlaps are wet, rough or planted"
)


@frozen
class FlightCalibration:
    """A calibration of several strips, and how they agree."""

    calibration: Calibration
    pairs: tuple[PairOverlap, ...] = ()
    cell: float = 0.0
    """Edge of the tie cells [m]."""


def calibrate_flight(
    paths: Sequence[Path], targets: Sequence[Target], options: CalibrationOptions | None = None
) -> FlightCalibration:
    """Calibrate all channels of one or more strips, so that they agree on targets and where they overlap.

    Parameters
    ----------
    paths : sequence of Path
        Strips of one flight.
    targets : sequence of Target
        Each may lie on any of the strips; none where the options name a column.
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
    check_attenuation(options.air)
    _refuse_zones(paths)
    boxes = [find_box(path) for path in paths]
    strips: list[FlightStrip] = []
    for i, path in enumerate(paths):
        # All energies count relative to those of the first strip: the mean of each would hide what lasers lose.
        before = Calibration(1.0, 0.0, **strips[0].sent.describe()) if strips else None
        strips.append(read_strip(path, i, boxes, targets, replace(options, before=before)))
    good = [strip.found for strip in strips if strip.found is not None]
    if not good:
        raise InputError(strips[0].refused if len(strips) == 1 else "; ".join(strip.refused for strip in strips))
    bent = max(one.bent for one in good)
    sources = [Source(strip, row) for strip in strips for row in strip.channels]
    if len(sources) == 1 and not options.scan_angle:
        return FlightCalibration(good[0].widened(bent))
    rights = np.array([source.strip.right for source in sources])
    ties = _tie(sources, rights)
    anchors, seen = _list_given(sources, options)
    swath: tuple[float, ...] = ()
    open_error = None
    if options.scan_angle:
        adjusted, swath, open_error = fit_swath(ties, anchors, seen)
        ties = replace(ties, value=ties.value + swath_columns(ties.view["angle"], swath[0]) @ swath[1:])
        anchors = replace(anchors, value=anchors.value - swath_columns(seen["angle"], swath[0]) @ swath[1:])
    else:
        adjusted = adjust_constants(ties, anchors)
    calibration = replace(_assemble(strips, sources, adjusted, options), swath=swath)
    names = [source.name for source in sources]
    pairs = tuple(compare_pairs(ties, adjusted, names))
    lost = [
        source.name
        for source, value in zip(sources, adjusted.value, strict=True)
        if not (np.isfinite(value) or _is_covered(source.row, calibration.channels))
    ]
    notes = [*calibration.notes, *find_doubts(lost, calibration.strips, pairs)]
    calibration, more = _widen(calibration, adjusted, find_trend(ties, anchors, seen, adjusted))
    if open_error is not None and open_error > LEAST_SPREAD:
        calibration = calibration.widened(open_error)
        more.append(
            "--scan-angle: these strips do not show whether light falls from one side of the swath to the other: the "
            f"error of the constants grows by {100 * open_error:.1f} %; give three strips, one of another heading"
        )
    return FlightCalibration(replace(calibration.widened(bent), notes=(*notes, *more)), pairs, ties.size)


def _refuse_zones(paths: Sequence[Path]) -> None:
    """Raise InputError where strips name different CRSs: places with equal coordinates would be tied."""
    named = [(path, describe_crs(path).name) for path in paths]
    for coded in (True, False):
        # By codes where files have them: names of one CRS differ from program to program.
        some = {
            name.rpartition("EPSG:")[2]: (path, name) for path, name in named if name and coded == ("EPSG:" in name)
        }
        if len(some) > 1:
            (path, one), (second, other) = list(some.values())[:2]
            problem = f"its coordinates are in {other}, those of {path.name} in {one}"
            raise InputError(f"{second}: {problem}: project the strips to one CRS, or calibrate them separately")


def _is_covered(row: ChannelConstant, channels: Sequence[ChannelConstant]) -> bool:
    """Whether a run takes the constant of other channels for this one, which differs in its samples per waveform only:
    see `strip_match`."""
    alike = [
        other
        for other in channels
        if (other.scanner, other.bits, other.spacing_ns, other.gain)
        == (row.scanner, row.bits, row.spacing_ns, row.gain)
    ]
    return bool(alike) and all(other.samples != row.samples for other in alike)


def _widen(calibration: Calibration, adjusted: Adjustment, trend: Trend | None) -> tuple[Calibration, list[str]]:
    """The calibration with what the overlaps leave unexplained in its errors, and the sentence about it where it is
    more than these."""
    spread = adjusted.scatter if trend is None else max(adjusted.scatter, trend.spread)
    if spread < LEAST_SPREAD:
        return calibration, []
    stated = max(row.relative_error for row in calibration.strips)
    reason = _UNEXPLAINED if trend is None else trend.doubt
    note = f"{reason}; the error of the constants grows from {100 * stated:.1f} by {100 * spread:.1f} %"
    return calibration.widened(spread), [note] if spread > stated else []


def _tie(sources: Sequence[Source], rights: np.ndarray) -> Ties:
    """The tie cells of all sources."""
    parts = [np.empty(0, TIE)]
    for number, source in enumerate(sources):
        rows = source.strip.ties[source.strip.ties["source"] == source.channel]
        rows["source"] = number
        parts.append(rows)
    rows = np.concatenate(parts)
    return measure_ties(rows, choose_size(rows), rights=rights)


def _list_given(sources: Sequence[Source], options: CalibrationOptions) -> tuple[Anchors, np.ndarray]:
    """Constants by targets with their errors without that of the reflectance, which strips that see the same targets
    share; and how each source saw its targets, array of VIEW (n,), NaN without."""
    value, error = np.full((2, len(sources)), np.nan)
    seen = np.full(len(sources), np.nan, VIEW)
    for number, source in enumerate(sources):
        given, found = source.given, source.strip.found
        if given is not None and found is not None:
            rest = given.relative_error**2 - _reflectance_error([found], options) ** 2
            value[number], error[number] = math.log(given.constant), math.sqrt(max(rest, 1e-6))
            seen[number] = source.strip.seen[source.channel]
    return Anchors(value, error), seen


def _reflectance_error(found: Sequence[Calibration], options: CalibrationOptions) -> float:
    """What the reflectance's error does to the constants: targets that several strips saw count once."""
    names = {(row.name, not options.column and row.reflectance)
             for one in found for row in one.targets if row.constant is not None}  # fmt: skip
    return options.reflectance_error / math.sqrt(len(names))


def _assemble(
    strips: Sequence[FlightStrip], sources: Sequence[Source], adjusted: Adjustment, options: CalibrationOptions
) -> Calibration:
    """The calibration of the flight: a constant per channel, and one per channel and strip."""
    good = [strip.found for strip in strips if strip.found is not None]
    shared = _reflectance_error(good, options)
    of = np.array([source.channel for source in sources])
    known = np.isfinite(adjusted.value)
    channels: list[ChannelConstant] = []
    rows: list[StripConstant] = []
    scatter = _drift_scatter(of[known], adjusted.value[known])
    for channel in np.unique(of[known]):
        mine = np.flatnonzero(known & (of == channel))
        some = [sources[k] for k in mine.tolist()]
        mean, trials = float(adjusted.value[mine].mean()), adjusted.trials[:, mine]
        # A channel of one strip says nothing of its drift: it is credited with that of the others.
        apart = float(np.std(adjusted.value[mine], ddof=1)) if len(mine) > 1 else scatter
        ranging = float(np.mean([source.strip.ranging for source in some]))
        error = float(np.sqrt(np.std(trials.mean(axis=1), ddof=1) ** 2 + shared**2 + apart**2 + ranging**2))
        channels.append(_describe_row(some, math.exp(mean), error))
        rows += _list_strips(some, mine, adjusted, shared)
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
        places=_join_places(good, rows),
        notes=tuple(
            note if len(strips) == 1 else f"{strip.path.name}: {note}"
            for strip in strips
            if strip.found
            for note in strip.found.notes
        ),
    )


def _join_places(good: Sequence[Calibration], rows: Sequence[StripConstant]) -> tuple[float, ...]:
    """Ground of the strips with targets, as bright as it is by the mean constants of their channels."""
    drift = {(row.sha256, number_channel(row.digitizer, row.scanner)): math.log1p(row.drift) for row in rows}
    parts = []
    for found in good:
        part = np.reshape(found.places, (-1, 4))
        part[:, 3] += [drift.get((found.fingerprint["sha256_sampled"], channel), 0.0) for channel in part[:, 0]]
        parts.append(part)
    joined = np.concatenate(parts)
    return tuple(joined[even_places(len(joined), PLACES)].ravel().tolist())


def _list_strips(
    some: Sequence[Source], mine: np.ndarray, adjusted: Adjustment, shared: float
) -> Iterator[StripConstant]:
    """The constants of one channel on each strip; mine: numbers of its sources, shared: error of the reflectance."""
    values, trials = adjusted.value[mine], adjusted.trials[:, mine]
    errors = np.std(trials - trials.mean(axis=1)[:, None], axis=0, ddof=1)
    for source, k, drift, error in zip(some, mine, np.expm1(values - values.mean()), errors, strict=True):
        yield StripConstant(
            strip=source.strip.path.name,
            sha256=source.strip.sha256,
            digitizer=source.row.digitizer,
            scanner=source.row.scanner,
            constant=math.exp(adjusted.value[k]),
            relative_error=float(np.sqrt(adjusted.error[k] ** 2 + shared**2 + source.strip.ranging**2)),
            drift=float(drift),
            drift_error=float(error),
            ties=int(adjusted.ties[k]),
        )


def _drift_scatter(channel: np.ndarray, value: np.ndarray) -> float:
    """Standard deviation of the logarithms of a channel's constants between strips; 0 where no channel has two."""
    parts = [value[channel == one] for one in np.unique(channel)]
    freedom = sum(len(part) - 1 for part in parts)
    squares = sum(float(np.sum((part - part.mean()) ** 2)) for part in parts)
    return math.sqrt(squares / freedom) if freedom else 0.0


def _list_targets(strips: Sequence[FlightStrip]) -> Iterator[TargetResult]:
    """What the targets gave on each strip; those without any echo on a strip of several are left out."""
    for strip in strips:
        for row in strip.found.targets if strip.found else ():
            if len(strips) == 1:
                yield row
            elif row.echoes:
                yield replace(row, name=f"{row.name} on {strip.path.name}")


def _describe_row(some: Sequence[Source], constant: float, error: float) -> ChannelConstant:
    """The row of a channel with how it records, and what targets say of its scatter; InputError for two recordings."""
    first = some[0].row
    for path, row in ((source.strip.path, source.row) for source in some):
        if (row.bits, row.spacing_ns, row.gain) != (first.bits, first.spacing_ns, first.gain):
            raise InputError(
                f"{path}: digitizer {row.digitizer} records in another way than that of "
                f"{some[0].strip.path.name}: another sensor or other settings; calibrate these strips separately"
            )
    seen = [source.given for source in some if source.given is not None]
    return replace(
        first,
        constant=constant,
        relative_error=error,
        spread=max((row.spread for row in seen), default=0.0),
        echoes=sum(row.echoes for row in seen),
        shot_energy=max((row.shot_energy for row in seen), default=0.0),
        pulse_ns=float(np.median([source.row.pulse_ns for source in some])),
    )
