"""What surveys must do without, so that `bench --real` can compare surveys of one strip."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from wavebatch.core.frozen import frozen
from wavebatch.kernels.fit.learn_pulse import MOST_COMPONENTS


@frozen
class Trial:
    """Limits of a survey."""

    left_out: str = ""
    """Name of a shipped pulse that is not known."""
    most_components: int = MOST_COMPONENTS
    """Gaussians of a learned pulse, at most."""


ALL = Trial()
"""What surveys obey but for comparisons."""

TRIAL: ContextVar[Trial] = ContextVar("trial", default=ALL)
"""The limits that hold now."""


@contextmanager
def limit_surveys(trial: Trial) -> Iterator[None]:
    """Let all surveys within obey the limits."""
    token = TRIAL.set(trial)
    try:
        yield
    finally:
        TRIAL.reset(token)
