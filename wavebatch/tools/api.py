"""What users call from Python as `wavebatch.run`, `wavebatch.load_chain`, ...; commands call it too.

`plan_run` turns options into jobs: it checks everything and starts nothing; `run` plans and runs. A strip as users see
it, and its survey: surveying/inspect_strip.py.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

from wavebatch.batch.job import StripJob, choose_columns, split_columns
from wavebatch.batch.options import OPTIONS, RunOptions, describe_options
from wavebatch.batch.run import BatchResult, check_outputs, plan_memory, run_batch
from wavebatch.core.errors import ConfigError, InputError, nearest
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.pulse_energy import NONE
from wavebatch.files.text_file import find_strips
from wavebatch.files.trajectory_file import check_trajectory
from wavebatch.kernels.physics.radiometry import attenuation_of_visibility
from wavebatch.stages.chain import Chain, list_profiles, load_chain_file, load_profile
from wavebatch.surveying.calibration import check_attenuation, needs_sensor
from wavebatch.surveying.choose_chain import Request, choose_chain, widest_chain
from wavebatch.surveying.sensor import SensorRequest
from wavebatch.surveying.systems.survey_result import SavedSurvey, Survey, load_survey

AUTO = "auto"
"""In place of a chain's name: the survey of each strip chooses the chain."""


def load_chain(name: Path | str) -> Chain:
    """Load a shipped chain by its name, or a chain file by its path.

    Parameters
    ----------
    name : path or str
        "fast", "balanced", "accurate" or another shipped chain, or the path of a TOML file. Text without a folder and
        a suffix is a name.

    Returns
    -------
    Chain
        The checked chain. `chain.run(block, system)` gives the echoes of a block.

    Raises
    ------
    ConfigError
        Where there is no such chain or it is wrong; names file, table, key and the nearest known word.
    """
    known = list_profiles()
    if isinstance(name, Path) or Path(name).name != name or Path(name).suffix:
        return load_chain_file(name)
    if name not in known:
        raise ConfigError(f"profile {name!r} does not exist; {nearest(name, [AUTO, *known])}")
    return load_profile(name)


def auto_chain(survey: Survey) -> Chain:
    """Choose the cheapest chain that loses nothing on the surveyed strip.

    Parameters
    ----------
    survey : Survey
        Result of `survey`; its `decisions` give the reason for every part that is left out.

    Returns
    -------
    Chain
        The chain that `run` would choose for this strip.

    Raises
    ------
    ConfigError
        Where it is no Survey.
    """
    if not isinstance(survey, Survey):
        raise ConfigError(f"auto_chain: give a Survey, which wavebatch.survey returns, not a {type(survey).__name__}")
    return choose_chain(survey)


Strips = Iterable[Path | str] | Path | str


_P = ParamSpec("_P")


def _takes(
    options: Callable[_P, RunOptions],
) -> Callable[[Callable[..., BatchResult]], Callable[Concatenate[Strips, _P], BatchResult]]:
    """A function of strips gets the keywords of RunOptions: for type checkers, help() and editors that run the code."""

    def sign(function: Callable[..., BatchResult]) -> Callable[Concatenate[Strips, _P], BatchResult]:
        first = inspect.signature(function).parameters["strips"]
        output, *others = inspect.signature(options).parameters.values()
        shown = [first, output.replace(default=output.empty), *(one.replace(kind=one.KEYWORD_ONLY) for one in others)]
        function.__signature__ = inspect.Signature(shown, return_annotation=BatchResult)  # type: ignore[attr-defined]
        before, mark, after = (function.__doc__ or "").partition("    **options\n")
        lines = "".join(f"    {line}\n" for line in describe_options().split("\n"))
        function.__doc__ = before + lines + after[after.find("\n\n") + 1 :] if mark else before
        return function

    return sign


@_takes(RunOptions)
def run(
    strips: Strips, output: Path | str, *, on_event: Callable[[dict[str, Any]], None] | None = None, **options: Any
) -> BatchResult:
    """Write a point cloud and a report for every strip; what `wavebatch run` does.

    The keywords are the options of the command, with `_` for `-`; `help(wavebatch.run)` lists them.

    Parameters
    ----------
    strips : iterable of path or str, path or str
        Files, folders, globs, or "@list.txt" with one of these per line.
    output : path or str
        Folder of the clouds and reports; made if it is not there.
    on_event : callable, optional
        Called with a dictionary when a strip starts, advances, is written, skipped or fails.
    **options
        Fields of `RunOptions`. `chain` may be a Chain, a path, or the name of a shipped chain, `system` a Survey.

    Returns
    -------
    BatchResult
        Outcome of every strip. A strip that fails does not stop the others: look at `.failed` and `.outcomes`.

    Raises
    ------
    ConfigError
        For wrong options, before anything starts.
    """
    for name in options:
        if name not in OPTIONS:
            raise TypeError(f"run has no option {name}; {nearest(name, OPTIONS)}")
    return run_batch(*plan_run(strips, RunOptions(output, **options)), on_event)


