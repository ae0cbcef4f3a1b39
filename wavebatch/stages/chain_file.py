"""Chain files: TOML text to a checked Chain, and a Chain to text that names every parameter.

A chain file holds only what changes the result: no paths, no number of processes. Shipped chains are in `profiles/`.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.stages.chain import Chain, Parameter, Stage, Step
from wavebatch.stages.plugins import find_stage

_TYPE_WORDS = {int: "an integer", float: "a number", bool: "true or false", str: "a string", type(None): "nothing"}


def list_profiles() -> list[str]:
    """Return the names of the shipped chains, sorted."""
    return sorted(file.name.removesuffix(".toml") for file in _shipped().iterdir() if file.name.endswith(".toml"))


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
    return parse_chain((_shipped() / f"{name}.toml").read_text("utf-8"), f"profile {name}")


def load_chain(path: Path | str) -> Chain:
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
    try:
        text = Path(path).read_text("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: chain file cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: chain file is not UTF-8 text (byte {error.start})") from error
    return parse_chain(text, str(path))


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
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from error
    for key in document:
        if key != "chain":
            raise ConfigError(f"{name}: unknown table or key {key!r}; {nearest(key, ['chain'])}")
    tables = document.get("chain", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ConfigError(f"{name}: chain must be written as [[chain]] tables, one per stage")
    steps = tuple(_read_step(table, f"{name}: [[chain]] {number}") for number, table in enumerate(tables, 1))
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
    lines = ["[[chain]]", f'stage = "{stage}"']
    lines += [f"{name} = {_format_value(value)}" for name, value in parameters.items() if value is not None]
    return "\n".join(lines) + "\n"


def _shipped() -> Any:
    return resources.files("wavebatch") / "stages" / "profiles"


def _format_value(value: Any) -> str:
    if isinstance(value, bool | str):
        return json.dumps(value)
    return repr(value)


def _read_step(table: Mapping[str, Any], where: str) -> Step:
    if "stage" not in table:
        raise ConfigError(f'{where}: key stage is missing; name one, for example stage = "detect.maximum"')
    name = table["stage"]
    if not isinstance(name, str):
        raise ConfigError(f"{where}: stage must be a string, it is {name!r}")
    found = find_stage(name, where)
    where = f"{where} ({name})"
    values = {key: value for key, value in table.items() if key != "stage"}
    return Step(found, {key: _read_value(found, key, value, where) for key, value in values.items()})


def _read_value(stage: Stage, key: str, value: Any, where: str) -> Any:
    parameter = stage.parameters.get(key)
    if parameter is None:
        raise ConfigError(f"{where}: unknown key {key!r}; {nearest(key, ['stage', *stage.parameters])}")
    value = _check_type(parameter, value, f"{where}: {key}")
    if parameter.choices is not None and value not in parameter.choices:
        choices = ", ".join(_format_value(choice) for choice in parameter.choices)
        raise ConfigError(f"{where}: {key} must be one of {choices}, it is {_format_value(value)}")
    if parameter.range is not None and not parameter.range[0] <= value <= parameter.range[1]:
        low, high = parameter.range
        raise ConfigError(f"{where}: {key} must lie between {low:g} and {high:g}, it is {value!r}")
    return value


def _check_type(parameter: Parameter, value: Any, where: str) -> Any:
    """Return the value in the parameter's type: integers become numbers, nothing else is converted."""
    if float in parameter.types and isinstance(value, int) and not isinstance(value, bool):
        value = value if int in parameter.types else float(value)
    elif type(value) not in parameter.types:
        words = " or ".join(_TYPE_WORDS.get(kind, kind.__name__) for kind in parameter.types)
        raise ConfigError(f"{where} must be {words}, it is {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where} must be a finite number, it is {value!r}")
    return value
