"""Every sentence of docs/reliability.md, "What can be relied on", has its tests: tests/reliability_tests.txt."""

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HELD = ROOT / "tests" / "reliability_tests.txt"


def split_sentences(text):
    """The sentences of a Markdown text, each on one line; rows of a table and items of a list are split too."""
    text = re.sub(r"```.*?```|(?m:^    [^\n]*$)", "", text, flags=re.DOTALL)
    found = []
    for block in re.split(r"\n\s*\n|\n(?=- |\|)", text):
        line = " ".join(block.split())
        if line and not line.startswith("#") and not set(line) <= set("|- "):
            found += re.split(r"(?<=[.])\s+(?=[A-Z`*-])", line.removeprefix("- "))
    return found


def read_held():
    """The tests of each sentence."""
    held = {}
    for line in HELD.read_text("utf-8").splitlines():
        if line.startswith("    "):
            held[sentence].append(line.strip())  # noqa: F821 - of the line before
        elif line and not line.startswith("#"):
            sentence = line
            assert sentence not in held, sentence
            held[sentence] = []
    return held


def test_every_sentence_of_what_can_be_relied_on_has_its_tests():
    sentences = split_sentences((ROOT / "docs" / "reliability.md").read_text("utf-8"))
    held = read_held()
    missing = [sentence for sentence in sentences if sentence not in held]
    assert not missing, f"no test is named for {missing}; add the sentence and its tests to {HELD.name}"
    gone = [sentence for sentence in held if sentence not in sentences]
    assert not gone, f"no sentence of the document any more: {gone}"
    assert all(held.values()), [sentence for sentence, tests in held.items() if not tests]


@functools.cache
def _tree(path):
    return ast.parse(path.read_text("utf-8"))


def test_the_named_tests_exist_and_assert_something():
    for sentence, tests in read_held().items():
        for test in tests:
            if test.startswith("fact: "):
                continue
            path, _, name = test.partition("::")
            tree = _tree(ROOT / path)
            found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
            found = [node for node in found if not name or node.name == name]
            assert found, f"{test}, which should hold {sentence!r}, is not there"
            for node in found:
                helpers = {one.name for one in tree.body if isinstance(one, ast.FunctionDef) and _asserts(one)}
                calls = {ast.unparse(one.func) for one in ast.walk(node) if isinstance(one, ast.Call)}
                assert _asserts(node) or calls & {"pytest.raises", *helpers}, f"{test} asserts nothing"
                marks = " ".join(map(ast.unparse, node.decorator_list))
                assert "mark.skip(" not in marks and "xfail" not in marks, f"{test} does not run"


def _asserts(node):
    return any(isinstance(one, ast.Assert) for one in ast.walk(node))
