"""The calibration of several strips and channels together: on targets where they lie, on tie cells everywhere else.

`wavebatch calibrate` calls `calibrate_flight` for any number of strips. Before you change it: a strip that nothing ties
to a target has no constant, and a constant never goes from one channel to another without ties. `fit_swath` and
`find_trend` find out whether brightness depends on how a place was seen: by scan angle, incidence, range and time.

`read_strip` reads one strip of the flight: its echoes on targets, and in the squares that tie it to other strips.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import even_places
from wavebatch.core.units import name_first
from wavebatch.core.waveforms import angle_across, angle_to_vertical, swath_columns
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.las.crs import describe_crs
from wavebatch.files.las.header import read_header
from wavebatch.surveying.calibrating import adjust_flight as adjust
from wavebatch.surveying.calibrating.calibration_files import Target
from wavebatch.surveying.calibrating.strip_echoes import CLEAN_ECHO, CalibrationOptions, open_source
from wavebatch.surveying.calibrating.targets import MOST_ECHOES, build_calibration, describe_channel, measure_ranging
from wavebatch.surveying.calibration import ONE_VIEW, Calibration, ChannelConstant, StripConstant, check_attenuation
from wavebatch.surveying.matching.setting import PLACES, SCANNERS, number_channel, refuse_headings, see_channels
from wavebatch.surveying.matching.strip_energies import StripEnergies

MOST_TIES = 200_000
"""Most waveforms of a strip that are decomposed for ties; they come from whole squares of 10 m, spread by chance."""

MOST_OF_COLUMN = 20_000
"""Most waveforms of a strip that are decomposed for a column of reflectances, from whole squares as well."""

OTHER_ANGLES, MOST_OF_SWATH = 0.1, 0.5
"""Standard deviation of the angles at which one place is seen, over that of all, from which light that falls from side
to side shows: of light that falls by a fifth, 2 % are a trend then (LEAST_SPREAD); and that of all in the overlaps over
that of a whole swath, since overlaps in its middle say nothing of its edges."""

_Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper corner in x and y [m]."""


@frozen(eq=False)
class FlightStrip:
    """What is kept of one strip."""

    path: Path
    sha256: str
    found: Calibration | None
    """The calibration by targets on this strip."""
    refused: str
    channels: tuple[ChannelConstant, ...]
    """How each of its channels records."""
    ranging: float
    """Relative error of a constant from the errors of the sensor's position and of the level of the energies."""
    sent: StripEnergies
    ties: np.ndarray
    """Array of TIE, with channels as sources."""
    seen: Mapping[int, np.void]
    """How the targets were seen by each channel, as VIEW."""
    right: tuple[float, float]
    """Unit vector to the right of its flight."""
    width: float
    """As `Setting.width`."""


class Source(NamedTuple):
    """A channel of a strip: what has a constant."""

    strip: FlightStrip
    row: ChannelConstant
    """How it records."""

    @property
    def channel(self) -> int:
        """Its number; the same in all strips."""
        return SCANNERS * self.row.digitizer + self.row.scanner

    @property
    def given(self) -> ChannelConstant | None:
        """Its constant by the targets on the strip; None without."""
        found = self.strip.found.channels if self.strip.found else ()
        return next((row for row in found if Source(self.strip, row).channel == self.channel), None)

    @property
    def name(self) -> str:
        """Of the strip, and of the channel where the strip has several."""
        of = f" digitizer {self.row.digitizer} scanner channel {self.row.scanner}"
        return self.strip.path.name + (of if len(self.strip.channels) > 1 else "")


