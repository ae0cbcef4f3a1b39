"""`--version`, and the manual pages of `--man-pages`: written from the same declarations as --help."""

from __future__ import annotations

import inspect
import platform
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import click

from wavebatch import __version__
from wavebatch.cli.program.command import EXAMPLES, group_options

LIBRARIES = ("numpy", "scipy", "laspy", "lazrs")
"""Libraries on which results and files depend."""


def describe_version() -> str:
    """Version of wavebatch, of Python and of the libraries; nothing is imported for it."""
    lines = [f"wavebatch {__version__}", f"Python {platform.python_version()}"]
    for name in LIBRARIES:
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            lines.append(f"{name} is not installed")
    return "\n".join(lines)


def write_man_pages(group: click.Group, folder: Path) -> list[Path]:
    """Write wavebatch.1 and a page per command into a folder, over older ones; returns their names."""
    from wavebatch.files.text_file import write_text

    folder.mkdir(parents=True, exist_ok=True)
    top = click.Context(group, info_name="wavebatch")
    pages = {"wavebatch": _front_page(group, top)}
    for name in group.list_commands(top):
        command = group.get_command(top, name)
        if command is not None:
            pages |= dict(_pages(command, click.Context(command, info_name=name, parent=top), name))
    for name, text in pages.items():
        write_text(folder / f"{name}.1", text, overwrite=True)
    return [folder / f"{name}.1" for name in pages]


def _pages(command: click.Command, ctx: click.Context, title: str) -> Iterator[tuple[str, str]]:
    yield f"wavebatch-{title.replace(' ', '-')}", _page(command, ctx, title)
    if isinstance(command, click.Group):
        for name, one in command.commands.items():
            yield from _pages(one, click.Context(one, info_name=name, parent=ctx), f"{title} {name}")


def _heading(name: str) -> str:
    return f'.TH "{name.upper()}" "1" "" "wavebatch {__version__}" "wavebatch"'


def _front_page(group: click.Group, ctx: click.Context) -> str:
    lines = [_heading("wavebatch"), ".SH NAME", f"wavebatch \\- {roff(_first_line(group.help))}", ".SH SYNOPSIS",
             ".B wavebatch", "COMMAND [OPTIONS] ...", ".SH COMMANDS"]  # fmt: skip
    for name in group.list_commands(ctx):
        command = group.get_command(ctx, name)
        text = _first_line(None if command is None else command.help)
        lines += [".TP", f"\\fB{roff(f'wavebatch-{name}(1)')}\\fR", roff(text)]
    return "\n".join([*lines, *_options(group, ctx), *SETTINGS_PAGE]) + "\n"


SETTINGS_PAGE = (
    ".SH ENVIRONMENT",
    "WAVEBATCH_OPTION is the default of an option of every command, WAVEBATCH_COMMAND_OPTION that of one command, for "
    "example WAVEBATCH_RUN_JOBS=4.",
    ".SH FILES",
    "A settings file holds defaults of options in a table per command, for example [run] with jobs = 4. That of "
    "--config FILE or WAVEBATCH_CONFIG is the only one; without it, wavebatch.toml beside the inputs counts before "
    "that in the folder for settings of the user. The one beside the inputs can change numbers only. "
    "Options on the command line count first, then variables, then files.",
)


def _page(command: click.Command, ctx: click.Context, title: str) -> str:
    name = f"wavebatch-{title.replace(' ', '-')}"
    lines = [_heading(name), ".SH NAME", f"{roff(name)} \\- {roff(_first_line(command.help))}", ".SH SYNOPSIS",
             f"\\fB{roff(ctx.command_path)}\\fR {roff(' '.join(command.collect_usage_pieces(ctx)))}",
             ".SH DESCRIPTION", *_describe(command.help or ""), *_options(command, ctx)]  # fmt: skip
    examples = EXAMPLES.get(title, ())
    if examples:
        lines.append(".SH EXAMPLES")
        for line, purpose in examples:
            words = f"{purpose[:1].upper()}{purpose[1:]}:"
            lines += [".PP", roff(words), ".PP", ".nf", ".RS", roff(line), ".RE", ".fi"]
    return "\n".join([*lines, ".SH SEE ALSO", "\\fBwavebatch\\fR(1)"]) + "\n"


def _options(command: click.Command, ctx: click.Context) -> Iterator[str]:
    for heading, records in group_options(command, ctx):
        yield f".SH {heading.upper()}"
        for names, text in records:
            yield from (".TP", f"\\fB{roff(names)}\\fR", roff(" ".join(text.split())))


def _describe(text: str) -> Iterator[str]:
    """Paragraphs; those that click must not wrap (\\b) keep their lines."""
    for part in re.split(r"\n\s*\n", inspect.cleandoc(text).replace("\f", "")):
        yield ".PP"
        if part.startswith("\b"):
            yield from (".nf", *(roff(line) for line in part.lstrip("\b\n").splitlines()), ".fi")
        else:
            yield roff(" ".join(part.split()))


def _first_line(text: str | None) -> str:
    return " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split()).rstrip(".")


def roff(text: str) -> str:
    """Text without a meaning for roff: backslashes, hyphens, and dots and quotes that begin a line."""
    plain = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{plain}" if plain[:1] in (".", "'") else plain
