"""Calibration on reference targets: from the echoes on them to the constant of every channel of one strip.

`calibrating.calibrate_flight` reads the strips and calls `build_calibration` for each. Before you change it: pulse,
chain and energy must be those of `wavebatch run`, or the constant would not fit the columns that it is used for.
`measure_target` gives the constant of a target and channel, `combine_targets` that of a channel, with an error that
holds angle, edges, scatter and disagreement. An unusable target is rejected, with the reason; no value is guessed.

`find_compression`: whether a receiver records strong light too low, by the shape of strong echoes beside that of weak
ones: a constant from bright targets is too large for dark surfaces then. Slopes, roughness and the pulse's misfit
change the shape of echoes too, but not more where these are strong.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import group_medians, robust_std
from wavebatch.core.units import ASSUMED_DIVERGENCE, FWHM_PER_SIGMA, INSET, MAD_TO_STD, MEDIAN_ERROR
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.geojson import describe_miss
from wavebatch.files.las.header import decode_text
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.kernels.geometry.planes import fit_facet
from wavebatch.kernels.physics.radiometry import backscatter_error
from wavebatch.stages.clean import clean_block
from wavebatch.surveying.calibrating.calibration_files import LEAST_REFLECTANCE, Target
from wavebatch.surveying.calibrating.strip_echoes import CalibrationOptions, EchoSource
from wavebatch.surveying.calibration import Calibration, ChannelConstant, TargetResult
from wavebatch.surveying.matching.setting import SCANNERS, keep_places, read_day, read_sensor_name
from wavebatch.surveying.measuring.noise_and_width import find_single
from wavebatch.surveying.measuring.residuals import decompose_sample, describe_own, subtract_echoes
from wavebatch.surveying.sensor import SensorSource

SAMPLE, BLOCK = 4096, 512
"""Waveforms that are looked at, and so many at a time: each takes 100 bytes per sample."""

SHAPE_CLASSES, LEAST_OF_CLASS = 8, 12
"""Classes of echoes by amplitude whose medians are compared, and fewest echoes of each."""

SURE = 4.0
"""Standard errors from which a receiver compresses."""


class Compression(NamedTuple):
    """What a channel loses of strong light."""

    factor: float
    """Share of its light that an echo loses per DN of its amplitude [1/DN]; 0 where no shape of an echo shows it."""
    amplitude: np.ndarray
    """Of the strip's lone echoes, f8 (k,) [DN]."""

    def compare(self, amplitude: np.ndarray) -> float:
        """Return the root mean square of what the strip's echoes lose against those of targets, of amplitudes (n,)."""
        return self.factor * float(np.sqrt(np.mean((self.amplitude - np.mean(amplitude)) ** 2)))


def find_compression(reader: StripReader, scan: StripScan, system: SystemPulse) -> dict[int, Compression]:
    """Measure what the channels of a strip lose of strong light.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    system : SystemPulse
        Of the survey.

    Returns
    -------
    dict of int to Compression
        By the number of the channel; without those of few clear echoes.

    Notes
    -----
    A receiver that records x - c x^2 leaves of an echo -c times what the fit's amplitude, time and width cannot explain
    of its square. Receivers that bend later, like the hyperbolic tangent, lose up to 2.4 times less than this says.
    docs/algorithms.md 5.
    """
    parts: dict[int, list[np.ndarray]] = {}
    for block in reader.sample_blocks(scan, SAMPLE, BLOCK):
        own = system.of(block)
        for channel, rows in _describe(clean_block(block, own), own):
            parts.setdefault(channel, []).append(rows)
    found = {channel: _judge(*np.concatenate(some, axis=1)) for channel, some in parts.items()}
    return {channel: one for channel, one in found.items() if one is not None}


