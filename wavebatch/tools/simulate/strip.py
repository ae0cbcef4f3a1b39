"""Scenes to strips: points with wave packets as vendors deliver them, and the truth beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.writer import FullwaveWriter
from wavebatch.stages.score import find_isolated
from wavebatch.tools.simulate.blocks import SEED_BLOCK, Simulated, cut_block, simulate_seed_block
from wavebatch.tools.simulate.geometry import EAST, NORTH, Flight, Rays
from wavebatch.tools.simulate.returns import Returns, list_returns
from wavebatch.tools.simulate.scenes import Scene, find_scene
from wavebatch.tools.simulate.truth import TruthWriter

WKT = (
    'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89",DATUM["European_Terrestrial_Reference_System_1989",'
    'SPHEROID["GRS 1980",6378137,298.257222101]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],'
    'PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],'
    'UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH],AUTHORITY["EPSG","25832"]]'
)
"""CRS of every simulated strip."""


@dataclass(frozen=True, slots=True)
class StripOptions:
    """How a simulated strip is stored; what it holds is the scene's matter."""

    version: str | None = None
    """LAS version; None: 1.3 for point formats 4 and 5, 1.4 for 9 and 10."""
    point_format: int = 4
    internal: bool = True
    """Packets in the file itself, else in a .wdp beside it."""
    scale: float = 0.001
    """Unit of the stored coordinates [m]."""
    without_waveform: float = 0.01
    """Share of the pulses whose points have no packet (descriptor index 0)."""
    keep_empty: bool = True
    """A pulse without any echo keeps its packet and one point; else it is left out."""
    toward: bool = True
    """The stored vectors point to the sensor."""

    def __post_init__(self) -> None:
        if self.point_format not in (4, 5, 9, 10):
            raise ConfigError(f"point format {self.point_format} holds no waveforms; choose 4, 5, 9 or 10")
        if not 0 <= self.without_waveform <= 1 or not 1e-5 <= self.scale <= 1:
            raise ConfigError("the share without waveform must lie in 0 to 1, the coordinates' scale in 1e-5 to 1 m")

    @property
    def las_version(self) -> str:
        """The LAS version that is written."""
        return self.version or ("1.3" if self.point_format < 6 else "1.4")


@dataclass(frozen=True, slots=True)
class StripSummary:
    """What a simulated strip holds."""

    pulses: int
    packets: int
    points: int
    echoes: int
    """True echoes in the packets."""


def simulate_strip(
    scene: Scene | str,
    target: Path,
    *,
    pulses: int,
    seed: int = 0,
    options: StripOptions | None = None,
    truth: Path | None = None,
    flight: Flight | None = None,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> StripSummary:
    """Writes a strip of the scene to `target` (.las or .laz), and the truth to the .npz `truth`; returns the counts.

    Waveforms and truth of pulse k depend on scene and seed only, not on how many are made. The points are a vendor's
    returns: one per distinguishable echo, all returns of a pulse with one packet, their `return location` shifted
    together by up to half a sample, so that sample 0 lies up to 7.5 cm from where the location says.
    progress: called with the number of pulses done since the last call. Memory does not grow with `pulses`.
    Raises ConfigError for wrong values, InputError when a file exists or cannot be written; nothing remains then.
    """
    scene = find_scene(scene) if isinstance(scene, str) else scene
    options = options or StripOptions()
    if pulses < 1:
        raise ConfigError(f"a strip needs at least one pulse, not {pulses}")
    notes = TruthWriter(truth, overwrite=overwrite) if truth else None
    try:
        with _open_writer(target, scene, options, overwrite) as writer:
            summary = StripSummary(0, 0, 0, 0)
            for number in range(-(-pulses // SEED_BLOCK)):
                n = min(SEED_BLOCK, pulses - number * SEED_BLOCK)
                simulated = cut_pulses(simulate_seed_block(scene, seed, number, flight), n)
                rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, 1)))
                summary = _write_block(writer, notes, simulated, scene, options, rng, summary)
                if progress:
                    progress(n)
            _publish(writer, notes, _describe(scene, seed, summary))
    finally:
        if notes:
            notes.discard()
    return summary


def _publish(writer: FullwaveWriter, notes: TruthWriter | None, meta: dict) -> None:
    """Both files or none: the strip appears last."""
    if notes:
        notes.publish(meta)
    try:
        writer.commit()
    except BaseException:
        if notes:
            notes.withdraw()
        raise


def _open_writer(target: Path, scene: Scene, options: StripOptions, overwrite: bool) -> FullwaveWriter:
    return FullwaveWriter(
        Path(target),
        version=options.las_version,
        point_format=options.point_format,
        internal=options.internal,
        digitizers=[scene.recording.digitizer],
        scales=(options.scale,) * 3,
        offsets=(EAST, NORTH, 0.0),
        wkt=WKT if options.las_version != "1.3" else None,
        toward=options.toward,
        overwrite=overwrite,
    )


def cut_pulses(simulated: Simulated, n: int) -> Simulated:
    """The first n pulses."""
    if n == len(simulated.block):
        return simulated
    rays = simulated.rays
    columns = {name: getattr(rays, name)[:n] for name in Rays.__slots__}
    return Simulated(*cut_block(simulated.block, simulated.truth, 0, n), Rays(**columns))


