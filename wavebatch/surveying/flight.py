"""One survey for all strips of a flight, and whether a strip belongs to it.

`wavebatch survey STRIPS...` and `run --survey flight` call `survey_flight`; `batch.unit` compares every strip with
the result (`hold_strip`). Before you change it: nothing may depend on the order in which the strips are given.
"""

from __future__ import annotations

import functools
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core import interrupts
from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import quantile
from wavebatch.core.system import ReceiverNoise
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.surveying.choose_chain import decide, sample_size
from wavebatch.surveying.inspect_strip import doubt_files
from wavebatch.surveying.measuring.noise_and_width import (
    FAR_OFF,
    FEW,
    FIRST_WIDTH,
    find_edge,
    measure_gaussian,
    measure_quiet,
)
from wavebatch.surveying.survey import Survey, compare_levels, describe_level, pool_blocks, survey_blocks
from wavebatch.surveying.system_file import SavedSurvey
from wavebatch.surveying.systems.figures import Kind, Look
from wavebatch.surveying.systems.known_systems import compare_pulses, find_lone, fit_alone, take_strongest, with_pulse

LEAST_SHARE = 64
"""Waveforms that each strip gives to the survey, however many strips there are."""

HELD = 512
"""Waveforms of a strip from which it is decided whether it belongs to a flight. Their width scatters by 0.6 %, far less
than NARROWER and WIDER, and each 100 take 2 ms per strip; a saved survey is compared with one strip by twice as many.
"""

CANDIDATES = 32
"""Strips that are tried as the one that most others agree with."""

ROUNDS = 3
"""Times, at most, that strips are pooled and compared with the result."""

NARROWER = 0.06
"""How much narrower than those of the flight the echoes of a strip may be, as a share of the width: find_edge gives it
to 1 to 3 %."""

WIDER, STEADY = 0.10, 0.5
"""How much wider they may be, where more than this share of them have nearly one width. Slopes and forest widen echoes
by any amount, but never most of them by the same."""

OTHER_NOISE = 1.5
"""Ratio of the noise of two strips from which they are of two sensors: that of one sensor grows with the light of the
scene, on strips of one RIEGL from .62 to .89 DN."""

SAME_WIDTH = 0.06
"""How far from the edge a width may be to count as the same, as a share of it."""

SHAPE = 0.008
"""How much worse than in the flight the common pulse may fit the better quarter of a strip's strong echoes, as a share
of the amplitude. A Gaussian misses the echoes of the shipped sensors by 0.02 to 0.06."""

ALIKE_PULSES, PULSE_ERROR = 0.02, 0.3
"""Difference of two pulses (`compare_pulses`) up to which surveys of single strips agree, and what is added to it, over
the root of the number of isolated echoes: pulses of two simulated strips with 200 of them differ by 0.03."""

ALIKE_NOISE, ALIKE_LEVEL = 1.15, 0.5
"""The same for the ratio of the noise, and for the difference of the level over the noise."""

