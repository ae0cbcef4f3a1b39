"""The table [system] of a SYSTEM.toml: a system pulse as plain numbers, and back.

`system_file` writes and reads whole files with it, `known_systems` the pulses that are shipped.
Before you change it: every number must come back to the last bit, and old files must stay readable.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.toml_file import TomlTable, check_number, shorten

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
    "recovery_ns": Quantity("recovery", 0.0, 1e9, "after strong signal, until the level is back", optional=True),
    "noise_std_dn": Quantity("noise_std", 1e-3, 1e10, "noise of one sample, for thresholds and errors"),
    "noise_gain": Quantity("noise_gain", 0.0, 1e6, "growth of the noise's variance per count of signal"),
    "kappa": Quantity("kappa", -0.9, 0.9, "skew of the pulse; 0 is a Gaussian"),
    "skew": Quantity("skew", -0.9, 0.9, "of the best skewed pulse, whichever pulse was chosen", optional=True),
    "skew_spread": Quantity("skew_spread", 0.0, 10.0, "of the skews of single echoes about it", optional=True),
    "slope_spread_dn_ns": Quantity("slope_spread", 0.0, 1e9, "of baselines within a waveform, taken off", True),
    "spikes": Quantity("spikes", 0.0, 1e6, "of one sample, per waveform, taken off", optional=True),
    "transient_ns": Quantity("transient", 0.0, 1e9, "at the start of waveforms, left out", optional=True),
    "ringing": Quantity("ringing", 0.0, 1.0, "largest after-pulse, as a share of the amplitude"),
    "saturation_dn": Quantity("saturation", 1.0, 1e10, "count at which the digitizer clips", optional=True),
    "acceptance": Quantity("acceptance", 1.0, 1e6, "least fall of chi2 for which an echo is added"),
    "misfit": Quantity("misfit", 0.0, 1.0, "of strong echoes to the pulse, as a share of them", optional=True),
    "level_variance_ns2": Quantity("level_variance", -1e8, 0.0, "of level ground's echoes less the pulse's", True),
    "level_error_ns2": Quantity("level_error", 0.0, 1e8, "standard deviation of level_variance", True),
    "width_scatter_ns": Quantity("width_scatter", 0.0, 1e4, "of echo widths beyond the errors of their fits", True),
    "divergence_mrad": Quantity("divergence", 1e-3, 100.0, "full angle of the beam, 1/e^2, from its data sheet", True),
    "divergence_error": Quantity("divergence_error", 0.0, 1.0, "standard deviation of the divergence, relative", True),
}
"""Keys of the table [system] that are plain numbers."""

COMPONENT_LIMITS = ((-10.0, 10.0), (-1e4, 1e4), (1e-3, 1e4))
"""Allowed weight, delay [ns] and sigma [ns] of a component."""

CORRELATION_LIMITS = ((-1.0, 1.0),)
"""Allowed correlation of the noise at a lag."""

PATTERN_LIMITS = ((-1e6, 1e6),)
"""Allowed offset of a pattern [count]."""

TAIL_LIMITS = ((-1e5, 1e5), (0.0, 10.0))
"""Allowed lag [ns] and share of the misfit of a tail."""

SEAM_LIMITS = ((3, 1e9), (1, 1e9))
"""Allowed samples of a packet and place of its seam."""

HIDDEN_LIMITS = ((0.0, 1e4), (0.0, 10.0), (0.0, 10.0))
"""Allowed excess variance of a width, and variance of times over it, of lone and other echoes."""

MOST_LAGS = 1024
"""Lags that the correlation and the tail of a pulse in a file may have; a survey finds fewer than 64."""

MOST_FIGURE = 1e30
"""Largest figure of a survey: far above counts and times, far below what overflows when it is squared."""

_FIGURE_LIMITS = {
    "_share": (0.0, 1.0),
    "flight_steady": (0.0, 1.0),
    **{f"flight_{name}": (0.0, MOST_FIGURE) for name in ("width", "misfit")},
    **{f"flight_level_{name}": (0.0, MOST_FIGURE) for name in ("waveforms", "samples", "spread", "std")},
}
"""Allowed figures of a survey by the ends of their names; others are any numbers."""

_NOISE, _COMPONENTS, _DIGITIZERS, _INDEX = "noise_by_kind_dn", "components", "digitizers", "index"
_CORRELATION, _TAIL, _PATTERN, _SEAMS, _HIDDEN = "correlation", "tail_misfit", "pattern_dn", "seams", "hidden"
_ABOUT_COMPONENTS = "(weight, delay [ns], sigma [ns]) of each Gaussian of a learned pulse, the main one first"
_ABOUT_CORRELATION = "of the noise of two samples 1, 2, ... spacings apart; empty: white noise"
_ABOUT_PATTERN = "offsets that repeat along the samples, taken off; empty: none"
_ABOUT_SEAMS = "(samples of a packet, sample of it that was interpolated between two recordings)"
_ABOUT_HIDDEN = "(excess variance of a width, that of times over it for lone and other echoes) by unseen neighbours"
_ABOUT_TAIL = "(lag [ns], share of the amplitude) that the pulse leaves before and after strong echoes"
REMEDY = "`wavebatch survey STRIP -o FILE` writes all"
"""What to do where a key is missing."""


def describe_system(system: SystemPulse) -> dict[str, Any]:
    """Return the system pulse as plain numbers, lists and dictionaries under the keys of the file; exact."""
    own = [{_INDEX: index, **_describe_pulse(other)} for index, other in sorted(system.digitizers.items())]
    return {**_describe_pulse(system), **({_DIGITIZERS: own} if own else {})}


def _describe_pulse(system: SystemPulse) -> dict[str, Any]:
    values = {key: getattr(system, quantity.field) for key, quantity in QUANTITIES.items()}
    return {
        **{key: None if value is None or math.isinf(value) else float(value) for key, value in values.items()},
        _NOISE: {kind: float(value) for kind, value in system.noise_by_kind.items()},
        _CORRELATION: [float(value) for value in system.correlation],
        _PATTERN: [float(value) for value in system.pattern],
        _COMPONENTS: [[float(value) for value in component] for component in system.components],
        _TAIL: [[float(value) for value in row] for row in system.tail_misfit],
        **({_SEAMS: [list(seam) for seam in sorted(system.seams.items())]} if system.seams else {}),
        _HIDDEN: [[float(value) for value in row] for row in system.hidden],
    }


def comment_system() -> dict[str, str]:
    """Return the comments of a file by dotted key."""
    meanings = {key: quantity.meaning for key, quantity in QUANTITIES.items()}
    meanings |= {_COMPONENTS: _ABOUT_COMPONENTS, _CORRELATION: _ABOUT_CORRELATION, _TAIL: _ABOUT_TAIL}
    meanings |= {_PATTERN: _ABOUT_PATTERN, _SEAMS: _ABOUT_SEAMS, _HIDDEN: _ABOUT_HIDDEN}
    places = ("system", f"system.{_DIGITIZERS}")
    comments = {f"{place}.{key}": meaning for place in places for key, meaning in meanings.items()}
    comments[places[1]] = "a digitizer that records otherwise"
    return comments


def read_system(table: TomlTable) -> SystemPulse:
    """Read the table [system] with those of the digitizers that record otherwise; raises ConfigError."""
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
    keys = (*QUANTITIES, _COMPONENTS, _NOISE, _CORRELATION, _TAIL, _PATTERN, _SEAMS, _HIDDEN, extra)
    table.check_keys(keys, needed, REMEDY)
    values = {
        quantity.field: table.number(key, quantity.low, quantity.high)
        for key, quantity in QUANTITIES.items()
        if key in table.values
    }
    correlation = _read_rows(table, _CORRELATION, CORRELATION_LIMITS, "numbers")
    return SystemPulse(
        **values,
        noise_by_kind=read_numbers(table.table(_NOISE), low=0.0),
        correlation=tuple(row[0] for row in correlation),
        pattern=tuple(row[0] for row in _read_rows(table, _PATTERN, PATTERN_LIMITS, "numbers")),
        components=_read_components(table),
        tail_misfit=_read_rows(table, _TAIL, TAIL_LIMITS, "[lag, share]"),
        seams={int(length): int(at) for length, at in _read_rows(table, _SEAMS, SEAM_LIMITS, "[samples, sample]")},
        hidden=_read_rows(table, _HIDDEN, HIDDEN_LIMITS, "[excess, lone, others]"),
    )


def _read_components(table: TomlTable) -> tuple[tuple[float, ...], ...]:
    components = _read_rows(table, _COMPONENTS, COMPONENT_LIMITS, "[weight, delay, sigma]")
    where = f"{table.where}: {_COMPONENTS}"
    if len(components) == 1 or len(components) > MOST_COMPONENTS:
        raise ConfigError(f"{where} must be empty or hold 2 to {MOST_COMPONENTS} Gaussians, it holds {len(components)}")
    if components and components[0][0] < 0.01:
        raise ConfigError(f"{where} row 1 is the main Gaussian, its weight must be positive, it is {components[0][0]}")
    return components


def _read_rows(
    table: TomlTable, key: str, limits: tuple[tuple[float, float], ...], form: str
) -> tuple[tuple[float, ...], ...]:
    """The rows of a list, empty where it is missing; a row has a number within each of the limits."""
    where, rows = f"{table.where}: {key}", table.values.get(key, [])
    if isinstance(rows, list) and len(limits) == 1:
        rows = [[value] for value in rows]
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == len(limits) for row in rows):
        raise ConfigError(f"{where} must be a list of {form}, it is {shorten(rows)}")
    if len(rows) > MOST_LAGS:
        raise ConfigError(f"{where} holds {len(rows)} rows, at most {MOST_LAGS} are read")
    return tuple(
        tuple(check_number(value, *pair, f"{where} row {number}") for value, pair in zip(row, limits, strict=True))
        for number, row in enumerate(rows, 1)
    )


def read_figures(table: TomlTable) -> dict[str, float]:
    """Read the figures of a survey; raises ConfigError for shares, counts and deviations that are none."""
    figures = read_numbers(table)
    for key, value in figures.items():
        for end, limits in _FIGURE_LIMITS.items():
            if key.endswith(end):
                check_number(value, *limits, f"{table.where}: {key}")
    return figures


def read_numbers(table: TomlTable, low: float = -MOST_FIGURE) -> dict[str, float]:
    """Read a table of numbers from `low` to MOST_FIGURE."""
    return {key: table.number(key, low, MOST_FIGURE) for key in table.values}
