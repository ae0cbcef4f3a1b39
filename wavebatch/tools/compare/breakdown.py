"""Counts of echoes without a partner, by return number, LAS class, amplitude, flags, and other echoes of their pulse.

`pairing` has one Breakdown per side. Add a class of echoes here to see it in `wavebatch compare`.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.files.las.point_formats import CLASS_NAMES

_OCTAVES = 18
"""Classes of amplitude: below 1, then one per doubling; the last one holds everything larger."""

_NUMBERS = 16
"""Return numbers that a LAS point can hold, 0 to 15."""

Table = dict[str, tuple[int, int]]
"""Per class: echoes without a partner, and all echoes."""


class Breakdown:
    """Counts echoes of one side, with and without a partner on the other side, by possible reasons."""

    def __init__(self) -> None:
        self._tallies = {kind: np.zeros((len(names), 2), np.int64) for kind, names in _NAMES.items()}

    def add(self, rows: np.ndarray, alone: np.ndarray, others: np.ndarray | None) -> None:
        """Adds echoes (k,), CLOUD_DTYPE.

        alone: echoes without a partner, bool (k,). others: number of echoes of the other side in the pulse of each
        echo, (k,); None if unknown.
        """
        numbered = rows["number"] > 0
        code = np.minimum(rows["total"], _NUMBERS - 1) * np.int64(_NUMBERS) + np.minimum(rows["number"], _NUMBERS - 1)
        self._count("return", code[numbered], alone[numbered])
        self._count("class", rows["classification"], alone)
        known = ~np.isnan(rows["amplitude"])
        self._count("amplitude", _octave(rows["amplitude"][known]), alone[known])
        self._count("intensity", _octave(rows["intensity"]), alone)
        if others is not None:
            self._count("pulse", (others > 0).astype(np.int64), alone)
        flags = [*((rows["flags"] & np.uint16(flag)) != 0 for flag in EchoFlag), rows["flags"] == 0]
        for place, has in enumerate(flags):
            self._count("flag", np.full(int(has.sum()), place), alone[has])

    def _count(self, kind: str, code: np.ndarray, alone: np.ndarray) -> None:
        tally = self._tallies[kind]
        tally[:, 0] += np.bincount(code[alone], minlength=len(tally))
        tally[:, 1] += np.bincount(code, minlength=len(tally))

    def tables(self) -> dict[str, Table]:
        """For each kind the classes that have an echo; kinds without data are left out.

        `intensity` is there only without amplitudes and if not all are 0; `flag` and `class` only if any echo has one.
        """
        tables = {}
        for kind, tally in self._tallies.items():
            rows = np.flatnonzero(tally[:, 1]).tolist()
            tables[kind] = {_NAMES[kind][row]: (int(tally[row, 0]), int(tally[row, 1])) for row in rows}
        if tables["amplitude"] or set(tables["intensity"]) <= {_OCTAVE_NAMES[0]}:
            del tables["intensity"]
        if set(tables["flag"]) <= {"none"}:
            del tables["flag"]
        if set(tables["class"]) <= {name_class(0)}:
            del tables["class"]
        return {kind: table for kind, table in tables.items() if table}


def _octave(values: np.ndarray) -> np.ndarray:
    """Classes of amplitudes: 0 below 1, 1 from 1 to 2, 2 from 2 to 4 ..., i8 (k,)."""
    return np.clip(np.frexp(np.clip(values.astype(np.float64), 0.0, 1e9))[1], 0, _OCTAVES - 1).astype(np.int64)


def name_class(number: int) -> str:
    """A LAS class with its name, if the standard has one."""
    return f"{number} {CLASS_NAMES[number]}" if number in CLASS_NAMES else str(number)


_OCTAVE_NAMES = ["below 1", *(f"{1 << n}-{2 << n}" for n in range(_OCTAVES - 2)), f"from {1 << (_OCTAVES - 2)}"]
_NAMES = {
    "return": [f"{number} of {total}" for total in range(_NUMBERS) for number in range(_NUMBERS)],
    "class": [name_class(number) for number in range(256)],
    "amplitude": _OCTAVE_NAMES,
    "intensity": _OCTAVE_NAMES,
    "pulse": ["nothing of the other side", "other echoes of the other side"],
    "flag": [*(flag.name for flag in EchoFlag), "none"],
}
"""Per kind of class the names of its classes."""
