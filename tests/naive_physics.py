"""Slow, plain references for kernels/physics: one echo, one pulse or one angle after the other, by the math module."""

import math

import numpy as np
from scipy.optimize import brentq
from scipy.special import log_ndtr

from wavebatch.kernels.physics.incidence import RADIUS

LIGHT = 0.299792458


def median(values):
    values = sorted(values)
    return (values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2


def angle_of_spread(spread, distance, divergence):
    return math.copysign(1, spread) * math.atan(abs(spread) * LIGHT / 2 / (distance * divergence / 4))


def radius(variance, error):
    """Half of the range of the spread that holds 68.3 %: from the table, or by propagation far from 0."""
    place = variance / error if variance < 0 else math.sqrt(variance / error)
    table = list(zip(*RADIUS, strict=True))
    if place > table[-1][0]:
        return error / (2 * math.sqrt(variance))
    if place <= table[0][0]:
        return table[0][1] * math.sqrt(error)
    right = next(i for i, (at, _) in enumerate(table) if at >= place)
    (a, low), (b, high) = table[right - 1], table[right]
    return (low + (high - low) * (place - a) / (b - a)) * math.sqrt(error)


def mean_above(over, share):
    """Mean of the normal law of which so many of the draws above 0 lie above `over`."""
    return brentq(lambda mean: log_ndtr(mean - over) - log_ndtr(mean) - math.log(share), -3000, over + 9, xtol=1e-10)


def angle_above(variance, error, distance, divergence, threshold):
    """Angle of one echo that is seen because its variance exceeds the threshold, and its error."""
    over = variance / error - threshold
    angles = []
    for share in (0.1587, 0.5, 0.8413):
        true = threshold + mean_above(over, share)
        angles.append(angle_of_spread(math.sqrt(max(error * true, 0.0)), distance, divergence))
    low, angle, high = angles
    facing = angle_of_spread(radius(0.0, error), distance, divergence)
    off = (high - low) / 2 if angle > 0 else max(high, facing)
    return (angle, off) if angle <= math.radians(80) else (math.nan, math.nan)


def light_slope(pulses, ratio):
    """Slope of the logarithm of all light over the ground's share, fitted three times without outliers."""
    share = [ratio * g / (c + ratio * g) for c, g in pulses]
    light = [math.log(c + ratio * g) for c, g in pulses]
    used = range(len(pulses))
    for _ in range(3):
        line = np.polyfit([share[i] for i in used], [light[i] for i in used], 1)
        off = [abs(y - line[0] * x - line[1]) for x, y in zip(share, light, strict=True)]
        used = [i for i, one in enumerate(off) if one <= 4 * max(1.482602 * median(off), 1e-9)]
    return line[0], np.std(share)


def canopy_ratio(pulses, logs):
    """Logarithm of the ratio at which light has no slope over the ground's share; None where there is not one."""
    slopes = [light_slope(pulses, math.exp(value))[0] for value in logs]
    rises = [i for i in range(len(logs) - 1) if slopes[i] < 0 <= slopes[i + 1]]
    if len(rises) != 1:
        return None
    low, high = logs[rises[0]], logs[rises[0] + 1]
    found = brentq(lambda value: light_slope(pulses, math.exp(value))[0], low, high, xtol=2e-4)
    return found if light_slope(pulses, math.exp(found))[1] >= 0.1 else None


def estimate_canopy_ratio(canopy, ground):
    """(ratio, error) from all pulses, and from all but one of ten parts of the strip."""
    pulses = [(c, g) for c, g in zip(canopy, ground, strict=True) if c >= 0 and g >= 0 and 0 < c + g < math.inf]
    found = canopy_ratio(pulses, np.linspace(math.log(0.02), math.log(50.0), 33)) if len(pulses) >= 100 else None
    if found is None:
        return None
    parts = [i * 10 // len(pulses) for i in range(len(pulses))]
    near = found + np.linspace(-math.log(2), math.log(2), 5)
    others = [
        canopy_ratio([p for p, own in zip(pulses, parts, strict=True) if own != left], near) for left in range(10)
    ]
    if None in others:
        return None
    light = [math.log(c + math.exp(found) * g) for c, g in pulses]
    scatter = 1.482602 * median([abs(value - median(light)) for value in light])
    off = [abs(value - median(light)) for value in light]
    unlike = sum(value**2 for value in off if 4 * scatter < value < math.log(4)) / len(off)
    error = math.sqrt(9 * np.var(others) + 0.03**2 + scatter**4 + unlike)
    return (math.exp(found), math.exp(found) * error) if error < 0.5 else None


def energy_slope(light, energy):
    """Slope of the steps of the logarithm of light over those of energy, and its error; the ends do not count."""
    steps = []
    for i in range(1, len(light) - 2):
        four = light[i], light[i + 1], energy[i], energy[i + 1]
        if all(0 < value < math.inf for value in four):
            steps.append((math.log(four[1] / four[0]), math.log(four[3] / four[2])))
    whole = sum(step**2 for _, step in steps)
    if not whole > 0:
        return 0.0, math.inf
    limit = 4 * median([abs(rise) for rise, _ in steps])
    steps = [(min(max(rise, -limit), limit), step) for rise, step in steps]
    slope = sum(rise * step for rise, step in steps) / whole
    return slope, math.sqrt(2 * sum((rise - slope * step) ** 2 for rise, step in steps) / len(steps) / whole)


def judge_energies(light, energy):
    """"" where light follows the energies or nothing is known, else "early", "late" or "others"; and what it lacks."""
    slope, error = energy_slope(light, energy)
    if error > 0.15:
        return "", 0.0
    if slope + 3 * error > 0.5:
        return "", max(0.95 - slope, 0.0)
    if energy_slope(light, [energy[-1], *energy[:-1]])[0] > 0.5:
        return "early", 1.0
    return "late" if energy_slope(light, [*energy[1:], energy[0]])[0] > 0.5 else "others", 1.0
