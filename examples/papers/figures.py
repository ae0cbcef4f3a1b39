"""Pictures that no command of wavebatch makes: what single figures of the papers show, drawn from our own simulation.

`page` calls them. Each function takes the folder with the strips and clouds that `page.prepare` makes, a seed and the
file to write.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from given_echoes import FINE, fine_recording, known_noise, known_system
from published import WANG_CASES, simulate_wang
from s3_rhomberg_kauert import DIVERGENCE, FWHM_PER_TAU, HEIGHT, LENGTH, PULSE_SIGMA, strike_planes
from s4_ussyshkin import fly_cloud

import wavebatch as wb
from wavebatch.core.units import HALF_C
from wavebatch.files.figure_file import open_picture
from wavebatch.kernels.physics.incidence import PAPER_TAU, paper_table, pulse_table, spread_of_angle, spread_pulse
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.detect.transformed import transform, wavelet
from wavebatch.tools.simulate.returns import SynthesisOptions, synthesize_strip

SCALES = (1.0, 2.0, 3.0)
DEGREES = np.arange(0.0, 76.0, 1.0)
MEASURED = (0.0, 10.0, 20.0, 30.0, 45.0, 60.0)


def draw_voxels(folder: Path, seed: int, target: Path) -> None:
    """Wagner et al., figure 1: roofs and ground as voxels, each with the energy that came back from it."""
    voxels = wb.read_cloud(folder / "voxels.laz", ["x", "y", "z", "energy"])
    x, y, z, energy = (np.asarray(voxels[name], np.float64) for name in ("x", "y", "z", "energy"))
    x, y = x - np.median(x), y - np.median(y)
    near = np.flatnonzero((np.abs(x) < 20) & (np.abs(y) < 20) & (energy > np.quantile(energy, 0.3)))
    near = near[np.argsort(energy[near])]
    with open_picture(target, (9.0, 7.0), overwrite=True) as figure:
        axes = figure.add_subplot(projection="3d")
        shown = axes.scatter(x[near], y[near], z[near], c=np.log10(energy[near]), s=14, marker="s", alpha=0.7)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        axes.set_zlabel("height [m]")
        axes.set_box_aspect((1, 1, 0.8))
        figure.colorbar(shown, ax=axes, label="energy of the voxel, log10 [DN ns]", shrink=0.7)


def draw_cases(folder: Path, seed: int, target: Path) -> None:
    """Wang et al., figure 5: the five cases, and the echoes that the wavelet finds at three scales."""
    rng = np.random.default_rng(seed)
    with open_picture(target, (13.0, 4.6), overwrite=True) as figure:
        every = figure.subplots(1, 5, sharey=True)
        for axes, case in zip(every, WANG_CASES, strict=True):
            block, truth, recording = simulate_wang(case, 0.0, 1, rng)
            noise, system = known_noise(recording, 1, 0.3 * FINE), known_system(recording)
            time = np.arange(block.samples.shape[1]) * block.spacing
            signal = (block.samples[0] - noise.baseline[0]) / FINE
            axes.plot(time, signal, color="black", linewidth=1.0)
            for amplitude, centre, sigma in zip(truth.amplitude, truth.time, truth.sigma, strict=True):
                pulse = amplitude / FINE * np.exp(-0.5 * ((time - centre) / sigma) ** 2)
                axes.plot(time, pulse, color="tab:gray", linewidth=0.8, linestyle="--")
            top = signal.max()
            for place, scale in enumerate(SCALES):
                found = wavelet(block, noise, system, scale=scale, threshold=3.0)
                height = top * (1.08 + 0.1 * place)
                axes.plot(found.time, np.full(len(found), height), "v", label=f"scale {scale:g}", markersize=6)
                axes.annotate(str(len(found)), (20.5, height), va="center", fontsize=8)
            axes.set_xlim(18, 55)
            axes.set_title(f"case {case}", loc="left", fontsize=10)
            axes.set_xlabel("time [ns]")
        every[0].set_ylabel("signal [paper's unit]")
        every[-1].legend(title="echoes found", fontsize=8, loc="center right")


def draw_coefficients(folder: Path, seed: int, target: Path) -> None:
    """Wang et al., figure 1: two echoes 5 ns apart in noise 1, and coefficients of the B3 wavelet at three scales."""
    block, truth, recording = simulate_wang("b", 1.0, 1, np.random.default_rng(seed))
    noise, system = known_noise(recording, 1), known_system(recording)
    signal = (block.samples - noise.baseline[:, None]).T.astype(np.float32)
    time = np.arange(len(signal)) * block.spacing
    with open_picture(target, (9.0, 7.0), overwrite=True) as figure:
        every = figure.subplots(4, 1, sharex=True)
        every[0].plot(time, signal[:, 0] / FINE, color="black")
        every[0].set_ylabel("signal")
        for axes, scale in zip(every[1:], SCALES, strict=True):
            detail, gain = transform(signal, system.sigma_ref / block.spacing, "b3", scale, block.spacing)
            axes.plot(time, detail[:, 0] / FINE, color="tab:blue")
            axes.axhline(3 * gain * noise.std[0] / FINE, color="tab:red", linewidth=0.8, linestyle="--")
            axes.set_ylabel(f"scale {scale:g}")
        for axes in every:
            for centre in truth.time:
                axes.axvline(centre, color="tab:gray", linewidth=0.6)
        every[-1].set_xlabel("time [ns]   red: three standard deviations of noise, gray: true echoes")


def draw_noise(folder: Path, seed: int, target: Path) -> None:
    """Wang et al., figure 4: a waveform, and 60 of them with the noise of their last samples and the threshold."""
    block, _, recording = simulate_wang("e", 1.0, 60, np.random.default_rng(seed))
    signal = block.samples / FINE
    time = np.arange(signal.shape[1]) * block.spacing
    quiet = time > 0.78 * time[-1]
    mean, std = float(signal[:, quiet].mean()), float(signal[:, quiet].std())
    with open_picture(target, (12.0, 4.4), overwrite=True) as figure:
        every = figure.subplots(1, 2, sharey=True)
        every[0].plot(time, signal[0], color="black", linewidth=1.0)
        every[1].plot(time, signal.T, color="tab:gray", linewidth=0.4)
        every[1].axvspan(time[quiet][0], time[-1], color="tab:blue", alpha=0.15)
        every[1].axhline(mean + 3 * std, color="tab:red", linewidth=1.0, label=f"{mean:.1f} + 3 x {std:.2f}")
        every[1].legend(fontsize=8)
        for axes, name in zip(every, ("a waveform", "60 waveforms, free of signal at the end"), strict=True):
            axes.set_title(name, loc="left", fontsize=10)
            axes.set_xlabel("time [ns]")
        every[0].set_ylabel("signal [paper's unit]")


def draw_fan(folder: Path, seed: int, target: Path) -> None:
    """Rhomberg-Kauert et al., figures 2A and 2B: echoes of planes by angle, of the printed pulse and of the other."""
    angles = DEGREES[::5]
    spreads = spread_of_angle(np.radians(angles), HEIGHT, DIVERGENCE)
    fans = {
        "2A: t exp(-t), half a Gaussian": spread_pulse(1, spreads / 2**0.5, LENGTH / PAPER_TAU, causal=True),
        "2B: t^2 exp(-t)": spread_pulse(2, spreads, LENGTH / FWHM_PER_TAU),
    }
    with open_picture(target, (12.0, 4.8), overwrite=True) as figure:
        sides = figure.subplots(1, 2, sharey=True)
        for axes, (name, (time, curves)) in zip(sides, fans.items(), strict=True):
            shown = axes.scatter([], [], c=[], cmap="viridis", vmin=0, vmax=angles[-1])
            for angle, curve in zip(angles, curves, strict=True):
                axes.plot(time, curve, color=shown.to_rgba(angle), linewidth=1.0)
            axes.set_xlim(-8, 12)
            axes.set_title(name, loc="left", fontsize=10)
            axes.set_xlabel("time [ns]")
        sides[0].set_ylabel("echo, over its maximum")
        figure.colorbar(shown, ax=sides, label="angle of incidence [deg]")


def draw_widths(folder: Path, seed: int, target: Path) -> None:
    """Rhomberg-Kauert et al., figure 3: widths by angle with measured points."""
    rng = np.random.default_rng(seed)
    spread = spread_of_angle(np.radians(DEGREES), HEIGHT, DIVERGENCE)
    printed, fitted = paper_table(PULSE_SIGMA), pulse_table(2.5364 / 4, 0.05)
    with open_picture(target, (8.0, 4.8), overwrite=True) as figure:
        axes = figure.subplots()
        axes.plot(DEGREES, 4 * np.interp(spread, printed.spread, printed.width), label="as printed")
        label = "4 x fitted Gaussian, h = t^2 exp(-t)"
        axes.plot(DEGREES, 4 * np.interp(spread, fitted.spread, fitted.width), label=label)
        axes.plot(DEGREES, 4 * np.hypot(PULSE_SIGMA, spread), linestyle="--", label="Gaussian closed form")
        widths = np.array([_measure_width(degrees, rng) for degrees in MEASURED])
        axes.errorbar(MEASURED, widths[:, 0], widths[:, 1], fmt="o", color="black", markersize=4,
                      label="fitted to planes that are summed ray by ray")  # fmt: skip
        axes.set_xlabel("angle of incidence [deg]")
        axes.set_ylabel("width at e^-2 [ns]")
        axes.legend(fontsize=8)


def _measure_width(degrees: float, rng: np.random.Generator) -> tuple[float, float]:
    """Median and spread of the width at e^-2 [ns] of planes at an amplitude over noise of 100."""
    block = strike_planes(degrees, 100.0, 60, rng)
    recording = fine_recording(1.0, PULSE_SIGMA, n_samples=120, spacing=0.5)
    noise, system = known_noise(recording, len(block)), known_system(recording)
    found = gaussian(block, noise, system, maximum(block, noise, system), most_width=20.0)
    return float(np.median(4 * found.sigma)), float(np.std(4 * found.sigma))


def draw_angles(folder: Path, seed: int, target: Path) -> None:
    """Rhomberg-Kauert et al., figure 6B: angles from widths by those from normals, and their differences."""
    names = ["incidence_angle", "incidence_angle_normals"]
    cloud = wb.read_cloud(folder / "out" / "village.laz", names)
    width, normal = (np.asarray(cloud[name], np.float64) for name in names)
    known = np.isfinite(width) & np.isfinite(normal)
    width, normal = width[known], normal[known]
    with open_picture(target, (12.0, 4.8), overwrite=True) as figure:
        left, right = figure.subplots(1, 2)
        shown = left.hist2d(normal, width, bins=70, range=((0, 70), (0, 70)), cmin=1, norm="log", cmap="viridis")
        left.plot([0, 70], [0, 70], color="black", linewidth=0.8)
        left.set_xlabel("angle from normals [deg]")
        left.set_ylabel("angle from widths [deg]")
        figure.colorbar(shown[3], ax=left, label="echoes", format=_plain)
        off = width - normal
        right.hist(off, bins=np.arange(-15.25, 15.5, 0.5), color="tab:blue")
        right.axvline(np.median(off), color="black", linewidth=0.8)
        right.set_xlabel("angle from the width less that from normals [deg]")
        right.set_ylabel("echoes")
        right.set_title(f"median {np.median(off):.2f}, rms {np.sqrt(np.mean(off**2)):.2f} deg", loc="left", fontsize=10)


def _plain(value: float, place: int) -> str:
    """Numbers of logarithmic axes as they are: pictures parse no formulas."""
    return f"{value:g}"


def draw_old_records(folder: Path, seed: int, target: Path) -> None:
    """Ussyshkin and Theriault, figure 1: pulses with four returns by receivers with long dead zones."""
    with open_picture(target, (13.0, 4.6), overwrite=True) as figure:
        every = figure.subplots(1, 2)
        for axes, dead_zone in zip(every, (2.14, 1.54), strict=True):
            _draw_modelled(axes, folder, seed, "orion-20", 4, dead_zone)
            axes.set_title(f"figure 1: 4 returns over trees of 20 m, dead zone {dead_zone} m", loc="left", fontsize=10)
        every[0].set_ylabel("signal [DN]")


def draw_record(folder: Path, seed: int, target: Path) -> None:
    """Ussyshkin and Theriault, figures 2 and 7: pulses with four returns over trees of 6 m and with three over corn,
    and the waveforms modelled from them."""
    with open_picture(target, (13.0, 4.6), overwrite=True) as figure:
        every = figure.subplots(1, 2)
        for axes, (stand, returns, name) in zip(
            every, (("orion-6", 4, "figures 2a and 7a: 4 returns over trees of 6 m"),
                    ("corn", 3, "figures 2b and 7b: 3 returns over corn")), strict=True,
        ):  # fmt: skip
            _draw_modelled(axes, folder, seed, stand, returns)
            axes.set_title(name, loc="left", fontsize=10)
        every[0].set_ylabel("signal [DN]")
        every[0].legend(fontsize=8)


def draw_peak(folder: Path, seed: int, target: Path) -> None:
    """Ussyshkin and Theriault, figure 6: a return as the peak of a Gaussian."""
    with open_picture(target, (7.0, 4.6), overwrite=True) as figure:
        axes = figure.subplots()
        _draw_modelled(axes, folder, seed, "orion-6", 1)
        axes.set_ylabel("signal [DN]")
        axes.legend(fontsize=8)


def _draw_modelled(axes, folder: Path, seed: int, stand: str, returns: int, dead_zone: float = 0.65) -> None:
    """A pulse with so many returns over a stand, and the waveform that `synthesize` models from them."""
    cloud, strip = (folder / f"{kind}-{stand}-{dead_zone}.las" for kind in ("record", "modelled"))
    if not cloud.exists():  # another picture shows more of it
        fly_cloud(stand, cloud, dead_zone, 2000, seed)
    synthesize_strip(cloud, strip, SynthesisOptions(bits=16, baseline=0.0), overwrite=True)
    with wb.open_strip(strip) as opened:
        block, row = next(
            (block, row) for block in opened.blocks()
            for row in np.flatnonzero(np.bincount(block.returns.waveform, minlength=len(block)) == returns)
        )  # fmt: skip
        time = np.arange(block.samples.shape[1]) * block.spacing
        mine = np.flatnonzero(block.returns.waveform == row)
        height = np.interp(block.returns.time[mine], time, block.samples[row])
        metres = HALF_C * (block.returns.time[mine] - block.returns.time[mine][0])
    axes.plot(time, block.samples[row], color="black", label="modelled waveform")
    axes.vlines(block.returns.time[mine], 0, height, color="tab:red", label="returns")
    for number, (at, top, deep) in enumerate(zip(block.returns.time[mine], height, metres, strict=True), 1):
        text = f"{number}: {deep:.2f} m"
        axes.annotate(text, (at, top), xytext=(4, 4), textcoords="offset points", fontsize=8)
    axes.set_ylim(0, 1.15 * float(block.samples[row].max()))
    axes.set_title(f"{returns} return{'s' * (returns > 1)}, {stand}", loc="left", fontsize=10)
    axes.set_xlabel("time [ns]")


def draw_canopy(folder: Path, seed: int, target: Path) -> None:
    """Ussyshkin and Theriault, figure 4: the same trees by two sensors, side by side, and returns by height."""
    sensors = {"dead zone 0.65 m": 0.65, "dead zone 2 m": 2.0}
    colours = ("tab:green", "tab:orange", "tab:red", "tab:purple")
    with open_picture(target, (13.0, 4.8), overwrite=True) as figure:
        *sides, heights = figure.subplots(1, 3, sharey=True)
        for axes, (name, dead_zone) in zip(sides, sensors.items(), strict=True):
            path = folder / f"canopy-{dead_zone:g}.las"
            fly_cloud("orion-20", path, dead_zone, 4000, seed)
            cloud = wb.read_cloud(path, ["y", "z", "return_number"])
            along = np.asarray(cloud["y"]) - np.median(cloud["y"])
            near = np.abs(along) < 30
            level = np.asarray(cloud["z"]) - np.min(cloud["z"])
            for number, colour in enumerate(colours, 1):
                rows = near & (np.asarray(cloud["return_number"]) == number)
                axes.plot(along[rows], level[rows], ".", color=colour, markersize=3, label=f"return {number}")
            axes.set_title(f"{name}: {len(level) / np.sum(cloud['return_number'] == 1):.2f} returns per pulse",
                           loc="left", fontsize=10)  # fmt: skip
            axes.set_xlabel("along the section [m]")
            heights.hist(level, bins=np.arange(0, 22, 1.0), orientation="horizontal", histtype="step", label=name)
        sides[0].set_ylabel("height above ground [m]")
        sides[0].legend(fontsize=8, loc="lower left", framealpha=0.9)
        heights.set_xscale("log")
        heights.xaxis.set_major_formatter(_plain)
        heights.set_xlabel("returns per metre of height")
        heights.legend(fontsize=8)
