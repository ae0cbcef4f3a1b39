"""A slow, plain decomposition of real waveforms, to judge others by; it shares nothing with wavebatch but its reader.

The pulse is stacked from lone echoes, or known. Echoes are added one by one where a matched filter with the full
covariance of noise and misfit sees the most, as long as the likelihood ratio pays for three more values.
All times are in samples.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.ndimage import gaussian_filter1d

PAYS = 25.0
"""Fall of chi2 that pays for one more echo."""
MOST = 10
"""Echoes of a packet."""
FINE = 20
"""Steps of the pulse's table per sample."""
LAGS = 16
"""Of the noise's covariance that are measured."""
CUT, SMOOTH = 0.35, 0.8
"""Share of quiet samples up to which a strip is cut to its signal: what fits leave there is echoes that were not found,
so the first samples of all packets give the noise, and its correlation is a guess."""
WIDEST = 6.0
"""Largest variance of a target, in those of the pulse."""
STEP = 0.125
"""Of the table's widenings."""


@dataclass
class Waveform:
    """One packet; `used` leaves out what was not recorded or is clipped."""

    packet: int
    samples: np.ndarray
    used: np.ndarray


@dataclass
class Pulse:
    """Pulses by the variance that targets add, each with a peak of 1 near lag 0."""

    lag: np.ndarray
    table: np.ndarray
    fwhm: float
    slopes: tuple[np.ndarray, np.ndarray] = field(default=())

    @classmethod
    def widen(cls, lag: np.ndarray, plain: np.ndarray) -> Pulse:
        """With all widenings of a plain pulse."""
        top = int(np.argmax(plain))
        before = np.interp(0.5 * plain[top], np.maximum.accumulate(plain[: top + 1]), lag[: top + 1])
        after = np.interp(-0.5 * plain[top], np.maximum.accumulate(-plain[top:]), lag[top:])
        fwhm = float(after - before)
        sigma = fwhm / 2.3548 * FINE
        levels = np.arange(0, WIDEST + STEP, STEP)
        table = [gaussian_filter1d(plain, sigma * np.sqrt(v), mode="nearest") if v else plain for v in levels]
        table = np.array([one / one.max() for one in table])
        return cls(lag, table, fwhm, (np.gradient(table, 1 / FINE, axis=1), np.gradient(table, STEP, axis=0)))

    def at(self, lag: np.ndarray, variance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height, and its slopes by lag and by variance; variances may be a little negative."""
        x = np.clip((lag - self.lag[0]) * FINE, 0, len(self.lag) - 1.001)
        v = np.clip(variance / STEP, 0, len(self.table) - 1.001)
        i, j = x.astype(int), int(v)
        p, q = x - i, v - j
        mixed = [
            (1 - q) * ((1 - p) * one[j, i] + p * one[j, i + 1]) + q * ((1 - p) * one[j + 1, i] + p * one[j + 1, i + 1])
            for one in (self.table, *self.slopes)
        ]
        return mixed[0] + min(variance, 0) * mixed[2], mixed[1], mixed[2]


def read_known(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A pulse of a file: a recording (.csv, a count per line), or Gaussians of a shipped system (.toml)."""
    if path.suffix == ".csv":
        counts = np.trim_zeros(np.loadtxt(path))
        counts = counts - np.median(counts[:8])
        x = np.arange(len(counts)) - float(np.argmax(counts))
        lag = np.arange(-60, 90, 1 / FINE)
        return lag, np.interp(lag, x, counts / counts.max(), 0, 0)
    values = tomllib.loads(path.read_text())
    spacing = values["figures"]["spacing_ns"]
    lag = np.arange(-40, 90, 1 / FINE)
    parts = [w * np.exp(-0.5 * ((lag * spacing - d) / s) ** 2) for w, d, s in values["system"]["components"]]
    plain = np.sum(parts, axis=0)
    return lag - lag[np.argmax(plain)], plain / plain.max()


def stack_pulse(waveforms: list[Waveform]) -> tuple[np.ndarray, np.ndarray]:
    """The pulse of lone echoes of the most frequent width, so that slopes do not widen it."""
    level = np.median(np.concatenate([one.samples[:8] for one in waveforms]))
    noise = max(measure_white(waveforms), 0.3)
    rows = []
    for one in waveforms:
        y = np.where(one.used, one.samples - level, 0)
        top = int(np.argmax(y))
        low = np.flatnonzero(y < 0.5 * y[top])
        left, right = low[low < top], low[low > top]
        if y[top] < 30 * noise or not one.used.all() or not len(left) or not len(right):
            continue
        a, b = left[-1], right[0]
        begin = a + (0.5 * y[top] - y[a]) / (y[a + 1] - y[a])
        end = b - (0.5 * y[top] - y[b]) / (y[b - 1] - y[b])
        rows.append((end - begin, 0.5 * (begin + end), y))
    usual = np.quantile([row[0] for row in rows], 0.25)
    lone = []
    for width, centre, y in rows:
        far = np.abs(np.arange(len(y)) - centre) > 1.4 * usual
        if y[far].max(initial=0) < 0.08 * y.max() and 1.5 * usual < centre < len(y) - 2 * usual:
            lone.append((width, centre, y))
    # The shortest interval with half of the widths: level ground has the most frequent width, not the least.
    widths, half = np.sort([row[0] for row in lone]), (len(lone) + 1) // 2
    begin = int(np.argmin(widths[half - 1 :] - widths[: len(widths) - half + 1]))
    limits = widths[begin], widths[begin + half - 1]
    lone = [row for row in lone if limits[0] <= row[0] <= limits[1]]
    lag = np.arange(-4 * usual, 8 * usual, 1 / FINE)
    height, centre = np.array([row[2].max() for row in lone]), np.array([row[1] for row in lone])
    bins = max(int(usual), 4)
    for _ in range(4):
        x = np.concatenate([np.arange(len(row[2])) - c for row, c in zip(lone, centre, strict=True)])
        value = np.concatenate([row[2] / h for row, h in zip(lone, height, strict=True)])
        edges = np.arange(lag[0], lag[-1], usual / (6 * bins))
        place = np.digitize(x, edges)
        order = np.argsort(place, kind="stable")
        groups = np.split(value[order], np.searchsorted(place[order], np.arange(1, len(edges) + 1)))[1:]
        middle = np.array([np.median(group) if len(group) > 4 else np.nan for group in groups])
        good = np.isfinite(middle)
        plain = np.interp(lag, edges[good] + usual / (12 * bins), middle[good], 0, 0)
        plain = gaussian_filter1d(plain, FINE * usual / 30)
        plain /= plain.max()
        slope = np.gradient(plain, 1 / FINE)
        for i, row in enumerate(lone):
            away = np.arange(len(row[2])) - centre[i]
            near = np.abs(away) < usual
            columns = np.stack([np.interp(away, lag, one) for one in (plain, -slope)], axis=1)[near]
            gain, shift = np.linalg.lstsq(columns, row[2][near], rcond=None)[0]
            centre[i] += np.clip(shift / gain, -0.5, 0.5)
            height[i] = gain
    return lag - lag[np.argmax(plain)], plain


def measure_white(waveforms: list[Waveform]) -> float:
    """Noise from differences of neighbours: right for white noise, a start for others."""
    steps = np.concatenate([np.diff(one.samples)[one.used[1:] & one.used[:-1]] for one in waveforms])
    return float(max(1.4826 * np.median(np.abs(steps)) / np.sqrt(2), 0.3))


class Fitter:
    """Fits packets of one strip."""

    def __init__(self, waveforms: list[Waveform], known: Path | None) -> None:
        self.waveforms = waveforms
        self.pulse = Pulse.widen(*(read_known(known) if known else stack_pulse(waveforms)))
        lows = np.array([np.quantile(one.samples[one.used], 0.2) for one in waveforms])
        self.level = float(np.median(lows))
        self.spread = float(1.4826 * np.median(np.abs(lows - self.level)) + 0.5)
        self.covariance = np.r_[measure_white(waveforms) ** 2 + 1 / 12, np.zeros(LAGS - 1)]
        self.misfit = 0.005
        starts = np.array([one.samples[5] - one.samples[0] for one in waveforms])
        scale = max(1.4826 * np.median(np.abs(starts - np.median(starts))) / np.sqrt(2), 0.5)
        quiet = np.mean([np.mean(np.abs(one.samples - self.level) < 4 * scale) for one in waveforms])
        if quiet < CUT:
            self.covariance = scale**2 * SMOOTH ** np.arange(LAGS) * (1 - np.arange(LAGS) / LAGS)
            self.misfit = 0.01
            return
        for _ in range(2):
            self._measure(waveforms[:: max(len(waveforms) // 50, 1)])

    def _measure(self, waveforms: list[Waveform]) -> None:
        """Covariance of the noise and misfit of strong echoes, from what fits leave."""
        lags, number, strong, levels = np.zeros(LAGS), np.zeros(LAGS), [], []
        for one in waveforms:
            echoes, model = self.fit(one)
            rest = np.where(one.used, one.samples - model, 0)
            quiet = one.used & (model - model.min() < 2 * np.sqrt(self.covariance[0]))
            quiet = quiet if quiet.sum() > 2 * LAGS else one.used
            levels.append(rest[quiet])
            for lag in range(LAGS):
                pair = quiet[lag:] & quiet[: len(quiet) - lag]
                lags[lag] += np.sum((rest[lag:] * rest[: len(rest) - lag])[pair])
                number[lag] += pair.sum()
            if len(echoes) == 1 and echoes[0, 1] > 30 * np.sqrt(self.covariance[0]):
                near = one.used & (np.abs(np.arange(len(rest)) - echoes[0, 0]) < self.pulse.fwhm)
                strong.append((np.sum(rest[near] ** 2) - near.sum() * self.covariance[0]) / np.sum(model[near] ** 2))
        measured = lags / np.maximum(number, 1) * (1 - np.arange(LAGS) / LAGS)  # a taper keeps it positive
        # The scale is robust: where no sample is quiet, echoes that were not found yet are no noise.
        scale = (1.4826 * np.median(np.abs(np.concatenate(levels)))) ** 2
        self.covariance = np.clip(scale, 1 / 12, max(measured[0], 1 / 12)) * measured / max(measured[0], 1e-9)
        self.misfit = float(np.sqrt(np.clip(np.median(strong), 0.003**2, 0.05**2))) if len(strong) > 5 else 0.01

    def fit(self, one: Waveform) -> tuple[np.ndarray, np.ndarray]:
        """Echoes (m, 6): time, amplitude, variance of the target and their errors; and the model of all samples."""
        keep = np.flatnonzero(one.used)
        y, n = one.samples[keep].astype(float), len(keep)
        noise = toeplitz(np.r_[self.covariance, np.zeros(max(len(one.samples) - LAGS, 0))][: len(one.samples)])
        noise = noise[np.ix_(keep, keep)]
        values, model = np.array([self.level]), np.full(n, self.level)
        errors, chi2 = np.zeros(1), np.inf
        grid = np.arange(0, len(one.samples), 0.5)
        templates = self.pulse.at(keep[:, None] - grid, 0.0)[0]
        while True:
            rest = (self.misfit * (model - values[0])) ** 2
            lower = cholesky(noise + np.diag(rest), lower=True)
            values, errors, chi2, jacobian, left = self._refine(values, keep, y, lower)
            model = self._draw(values, keep)[0]
            if len(values) >= 3 * MOST:
                break
            white = solve_triangular(lower, templates, lower=True)
            base = np.linalg.qr(jacobian)[0]
            white -= base @ (base.T @ white)
            energy = np.maximum(np.sum(white**2, axis=0), 1e-12)
            seen = np.maximum(left @ white, 0) ** 2 / energy
            seen[energy < 1e-3 * energy.max()] = 0
            best = None
            for start in self._propose(values, grid, seen):
                tried = self._refine(start, keep, y, lower)
                if best is None or tried[2] < best[2]:
                    best = tried
            if best is None or chi2 - best[2] < PAYS or (best[0][2::3] < 0).any():
                break
            values, model = best[0], self._draw(best[0], keep)[0]
        echoes = np.column_stack([values[1:].reshape(-1, 3), errors[1:].reshape(-1, 3)])
        return echoes[np.argsort(echoes[:, 0])], self._draw(values, np.arange(len(one.samples)))[0]

    def _propose(self, values: np.ndarray, grid: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
        """Starts with one more echo: where the residual shows most, and in place of the widest echo."""
        starts, place = [], int(np.argmax(seen))
        if seen[place] > 4:
            starts.append(np.r_[values, grid[place], np.sqrt(seen[place]) + 1e-3, 0.0])
        if len(values) > 1 and values[3::3].max() > 0.3:
            row = 1 + 3 * int(np.argmax(values[3::3]))
            away = self.pulse.fwhm / 2.3548 * np.sqrt(values[row + 2])
            split = np.r_[values, values[row] + away, 0.5 * values[row + 1], 0.0]
            split[row : row + 3] = values[row] - away, 0.5 * values[row + 1], 0.0
            starts.append(split)
        return starts

    def _draw(self, values: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Model and its derivatives."""
        columns, model = [np.ones(len(x))], np.full(len(x), values[0])
        for time, amplitude, variance in values[1:].reshape(-1, 3):
            height, by_lag, by_variance = self.pulse.at(x - time, variance)
            model = model + amplitude * height
            columns += [-amplitude * by_lag, height, amplitude * by_variance]
        return model, np.stack(columns, axis=1)

    def _refine(self, values: np.ndarray, x: np.ndarray, y: np.ndarray, lower: np.ndarray) -> tuple:
        """Levenberg-Marquardt; returns values, errors, chi2, and whitened derivatives and residual."""

        def look(tried: np.ndarray) -> tuple:
            model, columns = self._draw(tried, x)
            white = solve_triangular(lower, np.column_stack([columns, y - model]), lower=True)
            prior = np.zeros((1, white.shape[1]))
            prior[0, 0], prior[0, -1] = 1 / self.spread, (self.level - tried[0]) / self.spread
            white = np.vstack([white, prior])
            wide = np.sum((np.maximum(tried[3::3], 0) / 2) ** 2)  # targets much wider than the pulse are rare
            return white[:, :-1], white[:, -1], float(white[:, -1] @ white[:, -1] + wide)

        jacobian, left, chi2 = look(values)
        damping = 1e-3
        for _ in range(25):
            normal = jacobian.T @ jacobian
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), jacobian.T @ left)
            tried = values + step
            tried[1::3] = np.clip(tried[1::3], values[1::3] - 2, values[1::3] + 2)
            tried[3::3] = np.clip(tried[3::3], -0.1, WIDEST - STEP)
            result = look(tried)
            if result[2] < chi2:
                done = chi2 - result[2] < 1e-3
                values, (jacobian, left, chi2), damping = tried, result, damping / 5
                if done:
                    break
            else:
                damping *= 8
                if damping > 1e6:
                    break
        size = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)))
        return values, size, chi2, jacobian[:-1], left[:-1]
