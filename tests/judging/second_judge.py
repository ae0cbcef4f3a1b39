"""Judges by a second family of strips with truth, by another hand: `python tests/judging/second_judge.py --help`.

It shares nothing with `strangers.py` but the command line: no draw, no pulse, no matching. A survey that suits only one
of them is not right. Strips come as real ones do: up to five returns per pulse, waveforms in a second file, point
format 4 or 9. Those from 5000 on are harder: more of them ring, their echoes are higher, and they have fewer packets.
Judged is the cloud that `wavebatch run` writes, and what its report says.

clear   true echoes that any sound decomposition finds: 8 noises high, not clipped, a width away from the edges, and
        apart from others: 1.1 widths, more where heights differ, 5 widths beside one that is 20 times as high.
found   all echoes of the cloud with a time and an amplitude.
extra   found echoes that belong to no true one, but for those on a clipped echo; near: within 4 widths of a true one.

A strip is right where at most 3 % of the clear echoes are missed and at most 3 % of the found ones are extra.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from checkouts import format_table, judge_seeds, timed, verdict

SEED, HARD = 20261128, 5000
"""Of the whole list (who changes this, or a draw in this file, makes other strips, and no older result compares); the
first of the hard strips."""
GPS, PULSE_TIME = 200000.0, 1e-4
"""Time of the first pulse, and from one to the next [s]."""
DOUBTS = {"pulse-guess", "noise-guess", "false-echoes", "failed-fits"}
"""Warnings by which a report says that its echoes may be wrong."""
NEAREST, WIDER, MOST = 0.5, 0.75, 0.03
"""Distance [widths] up to which a found echo is a true one; up to which it is not extra; share of missed, or extra."""
VERDICTS = ("right", "doubted", "said", "silent")
COUNTS = ("missed", "clear", "extra", "near", "found", "run_s")
DRAWN = ("fwhm", "shape", "skew", "ring", "change", "bits", "noise", "AR", "base", "top", "clip", "samples", "packets",
         "most", "gap", "single", "wide", "widest")  # fmt: skip
"""What a strip that is not right is listed with."""


def draw_sensor(number: int) -> tuple[dict[str, Any], np.random.Generator]:
    """What a strip is drawn with, times in samples; and the generator for the rest of it."""
    rng = np.random.default_rng([SEED, number])
    uniform = rng.uniform

    def spread(low: float, high: float) -> float:
        return float(np.exp(uniform(np.log(low), np.log(high))))

    p: dict[str, Any] = {"strip": number, "fwhm": (fwhm := spread(1.2, 40))}
    p["shape"] = str(rng.choice(["gauss", "emg", "split", "gamma"]))
    p["skew"] = 0.0 if p["shape"] == "gauss" else float(uniform(0, 0.2))
    p["ring"] = float(uniform(0.01, 0.05)) if uniform() < 0.5 else 0.0
    p["ring_period"], p["ring_decay"] = float(uniform(1.2, 3)), float(uniform(0.6, 2))
    p["change"] = float(uniform(0, 0.04)) if uniform() < 0.6 else 0.0
    p["bits"] = int(rng.choice([8, 10, 12, 16], p=[0.4, 0.1, 0.15, 0.35]))
    full = 2 ** p["bits"] - 1
    p["noise"] = spread(0.3, {8: 2.5, 10: 5}.get(p["bits"], 10))
    (one, two), p["AR"] = (uniform(0.1, 0.8), uniform(-0.2, 0.7)), int(rng.choice(3, p=[0.4, 0.35, 0.25]))
    p["filter"] = [[], [float(one)], [float(one + two), float(-one * two)]][p["AR"]]
    p["base"] = str(rng.choice(["constant", "packet", "drift"]))
    p["level"] = float(uniform(0.02, 0.1) * full) if p["bits"] == 8 else float(uniform(20, 200))
    p["top"] = min(float(10 ** uniform(1.6, 3.7)) * p["noise"], uniform(0.5, 0.9) * (full - p["level"]))
    p["clip"] = float(uniform(1.05, 1.6)) if uniform() < 0.15 and p["bits"] < 16 and full / p["noise"] < 8000 else 0.0
    p["top"] = p["clip"] * (full - p["level"]) or p["top"]
    p["samples"] = int(spread(least := max(24, 5 * fwhm), max(2000, least * 1.2)))
    most = max(50, 700000 / p["samples"])
    p["packets"] = int(np.clip(spread(50, 8000), 50, most))
    p["most"], p["gap"], p["single"] = int(rng.integers(1, 9)), spread(1.0, 6), float(uniform(0.1, 0.8))
    p["empty"], p["wide"] = float(rng.choice([0, uniform(0, 0.3)])), float(rng.choice([0, uniform(0, 0.4)]))
    p["widest"], p["lognormal"] = float(uniform(0.2, 1.0)), False
    p["spacing"], p["format"] = float(rng.choice([0.5, 1.0, 2.0])), int(rng.choice([4, 9]))
    if number >= HARD:
        p["ring"] = float(uniform(0.01, 0.05)) if uniform() < 0.7 else 0.0
        p["packets"] = int(np.clip(spread(50, 1500), 50, most))
        if not p["clip"]:
            p["top"] = min(float(10 ** uniform(2.3, 3.7)) * p["noise"], uniform(0.5, 0.9) * (full - p["level"]))
        p["single"], p["gap"], p["most"] = float(uniform(0, 0.6)), spread(0.5, 4), int(rng.integers(1, 9))
        p["lognormal"] = bool(uniform() < 0.5)
    return p, rng


def make_pulse(p: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, int]:
    """Times from the top, heights, and steps per sample."""
    w, skew, fine = p["fwhm"], p["skew"], max(8, int(np.ceil(60 / p["fwhm"])))
    t, s = np.arange(-6 * w, 14 * w, 1 / fine), w / 2.3548
    y = np.exp(-(t**2) / 2 / s**2)
    if p["shape"] == "emg" and skew >= 0.01:
        part = (skew / 2) ** (1 / 3)
        rise, tail = s * np.sqrt(1 - part * part), np.where(t >= 0, np.exp(-np.maximum(t, 0) / (s * part)), 0)
        y = np.fft.irfft(np.prod(np.fft.rfft([np.exp(-(t**2) / 2 / rise**2), tail], 2 * len(t)), axis=0))[: len(t)]
    elif p["shape"] == "split" and skew >= 0.01:
        y = np.exp(-(t**2) / 2 / np.where(t < 0, s * (1 - skew), s * (1 + skew)) ** 2)
    elif skew >= 0.01:  # a gamma density
        b, most = s * skew / 2, 4 / skew**2 - 1
        x = t / b + most + 1
        y = np.exp(np.where(x > 0, most * np.log(np.maximum(x, 1e-9) / most) - (x - most), -99))
    y = y / y.max()
    above = np.flatnonzero(y >= 0.5)
    stretch = (t - t[y.argmax()]) * w / ((above[-1] - above[0] + 1) / fine)
    y = np.interp(t, stretch, y, 0, 0)
    if p["ring"]:
        late = t - 0.6 * w
        wave = np.sin(2 * np.pi * late / (p["ring_period"] * w)) * np.exp(-late / (p["ring_decay"] * w))
        wave *= (late > 0) * (1 - np.exp(-((late / (0.4 * w)) ** 2)))
        y = y + p["ring"] * wave / max(np.abs(wave).max(), 1e-9)
    return t, y / y.max(), fine


def draw_echoes(p: dict[str, Any], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Waveforms without noise, and the truth: rows of packet, time, amplitude and FWHM."""
    t, y, fine = make_pulse(p)
    w, n, weakest = p["fwhm"], p["samples"], 3 * p["noise"]
    spectrum, frequency = np.fft.rfft(y, 2 * len(t)), np.fft.rfftfreq(2 * len(t), 1 / fine)
    waves, truth, samples = np.zeros((p["packets"], n)), [], np.arange(n)
    low, high = min(2 * w, 0.3 * n), n - 1 - min(2 * w, 0.3 * n)
    for packet, wave in enumerate(waves):
        if rng.uniform() < p["empty"]:
            continue
        m = 1 if rng.uniform() < p["single"] else int(rng.integers(1, p["most"] + 1))
        gaps = w * (0.3 + rng.exponential(p["gap"], m - 1)) if m > 1 else np.zeros(0)
        while len(gaps) and gaps.sum() > high - low:
            gaps = gaps[:-1]
        times = rng.uniform(low, high - gaps.sum()) + np.r_[0, np.cumsum(gaps)]
        m = len(times)
        heights = np.exp(rng.uniform(np.log(weakest), np.log(p["top"]), m))
        if p["lognormal"]:
            heights = p["top"] / 3 * np.exp(0.9 * rng.standard_normal(m)) * (0.7 ** np.arange(m))
            heights = heights.clip(weakest, p["top"])
        for time, height in zip(times, heights, strict=True):
            scale = 1 + p["change"] * rng.standard_normal() if p["change"] else 1.0
            wider = p["widest"] * w / 2.3548 * rng.uniform() if rng.uniform() < p["wide"] else 0.0
            lag, pulse = t, y
            if wider > 0.02 * w:
                pulse = np.fft.irfft(spectrum * np.exp(-2 * (np.pi * frequency * wider) ** 2))[: len(t)]
                lag, pulse = t - t[pulse.argmax()], pulse / pulse.max()
            wave += height * np.interp((samples - time) / scale, lag, pulse, 0, 0)
            truth.append((packet, time, height, w * scale * np.sqrt(1 + (wider * 2.3548 / w) ** 2)))
    return waves, np.array(truth).reshape(-1, 4)


