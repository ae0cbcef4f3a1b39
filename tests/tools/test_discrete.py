"""The discrete receiver against a plain loop, and the published tables of return numbers (docs/algorithms.md 1.5)."""

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from published import RETURN_TABLES

from wavebatch.cli.strips import simulate
from wavebatch.core.errors import ConfigError
from wavebatch.tools.return_stats import count_returns
from wavebatch.tools.simulate import DiscreteReceiver, StripOptions, find_scene, simulate_block, simulate_returns
from wavebatch.tools.simulate.scenes import CANOPIES


def fire_slowly(receiver, pulse, distance, amplitude):
    found = []
    for p in np.unique(pulse):
        rows = np.flatnonzero(pulse == p)
        limit, number = -np.inf, 0
        for row in rows:
            if distance[row] < limit or number == receiver.most:
                continue
            inside = rows[(rows >= row) & (distance[rows] < distance[row] + receiver.dead_zone)]
            if amplitude[inside].sum() > receiver.threshold:
                number += 1
                limit = distance[row] + receiver.dead_zone
                found.append((row, number, amplitude[inside].sum()))
    return found


@pytest.mark.parametrize("most", [1, 4])
def test_receiver_fires_as_a_plain_loop_does(rng, most):
    pulse = np.sort(rng.integers(0, 200, 900))
    distance = rng.uniform(0, 5, 900)
    order = np.lexsort((distance, pulse))
    distance, amplitude = distance[order], rng.integers(0, 9, 900).astype(float)
    receiver = DiscreteReceiver(0.6, 8.0, most)
    row, number, energy = receiver.fire(pulse, distance, amplitude)
    assert list(zip(row.tolist(), number.tolist(), energy.tolist(), strict=True)) == [
        (int(r), n, pytest.approx(e)) for r, n, e in fire_slowly(receiver, pulse, distance, amplitude)
    ]


def test_receiver_without_echoes_has_no_returns():
    empty = np.empty(0)
    assert [len(part) for part in DiscreteReceiver().fire(empty.astype(int), empty, empty)] == [0, 0, 0]


@pytest.mark.parametrize("stand", list(RETURN_TABLES))
def test_published_return_numbers_are_reproduced(stand, tmp_path):
    dead_zone, exact = RETURN_TABLES[stand]
    simulate_returns(f"canopy.{stand}", tmp_path / "c.las", pulses=8192, seed=77, receiver=DiscreteReceiver(dead_zone))
    stats = count_returns([tmp_path / "c.las"])[1]
    number = np.cumsum(exact[::-1])[::-1] / np.sum(np.cumsum(exact[::-1]))
    ours = [stats.by_number.get(k, 0.0) for k in (1, 2, 3, 4)]
    assert 100 * np.abs(np.subtract(ours, number)).sum() < 6
    assert stats.returns_per_pulse == pytest.approx(np.dot((1, 2, 3, 4), exact) / 100, abs=0.08)
    assert stats.separations["all"].least == pytest.approx(dead_zone, abs=0.03)


@pytest.mark.parametrize(("dead_zone", "means"), [(0.64, (1.13, 0.90)), (0.67, (1.15, 0.92))])
def test_least_separation_in_corn_is_the_dead_zone(dead_zone, means, tmp_path):
    simulate_returns("canopy.corn", tmp_path / "c.las", pulses=16384, seed=5, receiver=DiscreteReceiver(dead_zone))
    stats = count_returns([tmp_path / "c.las"])[1]
    for pair, mean in zip(("1-2", "2-3"), means, strict=True):
        assert stats.separations[pair].least == pytest.approx(dead_zone, abs=0.004)
        assert stats.separations[pair].mean == pytest.approx(mean, abs=0.06)
    assert stats.by_count.get(4, 0) < 0.002
    assert any("dead zone" in line for line in stats.warnings)


def test_a_long_dead_zone_leaves_no_third_return(tmp_path):
    simulate_returns("canopy.corn", tmp_path / "c.las", pulses=4000, receiver=DiscreteReceiver(1.5))
    assert max(count_returns([tmp_path / "c.las"])[1].by_number) == 2


def test_stands_have_waveforms_whose_echoes_lie_in_their_windows(rng):
    for name, (_, canopy) in CANOPIES.items():
        scene = find_scene(f"canopy.{name}")
        block, truth = simulate_block(scene, 300, rng)
        last = truth.time[np.flatnonzero(np.diff(np.append(truth.waveform, 300)))]
        assert len(last) == len(block) == 300
        assert truth.time.min() > 4 and truth.time.max() < scene.recording.duration - 4
        energy = np.bincount(truth.waveform, truth.amplitude, 300)
        assert energy == pytest.approx(np.full(300, canopy.full), rel=1e-4)


@pytest.mark.parametrize(("waveform", "discrete"), [(4, 1), (5, 3), (9, 6), (10, 8)])
def test_cloud_is_complete_and_well_formed(waveform, discrete, tmp_path):
    summary = simulate_returns(
        "forest", tmp_path / "c.laz", pulses=500, seed=2, options=StripOptions(point_format=waveform, scale=0.01)
    )
    cloud = laspy.read(tmp_path / "c.laz")
    assert cloud.header.point_format.id == discrete
    assert len(cloud) == summary.points and summary.pulses == 500
    assert len(np.unique(cloud.gps_time)) == 500 - summary.empty
    number, total = np.asarray(cloud.return_number), np.asarray(cloud.number_of_returns)
    assert number.max() <= 4 and (number <= total).all()
    assert (cloud.intensity >= 120).all()


def test_too_many_returns_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="receiver has 9"):
        simulate_returns("flat", tmp_path / "d.las", pulses=5, receiver=DiscreteReceiver(most=9))
    assert not list(tmp_path.iterdir())


def test_command_line(tmp_path):
    def run(*arguments):
        fixed = ("canopy.corn", "-o", str(tmp_path / "c.laz"), "--pulses", "50")
        return CliRunner().invoke(simulate, [*fixed, *arguments])

    assert run("--sensor", "discrete", "--dead-zone", "1").exit_code == 0
    assert run("--sensor", "discrete").exit_code == 1
    assert run("--sensor", "discrete", "--overwrite", "--json").exit_code == 0
