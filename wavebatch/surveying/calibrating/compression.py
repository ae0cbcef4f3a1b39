"""Whether a receiver records strong light too low, by the shape of strong echoes beside that of weak ones.

`targets` asks for each strip: a constant from bright targets is too large for dark surfaces then. Slopes, roughness and
the pulse's misfit change the shape of echoes too, but not more where these are strong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from wavebatch.core.echoes import UNCLEAN
from wavebatch.core.order import group_medians
from wavebatch.core.units import MEDIAN_ERROR
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.clean import clean_block
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits
from wavebatch.surveying.matching.setting import SCANNERS
from wavebatch.surveying.measuring.lone_echoes import MIN_SNR
from wavebatch.surveying.measuring.residuals import decompose_sample, subtract_echoes

SAMPLE, BLOCK = 4096, 512
"""Waveforms that are looked at, and so many at a time: each takes 100 bytes per sample."""

CLASSES, LEAST_OF_CLASS = 8, 12
"""Classes of echoes by amplitude whose medians are compared, and fewest echoes of each."""

SURE = 4.0
"""Standard errors from which a receiver compresses."""


class Compression(NamedTuple):
    """What a channel loses of strong light."""

    factor: float
    """Share of its light that an echo loses per DN of its amplitude [1/DN]."""
    amplitude: np.ndarray
    """Of the strip's lone echoes, f8 (k,) [DN]."""

    def compare(self, amplitude: np.ndarray) -> float:
        """Return the root mean square of what the strip's echoes lose against those of targets, of amplitudes (n,)."""
        return self.factor * float(np.sqrt(np.mean((self.amplitude - np.mean(amplitude)) ** 2)))


def find_compression(reader: StripReader, scan: StripScan, system: SystemPulse) -> dict[int, Compression]:
    """Measure what the channels of a strip lose of strong light.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    system : SystemPulse
        Of the survey.

    Returns
    -------
    dict of int to Compression
        By the number of the channel; without those whose echoes do not show that they compress.

    Notes
    -----
    A receiver that records x - c x^2 leaves of an echo -c times what the fit's amplitude, time and width cannot explain
    of its square. Receivers that bend later, like the hyperbolic tangent, lose up to 2.4 times less than this says.
    docs/algorithms.md 5.
    """
    parts: dict[int, list[np.ndarray]] = {}
    for block in reader.sample_blocks(scan, SAMPLE, BLOCK):
        own = system.of(block)
        for channel, rows in _describe(clean_block(block, own), own):
            parts.setdefault(channel, []).append(rows)
    found = {channel: _judge(*np.concatenate(some, axis=1)) for channel, some in parts.items()}
    return {channel: one for channel, one in found.items() if one is not None}


def _describe(block: WaveformBlock, system: SystemPulse) -> Iterator[tuple[int, np.ndarray]]:
    """Channels, and of their lone echoes f8 (3, k): amplitude, share of the squared echo that is missing, and the light
    that goes with that."""
    echoes = decompose_sample(block, system)
    clear = echoes.alone(len(block)) & ((echoes.flags & np.uint16(UNCLEAN)) == 0)
    echoes = echoes.take(np.flatnonzero(clear & (echoes.amplitude > MIN_SNR * system.noise.std)))
    if not len(echoes):
        return
    part = block.rows(echoes.waveform)
    echoes = replace(echoes, waveform=np.arange(len(echoes), dtype=np.int32))
    shape, limits = pulse_shape(system, block.spacing), shape_limits(system, block.spacing)
    place = np.stack([echoes.amplitude, echoes.time / block.spacing, echoes.sigma / block.spacing], axis=1)
    height, time, width = model_parameters(shape, limits, place.astype(np.float64)).T[:, :, None]
    basis = np.stack(evaluate_pulse(shape, np.arange(block.samples.shape[1], dtype=np.float64), time, width), axis=1)
    left = subtract_echoes(part, system, echoes).astype(np.float64)
    basis *= np.isfinite(left)[:, None]
    left = np.nan_to_num(left) / height
    missing = (basis[:, 0] * height / place[:, :1]) ** 2
    inner = np.einsum("nis,njs->nij", basis, basis) + 1e-9 * np.eye(3)  # a pulse between two samples has no width
    taken = np.linalg.solve(inner, np.einsum("nis,ns->ni", basis, missing)[..., None])[..., 0]
    rest = missing - np.einsum("ni,nis->ns", taken, basis)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = -np.einsum("ns,ns->n", left, rest) / np.einsum("ns,ns->n", rest, rest)
    rows = np.stack([place[:, 0], share, taken[:, 0] + taken[:, 2]])
    scanner = np.zeros(len(part), np.int64) if part.scanner is None else part.scanner
    for number in np.unique(scanner).tolist():
        yield SCANNERS * block.digitizer.index + number, rows[:, (scanner == number) & np.isfinite(share)]


def _judge(amplitude: np.ndarray, share: np.ndarray, light: np.ndarray) -> Compression | None:
    """The compression by echoes as from `_describe`; None where they show none.

    What the pulse misses of all echoes alike is no compression: only what grows with the amplitude.
    """
    if len(amplitude) < CLASSES * LEAST_OF_CLASS:
        return None
    group = np.empty(len(amplitude), np.int64)
    group[np.argsort(amplitude, kind="stable")] = np.arange(len(amplitude)) * CLASSES // len(amplitude)
    level, (middle, spread) = group_medians(amplitude, group)[0], group_medians(share, group)
    weight = np.bincount(group) / (MEDIAN_ERROR * np.maximum(spread, 1e-9)) ** 2
    apart = level - np.average(level, weights=weight)
    squares = float(weight @ apart**2)
    slope = float((weight * apart) @ middle) / max(squares, 1e-30)
    rest = middle - np.average(middle, weights=weight) - slope * apart
    error = (max(float(weight @ rest**2) / (CLASSES - 2), 1.0) / max(squares, 1e-30)) ** 0.5
    return Compression(slope * float(np.median(light)), amplitude) if slope > SURE * error else None
