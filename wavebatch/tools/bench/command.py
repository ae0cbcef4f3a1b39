"""The benchmark as a whole: scenes, chains, peers and stability in, one document of plain values out."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.batch.unit import BLOCK_SAMPLES
from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import load_chain, load_profile
from wavebatch.surveying import Survey
from wavebatch.surveying.auto_chain import choose_chain
from wavebatch.tools.bench.accuracy import Group, Tally, derive_seed, describe_found, make_groups
from wavebatch.tools.bench.figures import median_range
from wavebatch.tools.bench.peers import list_peers, run_peer
from wavebatch.tools.bench.promises import judge, measure_system
from wavebatch.tools.bench.rank_chains import choose_cheapest, find_front, list_methods
from wavebatch.tools.bench.scenes import find_bench_scene, shape_scene
from wavebatch.tools.bench.speed import Laps, make_strip, time_chains
from wavebatch.tools.bench.stability import AUTO, FAILURES, find_twin, list_cases, measure_stability
from wavebatch.tools.simulate import Scene, simulate_blocks

SCHEMA = "wavebatch.bench/1"

PROFILES = ("fast", "balanced", "accurate")
"""Shipped chains that are always measured, cheapest first."""

PEER_GROUPS = 6
"""Groups that peers get a part of: they are slow."""

STABILITY_SURVEY = 3072
"""Waveforms that each survey of the stability section sees: every receiver is surveyed several times."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What is measured."""

    strip: Path | None = None
    """Strip after whose survey the waveforms are simulated."""
    scenes: tuple[str, ...] = ()
    """Named scenes, besides the strip."""
    chains: tuple[Path, ...] = ()
    """Chain files, besides the shipped chains."""
    all_methods: bool = False
    """Measure every detector and decomposer too, each in a chain of its own."""
    seed: int = 0
    waveforms: int = 65_536
    """Simulated waveforms per scene."""
    repeats: int = 3
    """Turns of the timing."""
    pulses: int = 50_000
    """Pulses of the strip that goes from file to file; 0 leaves it out."""
    peers: bool = True
    peer_waveforms: int = 2_000
    stability: bool = True
    stability_waveforms: int = 900
    """Per case."""
    hazards: tuple[str, ...] = ()
    """Hazards whose cases are measured; all where none is given."""
    tolerance_cm: float | None = None
    """Error of the range of isolated echoes that the cheapest chain must meet."""
    promises: bool = False
    """Also measure start-up, memory and jobs, and hold everything to what is promised."""
    large: bool = False
    """Measure memory with 100 times as many pulses too."""


def run_bench(options: BenchOptions, progress: Progress = lambda text: None) -> dict[str, Any]:
    """The document of a benchmark: plain values, reproducible but for times and memory.

    Raises ConfigError for unknown scenes and chains that cannot run, InputError for a strip that cannot be used.
    """
    chains, cases = load_chains(options.chains), list_cases(options.hazards)
    scenes: list[Scene] = [find_bench_scene(name) for name in options.scenes]
    if options.strip is not None:
        progress(f"surveying {options.strip}")
        scenes.insert(0, shape_scene(options.strip, chains["accurate"]))
    if not scenes:
        raise ConfigError("nothing to measure: give a strip or --scene NAME")
    methods = list_methods() if options.all_methods else {}
    measured = chains | methods
    sections = [_measure_scene(scene, measured, options, place, progress) for place, scene in enumerate(scenes)]
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "seed": options.seed,
        "error_means": "standard error of the difference between two runs that differ in their seed",
        "scenes": sections,
    }
    if options.stability:
        document["failure_kinds"] = FAILURES
        document["stability"] = measure_stability(
            lambda survey: choose_chains(measured, survey),
            options.stability_waveforms,
            min(STABILITY_SURVEY, options.waveforms),
            options.seed,
            cases=cases,
            methods=methods,
            progress=progress,
        )
    if options.tolerance_cm is not None:
        document["tolerance_cm"] = options.tolerance_cm
    if options.promises:
        pulses = 2 * max(options.pulses, 1000)
        document["system"] = measure_system(options.seed, pulses=pulses, large=options.large, progress=progress)
        document["promises"] = judge(document)
    return document


def load_chains(files: tuple[Path, ...]) -> dict[str, Chain]:
    """The shipped chains and those of the files, by the names that rows carry."""
    chains = {name: load_profile(name) for name in PROFILES}
    for path in files:
        name = path.stem if path.stem not in chains else str(path)
        if name in chains:
            raise ConfigError(f"{path}: given twice; give every chain file once")
        chains[name] = load_chain(path)
    return chains


def choose_chains(chains: Mapping[str, Chain], survey: Survey) -> dict[str, Chain]:
    """The chains that run on every strip, and `auto`, the one that the strip's survey chooses."""
    return {**chains, AUTO: choose_chain(survey)}


