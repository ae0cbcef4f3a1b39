"""Readers of trajectory files: text with named columns, and SBET; positions come in the coordinates of the strip.

`surveying/sensor.py` calls `read_trajectory` for `--trajectory`. Add names of text columns to COLUMN_NAMES.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError, need
from wavebatch.core.trajectory import Trajectory, apply_lever_arm
from wavebatch.files.disk.raw_bytes import naming, open_regular, reporting_reads, widen_integers

SBET_RECORD = np.dtype([(name, "<f8") for name in (
    "time", "latitude", "longitude", "height", "x_velocity", "y_velocity", "z_velocity", "roll", "pitch", "heading",
    "wander", "x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate")])  # fmt: skip

MOST_RECORDS = 400_000
"""Most positions that are kept of an SBET: 5 hours at 20 Hz; more of them do not make the interpolation better."""

MOST_TEXT = 1 << 30
"""Most bytes of a text file: it is kept in memory."""

MOST_HEAD = 1 << 20
"""Bytes among which the names of the columns stand: 200 lines of 5,000 characters."""

MOST_NAME = 100
"""Most characters of the name of a column."""

COLUMN_NAMES: dict[str, tuple[str, ...]] = {
    "time": ("time", "gpstime", "gps", "t", "sow", "gpsseconds", "gpssow", "secondsofweek", "weekseconds", "timestamp"),
    "x": ("x", "easting", "east", "e", "utmeasting", "projx"),
    "y": ("y", "northing", "north", "n", "utmnorthing", "projy"),
    "z": ("z", "height", "altitude", "alt", "h", "elevation", "hell", "up",
          "ellipsoidalheight", "ellipsoidheight", "ellheight"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "long", "lng"),
    "roll": ("roll",),
    "pitch": ("pitch",),
    "heading": ("heading", "yaw", "azimuth"),
}
"""Names of columns in text files, compared without case, blanks, units and punctuation."""

_ATTITUDE = ("roll", "pitch", "heading")


def read_trajectory(
    path: Path | str, *, crs: str | None = None, lever_arm: tuple[float, float, float] | None = None
) -> Trajectory:
    """Return the positions of a trajectory file in the coordinates of the strip, with the times of the file.

    Parameters
    ----------
    path : Path or str
        Text with a header line, or an SBET.
    crs : str or None
        CRS of the strip as WKT or EPSG code; needed if the file has degrees.
    lever_arm : (float, float, float), m
        From the position of the file to the scanner: forward, right, down; needs roll, pitch and heading.

    Raises
    ------
    InputError
        If the file cannot be read or does not have what is needed.
    """
    path = Path(path)
    size, is_sbet = check_trajectory(path)
    if is_sbet:
        records = np.memmap(path, SBET_RECORD, "r")
        step = max(1, -(-len(records) // MOST_RECORDS))
        names = ("time", "latitude", "longitude", "height", *_ATTITUDE, "wander")
        columns = {name: widen_integers(records[name][::step]) for name in names}
        columns["z"], wander = columns.pop("height"), columns.pop("wander")
        inside = (np.abs(columns["latitude"]) <= np.pi / 2) & (np.abs(columns["longitude"]) <= 2 * np.pi)
        if not (inside & np.isfinite(columns["time"])).mean() > 0.99:
            raise InputError(
                f"{path}: not an SBET: its latitudes and longitudes are not radians; give text with headers"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # a few damaged records: not finite, and not used later
            # An SBET counts the heading in the wander frame, which is turned from north by the wander angle.
            columns["heading"] -= wander
            for name in ("latitude", "longitude"):
                columns[name] = np.degrees(columns[name])
    else:
        if size > MOST_TEXT:
            raise InputError(f"{path}: {size / 1e9:.1f} GB of text are too much; thin it to 20 positions per second")
        lines = path.read_text("utf-8", "replace").splitlines()
        place, found = _find_names(path, lines)
        listed = [name if name not in found[:i] else "" for i, name in enumerate(found)]
        body = (_split(line) for line in lines[place + 1 :])
        rows = [row for row in (_numbers(fields, len(listed)) for fields in body) if row is not None]
        if not rows:
            raise InputError(f"{path}: no line of numbers, such as 12.5, follows the header in line {place + 1}")
        table = np.array(rows)
        columns = {name: table[:, i] for i, name in enumerate(listed) if name}
        columns = {name: np.radians(values) if name in _ATTITUDE else values for name, values in columns.items()}
    if "x" in columns:
        xyz = np.stack([columns["x"], columns["y"], columns["z"]], axis=1)
    elif crs is None:
        raise InputError(f"{path}: the trajectory is in degrees, but the strip has no CRS; give a trajectory in metres")
    else:
        pyproj = need("pyproj", lambda advice: InputError(
            f"{path}: the trajectory is in degrees, which needs pyproj: {advice}; or give x, y, z in the strip's CRS"
        ))  # fmt: skip
        try:
            target = pyproj.CRS.from_user_input(crs)
            if target.is_geographic:
                words = "the strip's coordinates are degrees; wavebatch needs metres: project the strip"
                raise InputError(f"{path}: {words}")
            transformer = pyproj.Transformer.from_crs("EPSG:4979", target, always_xy=True)
            placed = transformer.transform(columns["longitude"], columns["latitude"], columns["z"])
        except pyproj.exceptions.ProjError as error:
            raise InputError(f"{path}: the CRS of the strip is not understood ({error}); give x, y, z") from error
        xyz = np.stack([np.asarray(values, np.float64) for values in placed], axis=1)
    if lever_arm is not None:
        missing = [name for name in _ATTITUDE if name not in columns]
        if missing:
            raise InputError(f"{path}: a lever arm needs {', '.join(_ATTITUDE)}; the file has no {', '.join(missing)}")
        xyz = apply_lever_arm(xyz, np.stack([columns[name] for name in _ATTITUDE], axis=1), lever_arm)
    with naming(path):
        return Trajectory.build(columns["time"], xyz)


def check_trajectory(path: Path) -> tuple[int, bool]:
    """Look at the beginning of a trajectory only, which takes no time; return its size and whether it is an SBET.

    Raises
    ------
    InputError
        If the file cannot be read, or is neither an SBET nor text whose columns have names.
    """
    with reporting_reads(path, "trajectory "), open_regular(path) as file:
        size, head = path.stat().st_size, file.read(MOST_HEAD)
    is_binary = b"\0" in head[:4096]
    if is_binary and size % SBET_RECORD.itemsize == 0:
        return size, True
    if is_binary or not head.strip():
        raise InputError(f"{path}: trajectory is neither text nor SBET (records of {SBET_RECORD.itemsize} bytes)")
    _find_names(path, head.decode("utf-8", "replace").splitlines())
    return size, False


def _find_names(path: Path, lines: list[str]) -> tuple[int, list[str]]:
    """The line that names the columns, and what they mean; InputError where there is none."""
    for place, line in enumerate(lines[:200]):
        found = []
        for field in _split(line):
            # The column that a name means; empty for other names, and for long ones, for which the patterns take hours.
            bare = re.sub(r"[\[(].*?[\])]", "", field.strip().lower()) if len(field) <= MOST_NAME else ""
            bare = re.sub(r"[^a-z]", "", re.sub(r"_(m|s|deg)$", "", bare))
            found.append(next((name for name, known in COLUMN_NAMES.items() if bare in known), ""))
        if "time" in found and ({"x", "y", "z"} <= set(found) or {"latitude", "longitude", "z"} <= set(found)):
            return place, found
    raise InputError(
        f"{path}: no line names the columns of the trajectory; the first line must hold time, x, y, z "
        "(or time, latitude, longitude, height)"
    )


def _split(line: str) -> list[str]:
    text = line.replace('"', "").strip().lstrip("#").strip()  # of a table, whose fields may all be quoted
    for mark in ("\t", ";", ","):
        if mark in text:
            return [field.strip() for field in text.split(mark)]
    return text.split()


def _numbers(fields: list[str], number: int) -> list[float] | None:
    try:
        return [float(field) if field else np.nan for field in fields[:number]] if len(fields) >= number else None
    except ValueError:
        return None
