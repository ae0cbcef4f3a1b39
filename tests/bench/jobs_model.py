"""What each part of a run costs in each process, and what many jobs then reach.

    PYTHONPATH=tests python -m bench.jobs_model [STRIP] -o OUT

The parts are processor seconds of runs with one and two jobs that take turns; other load of the machine changes them
far less than it changes elapsed time. A machine of 64 cores is not needed to see what would bound 64 jobs: what one
process does alone, and what it does per waveform.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench.against import simulate_strips

from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import BatchResult, run_batch
from wavebatch.batch.unit import prepare_strip
from wavebatch.batch.workers.processes import Workers
from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import UNIT_POINTS
from wavebatch.files.strip.scanner import PART_UNITS
from wavebatch.tools.api import plan_run
from wavebatch.tools.bench.command import Worker
from wavebatch.tools.bench.report import write_texts

JOBS = (1, 2, 4, 16, 64)
"""Numbers of jobs of the table."""
MANY = 1000
"""Strips of the second column of the table: while one is prepared, others are processed."""
FEWEST_UNITS, MANY_UNITS = 2, 10
"""Units of a strip below which nothing is predicted, and below which a warning is given: fixed costs of a process
differ by a tenth of a second from run to run, which is much of the work then."""
PULSES, SMALL_PULSES = 600_000, 1_000
"""Of the simulated strip, more than ten units; and of the strips that show what a strip costs, however small."""
SMALL_STRIPS = 20
"""Strips of a batch that measures what each costs the process that writes."""
_IMPORTS = "import resource, wavebatch.tools.api, wavebatch.cli.run; r = resource.getrusage(resource.RUSAGE_SELF)"


@dataclass(frozen=True, slots=True)
class Lap:
    """One run of a strip."""

    elapsed: float
    """[s]."""
    own: float
    """Processor seconds of the process that writes."""
    workers: float
    """Those of the workers."""
    waveforms: int


@dataclass(frozen=True, slots=True)
class Parts:
    """What a run consists of; medians."""

    waveforms: int
    """Of the strip."""
    start: float
    """Before a run begins: processor seconds of the imports."""
    start_worker: float
    """The same of a worker; all start at once, while the parent starts."""
    scan: float
    """Scan of a strip: processor seconds, which several jobs share."""
    survey: float
    """What one process does after it, before the units of a strip."""
    single: float
    """One job: seconds per waveform; NaN for a strip that is too short, as the next ones."""
    work: float
    """Several jobs: seconds of the workers per waveform."""
    write: float
    """Several jobs: seconds of the process that writes, per waveform."""
    strip: float
    """The same per strip, however small."""
    tail: float
    """Workers wait for the last unit of a strip [s]; NaN too for a strip that is too short."""

    @property
    def prepare(self) -> float:
        """Scan and survey of a strip: processor seconds."""
        return self.scan + self.survey

    def scan_with(self, jobs: int) -> float:
        """Return the seconds until so many jobs have scanned a strip."""
        return self.scan / max(1, min(jobs, self.waveforms // (PART_UNITS * UNIT_POINTS)))

    @property
    def is_short(self) -> bool:
        """Whether the strip is too short for costs per waveform, and for predictions."""
        return self.waveforms < FEWEST_UNITS * UNIT_POINTS

    def predict(self, jobs: int, strips: int = 1) -> float:
        """Return the seconds of a batch of such strips on a machine with a core for every process."""
        n = self.waveforms
        if jobs == 1:
            return self.start + strips * (self.prepare + n * self.single)
        start = max(self.start, self.start_worker)
        writing = strips * (self.strip + n * self.write)
        if strips == 1:
            before = start + self.scan_with(jobs) + self.survey
            return before + max(n * self.work / jobs + self.tail * (1 - 1 / jobs), writing)
        return start + max(strips * (self.prepare + n * self.work) / jobs, writing) + self.prepare

    @property
    def most(self) -> float:
        """Return the number of jobs from which the process that writes is the slowest."""
        return (self.prepare + self.waveforms * self.work) / (self.strip + self.waveforms * self.write)


def measure_jobs(
    strip: Path, small: Path, folder: Path, rounds: int, say: Callable[[str], None]
) -> tuple[Parts, dict[int, list[Lap]]]:
    """Measure the parts of a run of a strip.

    Parameters
    ----------
    strip : Path
        The longer the better: MANY_UNITS or more. Below FEWEST_UNITS costs per waveform are NaN.
    small : Path
        A strip of few waveforms.
    folder : Path
        For the outputs.
    rounds : int
        Runs with one job and with two, in turn.
    say : callable
        Gets a line of progress.

    Returns
    -------
    parts : Parts
    laps : dict
        The runs by number of jobs.
    """
    laps: dict[int, list[Lap]] = {1: [], 2: []}
    with Worker() as worker:
        start_worker = worker.call(measure_worker)
        spent = [worker.call(time_preparation, strip, folder) for _ in range(rounds)]
        for turn in range(rounds):
            for jobs in (1, 2) if turn % 2 else (2, 1):
                say(f"running {strip.name} with {jobs} jobs, turn {turn + 1} of {rounds}")
                laps[jobs].append(worker.call(run_lap, strip, folder, jobs))
        say(f"running {SMALL_STRIPS} small strips")
        few = worker.call(run_small, small, folder / "small")
    scan, survey = (_middle(times) for times in zip(*spent, strict=True))
    prepare = scan + survey
    one, two = laps[1], laps[2]
    n = one[0].waveforms
    if not n:
        raise InputError(f"{strip}: has no waveforms to be timed")
    # Where other load moves `prepare` or `start_worker`, no difference may become negative.
    work = max(_middle([lap.workers - prepare - 2 * start_worker for lap in two]), 0.0) / n
    single = max(_middle([lap.own - prepare for lap in one]), 0.0) / n
    write = _middle([lap.own for lap in two]) / n
    if n < FEWEST_UNITS * UNIT_POINTS:
        single = work = write = math.nan
    parts = Parts(
        waveforms=n,
        start=time_imports(),
        start_worker=start_worker,
        scan=scan,
        survey=survey,
        single=single,
        work=work,
        write=write,
        strip=few,
        tail=work * n / max(n // UNIT_POINTS, 1) / 2,
    )
    return parts, laps


def _middle(values: Sequence[float]) -> float:
    return float(np.median(values))


def time_imports(repeats: int = 3) -> float:
    """Processor seconds until `wavebatch run` can begin."""
    command = [sys.executable, "-c", f"{_IMPORTS}; print(r.ru_utime + r.ru_stime)"]
    found = [subprocess.run(command, check=True, capture_output=True, text=True).stdout for _ in range(repeats)]
    return _middle([float(text) for text in found])


def measure_worker() -> float:
    """Processor seconds of a worker process that does nothing."""
    _, _, before = _usage()
    with Workers(2) as workers:
        for future in [workers.submit(time.sleep, 0.5), workers.submit(time.sleep, 0.5)]:
            future.result()
    return (_usage()[2] - before) / 2


def time_preparation(strip: Path, folder: Path) -> tuple[float, float]:
    """Processor seconds of scan, and of survey and planning."""
    (job,), _ = plan_run([strip], RunOptions(folder, overwrite=True))
    begin = time.process_time()
    prepared = prepare_strip(job)
    prepared.scan.close()
    scan = prepared.report.timing["scan"].processor
    return scan, time.process_time() - begin - scan


def run_lap(strip: Path, folder: Path, jobs: int) -> Lap:
    """Take the strip from file to file."""
    planned = plan_run([strip], RunOptions(folder, jobs=jobs, overwrite=True))
    before = _usage()
    result = run_batch(*planned)
    after = _usage()
    _raise_failure(result)
    elapsed, own, workers = (late - early for early, late in zip(before, after, strict=True))
    return Lap(elapsed, own, workers, result.report.count("waveforms"))


def run_small(strip: Path, folder: Path) -> float:
    """Processor seconds per strip of the process that writes, from a batch of copies of a small strip."""
    folder.mkdir(parents=True)
    copies = [folder / f"{number}{strip.suffix}" for number in range(SMALL_STRIPS)]
    for copy in copies:
        copy.write_bytes(strip.read_bytes())
    planned = plan_run(copies, RunOptions(folder / "clouds", jobs=2))
    _, before, _ = _usage()
    result = run_batch(*planned)
    _, after, _ = _usage()
    _raise_failure(result)
    return (after - before) / SMALL_STRIPS


def _raise_failure(result: BatchResult) -> None:
    """Raise the error of the first strip that failed: its time is not that of a run."""
    for outcome in result.outcomes:
        if outcome.error is not None:
            raise outcome.error


def _usage() -> tuple[float, float, float]:
    """Seconds that have passed, and processor seconds of this process and of its ended children."""
    try:
        import resource
    except ImportError as error:
        raise InputError("this system does not say what processes used; run it on Linux") from error
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return time.perf_counter(), own.ru_utime + own.ru_stime, children.ru_utime + children.ru_stime


def format_jobs(strip: str, parts: Parts, laps: dict[int, list[Lap]]) -> str:
    """The parts, the runs, and the table of the model."""
    lines = [
        f"{strip}: {parts.waveforms} waveforms; processor time, medians of {len(laps[1])} runs with one job and two",
        f"  start: {parts.start:.2f} s; of a worker, at the same time: {parts.start_worker:.2f} s",
        f"  scan of the strip, which jobs share: {parts.scan:.2f} s; survey, by one process: {parts.survey:.2f} s",
        f"  one job: {_list_cost(parts.single, 2)}",
        f"  two jobs: {_list_cost(parts.work, 2)} in the workers",
        f"  the process that writes: {_list_cost(parts.write, 3)}, or {1e3 * parts.strip:.1f} ms per strip",
        f"  elapsed, without the start: {_list_elapsed(laps[1])} s with one job, {_list_elapsed(laps[2])} s with two",
        *list_warnings(parts),
    ]
    if parts.is_short:
        return "\n".join(lines)
    lines += [
        "",
        "Predicted from these parts, with a core for every process:",
        f"{'jobs':>5}  {'this strip':>12}  {'times':>6}  {f'{MANY} strips':>12}  {'times':>6}  waveforms/s",
    ]
    for jobs in JOBS:
        one, many = parts.predict(jobs), parts.predict(jobs, MANY)
        lines.append(
            f"{jobs:5}  {one:10.2f} s  {parts.predict(1) / one:6.2f}  {many:10.0f} s  "
            f"{parts.predict(1, MANY) / many:6.2f}  {MANY * parts.waveforms / many:11,.0f}"
        )
    return "\n".join([*lines, f"The process that writes is the slowest from {parts.most:.0f} jobs on."])


def list_warnings(parts: Parts) -> list[str]:
    """What a strip of few units does not show."""
    if parts.waveforms >= MANY_UNITS * UNIT_POINTS:
        return []
    few = f"warning: {parts.waveforms} waveforms are fewer than"
    longer = f"; give a strip of {MANY_UNITS * UNIT_POINTS} or more, or --pulses"
    if parts.is_short:
        share = f"{few} {FEWEST_UNITS} units of {UNIT_POINTS}, which two jobs can share"
        return [f"{share}: what a waveform costs is no-data, and nothing is predicted{longer}"]
    return [f"{few} {MANY_UNITS} units of {UNIT_POINTS}: fixed costs of the processes blur all figures{longer}"]


def _list_cost(seconds: float, digits: int) -> str:
    return "no-data" if math.isnan(seconds) else f"{1e6 * seconds:.{digits}f} us per waveform"


def _list_elapsed(laps: Sequence[Lap]) -> str:
    return ", ".join(f"{lap.elapsed:.2f}" for lap in laps)


def to_document(strip: str, parts: Parts, laps: dict[int, list[Lap]]) -> dict[str, Any]:
    """The same as plain values."""
    known = () if parts.is_short else JOBS
    predicted = {str(jobs): {"strip_s": parts.predict(jobs), "many_s": parts.predict(jobs, MANY)} for jobs in known}
    runs = {str(jobs): [asdict(lap) for lap in of] for jobs, of in laps.items()}
    return {
        "strip": strip, "parts": {name: None if math.isnan(value) else value for name, value in asdict(parts).items()},
        "strips": MANY, "predicted": predicted, "most_jobs": None if parts.is_short else parts.most,
        "runs": runs, "warnings": list_warnings(parts),
    }  # fmt: skip


def main(words: Sequence[str] | None = None) -> None:
    """Measures a strip, or a simulated one; prints the tables and writes jobs.txt and jobs.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("strip", type=Path, nargs="?", metavar="STRIP", help="default: a simulated scene")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for jobs.txt and jobs.json")
    parser.add_argument("--scene", default="mixed")
    parser.add_argument("--pulses", type=int, default=PULSES, help="of the simulated strip")
    parser.add_argument("--repeat", type=int, default=3, help="rounds")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(words)
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as name:
        folder = Path(name)
        (folder / "small").mkdir()
        small = simulate_strips([given.scene], SMALL_PULSES, given.seed, folder / "small")[given.scene]
        strip = given.strip or simulate_strips([given.scene], given.pulses, given.seed, folder)[given.scene]
        say = (lambda text: print(text, file=sys.stderr)) if sys.stderr.isatty() else (lambda text: None)
        found = measure_jobs(strip, small, folder / "out", given.repeat, say)
    text, document = format_jobs(strip.name, *found), to_document(strip.name, *found)
    print(text)
    print(write_texts(given.output, {"jobs.txt": text, "jobs.json": json.dumps(document)}), file=sys.stderr)


if __name__ == "__main__":
    from bench.jobs_model import main  # worker processes find functions by the name of this module, not as __main__

    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
