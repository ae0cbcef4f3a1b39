"""Two chains on one strip, or a chain and a cloud or the vendor's returns: what both find, and how well they fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.echo_reader import CLOUD_DTYPE, CloudReader
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.chain_file import list_profiles, load_chain, load_profile
from wavebatch.surveying import Survey
from wavebatch.surveying.auto_chain import choose_chain
from wavebatch.surveying.choose_chain import read_sample, survey_sample
from wavebatch.tools.compare.clouds import PACKET_DTYPE, open_task, read_echoes
from wavebatch.tools.compare.differences import SPEED
from wavebatch.tools.compare.goodness import FitQuality, Goodness, measure_fit
from wavebatch.tools.compare.pairing import Comparison, Pairing, check_tolerance

AUTO = "auto"
"""The chain that the strip's survey chooses."""

_BLOCK = 8192
"""Waveforms that go through the chains at a time."""

_KEPT = 200_000
"""Waveforms and pairs per chain that medians are taken of, beside those of the two sides."""


@dataclass(frozen=True, slots=True)
class Contender:
    """One side of a match on a strip."""

    name: str
    """Of a chain, or the path of a cloud."""
    chain: Chain | None = None
    """What is run; None for a cloud, and for AUTO until the strip is surveyed."""

    @property
    def is_cloud(self) -> bool:
        """Whether it is a result already."""
        return self.chain is None and self.name != AUTO


def find_contender(name: str) -> Contender:
    """A shipped chain by its name, `auto`, a chain file (.toml), or else a cloud; ConfigError for a wrong chain."""
    if name == AUTO:
        return Contender(name)
    if name in list_profiles():
        return Contender(name, load_profile(name))
    return Contender(name, load_chain(name)) if Path(name).suffix.lower() == ".toml" else Contender(name)


@dataclass(frozen=True, slots=True)
class Matchup:
    """What two sides, a and b, make of the waveforms of one strip; b may be the vendor's returns."""

    strip: str
    waveforms: int
    """Those that were compared."""
    returns: int
    """The vendor's returns in them."""
    between: Comparison
    """a with b; two chains by time within each waveform, so that their differences are those of the fits."""
    vendor: dict[str, Comparison] = field(default_factory=dict)
    """Chains `a` and `b` with the vendor's returns, by place within each waveform."""
    fit: dict[str, dict[str, Goodness]] = field(default_factory=dict)
    """Goodness of fit of `a` and `b`: of `all` waveforms with an echo, those with a `single` one, those with
    several (`multi`), and those in which `both` chains have one; empty where what was fitted is not known, as it is
    not of a cloud."""

    def to_json(self) -> dict:
        """Plain numbers, lists and dictionaries for JSON."""
        return {
            **self.between.to_json(),
            "strip": self.strip,
            "waveforms": self.waveforms,
            "returns": self.returns,
            "vendor": {side: one.to_json() for side, one in self.vendor.items()},
            "fit": {side: {name: asdict(one) for name, one in fit.items()} or None for side, fit in self.fit.items()},
        }


