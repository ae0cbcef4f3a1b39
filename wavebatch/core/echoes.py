"""The echo table that flows through a chain, and the one declaration of its columns, flags and reasons for no value.

Every stage returns an EchoTable. The cloud writer, the report and docs/columns.md have what COLUMNS and EchoFlag say.
Names, bits and dtypes are written to files: do not change those that exist. A new flag takes the next bit; a new column
may stand anywhere, beside those that it belongs to.

NoData says why an echo has no value in a column: one code per echo and column, so that reports can count the reasons.
Stages write the codes of column `c` as attribute `c_reason` (uint8); the report counts them; clouds do not hold them.
Unknown values are NaN in arrays and null in JSON. The order of the codes is the order in which reasons are tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.errors import StageError, need
from wavebatch.core.frozen import frozen
from wavebatch.core.order import find_order
from wavebatch.core.units import LEAST_PULSE_WIDTH

if TYPE_CHECKING:
    from pandas import DataFrame

class EchoFlag(IntFlag):
    """What is known to be wrong or special about an echo: the bits of the `echo_flags` column."""

    meaning: str

    def __new__(cls, value: int, meaning: str) -> EchoFlag:
        """A flag with its meaning; combinations of flags have none."""
        flag = int.__new__(cls, value)
        flag._value_ = value
        flag.meaning = meaning
        return flag

    NOT_CONVERGED = 1, "the fit stopped before it converged; values are the last accepted ones"
    AT_BOUND = 2, "a fitted parameter lies at the edge of its allowed range"
    NEAR_EDGE = 4, "the echo is cut by the start or the end of the waveform"
    SATURATED = 8, "samples under the echo are at the digitizer's limit"
    OVERLAPPED = 16, "fitted together with at least one neighbouring echo"
    WEAK = 32, "amplitude below 5 noise standard deviations: noise helps to find it, so the mean of these is too high"
    RINGING_SUSPECT = 64, "may be ringing or an after-pulse of a stronger echo before it"
    NARROW = 128, "narrower than the system pulse"
    NO_WAVEFORM = 256, "point has no waveform (descriptor index 0 or packet size 0); passed through"
    BROKEN_PACKET = 512, "packet lies outside the file or does not fit its descriptor; point passed through"
    NO_ECHO = 1024, "waveform holds no echo for this point; point passed through"
    UNANCHORED = 2048, "no return of the packet matches an echo; position from the raw return location"
    MERGED = 4096, "two echoes too close to be separated were merged into this one"
    ADDED = 8192, "echo that the input does not have as a return"
    AMPLITUDE_UNRELIABLE = 16384, "so much of the echo is saturated that its amplitude is a guess"
    RETURN_LIMIT = 32768, "return number exceeds what the point format can hold; written as the largest"


FLAG_MEANINGS: dict[EchoFlag, str] = {flag: flag.meaning for flag in EchoFlag}
"""Meaning of each flag, as docs/columns.md lists it."""

UNCLEAN = (
    EchoFlag.OVERLAPPED | EchoFlag.MERGED | EchoFlag.SATURATED | EchoFlag.NEAR_EDGE | EchoFlag.NOT_CONVERGED
    | EchoFlag.AT_BOUND
)  # fmt: skip
"""Flags of echoes whose width or amplitude is not that of one echo. Calibration and the survey leave them out."""

PASSED_THROUGH = EchoFlag.NO_WAVEFORM | EchoFlag.BROKEN_PACKET | EchoFlag.NO_ECHO
"""Flags of points that were copied from the input: no echo was found for them."""


@frozen
class Column:
    """Declaration of one per-echo quantity, used by docs/columns.md, the LAS extra bytes and the report."""

    name: str
    """Name in files and reports."""
    dtype: str
    """NumPy type code of the values in files."""
    unit: str
    """Unit as text; "-" where there is none."""
    meaning: str
    """One line for the table of columns. Extra bytes hold 32 bytes of it with the unit: a longer one needs a
    short form in `_SHORT` of files/cloud/column_names.py."""
    no_data: float | None = -9999.0
    """Value that stands for NaN in files; None where every value is valid."""
    extra_bytes: bool = True
    """False for quantities that are LAS fields already (x, y, z) or that are not written to files."""


_COLUMNS = (
    Column("amplitude", "f4", "DN", "peak of the echo above the baseline"),
    Column("amplitude_normalized", "f4", "DN", "amplitude at the reference range"),
    Column("amplitude_normalized_db", "f4", "dB", "amplitude at the reference range, over 1 DN"),
    Column("echo_time", "f4", "ns", "centre of the echo after the first sample of its packet"),
    Column("echo_width", "f4", "ns", "full width at half maximum"),
    Column("energy", "f4", "DN ns", "integral of the echo over time"),
    Column("range", "f4", "m", "sensor to echo"),
    Column("cross_section", "f4", "m2", "backscatter cross section"),
    Column("backscatter_coefficient", "f4", "-", "cross section per illuminated area (gamma)"),
    Column("reflectance", "f4", "-", "diffuse reflectance, with the surface's angle"),
    Column("level_reflectance", "f4", "-", "diffuse reflectance if the surface is level"),
    Column("relative_backscatter", "f4", "DN ns m2", "not calibrated: backscatter in units of its own strip"),
    Column("relative_cross_section", "f4", "DN ns m4", "not calibrated: cross section in units of its own strip"),
    Column("relative_reflectance", "f4", "DN ns m2", "not calibrated: reflectance in units of its own strip"),
    Column("incidence_angle", "f4", "deg", "angle between ray and surface normal"),
    Column("incidence_angle_normals", "f4", "deg", "angle between ray and normal of the plane of the points around"),
    Column("range_err", "f4", "m", "one standard deviation of the place along the ray; that of range is range_error"),
    Column("range_error", "f4", "m", "error of range: of the place and of the sensor, one standard deviation"),
    Column("amplitude_err", "f4", "DN", "one standard deviation of amplitude"),
    Column("amplitude_normalized_err", "f4", "DN", "one standard deviation of amplitude_normalized"),
    Column("amplitude_normalized_db_err", "f4", "dB", "one standard deviation of amplitude_normalized_db"),
    Column("energy_err", "f4", "DN ns", "one standard deviation of energy"),
    Column("echo_width_err", "f4", "ns", "one standard deviation of echo_width, from the fit"),
    Column("incidence_angle_err", "f4", "deg", "one standard deviation of incidence_angle"),
    Column("incidence_angle_normals_err", "f4", "deg", "one standard deviation of incidence_angle_normals"),
    Column("cross_section_err", "f4", "m2", "one standard deviation of cross_section"),
    Column("backscatter_coefficient_err", "f4", "-", "one standard deviation of gamma"),
    Column("reflectance_err", "f4", "-", "one standard deviation of reflectance"),
    Column("level_reflectance_err", "f4", "-", "one standard deviation of level_reflectance, with unknown slopes"),
    Column("relative_backscatter_err", "f4", "DN ns m2", "one standard deviation of relative_backscatter"),
    Column("relative_cross_section_err", "f4", "DN ns m4", "one standard deviation of relative_cross_section"),
    Column("relative_reflectance_err", "f4", "DN ns m2", "one standard deviation of relative_reflectance"),
    Column("pulse_deviation", "f4", "-", "Gauss-Hermite deviation from the system pulse, sqrt(h3^2 + h4^2)"),
    Column("echo_flags", "u2", "bits", "flags: docs/columns.md", no_data=None),
    Column("skew", "f4", "-", "skew of the echo's log-normal; 0 is a Gaussian"),
    Column("skew_err", "f4", "-", "one standard deviation of skew"),
    Column("x", "f8", "m", "easting of the echo", extra_bytes=False),
    Column("y", "f8", "m", "northing of the echo", extra_bytes=False),
    Column("z", "f8", "m", "height of the echo", extra_bytes=False),
    Column("facing_reflectance", "f4", "-", "reflectance if the surface faces the sensor", extra_bytes=False),
)

COLUMNS: dict[str, Column] = {column.name: column for column in _COLUMNS}
"""Every column by its name."""

_FIELDS: dict[str, type] = {
    "waveform": np.int32,
    "time": np.float64,
    "amplitude": np.float32,
    "sigma": np.float32,
    "time_err": np.float32,
    "amplitude_err": np.float32,
    "sigma_err": np.float32,
    "relative_energy_err": np.float32,
    "residual": np.float32,
    "flags": np.uint16,
}
"""Core columns and their dtypes."""


@frozen(eq=False)
class EchoTable:
    """m echoes sorted by waveform, then time: found, fitted or simulated.

    Errors that no stage computed are NaN. Tables are not changed in place: methods return new ones.
    """

    waveform: np.ndarray
    """Row of the block, int32 (m,)."""
    time: np.ndarray
    """Centre of the echo after sample 0, float64 (m,), ns."""
    amplitude: np.ndarray
    """Peak above the baseline, float32 (m,), DN."""
    sigma: np.ndarray
    """Gaussian standard deviation, float32 (m,), ns."""
    time_err: np.ndarray
    """One standard deviation of time, float32 (m,), ns."""
    amplitude_err: np.ndarray
    """One standard deviation of amplitude, float32 (m,), DN."""
    sigma_err: np.ndarray
    """One standard deviation of sigma, float32 (m,), ns."""
    relative_energy_err: np.ndarray
    """One standard deviation of the energy (amplitude times sigma), relative, float32 (m,); from the fit's covariance
    of both, which depends on how much the echo overlaps others. NaN where the decomposer has none.
    """
    residual: np.ndarray
    """Root mean square of what the fit leaves within four widths of the pulse of the echo, or in its window where it is
    alone there, float32 (m,), in noise standard deviations."""
    flags: np.ndarray
    """EchoFlag bits, uint16 (m,)."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Optional columns by name (see COLUMNS), arrays (m,)."""

    def __len__(self) -> int:
        """Number of echoes."""
        return len(self.waveform)

    def __repr__(self) -> str:
        """Two lines: the number of echoes, and the columns."""
        return f"<EchoTable: {len(self)} echoes>\n  {', '.join(_FIELDS | dict(self.attributes))}"

    @classmethod
    def build(
        cls,
        waveform: np.ndarray,
        time: np.ndarray,
        amplitude: np.ndarray,
        sigma: np.ndarray,
        *,
        attributes: Mapping[str, np.ndarray] | None = None,
        **others: np.ndarray,
    ) -> EchoTable:
        """A table from columns in any order of rows and any numeric dtype.

        Parameters
        ----------
        waveform : int (m,)
            Row of the block.
        time, amplitude, sigma : float (m,), ns, DN, ns
            Centre, peak and Gaussian standard deviation of each echo.
        attributes : mapping of arrays (m,), optional
            Further columns by name.
        **others : arrays (m,)
            Other core columns: time_err, amplitude_err, sigma_err, relative_energy_err, residual (NaN if not given),
            flags (0 if not given).

        Returns
        -------
        EchoTable
            With the dtypes of the core columns, sorted by waveform, then time.

        Raises
        ------
        TypeError
            A name in `others` is not a core column.
        """
        nan = np.full(len(waveform), np.nan, np.float32)
        given = {
            **dict.fromkeys(("time_err", "amplitude_err", "sigma_err", "relative_energy_err", "residual"), nan),
            "flags": np.zeros(len(waveform), np.uint16),
            **{"waveform": waveform, "time": time, "amplitude": amplitude, "sigma": sigma, **others},
        }
        core = {name: np.ascontiguousarray(values, dtype=_FIELDS.get(name)) for name, values in given.items()}
        table = cls(**core, attributes=dict(attributes or {}))
        order = find_order(table.waveform, table.time)
        return table if order is None else table.take(order)

    @classmethod
    def empty(cls) -> EchoTable:
        """A table without echoes."""
        return cls.build(*np.empty((4, 0)))

    def columns(self) -> dict[str, np.ndarray]:
        """The core columns by name."""
        return {name: getattr(self, name) for name in _FIELDS}

    def take(self, rows: np.ndarray) -> EchoTable:
        """The echoes at `rows` (indices or mask), in that order."""
        rows = np.arange(len(self))[rows]  # once for all columns
        core = {name: values.take(rows) for name, values in self.columns().items()}
        others = {name: values.take(rows, axis=0) for name, values in self.attributes.items()}
        return EchoTable(**core, attributes=others)

    def with_attributes(self, **columns: np.ndarray) -> EchoTable:
        """A new table with `columns`, arrays (m,), added or replaced.

        Raises
        ------
        StageError
            A column does not have one value per echo.
        """
        for name, values in columns.items():
            if len(values) != len(self):
                raise StageError(f"column {name} has {len(values)} values for {len(self)} echoes")
        return replace(self, attributes={**self.attributes, **columns})

    def with_flags(self, flag: EchoFlag, where: np.ndarray) -> EchoTable:
        """A new table in which `flag` is also set for the echoes where `where`, bool (m,), is true."""
        return replace(self, flags=self.flags | np.where(where, np.uint16(flag), np.uint16(0)))

    def count(self, n: int) -> np.ndarray:
        """Number of echoes in each of the n waveforms of a block, int64 (n,)."""
        return np.bincount(self.waveform, minlength=n)

    def alone(self, n: int) -> np.ndarray:
        """Which echoes are the only one of their waveform, of n waveforms; bool (m,)."""
        return self.count(n)[self.waveform] == 1

    def to_numpy(self) -> np.ndarray:
        """The table as one structured array (m,): a field per core column, then one per attribute, with their dtypes.

        Examples
        --------
        >>> rows = echoes.to_numpy()
        >>> rows["amplitude"][rows["flags"] == 0].mean()
        """
        columns = {**self.columns(), **self.attributes}
        rows = np.empty(len(self), [(name, values.dtype, values.shape[1:]) for name, values in columns.items()])
        for name, values in columns.items():
            rows[name] = values
        return rows

    def to_frame(self) -> DataFrame:
        """The table as a pandas DataFrame, with the columns of `to_numpy`.

        Raises
        ------
        StageError
            pandas is not installed; the message says how to install it.
        """
        pandas = need("pandas", lambda advice: StageError(f"a DataFrame needs pandas: {advice}; or use to_numpy()"))
        return pandas.DataFrame(self.to_numpy())

    @classmethod
    def concatenate(cls, tables: Iterable[EchoTable | tuple[EchoTable, int]]) -> EchoTable:
        """One table of all echoes of several tables, in the order given.

        Parameters
        ----------
        tables : iterable of EchoTable or (EchoTable, int)
            Tables with the same attributes; the number, 0 if not given, is added to the waveform rows of its table.

        Returns
        -------
        EchoTable
            Not sorted again: give the tables in the order of their waveforms, or `build` the result.

        Raises
        ------
        StageError
            The tables have different attributes.
        """
        pairs = [(table, 0) if isinstance(table, EchoTable) else table for table in tables]
        if not pairs:
            return cls.empty()
        if len(pairs) == 1 and not pairs[0][1]:  # of most units
            return pairs[0][0]
        names = list(pairs[0][0].attributes)
        if any(set(table.attributes) != set(names) for table, _ in pairs):
            raise StageError("tables with different columns cannot be joined")
        core = {name: np.concatenate([getattr(table, name) for table, _ in pairs]) for name in _FIELDS}
        core["waveform"] = np.concatenate([table.waveform + np.int32(shift) for table, shift in pairs])
        return cls(**core, attributes={name: np.concatenate([t.attributes[name] for t, _ in pairs]) for name in names})


