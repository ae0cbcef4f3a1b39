"""The table [system] of a SYSTEM.toml: a system pulse as plain numbers, and back.

`system_file` writes and reads whole files with it, `known_systems` the pulses that are shipped. Keys, ranges and
comments are those of the fields of SystemPulse. Before you change it: every number must come back to the last bit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.toml_file import TomlTable, describe_record, list_comments, read_record

MOST_COMPONENTS = 16
"""Gaussians that a pulse in a file may have."""

_DIGITIZERS, _INDEX = "digitizers", "index"
REMEDY = "`wavebatch survey STRIP -o FILE` writes all"
"""What to do where a key is missing."""


def describe_system(system: SystemPulse) -> dict[str, Any]:
    """Return the system pulse as plain numbers, lists and dictionaries under the keys of the file; exact."""
    own = [{_INDEX: index, **describe_record(other)} for index, other in sorted(system.digitizers.items())]
    return {**describe_record(system), **({_DIGITIZERS: own} if own else {})}


def comment_system() -> dict[str, str]:
    """Return the comments of a file by dotted key."""
    nested = f"system.{_DIGITIZERS}"
    return list_comments(SystemPulse, "system", nested) | {nested: "a digitizer that records otherwise"}


def read_system(table: TomlTable) -> SystemPulse:
    """Read the table [system] with those of the digitizers that record otherwise; raises ConfigError."""
    own: dict[int, SystemPulse] = {}
    for row in table.tables(_DIGITIZERS, f"system.{_DIGITIZERS}"):
        index = row.integer(_INDEX, 1, 255)
        if index in own:
            raise ConfigError(f"{row.where}: {_INDEX} {index} has two tables; give each digitizer one")
        own[index] = _read_pulse(row, _INDEX)
    return replace(_read_pulse(table, _DIGITIZERS), digitizers=own)


def _read_pulse(table: TomlTable, extra: str) -> SystemPulse:
    """A pulse from a table that may hold one extra key."""
    found = read_record(SystemPulse, table, remedy=REMEDY, also=(extra,))
    _check_components(found.components, f"{table.where}: components")
    _check_whitening(found.noise.whitening, f"{table.where}: whitening")
    return found


def _check_components(components: tuple[tuple[float, ...], ...], where: str) -> None:
    if len(components) == 1 or len(components) > MOST_COMPONENTS:
        raise ConfigError(f"{where} must be empty or hold 2 to {MOST_COMPONENTS} Gaussians, it holds {len(components)}")
    if components and components[0][0] < 0.01:
        raise ConfigError(f"{where} row 1 is the main Gaussian, its weight must be positive, it is {components[0][0]}")


def _check_whitening(whitening: tuple[float, ...], where: str) -> None:
    if whitening and not (len(whitening) == 2 and abs(whitening[1]) < 1 and abs(whitening[0]) < 1 - whitening[1]):
        raise ConfigError(f"{where} must be empty or hold two shares a, b of steady noise: |a| < 1 - b and |b| < 1")
