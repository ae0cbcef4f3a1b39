"""The advice how to install a package can be typed as it is: it reaches the Python that runs wavebatch."""

import importlib.util
import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest

from wavebatch.core.errors import PACKAGES, advise_install

ROOT = Path(__file__).parents[2]


def test_versions_are_those_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = {line for name in ("plot", "gis", "cluster") for line in extras[name]}
    wanted |= {line for line in extras["test"] if line.startswith("pandas")}  # only to_frame() uses it
    assert set(PACKAGES.values()) == wanted
    assert all(re.split(r"[>=]", line)[0] == name for name, line in PACKAGES.items())


@pytest.mark.parametrize(
    ("pip", "beside", "advice"),
    [
        (True, True, "pip install 'matplotlib>=3.8'"),
        (True, False, f"{sys.executable} -m pip install 'matplotlib>=3.8'"),
        (None, True, f"uv pip install --python {sys.executable} 'matplotlib>=3.8'"),
    ],
)
def test_the_python_that_runs_wavebatch_gets_it(monkeypatch, pip, beside, advice):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: pip if name == "pip" else real(name, *more))
    where = Path(sys.executable).parent / "pip" if beside else Path("/elsewhere/bin/pip")
    monkeypatch.setattr(shutil, "which", lambda name: str(where))
    assert advise_install("matplotlib") == advice


def test_no_advice_asks_the_package_index_for_wavebatch():
    """It is not there: pip would find nothing, or a stranger's package of that name."""
    places = ("wavebatch/**/*.py", "docs/**/*.md", "*.md", "examples/**/*")
    pages = [page for place in places for page in ROOT.glob(place)]
    for page in pages:
        if page.is_file():
            found = re.findall(r"pip install[^\n]*wavebatch\[[^\n]*", page.read_text("utf-8", "replace"))
            assert not found, (page, found)
