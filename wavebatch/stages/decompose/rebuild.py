"""The waveform that a decomposer's echoes stand for: the sum of its fitted pulses. For `plot` and goodness of fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.stages.chain import Step
from wavebatch.stages.decompose.models import reference_shape, skewed_shape
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits

MODELS: dict[str, Callable[[SystemPulse, float, Mapping[str, Any]], PulseShape] | None] = {
    "decompose.adaptive": lambda system, spacing, _: pulse_shape(system, spacing),
    "decompose.reference": lambda system, spacing, given: reference_shape(
        system, spacing, given["model"], given["pulse"]
    ),
    "decompose.skewed": lambda system, _, given: skewed_shape(system, given["kappa"]),
    **dict.fromkeys(
        [f"decompose.{name}" for name in ("asdf_only", "closed_form", "gauss_newton", "gaussian", "residual_loop")],
        lambda *_: GAUSSIAN,
    ),
    "decompose.generalized_gaussian": None,
    "decompose.none": None,
}
"""The pulse that a decomposer fits, from system, spacing and parameters; None where nothing is fitted, or each cluster
has an exponent of its own."""


def fitted_pulse(decomposer: Step, system: SystemPulse, spacing: float) -> PulseShape | None:
    """Return the pulse that a decomposer fits.

    Parameters
    ----------
    decomposer : Step
        The decompose step of a chain.
    system : SystemPulse
        As the chain used it.
    spacing : float
        Time between two samples [ns].

    Returns
    -------
    PulseShape or None
        Pulse in samples; None where there is not one for all echoes, or a plugin does not say.
    """
    shape_of = MODELS.get(decomposer.stage.name)
    return None if shape_of is None else shape_of(system, spacing, decomposer.effective())


def rebuild_waveforms(
    block: WaveformBlock, system: SystemPulse, decomposer: Step, echoes: EchoTable
) -> np.ndarray | None:
    """Add up the pulses of the echoes of a block.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms of s samples.
    system : SystemPulse
        As the chain used it.
    decomposer : Step
        The decompose step of the chain.
    echoes : EchoTable
        What the decomposer found in the block.

    Returns
    -------
    float32 array, shape (n, s), or None
        Signal above the baseline [count]; None for decomposers without one pulse model.
    """
    spacing = block.spacing
    shape = fitted_pulse(decomposer, system, spacing)
    if shape is None:
        return None
    described = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1)
    amplitude, time, width = model_parameters(shape, shape_limits(system, spacing), described.astype(np.float64)).T
    n, s = block.samples.shape
    return render_echoes(shape, n, s, echoes.waveform, time, amplitude, width)
