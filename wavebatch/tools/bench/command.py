"""The benchmark as a whole: measures chains on scenes, and returns one document of plain values.

`wavebatch bench` calls `run_bench` and gives the document to `report`. Its keys are the format of bench.json: change
SCHEMA when they change. All but times and memory is the same for the same options.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

from wavebatch import __version__
from wavebatch.batch.unit import BLOCK_SAMPLES
from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Range, option
from wavebatch.stages.chain import Chain
from wavebatch.tools.bench.accuracy import AccuracyTally, Group, derive_seed, describe_found, make_groups
from wavebatch.tools.bench.chains import AUTO, choose_chains, find_twin, list_methods, load_chains
from wavebatch.tools.bench.figures import choose_cheapest, find_front, median_range
from wavebatch.tools.bench.scenes import shape_scene
from wavebatch.tools.bench.speed import Laps, time_chains
from wavebatch.tools.simulate import Scene, find_scene, simulate_blocks, simulate_strip

SCHEMA = "wavebatch.bench/1"

BenchProgress = Callable[[str], None]
BenchRows = list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
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
    measure_others: Callable[[Scene, list[Group]], BenchRows] = lambda scene, groups: [],
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
    measure_others: Callable[[Scene, list[Group]], BenchRows],
) -> dict[str, Any]:  # fmt: skip
    seed = derive_seed(options.seed, place)
    groups = make_groups(scene, options.waveforms, seed, progress)
    chosen = [choose_chains(chains, group.survey) for group in groups]
    twin = find_twin(chosen)
    measured = {name: chain for name, chain in chosen[0].items() if name != AUTO or twin is None}
    tallies = {name: AccuracyTally() for name in measured}
    for name, tally in tallies.items():
        progress(f"{scene.name}: error of {name}")
        for group, of_group in zip(groups, chosen, strict=True):
            tally.add(group, describe_found(of_group[name].run(group.block, group.system)))
    laps = _time(scene, groups[0], measured, options, seed, progress)
    rows = [make_row(name, "chain", tally, laps[name]) for name, tally in tallies.items()]
    if twin:
        rows.append({**next(row for row in rows if row["name"] == twin), "name": AUTO, "same_as": twin})
    rows += measure_others(scene, groups)
    _mark_front(rows)
    section = {"scene": scene.name, "meaning": scene.meaning, "survey": _describe(groups), "rows": rows}
    if options.tolerance_cm is not None:
        cheapest = choose_cheapest([row for row in rows if row["kind"] == "chain"], options.tolerance_cm)
        section["cheapest"] = cheapest["name"] if cheapest else None
    return section


def _time(
    scene: Scene, group: Group, chains: Mapping[str, Chain], options: BenchOptions, seed: int, progress: BenchProgress
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


def make_row(name: str, kind: str, tally: AccuracyTally, laps: Laps) -> dict[str, Any]:
    """The row of a chain or of another program (kind: chain or peer)."""
    figures = {key: figure.to_json() for key, figure in tally.figures().items()}
    times = {key: median_range(value) if isinstance(value, list) else value for key, value in asdict(laps).items()}
    return {"name": name, "kind": kind, "waveforms": tally.waveforms, "figures": figures, **times}


def _mark_front(rows: BenchRows) -> None:
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
    fields = {"noise_std": "noise.std", "noise_gain": "noise.gain"}
    names = ("sigma_ref", "noise_std", "kappa", "noise_gain", "ringing", "acceptance")
    values = {name: map(attrgetter(fields.get(name, name)), (group.system for group in groups)) for name in names}
    return {
        "groups": len(groups),
        "waveforms_of_a_group": len(groups[0].block),
        **{name: median_range([float(value) for value in found]) for name, found in values.items()},
        "components": sorted({len(group.system.components) for group in groups}),
    }
