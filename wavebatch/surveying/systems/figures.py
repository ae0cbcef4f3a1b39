"""The tables [figures] and [system] of a SYSTEM.toml: what a survey measured, and the system pulse as plain numbers.

Figures: echoes and pulse models, the scene, and what strips of the flight record. `survey` fills them in, decisions and
reports are made from them, and `survey_result` keeps them. A figure of counts or echoes is one field and one line of
`note_counts` or `describe_scene`; a field whose Key says how it is `shown` is a line of `wavebatch survey` too. Files
of earlier versions lack figures and have others, so each may be missing.

System: `survey_result` writes and reads whole files with it, `known_systems` the pulses that are shipped. Keys, ranges
and comments are those of the fields of SystemPulse. Before you change it: every number must come back to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from typing import Annotated, Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import changeable, frozen
from wavebatch.core.order import median, quantile
from wavebatch.core.schema import Key, Range
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.toml_file import TomlTable, check_number, describe_record, read_record

MOST_FIGURE = 1e30
"""Largest figure of a survey: far above counts and times, far below what overflows when it is squared."""

Figure = Annotated[float | None, Range(-MOST_FIGURE, MOST_FIGURE), Key()]
Share = Annotated[float | None, Range(0.0, 1.0), Key()]
SceneFigure = Annotated[float | None, Range(-MOST_FIGURE, MOST_FIGURE), Key(averaged=True)]
"""Of the scene, which all digitizers of a strip see."""
SceneShare = Annotated[float | None, Range(0.0, 1.0), Key(averaged=True)]
Number = Annotated[float, Range(-MOST_FIGURE, MOST_FIGURE), Key()]
Size = Annotated[float, Range(0.0, MOST_FIGURE), Key()]


@frozen
class Level:
    """Level and noise of a descriptor's quiet samples, with what is needed for their errors."""

    waveforms: Size
    mean: Number
    spread: Size
    std: Size
    samples: Size
    clip: Figure = None


@frozen
class Look:
    """What a strip, or all strips of a flight, record; of the main digitizer."""

    level: Annotated[Level, Key("level_")]
    width: Size
    """Gaussian width of the narrowest echoes that repeat [ns]; 0 where there are too few."""
    steady: Annotated[float, Range(0.0, 1.0), Key()]
    """Share of the clear echoes that have nearly this width."""
    misfit: Size
    """What the flight's pulse leaves of the better half of strong echoes, beyond noise, as a share of the amplitude."""


@frozen(order=True)
class Kind:
    """How the samples of a descriptor were made."""

    bits: Number
    spacing_ns: Number
    gain: Number
    offset: Number
    """Of count 0 [V]."""


@changeable
class Figures:
    """Figures of a survey, None where they are not known; the fields are the keys of the file, in its order."""

    outgoing_fwhm_ns: Figure = None
    """Of the outgoing pulses; only in the file that `wavebatch import` writes beside a strip."""
    outgoing_pulses: Figure = None
    outgoing_misfit: Figure = None
    outgoing_ringing: Figure = None
    outgoing_same_receiver: Figure = None
    """1 where the receiver of the echoes recorded the outgoing pulses."""
    isolated_echoes: Figure = None
    """Echoes that the pulse was learned from."""
    misfit_goal: Figure = None
    """Misfit of a pulse model that is too small to be seen, as a share of the amplitude."""
    misfit_skewed: Figure = None
    """Of the skewed pulse."""
    kappa: Figure = None
    """Its skew."""
    misfit_gaussians: Annotated[Mapping[int, Number], Key("misfit_{}_gaussians")] = field(default_factory=dict)
    """Misfits of sums of Gaussians, by their number."""
    description_nats: Figure = None
    """Length of a waveform's description with the chosen pulse, and with a Gaussian."""
    gaussian_nats: Figure = None
    pulse_change: Figure = None
    """Of the shape, from shot to shot, as a share of the amplitude: what describes the waveforms best."""
    false_in_noise_share: Share = None
    """Of the echoes, in stretches without signal, by mirrored residuals; and of the strong ones, the false ones beside
    them that the pulse's misfit makes."""
    false_by_misfit_share: Share = None
    placed_share: Share = None
    """Of the echoes, at one lag and one share of stronger ones, beyond chance: parts of the pulse, or a layer."""
    echoes_in_doubt: Figure = None
    """Share of the echoes that another pulse, misfit or noise, as likely, does not find, or whose samples it misses."""
    width_in_doubt: Figure = None
    """Share by which the widths of pulses that describe the waveforms as well differ from that of the chosen one."""
    spacing_ns: Figure = None
    n_samples: Figure = None
    bits: Figure = None
    inverted: Figure = None
    least_count: Figure = None
    largest_count: Figure = None
    empty_share: SceneShare = None
    """Of the waveforms; so are the next two."""
    single_share: SceneShare = None
    overlapped_share: SceneShare = None
    echoes_per_waveform: SceneFigure = None
    amplitude_50: Figure = None
    amplitude_99: Annotated[Figure, Key(shown="amplitudes: 99 % below {:.1f} DN")] = None
    saturated_share: SceneShare = None
    system_width_share: Share = None
    """Clear echoes that have the width of the system pulse."""
    descriptors_pooled: Figure = None
    sent_fwhm_ns: Figure = None
    """Of the outgoing pulses that the strip's pulse was compared with."""
    sent_time_error_ns: Figure = None
    """Of their times, which echoes are placed by: standard deviation."""
    look: Annotated[Look | None, Key("flight_")] = None
    """What the surveyed strips record: other strips of the sensor are compared with it."""
    kinds: Annotated[Mapping[int, Kind], Key("flight_descriptor_{}_")] = field(default_factory=dict)
    """Descriptors of the surveyed strips by index."""
    flight_strips: Figure = None
    divergence_seen_mrad: Figure = None
    """Of the beam, by the widths of echoes from surfaces of known slope."""
    divergence_seen_error_mrad: Figure = None
    outgoing_energy_scatter: Figure = None
    """From shot to shot, relative; so are the next two."""
    outgoing_energy_error: Figure = None
    outgoing_width_scatter: Figure = None
    outgoing_time_error_ns: Figure = None

    @property
    def samples(self) -> str:
        """The samples of a waveform, for people; empty where they are not known."""
        if None in (self.n_samples, self.bits, self.spacing_ns):
            return ""
        most = "up to " * ((self.descriptors_pooled or 0.0) > 1.0)
        return f"{most}{self.n_samples:.0f} of {self.bits:.0f} bits, {self.spacing_ns:g} ns apart"