def read_strip(
    path: Path,
    number: int,
    boxes: Sequence[_Box],
    targets: Sequence[Target],
    options: CalibrationOptions,
) -> FlightStrip:
    """Decompose what lies on targets or in the overlap with other strips, in one pass."""
    with open_source(path, options) as source:
        header = source.reader.facts.header
        if options.scan_angle:
            refuse_headings(source.reader, source.setting)
        targets = [target.place(path, header) for target in targets]
        seen = see_channels(source.reader, source.scan)
        known = source.reader.facts.digitizers  # points may name others: they have no waveform
        channels = [ChannelConstant(*channel, 1.0, 0.0) for channel in seen if channel[0] in known]
        # Ties: squares in the boxes of the strips that it is tied to, so many that about MOST_TIES waveforms count.
        low, high = boxes[number]
        tied = boxes[number : number + 1] if len(channels) > 1 else [box for i, box in enumerate(boxes) if i != number]
        area = float(np.prod(np.maximum(high - low, 1.0)))
        common = [np.maximum(np.minimum(high, top) - np.maximum(low, bottom), 0.0) for bottom, top in tied]
        overlap = min(sum(float(np.prod(edge)) for edge in common), area)
        share = MOST_TIES / max(source.scan.packets * overlap / area, MOST_TIES)

        def ties_at(xyz: np.ndarray) -> np.ndarray:
            inside = np.zeros(len(xyz), bool)
            for bottom, top in tied:
                inside |= ((xyz[:, :2] >= bottom) & (xyz[:, :2] <= top)).all(axis=1)
            return inside & (adjust.hash_squares(xyz) < share)

        if source.column is not None:
            part = MOST_OF_COLUMN / max(source.scan.packets, 1)
            near = lambda xyz: adjust.hash_squares(xyz) < part  # noqa: E731
            inside = [near]
        else:
            corners = np.concatenate([target.corners for target in targets])
            first, last = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
            near = lambda xyz: ((xyz[:, :2] >= first) & (xyz[:, :2] <= last)).all(axis=1)  # noqa: E731
            inside = [target.contains for target in targets]
        parts: list[list[np.ndarray]] = [[np.empty(0, CLEAN_ECHO)] for _ in inside]
        shorts = [np.empty(0, adjust.TIE)]
        for rows in source.echoes(lambda xyz: near(xyz) | ties_at(xyz)):
            for contains, some in zip(inside, parts, strict=True):
                if sum(map(len, some)) < MOST_ECHOES:
                    some.append(rows[contains(rows["xyz"])])
            rows = rows[ties_at(rows["xyz"]) & np.isfinite(rows["light_err"])]
            short = np.empty(len(rows), adjust.TIE)
            short["xyz"] = rows["xyz"] - [*boxes[0][0], 0.0]
            short["source"] = rows["channel"]
            for name in ("ray", "light", "distance", "time"):
                short[name] = rows[name]
            shorts.append(short)
        on_targets = [np.concatenate(some)[:MOST_ECHOES] for some in parts]
        found, refused = None, ""
        try:
            found = build_calibration(source, targets, on_targets, options)
        except InputError as error:
            refused = str(error)
        distance = np.array([source.sensor.distance or math.inf])
        # How each channel saw the targets in the middle; good targets are level.
        on, views = np.concatenate(on_targets), {}
        for channel in np.unique(on["channel"]).tolist():
            mine, view = on[on["channel"] == channel], np.zeros(1, adjust.VIEW)[0]
            view["angle"] = np.median(angle_across(mine["ray"], source.setting.right))
            view["incidence"] = np.median(angle_to_vertical(mine["ray"]))
            view["distance"], view["time"] = np.median(mine["distance"]), np.median(mine["time"])
            views[channel] = view
        return FlightStrip(
            path=path,
            sha256=take_fingerprint(path, source.reader.facts.packets.file)["sha256_sampled"],
            found=found,
            refused=refused,
            channels=tuple(describe_channel(row, source) for row in channels),
            ranging=math.hypot(measure_ranging(source.sensor, distance, source.air), source.sent.growth),
            sent=source.sent,
            ties=np.concatenate(shorts),
            seen=views,
            right=source.setting.right,
            width=source.setting.width,
        )


LEAST_SPREAD = 0.01
"""Smaller changes of the brightness are not named."""

