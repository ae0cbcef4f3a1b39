"""What a strip is run with: its survey, new or saved, and its chain, given, or chosen by survey or tolerance."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import load_profile
from wavebatch.surveying import SAMPLE, Decision, Survey, join_digitizers, survey_blocks
from wavebatch.surveying.auto_chain import choose_chain, decide, widest_chain
from wavebatch.surveying.predict_error import WAVEFORMS, Prediction, predict_errors
from wavebatch.surveying.system_file import SavedSurvey, describe_system

SAMPLE_SAMPLES = 1 << 21
"""Samples that a survey looks at, at most."""

LEAST_WAVEFORMS = 256
"""Waveforms that it looks at even if they are long."""

COSTS = ("fast", "balanced", "accurate")
"""The shipped chains by what they cost, the cheapest first; measured by `wavebatch bench`."""


@dataclass(frozen=True, slots=True)
class Request:
    """How a strip is to get its pulse and its chain; picklable."""

    auto: bool = False
    """The survey chooses the chain."""
    tolerance: float | None = None
    """The cheapest shipped chain with this range error is taken [m]."""
    system: SavedSurvey | None = None
    """Taken in place of a survey of the strip."""

    def describe(self, chain: Chain) -> str | None:
        """What chooses the chain; None where `chain` itself was asked for."""
        if self.tolerance is not None:
            return f"tolerance {self.tolerance:g} m"
        return "auto" if self.auto else None


@dataclass(frozen=True, slots=True)
class Choice:
    """What a strip is run with, and why; picklable."""

    chain: Chain
    survey: Survey
    decisions: tuple[Decision, ...] = ()
    """What the chain has and what it leaves out; empty where the survey did not choose it."""
    predictions: tuple[Prediction, ...] = ()
    """Of every chain that a tolerance was held against, the cheapest first."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Per waveform of the sample: the `chosen` chain, and `everything` that a survey may leave out; for the report's
    timing only."""


def widest(request: Request) -> Chain:
    """The chain with every column that the chosen one can have."""
    return load_profile(COSTS[-1]) if request.tolerance is not None else widest_chain()


def read_sample(reader: StripReader, scan: StripScan, waveforms: int | None = None) -> list[WaveformBlock]:
    """Waveforms spread over a strip, a block per digitizer, the main one first; none where there are none.

    The same ones every time. waveforms: how many to read; without it as many as a survey looks at.
    """
    return join_digitizers(reader.sample_blocks(scan, waveforms or sample_size(reader, scan)))


def sample_size(reader: StripReader, scan: StripScan) -> int:
    """Waveforms of a strip that a survey looks at."""
    used = (digitizer for index, digitizer in reader.facts.digitizers.items() if index in scan.by_descriptor)
    longest = max((digitizer.n_samples for digitizer in used), default=0)
    return int(np.clip(SAMPLE_SAMPLES // max(longest, 1), LEAST_WAVEFORMS, SAMPLE))


def survey_sample(sample: list[WaveformBlock]) -> Survey:
    """The survey of a strip's sample; one that knows nothing where there is no waveform."""
    return survey_blocks(sample)


def make_choice(reader: StripReader, scan: StripScan, chain: Chain, request: Request) -> Choice:
    """What the strip is run with; depends on nothing but the strip, `chain` and the request.

    Raises ConfigError where no shipped chain meets the tolerance.
    """
    sample = read_sample(reader, scan) if request.system is None or request.tolerance is not None else []
    found = survey_sample(sample) if request.system is None else request.system.survey
    block = sample[0] if sample else None
    if request.tolerance is not None:
        return _choose_by_tolerance(block, found, request.tolerance, str(reader.facts.path))
    if not request.auto:
        return Choice(chain, found)
    chosen = choose_chain(found)
    return Choice(chosen, found, decide(found), seconds=_compare_cost(block, found.system, chosen))


def _choose_by_tolerance(block: WaveformBlock | None, found: Survey, tolerance: float, strip: str) -> Choice:
    chains = {name: load_profile(name) for name in COSTS}
    if block is None:
        return Choice(chains[COSTS[0]], found)
    predictions = predict_errors(block, found.system, chains)
    good = [prediction for prediction in predictions if prediction.range_error <= tolerance]
    if not good:
        told = ", ".join(f"{prediction.name} {prediction.range_error:.3g} m" for prediction in predictions)
        raise ConfigError(
            f"{strip}: no shipped chain meets a tolerance of {tolerance:g} m; predicted are {told}: allow more"
        )
    return Choice(chains[good[0].name], found, predictions=tuple(predictions))


def _compare_cost(block: WaveformBlock | None, system: SystemPulse, chosen: Chain) -> dict[str, float]:
    """Seconds per waveform of the chosen chain and of the widest, where they differ."""
    full = widest_chain()
    if block is None or [step.effective() for step in full.steps] == [step.effective() for step in chosen.steps]:
        return {}
    part = block.rows(slice(0, WAVEFORMS))
    seconds = {}
    for name, chain in (("chosen", chosen), ("everything", full)):
        start = time.perf_counter()
        chain.run(part, system)
        seconds[name] = (time.perf_counter() - start) / len(part)
    return seconds


def describe_choice(choice: Choice, request: Request) -> dict[str, Any]:
    """How the chain was chosen, for reports: what was left out and why, or what error was predicted."""
    told: dict[str, Any] = {
        "by": request.describe(choice.chain) or "user",
        "chain": choice.chain.name,
        "decisions": [
            {"part": decision.part, "needed": decision.needed, "reason": decision.reason}
            for decision in choice.decisions
        ],
    }
    if request.tolerance is not None:
        told["tolerance_m"] = request.tolerance
        told["predictions"] = [prediction.to_json() for prediction in choice.predictions]
    return told


def describe_survey(choice: Choice, request: Request, fingerprint: Mapping[str, Any]) -> dict[str, Any]:
    """The pulse that is used and where it comes from, for reports. fingerprint: of the strip that is run."""
    found, saved = choice.survey, request.system
    figures = {name: float(value) for name, value in found.figures.items() if np.isfinite(value)}
    source: dict[str, Any] = {"from": "strip", "waveforms": found.waveforms, "figures": figures}
    if saved is not None:
        same = bool(saved.fingerprint) and dict(saved.fingerprint) == dict(fingerprint)
        source |= {"from": "file", "strip": saved.strip, "version": saved.version, "of_this_strip": same}
    return {"system": describe_system(found.system), "survey": source}
