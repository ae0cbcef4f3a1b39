"""Every registered method as a chain of its own, so that all stand in one table."""

from __future__ import annotations

from wavebatch.stages.chain import STAGES, Chain, Step

ATTRIBUTES = ("attribute.amplitude", "attribute.echo_width", "attribute.position")
"""What the shipped chains add to echoes too."""


def list_methods() -> dict[str, Chain]:
    """A chain per detector, without a fit, and per decomposer, behind `detect.maximum`; by the name of the stage."""
    names = {kind: sorted(name for name in STAGES if STAGES[name].kind == kind) for kind in ("detect", "decompose")}
    chains = {name: _chain(name, name, "decompose.none") for name in names["detect"]}
    others = (name for name in names["decompose"] if name != "decompose.none")
    return chains | {name: _chain(name, "detect.maximum", name) for name in others}


def _chain(name: str, detector: str, decomposer: str) -> Chain:
    return Chain(tuple(Step(STAGES[stage]) for stage in ("noise.pooled", detector, decomposer, *ATTRIBUTES)), name)
