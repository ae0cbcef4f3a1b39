"""The options of every command that asks where the sensor was."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.core.errors import ConfigError

if TYPE_CHECKING:
    from wavebatch.surveying.sensor import SensorRequest


_OPTIONS = (
    click.option("--trajectory", type=click.Path(path_type=Path), metavar="FILE",
                 help="Where the sensor was: text with time, x, y, z, or SBET. Without it the packets' vectors say."),
    click.option("--lever-arm", metavar="X,Y,Z", help="From the trajectory to the scanner: forward, right, down [m]."),
    click.option("--crs", metavar="CRS", help="Of the strip, e.g. EPSG:32632, for a trajectory in degrees."),
    click.option("--flight-height", type=click.FloatRange(1.0, 100_000.0), metavar="M",
                 help="Above the ground, where neither a trajectory nor vectors say where the sensor was."),
)  # fmt: skip


def sensor_options(command: Callable) -> Callable:
    """Options of a command that say where the sensor was, for `read_sensor`."""
    for option in reversed(_OPTIONS):
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
