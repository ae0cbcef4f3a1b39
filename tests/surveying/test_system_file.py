"""Files of surveys: written, read to the last bit, compared with strips; those of earlier versions."""

import json
import math
import re
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from commands import refuses, run_command, succeed
from commands import run_command as run
from helpers_scenes import make_block, make_scene
from hypothesis import given
from hypothesis import strategies as st
from stranger_strips import make_strip
from writer_tools import data_file

from wavebatch.batch.counts import RunReport
from wavebatch.batch.report_file import _sum_up as sum_up
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Defects, LevelWidths, Radiometry, ReceiverNoise, SystemPulse
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.text_file import write_text
from wavebatch.files.toml_file import list_entries, list_keys
from wavebatch.stages.chain import effective, load_chain_file
from wavebatch.surveying import Decision, Survey, survey_block
from wavebatch.surveying.calibrating.calibration_files import format_calibration, load_calibration
from wavebatch.surveying.inspect_strip import survey
from wavebatch.surveying.look import find_contradiction
from wavebatch.surveying.systems.figures import Figures, Kind, Level, Look, describe_system
from wavebatch.surveying.systems.known_systems import known_systems
from wavebatch.surveying.systems.survey_result import (
    SYSTEM_SCHEMA,
    SavedSurvey,
    format_survey,
    load_survey,
    parse_survey,
)
from wavebatch.tools.simulate import find_pulse, simulate_strip

SYSTEM = SystemPulse(
    sigma_ref=1.8581162121217176,
    noise=ReceiverNoise(
        baseline=3.6834210432062053,
        baseline_spread=0.1 + 0.2,
        std=1.2997285311240736,
        by_kind={"quiet": 1 / 3, "tail smoothed": 2e-7, "core": 1e22},
        gain=5e-324,
        correlation=(0.63, 1 / 7, -0.1),
        whitening=(0.58, 1 / 23),
        recovery=42.0,
    ),
    kappa=-0.1,
    components=((1.0, 0.0, 1.8836713464397783), (-0.03361226544360852, 10.587040699291984, 1.5927024379059929)),
    ringing=0.04428410627806453,
    saturation=255.0,
    acceptance=18.0,
    defects=Defects(pattern=(0.1, -0.1 / 3), slope_spread=1 / 7, spikes=0.08, transient=2.0),
    tail_misfit=((-9.3, 0.0021), (5.574348636365153, 0.1 + 0.2)),
    beside=((-9.3, 0.25), (5.574348636365153, 0.1 + 0.7)),
    misfit=0.1 / 3,
    hidden=((0.035, 1 / 7, 0.0), (0.07, 0.1 + 0.2, 1e-9)),
    hidden_light=((0.035, 2 / 7, 0.0), (0.07, 0.1 + 0.3, 1e-9)),
    hidden_width=((0.035, 3 / 7, 0.0), (0.07, 0.1 + 0.4, 1e-9)),
)
SURVEY = Survey(
    SYSTEM,
    2311,
    Figures(empty_share=0.1, kappa=np.float64(0.05534052830222781), misfit_gaussians={1: 1e-17}),
    (Decision("growth of fits", True, 'says "11 %",\nin two lines \\ with a \x7f'), Decision("ä", False, "")),
)
FINGERPRINT = {"size": 12345678901, "sha256_sampled": "ab" * 32, "packets": {"size": 7, "sha256_sampled": "cd" * 32}}
SAVED = SavedSurvey(SURVEY, 'a "strip".las', FINGERPRINT, "1.2.3")
TEXT = format_survey(SAVED)


def _same(a: SavedSurvey, b: SavedSurvey) -> bool:
    """Equal in every field, floats by their bits."""
    return repr(describe_system(a.survey.system)) == repr(describe_system(b.survey.system)) and a == b


def test_everything_comes_back():
    assert _same(parse_survey(TEXT, "x"), SAVED)
    assert format_survey(parse_survey(TEXT, "x")) == TEXT


positive = st.floats(1e-3, 1e4)


@given(
    width=positive,
    numbers=st.lists(st.floats(-1e9, 1e9), min_size=2, max_size=2),
    gain=st.floats(0, 1e6),
    rows=st.lists(st.tuples(st.floats(0.01, 10), st.floats(-1e4, 1e4), positive), min_size=2, max_size=5),
    reason=st.text(st.characters(exclude_categories=["Cs"])),
    saturation=st.none() | st.floats(1, 1e10),
    correlation=st.lists(st.floats(-1, 1), max_size=4),
    tail=st.lists(st.tuples(st.floats(-1e5, 1e5), st.floats(0, 10)), max_size=4),
)
def test_any_system_comes_back_to_the_last_bit(width, numbers, gain, rows, reason, saturation, correlation, tail):
    system = SystemPulse(
        sigma_ref=width,
        noise=ReceiverNoise(baseline=numbers[0], gain=gain, correlation=tuple(correlation)),
        components=tuple(rows),
        saturation=saturation,
        tail_misfit=tuple(tail),
    )
    survey = Survey(system, 1, Figures(least_count=numbers[1]), (Decision("part", False, reason),))
    assert _same(parse_survey(format_survey(SavedSurvey(survey)), "x"), SavedSurvey(survey))


