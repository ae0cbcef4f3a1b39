"""Defaults of options from outside of the command line: WAVEBATCH_* variables, and wavebatch.toml beside the strips.

An option on the command line counts first, then the variable, then the file, then the default. `ProgramCommand` asks
here before it parses. What changes results is never silent: the settings in force are printed in one line.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from wavebatch.core.errors import ConfigError

FILE = "wavebatch.toml"
PREFIX = "WAVEBATCH_"

READ = "wavebatch.settings_read"
"""Key of a context's `meta`: names of the files from which settings are in force."""

NEVER = ("overwrite", "force", "help", "debug")
"""Options that are given on the command line only: they may destroy files, or hide that a result is wrong."""

IN_NO_FILE = {"run": ("report", "resume", "scheduler")}
"""Options by command that replace files without --overwrite, or trust other machines: wavebatch.toml may have come with
the data."""

EXCLUSIVE = (
    ("chain_file", "profile", "tolerance"), ("overwrite", "resume"), ("quiet", "verbose"), ("scheduler", "jobs"),
    ("scheduler", "memory"), ("attenuation", "visibility"), ("trajectory", "flight_height"),
)  # fmt: skip
"""Options of which only one is possible: one on the command line, or in a variable, takes the place of the others in
what counts less."""

_INPUTS = ("strips", "strip", "clouds", "files", "cloud", "a")
"""Names of the arguments that are files to read; settings lie beside the first."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Values of options from outside of the command line."""

    values: Mapping[str, Any]
    """By name of the parameter."""
    sources: Mapping[str, str]
    """Where each comes from."""
    names: Mapping[str, str]
    """The option of each."""

    def lines(self) -> Iterator[str]:
        """One text per setting: option, value and source."""
        for name, value in self.values.items():
            yield f"{self.names[name]} {value} ({self.sources[name]})"

    def tell(self, context: click.Context) -> None:
        """Print the settings in one line, and keep them for --dry-run.

        With --quiet those of a file are printed still: who types the command may not know of the file.
        """
        from wavebatch.cli.messages import talk

        context.meta["wavebatch.settings"] = tuple(self.lines())
        context.meta[READ] = [source for source in self.sources.values() if not source.startswith(PREFIX)]
        shown = [line for name, line in zip(self.values, self.lines(), strict=True)
                 if not context.params.get("quiet") or not self.sources[name].startswith(PREFIX)]  # fmt: skip
        if shown:
            talk(f"settings: {', '.join(shown)}")


def find_settings(command: click.Command, arguments: list[str]) -> Settings | None:
    """The settings for a command with these arguments; None without any. Raises click's errors for wrong ones."""
    context = click.Context(command)
    try:
        parsed, _, order = command.make_parser(context).parse_args(list(arguments))
    except click.UsageError:
        return None  # the real parsing says what is wrong
    options = {one.name: one for one in command.params if isinstance(one, click.Option)}
    given = {one.name for one in order if one.name in options}
    path = _find_file(parsed)
    in_file = {} if path is None else _read_file(path, command, options)
    found = {name: (value, str(path)) for name, value in in_file.items()}
    in_variables = {name: (value, variable) for name, variable, value in _read_variables(command, options)}
    found = {**_without_rivals(found, in_variables), **in_variables}
    found = _without_rivals({name: one for name, one in found.items() if name not in given}, given)
    if not found:
        return None
    values, sources = ({name: one[place] for name, one in found.items()} for place in (0, 1))
    return Settings(values, sources, {name: _option_name(options[name]) for name in values})


def _without_rivals(found: Mapping[str, Any], stronger: Iterable[str]) -> dict[str, Any]:
    """The settings without those that exclude one of the names that count more."""
    names = set(stronger)
    taken = {name for rivals in EXCLUSIVE if names & set(rivals) for name in rivals if name not in names}
    return {name: value for name, value in found.items() if name not in taken}


