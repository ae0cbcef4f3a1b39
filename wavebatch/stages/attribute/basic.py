"""Attributes of the fit alone (amplitude, width, energy, shape of the pulse, position), and incidence angles.

Chains call the stages; the ground of a survey and `survey --angles` use `added_variance`. Angles come from echo widths,
with their errors, NaN where widths cannot give one (docs/algorithms.md 1.4), and from the points around an echo: the
check for angles from echo widths.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.echoes import SUFFIX, EchoFlag, EchoTable, NoData, explain_no_data
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import AIR_SPEED, FWHM_PER_SIGMA, HALF_C, LEAST_PULSE_WIDTH, SQRT_2PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import NO_SKEW, PulseShape, evaluate_pulse, residual_moments
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.geometry.group_returns import match_returns, share_offsets
from wavebatch.kernels.geometry.normals import measure_normals
from wavebatch.kernels.physics import incidence
from wavebatch.stages.attribute.radiometry import area_factor, light_error, sensor_distance
from wavebatch.stages.chain import Chain, Range, Step, stage
from wavebatch.stages.pulse_tables import BROADEST, model_parameters, pulse_shape, shape_limits


@stage("attribute", makes=("amplitude", "amplitude_err"))
def amplitude(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Peak of each echo above the baseline [DN], and its error."""
    return echoes.with_attributes(amplitude=echoes.amplitude, amplitude_err=echoes.amplitude_err)


def _need_free_skew(step: Step, chain: Chain, system: SystemPulse | None) -> str:
    """Refuse a chain in which no skew is fitted to single echoes."""
    decomposer = chain.decomposer
    free = decomposer.stage.name == "decompose.skewed" and decomposer.effective()["kappa"] == "free"
    if free or "skew" in decomposer.stage.makes:
        return ""
    return (
        f'{decomposer.stage.name} fits no skew per echo; put decompose.skewed with kappa = "free" in its place and add '
        "stage attribute.skew, in the file that `wavebatch survey STRIP --chain CHAIN.toml` writes, and give that as "
        "--chain; it fits pulses that are plain or skewed Gaussians: where the pulse is a sum of Gaussians it finds "
        "false echoes"
    )


