"""Judges a survey on strips of sensors that do not exist: `python tests/judging/strangers.py --help`.

Only the public API is used: `open_strip`, `survey`, `auto_chain`, `Chain.run` and `run`; any checkout can be judged
(`--root`). Strips 0-299 are for developers, 1000-1299 for the end: nobody chooses a constant by them.
A strip is right where 97 % of its clear echoes are found and at most 3 % of the found echoes are extra.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from checkouts import FWHM_PER_SIGMA, find_doubts, find_echoes, format_table, judge_seeds, timed, verdict
from stranger_strips import draw_sensor, make_shape, make_strip

CLEAR = 8.0
"""Errors of its amplitude from which an echo is clear, where it stands alone."""
APART = 1.5
"""Distance to every neighbour, in widths of the wider one, from which it is clear."""
SIDE = 0.01
"""Share of a neighbour's side that no pulse model explains, beside what changes from shot to shot ..."""
SURE = 3.0
"""... and how many times as high an echo must be there."""
FOUND = 0.5
"""Distance [widths] up to which a found echo is a true one."""
ONE = 0.7
"""True echoes closer than this [widths] may be found as one, so that far from them."""
MOST_MISSED, MOST_EXTRA = 0.03, 0.03


def find_clear(sensor: Any, truth: dict[str, np.ndarray]) -> np.ndarray:
    """Which true echoes any sound decomposition finds."""
    packet, time, width = truth["packet"], truth["time"] / sensor.fwhm, truth["fwhm"] / sensor.fwhm
    lag, height, _ = make_shape(sensor)
    # What may be left of a strong echo at a distance: the highest of its side within half a width.
    side = np.max([np.interp(lag + shift, lag, height[10]) for shift in np.linspace(-0.5, 0.5, 9)], axis=0)
    hidden, clear = np.zeros(len(time)), (truth["snr"] >= CLEAR) & ~truth["clipped"]
    edge = sensor.samples / sensor.fwhm
    clear &= (time > width) & (time < edge - width)
    for step in range(1, 9):
        for one, other in ((slice(step, None), slice(None, -step)), (slice(None, -step), slice(step, None))):
            same = packet[one] == packet[other]
            away = time[one] - time[other]
            clear[one] &= ~(same & (np.abs(away) < APART * np.maximum(width[one], width[other])))
            rest = truth["amplitude"][other] * (SIDE + sensor.width_change)
            hidden[one] = np.maximum(hidden[one], same * rest * np.interp(away, lag, side, 0, 0))
    error = truth["amplitude"] / np.maximum(truth["snr"], 1e-9)
    return clear & (truth["amplitude"] >= CLEAR * error + SURE * hidden)


def match(truth: dict[str, np.ndarray], found: dict[str, np.ndarray], fwhm: float) -> tuple[np.ndarray, np.ndarray]:
    """Nearest found echo of every true one (-1: none within FOUND), and which found echoes are extra.

    Among true echoes closer than ONE as many may be found as there are, or fewer.
    """
    scale = 1e4 * fwhm * max(truth["time"].max(initial=1), found["time"].max(initial=1))
    true_at, found_at = (one["packet"] * scale + one["time"] for one in (truth, found))
    nearest = _find_nearest(true_at, found_at)
    if not len(found_at) or not len(true_at):
        return np.full(len(true_at), -1), np.ones(len(found_at), bool)
    far = np.abs(found_at[nearest] - true_at) > FOUND * truth["fwhm"]
    group = np.r_[0, np.cumsum(np.diff(true_at) > ONE * fwhm)]
    own = _find_nearest(found_at, true_at)
    stray = np.abs(found_at - true_at[own]) > ONE * truth["fwhm"][own]
    member = group[own]
    allowed, seen = np.bincount(group), np.bincount(member[~stray], minlength=group[-1] + 1)
    # Of too many, which one is extra does not matter: those farthest from a true echo.
    extra = stray.copy()
    for crowded in np.flatnonzero(seen > allowed):
        rows = np.flatnonzero((member == crowded) & ~stray)
        away = np.abs(found_at[rows] - true_at[own[rows]])
        extra[rows[np.argsort(away)[allowed[crowded] :]]] = True
    return np.where(far, -1, nearest), extra


