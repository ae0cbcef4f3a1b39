"""What made a cloud, from the account of the run in it, and the command that makes it again.

`file_facts` shows it. Before you change it: the account may come from any program, so nothing in it is certain.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def describe_account(account: Mapping[str, Any]) -> dict[str, Any]:
    """What made a cloud: version, command, chain, input; what the account does not hold is None."""
    return {
        "version": account.get("wavebatch"),
        "command": str(account.get("command") or "wavebatch run"),
        "input": _table(account.get("input")).get("file"),
        "chain": account.get("chain"),
        "chosen_by": _table(account.get("choice")).get("by"),
        "columns": _table(account.get("columns")),
    }


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