Spread = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""Calls a function with every item and gives the results in order, like `map`."""

_FORMS = ("{:g} bits", "samples {:g} ns apart", "gain {:g}", "offset {:g}")


@frozen(eq=False)
class StripSample:
    """A strip and waveforms that are spread over it."""

    path: Path
    fingerprint: Mapping[str, Any]
    blocks: tuple[WaveformBlock, ...]
    facts: Mapping[str, Any] = field(default_factory=dict)
    """For display: points, packets."""

    @property
    def waveforms(self) -> int:
        """Return how many were sampled."""
        return sum(map(len, self.blocks))


@frozen
class Held:
    """A strip compared with a flight."""

    path: Path
    fingerprint: Mapping[str, Any]
    waveforms: int
    look: Look | None
    """None where its descriptors already differ."""
    reason: str = ""
    """Why it does not belong to the flight; empty where it does."""
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def fits(self) -> bool:
        """Return whether it belongs to the flight."""
        return not self.reason

    def to_json(self) -> dict[str, Any]:
        """Return it as plain values."""
        seen = {}
        if self.look is not None:
            level = self.look.level
            seen = {"level_dn": level.mean, "noise_dn": level.std, "gaussian_width_ns": self.look.width or None}
            seen["pulse_misfit"] = self.look.misfit
        return {
            "strip": str(self.path), **self.facts, "fingerprint": dict(self.fingerprint), "waveforms": self.waveforms,
            "fits": self.fits, "reason": self.reason, **seen,
        }  # fmt: skip


@frozen
class Flight:
    """The survey of a flight and its strips, by content."""

    saved: SavedSurvey
    strips: tuple[Held, ...]

    @property
    def misfits(self) -> list[Held]:
        """Return the strips that do not belong to it."""
        return [strip for strip in self.strips if not strip.fits]


def read_samples(
    paths: Sequence[Path],
    *,
    waveforms: int | None = None,
    direction: str = "auto",
    headerless: bool = False,
    on_error: Callable[[Path, InputError], None] | None = None,
    spread: Spread = map,
) -> list[StripSample]:
    """Read a share of the sample of a survey from each strip.

    Parameters
    ----------
    paths : sequence of Path
    waveforms : int, optional
        Of all strips together; by default as many as a survey of one strip reads, but LEAST_SHARE of each.
    direction, headerless
        As for `StripReader`.
    on_error : callable, optional
        Called with a strip that cannot be read and the reason; the strip is left out.
    spread : callable, optional
        `map`, or one that works in several processes.

    Returns
    -------
    list of StripSample
        Strips with waveforms, sorted by content.
    """
    read = functools.partial(
        _read_sample, waveforms=waveforms, strips=len(paths), direction=direction, headerless=headerless
    )
    samples = []
    for path, found in zip(paths, spread(read, paths), strict=True):
        interrupts.check()
        if isinstance(found, StripSample):
            samples.append(found)
        elif on_error is not None:
            on_error(path, found)
    return sorted(samples, key=lambda sample: json.dumps(sample.fingerprint, sort_keys=True))


def _read_sample(
    path: Path, *, waveforms: int | None, strips: int, direction: str, headerless: bool
) -> StripSample | InputError:
    """The share of one of the strips, or why it cannot be read."""
    try:
        with StripReader(path, direction=direction, headerless=headerless) as reader, reader.scan() as scan:
            share = waveforms or sample_size(reader, scan)
            share = max(-(-share // strips), 1 if waveforms else LEAST_SHARE)
            blocks = tuple(reader.sample_blocks(scan, share))
            warnings = [asdict(one) for one in doubt_files(reader.facts, scan)]
            facts = {"points": scan.points, "packets": scan.packets, "warnings": warnings}
            fingerprint = take_fingerprint(path, reader.facts.packets.file)
        if not blocks:
            raise InputError(f"{path}: holds no waveform to be surveyed; `wavebatch check` says what it holds")
    except InputError as error:
        return error
    return StripSample(path, fingerprint, blocks, facts)


def survey_flight(samples: Sequence[StripSample], *, spread: Spread = map) -> Flight:
    """Survey strips together, and find those that do not belong to the others.

    Parameters
    ----------
    samples : sequence of StripSample
        At least one, as `read_samples` returns them.
    spread : callable, optional
        As for `read_samples`.

    Returns
    -------
    Flight

    Notes
    -----
    A descriptor index must mean the same bits, spacing, gain and offset in all strips: those that contradict the
    majority are left out. The strip whose level, noise and width most others share chooses the first group. Its
    waveforms are surveyed together, and all strips are compared with the result. Those that fit are surveyed again,
    until the group stays.
    """
    kinds = _agree_on_kinds(samples)
    group = _find_group([sample for sample in samples if not _compare_kinds(sample.blocks, kinds)], spread)
    for _ in range(ROUNDS):
        blocks = [block for sample in group for block in sample.blocks]
        survey = survey_blocks(blocks)
        survey = replace(survey, decisions=decide(survey))
        whole = look_at(blocks, survey.system)
        held = list(spread(functools.partial(_hold, system=survey.system, whole=whole, kinds=kinds), samples))
        fitting = [sample for sample, strip in zip(samples, held, strict=True) if strip.fits]
        if not fitting or fitting == group:
            break
        group = fitting
    used = {index: kind for index, kind in kinds.items() if any(block.digitizer.index == index for block in blocks)}
    figures = replace(survey.figures, look=whole, kinds=used, flight_strips=float(len(group)))
    identity = {"strips": [dict(sample.fingerprint) for sample in group]}
    name = group[0].path.name if len(samples) == 1 else f"{len(group)} strips"
    return Flight(SavedSurvey(replace(survey, figures=figures), name, identity), tuple(held))


def hold_strip(reader: StripReader, scan: StripScan, flight: Survey) -> str:
    """Return why a strip does not belong to a surveyed flight; empty where it does, or where it has no waveforms.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    flight : Survey
        Of a file that `survey_flight` made.

    Returns
    -------
    str

    Raises
    ------
    ConfigError
        If the survey is not that of a flight.
    """
    whole, kinds = read_flight(flight)
    number = min(HELD, sample_size(reader, scan))
    sample = StripSample(reader.facts.path, {}, tuple(reader.sample_blocks(scan, number)))
    return _hold(sample, flight.system, whole, kinds).reason if sample.blocks else ""


def _hold(sample: StripSample, system: SystemPulse, whole: Look | None, kinds: Mapping[int, Kind]) -> Held:
    """A strip compared with what the flight records."""
    kind, look = _compare_kinds(sample.blocks, kinds), look_at(sample.blocks, system)
    # Counts of other bits or another gain say nothing; times do.
    pulse = "" if look is None or whole is None else (_compare_pulses if kind else compare_looks)(look, whole, system)
    reason = "; ".join(filter(None, (pulse, kind)))
    return Held(sample.path, sample.fingerprint, sample.waveforms, None if kind else look, reason, sample.facts)


def look_at(blocks: Iterable[WaveformBlock], system: SystemPulse) -> Look | None:
    """Measure what waveforms record, without learning a pulse.

    Parameters
    ----------
    blocks : iterable of WaveformBlock
        Of any descriptors; only those of the main digitizer are used.
    system : SystemPulse
        Of the flight: its pulse is tried on the strong echoes.

    Returns
    -------
    Look or None
        None without waveforms of the main digitizer.
    """
    kinds: dict[Kind, list[WaveformBlock]] = {}
    for block in blocks:
        if block.digitizer.index not in system.digitizers:
            kinds.setdefault(_kind(block), []).append(block)
    if not kinds:
        return None
    block = pool_blocks(max(kinds.values(), key=lambda group: sum(map(len, group))))
    plain, lone, width = _find_width(block, system.sigma_ref)
    level = describe_level(block, plain)
    quiet = plain.noise.by_kind.get("quiet", 0.0)
    if quiet:
        # The mean square of all quiet samples holds weak echoes too: 2.2 DN in a RIEGL strip, 1.6 in a part of it.
        level = replace(level, std=max(quiet, QUANTISATION_STD))
    if not width:
        return Look(level, 0.0, 0.0, 0.0)
    steady = float(np.mean(np.abs(np.log(lone.sigma / width)) < SAME_WIDTH))
    strong = take_strongest(lone)
    noise = level.std / strong.amplitude.astype(np.float64)
    left = quantile(fit_alone(block, with_pulse(plain, system), strong)[0] ** 2 - noise**2, 0.25)
    return Look(level, width, steady, float(np.sqrt(max(left, 0.0))))


def _find_width(block: WaveformBlock, expected: float) -> tuple[SystemPulse, EchoTable, float]:
    """A Gaussian and the noise, the lone echoes, and the width of the narrowest that repeat [ns]; 0: too few.

    With the width of the flight this takes half as long as to measure one; where the echoes contradict it, it is done.
    """
    plain = measure_quiet(block, expected / block.spacing)
    for measured in False, True:
        if measured:
            plain = measure_gaussian(block, expected / block.spacing)
        lone = find_lone(block, plain, most=len(block))
        width = find_edge(lone.sigma) if len(lone) >= FEW else 0.0
        if abs(width / plain.sigma_ref - 1.0) <= FAR_OFF:
            break
    return plain, lone, width


def compare_looks(own: Look, whole: Look, system: SystemPulse, wider: float = WIDER) -> str:
    """Return why a strip does not belong to the flight, the pulse first; empty where it does.

    wider: how much wider than the flight's most echoes may be, as a share of the width.
    """
    level = compare_levels(own.level, [whole.level], system.noise.std, OTHER_NOISE)
    level = level.strip().replace("the others", "the flight")
    return "; ".join(filter(None, (_compare_pulses(own, whole, system, wider), level)))


def _compare_pulses(own: Look, whole: Look, system: SystemPulse, wider: float = WIDER) -> str:
    """Why the echoes of a strip are not of the flight's sensor; empty where they may be."""
    if own.width and whole.width:
        ratio = own.width / whole.width
        if ratio < 1 - NARROWER or (ratio > 1 + wider and own.steady > STEADY):
            slope = "; steep slopes widen echoes as well" if ratio > 1 else ""
            widths = f"{own.width:.2f} ns wide (Gaussian sigma), those of the flight {whole.width:.2f} ns{slope}"
            return f"its echoes are {widths}"
        if own.misfit > whole.misfit + SHAPE:
            misfits = f"by {100 * own.misfit:.1f} % of the amplitude, those of the flight by {100 * whole.misfit:.1f} %"
            return f"the flight's pulse misses its strong echoes {misfits}"
    return ""


