"""Base of the classes that hold files: as a context manager each calls its `close`.

Readers of strips and clouds and the temporary stores use it; writers abort instead (see `PointFile`).
"""

from __future__ import annotations

from contextlib import AbstractContextManager


class Closing(AbstractContextManager):
    """A context manager that calls `close` at its end."""

    def __exit__(self, *error: object) -> None:
        self.close()
