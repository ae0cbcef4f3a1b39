"""RunReport: counts and quality of a unit, a strip or a batch, apart from timing.

`output_rows` makes one per unit, `strip_task` adds them up and checks the sums, `report_file` writes and reads them.
Before you change it: `a + b` must be exact and independent of order, so histograms hold counts, never quantiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field, fields
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import StageError, StripWarning
from wavebatch.core.frozen import frozen
from wavebatch.core.process import Seconds
from wavebatch.core.units import FWHM_PER_SIGMA

COUNTS: dict[str, str] = {
    "points_in": "points of the strip",
    "points_with_waveform": "points whose packet, or their echo in another packet of their pulse, can be read",
    "points_without_waveform": "the other points without a packet (descriptor index 0 or packet size 0)",
    "points_broken": "points whose packet lies outside the file or does not fit its descriptor",
    "points_cut": "those of points_broken whose packet lies past the end of the file, which is incomplete",
    "waveforms": "packets that went through the chain, each once however many points share it",
    "echoes": "echoes found in them",
    "matched_returns": "points whose echo was found",
    "unmatched_returns": "points in a packet with echoes, but without an echo of their own; passed through",
    "no_echo_returns": "points in a packet without any echo; passed through",
    "added_echoes": "echoes that the input does not have as a return",
    "points_out": "points written",
}
"""Every count of a report and its meaning."""

LEFT_OUT: dict[str, str] = {
    "drop_flags": "have a flag of --drop-flags",
    "classes": "are of no class of --classes",
    "bbox": "lie outside --bbox",
    "polygon": "lie outside --polygon",
    "where": "do not meet --where",
}
"""Why rows are not written, in the order in which they are asked: a row counts for the first reason."""

OVERFLOW = 16
"""Waveforms with this many echoes or more are counted together."""

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@frozen
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

_NUMBERS = {name: name for name in ("copied_echoes", "ground_points", "strayed_returns", "unseen_returns")}
_NUMBERS |= {"above_one": "reflectance_above_one", "last_left_out": "last_echoes_left_out"}
"""Numbers of the quality of a report: field, and key of the file."""


@frozen(eq=False)
class RunReport:
    """Counts and quality of a unit, a strip or a batch; `a + b` merges two."""

    counts: Mapping[str, int] = field(default_factory=dict)
    """By name in COUNTS; a missing one is 0."""
    passed_through: Mapping[str, int] = field(default_factory=dict)
    """Points without attributes, by the flag with the reason; a selection may leave some of them out."""
    left_out: Mapping[str, int] = field(default_factory=dict)
    """Points that a selection leaves out, by reason in LEFT_OUT."""
    flags: Mapping[str, int] = field(default_factory=dict)
    """Points written per flag."""
    no_data: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """Echoes per column that can lack values and per reason of NoData; KNOWN counts those with a value."""
    above_one: int = 0
    """Echoes that reflect more than a white matt surface, level or facing the sensor."""
    last_left_out: int = 0
    """Points of left_out["where"] that are the last echo of their pulse."""
    strayed_returns: int = 0
    """Returns in stretches where too few match an echo of their packet."""
    unseen_returns: int = 0
    """Returns with an intensity whose packet holds no echo at all."""
    copied_echoes: int = 0
    """Echoes that do not count, because another packet of their pulse has them too."""
    ground_points: int = 0
    """Points of the strip of class 2."""
    remarks: tuple[str, ...] = ()
    """Lines about the strip as a whole, from `report_file`."""
    warnings: tuple[StripWarning, ...] = ()
    """What makes the results doubtful, from `report_file`."""
    echoes_per_waveform: np.ndarray = field(default_factory=lambda: np.zeros(OVERFLOW + 1, np.int64))
    amplitude: np.ndarray = field(default_factory=lambda: np.zeros(AMPLITUDE_BINS.number, np.int64))
    """Echoes per bin of AMPLITUDE_BINS."""
    echo_width: np.ndarray = field(default_factory=lambda: np.zeros(WIDTH_BINS.number, np.int64))
    """Echoes per bin of WIDTH_BINS."""
    timing: Mapping[str, Seconds] = field(default_factory=dict)
    """By task, summed over all processes."""

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

    @property
    def is_incomplete(self) -> bool:
        """Whether packets were missing: the cloud is to be made again once their file is whole."""
        return self.count("points_cut") > 0

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
        counts = self.to_json()["counts"]
        totals = [(name, sum(parts.values())) for name, parts in list_sums(counts, points).items()]
        totals.append(("waveforms", int(self.echoes_per_waveform.sum())))
        totals += [("echoes", sum(reasons.values())) for reasons in self.no_data.values()]
        totals.append(("points_cut", min(counts["points_cut"], counts["points_broken"])))
        for name, total in totals:
            if counts[name] != total:
                raise StageError(
                    f"{where}: {name} is {counts[name]} but its parts add up to {total}; nothing was written for this "
                    "strip, please report it as a bug"
                )

    def to_json(self) -> dict[str, Any]:
        """Return counts and quality as plain values, without timing."""
        histograms: dict[str, Any] = {}
        for name, counts in (("amplitude_dn", self.amplitude), ("echo_width_ns", self.echo_width)):
            bins, filled = _BINS[name], np.flatnonzero(counts)
            first, last = (int(filled[0]), int(filled[-1])) if len(filled) else (0, -1)
            numbers = {"first_bin": first, "counts": [int(n) for n in counts[first : last + 1]]}
            histograms[name] = {f"p{round(100 * share):02d}": bins.quantile(counts, share) for share in QUANTILES}
            histograms[name]["histogram"] = {**numbers, "low": bins.low, "log_step": bins.step}
        return {
            "counts": {
                **{name: self.count(name) for name in COUNTS},
                "passed_through": {name: self.passed_through.get(name, 0) for name in _PASSED},
                "left_out": {name: self.left_out.get(name, 0) for name in LEFT_OUT},
                "flags": {name: self.flags.get(name, 0) for name in EchoFlag.__members__},
                "no_data": {
                    column: {name: number for name, number in reasons.items() if number}
                    for column, reasons in self.no_data.items()
                },
            },
            "remarks": list(self.remarks),
            "warnings": [asdict(one) for one in self.warnings],
            "quality": {
                "echoes_per_waveform": [int(n) for n in self.echoes_per_waveform],
                **{key: getattr(self, name) for name, key in _NUMBERS.items()},
                **histograms,
            },
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> RunReport:
        """Read a report that `to_json` wrote; raises KeyError, TypeError or ValueError for any other document."""
        counts, quality = document["counts"], document["quality"]
        numbers: dict[str, Any] = {name: int(quality.get(key, 0)) for name, key in _NUMBERS.items()}
        histograms = {}
        for name, bins in _BINS.items():
            filled = quality[name]["histogram"]["counts"]
            first = quality[name]["histogram"]["first_bin"]
            histograms[name] = np.zeros(bins.number, np.int64)
            histograms[name][first : first + len(filled)] = filled
        return cls(
            counts={name: int(counts[name]) for name in COUNTS},
            passed_through={name: int(n) for name, n in counts["passed_through"].items()},
            left_out={name: int(n) for name, n in counts["left_out"].items()},
            flags={name: int(n) for name, n in counts["flags"].items()},
            no_data={
                column: {name: int(n) for name, n in reasons.items()} for column, reasons in counts["no_data"].items()
            },
            remarks=tuple(str(line) for line in document["remarks"]),
            warnings=tuple(StripWarning(str(one["code"]), str(one["text"])) for one in document["warnings"]),
            **numbers,
            echoes_per_waveform=np.array(quality["echoes_per_waveform"], np.int64).reshape(OVERFLOW + 1),
            amplitude=histograms["amplitude_dn"],
            echo_width=histograms["echo_width_ns"],
        )


_PASSED = (EchoFlag.NO_WAVEFORM.name, EchoFlag.BROKEN_PACKET.name, EchoFlag.NO_ECHO.name)


def list_sums(counts: Mapping[str, Any], points: str) -> dict[str, dict[str, int]]:
    """List the counts that are sums of others.

    Parameters
    ----------
    counts : mapping
        The `counts` of `RunReport.to_json`.
    points : str
        What was written: "echoes" or "returns".

    Returns
    -------
    dict of str to dict of str to int
        By name of the count, its parts with their numbers; what is taken away is negative.
    """
    passed = {f"passed through: {name}": number for name, number in counts["passed_through"].items()}
    left = {f"left out: {name}": -number for name, number in counts["left_out"].items()}

    def take(*names: str) -> dict[str, int]:
        return {name: counts[name] for name in names}

    without, broken, silent = (
        {name: number for name, number in passed.items() if name.endswith(f" {flag}")} for flag in _PASSED
    )
    return {
        "points_in": take("points_with_waveform", "points_without_waveform", "points_broken"),
        "points_with_waveform": take("matched_returns", "unmatched_returns", "no_echo_returns"),
        "points_without_waveform": without,
        "points_broken": broken,
        "no_echo_returns": {**silent, "unmatched_returns": -counts["unmatched_returns"]},
        "echoes": take("matched_returns", "added_echoes"),
        "points_out": {**take("echoes" if points == "echoes" else "matched_returns"), **passed, **left},
    }


def count_flags(flags: np.ndarray) -> dict[str, int]:
    """Count the rows per flag in `flags`, u2 (m,); flags that no row has are left out."""
    numbers = {name: int(np.count_nonzero(flags & np.uint16(flag))) for name, flag in EchoFlag.__members__.items()}
    return {name: number for name, number in numbers.items() if number}


def _add(a: Any, b: Any) -> Any:
    """The sum of two fields: mappings by key, lines of text without repeats, numbers and arrays as they are."""
    if isinstance(a, Mapping):
        return {name: _add(a[name], b[name]) if name in a and name in b else {**a, **b}[name] for name in {**a, **b}}
    return tuple(sorted({*a, *b})) if isinstance(a, tuple) else a + b