def _describe(block: WaveformBlock, system: SystemPulse) -> Iterator[tuple[int, np.ndarray]]:
    """Channels, and of their lone echoes f8 (3, k): amplitude, share of the squared echo that is missing, and the light
    that goes with that."""
    echoes = decompose_sample(block, system, free_levels=True)
    echoes = echoes.take(np.flatnonzero(find_single(echoes, len(block), system)))
    if not len(echoes):
        return
    part = block.rows(echoes.waveform)
    echoes = replace(echoes, waveform=np.arange(len(echoes), dtype=np.int32))
    shape, main = describe_own(system, echoes, block.spacing)
    (height, time, width), amplitude = main.T[:, :, None], echoes.amplitude.astype(np.float64)
    basis = np.stack(evaluate_pulse(shape, np.arange(block.samples.shape[1], dtype=np.float64), time, width), axis=1)
    left = subtract_echoes(part, system, echoes).astype(np.float64)
    basis *= np.isfinite(left)[:, None]
    left = np.nan_to_num(left) / height
    missing = (basis[:, 0] * height / amplitude[:, None]) ** 2
    inner = np.einsum("nis,njs->nij", basis, basis) + 1e-9 * np.eye(3)  # a pulse between two samples has no width
    taken = np.linalg.solve(inner, np.einsum("nis,ns->ni", basis, missing)[..., None])[..., 0]
    rest = missing - np.einsum("ni,nis->ns", taken, basis)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = -np.einsum("ns,ns->n", left, rest) / np.einsum("ns,ns->n", rest, rest)
    rows = np.stack([amplitude, share, taken[:, 0] + taken[:, 2]])
    scanner = np.zeros(len(part), np.int64) if part.scanner is None else part.scanner
    for number in np.unique(scanner).tolist():
        yield SCANNERS * block.digitizer.index + number, rows[:, (scanner == number) & np.isfinite(share)]


def _judge(amplitude: np.ndarray, share: np.ndarray, light: np.ndarray) -> Compression | None:
    """The compression by echoes as from `_describe`; None where they are few.

    What the pulse misses of all echoes alike is no compression: only what grows with the amplitude.
    """
    if len(amplitude) < SHAPE_CLASSES * LEAST_OF_CLASS:
        return None
    group = np.empty(len(amplitude), np.int64)
    group[np.argsort(amplitude, kind="stable")] = np.arange(len(amplitude)) * SHAPE_CLASSES // len(amplitude)
    level, (middle, spread) = group_medians(amplitude, group)[0], group_medians(share, group)
    weight = np.bincount(group) / (MEDIAN_ERROR * np.maximum(spread, 1e-9)) ** 2
    apart = level - np.average(level, weights=weight)
    squares = float(weight @ apart**2)
    slope = float((weight * apart) @ middle) / max(squares, 1e-30)
    rest = middle - np.average(middle, weights=weight) - slope * apart
    error = (max(float(weight @ rest**2) / (SHAPE_CLASSES - 2), 1.0) / max(squares, 1e-30)) ** 0.5
    return Compression(slope * float(np.median(light)) * (slope > SURE * error), amplitude)


LEAST_ECHOES = 10
"""A target with fewer echoes is left out: a median of fewer is no better than one echo."""

MOST_FACING_ERROR = 0.05
"""A target is refused where its angle leaves the cosine more uncertain than this: the next one will know it better."""

GIVEN_ANGLE_ERROR = np.radians(1.0)
"""Error of an incidence that the target file gives."""

MOST_OFF = 4.0
"""A given incidence contradicts the plane of the echoes by so many standard errors."""

STRANGE_SIGMA, MOST_STRANGE = 6.0, 0.02
"""Echoes this many robust standard deviations off the median are of another surface; more than this share may be the
target itself, inside of an outline that is too large: it is named, and by how much they are off is in the error."""

MOST_PARTS, MOST_APART = 8, 0.1
"""Parts of a target in each direction, of LEAST_ECHOES echoes or more; and scatter of their constants, beyond what that
of the echoes explains, from which it is of several surfaces, which is in the error: tarps and asphalt have 1 to 3 %."""

DARKEST = 0.01
"""Reflectance of a target from which it is named: black paint and wet asphalt have 0.03 and more, so that less is
another unit, such as a hundredth of a share. Ten times too little looks like a dark surface."""

MOST_CLIPPED = 0.2
"""Share of clipped echoes from which a target is refused: the others are the dim ones, by a third of their scatter."""

EDGE_SIGMA, LEAST_EDGE, LEAST_CORE, SIZES = 4.0, 0.01, 0.1, 16
"""Echoes of the outer half differ from the others where their medians do by so many errors and by the second share; the
few in the middle differ from the rest by the third, which no stain does: the target is smaller than its outline; and
how many sizes of it are tried."""


