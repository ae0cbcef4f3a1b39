"""Whether a calibration fits the strip that it is used for: channel, recording, pulse, chain, day, distance.

`prepare` calls `match_strip` once per strip. A constant belongs to one channel of one sensor with
its settings: for anything else it is wrong by any factor. A contradiction is an error, with the reason; what only makes
the constant less certain (day, distance, air, software, rate of the pulses, noise, light and divergence) gives a
warning and a larger error.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import UNCLEAN
from wavebatch.core.errors import InputError
from wavebatch.core.units import FWHM_PER_SIGMA, name_first
from wavebatch.core.waveforms import Digitizer, SystemPulse
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.las.header import decode_text
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.attribute.radiometry import AIR_DOUBT
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.surveying.calibration import ONE_VIEW, Calibration, ChannelConstant
from wavebatch.surveying.flat_ground import sample_reference
from wavebatch.surveying.matching import setting as settings
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

HIDDEN = 0.05
"""Error from which it is said that another gain or energy would not show, or that light is uneven on common ground."""

SIDES = ("from half to half of the swath", "between its middle and its edges")
"""Of `Setting.sides`."""

FROM_START = 2.0 / 3.0**0.5
"""Root mean square over a strip of light that changes evenly from its start, over the change from half to half."""

ANYWHERE = (2.0 / 3.0) ** 0.5
"""Root mean square of what even growth across a swath changes between two places anywhere in it, a target's and an
echo's, over the growth from half to half."""

OTHER_NOISE, OTHER_LIGHT = 1.3, 1.5
"""Ratios of noise and of the light of the strongest echoes from which another gain is suspected: sunlight changes the
one, other surfaces the other."""


def find_growth(
    calibration: Calibration, reader: StripReader, sensor: SensorSource, attenuation: float | None, *, other: bool
) -> tuple[float, bool, list[str]]:
    """Error that day, air, distance and sensor add to the constant, relative, whether it is of another day, the lines.

    attenuation: of the strip's air [dB/km], where it is given. Air that is not given is known to AIR_DOUBT: over both
    ways on another day than that of the calibration. Within a day half of the variance of air and laser is common
    (assumed), so that air counts over the way of the strip, and over what the ways differ. other: a strip that was not
    calibrated.
    """
    usual, lines = OTHER_DAY * 0.5**0.5 * other, []
    day = settings.read_day(reader)
    later = bool(day and calibration.flight and day != calibration.flight)
    slope = 2.0e-4 * math.log(10.0) * AIR_DOUBT * calibration.attenuation
    haze = sensor.haze / calibration.haze if calibration.haze and attenuation is None else 1.0
    if later:
        apart = abs((date.fromisoformat(day) - date.fromisoformat(calibration.flight)).days)
        own = haze * (sensor.distance or 0.0) if attenuation is None else 0.0
        air = slope * math.hypot(own, calibration.distance or 0.0)
        usual = math.hypot(OTHER_MONTH if apart > 30 else OTHER_DAY, air)
        lines.append(
            f"calibration: measured on {calibration.flight}, this strip was flown on {day}: the error of the constant "
            f"grows by {100 * usual:.0f} %, {100 * air:.0f} % of it for the air"
        )
    elif calibration.distance and sensor.distance:
        more, less = haze * sensor.distance - calibration.distance, 0.0
        if haze != 1.0 and calibration.haze:
            # What heights above sea take off the air is known to a half as well.
            less = (sensor.distance - calibration.distance) / calibration.haze - more
        within = slope * haze * sensor.distance if other and attenuation is None else 0.0
        usual = math.hypot(usual, slope * math.hypot(more, less), within)
        ratio = sensor.distance / calibration.distance
        if max(ratio, 1 / ratio) > FAR:
            lines.append(
                f"calibration: measured at {calibration.distance:.0f} m, this strip is {sensor.distance:.0f} m away: "
                f"the air adds {100 * usual:.1f} % to the error of the constant"
            )
    name = settings.read_sensor_name(reader.facts)
    if calibration.sensor and name and name != calibration.sensor:
        lines.append(
            f"calibration: measured with sensor {calibration.sensor!r}, the header of this strip names {name!r}; "
            "bits, spacing, gain and pulse agree"
        )
    software = decode_text(reader.facts.header.generating_software).strip()
    if calibration.software and software and software != calibration.software:
        lines.append(f"calibration: measured on a file of {calibration.software!r}, this one is of {software!r}")
    return usual, later, lines


