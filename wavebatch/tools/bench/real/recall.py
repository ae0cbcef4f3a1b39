"""Tables from injected echoes: the share that is found, and how right the reported errors are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.tools.bench.real.inject import Injected

SIGMAS = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 40.0, 80.0)
"""Borders of amplitude classes [noise standard deviations]."""

COUNTS = (2.0, 3.0, 4.0, 6.0, 9.0, 15.0, 30.0, 60.0, 120.0, 240.0)
"""Borders of amplitude classes [DN]."""

APART = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)
"""Borders of the classes of separation [FWHM]."""

NEAR_SIGMAS = (5.0, 10.0, 20.0, 40.0)
"""Borders of amplitude classes near other echoes [noise standard deviations]."""

CALIBRATED = (8.0, 15.0, 30.0, 60.0)
"""Borders of amplitude classes of the reported errors: weaker echoes are found or not by their error."""

RESOLVED = 1.5
"""Separation from which errors near other echoes are looked at [FWHM]."""

GROSS = 5.0
"""Errors of more reported standard deviations are counted, and left out of the root mean square."""


@dataclass(frozen=True, slots=True)
class Class:
    """Injected echoes of one class of amplitude, and one of separation where it is set."""

    low: float
    high: float
    injected: int
    found: int
    extra: int
    """Echoes found in their waveforms that neither were there before nor were injected."""
    apart: tuple[float, float] | None = None
    """Separation from the strongest echo [FWHM]."""

    @property
    def recall(self) -> float:
        """Share that is found; NaN without any."""
        return self.found / self.injected if self.injected else float("nan")


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of found echoes against what the chain reports; per quantity time, amplitude, sigma."""

    where: str
    low: float
    high: float
    """Amplitudes [noise standard deviations]."""
    echoes: int
    ratio: tuple[float, float, float]
    """Root mean square of error / reported error, without gross ones."""
    bias: tuple[float, float, float]
    """Median error [ns, DN, ns]."""
    scatter: tuple[float, float, float]
    """Half the width of the central 68 % of the errors [ns, DN, ns]."""
    gross: float
    """Share with an error of more than 5 reported ones in any quantity."""


def count_classes(injected: Injected, unit: float, borders: tuple[float, ...], where: np.ndarray) -> list[Class]:
    """Classes of amplitude / unit between the borders and above the last, of the echoes at `where` (mask)."""
    size = injected.amplitude / unit
    classes = []
    for low, high in zip(borders, (*borders[1:], np.inf), strict=True):
        part = where & (size >= low) & (size < high)
        classes.append(
            Class(low, high, int(part.sum()), int(injected.found[part].sum()), int(injected.extra[part].sum()))
        )
    return [row for row in classes if row.injected]


def count_separations(injected: Injected, noise: float) -> list[Class]:
    """Recall near the strongest echoes by separation, before and after them, and amplitude."""
    rows = []
    size = injected.amplitude / noise
    for side in (-1.0, 1.0):
        for near, far in zip(APART[:-1], APART[1:], strict=True):
            apart = side * injected.separation
            with np.errstate(invalid="ignore"):
                inside = injected.near & (apart >= near) & (apart < far)
            for low, high in zip(NEAR_SIGMAS, (*NEAR_SIGMAS[1:], np.inf), strict=True):
                part = inside & (size >= low) & (size < high)
                found, extra = int(injected.found[part].sum()), int(injected.extra[part].sum())
                rows.append(Class(low, high, int(part.sum()), found, extra, (side * near, side * far)))
    return rows


def calibrate(injected: Injected, noise: float) -> list[Calibration]:
    """Errors in quiet stretches by amplitude, and near other echoes from a separation that fits can tell apart."""
    size = injected.amplitude / noise
    clean = injected.found & ~injected.clipped & (injected.extra <= 0)
    rows = []
    for low, high in zip(CALIBRATED, (*CALIBRATED[1:], np.inf), strict=True):
        rows.append(_calibrate("quiet", low, high, injected, clean & ~injected.near & (size >= low) & (size < high)))
    rows.append(_calibrate("quiet", CALIBRATED[0], np.inf, injected, clean & ~injected.near & (size >= CALIBRATED[0])))
    with np.errstate(invalid="ignore"):
        apart = injected.near & (np.abs(injected.separation) >= RESOLVED)
    rows.append(_calibrate("near", CALIBRATED[0], np.inf, injected, clean & apart & (size >= CALIBRATED[0])))
    return [row for row in rows if row.echoes >= 10]


def _calibrate(where: str, low: float, high: float, injected: Injected, part: np.ndarray) -> Calibration:
    errors, reported = injected.errors[part], injected.reported[part]
    known = (np.isfinite(reported) & (reported > 0)).all(axis=1)
    errors, scaled = errors[known], errors[known] / reported[known]
    gross = (np.abs(scaled) > GROSS).any(axis=1)
    if gross.all():
        return Calibration(where, low, high, 0, *((float("nan"),) * 3,) * 3, 0.0)
    ratio = np.sqrt(np.mean(scaled[~gross] ** 2, axis=0))
    lower, middle, upper = np.quantile(errors[~gross], [0.1587, 0.5, 0.8413], axis=0)
    figures = (tuple(map(float, values)) for values in (ratio, middle, 0.5 * (upper - lower)))
    return Calibration(where, low, high, len(errors), *figures, float(gross.mean()))
