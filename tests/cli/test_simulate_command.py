"""`wavebatch simulate`: options reach the strip, errors are one line with the documented exit code."""

import json

import laspy
import numpy as np
from click.testing import CliRunner

from wavebatch.cli.strips import simulate
from wavebatch.tools.simulate import SCENES, TruthReader


def run(*arguments):
    return CliRunner().invoke(simulate, [str(argument) for argument in arguments])


def test_strip_and_truth_are_written_and_counted(tmp_path):
    result = run("urban", "-o", tmp_path / "s.laz", "--pulses", 500, "--truth", tmp_path / "t.npz", "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    with laspy.open(tmp_path / "s.laz", read_evlrs=False) as reader:
        assert reader.header.point_count == summary["points"]
        assert reader.header.point_format.id == 4
    with TruthReader(tmp_path / "t.npz") as truth:
        assert truth.meta["echoes"] == summary["echoes"]
        assert truth.meta["scene"] == "urban"
    assert summary["pulses"] == 500


def test_every_option_reaches_the_recording(tmp_path):
    result = run(
        *("mixed", "-o", tmp_path / "s.las", "--truth", tmp_path / "t.npz", "--pulses", 300, "--seed", 9, "--bits", 16),
        *("--samples", 120, "--spacing", 2, "--noise", 3, "--rho", 0.667, "--noise-gain", 0.05, "--baseline", 200),
        *("--saturation", 900, "--pulse", "leica", "--kappa", 0.05, "--ringing", 0.02, "--point-format", 10),
        *("--external", "--scale", 0.01, "--without-waveform", 0.5, "--drop-empty", "--away"),
    )
    assert result.exit_code == 0, result.output
    with TruthReader(tmp_path / "t.npz") as truth:
        meta = truth.meta
    recording = meta["recording"]
    expected = {"bits": 16, "n_samples": 120, "spacing": 2, "noise_std": 3, "rho": 0.667, "noise_gain": 0.05}
    expected |= {"baseline": 200, "saturation": 900}
    assert {name: recording[name] for name in expected} == expected
    assert recording["pulse"]["kappa"] == 0.05
    assert recording["pulse"]["sigma"] == 3.0
    assert len(recording["pulse"]["lobes"]) == 4
    assert meta["seed"] == 9
    cloud = laspy.read(tmp_path / "s.las")
    assert cloud.header.point_format.id == 10
    assert tuple(cloud.header.scales) == (0.01, 0.01, 0.01)
    assert np.asarray(cloud.z_t).min() < 0
    assert 0.35 < (np.asarray(cloud.wavepacket_index) == 0).mean() < 0.65
    assert (tmp_path / "s.wdp").stat().st_size == 60 + meta["packets"] * 240


def test_help_lists_every_scene():
    text = run("--help").output
    for name in SCENES:
        assert f"{name}:" in text
