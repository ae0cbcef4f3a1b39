"""Advice how to install an optional package: a command that works from how wavebatch itself was installed.

`pip install 'wavebatch[plot]'` looks for wavebatch in the package index, which does not have it. And the `pip` that a
shell finds may be that of another Python than the one that runs wavebatch.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import shlex
import shutil
import sys
from collections.abc import Callable
from types import ModuleType

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
    wanted = shlex.quote(PACKAGES[package])
    if importlib.util.find_spec("pip") is None:
        return f"uv pip install --python {shlex.quote(sys.executable)} {wanted}"  # environments of uv have no pip
    found, here = (os.path.dirname(os.path.abspath(path or "/")) for path in (shutil.which("pip"), sys.executable))
    if found == here:
        return f"pip install {wanted}"
    return f"{shlex.quote(sys.executable)} -m pip install {wanted}"
