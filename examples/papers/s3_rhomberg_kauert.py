"""Rhomberg-Kauert, Poeppl, Pfennigbauer, Mandlburger (2024), Angle of incidence from echo pulse width.

The table of widths by angle as printed and as corrected, the footprint by Monte Carlo, the errors of angles, and what
its figure 6 shows: angles from fitted widths minus the true ones, with their pile-up at 0 (docs/algorithms.md 1.4).

    python examples/papers/s3_rhomberg_kauert.py [--seed N] [--number ECHOES]
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from table import Table, main, scatter

from wavebatch.core.units import FWHM_PER_SIGMA, C
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.physics.incidence import (
    angles_of_variance,
    direct_width,
    paper_table,
    pulse_table,
    spread_of_angle,
    spread_pulse,
    spread_variance,
)
from wavebatch.stages.chain import parse_chain
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.detect.direct import maximum
from wavebatch.tools.simulate.render import record_counts

HEIGHT, DIVERGENCE, LENGTH = 640.0, 1.1e-3, 1.5
"""Range [m], full divergence [rad] and length of the pulse [ns] of the paper's sensor, assumed."""
FWHM_PER_TAU = 3.3946780749849567
"""Full width at half maximum of t^2 exp(-t), in tau (docs/algorithms.md 1.4); of the printed t exp(-t) it is 3.5."""
PULSE_SIGMA = LENGTH / FWHM_PER_SIGMA
"""Standard deviation of the pulse [ns]."""
DEGREES = (5, 10, 20, 30, 45, 60, 75)
WIDTHS = {
    "as printed": (1.9259, 1.9725, 2.1257, 2.3534, 2.8934, 3.9601, 7.1218),
    "corrected": (2.6815, 2.8070, 3.2490, 3.9250, 5.5356, 8.6708, 17.7907),
    "Gaussian closed form": (2.5809, 2.6792, 3.0683, 3.7209, 5.3432, 8.5244, 17.7121),
    "4 x fitted Gaussian": (None, 2.7000, 3.1547, 3.8598, 5.5076, 8.6620, 17.7894),
}
"""Widths at e^-2 [ns] by angle."""
SPREADS = {5: 0.1027, 10: 0.2069, 20: 0.4274, 30: 0.678, 45: 1.172, 60: 2.036, 80: 6.67}
"""Standard deviations of the pulse's spread [ns] by angle."""
ERRORS = {
    20: (7.2, 5.9, 6.4, 6.2, 5.3, 4.6, 5.4, 8.5, None),
    50: (4.5, 3.9, 3.4, 2.2, 1.9, 1.7, 2.0, 2.7, 6.1),
    100: (3.2, 2.7, 1.5, 1.1, 0.9, 0.9, 1.0, 1.3, 2.1),
    300: (1.8, 1.0, 0.5, 0.4, 0.3, 0.3, 0.3, 0.4, 0.7),
}
"""Rms errors [deg] of angles of 0, 5, 10, 15, 20, 30, 45, 60, 75 degrees, by A/sn of an echo of 0 degrees."""
FULL = 20_000
"""Echoes that the bands hold for."""
READ_AS_ZERO = {(20, 5): 43, (50, 5): 32}
"""Share of the echoes that are narrower than the pulse [%], by A/sn and angle."""
TRUE_DEGREES = (0, 5, 10, 15, 20, 30, 45, 60, 75)


def table_of_widths() -> Table:
    """Width of the echo at e^-2 by angle."""
    table = Table("width at e^-2 [ns] by angle", 4)
    spreads = spread_of_angle(np.radians(DEGREES), HEIGHT, DIVERGENCE)
    time, curves = spread_pulse(2, spreads, LENGTH / FWHM_PER_TAU)
    printed, fitted = paper_table(PULSE_SIGMA), pulse_table(2.5364 / 4, 0.05)
    ours = {
        "as printed": 4 * np.interp(spreads, printed.spread, printed.width),
        "corrected": np.array([direct_width(time, curve, np.exp(-2.0)) for curve in curves]),
        "Gaussian closed form": 4 * np.hypot(PULSE_SIGMA, spreads),
        "4 x fitted Gaussian": 4 * np.interp(spreads, fitted.spread, fitted.width),
    }
    for name, expected in WIDTHS.items():
        for degrees, width, value in zip(DEGREES, ours[name], expected, strict=True):
            if value is not None:
                table.near(f"{name}, {degrees}", width, value, share=0.005)
    # The paper looks up widths of fitted Gaussians in a table of direct widths.
    degrees = np.arange(0, 12.5, 0.5)
    spreads = spread_of_angle(np.radians(degrees), HEIGHT, DIVERGENCE)
    time, curves = spread_pulse(2, spreads, LENGTH / FWHM_PER_TAU)
    direct = np.array([direct_width(time, curve, np.exp(-2.0)) for curve in curves])
    fit = 4 * np.interp(spreads, fitted.spread, fitted.width)
    table.near("corrected, 0", direct[0], 2.6403, share=0.005)
    table.near(
        "10 deg fitted, looked up as direct [deg]", np.interp(fit[20], direct, degrees), 6.0, within=0.06, digits=1
    )
    table.near("  read as 0 below [deg]", np.interp(direct[0], fit, degrees), 7.9, within=0.06, digits=1)
    return table


