"""The three errors of wavebatch, what they suggest, and the warnings about a strip.

All rooms raise the errors; each is also the builtin error that a caller would expect, and the command line prints it as
one line. Any other exception is a bug.

Where an optional package is missing, the advice is a command that works from how wavebatch itself was installed: the
package index does not have wavebatch with its extras, and the `pip` that a shell finds may be that of another Python
than the one that runs wavebatch.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterable
from types import ModuleType

from wavebatch.core.frozen import frozen


class ConfigError(ValueError):
    """A chain file, option or parameter is wrong; nothing has been started."""


class InputError(OSError):
    """A file cannot be read as what it claims to be, or an output cannot be written."""


class StageError(RuntimeError):
    """A stage broke its contract while a block ran through it: a bug, which is never hidden."""


def nearest(word: str, known: Iterable[str]) -> str:
    """`did you mean 'x'?` where a known word is similar or begins so, otherwise the list of known words."""
    import difflib

    known = list(known)
    near = difflib.get_close_matches(word, known, 1) or [one for one in known if word and one.startswith(word)]
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known are {', '.join(known)}" if known else "none is known"


WARNINGS = {
    "header": "header, descriptors or the place of the packets are wrong; the strip is read all the same",
    "packets": "packets, or the vectors of their points, are unusual; they are used",
    "lost-points": "the header claims fewer points than the file seems to hold: the others are not read",
    "lost-packets": "points whose packets cannot be used: they are written without attributes",
    "lost-samples": "packets are longer than their descriptor gives, or their sizes are no bytes: the rest is not read",
    "foreign-packets": "the packets, or the return locations, do not belong to the points",
    "repeated": "packets may be of one pulse though their times do not say so: its echoes are written once for each",
    "empty": "no points, no waveforms or no echoes",
    "nothing-selected": "the selection leaves no point",
    "pulse-guess": "the survey knows the pulse too little: widths, errors and the number of echoes depend on it",
    "noise-guess": "the survey knows noise or misfit too little: errors and the number of echoes depend on it",
    "forced-system": "the survey of --system contradicts the strip",
    "false-echoes": "the chain that was asked for does not fit the pulse: many of its echoes are false",
    "failed-fits": "far more fits than usual did not converge, or ended at a bound",
    "ground": "the strip has points of the ground only, so that all that its packets show beside them has its class",
    "no-value": "a column that --columns names has no value in the whole cloud",
    "calibration": "the calibration does not quite fit the strip, or its constant is less certain",
    "energy": "the energies of the pulses are not known as those of the calibration are",
    "reflectance": "more reflectances above 1 than surfaces explain",
    "beam": "the divergence contradicts the widths of the echoes",
    "zone": "echoes may have been taken for those of another pulse, so that ranges are off by hundreds of metres",
    "units": "coordinates may be wrong, in other units than the vectors of the packets, or returns off their rays",
    "dropped-records": "records of the strip that its cloud does not have",
}
"""What makes results of a strip doubtful, by a code that stays the same in later versions."""

OF_FILES = ("header", "packets", "dropped-records")
"""Codes of what is odd about a file, while the results are as good as usual: --quiet hides them. Others say that what
is written is less sure, or less, than its inputs promise."""


@frozen(order=True)
class StripWarning:
    """What makes results of a strip doubtful: a code of WARNINGS, and a line with the figures and the remedy."""

    code: str
    text: str

    def __post_init__(self) -> None:
        if self.code not in WARNINGS:
            raise ValueError(f"{self.code!r} is no code of a warning")

    @classmethod
    def of(cls, code: str, lines: Iterable[str]) -> tuple[StripWarning, ...]:
        """Return a warning for each line."""
        return tuple(cls(code, line) for line in lines)


PACKAGES = {
    "matplotlib": "matplotlib>=3.8",
    "pyproj": "pyproj>=3.6",
    "rasterio": "rasterio>=1.3",
    "distributed": "distributed>=2024.1",
    "pandas": "pandas>=2.0",
}
"""What pyproject.toml asks for of each optional package; `tests/test_docs.py` compares them."""


def need(package: str, complain: Callable[[str], Exception]) -> ModuleType:
    """Return an optional package; where it is missing, raise the error that `complain` makes of how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise complain(advise_install(package)) from error


def advise_install(package: str) -> str:
    """Return the command that installs a package of PACKAGES where this Python finds it."""
    import importlib.util
    import shlex
    import shutil  # only where a package is missing

    wanted = shlex.quote(PACKAGES[package])
    if importlib.util.find_spec("pip") is None:
        return f"uv pip install --python {shlex.quote(sys.executable)} {wanted}"  # environments of uv have no pip
    found, here = (os.path.dirname(os.path.abspath(path or "/")) for path in (shutil.which("pip"), sys.executable))
    if found == here:
        return f"pip install {wanted}"
    return f"{shlex.quote(sys.executable)} -m pip install {wanted}"
