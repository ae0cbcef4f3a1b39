"""Frozen dataclasses, and packages that need not be there."""

from __future__ import annotations

import collections
import copy
import importlib.util
import inspect
import pickle
import re
import shutil
import sys
import tomllib
from dataclasses import KW_ONLY, FrozenInstanceError, asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.errors import PACKAGES, advise_install
from wavebatch.core.frozen import NamedTuple, changeable, frozen


@frozen
class Point:
    """Two fields with every kind of default."""

    x: int
    y: float = 2.0
    names: list[str] = field(default_factory=list)
    note: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Twin:
    """The same class, made by Python."""

    x: int
    y: float = 2.0
    names: list[str] = field(default_factory=list)
    note: str = field(default="", compare=False)


@frozen(eq=False)
class Row:
    """Holds an array."""

    values: np.ndarray

    def __repr__(self) -> str:
        return f"Row of {len(self.values)}"


@frozen
class Checked(Point):
    """Has a field more, and checks it."""

    last: int = 0

    def __post_init__(self) -> None:
        if self.last < 0:
            raise ValueError("last is negative")


def test_it_is_the_dataclass_that_python_makes():
    one, twin = Point(1, names=["a"]), Twin(1, names=["a"])
    assert is_dataclass(Point) and [f.name for f in fields(Point)] == [f.name for f in fields(Twin)]
    assert asdict(one) == asdict(twin) and repr(one) == repr(twin).replace("Twin", "Point")
    assert Point.__match_args__ == Twin.__match_args__ and not hasattr(one, "__dict__")
    ours, theirs = inspect.signature(Point), inspect.signature(Twin)
    assert list(ours.parameters) == list(theirs.parameters)
    assert ours.parameters["y"] == theirs.parameters["y"] and ours.parameters["x"] == theirs.parameters["x"]
    assert replace(one, y=3.0) == Point(1, 3.0, ["a"])
    assert one.names is not Point(1).names, "each object has a default of its own"


def test_equal_values_are_equal_objects():
    assert Point(1, note="a") == Point(1, note="b") and Point(1) != Point(2) and Point(1) != Twin(1)
    assert hash(Checked(1, names=(), last=3)) == hash(Checked(1, names=(), last=3))
    assert Point(1) != Checked(1)
    row = Row(np.zeros(3))
    assert row == row and row != Row(row.values) and hash(row) == hash(row)
    assert repr(row) == "Row of 3", "its own method is kept"


@frozen(order=True)
class Ranked:
    """Is sorted."""

    first: int
    _: KW_ONLY
    second: str = ""


def test_objects_are_sorted_by_their_values():
    ranked = [Ranked(2), Ranked(1, second="b"), Ranked(1, second="a")]
    assert sorted(ranked) == ranked[::-1] and max(ranked) is ranked[0]
    assert ranked[1] <= Ranked(1, second="b") <= ranked[0] >= Ranked(2) > ranked[1]
    refuses(TypeError, "takes first, each once", Ranked, 1, "a")
    refuses(TypeError, "", sorted, [Point(1), Point(2)])


def test_nothing_can_be_changed():
    point = Point(1)
    with pytest.raises(FrozenInstanceError, match=r"Point\.x cannot be changed"):
        point.x = 2
    with pytest.raises(FrozenInstanceError, match=r"Point\.x cannot be changed"):
        del point.x
    with pytest.raises(FrozenInstanceError):
        point.other = 2


def test_objects_are_copied_and_sent_to_processes():
    one = Checked(1, 3.0, ["a"], "n", 5)
    for other in (pickle.loads(pickle.dumps(one)), copy.copy(one), copy.deepcopy(one)):
        assert other == one and other.note == "n" and other is not one


@pytest.mark.parametrize(
    ("values", "named", "text"),
    [
        ((), {}, "Checked needs x"),
        ((1,), {"x": 2}, "takes x, y, names, note, last, each once"),
        ((1, 2, [], "", 5, 6), {}, "takes x, y, names, note, last, each once"),
        ((1,), {"z": 2, "w": 3}, "Checked has no z, w"),
    ],
)
def test_wrong_arguments_are_named(values, named, text):
    refuses(TypeError, text, Checked, *values, **named)


def test_a_class_checks_its_values():
    refuses(ValueError, "last is negative", Checked, 1, last=-1)