def table_of_footprints(number: int, seed: int) -> Table:
    """Spread by a plane under a Gaussian beam: rays of a footprint against the closed form."""
    table = Table("std of the spread by angle [ns]", 4)
    x, y = np.random.default_rng(seed).normal(0.0, HEIGHT * DIVERGENCE / 4, (2, 10 * number))
    for degrees, expected in SPREADS.items():
        ray = np.stack([x / HEIGHT, y / HEIGHT, np.ones_like(x)])
        distance = HEIGHT / (1.0 - np.tan(np.radians(degrees)) * ray[0]) * np.sqrt((ray**2).sum(axis=0))
        closed = float(spread_of_angle(np.radians(degrees), HEIGHT, DIVERGENCE))
        table.near(f"Monte Carlo, {degrees}", np.std(2 * distance / C), expected, share=0.01)
        table.near(f"closed form, {degrees}", closed, expected, share=0.01)
    return table


def table_of_errors(number: int, seed: int) -> Table:
    """Rms errors of angles from widths at their bound, and angles read as 0."""
    table = Table("rms error of the angle [deg]; read as 0 [%]", 1, scatter(number, FULL))
    rng = np.random.default_rng(seed)
    for snr, expected in ERRORS.items():
        for degrees, rms in zip(TRUE_DEGREES, expected, strict=True):
            true = np.radians(degrees)
            sigma = np.hypot(PULSE_SIGMA, spread_of_angle(true, HEIGHT, DIVERGENCE))
            amplitude = snr * np.cos(true) * PULSE_SIGMA / sigma
            found = sigma + bound_time(amplitude, sigma, 1.0, 1.0) * rng.standard_normal(number)
            error = bound_time(amplitude, np.maximum(found, 0.2), 1.0, 1.0)
            spread = found**2 - PULSE_SIGMA**2
            angle, _ = angles_of_variance(spread, 2 * found * error, np.full(number, HEIGHT), DIVERGENCE)
            if rms is not None:
                ours = np.degrees(np.sqrt(np.nanmean((angle - true) ** 2)))
                table.near(f"SNR {snr}, {degrees} deg", ours, rms, within=0.07, share=0.06, digits=2 if rms < 1 else 1)
            if degrees == 0:
                table.near(f"SNR {snr}, 0 deg: read as 0", 100 * np.mean(angle == 0), 50, within=1.5)
            elif (snr, degrees) in READ_AS_ZERO:
                share = 100 * np.mean(angle == 0)
                table.near(f"SNR {snr}, {degrees} deg: read as 0", share, READ_AS_ZERO[snr, degrees], within=1.8)
    return table


def fitted_angles(degrees: np.ndarray, snr: float, mode: str, rng: np.random.Generator) -> np.ndarray:
    """Angles [deg] that Gaussians fitted to simulated echoes, sampled every 0.5 ns, have for planes of `degrees`."""
    spread = spread_of_angle(np.radians(degrees), HEIGHT, DIVERGENCE)
    recording = fine_recording(1.0, PULSE_SIGMA, n_samples=96, spacing=0.5)
    sigma = np.hypot(PULSE_SIGMA, spread)
    amplitude = snr * np.cos(np.radians(degrees)) * PULSE_SIGMA / sigma
    time = 24 + rng.uniform(-0.25, 0.25, (len(degrees), 1))
    block, _ = simulate_echoes(recording, time, FINE * amplitude[:, None], sigma[:, None], rng)
    noise, system = known_noise(recording, len(block)), known_system(recording)
    found = gaussian(block, noise, system, maximum(block, noise, system))
    angles = np.full(len(degrees), np.nan)
    alone = found.take(found.count(len(block))[found.waveform] == 1)
    width = alone.sigma.astype(np.float64)
    variance = spread_variance(paper_table(PULSE_SIGMA), width) if mode == "paper" else width**2 - PULSE_SIGMA**2
    error = 2 * width * alone.sigma_err
    angles[alone.waveform] = np.degrees(angles_of_variance(variance, error, np.full(len(alone), HEIGHT), DIVERGENCE)[0])
    return angles


