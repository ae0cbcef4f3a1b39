"""The class of all commands: help with examples and groups, options that settings can give, completion, man pages.

`LazyGroup` gives each command this class when it is loaded, so that a new command only declares itself. A command has
its examples in its docstring. They and the groups are those of --help, of the manual pages and of the page Commands.

Defaults of options may come from outside of the command line: from WAVEBATCH_* variables and settings files. Click
reads both (`envvar` of an option, `default_map` of a context): an option on the command line counts first, then the
variable, then the file, then the default. Here is what click lacks: where the files lie, and what is said of them. A
file that the user names or keeps in the personal folder may give any option. A wavebatch.toml beside the inputs may
have come with them: it gives only the options of HARMLESS. What changes results is never silent: the settings in force
are printed in one line.
"""

from __future__ import annotations

import glob
import inspect
import math
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from wavebatch import __version__
from wavebatch.batch.options import AIR, CHAIN, EXCLUSIVE, HEADINGS, OPTIONS, OUTPUT, READING, RUNNING, WHICH
from wavebatch.cli.messages import talk
from wavebatch.core.errors import ConfigError, nearest

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

_INPUTS = ("strips", "strip", "clouds", "files", "cloud", "a")
"""Names of the arguments that are files to read; settings lie beside the first."""


def read_settings(command: click.Command, title: str, context: click.Context, arguments: list[str]) -> None:
    """Take the command's tables of the settings files as defaults; click's errors for a wrong one, or an empty name.

    A file that the user names is the only one. Without it, that beside the inputs counts before that of the user.
    """
    try:
        parsed, _, _ = command.make_parser(click.Context(command)).parse_args(list(arguments))
    except click.UsageError:
        return  # the real parsing says what is wrong
    for one in command.params:
        given = parsed.get(one.name) if isinstance(one.type, click.Path) or one.name in _INPUTS else None
        if given == "" or isinstance(given, tuple | list) and "" in given:  # pathlib takes it for the current folder
            raise click.BadParameter("the name is empty; is a variable of the shell not set?", context, one)
    options = _list_options(command)
    named = parsed.get("config") or options["config"].resolve_envvar_value(context)
    personal = Path(named or os.path.join(click.get_app_dir("wavebatch"), FILE))
    words: list[str] = []
    for name in _INPUTS:
        value = parsed.get(name)
        words += [value] if isinstance(value, str) else list(value) if isinstance(value, tuple | list) else []
    beside = {}
    for folder in () if named else map(_folder, words):
        path = folder / FILE
        # os.path.isfile is false for names that the system refuses, such as one that is too long: `run` says so.
        beside[os.path.realpath(path) if os.path.isfile(path) else ""] = path
    if len(beside) > 1:
        files = ", ".join(str(path) for key, path in beside.items() if key)
        raise click.UsageError(f"the inputs lie in folders with different settings ({files}); run them one by one, or "
                               "give --config FILE")
    found = {path: _read_file(path, title, context, options, is_users=False) for key, path in beside.items() if key}
    if named or os.path.isfile(personal):
        given = {name for values in found.values() for name in values}
        barred = given.union(*(rivals for rivals in EXCLUSIVE if given.intersection(rivals)))
        values = _read_file(personal, title, context, options, is_users=True)
        found[personal] = {name: value for name, value in values.items() if name not in barred}
    if found:
        context.meta[READ] = found
        context.default_map = {name: value for values in found.values() for name, value in values.items()}


def _find_strangers(context: click.Context) -> Iterator[str]:
    """What is wrong with variables of our name that no command reads."""
    given = [name for name in os.environ if name.startswith(PREFIX)]
    if not given:
        return
    read = {name for option in _list_options(context.command).values() for name in option.envvar or ()}
    names = (one.words.name or name for name, one in OPTIONS.items() if name not in NO_VARIABLE)
    if read.union(*(_list_variables("run", name) for name in names)).issuperset(given):
        return  # nearly always, if only `run` reads them: the other commands need not be imported
    import difflib

    root, commands = context.find_root(), {}
    group = root.command
    for name in group.list_commands(root) if isinstance(group, click.Group) else ():
        commands[name] = group.get_command(root, name)
        commands |= {f"{name} {inner}": one for inner, one in getattr(commands[name], "commands", {}).items()}
    every = [option for one in commands.values() for option in _list_options(one).values()]
    known = {name.removeprefix(PREFIX) for option in every for name in option.envvar or ()}
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


def _list_options(command: click.Command) -> dict[str, click.Option]:
    return {one.name: one for one in command.params if isinstance(one, click.Option)}


