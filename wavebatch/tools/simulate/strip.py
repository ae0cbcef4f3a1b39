"""A scene as a file: a strip with wave packets and its truth, or a cloud of discrete returns without packets.

`wavebatch simulate` calls `simulate_strip` and `simulate_returns`. Both store the pulses of a scene, one seed block at
a time, so that memory does not grow with the number of pulses. Random numbers of storage (what the points get wrong)
come from another generator: the waveforms do not depend on StripOptions.

The truth file is a .npz with one array per column, written and read in pieces; columns and their types are declared
here. `simulate_strip` writes it, `wavebatch compare` and the tests read it.
"""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import CheckedOptions, Range, option
from wavebatch.files.disk.npz import NpzWriter, read_array_header, read_npz, reading_npz
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.las.header import WITHOUT_WAVES, LasHeader, build_dtype, field_names
from wavebatch.files.las.write_points import PointFile
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.stages.score import find_isolated_echoes
from wavebatch.tools.simulate.render import EAST, LEAST_SIGMA, NORTH, PulseModel
from wavebatch.tools.simulate.returns import DiscreteReceiver, Returns, fill_packets, list_returns
from wavebatch.tools.simulate.scenes import Scene, Simulated, find_scene, seed_block, simulate_seed_block

ECHO_COLUMNS: dict[str, str] = {
    "waveform": "<u8",
    "byte_offset": "<u8",
    "gps_time": "<f8",
    "time": "<f8",
    "amplitude": "<f4",
    "sigma": "<f4",
    "x": "<f8",
    "y": "<f8",
    "z": "<f8",
    "incidence_angle": "<f4",
    "range": "<f8",
    "flags": "<u2",
    "isolated": "|b1",
    "overlapped": "|b1",
}
"""Per true echo, in file order: packet number, byte offset of its packet, GPS time of its pulse [s], time after
sample 0 [ns], amplitude [DN], sigma [ns], position [m], angle to the ground's normal [deg], sensor to echo [m],
EchoFlag bits, whether it is isolated, whether a neighbour overlaps it."""

PACKET_COLUMNS: dict[str, str] = {"packet_byte_offset": "<u8", "packet_gps_time": "<f8"}
"""Per packet, in file order, those without an echo too."""

_DTYPES = {**ECHO_COLUMNS, **PACKET_COLUMNS}
_META = "meta"
_PIECE = 1 << 18
_WHAT, _REMEDY = "truth file of `wavebatch simulate`", "simulate the strip again"

_LARGEST = 1e30
"""Largest value that is taken for a true one; sums and squares of larger ones overflow."""


