"""The work-precision plot: error against time per waveform, the chains that nobody beats joined by a line."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.bench.pareto import find_front

PANELS = (
    ("wrong", 100.0, "echoes missed or false [%]"),
    ("rmse_all_cm", 1.0, "rms error of the range, all echoes [cm]"),
)


def can_plot() -> bool:
    """Whether matplotlib is installed (extra `plot`)."""
    return importlib.util.find_spec("matplotlib") is not None


def plot_scene(section: Mapping[str, Any], target: Path) -> None:
    """Writes the plot of one scene of a document as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{section['scene']}: error against run time, one core")
    for axes, (name, factor, label) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        _draw_panel(axes, section["rows"], name, factor, label)
    figure.savefig(target, dpi=120, format="png")


def _draw_panel(axes: Any, rows: list[Mapping[str, Any]], name: str, factor: float, label: str) -> None:
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
    axes.grid(alpha=0.3)
    if not known:
        return
    chains = np.array([row["kind"] == "chain" for row in known])
    front = find_front(np.where(chains[:, None], np.stack([time, value], axis=1), np.nan))
    order = np.flatnonzero(front)[np.argsort(time[front])]
    axes.plot(time[order], value[order], color="tab:red", zorder=1, label="Pareto front")
    for i, row in enumerate(known):
        marker = "o" if row["kind"] == "chain" else "s"
        color = "tab:red" if front[i] else "tab:gray"
        axes.errorbar(time[i], value[i], yerr=error[i], fmt=marker, color=color, capsize=2)
        label = " = ".join([row["name"], *filter(None, [twins.get(row["name"])])])
        axes.annotate(label, (time[i], value[i]), textcoords="offset points", xytext=(6, 5))
    axes.margins(x=0.25, y=0.15)
    axes.set_ylim(bottom=0)
    axes.legend()
