# ruff: noqa: F401
"""Simulation with known truth: scenes as blocks of waveforms, as strips, or as clouds of discrete returns.

Where to find what:

scenes    which echoes a waveform holds: kinds of land, difficult cases; a scene as blocks in memory with true echoes
render    flight, rays and terrain; shape of an echo; echoes to samples with noise
returns   true echoes to discrete returns, as vendors and discrete receivers record them; the light of a return; an
          existing cloud of returns as a strip with modelled waveforms
strip     a scene as a LAS or LAZ file, and the .npz with its true echoes

Called by `wavebatch simulate`, `wavebatch synthesize`, tools.bench, the examples and the tests.
"""

from wavebatch.tools.simulate.render import PULSES, PulseModel, Recording, find_pulse, shape_pulse
from wavebatch.tools.simulate.returns import DiscreteReceiver
from wavebatch.tools.simulate.scenes import (
    CANOPIES,
    OTHER_NAMES,
    SCENES,
    Scene,
    find_scene,
    flag_truth,
    simulate_block,
    simulate_blocks,
)
from wavebatch.tools.simulate.strip import (
    ReturnSummary,
    StripOptions,
    StripSummary,
    TruthReader,
    simulate_returns,
    simulate_strip,
)
