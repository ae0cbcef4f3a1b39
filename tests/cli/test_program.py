"""The program as a whole: help with examples, manual pages, version, settings from outside, log files.

Completion in shells, and results that cannot be printed.

`wavebatch stages`: every algorithm can be looked up, and its example is a chain that loads.
"""

import inspect
import os
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest
from click.shell_completion import BashComplete
from commands import run_command

import wavebatch as wb
from wavebatch.batch.options import EXCLUSIVE, NEEDS, OPTIONS, SAME_CLOUD, RunOptions
from wavebatch.batch.report_file import REQUESTED, describe_job
from wavebatch.cli import COMMANDS, main
from wavebatch.cli import command as program
from wavebatch.cli.command import GROUPS, ProgramCommand, complete_files, roff
from wavebatch.stages.chain import STAGES, Step, effective, parse_chain
from wavebatch.tools.api import plan_run


def invoke(*arguments, **environment):
    return run_command(*arguments, prog_name="wavebatch", env=environment)


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
    assert not re.findall(r" (?:RANGE|FLOAT|INTEGER|TEXT|PATH)\b", shown), "click's names, which say no unit"
    assert not re.findall(r"(?m)^  [a-z]+  .*\.\.\.$", shown), "the list of commands cuts no sentence"
    if not isinstance(command, click.Group):
        assert isinstance(command, ProgramCommand) and "Examples:" in shown and command.examples
    shown = shown[re.search(r"(?m)^[A-Z][\w ]+:\n  -", shown).start() :]
    for option in command.params:
        if isinstance(option, click.Option):
            name = max(option.opts, key=len)
            assert len(re.findall(rf"(?m)^  (?:-\w, )?{name}(?![\w-])", shown)) == 1, name