def add_noise(p: dict[str, Any], waves: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rounded counts, not yet clipped."""
    packets, n = waves.shape
    noise = rng.standard_normal((packets, n + 60))  # after 60 samples the filter forgot its start
    for k in range(1, n + 60):
        for lag, part in enumerate(p["filter"][:k], 1):
            noise[:, k] += part * noise[:, k - lag]
    noise = noise[:, 60:]
    base = p["level"] + np.zeros(packets)
    if p["base"] == "packet":
        base += rng.uniform(0.3, 2) * p["noise"] * rng.standard_normal(packets)
    elif p["base"] == "drift":
        height, along = rng.uniform(1, 6) * p["noise"], np.arange(packets) / packets
        base += height * np.sin(along * rng.uniform(2, 12) + rng.uniform(0, 6))
    return np.rint(waves + base[:, None] + noise * (p["noise"] / noise.std()))


def make_strip(number: int, folder: Path) -> tuple[Path, dict[str, Any], np.ndarray, np.ndarray]:
    """The strip NNNN.las, with NNNN.wdp, in a folder; what it was drawn with, its truth, which echoes are clipped."""
    p, rng = draw_sensor(number)
    waves, truth = draw_echoes(p, rng)
    raw, full = add_noise(p, waves, rng), 2 ** p["bits"] - 1
    clipped = [(raw[int(i), max(0, int(x - f)) : int(x + f) + 2] > full).any() for i, x, _, f in truth]
    counts = np.clip(raw, 0, full).astype("<u1" if p["bits"] == 8 else "<u2")
    path = folder / f"{number:04d}.las"
    record = struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, counts.nbytes, b"waveforms")
    path.with_suffix(".wdp").write_bytes(record + counts.tobytes())
    path.write_bytes(format_las(p, truth, counts.itemsize, rng))
    return path, p, truth, np.array(clipped, bool)


def format_las(p: dict[str, Any], truth: np.ndarray, width: int, rng: np.random.Generator) -> bytes:
    """LAS 1.3 or 1.4: for every pulse the returns that a sensor would give, at most its five strongest echoes."""
    n, step, new = p["samples"], p["spacing"] * 1000, p["format"] == 9
    high = truth[truth[:, 2] > 12 * p["noise"]]
    body, places, ranks = bytearray(), [], []
    for i, seen in enumerate(np.split(high, np.searchsorted(high[:, 0], np.arange(1, p["packets"])))):
        seen = seen[np.sort(np.argsort(-seen[:, 2])[:5])]
        times = seen[:, 1] + 0.1 * rng.standard_normal(len(seen)) if len(seen) else [n / 2]
        heights, number = seen[:, 2] if len(seen) else [0], len(times)
        angle = np.deg2rad(15 * np.sin(i * 0.05))
        vector = np.array([np.sin(angle), 0, -np.cos(angle)]) * 1.4989e-4
        start = np.array([1000 + 0.02 * (i // 200) + 700 * np.tan(angle), 2000 + i * 0.05, 300.0])
        degrees, gps = np.rad2deg(angle), GPS + i * PULSE_TIME
        for rank, (time, height) in enumerate(zip(times, heights, strict=True), 1):
            places.append(start + vector * time * step)
            ranks.append(rank)
            body += struct.pack("<iiiH", *(round(c / 0.001) for c in places[-1]), int(min(65535, height)))
            body += (struct.pack("<BBBBhHd", rank | number << 4, 0, 1, 0, int(degrees / 0.006), 7, gps) if new
                     else struct.pack("<BBbBHd", rank | number << 3, 1, int(degrees), 0, 7, gps))  # fmt: skip
            body += struct.pack("<BQIffff", 1, 60 + i * n * width, n * width, time * step, *vector)
    descriptor = struct.pack("<BBIIdd", 8 * width, 0, n, int(step), 1.0, 0.0)
    record = struct.pack("<H16sHH32s", 0, b"LASF_Spec", 100, 26, b"wave") + descriptor
    by_rank, box = np.bincount(ranks, minlength=16), np.array(places)
    size, length = (375, 59) if new else (235, 57)
    head = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I12dQ", b"LASF", 0, 4 | (17 if new else 1), 0, 0, 0, b"", 1, 4 if new else 3,
        b"OTHER", b"hj gen", 100, 2026, size, size + len(record), 1, p["format"], length, 0 if new else len(ranks),
        *([0] * 5 if new else by_rank[1:6]), *(0.001,) * 3, *(0.0,) * 3,
        *np.stack([box.max(axis=0), box.min(axis=0)], axis=1).ravel(), 0,
    )  # fmt: skip
    return head + (struct.pack("<QIQ15Q", 0, 0, len(ranks), *by_rank[1:]) if new else b"") + record + bytes(body)


def find_clear(p: dict[str, Any], truth: np.ndarray, clipped: np.ndarray) -> np.ndarray:
    """Which true echoes of one packet any sound decomposition finds."""
    _, time, height, width = truth.T
    alone = (height >= 8 * np.hypot(p["noise"], 0.29)) & ~clipped  # 0.29: of rounding
    alone &= (time >= width) & (time <= p["samples"] - 1 - width)
    away, ratio = np.abs(time - time[:, None]), height / height[:, None]
    both = (width + width[:, None]) / 2
    hidden = away < both * (1.1 + 0.25 * np.log(np.maximum(ratio, 1 / ratio)))
    hidden |= ((ratio > 20) & (away < 5 * both)) | (clipped & (away < 3 * both))
    np.fill_diagonal(hidden, False)
    return alone & ~hidden.any(axis=1)


def match(truth: np.ndarray, found: np.ndarray, reach: float) -> dict[int, int]:
    """The found echo of each true one of a packet that has any, the nearest pair first; `found` are times."""
    away = np.abs(found - truth[:, 1, None]) / (truth[:, 3, None] * reach + 0.5)
    pairs = {}
    while away.size and away.min() <= 1:
        one, other = divmod(int(away.argmin()), len(found))
        pairs[one] = other
        away[one], away[:, other] = np.inf, np.inf
    return pairs


def score(p: dict[str, Any], truth: np.ndarray, clipped: np.ndarray, found: np.ndarray) -> dict[str, Any]:
    """Figures of one strip; rows of `found`, sorted by packet: packet, time [samples]."""
    ends = [np.searchsorted(rows[:, 0], np.arange(p["packets"] + 1))[1:-1] for rows in (truth, found)]
    split = [np.split(truth, ends[0]), np.split(clipped, ends[0]), np.split(found[:, 1], ends[1])]
    parts = [(true, clip, times, find_clear(p, true, clip)) for true, clip, times in zip(*split, strict=True)]
    # A pulse's centre is a matter of taste: what all echoes share is no error.
    strong, number = 20 * np.hypot(p["noise"], 0.29), sum(int(seen.sum()) for *_, seen in parts)
    late = [times[j] - true[i, 1] for true, _, times, seen in parts
            for i, j in match(true, times, NEAREST).items() if seen[i] and true[i, 2] > strong]  # fmt: skip
    shift = float(np.median(late)) if len(late) > 5 else 0.0
    missed, extra, near = number, 0, 0
    for true, clip, times, seen in parts:
        missed -= sum(int(seen[i]) for i in match(true, times - shift, NEAREST))
        left = np.delete(times, list(match(true, times - shift, WIDER).values()))
        away = np.abs(left - true[:, 1, None]) / true[:, 3, None]
        over = ~(clip[:, None] & (away < 1)).any(axis=0)
        extra, near = extra + int(over.sum()), near + int((over & (away < 4).any(axis=0)).sum())
    right = missed <= MOST * max(number, 1) and extra <= MOST * max(len(found), 1)
    return {"right": right, "clear": number, "missed": missed, "extra": extra, "near": near, "found": len(found)}


def judge_strip(number: int, folder: Path) -> dict[str, Any]:
    """Run one strip with the wavebatch that can be imported and judge its cloud; JSON values."""
    import wavebatch as wb

    path, result, truth, clipped = make_strip(number, folder)
    with tempfile.TemporaryDirectory() as clouds:
        outcome, result["run_s"] = timed(wb.run, [path], clouds, columns="+echo_time")
        if outcome.failed:
            return result | {"right": False, "doubts": [], "error": str(outcome.outcomes[0].error)}
        report = json.loads((Path(clouds) / f"{path.stem}.report.json").read_text())
        cloud = laspy.read(Path(clouds) / f"{path.stem}.laz")
    result["doubts"] = [line["text"] for line in report["warnings"] if line["code"] in DOUBTS]
    found = np.stack([np.rint((cloud.gps_time - GPS) / PULSE_TIME), cloud["echo_time"] / result["spacing"]], axis=1)
    found = found[(cloud["amplitude"] > -9000) & (cloud["echo_time"] > -9000)]
    found = found[np.argsort(found[:, 0], kind="stable")]
    return result | score(result, truth, clipped, found)


def tabulate(results: list[dict[str, Any]], older: list[dict[str, Any]]) -> str:
    """The table, and a line for each strip that is not right, or differs from an older result."""
    before = {one["strip"]: one for one in older}
    rows: list[list[Any]] = [["strips", "all", *VERDICTS, *COUNTS]]
    groups = {"judged": results, "ringing": [one for one in results if one["ring"]],
              "before": [before[one["strip"]] for one in results if one["strip"] in before]}  # fmt: skip
    for name, group in [pair for pair in groups.items() if pair[1]]:
        words, sums = [verdict(one) for one in group], [sum(one.get(count, 0) for one in group) for count in COUNTS]
        rows.append([name, len(group), *map(words.count, VERDICTS), *sums])
    listed: list[list[Any]] = [["strip", "verdict", "before", *COUNTS, *DRAWN, "said"]]
    for one in results:
        old = before.get(one["strip"], one)
        moved = sum(abs(one.get(count, 0) - old.get(count, 0)) for count in ("missed", "extra"))
        # An echo, or 1 % of them, is no difference that matters.
        if {verdict(one), verdict(old)} != {"right"} or moved > 0.01 * one.get("found", 0) + 1:
            said = one.get("error") or "; ".join(text[:60] for text in one["doubts"])
            listed.append([one["strip"], verdict(one), verdict(old) if older else "-",
                           *(one.get(name) for name in (*COUNTS, *DRAWN)), said])  # fmt: skip
    return f"{format_table(rows)}\n\n{format_table(listed)}"


if __name__ == "__main__":
    sys.exit(judge_seeds(Path(__file__), __doc__, judge_strip, tabulate, "second_strips", "1000-1449"))
