"""The automatic chain: the cheapest one that serves a surveyed strip, with a comment on each part that is left out.

`choose_chain` calls it for `wavebatch run`, `wavebatch survey --chain` writes its text.
Before you change it: a part may be left out only where nothing is lost against the accurate profile.
"""

from __future__ import annotations

import math

from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import format_step, parse_chain
from wavebatch.surveying import Decision, Part, Survey

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
    share, filled = _overlapped(survey)
    if not filled or all(decision.part != Part.GROWTH for decision in survey.decisions):
        return Decision(Part.GROWTH, True, "the survey does not say how many echoes overlap")
    number = share * filled
    # Upper limit of the share: two standard deviations of the count above it, and at least six waveforms more, because
    # a small sample without overlaps proves little: with four, tiles of 1,000 waveforms grew or not by one pair.
    most = min((number + 4 + 2 * math.sqrt(number + 1)) / filled, 1.0)
    found = f"of the {filled:.0f} waveforms with echoes {100 * share:.2f} % hold overlapping ones"
    limit = f"at most {100 * most:.2f} % by this sample, the limit is {100 * LOST:g} %"
    return Decision(Part.GROWTH, most >= LOST, f"{found}; {limit}")


def _overlapped(survey: Survey) -> tuple[float, float]:
    """Share of overlapped ones among the waveforms with echoes, and the number of these in the sample."""
    empty, overlapped = survey.figures.empty_share, survey.figures.overlapped_share
    filled = 0.0 if empty is None else (1.0 - empty) * survey.waveforms
    if overlapped is None or filled < 1:
        return 1.0, 0.0
    return min(overlapped * survey.waveforms / filled, 1.0), filled


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
    lines += [_comment(decisions[Part.ANGLE]), ""] if Part.ANGLE in decisions else _explain_angle(survey)
    return "\n".join([*lines, format_step("attribute.position", {})])


def _explain_angle(survey: Survey) -> list[str]:
    """Why angles are not in the chain although widths say that surfaces slope."""
    if not any(decision.part == Part.ANGLE and decision.needed for decision in survey.decisions):
        return []
    needs = "it needs the divergence of the beam, which no strip holds"
    add = 'with it, add "attribute.incidence_angle" with divergence = MRAD after attribute.position'
    return [f"# {Part.ANGLE}: not in this chain: {needs};", f"# {add}.", ""]


def _comment(decision: Decision) -> str:
    reason = " ".join(decision.reason.split())
    return f"# {decision.part}: {'kept' if decision.needed else 'left out'}: {reason}"


def without_columns(columns: tuple[str, ...], widest: Chain, chain: Chain) -> tuple[str, ...]:
    """Drop the columns that the widest chain computes and the chosen one does not.

    Parameters
    ----------
    columns : tuple of str
        Chosen for the widest chain.
    widest, chain : Chain

    Returns
    -------
    tuple of str
    """
    lost = set(widest.makes) - set(chain.makes)
    return tuple(name for name in columns if name not in lost)


def widest_chain() -> Chain:
    """Return the automatic chain with all parts: its columns are those that a user can ask for."""
    return choose_chain(Survey(SystemPulse(sigma_ref=1.0), 0))
