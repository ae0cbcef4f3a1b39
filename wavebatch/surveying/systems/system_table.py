"""The table [system] of a SYSTEM.toml: a system pulse as plain numbers, and back.

`system_file` writes and reads whole files with it, `known_systems` the pulses that are shipped.
Before you change it: every number must come back to the last bit, and old files must stay readable.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.system import Defects, LevelWidths, Radiometry, ReceiverNoise
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.toml_file import TomlTable
from wavebatch.files.toml_schema import Key, Rows, describe_keys, read_keys

MOST_COMPONENTS = 16
"""Gaussians that a pulse in a file may have."""

NUMBERS: dict[str, Key] = {
    "sigma_ref_ns": Key("sigma_ref", 1e-3, 1e4, "Gaussian standard deviation of the echo of a flat target"),
    "baseline_dn": Key("noise.baseline", -1e10, 1e10, "level without signal"),
    "baseline_spread_dn": Key("noise.baseline_spread", 0.0, 1e10, "its standard deviation between waveforms"),
    "recovery_ns": Key("noise.recovery", 0.0, 1e9, "after strong signal, until the level is back", optional=True),
    "noise_std_dn": Key("noise.std", 1e-3, 1e10, "noise of one sample, for thresholds and errors"),
    "noise_gain": Key("noise.gain", 0.0, 1e6, "growth of the noise's variance per count of signal"),
    "kappa": Key("kappa", -0.9, 0.9, "skew of the pulse; 0 is a Gaussian"),
    "skew": Key("skew", -0.9, 0.9, "of the best skewed pulse, whichever pulse was chosen", optional=True),
    "skew_spread": Key("skew_spread", 0.0, 10.0, "of the skews of single echoes about it", optional=True),
    "slope_spread_dn_ns": Key("defects.slope_spread", 0.0, 1e9, "of baselines within a waveform, taken off", True),
    "spikes": Key("defects.spikes", 0.0, 1e6, "of one sample, per waveform, taken off", optional=True),
    "transient_ns": Key("defects.transient", 0.0, 1e9, "at the start of waveforms, left out", optional=True),
    "ringing": Key("ringing", 0.0, 1.0, "largest after-pulse, as a share of the amplitude"),
    "saturation_dn": Key("saturation", 1.0, 1e10, "count at which the digitizer clips", optional=True),
    "acceptance": Key("acceptance", 1.0, 1e6, "least fall of chi2 for which an echo is added"),
    "significance": Key("significance", 0.0, 1e3, "least energy of an echo, where that is more than the chain's", True),
    "misfit": Key("misfit", 0.0, 1.0, "of strong echoes to the pulse, as a share of them", optional=True),
    "level_variance_ns2": Key("widths.variance", -1e8, 0.0, "of level ground's echoes less the pulse's", True),
    "level_error_ns2": Key("widths.error", 0.0, 1e8, "standard deviation of level_variance", True),
    "width_scatter_ns": Key("widths.scatter", 0.0, 1e4, "of echo widths beyond the errors of their fits", True),
    "divergence_mrad": Key(
        "radiometry.divergence", 1e-3, 100.0, "full angle of the beam, 1/e^2, from its data sheet", optional=True
    ),
    "divergence_error": Key(
        "radiometry.divergence_error", 0.0, 1.0, "standard deviation of the divergence, relative", optional=True
    ),
}
"""Keys of the table [system] that are plain numbers."""

ROWS: dict[str, Rows] = {
    "correlation": Rows(
        "noise.correlation", ((-1.0, 1.0),), "numbers",
        "of the noise of two samples 1, 2, ... spacings apart; empty: white noise",
    ),
    "whitening": Rows(
        "noise.whitening", ((-2.0, 2.0),), "numbers",
        "what predicts the noise of a sample from the two before it; empty: fits take noise for white", optional=True,
    ),
    "pattern_dn": Rows(
        "defects.pattern", ((-1e6, 1e6),), "numbers", "offsets that repeat along the samples, taken off; empty: none"
    ),
    "components": Rows(
        "components", ((-10.0, 10.0), (-1e4, 1e4), (1e-3, 1e4)), "[weight, delay, sigma]",
        "(weight, delay [ns], sigma [ns]) of each Gaussian of a learned pulse, the main one first",
    ),
    "tail_misfit": Rows(
        "tail_misfit", ((-1e5, 1e5), (0.0, 10.0)), "[lag, share]",
        "(lag [ns], share of the amplitude) that the pulse leaves before and after strong echoes",
    ),
    "beside": Rows(
        "beside", ((-1e5, 1e5), (0.0, 1e4)), "[lag, variance]",
        "(lag [ns], variance over that of the noise) of what fits leave beside strong echoes", optional=True,
    ),
    "seams": Rows(
        "seams", ((3, 1e9), (1, 1e9)), "[samples, sample]",
        "(samples of a packet, sample of it that was interpolated between two recordings)", kind=int, optional=True,
    ),
    "hidden": Rows(
        "hidden", ((0.0, 1e4), (0.0, 10.0), (0.0, 10.0)), "[excess, lone, others]",
        "(excess variance of a width, that of times over it for lone and other echoes) by unseen neighbours",
    ),
}  # fmt: skip
"""Keys of the table [system] that are lists."""

MOST_FIGURE = 1e30
"""Largest figure of a survey: far above counts and times, far below what overflows when it is squared."""

_NOISE, _DIGITIZERS, _INDEX = "noise_by_kind_dn", "digitizers", "index"
REMEDY = "`wavebatch survey STRIP -o FILE` writes all"
"""What to do where a key is missing."""


def describe_system(system: SystemPulse) -> dict[str, Any]:
    """Return the system pulse as plain numbers, lists and dictionaries under the keys of the file; exact."""
    own = [{_INDEX: index, **_describe_pulse(other)} for index, other in sorted(system.digitizers.items())]
    return {**_describe_pulse(system), **({_DIGITIZERS: own} if own else {})}


def _describe_pulse(system: SystemPulse) -> dict[str, Any]:
    kinds = {kind: float(value) for kind, value in system.noise.by_kind.items()}
    rows = {key: value for key, value in describe_keys(system, ROWS).items() if value is not None}
    return {**describe_keys(system, NUMBERS), _NOISE: kinds, **rows}


def comment_system() -> dict[str, str]:
    """Return the comments of a file by dotted key."""
    places = ("system", f"system.{_DIGITIZERS}")
    comments = {f"{place}.{key}": entry.meaning for place in places for key, entry in (NUMBERS | ROWS).items()}
    comments[places[1]] = "a digitizer that records otherwise"
    return comments


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
    needed = (*(key for key, entry in NUMBERS.items() if not entry.optional), "components", _NOISE)
    table.check_keys((*NUMBERS, *ROWS, _NOISE, extra), needed, REMEDY)
    parts: dict[str, dict[str, Any]] = defaultdict(dict)
    for field, value in read_keys(table, {**NUMBERS, **ROWS}).items():
        part, _, name = field.rpartition(".")
        parts[part][name] = value
    own = parts[""]
    own["seams"] = dict(own.get("seams", ()))
    _check_components(own["components"], f"{table.where}: components")
    _check_whitening(parts["noise"].get("whitening", ()), f"{table.where}: whitening")
    return SystemPulse(
        **own,
        noise=ReceiverNoise(by_kind=read_numbers(table.table(_NOISE), low=0.0), **parts["noise"]),
        defects=Defects(**parts["defects"]),
        widths=LevelWidths(**parts["widths"]),
        radiometry=Radiometry(**parts["radiometry"]),
    )


def _check_components(components: tuple[tuple[float, ...], ...], where: str) -> None:
    if len(components) == 1 or len(components) > MOST_COMPONENTS:
        raise ConfigError(f"{where} must be empty or hold 2 to {MOST_COMPONENTS} Gaussians, it holds {len(components)}")
    if components and components[0][0] < 0.01:
        raise ConfigError(f"{where} row 1 is the main Gaussian, its weight must be positive, it is {components[0][0]}")


def _check_whitening(whitening: tuple[float, ...], where: str) -> None:
    if whitening and not (len(whitening) == 2 and abs(whitening[1]) < 1 and abs(whitening[0]) < 1 - whitening[1]):
        raise ConfigError(f"{where} must be empty or hold two shares a, b of steady noise: |a| < 1 - b and |b| < 1")


def read_numbers(table: TomlTable, low: float = -MOST_FIGURE) -> dict[str, float]:
    """Read a table of numbers from `low` to MOST_FIGURE."""
    return {key: table.number(key, low, MOST_FIGURE) for key in table.values}
