"""Differences of paired echoes in time, amplitude and width; against a truth also in units of the Cramer-Rao bound.

`pairing` adds pairs; sums are of all pairs, medians of an even sample, so that memory is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.even_sample import EvenSample
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, MAD_TO_STD
from wavebatch.kernels.fit.bounds import crlb
from wavebatch.stages.score import ErrorStats

SPEED = 0.9997 * HALF_C
"""Metres along the ray per ns; the factor is the refractive index of air, n = 1.0003."""

_BOTH = ("echo_time", "amplitude", "echo_width")
"""Columns that are compared if both sides have them."""


@dataclass(frozen=True, slots=True)
class Spread:
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

    def add(self, a: np.ndarray, b: np.ndarray) -> None:
        """Adds pairs: a[i] with b[i]."""
        part = {name: a[name].astype(np.float64) - b[name] for name in _BOTH}
        part["time"] = measure_lag(a, b) / SPEED
        for name, values in part.items():
            good = values[~np.isnan(values)]
            self.sums[name] += [len(good), good.sum(), np.square(good).sum()]
        for name in ("amplitude_err", "echo_width_err", "range_err"):
            part[name] = a[name]
        for name in ("amplitude", "echo_width", "flags"):
            part[f"true_{name}"] = b[name]
        part["isolated"] = b["isolated"] if "isolated" in b.dtype.names else np.zeros(len(b), bool)
        self._sample.add(part)

    def spreads(self) -> dict[str, Spread]:
        """Median, mean, rms and NMAD of a minus b, for each quantity that both sides have."""
        result = {}
        for name, (number, total, squares) in self.sums.items():
            if not number:
                continue
            values = self._sample.read()[name]
            values = values[~np.isnan(values)]
            median = np.median(values)
            nmad = MAD_TO_STD * np.median(np.abs(values - median))
            figures = (median, total / number, np.sqrt(squares / number), nmad)
            result[name] = Spread(int(number), *map(float, figures))
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
