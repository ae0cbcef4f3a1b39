"""Comparison of chains that run on one strip: with each other, with a cloud, and with the vendor's returns.

`wavebatch compare --strip` calls `match_sides`. Two chains are paired by echo time within each waveform, because the
positions of echoes are tied to the vendor's returns and would hide differences of the fits.
"""

from __future__ import annotations

from dataclasses import asdict, field
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import EvenSample
from wavebatch.core.units import AIR_SPEED
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.cloud_reader import CLOUD_DTYPE, CloudReader
from wavebatch.files.strip.packets import MAX_SAMPLES
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import STAGES, Chain, Solved, Step, list_profiles
from wavebatch.stages.decompose.models import rebuild_waveforms
from wavebatch.stages.pulse_tables import clip_level, floor_level
from wavebatch.surveying.choose_chain import Request, widest_chain
from wavebatch.surveying.prepare import Positions, prepare
from wavebatch.surveying.systems.survey_result import SavedSurvey, Survey
from wavebatch.tools import pairing
from wavebatch.tools.api import AUTO, load_chain


@frozen
class Goodness:
    """Goodness of fit E = |f - y|^2 / |f|^2 over waveforms with an echo; NaN without such waveforms."""

    waveforms: int
    mean: float
    median: float
    floor_mean: float
    """Mean of E0, the E that noise alone gives for a perfect fit."""
    floor_median: float


