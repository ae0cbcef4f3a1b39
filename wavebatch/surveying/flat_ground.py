"""How wide the echo of a surface is that faces the sensor: the reference against which widths of slopes are compared.

A survey assumes that the narrowest echoes are those of level ground seen from above. Few are: across a swath, rays hit
level ground at up to half the field of view, and a hillside has no level ground. A reference 1 % too wide turns 5
degrees into 2. So echoes are used whose surface is known from the points around them, whatever its slope: what the
slope adds to the width is taken off. The same echoes show the beam's divergence, where their surfaces differ in angle
(docs/algorithms.md 1.4).

`predict_angles` says whether the echo widths of a sensor can measure slopes at all: the error to expect, with the
numbers it comes from. `wavebatch survey --divergence` asks before a run, the report of a run asks afterwards. Before
you change it: stage attribute.incidence_angle must use the same limits, or predictions and columns disagree.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from wavebatch.core.echoes import REASONS, NoData
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import even_places, median, quantile
from wavebatch.core.units import LEAST_PULSE_WIDTH, SQUARED_NORMAL_MEDIAN, C, format_measure
from wavebatch.core.waveforms import LevelWidths, SystemPulse, WaveformBlock
from wavebatch.files.las.header import locate
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.geometry.normals import Surroundings, measure_normals, thin_out
from wavebatch.kernels.geometry.planes import in_two_lines
from wavebatch.kernels.physics.incidence import angle_of_spread, angles_of_variance, spread_of_angle
from wavebatch.stages.attribute.basic import added_variance
from wavebatch.stages.chain import Chain
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, find_single, spread_rows
from wavebatch.surveying.measuring.residuals import decompose_sample
from wavebatch.surveying.sensor import SensorRequest, SensorSource, find_sensor
from wavebatch.surveying.systems.survey_result import Decision, Part, Survey

ROUNDS = 10
"""Steps from the mode of the variances to the mean around it."""

SAMPLED_UNITS, OF_SAMPLE = 4, 2
"""Units of a strip whose points are read to find planes, and part of a survey's waveforms that is looked at: already
1,000 echoes of slopes tell a divergence to less than LEAST_DIVERGENCE_ERROR, and planes take most of the time."""

LEAST_NEIGHBOURS = 8
"""Points of a plane, as by default in stage attribute.incidence_angle_normals."""

WIDER = 0.5
"""Steps in which the radius grows until neighbourhoods hold a third scan line [m]."""

RADII = (1.5, 12.0)
"""Least and largest radius of a neighbourhood that is chosen by the distance between points [m]."""

LARGEST_ANGLE, LARGEST_ERROR = np.radians(50.0), 3.0
"""Surfaces struck at a larger angle [rad], or known less well [deg], say little about the reference."""

ENOUGH_SLOPES = 1000
"""Points whose surface is looked at for the slopes of a strip."""

GROUPS = 12
"""Groups of echoes by angle, through whose median widths the first line for the divergence goes."""

PROBED = 256
"""Waveforms that are asked for a known slope before any is decomposed: at least one in 34 must have one."""

LEAST_DIVERGENCE_ERROR = 0.03
"""Relative error of a divergence from widths at best: rough ground widens echoes too, by a little. It holds where
surfaces are plane over a footprint and several points: on two real strips (.5 mrad) the widths gave .563 and .375."""

LARGEST_DIVERGENCE_ERROR = 0.25
"""A divergence that is known less well than this is not given."""


class Slopes(NamedTuple):
    """Sampled waveforms, and the angles at which their rays strike the surface around the return."""

    block: WaveformBlock
    """With the sensor's positions."""
    place: np.ndarray
    """Of the last return of each waveform, f8 (n, 3) [m]; NaN without any."""
    measure: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Angles and their standard deviations [rad] at places, by the rays' directions (m, 3); NaN where the points around
    form no plane. One for all waveforms of a unit. It takes longer than to find which echoes can use it."""


@frozen
class GroundReference:
    """What echoes of surfaces of known slope show."""

    system: SystemPulse
    """With its `widths`."""
    echoes: int
    """Clean single echoes whose surface is known."""
    divergence: float | None = None
    """Of the beam by the widths over the angles [mrad]; None where they do not tell."""
    divergence_error: float = 0.0
    """Its relative standard deviation."""

    def doubt(self) -> str:
        """Return a sentence where the system's divergence contradicts the widths; empty where it does not."""
        given = self.system.radiometry.divergence
        if given is None or self.divergence is None:
            return ""
        if abs(given / self.divergence - 1.0) < 3.0 * self.divergence_error:
            return ""
        return (
            f"a beam of {given:g} mrad contradicts the echo widths, which grow with the slopes of surfaces as those of "
            f"a beam of {format_measure(self.divergence, self.divergence * self.divergence_error)} mrad do: "
            "cross sections and angles are wrong unless the surfaces are rough; check divergence_mrad"
        )

    def doubt_error(self) -> float | None:
        """Relative error of the system's divergence where the widths contradict it; None where they do not."""
        given = self.system.radiometry.divergence
        if not given or not self.divergence or not self.doubt():
            return None
        # Cross sections go with the square, so that a beam twice as wide makes them four times as large, not three.
        ratio = self.divergence / given
        ratio *= 1.0 + math.copysign(self.divergence_error, ratio - 1.0)
        return abs(ratio - 1.0) * max(1.0, 0.5 * (ratio + 1.0))


