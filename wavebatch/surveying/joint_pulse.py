"""The system pulse from all echoes of a sample together, also of waveforms with several."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.units import FWHM_PER_SIGMA, SQRT_2PI
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.learn_pulse import Stack, fit_gaussians
from wavebatch.stages.pulse_tables import pulse_measures, pulse_shape, shape_limits
from wavebatch.surveying.judge import Explained
from wavebatch.surveying.measuring.trial import TRIAL

MOST = 5

def learn_jointly(block, system, e, change):
    stack, offset = stack_jointly(block, system, e, change)
    return to_system(system, stack, block.spacing)[0]


def stack_jointly(block: WaveformBlock, system: SystemPulse, e: Explained, kappa: float, prior: float = 0.08, most: int = MOST):
    n, s = e.left.shape
    edge = shape_limits(system, block.spacing).ref
    if system.components:
        edge = system.sigma_ref / block.spacing
    A, t, w = e.main.T
    # datum at the whole pulse: use its own main component's place; widths beyond the reference are the target's
    ref = shape_limits(system, block.spacing).ref
    b2 = np.maximum(w * w - ref * ref, 0.0)
    row = e.echoes.waveform
    sd = max(0.6 * edge, 0.6)
    core = np.arange(-5, 4, 0.5) * edge
    far, wide = [4.0], [1.0]
    while far[-1] < min(40.0, 0.7 * s / edge):
        wide.append(0.22 * far[-1]); far.append(far[-1] + wide[-1])
    d = np.r_[core, np.array(far) * edge]
    sk = np.r_[np.full(len(core), sd), np.maximum(np.array(wide) * edge, sd)]
    K = len(d)
    k = np.bincount(row, minlength=n)
    area = A * w * SQRT_2PI
    x = np.arange(s, dtype=np.float32)
    Phi = np.zeros((K + 1, n, s), np.float32)
    starts = np.flatnonzero(np.r_[True, np.diff(row) != 0]) if len(row) else np.zeros(0, int)
    for j in range(K):
        var = (sk[j] ** 2 + b2).astype(np.float32)
        z = x[None, :] - (t + d[j]).astype(np.float32)[:, None]
        g = (area / np.sqrt(2 * np.pi * var)).astype(np.float32)[:, None] * np.exp(-0.5 * z * z / var[:, None])
        Phi[j, row[starts]] = np.add.reduceat(g, starts, axis=0)
    Phi[K] = 1
    v = system.noise.quiet**2 + system.noise.gain * np.maximum(e.model, 0) + (max(kappa, 0.003) * e.model) ** 2
    infl = (system.noise.std / max(system.noise.quiet, 0.1)) ** 2
    wt = e.used * (k <= 8)[:, None] * 5 / (4 + e.left**2 / v) / v / infl
    y = e.left + e.model
    X = (Phi * np.sqrt(wt)).reshape(K + 1, -1).astype(np.float64)
    Y = (y * np.sqrt(wt)).ravel()
    N, B = X @ X.T, X @ Y
    away = np.where(np.abs(d) < 2.5 * edge, 1.0, np.maximum(np.exp(-(np.abs(d) - 2.5 * edge) / (3 * edge)), np.where(d > 0, 0.15, 0.02))) * sk / sk[0]
    tau = prior * away
    D2 = np.diff(np.eye(K), 2, axis=0) / (0.5 * tau[1:-1])[:, None]
    Rg = D2.T @ D2 + np.diag(1 / (3 * tau) ** 2 * (np.abs(d) > 2.5 * edge))
    Rg = np.pad(Rg, ((0, 1), (0, 1)))
    C = np.linalg.inv(N + Rg + 1e-9 * np.trace(N) / K * np.eye(K + 1))
    wk = C @ B
    offset = float(wk[-1]); C, wk = C[:-1, :-1], wk[:-1]
    lag = np.r_[np.arange(-6 * edge, 8 * edge, 0.2), np.arange(8 * edge, min(40 * edge, 0.8 * s), 1.0)]
    G = np.exp(-0.5 * ((lag[:, None] - d) / sk) ** 2) / (SQRT_2PI * sk)
    val = G @ wk
    err = np.sqrt(np.maximum(np.einsum("lk,kj,lj->l", G, C, G), 0))
    top = val.max()
    return Stack(lag, val / top, np.maximum(err / top, 2e-4)), offset


def to_system(system, stack, spacing, most=MOST):
    half = stack.lag[stack.value > 0.5]
    width = (half[-1] - half[0] + 0.2) / FWHM_PER_SIGMA
    most = min(most, TRIAL.get().most_components)
    fits = fit_gaussians(stack, width, most, 0.0)
    err = stack.error
    def miss(f):
        a, b, c = f.components.T
        p = (a * np.exp(-0.5 * ((stack.lag[:, None] - f.datum - b) / c) ** 2)).sum(1)
        return float(np.sqrt(np.mean((p / p.max() - stack.value) ** 2)))
    m = [miss(f) for f in fits]
    f = next(f for f, q in zip(fits, m) if q <= 1.1 * min(m))
    if len(f.components) == 1:
        return replace(system, components=(), kappa=0.0, ringing=0.0, sigma_ref=float(f.components[0, 2]) * spacing), min(m)
    comp = tuple((float(a), float(b) * spacing, float(c) * spacing) for a, b, c in f.components)
    far = np.abs(stack.lag - f.datum) > 4 * width
    ringing = float(np.abs(stack.value[far]).max(initial=0.0))
    y = replace(system, components=comp, kappa=0.0, ringing=ringing)
    lim = shape_limits(y, spacing)
    table = pulse_measures(pulse_shape(y, spacing), lim)
    return replace(y, sigma_ref=float(np.interp(lim.ref, table.width, table.half_width)) / FWHM_PER_SIGMA * spacing), m[len(f.components)-1] if len(f.components)<=len(m) else min(m)
