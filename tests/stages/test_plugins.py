"""Stages of other packages: an installed distribution with the entry-point group `wavebatch.stages`."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import refuses, run_command, succeed

import wavebatch as wb
from wavebatch.core.echoes import COLUMNS
from wavebatch.core.waveforms import ReceiverNoise
from wavebatch.stages import chain as chain_module
from wavebatch.stages.chain import STAGES, effective, load_plugins, parse_chain

GOOD = '''
from typing import Annotated

import numpy as np

from wavebatch import Column, EchoTable, Noise, Range, SystemPulse, WaveformBlock, stage


@stage("detect")
def first_half(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: Annotated[float, Range(0.5, 9.0)] = 5.0
) -> EchoTable:
    """One echo at the highest sample of the first half.

    Parameters
    ----------
    level : float
        Least height [noise standard deviations].
    """
    signal = block.samples[:, : block.samples.shape[1] // 2] - noise.baseline[:, None]
    row = np.flatnonzero(signal.max(axis=1) > level * noise.std)
    at = signal[row].argmax(axis=1)
    return EchoTable.build(row, at * block.spacing, signal[row, at], np.full(len(row), system.sigma_ref))


@stage("attribute", makes=(Column("skew_hint", "f4", "-", "a column of another package"),))
def skew_hint(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """A new column: amplitude over width."""
    return echoes.with_attributes(skew_hint=echoes.amplitude / echoes.sigma)
'''

CHAIN = "".join(
    f'[[chain]]\nstage = "{name}"\n'
    for name in ("noise.pooled", "detect.first_half", "decompose.gaussian", "attribute.position", "attribute.skew_hint")
)


@pytest.fixture(autouse=True)
def installed(monkeypatch, tmp_path):
    """`installed(name, source)` installs a plugin; it, its stages and columns are gone after the test."""
    columns, stages, modules = set(COLUMNS), dict(STAGES), set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)
    load_plugins.cache_clear()

    def install(name: str, source: str) -> Path:
        (tmp_path / f"{name}_stages.py").write_text(source)
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[wavebatch.stages]\n{name} = {name}_stages\n")
        return tmp_path

    yield install
    load_plugins.cache_clear()
    STAGES.clear()
    STAGES.update(stages)
    for name in COLUMNS.keys() - columns:
        del COLUMNS[name]
    for name in sys.modules.keys() - modules:
        if name.endswith("_stages"):
            del sys.modules[name]


def test_a_chain_may_name_stages_of_a_plugin(installed):
    installed("mine", GOOD)
    chain = parse_chain(CHAIN, "mine.toml")
    assert chain.steps[1].stage.parameters["level"].range == (0.5, 9.0)
    assert effective(parse_chain(effective(chain), "again")) == effective(chain)
    samples = np.full((3, 40), 12, np.uint8)
    samples[1, 9:12] = (40, 90, 40)
    table = chain.run(wb.WaveformBlock.from_samples(samples), wb.SystemPulse(1.0, noise=ReceiverNoise(baseline=12.0)))
    assert table.waveform.tolist() == [1] and len(table.attributes["skew_hint"]) == 1


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import no_such_module_at_all", "ModuleNotFoundError: No module named 'no_such_module_at_all'"),
        ("raise SystemExit('three\\nlines\\nof it')", "SystemExit: three lines of it"),
        (GOOD + "\n\n@stage('detect')\ndef bad(block):\n    '''Nothing.'''\n", "StageError: stage detect.bad takes"),
    ],
)
def test_a_plugin_that_fails_to_import_is_named_in_one_line(installed, source, words):
    installed("poor", source)
    known = set(STAGES)
    with pytest.raises(wb.ConfigError) as caught:
        parse_chain(CHAIN, "mine.toml")
    message = str(caught.value)
    assert "\n" not in message and message.startswith("mine.toml: [[chain]] 2: unknown stage 'detect.first_half'; ")
    assert "plugin poor (poor_stages) cannot be imported: " in message and words in message
    assert set(STAGES) == known


def test_a_chain_without_plugins_imports_none(installed):
    installed("poor", "raise RuntimeError('imported')")
    assert wb.load_chain("accurate").steps
    refuses(wb.ConfigError, "unknown key", parse_chain, '[[chain]]\nstage = "noise.pooled"\nguad = 3.0\n', "x")
    assert "poor_stages" not in sys.modules


def test_the_list_of_stages_has_those_of_plugins_and_a_warning_for_poor_ones(installed):
    installed("mine", GOOD)
    installed("poor", "1 / 0")
    result = run_command("stages")
    assert result.exit_code == 0 and "detect.first_half" in result.stdout
    warning = "warning: plugin poor (poor_stages) cannot be imported: ZeroDivisionError: division by zero\n"
    assert result.stderr == warning
    assert "level (number, 0.5 to 9, default 5.0): Least height" in succeed("stages", "detect.first_half").stdout


def test_a_run_with_a_plugin_in_other_processes_writes_its_column(installed, tiny_strip, tmp_path):
    folder = installed("mine", GOOD)
    (tmp_path / "chain.toml").write_text(CHAIN)
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); from wavebatch.cli import main; main()"
    command = ["run", str(tiny_strip), "-o", str(tmp_path / "out"), "--chain", str(tmp_path / "chain.toml")]
    subprocess.run([sys.executable, "-c", code, *command, "--jobs", "2", "-q"], check=True)
    cloud = wb.read_cloud(tmp_path / "out" / "tiny.laz")
    assert np.isfinite(cloud["skew_hint"]).any()
    report = json.loads((tmp_path / "out" / "tiny.report.json").read_text())
    assert "detect.first_half" in report["chain"]
    assert chain_module.STAGES is STAGES
