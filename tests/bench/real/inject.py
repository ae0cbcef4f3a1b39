"""Echoes of known time, amplitude and width, added to the waveforms of a strip.

They lie at random places: in quiet stretches, or near the strongest echo of a waveform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from bench.real.noise import QuietNoise, unround
from bench.real.pool import ROWS, Pool, Solver, each_echo, find_fill, find_gaps, find_strongest
from bench.real.templates import Template, bare_block, digitizer_kind

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.scanner import expand
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.stages.score import match_echoes

LEAST = 2.5
"""Least amplitude that is injected [noise standard deviations]."""

CLIPPED = 0.001
"""Share of waveforms with clipped samples from which clipped echoes are injected too ..."""

CLIPPED_INJECTED, MOST_CLIPPED = 0.1, 1.5
"""... this share of all, up to this many times as high as the digitizer's range."""

TOLERANCE = 0.6
"""A found echo this near is the injected one [FWHM]."""

QUIET = 4.0
"""An injected echo this far from every echo of its waveform lies in a quiet stretch [FWHM of the system pulse]."""

NEAREST, FARTHEST = 0.5, 4.0
"""Separations from the strongest echo that are tried, before and after it [FWHM]."""

EDGE = 1.5
"""Least distance of an injected echo from the ends of its waveform [FWHM]."""

TRIES = 24
"""Places that are tried for an echo in a waveform before another waveform is taken."""

HOST = 10.0
"""Least amplitude of the strongest echo of a waveform near which one is injected [noise standard deviations]."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where echoes are injected into a block."""

    row: np.ndarray
    """Of the block, i8 (k,)."""
    time: np.ndarray
    """[ns], f8 (k,)."""
    strongest: np.ndarray
    """Row in the table of echoes of the strongest echo of the waveform; -1 for quiet stretches."""


