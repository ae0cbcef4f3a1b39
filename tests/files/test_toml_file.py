"""TOML writer and checked reader: round trips through tomllib, and one clear line for each wrong input.

A dataclass as the schema of a file: its fields are keys with ranges and comments, both ways to the last bit.
"""

import datetime
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import pytest
from commands import refuses
from hypothesis import given
from hypothesis import strategies as st

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Key, Range
from wavebatch.files import toml_file
from wavebatch.files.text_file import MOST_BYTES, read_text

PLAIN = (
    st.text()
    | st.booleans()
    | st.integers(-(1 << 63), (1 << 63) - 1)
    | st.floats(allow_nan=False)
    | st.dates()
    | st.datetimes()
)
VALUES = st.recursive(
    PLAIN, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4), max_leaves=15
)


@given(st.dictionaries(st.text(), VALUES, max_size=6))
def test_round_trip(document):
    text = toml_file.format_toml(document, heading="any\ntext", comments=dict.fromkeys(document, "any\nremark"))
    assert tomllib.loads(text) == document
    assert toml_file.format_toml(tomllib.loads(text)) == toml_file.format_toml(document)


def test_astral_characters_are_not_escaped():
    assert toml_file.format_toml({"a": "\U0001d538"}) == 'a = "\U0001d538"\n'


def test_bytes_that_are_no_text_become_question_marks():
    assert tomllib.loads(toml_file.format_toml({"strip": "a\udcff.las"}))["strip"] == "a?.las"


def test_numbers():
    values = {"a": math.inf, "b": -math.inf, "c": 1e-5, "d": 1e300, "e": -0.0, "f": np.float32(0.5)}
    text = toml_file.format_toml(values)
    assert text == "a = inf\nb = -inf\nc = 1e-05\nd = 1e+300\ne = -0.0\nf = 0.5\n"
    assert math.isnan(tomllib.loads(toml_file.format_toml({"a": math.nan}))["a"])
    scalars = {"a": np.float64(0.1), "b": np.int64(3), "c": np.bool_(True)}
    assert tomllib.loads(toml_file.format_toml(scalars)) == {"a": 0.1, "b": 3, "c": True}


def test_layout_with_comments():
    document = {
        "last": {"x": 1, "rows": [[1.0, 2]], "deep": {}},
        "first": True,
        "none": None,
        "many": [{"x": 1}, {"x": 2, "y": {"z": "s"}}],
    }
    comments = {"last": "a table", "last.x": "a value", "last.rows": "an array", "many": "each", "many.x": "of each"}
    assert toml_file.format_toml(document, heading="head", comments=comments) == (
        "# head\nfirst = true\n\n# a table\n[last]\nx = 1  # a value\n# an array\nrows = [[1.0, 2]]\n\n[last.deep]\n"
        '\n# each\n[[many]]\nx = 1  # of each\n\n# each\n[[many]]\nx = 2  # of each\n\n[many.y]\nz = "s"\n'
    )


def test_empty_comments_write_no_line():
    document = {"x": 1, "rows": [1], "table": {"x": 2}, "many": [{"x": 3}]}
    comments = dict.fromkeys(["x", "rows", "table", "table.x", "many", "many.x"], " ")
    assert toml_file.format_toml(document, comments=comments) == toml_file.format_toml(document)


def test_dates_keep_their_offset():
    when = datetime.datetime(2020, 1, 2, 3, 4, 5, tzinfo=datetime.UTC)
    assert tomllib.loads(toml_file.format_toml({"a": when, "b": when.time()})) == {"a": when, "b": when.time()}


@pytest.mark.parametrize("value", [object(), [None], b"bytes", {1, 2}, 1j])
def test_other_types_are_refused(value):
    refuses(TypeError, "TOML cannot hold", toml_file.format_toml, {"a": value})


def test_reading_is_bounded(tmp_path):
    path = tmp_path / "a.toml"
    path.write_bytes(b"#" * MOST_BYTES)
    assert len(read_text(path, "chain file")) == MOST_BYTES
    path.write_bytes(b"#" * (MOST_BYTES + 1))
    refuses(ConfigError, "a.toml: chain file is larger than 4 MiB", read_text, path, "chain file")
    path.write_bytes(b"a = '\xff'")
    refuses(ConfigError, r"a.toml: chain file is not UTF-8 text \(byte 5\)", read_text, path, "chain file")
    with pytest.raises(ConfigError, match="none.toml: chain file cannot be read: No such file"):
        read_text(tmp_path / "none.toml", "chain file")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a = " + "[" * 10_000, "nested more than 64 deep"),
        ("a = " + "[" * 100 + "]" * 100, "nested more than 64 deep"),
        ("a = " + "{b = [" * 70 + "]}" * 70, "nested more than 64 deep"),
        (".".join("a" * 65) + " = 1", "nested more than 64 deep"),
        ("a = " + "9" * 5000, "a number has more than 4000 digits"),
        ("a = [1, -1" + "_0" * 5000 + "]", "a number has more than 4000 digits"),
    ],
)
def test_depth_and_digits_are_bounded(text, why):
    refuses(ConfigError, f"x.toml: .*{why}", toml_file.parse_toml, text, "x.toml")
    deep = "a = " + "[" * 60 + "]" * 60 + f"\nb = {'9' * 900}\n" + ".".join("c" * 60) + " = 1"
    assert toml_file.parse_toml(deep, "x")


