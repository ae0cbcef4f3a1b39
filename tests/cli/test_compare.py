"""`wavebatch compare`: figures, thresholds and exit codes."""

import csv
import json
import re

import pytest
from click.testing import CliRunner
from commands import succeed
from html_tools import Page

import wavebatch as wb
from wavebatch.cli.compare import compare
from wavebatch.tools.simulate import simulate_strip

NAMES = ("median", "mean", "rms", "nmad")


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("strips")
    for name, seed in (("a", 1), ("b", 2)):
        simulate_strip("mixed", folder / f"{name}.las", pulses=600, seed=seed, truth=folder / f"{name}.npz")
    return folder


def run(*arguments):
    return CliRunner().invoke(compare, [str(argument) for argument in arguments])


def test_a_strip_with_itself_is_identical(strips):
    limits = ("--min-completeness", 1, "--min-correctness", 1, "--max-rmse", 0)
    result = succeed("compare", strips / "a.las", strips / "a.las", *limits)
    shown = result.stdout.splitlines()
    assert {"missed            0", "extra             0", "completeness      1.0000"} <= set(shown)


def test_json_holds_every_figure_and_no_nan(strips):
    result = succeed("compare", strips / "a.las", "--truth", strips / "a.npz", "--json")
    assert "NaN" not in result.stdout
    figures = json.loads(result.stdout)
    assert figures["missed"] == figures["echoes_b"] - figures["matched"]
    assert figures["errors"]["isolated"]["time"]["number"] > 200
    assert figures["errors"]["isolated"]["amplitude"]["rmse"] is None
    assert sum(figures["counts_b"].values()) == figures["pulses"]
    assert figures["tolerance_ns"] == 1.5


@pytest.mark.parametrize(
    ("option", "value", "code"),
    [
        ("--min-completeness", 0.7, 0),
        ("--min-completeness", 0.97, 1),
        ("--min-correctness", 0.99, 0),
        ("--min-exact", 0.5, 0),
        ("--min-exact", 0.98, 1),
        ("--max-rmse", 0.1, 0),
        ("--max-rmse", 0.0001, 1),
        ("--max-nmad", 0.0001, 1),
        ("--max-median", 0.01, 0),
    ],
)
def test_thresholds_set_the_exit_code(strips, option, value, code):
    result = run(strips / "a.las", "--truth", strips / "a.npz", option, value)
    assert result.exit_code == code, result.output
    assert (option in result.stderr) == bool(code)


def test_a_figure_that_does_not_exist_meets_no_threshold(strips):
    result = run(strips / "a.las", "--truth", strips / "b.npz", "--within", 1e-6, "--max-rmse", 5)
    assert result.exit_code == 1
    assert "has nan" in result.stderr


def test_text_table_and_page_have_the_classes_and_the_numbers_of_echoes(strips, tmp_path):
    """Ground and plants of two simulated strips: the same figures everywhere."""
    files = ("-o", tmp_path / "t.csv", "--html", tmp_path / "p.html")
    result = succeed("compare", strips / "a.las", strips / "b.las", "--json", *files)
    document = json.loads(result.stdout)
    text = run(strips / "a.las", strips / "b.las").stdout
    shown = Page(tmp_path / "p.html").check()
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = {tuple(row.values())[:5]: row["value"] for row in csv.DictReader(file)}
    assert "A - B by class " in text and "A - B by echoes" in text
    for kind, groups in document["differences_by"].items():
        assert len(groups) > 1 and sum(one["time"]["number"] for one in groups.values()) == document["matched"]
        for group, quantities in groups.items():
            one = quantities["time"]
            title = group if kind == "class" else f"{group} of the pulse"
            (line,) = [line for line in text.splitlines() if re.match(rf"  {title} +time ns ", line)]
            values = [str(one["number"]), *(f"{one[name]:.4f}" for name in NAMES)]
            assert line.split() == [*title.split(), "time", "ns", *values]
            assert rows[f"differences by {kind}", "", group, "time", "number"] == str(one["number"])
            row = next(row for row in shown.rows if row[:2] == [title, "time ns"])
            assert row[2] == f"{one['number']:,}"


def test_a_truth_says_whose_times_it_tests(strips):
    wb.run([strips / "a.las"], strips / "out", columns="+echo_time", profile="fast", overwrite=True)
    for cloud, said in ((strips / "a.las", True), (strips / "out" / "a.laz", False)):
        shown = run(cloud, "--truth", strips / "a.npz").stdout
        assert ("`run --columns +echo_time` adds" in shown) is said
        assert bool(re.search("  isolated +echo_time", shown)) is not said


def test_a_truth_is_compared_at_the_chosen_points(strips):
    whole, some = (
        json.loads(run(strips / "a.las", "--truth", strips / "a.npz", "--json", *more).stdout)
        for more in ((), ("--where", "return_number == 1"))
    )
    assert some["echoes_b"] == whole["echoes_b"] and some["left_out_a"] > 0 == whole["left_out_a"]
    assert 0 < some["echoes_a"] < whole["echoes_a"]
    assert some["correctness"] >= whole["correctness"] - 0.01 and some["completeness"] < whole["completeness"]
