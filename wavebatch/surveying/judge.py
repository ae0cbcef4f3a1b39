"""What a strip's waveforms cost to write down with a pulse: the one number by which pulses and noises are compared.

`survey` calls `describe_waveforms` with each candidate. Before you change it: the number must fall only for what makes
the description of waveforms shorter that nothing was learned from (docs/algorithms.md R2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, ndtr

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import SQRT_2PI
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.stages.clean import clean_block
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.maximum import matched_filter
from wavebatch.stages.flags import use_noise_errors
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import clip_level, model_parameters, pulse_shape, shape_limits

STRICT = 0.96
FREEDOM = 4.0
ORDER = 2
WIDER = np.array([1.0, 1.02, 1.04, 1.08, 1.15, 1.3, 1.6, 2.2, 4.0])


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """Waveforms, and what echoes of one pulse explain of them."""

    echoes: EchoTable
    main: np.ndarray
    """Amplitude, time and width of the pulse's main component in samples, float64 (m, 3)."""
    model: np.ndarray
    """Sum of the echoes, float32 (n, s)."""
    left: np.ndarray
    """Samples less level and model; 0 where a sample does not count, float32 (n, s)."""
    used: np.ndarray
    """Samples that count: recorded, and not clipped, bool (n, s)."""


def explain(block: WaveformBlock, system: SystemPulse, **options: float) -> Explained:
    block = clean_block(block, system)
    noise = pooled_noise(block, system)
    echoes = adaptive(block, noise, system, matched_filter(block, noise, system), **options)
    echoes = use_noise_errors(echoes, system, block.spacing)
    spacing = block.spacing
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    whole = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1).astype(np.float64)
    main = model_parameters(shape, limits, whole)
    n, s = block.samples.shape
    model = render_echoes(shape, n, s, echoes.waveform, main[:, 1], main[:, 0], main[:, 2])
    used = block.samples < clip_level(block, system)
    if block.missing is not None:
        used &= ~block.missing
    left = np.where(used, block.samples - noise.level - model, np.float32(0))
    return Explained(echoes, main, model, left, used)