def strike_planes(degrees: float, snr: float, n: int, rng: np.random.Generator) -> WaveformBlock:
    """Waveforms of a tilted plane, as sums of the pulses of 400,000 rays of the footprint; nothing else is put in.

    The pulse is a Gaussian of PULSE_SIGMA, each ray has the distance at which it meets the plane. Samples every 0.5 ns.
    """
    x, y = rng.normal(0.0, HEIGHT * DIVERGENCE / 4, (2, 400_000)) / HEIGHT
    distance = HEIGHT / (1.0 - np.tan(np.radians(degrees)) * x) * np.sqrt(x * x + y * y + 1.0)
    step, start = 0.01, 2 * HEIGHT / C - 30.0
    bins = np.bincount(np.rint((2 * distance / C - start) / step).astype(np.int64).clip(0, 5999), minlength=6000)
    fine = np.arange(-500, 501) * step
    signal = np.convolve(bins / len(x), np.exp(-0.5 * (fine / PULSE_SIGMA) ** 2), "same") * np.cos(np.radians(degrees))
    recording = fine_recording(1.0, PULSE_SIGMA, n_samples=120, spacing=0.5)
    phase = rng.uniform(-0.25, 0.25, (n, 1))
    values = snr * FINE * np.interp(np.arange(120) * 0.5 + phase, np.arange(6000) * step, signal)
    block = WaveformBlock.from_samples(record_counts(recording, values.astype(np.float32), rng), spacing=0.5)
    # The middle of the footprint lies 30 ns after sample 0.
    return replace(block, sensor=block.origin + [0.0, 0.0, HEIGHT - 15.0 * C])


def table_of_rays(number: int, seed: int) -> Table:
    """Angles of planes whose waveforms are summed ray by ray, by the chain that a user runs."""
    title = "planes ray by ray: angle by decompose.gaussian and attribute.incidence_angle"
    table = Table(title, 2, scatter(number, FULL))
    rng, n = np.random.default_rng(seed), max(number // 40, 30)
    level = strike_planes(0.0, 200.0, 4 * n, rng)
    recording = fine_recording(1.0, PULSE_SIGMA, n_samples=120, spacing=0.5)
    names = ("noise.pooled", "detect.maximum", "decompose.gaussian", "attribute.position")
    chain = parse_chain("".join(f'[[chain]]\nstage = "{name}"\n' for name in names), "papers")
    plain = known_system(recording)
    widths = chain.run(level, plain).sigma
    # The system pulse is what level ground shows, as a survey has it.
    system = replace(plain, sigma_ref=float(np.median(widths))).with_radiometry(divergence=1e3 * DIVERGENCE)
    table.near("width of level ground over the pulse", system.sigma_ref / PULSE_SIGMA, 1.0, within=0.01)
    angles = parse_chain(
        "".join(f'[[chain]]\nstage = "{name}"\n' for name in (*names, "attribute.incidence_angle"))
        + "max_error = 90.0\n",
        "papers",
    )
    for degrees in (10, 20, 30, 45, 60):
        found = angles.run(strike_planes(degrees, 200.0, n, rng), system).attributes
        off, error = found["incidence_angle"] - degrees, found["incidence_angle_err"]
        known = np.isfinite(off)
        table.add(f"{degrees} deg: known [%]", 100 * known.mean(), 100 - table.room, digits=1)
        within = 4 * float(np.median(error[known])) / np.sqrt(n) + 0.15
        table.near(f"{degrees} deg: median less truth [deg]", np.median(off[known]), 0.0, within=within)
        covered = 100 * np.mean(np.abs(off[known]) < error[known])
        # 500 planes scatter by 2 points; of 10 degrees a seventh is cut off at 0, which is nearer.
        table.near_share(f"{degrees} deg: within one error [%]", covered, 70, within=8, spec=68, digits=1)
    return table


def figure_of_differences(number: int, seed: int) -> tuple[Table, str]:
    """Figure 6: angle from the fitted width minus the true one, of roofs of 0 to 60 degrees at SNR 100."""
    rng = np.random.default_rng(seed)
    true = rng.choice([0.0, 10, 20, 30, 40, 50, 60], number)
    found = fitted_angles(true, 100.0, "system", rng)
    off, known = found - true, np.isfinite(found)
    table = Table("figure 6: angle from the width minus the true one", 1, scatter(number, FULL // 2))
    table.add("found [%]", 100 * known.mean(), 100 - 0.3 * table.room)
    table.near("median [deg]", np.median(off[known]), 0.0, within=0.05, digits=2)
    within = 100 * np.mean(np.abs(off[known & (true >= 10)]) < 5)
    table.add("within 5 deg, slopes of 10 and more [%]", within, 100 - 0.3 * table.room)
    table.near("level planes read as 0 [%]", 100 * np.mean(found[known & (true == 0)] == 0), 50, within=5)
    printed = fitted_angles(true, 100.0, "paper", rng)
    some = true == 30
    name = "30 deg by the printed formulas, median [deg]"
    table.near(name, np.nanmedian(printed[some]), 57.5, within=0.3, spec=None)
    edges = np.arange(-12, 14, 2) - 1.0
    counts = np.histogram(np.clip(off[known], -11.9, 11.9), edges)[0]
    bars = [f"{a + 1:4.0f} |{'#' * round(60 * c / counts.max())} {c}" for a, c in zip(edges, counts, strict=False)]
    return table, "\n".join(["angle minus truth [deg], bins of 2 deg", *bars])


def measure(number: int, seed: int) -> list[Table | str]:
    """All tables, and the histogram."""
    return [
        table_of_widths(),
        table_of_footprints(number, seed),
        table_of_rays(number, seed),
        table_of_errors(number, seed),
        *figure_of_differences(max(number // 2, 10), seed),
    ]


if __name__ == "__main__":
    raise SystemExit(main(measure, __doc__, 20_000))
