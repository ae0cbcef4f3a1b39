"""`wavebatch synthesize`: the strip holds the cloud, and `run` finds its returns again."""

import json

import laspy
import numpy as np
import pytest
from batch_tools import read_cloud, run_one
from click.testing import CliRunner
from commands import succeed

from wavebatch.cli.strips import synthesize
from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import check_file
from wavebatch.tools.pairing import compare_clouds
from wavebatch.tools.simulate import DiscreteReceiver, returns, simulate_returns
from wavebatch.tools.simulate.returns import Radar, SynthesisOptions, synthesize_strip


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """Returns of 2000 pulses in trees, at least 2 m apart."""
    path = tmp_path_factory.mktemp("synthesize") / "cloud.las"
    simulate_returns("canopy.gemini-24", path, pulses=2000, seed=8, receiver=DiscreteReceiver(2.0))
    return path


def read_blocks(path):
    with StripReader(path) as reader:
        scan = reader.scan()
        unit = reader.read_unit(0, scan)
        return [block for block, _ in reader.read_blocks(unit, 100_000, True)]


@pytest.mark.quick_cases("1.0")
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_run_finds_the_returns_again(cloud, noise, tmp_path):
    summary = synthesize_strip(cloud, tmp_path / "s.laz", SynthesisOptions(noise=noise))
    assert summary.packets == 2000 and summary.without_packet == summary.scattered == 0
    assert check_file(tmp_path / "s.laz").is_clean
    assert run_one(tmp_path / "s.laz", tmp_path / "out", profile="balanced").error is None
    result = compare_clouds(tmp_path / "out" / "s.laz", cloud)
    assert result.completeness > 0.97 and result.correctness > 0.97
    assert abs(result.differences["time"].median) < 0.02
    assert result.differences["time"].nmad < 0.1


def test_samples_are_gaussians_at_the_returns(cloud, tmp_path):
    options = SynthesisOptions(gain=0.05, width=6.0, bits=16, baseline=300.0, spacing=0.5)
    synthesize_strip(cloud, tmp_path / "s.las", options)
    intensity = read_cloud(cloud)[0]["intensity"].astype(float)
    xyz = read_cloud(cloud)[1]
    lengths = set()
    for block in read_blocks(tmp_path / "s.las"):
        lengths.add(block.samples.shape[1])
        assert np.linalg.norm(block.direction, axis=1) == pytest.approx(np.full(len(block), 0.149896229), rel=1e-6)
        returns = block.returns
        time = np.arange(block.samples.shape[1]) * 0.5
        model = np.full(block.samples.shape, 300.0)
        waves = (
            0.05
            * intensity[returns.point][:, None]
            * np.exp(-0.5 * ((time - returns.time[:, None]) / (6.0 / 2.35482)) ** 2)
        )
        np.add.at(model, returns.waveform, waves)
        assert np.abs(block.samples - model).max() < 0.51
        place = block.origin[returns.waveform] + returns.time[:, None] * block.direction[returns.waveform]
        assert np.abs(place - xyz[returns.point]).max() < 0.02
        assert returns.time.min() > 5 * 6.0 / 2.35482
        assert (time[-1] - returns.time).min() > 5 * 6.0 / 2.35482
    assert len(lengths) > 1


def test_lone_returns_take_the_direction_of_their_scan_angle(cloud, tmp_path):
    synthesize_strip(cloud, tmp_path / "s.las")
    points = read_cloud(tmp_path / "s.las")[0]
    lone = points["bit_fields"] >> 3 & 7 == 1
    y, z = points["y_t"][lone], points["z_t"][lone]
    assert lone.sum() > 100
    assert -y / z == pytest.approx(np.tan(np.radians(points["scan_angle_rank"][lone])), abs=0.03)
    assert points["x_t"][lone] / z == pytest.approx(np.full(lone.sum(), -4 / 57.3), abs=0.02)


def test_measured_widths_come_first(cloud, tmp_path):
    synthesize_strip(cloud, tmp_path / "s.las", SynthesisOptions(width=8.0, bits=16, gain=5.0))
    run_one(tmp_path / "s.las", tmp_path / "out", profile="balanced")
    synthesize_strip(tmp_path / "out" / "s.laz", tmp_path / "again.las", SynthesisOptions(width=3.0, bits=16, gain=5.0))
    (wide,) = {block.samples.shape[1] for block in read_blocks(tmp_path / "again.las")} & {128}
    block = next(block for block in read_blocks(tmp_path / "again.las") if block.samples.shape[1] == wide)
    peak = block.samples[block.returns.waveform].max(axis=1).astype(float) - 12
    above = (block.samples - 12.0 > 0.5 * (block.samples.max(axis=1) - 12.0)[:, None]).sum(axis=1)
    assert peak.max() > 500
    assert np.percentile(above, 10) >= 7