EXPLAINED, SURE_TREND, LEAST_BLOCKS = 0.8, 6.0, 4
"""A trend leaves at most this share of the scatter, or it is so many times its error by resamples of so many blocks:
those of one block are all the same, and show no error."""

MOST_EDGE_ERROR = 0.05
"""The term over the scan angle is refused where it is less certain than this at the edge of the swath, relative."""

LEAST_LEFT = 0.05
"""What constants and even terms must leave of u (root mean square) for a term that falls from side to side."""

LIKE_PLACES = 0.01
"""Square of the change of strips from one to the next over that of light from side to side, 2 % over 20 %: where strips
see a place at angles that are nearly alike, what their constants differ by is such a change."""

_EDGES = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])
"""The columns of `swath_columns` at both edges of the swath."""

_REMEDY = {
    "scan angle": "fit it with --scan-angle",
    "incidence": "surfaces are not matt, or a term over the scan angle is missing (--scan-angle)",
    "range": "check --attenuation and the heights of the trajectory",
    "time": "the laser drifts along the strips: calibrate shorter ones",
}


class Trend(NamedTuple):
    """What the brightness of the tie cells depends on most."""

    doubt: str
    """A sentence with what to do."""
    spread: float
    """Root mean square of what it changes against the places of the targets, relative."""


def fit_swath(
    ties: adjust.Ties, anchors: adjust.Anchors, seen: np.ndarray, channel: np.ndarray, *, asked: bool = True
) -> tuple[adjust.Adjustment, tuple[float, ...], float, float | None]:
    """Adjust the constants, with a term over the scan angle where it is asked for.

    Parameters
    ----------
    ties : Ties
    anchors : Anchors
    seen : array of VIEW (n,)
        How each source saw the targets.
    channel : int array, shape (n,)
        Number of the channel of each source: these differ in gain.
    asked : bool
        Whether the term is fitted.

    Returns
    -------
    adjusted : Adjustment
        With the constants straight below the sensor.
    swath : (float, float, float, float) or ()
        As `Radiometry.swath`; empty where it is not asked for.
    edge : float
        Error of the term at the edge of the swath, relative: constants near it are not known better.
    open_error : float or None
        Error of the constants, relative, where the strips leave open whether light falls from side to side: as if that
        made their constants differ, or stood for what falls to both edges. None where they tell it.

    Raises
    ------
    InputError
        If the overlaps do not determine the term.
    """
    most = float(np.abs(ties.view["angle"]).max(initial=0.0))
    columns, edge = swath_columns(ties.view["angle"], most or 1.0), np.inf if asked else 0.0
    at_targets = np.nan_to_num(swath_columns(seen["angle"], most or 1.0))
    # Do constants and a term that is alike on both sides stand for one that falls from side to side?
    # They do where headings are alike, and where two strips of opposite headings overlap.
    falling = replace(ties, value=columns[:, 2], error=np.full(len(columns), 1e-3))
    free = adjust.Anchors(0.0 * anchors.value, 1e3 * np.ones(len(anchors.value)), np.zeros((len(anchors.value), 2)))
    rest = adjust.adjust_constants(falling, free, columns[:, :2], 0).residual
    odd = bool(len(rest) and np.nanstd(rest) > LEAST_LEFT)
    used = (3 if odd else 2) * asked
    adjusted = adjust.adjust_constants(ties, replace(anchors, columns=at_targets[:, :used]), columns[:, :used])
    if asked and len(ties.cell):
        edge = max(float(np.std(adjusted.term_trials @ side[:used], ddof=1)) for side in _EDGES)
    if asked and not 0 < edge <= MOST_EDGE_ERROR:
        raise InputError(
            f"--scan-angle: the overlaps do not show the light at the edge of the swath to {100 * MOST_EDGE_ERROR:.0f} "
            "%; give strips that overlap by a third or more, or leave --scan-angle out"
        )
    swath = (most, *map(float, adjusted.terms), *(0.0,) * (3 - used)) if asked else ()
    if odd or not len(ties.cell):
        return adjusted, swath, edge, None
    # The error of the constants if they differ because each strip was seen from another side, or if the light falls
    # from side to side and not to both edges, where that explains the overlaps nearly as well.
    side, n, grid = columns[:, 2], len(adjusted.value), np.linspace(-1.0, 1.0, 21)
    known = np.isfinite(adjusted.value) & (adjusted.ties > 0)
    of = np.unique(channel[known], return_inverse=True)[1]
    place = np.bincount(ties.source, side, n) / np.maximum(adjusted.ties, 1)
    off, value = (one[known] - (np.bincount(of, one[known]) / np.bincount(of))[of] for one in (place, adjusted.value))
    error = float(abs(off @ value) / (off @ off + LIKE_PLACES) * np.quantile(np.abs(side), 0.68))
    other = adjust.adjust_constants(ties, replace(anchors, columns=at_targets[:, 2:]), columns[:, 2:], 0)
    if asked and other.scatter < max(LEAST_SPREAD, adjusted.scatter / EXPLAINED):
        apart = float(np.mean(adjusted.value[known] - other.value[known]))
        apart = apart + swath_columns(grid, 1.0) @ [*adjusted.terms, -other.terms[0]]
        error = max(error, float(np.sqrt(np.mean(apart**2))))
    return adjusted, swath, edge, error