MOST_HOLE, BY_CHANCE = 0.25, 0.02
"""Part of an outline, as a length, without an echo in its middle from which a target of that size is said not to show;
and chance that echoes at random places leave it: thirty of them leave a quarter in one of seven outlines."""

LEAST_NEGATIVE, MOST_REFLECTANCE, BRIGHT = 0.01, 1.5, 0.1
"""Share of negative values from which a column of reflectances is in dB; most that surfaces send back along the light:
white ones half more than a matt one; and share of values above that from which it is no reflectance. Backscatter
coefficients are four times as large; amplitudes over full scale (dB) are hundreds of times too small."""

MOST_AIR_ERROR = 0.3
"""Error of the share of the air that a column holds from which the share is not known: it is 0 or 1. Beyond -0.5 and
1.5 something else changes with the range."""

CLASSES, MOST_POWER = 5, 2.0
"""Classes of reflectance whose constants are compared; and the most by which the logarithm of the constant may change
with that of the column: 1 for the root of the reflectance, 2 for its third root."""


def measure_target(
    target: Target, rows: np.ndarray, divergence: float | None, reflectance_error: float
) -> tuple[TargetResult, np.ndarray, np.ndarray]:
    """Measure the constant of one target.

    Parameters
    ----------
    target : Target
    rows : array of ECHO (n,)
        Clean single echoes inside its outline.
    divergence : float or None
        Full angle of the beam between the 1/e^2 points [mrad].
    reflectance_error : float
        Standard deviation of the target's reflectance, relative.

    Returns
    -------
    result : TargetResult
    used : array of ECHO (k,)
        Echoes on the target's plane, with their whole footprint inside.
    constant : float64 (k,)
        The constant of each [1/(m2 DN ns)].

    Notes
    -----
    docs/algorithms.md 5.
    """
    clipped = np.isinf(rows["light_err"])
    blank, nothing = TargetResult(target.name, target.reflectance, int(np.sum(~clipped))), (rows[:0], np.empty(0))
    if clipped.sum() > MOST_CLIPPED * len(rows):
        reason = f"{np.mean(clipped):.0%} of its echoes are clipped, the others are its dim ones: take a darker target"
        return replace(blank, refused=reason), *nothing
    rows = rows[~clipped]
    if len(rows) < LEAST_ECHOES:
        why = "" if len(clipped) else ": no pulse that counts met it with one echo; check its place and size"
        return replace(blank, refused=f"{len(rows)} clean single echoes, {LEAST_ECHOES} are needed{why}"), *nothing
    facet = fit_facet(rows["xyz"], rows["ray"])
    seen, seen_err = float(np.median(facet.angles(rows["ray"]))), float(np.hypot(facet.angle_error, GIVEN_ANGLE_ERROR))
    if target.incidence is not None and abs(np.radians(target.incidence) - seen) > MOST_OFF * seen_err:
        reason = (
            f"its incidence of {target.incidence:g} deg contradicts the plane of its echoes, which rays strike at "
            f"{np.degrees(seen):.1f} +- {np.degrees(seen_err):.1f} deg: correct incidence, or leave it out"
        )
        return replace(blank, refused=reason), *nothing
    if target.incidence is None:
        angle, angle_err, facing_err = facet.angles(rows["ray"]), facet.angle_error, facet.facing_error
    else:
        angle, angle_err = np.full(len(rows), np.radians(target.incidence)), GIVEN_ANGLE_ERROR
        facing_err = np.tan(angle[0]) * angle_err + 0.5 * angle_err**2
    if facing_err > MOST_FACING_ERROR:
        found = "unknown" if np.isinf(angle_err) else f"known to {np.degrees(angle_err):.0f} deg"
        reason = (
            f"its {len(rows)} echoes lie in one scan line or nearly so: the angle across it is {found}; "
            "give its incidence [deg] in the target file, or a target that several scan lines cross"
        )
        return replace(blank, refused=reason), *nothing
    depth = target.depth(rows["xyz"])
    radius = 0.5e-3 * (divergence or ASSUMED_DIVERGENCE) * float(np.median(rows["distance"]))
    inset = INSET * radius / max(float(np.cos(np.median(angle))), 0.1)
    used = facet.kept & (depth >= inset)
    if used.sum() < LEAST_ECHOES:
        assumed = "" if divergence else f" (of an assumed {ASSUMED_DIVERGENCE:g} mrad; give --divergence)"
        reason = (
            f"too small for a footprint of {2 * radius:.2f} m{assumed}: {used.sum()} of {len(rows)} echoes lie "
            f"{inset:.2f} m inside its outline, {LEAST_ECHOES} are needed"
        )
        return replace(blank, refused=reason, inset_m=round(inset, 3)), *nothing
    bright = target.reflectance * (1.0 + target.hot_spot)
    constant = 4.0 * bright * np.cos(angle[used]) / rows["light"][used]
    _, channel = np.unique(rows["channel"][used], return_inverse=True)
    relative = constant / group_medians(constant, channel)[0][channel]
    edge, edge_err = _compare_edge(relative, depth[used])
    off = np.abs(relative / np.median(relative) - 1.0)
    other_surface = off > max(STRANGE_SIGMA * MAD_TO_STD * float(np.median(off)), LEAST_EDGE)
    strange = float(np.mean(other_surface))
    # Footprints on both surfaces lie between them: the farthest tell the other one.
    strange_err = float(np.quantile(off[other_surface], 0.84)) if strange > MOST_STRANGE else 0.0
    low, high = target.corners.min(axis=0), target.corners.max(axis=0)
    places = np.zeros((1024, 3))
    places[:, :2] = low + (high - low) * (np.indices((32, 32)).reshape(2, -1).T + 0.5) / 32
    depths = target.depth(places[target.contains(places)])
    deepest, reached = float(depths.max(initial=0.0)), float(depth[used].max())
    hole, nearer = deepest - reached, float(np.mean(depths[depths >= inset] <= reached)) if deepest >= inset else 1.0
    hidden = hole > MOST_HOLE * deepest and nearer ** int(used.sum()) < BY_CHANCE
    result = replace(
        summarise(blank, constant),
        incidence_deg=float(np.degrees(np.median(angle[used]))),
        incidence_error_deg=float(np.degrees(angle_err)),
        inset_m=round(inset, 3),
        edge=edge,
        strange=strange,
        apart=_compare_parts(relative, rows["xyz"][used]),
        hidden_m=round(2.0 * hole, 2) if hidden else None,
    )
    inner = MEDIAN_ERROR * (result.spread or 0.0) / np.sqrt(result.echoes - 1)
    hot_err = 0.5 * target.hot_spot / (1.0 + target.hot_spot)
    other = max(edge_err, strange_err, result.apart if result.apart > MOST_APART else 0.0)
    error = float(np.sqrt(reflectance_error**2 + hot_err**2 + facing_err**2 + inner**2 + other**2))
    return replace(result, relative_error=error), rows[used], constant


