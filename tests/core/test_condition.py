"""The grammar of --where: what it means, what it refuses and where, and what a point without data does."""

import pickle

import numpy as np
import pytest
from commands import refuses
from hypothesis import given
from hypothesis import strategies as st

from wavebatch.core.condition import MOST_CHARACTERS, MOST_NESTED, parse_condition
from wavebatch.core.errors import ConfigError

NAN = np.nan
VALUES = {
    "a": np.array([1.0, 2.0, 3.0, NAN, -1.5]),
    "b": np.array([1.0, 3.0, NAN, NAN, 0.0]),
    "n": np.array([1, 2, 3, 4, 5], np.uint8),
    "echo width (ns)": np.array([4.0, 5.0, 6.0, NAN, 8.0]),
}


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("a == 1", [0]),
        ("a != 1", [1, 2, 4]),
        ("a<=2", [0, 1, 4]),
        ("a > -1.5e0", [0, 1, 2]),
        (".5 < a", [0, 1, 2]),
        ("1 <= a < 3", [0, 1]),
        ("a == b", [0]),
        ("a != b", [1, 4]),
        ("a > 1 or n == 4", [1, 2, 3]),
        ("n == 1 or n == 2 and a == 9", [0]),
        ("(n == 1 or n == 2) and a == 2", [1]),
        ("not a == 1", [1, 2, 4]),
        ("not (a > 1 or b > 1)", [0, 4]),
        ("NOT n == 1 AND n < 3", [1]),
        ("not not n == 1", [0]),
        ("`echo width (ns)` < 6", [0, 1]),
        ('"echo width (ns)" >= 8', [4]),
        ("n == 1 and n == 2 or n == 3", [2]),
    ],
)
def test_conditions_choose_the_points_that_meet_them(text, chosen):
    condition = pickle.loads(pickle.dumps(parse_condition(text)))
    np.testing.assert_array_equal(np.flatnonzero(condition.choose(VALUES)), chosen)


@given(st.sampled_from(["==", "!=", "<", "<=", ">", ">="]), st.sampled_from(["a", "b"]), st.floats(-3, 3))
def test_no_data_meets_neither_a_comparison_nor_its_negation(sign, name, number):
    comparison = f"{name} {sign} {number!r}"
    met, unmet = (parse_condition(text).choose(VALUES) for text in (comparison, f"not ({comparison})"))
    unknown = np.isnan(VALUES[name])
    assert not (met | unmet)[unknown].any()
    assert (met ^ unmet)[~unknown].all()


@pytest.mark.parametrize(
    ("text", "place", "word"),
    [
        ("a", 2, "comparison"),
        ("a = 1", 3, "write =="),
        ("a == 1 && b == 2", 8, "write and"),
        ("a == ", 6, "a column or a number is missing before the end"),
        ("a == 1 b == 2", 8, "`and`, `or`"),
        ("(a == 1", 8, "closing parenthesis"),
        ("a == 1)", 7, "the condition ends here, before ')'"),
        ("1 < 'here  b'  'there  c'", 16, "before \"'there  c'\""),
        ("and a == 1", 1, "column or a number"),
        ("a == 1 and", 11, "the end"),
        ("a == -b", 7, "number"),
        ("a == 1e999", 6, "too large"),
        ("__import__('os').system('x')", 11, "comparison"),
        ("a == 1; b", 7, "';'"),
        ("a == 1.2.3", 6, "'1.2.3'"),
        ("a == 2x", 6, "'2x'"),
        ("", 1, "missing before the end"),
    ],
)
def test_errors_have_the_place(text, place, word):
    with pytest.raises(ConfigError) as caught:
        parse_condition(text)
    message = str(caught.value)
    assert message.startswith(f"--where: character {place}: ") and word in message and "\n" not in message


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        ("flag(SATURATED)", [0, 1, 0, 1]), ("echo_flags has saturated and z > 0", [0, 0, 0, 1]),
        ("not flag( WEAK ) or flag(SATURATED)", [1, 1, 0, 1]), ("not (echo_flags has WEAK)", [1, 1, 0, 0]),
    ],
)  # fmt: skip
def test_flags_have_names(text, chosen):
    bits = {"echo_flags": np.array([0, 8, 32, 40, np.nan]), "z": np.array([1.0, -1, 1, 1, 1])}
    condition = parse_condition(text)
    found = condition.choose({name: bits[name] for name in condition.columns})
    assert found.astype(int).tolist() == [*chosen, 0]
    refuses(ConfigError, r"character 6: flag 'WEEK' does not exist; did you mean 'WEAK'", parse_condition, "flag(WEEK)")


def test_length_and_depth_are_bounded():
    refuses(ConfigError, f"at most {MOST_CHARACTERS}", parse_condition, "a == 1 or " * 300 + "a == 1")
    for part, end in (("(", ")"), ("not ", "")):
        fits = part * MOST_NESTED + "a == 1" + end * MOST_NESTED
        assert parse_condition(fits).columns == ("a",)
        refuses(ConfigError, "inside each other", parse_condition, part + fits + end)
    chain = " or ".join(["a==1"] * 240)  # as long as the text may be: no recursion
    assert parse_condition(chain).choose(VALUES).tolist() == [True, False, False, False, False]


def test_numbers_alone_are_no_condition():
    refuses(ConfigError, "names no column", parse_condition, "1 == 1")


@given(st.text("ab12.()<>=! andortn'\"`\\\n", max_size=40))
def test_any_text_is_a_condition_or_one_line(text):
    try:
        condition = parse_condition(text)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        assert condition.choose(dict.fromkeys(condition.columns, VALUES["a"])).shape == (5,)
