"""A strip to process and how: what the command line and the public API ask for, and the workers get.

`tools.api` builds a StripJob per strip; `unit` does what it asks for.
Before you change it: a job travels to other processes, and all of it that decides the output is in `describe_job` of
`report_file`, or --resume would keep clouds that are not what is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavebatch.batch.options import RunOptions
from wavebatch.batch.output_rows import NEEDED
from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.cloud.column_names import name_standard, read_field, resolve
from wavebatch.files.cloud.point_filter import PlannedFilter, PointFilter
from wavebatch.files.cloud.writer import OutputLayout, plan_output
from wavebatch.files.las.header import read_classes
from wavebatch.files.strip.reader import StripFacts, StripReader
from wavebatch.stages.chain import STAGES, Chain
from wavebatch.surveying.calibration import Calibration, with_columns, with_physics
from wavebatch.surveying.choose_chain import Request
from wavebatch.surveying.sensor import SensorRequest

WITHOUT_STAGE = ("echo_time", "echo_flags")
"""Columns that need no attribute stage."""


@frozen
class StripJob:
    """A strip to process and how; picklable."""

    path: Path
    chain: Chain
    """The chain, or the widest that may be chosen."""
    options: RunOptions = RunOptions()
    columns: tuple[str, ...] = ()
    """Columns to write, in order; see `choose_columns`."""
    request: Request = Request()
    """How pulse and chain are chosen."""
    sensor: SensorRequest = SensorRequest()
    """Where the sensor's positions come from; used only if the chain needs them."""
    calibration: Calibration | None = None
    attenuation: tuple[float, float] | None = None
    """Of the air during the flight and its standard deviation [dB/km]; None: of the calibration, or the default."""
    selection: PointFilter = PointFilter()
    """What is written."""
    unit_points: int | None = None
    """Of a unit, which one process works on; the cloud does not depend on it."""

    def extend(self, chain: Chain) -> Chain:
        """Return the chain with the physical stages that trajectory, calibration and divergence allow, and those of the
        columns that are asked for.
        """
        saved = self.request.system
        known = [self.calibration and self.calibration.divergence, saved and saved.survey.system.radiometry.divergence]
        divergence = any(value is not None for value in known)
        given = self.sensor != SensorRequest()
        chain = with_physics(chain, sensor=given, calibrated=self.calibration is not None, divergence=divergence)
        # Columns that --where names exactly; the others are those of the input.
        where = () if self.selection.where is None else self.selection.where.columns
        named = (name for name in where if name in COLUMNS and COLUMNS[name].extra_bytes)
        return with_columns(chain, (*self.columns, *named))

    def calibrate(self, system: SystemPulse) -> SystemPulse:
        """Return the system pulse with the job's calibration and air, if it has them."""
        system = system if self.calibration is None else self.calibration.apply(system)
        if self.attenuation is None:
            return system
        value, error = self.attenuation
        return system.with_radiometry(attenuation=value, attenuation_error=error)

    @property
    def energy(self) -> str | None:
        """Where the energy of each emitted pulse comes from; see `find_pulse_energy`."""
        return None if self.options.energy is None else str(self.options.energy)

    @property
    def energy_file(self) -> Path | None:
        """The file of --energy; None where that names an extra byte."""
        file = None if self.energy is None else Path(self.energy)
        return file if file is not None and file.is_file() else None

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the processes read, without those of packets."""
        return tuple(path for path in (self.path, self.sensor.trajectory, self.energy_file) if path is not None)

    def absolute(self) -> StripJob:
        """Return the job with absolute paths, for processes that work in another folder."""
        file = self.sensor.trajectory
        sensor = replace(self.sensor, trajectory=None if file is None else file.absolute())
        energy = self.energy if self.energy_file is None else str(self.energy_file.absolute())
        options = replace(self.options, energy=energy)
        return replace(self, path=self.path.absolute(), sensor=sensor, options=options)

    def open(self) -> StripReader:
        """Open the strip; raises InputError where it cannot be read."""
        direction, headerless = self.options.direction, self.options.headerless
        return StripReader(self.path, direction=direction, headerless=headerless, unit_points=self.unit_points)


def split_columns(wanted: str | None) -> list[str]:
    """The entries of --columns, with their `+`."""
    return [entry.strip() for entry in (wanted or "").split(",") if entry.strip()]


def choose_columns(chain: Chain, wanted: str | None = None) -> tuple[str, ...]:
    """Choose the columns to write.

    Parameters
    ----------
    chain : Chain
    wanted : str, optional
        `a,b` writes these columns only, `+a,+b` adds them. By default all columns of the chain and the flags.

    Returns
    -------
    tuple of str

    Raises
    ------
    ConfigError
        Where a column does not exist or the chain does not compute it, where a name without `+` follows one with it,
        and for a chain without positions.
    """
    missing = [name for name in NEEDED if name not in chain.makes]
    if missing:
        raise ConfigError(
            f"chain {chain.name}: computes no {', '.join(missing)}, which every point needs; add a "
            '[[chain]] table with stage = "attribute.position"'
        )
    computed = [name for name in chain.makes if name in COLUMNS and COLUMNS[name].extra_bytes]
    default = [*computed, "echo_flags"]
    entries = split_columns(wanted)
    added = [entry[1:] for entry in entries if entry.startswith("+")]
    chosen = [entry for entry in entries if not entry.startswith("+")]
    if wanted is not None and not entries:
        raise ConfigError("--columns: names no column; leave it out for the usual ones, or write a,b or +a,+b")
    if away := [entry for entry in entries if entry.startswith("-")]:
        raise ConfigError(f"--columns: {away[0]!r}: a column cannot be taken away; list all that are wanted, without +")
    if chosen and entries[0].startswith("+"):
        raise ConfigError(
            f"--columns: '+{added[0]}' adds, but {chosen[0]!r} has no +; write +{chosen[0]} to add it too"
        )
    known = [column.name for column in COLUMNS.values() if column.extra_bytes]
    for name in [*chosen, *added]:
        if name not in known:
            raise ConfigError(f"--columns: column {name!r} does not exist; {nearest(name, known)}")
        if name not in (*computed, *WITHOUT_STAGE):
            makers = [stage.name for stage in STAGES.values() if name in stage.makes]
            remedy = f"add stage {' or '.join(makers)} to it" if makers else "no stage of this version does"
            raise ConfigError(f"--columns: the chain does not compute {name!r}; {remedy}")
    return tuple(dict.fromkeys([*(chosen or default), *added]))


def plan_layout(job: StripJob, facts: StripFacts) -> OutputLayout:
    """Plan the layout of the strip's output; raises InputError or ConfigError where it cannot be written."""
    options = job.options
    return plan_output(
        facts,
        job.columns,
        point_format=options.point_format,
        las_version=options.las_version,
        packets=facts if options.keep_packets else None,
        names=options.names,
        no_data=options.no_data,
        points=options.points,
        strict=options.strict,
    )


