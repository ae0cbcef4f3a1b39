"""The files of a calibration: CAL.toml, which a person can read and change, and the reference targets.

`wavebatch calibrate` writes CAL.toml, `run` and `voxelize` read it. Before you change it: files of earlier versions
must stay readable, and a key that is taken out by hand must only take its check away.

Targets are areas of known reflectance, from GeoJSON or CSV. `wavebatch calibrate` reads them; `targets` asks which
echoes lie inside, and how far.
"""

from __future__ import annotations

import contextlib
import csv
import datetime
import io
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.files import toml_file
from wavebatch.files.geojson import LARGEST_COORDINATE, AreaFile, find_inside, place_rings, read_features
from wavebatch.files.las.header import LasHeader
from wavebatch.files.text_file import MOST_LIST, read_text
from wavebatch.surveying.calibration import Calibration

CALIBRATION_SCHEMA = "wavebatch.calibration/1"

_DAY = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")

_SECTION = "section_constant"
_MEANING = "C_cal: cross section = C_cal R^4 amplitude sigma / transmission"
_SWATH = {"most_deg": (1e-3, 90.0), "square": (-10.0, 10.0), "fourth": (-10.0, 10.0), "odd": (-10.0, 10.0)}
"""Keys of [scan_angle] with their limits: the constant grows by exp(square u^2 + fourth u^4 + odd u), u = angle to the
right of the flight / most_deg."""
_HEADING = "A calibration: `wavebatch run --calibration` takes it for strips of the same sensor and settings."


