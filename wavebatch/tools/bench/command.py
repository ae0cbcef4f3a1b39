"""The benchmark as a whole: measures chains on scenes, and returns one document of plain values; its sheet and files.

`wavebatch bench` calls `run_bench`, prints `bench_sheet` and calls `write_outputs`. In go scenes and chains; out comes
a document whose keys are the format of bench.json: change SCHEMA when they change. All but times and memory is the same
for the same options. `_measure_scene` has the order of the parts below it: which chains, on what echoes, how exact, how
fast. A scene may be shaped like a strip: it draws whole waveforms of a sample of it with small changes. `auto` is the
chain that a survey of a group chooses.

`time_chains` measures run time and memory: kernels alone and from file to file, each chain in a process with one
thread. The chains take turns, so that other load of the machine slows all of them alike. The process of a Worker is
one of those of `wavebatch run`.

The sheet, bench.json, bench.txt, a page and plots of error against run time show the document. A column of a table
names a figure of the rows.
"""

from __future__ import annotations

import json
import math
import pickle
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from operator import attrgetter
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Any

import numpy as np

from wavebatch import __version__
from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.batch.unit import BLOCK_SAMPLES
from wavebatch.batch.workers.futures import PATIENCE, WorkerDied, end_future, wait_uninterrupted
from wavebatch.batch.workers.spawned import Call, PipedProcess, start_early, take_early
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError, advise_install
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import join_ranges
from wavebatch.core.process import Seconds
from wavebatch.core.schema import Range, option
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.publish import reporting
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.figure_file import has_matplotlib, open_picture, plain_text
from wavebatch.files.strip.reader import SAMPLE_WAVEFORMS, StripReader
from wavebatch.files.text_file import write_text
from wavebatch.stages.chain import STAGES, Chain, Step, effective, load_chain_file, load_profile
from wavebatch.stages.score import QUANTITIES
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import choose_chain
from wavebatch.surveying.look import pool_blocks
from wavebatch.tools.api import AUTO
from wavebatch.tools.bench import accuracy
from wavebatch.tools.sheets.sheet import Cell, Later, Note, Picture, Sheet, SheetPart, Table
from wavebatch.tools.simulate import PulseModel, Recording, Scene, find_scene, simulate_blocks, simulate_strip
from wavebatch.tools.simulate.scenes import Drawn

SCHEMA = "wavebatch.bench/1"
BenchProgress = Callable[[str], None]
BenchRows = list[dict[str, Any]]


@frozen
class BenchOptions:
    """What a benchmark measures."""

    strip: Path | None = None
    """Strip whose survey and echoes the simulated waveforms follow."""
    scenes: tuple[str, ...] = ()
    """Named scenes, in addition to the strip."""
    chains: tuple[Path, ...] = ()
    """Chain files, in addition to the shipped chains."""
    all_methods: bool = option(False, "Also measure every detector and every decomposer.")
    seed: int = 0
    waveforms: Annotated[int, Range(1, math.inf)] = option(65_536, "Simulated waveforms per scene.", form="N")
    repeats: Annotated[int, Range(1, math.inf)] = option(3, "Repetitions of the timing.", form="N", name="repeat")
    pulses: Annotated[int, Range(0, math.inf)] = option(
        50_000, "Pulses of the strip that is timed from file to file; 0: time the algorithms only.", form="N"
    )
    tolerance_cm: float | None = None
    """Largest error of the range of isolated echoes for the choice of the cheapest chain."""


def run_bench(
    options: BenchOptions,
    progress: BenchProgress = lambda text: None,
    measure_others: Callable[[Scene, list[accuracy.Group]], BenchRows] = lambda scene, groups: [],
) -> dict[str, Any]:
    """Runs a benchmark and returns its document of plain values.

    measure_others: gives more rows of a scene, made by `make_row`, of programs that are no chains.
    Raises ConfigError for unknown scenes and chains that cannot run, InputError for a strip that cannot be used.
    """
    chains = load_chains(options.chains)
    scenes: list[Scene] = [find_scene(name) for name in options.scenes]
    if options.strip is not None:
        progress(f"surveying {options.strip}")
        scenes.insert(0, shape_scene(options.strip, chains["accurate"]))
    if not scenes:
        raise ConfigError("nothing to measure: give a strip or --scene NAME")
    measured = chains | (list_methods() if options.all_methods else {})
    sections = [
        _measure_scene(scene, measured, options, place, progress, measure_others) for place, scene in enumerate(scenes)
    ]
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "seed": options.seed,
        "error_means": "standard error of the difference between two runs that differ in their seed",
        "scenes": sections,
    }
    if options.tolerance_cm is not None:
        document["tolerance_cm"] = options.tolerance_cm
    return document


