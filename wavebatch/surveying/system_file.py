"""SYSTEM.toml: what a survey found, as a file that a later run reads instead of surveying its strip again."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.text_file import write_text
from wavebatch.surveying import Decision, Survey

SYSTEM_SCHEMA = "wavebatch.system/1"

MOST_COMPONENTS = 16
"""Gaussians that a pulse in a file may have."""


class Quantity(NamedTuple):
    """One number of a system pulse: the field it belongs to, and the values that it may have."""

    field: str
    low: float
    high: float
    meaning: str
    optional: bool = False


QUANTITIES: dict[str, Quantity] = {
    "sigma_ref_ns": Quantity("sigma_ref", 1e-3, 1e4, "Gaussian standard deviation of the echo of a flat target"),
    "baseline_dn": Quantity("baseline", -1e10, 1e10, "level without signal"),
    "baseline_spread_dn": Quantity("baseline_spread", 0.0, 1e10, "its standard deviation between waveforms"),
    "noise_std_dn": Quantity("noise_std", 1e-3, 1e10, "noise of one sample, for thresholds and errors"),
    "noise_gain": Quantity("noise_gain", 0.0, 1e6, "growth of the noise's variance per count of signal"),
    "kappa": Quantity("kappa", -0.9, 0.9, "skew of the pulse; 0 is a Gaussian"),
    "ringing": Quantity("ringing", 0.0, 1.0, "largest after-pulse, as a share of the amplitude"),
    "saturation_dn": Quantity("saturation", 1.0, 1e10, "count at which the digitizer clips", optional=True),
    "acceptance": Quantity("acceptance", 1.0, 1e6, "least fall of chi2 for which an echo is added"),
    "misfit": Quantity("misfit", 0.0, 1.0, "of strong echoes to the pulse, as a share of them", optional=True),
    "level_variance_ns2": Quantity("level_variance", -1e8, 0.0, "of level ground's echoes less the pulse's", True),
    "width_scatter_ns": Quantity("width_scatter", 0.0, 1e4, "of echo widths beyond the errors of their fits", True),
    "divergence_mrad": Quantity("divergence", 1e-3, 100.0, "full angle of the beam, 1/e^2, from its data sheet", True),
}
"""Keys of the table [system] that are plain numbers."""

COMPONENT_LIMITS = ((-10.0, 10.0), (-1e4, 1e4), (1e-3, 1e4))
"""Allowed weight, delay [ns] and sigma [ns] of a component."""

_NOISE, _COMPONENTS, _DIGITIZERS, _INDEX = "noise_by_kind_dn", "components", "digitizers", "index"
_TABLES = {"schema": str, "version": str, "strip": str, "waveforms": int}


@dataclass(frozen=True, slots=True)
class SavedSurvey:
    """A survey with where it comes from."""

    survey: Survey
    strip: str = ""
    """Name of the strip that was surveyed."""
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    """Of that strip, from `take_fingerprint`; empty when not known."""
    version: str = __version__
    """Of the program that surveyed."""


def describe_system(system: SystemPulse) -> dict[str, Any]:
    """The system pulse as plain numbers, lists and dictionaries under the keys of the file; exact."""
    own = [{_INDEX: index, **_describe_pulse(other)} for index, other in sorted(system.digitizers.items())]
    return {**_describe_pulse(system), **({_DIGITIZERS: own} if own else {})}


def _describe_pulse(system: SystemPulse) -> dict[str, Any]:
    told = {key: getattr(system, quantity.field) for key, quantity in QUANTITIES.items()}
    return {
        **{key: None if value is None else float(value) for key, value in told.items()},
        _NOISE: {kind: float(value) for kind, value in system.noise_by_kind.items()},
        _COMPONENTS: [[float(value) for value in component] for component in system.components],
    }


def format_survey(saved: SavedSurvey) -> str:
    """TOML text of a survey; `parse_survey` gives the same survey again, to the last bit of every number."""
    survey, told = saved.survey, describe_system(saved.survey.system)
    head = {
        "schema": SYSTEM_SCHEMA,
        "version": saved.version,
        "strip": saved.strip,
        "waveforms": int(survey.waveforms),
    }
    lines = ["# What a survey found: `wavebatch run --system` takes it for a strip of the same sensor and settings."]
    lines += _format_table(head)
    lines += ["", "[system]", *_format_pulse(told, "system")]
    for own in told.get(_DIGITIZERS, []):
        lines += ["", "# a digitizer that records otherwise", f"[[system.{_DIGITIZERS}]]", f"{_INDEX} = {own[_INDEX]}"]
        lines += _format_pulse(own, f"system.{_DIGITIZERS}")
    finite = {key: float(value) for key, value in survey.figures.items() if math.isfinite(value)}
    lines += ["", "[figures]", *_format_table(finite)]
    for decision in survey.decisions:
        table = {"part": decision.part, "needed": bool(decision.needed), "reason": decision.reason}
        lines += ["", "[[decision]]", *_format_table(table)]
    if saved.fingerprint:
        lines += ["", "[fingerprint]", *_format_fingerprint(saved.fingerprint)]
    return "\n".join(lines) + "\n"


def _format_pulse(told: Mapping[str, Any], name: str) -> list[str]:
    lines = []
    for key, quantity in QUANTITIES.items():
        if told[key] is not None:
            lines.append(f"{key} = {_format(told[key])}  # {quantity.meaning}")
    lines.append("# (weight, delay [ns], sigma [ns]) of each Gaussian of a learned pulse, the main one first")
    lines += _format_table({_COMPONENTS: told[_COMPONENTS]})
    return [*lines, "", f"[{name}.{_NOISE}]", *_format_table(told[_NOISE])]


def _format_table(table: Mapping[str, Any]) -> list[str]:
    return [f"{_format_key(key)} = {_format(value)}" for key, value in table.items()]


def _format_key(key: str) -> str:
    bare = key.isascii() and key.replace("_", "a").replace("-", "a").isalnum()
    return key if bare else _format(key)


def _format(value: Any) -> str:
    if isinstance(value, str):
        # JSON escapes are TOML escapes too, but for DEL, which JSON leaves as it is.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(_format(item) for item in value) + "]"
    return repr(value)


def _format_fingerprint(fingerprint: Mapping[str, Any]) -> list[str]:
    plain = {key: value for key, value in fingerprint.items() if not isinstance(value, Mapping)}
    lines = _format_table(plain)
    for key, value in fingerprint.items():
        if isinstance(value, Mapping):
            lines += ["", f"[fingerprint.{_format_key(key)}]", *_format_table(value)]
    return lines


def write_survey(path: Path, saved: SavedSurvey, *, overwrite: bool) -> None:
    """The survey as a file that appears whole or not at all; InputError where it exists or cannot be written."""
    write_text(path, format_survey(saved), overwrite=overwrite)


def load_survey(path: Path | str) -> SavedSurvey:
    """The survey of a file; ConfigError in one line that names file, key and the nearest known word."""
    try:
        text = Path(path).read_text("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: system file cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: system file is not UTF-8 text (byte {error.start})") from error
    return parse_survey(text, str(path))


def parse_survey(text: str, name: str) -> SavedSurvey:
    """The survey that TOML text describes; `name` stands in front of every error message.

    [system] is needed whole; figures, decisions and the fingerprint may be missing.
    """
    try:
        document = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from error
    tables = {**_TABLES, "system": dict, "figures": dict, "decision": list, "fingerprint": dict}
    _check_keys(document, tables, ("schema", "system"), name)
    for key, kind in tables.items():
        if key in document and type(document[key]) is not kind:
            raise ConfigError(f"{name}: {key} must be {_WORDS[kind]}, it is {_shorten(document[key])}")
    if document["schema"] != SYSTEM_SCHEMA:
        raise ConfigError(
            f"{name}: schema is {_shorten(document['schema'])}, this version reads {SYSTEM_SCHEMA!r}; survey again"
        )
    if document.get("waveforms", 0) < 0:
        raise ConfigError(f"{name}: waveforms must not be negative, it is {document['waveforms']}")
    survey = Survey(
        system=_read_system(document["system"], f"{name}: [system]"),
        waveforms=document.get("waveforms", 0),
        figures=_read_numbers(document.get("figures", {}), f"{name}: [figures]"),
        decisions=tuple(
            _read_decision(table, f"{name}: [[decision]] {number}")
            for number, table in enumerate(document.get("decision", []), 1)
        ),
    )
    return SavedSurvey(
        survey, document.get("strip", ""), document.get("fingerprint", {}), document.get("version", __version__)
    )


_WORDS = {
    str: "a string",
    int: "an integer",
    dict: "a table",
    list: "written as [[decision]] tables",
    bool: "true or false",
}


def _check_keys(table: Mapping[str, Any], known: Mapping[str, Any], needed: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in known:
            raise ConfigError(f"{where}: unknown key {_shorten(key)}; {nearest(key, known)}")
    for key in needed:
        if key not in table:
            raise ConfigError(f"{where}: key {key!r} is missing; `wavebatch survey STRIP -o FILE` writes all")


def _read_system(table: Mapping[str, Any], where: str) -> SystemPulse:
    """The table [system] with those of digitizers that record otherwise."""
    rows = table.get(_DIGITIZERS, [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ConfigError(f"{where}: {_DIGITIZERS} must be written as [[system.{_DIGITIZERS}]] tables")
    main = _read_pulse({key: value for key, value in table.items() if key != _DIGITIZERS}, where)
    own: dict[int, SystemPulse] = {}
    for number, row in enumerate(rows, 1):
        place = f"{where}: {_DIGITIZERS} {number}"
        index = row.get(_INDEX)
        if type(index) is not int or not 1 <= index <= 255 or index in own:
            raise ConfigError(f"{place}: {_INDEX} must be a number from 1 to 255 of its own, it is {_shorten(index)}")
        own[index] = _read_pulse({key: value for key, value in row.items() if key != _INDEX}, place)
    return replace(main, digitizers=own)


def _read_pulse(table: Mapping[str, Any], where: str) -> SystemPulse:
    known = (*QUANTITIES, _COMPONENTS, _NOISE)
    needed = tuple(key for key in known if not (key in QUANTITIES and QUANTITIES[key].optional))
    _check_keys(table, dict.fromkeys(known), needed, where)
    values = {
        quantity.field: _read_number(table[key], quantity.low, quantity.high, f"{where}: {key}")
        for key, quantity in QUANTITIES.items()
        if key in table
    }
    if not isinstance(table[_NOISE], dict):
        raise ConfigError(f"{where}: {_NOISE} must be a table, it is {_shorten(table[_NOISE])}")
    kinds = _read_numbers(table[_NOISE], f"{where}: {_NOISE}", low=0.0)
    return SystemPulse(**values, noise_by_kind=kinds, components=_read_components(table[_COMPONENTS], where))


def _read_components(rows: Any, where: str) -> tuple[tuple[float, float, float], ...]:
    where = f"{where}: {_COMPONENTS}"
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == 3 for row in rows):
        raise ConfigError(f"{where} must be a list of [weight, delay, sigma], it is {_shorten(rows)}")
    if len(rows) == 1 or len(rows) > MOST_COMPONENTS:
        raise ConfigError(f"{where} must be empty or hold 2 to {MOST_COMPONENTS} Gaussians, it holds {len(rows)}")
    components = tuple(
        tuple(
            _read_number(value, low, high, f"{where} row {number}")
            for value, (low, high) in zip(row, COMPONENT_LIMITS, strict=True)
        )
        for number, row in enumerate(rows, 1)
    )
    if components and components[0][0] < 0.01:
        raise ConfigError(f"{where} row 1 is the main Gaussian, its weight must be positive, it is {components[0][0]}")
    return components


def _read_numbers(table: Mapping[str, Any], where: str, low: float = -math.inf) -> dict[str, float]:
    return {key: _read_number(value, low, math.inf, f"{where}: {key}") for key, value in table.items()}


def _read_number(value: Any, low: float, high: float, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{where} must be a number, it is {_shorten(value)}")
    if isinstance(value, int) and abs(value) > 1 << 53 or not math.isfinite(value):
        raise ConfigError(f"{where} must be a finite number, it is {_shorten(value)}")
    if not low <= value <= high:
        raise ConfigError(f"{where} must lie between {low:g} and {high:g}, it is {value!r}")
    return float(value)


def _read_decision(table: Any, where: str) -> Decision:
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: must be a table, it is {_shorten(table)}")
    kinds = {"part": str, "needed": bool, "reason": str}
    _check_keys(table, kinds, tuple(kinds), where)
    for key, kind in kinds.items():
        if type(table[key]) is not kind:
            raise ConfigError(f"{where}: {key} must be {_WORDS[kind]}, it is {_shorten(table[key])}")
    return Decision(**table)


def _shorten(value: Any, limit: int = 60) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= limit else text[: limit - 3] + "..."
