"""Wang, Wang, Tseng, A comparison of lidar waveform decomposition models: figure 5, tables 1 and 2.

Which pairs and triples a wavelet resolves, how well Gaussians and log-normals fit skewed pulses, and how many echoes
the loop that adds them at the largest residual gains (docs/algorithms.md 1.2).

    python examples/papers/s1_wang.py [--seed N] [--number WAVEFORMS]
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import PULSE_SIGMA, WANG_CASES, simulate_wang
from table import Table, main, scatter

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.signal.signal import find_peaks
from wavebatch.stages.chain import parse_chain
from wavebatch.stages.decompose.fit import gaussian, residual_loop
from wavebatch.stages.decompose.models import render_table, skewed
from wavebatch.stages.detect.direct import maximum, signal_above
from wavebatch.stages.detect.transformed import wavelet
from wavebatch.stages.noise import pooled
from wavebatch.stages.score import match_echoes
from wavebatch.surveying import survey_block
from wavebatch.tools.compare_chains import measure_fit
from wavebatch.tools.simulate import find_scene, simulate_block

PAPER_COUNTS = {"a": 1, "b": 2, "c": 1, "d": 2, "e": 3}
LOCAL_MAXIMA = {"a": 1, "b": 2, "c": 1, "d": 1, "e": 2}
IN_NOISE = {
    0.5: {"a": 4, "b": 94, "c": 0, "d": 5, "e": 96},
    1.0: {"a": 5, "b": 95, "c": 0, "d": 5, "e": 95},
    2.0: {"a": 3, "b": 95, "c": 0, "d": 3, "e": 54},
    4.0: {"a": 11, "b": 94, "c": 1, "d": 0, "e": 13},
}
"""Share of the waveforms with the exact number of echoes [%], by noise and case, B3 wavelet of scale 2."""
CRITICAL = {
    ("b3", 1.0): 3.69,
    ("b3", 2.0): 4.40,
    ("b3", 3.0): 6.38,
    ("mexican_hat", 1.0): 3.89,
    ("mexican_hat", 1.5): 4.30,
    ("mexican_hat", 2.0): 4.82,
    ("mexican_hat", 3.0): 6.05,
}
"""Least distance of echoes of 80 and 100 that are resolved [ns], by wavelet and scale."""
CLASSES = {
    "Leica ground": (0.104, 0.0214, 0.0094, 0.0073, 0.0089, 0.0069),
    "Leica tree": (0.184, 0.0158, 0.0103, 0.0040, 0.0100, 0.0037),
    "Riegl ground": (0.0, 0.0097, 0.0015, 0.0016, 0.0014, 0.0014),
    "Riegl tree": (0.05, 0.0186, 0.0060, 0.0055, 0.0058, 0.0052),
}
"""Skew, noise over amplitude, E of Gaussian and log-normal in the paper, the same in the specification.

Skew and noise were chosen so that both E come out as the paper has them: two numbers in, two numbers out. What the
tables show is that one skewed pulse in noise explains them, not that the paper's pulse was this one."""
PULSES = {"gamma, k = 12": (12, 0.197), "gamma, k = 24": (24, 0.318)}
"""Pulses (t / tau)^k exp(-t / tau), which are no log-normals: their skew must be estimated. k, and E of the skewed
fit over E of the Gaussian with 1000 waveforms, which scatters by 0.003."""
LOOP = {"urban": (92.4, 94.7, 93.8, 95.6, 1.2), "forest": (61.3, 70.7, 63.5, 73.6, 6.1)}
"""Completeness [%] of maxima and fit, and of wavelet, fit and loop, in docs/algorithms.md 2.5; ours of 4000 waveforms,
which scatter by 0.4, and what the loop gains over its candidates [points]."""
FULL = 4000
"""Waveforms that the bands hold for."""


def find_wavelet(block, noise, system) -> EchoTable:
    """The paper's candidates: maxima of the second scale of the B3 wavelet above three standard deviations."""
    return wavelet(block, noise, system, threshold=3.0)


def find_raw_maxima(block, noise, system) -> EchoTable:
    """Local maxima of the samples themselves."""
    signal = signal_above(block, noise)
    waveform, sample = find_peaks(signal, 3.0 * noise.std)
    return EchoTable.build(waveform, sample, signal[sample, waveform], np.full(len(sample), system.sigma_ref))


def count_exact(detect: Callable, case: str, std: float, number: int, rng: np.random.Generator) -> np.ndarray:
    """Echoes found per waveform of a case."""
    block, _, recording = simulate_wang(case, std, number, rng)
    return detect(block, known_noise(recording, number, 0.3 * FINE), known_system(recording)).count(number)


