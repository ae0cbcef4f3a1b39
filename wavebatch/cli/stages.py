"""`wavebatch stages`: every algorithm, with parameters, source and an example."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli.messages import debug_option, print_json, report_errors, talk
from wavebatch.cli.options import json_option
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest

if TYPE_CHECKING:
    from wavebatch.stages.chain import Parameter, Stage


@click.command()
@click.argument("name", required=False)
@json_option("For programs.")
@debug_option
@report_errors()
def stages(name: str | None, as_json: bool, debug: bool) -> None:
    """The algorithms that a chain is made of: all of them, or one with its parameters, source and a TOML example."""
    from wavebatch.stages.chain import KINDS, STAGES
    from wavebatch.stages.plugins import load_plugins

    for line in load_plugins() if name not in STAGES else ():
        talk(f"warning: {line}")
    if name is not None and name not in STAGES:
        told = nearest(name, STAGES)
        raise ConfigError(f"no stage {name!r}; {told if '?' in told else '`wavebatch stages` lists them'}")
    order = list(KINDS)
    chosen = [STAGES[name]] if name else sorted(STAGES.values(), key=lambda s: (order.index(s.kind), s.name))
    if as_json:
        print_json([_describe(stage) for stage in chosen])
    elif name:
        click.echo(_explain(STAGES[name]))
    else:
        width = max(len(stage.name) for stage in chosen)
        for stage in chosen:
            click.echo(f"{stage.name:<{width}}  {stage.summary}")


def _types(parameter: Parameter) -> str:
    if parameter.choices:
        return " or ".join(repr(choice) for choice in parameter.choices)
    words = {int: "integer", float: "number", bool: "true or false", str: "string", type(None): "nothing"}
    return " or ".join(words.get(kind, kind.__name__) for kind in parameter.types)


def _describe(stage: Stage) -> dict[str, Any]:
    from wavebatch.stages.chain_file import format_step

    defaults = {name: parameter.default for name, parameter in stage.parameters.items()}
    return {
        "name": stage.name,
        "kind": stage.kind,
        "text": stage.text,
        "makes": list(stage.makes),
        "needs": list(stage.needs),
        "parameters": {
            name: {
                "type": _types(parameter),
                "default": parameter.default,
                "range": parameter.range,
                "meaning": parameter.meaning,
            }
            for name, parameter in stage.parameters.items()
        },
        "example": format_step(stage.name, defaults),
    }


def _explain(stage: Stage) -> str:
    from wavebatch.core.echoes import COLUMNS

    told = _describe(stage)
    parts = [f"{stage.name}\n\n{told['text']}"]
    if stage.makes:
        known = [COLUMNS[name] for name in stage.makes if name in COLUMNS]
        parts.append("Makes:\n" + "\n".join(f"  {c.name} [{c.unit}]: {c.meaning}" for c in known))
    if stage.needs:
        parts.append(f"Needs: {', '.join(stage.needs)}")
    if told["parameters"]:
        lines = []
        for name, p in told["parameters"].items():
            limits = f", {p['range'][0]:g} to {p['range'][1]:g}" if p["range"] else ""
            lines.append(f"  {name} ({p['type']}{limits}, default {p['default']}): {p['meaning']}")
        parts.append("Parameters:\n" + "\n".join(lines))
    parts.append("In a chain file:\n\n" + told["example"].rstrip())
    return "\n\n".join(parts)
