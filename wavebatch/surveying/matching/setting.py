"""What a strip says of its sensor and its setting: day, name, channels, rate of pulses, light of the strongest echoes.

`strip_echoes` measures it for CAL.toml and `strip_match` for each strip: another pulse rate or gain under the same
header makes another sensor of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import even_places, known_median, robust_std
from wavebatch.core.units import ADJUSTED, AIR_ATTENUATION, HALF_C, MEDIAN_ERROR, WEEK, date_gps
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.las.header import decode_text
from wavebatch.files.strip.packets import StripFacts
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.physics.radiometry import transmit
from wavebatch.surveying.sensor import SensorSource

if TYPE_CHECKING:
    from numpy.typing import ArrayLike  # a millisecond of each start

SAMPLE = 2048
"""Waveforms whose light is summed."""

QUANTILES = np.linspace(0.05, 0.95, 10)
"""Of the light of waveforms, by which scenes are compared."""

UNLIKE, LEAST_UNLIKE, MOST_UNLIKE = 5.0, 0.04, 0.3
"""Scenes of one setting differ in brightness by so many times the scatter of the ratios of their quantiles, by the
second where these are equal, and by the third where they are not: unlike scenes differ by no more where they are more
unlike (standard deviations of the logarithm). Quarters of four real strips differ by as much as these make together
(18 pairs; 0.28 where the ratios scatter by 0.1 to 0.2), 100 pairs of drawn landscapes by 1.09 times that."""

USUAL_CHANGE = 0.35
"""By how much another gain or energy changes light (standard deviation of the logarithm): factors of 0.7 to 1.4."""

USUAL_SIDES = 0.1
"""By how much light that is uneven across the swath grows from half to half (standard deviation of the logarithm;
assumed, since no figure was found): 20 % from edge to edge, as of a dirty window."""

SUNLIGHT = 0.1
"""By how much sunlight changes the noise of one gain (standard deviation of the logarithm)."""

PLACES, NEAR, LEAST_COMMON, BESIDE, SPAN, BORDER = 256, 20.0, 20, 2.0, 0.25, 4.0
"""Places that a calibration keeps; distance up to which a waveform of another strip sees the same ground [m], since
fields are larger; fewest of these that show a change; times the middle distance up to which they count; how far they
spread along the strip to show that it fades (standard deviation, in half of its time); and standard deviations of their
differences from which they lie apart."""

SAME_GROUND = 0.02
"""By how much ground changes its brightness between two strips, by moisture and the direction of their light (standard
deviation of the logarithm; assumed): a third of what whole scenes do, and less than air over 500 m."""

LIKE_GROUND = 0.5
"""Scatter of the differences of neighbours, over that of surfaces that have nothing to do with each other, up to which
they are the same surfaces: even ground looks like all even ground, and ground may have changed."""

CHANGES = ((1.0, 0.0), (1.0, 1.0))
"""How another energy and another gain move light and noise; one is as likely as the other, and the chance of both is
`Calibration.change_chance` before light and noise are seen."""

LIKELY = 0.5
"""Chance from which another gain or energy is named. From there on the error is that of a change; below, the square is
less by the chance over this one, so that both meet: by the chance alone it would hold few of the changes there are."""

ZONE_PARTS = 8
"""Parts of a strip whose bend is measured: their scatter tells ground from a wrong pulse zone."""

LEAST_OF_ZONE = 100
"""Waveforms of each of them."""

LEAST_BEND, MOST_BEND = 0.0005, 0.1
"""Least standard deviation of the cosine of the rays' angles that bends level ground by a third of a metre; and by how
much of a zone the ranges may seem to be off a whole number of them, and uncertain: terrain that follows the flight line
for the whole strip seldom does so."""

MOST_ZONES = 3
"""Zones by which ranges may be wrong: valleys bend the ground as more of them would."""

NEAR_PULSES, NEAR_TIME, LONE_STEP = 64, 2.0, 8.0
"""Pulses that follow each other in the sample; the longest time [s] from such a group to the next, in which the ground
does not change by a zone; and how much larger than other steps a jump is, since mountains have many."""

LEAST_OFF, MOST_BETWEEN = 0.02, 0.1
"""Share of the pulses a whole number of zones off their neighbours from which zones are mixed, and that of this share
which may lie half-way: slopes and cliffs lie there."""

FADING_PARTS, LEAST_OF_PART = 16, 50
"""Parts of a strip that show whether it fades, and waveforms of each."""

FEW_PARTS = 1.3
"""Factor of an error that so few parts tell, for surfaces that lie in no order."""

LEAST_FACING, LEAST_PLANE = 0.1, 1e-3
"""Least cosine by which light is divided: grazing rays tell nothing; and least share of their extent that places have
across their line, where they show a plane."""

CELLS, LEAST_OF_CELL, LEAST_CELLS = (8, 32), 4, 50
"""Mean numbers of sampled waveforms of the cells in which light is compared with time; fewest of one that counts, and
fewest such cells."""

SURE_SMOOTH = 2.0
"""Errors beyond which light that grows along the flight, in cells, shows a landscape that is smooth over the strip."""

BREAK = 10.0
"""Time without a pulse from which another flight line begins [s]: aircraft turn for longer."""

HEADINGS, LEAST_STRAIGHT = 4, 0.97
"""Parts of a flight line whose middles give its heading, and least straightness of a flight that has one right side:
headings that scatter by 14 degrees about their mean, by which scan angles of 15 degrees are half a degree wrong."""

BRIGHT = 0.95
"""Quantile of the light of waveforms: above it lie few metal roofs and signs."""

SLICES, SLICE_POINTS = 8, 2048
"""Places of the strip at which GPS times are read, and points at each."""

USUAL_STEP = 0.45
"""Share of the steps of GPS times that are alike within 30 %, from which pulses are not thinned at random: of thinned
ones, of any share, 0.38 at most are like two or three intervals. Of fewer, one in 50 is taken as one interval."""

LEAST_IN_ORDER = 0.8
"""Share of neighbouring points whose times must not fall: points in another order show no pulse rate."""

SCANNERS = 4
"""Scanner channels of LAS points (0 to 3). A channel number here is SCANNERS x digitizer + scanner channel."""

OTHER_PULSE = "echoes were taken for those of another pulse; resolve the pulse zones again with the sensor's software"

_CHANNEL_SAMPLE = 4096
"""Waveforms that show which scanner channels a strip has."""


_Channel = tuple[int, int]
"""Index of a digitizer and scanner channel."""


class Change(NamedTuple):
    """By how much light is brighter, and what another gain or energy may have to do with it."""

    shift: float
    """Logarithm of the ratio."""
    chance: float
    """Of another gain or energy, from 0 to 1."""
    error: float
    """Root mean square of the logarithm of that change, as far as the light shows it, from LIKELY on; less below."""
    spread: float = np.inf
    """How much surfaces change the ratio (standard deviation)."""
    is_uneven: bool = False
    """Whether the shift is that of parts of a strip about their mean, root mean square; or the largest one of a flight
    line against the others of its file."""


NO_CHANGE = Change(0.0, 0.0, 0.0)


class Zone(NamedTuple):
    """What the ground says of ranges that are a whole number of pulse intervals off."""

    size: float
    """Way of light between two pulses, one way [m]."""
    off: float
    """By how much ranges seem too short, as the ground is bent across the flight [m]."""
    error: float
    """Of `off` [m]; infinite where the swath is too narrow."""


class Setting(NamedTuple):
    """A strip's setting by its data."""

    rate: float | None
    """Pulses per second; None where the times do not show it."""
    brightest: dict[_Channel, float]
    """R^2 / eta times the sum of the samples of the strongest waveforms of each channel [DN m2]: slopes do not change
    it."""
    scenes: dict[_Channel, tuple[float, ...]]
    """Logarithms of the QUANTILES of that light, for each channel."""
    places: dict[_Channel, np.ndarray]
    """East, north, logarithm of that light as if the ground were level, time from -1 to 1, and by how much the ray goes
    to the right, of waveforms of each channel, f8 (5, k)."""
    right: tuple[float, float]
    """Unit vector to the right of the flight."""
    fades: Change
    """How this light grows from the first half of the strip to the second."""
    zone: Zone | None
    """None where there is no rate."""
    straight: float = 1.0
    """Way from the start to the end of the flight over the length of its path; of several lines, of all together."""
    sides: tuple[Change, ...] = ()
    """How light grows from one half of the swath to the other, and from its middle to both edges; empty where the
    flight has no right side."""
    width: float = 0.0
    """Standard deviation of how much rays go to the right."""


