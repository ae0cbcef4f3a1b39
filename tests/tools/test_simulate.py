"""Scenes: what they promise of their echoes, that samples hold the truth, that seeds fix everything."""


import numpy as np
import pytest
from helpers_scenes import make_block, make_scene

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian
from wavebatch.kernels.physics.radiometry import backscatter
from wavebatch.tools.simulate import SCENES, PulseModel, Recording, find_pulse, find_scene, render, shape_pulse
from wavebatch.tools.simulate.scenes import HAZARDS, SEED_BLOCK, flag_truth, simulate_blocks

ALL = [*SCENES, *(f"stiff.{name}" for name in HAZARDS)]


def paint_naively(recording, n, waveform, time, amplitude, sigma):
    """Slow twin of paint_echoes for pulses without lobes: every sample of every echo, in double precision."""
    x = np.arange(recording.n_samples) * recording.spacing
    signal = np.zeros((n, recording.n_samples))
    peak = render.spread_lobes(recording.pulse, time, amplitude, sigma)[0][0]
    for w, t, a, s in zip(waveform, peak, amplitude, sigma, strict=True):
        signal[w] += a * render.main_lobe((x - t) / s, recording.pulse.kappa)
    return signal


@pytest.mark.parametrize("kappa", [0.0, 0.1, 0.3, -0.1])
@pytest.mark.parametrize("spacing", [1.0, 2.0])
def test_painting_equals_the_naive_twin(kappa, spacing, seed=1):
    rng = np.random.default_rng(seed)
    recording = Recording(spacing=spacing, pulse=PulseModel(kappa=kappa))
    n, m = 40, 150
    waveform = np.sort(rng.integers(0, n, m))
    time = rng.uniform(-30, recording.duration + 30, m)
    amplitude, sigma = rng.uniform(5, 5000, m), rng.uniform(0.8, 9.0, m)
    fast = render.paint_echoes(recording, n, waveform, time, amplitude, sigma)
    slow = paint_naively(recording, n, waveform, time, amplitude, sigma)
    assert np.abs(fast - slow).max() < 1e-5 * 5000
    assert slow.max() > 1000


@pytest.mark.parametrize("name", ALL)
def test_samples_hold_the_truth(name):
    """The recorded counts minus the painted truth are noise: nothing is shifted, scaled or left out."""
    scene = make_scene(name)
    block, truth = make_block(scene, 3000, seed=7)
    if name in ("stiff", "stiff.ringing", "stiff.constant"):
        return
    recording = scene.recording
    signal = render.paint_echoes(
        recording, len(block), truth.waveform, truth.time, truth.amplitude.astype(float), truth.sigma.astype(float)
    )
    clear = signal + recording.baseline + 6 < recording.clip
    residual = (block.samples - recording.baseline - signal)[clear]
    assert abs(residual.mean()) < 0.05
    assert residual.std() == pytest.approx(np.hypot(recording.recorded_noise, recording.baseline_spread), rel=0.02)


@pytest.mark.parametrize("name", list(render.PULSES))
@pytest.mark.parametrize(("ringing", "factor"), [(0.0, 1.0), (0.03, 1.0), (0.03, 1.7)])
def test_every_pulse_peaks_at_the_amplitude(name, ringing, factor):
    pulse = find_pulse(name).with_ringing(ringing)
    recording, sigma = Recording(n_samples=4000, spacing=0.02, pulse=pulse), np.array([pulse.sigma * factor])
    signal = render.paint_echoes(recording, 1, np.array([0]), np.array([30.0]), np.array([100.0]), sigma)[0]
    assert signal.max() == pytest.approx(100, rel=1e-3)
    # The Gaussian that fits a flat target's pulse lies at its time; a target that widens it moves it a little.
    datum = fit_one_gaussian(np.arange(4000) * 0.02, signal)[0]
    assert datum == pytest.approx(30.0, abs=0.001 if factor == 1.0 else 0.8)


def test_slope_widens_echoes():
    scene = find_scene("slope")
    _, truth = make_block("slope", 30_000, seed=6)
    rays = render.trace_rays(render.FlightLine(), scene.terrain, np.arange(30_000))
    wider = 0.5e-3 * scene.divergence * rays.distance * np.tan(rays.incidence) / 0.299792458
    assert np.degrees(rays.incidence).max() > 50 and np.allclose(truth.sigma, np.hypot(2.0, wider), rtol=1e-5)


