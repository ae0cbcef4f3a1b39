"""The pulse and the chain of a strip: from its survey or a saved one, given by the user or chosen.

`prepare` calls `make_choice` once per strip. Request says how to choose, ChainChoice is the answer with its reasons.
Before you change it: the choice must depend on the strip and the request alone, never on jobs or block size.

The automatic chain is the cheapest one that serves a surveyed strip, with a comment on each part that is left out
(`wavebatch survey --chain` writes its text): a part may be left out only where nothing is lost against the accurate
profile.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import Chain, format_step, load_profile, parse_chain
from wavebatch.surveying.look import join_digitizers
from wavebatch.surveying.systems.figures import describe_figures, describe_system
from wavebatch.surveying.systems.survey_result import Decision, Part, SavedSurvey, Survey

TYPE_CHECKING = False
if TYPE_CHECKING:
    from wavebatch.surveying.predict_error import Prediction

LOST = 0.005
"""Largest share of overlapping echoes, among the waveforms with echoes, at which growth is turned off.

Without growth about half of the echoes in such waveforms are lost: 0.25 % of all echoes at most.
"""

_NAME = "profile auto"


def choose_chain(survey: Survey) -> Chain:
    """Return the cheapest chain that loses nothing on the surveyed strip (docs/algorithms.md 4.4)."""
    return parse_chain(chain_text(survey), _NAME)


def decide(survey: Survey) -> tuple[Decision, ...]:
    """Decide which parts the automatic chain keeps.

    Parameters
    ----------
    survey : Survey

    Returns
    -------
    tuple of Decision
        The survey's decisions, except two. Growth is turned off only where overlapping echoes are so rare, and the
        sample so large, that next to nothing can be lost. The width prior always stays: it acts on overlapping echoes
        only, so it costs nothing elsewhere, and the few pairs of an open scene are wrong without it.
    """
    needed = {decision.part: decision for decision in survey.decisions}
    needed[Part.GROWTH] = _decide_growth(survey)
    if Part.PRIOR in needed:
        reason = "acts on overlapping echoes only and costs nothing where there are none"
        needed[Part.PRIOR] = Decision(Part.PRIOR, True, reason)
    # Angles need divergence and range, which come from other files: a survey alone cannot add them to a chain.
    return tuple(decision for decision in needed.values() if decision.part != Part.ANGLE or not decision.needed)


def _decide_growth(survey: Survey) -> Decision:
    empty, overlapped = survey.figures.empty_share, survey.figures.overlapped_share
    filled = 0.0 if empty is None else (1.0 - empty) * survey.waveforms
    if overlapped is None or filled < 1 or all(decision.part != Part.GROWTH for decision in survey.decisions):
        return Decision(Part.GROWTH, True, "the survey does not say how many echoes overlap")
    share = min(overlapped * survey.waveforms / filled, 1.0)
    number = share * filled
    # Upper limit of the share: the count, two of its standard deviations, and six waveforms at least, because a small
    # sample without overlaps proves little. With four, one pair decided whether a tile of 1,000 waveforms has growth.
    most = min((number + 4 + 2 * math.sqrt(number + 1)) / filled, 1.0)
    found = f"of the {filled:.0f} waveforms with echoes {100 * share:.2f} % hold overlapping ones"
    limit = f"at most {100 * most:.2f} % by this sample, the limit is {100 * LOST:g} %"
    return Decision(Part.GROWTH, most >= LOST, f"{found}; {limit}")


def chain_text(survey: Survey) -> str:
    """Return the automatic chain as TOML; each part left out stands at its place as a comment with the reason."""
    decisions = {decision.part: decision for decision in decide(survey)}
    width = decisions.get(Part.WIDTH, Decision(Part.WIDTH, True, ""))
    lines = [
        f"# Chosen by a survey of {survey.waveforms} waveforms: what the strip does not need is left out. Pulse, noise",
        "# and clipping are not in here: they come with the survey (`--system`), and so do the parts they need.",
        "",
        format_step("noise.pooled", {}),
        format_step("detect.maximum", {}),
        *(
            _comment(decision)
            for part, decision in decisions.items()
            if part not in (Part.WIDTH, Part.ANGLE, Part.INVERTED)
        ),
        format_step("decompose.adaptive", {} if decisions[Part.GROWTH].needed else {"max_echoes": 1}),
        format_step("attribute.amplitude", {}),
    ]
    lines += [format_step("attribute.echo_width", {})] if width.needed else [_comment(width), ""]
    if Part.ANGLE in decisions:
        lines += [_comment(decisions[Part.ANGLE]), ""]
    elif any(decision.part == Part.ANGLE and decision.needed for decision in survey.decisions):
        # Widths say that surfaces slope.
        needs = "it needs the divergence of the beam, which no strip holds"
        add = 'with it, add "attribute.incidence_angle" with divergence = MRAD after attribute.position'
        lines += [f"# {Part.ANGLE}: not in this chain: {needs};", f"# {add}.", ""]
    return "\n".join([*lines, format_step("attribute.position", {})])


def _comment(decision: Decision) -> str:
    reason = " ".join(decision.reason.split())
    return f"# {decision.part}: {'yes' if decision.needed else 'no'}: {reason}"


COSTS = ("fast", "balanced", "accurate")
"""The shipped chains by computing time, the fastest first; measured by `wavebatch bench`."""


@frozen
class Request:
    """How a strip gets its pulse and its chain; picklable."""

    auto: bool = False
    """The survey chooses the chain."""
    tolerance: float | None = None
    """Take the fastest shipped chain whose predicted range error is not larger [m]."""
    system: SavedSurvey | None = None
    """A saved survey; None: the strip is surveyed."""
    flight: bool = False
    """The saved survey is that of the strip's flight, or will be made before the run: the strip is compared with it."""
    force: bool = False
    """Use the saved survey also where the strip contradicts it."""

    def describe(self) -> str | None:
        """Return what chooses the chain, for reports; None where the user gave the chain itself."""
        if self.tolerance is not None:
            return f"tolerance {self.tolerance:g} m"
        return "auto" if self.auto else None


