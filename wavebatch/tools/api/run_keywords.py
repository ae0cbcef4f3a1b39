"""The keywords of `wavebatch.run` for type checkers, which cannot read them from RunOptions.

`tests/test_typing.py` holds that they are the fields of RunOptions with their types.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict

from wavebatch.core.condition import Condition
from wavebatch.stages.chain import Chain
from wavebatch.surveying.survey import Survey


class RunKeywords(TypedDict, total=False):
    """What RunOptions takes beside the output."""

    chain: Chain | Path | str | None
    profile: str | None
    tolerance: float | None
    system: Survey | Path | str | None
    force: bool
    survey: Literal["each", "flight"]
    calibration: Path | str | None
    direction: Literal["auto", "toward", "away"]
    headerless: bool
    recursive: bool
    trajectory: Path | str | None
    lever_arm: tuple[float, float, float] | None
    crs: str | None
    flight_height: float | None
    attenuation: float | None
    attenuation_error: float | None
    visibility: float | None
    wavelength: float | None
    energy: Path | str | None
    where: Condition | str | None
    drop_flags: str | None
    classes: tuple[int, ...] | None
    bbox: tuple[float, float, float, float] | None
    polygon: Path | str | None
    points: Literal["echoes", "returns"]
    columns: str | None
    names: Literal["wavebatch", "asprs", "riegl", "pdal", "opals"]
    format: Literal["laz", "las"]
    point_format: int | None
    las_version: Literal["1.4", "1.3", "keep"]
    no_data: Literal["-9999", "nan"]
    strict: bool
    keep_packets: bool
    jobs: int
    scheduler: str | None
    memory: int | None
    block_size: int | None
    overwrite: bool
    resume: bool