@dataclass(frozen=True, slots=True, eq=False)
class Injected:
    """k injected echoes and what a chain made of them, one array per field."""

    near: np.ndarray
    """Near the waveform's strongest echo, else in a quiet stretch, bool."""
    separation: np.ndarray
    """From the strongest echo, negative before it [FWHM]; NaN in quiet stretches."""
    host: np.ndarray
    """Amplitude of that echo [DN]; NaN in quiet stretches."""
    amplitude: np.ndarray
    """[DN]."""
    clipped: np.ndarray
    """Samples of it are at the digitizer's limit, bool."""
    found: np.ndarray
    """Found, and the strongest echo still found too where it is near, bool."""
    extra: np.ndarray
    """Echoes found that neither were there before nor were injected."""
    errors: np.ndarray
    """Found minus injected time [ns], amplitude [DN] and sigma [ns], (k, 3); NaN where not found."""
    reported: np.ndarray
    """Standard deviations of these that the chain reports, (k, 3)."""

    def __len__(self) -> int:
        return len(self.near)

    @classmethod
    def join(cls, parts: Sequence[Injected]) -> Injected:
        """All echoes of several tables."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__))


def inject_echoes(
    pool: Pool,
    solver: Solver,
    echoes: Sequence[EchoTable],
    templates: Sequence[Template],
    noise: QuietNoise,
    number: int,
    rng: np.random.Generator,
) -> Injected:
    """Injects about `number` echoes, half in quiet stretches and half near strong echoes, and runs the chain again.

    echoes: of the pool's blocks. Only one echo is added to a copy of
    a waveform. Blocks without a template of their digitizer get none.
    """
    parts = []
    for block, table in zip(pool.blocks, echoes, strict=True):
        usable = [template for template in templates if template.kind == digitizer_kind(block)]
        share = round(number * len(block) / max(len(pool), 1))
        if not usable or not share:
            continue
        for near in (False, True):
            for begin in range(0, max(share // 2, 1), ROWS):
                wanted = min(ROWS, max(share // 2, 1) - begin)
                places = _find_places(block, table, solver, noise.std, wanted, near, rng)
                if len(places.row):
                    parts.append(_inject(block, table, solver, usable, noise, places, rng))
    return Injected.join(parts) if parts else _nothing()


def _nothing() -> Injected:
    none = np.empty(0)
    return Injected(none > 0, none, none, none, none > 0, none > 0, none, np.empty((0, 3)), np.empty((0, 3)))


def _find_places(
    block: WaveformBlock,
    table: EchoTable,
    solver: Solver,
    noise: float,
    wanted: int,
    near: bool,
    rng: np.random.Generator,
) -> Places:
    """Random places that meet the rules; fewer than wanted where the strip has no room."""
    fwhm, end = solver.fwhm, (block.samples.shape[1] - 1) * block.spacing
    strongest = find_strongest(table, len(block))
    hosts = np.arange(len(block))
    if near:
        strong = np.where(strongest >= 0, table.amplitude[strongest] if len(table) else 0.0, 0.0)
        hosts = np.flatnonzero(strong > HOST * noise)
    if not len(hosts) or end <= 2 * EDGE * fwhm:
        return Places(*(np.empty(0, np.int64),) * 3)
    row = np.repeat(rng.choice(hosts, wanted), TRIES)
    if near:
        # As many at each ratio of separations: the narrow ones matter most.
        apart = np.exp(rng.uniform(np.log(NEAREST), np.log(FARTHEST), len(row))) * rng.choice((-1, 1), len(row))
        time = table.time[strongest[row]] + apart * fwhm
    else:
        time = rng.uniform(EDGE * fwhm, end - EDGE * fwhm, len(row))
    good = (time >= EDGE * fwhm) & (time <= end - EDGE * fwhm)
    good &= _is_clear(table, row, time, fwhm, strongest if near else None)
    good &= ~_touches_fill(block, row, time, fwhm)
    tries = good.reshape(wanted, TRIES)
    done = np.flatnonzero(tries.any(axis=1))
    chosen = done * TRIES + tries[done].argmax(axis=1)
    owner = strongest[row[chosen]] if near else np.full(len(chosen), -1)
    return Places(row[chosen], time[chosen], owner)


def _is_clear(
    table: EchoTable, row: np.ndarray, time: np.ndarray, fwhm: float, strongest: np.ndarray | None
) -> np.ndarray:
    """Whether no echo of the waveform is near; the strongest may be, and others of it further off then."""
    clear = np.ones(len(row), bool)
    for have, echo in each_echo(table, row):
        apart = np.abs(time[have] - table.time[echo]) / fwhm
        limit = QUIET if strongest is None else np.where(strongest[row[have]] == echo, 0.0, 0.5 * QUIET)
        clear[have] &= apart >= limit
    return clear


def _touches_fill(block: WaveformBlock, row: np.ndarray, time: np.ndarray, fwhm: float) -> np.ndarray:
    """Whether a gap between two recordings lies under the echo or next to it."""
    fill = find_gaps(block)
    if not fill.any():
        return np.zeros(len(row), bool)
    before = np.concatenate([np.zeros((len(fill), 1), np.int64), np.cumsum(fill, axis=1)], axis=1)
    s = fill.shape[1]
    low = np.clip(np.floor((time - EDGE * fwhm) / block.spacing), 0, s).astype(int)
    high = np.clip(np.ceil((time + EDGE * fwhm) / block.spacing) + 1, 0, s).astype(int)
    return before[row, high] > before[row, low]


def _inject(
    block: WaveformBlock,
    table: EchoTable,
    solver: Solver,
    templates: Sequence[Template],
    noise: QuietNoise,
    places: Places,
    rng: np.random.Generator,
) -> Injected:
    limit = clip_level(block, solver.system.of(block))
    height, which = _draw_pulses(templates, noise.std, len(places.row), rng)
    if (block.samples >= limit).any(axis=1).mean() > CLIPPED:
        _raise_some(height, which, templates, limit - solver.system.of(block).noise.baseline, rng)
    lag = np.arange(block.samples.shape[1]) * block.spacing - places.time[:, None]
    signal = np.empty(lag.shape)
    for number in np.unique(which):
        rows = which == number
        signal[rows] = height[rows, None] * templates[number].evaluate(lag[rows])
    samples = block.samples[places.row]
    exact = unround(samples, solver.expect(block, table)[places.row], noise, rng)
    added = add_signal(samples, exact, signal, limit)
    clipped = ((added >= limit) & (np.abs(lag) < solver.fwhm)).any(axis=1)
    gain, delay, sigma = np.array([(t.gain, t.delay, t.sigma) for t in templates])[which].T
    true = np.stack([places.time + delay, gain * height, sigma], axis=1)
    bare = replace(bare_block(block, added), missing=None if block.missing is None else block.missing[places.row])
    return _compare(solver.run(bare), table, places, true, clipped, solver.fwhm)


def _compare(
    found: EchoTable, table: EchoTable, places: Places, true: np.ndarray, clipped: np.ndarray, fwhm: float
) -> Injected:
    """What was found of the injected echoes; true: their times, amplitudes and sigmas (k, 3)."""
    k = len(true)
    truth, is_new, is_host = _list_truth(table, places, true)
    match = match_echoes(found, truth, TOLERANCE * fwhm)
    place = np.full(len(truth), -1)
    place[match.truth] = match.found
    kept = np.ones(k, bool)
    kept[truth.waveform[is_host]] = place[is_host] >= 0
    mine = place[is_new]
    hit = (mine >= 0) & kept
    errors, reported = np.full((k, 3), np.nan), np.full((k, 3), np.nan)
    for column, name in enumerate(("time", "amplitude", "sigma")):
        errors[hit, column] = getattr(found, name)[mine[hit]] - true[hit, column]
        reported[hit, column] = getattr(found, f"{name}_err")[mine[hit]]
    near = places.strongest >= 0
    separation, host = np.full(k, np.nan), np.full(k, np.nan)
    separation[near] = (places.time[near] - table.time[places.strongest[near]]) / fwhm
    host[near] = table.amplitude[places.strongest[near]]
    extra = found.count(k) - np.bincount(found.waveform[match.found], minlength=k)
    return Injected(near, separation, host, true[:, 1], clipped, hit, extra, errors, reported)


def _draw_pulses(
    templates: Sequence[Template], noise: float, k: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Heights [DN], as many at each ratio, and the number of the template of each: one of echoes at least as strong."""
    tiers = np.array([template.tier for template in templates])
    tops = [max(t.amplitude for t in templates if t.tier == tier) for tier in np.unique(tiers)]
    most = max(tops[-1], 2 * LEAST * noise)
    height = np.exp(rng.uniform(np.log(LEAST * noise), np.log(most), k))
    tier = np.unique(tiers)[np.minimum(np.searchsorted(np.maximum.accumulate(tops), height), len(tops) - 1)]
    choice = rng.random(k)
    which = np.empty(k, np.int64)
    for number in np.unique(tier):
        members, rows = np.flatnonzero(tiers == number), tier == number
        which[rows] = members[(choice[rows] * len(members)).astype(int)]
    return height, which


