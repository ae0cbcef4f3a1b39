"""Wagner, Roncat, Melzer, Ullrich (2007), Waveform analysis techniques in airborne laser scanning: tables 1 and 2.

Maxima, Gaussian decomposition and the average square difference function (ASDF) on the same simulated waveforms: the
resolution of the ASDF, the bias of its parabola, the effect of ringing on the number of echoes, and cross sections by
a calibration target (docs/algorithms.md 1.1, 5).

    python examples/papers/s0_wagner.py [--seed N] [--number WAVEFORMS]
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import WAGNER
from s1_wang import find_raw_maxima
from table import Table, main, scatter

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import HALF_C, MAD_TO_STD
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.signal.signal import SMOOTH_GAIN
from wavebatch.stages.attribute.basic import position
from wavebatch.stages.attribute.radiometry import cross_section
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.detect.direct import TWICE_SMOOTHED_GAIN, maximum
from wavebatch.stages.detect.transformed import asdf
from wavebatch.stages.score import match_echoes
from wavebatch.tools.simulate import shape_pulse, simulate_block
from wavebatch.tools.simulate.scenes import LogNormal

PAPER_RULE = {"rule": "paper", "interpolation": "parabola"}
RESOLUTION = {1.0: (3.58, 3.43, 3.24, 3.14), 0.5: (4.76, 4.34, 3.95, 3.74), 0.35: (5.75, 4.97, 4.33, 4.00)}
"""Least distance of two resolved echoes [sigma], for fractions of 0.3, 0.2, 0.1, 0.05; by ratio of amplitudes."""
FRACTIONS = (0.3, 0.2, 0.1, 0.05)
ONCE_SMOOTHED = 4 * SMOOTH_GAIN / TWICE_SMOOTHED_GAIN
"""The specification's maxima are 4 sigma high in the waveform smoothed once; our detector smooths it twice."""
FULL = 4000
"""Waveforms that the bands hold for."""
COUNTS = {
    ("no ringing", "maxima", 1): (62.3, 2.0, 63),
    ("ringing of 5 %", "maxima", 1): (50.8, 2.0, 52),
    ("ringing of 5 %", "shipped maxima", 1): (46.0, 2.0, None),
    ("no ringing", "maxima", 3): (7.1, 1.2, 6.5),
    ("ringing of 5 %", "maxima", 3): (12.6, 1.4, 12.3),
    ("no ringing", "ASDF", 1): (70.5, 2.2, 71.6),
    ("ringing of 5 %", "ASDF", 1): (70.7, 2.2, 71.6),
}
"""Our share of the waveforms, how far FULL of them may be off, and the specification's share [%], by scene, method and
number of echoes. One share scatters by 0.4 to 0.8."""
OF_PAPER = {"maxima": 8.9, "ASDF": 11.2}
"""Table 1: share of the waveforms of sample 1 with three or more echoes [%], sums that the paper does not print."""
PRINTED = {
    "maxima": ("58.08, 51.54", "32.20, 35.23", "7.73, 10.86", "1.08, 1.67", "0.09, 0.27"),
    "ASDF": ("66.23, 60.96", "21.09, 24.24", "9.22, 11.48", "1.81, 2.47", "0.18, 0.24"),
    "ASDF, mean pulse": ("65.89, 60.64", "20.65, 23.63", "9.74, 12.15", "2.01, 2.70", "0.24, 0.27"),
}
"""Table 1 as printed: share of the waveforms with 1, 2, 3, 4, and 5 or more echoes [%], samples 1 and 2."""
WEAK = replace(WAGNER, amplitude=LogNormal(12.0, 0.8, 5.0, 230.0))
"""Echoes of 12 noise standard deviations instead of 25: there the paper's conclusion holds (`table_of_conclusions`)."""
TARGET, RANGES = 600.0, (300.0, 450.0, 600.0, 900.0, 1400.0)
"""Range of the calibration target and of the others [m]."""
BIAS = {0.85: 0.035, 1.0: 0.0242, 1.5: 0.0107, 1.7: 0.0083, 2.0: 0.0060, 3.0: 0.0027}
"""Bias of the parabola [ns] by sigma [ns]."""

Strip = tuple[WaveformBlock, EchoTable, Noise, SystemPulse]


def simulate(number: int, seed: int, ringing: float = 0.0) -> Strip:
    """The waveforms of the tables, with lobes of -ringing and +ringing after every echo."""
    recording = replace(WAGNER.recording, pulse=shape_pulse(WAGNER.recording.pulse, ringing=ringing))
    block, truth = simulate_block(WAGNER, number, np.random.default_rng(seed), recording=recording)
    return block, truth, known_noise(recording, number), known_system(recording)