def table_of_cases() -> Table:
    """Figure 5: echoes found without noise."""
    table = Table("figure 5: echoes found without noise", 0)
    rng = np.random.default_rng(0)

    def hat(*waveforms) -> EchoTable:
        return wavelet(*waveforms, wavelet="mexican_hat", threshold=3.0)

    for name, detect in (("B3, scale 2", find_wavelet), ("Mexican hat", hat)):
        for case, expected in PAPER_COUNTS.items():
            table.near(f"{name}, {case}", count_exact(detect, case, 0.0, 1, rng)[0], expected, paper=expected)
    for case, expected in LOCAL_MAXIMA.items():
        table.near(f"raw maxima, {case}", count_exact(find_raw_maxima, case, 0.0, 1, rng)[0], expected)
        table.add(f"maxima smoothed twice, {case}", count_exact(maximum, case, 0.0, 1, rng)[0])
    for scale, expected in ((1.0, 2), (2.0, 2), (3.0, 1)):
        found = count_exact(lambda *w, s=scale: wavelet(*w, scale=s, threshold=3.0), "b", 0.0, 1, rng)[0]
        table.near(f"B3, b at scale {scale:g}", found, expected, paper=expected)
    return table


def table_of_critical_distances() -> Table:
    """Least distances that are two echoes, mean over phases."""
    table = Table("least distance of echoes of 80 and 100 [ns]")
    recording = fine_recording(0.0, PULSE_SIGMA)
    phase, distance = np.linspace(0, 1, 8, endpoint=False), np.arange(3.0, 8.0, 0.02)
    first = 30 + np.tile(phase, len(distance))
    time = np.stack([first, first + np.repeat(distance, len(phase))], axis=1)
    block, _ = simulate_echoes(recording, time, FINE * np.array([80.0, 100.0]), PULSE_SIGMA, np.random.default_rng(0))
    noise, system = known_noise(recording, len(block), 0.3 * FINE), known_system(recording)
    for (name, scale), expected in CRITICAL.items():
        found = wavelet(block, noise, system, wavelet=name, scale=scale).count(len(block))
        least = distance[np.argmax(found.reshape(len(distance), -1) == 2, axis=0)]
        table.near(f"{name}, scale {scale:g}", least.mean(), expected, within=0.12)
    return table


def table_of_noise(number: int, seed: int) -> Table:
    """Shares of waveforms in which the exact number is found in noise."""
    table = Table("figure 5 in noise: exact number of echoes [%]", 1, scatter(number, FULL))
    rng = np.random.default_rng(seed)
    for std, shares in IN_NOISE.items():
        for case, expected in shares.items():
            found = 100 * (count_exact(find_wavelet, case, std, number, rng) == len(WANG_CASES[case])).mean()
            # False echoes make more "exact" counts of case a here: our waveforms are longer (README.md).
            table.near_share(f"{case}, noise {std:g}", found, expected, within=5.0 if case == "a" else 4.0)
    return table


def misfit(block: WaveformBlock, system: SystemPulse, found: EchoTable, y: np.ndarray, kappa: float) -> float:
    """Mean of E = |f - y|^2 / |f|^2 over the waveforms (n, s) in which one echo is found."""
    alone = found.take(found.count(len(block))[found.waveform] == 1)
    f = render_table(PulseShape(kappa=kappa), block, system, alone)[alone.waveform]
    return float(np.mean(np.sum((f - y[alone.waveform]) ** 2, axis=1) / np.sum(f**2, axis=1)))


def gamma_strip(k: int, number: int, rng: np.random.Generator) -> WaveformBlock:
    """Single echoes of 60 to 180 DN with a pulse (t / tau)^k exp(-t / tau), 5 ns wide, in noise 1 of 8 bits."""
    x = np.arange(-15, 40, 0.01)
    lag = np.maximum(x + k, 1e-9)  # tau = 1, peak at k
    pulse = np.exp(k * np.log(lag / k) - (lag - k))
    above = x[pulse > 0.5]
    scale = 5.0 / (above[-1] - above[0])
    time = 24 + rng.uniform(-3, 3, (number, 1))
    signal = np.interp((np.arange(64) - time) / scale, x, pulse, 0.0, 0.0) * rng.uniform(60, 180, (number, 1))
    counts = np.rint(12 + signal + rng.standard_normal(signal.shape))
    return WaveformBlock.from_samples(np.clip(counts, 0, 255).astype(np.uint8))


