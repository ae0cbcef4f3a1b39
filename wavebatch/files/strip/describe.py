"""The contents of a strip, for `wavebatch info`: what a scan and a sample of its packets show, without a survey.

`wavebatch check` compares the header's claims with the points, which wavebatch itself does not use.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.no_data import without_nan
from wavebatch.files.las.header import LasHeader, read_header
from wavebatch.files.las.write_points import Statistics
from wavebatch.files.strip.reader import StripFacts, StripReader, StripScan

_SAMPLED = 4096
"""Waveforms that are read."""


def audit_header(reader: StripReader, scan: StripScan) -> Iterator[str]:
    """Yield a line for each count or bound of the header that the points contradict."""
    facts = reader.facts
    claimed = read_header(facts.path)
    true = LasHeader(claimed.version, claimed.point_format, claimed.point_length, claimed.scales, claimed.offsets)
    statistics = Statistics(facts.dtype, ())
    for start, stop in zip(scan.borders[:-1].tolist(), scan.borders[1:].tolist(), strict=True):
        statistics.add(reader.read_points(start, stop))
    statistics.fill(true)
    if not true.point_count:
        return
    known = 15 if claimed.version >= (1, 4) else 5
    if claimed.by_return[:known] != true.by_return[:known]:
        first, really = claimed.by_return[0], true.by_return[0]
        yield f"counts by return in the header are wrong (first returns: {first}, counted: {really})"
    slack = 1.5 * np.abs(claimed.scales)
    outside = (np.array(true.mins) < np.array(claimed.mins) - slack) | (np.array(true.maxs) > claimed.maxs + slack)
    if not np.all(~outside):
        axes = ", ".join(np.array(list("xyz"))[outside].tolist())
        yield f"points lie outside the bounds that the header claims ({axes})"


def describe_strip(path: Path | str, *, direction: str = "auto", headerless: bool = False) -> dict[str, Any]:
    """Collect everything that `wavebatch info` shows of a strip.

    Parameters
    ----------
    path : path
    direction : str
        Where packet vectors point: auto, toward or away.
    headerless : bool
        Accept a .wdp file without its 60-byte header.

    Returns
    -------
    dict
        Plain values for JSON; None for floats that are not finite. `problems` lists why a strip cannot be processed.

    Raises
    ------
    InputError
        Where the strip cannot be read.
    """
    with StripReader(path, direction=direction, headerless=headerless) as reader, reader.scan(tolerant=True) as scan:
        facts = reader.facts
        return {
            **_describe_file(facts),
            **_describe_points(scan),
            "packets": _describe_packets(facts, scan),
            "samples": describe_samples(reader, scan),
            "vectors": {
                "direction": scan.vectors.direction,
                "evidence": scan.vectors.evidence,
                "length_over_half_c": without_nan(scan.vectors.ratio),
                "form": scan.vectors.form,
            },
            "notes": list(scan.notes),
            "warnings": [*facts.warnings, *scan.warnings],
            "problems": list(scan.problems),
        }


def describe_samples(reader: StripReader, scan: StripScan) -> dict[str, Any]:
    """Extremes of waveforms spread over the strip; of none where no packet can be used."""
    rows = []
    for block in reader.sample_blocks(scan, _SAMPLED) if scan.with_waveform else ():
        at_limit = (block.samples == block.digitizer.max_count).any(axis=1)
        extremes = int(block.samples.min()), int(block.samples.max())
        gaps = 0 if block.missing is None else int(block.missing.any(axis=1).sum())
        rows.append((len(block), *extremes, int(np.count_nonzero(at_limit)), gaps, block.samples.shape[1]))
    columns: Any = zip(*rows, strict=True) if rows else ((),) * 6
    numbers, least, largest, limited, with_gaps, lengths = columns
    return {
        "waveforms_read": sum(numbers),
        "least": min(least, default=None),
        "largest": max(largest, default=None),
        "waveforms_at_limit": sum(limited),
        "waveforms_with_gaps": sum(with_gaps),
        "lengths": sorted(set(lengths)),
    }


def _describe_file(facts: StripFacts) -> dict[str, Any]:
    return {
        "file": str(facts.path),
        "bytes": facts.size,
        "las_version": facts.version,
        "point_format": facts.header.point_format,
        "compressed": facts.header.compressed,
        "crs": facts.crs,
        "scales": list(facts.header.scales),
        "offsets": list(facts.header.offsets),
        "extra_dimensions": [record.name for record in facts.records],
    }


def _describe_points(scan: StripScan) -> dict[str, Any]:
    return {
        "points": scan.points,
        "points_with_waveform": scan.with_waveform,
        "points_without_waveform": scan.without_waveform,
        "points_broken": scan.broken,
        "share_with_waveform": scan.with_waveform / scan.points if scan.points else None,
    }


def _describe_packets(facts: StripFacts, scan: StripScan) -> dict[str, Any]:
    used = {index: count for index, count in scan.by_descriptor.items() if index in facts.digitizers}
    return {
        "count": scan.packets,
        "where": None if facts.packets.file is None else "internal" if facts.packets.internal else "external",
        "file": None if facts.packets.file is None else str(facts.packets.file),
        "bytes": facts.packets.end - facts.packets.start,
        "shorter_than_descriptor": scan.short,
        "farthest_shared": scan.reach,
        "descriptors": [_describe_descriptor(facts, scan, index, count) for index, count in used.items()],
        "descriptors_unused": len(facts.digitizers) - len(used),
    }


def _describe_descriptor(facts: StripFacts, scan: StripScan, index: int, points: int) -> dict[str, Any]:
    digitizer = facts.digitizers[index]
    form = scan.forms.get(index)
    return {
        "index": index,
        "points": points,
        "bits": digitizer.bits,
        "samples": digitizer.n_samples,
        "spacing_ns": digitizer.spacing,
        "gain": without_nan(digitizer.gain),
        "offset": without_nan(digitizer.offset),
        "inverted": form is not None and form.inverted,
    }
