"""Calibration on reference targets: from the echoes on them to the constant of every channel of one strip.

`calibrating.calibrate_flight` reads the strips and calls `build_calibration` for each. Before you change it: pulse,
chain and energy must be those of `wavebatch run`, or the constant would not fit the columns that it is used for.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.geojson import describe_miss
from wavebatch.files.las.header import decode_text
from wavebatch.kernels.physics.radiometry import backscatter_error
from wavebatch.surveying.calibrating.compression import find_compression
from wavebatch.surveying.calibrating.strip_echoes import CalibrationOptions, EchoSource
from wavebatch.surveying.calibrating.target_constants import (
    LEAST_ECHOES,
    MOST_APART,
    MOST_STRANGE,
    combine_targets,
    measure_column,
    measure_target,
    summarise,
)
from wavebatch.surveying.calibrating.target_file import Target
from wavebatch.surveying.calibration import Calibration, ChannelConstant, TargetResult
from wavebatch.surveying.matching.setting import SCANNERS, keep_places, read_day, read_sensor_name
from wavebatch.surveying.sensor import SensorSource

LEAST_BENT = 0.01
"""Error by a compressing receiver from which it is said: a third of that of a target's reflectance."""

MOST_ECHOES = 200_000
"""Most echoes that a target uses: the error of its reflectance is far larger than that of so many."""


def build_calibration(
    source: EchoSource, targets: Sequence[Target], found: Sequence[np.ndarray], options: CalibrationOptions
) -> Calibration:
    """Turn the echoes on targets into a calibration.

    The constant is the median over targets of the median of each target's clean echoes that are alone in their
    waveform, lie on the target's plane, and have their whole footprint inside its outline.

    Parameters
    ----------
    source : EchoSource
        The strip.
    targets : sequence of Target
    found : sequence of arrays of ECHO
        Clean single echoes inside the outline of each target; all echoes where the options name a column.
    options : CalibrationOptions

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        Where no target gives a constant.

    Notes
    -----
    docs/algorithms.md 5.
    """
    divergence = options.divergence or source.system.radiometry.divergence
    measured = [
        measure_target(target, rows, divergence, options.reflectance_error)
        for target, rows in zip(targets, found, strict=not options.column)
    ]
    if options.column:
        measured = [measure_column(options.column, found[0], options.reflectance_error, source.air)]
    results = [result for result, _, _ in measured]
    whole = combine_targets(results, _fit_errors([used for _, used, _ in measured]))
    if whole is None:
        miss = describe_miss([target.corners for target in targets], source.reader.facts.header) if targets else ""
        reasons = miss or "; ".join(f"{result.name}: {result.refused}" for result in results)
        raise InputError(f"{source.path}: no target gives a constant ({reasons}); check coordinates and targets")
    used = np.concatenate([rows for _, rows, _ in measured])
    ranging = math.hypot(measure_ranging(source.sensor, used["distance"], source.air), source.sent.growth)
    bent, compressed = _compare_compression(source, used)
    channels = tuple(
        describe_channel(replace(row, relative_error=math.hypot(row.relative_error, ranging)), source)
        for row in _measure_channels(measured)
    )
    # The constant of all together serves files of tools that know no channels; its error covers how far they differ.
    apart = float(np.std([row.constant for row in channels])) / whole.constant
    facts, pulse = source.reader.facts, source.system.sigma_ref
    decomposer = next(step.stage.name for step in source.chain.steps if step.stage.kind == "decompose")
    return Calibration(
        constant=whole.constant,
        relative_error=math.hypot(whole.relative_error, apart, ranging),
        attenuation=source.air,
        haze=source.haze,
        divergence=divergence,
        strip=source.path.name,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        conditions=f"sensor from {source.sensor.kind}, pulse {pulse:.4g} ns, {whole.echoes} echoes",
        sensor=read_sensor_name(facts),
        software=decode_text(facts.header.generating_software).strip(),
        rate=source.setting.rate,
        flight=read_day(source.reader),
        chain=source.choice.chain.name,
        decomposer=decomposer,
        places=keep_places(source.setting.places),
        height=float(np.median(-used["ray"][:, 2] * used["distance"])),
        distance=float(np.median(used["distance"])),
        fingerprint=take_fingerprint(source.path, facts.packets.file),
        targets=tuple(_split_targets(measured) if len(channels) > 1 else results),
        channels=channels,
        **source.sent.describe(),
        bent=bent,
        notes=(*_list_doubts(source, results, channels, options), *compressed),
    )


def _fit_errors(parts: Sequence[np.ndarray]) -> np.ndarray:
    rows = np.concatenate(parts)
    return rows["light_err"] / rows["light"]


def measure_ranging(sensor: SensorSource, distance: np.ndarray, attenuation: float) -> float:
    """Return the relative error of the constant from that of the sensor's position, which all echoes share."""
    middle = np.array([np.median(distance)])
    return float(np.nan_to_num(backscatter_error(np.zeros(1), middle, sensor.error, 0.0, attenuation)[0]))


