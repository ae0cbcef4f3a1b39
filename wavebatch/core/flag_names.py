"""Flags by their names, as users write them on the command line: `SATURATED,WEAK`."""

from __future__ import annotations

from collections.abc import Sequence

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest


def read_flags(names: Sequence[str], option: str = "") -> int:
    """Return the bits of flags given by names.

    Parameters
    ----------
    names : sequence of str
        Each one name, or several separated by commas; in any case of letters.
    option : str, optional
        For the message, e.g. "--drop-flags".

    Returns
    -------
    int

    Raises
    ------
    ConfigError
        For an unknown name.
    """
    bits = 0
    for name in (part.strip().upper() for text in names for part in text.split(",")):
        if name not in EchoFlag.__members__:
            where = f"{option}: " if option else ""
            raise ConfigError(f"{where}flag {name!r} does not exist; {nearest(name, EchoFlag.__members__)}")
        bits |= int(EchoFlag[name])
    return bits
