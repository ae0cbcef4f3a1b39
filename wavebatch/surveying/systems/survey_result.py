"""What a survey says of sensor and scene, how a prompt and a notebook show it, and its file, SYSTEM.toml.

`survey` makes it; runs with a saved survey need no more of a survey than this. The picture of the pulse needs no
matplotlib, so that a notebook shows it everywhere.

`wavebatch survey -o` writes the file, so that a later run need not survey its strip again; `run`, `calibrate`,
`compare` and `voxelize` read it with `--system`. Before you change it: every number must come back to the last bit, and
old files must stay readable.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import format_toml, list_comments, parse_toml
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits
from wavebatch.surveying.systems import figures as tables
from wavebatch.surveying.systems.figures import Figures

WIDE, HIGH, MARGIN = 320, 140, 16
"""Size of the picture, and the strip below it for the times [pixels]."""


class Part(StrEnum):
    """Parts of a chain that a survey decides on; the values stand in files and reports."""

    PULSE = "sum of Gaussians"
    """As pulse: learned from the strip, or a shipped one."""
    SKEW = "skewed pulse"
    GROWTH = "growth of fits"
    PRIOR = "width prior"
    CENSORED = "censored fit"
    WEIGHTS = "signal-dependent weights"
    WIDTH = "echo width"
    ANGLE = "incidence angle"
    INVERTED = "inverted waveforms"
    """Only where they are."""


@frozen
class Decision:
    """Whether the strip needs a part of the chain, and why."""

    part: str
    """A Part; any text where a file of another version has it."""
    needed: bool
    reason: str


class Tried(NamedTuple):
    """A pulse that was tried, in a line of `survey`."""

    name: str
    fwhm_ns: float
    gaussians: int
    """Of its sum; 1 also for a skewed pulse."""
    change: float
    """Of the shape, from shot to shot, as a share of the amplitude."""
    nats: float
    """That describe a waveform; and standard errors by which they are more than with the chosen pulse."""
    longer_by: float
    echoes_per_waveform: float
    chosen: bool


@frozen
class Survey:
    """What a sample of a strip says of sensor and scene."""

    system: SystemPulse
    waveforms: int
    figures: Figures = field(default_factory=Figures)
    decisions: tuple[Decision, ...] = ()
    candidates: tuple[Tried, ...] = field(default=(), compare=False)
    """Pulses that were tried, that which describes waveforms best first; empty for a survey from a file."""

    def __repr__(self) -> str:
        lines = (f"  {name:14}{text}" for name, text in _describe(self))
        return "\n".join(["<Survey>", *lines])

    def _repr_html_(self) -> str:
        """Table of the same lines beside the pulse; what Jupyter shows."""
        from html import escape  # 10 ms

        rows = "".join(f"<tr><th>{name}</th><td>{escape(text)}</td></tr>" for name, text in _describe(self))
        system, spacing = self.system, self.figures.spacing_ns or 1.0
        return f'<div style="display:flex;gap:1em"><table>{rows}</table>{_draw(*sample_pulse(system, spacing))}</div>'


def _describe(survey: Survey) -> Iterator[tuple[str, str]]:
    """Name and text of each line."""
    system, figures = survey.system, survey.figures
    yield "surveyed", f"{survey.waveforms} waveforms"
    yield "noise", f"{system.noise.std:.3f} DN, baseline {system.noise.baseline:.3f} DN"
    yield "system pulse", f"{name_model(system)}; full width at half maximum {system.sigma_ref * FWHM_PER_SIGMA:.3f} ns"
    if figures.echoes_per_waveform is not None:
        yield "echoes", f"{figures.echoes_per_waveform:.3f} per waveform, 99 % below {figures.amplitude_99:.1f} DN"
    needed = ", ".join(decision.part for decision in survey.decisions if decision.needed)
    yield "needed", needed or "nothing beyond the plainest chain"


def name_model(system: SystemPulse) -> str:
    """The kind of pulse that is fitted."""
    if system.components:
        return f"sum of {len(system.components)} Gaussians"
    return f"skewed, kappa {system.kappa:.4f}" if system.kappa else "Gaussian"


def sample_pulse(system: SystemPulse, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Times after the peak [ns] and heights of the pulse that is fitted, 1 at its peak; f8 (400,)."""
    wide = 4 * system.sigma_ref
    delays = [delay + 3 * sigma for _, delay, sigma in system.components]
    time = np.linspace(-wide, max([2 * wide, *delays]), 400)
    shape = pulse_shape(system, spacing)
    described = np.array([[1.0, 0.0, system.sigma_ref / spacing]])
    amplitude, centre, width = model_parameters(shape, shape_limits(system, spacing), described).T
    return time, float(amplitude[0]) * evaluate_pulse(shape, time / spacing, centre[0], width[0])[0]


def _draw(time: np.ndarray, height: np.ndarray) -> str:
    """The pulse over its time, as SVG."""
    low, high = min(0.0, float(height.min())), float(height.max())
    across = WIDE * (time - time[0]) / (time[-1] - time[0])
    down = HIGH * (high - height) / (high - low) + 2
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
    ground = HIGH * high / (high - low) + 2
    texts = "".join(
        f'<text x="{place}" y="{HIGH + MARGIN}" text-anchor="{anchor}" font-size="11">{words}</text>'
        for place, anchor, words in ((0, "start", f"{time[0]:.1f} ns"), (WIDE, "end", f"{time[-1]:.1f} ns"))
    )
    return (
        f'<svg role="img" aria-label="system pulse" fill="currentColor" width="{WIDE}" height="{HIGH + MARGIN + 4}">'
        f'<path d="M0 {ground:.1f}H{WIDE}" stroke="#8a8a8a"/>'
        f'<polyline points="{points}" fill="none" stroke="#1f77b4" stroke-width="1.5"/>{texts}</svg>'
    )


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
    others = f"system.{tables.DIGITIZERS}"
    comments = list_comments(SystemPulse, "system", others) | {others: "a digitizer that records otherwise"}
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
    table.check_kind("system")
    known = ("schema", "version", "strip", "sensor", "unlike_gaussian", "waveforms", "system", "figures", "decision",
             "fingerprint")  # fmt: skip
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
