"""The stability section: every chain on every stiff case, and whatever goes wrong there counted."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import effective
from wavebatch.surveying import Survey, survey_block
from wavebatch.tools.bench.accuracy import Group, Tally, derive_seed, describe_found, make_group
from wavebatch.tools.bench.hazards import CASES, Case, make_scene
from wavebatch.tools.simulate import Recording, Scene, find_scene, simulate_blocks
from wavebatch.tools.simulate.draws import LogUniform, Mixture

AUTO = "auto"
"""Name of the chain that a survey chooses."""

GROUPS = 5
"""Groups of every case, each with a survey of its own of an ordinary scene with the same receiver."""

NARROWEST = 0.7
"""Widths of the system pulse below which no echo may be (H3)."""

FAILURES: dict[str, str] = {
    "not_finite": "time, amplitude or width that is no finite number",
    "too_narrow": "echo narrower than 0.7 of the system pulse",
    "negative": "amplitude of 0 or less",
    "unsorted": "echo that lies before the one before it",
    "warnings": "warning of Python or NumPy",
    "block_size": "echo that changes when the waveforms go through the chain in other blocks",
}
"""What must never happen, and is counted."""


def measure_stability(
    choose: Callable[[Survey], Mapping[str, Chain]],
    waveforms: int,
    surveyed: int,
    seed: int,
    cases: Sequence[Case] = CASES,
    methods: Collection[str] = (),
    progress: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """A row per case and chain, plain values for JSON.

    choose: chains by name for a strip of that survey.
    waveforms: per case. surveyed: waveforms of the ordinary scene that each survey sees. methods: names of chains that
    hold one method each, for comparison: their rows say so.
    """
    ordinary: dict[Recording, list[tuple[Survey, Mapping[str, Chain]]]] = {}
    rows = []
    for number, case in enumerate(cases):
        progress(f"stability: {case.hazard} {case.name}")
        if case.recording not in ordinary:
            ordinary[case.recording] = _survey(case.recording, choose, surveyed, seed)
        groups = [
            _make_case(case, survey, waveforms // GROUPS, derive_seed(seed, 77, number, place), place)
            for place, (survey, _) in enumerate(ordinary[case.recording])
        ]
        chosen = [chains for _, chains in ordinary[case.recording]]
        twin = find_twin(chosen)
        for name in chosen[0]:
            if name == AUTO and twin:
                continue
            told = {"hazard": case.hazard, "case": case.name, "chain": name, "is_auto": name in (AUTO, twin)}
            told["is_method"] = name in methods
            rows.append({**told, **_measure([chains[name] for chains in chosen], groups)})
    return rows


def list_cases(hazards: Sequence[str]) -> tuple[Case, ...]:
    """The cases of the given hazards, all where none is given; raises ConfigError for a hazard without cases."""
    known = list(dict.fromkeys(case.hazard for case in CASES))
    for name in hazards:
        if name not in known:
            raise ConfigError(f"hazard {name!r} cannot be simulated; {nearest(name, known)}")
    return tuple(case for case in CASES if not hazards or case.hazard in hazards)


def find_twin(chosen: Sequence[Mapping[str, Chain]]) -> str | None:
    """The chain that `auto` is on every strip, so that it need not be measured again; None where it is one of its own.

    chosen: the chains of each strip.
    """
    for name in chosen[0]:
        if name != AUTO and all(AUTO in c and effective(c[name]) == effective(c[AUTO]) for c in chosen):
            return name
    return None


def _survey(
    recording: Recording, choose: Callable[[Survey], Mapping[str, Chain]], surveyed: int, seed: int
) -> list[tuple[Survey, Mapping[str, Chain]]]:
    """Survey and chains of GROUPS ordinary, open strips with this receiver.

    Where the receiver is said to clip, one echo in a hundred does; else none.
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
    for place in range(GROUPS):
        ((block, _),) = simulate_blocks(scene, surveyed, seed=derive_seed(seed, 78, place), size=surveyed)
        survey = survey_block(block)
        surveys.append((survey, choose(survey)))
    return surveys


def _make_case(case: Case, survey: Survey, n: int, seed: int, place: int) -> Group:
    scene = make_scene(case)
    ((block, truth),) = simulate_blocks(scene, n, seed=seed, size=n)
    return make_group(scene, place, block, truth, survey, clear=0.0)


def _measure(chains: list[Chain], groups: list[Group]) -> dict[str, Any]:
    tally = Tally()
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
        tally.add(group, describe_found(found))
    return {
        "waveforms": tally.waveforms,
        "echoes": echoes,
        "failures": failures,
        "flags": {name: number for name, number in flags.items() if number},
        "figures": {name: figure.to_json() for name, figure in tally.figures().items() if _is_told(name)},
    }


def _is_told(name: str) -> bool:
    """Lengths and reported errors mean little where echoes are made to be hard."""
    return not name.startswith("rmse") and "calibration" not in name


def count_failures(found: EchoTable, system: SystemPulse) -> dict[str, int]:
    """Echoes per kind of failure that shows in the table alone."""
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
    edges = [0, n // 7, n // 2, n]
    parts = []
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
        if stop > start:
            parts.append((chain.run(group.block.rows(slice(start, stop)), group.system), start))
    again = EchoTable.concatenate(parts)
    if len(again) != len(found):
        return abs(len(again) - len(found))
    same = (again.waveform == found.waveform) & (again.flags == found.flags)
    for name in ("time", "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err"):
        a, b = getattr(again, name), getattr(found, name)
        same &= (a == b) | (np.isnan(a) & np.isnan(b))
    return int((~same).sum())
