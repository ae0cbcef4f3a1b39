"""What a survey measured beside the system: echoes and pulse models, the scene, and what strips of the flight record.

`survey` fills it in, decisions and reports are made from it, and `system_file` keeps it as the table [figures].
Before you change it: files of earlier versions lack figures and have others, so each may be missing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

from wavebatch.core.units import QUANTISATION_STD
from wavebatch.files.toml_file import TomlTable, check_number
from wavebatch.surveying.systems.system_table import MOST_FIGURE, read_numbers


class Level(NamedTuple):
    """Level and noise of a descriptor's quiet samples, with what is needed for their errors."""

    waveforms: int
    mean: float
    spread: float
    std: float
    samples: int
    clip: float | None


@dataclass(frozen=True, slots=True)
class Look:
    """What a strip, or all strips of a flight, record; of the main digitizer."""

    level: Level
    width: float
    """Gaussian width of the narrowest echoes that repeat [ns]; 0 where there are too few."""
    steady: float
    """Share of the clear echoes that have nearly this width."""
    misfit: float
    """What the flight's pulse leaves of the better half of strong echoes, beyond noise, as a share of the amplitude."""


class Kind(NamedTuple):
    """How the samples of a descriptor were made."""

    bits: float
    spacing_ns: float
    gain: float
    offset: float
    """Of count 0 [V]."""


@dataclass(slots=True)
class Figures:
    """Figures of a survey, None where they are not known; the fields are the keys of the file, in its order."""

    outgoing_fwhm_ns: float | None = None
    """Of the outgoing pulses; only in the file that `wavebatch import` writes beside a strip."""
    outgoing_pulses: float | None = None
    outgoing_misfit: float | None = None
    outgoing_ringing: float | None = None
    outgoing_same_receiver: float | None = None
    """1 where the receiver of the echoes recorded the outgoing pulses."""
    isolated_echoes: float | None = None
    """Echoes that the pulse was learned from."""
    misfit_goal: float | None = None
    """Misfit of a pulse model that chance alone makes, as a share of the amplitude."""
    misfit_skewed: float | None = None
    """Of the skewed pulse."""
    kappa: float | None = None
    """Its skew."""
    misfit_gaussians: Mapping[int, float] = field(default_factory=dict)
    """Misfits of sums of Gaussians, by their number."""
    description_nats: float | None = None
    """Length of a waveform's description with the chosen pulse, and with a Gaussian."""
    gaussian_nats: float | None = None
    pulse_change: float | None = None
    """Of the shape, from shot to shot, as a share of the amplitude: what describes the waveforms best."""
    false_in_noise_share: float | None = None
    """Of the echoes, in stretches without signal, by mirrored residuals; and of the strong ones, the false ones beside
    them that the pulse's misfit makes."""
    false_by_misfit_share: float | None = None
    echoes_in_doubt: float | None = None
    """Share of the echoes that another pulse, misfit or noise, as likely, does not find, or whose samples it misses."""
    spacing_ns: float | None = None
    n_samples: float | None = None
    bits: float | None = None
    inverted: float | None = None
    least_count: float | None = None
    largest_count: float | None = None
    empty_share: float | None = None
    """Of the waveforms; so are the next two."""
    single_share: float | None = None
    overlapped_share: float | None = None
    echoes_per_waveform: float | None = None
    amplitude_50: float | None = None
    amplitude_99: float | None = None
    saturated_share: float | None = None
    system_width_share: float | None = None
    """Clear echoes that have the width of the system pulse."""
    descriptors_pooled: float | None = None
    sent_fwhm_ns: float | None = None
    """Of the outgoing pulses that the strip's pulse was compared with."""
    look: Look | None = None
    """What the surveyed strips record: other strips of the sensor are compared with it."""
    kinds: Mapping[int, Kind] = field(default_factory=dict)
    """Descriptors of the surveyed strips by index."""
    flight_strips: float | None = None
    divergence_seen_mrad: float | None = None
    """Of the beam, by the widths of echoes from surfaces of known slope."""
    divergence_seen_error_mrad: float | None = None
    outgoing_energy_scatter: float | None = None
    """From shot to shot, relative; so are the next two."""
    outgoing_energy_error: float | None = None
    outgoing_width_scatter: float | None = None

    @property
    def samples(self) -> str:
        """The samples of a waveform, for people; empty where they are not known."""
        if None in (self.n_samples, self.bits, self.spacing_ns):
            return ""
        most = "up to " * ((self.descriptors_pooled or 0.0) > 1.0)
        return f"{most}{self.n_samples:.0f} of {self.bits:.0f} bits, {self.spacing_ns:g} ns apart"


