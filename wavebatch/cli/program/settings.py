"""Defaults of options from outside of the command line: WAVEBATCH_* variables, and settings files.

Click reads both (`envvar` of an option, `default_map` of a context): an option on the command line counts first, then
the variable, then the file, then the default. Here is what click lacks: where the files lie, and what is said of them.
A file that the user names or keeps in the personal folder may give any option. A wavebatch.toml beside the inputs may
have come with them: it gives only the options of HARMLESS. What changes results is never silent: the settings in force
are printed in one line.
"""

from __future__ import annotations

import difflib
import glob
import os
import re
import shlex
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
"""Key of a context's `meta`: values by option, of each file that was read; the first file counts first."""

_ORDER = (ParameterSource.COMMANDLINE, ParameterSource.ENVIRONMENT, ParameterSource.DEFAULT_MAP)
"""What counts first."""

NO_VARIABLE = ("overwrite", "force", "help", "debug")
"""Options that no variable gives: they may destroy files, or hide that a result is wrong."""

HARMLESS = frozenset({
    "attenuation", "attenuation-error", "bbox", "classes", "columns", "direction", "divergence", "drop-flags", "flags",
    "flight-height", "headerless", "lever-arm", "names", "no-data", "points", "profile", "reflectance-ratio",
    "tolerance", "visibility", "wavelength", "where",
})  # fmt: skip
"""All options that a file beside the inputs may give: they change numbers of the result. None names a file, folder,
address or plug-in, replaces or hides anything, or decides how much of the machine is used: `format` decides which files
--overwrite replaces, `crs` may name a grid file, `energy` a file. A new option is not harmless until it is listed."""

LONGEST = 4096
"""Most characters of a value from a file beside the inputs: messages show it."""

MOST_BYTES = 1 << 20
"""Largest settings file: a table for each command with all of its options takes 10 kB."""

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
        if isinstance(option, click.Option) and option.name not in NO_VARIABLE:
            words = re.sub("[- ]", "_", f"{title} {_option_name(option)}").upper()
            general = _option_name(option).replace("-", "_").upper()
            known = [option.envvar] if isinstance(option.envvar, str) else []
            option.envvar = [*known, f"{PREFIX}{words}", f"{PREFIX}{general}"]


def read_settings(command: click.Command, title: str, context: click.Context, arguments: list[str]) -> None:
    """Take the command's tables of the settings files as defaults; click's errors for a wrong one.

    A file that the user names is the only one. Without it, that beside the inputs counts before that of the user.
    """
    try:
        parsed, _, _ = command.make_parser(click.Context(command)).parse_args(list(arguments))
    except click.UsageError:
        return  # the real parsing says what is wrong
    options = _list_options(command)
    named = parsed.get("config") or options["config"].resolve_envvar_value(context)
    personal = Path(named or os.path.join(click.get_app_dir("wavebatch"), FILE))
    beside = None if named else _find_file(parsed)
    found: dict[Path, dict[str, Any]] = {}
    if beside is not None:
        found[beside] = _read_file(beside, title, options, is_users=False)
    if named or os.path.isfile(personal):
        given = {name for values in found.values() for name in values}
        barred = given.union(*(rivals for rivals in EXCLUSIVE if given.intersection(rivals)))
        values = _read_file(personal, title, options, is_users=True)
        found[personal] = {name: value for name, value in values.items() if name not in barred}
    if found:
        context.meta[READ] = found
        context.default_map = {name: value for values in found.values() for name, value in values.items()}


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
            place, value = next((str(path), values[name]) for path, values in context.meta[READ].items()
                                if name in values)  # fmt: skip
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
        if name.lower().rpartition("_")[2] in NO_VARIABLE:
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
        raise click.UsageError(f"the inputs lie in folders with different settings ({files}); run them one by one, or "
                               "give --config FILE")
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


def _read_file(path: Path, title: str, options: Mapping[str, click.Option], *, is_users: bool) -> dict[str, Any]:
    """Values of the command's table in the file, by name of the parameter; ConfigError becomes wrong usage.

    is_users: the user named the file or keeps it; else it may have come with the data.
    """
    from wavebatch.files.text_file import read_text
    from wavebatch.files.toml_file import parse_toml, shorten

    try:
        table: Any = parse_toml(read_text(path, "settings file", MOST_BYTES), str(path)).values
    except ConfigError as error:
        raise click.UsageError(str(error)) from error
    for part in title.split():
        table = table.get(part, {}) if isinstance(table, dict) else {}
    if not isinstance(table, dict):
        raise click.UsageError(f"{path}: [{title}] must be a table of options")
    known = {_option_name(one): name for name, one in options.items() if name != "config"}
    found = {}
    for key, value in table.items():
        if isinstance(value, dict):
            continue
        key = OLD_NAMES.get(f"--{key}", key).removeprefix("--") if key not in known else key
        if key not in known:
            raise click.UsageError(f"{path}: [{title}] has no option {shorten(key)}; {nearest(key, list(known))}")
        # A profile may also be the path of a chain file.
        harmless = key in HARMLESS and len(str(value)) <= LONGEST and (key != "profile" or str(value).isidentifier())
        if not is_users and not harmless:
            raise click.UsageError(
                f"{path}: [{title}] must not set {key} so: a file that lies with the data may change numbers only; "
                f"remove the line, or, if the whole file can be trusted, give --config {shlex.quote(str(path))}"
            )
        found[known[key]] = _convert(value, options[known[key]], path)
    return found


def _convert(value: Any, option: click.Option, path: Path) -> Any:
    """A value of TOML as the option takes it; paths are relative to the file."""
    if isinstance(option.type, click.Path) and isinstance(value, str) and value != "-":
        return str(path.parent / value)
    if isinstance(value, list):
        return [str(one) for one in value] if option.multiple else ",".join(map(str, value))
    return value if isinstance(value, bool) else str(value)
