"""Defaults of options from outside of the command line: WAVEBATCH_* variables, and wavebatch.toml beside the strips.

Click reads both (`envvar` of an option, `default_map` of a context): an option on the command line counts first, then
the variable, then the file, then the default. Here is what click lacks: where the file lies, what it must not give
because it may have come with the data, and what is said of it. What changes results is never silent: the settings in
force are printed in one line.
"""

from __future__ import annotations

import difflib
import glob
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from wavebatch.batch.options import EXCLUSIVE
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest

FILE = "wavebatch.toml"
PREFIX = "WAVEBATCH_"

READ = "wavebatch.settings_read"
"""Key of a context's `meta`: the file that was read."""

_ORDER = (ParameterSource.COMMANDLINE, ParameterSource.ENVIRONMENT, ParameterSource.DEFAULT_MAP)
"""What counts first."""

NEVER = ("overwrite", "force", "help", "debug")
"""Options that are given on the command line only: they may destroy files, or hide that a result is wrong."""

IN_NO_FILE = {"run": ("report", "resume", "scheduler"), "import": ("resume",)}
"""Options by command that replace files without --overwrite, or trust other machines: wavebatch.toml may have come with
the data."""

SIMILAR = 0.74
"""Least similarity of a variable that no command reads to one that is read, for a warning: JBOS to JOBS is 0.75."""

OLD_NAMES = {"--bounds": "--bbox", "--polygons": "--polygon", "--flags-with": "--flags",
             "--flags-without": "--drop-flags", "--pulse-energy": "--energy", "--tolerance": "--within"}  # fmt: skip
"""Names of earlier versions, and what they are now."""

_INPUTS = ("strips", "strip", "clouds", "files", "cloud", "a")
"""Names of the arguments that are files to read; settings lie beside the first."""


def add_variables(command: click.Command, title: str) -> None:
    """Let each option of a command be given by a variable: WAVEBATCH_RUN_JOBS counts before WAVEBATCH_JOBS."""
    for option in command.params:
        if isinstance(option, click.Option) and option.name not in NEVER:
            words = re.sub("[- ]", "_", f"{title} {_option_name(option)}").upper()
            general = _option_name(option).replace("-", "_").upper()
            own = [option.envvar] if isinstance(option.envvar, str) else []
            option.envvar = [*own, f"{PREFIX}{words}", f"{PREFIX}{general}"]


def read_settings(command: click.Command, title: str, context: click.Context, arguments: list[str]) -> None:
    """Take the command's table of wavebatch.toml beside the inputs as defaults; click's errors for a wrong one."""
    try:
        parsed, _, _ = command.make_parser(click.Context(command)).parse_args(list(arguments))
    except click.UsageError:
        return  # the real parsing says what is wrong
    path = _find_file(parsed)
    if path is not None:
        context.meta[READ] = path
        context.default_map = _read_file(path, title, _list_options(command))


def drop_rivals(context: click.Context) -> None:
    """Put settings aside that exclude an option that counts more: of the command line, or of a variable."""
    options = {one.name: one for one in context.command.params}
    for rivals in EXCLUSIVE:
        given = {name: _ORDER.index(source) for name in rivals
                 if (source := context.get_parameter_source(name)) in _ORDER}  # fmt: skip
        for name in [name for name, place in given.items() if place > min(given.values())]:
            (context.default_map or {}).pop(name, None)
            default = options[name].get_default(context)
            context.params[name] = default if isinstance(default, bool | int | str) else None
            context.set_parameter_source(name, ParameterSource.DEFAULT)


def tell_settings(context: click.Context) -> None:
    """Print the settings in force in one line, keep them for --dry-run, and name variables without use.

    With --quiet those of a file are printed still: who types the command may not know of the file.
    """
    from wavebatch.cli.messages import talk

    lines, shown = [], []
    for name, option in _list_options(context.command).items():
        source = context.get_parameter_source(name)
        if source is ParameterSource.DEFAULT_MAP:
            value, place = context.default_map[name], str(context.meta[READ])
        elif source is ParameterSource.ENVIRONMENT:
            place = next(variable for variable in option.envvar if os.environ.get(variable))
            value = os.environ[place]
        else:
            continue
        lines.append(f"--{_option_name(option)} {value} ({place})")
        shown += lines[-1:] if source is ParameterSource.DEFAULT_MAP or not context.params.get("quiet") else []
    context.meta["wavebatch.settings"] = tuple(lines)
    for line in _find_strangers(context):
        talk(f"warning: {line}")
    if shown:
        talk(f"settings: {', '.join(shown)}")


def _find_strangers(context: click.Context) -> Iterator[str]:
    """What is wrong with variables of our name that no command reads."""
    given = [name for name in os.environ if name.startswith(PREFIX)]
    if set(given) <= _list_variables(context.command):  # nearly always: the other commands need not be imported
        return
    commands = dict(_load_all(context.find_root()))
    known = {name.removeprefix(PREFIX) for one in commands.values() for name in _list_variables(one)}
    prefixes = tuple(f"{name.upper().replace(' ', '_')}_" for name in commands)
    for name in sorted(name.removeprefix(PREFIX) for name in given):
        near = difflib.get_close_matches(name, known, 1, SIMILAR)
        if name in known:
            continue
        if name.lower().rpartition("_")[2] in NEVER:
            yield f"{PREFIX}{name} is ignored: this option can be given on the command line only"
        elif near or name.startswith(prefixes):
            meant = f"did you mean {PREFIX}{near[0]}?" if near else "see --help for the names"
            yield f"{PREFIX}{name} is ignored: no command has this option; {meant}"


def _load_all(root: click.Context) -> Iterator[tuple[str, click.Command]]:
    """All commands of the program: name, with that of its group, and command."""
    group = root.command
    for name in group.list_commands(root) if isinstance(group, click.Group) else ():
        command = group.get_command(root, name)
        yield name, command
        for inner, one in getattr(command, "commands", {}).items():
            yield f"{name} {inner}", one


def _list_options(command: click.Command) -> dict[str, click.Option]:
    return {one.name: one for one in command.params if isinstance(one, click.Option)}


def _list_variables(command: click.Command) -> set[str]:
    return {name for option in _list_options(command).values() for name in option.envvar or ()}


def _option_name(option: click.Option) -> str:
    """The long name without its hyphens."""
    return max(option.opts, key=len).removeprefix("--")


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


def _read_file(path: Path, title: str, options: Mapping[str, click.Option]) -> dict[str, Any]:
    """Values of the command's table in the file, by name of the parameter; ConfigError becomes wrong usage."""
    from wavebatch.files.text_file import read_text
    from wavebatch.files.toml_file import parse_toml

    try:
        table: Any = parse_toml(read_text(path, "settings file"), str(path)).values
    except ConfigError as error:
        raise click.UsageError(str(error)) from error
    for part in title.split():
        table = table.get(part, {}) if isinstance(table, dict) else {}
    if not isinstance(table, dict):
        raise click.UsageError(f"{path}: [{title}] must be a table of options")
    known = {_option_name(one): name for name, one in options.items()}
    found = {}
    for key, value in table.items():
        if isinstance(value, dict):
            continue
        key = OLD_NAMES.get(f"--{key}", key).removeprefix("--") if key not in known else key
        if key not in known:
            raise click.UsageError(f"{path}: [{title}] has no option {key!r}; {nearest(key, list(known))}")
        if known[key] in NEVER:
            raise click.UsageError(f"{path}: {key} can be given on the command line only; remove it from the file")
        if known[key] in IN_NO_FILE.get(title, ()):
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