@frozen
class ChainChoice:
    """The chain and the survey that a strip is run with, and the reasons; picklable."""

    chain: Chain
    survey: Survey
    decisions: tuple[Decision, ...] = ()
    """Parts that the chain has or leaves out; empty where the survey did not choose the chain."""
    predictions: tuple[Prediction, ...] = ()
    """Of each chain that was compared with a tolerance, the fastest first; or of the user's chain and the accurate one,
    where the user's finds false echoes on a strip like this."""

    @property
    def false_share(self) -> float:
        """Share of false echoes to expect from the user's chain; 0 where there is no doubt about it."""
        return self.predictions[0].false_share if self.doubted else 0.0

    @property
    def doubted(self) -> bool:
        """Whether a trial shows that the user's chain finds false echoes on this strip."""
        return bool(self.predictions) and self.predictions[0].name == _USERS


_USERS = "user"
"""Name of the user's chain among the predictions; shipped chains have theirs."""


def widest_chain(request: Request | None = None) -> Chain:
    """Return a chain that has every column of any chain that may be chosen; by default the survey chooses it."""
    if request is not None and request.tolerance is not None:
        return load_profile(COSTS[-1])
    return choose_chain(Survey(SystemPulse(sigma_ref=1.0), 0))


def read_sample(reader: StripReader, scan: StripScan, waveforms: int | None = None) -> list[WaveformBlock]:
    """Read waveforms spread evenly over a strip, always the same ones.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    waveforms : int, optional
        How many; by default as many as a survey reads.

    Returns
    -------
    list of WaveformBlock
        Copies of a waveform too; empty for a strip without waveforms.
    """
    return list(reader.sample_blocks(scan, waveforms or reader.sample_size(scan)))