def _list_variables(title: str, name: str) -> list[str]:
    """Variables that give an option of a command: WAVEBATCH_RUN_JOBS counts before WAVEBATCH_JOBS."""
    return [re.sub("[- ]", "_", f"{PREFIX}{words}").upper() for words in (f"{title} {name}", name)]


def find_setting(ctx: click.Context, option: click.Option | None) -> tuple[str, Any]:
    """Settings file or variable that gives an option, and what it gives; empty and None for all other options."""
    name = "" if option is None else option.name or ""
    source = ctx.get_parameter_source(name)
    if source is ParameterSource.DEFAULT_MAP:
        return next((str(path), values[name]) for path, values in ctx.meta[READ].items() if name in values)
    if option is not None and source is ParameterSource.ENVIRONMENT:
        return next((variable, os.environ[variable]) for variable in option.envvar or () if os.environ.get(variable))
    return "", None


def _option_name(option: click.Option) -> str:
    """The long name without its hyphens."""
    return max(option.opts, key=len).removeprefix("--")


def _folder(word: str) -> Path:
    """The folder of an argument: a file, a folder, a pattern, or @list.txt."""
    word = word.removeprefix("@")
    if os.path.isdir(word):
        return Path(word)
    parent = Path(word).parent
    while glob.has_magic(str(parent)):
        parent = parent.parent
    return parent


def _read_file(
    path: Path, title: str, context: click.Context, options: Mapping[str, click.Option], *, is_users: bool
) -> dict[str, Any]:
    """Values of the command's table in the file, by name of the parameter; ConfigError becomes wrong usage.

    is_users: the user named the file or keeps it; else it may have come with the data.
    """
    from wavebatch.files.text_file import read_text
    from wavebatch.files.toml_file import parse_toml, shorten

    try:
        table: Any = parse_toml(read_text(path, "settings file", MOST_BYTES), str(path)).values
    except ConfigError as error:
        raise click.UsageError(str(error)) from error
    group: Any = context.find_root().command
    for part in title.split():
        commands = group.list_commands(context)
        for name in table:
            if name not in commands:
                raise click.UsageError(f"{path}: there is no command {shorten(name)} to give options to, as in [run]; "
                                       f"{nearest(name, commands)}")  # fmt: skip
        table, group = table.get(part, {}), group.get_command(context, part)
        if not isinstance(table, dict):
            raise click.UsageError(f"{path}: [{title}] must be a table of options")
    known = {_option_name(one): name for name, one in options.items() if name != "config"}
    found = {}
    for key, value in table.items():
        if key not in known:
            raise click.UsageError(f"{path}: [{title}] has no option {shorten(key)}; {nearest(key, list(known))}")
        # A profile may also be the path of a chain file.
        harmless = key in HARMLESS and len(str(value)) <= LONGEST and (key != "profile" or str(value).isidentifier())
        if not is_users and not harmless:
            raise click.UsageError(
                f"{path}: [{title}] must not set {key} so: a file that lies with the data may change numbers of the "
                "result, not how or where it is made; remove the line, or, if the whole file can be trusted, give "
                f"--config {shlex.quote(str(path))}"
            )
        found[known[key]] = _convert(value, options[known[key]], path)
    return found


def _convert(value: Any, option: click.Option, path: Path) -> Any:
    """A value of TOML as the option takes it; paths are relative to the file."""
    if value == "" and isinstance(option.type, click.Path):
        raise click.UsageError(f"{path}: {_option_name(option)}: the name is empty; remove the line")
    if isinstance(option.type, click.Path) and isinstance(value, str) and value != "-":
        return str(path.parent / value)
    if isinstance(value, list):
        return [str(one) for one in value] if option.multiple else ",".join(map(str, value))
    return value if isinstance(value, bool) else str(value)


GROUPS: dict[str, tuple[str, ...]] = {
    "Options": ("grid columns", "slice most", "stats polygon", "simulate most", "synthesize divergence"),
    READING: ("grid crs",),
    CHAIN: ("waveforms", "divergence"),
    AIR: ("reflectance_error", "scan_angle"),
    WHICH: ("flags", "packets", "point_numbers", "times", "most", "random", "limit"),
    OUTPUT: ("html_file", "report", "as_json"),
    RUNNING: ("dry_run", "fail_on", "progress", "verbose", "quiet", "log_path", "log_level", "config", "debug", "help"),
}
"""Names of options under a heading of --help, besides those of RunOptions. Others come first, under Options.

With the command in front where the name means something else in others."""

FEWEST_GROUPED = 8
"""Pages with fewer options than this have no groups."""

MANY, USUAL, ALSO_USUAL = 40, "Options that most runs need", ("html_file",)
"""Pages with more options than MANY begin with those that RunOptions calls usual, and these."""


