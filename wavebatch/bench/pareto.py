"""Which chains nobody beats, and which is the cheapest that is good enough."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from wavebatch.core.errors import ConfigError

_UNITS = {"m": 100.0, "cm": 1.0, "mm": 0.1}


def find_front(costs: np.ndarray) -> np.ndarray:
    """True for the rows of costs (n, k) that no other row beats: none is as good in all columns and better in one.

    Rows with a cost that is not known are never on the front.
    """
    known = np.isfinite(costs).all(axis=1)
    no_worse = (costs[:, None, :] <= costs[None, :, :]).all(axis=2)
    better = (costs[:, None, :] < costs[None, :, :]).any(axis=2)
    beaten = (no_worse & better & known[:, None]).any(axis=0)
    return known & ~beaten


def parse_length(text: str) -> float:
    """A length in cm from text such as `0.02m`, `2cm`, `15 mm`; raises ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", text)
    if match is None or not float(match[1]) > 0:
        raise ConfigError(f"{text!r} is no length; write for example 0.02m, 2cm or 20mm")
    return float(match[1]) * _UNITS[match[2]]


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
