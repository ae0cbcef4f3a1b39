"""The waveforms of a strip that its measurements use, and how a survey and its chain decompose them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import ReturnTable, SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import Chain
from wavebatch.stages.decompose.rebuild import rebuild_waveforms
from wavebatch.surveying import Survey, survey_blocks
from wavebatch.surveying.auto_chain import choose_chain
from wavebatch.surveying.choose_chain import sample_size

ROWS = 8192
"""Waveforms that a chain gets at a time."""

SurveyOf = Callable[[Sequence[WaveformBlock]], Survey]


@dataclass(frozen=True, slots=True)
class Solver:
    """A survey with the chain that it chooses, as a run would use them on the same strip."""

    survey: Survey
    chain: Chain

    @classmethod
    def of_blocks(cls, blocks: Sequence[WaveformBlock], survey_of: SurveyOf = survey_blocks) -> Solver:
        """The survey of `blocks`; its chain stops after the fits, because positions are not needed here."""
        survey = survey_of(blocks)
        chain = choose_chain(survey)
        return cls(survey, Chain(chain.steps[:3], chain.name))

    @property
    def system(self) -> SystemPulse:
        """Of the strip's main digitizer."""
        return self.survey.system

    @property
    def fwhm(self) -> float:
        """Full width at half maximum of the system pulse [ns]."""
        return self.system.sigma_ref * FWHM_PER_SIGMA

    def run(self, block: WaveformBlock) -> EchoTable:
        """Echoes of a block of any size."""
        starts = range(0, len(block), ROWS)
        parts = [(self.chain.run(block.rows(slice(at, at + ROWS)), self.system), at) for at in starts]
        return EchoTable.concatenate(parts)

    def expect(self, block: WaveformBlock, echoes: EchoTable) -> np.ndarray:
        """Samples without their noise, f4 (n, s): baseline and fitted echoes; the baseline where nothing is fitted."""
        system, (first, _, decomposer) = self.system.of(block), self.chain.steps
        baseline = first.stage.function(block, system, **first.parameters).level
        model = rebuild_waveforms(block, system, decomposer, echoes)
        return np.broadcast_to(baseline, block.samples.shape) if model is None else baseline + model


@dataclass(frozen=True, eq=False)
class Pool:
    """Waveforms spread over a strip."""

    path: Path
    blocks: tuple[WaveformBlock, ...]
    """One per descriptor and number of samples."""
    surveyed: tuple[WaveformBlock, ...]
    """Those that a survey of this strip looks at, as `wavebatch run` reads them."""

    def __len__(self) -> int:
        return sum(map(len, self.blocks))

    @cached_property
    def places(self) -> tuple[np.ndarray, ...]:
        """Rank of each waveform along the strip, per block."""
        point = np.concatenate([block.point for block in self.blocks])
        time = np.concatenate([block.gps_time for block in self.blocks])
        rank = np.empty(len(point), np.int64)
        rank[np.lexsort((point, time))] = np.arange(len(point))
        return self._split(rank)

    @cached_property
    def eastings(self) -> tuple[np.ndarray, ...]:
        """Of the first sample [m], per block."""
        return self._split(np.concatenate([block.origin[:, 0] for block in self.blocks]))

    def _split(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(np.split(values, np.cumsum([len(block) for block in self.blocks])[:-1]))

    def take(self, masks: Iterable[np.ndarray]) -> list[WaveformBlock]:
        """The waveforms at `masks` (bool or indices, one per block); blocks without any are left out."""
        parts = [block.rows(mask) for block, mask in zip(self.blocks, masks, strict=True)]
        return [part for part in parts if len(part)]

    def thin(self, number: int) -> list[WaveformBlock]:
        """About `number` waveforms, spread over the strip."""
        step = max(len(self) // max(number, 1), 1)
        return self.take([place % step == 0 for place in self.places])


def read_pool(path: Path | str, waveforms: int | None = None) -> Pool:
    """Waveforms of a strip, without their empty part at the end; the same ones every time.

    waveforms: how many to read; None: twice as many as a survey looks at, so that each half gives a full survey.
    """
    with StripReader(path) as reader, reader.scan() as scan:
        sample = sample_size(reader, scan)
        surveyed = tuple(reader.sample_blocks(scan, sample))
        blocks = list(reader.sample_blocks(scan, waveforms or 2 * sample))
        return Pool(reader.facts.path, tuple(_join_alike(blocks)), surveyed)


def _join_alike(blocks: Iterable[WaveformBlock]) -> Iterator[WaveformBlock]:
    """One block per descriptor and number of samples, in order of these."""
    groups: dict[tuple[int, int], list[WaveformBlock]] = {}
    for block in blocks:
        groups.setdefault((block.digitizer.index, block.samples.shape[1]), []).append(block)
    for _, group in sorted(groups.items()):
        yield join_blocks(group)


def join_blocks(blocks: Sequence[WaveformBlock]) -> WaveformBlock:
    """Blocks of one digitizer and one length as a single one."""
    if len(blocks) == 1:
        return blocks[0]
    names = ("samples", "point", "gps_time", "origin", "direction")
    arrays = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
    arrays["samples"].flags.writeable = False
    missing = None
    if any(block.missing is not None for block in blocks):
        missing = np.concatenate([fill_of(block) for block in blocks])
    return replace(blocks[0], **arrays, returns=_join_returns(blocks), sensor=None, scanner=None, missing=missing)


def _join_returns(blocks: Sequence[WaveformBlock]) -> ReturnTable | None:
    if any(block.returns is None for block in blocks):
        return None
    starts = np.cumsum([0, *(len(block) for block in blocks[:-1])])
    waveform = [block.returns.waveform + start for block, start in zip(blocks, starts, strict=True)]
    others = [np.concatenate([getattr(b.returns, name) for b in blocks]) for name in ("time", "point", "xyz")]
    return ReturnTable(np.concatenate(waveform).astype(np.int32), *others)


def fill_of(block: WaveformBlock) -> np.ndarray:
    """Samples of a block that only fill its packets, bool (n, s): as its reader has found them, or else from counts."""
    return find_fill(block.samples) if block.missing is None else block.missing


def find_fill(samples: np.ndarray, shortest: int = 12, gap: int = 3) -> np.ndarray:
    """Samples that only fill a packet between two recordings, bool (n, s).

    These are runs of the waveform's lowest count, at least `shortest` long, where all other samples of the waveform
    are at least `gap` higher: a recording does not stay at one value that its noise never comes near.
    """
    lowest = samples.min(axis=1, keepdims=True)
    at_low = samples == lowest
    near = (samples - lowest < gap) & ~at_low
    rows = np.flatnonzero(~near.any(axis=1) & (at_low.sum(axis=1) >= shortest) & ~at_low.all(axis=1))
    fill = np.zeros(samples.shape, bool)
    for row in rows:
        edges = np.flatnonzero(np.diff(np.r_[False, at_low[row], False].astype(np.int8)))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            fill[row, start:end] = end - start >= shortest
    return fill
