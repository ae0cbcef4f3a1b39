"""The figures that each release promises, compared with those of a benchmark document.

`release` calls `judge` and prints `format_promises`. The limits stand in the tables SPEEDS, SHARES
and STABLE, and in `_scene_promises` and `_system_promises` where they hold for all scenes or chains.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any

from bench.stability_tables import align

Row = Mapping[str, Any]

MAIN = "main"
"""Stands for the chain `auto`, or `accurate` where `auto` was found to equal it."""

SPEEDS = (
    ("mixed", MAIN, "kernels", 70_000),
    ("mixed", "balanced", "kernels", 120_000),
    ("mixed", "balanced", "file", 60_000),
    ("open", MAIN, "file", 100_000),
    ("forest", MAIN, "file", 25_000),
    ("empty", MAIN, "kernels", 250_000),
)
"""Scene, chain, what is timed, least waveforms per second."""

SHARES = {
    MAIN: {"exact_count": 94.0, "completeness": 94.5, "correctness": 98.3},
    "balanced": {"exact_count": 82.0, "completeness": 85.4, "correctness": 95.8},
}
"""Least shares on the mixed scene [%]."""

STABLE = {
    "pair 1.5 s apart, SNR 50": ("exact_count", 85.0, False),
    "skew 0.1, SNR 100": ("false_splits", 2.0, True),
    "skew 0.15, SNR 100": ("false_splits", 2.0, True),
    "ringing 1%": ("false_splits", 2.0, True),
    "ringing 2%": ("false_splits", 2.0, True),
    "ringing 3%": ("false_splits", 2.0, True),
    "noise of rho 0.67": ("false_splits", 0.5, True),
}
"""Stiff cases: figure, limit [%], whether the limit is the largest allowed value."""


@dataclass(frozen=True, slots=True)
class Promise:
    """A promised limit and the measured figure."""

    what: str
    measured: float | None
    """None where the benchmark did not measure it; such promises are left out."""
    promised: float
    at_most: bool = False
    """The limit is the largest allowed value, else the least."""
    unit: str = ""

    @property
    def met(self) -> bool:
        """Whether the measured figure is within the limit."""
        return bool(self.measured <= self.promised if self.at_most else self.measured >= self.promised)


def judge(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row per promise that the document has a figure for: what, measured, promised, at_most, unit, met."""
    promises = chain(
        chain.from_iterable(_scene_promises(section) for section in document["scenes"]),
        _case_promises(document.get("stability", ())),
        _system_promises(document["system"]) if "system" in document else (),
    )
    return [{**asdict(promise), "met": promise.met} for promise in promises if promise.measured is not None]


def _scene_promises(section: Mapping[str, Any]) -> Iterator[Promise]:
    rows = {row["name"]: row for row in section["rows"]}
    scene, main = section["scene"], rows.get("auto") or rows["accurate"]
    rows[MAIN] = main
    for place, role, kind, limit in SPEEDS:
        if place == scene:
            timed = "file to file" if kind == "file" else kind
            what = f"{scene}: {rows[role]['name']}, {timed}"
            yield Promise(what, _rate(rows[role], kind), limit, unit="waveforms/s")
    if scene == "mixed":
        for role, shares in SHARES.items():
            for name, limit in shares.items():
                yield Promise(f"mixed: {rows[role]['name']}, {name}", _percent(rows[role], name), limit, unit="%")
        if "gdecomp" in rows:
            yield from _peer_promises(main, rows["gdecomp"])
    ratio = main["figures"]["time_ratio_isolated"]["value"]
    yield Promise(f"{scene}: {main['name']}, isolated, time error / bound", ratio, 1.05, at_most=True)
    splits = _percent(main, "false_splits")
    yield Promise(f"{scene}: {main['name']}, false splits", splits, 2.0, at_most=True, unit="%")


def _peer_promises(main: Row, peer: Row) -> Iterator[Promise]:
    faster = (_rate(main, "kernels") or 0.0) / (_rate(peer, "kernels") or 1.0)
    yield Promise(f"mixed: {main['name']} is faster than gdecomp", faster, 10.0, unit="times")
    for name in ("completeness", "correctness"):
        what = f"mixed: {main['name']}, {name} against gdecomp's"
        yield Promise(what, _percent(main, name), _percent(peer, name) or 0.0, unit="%")


def _case_promises(cases: Sequence[Row]) -> Iterator[Promise]:
    for row in cases:
        if row["is_auto"] and row["case"] in STABLE:
            figure, limit, at_most = STABLE[row["case"]]
            what = f"{row['hazard']} {row['case']}: auto, {figure}"
            yield Promise(what, _percent(row, figure), limit, at_most, "%")
    if cases:
        failures = sum(sum(row["failures"].values()) for row in cases)
        yield Promise("stiff cases: failures of all chains", failures, 0, at_most=True)


def _system_promises(system: Mapping[str, Any]) -> Iterator[Promise]:
    yield Promise("start-up of wavebatch --help", system["start_seconds"]["median"], 0.3, True, "s")
    peaks = [entry["peak_bytes"] for entry in system["memory"]]
    for entry, peak in zip(system["memory"], peaks, strict=True):
        megabytes = None if peak is None else peak / 1e6
        yield Promise(f"peak memory with {entry['waveforms']} waveforms", megabytes, 500.0, True, "MB")
    if len(peaks) > 1 and None not in peaks:
        yield Promise("memory of the long strip over the short", peaks[-1] / peaks[0], 1.1, True, "times")
    one, two = system["jobs"]["1"]["median"], system["jobs"]["2"]["median"]
    yield Promise("open: speed with 2 jobs over 1", one / two, 1.7, unit="times")


def _rate(row: Row, kind: str) -> float | None:
    """Waveforms per second; None where they were not timed."""
    return 1e6 / row[kind]["median"] if row[kind]["median"] else None


def _percent(row: Row, name: str) -> float | None:
    value = row["figures"][name]["value"]
    return None if value is None else 100 * value


def format_promises(rows: Sequence[Row]) -> str:
    """The promises as a table, each met or short."""
    lines = [["== promised", "measured", "promise", "", ""]]
    for row in rows:
        limit = f"{'<=' if row['at_most'] else '>='} {_number(row['promised'])}"
        lines.append([row["what"], _number(row["measured"]), limit, row["unit"], "met" if row["met"] else "short"])
    return "\n".join(align(lines))


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
