"""What shells offer after TAB: names of files, profiles, flags, columns, stages and scenes.

Options and arguments of `wavebatch.cli` have one of these as `shell_complete`. Each is called in a process that runs
for one key press: modules are imported only when they are needed, and no file is opened.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

import click
from click.shell_completion import CompletionItem


def complete_files(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Let the shell complete file names; those of lists, which begin with `@`, are found here.

    bash ends a word at `@`: it gives the sign as an argument of its own, but replaces it too.
    """
    given = context.params.get(parameter.name or "") if context is not None else None
    apart = isinstance(given, tuple) and bool(given) and str(given[-1]) == "@"
    if not (apart or incomplete.startswith("@")):
        return [CompletionItem(incomplete, type="file")]
    folder, start = os.path.split(incomplete.removeprefix("@"))
    try:
        entries = sorted(os.scandir(folder or "."), key=lambda entry: entry.name)
    except OSError:
        return []
    found = []
    for entry in entries:
        if entry.name.startswith(start) and (start or not entry.name.startswith(".")):
            found.append(CompletionItem("@" + os.path.join(folder, entry.name) + "/" * entry.is_dir()))
    return found


def complete_profiles(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the shipped chains and auto."""
    from wavebatch.stages.chain_file import list_profiles

    return [name for name in ("auto", *list_profiles()) if name.startswith(incomplete)]


def complete_flags(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the last of several flags with commas."""
    from wavebatch.core.echoes import EchoFlag

    return _complete_last(incomplete, (flag.name or "" for flag in EchoFlag), upper=True)


def complete_written(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the last of several columns that `run` can write, with commas, each with or without `+`."""
    from wavebatch.core.echoes import COLUMNS

    names = [name for name, column in COLUMNS.items() if column.extra_bytes]
    last = incomplete.rpartition(",")[2]
    return _complete_last(incomplete, (f"+{name}" for name in names) if last.startswith("+") else names)


def complete_columns(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete columns that clouds of wavebatch usually have."""
    from wavebatch.core.echoes import COLUMNS

    standard = ("x", "y", "z", "intensity", "return_number", "number_of_returns", "classification", "scan_angle",
                "user_data", "point_source_id", "gps_time")  # fmt: skip
    names = [*(name for name, column in COLUMNS.items() if column.extra_bytes), *standard]
    return [name for name in dict.fromkeys(names) if name.startswith(incomplete)]


def complete_stages(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the names of stages, those of other packages too."""
    from wavebatch.stages.chain import STAGES
    from wavebatch.stages.plugins import load_plugins

    load_plugins()
    return sorted(name for name in STAGES if name.startswith(incomplete))


def complete_scenes(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the scenes of `simulate` and `bench`."""
    from wavebatch.tools.simulate.scenes import OTHER_NAMES, SCENES

    return [name for name in (*SCENES, *OTHER_NAMES) if name.startswith(incomplete)]


def _complete_last(incomplete: str, names: Iterable[str], *, upper: bool = False) -> list[str]:
    """Complete the part after the last comma; names that stand before it are not offered again."""
    before, comma, last = incomplete.rpartition(",")
    last = last.upper() if upper else last
    given = {(part.upper() if upper else part).lstrip("+") for part in before.split(",")}
    return [f"{before}{comma}{name}" for name in names if name.startswith(last) and name.lstrip("+") not in given]
