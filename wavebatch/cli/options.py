"""Options that several commands share, and the code that reads their values.

Every command of `wavebatch.cli` is built from these. An option with a short form or a name used twice belongs here:
`tests/cli/test_usage.py` checks that one name means one thing everywhere.
"""

from __future__ import annotations

import functools
import math
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click
from click.core import ParameterSource

from wavebatch.batch.options import OPTIONS, RunOptions, check_together
from wavebatch.cli.command import READ, complete, complete_files, find_setting
from wavebatch.cli.messages import LEVELS, LOG, answer, begin_log, keep_level, one_line, report_errors, talk, tell
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.schema import Above, Declared, declared_options, typed
from wavebatch.files.disk.publish import check_target, protecting, refuse_input
from wavebatch.files.text_file import find_files

if TYPE_CHECKING:
    from wavebatch.tools.sheets.sheet import SheetPart

_Options = TypeVar("_Options")


class OutputPath(click.Path):
    """The type of every option that names a file or folder to write; `click.Path` is that of files to read.

    Where the help names an ending (FILE.csv), a file has no other one: programs choose by it how to read a file. It may
    go on (.tiff) or be cut short (.htm).
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path."""
        ending = "" if param is None else Path(param.metavar or "").suffix
        own = Path(value).suffix.lower()
        if not (own.startswith(ending) or ending.startswith(own)):
            name = Path(value).stem + ending
            self.fail(f"{str(value)!r} must end in {ending}; choose another name, such as {name}", param, ctx)
        return super().convert(value, param, ctx)


def file_option(*names: str, text: str, metavar: str = "FILE", **more: Any) -> Callable:
    """An option whose value is a path; text: its help."""
    return click.option(*names, type=click.Path(path_type=Path), metavar=metavar, help=text, **more)


def output_option(
    text: str, metavar: str = "FILE", *names: str, required: bool = True, folder: bool | None = False
) -> Callable:
    """`-o`, or the option of these names: the file or folder to write; text: its help; folder: None for either."""
    kind = OutputPath(dir_okay=folder is not False, file_okay=not folder, path_type=Path)
    return click.option(*(names or ("-o", "--output")), required=required, type=kind, metavar=metavar, help=text)


def seed_option(text: str) -> Callable:
    """`--seed`; text: its help."""
    return click.option("--seed", type=click.IntRange(0), default=0, show_default=True, metavar="N", help=text)


def together(*options: Callable) -> Callable:
    """One decorator for several options, in this order in the help."""

    def decorate(command: Callable) -> Callable:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


_PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}


def parse_length(text: str) -> float:
    """A length in metres from text such as `0.02m`, `2cm`, `15 mm`; raises ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", text)
    if match is None or not float(match[1]) > 0:
        raise ConfigError(f"{text!r} is no length; write for example 0.02m, 2cm or 20mm")
    return float(match[1]) / _PER_METRE[match[2]]


_SIZE_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def _parse_size(text: str) -> int:
    """Bytes from `800M`, `2G` or a plain number."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)([KMGT]?)(I?B)?", text.strip().upper())
    size = int(float(found[1]) * _SIZE_UNITS[found[2]]) if found else 0
    if not size:
        raise click.BadParameter(f"{text!r} is not a size such as 800M or 2G")
    return size


