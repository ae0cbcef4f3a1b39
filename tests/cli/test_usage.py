"""Wrong usage of any command is one line on stderr that says where help is, and exit code 2.

Plausible mistakes of a first hour: the line says what to do next, not only what is wrong.
"""

import json
import os
import shutil
import struct
import subprocess
import sys

import pytest
from commands import run_command
from strips import cut_strip

from wavebatch.cli import COMMANDS, main
from wavebatch.files.inputs import find_files


def invoke(*arguments):
    return run_command(*arguments, prog_name="wavebatch")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--nope"], "no such option '--nope'; see `wavebatch --help`"),
        (["rnu"], "no command 'rnu'; did you mean 'run'? see `wavebatch --help`"),
        (["plot", "mpa"], "no command 'mpa'; did you mean 'map'? see `wavebatch plot --help`"),
        (["run", "a.las"], "missing option '-o' / '--output'; see `wavebatch run --help`"),
        (["run", "a.las", "-o", "d", "--crs"], "option '--crs' requires an argument"),
        (["bench", "--seed", "-1"], "invalid value for '--seed': -1 is not in the range x>=0; see `wavebatch bench"),
        (
            ["simulate", "flat", "-o", "a.las", "--seed", "-1"],
            "invalid value for '--seed': -1 is not in the range x>=0",
        ),
        (["synthesize", "a.las", "-o", "b.las", "--seed", "-1"], "invalid value for '--seed': -1 is not in the range"),
        (["simulate", "flat", "-o", "a.las", "--sensor", "discrete", "--external"], "--external is about packets"),
        (["compare", "a.las", "b.las", "--min-exact", "95"], "invalid value for '--min-exact': 95.0 is not in"),
        (["compare", "--strip", "a.las", "fats"], "fats: is neither a file nor a shipped chain; did you mean 'fast'?"),
        (["run", "a.las", "-o", "d", "--columns", ""], "--columns: names no column; leave it out for the usual ones"),
        (["slice", "a.las", "--lines", "3:1"], "invalid value for '--lines': '3:1' is empty; END is the number"),
        (["slice", "a.las"], "give -o for the segments, --png or --overview for a picture, or --cube; see `wavebatch "
         "slice --help`"),
        (["slice", "a.las", "-o", "l.csv", "--geojson-crs", "keep"], "--geojson-crs keep is of no use without -o FILE"),
        (["run", "a.las", "-o", "d", "--overwrite", "--resume"], "--overwrite and --resume exclude each other"),
        (["plot", "waveform", "a.las", "-o", "w.png", "--chain", "c", "--profile", "fast"],
         "--chain and --profile exclude each other"),
        *((["plot", "waveform", "a.las", "-o", "w.csv", *words], f"{words[0]} is for pictures")
          for words in (["--sheet"], ["--show", "detector"], ["--times", "all"])),
        (["calibrate", "a.las", "--targets", "t", "-o", "c", "--chain", "c", "--profile", "auto"],
         "--chain and --profile exclude each other"),
        (["voxelize", "a.las", "--size", "1", "-o", "v.npz", "--trajectory", "t", "--flight-height", "9"],
         "--trajectory and --flight-height"),
        (["run", "a.las", "-o", "d", "--attenuation", "0", "--visibility", "9"], "--attenuation and --visibility excl"),
    ],
)
def test_wrong_usage_is_one_line(arguments, line):
    result = invoke(*arguments)
    assert result.exit_code == 2 and result.stdout == ""
    assert result.stderr.startswith(f"error: {line}") and result.stderr.count("\n") == 1


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_says_what_its_exit_codes_are(name):
    result = invoke(name, "--help")
    assert result.exit_code == 0 and result.stderr == ""
    words = " ".join(result.stdout.split())
    assert name == "plot" or name == "stages" or "Exit code" in words


