"""What differs between a calibration and a strip of its sensor, and what that adds to the error of the constant.

`strip_match` asks about day, distance, air, software, rate of the pulses, noise, light and divergence.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from datetime import date
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.las.header import decode_text
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.attribute.radiometry import AIR_DOUBT
from wavebatch.surveying.calibration import Calibration, ChannelConstant
from wavebatch.surveying.matching.setting import (
    MOST_ZONES,
    OTHER_PULSE,
    SUNLIGHT,
    Change,
    Setting,
    compare_ground,
    compare_scenes,
    number_channel,
    read_day,
    read_sensor_name,
)
from wavebatch.surveying.sensor import FOOT, SensorSource

SAME_DIVERGENCE = 0.03
"""Relative difference up to which divergences are equal."""

OTHER_DAY, OTHER_MONTH = 0.02, 0.05
"""Errors for strips of another day than the calibration, and for more than 30 days: lasers and receivers drift. These
are assumptions; `wavebatch calibrate` of several strips measures the drift of a flight."""

UNSTATED = 0.03
"""Error of a constant whose file states none: that of the reflectances of targets."""

LEAST_AIR = 0.005
"""Relative change of the light from which other air on the same day is named."""

FAR = 1.3
"""Ratio of distances from which the strip's and the targets' are named."""

SAME_RATE = 1.02
"""Ratio up to which pulse rates are equal."""

OTHER_RANGE, LIKE_RANGE = 1.5, 0.35
"""Logarithm of the light from which surfaces do not explain it, and by how much they change what ranges explain."""

LIKE_FEET = 0.35
"""Logarithm by which light may differ from what feet taken for metres make of it: other surfaces, and more air."""

LIKELY, HIDDEN = 0.5, 0.05
"""Chance from which another gain or energy is named; and error from which it is said that one would not show."""

OTHER_NOISE, OTHER_LIGHT = 1.3, 1.5
"""Ratios of noise and of the light of the strongest echoes from which another gain is suspected: sunlight changes the
one, other surfaces the other."""


def doubt_calibration(calibration: Calibration) -> Iterator[str]:
    """Yield what makes a calibration doubtful for any strip."""
    if not any(row.is_described for row in calibration.channels):
        yield (
            "calibration: the file does not say which sensor it was measured with (an earlier version wrote it), so "
            "it cannot be compared with this strip; measure it again with `wavebatch calibrate`"
        )
    if not _least_error(calibration):
        yield (
            f"calibration: its relative_error is 0, but no constant is known exactly: {UNSTATED:.0%} is taken; put the "
            "error of the targets into the file"
        )


def _least_error(calibration: Calibration) -> float:
    """The least relative error of its constants."""
    return min([calibration.relative_error, *(row.relative_error for row in calibration.channels)])


def find_growth(
    calibration: Calibration, reader: StripReader, sensor: SensorSource, attenuation: float | None
) -> tuple[float, list[str]]:
    """Error that day, air, distance and sensor add to the constant, relative, and the warnings.

    attenuation: of the strip's air [dB/km], where it is given. Air that is not given is known to AIR_DOUBT: over the
    whole way on another day than that of the calibration, over what the ways differ on the same.
    """
    parts, lines = [UNSTATED if not _least_error(calibration) else 0.0], []
    day = read_day(reader)
    slope = 2.0e-4 * math.log(10.0) * AIR_DOUBT * calibration.attenuation
    haze = sensor.haze / calibration.haze if calibration.haze and attenuation is None else 1.0
    if day and calibration.flight and day != calibration.flight:
        apart = abs((date.fromisoformat(day) - date.fromisoformat(calibration.flight)).days)
        own = haze * (sensor.distance or 0.0) if attenuation is None else 0.0
        air = slope * math.hypot(own, calibration.distance or 0.0)
        parts.append(math.hypot(OTHER_MONTH if apart > 30 else OTHER_DAY, air))
        lines.append(
            f"calibration: measured on {calibration.flight}, this strip was flown on {day}: the error of the constant "
            f"grows by {100 * parts[-1]:.0f} %, {100 * air:.0f} % of it for the air"
        )
    elif calibration.distance and sensor.distance:
        more, less = haze * sensor.distance - calibration.distance, 0.0
        if haze != 1.0 and calibration.haze:
            # What heights above sea take off the air is known to a half as well.
            less = (sensor.distance - calibration.distance) / calibration.haze - more
        parts.append(slope * math.hypot(more, less))
        ratio = sensor.distance / calibration.distance
        if max(ratio, 1 / ratio) > FAR:
            lines.append(
                f"calibration: measured at {calibration.distance:.0f} m, this strip is {sensor.distance:.0f} m away: "
                f"the air between adds {100 * parts[-1]:.1f} % to the error of the constant"
            )
    name = read_sensor_name(reader.facts)
    if calibration.sensor and name and name != calibration.sensor:
        lines.append(
            f"calibration: measured with sensor {calibration.sensor!r}, the header of this strip names {name!r}; "
            "bits, spacing, gain and pulse agree"
        )
    software = decode_text(reader.facts.header.generating_software).strip()
    if calibration.software and software and software != calibration.software:
        lines.append(f"calibration: measured on a file of {calibration.software!r}, this one is of {software!r}")
    return float(np.sqrt(np.sum(np.square(parts)))), lines


def refuse_zone(calibration: Calibration, found: Setting, distance: float | None, path: Path) -> None:
    """Raise InputError where light is as much darker or brighter than the calibration's as in a wrong pulse zone, and
    the ground's bend does not speak against it: narrow swaths and hills do not show the zone alone."""
    zone = found.zone
    if zone is None or not distance or abs(zone.off) + 2.0 * zone.error < 0.5 * zone.size:
        return
    for row, number in itertools.product(calibration.channels, range(-MOST_ZONES, MOST_ZONES + 1)):
        scene, off = found.scenes.get((row.digitizer, row.scanner), ()), number * zone.size
        if not number or distance + off <= 0.0 or not scene or len(row.scene) != len(scene):
            continue
        light = -2.0 * math.log1p(off / distance) - 2.0e-4 * math.log(10.0) * calibration.attenuation * off
        seen = float(np.median(np.subtract(scene, row.scene)))
        if abs(light) > OTHER_RANGE and abs(seen - light) < LIKE_RANGE:
            raise InputError(
                f"{path}: --calibration: its light is {math.exp(seen):.2g} times that of the calibration, as if all "
                f"ranges were {abs(off):.0f} m too {'short' if off > 0 else 'long'}, {abs(number)} x the way between "
                f"two pulses: {OTHER_PULSE}, or calibrate this strip if its gain is another"
            )