def _measure_scene(
    scene: Scene, chains: Mapping[str, Chain], options: BenchOptions, place: int, progress: BenchProgress,
    measure_others: Callable[[Scene, list[accuracy.Group]], BenchRows],
) -> dict[str, Any]:  # fmt: skip
    seed = accuracy.derive_seed(options.seed, place)
    groups = accuracy.make_groups(scene, options.waveforms, seed, progress)
    chosen = [{**chains, AUTO: choose_chain(group.survey)} for group in groups]
    twin = find_twin(chosen)
    measured = {name: chain for name, chain in chosen[0].items() if name != AUTO or twin is None}
    tallies = {name: accuracy.AccuracyTally() for name in measured}
    for name, tally in tallies.items():
        progress(f"{scene.name}: error of {name}")
        for group, of_group in zip(groups, chosen, strict=True):
            tally.add(group, of_group[name].run(group.block, group.system))
    timed = {name: (chain, groups[0].system) for name, chain in measured.items()}
    block, strip = groups[0].block, None
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as folder:
        if options.pulses:
            # As many waveforms as a run takes through a chain at a time.
            n = min(options.pulses, BLOCK_SAMPLES // scene.recording.n_samples)
            block = next(simulate_blocks(scene, n, seed=seed, size=n))[0]
            strip = Path(folder, "strip.laz")
            simulate_strip(scene, strip, pulses=options.pulses, seed=seed)
        laps = time_chains(timed, block, strip, Path(folder), options.repeats, progress)
    rows = [make_row(name, "chain", tally, laps[name]) for name, tally in tallies.items()]
    if twin:
        rows.append({**next(row for row in rows if row["name"] == twin), "name": AUTO, "same_as": twin})
    rows += measure_others(scene, groups)
    # Whether no other chain is as good in time, error and wrong echoes, and better in one of them. Peers get other and
    # fewer waveforms: they are never on the front.
    names = ("rmse_all_cm", "wrong")
    costs = [(row["kernels"]["median"], *(row["figures"][name]["value"] for name in names))
             if row["kind"] == "chain" else (None,) * 3 for row in rows]  # fmt: skip
    for row, best in zip(rows, accuracy.find_front(costs).tolist(), strict=True):
        row["pareto"] = best
    # Range of the results of the groups' surveys.
    fields = {"noise_std": "noise.std", "noise_gain": "noise.gain"}
    names = ("sigma_ref", "noise_std", "kappa", "noise_gain", "ringing", "acceptance")
    values = {name: map(attrgetter(fields.get(name, name)), (group.system for group in groups)) for name in names}
    survey = {
        "groups": len(groups),
        "waveforms_of_a_group": len(groups[0].block),
        **{name: accuracy.median_range([float(value) for value in found]) for name, found in values.items()},
        "components": sorted({len(group.system.components) for group in groups}),
    }
    section = {"scene": scene.name, "meaning": scene.meaning, "survey": survey, "rows": rows}
    if options.tolerance_cm is not None:
        cheapest = accuracy.choose_cheapest([row for row in rows if row["kind"] == "chain"], options.tolerance_cm)
        section["cheapest"] = cheapest["name"] if cheapest else None
    return section


def make_row(name: str, kind: str, tally: accuracy.AccuracyTally, laps: Laps) -> dict[str, Any]:
    """The row of a chain or of another program (kind: chain or peer)."""
    figures = {key: figure.to_json() for key, figure in tally.figures().items()}
    found = asdict(laps).items()
    times = {key: accuracy.median_range(value) if isinstance(value, list) else value for key, value in found}
    return {"name": name, "kind": kind, "waveforms": tally.waveforms, "figures": figures, **times}


# Chains

PROFILES = ("fast", "balanced", "accurate")
"""Shipped chains that are always measured, cheapest first."""

ATTRIBUTES = ("attribute.amplitude", "attribute.echo_width", "attribute.position")
"""Attributes that the shipped chains compute too, so that times can be compared."""

DETECTORS = {"decompose.asdf_only": "detect.asdf", "decompose.asdf_mixed": "detect.asdf"}
"""Detectors of decomposers that refuse `detect.maximum`."""


def load_chains(files: Sequence[Path]) -> dict[str, Chain]:
    """The shipped chains and those of the files, by the names that rows of the benchmark have."""
    chains = {name: load_profile(name) for name in PROFILES}
    for path in files:
        name = path.stem if path.stem not in chains else str(path)
        if name in chains:
            raise ConfigError(f"{path}: given twice; give every chain file once")
        chains[name] = load_chain_file(path)
    return chains


def find_twin(chosen: Sequence[Mapping[str, Chain]]) -> str | None:
    """The chain that equals `auto` on every strip, so that `auto` need not be measured; None if there is none.

    chosen: the chains of each strip.
    """
    for name in chosen[0]:
        if name != AUTO and all(AUTO in each and effective(each[name]) == effective(each[AUTO]) for each in chosen):
            return name
    return None


def list_methods() -> dict[str, Chain]:
    """A chain per detector, without a fit, and per decomposer, after a detector that serves it; by stage."""
    names = {kind: sorted(name for name in STAGES if STAGES[name].kind == kind) for kind in ("detect", "decompose")}
    pairs = {name: (name, "decompose.none") for name in names["detect"]}
    others = (name for name in names["decompose"] if name != "decompose.none")
    pairs |= {name: (DETECTORS.get(name, "detect.maximum"), name) for name in others}
    return {
        name: Chain(tuple(Step(STAGES[stage]) for stage in ("noise.pooled", *pair, *ATTRIBUTES)), name)
        for name, pair in pairs.items()
    }


# A scene like a strip

LEAST_WAVEFORMS = 200
"""Least waveforms of a strip whose echoes can be resampled."""

JITTER = 0.05
"""Relative change of the amplitudes and gaps of a resampled waveform, one standard deviation."""

STRONG = 20.0
"""Signal to noise from which measured widths show the true spread of widths."""


@frozen(eq=False)
class Sample:
    """Echoes of decomposed waveforms, to draw from."""

    first: np.ndarray
    """Row of each waveform's first echo, i8 (n,)."""
    count: np.ndarray
    """Echoes of each waveform, i8 (n,)."""
    time: np.ndarray
    amplitude: np.ndarray
    sigma: np.ndarray
    """Of the main lobe [ns], without the scatter of its error, f8 (m,)."""


@frozen
class StripScene(Scene):
    """Waveforms like those of a strip, drawn from a sample of its echoes."""

    sample: Sample | None = None

    def draw(self, rng: np.random.Generator, n: int, incidence: np.ndarray) -> Drawn:
        """Echoes of n waveforms: whole waveforms of the strip, shifted by part of a sample, with JITTER.

        Echoes outside the window are dropped.
        """
        sample, recording = self.sample, self.recording
        chosen = rng.integers(0, len(sample.count), n)
        count = sample.count[chosen]
        waveform = np.repeat(np.arange(n), count)
        row = join_ranges(sample.first[chosen], count)
        start = sample.time[np.repeat(sample.first[chosen], count)]
        stretch = np.exp(JITTER * rng.standard_normal(n))[waveform]
        shift = rng.uniform(-0.5, 0.5, n)[waveform] * recording.spacing
        time = start + shift + (sample.time[row] - start) * stretch
        amplitude = sample.amplitude[row] * np.exp(JITTER * rng.standard_normal(len(row)))
        inside = (time > 0) & (time < recording.duration)
        return Drawn(waveform[inside], time[inside], amplitude[inside], sample.sigma[row][inside])


def shape_scene(strip: Path, chain: Chain) -> StripScene:
    """A scene like the strip: noise, baselines and pulse of its survey, and the echoes that `chain` finds in it.

    Raises InputError where the strip cannot be read or holds too few waveforms.
    """
    with StripReader(strip) as reader, reader.scan() as scan:
        blocks = [block for block in reader.sample_blocks(scan, SAMPLE_WAVEFORMS) if len(block)]
    kinds: dict[tuple[float, int], list[WaveformBlock]] = {}
    for block in blocks:
        kinds.setdefault((block.spacing, block.samples.shape[1]), []).append(block)
    chosen = max(kinds.values(), key=lambda alike: sum(block.samples.size for block in alike), default=[])
    number = sum(map(len, chosen))
    if number < LEAST_WAVEFORMS:
        raise InputError(
            f"{strip}: {number} waveforms of one length are too few to shape a benchmark like it ({LEAST_WAVEFORMS} "
            "are needed); name a scene with --scene"
        )
    block = pool_blocks(chosen)
    system = survey_blocks([block]).system
    # The receiver that the survey found: levels, noise and its colour, clipping, learned pulse. The noise is that of a
    # sample: `noise.std` is what coloured noise does to the amplitude of a pulse.
    # The binomial filter whose noise changes by [1 2 1] as the noise of the strip does.
    first, second = (*system.noise.correlation, 0.0, 0.0)[:2]
    color = int(np.argmin(np.abs(accuracy.smoothed_power(np.arange(5)) - (6 + 8 * first + 2 * second))))
    pulse = PulseModel(sigma=system.sigma_ref, kappa=system.kappa)
    if len(system.components) > 1:
        weight, delay, sigma = system.components[0]
        pulse = PulseModel(sigma, 0.0, tuple((w / weight, d - delay, s) for w, d, s in system.components[1:]))
    clip = None if system.saturation is None else int(min(system.saturation, block.digitizer.max_count))
    recording = Recording(
        n_samples=block.samples.shape[1],
        spacing=block.spacing,
        bits=block.digitizer.bits,
        baseline=system.noise.baseline,
        baseline_spread=system.noise.baseline_spread,
        noise_std=float(np.sqrt(max(system.noise.quiet**2 - QUANTISATION_STD**2, 0.0))),
        rho=color / (color + 1),
        noise_gain=system.noise.gain,
        saturation=clip,
        pulse=pulse,
    )
    found = chain.run(block, system)
    bad = int(EchoFlag.NOT_CONVERGED | EchoFlag.NEAR_EDGE | EchoFlag.AMPLITUDE_UNRELIABLE)
    keep = ((found.flags & bad) == 0) & (found.time > 0) & (found.time < recording.duration)
    found = found.take(np.flatnonzero(keep))
    # Widths move towards the typical one by the share of their spread that their error explains.
    sigma = found.sigma.astype(np.float64)
    strong = sigma[found.amplitude > STRONG * system.noise.std]
    if len(strong) < 2:
        sigma[:] = system.sigma_ref
    else:
        typical, spread = float(np.median(strong)), float(strong.var())
        error = np.nan_to_num(found.sigma_err.astype(np.float64), nan=0.0, posinf=1e3)
        sigma = typical + (sigma - typical) * spread / np.maximum(spread + error**2, 1e-12)
    lobe, count = recording.pulse.sigma, found.count(len(block))
    sample = Sample(
        first=np.cumsum(count) - count,
        count=count,
        time=found.time,
        amplitude=np.clip(found.amplitude.astype(np.float64), 1.0, 4.0 * (1 << recording.bits)),
        sigma=np.clip(sigma * (lobe / system.sigma_ref), 0.85 * lobe, 4.0 * lobe),
    )
    return StripScene(strip.name, f"like {strip.name}", recording=recording, sample=sample)


# Run time and memory

PREPARATION = ("scan", "survey")
"""Parts of a run whose time does not grow with the strip."""


@dataclass(slots=True)
class Laps:
    """Repeated measurements of one chain; the names are those of the document."""

    kernels: list[float] = field(default_factory=list)
    """Microseconds per waveform."""
    file: list[float] = field(default_factory=list)
    """Microseconds per waveform from file to file, without scan and survey."""
    file_with_survey: list[float] = field(default_factory=list)
    """Microseconds per waveform from file to file."""
    survey_seconds: list[float] = field(default_factory=list)
    """Seconds of scan and survey."""
    peak_bytes: int | None = None
    """Peak memory."""


class FileRun(NamedTuple):
    """A run from file to file."""

    seconds: float
    survey_seconds: float
    """Of these, scan and survey."""
    waveforms: int


def time_chains(
    chains: Mapping[str, tuple[Chain, SystemPulse]],
    block: WaveformBlock,
    strip: Path | None,
    folder: Path,
    repeats: int,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Laps]:
    """Laps of every chain: kernels on the block, and from `strip` to a cloud in the folder (None: kernels only)."""
    laps = {name: Laps() for name in chains}
    workers = {name: Worker() for name in chains}
    try:
        for name, (chain, system) in chains.items():
            workers[name].call(run_kernels, chain, block, system)
        for turn in range(repeats):
            for name, (chain, system) in chains.items():
                progress(f"timing {name}, turn {turn + 1} of {repeats}")
                seconds = workers[name].call(run_kernels, chain, block, system)
                laps[name].kernels.append(1e6 * seconds / len(block))
                if strip is not None:
                    clouds = folder / re.sub(r"\W", "-", name)
                    run, lap = workers[name].call(run_file, chain, strip, clouds, 1), laps[name]
                    lap.file.append(1e6 * (run.seconds - run.survey_seconds) / run.waveforms)
                    lap.file_with_survey.append(1e6 * run.seconds / run.waveforms)
                    lap.survey_seconds.append(run.survey_seconds)
        for name, worker in workers.items():
            laps[name].peak_bytes = worker.call(peak_memory)
    finally:
        for worker in workers.values():
            worker.close()
    return laps


def run_kernels(chain: Chain, block: WaveformBlock, system: SystemPulse) -> float:
    """Seconds for noise, detection and decomposition of the block."""
    timing: dict[str, Seconds] = {}
    chain.run(block, system, timing)
    return sum(timing[step.stage.name].wall for step in chain.steps[:3])


def run_file(chain: Chain, strip: Path, folder: Path, jobs: int) -> FileRun:
    """Times the strip through the batch, as `wavebatch run` does it."""
    job = StripJob(strip, chain, columns=choose_columns(chain))
    begin = time.perf_counter()
    result = run_batch([job], RunOptions(folder, jobs=jobs, overwrite=True))
    seconds = time.perf_counter() - begin
    for outcome in result.outcomes:
        if outcome.error is not None:
            raise outcome.error
    timing = result.report.timing
    return FileRun(seconds, sum(timing[name].wall for name in PREPARATION), result.report.count("waveforms"))


def peak_memory() -> int | None:
    """Peak memory of this process [bytes]; None where the system does not report it."""
    try:
        lines = Path("/proc/self/status").read_text("ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


class Worker(Closing):
    """Runs functions in a process of their own, one after another; a context manager."""

    def __init__(self) -> None:
        self._calls: SimpleQueue[Call | None] = SimpleQueue()
        start_early(1)
        self._process = PipedProcess(take_early(), self._calls, None)

    def call(self, function: Callable, *arguments: Any) -> Any:
        """`function(*arguments)` computed in the process; both must be picklable.

        Raises WorkerDied, or whatever the function raised. A caller that cannot wait uses a thread: `close` ends it.
        """
        call = Call(pickle.dumps((function, arguments), pickle.HIGHEST_PROTOCOL))
        self._calls.put(call)
        while not wait_uninterrupted([call.future], PATIENCE):
            self._process.look()
            if not self._process.serves:  # it died before it took the call
                end_future(call.future, error=WorkerDied("the measuring process ended"))
        return call.future.result()

    def close(self) -> None:
        """Kills the process."""
        self._process.process.kill()
        self._calls.put(None)
        self._process.process.join()


# The document as a sheet

ReportColumn = tuple[str, str, float, int]
"""Head, name of the figure, factor, decimals."""

SHARES: tuple[ReportColumn, ...] = (
    ("complete %", "completeness", 100, 2),
    ("correct %", "correctness", 100, 2),
    ("exact %", "exact_count", 100, 2),
    ("splits %", "false_splits", 100, 2),
    ("isolated %", "found_isolated", 100, 2),
    ("overlapped %", "found_overlapped", 100, 2),
)

LENGTHS: tuple[ReportColumn, ...] = (
    ("all cm", "rmse_all_cm", 1, 2),
    ("isolated cm", "rmse_isolated_cm", 1, 2),
    ("overlapped cm", "rmse_overlapped_cm", 1, 2),
)

REPORTED: tuple[ReportColumn, ...] = (
    ("no flag", "time_calibration_not_flagged", 1.0, 2),
    ("flag", "time_calibration_flagged", 1.0, 2),
    ("neighbours found", "time_calibration_not_hidden", 1.0, 2),
    ("one not found", "time_calibration_hidden", 1.0, 2),
    ("share of these %", "hidden", 100, 2),
)
"""Errors of times over the reported ones: echoes without and with a flag of UNCLEAN, and by what was found around."""


def bench_sheet(document: Mapping[str, Any]) -> Sheet:
    """The sheet of a benchmark: for each scene what was measured of every chain."""
    words = (
        f"wavebatch {document['version']} bench, seed {document['seed']}. +- is the {document['error_means']} "
        "(1.41 times that of the figure)."
    )
    scenes = (_scene_sheet(one, document.get("tolerance_cm")) for one in document["scenes"])
    return Sheet("bench", [Note(words), *scenes])


def _scene_sheet(section: Mapping[str, Any], tolerance_cm: float | None) -> Sheet:
    rows, survey = section["rows"], section["survey"]
    found = (
        f"survey of {survey['groups']} x {survey['waveforms_of_a_group']} waveforms: "
        f"sigma {_span(survey['sigma_ref'])} ns, noise {_span(survey['noise_std'])} DN, "
        f"kappa {_span(survey['kappa'])}, "
        f"acceptance {_span(survey['acceptance'])}, Gaussians {', '.join(map(str, survey['components']))}"
    )
    parts: list[SheetPart] = [Note(f"== {section['scene']}: {section['meaning']}"), Note(found)]
    head = ("median (least..most) waveforms/s", "kernels", "file to file", "with survey", "survey s", "MB", "front")
    lines = []
    for row in rows:
        name = row["name"]
        if row.get("same_as"):
            name += f" (is {row['same_as']})"
        if row.get("crashed_or_hung"):
            name += f" ({row['crashed_or_hung']} crashed or hung)"
        rates = []
        for times in (row[kind] for kind in ("kernels", "file", "file_with_survey")):  # microseconds per waveform
            rate, least, most = (1e6 / times[end] if times["median"] else 0.0 for end in ("median", "max", "min"))
            rates.append(Cell(f"{rate:,.0f} ({least:,.0f}..{most:,.0f})", rate) if rate else Cell("-", ""))
        megabytes = None if row["peak_bytes"] is None else row["peak_bytes"] / 1e6
        lines.append((name, *rates, row["survey_seconds"]["median"], megabytes, "*" if row["pareto"] else ""))
    speeds = Table(head, lines, ("", "", "", "", ".2f", ".0f", ""), sortable=True)
    parts += [Later(partial(_draw_scene, section)), speeds]
    parts += [_figure_table("echoes found", rows, SHARES), _figure_table("rms error of the range", rows, LENGTHS)]
    for kind in ("isolated", "overlapped"):
        ratios = [(name, f"{name}_ratio_{kind}", 1.0, 3) for name in QUANTITIES]
        ratios += [("gross %", f"gross_{kind}", 100, 2), ("err column", f"time_calibration_{kind}", 1.0, 3)]
        parts.append(_figure_table(f"{kind}: rms error / Cramer-Rao bound, SNR >= 10", rows, ratios))
    parts.append(_figure_table("rms error of the time / its error column, SNR >= 10", rows, REPORTED))
    if tolerance_cm is not None:
        wanted = f"an error of {tolerance_cm:g} cm for isolated echoes"
        best = next((row for row in rows if row["name"] == section["cheapest"]), None)
        words = f"cheapest chain with {wanted}: {best['name']} ({figure_text(best, LENGTHS[1])} cm)" if best else ""
        parts.append(Note(words or f"no chain meets {wanted}"))
    return Sheet(f"Scene {section['scene']}", parts)


def _span(times: Mapping[str, Any]) -> str:
    low, high = f"{times['min']:.4g}", f"{times['max']:.4g}"
    return low if low == high else f"{low}..{high}"


def _figure_table(title: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[ReportColumn]) -> Table:
    lines = [(row["name"], *(Cell(figure_text(row, one), row["figures"][one[1]]["value"]) for one in columns))
             for row in rows]  # fmt: skip
    return Table((title, *(column[0] for column in columns)), lines, sortable=True)


def figure_text(row: Mapping[str, Any], column: ReportColumn) -> str:
    """A figure of a row with its error; a dash where there is no figure."""
    _, name, factor, decimals = column
    figure = row["figures"][name]
    if figure["value"] is None:
        return "-"
    text = f"{figure['value'] * factor:.{decimals}f}"
    return text if figure["error"] is None else f"{text} +-{figure['error'] * factor:.{decimals}f}"


# Files and pictures

NO_PLOT = f"no plot without matplotlib: {advise_install('matplotlib')}"
PANELS = (
    ("wrong", 100.0, "echoes missed or false [%]"),
    ("rmse_all_cm", 1.0, "rms error of the range, all echoes [cm]"),
)


def write_outputs(document: Mapping[str, Any], text: str, folder: Path) -> list[str]:
    """Writes bench.json, bench.txt with the text, and a PNG per scene, replacing old ones; returns messages.

    Without matplotlib there are no plots, and a message says how to get them. Raises InputError where it cannot write.
    """
    texts = {"bench.json": json.dumps(document, indent=1, sort_keys=True), "bench.txt": text}
    written = write_texts(folder, texts)
    if not has_matplotlib():
        return [written, NO_PLOT]
    for section in document["scenes"]:
        name = f"bench-{Path(section['scene']).stem}.png"
        with open_picture(folder / name, (11, 4.6), overwrite=True, dpi=120) as figure:
            figure.suptitle(plain_text(f"{section['scene']}: error against run time, one core"))
            for axes, panel in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
                _draw_panel(axes, section["rows"], *panel)
        written += f", {name}"
    return [written]


def write_texts(folder: Path, texts: Mapping[str, str]) -> str:
    """Writes texts by file name into a folder, replacing old ones; returns a line that names them."""
    with reporting(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(folder / name, text + "\n", overwrite=True)
    return f"{folder}: {', '.join(texts)}"


def _draw_scene(section: Mapping[str, Any]) -> Iterator[Picture]:
    """The same panels for a page."""
    from wavebatch.tools.plots.charts import picture

    for panel in PANELS:
        draw = lambda figure, panel=panel: _draw_panel(  # noqa: E731
            figure.add_axes((0.12, 0.14, 0.85, 0.82)), section["rows"], *panel
        )
        yield from picture(panel[2], (5.6, 3.6), draw, "Below and to the left is better.")


def _draw_panel(axes: Any, rows: list[Mapping[str, Any]], name: str, factor: float, label: str) -> None:
    """Draws one error against time."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    from wavebatch.tools.plots.draw_cloud import MARKERS, SERIES_COLORS

    twins = {row["same_as"]: row["name"] for row in rows if "same_as" in row}
    rows = [row for row in rows if "same_as" not in row]
    known = [row for row in rows if row["kernels"]["median"] and row["figures"][name]["value"] is not None]
    time = np.array([row["kernels"]["median"] for row in known])
    value = np.array([row["figures"][name]["value"] * factor for row in known])
    error = np.array([(row["figures"][name]["error"] or 0.0) * factor for row in known])
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set(xlabel="kernels: microseconds per waveform", ylabel=label)
    if not known:
        return
    chains = np.array([row["kind"] == "chain" for row in known])
    front = accuracy.find_front(np.where(chains[:, None], np.stack([time, value], axis=1), np.nan))
    order = np.flatnonzero(front)[np.argsort(time[front])]
    axes.plot(time[order], value[order], color="tab:red", zorder=1, label="Pareto front")
    for i, row in enumerate(known):
        names = " = ".join([row["name"], *filter(None, [twins.get(row["name"])])])
        marker, color = MARKERS[i // len(SERIES_COLORS) % len(MARKERS)], SERIES_COLORS[i % len(SERIES_COLORS)]
        axes.errorbar(time[i], value[i], yerr=error[i], fmt=marker, color=color, capsize=2, label=names)
    axes.margins(x=0.25, y=0.15)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7.0)