def test_commands_over_many_files_take_what_run_takes(tiny_strip, tmp_path):
    folder = tmp_path / "many strips"
    folder.mkdir()
    for name in ("a.las", "b.las"):
        (folder / name).write_bytes(tiny_strip.read_bytes())
    (tmp_path / "list.txt").write_text("many strips/*.las\n")
    for words in ([folder], [folder / "*.las"], [f"@{tmp_path / 'list.txt'}"], [folder / "a.las", folder]):
        checked = invoke("check", *map(str, words))
        assert checked.exit_code == 0 and checked.stdout.count(": ok (") == 2
        counted = invoke("stats", *map(str, words), "--json")
        assert counted.exit_code == 0 and len(json.loads(counted.stdout)["files"]) == 2
    (tmp_path / "empty").mkdir()
    for command in ("check", "stats"):
        told = invoke(command, str(tmp_path / "empty"))
        assert told.exit_code == 2 and told.stderr.endswith("empty: the folder holds no .las or .laz file\n")


def test_options_that_commands_share_have_one_name():
    short = {"-o": "--output", "-q": "--quiet", "-v": "--verbose", "-c": "--chain", "-h": "--help"}
    for name in COMMANDS:
        command = main.get_command(None, name)
        parts = [command, *getattr(command, "commands", {}).values()]
        options = [option for part in parts for option in part.params if option.param_type_name == "option"]
        for option in options:
            for flag in set(option.opts) & set(short):
                assert short[flag] in option.opts, f"{name}: {option.opts}"
            assert all(opt.startswith("--") or opt in short for opt in option.opts), f"{name}: {option.opts}"


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e999"])
def test_numbers_of_options_must_be_finite(value):
    """NaN passes every limit: it is neither below nor above."""
    for words in (["run", "a.las", "-o", "x", "--attenuation"], ["plot", "section", "a.las", "-o", "x", "--aspect"],
                  ["stats", "a.las", "--area"], ["simulate", "flat", "-o", "x", "--noise"]):  # fmt: skip
        done = run_command(*words, value)
        assert done.exit_code == 2 and "is not" in done.stderr and done.stderr.count("\n") == 1, done.stderr


@pytest.fixture
def place(tmp_path, tiny_strip, monkeypatch):
    """A folder to work in, with a strip."""
    shutil.copy(tiny_strip, tmp_path / "strip.las")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _say(*words, code=None):
    """The only line on stderr."""
    result = run_command(*words)
    assert result.exit_code == code if code is not None else result.exit_code in (1, 2, 3, 4), result.output
    (line,) = result.stderr.splitlines()
    return line


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        ("run strip.las -o o --chain fast", "there is no such file; the shipped chain is --profile fast"),
        ("run strip.las -o o --chain auto", "the shipped chain is --profile auto"),
        ("run strip.las -o o --memory 10", "10 bytes is too little, one job needs 350 MB; write for example 500M"),
        ("run strip.las -o o --jobs 0.5", "'0.5' is no whole number"),
        ("run strip.las -o o --flight-height high", "'high' is no number"),
        ("run strip.las -o strip.las", "'strip.las' is a file, not a folder"),
        ("survey strip.las -o system.json", "written as TOML; name it system.toml; --json prints the figures"),
        ("calibrate strip.las --targets t.csv -o cal.csv", "written as TOML; name it cal.toml"),
        ("stats strip.las --where echo_width<5", "`wavebatch run` writes echo_width into clouds, and this is none"),
        ("plot map strip.las --column echowidth -o m.png", "`wavebatch run` writes echo_width into clouds"),
        ("stages decomposer", "did you mean"),
        ("run strip.las -o o --jobs 100000", "100000 is not in the range 0<=x<=1024"),
        ("plot waveform strip.las -o w.png --seed 3", "--seed is of no use without --random"),
        ("plot waveform strip.las -o w.png --packet 3 --most 2", "--most is for --flags, --where and the default"),
        ("plot waveform strip.las -o w.png --times 5000:6000", "no sample lies there; the waveforms end at"),
        ("calibrate strip.las --targets t.csv -o c.toml --attenuation .1 --wavelength 532", "exclude each other"),
        ("compare strip.las strip.las --within 1e9", "tolerance 1e+09 ns (--within): must be above 0 and below 1e6"),
    ],
)
def test_options_that_are_nearly_right(place, words, advice):
    assert advice in _say(*words.split())