def _option_name(option: click.Option) -> str:
    return max(option.opts, key=len)


def _find_file(parsed: Mapping[str, Any]) -> Path | None:
    """wavebatch.toml in the folder of the inputs; ConfigError where they lie in folders with different ones."""
    words: list[str] = []
    for name in _INPUTS:
        value = parsed.get(name)
        words += [value] if isinstance(value, str) else list(value) if isinstance(value, tuple | list) else []
    found = {}
    for word in words:
        folder = _folder(word)
        path = folder / FILE
        # os.path.isfile is false for names that the system refuses, such as one that is too long: `run` says so.
        found[os.path.realpath(path) if os.path.isfile(path) else ""] = path
    if len(found) > 1:
        files = ", ".join(str(path) for key, path in found.items() if key)
        raise click.UsageError(f"the inputs lie in folders with different settings ({files}); run them one by one")
    return next((path for key, path in found.items() if key), None)


def _folder(word: str) -> Path:
    """The folder of an argument: a file, a folder, a pattern, or @list.txt."""
    word = word.removeprefix("@")
    if os.path.isdir(word):
        return Path(word)
    parent = Path(word).parent
    while glob.has_magic(str(parent)):
        parent = parent.parent
    return parent


def _read_file(path: Path, command: click.Command, options: Mapping[str, click.Option]) -> dict[str, Any]:
    """Values of the command's table in the file, by name of the parameter; ConfigError becomes wrong usage."""
    from wavebatch.core.suggest import nearest
    from wavebatch.files.text_file import read_text
    from wavebatch.files.toml_file import parse_toml

    try:
        table: Any = parse_toml(read_text(path, "settings file"), str(path)).values
    except ConfigError as error:
        raise click.UsageError(str(error)) from error
    for part in _title(command).split():
        table = table.get(part, {}) if isinstance(table, dict) else {}
    if not isinstance(table, dict):
        raise click.UsageError(f"{path}: [{_title(command)}] must be a table of options")
    known = {_option_name(one).removeprefix("--"): name for name, one in options.items()}
    found = {}
    for key, value in table.items():
        if isinstance(value, dict) or isinstance(command, click.Group):
            continue
        if key not in known:
            raise click.UsageError(f"{path}: [{_title(command)}] has no option {key!r}; {nearest(key, list(known))}")
        if known[key] in NEVER:
            raise click.UsageError(f"{path}: {key} can be given on the command line only; remove it from the file")
        if known[key] in IN_NO_FILE.get(_title(command), ()):
            where = "on the command line or in a variable only, since the file may have come with the data"
            raise click.UsageError(f"{path}: {key} can be given {where}; remove it")
        found[known[key]] = _convert(value, options[known[key]], path)
    return found


def _convert(value: Any, option: click.Option, path: Path) -> Any:
    """A value of TOML as the option takes it; paths are relative to the file."""
    if isinstance(option.type, click.Path) and isinstance(value, str) and value != "-":
        return str(path.parent / value)
    if isinstance(value, list):
        return [str(one) for one in value] if option.multiple else ",".join(map(str, value))
    return value if isinstance(value, bool) else str(value)


def _read_variables(
    command: click.Command, options: Mapping[str, click.Option]
) -> Iterator[tuple[str, str, str | list[str]]]:
    """Name, variable and value: WAVEBATCH_RUN_JOBS counts before WAVEBATCH_JOBS."""
    title = _title(command).upper().replace(" ", "_")
    for name, option in options.items():
        if name in NEVER:
            continue
        words = _option_name(option).removeprefix("--").upper().replace("-", "_")
        for variable in (f"{PREFIX}{title}_{words}", f"{PREFIX}{words}"):
            value = os.environ.get(variable)
            if value:
                yield name, variable, value.split() if option.multiple else value
                break


def _title(command: click.Command) -> str:
    return getattr(command, "title", "") or command.name or ""