class TruthReader(Closing):
    """Reads a truth file; raises InputError when `path` is none."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._reading = partial(reading_npz, self.path, _WHAT, _REMEDY)
        with self._reading():
            self._archive = zipfile.ZipFile(self.path)
            known = set(self._archive.namelist())
            lacking = [name for name in (*_DTYPES, _META) if f"{name}.npy" not in known]
            if lacking:
                raise InputError(f"{self.path}: no truth file of wavebatch simulate: lacks {', '.join(lacking)}")
            text = read_npz(self.path, {_META: ("U", 0)}, _WHAT, _REMEDY)[_META]
            self.meta: dict[str, Any] = json.loads(text.item())
            # The numbers that comparisons need.
            for key, least, most in (("noise_std", 0.0, 1e9), ("spacing", 1e-6, 1e6), ("packets", 0, 1 << 40)):
                value = self.meta[key]
                if type(value) not in (int, float) or not least <= value <= most:
                    raise ValueError(f"{key} of its description is {str(value)[:40]}")
            shape = self.meta["recording"]["pulse"]
            lobes = tuple((float(share), float(later), float(width)) for share, later, width in shape["lobes"])
            self.pulse = PulseModel(float(shape["sigma"]), float(shape["kappa"]), lobes)
            lobes = ((self.pulse.kappa, 0.0, self.pulse.sigma), *lobes)
            if not all(abs(h) <= 0.5 and abs(t) <= 1e4 and LEAST_SIGMA <= width <= 1e4 for h, t, width in lobes):
                raise ValueError(f"pulse of its description is {str(shape)[:40]}")

    def close(self) -> None:
        """Closes the file."""
        self._archive.close()

    def read_pieces(self, *names: str, size: int = _PIECE) -> Iterator[dict[str, np.ndarray]]:
        """The named columns, all per echo or all per packet, at most `size` rows at a time."""
        with self._reading(), contextlib.ExitStack() as stack:
            members = {name: stack.enter_context(self._archive.open(f"{name}.npy")) for name in names}
            lengths = set()
            for name, member in members.items():
                shape, _, dtype = read_array_header(member)
                if dtype != np.dtype(_DTYPES[name]) or len(shape) != 1:
                    raise InputError(f"{self.path}: column {name} is {dtype}, not {_DTYPES[name]}; {_REMEDY}")
                lengths.add(shape[0])
            if len(lengths) != 1:
                raise InputError(f"{self.path}: columns {', '.join(names)} differ in length; {_REMEDY}")
            (length,) = lengths
            for start in range(0, length, size):
                rows = min(size, length - start)
                yield {name: self._read_column(name, member, rows) for name, member in members.items()}

    def _read_column(self, name: str, member: IO[bytes], rows: int) -> np.ndarray:
        dtype = np.dtype(_DTYPES[name])
        data = member.read(rows * dtype.itemsize)
        if len(data) != rows * dtype.itemsize:
            raise InputError(f"{self.path}: ends too early; {_REMEDY}")
        values = np.frombuffer(data, dtype)
        if dtype.kind == "f" and (np.abs(values) > _LARGEST).any():
            most = np.nanmax(np.abs(values))
            raise InputError(f"{self.path}: column {name} holds {most:g}; {_REMEDY}")
        return values


WKT = (
    'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89",DATUM["European_Terrestrial_Reference_System_1989",'
    'SPHEROID["GRS 1980",6378137,298.257222101]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],'
    'PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],'
    'UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH],AUTHORITY["EPSG","25832"]]'
)
"""CRS of every simulated strip."""


@frozen
class StripOptions(CheckedOptions):
    """How a simulated strip is stored; its contents are those of the scene."""

    point_format: Literal[4, 5, 9, 10] = option(4, "LAS point format.")
    version: Literal["1.3", "1.4"] | None = option(
        None, "LAS version.", name="las-version", unset="1.3 for point formats 4 and 5, else 1.4"
    )
    internal: bool = option(True, "Store packets in the file or in a .wdp file.", opposite="external", unset="internal")
    scale: Annotated[float, Range(1e-5, 1.0)] = option(0.001, "Unit of the stored coordinates [m].", form="M")
    without_waveform: Annotated[float, Range(0.0, 1.0)] = option(
        0.01, "Share of the pulses without a packet.", form="SHARE"
    )
    keep_empty: bool = option(True, "Keep or leave out pulses without an echo.", opposite="drop-empty", unset="keep")
    toward: bool = option(
        True, "Direction of the packet vectors: toward or away from the sensor.", opposite="away", unset="toward"
    )

    @property
    def las_version(self) -> str:
        """The LAS version that is written."""
        return self.version or ("1.3" if self.point_format < 6 else "1.4")

    @property
    def most_returns(self) -> int:
        """Returns per pulse that the point format can number."""
        return 7 if self.point_format < 6 else 15


@dataclass(slots=True)
class StripSummary:
    """Counts of a simulated strip."""

    pulses: int = 0
    packets: int = 0
    points: int = 0
    echoes: int = 0
    """True echoes in the packets."""


@dataclass(slots=True)
class ReturnSummary:
    """Counts of a simulated cloud of discrete returns."""

    pulses: int = 0
    points: int = 0
    empty: int = 0
    """Pulses without any return."""


def simulate_strip(
    scene: Scene | str,
    target: Path,
    *,
    pulses: int,
    seed: int = 0,
    options: StripOptions | None = None,
    truth: Path | None = None,
    overwrite: bool = False,
    progress: Callable[[int], object] = lambda pulses: None,
) -> StripSummary:
    """Writes a strip of the scene to `target` (.las or .laz), and the truth to the .npz `truth`; returns the counts.

    Waveforms and truth of pulse k depend on scene and seed only, not on how many are made. The points are a vendor's
    returns: one per distinguishable echo, all returns of a pulse with one packet. The `return location` of a pulse is
    shifted by up to half a sample, so that the stored position of sample 0 is wrong by up to 7.5 cm.
    progress: called with the number of pulses done since the last call. Memory does not grow with `pulses`.
    Raises ConfigError for wrong values, InputError when a file exists or cannot be written; no file remains then.
    """
    scene, options = find_scene(scene), options or StripOptions()
    parts = _simulate_parts(scene, pulses, seed, progress)
    summary, whole = StripSummary(), seed_block(scene)
    with (
        NpzWriter(truth, _DTYPES, overwrite=overwrite) if truth else nullcontext() as truth_writer,
        FullwaveWriter(
            Path(target), version=options.las_version, point_format=options.point_format, internal=options.internal,
            digitizers=[scene.recording.digitizer], scales=(options.scale,) * 3, offsets=(EAST, NORTH, 0.0),
            wkt=WKT if options.las_version != "1.3" else None, toward=options.toward, overwrite=overwrite,
        ) as writer,
    ):  # fmt: skip
        for number, simulated in enumerate(parts):
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, 1)))
            block, n = simulated.block, len(simulated.block)
            returns = list_returns(
                simulated.truth, n, scene.recording, options.most_returns, keep_empty=options.keep_empty
            )
            # Always a whole block of random numbers: pulse k gets the same whatever the number of pulses.
            jitter = rng.uniform(-0.5, 0.5, whole)[:n] * scene.recording.spacing
            stored = rng.random(whole)[:n] >= options.without_waveform
            stored &= np.bincount(returns.pulse, minlength=n) > 0
            rows = np.flatnonzero(stored)
            offset = np.zeros(n, np.uint64)
            offset[rows] = writer.write_packets(block.samples[rows], 1)
            points, pulse = _fill_points(writer.dtype, simulated, returns, options.scale), returns.pulse
            size, time = block.samples.shape[1] * block.samples.itemsize, returns.time + jitter[pulse]
            fill_packets(points, stored[pulse], offset[pulse], size, time, block.direction[pulse])
            writer.write_points(points)
            kept = simulated.truth.take(np.flatnonzero(stored[simulated.truth.waveform]))
            if truth_writer:
                packet = summary.packets + np.cumsum(stored) - 1
                truth_writer.add({"packet_byte_offset": offset[rows], "packet_gps_time": block.gps_time[rows]})
                # The echoes in stored packets.
                waveform, rays = kept.waveform, simulated.rays
                xyz = block.origin[waveform] + kept.time[:, None] * block.direction[waveform]
                speed = np.linalg.norm(block.direction[waveform], axis=1)
                past_ground = np.einsum("ij,ij->i", xyz - rays.ground[waveform], block.direction[waveform]) / speed
                truth_writer.add({
                    "waveform": packet[waveform],
                    "byte_offset": offset[waveform],
                    "gps_time": block.gps_time[waveform],
                    "time": kept.time,
                    "amplitude": kept.amplitude,
                    "sigma": kept.sigma,
                    **dict(zip("xyz", xyz.T, strict=True)),
                    "incidence_angle": np.degrees(rays.incidence[waveform]),
                    "range": rays.distance[waveform] + past_ground,
                    "flags": kept.flags,
                    "isolated": find_isolated_echoes(kept),
                    "overlapped": (kept.flags & np.uint16(EchoFlag.OVERLAPPED)) != 0,
                })  # fmt: skip
            summary.pulses += n
            summary.packets += len(rows)
            summary.points += len(points)
            summary.echoes += len(kept)
        if truth_writer:
            recording = scene.recording
            meta = {
                "scene": scene.name,
                "seed": seed,
                "noise_std": recording.recorded_noise,
                "spacing": recording.spacing,
                "n_samples": recording.n_samples,
                "recording": asdict(recording),
                **asdict(summary),
            }
            writer.drafts.insert(0, truth_writer.complete({_META: json.dumps(meta, sort_keys=True)}))
        writer.commit()
    return summary


def simulate_returns(
    scene: Scene | str,
    target: Path,
    *,
    pulses: int,
    seed: int = 0,
    receiver: DiscreteReceiver | None = None,
    options: StripOptions | None = None,
    overwrite: bool = False,
    progress: Callable[[int], object] = lambda pulses: None,
) -> ReturnSummary:
    """Writes the returns that a discrete receiver has of the scene to `target` (.las or .laz); returns the counts.

    Pulse k of a scene and seed meets the same echoes as in simulate_strip. A return lies at the first echo that fires
    it; its intensity is ten times the summed amplitude. Of `options` only scale and point_format are used (4, 5, 9, 10
    become 1, 3, 6, 8). Errors as in simulate_strip.
    """
    scene, options, receiver = find_scene(scene), options or StripOptions(), receiver or DiscreteReceiver()
    if receiver.most > options.most_returns:
        raise ConfigError(
            f"point formats 4 and 5 number {options.most_returns} returns, the receiver has {receiver.most}; "
            "take 9 or 10"
        )
    parts = _simulate_parts(scene, pulses, seed, progress)
    summary = ReturnSummary()
    point_format = WITHOUT_WAVES[options.point_format]
    version, wkt = ((1, 4), WKT) if point_format >= 6 else ((1, 2), None)
    header = LasHeader.new(version, point_format, (options.scale,) * 3, (EAST, NORTH, 0.0), wkt)
    with PointFile(Path(target), header, build_dtype(point_format, ()), (), overwrite=overwrite) as writer:
        for simulated in parts:
            n = len(simulated.block)
            returns = receiver.list_returns(simulated.truth, n)
            writer.write(_fill_points(writer.dtype, simulated, returns, options.scale))
            summary.pulses += n
            summary.points += len(returns.pulse)
            summary.empty += n - len(np.unique(returns.pulse))
        writer.commit()
    return summary


def _simulate_parts(
    scene: Scene, pulses: int, seed: int, progress: Callable[[int], object]
) -> Iterator[Simulated]:
    """Pulses 0 to `pulses` of the scene, a seed block at a time; progress is called when the caller has used one."""
    if pulses < 1:
        raise ConfigError(f"a strip needs at least one pulse, not {pulses}")
    block = seed_block(scene)
    for first in range(0, pulses, block):
        n = min(block, pulses - first)
        yield simulate_seed_block(scene, seed, first // block).cut(0, n)
        progress(n)


def _fill_points(dtype: np.dtype, simulated: Simulated, returns: Returns, scale: float) -> np.ndarray:
    """Point records of the returns: every field but those of the packets."""
    block, pulse = simulated.block, returns.pulse
    points = np.zeros(len(pulse), dtype)
    xyz = block.origin[pulse] + returns.time[:, None] * block.direction[pulse]
    for axis, (name, origin) in enumerate((("X", EAST), ("Y", NORTH), ("Z", 0.0))):
        values = np.rint((xyz[:, axis] - origin) / scale)
        if len(values) and np.abs(values).max() >= 2**31:
            raise ConfigError(f"a scale of {scale} m is too fine for a strip this long; choose a coarser one")
        points[name] = values
    points["intensity"] = np.clip(np.rint(10 * returns.amplitude), 0, 65535)
    points["gps_time"] = block.gps_time[pulse]
    points["point_source_id"] = 1
    for number, name in enumerate(("red", "green", "blue", "nir")):
        if name in field_names(dtype):
            points[name] = 20_000 + 9_000 * number + 20 * (pulse % 256)
    ground_or_plants = np.where(returns.number == returns.total, 2, 5)
    scan_angle = simulated.rays.scan_angle[pulse]
    if "classification_flags" in field_names(dtype):
        points["bit_fields"] = returns.number | returns.total << 4
        points["classification"] = ground_or_plants
        points["classification_flags"] = 0x40
        points["scan_angle"] = np.rint(scan_angle / 0.006)
    else:
        points["bit_fields"] = returns.number | returns.total << 3 | 0x40
        points["raw_classification"] = ground_or_plants
        points["scan_angle_rank"] = np.rint(scan_angle)
    return points