def refuse_zone(calibration: Calibration, found: settings.Setting, distance: float | None, path: Path) -> None:
    """Raise InputError where light is as much darker or brighter than the calibration's as in a wrong pulse zone, and
    the ground's bend does not speak against it: narrow swaths and hills do not show the zone alone."""
    zone = found.zone
    if zone is None or not distance or abs(zone.off) + 2.0 * zone.error < 0.5 * zone.size:
        return
    for row, number in itertools.product(calibration.channels, range(-settings.MOST_ZONES, settings.MOST_ZONES + 1)):
        scene, off = found.scenes.get((row.digitizer, row.scanner), ()), number * zone.size
        if not number or distance + off <= 0.0 or not scene or len(row.scene) != len(scene):
            continue
        light = -2.0 * math.log1p(off / distance) - 2.0e-4 * math.log(10.0) * calibration.attenuation * off
        seen = float(np.median(np.subtract(scene, row.scene)))
        if abs(light) > OTHER_RANGE and abs(seen - light) < LIKE_RANGE:
            raise InputError(
                f"{path}: --calibration: its light is {math.exp(seen):.2g} times that of the calibration, as if all "
                f"ranges were {abs(off):.0f} m too {'short' if off > 0 else 'long'}, {abs(number)} x the way between "
                f"two pulses: {settings.OTHER_PULSE}, or calibrate this strip if its gain is another"
            )


def compare_setting(
    calibration: Calibration,
    found: settings.Setting,
    system: SystemPulse,
    usual: float = 0.0,
    energy: float | None = None,
) -> tuple[float, list[str], list[str]]:
    """Error that another pulse rate, gain or air adds to the constant, relative, the warnings, and what would not show.

    usual: what `find_growth` knows of air and day; ground in common shows it, too. energy: what a log says of the
    laser, over the calibration's; the light may say that the laser is as it was, and the log of another scale: half as
    often, before it is seen, as a gain or energy changes.
    """
    growth, lines, notes = 0.0, [], []
    unseen = usual

    def compare(value: float | None, known: float | None, most: float, share: float, line: str) -> None:
        nonlocal growth
        off = abs(math.log(value / known)) if value and known else 0.0
        if off > math.log(most):
            growth = max(growth, share * off)
            lines.append(f"calibration: {line} {value:.4g}, where the calibration has {known:.4g}")

    shown = True
    for row in calibration.channels:
        noise, which = system.digitizers.get(row.digitizer, system).noise.std, f"of digitizer {row.digitizer}"
        which += f" scanner channel {row.scanner}" if row.scanner else ""
        louder = math.log(noise / row.noise_dn) if noise and row.noise_dn else None
        ground = _compare_places(calibration, found, row, louder, usual)
        shown &= ground is not None
        scene = found.scenes.get((row.digitizer, row.scanner)) or ()
        alike, change = ("ground in common is", ground[0]) if ground else ("scenes are", settings.NO_CHANGE)
        chance, shows = calibration.change_chance, ground is not None or 0 < len(row.scene) == len(scene)
        if shows and ground is None:
            change = settings.compare_scenes(scene, row.scene, louder, chance=chance, usual=usual)
        if ground is None:
            compare(noise, row.noise_dn, OTHER_NOISE, 1.0, f"another gain, or other sunlight: noise {which} is [DN]")
        if ground is None and (not shows or change.chance > settings.LIKELY):
            # Other surfaces explain it as well as another gain: half of the square of what a gain would be.
            light = found.brightest.get((row.digitizer, row.scanner))
            surfaces = "other surfaces"
            if light and row.brightest and abs(math.log(light / row.brightest * FOOT**2)) < LIKE_FEET:
                surfaces += ", or coordinates in feet (which make it 10.8 times as bright)"
            compare(light, row.brightest, OTHER_LIGHT, 0.5**0.5, f"another gain, or {surfaces}: light {which} is")
        if not shows:
            continue
        # What common ground shows is in the error, whatever changed it, with half of what it is uncertain: 68 % of the
        # changes that may have made it are smaller. So is all of what other scenes show, where surfaces mostly do less.
        seen = bool(ground or change.chance > settings.LIKELY or abs(change.shift) > change.spread and chance)
        more = math.expm1(max(change.error, (abs(change.shift) + 0.5 * change.spread * bool(ground)) * seen))
        growth, unseen = max(growth, more), 0.0
        step = math.log(energy or 1.0)
        right, wrong = (-0.5 * ((change.shift + off) / math.hypot(change.spread, usual)) ** 2 for off in (0.0, step))
        doubt = 1.0 / (1.0 + (2.0 - chance) / max(chance, 1e-9) * math.exp(min(right - wrong, 100.0)))
        most = abs(math.expm1(step + math.copysign(settings.SAME_GROUND, step)))
        scale = most * min(doubt / settings.LIKELY, 1.0) ** 0.5 if step else 0.0
        growth = max(growth, scale)
        if doubt > settings.LIKELY and scale > HIDDEN:
            lines.append(
                f"calibration: the log of the energies says {100 * math.expm1(step):+.0f} % against the calibration's, "
                f"the light {which} that nothing changed: is it of another scale? Then give energy_mean in CAL.toml in "
                "that scale, or --energy none"
            )
        elif change.chance <= settings.LIKELY and more > HIDDEN:
            brighter = f"{100 * math.expm1(change.shift):+.0f} % brighter"
            known = f"surfaces {which} are {brighter}, none is common"
            if ground:
                known = f"ground in common {which} is {brighter}, which its scatter and moisture may do"
            notes.append(
                f"calibration: {known}, so that another energy under the same header, or other air, would not show: "
                f"{100 * more:.0f} % of error hold it, by an assumed chance of {chance:.0%} (change_chance); calibrate "
                "a strip that overlaps this one"
            )
        elif change.chance > settings.LIKELY:
            lines.append(
                f"calibration: another gain or energy under the same header, or haze: all echoes {which} are brighter "
                f"by a factor of {math.exp(change.shift):.2f}, "
                + ("and noise with them" if abs(louder or 0.0) > settings.SUNLIGHT else f"though {alike} alike")
            )
    # Where points are thinned pulses follow later; ground in common shows whether they have another energy.
    if not shown or (found.rate or 0.0) > (calibration.rate or 0.0):
        compare(found.rate, calibration.rate, SAME_RATE, 1.0, "another rate of pulses [1/s], so another energy:")
    growth = math.hypot(growth, unseen)
    return growth, [f"{line}: the error of the constant grows by {100 * growth:.0f} %" for line in lines], notes


