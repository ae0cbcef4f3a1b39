"""Simulated strips and blocks: scenes, pulses, truth, packets, and discrete receivers."""

import struct

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from commands import refuses
from helpers_scenes import make_block, make_scene
from published import RETURN_TABLES

from wavebatch.cli.strips import simulate
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian
from wavebatch.kernels.physics.radiometry import backscatter
from wavebatch.tools.return_stats import count_returns
from wavebatch.tools.simulate import (
    SCENES,
    DiscreteReceiver,
    PulseModel,
    Recording,
    StripOptions,
    TruthReader,
    find_pulse,
    find_scene,
    render,
    shape_pulse,
    simulate_returns,
    simulate_strip,
)
from wavebatch.tools.simulate.render import AIR_SPEED
from wavebatch.tools.simulate.returns import list_returns
from wavebatch.tools.simulate.scenes import HAZARDS, SEED_BLOCK, flag_truth, simulate_blocks
from wavebatch.tools.simulate.strip import ECHO_COLUMNS

FORMATS = [(4, "1.3", True), (4, "1.4", False), (5, None, True), (9, None, False), (10, None, True)]


def read_strip(path):
    """Points by laspy, and the packet of every point, (n, s), by plain file access."""
    with laspy.open(path, read_evlrs=False) as reader:
        points = reader.read_points(reader.header.point_count).array
        header = reader.header
        descriptor = next(vlr for vlr in header.vlrs if vlr.record_id == 100).parsed_record
    if header.global_encoding.waveform_data_packets_internal:
        data, base = path.read_bytes(), header.start_of_waveform_data_packet_record
    else:
        data, base = path.with_suffix(".wdp").read_bytes(), 0
    bits, _, n_samples, spacing = struct.unpack_from("<BBII", bytes(descriptor))[:4]
    has = points["wavepacket_index"] > 0
    start = points["wavepacket_offset"][has].astype(np.int64) + base
    width = n_samples * bits // 8
    assert (points["wavepacket_size"][has] == width).all()
    raw = np.frombuffer(data, np.uint8)[start[:, None] + np.arange(width)]
    samples = np.zeros((len(points), n_samples), np.int64)
    samples[has] = np.ascontiguousarray(raw).view(f"<u{bits // 8}")
    xyz = np.stack([points[k] * s + o for k, s, o in zip("XYZ", header.scales, header.offsets, strict=True)], axis=1)
    return points, xyz, samples, header, spacing


def read_truth(path):
    with TruthReader(path) as reader, np.load(path) as whole:
        packets = {name: whole[name] for name in ("packet_byte_offset", "packet_gps_time")}
        return reader.meta, {name: whole[name] for name in ECHO_COLUMNS}, packets


@pytest.mark.parametrize(("point_format", "version", "internal"), FORMATS)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_strip_reads_back_and_holds_its_truth(tmp_path, point_format, version, internal, suffix):
    path, truth_path = tmp_path / f"strip{suffix}", tmp_path / "truth.npz"
    options = StripOptions(point_format=point_format, version=version, internal=internal, without_waveform=0.05)
    summary = simulate_strip("forest", path, pulses=3000, seed=1, options=options, truth=truth_path)
    points, xyz, samples, header, spacing = read_strip(path)
    meta, truth, packets = read_truth(truth_path)
    assert header.point_format.id == point_format
    assert str(header.version) == options.las_version
    assert spacing == 1000
    assert len(points) == summary.points
    assert len(packets["packet_byte_offset"]) == summary.packets == meta["packets"]
    assert len(truth["time"]) == summary.echoes
    assert sorted(set(points["wavepacket_offset"][points["wavepacket_index"] > 0])) == list(
        packets["packet_byte_offset"]
    )
    assert (packets["packet_byte_offset"][truth["waveform"].astype(int)] == truth["byte_offset"]).all()
    assert (packets["packet_gps_time"][truth["waveform"].astype(int)] == truth["gps_time"]).all()
    _, first, count = np.unique(points["gps_time"], return_index=True, return_counts=True)
    with laspy.open(path, read_evlrs=False) as reader:
        cloud = reader.read_points(-1)
    assert (cloud.return_number[first] == 1).all() and np.array_equal(cloud.number_of_returns, np.repeat(count, count))
    without = points["wavepacket_index"] == 0
    assert 0.03 < len(set(points["gps_time"][without])) / 3000 < 0.07
    assert (points["wavepacket_size"][without] == 0).all()
    lonely = truth["isolated"] & (truth["amplitude"] > 30)
    first = {offset: row for row, offset in reversed(list(enumerate(points["wavepacket_offset"].tolist())))}
    rows = np.array([first[offset] for offset in truth["byte_offset"][lonely].tolist()])
    nearest = np.rint(truth["time"][lonely]).astype(int)
    heights = samples[rows, nearest] - 12
    assert np.median(heights / truth["amplitude"][lonely]) == pytest.approx(0.98, abs=0.03)


