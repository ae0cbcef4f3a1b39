"""Scan lines from the angles of consecutive pulses: a line ends where the mirror turns, jumps back or pauses.

Used by the slices tool. Oscillating and rotating mirrors look different: the first turn, the second jump.
"""

from __future__ import annotations

import numpy as np

LAG = 16
"""Pulses over which the direction of the mirror is judged: turns closer together than that are noise."""
_JUMP = 20.0
"""Steps of the angle above this many usual ones ..."""
_JUMP_SHARE = 0.25
"""... and above this share of its range are jumps."""
_PAUSE = 20.0
"""Times between pulses above this many usual ones are pauses."""


def find_sweeps(angle: np.ndarray, time: np.ndarray) -> np.ndarray:
    """First pulse of every scan line.

    Parameters
    ----------
    angle : float (n,)
        Across the flight direction, in any unit.
    time : float (n,), s
        Of the pulses.

    Returns
    -------
    int64 (k,)
        0 included; empty for no pulses. A line begins after a jump of the angle (a quarter of its range and 20 usual
        steps), after a pause (20 usual intervals, or a time that runs backwards), and where the angle turns.
    """
    n = len(angle)
    if n < 2:
        return np.arange(min(n, 1))
    step, interval = np.abs(np.diff(angle)), np.diff(time)
    usual = np.median(step[step > 0]) if (step > 0).any() else np.inf
    pause = _PAUSE * np.median(interval[interval > 0]) if (interval > 0).any() else np.inf
    jump = step > max(_JUMP * usual, _JUMP_SHARE * np.ptp(angle))
    cuts = np.flatnonzero(jump | (interval > pause) | (interval < 0)) + 1
    edges = np.concatenate([[0], cuts, [n]])
    parts = [a + _find_turns(angle[a:b]) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
    return np.unique(np.concatenate([edges[:-1], *parts]))


def _find_turns(angle: np.ndarray) -> np.ndarray:
    """Pulses at which the angle turns, within one run without jumps."""
    if len(angle) <= 2 * LAG:
        return np.empty(0, np.int64)
    rising = angle[LAG:] > angle[:-LAG]
    changes = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    edges = _drop_short(np.concatenate([[0], changes, [len(rising)]]))[1:-1]
    turns = []
    for edge in edges.tolist():
        low, high = max(edge - LAG, 0), min(edge + 2 * LAG, len(angle))
        part = angle[low:high]
        turns.append(low + int(np.argmax(part) if rising[edge - 1] else np.argmin(part)))
    return np.array(turns, np.int64)


def _drop_short(edges: np.ndarray) -> np.ndarray:
    """Edges without those of runs shorter than LAG: the shortest run is joined with its two neighbours first."""
    while len(edges) > 2:
        lengths = np.diff(edges)
        shortest = int(np.argmin(lengths))
        if lengths[shortest] >= LAG:
            break
        gone = [number for number in (shortest, shortest + 1) if 0 < number < len(edges) - 1]
        edges = np.delete(edges, gone)
    return edges
