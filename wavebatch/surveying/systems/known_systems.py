"""Pulses of known sensors, measured on real strips and shipped as SYSTEM.toml files in this folder; what is a guess.

`survey` takes one where a strip has too few echoes to learn a pulse from; `wavebatch survey` names the one that a
strip's pulse looks like. Before you change it: a wrong pulse is worse than none, so the margins must keep simulated
strips of other sensors from getting one (tests/surveying/test_survey.py).

`doubt_survey` says for `survey` and `run` whether pulse or noise of a survey are a guess.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import StripWarning
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import median, quantiles
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import parse_toml
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import pulse_shape, shape_limits
from wavebatch.surveying.measuring.noise_and_width import FEW, HALVED, find_strongest, fit_lone
from wavebatch.surveying.measuring.residuals import hides_noise, subtract_echoes
from wavebatch.surveying.systems.figures import Figures, read_system

LEAST_ECHOES = 8
"""Strong single echoes below which no pulse is taken: eight that all agree are chance once in 256 times."""

LEAST_SNR = 10.0
"""Least amplitude of these echoes, over the noise: below it noise hides the misfit of any pulse."""

BEFORE, AFTER = 4.0, 9.0
"""Widths of the pulse before and after an echo in which the misfit is measured: both shipped pulses with their
after-pulses lie within."""

SAME_SPACING = 0.01
"""How far the spacing of a strip may be from that of a known sensor, as a share of it."""


ALIKE = 0.05
"""Difference of two pulses, as `compare_pulses` measures it, up to which one looks like the other ..."""

NOT_A_GAUSSIAN = 0.5
"""... and over that of the known pulse to its best Gaussian: else every Gaussian of this width would look like it."""

NO_FIT = 1e6
"""Misfit of an echo to which the pulse cannot be fitted."""


@frozen
class KnownSystem:
    """A shipped pulse."""

    name: str
    """Of the file, for example riegl-q680i."""
    sensor: str
    """For people, for example RIEGL LMS-Q680i."""
    spacing: float
    """Of the samples that it was measured with [ns]."""
    unlike_gaussian: float
    """Difference from the Gaussian that is most like it, as `compare_pulses` measures it; to measure it takes longer
    than to survey some strips."""
    system: SystemPulse


@cache
def known_systems() -> tuple[KnownSystem, ...]:
    """Return the shipped pulses by name."""
    found = []
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        table = parse_toml(read_text(path, "system file"), str(path))
        spacing = table.table("figures").number("spacing_ns", 1e-3, 1e3)
        unlike = table.number("unlike_gaussian", 0.0, 1.0)
        system = read_system(table.table("system"))
        found.append(KnownSystem(path.stem, table.get("sensor", str), spacing, unlike, system))
    return tuple(found)


def list_known(block: WaveformBlock, system: SystemPulse) -> dict[str, SystemPulse]:
    """The system with the pulse of each shipped sensor whose samples are as far apart, by name."""
    near = (known for known in known_systems() if abs(block.spacing / known.spacing - 1) < SAME_SPACING)
    return {known.name: with_pulse(system, known.system) for known in near}


def find_lone(block: WaveformBlock, system: SystemPulse) -> EchoTable:
    """Return the single echoes of a block by Gaussian fits: one per waveform, not clipped."""
    return fit_lone(block, pooled_noise(block, system), system, LEAST_SNR, fraction=0.5)


def fit_alone(block: WaveformBlock, system: SystemPulse, lone: EchoTable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit the pulse of a system to single echoes.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    lone : EchoTable
        m echoes, one per waveform.

    Returns
    -------
    misfit : float64 (m,)
        Root mean square of what is left from BEFORE to AFTER the echo, as a share of the amplitude; or NO_FIT.
    left : float64 (m, s)
        What is left of the waveform, as a share of the amplitude.
    lag : float64 (m, s)
        Of the samples after the echo [ns].
    """
    part, m = block.rows(lone.waveform), len(lone)
    start = replace(lone, waveform=np.arange(m, dtype=np.int32))
    fitted = adaptive(part, pooled_noise(part, system), system, start, max_echoes=1, significance=0.0)
    fitted = fitted.take(find_strongest(fitted, m)[0])
    fitted = fitted.take(np.flatnonzero(fitted.amplitude > 0))
    left = np.full(part.samples.shape, np.nan)
    lag = np.full(part.samples.shape, np.inf)
    rows = fitted.waveform
    left[rows] = subtract_echoes(part, system, fitted)[rows] / fitted.amplitude[:, None]
    lag[rows] = np.arange(part.samples.shape[1]) * part.spacing - fitted.time[:, None].astype(np.float64)
    near = (lag > -BEFORE * system.sigma_ref) & (lag < AFTER * system.sigma_ref) & np.isfinite(left)
    number = near.sum(axis=1)
    power = np.where(near, left, 0.0) ** 2
    return np.where(number > 0, np.sqrt(power.sum(axis=1) / np.maximum(number, 1)), NO_FIT), left, lag