@pytest.mark.parametrize(
    ("title", "line"),
    [(title, line) for title, command in _commands() for line, _ in getattr(command, "examples", ())],
    ids=str,
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
    assert [name for name in {*rivals, *program.NO_VARIABLE, *SAME_CLOUD} if name not in known] == []
    assert set(named) - known == set()


def test_resume_compares_every_option_that_may_change_a_cloud(tiny_strip):
    (job,), _ = plan_run(tiny_strip, RunOptions("clouds"))
    described = describe_job(job, {})["options"].keys()
    assert OPTIONS.keys() - described == {*SAME_CLOUD, *REQUESTED} - {"columns"}
    assert not set(SAME_CLOUD) & set(REQUESTED)


def test_run_has_the_options_of_runoptions_and_python_the_same():
    command = dict(_commands())["run"]
    names = {option.name: option for option in command.params}
    keywords = inspect.signature(wb.run).parameters
    for name, one in OPTIONS.items():
        assert max(names[name].opts, key=len) == f"--{name.replace('_', '-')}"
        assert name in keywords and names[name].help.startswith(one.words.help.split("  [")[0])
        if name != "output":
            assert f"{name} : " in wb.run.__doc__ and keywords[name].default == getattr(RunOptions(), name)
    extra = {"strips", "dry_run", "fail_on", "report", "html_file", "progress", "verbose", "as_json", "quiet",
             "log_path", "log_level", "config", "debug"}  # fmt: skip
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


def test_every_command_has_quiet_and_debug():
    for title, command in _commands():
        names = {name for option in command.params for name in option.opts}
        assert not names or {"-q", "--quiet", "--debug", "--log-file"} <= names, title


def test_quiet_hides_what_is_written_but_no_warning(tiny_strip, tmp_path):
    loud, still = (invoke("survey", tiny_strip, "-o", tmp_path / f"{name}.toml", *words)
                   for name, words in (("a", ()), ("b", ("-q",))))  # fmt: skip
    assert loud.exit_code == still.exit_code == 0 and loud.stdout == still.stdout
    assert "a.toml: written" in loud.stderr and still.stderr == ""


def test_version_names_python_and_the_libraries():
    lines = invoke("--version").stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["wavebatch", "Python", "numpy", "scipy", "laspy", "lazrs"]
    assert lines[1].split()[1] == sys.version.split()[0]


def test_manual_pages_have_the_text_of_help(tmp_path):
    result = invoke("--man-pages", tmp_path / "man")
    assert result.exit_code == 0 and result.stdout == ""
    pages = {path.name: path.read_text() for path in (tmp_path / "man").iterdir()}
    assert len(pages) == 1 + sum(1 for _ in _commands()) and "wavebatch-plot-map.1" in pages
    text = pages["wavebatch-run.1"]
    assert ".SH EXAMPLES" in text and roff("--tolerance LENGTH") in text and "\n\\&" not in text
    assert "\n.PP\nDecompose strips into enriched point clouds.\n" in text
    assert ".SH SEE ALSO" in text and ".SH SEE ALSO" not in pages["wavebatch.1"]
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
    (folder / "wavebatch.toml").write_text('[run]\nprofile = "fast"\npoints = "returns"\n[survey]\nwaveforms = 9\n')
    shown = _dry(folder)
    assert shown.exit_code == 0 and "out/tiny.laz" in shown.stdout
    source = str(folder / "wavebatch.toml")
    assert shown.stderr.startswith("settings: ") and shown.stderr.count("\n") == 1
    assert f"--profile fast ({source})" in shown.stderr and f"--points returns ({source})" in shown.stderr
    assert f"# setting: --points returns ({source})" in shown.stdout
    shown = _dry(folder, WAVEBATCH_POINTS="echoes", WAVEBATCH_RUN_PROFILE="balanced", WAVEBATCH_PROFILE="accurate")
    assert "--points echoes (WAVEBATCH_POINTS)" in shown.stderr
    assert "--profile balanced (WAVEBATCH_RUN_PROFILE)" in shown.stderr
    shown = _dry(folder, "--tolerance", "5m", "--points", "returns", WAVEBATCH_PROFILE="fast")
    assert shown.exit_code == 0 and shown.stderr == ""  # what excludes others takes their place


def test_a_wrong_condition_names_where_it_comes_from(folder):
    (folder / "wavebatch.toml").write_text('[run]\nwhere = "z = 2"\n')
    assert f"write == for '=' ({folder / 'wavebatch.toml'})" in _dry(folder).stderr
    assert "(WAVEBATCH_WHERE)" in _dry(folder, WAVEBATCH_WHERE="z = 2").stderr


@pytest.mark.parametrize(("weak", "strong"), [('profile = "fast"', "tolerance"), ('chain = "c.toml"', "profile")])
def test_a_variable_takes_the_place_of_what_it_excludes_in_the_file(folder, weak, strong):
    (folder / "own.toml").write_text(f"[run]\n{weak}\n")
    value = {"tolerance": "5m", "profile": "balanced"}[strong]
    shown = _dry(folder, "--config", folder / "own.toml", **{f"WAVEBATCH_{strong.upper()}": value})
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
    """A file that the user names gives any option, those of its own paths relative to it; one beside it is not read."""
    own = folder.parent / "own.toml"
    own.write_text('[run]\nprofile = "fast"\nformat = "las"\noutput = "there"\noverwrite = true\nlog-file = "a.log"\n')
    (folder / "wavebatch.toml").write_text("[run]\nbroken = 1\n")
    for _ in range(2):
        result = invoke("run", folder, "--quiet", WAVEBATCH_CONFIG=str(own))
        assert result.exit_code == 0 and (folder.parent / "there" / "tiny.las").exists(), result.stderr
        assert result.stderr.count("settings: ") == 1  # a file is never silent
    assert (folder.parent / "a.log").exists()
    (folder / "wavebatch.toml").unlink()
    assert "settings" not in invoke("run", folder, "-q", "--resume", "-o", folder / "other", "--profile", "fast",
                                    "--format", "las", WAVEBATCH_JOBS="1").stderr  # fmt: skip


def test_the_file_of_the_user_counts_after_the_one_beside_the_strips(folder, tmp_path):
    kept = tmp_path / "home" / "wavebatch" / "wavebatch.toml"
    kept.parent.mkdir(parents=True)
    kept.write_text(f'[run]\nchain = "{tmp_path}/c.toml"\npoints = "returns"\nlog-file = "{tmp_path}/a.log"\n')
    beside = folder / "wavebatch.toml"
    beside.write_text('[run]\nprofile = "fast"\npoints = "echoes"\n')
    shown = _dry(folder, XDG_CONFIG_HOME=str(tmp_path / "home"))
    assert shown.exit_code == 0 and f"--log-file {tmp_path}/a.log ({kept})" in shown.stderr
    assert f"--points echoes ({beside})" in shown.stderr and "--chain" not in shown.stderr
    assert f"--profile fast ({beside})" in shown.stderr and (tmp_path / "a.log").exists()


def test_a_file_beside_the_strips_gives_only_the_options_on_the_list(folder):
    """A new option is refused until it is listed; one that names a file must not be listed."""
    options = [(title, max(option.opts, key=len).removeprefix("--"), isinstance(option.type, click.Path))
               for title, command in _commands() for option in command.params if isinstance(option, click.Option)]
    assert not {name for _, name, is_path in options if is_path} & program.HARMLESS
    assert {name for _, name, _ in options} >= program.HARMLESS, "all of the list exist"
    harmful = {"energy", "crs", "scheduler", "memory", "jobs", "block-size", "format", "survey", "force", "quiet",
               "log-level", "debug", "resume", "overwrite", "recursive", "json"}  # fmt: skip
    assert not program.HARMLESS & harmful
    for name in sorted({name for title, name, _ in options if title == "run"} - program.HARMLESS - {"config"}):
        (folder / "wavebatch.toml").write_text(f'[run]\n{name} = "{folder}/x"\n')
        done = _dry(folder)
        assert done.exit_code == 2 and f"must not set {name} so" in done.stderr, (name, done.stderr)
        assert done.stderr.count("\n") == 1 and f"give --config {folder}/wavebatch.toml" in done.stderr
    assert sorted(path.name for path in folder.iterdir()) == ["tiny.las", "wavebatch.toml"]


def test_settings_beside_the_strips_of_a_pattern_are_used(folder):
    (folder / "wavebatch.toml").write_text('[stats]\nwhere = "z > 0"\n')
    assert "settings: --where z > 0" in invoke("stats", folder / "*.las").stderr


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
    loud = invoke(*task, "--overwrite").stderr.splitlines()
    assert log.read_text().count("broken.las") == 2, "the log is closed with its command"
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


def test_no_command_loads_linear_algebra_before_it_runs():
    """To explain a variable that no command reads, all commands load; SciPy's BLAS may wait for memory for ever."""
    script = (
        "import sys, click; from wavebatch.cli import main; context = click.Context(main); "
        "every = [main.get_command(context, one) for one in main.list_commands(context)]; "
        "assert None not in every and len(every) > 15; print('scipy.linalg' in sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert shown.stdout == "False\n", shown.stderr


ROOT = Path(__file__).parents[2]
PROGRAM = "from wavebatch.cli import main; main.main(prog_name='wavebatch')"


@pytest.fixture
def complete(monkeypatch):
    """`complete(words, number)`: what the program offers for the word `number`."""

    def ask(words, number):
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(number))
        return BashComplete(main, {}, "wavebatch", "_WAVEBATCH_COMPLETE").complete().split()

    return ask


@pytest.mark.parametrize("command", ["run", "info", "survey", "voxelize", "slice", "check", "stats"])
def test_arguments_are_files(complete, command):
    assert complete(f"wavebatch {command} fl", 2) == ["file,fl"]


def test_commands_profiles_and_choices(complete):
    assert complete("wavebatch vox", 1) == ["plain,voxelize"]
    assert complete("wavebatch run --profile a", 3) == ["plain,auto", "plain,accurate"]
    assert complete("wavebatch run --names p", 3) == ["plain,pdal"]
    assert complete("wavebatch run --las", 2) == ["plain,--las-version"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_its_script(shell):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "_WAVEBATCH_COMPLETE": f"{shell}_source"}
    result = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert f"_WAVEBATCH_COMPLETE={shell}_complete" in result.stdout


@pytest.mark.parametrize(
    ("words", "number", "offers"),
    [
        ("wavebatch run a --drop-flags weak,ring", 4, ["weak,RINGING_SUSPECT"]),
        ("wavebatch plot map a --drop-flags NO_E", 5, ["NO_ECHO"]),
        ("wavebatch run a --columns +ran", 4, ["+range", "+range_err", "+range_error"]),
        ("wavebatch run a --columns +range,+rang", 4, ["+range,+range_err", "+range,+range_error"]),
        ("wavebatch grid a --column echo_w", 4, ["echo_width", "echo_width_err"]),
        ("wavebatch stages decompose.resid", 2, ["decompose.residual_loop"]),
        ("wavebatch simulate fore", 2, ["forest"]),
        ("wavebatch bench --scene fore", 3, ["forest"]),
    ],
)
def test_names_of_flags_columns_stages_and_scenes(complete, words, number, offers):
    assert complete(words, number) == [f"plain,{offer}" for offer in offers]


def test_lists_are_completed_with_their_sign(complete, tmp_path, monkeypatch):
    (tmp_path / "strips").mkdir()
    (tmp_path / "strips" / "strip list.txt").touch()
    monkeypatch.chdir(tmp_path)
    assert complete("wavebatch run @str", 2) == ["plain,@strips/"]
    assert [item.value for item in complete_files(None, None, "@strips/st")] == ["@strips/strip list.txt"]
    assert complete_files(None, None, "@nowhere/x") == []


STARTS = {
    "bash": (["bash", "--norc", "-i"], 'eval "$(_WAVEBATCH_COMPLETE=bash_source wavebatch)"'),
    "zsh": (["zsh", "-f", "-i"],
            'autoload -U compinit; compinit -u; eval "$(_WAVEBATCH_COMPLETE=zsh_source wavebatch)"'),
    "fish": (["fish", "--no-config", "-i"], "_WAVEBATCH_COMPLETE=fish_source wavebatch | source"),
}  # fmt: skip
TYPED = {
    "wavebatch run --profile ba\t": "--profile balanced",
    "wavebatch run fl\t": "flight\\ 7.las",
    "wavebatch run --system oth\t": "--system other.toml",
    "wavebatch plot histogram Ü\t": "histogram Übung.laz",
    "wavebatch vox\t": "wavebatch voxelize",
    "wavebatch check @oth\t": "check @other.toml",
}


@pytest.mark.parametrize("shell", STARTS)
def test_a_terminal_completes_names_after_tab(shell, tmp_path):
    """Keys are typed into a real shell in a terminal of its own; the shell starts as docs/index.md says."""
    if shutil.which(shell) is None or not hasattr(os, "fork"):
        pytest.skip(f"{shell} is not installed")
    for name in ("flight 7.las", "other.toml", "Übung.laz"):
        (tmp_path / name).touch()
    program = tmp_path / "bin" / "wavebatch"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "{PROGRAM}" "$@"\n')
    program.chmod(0o755)
    words, start = STARTS[shell]
    assert start.split("; ")[-1] in (ROOT / "docs" / "index.md").read_text("utf-8")
    environment = {
        **os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        "TERM": "dumb", "HOME": str(tmp_path), "LC_ALL": "C.UTF-8",
    }  # fmt: skip
    terminal = [sys.executable, "-c", "import pty, sys; pty.spawn(sys.argv[1:])", *words]
    with subprocess.Popen(terminal, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path, env=environment,
                          start_new_session=True) as child:  # fmt: skip
        try:
            _talk(child, start + "; echo rea''dy\n", "ready")
            for keys, shown in TYPED.items():
                _talk(child, keys, shown)
                _talk(child, "\x15echo n''ext\n", "next")  # first kills the line
        finally:
            os.killpg(child.pid, signal.SIGKILL)


def _talk(child, keys, wanted, seconds=100.0):
    """Types keys and waits until the terminal shows the text."""
    child.stdin.write(keys.encode())
    child.stdin.flush()
    shown, end = b"", time.monotonic() + seconds
    while wanted.encode() not in shown:
        assert time.monotonic() < end, (keys, wanted, shown.decode(errors="replace"))
        if select.select([child.stdout], [], [], 0.2)[0]:
            shown += os.read(child.stdout.fileno(), 65536)


def _invoke(*arguments):
    return run_command("stages", *arguments)


def test_the_list_has_every_stage_with_its_summary():
    result = _invoke()
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert len(lines) == len(STAGES)
    for stage in STAGES.values():
        assert any(line.split()[0] == stage.name and stage.summary in line for line in lines)


PARTNERS = {
    "decompose.asdf_only": {"detect": "detect.asdf"}, "decompose.asdf_mixed": {"detect": "detect.asdf"},
    "attribute.skew": {"decompose": "decompose.skewed"},
}  # fmt: skip
"""Stages that refuse a chain without another one; their texts say which."""
MORE = {"attribute.skew": {"decompose": 'kappa = "free"\n'}}
"""Parameters that it must have."""


@pytest.mark.parametrize("name", sorted(STAGES))
def test_one_stage_shows_parameters_defaults_and_an_example_that_loads(name):
    text = _invoke(name).stdout
    for parameter in STAGES[name].parameters.values():
        assert f"{parameter.name} (" in text and f"default {parameter.default}" in text
        assert parameter.meaning in text
    example = text[text.index("[[chain]]") :]
    others = {kind: next(s for s in STAGES if s.startswith(kind)) for kind in ("noise", "detect", "decompose")}
    others |= PARTNERS.get(name, {})
    kind = name.split(".")[0]
    more = MORE.get(name, {})
    tables = [
        example if k == kind else f'[[chain]]\nstage = "{other}"\n{more.get(k, "")}' for k, other in others.items()
    ]
    if kind == "attribute":
        makers = {s.name for column in Step(STAGES[name]).needs for s in STAGES.values() if column in s.makes}
        ordered = sorted(makers, key=lambda maker: maker != "attribute.position")
        tables += [*(f'[[chain]]\nstage = "{maker}"\n' for maker in ordered), example]
    assert all(other in text for other in PARTNERS.get(name, {}).values())
    chain = parse_chain("\n".join(tables), "example")
    assert example.strip() in effective(chain)
