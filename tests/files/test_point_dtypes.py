"""Point records are written out in wavebatch: they are laspy's, and a run needs no laspy."""

import os
import subprocess
import sys

import laspy
import pytest

from wavebatch.files.las.header import STANDARD_DTYPES, list_dimensions


@pytest.mark.parametrize("number", range(11))
def test_fields_and_dimensions_are_those_of_laspy(number):
    known = laspy.PointFormat(number)
    assert STANDARD_DTYPES[number] == known.dtype()
    assert list_dimensions(number) == tuple(known.dimension_names)


def test_a_run_imports_only_what_it_uses(tmp_path):
    """laspy imports an HTTP client, which took a sixth of the start of every process; the others a tenth each."""
    for words in ("simulate mixed -o a.laz --pulses 300", "survey a.laz -o a.toml"):
        command = [sys.executable, "-m", "wavebatch", *words.split()]
        subprocess.run(command, check=True, cwd=tmp_path, capture_output=True)
    code = """
import sys
from wavebatch.cli import main
try:
    main.main("run a.laz --system a.toml -o clouds -q".split())
except SystemExit as end:
    assert not end.code
print(*sys.modules)
"""
    # To explain a variable that is no setting of ours, all commands are loaded.
    known = {name: value for name, value in os.environ.items() if not name.startswith("WAVEBATCH_")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=known, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "wavebatch.batch.unit" in loaded
    assert not {"laspy", "requests", "urllib3", "numpy.ma", "scipy", "dask"} & loaded
