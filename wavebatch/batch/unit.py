"""The work in a worker process: prepare a strip, take one of its units from packets to output rows, compress rows.

`strip_task` submits `prepare_strip` once per strip and `process_unit` for each unit. It gives `Packing` the rows of the
units in order: rows become the LAZ chunks of a cloud, cut after every 50,000 rows wherever the units end. Workers
compress each chunk as soon as its rows are there (`pack_chunk`), so rows never reach the process that writes.
Before you change it: all that travels between processes must be picklable, and rows must not depend on block size.
"""

from __future__ import annotations

import functools
import pickle
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.batch.counts import LEFT_OUT, RunReport, count_flags
from wavebatch.batch.job import RowColumn, StripJob, UnitRows, plan_filter, plan_layout
from wavebatch.batch.output_rows import (
    Assembled,
    UnitEchoes,
    assemble_echoes,
    assemble_returns,
    find_shared,
    gather_echoes,
)
from wavebatch.core.echoes import NoData
from wavebatch.core.errors import InputError, StripWarning
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.process import Seconds
from wavebatch.core.units import ASSUMED_DIVERGENCE, INSET
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.cloud.point_filter import TESTS, PlannedFilter
from wavebatch.files.cloud.writer import OutputLayout
from wavebatch.files.disk.raw_bytes import join_records, naming, undoing
from wavebatch.files.disk.temp_store import Spool, spool_rows
from wavebatch.files.las.header import split_numbers
from wavebatch.files.las.write_points import CHUNK_POINTS, Chunk, Statistics, compress_rows
from wavebatch.files.pulse_energy import PulseEnergy
from wavebatch.files.strip.reader import StripFacts, StripReader, StripScan, Unit
from wavebatch.files.strip.scanner import ScanPart
from wavebatch.kernels.geometry.normals import find_edges
from wavebatch.stages.attribute.radiometry import REFLECTANCES, hide_values
from wavebatch.stages.chain import Solved, Step
from wavebatch.surveying import flat_ground
from wavebatch.surveying.calibration import needs_sensor
from wavebatch.surveying.choose_chain import ChainChoice, try_chain
from wavebatch.surveying.matching.setting import doubt_zone
from wavebatch.surveying.prepare import prepare
from wavebatch.surveying.sensor import UNKNOWN, SensorSource, judge_scale, refuse_units

SolvedBlocks = list[tuple[np.ndarray, Solved]]
"""Per block of a unit: row of unit.packets of each waveform, i8 (n,), and what the chain found, without the samples."""

BLOCK_SAMPLES = 1 << 22
"""Samples of a block by default: a unit of 50,000 waveforms of 80. Smaller blocks are slower: NumPy's cost per call."""

USUAL_SAMPLES = 256
"""Waveforms of more samples than this count several times where --block-size is given."""

LEVEL = "level_reflectance"
"""The column that is computed before edges are known."""

STEEP = 80.0
"""Largest slope that the error of a level reflectance holds [deg]."""

LARGEST_HEIGHT_ERROR = 0.3
"""Largest logarithm of the ratio of two flight heights: a user knows the one planned, not that above each hill."""


@frozen(eq=False)
class Prepared:
    """Everything that the units of a strip share; picklable."""

    job: StripJob
    """With the chosen chain and the columns that it computes."""
    facts: StripFacts
    scan: StripScan
    units: int
    choice: ChainChoice
    layout: OutputLayout
    selection: PlannedFilter
    """Chooses the rows that are written, from UnitRows."""
    report: RunReport
    """Timing of the preparation, and how many points have lost their packets."""
    sensor: SensorSource = UNKNOWN
    stranger: str = ""
    """Why the strip does not belong to its flight and was surveyed alone; empty where it does."""
    pulse_energy: PulseEnergy | None = None
    doubts: tuple[StripWarning, ...] = ()
    """Warnings about inputs that do not quite fit the strip, such as its calibration or the beam's divergence."""
    forced: str = ""
    """What contradicts the saved survey with which the strip is run, by --force or in doubt; empty for nothing."""

    @property
    def system(self) -> SystemPulse:
        """The pulse that the strip is run with, its calibration, and the error of the sensor's position."""
        return self.job.calibrate(self.sensor.place(self.choice.survey.system))

    @property
    def second_step(self) -> Step | None:
        """The step whose columns need a second pass over the strip's points; None where nothing wanted needs them."""
        chain, step = self.job.chain, self.job.chain.second_step
        made = {name for one in (step, *chain.after_second) if one is not None for name in one.stage.makes}
        return None if made.isdisjoint([*self.job.columns, *self.needed]) else step

    @property
    def needed(self) -> tuple[str, ...]:
        """The computed columns that decide which rows are written."""
        columns = [one for one in self.selection.columns.values() if isinstance(one, RowColumn)]
        return tuple(one.name for one in columns if one.kind == "computed")


