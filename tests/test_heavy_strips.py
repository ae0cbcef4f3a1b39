"""Small strips that ask for much work stay under 2 GB and 20 s of a processor, whatever their waveforms."""

import random
import sys
from pathlib import Path

import pytest
from heavy_strips import COMMANDS, MEMORY, TOOLS, Plan, attack, draw_plan

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="sets limits of memory and processor time")

LONG = Plan(1, "spikes", 16, 65_535, 1, 1, 4, True, 1, 1000)
HOSTILE = {
    "spikes": LONG,
    "saturated": LONG._replace(shape="saturated", packets=7),
    "dense": LONG._replace(shape="comb", bits=8, samples=10_000, packets=95),
    "stairs": LONG._replace(shape="stairs", packets=7),
    "32 bits": LONG._replace(shape="pulses", bits=32, samples=256, packets=800, point_format=9),
}


def _all_hold(folder: Path, plan: Plan, commands: list[str]) -> None:
    for done in attack(folder, plan, commands):
        assert not done.wrong and done.memory < MEMORY, (plan, done)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(HOSTILE))
def test_long_and_dense_waveforms_stay_within_memory_and_time(tmp_path, name):
    done = attack(tmp_path, HOSTILE[name], COMMANDS[:1])
    assert [(one.wrong, one.code) for one in done] == [("", 0)], done


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_random_heavy_strips_stay_within_memory_and_time(tmp_path, seed):
    rng = random.Random(seed)
    _all_hold(tmp_path, draw_plan(rng), [*COMMANDS, rng.choice(TOOLS)])
