"""Seeded scenes with known echoes: as blocks for tests and benchmarks, or as strips with wave packets."""

from wavebatch.tools.simulate.blocks import flag_truth, simulate_block, simulate_blocks
from wavebatch.tools.simulate.canopy import CANOPIES
from wavebatch.tools.simulate.discrete import DiscreteReceiver, ReturnSummary, simulate_returns
from wavebatch.tools.simulate.given import FINE, fine_recording, known_noise, known_system, simulate_echoes
from wavebatch.tools.simulate.pulses import PULSES, PulseModel, find_pulse
from wavebatch.tools.simulate.render import Recording
from wavebatch.tools.simulate.scenes import SCENES, Scene, find_scene, shape_pulse
from wavebatch.tools.simulate.strip import StripOptions, StripSummary, simulate_strip
from wavebatch.tools.simulate.truth import TruthReader

__all__ = [
    "CANOPIES",
    "FINE",
    "PULSES",
    "SCENES",
    "DiscreteReceiver",
    "PulseModel",
    "Recording",
    "ReturnSummary",
    "Scene",
    "StripOptions",
    "StripSummary",
    "TruthReader",
    "find_pulse",
    "find_scene",
    "fine_recording",
    "flag_truth",
    "known_noise",
    "known_system",
    "shape_pulse",
    "simulate_block",
    "simulate_blocks",
    "simulate_echoes",
    "simulate_returns",
    "simulate_strip",
]
