"""The class of all commands: help with examples and groups, and options that settings can give.

`LazyGroup` gives each command this class when it is loaded, so that a new command only declares itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import click

from wavebatch.batch.options import HEADINGS, OPTIONS
from wavebatch.cli.messages import talk
from wavebatch.cli.program.examples import ALSO_USUAL, EXAMPLES, FEWEST, GROUPS, MANY, USUAL
from wavebatch.cli.program.settings import OLD_NAMES, add_variables, drop_rivals, read_settings, tell_settings

MAYBE_NAN = ("no_data",)
"""Options whose number may be NaN."""


class ProgramCommand(click.Command):
    """A command with its examples."""

    title: str = ""
    """Name with that of its group, e.g. `plot map`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments; options that they do not give come from settings, if there are any.

        Numbers must be finite, because no limit of an option holds for NaN.
        """
        args = [self._rename(word) for word in args]
        is_real = not ctx.resilient_parsing and {"-h", "--help"}.isdisjoint(args)
        if is_real:
            read_settings(self, self.title, ctx, args)
        rest = super().parse_args(ctx, args)
        for option in self.params:
            value = ctx.params.get(option.name or "")
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number) and option.name not in MAYBE_NAN:
                    raise click.BadParameter(f"{number} is not a finite number.", ctx, option)
        if is_real:
            drop_rivals(ctx)
            tell_settings(ctx)
        return rest

    def _rename(self, word: str) -> str:
        """A word of the command line with the new name of an option, and a remark."""
        old, mark, value = word.partition("=")
        new = OLD_NAMES.get(old, "")
        names = {name for option in self.params for name in option.opts}
        if new not in names or old in names:
            return word
        talk(f"remark: {old} is now {new}; the old name goes with the next version")
        return new + mark + value

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
    """Headings, and names and texts of their options; every option once.

    A page of very many options begins with those that most users need.
    """
    shown = [option for option in command.get_params(ctx) if isinstance(option, click.Option)]
    names = ["help" if "--help" in option.opts else option.name for option in shown]
    found = zip(names, (option.get_help_record(ctx) for option in shown), strict=True)
    records = {name: record for name, record in found if record}
    if len(records) < FEWEST:
        yield "Options", list(records.values())
        return
    heading = {name: one.words.group for name, one in OPTIONS.items()}
    heading |= {name: title for title, names in GROUPS.items() for name in names}
    if len(records) > MANY:
        heading |= {name: USUAL for name, one in OPTIONS.items() if one.words.usual} | dict.fromkeys(ALSO_USUAL, USUAL)
    of = getattr(command, "title", "")
    for title in ("Options", USUAL, *HEADINGS):
        found = [record for name, record in records.items()
                 if heading.get(f"{of} {name}", heading.get(name, "Options")) == title]  # fmt: skip
        if found:
            yield title, found


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
    add_variables(dressed, title)
    return dressed
