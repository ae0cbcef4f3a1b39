"""A dataclass as the schema of a file: its fields are keys with ranges and comments, both ways to the last bit."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import pytest

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Key, Range
from wavebatch.files.toml_file import describe_record, format_toml, list_comments, list_keys, parse_toml, read_record

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
TEXT = format_toml(describe_record(FULL), comments=list_comments(Whole, ""))


def test_an_object_comes_back_without_what_has_no_key():
    found = read_record(Whole, parse_toml(TEXT, "x"), strict=False)
    assert found == Whole(**{**FULL.__dict__, "part": Part(1 / 3, "a")})
    assert "secret" not in TEXT and "size_m = 3  # of a cell" in TEXT


def test_values_come_before_tables_and_lists():
    keys = list(describe_record(FULL))
    assert keys.index("other_width") < keys.index("by_kind") < keys.index("shares") < keys.index("row")
    assert describe_record(FULL)["seams"] == [[9, 1], [80, 3]]
    assert set(list_keys(Whole)) >= {"size_m", "part_width", "other_note", "row"}


def test_what_is_empty_or_infinite_is_left_out():
    plain = describe_record(Whole(1, Part(float("inf"))))
    assert plain["part_width"] is None and plain["limit_dn"] is None and plain["shares"] == []
    assert not {"pairs", "seams", "row", "other_width"} & plain.keys()


def test_parts_that_are_not_whole_are_left_out_where_they_may_be():
    text = TEXT.replace("other_width = 4.0", "").replace("form_2_width = 0.1", "")
    found = read_record(Whole, parse_toml(text, "x"), strict=False)
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
    table = parse_toml(TEXT.replace(old, new, 1), "x")
    with pytest.raises(ConfigError, match=words):
        read_record(Whole, table, also=[key for key in table.values if key.startswith(("misfit_", "form_"))])


def test_a_remedy_stands_for_the_meaning():
    with pytest.raises(ConfigError, match="x: key 'size_m' is missing; survey again"):
        read_record(Whole, parse_toml(TEXT.replace("size_m = 3", ""), "x"), strict=False, remedy="survey again")


def test_a_day_without_quotes_is_text():
    found = read_record(Part, parse_toml("width = 1\nnote = 2026-05-31", "x"))
    assert found.note == "2026-05-31"
