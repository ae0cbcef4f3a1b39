"""`wavebatch voxelize` as a user types it: what it writes and prints, and how it refuses."""

import json

import numpy as np
import pytest
from commands import run_command, succeed

from wavebatch.surveying.calibrating.calibration_files import format_calibration
from wavebatch.surveying.calibration import Calibration
from wavebatch.tools.simulate import simulate_strip


def voxelize(*arguments):
    return run_command("voxelize", *arguments)


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """600 pulses over streets and houses."""
    path = tmp_path_factory.mktemp("voxelize") / "urban.las"
    simulate_strip("urban", path, pulses=600, seed=5)
    return path


def test_counts_go_to_stdout_and_talk_to_stderr(strip, tmp_path):
    result = succeed("voxelize", strip, "--size", 1, "-o", tmp_path / "v.npz", "--json")
    counts = json.loads(result.stdout)
    with np.load(tmp_path / "v.npz") as file:
        assert counts["voxels"] == len(file["index"]) > 300
        assert counts["origin"] == file["origin"].tolist() and file["size"] == counts["size"] == 1.0
        assert json.loads(str(file["meta"]))["strip"] == "urban.las"
    assert counts["method"] == "richardson_lucy" and 4.4 < counts["pulse_fwhm"] < 5.2
    assert f"{counts['voxels']} voxels of 1 m" in result.stderr
    quiet = voxelize(strip, "--size", 1, "-o", tmp_path / "w.npz", "-q")
    assert quiet.exit_code == 0 and quiet.output == ""
    assert (tmp_path / "w.npz").read_bytes() == (tmp_path / "v.npz").read_bytes()


def test_a_saved_survey_gives_the_same_voxels(strip, tmp_path):
    system = tmp_path / "SYSTEM.toml"
    assert run_command("survey", strip, "-o", system).exit_code == 0
    for name, more in (("a.npz", ()), ("b.npz", ("--system", system))):
        assert voxelize(strip, "--size", 0.5, "-o", tmp_path / name, *more).exit_code == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_every_method_and_option_changes_the_result(strip, tmp_path):
    variants = [
        (), ("--iterations", 5), ("--method", "gold"), ("--method", "wiener"), ("--method", "wiener", "--snr", 5),
        ("--threshold", 12), ("--all-crossed",), ("--all-crossed", "--headroom", 30),
    ]  # fmt: skip
    made = set()
    for number, variant in enumerate(variants):
        succeed("voxelize", strip, "--size", 1, "-o", tmp_path / f"{number}.npz", *variant)
        with np.load(tmp_path / f"{number}.npz") as file:
            made.add(b"".join(file[name].tobytes() for name in ("index", "energy", "rays")))
    assert len(made) == len(variants)


def test_calibrated_strips_have_cross_sections(strip, tmp_path):
    path = tmp_path / "CAL.toml"
    path.write_text(format_calibration(Calibration(2.5e-8, 0.03, 0.22, divergence=0.5)))
    result = succeed("voxelize", strip, "--size", 2, "-o", tmp_path / "v.npz", "--calibration", path, "--json")
    assert json.loads(result.stdout)["sensor"] == "direction vectors"
    with np.load(tmp_path / "v.npz") as file:
        assert (file["cross_section"] > 0).all()


def test_help_says_what_a_voxel_holds():
    text = voxelize("--help").output
    for word in ("energy", "cross_section", "rays", "path", "light", "share", "--all-crossed", "--headroom", "DN ns"):
        assert word in text