def plan_run(
    strips: Strips, options: RunOptions, note: Callable[[str], None] | None = None
) -> tuple[list[StripJob], RunOptions]:
    """Check the options of `run` and turn them into jobs; nothing is started or written.

    Parameters
    ----------
    strips : iterable of path or str, path or str
        As for `run`.
    options : RunOptions
    note : callable, optional
        Called with a line about each link to a strip that was given before.

    Returns
    -------
    jobs : list of StripJob
        One per strip, in the order given.
    options : RunOptions
        For `run_batch`, with the number of processes and the block size that the memory allows.

    Raises
    ------
    ConfigError
        For whatever is wrong with the options.
    """
    options.check()
    folder = Path(options.output)
    if folder.suffix.lower() in (".las", ".laz") and not folder.is_dir():
        raise ConfigError(f"--output {folder}: this is a folder, which gets a cloud and a report for each strip; give "
                          f"a name such as {folder.with_suffix('')}")  # fmt: skip
    asked_chain, request = find_request(options)
    air, attenuation = None, options.attenuation
    if options.visibility is not None:
        attenuation = attenuation_of_visibility(options.visibility, options.wavelength or 1064.0)
    elif attenuation is not None:
        check_attenuation(attenuation)
    if attenuation is not None:
        air = (float(attenuation), float(options.attenuation_error or 0.0))  # [dB/km] and its error
    calibration = None
    if options.calibration is not None:
        from wavebatch.surveying.calibrating.calibration_files import load_calibration  # most runs have none

        calibration = load_calibration(Path(options.calibration))
    template = StripJob(
        Path(),
        asked_chain,
        options,
        tuple(entry.removeprefix("+") for entry in split_columns(options.columns) if entry.strip(" +")),
        request,
        read_sensor(options),
        calibration,
        air,
        PointFilter.build(drop_flags=options.drop_flags, classes=options.classes, bbox=options.bbox,
                          polygon=options.polygon, where=options.where),
    )
    # A chain that the user wrote stays as it is; a shipped one gets the stages that the given files allow.
    asked = options.chain or options.profile
    shipped = asked is None or isinstance(asked, str) and asked in (AUTO, *list_profiles())
    found = template.extend(template.chain) if shipped else template.chain
    sensor = template.sensor
    if sensor.trajectory is not None:
        # Once, not for each strip after its survey.
        try:
            check_trajectory(sensor.trajectory)
        except InputError as error:
            raise ConfigError(str(error)) from error
    given = {
        "--trajectory": sensor.trajectory, "--flight-height": sensor.height, "--calibration": template.calibration,
        "--attenuation": options.attenuation, "--visibility": options.visibility,
        "--energy": None if template.energy == NONE else template.energy,
    }  # fmt: skip
    option = next((name for name, value in given.items() if value is not None), None)
    if option is not None and not needs_sensor(found):
        stages = {"--trajectory": "range", "--flight-height": "range", "--calibration": "backscatter_coefficient"}
        name = stages.get(option, "amplitude_normalized")
        remedy = f"give --columns +{name}, or add stage attribute.{name} to a chain file"
        raise ConfigError(f"{option}: chain {found.name} computes nothing from it; {remedy}")
    paths = find_strips([str(strips)] if isinstance(strips, Path | str) else map(str, strips),
                        recursive=options.recursive, note=note)  # fmt: skip
    processes, block = plan_memory(options.jobs or os.cpu_count() or 1, options.memory)
    columns = choose_columns(found, options.columns)
    plan = [replace(template, path=path, chain=found, columns=columns) for path in paths]
    how = replace(options, jobs=processes, block_size=options.block_size or block)
    check_outputs(plan, how)
    return plan, how


def find_request(options: RunOptions) -> tuple[Chain, Request]:
    """Find the chain to run with, or the widest one that a survey may choose, and the request that goes with it.

    Parameters
    ----------
    options : RunOptions

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
    given, asked, saved = options.system, options.chain or options.profile or AUTO, None
    if given is not None:
        saved = SavedSurvey(given) if isinstance(given, Survey) else load_survey(given)
    auto = asked == AUTO and options.tolerance is None
    request = Request(auto, options.tolerance, saved, options.survey == "flight", options.force)
    if asked == AUTO:
        return widest_chain(request), request
    return asked if isinstance(asked, Chain) else load_chain(asked), request


def read_sensor(options: RunOptions) -> SensorRequest:
    """Return where the sensor's positions shall come from; raises ConfigError for a lever arm that cannot be."""
    arm, file = options.lever_arm, options.trajectory
    if arm is not None and not sum(map(abs, arm)) < 1000:
        raise ConfigError(f"--lever-arm: {','.join(map(str, arm))} is too long; a lever arm has a few metres")
    return SensorRequest(None if file is None else Path(file), options.crs, arm, options.flight_height)
