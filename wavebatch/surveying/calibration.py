"""CAL.toml: the calibration constant of a sensor, where it comes from, and the stages that it and the sensor allow."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import STAGES, Chain, Step

CALIBRATION_SCHEMA = "wavebatch.calibration/1"

NEEDS_SENSOR = ("range", "backscatter_coefficient", "cross_section", "reflectance", "incidence_angle")
"""Columns that need the sensor's position."""

_NUMBERS = {
    "constant": (1e-30, 1e30, None, "C' [1/(m2 count ns)]: gamma = C' R^2 amplitude sigma / transmission"),
    "relative_error": (0.0, 10.0, None, "standard deviation of the constant, relative"),
    "attenuation_db_km": (0.0, 100.0, 0.22, "of the air, one way, as it was used for the constant"),
    "divergence_mrad": (1e-3, 100.0, math.nan, "full angle of the beam between the 1/e^2 points; needed for m2"),
}
_SECTION = (0.0, 1e30, math.nan, "C_cal: cross section = C_cal R^4 amplitude sigma / transmission")
_MORE_NUMBERS = {
    "section_constant": _SECTION,
    "digitizer": (1, 255, None, "index of the wave packet descriptor"),
    "scanner": (0, 3, 0, "scanner channel of the points"),
    "spread": (0.0, 1e6, 0.0, "of the echoes' constants, relative, robust standard deviation"),
    "echoes": (0, 1e12, 0, "that it comes from"),
}
_CHANNEL = ("digitizer", "scanner", "constant", "relative_error", "spread", "echoes")
_TEXTS = ("schema", "version", "strip", "date", "conditions")
_TABLES = ("fingerprint", "target", "channel")


@dataclass(frozen=True, slots=True)
class Calibration:
    """What turns amplitudes into backscatter; picklable."""

    constant: float
    relative_error: float
    attenuation: float = 0.22
    """[dB/km]."""
    divergence: float | None = None
    """[mrad]; None where nobody gave it."""
    strip: str = ""
    date: str = ""
    conditions: str = ""
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    targets: tuple[Mapping[str, Any], ...] = ()
    """What each reference target gave: name, reflectance, echoes, constant, spread."""
    channels: tuple[Mapping[str, Any], ...] = ()
    """Channels with a constant of their own: digitizer, scanner, constant, relative_error, spread, echoes."""

    @property
    def section_constant(self) -> float | None:
        """C_cal [1/(m2 count ns)]; None where nobody gave the divergence."""
        return None if self.divergence is None else 0.25 * math.pi * (1e-3 * self.divergence) ** 2 * self.constant

    def apply(self, system: SystemPulse) -> SystemPulse:
        """The system with this calibration; a divergence of its own stays."""
        return replace(
            system,
            calibration=self.constant,
            calibration_err=self.relative_error,
            channels={
                (row["digitizer"], row["scanner"]): (row["constant"], row["relative_error"]) for row in self.channels
            },
            attenuation=self.attenuation,
            divergence=self.divergence if system.divergence is None else system.divergence,
        )

    def describe(self) -> dict[str, Any]:
        """For reports."""
        return {
            "constant": self.constant,
            "relative_error": self.relative_error,
            "attenuation_db_km": self.attenuation,
            "divergence_mrad": self.divergence,
            "section_constant": self.section_constant,
            "strip": self.strip,
            "date": self.date,
            "channels": [dict(row) for row in self.channels],
        }


def with_physics(chain: Chain, *, sensor: bool, calibrated: bool, divergence: bool) -> Chain:
    """The chain with the stages that what is known allows, behind those it has; as it is where it has them."""
    names = ["attribute.range"] if sensor or calibrated or divergence else []
    names += ["attribute.incidence_angle"] if divergence else []
    names += ["attribute.backscatter_coefficient"] if calibrated else []
    names += ["attribute.cross_section"] if calibrated and divergence else []
    names += ["attribute.reflectance"] if calibrated else []
    have = {step.stage.name for step in chain.steps}
    added = tuple(Step(STAGES[name]) for name in names if name not in have)
    return replace(chain, steps=(*chain.steps, *added)) if added else chain


def needs_sensor(chain: Chain) -> bool:
    """Whether a chain computes anything that needs the sensor's position."""
    return any(name in NEEDS_SENSOR for name in chain.makes)


