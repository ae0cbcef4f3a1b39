"""Names, types and units of columns: one table for wavebatch's style and four styles of other programs.

The layout of a cloud names columns with it, and the cloud readers find columns of all styles. A style may use a name
only if the column has the meaning and unit that the other program gives to this name.

The provenance of a cloud says under which names its columns are: JSON in VLRs of the user id "wavebatch", one per run,
the latest with the largest number. `CloudWriter` writes it, all readers of clouds use it. Its bytes may come from any
program, so whatever is not as expected counts as no provenance.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from wavebatch.core.echoes import COLUMNS, Column
from wavebatch.core.frozen import frozen
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.las import header as las

USER_ID = "wavebatch"
"""User id of the records."""


def read_provenance(header: las.LasHeader) -> list[dict[str, Any]]:
    """Return the runs that made a cloud, by its header, oldest first; empty for a file that is not of wavebatch."""
    records = sorted((vlr for vlr in header.vlrs if vlr.user == USER_ID), key=lambda vlr: vlr.record_id)
    runs = []
    for record in records:
        try:
            run = json.loads(record.payload)
        except (ValueError, RecursionError):
            continue
        if isinstance(run, dict):
            runs.append(run)
    return runs


@frozen
class Naming:
    """How a style writes one column, where it differs from the declaration of the column."""

    name: str
    dtype: str | None = None
    unit: str | None = None
    scale: float | None = None
    no_data: float | None = None
    """Stored no-data value; only for styles that change the type."""
    decibel: bool = False
    """Written as 10 log10 of the value."""


STYLES: dict[str, dict[str, Naming]] = {
    "wavebatch": {},
    # Of the standard extra bytes of ASPRS one is a wavebatch column: pulse width, full width at half maximum in ns.
    "asprs": {"echo_width": Naming("pulse width", "u2", scale=0.1, no_data=0.0)},
    # RIEGL's Amplitude is in dB above the detection limit, which cannot be computed from counts; Reflectance is in dB.
    "riegl": {
        "echo_width": Naming("Pulse width", "u2", scale=0.1, no_data=0.0),
        "reflectance": Naming("Reflectance", "i2", "dB", scale=0.01, no_data=-32768.0, decibel=True),
    },
    # PDAL's Amplitude is in dB and its PulseWidth in samples of the digitizer, so these two names are not used.
    "pdal": {
        **{name: Naming(name.title().replace("_", "")) for name in (
            "echo_time", "echo_width", "energy", "cross_section", "backscatter_coefficient", "incidence_angle",
            "incidence_angle_normals", "echo_width_err", "incidence_angle_err", "incidence_angle_normals_err",
            "echo_flags",
        )},
        "amplitude": Naming("PeakAmplitude"),
        "amplitude_err": Naming("PeakAmplitudeErr"),
        "range": Naming("EchoRange"),
        "range_err": Naming("EchoRangeErr"),
        "range_error": Naming("EchoRangeError"),
        "reflectance": Naming("Reflectance", unit="dB", decibel=True),
        "pulse_deviation": Naming("PulseShapeDeviation"),
    },
    "opals": {name: Naming(name.title().replace("_", "")) for name in (
        "amplitude", "echo_width", "range", "cross_section", "backscatter_coefficient", "reflectance"
    )},
}  # fmt: skip
"""Columns that a style names differently; all other columns keep wavebatch's name, type and unit."""

NO_DATA = {"-9999": -9999.0, "nan": float("nan")}
"""Values of --no-data: what is stored in floating-point columns where an echo has no value."""

_RELATIVE = ("backscatter", "cross_section", "reflectance")
_SHORT = {
    "amplitude": "peak above the baseline",
    "echo_time": "echo after first sample",
    "energy": "integral of the echo",
    "backscatter_coefficient": "gamma: section per area",
    "backscatter_coefficient_err": "1 sigma of gamma",
    "incidence_angle": "ray to surface normal",
    "incidence_angle_normals": "ray to plane of points",
    "incidence_angle_normals_err": "1 sigma of angle to plane",
    "pulse_deviation": "Gauss-Hermite deviation",
    "amplitude_normalized": "at the reference range",
    "amplitude_normalized_db": "at reference range",
    "amplitude_normalized_err": "1 sigma, normalized",
    "amplitude_normalized_db_err": "1 sigma, normalized",
    "reflectance": "reflectance at true angle",
    "level_reflectance": "reflectance if level",
    "level_reflectance_err": "1 sigma, slope unknown",
    "range_err": "1 sigma of place along ray",
    "range_error": "1 sigma of range with sensor",
    "skew": "skew; 0 is a Gaussian",
    **{f"relative_{name}": "relative to strip" for name in _RELATIVE},
    **{f"relative_{name}_err": "1 sigma, relative" for name in _RELATIVE},
}
"""Short meanings of columns whose declared meaning does not fit into the 32 bytes of a description."""

_STANDARD = frozenset(
    re.sub("[_ ]", "", name.casefold())
    for number in las.STANDARD_DTYPES
    for name in (*las.list_dimensions(number), *las.field_names(las.STANDARD_DTYPES[number]))
)
"""Normalised names of the standard LAS dimensions."""