_UNSETTLED_REMEDY = "try a slower decompose stage, or a larger most_width: steep surfaces make echoes wider than that"


class NoData(IntEnum):
    """Why an echo has no value: the first reason that applies, in this order."""

    meaning: str
    remedy: str

    def __new__(cls, value: int, meaning: str, remedy: str) -> NoData:
        """A code with its meaning, and what the user can do about it."""
        code = int.__new__(cls, value)
        code._value_, code.meaning, code.remedy = value, meaning, remedy
        return code

    KNOWN = 0, "", ""
    NO_SENSOR = 1, "the position of the sensor is not known", "give --trajectory, or --flight-height"
    NOT_CALIBRATED = (
        2,
        "the strip is not calibrated",
        "give --calibration (of `wavebatch calibrate`), or ask for relative_backscatter instead",
    )
    NO_DIVERGENCE = (
        3,
        "the beam's divergence is not known",
        "give --system with the SYSTEM.toml of `wavebatch survey STRIP --divergence MRAD -o SYSTEM.toml`",
    )
    SHORT_PULSE = (
        4,
        f"the system pulse is shorter than {LEAST_PULSE_WIDTH} samples: widths depend on where the samples lie",
        "there is no remedy; leave the stage out",
    )
    SHARED_PULSE = 5, "shares the light of its pulse with other echoes", "sum the echoes of a pulse instead"
    OVERLAPPED = (
        6,
        "overlaps another echo, or was merged with one",
        "there is no remedy; its width is not that of one surface",
    )
    SATURATED = 7, "saturated", "fly higher, or with less power"
    CUT = 8, "cut by the start or the end of its waveform", "record longer waveforms"
    UNSETTLED = 9, "its fit did not converge, or ended at a bound", _UNSETTLED_REMEDY
    NO_ANGLE = 10, "its incidence angle is not known", "see why incidence_angle is not, or set surface"
    TOO_STEEP = 11, "incidence angle above 80 degrees, or broader than any slope explains", "there is no remedy"
    UNCERTAIN = (
        12,
        "more uncertain than max_error",
        "raise max_error, or take angles from the points around (stage attribute.incidence_angle_normals)",
    )
    OTHER = 13, "its fit gave no usable value", "see its flags"
    NO_RAY = (
        14,
        "its packet has no direction, or one that misses the path of the sensor, or it is not a point of the cloud",
        "write --points echoes",
    )
    FEW_NEIGHBOURS = 15, "fewer points around it than min_points, or only one or two scan lines", "raise radius"
    NO_PLANE = 16, "the points around it do not form a plane that it lies in", "lower radius; plants have no plane"
    OTHER_PULSE = (
        17,
        "its width was fitted with another pulse than mode compares it with",
        'fit the pulse of the survey (decompose.adaptive), or Gaussians with mode = "pulse"',
    )
    NO_PULSE_ENERGY = 18, "the energy of its pulse is not known", "complete the file of --energy, or leave it out"
    NO_LEVEL = (
        19,
        "the width of an echo that no slope widens is not known: too few points of the strip lie on planes",
        "give --system with the SYSTEM.toml of a strip of the same sensor that has them (`survey --divergence`)",
    )
    EDGE = (
        20,
        "its footprint may reach over an edge, to a surface after the end of its packet",
        "record longer waveforms; backscatter_coefficient holds what comes from its surface",
    )


