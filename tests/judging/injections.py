"""Echoes of known place and height, added to the waveforms of a real strip: `inject` and `classify` for real.py.

The pulse is that of the reference fit (reference_fit.py), so none that wavebatch learned. A count is rounded twice,
which makes noise of 1 DN 4 % larger.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from checkouts import format_table
from reference_fit import Pulse
from strangers import match

STRONG = 20.0
"""Noises of an echo whose place in the found ones is that of all: what all echoes share is no error."""
JUDGED, CLASSED = (8.0, 100.0), (2.5, 160.0)
"""Heights of injected echoes of a judge and of classes [noises]."""
ROOM = 0.75
"""Least distance to an echo that was found [widths] ..."""
BESIDE_ROOM = 2.0
"""... and to those but the main one, where the injected echo lies beside that."""
HOST, FARTHEST = 10.0, 4.0
"""Least height of the main echo beside which echoes are injected [noises], and how far from it [widths]."""
ROUNDS = 8
"""Times that a strip gets an echo in each waveform, every second time beside its main echo."""
HEIGHTS = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 40.0, 160.0)
"""Borders of classes of height [noises]."""
APART = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)
"""Borders of classes of separation from the main echo [widths]."""
BESIDE = (5.0, 10.0, 20.0, 40.0)
"""Borders of classes of height beside the main echo [noises]."""
ALONE = 4.0
"""Distance from all other echoes from which an echo lies alone [widths]."""
LEAST = 10
"""Echoes of a class that is printed."""


def add_echoes(
    strip: Any,
    tables: list[Any],
    pulse: Pulse,
    noise: float,
    rng: np.random.Generator,
    heights: tuple[float, float],
    *,
    beside: bool = False,
) -> tuple[list[Any], np.ndarray]:
    """Blocks with one more echo in each waveform that has room for it, and these echoes, sorted by packet.

    beside: up to FARTHEST widths from the main echo, else anywhere. Columns of the echoes: packet, time [samples],
    height, distance to the nearest echo that was found, without the main one if beside it, and lag behind the main one
    [widths].
    """  # fmt: skip
    fwhm, blocks, added = pulse.fwhm, [], []
    for block, echoes in zip(strip.blocks, tables, strict=True):
        samples = block.samples.astype(float)
        n, s = samples.shape
        x = np.arange(s)
        for row in range(n):
            mine = echoes.waveform == row
            old, main = echoes.time[mine] / strip.spacing, np.nan
            if beside:
                if not mine.any() or echoes.amplitude[mine].max() < HOST * noise:
                    continue
                top = np.argmax(echoes.amplitude[mine])
                old, main = np.delete(old, top), old[top]
                place = main + rng.choice((-1, 1)) * fwhm * np.exp(rng.uniform(*np.log((APART[0], FARTHEST))))
            else:
                place = rng.uniform(fwhm, max(s - fwhm, fwhm + 1))
            height = noise * np.exp(rng.uniform(*np.log(heights)))
            away = np.abs(old - place).min(initial=1e9) / fwhm
            drawn = height * pulse.at(x - place, 0.0)[0]
            hidden = block.missing is not None and block.missing[row][drawn > 0.01 * height].any()
            outside = beside and not fwhm < place < s - fwhm
            if (
                away < (BESIDE_ROOM if beside else ROOM)
                or hidden
                or outside
                or (samples[row] + drawn).max() > 0.9 * samples.max()
            ):
                continue
            samples[row] += drawn
            added.append((block.point[row], place, height, away, (place - main) / fwhm))
        blocks.append(replace(block, samples=np.rint(samples).astype(block.samples.dtype)))
    table = np.array(added).reshape(-1, 5)
    return blocks, table[np.argsort(table[:, 0], kind="stable")]


def inject(strip: Any, survey: Any, tables: list[Any], reference: dict[str, np.ndarray]) -> dict[str, Any]:
    """Adds an echo to every waveform, .75 widths or more from those found, and looks for it: shares and scatters."""
    pulse, noise = Pulse.widen(reference["lag"], reference["pulse"]), float(reference["noise"])
    blocks, added = add_echoes(strip, tables, pulse, noise, np.random.default_rng(7), JUDGED)
    found, (packet, time, height, away, _) = strip.flat(strip.run(survey, blocks)), added.T
    nearest, _ = match({"packet": packet, "time": time, "fwhm": np.full(len(time), pulse.fwhm)}, found, pulse.fwhm)
    near, hit = away < 1.5, nearest >= 0
    off = _errors(found, nearest, time, height, hit & ~near & (height > STRONG * noise))
    result = {"injected": len(time)}
    for name, which in (("near", near), ("far", ~near)):
        result[f"found_{name}"] = 100 * float(hit[which].mean()) if which.any() else float("nan")
        for kind, ratio in zip("ta", off, strict=True):
            result[f"{kind}_{name}"] = _scatter(ratio[which & hit])
    return result


def _errors(
    found: dict[str, np.ndarray], nearest: np.ndarray, time: np.ndarray, height: np.ndarray, strong: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of time and amplitude over those reported; times without what the strong ones are late in the middle."""
    late = found["time"][nearest] - time
    late -= np.median(late[strong]) if strong.any() else 0.0
    higher = found["amplitude"][nearest] - height
    return late / found["time_err"][nearest], higher / found["amplitude_err"][nearest]