def format_calibration(found: Calibration) -> str:
    """TOML text; `parse_calibration` gives the same calibration again."""
    lines = ["# A calibration: `wavebatch run --calibration` takes it for strips of the same sensor and settings."]
    texts = (CALIBRATION_SCHEMA, __version__, found.strip, found.date, found.conditions)
    lines += [f"{key} = {json.dumps(value)}" for key, value in zip(_TEXTS, texts, strict=True)]
    values = (found.constant, found.relative_error, found.attenuation, found.divergence, found.section_constant)
    numbers = {**_NUMBERS, "section_constant": _SECTION}
    for (key, (*_, meaning)), value in zip(numbers.items(), values, strict=True):
        if value is not None:
            lines.append(f"{key} = {float(value)!r}  # {meaning}")
    for word, tables in (("channel", found.channels), ("target", found.targets)):
        for table in tables:
            lines += ["", f"[[{word}]]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    plain = {key: value for key, value in found.fingerprint.items() if not isinstance(value, Mapping)}
    if plain:
        lines += ["", "[fingerprint]", *(f"{key} = {json.dumps(value)}" for key, value in plain.items())]
    return "\n".join(lines) + "\n"


def load_calibration(path: Path | str) -> Calibration:
    """The calibration of a file; ConfigError in one line that names file and key."""
    try:
        text = Path(path).read_text("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: calibration file cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: calibration file is not UTF-8 text (byte {error.start})") from error
    return parse_calibration(text, str(path))


def parse_calibration(text: str, name: str) -> Calibration:
    """The calibration that TOML text describes; `name` stands in front of every error message."""
    try:
        document = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from error
    keys = (*_TEXTS, *_NUMBERS, "section_constant", *_TABLES)
    for key in document:
        if key not in keys:
            raise ConfigError(f"{name}: unknown key {key!r}; {nearest(key, keys)}")
    if document.get("schema") != CALIBRATION_SCHEMA:
        raise ConfigError(f"{name}: schema is {document.get('schema')!r}, this version reads {CALIBRATION_SCHEMA!r}")
    constant, error, attenuation, divergence = (_read_number(document, key, name) for key in _NUMBERS)
    texts = {key: str(document.get(key, "")) for key in ("strip", "date", "conditions")}
    divergence = None if math.isnan(divergence) else divergence
    channels = _read_channels(document.get("channel", []), name)
    found = Calibration(constant, error, attenuation, divergence, **texts, channels=channels)
    if "section_constant" in document:
        _check_section(_read_number(document, "section_constant", name), found, name)
    return found


def _check_section(said: float, found: Calibration, name: str) -> None:
    """Raises ConfigError where C_cal is not that of the constant and the divergence: one was changed, not the other."""
    expected = found.section_constant
    if expected is None or abs(said - expected) > 1e-3 * expected:
        wanted = "no divergence_mrad" if expected is None else f"{expected!r} by constant and divergence_mrad"
        raise ConfigError(f"{name}: section_constant is {said!r}, but there is {wanted}: mend these, or leave it out")


def _read_channels(rows: Any, name: str) -> tuple[dict[str, Any], ...]:
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        raise ConfigError(f"{name}: channel must be written as [[channel]] tables")
    channels: dict[tuple[int, int], dict[str, Any]] = {}
    for number, row in enumerate(rows, 1):
        where = f"{name}: [[channel]] {number}"
        for key in row:
            if key not in _CHANNEL:
                raise ConfigError(f"{where}: unknown key {key!r}; {nearest(key, _CHANNEL)}")
        index, scanner = (_read_whole(row, key, where) for key in _CHANNEL[:2])
        if (index, scanner) in channels:
            raise ConfigError(f"{where}: digitizer {index} with scanner channel {scanner} is there already")
        numbers = {key: _read_number(row, key, where) for key in _CHANNEL[2:]}
        channels[index, scanner] = {"digitizer": index, "scanner": scanner, **numbers}
    return tuple(channels.values())


def _read_whole(row: Mapping[str, Any], key: str, where: str) -> int:
    value = _read_number(row, key, where)
    if value != int(value):
        raise ConfigError(f"{where}: {key} must be a whole number, it is {value!r}")
    return int(value)


def _read_number(document: Mapping[str, Any], key: str, name: str) -> float:
    low, high, default, meaning = {**_NUMBERS, **_MORE_NUMBERS}[key]
    value = document.get(key, default)
    if value is None:
        raise ConfigError(f"{name}: key {key!r} is missing: {meaning}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{name}: {key} must be a number, it is {value!r}")
    if key in document and not low <= value <= high:
        raise ConfigError(f"{name}: {key} must lie between {low:g} and {high:g}, it is {value!r}")
    return float(value)
