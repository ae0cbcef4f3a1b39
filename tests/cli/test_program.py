"""The program as a whole: help with examples, manual pages, version, settings from outside, log files."""

import inspect
import math
import re
import shlex
import shutil
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

import wavebatch as wb
from wavebatch.batch.options import ELSEWHERE, EXCLUSIVE, NEEDS, OPTIONS, RunOptions
from wavebatch.cli import COMMANDS, main
from wavebatch.cli.program import log_file
from wavebatch.cli.program.about import roff
from wavebatch.cli.program.command import ProgramCommand, group_options
from wavebatch.cli.program.examples import EXAMPLES, GROUPS
from wavebatch.cli.program.settings import NEVER, OLD_NAMES
from wavebatch.core.errors import ConfigError
from wavebatch.tools.simulate import DiscreteReceiver, Recording, StripOptions
from wavebatch.tools.slices.segments import SliceOptions
from wavebatch.tools.voxels.profile import Deconvolution


def invoke(*arguments, **environment):
    return CliRunner().invoke(main, list(map(str, arguments)), prog_name="wavebatch", env=environment)


def _commands():
    for name in COMMANDS:
        command = main.get_command(None, name)
        yield name, command
        for inner, one in getattr(command, "commands", {}).items():
            yield f"{name} {inner}", one


@pytest.mark.parametrize("title", [title for title, _ in _commands()])
def test_every_page_of_help_has_examples_and_every_option_once(title):
    command = dict(_commands())[title]
    shown = invoke(*title.split(), "--help").stdout
    if not isinstance(command, click.Group):
        assert isinstance(command, ProgramCommand) and "Examples:" in shown and EXAMPLES[title]
    shown = shown[re.search(r"(?m)^[A-Z][\w ]+:\n  -", shown).start() :]
    for option in command.params:
        if isinstance(option, click.Option):
            name = max(option.opts, key=len)
            assert len(re.findall(rf"(?m)^  (?:-\w, )?{name}(?![\w-])", shown)) == 1, name


@pytest.mark.parametrize(
    ("title", "line"), [(title, line) for title, lines in EXAMPLES.items() for line, _ in lines], ids=str
)
def test_examples_are_right_usage(title, line):
    program, *words = shlex.split(line)
    assert program == "wavebatch" and words[: len(title.split())] == title.split()
    dict(_commands())[title].make_context(title, words[len(title.split()) :], parent=click.Context(main))


def test_groups_name_options_that_exist_and_each_once():
    known = {option.name for _, command in _commands() for option in command.params} | {"help"}
    titled = {(title, option.name) for title, command in _commands() for option in command.params}
    named = [name for names in GROUPS.values() for name in names if " " not in name]
    assert {tuple(name.rsplit(" ", 1)) for names in GROUPS.values() for name in names if " " in name} <= titled
    assert len(named) == len(set(named)) and not set(named) & set(OPTIONS)
    rivals = {name for group in (*EXCLUSIVE, *NEEDS.values(), NEEDS) for name in group}
    assert [name for name in {*rivals, *NEVER, *ELSEWHERE} if name not in known] == []
    assert set(named) - known == set()


def test_run_has_the_options_of_runoptions_and_python_the_same():
    command = dict(_commands())["run"]
    names = {option.name: option for option in command.params}
    keywords = inspect.signature(wb.run).parameters
    for name, one in OPTIONS.items():
        assert max(names[name].opts, key=len) == f"--{name.replace('_', '-')}"
        assert name in keywords and names[name].help.startswith(one.told.help.split("  [")[0])
        if name != "output":
            assert f"{name} : " in wb.run.__doc__ and keywords[name].default == getattr(RunOptions(), name)
    extra = {"strips", "dry_run", "report", "html_file", "progress", "verbose", "as_json", "quiet", "log_path",
             "log_level", "debug"}  # fmt: skip
    assert names.keys() - OPTIONS.keys() == extra and keywords.keys() - OPTIONS.keys() == {"strips", "on_event"}


def test_help_of_run_begins_with_the_options_that_most_need():
    shown = invoke("run", "--help").stdout
    headings = re.findall(r"(?m)^([A-Z][\w ]+):\n  -", shown)
    assert headings[0] == "Options that most runs need"
    first = shown.split(headings[0])[1].split(f"\n{headings[1]}:")[0]
    assert len(re.findall(r"(?m)^  (?:-\w, )?--", first)) <= 11 and "--jobs" in first and "--crs" not in first


