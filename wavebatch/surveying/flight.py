"""One survey for all strips of a flight, and whether a strip belongs to it.

`wavebatch survey STRIPS...` and `run --survey flight` call `survey_flight`; `prepare` compares every strip with the
result (`compare_flight`). Before you change it: nothing may depend on the order in which the strips are given.
"""

from __future__ import annotations

import functools
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core import interrupts
from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.surveying.choose_chain import decide
from wavebatch.surveying.inspect_strip import doubt_files
from wavebatch.surveying.look import (
    COMPARED,
    Glance,
    compare_echoes,
    compare_looks,
    glance_at,
    kind_of,
    look_at,
    read_flight,
)
from wavebatch.surveying.measuring.noise_and_width import FIRST_WIDTH, thin_block
from wavebatch.surveying.survey import survey_blocks
from wavebatch.surveying.systems.figures import Kind, Look
from wavebatch.surveying.systems.survey_result import SavedSurvey

LEAST_SHARE = 64
"""Waveforms that each strip gives to the survey, however many strips there are."""

ROOM = 8
"""Samples of a survey that may be kept while strips are compared, so that none is read a second time for that."""

CANDIDATES = 32
"""Strips that are tried as the one that most others agree with."""

ROUNDS = 3
"""Times, at most, that strips are pooled and compared with the result."""

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
    share: int | None = None
    """Waveforms that the survey gets, None for all; all are compared with it."""

    def surveyed(self) -> Iterator[WaveformBlock]:
        """The share of the survey, spread over the strip."""
        share = self.share or self.waveforms
        return (thin_block(block, -(-len(block) * share // self.waveforms)) for block in self.blocks)

    @property
    def waveforms(self) -> int:
        """Return how many were sampled."""
        return sum(map(len, self.blocks))


@frozen
class SurveyedStrip:
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
    strips: tuple[SurveyedStrip, ...]

    @property
    def misfits(self) -> list[SurveyedStrip]:
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
            size = reader.sample_size(scan)
            share = max(-(-(waveforms or size) // strips), 1 if waveforms else LEAST_SHARE)
            least = 0 if waveforms or strips * min(COMPARED, size) > ROOM * size else min(COMPARED, size)
            blocks = tuple(reader.sample_blocks(scan, max(share, least)))
            warnings = [asdict(one) for one in doubt_files(reader.facts, scan)]
            facts = {"points": scan.points, "packets": scan.packets, "warnings": warnings}
            fingerprint = take_fingerprint(path, reader.facts.packets.file)
        if not blocks:
            raise InputError(f"{path}: holds no waveform to be surveyed; `wavebatch check` says what it holds")
    except InputError as error:
        return error
    return StripSample(path, fingerprint, blocks, facts, share if share < least else None)


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
    # What each descriptor index means, by strips that have it so, then by waveforms. Strips that contradict what is
    # decided have no vote in the rest: strangers would give one index their meaning, and no strip would fit all.
    votes: dict[tuple[int, Kind], list[int]] = {}
    for sample in samples:
        counts: Counter[tuple[int, Kind]] = Counter()
        for block in sample.blocks:
            counts[block.digitizer.index, kind_of(block)] += len(block)
        for meaning, number in counts.items():
            votes.setdefault(meaning, []).append(number)
    order = sorted(votes, key=lambda meaning: (len(votes[meaning]), sum(votes[meaning]), meaning), reverse=True)
    kinds: dict[int, Kind] = {}
    voters = [{block.digitizer.index: kind_of(block) for block in sample.blocks} for sample in samples]
    for index, kind in order:
        if index not in kinds and any(meant.get(index) == kind for meant in voters):
            kinds[index] = kind
            voters = [meant for meant in voters if meant.get(index, kind) == kind]
    kinds = dict(sorted(kinds.items()))
    group, seen = _find_group([sample for sample in samples if not _compare_kinds(sample.blocks, kinds)], spread)
    for _ in range(ROUNDS):
        blocks = [block for sample in group for block in sample.surveyed()]
        survey = survey_blocks(blocks)
        survey = replace(survey, decisions=decide(survey))
        whole = look_at(blocks, survey.system)
        compare = functools.partial(_compare, system=survey.system, whole=whole, kinds=kinds)
        judged = list(spread(compare, [(sample, seen.get(sample.path)) for sample in samples]))
        fitting = [sample for sample, strip in zip(samples, judged, strict=True) if strip.fits]
        if not fitting or fitting == group:
            break
        group = fitting
    used = {index: kind for index, kind in kinds.items() if any(block.digitizer.index == index for block in blocks)}
    figures = replace(survey.figures, look=whole, kinds=used, flight_strips=float(len(group)))
    # Of 64 waveforms the clip level is seldom seen, and widths are known to no 6 %: strangers over roofs passed.
    compared = {
        sample.path
        for sample, strip in zip(samples, judged, strict=True)
        if strip.fits and strip.look is not None and strip.look.width and sum(map(len, sample.blocks)) >= COMPARED
    }
    identity = {"strips": [{**sample.fingerprint, "compared": sample.path in compared} for sample in group]}
    name = group[0].path.name if len(samples) == 1 else f"{len(group)} strips"
    return Flight(SavedSurvey(replace(survey, figures=figures), name, identity), tuple(judged))


def compare_flight(reader: StripReader, scan: StripScan, flight: SavedSurvey) -> str:
    """Return why a strip does not belong to a surveyed flight; empty where it does, or where it has no waveforms.

    A strip that was compared by so many waveforms when the flight was surveyed is not read again.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    flight : SavedSurvey
        That `survey_flight` made.

    Returns
    -------
    str

    Raises
    ------
    ConfigError
        If the survey is not that of a flight.
    """
    whole, kinds = read_flight(flight.survey)
    fingerprint = take_fingerprint(reader.facts.path, reader.facts.packets.file)
    surveyed = flight.fingerprint.get("strips")
    if isinstance(surveyed, list) and {**fingerprint, "compared": True} in surveyed:
        return ""
    number = min(COMPARED, reader.sample_size(scan))
    sample = StripSample(reader.facts.path, fingerprint, tuple(reader.sample_blocks(scan, number)))
    return _compare((sample, None), flight.survey.system, whole, kinds).reason if sample.blocks else ""


def _compare(
    strip: tuple[StripSample, Glance | None], system: SystemPulse, whole: Look | None, kinds: Mapping[int, Kind]
) -> SurveyedStrip:
    """A strip compared with what the flight records; with a glance at it, if there was one."""
    sample, seen = strip
    kind = _compare_kinds(sample.blocks, kinds)
    look = look_at(sample.blocks, system, None if system.digitizers else seen)
    # Counts of other bits or another gain say nothing; times do.
    pulse = ""
    if look is not None and whole is not None:
        pulse = compare_echoes(look, whole) if kind else compare_looks(look, whole, system)
    reason, look = "; ".join(filter(None, (pulse, kind))), None if kind else look
    return SurveyedStrip(sample.path, sample.fingerprint, sample.waveforms, look, reason, sample.facts)


def _compare_kinds(blocks: Iterable[WaveformBlock], kinds: Mapping[int, Kind]) -> str:
    """Why a strip's descriptors do not fit those of the flight; empty where they do."""
    for block in blocks:
        index, kind = block.digitizer.index, kind_of(block)
        if index not in kinds and kind in kinds.values():
            continue
        other = kinds.get(index) or next(iter(kinds.values()))
        if kind != other:
            both = astuple(kind), astuple(other)
            apart = [place for place, pair in enumerate(zip(*both, strict=True)) if pair[0] != pair[1]]
            own, theirs = (", ".join(_FORMS[i].format(values[i]) for i in apart) for values in both)
            return f"its descriptor {index} has {own}; that of the flight has {theirs}"
    return ""


def _find_group(samples: list[StripSample], spread: Spread) -> tuple[list[StripSample], dict[Path, Glance | None]]:
    """The strips that agree with the one that the most waveforms agree with, in level, noise and width; and glances."""
    if len(samples) < 2:
        return samples, {}
    # Pulses are not known yet: every Gaussian misses strong echoes alike.
    first = SystemPulse(sigma_ref=FIRST_WIDTH * samples[0].blocks[0].spacing)
    seen = glance_at(samples[0].blocks, first)
    if seen is not None and seen.look.width:
        first = replace(first, sigma_ref=seen.look.width)  # most strips will have it
    glances = list(spread(functools.partial(glance_at, system=first), [sample.blocks for sample in samples]))
    looks = [None if glance is None else glance.look for glance in glances]
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
    return best or samples, dict(zip((sample.path for sample in samples), glances, strict=True))
