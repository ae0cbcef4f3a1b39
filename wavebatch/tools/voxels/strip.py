"""A strip to voxels: every pulse is deconvolved and added to the grid, then the grid is written in order.

`wavebatch voxelize` calls `voxelize_strip`. Memory does not grow with the strip: sums beyond a limit lie on disk. The
output must not depend on batches, so nothing here may mix pulses of a batch.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import MISSING, asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from wavebatch import __version__
from wavebatch.batch.job import StripJob
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import even_places
from wavebatch.core.schema import Above, CheckedOptions, Range, option
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, count
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.disk.publish import Draft, protecting, refuse_existing
from wavebatch.files.disk.temp_store import ROWS_IN_MEMORY
from wavebatch.files.las.header import locate, split_numbers
from wavebatch.files.pulse_energy import PulseEnergy
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.geometry.voxels import fits_keys, pack_index
from wavebatch.kernels.physics.gap_probability import HIGHEST_RATIO, LOWEST_RATIO
from wavebatch.kernels.physics.radiometry import backscatter_error
from wavebatch.surveying.flat_ground import sample_reference
from wavebatch.surveying.inspect_strip import name_gains
from wavebatch.surveying.prepare import Positions, prepare
from wavebatch.surveying.sensor import SensorSource, judge_scale
from wavebatch.surveying.systems.figures import describe_system
from wavebatch.tools.voxels import grid as voxel_grid
from wavebatch.tools.voxels import rays

LARGEST_VOXEL = 1e6
"""Largest voxel [m]."""

SAMPLED_PULSES = 4096
"""Pulses from which the reflectance ratio is estimated."""

WIDE = 1.0
"""Of footprints whose beam is not known [m]: most are smaller."""

TOO_WIDE = 2.5
"""Of footprints from which crowns of 3 to 6 m cannot be told from even layers [m] (docs/forest.md)."""

_SAMPLED_UNITS = 16
"""Units that they are read from."""

_SAMPLED = 2048
"""Waveforms from which the middle and the extent of the strip are found."""
_MOST_FITTING = 0.9
"""Share of the sampled rays that must fit the grid; fewer mean damaged coordinates or too small voxels."""

MOST_MISSING = 0.05
"""Share of the returns that may be missing from a file, or of the pulses that may be found in parts: the border of a
tile cuts fewer, thinning and sorting more."""


USUAL_HEIGHT = 30.0
"""Of what rays cross above the ground [m], by which as many voxels are summed at a time as memory shall hold."""

USUAL = 1000.0
"""Distance [m] for the error of the air where that of the strip is not known."""


@frozen
class VoxelOptions(CheckedOptions):
    """How a strip becomes voxels."""

    size: Annotated[float, Above(0.0, LARGEST_VOXEL)] = option(
        MISSING, "Edge of a voxel [m]; the faces of voxels lie at multiples of it.", form="M"
    )
    deconvolution: rays.Deconvolution = field(default_factory=rays.Deconvolution)
    headroom: Annotated[float | None, Range(0.0, 1e5)] = option(
        None, "Count each ray from this distance before its first sample [m], whether recorded or not.", form="M",
        unset="from the highest return near it",
    )  # fmt: skip
    all_crossed: bool = option(False, "Also write voxels that rays crossed without any signal.")
    forest: bool = option(False, "Also write what `grid --forest` needs: all voxels that rays crossed, with height, "
                          "ground and attenuation.")  # fmt: skip
    ground_height: Annotated[float, Range(0.0, 100.0)] = option(
        0.5, "Height above the lowest returns up to which signal counts as ground [m].", form="M"
    )
    reflectance_ratio: Annotated[float | None, Range(LOWEST_RATIO, HIGHEST_RATIO)] = option(
        None, "Reflectance of the canopy over that of the ground.", form="RATIO", unset="estimated from the strip"
    )


@dataclass(slots=True)
class VoxelSummary:
    """Counts and facts of a voxelized strip."""

    strip: str
    output: str
    method: str
    pulse_fwhm: float
    """Full width at half maximum of the Gaussian that is as wide as the system pulse [ns]."""
    noise: float
    """Noise of a sample [DN]."""
    sensor: str | None
    """Source of the sensor's positions; None without calibration."""
    cross_section_error: float | None
    """Relative standard deviation that all cross sections share; None without calibration."""
    warnings: tuple[str, ...]
    """Why cross sections may be less sure than the calibration says."""
    reflectance_ratio: float
    """Reflectance of canopy over that of ground, by which light is shared between them."""
    reflectance_ratio_err: float | None
    """Its standard deviation; None where it was given or assumed."""
    reflectance_ratio_source: str
    """`given`, `strip`, `assumed` (1, because the strip does not show it), or `no canopy`."""
    hidden_light: float | None
    """Most of a pulse's light that may hide between two of its packets: 5 % of the recorded packets have less."""
    size: float
    profiles: str | None
    """File with the profiles of single pulses."""
    profile_samples: int = 0
    """Samples with signal in that file."""
    voxels: int = 0
    shape: tuple[int, int, int] = (0, 0, 0)
    """Voxels along x, y and z of the smallest box around them."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Lower corner of that box [m]."""
    waveforms: int = 0
    """Packets with samples: a pulse has one or several."""
    pulses: int = 0
    several_packets: int = 0
    """Pulses of several packets; between them nothing was recorded, which counts as empty air."""
    lost_packets: int = 0
    """Pulses with a packet that is missing or broken: their light is known up to it, not beyond."""
    with_signal: int = 0
    """Pulses with signal."""
    anchored: int = 0
    """Pulses with signal placed by a return of each packet; the others are placed by the raw location."""
    clipped: int = 0
    """Pulses with samples at the digitizer's limit: their energy is too low."""
    outside: int = 0
    """Pulses left out: their position is not a number, or too far from all others."""
    unknown: int = 0
    """Pulses with signal of unknown cross section: channels without a constant, pulses without a sensor position."""
    left_out: int = 0
    """Waveforms of pulses without a return that meets the condition of --where; `waveforms` are the others."""
    energy: float = 0.0
    """[DN ns]."""

    def add(self, table: np.ndarray) -> None:
        """Counts the pulses of a table of rays."""
        self.waveforms += int(table["packets"].sum())
        self.pulses += len(table)
        found = {"with_signal": table["count"], "anchored": table["anchored"], "clipped": table["clipped"],
                 "several_packets": table["packets"] > 1, "lost_packets": table["known"] < np.inf}  # fmt: skip
        for name, has in found.items():
            setattr(self, name, getattr(self, name) + int(np.count_nonzero(has)))


