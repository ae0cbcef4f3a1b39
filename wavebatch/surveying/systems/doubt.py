"""Whether the pulse or the noise of a survey is a guess, for `survey` and `run`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import StripWarning
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse
from wavebatch.kernels.elementary import log
from wavebatch.stages.flags import find_unexplained, list_neighbours
from wavebatch.surveying.measuring.lone_echoes import MIN_SNR
from wavebatch.surveying.measuring.noise_and_width import FEW, HALVED
from wavebatch.surveying.measuring.residuals import hides_noise
from wavebatch.surveying.systems.figures import Figures
from wavebatch.surveying.systems.known_systems import find_source

WEAKER, REACH = 0.5, 15
"""Height over that of a stronger echo, and distance from it [system widths], up to which one may be a part of it."""

SAME_RATIO, CHANCE_RATIO = 0.3, 0.35
"""Difference of the logarithms of two ratios up to which they are alike, and share of ratios that are so by chance."""

MOST_SPREAD = 0.05
"""Difference of widths, among pulses that describe the waveforms as well, from which the width is a guess where no
echoes stand alone: that of close pairs that a pulse takes for one."""

MOST_DOUBTED, MOST_DOUBTED_KNOWN = 0.15, 0.05
"""Share of the echoes in doubt, because another pulse, misfit or noise serves as well, from which a survey's pulse is
called a guess; of a known pulse, from which its noise is."""


def doubt_survey(system: SystemPulse, figures: Figures, waveforms: int) -> Iterator[StripWarning]:
    """Say that pulse or noise is a guess: too few echoes to learn a pulse from, echoes that another one does not find,
    or no samples to measure noise in.
    """
    alone, doubt = figures.isolated_echoes, figures.echoes_in_doubt
    if alone is None:
        return
    # Known systems are read and compared only where that decides.
    known = (alone < FEW or (doubt or 0.0) > MOST_DOUBTED_KNOWN) and find_source(system) is not None
    most = MOST_DOUBTED_KNOWN if known else MOST_DOUBTED
    reason = f"{100 * doubt:.0f} % of the echoes in doubt" if doubt is not None and doubt > most else ""
    # So few that the judge sees what the pulse was learned from: many Gaussians explain any waveforms, and a shipped
    # pulse may be that of another sensor. Of more waveforms the judge knows the width, or that it does not.
    unsure = figures.width_in_doubt is None or figures.width_in_doubt > MOST_SPREAD
    few = alone < FEW and (waveforms < HALVED or (unsure and not (known or system.components)))
    if few:
        reason = f"too few isolated echoes, {int(alone)} where {FEW} are needed"
    measured = system.noise.by_kind
    unseen = measured.get("quiet") == 0 and "outside" not in measured
    if unseen and not reason:
        reason = "too few samples without signal"
    remedy = "give --system, a survey of a longer strip of this sensor"
    hidden = hides_noise(system.noise)
    if hidden and not reason:
        reason, remedy = "most of the noise below count 0", "raise the level of the digitizer in the next flight"
    if reason:
        code, guess = "pulse-guess", f"system pulse is a guess, of {FWHM_PER_SIGMA * system.sigma_ref:.3g} ns"
        if unseen or hidden:
            code, guess = "noise-guess", f"noise is a guess, of {system.noise.std:.3g} DN"
        elif known and not few:
            misfit = f"{100 * system.misfit:.2g} %" if system.misfit else "none found"
            noise = f"noise, {system.noise.std:.3g} DN"
            code, guess = "noise-guess", f"{noise}, and the pulse's misfit, {misfit}, are guesses"
        yield StripWarning(
            code, f"the survey found {reason}: the {guess}, and widths, errors and the number of echoes depend on it; "
            f"{remedy}",
        )  # fmt: skip


def share_unexplained(system: SystemPulse, echoes: EchoTable, spacing: float) -> float:
    """Share of the clear echoes whose samples the pulse and the noise do not explain; 0 with too few of them."""
    clear = echoes.amplitude > MIN_SNR * system.noise.std
    unexplained = find_unexplained(echoes, system, spacing)[clear] > 1
    return float(np.mean(unexplained)) if len(unexplained) >= FEW else 0.0


def share_repeated(echoes: EchoTable, width: float) -> float:
    """Twice the share of the echoes that, beyond chance, stand beside stronger ones, all at one lag and one ratio.

    A pulse that few echoes show only roughly leaves such parts of it, each at its place.
    """
    pairs = []
    for row, other, lag in list_neighbours(echoes):
        ratio = echoes.amplitude[row] / echoes.amplitude[other]
        near = (ratio < WEAKER) & (np.abs(lag) < REACH * width)
        pairs.append(np.stack([lag[near] / width, log(ratio[near])]))
    lags, ratios = np.concatenate(pairs, axis=1) if pairs else np.empty((2, 0))
    most = 0.0
    for centre in np.arange(-REACH, REACH, 0.5):
        here = np.abs(lags - centre) <= 1
        if np.count_nonzero(here) >= FEW:
            alike = np.abs(ratios - np.median(ratios[here])) < SAME_RATIO
            chance = max(np.mean(alike[~here]), 0.1) if np.count_nonzero(~here) >= FEW else CHANCE_RATIO
            most = max(most, float(np.count_nonzero(alike & here) - chance * np.count_nonzero(here)))
    return 2 * most / max(len(echoes), 1)
