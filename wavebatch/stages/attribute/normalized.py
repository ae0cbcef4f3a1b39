"""Amplitudes as they would be at one range: what compares within a flight without any calibration."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.stages.attribute.light import POSITION, add_column, normalize_amplitude
from wavebatch.stages.chain import Range, stage

DECIBEL = 10.0 / math.log(10.0)
"""Decibel per unit of the natural logarithm."""


@stage("attribute", makes=("amplitude_normalized", "amplitude_normalized_err"), needs=POSITION)
def amplitude_normalized(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    reference_range: Annotated[float, Range(1.0, 1e5)] = 1000.0,
) -> EchoTable:  # fmt: skip
    """Amplitude that each echo would have at the reference range [DN], and its error: no calibration is needed.

    amplitude (R / R0)^2 eta(R0) / eta(R), divided by the energy of its pulse where that is given. Only echoes of
    surfaces that fill the beam fall with R^2; those of wires and leaves fall faster.

    Parameters
    ----------
    reference_range : float
        R0 [m]. Use the same one for all strips that shall compare.

    References
    ----------
    docs/algorithms.md 5.
    """
    value, relative, cases = normalize_amplitude(block, system, echoes, reference_range)
    return add_column(echoes, "amplitude_normalized", value, relative, *cases)


@stage("attribute", makes=("amplitude_normalized_db", "amplitude_normalized_db_err"), needs=POSITION)
def amplitude_normalized_db(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    reference_range: Annotated[float, Range(1.0, 1e5)] = 1000.0,
) -> EchoTable:  # fmt: skip
    """Amplitude that each echo would have at the reference range, in decibel over 1 DN, and its error.

    10 log10 of what attribute.amplitude_normalized gives.

    Parameters
    ----------
    reference_range : float
        R0 [m]. Use the same one for all strips that shall compare.

    References
    ----------
    docs/algorithms.md 5.
    """
    value, relative, cases = normalize_amplitude(block, system, echoes, reference_range)
    with np.errstate(invalid="ignore", divide="ignore"):
        decibel = DECIBEL * log(value)
        share = DECIBEL * relative / np.maximum(np.abs(decibel), 1e-30)
    return add_column(echoes, "amplitude_normalized_db", decibel, share, *cases)