REASONS: dict[NoData, tuple[str, str]] = {code: (code.meaning, code.remedy) for code in NoData if code.meaning}
"""Meaning of each reason, and what the user can do about it."""

SUFFIX = "_reason"
"""Ending of the names of attributes that hold codes."""


def explain_no_data(values: np.ndarray, *cases: tuple[NoData, np.ndarray | bool]) -> np.ndarray:
    """The reason code of each value of a column.

    Parameters
    ----------
    values : float (n,)
        The column; finite values are KNOWN.
    *cases : (NoData, bool or bool (n,))
        Reasons in order, with where they apply. The first one that applies counts; OTHER where none does.

    Returns
    -------
    uint8 (n,)
        Codes of NoData.
    """
    codes = np.zeros(len(values), np.uint8)
    rows = np.flatnonzero(~np.isfinite(values))
    if not len(rows):
        return codes
    left = np.full(len(rows), NoData.OTHER, np.uint8)
    for reason, where in reversed(cases):
        holds = where if np.ndim(where) == 0 else where[rows]
        left[np.broadcast_to(holds, len(rows))] = reason
    codes[rows] = left
    return codes


def without_nan(value: Any) -> Any:
    """Numbers, lists and dictionaries made ready for JSON: None for NaN and infinity, dictionary keys as text."""
    if isinstance(value, Mapping):
        return {str(key): without_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def count_reasons(attributes: Mapping[str, np.ndarray]) -> dict[str, dict[str, int]]:
    """Number of echoes per reason, for each column of a table that has reasons.

    Parameters
    ----------
    attributes : mapping of arrays (m,)
        Attributes of an EchoTable.

    Returns
    -------
    dict of dict of int
        By column, then by the name of the code; codes that do not occur are left out, KNOWN is counted too.
    """
    counts = {}
    for name, codes in attributes.items():
        if name.endswith(SUFFIX):
            numbers = np.bincount(codes, minlength=len(NoData)).tolist()
            counts[name.removesuffix(SUFFIX)] = {reason.name: numbers[reason] for reason in NoData if numbers[reason]}
    return counts
