"""What a strip says of its sensor and its setting: day, name, channels, rate of pulses, light of the strongest echoes.

`targets` measures it for CAL.toml and `strip_match` for each strip: another pulse rate or gain under the same header
makes another sensor of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.order import robust_std
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.las.header import decode_text
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.physics.radiometry import transmit
from wavebatch.surveying.sensor import SensorSource

SAMPLE = 2048
"""Waveforms whose light is summed."""

QUANTILES = np.linspace(0.05, 0.95, 10)
"""Of the light of waveforms, by which scenes are compared."""

UNLIKE = 4.0
"""Scenes of one setting differ in brightness by up to so many times the scatter of the ratios of their quantiles:
quarters of strips over villages, fields and forest by up to 3.8 times."""

ZONE_PARTS = 8
"""Parts of a strip whose bend is measured: their scatter tells ground from a wrong pulse zone."""

LEAST_BEND, MOST_BEND = 0.002, 0.1
"""Least standard deviation of the cosine of the rays' angles that bends level ground by a metre or more; and by how
much of a zone the ranges may seem to be off a whole number of them, and uncertain: terrain that follows the flight line
for the whole strip seldom does so."""

LEAST_SCENE = 200
"""Waveforms of a scene."""

LEAST_CHANGE = 0.1
"""Smaller changes of the brightness (logarithm) say nothing: quarters of a strip over a village differ by 0.09."""

BRIGHT = 0.95
"""Quantile of the light of waveforms: above it lie few metal roofs and signs."""

SLICES, SLICE_POINTS = 8, 2048
"""Places of the strip at which GPS times are read, and points at each."""

LEAST_IN_ORDER = 0.8
"""Share of neighbouring points whose times must not fall: points in another order show no pulse rate."""

SCANNERS = 4
"""Scanner channels of LAS points (0 to 3). A channel number here is SCANNERS x digitizer + scanner channel."""

_CHANNEL_SAMPLE = 4096
"""Waveforms that show which scanner channels a strip has."""

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_ADJUSTED = 1e9
"""Seconds that LAS takes off standard GPS time."""
_WEEK = 604_800.0


class Setting(NamedTuple):
    """A strip's setting by its data."""

    rate: float | None
    """Pulses per second; None where the times do not show it."""
    brightest: dict[int, float]
    """R^2 / eta times the sum of the samples of the strongest waveforms of each digitizer [DN m2]: slopes do not change
    it."""
    scenes: dict[int, tuple[float, ...]]
    """Logarithms of the QUANTILES of that light, for each digitizer."""
    right: tuple[float, float]
    """Unit vector to the right of the flight."""
    fades: float
    """By how much this light falls from the first half of the strip to the second, as of one scene (logarithm)."""


def compare_scenes(one: Sequence[float], other: Sequence[float]) -> float:
    """Return by how much one scene is brighter than another that is like it (logarithm); 0 where scenes explain it.

    Another energy or gain shifts the logarithms of all quantiles alike; other surfaces shift each in its own way.
    """
    off = np.subtract(one, other)
    shift = float(np.median(off))
    return shift if abs(shift) > max(LEAST_CHANGE, UNLIKE * float(np.std(off))) else 0.0


def measure_setting(
    reader: StripReader, scan: StripScan, sensor: SensorSource, attenuation: float, energy: float = 1.0
) -> Setting:
    """Measure the setting of a strip; attenuation: of the air, one way [dB/km], energy: by which light is divided."""
    parts: dict[int, list[np.ndarray]] = {}
    for block in reader.sample_blocks(scan, SAMPLE):
        block = sensor.fill(block)
        if block.sensor is None:
            continue
        above = _take_off_level(block)
        time = block.spacing * np.nanargmax(above, axis=1)
        away = block.origin + block.direction * time[:, None] - block.sensor
        distance = np.sqrt((away * away).sum(axis=1))
        whole = np.nansum(above, axis=1) * distance**2 / transmit(distance, attenuation) / energy
        rows = np.stack([block.gps_time, whole, *(away + block.sensor).T, -away[:, 2] / distance, *block.sensor.T[:2]])
        parts.setdefault(block.digitizer.index, []).append(rows[:, whole > 0])
    joined = {index: np.concatenate(some, axis=1) for index, some in parts.items()}
    known = {index: rows for index, rows in joined.items() if rows.size}
    rate = _measure_rate(reader)
    if known and rate:
        _refuse_zone(reader, np.concatenate([*known.values()], axis=1), 1e9 * HALF_C / rate)
    brightest = {index: float(np.quantile(rows[1], BRIGHT)) for index, rows in known.items()}
    scenes = {index: _describe_scene(rows[1]) for index, rows in known.items()}
    fades = [_find_fading(*rows[:2]) for rows in known.values()]
    return Setting(rate, brightest, scenes, _find_right(known), max(fades, key=abs, default=0.0))


def _find_right(known: Mapping[int, np.ndarray]) -> tuple[float, float]:
    """Unit vector to the right of the mean motion of the sensor; 0 where it does not move."""
    rows = np.concatenate([np.empty((8, 0)), *known.values()], axis=1)
    time, *place = rows[[0, 6, 7]] - rows[[0, 6, 7]].mean(axis=1, keepdims=True)
    ahead = np.nan_to_num(np.stack(place) @ time)
    return tuple((np.array([ahead[1], -ahead[0]]) / max(float(np.hypot(*ahead)), 1e-30)).tolist())


