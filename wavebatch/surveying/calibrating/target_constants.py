"""The constant that reference targets give, with an error that holds angle, edges, scatter and disagreement.

`targets.calibrate_strip` calls `measure_target` per target and channel, and `combine_targets` per channel. An unusable
target is rejected, with the reason; no value is guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wavebatch.core.order import group_medians, robust_std
from wavebatch.core.units import ASSUMED_DIVERGENCE, INSET, MAD_TO_STD, MEDIAN_ERROR
from wavebatch.kernels.geometry.facets import fit_facet
from wavebatch.surveying.calibrating.target_file import LEAST_REFLECTANCE, Target
from wavebatch.surveying.calibration import ChannelConstant, TargetResult
from wavebatch.surveying.matching.setting import SCANNERS

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

MOST_CLIPPED = 0.2
"""Share of clipped echoes from which a target is refused: the others are the dim ones, by a third of their scatter."""

EDGE_SIGMA, LEAST_EDGE, LEAST_CORE = 4.0, 0.01, 0.1
"""Echoes of the outer half differ from the others where their medians do by so many errors and by the second share; the
few in the middle differ from all by the third, which no stain does: the target is smaller than its outline."""


LEAST_NEGATIVE, MOST_REFLECTANCE = 0.01, 2.0
"""Share of negative values from which a column of reflectances is in dB, and the most that its median may be."""

MOST_HELD_ERROR = 0.3
"""Error of the share of the air that a column holds from which the share is not known: it is 0 or 1. Beyond -0.5 and
1.5 something else changes with the range."""

CLASSES = 5
"""Classes of reflectance whose constants are compared."""


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
        The constant of each [1/(m2 count ns)].

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
        return replace(blank, refused=f"{len(rows)} clean single echoes, {LEAST_ECHOES} are needed"), *nothing
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
    depth = target.depth(rows["xyz"][:, 0], rows["xyz"][:, 1])
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
    relative = _by_channel(constant, rows["channel"][used])
    (edge, edge_err), (strange, strange_err) = _compare_edge(relative, depth[used]), _share_strange(relative)
    result = replace(
        summarise(blank, constant),
        incidence_deg=float(np.degrees(np.median(angle[used]))),
        incidence_error_deg=float(np.degrees(angle_err)),
        inset_m=round(inset, 3),
        edge=edge,
        strange=strange,
        apart=_compare_parts(relative, rows["xyz"][used]),
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
    if len(rows) < LEAST_ECHOES or not blank.reflectance < MOST_REFLECTANCE:
        reason = f"{len(rows)} clean single echoes have a reflectance, {LEAST_ECHOES} are needed"
        if len(rows) >= LEAST_ECHOES:
            reason = f"its median is {blank.reflectance:.3g}: it holds neither dB nor shares of 1"
        return replace(blank, refused=reason), rows[:0], np.empty(0)
    constant, held, air_err = _take_off_air(4.0 * facing / rows["light"], rows["distance"], attenuation)
    result = replace(summarise(blank, constant), air=held)
    # By both: classes of one alone differ where that one is noisy.
    order = np.argsort(facing * rows["light"], kind="stable")
    classes = np.array_split(constant[order], min(CLASSES, len(rows) // LEAST_ECHOES))
    apart = float(np.std([np.median(some) for some in classes])) / (result.constant or 1.0)
    inner = MEDIAN_ERROR * (result.spread or 0.0) / np.sqrt(len(rows) - 1)
    error = float(np.sqrt(reflectance_error**2 + apart**2 + inner**2 + air_err**2))
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
    held = -float(apart @ value[kept]) / squares
    error = float(np.std(value[kept] - value[kept].mean() + held * apart)) / np.sqrt(squares)
    if error > MOST_HELD_ERROR or abs(held - 0.5) > 1.0:
        return constant, None, whole
    return constant * np.exp(held * loss), held, error * whole


def summarise(blank: TargetResult, constant: np.ndarray) -> TargetResult:
    """Return the result with number, median and relative robust spread of constants (n,), n > 0."""
    middle = float(np.median(constant))
    return replace(blank, echoes=len(constant), constant=middle, spread=robust_std(constant) / middle)


def _by_channel(constant: np.ndarray, channel: np.ndarray) -> np.ndarray:
    """Constants over the median of their channel."""
    _, group = np.unique(channel, return_inverse=True)
    return constant / group_medians(constant, group)[0][group]


def _share_strange(constant: np.ndarray) -> tuple[float, float]:
    """Share of echoes whose constant is that of another surface, and the error that follows."""
    off = np.abs(constant / np.median(constant) - 1.0)
    strange = off > max(STRANGE_SIGMA * MAD_TO_STD * float(np.median(off)), LEAST_EDGE)
    share = float(np.mean(strange))
    return share, float(np.median(off[strange])) if share > MOST_STRANGE else 0.0


def _compare_parts(constant: np.ndarray, xyz: np.ndarray) -> float:
    """Scatter of the constants of parts of a target, beyond what the scatter within them explains."""
    side = min(int((len(constant) / LEAST_ECHOES) ** 0.5), MOST_PARTS)
    if side < 2:
        return 0.0
    columns = np.array_split(np.argsort(xyz[:, 0], kind="stable"), side)
    parts = [part for some in columns for part in np.array_split(some[np.argsort(xyz[some, 1], kind="stable")], side)]
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
        return float(off), abs(float(off))
    few = LEAST_ECHOES // 2
    core = float(np.median(constant[np.argsort(depth)[-few:]]))
    off = float(np.median(constant)) / core - 1.0
    if abs(off) < max(LEAST_CORE, EDGE_SIGMA * max(spreads) * MEDIAN_ERROR / few**0.5):
        return None, 0.0
    return off, abs(off / (1.0 + off))


def combine_targets(results: Sequence[TargetResult], light_err: np.ndarray, channel: int = 0) -> ChannelConstant | None:
    """Combine the constants of several targets; None where none of them has one.

    Parameters
    ----------
    results : sequence of TargetResult
    light_err : float64 (n,)
        Relative errors of the fits of all their echoes.
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
    fits = float(np.median(light_err)) if len(light_err) else 0.0
    return ChannelConstant(
        digitizer=channel // SCANNERS,
        scanner=channel % SCANNERS,
        constant=constant,
        relative_error=max(stated, between),
        spread=spread,
        echoes=sum(result.echoes for result in good),
        shot_energy=float(np.sqrt(max(spread * spread - fits * fits, 0.0))),
    )
