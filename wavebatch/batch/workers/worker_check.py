"""Whether a worker of a cluster fits: same programs, same kind of processor, same files. Runs on the workers.

`dask_cluster` asks all workers before anything starts, and each that joins later before it gets work. Before you change
it: a worker that does not fit must never make a row of a cloud.
"""

from __future__ import annotations

import functools
import os
import platform
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy
import scipy

import wavebatch
from wavebatch.batch.workers.processor import describe_processor


@functools.cache
def describe_worker() -> dict[str, str]:
    """Return what results depend on, of this process: versions of packages, and the kind of the processor."""
    files = sorted(Path(wavebatch.__file__).parent.rglob("*.py"))
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        "wavebatch": f"{wavebatch.__version__} {zlib.crc32(b''.join(file.read_bytes() for file in files)):08x}",
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        **describe_processor(),
    }


def compare_workers(here: dict[str, str], there: dict[str, str]) -> str:
    """Return in what a worker differs from this machine; empty where it does not.

    Parameters
    ----------
    here, there : dict
        From `describe_worker`.

    Returns
    -------
    str
        The end of a message about the worker.
    """
    for name in ("python", "wavebatch", "numpy", "scipy"):
        if there.get(name) != here[name]:
            has = f"has {name} {there.get(name)}"
            return f"{has}, this machine {here[name]}; install the same there, so that the result is the same"
    if there.get("probe") != here["probe"]:
        return (
            f"has another kind of processor ({there.get('name')}), which rounds in another way than this machine "
            f"({here['name']}); take workers of one kind, and start wavebatch on one of them"
        )
    return ""


def list_sizes(files: Sequence[str]) -> list[int]:
    """Return the size of each file as this process sees it [bytes], -1 where it sees none.

    Parameters
    ----------
    files : sequence of str
        Absolute paths.

    Returns
    -------
    list of int
    """
    return [_size(file) for file in files]


def _size(file: str) -> int:
    try:
        return os.path.getsize(file)
    except (OSError, ValueError):
        return -1
