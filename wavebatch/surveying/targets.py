"""Calibration on reference targets: reads a file of targets and measures the constant from a strip over them.

`wavebatch calibrate` calls `load_targets` and `calibrate_strip`.
Before you change it: the angle of each echo comes from the plane of its target, so a bent target biases the constant.
"""

from __future__ import annotations

import csv
import datetime
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import MAD_TO_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.geojson import find_inside, read_features
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.text_file import read_text
from wavebatch.kernels.geometry.planes import fit_normal
from wavebatch.kernels.physics.radiometry import calibrate_echoes
from wavebatch.stages.chain_file import load_profile
from wavebatch.surveying import Survey, survey_blocks
from wavebatch.surveying.calibration import Calibration, ChannelConstant, TargetResult
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.surveying.sensor import SensorRequest, SensorSource, find_sensor
from wavebatch.surveying.systems.saved_check import check_saved

LEAST_ECHOES = 10
"""A target with fewer echoes is left out: a median of fewer is no better than one echo."""

MOST_ECHOES = 200_000
"""Most echoes that a target uses: the error of its reflectance is far larger than that of so many."""

SCANNERS = 4
"""Scanner channels of LAS points (0 to 3). A channel number here is SCANNERS x digitizer + scanner channel."""

_CORNERS = 64
"""Corners of the polygon that stands for a circle."""
_BLOCK = 8192
"""Waveforms that are read at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """An area of known reflectance."""

    name: str
    reflectance: float
    corners: np.ndarray
    """Corners of its outline, f8 (k, 2) [m]."""
    incidence: float | None = None
    """Angle between ray and normal [deg]; None: taken from the plane of the target's echoes."""

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return whether points at x, y, f8 (n,) [m], lie inside, bool (n,)."""
        return find_inside([self.corners], x, y)


def load_targets(path: Path | str) -> list[Target]:
    """Read reference targets from a GeoJSON or CSV file.

    Parameters
    ----------
    path : path
        GeoJSON: polygons with the property reflectance. CSV: the column reflectance, and x, y, radius, or vertices as
        `x y x y x y ...`. Both may have name and incidence [deg]. Coordinates are those of the strip.

    Returns
    -------
    list of Target

    Raises
    ------
    ConfigError
        In one line, where the file cannot be read, is empty or holds a wrong target.
    """
    text = read_text(path, "target file", 1 << 30)
    lines = io.StringIO(text, newline=None)
    rows = _read_geojson(text, path) if text.lstrip().startswith("{") else list(csv.DictReader(lines))
    targets = [_read_target(row, f"{path}: target {number}") for number, row in enumerate(rows, 1)]
    if not targets:
        raise ConfigError(f"{path}: no target in it; give polygons (GeoJSON) or rows (CSV)")
    return targets


def _read_geojson(text: str, path: Path | str) -> list[dict[str, Any]]:
    rows = []
    for properties, rings in read_features(text, path):
        if len(rings) > 1:
            raise ConfigError(f"{path}: a target has {len(rings)} rings; make every part a target, without holes")
        corners = " ".join(f"{float(x)!r} {float(y)!r}" for x, y in rings[0])
        rows.append({**properties, "vertices": corners})
    return rows


def _read_target(row: Mapping[str, Any], where: str) -> Target:
    fields = {str(key).strip().lower(): value for key, value in row.items() if value not in (None, "")}
    try:
        reflectance = float(fields["reflectance"])
        incidence = float(fields["incidence"]) if "incidence" in fields else None
        if "vertices" in fields:
            corners = np.array(str(fields["vertices"]).split(), np.float64).reshape(-1, 2)
        else:
            angle = np.arange(_CORNERS) * (2 * np.pi / _CORNERS)
            circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) * float(fields["radius"])
            corners = circle + [float(fields["x"]), float(fields["y"])]
    except KeyError as error:
        raise ConfigError(
            f"{where}: {error.args[0]} is missing; a target has reflectance, and x, y, radius or vertices"
        ) from error
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: not numbers: {error}") from error
    if not 0 < reflectance <= 1.5 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ConfigError(f"{where}: reflectance must lie in 0 to 1.5, and the outline needs three corners")
    if incidence is not None and not 0 <= incidence < 85:
        raise ConfigError(f"{where}: incidence must lie in 0 to 85 degrees, it is {incidence:g}")
    return Target(str(fields.get("name", where.rsplit(": ", 1)[-1])), reflectance, corners, incidence)


def calibrate_strip(
    path: Path,
    targets: Sequence[Target],
    *,
    sensor: SensorRequest | None = None,
    system: SystemPulse | None = None,
    survey: Survey | None = None,
    force: bool = False,
    attenuation: float = 0.22,
    divergence: float | None = None,
    reflectance_error: float = 0.03,
    direction: str = "auto",
) -> Calibration:
    """Measure the calibration constant of a strip over reference targets.

    It is the median over targets of the median of each target's clean echoes that are alone in their waveform.

    Parameters
    ----------
    path : Path
        The strip.
    targets : sequence of Target
    sensor : SensorRequest, optional
        Where the sensor's positions come from; by default from the strip's packets.
    system : SystemPulse, optional
        The pulse; by default from a survey of the strip.
    survey : Survey, optional
        A saved survey, in place of `system`: checked against the strip.
    force : bool
        Use the survey also where the strip contradicts it.
    attenuation : float
        Of the air, one way [dB/km].
    divergence : float, optional
        Full angle of the beam between the 1/e^2 points [mrad].
    reflectance_error : float
        Standard deviation of the targets' reflectances, relative.
    direction : str
        Where packet vectors point: auto, toward or away.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        Where no target has enough echoes, the sensor's position is unknown, or the strip contradicts the survey.

    Notes
    -----
    docs/algorithms.md 5.
    """
    with StripReader(path, direction=direction) as reader, reader.scan() as scan:
        source = find_sensor(reader, scan, sensor or SensorRequest())
        if source.kind == "none":
            raise InputError(f"{path}: the sensor's position is unknown: give --trajectory or --flight-height")
        check_saved(reader, scan, survey, force=force)
        system = survey.system if survey is not None else system
        pulse = system or survey_blocks(read_sample(reader, scan)).system
        found = [np.concatenate(parts)[:MOST_ECHOES] for parts in _collect(reader, scan, targets, source, pulse)]
        fingerprint = take_fingerprint(path, reader.facts.packets.file)
    results = [_evaluate(target, found[i], attenuation) for i, target in enumerate(targets)]
    whole = _combine([result for result, _ in results], reflectance_error)
    if whole is None:
        counts = ", ".join(f"{result.name}: {result.echoes} echoes" for result, _ in results)
        raise InputError(f"{path}: no target has {LEAST_ECHOES} clean single echoes ({counts}); check the coordinates")
    channels = _calibrate_channels(targets, [part for _, part in results], reflectance_error)
    # Channels that no target was seen by get the constant of all together: its error covers how far channels differ.
    apart = float(np.std([row.constant for row in channels])) / whole.constant if channels else 0.0
    conditions = f"sensor from {source.kind}, pulse {pulse.sigma_ref:.4g} ns, {whole.echoes} echoes"
    return Calibration(
        constant=whole.constant,
        relative_error=float(np.hypot(whole.relative_error, apart)),
        attenuation=attenuation,
        divergence=divergence,
        strip=Path(path).name,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        conditions=conditions,
        fingerprint=fingerprint,
        targets=tuple(result for result, _ in results),
        channels=channels,
    )


def _collect(
    reader: StripReader, scan: Any, targets: Sequence[Target], source: SensorSource, system: SystemPulse
) -> list[list[np.ndarray]]:
    """Clean single echoes on every target; only waveforms with a return near a target are decomposed, to save time.

    A row is x, y, z, range, amplitude, sigma, unit direction (3), channel.
    """
    chain, found = load_profile("balanced"), [[np.empty((0, 10))] for _ in targets]
    corners = np.concatenate([target.corners for target in targets])
    low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
    for block in reader.all_blocks(scan, _BLOCK):
        xy = block.returns.xyz[:, :2]
        near = np.unique(block.returns.waveform[((xy >= low) & (xy <= high)).all(axis=1)])
        if len(near):
            part = source.fill(block.rows(near))
            _add_echoes(part, chain.run(part, system), targets, found)
    return found


def _add_echoes(block: WaveformBlock, echoes: EchoTable, targets: Sequence[Target], found: list[list]) -> None:
    alone = echoes.count(len(block))[echoes.waveform] == 1
    echoes = echoes.take(np.flatnonzero(alone & ((echoes.flags & np.uint16(UNCLEAN | EchoFlag.UNANCHORED)) == 0)))
    xyz = np.stack([echoes.attributes[name] for name in "xyz"], axis=1)
    ray = xyz - block.sensor[echoes.waveform]
    distance = np.sqrt((ray * ray).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        columns = [xyz, distance, echoes.amplitude, echoes.sigma, ray / distance[:, None]]
    scanner = 0 if block.scanner is None else block.scanner[echoes.waveform].astype(float)
    table = np.column_stack([*columns, np.full(len(echoes), SCANNERS * block.digitizer.index) + scanner])
    known = np.isfinite(table).all(axis=1)
    for target, parts in zip(targets, found, strict=True):
        if sum(map(len, parts)) < MOST_ECHOES:
            parts.append(table[known & target.contains(xyz[:, 0], xyz[:, 1])])


def _evaluate(target: Target, rows: np.ndarray, attenuation: float) -> tuple[TargetResult, np.ndarray]:
    """What one target gave, and the channel and the constant of each of its echoes, f8 (n, 2)."""
    if len(rows) < LEAST_ECHOES:
        return TargetResult(target.name, target.reflectance, len(rows)), np.empty((0, 2))
    xyz, (distance, amplitude, sigma), unit = rows[:, :3], rows[:, 3:6].T, rows[:, 6:9]
    if target.incidence is None:
        angle = np.arccos(np.clip(np.abs(unit @ fit_normal(xyz)), 0.0, 1.0))
    else:
        angle = np.full(len(rows), np.radians(target.incidence))
    constant = calibrate_echoes(target.reflectance, angle, distance, amplitude, sigma, attenuation)
    result = _summarise(target, constant)
    return replace(result, incidence_deg=float(np.degrees(np.median(angle)))), np.column_stack([rows[:, 9], constant])


def _summarise(target: Target, constant: np.ndarray) -> TargetResult:
    """Median and relative robust spread of constants (n,); their number alone where they are too few."""
    if len(constant) < LEAST_ECHOES:
        return TargetResult(target.name, target.reflectance, len(constant))
    middle = float(np.median(constant))
    spread = MAD_TO_STD * float(np.median(np.abs(constant - middle))) / middle
    return TargetResult(target.name, target.reflectance, len(constant), middle, spread)


def _combine(results: Sequence[TargetResult], reflectance_error: float, channel: int = 0) -> ChannelConstant | None:
    """The constant of several targets and its error; None where all of them have too few echoes."""
    good = [result for result in results if result.constant is not None]
    if not good:
        return None
    constants = np.array([result.constant for result in good])
    constant = float(np.median(constants))
    inner = float(np.median([result.spread / np.sqrt(result.echoes) for result in good]))
    between = float(np.std(constants, ddof=1) / constant / np.sqrt(len(good))) if len(good) > 1 else 0.0
    return ChannelConstant(
        digitizer=channel // SCANNERS,
        scanner=channel % SCANNERS,
        constant=constant,
        relative_error=float(np.sqrt(reflectance_error**2 / len(good) + inner**2 + between**2)),
        spread=float(np.median([result.spread for result in good])),
        echoes=sum(result.echoes for result in good),
    )


def _calibrate_channels(
    targets: Sequence[Target], parts: Sequence[np.ndarray], reflectance_error: float
) -> tuple[ChannelConstant, ...]:
    """A constant per channel, where several channels saw the targets; channels with too few echoes are left out.

    parts: channel and constant of each echo, f8 (n, 2), one array per target.
    """
    channels = np.unique(np.concatenate(parts)[:, 0]).astype(int).tolist()
    if len(channels) < 2:
        return ()
    found = []
    for channel in channels:
        pairs = zip(targets, parts, strict=True)
        results = [_summarise(target, part[part[:, 0] == channel, 1]) for target, part in pairs]
        found.append(_combine(results, reflectance_error, channel))
    return tuple(row for row in found if row is not None)