def test_a_real_survey_comes_back():
    survey = survey_block(make_block("urban", 2000, seed=1)[0])
    again = parse_survey(format_survey(SavedSurvey(survey)), "x").survey
    assert again == survey and describe_system(again.system) == describe_system(survey.system)


def test_figures_that_are_no_numbers_are_left_out():
    text = format_survey(SavedSurvey(Survey(SYSTEM, 0, Figures(bits=1.0, kappa=math.nan), ())))
    assert parse_survey(text, "x").survey.figures == Figures(bits=1.0)


def test_figures_of_other_versions_are_left_out_and_a_flight_is_whole_or_none():
    others = "new_figure = 3.0\nflight_width = 2.0\nflight_descriptor_1_bits = 8.0\n"
    text = TEXT.replace("[figures]\n", f"[figures]\n{others}")
    assert parse_survey(text, "x").survey.figures == SURVEY.figures
    look = Look(Level(7, 12.0, 0.5, 1.0, 99, None), 2.0, 0.9, 0.01)
    figures = replace(SURVEY.figures, look=look, kinds={3: Kind(8.0, 1.0, 0.5, -1.0), 12: Kind(16.0, 2.0, 1.0, 0.0)})
    assert parse_survey(format_survey(SavedSurvey(Survey(SYSTEM, 5, figures))), "x").survey.figures == figures


def test_every_number_of_the_system_has_a_key():
    keys = {entry.field for entry in list_entries(SystemPulse) if entry.shape != "record"} | {"digitizers"}
    # Of a calibration and of the sensor's position, which come with files of their own.
    elsewhere = {"constant", "constant_error", "channels", "attenuation", "sensor_error", "shot_error"}
    elsewhere |= {"attenuation_error", "swath", "right", "returns", "phase"}
    parts = {"noise": ReceiverNoise, "defects": Defects, "widths": LevelWidths, "radiometry": Radiometry}
    keys |= {f"{name}.{entry.field}" for name, part in parts.items() for entry in list_entries(part)}
    fields = set(SystemPulse.__dataclass_fields__) - set(parts)
    fields |= {f"{name}.{field}" for name, part in parts.items() for field in part.__dataclass_fields__}
    # Set by a chain while it runs.
    assert keys | {f"radiometry.{name}" for name in elsewhere} | {"other_pulse"} == fields


def test_figures_decisions_and_fingerprint_may_be_missing():
    start = TEXT.index("[system]")
    text = f'schema = "{SYSTEM_SCHEMA}"\n' + TEXT[start : TEXT.index("[figures]")]
    saved = parse_survey(text, "x")
    assert saved.survey.system == SYSTEM
    assert saved.survey.figures == Figures() and saved.survey.decisions == () and not saved.fingerprint


@pytest.mark.parametrize(
    "key", [key for key, one in list_keys(SystemPulse).items() if one.needed and one.shape == "value"]
)
def test_a_missing_quantity_is_named(key):
    text = re.sub(rf"^{key} = .*\n", "", TEXT, flags=re.M)
    refuses(ConfigError, rf"x\.toml: \[system\]: key '{key}' is missing", parse_survey, text, "x.toml")


def test_without_saturation_nothing_clips():
    assert parse_survey(re.sub(r"^saturation_dn.*\n", "", TEXT, flags=re.M), "x").survey.system.saturation is None