@pytest.mark.parametrize("text", ["a", "a = 1\na = 2", 'a = "\\ud835"'])
def test_text_that_is_not_toml(text):
    refuses(ConfigError, "x.toml: not valid TOML: ", toml_file.parse_toml, text, "x.toml")


TABLE = toml_file.parse_toml(
    'text = "s"\nyes = true\nwhole = 3\nhalf = 0.5\nbad = nan\nhuge = 0x1'
    + "0" * 5000
    + "\n[t]\na = 1\n[[r]]\nb = 2\n",
    "x.toml",
)


def test_typed_keys():
    assert (TABLE.get("text", str), TABLE.get("yes", bool), TABLE.get("whole", int)) == ("s", True, 3)
    assert (TABLE.number("half"), TABLE.number("whole", 0, 3), TABLE.integer("whole", 3, 3)) == (0.5, 3.0, 3)
    assert type(TABLE.number("whole")) is float
    assert (TABLE.get("none", str, ""), TABLE.number("none", 1, 2, default=None)) == ("", None)
    assert TABLE.integer("none", 1, 2, default=0) == 0
    assert TABLE.table("t") == toml_file.TomlTable({"a": 1}, "x.toml: [t]")
    assert TABLE.tables("r") == [toml_file.TomlTable({"b": 2}, "x.toml: [[r]] 1")] and TABLE.tables("none") == []
    TABLE.check_keys(TABLE.values, ["text"])


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: TABLE.get("text", int), "x.toml: text must be an integer, it is 's'"),
        (lambda: TABLE.get("yes", int), "x.toml: yes must be an integer, it is True"),
        (lambda: TABLE.get("whole", bool), "x.toml: whole must be true or false, it is 3"),
        (lambda: TABLE.get("none", str), "x.toml: key 'none' is missing"),
        (lambda: TABLE.number("none", meaning="counts"), "x.toml: key 'none' is missing: counts"),
        (lambda: TABLE.number("yes"), "x.toml: yes must be a number, it is True"),
        (lambda: TABLE.number("bad"), "x.toml: bad must be a finite number, it is nan"),
        (lambda: TABLE.number("huge"), "x.toml: huge must be a finite number, it is a very large number"),
        (lambda: TABLE.get("huge", str), "x.toml: huge must be a string, it is a very large number"),
        (lambda: TABLE.number("half", 1, 2), "x.toml: half must lie between 1 and 2, it is 0.5"),
        (lambda: TABLE.integer("whole", 4, 5), "x.toml: whole must lie between 4 and 5, it is 3"),
        (lambda: TABLE.integer("huge", 4, 5), "x.toml: huge must lie between 4 and 5, it is a very large number"),
        (lambda: TABLE.table("text"), "x.toml: text must be a table, it is 's'"),
        (lambda: TABLE.tables("t", "u.t"), "x.toml: t must be written as [[u.t]] tables"),
        (lambda: TABLE.check_keys(["text", "whale"]), "x.toml: unknown key 'yes'; known are text, whale"),
        (lambda: TABLE.table("t").check_keys("ab", "b", "add it"), "x.toml: [t]: key 'b' is missing; add it"),
        (
            lambda: TABLE.check_schema("s/1", "survey again"),
            "x.toml: schema is None, this version reads 's/1'; survey again",
        ),
        (lambda: toml_file.check_type("s", (int, type(None)), "here"), "here must be an integer, it is 's'"),
        (lambda: toml_file.check_type("s", (int, bool), "here"), "here must be an integer or true or false, it is 's'"),
        (
            lambda: toml_file.check_number(toml_file.LARGEST_INTEGER + 1, 0, math.inf, "here"),
            "here must be a finite number, it is 9007199254740993",
        ),
    ],
)
def test_messages(check, message):
    with pytest.raises(ConfigError) as caught:
        check()
    assert str(caught.value) == message


def test_integers_stay_where_they_are_allowed():
    assert type(toml_file.check_type(3, (int, float), "")) is int


def test_shorten():
    assert toml_file.shorten("a" * 100) == "'" + "a" * 56 + "..." and toml_file.shorten({"a": "b"}) == "{'a': 'b'}"


Share = Annotated[float, Range(0.0, 1.0)]


@dataclass(frozen=True)
class Part:
    width: Annotated[float, Range(0.0, 9.0), Key()]
    note: Annotated[str, Key()] = ""
    secret: float = 1.0