@pytest.mark.parametrize(
    ("variable", "words"),
    [
        ("WAVEBATCH_RUN_FORMTA", "no command has this option; did you mean WAVEBATCH_RUN_FORMAT?"),
        ("WAVEBATCH_JBOS", "did you mean WAVEBATCH_JOBS?"),
        ("WAVEBATCH_SURVEY_OVERWRITE", "this option can be given on the command line only"),
        ("WAVEBATCH_PLOT_MAP_QQQQQQQQQQQQQQQQ", "see --help for the names"),
    ],
)
def test_a_variable_that_no_command_reads_is_said(folder, variable, words):
    shown = _dry(folder, **{variable: "3"})
    assert shown.exit_code == 0 and shown.stderr.startswith(f"warning: {variable} is ignored: ")
    assert words in shown.stderr and shown.stderr.count("\n") == 1


def test_variables_of_other_commands_and_of_others_are_not_said(folder):
    assert _dry(folder, WAVEBATCH_SURVEY_WAVEFORMS="9", WAVEBATCH_DATA="x", WAVEBATCH_SEED="1").stderr == ""


def test_options_that_take_a_number_name_its_unit():
    for title, command in _commands():
        for option in command.params:
            if isinstance(option, click.Option) and isinstance(option.type, click.types.FloatParamType):
                unit = option.metavar and option.metavar not in ("FLOAT", None)
                none = option.help.startswith(("Correlation", "Share"))
                assert unit or none or re.search(r"\[[^\]]+\]", option.help), (title, option.name)


def test_options_of_several_commands_mean_the_same():
    seen = {}
    for title, command in _commands():
        for option in command.params:
            if isinstance(option, click.Option):
                name = max(option.opts, key=len)
                kind = (type(option.type).__name__.replace("Range", "ParamType"), option.is_flag)
                seen.setdefault(name, {}).setdefault(kind, []).append(title)
    mixed = {name: kinds for name, kinds in seen.items() if len(kinds) > 1}
    # Files that are written in one command are read by others; other names stand for numbers of different things.
    read_or_written = {"--chain", "--truth", "--angles"}
    numbers = {"--point-format", "--no-data", "--pulses", "--width", "--most"}
    assert mixed.keys() <= read_or_written | numbers
    assert set(OLD_NAMES.values()) <= seen.keys()
    for title, command in _commands():
        names = {name for option in command.params for name in option.opts}
        assert not any({old, new} <= names for old, new in OLD_NAMES.items()), title


def test_options_that_share_a_name_stand_where_they_belong():
    places = (("grid", "--crs", "Reading"), ("grid", "--column", "Options"), ("slice", "--most", "Options"))
    for title, name, heading in places:
        command = dict(_commands())[title]
        groups = dict(group_options(command, click.Context(command, info_name=title)))
        assert any(record[0].startswith(name) for record in groups[heading]), (title, name)


def test_every_command_has_quiet_and_debug():
    for title, command in _commands():
        names = {name for option in command.params for name in option.opts}
        assert not names or {"-q", "--quiet", "--debug", "--log-file"} <= names, title


def test_quiet_hides_what_is_written_but_no_warning(tiny_strip, tmp_path):
    loud, still = (invoke("survey", tiny_strip, "-o", tmp_path / f"{name}.toml", *words)
                   for name, words in (("a", ()), ("b", ("-q",))))  # fmt: skip
    assert loud.exit_code == still.exit_code == 0 and loud.stdout == still.stdout
    assert "a.toml: written" in loud.stderr and still.stderr == ""


def test_the_tolerance_of_compare_has_another_name(tiny_strip):
    found = invoke("compare", tiny_strip, tiny_strip, "--tolerance", "0.5")
    assert found.exit_code == 0, found.stderr
    assert "--tolerance is now --within" in found.stderr and "within 0.5 ns" in found.stdout


def test_old_names_of_options_work_with_a_remark(tiny_strip, tmp_path):
    (tmp_path / "a.las").write_bytes(tiny_strip.read_bytes())
    old = invoke("stats", tmp_path / "a.las", "--where", "flag(WEAK) or z > 0", "--polygons=none.json")
    assert old.exit_code == 2 and old.stderr.startswith("remark: --polygons is now --polygon; ")
    assert "none.json" in old.stderr.splitlines()[1]


def test_version_names_python_and_the_libraries():
    lines = invoke("--version").stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["wavebatch", "Python", "numpy", "scipy", "laspy", "lazrs"]
    assert lines[1].split()[1] == sys.version.split()[0]


