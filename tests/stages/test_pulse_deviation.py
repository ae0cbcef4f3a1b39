"""The column pulse_deviation against a plain loop over echoes: alone, in company, cut by an edge; any pulse model."""

import numpy as np
import pytest
from helpers_scenes import make_block

from wavebatch.core.waveforms import Noise, SystemPulse
from wavebatch.stages import pulse_tables
from wavebatch.stages.chain import STAGES

SYSTEMS = {
    "gaussian": SystemPulse(2.0),
    "learned": SystemPulse(2.0, components=((1.0, 0.0, 2.0), (0.1, 5.0, 2.2))),
}


def deviate_slowly(block, noise, system, echoes):
    """Every echo on its own, in double precision: residual of the whole waveform, two projections."""
    s = block.samples.shape[1]
    x = np.arange(s, dtype=float)
    shape, limits = pulse_tables.pulse_shape(system, 1.0), pulse_tables.shape_limits(system, 1.0)
    whole = np.stack([echoes.amplitude, echoes.time, echoes.sigma], axis=1).astype(float)
    lobes = [(1.0, 0.0, 0.0), *shape.components]
    values = []
    for row in range(len(echoes)):
        waveform = echoes.waveform[row]
        residual = block.samples[waveform] - float(noise.baseline[waveform])
        for amplitude, time, width in pulse_tables.model_parameters(shape, limits, whole)[echoes.waveform == waveform]:
            for weight, delay, extra in lobes:
                wide = np.sqrt(width**2 + extra)
                height = amplitude * weight * width / wide
                residual = residual - height * np.exp(-0.5 * ((x - time - delay) / wide) ** 2)
        amplitude, time, sigma = whole[row]
        reach = min(int(np.ceil(5 * sigma)), s)
        near = np.abs(x - np.rint(time)) <= reach
        z = (x[near] - time) / sigma
        total = 0.0
        for direction in (8 * z**3 - 12 * z, 16 * z**4 - 48 * z**2 + 12):
            direction = direction * np.exp(-0.5 * z * z)
            total += (direction @ residual[near]) ** 2 / (direction @ direction)
        std = float(noise.std[waveform])
        values.append(np.sqrt(total) / std / (amplitude / std * np.sqrt(sigma)))
    return np.array(values)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("scene", ["urban", "forest", "stiff.edge"])
def test_deviation_is_that_of_a_plain_loop(scene, name):
    system = SYSTEMS[name]
    block, truth = make_block(scene, 120, seed=3)
    noise = Noise(np.full(len(block), 12.2, np.float32), np.full(len(block), 1.1, np.float32))
    found = STAGES["attribute.pulse_deviation"].function(block, noise, system, truth).attributes["pulse_deviation"]
    assert found == pytest.approx(deviate_slowly(block, noise, system, truth), rel=1e-3, abs=1e-5)
