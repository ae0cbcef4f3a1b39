"""Documentation: what it shows is true, its sentences are held by tests, and the site is whole."""

import ast
import functools
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner

import wavebatch
from wavebatch.cli import COMMANDS, main
from wavebatch.core.echoes import COLUMNS, FLAG_MEANINGS, EchoFlag
from wavebatch.kernels.build_kernels import LIBRARY
from wavebatch.stages.chain import STAGES, list_profiles, parse_chain

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
OURS = [column for column in COLUMNS.values() if column.extra_bytes]


def read(name: str) -> str:
    return (DOCS / name).read_text("utf-8")


def blocks(name: str) -> dict[str, str]:
    """Code blocks with a title, by title."""
    return dict(re.findall(r'(?ms)^```\w+ title="([^"]+)"\n(.*?)^```$', read(name)))


@pytest.mark.parametrize("column", OURS, ids=lambda column: column.name)
def test_every_column_is_described_as_it_is_declared(column):
    assert f"| {column.name} | {column.unit} | {column.meaning} |" in read("columns.md")


@pytest.mark.parametrize("flag", list(EchoFlag), ids=lambda flag: flag.name)
def test_every_flag_is_described_as_it_is_declared(flag):
    assert f"| {int(flag)} | {flag.name} | {FLAG_MEANINGS[flag]} |" in read("columns.md")


def test_every_stage_has_its_place_in_the_algorithms():
    text = read("algorithms.md").partition("\n## 6. ")[2].partition("\n## 7. ")[0]
    shipped = [stage.name for stage in STAGES.values() if stage.function.__module__.startswith("wavebatch.")]
    assert [name for name in shipped if f"`{name}`" not in text] == []


def test_profiles_are_described_and_the_chain_loads():
    for name in list_profiles():
        assert f"--profile {name}" in read("chains.md")
    text = re.search(r"(?m)^    \[\[chain\]\]\n(?:    .*\n|\n)+", read("chains.md")).group()
    assert len(parse_chain(re.sub("(?m)^    ", "", text), "chains.md").steps) == 5


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_names_exist(page):
    rooms = "core|kernels|files|stages|surveying|batch|tools|cli|tests|examples"
    named = re.findall(rf"`((?:{rooms})/[\w./*-]*?)`", page.read_text("utf-8"))
    for name in named:
        base = ROOT if name.startswith(("tests/", "examples/")) else ROOT / "wavebatch"
        assert list(base.glob(name.rstrip("/"))), f"{page.name} names {name}"


def test_links_between_pages_lead_somewhere():
    for page in [*PAGES, *ROOT.glob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_numbered_sections_that_code_cites_exist():
    for name in ("algorithms", "las-waveforms"):
        text = read(f"{name}.md")
        known = set(re.findall(r"(?m)^#{2,4} ([\w.]+?)\.? ", text))
        # A cited pair such as "9.2" may be item 2 of the list in section 9.
        for path in (ROOT / "wavebatch").rglob("*.py"):
            for cited in re.findall(rf"docs/{name}\.md (\d[\d.]*\d|\d|[HRT]\d+)", path.read_text("utf-8")):
                tests = cited.startswith("T") and f"| {cited} |" in text
                assert cited in known or cited.split(".")[0] in known or tests, f"{path}: {name}.md {cited}"


PRIVATE = re.compile(
    r"\bshared/|\b(?:ALGORITHMS|LAS-WAVEFORMS)\b|\b(?:ARCHITECTURE|HOUSE|PRODUCT|PULSEWAVES|PEERS)\.md\b"
)


@pytest.mark.parametrize("folder", ["wavebatch", "tests", "docs", "examples", ""], ids=lambda name: name or "top")
def test_nothing_cites_what_is_not_shipped(folder):
    """The specification is docs/algorithms.md and docs/las-waveforms.md; earlier notes are not in the repository."""
    found = (ROOT / folder).rglob("*") if folder else ROOT.glob("*")
    bad = []
    for path in found:
        text = path.suffix in {".py", ".md", ".toml", ".yml", ".cff"} or path.name == "Makefile"
        if text and path != Path(__file__).resolve():
            lines = enumerate(path.read_text("utf-8").splitlines(), 1)
            bad += [f"{path.relative_to(ROOT)}:{number}" for number, line in lines if PRIVATE.search(line)]
    assert bad == []


def install(folder: Path, text: str) -> None:
    """What pip would leave of a package whose pyproject.toml has this text: its metadata, for entry points."""
    project = tomllib.loads(text)["project"]
    info = folder / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in points.items()) for group, points in groups]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def extended(tmp_path_factory, tiny_strip) -> Path:
    """A folder with the files of extending.md and a strip."""
    folder = tmp_path_factory.mktemp("extending")
    for name, text in blocks("extending.md").items():
        if "." in name:
            (folder / name).write_text(text, "utf-8")
    install(folder, (folder / "pyproject.toml").read_text("utf-8"))
    shutil.copy(tiny_strip, folder / "strip.las")
    return folder


