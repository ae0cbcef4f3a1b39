"""Strips whose digitizer records only what is above a threshold: several packets per pulse, of different lengths.

`write_recorded` renders pulses once and writes them joined, one packet each, or split around the gaps, with the same
samples and returns: what is computed from both must agree.
"""

import numpy as np
from scipy.spatial import cKDTree

from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.tools.simulate.returns import fill_packets

SIGMA = 2.0
LENGTHS = np.arange(32, 513, 32)
"""Samples of the descriptors, one per length."""


def render(echoes, begin, n_samples, rng, *, noise=0.5):
    """Counts (n, s) of echoes given as rows of (pulse, height [m], amplitude), seen from heights `begin` (n,) down."""
    pulse, height, amplitude = echoes[:, 0].astype(int), echoes[:, 1], echoes[:, 2]
    at = (begin[pulse] - height) / HALF_C
    signal = np.full((len(begin), n_samples), 12.0)
    lag = np.arange(-12, 13)
    place = np.rint(at).astype(int)[:, None] + lag
    inside = (place >= 0) & (place < n_samples)
    value = amplitude[:, None] * np.exp(-0.5 * ((place - at[:, None]) / SIGMA) ** 2)
    np.add.at(signal, (np.broadcast_to(pulse[:, None], place.shape)[inside], place[inside]), value[inside])
    return np.clip(np.rint(signal + noise * rng.standard_normal(signal.shape)), 0, 65535).astype("<u2")


def record(counts, threshold, *, before=20, after=24):
    """(first, last) samples of the packets of each pulse: around what is above the threshold."""
    packets = []
    for row in counts:
        above = np.flatnonzero(row > 12 + threshold)
        if not len(above):
            packets.append([])
            continue
        cuts = np.flatnonzero(np.diff(above) > before + after)
        first, last = above[np.append(0, cuts + 1)] - before, above[np.append(cuts, len(above) - 1)] + after
        packets.append([(max(a, 0), min(b, len(row) - 1)) for a, b in zip(first, last, strict=True)])
    return packets


def write_recorded(path, counts, begin, xy, echoes, packets=None, *, time=None, order=None, wrong=(), direction=None,
                   scanner=None):  # fmt: skip
    """A strip of pulses going down from `begin` (n,), with a point per echo.

    packets: (first, last) samples of each pulse's packets; None: all samples in one. order: of the points. wrong:
    (pulse, packet) that are lost: their points have no packet.
    """
    n, s = counts.shape
    packets = [[(0, s - 1)]] * n if packets is None else packets
    direction = np.tile([0.0, 0.0, -HALF_C], (n, 1)) if direction is None else direction
    digitizers = [Digitizer(i + 1, 16, int(length), 1.0) for i, length in enumerate(LENGTHS)]
    writer = FullwaveWriter(path, version="1.4", point_format=9 if scanner is not None else 4, internal=True,
                            digitizers=digitizers, wkt="" if scanner is not None else None)  # fmt: skip
    with writer:
        rows = []
        of, number, low, high = np.array([(p, k, *one) for p in range(n) for k, one in enumerate(packets[p])]).T
        kind = np.searchsorted(LENGTHS, high - low + 1)
        start, offset = np.maximum(np.minimum(low, s - LENGTHS[kind]), 0), np.zeros(len(of), np.int64)
        for k in np.unique(kind):
            own = np.flatnonzero(kind == k)
            place = start[own, None] + np.arange(min(LENGTHS[k], s))
            offset[own] = writer.write_packets(counts[of[own, None], place], int(k) + 1)
        ends = np.searchsorted(echoes[:, 0], np.arange(n + 1))
        for i, (pulse, first, length) in enumerate(zip(of, start, np.minimum(LENGTHS[kind], s), strict=True)):
            at = (echoes[ends[pulse] : ends[pulse + 1], 1] - begin[pulse]) / direction[pulse, 2]
            inside = (at >= max(first, low[i])) & (at < first + length) & (at <= high[i])
            known = 0 if (pulse, number[i]) in wrong else kind[i] + 1
            for one in at[inside] if inside.any() else [first + length / 2]:
                rows.append((pulse, one, one - first, known, offset[i], length * 2))
        points = np.zeros(len(rows), writer.dtype)
        pulse, at = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
        place = np.column_stack([xy, begin])[pulse] + direction[pulse] * at[:, None]
        for axis, name in enumerate("XYZ"):
            points[name] = np.rint(place[:, axis] / 0.001)
        points["bit_fields"] = 9 if scanner is None else 17
        if scanner is not None:
            points["classification_flags"] = np.asarray(scanner)[pulse] << 4
        points["gps_time"] = (1000.0 + np.arange(n) * 1e-5 if time is None else time)[pulse]
        after, index, place, size = np.array([row[2:] for row in rows]).T
        fill_packets(points, index, place, size, after, direction[pulse])
        writer.write_points(points if order is None else points[order(len(points), pulse)])
        writer.commit()
    return path


def _cover(rng, xy, density, radius):
    """Share of the footprints of .1 m at `xy` that discs cover, of which `density` of the area is under any."""
    low, high = xy.min() - 1, xy.max() + 1
    number = rng.poisson(-np.log(1 - density) / (np.pi * radius**2) * (high - low) ** 2)
    distance, _ = cKDTree(rng.uniform(low, high, (number, 2))).query(xy)
    return np.clip((radius - distance) / 0.1 + 0.5, 0, 1)


def draw_canopy(rng, n, *, layers=(122.0, 116.0, 110.0), density=0.25, leaf=0.5, soil=0.25, full=900.0, width=20.0,
                clumps=None):  # fmt: skip
    """Echoes (m, 3), positions (n, 2), and the light that each layer and the ground catch, (n, layers + 1).

    A layer catches a beta-distributed part of a pulse's light; with clumps, all of it in discs of that radius [m],
    whose edges are as wide as a footprint.
    """
    xy = rng.uniform(0, width, (n, 2))
    left, caught, echoes = np.ones(n), [], []
    energy = full * np.exp(0.05 * rng.standard_normal(n))
    for layer in layers:
        part = left * (rng.beta(density, 1 - density, n) if clumps is None else _cover(rng, xy, density, clumps))
        part[part < 0.02] = 0.0
        caught.append(part)
        left = left - part
        echoes.append(np.column_stack([np.arange(n), layer + rng.uniform(-0.4, 0.4, n), energy * leaf * part]))
    caught.append(left)
    echoes.append(np.column_stack([np.arange(n), np.full(n, 100.3), energy * soil * left]))
    table = np.concatenate(echoes)
    table = table[table[:, 2] > 4]
    return table[np.lexsort((-table[:, 1], table[:, 0]))], xy, np.stack(caught, axis=1)