def find_trend(
    ties: adjust.Ties, anchors: adjust.Anchors, seen: np.ndarray, adjusted: adjust.Adjustment, *, fitted: bool = False
) -> Trend | None:
    """Find what explains most of the scatter that constants leave in the overlaps; None where nothing explains a part,
    and nothing is sure by its resamples.

    Parameters
    ----------
    ties : Ties
    anchors : Anchors
    seen : array of VIEW (n,)
        How each source saw the targets.
    adjusted : Adjustment
    fitted : bool
        Whether a term over the scan angle was fitted, whose error holds what overlaps leave open.
    """
    best: list[tuple[float, float, Trend]] = []
    few = len(np.unique(np.floor(ties.centre / adjust.BLOCK), axis=0)) < LEAST_BLOCKS
    for name, columns, at_targets in _list_columns(ties, seen) if len(ties.cell) else ():
        known = np.isfinite(at_targets).all(axis=1)
        shown = replace(anchors, columns=np.where(known[:, None], at_targets, 0.0))
        fit = adjust.adjust_constants(ties, shown, columns, 0)
        used = np.isfinite(fit.residual)
        against = columns[used] - at_targets[known].mean(axis=0)
        effect = against @ fit.terms
        spread = float(np.sqrt(np.mean(effect**2)))
        explains = adjusted.scatter >= LEAST_SPREAD and fit.scatter < EXPLAINED * adjusted.scatter
        if not explains:
            # Uneven cells hide what all of them show together; range and incidence follow the angle then.
            if fitted or few or spread < LEAST_SPREAD or name not in ("scan angle", "time"):
                continue
            again = adjust.adjust_constants(ties, shown, columns).term_trials
            if spread < SURE_TREND * float(np.sqrt(np.mean(np.var(against @ again.T, axis=1)))):
                continue
        low, high = np.quantile(effect, [0.02, 0.98])
        share = f"{100 * np.expm1(high - low):.0f} %"
        doubt = f"brightness changes with the {name} by {share} in the overlaps: {_REMEDY[name]}"
        best.append((fit.scatter, float(np.std(fit.residual[used])), Trend(doubt, spread)))
    return min(best)[2] if best else None