def _parse_classes(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of numbers such as 2,6") from None


def _parse_where(text: str) -> Any:
    from wavebatch.core.condition import parse_condition

    return parse_condition(text)


def parse_span(text: str) -> tuple[int, int | None]:
    """`7` or `5:20` as the first number and the end, which is not included; `:20` starts at 0, `5:` has no end."""
    found = re.fullmatch(r"(\d{1,18})|(\d{0,18}):(\d{0,18})", text)
    if not found or text == ":":
        raise click.BadParameter(f"{text!r} is neither a number nor FIRST:END")
    if found[1]:
        return int(found[1]), int(found[1]) + 1
    first, end = int(found[2] or 0), int(found[3]) if found[3] else None
    if end is not None and end <= first:
        raise click.BadParameter(f"{text!r} is empty; END is the number after the last one")
    return first, end


def parse_floats(text: str, form: str) -> tuple[float, ...]:
    """As many numbers as the form has, e.g. `LOW:HIGH` or `W,S,E,N`."""
    mark = ":" if ":" in form else ","
    try:
        numbers = tuple(float(part) for part in text.split(mark))
    except ValueError:
        numbers = ()
    if len(numbers) != form.count(mark) + 1:
        raise click.BadParameter(f"{text!r} is not {form}")
    return numbers


def bbox_option(text: str) -> Callable:
    """`--bbox` of a picture or a raster; text: what is done with the part."""
    part = "west, south, east, north, in the coordinates of the clouds"
    return declared("bbox", f"{text} only this part: {part}.  [default: all]")


_READERS: dict[str, Callable[[str], Any]] = {
    "bbox": lambda text: parse_floats(text, "WEST,SOUTH,EAST,NORTH"),
    "lever_arm": lambda text: parse_floats(text, OPTIONS["lever_arm"].words.form),
    "tolerance": parse_length,
    "memory": _parse_size,
    "classes": _parse_classes,
    "where": _parse_where,
}
"""Values of options of RunOptions from their texts."""


_COMPLETE = {"profile": complete("chains"), "drop_flags": complete("flags"), "columns": complete("written")}
"""What shells offer after these options."""


class Text(click.ParamType):
    """The type of an option whose value is read from text; form: as in --help; read: gives the value, or raises
    click.BadParameter or ConfigError."""

    def __init__(self, form: str, read: Callable[[str], Any]) -> None:
        self.name, self._read = form, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text."""
        if not isinstance(value, str):
            return value
        try:
            return self._read(value)
        except ConfigError as error:
            place = "" if param is None or str(error).startswith("--") else f"{param.opts[-1]}: "
            source = "" if ctx is None else find_setting(ctx, param)[0]
            raise click.UsageError(f"{place}{error}" + (f" ({source})" if source else ""), ctx) from error


def declared(name: str, text: str = "", kind: type = RunOptions, **more: Any) -> Callable:
    """An option that is declared in a dataclass; text: its help in this command; more: what differs for click."""
    one = declared_options(kind)[name]
    words, default = one.words, more.get("default", one.default)
    parts = [text or words.help, f"[default: {words.unset}]" if words.unset and more.get("default") is None else ""]
    how: dict[str, Any] = {"help": "  ".join(filter(None, parts)), "metavar": words.form or None}
    how |= {"shell_complete": _COMPLETE.get(name), "required": default is MISSING}
    if default is not MISSING and not more.get("required"):
        how |= {"default": default, "show_default": not words.unset and default is not None and one.kinds != (bool,)}
    how |= {"is_flag": True} if one.kinds == (bool,) else _find_type(name, one)
    word = typed(words.name or name) + f"/--{words.opposite}" * bool(words.opposite)
    return click.option(*[f"-{words.short}"] * bool(words.short), word, name, **{**how, **more})


def options_of(kind: type, *names: str, **more: Any) -> Callable:
    """All options of a dataclass, or those of these names, in the order of the names; more: as in `declared`."""
    return together(*(declared(name, kind=kind, **more) for name in names or declared_options(kind)))


def _find_type(name: str, one: Declared) -> dict[str, Any]:
    """Click's type of an option, and what belongs to it."""
    if one.choices is not None:
        if int in one.kinds:
            numbers = click.Choice([str(choice) for choice in one.choices])
            return {"type": numbers, "callback": lambda context, parameter, text: text and int(text)}
        return {"type": click.Choice(one.choices)}
    if name in _READERS:
        return {"type": Text(one.words.form, _READERS[name])}
    number = next((number for number in (int, float) if number in one.kinds), None)
    if one.limits is not None:
        kind = click.IntRange if number is int else click.FloatRange
        return {"type": kind(*map(_plain, one.limits), isinstance(one.limits, Above))}
    if name == "output":
        return {"type": OutputPath(file_okay=False, path_type=Path)}
    is_path = Path in one.kinds and name != "energy"
    return {"type": click.Path(path_type=Path) if is_path else number or str}


def _plain(limit: float) -> float | None:
    """A limit as the help shows it."""
    if math.isinf(limit):
        return None
    return int(limit) if limit % 1 == 0 and abs(limit) < 1e16 else limit


def where_option(text: str) -> Callable:
    """`--where`; text: what is done with the points that meet the condition."""
    return declared("where", OPTIONS["where"].words.help.replace("Write only points", text, 1))


selection_options = together(
    click.option("--flags", multiple=True, metavar="NAMES", shell_complete=complete("flags"),
                 help="Use only points with one of these flags of echo_flags, e.g. SATURATED,WEAK."),
    declared("drop_flags", "Leave out points with one of these flags.", multiple=True, default=()),
    where_option("Use only points"),
)  # fmt: skip
"""Options that select points by their flags and columns."""


html_option = output_option(
    "Also write a report page: one HTML file with all pictures in it. An older report of that name is replaced.",
    "FILE.html", "--html", "html_file", required=False,
)  # fmt: skip


def check_html(target: Path | None, *, will_exist: bool = False) -> None:
    """Raises ConfigError, before the work, if the page of --html cannot be written; does nothing without it.

    will_exist: its folder will be made.
    """
    if target is not None and not (will_exist and not target.parent.exists()):
        from wavebatch.tools.sheets.page import check_page

        check_page(target)


def write_html(target: Path | None, of: str, parts: Iterable[SheetPart]) -> None:
    """Write the page of --html and say so; does nothing without it. of: what its title names beside the command."""
    if target is not None:
        from wavebatch.tools.sheets.page import write_page

        write_page(target, f"wavebatch {click.get_current_context().info_name}: {of}", parts)
        tell(f"{target}: written")


def find_inputs(arguments: Iterable[Path | str], options: Mapping[str, Any], **how: Any) -> list[Path]:
    """The files of the arguments, as `find_files` finds them; a link to a file that was given before is named,
    and so are subfolders that cannot be read. options: of the command, with --recursive."""
    return find_files(map(str, arguments), note=note_input, recursive=options["recursive"], **how)


def note_input(line: str) -> None:
    """A line about the arguments."""
    tell(line if line.startswith("warning: ") else f"note: {line}")


INPUT = click.Path(path_type=Path, readable=False)
"""The type of an argument that is a file to read: the command says what is wrong with it, and reads the others."""

strip_argument = click.argument("strip", type=INPUT)


strips_argument = together(
    click.argument("strips", nargs=-1, required=True, metavar="STRIP...", shell_complete=complete_files),
    declared("recursive"),
)
clouds_argument = together(
    click.argument("clouds", nargs=-1, required=True, type=INPUT, metavar="CLOUD...", shell_complete=complete_files),
    declared("recursive"),
)

strip_options = together(declared("direction"), declared("headerless"))
system_option = together(declared("system"), declared("force"))
chain_options = together(declared("chain"), declared("profile"))
sensor_options = together(*map(declared, ("trajectory", "lever_arm", "crs", "flight_height")))

_COMMON = {
    "overwrite": declared("overwrite"),
    "json": click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout."),
    "quiet": click.option("-q", "--quiet", is_flag=True,
                          help="Print no progress and no messages, only errors and warnings of wrong results."),
    "log_level": click.option("--log-level", type=click.Choice(LEVELS), default="info", show_default=True,
                              is_eager=True, expose_value=False, callback=keep_level,
                              help="Last level that --log-file holds."),
    "log_file": click.option("--log-file", "log_path", type=OutputPath(dir_okay=False, path_type=Path), metavar="FILE",
                             expose_value=False, callback=begin_log,
                             help="Append every message with its time to this file, also with --quiet."),
    "config": click.option("--config", type=click.Path(path_type=Path), metavar="FILE", expose_value=False,
                           help="Take options from this settings file (TOML, a table per command), and from no other."),
    "debug": click.option("--debug", is_flag=True, help="Print the traceback of an error."),
}


def common_options(*names: str, failure: int = 1) -> Callable:
    """The last options of a command, by their names in _COMMON and those that all have, and its errors as one line.

    failure: exit code as in `report_errors`.
    """

    def decorate(command: Callable) -> Callable:
        shared = (*names, "quiet", "log_file", "log_level", "config", "debug")
        # Outputs never replace inputs, nor each other, nor files without --overwrite; pages of --html know their own.
        @functools.wraps(command)
        def call(*args: Any, **options: Any) -> Any:
            context = click.get_current_context()
            known = {one.name: one for one in context.command.params if isinstance(one, click.Option)}
            default = ParameterSource.DEFAULT
            given = {name: value for name, value in context.params.items()
                     if name in known and context.get_parameter_source(name) is not default}  # fmt: skip
            check_together(given, known, lambda name: max(known[name].opts, key=len) if name in known else typed(name))
            inputs: list[Any] = list(context.meta.get(READ, ()))
            outputs: dict[str, Any] = {}
            files: list[Path] = []
            if LOG in context.meta:
                outputs[os.path.realpath(context.meta[LOG])] = [context.meta[LOG]]
            for parameter in context.command.params:
                value = context.params.get(parameter.name)
                if isinstance(parameter.type, OutputPath):
                    if value not in (None, "-"):
                        outputs.setdefault(os.path.realpath(value), []).append(value)
                        files += [] if parameter.type.dir_okay or parameter.name == "html_file" else [value]
                elif isinstance(parameter.type, click.Path):
                    inputs += value if isinstance(value, tuple) else [value]
            with protecting(inputs):
                for same in outputs.values():
                    refuse_input(same[0])
                    if len(same) > 1:
                        raise ConfigError(f"{same[0]}: two outputs have this name; choose another for one of them")
                for target in files if "overwrite" in names else ():
                    check_target(target, overwrite=options["overwrite"])
                return command(*args, **options)
        return together(*(_COMMON[name] for name in shared))(report_errors(call, failure))

    return decorate


def given_options(options: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """The options of these names that the user gave."""
    return {name: options[name] for name in names if options.get(name) is not None}


def from_options(kind: type[_Options], options: Mapping[str, Any], **more: Any) -> _Options:
    """A dataclass filled from options named like its fields; those not given keep its defaults. more: other fields."""
    return kind(**{**given_options(options, [field.name for field in fields(kind)]), **more})


def for_each(
    paths: Sequence[Path], work: Callable[[Path], Any], *, debug: bool = False, alone: bool = False
) -> tuple[list[Any], int]:
    """The results of `work` for the paths, and how many failed: with several, one that fails is one line on stderr.

    alone: a single one that fails is such a line too.
    """
    if len(paths) == 1 and not alone:
        return [work(paths[0])], 0
    results, failed = [], 0
    for path in paths:
        try:
            results.append(work(path))
        except (ConfigError, InputError) as error:
            if debug:
                traceback.print_exc()
            failed += 1
            talk(f"error: {one_line(error)}")
    return results, failed


def finish_each(paths: Sequence[Path], work: Callable[[Path], Any], options: Mapping[str, Any]) -> NoReturn:
    """Do the work for each path, give the results as --json, and end the command: exit code 1 if one failed."""
    results, failed = for_each(paths, work, debug=options["debug"])
    answer(results[0] if len(paths) == 1 else results)
    sys.exit(1 if failed else 0)


def name_outputs(paths: Sequence[Path], output: Path, suffixes: Sequence[str], kind: str) -> dict[Path, Path]:
    """The output of each strip: `output` itself for one strip, or `output`/<stem>.<kind>, a folder, for several.

    suffixes: those of files. Raises ConfigError where several strips would get one file, or two of them one name.
    """
    is_file = output.suffix.lower() in suffixes and not output.is_dir()
    if is_file or (len(paths) == 1 and not output.is_dir()):
        if len(paths) > 1:
            raise ConfigError(f"{output}: one file for {len(paths)} strips; give a folder, which gets a file for each")
        refuse_input(output)
        return {paths[0]: output}
    named = {path: output / f"{path.stem}{kind}" for path in paths}
    if len(set(named.values())) < len(named):
        raise ConfigError(f"{output}: two strips have the same name, and so would their outputs; use two folders")
    output.mkdir(parents=True, exist_ok=True)
    return named