def guess_width(block: WaveformBlock, system: SystemPulse) -> SystemPulse | None:
    """Return the Gaussian of the narrower single echoes; None with fewer than LEAST_ECHOES of them.

    The lower quartile, without what noise takes off it: widths of one surface then give their median. Of all echoes:
    noise makes the strongest of many weak ones both high and narrow.
    """
    lone = find_lone(block, system)
    if len(lone) < LEAST_ECHOES:
        return None
    low, middle = quantiles(lone.sigma, (0.25, 0.5))
    width = min(low + 0.674 * float(median(lone.sigma_err)), middle)
    # Not below half a sample, as for isolated echoes: spikes are no pulses.
    return replace(system, sigma_ref=max(float(width), 0.5 * block.spacing))


def with_pulse(system: SystemPulse, known: SystemPulse) -> SystemPulse:
    """Return a strip's system with the pulse of another one, and with how far strong echoes deviate from it."""
    names = ("sigma_ref", "kappa", "components", "ringing", "acceptance", "misfit", "tail_misfit")
    widths = replace(system.widths, scatter=known.widths.scatter)
    return replace(system, widths=widths, **{name: getattr(known, name) for name in names})


def find_source(system: SystemPulse) -> KnownSystem | None:
    """Return the known sensor whose pulse a system has, bit for bit; None for a pulse of its own."""
    same = (one for one in known_systems() if one.system.pulse == system.pulse)
    return next(same, None) if system.components or system.kappa else None


class Likeness(NamedTuple):
    """The known sensor whose pulse is nearest to that of a strip."""

    known: KnownSystem
    difference: float
    """As `compare_pulses` measures it."""

    def describe(self) -> str:
        """Return the sentence for people."""
        return f"this strip's pulse looks like {self.known.sensor}; it differs by {100 * self.difference:.1f} %"


def find_likeness(system: SystemPulse, spacing: float) -> Likeness | None:
    """Find the known sensor whose pulse a system's pulse looks like.

    Parameters
    ----------
    system : SystemPulse
        With its pulse.
    spacing : float
        Of its samples [ns].

    Returns
    -------
    Likeness or None
        None where no pulse was learned, or no known one of this spacing is within ALIKE of it.
    """
    if not (system.components or system.kappa):
        return None
    near = (known for known in known_systems() if abs(spacing / known.spacing - 1) < SAME_SPACING)
    found = [Likeness(known, compare_pulses(system, known.system)) for known in near]
    best = min(found, key=lambda one: one.difference, default=None)
    if best is None or best.difference >= min(ALIKE, NOT_A_GAUSSIAN * best.known.unlike_gaussian):
        return None
    return best


def compare_pulses(a: SystemPulse, b: SystemPulse) -> float:
    """Return how far two pulses differ, once they are shifted and scaled onto each other.

    Returns
    -------
    float
        Root of the energy that is left over the energy of the pulse; 0 for equal pulses. Two Gaussians whose widths
        differ by 2 % differ by 0.014.
    """
    step = 0.02 * min(a.sigma_ref, b.sigma_ref)
    reach = 30.0 * max(a.sigma_ref, b.sigma_ref)
    lag = np.arange(-reach, reach, step)
    first, second = draw_pulse(a, lag), draw_pulse(b, lag)
    # Zeros after the pulses, so that shifts do not wrap around; sizes other than powers of two take up to 25 times as
    # long.
    size = 1 << (2 * len(lag)).bit_length()
    spectrum = np.fft.rfft(first, size) * np.conj(np.fft.rfft(second, size))
    together = float(np.fft.irfft(spectrum, size).max())
    share = together**2 / float(np.sum(first * first) * np.sum(second * second))
    return round(float(np.sqrt(max(1.0 - share, 0.0))), 6)  # the rest is rounding, and differs between processors


def draw_pulse(system: SystemPulse, lag: np.ndarray) -> np.ndarray:
    """Return the height of a system's pulse at times after the centre of its main component [ns], f8 of that shape."""
    width = shape_limits(system, 1.0).ref
    return evaluate_pulse(pulse_shape(system, 1.0), lag[:, None], np.zeros(1), np.full(1, width))[0][:, 0]