def _list_columns(ties: adjust.Ties, seen: np.ndarray) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, columns (k, m) at the ties and (n, m) at the targets, of each quantity."""
    view = ties.view
    most = float(np.abs(view["angle"]).max())
    columns, at_targets = (swath_columns(angle, most or 1.0) for angle in (view["angle"], seen["angle"]))
    yield "scan angle", columns, at_targets
    yield "scan angle", columns[:, :2], at_targets[:, :2]  # two opposite headings do not tell both sides apart
    yield "incidence", 1.0 - np.cos(view["incidence"])[:, None], 1.0 - np.cos(seen["incidence"])[:, None]
    middle = float(np.median(view["distance"])) or 1.0
    yield "range", view["distance"][:, None] / middle - 1.0, seen["distance"][:, None] / middle - 1.0
    n = len(seen)
    start, stop = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(start, ties.source, view["time"])
    np.maximum.at(stop, ties.source, view["time"])
    with np.errstate(invalid="ignore", divide="ignore"):
        along, at_targets = ((time - start[of]) / (stop - start)[of] - 0.5 for time, of in (
            (view["time"], ties.source), (seen["time"], np.arange(n))))  # fmt: skip
    if np.isfinite(along).all():
        yield "time", along[:, None] * (ties.source[:, None] == np.arange(n)), np.diag(at_targets)


_UNEXPLAINED = (
    "the strips' light from one place differs by more than their constants explain: check targets, trajectory and "
    "whether the overlaps are wet, rough or planted, or channels have several wavelengths"
)


@frozen
class FlightCalibration:
    """A calibration of several strips, and how they agree."""

    calibration: Calibration
    pairs: tuple[adjust.PairOverlap, ...] = ()
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
    # Strips of several CRSs are refused: places with equal coordinates would be tied.
    named = [(path, describe_crs(path).name) for path in paths]
    for coded in (True, False):
        # By codes where files have them: names of one CRS differ from program to program.
        some = {
            name.rpartition("EPSG:")[2]: (path, name) for path, name in named if name and coded == ("EPSG:" in name)
        }
        if len(some) > 1:
            (path, first), (second, other) = list(some.values())[:2]
            problem = f"its coordinates are in {other}, those of {path.name} in {first}"
            raise InputError(f"{second}: {problem}: project the strips to one CRS, or calibrate them separately")
    boxes = [(np.array(one.mins[:2]), np.array(one.maxs[:2])) for one in map(read_header, paths)]
    strips: list[FlightStrip] = []
    for i, path in enumerate(paths):
        # All energies count relative to those of the first strip: the mean of each would hide what lasers lose.
        before = Calibration(1.0, 0.0, **strips[0].sent.describe()) if strips else None
        strips.append(read_strip(path, i, boxes, targets, replace(options, before=before)))
    for kept, copy in combinations(strips, 2):
        same = np.intersect1d(kept.ties["light"], copy.ties["light"])
        if 2 * len(same) > max(len(kept.ties), 1):
            problem = f"its echoes are those of {kept.path.name}: a copy proves nothing"
            raise InputError(f"{copy.path}: {problem}; leave it out")
    good = [strip.found for strip in strips if strip.found is not None]
    if not good:
        raise InputError(strips[0].refused if len(strips) == 1 else "; ".join(strip.refused for strip in strips))
    bent = max(one.bent for one in good)
    sources = [Source(strip, row) for strip in strips for row in strip.channels]
    if len(sources) == 1 and not options.scan_angle:
        return FlightCalibration(replace(good[0].widened(bent), conditions=good[0].conditions + ONE_VIEW))
    rights = np.array([source.strip.right for source in sources])
    parts = [np.empty(0, adjust.TIE)]
    for number, source in enumerate(sources):
        rows = source.strip.ties[source.strip.ties["source"] == source.channel]
        rows["source"] = number
        parts.append(rows)
    rows = np.concatenate(parts)
    ties = adjust.measure_ties(rows, adjust.choose_size(rows), rights=rights)
    value, error = np.full((2, len(sources)), np.nan)
    seen = np.full(len(sources), np.nan, adjust.VIEW)
    for number, source in enumerate(sources):
        given, found = source.given, source.strip.found
        if given is not None and found is not None:
            rest = given.relative_error**2 - _reflectance_error([found], options) ** 2
            value[number], error[number] = math.log(given.constant), math.sqrt(max(rest, 1e-6))
            seen[number] = source.strip.seen[source.channel]
    anchors = adjust.Anchors(value, error)
    channel = np.array([source.channel for source in sources])
    adjusted, swath, edge, open_error = fit_swath(ties, anchors, seen, channel, asked=options.scan_angle)
    if swath:
        ties = replace(ties, value=ties.value + swath_columns(ties.view["angle"], swath[0]) @ swath[1:])
        anchors = replace(anchors, value=anchors.value - swath_columns(seen["angle"], swath[0]) @ swath[1:])
    calibration = replace(_assemble(strips, sources, adjusted, options), swath=swath).widened(edge)
    angle, of = ties.view["angle"], ties.cell
    within = angle - (np.bincount(of, angle) / np.bincount(of))[of]
    width = max(strip.width for strip in strips)
    tells = len(angle) and np.std(within) > OTHER_ANGLES * np.std(angle) and np.std(angle) > MOST_OF_SWATH * width
    if not swath and not tells:
        calibration = replace(calibration, conditions=calibration.conditions + ONE_VIEW)
    names = [source.name for source in sources]
    pairs = tuple(adjust.compare_pairs(ties, adjusted, names))
    lost = []
    for source, value in zip(sources, adjusted.value, strict=True):
        # A run takes the constant of other channels for one that differs in its samples per waveform only.
        row = source.row
        kind = (row.scanner, row.bits, row.spacing_ns, row.gain)
        channels = calibration.channels
        alike = [one for one in channels if (one.scanner, one.bits, one.spacing_ns, one.gain) == kind]
        covered = alike and all(one.samples != row.samples for one in alike)
        if not (np.isfinite(value) or covered):
            lost.append(source.name)
    notes = [*calibration.notes, *adjust.find_doubts(lost, calibration.strips, pairs)]
    # What the overlaps leave unexplained is in the errors; where it is more than these, it is said.
    trend, more = find_trend(ties, anchors, seen, adjusted, fitted=bool(swath)), []
    spread = adjusted.scatter if trend is None else max(adjusted.scatter, trend.spread)
    if spread >= LEAST_SPREAD:
        stated = max(row.relative_error for row in calibration.strips)
        if spread > stated:
            reason = _UNEXPLAINED if trend is None else trend.doubt
            growth = f"the error of the constants grows from {100 * stated:.1f} by {100 * spread:.1f} %"
            more.append(f"{reason}; {growth}")
        calibration = calibration.widened(spread)
    if open_error is not None and open_error > LEAST_SPREAD:
        calibration = calibration.widened(open_error)
        more.append(
            "these strips do not show whether light falls from one side of the swath to the other: the error of the "
            f"constants grows by {100 * open_error:.1f} %; give three strips, one of another heading, and --scan-angle"
        )
    return FlightCalibration(replace(calibration.widened(bent), notes=(*notes, *more)), pairs, ties.size)


def _reflectance_error(found: Sequence[Calibration], options: CalibrationOptions) -> float:
    """What the reflectance's error does to the constants: targets that several strips saw count once."""
    names = {(row.name, not options.column and row.reflectance)
             for one in found for row in one.targets if row.constant is not None}  # fmt: skip
    return options.reflectance_error / math.sqrt(len(names))