def _find_nearest(values: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Index of the nearest of sorted values."""
    if not len(among):
        return np.zeros(len(values), int)
    right = np.clip(np.searchsorted(among, values), 1, max(len(among) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(among) - 1)
    return np.where(values - among[left] <= among[right] - values, left, right)


def score(sensor: Any, truth: dict[str, np.ndarray], found: dict[str, np.ndarray]) -> dict[str, Any]:
    """Figures of one strip; times of `found` in samples."""
    order = np.lexsort((truth["time"], truth["packet"]))
    truth = {name: column[order] for name, column in truth.items()}
    clear = find_clear(sensor, truth)
    # A pulse's centre is a matter of taste: what all echoes share is no error.
    nearest, _ = match(truth, found, sensor.fwhm)
    strong = clear & (nearest >= 0)
    shift = float(np.median(found["time"][nearest[strong]] - truth["time"][strong])) if strong.any() else 0.0
    found = found | {"time": found["time"] - shift}
    nearest, extra = match(truth, found, sensor.fwhm)
    # Beside clipped echoes nothing is extra: their shape is not known.
    clipped, far = np.flatnonzero(truth["clipped"]), 1e9
    if len(clipped):
        places = truth["packet"][clipped] * far + truth["time"][clipped]
        at = found["packet"] * far + found["time"]
        extra &= np.abs(at - places[_find_nearest(at, places)]) > 2 * sensor.fwhm
    hit = clear & (nearest >= 0)
    missed, number = int((clear & (nearest < 0)).sum()), int(clear.sum())
    over, total = int(extra.sum()), len(found["time"])
    late = (found["time"][nearest] - truth["time"])[hit] / np.maximum(found["time_err"][nearest][hit], 1e-9)
    high = (found["amplitude"][nearest] - truth["amplitude"])[hit] / found["amplitude_err"][nearest][hit]
    # One echo more or less than the limit is chance.
    right = missed <= MOST_MISSED * number + 1 and over <= MOST_EXTRA * total + 1
    return {
        "right": bool(right), "clear": number, "missed": missed / max(number, 1), "extra": over / max(total, 1),
        "true": len(truth["time"]), "found": total, "shift": shift / sensor.fwhm,
        "time_scatter": _scatter(late), "amplitude_scatter": _scatter(high),
        "unsure": float(np.mean(found["amplitude_err"] > found["amplitude"])) if total else 0.0,
    }  # fmt: skip


def _scatter(values: np.ndarray) -> float | None:
    """Robust standard deviation about 0; 1 where reported errors are right."""
    values = values[np.isfinite(values)]
    return float(1.4826 * np.median(np.abs(values))) if len(values) >= 20 else None


def judge_strip(number: int, folder: Path) -> dict[str, Any]:
    """Survey and decompose one strip with the wavebatch that can be imported; JSON values."""
    import wavebatch as wb

    path = make_strip(number, folder)
    sensor, _ = draw_sensor(number)
    result: dict[str, Any] = {"strip": number, "causes": sensor.causes(), "fwhm": sensor.fwhm}
    try:
        with wb.open_strip(path) as strip:
            survey, result["survey_s"] = timed(wb.survey, strip)
            found = find_echoes(strip, wb.auto_chain(survey), survey.system)
        with tempfile.TemporaryDirectory() as clouds:
            result["doubts"], result["run_s"] = find_doubts(path, survey, Path(clouds))
    except Exception as error:  # any failure is a result
        return result | {"right": False, "doubts": [], "error": f"{type(error).__name__}: {error}"}
    for name in ("time", "time_err"):
        found[name] = found[name] / sensor.spacing
    with np.load(path.with_suffix(".npz")) as truth:
        result |= score(sensor, dict(truth), found)
    result["width_ratio"] = float(survey.system.sigma_ref) * FWHM_PER_SIGMA / sensor.spacing / sensor.fwhm
    return result


def tabulate(results: list[dict[str, Any]], older: list[dict[str, Any]]) -> str:
    """The table by cause, and a line for each strip that is not right, or differs from an older result."""
    before = {one["strip"]: one for one in older}
    head = ["cause", "strips", "right", "doubted", "wrong said", "wrong silent", "missed %", "extra %", "width off %",
            "t/err", "a/err", "survey s", "run s", *(["wrong before", "survey s before"] if older else [])]  # fmt: skip
    rows, causes = [head], {cause for one in results for cause in one["causes"]}
    order = {cause: i for i, cause in enumerate(dict.fromkeys(c for one in results for c in one["causes"]))}
    for cause in ["all", *sorted(causes, key=lambda c: (c.startswith("scene"), order[c]))]:
        group = [one for one in results if cause == "all" or cause in one["causes"]]
        words = [verdict(one) for one in group]
        row = [cause, len(group), *(words.count(word) for word in ("right", "doubted", "said", "silent"))]
        row += [100 * _mean(group, "missed"), 100 * _mean(group, "extra")]
        row += [100 * float(np.median([abs(one.get("width_ratio", np.nan) - 1) for one in group]))]
        row += [_mean(group, name, np.median) for name in ("time_scatter", "amplitude_scatter")]
        row += [_mean(group, "survey_s"), _mean(group, "run_s")]
        if older:
            same = [before[one["strip"]] for one in group if one["strip"] in before]
            row += [sum(not one["right"] for one in same), _mean(same, "survey_s")]
        rows.append(row)
    text = format_table(rows)
    listed = [["strip", "verdict", "before", "missed %", "extra %", "width", "clear", "found", "causes"]]
    for one in results:
        old = verdict(before[one["strip"]]) if one["strip"] in before else "-"
        if verdict(one) != "right" or old not in ("-", "right"):
            listed.append([
                one["strip"], verdict(one), old, 100 * one.get("missed", np.nan), 100 * one.get("extra", np.nan),
                *(one.get(name) for name in ("width_ratio", "clear", "found")),
                one.get("error") or ", ".join(one["causes"]),
            ])  # fmt: skip
    return f"{text}\n\n{format_table(listed)}" if len(listed) > 1 else text


def _mean(group: list[dict[str, Any]], name: str, average: Any = np.mean) -> float:
    values = [one[name] for one in group if one.get(name) is not None]
    return float(average(values)) if values else float("nan")


if __name__ == "__main__":
    sys.exit(judge_seeds(Path(__file__), __doc__, judge_strip, tabulate, "strangers", "0-299"))
