"""attribute.position: the error of an echo's place covers returns of its packet that contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Noise, ReturnTable, SystemPulse, WaveformBlock
from wavebatch.stages.attribute.basic import position

ERROR = 0.02
"""Of the fitted times [ns]."""


def place(times, locations, **errors):
    """x and range_err of echoes at `times` in one packet whose returns lie at `locations` [m along the ray]."""
    block = WaveformBlock.from_samples(np.zeros((1, 80), np.uint8))
    k = len(locations)
    returns = ReturnTable(np.zeros(k, np.int32), np.array(locations, float), np.arange(k), np.zeros((k, 3)))
    block = replace(block, returns=returns, direction=np.array([[HALF_C, 0.0, 0.0]]))
    n = len(times)
    echoes = EchoTable.build(np.zeros(n), np.array(times), np.full(n, 50.0), np.full(n, 2.0),
                             time_err=np.full(n, ERROR))  # fmt: skip
    system = SystemPulse(2.0).with_radiometry(**errors)
    done = position(block, Noise(np.zeros(1, "f4"), np.ones(1, "f4")), system, echoes)
    return (done.attributes["x"] - block.origin[0, 0]) / HALF_C, done.attributes["range_err"] / HALF_C


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_returns_that_contradict_each_other_widen_the_error(shift):
    # The vendor gave one return for what the fit sees as a later centre: one of the two places must be wrong.
    at, error = place([20.0, 40.0], [20.0, 40.0 - shift])
    assert at == pytest.approx([20.0 - shift / 2, 40.0 - shift / 2], abs=1e-3)
    assert error == pytest.approx(np.hypot(ERROR, shift / 2), rel=1e-3)


def test_an_added_echo_has_the_error_of_its_packet():
    at, error = place([20.0, 40.0, 60.0], [20.0, 39.0])
    assert at[2] == pytest.approx(59.5, abs=1e-3) and error[2] == pytest.approx(np.hypot(ERROR, 0.5), rel=1e-3)


@pytest.mark.parametrize("locations", [[19.6], [19.6, 39.61], [19.6, 39.6, 59.59]])
def test_returns_that_agree_within_their_errors_leave_the_error_of_the_fit(locations):
    _, error = place([20.0, 40.0, 60.0][: len(locations)], locations)
    assert error == pytest.approx(ERROR, rel=1e-3)


def test_returns_have_their_scatter_and_echoes_without_one_the_phase():
    errors = {"returns": 0.03 * HALF_C, "phase": 0.29 * HALF_C}
    for locations, other in (([19.6], 0.03), ([19.6, 39.6], 0.03), ([19.6, 38.6], 0.5), ([99.0], 0.29)):
        _, error = place([20.0, 40.0], locations, **errors)
        assert error == pytest.approx(np.hypot(ERROR, other), rel=1e-3)
