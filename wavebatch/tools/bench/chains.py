"""The chains of a benchmark: the shipped ones, those of the user, one per method, and `auto`.

`auto` is the chain that a survey chooses, so the set of chains is built for every surveyed strip. `command` and
`stability` call this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from wavebatch.core.errors import ConfigError
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.chain_file import effective, load_chain_file, load_profile
from wavebatch.surveying import Survey
from wavebatch.surveying.auto_chain import choose_chain
from wavebatch.tools.api.chain import AUTO

PROFILES = ("fast", "balanced", "accurate")
"""Shipped chains that are always measured, cheapest first."""

ATTRIBUTES = ("attribute.amplitude", "attribute.echo_width", "attribute.position")
"""Attributes that the shipped chains compute too, so that times can be compared."""


def load_chains(files: Sequence[Path]) -> dict[str, Chain]:
    """The shipped chains and those of the files, by the names that rows of the benchmark have."""
    chains = {name: load_profile(name) for name in PROFILES}
    for path in files:
        name = path.stem if path.stem not in chains else str(path)
        if name in chains:
            raise ConfigError(f"{path}: given twice; give every chain file once")
        chains[name] = load_chain_file(path)
    return chains


def choose_chains(chains: Mapping[str, Chain], survey: Survey) -> dict[str, Chain]:
    """The given chains, and as `auto` the one that the survey chooses."""
    return {**chains, AUTO: choose_chain(survey)}


def find_twin(chosen: Sequence[Mapping[str, Chain]]) -> str | None:
    """The chain that equals `auto` on every strip, so that `auto` need not be measured; None if there is none.

    chosen: the chains of each strip.
    """
    for name in chosen[0]:
        if name != AUTO and all(AUTO in c and effective(c[name]) == effective(c[AUTO]) for c in chosen):
            return name
    return None


DETECTORS = {"decompose.asdf_only": "detect.asdf", "decompose.asdf_mixed": "detect.asdf"}
"""Detectors of decomposers that refuse `detect.maximum`."""


def list_methods() -> dict[str, Chain]:
    """A chain per detector, without a fit, and per decomposer, after a detector that serves it; by stage."""
    names = {kind: sorted(name for name in STAGES if STAGES[name].kind == kind) for kind in ("detect", "decompose")}
    chains = {name: _build_chain(name, name, "decompose.none") for name in names["detect"]}
    others = (name for name in names["decompose"] if name != "decompose.none")
    return chains | {name: _build_chain(name, DETECTORS.get(name, "detect.maximum"), name) for name in others}


def _build_chain(name: str, detector: str, decomposer: str) -> Chain:
    return Chain(tuple(Step(STAGES[stage]) for stage in ("noise.pooled", detector, decomposer, *ATTRIBUTES)), name)
