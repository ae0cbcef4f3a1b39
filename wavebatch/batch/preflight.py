"""Checks before a run: memory, outputs that would replace inputs, and the plan that --dry-run prints.

Before you change it: nothing here may write to disk.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wavebatch.batch.job import StripJob, plan_filter, plan_layout
from wavebatch.batch.options import RunOptions
from wavebatch.batch.report_file import cloud_path, report_path
from wavebatch.batch.strip_task import StripTask
from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import protecting, refuse_input
from wavebatch.surveying.flight import read_flight
from wavebatch.surveying.system_file import SavedSurvey, load_survey

LEAST_MEMORY = 350 << 20
"""Bytes that one process needs with the smallest blocks: 320 MB for the survey of a strip of noise."""

FULL_MEMORY = 500 << 20
"""Bytes that one process takes with full blocks."""

SMALL_BLOCK = 1024
"""Waveforms of a block when memory is short."""


def plan_memory(options_jobs: int, memory: int | None) -> tuple[int, int | None]:
    """Choose number of processes and block size so that a run stays within a memory limit.

    Parameters
    ----------
    options_jobs : int
        Processes that the user asks for.
    memory : int or None
        Bytes for all processes together; with several, the one that writes counts too. None: no limit.

    Returns
    -------
    jobs : int
    block_size : int or None
        Waveforms; None for the usual size.

    Raises
    ------
    ConfigError
        Where not even one process fits.
    """
    if memory is None:
        return options_jobs, None
    if memory < LEAST_MEMORY:
        given = f"{memory >> 20} MB" if memory >> 20 else f"{memory} bytes"
        raise ConfigError(
            f"--memory: {given} is too little, one job needs {LEAST_MEMORY >> 20} MB; write for example 500M or 4G"
        )
    processes = max(min(memory // LEAST_MEMORY, options_jobs + (options_jobs > 1)), 1)
    jobs = max(processes - 1, 1) if options_jobs > 1 else 1
    processes = jobs + (jobs > 1)
    return jobs, SMALL_BLOCK if memory // processes < FULL_MEMORY else None


def check_outputs(jobs: Sequence[StripJob], options: RunOptions) -> None:
    """Raise ConfigError where an output would replace an input."""
    with protecting(list_read_files(jobs)):
        for job in jobs:
            for target in find_outputs(job, options.folder):
                refuse_input(target)


def list_read_files(jobs: Sequence[StripJob]) -> list[Path]:
    """Return the files that the jobs read, also those that are read already: no output may replace them."""
    read = {Path(job.chosen.polygon_file["file"]) for job in jobs if job.chosen.polygon_file is not None}
    return sorted(read.union(*(job.files for job in jobs)))


def find_outputs(job: StripJob, folder: Path) -> list[Path]:
    """Return the files that the job may write."""
    cloud = cloud_path(job, folder)
    packets = [cloud.with_suffix(".wdp")] if job.options.keep_packets else []
    flight = [flight_path(folder)] if job.request.flight else []
    return [cloud, report_path(job, folder), *packets, *flight]


def flight_path(folder: Path) -> Path:
    """Return the path of the survey of a flight in the folder of its clouds."""
    return folder / "flight.system.toml"


def load_flight(jobs: Sequence[StripJob], options: RunOptions) -> SavedSurvey | None:
    """Load the survey of a flight that an earlier run has kept.

    Parameters
    ----------
    jobs : sequence of StripJob
    options : RunOptions

    Returns
    -------
    SavedSurvey or None
        None where the jobs want none, where there is none yet, and where `overwrite` asks for a new one.

    Raises
    ------
    ConfigError
        Where the file cannot be read or holds no survey of a flight.
    """
    path = flight_path(options.folder)
    if options.overwrite or not any(job.request.flight for job in jobs) or not os.path.lexists(path):
        return None
    saved = load_survey(path)
    try:
        read_flight(saved.survey)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return saved


def with_flight(jobs: Sequence[StripJob], saved: SavedSurvey | None) -> list[StripJob]:
    """Return the jobs with the survey of their flight."""
    return [replace(job, request=replace(job.request, system=saved)) if job.request.flight else job for job in jobs]


def plan_strip(job: StripJob, options: RunOptions) -> dict[str, Any]:
    """Describe what `run_batch` would do with a strip, from its headers alone.

    Parameters
    ----------
    job : StripJob
    options : RunOptions

    Returns
    -------
    dict
        Plain values: action (write or skip), strip, output, columns, points, sizes.

    Raises
    ------
    InputError, ConfigError
        Where the run would refuse the strip before it begins.
    """
    (job,) = with_flight([job], load_flight([job], options))
    task = StripTask(job, options, alone=False)
    done = task.start(jobs=1) is not None
    facts = task.facts
    layout, is_laz = plan_layout(job, facts), job.options.format == "laz"
    plan_filter(job, layout)
    return {
        "action": "skip" if done else "write",
        "strip": str(job.path),
        "points": facts.header.point_count,
        "point_format": facts.header.point_format,
        "packet_bytes": facts.packets.end - facts.packets.start,
        "output": str(cloud_path(job, options.folder)),
        "output_point_format": layout.point_format,
        "columns": [written.record.name for written in layout.written],
        # LAZ takes about two fifths of LAS.
        "estimated_bytes": math.ceil(facts.header.point_count * layout.dtype.itemsize * (0.4 if is_laz else 1.0)),
    }
