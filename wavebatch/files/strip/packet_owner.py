"""Whether the packets of a strip are its own: a .wdp of another strip, under the right name, looks like any other.

`StripReader.scan` asks it, and so every command. Nothing in a .wdp names its strip; but in a strip's own packets echoes
lie where its returns say, or are as strong as these.
Before you change it: only packets that are certainly strange are refused. Locations that are wrong, in another unit or
all zero are no proof; `doubt_packets` in surveying/inspect_strip.py warns of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from wavebatch.core.waveforms import WaveformBlock

_WAVEFORMS, _SAMPLES = 1024, 1 << 20
"""Most waveforms that are compared with their returns, and about the most samples of them."""

_SHORTEST = 64
"""Waveforms that are read even if they are long."""

LEAST_PACKETS = 50
"""Fewer returns prove nothing: the error of a rank correlation is 0.14."""

MOST_GAIN = 0.3
"""Share of the largest possible gain in height, of a return's own packet over those of others, that must be excluded.
Own packets gain .4 to 1.0, or .05 to .3 where only weak returns or mostly noise are there: then a gain of four standard
errors still shows. Those of other strips gain -.05 to .07 (real strips in every wrong combination)."""

MOST_ALIKE = 0.4
"""Largest rank correlation, in packets of another strip, of location and place of the highest sample, and of intensity
and height. At least one of them is .5 to 1.0 in own packets. Scenes and scanners that are alike bring others to .3,
rarely .5: these are left to the warning."""

_SHIFTS = np.arange(1, 5) / 5
"""How far away the returns are, as a share of all of them, at whose locations a return's packet is looked at too."""

_HIGHEST, _WHERE, _LOCATION, _INTENSITY, _OWN, _OTHERS, _DEPTH = range(7)
"""Columns of a table of returns."""


def size_of_sample(longest: int) -> int:
    """Return how many waveforms are looked at where the longest has so many samples."""
    return int(np.clip(_SAMPLES // max(longest, 1), _SHORTEST, _WAVEFORMS))


def is_strange(table: np.ndarray) -> bool:
    """Return whether nothing ties returns, f8 (m, 7) of `compare_returns`, to their packets, though own ones would."""
    # In a packet of noise the highest sample is as far above the median as the lowest one below it.
    table = table[table[:, _HIGHEST] > 2.0 * np.median(table[:, _DEPTH])] if len(table) else table
    if len(table) < LEAST_PACKETS:
        return False
    # Where all returns lie at one place, own packets would look the same; intensities alone may be scaled.
    low, high = np.quantile(table[:, _LOCATION], (0.25, 0.75))
    if high - low < 1.0:
        return False
    gains, possible = table[:, _OWN] - table[:, _OTHERS], 1.0 - table[:, _OTHERS].mean()
    error = 4.0 * gains.std() / np.sqrt(len(gains))
    if gains.mean() > error or gains.mean() + error > MOST_GAIN * possible:
        return False
    pairs = (_LOCATION, _WHERE), (_INTENSITY, _HIGHEST)
    return all(abs(_correlate(table[:, one], table[:, other])) < MOST_ALIKE for one, other in pairs)


def _correlate(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation of values (m,); 0 where one of them is always the same."""
    ranks = []
    for values in (a, b):
        _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(counts) - 0.5 * counts)[which] - 0.5 * len(values))
    scale = np.sqrt((ranks[0] ** 2).sum() * (ranks[1] ** 2).sum())
    return float(ranks[0] @ ranks[1] / scale) if scale > 0 else 0.0


def compare_returns(blocks: Iterable[tuple[WaveformBlock, np.ndarray]]) -> np.ndarray:
    """Compare packets with their strongest returns.

    Parameters
    ----------
    blocks : iterable of WaveformBlock and array
        A sample of the strip, with the intensities of the returns of each block.

    Returns
    -------
    f8 (m, 7)
        A row per packet with signal: height above the median and place of its highest sample; location, in samples, and
        intensity of the return; how high the packet is there, as a share of its highest sample, and at the locations of
        the returns of others; depth of its lowest sample below the median.
    """
    groups: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for block, strength in blocks:
        returns = block.returns
        if returns is None:
            continue
        order = np.lexsort((-strength, returns.waveform))
        strongest = order[np.unique(returns.waveform[order], return_index=True)[1]]
        part = block.samples, returns.time[strongest] / block.spacing, strength[strongest]
        groups.setdefault(block.digitizer.index, []).append(part)
    return np.concatenate([np.empty((0, 7)), *(part for group in groups.values() for part in _compare(group))])


def _compare(group: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Iterator[np.ndarray]:
    """Tables of the blocks of one digitizer: samples (n, s), place (n,) and intensity (n,) of the strongest returns."""
    places = np.concatenate([place for _, place, _ in group])
    sets = [places, *(np.roll(places, int(share * len(places))) for share in _SHIFTS)]
    first = 0
    for samples, place, strength in group:
        last = first + len(samples)
        height, level = samples.max(axis=1).astype(float), np.median(samples, axis=1)
        height -= level
        found = np.stack([_read_height(samples, at[first:last]) - level for at in sets]) / np.maximum(height, 1.0)
        table = [height, samples.argmax(axis=1), place, strength, found[0], found[1:].mean(axis=0)]
        yield np.column_stack([*table, level - samples.min(axis=1)])[height > 0]
        first = last


def _read_height(samples: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The highest of three samples (n, s) at a place (n,) of each; one beyond the end has that of the end."""
    end = samples.shape[1] - 1
    middle = np.rint(np.clip(place, 0, end)).astype(np.int64)
    near = [np.clip(middle + step, 0, end) for step in (-1, 0, 1)]
    return np.maximum.reduce([samples[np.arange(len(samples)), at] for at in near])
