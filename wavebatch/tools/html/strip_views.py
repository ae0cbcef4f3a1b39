"""Waveforms for a page: some at random, and those that the chain fits worst among a sample. Memory is bounded.

`strip_part` and `survey_page` draw them. Only a sample of a strip is searched: all of it would take as long as the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import Chain
from wavebatch.stages.decompose.rebuild import rebuild_waveforms
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.surveying.choose_chain import sample_size
from wavebatch.tools.html.charts import draw_sheet, figures
from wavebatch.tools.html.markup import paragraph, section
from wavebatch.tools.plots.waveform import WaveformView, build_views

SEARCHED = 4096
"""Waveforms among which the worst fits are looked for."""

SHOWN_RANDOM, SHOWN_WORST = 8, 4
"""Waveforms drawn of each kind."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Waveforms of a strip with the result of its chain."""

    searched: int
    total: int
    """Waveforms of the strip."""
    random: tuple[WaveformView, ...]
    worst: tuple[tuple[WaveformView, float], ...]
    """With the root mean square of their residual in standard deviations of the noise, the largest first."""


def read_page_views(path: Path, chain: Chain, system: SystemPulse, *, seed: int = 0, **reading: Any) -> Views:
    """Waveforms of a sample that is spread evenly over the strip; reading: direction and headerless.

    Raises InputError if the strip cannot be read.
    """
    generator = np.random.default_rng(seed)
    drawn: list[tuple[float, WaveformView]] = []
    worst: list[tuple[float, WaveformView]] = []
    searched = 0
    with StripReader(path, **reading) as reader, reader.scan() as scan:
        total = scan.packets
        for block in reader.sample_blocks(scan, min(SEARCHED, sample_size(reader, scan))):
            searched += len(block)
            residual = measure_view_residuals(block, chain, system)
            # The least of random numbers, kept over all blocks, draw each waveform with the same chance.
            order = generator.random(len(block))
            drawn = _keep(drawn, block, chain, system, order, SHOWN_RANDOM)
            worst = _keep(worst, block, chain, system, -residual, SHOWN_WORST)
    bad = tuple((view, -key) for key, view in worst if np.isfinite(key))
    return Views(searched, total, tuple(sorted((view for _, view in drawn), key=lambda view: view.point)), bad)


def _keep(
    kept: list[tuple[float, WaveformView]], block: WaveformBlock, chain: Chain, system: SystemPulse, keys: np.ndarray,
    most: int,
) -> list[tuple[float, WaveformView]]:  # fmt: skip
    """The waveforms with the `most` least keys of those kept so far and of the block."""
    rows = np.argsort(keys, kind="stable")[:most]
    rows = np.sort(rows[np.isfinite(keys[rows])])
    if not len(rows):
        return kept
    views = build_views(block.rows(rows), chain, system, [-1] * len(rows))
    return sorted([*kept, *zip(keys[rows].tolist(), views, strict=True)], key=lambda pair: pair[0])[:most]


def measure_view_residuals(block: WaveformBlock, chain: Chain, system: SystemPulse) -> np.ndarray:
    """Root mean square of each waveform's residual in standard deviations of the noise, f8 (n,); NaN without a model.

    Samples that are missing, or at the digitizer's limit, are left out.
    """
    block, noise, system, echoes = chain.solve(block, system)
    fit = rebuild_waveforms(block, system, chain.steps[2], echoes)
    if fit is None:
        return np.full(len(block), np.nan)
    samples = block.samples.astype(np.float64)
    used = samples < clip_level(block, system)
    if block.missing is not None:
        used &= ~block.missing
    level = np.stack([np.broadcast_to(noise.level[row], samples.shape[1:]) for row in range(len(block))])
    variance = noise.std[:, None].astype(np.float64) ** 2 + system.noise.gain * np.maximum(fit, 0)
    square = np.where(used, (samples - level - fit) ** 2 / variance, 0.0)
    number = used.sum(axis=1)
    return np.sqrt(square.sum(axis=1) / np.maximum(number, 1))


def draw_waveforms(path: Path, chain: Chain, system: SystemPulse, name: str, **reading: Any) -> str:
    """The sheet of random waveforms and the worst fits, as sections of a page; name: of the chain.

    reading, errors: as for `read_page_views`.
    """
    views, level = read_page_views(path, chain, system, **reading), 3
    whole = f"all {views.searched:,} waveforms"
    part = f"{views.searched:,} waveforms that are spread over the strip ({views.total:,} in all)"
    head = (
        f"Drawn at random from {whole if views.searched >= views.total else part}. Chain: {name}. `wavebatch plot "
        "waveform STRIP --point N -o FILE.png` draws one of them large."
    )
    sheet = figures([draw_sheet(views.random, "Random waveforms")], "sheet")
    parts = [section("Random waveforms", paragraph(head), sheet, level=level)]
    if views.worst:
        words = (
            f"The largest residuals among these {views.searched:,} waveforms, as root mean square in standard "
            "deviations of the noise (1 is noise alone)."
        )
        if views.searched < views.total:
            words += f" The other {views.total - views.searched:,} waveforms of the strip were not searched."
        notes = [f"residual {rms:.2f}" for _, rms in views.worst]
        worst = draw_sheet([view for view, _ in views.worst], "Worst fits", notes)
        parts.append(section("Worst fits", paragraph(words), figures([worst], "sheet"), level=level))
    return "\n".join(parts)