def test_manual_pages_have_the_text_of_help(tmp_path):
    result = invoke("--man-pages", tmp_path / "man")
    assert result.exit_code == 0 and result.stdout == ""
    pages = {path.name: path.read_text() for path in (tmp_path / "man").iterdir()}
    assert len(pages) == 1 + sum(1 for _ in _commands()) and "wavebatch-plot-map.1" in pages
    assert ".SH EXAMPLES" in pages["wavebatch-run.1"] and roff("--tolerance LENGTH") in pages["wavebatch-run.1"]
    assert not any(re.search(r"(?m)^'", text) for text in pages.values())
    if shutil.which("groff"):
        for path in (tmp_path / "man").iterdir():
            shown = subprocess.run(["groff", "-man", "-Tutf8", "-ww", path], capture_output=True, text=True)
            assert shown.returncode == 0 and not shown.stderr, (path, shown.stderr)


@pytest.fixture
def folder(tiny_strip, tmp_path):
    (tmp_path / "in").mkdir()
    shutil.copy(tiny_strip, tmp_path / "in" / "tiny.las")
    return tmp_path / "in"


def _dry(folder, *arguments, **environment):
    return invoke("run", folder / "tiny.las", "-o", folder / "out", "--dry-run", *arguments, **environment)


def test_the_order_is_command_line_variable_file(folder):
    (folder / "wavebatch.toml").write_text('[run]\nprofile = "fast"\nformat = "las"\n[survey]\nwaveforms = 9\n')
    shown = _dry(folder)
    assert shown.exit_code == 0 and "out/tiny.las" in shown.stdout
    source = str(folder / "wavebatch.toml")
    assert f"settings: --profile fast ({source}), --format las ({source})" in shown.stderr
    assert f"# setting: --format las ({source})" in shown.stdout
    shown = _dry(folder, WAVEBATCH_FORMAT="laz", WAVEBATCH_RUN_PROFILE="balanced", WAVEBATCH_PROFILE="accurate")
    assert "--format laz (WAVEBATCH_FORMAT)" in shown.stderr
    assert "--profile balanced (WAVEBATCH_RUN_PROFILE)" in shown.stderr
    shown = _dry(folder, "--tolerance", "5m", "--format", "las", WAVEBATCH_PROFILE="fast")
    assert shown.exit_code == 0 and shown.stderr == ""  # what excludes others takes their place


@pytest.mark.parametrize(("weak", "strong"), [('profile = "fast"', "tolerance"), ('chain = "c.toml"', "profile")])
def test_a_variable_takes_the_place_of_what_it_excludes_in_the_file(folder, weak, strong):
    (folder / "wavebatch.toml").write_text(f"[run]\n{weak}\n")
    value = {"tolerance": "5m", "profile": "balanced"}[strong]
    shown = _dry(folder, **{f"WAVEBATCH_{strong.upper()}": value})
    assert shown.exit_code == 0 and shown.stderr == f"settings: --{strong} {value} (WAVEBATCH_{strong.upper()})\n"


@pytest.mark.parametrize(
    ("setting", "arguments"),
    [("attenuation = 0.3", ("--visibility", "23")), ("flight-height = 800", ("--trajectory", "t.txt"))],
)  # fmt: skip
def test_an_option_takes_the_place_of_what_it_excludes(folder, setting, arguments):
    (folder / "wavebatch.toml").write_text(f"[run]\n{setting}\n")
    shown = _dry(folder, *arguments, "--columns", "+range")
    assert "exclude each other" not in shown.stderr and "settings" not in shown.stderr


def test_settings_change_the_result_as_options_do(folder):
    (folder / "wavebatch.toml").write_text('[run]\nprofile = "fast"\nformat = "las"\noutput = "there"\n')
    result = invoke("run", folder, "--quiet")
    assert result.exit_code == 0 and (folder / "there" / "tiny.las").exists()
    assert result.stderr.count("settings: ") == 1  # a file beside the strips is never silent
    assert "settings" not in invoke("run", folder, "-q", "--resume", "-o", folder / "other", "--profile", "fast",
                                    "--format", "las", WAVEBATCH_JOBS="1").stderr  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[run]\njbos = 3\n", "has no option 'jbos'; did you mean 'jobs'?"),
        ("[run]\noverwrite = true\n", "overwrite can be given on the command line only"),
        ('[run]\nreport = "../notes.txt"\n', "report can be given on the command line or in a variable only"),
        ('[run]\nscheduler = "tcp://there:8786"\n', "scheduler can be given on the command line or in a variable only"),
        ("[run]\nresume = true\n", "resume can be given on the command line or in a variable only"),
        ("[run\n", "wavebatch.toml"), ("run = 3\n", "must be a table"),
        ('[run]\njobs = "many"\n', "invalid value for '--jobs'"),
    ],
)  # fmt: skip
def test_wrong_settings_are_one_line(folder, text, words):
    (folder / "wavebatch.toml").write_text(text)
    result = _dry(folder)
    assert result.exit_code == 2 and words in result.stderr and result.stderr.count("\n") == 1, result.stderr