MOST_SPREAD = 0.05
"""Difference of widths, among pulses that describe the waveforms as well, from which the width is a guess where no
echoes stand alone: that of close pairs that a pulse takes for one."""

MOST_DOUBTED, MOST_DOUBTED_KNOWN = 0.15, 0.05
"""Share of the echoes in doubt, because another pulse, misfit or noise serves as well, from which a survey's pulse is
called a guess; of a known pulse, from which its noise is."""

MADE_BY_NOISE, LEAST_MADE = 0.03, 4
"""Share of the echoes that mirrored noise makes, and number of them, from which noise is not what the survey took it
for: it differs between waveforms, or a baseline is not level. The survey raises its significance at .75 %; of the six
real strips 1 % are left at most, of simulated ones that were right .7 %."""

MOST_PLACED = 0.03
"""Share of the echoes that stand where parts of the pulse would, as many as may be false in a strip that is right."""


def doubt_survey(system: SystemPulse, figures: Figures, waveforms: int) -> Iterator[StripWarning]:
    """Say that pulse or noise is a guess: too few echoes to learn a pulse from, echoes that another one does not find,
    or no samples to measure noise in.
    """
    alone, doubt = figures.isolated_echoes, figures.echoes_in_doubt
    if alone is None:
        return
    # Known systems are read and compared only where that decides.
    known = (alone < FEW or (doubt or 0.0) > MOST_DOUBTED_KNOWN) and find_source(system) is not None
    # Waveforms that a pulse was learned from tell little against it: enough where width and echoes are both in doubt.
    both = waveforms < HALVED and (figures.width_in_doubt or 0.0) > MOST_SPREAD
    most = MOST_DOUBTED_KNOWN if known or both else MOST_DOUBTED
    reason = f"{100 * doubt:.0f} % of the echoes in doubt" if doubt is not None and doubt > most else ""
    # So few that the judge sees what the pulse was learned from: many Gaussians explain any waveforms, and a shipped
    # pulse may be that of another sensor. Of more waveforms the judge knows the width, or that it does not.
    unsure = figures.width_in_doubt is None or figures.width_in_doubt > MOST_SPREAD
    # All pulses that these do not exclude may agree, unless there are hardly more waveforms than a pulse needs echoes.
    agreed = waveforms >= 2 * FEW and not unsure and doubt is not None and doubt <= MOST_DOUBTED_KNOWN
    few = alone < FEW and (not agreed if waveforms < HALVED else unsure and not (known or system.components))
    if few:
        reason = f"too few isolated echoes, {int(alone)} where {FEW} are needed"
    unseen = system.noise.by_kind.get("quiet") == 0
    if unseen and not reason:
        reason = "too few samples without signal"
    remedy = "give --system, a survey of a longer strip of this sensor"
    hidden = hides_noise(system.noise)
    if hidden and not reason:
        reason, remedy = "most of the noise below count 0", "raise the level of the digitizer in the next flight"
    made = figures.false_in_noise_share or 0.0
    many = made * waveforms * (figures.echoes_per_waveform or 0.0) >= LEAST_MADE
    noisy = not reason and made > MADE_BY_NOISE and many
    if noisy:
        reason = f"that noise made {100 * made:.0f} of 100 echoes"
        remedy = "some waveforms may have more noise or interference, or baselines are not level: "
        remedy += "draw some with `wavebatch plot waveform`"
    placed = figures.placed_share or 0.0
    if placed > MOST_PLACED and not reason:
        reason = f"that {100 * placed:.0f} of 100 echoes repeat beside stronger ones, as parts of a pulse do"
        remedy = "a layer of the scene does so too: draw some with `wavebatch plot waveform`"
    if reason:
        code, guess = "pulse-guess", f"system pulse is a guess, of {FWHM_PER_SIGMA * system.sigma_ref:.3g} ns"
        if unseen or hidden or noisy:
            code, guess = "noise-guess", f"noise is a guess, of {system.noise.std:.3g} DN"
        elif known and not few:
            guess = f"noise of {system.noise.std:.3g} DN is a guess, as is the pulse's misfit"
            code, guess = "noise-guess", f"{guess} of {100 * system.misfit:.2g} % of the amplitude"
        yield StripWarning(
            code, f"the survey found {reason}: the {guess}, and widths, errors and the number of echoes depend on it; "
            f"{remedy}",
        )  # fmt: skip
