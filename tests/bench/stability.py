"""The stability section of the benchmark: every chain on every stiff case of `cases`, with a count of failures.

`release` calls `measure_stability`. Surveys come from ordinary scenes with the receiver of the case, not from the case:
a chain must survive a waveform that its survey did not prepare it for.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from bench.cases import CASES, Case, make_scene

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import Chain
from wavebatch.surveying import Survey, survey_block
from wavebatch.tools.bench.accuracy import AccuracyTally, Group, derive_seed, make_group
from wavebatch.tools.bench.command import AUTO, find_twin
from wavebatch.tools.simulate import Recording, Scene, find_scene, simulate_blocks
from wavebatch.tools.simulate.scenes import LogUniform, Mixture

GROUPS = 5
"""Groups of every case; each has a survey of an ordinary scene with the same receiver."""

NARROWEST = 0.7
"""Least allowed width of an echo, in widths of the system pulse (docs/algorithms.md H3)."""

FAILURES: dict[str, str] = {
    "not_finite": "time, amplitude or width that is not a finite number",
    "too_narrow": "echo narrower than 0.7 of the system pulse",
    "negative": "amplitude of 0 or less",
    "unsorted": "echo earlier than the one before it in the table",
    "warnings": "warning of Python or NumPy",
    "block_size": "echo that changes when the waveforms go through the chain in other blocks",
}
"""Kinds of failures, which must never happen."""


def measure_stability(
    choose: Callable[[Survey], Mapping[str, Chain]],
    waveforms: int,
    surveyed: int,
    seed: int,
    cases: Sequence[Case] = CASES,
    methods: Collection[str] = (),
    progress: Callable[[str], None] = lambda text: None,
    groups: int = GROUPS,
) -> list[dict[str, Any]]:
    """A row per case and chain, plain values for JSON.

    choose: returns the chains by name for a survey. waveforms: per case. surveyed: waveforms of each survey.
    methods: names of chains that test a single method; their rows have `is_method`.
    """
    ordinary: dict[Recording, list[tuple[Survey, Mapping[str, Chain]]]] = {}
    rows = []
    for number, case in enumerate(cases):
        progress(f"stability: {case.hazard} {case.name}")
        if case.recording not in ordinary:
            ordinary[case.recording] = _survey(case.recording, choose, surveyed, seed, groups)
        made = [
            _make_case(case, survey, waveforms // groups, derive_seed(seed, 77, number, place), place)
            for place, (survey, _) in enumerate(ordinary[case.recording])
        ]
        chosen = [chains for _, chains in ordinary[case.recording]]
        twin = find_twin(chosen)
        for name in chosen[0]:
            if name == AUTO and twin:
                continue
            row = {"hazard": case.hazard, "case": case.name, "chain": name}
            row |= {"is_auto": name in (AUTO, twin), "is_method": name in methods}
            rows.append(row | _measure([chains[name] for chains in chosen], made))
    return rows


def _survey(
    recording: Recording, choose: Callable[[Survey], Mapping[str, Chain]], surveyed: int, seed: int, groups: int
) -> list[tuple[Survey, Mapping[str, Chain]]]:
    """Survey and chains of so many ordinary, open strips with this receiver.

    For a receiver with a saturation level, one echo in a hundred is clipped; else none.
    """
    scale = 30.0 if recording.bits > 8 else 1.0
    urban = find_scene("urban")
    law = replace(urban.amplitude, median=urban.amplitude.median * scale, high=urban.amplitude.high * scale)
    if recording.saturation is None:
        law = replace(law, high=min(law.high, 0.45 * recording.clip))
    else:
        law = Mixture(0.99, law, LogUniform(recording.clip, 3.0 * recording.clip))
    scene: Scene = replace(urban, amplitude=law, recording=recording)
    surveys = []
    for place in range(groups):
        ((block, _),) = simulate_blocks(scene, surveyed, seed=derive_seed(seed, 78, place), size=surveyed)
        survey = survey_block(block)
        surveys.append((survey, choose(survey)))
    return surveys


def _make_case(case: Case, survey: Survey, n: int, seed: int, place: int) -> Group:
    scene = make_scene(case)
    ((block, truth),) = simulate_blocks(scene, n, seed=seed, size=n)
    return make_group(scene, place, block, truth, survey, clear=0.0)


def _measure(chains: list[Chain], groups: list[Group]) -> dict[str, Any]:
    tally = AccuracyTally()
    flags = {flag.name: 0 for flag in EchoFlag}
    failures = dict.fromkeys(FAILURES, 0)
    echoes = 0
    for chain, group in zip(chains, groups, strict=True):
        with warnings.catch_warnings(record=True) as caught, np.errstate(divide="warn", over="warn", invalid="warn"):
            warnings.simplefilter("always")
            found = chain.run(group.block, group.system)
        failures["warnings"] += len(caught)
        for name, number in count_failures(found, group.system).items():
            failures[name] += number
        failures["block_size"] += count_changes(chain, group, found)
        for flag in EchoFlag:
            flags[flag.name] += int(np.count_nonzero(found.flags & np.uint16(flag)))
        echoes += len(found)
        tally.add(group, found)
    return {
        "waveforms": tally.waveforms,
        "echoes": echoes,
        "failures": failures,
        "flags": {name: number for name, number in flags.items() if number},
        "figures": {name: figure.to_json() for name, figure in tally.figures().items() if _is_useful(name)},
    }


def _is_useful(name: str) -> bool:
    """Lengths and reported errors mean little where echoes are hard on purpose."""
    return not name.startswith("rmse") and "calibration" not in name and name != "hidden"


def count_failures(found: EchoTable, system: SystemPulse) -> dict[str, int]:
    """Echoes per kind of failure that a table of found echoes can show."""
    finite = np.isfinite(found.time) & np.isfinite(found.amplitude) & np.isfinite(found.sigma)
    back = (np.diff(found.waveform) < 0) | ((np.diff(found.waveform) == 0) & (np.diff(found.time) <= 0))
    return {
        "not_finite": int((~finite).sum()),
        "too_narrow": int((found.sigma < NARROWEST * system.sigma_ref * (1 - 1e-5)).sum()),
        "negative": int((found.amplitude <= 0).sum()),
        "unsorted": int(back.sum()),
    }


def count_changes(chain: Chain, group: Group, found: EchoTable) -> int:
    """Echoes that differ, in any bit, when the waveforms go through the chain in three unequal blocks."""
    n = len(group.block)
    edges = pairwise([0, n // 7, n // 2, n])
    again = EchoTable.concatenate(
        (chain.run(group.block.rows(slice(start, stop)), group.system), start) for start, stop in edges if stop > start
    )
    if len(again) != len(found):
        return abs(len(again) - len(found))
    same = (again.waveform == found.waveform) & (again.flags == found.flags)
    for name in ("time", "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err"):
        a, b = getattr(again, name), getattr(found, name)
        same &= (a == b) | (np.isnan(a) & np.isnan(b))
    return int((~same).sum())
