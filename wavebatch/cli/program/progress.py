"""What `wavebatch run` shows while it works: a bar, JSON lines on stdout, or a line per strip on stderr.

`cli/run.py` gives `Progress.show` to the batch, which calls it with each event.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from wavebatch.cli.messages import log_text, one_line, print_safely, printable, write_message
from wavebatch.core.errors import StripWarning
from wavebatch.core.units import count


class Progress:
    """Shows the events of a batch.

    kind: `bar`, `json`, `none`, or `auto`: a bar if stderr is a terminal. level: -1 shows errors only, 0 also a line
    per strip, 1 also how its points were processed.
    """

    def __init__(self, strips: Iterable[Path], kind: str, level: int, debug: bool) -> None:
        if kind == "auto":
            kind = "bar" if sys.stderr.isatty() and level >= 0 else "none"
        self._json = kind == "json"
        self.is_written = True
        """Whether all events could be written to stdout."""
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

    def show(self, event: dict[str, Any]) -> None:
        """Shows one event of `run_batch`."""
        error = event.get("error")
        if self._json:
            plain = event if error is None else {**event, "error": one_line(error)}
            self._json = self.is_written = print_safely(json.dumps(plain, sort_keys=True, ensure_ascii=False))
        kind, strip = event["event"], event["strip"]
        if self._bar is not None:
            share = event["done"] / event["of"] if kind == "unit" else float(kind != "start")
            self._advance(strip, share)
        if error is not None and not event["again"]:
            if self._debug:
                self._say("".join(traceback.format_exception(error)).rstrip())
            self._say(f"error: {_place(printable(strip), one_line(error))}")
        elif kind == "incomplete" and "decisions" not in event:
            cut = count(event["counts"]["points_cut"], "point")
            remedy = "get its waveform data again, whole"
            self._say(printable(f"{strip}: is incomplete as before: the packets of {cut} are missing; {remedy}"))
        elif kind in ("written", "incomplete"):
            self._tell(_summary(event, self._level > 0))
            for one in event["warnings"]:
                say = self._say if StripWarning(**one).is_loud else self._tell
                say(printable(f"{strip}: warning: {one['text']}"))
            chosen = [f"{one['part']}: {'kept' if one['needed'] else 'left out'}: {one['reason']}"
                      for one in event["decisions"]]  # fmt: skip
            more = [*chosen, *_sensor_lines(event["sensor"]), *_reasons(event["counts"]["no_data"])]
            for line in [*more * (self._level > 0), *event["remarks"]]:
                self._tell(f"{strip}: {line}")
        elif kind == "skipped":
            self._tell(f"{strip}: is up to date, skipped")
        elif kind == "flight" and self._level > 0:
            self._say(printable(f"{strip}: survey of {count(event['strips'], 'strip')} together"))

    def _advance(self, strip: str, share: float) -> None:
        done = round(self._sizes.get(strip, 0) * share)
        self._bar.set_description(Path(strip).name, refresh=False)
        self._bar.update(max(done - self._shown.get(strip, 0), 0))
        self._shown[strip] = done

    def _tell(self, line: str) -> None:
        """A message that --quiet leaves to the log."""
        if self._level >= 0:
            self._say(printable(line))
        else:
            log_text(printable(line))

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.clear()
        write_message(line)
        log_text(line)
        if self._bar is not None:
            self._bar.refresh()


def _size(path: Path) -> int:
    try:
        return os.path.getsize(path)
    except (OSError, ValueError):
        return 0


def _place(strip: str, line: str) -> str:
    """The line with the strip's name first, unless it contains the name already."""
    return line if strip in line else f"{strip}: {line}"


def _sensor_lines(sensor: dict[str, Any]) -> Iterator[str]:
    """The sensor's position and how exactly returns were placed, with their sources."""
    words = {
        "distance_m": "{:.0f} m away",
        "height_m": "{:.0f} m above the points",
        "speed_m_s": "{:.1f} m/s",
        "heading_deg": "heading {:.0f} degrees",
        "smoothness_m": "smooth to {:.3f} m",
        "range_error_m": "ranges to {:.3f} m",
    }
    parts = [text.format(sensor[key]) for key, text in words.items() if sensor.get(key) is not None]
    if parts:
        yield f"sensor from {sensor['source']}: {', '.join(parts)}"
    if returns := sensor.get("returns"):
        yield (
            f"returns were placed to {returns['scatter_m']:.3f} m, by {returns['from']}; an echo without a return is "
            f"off by {returns['phase_m']:.3f} m"
        )


def _reasons(no_data: dict[str, dict[str, int]]) -> Iterator[str]:
    """For each column and reason: how many echoes have no value."""
    from wavebatch.core.no_data import REASONS, NoData

    for column, counts in sorted(no_data.items()):
        total = sum(counts.values())
        for name, number in counts.items():
            if name != NoData.KNOWN.name:
                yield f"{column}: no-data for {number} of {total} echoes: {REASONS[NoData[name]][0]}"


_COUNTED = {"points_in": "point", "waveforms": "waveform", "echoes": "echo"}


def _summary(event: dict[str, Any], long: bool) -> str:
    counts = event["counts"]
    passed = sum(counts["passed_through"].values())
    parts = [count(counts[key], name) for key, name in _COUNTED.items()]
    line = f"{event['strip']}: {', '.join(parts)}, {passed} passed through -> {count(counts['points_out'], 'point')}"
    left = {name: number for name, number in counts["left_out"].items() if number}
    if left:
        by = ", ".join(f"{number} by --{name.replace('_', '-')}" for name, number in left.items())
        line = f"{line}; left out: {by}"
    if not long:
        return line
    reasons, flags = (
        ", ".join(f"{name} {number}" for name, number in counts[key].items() if number) or "none"
        for key in ("passed_through", "flags")
    )
    return (
        f"{line}; returns matched {counts['matched_returns']}, unmatched {counts['unmatched_returns']}, echoes added "
        f"{counts['added_echoes']}; passed through: {reasons}; flags: {flags}"
    )