def test_a_column_that_the_run_left_out_names_the_option_that_adds_it(place):
    assert run_command("run", "strip.las", "-o", "o", "--profile", "fast", "-q").exit_code == 0
    line = _say("grid", next((place / "o").glob("strip.la?")), "--column", "cross_section", "-o", "x.tif")
    assert "writes cross_section into clouds: add --columns +cross_section" in line or "rasterio" in line


def test_files_of_other_kinds_say_what_to_give(place):
    (place / "list.txt").write_text("strip.las\n")
    assert "if it is a list of files, write @list.txt" in _say("info", "list.txt")
    (place / "strip.wdp").write_bytes(b"\0" * 100)
    assert "it has the packets of strip.las: give that file" in _say("info", "strip.wdp")
    (place / "strip.pls").write_bytes(b"PulseWavesPulse\0" + b"\0" * 300)
    line = _say("run", "strip.pls", "-o", "o")
    assert "it is PulseWaves: `wavebatch import strip.pls` makes a strip of it, or give strip.las" in line
    (place / "strip.pls").rename(place / "strip.plz")
    line = _say("info", "strip.plz")
    assert "`pulsezip -i strip.plz -o strip.pls`" in line and "then `wavebatch import strip.pls`" in line
    (place / "empty.las").touch()
    assert "it is empty" in _say("info", "empty.las")


def test_simulate_and_bench_have_the_same_scenes(place):
    for words in (("simulate", "opne", "-o", "s.las"), ("bench", "--scene", "opne")):
        assert "did you mean 'open'?" in _say(*words)
    done = run_command("simulate", "open", "-o", "open.las", "--pulses", "50")
    assert done.exit_code == 0, done.output


def test_an_unknown_stage_lists_those_of_its_kind(place):
    for stage, words in (
        ("detect.qqqqqqqqqqqqqqqq", "known are detect."),
        ("xyz", "names begin with noise., detect., decompose., attribute.; `wavebatch stages` lists them"),
    ):
        (place / "c.toml").write_text(f'[[chain]]\nstage = "{stage}"\n')
        line = _say("run", "strip.las", "-o", "o", "-c", "c.toml")
        assert words in line and "attribute.position" not in line


def test_the_home_folder_is_found_in_lists_and_quotes(place, monkeypatch):
    monkeypatch.setenv("HOME", str(place))
    monkeypatch.setenv("USERPROFILE", str(place))
    (place / "sub").mkdir()
    (place / "sub" / "list.txt").write_text("~/strip.las\n")
    assert find_files(["@sub/list.txt"]) == find_files(["~/strip.las"]) == [place / "strip.las"]
    (place / "~odd.las").touch()  # a file of such a name stays a file
    assert [path.name for path in find_files(["~odd.las"])] == ["~odd.las"]


def test_stages_lists_those_of_a_kind():
    result = run_command("stages", "decompose")
    names = [line.split()[0] for line in result.stdout.splitlines()]
    assert result.exit_code == 0 and "decompose.residual_loop" in names
    assert all(name.startswith("decompose.") for name in names)


def test_clouds_without_an_echo_in_common_are_doubted(place):
    content = bytearray((place / "strip.las").read_bytes())
    struct.pack_into("<d", content, 155, struct.unpack_from("<d", content, 155)[0] + 1e5)  # x of all points
    (place / "moved.las").write_bytes(content)
    result = run_command("compare", "strip.las", "moved.las")
    assert result.exit_code == 0 and "warning: A and B have no echo in common" in result.stderr
    result = run_command("compare", "strip.las", "strip.las")
    assert "in common" not in result.stderr