def test_points_lie_on_truth_and_raw_locations_do_not(tmp_path):
    path, truth_path = tmp_path / "strip.las", tmp_path / "truth.npz"
    simulate_strip("urban", path, pulses=4000, seed=2, truth=truth_path)
    points, xyz, _, _, _ = read_strip(path)
    _, truth, packets = read_truth(truth_path)
    true = np.stack([truth[k] for k in "xyz"], axis=1)
    rows = np.flatnonzero((points["wavepacket_index"] > 0) & (points["intensity"] > 0))
    by_offset = {}
    for i, offset in enumerate(truth["byte_offset"].tolist()):
        by_offset.setdefault(offset, []).append(i)
    starts, errors = [], []
    toward = np.stack([points[k] for k in ("x_t", "y_t", "z_t")], axis=1).astype(float) * 1000
    assert np.allclose(np.linalg.norm(toward, axis=1)[rows], AIR_SPEED, rtol=1e-6)
    assert (toward[rows, 2] > 0).all()
    location = points["return_point_wave_location"].astype(float) / 1000
    for row in rows:
        here = by_offset[int(points["wavepacket_offset"][row])]
        gaps = np.linalg.norm(true[here] - xyz[row], axis=1)
        best = here[int(np.argmin(gaps))]
        errors.append(gaps.min())
        starts.append(location[row] - truth["time"][best])
    assert max(errors) < 0.001
    starts = np.array(starts)
    assert np.abs(starts).max() <= 0.501
    assert starts.std() == pytest.approx(1 / np.sqrt(12), rel=0.05)
    # Returns of a pulse share the offset: relative placement is right.
    times = points["gps_time"][rows]
    same = np.flatnonzero(np.diff(times) == 0)
    assert len(same) > 100
    assert np.abs(np.diff(starts)[same]).max() < 1e-3


def test_strip_starts_with_the_same_pulses_whatever_its_length(tmp_path):
    """Bytes too: the same call gives the same files, and a longer strip begins as the shorter one does."""
    for name, pulses in (("a", SEED_BLOCK + 500), ("b", SEED_BLOCK + 500), ("c", 300)):
        simulate_strip("mixed", tmp_path / f"{name}.las", pulses=pulses, seed=5, truth=tmp_path / f"{name}.npz")
    for suffix in (".las", ".npz"):
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    long, short = read_strip(tmp_path / "a.las"), read_strip(tmp_path / "c.las")
    n = len(short[0])
    for name in ("X", "Y", "Z", "gps_time", "bit_fields", "return_point_wave_location", "wavepacket_offset"):
        assert np.array_equal(long[0][name][:n], short[0][name])
    assert np.array_equal(long[2][:n], short[2])
    other = tmp_path / "d.las"
    simulate_strip("mixed", other, pulses=300, seed=6)
    assert not np.array_equal(read_strip(other)[2], short[2])


