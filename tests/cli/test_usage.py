"""Wrong usage of any command is one line on stderr that says where help is, and exit code 2."""

import json

import pytest
from commands import run_command

from wavebatch.cli import COMMANDS, main


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
