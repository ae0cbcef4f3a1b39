"""How well chains find the simulated echoes: groups of waveforms with their truth, and the figures over all groups.

`command` and `stability` make groups and add what a chain found to AccuracyTally. Each group has one seed and survey,
because the survey of a strip is a source of error too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.score import ISOLATED, QUANTITIES, find_isolated_echoes, list_pairs, match_echoes
from wavebatch.surveying import Survey, survey_block
from wavebatch.tools.bench.figures import Figure, root_mean_square, share_figure
from wavebatch.tools.bench.truth import describe_truth, find_bounds
from wavebatch.tools.simulate import Scene, simulate_blocks

CLEAR = 10.0
"""Signal to noise from which the error of an echo is compared with its bound."""

GROSS = 10.0
"""Errors above this many bounds are gross: they are counted, but left out of error/bound."""

GROUPS = 8
"""Groups of a scene; each has one survey, like the strips of a project."""

CM_PER_NS = 100 * HALF_C


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Waveforms of one seed, their truth, and their survey."""

    number: int
    block: WaveformBlock
    truth: EchoTable
    """In the terms of found echoes, see `describe_truth`."""
    isolated: np.ndarray
    """Echoes without a close neighbour, bool (m,)."""
    bounds: np.ndarray
    """Cramer-Rao bounds of time, amplitude and sigma, (m, 3)."""
    survey: Survey
    clear: np.ndarray
    """Echoes strong enough to compare their error with the bound, bool (m,)."""

    @property
    def system(self) -> SystemPulse:
        """The system pulse of the survey."""
        return self.survey.system

    def cut(self, n: int) -> Group:
        """The first n waveforms."""
        m = int(np.searchsorted(self.truth.waveform, n))
        columns = {name: getattr(self, name)[:m] for name in ("isolated", "bounds", "clear")}
        return replace(self, block=self.block.rows(slice(0, n)), truth=self.truth.take(np.arange(m)), **columns)


