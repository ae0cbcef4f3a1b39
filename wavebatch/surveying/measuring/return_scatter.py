"""How exactly a vendor placed the returns of a strip: echoes are placed relative to them, and inherit their error.

`prepare` calls it once per strip. A fit shows how far an echo lies from the return of its packet, but not how far both
are off: locations also have the phase of the outgoing pulse. The strip shows three scatters that hold more than that
of the returns, so that the smallest counts (docs/algorithms.md 6.1).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import distinct, even_places, median, quantile
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import ReturnTable, SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.geometry.group_returns import match_returns
from wavebatch.surveying.measuring.residuals import decompose_sample

RUNS, RUN = 4, 160
"""Places of a strip that are looked at, and packets in each, one after the other: some hundred returns show a scatter
to a tenth."""

RUN_SAMPLES = 1 << 18
"""Most samples in each place: 1,638 of each of 160, or four of the longest waveforms."""

RETURNS = 0.02
"""Scatter of vendors' returns along the ray [m], by data sheets, where a strip does not show it."""

LEAST = 20
"""Fewer pairs, or returns between two neighbours, do not show a scatter."""

LOWEST, LOWEST_OF_NORMAL = 1 / 3, 0.4307
"""Share of the smallest residuals that count, since edges and plants only enlarge them; and the largest of these, over
the standard deviation, for normal residuals."""

ROUNDED, LEAST_ROUNDING = 2048, 1e-3
"""Points that show to what coordinates are rounded, since a common divisor of so many is no chance; and the least that
counts [m]: millimetres are usual."""

FEWEST_VALUES = 50
"""Fewer different values of a coordinate may be true ones with a common step: two levels, or rows of a raster."""

BETWEEN = (0.2, 0.8)
"""Where a return lies between its two neighbours, as a share of their distance: elsewhere a scan line ends."""

REACH = 2.5
"""Largest distance in time between an echo and its return, as in stage attribute.position [ns]."""


class ReturnScatter(NamedTuple):
    """Errors of places that no fit shows."""

    scatter: float = RETURNS
    """Standard deviation of the vendor's returns along the ray [m]."""
    phase: float = 0.0
    """Root mean square of the difference between locations and echoes [m]: of echoes without a return."""
    source: str = "assumed"
    """`neighbours`, `pairs of returns`, `locations`, `rounding` of the coordinates, or `assumed`."""


def measure_returns(reader: StripReader, scan: StripScan, system: SystemPulse) -> ReturnScatter:
    """Measure the scatter of the returns of a strip along their rays.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    system : SystemPulse
        Of the survey.

    Returns
    -------
    ReturnScatter
        The smallest of three scatters, each less the errors of the fits. Neighbours: single returns of clear echoes
        off the line between the returns before and after them; it holds the roughness of the ground. Pairs of returns
        of a packet, against the fits; not less than RETURNS. Locations of returns against the fits; it holds the
        phase. Coordinates that are rounded to more than that count instead.
    """
    parts = list(_sample(reader, scan, system))
    if not parts:
        return ReturnScatter()
    neighbours, pairs, offsets = (np.concatenate(kind, axis=-1) for kind in zip(*parts, strict=True))
    phase = HALF_C * float(np.sqrt(np.mean(offsets[0] ** 2))) if offsets.size else 0.0
    offsets[0] -= median(offsets[0]) if offsets.size else 0.0
    kinds = {"neighbours": neighbours, "pairs of returns": pairs, "locations": offsets}
    found = {name: _measure(residuals) for name, residuals in kinds.items()}
    known = {name: HALF_C * scatter for name, scatter in found.items() if scatter is not None}
    # What two returns of a packet share, as the instant of its pulse, cancels in their difference.
    if known.get("pairs of returns", RETURNS) < RETURNS:
        del known["pairs of returns"]
        known["assumed"] = RETURNS
    source = min(known, key=known.__getitem__, default="assumed")
    # What rounding takes off the coarsest coordinate: locations do not show it.
    points = reader.read_points(0, int(min(scan.borders[-1], ROUNDED)), scan)
    values = [distinct(points[name].astype(np.int64)) for name in "XYZ"]
    steps = [np.gcd.reduce(np.diff(one)) if len(one) >= FEWEST_VALUES else 0 for one in values]
    rounding = float(np.max(np.multiply(steps, reader.facts.header.scales))) / 12.0**0.5
    scatter = known.get(source, RETURNS)
    if rounding > max(scatter, LEAST_ROUNDING):
        return ReturnScatter(rounding, phase, "rounding")
    return ReturnScatter(scatter, phase, source)


