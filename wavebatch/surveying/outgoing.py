"""The system pulse from recordings of outgoing pulses, and its comparison with the pulse that echoes show.

`wavebatch import` learns it and writes it beside the strip (STRIP.system.toml); a survey of the strip reads it there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.units import FWHM_PER_SIGMA, QUANTISATION_STD
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse
from wavebatch.kernels.elementary import exp
from wavebatch.kernels.fit.learn_pulse import PulseFit, Stack, fit_gaussians, stack_pulse
from wavebatch.kernels.signal.outgoing import OutgoingReference, measure_outgoing
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN
from wavebatch.surveying.systems.figures import Figures
from wavebatch.surveying.systems.survey_result import Decision, SavedSurvey, Survey, load_survey

MOST_STACKED = 4096
"""Outgoing pulses that are stacked, at most."""
REACH = (6.0, 12.0)
"""Widths before and after the peak that the stack covers."""
ALIGNED = 3
"""Times that pulses are aligned to what was learned before."""
GAUSSIANS = 5
"""Most of a pulse: a sixth follows what the alignment leaves, and widens pulses of 1.2 samples by 3 %."""

GOAL = 1.25
"""Misfit of a pulse, in errors of the stack, that chance alone makes."""
WIDENED = 1.15
"""Ratio of widths up to which slopes and plants may have widened even the narrowest echoes of a strip."""
PART = "outgoing pulse"
SYSTEM_SUFFIX = ".system.toml"
"""End of the system file beside an imported strip."""
_GRID = 4096

SAME = 0.03
"""Share by which two widths may differ and still be those of one pulse: echoes of ground show the width to 1 or 2 %."""


class OutgoingShape(NamedTuple):
    """The stacked outgoing pulse of a strip."""

    fit: PulseFit
    fwhm: float
    """[ns]."""
    ringing: float
    """Largest value beyond four widths, as a share of the amplitude."""
    pulses: int


def learn_shape(samples: np.ndarray, spacing: float, reference: OutgoingReference) -> OutgoingShape | None:
    """Learn the shape of outgoing pulses.

    Parameters
    ----------
    samples : unsigned integers (n, s), count
        Recordings spread over the strip.
    spacing : float
        [ns].
    reference : Reference

    Returns
    -------
    OutgoingShape or None
        None with too few pulses, or where they are no pulses.

    Notes
    -----
    The first alignment, by the three largest samples, widens the stack. So times and heights are fitted again with the
    stacked pulse, until it does not change.
    """
    found = measure_outgoing(samples, reference)
    good = np.flatnonzero(np.isfinite(found.energy) & (samples.max(axis=1) < np.iinfo(samples.dtype).max))
    if len(good) < ENOUGH_TO_LEARN:
        return None
    signal = samples[good] - found.level[good, None]
    time, height = found.time[good], found.amplitude[good]
    before, after = (side * reference.width for side in REACH)
    for _ in range(ALIGNED):
        stack = stack_pulse(signal, height, time, before, after, QUANTISATION_STD)
        if len(stack.lag) < 12:
            return None
        fits = fit_gaussians(stack, reference.width, GAUSSIANS, GOAL * float(np.sqrt(np.mean(stack.error**2))))
        # One Gauss-Newton step of times and heights with the sum of Gaussians.
        time = time + fits[-1].datum
        lag = np.arange(signal.shape[1]) - time[:, None]
        pulse, slope = np.zeros_like(lag), np.zeros_like(lag)
        for weight, delay, sigma in fits[-1].components:
            away = (lag - delay) / sigma
            bell = weight * exp(-0.5 * away**2)
            pulse += bell
            slope += bell * away / sigma
        slope *= height[:, None]
        rest = signal - height[:, None] * pulse
        a, b, c = (pulse**2).sum(axis=1), (pulse * slope).sum(axis=1), (slope**2).sum(axis=1)
        p, q = (rest * pulse).sum(axis=1), (rest * slope).sum(axis=1)
        scale = np.maximum(a * c - b * b, 1e-12)
        step = np.clip((a * q - b * p) / scale, -0.5, 0.5)
        time, height = time + step, height + (c * p - b * q) / scale
        if not (np.isfinite(time).all() and (height > 0).all()):
            return None
    shape = _describe(stack, fits[-1], spacing, len(good))
    return shape if shape.fwhm > 0 else None


def _describe(stack: Stack, fit: PulseFit, spacing: float, pulses: int) -> OutgoingShape:
    """Width and after-pulses of a fit."""
    lag = np.linspace(stack.lag[0], stack.lag[-1], _GRID) - fit.datum
    value = fit.draw(lag + fit.datum)
    top = int(np.argmax(value))
    low = value < 0.5 * value[top]
    left, right = lag[top - int(np.argmax(low[top::-1]))], lag[top + int(np.argmax(low[top:]))]
    far = np.abs(stack.lag - fit.datum) > 4 * (right - left) / FWHM_PER_SIGMA
    ringing = float(np.abs(stack.value[far]).max(initial=0.0))
    return OutgoingShape(fit, float(right - left) * spacing, min(ringing, 1.0), pulses)


def save_outgoing(
    shape: OutgoingShape,
    reference: OutgoingReference,
    spacing: float,
    bits: int,
    name: str,
    fingerprint: Mapping[str, Any],
    *,
    same_receiver: bool,
    **scatter: float,
) -> SavedSurvey:
    """Return what outgoing pulses say as a system file.

    Parameters
    ----------
    shape : OutgoingShape
    reference : Reference
    spacing : float
        [ns].
    bits : int
    name : str
        Of the file with the pulses.
    fingerprint : mapping
        Of that file.
    same_receiver : bool
        Whether the receiver of the echoes recorded them.
    **scatter : float
        Figures of the shots: energy_scatter, energy_error, width_scatter, all relative, and time_error_ns.

    Returns
    -------
    SavedSurvey
    """
    components = tuple((float(w), float(d) * spacing, float(s) * spacing) for w, d, s in shape.fit.components)
    system = SystemPulse(
        sigma_ref=shape.fwhm / FWHM_PER_SIGMA,
        noise=ReceiverNoise(baseline=reference.level, baseline_spread=reference.spread, std=reference.noise),
        components=components if len(components) > 1 else (),
        ringing=shape.ringing,
    )
    figures = Figures(
        outgoing_fwhm_ns=shape.fwhm,
        outgoing_pulses=float(shape.pulses),
        outgoing_misfit=shape.fit.rms,
        outgoing_ringing=shape.ringing,
        outgoing_same_receiver=float(same_receiver),
        spacing_ns=spacing,
        bits=float(bits),
    )
    scatter_figures: dict[str, Any] = {f"outgoing_{key}": value for key, value in scatter.items()}
    figures = replace(figures, **scatter_figures)
    reason = f"stacked from {shape.pulses} outgoing pulses: full width at half maximum {shape.fwhm:.3f} ns"
    survey = Survey(system, shape.pulses, figures, (Decision(PART, True, reason),))
    return SavedSurvey(survey, name, fingerprint)


def compare_outgoing(found: Survey, strip: Path) -> Survey:
    """Compare the pulse that echoes show with that of the outgoing pulses beside a strip, and take the better one.

    Parameters
    ----------
    found : Survey
        Of the strip.
    strip : Path
        The strip; STRIP.system.toml has its outgoing pulses if it was imported with them.

    Returns
    -------
    Survey
        The same one where there is no such file; else with a decision, and with the pulse that was taken.

    Raises
    ------
    ConfigError
        Where the file beside the strip cannot be read.

    Notes
    -----
    Echoes pass the receiver, so where both agree the pulse of the echoes is taken. Where echoes are wider, slopes and
    plants have widened them, and the outgoing pulse is the narrower truth; but only if the same receiver recorded it,
    or if it is wider by a little only. Echoes narrower than the outgoing pulse show that another receiver
    recorded the latter.
    """
    path = strip.with_suffix(SYSTEM_SUFFIX)
    sent = load_survey(path).survey if path.is_file() else None
    if sent is None or sent.figures.outgoing_fwhm_ns is None or not found.waveforms:
        return found
    ours, theirs = found.system.sigma_ref * FWHM_PER_SIGMA, sent.figures.outgoing_fwhm_ns
    learned = bool(found.figures.misfit_gaussians)
    ratio = ours / theirs
    if not learned:
        take, why = ratio > 1 - SAME, "too few echoes show the pulse"
    elif abs(ratio - 1) <= SAME:
        take, why = False, "both agree, and echoes have passed the receiver too"
    elif ratio < 1:
        take, why = False, "echoes are narrower, so another receiver recorded the outgoing pulses"
    else:
        take = bool(sent.figures.outgoing_same_receiver) or ratio < WIDENED
        why = "targets widened the echoes" if take else "their receiver is slower than that of the outgoing pulses"
    rings = f"after-pulses {100 * found.system.ringing:.1f} and {100 * sent.system.ringing:.1f} %"
    text = f"echoes {ours:.3f} ns wide at half maximum, outgoing pulses {theirs:.3f} ns, {rings}: {why}"
    # Not the name of the figure itself: a survey that is saved beside the strip is no file of outgoing pulses.
    figures = replace(found.figures, sent_fwhm_ns=theirs, sent_time_error_ns=sent.figures.outgoing_time_error_ns)
    shape = ("sigma_ref", "components", "kappa", "ringing")
    pulse = {name: getattr(sent.system, name) for name in shape} if take else {}
    # Pulses of various widths scatter those of echoes, and their heights, whichever digitizer records them.
    share, whole = sent.figures.outgoing_width_scatter or 0.0, replace(found.system, **pulse)
    system, *others = (
        replace(one, widths=replace(one.widths, scatter=max(one.widths.scatter, share * one.sigma_ref)))
        for one in (whole, *whole.digitizers.values())
    )
    system = replace(system, digitizers=dict(zip(whole.digitizers, others, strict=True)))
    return replace(found, system=system, figures=figures, decisions=(*found.decisions, Decision(PART, take, text)))
