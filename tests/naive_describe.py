"""Slow twins of kernels/fit/describe.py: loops over waveforms, echoes and directions, in double precision."""

import numpy as np
from scipy.special import gammaln
from scipy.stats import norm

FREEDOM = 4


def rows_of(evaluate, x, echo):
    """Pulse, and derivatives by time and width, of one echo (amplitude, time, width) at every sample."""
    return [np.asarray(row, float) for row in evaluate(x, echo[1], echo[2])]


def render(evaluate, s, echoes):
    """The sum of the echoes of one waveform."""
    x = np.arange(float(s))
    return sum((echo[0] * rows_of(evaluate, x, echo)[0] for echo in echoes), np.zeros(s))


def predict(correlation):
    """Factors of the two samples before, and the variance that they leave, by the equations of Yule and Walker."""
    rho = np.r_[1.0, correlation, 0.0, 0.0][:3]
    factors = np.linalg.solve([[1, rho[1]], [rho[1], 1]], rho[1:])
    return factors, 1 - factors @ rho[1:]


def innovate(row, correlation):
    """What the two samples before do not predict, of variance 1."""
    factors, left = predict(correlation)
    before = np.r_[0.0, 0.0, row]
    rest = [before[i + 2] - factors[0] * before[i + 1] - factors[1] * before[i] for i in range(len(row))]
    return np.array(rest) / np.sqrt(left)


def directions(evaluate, x, echo, used):
    """The two directions after the three of the fit, of length 1, times the root of the echo's energy."""
    pulse, by_time, by_width = rows_of(evaluate, x, echo)
    z = np.clip((x - echo[1]) / echo[2], -5, 5)
    found = []
    for row in (pulse, by_time, by_width, by_width * z, by_width * z * z):
        row = row * used
        for other in found:
            row = row - (row @ other) * other
        found.append(row / np.linalg.norm(row))
    size = echo[0] * np.linalg.norm(pulse * used)
    return size * found[3], size * found[4]


def describe(evaluate, left, model, used, echoes, std, gain, correlation, change):
    """Length and volume of one waveform."""
    x, variance = np.arange(float(len(left))), std**2 + gain * np.maximum(model, 0)
    weight = used / np.sqrt(variance)
    rest = innovate(left * weight, correlation)
    cost = 0.0
    for echo in sorted(echoes, key=lambda one: -one[0])[:3] if change else ():
        for direction in directions(evaluate, x, echo, used):
            row = innovate(direction * weight, correlation)
            height = row @ rest / (row @ row + 1 / change**2)
            rest = rest - height * row
            cost += 0.5 * (height / change) ** 2 + 0.5 * np.log1p(change**2 * (row @ row))
    scale = 0.75 * FREEDOM
    peak = gammaln((FREEDOM + 1) / 2) - gammaln(FREEDOM / 2) - 0.5 * np.log(np.pi * scale)
    density = (FREEDOM + 1) / 2 * np.log1p(rest**2 / scale) - peak
    length = cost + np.sum((density + 0.5 * np.log(variance * predict(correlation)[1]))[used])
    jacobian = [innovate(row * weight, correlation) for echo in echoes for row in rows_of(evaluate, x, echo)]
    if not jacobian:
        return length, 0.0
    jacobian = np.array([row / np.linalg.norm(row) for row in jacobian])
    gram = jacobian @ jacobian.T + 1e-6 * np.eye(len(jacobian))
    covariance = np.linalg.inv(gram)
    return length, 0.5 * (np.linalg.slogdet(gram)[1] + np.sum(np.log(np.maximum(np.diag(covariance), 1))))


def measure_change(evaluate, left, model, used, echoes, std, gain, correlation):
    """Least-squares changes of the strongest echo's shape, and one over their variances."""
    x, weight = np.arange(float(len(left))), used / np.sqrt(std**2 + gain * np.maximum(model, 0))
    rest = innovate(left * weight, correlation)
    strongest = max(echoes, key=lambda one: one[0])
    rows = [innovate(one * weight, correlation) for one in directions(evaluate, x, strongest, used)]
    return [row @ rest / (row @ row) for row in rows], [row @ row for row in rows]


def gather(evaluate, left, model, used, echoes, std, gain, change, delay, sigma, reference, counted):
    """Normal equations of one waveform, in which what its echoes may absorb counts less."""
    x = np.arange(float(len(left)))
    spread = std**2 + gain * np.maximum(model, 0) + change**2 * model**2
    weight = used * (FREEDOM + 1) / (FREEDOM + left**2 / spread) / spread
    columns = []
    for place, width in zip(delay, sigma, strict=True):
        column = np.zeros(len(x))
        for amplitude, time, own in echoes:
            wide = np.sqrt(max(width**2 + own**2 - reference**2, 0.1 * width**2))
            column += amplitude * own / wide * np.exp(-0.5 * ((x - time - place) / wide) ** 2)
        columns.append(column)
    rows = np.array([*columns, np.ones(len(x)), left + model]) * np.sqrt(weight)
    moves = np.array([row for echo in echoes for row in rows_of(evaluate, x, echo)[:2]]) * np.sqrt(weight)
    moves = np.linalg.qr(moves.T)[0]
    rows = rows - (1 - counted) * rows @ moves @ moves.T
    return rows[:-1] @ rows[:-1].T, rows[:-1] @ rows[-1]


def describe_widths(ratio, error, known, scatters, wider, anywhere):
    """Costs of widths, by a mixture of the pulse's own width and uniform laws, learned from the known ones."""
    found = []
    for scatter in scatters:
        spread = np.hypot(error, scatter)
        below = norm.cdf((ratio - 1) / spread)
        laws = [norm.pdf(ratio, 1, spread)]
        laws += [(below - norm.cdf((ratio - end) / spread)) / (end - 1) for end in wider]
        laws = np.array(laws).T
        share = np.full(laws.shape[1], 1 / laws.shape[1])
        for _ in range(15):
            belongs = laws[known] * share
            belongs /= belongs.sum(axis=1, keepdims=True)
            share = (belongs.sum(axis=0) + 0.5) / (known.sum() + 0.5 * len(share))
        found.append(-np.log((1 - anywhere) * laws @ share + anywhere / wider[-1]))
    best = min(found, key=lambda cost: cost[known].sum())
    return best - np.log(np.sqrt(2 * np.pi) * error)
