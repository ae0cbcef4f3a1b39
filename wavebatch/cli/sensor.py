"""The options of every command that asks where the sensor was."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from wavebatch.errors import ConfigError

if TYPE_CHECKING:
    from wavebatch.sensor import SensorRequest


def read_sensor(options: Mapping[str, Any]) -> SensorRequest:
    """What --trajectory, --crs, --lever-arm and --flight-height ask for; ConfigError where they cannot be meant."""
    from wavebatch.sensor import SensorRequest

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
