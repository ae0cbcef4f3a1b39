"""Options that several commands have: each is declared here once, with the code that reads its value."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.core.errors import ConfigError

if TYPE_CHECKING:
    from wavebatch.surveying.sensor import SensorRequest

overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what exists.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Say nothing unless something fails.")
headerless_option = click.option("--headerless", is_flag=True, help="Take a .wdp that lacks its 60-byte header.")
direction_option = click.option(
    "--direction",
    type=click.Choice(["auto", "toward", "away"]),
    default="auto",
    show_default=True,
    help="Where packet vectors point: decided from the file, or toward or away from the sensor.",
)
system_option = click.option(
    "--system",
    "system_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A saved survey (of `wavebatch survey -o`) in place of one of the strip.",
)


def json_option(text: str = "Print JSON.") -> Callable:
    """`--json`, the parameter `as_json`; text: what is printed."""
    return click.option("--json", "as_json", is_flag=True, help=text)


_LENGTH_UNITS = {"m": 100.0, "cm": 1.0, "mm": 0.1}


def parse_length(text: str) -> float:
    """A length in cm from text such as `0.02m`, `2cm`, `15 mm`; raises ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m)\s*", text)
    if match is None or not float(match[1]) > 0:
        raise ConfigError(f"{text!r} is no length; write for example 0.02m, 2cm or 20mm")
    return float(match[1]) * _LENGTH_UNITS[match[2]]


_SENSOR_OPTIONS = (
    click.option("--trajectory", type=click.Path(path_type=Path), metavar="FILE",
                 help="Where the sensor was: text with time, x, y, z, or SBET. Without it the packets' vectors say."),
    click.option("--lever-arm", metavar="X,Y,Z", help="From the trajectory to the scanner: forward, right, down [m]."),
    click.option("--crs", metavar="CRS", help="Of the strip, e.g. EPSG:32632, for a trajectory in degrees."),
    click.option("--flight-height", type=click.FloatRange(1.0, 100_000.0), metavar="M",
                 help="Above the ground, where neither a trajectory nor vectors say where the sensor was."),
)  # fmt: skip


def sensor_options(command: Callable) -> Callable:
    """Options of a command that say where the sensor was, for `read_sensor`."""
    for option in reversed(_SENSOR_OPTIONS):
        command = option(command)
    return command


def read_sensor(options: Mapping[str, Any]) -> SensorRequest:
    """What --trajectory, --crs, --lever-arm and --flight-height ask for; ConfigError where they cannot be meant."""
    from wavebatch.surveying.sensor import SensorRequest

    arm = _read_lever_arm(options["lever_arm"])
    for name in ("lever_arm", "crs"):
        if options[name] is not None and options["trajectory"] is None:
            raise ConfigError(f"--{name.replace('_', '-')} is of no use without --trajectory; give that too")
    return SensorRequest(options["trajectory"], options["crs"], arm, options["flight_height"])


def _read_lever_arm(text: str | None) -> tuple[float, float, float] | None:
    """Forward, right, down [m]."""
    if text is None:
        return None
    try:
        forward, right, down = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--lever-arm: {text!r} must be three numbers in metres, e.g. 0.1,-0.2,0.5") from error
    if not abs(forward) + abs(right) + abs(down) < 1000:
        raise ConfigError(f"--lever-arm: {text!r} is no arm of a few metres")
    return forward, right, down