def _refuse_zone(reader: StripReader, rows: np.ndarray, zone: float) -> None:
    """Raise InputError where the ground is bent across the flight as by ranges that are off by whole pulse intervals.

    rows: f8 (8, n), of which 2 to 5 are x, y, z and the cosine of the ray's angle to the vertical; zone: way of light
    between two pulses, one way [m]. Ranges that are too short by s lift the ground by s times that cosine.
    """
    found = []
    for part in np.array_split(rows[2:6, np.argsort(rows[0], kind="stable")], ZONE_PARTS, axis=1):
        x, y, z, down = part - part.mean(axis=1, keepdims=True)
        if part.shape[1] < LEAST_SCENE // 2 or np.std(down) < LEAST_BEND:
            return
        found.append(np.linalg.lstsq(np.stack([x, y, down], axis=1), z, rcond=None)[0][2])
    off, error = float(np.median(found)), robust_std(np.array(found)) / ZONE_PARTS**0.5
    number = round(off / zone)
    if number and abs(off - number * zone) < MOST_BEND * zone > error:
        raise InputError(
            f"{reader.facts.path}: its ground is bent across the flight as if all ranges were {abs(off):.0f} m too "
            f"{'short' if off > 0 else 'long'}, {abs(number)} x the {zone:.0f} m between two pulses: echoes were taken "
            "for those of another pulse; resolve the pulse zones again with the sensor's software"
        )


def _describe_scene(light: np.ndarray) -> tuple[float, ...]:
    return tuple(np.log(np.quantile(light, QUANTILES)).tolist())


def _find_fading(time: np.ndarray, light: np.ndarray) -> float:
    """Logarithm by which the light of the second half of a strip is darker, where both halves are like one scene."""
    late = time > np.median(time)
    if min(late.sum(), (~late).sum()) < LEAST_SCENE:
        return 0.0
    return compare_scenes(_describe_scene(light[~late]), _describe_scene(light[late]))


def sum_light(block: WaveformBlock) -> np.ndarray:
    """Sum of the samples of each waveform above its median, f4 (n,) [DN]: the light of whole pulses, not fitted."""
    return np.nansum(_take_off_level(block), axis=1)


def _take_off_level(block: WaveformBlock) -> np.ndarray:
    """Samples f4 (n, s) over the median of their waveform; NaN where they are missing."""
    samples = block.samples.astype(np.float32)
    if block.missing is not None:
        samples[block.missing] = np.nan
    return samples - np.nanmedian(samples, axis=1)[:, None]


def _measure_rate(reader: StripReader) -> float | None:
    """Pulses per second by the shortest usual distance of GPS times: pulses without a point leave longer ones."""
    count, rates = reader.facts.header.point_count, []
    for start in np.unique(np.linspace(0, max(count - SLICE_POINTS, 0), SLICES).astype(np.int64)).tolist():
        step = np.diff(widen_integers(reader.read_points(start, min(start + SLICE_POINTS, count))["gps_time"]))
        later = step[np.isfinite(step) & (step > 0)]
        if not len(later) or np.mean(step >= 0) < LEAST_IN_ORDER:
            continue
        shortest = np.quantile(later, 0.1)
        rates.append(1.0 / float(np.mean(later[later < 1.3 * shortest + 1e-9])))
    return float(np.median(rates)) if rates else None


def read_day(reader: StripReader) -> str:
    """Return the day of the flight as 2026-11-22; empty where GPS times are not standard ones."""
    header = reader.facts.header
    if not header.point_count or not header.global_encoding & 1:
        return ""
    second = float(reader.read_points(0, 1)["gps_time"][0]) + _ADJUSTED
    if not _WEEK < second < 4e9:
        return ""
    return (_GPS_EPOCH + timedelta(seconds=second)).date().isoformat()


def read_sensor_name(facts: StripFacts) -> str:
    """Return the system identifier of the header; empty where it names no sensor."""
    name = decode_text(facts.header.system_identifier).strip()
    return "" if name.upper() in ("OTHER", "MERGE", "MODIFICATION", "EXTRACTION", "TRANSFORMATION", "") else name


def see_channels(reader: StripReader, scan: StripScan) -> dict[tuple[int, int], float]:
    """Return the share of the waveforms of each digitizer and scanner channel, by a sample for the scanner channels."""
    total = sum(scan.by_descriptor.values())
    counts: dict[int, np.ndarray] = {}
    for block in reader.sample_blocks(scan, _CHANNEL_SAMPLE):
        scanner = np.zeros(len(block), np.int64) if block.scanner is None else block.scanner
        counts[block.digitizer.index] = counts.get(block.digitizer.index, 0) + np.bincount(scanner, minlength=SCANNERS)
    shares: dict[tuple[int, int], float] = {}
    for index, number in sorted(scan.by_descriptor.items()):
        of = counts.get(index, np.eye(SCANNERS)[0])
        shares |= {(index, scanner): number / total * of[scanner] / of.sum() for scanner in np.flatnonzero(of).tolist()}
    return shares
