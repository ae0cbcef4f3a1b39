"""One survey per sample of a strip and session, for the tests of everything but surveys.

Nearly every test that runs a strip surveys it first, which takes ten times as long as the run. A survey depends on the
sampled waveforms alone: in the fast tests the second survey of the same sample is a copy of the first. The processes
of a session share a folder of surveys: those of xdist, and those in which the fuzzer runs its cases.
Tests of surveys, in tests/surveying without the mark `kept_surveys`, and `make slow` measure every survey anew.
Called by conftest.
"""

import functools
import hashlib
import os
import pickle
import shutil
import tempfile
from pathlib import Path

active = False
"""Whether the test that runs now may get a copy."""

_FOLDER = "KEPT_SURVEYS"
"""Variable of the environment with the folder of the session."""


def keep(function):
    """The function; called again with the same values it returns a copy of what it returned before."""

    @functools.wraps(function)
    def kept(values, *arguments, **options):
        if not active:
            return function(values, *arguments, **options)
        values = values if hasattr(values, "samples") else list(values)  # a block, or blocks
        asked = pickle.dumps((function.__qualname__, values, arguments, options))
        path = Path(os.environ[_FOLDER], hashlib.sha256(asked).hexdigest())
        if not path.exists():
            result = pickle.dumps(function(values, *arguments, **options))
            whole = path.with_name(f"{path.name}.{os.getpid()}")
            whole.write_bytes(result)
            whole.replace(path)
        return pickle.loads(path.read_bytes())

    return kept


def install(config):
    """Keep what is measured on a sample wherever a strip is prepared."""
    from wavebatch.surveying import flight, predict_error, survey

    if _FOLDER not in os.environ:  # the first process of the session; the others inherit the variable
        os.environ[_FOLDER] = tempfile.mkdtemp(prefix="wavebatch-tests-")
        config.add_cleanup(lambda: shutil.rmtree(os.environ.pop(_FOLDER), ignore_errors=True))
    for module in survey, flight:
        module.survey_blocks = keep(module.survey_blocks)
    predict_error.predict_errors = keep(predict_error.predict_errors)