def measure_column(
    name: str, rows: np.ndarray, reflectance_error: float, attenuation: float
) -> tuple[TargetResult, np.ndarray, np.ndarray]:
    """Measure the constant by a column of reflectances that the sensor's vendor computed.

    Parameters
    ----------
    name : str
        Of the column.
    rows : array of ECHO (n,)
        Clean single echoes; `given` is the reflectance of a matt surface that faces the sensor and returns as much, in
        dB or as a share.
    reflectance_error : float
        Standard deviation of the vendor's constant, relative.
    attenuation : float
        Of the air, one way [dB/km].

    Returns
    -------
    result : TargetResult
        Its error holds by how much dark and bright echoes differ, and the air where ranges do not show whether the
        vendor has taken it off. Where they show that he has not, it is taken off.
    used : array of ECHO (k,)
    constant : float64 (k,)
        As `measure_target`.
    """
    rows = rows[np.isfinite(rows["given"] + rows["light_err"])]
    facing = 10.0 ** (0.1 * rows["given"]) if np.mean(rows["given"] < 0) > LEAST_NEGATIVE else rows["given"]
    rows, facing = rows[facing > LEAST_REFLECTANCE], facing[facing > LEAST_REFLECTANCE]
    blank = TargetResult(f"column {name}", float(np.median(facing)) if len(facing) else 0.0, len(rows))
    bright = float(np.mean(facing > MOST_REFLECTANCE)) if len(facing) else 0.0
    if len(rows) < LEAST_ECHOES or bright > BRIGHT or blank.reflectance < DARKEST:
        reason = f"{len(rows)} clean single echoes have a reflectance, {LEAST_ECHOES} are needed"
        if len(rows) >= LEAST_ECHOES:
            reason = f"its median is {blank.reflectance:.3g}, {bright:.0%} exceed {MOST_REFLECTANCE:g}, as no surfaces "
            reason += "have: no reflectance in dB (below 0), nor as a share of 1"
        return replace(blank, refused=reason), rows[:0], np.empty(0)
    constant, left, air_err = _take_off_air(4.0 * facing / rows["light"], rows["distance"], attenuation)
    result = replace(summarise(blank, constant), air=left)
    # By both: classes of one alone differ where that one is noisy.
    order = np.argsort(facing * rows["light"], kind="stable")
    number = min(CLASSES, len(rows) // LEAST_ECHOES)
    apart, steps = (
        float(np.std([np.log(np.median(some)) for some in np.array_split(of[order], number)]))
        for of in (constant, facing)
    )
    # A power of the reflectance, as another factor of dB makes it, is right where it is 1: how far it is from there.
    power = min(apart / max(steps, 1e-9), MOST_POWER) if apart > MOST_APART else 0.0
    far = math.expm1(max(apart, power * abs(math.log(blank.reflectance))))
    inner = MEDIAN_ERROR * (result.spread or 0.0) / np.sqrt(len(rows) - 1)
    error = float(np.sqrt(reflectance_error**2 + far**2 + inner**2 + air_err**2))
    return replace(result, relative_error=error, apart=apart), rows, constant


def _take_off_air(
    constant: np.ndarray, distance: np.ndarray, attenuation: float
) -> tuple[np.ndarray, float | None, float]:
    """Constants by a vendor's reflectances without the air that these still hold; its share, None where the ranges do
    not show it; and the error that follows.

    Such reflectances, and constants, fall with the range as the air's transmission does.
    """
    loss = 2.0e-4 * np.log(10.0) * attenuation * distance
    value = np.log(constant)
    off = np.abs(value - np.median(value))
    kept = off <= 4.0 * MAD_TO_STD * np.median(off)
    apart = loss[kept] - loss[kept].mean()
    squares = float(apart @ apart)
    whole = float(np.median(loss))
    if not squares > 0.0:
        return constant, None, whole
    left = -float(apart @ value[kept]) / squares
    error = float(np.std(value[kept] - value[kept].mean() + left * apart)) / np.sqrt(squares)
    if error > MOST_AIR_ERROR or abs(left - 0.5) > 1.0:
        return constant, None, whole
    return constant * np.exp(left * loss), left, error * whole


def summarise(blank: TargetResult, constant: np.ndarray) -> TargetResult:
    """Return the result with number, median and relative robust spread of constants (n,), n > 0."""
    middle = float(np.median(constant))
    return replace(blank, echoes=len(constant), constant=middle, spread=robust_std(constant) / middle)


def _compare_parts(constant: np.ndarray, xyz: np.ndarray) -> float:
    """Scatter of the constants of parts of a target, beyond what the scatter within them explains."""
    side = min(int((len(constant) / LEAST_ECHOES) ** 0.5), MOST_PARTS)
    if len(constant) < 2 * LEAST_ECHOES:
        return 0.0
    east, north = (np.argsort(xyz[:, axis], kind="stable") for axis in (0, 1))
    columns = np.array_split(east, side)
    parts = [part for some in columns for part in np.array_split(some[np.argsort(xyz[some, 1], kind="stable")], side)]
    if side < 2:  # halves, the way in which they differ more
        ways = [np.array_split(order, 2) for order in (east, north)]
        parts = max(ways, key=lambda both: float(np.var([np.median(constant[part]) for part in both])))
    chance = np.mean([MEDIAN_ERROR**2 * robust_std(constant[part]) ** 2 / len(part) for part in parts])
    return float(max(np.var([np.median(constant[part]) for part in parts]) - chance, 0.0) ** 0.5)


def _compare_edge(constant: np.ndarray, depth: np.ndarray) -> tuple[float | None, float]:
    """The outer half's constant over the inner one's, or that of all over that of the few in the middle, less 1, where
    they differ; and the error that follows."""
    outer = depth < np.median(depth)
    if min(outer.sum(), (~outer).sum()) < LEAST_ECHOES // 2:
        return None, 0.0
    parts = [constant[outer], constant[~outer]]
    middle = [float(np.median(part)) for part in parts]
    spreads = [MAD_TO_STD * float(np.median(np.abs(p / m - 1.0))) for p, m in zip(parts, middle, strict=True)]
    errors = [MEDIAN_ERROR * s / np.sqrt(len(p)) for s, p in zip(spreads, parts, strict=True)]
    off = middle[0] / middle[1] - 1.0
    if abs(off) >= max(LEAST_EDGE, EDGE_SIGMA * float(np.hypot(*errors))):
        return float(off), abs(middle[0] - middle[1])  # over the median of all, which is the constant
    inwards, oddest, half = np.argsort(depth), np.argmax(np.abs(constant - np.median(constant))), len(depth) // 2
    # A target much smaller than its outline has one echo, which differs most: else it is one of many spots.
    sizes = np.unique(np.linspace(LEAST_ECHOES // 2, half, SIZES).astype(np.int64)).tolist()
    found: list[tuple[float, float]] = []
    for few in sizes + [1] * bool(inwards[-1] == oddest):
        inner, rest = constant[inwards[-few:]], constant[inwards[:-few]]
        core, other = float(np.median(inner)), float(np.median(rest))
        spread = MAD_TO_STD * float(np.median(np.abs(np.append(inner / core, rest / other) - 1.0)))
        sure = abs(other / core - 1.0) / max(LEAST_CORE, EDGE_SIGMA * spread * MEDIAN_ERROR / few**0.5)
        found.append((sure, float(np.median(constant)) / core - 1.0))
    sure, off = max(found)
    return (off, abs(off / (1.0 + off))) if sure >= 1.0 else (None, 0.0)


def combine_targets(
    results: Sequence[TargetResult], used: Sequence[np.ndarray], channel: int = 0
) -> ChannelConstant | None:
    """Combine the constants of several targets; None where none of them has one.

    Parameters
    ----------
    results : sequence of TargetResult
    used : sequence of arrays of ECHO
        Their echoes.
    channel : int
        Number of the channel.

    Returns
    -------
    ChannelConstant or None
        The median over the targets. Its error is that of their mean, or their disagreement where that is larger.
    """
    good = [result for result in results if result.constant is not None]
    if not good:
        return None
    constants = np.array([result.constant for result in good])
    constant = float(np.median(constants))
    stated = float(np.sqrt(sum((result.relative_error or 0.0) ** 2 for result in good))) / len(good)
    between = float(np.std(constants, ddof=1) / constant / np.sqrt(len(good))) if len(good) > 1 else 0.0
    spread = float(np.median([result.spread for result in good]))
    rows = np.concatenate(used)
    fits = float(np.median(rows["light_err"] / rows["light"])) if len(rows) else 0.0
    return ChannelConstant(
        digitizer=channel // SCANNERS,
        scanner=channel % SCANNERS,
        constant=constant,
        relative_error=max(stated, between),
        spread=spread,
        echoes=sum(result.echoes for result in good),
        shot_energy=float(np.sqrt(max(spread * spread - fits * fits, 0.0))),
    )


MOST, UNLIKE_TARGETS = (0.05, 0.95), 1.5
"""Quantiles of the amplitudes of targets and of the strip; and how many times darker or brighter than targets echoes
are for which these do not prove a linear receiver: what one loses grows with the amplitude."""

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
    whole = combine_targets(results, [rows for _, rows, _ in measured])
    if whole is None:
        miss = describe_miss([target.corners for target in targets], source.reader.facts.header) if targets else ""
        reasons = miss or "; ".join(f"{result.name}: {result.refused}" for result in results)
        remedy = "give a column of reflectances" if options.column else "check coordinates and targets"
        raise InputError(f"{source.path}: no target gives a constant ({reasons}); {remedy}")
    used = np.concatenate([rows for _, rows, _ in measured])
    ranging = math.hypot(measure_ranging(source.sensor, used["distance"], source.air), source.sent.growth)
    # By how much constants are off for echoes that a compressing receiver makes darker or brighter than the
    # targets, relative, and the lines about it, or about targets that do not show it.
    bent, compressed = 0.0, []
    for number, loss in find_compression(source.reader, source.scan, source.system).items():
        lit = used["amplitude"][used["channel"] == number]
        if not len(lit):
            continue
        growth = loss.compare(lit)
        bent = max(bent, growth)
        (low, high), (dark, bright) = (np.quantile(one, MOST).tolist() for one in (loss.amplitude, lit))
        which = f"digitizer {number // SCANNERS}"
        which += f", scanner channel {number % SCANNERS}," if number % SCANNERS else ""
        if growth > LEAST_BENT:
            off = [loss.factor * (float(np.mean(lit)) - amplitude) for amplitude in (low, high)]
            compressed.append(
                f"the receiver of {which} compresses, by the shape of its echoes: those of "
                f"{low:.0f} to {high:.0f} DN are {off[0]:+.1%} to {off[1]:+.1%} off against the targets': the error of "
                f"the constant grows by {growth:.1%}; take targets as bright as the surfaces that you measure"
            )
        elif max(dark / low, high / bright) > UNLIKE_TARGETS:
            compressed.append(
                f"the targets of {which} are {dark:.0f} to {bright:.0f} DN bright, its echoes {low:.0f} to {high:.0f} "
                "DN: that its receiver weakens no strong light is assumed, and not in the error; take a dark and a "
                "bright target"
            )
    channels = tuple(
        describe_channel(replace(row, relative_error=math.hypot(row.relative_error, ranging)), source)
        for row in _measure_channels(measured)
    )
    shown = results
    if len(channels) > 1:  # they differ in gain, so that no median of a target is common to them
        shown = []
        for result, rows, constant in measured:
            shown += [result] if result.constant is None else []
            for channel in np.unique(rows["channel"]).tolist():
                which = f"digitizer {channel // SCANNERS}, scanner channel {channel % SCANNERS}"
                shown.append(replace(summarise(result, constant[rows["channel"] == channel]), channel=which))
    # The constant of all together serves files of tools that know no channels; its error covers how far they differ.
    apart = float(np.std([row.constant for row in channels])) / whole.constant
    facts, pulse, where = source.reader.facts, source.system.sigma_ref, options.selection.where
    decomposer = next(step.stage.name for step in source.chain.steps if step.stage.kind == "decompose")
    return Calibration(
        constant=whole.constant,
        relative_error=math.hypot(whole.relative_error, apart, ranging),
        attenuation=source.air,
        haze=source.haze,
        divergence=divergence,
        strip=source.path.name,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        conditions=f"sensor from {source.sensor.kind}, pulse {pulse:.4g} ns, {whole.echoes} echoes"
        + (f" where {where.text}" if where else ""),
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
        targets=tuple(shown),
        channels=channels,
        **source.sent.describe(),
        bent=bent,
        notes=(*_list_doubts(source, results, channels, options), *compressed),
    )


def measure_ranging(sensor: SensorSource, distance: np.ndarray, attenuation: float) -> float:
    """Return the relative error of the constant from that of the sensor's position, which all echoes share."""
    middle = np.array([np.median(distance)])
    return float(np.nan_to_num(backscatter_error(np.zeros(1), middle, sensor.error, 0.0, attenuation)[0]))


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
        combined = combine_targets(results, parts, channel) if results else None
        if combined is not None:
            found.append(combined)
    return found


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
        if result.reflectance < DARKEST and not options.column:
            yield (
                f"{result.name}: no dry surface has a reflectance of {result.reflectance:g}, and all results are in "
                "proportion to it: it is a share of 1"
            )
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
        if result.hidden_m is not None:
            yield (
                f"{result.name}: no echo lies in its middle, so that a target of {result.hidden_m:.1f} m in a larger "
                "outline would not show: make sure that it is as large as the outline"
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
        yield (
            f"constants of the targets differ by a factor of {ratio:.2f}, which the error holds: check reflectances "
            "and coordinates; a receiver that weakens strong light does that too"
        )
