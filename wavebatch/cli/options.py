"""Options that several commands share, and the code that reads their values.

Every command of `wavebatch.cli` is built from these. An option with a short form or a name used twice belongs here:
`tests/cli/test_usage.py` checks that one name means one thing everywhere.
"""

from __future__ import annotations

import functools
import os
import re
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from wavebatch.cli.messages import one_line, report_errors, talk
from wavebatch.cli.program.completion import complete_files, complete_flags, complete_profiles
from wavebatch.cli.program.log_file import LEVELS, LOG, begin_log, keep_level
from wavebatch.cli.program.settings import EXCLUSIVE, READ
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.protect import protecting, refuse_input

if TYPE_CHECKING:
    from wavebatch.core.condition import Condition
    from wavebatch.surveying.calibration import Calibration
    from wavebatch.surveying.sensor import SensorRequest
    from wavebatch.surveying.system_file import SavedSurvey

_Options = TypeVar("_Options")


class OutputPath(click.Path):
    """The type of every option that names a file or folder to write; `click.Path` is that of files to read."""


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


def _read_where(context: click.Context, parameter: click.Parameter, text: str | None) -> Condition | None:
    from wavebatch.core.condition import parse_condition

    try:
        return None if text is None else parse_condition(text)
    except ConfigError as error:
        raise click.UsageError(str(error), context) from error


def where_option(text: str) -> Callable:
    """`--where`; text: what is done with the points that meet the condition."""
    more = "that meet this, e.g. \"number_of_returns == 2 and not (classification == 7 or echo_width >= 8)\"; points"
    more += " without data in a column meet nothing on it."
    return click.option("--where", callback=_read_where, metavar="CONDITION", help=f"{text} {more}")


selection_options = together(
    click.option("--flags-with", multiple=True, metavar="NAMES", shell_complete=complete_flags,
                 help="Use only points with one of these flags of echo_flags, e.g. SATURATED,WEAK."),
    click.option("--flags-without", multiple=True, metavar="NAMES", shell_complete=complete_flags,
                 help="Use only points with none of these flags."),
    where_option("Use only points"),
)  # fmt: skip
"""Options that select points by their flags and columns."""


html_option = output_option(
    "Also write a report page: one HTML file with all pictures in it. An older report of that name is replaced.",
    "FILE", "--html", "html_file", required=False,
)  # fmt: skip


def check_html(target: Path | None) -> None:
    """Raises ConfigError, before the work, if the page of --html cannot be written; does nothing without it."""
    if target is not None:
        from wavebatch.tools.html.page import check_page

        check_page(target)


strip_argument = click.argument("strip", type=click.Path(path_type=Path))


recursive_option = click.option("--recursive", is_flag=True, help="Also take the files in subfolders of folders.")
strips_argument = together(
    click.argument("strips", nargs=-1, required=True, metavar="STRIP...", shell_complete=complete_files),
    recursive_option,
)
clouds_argument = click.argument("clouds", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CLOUD...",
                                shell_complete=complete_files)  # fmt: skip

