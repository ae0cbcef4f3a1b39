"""The discrete receiver against a plain loop, and the published tables of return numbers (docs/algorithms.md 1.5)."""

import numpy as np
import pytest
from click.testing import CliRunner
from published import RETURN_TABLES

from wavebatch.cli.strips import simulate
from wavebatch.core.errors import ConfigError
from wavebatch.tools.return_stats import count_returns
from wavebatch.tools.simulate import DiscreteReceiver, simulate_returns


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