class UnitResult(NamedTuple):
    """What a unit becomes."""

    rows: Spool
    """Those that are written and not yet compressed, in the cloud's layout."""
    statistics: Statistics
    """Of all rows that are written."""
    report: RunReport
    chunks: Sequence[Chunk] = ()
    """Of LAZ: the only unit of a strip is compressed at once."""


def scan_run(job: StripJob, first: int, last: int) -> tuple[ScanPart, Seconds]:
    """Scan some units of a strip; what was found, and the time that it took. Raises InputError as the scan."""
    start = Seconds.now()
    with job.open() as reader:
        part = reader.scan_units(first, last)
    return part, Seconds.now() - start


def prepare_strip(job: StripJob, parts: Sequence[ScanPart] = ()) -> Prepared:
    """Scan and survey a strip, choose its chain, find the sensor, and plan its output.

    Parameters
    ----------
    job : StripJob
    parts : sequence of ScanPart
        From `scan_run`, all units in order; none where this process scans them.

    Returns
    -------
    Prepared
        Its scan holds temporary files: close it.

    Raises
    ------
    InputError
        Where the strip cannot be processed.
    ConfigError
        Where no chain meets the tolerance, or columns or format do not fit the strip.
    """
    start = Seconds.now()
    with job.open() as reader:
        facts = reader.facts
        scan = reader.scan(force=job.request.force, parts=parts)
        with undoing(scan.close):
            scanned = Seconds.now()
            setup = prepare(reader, scan, job.chain, job.request, sensor=job.sensor, calibration=job.calibration,
                            air=job.attenuation and job.attenuation[0], energy=job.energy,
                            extend=job.extend)  # fmt: skip
            sensor, doubts = setup.sensor, StripWarning.of("calibration", setup.doubts)
            if setup.stranger:
                job = replace(job, request=replace(job.request, system=None))
            choice = try_chain(reader, scan, setup.choice, job.request)
            # Without the columns that the widest chain computes and the chosen one does not.
            lost = set(job.chain.makes) - set(choice.chain.makes)
            columns = tuple(name for name in job.columns if name not in lost)
            job = replace(job, chain=choice.chain, columns=columns, calibration=setup.calibration)
            surveyed = Seconds.now()
            if job.chain.second_step is not None:
                refuse_units(reader, scan)
            if job.calibration is None and needs_sensor(job.chain):
                doubts += StripWarning.of("zone", doubt_zone(reader, scan, sensor))
            if job.options.points == "echoes":
                doubts += StripWarning.of("units", judge_scale(reader, scan))
            # A flight height that contradicts the packet vectors, which are more exact and are used in its place.
            given, seen = job.sensor.height, dict(sensor.facts).get("height_m")
            off = 0.0 if given is None or sensor.height is not None or not seen else np.log(given / max(seen, 1e-9))
            if abs(off) > LARGEST_HEIGHT_ERROR:
                raise InputError(
                    f"{facts.path}: --flight-height {given:g} m contradicts the strip: by its {sensor.kind} the sensor "
                    f"flew {seen:.0f} m above the points; leave --flight-height out"
                )
            choice, more = _see_level(reader, scan, job, choice, sensor)
            doubts += StripWarning.of("beam", more)
            # The distance between the points decides a radius that is 0, and the strip's slopes the error of level
            # reflectances where no slope is given.
            steps = []
            for step in job.chain.steps:
                if step.stage.second_pass is not None and step.effective()["radius"] == 0:
                    radius = flat_ground.choose_radius(flat_ground.read_middle(reader, scan))
                    step = replace(step, parameters={**step.parameters, "radius": radius})
                elif step.stage.name == "attribute.level_reflectance" and not step.parameters:
                    slope = max(step.effective()["slope"], round(flat_ground.measure_slope(reader, scan), 1))
                    step = replace(step, parameters={"slope": min(slope, STEEP)})
                steps.append(step)
            job = replace(job, chain=replace(job.chain, steps=tuple(steps)))
            if job.calibration is not None or setup.sent.energy is not None or needs_sensor(job.chain):
                doubts += StripWarning.of("energy", setup.sent.notes)
            layout = plan_layout(job, facts)
            selection = plan_filter(job, layout)
            units = reader.unit_count()
    timing = {"scan": scanned - start, "survey": surveyed - scanned, "sensor": Seconds.now() - surveyed}
    report = RunReport(counts={"points_cut": scan.cut}, timing=timing)
    found = choice, layout, selection, report, sensor, setup.stranger, setup.sent.energy, doubts, setup.forced
    return Prepared(job, facts, scan, units, *found)