_LOOK = ("width", "steady", "misfit")
_GAUSSIANS = re.compile(r"misfit_([0-9]{1,3})_gaussians")
_DESCRIPTOR = re.compile(r"flight_descriptor_([0-9]{1,3})_(\w+)")
_LIMITS = {
    "_share": (0.0, 1.0),
    "flight_steady": (0.0, 1.0),
    **{f"flight_{name}": (0.0, MOST_FIGURE) for name in ("width", "misfit")},
    **{f"flight_level_{name}": (0.0, MOST_FIGURE) for name in ("waveforms", "samples", "spread", "std")},
}
"""Allowed figures by the ends of their keys; others are any numbers."""


def describe_figures(figures: Figures) -> dict[str, float]:
    """Return the figures that are known by the keys of files and reports."""
    found: dict[str, float | None] = {}
    for name in (one.name for one in fields(Figures)):
        value = getattr(figures, name)
        if name == "misfit_gaussians":
            found |= {f"misfit_{number}_gaussians": misfit for number, misfit in value.items()}
        elif name == "kinds":
            for index, kind in value.items():
                found |= {f"flight_descriptor_{index}_{part}": number for part, number in kind._asdict().items()}
        elif name != "look":
            found[name] = value
        elif value is not None:
            found |= {f"flight_level_{part}": number for part, number in value.level._asdict().items()}
            found |= {f"flight_{part}": getattr(value, part) for part in _LOOK}
    return {key: float(value) for key, value in found.items() if value is not None and math.isfinite(value)}


def read_figures(table: TomlTable) -> Figures:
    """Read the figures of a survey; raises ConfigError for shares, counts and deviations that are none.

    Figures of other versions are left out.
    """
    numbers = read_numbers(table)
    for key, value in numbers.items():
        for end, limits in _LIMITS.items():
            if key.endswith(end):
                check_number(value, *limits, f"{table.where}: {key}")
    plain = {one.name for one in fields(Figures)} - {"misfit_gaussians", "kinds", "look"}
    gaussians = {int(match[1]): numbers[match[0]] for match in map(_GAUSSIANS.fullmatch, numbers) if match}
    return Figures(
        **{key: value for key, value in numbers.items() if key in plain},
        misfit_gaussians=gaussians,
        look=_read_look(numbers),
        kinds=_read_kinds(numbers),
    )


def _read_look(numbers: Mapping[str, float]) -> Look | None:
    """What strips record; None where a part of it is missing."""
    level: dict[str, Any] = {name: numbers.get(f"flight_level_{name}") for name in Level._fields}
    rest: list[Any] = [numbers.get(f"flight_{name}") for name in _LOOK]
    clip = level.pop("clip")
    if None in rest or None in level.values():
        return None
    level |= {"waveforms": int(level["waveforms"]), "samples": int(level["samples"])}
    level["std"] = max(level["std"], QUANTISATION_STD)
    return Look(Level(**level, clip=clip), *rest)


def _read_kinds(numbers: Mapping[str, float]) -> dict[int, Kind]:
    """The descriptors by index; none where a part of one is missing."""
    parts: dict[int, dict[str, float]] = {}
    for match in filter(None, map(_DESCRIPTOR.fullmatch, numbers)):
        parts.setdefault(int(match[1]), {})[match[2]] = numbers[match[0]]
    whole = all(part.keys() == set(Kind._fields) for part in parts.values())
    return {index: Kind(**part) for index, part in parts.items()} if whole else {}
