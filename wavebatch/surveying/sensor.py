"""The sensor's positions: from a trajectory file, from the rays in the strip, or from the height of the flight.

`find_sensor` is called once per strip; its SensorSource then fills the positions into each block.
Before you change it: positions must depend on the strip and the request alone, or units would disagree.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import distinct, median, quantile, robust_std
from wavebatch.core.trajectory import JUMP_SCATTER, LEAST_JUMP, Trajectory, solve_offset
from wavebatch.core.units import AIR_ATTENUATION, name_first
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.raw_bytes import naming
from wavebatch.files.las.crs import read_crs_definition
from wavebatch.files.strip.reader import LEAST_PAIRS, RaySample, StripReader, StripScan, measure_scale, sample_rays
from wavebatch.files.trajectory_file import read_trajectory
from wavebatch.kernels.geometry import ray_convergence
from wavebatch.kernels.physics.radiometry import mean_haze
from wavebatch.surveying.measuring.return_scatter import ReturnScatter

plain = partial(np.format_float_positional, unique=False, fractional=False, trim="-")
"""A number as text without powers of ten; precision: the digits that count."""

NODE_SECONDS = 0.5
"""Time between two positions that are estimated from rays [s]."""

WIDER = (1, 2, 4)
"""Nodes before and after a node whose rays are used too; the next number where rays are too few or too parallel."""

MOST_RAYS = 512
"""Most rays used per time window."""

MOST_NODES = 20_000
"""Most positions along a path, 2.8 hours: a longer time range means that GPS times are wrong."""

STEADY = 9.8
"""Most that windows of rays find a sensor accelerated [m/s2]: an aircraft that holds its height has far less."""

BEYOND = 0.25
"""Time for which a path goes straight on after its last ray [s]: only a sample of a strip's rays is used."""

MARGIN = 30.0
"""Time of a trajectory that is kept before and after the strip [s]."""

LARGEST_ANGLE = np.radians(2.0)
"""Largest angle between packet vectors and rays from a trajectory, but for a tenth of them; above it, strip, clock or
CRS differ."""

PROJECT = "project the strip to metres, or leave out the stages that measure in metres"

FOOT = 0.3048
"""International foot [m]."""

LEAST_OVERLAPS = 3
"""Smallest number of overlapping windows whose positions show by how much the motion leaves the fits' polynomials."""

MERCATOR = r'(?i)(?:projection|method)\s*\[\s*"(?:mercator(?!.{1,2}variant.c)|popular)|^epsg:(?:3857|3785|3395)\b'
"""WKT, or code, of the projections of web maps and sea charts, whose metres are those on the ground at one latitude
only. Variant C counts its northings from anywhere; of other codes the parameters are not known here."""

SCALING = r'(?i)(standard|scale|false).(?:parallel|factor|northing)[^"]*"\s*,\s*([-+.\de]+)'
"""Parameters of a WKT that say at which latitude that is, and from where northings count."""

EARTH, FLAT, STRETCHED, OFF_LINE = 6_378_137.0, 0.00669, 0.01, 1e-3
"""Radius of the Earth [m] and square of its eccentricity; stretch of a map above which ranges and slopes are wrong:
maps for surveys have 0.001; and share of the variance by which vectors may be off the line that shows it: those of real
strips are off by 1e-5."""

JERK, JERK_LEFT = 1.0, 0.025
"""Change of acceleration of an aircraft in turbulent air [m/s3], assumed where fewer windows overlap; and what a
parabola leaves of it: a root mean square of JERK half^3 times this."""

LEAST_DOUBT = 2.0
"""Least median difference of ranges by the trajectory and by the packet vectors for a remark [m]."""

MOUNTING = 5e-3
"""Angle to which a mounting is known at least [rad]: the least between a trajectory and the packet vectors, along the
flight, for a remark; and twice the error of vectors where nothing shows whether they are turned."""

SURE_TURN, LEAST_TURN = 5.0, 5e-4
"""Errors from which packet vectors are said to be turned against their points, and least angle that counts [rad]: by
it, an echo 20 m from its return is 1 cm off, as coordinates are rounded."""

TURN_ROUNDS = 10
"""Rounds in which a turn and how large turns are, of which it is the one known, are found: each halves what is left."""

HEIGHT_ERROR = 0.05
"""Error of the range, relative, where only the height of the flight is known; and scatter of the points' heights, over
it, from which one height for all is doubted."""

LARGEST_MISS, MOST_MISS = 0.01, 0.1
"""Distance by which a ray misses the path, over its length, and share of such rays, from which they do not meet: the
path of two sensors with the same times is half way between them. Those of real sensors miss it by a thousandth."""

LEVEL = 30
"""Steps of coordinates by which rays may miss their meeting place over ground that is level at 0: rounding and noise of
returns make some, heights that were taken off make hundreds."""

OF_WAY, STANDS = 0.5, 0.2
"""Share of the way by the packet vectors below which a trajectory is of no such flight, since clocks that are off leave
the way as it is; and speed below which a sensor stands, so that no clock shows [m/s]."""

LEAST_AGREEING = 20
"""Fewest rays of other digitizers that must agree with a trajectory, each after a ray that does not, for vectors to be
wrong and not the trajectory."""

MOST_ASIDE = 0.003
"""Distance of returns from their ray, over that to the first one: real strips have 0.0001. An echo 20 m from its
return is 6 cm aside then."""

MOST_BENT = 0.1
"""Share of pairs of returns that are off their ray, from which it is said: fewer are returns of two pulses."""