@dataclass(frozen=True)
class Whole:
    size: Annotated[int, Range(1, 10), Key("size_m", "of a cell")]
    part: Annotated[Part, Key("part_")]
    limit: Annotated[float | None, Range(0.0, 5.0), Key("limit_dn", needed=True)] = None
    sharp: Annotated[bool, Key()] = False
    shares: Annotated[tuple[Share, ...], Key(blank=True)] = ()
    pairs: Annotated[tuple[tuple[Share, Annotated[float, Range(-9, 9)]], ...], Key(form="[share, lag]")] = ()
    seams: Annotated[Mapping[Annotated[int, Range(1, 99)], Annotated[int, Range(1, 9)]], Key()] = field(
        default_factory=dict
    )
    kinds: Annotated[Mapping[str, Share], Key("by_kind")] = field(default_factory=dict)
    misfits: Annotated[Mapping[int, Share], Key("misfit_{}_terms")] = field(default_factory=dict)
    forms: Annotated[Mapping[int, Part], Key("form_{}_")] = field(default_factory=dict)
    rows: Annotated[tuple[Part, ...], Key("row")] = ()
    other: Annotated[Part | None, Key("other_")] = None


FULL = Whole(
    3, Part(1 / 3, "a", 2.0), 0.1 + 0.2, True, (0.1, 1 / 7), ((0.5, -1 / 3),), {80: 3, 9: 1}, {"quiet": 1e-17},
    {1: 0.5, 12: 1 / 9}, {2: Part(0.1, "b")}, (Part(1.0, "c"), Part(2.0)), Part(4.0),
)  # fmt: skip
TEXT = toml_file.format_toml(toml_file.describe_record(FULL), comments=toml_file.list_comments(Whole, ""))


def test_an_object_comes_back_without_what_has_no_key():
    found = toml_file.read_record(Whole, toml_file.parse_toml(TEXT, "x"), strict=False)
    assert found == Whole(**{**FULL.__dict__, "part": Part(1 / 3, "a")})
    assert "secret" not in TEXT and "size_m = 3  # of a cell" in TEXT


def test_values_come_before_tables_and_lists():
    keys = list(toml_file.describe_record(FULL))
    assert keys.index("other_width") < keys.index("by_kind") < keys.index("shares") < keys.index("row")
    assert toml_file.describe_record(FULL)["seams"] == [[9, 1], [80, 3]]
    assert set(toml_file.list_keys(Whole)) >= {"size_m", "part_width", "other_note", "row"}


def test_what_is_empty_or_infinite_is_left_out():
    plain = toml_file.describe_record(Whole(1, Part(float("inf"))))
    assert plain["part_width"] is None and plain["limit_dn"] is None and plain["shares"] == []
    assert not {"pairs", "seams", "row", "other_width"} & plain.keys()


def test_parts_that_are_not_whole_are_left_out_where_they_may_be():
    text = TEXT.replace("other_width = 4.0", "").replace("form_2_width = 0.1", "")
    found = toml_file.read_record(Whole, toml_file.parse_toml(text, "x"), strict=False)
    assert found.other is None and found.forms == {}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("size_m = 3", "sise_m = 3", "x: unknown key 'sise_m'; did you mean 'size_m'"),
        ("size_m = 3", "", "x: key 'size_m' is missing: of a cell"),
        ("size_m = 3", "size_m = 11", "x: size_m must lie between 1 and 10"),
        ("size_m = 3", "size_m = 1.5", "x: size_m must be an integer"),
        ("limit_dn = 0.30000000000000004", "", "x: key 'limit_dn' is missing"),
        ("part_width = 0.3333333333333333", "part_width = 10", "x: part_width must lie between 0 and 9"),
        ("sharp = true", "sharp = 1", "x: sharp must be true or false"),
        ('part_note = "a"', "part_note = [1]", "x: part_note must be a string"),
        ("shares = [0.1", "shares = [2", "x: shares row 1 must lie between 0 and 1"),
        ("pairs = [[0.5, ", "pairs = [[", r"x: pairs must be a list of \[share, lag\]"),
        ("quiet = 1e-17", "quiet = -1", r"x: \[by_kind\]: quiet must lie between 0 and 1"),
        ("width = 1.0", "", r"x: \[\[row\]\] 1: key 'width' is missing"),
        ("form_2_width = 0.1", "form_2_width = 99", "x: form_2_width must lie between"),
        ("misfit_12_terms = 0.1", "misfit_12_terms = 7.1", "x: misfit_12_terms must lie between 0 and 1"),
    ],
)
def test_what_is_wrong_is_named(old, new, words):
    assert old in TEXT
    table = toml_file.parse_toml(TEXT.replace(old, new, 1), "x")
    with pytest.raises(ConfigError, match=words):
        toml_file.read_record(Whole, table, also=[key for key in table.values if key.startswith(("misfit_", "form_"))])


def test_a_remedy_stands_for_the_meaning():
    with pytest.raises(ConfigError, match="x: key 'size_m' is missing; survey again"):
        old = toml_file.parse_toml(TEXT.replace("size_m = 3", ""), "x")
        toml_file.read_record(Whole, old, strict=False, remedy="survey again")


def test_a_day_without_quotes_is_text():
    found = toml_file.read_record(Part, toml_file.parse_toml("width = 1\nnote = 2026-05-31", "x"))
    assert found.note == "2026-05-31"
