"""What one process does: prepare a strip, and take one of its units from packets to output rows."""

from __future__ import annotations

import functools
import pickle
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.batch.counts import RunReport
from wavebatch.batch.output_rows import NEEDED, assemble_echoes, assemble_returns, gather_echoes
from wavebatch.core.echoes import COLUMNS, RAY, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.cloud.layout import OutputLayout, plan_output
from wavebatch.files.strip.reader import StripFacts, StripReader, StripScan, Unit
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.surveying.angle_limits import angle_parameters
from wavebatch.surveying.auto_chain import without_columns
from wavebatch.surveying.calibration import Calibration, needs_sensor, with_physics
from wavebatch.surveying.choose_chain import Choice, Request, make_choice, sample_size
from wavebatch.surveying.flat_ground import measure_level
from wavebatch.surveying.sensor import NOBODY, SensorRequest, SensorSource, find_sensor, refuse_units

BLOCK_SAMPLES = 1 << 22
"""Samples of a block, unless told otherwise: a whole unit of waveforms of 80; fewer, and NumPy calls dominate."""

_ALWAYS = ("echo_time", "echo_flags")
"""Columns that need no attribute stage."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of a run that change what is written."""

    direction: str = "auto"
    headerless: bool = False
    points: str = "echoes"
    format: str = "laz"
    point_format: int | None = None
    names: str = "wavebatch"
    columns: tuple[str, ...] = ()
    """Columns to write, in order; see `choose_columns`."""
    keep_packets: bool = False


@dataclass(frozen=True, slots=True)
class StripJob:
    """A strip to process and how; picklable."""

    path: Path
    chain: Chain
    """The chain, or the widest that may be chosen."""
    options: RunOptions
    request: Request = Request()
    """How pulse and chain are found."""
    sensor: SensorRequest = SensorRequest()
    """Where the sensor's positions come from; asked for only if the chain needs them."""
    calibration: Calibration | None = None

    def extend(self, chain: Chain) -> Chain:
        """The chain with what trajectory, calibration and divergence allow; a chain that the user wrote stays."""
        saved = self.request.system
        divergence = self.calibration is not None and self.calibration.divergence is not None
        divergence |= saved is not None and saved.survey.system.divergence is not None
        given = self.sensor != SensorRequest()
        return with_physics(chain, sensor=given, calibrated=self.calibration is not None, divergence=divergence)

    def absolute(self) -> StripJob:
        """The same for processes that work in another folder."""
        sensor = self.sensor
        if sensor.trajectory is not None:
            sensor = replace(sensor, trajectory=sensor.trajectory.absolute())
        return replace(self, path=self.path.absolute(), sensor=sensor)

    def open(self) -> StripReader:
        """A reader of the strip; raises InputError where it is not one."""
        return StripReader(self.path, direction=self.options.direction, headerless=self.options.headerless)


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """All that the units of a strip share; picklable."""

    job: StripJob
    """With the chosen chain, and the columns that it computes."""
    facts: StripFacts
    scan: StripScan
    units: int
    choice: Choice
    layout: OutputLayout
    report: RunReport
    """Timing of the preparation."""
    sensor: SensorSource = NOBODY

    @property
    def system(self) -> SystemPulse:
        """The pulse that the strip is run with, its calibration, and the error of the sensor's position."""
        system = replace(self.choice.survey.system, sensor_error=self.sensor.error)
        return system if self.job.calibration is None else self.job.calibration.apply(system)


    @property
    def second_step(self) -> Step | None:
        """The step whose columns are filled in a second pass over the strip's points; None where none is written."""
        step = self.job.chain.second_step
        return step if step is not None and set(step.stage.makes) & set(self.job.options.columns) else None

    @property
    def row_layout(self) -> OutputLayout:
        """The layout of a unit's rows: the cloud's, and behind it what a second pass needs."""
        return self.layout if self.second_step is None else self.layout.extended(RAY)


def choose_columns(chain: Chain, wanted: str | None = None) -> tuple[str, ...]:
    """Columns to write: what the chain computes and the flags; `a,b` chooses among them, `+a,+b` adds.

    Raises ConfigError for a column that does not exist or that the chain does not compute, and for a chain without
    positions.
    """
    missing = [name for name in NEEDED if name not in chain.makes]
    if missing:
        raise ConfigError(
            f"chain {chain.name}: computes no {', '.join(missing)}, without which echoes are no points; add a "
            "[[chain]] table with stage = \"attribute.position\""
        )  # fmt: skip
    computed = [name for name in chain.makes if name in COLUMNS and COLUMNS[name].extra_bytes]
    default = [*computed, "echo_flags"]
    entries = [entry.strip() for entry in (wanted or "").split(",") if entry.strip()]
    added = [entry[1:] for entry in entries if entry.startswith("+")]
    chosen = [entry for entry in entries if not entry.startswith("+")]
    if wanted is not None and not entries:
        raise ConfigError("--columns: names no column; leave it out for the usual ones, or write a,b or +a,+b")
    for name in [*chosen, *added]:
        _check_column(name, (*computed, *_ALWAYS))
    return tuple(dict.fromkeys([*(chosen or default), *added]))


