"""SYSTEM.toml: the results of a survey as a file, so that a later run need not survey its strip again.

`wavebatch survey -o` writes it; `run`, `calibrate`, `compare` and `voxelize` read it with `--system`.
Before you change it: every number must come back to the last bit, and old files must stay readable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import TomlTable, check_number, format_toml, parse_toml, shorten
from wavebatch.surveying import Decision, Survey

SYSTEM_SCHEMA = "wavebatch.system/1"

MOST_COMPONENTS = 16
"""Gaussians that a pulse in a file may have."""


class Quantity(NamedTuple):
    """One number of a system pulse: its field in SystemPulse and the values that it may have."""

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
_HEADING = "What a survey found: `wavebatch run --system` takes it for a strip of the same sensor and settings."
_ABOUT_COMPONENTS = "(weight, delay [ns], sigma [ns]) of each Gaussian of a learned pulse, the main one first"
_REMEDY = "`wavebatch survey STRIP -o FILE` writes all"


@dataclass(frozen=True, slots=True)
class SavedSurvey:
    """A survey and the strip that it was made on."""

    survey: Survey
    strip: str = ""
    """Name of the strip that was surveyed."""
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    """Of that strip, from `take_fingerprint`; empty when not known."""
    version: str = __version__
    """Of the program that made the survey."""


def describe_system(system: SystemPulse) -> dict[str, Any]:
    """Return the system pulse as plain numbers, lists and dictionaries under the keys of the file; exact."""
    own = [{_INDEX: index, **_describe_pulse(other)} for index, other in sorted(system.digitizers.items())]
    return {**_describe_pulse(system), **({_DIGITIZERS: own} if own else {})}


def _describe_pulse(system: SystemPulse) -> dict[str, Any]:
    values = {key: getattr(system, quantity.field) for key, quantity in QUANTITIES.items()}
    return {
        **{key: None if value is None else float(value) for key, value in values.items()},
        _NOISE: {kind: float(value) for kind, value in system.noise_by_kind.items()},
        _COMPONENTS: [[float(value) for value in component] for component in system.components],
    }


def format_survey(saved: SavedSurvey) -> str:
    """Return the TOML text of a survey; `parse_survey` gives the same survey again, each number to the last bit."""
    survey = saved.survey
    document = {
        "schema": SYSTEM_SCHEMA,
        "version": saved.version,
        "strip": saved.strip,
        "waveforms": int(survey.waveforms),
        "system": describe_system(survey.system),
        "figures": {key: float(value) for key, value in survey.figures.items() if math.isfinite(value)},
        "decision": [{**asdict(decision), "needed": bool(decision.needed)} for decision in survey.decisions] or None,
        "fingerprint": saved.fingerprint or None,
    }
    meanings = {**{key: quantity.meaning for key, quantity in QUANTITIES.items()}, _COMPONENTS: _ABOUT_COMPONENTS}
    places = ("system", f"system.{_DIGITIZERS}")
    comments = {f"{place}.{key}": meaning for place in places for key, meaning in meanings.items()}
    comments[places[1]] = "a digitizer that records otherwise"
    return format_toml(document, heading=_HEADING, comments=comments)


def load_survey(path: Path | str) -> SavedSurvey:
    """Read a survey file; raises ConfigError, in one line, where it cannot be read or is wrong."""
    return parse_survey(read_text(path, "system file"), str(path))


def parse_survey(text: str, name: str) -> SavedSurvey:
    """Read the TOML text of a survey.

    Parameters
    ----------
    text : str
        The table [system] must be whole; figures, decisions and fingerprint may be missing.
    name : str
        Start of every message, usually the path.

    Returns
    -------
    SavedSurvey

    Raises
    ------
    ConfigError
        With file, table and key, and the nearest known word for an unknown key.
    """
    table = parse_toml(text, name)
    known = ("schema", "version", "strip", "waveforms", "system", "figures", "decision", "fingerprint")
    table.check_keys(known, ("schema", "system"), _REMEDY)
    table.check_schema(SYSTEM_SCHEMA, "survey again")
    survey = Survey(
        system=_read_system(table.table("system")),
        waveforms=table.integer("waveforms", 0, 10**12, 0),
        figures=_read_numbers(table.table("figures", {})),
        decisions=tuple(map(_read_decision, table.tables("decision"))),
    )
    texts = (table.get("strip", str, ""), table.get("fingerprint", dict, {}), table.get("version", str, __version__))
    return SavedSurvey(survey, *texts)


def _read_system(table: TomlTable) -> SystemPulse:
    """The table [system] with those of the digitizers that record otherwise."""
    own: dict[int, SystemPulse] = {}
    for row in table.tables(_DIGITIZERS, f"system.{_DIGITIZERS}"):
        index = row.integer(_INDEX, 1, 255)
        if index in own:
            raise ConfigError(f"{row.where}: {_INDEX} {index} is there already; give each digitizer one table")
        own[index] = _read_pulse(row, _INDEX)
    return replace(_read_pulse(table, _DIGITIZERS), digitizers=own)


def _read_pulse(table: TomlTable, extra: str) -> SystemPulse:
    """A pulse from a table that may hold one extra key."""
    needed = (*(key for key, quantity in QUANTITIES.items() if not quantity.optional), _COMPONENTS, _NOISE)
    table.check_keys((*QUANTITIES, _COMPONENTS, _NOISE, extra), needed, _REMEDY)
    values = {
        quantity.field: table.number(key, quantity.low, quantity.high)
        for key, quantity in QUANTITIES.items()
        if key in table.values
    }
    return SystemPulse(
        **values, noise_by_kind=_read_numbers(table.table(_NOISE), low=0.0), components=_read_components(table)
    )


def _read_components(table: TomlTable) -> tuple[tuple[float, float, float], ...]:
    where, rows = f"{table.where}: {_COMPONENTS}", table.values[_COMPONENTS]
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == 3 for row in rows):
        raise ConfigError(f"{where} must be a list of [weight, delay, sigma], it is {shorten(rows)}")
    if len(rows) == 1 or len(rows) > MOST_COMPONENTS:
        raise ConfigError(f"{where} must be empty or hold 2 to {MOST_COMPONENTS} Gaussians, it holds {len(rows)}")
    components = tuple(
        tuple(check_number(value, *limits, f"{where} row {number}")
              for value, limits in zip(row, COMPONENT_LIMITS, strict=True))
        for number, row in enumerate(rows, 1)
    )  # fmt: skip
    if components and components[0][0] < 0.01:
        raise ConfigError(f"{where} row 1 is the main Gaussian, its weight must be positive, it is {components[0][0]}")
    return components


def _read_numbers(table: TomlTable, low: float = -math.inf) -> dict[str, float]:
    return {key: table.number(key, low) for key in table.values}


def _read_decision(table: TomlTable) -> Decision:
    kinds = {"part": str, "needed": bool, "reason": str}
    table.check_keys(kinds, kinds, _REMEDY)
    return Decision(**{key: table.get(key, kind) for key, kind in kinds.items()})
