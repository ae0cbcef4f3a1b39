"""`wavebatch synthesize`: the strip holds the cloud, and `run` finds its returns again."""

import json

import laspy
import numpy as np
import pytest
from batch_tools import read_cloud, run_one
from click.testing import CliRunner

from wavebatch.cli.simulate import synthesize
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.geometry.pulse_rays import fit_rays, group_pulses
from wavebatch.kernels.physics.radar import pass_atmosphere, receive_power, spread_cross_section
from wavebatch.surveying.inspect_strip import check_file
from wavebatch.tools.compare.clouds import compare_clouds
from wavebatch.tools.simulate import DiscreteReceiver, StripOptions, simulate_returns
from wavebatch.tools.simulate.from_returns import Radar, SynthesisOptions, synthesize_strip


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


def test_points_are_those_of_the_cloud(cloud, tmp_path):
    for name in ("s.las", "s.laz"):
        synthesize_strip(cloud, tmp_path / name)
        before, after = read_cloud(cloud), read_cloud(tmp_path / name)
        assert np.array_equal(before[1], after[1])
        for field in before[0].dtype.names:
            assert np.array_equal(before[0][field], after[0][field]), field


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
        waves = 0.05 * intensity[returns.point][:, None] * np.exp(
            -0.5 * ((time - returns.time[:, None]) / (6.0 / 2.35482)) ** 2
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


def test_pieces_cut_no_pulse(cloud, tmp_path, monkeypatch):
    synthesize_strip(cloud, tmp_path / "whole.las", SynthesisOptions(gain=0.1))
    monkeypatch.setattr("wavebatch.tools.simulate.from_returns._PIECE", 37)
    monkeypatch.setattr("wavebatch.tools.simulate.from_returns._PAINTED", 1000)
    summary = synthesize_strip(cloud, tmp_path / "parts.las", SynthesisOptions(gain=0.1))
    assert summary.packets == 2000 and summary.scattered == 0
    whole, parts = read_cloud(tmp_path / "whole.las")[0], read_cloud(tmp_path / "parts.las")[0]
    assert np.array_equal(whole["gps_time"], parts["gps_time"])
    assert len(np.unique(parts["wavepacket_offset"])) == 2000


@pytest.mark.parametrize(("given", "expected"), [(4, 4), (5, 5), (9, 9), (10, 10)])
def test_every_family_of_formats(given, expected, tmp_path):
    simulate_returns("forest", tmp_path / "c.laz", pulses=200, options=StripOptions(point_format=given))
    synthesize_strip(tmp_path / "c.laz", tmp_path / "s.laz", SynthesisOptions(internal=given > 5))
    assert check_file(tmp_path / "s.laz").is_clean
    with laspy.open(tmp_path / "s.laz", read_evlrs=False) as reader:
        assert reader.header.point_format.id == expected
        assert (len([v for v in reader.header.vlrs if v.user_id == "LASF_Projection"]) == 1) == (given > 5)
    assert (tmp_path / "s.wdp").exists() == (given < 6)


def test_lidar_equation_for_a_surface_that_fills_the_footprint():
    distance = np.array([300.0, 800.0, 3000.0])
    figures = {"transmitted": 4000.0, "aperture": 0.1, "efficiency": 0.4, "attenuation": 0.3}
    power = receive_power(spread_cross_section(0.3, distance, 7e-4), distance, divergence=7e-4, **figures)
    through = pass_atmosphere(distance, 0.3)
    assert power == pytest.approx(4000 * 0.1**2 * 0.3 * 0.4 * through**2 / (4 * distance**2), rel=1e-12)
    assert pass_atmosphere(np.array([1000.0]), 0.22) ** 2 == pytest.approx([0.904], abs=5e-4)


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
    with pytest.raises(InputError, match="above the sensor"):
        synthesize_strip(tmp_path / "c.las", tmp_path / "x.las", SynthesisOptions("reflectance", 1.0, Radar(100.0)))


def test_pulses_are_runs_of_equal_time_and_rising_numbers():
    time, number = np.array([1, 1, 2, 2, 2, 2, 3.0]), np.array([1, 2, 1, 2, 1, 2, 3], np.uint8)
    assert group_pulses(time, number).tolist() == [0, 2, 4, 6]
    assert group_pulses(time[:0], number[:0]).tolist() == []


def test_rays_without_enough_pairs_are_vertical():
    rays = fit_rays(np.zeros((3, 3)), np.arange(3), np.array([0.0, 20.0, -20.0]), np.zeros(3, int))
    assert rays.tolist() == [[0, 0, -1]] * 3


@pytest.mark.parametrize(
    "wrong",
    [{"width": 0.0}, {"gain": -1.0}, {"width": 0.5}, {"intensity": "x"}, {"intensity": "reflectance"}],
)
def test_wrong_options_are_refused(wrong):
    with pytest.raises(ConfigError):
        SynthesisOptions(**wrong)
    with pytest.raises(ConfigError):
        Radar(100.0, aperture=0.0)


def run(*arguments):
    return CliRunner().invoke(synthesize, [str(argument) for argument in arguments])


def test_command_line(cloud, tmp_path):
    target = tmp_path / "s.las"
    assert json.loads(run(cloud, "-o", target, "--json", "-q").stdout)["packets"] == 2000
    again = run(cloud, "-o", target)
    assert again.exit_code == 1 and again.stderr.count("\n") == 1 and "exists already" in again.stderr
    strong = run(cloud, "-o", target, "--overwrite", "--gain", "10")
    assert strong.exit_code == 0 and "above the digitizer" in strong.stderr
    assert run(cloud, "-o", tmp_path / "t.las", "--intensity", "reflectance").exit_code == 2
    assert run(cloud, "-o", tmp_path / "t.las", "--power", "3").exit_code == 2
    assert run(cloud, "-o", tmp_path / "t.las", "--width", "0").exit_code == 2
    assert run(cloud, "-o", tmp_path / "t.txt").exit_code == 2
    figures = ("--intensity", "reflectance", "--sensor-height", "920", "--divergence", "0.7")
    radar = run(cloud, "-o", tmp_path / "r.las", *figures)
    assert radar.exit_code == 0, radar.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.las", "s.las"]
