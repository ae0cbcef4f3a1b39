"""What detectors share: the signal they look at and the table they make."""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.signal import transpose_samples


def signal_above(block: WaveformBlock, noise: Noise) -> np.ndarray:
    """Signal above the baseline, float32 (s, n)."""
    signal = transpose_samples(block.samples)
    signal -= noise.baseline
    return signal


def make_table(
    block: WaveformBlock, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, width: np.ndarray
) -> EchoTable:
    """Candidates in samples as a table in ns; a constant waveform has none, whatever filters make of its ends (H10)."""
    rows, row = np.unique(waveform, return_inverse=True)
    varies = find_varying(block.samples[rows])[row]
    columns = (waveform, time * block.spacing, amplitude, width * block.spacing)
    return EchoTable.build(*(columns if varies.all() else (values[varies] for values in columns)))


def find_varying(samples: np.ndarray) -> np.ndarray:
    """True (n,) for the waveforms of samples (n, s) that are not constant."""
    return (samples != samples[:, :1]).any(axis=1)


def candidate_table(
    block: WaveformBlock,
    system: SystemPulse,
    waveform: np.ndarray,
    time: np.ndarray,
    amplitude: np.ndarray,
    width: np.ndarray,
) -> EchoTable:
    """Candidates in samples as a table in ns.

    Widths are brought within 0.7 and 4 system widths, times within the waveform, amplitudes to at least 0.
    """
    ref = system.sigma_ref / block.spacing
    last = block.samples.shape[1] - 1
    return make_table(
        block, waveform, np.clip(time, 0.0, last), np.maximum(amplitude, 0.0), np.clip(width, 0.7 * ref, 4.0 * ref)
    )
