"""Chains of a benchmark: one per registered method, those that no other beats, and the cheapest that is good enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

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


def find_front(costs: np.ndarray) -> np.ndarray:
    """True for the rows of costs (n, k) that no other row beats: none is as good in all columns and better in one.

    Rows with a cost that is not known are never on the front.
    """
    known = np.isfinite(costs).all(axis=1)
    no_worse = (costs[:, None, :] <= costs[None, :, :]).all(axis=2)
    better = (costs[:, None, :] < costs[None, :, :]).any(axis=2)
    beaten = (no_worse & better & known[:, None]).any(axis=0)
    return known & ~beaten


def choose_cheapest(rows: Sequence[Mapping], tolerance_cm: float) -> Mapping | None:
    """The row of least time per waveform whose isolated echoes meet the tolerance, their error added; None if none.

    rows: as in the document of the benchmark.
    """
    good = []
    for row in rows:
        rmse = row["figures"]["rmse_isolated_cm"]
        seconds = row["kernels"]["median"]
        if rmse["value"] is not None and seconds is not None and rmse["value"] + (rmse["error"] or 0) <= tolerance_cm:
            good.append((seconds, row["name"], row))
    return min(good, key=lambda entry: entry[:2])[2] if good else None