def test_files_of_earlier_versions_are_read():
    """They have no correlation, no tail, no misfit and nothing of what is left beside echoes."""
    later = "correlation|whitening|tail_misfit|beside|misfit|hidden(_light|_width)?"
    text = re.sub(rf"^({later}) = .*\n", "", TEXT, flags=re.M)
    assert text.count("\n") == TEXT.count("\n") - 8
    system = parse_survey(text, "x").survey.system
    noise = replace(SYSTEM.noise, correlation=(), whitening=())
    without = replace(SYSTEM, noise=noise, tail_misfit=(), beside=(), misfit=0.0)
    assert system == replace(without, hidden=(), hidden_light=(), hidden_width=())


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sigma_ref_ns =", "sigma_ref =", "did you mean 'sigma_ref_ns'"),
        ("acceptance = 18.0", "acceptance = true", "acceptance must be a number, it is True"),
        ("acceptance = 18.0", 'acceptance = "18"', "acceptance must be a number, it is '18'"),
        ("acceptance = 18.0", "acceptance = nan", "acceptance must be a finite number"),
        ("acceptance = 18.0", "acceptance = 1" + "0" * 400, "acceptance must be a finite number"),
        ("noise_std_dn = 1.2997285311240736", "noise_std_dn = 0.0", "noise_std_dn must lie between 0.001"),
        ("sigma_ref_ns = 1.8581162121217176", "sigma_ref_ns = -1.8", "sigma_ref_ns must lie between"),
        ("sigma_ref_ns = 1.8581162121217176", "sigma_ref_ns = 1e300", "sigma_ref_ns must lie between"),
        ("ringing = 0.04428410627806453", "ringing = 7", "ringing must lie between 0 and 1"),
        ("components = [[1.0, ", "components = [[-1.0, ", "row 1 is the main Gaussian"),
        ("1.8836713464397783]", "0.0]", "components row 1 must lie between 0.001"),
        ("1.8836713464397783]", "1.0, 2.0]", r"must be a list of \[weight, delay, sigma\]"),
        ("components = [", "components = 3 # [", "must be a list of"),
        (", [-0.03361226544360852, 10.587040699291984, 1.5927024379059929]", "", "must be empty or hold 2 to"),
        ("correlation = [", "correlation = [2, ", "correlation row 1 must lie between -1 and 1"),
        ("correlation = [", "correlation = [[0.5], ", "correlation row 1 must be a number"),
        ("correlation = [", "correlation = 1 # [", "correlation must be a list of numbers"),
        ("whitening = [", "whitening = [0.1, ", "whitening must be empty or hold two shares a, b of steady noise"),
        ("whitening = [", "whitening = [1.2, 0.1] # [", "hold two shares a, b of steady noise"),
        ("correlation = [", "correlation = [" + 2000 * "0, ", "at most 1024 are read"),
        ("tail_misfit = [", "tail_misfit = [1.0, ", r"tail_misfit must be a list of \[lag, share\]"),
        ("tail_misfit = [[-9.3, 0.0021]", "tail_misfit = [[-9.3, -1]", "tail_misfit row 1 must lie between 0 and 10"),
        ("quiet = ", "quiet = '1' # ", r"\[noise_by_kind_dn\]: quiet must be a number"),
        ("quiet = ", "quiet = -1 # ", r"\[noise_by_kind_dn\]: quiet must lie between"),
        ("empty_share = 0.1", "empty_share = inf", r"\[figures\]: empty_share must be a finite number"),
        ("needed = true", "needed = 1", r"\[\[decision\]\] 1: needed must be true or false, it is 1"),
        ("needed = true", "neded = true", "did you mean 'needed'"),
        ("[[decision]]", "[[decisions]]", "did you mean 'decision'"),
        ("waveforms = 2311", "waveforms = 1.5", "waveforms must be an integer"),
        ("waveforms = 2311", "waveforms = -5", "waveforms must lie between 0 and"),
        ("system/1", "system/2", "this version reads 'wavebatch.system/1'"),
        ("schema = ", "# schema = ", "key 'schema' is missing"),
        ("[figures]", "[figures", "not valid TOML"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(old, new, words):
    assert old in TEXT
    with pytest.raises(ConfigError, match=words) as caught:
        parse_survey(TEXT.replace(old, new), "x.toml")
    assert str(caught.value).startswith("x.toml: ") and "\n" not in str(caught.value)


def test_files(tmp_path):
    path = tmp_path / "SYSTEM.toml"
    write_text(path, format_survey(SAVED), overwrite=False)
    assert _same(load_survey(path), SAVED)
    write_text(path, format_survey(SavedSurvey(SURVEY)), overwrite=True)
    assert load_survey(path).strip == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["SYSTEM.toml"]
    path.write_bytes(b"\xff\xfe")
    refuses(ConfigError, "not UTF-8", load_survey, path)


def test_files_from_before_the_skew_stay_readable():
    old = "\n".join(line for line in TEXT.splitlines() if not line.startswith(("skew =", "skew_spread =")))
    system = parse_survey(old, "x").survey.system
    assert system.skew is None and system.skew_spread == 0.0
    known = replace(SYSTEM, skew=0.2345678901234567, skew_spread=0.05)
    again = parse_survey(format_survey(SavedSurvey(Survey(known, 1))), "x").survey.system
    assert (again.skew, again.skew_spread) == (known.skew, known.skew_spread)


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("overlapped_share = 1.5", "overlapped_share must"),
        ("flight_level_waveforms = -1e14", "flight_level_waveforms must"),
        ("flight_level_std = -1.0", "flight_level_std must"),
        ("echoes_per_waveform = 1e308", "echoes_per_waveform must"),
        ("flight_descriptor_1_gain = -1e308", "flight_descriptor_1_gain must"),
    ],
)
def test_figures_that_no_survey_finds_are_refused(line, wrong):
    """They would overflow or be roots of negative numbers far from the file."""
    text = TEXT.replace("[figures]\n", f"[figures]\n{line}\n")
    with pytest.raises(ConfigError, match=wrong) as caught:
        parse_survey(text, "s.toml")
    assert "\n" not in str(caught.value)


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
    shown = survey(folder / "flat.las", for_checks=False, find_divergence=True)
    assert shown.figures.look is None and not shown.figures.kinds
    saved = load_survey(folder / "SYSTEM.toml").survey
    assert saved.figures.look is not None and shown.system.sigma_ref == pytest.approx(saved.system.sigma_ref)
    assert saved.system.beside and not shown.system.beside, "errors of echoes that nobody measures"
    assert shown.figures == replace(saved.figures, look=None, kinds={}), "what is printed is what would be saved"
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


