"""The benchmark as a whole: measures scenes, chains, peers and stiff cases, and returns one document of plain values.

`wavebatch bench` calls `run_bench` and gives the document to `report`. Its keys are the format of bench.json: change
SCHEMA when they change. All but times and memory is the same for the same options.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.batch.unit import BLOCK_SAMPLES
from wavebatch.core.errors import ConfigError
from wavebatch.stages.chain import Chain
from wavebatch.tools.bench.accuracy import Group, Tally, derive_seed, describe_found, make_groups
from wavebatch.tools.bench.cases import list_cases
from wavebatch.tools.bench.chains import AUTO, choose_chains, find_twin, list_methods, load_chains
from wavebatch.tools.bench.figures import choose_cheapest, find_front, median_range
from wavebatch.tools.bench.peers import list_peers, run_peer
from wavebatch.tools.bench.promises import judge
from wavebatch.tools.bench.scenes import find_bench_scene, shape_scene
from wavebatch.tools.bench.speed import Laps, measure_system, time_chains
from wavebatch.tools.bench.stability import FAILURES, measure_stability
from wavebatch.tools.simulate import Scene, simulate_blocks, simulate_strip

SCHEMA = "wavebatch.bench/1"

PEER_GROUPS = 6
"""Groups of which peers get a part: they are slow."""

STABILITY_SURVEY = 3072
"""Waveforms per survey of the stability section, where every receiver is surveyed several times."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What a benchmark measures."""

    strip: Path | None = None
    """Strip whose survey and echoes the simulated waveforms follow."""
    scenes: tuple[str, ...] = ()
    """Named scenes, in addition to the strip."""
    chains: tuple[Path, ...] = ()
    """Chain files, in addition to the shipped chains."""
    all_methods: bool = False
    """Measure every detector and decomposer too, each in its own chain."""
    seed: int = 0
    waveforms: int = 65_536
    """Simulated waveforms per scene."""
    repeats: int = 3
    """Times that every chain is timed."""
    pulses: int = 50_000
    """Pulses of the strip that is timed from file to file; 0: kernels only."""
    peers: bool = True
    """Measure the other decomposers of `peers` too."""
    peer_waveforms: int = 2_000
    stability: bool = True
    stability_waveforms: int = 900
    """Waveforms per stiff case."""
    hazards: tuple[str, ...] = ()
    """Hazards (H1 ... H16) whose cases are measured; empty: all."""
    tolerance_cm: float | None = None
    """Largest error of the range of isolated echoes for the choice of the cheapest chain."""
    promises: bool = False
    """Also measure start-up, memory and jobs, and compare all figures with the promised ones."""
    large: bool = False
    """With promises: measure memory with 100 times as many pulses too."""


def run_bench(options: BenchOptions, progress: Progress = lambda text: None) -> dict[str, Any]:
    """Runs a benchmark and returns its document of plain values.

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
    rows = [_row(name, "chain", tally, laps[name]) for name, tally in tallies.items()]
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
    block, strip = group.block, None
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as name:
        if options.pulses:
            # As many waveforms as a run takes through a chain at a time.
            n = min(options.pulses, BLOCK_SAMPLES // scene.recording.n_samples)
            block = next(simulate_blocks(scene, n, seed=seed, size=n))[0]
            strip = Path(name, "strip.laz")
            simulate_strip(scene, strip, pulses=options.pulses, seed=seed)
        return time_chains(timed, block, strip, Path(name), options.repeats, progress)


def _measure_peers(
    scene: Scene, groups: list[Group], options: BenchOptions, progress: Progress
) -> list[dict[str, Any]]:
    n = min(max(options.peer_waveforms // len(groups), 1), len(groups[0].block))
    parts = [group.cut(n) for group in groups]
    rows = []
    for name in list_peers():
        progress(f"{scene.name}: {name} on {n * len(parts)} waveforms")
        tally, times, failures = Tally(), [], 0
        for part in parts:
            result = run_peer(name, part.block, part.system)
            tally.add(part, result.found)
            times.append(1e6 * result.seconds / max(result.waveforms, 1))
            failures += result.failures
        rows.append({**_row(name, "peer", tally, Laps(kernels=times)), "crashed_or_hung": failures})
    return rows


def _row(name: str, kind: str, tally: Tally, laps: Laps) -> dict[str, Any]:
    figures = {key: figure.to_json() for key, figure in tally.figures().items()}
    times = {key: median_range(value) if isinstance(value, list) else value for key, value in asdict(laps).items()}
    return {"name": name, "kind": kind, "waveforms": tally.waveforms, "figures": figures, **times}


def _mark_front(rows: list[dict[str, Any]]) -> None:
    """Adds to every row whether no other chain is as good in time, error and wrong echoes, and better in one of them.

    Peers get other and fewer waveforms: they are never on the front.
    """
    names = ("rmse_all_cm", "wrong")
    costs = [(row["kernels"]["median"], *(row["figures"][name]["value"] for name in names)) for row in rows]
    costs = [cost if row["kind"] == "chain" else (None,) * 3 for row, cost in zip(rows, costs, strict=True)]
    for row, best in zip(rows, find_front(costs).tolist(), strict=True):
        row["pareto"] = best


def _describe(groups: list[Group]) -> dict[str, Any]:
    """Range of the results of the groups' surveys."""
    return {
        "groups": len(groups),
        "waveforms_of_a_group": len(groups[0].block),
        **{
            name: median_range([float(getattr(group.system, name)) for group in groups])
            for name in ("sigma_ref", "noise_std", "kappa", "noise_gain", "ringing", "acceptance")
        },
        "components": sorted({len(group.system.components) for group in groups}),
    }