def _measure_scene(
    scene: Scene, chains: Mapping[str, Chain], options: BenchOptions, place: int, progress: Progress
) -> dict[str, Any]:
    seed = derive_seed(options.seed, place)
    groups = make_groups(scene, options.waveforms, seed, progress)
    chosen = [choose_chains(chains, group.survey) for group in groups]
    twin = find_twin(chosen)
    measured = {name: chain for name, chain in chosen[0].items() if name != AUTO or twin is None}
    tallies = {name: Tally() for name in measured}
    for name, tally in tallies.items():
        progress(f"{scene.name}: error of {name}")
        for group, of_group in zip(groups, chosen, strict=True):
            tally.add(group, describe_found(of_group[name].run(group.block, group.system)))
    laps = _time(scene, groups[0], measured, options, seed, progress)
    rows = [_row(name, "chain", tally, laps[name].to_json()) for name, tally in tallies.items()]
    if twin:
        rows.append({**next(row for row in rows if row["name"] == twin), "name": AUTO, "same_as": twin})
    if options.peers:
        rows += _measure_peers(scene, groups[:PEER_GROUPS], options, progress)
    _mark_front(rows)
    section = {"scene": scene.name, "meaning": scene.meaning, "survey": _describe(groups), "rows": rows}
    if options.tolerance_cm is not None:
        cheapest = choose_cheapest([row for row in rows if row["kind"] == "chain"], options.tolerance_cm)
        section["cheapest"] = cheapest["name"] if cheapest else None
    return section


def _time(
    scene: Scene, group: Group, chains: Mapping[str, Chain], options: BenchOptions, seed: int, progress: Progress
) -> dict[str, Laps]:
    timed = {name: (chain, group.system) for name, chain in chains.items()}
    block = _make_block(scene, options, seed) if options.pulses else group.block
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as name:
        folder, strip = Path(name), None
        if options.pulses:
            strip = make_strip(scene, folder / "strip.laz", options.pulses, seed)
        return time_chains(timed, block, strip, folder, options.repeats, progress)


def _make_block(scene: Scene, options: BenchOptions, seed: int) -> WaveformBlock:
    """As many waveforms as a run takes through a chain at a time."""
    n = min(options.pulses, BLOCK_SAMPLES // scene.recording.n_samples)
    return next(simulate_blocks(scene, n, seed=seed, size=n))[0]


def _measure_peers(
    scene: Scene, groups: list[Group], options: BenchOptions, progress: Progress
) -> list[dict[str, Any]]:
    n = min(max(options.peer_waveforms // len(groups), 1), len(groups[0].block))
    parts = [cut_group(group, n) for group in groups]
    rows = []
    for name in list_peers():
        progress(f"{scene.name}: {name} on {n * len(parts)} waveforms")
        tally, times, failures = Tally(), [], 0
        for part in parts:
            result = run_peer(name, part.block, part.system)
            tally.add(part, result.found)
            times.append(1e6 * result.seconds / max(result.waveforms, 1))
            failures += result.failures
        rows.append({**_row(name, "peer", tally, Laps(kernels=times).to_json()), "crashed_or_hung": failures})
    return rows


def cut_group(group: Group, n: int) -> Group:
    """The first n waveforms of a group."""
    m = int(np.searchsorted(group.truth.waveform, n))
    rows: EchoTable = group.truth.take(np.arange(m))
    return replace(
        group,
        block=group.block.rows(slice(0, n)),
        truth=rows,
        isolated=group.isolated[:m],
        bounds=group.bounds[:m],
        clear=group.clear[:m],
    )


def _row(name: str, kind: str, tally: Tally, laps: Mapping[str, Any]) -> dict[str, Any]:
    figures = {key: figure.to_json() for key, figure in tally.figures().items()}
    return {"name": name, "kind": kind, "waveforms": tally.waveforms, "figures": figures, **laps}


def _mark_front(rows: list[dict[str, Any]]) -> None:
    """Adds to every row whether no other chain is as good in time, error and wrong echoes, and better in one.

    Peers saw other waveforms, and fewer: they are never on the front.
    """
    costs = [
        [row["kernels"]["median"], row["figures"]["rmse_all_cm"]["value"], row["figures"]["wrong"]["value"]]
        if row["kind"] == "chain"
        else [None] * 3
        for row in rows
    ]
    front = find_front(np.array([[np.nan if cost is None else cost for cost in line] for line in costs]))
    for row, best in zip(rows, front.tolist(), strict=True):
        row["pareto"] = best


def _describe(groups: list[Group]) -> dict[str, Any]:
    """Range of what the surveys of the groups found."""
    return {
        "groups": len(groups),
        "waveforms_of_a_group": len(groups[0].block),
        **{
            name: median_range([float(getattr(group.system, name)) for group in groups])
            for name in ("sigma_ref", "noise_std", "kappa", "noise_gain", "ringing", "acceptance")
        },
        "components": sorted({len(group.system.components) for group in groups}),
    }
