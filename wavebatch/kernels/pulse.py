"""The pulse models of a fit: unit pulses and their derivatives for many echoes at once (ALGORITHMS.md 0, R1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

NO_SKEW = 1e-6
"""Below this |kappa| a pulse is treated as symmetric."""


class PulseShape(NamedTuple):
    """Shape of the system pulse in samples: a Gaussian, a skewed pulse, or a learned sum of Gaussians.

    kappa: skew of the log-normal pulse in its stable form; 0 for the others.
    components: (weight, delay, extra variance) of the learned pulse's further Gaussians relative to the first:
        weight per unit of the first one's area, delay behind it, variance minus the first one's.
    """

    kappa: float = 0.0
    components: tuple[tuple[float, float, float], ...] = ()

    @property
    def is_gaussian(self) -> bool:
        """True when the plain Gaussian is the whole model."""
        return abs(self.kappa) < NO_SKEW and not self.components


GAUSSIAN = PulseShape()


def evaluate_pulse(shape: PulseShape, x: np.ndarray, t: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, ...]:
    """Unit pulse and its derivatives times s by time and by width, each of the shape that x and t broadcast to.

    x: sample positions; t, s: centre and width of echoes; float32 throughout in a fit, float64 where asked.
    With amplitude A the Jacobian columns are pulse, A/s times the second, A/s times the third.
    """
    z = x - t
    z *= 1 / s
    if shape.components:
        return _evaluate_components(shape, x, t, s, z)
    if abs(shape.kappa) >= NO_SKEW:
        return _evaluate_skewed(shape.kappa, z)
    return _evaluate_gaussian(z)


def _evaluate_gaussian(z: np.ndarray) -> tuple[np.ndarray, ...]:
    pulse = z * z
    pulse *= np.float32(-0.5)
    np.exp(pulse, out=pulse)
    by_time = pulse * z
    z *= by_time
    return pulse, by_time, z


def _evaluate_skewed(kappa: float, z: np.ndarray) -> tuple[np.ndarray, ...]:
    """f = exp(-L^2/2), L = log1p(kappa z)/kappa, 0 where kappa z <= -1 (section 0)."""
    inside = np.float32(kappa) * z
    gone = inside <= np.float32(-0.999999)
    inside[gone] = 0
    level = np.log1p(inside)
    level *= np.float32(1 / kappa)
    pulse = np.exp(np.float32(-0.5) * level * level)
    pulse[gone] = 0
    inside += np.float32(1)
    by_time = pulse * level
    by_time /= inside
    return pulse, by_time, by_time * z


def _evaluate_components(
    shape: PulseShape, x: np.ndarray, t: np.ndarray, s: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Sum of Gaussians that a Gaussian target widens together; amplitude is that of the first one (R1)."""
    pulse, by_time, by_width = _evaluate_gaussian(z)
    variance = s * s
    for weight, delay, extra in shape.components:
        wide = variance + np.float32(extra)
        inverse = 1 / np.sqrt(wide)
        ratio = s * inverse
        d = (x - (t + np.float32(delay))) * inverse
        part, part_time, part_width = _evaluate_gaussian(d)
        part *= np.float32(weight) * ratio
        pulse += part
        by_time += part_time * (np.float32(weight) * ratio * ratio)
        # d/ds of ratio * exp(-d^2/2): s * (1/s - s/wide) * part + (s/wide) * s * weight * ratio * part_width
        by_width += part * (1 - ratio * ratio)
        by_width += part_width * (np.float32(weight) * ratio * ratio * ratio)
    return pulse, by_time, by_width
