"""CAL.toml: a calibration as a file that a person can read and change.

`wavebatch calibrate` writes it, `run` and `voxelize` read it. Before you change it: files of earlier versions must stay
readable, and a key that is taken out by hand must only take its check away.
"""

from __future__ import annotations

import contextlib
import datetime
import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import TomlTable, format_toml, parse_toml, shorten
from wavebatch.files.toml_schema import Key, Rows, describe_keys, read_keys
from wavebatch.surveying.calibration import Calibration, ChannelConstant, StripConstant

CALIBRATION_SCHEMA = "wavebatch.calibration/1"

_NUMBERS: dict[str, Key] = {
    "constant": Key(
        "constant", 1e-30, 1e30, "C' [1/(m2 count ns)]: gamma = C' R^2 amplitude sigma / transmission"
    ),
    "relative_error": Key("relative_error", 0.0, 10.0, "standard deviation of the constant, relative"),
    "attenuation_db_km": Key("attenuation", 0.0, 100.0, "of the air, one way, as it was used for the constant", True),
    "haze": Key(
        "haze", 1e-6, 10.0, "of the flight over usual ones: other heights have other air", optional=True
    ),
    "divergence_mrad": Key(
        "divergence", 1e-3, 100.0, "full angle of the beam between the 1/e^2 points; needed for m2", optional=True
    ),
    "height_m": Key("height", 0.0, 1e7, "of the sensor above the targets, median", optional=True),
    "distance_m": Key(
        "distance", 0.0, 1e7, "from the sensor to the targets, median: others are less certain", optional=True
    ),
    "pulse_rate_hz": Key("rate", 1e-3, 1e12, "by GPS times: a laser has another energy at another rate", optional=True),
    "energy_mean": Key(
        "energy_mean", 1e-30, 1e30, "mean energy of the pulses: light was divided by the energy over it", optional=True
    ),
    "energy_spread": Key("energy_spread", 0.0, 1e6, "of the energies from shot to shot, relative", optional=True),
    "section_constant": Key(
        "section_constant", 0.0, 1e30, "C_cal: cross section = C_cal R^4 amplitude sigma / transmission", optional=True
    ),
}  # fmt: skip
"""Numbers of the file by key."""

_CONSTANT: dict[str, Key] = {
    "digitizer": Key("digitizer", 1, 255, kind=int),
    "scanner": Key("scanner", 0, 3, optional=True, kind=int),
    "constant": _NUMBERS["constant"],
    "relative_error": _NUMBERS["relative_error"],
}
"""Keys of any constant of a channel."""

_CHANNEL: dict[str, Key | Rows] = {
    **_CONSTANT,
    "spread": Key("spread", 0.0, 1e6, optional=True),
    "echoes": Key("echoes", 0, 10**12, optional=True, kind=int),
    "shot_energy": Key("shot_energy", 0.0, 1e6, optional=True),
    "bits": Key("bits", 1, 32, optional=True, kind=int),
    "samples": Key("samples", 1, 1 << 32, optional=True, kind=int),
    "spacing_ns": Key("spacing_ns", 1e-6, 1e9, optional=True),
    "gain": Key("gain", -math.inf, math.inf, optional=True),
    "pulse_ns": Key("pulse_ns", 1e-6, 1e9, optional=True),
    "noise_dn": Key("noise_dn", 0.0, 1e12, optional=True),
    "brightest": Key("brightest", 0.0, 1e30, optional=True),
    "scene": Rows("scene", ((-100.0, 100.0),), "numbers", "", optional=True),
}
"""Keys of a [[channel]]."""

_STRIP: dict[str, Key] = _CONSTANT | {
    "drift": Key("drift", -1.0, 1e6, optional=True),
    "drift_error": Key("drift_error", 0.0, 1e6, optional=True),
    "ties": Key("ties", 0, 10**12, optional=True, kind=int),
}
"""Keys of a [[flight_strip]] that are numbers."""

_DAY = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")

_TEXTS = ("strip", "date", "conditions", "sensor", "software", "flight", "chain", "decomposer", "energy_source",
          "energy_unit")  # fmt: skip
_SWATH = {"most_deg": (1e-3, 90.0), "square": (-10.0, 10.0), "fourth": (-10.0, 10.0), "odd": (-10.0, 10.0)}
"""Keys of [scan_angle] with their limits: the constant grows by exp(square u^2 + fourth u^4 + odd u), u = angle to the
right of the flight / most_deg."""
_HEADING = "A calibration: `wavebatch run --calibration` takes it for strips of the same sensor and settings."


