"""`bench --all-methods`: one row for every detector and decomposer."""

import json

import pytest
from bench.cases import list_cases
from bench.stability import FAILURES, measure_stability
from bench.stability_tables import format_stability
from commands import run_command

from wavebatch.stages.chain import STAGES
from wavebatch.stages.chain_file import load_profile
from wavebatch.tools.bench.command import list_methods


def test_every_method_has_a_chain():
    methods = list_methods()
    kinds = {name for name, stage in STAGES.items() if stage.kind in ("detect", "decompose")}
    assert set(methods) == kinds - {"decompose.none"}
    for name, chain in methods.items():
        stages = [step.stage.name for step in chain.steps]
        assert name in stages
        before = "detect.asdf" if name.startswith("decompose.asdf") else "detect.maximum"
        assert stages[1] == (name if name.startswith("detect") else before)


@pytest.mark.slow
def test_all_methods_stand_in_one_table(timed_here):
    options = "--scene flat --waveforms 600 --pulses 0 --repeat 1 --all-methods --json"
    result = run_command("bench", *options.split())
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row for row in json.loads(result.stdout)["scenes"][0]["rows"]}
    assert set(list_methods()) | {"fast", "balanced", "accurate"} <= set(rows)
    for name in ("detect.maximum", "detect.asdf", "decompose.gaussian", "decompose.reference"):
        assert rows[name]["figures"]["completeness"]["value"] > 0.98, name


@pytest.mark.slow
def test_every_method_goes_through_the_stiff_cases(monkeypatch):
    monkeypatch.setattr("bench.stability.GROUPS", 1)
    few = ("detect.asdf", "detect.wavelet", "decompose.residual_loop", "decompose.reference")
    methods = {name: list_methods()[name] for name in few}
    shown = {"accurate": load_profile("accurate"), **methods}
    rows = measure_stability(lambda survey: shown, 50, 300, 3, cases=list_cases(["H10", "H2"]), methods=methods)
    assert len(rows) == 4 * len(shown)
    for row in rows:
        assert row["is_method"] == (row["chain"] != "accurate")
        assert row["failures"] == dict.fromkeys(FAILURES, 0), (row["chain"], row["case"])
    rows[-1]["failures"]["negative"] = 3
    text = format_stability(rows)
    assert text.count("constant 0, 12 or 255") == 1
    table = text[text.index("every method") :].splitlines()
    assert table[0].split()[-3:] == ["H2", "H10", "failures"]
    assert [line.split()[0] for line in table[1:]] == list(methods)
    assert table[-1].endswith("3 negative")
    assert all(line.endswith("none") for line in table[1:-1])
    for line in table[1:]:
        pairs, empty = (float(cell) for cell in line.split()[1:3])
        assert pairs < 50 < empty, line