def measure_slope(reader: StripReader, scan: StripScan) -> float:
    """Measure how steep the surfaces of a strip are.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan

    Returns
    -------
    float
        Slope [deg] that 84 % of the sampled planes in the middle of the strip do not exceed; 0 where there are too few.
    """
    xyz = read_middle(reader, scan)
    if len(xyz) < ENOUGH_TO_LEARN:
        return 0.0
    some, radius = xyz[:: max(len(xyz) // ENOUGH_SLOPES, 1)], choose_radius(xyz)
    (slope, _), _ = measure_normals(
        some, np.tile([0.0, 0.0, -1.0], (len(some), 1)), Surroundings(xyz[thin_out(xyz, np.arange(len(xyz)), radius)]),
        radius=radius, min_points=LEAST_NEIGHBOURS, max_error=LARGEST_ERROR,
    )  # fmt: skip
    known = slope[np.isfinite(slope)]
    return quantile(known, 0.84) if len(known) >= ENOUGH_TO_LEARN else 0.0


def read_middle(reader: StripReader, scan: StripScan) -> np.ndarray:
    """Places of the points in the middle of a strip, as `_list_places` has them."""
    units = reader.unit_count()
    return _list_places(reader, reader.read_unit(units // 2, scan)) if units else np.empty((0, 3))


def _list_places(reader: StripReader, unit: Unit) -> np.ndarray:
    """Finite positions of the points of a unit [m], f8 (n, 3)."""
    xyz = locate(unit.points, reader.facts.header)
    return xyz[np.isfinite(xyz).all(axis=1)]


def choose_radius(xyz: np.ndarray) -> float:
    """Choose the radius of neighbourhoods by the distance between points.

    Parameters
    ----------
    xyz : float64 (n, 3), m
        From `read_middle`.

    Returns
    -------
    float
        Radius [m] in which nine tenths of the points have half more than LEAST_NEIGHBOURS, and these lie on more than
        two scan lines; at least 1.5, at most 12.
    """
    number = LEAST_NEIGHBOURS * 3 // 2
    if len(xyz) <= number:
        return RADII[0]
    some, around = xyz[:: max(len(xyz) // 500, 1)], Surroundings(xyz, 2 * RADII[0])
    # Distance within which nine tenths of some points have so many points, with themselves; far beyond `reach` where
    # that is not enough.
    reach, needed = 0.5 * RADII[0], np.inf
    while needed > reach and reach < RADII[1]:
        reach = min(2 * reach, RADII[1])
        point, offset = around.find(some, reach)
        x, y, z = offset.T
        square = x * x + y * y + z * z
        order = np.argsort(square)
        # There are at most 1,000 points.
        square = square[order[np.argsort(point[order].astype(np.int16), kind="stable")]]
        last = np.searchsorted(point, np.arange(len(some))) + number - 1
        near = np.bincount(point, minlength=len(some)) >= number
        distance = np.full(len(some), 1e9)
        distance[near] = np.sqrt(square[last[near]])
        needed = quantile(distance, 0.9)
    first = float(np.clip(np.ceil(10.0 * needed) / 10.0, *RADII))
    radii = [*np.arange(first, RADII[1], WIDER).round(1).tolist(), RADII[1]]

    def is_enough(radius: float) -> bool:
        """Whether few points have all neighbours on two scan lines, seen from above: those have no angle."""
        group, offset = around.find(some, radius)
        return bool(np.mean(in_two_lines(offset[:, 0], offset[:, 1], group, len(some))) <= 0.1)

    # The first nearly always is; the wider ones are halved: neighbours take longest there. Where wider ones hold fewer
    # lines, which hardly happens, the radius is one that is enough, though not the least.
    least = 0 if len(radii) == 1 or is_enough(first) else 1
    return radii[least and bisect_left(radii, True, 1, len(radii) - 1, key=is_enough)]


def sample_slopes(reader: StripReader, scan: StripScan, fill: SensorSource, n_waveforms: int) -> Iterator[Slopes]:
    """Yield waveforms spread over a strip with the slopes of the surfaces that they hit.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    fill : SensorSource
        Positions of the sensor.
    n_waveforms : int
        About so many.

    Yields
    ------
    Slopes
    """
    chosen, radius = even_places(reader.unit_count(), SAMPLED_UNITS).tolist(), 0.0
    for number in chosen:
        unit = reader.read_unit(number, scan)
        rows = np.flatnonzero(unit.packets.owned)
        rows = rows[:: max(len(rows) * len(chosen) // max(n_waveforms, 1), 1)]
        xyz = _list_places(reader, unit)
        radius = radius or choose_radius(xyz)  # one for all, as a run has it
        around = Surroundings(xyz[thin_out(xyz, np.arange(len(xyz)), radius)])
        measure = partial(_measure_angles, around, radius)
        for block, _ in reader.read_rows(unit, rows, 4096):
            block = fill.fill(block)
            place = np.full((len(block), 3), np.nan)
            if block.returns is not None:
                place[block.returns.waveform] = block.returns.xyz
            yield Slopes(block, place, measure)


def _measure_angles(
    around: Surroundings, radius: float, place: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Angles between rays and surfaces around places, as `Slopes` has them."""
    (angle, error), _ = measure_normals(
        place, direction, around, radius=radius, min_points=LEAST_NEIGHBOURS, max_error=LARGEST_ERROR
    )
    return np.radians(angle.astype(np.float64)), np.radians(error.astype(np.float64))


def measure_reference(samples: Iterable[Slopes], system: SystemPulse, spacing: float) -> GroundReference:
    """Measure variance and scatter of the widths of surfaces that face the sensor, and the beam's divergence.

    Parameters
    ----------
    samples : iterable of Slopes
        Sampled over the strip.
    system : SystemPulse
        With the beam's divergence, where it is known.
    spacing : float
        Of the samples of the main digitizer [ns]; other digitizers have pulses of their own in `system.digitizers`.

    Returns
    -------
    Reference
        `widths.error` is infinite where fewer than 50 clean echoes of surfaces of known slope are found: widths then
        give no angle. Without a divergence the system stays as it is.
    """
    parts: dict[int | None, list[np.ndarray]] = {}
    samples = list(samples)
    if system.radiometry.divergence is None:
        # Without any known slope, nothing is decomposed: some waveforms of each sample tell.
        share = max(sum(len(one.block) for one in samples) / PROBED, 1.0)
        probed: dict[Callable, list[tuple[np.ndarray, np.ndarray]]] = {}
        for one in samples:
            own = spread_rows(len(one.block), math.ceil(len(one.block) / share))
            probed.setdefault(one.measure, []).append((one.place[own], one.block.direction[own]))
        units = ((measure, map(np.concatenate, zip(*parts, strict=True))) for measure, parts in probed.items())
        if not any(np.isfinite(measure(*rays)[0]).any() for measure, rays in units):
            return GroundReference(system, 0)
    for sample in samples:
        block, index = sample.block, sample.block.digitizer.index
        if block.sensor is None or (index not in system.digitizers and block.spacing != spacing):
            continue
        parts.setdefault(index if index in system.digitizers else None, []).append(_measure(sample, system))
    found = {index: np.concatenate(rows, axis=1) for index, rows in parts.items()}
    others = {
        index: _refer(replace(other, radiometry=system.radiometry), found.get(index, np.empty((4, 0))))
        for index, other in system.digitizers.items()
    }
    main = found.get(None, np.empty((4, 0)))
    return GroundReference(replace(_refer(system, main), digitizers=others), main.shape[1], *_fit_divergence(*main))


def _refer(system: SystemPulse, rows: np.ndarray) -> SystemPulse:
    """The system of one digitizer with the reference from echoes (4, n): see `_measure`."""
    if system.radiometry.divergence is None:
        return system
    variance, error, lever, lever_err = rows
    square = (1e-3 * system.radiometry.divergence) ** 2
    variance, error = variance - square * lever, np.hypot(error, square * lever_err)
    if len(variance) < ENOUGH_TO_LEARN:
        return replace(system, widths=replace(system.widths, error=np.inf))
    # The survey's pulse may include slopes, so the true one can be narrower, but never wider.
    # Centre of the shortest interval that holds a third of the values, which slopes and plants do not move.
    ordered = np.sort(variance.astype(np.float64))
    hold = max(len(ordered) // 3, 2)
    span = ordered[hold - 1 :] - ordered[: len(ordered) - hold + 1]
    first = int(np.argmin(span))
    level, level_err = float(median(ordered[first : first + hold])), float(median(error))
    for _ in range(ROUNDS):
        near = np.abs(variance - level) < 2.0 * error
        if np.count_nonzero(near) < ENOUGH_TO_LEARN:
            break
        weight = error[near] ** -2.0
        level = float((weight * variance[near]).sum() / weight.sum())
        level_err = float(weight.sum() ** -0.5)
    level = min(level, 0.0)
    below = variance < level
    ratio = median(((level - variance[below]) / error[below]) ** 2) / SQUARED_NORMAL_MEDIAN if below.any() else 1.0
    excess = median(error[below] ** 2) * max(float(ratio) - 1.0, 0.0) if below.any() else 0.0
    scatter = float(np.sqrt(excess) / (2.0 * system.sigma_ref))
    level_err = float(np.hypot(level_err, 2.0 * square * median(lever) * system.radiometry.divergence_error))
    # Grass and gravel widen echoes as slopes do. Errors alone reach their double on a fortieth of the surfaces.
    rough = quantile(variance - level, 0.84)
    seen = rough > 2.0 * quantile(error, 0.84)
    return replace(system, widths=LevelWidths(level, level_err, scatter, rough if seen else None))


def _measure(sample: Slopes, system: SystemPulse) -> np.ndarray:
    """Clean echoes of surfaces of known slope, float64 (4, m).

    Variance beyond the system's and its error [ns2]; what a beam of 1 rad would add, and its error [ns2].
    """
    block = sample.block
    system = replace(system.of(block), widths=LevelWidths())
    echoes = decompose_sample(block, system, free_levels=True)
    echoes = echoes.take(np.flatnonzero(find_single(echoes, len(block), system)))
    variance, error = added_variance(block, system, echoes, "system", 0.0)
    row = echoes.waveform
    off = block.origin[row] + block.direction[row] * echoes.time[:, None] - np.asarray(block.sensor)[row]
    angle, angle_err = sample.measure(sample.place[row], block.direction[row])
    arm = 0.5 / C * np.sqrt((off * off).sum(axis=1))
    lever = (arm * np.tan(angle)) ** 2
    lever_err = 2.0 * arm * arm * np.tan(angle) / np.cos(angle) ** 2 * angle_err
    rows = np.stack([variance, error, lever, lever_err])
    return rows[:, np.isfinite(rows).all(axis=0) & (error > 0) & (angle < LARGEST_ANGLE)]


def _fit_divergence(
    variance: np.ndarray, error: np.ndarray, lever: np.ndarray, lever_err: np.ndarray
) -> tuple[float | None, float]:
    """Divergence [mrad] and its relative error from the growth of variances with the lever; None where unknown."""
    if len(variance) < GROUPS * ENOUGH_TO_LEARN // 2:
        return None, 0.0
    groups = np.array_split(np.argsort(lever, kind="stable"), GROUPS)
    middle = np.array([(median(lever[rows]), median(variance[rows])) for rows in groups])
    off = middle - middle.mean(axis=0)
    square = float((off[:, 0] * off[:, 1]).sum() / max((off[:, 0] ** 2).sum(), 1e-300))
    level = float(middle[:, 1].mean() - square * middle[:, 0].mean())
    for _ in range(ROUNDS):
        total = np.hypot(error, max(square, 0.0) * lever_err)
        left = variance - level - square * lever
        # Rough surfaces and plants only widen echoes, so that the scatter is that of the lower half.
        scatter = np.sqrt(median((left[left < 0] / total[left < 0]) ** 2) / SQUARED_NORMAL_MEDIAN)
        total = total * max(scatter, 1.0) if np.isfinite(scatter) else total
        near = np.abs(left) < 2.5 * total
        weight = np.where(near, total**-2.0, 0.0)
        mean = (weight * lever).sum() / weight.sum()
        spread = (weight * (lever - mean) ** 2).sum()
        if np.count_nonzero(near) < ENOUGH_TO_LEARN or not spread > 0:
            return None, 0.0
        square = float((weight * (lever - mean) * variance).sum() / spread)
        level = float((weight * variance).sum() / weight.sum() - square * mean)
    if square <= 0:
        return None, 0.0
    relative = float(np.hypot(0.5 * spread**-0.5 / square, LEAST_DIVERGENCE_ERROR))
    return (None, 0.0) if relative > LARGEST_DIVERGENCE_ERROR else (1e3 * float(np.sqrt(square)), relative)


SLOPE = 30.0
"""Slope at which the error is predicted [deg]: widths are most sensitive there (docs/algorithms.md 1.4)."""

REFERENCE_ERROR = 0.003
"""Error of the system pulse's width, relative: the default of stage attribute.incidence_angle."""


@frozen
class AngleOutlook:
    """How good angles from widths will be on a strip."""

    error: float
    """Standard deviation of the angle of a plane at SLOPE [deg]; inf where widths say nothing about it."""
    max_error: float
    """Largest error, for a surface that faces the sensor, with which angles are written [deg]."""
    reason: str
    """The numbers as a sentence."""
    facing: float = np.inf
    """Standard deviation of the angle of a surface that faces the sensor [deg]: it decides what is written."""

    @property
    def possible(self) -> bool:
        """Whether angles would be written."""
        return self.facing <= self.max_error


def angle_parameters(chain: Chain) -> dict[str, Any] | None:
    """Return the parameters of a chain's last stage attribute.incidence_angle; None where it has none."""
    steps = [step for step in chain.steps if step.stage.name == "attribute.incidence_angle"]
    return steps[-1].effective() if steps else None


def predict_angles(
    system: SystemPulse, spacing: float, distance: float, divergence: float, amplitude: float, max_error: float = 10.0
) -> AngleOutlook:
    """Predict the error of angles from widths for echoes of a typical amplitude.

    Parameters
    ----------
    system : SystemPulse
    spacing : float
        Between samples [ns].
    distance : float
        Sensor to ground [m].
    divergence : float
        Full angle of the beam between the 1/e^2 points [mrad].
    amplitude : float
        Of a typical echo [DN].
    max_error : float
        Largest error of an angle that is written [deg].

    Returns
    -------
    AngleOutlook

    Notes
    -----
    Width errors are the Cramer-Rao bound with the system's noise (docs/algorithms.md 2.1); the angle is that of 1.4.
    """
    width = system.sigma_ref / spacing
    own = float(np.sqrt(max(system.sigma_ref**2 + system.widths.variance, 1e-12)))
    if np.isinf(system.widths.error or 0.0):
        return AngleOutlook(np.inf, max_error, REASONS[NoData.NO_LEVEL][0])
    if width < LEAST_PULSE_WIDTH:
        needed = f"{LEAST_PULSE_WIDTH} are needed for widths to mean a slope"
        reason = f"the system pulse is {width:.2f} samples wide, {needed}"
        return AngleOutlook(np.inf, max_error, reason)
    added = float(spread_of_angle(np.radians(SLOPE), distance, 1e-3 * divergence))
    sigma = float(np.hypot(own, added))
    bound = float(bound_time(max(amplitude, 1e-3), sigma, system.noise.std, spacing))
    width_err = float(np.hypot(bound, system.widths.scatter))
    variance_err = np.hypot(2.0 * np.hypot(sigma * width_err, own * own * REFERENCE_ERROR), system.widths.error or 0.0)
    given, given_err, away = (np.array([value]) for value in (added * added, variance_err, distance))
    error = float(np.degrees(angles_of_variance(given, given_err, away, 1e-3 * divergence)[1][0]))
    smooth = np.sqrt(np.maximum(added * added - (system.widths.rough or 0.0), 0.0))
    error = math.hypot(error, SLOPE - float(np.degrees(angle_of_spread(smooth, distance, 1e-3 * divergence))))
    flat_err = float(np.hypot(bound_time(max(amplitude, 1e-3), own, system.noise.std, spacing), system.widths.scatter))
    least = np.sqrt(np.hypot(2.0 * np.hypot(own * flat_err, own * own * REFERENCE_ERROR), system.widths.error or 0.0))
    facing = float(np.degrees(angle_of_spread(least, distance, 1e-3 * divergence)))
    reason = (
        f"at {distance:.0f} m, a beam of {divergence:g} mrad on a slope of {SLOPE:g} degrees widens the pulse from "
        f"{own:.3g} ns to {sigma:.4g} ns; echoes of {amplitude:.0f} DN with a noise of {system.noise.std:.3g} DN "
        f"give this width to {width_err:.2g} ns, so the angle to {error:.1f} degrees ({facing:.1f} where the surface "
        f"faces the sensor); max_error is {max_error:g}"
    )
    return AngleOutlook(error, max_error, reason, facing)


def sample_reference(
    reader: StripReader, scan: StripScan, source: SensorSource, system: SystemPulse, spacing: float
) -> GroundReference:
    """Measure the widths of surfaces of known slope on a sample of a strip; see `measure_reference`.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    source : SensorSource
        Positions of the sensor.
    system : SystemPulse
        With the beam's divergence, where it is known.
    spacing : float
        Of the samples that are used [ns].

    Returns
    -------
    Reference
    """
    samples = sample_slopes(reader, scan, source, reader.sample_size(scan) // OF_SAMPLE)
    return measure_reference(samples, system, spacing)


def survey_angles(reader: StripReader, scan: StripScan, survey: Survey, divergence: float | None) -> Survey:
    """Add the divergence, the variance of surfaces that face the sensor, and a decision about angles to a survey.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    survey : Survey
    divergence : float or None
        Full angle of the beam between the 1/e^2 points [mrad]; None: only the figure `divergence_seen_mrad` is added,
        where the widths of the strip show it.

    Returns
    -------
    Survey

    Raises
    ------
    InputError
        Where the coordinates are not in metres.
    """
    system = survey.system.with_radiometry(divergence=divergence)
    if divergence is None:  # errors without hidden neighbours, which a survey that is only printed does not measure
        plain: dict[str, Any] = {"beside": (), "hidden": (), "hidden_light": (), "hidden_width": ()}
        others = {index: replace(other, **plain) for index, other in system.digitizers.items()}
        system = replace(system, **plain, digitizers=others)
    source = find_sensor(reader, scan, SensorRequest())
    spacing, figures = survey.figures.spacing_ns or 0.0, survey.figures
    seen = None if source.distance is None else sample_reference(reader, scan, source, system, spacing)
    if seen is not None and seen.divergence is not None:
        error = seen.divergence * seen.divergence_error
        figures = replace(figures, divergence_seen_mrad=seen.divergence, divergence_seen_error_mrad=error)
    if divergence is None:
        return replace(survey, figures=figures)
    if seen is None:
        outlook = AngleOutlook(np.inf, 0.0, "the sensor's position is unknown: give --trajectory to `wavebatch run`")
    else:
        system = seen.system
        outlook = predict_angles(system, spacing, source.distance or 0.0, divergence, figures.amplitude_50 or 0.0)
        if seen.doubt():
            outlook = replace(outlook, reason=f"{seen.doubt()}; {outlook.reason}")
    kept = (decision for decision in survey.decisions if decision.part != Part.ANGLE)
    decisions = (*kept, Decision(Part.ANGLE, outlook.possible, outlook.reason))
    return replace(survey, system=system, figures=figures, decisions=decisions)
