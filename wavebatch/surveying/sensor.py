"""Where the sensor of a strip was: from a trajectory file, from the strip's own rays, or from the flight's height."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.trajectory import Trajectory, solve_offset
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.ray_sample import Rays, sample_rays
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.files.trajectory_file import read_trajectory
from wavebatch.kernels.geometry.ray_convergence import SensorFit, fit_best, range_error, sensor_at

NODE_SECONDS = 0.5
"""Time between two positions that are estimated from rays."""

WIDER = (1, 2, 4)
"""Nodes before and after one whose rays take part in it; the next where a window says nothing."""

MOST_RAYS = 512
"""Of a window."""

MOST_NODES = 20_000

BEYOND = 0.25
"""Time for which a path goes straight on where its rays end [s]: not every point of a strip is looked at."""

MARGIN = 30.0
"""Of a trajectory that is kept before and after the strip [s]."""

LARGEST_ANGLE = np.radians(2.0)
"""Between the packets' rays and those from a trajectory: above it the trajectory is of another strip, clock or CRS."""

FOOT = 0.3048
"""[m]."""

HEIGHT_ERROR = 0.05
"""Of the range, relative, where only the height of the flight is known."""


@dataclass(frozen=True, slots=True)
class SensorRequest:
    """Where positions of the sensor are to come from; picklable."""

    trajectory: Path | None = None
    """A file; without it the strip's own rays."""
    crs: str | None = None
    """Of the strip, where it does not say so itself."""
    lever_arm: tuple[float, float, float] | None = None
    """Trajectory to scanner: forward, right, down [m]."""
    height: float | None = None
    """Above the ground, where rays say nothing [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorSource:
    """Positions of the sensor and where they come from; picklable."""

    kind: str
    """`trajectory`, `direction vectors`, `pairs of returns`, `flight height` or `none`."""
    trajectory: Trajectory | None = None
    height: float | None = None
    error: float = 0.0
    """Standard deviation of the distance to the sensor [m], of a trajectory by what the vectors say; 0 if unknown."""
    facts: tuple[tuple[str, Any], ...] = ()
    """What reports say beside."""

    def fill(self, block: WaveformBlock) -> WaveformBlock:
        """The block with the sensor's positions; as it is where nobody knows them."""
        if self.trajectory is not None:
            return replace(block, sensor=self.trajectory.at(block.gps_time))
        if self.height is None:
            return block
        down = -block.direction[:, 2:]
        # Waveforms begin above what they hit: the height is that above the lowest return of each packet.
        low = block.origin[:, 2].copy()
        if block.returns is not None:
            np.minimum.at(low, block.returns.waveform, block.returns.xyz[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            back = block.direction * ((low[:, None] + self.height - block.origin[:, 2:]) / down)
        return replace(block, sensor=np.where(down > 0, block.origin - back, np.nan))

    def describe(self) -> dict[str, Any]:
        """For reports."""
        known = self.kind != "none" and self.error > 0
        return {"source": self.kind, "range_error_m": round(self.error, 6) if known else None, **dict(self.facts)}


NOBODY = SensorSource("none")


def find_sensor(reader: StripReader, scan: StripScan, request: SensorRequest) -> SensorSource:
    """Where the sensor of a strip was. Depends on nothing but the strip and the request.

    Raises InputError where a trajectory cannot be read, does not overlap, or contradicts the packets' vectors, and for
    strips in degrees, feet or geocentric coordinates.
    """
    refuse_units(reader, scan)
    vectors, pairs = sample_rays(reader, scan)
    if request.trajectory is not None:
        return _from_file(reader, vectors, request)
    for kind, rays in (("direction vectors", vectors), ("pairs of returns", pairs)):
        found = estimate_path(rays, kind)
        if found is not None:
            return found
    if request.height is not None:
        error, facts = HEIGHT_ERROR * request.height, (("distance_m", request.height),)
        return SensorSource("flight height", height=request.height, error=error, facts=facts)
    return NOBODY


def refuse_units(reader: StripReader, scan: StripScan) -> None:
    """Raises InputError where coordinates are no metres, or nobody can be sure that they are."""
    path, units, ratio = reader.facts.path, reader.facts.units, scan.vector_ratio
    remedy = "project the strip to metres, or leave out the stages that measure in metres"
    for said in units:
        if not said.is_metric:
            what = f"coordinates are {said.describe()}, in which nothing has a range in metres"
            raise InputError(f"{path}: {what}: {remedy}")
    if abs(ratio * FOOT - 1.0) < 0.05:
        raise InputError(
            f"{path}: packet vectors are {ratio:.3f} times c/2 long, as they are in feet, though no CRS of the strip "
            f"says that its coordinates are: {remedy}"
        )


def _from_file(reader: StripReader, rays: Rays, request: SensorRequest) -> SensorSource:
    crs = request.crs or (reader.facts.crs if (reader.facts.crs or "").endswith("]") else None)
    known = read_trajectory(request.trajectory, crs=crs, lever_arm=request.lever_arm)
    if not len(rays.time):
        return SensorSource("trajectory", known, facts=(("file", request.trajectory.name),))
    start, stop = float(rays.time[0]), float(rays.time[-1])
    try:
        offset, clocks = solve_offset(known, start, stop)
        known = known.shifted(offset).between(start - MARGIN, stop + MARGIN)
        angle = _disagreement(known, rays)
    except InputError as error:
        raise InputError(f"{request.trajectory}: {error}") from error
    share = known.share_known(start, stop)
    off, error, sure = _compare_ranges(known, rays)
    facts = {
        "file": request.trajectory.name,
        "clocks": clocks,
        "offset_s": offset,
        "share_covered": round(share, 6),
        "gaps_s": [[round(a, 3), round(b, 3)] for a, b in known.gaps(start, stop)[:20]],
        "angle_to_packet_vectors_deg": round(float(np.degrees(angle)), 4),
        "distance_m": _median_distance(known, rays),
        "farther_than_by_vectors_m": off,
        "by_vectors_error_m": sure,
    }
    return SensorSource("trajectory", known, error=error, facts=tuple(facts.items()))


def _compare_ranges(known: Trajectory, rays: Rays) -> tuple[float | None, float, float | None]:
    """By how much ranges from a trajectory are longer than those from the packets' vectors [m]: median, root mean
    square, and the error of the latter; None, 0 and None where vectors do not tell."""
    path = estimate_path(rays, "direction vectors")
    if path is None:
        return None, 0.0, None
    lengths = [rays.point - where.at(rays.time) for where in (known, path.trajectory)]
    longer = np.sqrt((lengths[0] ** 2).sum(axis=1)) - np.sqrt((lengths[1] ** 2).sum(axis=1))
    longer = longer[np.isfinite(longer)]
    if not len(longer):
        return None, 0.0, None
    return round(float(np.median(longer)), 3), float(np.sqrt(np.mean(longer**2))), round(path.error, 6)


def _median_distance(known: Trajectory, rays: Rays) -> float | None:
    off = rays.point - known.at(rays.time)
    distance = np.sqrt((off * off).sum(axis=1))
    distance = distance[np.isfinite(distance)]
    return round(float(np.median(distance)), 2) if len(distance) else None


def _disagreement(known: Trajectory, rays: Rays) -> float:
    """Median angle between the packets' rays and those from the trajectory [rad]; InputError where it is too large."""
    ahead = rays.point - known.at(rays.time)
    with np.errstate(all="ignore"):
        ahead /= np.sqrt((ahead * ahead).sum(axis=1))[:, None]
        unit = rays.direction / np.sqrt((rays.direction**2).sum(axis=1))[:, None]
        cosine = np.clip(np.einsum("ni,ni->n", ahead, unit), -1.0, 1.0)
    cosine = cosine[np.isfinite(cosine)]
    if not len(cosine):
        return 0.0
    angle = float(np.median(np.arccos(cosine)))
    if angle > LARGEST_ANGLE:
        raise InputError(
            f"the trajectory's rays are {np.degrees(angle):.1f} degrees off the packets' vectors: it is of another "
            "strip, in another CRS, or its clock is off by seconds (UTC is behind GPS time by 18)"
        )
    return angle


def estimate_path(rays: Rays, kind: str) -> SensorSource | None:
    """The sensor's path from where its rays come together, in windows along the flight; None where they do not."""
    if not len(rays.time) or rays.time[0] == rays.time[-1]:
        return None
    origin = rays.time[0]
    cells = np.floor((rays.time - origin) / NODE_SECONDS)
    nodes = np.unique(cells)
    if len(nodes) > MOST_NODES:
        return None
    found: list[tuple[SensorFit, np.ndarray, np.ndarray]] = []
    for node in nodes.tolist():
        fit, low, high = _fit_window(rays, cells, node)
        if fit is not None:
            times = _node_times(nodes, node, low, high, origin + (node + 0.5) * NODE_SECONDS)
            found.append((fit, times, np.clip(times, low, high)))
    if not found:
        return None
    time, inside = (np.concatenate([part[i] for part in found]) for i in (1, 2))
    placed = [sensor_at(fit, within) for fit, _, within in found]
    xyz, velocity = (np.concatenate([part[i] for part in placed]) for i in (0, 1))
    xyz += velocity * (time - inside)[:, None]
    path = Trajectory.build(time, xyz, velocity, gap=(max(WIDER) + 1) * NODE_SECONDS)
    return SensorSource(kind, path, error=_overall_error(found, rays), facts=_describe(found, path, rays))


def _fit_window(rays: Rays, cells: np.ndarray, node: float) -> tuple[SensorFit | None, float, float]:
    """The fit around a node from the smallest window that says something, and the time of the node's own rays."""
    own = np.searchsorted(cells, [node, node + 1])
    low, high = float(rays.time[own[0]]), float(rays.time[own[1] - 1])
    for reach in WIDER:
        start, stop = np.searchsorted(cells, [node - reach, node + reach + 1])
        rows = np.arange(start, stop, max(1, (stop - start) // MOST_RAYS))
        fit = fit_best(rays.time[rows], rays.point[rows], rays.direction[rows], rays.weight[rows])
        if fit is not None:
            return fit, low, high
    return None, low, high


def _node_times(nodes: np.ndarray, node: float, low: float, high: float, middle: float) -> np.ndarray:
    """Times at which a node's fit is used: its middle, and beyond the ends of its rays where no node is beside it."""
    times = [middle] if low <= middle <= high else [low, high]
    if not np.any(nodes == node - 1):
        times += [low - BEYOND, low]
    if not np.any(nodes == node + 1):
        times += [high, high + BEYOND]
    return np.unique(times)


def _overall_error(found: list[tuple[SensorFit, np.ndarray, np.ndarray]], rays: Rays) -> float:
    """Root mean square of the range's error over all windows [m]."""
    squares = []
    for fit, _, within in found:
        near = np.abs(rays.time - fit.centre) <= fit.half
        direction = rays.direction[near][:64]
        direction = direction / np.sqrt((direction**2).sum(axis=1))[:, None]
        at = np.full(len(direction), within[len(within) // 2])
        squares.append(np.mean(range_error(fit, at, direction) ** 2))
    return float(np.sqrt(np.mean(squares)))


def _describe(
    found: list[tuple[SensorFit, np.ndarray, np.ndarray]], path: Trajectory, rays: Rays
) -> tuple[tuple[str, Any], ...]:
    """Height, speed, heading and smoothness of a path, for whoever reads the report."""
    speed = np.sqrt((path.velocity**2).sum(axis=1))
    east, north, _ = np.median(path.velocity, axis=0)
    facts: dict[str, Any] = {
        "windows": len(found),
        "height_m": round(float(np.median(path.xyz[:, 2]) - np.median(rays.point[:, 2])), 2),
        "distance_m": round(float(np.median([fit.distance for fit, _, _ in found])), 2),
        "speed_m_s": round(float(np.median(speed)), 2),
        "heading_deg": round(float(np.degrees(np.arctan2(east, north)) % 360), 1),
        "view_deg": round(float(np.degrees(np.median([fit.spread for fit, _, _ in found]))), 2),
        "residual_deg": round(float(np.degrees(np.median([fit.residual for fit, _, _ in found]))), 6),
    }
    if len(path.time) > 4:
        middle = np.arange(1, len(path.time) - 1)
        every = replace(path, time=path.time[::2], xyz=path.xyz[::2], velocity=path.velocity[::2], gap=np.inf)
        odd = middle[middle % 2 == 1]
        odd = odd[path.time[odd] < every.time[-1]]
        off = every.at(path.time[odd]) - path.xyz[odd]
        facts["smoothness_m"] = round(float(np.median(np.sqrt((off * off).sum(axis=1)))), 4)
    return tuple(facts.items())
