"""What the reader of Python for the site is told: classes of core/frozen.py are dataclasses (see mkdocs.yml)."""

from __future__ import annotations

from griffe import Class, ExprName, Extension

_DECORATORS = {"wavebatch.core.frozen.frozen", "wavebatch.core.frozen.changeable"}


class Dataclass(ExprName):
    """The decorator that the reader knows."""

    canonical_path = "dataclasses.dataclass"


class FrozenClasses(Extension):
    """Gives classes of `wavebatch.core.frozen` the constructor of a dataclass."""

    def on_class_members(self, *, cls: Class, **_: object) -> None:
        """Look at the decorators of a class that was read."""
        for one in cls.decorators:
            if getattr(one.value, "canonical_path", "") in _DECORATORS:
                one.value = Dataclass("dataclass")