def _kind(block: WaveformBlock) -> Kind:
    digitizer = block.digitizer
    return Kind(float(digitizer.bits), digitizer.spacing, digitizer.gain, digitizer.offset)


def _agree_on_kinds(samples: Sequence[StripSample]) -> dict[int, Kind]:
    """What each descriptor index means in most strips; of two meanings with as many, that of more waveforms."""
    votes: dict[int, dict[Kind, list[int]]] = {}
    for sample in samples:
        counts: Counter[tuple[int, Kind]] = Counter()
        for block in sample.blocks:
            counts[block.digitizer.index, _kind(block)] += len(block)
        for (index, kind), number in counts.items():
            votes.setdefault(index, {}).setdefault(kind, []).append(number)
    return {
        index: max((len(numbers), sum(numbers), kind) for kind, numbers in kinds.items())[2]
        for index, kinds in sorted(votes.items())
    }


def _compare_kinds(blocks: Iterable[WaveformBlock], kinds: Mapping[int, Kind]) -> str:
    """Why a strip's descriptors do not fit those of the flight; empty where they do."""
    for block in blocks:
        index, kind = block.digitizer.index, _kind(block)
        if index not in kinds and kind in kinds.values():
            continue
        other = kinds.get(index) or next(iter(kinds.values()))
        if kind != other:
            both = astuple(kind), astuple(other)
            apart = [place for place, pair in enumerate(zip(*both, strict=True)) if pair[0] != pair[1]]
            own, theirs = (", ".join(_FORMS[i].format(values[i]) for i in apart) for values in both)
            return f"its descriptor {index} has {own}; that of the flight has {theirs}"
    return ""