def compare_setting(
    calibration: Calibration, found: Setting, system: SystemPulse
) -> tuple[float, list[str], list[str]]:
    """Error that another pulse rate or gain adds to the constant, relative, the warnings, and what would not show."""
    growth, lines, notes = 0.0, [], []

    def compare(value: float | None, known: float | None, most: float, share: float, line: str) -> None:
        nonlocal growth
        off = abs(math.log(value / known)) if value and known else 0.0
        if off > math.log(most):
            growth = max(growth, share * off)
            lines.append(f"calibration: {line} {value:.4g}, where the calibration has {known:.4g}")

    compare(found.rate, calibration.rate, SAME_RATE, 1.0, "another rate of pulses [1/s], so another energy:")
    for row in calibration.channels:
        noise, which = system.digitizers.get(row.digitizer, system).noise.std, f"of digitizer {row.digitizer}"
        which += f" scanner channel {row.scanner}" if row.scanner else ""
        compare(noise, row.noise_dn, OTHER_NOISE, 1.0, f"another gain, or other sunlight: noise {which} is [DN]")
        # Other surfaces explain it as well as another gain: half of the square of what a gain would be.
        light = found.brightest.get((row.digitizer, row.scanner))
        surfaces = "other surfaces"
        if light and row.brightest and abs(math.log(light / row.brightest * FOOT**2)) < LIKE_FEET:
            surfaces += ", or coordinates in feet (which make it 10.8 times as bright)"
        compare(light, row.brightest, OTHER_LIGHT, 0.5**0.5, f"another gain, or {surfaces}: light {which} is")
        scene = found.scenes.get((row.digitizer, row.scanner))
        if not scene or len(row.scene) != len(scene):
            continue
        louder = math.log(noise / row.noise_dn) if noise and row.noise_dn else None
        ground = _compare_places(calibration, found, row, louder)
        seen, change = ("ground in common is", ground[0]) if ground else ("scenes are", None)
        change = change or compare_scenes(scene, row.scene, louder, chance=calibration.change_chance)
        more = math.expm1(abs(change.shift) if change.chance > LIKELY else change.error)
        growth = max(growth, more)
        if change.chance <= LIKELY and more > HIDDEN:
            known = f"ground in common scatters {which}" if ground else f"surfaces {which} differ, no ground is common"
            notes.append(
                f"calibration: {known}, so that another energy under the same "
                f"header would not show: {100 * more:.0f} % of error hold it, by an assumed chance of "
                f"{calibration.change_chance:.0%} (change_chance); calibrate a strip that overlaps this one"
            )
        elif change.chance > LIKELY:
            lines.append(
                f"calibration: another gain or energy under the same header: all echoes {which} are brighter by a "
                f"factor of {math.exp(change.shift):.2f}, "
                + ("and noise with them" if abs(louder or 0.0) > SUNLIGHT else f"though {seen} alike")
            )
    return growth, [f"{line}: the error of the constant grows by {100 * growth:.0f} %" for line in lines], notes


