"""Echoes that stand beside stronger ones at one lag and one share of them, as a part of the pulse would.

`survey` says how many do so beyond chance: a pulse that few echoes show, or none alone, may lack such a part, and a
layer of the scene may look like one (docs/algorithms.md R2).
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.order import distinct
from wavebatch.kernels.elementary import log
from wavebatch.surveying.measuring.judge import SURE
from wavebatch.surveying.measuring.misfit import PART, PLACES, REPEATED, TAIL_AFTER, list_lags

CELLS = (0.3, 0.4), (0.5, 0.7)
"""Half a place: in lags [widths of the pulse] and in logarithms of shares. Strong echoes show parts of a pulse in the
first, weak ones in the second."""

BESIDE = -6, -4, -3, 3, 4, 6
"""How many half places beside it others are compared: targets are at other lags too, or of higher shares."""

LEAST_SHARE = 1e-4
"""Of an echo, below which none is found beside it."""


def share_placed(echoes: EchoTable, width: float, waveforms: int) -> float:
    """Share of the echoes at places, of lag and share, that have more than twice as many as any beside them, for sure.

    Parameters
    ----------
    echoes : EchoTable
        Of a sample.
    width : float
        Of the system pulse [ns].
    waveforms : int
        Of the sample: a place must be seen in three tenths of it, as an object lies in one or two.
    """
    row, other, lag = list_lags(echoes, width)
    ratio = echoes.amplitude[row] / echoes.amplitude[other]
    near = (ratio < 1) & (ratio > LEAST_SHARE) & (np.abs(lag) < TAIL_AFTER)
    row, lag, depth = row[near], lag[near], -log(ratio[near])
    tenth = 10 * echoes.waveform[row].astype(np.int64) // waveforms
    placed = np.zeros(len(row), bool)
    for long, deep in CELLS:
        begin = int(TAIL_AFTER / long) + 1 + BESIDE[-1]
        at, below = np.floor(lag / long).astype(np.int64) + begin, np.floor(depth / deep).astype(np.int64)
        count = np.zeros((2 * begin + 1, int(-log(LEAST_SHARE) / deep) + 2))
        np.add.at(count, (at, below), 1)
        place = count[:-1, :-1] + count[1:, :-1] + count[:-1, 1:] + count[1:, 1:]
        higher = np.pad(place, ((0, 0), (2, 0)))[:, :-2]
        most = np.max([higher, *(np.roll(place, step, axis=0) for step in BESIDE)], axis=0)
        # Roots of counts scatter by a half, whatever the counts.
        sure = 2 * (np.sqrt(place + 0.375) - np.sqrt(2 * most + 0.375)) >= SURE
        sure[:, : int(np.ceil(-log(PART) / deep))] = False
        for first, second in np.argwhere(sure & (place >= REPEATED)):
            here = (at - first) // 2 == 0
            here &= (below - second) // 2 == 0
            if len(distinct(tenth[here])) >= PLACES:
                placed |= here
    return len(distinct(row[placed])) / max(len(echoes), 1)