def match_sides(
    strip: Path,
    a: Contender,
    b: Contender | None = None,
    *,
    tolerance_ns: float = 1.0,
    survey: Survey | None = None,
    limit: int | None = None,
) -> Matchup:
    """Echoes that a and b find in the waveforms of a strip; without b, a and the vendor's returns.

    At least one side is a chain. survey: taken in place of one of the strip. limit: about as many waveforms, spread
    evenly over the strip, in place of all; not with a cloud. Memory is bounded, as in compare_clouds.
    Raises InputError for files that cannot be read, ConfigError for what cannot be compared.
    """
    clouds = [side for side in (a, b) if side is not None and side.is_cloud]
    if len(clouds) == (1 if b is None else 2):
        raise ConfigError(f"{a.name}: clouds need no chain to be run; compare them without --strip")
    if clouds and limit is not None:
        raise ConfigError(f"{clouds[0].name}: a cloud has the echoes of all waveforms; leave --limit out")
    check_tolerance(tolerance_ns)
    with StripReader(strip) as reader, reader.scan() as scan:
        survey = survey or survey_sample(read_sample(reader, scan))
        chains = {key: side for key, side in (("a", a), ("b", b)) if side is not None and not side.is_cloud}
        chosen = choose_chain(survey)
        runs = {key: ChainRun(side.chain or chosen, survey.system, tolerance_ns) for key, side in chains.items()}
        blocks = _read_blocks(reader, scan, limit)
        if clouds:
            between = _match_cloud(blocks, Path(strip), a, b, runs, tolerance_ns)
        else:
            between = match_chains(blocks, runs, (a.name, b.name if b else str(strip)), tolerance_ns)
    names = {key: side.name for key, side in chains.items()}
    return Matchup(
        strip=str(strip),
        waveforms=next(iter(runs.values())).vendor.pulses,
        returns=next(iter(runs.values())).vendor.echoes[1],
        between=between,
        vendor={key: run.vendor.finish(names[key], str(strip), "waveform") for key, run in runs.items()},
        fit={key: runs[key].fit.result() if key in runs else {} for key in ("a", "b")[: 1 if b is None else 2]},
    )


def _read_blocks(reader: StripReader, scan: StripScan, limit: int | None) -> Iterator[WaveformBlock]:
    if limit is not None:
        yield from reader.sample_blocks(scan, limit, _BLOCK)
        return
    for number in range(reader.unit_count()):
        for block, _ in reader.read_blocks(reader.read_unit(number, scan), _BLOCK, owned_only=True):
            yield block


def match_chains(
    blocks: Iterator[WaveformBlock], runs: dict[str, ChainRun], names: tuple[str, str], tolerance_ns: float
) -> Comparison:
    """Chains a and b, or a and the vendor's returns, waveform by waveform; each of `runs` keeps what it finds."""
    between = Pairing(tolerance_ns)
    for block in blocks:
        found = {key: run.find(block) for key, run in runs.items()}
        number = {key: one.echoes.count(len(block)) for key, one in found.items()}
        for key, run in runs.items():
            other = number.get("b" if key == "a" else "a", np.zeros(len(block), np.int64))
            run.add(block, found[key], other > 0)
        sides = [found["a"].rows(block), found["a"].vendor_rows(block)]
        if "b" in found:
            sides = [one.rows_along(block) for one in found.values()]
        between.pair_by_time(*sides, _keys(block))
    return between.finish(*names, "waveform")


