"""Pulses of several packets in voxels: joined or split, in any order and any unit, with lost packets, and errors."""

import numpy as np
import pytest
from packet_strips import LENGTHS, draw_canopy, record, render, write_recorded

from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import Survey
from wavebatch.surveying.systems.survey_result import SavedSurvey
from wavebatch.tools.voxels import rays
from wavebatch.tools.voxels.strip import VoxelOptions, voxelize_strip

NOISE = ReceiverNoise(baseline=12.0, baseline_spread=0.1, std=0.58)
SAVED = SavedSurvey(Survey(SystemPulse(2.0, noise=NOISE), 1000))
N = 1500


def voxelize(strip, folder, *, size=1.0, ratio=2.0, where=None, all_crossed=True, **options):
    chosen = PointFilter.build(where=where)
    settings = VoxelOptions(size, headroom=50.0, reflectance_ratio=ratio, all_crossed=all_crossed, chosen=chosen)
    summary = voxelize_strip(strip, folder / "v.npz", settings, system=SAVED, force=True, overwrite=True, **options)
    with np.load(folder / "v.npz") as file:
        return summary, {name: file[name] for name in file}


def shares(found, layers):
    """Share of all light that is caught in layers given as (low, high) [m]."""
    z = found["origin"][2] + (found["index"][:, 2] + 0.5) * found["size"]
    caught = np.nan_to_num(found["share"]) * found["light"].astype(float)
    rays = max(found["light"][z == one].sum(dtype=float) for one in np.unique(z))
    return np.array([caught[(z > low) & (z < high)].sum() / rays for low, high in layers])


def layer_of(found):
    """Lower face of each voxel of 1 m."""
    return np.floor(found["origin"][2] + found["index"][:, 2] + 0.5)


LAYERS = ((120, 124), (114, 118), (108, 112), (98, 102))


@pytest.fixture(scope="module")
def canopy():
    """Counts, heights, positions, echoes, and the light that each layer catches."""
    rng = np.random.default_rng(5)
    echoes, xy, caught = draw_canopy(rng, N, density=0.2)
    begin = 128.0 + rng.uniform(0, 0.3, N)
    return render(echoes, begin, 224, rng), begin, xy, echoes, caught.mean(axis=0)


@pytest.fixture(scope="module")
def strips(canopy, tmp_path_factory):
    """The same pulses with one packet each, and with a packet per stretch above the threshold."""
    folder = tmp_path_factory.mktemp("packets")
    *pulses, _ = canopy
    packets = record(canopy[0], 4)
    assert {1, 2, 3} == {len(one) for one in packets}
    return write_recorded(folder / "joined.las", *pulses), write_recorded(folder / "split.las", *pulses, packets)


@pytest.fixture(scope="module")
def whole(strips, tmp_path_factory):
    """What the pulses with one packet each give."""
    return voxelize(strips[0], tmp_path_factory.mktemp("whole"))


@pytest.mark.quick_cases("None")
@pytest.mark.parametrize("ratio", [2.0, None])
def test_split_pulses_are_joined_ones(strips, canopy, whole, tmp_path, ratio):
    """As pulses of their own, packets make the shares of the canopy half as large again."""
    (_, joined), (summary, split) = whole, voxelize(strips[1], tmp_path, ratio=ratio)
    assert summary.pulses == N and summary.waveforms > 1.8 * N and summary.several_packets > 0.7 * N
    assert shares(split, LAYERS) == pytest.approx(shares(joined, LAYERS), rel=0.005)
    assert shares(split, LAYERS) == pytest.approx(canopy[-1], abs=0.01)
    assert summary.reflectance_ratio == pytest.approx(2.0, abs=0.15) and 0.01 < summary.hidden_light < 0.06
    # What lies between two packets was seen to be empty.
    between = [one["path"][layer_of(one) == 105].sum() for one in (split, joined)]
    assert between[0] == pytest.approx(between[1], rel=0.002) and between[1] > 0.8 * N