def note_counts(figures: Figures, block: WaveformBlock) -> None:
    """Add the range of the counts as they were recorded: a block that was cleaned may leave the digitizer's range."""
    figures.least_count = float(block.samples.min(initial=block.digitizer.max_count))
    figures.largest_count = float(block.samples.max(initial=0))


def describe_scene(
    figures: Figures, block: WaveformBlock, system: SystemPulse, echoes: EchoTable, clear: float
) -> Figures:
    """The figures with samples, shares and amplitudes of the scene; clear: amplitude over noise of a clear echo."""
    n = len(block)
    number = echoes.count(n)
    overlapped = np.zeros(n, bool)
    overlapped[echoes.waveform[(echoes.flags & int(EchoFlag.OVERLAPPED)) != 0]] = True
    saturated = 0.0
    if system.saturation is not None:
        saturated = float((block.samples >= system.saturation).any(axis=1).mean())
    narrow = (number[echoes.waveform] == 1) & (echoes.amplitude > clear * system.noise.std)
    deviation = (echoes.sigma - system.sigma_ref) / np.maximum(echoes.sigma_err, 1e-6)
    return replace(
        figures,
        spacing_ns=block.spacing,
        n_samples=float(block.samples.shape[1]),
        bits=float(block.digitizer.bits),
        inverted=float(block.digitizer.inverted),
        empty_share=float((number == 0).mean()),
        single_share=float((number == 1).mean()),
        overlapped_share=float(overlapped.mean()),
        echoes_per_waveform=float(number.mean()),
        amplitude_50=float(median(echoes.amplitude)) if len(echoes) else 0.0,
        amplitude_99=quantile(echoes.amplitude, 0.99) if len(echoes) else 0.0,
        saturated_share=saturated,
        system_width_share=float((np.abs(deviation[narrow]) < 3).mean()) if narrow.any() else 0.0,
    )


def describe_figures(figures: Figures) -> dict[str, float]:
    """Return the figures that are known by the keys of files and reports."""
    found = describe_record(figures)
    return {key: float(value) for key, value in found.items() if value is not None and math.isfinite(value)}


def read_figures(table: TomlTable) -> Figures:
    """Read the figures of a survey; raises ConfigError for what is no number, or none that a survey finds.

    Figures of other versions are left out; so is what strips record where a part of it is missing.
    """
    for key, value in table.values.items():
        check_number(value, -MOST_FIGURE, MOST_FIGURE, f"{table.where}: {key}")
    found = read_record(Figures, table, strict=False)
    if found.look is None:
        return found
    level = found.look.level
    counts = {"waveforms": int(level.waveforms), "samples": int(level.samples)}
    level = replace(level, **counts, std=max(level.std, QUANTISATION_STD))
    return replace(found, look=replace(found.look, level=level))


MOST_COMPONENTS = 16
"""Gaussians that a pulse in a file may have."""

DIGITIZERS, _INDEX = "digitizers", "index"
REMEDY = "`wavebatch survey STRIP -o FILE` writes all"
"""What to do where a key is missing."""


def describe_system(system: SystemPulse) -> dict[str, Any]:
    """Return the system pulse as plain numbers, lists and dictionaries under the keys of the file; exact."""
    own = [{_INDEX: index, **describe_record(other)} for index, other in sorted(system.digitizers.items())]
    return {**describe_record(system), **({DIGITIZERS: own} if own else {})}


def read_system(table: TomlTable) -> SystemPulse:
    """Read the table [system] with those of the digitizers that record otherwise; raises ConfigError."""
    own: dict[int, SystemPulse] = {}
    for row in table.tables(DIGITIZERS, f"system.{DIGITIZERS}"):
        index = row.integer(_INDEX, 1, 255)
        if index in own:
            raise ConfigError(f"{row.where}: {_INDEX} {index} has two tables; give each digitizer one")
        own[index] = _read_pulse(row, _INDEX)
    return replace(_read_pulse(table, DIGITIZERS), digitizers=own)


def _read_pulse(table: TomlTable, extra: str) -> SystemPulse:
    """A pulse from a table that may hold one extra key."""
    found = read_record(SystemPulse, table, remedy=REMEDY, also=(extra,))
    components, whitening = found.components, found.noise.whitening
    where = f"{table.where}: components"
    if len(components) == 1 or len(components) > MOST_COMPONENTS:
        raise ConfigError(f"{where} must be empty or hold 2 to {MOST_COMPONENTS} Gaussians, it holds {len(components)}")
    if components and components[0][0] < 0.01:
        raise ConfigError(f"{where} row 1 is the main Gaussian, its weight must be positive, it is {components[0][0]}")
    if whitening and not (len(whitening) == 2 and abs(whitening[1]) < 1 and abs(whitening[0]) < 1 - whitening[1]):
        where = f"{table.where}: whitening"
        raise ConfigError(f"{where} must be empty or hold two shares a, b of steady noise: |a| < 1 - b and |b| < 1")
    return found
