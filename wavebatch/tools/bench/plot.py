"""The plot of a benchmark: error against time per waveform, with the Pareto front of the chains as a line.

`report.write_outputs` calls `plot_scene` where matplotlib is installed. Labels are placed last, because their size on
paper is known only then.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.optional import advise_install
from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.tools.bench.figures import find_front
from wavebatch.tools.plots.draw_cloud import MARKERS, SERIES

NO_PLOT = f"no plot without matplotlib: {advise_install('matplotlib')}"

PANELS = (
    ("wrong", 100.0, "echoes missed or false [%]"),
    ("rmse_all_cm", 1.0, "rms error of the range, all echoes [cm]"),
)


def plot_scene(section: Mapping[str, Any], target: Path) -> None:
    """Writes the plot of one scene of a document as PNG, over an older one."""
    with open_picture(target, (11, 4.6), overwrite=True, dpi=120) as figure:
        figure.suptitle(plain_text(f"{section['scene']}: error against run time, one core"))
        panels = figure.subplots(1, len(PANELS))
        for axes, (name, factor, label) in zip(panels, PANELS, strict=True):
            _draw_panel(axes, section["rows"], name, factor, label)


def _draw_panel(axes: Any, rows: list[Mapping[str, Any]], name: str, factor: float, label: str) -> None:
    """Draws one error against time."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    twins = {row["same_as"]: row["name"] for row in rows if "same_as" in row}
    rows = [row for row in rows if "same_as" not in row]
    known = [row for row in rows if row["kernels"]["median"] and row["figures"][name]["value"] is not None]
    time = np.array([row["kernels"]["median"] for row in known])
    value = np.array([row["figures"][name]["value"] * factor for row in known])
    error = np.array([(row["figures"][name]["error"] or 0.0) * factor for row in known])
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("kernels: microseconds per waveform")
    axes.set_ylabel(label)
    if not known:
        return
    chains = np.array([row["kind"] == "chain" for row in known])
    front = find_front(np.where(chains[:, None], np.stack([time, value], axis=1), np.nan))
    order = np.flatnonzero(front)[np.argsort(time[front])]
    axes.plot(time[order], value[order], color="tab:red", zorder=1, label="Pareto front")
    for i, row in enumerate(known):
        names = " = ".join([row["name"], *filter(None, [twins.get(row["name"])])])
        marker, color = MARKERS[i // len(SERIES) % len(MARKERS)], SERIES[i % len(SERIES)]
        axes.errorbar(time[i], value[i], yerr=error[i], fmt=marker, color=color, capsize=2, label=names)
    axes.margins(x=0.25, y=0.15)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7.0)
