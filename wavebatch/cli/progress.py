"""What a run tells while it goes: a bar on a terminal, JSON lines on request, lines about strips on stderr."""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.common import one_line, printable
from wavebatch.core.no_data import REASONS, NoData

KINDS = ("auto", "bar", "json", "none")


def counting(unit: str, quiet: bool, total: int | None = None) -> Any:
    """A bar that counts up to `total`, on a terminal and unless `quiet`; a context manager with `update(number)`."""
    from tqdm import tqdm

    return tqdm(total=total, unit=f" {unit}", disable=quiet or not sys.stderr.isatty(), leave=False)


class Progress:
    """Takes the events of a batch. kind: one of KINDS; auto is a bar where stderr is a terminal.

    level: -1 tells errors only, 0 also what was written, 1 also where the points went.
    """

    def __init__(self, strips: Iterable[Path], kind: str, level: int, debug: bool) -> None:
        if kind == "auto":
            kind = "bar" if sys.stderr.isatty() and level >= 0 else "none"
        self._json = kind == "json"
        self._level = level
        self._debug = debug
        self._sizes = {str(path): _size(path) for path in strips}
        self._shown: dict[str, int] = {}
        self._bar = None
        if kind == "bar":
            from tqdm import tqdm

            total = sum(self._sizes.values())
            self._bar = tqdm(total=total, unit="B", unit_scale=True, file=sys.stderr, dynamic_ncols=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def tell(self, event: dict[str, Any]) -> None:
        """Shows one event of `run_batch`."""
        error = event.get("error")
        if self._json:
            plain = event if error is None else {**event, "error": one_line(error)}
            click.echo(json.dumps(plain, sort_keys=True, ensure_ascii=False))
        kind, strip = event["event"], event["strip"]
        if self._bar is not None:
            share = event["done"] / event["of"] if kind == "unit" else float(kind != "start")
            self._advance(strip, share)
        if error is not None and not event["again"]:
            if self._debug:
                self._say("".join(traceback.format_exception(error)).rstrip())
            self._say(f"error: {_place(printable(strip), one_line(error))}")
        elif kind == "written" and self._level >= 0:
            self._say(printable(_summary(event, self._level > 0)))
            warnings = [f"warning: {line}" for line in event["warnings"]]
            more = [*_tell_sensor(event["sensor"]), *_reasons(event["counts"]["no_data"])] * (self._level > 0)
            for line in [*warnings, *more, *event["remarks"]]:
                self._say(printable(f"{strip}: {line}"))
        elif kind == "skipped" and self._level >= 0:
            self._say(printable(f"{strip}: is there already"))

    def _advance(self, strip: str, share: float) -> None:
        done = round(self._sizes.get(strip, 0) * share)
        self._bar.set_description(Path(strip).name, refresh=False)
        self._bar.update(max(done - self._shown.get(strip, 0), 0))
        self._shown[strip] = done

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.clear()
        click.echo(line, err=True)
        if self._bar is not None:
            self._bar.refresh()


def _size(path: Path) -> int:
    try:
        return os.path.getsize(path)
    except OSError:
        return 0


def _place(strip: str, line: str) -> str:
    """The line with the strip in front, unless it names it already."""
    return line if strip in line else f"{strip}: {line}"


def _tell_sensor(sensor: dict[str, Any]) -> Iterator[str]:
    """Where the sensor was, and how one knows."""
    words = {
        "distance_m": "{:.0f} m away",
        "height_m": "{:.0f} m above the points",
        "speed_m_s": "{:.1f} m/s",
        "heading_deg": "heading {:.0f} degrees",
        "smoothness_m": "smooth to {:.3f} m",
        "range_error_m": "ranges to {:.3f} m",
    }
    told = [text.format(sensor[key]) for key, text in words.items() if sensor.get(key) is not None]
    if told:
        yield f"sensor from {sensor['source']}: {', '.join(told)}"


def _reasons(no_data: dict[str, dict[str, int]]) -> Iterator[str]:
    """Per column how many echoes lack a value, one line for each reason."""
    for column, counts in sorted(no_data.items()):
        total = sum(counts.values())
        for name, number in counts.items():
            if name != NoData.KNOWN.name:
                yield f"{column}: no-data for {number} of {total} echoes: {REASONS[NoData[name]][0]}"


def _summary(event: dict[str, Any], long: bool) -> str:
    counts = event["counts"]
    passed = sum(counts["passed_through"].values())
    line = (
        f"{event['strip']}: {counts['points_in']} points, {counts['waveforms']} waveforms, {counts['echoes']} echoes, "
        f"{passed} passed through -> {counts['points_out']} points"
    )
    if not long:
        return line
    reasons = ", ".join(f"{name} {number}" for name, number in counts["passed_through"].items() if number)
    flags = ", ".join(f"{name} {number}" for name, number in counts["flags"].items() if number)
    return (
        f"{line}; returns matched {counts['matched_returns']}, unmatched {counts['unmatched_returns']}, echoes added "
        f"{counts['added_echoes']}; passed through: {reasons or 'none'}; flags: {flags or 'none'}"
    )
