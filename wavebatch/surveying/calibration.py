"""The calibration of a sensor: its constant, the file CAL.toml, and the stages that it adds to a chain.

`targets` measures a calibration, `wavebatch calibrate` writes it, `wavebatch run` reads it for each strip.
Before you change it: files of earlier versions must stay readable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import REQUIRED, TomlTable, format_toml, parse_toml
from wavebatch.stages.chain import STAGES, Chain, Step

CALIBRATION_SCHEMA = "wavebatch.calibration/1"

NEEDS_SENSOR = (
    "range", "backscatter_coefficient", "cross_section", "reflectance", "incidence_angle", "relative_backscatter",
    "relative_cross_section", "relative_reflectance",
)  # fmt: skip
"""Columns that need the sensor's position."""

_NUMBERS: dict[str, tuple[str, float, float, Any, str]] = {
    "constant": (
        "constant", 1e-30, 1e30, REQUIRED, "C' [1/(m2 count ns)]: gamma = C' R^2 amplitude sigma / transmission"
    ),
    "relative_error": ("relative_error", 0.0, 10.0, REQUIRED, "standard deviation of the constant, relative"),
    "attenuation_db_km": ("attenuation", 0.0, 100.0, 0.22, "of the air, one way, as it was used for the constant"),
    "divergence_mrad": (
        "divergence", 1e-3, 100.0, None, "full angle of the beam between the 1/e^2 points; needed for m2"
    ),
    "section_constant": (
        "section_constant", 0.0, 1e30, None, "C_cal: cross section = C_cal R^4 amplitude sigma / transmission"
    ),
}  # fmt: skip
"""Numbers of the file by key: field of Calibration, least and largest value, default, meaning."""

_HEADING = "A calibration: `wavebatch run --calibration` takes it for strips of the same sensor and settings."
_TEXTS = ("strip", "date", "conditions")


@dataclass(frozen=True, slots=True)
class TargetResult:
    """What one reference target gave; the last three are None where it has too few echoes."""

    name: str
    reflectance: float
    echoes: int
    """Clean single echoes on the target."""
    constant: float | None = None
    """Median of the echoes' constants [1/(m2 count ns)]."""
    spread: float | None = None
    """Robust standard deviation of the echoes' constants, relative."""
    incidence_deg: float | None = None
    """Median angle between ray and normal [deg]."""


@dataclass(frozen=True, slots=True)
class ChannelConstant:
    """The calibration of one channel: a digitizer together with a scanner channel."""

    digitizer: int
    """Index of the wave packet descriptor."""
    scanner: int
    """Scanner channel of the points."""
    constant: float
    relative_error: float
    spread: float = 0.0
    """Robust standard deviation of the echoes' constants, relative."""
    echoes: int = 0
    """Echoes that the constant was measured from."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Constants that turn amplitudes into backscatter; picklable."""

    constant: float
    """C' [1/(m2 count ns)]."""
    relative_error: float
    """Standard deviation of the constant, relative."""
    attenuation: float = 0.22
    """Of the air, one way [dB/km]."""
    divergence: float | None = None
    """Full angle of the beam between the 1/e^2 points [mrad]; None where unknown."""
    strip: str = ""
    date: str = ""
    conditions: str = ""
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    """Of the strip that was measured."""
    targets: tuple[TargetResult, ...] = ()
    channels: tuple[ChannelConstant, ...] = ()
    """Channels that have a constant of their own."""

    @property
    def section_constant(self) -> float | None:
        """C_cal [1/(m2 count ns)]; None where the divergence is unknown."""
        return None if self.divergence is None else 0.25 * math.pi * (1e-3 * self.divergence) ** 2 * self.constant

    def apply(self, system: SystemPulse) -> SystemPulse:
        """Return the system pulse with this calibration; a divergence that the system has already stays."""
        return replace(
            system,
            calibration=self.constant,
            calibration_err=self.relative_error,
            channels={(row.digitizer, row.scanner): (row.constant, row.relative_error) for row in self.channels},
            attenuation=self.attenuation,
            divergence=self.divergence if system.divergence is None else system.divergence,
        )

    def describe(self) -> dict[str, Any]:
        """Return the calibration as plain values for reports."""
        return {
            **{key: getattr(self, name) for key, (name, *_) in _NUMBERS.items()},
            "strip": self.strip,
            "date": self.date,
            "channels": [asdict(row) for row in self.channels],
        }