def table_of_estimates(number: int, seed: int) -> Table:
    """The same question with nothing given: pulses of another law, whose skew the survey estimates from the strip."""
    table = Table("E with a skew that is estimated, not given", 4, scatter(number, FULL // 4))
    rng = np.random.default_rng(seed)
    for name, (k, ratio) in PULSES.items():
        block = gamma_strip(k, max(number, 600), rng)
        system = survey_block(block).system
        # The third moment of the law over that of the log-normal: kappa near a third of the skewness 2 / sqrt(k + 1).
        table.near(f"{name}: skew found", system.skew, 2 / np.sqrt(k + 1) / 3, share=0.07, digits=3)
        chain = "".join(f'[[chain]]\nstage = "{one}"\n' for one in ("noise.pooled", "detect.maximum", "decompose.{}"))
        shares = {}
        for model, lines in (("gaussian", ""), ("skewed", ""), ("skewed free", 'kappa = "free"\n')):
            made = parse_chain(chain.format(model.split()[0]) + lines, "papers")
            found = made.run(block, system)
            noise = pooled(block, system)
            fit, _ = measure_fit(block, noise, system, made.steps[2], found)
            shares[model] = np.nanmean(fit[found.count(len(block)) == 1])
            table.add(f"{name}: E, {model}", shares[model])
        for model in ("skewed", "skewed free"):
            over = shares[model] / shares["gaussian"]
            table.near(f"{name}: {model} over Gaussian", over, ratio, within=0.02, spec=None, digits=3)
        alone = measure_skew_of(block, system)
        table.near(f"{name}: median of free skews less the strip's", alone - system.skew, 0.0, within=0.005)
    return table


def measure_skew_of(block: WaveformBlock, system: SystemPulse) -> float:
    """Median skew of echoes that are fitted with a skew each."""
    noise = pooled(block, system)
    found = skewed(block, noise, system, maximum(block, noise, system), kappa="free")
    return float(np.median(found.attributes["skew"][found.amplitude > 40]))


TABLE_3 = {"Leica": (0.0139, 0.0083), "Riegl": (0.0024, 0.0024)}
"""Table 3: E of Gaussians and log-normals, means of 10,000 waveforms. Those of Leica lie above both classes of tables 1
and 2, and the share of trees is not printed: ours, the mean of both classes, are not held to them."""


def table_of_models(number: int, seed: int) -> Table:
    """Tables 1 and 2: goodness of fit E of Gaussians and log-normals to 60 samples, skew and noise as in CLASSES."""
    table = Table("tables 1, 2: E (inputs follow from the paper's E)", 4, scatter(number, FULL // 10))
    rng = np.random.default_rng(seed)
    for name, (kappa, share, *expected) in CLASSES.items():
        recording = fine_recording(100 * share, PULSE_SIGMA, n_samples=60, kappa=kappa)
        time = 30 + rng.uniform(-0.5, 0.5, (number, 1))
        block, _ = simulate_echoes(recording, time, 100 * FINE, PULSE_SIGMA, rng)
        noise, system = known_noise(recording, number), known_system(recording)
        start = maximum(block, noise, system)
        y = block.samples - noise.baseline[:, None]
        for place, (model, fit, skew) in enumerate((("Gaussian", gaussian, 0.0), ("log-normal", skewed, kappa))):
            value = misfit(block, system, fit(block, noise, system, start), y, skew)
            paper, spec = expected[place], expected[place + 2]
            # The specification has four decimals: 0.00005 of 0.0014 are 4 %.
            table.near(f"{name}, {model}", value, spec, within=0.0001, share=0.04, paper=paper, spec=spec)
    for sensor, printed in TABLE_3.items():
        for model, paper in zip(("Gaussian", "log-normal"), printed, strict=True):
            both = [table.values[f"{name}, {model}"] for name in CLASSES if name.startswith(sensor)]
            table.add(f"table 3: {sensor}, mean of both classes, {model}", np.mean(both), paper=paper)
    return table


def table_of_the_loop(number: int, seed: int) -> Table:
    """Echoes that are found with and without the residual loop."""
    table = Table("residual loop: completeness and gain [%, points]", 1, scatter(number, FULL))
    for name, (plain, looped, ours, ours_looped, gain) in LOOP.items():
        recording = find_scene(name).recording
        block, truth = simulate_block(name, number, np.random.default_rng(seed))
        noise, system = known_noise(recording, number), known_system(recording)
        candidates = find_wavelet(block, noise, system)

        def complete(found: EchoTable, truth=truth) -> float:
            return 100 * len(match_echoes(found, truth).truth) / len(truth)

        plainest = gaussian(block, noise, system, maximum(block, noise, system))
        found = residual_loop(block, noise, system, candidates)
        maxima, loop = complete(plainest), complete(found)
        single = complete(gaussian(block, noise, system, candidates))
        table.near(f"{name}: maxima, fit", maxima, ours, within=1.5, spec=plain)
        table.add(f"{name}: wavelet, fit", single)
        table.near(f"{name}: wavelet, fit, loop", loop, ours_looped, within=1.5, spec=looped)
        table.near(f"{name}: gain by the loop", loop - single, gain, within=0.8, spec=None)
        known = {"within": 1.0, "spec": looped - plain}
        table.near(f"{name}: gain over the maxima", loop - maxima, ours_looped - ours, **known)
        more = 100 * (len(found) / len(plainest) - 1)
        table.add(f"{name}: more echoes than by maxima", more, paper="11 (city)" if name == "urban" else None)
    return table


def measure(number: int, seed: int) -> list[Table]:
    """All tables."""
    return [
        table_of_cases(),
        table_of_critical_distances(),
        table_of_noise(number, seed),
        table_of_models(max(number // 10, 20), seed),
        table_of_estimates(number // 4, seed),
        table_of_the_loop(number, seed),
    ]


if __name__ == "__main__":
    raise SystemExit(main(measure, __doc__, 4000))