@stage("attribute", makes=("echo_width", "echo_width_err"))
def echo_width(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Full width at half maximum of each echo [ns], and its error.

    2.354820 sigma of a Gaussian, 2 sinh(1.17741 kappa) / kappa sigma of a skewed pulse. Of a learned pulse it is the
    width of the main lobe.
    """
    # Full width at half maximum per sigma of a skewed pulse (docs/algorithms.md 0); an echo may have its own skew.
    kappa = np.asarray(echoes.attributes.get("skew", system.kappa), np.float64)
    half = FWHM_PER_SIGMA / 2
    small = np.abs(kappa) < 1e-6
    safe = np.where(small, 1.0, kappa)
    factor = np.where(small, FWHM_PER_SIGMA, 2 * np.sinh(half * safe) / safe).astype(np.float32)
    return echoes.with_attributes(echo_width=echoes.sigma * factor, echo_width_err=echoes.sigma_err * factor)


@stage("attribute", makes=("skew", "skew_err"), check=_need_free_skew)
def skew(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Skew of each echo and its error, after decompose.skewed with kappa = "free".

    Ground and plants differ in it. 0 is a Gaussian; of a log-normal it is the sigma of its logarithm.

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 1.2.
    """
    unknown = np.full(len(echoes), np.nan, np.float32)
    return echoes.with_attributes(**{name: echoes.attributes.get(name, unknown) for name in ("skew", "skew_err")})


@stage("attribute", makes=("energy", "energy_err"))
def energy(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Integral of each echo over time [DN ns], and its error.

    Amplitude sigma sqrt(2 pi), times exp(kappa^2 / 2) of a skewed pulse; of a generalized Gaussian that of its
    exponent; of a learned pulse the sum over its Gaussians, with tails and after-pulses.
    """
    shape, limits = pulse_shape(system, block.spacing), shape_limits(system, block.spacing, most=BROADEST)
    if shape.components:
        whole = np.stack([echoes.amplitude, np.zeros(len(echoes)), echoes.sigma / block.spacing], axis=1)
        amplitude, _, width = model_parameters(shape, limits, whole.astype(np.float64)).T
        area = amplitude * width * block.spacing * (1.0 + sum(weight for weight, _, _ in shape.components))
    else:
        area = echoes.amplitude.astype(np.float64) * echoes.sigma * area_factor(system, echoes)
    value = SQRT_2PI * area
    error = np.abs(value) * light_error(echoes)
    return echoes.with_attributes(energy=value.astype(np.float32), energy_err=error.astype(np.float32))


def _need_one_pulse(step: Step, chain: Chain, system: SystemPulse | None) -> str:
    """Refuse decomposers that fit another pulse to every echo: none is common to compare with."""
    decomposer = chain.decomposer
    own = decomposer.effective().get("kappa") == "free" or decomposer.effective().get("model") == "generalized"
    if own or "skew" in decomposer.stage.makes or decomposer.stage.name == "decompose.generalized_gaussian":
        return f"{decomposer.stage.name} fits another shape to every echo; use it after decompose.adaptive"
    return ""


@stage("attribute", makes=("pulse_deviation",), check=_need_one_pulse)
def pulse_deviation(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Deviation of each echo from the fitted pulse: sqrt(h3^2 + h4^2) of its residual, per unit of A/std sqrt(s/T).

    The Gauss-Hermite moments h3 (skew) and h4 (peakedness) of a right fit are standard normal numbers, so noise alone
    gives about 1.25 std/A sqrt(T/s): A is the amplitude, std the noise, s the sigma, T the spacing. Merged echoes
    and sloping targets give more.

    References
    ----------
    docs/algorithms.md 4.2.
    """
    s, spacing = block.samples.shape[1], block.spacing
    time, sigma = echoes.time / spacing, echoes.sigma.astype(np.float64) / spacing
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing, most=BROADEST)
    whole = np.stack([echoes.amplitude, time, sigma], axis=1).astype(np.float64)
    model = model_parameters(shape, limits, whole)
    std = noise.std[echoes.waveform].astype(np.float64)
    h3, h4 = np.empty(len(echoes)), np.empty(len(echoes))
    alone = echoes.alone(len(block))
    for kind, rows in ((_read_single, np.flatnonzero(alone)), (_read_several, np.flatnonzero(~alone))):
        read = kind(block, noise, shape, echoes.waveform[rows], model[rows])
        h3[rows], h4[rows] = residual_moments(read, s, time[rows], sigma[rows], std[rows])
    unit = echoes.amplitude / std * np.sqrt(sigma)
    return echoes.with_attributes(pulse_deviation=(np.hypot(h3, h4) / np.maximum(unit, 1e-6)).astype(np.float32))


_Read = Callable[[np.ndarray | slice, np.ndarray], np.ndarray]


def _read_single(
    block: WaveformBlock, noise: Noise, shape: PulseShape, waveform: np.ndarray, model: np.ndarray
) -> _Read:
    """Reader of residuals of echoes (k,) that are alone in their waveforms; the pulse is computed where it is read."""
    samples, s = block.samples.ravel(), block.samples.shape[1]
    first = waveform.astype(np.int64)[:, None] * s
    amplitude, time, width = model.astype(np.float32).T[..., None]
    level, missing = (None if values is None else values.ravel() for values in (noise.of_sample, block.missing))

    def read(part: np.ndarray | slice, at: np.ndarray) -> np.ndarray:
        values = samples[first[part] + at].astype(np.float32)
        values -= noise.baseline[waveform[part], None] if level is None else level[first[part] + at]
        values -= amplitude[part] * evaluate_pulse(shape, at.astype(np.float32), time[part], width[part])[0]
        if missing is not None:
            values[missing[first[part] + at]] = 0
        return values

    return read


def _read_several(
    block: WaveformBlock, noise: Noise, shape: PulseShape, waveform: np.ndarray, model: np.ndarray
) -> _Read:
    """Reader of residuals of echoes (k,) that share their waveforms: the model is computed for the whole waveform."""
    rows, place = np.unique(waveform, return_inverse=True)
    residual = block.samples[rows] - noise.level[rows]
    residual -= render_echoes(shape, len(rows), block.samples.shape[1], place, model[:, 1], model[:, 0], model[:, 2])
    if block.missing is not None:
        residual[block.missing[rows]] = 0

    def read(part: np.ndarray | slice, at: np.ndarray) -> np.ndarray:
        return residual[place[part][:, None], at].astype(np.float32)

    return read


@stage("attribute", makes=("x", "y", "z", "point", "range_err"))
def position(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 2.5,
) -> EchoTable:  # fmt: skip
    """Coordinates of each echo along its ray [m], relative to the returns of its packet, and the return it matches.

    Return locations differ from the fit by an offset that all returns of a packet share (phase of the emitted
    pulse, a detector of leading edges). The offset is measured on the matched returns and subtracted. Besides the
    error of the fit, range_err has that of the returns: their scatter in this strip, or, where the returns of a
    packet contradict each other by more, the error of their mean, and an offset that is 3 times that of the strip's
    lone echoes: such a return is the mean of two surfaces, or another one's. Returns that lie off the packet's ray
    by more than a sample (bent at a water surface) put that into it. Packets without a matched return keep the raw
    location and are flagged; their error has what locations differ from echoes in the strip, and how far their
    nearest return is from an echo.

    Parameters
    ----------
    tolerance : float
        Largest distance in time between an echo and its return, in addition to half a sample [ns].

    References
    ----------
    docs/las-waveforms.md 8.
    """
    waveform = echoes.waveform
    offset = np.zeros(len(block))
    doubt = np.zeros(len(block))
    known = np.zeros(len(block), bool)
    most, bent, apart = np.zeros(len(block)), np.zeros(len(echoes)), np.zeros(len(block))
    point = np.full(len(echoes), -1, np.int64)
    returns = block.returns
    east, north, up = block.direction.T
    square = east**2 + north**2 + up**2
    if returns is not None and len(returns):
        reach, own = tolerance + 0.5 * block.spacing, (len(block), waveform, echoes.time, echoes.time_err)
        match = match_returns(waveform, echoes.time, returns.waveform, returns.time, reach)
        offset, doubt, known = share_offsets(*own, match, returns.time)
        shifted = returns.time + offset[returns.waveform]
        again = match_returns(waveform, echoes.time, returns.waveform, shifted, reach)
        if not np.array_equal(again, match):
            match = again
            offset, doubt, known = share_offsets(*own, match, returns.time)
        point = np.where(match >= 0, returns.point[match], -1)
        several = np.flatnonzero(np.bincount(returns.waveform)[returns.waveform] > 1)
        if len(several):
            of, away = returns.waveform[several], np.zeros(len(returns))
            time, places = returns.time[several], zip(returns.xyz.T, block.origin.T, block.direction.T, strict=True)
            off = [at[several] - origin[of] - way[of] * time for at, origin, way in places]
            with np.errstate(divide="ignore", invalid="ignore"):
                away[several] = np.sqrt((off[0] ** 2 + off[1] ** 2 + off[2] ** 2) / square[of])
            away[away <= block.spacing] = 0.0  # a location may be rounded to a sample
            np.maximum.at(most, returns.waveform, away)
            bent = np.where(match >= 0, away[match], most[waveform])
        # Of returns far from all echoes of their packet, place or location may be wrong: as the nearest two differ.
        strange = np.flatnonzero(~known[returns.waveform])
        if len(strange):
            of, time = returns.waveform[strange], returns.time[strange]
            match = match_returns(waveform, echoes.time, of, time, np.inf)
            found = np.flatnonzero(match >= 0)
            apart[waveform[found]] = np.inf
            np.minimum.at(apart, waveform[found], np.abs(echoes.time[found] - time[match[found]]))
    along = echoes.time - offset[waveform]
    # `take` copies whole rows: a tenth of the time of an index.
    xyz = block.origin.take(waveform, axis=0) + block.direction.take(waveform, axis=0) * along[:, None]
    speed = np.sqrt(square)
    # In strips in feet or degrees the vectors are no speeds in m/ns, but the error is always in metres.
    speed = np.where(np.abs(speed / HALF_C - 1.0) < 0.5, speed, HALF_C)
    # Between return and echo, vectors that are not as long as light is fast miss by the difference.
    range_err, wrong = echoes.time_err * speed[waveform], np.maximum(np.abs(speed - HALF_C), np.abs(speed - AIR_SPEED))
    if returns is not None and len(returns) and wrong.max(initial=0.0) > LEAST_WRONG * HALF_C:
        first = np.searchsorted(returns.waveform, waveform).clip(max=len(returns) - 1)
        start = np.where(returns.waveform[first] == waveform, returns.time[first], 0.0)  # without a return: the origin
        missed = np.abs(along - start) * np.where(wrong > LEAST_WRONG * HALF_C, wrong, 0.0)[waveform]
        range_err = np.hypot(range_err, missed)
    phase, shift = system.radiometry.phase, np.abs(offset) * speed
    # An offset far beyond those of lone echoes is no phase: the return is of two surfaces, or of another one.
    shift = np.where((phase > 0) & (shift > STRANGE_SHIFT * phase), shift, 0.0)
    shared = np.where(known, np.maximum(np.maximum(doubt * speed, shift), system.radiometry.returns),
                      np.maximum(apart * speed, phase))  # fmt: skip
    echoes = echoes.with_attributes(
        x=xyz[:, 0],
        y=xyz[:, 1],
        z=xyz[:, 2],
        point=point,
        range_err=np.hypot(range_err, np.maximum(shared[waveform], bent * speed[waveform])).astype(np.float32),
    )
    if returns is None:
        return echoes
    return echoes.with_flags(EchoFlag.ADDED, point < 0).with_flags(EchoFlag.UNANCHORED, ~known[waveform])


LEAST_WRONG = 1e-3
"""Error of a vector's length that counts: vendors may leave out the .0003 that air takes."""

STRANGE_SHIFT = 3.0
"""Offset of a packet over the root mean square of those of lone echoes: phases are even over a sample, up to 1.7."""

NARROW_ERRORS = 3.0
"""An echo whose variance is negative by so many errors is flagged as narrower than the system pulse."""

CLEAR_ERRORS = 4.0
"""A weak echo whose variance is positive by so many errors certainly comes from a slope, and has an angle."""

_UNCLEAN = {
    NoData.OVERLAPPED: EchoFlag.OVERLAPPED | EchoFlag.MERGED,
    NoData.SATURATED: EchoFlag.SATURATED,
    NoData.CUT: EchoFlag.NEAR_EDGE,
    NoData.UNSETTLED: EchoFlag.NOT_CONVERGED | EchoFlag.AT_BOUND,
}
"""Echoes with these flags have widths that do not depend on the surface alone."""

_REASON = f"incidence_angle{SUFFIX}"


def _check_widths(step: Step, chain: Chain, system: SystemPulse | None) -> str:
    """Refuse decomposers whose widths never are those of one pulse."""
    decomposer = chain.decomposer
    name = decomposer.stage.name
    if "skew" in decomposer.stage.makes or decomposer.effective().get("kappa") == "free":
        return f"{name} fits a skew per echo, which takes part of the width; use decompose.adaptive"
    return ""


LEAST_SKEW = 0.25
"""Skew of the strip's pulse from which the pulse t^2 exp(-t) of mode `pulse` describes it: it has 0.48 itself."""


@stage(
    "attribute",
    makes=("incidence_angle", "incidence_angle_err"),
    needs=("x", "y", "z"),
    check=_check_widths,
)
def incidence_angle(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    mode: Literal["system", "pulse", "paper"] = "system",
    divergence: Annotated[float, Range(0.0, 100.0)] = 0.0,
    max_error: Annotated[float, Range(1e-3, 180.0)] = 10.0,
    reference_error: Annotated[float, Range(0.0, 1.0)] = 0.003,
    alone: bool = True,
) -> EchoTable:  # fmt: skip
    """Angle between ray and surface normal of each echo [deg], from its width beyond the system pulse's; its error.

    A plane spreads the pulse by R divergence tan(alpha) / (2 c). Rough ground and plants widen echoes too and look like
    slopes. Echoes narrower than the system pulse have angle 0; where they are narrower by more than three errors they
    have the flag NARROW.

    No-data where the system pulse is shorter than 0.85 samples, where sensor, divergence or the width of a surface that
    faces the sensor are not known, and where the echo is too weak for max_error: with a narrow beam and a long pulse
    that is everywhere. No-data also if the decomposer fits another pulse than the mode needs, for example
    Gaussians on a strip whose pulse is not a Gaussian.

    Parameters
    ----------
    mode : {"system", "pulse", "paper"}
        `system` takes the pulse of the survey, which the decomposer must have fitted (`decompose.adaptive`), `pulse`
        a Gaussian fitted to t^2 exp(-t / tau) at the sampling of the file (`decompose.gaussian`), `paper` the printed
        formulas, whose angles are too large.
    divergence : float
        Full angle of the beam between the 1/e^2 points [mrad]; 0 takes that of the system.
    max_error : float
        Largest standard deviation that the angle of an echo of this strength would have on a surface that faces the
        sensor, where angles are least certain [deg]. So only strong enough echoes get an
        angle, whatever their width. A weaker echo gets one only if it is wider than the system pulse by four errors of
        the variance; its angle and error are then corrected for this selection.
    reference_error : float
        Standard deviation of the system pulse's width, relative.
    alone : bool
        Only echoes that are alone in their waveform; others fill an unknown part of the beam.

    References
    ----------
    Rhomberg-Kauert et al. (2024), as corrected by docs/algorithms.md 1.4.
    """
    beam = divergence or system.radiometry.divergence
    short = system.sigma_ref < LEAST_PULSE_WIDTH * block.spacing
    variance, variance_err = added_variance(block, system, echoes, mode, reference_error)
    distance = sensor_distance(block, echoes)
    angle, error = incidence.angles_of_variance(variance, variance_err, distance, 1e-3 * beam if beam else np.nan)
    steep = np.isnan(angle) & np.isfinite(variance) & np.isfinite(variance_err) & np.isfinite(distance)
    # Of a surface that faces the sensor: the relative error of a width goes with 1/(amplitude sqrt(sigma)), whose noise
    # has nothing to do with that of the width (docs/algorithms.md 2.1), so that this selects no echoes by their width.
    square = system.sigma_ref**2
    relative = np.hypot(echoes.sigma_err / echoes.sigma, system.widths.scatter / system.sigma_ref)
    facing_err = np.hypot(2.0 * square * np.hypot(relative, reference_error), system.widths.error or 0.0)
    flat_error = incidence.angle_of_spread(np.sqrt(facing_err), distance, 1e-3 * beam if beam else np.nan)
    with np.errstate(invalid="ignore"):
        weak = ~(flat_error <= np.radians(max_error))
        clear = weak & (variance > CLEAR_ERRORS * variance_err)
    if clear.any():
        known = variance[clear], variance_err[clear], distance[clear]
        angle[clear], error[clear] = incidence.angles_above(*known, 1e-3 * beam if beam else np.nan, CLEAR_ERRORS)
    error = np.hypot(error, 0.5 * np.sin(2.0 * angle) * system.radiometry.divergence_error)
    # Without what rough ground may have added the surface is less steep.
    steepest, least = (
        incidence.angle_of_spread(np.sqrt(np.maximum(variance - part, 0.0)), distance, 1e-3 * beam if beam else np.nan)
        for part in (0.0, system.widths.rough or 0.0)
    )
    error = np.hypot(error, steepest - least)
    unproven = np.isinf(system.widths.error or 0.0)
    # Widths that were fitted with another pulse than the mode compares them with: angles would be off by degrees.
    other = system.other_pulse
    if mode != "system":
        symmetric = mode == "pulse" and system.skew is not None and system.skew < LEAST_SKEW
        other = bool(system.components) or abs(system.kappa) >= NO_SKEW or symmetric
    with np.errstate(invalid="ignore"):
        narrow = variance < -NARROW_ERRORS * variance_err
    cases = (
        (NoData.NO_SENSOR, np.isnan(distance)),
        (NoData.NO_DIVERGENCE, not beam),
        (NoData.OTHER_PULSE, other),
        (NoData.NO_LEVEL, unproven),
        (NoData.SHORT_PULSE, short),
        (NoData.SHARED_PULSE, ~echoes.alone(len(block)) & alone),
        *((reason, (echoes.flags & np.uint16(flags)) != 0) for reason, flags in _UNCLEAN.items()),
        (NoData.TOO_STEEP, steep),
        (NoData.OTHER, np.isnan(error)),
        # Weak echoes just above the limit may have any angle down to 0; as 0 they pulled the mean down by 3 to 11 deg.
        (NoData.UNCERTAIN, weak & ~(clear & (angle > 0))),
    )
    bad = np.logical_or.reduce([np.broadcast_to(where, len(echoes)) for _, where in cases])
    angle, error = (np.degrees(np.where(bad, np.nan, values)).astype(np.float32) for values in (angle, error))
    columns = {"incidence_angle": angle, "incidence_angle_err": error, _REASON: explain_no_data(angle, *cases)}
    return echoes.with_attributes(**columns).with_flags(EchoFlag.NARROW, narrow)


def added_variance(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, mode: str, reference_error: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the variance that the target adds to the pulse.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    system : SystemPulse
        Result of the survey.
    echoes : EchoTable
        m fitted echoes.
    mode, reference_error
        As for `incidence_angle`.

    Returns
    -------
    variance, error : float64 array, shape (m,)
        Variance and its standard deviation [ns2].
    """
    width = echoes.sigma.astype(np.float64)
    error = np.hypot(echoes.sigma_err.astype(np.float64), system.widths.scatter)
    reference = system.sigma_ref
    if mode == "pulse":
        variance = incidence.spread_variance(incidence.pulse_table(system.sigma_ref, block.spacing), width)
    elif mode == "paper":
        variance = incidence.spread_variance(incidence.paper_table(system.sigma_ref), width)
    else:
        shape, limits = pulse_shape(system, block.spacing), shape_limits(system, block.spacing, most=BROADEST)
        if shape.components:
            # The part of the fitted pulse that a target widens as a Gaussian.
            one, near, whole = np.ones_like(width), 1e-3 * system.sigma_ref / block.spacing, width / block.spacing
            low, middle, high = (
                model_parameters(shape, limits, np.stack([one, one, whole + step], axis=1))[:, 2]
                for step in (-near, 0.0, near)
            )
            width, error = middle * block.spacing, error * (high - low) / (2.0 * near)
            reference = limits.ref * block.spacing
        variance = width * width - reference * reference - system.widths.variance
    fit_err = 2.0 * np.hypot(width * error, reference * reference * reference_error)
    return variance, np.hypot(fit_err, system.widths.error or 0.0)


@stage(
    "attribute",
    makes=("incidence_angle_normals", "incidence_angle_normals_err"),
    needs=("x", "y", "z"),
    second_pass=measure_normals,
)
def incidence_angle_normals(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    radius: Annotated[float, Range(0.0, 1000.0)] = 1.5,
    min_points: Annotated[int, Range(4, 10_000)] = 8,
    max_error: Annotated[float, Range(1e-3, 180.0)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Angle between the packet's ray and the normal of the plane of the points around each echo [deg]; its error.

    `run` computes it in a second pass, when all points of the strip are there; a block alone gives no-data. The plane
    is fitted to all points within the radius that are not outliers. It needs neither sensor nor divergence.

    No-data where there are fewer than min_points, or only one or two scan lines of them (always in a plane); where
    the points form no plane (plants: less than 60 % of them in it, thicker than a fifth of its width, or the echo not
    in it) or clearly two (a ridge, a valley or a step close by); where the angle exceeds 80 degrees (one sweep of the
    scanner over plants makes a plane that contains its rays); and where its error exceeds max_error. The error includes
    the change that two planes instead of one would make.

    Parameters
    ----------
    radius : float
        Radius of the neighbourhood [m]; three times the distance between points is a good start. 0: `run` chooses 1.5
        or as much more as the distance between the points of the strip asks for, 12 at most.
    min_points : int
        Least number of points in the neighbourhood, and in the plane.
    max_error : float
        Largest standard deviation of an angle that is written [deg].

    References
    ----------
    Rhomberg-Kauert et al. (2024), comparison of Fig. 6; docs/algorithms.md 1.4.
    """
    if not (radius == 0 or 1e-3 <= radius <= 1e3) or min_points < 4 or not max_error > 0:
        raise ConfigError("radius must be 0 or lie in 0.001 to 1000 m, min_points be 4 at least, max_error above 0")
    none = np.full(len(echoes), np.nan, np.float32)
    return echoes.with_attributes(incidence_angle_normals=none, incidence_angle_normals_err=none)