def prediction_filter(correlation, order=ORDER):
    order = min(order, len(correlation))
    if not order:
        return np.zeros(0), 1.0
    rho = np.r_[1.0, correlation[:order]]
    R = rho[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    a = np.linalg.solve(R + 1e-6 * np.eye(order), rho[1:])
    return a, max(float(1 - a @ rho[1:]), 0.02)


def count_widths(ratio, err):
    """Density of each ratio under each of the uniform laws from 1 to WIDER, seen through its error (m, k)."""
    z = lambda b: (ratio[:, None] - b) / err[:, None]
    high = WIDER[None, :]
    d = (ndtr(z(1.0)) - ndtr(z(high))) / np.maximum(high - 1.0, 1e-9)
    d[:, 0] = np.exp(-0.5 * z(1.0)[:, 0] ** 2) / (SQRT_2PI * err)
    return d


def fit_widths(ratio, err, rounds=30):
    d = count_widths(ratio, err)
    w = np.full(d.shape[1], 1.0 / d.shape[1])
    for _ in range(rounds):
        p = d * w
        p /= np.maximum(p.sum(axis=1, keepdims=True), 1e-300)
        w = (p.sum(axis=0) + 0.5) / (len(ratio) + 0.5 * len(w))
    return w


MODE_PASSES = 3


def shape_modes(block, system, e, rows, before=4.0, after=5.0):
    """The two directions in which the shape of echoes may change, each with the energy of its echo at misfit 1 (m, L)."""
    sp = block.spacing
    shape = pulse_shape(system, sp)
    amplitude, time, width = e.main[rows].T
    s = e.left.shape[1]
    reach = int(np.ceil((before + after) * max(shape_limits(system, sp).ref, 0.5))) + 1
    reach = min(reach, s)
    first = np.clip(np.floor(time - before * width), 0, s - reach).astype(np.int64)
    at = first[:, None] + np.arange(reach)
    x = at.astype(np.float32)
    p, bt, bw = evaluate_pulse(shape, x, time[:, None].astype(np.float32), width[:, None].astype(np.float32))
    z = np.clip((x - time[:, None]) / width[:, None], -5, 5)
    basis = [np.asarray(q, np.float64) for q in (p, bt, bw)]
    third = basis[2] * z
    fourth = third * z
    out = []
    used = e.used[e.echoes.waveform[rows][:, None], at]
    basis = [q * used for q in basis]
    energy = np.sqrt(np.einsum("ml,ml->m", basis[0], basis[0]))
    done = []
    for q in (*basis, third * used, fourth * used):
        for b in done:
            q = q - np.einsum("ml,ml->m", q, b)[:, None] * b
        q = q / np.maximum(np.sqrt(np.einsum("ml,ml->m", q, q)), 1e-9)[:, None]
        done.append(q)
    return at, done[3], done[4], energy * amplitude


JOINT = True


def joint_cost(block, system, e, innovate, v):
    """Half the negative logarithm of the determinant of the correlations of what is fitted in each waveform (n,)."""
    n, s = e.left.shape
    shape = pulse_shape(system, block.spacing)
    k = np.bincount(e.echoes.waveform, minlength=n)
    start = np.cumsum(np.r_[0, k])
    scale = (e.used / np.sqrt(v)).astype(np.float32)
    x = np.arange(s, dtype=np.float32)[None, :]
    out = np.zeros(n)
    for number in np.unique(k[(k > 0) & (k <= 12)]):
        rows = np.flatnonzero(k == number)
        J = np.empty((3 * number, len(rows), s), np.float32)
        for j in range(number):
            _, t, w = e.main[start[rows] + j].T.astype(np.float32)
            J[3 * j : 3 * j + 3] = evaluate_pulse(shape, x, t[:, None], w[:, None])
        J *= scale[rows]
        J = np.stack([innovate(j) for j in J])
        G = np.einsum("ams,bms->mab", J, J, optimize=True).astype(float)
        d = np.sqrt(np.maximum(np.einsum("maa->ma", G), 1e-12))
        G /= d[:, :, None] * d[:, None, :]
        G += 1e-6 * np.eye(3 * number)
        # correlations of the estimates: det Corr(C) = det(G^-1) / prod diag(G^-1)
        C = np.linalg.inv(G)
        out[rows] = 0.5 * (np.linalg.slogdet(G)[1] + np.log(np.maximum(np.einsum("maa->ma", C), 1.0)).sum(axis=1))
    return out


def describe_waveforms(block, system, e: Explained, kappa=0.0, detail=False):
    n, s = e.left.shape
    noise = system.noise
    v = noise.quiet**2 + noise.gain * np.maximum(e.model, 0)
    a, rest = prediction_filter(noise.correlation)

    def innovate(z):
        inn = z.copy()
        for l, al in enumerate(a, 1):
            inn[:, l:] -= np.float32(al) * z[:, :-l]
        return inn

    inn = innovate(e.left / np.sqrt(v)) / np.sqrt(rest)
    ec, sp = e.echoes, block.spacing
    A = ec.amplitude.astype(float)
    modes = np.zeros(n)
    if kappa > 0 and len(A):
        order = np.lexsort((-A, ec.waveform))
        rank = np.arange(len(A)) - np.searchsorted(ec.waveform[order], ec.waveform[order])
        for k in range(MODE_PASSES):
            rows = order[rank == k]
            if not len(rows):
                break
            at, b3, b4, size = shape_modes(block, system, e, rows)
            w = ec.waveform[rows]
            scale = 1 / np.sqrt(v[w[:, None], at])
            for b in (b3, b4):
                g = innovate((b * size[:, None] * scale).astype(np.float32)) / np.sqrt(rest)
                gg = np.einsum("ml,ml->m", g, g).astype(float)
                here = inn[w[:, None], at]
                c = np.einsum("ml,ml->m", g, here) / (gg + 1 / kappa**2)
                inn[w[:, None], at] = here - c[:, None] * g
                modes[w] += 0.5 * (c / kappa) ** 2 + 0.5 * np.log1p(kappa**2 * gg)
    nu = FREEDOM
    f = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(np.pi * nu * 0.75)
    fit = np.where(e.used, (nu + 1) / 2 * np.log1p(inn**2 / (nu * 0.75)) - f + 0.5 * np.log(v * rest), 0).sum(1) + modes
    shared = joint_cost(block, system, e, innovate, v) if JOINT else 0.0
    typical = max(float(np.mean(A)), 1.0) if len(A) else 1.0
    ea, et = np.clip(ec.amplitude_err, 1e-3, None), np.clip(ec.time_err / sp, 1e-3, s)
    cost = np.clip(np.log(s / (SQRT_2PI * et)), 0, None) + np.clip(np.log(typical / (SQRT_2PI * ea)), 0, None) + np.log1p((A / typical) ** 2)
    ref = shape_limits(system, sp).ref
    ratio = e.main[:, 2] / ref
    err = np.clip(np.nan_to_num(ec.sigma_err / np.maximum(ec.sigma, 1e-6), nan=2.0), 1e-3, 2.0) * ratio
    err = np.hypot(err, max(0.01, kappa))
    bad = np.uint16(EchoFlag.SATURATED | EchoFlag.NEAR_EDGE | EchoFlag.NOT_CONVERGED | EchoFlag.MERGED)
    known = ((ec.flags & bad) == 0) & (err < 0.15 * ratio)
    wcost = np.zeros(len(A))
    if known.sum() >= 10:
        w = fit_widths(ratio[known], err[known])
        density = 0.99 * count_widths(ratio, err) @ w + 0.01 / 4
        wcost = -np.log(density) - np.log(SQRT_2PI * err)
    k = np.bincount(ec.waveform, minlength=n)
    q = max(k.mean(), 0.01)
    count = np.log(1 + q) - k * np.log(q / (1 + q)) - gammaln(k + 1)
    per = fit + count + np.bincount(ec.waveform, cost + wcost, minlength=n) + shared
    if detail:
        return per, fit.mean(), (cost.sum()/n + np.mean(shared)), wcost.sum()/n, count.mean()
    return per