@pytest.mark.parametrize(("given", "expected"), [(1, 4), (3, 5), (6, 9), (7, 10)])
def test_points_are_those_of_the_cloud_and_pieces_cut_no_pulse(cloud, given, expected, tmp_path):
    las = laspy.convert(laspy.read(cloud), point_format_id=given)
    las.user_data[:] = np.arange(len(las)) % 251
    las.write(tmp_path / "c.las")
    summary = synthesize_strip(tmp_path / "c.las", tmp_path / "s.laz", SynthesisOptions(gain=0.1), piece=37)
    assert summary.packets == 2000 and summary.scattered == 0 and check_file(tmp_path / "s.laz").is_clean
    with laspy.open(tmp_path / "s.laz", read_evlrs=False) as reader:
        assert reader.header.point_format.id == expected
    before, after = read_cloud(tmp_path / "c.las")[0], read_cloud(tmp_path / "s.laz")[0]
    assert len(np.unique(after["wavepacket_offset"])) == 2000
    for field in before.dtype.names:
        assert np.array_equal(before[field], after[field]), field


def test_reflectances_are_weakened_with_range(tmp_path):
    simulate_returns("flat", tmp_path / "c.las", pulses=300)
    radar = {height: Radar(height, power=4000.0) for height in (620.0, 1120.0)}
    peaks = []
    for height, figures in radar.items():
        options = SynthesisOptions("reflectance", 1e11, figures, bits=16)
        synthesize_strip(tmp_path / "c.las", tmp_path / f"{height}.las", options)
        (block,) = read_blocks(tmp_path / f"{height}.las")
        peaks.append(block.samples.max(axis=1) - 12.0)
    assert np.median(peaks[0] / peaks[1]) == pytest.approx(4 * 10 ** (2 * 0.5 * 0.22 / 10), rel=0.02)
    points = read_cloud(tmp_path / "c.las")[0]
    distance = 500.0 / np.cos(np.radians(points["scan_angle_rank"].astype(float)))
    # Of a surface that fills the footprint, without the beam's divergence.
    power = 4000.0 * 0.1**2 * points["intensity"] / 65535 * 0.5 * 10 ** (-0.22e-4 * 2 * distance) / (4 * distance**2)
    assert np.median(peaks[0] / (1e11 * power)) == pytest.approx(0.99, abs=0.01)  # samples are beside the peak
    with pytest.raises(InputError, match="above the sensor"):
        synthesize_strip(tmp_path / "c.las", tmp_path / "x.las", SynthesisOptions("reflectance", 1.0, Radar(100.0)))


def run(*arguments):
    return CliRunner().invoke(synthesize, [str(argument) for argument in arguments])


def test_command_line(cloud, tmp_path):
    target = tmp_path / "s.las"
    assert json.loads(run(cloud, "-o", target, "--json", "-q").stdout)["packets"] == 2000
    again = run(cloud, "-o", target)
    assert again.exit_code == 1 and again.stderr.count("\n") == 1 and "exists already" in again.stderr
    strong = run(cloud, "-o", target, "--overwrite", "--gain", "10")
    assert strong.exit_code == 0 and "above the digitizer" in strong.stderr
    figures = ("--intensity", "reflectance", "--sensor-height", "920", "--divergence", "0.7")
    succeed("synthesize", cloud, "-o", tmp_path / "r.las", *figures)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.las", "s.las"]


FIGURES = {"gain": 1e11, "radar": Radar(1200.0, power=4000.0), "bits": 16, "spacing": 0.5, "width": 5.0}


def add_columns(path, target, **columns):
    """The cloud with extra bytes; a name with a unit in brackets gets it as its description."""
    cloud = laspy.read(path)
    for name, values in columns.items():
        cloud.add_extra_dim(laspy.ExtraBytesParams(name.split("[")[0], "f4", description=name))
        cloud[name.split("[")[0]] = values
    cloud.write(target)
    return target


def energies(path, spacing=0.5, baseline=12.0):
    """Energy of each pulse's samples above the baseline by GPS time [DN ns]."""
    found = {}
    for block in read_blocks(path):
        found |= dict(zip(block.gps_time.tolist(), spacing * (block.samples - baseline).sum(axis=1), strict=True))
    return np.array([found[key] for key in sorted(found)])


def pulses_of(path):
    """Pulse of each point, from 0 in the order of the times, and returns per pulse."""
    times = np.unique(laspy.read(path).gps_time, return_inverse=True)[1]
    return times, np.bincount(times)