direction_option = click.option(
    "--direction",
    type=click.Choice(["auto", "toward", "away"]),
    default="auto",
    show_default=True,
    help="Direction of the packet vectors: toward or away from the sensor; auto finds it from the file.",
)
strip_options = together(
    direction_option,
    click.option("--headerless", is_flag=True, help="Read a .wdp file that lacks its 60-byte header."),
)
system_option = together(
    file_option("--system", "system_file",
                text="Use this saved survey (`wavebatch survey -o FILE`) instead of surveying the strip."),
    click.option("--force", is_flag=True, help="Use the survey of --system also where bits, noise or echo width of the "
                 "strip contradict it."),
)  # fmt: skip
energy_option = click.option(
    "--energy", metavar="COLUMN|FILE|none",
    help="Energy of each emitted pulse, which backscatter and normalized amplitudes are divided by: an extra byte of "
    "the strips, or a text file with columns time (GPS time of the points) and energy; none: not divided.  [default: "
    "the extra byte pulse_energy, where it is there]",
)  # fmt: skip
calibration_option = file_option(
    "--calibration", "calibration_file",
    text="Calibration file of `wavebatch calibrate`: adds calibrated columns; cross sections need its divergence.",
)  # fmt: skip
air_options = together(
    click.option("--attenuation", type=click.FloatRange(0.0, 100.0), metavar="DB_KM",
                 help="Attenuation of the air during the flight, one way [dB/km].  [default: that of --calibration, "
                 "else 0.22]"),
    click.option("--visibility", type=click.FloatRange(0.5, 400.0), metavar="KM",
                 help="Meteorological visibility during the flight [km], in place of --attenuation."),
    click.option("--wavelength", type=click.FloatRange(300.0, 2500.0), metavar="NM",
                 help="Wavelength of the laser [nm], for --visibility.  [default: 1064]"),
    energy_option,
    click.option("--attenuation-error", type=click.FloatRange(0.0, 100.0), metavar="DB_KM",
                 help="Standard deviation of the attenuation [dB/km]: goes into the errors.  [default: 0]"),
)  # fmt: skip
chain_options = together(
    file_option("-c", "--chain", "chain_file", text="Run the chain of this chain file (TOML)."),
    click.option("--profile", metavar="auto|fast|balanced|accurate", shell_complete=complete_profiles,
                 help="Run a shipped chain; auto surveys the strip and chooses the cheapest chain that suits it.  "
                 "[default: auto]"),
)  # fmt: skip
sensor_options = together(
    file_option("--trajectory", text="Trajectory of the sensor: text with columns time, x, y, z, or SBET. Without it "
                "the sensor position is estimated from the packet vectors."),
    click.option("--lever-arm", metavar="X,Y,Z", help="Offset from trajectory to scanner: forward, right, down [m]."),
    click.option("--crs", metavar="CRS", help="CRS of the strip, e.g. EPSG:32632; for a trajectory in degrees."),
    click.option("--flight-height", type=click.FloatRange(1.0, 100_000.0), metavar="M",
                 help="Flight height above ground [m], used if the packet vectors do not give the position; not with "
                 "--trajectory."),
)  # fmt: skip

_COMMON = {
    "overwrite": click.option("--overwrite", is_flag=True, help="Replace existing files."),
    "json": click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout."),
    "quiet": click.option("-q", "--quiet", is_flag=True,
                          help="Print no progress and no messages, only errors and warnings of wrong results."),
    "log_level": click.option("--log-level", type=click.Choice(LEVELS), default="info", show_default=True,
                              is_eager=True, expose_value=False, callback=keep_level,
                              help="Last level that --log-file holds."),
    "log_file": click.option("--log-file", "log_path", type=OutputPath(dir_okay=False, path_type=Path), metavar="FILE",
                             expose_value=False, callback=begin_log,
                             help="Append every message with its time to this file, also with --quiet."),
    "debug": click.option("--debug", is_flag=True, help="Print the traceback of an error."),
}


def common_options(*names: str, failure: int = 1) -> Callable:
    """The last options of a command, by their names in _COMMON and always `--debug`, and its errors as one line.

    failure: exit code as in `report_errors`.
    """

    def decorate(command: Callable) -> Callable:
        shared = (*names, "log_file", "log_level", "debug")
        return together(*(_COMMON[name] for name in shared))(report_errors(failure)(_protected(command)))

    return decorate


def _protected(command: Callable) -> Callable:
    """The command; its outputs never replace its inputs, nor each other."""

    @functools.wraps(command)
    def call(*args: Any, **options: Any) -> Any:
        context = click.get_current_context()
        _check_together(context)
        inputs: list[Any] = list(context.meta.get(READ, ()))
        outputs: dict[str, Any] = {}
        if LOG in context.meta:
            outputs[os.path.realpath(context.meta[LOG])] = [context.meta[LOG]]
        for parameter in context.command.params:
            value = context.params.get(parameter.name)
            if isinstance(parameter.type, OutputPath):
                if value not in (None, "-"):
                    outputs.setdefault(os.path.realpath(value), []).append(value)
            elif isinstance(parameter.type, click.Path):
                inputs += value if isinstance(value, tuple) else [value]
        with protecting(inputs):
            for same in outputs.values():
                refuse_input(same[0])
                if len(same) > 1:
                    raise ConfigError(f"{same[0]}: two outputs have this name; choose another for one of them")
            return command(*args, **options)

    return call


def _check_together(context: click.Context) -> None:
    """Raises ConfigError for two options of which only one is possible, and for one that another one needs."""
    given = {
        option.name: max(option.opts, key=len)
        for option in context.command.params
        if context.params.get(option.name) is not None and context.params[option.name] is not False
    }
    for rivals in EXCLUSIVE:
        names = [given[name] for name in rivals if name in given]
        if len(names) > 1:
            raise ConfigError(f"{names[0]} and {names[1]} exclude each other; give one of them")
    if "force" in given and "system_file" not in given:
        raise ConfigError("--force is of no use without --system; leave it out")


