"""What a run will do before it begins: memory, outputs that collide with inputs, and the plan of each strip."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from wavebatch.batch.report_file import cloud_path
from wavebatch.batch.strip_task import BatchOptions, StripTask
from wavebatch.batch.unit import StripJob, plan_layout
from wavebatch.core.errors import ConfigError

LEAST_MEMORY = 300 << 20
"""Bytes that one process needs with the smallest blocks."""

FULL_MEMORY = 500 << 20
"""Bytes that one process takes with full blocks."""

SMALL_BLOCK = 1024
"""Waveforms of a block when memory is short."""



def plan_memory(options_jobs: int, memory: int | None) -> tuple[int, int | None]:
    """Number of processes and block size with which a run stays within `memory` bytes, all processes together.

    The process that writes counts too when there are others. Raises ConfigError where not even one process fits.
    """
    if memory is None:
        return options_jobs, None
    if memory < LEAST_MEMORY:
        raise ConfigError(f"--memory: {memory >> 20} MB is too little, one job needs {LEAST_MEMORY >> 20} MB")
    processes = max(min(memory // LEAST_MEMORY, options_jobs + (options_jobs > 1)), 1)
    jobs = max(processes - 1, 1) if options_jobs > 1 else 1
    processes = jobs + (jobs > 1)
    return jobs, SMALL_BLOCK if memory // processes < FULL_MEMORY else None


def check_outputs(jobs: Sequence[StripJob], options: BatchOptions) -> None:
    """Raises ConfigError where an output would take the place of an input."""
    inputs = {os.path.realpath(job.path): job.path for job in jobs}
    for job in jobs:
        targets = [cloud_path(job, options.folder)]
        if job.options.keep_packets:
            targets.append(targets[0].with_suffix(".wdp"))
            inputs.setdefault(os.path.realpath(job.path.with_suffix(".wdp")), job.path.with_suffix(".wdp"))
        for target in targets:
            if os.path.realpath(target) in inputs:
                raise ConfigError(f"{target}: the output would replace this input; choose another output folder")


def estimate_output(points: int, record_size: int, *, compressed: bool) -> int:
    """Bytes that a cloud will take, roughly: LAZ needs about two fifths of LAS."""
    return math.ceil(points * record_size * (0.4 if compressed else 1.0))


def plan_strip(job: StripJob, options: BatchOptions) -> dict[str, Any]:
    """What `run_batch` would do with a strip, from its headers alone; nothing is written.

    Raises InputError or ConfigError where it would fail before it begins.
    """
    done = StripTask(job, options, alone=False).start() is not None
    with job.open() as reader:
        facts = reader.facts
    layout = plan_layout(job, facts)
    return {
        "action": "skip" if done else "write",
        "strip": str(job.path),
        "points": facts.point_count,
        "point_format": facts.point_format,
        "packet_bytes": facts.packet_end - facts.packet_start,
        "output": str(cloud_path(job, options.folder)),
        "output_point_format": layout.point_format,
        "columns": [written.record.name for written in layout.written],
        "estimated_bytes": estimate_output(
            facts.point_count, layout.dtype.itemsize, compressed=job.options.format == "laz"
        ),
    }
