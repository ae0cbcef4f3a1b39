"""Stages that only reproduce what the papers compare with, as a plug-in: `pip install examples/papers`.

The entry point in pyproject.toml makes wavebatch import this package when a chain names a stage that wavebatch does not
have. The scripts of this folder import it, so that nothing need be installed for them.
"""

from paper_stages import asdf_mixed, classic, gauss_newton, log_normal  # noqa: F401
