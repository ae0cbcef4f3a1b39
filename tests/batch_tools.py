"""Runs for tests: a strip through a profile in this process, and what came out."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np

from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.stages.chain import load_profile


def make_job(path, *, profile="fast", columns=None, **options) -> StripJob:
    """A job of a strip with a shipped chain."""
    chain = load_profile(profile)
    return StripJob(Path(path), chain, RunOptions(profile=profile, **options), choose_columns(chain, columns))


def run_one(path, folder, *, profile="fast", columns=None, batch=None, **options):
    """The outcome of one strip; options are those that decide what is written, `batch` the others."""
    job = make_job(path, profile=profile, columns=columns, **options)
    result = run_batch([job], RunOptions(Path(folder), **(batch or {})))
    return result.outcomes[0]


def read_cloud(path) -> tuple[np.ndarray, np.ndarray]:
    """Records of a cloud under laspy's names, and coordinates [m] (n, 3)."""
    with laspy.open(path) as reader:
        points = reader.read_points(reader.header.point_count)
        return points.array, np.stack([np.asarray(points[axis]) for axis in "xyz"], axis=1)


def read_outputs(folder) -> dict:
    """Bytes of all files in a folder by name; of reports what they say, without timing."""
    found = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    for name in found:
        if name.endswith(".report.json"):
            found[name] = {key: value for key, value in json.loads(found[name]).items() if key != "timing"}
    return found


def is_alive(pid) -> bool:
    """Whether the process runs; one that ended and was not collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(true: Callable[[], bool], what: str = "") -> None:
    """Wait until it is true; on a busy machine that may take minutes."""
    deadline = time.monotonic() + 300
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)