def _see_level(
    reader: StripReader, scan: StripScan, job: StripJob, choice: ChainChoice, sensor: SensorSource
) -> tuple[ChainChoice, tuple[str, ...]]:
    """The choice with the widths of surfaces that face the sensor, where angles are computed and no saved survey has
    them; and what is doubtful about the beam."""
    parameters = flat_ground.angle_parameters(job.chain)
    survey, figures = choice.survey, choice.survey.figures
    if parameters is None or sensor.kind == UNKNOWN.kind:
        return choice, ()
    used = job.calibrate(survey.system)
    divergence = parameters["divergence"] or used.radiometry.divergence
    used = used.with_radiometry(divergence=divergence)
    if job.request.system is not None and not job.request.flight and survey.system.widths.error is not None:
        beam = figures.divergence_seen_mrad
        seen = flat_ground.GroundReference(used, 0, beam, (figures.divergence_seen_error_mrad or 0.0) / (beam or 1.0))
    else:
        seen = flat_ground.sample_reference(reader, scan, sensor, used, figures.spacing_ns or 0.0)
    doubt, error = seen.doubt(), seen.doubt_error() or survey.system.radiometry.divergence_error
    system = _take_reference(survey.system, seen.system).with_radiometry(divergence_error=error)
    return replace(choice, survey=replace(survey, system=system)), (doubt,) if doubt else ()


def _take_reference(system: SystemPulse, seen: SystemPulse) -> SystemPulse:
    """The system with the reference of angles, one for each digitizer."""
    others = {index: _take_reference(other, seen.digitizers[index]) for index, other in system.digitizers.items()}
    return replace(system, digitizers=others, widths=seen.widths)


def process_unit(blob: bytes, number: int, block_size: int | None = None) -> UnitResult:
    """Make the output rows of one unit.

    Parameters
    ----------
    blob : bytes
        The pickled Prepared of the strip.
    number : int
        Of the unit.
    block_size : int, optional
        Waveforms that go through the chain at a time; the rows do not depend on it.

    Returns
    -------
    UnitResult
    """
    prepared: Prepared = unpack(blob)
    timing: dict[str, Seconds] = {}
    _, _, made = solve_unit(prepared, number, block_size, timing)
    return finish_rows(prepared, made.rows, made.columns, made.report, timing)


def finish_rows(
    prepared: Prepared,
    rows: np.ndarray,
    columns: Mapping[str, np.ndarray],
    report: RunReport,
    timing: dict[str, Seconds],
) -> UnitResult:
    """Choose the rows of a unit that are written.

    Parameters
    ----------
    prepared : Prepared
    rows : structured array (m,)
        All rows of the unit, in the cloud's layout.
    columns : mapping of str to array (m,)
        Those that the selection needs.
    report : RunReport
        Of the unit; it gets what the selection leaves out.
    timing : dict
        Seconds of every step so far; they become those of the report.

    Returns
    -------
    UnitResult
    """
    start = Seconds.now()
    codes = prepared.selection.test(UnitRows(rows, columns), len(rows))
    kept = codes == 0
    numbers = dict(zip(("", *TESTS), np.bincount(codes, minlength=len(TESTS) + 1).tolist(), strict=True))
    number, total = split_numbers(rows[codes == 1 + TESTS.index("where")])
    left = RunReport(
        counts={"points_out": numbers[""]},
        last_left_out=int(np.count_nonzero(number == total)),
        left_out={name: numbers[name] for name in LEFT_OUT if numbers[name]},
        flags=count_flags(columns["echo_flags"][kept]),
    )
    rows = rows if kept.all() else rows[kept]
    statistics = Statistics(rows.dtype, prepared.layout.extra_records)
    statistics.add(rows)
    timing["assemble"] = timing.get("assemble", Seconds()) + (Seconds.now() - start)
    chunks: list[Chunk] = []
    if prepared.units == 1 and prepared.job.options.format == "laz":
        start = Seconds.now()
        chunks, rows = pack_rows(prepared.job.path, rows, prepared.layout.point_format), rows[:0]
        timing["write"] = Seconds.now() - start
    return UnitResult(spool_rows(rows), statistics, replace(report + left, timing=timing), chunks)


