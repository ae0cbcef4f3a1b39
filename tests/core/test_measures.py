"""Numbers with errors as text: the digits of the value are those of its error."""

import math

import numpy as np
import pytest

from wavebatch.core.units import format_measure, format_relative


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.994, 0.04, "0.994 +- 0.040"), (0.9944, 0.4, "0.99 +- 0.40"), (12.3456, 0.0996, "12.35 +- 0.10"),
        (1234.5, 23.0, "1234 +- 23"), (1234.5, 9.96, "1234 +- 10"), (1.0, 0.0, "1"), (1.5, math.inf, "1.5"),
        (math.nan, 1.0, "-"), (1.0, math.nan, "1"), (-0.5, 1.25, "-0.5 +- 1.2"),
        (0.9876543212, 1e-8, "0.987654321 +- 1.0e-08"), (2.8571e-8, 1.2e-9, "2.86e-08 +- 1.2e-09"),
        (1e-9, 3.4e-7, "1e-09 +- 3.4e-07"), (0.5, 9.96e-6, "0.500000 +- 0.000010"), (0.5, 4e-6, "0.5000000 +- 4.0e-06"),
    ],
)  # fmt: skip
def test_digits_of_the_value_are_those_of_the_error(value, error, text):
    assert format_measure(value, error) == text


def test_errors_have_two_digits_and_values_their_decimals():
    for error in np.geomspace(1e-4, 0.9, 300):
        value, shown = format_measure(0.987654321, error).split(" +- ")
        assert len(value.split(".")[1]) == len(shown.split(".")[1])
        assert len(shown.split(".")[1].lstrip("0")) == 2 and float(shown) == pytest.approx(error, rel=0.051)


def test_no_error_is_shown_as_zero_and_no_value_loses_more_than_its_error():
    for error in np.geomspace(1e-18, 1e-4, 200):
        for value in (0.0123456789, -2.3456789e-8, 0.0):
            first, second = format_measure(value, error).split(" +- ")
            assert float(second) == pytest.approx(error, rel=0.051)
            assert float(first) == pytest.approx(value, abs=0.51 * error)


@pytest.mark.parametrize(
    ("relative", "text"), [(0.012, "2.857e-08"), (0.12, "2.86e-08"), (0.0012, "2.8571e-08"), (0.0, "2.85714e-08")]
)
def test_constants_have_the_digits_that_their_error_allows(relative, text):
    assert format_relative(4 / 1.4e8, relative) == text