def test_each_return_sends_back_its_share_of_the_light(cloud, tmp_path):
    """Energies of pulses with shares are those sums of the energies of the returns alone."""
    pulse, number = pulses_of(cloud)
    share = np.random.default_rng(1).uniform(0.2, 0.9, len(pulse)).astype("f4") / number[pulse]
    given = add_columns(cloud, tmp_path / "c.las", footprint=share)
    whole = synthesize_strip(given, tmp_path / "w.las", SynthesisOptions("reflectance", **FIGURES))
    part = synthesize_strip(given, tmp_path / "s.las", SynthesisOptions("reflectance", shares="footprint", **FIGURES))
    even = synthesize_strip(given, tmp_path / "e.las", SynthesisOptions("reflectance", shares="equal", **FIGURES))
    ones = number == 1
    ratio = energies(tmp_path / "s.las")[ones] / energies(tmp_path / "w.las")[ones]
    assert ratio == pytest.approx(share[ones[pulse]], rel=0.02)
    assert energies(tmp_path / "e.las") == pytest.approx(energies(tmp_path / "w.las") / number, rel=0.02)
    assert part.light.own_share == len(pulse) and part.light.assumed_share == part.light.over_one == 0
    assert part.light_used == pytest.approx(np.bincount(pulse, share).mean()) and even.light_used == pytest.approx(1)
    assert np.isnan(whole.light_used)
    for summary, name in ((whole, "w"), (part, "s"), (even, "e")):
        assert summary.saturated == 0
        assert summary.energy_recorded == pytest.approx(energies(tmp_path / f"{name}.las").sum(), rel=1e-9)
        assert summary.energy_recorded == pytest.approx(summary.energy, rel=0.003)


def test_shares_of_a_pulse_are_at_most_one_and_gaps_take_the_rest():
    starts = np.array([0, 2, 5, 7, 8, 10])
    share = np.array([0.3, np.nan, 0.2, np.nan, np.nan, 0.9, 0.6, np.nan, 1.0, np.nan, 1.00005])
    filled, over = returns.fill_shares(share, starts)
    assert filled == pytest.approx([0.3, 0.7, 0.2, 0.4, 0.4, 0.6, 0.4, 1.0, 1.0, 0.0, 1.0])
    assert over == 1  # float32 dust above 1 is none
    rng = np.random.default_rng(0)
    count = rng.integers(1, 6, 500)
    starts = np.cumsum(count) - count
    share = np.where(rng.random(count.sum()) < 0.3, np.nan, rng.random(count.sum()))
    filled, _ = returns.fill_shares(share, starts)
    assert filled.min() >= 0 and np.add.reduceat(filled, starts).max() < 1 + 1e-12
    for start, n in zip(starts, count, strict=True):
        part = share[start : start + n]
        known = part[~np.isnan(part)]
        if len(known) == n and known.sum() <= 1:
            assert filled[start : start + n] == pytest.approx(part)


def test_a_wide_echo_is_lower_and_has_the_same_energy(cloud, tmp_path):
    pulse, number = pulses_of(cloud)
    width = np.where(pulse % 2, 10.0, 5.0).astype("f4")
    width[::7] = np.nan  # those of the pulse
    given = add_columns(cloud, tmp_path / "c.las", **{"their width[ns]": width})
    synthesize_strip(given, tmp_path / "p.las", SynthesisOptions("reflectance", **FIGURES))
    options = SynthesisOptions("reflectance", widths="their width", **FIGURES)
    summary = synthesize_strip(given, tmp_path / "w.las", options)
    assert energies(tmp_path / "w.las") == pytest.approx(energies(tmp_path / "p.las"), rel=0.02)
    assert summary.light.own_width == np.isfinite(width).sum() and summary.light.limited_width == 0
    peaks = {}
    for name in ("p", "w"):
        for block in read_blocks(tmp_path / f"{name}.las"):
            top = block.samples.max(axis=1) - 12.0
            peaks |= {(name, time): height for time, height in zip(block.gps_time.tolist(), top, strict=True)}
    times = np.unique(laspy.read(cloud).gps_time)
    ratio = np.array([peaks["w", time] / peaks["p", time] for time in times.tolist()])
    lone = number == 1
    expected = np.where(width[lone[pulse]] == 10.0, 0.5, 1.0)
    assert ratio[lone] == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(
    ("baseline", "noise", "level"), [(0.0, 2.0, 0.7), (3.0, 2.0, 3.03), (12.4, 0.0, 12.0), (12.4, 1.0, 12.4)]
)
def test_energy_that_is_not_of_echoes_is_shown(cloud, tmp_path, baseline, noise, level):
    """Noise that is cut off at 0, or a fraction of a count, moves every sample without an echo."""
    words = ("--baseline", baseline, "--noise", noise, "--gain", 0.01, "--bits", 16)
    result = succeed("synthesize", cloud, "-o", tmp_path / "s.las", *words, "--json")
    document = json.loads(result.stdout)
    samples = np.concatenate([block.samples[:, :4].ravel() for block in read_blocks(tmp_path / "s.las")])
    error = 5 * max(samples.std(), 1e-6) / np.sqrt(samples.size)
    assert document["level"] == pytest.approx(level, abs=0.12) and document["level"] == pytest.approx(
        samples.mean(), abs=error
    )
    excess = document["energy_recorded"] - document["energy"]
    assert excess == pytest.approx(document["energy_of_level"], rel=0.4, abs=0.01 * document["energy"])
    is_off = abs(document["energy_of_level"]) > 0.001 * document["energy"]
    assert is_off == (abs(level - baseline) > 0.01)
    assert ("are not of echoes" in result.stderr) == is_off, result.stderr