@pytest.mark.parametrize("keep", [True, False])
def test_empty_pulses_stay_or_go(tmp_path, keep):
    path, truth = tmp_path / "strip.las", tmp_path / "t.npz"
    options = StripOptions(keep_empty=keep, without_waveform=0.0)
    summary = simulate_strip("empty", path, pulses=2000, seed=1, options=options, truth=truth)
    points, _, samples, _, _ = read_strip(path)
    silent = points["intensity"] == 0
    _, _, packets = read_truth(truth)
    assert summary.packets == len(packets["packet_gps_time"])
    if keep:
        assert summary.packets == 2000
        assert 0.75 < silent.mean() < 0.85
        assert samples[silent].max() < 22
        assert (points["return_point_wave_location"][silent] > 38_000).all()
    else:
        assert summary.packets < 450
        assert not silent.any()


def test_vectors_away_differ_in_sign_only(tmp_path):
    for toward in (True, False):
        simulate_strip("flat", tmp_path / f"{toward}.las", pulses=200, options=StripOptions(toward=toward))
    a, b = (read_strip(tmp_path / f"{toward}.las")[0] for toward in (True, False))
    for name in ("x_t", "y_t", "z_t"):
        assert np.array_equal(a[name], -b[name])
    assert np.array_equal(a["Z"], b["Z"])


def test_close_echoes_share_a_return_of_the_strongest():
    from wavebatch.core.echoes import EchoTable

    recording = find_scene("mixed").recording
    truth = EchoTable.build([0, 0, 0, 1, 2, 2], [20, 22, 40, 30, -3, 50], [50, 90, 40, 2, 80, 60], [2] * 6)
    returns = list_returns(truth, 4, recording, 7, keep_empty=True)
    assert returns.pulse.tolist() == [0, 0, 1, 2, 3]
    assert returns.time.tolist() == [22, 40, 39.5, 50, 39.5]
    assert returns.number.tolist() == [1, 2, 1, 1, 1]
    assert returns.total.tolist() == [2, 2, 1, 1, 1]
    assert list_returns(truth, 4, recording, 1, keep_empty=False).pulse.tolist() == [0, 2]
    assert len(list_returns(EchoTable.empty(), 2, recording, 7, keep_empty=False).pulse) == 0