def test_the_after_pulse_of_riegl():
    pulse = find_pulse("riegl")
    recording = Recording(n_samples=100, spacing=0.5, pulse=pulse)
    one = np.array([0]), np.array([10.0]), np.array([100.0])
    signal = render.paint_echoes(recording, 1, *one, np.array([pulse.sigma]))[0]
    assert 3.0 < signal[41] < 5.0


def test_hazards_are_what_they_say():
    constant, truth = make_block("stiff.constant", 3000)
    assert len(truth) == 0
    assert (constant.samples == constant.samples[:, :1]).all()
    assert set(constant.samples[:, 0].tolist()) == {0, 12, 255}
    ringing, truth = make_block("stiff.ringing", 500)
    assert (truth.count(500) == 1).all()
    behind = (truth.time + 8.0).round().astype(int)
    dips = ringing.samples[np.arange(500), np.minimum(behind, 95)]
    assert dips.mean() < 10
    saturated, truth = make_block("stiff.saturated", 500)
    assert (saturated.samples.max(axis=1) == 255).mean() > 0.95
    assert (truth.flags & EchoFlag.SATURATED).astype(bool).sum() == 500
    _, truth = make_block("stiff.edge", 500)
    assert ((truth.flags & EchoFlag.NEAR_EDGE) != 0).all()
    assert truth.time.min() < 0
    _, truth = make_block("stiff.near", 500)
    assert ((truth.flags & EchoFlag.OVERLAPPED) != 0).all()
    assert (truth.count(500) == 2).all()
    _, truth = make_block("stiff.huge", 500)
    assert truth.amplitude.max() > 50_000
    _, truth = make_block("stiff", 5000)
    assert np.bincount(truth.count(5000), minlength=9)[[0, 1, 2, 8]] == pytest.approx([500, 2830, 1170, 500], rel=0.15)


@pytest.mark.parametrize("name", ["mixed", "stiff", "shore"])
def test_waveform_depends_on_seed_and_number_only(name):
    n = SEED_BLOCK + 900
    whole, truth = make_block(name, n, seed=11)
    for size in (700, SEED_BLOCK):
        start = 0
        for block, part in simulate_blocks(name, n, seed=11, size=size):
            stop = start + len(block)
            assert np.array_equal(block.samples, whole.samples[start:stop])
            assert np.array_equal(block.gps_time, whole.gps_time[start:stop])
            assert np.array_equal(block.origin, whole.origin[start:stop])
            a, b = np.searchsorted(truth.waveform, [start, stop])
            assert np.array_equal(part.time, truth.time[a:b])
            assert np.array_equal(part.waveform, truth.waveform[a:b] - start)
            assert np.array_equal(part.flags, truth.flags[a:b])
            assert block.first == start
            start = stop
        assert start == n
    other, _ = make_block(name, 100, seed=12)
    assert not np.array_equal(other.samples, whole.samples[:100])


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (16, np.uint16), (32, np.uint32)])
def test_bits_windows_and_spacings(bits, dtype):
    scene = make_scene("mixed", bits=bits, spacing=2.0, n_samples=60)
    block, truth = make_block(scene, 200)
    assert block.samples.dtype == dtype
    assert block.samples.shape == (200, 60)
    assert block.spacing == 2.0
    assert truth.time.max() > 80


@pytest.mark.parametrize("terrain", list(render.TERRAINS))
def test_rays_and_slopes_fit_together(terrain):
    rays = render.trace_rays(render.FlightLine(), terrain, np.arange(0, 50_000, 7))
    assert np.allclose(np.linalg.norm(rays.direction, axis=1), render.AIR_SPEED)
    assert (rays.direction[:, 2] < 0).all()
    assert (np.diff(rays.gps_time) > 0).all()
    assert np.abs(rays.scan_angle).max() <= 30
    height, slope_x, slope_y = render.TERRAINS[terrain](rays.ground[:, 0], rays.ground[:, 1])
    ahead = render.TERRAINS[terrain](rays.ground[:, 0] + 1e-4, rays.ground[:, 1])[0]
    aside = render.TERRAINS[terrain](rays.ground[:, 0], rays.ground[:, 1] + 1e-4)[0]
    assert np.median(np.abs((ahead - height) / 1e-4 - slope_x)) < 1e-3
    assert np.median(np.abs((aside - height) / 1e-4 - slope_y)) < 1e-3


