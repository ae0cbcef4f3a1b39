"""Seeded scenes with known echoes: as blocks for tests and benchmarks, or as strips with wave packets."""

from wavebatch.simulate.blocks import flag_truth, simulate_block, simulate_blocks
from wavebatch.simulate.canopy import CANOPIES
from wavebatch.simulate.discrete import DiscreteReceiver
from wavebatch.simulate.given import FINE, fine_recording, known_noise, known_system, simulate_echoes
from wavebatch.simulate.pulses import PULSES, PulseModel, find_pulse
from wavebatch.simulate.render import Recording
from wavebatch.simulate.returnstrip import ReturnSummary, simulate_returns
from wavebatch.simulate.scenes import SCENES, Scene, find_scene, shape_pulse
from wavebatch.simulate.strip import StripOptions, StripSummary, simulate_strip
from wavebatch.simulate.truth import TruthReader

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