_NO_TOML = (".json", ".csv", ".html", ".las", ".laz", ".yaml", ".yml", ".xml", ".npz")


def check_toml(target: Path | None) -> None:
    """Raises ConfigError for an input, and for a name that says that another kind of file would be written."""
    if target is not None:
        refuse_input(target)
    if target is not None and target.suffix.lower() in _NO_TOML:
        more = "; --json prints the figures" if target.suffix.lower() == ".json" else ""
        raise ConfigError(f"{target}: this file is written as TOML; name it {target.with_suffix('.toml').name}{more}")


def given_options(options: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """The options of these names that the user gave."""
    return {name: options[name] for name in names if options.get(name) is not None}


def from_options(kind: type[_Options], options: Mapping[str, Any], **more: Any) -> _Options:
    """A dataclass filled from options named like its fields; those not given keep its defaults. more: other fields."""
    return kind(**{**given_options(options, [field.name for field in fields(kind)]), **more})


_LENGTH_UNITS = {"m": 100.0, "cm": 1.0, "mm": 0.1}


def parse_length(text: str) -> float:
    """A length in cm from text such as `0.02m`, `2cm`, `15 mm`; raises ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", text)
    if match is None or not float(match[1]) > 0:
        raise ConfigError(f"{text!r} is no length; write for example 0.02m, 2cm or 20mm")
    return float(match[1]) * _LENGTH_UNITS[match[2]]


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


def floats_reader(form: str) -> Callable[[click.Context, click.Parameter, str | None], tuple[float, ...] | None]:
    """The callback of an option that takes numbers of this form, as `parse_floats`."""
    return lambda context, parameter, text: None if text is None else parse_floats(text, form)


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


def read_system(options: Mapping[str, Any]) -> SavedSurvey | None:
    """The survey of --system, None without it."""
    from wavebatch.surveying.system_file import load_survey

    return load_survey(options["system_file"]) if options["system_file"] else None


def read_calibration(options: Mapping[str, Any]) -> Calibration | None:
    """The calibration of --calibration, None without it."""
    from wavebatch.surveying.calibrating.calibration_file import load_calibration

    return load_calibration(options["calibration_file"]) if options["calibration_file"] else None


def read_air(options: Mapping[str, Any]) -> tuple[float, float] | None:
    """Attenuation and error of --attenuation or --visibility [dB/km]; ConfigError for options without use."""
    from wavebatch.kernels.physics.radiometry import attenuation_of_visibility

    given, visibility = options["attenuation"], options["visibility"]
    if options["wavelength"] is not None and visibility is None:
        raise ConfigError("--wavelength is of no use without --visibility; give that too")
    if options["attenuation_error"] is not None and given is None and visibility is None:
        raise ConfigError("--attenuation-error is of no use without --attenuation or --visibility; give one of them")
    if visibility is not None:
        given = attenuation_of_visibility(visibility, options["wavelength"] or 1064.0)
    return None if given is None else (given, options["attenuation_error"] or 0.0)


def read_sensor(options: Mapping[str, Any]) -> SensorRequest:
    """The request of --trajectory, --crs, --lever-arm and --flight-height; ConfigError where they do not fit."""
    from wavebatch.surveying.sensor import SensorRequest

    arm = _read_lever_arm(options["lever_arm"])
    for name in ("lever_arm", "crs"):
        if options[name] is not None and options["trajectory"] is None:
            raise ConfigError(f"--{name.replace('_', '-')} is of no use without --trajectory; give that too")
    return SensorRequest(options["trajectory"], options["crs"], arm, options["flight_height"])


def _read_lever_arm(text: str | None) -> tuple[float, ...] | None:
    """Forward, right, down [m]."""
    if text is None:
        return None
    try:
        arm = parse_floats(text, "X,Y,Z")
    except click.BadParameter as error:
        raise ConfigError(f"--lever-arm: {text!r} must be three numbers in metres, e.g. 0.1,-0.2,0.5") from error
    if not sum(map(abs, arm)) < 1000:
        raise ConfigError(f"--lever-arm: {text!r} is too long; a lever arm has a few metres")
    return arm
