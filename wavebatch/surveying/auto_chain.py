"""The cheapest chain that serves a surveyed strip: what its scene does not need is left out, with the reason."""

from __future__ import annotations

import math
from typing import Any

from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import format_step, parse_chain
from wavebatch.surveying import Decision, Survey

LOST = 0.005
"""Share of the waveforms with echoes that may hold overlapping ones for fits not to grow.

Without growth about half of the echoes in such waveforms are not found: a quarter of a percent of all at most.
"""

GROWTH, PRIOR, WIDTH, ANGLE = "growth of fits", "width prior", "echo width", "incidence angle"
"""Parts of a chain that decisions of a survey are about and that this module treats on their own."""

_NAME = "profile auto"


def choose_chain(survey: Survey) -> Chain:
    """The cheapest chain that loses nothing on the surveyed strip (ALGORITHMS 4.4)."""
    return parse_chain(chain_text(survey), _NAME)


def decide(survey: Survey) -> tuple[Decision, ...]:
    """What the chosen chain has and what it leaves out, each with the reason.

    As the survey decided, but for two parts. Fits stop growing only where overlapping echoes are so rare, and the
    sample so large, that next to nothing can be lost. The width prior stays: it acts on overlapping echoes only, so
    that it costs nothing elsewhere, and the few pairs of an open scene are wrong without it.
    """
    needed = {decision.part: decision for decision in survey.decisions}
    grows = _decide_growth(survey)
    needed[GROWTH] = grows
    if PRIOR in needed:
        reason = "acts on overlapping echoes only and costs nothing where there are none"
        needed[PRIOR] = Decision(PRIOR, True, reason)
    # Without divergence and range there is no angle, so that needing it makes no chain have it.
    return tuple(decision for decision in needed.values() if decision.part != ANGLE or not decision.needed)


def left_out(survey: Survey) -> tuple[Decision, ...]:
    """The decisions of `decide` that leave something out."""
    return tuple(decision for decision in decide(survey) if not decision.needed)


def _decide_growth(survey: Survey) -> Decision:
    told = {decision.part: decision for decision in survey.decisions}.get(GROWTH)
    share, filled = _overlapped(survey)
    if told is None or not filled:
        return Decision(GROWTH, True, "the survey does not say how many echoes overlap")
    number = share * filled
    # Two standard deviations of a count above it, and no less than a few: small samples prove little.
    most = (number + 2 + 2 * math.sqrt(number + 1)) / filled
    found = f"of the {filled:.0f} waveforms with echoes {100 * share:.2f} % hold overlapping ones"
    limit = f"at most {100 * most:.2f} % by this sample, the limit is {100 * LOST:g} %"
    return Decision(GROWTH, most >= LOST, f"{found}; {limit}")


def _overlapped(survey: Survey) -> tuple[float, float]:
    """Share of overlapped ones among the waveforms with echoes, and the number of these in the sample."""
    figures = survey.figures
    filled = (1.0 - figures.get("empty_share", 1.0)) * survey.waveforms
    if "overlapped_share" not in figures or filled < 1:
        return 1.0, 0.0
    return min(figures["overlapped_share"] * survey.waveforms / filled, 1.0), filled


def chain_text(survey: Survey) -> str:
    """The chosen chain as TOML; every part that is left out stands where it would be, as a comment with its reason."""
    decisions = {decision.part: decision for decision in decide(survey)}
    width = decisions.get(WIDTH, Decision(WIDTH, True, ""))
    decompose: dict[str, Any] = {} if decisions[GROWTH].needed else {"max_echoes": 1}
    lines = [
        f"# Chosen by a survey of {survey.waveforms} waveforms: what the strip does not need is left out. Pulse, noise",
        "# and clipping are not in here: they come with the survey (`--system`), and so do the parts they need.",
        "",
        format_step("noise.pooled", {}),
        format_step("detect.maximum", {}),
        *(_comment(part) for part in decisions.values() if part.part not in (WIDTH, ANGLE)),
        format_step("decompose.adaptive", decompose),
        format_step("attribute.amplitude", {}),
    ]
    lines += [format_step("attribute.echo_width", {})] if width.needed else [_comment(width), ""]
    lines += [_comment(decisions[ANGLE]), ""] if ANGLE in decisions else []
    return "\n".join([*lines, format_step("attribute.position", {})])


def _comment(decision: Decision) -> str:
    reason = " ".join(decision.reason.split())
    return f"# {decision.part}: {'kept' if decision.needed else 'left out'}: {reason}"


def without_columns(columns: tuple[str, ...], widest: Chain, chain: Chain) -> tuple[str, ...]:
    """The columns that `chain` computes, of those that were chosen for the widest one."""
    lost = set(widest.makes) - set(chain.makes)
    return tuple(name for name in columns if name not in lost)


def widest_chain() -> Chain:
    """The chain with everything that `choose_chain` may leave out: what columns can be asked for."""
    return choose_chain(Survey(SystemPulse(sigma_ref=1.0), 0, {}, ()))
