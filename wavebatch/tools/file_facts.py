"""Header, records and points of any LAS or LAZ file, and how wavebatch made it.

`wavebatch info` prints it; strips with waveforms add what their packets hold, without a survey. All points
are read once, in bounded memory, because headers are often wrong.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import PASSED_THROUGH, EchoFlag, without_nan
from wavebatch.core.errors import InputError
from wavebatch.core.units import ADJUSTED, WEEK, date_gps
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.cloud.column_names import read_provenance
from wavebatch.files.las import header as las
from wavebatch.files.las.crs import name_units, read_crs
from wavebatch.files.las.read_points import read_checked_header
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import describe_samples


def describe_file(path: Path, *, direction: str = "auto", headerless: bool = False) -> dict[str, Any]:
    """Return everything that `wavebatch info` shows of a file, as plain values.

    direction, headerless: as for `open_strip`, for files with waveforms. What cannot be read of the packets or the
    points goes to `problems`. Raises InputError where the header cannot be read.
    """
    checked = read_checked_header(path, waveforms=False)
    header = checked.header
    facts: dict[str, Any] = {"file": str(path), "bytes": header.file_size, "problems": [],
                             "warnings": list(checked.warnings), "notes": []}  # fmt: skip
    if header.point_format in las.WITHOUT_WAVES and header.version >= (1, 3):
        facts |= _describe_waveforms(path, direction, headerless)
    evlrs, _ = las.find_evlrs(path, header, 1000)
    day, year = header.creation
    crs, units = read_crs(path, header)
    facts |= {
        "las_version": "{}.{}".format(*header.version),
        "point_format": header.point_format,
        "compressed": header.compressed,
        "crs": crs,
        "coordinates": name_units(units),
        "scales": list(header.scales),
        "offsets": list(header.offsets),
        "system_identifier": las.decode_text(header.system_identifier),
        "generating_software": las.decode_text(header.generating_software),
        "created": f"day {day} of {year}" if day or year else None,
        "file_source_id": header.file_source_id,
        "points": header.point_count,
        "header_bounds": {"least": list(header.mins), "largest": list(header.maxs)},
        "records": [
            *({"user": one.user, "id": one.record_id, "bytes": len(one.payload), "extended": False,
               "description": las.decode_text(one.description)} for one in header.vlrs),
            *({"user": one.user, "id": one.record_id, "bytes": one.length, "extended": True, "description": ""}
              for one in evlrs),
        ],
        "extra_dimensions": [record.name for record in checked.records],
        "extra_bytes": [
            {"name": record.name,
             "type": record.dtype.base.name + (f"[{record.dtype.shape[0]}]" if record.dtype.shape else ""),
             "description": record.description, "scale": None if record.scaling is None else record.scaling[0],
             "no_data": None if record.no_data is None else [str(value) for value in record.no_data.tolist()]}
            for record in checked.records
        ],
    }  # fmt: skip
    runs = read_provenance(header)
    facts["provenance"] = [
        {
            "version": run.get("wavebatch"),
            "command": str(run.get("command") or "wavebatch run"),
            "input": _table(run.get("input")).get("file"),
            "chain": run.get("chain"),
            "chosen_by": _table(run.get("choice")).get("by"),
            "columns": {name: text for name, text in _table(run.get("columns")).items() if isinstance(text, str)},
        }
        for run in runs
    ]
    try:
        facts |= _describe_points(path, header, bool(runs))
    except InputError as error:
        found = " ".join(str(error).split()).removeprefix(f"{path}: ")
        facts["problems"] = list(dict.fromkeys([*facts["problems"], found]))
    return without_nan(facts)


def _describe_waveforms(path: Path, direction: str, headerless: bool) -> dict[str, Any]:
    """What a strip holds besides points; the reason where its packets cannot be found, because points still can."""
    try:
        with (
            StripReader(path, direction=direction, headerless=headerless) as reader,
            reader.scan(tolerant=True) as scan,
        ):
            facts, packets = reader.facts, reader.facts.packets
            descriptors = []
            for index, points in scan.by_descriptor.items():
                if index in facts.digitizers:
                    digitizer, form = facts.digitizers[index], scan.forms.get(index)
                    descriptors.append({
                        "index": index,
                        "points": points,
                        "bits": digitizer.bits,
                        "samples": digitizer.n_samples,
                        "spacing_ns": digitizer.spacing,
                        "gain": digitizer.gain,
                        "offset": digitizer.offset,
                        "inverted": form is not None and form.inverted,
                    })  # fmt: skip
            return {
                "points_with_waveform": scan.with_waveform,
                "points_without_waveform": scan.without_waveform,
                "points_broken": scan.broken,
                "share_with_waveform": scan.with_waveform / scan.points if scan.points else None,
                "packets": {
                    "count": scan.packets,
                    "where": None if packets.file is None else "internal" if packets.internal else "external",
                    "file": None if packets.file is None else str(packets.file),
                    "bytes": packets.end - packets.start,
                    "shorter_than_descriptor": scan.short,
                    "farthest_shared": scan.reach,
                    "descriptors": descriptors,
                    "descriptors_unused": len(facts.digitizers) - len(descriptors),
                },
                "samples": describe_samples(reader, scan),
                "vectors": {
                    "direction": scan.vectors.direction,
                    "evidence": scan.vectors.evidence,
                    "length_over_half_c": scan.vectors.ratio,
                    "form": scan.vectors.form,
                },
                "notes": list(scan.notes),
                "warnings": [*facts.warnings, *scan.warnings],
                "problems": list(scan.problems),
            }
    except InputError as error:
        return {"problems": [" ".join(str(error).split()).removeprefix(f"{path}: ")]}


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _describe_points(path: Path, header: las.LasHeader, is_ours: bool) -> dict[str, Any]:
    """Sums over all points; counts of echoes only of a cloud with provenance, whose flags are known to be ours."""
    points = passed = 0
    found: dict[str, tuple[float, float]] = {}  # extremes by name
    returns, totals = np.zeros(16, np.int64), np.zeros(16, np.int64)
    classes: Counter[int] = Counter()
    sources: Counter[int] = Counter()
    flags: Counter[str] = Counter()
    with CloudReader(path, np.dtype([("flags", "<u2")])) as reader:
        has_flags = reader.has_flags and is_ours
        for rows in reader.read_pieces():
            raw: np.ndarray = reader.records
            points += len(raw)
            columns = dict(zip("xyz", las.locate(raw, header).T, strict=True))
            columns |= {"scan_angle_deg": las.read_angles(raw), "intensity": raw["intensity"]}
            if "gps_time" in las.field_names(raw.dtype):
                columns["gps_time"] = raw["gps_time"]
            for name, values in columns.items():
                values = values[np.isfinite(values)] if values.dtype.kind == "f" else values
                if len(values):
                    least, largest = found.get(name, (np.inf, -np.inf))
                    found[name] = min(least, float(values.min())), max(largest, float(values.max()))
            number, total = las.split_numbers(raw)
            returns += np.bincount(number, minlength=16)
            totals += np.bincount(total, minlength=16)
            for counter, values in ((classes, las.read_classes(raw)), (sources, raw["point_source_id"])):
                kinds, numbers = np.unique(values, return_counts=True)
                counter.update(dict(zip(kinds.tolist(), numbers.tolist(), strict=True)))
            if has_flags:
                for name, one in EchoFlag.__members__.items():
                    flags[name] += int(np.count_nonzero(rows["flags"] & np.uint16(one)))
                passed += int(np.count_nonzero(rows["flags"] & np.uint16(PASSED_THROUGH)))
    bounds = {}
    if found:
        bounds = {name: [found[axis][end] for axis in "xyz"] for end, name in enumerate(("least", "largest"))}
    echoes = {}
    if has_flags:
        seen = {name: number for name, number in flags.items() if number}
        added = flags[EchoFlag.ADDED.name]
        echoes = {"counts": {"echoes": points - passed, "added": added, "passed_through": passed, "flags": seen}}
    return {
        "bounds": bounds or None,
        "gps_time": _describe_time(header, found.get("gps_time")),
        "scan_angle_deg": list(found["scan_angle_deg"]) if found else None,
        "intensity": list(found["intensity"]) if found else None,
        "returns": {str(k): int(n) for k, n in enumerate(returns) if n},
        "numbers_of_returns": {str(k): int(n) for k, n in enumerate(totals) if n},
        "classes": {str(k): n for k, n in sorted(classes.items())},
        "point_sources": {str(k): n for k, n in sorted(sources.items())},
        **echoes,
    }


def _describe_time(header: las.LasHeader, found: tuple[float, float] | None) -> dict[str, Any] | None:
    """First and last GPS time, its kind, and the dates; None for a point format without times."""
    if found is None:
        return None
    standard = bool(header.global_encoding & las.STANDARD_TIME)
    kind = "adjusted standard" if standard else "seconds of the week"
    if not standard and found[1] > WEEK:
        kind = "unknown (the header says seconds of the week, but they are too large)"
    times = {"least": found[0], "largest": found[1], "kind": kind}
    if standard and -ADJUSTED < found[0] <= found[1] < 4 * ADJUSTED:
        times["dates_gps"] = [date_gps(time).isoformat(sep=" ", timespec="seconds") for time in found]
    return times
