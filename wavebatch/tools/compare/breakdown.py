"""Which echoes have no partner on the other side: by return number, amplitude, flag, and what else their pulse has."""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoFlag

_OCTAVES = 18
"""Classes of amplitude: below 1, then one per doubling; the last one takes all that is larger."""

_NUMBERS = 16

Table = dict[str, tuple[int, int]]
"""Per class: echoes without a partner, and all echoes."""


class Breakdown:
    """Counts echoes of one side with and without a partner on the other, by what may be the reason."""

    def __init__(self) -> None:
        self._tallies = {
            "return": np.zeros((_NUMBERS * _NUMBERS, 2), np.int64),
            "amplitude": np.zeros((_OCTAVES, 2), np.int64),
            "intensity": np.zeros((_OCTAVES, 2), np.int64),
            "pulse": np.zeros((2, 2), np.int64),
            "flag": np.zeros((len(EchoFlag) + 1, 2), np.int64),
        }

    def add(self, rows: np.ndarray, alone: np.ndarray, others: np.ndarray | None) -> None:
        """Takes in echoes (records of io.cloud.CLOUD_DTYPE).

        alone: those without a partner, bool (k,). others: echoes that the other side has in the pulse of each, (k,);
        None where nobody knows.
        """
        numbered = rows["number"] > 0
        code = np.minimum(rows["total"], _NUMBERS - 1) * np.int64(_NUMBERS) + np.minimum(rows["number"], _NUMBERS - 1)
        self._count("return", code[numbered], alone[numbered])
        known = ~np.isnan(rows["amplitude"])
        self._count("amplitude", _octave(rows["amplitude"][known]), alone[known])
        self._count("intensity", _octave(rows["intensity"]), alone)
        if others is not None:
            self._count("pulse", (others > 0).astype(np.int64), alone)
        for place, flag in enumerate(EchoFlag):
            has = (rows["flags"] & np.uint16(flag)) != 0
            self._count("flag", np.full(int(has.sum()), place), alone[has])
        none = rows["flags"] == 0
        self._count("flag", np.full(int(none.sum()), len(EchoFlag)), alone[none])

    def _count(self, kind: str, code: np.ndarray, alone: np.ndarray) -> None:
        tally = self._tallies[kind]
        tally[:, 0] += np.bincount(code[alone], minlength=len(tally))
        tally[:, 1] += np.bincount(code, minlength=len(tally))

    def tables(self) -> dict[str, Table]:
        """Per kind a table of its classes that have an echo; kinds of which the side knows nothing are left out.

        `intensity` only where there are no amplitudes, and not if all are 0; `flag` only if any echo has one.
        """
        names = {
            "return": [_name_return(*divmod(code, _NUMBERS)) for code in range(_NUMBERS * _NUMBERS)],
            "amplitude": _OCTAVE_NAMES,
            "intensity": _OCTAVE_NAMES,
            "pulse": ["nothing of the other side", "other echoes of the other side"],
            "flag": [*(flag.name for flag in EchoFlag), "none"],
        }
        tables = {}
        for kind, tally in self._tallies.items():
            rows = np.flatnonzero(tally[:, 1]).tolist()
            tables[kind] = {names[kind][row]: (int(tally[row, 0]), int(tally[row, 1])) for row in rows}
        if tables["amplitude"] or set(tables["intensity"]) <= {_OCTAVE_NAMES[0]}:
            del tables["intensity"]
        if set(tables["flag"]) <= {"none"}:
            del tables["flag"]
        return {kind: table for kind, table in tables.items() if table}


def _octave(values: np.ndarray) -> np.ndarray:
    """Class of amplitudes: 0 below 1, 1 from 1 to 2, 2 from 2 to 4 ..., i8 (k,)."""
    return np.clip(np.frexp(np.clip(values.astype(np.float64), 0.0, 1e9))[1], 0, _OCTAVES - 1).astype(np.int64)


_OCTAVE_NAMES = ["below 1", *(f"{1 << n}-{2 << n}" for n in range(_OCTAVES - 2)), f"from {1 << (_OCTAVES - 2)}"]


def _name_return(total: int, number: int) -> str:
    return f"{number} of {total}"