def _compare_places(
    calibration: Calibration, found: Setting, row: ChannelConstant, noise: float | None = None
) -> tuple[Change, Change | None] | None:
    known = np.reshape(calibration.places[: len(calibration.places) // 4 * 4], (-1, 4))
    seen = found.places.get((row.digitizer, row.scanner), np.empty((4, 0)))
    mine = known[known[:, 0] == number_channel(row.digitizer, row.scanner), 1:]
    return compare_ground(seen, mine, noise, chance=calibration.change_chance)


def judge_fading(calibration: Calibration, found: Setting, *, other: bool) -> tuple[float, list[str], list[str]]:
    """Error of the constant by light that changes along the strip, relative, the warnings, and what would not show.

    other: a strip that was not calibrated, so that ground in common shows it. Of strips that were calibrated together
    their overlaps do.
    """
    fades, hidden = found.fades, "surfaces in large patches hide"
    compared = [_compare_places(calibration, found, row) for row in calibration.channels if other]
    seen = [ground[1] for ground in compared if ground and ground[1]]
    if seen:
        # One laser that fades is enough.
        fades, hidden = max(seen, key=lambda one: (one.chance, one.error)), "the scatter of the ground in common hides"
    if fades.chance > LIKELY:
        growth = math.expm1(abs(fades.shift))
        return growth, [
            f"calibration: the second half of the strip is {100 * math.expm1(fades.shift):+.0f} % brighter, though "
            "both are like one scene: a laser that fades, or haze? The error of the constant grows by "
            f"{100 * growth:.0f} %; calibrate shorter strips"
        ], []
    growth = math.expm1(fades.error)
    if growth < HIDDEN or not other and len(calibration.strips) > 1:
        return 0.0, [], []
    return growth, [], [
        f"calibration: {hidden} whether the laser fades along the strip: {100 * growth:.0f} % of error hold it; "
        "calibrate strips that overlap this one"
    ]


def compare_air(
    calibration: Calibration, reader: StripReader, sensor: SensorSource, attenuation: float | None, warnings: list[str]
) -> float:
    """Relative error of a strip of the calibration's day that is given other air than the calibration had."""
    day = read_day(reader)
    if attenuation is None or not sensor.distance or (day and calibration.flight and day != calibration.flight):
        return 0.0
    off = 2.0e-4 * math.log(10.0) * sensor.distance * (attenuation - calibration.attenuation)
    if abs(off) < LEAST_AIR:
        return 0.0
    warnings.append(
        f"calibration: --attenuation {attenuation:g} dB/km contradicts the {calibration.attenuation:.2g} dB/km with "
        f"which the constant was measured on the same day: light changes by {100 * math.expm1(off):+.0f} %, which is "
        "in the error; give `wavebatch calibrate` the same --attenuation"
    )
    return abs(off)


def compare_divergence(calibration: Calibration, system: SystemPulse) -> Iterator[str]:
    """Yield the sentence about a divergence that is not that of the calibration."""
    own, other = system.radiometry.divergence, calibration.divergence
    if own is not None and other is not None and abs(own / other - 1.0) > SAME_DIVERGENCE:
        yield (
            f"calibration: measured with a divergence of {other:g} mrad, the survey has {own:g} mrad, which is used: "
            f"one of the two makes cross sections {100 * abs((own / other) ** 2 - 1):.0f} % wrong"
        )