def format_calibration(found: Calibration) -> str:
    """Return the TOML text of a calibration; `parse_calibration` gives the same constants again."""
    document = {
        "schema": CALIBRATION_SCHEMA,
        "version": __version__,
        **{key: getattr(found, key) for key in _TEXTS},
        **describe_keys(found, _NUMBERS),
        "scan_angle": dict(zip(_SWATH, (math.degrees(found.swath[0]), *found.swath[1:]), strict=True))
        if found.swath
        else None,
        "channel": [asdict(row) for row in found.channels] or None,
        "flight_strip": [asdict(row) for row in found.strips] or None,
        "target": [asdict(row) for row in found.targets] or None,
        "fingerprint": {key: item for key, item in found.fingerprint.items() if not isinstance(item, Mapping)} or None,
    }
    return format_toml(document, heading=_HEADING, comments={key: entry.meaning for key, entry in _NUMBERS.items()})


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file; raises ConfigError, in one line, where it cannot be read or is wrong."""
    return parse_calibration(read_text(path, "calibration file"), str(path))


def parse_calibration(text: str, name: str) -> Calibration:
    """Read the TOML text of a calibration.

    Parameters
    ----------
    text : str
    name : str
        Start of every message, usually the path.

    Returns
    -------
    Calibration
        Without `targets`, which nothing uses after the measurement.

    Raises
    ------
    ConfigError
        When a key is unknown, missing or out of its range, or where section_constant does not fit the others.
    """
    table = parse_toml(text, name)
    table.check_kind("calibration")
    tables = ("scan_angle", "channel", "flight_strip", "target", "fingerprint")
    table.check_keys(("schema", "version", *_TEXTS, *_NUMBERS, *tables))
    table.check_schema(CALIBRATION_SCHEMA)
    values = read_keys(table, _NUMBERS)
    section = values.pop("section_constant", None)
    texts: dict[str, Any] = {key: str(table.values.get(key, "")) for key in _TEXTS}
    if texts["flight"]:
        with contextlib.suppress(ValueError):
            texts["flight"] = datetime.date.fromisoformat(texts["flight"]).isoformat()
        if not _DAY.fullmatch(texts["flight"]):
            raise ConfigError(f"{name}: flight must be a day such as 2026-05-31, it is {shorten(texts['flight'])}")
    channels: dict[tuple[int, int], ChannelConstant] = {}
    for row in table.tables("channel"):
        channel = _read_channel(row)
        key = (channel.digitizer, channel.scanner)
        if key in channels:
            raise ConfigError(f"{row.where}: digitizer {key[0]} with scanner channel {key[1]} has two tables")
        channels[key] = channel
    strips = tuple(map(_read_strip, table.tables("flight_strip")))
    swath = _read_swath(table.table("scan_angle")) if "scan_angle" in table.values else ()
    fingerprint = dict(table.table("fingerprint").values) if "fingerprint" in table.values else {}
    found = Calibration(
        **values, **texts, channels=tuple(channels.values()), strips=strips, swath=swath, fingerprint=fingerprint
    )
    if section is not None:
        _check_section(section, found, name)
    return found


def _read_swath(table: TomlTable) -> tuple[float, ...]:
    table.check_keys(_SWATH)
    even = {key: limits for key, limits in _SWATH.items() if key != "odd"}
    most, *terms = (table.number(key, low, high) for key, (low, high) in even.items())
    terms.append(table.number("odd", *_SWATH["odd"], default=0.0))  # older files have none
    return (math.radians(most), *terms)


def _check_section(section: float, found: Calibration, name: str) -> None:
    """Raise ConfigError where C_cal does not follow from the other two: one was changed by hand."""
    expected = found.section_constant
    if expected is None or abs(section - expected) > 1e-3 * expected:
        wanted = "no divergence_mrad" if expected is None else f"{expected!r} by constant and divergence_mrad"
        problem = f"section_constant is {section!r}, but there is {wanted}"
        raise ConfigError(f"{name}: {problem}; correct these, or leave section_constant out")


def _read_channel(table: TomlTable) -> ChannelConstant:
    table.check_keys(_CHANNEL)
    return ChannelConstant(**{"scanner": 0, **read_keys(table, _CHANNEL)})


def _read_strip(table: TomlTable) -> StripConstant:
    table.check_keys(("strip", "sha256", *_STRIP))
    names = {"strip": table.get("strip", str, ""), "sha256": table.get("sha256", str)}
    return StripConstant(**{**names, "scanner": 0, **read_keys(table, _STRIP)})