def derive_seed(*numbers: int) -> int:
    """A seed that depends on all of the numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def make_groups(
    scene: Scene, waveforms: int, seed: int, progress: Callable[[str], None] = lambda text: None
) -> list[Group]:
    """`waveforms` waveforms of the scene in GROUPS groups, each with another seed and survey."""
    size = max(waveforms // GROUPS, 1)
    groups = []
    for place in range(GROUPS):
        progress(f"{scene.name}: simulating and surveying, group {place + 1} of {GROUPS}")
        ((block, truth),) = simulate_blocks(scene, size, seed=derive_seed(seed, place), size=size)
        groups.append(make_group(scene, place, block, truth, survey_block(block)))
    return groups


def make_group(
    scene: Scene, number: int, block: WaveformBlock, truth: EchoTable, survey: Survey, *, clear: float = CLEAR
) -> Group:
    """The group of a simulated block and its survey; clear: signal to noise from which echoes are compared."""
    recording = scene.recording
    return Group(
        number=number,
        block=block,
        truth=describe_truth(truth, recording.pulse),
        isolated=find_isolated_echoes(truth),
        bounds=find_bounds(recording, truth, len(block)),
        survey=survey,
        clear=truth.amplitude >= clear * recording.recorded_noise,
    )


def find_hidden(truth: EchoTable, matched: np.ndarray) -> np.ndarray:
    """Which true echoes (m,) have a neighbour within ISOLATED widths that was not found, so that one echo holds both.

    matched: the true echoes that were found, bool (m,).
    """
    seen, lost = np.flatnonzero(matched), np.flatnonzero(~matched)
    sigma = truth.sigma.astype(np.float64)
    reach = ISOLATED * sigma.max(initial=0.0)
    row, other = list_pairs(truth.waveform[seen], truth.time[seen], truth.waveform[lost], truth.time[lost], reach)
    row, other = seen[row], lost[other]
    near = np.abs(truth.time[row] - truth.time[other]) < ISOLATED * np.maximum(sigma[row], sigma[other])
    hidden = np.zeros(len(truth), bool)
    hidden[row[near]] = True
    return hidden


def describe_found(found: EchoTable) -> EchoTable:
    """The echoes with sigma replaced by echo_width over 2.354820, where the chain computes echo_width."""
    if "echo_width" not in found.attributes:
        return found
    factor = np.float32(1 / FWHM_PER_SIGMA)
    return replace(found, **{f"sigma{end}": found.attributes[f"echo_width{end}"] * factor for end in ("", "_err")})


@dataclass(slots=True)
class AccuracyTally:
    """Collects the echoes found in groups; `figures` summarises them."""

    _waveforms: list[dict[str, np.ndarray]] = field(default_factory=list)
    _echoes: list[dict[str, np.ndarray]] = field(default_factory=list)
    _offset: int = 0

    def add(self, group: Group, found: EchoTable) -> None:
        """Adds the echoes found in the waveforms of a group."""
        n, truth = len(group.block), group.truth
        match = match_echoes(found, truth)
        matched = np.zeros(len(truth), bool)
        matched[match.truth] = True
        counts = {"true": truth.count(n), "found": found.count(n), "group": np.full(n, group.number)}
        counts["matched"] = np.bincount(truth.waveform[matched], minlength=n)
        for kind, rows in (("isolated", group.isolated), ("overlapped", ~group.isolated)):
            counts[kind] = np.bincount(truth.waveform[rows], minlength=n)
            counts[f"{kind}_matched"] = np.bincount(truth.waveform[rows & matched], minlength=n)
        self._waveforms.append(counts)
        part = {
            "waveform": truth.waveform[match.truth].astype(np.int64) + self._offset,
            "group": np.full(len(match.truth), group.number),
            "isolated": group.isolated[match.truth],
            "clear": group.clear[match.truth],
            "flagged": (found.flags[match.found] & np.uint16(UNCLEAN)) != 0,
            "hidden": find_hidden(truth, matched)[match.truth],
        }
        for place, name in enumerate(QUANTITIES):
            error = getattr(found, name)[match.found].astype(np.float64) - getattr(truth, name)[match.truth]
            reported = getattr(found, f"{name}_err")[match.found].astype(np.float64)
            part[name] = error
            part[f"{name}_ratio"] = error / group.bounds[match.truth, place]
            part[f"{name}_scaled"] = error / np.where(reported > 0, reported, np.nan)
        self._echoes.append(part)
        self._offset += n

    def figures(self) -> dict[str, Figure]:
        """Every figure by name: shares as fractions, lengths in cm of range, the others without unit."""
        return {**self._shares(), **self._errors()}

    @property
    def waveforms(self) -> int:
        """Number of waveforms added."""
        return self._offset

    def _shares(self) -> dict[str, Figure]:
        w = _join(self._waveforms)
        group, true, found = w["group"], w["true"], w["found"]
        one, none = true == 1, true == 0
        return {
            "completeness": share_figure(w["matched"], true, group),
            "correctness": share_figure(w["matched"], found * true.any(), group),
            "exact_count": share_figure(found == true, np.ones(len(true)), group),
            "false_splits": share_figure(one & (found > 1), one, group),
            "false_alarms": share_figure(none & (found > 0), none, group),
            "found_isolated": share_figure(w["isolated_matched"], w["isolated"], group),
            "found_overlapped": share_figure(w["overlapped_matched"], w["overlapped"], group),
            "wrong": share_figure(true + found - 2 * w["matched"], (true + found) * true.any(), group),
        }

    def _errors(self) -> dict[str, Figure]:
        e = _join(self._echoes)
        every = np.ones(len(e["time"]), bool)
        figures = {}
        for kind, rows in (("all", every), ("isolated", e["isolated"]), ("overlapped", ~e["isolated"])):
            figures[f"rmse_{kind}_cm"] = _spread(e, "time", rows).scale(CM_PER_NS)
            if kind == "all":
                continue
            clear = rows & e["clear"]
            ratios = np.stack([e[f"{name}_ratio"] for name in QUANTITIES])
            gross = np.abs(ratios).max(axis=0) > GROSS
            figures[f"gross_{kind}"] = share_figure(clear & gross, clear, e["group"])
            for name in QUANTITIES:
                figures[f"{name}_ratio_{kind}"] = _spread(e, f"{name}_ratio", clear & ~gross)
                known = np.isfinite(e[f"{name}_scaled"])
                figures[f"{name}_calibration_{kind}"] = _spread(e, f"{name}_scaled", clear & ~gross & known)
        known = e["clear"] & np.isfinite(e["time_scaled"])
        figures["hidden"] = share_figure(known & e["hidden"], known, e["group"])
        for kind in ("flagged", "hidden"):
            for name, rows in ((kind, e[kind]), (f"not_{kind}", ~e[kind])):
                figures[f"time_calibration_{name}"] = _spread(e, "time_scaled", known & rows)
        return figures


def _spread(echoes: Mapping[str, np.ndarray], name: str, rows: np.ndarray) -> Figure:
    return root_mean_square(echoes[name][rows], echoes["waveform"][rows], echoes["group"][rows])


def _join(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