def test_strips_that_share_their_times_only_are_doubted(place):
    """Other scenes have the GPS times of the strip: one echo in a hundred agrees by chance."""
    for scene in ("urban", "mixed"):
        words = ["simulate", scene, "-o", f"{scene}.las", "--pulses", "500", "-q"]
        assert run_command(*words).exit_code == 0
    result = run_command("compare", "urban.las", "mixed.las")
    assert result.exit_code == 0 and "echoes in common; are they results of one strip" in result.stderr
    result = run_command("compare", "urban.las", "mixed.las", "--within", "0.5")
    assert "echoes in common" not in result.stderr


def test_a_file_of_another_kind_names_its_option(place):
    words = ["survey", "strip.las", "-o", "system.toml", "--chain", "chain.toml"]
    assert run_command(*words).exit_code == 0
    (place / "cal.toml").write_text('schema = "wavebatch.calibration/1"\nconstant = 1e-8\nrelative_error = 0.1\n')
    kinds = {"chain": "a chain file", "system": "a survey", "calibration": "a calibration"}
    files = {"chain": "chain.toml", "system": "system.toml", "calibration": "cal.toml"}
    for option, wanted in kinds.items():
        for kind, path in files.items():
            if kind != option:
                line = _say("run", "strip.las", "-o", "o", f"--{option}", path, code=2)
                assert f"{path}: this is {kinds[kind]}, not {wanted}: give it as --{kind}" in line


def test_a_trajectory_that_is_missing_is_one_line_for_all_strips(place):
    line = _say("run", "strip.las", "other.las", "-o", "o", "--trajectory", "none.txt", code=2)
    assert "none.txt: trajectory cannot be read: No such file" in line


def test_points_are_shown_where_the_packets_are_missing(place):
    content = bytearray((place / "strip.las").read_bytes())
    content[6:8] = struct.pack("<H", 0b101)  # global encoding: packets in a .wdp
    (place / "lost.las").write_bytes(content)
    shown = run_command("info", "lost.las")
    assert shown.exit_code == 1 and "points         " in shown.stdout and "classes " in shown.stdout
    assert shown.stderr == "error: lost.las: its packets are missing: put lost.wdp next to the strip\n"
    assert shown.stdout.splitlines()[-1].split(maxsplit=1) == [
        "problem", "its packets are missing: put lost.wdp next to the strip"
    ]  # fmt: skip


def test_strips_without_points_pass_through_every_stage(place):
    empty = cut_strip(place / "strip.las", place / "empty.las", 0)
    columns = "+range,+incidence_angle_normals,+amplitude_normalized"
    done = run_command("run", empty, "-o", "o", "--columns", columns)
    assert done.exit_code == 0, done.stderr
    quiet = run_command("run", empty, "-o", "q", "-q")
    assert "warning: the strip has no points, so its cloud has none" in quiet.stderr and quiet.exit_code == 0
    assert run_command("check", empty).stdout.endswith("ok (0 points, 0 packets)\n")
    one = cut_strip(place / "strip.las", place / "one.las", 1)
    assert "ok (1 point, 1 packet, " in run_command("check", one).stdout
    shown = run_command("compare", "o/empty.laz", empty).stdout
    assert "nan" not in shown and "completeness      no-data\ncorrectness       no-data\n" in shown


@pytest.mark.quick_cases("check strip.las --json")
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is full")
@pytest.mark.parametrize("words", ["info strip.las", "check strip.las --json", "stats strip.las", "stages"])
def test_a_full_stdout_is_named(place, words):
    with open("/dev/full", "wb") as full:
        done = subprocess.run([sys.executable, "-m", "wavebatch", *words.split()], stdout=full, stderr=subprocess.PIPE,
                              text=True, check=False)  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "error: stdout: cannot be written: No space left on device\n")


def test_a_cloud_without_permission_is_one_of_those_that_cannot_be_read(place, monkeypatch):
    """Not wrong usage: the others are counted. Root may read everything, so click's question is answered with no."""
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    (place / "other.las").write_bytes(b"no permission")
    result = run_command("stats", "strip.las", "other.las")
    assert result.exit_code == 1 and "strip.las" in result.stdout and "not a LAS or LAZ file" in result.stderr