@pytest.mark.parametrize(
    "wrong",
    [{"rho": 0.3}, {"rho": 1.0}, {"rho": 2.0}, {"rho": -1.0}, {"saturation": 300}, {"spacing": 0.01},
     {"pulse": PulseModel(90.0)}],
)  # fmt: skip
def test_impossible_recordings_are_refused(wrong):
    """Lobes of a pulse longer than the waveform would take all memory."""
    with pytest.raises(ConfigError, match="simulated recording: "):
        Recording(**wrong)


def test_unknown_names_bring_the_nearest():
    with pytest.raises(ConfigError, match="'forrest'.*'forest'"):
        find_scene("forrest")
    with pytest.raises(ConfigError, match="stiff.near"):
        find_scene("stiff.nearr")
    with pytest.raises(ConfigError, match="'riegl'"):
        find_pulse("rigl")
    with pytest.raises(ConfigError, match="above 0"):
        list(simulate_blocks("flat", 10, size=0))


def test_pulses_take_their_shape_from_options():
    base = PulseModel(sigma=1.9)
    assert shape_pulse(base) == base
    assert shape_pulse(base, pulse="skewed") == PulseModel(sigma=1.9, kappa=0.1)
    assert shape_pulse(base, pulse="leica").sigma == find_pulse("leica").sigma
    assert shape_pulse(base, pulse="riegl", sigma=2.5).sigma == 2.5
    assert shape_pulse(base, kappa=0.2, ringing=0.02).lobes[0] == (-0.02, 7.6, 1.9)
    for wrong in ({"sigma": -1.0}, {"kappa": 2.0}, {"ringing": 0.9}):
        with pytest.raises(ConfigError, match="pulse"):
            shape_pulse(base, **wrong)


def test_a_village_has_roofs_of_all_angles_as_bright_as_they_reflect():
    scene = find_scene("village")
    block, truth = make_block(scene, 30_000, seed=7)
    rays = render.trace_rays(scene.flight, scene.terrain, np.arange(30_000))
    roof = rays.ground[:, 2] > render.GROUND + 1
    assert 0.15 < roof.mean() < 0.4
    steep = np.degrees(rays.incidence[roof])
    assert all((np.abs(steep - angle) < 3).any() for angle in (10, 20, 30, 40, 50, 60))
    energy = truth.amplitude.astype(float) * truth.sigma
    gamma = backscatter(4 / scene.light, rays.distance, truth.amplitude, truth.sigma, 0.22)
    assert gamma == pytest.approx(4 * np.where(roof, 0.4, 0.2) * np.cos(rays.incidence), rel=1e-5)
    assert np.median(energy[roof]) > np.median(energy[~roof])
    assert (block.samples == block.digitizer.max_count).any(axis=1).mean() < 0.01


def test_flags_of_the_truth():
    scene = find_scene("mixed")
    _, truth = make_block(scene, 5000, seed=9)
    flags = flag_truth(truth, scene.recording).flags
    for row in np.random.default_rng(0).integers(0, len(truth), 300):
        same = np.flatnonzero(truth.waveform == truth.waveform[row])
        others = same[same != row]
        wide = np.maximum(truth.sigma[others], truth.sigma[row]).astype(float)
        neighbours = np.abs(np.arange(len(truth))[others] - row) == 1
        close = (np.abs(truth.time[others] - truth.time[row]) < 4 * wide) & neighbours
        assert bool(flags[row] & EchoFlag.OVERLAPPED) == bool(close.any())
        assert bool(flags[row] & EchoFlag.SATURATED) == (truth.amplitude[row] + 12 > 255)
        assert bool(flags[row] & EchoFlag.WEAK) == (truth.amplitude[row] < 5 * scene.recording.recorded_noise)


def test_noise_has_the_spread_and_the_colour_asked_for():
    recording = Recording(noise_std=8.0, rho=0.667, baseline=100.0, baseline_spread=0.0)
    counts = render.record_counts(recording, np.zeros((4000, 80), np.float32), np.random.default_rng(2)) - 100.0
    assert counts.std() == pytest.approx(recording.recorded_noise, rel=0.01)
    assert (counts[:, 1:] * counts[:, :-1]).mean() / counts.var() == pytest.approx(0.667, abs=0.01)


def test_signal_adds_variance_when_asked():
    recording = Recording(bits=16, noise_std=2.0, noise_gain=0.5, baseline=100.0, baseline_spread=0.0)
    counts = render.record_counts(recording, np.full((3000, 80), 400.0, np.float32), np.random.default_rng(3))
    assert counts.std() == pytest.approx(np.sqrt(4 + 0.5 * 400), rel=0.02)