def _compare_places(
    calibration: Calibration,
    found: settings.Setting,
    row: ChannelConstant,
    noise: float | None = None,
    usual: float = 0.0,
) -> tuple[settings.Change, settings.Change | None, settings.Change] | None:
    known = np.reshape(calibration.places[: len(calibration.places) // 4 * 4], (-1, 4))
    seen = found.places.get((row.digitizer, row.scanner), np.empty((5, 0)))
    mine = known[known[:, 0] == settings.number_channel(row.digitizer, row.scanner), 1:]
    return settings.compare_ground(seen, mine, noise, chance=calibration.change_chance, usual=usual)


def judge_fading(
    calibration: Calibration, found: settings.Setting, *, other: bool
) -> tuple[float, list[str], list[str]]:
    """Error of the constant by light that changes along the strip, relative, the warnings, and what would not show.

    other: a strip that was not calibrated, so that ground in common shows it. Of strips that were calibrated together
    their overlaps do.
    """
    fades, hidden = found.fades, "surfaces in large patches hide"
    compared = [_compare_places(calibration, found, row) for row in calibration.channels if other]
    # One laser that fades is enough.
    seen = max((ground[1] for ground in compared if ground and ground[1]), key=lambda one: one[1:3], default=fades)
    if fades.is_uneven:
        growth = math.expm1(max(fades.error, abs(fades.shift)))
        return growth, [
            f"calibration: one of the flight lines in this file is {100 * growth:.0f} % brighter or darker than the "
            "others, over ground that they share: another energy or gain, or wet ground? The error of the constant "
            "grows by it; run each line alone"
        ], []
    if seen.spread < fades.spread:
        fades, hidden = seen, "the scatter of the ground in common hides"
    if fades.chance > settings.LIKELY and fades.is_uneven:
        growth = math.expm1(abs(fades.shift))
        return growth, [
            f"calibration: over ground in common light changes along the strip, not evenly, by {100 * growth:.0f} % "
            "(root mean square): a laser that warms up, or fails for a time, or haze? The error of the constant grows "
            "by it; calibrate shorter strips"
        ], []
    if fades.chance > settings.LIKELY:
        growth = math.expm1(FROM_START * abs(fades.shift))
        return growth, [
            f"calibration: the second half of the strip is {100 * math.expm1(fades.shift):+.0f} % brighter, though "
            "both are like one scene: a laser that fades, or haze? The error of the constant grows by "
            f"{100 * growth:.0f} %; calibrate shorter strips"
        ], []
    growth = math.expm1(FROM_START * fades.error)
    if growth < HIDDEN or not other and len(calibration.strips) > 1:
        return 0.0, [], []
    return growth, [], [
        f"calibration: {hidden} whether the laser fades along the strip: {100 * growth:.0f} % of error hold it; "
        "calibrate strips that overlap this one"
    ]


def judge_sides(
    calibration: Calibration, found: settings.Setting, *, other: bool
) -> tuple[float, list[str], list[str]]:
    """Error of the constant by light that is uneven across the swath, relative, the warnings, and what would not show.

    Overlaps of strips that were calibrated together show it themselves, where they saw places at several angles; ground
    in common shows it for a strip that was not (other).
    """
    sides = found.sides
    compared = [_compare_places(calibration, found, row) for row in calibration.channels if other]
    across = max((ground[2] for ground in compared if ground), key=lambda one: one.chance, default=settings.NO_CHANGE)
    # One part of the swath that is off is a roof or a tree.
    if across.chance > settings.LIKELY and across.shift > HIDDEN and not calibration.swath:
        growth = math.expm1(across.shift)
        return growth, [
            f"calibration: over ground in common light changes across the swath, by up to {100 * growth:.0f} % for two "
            "thirds of it: a dirty window, surfaces that are not matt, or two lasers that take turns in step with the "
            "scan lines? The error of the constant grows by it"
        ], []
    if not calibration.conditions.endswith(ONE_VIEW) or calibration.swath:
        return 0.0, [], []
    seen = [one.chance > settings.LIKELY for one in sides]
    error = math.hypot(*(abs(one.shift) if named else one.error for one, named in zip(sides, seen, strict=True)))
    growth, remedy = math.expm1(ANYWHERE * error), "calibrate strips of several headings with --scan-angle"
    lines = [
        f"calibration: light falls {way} by {100 * -math.expm1(-abs(one.shift)):.0f} %, as behind a dirty window, or "
        f"where surfaces are not matt: {100 * growth:.0f} % of error of the constant hold it; {remedy}"
        for one, named, way in zip(sides, seen, SIDES, strict=False)
        if named
    ]
    hidden = (
        "calibration: surfaces hide whether light is even across the swath: "
        f"{100 * growth:.0f} % of error hold it, by an assumed chance (change_chance); {remedy}"
    )
    return growth, lines, [hidden] if growth > HIDDEN and not lines else []


OTHER_WIDTH, NEAR_WIDTH = 1.25, 1.03
"""Ratios of the pulse widths of calibration and strip: above the first it is another pulse, above the second it may be
one, and the error grows by the difference. Surveys of a sensor's strips agree within 2 % where ground is not steep."""

SAME = 1e-3
"""Relative difference up to which spacings and gains are equal: headers round them."""

_CHAIN_SAMPLE = 2048
"""Waveforms on which two chains are compared."""

_LEAST_SHARED = 50
"""Echoes that both chains must have for a comparison."""


def match_strip(
    calibration: Calibration,
    reader: StripReader,
    scan: StripScan,
    system: SystemPulse,
    sensor: SensorSource,
    chain: Chain | None = None,
    attenuation: float | None = None,
    energy: float | None = None,
) -> tuple[Calibration, tuple[str, ...]]:
    """Fit a calibration to a strip.

    Parameters
    ----------
    calibration : Calibration
    reader : StripReader
    scan : StripScan
    system : SystemPulse
        Of the strip's own survey.
    sensor : SensorSource
    chain : Chain, optional
        That the strip runs with.
    attenuation : float, optional
        Of the air [dB/km], where it is not that of the calibration.
    energy : float, optional
        Mean of its pulses over that of the calibration, where it is known.

    Returns
    -------
    fitted : Calibration
        With the constants of the strip's channels; its common constant is NaN where the channels are known.
    warnings : tuple of str
        One line each.

    Raises
    ------
    InputError
        Where none of the strip's channels has a constant, with the reasons.

    Notes
    -----
    docs/algorithms.md 5.2.
    """
    warnings: list[str] = []
    described = any(row.is_described for row in calibration.channels)
    if not described:
        warnings.append(
            "calibration: the file does not say which sensor it was measured with (an earlier version wrote it), so "
            "it cannot be compared with this strip; measure it again with `wavebatch calibrate`"
        )
    if not min([calibration.relative_error, *(row.relative_error for row in calibration.channels)]):
        warnings.append(
            f"calibration: its relative_error is 0, but no constant is known exactly: {UNSTATED:.0%} is taken; put the "
            "error of the targets into the file"
        )
        calibration = calibration.widened(UNSTATED)
    if not described:
        return calibration, tuple(warnings)
    if calibration.haze and attenuation is None:
        calibration = replace(calibration, attenuation=calibration.attenuation / calibration.haze * sensor.haze)
    own_strip = take_fingerprint(reader.facts.path, reader.facts.packets.file)["sha256_sampled"]
    # A strip that was calibrated has its own constants.
    own = {(row.digitizer, row.scanner): row for row in calibration.strips if row.sha256 == own_strip}
    rows = [(row, own.get((row.digitizer, row.scanner))) for row in calibration.channels]
    calibration = replace(calibration, channels=tuple(
        replace(row, constant=one.constant, relative_error=one.relative_error) if one else row for row, one in rows
    ))  # fmt: skip
    chance = calibration.change_chance
    setting = settings.measure_setting(reader, scan, sensor, calibration.attenuation, energy or 1.0, chance=chance)
    refuse_zone(calibration, setting, sensor.distance, reader.facts.path)
    if calibration.swath:
        settings.refuse_headings(reader, setting)
    notes: list[str] = []
    measured = {calibration.fingerprint.get("sha256_sampled"), *(row.sha256 for row in calibration.strips)}
    other = own_strip not in measured
    growth, later, reasons = find_growth(calibration, reader, sensor, attenuation, other=other)
    if other:
        more, lines, notes = compare_setting(calibration, setting, system, growth, energy)
        # Ground of another day may have changed as well: it proves no air.
        growth, reasons = math.hypot(more, growth * later), [*reasons, *lines]
        if not (calibration.flight and settings.read_day(reader)):
            which = "the calibration" if not calibration.flight else "this strip"
            notes.append(
                f"calibration: the day of {which} is not known (GPS times that are seconds of a week show none): it "
                "counts as the same day; lasers, receivers and air of another day would add to the error"
            )
    if energy is None:
        more, lines, hidden = judge_fading(calibration, setting, other=other)
        # Light that is seen to fade from the calibrated level on also moves the mean, which the first error holds.
        growth = max(growth, more) if lines else math.hypot(growth, more)
        reasons, notes = [*reasons, *lines], [*notes, *hidden]
    more, lines, hidden = judge_sides(calibration, setting, other=other)
    growth, reasons, notes = math.hypot(growth, more), [*reasons, *lines], [*notes, *hidden]
    warnings += reasons
    beam, divergence = system.radiometry.divergence, calibration.divergence
    if beam is not None and divergence is not None and abs(beam / divergence - 1.0) > SAME_DIVERGENCE:
        warnings.append(
            f"calibration: measured with a divergence of {divergence:g} mrad, the survey has {beam:g} mrad, which is "
            f"used: one of the two makes cross sections {100 * abs((beam / divergence) ** 2 - 1):.0f} % wrong"
        )
    growth = math.hypot(growth, _compare_decomposers(calibration, reader, scan, system, chain, warnings))
    fitting: list[ChannelConstant] = []
    missing: dict[int, str] = {}
    # Widths at half maximum of the pulses of all digitizers that have one of their own, and of the others as 0 [ns].
    # A hillside widens every echo, so that the survey of its strip finds a wider pulse than the sensor has: where a
    # pulse is wider than the calibration's, what the slopes of the strip's surfaces add to it is taken off.
    systems = {0: system, **system.digitizers}
    known = [row.pulse_ns for row in calibration.channels if row.pulse_ns]
    divergence = system.radiometry.divergence or calibration.divergence
    widest = max(one.sigma_ref for one in systems.values()) * FWHM_PER_SIGMA
    if known and divergence and widest > NEAR_WIDTH * min(known):
        main = max(scan.by_descriptor, key=lambda index: (index not in system.digitizers, scan.by_descriptor[index]))
        spacing = reader.facts.digitizers[main].spacing
        face = sample_reference(reader, scan, sensor, system.with_radiometry(divergence=divergence), spacing).system
        systems = {0: face, **face.digitizers}
    pulses = {
        index: FWHM_PER_SIGMA * math.sqrt(max(one.sigma_ref**2 + one.widths.variance, 0.0))
        for index, one in systems.items()
    }
    for index in sorted(scan.by_descriptor):
        pulse = pulses.get(index, pulses[0])
        found, missing[index] = _match_digitizer(calibration, reader.facts.digitizers[index], pulse, warnings)
        fitting += found
    have, seen = {(row.digitizer, row.scanner) for row in fitting}, settings.see_channels(reader, scan)
    problems: dict[str, dict[int, float]] = {}  # share of the waveforms by digitizer, for each reason
    for (index, scanner), share in seen.items():
        if (index, scanner) not in have:
            shares = problems.setdefault(missing[index] or f"was not calibrated on scanner channel {scanner}", {})
            shares[index] = shares.get(index, 0.0) + share
    named: dict[str, float] = {}
    for problem, shares in problems.items():
        which = name_first([f"digitizer {index}" for index in sorted(shares)])
        named[f"{which} {problem}"] = sum(shares.values())
    if not have & seen.keys():
        raise InputError(
            f"{reader.facts.path}: --calibration: none of the strip's channels is calibrated: {'; '.join(named)}; "
            "measure this sensor with `wavebatch calibrate`"
        )
    warnings += [
        f"calibration: no calibrated values for {share:.0%} of the waveforms: {line}" for line, share in named.items()
    ]
    fitting = [replace(row, relative_error=math.hypot(row.relative_error, growth)) for row in fitting]
    air = 0.0
    if attenuation is not None and sensor.distance and not later:
        # A strip of the calibration's day that is given other air than the calibration had.
        off = 2.0e-4 * math.log(10.0) * sensor.distance * (attenuation - calibration.attenuation)
        if abs(off) >= LEAST_AIR:
            air = abs(off)
            warnings.append(
                f"calibration: --attenuation {attenuation:g} dB/km contradicts the {calibration.attenuation:.2g} dB/km "
                "with which the constant was measured on the same day: light changes by "
                f"{100 * math.expm1(off):+.0f} %, which is in the error; give `wavebatch calibrate` the same "
                "--attenuation"
            )
    fitted = replace(
        calibration, right=setting.right, constant=math.nan, channels=tuple(fitting), strips=(), notes=tuple(notes)
    )
    return fitted.widened(air), tuple(dict.fromkeys(warnings))


def _match_digitizer(
    calibration: Calibration, digitizer: Digitizer, pulse: float, warnings: list[str]
) -> tuple[list[ChannelConstant], str]:
    """Constants of all scanner channels of a digitizer, or why there is none; pulse: width at half maximum [ns]."""
    known = [row for row in calibration.channels if row.is_described]
    reason = ""
    fitting = []
    for row in known:
        contradiction = _contradict(row, digitizer, pulse)
        if not contradiction:
            fitting.append(row)
        elif not reason or row.digitizer == digitizer.index:
            reason = contradiction
    if not fitting:
        return [], reason
    exact = [row for row in fitting if row.digitizer == digitizer.index]
    found = exact or _pool_lengths(fitting, digitizer)
    if not found:
        numbers = ", ".join(sorted({str(row.digitizer) for row in fitting}, key=int))
        return [], f"was not calibrated, only {numbers}, which may have another gain"
    ratio = pulse / (found[0].pulse_ns or pulse)
    if max(ratio, 1 / ratio) > NEAR_WIDTH:
        warnings.append(
            f"calibration: the pulse of this strip is {pulse:.3g} ns wide, that of the calibration "
            f"{found[0].pulse_ns:.3g} ns: the error of the constant grows by {100 * abs(math.log(ratio)):.0f} %"
        )
        found = [replace(row, relative_error=math.hypot(row.relative_error, math.log(ratio))) for row in found]
    return found, ""


def _contradict(row: ChannelConstant, digitizer: Digitizer, pulse: float) -> str:
    """What a digitizer has that excludes a channel's constant; empty where nothing does. Unknowns are not checked."""
    if row.bits is not None and row.bits != digitizer.bits:
        return f"has {digitizer.bits} bits, the calibration {row.bits}"
    for name, unit, own, other in (
        ("spacing", "ns", digitizer.spacing, row.spacing_ns),
        ("gain", "V per count", digitizer.gain, row.gain),
    ):
        if other is not None and abs(own - other) > SAME * max(abs(own), abs(other)):
            return f"has a {name} of {own:g} {unit}, the calibration {other:g}"
    ratio = pulse / (row.pulse_ns or pulse)
    if max(ratio, 1 / ratio) > OTHER_WIDTH:
        slopes = " (if slopes widen it, put divergence_mrad of the data sheet into CAL.toml)" if ratio > 1 else ""
        return f"has a pulse of {pulse:.3g} ns, the calibration one of {row.pulse_ns:.3g} ns{slopes}"
    return ""


def _pool_lengths(rows: list[ChannelConstant], digitizer: Digitizer) -> list[ChannelConstant]:
    """Constants for a descriptor that differs from all calibrated ones in the number of samples only.

    Some sensors have a descriptor per packet length for one and the same digitizer. A descriptor of the same length is
    another channel: its gain is not known.
    """
    if any(row.samples in (None, digitizer.n_samples) for row in rows):
        return []
    pooled = []
    for scanner in sorted({row.scanner for row in rows}):
        some = [row for row in rows if row.scanner == scanner]
        constants = np.array([row.constant for row in some])
        apart = float(np.std(constants) / constants.mean())
        error = math.hypot(max(row.relative_error for row in some), apart)
        pooled.append(
            replace(some[0], digitizer=digitizer.index, constant=float(constants.mean()), relative_error=error)
        )
    return pooled


def _compare_decomposers(
    calibration: Calibration,
    reader: StripReader,
    scan: StripScan,
    system: SystemPulse,
    chain: Chain | None,
    warnings: list[str],
) -> float:
    """By how much energies of the strip's chain differ from those of the calibration's, relative; 0 for one chain."""
    own = None if chain is None else chain.decomposer.stage.name
    other = STAGES.get(calibration.decomposer)
    if chain is None or other is None or own == calibration.decomposer:
        return 0.0
    steps = chain.steps[:3] + (Step(STAGES["attribute.energy"]),)
    pair = (Chain(steps), Chain((*steps[:2], Step(other), steps[3])))
    ratios = [np.empty(0)]
    for block in reader.sample_blocks(scan, _CHAIN_SAMPLE):
        # Energies of clean single echoes by the strip's chain over those by the calibration's.
        found = []
        for one in pair:
            echoes = one.run(block, system)
            clean = echoes.alone(len(block)) & ((echoes.flags & np.uint16(UNCLEAN)) == 0)
            energy = np.full(len(block), np.nan)
            energy[echoes.waveform[clean]] = echoes.attributes["energy"][clean]
            found.append(energy)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = found[0] / found[1]
        ratios.append(ratio[np.isfinite(ratio)])
    ratio = np.concatenate(ratios)
    off = float(np.median(ratio)) - 1.0 if len(ratio) >= _LEAST_SHARED else 0.0
    if abs(off) > 0.002:
        warnings.append(
            f"calibration: measured with {calibration.decomposer}, this strip runs {own}, whose energies are "
            f"{100 * off:+.1f} % off: the error of the constant grows by that; calibrate with the same --chain or "
            "--profile"
        )
    return abs(off)