def mean_pulse(block: WaveformBlock, truth: EchoTable, noise: Noise, reach: int = 10) -> str:
    """The mean of the clear single echoes, aligned at their highest samples, as the `pulse` of a reference."""
    alone = truth.take(np.flatnonzero((truth.count(len(block))[truth.waveform] == 1) & (truth.amplitude > 20)))
    top = np.rint(alone.time).astype(np.int64)
    inside = (top >= reach) & (top < block.samples.shape[1] - reach)
    rows, top = alone.waveform[inside], top[inside]
    signal = block.samples[rows] - noise.baseline[rows, None]
    mean = np.take_along_axis(signal, top[:, None] + np.arange(-reach, reach + 1), axis=1).mean(axis=0)
    return " ".join(f"{value:.5f}" for value in mean / mean.max())


def compare(a: EchoTable, b: EchoTable) -> tuple[float, np.ndarray]:
    """Share [%] of the echoes of both that are the same within 1 ns, and the differences of those [ns]."""
    match = match_echoes(a, b, 1.0)
    return 200 * len(match.found) / (len(a) + len(b)), a.time[match.found] - b.time[match.truth]


def table_of_differences(strip: Strip) -> Table:
    """Table 2: Gaussian decomposition and the ASDF with a mean pulse, each against the ASDF with a Gaussian."""
    block, truth, noise, system = strip
    table = Table("table 2: the same echoes by two methods", 3, scatter(len(block), FULL))
    gauss = asdf(block, noise, system, **PAPER_RULE)
    fitted = gaussian(block, noise, system, maximum(block, noise, system))
    same, difference = compare(fitted, gauss)
    known = {"paper": "86.7, 86.4", "spec": 85.8, "digits": 1}
    table.near("decomposition, identical within 1 ns [%]", same, 89.8, within=1.2, **known)
    middle = np.median(difference)
    table.near("  median difference [ns]", middle, 0.0, within=0.0006, paper="-0.0004, -0.0004", spec=0.0001, digits=4)
    rms = np.sqrt(np.mean(difference**2))
    table.near("  rms difference [ns]", rms, 0.122, within=0.014, paper="0.12, 0.13", spec=0.136)
    robust = MAD_TO_STD * np.median(np.abs(difference - np.median(difference)))
    table.near("  robust difference [ns]", robust, 0.0087, within=0.001, spec=0.009, digits=4)
    same, difference = compare(gaussian(block, noise, system, find_raw_maxima(block, noise, system)), gauss)
    name = "decomposition from maxima not smoothed, identical [%]"
    table.near(name, same, 87.5, within=1.2, **known)
    rms = np.sqrt(np.mean(difference**2))
    table.near("  from these, rms difference [ns]", rms, 0.142, within=0.022, paper="0.12, 0.13", spec=0.136)
    mean = asdf(block, noise, system, reference="given", pulse=mean_pulse(block, truth, noise), **PAPER_RULE)
    same, difference = compare(fitted, mean)
    table.near("decomposition and ASDF with a mean pulse, identical [%]", same, 89.8, within=1.2, paper="86.9, 86.8",
               spec=None, digits=1)  # fmt: skip
    known = {"paper": "0.0002, -7e-5", "spec": None, "digits": 4}
    table.near("  median difference of these [ns]", np.median(difference), 0.0, within=0.002, **known)
    rms = np.sqrt(np.mean(difference**2))
    table.near("  rms difference of these [ns]", rms, 0.122, within=0.014, paper="0.12, 0.13", spec=None)
    same, difference = compare(mean, gauss)
    known = {"paper": "98.7, 98.7", "spec": 99.6, "digits": 1}
    table.near("ASDF with a mean pulse and with a Gaussian, identical [%]", same, 99.7, within=0.25, **known)
    middle = np.median(difference)
    known = {"paper": "-0.0008, -0.001", "spec": None, "digits": 4}
    table.near("  their median difference [ns]", middle, 0.0, within=0.002, **known)
    rms = np.sqrt(np.mean(difference**2))
    table.near("  their rms difference [ns]", rms, 0.022, within=0.01, paper="0.05, 0.05", spec=0.020)
    return table


def table_of_counts(strips: dict[str, Strip]) -> Table:
    """Table 1: echoes per waveform, without and with ringing of 5 %."""
    number = len(strips["no ringing"][0])
    table = Table("table 1: share of the waveforms [%]", 1, scatter(number, FULL))
    shares = {key: share_counts(strip) for key, strip in strips.items()}
    for name, share in shares["no ringing"].items():
        for echoes in range(1, 6):
            more = " or more" * (echoes == 5)
            table.add(f"{name}: {echoes}{more}", share[echoes], paper=PRINTED.get(name, (None,) * 5)[echoes - 1])
    for (key, name, echoes), (expected, within, spec) in COUNTS.items():
        table.near(f"{name}: {echoes}, {key}", shares[key][name][echoes], expected, within=within, spec=spec)
    return table


