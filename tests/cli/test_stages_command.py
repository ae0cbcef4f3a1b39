"""`wavebatch stages`: every algorithm can be looked up, and its example is a chain that loads."""

import json

import pytest
from commands import run_command

from wavebatch.stages.chain import STAGES, Step
from wavebatch.stages.chain_file import effective, parse_chain


def _invoke(*arguments):
    return run_command("stages", *arguments)


def test_the_list_has_every_stage_with_its_summary():
    result = _invoke()
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert len(lines) == len(STAGES)
    for stage in STAGES.values():
        assert any(line.split()[0] == stage.name and stage.summary in line for line in lines)


PARTNERS = {
    "decompose.asdf_only": {"detect": "detect.asdf"}, "decompose.asdf_mixed": {"detect": "detect.asdf"},
    "attribute.skew": {"decompose": "decompose.skewed"},
}  # fmt: skip
"""Stages that refuse a chain without another one; their texts say which."""
MORE = {"attribute.skew": {"decompose": 'kappa = "free"\n'}}
"""Parameters that it must have."""


@pytest.mark.parametrize("name", sorted(STAGES))
def test_one_stage_shows_parameters_defaults_and_an_example_that_loads(name):
    text = _invoke(name).stdout
    for parameter in STAGES[name].parameters.values():
        assert f"{parameter.name} (" in text and f"default {parameter.default}" in text
        assert parameter.meaning in text
    example = text[text.index("[[chain]]") :]
    others = {kind: next(s for s in STAGES if s.startswith(kind)) for kind in ("noise", "detect", "decompose")}
    others |= PARTNERS.get(name, {})
    kind = name.split(".")[0]
    more = MORE.get(name, {})
    tables = [
        example if k == kind else f'[[chain]]\nstage = "{other}"\n{more.get(k, "")}' for k, other in others.items()
    ]
    if kind == "attribute":
        makers = {s.name for column in Step(STAGES[name]).needs for s in STAGES.values() if column in s.makes}
        ordered = sorted(makers, key=lambda maker: maker != "attribute.position")
        tables += [*(f'[[chain]]\nstage = "{maker}"\n' for maker in ordered), example]
    assert all(other in text for other in PARTNERS.get(name, {}).values())
    chain = parse_chain("\n".join(tables), "example")
    assert example.strip() in effective(chain)


def test_json_for_programs():
    told = json.loads(_invoke("--json").stdout)
    assert {stage["name"] for stage in told} == set(STAGES)
    one = json.loads(_invoke("detect.maximum", "--json").stdout)[0]
    assert one["parameters"]["threshold"]["default"] == STAGES["detect.maximum"].parameters["threshold"].default


def test_an_unknown_stage_names_the_nearest():
    result = _invoke("detect.maximun")
    assert result.exit_code == 2 and "did you mean 'detect.maximum'" in result.stderr
    nothing_like_it = _invoke("xyzzy")
    assert nothing_like_it.exit_code == 2 and nothing_like_it.stderr.endswith("; `wavebatch stages` lists them\n")
