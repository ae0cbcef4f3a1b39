"""What all detectors share: the signal that they search and the table of candidates that they return."""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.frozen import frozen
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal.runs import gap_distance
from wavebatch.kernels.signal.signal import transpose_samples


@frozen(eq=False)
class Searched:
    """The signal in which a detector searches n waveforms for echoes; `wavebatch plot waveform --show` draws it."""

    label: str
    """What it is, with its unit."""
    rule: str
    """When a maximum or a minimum of it is an echo."""
    values: np.ndarray
    """(q, n) as kernels give it."""
    least: np.ndarray
    """Threshold: a level, or the depth that a minimum needs, (n,); NaN without one."""
    signal: np.ndarray
    """What it was made of: waveforms above their baselines [DN], f4 (s, n)."""
    unit: float = 1.0
    """What one DN is in it: pictures divide by it."""
    first: float = 0.0
    """Place of the first value [samples]."""
    deep: bool = False
    """Whether `least` is the depth of minima instead of a level."""
    second: np.ndarray | None = None
    """A further line with the same unit and times, to which `least` belongs, as `values`."""
    second_label: str = ""


def signal_above(block: WaveformBlock, noise: Noise) -> np.ndarray:
    """Subtract the baseline of each waveform.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms of s samples.
    noise : Noise
        Their baselines.

    Returns
    -------
    float32 array, shape (s, n)
        Signal above the baseline [count]; waveforms lie along the last axis, as kernels need it.
    """
    signal = transpose_samples(block.samples)
    signal -= noise.level.T
    if block.missing is not None:
        missing = block.missing.T
        signal[missing] = 0
        # An echo across a single sample is one.
        single = missing[1:-1] & ~missing[:-2] & ~missing[2:]
        signal[1:-1] = np.where(single, 0.5 * (signal[:-2] + signal[2:]), signal[1:-1])
    return signal


def samples_of(block: WaveformBlock, noise: Noise) -> Samples:
    """Put the waveforms of a block and their noise together, as kernels take them.

    Parameters
    ----------
    block, noise
        As for a stage.

    Returns
    -------
    Samples
        Raw counts with their levels.
    """
    return Samples(block.samples, noise.for_fits, noise.std, block.missing)


def make_table(
    block: WaveformBlock, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, width: np.ndarray
) -> EchoTable:
    """Turn candidates in samples into a table in ns.

    Constant waveforms and gaps between two recordings get none, whatever a filter shows at their ends.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    waveform : int array, shape (m,)
        Row of the block.
    time, width : float array, shape (m,)
        Centre and standard deviation [samples].
    amplitude : float array, shape (m,)
        Height above the baseline [count].

    Returns
    -------
    EchoTable
        Candidates, sorted.

    References
    ----------
    docs/algorithms.md H10.
    """
    rows, row = np.unique(waveform, return_inverse=True)
    varies = find_varying(block.samples[rows])[row]
    if block.missing is not None:
        varies &= gap_distance(block.missing, waveform, time) > -1.0
    columns = (waveform, time * block.spacing, amplitude, width * block.spacing)
    return EchoTable.build(*(columns if varies.all() else (values[varies] for values in columns)))


def find_varying(samples: np.ndarray) -> np.ndarray:
    """Find the waveforms that are not constant.

    Parameters
    ----------
    samples : uint array, shape (n, s)
        Raw counts.

    Returns
    -------
    bool array, shape (n,)
        True where samples differ.
    """
    return (samples != samples[:, :1]).any(axis=1)


def candidate_table(
    block: WaveformBlock,
    system: SystemPulse,
    waveform: np.ndarray,
    time: np.ndarray,
    amplitude: np.ndarray,
    width: np.ndarray | None = None,
) -> EchoTable:
    """Turn candidates in samples into a table in ns, with all values brought into their legal ranges.

    Widths are clipped to 0.7 to 4 system widths, times to the waveform, amplitudes to 0 and above.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    system : SystemPulse
        With the width of the system pulse.
    waveform : int array, shape (m,)
        Row of the block.
    time : float array, shape (m,)
        Centre [samples].
    amplitude : float array, shape (m,)
        Height above the baseline [count].
    width : float array, shape (m,), optional
        Standard deviation [samples]; the system's by default.

    Returns
    -------
    EchoTable
        Candidates, sorted.
    """
    ref = system.sigma_ref / block.spacing
    last = block.samples.shape[1] - 1
    width = np.full(len(time), ref) if width is None else width
    return make_table(
        block, waveform, np.clip(time, 0.0, last), np.maximum(amplitude, 0.0), np.clip(width, 0.7 * ref, 4.0 * ref)
    )
