"""Chain files, and stages of other packages: `prepare`, the API and the commands that show chains call it.

TOML text becomes a checked Chain, and a Chain text that names every parameter.

Stages of other installed packages are found through the entry-point group `wavebatch.stages`: an entry point names a
module that registers its stages with `@wavebatch.stage` when it is imported. Nothing is imported before a chain names
an unknown stage or the stages are listed, so that plugins cost nothing when none is used.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wavebatch.core.errors import ConfigError, nearest
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import TomlTable, check_range, check_type, format_toml, format_toml_value, parse_toml
from wavebatch.stages.chain import KINDS, STAGES, Chain, Step

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


_SHIPPED = Path(__file__).with_name("profiles")


def list_profiles() -> list[str]:
    """Return the names of the shipped chains, sorted."""
    return sorted(file.name.removesuffix(".toml") for file in _SHIPPED.iterdir() if file.name.endswith(".toml"))


def load_profile(name: str) -> Chain:
    """Load a shipped chain.

    Parameters
    ----------
    name : str
        A name of `list_profiles`.

    Returns
    -------
    Chain
        The checked chain.

    Raises
    ------
    ConfigError
        For an unknown name.
    """
    if name not in list_profiles():
        raise ConfigError(f"profile {name!r} does not exist; {nearest(name, list_profiles())}")
    return parse_chain((_SHIPPED / f"{name}.toml").read_text("utf-8"), f"profile {name}")


def load_chain_file(path: Path | str) -> Chain:
    """Load the chain of a TOML file.

    Parameters
    ----------
    path : path or str
        The file.

    Returns
    -------
    Chain
        The checked chain.

    Raises
    ------
    ConfigError
        Where the file or the chain is wrong; names file, table, key and the nearest known word.
    """
    if str(path) in ("auto", *list_profiles()) and not Path(path).exists():
        raise ConfigError(f"--chain {path}: there is no such file; the shipped chain is --profile {path}")
    return parse_chain(read_text(path, "chain file"), str(path))


def parse_chain(text: str, name: str) -> Chain:
    """Read a chain from TOML text.

    Parameters
    ----------
    text : str
        [[chain]] tables.
    name : str
        Name of the chain; every error message starts with it.

    Returns
    -------
    Chain
        The checked chain.

    Raises
    ------
    ConfigError
        Where the chain is wrong.
    """
    document = parse_toml(text, name)
    document.check_kind("chain")
    document.check_keys(["chain"])
    steps = tuple(map(_read_step, document.tables("chain")))
    return Chain(steps, name)


def effective(chain: Chain) -> str:
    """Write a chain as TOML text with every parameter as it will be used; `parse_chain` reads it back.

    Parameters
    ----------
    chain : Chain
        Any chain.

    Returns
    -------
    str
        [[chain]] tables.
    """
    return "\n".join(format_step(step.stage.name, step.effective()) for step in chain.steps)


def format_step(stage: str, parameters: Mapping[str, Any]) -> str:
    """Write one [[chain]] table as TOML text; parameters that are None are left out.

    Parameters
    ----------
    stage : str
        Name of the stage.
    parameters : mapping
        Values by name.

    Returns
    -------
    str
        The table.
    """
    return format_toml({"chain": [{"stage": stage, **parameters}]}).lstrip()


def _read_step(table: TomlTable) -> Step:
    table.check_keys(table.values, ["stage"], 'name one, for example stage = "detect.maximum"')
    name = table.get("stage", str)
    if name not in STAGES:
        failures = load_plugins()
        if name not in STAGES:
            kind = f"{name.partition('.')[0]}."
            same = [known for known in STAGES if known.startswith(kind)]
            advice = nearest(name, same or STAGES)
            if not same and advice.startswith("known"):
                advice = f"names begin with {', '.join(f'{one}.' for one in KINDS)}; `wavebatch stages` lists them"
            raise ConfigError("; ".join([f"{table.where}: unknown stage {name!r}", advice, *failures]))
    stage, where = STAGES[name], f"{table.where} ({name})"
    TomlTable(table.values, where).check_keys(["stage", *stage.parameters])
    values = {}
    for key in table.values:
        if key == "stage":
            continue
        parameter, place = stage.parameters[key], f"{where}: {key}"
        value = values[key] = check_type(table.values[key], parameter.types, place)
        if parameter.choices is not None and value not in parameter.choices:
            choices = ", ".join(map(format_toml_value, parameter.choices))
            if parameter.range is None or isinstance(value, str):
                number = "" if parameter.range is None else " or a number"
                raise ConfigError(f"{place} must be one of {choices}{number}, it is {format_toml_value(value)}")
        if parameter.range is not None and not isinstance(value, str):
            check_range(value, *parameter.range, place)
    return Step(stage, values)
