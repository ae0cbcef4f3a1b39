"""What a strip says of its sensor: day of the flight, name, channels. `targets` and `strip_match` read it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from wavebatch.files.las.header import decode_text
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.scan_result import StripScan

SCANNERS = 4
"""Scanner channels of LAS points (0 to 3). A channel number here is SCANNERS x digitizer + scanner channel."""

_CHANNEL_SAMPLE = 4096
"""Waveforms that show which scanner channels a strip has."""

_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_ADJUSTED = 1e9
"""Seconds that LAS takes off standard GPS time."""
_WEEK = 604_800.0


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
    shares = {}
    for index, number in sorted(scan.by_descriptor.items()):
        of = counts.get(index, np.eye(SCANNERS)[0])
        shares |= {(index, scanner): number / total * of[scanner] / of.sum() for scanner in np.flatnonzero(of).tolist()}
    return shares