def test_failures_half_way_leave_nothing(tmp_path):
    def stop(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_strip("flat", tmp_path / "s.laz", pulses=50, truth=tmp_path / "t.npz", progress=stop)
    assert not list(tmp_path.iterdir())


def test_truth_that_is_none_gives_one_line(tmp_path):
    path = tmp_path / "x.npz"
    refuses(InputError, "cannot be read", TruthReader, path)
    path.write_bytes(b"nothing")
    refuses(InputError, "no truth file", TruthReader, path)
    np.savez(path, time=np.zeros(3))
    refuses(InputError, "lacks waveform", TruthReader, path)


def test_truth_is_an_ordinary_npz_and_read_in_pieces(tmp_path):
    path = tmp_path / "t.npz"
    simulate_strip("mixed", tmp_path / "s.las", pulses=500, truth=path)
    with np.load(path, allow_pickle=False) as whole, TruthReader(path) as reader:
        pieces = list(reader.read_pieces("time", "isolated", size=37))
        assert all(len(piece["time"]) <= 37 for piece in pieces)
        assert np.array_equal(np.concatenate([piece["time"] for piece in pieces]), whole["time"])
        assert np.array_equal(np.concatenate([piece["isolated"] for piece in pieces]), whole["isolated"])
        assert reader.meta["scene"] == "mixed"
        assert reader.meta["noise_std"] == pytest.approx(np.hypot(1.2, 1 / np.sqrt(12)))


def test_truth_goes_when_the_strip_cannot_be_published(tmp_path):
    strip = tmp_path / "s.las"
    with pytest.raises(InputError, match="exists already"):
        simulate_strip("flat", strip, pulses=50, truth=tmp_path / "t.npz", progress=lambda _: strip.touch())
    assert list(tmp_path.iterdir()) == [strip]


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
    pulse = shape_pulse(find_pulse(name), ringing=ringing)
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


@pytest.mark.quick_cases("mixed")
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
    refuses(ConfigError, "simulated recording: ", Recording, **wrong)


def test_unknown_names_bring_the_nearest():
    refuses(ConfigError, "'forrest'.*'forest'", find_scene, "forrest")
    refuses(ConfigError, "stiff.near", find_scene, "stiff.nearr")
    refuses(ConfigError, "'riegl'", find_pulse, "rigl")
    refuses(ConfigError, "above 0", list, simulate_blocks("flat", 10, size=0))


def test_pulses_take_their_shape_from_options():
    base = PulseModel(sigma=1.9)
    assert shape_pulse(base) == base
    assert shape_pulse(base, pulse="skewed") == PulseModel(sigma=1.9, kappa=0.1)
    assert shape_pulse(base, pulse="leica").sigma == find_pulse("leica").sigma
    assert shape_pulse(base, pulse="riegl", sigma=2.5).sigma == 2.5
    assert shape_pulse(base, kappa=0.2, ringing=0.02).lobes[0] == (-0.02, 7.6, 1.9)
    for wrong in ({"sigma": -1.0}, {"kappa": 2.0}, {"ringing": 0.9}):
        refuses(ConfigError, "pulse", shape_pulse, base, **wrong)


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


def fire_slowly(receiver, pulse, distance, amplitude):
    found = []
    for p in np.unique(pulse):
        rows = np.flatnonzero(pulse == p)
        limit, number = -np.inf, 0
        for row in rows:
            if distance[row] < limit or number == receiver.most:
                continue
            inside = rows[(rows >= row) & (distance[rows] < distance[row] + receiver.dead_zone)]
            if amplitude[inside].sum() > receiver.threshold:
                number += 1
                limit = distance[row] + receiver.dead_zone
                found.append((row, number, amplitude[inside].sum()))
    return found


@pytest.mark.parametrize("most", [1, 4])
def test_receiver_fires_as_a_plain_loop_does(rng, most):
    pulse = np.sort(rng.integers(0, 200, 900))
    distance = rng.uniform(0, 5, 900)
    order = np.lexsort((distance, pulse))
    distance, amplitude = distance[order], rng.integers(0, 9, 900).astype(float)
    receiver = DiscreteReceiver(0.6, 8.0, most)
    row, number, energy = receiver.fire(pulse, distance, amplitude)
    assert list(zip(row.tolist(), number.tolist(), energy.tolist(), strict=True)) == [
        (int(r), n, pytest.approx(e)) for r, n, e in fire_slowly(receiver, pulse, distance, amplitude)
    ]


@pytest.mark.parametrize("stand", list(RETURN_TABLES))
def test_published_return_numbers_are_reproduced(stand, tmp_path):
    dead_zone, exact = RETURN_TABLES[stand]
    simulate_returns(f"canopy.{stand}", tmp_path / "c.las", pulses=8192, seed=77, receiver=DiscreteReceiver(dead_zone))
    stats = count_returns([tmp_path / "c.las"])[1]
    number = np.cumsum(exact[::-1])[::-1] / np.sum(np.cumsum(exact[::-1]))
    ours = [stats.by_number.get(k, 0.0) for k in (1, 2, 3, 4)]
    assert 100 * np.abs(np.subtract(ours, number)).sum() < 6
    assert stats.returns_per_pulse == pytest.approx(np.dot((1, 2, 3, 4), exact) / 100, abs=0.08)
    assert stats.separations["all"].least == pytest.approx(dead_zone, abs=0.03)


def test_too_many_returns_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="receiver has 9"):
        simulate_returns("flat", tmp_path / "d.las", pulses=5, receiver=DiscreteReceiver(most=9))
    assert not list(tmp_path.iterdir())


def test_command_line(tmp_path):
    def run(*arguments):
        fixed = ("canopy.corn", "-o", str(tmp_path / "c.laz"), "--pulses", "50")
        return CliRunner().invoke(simulate, [*fixed, *arguments])

    assert run("--sensor", "discrete", "--dead-zone", "1").exit_code == 0
    assert run("--sensor", "discrete").exit_code == 1
    assert run("--sensor", "discrete", "--overwrite", "--json").exit_code == 0
