"""Strips: written, read back with laspy and bytes, and consistent with their truth."""

import struct

import laspy
import numpy as np
import pytest

from wavebatch.core.errors import InputError
from wavebatch.tools.simulate import StripOptions, TruthReader, simulate_strip
from wavebatch.tools.simulate.render import AIR_SPEED
from wavebatch.tools.simulate.returns import list_returns
from wavebatch.tools.simulate.scenes import SEED_BLOCK, find_scene
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
    with TruthReader(path) as reader:
        return reader.meta, reader.read(*ECHO_COLUMNS), reader.read("packet_byte_offset", "packet_gps_time")


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


def test_returns_are_numbered_and_share_packets_and_times(tmp_path):
    path = tmp_path / "strip.laz"
    simulate_strip("forest", path, pulses=3000, seed=3)
    cloud = laspy.read(path)
    times = np.asarray(cloud.gps_time)
    assert (np.diff(times) >= 0).all()
    _, first, count = np.unique(times, return_index=True, return_counts=True)
    number = np.asarray(cloud.return_number)
    assert (number[first] == 1).all()
    assert np.array_equal(np.asarray(cloud.number_of_returns), np.repeat(count, count))
    assert np.array_equal(number, np.arange(len(times)) - np.repeat(first, count) + 1)
    offsets = np.asarray(cloud.wavepacket_offset)
    assert all(len(set(offsets[a : a + n].tolist())) == 1 for a, n in zip(first, count, strict=True))
    assert count.max() >= 3
    z = np.asarray(cloud.z)
    later = np.diff(times) == 0
    assert (np.diff(z)[later] < 0).all()


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
    with pytest.raises(InputError, match="cannot be read"):
        TruthReader(path)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match="no truth file"):
        TruthReader(path)
    np.savez(path, time=np.zeros(3))
    with pytest.raises(InputError, match="lacks waveform"):
        TruthReader(path)


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
