"""Base of the classes that hold files: as a context manager each calls its `close`.

Readers of strips and clouds and the temporary stores use it; writers abort instead (see `PointFile`).
"""

from __future__ import annotations

from typing import Self


class Closing:
    """A context manager that calls `close` at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close what is open. Harmless twice."""
        raise NotImplementedError
