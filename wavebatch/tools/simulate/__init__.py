"""Simulation with known truth: scenes as blocks of waveforms, as strips, or as clouds of discrete returns.

Where to find what:

scenes, draws   which echoes a waveform holds: kinds of land, difficult cases; distributions, plants
geometry        flight, rays and terrain
render          shape of an echo; echoes to samples with noise
blocks          a scene as blocks in memory, with the true echoes
returns         true echoes to discrete returns, as vendors and discrete receivers record them; the light of a return
strip, truth    a scene as a LAS or LAZ file, and the .npz with its true echoes
from_returns    an existing cloud of returns as a strip with modelled waveforms

Called by `wavebatch simulate`, `wavebatch synthesize`, tools.bench, the examples and the tests.
"""

from wavebatch.tools.simulate.blocks import flag_truth, simulate_block, simulate_blocks
from wavebatch.tools.simulate.render import PULSES, PulseModel, Recording, find_pulse, shape_pulse
from wavebatch.tools.simulate.returns import DiscreteReceiver
from wavebatch.tools.simulate.scenes import CANOPIES, OTHER_NAMES, SCENES, Scene, find_scene
from wavebatch.tools.simulate.strip import ReturnSummary, StripOptions, StripSummary, simulate_returns, simulate_strip
from wavebatch.tools.simulate.truth import TruthReader

__all__ = [
    "CANOPIES", "OTHER_NAMES", "PULSES", "SCENES",
    "DiscreteReceiver", "PulseModel", "Recording", "ReturnSummary", "Scene", "StripOptions", "StripSummary",
    "TruthReader", "find_pulse", "find_scene", "flag_truth",
    "shape_pulse", "simulate_block", "simulate_blocks", "simulate_returns", "simulate_strip",
]  # fmt: skip
