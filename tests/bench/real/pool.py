"""The waveforms of a strip that its measurements use, and how a survey and its chain decompose them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.signal.runs import find_stretches
from wavebatch.stages.chain import Chain
from wavebatch.stages.decompose.models import rebuild_waveforms
from wavebatch.surveying import Survey, survey_blocks
from wavebatch.surveying.choose_chain import choose_chain, sample_size

ROWS = 8192
"""Waveforms that a chain gets at a time."""


@dataclass(frozen=True, slots=True)
class Solver:
    """A survey with the chain that it chooses, as a run would use them on the same strip."""

    survey: Survey
    chain: Chain

    @classmethod
    def of_blocks(cls, blocks: Sequence[WaveformBlock]) -> Solver:
        """The survey of `blocks`; its chain stops after the fits, because positions are not needed here."""
        survey = survey_blocks(blocks)
        chain = choose_chain(survey)
        return cls(survey, Chain(chain.steps[:3], chain.name))

    @property
    def system(self) -> SystemPulse:
        """Of the strip's main digitizer. Injected echoes hide no neighbours: their errors are those of the fit."""
        whole = self.survey.system
        others = {index: replace(one, hidden=()) for index, one in whole.digitizers.items()}
        return replace(whole, hidden=(), digitizers=others)

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
        """Samples without their noise, f4 (n, s): fitted echoes over the baseline, with its slope and its defects."""
        cleaned, noise, system = self.chain.estimate_noise(block, self.system)
        model = rebuild_waveforms(cleaned, system, self.chain.steps[2], echoes)
        level = noise.level if cleaned is block else noise.level + (block.samples - cleaned.samples)
        return np.broadcast_to(level, block.samples.shape) if model is None else level + model


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


def each_echo(table: EchoTable, row: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """First echo, second echo ... of the waveforms `row` (k,): which of `row` have it, and its row in the table."""
    count = np.bincount(table.waveform, minlength=int(row.max(initial=0)) + 1)
    first = np.cumsum(count) - count
    for order in range(int(count.max(initial=0))):
        have = np.flatnonzero(count[row] > order)
        yield have, first[row[have]] + order


def find_strongest(table: EchoTable, n: int) -> np.ndarray:
    """Row of the strongest echo of each of n waveforms, -1 without any."""
    strongest = np.full(n, -1)
    order = np.lexsort((table.amplitude, table.waveform))
    strongest[table.waveform[order]] = order
    return strongest


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
        yield WaveformBlock.concatenate(group)


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
    for place, start, end in zip(*find_stretches(at_low[rows]), strict=True):
        fill[rows[place], start:end] = end - start >= shortest
    return fill


def find_gaps(block: WaveformBlock) -> np.ndarray:
    """The same of a block, and what its reader found to be no sample, bool (n, s)."""
    fill = find_fill(block.samples)
    return fill if block.missing is None else fill | block.missing
