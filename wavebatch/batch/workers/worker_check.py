"""Whether a worker of a cluster fits: same programs, same kind of processor, same files. Runs on the workers.

`dask_cluster` asks all workers before anything starts, and `describe_worker` again with every call, because workers
join later. Before you change it: a worker that does not fit must never make a row of a cloud.
"""

from __future__ import annotations

import functools
import os
import platform
import zlib
from collections.abc import Callable, Sequence
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


def compare_workers(here: dict[str, str], there: dict[str, str | None]) -> str:
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
            has = f"has {name} {there[name]}" if there.get(name) else f"has no {name}"
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


def travelling_kind() -> Callable[[], dict[str, str | None]]:
    """Return `describe_worker` as code: a worker may have another wavebatch, or none."""

    def find() -> dict[str, str | None]:
        try:
            from wavebatch.batch.workers.worker_check import describe_worker

            return describe_worker()
        except Exception:
            import platform
            import sys

            version = getattr(sys.modules.get("wavebatch"), "__version__", None)
            return {"python": ".".join(platform.python_version_tuple()[:2]), "wavebatch": version}

    return find


def travelling_call() -> Callable[[bytes, dict[str, str]], bytes]:
    """Return a function that makes a pickled call and pickles (result, error), if the worker is of the client's kind.

    It is sent as code, calls and results as bytes: the scheduler unpickles all else, and may lack wavebatch.
    """
    find = travelling_kind()

    def call(pickled: bytes, kind: dict[str, str]) -> bytes:
        import pickle
        import traceback

        found = find()
        if found != kind:
            from distributed import get_worker

            return pickle.dumps(((get_worker().address, found), "misfit"))
        try:
            function, arguments = pickle.loads(pickled)
            return pickle.dumps((function(*arguments), None), pickle.HIGHEST_PROTOCOL)
        except Exception as error:
            error.add_note(traceback.format_exc())
            return pickle.dumps((None, error))

    return call
