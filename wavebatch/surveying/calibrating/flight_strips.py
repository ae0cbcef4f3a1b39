"""One strip of a flight that is calibrated: its echoes on targets, and in the squares that tie it to other strips.

`calibrate_flight` calls `read_strip` for each strip, and keeps the result only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.system import angle_across, angle_to_vertical
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.calibrating.adjust_flight import TIE, VIEW, hash_squares
from wavebatch.surveying.calibrating.strip_echoes import ECHO, CalibrationOptions, EchoSource, open_source
from wavebatch.surveying.calibrating.target_file import Target
from wavebatch.surveying.calibrating.targets import (
    MOST_ECHOES,
    build_calibration,
    describe_channel,
    measure_ranging,
)
from wavebatch.surveying.calibration import Calibration, ChannelConstant
from wavebatch.surveying.matching.setting import SCANNERS, see_channels
from wavebatch.surveying.matching.strip_energies import StripEnergies

MOST_TIES = 200_000
"""Most waveforms of a strip that are decomposed for ties; they come from whole squares of 10 m, spread by chance."""

MOST_OF_COLUMN = 20_000
"""Most waveforms of a strip that are decomposed for a column of reflectances, from whole squares as well."""

_Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper corner in x and y [m]."""


@frozen(eq=False)
class FlightStrip:
    """What is kept of one strip."""

    path: Path
    sha256: str
    found: Calibration | None
    """The calibration by targets on this strip."""
    refused: str
    channels: tuple[ChannelConstant, ...]
    """How each of its channels records."""
    ranging: float
    """Relative error of a constant from the errors of the sensor's position and of the level of the energies."""
    sent: StripEnergies
    ties: np.ndarray
    """Array of TIE, with channels as sources."""
    seen: Mapping[int, np.void]
    """How the targets were seen by each channel, as VIEW."""
    right: tuple[float, float]
    """Unit vector to the right of its flight."""


class Source(NamedTuple):
    """A channel of a strip: what has a constant."""

    strip: FlightStrip
    row: ChannelConstant
    """How it records."""

    @property
    def channel(self) -> int:
        """Its number; the same in all strips."""
        return SCANNERS * self.row.digitizer + self.row.scanner

    @property
    def given(self) -> ChannelConstant | None:
        """Its constant by the targets on the strip; None without."""
        found = self.strip.found.channels if self.strip.found else ()
        return next((row for row in found if Source(self.strip, row).channel == self.channel), None)

    @property
    def name(self) -> str:
        """Of the strip, and of the channel where the strip has several."""
        of = f" digitizer {self.row.digitizer} scanner channel {self.row.scanner}"
        return self.strip.path.name + (of if len(self.strip.channels) > 1 else "")


def find_box(path: Path) -> _Box:
    """Lower and upper corner of a strip in x and y by its header."""
    with StripReader(path) as reader:
        header = reader.facts.header
        return np.array(header.mins[:2]), np.array(header.maxs[:2])


def read_strip(
    path: Path,
    number: int,
    boxes: Sequence[_Box],
    targets: Sequence[Target],
    options: CalibrationOptions,
) -> FlightStrip:
    """Decompose what lies on targets or in the overlap with other strips, in one pass."""
    with open_source(path, options) as source:
        header = source.reader.facts.header
        targets = [target.place(path, header) for target in targets]
        seen = see_channels(source.reader, source.scan)
        known = source.reader.facts.digitizers  # points may name others: they have no waveform
        channels = [ChannelConstant(*channel, 1.0, 0.0) for channel in seen if channel[0] in known]
        others = [box for i, box in enumerate(boxes) if i != number]
        area = _TieArea(
            boxes[number], boxes[0][0], [boxes[number]] if len(channels) > 1 else others, source.scan.packets
        )
        on_targets, ties = _collect(source, targets, area)
        found, refused = None, ""
        try:
            found = build_calibration(source, targets, on_targets, options)
        except InputError as error:
            refused = str(error)
        distance = np.array([source.sensor.distance or math.inf])
        return FlightStrip(
            path=path,
            sha256=take_fingerprint(path, source.reader.facts.packets.file)["sha256_sampled"],
            found=found,
            refused=refused,
            channels=tuple(describe_channel(row, source) for row in channels),
            ranging=math.hypot(measure_ranging(source.sensor, distance, source.air), source.sent.growth),
            sent=source.sent,
            ties=ties,
            seen=_see_targets(on_targets, source.setting.right),
            right=source.setting.right,
        )


