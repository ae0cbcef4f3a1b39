"""Names, types and units under which columns are written: one table for wavebatch's own style and four others."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from laspy import PointFormat

from wavebatch.core.echoes import COLUMNS, Column
from wavebatch.core.errors import ConfigError
from wavebatch.files.las.extra_bytes import ExtraRecord
from wavebatch.files.las.header import STANDARD_DTYPES


@dataclass(frozen=True, slots=True)
class Naming:
    """How a style writes one column where it differs from the column's declaration."""

    name: str
    dtype: str | None = None
    unit: str | None = None
    scale: float | None = None
    no_data: float | None = None
    """Stored value; only for styles that change the type."""
    decibel: bool = False
    """Written as 10 log10 of the value."""


STYLES: dict[str, dict[str, Naming]] = {
    "wavebatch": {},
    # The standard extra bytes of ASPRS have one of our quantities: the pulse width, full width at half maximum in ns.
    "asprs": {"echo_width": Naming("pulse width", "u2", scale=0.1, no_data=0.0)},
    # RIEGL's Amplitude is in dB above the detection limit, which counts cannot be turned into; Reflectance is dB too.
    "riegl": {
        "echo_width": Naming("Pulse width", "u2", scale=0.1, no_data=0.0),
        "reflectance": Naming("Reflectance", "i2", "dB", scale=0.01, no_data=-32768.0, decibel=True),
    },
    # PDAL's Amplitude is in dB and its PulseWidth in samples of the digitizer, so these two names are left alone.
    "pdal": {
        "amplitude": Naming("PeakAmplitude"),
        "echo_time": Naming("EchoTime"),
        "echo_width": Naming("EchoWidth"),
        "energy": Naming("Energy"),
        "range": Naming("EchoRange"),
        "cross_section": Naming("CrossSection"),
        "backscatter_coefficient": Naming("BackscatterCoefficient"),
        "reflectance": Naming("Reflectance", unit="dB", decibel=True),
        "incidence_angle": Naming("IncidenceAngle"),
        "incidence_angle_normals": Naming("IncidenceAngleNormals"),
        "range_err": Naming("EchoRangeErr"),
        "amplitude_err": Naming("PeakAmplitudeErr"),
        "echo_width_err": Naming("EchoWidthErr"),
        "incidence_angle_err": Naming("IncidenceAngleErr"),
        "incidence_angle_normals_err": Naming("IncidenceAngleNormalsErr"),
        "pulse_deviation": Naming("PulseShapeDeviation"),
        "echo_flags": Naming("EchoFlags"),
    },
    "opals": {
        "amplitude": Naming("Amplitude"),
        "echo_width": Naming("EchoWidth"),
        "range": Naming("Range"),
        "cross_section": Naming("CrossSection"),
        "backscatter_coefficient": Naming("BackscatterCoefficient"),
        "reflectance": Naming("Reflectance"),
    },
}
"""Per style the columns it names in its own way; every other column keeps wavebatch's name, type and unit."""

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
    "relative_backscatter": "relative to strip only",
    "relative_cross_section": "relative to strip only",
    "relative_reflectance": "relative to strip only",
    "relative_backscatter_err": "1 sigma, relative",
    "relative_cross_section_err": "1 sigma, relative",
    "relative_reflectance_err": "1 sigma, relative",
}
"""Meanings short enough for the 32 bytes of a description, where the column's own is not."""

_STANDARD = frozenset(
    re.sub("[_ ]", "", name.casefold())
    for number in STANDARD_DTYPES
    for name in (*PointFormat(number).dimension_names, *STANDARD_DTYPES[number].names)
)
"""Names of standard LAS dimensions, as `normalise` gives them."""


@dataclass(frozen=True, slots=True)
class WrittenColumn:
    """One column of ours as it stands in the file."""

    column: str
    """Name in COLUMNS."""
    record: ExtraRecord
    naming: Naming

    def encode(self, values: np.ndarray) -> np.ndarray:
        """Stored values of physical `values` (m,); what is not finite becomes no-data.

        Scaled values that the stored type cannot hold become its nearest value that is not no-data.
        """
        dtype, no_data = self.record.dtype, self.record.no_data
        if dtype.kind in "ui" and np.asarray(values).dtype.kind in "ui":
            return np.asarray(values).astype(dtype, copy=False)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values = np.asarray(values, np.float64 if self.naming.decibel or self.naming.scale else None)
            if self.naming.decibel:
                values = 10.0 * np.log10(values)
            if dtype.kind == "f":
                stored = values.astype(dtype)
                return stored if no_data is None else np.where(np.isfinite(stored), stored, no_data[0])
            stored = np.rint(values / (self.naming.scale or 1.0))
        good = np.isfinite(stored)
        limits = np.iinfo(dtype)
        empty = 0 if no_data is None else int(no_data[0])
        least, largest = limits.min + (empty == limits.min), limits.max - (empty == limits.max)
        return np.where(good, np.clip(np.where(good, stored, 0.0), least, largest), empty).astype(dtype)


def normalise(name: str) -> str:
    """What names are compared by: case, spaces, underscores and hyphens do not count."""
    return re.sub(r"[\s_\-]", "", name.casefold())


def describe(column: Column, unit: str | None = None) -> str:
    """Meaning and unit of the column in at most 32 bytes, `meaning [unit]`."""
    tail = f" [{unit or column.unit}]"
    if column.name.endswith("_err") and column.name not in _SHORT:
        meaning = f"1 sigma of {column.name.removesuffix('_err')}"
    else:
        meaning = _SHORT.get(column.name, column.meaning)
    while len((meaning + tail).encode()) > 32:
        meaning = meaning.rpartition(" ")[0] or meaning[:-1]
    return meaning + tail


def name_columns(columns: Sequence[str], style: str, taken: Collection[str]) -> list[WrittenColumn]:
    """The extra-bytes columns among `columns`, in their order, as `style` writes them.

    taken: names of the input's own extra bytes, which they keep. THE RULE: where one of our names equals a name of the
    input, of a standard LAS dimension or of another column of ours - whatever the case, spaces, underscores and
    hyphens - ours is written with `wb ` in front (`wb2 `, `wb3 ` ... if that exists as well).
    Columns that are LAS fields (x, y, z) are left out, repeated ones count once.
    Raises ConfigError for an unknown style or column.
    """
    if style not in STYLES:
        raise ConfigError(f"names {style!r}: must be one of {', '.join(STYLES)}")
    used = {normalise(name) for name in taken} | _STANDARD
    written: list[WrittenColumn] = []
    for key in dict.fromkeys(columns):
        column = _find_column(key)
        if not column.extra_bytes:
            continue
        naming = STYLES[style].get(key, Naming(key))
        name = _avoid(naming.name, used)
        used.add(normalise(name))
        record = ExtraRecord.build(
            name,
            naming.dtype or column.dtype,
            describe(column, naming.unit),
            no_data=column.no_data if naming.no_data is None else naming.no_data,
            scale=naming.scale,
        )
        written.append(WrittenColumn(key, record, naming))
    return written


def _find_column(name: str) -> Column:
    if name in COLUMNS:
        return COLUMNS[name]
    near = difflib.get_close_matches(name, COLUMNS, 1)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(COLUMNS)}"
    raise ConfigError(f"column {name!r} does not exist; {hint}")


def _avoid(name: str, used: Collection[str]) -> str:
    candidate, number = name, 1
    while normalise(candidate) in used:
        prefix = "wb " if number == 1 else f"wb{number} "
        candidate, number = prefix + name, number + 1
    return candidate