SURE_HEIGHTS, LEAST_HEIGHTS = 4.0, 1e-3
"""Errors from which rays come from several heights: a twelfth of 1,000 rays shows that so, wherever they come from; and
least standard deviation of these heights that counts, over the distance: drifts of attitude look like a tenth of it."""

OF_JUMP = 2.0
"""By how much a path jumps where vectors are turned in a part of the strip, over what the line between the neighbours
shows of it: 0.5 to 3 times, since windows of rays may reach over the jump. And how far turns that vary from window to
window reach, over their standard deviation: those that grow evenly 1.7 times."""

TURNED = ("turned_deg", "turned_error_deg", "is_turned")
"""Facts of a turn of the packet vectors."""

LEAST_RAYS, LEAST_SPREAD = 100, np.radians(4.0)
"""So many packet vectors, which cover so wide an angle, meet in a path, or contradict their points."""


@frozen
class SensorRequest:
    """Where the sensor's positions shall come from; picklable."""

    trajectory: Path | None = None
    """A file of positions; None: from the rays in the strip."""
    crs: str | None = None
    """CRS of the strip, where its header has none."""
    lever_arm: tuple[float, float, float] | None = None
    """From the trajectory to the scanner: forward, right, down [m]."""
    height: float | None = None
    """Of the flight above the ground, used where rays give no position [m]."""