def test_other_classes_may_be_made_of_it():
    @dataclass(frozen=True)
    class Plain(Point):
        more: int = 0

    class Own(Point):
        def __init__(self, width: int) -> None:
            super().__init__(width)

    one = Own(3)
    object.__setattr__(one, "seen", 1)
    assert Plain(1, more=2) == Plain(1, more=2) and list(inspect.signature(Own).parameters) == ["width"]
    assert copy.copy(one).seen == 1 and copy.copy(one).x == 3
    refuses(TypeError, "cannot inherit non-frozen", dataclass, type("Loose", (Point,), {}))
    with pytest.raises(TypeError, match="use dataclass"):

        @frozen
        class Hidden:
            x: int = field(default=0, init=False)


@changeable
class Tally:
    """Counts."""

    number: int = 0
    names: list[str] = field(default_factory=list)


def test_fields_of_a_changeable_class_may_be_set():
    one, other = Tally(1), Tally(names=["a"])
    other.number += 1
    assert one != other and one == replace(other, names=[]) == pickle.loads(pickle.dumps(one))
    assert repr(other) == "Tally(number=1, names=['a'])" and Tally().names is not Tally().names
    refuses(TypeError, "unhashable", hash, one)
    with pytest.raises(AttributeError):
        one.other = 1


ROOT = Path(__file__).parents[2]


def test_versions_are_those_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = {line for name in ("plot", "gis", "cluster") for line in extras[name]}
    wanted |= {line for line in extras["test"] if line.startswith("pandas")}  # only to_frame() uses it
    assert set(PACKAGES.values()) == wanted
    assert all(re.split(r"[>=]", line)[0] == name for name, line in PACKAGES.items())


@pytest.mark.parametrize(
    ("pip", "beside", "advice"),
    [
        (True, True, "pip install 'matplotlib>=3.8'"),
        (True, False, f"{sys.executable} -m pip install 'matplotlib>=3.8'"),
        (None, True, f"uv pip install --python {sys.executable} 'matplotlib>=3.8'"),
    ],
)
def test_the_python_that_runs_wavebatch_gets_it(monkeypatch, pip, beside, advice):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: pip if name == "pip" else real(name, *more))
    where = Path(sys.executable).parent / "pip" if beside else Path("/elsewhere/bin/pip")
    monkeypatch.setattr(shutil, "which", lambda name: str(where))
    assert advise_install("matplotlib") == advice


def test_no_advice_asks_the_package_index_for_wavebatch():
    """It is not there: pip would find nothing, or a stranger's package of that name."""
    places = ("wavebatch/**/*.py", "docs/**/*.md", "*.md", "examples/**/*")
    pages = [page for place in places for page in ROOT.glob(place)]
    for page in pages:
        if page.is_file():
            found = re.findall(r"pip install[^\n]*wavebatch\[[^\n]*", page.read_text("utf-8", "replace"))
            assert not found, (page, found)


class Named(NamedTuple):
    """A tuple of fields."""

    x: int
    y: float = 2.0

    @property
    def sum(self) -> float:
        """Of both fields."""
        return self.x + self.y


class Other(Named):
    """Has the fields of another."""


@pytest.mark.parametrize("kind", [Named, Other])
def test_a_named_tuple_is_like_that_of_python(kind: type[Named]) -> None:
    twin = collections.namedtuple(kind.__name__, ("x", "y"), defaults=(2.0,))  # noqa: PYI024
    for values, named in ((1, 3.0), {}), ((1,), {}), ((1,), {"y": 4.0}), ((), {"y": 4.0, "x": 1}):
        one, other = kind(*values, **named), twin(*values, **named)
        assert one == other and repr(one) == repr(other) and one._asdict() == other._asdict()
        assert (one.x, one.y, one.sum) == (*other, sum(other)) and hash(one) == hash(other)
        assert one._replace(x=7) == other._replace(x=7) and kind._make(other) == other
        for copied in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
            assert copied == one and type(copied) is kind
    for name in ("_fields", "_field_defaults", "__match_args__"):
        assert getattr(kind, name) == getattr(twin, name)
    with pytest.raises(AttributeError):
        kind(1).x = 2
    with pytest.raises(AttributeError):
        kind(1).z = 2
    for values, named in ((), {}), ((1, 2, 3), {}), ((1,), {"x": 2}), ((1,), {"z": 2}), ((), {"y": 1, "z": 2}):
        refuses(TypeError, f"{kind.__name__} takes x, y, each once", kind, *values, **named)
        with pytest.raises(TypeError):
            twin(*values, **named)


def test_classes_of_fields_keep_their_annotations() -> None:
    assert Checked.__annotations__ == {"last": "int"}
    assert {one.name: one.type for one in fields(Checked)} == inspect.get_annotations(Twin) | {"last": "int"}
