"""What each release promises (PRODUCT.md and the issues), beside what was measured."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from wavebatch.stages.chain_file import load_profile
from wavebatch.tools.bench.report import align
from wavebatch.tools.bench.scenes import find_bench_scene
from wavebatch.tools.bench.speed import make_strip, measure_memory, time_jobs, time_start

Document = Mapping[str, Any]


def measure_system(
    seed: int, *, pulses: int, large: bool, progress: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Start-up, memory over the length of a strip, and speed over jobs, as plain values.

    pulses: of the strip for memory; that for jobs is five times as long.
    large: also measure memory with 100 times as many.
    """
    chain, scene = load_profile("accurate"), find_bench_scene("open")
    progress("timing wavebatch --help")
    told: dict[str, Any] = {"start_seconds": time_start(), "memory": [], "jobs": {}}
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as name:
        folder = Path(name)
        for number in (pulses, 100 * pulses) if large else (pulses,):
            progress(f"memory with {number} pulses")
            strip = make_strip(scene, folder / "memory.laz", number, seed)
            peak, waveforms = measure_memory(chain, strip, folder / "memory")
            told["memory"].append({"waveforms": waveforms, "peak_bytes": peak})
        progress("speed with 1 and 2 jobs")
        strip = make_strip(scene, folder / "jobs.laz", 5 * pulses, seed)
        times = time_jobs(chain, strip, folder / "jobs", (1, 2), 2)
        told["jobs"] = {str(number): seconds for number, seconds in times.items()}
    return told


def judge(document: Document) -> list[dict[str, Any]]:
    """A row per promise that the document can be held to: what, measured, promised, unit, met."""
    rows: list[dict[str, Any]] = []
    for section in document["scenes"]:
        _judge_scene(rows, section)
    _judge_stability(rows, document.get("stability", []))
    if "system" in document:
        _judge_system(rows, document["system"])
    return rows


SPEEDS = {
    "mixed": {"main": ("kernels", 70_000), "balanced": ("kernels", 120_000)},
    "open": {"main": ("file", 100_000)},
    "forest": {"main": ("file", 25_000)},
    "empty": {"main": ("kernels", 250_000)},
}
"""Least waveforms per second by scene and chain."""

SHARES = {
    "main": {"exact_count": 94.0, "completeness": 94.5, "correctness": 98.3},
    "balanced": {"exact_count": 82.0, "completeness": 85.4, "correctness": 95.8},
}
"""Least shares on the mixed scene [%]."""


def _add(rows: list[dict[str, Any]], what: str, value: float | None, limit: float, unit: str, most: bool) -> None:
    if value is not None:
        met = value <= limit if most else value >= limit
        rows.append(
            {"what": what, "measured": value, "promised": limit, "at_most": most, "unit": unit, "met": bool(met)}
        )


def _judge_scene(rows: list[dict[str, Any]], section: Mapping[str, Any]) -> None:
    chains = {row["name"]: row for row in section["rows"]}
    scene, main = section["scene"], "auto" if "auto" in chains else "accurate"
    for role, (kind, limit) in SPEEDS.get(scene, {}).items():
        row = chains[main if role == "main" else role]
        _add(rows, f"{scene}: {row['name']}, {_KINDS[kind]}", _rate(row, kind), limit, "waveforms/s", False)
    if scene == "mixed":
        _add(rows, "mixed: balanced, file to file", _rate(chains["balanced"], "file"), 60_000, "waveforms/s", False)
        for role, shares in SHARES.items():
            row = chains[main if role == "main" else role]
            for name, limit in shares.items():
                _add(rows, f"mixed: {row['name']}, {name}", _percent(row, name), limit, "%", False)
        _judge_peer(rows, chains, chains[main])
    ratio = chains[main]["figures"]["time_ratio_isolated"]["value"]
    _add(rows, f"{scene}: {main}, isolated, time error / bound", ratio, 1.05, "", True)
    _add(rows, f"{scene}: {main}, false splits", _percent(chains[main], "false_splits"), 2.0, "%", True)


_KINDS = {"kernels": "kernels", "file": "file to file"}


def _rate(row: Mapping[str, Any], kind: str) -> float | None:
    return 1e6 / row[kind]["median"] if row[kind]["median"] else None


def _percent(row: Mapping[str, Any], name: str) -> float | None:
    value = row["figures"][name]["value"]
    return None if value is None else 100 * value


def _judge_peer(rows: list[dict[str, Any]], chains: Mapping[str, Any], main: Mapping[str, Any]) -> None:
    peer = chains.get("gdecomp")
    if peer is None:
        return
    faster = (_rate(main, "kernels") or 0.0) / (_rate(peer, "kernels") or 1.0)
    _add(rows, f"mixed: {main['name']} is faster than gdecomp", faster, 10.0, "times", False)
    for name in ("completeness", "correctness"):
        what = f"mixed: {main['name']}, {name} against gdecomp's"
        _add(rows, what, _percent(main, name), _percent(peer, name) or 0.0, "%", False)


STABLE = {
    "pair 1.5 s apart, SNR 50": ("exact_count", 85.0, False),
    "skew 0.1, SNR 100": ("false_splits", 2.0, True),
    "skew 0.15, SNR 100": ("false_splits", 2.0, True),
    "ringing 1%": ("false_splits", 2.0, True),
    "ringing 2%": ("false_splits", 2.0, True),
    "ringing 3%": ("false_splits", 2.0, True),
    "noise of rho 0.67": ("false_splits", 0.5, True),
}
"""Shares that are promised by stiff case [%]: figure, limit, whether it is the most."""


def _judge_stability(rows: list[dict[str, Any]], cases: list[Mapping[str, Any]]) -> None:
    for row in cases:
        if row["is_auto"] and row["case"] in STABLE:
            figure, limit, most = STABLE[row["case"]]
            _add(rows, f"{row['hazard']} {row['case']}: auto, {figure}", _percent(row, figure), limit, "%", most)
    if cases:
        failures = sum(sum(row["failures"].values()) for row in cases)
        _add(rows, "stiff cases: failures of all chains", failures, 0, "", True)


def _judge_system(rows: list[dict[str, Any]], system: Mapping[str, Any]) -> None:
    _add(rows, "start-up of wavebatch --help", system["start_seconds"]["median"], 0.3, "s", True)
    peaks = [entry["peak_bytes"] for entry in system["memory"]]
    for entry, peak in zip(system["memory"], peaks, strict=True):
        megabytes = None if peak is None else peak / 1e6
        _add(rows, f"peak memory with {entry['waveforms']} waveforms", megabytes, 500.0, "MB", True)
    if len(peaks) > 1 and None not in peaks:
        _add(rows, "memory of the long strip over the short", peaks[-1] / peaks[0], 1.1, "times", True)
    one, two = system["jobs"]["1"]["median"], system["jobs"]["2"]["median"]
    _add(rows, "open: speed with 2 jobs over 1", one / two, 1.7, "times", False)


def format_promises(rows: list[dict[str, Any]]) -> str:
    """The promises as a table, each met or short."""
    lines = [["== promised", "measured", "promise", "", ""]]
    for row in rows:
        sign = "<=" if row["at_most"] else ">="
        verdict = "met" if row["met"] else "short"
        lines.append(
            [row["what"], _number(row["measured"]), f"{sign} {_number(row['promised'])}", row["unit"], verdict]
        )
    return "\n".join(align(lines))


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
