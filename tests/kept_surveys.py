"""One survey per sample of a strip and test process, for the tests of everything but surveys.

Nearly every test that runs a strip surveys it first, which takes ten times as long as the run. A survey depends on the
sampled waveforms alone: in the fast tests the second survey of the same sample is a copy of the first. Tests of
surveys, in tests/surveying, and `make test-all` measure every survey anew.
Called by conftest.
"""

import functools
import hashlib
import pickle

active = False
"""Whether the test that runs now may get a copy."""


def keep(function):
    """The function; called again with the same values it returns a copy of what it returned before."""
    known = {}

    @functools.wraps(function)
    def kept(values, *arguments, **options):
        if not active:
            return function(values, *arguments, **options)
        values = values if hasattr(values, "samples") else list(values)  # a block, or blocks
        key = hashlib.sha256(pickle.dumps((values, arguments, options))).digest()
        if key not in known:
            known[key] = pickle.dumps(function(values, *arguments, **options))
        return pickle.loads(known[key])

    return kept


def install():
    """Keep what is measured on a sample wherever a strip is prepared."""
    from wavebatch.surveying import choose_chain, flight
    from wavebatch.tools.api import strip

    for module in choose_chain, flight, strip:
        module.survey_blocks = keep(module.survey_blocks)
    choose_chain.predict_errors = keep(choose_chain.predict_errors)
