"""`bench --all-methods`: one row for every detector and decomposer."""

import json

from click.testing import CliRunner

from wavebatch.bench.methods import list_methods
from wavebatch.chain import STAGES
from wavebatch.cli import main


def test_every_method_has_a_chain():
    methods = list_methods()
    kinds = {name for name, stage in STAGES.items() if stage.kind in ("detect", "decompose")}
    assert set(methods) == kinds - {"decompose.none"}
    for name, chain in methods.items():
        stages = [step.stage.name for step in chain.steps]
        assert name in stages
        assert stages[1] == (name if name.startswith("detect") else "detect.maximum")


def test_all_methods_stand_in_one_table():
    options = "--scene flat --waveforms 600 --pulses 0 --repeat 1 --no-peers --no-stability --all-methods --json"
    result = CliRunner().invoke(main, ["bench", *options.split()])
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row for row in json.loads(result.stdout)["scenes"][0]["rows"]}
    assert set(list_methods()) | {"fast", "balanced", "accurate"} <= set(rows)
    for name in ("detect.maximum", "detect.asdf", "decompose.gauss_newton", "decompose.reference"):
        assert rows[name]["figures"]["completeness"]["value"] > 0.98, name
