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
from dataclasses import asdict, replace
from pathlib import Path

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.files import toml_file
from wavebatch.files.text_file import read_text
from wavebatch.surveying.calibration import Calibration

CALIBRATION_SCHEMA = "wavebatch.calibration/1"

_DAY = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")

_SECTION = "section_constant"
_MEANING = "C_cal: cross section = C_cal R^4 amplitude sigma / transmission"
_SWATH = {"most_deg": (1e-3, 90.0), "square": (-10.0, 10.0), "fourth": (-10.0, 10.0), "odd": (-10.0, 10.0)}
"""Keys of [scan_angle] with their limits: the constant grows by exp(square u^2 + fourth u^4 + odd u), u = angle to the
right of the flight / most_deg."""
_HEADING = "A calibration: `wavebatch run --calibration` takes it for strips of the same sensor and settings."


def format_calibration(found: Calibration) -> str:
    """Return the TOML text of a calibration; `parse_calibration` gives the same constants again."""
    table = toml_file.describe_record(found)
    rows = {key: table.pop(key, None) for key in ("channel", "flight_strip")}
    document = {
        "schema": CALIBRATION_SCHEMA,
        "version": __version__,
        **{key: value for key, value in table.items() if isinstance(value, str)},
        **table,
        _SECTION: found.section_constant,
        "scan_angle": dict(zip(_SWATH, (math.degrees(found.swath[0]), *found.swath[1:]), strict=True))
        if found.swath
        else None,
        **rows,
        "target": [asdict(row) for row in found.targets] or None,
        "fingerprint": {key: item for key, item in found.fingerprint.items() if not isinstance(item, Mapping)} or None,
    }
    comments = toml_file.list_comments(Calibration, "") | {_SECTION: _MEANING}
    return toml_file.format_toml(document, heading=_HEADING, comments=comments)


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
    table = toml_file.parse_toml(text, name)
    table.check_kind("calibration")
    table.check_schema(CALIBRATION_SCHEMA)
    swath = _read_swath(table.table("scan_angle")) if "scan_angle" in table.values else ()
    fingerprint = dict(table.table("fingerprint", {}).values)
    others = ("schema", "version", _SECTION, "scan_angle", "target", "fingerprint")
    found = replace(toml_file.read_record(Calibration, table, also=others), swath=swath, fingerprint=fingerprint)
    if found.flight:
        flight = found.flight
        with contextlib.suppress(ValueError):
            flight = datetime.date.fromisoformat(flight).isoformat()
        if not _DAY.fullmatch(flight):
            raise ConfigError(f"{name}: flight must be a day such as 2026-05-31, it is {toml_file.shorten(flight)}")
        found = replace(found, flight=flight)
    known: set[tuple[int, int]] = set()
    for number, row in enumerate(found.channels, 1):
        channel = (row.digitizer, row.scanner)
        if channel in known:
            where = f"{name}: [[channel]] {number}"
            raise ConfigError(f"{where}: digitizer {channel[0]} with scanner channel {channel[1]} has two tables")
        known.add(channel)
    if _SECTION in table.values:
        _check_section(table.number(_SECTION, 0.0, 1e30), found, name)
    return found


def _read_swath(table: toml_file.TomlTable) -> tuple[float, ...]:
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