@pytest.mark.parametrize(("factor", "doubted"), [(10.0, True), (0.1, True), (2.0, False)])
def test_noise_that_was_edited_is_doubted(folder, factor, doubted):
    """Noise 10 times too high: 42 % of the echoes were lost without a line. Shipped surveys have up to 2.2 times."""
    saved = load_survey(folder / "SYSTEM.toml").survey
    noise = replace(saved.system.noise, std=factor * saved.system.noise.std)
    with StripReader(folder / "flat.las") as reader, reader.scan() as scan:
        found = find_contradiction(reader, scan, replace(saved, system=replace(saved.system, noise=noise)))
    assert ("its noise is" in found[0]) == doubted and not found[1]


def test_coloured_noise_is_that_of_its_own_survey(tmp_path):
    """A pulse sees 3.4 times what its samples scatter by: three of 300 simulated strips contradicted their survey."""
    path = make_strip(6736, tmp_path)
    with StripReader(path) as reader, reader.scan() as scan:
        assert find_contradiction(reader, scan, survey(path)) == ("", False)


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


FOLDER = Path(__file__).parent / "written_files"
"""Written by commit 53e1b4c0 from simulated strips (stiff, village, a flight of three), and two with every key."""

READ = json.loads((FOLDER / "read.json").read_text())
"""What that commit read from them: fields by name, floats to the last bit. Of the chain: with defaults of today."""


def plain(value):
    """Plain values for JSON, which keeps every float; keys of mappings as text."""
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return list(map(plain, value))
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def read_written(path):
    """What the readers of wavebatch make of a file, as plain values."""
    if path.name.endswith(".report.json"):
        return plain(RunReport.from_json(json.loads(path.read_text())))
    if path.name.endswith(".system.toml"):
        return plain(load_survey(path))
    if path.name.endswith(".calibration.toml"):
        found = load_calibration(path)
        return {"read": plain(found), "described": plain(found.describe())}
    return effective(load_chain_file(path))


def check_within(expected, found):
    """All that was read then is read now; fields that are new since then are not asked for."""
    if isinstance(expected, dict):
        assert expected.keys() <= found.keys()
        for key, value in expected.items():
            check_within(value, found[key])
    else:
        assert found == expected


@pytest.mark.parametrize("name", READ)
def test_a_written_file_is_read_to_the_last_bit(name):
    check_within(READ[name], json.loads(json.dumps(read_written(FOLDER / name))))


@pytest.mark.parametrize("name", [name for name in READ if name.endswith(".system.toml")])
def test_a_system_file_is_written_again_line_for_line(name):
    again = iter(format_survey(load_survey(FOLDER / name)).splitlines())
    assert all(line in again for line in (FOLDER / name).read_text().splitlines())


@pytest.mark.parametrize("name", [name for name in READ if name.endswith(".calibration.toml")])
def test_a_calibration_is_written_again_but_for_what_only_documents_it(name):
    again = iter(format_calibration(load_calibration(FOLDER / name)).splitlines())
    assert all(line in again for line in (FOLDER / name).read_text().partition("\n[[target]]")[0].splitlines())


def test_the_counts_of_a_report_are_written_again():
    document = json.loads((FOLDER / "stiff.report.json").read_text())
    again = RunReport.from_json(document).to_json()
    check_within({name: document[name] for name in again}, again)
    assert sum_up(document) == document["checksum"]