@pytest.mark.slow
def test_the_strip_may_be_in_any_order_and_cut_anywhere(strips, canopy, tmp_path):
    *pulses, _ = canopy
    expected = voxelize(strips[1], tmp_path, profiles=tmp_path / "a.npz")[1]
    made = [(tmp_path / name).read_bytes() for name in ("v.npz", "a.npz")]
    for block_size, held in ((40, 1 << 18), (97, 400)):
        voxelize(strips[1], tmp_path, block_size=block_size, held=held, profiles=tmp_path / "a.npz")
        assert [(tmp_path / name).read_bytes() for name in ("v.npz", "a.npz")] == made
    mixed = write_recorded(
        tmp_path / "mixed.las", *pulses, record(canopy[0], 4),
        order=lambda n, pulse: np.lexsort((np.random.default_rng(1).random(n), pulse // 100)),
    )  # fmt: skip
    # Packets of most pulses at borders lie in two units.
    for strip in (strips[1], mixed):
        summary, found = voxelize(strip, tmp_path, unit_points=600)
        assert summary.pulses == N
        # The cells of the ground's map are placed by a sample of the points, which depends on their order.
        assert shares(found, LAYERS) == pytest.approx(shares(expected, LAYERS), rel=0.01)
        names = ("index", "energy", "light", "share")
        assert strip == mixed or all(np.array_equal(found[name], expected[name]) for name in names)


def test_five_packets_are_one_pulse(tmp_path):
    rng = np.random.default_rng(2)
    echoes, xy, caught = draw_canopy(rng, 600, layers=(140.0, 130.0, 120.0, 110.0), density=0.15)
    begin = np.full(600, 145.0)
    counts = render(echoes, begin, 352, rng)
    packets = record(counts, 4)
    assert max(map(len, packets)) == 5
    split = write_recorded(tmp_path / "s.las", counts, begin, xy, echoes, packets)
    summary, found = voxelize(split, tmp_path, profiles=tmp_path / "p.npz")
    layers = [(z - 2, z + 2) for z in (140, 130, 120, 110, 100)]
    assert shares(found, layers) == pytest.approx(caught.mean(axis=0), abs=0.01)
    with np.load(tmp_path / "p.npz") as made:
        assert len(made["point"]) == summary.pulses == 600 and made["packets"].tolist() == [len(p) for p in packets]
        assert np.isinf(made["known"]).all() and (np.diff(made["gps_time"]) > 0).all()
        height = np.repeat(made["start"][:, 2], made["count"]) - HALF_C * made["time"]
        pulse = np.repeat(np.arange(600), made["count"])
        ground = np.bincount(pulse, np.where(height < 102, made["energy"], 0), minlength=600)
    true = np.zeros(600)
    low = echoes[:, 1] < 102
    true[echoes[low, 0].astype(int)] = echoes[low, 2] * 2.0 * np.sqrt(2 * np.pi)
    assert ground == pytest.approx(true, abs=60)


def test_packets_that_overlap_count_once(canopy, whole, tmp_path):
    """All samples twice, in packets that overlap by half or lie inside another."""
    *pulses, _ = canopy
    twice = write_recorded(tmp_path / "s.las", *pulses, [[(0, 159), (96, 223), (100, 131)]] * N)
    summary, found = voxelize(twice, tmp_path)
    whole, joined = whole
    assert summary.pulses == N and summary.waveforms == 3 * N and max(LENGTHS) > 224
    assert summary.energy == pytest.approx(whole.energy, rel=0.002)
    assert shares(found, LAYERS) == pytest.approx(shares(joined, LAYERS), rel=0.005)


def test_of_two_packets_that_overlap_each_counts_to_the_middle_of_what_both_recorded():
    """Samples 0 to 9 and 6 to 19 of a ray, 1 ns apart; the middle of 5.5 to 9.5 is 7.5."""
    packets, samples = np.zeros(2, rays.PACKET), np.zeros(24, rays.SAMPLE)
    packets["point"], packets["seen"], packets["begin"], packets["end"] = (0, 1), True, -0.5, (9.5, 13.5)
    packets["step"] = 0.0, 0.0, -HALF_C
    packets["start"][1] = 6.0 * packets["step"][0]
    samples["packet"], samples["time"] = np.repeat((0, 1), (10, 14)), [*range(10), *range(14)]
    samples["energy"] = 100.0 * samples["packet"] + samples["time"]
    joined = rays.join_packets(packets, samples, np.zeros(0, rays.LOST))
    assert joined.samples["time"].tolist() == list(range(20))
    assert joined.samples["energy"].tolist() == [*range(8), *range(102, 114)]


def test_light_is_known_up_to_a_lost_packet(canopy, strips, tmp_path):
    """A quarter of the pulses lack their last packet: without a rule, their canopy would catch all of their light."""
    *pulses, true = canopy
    packets = record(canopy[0], 4)
    several = [pulse for pulse in range(N) if len(packets[pulse]) > 1]
    wrong = {(pulse, len(packets[pulse]) - 1) for pulse in several[::4]}
    lossy = write_recorded(tmp_path / "s.las", *pulses, packets, wrong=wrong)
    summary, found = voxelize(lossy, tmp_path, profiles=tmp_path / "p.npz")
    assert summary.lost_packets == len(wrong) and summary.pulses == N
    assert shares(found, LAYERS[:3]) == pytest.approx(true[:3], abs=0.01)
    low = layer_of(found) == 103
    assert found["rays"][low].sum() < N - 0.9 * len(wrong)
    with np.load(tmp_path / "p.npz") as made:
        assert np.isfinite(made["known"]).sum() == len(wrong)
    first = write_recorded(tmp_path / "f.las", *pulses, packets, wrong={(pulse, 0) for pulse in several[::4]})
    summary, found = voxelize(first, tmp_path)
    assert summary.lost_packets == len(wrong)
    z = layer_of(found)
    assert found["rays"][z == 126].sum() == N - len(wrong)
    # Beyond the lost packet light is not known, energy is.
    whole = voxelize(strips[1], tmp_path)[1]
    expected = whole["energy"][layer_of(whole) == 100].sum()
    assert found["energy"][z == 100].sum() == pytest.approx(expected, rel=0.001)


def test_returns_that_are_missing_or_stand_far_apart_are_named(strips, canopy, edit_points, tmp_path):
    """Sorted by return number, packets of a pulse were pulses of their own; of first returns alone light is missing."""
    *pulses, _ = canopy
    with StripReader(strips[1]) as reader:
        time = reader.read_points(0, reader.facts.header.point_count)["gps_time"]
    totals = np.unique(time, return_counts=True)[1]

    def number(points):
        _, first, pulse = np.unique(points["gps_time"], return_index=True, return_inverse=True)
        points["bit_fields"] = np.arange(len(points)) - first[pulse] + 1 | totals[pulse] << 3
        return points

    def sort(points):
        return points[np.argsort(points["bit_fields"] & 7, kind="stable")]

    whole = edit_points(strips[1], tmp_path / "whole.las", number)
    by_number = edit_points(whole, tmp_path / "sorted.las", sort)
    first = write_recorded(
        tmp_path / "f.las", *pulses, record(canopy[0], 4), order=lambda n, pulse: np.unique(pulse, return_index=True)[1]
    )
    thinned = edit_points(first, tmp_path / "thinned.las", number)
    for strip, unit_points, words in (
        (whole, None, ""), (whole, 600, ""), (by_number, None, ""), (by_number, 600, "stand far apart in the file"),
        (thinned, None, f"{len(time) - N} of {len(time)} returns that"),
    ):  # fmt: skip
        summary, _ = voxelize(strip, tmp_path, unit_points=unit_points)
        said = [line for line in summary.warnings if "in the file" in line]
        assert len(said) == bool(words) and all(words in line for line in said), (strip, unit_points)


@pytest.mark.parametrize("apart", ["direction", "scanner", "place"])
def test_pulses_of_equal_time_are_not_one(canopy, tmp_path, apart):
    """Two channels, or two scanners: each pulse has the time of its neighbour."""
    counts, begin, xy, echoes, _ = canopy
    n = 400
    counts, begin, xy, echoes = counts[:n], begin[:n], xy[:n].copy(), echoes[echoes[:, 0] < n]
    xy[1::2] = xy[::2] + (5.0 if apart == "place" else 0.0)
    direction = np.tile([0.0, 0.0, -HALF_C], (n, 1))
    if apart == "direction":
        direction[1::2, 0] = 0.06 * HALF_C
    scanner = np.arange(n) % 2 if apart == "scanner" else np.zeros(n, int)
    time = 1000.0 + np.arange(n) // 2 * 1e-5
    strip = write_recorded(tmp_path / "s.las", counts, begin, xy, echoes, record(counts, 4), time=time,
                           direction=direction, scanner=scanner)  # fmt: skip
    summary, found = voxelize(strip, tmp_path)
    assert summary.pulses == n
    assert found["light"][layer_of(found) == 126].sum() == pytest.approx(n, abs=12 if apart == "direction" else 0)
    if apart == "scanner":
        summary, _ = voxelize(strip, tmp_path, where="scanner_channel == 1")
        assert summary.pulses == n / 2 and summary.left_out + summary.waveforms > n


def test_times_of_many_packets_are_no_pulse(canopy, tmp_path):
    """A constant time is none, nor is 0: each packet stays a pulse."""
    *pulses, _ = canopy
    for time in (0.0, 77.0):
        strip = write_recorded(tmp_path / f"{time}.las", *pulses, record(canopy[0], 4), time=np.full(N, time))
        summary, _ = voxelize(strip, tmp_path)
        assert summary.pulses == summary.waveforms > N and summary.several_packets == summary.lost_packets == 0


@pytest.mark.slow
@pytest.mark.parametrize(("clumps", "density"), [(None, 0.25), (0.35, 0.3), (0.35, 0.7)])
def test_errors_of_shares_cover_the_truth(tmp_path, clumps, density):
    """Leaves spread evenly, and in clumps of .35 m that cover a part of each voxel: two of three within an error."""
    rng = np.random.default_rng(3)
    parts = []
    for _ in range(2):
        echoes, xy, _ = draw_canopy(rng, 3000, layers=(119.0, 113.0), density=density, width=28.0, clumps=clumps)
        counts = render(echoes, np.full(3000, 122.0), 170, rng)
        strip = write_recorded(tmp_path / "s.las", counts, np.full(3000, 122.0), xy, echoes)
        _, found = voxelize(strip, tmp_path, size=2.0, ratio=None)
        centre = found["origin"] + (found["index"] + 0.5) * 2.0
        used = (np.abs(centre[:, 2, None] - (119.0, 113.0)) < 0.5).any(axis=1) & (found["light"] > 2)
        parts.append((found["share"][used] - density) / found["share_error"][used])
        (tmp_path / "s.las").unlink()
    off = np.concatenate(parts)
    assert 0.6 < np.mean(np.abs(off) < 1) < 0.8 and len(off) > 600 and abs(np.mean(off)) < 0.25


@pytest.mark.slow
def test_a_wrong_ratio_is_within_the_errors(tmp_path):
    """Two kinds of soil: the ratio is that of one of them, and its error says how much the other differs."""
    rng = np.random.default_rng(4)
    echoes, xy, caught = draw_canopy(rng, 3000, density=0.3)
    low, bright = echoes[:, 1] < 102, xy[:, 0] % 8 < 4
    echoes[low, 2] *= np.where(bright, 1.5, 0.5)[echoes[low, 0].astype(int)]
    begin = np.full(3000, 128.0)
    strip = write_recorded(tmp_path / "s.las", render(echoes, begin, 224, rng), begin, xy, echoes)
    summary, found = voxelize(strip, tmp_path, ratio=None)
    assert summary.reflectance_ratio_source == "strip"
    assert abs(summary.reflectance_ratio - 2.0) < 2 * summary.reflectance_ratio_err
    assert abs(shares(found, LAYERS)[3] / caught.mean(axis=0)[3] - 1) > 0.02
    _, given = voxelize(strip, tmp_path, ratio=summary.reflectance_ratio)
    assert (found["share_error"] >= given["share_error"] - 1e-7).all()
    partly = (found["share"] > 0.1) & (found["share"] < 0.9)
    assert np.mean(found["share_error"][partly] - given["share_error"][partly]) > 1e-3


def test_where_takes_whole_pulses(strips, tmp_path):
    """The ground's return chooses the pulse, with its canopy."""
    summary, found = voxelize(strips[1], tmp_path, where="z < 102")
    whole, _ = voxelize(strips[1], tmp_path)
    assert 0.8 * N < summary.pulses < N and summary.waveforms + summary.left_out == whole.waveforms
    assert shares(found, LAYERS)[0] > 0.1
