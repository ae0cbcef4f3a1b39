"""Chains as users get them from Python: by name or path, or chosen by a survey."""

from __future__ import annotations

from pathlib import Path

from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.stages import chain_file
from wavebatch.stages.chain import Chain
from wavebatch.surveying.auto_chain import choose_chain
from wavebatch.surveying.survey import Survey

AUTO = "auto"
"""In place of a chain's name: the survey of each strip chooses the chain."""


def load_chain(name: Path | str) -> Chain:
    """Load a shipped chain by its name, or a chain file by its path.

    Parameters
    ----------
    name : path or str
        "fast", "balanced", "accurate" or another shipped chain, or the path of a TOML file. Text without a folder and
        a suffix is a name.

    Returns
    -------
    Chain
        The checked chain. `chain.run(block, system)` gives the echoes of a block.

    Raises
    ------
    ConfigError
        Where there is no such chain or it is wrong; names file, table, key and the nearest known word.
    """
    known = chain_file.list_profiles()
    if isinstance(name, Path) or Path(name).name != name or Path(name).suffix:
        return chain_file.load_chain_file(name)
    if name not in known:
        raise ConfigError(f"profile {name!r} does not exist; {nearest(name, [AUTO, *known])}")
    return chain_file.load_profile(name)


def auto_chain(survey: Survey) -> Chain:
    """Choose the cheapest chain that loses nothing on the surveyed strip.

    Parameters
    ----------
    survey : Survey
        Result of `survey`; its `decisions` give the reason for every part that is left out.

    Returns
    -------
    Chain
        The chain that `run` would choose for this strip.
    """
    return choose_chain(survey)