def format_calibration(found: Calibration) -> str:
    """Return the TOML text of a calibration; `parse_calibration` gives the same constants again."""
    table = toml_file.describe_record(found)
    rows = {key: table.pop(key, None) for key in ("channel", "flight_strip")}
    document = {
        "schema": CALIBRATION_SCHEMA,
        "version": __version__,
        **{key: value for key, value in table.items() if isinstance(value, str)},
        **table,
        _SECTION: found.section_constant,
        "scan_angle": dict(zip(_SWATH, (math.degrees(found.swath[0]), *found.swath[1:]), strict=True))
        if found.swath
        else None,
        **rows,
        "target": [asdict(row) for row in found.targets] or None,
        "fingerprint": {key: item for key, item in found.fingerprint.items() if not isinstance(item, Mapping)} or None,
    }
    comments = toml_file.list_comments(Calibration, "") | {_SECTION: _MEANING}
    return toml_file.format_toml(document, heading=_HEADING, comments=comments)


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file; raises ConfigError, in one line, where it cannot be read or is wrong."""
    return parse_calibration(read_text(path, "calibration file"), str(path))


def parse_calibration(text: str, name: str) -> Calibration:
    """Read the TOML text of a calibration.

    Parameters
    ----------
    text : str
    name : str
        Start of every message, usually the path.

    Returns
    -------
    Calibration
        Without `targets`, which nothing uses after the measurement.

    Raises
    ------
    ConfigError
        When a key is unknown, missing or out of its range, or where section_constant does not fit the others.
    """
    table = toml_file.parse_toml(text, name)
    table.check_kind("calibration")
    table.check_schema(CALIBRATION_SCHEMA)
    swath: tuple[float, ...] = ()
    if "scan_angle" in table.values:
        angles = table.table("scan_angle")
        angles.check_keys(_SWATH)
        older = {"odd": 0.0}  # files that have none
        most, *terms = (
            angles.number(key, *limits, default=older.get(key, toml_file.REQUIRED)) for key, limits in _SWATH.items()
        )
        swath = (math.radians(most), *terms)
    fingerprint = dict(table.table("fingerprint", {}).values)
    others = ("schema", "version", _SECTION, "scan_angle", "target", "fingerprint")
    found = replace(toml_file.read_record(Calibration, table, also=others), swath=swath, fingerprint=fingerprint)
    if found.flight:
        flight = found.flight
        with contextlib.suppress(ValueError):
            flight = datetime.date.fromisoformat(flight).isoformat()
        if not _DAY.fullmatch(flight):
            raise ConfigError(f"{name}: flight must be a day such as 2026-05-31, it is {toml_file.shorten(flight)}")
        found = replace(found, flight=flight)
    known: set[tuple[int, int]] = set()
    for number, row in enumerate(found.channels, 1):
        channel = (row.digitizer, row.scanner)
        if channel in known:
            where = f"{name}: [[channel]] {number}"
            raise ConfigError(f"{where}: digitizer {channel[0]} with scanner channel {channel[1]} has two tables")
        known.add(channel)
    if _SECTION in table.values:
        # C_cal must follow from the other two: else one was changed by hand.
        section = table.number(_SECTION, 0.0, 1e30)
        expected = found.section_constant
        if expected is None or abs(section - expected) > 1e-3 * expected:
            wanted = "no divergence_mrad" if expected is None else f"{expected!r} by constant and divergence_mrad"
            problem = f"section_constant is {section!r}, but there is {wanted}"
            raise ConfigError(f"{name}: {problem}; correct these, or leave section_constant out")
    return found


_CORNERS = 64
"""Corners of the polygon that stands for a circle."""


HOT_SPOT, BRIGHT = 0.25, 0.5
"""What reflectances measured from aside lack of those that a lidar sees along its own light, and from which reflectance
on; in proportion below it. Half of it is its error. White standards reflect 1.3 to 1.5 times as much within a degree of
the light (Egan and Hilgeman 1976); natural bright targets 1.2 to 1.3."""

NARROW = 3.0
"""Angle between light and detector up to which a measurement sees the hot spot [deg]."""

GEOMETRIES = ("backscatter", "directional", "hemispherical")
"""How a reflectance was measured: along the light, at an angle to it (column `angle`), into all directions."""

LEAST_REFLECTANCE = 1e-6
"""Of a target: the blackest coatings reflect 100 times as much."""


@frozen(eq=False)
class Target:
    """An area of known reflectance."""

    name: str
    reflectance: float
    corners: np.ndarray
    """Corners of its outline, f8 (k, 2) [m]."""
    incidence: float | None = None
    """Angle between ray and normal [deg]; None: taken from the plane of the target's echoes."""
    hot_spot: float = 0.0
    """What the lidar sees more than the reflectance says, relative, because that was measured from aside."""
    file: AreaFile | None = None
    """Where the coordinates of a GeoJSON file lie; None: in the CRS of the strip."""

    def place(self, strip: Path, header: LasHeader) -> Target:
        """Return the target in the coordinates of a strip; raises as `place_rings`."""
        (corners,) = place_rings(self.file, [self.corners], strip, header)
        return replace(self, corners=corners, file=None)

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        """Return whether positions f8 (n, 3) [m] lie inside, bool (n,)."""
        return find_inside([self.corners], xyz[:, 0], xyz[:, 1])

    def depth(self, xyz: np.ndarray) -> np.ndarray:
        """Return the distance of positions f8 (n, 3) to the outline, f8 (n,) [m]; it does not say on which side."""
        x, y = xyz[:, 0], xyz[:, 1]
        best = np.full(len(x), np.inf)
        for (x0, y0), (x1, y1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            dx, dy = x1 - x0, y1 - y0
            square = dx * dx + dy * dy
            part = np.clip(((x - x0) * dx + (y - y0) * dy) / square, 0.0, 1.0) if square > 0 else 0.0
            best = np.minimum(best, np.hypot(x - x0 - part * dx, y - y0 - part * dy))
        return best


def load_targets(path: Path | str) -> list[Target]:
    """Read reference targets from a GeoJSON or CSV file.

    Parameters
    ----------
    path : path
        GeoJSON: polygons with the property reflectance. CSV: the column reflectance, and x, y, radius, or vertices as
        `x y x y x y ...`. Both may have name, incidence [deg], and how the reflectance was measured: geometry (one of
        GEOMETRIES) and angle [deg]. Coordinates of CSV are those of the strip; those of GeoJSON are placed in each
        strip by `Target.place`.

    Returns
    -------
    list of Target

    Raises
    ------
    ConfigError
        In one line, where the file cannot be read, is empty or holds a wrong target.
    """
    text = read_text(path, "target file", MOST_LIST)
    lines = io.StringIO(text, newline=None)
    file = None
    try:
        if text.lstrip().startswith("{"):
            rows = []
            features, file = read_features(text, path)
            for properties, rings in features:
                if len(rings) > 1:
                    problem = f"a target has {len(rings)} rings"
                    raise ConfigError(f"{path}: {problem}; make every part a target, without holes")
                corners = " ".join(f"{float(x)!r} {float(y)!r}" for x, y in rings[0])
                rows.append({**properties, "vertices": corners})
        else:
            rows = list(csv.DictReader(lines))
    except csv.Error as error:
        raise ConfigError(f"{path}: target file is neither GeoJSON nor CSV ({error})") from error
    targets = [replace(_read_target(row, f"{path}: target {i}"), file=file) for i, row in enumerate(rows, 1)]
    if not targets:
        raise ConfigError(f"{path}: no target in it; give polygons (GeoJSON) or rows (CSV)")
    centres = np.array([one.corners.mean(axis=0) for one in targets])
    alike = np.array([one.reflectance for one in targets])
    for number, one in enumerate(targets, 1):
        # Two outlines of one surface: the middle of one lies in the other.
        within = find_inside([one.corners], *centres.T) | np.isclose(centres, centres[number - 1], 0, 1e-6).all(axis=1)
        same = np.flatnonzero(within & (alike == one.reflectance)) + 1
        others = same[same != number]
        if len(others):
            first, second = sorted((number, int(others[0])))
            raise ConfigError(
                f"{path}: targets {first} and {second} are one target: its reflectance would count twice; leave one out"
            )
    return targets


def _read_target(row: Mapping[str, Any], where: str) -> Target:
    fields = {str(key).strip().lower(): value for key, value in row.items() if key and value not in (None, "")}
    try:
        reflectance = float(fields["reflectance"])
        incidence = float(fields["incidence"]) if "incidence" in fields else None
        if "vertices" in fields:
            corners = np.array(str(fields["vertices"]).split(), np.float64).reshape(-1, 2)
        else:
            angle = np.arange(_CORNERS) * (2 * np.pi / _CORNERS)
            circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            with np.errstate(invalid="ignore", over="ignore"):
                radius = float(fields["radius"])
                corners = radius * circle[: _CORNERS * (radius > 0)] + [float(fields["x"]), float(fields["y"])]
    except KeyError as error:
        needed = f"{error.args[0]} is missing, it has {', '.join(fields) or 'nothing'}"
        rest = "" if "vertices" in fields else ", and x, y, radius or vertices; CSV has commas between them"
        raise ConfigError(f"{where}: {needed}; a target has reflectance{rest}") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{where}: not numbers: {error}") from error
    if not LEAST_REFLECTANCE <= reflectance <= 1.5:
        limits = f"{LEAST_REFLECTANCE:g} to 1.5, not in per cent"
        raise ConfigError(f"{where}: reflectance must lie in {limits}; it is {reflectance:g}")
    if len(corners) < 3 or not (np.abs(corners) <= LARGEST_COORDINATE).all():
        raise ConfigError(f"{where}: the outline needs three corners, or a radius above 0, and possible coordinates")
    if incidence is not None and not 0 <= incidence < 85:
        raise ConfigError(f"{where}: incidence must lie in 0 to 85 degrees, it is {incidence:g}")
    name = str(fields.get("name", where.rsplit(": ", 1)[-1]))
    geometry = str(fields.get("geometry", GEOMETRIES[0])).strip().lower()
    if geometry not in GEOMETRIES or (geometry == "directional") != ("angle" in fields):
        kinds = " or ".join(GEOMETRIES)
        raise ConfigError(f"{where}: geometry must be {kinds}, and only directional has an angle [deg] to the light")
    try:
        to_light = float(fields.get("angle", 90.0))
    except ValueError as error:
        raise ConfigError(f"{where}: not numbers: {error}") from error
    aside = geometry == "hemispherical" or (geometry == "directional" and not abs(to_light) <= NARROW)
    return Target(name, reflectance, corners, incidence, HOT_SPOT * min(reflectance / BRIGHT, 1.0) if aside else 0.0)
