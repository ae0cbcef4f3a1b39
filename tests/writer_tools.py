"""Small LAS and LAZ files with whatever a test needs in them, and readers of the results."""

import io
import json
import os
from pathlib import Path

import laspy
import numpy as np
import pytest

from wavebatch.core.waveforms import Digitizer
from wavebatch.files.cloud import writer as layout
from wavebatch.files.cloud.writer import OutputLayout
from wavebatch.files.las.header import LasHeader, Vlr, build_dtype, encode_evlr_header, read_header
from wavebatch.files.las.read_points import read_checked_header
from wavebatch.files.las.write_points import PointFile
from wavebatch.files.strip.packets import FullwaveWriter, StripFacts
from wavebatch.files.strip.reader import StripReader

BACKENDS = (laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip)


def data_file(name: str) -> Path:
    """A real file of the shared data, or a skip that says where it was looked for."""
    folder = Path(os.environ.get("WAVEBATCH_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not (folder / name).exists():
        pytest.skip(f"{folder / name} is not here; set WAVEBATCH_DATA")
    return folder / name


def leave_out(monkeypatch, name: str) -> None:
    """No shipped pulse has this name: its sensor is a stranger."""
    from wavebatch.surveying.systems import known_systems as module

    rest = tuple(one for one in module.known_systems() if one.name != name)
    monkeypatch.setattr(module, "known_systems", lambda: rest)


def read_raw(path: Path, backend: laspy.LazBackend = laspy.LazBackend.Lazrs) -> np.ndarray:
    """Raw records of a file; laspy never sees its extended records."""
    with laspy.open(path, laz_backend=backend, read_evlrs=False) as reader:
        return np.array(reader.read_points(-1).array)


def random_points(dtype: np.dtype, n: int, seed: int = 0) -> np.ndarray:
    """Points whose every byte is random, apart from what must be a legal number."""
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 256, (n, dtype.itemsize), dtype=np.uint8).view(dtype).reshape(n)
    points["X"], points["Y"], points["Z"] = rng.integers(-(10**6), 10**6, (3, n))
    for name in dtype.names:
        if dtype[name].base.kind == "f":
            points[name] = rng.normal(100, 10, points[name].shape)
    bits = 0xF if "classification_flags" in dtype.names else 0b111
    points["bit_fields"] = (points["bit_fields"] & (0xFF ^ bits)) | (np.arange(n) % 3 + 1).astype(np.uint8)
    if "classification_flags" in dtype.names:
        points["classification_flags"] &= 0b11001111
    return points


def write_source(
    path: Path,
    point_format: int,
    version: tuple[int, int],
    *,
    n: int = 200,
    records=(),
    vlrs: list[Vlr] | None = None,
    evlrs: list[tuple[bytes, int, bytes]] | None = None,
    points: np.ndarray | None = None,
    **header,
) -> np.ndarray:
    """An input with these extra-byte records, VLRs and EVLRs; the packets its points claim are not there."""
    dtype = build_dtype(point_format, records)
    points = random_points(dtype, n) if points is None else points
    filled = LasHeader(version, point_format, dtype.itemsize, (0.01,) * 3, (1000.0, 2000.0, 30.0), **header)
    filled.vlrs = list(vlrs or [])

    class WithRecords(PointFile):
        def _append_records(self):
            for user_id, record_id, payload in evlrs or []:
                head = encode_evlr_header(user_id, record_id, len(payload), b"of a test")
                self.append_record(head, io.BytesIO(payload), 0, len(payload))

    file = WithRecords(path, filled, dtype, list(records), overwrite=True)
    file.write(points)
    file.commit()
    return points


def write_points(
    path: Path, xyz, *, point_format=6, scale=0.001, offsets=(0, 0, 0), extra=(), vlrs=(), raw=(), **fields
) -> laspy.LasData:
    """A cloud as laspy writes it: points (n, 3), fields by their names.

    extra: columns as (name, type, no-data, scale, description), of which the last ones may be missing.
    raw: (name, counts as they are stored).
    """
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.scales, header.offsets = np.full(3, scale), np.array(offsets, float)
    for one in extra:
        name, kind, no_data, step, description = (*one, *(None, None, "")[len(one) - 2 :])
        steps = {} if step is None else {"scales": np.array([step]), "offsets": np.array([0.0])}
        none = None if no_data is None else np.atleast_1d(no_data)
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind, description, no_data=none, **steps))
    header.vlrs.extend(vlrs)
    cloud = laspy.LasData(header)
    cloud.points = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    cloud.x, cloud.y, cloud.z = np.transpose(xyz)
    for name, values in fields.items():
        cloud[name] = values
    for name, values in raw:
        cloud.points.array[name] = values
    cloud.write(path)
    return cloud


def number_returns(count: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pulse, return number and number of returns of each return; count: returns of each pulse."""
    pulse = np.repeat(np.arange(len(count)), count)
    return pulse, np.arange(len(pulse)) - np.repeat(np.cumsum(count) - count, count) + 1, count[pulse]


def facts_of(path: Path) -> StripFacts:
    """What the reader finds about a strip."""
    with StripReader(path) as reader:
        return reader.facts


def plan_output(path: Path, *args, **options) -> OutputLayout:
    """The layout for any LAS or LAZ file."""
    return layout.plan_output(read_checked_header(path, waveforms=False), *args, **options)


def read_provenance(path: Path) -> list[dict]:
    """The accounts of a cloud, oldest first; empty if wavebatch did not write it."""
    return [json.loads(vlr.payload) for vlr in read_header(Path(path)).vlrs if vlr.user == "wavebatch"]


def write_strip(path: Path, *, point_format: int = 9, version: str = "1.4", n: int = 100, **options) -> np.ndarray:
    """A small full-waveform strip with two digitizers; returns its points."""
    digitizers = (Digitizer(1, 8, 40, 1.0, 0.5, 0.1), Digitizer(2, 16, 60, 2.0))
    options = {"internal": True, "digitizers": digitizers, **options}
    with FullwaveWriter(path, version=version, point_format=point_format, **options) as writer:
        points = random_points(writer.dtype, n)
        rng = np.random.default_rng(1)
        half = n // 2
        points["wavepacket_index"] = np.where(np.arange(n) < half, 1, 2)
        points["wavepacket_size"] = np.where(np.arange(n) < half, 40, 120)
        points["wavepacket_offset"][:half] = writer.write_packets(rng.integers(0, 256, (half, 40), np.uint8), 1)
        points["wavepacket_offset"][half:] = writer.write_packets(rng.integers(0, 65536, (n - half, 60), np.uint16), 2)
        writer.write_points(points)
        writer.commit()
    return points