def run_in(folder: Path, *words: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join([str(ROOT), str(folder)])
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
    )


@pytest.mark.slow
def test_a_stage_and_a_column_of_another_package_are_used(extended):
    for line in blocks("extending.md")["commands"].splitlines():
        done = run_in(extended, "-m", *line.split())
        assert done.returncode == 0, done.stderr
        if line.startswith("wavebatch stages"):
            assert "Amplitude of each echo over the noise" in done.stdout and "largest" in done.stdout
    done = run_in(extended, "use_it.py")
    assert done.returncode == 0, done.stderr
    assert 0 < float(done.stdout.split()[1]) <= 100


def test_a_new_command_is_found_and_runs(extended, monkeypatch):
    name, row = next(iter(eval("{" + blocks("extending.md")["row"] + "}").items()))  # noqa: S307 - our own page
    monkeypatch.syspath_prepend(str(extended))
    monkeypatch.setitem(COMMANDS, name, (row[0].removeprefix("wavebatch.cli."), row[1]))
    runner = CliRunner()
    assert row[1] in runner.invoke(main, ["--help"]).stdout
    cloud = extended / "out" / "strip.laz"
    result = runner.invoke(main, ["run", str(extended / "strip.las"), "-o", str(cloud.parent), "--quiet"])
    assert result.exit_code == 0, result.output
    result = runner.invoke(main, [name, str(cloud), "--flag", "NO_WAVEFORM"])
    assert result.exit_code == 0 and int(result.stdout.split()[1]) > 0
    result = runner.invoke(main, [name, str(extended / "nothing.laz")])
    assert result.exit_code == 1 and result.stderr.count("\n") == 1


