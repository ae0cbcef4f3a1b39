"""What `wavebatch bench --real` prints and writes: a text, a JSON document and a picture per strip."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavebatch.core.no_data import without_nan
from wavebatch.files.disk.publish import reporting
from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.files.text_file import write_text
from wavebatch.tools.bench.plot import can_plot
from wavebatch.tools.bench.real.agreement import Agreement
from wavebatch.tools.bench.real.measure import RealReport
from wavebatch.tools.bench.real.recall import APART, NEAR_SIGMAS, Calibration, Class
from wavebatch.tools.bench.report import align

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RATIOS = (0.9, 1.1)
"""Error / reported error that is right."""

MOST_FALSE = 1e-4
"""False echoes per ns of recording without signal that are too many."""

LEAST_SHOWN = 10
"""Injected echoes near others of which a share is printed."""

MOST_DIFFER, MOST_OFFSET, MOST_SCALE = 0.01, 0.02, 0.005
"""Packets with another count, time offset [ns] and change of amplitude at which surveys disagree."""


def format_report(report: RealReport) -> str:
    """All tables of a strip; `!` marks figures that miss their goal."""
    survey, noise, templates = report.survey, report.noise, report.templates
    correlation = " ".join(f"{value:.2f}" for value in noise.correlation) or "unknown"
    lines = [
        f"== {report.strip}: {report.waveforms} waveforms, {report.echoes} echoes, seed {report.seed}; ! misses a goal",
        f"survey: FWHM {survey.fwhm:.3f} ns, noise {survey.noise:.2f} DN, {survey.model}, acceptance "
        f"{survey.acceptance:g}, digitizers that record otherwise: {survey.digitizers}",
        f"quiet samples: noise {noise.std:.2f} DN ({noise.samples} samples), correlation {correlation}",
        f"templates: {templates.templates} of {templates.echoes} clear echoes, FWHM {templates.fwhm:.3f} ns; the chain "
        f"finds {templates.gain:.4f} of their amplitude and {templates.widened:.4f} of their width",
        "",
        *_recall_table("in quiet stretches, noise std", report.quiet_by_sigma),
        "",
        *_recall_table("in quiet stretches, DN", report.quiet_by_count),
        "",
        *_separation_table(report.near_by_separation),
        "",
        *_describe_splits(report),
        *_describe_false(report),
        "",
        *_calibration_table(report.calibration),
    ]
    if report.agreement:
        lines += ["", *_agreement_table(report.agreement)]
    return "\n".join(lines)


def _span(low: float, high: float) -> str:
    return f"{low:g}.." if math.isinf(high) else f"{low:g}-{high:g}"


def _share(row: Class) -> str:
    return f"{100 * row.recall:.1f}" if row.injected else "-"


def _recall_table(title: str, rows: Sequence[Class]) -> list[str]:
    return align([
        [title, *(_span(row.low, row.high) for row in rows)],
        ["injected", *(str(row.injected) for row in rows)],
        ["found %", *map(_share, rows)],
    ])  # fmt: skip


def _separation_table(rows: Sequence[Class]) -> list[str]:
    """A line per separation, before and after the strongest echo."""
    cells = {(row.low, row.apart): row for row in rows}
    spans = [_span(low, high) for low, high in zip(NEAR_SIGMAS, (*NEAR_SIGMAS[1:], math.inf), strict=True)]
    heads = [f"{side} {span}" for side in ("before", "after") for span in spans]
    lines = [["found % near the strongest echo, FWHM", *heads]]
    for near, far in zip(APART[:-1], APART[1:], strict=True):
        row = [_span(near, far)]
        for side in (-1.0, 1.0):
            row += [_share_of(cells.get((low, (side * near, side * far)))) for low in NEAR_SIGMAS]
        lines.append(row)
    return align(lines)


def _share_of(row: Class | None) -> str:
    return "-" if row is None or row.injected < LEAST_SHOWN else f"{100 * row.recall:.0f}"


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
                f"per ns{_mark(rate >= MOST_FALSE)}; with mirrored residuals {part.mirrored}"
            )
    return lines


def _mark(missed: bool) -> str:
    return "!" if missed else ""


def _calibration_table(rows: Sequence[Calibration]) -> list[str]:
    heads = ["time", "amplitude", "width", "bias ns", "DN", "ns", "scatter ns", "DN", "ns", "gross %"]
    lines = [["error / reported error, noise std", "echoes", *heads]]
    for row in rows:
        ratio = [f"{value:.3f}{_mark(not RATIOS[0] <= value <= RATIOS[1])}" for value in row.ratio]
        bias = [f"{value:+.3f}" for value in row.bias]
        scatter = [f"{value:.3f}" for value in row.scatter]
        name = f"{row.where} {_span(row.low, row.high)}"
        lines.append([name, str(row.echoes), *ratio, *bias, *scatter, f"{100 * row.gross:.2f}"])
    return align(lines)


def _agreement_table(rows: Sequence[Agreement]) -> list[str]:
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
            f"{100 * row.differ:.2f}{_mark(row.differ >= MOST_DIFFER)}",
            f"{row.offset:+.4f}{_mark(abs(row.offset) >= MOST_OFFSET)}",
            f"{row.apart:.4f}{_mark(row.apart >= MOST_OFFSET)}",
            f"{row.amplitude_ratio:.4f}{_mark(abs(row.amplitude_ratio - 1) >= MOST_SCALE)}",
            f"{row.width_ratio:.4f}",
        ])  # fmt: skip
    return align(lines)


def write_report(report: RealReport, folder: Path) -> str:
    """Writes real-STRIP.json, .txt and, with matplotlib, .png into a folder, replacing old ones; returns a line.

    Raises InputError where it cannot write.
    """
    stem = f"real-{Path(report.strip).stem}"
    with reporting(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / f"{stem}.json", to_text(report.to_json()) + "\n", overwrite=True)
        write_text(folder / f"{stem}.txt", format_report(report) + "\n", overwrite=True)
    names = [f"{stem}.json", f"{stem}.txt"]
    if not can_plot():
        return f"{folder}: {', '.join(names)}; no plot without matplotlib: pip install 'wavebatch[plot]'"
    draw_report(report, folder / f"{stem}.png")
    return f"{folder}: {', '.join([*names, f'{stem}.png'])}"


def to_text(document: Mapping[str, Any]) -> str:
    """JSON with sorted keys; null for what is no number."""
    return json.dumps(without_nan(document), indent=1, sort_keys=True, allow_nan=False)


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
    for low, high in zip(NEAR_SIGMAS, (*NEAR_SIGMAS[1:], math.inf), strict=True):
        part = [row for row in rows if row.low == low and row.injected >= LEAST_SHOWN]
        points = sorted((0.5 * sum(row.apart), 100 * row.recall) for row in part)
        axes.plot([x for x, _ in points], [y for _, y in points], "o-", markersize=3, label=_span(low, high))
    axes.set(xlabel="after the strongest echo [FWHM]", ylabel="found [%]", title="near it, by amplitude [noise std]")
    axes.set_ylim(-3, 103)
    axes.legend()