def _write_block(
    writer: FullwaveWriter,
    notes: TruthWriter | None,
    simulated: Simulated,
    scene: Scene,
    options: StripOptions,
    rng: np.random.Generator,
    before: StripSummary,
) -> StripSummary:
    block, n = simulated.block, len(simulated.block)
    most = 7 if options.point_format < 6 else 15
    returns = list_returns(simulated.truth, n, scene.recording, most, keep_empty=options.keep_empty)
    jitter = rng.uniform(-0.5, 0.5, SEED_BLOCK)[:n] * scene.recording.spacing
    stored = rng.random(SEED_BLOCK)[:n] >= options.without_waveform
    stored &= np.bincount(returns.pulse, minlength=n) > 0
    rows = np.flatnonzero(stored)
    offset = np.zeros(n, np.uint64)
    offset[rows] = writer.write_packets(block.samples[rows], 1)
    writer.write_points(_fill_points(writer.dtype, simulated, returns, jitter, stored, offset, options))
    packet = np.full(n, -1)
    packet[rows] = before.packets + np.arange(len(rows))
    kept = simulated.truth.take(np.flatnonzero(stored[simulated.truth.waveform]))
    if notes:
        notes.add({"packet_byte_offset": offset[rows], "packet_gps_time": block.gps_time[rows]})
        notes.add(_list_truth(kept, simulated, packet, offset))
    return StripSummary(
        before.pulses + n, before.packets + len(rows), before.points + len(returns.pulse), before.echoes + len(kept)
    )


def _fill_points(
    dtype: np.dtype,
    simulated: Simulated,
    returns: Returns,
    jitter: np.ndarray,
    stored: np.ndarray,
    offset: np.ndarray,
    options: StripOptions,
) -> np.ndarray:
    """Point records of the returns, every field set."""
    block, pulse = simulated.block, returns.pulse
    points = np.zeros(len(pulse), dtype)
    place_points(points, locate(block, pulse, returns.time), options)
    points["intensity"] = np.clip(np.rint(10 * returns.amplitude), 0, 65535)
    points["gps_time"] = block.gps_time[pulse]
    points["point_source_id"] = 1
    last = returns.number == returns.total
    set_returns(points, returns, np.where(last, 2, 5), simulated.rays.scan_angle[pulse])
    for number, name in enumerate(("red", "green", "blue", "nir")):
        if name in dtype.names:
            points[name] = 20_000 + 9_000 * number + 20 * (pulse % 256)
    has = stored[pulse]
    samples = block.samples
    points["wavepacket_index"] = has
    points["wavepacket_offset"] = np.where(has, offset[pulse], 0)
    points["wavepacket_size"] = np.where(has, samples.shape[1] * samples.itemsize, 0)
    points["return_point_wave_location"] = np.where(has, (returns.time + jitter[pulse]) * PS_PER_NS, 0)
    for axis, name in enumerate(("x_t", "y_t", "z_t")):
        points[name] = np.where(has, -block.direction[pulse, axis] / PS_PER_NS, 0)
    return points


def locate(block: WaveformBlock, pulse: np.ndarray, time: np.ndarray) -> np.ndarray:
    """True position of what lies `time` ns after sample 0 of the pulses, f8 (k, 3) [m]."""
    return block.origin[pulse] + time[:, None] * block.direction[pulse]


def place_points(points: np.ndarray, xyz: np.ndarray, options: StripOptions) -> None:
    """Coordinates as the file stores them."""
    for axis, (name, origin) in enumerate((("X", EAST), ("Y", NORTH), ("Z", 0.0))):
        values = np.rint((xyz[:, axis] - origin) / options.scale)
        if len(values) and np.abs(values).max() >= 2**31:
            raise ConfigError(f"a scale of {options.scale} m is too fine for a strip this long; choose a coarser one")
        points[name] = values


def set_returns(points: np.ndarray, returns: Returns, kind: np.ndarray, scan_angle: np.ndarray) -> None:
    """Return numbers, class, scan angle and flags in the fields of the point format."""
    if "classification_flags" in points.dtype.names:
        points["bit_fields"] = returns.number | returns.total << 4
        points["classification"] = kind
        points["classification_flags"] = 0x40
        points["scan_angle"] = np.rint(scan_angle / 0.006)
    else:
        points["bit_fields"] = returns.number | returns.total << 3 | 0x40
        points["raw_classification"] = kind
        points["scan_angle_rank"] = np.rint(scan_angle)


def _list_truth(kept: EchoTable, simulated: Simulated, packet: np.ndarray, offset: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of the truth file for the echoes in stored packets."""
    block, rows = simulated.block, kept.waveform
    xyz = locate(block, rows, kept.time)
    speed = np.linalg.norm(block.direction[rows], axis=1)
    behind = np.einsum("ij,ij->i", xyz - simulated.rays.ground[rows], block.direction[rows]) / speed
    return {
        "waveform": packet[rows],
        "byte_offset": offset[rows],
        "gps_time": block.gps_time[rows],
        "time": kept.time,
        "amplitude": kept.amplitude,
        "sigma": kept.sigma,
        "x": xyz[:, 0],
        "y": xyz[:, 1],
        "z": xyz[:, 2],
        "incidence_angle": np.degrees(simulated.rays.incidence[rows]),
        "range": simulated.rays.distance[rows] + behind,
        "flags": kept.flags,
        "isolated": find_isolated(kept),
        "overlapped": (kept.flags & np.uint16(EchoFlag.OVERLAPPED)) != 0,
    }


def _describe(scene: Scene, seed: int, summary: StripSummary) -> dict:
    """What the truth file says of the whole strip."""
    recording = scene.recording
    return {
        "scene": scene.name,
        "seed": seed,
        "noise_std": recording.recorded_noise,
        "spacing": recording.spacing,
        "n_samples": recording.n_samples,
        "recording": asdict(recording),
        **asdict(summary),
    }