def solve_unit(
    prepared: Prepared, number: int, block_size: int | None, timing: dict[str, Seconds]
) -> tuple[SolvedBlocks, UnitEchoes, Assembled]:
    """Run the chain on the packets of a unit and make all of its rows.

    Parameters
    ----------
    prepared : Prepared
    number, block_size
        As for `process_unit`.
    timing : dict
        Gets the seconds of every step.

    Returns
    -------
    solved : SolvedBlocks
    echoes : UnitEchoes
        The same echoes, by packet.
    made : Assembled
        With the columns that decide which rows are written.
    """
    start = Seconds.now()
    echoes_mode = prepared.job.options.points == "echoes"
    with StripReader(prepared.facts, unit_points=prepared.job.unit_points) as reader:
        unit = reader.read_unit(number, prepared.scan)
        timing["read points"] = Seconds.now() - start
        blocks = reader.read_blocks(unit, _block_size(unit, block_size), owned_only=echoes_mode)
        system, solved = prepared.system, []
        timing["read packets"] = Seconds()
        while True:
            start = Seconds.now()
            found = next(blocks, None)
            timing["read packets"] += Seconds.now() - start
            if found is None:
                break
            block, index = found
            placed = prepared.sensor.fill(block)
            if prepared.pulse_energy is not None:
                placed = prepared.pulse_energy.fill(placed, unit)
            solved.append((index, prepared.job.chain.solve(placed, system, timing).without_samples()))
            del found, block, placed  # else its samples would stay while the next one is read, and the rows are made
    start = Seconds.now()
    solved = _mark_edges(prepared, solved)
    echoes = gather_echoes(unit, ((block.block, index, block.echoes) for index, block in solved))
    layout, needed, angle = prepared.layout, prepared.needed, flat_ground.angle_parameters(prepared.job.chain)
    first = unit.packets.owner[unit.packets.owned] - unit.start
    # Packets of one time may be those of one pulse.
    if angle is not None and angle["alone"] and (np.diff(unit.points["gps_time"][first]) <= 0.0).any():
        shared = find_shared(unit, echoes, layout.source.header)
        table = hide_values(echoes.table, "incidence_angle", shared, NoData.SHARED_PULSE)
        echoes = replace(echoes, table=table)
    if echoes_mode:
        made = assemble_echoes(unit, echoes, layout, needed, prepared.job.selection.drop_flags)
    else:
        made = assemble_returns(unit, echoes, layout, needed)
    timing["assemble"] = Seconds.now() - start
    return solved, echoes, made