def test_a_wheel_holds_all_and_works_outside_the_repository(tmp_path):
    # Not imported: setuptools replaces distutils, of which it and later tests of this process would warn.
    setuptools = importlib.util.find_spec("setuptools")
    if setuptools is None or int(importlib.metadata.version("setuptools").partition(".")[0]) < 77:
        pytest.skip("building a wheel needs setuptools 77")
    source, wheels, away = tmp_path / "source", tmp_path / "wheels", tmp_path / "away"
    ignored = shutil.ignore_patterns(".*", "site", "demo", "bench", "build", "dist", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, source, ignore=ignored)
    wheels.mkdir()
    code = f"import sys, setuptools.build_meta as b; b.build_wheel({str(wheels)!r})"
    environment = {**os.environ, "PYTHONPATH": str(Path(setuptools.origin).parent.parent)}
    done = subprocess.run([sys.executable, "-c", code], cwd=source, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = wheels.glob("wavebatch-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(away)
    assert {"wavebatch/py.typed", f"wavebatch/kernels/{LIBRARY.name}"} <= names
    assert not [name for name in names if name.startswith("wavebatch/kernels/c/")]  # it would be compiled once more
    assert {f"wavebatch/stages/profiles/{name}.toml" for name in list_profiles()} <= names
    assert any(name.endswith("/licenses/LICENSE") for name in names)
    assert not [name for name in names if not re.match(r"wavebatch(-[\w.]+\.dist-info)?/", name)]
    # Where the repository is installed as an editable package, its path must not come before the wheel's.
    code = (
        "import wavebatch, sys; from wavebatch.stages.chain import list_profiles, load_profile; "
        "from wavebatch.kernels.library import load; load(); "
        "print(wavebatch.__file__); [load_profile(name) for name in list_profiles()]"
    )
    environment = {**os.environ, "PYTHONPATH": str(away)}
    done = subprocess.run([sys.executable, "-c", code], cwd=away, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(away)


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("mkdocstrings", reason="needs the extra docs: pip install '.[docs]'")
    pytest.importorskip("material", reason="needs the extra docs: pip install '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    site = tmp_path / "site"
    pages = {str(page.relative_to(site).with_suffix("")): page.read_text("utf-8") for page in site.rglob("*.html")}
    assert {str(page.relative_to(DOCS).with_suffix("")) for page in PAGES} <= pages.keys()
    assert all(f"wavebatch {name}" in pages["cli"] for name in COMMANDS)
    assert all(name in pages["stages"] for name in STAGES)
    # Nothing is loaded from another host.
    loaded = re.findall(r'<(?:script|link|img)\b[^>]*?(?:src|href)="((?:https?:)?//[^"]+)"', "".join(pages.values()))
    assert loaded == []


TEXT = (ROOT / "README.md").read_text("utf-8")


def test_it_is_short():
    assert len(TEXT.splitlines()) <= 250


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_is_described(name):
    assert f"| `wavebatch {name}` |" in TEXT


def test_profiles_are_named():
    for name in (*list_profiles(), "auto"):
        assert f"`{name}`" in TEXT


def test_the_first_commands_are_two_targets_of_the_makefile():
    block = re.search(r"## Try it\n\n((?:    .*\n)+)", TEXT).group(1)
    commands = [line.split("#")[0].split() for line in block.splitlines()]
    assert commands == [["make", "demo"], ["make", "test"]]
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in re.findall(r"`?make ([a-z]+)", TEXT):
        assert re.search(rf"(?m)^{target}:", makefile), target


def test_the_python_example_uses_public_names():
    names = set(re.findall(r"\bwb\.(\w+)", TEXT))
    assert len(names) > 4 and names <= set(wavebatch.__all__)


def test_versions_agree():
    for name in ("CITATION.cff", "CHANGELOG.md"):
        assert wavebatch.__version__ in (ROOT / name).read_text("utf-8")


HELD = ROOT / "tests" / "reliability_tests.txt"


def split_sentences(text):
    """The sentences of a Markdown text, each on one line; rows of a table and items of a list are split too."""
    text = re.sub(r"```.*?```|(?m:^    [^\n]*$)", "", text, flags=re.DOTALL)
    found = []
    for block in re.split(r"\n\s*\n|\n(?=- |\|)", text):
        line = " ".join(block.split())
        if line and not line.startswith("#") and not set(line) <= set("|- "):
            found += re.split(r"(?<=[.])\s+(?=[A-Z`*-])", line.removeprefix("- "))
    return found


def read_held():
    """The tests of each sentence."""
    held = {}
    for line in HELD.read_text("utf-8").splitlines():
        if line.startswith("    "):
            held[sentence].append(line.strip())  # noqa: F821 - of the line before
        elif line and not line.startswith("#"):
            sentence = line
            assert sentence not in held, sentence
            held[sentence] = []
    return held


def test_every_sentence_of_what_can_be_relied_on_has_its_tests():
    sentences = split_sentences((ROOT / "docs" / "reliability.md").read_text("utf-8"))
    held = read_held()
    missing = [sentence for sentence in sentences if sentence not in held]
    assert not missing, f"no test is named for {missing}; add the sentence and its tests to {HELD.name}"
    gone = [sentence for sentence in held if sentence not in sentences]
    assert not gone, f"no sentence of the document any more: {gone}"
    assert all(held.values()), [sentence for sentence, tests in held.items() if not tests]


@functools.cache
def _tree(path):
    return ast.parse(path.read_text("utf-8"))


def test_the_named_tests_exist_and_assert_something():
    for sentence, tests in read_held().items():
        for test in tests:
            if test.startswith("fact: "):
                continue
            path, _, name = test.partition("::")
            tree = _tree(ROOT / path)
            found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
            found = [node for node in found if not name or node.name == name]
            assert found, f"{test}, which should hold {sentence!r}, is not there"
            for node in found:
                helpers = {one.name for one in tree.body if isinstance(one, ast.FunctionDef) and _asserts(one)}
                helpers |= {"pytest.raises", "refuses", "fail"}
                calls = {ast.unparse(one.func) for one in ast.walk(node) if isinstance(one, ast.Call)}
                assert _asserts(node) or calls & helpers, f"{test} asserts nothing"
                marks = " ".join(map(ast.unparse, node.decorator_list))
                assert "mark.skip(" not in marks and "xfail" not in marks, f"{test} does not run"


def _asserts(node):
    return any(isinstance(one, ast.Assert) for one in ast.walk(node))
