"""What `make bench-real` prints and writes: a text, a JSON document and a picture per strip."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from bench.real.agreement import MOST_DIFFER, MOST_OFFSET, MOST_SCALE, Agreement
from bench.real.measure import APART, NEAR_SIGMAS, Calibration, Class, RealReport, between

from wavebatch.core.no_data import without_nan
from wavebatch.files.figure_file import has_matplotlib, open_picture, plain_text
from wavebatch.tools.bench.command import NO_PLOT, align, write_texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RATIOS = (0.9, 1.1)
"""Error / reported error that is right."""

MOST_FALSE = 1e-4
"""False echoes per ns of recording without signal that are too many."""

LEAST_SHOWN = 10
"""Injected echoes near others from which on a share is printed."""


def format_report(report: RealReport) -> str:
    """All tables of a strip; `!` marks figures that miss their goal."""
    survey, noise, templates = report.survey, report.noise, report.templates
    correlation = " ".join(f"{value:.2f}" for value in noise.correlation) or "unknown"
    head = [
        f"== {report.title}: {report.waveforms} waveforms, {report.echoes} echoes, seed {report.seed}; ! misses a goal",
        f"survey: FWHM {survey.fwhm:.3f} ns, noise {survey.noise:.2f} DN, {survey.model}, acceptance "
        f"{survey.acceptance:g}, other digitizers: {survey.digitizers}",
        f"quiet samples: noise {noise.std:.2f} DN ({noise.samples} samples), correlation {correlation}",
    ]
    if templates is None:
        head.append("nothing injected: too few clear single echoes")
        return "\n\n".join(map("\n".join, (head, _describe_false(report), _agreement_table(report.agreement))))
    head.append(
        f"templates: {templates.templates} of {templates.echoes} clear echoes, FWHM {templates.fwhm:.3f} ns; the chain "
        f"finds {templates.gain:.4f} of their amplitude and {templates.widened:.4f} of their width"
    )
    near = report.near_by_separation
    parts = [
        head,
        _recall_table("in quiet stretches, noise std", report.quiet_by_sigma),
        _recall_table("in quiet stretches, DN", report.quiet_by_count),
        _separation_table("found %", near, lambda row: f"{100 * row.recall:.0f}"),
        _separation_table("further echoes %", near, lambda row: f"{100 * row.extra / row.injected:.0f}"),
        _separation_table("time error / reported", near, lambda row: f"{row.ratio[0]:.2f}" if row.found else "-"),
        [*_describe_splits(report), *_describe_false(report)],
        _calibration_table(report.calibration),
        _agreement_table(report.agreement),
    ]
    return "\n\n".join(map("\n".join, parts))


def _span(low: float, high: float) -> str:
    return f"{low:g}.." if math.isinf(high) else f"{low:g}-{high:g}"


def _recall_table(title: str, rows: Sequence[Class]) -> list[str]:
    return align([
        [title, *(_span(row.low, row.high) for row in rows)],
        ["injected", *(str(row.injected) for row in rows)],
        ["found %", *(f"{100 * row.recall:.1f}" for row in rows)],
    ])  # fmt: skip


def _separation_table(title: str, rows: Sequence[Class], show: Callable[[Class], str]) -> list[str]:
    """A figure of each class: a line per separation, before and after the strongest echo."""
    cells = {(row.low, row.apart): row for row in rows}
    spans = [_span(low, high) for low, high in between(NEAR_SIGMAS)]
    heads = [f"{side} {span}" for side in ("before", "after") for span in spans]
    lines = [[f"{title} near the strongest echo, FWHM", *heads]]
    for near, far in pairwise(APART):
        row = [cells[low, (side * near, side * far)] for side in (-1.0, 1.0) for low in NEAR_SIGMAS]
        lines.append([_span(near, far), *(show(one) if one.injected >= LEAST_SHOWN else "-" for one in row)])
    return align(lines)


def _describe_splits(report: RealReport) -> list[str]:
    lines = []
    for name, row in (("strong echoes in quiet stretches", report.split), ("clipped ones", report.clipped)):
        if row is not None:
            lines.append(
                f"{name} (from {row.low:g} noise std): {row.injected} injected, {row.found} found, "
                f"{row.extra} more echoes appeared ({100 * row.extra / row.injected:.2f} %)"
            )
    return lines


def _describe_false(report: RealReport) -> list[str]:
    false = report.false_echoes
    mirrored = false.mirrored_near + false.mirrored_far
    lines = [
        f"false echoes by mirrored residuals: {mirrored} ({false.mirrored_near} near others, {false.mirrored_far} far) "
        f"against {false.echoes} found: correctness {100 * false.correctness:.2f} %, "
        f"{mirrored / false.recording:.1e} per ns of recording"
    ]
    for name, part in (("before", false.before), ("after", false.after)):
        if part.length > 0:
            rate = part.echoes / part.length
            lines.append(
                f"signal-free stretches {name} all signal: {part.echoes} echoes in {part.length:.0f} ns, {rate:.1e} "
                f"per ns{'!' * (rate >= MOST_FALSE)}; with mirrored residuals {part.mirrored}"
            )
    return lines


def _calibration_table(rows: Sequence[Calibration]) -> list[str]:
    heads = ["time", "amplitude", "width", "bias ns", "DN", "ns", "scatter ns", "DN", "ns", "gross %"]
    lines = [["error / reported error, noise std", "echoes", *heads]]
    for row in rows:
        ratio = [f"{value:.3f}{'!' * (not RATIOS[0] <= value <= RATIOS[1])}" for value in row.ratio]
        bias = [f"{value:+.3f}" for value in row.bias]
        scatter = [f"{value:.3f}" for value in row.scatter]
        name = f"{row.where} {_span(row.low, row.high)}"
        lines.append([name, str(row.echoes), *ratio, *bias, *scatter, f"{100 * row.gross:.2f}"])
    return align(lines)


def _agreement_table(rows: Sequence[Agreement]) -> list[str]:
    """A line per pair of surveys."""
    heads = ["waveforms", "FWHM ns", "noise DN", "model", "other count %", "dt ns", "|dt| ns", "amplitude", "width"]
    lines = [["surveys of parts", *heads]]
    for row in rows:
        one, other = row.surveys
        lines.append([
            row.parts,
            f"{one.waveforms}/{other.waveforms}",
            f"{one.fwhm:.3f}/{other.fwhm:.3f}",
            f"{one.noise:.2f}/{other.noise:.2f}",
            one.model if one.model == other.model else f"{one.model}/{other.model}",
            f"{100 * row.differ:.2f}{'!' * (row.differ >= MOST_DIFFER)}",
            f"{row.offset:+.4f}{'!' * (abs(row.offset) >= MOST_OFFSET)}",
            f"{row.apart:.4f}{'!' * (row.apart >= MOST_OFFSET)}",
            f"{row.amplitude_ratio:.4f}{'!' * (abs(row.amplitude_ratio - 1) >= MOST_SCALE)}",
            f"{row.width_ratio:.4f}",
        ])  # fmt: skip
    return align(lines)


def write_report(report: RealReport, folder: Path) -> str:
    """Writes real-STRIP.json, .txt and, with matplotlib, .png into a folder, replacing old ones; returns a line.

    Raises InputError where it cannot write.
    """
    stem = f"real-{Path(report.strip).stem}{'-left-out' if report.left_out else ''}"
    document = json.dumps(without_nan(asdict(report)), indent=1, sort_keys=True, allow_nan=False)
    written = write_texts(folder, {f"{stem}.json": document, f"{stem}.txt": format_report(report)})
    if report.templates is None:
        return written
    if not has_matplotlib():
        return f"{written}; {NO_PLOT}"
    draw_report(report, folder / f"{stem}.png")
    return f"{written}, {stem}.png"


def draw_report(report: RealReport, target: Path) -> None:
    """Recall by amplitude and by separation, and the reported errors, as a picture; replaces an old one."""
    with open_picture(target, (12.0, 4.0), overwrite=True) as figure:
        figure.suptitle(f"{plain_text(report.strip)}   injected echoes", x=0.01, ha="left", fontsize=11, weight="bold")
        amplitude, separation, errors = figure.subplots(1, 3)
        rows = report.quiet_by_sigma
        _name_classes(amplitude, rows)
        amplitude.plot([100 * row.recall for row in rows], "o-")
        amplitude.set(ylim=(-3, 103), ylabel="found [%]", title="in quiet stretches")
        _draw_separations(separation, report.near_by_separation)
        quiet = [row for row in report.calibration if row.where == "quiet"][:-1]
        _name_classes(errors, quiet)
        for place, name in enumerate(("time", "amplitude", "width")):
            errors.plot([row.ratio[place] for row in quiet], "o-", label=name)
        errors.axhspan(*RATIOS, color="#e6e6e6", zorder=0)
        errors.set(ylim=(0, None), title="error / reported error (grey: right)")
        errors.legend()


def _name_classes(axes: Axes, rows: Sequence[Class | Calibration]) -> None:
    """A tick per class of amplitude."""
    axes.set_xticks(range(len(rows)), [_span(row.low, row.high) for row in rows], fontsize=7)
    axes.set_xlabel("amplitude [noise std]")


def _draw_separations(axes: Axes, rows: Sequence[Class]) -> None:
    for low, high in between(NEAR_SIGMAS):
        part = [row for row in rows if row.low == low and row.injected >= LEAST_SHOWN]
        points = sorted((0.5 * sum(row.apart), 100 * row.recall) for row in part)
        axes.plot([x for x, _ in points], [y for _, y in points], "o-", markersize=3, label=_span(low, high))
    axes.set(xlabel="after the strongest echo [FWHM]", ylabel="found [%]", title="near it, by amplitude [noise std]")
    axes.set_ylim(-3, 103)
    axes.legend()
