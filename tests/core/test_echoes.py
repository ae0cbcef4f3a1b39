"""Echo tables; what is no data in their columns; numbers with their errors as text."""

import json
import math
import pickle

import numpy as np
import pytest
from commands import refuses

from wavebatch.cli.messages import format_json
from wavebatch.core import echoes
from wavebatch.core.errors import StageError
from wavebatch.core.units import format_measure, format_relative


def make_table(waveforms, shift=0.0, **attributes):
    m = len(waveforms)
    number = np.arange(m, dtype=np.float64)
    return echoes.EchoTable.build(
        np.array(waveforms), number + shift, 10 * number, 1 + number, time_err=0.1 * number, attributes=attributes
    )


def test_to_numpy_has_a_field_per_column():
    table = make_table([0, 1, 1], x=np.array([1.0, 2.0, 3.0]), echo_flags=np.array([1, 2, 3], np.uint16))
    rows = table.to_numpy()
    assert rows.dtype.names == (
        "waveform", "time", "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err",
        "relative_energy_err", "residual", "flags",
        "x", "echo_flags",
    )  # fmt: skip
    assert len(rows) == 3
    for name in rows.dtype.names:
        column = table.attributes[name] if name in table.attributes else getattr(table, name)
        assert rows[name].dtype == column.dtype
        np.testing.assert_array_equal(rows[name], column)
    rows["time"] = -1
    assert table.time[1] == 1.0


def test_build_sorts_and_converts():
    table = make_table([3, 1, 1])
    assert table.waveform.tolist() == [1, 1, 3]
    assert table.time.tolist() == [1.0, 2.0, 0.0]
    assert (table.time.dtype, table.amplitude.dtype, table.flags.dtype) == (np.float64, np.float32, np.uint16)
    assert np.isnan(table.residual).all()
    assert not table.flags.any()


def test_build_refuses_unknown_columns():
    with pytest.raises(TypeError, match="height"):
        echoes.EchoTable.build(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1), height=np.zeros(1))


def test_concatenate_with_and_without_shifts():
    first, second = make_table([0, 1], x=np.array([1.0, 2.0])), make_table([0], 5.0, x=np.array([3.0]))
    joined = echoes.EchoTable.concatenate([first, (second, 2)])
    assert joined.waveform.tolist() == [0, 1, 2]
    assert joined.waveform.dtype == np.int32
    assert joined.attributes["x"].tolist() == [1.0, 2.0, 3.0]
    assert echoes.EchoTable.concatenate([first, second]).waveform.tolist() == [0, 1, 0]
    assert len(echoes.EchoTable.concatenate([])) == 0
    refuses(StageError, "different columns", echoes.EchoTable.concatenate, [first, make_table([0])])


def test_attributes_must_fit_the_table():
    refuses(StageError, "column x has 2 values for 1 echoes", make_table([0]).with_attributes, x=np.zeros(2))


def test_flags_are_single_bits_with_a_meaning():
    assert [int(flag) for flag in echoes.EchoFlag] == [1 << bit for bit in range(16)]
    assert all(echoes.FLAG_MEANINGS[flag] == flag.meaning for flag in echoes.EchoFlag)
    both = echoes.EchoFlag.WEAK | echoes.EchoFlag.MERGED
    assert pickle.loads(pickle.dumps(both)) == both == 4128


def test_json_has_null_for_what_is_no_number():
    given = {1: math.nan, "b": [np.float64("inf"), 2, np.float32(0.5)], "c": ("x", None, True, -math.inf)}
    expected = {"1": None, "b": [None, 2, 0.5], "c": ["x", None, True, None]}
    assert echoes.without_nan(given) == expected
    assert json.loads(format_json(given), parse_constant=pytest.fail) == expected


def test_the_first_reason_that_applies_is_given_and_counted():
    values = np.array([1.0, np.nan, np.nan, np.nan])
    unplaced = np.array([True, True, False, False])
    codes = echoes.explain_no_data(values, (echoes.NoData.NO_SENSOR, unplaced), (echoes.NoData.CUT, values != values))
    assert codes.tolist() == [echoes.NoData.KNOWN, echoes.NoData.NO_SENSOR, echoes.NoData.CUT, echoes.NoData.CUT]
    found = echoes.count_reasons({"range": values, "range_reason": codes})
    assert found == {"range": {"KNOWN": 1, "NO_SENSOR": 1, "CUT": 2}}
    assert echoes.explain_no_data(values, (echoes.NoData.CUT, False))[1] == echoes.NoData.OTHER


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