def _check_column(name: str, available: tuple[str, ...]) -> None:
    known = [column.name for column in COLUMNS.values() if column.extra_bytes]
    if name not in known:
        raise ConfigError(f"--columns: column {name!r} does not exist; {nearest(name, known)}")
    if name not in available:
        makers = [stage.name for stage in STAGES.values() if name in stage.makes]
        remedy = f"add stage {' or '.join(makers)} to it" if makers else "no stage of this version does"
        raise ConfigError(f"--columns: the chain does not compute {name!r}; {remedy}")


def plan_layout(job: StripJob, facts: StripFacts) -> OutputLayout:
    """How the points of the strip's output look; raises InputError or ConfigError where that cannot be had."""
    options = job.options
    return plan_output(
        facts.checked,
        options.columns,
        point_format=options.point_format,
        packets=facts if options.keep_packets else None,
        names=options.names,
        points=options.points,
    )


def prepare_strip(job: StripJob) -> Prepared:
    """Scan and survey of a strip, its chain, and the layout of its output.

    Raises InputError where it cannot be processed, ConfigError where no chain serves.
    """
    start = time.perf_counter()
    with job.open() as reader:
        facts = reader.facts
        plan_layout(job, facts)
        scan = reader.scan()
        try:
            scanned = time.perf_counter()
            choice = make_choice(reader, scan, job.chain, job.request)
            if job.request.describe(job.chain) is not None:
                choice = replace(choice, chain=job.extend(choice.chain))
            columns = without_columns(job.options.columns, job.chain, choice.chain)
            job = replace(job, chain=choice.chain, options=replace(job.options, columns=columns))
            surveyed = time.perf_counter()
            if job.chain.second_step is not None:
                refuse_units(reader, scan)
            sensor = find_sensor(reader, scan, job.sensor) if needs_sensor(job.chain) else NOBODY
            choice = _see_level(reader, scan, job, choice, sensor)
            layout = plan_layout(job, facts)
            units = reader.unit_count()
        except BaseException:
            scan.close()
            raise
    timing = {"scan": scanned - start, "survey": surveyed - scanned, "sensor": time.perf_counter() - surveyed}
    return Prepared(job, facts, scan, units, choice, layout, RunReport(timing=timing), sensor)


def _see_level(reader: StripReader, scan: StripScan, job: StripJob, choice: Choice, sensor: SensorSource) -> Choice:
    """The choice with the widths of level ground, where angles are taken and no saved survey says them."""
    parameters = angle_parameters(job.chain)
    if parameters is None or sensor is NOBODY or job.request.system is not None:
        return choice
    system = choice.survey.system
    used = system if job.calibration is None else job.calibration.apply(system)
    used = replace(used, divergence=parameters["divergence"] or used.divergence)
    blocks = (sensor.fill(block) for block in reader.sample_blocks(scan, sample_size(reader, scan)))
    seen = measure_level(blocks, used, choice.survey.figures.get("spacing_ns", 0.0))
    system = replace(system, level_variance=seen.level_variance, width_scatter=seen.width_scatter)
    return replace(choice, survey=replace(choice.survey, system=system))


def process_unit(prepared: Prepared, number: int, block_size: int | None = None) -> tuple[np.ndarray, RunReport]:
    """Output rows of one unit, and their account.

    block_size: waveforms that go through the chain at a time; the rows do not depend on it.
    """
    start = time.perf_counter()
    stages: dict[str, float] = {}
    echoes_mode = prepared.job.options.points == "echoes"
    with StripReader.reopen(prepared.facts) as reader:
        unit = reader.read_unit(number, prepared.scan)
        opened = time.perf_counter()
        size = block_size or _block_size(unit)
        blocks = _Stopwatch(reader.read_blocks(unit, size, owned_only=echoes_mode))
        echoes = gather_echoes(unit, _run_blocks(prepared, blocks, stages))
    gathered = time.perf_counter()
    assemble = assemble_echoes if echoes_mode else assemble_returns
    rows, report = assemble(unit, echoes, prepared.row_layout)
    timing = {
        **stages,
        "read points": opened - start,
        "read packets": blocks.seconds,
        "assemble": time.perf_counter() - gathered,
    }
    return rows, replace(report, timing=timing)


@functools.lru_cache(maxsize=4)
def unpack(blob: bytes) -> Any:
    """What was pickled, unpickled once per process for the strips that are under way."""
    return pickle.loads(blob)


def process_packed_unit(blob: bytes, number: int, block_size: int | None) -> tuple[np.ndarray, RunReport]:
    """`process_unit` of a pickled Prepared, which is unpickled once per process and strip."""
    return process_unit(unpack(blob), number, block_size)


def _block_size(unit: Unit) -> int:
    longest = int(unit.packets.n_samples.max(initial=1))
    return int(np.clip(BLOCK_SAMPLES // longest, 64, 65536))


def _run_blocks(
    prepared: Prepared, blocks: Iterator[tuple[WaveformBlock, np.ndarray]], timing: dict[str, float]
) -> Iterator[tuple[WaveformBlock, np.ndarray, EchoTable]]:
    system = prepared.system
    for block, index in blocks:
        yield block, index, prepared.job.chain.run(prepared.sensor.fill(block), system, timing)


class _Stopwatch:
    """Iterates over something else and keeps the seconds that it took."""

    def __init__(self, items: Iterator) -> None:
        self._items = iter(items)
        self.seconds = 0.0

    def __iter__(self) -> _Stopwatch:
        return self

    def __next__(self) -> object:
        start = time.perf_counter()
        try:
            return next(self._items)
        finally:
            self.seconds += time.perf_counter() - start
