"""What the strips of a calibrated flight have in common, and what a person should look at.

`calibrate_flight` calls `compare_pairs` and `find_doubts` once the constants are adjusted.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from wavebatch.core.frozen import frozen
from wavebatch.core.order import robust_std
from wavebatch.surveying.calibrating.adjust_flight import LEAST_TIES, Adjustment
from wavebatch.surveying.calibrating.tie_cells import Ties
from wavebatch.surveying.calibration import StripConstant

HEIGHT_DOUBT, LEAST_HEIGHT = 5.0, 0.05
"""Height differences of two strips are named from so many standard errors, and this [m]."""

LEAST_DRIFT = 4.0
"""Drifts of this many standard deviations are named."""


@frozen
class PairOverlap:
    """What two sources have in common."""

    a: str
    b: str
    cells: int
    ratio: float
    """Light of a over that of b in the same cells, median: what differs before the calibration."""
    after: float
    """The same with their constants: 1 where the adjustment brings them together."""
    spread: float
    """Robust standard deviation of the ratio between cells, relative."""
    height: float
    """Median height of a over b [m]."""
    height_spread: float


def compare_pairs(ties: Ties, adjusted: Adjustment, names: Sequence[str]) -> Iterator[PairOverlap]:
    """Compare each two sources that share enough cells.

    Parameters
    ----------
    ties : Ties
    adjusted : Adjustment
    names : sequence of str
        Of the sources.

    Yields
    ------
    PairOverlap
    """
    order = np.argsort(ties.source, kind="stable")
    rows = {k: order[ties.source[order] == k] for k in range(len(names))}
    for a in range(len(names)):
        for b in range(a):
            _, left, right = np.intersect1d(ties.cell[rows[a]], ties.cell[rows[b]], return_indices=True)
            if len(left) < LEAST_TIES:
                continue
            i, j = rows[a][left], rows[b][right]
            value, height = ties.value[i] - ties.value[j], ties.height[i] - ties.height[j]
            middle = float(np.median(value))
            yield PairOverlap(
                names[a],
                names[b],
                len(i),
                math.exp(middle),
                math.exp(middle + adjusted.value[a] - adjusted.value[b]),
                robust_std(value),
                float(np.median(height)),
                robust_std(height),
            )


def find_doubts(lost: Sequence[str], strips: Sequence[StripConstant], pairs: Sequence[PairOverlap]) -> Iterator[str]:
    """Name sources without a constant, strips that drift, and heights that do not fit.

    Parameters
    ----------
    lost : sequence of str
        Names of the sources without a constant.
    strips : sequence of StripConstant
    pairs : sequence of PairOverlap

    Yields
    ------
    str
        One line each.
    """
    for name in lost:
        yield (
            f"{name}: has no constant: no target lies on it, and fewer than {LEAST_TIES} flat cells tie it to a "
            "strip or channel that has one"
        )
    for row in strips:
        if row.drift_error > 0 and abs(row.drift) > max(LEAST_DRIFT * row.drift_error, 0.01):
            yield (
                f"{row.strip}: its constant is {100 * row.drift:+.2f} +- {100 * row.drift_error:.2f} % off the mean of "
                f"digitizer {row.digitizer}, scanner channel {row.scanner}"
            )
    for pair in pairs:
        error = pair.height_spread / math.sqrt(pair.cells)
        if abs(pair.height) > max(HEIGHT_DOUBT * error, LEAST_HEIGHT):
            yield f"{pair.a} lies {pair.height:+.2f} m over {pair.b}: check boresight, trajectory and heights"