class UnitRows(NamedTuple):
    """Rows of a unit before they are written."""

    rows: np.ndarray
    """Structured (m,), in the cloud's layout."""
    columns: Mapping[str, np.ndarray]
    """Computed columns (m,) as the chain gave them, whatever the cloud's names and units; echo_flags among them."""


@frozen
class RowColumn:
    """A column of UnitRows; picklable."""

    kind: str
    """`computed`, `standard` or `carried`."""
    name: str
    """Of the column, or of the field of the layout."""
    layout: OutputLayout

    def __call__(self, unit: UnitRows) -> np.ndarray:
        """Values (m,), NaN for no data."""
        if self.kind == "computed":
            return unit.columns[self.name].astype(COLUMNS[self.name].dtype, copy=False)
        if self.kind == "carried":
            return self.layout.carried[self.layout.extra_fields.index(self.name)].record.read(unit.rows[self.name])
        if self.name == "classification":
            return read_classes(unit.rows)
        return read_field(unit.rows, self.layout.point_format, self.name, self.layout.source.header)


def plan_filter(job: StripJob, layout: OutputLayout) -> PlannedFilter:
    """Look up the columns of --where among those that the rows of the output have, and place the polygons.

    Parameters
    ----------
    job : StripJob
        With the chain that makes the rows.
    layout : OutputLayout

    Returns
    -------
    PlannedFilter
        For UnitRows.

    Raises
    ------
    ConfigError
        Where --where names a column that the rows do not have, or the polygons cannot be placed in the strip.
    """
    source, chain = layout.source, job.chain
    made = [name for name in chain.makes if name in COLUMNS and COLUMNS[name].extra_bytes]
    fields = zip(layout.carried, layout.extra_fields, strict=False)
    names = {
        "computed": {name: name for name in [*made, *WITHOUT_STAGE]},
        "standard": name_standard(layout.point_format),
        "carried": {one.record.name: field for one, field in fields if not layout.dtype[field].shape},
    }
    kinds = [{name: (kind, meant) for name, meant in known.items()} for kind, known in names.items()]

    def find(name: str) -> RowColumn:
        found = resolve(name, *kinds)
        if found is not None:
            return RowColumn(found[0], found[1], layout)
        makers = [stage.name for stage in STAGES.values() if name in stage.makes and name in COLUMNS]
        remedy = nearest(name, [one for known in kinds for one in known])
        if makers:
            remedy = f"chain {chain.name} does not compute it; add stage {' or '.join(makers)} to it"
        raise ConfigError(f"{source.path}: there is no column {name!r}; {remedy}")

    standard = {name: RowColumn("standard", name, layout) for name in ("x", "y", "classification")}
    standard["echo_flags"] = RowColumn("computed", "echo_flags", layout)
    return job.selection.place(source.path, source.header).plan(standard, find, str(source.path))
