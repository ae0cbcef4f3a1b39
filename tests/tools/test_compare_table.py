"""`wavebatch compare -o FILE.csv`: every figure of the comparison is a row, and says what the JSON document says."""

import csv
import json

import pytest
from commands import run_command

from wavebatch.tools.sheets.compare import HEAD, format_comparison


def run(*words):
    return run_command("compare", *words)


def read(path):
    with path.open(newline="") as file:
        return {tuple(row[name] for name in HEAD[:5]): row["value"] for row in csv.DictReader(file)}


def test_rows_are_the_figures_of_the_document(tmp_path, tiny_strip):
    target = tmp_path / "t.csv"
    result = run("fast", "balanced", "--strip", tiny_strip, "--limit", 200, "-o", target, "--json")
    assert result.exit_code == 0, result.output
    found, document = read(target), json.loads(result.stdout)
    between = document
    assert float(found["all", "", "", "", "completeness"]) == pytest.approx(between["completeness"])
    for number, pulses in between["counts_a"].items():
        assert int(found["echoes per pulse", "A", "", number, "pulses"]) == pulses
    for kind, classes in between["missed_by"].items():
        for name, (alone, of) in classes.items():
            assert int(found["missed", "B", kind, name, "echoes"]) == alone
            assert float(found["missed", "B", kind, name, "share"]) == pytest.approx(alone / of)
    for side in "ab":
        title = f"all, {side.upper()} and the vendor's returns"
        assert int(found[title, "", "", "", "matched"]) == document["vendor"][side]["matched"]
    for name, spread in between["differences"].items():
        assert float(found["differences", "", "", name, "rms"] or "nan") == pytest.approx(
            float("nan") if spread["rms"] is None else spread["rms"], nan_ok=True
        )
    assert set(between["differences_by"]["echoes"]) >= {"1", "2"}
    for group, quantities in between["differences_by"]["echoes"].items():
        for quantity, spread in quantities.items():
            rows = {
                key[4]: value
                for key, value in found.items()
                if key[:4] == ("differences by echoes", "", group, quantity)
            }
            assert int(rows["number"]) == spread["number"]
            assert float(rows["mean"]) == pytest.approx(spread["mean"])
    assert not any("(" in value for value in found.values())
    refused = run("fast", "balanced", "--strip", tiny_strip, "--limit", 200, "-o", target)
    assert refused.exit_code == 2 and "--overwrite" in refused.stderr


def test_no_data_is_an_empty_cell():
    text = format_comparison({"gain": float("nan"), "errors": {"all": {"time": {"bias": None, "number": 3}}}})
    assert text.splitlines()[1:] == ["all,,,,gain,", "errors,,all,time,bias,", "errors,,all,time,number,3"]