def complete_files(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Let the shell complete file names; those of lists, which begin with `@`, are found here.

    bash ends a word at `@`: it gives the sign as an argument of its own, but replaces it too.
    """
    given = context.params.get(parameter.name or "") if context is not None else None
    apart = isinstance(given, tuple) and bool(given) and str(given[-1]) == "@"
    if not (apart or incomplete.startswith("@")):
        return [CompletionItem(incomplete, type="file")]
    folder, start = os.path.split(incomplete.removeprefix("@"))
    try:
        entries = sorted(os.scandir(folder or "."), key=lambda entry: entry.name)
    except OSError:
        return []
    found = []
    for entry in entries:
        if entry.name.startswith(start) and (start or not entry.name.startswith(".")):
            found.append(CompletionItem("@" + os.path.join(folder, entry.name) + "/" * entry.is_dir()))
    return found


_FIELDS = ("x", "y", "z", "intensity", "return_number", "number_of_returns", "classification", "scan_angle",
           "user_data", "point_source_id", "gps_time")  # fmt: skip
"""Standard fields that clouds usually have."""


def complete(kind: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """What shells offer for names of a kind: chains, flags, written (columns of `run`), columns, stages or scenes.

    Of flags and written columns the last one is completed; those before its comma are not offered again.
    """

    def offer(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",") if kind in ("flags", "written") else ("", "", incomplete)
        last = last.upper() if kind == "flags" else last
        given = {part.upper().lstrip("+") for part in before.split(",")}
        # Only what a kind needs is imported: the user waits.
        names: Iterable[str]
        if kind == "chains":
            from wavebatch.stages.chain import list_profiles

            names = ("auto", *list_profiles())
        elif kind == "stages":
            from wavebatch.stages.chain import STAGES, load_plugins

            load_plugins()
            names = sorted(STAGES)
        elif kind == "scenes":
            from wavebatch.tools.simulate.scenes import OTHER_NAMES, SCENES

            names = (*SCENES, *OTHER_NAMES)
        else:
            from wavebatch.core.echoes import COLUMNS, EchoFlag

            ours = [name for name, column in COLUMNS.items() if column.extra_bytes]
            names = {
                "flags": [flag.name or "" for flag in EchoFlag],
                "written": [f"+{name}" for name in ours] if last.startswith("+") else ours,
                "columns": list(dict.fromkeys([*ours, *_FIELDS])),
            }[kind]
        fitting = (name for name in names if name.startswith(last) and name.upper().lstrip("+") not in given)
        return [f"{before}{comma}{name}" for name in fitting]

    return offer


MAYBE_NAN = ("no_data",)
"""Options whose number may be NaN."""


class ProgramCommand(click.Command):
    """A command with its examples."""

    title: str = ""
    """Name with that of its group, e.g. `plot map`."""
    examples: tuple[tuple[str, str], ...] = ()
    """A line to type, and what it is for: the last part of the function's docstring."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the arguments; options that they do not give come from settings, if there are any.

        Numbers must be finite, because no limit of an option holds for NaN.
        """
        is_real = not ctx.resilient_parsing and {"-h", "--help"}.isdisjoint(args)
        if is_real:
            read_settings(self, self.title, ctx, args)
        options = _list_options(self)
        try:
            with click.core.augment_usage_errors(ctx):  # click names no command where a value is missing
                rest = super().parse_args(ctx, args)
        except click.BadParameter as error:
            if error.param is not None and (place := find_setting(ctx, options.get(error.param.name or ""))[0]):
                error.message = f"{error.message.removesuffix('.')} ({place})"
            raise
        for option in self.params:
            value = ctx.params.get(option.name or "")
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number) and option.name not in MAYBE_NAN:
                    raise click.BadParameter(f"{number} is not a finite number.", ctx, option)
        if is_real:
            # Settings are put aside that exclude an option that counts more: of the command line, or of a variable.
            # Then those in force are printed in one line, kept for --dry-run, and variables without use named. With
            # --quiet those of a file are printed still: who types the command may not know of the file.
            for rivals in EXCLUSIVE:
                given = {name: _ORDER.index(source) for name in rivals
                         if name in options and (source := ctx.get_parameter_source(name)) in _ORDER}  # fmt: skip
                for name in [name for name, place in given.items() if place > min(given.values())]:
                    (ctx.default_map or {}).pop(name, None)
                    default = options[name].get_default(ctx)
                    ctx.params[name] = default if isinstance(default, bool | int | str) else None
                    ctx.set_parameter_source(name, ParameterSource.DEFAULT)
            lines, shown = [], []
            for name, option in options.items():
                place, value = find_setting(ctx, option)
                if not place:
                    continue
                is_file = ctx.get_parameter_source(name) is ParameterSource.DEFAULT_MAP
                lines.append(f"--{_option_name(option)} {value} ({place})")
                shown += lines[-1:] if is_file or not ctx.params.get("quiet") else []
            ctx.meta["wavebatch.settings"] = tuple(lines)
            talk(*(f"warning: {line}" for line in _find_strangers(ctx)))
            if shown:
                talk(f"settings: {', '.join(shown)}")
        return rest

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the options by group, then the examples."""
        for heading, records in group_options(self, ctx):
            with formatter.section(heading):
                formatter.write_dl(records)
        if self.examples:
            with formatter.section("Examples"):
                for line, purpose in self.examples:
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
    if len(records) < FEWEST_GROUPED:
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
    # Pairs of lines: `# purpose`, and what is typed.
    text, _, last = inspect.cleandoc(command.help or "").partition("\nExamples:\n")
    lines = [line.strip() for line in last.splitlines()]
    dressed.help = text.rstrip()
    dressed.examples = tuple((line, why.removeprefix("# ")) for why, line in zip(lines[::2], lines[1::2], strict=True))
    for option in dressed.params:
        if isinstance(option, click.Option) and option.name not in NO_VARIABLE:
            option.envvar = _list_variables(title, _option_name(option))
    return dressed


LIBRARIES = ("numpy", "scipy", "laspy", "lazrs")
"""Libraries on which results and files depend."""


def write_man_pages(group: click.Group, folder: Path) -> list[Path]:
    """Write wavebatch.1 and a page per command into a folder, over older ones; returns their names."""
    from wavebatch.files.text_file import write_text

    folder.mkdir(parents=True, exist_ok=True)
    pages = dict(_pages(group, click.Context(group, info_name="wavebatch")))
    for name, text in pages.items():
        write_text(folder / f"{name}.1", text, overwrite=True)
    return [folder / f"{name}.1" for name in pages]


def _pages(command: click.Command, ctx: click.Context, title: str = "") -> Iterator[tuple[str, str]]:
    """Name and text of the page of a command, and of those of a group; title: "" for the program itself."""
    name = "-".join(["wavebatch", *title.split()])
    inner = {}
    if isinstance(command, click.Group):
        inner = {one: command.get_command(ctx, one) for one in command.list_commands(ctx)}
    usage = f"\\fB{roff(ctx.command_path)}\\fR {roff(' '.join(command.collect_usage_pieces(ctx)))}"
    lines = [f'.TH "{name.upper()}" "1" "" "wavebatch {__version__}" "wavebatch"',
             ".SH NAME", f"{roff(name)} \\- {roff(_first_line(command.help))}",
             ".SH SYNOPSIS", *([usage] if title else [".B wavebatch", "COMMAND [OPTIONS] ..."]),
             ".SH DESCRIPTION"]  # fmt: skip
    for part in re.split(r"\n\s*\n", inspect.cleandoc(command.help or "").replace("\f", "")):
        lines.append(".PP")
        if part.startswith("\b"):  # click must not wrap it
            lines += [".nf", *(roff(line) for line in part.lstrip("\b\n").splitlines()), ".fi"]
        else:
            lines.append(roff(" ".join(part.split())))
    if not title:
        lines.append(".SH COMMANDS")
        for one, its in inner.items():
            lines += [".TP", f"\\fB{roff(f'wavebatch-{one}(1)')}\\fR", roff(_first_line(its.help))]
    for heading, records in group_options(command, ctx):
        lines.append(f".SH {heading.upper()}")
        for names, text in records:
            lines += [".TP", f"\\fB{roff(names)}\\fR", roff(" ".join(text.split()))]
    if examples := getattr(command, "examples", ()):
        lines.append(".SH EXAMPLES")
        for line, purpose in examples:
            words = f"{purpose[:1].upper()}{purpose[1:]}:"
            lines += [".PP", roff(words), ".PP", ".nf", ".RS", roff(line), ".RE", ".fi"]
    lines += [".SH SEE ALSO", "\\fBwavebatch\\fR(1)"] if title else []
    yield name, "\n".join(lines) + "\n"
    for one, its in inner.items():
        yield from _pages(its, click.Context(its, info_name=one, parent=ctx), f"{title} {one}".strip())


def _first_line(text: str | None) -> str:
    return " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split()).rstrip(".")


def roff(text: str) -> str:
    """Text without a meaning for roff: backslashes, hyphens, and dots and quotes that begin a line."""
    plain = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{plain}" if plain[:1] in (".", "'") else plain
