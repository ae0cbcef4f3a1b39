"""SYSTEM.toml: the results of a survey as a file, so that a later run need not survey its strip again.

`wavebatch survey -o` writes it; `run`, `calibrate`, `compare` and `voxelize` read it with `--system`.
Before you change it: every number must come back to the last bit, and old files must stay readable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.core.frozen import frozen
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import format_toml, parse_toml
from wavebatch.surveying.systems import figures as tables
from wavebatch.surveying.systems.survey_result import Decision, Survey

SYSTEM_SCHEMA = "wavebatch.system/1"

_HEADING = "What a survey found: `wavebatch run --system` takes it for a strip of the same sensor and settings."


@frozen
class SavedSurvey:
    """A survey and the strip that it was made on."""

    survey: Survey
    strip: str = ""
    """Name of the strip that was surveyed."""
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    """Of that strip, from `take_fingerprint`; empty when not known."""
    version: str = __version__
    """Of the program that made the survey."""
    sensor: str = ""
    """Name of the sensor, where a person has written it into the file."""


def format_survey(saved: SavedSurvey) -> str:
    """Return the TOML text of a survey; `parse_survey` gives the same survey again, each number to the last bit."""
    survey = saved.survey
    document = {
        "schema": SYSTEM_SCHEMA,
        "version": saved.version,
        "strip": saved.strip,
        "sensor": saved.sensor or None,
        "waveforms": int(survey.waveforms),
        "system": tables.describe_system(survey.system),
        "figures": tables.describe_figures(survey.figures),
        "decision": [{**asdict(decision), "needed": bool(decision.needed)} for decision in survey.decisions] or None,
        "fingerprint": saved.fingerprint or None,
    }
    return format_toml(document, heading=_HEADING, comments=tables.comment_system())


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
    table.check_kind("system")
    known = ("schema", "version", "strip", "sensor", "waveforms", "system", "figures", "decision", "fingerprint")
    table.check_keys(known, ("schema", "system"), tables.REMEDY)
    table.check_schema(SYSTEM_SCHEMA, "survey again")
    system = tables.read_system(table.table("system"))
    waveforms, figures = table.integer("waveforms", 0, 10**12, 0), tables.read_figures(table.table("figures", {}))
    kinds, decisions = {"part": str, "needed": bool, "reason": str}, []
    for row in table.tables("decision"):
        row.check_keys(kinds, kinds, tables.REMEDY)
        decisions.append(Decision(**{key: row.get(key, kind) for key, kind in kinds.items()}))
    survey = Survey(system, waveforms, figures, tuple(decisions))
    texts = (table.get("strip", str, ""), table.get("fingerprint", dict, {}), table.get("version", str, __version__))
    return SavedSurvey(survey, *texts, table.get("sensor", str, ""))
