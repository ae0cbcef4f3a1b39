import pickle

import numpy as np
import pytest

from wavebatch.core.echoes import FLAG_MEANINGS, EchoFlag, EchoTable
from wavebatch.core.errors import StageError


def make_table(waveforms, shift=0.0, **attributes):
    m = len(waveforms)
    number = np.arange(m, dtype=np.float64)
    return EchoTable.build(
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
        EchoTable.build(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1), height=np.zeros(1))


def test_concatenate_with_and_without_shifts():
    first, second = make_table([0, 1], x=np.array([1.0, 2.0])), make_table([0], 5.0, x=np.array([3.0]))
    joined = EchoTable.concatenate([first, (second, 2)])
    assert joined.waveform.tolist() == [0, 1, 2]
    assert joined.waveform.dtype == np.int32
    assert joined.attributes["x"].tolist() == [1.0, 2.0, 3.0]
    assert EchoTable.concatenate([first, second]).waveform.tolist() == [0, 1, 0]
    assert len(EchoTable.concatenate([])) == 0
    with pytest.raises(StageError, match="different columns"):
        EchoTable.concatenate([first, make_table([0])])


def test_attributes_must_fit_the_table():
    with pytest.raises(StageError, match="column x has 2 values for 1 echoes"):
        make_table([0]).with_attributes(x=np.zeros(2))


def test_flags_are_single_bits_with_a_meaning():
    assert [int(flag) for flag in EchoFlag] == [1 << bit for bit in range(16)]
    assert all(FLAG_MEANINGS[flag] == flag.meaning for flag in EchoFlag)
    both = EchoFlag.WEAK | EchoFlag.MERGED
    assert pickle.loads(pickle.dumps(both)) == both == 4128