def voxelize_strip(
    job: StripJob,
    target: Path,
    options: VoxelOptions,
    *,
    overwrite: bool = False,
    profiles: Path | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
    block_size: int | None = None,
    in_memory: int = ROWS_IN_MEMORY,
) -> VoxelSummary:
    """Deconvolves the waveforms of a strip and writes the sums of every voxel, in the format of the target's suffix.

    job: the strip, how it is read, its pulse, sensor and energies; a calibration for cross sections, where it or the
    survey must have the divergence of the beam; only pulses of which it chooses a return are used, with all of their
    signal. profiles: an .npz for those of single pulses. progress: called with the number of waveforms done since the
    last call, and the total. block_size: packets at a time, in_memory: sums there; the output does not depend on them.
    Raises ConfigError for wrong options, InputError where the strip cannot be read or the output not be written.
    """
    strip, target, calibration = job.path, Path(target), job.calibration
    *others, last = voxel_grid.SUFFIXES
    if target.suffix.lower() not in (*others, last):
        raise ConfigError(f"{target}: voxels are written as {', '.join(others)} or {last}")
    with protecting([strip]):
        Draft(target, overwrite=True).discard()  # before the work: whether it can be written
    keep = None  # the filter for the points of the strip, where it leaves any out
    if job.selection:
        with CloudReader(strip) as cloud:
            keep = cloud.plan(job.selection)
    refuse_existing(target, overwrite)
    if profiles is not None and Path(profiles).absolute() == target.absolute():
        raise ConfigError(f"--profiles {profiles}: the voxels are written to this file; choose another name")
    with job.open() as reader, reader.scan(force=job.request.force) as scan:
        if not scan.packets:
            raise InputError(f"{strip}: holds no waveform to put into voxels; see `wavebatch check`")
        positions = Positions.IF_KNOWN if calibration is None else Positions.REQUIRED
        setup = prepare(reader, scan, job.chain, job.request, sensor=job.sensor, positions=positions,
                        calibration=calibration, energy=job.energy)  # fmt: skip
        source, pulse, energy = setup.sensor, setup.system.with_radiometry(sensor_error=0.0), setup.sent.energy
        doubts, section_error = (*setup.doubts, *(setup.sent.notes if calibration else ())), None
        doubts += judge_scale(reader, scan)
        if calibration is not None:
            if pulse.radiometry.divergence is None:
                raise ConfigError(
                    "--calibration: cross sections need the beam's divergence: add divergence_mrad to the calibration "
                    "or give a --system file that has it"
                )
            beam = sample_reference(reader, scan, source, pulse, setup.choice.survey.figures.spacing_ns or 0.0)
            doubts += tuple(filter(None, [source.doubt(), beam.doubt()]))
            # What all cross sections share: of constant, air, ranges and beam.
            light = setup.system.radiometry
            constant = max((error for _, error in light.channels.values()), default=light.constant_error)
            shared = backscatter_error(
                np.zeros(1), np.array([source.distance or USUAL]), light.sensor_error, constant, light.attenuation,
                power=4, attenuation_err=light.attenuation_error,
            )  # fmt: skip
            section_error = math.hypot(float(shared[0]), 2.0 * (beam.doubt_error() or light.divergence_error))
        middle = _find_middle(reader, scan, options)
        floor, ceiling, shown = rays.Floor(middle), rays.Ceiling(middle, options.size), np.zeros(256, np.int64)
        for begin, end in pairwise(scan.borders.tolist()):
            points = reader.read_points(begin, end)
            number, total = split_numbers(points)
            shown += np.bincount(16 * np.minimum(total, 15).astype(np.int64) + np.minimum(number, 15), minlength=256)
            xyz = locate(points, reader.facts.header)
            floor.add(xyz)
            ceiling.add(xyz)
        tracer = _Tracer(
            reader, source, pulse, options, floor.finish(), ceiling.finish(), energy, calibration is not None
        )
        footprint = 1e-3 * (pulse.radiometry.divergence or 0.0) * (source.distance or 0.0)
        if options.forest:
            doubts += (*_doubt_footprints(footprint, floor.steep, options.ground_height),)
        numbers = even_places(reader.unit_count(), _SAMPLED_UNITS)
        each = -(-SAMPLED_PULSES // max(len(numbers), 1))  # spread evenly over the strip
        batches = rays.read_batches(
            reader, scan, numbers=numbers.tolist(), choose=lambda rows: rows[even_places(len(rows), each)]
        )
        sample, louder, rng = [], [], np.random.default_rng(0)
        for batch in batches:
            sample.append(tracer.trace(batch))
            louder.append(tracer.trace(batch, rng))
        rule = rays.find_rule(sample, options.reflectance_ratio, louder)
        most_bits = max(digitizer.bits for digitizer in reader.facts.digitizers.values() if digitizer.n_samples)
        anchor = np.floor(middle / options.size).astype(np.int64)
        # Parts of the voxels, in their order, begin at some of the lowest returns, each of which stands for its cell.
        lowest = np.sort(pack_index(np.floor(floor.places / options.size).astype(np.int64) - anchor))
        cells = int(in_memory * options.size**3 / (USUAL_HEIGHT * floor.cell**2))
        with (
            voxel_grid.VoxelGrid(
                options.size, anchor, voxel_grid.energy_unit(most_bits),
                sections=calibration is not None, everything=options.all_crossed or options.forest,
                floor=tracer.floor if options.forest else None, borders=lowest[:: max(cells, 1)], in_memory=in_memory,
            ) as grid,
            (
                voxel_grid.ProfileWriter(Path(profiles), strip, sections=calibration is not None, overwrite=overwrite)
                if profiles is not None
                else nullcontext()
            ) as writer,
        ):
            summary = VoxelSummary(
                strip=str(strip), output=str(target), size=grid.size, method=options.deconvolution.method,
                pulse_fwhm=pulse.sigma_ref * FWHM_PER_SIGMA, noise=pulse.noise.std, warnings=doubts,
                sensor=None if calibration is None else source.kind, cross_section_error=section_error,
                reflectance_ratio=rule.ratio,
                reflectance_ratio_err=rule.error, reflectance_ratio_source=rule.source, hidden_light=rule.hidden_light,
                profiles=None if profiles is None else str(profiles),
            )  # fmt: skip
            for batch in rays.read_batches(reader, scan, keep=keep, block_size=block_size):
                traced = tracer.trace(batch)
                grid.add(traced, rule)
                if writer is not None:
                    writer.add_rays(traced)
                summary.add(traced.table)
                progress(sum(len(rows) for _, rows, *_ in batch.parts), scan.packets)
            grid.measure_spread()
            summary.left_out = 0 if keep is None else scan.packets - summary.waveforms
            meta = _describe(job, options, grid, pulse) | {
                "reflectance_ratio": {"ratio": rule.ratio, "error": rule.error, "source": rule.source},
                "hidden_light": rule.hidden_light,
                "cross_section_error": section_error,
                "footprint_m": footprint or None,
            }
            meta["pulse_energy"] = None if energy is None else energy.describe()
            space = voxel_grid.VoxelSpace(grid.columns, reader.facts, grid.low * grid.size, grid.size, meta)
            # Profiles and voxels, or neither.
            others = []
            if writer is not None:
                known = {name: value for name, value in meta.items() if name not in ("size_m", "headroom_m")}
                text = json.dumps({**known, "columns": writer.meanings}, sort_keys=True)
                others.append(writer.complete({"crs": space.facts.crs or "", "meta": text}))
            write = voxel_grid.write_npz if target.suffix.lower() == ".npz" else voxel_grid.write_las
            summary.voxels = write(target, space, grid.pieces(rule.log_error), others, overwrite)
            summary.profile_samples = 0 if writer is None else writer.samples
            summary.shape, summary.origin = tuple(grid.shape.tolist()), tuple((grid.low * grid.size).tolist())
            summary.outside, summary.energy, summary.unknown = grid.outside, grid.energy, grid.unknown
            if calibration is None:
                summary.warnings += (*name_gains(reader.facts, scan),)
            summary.warnings += (*reader.facts.warnings, *scan.doubts)
            if scan.broken:
                lost = f"packets of {count(scan.broken, 'point')} cannot be used; `wavebatch check` says why"
                summary.warnings += (lost,)
            # Where returns share packets, and no pulse has several, those that are left hold all light.
            split = summary.several_packets > 0 or scan.with_waveform == scan.packets
            summary.warnings += (*_doubt_returns(shown.reshape(16, 16), summary.pulses, split),)
            return summary


def _doubt_footprints(footprint: float, steep: float, ground_height: float) -> Iterator[str]:
    """Say that footprints [m], 0 where not known, are too wide for the slope (rise per metre) or for the crowns."""
    assumed, wide = "" if footprint else " (assumed, as beam or range are not known)", footprint or WIDE
    # Half of it rises to the edge of a footprint; the planes are not known better than to the other half.
    if wide * steep > ground_height:
        yield (
            f"on slopes of {math.degrees(math.atan(steep)):.0f} degrees, ground in footprints of {wide:.2g} m{assumed} "
            f"reaches above --ground-height {ground_height:g} and counts as plants, so that cover and leaf area are "
            f"too large: give --ground-height {ground_height + 0.5 * wide * steep:.1f}"
        )
    if not 0.0 < footprint < TOO_WIDE:
        which = f"of {footprint:.2g} m" if footprint else "of unknown width (give --system with divergence_mrad)"
        yield (
            f"leaf areas: footprints {which} do not show narrower gaps between leaves: where crowns are no wider, leaf "
            "areas are too small by more than their errors"
        )


def _doubt_returns(shown: np.ndarray, found: int, split: bool) -> Iterator[str]:
    """Say that returns are missing from the file, or stand too far apart to be found as a pulse.

    shown: points by number of returns and return number, i8 (16, 16); found: pulses; split: they may have several
    packets.
    """
    kinds = [shown[n, 1 : n + 1] for n in range(1, 16)]
    there, pulses = int(shown.sum()), sum(int(kind.max()) for kind in kinds)
    missing = sum(int(len(kind) * kind.max() - kind.sum()) for kind in kinds)
    last = sum(int(kind.max() - kind[-1]) for kind in kinds)
    if split and missing > MOST_MISSING * (there + missing):
        yield (
            f"{missing} of {there + missing} returns that the points' numbers of returns count are not in the file: "
            "where returns of a pulse have packets of their own, the light of these is missing, and shares are wrong; "
            "take the whole strip"
        )
    elif last > MOST_MISSING * pulses:
        yield (
            f"the last returns of {last} of {pulses} pulses are not in the file: what is left is taken for the ground, "
            "so that heights and shares are wrong; take the whole strip"
        )
    if found > (1.0 + MOST_MISSING) * pulses > 0:
        yield (
            f"{found} pulses are found where the points' return numbers count {pulses}: packets of a pulse stand far "
            "apart in the file, and count as pulses of their own, or points were thinned out, which keeps more pulses "
            "of many returns; shares are wrong: take the whole strip, sorted by GPS time"
        )


FINEST = 0.01
"""Smallest voxel, over the way of light between two samples: fits of the strongest echoes place them no better."""


def _find_middle(reader: StripReader, scan: StripScan, options: VoxelOptions) -> np.ndarray:
    """A position in the middle of the strip, f8 (3,) [m]; ConfigError where the voxels are too small for the strip."""
    path, size = reader.facts.path, options.size
    for unit in reader.facts.units:
        if not unit.is_metric:
            raise InputError(f"{path}: coordinates are {unit.describe()}; voxels need metres: project the strip")
    blocks = list(reader.sample_blocks(scan, _SAMPLED))
    start = np.concatenate([block.origin for block in blocks])
    step = np.concatenate([block.direction for block in blocks])
    end = np.concatenate([np.full(len(block), block.samples.shape[1] * block.spacing) for block in blocks])
    known = np.isfinite(start).all(axis=1)
    middle = np.median(start[known], axis=0) if known.any() else np.zeros(3)
    begin = np.full(len(end), -(options.headroom or 0.0) / HALF_C)
    while np.mean(fits_keys(start - middle, step, begin, end, size)) < _MOST_FITTING:
        size *= 2
        if size > LARGEST_VOXEL:
            raise InputError(
                f"{path}: its coordinates are spread over more than a grid can hold; see `wavebatch check`"
            )
    if size > options.size:
        raise ConfigError(f"--size {options.size:g}: too small for the extent of this strip; take {size:g} m or more")
    finest = FINEST * HALF_C * min(block.spacing for block in blocks)
    if options.size < finest:
        raise ConfigError(
            f"--size {options.size:g}: below a hundredth of the way between two samples, where nothing more is seen, "
            f"but hours and disks are filled; take {finest:.2g} m or more"
        )
    return middle


@frozen
class _Tracer:
    """What turns the packets of a strip into rays."""

    reader: StripReader
    sensor: SensorSource
    pulse: SystemPulse
    options: VoxelOptions
    floor: rays.Floor
    ceiling: rays.Ceiling
    energy: PulseEnergy | None
    sections: bool

    def trace(self, batch: rays.Batch, louder: np.random.Generator | None = None) -> rays.Rays:
        """The rays of the pulses of a batch that `--where` keeps; louder: as for `rays.deconvolve_block`."""
        packets, samples = [np.empty(0, rays.PACKET)], [np.empty(0, rays.SAMPLE)]
        number = 0
        for unit, rows, groups, kept in batch.parts:
            place = np.zeros(len(unit.packets), np.int64)
            place[rows] = np.arange(len(rows))
            for block, index in self.reader.read_rows(unit, rows, max(len(rows), 1)):
                block = self.sensor.fill(block if self.energy is None else self.energy.fill(block, unit))
                profiles = rays.deconvolve_block(block, self.pulse, self.options.deconvolution, louder)
                if block.pulse_energy is not None:
                    known = np.isfinite(block.pulse_energy)
                    scale = np.where(known, block.pulse_energy, 1.0)[:, None]
                    profiles = replace(profiles, value=profiles.value / scale)
                system = self.pulse if self.sections else None
                at = place[index]
                found = rays.list_signal(block, profiles, groups[at], self.floor, self.options.ground_height, system)
                found[0]["kept"] = kept[at]
                found[1]["packet"] += number
                number += len(block)
                packets.append(found[0])
                samples.append(found[1])
        traced = rays.join_packets(np.concatenate(packets), np.concatenate(samples), batch.lost)
        traced = traced.take(traced.table["kept"])
        headroom = self.options.headroom
        if headroom is None:
            headroom = self.ceiling.measure_headroom(traced.table["start"], traced.table["step"])
        with np.errstate(divide="ignore", invalid="ignore"):
            traced.table["begin"] -= headroom / rays.measure_lengths(traced.table["step"])
        return traced


def _describe(
    job: StripJob, options: VoxelOptions, grid: voxel_grid.VoxelGrid, pulse: SystemPulse
) -> dict[str, Any]:
    """How the voxels were made; goes into the file, so it holds no time of day."""
    deconvolution = options.deconvolution
    return {
        "wavebatch": __version__,
        "command": f"wavebatch voxelize {job.path.name} --size {options.size:g}{' --forest' * options.forest}",
        "strip": job.path.name,
        "size_m": options.size,
        "headroom_m": options.headroom,
        "all_crossed": options.all_crossed or options.forest,
        "forest": options.forest,
        "ground_height_m": options.ground_height,
        "where": None if job.selection.where is None else job.selection.where.text,
        "deconvolution": asdict(deconvolution) | {"iterations": deconvolution.steps},
        "system": describe_system(pulse),
        "calibration": None if job.calibration is None else job.calibration.describe(),
        "columns": {column.name: {"unit": column.unit, "meaning": column.meaning} for column in grid.columns},
    }
