"""Small strips that ask for much work stay under 2 GB and 20 s of a processor, whatever their waveforms."""

import random
import sys
from pathlib import Path

import numpy as np
import pytest
from heavy_strips import COMMANDS, MEMORY, MOST_BYTES, SHAPES, TOOLS, Plan, attack, build_strip, draw_plan, run_limited

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


def test_a_plan_gives_the_same_small_strip_each_time(tmp_path):
    rng, kinds = random.Random(3), set()
    for number in range(30):
        plan = draw_plan(rng)
        kinds |= {plan.shape, plan.bits, plan.point_format}
        first, second = (build_strip(plan, tmp_path / f"{number}{name}.las") for name in "ab")
        assert first.read_bytes() == second.read_bytes()
        assert first.stat().st_size <= MOST_BYTES
    assert {8, 16, 32} < kinds and len(kinds & set(SHAPES)) > 6


def test_what_takes_too_much_is_noticed(tmp_path):
    strip = build_strip(LONG._replace(samples=60), tmp_path / "a.las")
    assert "exit code" in run_limited("info {strip}", strip, tmp_path / "out", seconds=0).wrong
    assert run_limited("info {strip}", strip, tmp_path / "out", memory=100 << 20).wrong


@pytest.mark.parametrize("shape", list(SHAPES))
def test_shapes_are_counts_of_their_bits(shape):
    counts = np.broadcast_to(SHAPES[shape](np.random.default_rng(1), 3, 200, 255), (3, 200))
    assert np.isfinite(counts).all() and counts.min() >= 0 and counts.max() < 256
