"""Lines in slices against slow twins, on random, noisy and degenerate inputs."""

import naive_geometry
import numpy as np
import pytest

from wavebatch.kernels.geometry.slice_lines import find_lines


def slice_of(rng, kind):
    """Pixels (x, y), weights of one or two lines among scattered pixels."""
    along = rng.uniform(0, 60, 70)
    x, y = along, {"flat": 0.1, "steep": 3.0}.get(kind, -0.7) * along + rng.normal(0, 1.0, 70)
    if kind == "crossing":
        y[::3] = 0.7 * along[::3] - 40
    if kind == "gaps":
        x[::2] += 90
    noise = rng.uniform(-10, 80, (2, 25 if kind != "noise" else 200))
    if kind == "noise":
        x = y = np.empty(0)
    return np.r_[x, noise[0]], np.r_[y, noise[1]], rng.uniform(0.5, 3.0, len(x) + noise.shape[1])


@pytest.mark.parametrize("kind", ["flat", "steep", "crossing", "gaps", "noise"])
def test_lines_of_a_slice_are_those_of_loops(rng, kind):
    x, y, weight = slice_of(rng, kind)
    options = {"sigma": 1.0, "gap": 12.0, "shortest": 15.0, "most": 3}
    lines = find_lines(x, y, weight, **options)
    expected = naive_geometry.find_lines(x, y, weight, **options)
    assert len(lines) == len(expected) and (lines or kind == "noise")
    for line, (rows, start, end, total) in zip(lines, expected, strict=True):
        assert line.rows.tolist() == rows
        assert line.start == pytest.approx(start, abs=1e-6) and line.end == pytest.approx(end, abs=1e-6)
        assert line.weight == pytest.approx(total)
