"""Stages of other installed packages, found through the entry-point group `wavebatch.stages`.

An entry point names a module that registers its stages with `@wavebatch.stage` when it is imported. Nothing is imported
before a chain names an unknown stage or the stages are listed, so that plugins cost nothing when none is used.
"""

from __future__ import annotations

import functools

from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.stages.chain import KINDS, STAGES, Stage

GROUP = "wavebatch.stages"


@functools.cache
def load_plugins() -> tuple[str, ...]:
    """Import all plugins, once per process.

    Returns
    -------
    tuple of str
        One line for each plugin that cannot be imported; stages that it had registered before are removed.
    """
    from importlib.metadata import entry_points  # 20 ms that only chains with plugins need

    failures = []
    for point in entry_points(group=GROUP):
        before = set(STAGES)
        try:
            point.load()
        except (Exception, SystemExit) as error:
            for name in STAGES.keys() - before:
                del STAGES[name]
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            failures.append(f"plugin {point.name} ({point.value}) cannot be imported: {reason}")
    return tuple(failures)


def find_stage(name: str, where: str) -> Stage:
    """Look up a stage; plugins are imported when no built-in stage has the name.

    Parameters
    ----------
    name : str
        `kind.function`.
    where : str
        Start of the error message: file and table.

    Returns
    -------
    Stage
        The registered stage.

    Raises
    ------
    ConfigError
        For an unknown name, with the nearest known one and the plugins that cannot be imported.
    """
    if name not in STAGES:
        failures = load_plugins()
        if name not in STAGES:
            kind = f"{name.partition('.')[0]}."
            same = [known for known in STAGES if known.startswith(kind)]
            advice = nearest(name, same or STAGES)
            if not same and advice.startswith("known"):
                advice = f"names begin with {', '.join(f'{one}.' for one in KINDS)}; `wavebatch stages` lists them"
            raise ConfigError("; ".join([f"{where}: unknown stage {name!r}", advice, *failures]))
    return STAGES[name]
