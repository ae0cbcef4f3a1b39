"""The class of all commands: help with examples and groups, and options that settings can give.

`LazyGroup` gives each command this class when it is loaded, so that a new command only declares itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import click

from wavebatch.cli.program.examples import EXAMPLES, FEWEST, GROUPS
from wavebatch.cli.program.settings import find_settings

MAYBE_NAN = ("no_data",)
"""Options whose number may be NaN."""


class ProgramCommand(click.Command):
    """A command with its examples."""

    title: str = ""
    """Name with that of its group, e.g. `plot map`."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> click.Context:
        """Parses the arguments; options that they do not give come from settings, if there are any."""
        wants_help = not {"-h", "--help"}.isdisjoint(args)
        settings = None if wants_help or extra.get("resilient_parsing") else find_settings(self, args)
        if settings is None or not settings.values:
            return super().make_context(info_name, args, parent, **extra)
        context = super().make_context(info_name, args, parent, **{**extra, "default_map": settings.values})
        settings.tell(context)
        return context

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments; numbers must be finite, because no limit of an option holds for NaN."""
        rest = super().parse_args(ctx, args)
        for option in self.params:
            value = ctx.params.get(option.name or "")
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number) and option.name not in MAYBE_NAN:
                    raise click.BadParameter(f"{number} is not a finite number.", ctx, option)
        return rest

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the options by group, then the examples."""
        for heading, records in group_options(self, ctx):
            with formatter.section(heading):
                formatter.write_dl(records)
        examples = EXAMPLES.get(self.title, ())
        if examples:
            with formatter.section("Examples"):
                for line, purpose in examples:
                    formatter.write_text(f"# {purpose}")
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")


def group_options(command: click.Command, ctx: click.Context) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Headings, and names and texts of their options; every option once."""
    shown = (option for option in command.get_params(ctx) if isinstance(option, click.Option))
    records = {option.opts[-1]: record for option in shown if (record := option.get_help_record(ctx))}
    names = {option.opts[-1]: option.name for option in command.get_params(ctx)} | {"--help": "help"}
    if len(records) < FEWEST:
        yield "Options", list(records.values())
        return
    grouped = {name for members in GROUPS.values() for name in members}
    rest = [record for key, record in records.items() if names[key] not in grouped]
    if rest:
        yield "Options", rest
    for heading, members in GROUPS.items():
        found = [record for key, record in records.items() if names[key] in members]
        if found:
            yield heading, found


def dress(command: click.Command, title: str) -> click.Command:
    """The command as a ProgramCommand; a group keeps its class, and its commands become such."""
    if isinstance(command, click.Group):
        command.commands = {name: dress(one, f"{title} {name}") for name, one in command.commands.items()}
        return command
    if isinstance(command, ProgramCommand):
        return command
    names = ("name", "context_settings", "callback", "params", "help", "epilog", "short_help", "options_metavar",
             "add_help_option", "no_args_is_help", "hidden", "deprecated")  # fmt: skip
    dressed = ProgramCommand(**{name: getattr(command, name) for name in names})
    dressed.title = title
    return dressed