def _scatter(ratio: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(ratio))) if len(ratio) > 10 else float("nan")


def classify(
    strip: Any, survey: Any, tables: list[Any], reference: dict[str, np.ndarray], seed: int
) -> dict[str, np.ndarray]:
    """Injects ROUNDS times, anywhere and beside main echoes; one value per echo.

    height [noises]; lag behind the main echo [widths], NaN where it lies alone; found, if it and no other echo of its
    waveform is the nearest to the found one and the other way round; further echoes that appeared in the waveform;
    errors of time and amplitude over the reported ones. Echoes neither alone nor beside a main one are left out.
    """
    pulse, noise = Pulse.widen(reference["lag"], reference["pulse"]), float(reference["noise"])
    fwhm, before, parts = pulse.fwhm, strip.flat(tables), []
    for turn in range(ROUNDS):
        rng, beside = np.random.default_rng((seed, turn)), turn % 2 == 1
        blocks, added = add_echoes(strip, tables, pulse, noise, rng, CLASSED, beside=beside)
        if not len(added):
            continue
        found, (packet, time, height, away, lag) = strip.flat(strip.run(survey, blocks)), added.T
        old = np.isin(before["packet"], packet)
        mine = np.repeat([False, True], [old.sum(), len(added)])
        truth = {"packet": np.r_[before["packet"][old], packet], "time": np.r_[before["time"][old], time]}
        order = np.lexsort((truth["time"], truth["packet"]))
        mine, truth = mine[order], {name: column[order] for name, column in truth.items()}
        nearest, _ = match(truth | {"fwhm": np.full(len(order), fwhm)}, found, fwhm)
        back, _ = match(found | {"fwhm": np.full(len(found["time"]), fwhm)}, truth, fwhm)
        pair = (nearest >= 0) & (back[nearest] == np.arange(len(nearest)))
        paired = np.zeros(len(found["time"]), bool)
        paired[nearest[pair]] = True
        # Of a waveform that lost its main echo nothing counts as found.
        whole = ~np.isin(packet, truth["packet"][~pair & ~mine])
        nearest, hit = nearest[mine], pair[mine] & (whole | (not beside))
        further = np.array([np.searchsorted(found["packet"][~paired], packet, side) for side in ("left", "right")])
        off = _errors(found, nearest, time, height, hit & (away > ALONE) & (height > STRONG * noise))
        keep = np.abs(lag) <= FARTHEST if beside else away > ALONE
        lag = lag if beside else np.full(len(lag), np.nan)
        parts.append(np.array([height / noise, lag, hit, further[1] - further[0], *off])[:, keep])
    names = ("height", "lag", "found", "further", "time", "amplitude")
    return dict(zip(names, np.concatenate([np.empty((6, 0)), *parts], axis=1), strict=True))


def format_classes(echoes: dict[str, np.ndarray]) -> str:
    """Tables of what `classify` gives: by height where echoes lie alone, by lag and height beside main echoes."""
    alone, height = np.isnan(echoes["lag"]), echoes["height"]
    rows = [["alone, noises", "injected", "found %", "further %", "time error / reported", "amplitude"]]
    rows += [
        _row(_span(low, high), echoes, alone & (height >= low) & (height < high)) for low, high in pairwise(HEIGHTS)
    ]
    rows.append(_row("beside main echoes, 1.5 widths", echoes, (height >= HEIGHTS[4]) & (np.abs(echoes["lag"]) >= 1.5)))
    sides = [(side, low, high) for side in (-1, 1) for low, high in pairwise(BESIDE)]
    table = [["found / further %, widths", *(f"{'after' if side > 0 else 'before'} {_span(low, high)}"
                                             for side, low, high in sides)]]  # fmt: skip
    for near, far in pairwise(APART):
        cells = [_row("", echoes, (side * echoes["lag"] >= near) & (side * echoes["lag"] < far) & (height >= low)
                      & (height < high)) for side, low, high in sides]  # fmt: skip
        table.append([_span(near, far), *(f"{cell[2]} / {cell[3]}" for cell in cells)])
    return f"{format_table(rows)}\n\n{format_table(table)}"


def _row(name: str, echoes: dict[str, np.ndarray], which: np.ndarray) -> list[Any]:
    number = int(which.sum())
    if number < LEAST:
        return [name, number, *"----"]
    hit = which & (echoes["found"] > 0)
    shares = [f"{100 * echoes[kind][which].mean():.1f}" for kind in ("found", "further")]
    return [name, number, *shares, *(_scatter(echoes[kind][hit]) for kind in ("time", "amplitude"))]


def _span(low: float, high: float) -> str:
    return f"{low:g}-{high:g}"