def with_physics(chain: Chain, *, sensor: bool, calibrated: bool, divergence: bool) -> Chain:
    """Add the physical stages that the given inputs allow to the end of a chain.

    Parameters
    ----------
    chain : Chain
    sensor : bool
        Whether the user gave a trajectory or a flight height.
    calibrated : bool
        Whether there is a calibration.
    divergence : bool
        Whether the beam's divergence is known.

    Returns
    -------
    Chain
        The same object where the chain has these stages already.
    """
    names = ["attribute.range"] if sensor or calibrated or divergence else []
    names += ["attribute.incidence_angle"] if divergence else []
    names += ["attribute.backscatter_coefficient"] if calibrated else []
    names += ["attribute.cross_section"] if calibrated and divergence else []
    names += ["attribute.reflectance"] if calibrated else []
    return with_stages(chain, names)


def find_makers(chain: Chain, columns: Iterable[str]) -> tuple[str, ...]:
    """Find the attribute stages that a chain lacks for some columns.

    Parameters
    ----------
    chain : Chain
    columns : iterable of str
        Names in COLUMNS; those that no attribute stage makes are left out.

    Returns
    -------
    tuple of str
        Names of stages, each after those whose columns it needs.
    """
    have, found = set(chain.makes), []
    for column in columns:
        if column in have:
            continue
        maker = next((one for one in STAGES.values() if one.kind == "attribute" and column in one.makes), None)
        if maker is not None:
            before = find_makers(chain, [name for name in maker.needs if name not in have])
            found += [name for name in (*before, maker.name) if name not in found]
            have.update(*(STAGES[name].makes for name in (*before, maker.name)))
    return tuple(found)


def with_stages(chain: Chain, names: Iterable[str]) -> Chain:
    """Return the chain with these stages at its end, with their default parameters; those that it has stay."""
    have = {step.stage.name for step in chain.steps}
    added = tuple(Step(STAGES[name]) for name in names if name not in have)
    return replace(chain, steps=(*chain.steps, *added)) if added else chain


def needs_sensor(chain: Chain) -> bool:
    """Return whether a chain computes a column that needs the sensor's position."""
    return any(name in NEEDS_SENSOR for name in chain.makes)


def format_calibration(found: Calibration) -> str:
    """Return the TOML text of a calibration; `parse_calibration` gives the same constants again."""
    numbers = {key: getattr(found, name) for key, (name, *_) in _NUMBERS.items()}
    document = {
        "schema": CALIBRATION_SCHEMA,
        "version": __version__,
        **{key: getattr(found, key) for key in _TEXTS},
        **{key: None if value is None else float(value) for key, value in numbers.items()},
        "channel": [asdict(row) for row in found.channels] or None,
        "target": [asdict(row) for row in found.targets] or None,
        "fingerprint": {key: item for key, item in found.fingerprint.items() if not isinstance(item, Mapping)} or None,
    }
    return format_toml(document, heading=_HEADING, comments={key: row[-1] for key, row in _NUMBERS.items()})


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
        Without `targets` and `fingerprint`, which nothing uses after the measurement.

    Raises
    ------
    ConfigError
        When a key is unknown, missing or out of its range, or where section_constant does not fit the others.
    """
    table = parse_toml(text, name)
    table.check_keys(("schema", "version", *_TEXTS, *_NUMBERS, "channel", "target", "fingerprint"))
    table.check_schema(CALIBRATION_SCHEMA)
    values = {field: table.number(key, *limits) for key, (field, *limits) in _NUMBERS.items()}
    section = values.pop("section_constant")
    texts = {key: str(table.values.get(key, "")) for key in _TEXTS}
    channels: dict[tuple[int, int], ChannelConstant] = {}
    for row in table.tables("channel"):
        channel = _read_channel(row)
        key = (channel.digitizer, channel.scanner)
        if key in channels:
            raise ConfigError(f"{row.where}: digitizer {key[0]} with scanner channel {key[1]} is there already")
        channels[key] = channel
    found = Calibration(**values, **texts, channels=tuple(channels.values()))
    if section is not None:
        _check_section(section, found, name)
    return found


def _check_section(section: float, found: Calibration, name: str) -> None:
    """Raise ConfigError where C_cal does not follow from the other two: one was changed by hand."""
    expected = found.section_constant
    if expected is None or abs(section - expected) > 1e-3 * expected:
        wanted = "no divergence_mrad" if expected is None else f"{expected!r} by constant and divergence_mrad"
        problem = f"section_constant is {section!r}, but there is {wanted}"
        raise ConfigError(f"{name}: {problem}; correct these, or leave section_constant out")


def _read_channel(table: TomlTable) -> ChannelConstant:
    table.check_keys(ChannelConstant.__dataclass_fields__)
    return ChannelConstant(
        table.integer("digitizer", 1, 255),
        table.integer("scanner", 0, 3, 0),
        *(table.number(key, *_NUMBERS[key][1:]) for key in ("constant", "relative_error")),
        spread=table.number("spread", 0.0, 1e6, 0.0),
        echoes=table.integer("echoes", 0, 10**12, 0),
    )