def _raise_some(
    height: np.ndarray, which: np.ndarray, templates: Sequence[Template], room: float, rng: np.random.Generator
) -> None:
    """Makes some heights exceed what the digitizer can hold, in place. room: from the baseline to its limit [DN].

    Flat targets only: what a fit cannot see in a widened echo it would see in one made stronger.
    """
    over = rng.random(len(height)) < CLIPPED_INJECTED
    strong = [number for number, template in enumerate(templates) if template.tier == templates[-1].tier]
    flat = sorted(strong, key=lambda number: templates[number].fwhm)[: len(strong) // 2 + 1]
    height[over] = room * rng.uniform(1.0, MOST_CLIPPED, over.sum())
    which[over] = rng.choice(flat, over.sum())


def add_signal(samples: np.ndarray, exact: np.ndarray, signal: np.ndarray, limit: float) -> np.ndarray:
    """Raw counts with a signal added as if the digitizer had seen both.

    exact: the samples before they were rounded, so that they are rounded only once. Samples at the digitizer's limit,
    those that only fill a packet and those without signal stay what they are.
    """
    top = min(limit, float(np.iinfo(samples.dtype).max))
    added = np.clip(np.rint(exact + signal), 0, top)
    keep = find_fill(samples) | (samples >= limit) | (signal == 0)
    return np.where(keep, samples, added).astype(samples.dtype)


def _list_truth(table: EchoTable, places: Places, true: np.ndarray) -> tuple[EchoTable, np.ndarray, np.ndarray]:
    """The echoes that the copies hold; rows of the injected ones in order of the copies, and of the hosts."""
    k = len(true)
    count = np.bincount(table.waveform, minlength=int(places.row.max(initial=0)) + 1)
    first = np.cumsum(count) - count
    number = count[places.row]
    copy, old = np.repeat(np.arange(k), number), expand(first[places.row], number)
    is_new = np.repeat((False, True), (len(copy), k))
    is_host = np.r_[places.strongest[copy] == old, np.zeros(k, bool)]
    before = np.stack([table.time, table.amplitude, table.sigma], axis=1)[old]
    truth = EchoTable.build(
        np.r_[copy, np.arange(k)], *np.concatenate([before, true]).T, attributes={"new": is_new, "host": is_host}
    )
    return truth, np.flatnonzero(truth.attributes["new"]), np.flatnonzero(truth.attributes["host"])
