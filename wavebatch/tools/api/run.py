"""Runs strips through a chain from Python and from `wavebatch run`: one place that turns options into jobs.

`plan_run` checks everything and starts nothing; `run` plans and runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from wavebatch.batch.job import RunOptions, StripJob, choose_columns, name_columns
from wavebatch.batch.preflight import check_outputs, plan_memory
from wavebatch.batch.run import BatchResult, run_batch
from wavebatch.batch.selection import build_selection
from wavebatch.batch.strip_task import BatchOptions
from wavebatch.core.condition import Condition
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.raw_bytes import open_regular, reporting_reads
from wavebatch.files.inputs import find_strips
from wavebatch.files.pulse_energy import NONE
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import list_profiles
from wavebatch.surveying.calibrating.calibration_file import load_calibration
from wavebatch.surveying.calibration import check_attenuation, needs_sensor
from wavebatch.surveying.choose_chain import Request, widest
from wavebatch.surveying.sensor import SensorRequest
from wavebatch.surveying.survey import Survey
from wavebatch.surveying.system_file import SavedSurvey, load_survey
from wavebatch.tools.api.chain import AUTO, load_chain

ChainLike = Chain | Path | str | None


def run(
    strips: Iterable[Path | str] | Path | str,
    out: Path | str,
    *,
    chain: ChainLike = None,
    tolerance: float | None = None,
    system: Survey | Path | str | None = None,
    force: bool = False,
    survey: Literal["each", "flight"] = "each",
    sensor: SensorRequest | None = None,
    calibration: Path | str | None = None,
    attenuation: float | tuple[float, float] | None = None,
    energy: Path | str | None = None,
    where: Condition | str | None = None,
    drop_flags: str | None = None,
    classes: Sequence[int] | None = None,
    bbox: Sequence[float] | None = None,
    polygon: Path | str | None = None,
    columns: str | None = None,
    points: Literal["echoes", "returns"] = "echoes",
    format: Literal["laz", "las"] = "laz",
    point_format: int | None = None,
    las_version: Literal["1.4", "1.3", "keep"] = "1.4",
    no_data: Literal["-9999", "nan"] = "-9999",
    strict: bool = False,
    names: Literal["wavebatch", "asprs", "riegl", "pdal", "opals"] = "wavebatch",
    keep_packets: bool = False,
    direction: Literal["auto", "toward", "away"] = "auto",
    headerless: bool = False,
    jobs: int = 1,
    scheduler: str | None = None,
    memory: int | None = None,
    block_size: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
    recursive: bool = False,
    on_event: Callable[[dict[str, Any]], None] | None = None,
) -> BatchResult:
    """Write a point cloud and a report for every strip; what `wavebatch run` does.

    With more than one job, call it under `if __name__ == "__main__":`, since new processes import your script.

    Parameters
    ----------
    strips : iterable of path or str, path or str
        Files, folders, globs, or "@list.txt" with one of these per line.
    out : path or str
        Folder of the clouds and reports; made if it is not there.
    chain : Chain, path or str, optional
        A chain, the path of a chain file, or the name of a shipped chain; "auto", the default, lets the survey of each
        strip choose.
    tolerance : float, optional
        Range error [m]; the cheapest shipped chain that meets it runs, in place of `chain`.
    system : Survey, path or str, optional
        A survey, or the file of a saved one (`wavebatch survey -o`), in place of one of each strip. A strip whose
        samples contradict it fails.
    force : bool
        Use the survey of `system` also for strips that contradict it.
    survey : {"each", "flight"}
        Survey each strip alone, or all of them once; that survey is kept as flight.system.toml in `out`, and used
        again by later runs into it. A strip that does not fit it gets one of its own.
    sensor : SensorRequest, optional
        Where the sensor was: trajectory file, lever arm, CRS, flight height. Default: from the packets' vectors.
    calibration : path or str, optional
        A file of `wavebatch calibrate`.
    attenuation : float or (float, float), optional
        Of the air during the flight, one way, and its standard deviation [dB/km]; default: that of the calibration,
        else 0.22.
    energy : path or str, optional
        Energy of each emitted pulse, by which columns of light are divided: name of an extra byte of the strips, or a
        text file with columns time and energy; "none" divides by nothing. Default: the extra byte pulse_energy, where
        it is there.
    where : str, optional
        Write only points that meet this, e.g. "classification == 2 and echo_width < 8"; see docs/selection.md.
    drop_flags : str, optional
        Leave out points with one of these flags, e.g. "RINGING_SUSPECT,WEAK"; return numbers are counted without them.
    classes : sequence of int, optional
        Write only points of these classes.
    bbox : (float, float, float, float), optional
        Write only points from west, south to east, north, in the coordinates of the strips.
    polygon : path or str, optional
        Write only points inside the polygons of this GeoJSON file, in WGS 84, in the CRS that the file names, or in the
        coordinates of the strips.
    columns : str, optional
        "a,b" writes these columns only, "+a,+b" adds them to the usual ones. Shipped chains get the stages that make
        them.
    points : {"echoes", "returns"}
        One point per echo found, or the points of the input with new columns.
    format : {"laz", "las"}
        Of the clouds.
    point_format : int, optional
        LAS point format of the clouds; default: 6, or 7 or 8 where the strip has colours.
    las_version : {"1.4", "1.3", "keep"}
        LAS version of the clouds; "keep": that of the strip, with its point format.
    no_data : {"-9999", "nan"}
        What floating-point columns hold where an echo has no value.
    strict : bool
        Fail where extra bytes of a strip have no free value to mark added echoes.
    names : {"wavebatch", "asprs", "riegl", "pdal", "opals"}
        Names and units of the extra bytes.
    keep_packets : bool
        Keep the waveforms.
    direction : {"auto", "toward", "away"}
        Where packet vectors point.
    headerless : bool
        Accept a .wdp file without its 60-byte header.
    jobs : int
        Processes; 0 means one per processor. The result is the same for any number.
    scheduler : str, optional
        Address of a dask cluster whose workers replace `jobs`.
    memory : int, optional
        Most memory of all processes together [bytes].
    block_size : int, optional
        Waveforms processed at a time. The result is the same for any number.
    overwrite : bool
        Replace existing outputs.
    resume : bool
        Keep outputs that are complete and up to date, make all others again.
    recursive : bool
        Take the strips in subfolders of folders too.
    on_event : callable, optional
        Called with a dictionary when a strip starts, advances, is written, skipped or fails.

    Returns
    -------
    BatchResult
        Outcome of every strip. A strip that fails does not stop the others: look at `.failed` and `.outcomes`.

    Raises
    ------
    ConfigError
        For wrong options, before anything starts.
    """
    plan = plan_run(
        strips, out, chain=chain, tolerance=tolerance, system=system, force=force, survey=survey, sensor=sensor,
        calibration=calibration, attenuation=attenuation, energy=energy, where=where, drop_flags=drop_flags,
        classes=classes, bbox=bbox, polygon=polygon, columns=columns, points=points,
        format=format, point_format=point_format, las_version=las_version, no_data=no_data, strict=strict, names=names,
        keep_packets=keep_packets, direction=direction, headerless=headerless, jobs=jobs, scheduler=scheduler,
        memory=memory, block_size=block_size, overwrite=overwrite, resume=resume, recursive=recursive,
    )  # fmt: skip
    return run_batch(*plan, on_event)


def plan_run(
    strips: Iterable[Path | str] | Path | str,
    out: Path | str,
    *,
    chain: ChainLike = None,
    tolerance: float | None = None,
    system: Survey | Path | str | None = None,
    force: bool = False,
    survey: Literal["each", "flight"] = "each",
    sensor: SensorRequest | None = None,
    calibration: Path | str | None = None,
    attenuation: float | tuple[float, float] | None = None,
    energy: Path | str | None = None,
    where: Condition | str | None = None,
    drop_flags: str | None = None,
    classes: Sequence[int] | None = None,
    bbox: Sequence[float] | None = None,
    polygon: Path | str | None = None,
    columns: str | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    memory: int | None = None,
    block_size: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
    recursive: bool = False,
    **output: Any,
) -> tuple[list[StripJob], BatchOptions]:
    """Check the options of `run` and turn them into jobs; nothing is started or written.

    Parameters
    ----------
    strips, out, chain, tolerance, system, force, survey, sensor, calibration, attenuation, energy, columns, jobs
        As for `run`.
    where, drop_flags, classes, bbox, polygon
        As for `run`.
    scheduler, memory
        As for `run`.
    block_size, overwrite, resume, recursive
        As for `run`.
    **output
        The remaining ones: fields of RunOptions.

    Returns
    -------
    jobs : list of StripJob
        One per strip, in the order given.
    options : BatchOptions
        For `run_batch`.

    Raises
    ------
    ConfigError
        For whatever is wrong with the options.
    """
    if scheduler is not None and not scheduler.strip():
        raise ConfigError("--scheduler: the address is empty; leave it out to work on this machine")
    found, request = find_request(chain, tolerance=tolerance, system=system)
    if force and system is None:
        raise ConfigError("--force is of no use without --system; leave it out")
    request = replace(request, force=force)
    if survey == "flight":
        if system is not None:
            raise ConfigError("--system and --survey flight exclude each other; give one of them")
        request = replace(request, flight=True)
    sensor = sensor or SensorRequest()
    known = None if calibration is None else load_calibration(Path(calibration))
    air = None if attenuation is None else _read_air(attenuation)
    template = StripJob(Path(), found, RunOptions(columns=name_columns(columns)), request, sensor, known, air)
    chosen = build_selection(where=where, drop_flags=drop_flags, classes=classes, bbox=bbox, polygon=polygon)
    template = replace(template, pulse_energy=None if energy is None else str(energy), selection=chosen)
    # A chain that the user wrote stays as it is; a shipped one gets the stages that the given files allow.
    if chain is None or isinstance(chain, str) and chain in (AUTO, *list_profiles()):
        found = template.extend(found)
    _check_use(found, sensor, known, air, None if energy == NONE else energy)
    options = RunOptions(columns=choose_columns(found, columns), **output)
    paths = find_strips([str(strips)] if isinstance(strips, Path | str) else map(str, strips), recursive=recursive)
    processes, block = plan_memory(jobs or os.cpu_count() or 1, memory)
    batch_options = BatchOptions(Path(out), processes, scheduler, block_size or block, overwrite, resume)
    plan = [replace(template, path=path, chain=found, options=options) for path in paths]
    check_outputs(plan, batch_options)
    return plan, batch_options


def find_request(
    chain: ChainLike, *, tolerance: float | None = None, system: Survey | Path | str | None = None
) -> tuple[Chain, Request]:
    """Find the chain to run with, or the widest one that a survey may choose, and the request that goes with it.

    Parameters
    ----------
    chain : Chain, path or str, optional
        As for `run`.
    tolerance : float, optional
        Range error [m] by which a chain is chosen.
    system : Survey, path or str, optional
        A survey, or the file of a saved one.

    Returns
    -------
    chain : Chain
        The chain itself, or the widest.
    request : Request
        How each strip gets its chain and its pulse.

    Raises
    ------
    ConfigError
        For a chain or a saved survey that cannot be read.
    """
    if tolerance is not None and chain is not None:
        raise ConfigError("chain and tolerance exclude each other; give one of them")
    auto = chain in (None, AUTO) and tolerance is None
    if isinstance(system, Survey):
        saved: SavedSurvey | None = SavedSurvey(system)
    else:
        saved = None if system is None else load_survey(system)
    request = Request(auto, tolerance, saved)
    if chain is None or auto:
        return widest(request), request
    return chain if isinstance(chain, Chain) else load_chain(chain), request


def _read_air(attenuation: float | tuple[float, float]) -> tuple[float, float]:
    """Attenuation and its error [dB/km]; ConfigError where they cannot be."""
    value, error = attenuation if isinstance(attenuation, tuple) else (attenuation, 0.0)
    if not (0 <= value <= 100 and 0 <= error <= 100):
        raise ConfigError(f"attenuation: {value:g} +- {error:g} dB/km must lie in 0 to 100; clear air has 0.1 to 0.5")
    check_attenuation(value)
    return float(value), float(error)


def _check_use(chain: Chain, sensor: SensorRequest, calibration: Any, air: Any, energy: Any) -> None:
    """Raise ConfigError for files that the chain, or another option, would ignore."""
    if sensor.trajectory is not None and sensor.height is not None:
        raise ConfigError("--trajectory and --flight-height exclude each other; give one of them")
    _check_trajectory(sensor)
    given = {"--trajectory": sensor.trajectory, "--flight-height": sensor.height, "--calibration": calibration,
             "--attenuation": air, "--energy": energy}  # fmt: skip
    option = next((name for name, value in given.items() if value is not None), None)
    if option is not None and not needs_sensor(chain):
        stages = {"--calibration": "backscatter_coefficient", "--attenuation": "amplitude_normalized",
                  "--energy": "amplitude_normalized"}  # fmt: skip
        stage = f"attribute.{stages.get(option, 'range')}"
        raise ConfigError(f"{option}: chain {chain.name} computes nothing from it; add stage {stage}")


def _check_trajectory(sensor: SensorRequest) -> None:
    """Raise ConfigError once where the trajectory cannot be read, not for each strip after its survey."""
    if sensor.trajectory is None:
        return
    try:
        with reporting_reads(sensor.trajectory, "trajectory "), open_regular(sensor.trajectory):
            pass
    except InputError as error:
        raise ConfigError(str(error)) from error
