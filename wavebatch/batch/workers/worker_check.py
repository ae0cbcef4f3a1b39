"""Whether a worker of a cluster fits: same programs, same kind of processor, same files. Runs on the workers.

`dask_cluster` asks all workers before anything starts, and each that joins later before it gets work. Before you change
it: a worker that does not fit must never make a row of a cloud.

Kinds of processors differ in the last bits of sums, and a survey's decisions follow them, so a strip's bytes would
depend on which worker it meets. NumPy and its BLAS choose code for the processor when they load; the probe shows what
was chosen by its results.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import subprocess
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy
import numpy as np
import scipy

import wavebatch
from wavebatch.core.process import CHILD


@functools.cache
def describe_worker() -> dict[str, str]:
    """Return what results depend on, of this process: versions of packages, and the kind of the processor.

    Returns
    -------
    dict
        `name`: the processor, for people; `probe`: equal on two machines if and only if arithmetic gave the same bits
        on both; `python`, `wavebatch`, `numpy`, `scipy`.

    Notes
    -----
    The probe runs in a process of one thread: threads share out large products, which none of wavebatch's are, and
    change their last bits.

    References
    ----------
    docs/reliability.md, "The same bytes".
    """
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    files = sorted(Path(wavebatch.__file__).parent.rglob("*.py"))
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        "wavebatch": f"{wavebatch.__version__} {zlib.crc32(b''.join(file.read_bytes() for file in files)):08x}",
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "name": name,
        "probe": _probe_alone(),
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


_PROBE = "from wavebatch.batch.workers.worker_check import probe_arithmetic; print(probe_arithmetic())"

_SIZES = ((3, 40), (13, 80), (19, 200), (64, 300))
"""Parameters and samples of the systems that are solved: from one echo in a window to the stack of a pulse."""


@functools.lru_cache(maxsize=1)
def _probe_alone() -> str:
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, **CHILD, "PYTHONPATH": path}
    found = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, check=True)
    return found.stdout.strip()


def probe_arithmetic() -> str:
    """Return a checksum of products, solutions, sums and functions whose last bits differ between processors."""
    digest = hashlib.sha256()
    for parameters, samples in _SIZES:
        for kind in (np.float64, np.float32):
            # Numbers of many digits that every machine makes alike: whole numbers, then one division.
            place = np.arange(parameters * samples, dtype=np.uint64)
            mixed = (place * np.uint64(2654435761) + np.uint64(12345)) % np.uint64(1_000_003)
            digits = (mixed.astype(np.float64) / 500_001.5 - 1.0).reshape(parameters, samples)
            rows: np.ndarray = digits.astype(kind)
            gram = rows @ rows.T
            matrix = gram.astype(np.float64) + np.eye(parameters)
            results = [
                gram,
                rows @ rows[0],
                np.linalg.solve(matrix, rows[:, :5].astype(np.float64)),
                np.linalg.inv(matrix),
                np.linalg.eigvalsh(matrix),
                np.linalg.lstsq(rows.T.astype(np.float64), np.arange(samples, dtype=np.float64), rcond=None)[0],
                np.einsum("pl,ql->pq", rows, rows),
                rows.sum(axis=1),
                np.exp(-rows),
                np.log1p(np.abs(rows)),
                np.sqrt(np.abs(rows)).sum(axis=0),
            ]
            for result in results:
                digest.update(np.ascontiguousarray(result).tobytes())
    return digest.hexdigest()[:16]
