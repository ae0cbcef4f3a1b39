"""Simulation with known truth: scenes as blocks of waveforms, as strips, or as clouds of discrete returns.

Where to find what:

scenes, canopy, hazards, draws   which echoes a waveform holds: kinds of land, plants, difficult cases, distributions
geometry                         flight, rays and terrain
pulses, render                   shape of an echo; echoes to samples with noise
blocks                           a scene as blocks in memory, with the true echoes
returns                          true echoes to discrete returns, as vendors and discrete receivers record them
strip, truth                     a scene as a LAS or LAZ file, and the .npz with its true echoes
from_returns, return_light       an existing cloud of returns as a strip with modelled waveforms

Called by `wavebatch simulate`, `wavebatch synthesize`, tools.bench, the examples and the tests.
"""

from wavebatch.tools.simulate.blocks import flag_truth, simulate_block, simulate_blocks
from wavebatch.tools.simulate.canopy import CANOPIES
from wavebatch.tools.simulate.pulses import PULSES, PulseModel, find_pulse, shape_pulse
from wavebatch.tools.simulate.render import Recording
from wavebatch.tools.simulate.returns import DiscreteReceiver
from wavebatch.tools.simulate.scenes import OTHER_NAMES, SCENES, Scene, find_scene
from wavebatch.tools.simulate.strip import ReturnSummary, StripOptions, StripSummary, simulate_returns, simulate_strip
from wavebatch.tools.simulate.truth import TruthReader

__all__ = [
    "CANOPIES", "OTHER_NAMES", "PULSES", "SCENES",
    "DiscreteReceiver", "PulseModel", "Recording", "ReturnSummary", "Scene", "StripOptions", "StripSummary",
    "TruthReader", "find_pulse", "find_scene", "flag_truth",
    "shape_pulse", "simulate_block", "simulate_blocks", "simulate_returns", "simulate_strip",
]  # fmt: skip
