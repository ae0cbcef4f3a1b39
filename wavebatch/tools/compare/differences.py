"""Differences of paired echoes in time, amplitude and width: of all, by LAS class, and by number of echoes.

Against a truth also in units of the Cramer-Rao bound.

`pairing` adds pairs; sums are of all pairs, medians of an even sample, so that memory is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, MAD_TO_STD
from wavebatch.kernels.fit.bounds import crlb
from wavebatch.stages.score import ErrorStats
from wavebatch.tools.even_sample import EvenSample

SPEED = 0.9997 * HALF_C
"""Metres along the ray per ns; the factor is the refractive index of air, n = 1.0003."""

_BOTH = ("echo_time", "amplitude", "echo_width")
"""Columns that are compared if both sides have them."""

GROUPS = {"class": "classification", "echoes": "total"}
"""By what differences are grouped: the LAS class, and the number of echoes of the pulse."""


@dataclass(frozen=True, slots=True)
class ErrorSpread:
    """Differences a minus b of one quantity, over the echoes that both sides have."""

    number: int
    median: float
    mean: float
    rms: float
    nmad: float


class Differences:
    """Collects pairs of echoes (CLOUD_DTYPE): sums of all pairs, and an even sample of them for medians."""

    def __init__(self, limit: int | None = None) -> None:
        self._sample = EvenSample(limit)
        self.sums = {name: np.zeros(3) for name in ("time", *_BOTH)}
        self._grouped = {
            (kind, side, name): np.zeros((256, 3)) for kind in GROUPS for side in "ab" for name in self.sums
        }

    def add(self, a: np.ndarray, b: np.ndarray) -> None:
        """Adds pairs: a[i] with b[i]."""
        part = {name: a[name].astype(np.float64) - b[name] for name in _BOTH}
        part["time"] = measure_lag(a, b) / SPEED
        for name, values in part.items():
            good = values[~np.isnan(values)]
            self.sums[name] += [len(good), good.sum(), np.square(good).sum()]
            for kind, field in GROUPS.items():
                for side, rows in (("a", a), ("b", b)):
                    group = rows[field][~np.isnan(values)]
                    sums = self._grouped[kind, side, name]
                    for place, weights in enumerate((None, good, np.square(good))):
                        sums[:, place] += np.bincount(group, weights, len(sums))
        for name in ("amplitude_err", "echo_width_err", "range_err"):
            part[name] = a[name]
        for name in ("amplitude", "echo_width", "flags"):
            part[f"true_{name}"] = b[name]
        part |= {f"{kind}_{side}": rows[field] for kind, field in GROUPS.items() for side, rows in (("a", a), ("b", b))}
        part["isolated"] = b["isolated"] if "isolated" in b.dtype.names else np.zeros(len(b), bool)
        self._sample.add(part)

    def spreads(self) -> dict[str, ErrorSpread]:
        """Median, mean, rms and NMAD of a minus b, for each quantity that both sides have."""
        data = self._sample.read()
        return {name: _spread(sums, data[name]) for name, sums in self.sums.items() if sums[0]}

    def groups(self) -> dict[str, dict[int, dict[str, ErrorSpread]]]:
        """The same by kind of GROUPS and by number: of the class, and of the echoes that the pulse has.

        A pair belongs to the group of its echo of b; where b has no groups (all are 0), to that of its echo of a.
        Kinds in which both sides have none are left out. Medians of rare groups are NaN if the sample has none of them.
        """
        data, result = self._sample.read(), {}
        for kind in GROUPS:
            side = next((side for side in "ba" if self._grouped[kind, side, "time"][1:, 0].any()), None)
            if side is None:
                continue
            result[kind] = {
                group: {
                    name: _spread(sums[group], data[name][data[f"{kind}_{side}"] == group])
                    for name in self.sums if (sums := self._grouped[kind, side, name])[group, 0]
                }
                for group in np.flatnonzero(self._grouped[kind, side, "time"][:, 0]).tolist()
            }  # fmt: skip
        return result

    def errors(self, meta: dict) -> dict[str, dict[str, ErrorStats]]:
        """Errors of time [ns], amplitude [DN] and sigma [ns], in units of the bound and of the reported errors."""
        data = self._sample.read()
        if not data:
            return {}
        sigma = data["true_echo_width"].astype(np.float64) / FWHM_PER_SIGMA
        amplitude = data["true_amplitude"].astype(np.float64)
        sigma[~(sigma > 0)] = amplitude[~(amplitude > 0)] = np.nan  # of a damaged truth: there is no bound
        reported = {name: data[name].astype(np.float64) for name in ("range_err", "amplitude_err", "echo_width_err")}
        bounds = crlb(amplitude, sigma, meta["noise_std"], meta["spacing"])
        columns = {
            "time": (data["time"], bounds[0], reported["range_err"] / SPEED),
            "echo_time": (data["echo_time"], bounds[0], reported["range_err"] / SPEED),
            "amplitude": (data["amplitude"], bounds[1], reported["amplitude_err"]),
            "sigma": (data["echo_width"] / FWHM_PER_SIGMA, bounds[2], reported["echo_width_err"] / FWHM_PER_SIGMA),
        }
        classes = {
            "all": np.ones(len(sigma), bool),
            "isolated": data["isolated"],
            "overlapped": (data["true_flags"] & np.uint16(EchoFlag.OVERLAPPED)) != 0,
        }
        return {
            kind: {name: _measure(rows, *values) for name, values in columns.items()} for kind, rows in classes.items()
        }


def _spread(sums: np.ndarray, values: np.ndarray) -> ErrorSpread:
    """The spread from number, sum and sum of squares of all pairs, and from the differences of a sample of them."""
    number, total, squares = sums.tolist()
    values = values[~np.isnan(values)]
    median = np.median(values) if len(values) else np.nan
    nmad = MAD_TO_STD * np.median(np.abs(values - median)) if len(values) else np.nan
    return ErrorSpread(int(number), float(median), total / number, float(np.sqrt(squares / number)), float(nmad))


def measure_lag(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of a after b along the ray [m], f8 (k,), positive away from the sensor.

    The ray is the packet vector of b, or of a; without both, the lower point counts as the farther one.
    """
    step = a["xyz"] - b["xyz"]
    ray = np.where(np.any(b["ray"] != 0, axis=1)[:, None], b["ray"], a["ray"]).astype(np.float64)
    length = np.linalg.norm(ray, axis=1)
    known = length > 0
    down = -np.sign(ray[:, 2]) / np.where(known, length, 1.0)
    along = np.einsum("ij,ij->i", step, ray) * down
    by_height = np.linalg.norm(step, axis=1) * -np.sign(step[:, 2])
    return np.where(known & (down != 0), along, by_height)


def _measure(rows: np.ndarray, error: np.ndarray, bound: np.ndarray, reported: np.ndarray) -> ErrorStats:
    rows = rows & ~np.isnan(error)
    return ErrorStats.compute(error[rows], bound[rows], reported[rows])
