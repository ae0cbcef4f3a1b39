"""The waveform that a decomposer's echoes stand for: the sum of the pulses that it fitted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.stages.chain import Step
from wavebatch.stages.decompose.models import reference_shape, skewed_shape
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits

ShapeOf = Callable[..., PulseShape]


def _gaussian(system: SystemPulse, spacing: float, **parameters: object) -> PulseShape:
    return GAUSSIAN


def _system(system: SystemPulse, spacing: float, **parameters: object) -> PulseShape:
    return pulse_shape(system, spacing)


def _skewed(system: SystemPulse, spacing: float, *, kappa: float, **parameters: object) -> PulseShape:
    return skewed_shape(system, kappa)


def _reference(system: SystemPulse, spacing: float, *, model: str, pulse: str, **parameters: object) -> PulseShape:
    return reference_shape(system, spacing, model, pulse)


MODELS: dict[str, ShapeOf | None] = {
    "decompose.adaptive": _system,
    "decompose.asdf_only": _gaussian,
    "decompose.closed_form": _gaussian,
    "decompose.gauss_newton": _gaussian,
    "decompose.gaussian": _gaussian,
    "decompose.generalized_gaussian": None,
    "decompose.none": None,
    "decompose.reference": _reference,
    "decompose.residual_loop": _gaussian,
    "decompose.skewed": _skewed,
}
"""The pulse that each decomposer fits; None where its echoes do not tell: nothing is fitted, or each cluster has an
exponent of its own."""


def rebuild_waveforms(
    block: WaveformBlock, system: SystemPulse, decomposer: Step, echoes: EchoTable
) -> np.ndarray | None:
    """Signal above the baseline (n, s), float32, as the decomposer's model has it; None where there is no model.

    echoes: of the block, as `decomposer` described them.
    """
    shape_of = MODELS[decomposer.stage.name]
    if shape_of is None:
        return None
    spacing = block.spacing
    shape = shape_of(system, spacing, **decomposer.effective())
    described = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1)
    amplitude, time, width = model_parameters(shape, shape_limits(system, spacing), described.astype(np.float64)).T
    return render_echoes(shape, *block.samples.shape, echoes.waveform, time, amplitude, width)