def _mark_edges(prepared: Prepared, solved: SolvedBlocks) -> SolvedBlocks:
    """The blocks whose echoes have the attribute `edge`, bool: beside them lies a surface outside of their packets; and
    no level reflectance there. Other reflectances see it after the second pass."""
    distance = prepared.sensor.distance
    if not solved or distance is None or set(REFLECTANCES).isdisjoint(prepared.job.chain.makes):
        return solved
    parts = []
    for block, _, system, echoes in (solution for _, solution in solved):
        way = block.direction[echoes.waveform]
        speed = np.sqrt((way * way).sum(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            ray = way / speed[:, None]
        place = np.stack([echoes.attributes[axis] for axis in "xyz"], axis=1)
        rest = block.digitizer.n_samples * block.spacing - echoes.time - 2.0 * system.sigma_ref
        parts.append((place, ray, block.gps_time[echoes.waveform], echoes.time * speed, rest * speed))
    beam = 0.5e-3 * (prepared.system.radiometry.divergence or ASSUMED_DIVERGENCE)
    # In the order of packets: blocks of several digitizers come in another one with blocks of another size.
    order = np.argsort(np.concatenate([index[block.echoes.waveform] for index, block in solved]), kind="stable")
    edge = np.empty(len(order), bool)
    place, ray, time, before, after = (np.concatenate(values)[order] for values in zip(*parts, strict=True))
    edge[order] = find_edges(place, ray, time, before, after, INSET * beam * distance)
    ends = np.cumsum([len(block.echoes) for _, block in solved])
    return [
        (index, block._replace(echoes=hide_values(block.echoes.with_attributes(edge=part), LEVEL, part, NoData.EDGE)))
        for (index, block), part in zip(solved, np.split(edge, ends[:-1]), strict=True)
    ]


@functools.lru_cache(maxsize=4)
def unpack(blob: bytes) -> Any:
    """Unpickle a blob, once per process while its strip is under way."""
    return pickle.loads(blob)


def _block_size(unit: Unit, wanted: int | None) -> int:
    """Waveforms of a block: as many as wanted, but fewer long ones, so that memory stays bounded."""
    longest = int(unit.packets.n_samples.max(initial=1))
    most = max(min(BLOCK_SAMPLES // longest, 65536), 1)
    return most if wanted is None else min(most, max(wanted * USUAL_SAMPLES // longest, 1), wanted)


RowSpan = tuple[Spool, int, int]
"""Rows [start, stop) of a unit."""


class Packing:
    """The rows of one strip that are not written yet: `add` those of all units in order, `take` a chunk when it may."""

    def __init__(self) -> None:
        self._parts: deque[RowSpan] = deque()
        self._count = 0
        """Rows that are in no chunk yet."""
        self._open: deque[list[Spool]] = deque()
        """Of every chunk under way, the units that end in it."""

    def add(self, rows: Spool) -> None:
        """Take the rows of the next unit."""
        self._parts.append((rows, 0, rows.count))
        self._count += rows.count

    def has_chunk(self, last: bool) -> bool:
        """Whether there are rows for a chunk; last: no further units come."""
        return self._count >= (1 if last else CHUNK_POINTS)

    @property
    def is_empty(self) -> bool:
        """Whether all rows are written."""
        return not self._count + len(self._open)

    def next_chunk(self) -> list[RowSpan]:
        """Return the rows of the next chunk, for `pack_chunk`."""
        parts, ended, left = [], [], min(self._count, CHUNK_POINTS)
        self._count -= left
        while left:
            rows, start, stop = self._parts.popleft()
            end = min(stop, start + left)
            parts.append((rows, start, end))
            left -= end - start
            if end < stop:
                self._parts.appendleft((rows, end, stop))
            else:
                ended.append(rows)
        self._open.append(ended)
        return parts

    def end_chunk(self) -> None:
        """The oldest chunk under way is written: remove the files of its rows."""
        for rows in self._open.popleft():
            rows.close()

    def close(self) -> None:
        """Remove all files; harmless twice."""
        for rows in [*(rows for ended in self._open for rows in ended), *(rows for rows, _, _ in self._parts)]:
            rows.close()


def pack_chunk(path: Path, parts: list[RowSpan], point_format: int) -> tuple[Chunk, Seconds]:
    """Compress the rows of one LAZ chunk.

    Parameters
    ----------
    path : Path
        Of the strip, for messages.
    parts : list of RowSpan
    point_format : int
        Of the cloud.

    Returns
    -------
    chunk : Chunk
    took : Seconds

    Raises
    ------
    InputError
        Where they cannot be compressed.
    """
    start = Seconds.now()
    rows = join_records(*(rows.read(0)[first:stop] for rows, first, stop in parts))
    (chunk,) = pack_rows(path, rows, point_format)
    return chunk, Seconds.now() - start


def pack_rows(path: Path, rows: np.ndarray, point_format: int) -> list[Chunk]:
    """Compress rows that begin where a chunk does; arguments and errors as for `pack_chunk`."""
    parts = (rows[first : first + CHUNK_POINTS] for first in range(0, len(rows), CHUNK_POINTS))
    with naming(path):
        return [compress_rows(part, point_format) for part in parts]