def weigh_change(
    shift: float, spread: float, noise: float | None = None, *, chance: float, usual: float = 0.0,
    most: float = USUAL_CHANGE,
) -> Change:  # fmt: skip
    """Weigh whether light differs by its surfaces, or by another energy or gain.

    Parameters
    ----------
    shift : float
        By how much it is brighter (logarithm).
    spread : float
        How much surfaces change that (standard deviation).
    noise : float, optional
        Logarithm of the ratio of the noise: a gain changes it as it changes light, an energy does not.
    chance : float
        Of another energy or gain before light and noise are seen.
    usual : float
        By how much air and laser change light in any case (standard deviation of the logarithm).
    most : float
        By how much a change changes light (standard deviation of the logarithm).

    Returns
    -------
    Change

    Notes
    -----
    Bayes' rule with this chance and normal distributions. docs/algorithms.md 5.2.
    """
    seen = np.array([shift, noise or 0.0])
    known = np.diag([spread**2, 1e6 if noise is None else SUNLIGHT**2])
    chances, squares = [], []
    for prior, moves in [(1.0 - chance, (0.0, 0.0)), *((chance / len(CHANGES), moves) for moves in CHANGES)]:
        light = most**2 * np.outer(moves, moves) + np.diag([usual**2, 0.0])
        inverse = np.linalg.inv(known + light)
        chances.append(prior * np.exp(-0.5 * seen @ inverse @ seen) * np.sqrt(np.linalg.det(inverse)))
        squares.append((light[0] @ inverse @ seen) ** 2 + light[0, 0] - light[0] @ inverse @ light[0])
    share = np.array(chances) / max(sum(chances), 1e-300)
    changed = float(1.0 - share[0])
    share[1:] /= max(changed, LIKELY)
    return Change(shift, changed, float(np.sqrt(share @ squares)), spread)


