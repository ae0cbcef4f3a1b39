"""One table of names, one rule for collisions, values in the unit that the record says."""

import numpy as np
import pytest

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.column_names import _SHORT as SHORT
from wavebatch.files.cloud.column_names import STYLES, describe, describe_roundings, normalise, resolve, style_columns

ALL = tuple(COLUMNS)
WRITTEN = tuple(name for name, column in COLUMNS.items() if column.extra_bytes)
NUMBERS = tuple(name for name in WRITTEN if name != "echo_flags")


@pytest.mark.parametrize("style", STYLES)
def test_every_style_writes_every_column_under_a_name_of_its_own(style):
    columns = style_columns(ALL, style, ())
    assert tuple(column.column for column in columns) == WRITTEN
    names = [column.record.name for column in columns]
    assert len({normalise(name) for name in names}) == len(names)
    assert all(len(name.encode()) <= 32 for name in names)


@pytest.mark.parametrize("column", COLUMNS.values(), ids=COLUMNS)
def test_descriptions_fit_and_end_with_the_unit(column):
    text = describe(column)
    assert len(text.encode()) <= 32 and text.endswith(f"[{column.unit}]")
    meaning = text.rpartition(" [")[0]
    error = f"1 sigma of {column.name.removesuffix('_err')}"
    assert not column.extra_bytes or meaning in (SHORT.get(column.name), column.meaning, error), "the meaning is cut"


@pytest.mark.parametrize("style", STYLES)
def test_styles_name_columns_that_exist(style):
    assert set(STYLES[style]) <= set(COLUMNS)


def test_collisions_with_prefixed_names_separators_and_standard_fields():
    def named(columns, style, taken):
        return [column.record.name for column in style_columns(columns, style, taken)]

    assert named(["amplitude"], "wavebatch", ["Amplitude", "wb_amplitude"]) == ["wb2_amplitude"]
    assert named(["echo_width"], "wavebatch", ["Echo Width"]) == ["wb_echo_width"]
    assert named(["echo_width"], "asprs", ["Pulse width"]) == ["wb_pulse_width"]
    assert named(["echo_width"], "pdal", ["echo_width"]) == ["wb_EchoWidth"]
    assert named(["amplitude", "amplitude"], "opals", []) == ["Amplitude"]
    assert named(["x", "y", "z", "range"], "wavebatch", ["X"]) == ["range"]
    assert named(["range"], "pdal", []) == ["EchoRange"]


def test_no_data_of_floating_point_columns_can_be_nan():
    plain, nan = (
        {column.column: column.record for column in style_columns(list(COLUMNS), "asprs", [], no_data)}
        for no_data in ("-9999", "nan")
    )
    for name, record in plain.items():
        if record.dtype.kind == "f":
            assert record.no_data[0] == -9999 and np.isnan(nan[name].no_data[0]), name
        else:
            assert record == nan[name]
    with pytest.raises(ConfigError, match="no_data '0': must be one of -9999, nan"):
        style_columns(["amplitude"], "wavebatch", [], "0")


def test_styles_that_round_say_so_with_step_and_limits():
    (line,) = describe_roundings(style_columns(list(COLUMNS), "asprs", []))
    assert line.startswith("echo_width: written as 'pulse width', rounded to 0.1 ns and kept within 0 to 6553.5 ns")
    assert [line.split(":")[0] for line in describe_roundings(style_columns(list(COLUMNS), "riegl", []))] == [
        "echo_width",
        "reflectance",
    ]
    for style in ("wavebatch", "pdal", "opals"):
        assert describe_roundings(style_columns(list(COLUMNS), style, [])) == []


def test_unknown_names_are_one_line():
    with pytest.raises(ConfigError, match="column 'amplitud' does not exist; did you mean 'amplitude'"):
        style_columns(["amplitud"], "wavebatch", ())
    with pytest.raises(ConfigError, match="column 'qqq' does not exist; known are amplitude, "):
        style_columns(["qqq"], "wavebatch", ())
    with pytest.raises(ConfigError, match="names 'x': must be one of wavebatch, asprs"):
        style_columns([], "x", ())


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("name", NUMBERS)
def test_what_is_no_number_becomes_the_declared_no_data(style, name):
    (column,) = style_columns([name], style, ())
    empty = column.record.no_data
    assert empty is not None
    stored = column.encode(np.array([np.nan, np.inf, -np.inf, 5.0]))
    assert list(stored[:3]) == [empty[0]] * 3 and stored[3] != empty[0]


def test_values_beyond_the_stored_type_become_its_nearest_value_never_no_data():
    (width,) = style_columns(["echo_width"], "asprs", ())
    assert list(width.encode(np.array([0.0, 0.01, 1e9, np.nan]))) == [1, 1, 65535, 0]
    (reflectance,) = style_columns(["reflectance"], "riegl", ())
    assert list(reflectance.encode(np.array([1.0, 0.1, 1e-300, 1e300, 0.0, -1.0]))) == [
        0, -1000, -32767, 32767, -32768, -32768,
    ]  # fmt: skip
    (amplitude,) = style_columns(["amplitude"], "wavebatch", ())
    assert list(amplitude.encode(np.array([1e300, 1.0]))) == [-9999.0, 1.0]


def test_exact_names_come_before_those_that_are_alike_and_kinds_count_in_order():
    ours, file = {"echo_width": "Pulse width", "amplitude": "wb_amplitude"}, {"Amplitude": "Amplitude", "z": "z"}
    assert resolve("Amplitude", ours, file) == "Amplitude"
    assert resolve("amplitude", ours, file) == "wb_amplitude"
    assert resolve("AMPLITUDE", ours, file) == "wb_amplitude"
    assert resolve("Echo Width", ours, file) == "Pulse width"
    assert resolve("Z", ours, file) == "z"
    assert resolve("width", ours, file) is None