@frozen
class WrittenColumn:
    """A wavebatch column as it is written to the file."""

    column: str
    """Name in COLUMNS."""
    record: las.ExtraRecord
    naming: Naming

    def encode(self, values: np.ndarray) -> np.ndarray:
        """Return the stored values (m,) of physical `values` (m,); values that are not finite become no-data.

        Values outside the stored type become its nearest value that is not no-data. Integers that are no-data stay so.
        """
        dtype, no_data, whole = self.record.dtype, self.record.no_data, values.dtype.kind in "ui"
        if dtype.kind in "ui" and values.dtype == dtype:
            return values
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values = np.asarray(values, np.float64 if self.naming.decibel or self.naming.scale else None)
            if self.naming.decibel:
                values = 10.0 * np.log10(values)
            if dtype.kind == "f":
                stored = values.astype(dtype)
                return stored if no_data is None else np.where(np.isfinite(stored), stored, no_data[0])
            stored = np.rint(values / (self.naming.scale or 1.0))
        limits = np.iinfo(dtype)
        empty = 0 if no_data is None else int(no_data[0])
        good = np.isfinite(stored) & (values != empty if whole else True)
        least, largest = limits.min + (empty == limits.min), limits.max - (empty == limits.max)
        return np.where(good, np.clip(np.where(good, stored, 0.0), least, largest), empty).astype(dtype)


def normalise(name: str) -> str:
    """Return the form in which names are compared: without case, spaces, underscores and other signs.

    PDAL makes `_` of every sign, and takes names that differ in case only as one.
    """
    return re.sub(r"[\W_]", "", name.casefold())


def resolve(name: str, *kinds: Mapping[str, Any]) -> Any:
    """Return what the name of a column stands for: the one way of --where, --column and all readers of clouds.

    kinds: names with what they stand for, the more important first. Exact names of any kind come before names that are
    alike by `normalise`: `Amplitude` is the vendor's, `amplitude` is ours. None where no name fits.
    """
    for known in kinds:
        if name in known:
            return known[name]
    alike = (known[one] for known in kinds for one in known if normalise(one) == normalise(name))
    return next(alike, None)


def name_standard(point_format: int) -> dict[str, str]:
    """Return the names that users may give to the fields of a point format, each with its field.

    Coordinates are x, y and z, not the stored integers. The scan angle has the names of all point formats.
    """
    names = ("x", "y", "z", *(name for name in las.list_dimensions(point_format) if name not in ("X", "Y", "Z")))
    angle = next(name for name in names if name in ("scan_angle", "scan_angle_rank"))
    return {**{name: name for name in names}, "scan_angle": angle, "scan_angle_rank": angle}


class Placing(Protocol):
    """A header or a reader: has scales and offsets, which turn stored positions into coordinates."""

    scales: tuple[float, ...]
    offsets: tuple[float, ...]


def read_field(raw: np.ndarray, point_format: int, name: str, placing: Placing) -> np.ndarray:
    """Return the values (n,) of a field of raw records, NaN for those that are not finite.

    placing: scales and offsets of the positions.
    """
    if name in ("x", "y", "z"):
        axis = "xyz".index(name)
        return raw[name.upper()] * placing.scales[axis] + placing.offsets[axis]
    if name.startswith("scan_angle"):
        return las.read_angles(raw)
    import laspy

    values = widen_integers(np.asarray(laspy.PackedPointRecord(raw, laspy.PointFormat(point_format))[name]))
    values[~np.isfinite(values)] = np.nan
    return values


def describe(column: Column, unit: str | None = None) -> str:
    """Return meaning and unit of a column in at most 32 bytes, as `meaning [unit]`."""
    tail = f" [{unit or column.unit}]"
    if column.name.endswith("_err") and column.name not in _SHORT:
        meaning = f"1 sigma of {column.name.removesuffix('_err')}"
    else:
        meaning = _SHORT.get(column.name, column.meaning)
    while len((meaning + tail).encode()) > 32:
        meaning = meaning.rpartition(" ")[0] or meaning[:-1]
    return meaning + tail


def style_columns(
    columns: Sequence[str], style: str, taken: Collection[str], no_data: str = "-9999"
) -> list[WrittenColumn]:
    """Return the extra-bytes columns among `columns`, in order, as `style` writes them.

    taken: names of the input's extra bytes, which stay. If the name of a wavebatch column is equal to one of these, to
    a LAS field or to another column (compared by `normalise`), it gets the prefix `wb_`, or `wb2_`, `wb3_` ... if that
    is taken too. Columns that are LAS fields (x, y, z) are skipped, repeated ones count once.
    style, no_data: keys of STYLES and NO_DATA.
    """
    used = {normalise(name) for name in taken} | _STANDARD
    written: list[WrittenColumn] = []
    for key in dict.fromkeys(columns):
        column = COLUMNS[key]
        if not column.extra_bytes:
            continue
        naming = STYLES[style].get(key, Naming(key))
        name, number = naming.name, 1
        while normalise(name) in used:
            # Without spaces, because PDAL takes only identifiers in its expressions.
            name = ("wb_" if number == 1 else f"wb{number}_") + naming.name.replace(" ", "_")
            number += 1
        used.add(normalise(name))
        dtype = naming.dtype or column.dtype
        empty = column.no_data if naming.no_data is None else naming.no_data
        if empty is not None and np.dtype(dtype).kind == "f":
            empty = NO_DATA[no_data]
        record = las.ExtraRecord.build(name, dtype, describe(column, naming.unit), no_data=empty, scale=naming.scale)
        written.append(WrittenColumn(key, record, naming))
    return written


def describe_roundings(written: Sequence[WrittenColumn]) -> list[str]:
    """Return a line for each column that its style stores in coarser steps than it was computed with."""
    lines = []
    for column in written:
        record, naming = column.record, column.naming
        if naming.scale is None:
            continue
        unit, limits = naming.unit or COLUMNS[column.column].unit, np.iinfo(record.dtype)
        low, high = (limit * naming.scale for limit in (max(limits.min, -limits.max), limits.max))
        lines.append(
            f"{column.column}: written as {record.name!r}, rounded to {naming.scale:g} {unit} and kept within "
            f"{low:g} to {high:g} {unit}; --names wavebatch keeps every digit"
        )
    return lines
