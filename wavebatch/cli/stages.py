"""`wavebatch stages`: every algorithm, with parameters, source and an example.

The texts come from the docstrings of the stages and from `wavebatch.stages.chain.STAGES`; nothing is repeated here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli.messages import print_result, talk
from wavebatch.cli.options import common_options
from wavebatch.cli.program.command import complete_stages
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.tools.sheets.sheet import Note, Sheet

if TYPE_CHECKING:
    from wavebatch.stages.chain import Parameter, Stage


@click.command()
@click.argument("name", required=False, shell_complete=complete_stages)
@common_options("json")
def stages(name: str | None, as_json: bool, quiet: bool, debug: bool) -> None:
    """List the algorithms that a chain can use, those of one kind, or explain the one called NAME.

    Kinds are noise, detect, decompose and attribute.

    The explanation has its parameters with units and ranges, its source, and an example for a chain file.

    Exit code: 0 done, 2 no stage has this name.
    """
    from wavebatch.stages.chain import KINDS, STAGES
    from wavebatch.stages.plugins import load_plugins

    for line in load_plugins() if name not in STAGES else ():
        talk(f"warning: {line}")
    kind = name if name in KINDS else None
    if name is not None and name not in STAGES and kind is None:
        hint = nearest(name, STAGES)
        raise ConfigError(f"no stage {name!r}; {hint if '?' in hint else '`wavebatch stages` lists them'}")
    order = list(KINDS)
    one = name is not None and kind is None
    chosen = sorted(STAGES.values(), key=lambda s: (order.index(s.kind), s.name))
    chosen = [stage for stage in chosen if name in (None, stage.name, stage.kind)]
    width = max(len(stage.name) for stage in chosen)
    lines = [_explain(STAGES[name])] if one else [f"{stage.name:<{width}}  {stage.summary}" for stage in chosen]
    print_result(as_json, [_describe(stage) for stage in chosen], Sheet("stages", list(map(Note, lines))))


def _types(parameter: Parameter) -> str:
    words = {int: "integer", float: "number", bool: "true or false", str: "string", type(None): "nothing"}
    if parameter.choices:
        number = ["number"] if float in parameter.types else []
        return " or ".join([*map(repr, parameter.choices), *number])
    return " or ".join(words.get(kind, kind.__name__) for kind in parameter.types)


def _describe(stage: Stage) -> dict[str, Any]:
    """The document of a stage for --json."""
    from wavebatch.stages.chain import Step
    from wavebatch.stages.chain_file import format_step

    parameters = {
        name: {"type": _types(one), "default": one.default, "range": one.range, "meaning": one.meaning}
        for name, one in stage.parameters.items()
    }
    return {
        "name": stage.name,
        "kind": stage.kind,
        "text": stage.text,
        "makes": list(stage.makes),
        "needs": list(Step(stage).needs),
        "parameters": parameters,
        "example": format_step(stage.name, {name: one["default"] for name, one in parameters.items()}),
    }


def _explain(stage: Stage) -> str:
    """The stage as text."""
    from wavebatch.core.echoes import COLUMNS

    described = _describe(stage)
    parts = [f"{stage.name}\n\n{described['text']}"]
    if stage.makes:
        known = [COLUMNS[name] for name in stage.makes if name in COLUMNS]
        parts.append("Makes:\n" + "\n".join(f"  {c.name} [{c.unit}]: {c.meaning}" for c in known))
    if described["needs"]:
        parts.append(f"Needs: {', '.join(described['needs'])}")
    lines = []
    for name, p in described["parameters"].items():
        limits = f", {p['range'][0]:g} to {p['range'][1]:g}" if p["range"] else ""
        lines.append(f"  {name} ({p['type']}{limits}, default {p['default']}): {p['meaning']}")
    if lines:
        parts.append("Parameters:\n" + "\n".join(lines))
    parts.append("In a chain file:\n\n" + described["example"].rstrip())
    return "\n\n".join(parts)
