"""Echoes: the table that flows through a chain, and the one declaration of its columns and flags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntFlag

import numpy as np

from wavebatch.core.errors import StageError


class EchoFlag(IntFlag):
    """What is known to be wrong or special about an echo; the bits of the `echo_flags` column."""

    NOT_CONVERGED = 1
    AT_BOUND = 2
    NEAR_EDGE = 4
    SATURATED = 8
    OVERLAPPED = 16
    WEAK = 32
    RINGING_SUSPECT = 64
    NARROW = 128
    NO_WAVEFORM = 256
    BROKEN_PACKET = 512
    NO_ECHO = 1024
    UNANCHORED = 2048
    MERGED = 4096
    ADDED = 8192
    AMPLITUDE_UNRELIABLE = 16384
    RETURN_LIMIT = 32768


FLAG_MEANINGS: dict[EchoFlag, str] = {
    EchoFlag.NOT_CONVERGED: "the fit stopped before it converged; values are the last accepted ones",
    EchoFlag.AT_BOUND: "a fitted parameter lies at the edge of its allowed range",
    EchoFlag.NEAR_EDGE: "the echo is cut by the start or the end of the waveform",
    EchoFlag.SATURATED: "samples under the echo are at the digitizer's limit",
    EchoFlag.OVERLAPPED: "fitted together with at least one neighbouring echo",
    EchoFlag.WEAK: "amplitude below 5 noise standard deviations",
    EchoFlag.RINGING_SUSPECT: "may be ringing or an after-pulse of a stronger echo before it",
    EchoFlag.NARROW: "narrower than the system pulse",
    EchoFlag.NO_WAVEFORM: "point has no waveform (descriptor index 0 or packet size 0); passed through",
    EchoFlag.BROKEN_PACKET: "packet lies outside the file or does not fit its descriptor; point passed through",
    EchoFlag.NO_ECHO: "waveform holds no echo for this point; point passed through",
    EchoFlag.UNANCHORED: "no return of the packet matches an echo; position from the raw return location",
    EchoFlag.MERGED: "two echoes too close to be told apart were merged into this one",
    EchoFlag.ADDED: "echo that the input does not have as a return",
    EchoFlag.AMPLITUDE_UNRELIABLE: "so much of the echo is saturated that its amplitude is a guess",
    EchoFlag.RETURN_LIMIT: "return number exceeds what the point format can hold; written as the largest",
}

UNCLEAN = (
    EchoFlag.OVERLAPPED | EchoFlag.MERGED | EchoFlag.SATURATED | EchoFlag.NEAR_EDGE | EchoFlag.NOT_CONVERGED
    | EchoFlag.AT_BOUND
)  # fmt: skip
"""Echoes with one of these say little of sensor and surface: their width or amplitude is not that of one echo."""

PASSED_THROUGH = EchoFlag.NO_WAVEFORM | EchoFlag.BROKEN_PACKET | EchoFlag.NO_ECHO
"""Points with one of these are not echoes that somebody found."""


@dataclass(frozen=True, slots=True)
class Column:
    """Declaration of one per-echo quantity: it feeds the README table, the LAS extra bytes and the report."""

    name: str
    dtype: str
    unit: str
    meaning: str
    no_data: float | None = -9999.0
    extra_bytes: bool = True
    """False for quantities that are LAS fields of their own (x, y, z) or never leave the program."""


def _columns(*columns: Column) -> dict[str, Column]:
    return {column.name: column for column in columns}


COLUMNS: dict[str, Column] = _columns(
    Column("amplitude", "f4", "DN", "peak of the echo above the baseline"),
    Column("echo_time", "f4", "ns", "centre of the echo after the first sample of its packet"),
    Column("echo_width", "f4", "ns", "full width at half maximum"),
    Column("energy", "f4", "DN ns", "integral of the echo over time"),
    Column("range", "f4", "m", "sensor to echo"),
    Column("cross_section", "f4", "m2", "backscatter cross section"),
    Column("backscatter_coefficient", "f4", "-", "cross section per illuminated area (gamma)"),
    Column("reflectance", "f4", "-", "diffuse reflectance"),
    Column("relative_backscatter", "f4", "DN ns m2", "not calibrated: backscatter in units of its own strip"),
    Column("relative_cross_section", "f4", "DN ns m4", "not calibrated: cross section in units of its own strip"),
    Column("relative_reflectance", "f4", "DN ns m2", "not calibrated: reflectance in units of its own strip"),
    Column("incidence_angle", "f4", "deg", "angle between ray and surface normal"),
    Column("incidence_angle_normals", "f4", "deg", "angle between ray and normal of the plane of the points around"),
    Column("range_err", "f4", "m", "one standard deviation of the echo along the ray, from the fit"),
    Column("amplitude_err", "f4", "DN", "one standard deviation of amplitude, from the fit"),
    Column("echo_width_err", "f4", "ns", "one standard deviation of echo_width, from the fit"),
    Column("incidence_angle_err", "f4", "deg", "one standard deviation of incidence_angle"),
    Column("incidence_angle_normals_err", "f4", "deg", "one standard deviation of incidence_angle_normals"),
    Column("cross_section_err", "f4", "m2", "one standard deviation of cross_section"),
    Column("backscatter_coefficient_err", "f4", "-", "one standard deviation of gamma"),
    Column("reflectance_err", "f4", "-", "one standard deviation of reflectance"),
    Column("relative_backscatter_err", "f4", "DN ns m2", "one standard deviation of relative_backscatter"),
    Column("relative_cross_section_err", "f4", "DN ns m4", "one standard deviation of relative_cross_section"),
    Column("relative_reflectance_err", "f4", "DN ns m2", "one standard deviation of relative_reflectance"),
    Column("pulse_deviation", "f4", "-", "Gauss-Hermite deviation from the system pulse, sqrt(h3^2 + h4^2)"),
    Column("echo_flags", "u2", "bits", "see the table of flags", no_data=None),
    Column("x", "f8", "m", "easting of the echo", extra_bytes=False),
    Column("y", "f8", "m", "northing of the echo", extra_bytes=False),
    Column("z", "f8", "m", "height of the echo", extra_bytes=False),
    Column("ray_x", "f4", "-", "east component of the unit vector away from the sensor", extra_bytes=False),
    Column("ray_y", "f4", "-", "north component of the unit vector away from the sensor", extra_bytes=False),
    Column("ray_z", "f4", "-", "upward component of the unit vector away from the sensor", extra_bytes=False),
)

RAY = ("ray_x", "ray_y", "ray_z")
"""Columns of a stage with a second pass: the direction in which each echo was seen."""


_FIELDS: dict[str, type] = {
    "waveform": np.int32,
    "time": np.float64,
    "amplitude": np.float32,
    "sigma": np.float32,
    "time_err": np.float32,
    "amplitude_err": np.float32,
    "sigma_err": np.float32,
    "residual": np.float32,
    "flags": np.uint16,
}


@dataclass(frozen=True, slots=True, eq=False)
class EchoTable:
    """m echoes sorted by waveform, then time: found, fitted or true. Errors that nobody computed are NaN."""

    waveform: np.ndarray
    """Row of the block, i4 (m,)."""
    time: np.ndarray
    """Centre of the echo after sample 0 [ns], f8 (m,)."""
    amplitude: np.ndarray
    """Peak above the baseline [count], f4 (m,)."""
    sigma: np.ndarray
    """Gaussian standard deviation [ns], f4 (m,)."""
    time_err: np.ndarray
    amplitude_err: np.ndarray
    sigma_err: np.ndarray
    residual: np.ndarray
    """Root mean square of the fit's residuals in the echo's cluster [noise std], f4 (m,)."""
    flags: np.ndarray
    """EchoFlag bits, u2 (m,)."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Optional columns by name (see COLUMNS), each (m,)."""

    def __len__(self) -> int:
        return len(self.waveform)

    @classmethod
    def build(
        cls,
        waveform: np.ndarray,
        time: np.ndarray,
        amplitude: np.ndarray,
        sigma: np.ndarray,
        *,
        time_err: np.ndarray | None = None,
        amplitude_err: np.ndarray | None = None,
        sigma_err: np.ndarray | None = None,
        residual: np.ndarray | None = None,
        flags: np.ndarray | None = None,
        attributes: Mapping[str, np.ndarray] | None = None,
    ) -> EchoTable:
        """A table with the right dtypes, sorted by waveform, then time; what is not given is NaN, or no flag."""
        m = len(waveform)
        nan = np.full(m, np.nan, np.float32)
        given = {
            "waveform": waveform,
            "time": time,
            "amplitude": amplitude,
            "sigma": sigma,
            "time_err": nan if time_err is None else time_err,
            "amplitude_err": nan if amplitude_err is None else amplitude_err,
            "sigma_err": nan if sigma_err is None else sigma_err,
            "residual": nan if residual is None else residual,
            "flags": np.zeros(m, np.uint16) if flags is None else flags,
        }
        table = cls(
            **{name: np.ascontiguousarray(given[name], dtype=dtype) for name, dtype in _FIELDS.items()},
            attributes=dict(attributes or {}),
        )
        step = np.diff(table.waveform)
        if np.any(step < 0) or np.any((step == 0) & (np.diff(table.time) < 0)):
            table = table.take(np.lexsort((table.time, table.waveform)))
        return table

    @classmethod
    def empty(cls) -> EchoTable:
        """A table without echoes."""
        none = np.empty(0)
        return cls.build(none, none, none, none)

    def take(self, rows: np.ndarray) -> EchoTable:
        """The echoes at `rows` (indices or mask), in that order."""
        core = {name: getattr(self, name)[rows] for name in _FIELDS}
        return EchoTable(**core, attributes={name: values[rows] for name, values in self.attributes.items()})

    def with_attributes(self, **columns: np.ndarray) -> EchoTable:
        """A new table with `columns` added or replaced."""
        for name, values in columns.items():
            if len(values) != len(self):
                raise StageError(f"column {name} has {len(values)} values for {len(self)} echoes")
        return replace(self, attributes={**self.attributes, **columns})

    def with_flags(self, flag: EchoFlag, where: np.ndarray) -> EchoTable:
        """A new table in which `flag` is set too for the echoes `where` is true."""
        flags = self.flags | np.where(where, np.uint16(flag), np.uint16(0))
        return replace(self, flags=flags.astype(np.uint16))

    def count(self, n: int) -> np.ndarray:
        """Echoes per waveform of a block of n, i8 (n,)."""
        return np.bincount(self.waveform, minlength=n)

    @staticmethod
    def concatenate(tables: Iterable[tuple[EchoTable, int]]) -> EchoTable:
        """Tables one behind the other; each comes with what is added to its waveform rows."""
        tables = [(table, shift) for table, shift in tables]
        if not tables:
            return EchoTable.empty()
        names = list(tables[0][0].attributes)
        if any(set(table.attributes) != set(names) for table, _ in tables):
            raise StageError("tables with different columns cannot be joined")
        core = {name: np.concatenate([getattr(table, name) for table, _ in tables]) for name in _FIELDS}
        core["waveform"] = np.concatenate([table.waveform + np.int32(shift) for table, shift in tables])
        attributes = {name: np.concatenate([table.attributes[name] for table, _ in tables]) for name in names}
        return EchoTable(**core, attributes=attributes)