def make_choice(reader: StripReader, scan: StripScan, chain: Chain, request: Request) -> ChainChoice:
    """Choose the pulse and the chain of a strip.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    chain : Chain
        Used where the request neither is automatic nor has a tolerance.
    request : Request

    Returns
    -------
    ChainChoice

    Raises
    ------
    ConfigError
        Where no shipped chain meets the tolerance.
    """
    sample = read_sample(reader, scan) if request.system is None or request.tolerance is not None else []
    if request.system is None:
        from wavebatch.surveying.outgoing import compare_outgoing  # these and what they import: 10 ms
        from wavebatch.surveying.survey import survey_blocks

        found = compare_outgoing(survey_blocks(sample), reader.facts.path)
    else:
        found = request.system.survey
    if request.tolerance is not None:
        from wavebatch.surveying.predict_error import leave_out_false, predict_errors

        chains = {name: load_profile(name) for name in COSTS}
        if not sample:
            return ChainChoice(chains[COSTS[0]], found)
        predictions = predict_errors(join_digitizers(sample)[0], found.system, chains)
        fitting = leave_out_false(predictions)
        good = [prediction for prediction in fitting if prediction.range_error <= request.tolerance]
        if not good:
            errors = ", ".join(
                f"{one.name} {one.range_error:.3g} m"
                + ("" if one in fitting else f" ({100 * one.false_share:.0f} % of its echoes would be false)")
                for one in predictions
            )
            raise ConfigError(
                f"{reader.facts.path}: no shipped chain meets a tolerance of {request.tolerance:g} m; predicted errors "
                f"are {errors}: allow more"
            )
        return ChainChoice(chains[good[0].name], found, predictions=tuple(predictions))
    if not request.auto:
        return ChainChoice(chain, found)
    return ChainChoice(choose_chain(found), found, decide(found))


def try_chain(reader: StripReader, scan: StripScan, choice: ChainChoice, request: Request) -> ChainChoice:
    """Find out whether the user's chain takes the strip's pulse for several echoes.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    choice : ChainChoice
        Of `make_choice`.
    request : Request

    Returns
    -------
    ChainChoice
        With two predictions, of the user's chain and of the accurate one, where the first finds more false echoes by
        MOST_FALSE; else the same one.

    Notes
    -----
    Only strips whose pulse is no plain Gaussian are tried: a trial takes as long as some 4,000 waveforms of the run.
    """
    system = choice.survey.system
    if request.describe() is not None or (len(system.components) < 2 and not system.kappa):
        return choice
    from wavebatch.surveying.predict_error import TRIAL_WAVEFORMS, leave_out_false, predict_errors

    sample = join_digitizers(read_sample(reader, scan, TRIAL_WAVEFORMS))
    if not sample:
        return choice
    chains = {_USERS: choice.chain, COSTS[-1]: load_profile(COSTS[-1])}
    predictions = predict_errors(sample[0], system, chains)
    if predictions[0] in leave_out_false(predictions):
        return choice
    return replace(choice, predictions=tuple(predictions))


def describe_choice(choice: ChainChoice, request: Request) -> dict[str, Any]:
    """Return how the chain was chosen, for reports: decisions with reasons, or predicted errors."""
    report: dict[str, Any] = {
        "by": request.describe() or "user",
        "chain": choice.chain.name,
        "decisions": [asdict(decision) for decision in choice.decisions],
    }
    if request.tolerance is not None:
        report["tolerance_m"] = request.tolerance
    if request.tolerance is not None or choice.predictions:
        report["predictions"] = [prediction.to_json() for prediction in choice.predictions]
    return report


def describe_survey(choice: ChainChoice, request: Request, fingerprint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the pulse and where it comes from, for reports.

    Parameters
    ----------
    choice : ChainChoice
    request : Request
    fingerprint : mapping
        Of the strip that is run, to see whether a saved survey was made on it.

    Returns
    -------
    dict
        `system` and `survey`.
    """
    found, saved = choice.survey, request.system
    figures = describe_figures(found.figures)
    source: dict[str, Any] = {"from": "strip", "waveforms": found.waveforms, "figures": figures}
    if saved is not None and request.flight:
        source |= {"from": "flight", "strips": int(found.figures.flight_strips or 0), "version": saved.version}
    elif saved is not None:
        same = bool(saved.fingerprint) and dict(saved.fingerprint) == dict(fingerprint)
        source |= {"from": "file", "strip": saved.strip, "version": saved.version, "of_this_strip": same}
    return {"system": describe_system(found.system), "survey": source}
