"""A saved survey of another sensor is refused by every command with --system; one of the same sensor never is."""

import json
import re
from dataclasses import replace

import pytest
from commands import run_command, succeed
from commands import run_command as run
from helpers_scenes import make_scene
from writer_tools import data_file

from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import survey
from wavebatch.surveying.look import find_contradiction
from wavebatch.surveying.systems.figures import Figures
from wavebatch.surveying.systems.known_systems import known_systems
from wavebatch.surveying.systems.survey_result import load_survey
from wavebatch.tools.simulate import find_pulse, simulate_strip

SCENES = {
    "flat": make_scene("flat"),
    "forest": make_scene("forest"),
    "slope": make_scene("slope"),
    "noisy": make_scene("flat", noise_std=2.5),
    "bits": make_scene("flat", bits=16),
    "wide": make_scene("flat", pulse=find_pulse("leica"), n_samples=100),
    "narrow": make_scene("flat", pulse=replace(find_pulse("gaussian"), sigma=1.2)),
}
CONTRADICTED = {
    "noisy": "its noise is",
    "bits": "samples have 16 bits",
    "wide": "slopes widen echoes",
    "narrow": "ns wide",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Strips by scene, and the saved survey of the flat one."""
    folder = tmp_path_factory.mktemp("saved")
    for name, scene in SCENES.items():
        simulate_strip(scene, folder / f"{name}.las", pulses=1500, seed=5)
    succeed("survey", folder / "flat.las", "-o", folder / "SYSTEM.toml")
    return folder


def test_a_survey_that_is_only_shown_looks_for_no_other_strips(folder):
    shown = survey(folder / "flat.las", for_checks=False)
    assert shown.figures.look is None and not shown.figures.kinds
    saved = load_survey(folder / "SYSTEM.toml").survey
    assert saved.figures.look is not None and shown.system.sigma_ref == pytest.approx(saved.system.sigma_ref)
    result = run_command("survey", folder / "flat.las", "--json")
    assert "flight_width" in json.loads(result.stdout)["figures"], "all figures, although no file is written"


def contradiction(strip, saved):
    with StripReader(strip) as reader, reader.scan() as scan:
        reason, sure = find_contradiction(reader, scan, saved)
        assert sure == bool(reason)
        return reason


@pytest.mark.parametrize("plain", [False, True], ids=["with figures", "hand-written"])
@pytest.mark.parametrize("name", SCENES)
def test_another_sensor_contradicts_and_another_scene_does_not(folder, name, plain):
    saved = load_survey(folder / "SYSTEM.toml").survey
    if plain:
        saved = replace(saved, figures=Figures(bits=saved.figures.bits, spacing_ns=saved.figures.spacing_ns))
    found = contradiction(folder / f"{name}.las", saved)
    if plain and name == "noisy":
        return  # less than three times the noise: such files do not give that of quiet samples
    assert (found != "") == (name in CONTRADICTED), found
    assert CONTRADICTED.get(name, "") in found


@pytest.mark.slow
def test_shipped_and_saved_surveys_of_real_strips_fit_their_own_strip_and_no_other():
    paths = {
        "riegl-q680i": data_file("riegl-q680i/100429_152240_2535pt_UTM.las"),
        "leica-als": data_file("leica-als/simple1_3_full_internal.las"),
        "geolas-q560": data_file("geolas/geolas1.las"),
        "nasa-lvis": data_file("lvis/lvis1.las"),
        "neon-gemini": data_file("neon/neon_harv_a.las"),
    }
    for known in known_systems():
        own = survey(paths[known.name])
        noise = replace(known.system.noise, std=own.system.noise.std)  # some have the pulse only
        plain = replace(own, system=replace(known.system, noise=noise))
        plain = replace(plain, figures=Figures(bits=own.figures.bits, spacing_ns=own.figures.spacing_ns))
        for name, path in paths.items():
            assert (contradiction(path, own) == "") == (name == known.name), (name, known.name)
            # Without figures of a look the limits are wide, and a canopy's echoes may be of any narrower pulse.
            hidden_by_canopy = (known.name, name) == ("riegl-q680i", "neon-gemini")
            assert (contradiction(path, plain) == "") == (name == known.name or hidden_by_canopy), (name, known.name)
        assert contradiction(paths[known.name], replace(plain, figures=Figures())) == ""


@pytest.mark.parametrize(
    "command",
    [
        ["run", "-o", "out"],
        ["voxelize", "--size", "5", "-o", "out.npz"],
        ["compare", "fast", "--strip"],
        ["plot", "waveform", "--packet", "3", "-o", "out.png"],
    ],
    ids=lambda command: command[0],
)
def test_every_command_refuses_and_obeys_force(folder, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    arguments = [*command, folder / "noisy.las", "--system", folder / "SYSTEM.toml"]
    result = run(*arguments)
    assert result.exit_code == {"run": 4, "compare": 2}.get(command[0], 1), result.output
    assert "noisy.las: the survey given by --system is not of this sensor: its noise is" in result.stderr
    assert "--force" in result.stderr and len(result.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.glob("*.[nlp][ap][zsn]")) and not list(tmp_path.glob("out/*.laz"))
    assert run(*arguments, "--force").exit_code == 0


def test_a_forced_survey_is_a_warning_and_in_the_report(folder, tmp_path):
    result = succeed("run", folder / "noisy.las", "-o", tmp_path, "-q", "--system", folder / "SYSTEM.toml", "--force")
    assert "warning: --force: the survey given by --system is not of this sensor: its noise is" in result.stderr
    assert "--force: the survey" in (tmp_path / "noisy.report.json").read_text()


def test_a_pulse_in_picoseconds_is_refused_though_it_finds_no_echo_to_compare(folder, tmp_path):
    text = re.sub(r"(?m)^sigma_ref_ns = \S+", "sigma_ref_ns = 2000.0", (folder / "SYSTEM.toml").read_text())
    (tmp_path / "ps.toml").write_text(text)
    result = run("run", folder / "flat.las", "-o", tmp_path / "out", "--system", tmp_path / "ps.toml")
    assert result.exit_code == 4 and "cannot show the pulse of --system, 2000 ns" in result.stderr, result.stderr


@pytest.mark.parametrize("picoseconds", [2, 200_000], ids=["waveform within the pulse", "pulse on one sample"])
def test_force_uses_no_pulse_that_the_samples_cannot_show(folder, tmp_path, picoseconds):
    """A damaged descriptor: tables of the pulse would take gigabytes, or its derivatives be 0."""
    data = bytearray((folder / "flat.las").read_bytes())
    at = data.index((80).to_bytes(4, "little") + (1000).to_bytes(4, "little")) + 4
    data[at : at + 4] = picoseconds.to_bytes(4, "little")
    (tmp_path / "bad.las").write_bytes(data)
    saved = folder / "SYSTEM.toml"
    result = run("run", tmp_path / "bad.las", "-o", tmp_path / "out", "--profile", "fast", "--system", saved, "--force")
    assert result.exit_code == 4 and "cannot show the pulse of --system, 2" in result.stderr, result.stderr
    assert not list(tmp_path.glob("out/*.la?"))