def compare_scenes(
    one: ArrayLike, other: ArrayLike, noise: float | None = None, *, chance: float, usual: float = 0.0
) -> Change:
    """Weigh by how much one scene is brighter than another; noise, chance, usual: as `weigh_change`.

    Another energy or gain shifts the logarithms of all quantiles alike; other surfaces shift each in its own way.
    """
    off = np.subtract(one, other)
    spread = float(np.hypot(min(UNLIKE * float(np.std(off)), MOST_UNLIKE), LEAST_UNLIKE))
    return weigh_change(float(np.median(off)), spread, noise, chance=chance, usual=usual)


def compare_ground(
    places: np.ndarray, known: np.ndarray, noise: float | None = None, *, chance: float, usual: float = 0.0
) -> tuple[Change, Change | None, Change] | None:
    """Weigh by how much the ground that a calibrated strip saw too is brighter, how that grows along the strip, and how
    it changes across the flight.

    Parameters
    ----------
    places : float array, shape (5, k)
        As `Setting.places`.
    known : float array, shape (m, 3)
        East, north and logarithm of the light of places of the calibration.
    noise : float, optional
    chance, usual : float
        As for `weigh_change`.

    Returns
    -------
    level, growth, across : Change
        Growth is that from the first half of the strip to the second; None where common ground is at one end. Across:
        the shift holds 68 % of the places. None instead of all for too little common ground, or where its pattern is
        not the same.
    """
    there = known.T
    if not (there.size and places.size):
        return None
    apart = np.hypot(*(there[:2, :, None] - places[:2, None]))
    near, distance = apart.argmin(axis=1), apart.min(axis=1)
    # Beyond the edge of the strip places have neighbours on other ground, and one neighbour for many places.
    rows = np.argsort(distance, kind="stable")[: np.count_nonzero(distance < NEAR)]
    rows = rows[distance[rows] <= BESIDE * distance[rows[len(rows) // 2 :][:1]].sum()]
    rows = rows[np.unique(near[rows], return_index=True)[1]]
    if len(rows) < LEAST_COMMON:
        return None
    light, time, side = places[2:, near[rows]]
    off, whole = light - there[2, rows], np.hypot(robust_std(light), robust_std(there[2, rows]))
    if robust_std(off) > LIKE_GROUND * whole:
        return None
    # Warming up, or failing for a time, moves parts of the strip.
    found = []
    for place, most in ((time, USUAL_CHANGE), (side, USUAL_SIDES)):
        order = np.argsort(place, kind="stable")
        parts = np.array_split(off[order], len(off) // LEAST_COMMON)
        middles = np.array([float(np.sort(part)[len(part) // 4 : -(len(part) // 4)].mean()) for part in parts])
        rest = np.concatenate([part - middle for part, middle in zip(parts, middles, strict=True)])
        rest = np.clip(rest, -BORDER * robust_std(rest), BORDER * robust_std(rest))
        doubt = float(np.hypot(MEDIAN_ERROR * np.std(rest) * (len(parts) / len(off)) ** 0.5, SAME_GROUND))
        found.append(weigh_change(float(np.std(middles)), doubt, chance=chance, most=most)._replace(is_uneven=True))
    uneven, across = found[0], found[1]._replace(shift=float(np.quantile(np.abs(middles), 0.68)))
    # Neighbours on two sides of a field's border say nothing.
    same = np.abs(off - np.median(off)) <= BORDER * robust_std(off)
    off, time = off[same], time[same]
    error, spread = float(np.std(off)) / len(off) ** 0.5, float(np.std(time))
    doubt = float(np.hypot(MEDIAN_ERROR * error, SAME_GROUND))
    level = weigh_change(float(np.median(off)), doubt, noise, chance=chance, usual=usual)
    if spread < SPAN:
        return level, None, across
    slope = float(np.polyfit(time, off, 1)[0])
    even = weigh_change(slope, float(np.hypot(error / spread, SAME_GROUND)), chance=chance)
    return level, uneven if even.chance <= LIKELY < uneven.chance else even, across


def measure_setting(
    reader: StripReader,
    scan: StripScan,
    sensor: SensorSource,
    attenuation: float,
    energy: float = 1.0,
    *,
    chance: float = 0.0,
) -> Setting:
    """Measure the setting of a strip; attenuation: of the air, one way [dB/km], energy: by which light is divided;
    chance: of a laser that fades, before the light is seen."""
    known = _read_rows(reader, scan, sensor, attenuation, energy)
    rate = _measure_rate(reader)
    every = np.concatenate([np.empty((9, 0)), *known.values()], axis=1)
    zone = _find_zone(reader, every, 1e9 * HALF_C / rate) if known and rate else None
    right, straight = _find_right(every[0], every[6:8])
    brightest, scenes, places, fading, sides, width = {}, {}, {}, [NO_CHANGE], [], 0.0
    for channel, rows in known.items():
        time, light, east, north = rows[:4]
        brightest[channel] = float(np.quantile(light, BRIGHT))
        scenes[channel] = tuple(np.log(np.quantile(light, QUANTILES)).tolist())
        off, (level, across) = time - 0.5 * (time.min() + time.max()), _level(rows, right)
        places[channel] = np.stack([east, north, np.log(level), off / max(float(off.max()), 1e-9), across])
        width = max(width, float(np.std(across)))
        fading.append(_find_fading(time, light, rows[2:4], chance=0.5 * chance))
        lines = _compare_lines(time, np.log(light), rows[2:4], chance=chance)
        fading += [lines] if lines.chance > LIKELY else []
        sides += [_find_sides(level, across, rows[2:4], right, chance=chance)] if straight >= LEAST_STRAIGHT else []
    fades, *uneven = (max(found, key=lambda one: one.error) for found in (fading, *zip(*sides, strict=True)))
    return Setting(rate, brightest, scenes, places, right, fades, zone, straight, tuple(uneven), width)


def _level(rows: np.ndarray, right: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Light of level ground, and by how much the rays go to the right, of rows as `_read_rows`.

    What slopes do to light is taken off by a plane of the ground in each cell: over a valley light falls to both sides.
    """
    down, (east, north) = rows[5], rows[2:4] - rows[6:8]
    *_, cell, count = cut_cells(rows[2:4], CELLS[1])
    x, y, z = (one - (np.bincount(cell, one) / count)[cell] for one in rows[2:5])
    xx, xy, yy, xz, yz = (np.bincount(cell, one * other) for one, other in ((x, x), (x, y), (y, y), (x, z), (y, z)))
    known = xx * yy - xy * xy
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.stack([yy * xz - xy * yz, xx * yz - xy * xz]) / known
    slopes[:, (count < LEAST_OF_CELL) | (known <= LEAST_PLANE * xx * yy)] = 0.0
    tilt = slopes[0, cell] * east + slopes[1, cell] * north
    light = rows[1] / np.maximum(down + tilt / rows[8], LEAST_FACING)
    return light, (right[0] * east + right[1] * north) / rows[8]


def _find_sides(
    light: np.ndarray, across: np.ndarray, place: np.ndarray, right: tuple[float, float], *, chance: float
) -> tuple[Change, ...]:
    """How light, as from `_level`, grows from one half of the swath to the other, and from its middle to both edges.

    Landscapes that are smooth over the whole strip grow along the flight as they do across it: what they show there,
    beyond chance, is in the spread.
    """
    prior: Any = {"chance": chance / 2, "most": USUAL_SIDES}
    aside, along = (one * place[0] + other * place[1] for one, other in (right, (-right[1], right[0])))
    along = along * (float(np.std(across)) / max(float(np.std(aside)), 1e-9))
    shown = find_growth_in_cells(along, np.log(light), place)
    smooth, sides = max((abs(slope) - SURE_SMOOTH * error for error, slope in shown), default=0.0), []
    for one in (across, np.abs(across)):
        found = _find_fading(one, light, place, **prior)
        half = 2.0 * float(np.abs(one - one.mean()).mean())
        spread = float(np.hypot(found.spread, half * max(smooth, 0.0)))  # infinite for too few waveforms
        sides.append(weigh_change(found.shift, min(spread, 10.0 * USUAL_SIDES), **prior))
    return tuple(sides)


def _find_right(time: np.ndarray, place: np.ndarray) -> tuple[tuple[float, float], float]:
    """Unit vector to the right of the flight by positions of the sensor f8 (2, n), and `Setting.straight`; 0 where it
    does not move."""
    order, steps = np.argsort(time, kind="stable"), [np.zeros((1, 2))]
    for line in np.split(place[:, order], np.flatnonzero(np.diff(time[order]) > BREAK) + 1, axis=1):
        if line.shape[1] >= HEADINGS:
            middles = [part.mean(axis=1) for part in np.array_split(line, HEADINGS, axis=1)]
            steps.append(np.diff(middles, axis=0))
    every = np.concatenate(steps)
    east, north = every.sum(axis=0).tolist()
    whole = max(float(np.hypot(east, north)), 1e-30)
    return (north / whole, -east / whole), whole / max(float(np.hypot(*every.T).sum()), 1e-12)


def refuse_headings(reader: StripReader, found: Setting) -> None:
    """Raise InputError where a flight has no right side, from which a term over the scan angle counts."""
    if found.straight < LEAST_STRAIGHT:
        raise InputError(
            f"{reader.facts.path}: was flown in several headings, so that a term over the scan angle (--scan-angle) "
            "does not apply: cut it into its flight lines"
        )


def _read_rows(
    reader: StripReader, scan: StripScan, sensor: SensorSource, attenuation: float, energy: float = 1.0
) -> dict[_Channel, np.ndarray]:
    """Of a sample of each channel, f8 (9, n): time, light, place of the brightest sample, cosine of the ray's angle to
    the vertical, x and y of the sensor, and the distance to it."""
    parts: dict[_Channel, list[np.ndarray]] = {}
    for block in reader.sample_blocks(scan, SAMPLE):
        block = sensor.fill(block)
        if block.sensor is None:
            continue
        above = take_off_level(block)
        time = block.spacing * np.argmax(np.nan_to_num(above, nan=-np.inf), axis=1)
        away = block.origin + block.direction * time[:, None] - block.sensor
        distance = np.sqrt((away * away).sum(axis=1))
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            whole = np.nansum(above, axis=1) * distance**2 / transmit(distance, attenuation) / energy
            down = -away[:, 2] / distance
        rows = np.stack([block.gps_time, whole, *(away + block.sensor).T, down, *block.sensor.T[:2], distance])
        scanner = np.zeros(len(block), np.int64) if block.scanner is None else block.scanner
        for number in np.unique(scanner).tolist():
            parts.setdefault((block.digitizer.index, number), []).append(rows[:, (whole > 0) & (scanner == number)])
    joined = {channel: np.concatenate(some, axis=1) for channel, some in parts.items()}
    return {channel: rows for channel, rows in joined.items() if rows.size}


def doubt_zone(reader: StripReader, scan: StripScan, sensor: SensorSource) -> tuple[str, ...]:
    """Return the line about ranges of another pulse, of a strip without a calibration, which would be refused."""
    rate = _measure_rate(reader)
    if not rate or not 0.0 < 1e9 * HALF_C / rate < np.inf:
        return ()
    rows = np.concatenate([np.empty((9, 0)), *_read_rows(reader, scan, sensor, AIR_ATTENUATION).values()], axis=1)
    if not rows.size:
        return ()
    try:
        _find_zone(reader, rows, 1e9 * HALF_C / rate)
    except InputError as error:
        line = str(error).removeprefix(f"{reader.facts.path}: ")
        return (f"{line}; a valley or a ridge along the flight looks alike",)
    return ()


def _find_zone(reader: StripReader, rows: np.ndarray, size: float) -> Zone:
    """Measure how the ground is bent across the flight; InputError where that, or jumps, show a wrong pulse zone.

    rows: f8 (9, n), of which 0 is the time, and 2 to 5 are x, y, z and the cosine of the ray's angle to the vertical;
    size: way of light between two pulses, one way [m]. Ranges that are too short by s lift the ground by s times that
    cosine.
    """
    rows, found = rows[:, np.argsort(rows[0], kind="stable")], []
    # Do pulses lie whole zones off their neighbours, or groups of them off the next?
    groups = np.array_split(rows, max(rows.shape[1] // NEAR_PULSES, 1), axis=1)
    height = np.array([np.median(group[4]) for group in groups])
    zones = np.concatenate([(group[4] - at) / group[5] for group, at in zip(groups, height, strict=True)]) / size
    whole = _is_whole(zones)
    steps = np.diff(height)[np.diff([np.median(group[0]) for group in groups]) < NEAR_TIME] / size
    between = np.mean(np.abs(zones - np.rint(zones)) > 0.25)
    mixed = np.mean(whole) > LEAST_OFF and between < MOST_BETWEEN * np.mean(whole)
    lone = np.abs(steps) > LONE_STEP * np.median(np.abs(steps)) if len(steps) else False
    if mixed or (_is_whole(steps) & lone).any():
        raise InputError(
            f"{reader.facts.path}: heights of neighbouring pulses jump by a whole number of the {size:.0f} m between "
            f"two pulses: {OTHER_PULSE}"
        )
    for part in np.array_split(rows[2:6], ZONE_PARTS, axis=1):
        x, y, z, down = part - part.mean(axis=1, keepdims=True)
        if part.shape[1] < LEAST_OF_ZONE or np.std(down) < LEAST_BEND:
            return Zone(size, 0.0, np.inf)
        found.append(np.linalg.lstsq(np.stack([x, y, down], axis=1), z, rcond=None)[0][2])
    off, error = float(np.median(found)), robust_std(np.array(found)) / ZONE_PARTS**0.5
    number = round(off / size)
    if 0 < abs(number) <= MOST_ZONES and abs(off - number * size) < MOST_BEND * size > error:
        raise InputError(
            f"{reader.facts.path}: its ground is bent across the flight as if all ranges were {abs(off):.0f} m too "
            f"{'short' if off > 0 else 'long'}, {abs(number)} x the {size:.0f} m between two pulses: {OTHER_PULSE}"
        )
    return Zone(size, off, error)


def _is_whole(zones: np.ndarray) -> np.ndarray:
    number = np.rint(zones)
    return (number != 0) & (np.abs(number) <= MOST_ZONES) & (np.abs(zones - number) < MOST_BEND)


def number_channel(digitizer: int, scanner: int) -> float:
    """Return the number of a channel in `Calibration.places`: the digitizer and a quarter of the scanner channel."""
    return digitizer + scanner / SCANNERS


def keep_places(places: Mapping[_Channel, np.ndarray]) -> tuple[float, ...]:
    """Return a part of `Setting.places` as `Calibration.places`, spread evenly over the strip."""
    parts = [
        np.column_stack([np.full(part.shape[1], number_channel(*channel)), *part[:2].round(1), part[2].round(3)])
        for channel, part in places.items()
    ]
    joined = np.concatenate([np.empty((0, 4)), *parts])
    return tuple(joined[even_places(len(joined), PLACES)].ravel().tolist())


def _find_fading(
    time: np.ndarray, light: np.ndarray, place: np.ndarray, *, chance: float, most: float = USUAL_CHANGE
) -> Change:
    """How light grows from the first half of a strip to the second; place: east and north, f8 (2, n).

    By a line through the scenes of its parts: what parts scatter about the line is their surfaces' doing. Fields,
    forests and towns reach over several parts: such neighbours scatter alike, and raise the error by what they share.
    Or by how it grows within small cells of the ground, most of which lie in one field. What shows it best counts.
    """
    parts = np.array_split(np.argsort(time, kind="stable"), FADING_PARTS)
    if len(time) < FADING_PARTS * LEAST_OF_PART or time.min() == time.max():
        return NO_CHANGE
    middle = np.array([time[part].mean() for part in parts])
    middle -= middle.mean()
    half = 2.0 * np.abs(middle).mean()
    scenes = np.array([np.log(np.quantile(light[part], QUANTILES)) for part in parts])
    slopes, levels = half * (middle @ scenes) / (middle @ middle), np.median(scenes, axis=1)
    rest = levels - levels.mean() - middle * (middle @ levels) / (middle @ middle)
    error = weigh_alike(rest) * half * float(np.sqrt(rest @ rest / (FADING_PARTS - 2) / (middle @ middle)))
    found = [(float(np.sqrt(LEAST_UNLIKE**2 + np.var(slopes) + error**2)), float(np.median(slopes)))]
    for error, slope in find_growth_in_cells(time, np.log(light), place):
        found.append((float(np.hypot(SAME_GROUND, half * error)), half * slope))
    spread, shift = min(found)
    return weigh_change(shift, spread, chance=chance, most=most)


def find_growth_in_cells(time: np.ndarray, light: np.ndarray, place: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield errors and slopes over time of light in cells of the ground of two sizes: medians over the cells, since a
    field's border in some of them says nothing."""
    for number in CELLS:
        across, up, first, cell, count = cut_cells(place, number)
        off, bright = (one - (np.bincount(cell, one) / count)[cell] for one in (time, light))
        weight = np.bincount(cell, off * off)
        good = (count >= LEAST_OF_CELL) & (weight > 0.0)
        if good.sum() >= LEAST_CELLS:
            slope = np.bincount(cell, off * bright)[good] / weight[good]
            middle, scatter = float(np.median(slope)), robust_std(slope)
            rest = np.clip(slope - middle, -BORDER * scatter, BORDER * scatter)
            # Cells beside each other, in either direction, tell the same where brightness runs smoothly.
            turned = np.lexsort((across[first[good]], up[first[good]]))
            alike = weigh_alike(rest) * weigh_alike(rest[turned]) / FEW_PARTS**2
            yield MEDIAN_ERROR * scatter * (alike / len(slope)) ** 0.5, middle


def cut_cells(place: np.ndarray, number: int) -> tuple[np.ndarray, ...]:
    """Return cells of the ground in which so many places lie in the mean: column and row of the cell of each place, the
    first place of each cell, the cell of each place, and how many each cell has."""
    low, high = place.min(axis=1), place.max(axis=1)
    size = max(float(np.sqrt(np.prod(high - low) * number / place.shape[1])), 1e-3)
    across, up = ((place - low[:, None]) // size).astype(np.int64)
    key = across * (up.max() + 1) + up
    return (across, up, *np.unique(key, return_index=True, return_inverse=True, return_counts=True)[1:])


def _compare_lines(time: np.ndarray, light: np.ndarray, place: np.ndarray, *, chance: float) -> Change:
    """By how much one of several flight lines in one file is brighter than the others, in cells that both saw."""
    order = np.argsort(time, kind="stable")
    line = np.empty(len(time), np.int64)
    line[order] = np.cumsum(np.append(False, np.diff(time[order]) > BREAK))
    *_, cell, count = cut_cells(place, CELLS[0])
    whole, found, lines = np.bincount(cell, light), [NO_CHANGE], int(line.max()) + 1
    for number in range(lines if lines > 1 else 0):
        own = line == number
        mine, level = np.bincount(cell[own], minlength=len(count)), np.bincount(cell[own], light[own], len(count))
        both = (mine > 0) & (mine < count)
        if both.sum() >= LEAST_CELLS:
            off = level[both] / mine[both] - (whole - level)[both] / (count - mine)[both]
            doubt = float(np.hypot(MEDIAN_ERROR * robust_std(off) / len(off) ** 0.5, 2.0 * SAME_GROUND))
            # Of many lines one is off by chance.
            found.append(weigh_change(float(np.median(off)), doubt, chance=chance / lines)._replace(is_uneven=True))
    return max(found, key=lambda one: one.chance * abs(one.shift))


def weigh_alike(rest: np.ndarray) -> float:
    """Factor of the error of a slope along the strip, by what parts in their order scatter about it, f8 (n,)."""
    alike = np.correlate(rest, rest, "full")[len(rest) - 1 :] / max(float(rest @ rest), 1e-30)
    return FEW_PARTS * (1.0 + 2.0 * float(alike[1 : int(np.argmax(alike <= 0.0))].sum()))


def take_off_level(block: WaveformBlock) -> np.ndarray:
    """Return samples f4 (n, s) over the median of their waveform, whose sum is the light of a pulse without any fit;
    NaN where they are missing."""
    samples = block.samples.astype(np.float32)
    if block.missing is not None:
        samples[block.missing] = np.nan
    return samples - known_median(samples, 1)[:, None]


def _measure_rate(reader: StripReader) -> float | None:
    """Pulses per second by the shortest usual distance of GPS times: pulses without a point leave longer ones."""
    count, rates = reader.facts.header.point_count, []
    for start in np.unique(np.linspace(0, max(count - SLICE_POINTS, 0), SLICES).astype(np.int64)).tolist():
        time = widen_integers(reader.read_points(start, min(start + SLICE_POINTS, count))["gps_time"])
        step = np.diff(time[np.isfinite(time)])
        later = step[step > 0]
        if not len(later) or np.mean(step >= 0) < LEAST_IN_ORDER:
            continue
        # Echoes may have times of their own. Thinned at random, less than USUAL_STEP of the steps are like any of them.
        later = np.sort(later)
        like = np.searchsorted(later, 1.3 * later, "right") - np.searchsorted(later, 0.7 * later)
        usual = later[like > USUAL_STEP * len(later)]
        shortest = float(usual[0] if len(usual) else np.quantile(later, 0.02))
        for _ in range(3):
            shortest = float(np.mean(later[np.abs(later - shortest) < 0.3 * shortest + 1e-9]))
        rates.append(1.0 / shortest)
    return float(np.median(rates)) if rates else None


def read_day(reader: StripReader) -> str:
    """Return the day of the flight as 2026-11-22; empty where GPS times are not standard ones."""
    header = reader.facts.header
    if not header.point_count or not header.global_encoding & 1:
        return ""
    time = float(reader.read_points(0, 1)["gps_time"][0])
    return date_gps(time).date().isoformat() if WEEK < time + ADJUSTED < 4e9 else ""


def read_sensor_name(facts: StripFacts) -> str:
    """Return the system identifier of the header; empty where it names no sensor."""
    name = decode_text(facts.header.system_identifier).strip()
    return "" if name.upper() in ("OTHER", "MERGE", "MODIFICATION", "EXTRACTION", "TRANSFORMATION", "") else name


def see_channels(reader: StripReader, scan: StripScan) -> dict[tuple[int, int], float]:
    """Return the share of the waveforms of each digitizer and scanner channel, by a sample for the scanner channels."""
    total = sum(scan.by_descriptor.values())
    counts: dict[int, np.ndarray] = {}
    for block in reader.sample_blocks(scan, _CHANNEL_SAMPLE):
        scanner = np.zeros(len(block), np.int64) if block.scanner is None else block.scanner
        counts[block.digitizer.index] = counts.get(block.digitizer.index, 0) + np.bincount(scanner, minlength=SCANNERS)
    shares: dict[tuple[int, int], float] = {}
    for index, number in sorted(scan.by_descriptor.items()):
        of = counts.get(index, np.eye(SCANNERS)[0])
        shares |= {(index, scanner): number / total * of[scanner] / of.sum() for scanner in np.flatnonzero(of).tolist()}
    return shares
