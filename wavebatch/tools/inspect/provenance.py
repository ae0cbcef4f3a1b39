"""What made a cloud, from its provenance, and the command that makes it again.

`file_facts` shows it. Before you change it: it may come from any program, so nothing in it is certain.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def describe_provenance(run: Mapping[str, Any]) -> dict[str, Any]:
    """What made a cloud: version, command, chain, input; what the provenance does not hold is None."""
    return {
        "version": run.get("wavebatch"),
        "command": str(run.get("command") or "wavebatch run"),
        "input": _table(run.get("input")).get("file"),
        "chain": run.get("chain"),
        "chosen_by": _table(run.get("choice")).get("by"),
        "columns": _table(run.get("columns")),
    }


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