def _match_cloud(
    blocks: Iterator[WaveformBlock],
    strip: Path,
    a: Contender,
    b: Contender,
    runs: dict[str, ChainRun],
    tolerance_ns: float,
) -> Comparison:
    """A chain and a cloud as two clouds."""
    ((key, run),) = runs.items()
    cloud_side = 1 if key == "a" else 0
    with (
        CloudReader(Path((a, b)[cloud_side].name)) as cloud,
        CloudReader(strip) as returns,
        open_task(cloud, returns, tolerance_ns) as task,
    ):
        for rows in read_echoes(cloud):
            task.add(cloud_side, rows)
        for block in blocks:
            found = run.find(block)
            run.add(block, found, np.zeros(len(block), bool))
            rows = found.rows(block)
            rows["gps_time"] = block.gps_time[found.echoes.waveform]
            task.add(1 - cloud_side, rows)
        return task.finish(a.name, b.name)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a chain makes of a block."""

    noise: Noise
    echoes: EchoTable

    def rows(self, block: WaveformBlock) -> np.ndarray:
        """The echoes as a cloud has them, but for their gps_time, which is the row of their waveform."""
        echoes = self.echoes
        rows = np.zeros(len(echoes), CLOUD_DTYPE)
        rows["gps_time"] = echoes.waveform
        for axis, name in enumerate("xyz"):
            rows["xyz"][:, axis] = echoes.attributes[name]
        rows["ray"] = block.direction[echoes.waveform]
        rows["number"], rows["total"] = _rank(echoes.waveform, echoes.time, len(block))
        rows["echo_time"] = echoes.time
        for name in ("flags", "amplitude", "amplitude_err"):
            rows[name] = getattr(echoes, name)
        for name in ("echo_width", "echo_width_err", "range_err"):
            rows[name] = echoes.attributes[name]
        return rows

    def rows_along(self, block: WaveformBlock) -> np.ndarray:
        """The echoes on a vertical line, as far apart as their times are.

        Positions hang on a return, so that those of two chains do not differ where an echo matches it.
        """
        rows = self.rows(block)
        rows["ray"] = rows["xyz"] = 0.0
        rows["xyz"][:, 2] = -SPEED * self.echoes.time
        return rows

    def vendor_rows(self, block: WaveformBlock) -> np.ndarray:
        """The returns of the block in the same way; their amplitude is that of the sample at their place."""
        returns = block.returns
        rows = np.zeros(0 if returns is None else len(returns), CLOUD_DTYPE)
        if returns is None:
            return rows
        for name in ("echo_time", "amplitude", "echo_width", "amplitude_err", "echo_width_err", "range_err"):
            rows[name] = np.nan
        rows["gps_time"], rows["xyz"], rows["ray"] = returns.waveform, returns.xyz, block.direction[returns.waveform]
        rows["number"], rows["total"] = _rank(returns.waveform, returns.time, len(block))
        rows["echo_time"] = returns.time
        sample = np.rint(returns.time / block.spacing)
        inside = np.flatnonzero((sample >= 0) & (sample < block.samples.shape[1]))
        waveform = returns.waveform[inside]
        count = block.samples[waveform, sample[inside].astype(np.int64)]
        rows["amplitude"][inside] = count - self.noise.baseline[waveform]
        return rows


class ChainRun:
    """A chain on the blocks of a strip, with its goodness of fit and what it has in common with the returns."""

    def __init__(self, chain: Chain, system: SystemPulse, tolerance_ns: float) -> None:
        placed = [step for step in chain.steps if step.stage.name == "attribute.position"]
        ending = [Step(STAGES["attribute.echo_width"]), *(placed or [Step(STAGES["attribute.position"])])[:1]]
        self.chain, self.system = Chain((*chain.steps[:3], *ending), chain.name), system
        self.fit, self.vendor = FitQuality(_KEPT), Pairing(tolerance_ns, limit=_KEPT)

    def find(self, block: WaveformBlock) -> _Found:
        """What the chain makes of a block."""
        echoes = self.chain.run(block, self.system)
        estimate = self.chain.steps[0]
        return _Found(estimate.stage.function(block, self.system.of(block), **estimate.parameters), echoes)

    def add(self, block: WaveformBlock, found: _Found, both: np.ndarray) -> None:
        """Takes in what was found; both: waveforms in which the other side has an echo, bool (n,)."""
        number = found.echoes.count(len(block))
        misfit, floor = measure_fit(block, found.noise, self.system.of(block), self.chain.steps[2], found.echoes)
        self.fit.add(misfit, floor, number, both & (number > 0))
        self.vendor.pair_by_time(found.rows(block), found.vendor_rows(block), _keys(block))


def _keys(block: WaveformBlock) -> np.ndarray:
    """Every waveform of the block, so that those without an echo count too."""
    keys = np.zeros(len(block), PACKET_DTYPE)
    keys["gps_time"] = np.arange(len(block))
    return keys


def _rank(waveform: np.ndarray, time: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Number of each echo in its waveform by time, from 1, and how many the waveform has; u1 (m,), 255 at most."""
    order = np.lexsort((time, waveform))
    count = np.bincount(waveform, minlength=n)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count) + 1
    return np.minimum(rank, 255).astype(np.uint8), np.minimum(count[waveform], 255).astype(np.uint8)