def share_counts(strip: Strip) -> dict[str, np.ndarray]:
    """Shares [%] of the waveforms with 0, 1, 2, 3, 4, more echoes, by method."""
    block, truth, noise, system = strip
    maxima = maximum(block, noise, system, threshold=ONCE_SMOOTHED)
    pulse = mean_pulse(block, truth, noise)
    found = {
        "truth": truth,
        "maxima": maxima,
        "shipped maxima": maximum(block, noise, system),
        "decomposition": gaussian(block, noise, system, maxima),
        "ASDF": asdf(block, noise, system, **PAPER_RULE),
        "ASDF, mean pulse": asdf(block, noise, system, reference="given", pulse=pulse, **PAPER_RULE),
    }
    counts = {name: np.minimum(echoes.count(len(block)), 5) for name, echoes in found.items()}
    return {name: 100 * np.bincount(count, minlength=6) / len(block) for name, count in counts.items()}


def table_of_conclusions(number: int, seed: int) -> Table:
    """Table 1, its conclusion: which method finds more waveforms with three or more echoes.

    In the paper the ASDF does. Here, with echoes as strong as the rest of the paper's figures need, both find about the
    same: its 30 % rule loses weak echoes and its long reference joins close ones. With weaker echoes the rule is
    relative to so little that noise passes it, and the ASDF finds more, as in the paper; most of what it finds more is
    not there.
    """
    table = Table("table 1: waveforms with three or more echoes [%]", 1, scatter(number, FULL))
    for name, scene in (("echoes of 25 sigma", WAGNER), ("echoes of 12 sigma", WEAK)):
        block, truth = simulate_block(scene, number, np.random.default_rng(seed))
        noise, system = known_noise(scene.recording, number), known_system(scene.recording)
        found = {
            "maxima": maximum(block, noise, system, threshold=ONCE_SMOOTHED),
            "ASDF": asdf(block, noise, system, **PAPER_RULE),
        }
        shares = {key: 100 * np.mean(echoes.count(number) >= 3) for key, echoes in found.items()}
        table.add(f"{name}: truth", 100 * np.mean(truth.count(number) >= 3))
        for key, share in shares.items():
            ours = 8.6 if key == "maxima" else 8.6 if scene is WAGNER else 13.7
            table.near(f"{name}: {key}", share, ours, within=1.6, paper=f"{OF_PAPER[key]} (sum)")
        expected = 0.0 if scene is WAGNER else 5.0
        more = shares["ASDF"] - shares["maxima"]
        table.near(f"{name}: ASDF less maxima", more, expected, within=1.6, paper="2.3 (of sums)")
        echoes = found["ASDF"].take(found["ASDF"].count(number)[found["ASDF"].waveform] >= 3)
        false = 100 * (1 - len(match_echoes(echoes, truth, 4.0).found) / max(len(echoes), 1))
        expected = 23.0 if scene is WAGNER else 36.5
        table.near(f"{name}: of the ASDF's echoes there, none within 4 ns", false, expected, within=4.0, spec=None)
    return table