@frozen(eq=False)
class SensorSource:
    """Positions of the sensor and where they come from; picklable."""

    kind: str
    """`trajectory`, `direction vectors`, `pairs of returns`, `flight height` or `none`."""
    trajectory: Trajectory | None = None
    height: float | None = None
    """Of the flight above the ground [m], where nothing else is known."""
    distance: float | None = None
    """Median distance from sensor to ground [m]; None where unknown."""
    error: float = 0.0
    """Standard deviation of the distance [m]; of a trajectory by comparison with the packet vectors; 0 if unknown."""
    farther: float | None = None
    """Median of the ranges by the trajectory less those by the packet vectors [m]; None where not compared."""
    vectors_error: float | None = None
    """Error of the ranges by the packet vectors [m]."""
    facts: tuple[tuple[str, Any], ...] = ()
    """More values for reports, by name."""
    returns: ReturnScatter = ReturnScatter(0.0)
    """How exactly the vendor placed the returns."""

    @property
    def haze(self) -> float:
        """Haze on the way to the ground over that of a usual flight above a coast; 1 where nothing is known."""
        if not self.distance:
            return 1.0
        top = self.distance if self.trajectory is None else float(np.nanmedian(self.trajectory.xyz[:, 2]))
        return mean_haze(top - self.distance, top)

    @property
    def turned(self) -> float:
        """Error of the packet vectors against the points [deg]: what was measured, and what cannot be seen."""
        facts = dict(self.facts)
        if self.kind == "trajectory":
            return facts.get("angle_to_packet_vectors_deg", 0.0)
        return float(np.hypot(facts.get("turned_deg", 0.0), facts.get("turned_error_deg", 0.0)))

    def place(self, system: SystemPulse) -> SystemPulse:
        """Return the system with errors of sensor and returns, and with the usual air at the flight's heights."""
        places = {"sensor_error": self.error, "returns": self.returns.scatter, "phase": self.returns.phase}
        return system.with_radiometry(attenuation=AIR_ATTENUATION * self.haze, **places)

    def fill(self, block: WaveformBlock) -> WaveformBlock:
        """Return the block with the sensor's positions; the block itself where they are unknown.

        Parameters
        ----------
        block : WaveformBlock

        Returns
        -------
        WaveformBlock
            With `sensor`, f8 (n, 3) [m].
        """
        if self.trajectory is not None:
            return replace(block, sensor=self.trajectory.at(block.gps_time))
        if self.height is None:
            return block
        down = -block.direction[:, 2:]
        # Waveforms begin above their targets, so the height counts from the lowest return of each packet.
        low = block.origin[:, 2].copy()
        if block.returns is not None:
            np.minimum.at(low, block.returns.waveform, block.returns.xyz[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            back = block.direction * ((low[:, None] + self.height - block.origin[:, 2:]) / down)
        return replace(block, sensor=np.where(down > 0, block.origin - back, np.nan))

    def doubt(self) -> str:
        """Return the line about what contradicts the range: vectors, relief or a trajectory; empty without any."""
        facts = dict(self.facts)
        spread = facts.get("do_not_meet_deg")
        if spread == 0.0:
            return (
                "range: the packets' vectors are all parallel, as no scanner's are: they are no directions, new echoes "
                "lie along them, and angles by normals are not known"
            )
        if spread:
            return (
                f"range: the packets' vectors spread by {spread:.0f} degrees, but do not meet in a path of the sensor: "
                "points and vectors are of two CRSs, axes are swapped or mirrored, --direction is the other one, times "
                "are wrong or the same for two sensors; new echoes lie along them"
            )
        if self.height and facts.get("relief_m", 0.0) > HEIGHT_ERROR * self.height:
            return (
                f"range: --flight-height is one number, but heights scatter by {facts['relief_m']:.0f} m: the "
                f"error of the ranges, {plain(self.error, 2)} m, holds it; give --trajectory"
            )
        if facts.get("is_turned"):
            off, error = facts["turned_deg"], facts["turned_error_deg"]
            shown, known, most = (plain(value, 2) for value in (off, error, off + error))
            size = f"{shown} degrees, known to {known}" if off > error else f"up to {most} degrees"
            off += error * (off <= error)
            return (
                f"angles: the packets' vectors are turned against the points by {size}: echoes 10 m from a return are "
                f"{plain(1000 * np.radians(off), 1)} cm off, and the errors of angles and of ranges "
                "(range_error) hold it; compute points and vectors with the same mounting"
            )
        if "jump_m" in facts:
            return (
                f"range: the sensor's path by vectors jumps by {facts['jump_m']:.3g} m, as no aircraft does: in a part "
                "of the strip points lie elsewhere (another datum of heights), or times do; errors of ranges hold it"
            )
        late, behind = (facts.get(name) or 0.0 for name in ("late_s", "behind_m"))
        if abs(behind) > max(MOUNTING * (self.distance or 0.0), 10.0 * (self.vectors_error or 0.0)):
            return (
                f"range: the trajectory is {abs(behind):.1f} m {'behind' if late > 0 else 'ahead of'} the packets' "
                f"vectors, as if its clock were off by {late:+.2f} s: check its clock and lever arm; the error of the "
                f"ranges, {plain(self.error, 2)} m, holds it"
            )
        if self.farther is None or abs(self.farther) <= max(LEAST_DOUBT, 5.0 * (self.vectors_error or 0.0)):
            return ""
        which = "farther" if self.farther > 0 else "nearer"
        return (
            f"range: by the trajectory echoes are {abs(self.farther):.1f} m {which} than by the packets' vectors, "
            f"whose error is {self.vectors_error:.2g} m; are the heights of one above the geoid, of the other above "
            "the ellipsoid?"
        )

    def describe(self) -> dict[str, Any]:
        """Return kind, errors and the other values for reports."""
        placed = self.returns
        returns = {"scatter_m": round(placed.scatter, 5), "from": placed.source, "phase_m": round(placed.phase, 5)}
        error = round(self.error, 6) or None
        report = {"source": self.kind, "range_error_m": error, "returns": returns, **dict(self.facts)}
        return report if self.distance is None else {**report, "distance_m": self.distance}


UNKNOWN = SensorSource("none")


def find_sensor(reader: StripReader, scan: StripScan, request: SensorRequest) -> SensorSource:
    """Find the sensor's positions during a strip.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    request : SensorRequest

    Returns
    -------
    SensorSource
        `UNKNOWN` where neither the request nor the strip gives positions.

    Raises
    ------
    InputError
        Where a trajectory cannot be read, does not overlap the strip or contradicts the packet vectors, and for strips
        that are not in metres.

    Notes
    -----
    docs/algorithms.md 5.1.
    """
    refuse_units(reader, scan)
    vectors, pairs = sample_rays(reader, scan)
    if stretch := _measure_stretch(vectors.direction):
        raise InputError(
            f"{reader.facts.path}: packet vectors are {stretch:.3f} times as long across as upwards, so that angles "
            "and ranges would be wrong: their map is stretched, as those of the web, or heights have another unit: "
            f"{PROJECT}"
        )
    if request.trajectory is not None:
        return _from_file(reader, vectors, pairs, request, scan.packets > 1)
    found = estimate_path(vectors, "direction vectors", pairs)
    if found is not None:
        return found
    facts: dict[str, Any] = dict(find_turn(vectors, pairs, [])[0])
    found = estimate_path(pairs, "pairs of returns")
    if found is not None:
        return replace(found, facts=(*found.facts, *facts.items()))
    if len(vectors.time) >= LEAST_RAYS and vectors.time[0] < vectors.time[-1]:
        spread = ray_convergence.measure_extent(_unit(vectors.direction))
        if not LEAST_TURN < spread <= LEAST_SPREAD:
            facts["do_not_meet_deg"] = round(float(np.degrees(spread)), 1)
            # Unless pairs of returns prove them, such vectors may be off by as much as they scatter, or by anything.
            unproved = np.degrees(spread / 4.0 if spread > LEAST_SPREAD else 0.5 * np.pi)
            if facts["turned_error_deg"] > np.degrees(0.25 * MOUNTING):
                facts["turned_error_deg"] = round(float(unproved), 4)
    if request.height is None:
        return replace(UNKNOWN, facts=tuple(facts.items()))
    # An aircraft does not follow hills: their heights are in the error.
    facts["relief_m"] = round(robust_std(vectors.point[:, 2]), 1) if len(vectors.point) else 0.0
    error = float(np.hypot(HEIGHT_ERROR * request.height, facts["relief_m"]))
    return SensorSource(
        "flight height", height=request.height, distance=request.height, error=error, facts=tuple(facts.items())
    )


def refuse_units(reader: StripReader, scan: StripScan) -> None:
    """Raise InputError where the coordinates are not in metres, or where the packets make that doubtful."""
    path, units, ratio, remedy = reader.facts.path, reader.facts.units, scan.vectors.ratio, PROJECT
    for unit in units:
        if not unit.is_metric:
            why = "which have no height" if unit.kind == "geocentric" else "so ranges would not be in metres"
            raise InputError(f"{path}: coordinates are {unit.describe()}, {why}: {remedy}")
    text = reader.facts.crs or ""
    if projection := re.search(MERCATOR, text):
        given = {name.lower(): float(value) for name, value in re.findall(SCALING, text[projection.end() :])}
        sine = np.sin(np.radians(given.get("standard", 0.0)))
        least = given.get("scale", 1.0) * ((1.0 - sine**2) / (1.0 - FLAT * sine**2)) ** 0.5
        low, high = (ends[1] - given.get("false", 0.0) for ends in (reader.facts.header.mins, reader.facts.header.maxs))
        map_scale = float(least * np.cosh(np.clip(0.5 * (low + high) / (EARTH * least), -9.0, 9.0)))
        if abs(map_scale - 1.0) > STRETCHED:
            raise InputError(
                f"{path}: coordinates are of a Mercator projection, whose metres are {map_scale:.2f} times as long "
                f"here as on the ground: {remedy}"
            )
    if abs(ratio * FOOT - 1.0) < 0.05:
        raise InputError(
            f"{path}: packet vectors are {ratio:.3f} times c/2 long, as in feet, but the CRS of the strip does not say "
            f"that its coordinates are in feet: {remedy}"
        )
    if _look_like_degrees(reader):
        raise InputError(
            f"{path}: coordinates look like degrees, since all points lie within one unit, and no CRS says so: {remedy}"
        )
    scale, *_, level = measure_scale(reader, scan)
    found = estimate_path(sample_rays(reader, scan)[0], "direction vectors") if level else None
    residual = np.radians(dict(found.facts)["residual_deg"]) * found.distance if found and found.distance else np.inf
    # Heights that were taken off move rays, which meet no more; over ground that is level at 0 they do.
    if level and residual > LEVEL * max(np.abs(reader.facts.header.scales)):
        raise InputError(
            f"{path}: most points of the ground (class 2) have the height 0: heights count from the ground, so slopes "
            "and ranges would be wrong: take the strip with its heights before they were normalised, or leave out the "
            "stages that need slopes or ranges; where the ground is level at 0 indeed, raise all heights"
        )
    if scale is not None and abs(scale * FOOT - 1.0) < 0.05:
        raise InputError(
            f"{path}: returns of one pulse lie {scale:.2f} times as far apart as their times in the packet say: "
            f"coordinates are in feet, packet vectors in metres, and no CRS says so: {remedy}"
        )


def _measure_stretch(vectors: np.ndarray) -> float:
    """How much longer vectors (n, 3) are across than upwards; 0 where that is 1 within STRETCHED, or not known:
    a few rays are rounded to any stretch.

    Light is as fast in all directions, so that the square across falls by 1 where that upwards grows by 1.
    """
    if len(vectors) < LEAST_RAYS:
        return 0.0
    up, across = vectors[:, 2] ** 2, vectors[:, 0] ** 2 + vectors[:, 1] ** 2
    off = up - np.mean(up)
    square = float(off @ off)
    slope = float(off @ across) / max(square, 1e-300)
    left = across - np.mean(across) - slope * off
    # Vectors that are longer and shorter for another reason show nothing.
    exact = float(left @ left) < OFF_LINE * slope**2 * square and square > OFF_LINE**3 * float(up @ up)
    error, stretch = (float(left @ left) / max(square, 1e-300) / (len(left) - 2)) ** 0.5, max(-slope, 0.0) ** 0.5
    sure = exact and abs(slope + 1.0) > SURE_TURN * error
    return stretch if sure and abs(stretch - 1.0) > STRETCHED else 0.0


def _look_like_degrees(reader: StripReader) -> bool:
    """Whether all of many points lie within one unit, at numbers of degrees."""
    header = reader.facts.header
    low, high = np.array(header.mins[:2]), np.array(header.maxs[:2])
    extent = high - low
    inside = (np.maximum(np.abs(low), np.abs(high)) <= (360.0, 90.0)).all()
    return bool(header.point_count > 100 and inside and (extent > 0).all() and (extent < 1.0).all())


def judge_scale(reader: StripReader, scan: StripScan) -> tuple[str, ...]:
    """Raise InputError where packet vectors are in metres and coordinates in feet, or the other way round.

    New echoes lie along the vectors, so they would be up to metres from their place. Spacings of returns decide, not
    the CRS: it may be missing or wrong. Doubts are returned: where many second returns lie off their ray; and, without
    enough pairs of returns, where the CRS and the length of the vectors differ.
    """
    path, units, ratio = reader.facts.path, reader.facts.units, scan.vectors.ratio
    along = next((unit.horizontal for unit in units if unit.horizontal is not None), None)
    is_feet = along is not None and abs(along / FOOT - 1.0) < 0.001
    if (along is None or is_feet) and _look_like_degrees(reader) and ratio > 0.01:  # those in degrees are below 1e-5
        raise InputError(
            f"{path}: coordinates are degrees, packet vectors metres, so new echoes would be misplaced: project the "
            "strip with its vectors to metres, or write only its own points with `run --points returns`"
        )
    scale, bent, pairs, aside, _ = measure_scale(reader, scan)
    bends: tuple[str, ...] = ()
    if bent > MOST_BENT:
        bends = (
            f"in {bent:.0%} of {pairs} pairs of returns of one pulse the second lies off its ray by more than a tenth "
            "of their distance: light is bent at water, or times or vectors are wrong; echoes are placed along "
            "straight rays, and range_err holds how far returns are from there",
        )
    elif aside > MOST_ASIDE:
        bends = (
            f"of {pairs} pairs of returns of one pulse half lie aside of its ray by {aside:.1%} of their distance and "
            "more: points were projected anew without their packet vectors, or light is bent at water; added echoes "
            "lie aside by as much: project both, or run the strip as its vendor wrote it",
        )
    if scale is None:
        doubt = "coordinates are in feet by the CRS, packet vectors as long as metres: added echoes may be far off"
        return (*bends, doubt) if is_feet and abs(ratio - 1.0) < 0.05 else bends
    kinds = ((FOOT, "in feet, packet vectors in metres"), (1 / FOOT, "in metres, packet vectors in feet"))
    for factor, words in kinds:
        if abs(scale * factor - 1.0) < 0.05:
            raise InputError(
                f"{path}: returns of one pulse lie {scale:.2f} times as far apart as their times in the packet say: "
                f"coordinates are {words}, so new echoes would be misplaced: project the strip to metres, or write "
                "only its own points with `run --points returns`"
            )
    return bends


def _from_file(
    reader: StripReader, rays: RaySample, pairs: RaySample, request: SensorRequest, several: bool
) -> SensorSource:
    path = Path(request.trajectory or "")
    crs = request.crs or read_crs_definition(reader.facts.path, reader.facts.header, heights=True)
    known = read_trajectory(path, crs=crs, lever_arm=request.lever_arm)
    times = rays.time[np.isfinite(rays.time) & (rays.time != 0)]
    if several and (not len(times) or times.min() == times.max()):
        raise InputError(
            f"{request.trajectory}: cannot be used, because the points of this strip have no GPS times, or all the "
            "same; give --flight-height instead"
        )
    if not len(rays.time):
        return SensorSource("trajectory", known, facts=(("file", path.name),))
    start, stop = float(rays.time[0]), float(rays.time[-1])
    with naming(path):
        offset, clocks = solve_offset(known, start, stop)
        known = known.shifted(offset).between(start - MARGIN, stop + MARGIN)
        if jump := known.find_jump(start, stop):
            raise InputError(
                f"the trajectory jumps by {jump[1]:.3g} m at {jump[0] - offset:.2f} s, as no aircraft does: a row "
                "there is damaged; take it out, and positions are interpolated"
            )
        ahead = rays.point - known.at(rays.time)
        distance = np.sqrt((ahead * ahead).sum(axis=1))
        angle = _disagreement(ahead, distance, rays)
    share = known.share_known(start, stop)
    seen = estimate_path(rays, "direction vectors", pairs)
    shown = dict(seen.facts if seen else ())
    farther = vectors_error = late = behind = None
    range_error_m = 0.0
    if seen is not None and seen.trajectory is not None:
        # How much longer ranges are than by the packet vectors: median, and mean with scatter, which all rays share.
        by_vectors = seen.trajectory
        longer = distance - np.sqrt(((rays.point - by_vectors.at(rays.time)) ** 2).sum(axis=1))
        longer = longer[np.isfinite(longer)]
        if len(longer):
            farther, vectors_error = round(float(median(longer)), 3), round(seen.error, 6)
            range_error_m = float(abs(np.mean(longer)) + np.std(longer))
            if range_error_m > seen.error:  # a contradiction is known no better than the vectors are
                range_error_m = float(np.hypot(range_error_m, seen.error))
        ends = (np.diff(one.at(np.array([start, stop])), axis=0) for one in (known, by_vectors))
        flown, seen_way = (float(np.sqrt(np.square(way).sum())) for way in ends)
        if seen_way > max(MOUNTING * (seen.distance or 0.0), 10.0 * seen.error) and flown < OF_WAY * seen_way:
            raise InputError(
                f"{path}: the trajectory moves by {flown:.1f} m during the strip, but the packets' vectors come from a "
                f"sensor that moves by {seen_way:.1f} m: its positions stand still, or its times run slower"
            )
        # By how much the trajectory comes later than the path by the packet vectors, in s and in m along the flight.
        step = known.at(by_vectors.time + 0.5 * NODE_SECONDS) - known.at(by_vectors.time - 0.5 * NODE_SECONDS)
        square = np.einsum("ni,ni->n", step, step)
        with np.errstate(invalid="ignore", divide="ignore"):
            lag = NODE_SECONDS * np.einsum("ni,ni->n", by_vectors.xyz - known.at(by_vectors.time), step) / square
        there = np.isfinite(lag) & (square > (NODE_SECONDS * STANDS) ** 2)
        if there.any():
            middle = float(median(lag[there]))
            late = round(middle, 4)
            behind = round(middle * float(np.sqrt(median(square[there]))) / NODE_SECONDS, 3)
    distance = distance[np.isfinite(distance)]
    facts = {
        "file": path.name,
        "clocks": clocks,
        "offset_s": offset,
        "share_covered": round(share, 6),
        "gaps_s": [[round(a, 3), round(b, 3)] for a, b in known.gaps(start, stop)[:20]],
        "angle_to_packet_vectors_deg": round(float(np.degrees(angle)), 4),
        **{name: shown[name] for name in TURNED if name in shown},
        "distance_m": None,
        "farther_than_by_vectors_m": farther,
        "by_vectors_error_m": vectors_error,
        "late_s": late,
        "behind_m": behind,
    }
    return SensorSource(
        "trajectory",
        known,
        distance=round(float(median(distance)), 2) if len(distance) else None,
        error=range_error_m,
        farther=farther,
        vectors_error=vectors_error,
        facts=tuple(facts.items()),
    )


def find_turn(
    vectors: RaySample, pairs: RaySample, fits: Sequence[ray_convergence.SensorFit]
) -> tuple[dict[str, Any], np.ndarray, float]:
    """Find by how much packet vectors are turned against the points, alike in the whole strip.

    Parameters
    ----------
    vectors : RaySample
    pairs : RaySample
        Returns of one pulse lie on its ray, wherever its vector points.
    fits : sequence of SensorFit
        Of the vectors: rays that are turned do not meet.

    Returns
    -------
    facts : dict
        TURNED: angle between vectors and rays [deg]; its error, with what nothing shows; and whether
        chance does not explain it.
    turn : float64 (3,)
        Of the vectors, about the axes; 0 where chance explains it [rad].
    off : float
        How wrong ranges are, which count from where rays meet, root mean square [m]: once the vectors are turned back,
        where chance does not explain it; else as they are, 0 for an angle below LEAST_TURN.

    Notes
    -----
    docs/algorithms.md 5.1.
    """
    known, right, shift, varied = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    parts: list[ray_convergence.TurnSeen] = []
    end = -np.inf
    for fit in fits:
        if fit.centre - fit.half > end:  # windows that overlap have the same rays
            rows = np.flatnonzero(np.abs(vectors.time - fit.centre) <= fit.half)
            window = [values[rows[:: max(1, len(rows) // MOST_RAYS)]] for values in vectors[:4]]
            parts.append(ray_convergence.measure_turn(fit, *window))
            end = fit.centre + fit.half
    if parts:
        each, sides, floors, shifts = (np.stack(values) for values in zip(*parts, strict=True))
        shift = shifts.mean(axis=0)
        # Mirrors do the same in all windows; by relief alone each window has a floor of its own.
        for kind, count in enumerate((1, len(parts))):
            total, floor = each[:, kind].sum(axis=0), count * floors[:, kind].mean(axis=0)
            seen = np.linalg.pinv(total, hermitian=True) @ sides[:, kind].sum(axis=0)
            off = sides[:, kind] - each[:, kind] @ seen
            # Over level ground rounding alone turns windows by radians about an axis that they hardly show.
            loose = np.linalg.inv(each[:, kind] + np.eye(3) / MOUNTING**2)
            apart = np.einsum("wi,wij,wj->", off, loose, off) / max(3 * len(parts) - 3, 1)
            if not kind and apart > SURE_TURN:  # vectors that roll by themselves, each window in its own way
                varied = OF_JUMP**2 * np.cov(np.einsum("wij,wj->iw", loose, sides[:, 0]))
            total = total / max(1.0, apart)
            both = total @ np.linalg.pinv(total + floor, hermitian=True) @ floor
            known, right = known + both, right + both @ seen
    by_pairs, side, swung = _turn_by_pairs(pairs)
    known = known + by_pairs
    # Within MOUNTING what is seen counts as it is. What is not seen is half of that, since a limit is two standard
    # deviations; where vectors are turned it is as large as what is seen, and MOUNTING at least.
    error = np.linalg.inv(known + np.eye(3) / MOUNTING**2)
    turn = error @ (right + side)
    moved = turn @ known @ turn > SURE_TURN**2 and turn @ turn > LEAST_TURN**2
    for _ in range(TURN_ROUNDS if moved else 0):
        error = np.linalg.inv(known + np.eye(3) / (MOUNTING**2 + turn @ turn))
        turn = error @ (right + side)
    error = varied + swung * np.eye(3) + (error if moved else np.linalg.inv(known + np.eye(3) * (2.0 / MOUNTING) ** 2))
    unit = _unit(vectors.direction)
    unit = unit[np.isfinite(unit[:, 0])]
    across = np.eye(3) - unit.T @ unit / max(len(unit), 1)
    angle, doubt = float(np.sqrt(turn @ across @ turn)), float(np.sqrt(0.5 * np.sum(across * error)))
    moved = bool(moved and angle > LEAST_TURN)
    seen = moved or bool(np.trace(varied) > LEAST_TURN**2)
    values = (round(float(np.degrees(angle)), 4), round(float(np.degrees(doubt)), 4), seen)
    facts = dict(zip(TURNED, values, strict=True))
    left = error if moved else np.outer(turn, turn) * (angle > LEAST_TURN)
    off = float(np.sqrt(np.sum(np.einsum("ni,ij,nj->n", unit @ shift, left, unit @ shift)) / max(len(unit), 1)))
    return facts, turn * moved, off


def _unit(vectors: np.ndarray) -> np.ndarray:
    """The vectors (n, 3) with a length of 1; NaN for those without a length."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / np.sqrt((vectors**2).sum(axis=1))[:, None]


def _turn_by_pairs(pairs: RaySample) -> tuple[np.ndarray, np.ndarray, float]:
    """Information of a turn and its right side, (3, 3) and (3,), by vectors across the ray between two returns; and
    variance of turns that change along the strip [rad2]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        long = np.sqrt(pairs.weight)
        ray = pairs.direction / long[:, None]
        vector = _unit(pairs.vector)
        ray = ray * np.sign(np.einsum("ni,ni->n", vector, ray))[:, None]
        off = (vector - ray) * long[:, None]
    rows = np.isfinite(off).all(axis=1) & ((off * off).sum(axis=1) < (LARGEST_ANGLE * long) ** 2)
    if rows.sum() < LEAST_PAIRS:
        return np.zeros((3, 3)), np.zeros(3), 0.0
    off = off[rows]
    turns = np.cross(np.eye(3), ray[rows, None]).transpose(0, 2, 1) * long[rows, None, None]
    left = off
    for _ in range(3):
        size = np.sqrt((left * left).sum(axis=1))
        good = size <= ray_convergence.CLIP * max(float(median(size)), 1e-12)
        normal = np.einsum("nki,nkj->ij", turns[good], turns[good])
        right = np.einsum("nki,nk->i", turns[good], off[good])
        left = off - turns @ (np.linalg.pinv(normal, hermitian=True) @ right)
    variance = max(float((left[good] ** 2).sum()) / max(2 * int(good.sum()) - 3, 1), 1e-12)
    # Vectors that turn to and fro are off alike in neighbours in time; what is off by chance is not.
    # 68 % of a swing lie within 1.24 of its root mean square.
    one = np.unique(pairs.time[rows][good], return_index=True)[1]  # of each pulse
    angle = (left[good] / long[rows][good, None])[one]
    alike = np.einsum("ni,ni->n", angle[1:], angle[:-1])
    surely = alike.sum() > SURE_TURN * np.sqrt((alike * alike).sum())
    return normal / variance, right / variance, float(1.24**2 * surely * alike.sum() / max(len(alike), 1))


def _disagreement(ahead: np.ndarray, distance: np.ndarray, rays: RaySample) -> float:
    """Median angle between packet vectors and rays from the trajectory [rad]; InputError where it is too large, or that
    of a tenth of the rays, which are of another flight then.
    """
    with np.errstate(all="ignore"):
        ahead = ahead / distance[:, None]
        cosine = np.clip(np.einsum("ni,ni->n", ahead, _unit(rays.direction)), -1.0, 1.0)
    known = np.isfinite(cosine)
    if not known.any():
        return 0.0
    angles, digitizer = np.arccos(cosine[known]), rays.digitizer[known]
    angle, most = (quantile(angles, share) for share in (0.5, 1.0 - MOST_MISS))
    if most > LARGEST_ANGLE:
        share, off = ("half", angle) if angle > LARGEST_ANGLE else ("a tenth", most)
        off_ray = angles > LARGEST_ANGLE
        wrong = [one for one in distinct(digitizer).tolist() if np.mean(off_ray[digitizer == one]) > MOST_MISS]
        is_wrong = np.isin(digitizer, wrong)
        # A trajectory that is wrong for a time agrees with channels that record nothing then, and with few rays.
        last = np.maximum.accumulate(np.where(is_wrong, np.arange(len(angles)), 0))
        agree = ~is_wrong & ~off_ray & (is_wrong & off_ray)[last]
        if np.count_nonzero(agree) >= LEAST_AGREEING:
            which = name_first([f"digitizer {one}" for one in wrong])
            raise InputError(
                f"the packets' vectors of {which} are off the trajectory's rays, those of the others agree with them: "
                "compute their vectors again, or leave out --trajectory"
            )
        raise InputError(
            f"{share} of the trajectory's rays are {np.degrees(off):.1f} degrees off the packets' vectors: it belongs "
            "to another strip, or to a part of this one, has another CRS or unit, or its clock is off by seconds (UTC "
            "is 18 s less than GPS time)"
        )
    return angle


def estimate_path(rays: RaySample, kind: str, pairs: RaySample | None = None) -> SensorSource | None:
    """Estimate the sensor's path from the points where its rays meet, in time windows along the flight.

    Parameters
    ----------
    rays : Rays
        A sample of the strip's rays, sorted by time.
    kind : str
        Of the rays; becomes the kind of the source.
    pairs : RaySample, optional
        Of rays by packet vectors: shows, as rays do that do not meet, whether the vectors are turned.

    Returns
    -------
    SensorSource or None
        None where the rays do not meet.
    """
    if not len(rays.time) or rays.time[0] == rays.time[-1]:
        return None
    origin = rays.time[0]
    cells = np.floor((rays.time - origin) / NODE_SECONDS)
    nodes = distinct(cells)
    if len(nodes) > MOST_NODES:
        return None
    found: list[tuple[ray_convergence.SensorFit, np.ndarray, np.ndarray]] = []
    for node in nodes.tolist():
        own = np.searchsorted(cells, [node, node + 1])
        low, high = float(rays.time[own[0]]), float(rays.time[own[1] - 1])
        for reach in WIDER:  # the smallest window that gives a fit
            start, stop = np.searchsorted(cells, [node - reach, node + reach + 1])
            rows = np.arange(start, stop, max(1, (stop - start) // MOST_RAYS))
            fit = ray_convergence.fit_best(rays.time[rows], rays.point[rows], rays.direction[rows], rays.weight[rows])
            if fit is not None:
                break
        if fit is None:
            continue
        # It is used at the middle of the node, and beyond the ends of its rays where it has no neighbour.
        middle = origin + (node + 0.5) * NODE_SECONDS
        places = [middle] if low <= middle <= high else [low, high]
        if not np.any(nodes == node - 1):
            places += [low - BEYOND, low]
        if not np.any(nodes == node + 1):
            places += [high, high + BEYOND]
        times = distinct(np.array(places))
        found.append((fit, times, np.clip(times, low, high)))
    if not found:
        return None
    time, inside = (np.concatenate([part[i] for part in found]) for i in (1, 2))
    placed = [ray_convergence.sensor_at(fit, within) for fit, _, within in found]
    xyz, velocity = (np.concatenate([part[i] for part in placed]) for i in (0, 1))
    xyz += velocity * (time - inside)[:, None]
    path = Trajectory.build(time, xyz, velocity, gap=(max(WIDER) + 1) * NODE_SECONDS)
    distance = round(float(median(np.array([fit.distance for fit, _, _ in found]))), 2)
    # The range's error over all windows: what the fits say, and what they contradict.
    squares, apart = [], []
    for number, (fit, _, within) in enumerate(found):
        near = np.abs(rays.time - fit.centre) <= fit.half
        direction = _unit(rays.direction[near][:64])
        at = np.full(len(direction), within[len(within) // 2])
        squares.append(np.mean(ray_convergence.range_error(fit, at, direction) ** 2))
        later = found[number + 1][0] if number + 1 < len(found) else None
        if later is not None and later.centre - fit.centre <= fit.half + later.half:
            # Difference of their positions in the middle of what they share [m].
            low = max(fit.centre - fit.half, later.centre - later.half)
            high = min(fit.centre + fit.half, later.centre + later.half)
            middle = np.array([0.5 * (low + high)])
            off = (ray_convergence.sensor_at(later, middle)[0] - ray_convergence.sensor_at(fit, middle)[0])[0]
            apart.append(np.mean((direction @ off) ** 2))
    if len(apart) >= LEAST_OVERLAPS:
        motion = 0.5 * np.mean(apart)  # both windows are off
    else:
        motion = (JERK * JERK_LEFT * max(fit.half for fit, _, _ in found) ** 3) ** 2
    sure = rays.weight >= median(rays.weight)
    unit = _unit(rays.direction[sure])
    miss = np.sqrt(np.square(np.cross(rays.point[sure] - path.at(rays.time[sure]), unit)).sum(axis=1))
    above = _measure_heights(rays.point[sure] - path.at(rays.time[sure]), unit)
    above *= above > LEAST_HEIGHTS * distance
    if np.mean(miss > LARGEST_MISS * distance) > MOST_MISS or above > LARGEST_MISS * distance:
        return None
    # Mirrored vectors meet as well, but behind the points; pairs may be in any order.
    behind = np.einsum("ni,ni->n", rays.point[sure] - path.at(rays.time[sure]), unit) < 0.0
    if kind == "direction vectors" and np.mean(behind) > 0.5:
        return None
    error, facts = float(np.sqrt(np.mean(squares) + motion + above**2)), _describe(found, path, rays)
    wait, known = np.diff(path.time)[:, None], np.diff(path.time) <= path.gap
    off = np.diff(path.xyz, axis=0) - 0.5 * wait * (path.velocity[1:] + path.velocity[:-1])
    off = np.sqrt((off * off).sum(axis=1))[known]
    most = 0.25 * STEADY * wait[known, 0] ** 2 + LEAST_JUMP + JUMP_SCATTER * (median(off) if len(off) else 0.0)
    if np.any(off > most):
        farthest = float(np.max(off[off > most]))
        error, facts = float(np.hypot(error, farthest)), (*facts, ("jump_m", round(farthest, 2)))
    source = SensorSource(kind, path, distance=distance, error=error, facts=facts)
    if pairs is None:
        return source
    shown, turn, off = find_turn(rays, pairs, [fit for fit, _, _ in found])
    if jump := path.find_jump(rays.time[0], rays.time[-1]):  # turned in a part of the strip only
        size = np.hypot(shown["turned_error_deg"], np.degrees(OF_JUMP * jump[1] / distance))
        shown |= {"turned_error_deg": round(float(size), 4), "is_turned": True}
    back = np.cross(rays.direction, turn)
    straight = rays._replace(direction=rays.direction + back + 0.5 * np.cross(back, turn))
    source = (estimate_path(straight, kind) if turn.any() else None) or source
    return replace(source, error=float(np.hypot(source.error, off)), facts=(*source.facts, *shown.items()))


def _measure_heights(away: np.ndarray, unit: np.ndarray) -> float:
    """Standard deviation of the places along the view from which rays come [m]; 0 where errors of rays explain it.

    A ray that comes from h above the path misses it by h sin(angle); errors of its direction miss by the same angle
    wherever it looks. So all is taken over the distance: wide views would show heights otherwise.

    away : f8 (n, 3)
        From the path to a point of the ray.
    """
    known = np.isfinite(away).all(axis=1)
    away, unit = away[known], unit[known]
    view = unit.sum(axis=0)
    view = view / max(float(np.sqrt(view @ view)), 1e-30)
    side = view - (unit @ view)[:, None] * unit
    tilt, far = (side * side).sum(axis=1), np.maximum((away * away).sum(axis=1), 1e-30)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = np.nan_to_num(np.einsum("ni,ni->n", away, side) ** 2 / tilt) / far
    tilt = tilt / far
    off = tilt - tilt.mean()
    growth = float(off @ square) / max(float(off @ off), 1e-30)
    left = square - square.mean() - growth * off
    doubt = float(np.sqrt(np.sum((off * left) ** 2))) / max(float(off @ off), 1e-30)
    return growth**0.5 if growth > SURE_HEIGHTS * doubt else 0.0


def _describe(
    found: list[tuple[ray_convergence.SensorFit, np.ndarray, np.ndarray]], path: Trajectory, rays: RaySample
) -> tuple[tuple[str, Any], ...]:
    """Height, speed, heading and smoothness of a path, for reports."""
    speed = np.sqrt((path.velocity**2).sum(axis=1))
    east, north, _ = median(path.velocity, axis=0)
    facts: dict[str, Any] = {
        "windows": len(found),
        "height_m": round(float(median(path.xyz[:, 2]) - median(rays.point[:, 2])), 2),
        "speed_m_s": round(float(median(speed)), 2),
        "heading_deg": round(float(np.degrees(np.arctan2(east, north)) % 360), 1),
        "view_deg": round(float(np.degrees(median(np.array([fit.spread for fit, _, _ in found])))), 2),
        "residual_deg": round(float(np.degrees(median(np.array([fit.residual for fit, _, _ in found])))), 6),
    }
    if len(path.time) > 4:
        middle = np.arange(1, len(path.time) - 1)
        every = replace(path, time=path.time[::2], xyz=path.xyz[::2], velocity=path.velocity[::2], gap=np.inf)
        odd = middle[middle % 2 == 1]
        odd = odd[path.time[odd] < every.time[-1]]
        off = every.at(path.time[odd]) - path.xyz[odd]
        facts["smoothness_m"] = round(float(median(np.sqrt((off * off).sum(axis=1)))), 4)
    return tuple(facts.items())