def find_residual(
    block: WaveformBlock, noise: Noise, system: SystemPulse, decomposer: Step, echoes: EchoTable
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The sum of the fitted pulses and what it leaves of the samples, f8 (n, s) [DN], and which samples count.

    Missing samples, and those at the digitizer's limit, do not count: both are 0 there. None without a known model.
    """
    model = rebuild_waveforms(block, system, decomposer, echoes)
    if model is None:
        return None
    used = (block.samples < clip_level(block, system)) & (block.samples > floor_level(system))
    if block.missing is not None:
        used &= ~block.missing
    model = np.where(used, model.astype(np.float64), 0.0)
    return model, np.where(used, block.samples - noise.level.astype(np.float64) - model, 0.0), used


def measure_fit(
    block: WaveformBlock, noise: Noise, system: SystemPulse, decomposer: Step, echoes: EchoTable
) -> tuple[np.ndarray, np.ndarray]:
    """E and E0 of each waveform, f8 (n,); NaN without an echo, or if the model of the decomposer is not known.

    f is the sum of the fitted pulses, y the samples above the baseline, both without what `find_residual` leaves out.
    E0 = n sn^2 / |f|^2 with n samples and sn of one sample: what fits and thresholds use is larger where noise is
    coloured. Source: Wang, Wang and Tseng eq. 5; docs/algorithms.md 1.2.
    """
    found = find_residual(block, noise, system, decomposer, echoes)
    if found is None:
        return np.full(len(block), np.nan), np.full(len(block), np.nan)
    model, residual, used = found
    energy = np.square(model).sum(axis=1)
    energy[energy <= 0] = np.nan
    std = noise.std.astype(np.float64) * (system.noise.quiet / system.noise.std)
    floor = np.count_nonzero(used, axis=1) * np.square(std)
    return np.square(residual).sum(axis=1) / energy, floor / energy


class FitQuality:
    """Collects E and E0 of waveforms: sums of all, and an even sample of them for medians."""

    def __init__(self, limit: int | None = None) -> None:
        self._sample = EvenSample(limit)
        self._sums = {name: np.zeros(3) for name in ("all", "single", "multi", "both")}

    def add(self, misfit: np.ndarray, floor: np.ndarray, number: np.ndarray, both: np.ndarray) -> None:
        """Adds waveforms (n,): E, E0, number of echoes, and whether the other side has an echo too."""
        rows = np.flatnonzero(np.isfinite(misfit))
        part = {"misfit": misfit[rows], "floor": floor[rows], "number": number[rows], "both": both[rows]}
        for name, inside in _classes(part).items():
            self._sums[name] += [inside.sum(), part["misfit"][inside].sum(), part["floor"][inside].sum()]
        self._sample.add(part)

    def result(self) -> dict[str, Goodness]:
        """Goodness of all waveforms, of those with a single echo, with several, and with an echo on both sides; empty
        if E is not known."""
        whole = self._sample.read()
        if not whole or not len(whole["misfit"]):
            return {}
        classes = _classes(whole)
        found = {}
        for name, (number, misfit, floor) in self._sums.items():
            means = [float(total / number) if number else float("nan") for total in (misfit, floor)]
            some = [whole[kind][classes[name]] for kind in ("misfit", "floor")]
            medians = [float(np.median(values)) if len(values) else float("nan") for values in some]
            found[name] = Goodness(int(number), means[0], medians[0], means[1], medians[1])
        return found


def _classes(part: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    number = part["number"]
    return {"all": number > 0, "single": number == 1, "multi": number > 1, "both": part["both"]}


_BLOCK = 8192
"""Waveforms that run through the chains at once."""

_KEPT = 200_000
"""Waveforms and pairs per chain from which medians of goodness and returns are taken; bounds the memory."""


@frozen
class Contender:
    """One side of a match on a strip."""

    name: str
    """Name of a chain, or path of a cloud."""
    chain: Chain | None = None
    """The chain; None for a cloud, and for AUTO until the strip is surveyed."""

    @property
    def is_cloud(self) -> bool:
        """Whether it is a cloud, which needs no run."""
        return self.chain is None and self.name != AUTO


def find_contender(name: str) -> Contender:
    """A shipped chain by its name, `auto`, a chain file (.toml), or else a cloud; ConfigError for a wrong chain."""
    is_chain = name in list_profiles() or Path(name).suffix.lower() == ".toml"
    return Contender(name, load_chain(name) if is_chain else None)


@frozen
class Matchup:
    """Comparison of two sides, a and b, on the waveforms of one strip; b may be the vendor's returns."""

    strip: str
    waveforms: int
    """Waveforms that were compared."""
    returns: int
    """The vendor's returns in these waveforms."""
    between: pairing.Comparison
    """a with b; two chains by time within each waveform, so that differences are those of the fits."""
    vendor: dict[str, pairing.Comparison] = field(default_factory=dict)
    """Chains `a` and `b` with the vendor's returns, by position within each waveform."""
    fit: dict[str, dict[str, Goodness]] = field(default_factory=dict)
    """Goodness of fit of `a` and `b`: of `all` waveforms with an echo, of those with a `single` echo, with several
    (`multi`), and with echoes of `both` chains; empty for a cloud, which does not hold the fitted model."""

    def to_json(self) -> dict:
        """Plain numbers, lists and dictionaries for JSON."""
        document = self.between.to_json() | asdict(self)
        del document["between"]
        document["vendor"] = {side: one.to_json() for side, one in self.vendor.items()}
        document["fit"] = {side: fit or None for side, fit in document["fit"].items()}
        return document


def match_sides(
    strip: Path,
    a: Contender,
    b: Contender | None = None,
    *,
    tolerance_ns: float = 1.0,
    survey: Survey | None = None,
    force: bool = False,
    limit: int | None = None,
    block_size: int = _BLOCK,
) -> Matchup:
    """Compares the echoes of a and b on the waveforms of a strip; without b, a with the vendor's returns.

    At least one side is a chain. survey: used instead of a survey of the strip; force: also where the strip contradicts
    it. limit: use about as many waveforms, spread evenly over the strip, instead of all; not with a cloud. block_size:
    waveforms at a time. Memory is bounded, as in compare_clouds.
    Raises InputError for files that cannot be read, ConfigError for sides that cannot be compared.
    """
    clouds = [side for side in (a, b) if side is not None and side.is_cloud]
    if len(clouds) == (1 if b is None else 2):
        raise ConfigError(f"{a.name}: both sides are results already; compare them without --strip")
    if clouds and limit is not None:
        raise ConfigError(f"{clouds[0].name}: a cloud has the echoes of all waveforms; leave --limit out")
    pairing.check_tolerance(tolerance_ns)
    with StripReader(strip) as reader, reader.scan(force=force) as scan:
        saved = None if survey is None else SavedSurvey(survey)
        request = Request(auto=True, system=saved, force=force)
        choice = prepare(reader, scan, widest_chain(), request, positions=Positions.NONE).choice
        chains = {key: side for key, side in (("a", a), ("b", b)) if side is not None and not side.is_cloud}
        system = choice.survey.system
        runs = {key: ChainRun(side.chain or choice.chain, system, tolerance_ns) for key, side in chains.items()}
        blocks = reader.all_blocks(scan, block_size)
        if limit is not None:
            blocks = reader.sample_blocks(scan, limit, block_size, long_samples=limit * MAX_SAMPLES)
        if clouds:  # as two clouds
            ((key, run),) = runs.items()
            side = 1 if key == "a" else 0  # of the cloud
            with (
                CloudReader(Path((a, b)[side].name)) as cloud,
                CloudReader(Path(strip)) as returns,
                pairing.open_task(cloud, returns, tolerance_ns) as task,
            ):
                for rows in pairing.read_echoes(cloud):
                    task.add(side, rows)
                for block in blocks:
                    found = run.find(block)
                    run.add(block, found, np.zeros(len(block), bool))
                    rows = found.rows()
                    rows["gps_time"] = block.gps_time[found.echoes.waveform]
                    task.add(1 - side, rows)
                between = task.finish(a.name, b.name)
        else:
            # Waveform by waveform: two chains, or one and the vendor's returns.
            pairs = pairing.Pairing(tolerance_ns)
            for block in blocks:
                found = {key: run.find(block) for key, run in runs.items()}
                number = {key: one.echoes.count(len(block)) for key, one in found.items()}
                for key, run in runs.items():
                    other = number.get("b" if key == "a" else "a", np.zeros(len(block), np.int64))
                    run.add(block, found[key], other > 0)
                sides = [found["a"].rows(), found["a"].vendor_rows()]
                if "b" in found:
                    sides = [one.rows_along() for one in found.values()]
                keys = np.arange(len(block), dtype=np.float64)  # all waveforms: those without an echo count too
                pairs.pair_by_time(*sides, keys.view(pairing.PACKET_DTYPE))
            between = pairs.finish(a.name, b.name if b else str(strip), "waveform")
    some = next(iter(runs.values())).vendor
    vendor = {key: run.vendor.finish(chains[key].name, str(strip), "waveform") for key, run in runs.items()}
    fit = {key: runs[key].fit.result() if key in runs else {} for key in ("a", "b")[: 1 if b is None else 2]}
    return Matchup(str(strip), some.pulses, some.echoes[1], between, vendor, fit)


class _Found(Solved):
    """Noise and echoes of a chain in a block, as rows of clouds."""

    def rows(self) -> np.ndarray:
        """The echoes as rows of a cloud; gps_time is the row of the waveform in the block."""
        block, echoes = self.block, self.echoes
        rows = np.zeros(len(echoes), CLOUD_DTYPE)
        rows["gps_time"] = echoes.waveform
        rows["xyz"] = np.stack([echoes.attributes[name] for name in "xyz"], axis=1)
        rows["ray"] = block.direction[echoes.waveform]
        rows["number"], rows["total"] = _rank(echoes.waveform, echoes.time, len(block))
        rows["echo_time"] = echoes.time
        for name in ("flags", "amplitude", "amplitude_err"):
            rows[name] = getattr(echoes, name)
        for name in ("echo_width", "echo_width_err", "range_err"):
            rows[name] = echoes.attributes[name]
        return rows

    def rows_along(self) -> np.ndarray:
        """The echoes on a vertical line, with distances that follow from their times.

        Positions would not do: an echo that matches a return lies on the return, whatever the chain has fitted.
        """
        rows = self.rows()
        rows["ray"] = rows["xyz"] = 0.0
        rows["xyz"][:, 2] = -AIR_SPEED * self.echoes.time
        rows["echo_time"] = np.nan  # the distances are these times: they would be compared twice
        return rows

    def vendor_rows(self) -> np.ndarray:
        """The returns of the block as rows of a cloud; the amplitude is that of the sample nearest to the return."""
        block, returns = self.block, self.block.returns
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
        at = sample[inside].astype(np.int64)
        level = np.broadcast_to(self.noise.level, block.samples.shape)[waveform, at]
        rows["amplitude"][inside] = block.samples[waveform, at] - level
        if block.missing is not None:
            rows["amplitude"][inside[block.missing[waveform, at]]] = np.nan
        return rows


class ChainRun:
    """Runs a chain on blocks and collects its goodness of fit and its comparison with the vendor's returns."""

    def __init__(self, chain: Chain, system: SystemPulse, tolerance_ns: float) -> None:
        placed = [step for step in chain.steps if step.stage.name == "attribute.position"]
        ending = [Step(STAGES["attribute.echo_width"]), *(placed or [Step(STAGES["attribute.position"])])[:1]]
        self.chain, self.system = Chain((*chain.steps[:3], *ending), chain.name), system
        self.fit, self.vendor = FitQuality(_KEPT), pairing.Pairing(tolerance_ns, limit=_KEPT)

    def find(self, block: WaveformBlock) -> _Found:
        """Runs the chain on a block."""
        return _Found(*self.chain.solve(block, self.system))

    def add(self, block: WaveformBlock, found: _Found, both: np.ndarray) -> None:
        """Adds the result of a block; both: waveforms in which the other side has an echo, bool (n,)."""
        number = found.echoes.count(len(block))
        misfit, floor = measure_fit(found.block, found.noise, found.system, self.chain.decomposer, found.echoes)
        self.fit.add(misfit, floor, number, both & (number > 0))
        keys = np.arange(len(block), dtype=np.float64)  # all waveforms, so that those without an echo count too
        self.vendor.pair_by_time(found.rows(), found.vendor_rows(), keys.view(pairing.PACKET_DTYPE))


def _rank(waveform: np.ndarray, time: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Number of each echo in its waveform by time, from 1, and echoes per waveform; u1 (m,), at most 255."""
    order = np.lexsort((time, waveform))
    count = np.bincount(waveform, minlength=n)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count) + 1
    return np.minimum(rank, 255).astype(np.uint8), np.minimum(count[waveform], 255).astype(np.uint8)