def table_of_cross_sections(number: int, seed: int) -> Table:
    """Equations 2 to 4: cross sections of targets by the constant of one target at another range.

    The waveforms come from the lidar equation as it is printed, with powers of the range written out here.
    """
    table = Table("equations 2 to 4: cross section over the truth", 4)
    rng, n = np.random.default_rng(seed), max(number // 20, 30)
    recording = fine_recording(1.0, 2.0)
    beam, system = 1e-3, known_system(recording).with_radiometry(divergence=1.0, attenuation=0.22)
    section = {distance: 2.0 * distance / TARGET for distance in RANGES}
    echoes = {}
    for distance, size in section.items():
        power = size * 10 ** (-2e-4 * 0.22 * distance) / distance**4
        height = 150.0 * power / (section[TARGET] * 10 ** (-2e-4 * 0.22 * TARGET) / TARGET**4)
        time = 40 + rng.uniform(-0.5, 0.5, (n, 1))
        block, _ = simulate_echoes(recording, time, height * FINE, 2.0, rng)
        block = replace(block, sensor=block.origin + [0.0, 0.0, distance - 40 * HALF_C])
        noise = known_noise(recording, n)
        fitted = gaussian(block, noise, system, maximum(block, noise, system))
        fitted = fitted.take(np.flatnonzero(np.abs(fitted.time - time[fitted.waveform, 0]) < 2))
        echoes[distance] = block, noise, position(block, noise, system, fitted)
    # C_cal of eq. 4 from the target alone, as C' of docs/algorithms.md 5.
    chosen = echoes[TARGET][2]
    covered = 0.25 * np.pi * (TARGET * beam) ** 2
    light = TARGET**2 * chosen.amplitude * chosen.sigma * 10 ** (2e-4 * 0.22 * TARGET)
    system = system.with_radiometry(constant=float(np.median(section[TARGET] / covered / light)))
    for distance, (block, noise, fitted) in echoes.items():
        found = cross_section(block, noise, system, fitted).attributes["cross_section"]
        spread = 1.2 * np.sqrt(2) * (distance / TARGET) ** 3 / 150 / np.sqrt(n)
        table.near(f"target at {distance:g} m", np.median(found) / section[distance], 1.0, within=4 * spread + 0.003)
    return table


def table_of_resolution() -> Table:
    """The least distance at which the paper's rule resolves two echoes, mean over phases of the samples."""
    table = Table("ASDF: least distance of two echoes [sigma]")
    recording = fine_recording(0.0, 2.0, n_samples=120)
    system = known_system(recording)
    distance = np.arange(2.8, 6.6, 0.02)
    phase = np.linspace(0, 1, 4, endpoint=False)
    first = 50 + np.tile(phase, len(distance))[:, None]
    time = np.hstack([first, first + 2 * np.repeat(distance, len(phase))[:, None]])
    for ratio, expected in RESOLUTION.items():
        heights = FINE * 200 * np.array([1, ratio])
        block, _ = simulate_echoes(recording, time, heights, 2.0, np.random.default_rng(0))
        noise = known_noise(recording, len(block), 30.0)
        for fraction, apart in zip(FRACTIONS, expected, strict=True):
            two = asdf(block, noise, system, fraction=fraction, **PAPER_RULE).count(len(block)) == 2
            least = distance[np.argmax(two.reshape(len(distance), -1), axis=0)].mean()
            table.near(f"amplitudes 1 : {ratio:g}, fraction {fraction:g}", least, apart, within=0.07)
    for ratio, number in ((0.28, 1), (0.30, 2)):
        block, _ = simulate_echoes(
            recording, np.array([[40.0, 80.0]]), FINE * 200 * np.array([1, ratio]), 2.0, np.random.default_rng(0)
        )
        count = len(asdf(block, known_noise(recording, 1, 30.0), system, **PAPER_RULE))
        table.near(f"far apart, 1 : {ratio:g}: echoes", count, number)
    return table


def table_of_parabolas(number: int, seed: int) -> Table:
    """Bias of both parabolas at the worst phase without noise, and errors over their bound with noise."""
    table = Table("ASDF: bias of the parabolas [ns]; error over the bound", 4)
    phase = np.linspace(0, 1, 101)
    for sigma, expected in BIAS.items():
        recording = fine_recording(0.0, sigma)
        block, _ = simulate_echoes(recording, 40 + phase[:, None], 200 * FINE, sigma, np.random.default_rng(seed))
        noise, system = known_noise(recording, len(phase), 30.0), known_system(recording)
        for kind in ("parabola", "log"):
            found = asdf(block, noise, system, rule="paper", interpolation=kind)
            bias = np.abs(found.time - 40 - phase).max()
            if kind == "parabola":
                table.near(f"parabola, sigma {sigma:g}", bias, expected, share=0.02)
            else:
                table.add(f"log parabola, sigma {sigma:g}", bias, 0, 0.002, spec={1.0: 1.5e-4, 2.0: 4e-13}.get(sigma))
    rng = np.random.default_rng(seed)
    for kind, low, high, spec in (("parabola", 3.2, 3.6, 3.4), ("log", 0.96, 1.07, 1.0)):
        recording = fine_recording(1.0, 1.0)
        time = 40 + rng.uniform(-0.5, 0.5, (number, 1))
        block, _ = simulate_echoes(recording, time, 200 * FINE, 1.0, rng)
        noise, system = known_noise(recording, number), known_system(recording)
        found = asdf(block, noise, system, rule="paper", interpolation=kind)
        best = found.take(np.flatnonzero(np.abs(found.time - time[found.waveform, 0]) < 1))
        bound = bound_time(200.0, 1.0, 1.0, 1.0)
        error = np.sqrt(np.mean((best.time - time[best.waveform, 0]) ** 2)) / bound
        room = scatter(number, FULL)
        low, high = spec + room * (low - spec), spec + room * (high - spec)
        table.add(f"{kind}: rms error / bound, sigma 1, SNR 200", error, low, high, spec=spec, digits=2)
    return table


def measure(number: int, seed: int) -> list[Table]:
    """All tables."""
    strips = {"no ringing": simulate(number, seed), "ringing of 5 %": simulate(number, seed, 0.05)}
    return [
        table_of_differences(strips["no ringing"]),
        table_of_counts(strips),
        table_of_conclusions(number, seed),
        table_of_cross_sections(number, seed),
        table_of_resolution(),
        table_of_parabolas(number, seed),
    ]


if __name__ == "__main__":
    raise SystemExit(main(measure, __doc__, 4000))
