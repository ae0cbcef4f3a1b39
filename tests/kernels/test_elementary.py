"""Tables between their rows by the library, with the bits of NumPy's interp; logarithms alone and in fours."""

import numpy as np
import pytest
from commands import refuses

from wavebatch.kernels.elementary import interpolate, log


@pytest.mark.parametrize("rows", [2, 3, 12])
def test_interpolation_has_the_bits_of_numpy(rng, rows):
    at, table = np.sort(rng.uniform(0, 50, rows)), rng.normal(1, 0.3, (rows, 4))
    x = np.concatenate([rng.uniform(-10, 60, 5000), at, np.nextafter(at, 0), [np.nan, np.inf, -np.inf]])
    twin = np.stack([np.interp(x, at, column) for column in table.T], axis=1)
    assert interpolate(x, at, table).tobytes() == twin.tobytes()


def test_a_table_without_its_places_is_refused():
    for at, table in ((np.zeros(3), np.zeros((2, 4))), (np.zeros(0), np.zeros((0, 4)))):
        refuses(ValueError, "has no rows", interpolate, np.zeros(5), at, table)


@pytest.mark.parametrize("odd", [np.inf, np.nan, 0.0, -1.0, 5e-324])
def test_logarithms_in_fours_are_those_of_single_numbers(rng, odd):
    x = np.exp(rng.uniform(-300, 300, 41))
    x[6] = odd
    with np.errstate(all="ignore"):
        assert log(x).tobytes() == np.concatenate([log(x[i : i + 1]) for i in range(len(x))]).tobytes()
        np.testing.assert_allclose(log(x), np.log(x), rtol=1e-14)