def test_the_ratio_of_energies_leaves_out_echoes_without_a_packet(tmp_path, cloud):
    las = laspy.read(cloud)
    first = np.flatnonzero(las.return_number == 1)[las.number_of_returns[las.return_number == 1] > 1][:300]
    las.z[first] = las.z[first] + 3000.0  # no waveform is so long
    las.write(tmp_path / "far.las")
    result = run(tmp_path / "far.las", "-o", tmp_path / "s.las", "--bits", 16, "--gain", 5, "--json")
    document = json.loads(result.stdout)
    assert document["without_packet"] >= 600 and document["energy_without_packet"] > 0.1 * document["energy"]
    packed = document["energy"] - document["energy_without_packet"]
    assert document["energy_recorded"] == pytest.approx(packed, rel=0.003)
    assert f"({document['energy_recorded'] / packed:.1%})" in result.stderr
    assert f"{document['energy_without_packet']:.4g} DN ns without a packet" in result.stderr


@pytest.mark.parametrize("gain", [(), ("--gain", "0.05")])
def test_widths_of_which_most_are_possible_are_taken_as_nanoseconds(cloud, tmp_path, gain):
    points = len(laspy.read(cloud))
    some = np.full(points, 5.0)
    some[: int(0.4 * points)] = 4000.0
    given = add_columns(cloud, tmp_path / "c.las", some=some)
    result = run(given, "-o", tmp_path / "s.las", "--widths", "some", *gain)
    assert result.exit_code == 0 and "some states no unit; its values were taken as nanoseconds" in result.stderr


def test_shares_above_one_together_are_scaled_and_counted(cloud, tmp_path):
    given = add_columns(cloud, tmp_path / "c.las", footprint=np.full(len(laspy.read(cloud)), 0.9))
    figures = ("--intensity", "reflectance", "--sensor-height", "1200", "-o", tmp_path / "s.las")
    over = run(given, *figures, "--shares", "footprint")
    assert "with shares above 1 together, scaled to 1" in over.stderr and "energy: " in over.stderr
    document = json.loads(run(given, *figures, "--shares", "footprint", "--json", "-q", "--overwrite").stdout)
    assert document["light"]["over_one"] == np.count_nonzero(pulses_of(cloud)[1] > 1)
    assert document["light_used"] < 1


def test_equal_shares_count_the_returns_that_a_thinned_cloud_lacks(cloud, tmp_path):
    """First returns alone keep the energy that they have in the whole cloud."""
    las = laspy.read(cloud)
    las.points = las.points[np.array(las.return_number) == 1]
    las.write(tmp_path / "first.las")
    options = SynthesisOptions("reflectance", shares="equal", **FIGURES)
    whole = synthesize_strip(cloud, tmp_path / "w.las", options)
    first = synthesize_strip(tmp_path / "first.las", tmp_path / "f.las", options)
    number = np.array(las.number_of_returns)
    assert whole.light_used == pytest.approx(1) and first.light_used == pytest.approx(np.mean(1 / number))
    assert first.scattered == np.count_nonzero(number > 1)
    words = ("-o", tmp_path / "x.las", "--intensity", "reflectance", "--sensor-height", 1200, "--overwrite")
    said = run(tmp_path / "first.las", *words, "--shares", "equal")
    assert "equal shares use number_of_returns, including missing returns" in said.stderr
    assert "shares of incomplete pulses" not in said.stderr  # they are not those of the points that are there
    given = add_columns(tmp_path / "first.las", tmp_path / "g.las", footprint=np.full(len(las.points), 0.3))
    said = run(given, *words, "--shares", "footprint")
    assert "shares of incomplete pulses are those of the points that are there" in said.stderr
