"""RunReport: counts and quality of a unit, a strip or a batch, apart from timing.

`output_rows` makes one per unit, `strip_task` adds them up and checks the sums, `report_file` writes and reads them.
Before you change it: `a + b` must be exact and independent of order, so histograms hold counts, never quantiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import StageError
from wavebatch.core.units import FWHM_PER_SIGMA

COUNTS: dict[str, str] = {
    "points_in": "points of the strip",
    "points_with_waveform": "points whose packet can be read",
    "points_without_waveform": "points without a packet (descriptor index 0 or packet size 0)",
    "points_broken": "points whose packet lies outside the file or does not fit its descriptor",
    "waveforms": "packets that went through the chain, each once however many points share it",
    "echoes": "echoes found in them",
    "matched_returns": "points whose echo was found",
    "unmatched_returns": "points in a packet with echoes, none of which is theirs; passed through",
    "no_echo_returns": "points in a packet without any echo; passed through",
    "added_echoes": "echoes that the input does not have as a return",
    "points_out": "points written",
}
"""Every count of a report and its meaning."""

OVERFLOW = 16
"""Waveforms with this many echoes or more are counted together."""

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True, slots=True)
class LogBins:
    """Logarithmic bins; the first and the last also count the values beyond them."""

    low: float
    step: float
    """Difference of the logarithms of two neighbouring edges."""
    number: int

    def count(self, values: np.ndarray) -> np.ndarray:
        """Count values (m,) per bin, i8 (number,); values that are not positive and finite are left out."""
        values = np.asarray(values, np.float64)
        values = values[np.isfinite(values) & (values > 0)]
        place = np.floor(np.log(values / self.low) / self.step)
        return np.bincount(np.clip(place, 0, self.number - 1).astype(np.int64), minlength=self.number)

    def quantile(self, counts: np.ndarray, share: float) -> float | None:
        """Return the centre of the bin of the quantile `share`, from counts i8 (number,); None without values."""
        total = int(counts.sum())
        if not total:
            return None
        place = int(np.searchsorted(np.cumsum(counts), share * total))
        return float(f"{self.low * np.exp((place + 0.5) * self.step):.4g}")


AMPLITUDE_BINS = LogBins(0.1, 0.02, 1240)
"""0.1 to 6e9 DN, 2 % each."""
WIDTH_BINS = LogBins(0.01, 0.01, 1200)
"""0.01 to 1600 ns, 1 % each."""
_BINS = {"amplitude_dn": AMPLITUDE_BINS, "echo_width_ns": WIDTH_BINS}


def _zeros(number: int) -> Any:
    return field(default_factory=lambda: np.zeros(number, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """Counts and quality of a unit, a strip or a batch; `a + b` merges two."""

    counts: Mapping[str, int] = field(default_factory=dict)
    """By name in COUNTS; a missing one is 0."""
    passed_through: Mapping[str, int] = field(default_factory=dict)
    """Points written without attributes, by the flag with the reason."""
    flags: Mapping[str, int] = field(default_factory=dict)
    """Points written per flag."""
    no_data: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """Echoes per column that can lack values and per reason in no_data.NoData; KNOWN counts those with a value."""
    remarks: tuple[str, ...] = ()
    """Lines about the strip as a whole, from `explain`."""
    echoes_per_waveform: np.ndarray = _zeros(OVERFLOW + 1)
    amplitude: np.ndarray = _zeros(AMPLITUDE_BINS.number)
    """Echoes per bin of AMPLITUDE_BINS."""
    echo_width: np.ndarray = _zeros(WIDTH_BINS.number)
    """Echoes per bin of WIDTH_BINS."""
    timing: Mapping[str, float] = field(default_factory=dict)
    """Seconds by task, summed over all processes."""

    def __add__(self, other: RunReport) -> RunReport:
        return RunReport(**{f.name: _add(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)})

    @classmethod
    def of_echoes(cls, per_waveform: np.ndarray, amplitude: np.ndarray, sigma: np.ndarray) -> RunReport:
        """Build the quality part.

        Parameters
        ----------
        per_waveform : i8 (n,)
            Echoes per waveform.
        amplitude : f4 (m,), count
        sigma : f4 (m,), ns

        Returns
        -------
        RunReport
        """
        clipped = np.minimum(per_waveform, OVERFLOW)
        return cls(
            echoes_per_waveform=np.bincount(clipped, minlength=OVERFLOW + 1),
            amplitude=AMPLITUDE_BINS.count(amplitude),
            echo_width=WIDTH_BINS.count(np.asarray(sigma, np.float64) * FWHM_PER_SIGMA),
        )

    def count(self, name: str) -> int:
        """Return the count of a name in COUNTS."""
        return self.counts.get(name, 0)

    def check(self, points: str, where: str) -> None:
        """Check that every point and every echo is accounted for.

        Parameters
        ----------
        points : str
            What was written: "echoes" or "returns".
        where : str
            The strip, for the message.

        Raises
        ------
        StageError
            Where a sum differs.
        """
        get, passed = self.count, self.passed_through
        sums = {
            "points_in": get("points_with_waveform") + get("points_without_waveform") + get("points_broken"),
            "points_with_waveform": get("matched_returns") + get("unmatched_returns") + get("no_echo_returns"),
            "points_without_waveform": passed.get("NO_WAVEFORM", 0),
            "points_broken": passed.get("BROKEN_PACKET", 0),
            "no_echo_returns": passed.get("NO_ECHO", 0) - get("unmatched_returns"),
            "echoes": get("matched_returns") + get("added_echoes"),
            "points_out": get("echoes" if points == "echoes" else "matched_returns") + sum(passed.values()),
            "waveforms": int(self.echoes_per_waveform.sum()),
        }
        by_reason = [("echoes", sum(reasons.values())) for reasons in self.no_data.values()]
        for name, total in [*sums.items(), *by_reason]:
            if get(name) != total:
                raise StageError(
                    f"{where}: {name} is {get(name)} but its parts add up to {total}; nothing was written for this "
                    "strip, please report it as a bug"
                )

    def to_json(self) -> dict[str, Any]:
        """Return counts and quality as plain values, without timing."""
        histograms = {"amplitude_dn": self.amplitude, "echo_width_ns": self.echo_width}
        return {
            "counts": {
                **{name: self.count(name) for name in COUNTS},
                "passed_through": {name: self.passed_through.get(name, 0) for name in _PASSED},
                "flags": {flag.name: self.flags.get(flag.name, 0) for flag in EchoFlag},
                "no_data": {
                    column: {name: number for name, number in reasons.items() if number}
                    for column, reasons in self.no_data.items()
                },
            },
            "remarks": list(self.remarks),
            "quality": {
                "echoes_per_waveform": [int(n) for n in self.echoes_per_waveform],
                **{name: _histogram_json(_BINS[name], counts) for name, counts in histograms.items()},
            },
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> RunReport:
        """Read a report that `to_json` wrote; raises KeyError, TypeError or ValueError for any other document."""
        counts, quality = document["counts"], document["quality"]
        amplitude, echo_width = (_read_histogram(_BINS[name], quality[name]) for name in _BINS)
        return cls(
            counts={name: int(counts[name]) for name in COUNTS},
            passed_through={name: int(n) for name, n in counts["passed_through"].items()},
            flags={name: int(n) for name, n in counts["flags"].items()},
            no_data={
                column: {name: int(n) for name, n in reasons.items()} for column, reasons in counts["no_data"].items()
            },
            remarks=tuple(str(line) for line in document["remarks"]),
            echoes_per_waveform=np.array(quality["echoes_per_waveform"], np.int64).reshape(OVERFLOW + 1),
            amplitude=amplitude,
            echo_width=echo_width,
        )


_PASSED = (EchoFlag.NO_WAVEFORM.name, EchoFlag.BROKEN_PACKET.name, EchoFlag.NO_ECHO.name)


def count_flags(flags: np.ndarray) -> dict[str, int]:
    """Count the rows per flag in `flags`, u2 (m,); flags that no row has are left out."""
    numbers = {flag.name: int(np.count_nonzero(flags & np.uint16(flag))) for flag in EchoFlag}
    return {name: number for name, number in numbers.items() if number}


def _add(a: Any, b: Any) -> Any:
    """The sum of two fields: mappings by key, lines of text without repeats, numbers and arrays as they are."""
    if isinstance(a, Mapping):
        return {name: _add(a[name], b[name]) if name in a and name in b else {**a, **b}[name] for name in {**a, **b}}
    return tuple(sorted({*a, *b})) if isinstance(a, tuple) else a + b


def _histogram_json(bins: LogBins, counts: np.ndarray) -> dict[str, Any]:
    filled = np.flatnonzero(counts)
    first, last = (int(filled[0]), int(filled[-1])) if len(filled) else (0, -1)
    quantiles = {f"p{round(100 * share):02d}": bins.quantile(counts, share) for share in QUANTILES}
    histogram = {"first_bin": first, "counts": [int(n) for n in counts[first : last + 1]]}
    return {**quantiles, "histogram": {**histogram, "low": bins.low, "log_step": bins.step}}


def _read_histogram(bins: LogBins, document: Mapping[str, Any]) -> np.ndarray:
    first, filled = document["histogram"]["first_bin"], document["histogram"]["counts"]
    counts = np.zeros(bins.number, np.int64)
    counts[first : first + len(filled)] = filled
    return counts
