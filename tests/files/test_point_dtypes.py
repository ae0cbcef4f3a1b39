"""Point records are written out in wavebatch: they are laspy's, and a run needs no laspy."""

import subprocess
import sys

import laspy
import pytest

from wavebatch.files.point_dtypes import STANDARD_DTYPES, list_dimensions


@pytest.mark.parametrize("number", range(11))
def test_fields_and_dimensions_are_those_of_laspy(number):
    known = laspy.PointFormat(number)
    assert STANDARD_DTYPES[number] == known.dtype()
    assert list_dimensions(number) == tuple(known.dimension_names)


def test_a_run_imports_no_laspy():
    """It imports an HTTP client, which took a sixth of the start of every process."""
    code = "import sys, wavebatch.cli.run, wavebatch.tools.api.run, wavebatch.batch.strip_task; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"laspy", "requests", "urllib3"} & set(done.stdout.split())
