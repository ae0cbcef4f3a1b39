"""The pictures of pages: pulses, histograms, values with errors, maps of clouds, sheets of waveforms; by matplotlib.

Each function gives a list with one picture as a part of a sheet, or an empty one where there is nothing to draw or
matplotlib is not installed: the page then says how to get the pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.order import EvenSample
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.cloud.cloud_reader import ColumnFacts, ColumnReader
from wavebatch.files.figure_file import has_matplotlib, open_svg, plain_text
from wavebatch.files.las.crs import describe_crs
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, evaluate_pulse
from wavebatch.stages.chain import Chain
from wavebatch.surveying.systems.survey_result import sample_pulse
from wavebatch.tools.cells import Raster, Tally, choose_grid, compute_cells, find_shown, robust_limits
from wavebatch.tools.compare_chains import find_residual
from wavebatch.tools.plots.draw_cloud import SERIES_COLORS, add_colorbar, draw_cells
from wavebatch.tools.plots.draw_waveform import HEAD, LEGEND, draw_small_waveforms, sheet_size
from wavebatch.tools.plots.waveform import WaveformView, build_views
from wavebatch.tools.sheets.sheet import Note, Picture, Sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_SHARE = 0.001
"""Share of the values at each end that a histogram leaves out and counts in words."""

MOST_BARS = 60

SIZE = (4.2, 2.7)
"""Width and height of a chart [inch]."""

PLACE = (0.19, 0.18, 0.78, 0.69)
"""Of the axes in it: left, bottom, width and height."""

SAMPLED_POINTS = 400_000
"""Most points of the sample of a cloud."""

MOST_CELLS = 160
"""Cells along the longer side of a map, which is small."""

BINS = 60

MAP_SIDE = 3.4
"""Most width and height of a map [inch]."""

SHEET_COLUMNS = 4

SEARCHED = 4096
"""Waveforms among which the worst fits are looked for."""

SHOWN_RANDOM, SHOWN_WORST = 8, 4
"""Waveforms drawn of each kind."""


def picture(title: str, size: tuple[float, float], draw: Callable[[Figure], None], words: str = "",
            kind: str = "figures") -> list[Picture]:  # fmt: skip
    """A figure with words below it; nothing without matplotlib."""
    if not has_matplotlib():
        return []
    with open_svg(size) as (figure, drawn):
        draw(figure)
    return [Picture(title, drawn[0], size, words, kind)]


def chart(title: str, labels: tuple[str, str], draw: Callable[[Axes], None], words: str = "") -> list[Picture]:
    """A figure of one chart with a title and labels of its axes."""
    texts = {"title": plain_text(title, 60), "xlabel": plain_text(labels[0], 60), "ylabel": plain_text(labels[1], 40)}
    return picture(title, SIZE, lambda figure: draw(figure.add_axes(PLACE, **texts)), words)


def chart_pulse(system: SystemPulse, spacing: float, title: str = "System pulse") -> list[Picture]:
    """The pulse that is fitted, height 1 at its peak, with a Gaussian of its width and the distance of samples."""
    time, pulse = sample_pulse(system, spacing)
    gaussian = evaluate_pulse(GAUSSIAN, time / system.sigma_ref, np.float64(0.0), np.float64(1.0))[0]
    at = np.arange(np.ceil(time[0] / spacing), np.floor(time[-1] / spacing) + 1) * spacing

    def draw(axes: Axes) -> None:
        axes.plot(time, gaussian, "--", color="#8a8a8a", linewidth=1, label="Gaussian of the same width")
        axes.plot(time, pulse, color=SERIES_COLORS[0], label="pulse of this strip")
        axes.plot(at, np.interp(at, time, pulse), "o", color=SERIES_COLORS[0], markersize=2.5)
        axes.set(xlim=(time[0], time[-1]), ylim=(min(0.0, float(pulse.min())) - 0.05, 1.35))
        axes.legend(loc="upper right", fontsize=7.5, borderaxespad=0.2)

    full = system.sigma_ref * FWHM_PER_SIGMA
    words = f"Full width at half maximum {full:.3f} ns; dots are {spacing:g} ns apart, as samples are."
    return chart(title, ("time after the peak [ns]", "height"), draw, words)


def draw_sheet(views: Sequence[WaveformView], title: str, notes: Sequence[str] = ()) -> list[Picture]:
    """Small pictures of waveforms; notes: a word on each."""
    columns = min(SHEET_COLUMNS, len(views)) or 1
    wide, high = sheet_size(len(views), columns)
    size = (wide, high - HEAD)
    draw = lambda figure: draw_small_waveforms(figure, views, columns, notes=notes, head=0.0)  # noqa: E731
    return picture(title, size, draw, LEGEND, "sheet")


def draw_histogram(edges: np.ndarray, counts: np.ndarray, *, title: str, label: str, log: bool = False,
                   beyond: int = 0) -> list[Picture]:  # fmt: skip
    """A histogram of counts i8 (b,) between edges (b + 1,) without its outermost values, which are counted.

    beyond: values outside of the edges, to be counted too.
    """
    borders, merged = merge_bins(edges, counts)
    total, shown = int(counts.sum()) + beyond, int(merged.sum())
    if not shown:
        return []

    def draw(axes: Axes) -> None:
        axes.stairs(merged, borders, fill=True, color=SERIES_COLORS[0], alpha=0.75)
        if log and borders[0] > 0:
            from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set(xlim=(borders[0], borders[-1]), ylim=(0, 1.06 * merged.max()))
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value == round(value) else "")

    words = f"{total:,} values; {total - shown:,} of them outside of the picture."
    return chart(title, (label, "number"), draw, words)


def merge_bins(edges: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most MOST_BARS bins without the outermost SHOWN_SHARE of the values at each end."""
    total = int(counts.sum())
    sums = np.cumsum(counts)
    first = int(np.searchsorted(sums, SHOWN_SHARE * total, side="right"))
    last = int(np.searchsorted(sums, (1 - SHOWN_SHARE) * total))
    first, last = min(first, last, len(counts) - 1), max(first, last)
    step = max(1, -(-(last - first + 1) // MOST_BARS))
    last = min(first + step * -(-(last - first + 1) // step), len(counts))
    return np.append(edges[first:last:step], edges[last]), np.add.reduceat(
        counts[first:last], np.arange(0, last - first, step)
    )


def draw_counts(counts: Mapping[str, int] | Sequence[tuple[str, int]], *, title: str, label: str) -> list[Picture]:
    """A bar per name, which are few and short."""
    rows = list(counts.items() if isinstance(counts, Mapping) else counts)

    def draw(axes: Axes) -> None:
        axes.bar(range(len(rows)), [number for _, number in rows], color=SERIES_COLORS[0], alpha=0.75)
        axes.set_xticks(range(len(rows)), [name for name, _ in rows], fontsize=8)
        axes.grid(axis="x", visible=False)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value == round(value) else "")

    return chart(title, (label, "number"), draw, "; ".join(f"{name}: {number:,}" for name, number in rows))


def draw_map(found: Raster, note: str = "") -> list[Picture]:
    """A map: cells coloured from the 2nd to the 98th percentile, north up, equal scales; note: added to the caption."""
    grid = found.grid
    across, up = (MAP_SIDE * side / max(grid.columns, grid.rows) for side in (grid.columns, grid.rows))
    across, up = max(across, 0.8), max(up, 0.8)
    size = (across + 2.2, up + 1.0)
    west, east, south, north = grid.extent

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.95 / size[0], 0.55 / size[1], across / size[0], up / size[1]))
        axes.set_title(f"{found.statistic} of {found.facts.name}", fontsize=9.5)
        shown = draw_cells(axes, found, (0, east - west, 0, north - south))
        place = figure.add_axes(((1.1 + across) / size[0], 0.55 / size[1], 0.12 / size[0], up / size[1]))
        label = found.label if found.statistic == "density" else f"{found.facts.name} [{found.facts.unit}]"
        add_colorbar(axes, shown, found.values, found.shown, label, length=up, flat=False, place=place)
        axes.locator_params(axis="x", nbins=4 if across > 1.5 else 1)
        axes.locator_params(axis="y", nbins=4 if up > 1.5 else 1)
        axes.set(xlabel=f"east [{found.crs.unit}]", ylabel=f"north [{found.crs.unit}]")

    words = f"Cells of {grid.size:g} {found.crs.unit}; origin {west:.10g} E, {south:.10g} N{note}."
    return picture(f"{found.statistic} of {found.facts.name}", size, draw, words)


def draw_values(
    names: Sequence[str], values: Sequence[float], errors: Sequence[float], *, title: str, label: str
) -> list[Picture]:
    """Values with their errors, side by side."""
    middle, spread = np.asarray(values, np.float64), np.nan_to_num(np.asarray(errors, np.float64))
    # Small constants: a power of ten in the label, so that ticks differ and stay short.
    largest = float(np.abs(middle).max())
    power = int(np.floor(np.log10(largest))) if largest else 0
    if abs(power) > 3:
        middle, spread, label = middle / 10.0**power, spread / 10.0**power, f"1e{power} {label}"

    def draw(axes: Axes) -> None:
        axes.errorbar(np.arange(len(names)) + 1, middle, yerr=spread, fmt="o", color=SERIES_COLORS[0], capsize=3)
        axes.set_xticks(np.arange(len(names)) + 1)
        axes.margins(x=0.1, y=0.15)

    return chart(title, ("", label), draw, ", ".join(f"{place + 1}: {name}" for place, name in enumerate(names)))


def figures_of(document: Mapping[str, Any]) -> list[Picture]:
    """Histograms of a report's `quality`: amplitudes and widths of all echoes, echoes per waveform."""
    parts = []
    for name, title, label in (("amplitude_dn", "Amplitude", "[DN]"), ("echo_width_ns", "Echo width", "[ns]")):
        one = document[name]["histogram"]
        counts = np.array(one["counts"], np.int64)
        edges = one["low"] * np.exp(one["log_step"] * (one["first_bin"] + np.arange(len(counts) + 1)))
        if counts.any():
            parts += draw_histogram(edges, counts, title=title, label=f"{title.lower()} {label}", log=True)
    per = document["echoes_per_waveform"]
    last = max((number for number, count in enumerate(per) if count), default=0)
    shown = [(f"{n}" if n < len(per) - 1 else f"{n} or more", count) for n, count in enumerate(per[: last + 1])]
    return [*parts, *draw_counts(shown, title="Echoes per waveform", label="echoes")]


def picture_cloud(path: Path, columns: Sequence[str]) -> Iterator[Sheet]:
    """Histograms and maps of the columns that the cloud has, from an even sample of its points.

    Raises InputError if it cannot be read. `wavebatch plot` and `wavebatch grid` show every point, and finer cells.
    """
    sample = EvenSample(SAMPLED_POINTS)
    with ColumnReader(path, *columns, missing_ok=True) as reader:
        for rows in reader.read_pieces():
            good = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
            sample.add({"place": np.stack([rows["x"], rows["y"]], axis=1)[good], "values": rows["values"][good]})
        facts = reader.facts
    seen = sample.read()
    if not seen or not len(seen["place"]):
        return
    drawn: list[Picture] = []
    for one, values in zip(facts, seen["values"].T, strict=True):
        values = values[np.isfinite(values)]
        if len(values):  # without far outliers
            low, high = robust_limits(values, float(values.min()), float(values.max()))
            room = 0.5 * (high == low) * max(abs(high), 1.0)
            counts, edges = np.histogram(values, BINS, (low - room, high + room))
            beyond = len(values) - int(counts.sum())
            drawn += draw_histogram(edges, counts, title=one.name, label=f"{one.name} [{one.unit}]", beyond=beyond)
    if drawn:
        yield Sheet("Columns of the cloud", drawn)
    # The density of the points, and the mean of each column that has values.
    places = seen["place"]
    box = (*places.min(axis=0).tolist(), *places.max(axis=0).tolist())
    grid = choose_grid(str(path), sample, box, None, fixed=False, most=MOST_CELLS)
    crs = describe_crs(path)
    row, column, inside = grid.place(*places.T)
    cell = (row * grid.columns + column)[inside]
    wanted = [("density", ColumnFacts("points", "-", "", 0.0), np.full(len(places), float(sample.step)))]
    wanted += [("mean", one, values) for one, values in zip(facts, seen["values"].T, strict=True)]
    note, maps = f"; every {sample.step}th point" if sample.step > 1 else "", []
    for statistic, one, values in wanted:
        size, area = grid.rows * grid.columns, grid.size**2 / sample.step
        found = compute_cells(statistic, cell, values[inside], size, area)
        if np.isfinite(found).any():
            found = found.reshape(grid.rows, grid.columns)
            shown = find_shown(found)
            maps += draw_map(Raster(one, (path.name,), Tally(), statistic, grid, found, 0, shown, crs), note)
    if maps:
        yield Sheet("Maps", maps)


def measure_view_residuals(block: WaveformBlock, chain: Chain, system: SystemPulse) -> np.ndarray:
    """Root mean square of each waveform's residual in standard deviations of the noise, f8 (n,); NaN without a model.

    Samples that are missing, or at the digitizer's limit, are left out.
    """
    solved = chain.solve(block, system)
    found = find_residual(solved.block, solved.noise, solved.system, chain.decomposer, solved.echoes)
    if found is None:
        return np.full(len(block), np.nan)
    fit, residual, used = found
    variance = solved.noise.std[:, None].astype(np.float64) ** 2 + solved.system.noise.gain * np.maximum(fit, 0)
    return np.sqrt((residual**2 / variance).sum(axis=1) / np.maximum(used.sum(axis=1), 1))


def draw_waveforms(path: Path, chain: Chain, system: SystemPulse, name: str, **reading: Any) -> Iterator[Sheet]:
    """Random waveforms of a strip, and the worst fits among a sample, as parts of a page; name: of the chain.

    reading: direction and headerless. Raises InputError if the strip cannot be read.
    """
    generator, searched = np.random.default_rng(0), 0
    kept: tuple[list[tuple[float, WaveformView]], ...] = ([], [])
    with StripReader(path, **reading) as reader, reader.scan() as scan:
        total = scan.packets
        for block in reader.sample_blocks(scan, min(SEARCHED, reader.sample_size(scan))):
            searched += len(block)
            residual = measure_view_residuals(block, chain, system)
            # The least keys of all blocks are kept; those of random numbers draw each waveform with the same chance.
            every = generator.random(len(block)), -residual
            for best, keys, most in zip(kept, every, (SHOWN_RANDOM, SHOWN_WORST), strict=True):
                rows = np.argsort(keys, kind="stable")[:most]
                rows = np.sort(rows[np.isfinite(keys[rows])])
                if len(rows):
                    views = build_views(block.rows(rows), chain, system, [-1] * len(rows))
                    best += zip(keys[rows].tolist(), views, strict=True)
                    best[:] = sorted(best, key=lambda pair: pair[0])[:most]
    drawn, worst = kept
    whole = f"all {searched:,} waveforms"
    part = f"{searched:,} waveforms that are spread over the strip ({total:,} in all)"
    head = (
        f"Drawn at random from {whole if searched >= total else part}. Chain: {name}. `wavebatch plot "
        "waveform STRIP --point N -o FILE.png` draws one of them large."
    )
    random = sorted((view for _, view in drawn), key=lambda view: view.point)
    yield Sheet("Random waveforms", [Note(head), *draw_sheet(random, "Random waveforms")])
    if worst:
        words = (
            f"The largest residuals among these {searched:,} waveforms, as root mean square in standard "
            "deviations of the noise (1 is noise alone)."
        )
        if searched < total:
            words += f" The other {total - searched:,} waveforms of the strip were not searched."
        notes = [f"residual {-key:.2f}" for key, _ in worst]
        yield Sheet("Worst fits", [Note(words), *draw_sheet([view for _, view in worst], "Worst fits", notes)])