def _assemble(
    strips: Sequence[FlightStrip], sources: Sequence[Source], adjusted: adjust.Adjustment, options: CalibrationOptions
) -> Calibration:
    """The calibration of the flight: a constant per channel, and one per channel and strip."""
    good = [strip.found for strip in strips if strip.found is not None]
    shared = _reflectance_error(good, options)
    of = np.array([source.channel for source in sources])
    known = np.isfinite(adjusted.value)
    channels: list[ChannelConstant] = []
    rows: list[StripConstant] = []
    # Standard deviation of a channel's constants between strips, logarithm; 0 where no channel has two.
    parts = [adjusted.value[known & (of == channel)] for channel in np.unique(of[known])]
    freedom = sum(len(part) - 1 for part in parts)
    squares = sum(float(np.sum((part - part.mean()) ** 2)) for part in parts)
    scatter = math.sqrt(squares / freedom) if freedom else 0.0
    for channel in np.unique(of[known]):
        mine = np.flatnonzero(known & (of == channel))
        some = [sources[k] for k in mine.tolist()]
        mean, trials = float(adjusted.value[mine].mean()), adjusted.trials[:, mine]
        # A channel of one strip says nothing of its drift: it is credited with that of the others.
        apart = float(np.std(adjusted.value[mine], ddof=1)) if len(mine) > 1 else scatter
        ranging = float(np.mean([source.strip.ranging for source in some]))
        error = float(np.sqrt(np.std(trials.mean(axis=1), ddof=1) ** 2 + shared**2 + apart**2 + ranging**2))
        first = some[0].row
        for path, own in ((source.strip.path, source.row) for source in some):
            if (own.bits, own.spacing_ns, own.gain) != (first.bits, first.spacing_ns, first.gain):
                raise InputError(
                    f"{path}: digitizer {own.digitizer} records in another way than that of "
                    f"{some[0].strip.path.name}: another sensor or other settings; calibrate these strips separately"
                )
        seen = [source.given for source in some if source.given is not None]
        channels.append(replace(
            first,
            constant=math.exp(mean),
            relative_error=error,
            spread=max((own.spread for own in seen), default=0.0),
            echoes=sum(own.echoes for own in seen),
            shot_energy=max((own.shot_energy for own in seen), default=0.0),
            pulse_ns=float(np.median([source.row.pulse_ns for source in some])),
        ))
        errors = np.std(trials - trials.mean(axis=1)[:, None], axis=0, ddof=1)
        drifts = np.expm1(adjusted.value[mine] - adjusted.value[mine].mean())
        for source, k, drift, drift_error in zip(some, mine, drifts, errors, strict=True):
            rows.append(StripConstant(
                strip=source.strip.path.name,
                sha256=source.strip.sha256,
                digitizer=source.row.digitizer,
                scanner=source.row.scanner,
                constant=math.exp(adjusted.value[k]),
                relative_error=float(np.sqrt(adjusted.error[k] ** 2 + shared**2 + source.strip.ranging**2)),
                drift=float(drift),
                drift_error=float(drift_error),
                ties=int(adjusted.ties[k]),
            ))
    constants = np.array([row.constant for row in channels])
    error = float(np.hypot(np.std(constants) / constants.mean(), max(row.relative_error for row in channels)))
    # Places are as bright as they are by the mean constants of their channels.
    gain = {(row.sha256, number_channel(row.digitizer, row.scanner)): math.log1p(row.drift) for row in rows}
    places = []
    for found in good:
        part = np.reshape(found.places, (-1, 4))
        part[:, 3] += [gain.get((found.fingerprint["sha256_sampled"], channel), 0.0) for channel in part[:, 0]]
        places.append(part)
    joined = np.concatenate(places)
    noted: dict[str, list[str]] = {}
    for strip in strips:
        for note in strip.found.notes if strip.found else ():
            noted.setdefault(note, []).append(strip.path.name)
    return replace(
        good[0],
        constant=float(np.median(constants)),
        relative_error=error,
        strip=", ".join(strip.path.name for strip in strips),
        conditions=good[0].conditions if len(strips) == 1 else f"{len(strips)} strips, {good[0].conditions}",
        targets=tuple(
            # Those without any echo on a strip of several are left out.
            row if len(strips) == 1 else replace(row, name=f"{row.name} on {strip.path.name}")
            for strip in strips
            if strip.found
            for row in strip.found.targets
            if len(strips) == 1 or row.echoes
        ),
        channels=tuple(channels),
        strips=tuple(rows),
        places=tuple(joined[even_places(len(joined), PLACES)].ravel().tolist()),
        notes=tuple(note if len(strips) == 1 else f"{name_first(names)}: {note}" for note, names in noted.items()),
    )