def _measure(residuals: np.ndarray) -> float | None:
    """Scatter of residuals (3, k): each with its variance per variance of a return, and with the error of its fits;
    None for too few of them. Of the half with the smaller errors, less these errors.

    A few residuals may have less than their errors by chance, which must not mean that returns are exact. So it is the
    root mean square over the normal distribution of the share LOWEST, at three nodes (Gauss-Hermite).
    """
    off, factor, error = residuals[:, np.argsort(residuals[2], kind="stable")[: max(LEAST, residuals.shape[1] // 2)]]
    if len(off) < LEAST:
        return None
    variance = ((off / LOWEST_OF_NORMAL) ** 2 - error**2) / factor
    chance = np.sqrt(3.0 * LOWEST * (1.0 - LOWEST) / len(off))
    low, middle, high = (max(quantile(variance, LOWEST + node * chance), 0.0) for node in (-1.0, 0.0, 1.0))
    return float(np.sqrt((low + 4.0 * middle + high) / 6.0))


def _sample(reader: StripReader, scan: StripScan, system: SystemPulse) -> Iterator[tuple[np.ndarray, ...]]:
    """Residuals of runs of packets (3, k), as for `_measure`: of neighbours, pairs and locations [ns]."""
    chosen = even_places(reader.unit_count(), RUNS).tolist()
    for number in chosen:
        unit = reader.read_unit(number, scan)
        rows = np.flatnonzero(unit.packets.owned)
        rows = rows[np.argsort(unit.packets.offset[rows], kind="stable")]
        size = max(min(RUN, RUN_SAMPLES // int(unit.packets.n_samples[rows].max(initial=1))), 1)
        # Runs that overlap would count packets twice.
        runs = max(min(RUNS // len(chosen), len(rows) // size), 1)
        run = np.full(len(unit.packets), -1)
        for place, start in enumerate(even_places(max(len(rows) - size, 0) + 1, runs).tolist()):
            run[rows[start : start + size]] = place
        # All runs at once: each call of the decomposition takes as long as some hundred waveforms of it.
        for block, taken in reader.read_rows(unit, rows[run[rows] >= 0], runs * size):
            if block.returns is not None and len(block.returns):
                yield _compare(block, block.returns, run[taken], system.of(block))


def _compare(
    block: WaveformBlock, returns: ReturnTable, run: np.ndarray, system: SystemPulse
) -> tuple[np.ndarray, ...]:
    """The same of one block; run: of each waveform (n,). Only waveforms of one run are neighbours."""
    echoes = decompose_sample(block, system, free_levels=True)
    match = match_returns(echoes.waveform, echoes.time, returns.waveform, returns.time, REACH + 0.5 * block.spacing)
    clear = (match >= 0) & ((echoes.flags & np.uint16(UNCLEAN | EchoFlag.WEAK)) == 0) & (echoes.time_err > 0)
    rows = np.flatnonzero(clear)
    waveform, error = echoes.waveform[rows], echoes.time_err[rows].astype(np.float64)
    offset = echoes.time[rows] - returns.time[match[rows]]
    two = np.flatnonzero(waveform[1:] == waveform[:-1])
    pairs = np.stack([np.diff(offset)[two], np.full(len(two), 2.0), np.hypot(error[two], error[two + 1])])
    offsets = np.stack([offset, np.ones(len(rows)), error])

    number = np.bincount(returns.waveform, minlength=len(block))
    lone = (echoes.alone(len(block)) & (number[echoes.waveform] == 1))[rows]
    waveform, error, place = waveform[lone], error[lone], returns.xyz[match[rows[lone]]]
    order = np.lexsort((block.gps_time[waveform], run[waveform]))
    error, place, run, ray = error[order], place[order], run[waveform[order]], block.direction[waveform[order]][1:-1]
    chord, ahead = place[2:] - place[:-2], place[1:-1] - place[:-2]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (ahead * chord).sum(axis=1) / (chord * chord).sum(axis=1)
        aside = ray - chord * ((ray * chord).sum(axis=1) / (chord * chord).sum(axis=1))[:, None]
        off = ((ahead - share[:, None] * chord) * aside).sum(axis=1) / (aside * aside).sum(axis=1)
    between = (share > BETWEEN[0]) & (share < BETWEEN[1]) & np.isfinite(off)
    between = np.flatnonzero(between & (run[2:] == run[:-2]))
    before, after = (1.0 - share) ** 2, share**2
    fits = np.sqrt(error[1:-1] ** 2 + before * error[:-2] ** 2 + after * error[2:] ** 2)
    neighbours = np.stack([off, 1.0 + before + after, fits])[:, between]
    return neighbours, pairs, offsets
