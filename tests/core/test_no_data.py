import json
import math

import numpy as np
import pytest

from wavebatch.cli.messages import format_json
from wavebatch.core.echoes import NoData, count_reasons, explain_no_data, without_nan


def test_json_has_null_for_what_is_no_number():
    given = {1: math.nan, "b": [np.float64("inf"), 2, np.float32(0.5)], "c": ("x", None, True, -math.inf)}
    expected = {"1": None, "b": [None, 2, 0.5], "c": ["x", None, True, None]}
    assert without_nan(given) == expected
    assert json.loads(format_json(given), parse_constant=pytest.fail) == expected


def test_the_first_reason_that_applies_is_given_and_counted():
    values = np.array([1.0, np.nan, np.nan, np.nan])
    unplaced = np.array([True, True, False, False])
    codes = explain_no_data(values, (NoData.NO_SENSOR, unplaced), (NoData.CUT, values != values))
    assert codes.tolist() == [NoData.KNOWN, NoData.NO_SENSOR, NoData.CUT, NoData.CUT]
    assert count_reasons({"range": values, "range_reason": codes}) == {"range": {"KNOWN": 1, "NO_SENSOR": 1, "CUT": 2}}
    assert explain_no_data(values, (NoData.CUT, False))[1] == NoData.OTHER
