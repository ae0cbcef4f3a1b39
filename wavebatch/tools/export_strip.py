"""A strip for other programs: LAS with its packets repaired, or its waveforms as arrays, for `wavebatch export`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.units import count
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.disk.npz import NpzWriter
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.las.header import EXTRA_BYTES_RECORD_ID, STANDARD_TIME, Vlr, decode_text, has_record, is_projection
from wavebatch.files.strip.packet_check import VECTORS, read_toward
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.surveying.inspect_strip import audit_header

SUFFIXES = (".las", ".laz", ".npz")
USER_ID = b"wavebatch_export"
"""User id of the record that says what was repaired."""
MOST_DESCRIPTORS = 255
_BLOCK = 4096
_WAVES = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", *VECTORS)


@frozen
class ExportSummary:
    """What was exported."""

    strip: str
    output: str
    points: int
    waveforms: int
    repaired: tuple[str, ...]
    """What was wrong with the strip, and is not any more."""


def export_strip(
    path: Path, target: Path, *, direction: str = "auto", headerless: bool = False, overwrite: bool = False,
    progress: Callable[[int], Any] = lambda waveforms: None,
) -> ExportSummary:  # fmt: skip
    """Export a strip.

    Parameters
    ----------
    path : Path
        LAS or LAZ file with waveforms.
    target : Path
        .las or .laz: the strip with its packets repaired, in a .wdp beside it; .npz: its waveforms as arrays.
    direction : str
        Where packet vectors point: auto, toward or away.
    headerless : bool
        Accept a .wdp without its 60-byte header.
    overwrite : bool
        Replace an existing file.
    progress : callable
        Called with numbers of waveforms.

    Returns
    -------
    ExportSummary

    Raises
    ------
    InputError
        Where the strip cannot be read or the output cannot be written.
    ConfigError
        Where the output's name has another end than .las, .laz or .npz.
    """
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{target}: an output's name must end in .las, .laz or .npz")
    write = _write_arrays if target.suffix.lower() == ".npz" else _write_strip
    with StripReader(path, direction=direction, headerless=headerless) as reader, reader.scan() as scan:
        facts, repaired = reader.facts, []
        if facts.compressed & set(scan.by_descriptor):
            repaired.append("packets were compressed")
        if scan.vectors.form == "range":
            repaired.append("packet vectors were whole paths; they are metres per picosecond")
        elif scan.vectors.direction == "away":
            repaired.append("packet vectors pointed away from the sensor; they point toward it")
        if scan.broken:
            lost = f"packets of {count(scan.broken, 'point')} cannot be used: left out; `wavebatch check` says why"
            repaired.append(f"warning: {lost}")
        if scan.short:
            repaired.append(
                f"{count(scan.short, 'point')} had packets shorter than their descriptor; now descriptors fit"
            )
        doubts = (f"warning: {line}" for line in (*facts.warnings, *scan.doubts))
        repaired += [*scan.notes, *audit_header(reader, scan), *doubts]
        source = {"file": facts.path.name, **take_fingerprint(facts.path, facts.packets.file)}
        account = json.dumps({"export": source, "repaired": repaired, "version": __version__}, sort_keys=True)
        waveforms = write(reader, scan, target, account, overwrite, progress)
    return ExportSummary(str(path), str(target), scan.points, waveforms, tuple(repaired))


def _write_arrays(
    reader: StripReader, scan: StripScan, target: Path, account: str, overwrite: bool, progress: Callable[[int], Any]
) -> int:
    """All waveforms of a strip as one .npz; their samples stand behind each other."""
    columns = {
        "point": "<i8", "gps_time": "<f8", "origin": np.dtype(("<f8", (3,))), "direction": np.dtype(("<f8", (3,))),
        "digitizer": "u1", "spacing": "<f8", "first": "<i8", "count": "<i4", "samples": "<u4", "missing": "?",
        "return_waveform": "<i8", "return_point": "<i8", "return_time": "<f8",
        "return_xyz": np.dtype(("<f8", (3,))),
    }  # fmt: skip
    if all(reader.facts.digitizers[index].width <= 2 for index in scan.by_descriptor):
        columns["samples"] = "<u2"
    done, at = 0, 0
    with NpzWriter(target, columns, overwrite=overwrite) as writer:
        for block in reader.all_blocks(scan, _BLOCK):
            n, s = block.samples.shape
            missing = np.zeros((n, s), bool) if block.missing is None else block.missing
            writer.add({
                "point": block.point, "gps_time": block.gps_time, "origin": block.origin, "direction": block.direction,
                "digitizer": np.full(n, block.digitizer.index), "spacing": np.full(n, block.spacing),
                "first": at + s * np.arange(n), "count": np.full(n, s), "samples": block.samples.reshape(-1),
                "missing": missing.reshape(-1), "return_waveform": done + block.returns.waveform,
                "return_point": block.returns.point, "return_time": block.returns.time,
                "return_xyz": block.returns.xyz,
            })  # fmt: skip
            done, at = done + n, at + n * s
            progress(n)
        writer.publish({"crs": reader.facts.crs or "", "meta": account})
    return done


def _write_strip(
    reader: StripReader, scan: StripScan, target: Path, account: str, overwrite: bool, progress: Callable[[int], Any]
) -> int:
    """The strip with plain packets, one descriptor per kind and length, and vectors toward the sensor."""
    found: dict[tuple[int, int, bool], Digitizer] = {}
    for unit in reader.read_units(scan):
        table = unit.packets
        kinds = np.stack([table.digitizer, table.n_samples, table.packed], axis=1) if len(table) else np.empty((0, 3))
        for index, length, packed in np.unique(kinds, axis=0).astype(int).tolist():
            stored = reader.facts.digitizers[index]
            form = unit.forms.get(index)
            here = replace(stored, bits=8 * stored.width) if form is None else form.digitizer(stored, bool(packed))
            found[here.index, length, here.inverted] = replace(here, bits=8 * here.width, n_samples=length)
    names = sorted(found)
    facts, header, done = reader.facts, reader.facts.header, 0
    if len(names) <= MOST_DESCRIPTORS:
        digitizers = {name: replace(found[name], index=number) for number, name in enumerate(names, 1)}
    else:  # the strip's own descriptors
        digitizers = {name: replace(found[name], n_samples=facts.digitizers[name[0]].n_samples) for name in names}
    dropped = [("LASF_Spec", number) for number in (*range(100, 355), EXTRA_BYTES_RECORD_ID)]
    records = [vlr for vlr in header.vlrs if not any(has_record([vlr], *one) for one in dropped)]
    records.append(Vlr(USER_ID, 1, account.encode(), b"what was exported and repaired"))
    with FullwaveWriter(
        target, version="{}.{}".format(*header.version), point_format=header.point_format, internal=False,
        digitizers=list({one.index: one for one in digitizers.values()}.values()), scales=header.scales,
        offsets=header.offsets, wkt=None if any(map(is_projection, header.vlrs)) else facts.crs,
        extra_bytes=facts.records, records=records, week=not header.global_encoding & STANDARD_TIME,
        system=decode_text(header.system_identifier), source=header.file_source_id, overwrite=overwrite,
    ) as writer:  # fmt: skip
        for unit in reader.read_units(scan):
            offset, size, index = (np.zeros(len(unit.packets), kind) for kind in (np.uint64, np.uint32, np.uint8))
            # Packets that points of several units share are written in each of them.
            rows = np.unique(unit.packet_of_point[unit.packet_of_point >= 0])
            for samples, stored, chosen in reader.read_counts(unit, rows, _BLOCK):
                digitizer = digitizers[stored.index, samples.shape[1], stored.inverted]
                offset[chosen] = writer.write_packets(samples, digitizer.index)
                size[chosen], index[chosen] = samples.shape[1] * digitizer.width, digitizer.index
                done += len(chosen)
                progress(len(chosen))
            points = np.ascontiguousarray(unit.points).view(writer.dtype).copy()
            has = np.flatnonzero(unit.packet_of_point >= 0)
            row = unit.packet_of_point[has]
            toward = read_toward(points[has], unit.vectors.direction, unit.vectors.form)
            location = points["return_point_wave_location"][has]
            for name in _WAVES:
                points[name] = 0
            points["wavepacket_index"][has], points["wavepacket_offset"][has] = index[row], offset[row]
            points["wavepacket_size"][has], points["return_point_wave_location"][has] = size[row], location
            for axis, name in enumerate(VECTORS):
                points[name][has] = toward[:, axis]
            writer.write_points(points)
        writer.commit()
    return done