def _find_group(samples: list[StripSample], spread: Spread) -> list[StripSample]:
    """The strips that agree with the one that the most waveforms agree with, in level, noise and width."""
    if len(samples) < 2:
        return samples
    # Pulses are not known yet: every Gaussian misses strong echoes alike.
    first = SystemPulse(sigma_ref=FIRST_WIDTH * samples[0].blocks[0].spacing)
    seen = look_at(samples[0].blocks, first)
    if seen is not None and seen.width:
        first = replace(first, sigma_ref=seen.width)  # most strips will have it
    looks = list(spread(functools.partial(look_at, system=first), [sample.blocks for sample in samples]))
    best: list[StripSample] = []
    for candidate in looks[:: max(len(looks) // CANDIDATES, 1)]:
        if candidate is None:
            continue
        whole = replace(candidate, misfit=np.inf)
        noise = SystemPulse(sigma_ref=1.0, noise=ReceiverNoise(std=candidate.level.std))
        group = [
            sample
            for sample, look in zip(samples, looks, strict=True)
            if look is not None and not compare_looks(look, whole, noise)
        ]
        if sum(sample.waveforms for sample in group) > sum(sample.waveforms for sample in best):
            best = group
    return best or samples


def list_kinds(blocks: Iterable[WaveformBlock]) -> dict[int, Kind]:
    """Return how the samples of each descriptor of blocks were made, by its index."""
    return {block.digitizer.index: _kind(block) for block in blocks}


def read_flight(survey: Survey) -> tuple[Look, dict[int, Kind]]:
    """Return what a surveyed flight records, and its descriptors; raises ConfigError for a survey of no flight."""
    look, kinds = survey.figures.look, survey.figures.kinds
    if look is None or not kinds:
        raise ConfigError("holds no survey of a flight; `wavebatch run --survey flight --overwrite` makes one")
    return look, dict(sorted(kinds.items()))


def surveys_agree(surveys: Sequence[Survey]) -> bool:
    """Return whether surveys of single strips agree so well that one survey of all of them would serve.

    Parameters
    ----------
    surveys : sequence of Survey

    Returns
    -------
    bool
        False for fewer than two, and where one has too few echoes for a pulse.
    """
    if len(surveys) < 2 or any((survey.figures.isolated_echoes or 0) < FEW for survey in surveys):
        return False
    first, *others = surveys
    return all(_agree(first, other) for other in others)


def _agree(a: Survey, b: Survey) -> bool:
    if (a.figures.spacing_ns, a.figures.bits) != (b.figures.spacing_ns, b.figures.bits):
        return False
    noise = min(a.system.noise.std, b.system.noise.std)
    echoes = min(a.figures.isolated_echoes or 0.0, b.figures.isolated_echoes or 0.0)
    return (
        max(a.system.noise.std, b.system.noise.std) < ALIKE_NOISE * noise
        and abs(a.system.noise.baseline - b.system.noise.baseline) < ALIKE_LEVEL * noise
        and a.system.digitizers.keys() == b.system.digitizers.keys()
        and compare_pulses(a.system, b.system) < ALIKE_PULSES + PULSE_ERROR / np.sqrt(echoes)
    )