def _compare_compression(source: EchoSource, used: np.ndarray) -> tuple[float, list[str]]:
    """By how much constants are off for echoes that a compressing receiver makes darker or brighter than the targets,
    relative, and the lines about it; used: array of ECHO."""
    most, lines = 0.0, []
    for channel, found in find_compression(source.reader, source.scan, source.system).items():
        targets = used["amplitude"][used["channel"] == channel]
        growth = found.compare(targets) if len(targets) else 0.0
        most = max(most, growth)
        if growth > LEAST_BENT:
            low, high = np.quantile(found.amplitude, [0.05, 0.95]).tolist()
            off = [found.factor * (float(np.mean(targets)) - amplitude) for amplitude in (low, high)]
            lines.append(
                f"the receiver of digitizer {channel // SCANNERS}"
                + (f", scanner channel {channel % SCANNERS}," if channel % SCANNERS else "")
                + " compresses, by the shape of its echoes: those of "
                f"{low:.0f} to {high:.0f} DN are {off[0]:+.1%} to {off[1]:+.1%} off against the targets': the error of "
                f"the constant grows by {growth:.1%}; take targets as bright as the surfaces that you measure"
            )
    return most, lines


def _measure_channels(measured: Sequence[tuple[TargetResult, np.ndarray, np.ndarray]]) -> list[ChannelConstant]:
    """A constant for each channel that saw targets; channels with too few echoes are left out."""
    channels = np.unique(np.concatenate([rows["channel"] for _, rows, _ in measured])).tolist()
    found = []
    for channel in channels:
        results, parts = [], []
        for result, rows, constant in measured:
            mine = rows["channel"] == channel
            if mine.sum() >= LEAST_ECHOES:
                results.append(summarise(result, constant[mine]))
                parts.append(rows[mine])
        combined = combine_targets(results, _fit_errors(parts), channel) if results else None
        if combined is not None:
            found.append(combined)
    return found


def _split_targets(measured: Sequence[tuple[TargetResult, np.ndarray, np.ndarray]]) -> Iterator[TargetResult]:
    """What each channel has of each target: channels differ in gain, so that no median is common to them."""
    for result, rows, constant in measured:
        if result.constant is None:
            yield result
        for channel in np.unique(rows["channel"]).tolist():
            name = f"digitizer {channel // SCANNERS}, scanner channel {channel % SCANNERS}"
            yield replace(summarise(result, constant[rows["channel"] == channel]), channel=name)


def describe_channel(row: ChannelConstant, source: EchoSource) -> ChannelConstant:
    """Return the row with how its channel records, for the comparison with other strips."""
    digitizer = source.reader.facts.digitizers[row.digitizer]
    system = source.system.digitizers.get(row.digitizer, source.system)
    return replace(
        row,
        noise_dn=system.noise.std,
        brightest=source.setting.brightest.get((row.digitizer, row.scanner)),
        scene=source.setting.scenes.get((row.digitizer, row.scanner), ()),
        bits=digitizer.bits,
        samples=digitizer.n_samples,
        spacing_ns=digitizer.spacing,
        gain=digitizer.gain,
        pulse_ns=system.sigma_ref * FWHM_PER_SIGMA,
    )


def _list_doubts(
    source: EchoSource,
    results: Sequence[TargetResult],
    channels: Sequence[ChannelConstant],
    options: CalibrationOptions,
):
    """What a person should look at before the calibration is used."""
    yield from filter(None, (source.sensor.doubt(), *source.sent.notes))
    for result in results:
        if result.apart > MOST_APART:
            which, why = "parts", "several surfaces? Check its outline"
            if options.column:
                which, why = "dark and bright echoes", "is it the reflectance, of this channel?"
            yield f"{result.name}: constants of its {which} scatter by {result.apart:.0%}, which the error holds: {why}"
        if options.column and result.air is None and source.air:
            yield (
                f"{result.name}: its ranges are too alike to show whether it still holds the air: the error of the "
                f"constant, {100 * (result.relative_error or 0.0):.1f} %, holds all of that; ask the vendor, or take "
                "targets"
            )
        elif options.column and result.air is not None and result.air > 0.5:
            yield f"{result.name}: it falls with the range as if it still held {result.air:.0%} of the air: taken off"
        if result.edge is not None:
            yield (
                f"{result.name}: echoes near its outline give a constant {100 * result.edge:+.1f} % off that of its "
                "middle: check outline and coordinates; the error holds it"
            )
        if result.strange > MOST_STRANGE:
            yield (
                f"{result.name}: {100 * result.strange:.0f} % of its echoes are darker or brighter than the target by "
                "far: check its outline and the coordinates; the error holds it"
            )
    good = [(one.constant, one.relative_error or 0.0) for one in results if one.constant is not None]
    limits = [abs(np.log(a / b)) / (3 * np.hypot(a_err, b_err))
              for i, (a, a_err) in enumerate(good) for b, b_err in good[:i]]  # fmt: skip
    ratio = max(good)[0] / min(good)[0]
    # Channels may have different constants, so that targets that they see unequally may differ too.
    if limits and max(limits) > 1 and len(channels) < 2:
        yield f"constants of the targets differ by a factor of {ratio:.2f}: check reflectances and coordinates"