def _see_targets(on_targets: Sequence[np.ndarray], right: tuple[float, float]) -> dict[int, np.void]:
    """How each channel saw the targets in the middle, as VIEW; good targets are level."""
    rows, seen = np.concatenate(on_targets), {}
    for channel in np.unique(rows["channel"]).tolist():
        mine, view = rows[rows["channel"] == channel], np.zeros(1, VIEW)[0]
        view["angle"] = np.median(angle_across(mine["ray"], right))
        view["incidence"] = np.median(angle_to_vertical(mine["ray"]))
        view["distance"], view["time"] = np.median(mine["distance"]), np.median(mine["time"])
        seen[channel] = view
    return seen


class _TieArea:
    """Where a strip is decomposed for ties: squares in the boxes of those that it is tied to."""

    def __init__(self, own: _Box, origin: np.ndarray, tied: Sequence[_Box], packets: int) -> None:
        self.origin, self._tied = origin, tied
        area = float(np.prod(np.maximum(own[1] - own[0], 1.0)))
        common = [np.maximum(np.minimum(own[1], top) - np.maximum(own[0], low), 0.0) for low, top in tied]
        shared = min(sum(float(np.prod(edge)) for edge in common), area)
        self._share = MOST_TIES / max(packets * shared / area, MOST_TIES)
        """Of the squares, so that about MOST_TIES waveforms are decomposed."""

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        """Return which positions f8 (n, 3) count, bool (n,)."""
        inside = np.zeros(len(xyz), bool)
        for low, top in self._tied:
            inside |= ((xyz[:, :2] >= low) & (xyz[:, :2] <= top)).all(axis=1)
        return inside & (hash_squares(xyz) < self._share)


def _lies_on(target: Target, xyz: np.ndarray) -> np.ndarray:
    return target.contains(xyz[:, 0], xyz[:, 1])


def _collect(source: EchoSource, targets: Sequence[Target], area: _TieArea) -> tuple[list[np.ndarray], np.ndarray]:
    """Echoes on each target (ECHO), and those for ties (TIE, with channels as sources)."""
    if source.column is not None:
        share = MOST_OF_COLUMN / max(source.scan.packets, 1)
        near = lambda xyz: hash_squares(xyz) < share  # noqa: E731
        inside = [near]
    else:
        corners = np.concatenate([target.corners for target in targets])
        low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
        near = lambda xyz: ((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)  # noqa: E731
        inside = [partial(_lies_on, target) for target in targets]
    on_targets: list[list[np.ndarray]] = [[np.empty(0, ECHO)] for _ in inside]
    parts = [np.empty(0, TIE)]

    def wanted(xyz: np.ndarray) -> np.ndarray:
        return near(xyz) | area.contains(xyz)

    for rows in source.echoes(wanted):
        for contains, some in zip(inside, on_targets, strict=True):
            if sum(map(len, some)) < MOST_ECHOES:
                some.append(rows[contains(rows["xyz"])])
        parts.append(_shorten(rows[area.contains(rows["xyz"]) & np.isfinite(rows["light_err"])], area.origin))
    return [np.concatenate(some)[:MOST_ECHOES] for some in on_targets], np.concatenate(parts)


def _shorten(rows: np.ndarray, origin: np.ndarray) -> np.ndarray:
    short = np.empty(len(rows), TIE)
    short["xyz"] = rows["xyz"] - [*origin, 0.0]
    short["source"] = rows["channel"]
    for name in ("ray", "light", "distance", "time"):
        short[name] = rows[name]
    return short