def test_a_file_beside_the_archives_resumes_no_import(tmp_path):
    (tmp_path / "wavebatch.toml").write_text("[import]\nresume = true\n")
    (tmp_path / "a.pls").write_bytes(b"")
    result = invoke("import", tmp_path / "a.pls", "-o", tmp_path / "a.las")
    assert result.exit_code == 2 and "resume can be given on the command line or in a variable only" in result.stderr


def test_strips_of_folders_with_different_settings_are_not_mixed(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "two")
    for name in ("in", "two"):
        (tmp_path / name / "wavebatch.toml").write_text("[stats]\njson = true\n")
    result = invoke("stats", tmp_path / "in", tmp_path / "two" / "*.las")
    assert result.exit_code == 2 and "different settings" in result.stderr
    assert invoke("stats", tmp_path / "two" / "*.las").stdout.startswith("{")


def test_a_log_has_what_quiet_hides_and_is_appended(folder, tmp_path):
    log = tmp_path / "night.log"
    (folder / "broken.las").write_bytes((folder / "tiny.las").read_bytes()[:300])
    task = ["run", folder, "-o", tmp_path / "out", "--profile", "fast", "--columns", "+cross_section"]
    arguments = [*task, "-q", "--log-file", log]
    assert invoke(*arguments).exit_code == 3
    lines = log.read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ (INFO|WARNING|ERROR) ", line) for line in lines)
    assert any("INFO" in line and "tiny.las" in line and "waveforms" in line for line in lines)
    assert any("ERROR" in line and "broken.las" in line for line in lines)
    assert invoke(*arguments, "--resume", "--log-level", "error").exit_code == 3
    assert log.read_text().count("broken.las") == 2 and not log_file.is_open()
    loud = invoke(*task, "--overwrite").stderr.splitlines()
    said = [line.partition(": ")[2] for line in loud if "tiny.las: " in line]
    assert len(said) > 1 and all(any(text in line for line in lines) for text in said), "also remarks and warnings"
    assert invoke(*arguments, "--resume").exit_code == 3 and "tiny.las: is up to date, skipped" in log.read_text()
    done = invoke("export", folder / "tiny.las", "-o", tmp_path / "x.npz", "-q", "--log-file", log)
    assert done.exit_code == 0 and done.stderr == "" and "INFO    " + str(tmp_path / "x.npz: ") in log.read_text()


@pytest.mark.parametrize("words", ["run in -o out", "plot map in --column z -o m.png"])
def test_the_first_line_of_a_log_is_the_command_as_it_was_typed(folder, monkeypatch, words):
    monkeypatch.chdir(folder.parent)
    monkeypatch.setattr(sys, "argv", ["/usr/bin/wavebatch", *words.split(), "--log-file", "a b.log"])
    assert invoke(*sys.argv[1:]).exit_code == 0
    first = (folder.parent / "a b.log").read_text().splitlines()[0]
    assert first.endswith(f": wavebatch {words} --log-file 'a b.log'")


def test_outputs_replace_neither_the_log_nor_the_settings(folder, tmp_path):
    settings = folder / "wavebatch.toml"
    settings.write_text('[run]\nprofile = "fast"\n')
    result = invoke("run", folder, "-o", tmp_path / "out", "--report", settings)
    assert result.exit_code == 2 and "would replace this input" in result.stderr and "fast" in settings.read_text()
    log = tmp_path / "night.log"
    result = invoke("run", folder, "-o", tmp_path / "out", "--report", log, "--log-file", log)
    assert result.exit_code == 2 and "two outputs have this name" in result.stderr
    assert not (tmp_path / "out").exists() and "two outputs" in log.read_text()


def test_a_log_never_grows_into_another_file(folder):
    before = (folder / "tiny.las").read_bytes()
    result = invoke("info", folder / "tiny.las", "--log-file", folder / "tiny.las")
    assert result.exit_code == 2 and "is no log" in result.stderr and (folder / "tiny.las").read_bytes() == before
    result = invoke("info", folder / "tiny.las", "--log-file", folder / "no" / "x.log")
    assert result.exit_code == 2 and "cannot be written" in result.stderr


def test_python_is_refused_what_the_command_line_is():
    for options, words in (
        (SliceOptions, {"std": 0.0}), (Deconvolution, {"method": "golden"}), (Deconvolution, {"threshold": math.nan}),
        (StripOptions, {"scale": 2.0}), (DiscreteReceiver, {"most": 0}), (Recording, {"bits": 12}),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match="^--[a-z-]+ [^:]+: (must lie (from|above)|choose) "):
            options(**words)
