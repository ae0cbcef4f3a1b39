"""Reflectance of surfaces that fill the beam. It needs the angle at which the surface was struck.

The angle comes from the points around an echo (known after the second pass over the strip), or from the echo's width.
Where neither is known, a column of another name takes the surface as level, with an error for its unknown slope.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.no_data import SUFFIX, NoData
from wavebatch.core.system import angle_to_vertical
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.physics import radiometry
from wavebatch.stages.attribute.light import (
    POSITION,
    Light,
    add_column,
    measure_light,
    without_calibration,
)
from wavebatch.stages.chain import Range, stage

REFLECTANCES = ("level_reflectance", "reflectance", "relative_reflectance")
"""Columns that footprints over an edge do not have."""

_ANGLE = {"normals": "incidence_angle_normals", "echo": "incidence_angle"}
"""Column of the angle, by the parameter `surface`."""


def _needs(parameters: Mapping[str, Any]) -> tuple[str, ...]:
    angle = _ANGLE[parameters["surface"]]
    return (*POSITION, "range_err", angle, f"{angle}_err")


@stage("attribute", makes=("reflectance", "reflectance_err", "facing_reflectance"), needs=_needs)
def reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    surface: Literal["normals", "echo"] = "normals",
) -> EchoTable:  # fmt: skip
    """Diffuse reflectance of each echo that is alone in its waveform, and its error; no-data for all others.

    gamma / (4 cos(alpha)): only a target that fills the beam has a reflectance. Its error holds that of the angle. With
    `normals`, `run` computes it in the second pass; a block alone gives no-data.

    Parameters
    ----------
    surface : {"normals", "echo"}
        Where alpha comes from: the points around the echo (column incidence_angle_normals of an earlier stage), or its
        width (column incidence_angle of an earlier stage). No-data where that column has none.

    References
    ----------
    docs/algorithms.md 5.
    """
    light = measure_light(block, system, echoes, 2)
    facing = _divide(block, echoes, "reflectance", light, np.zeros(len(echoes)), light.relative_error)
    echoes = echoes.with_attributes(facing_reflectance=facing.attributes["reflectance"])
    return _reflectance(block, echoes, "reflectance", light, surface)


@stage("attribute", makes=("relative_reflectance", "relative_reflectance_err"), needs=_needs)
def relative_reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    surface: Literal["normals", "echo"] = "normals",
) -> EchoTable:  # fmt: skip
    """Reflectance of each echo that is alone in its waveform, in units of its strip [DN ns m2], and its error.

    R^2 A sigma / (4 cos(alpha) eta(R)): the reflectance without the constant C', for strips without calibration.

    Parameters
    ----------
    surface : {"normals", "echo"}
        Where alpha comes from: the points around the echo (column incidence_angle_normals of an earlier stage), or its
        width (column incidence_angle of an earlier stage). No-data where that column has none.
    """
    light = measure_light(block, without_calibration(system), echoes, 2)
    return _reflectance(block, echoes, "relative_reflectance", light, surface)


@stage("attribute", makes=("level_reflectance", "level_reflectance_err"), needs=POSITION)
def level_reflectance(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    slope: Annotated[float, Range(0.0, 80.0)] = 30.0,
) -> EchoTable:  # fmt: skip
    """Diffuse reflectance of each echo alone in its waveform if its surface is level, and its error.

    gamma / (4 cos(angle of the ray to the vertical)). It needs no neighbours, but roofs and hillsides are not level:
    the error holds what a slope of `slope` degrees in an unknown direction does to it.

    Parameters
    ----------
    slope : float
        Slope of surfaces that the error shall cover [deg]; 0 where all of them are known to be level.

    References
    ----------
    docs/algorithms.md 5.
    """
    light, angle = measure_light(block, system, echoes, 2), angle_to_vertical(block.direction)[echoes.waveform]
    relative = np.hypot(light.relative_error, radiometry.slope_error(angle, np.radians(slope)))
    return _divide(block, echoes, "level_reflectance", light, angle, relative)


def hide_edges(echoes: EchoTable) -> EchoTable:
    """Leave out the level reflectance of echoes with the attribute `edge`: it is computed before edges are known."""
    name, edge = "level_reflectance", echoes.attributes["edge"]
    if name not in echoes.attributes:
        return echoes
    hidden = edge & np.isfinite(echoes.attributes[name])
    changed = {key: np.where(hidden, np.float32(np.nan), echoes.attributes[key]) for key in (name, f"{name}_err")}
    changed[f"{name}{SUFFIX}"] = np.where(hidden, np.uint8(NoData.EDGE), echoes.attributes[f"{name}{SUFFIX}"])
    return echoes.with_attributes(**changed)


def _reflectance(block: WaveformBlock, echoes: EchoTable, name: str, light: Light, surface: str) -> EchoTable:
    """The column for surfaces struck at the angle that another column has."""
    unknown = np.full(len(echoes), np.nan)
    known = (echoes.attributes.get(key, unknown) for key in (_ANGLE[surface], f"{_ANGLE[surface]}_err"))
    angle, angle_err = (np.radians(values.astype(np.float64)) for values in known)
    relative = radiometry.reflectance_error(light.relative_error, angle, angle_err)
    edge = echoes.attributes.get("edge", np.zeros(len(echoes), bool))
    return _divide(block, echoes, name, light, angle, relative, edge)


def _divide(
    block: WaveformBlock, echoes: EchoTable, name: str, light: Light, angle: np.ndarray, relative: np.ndarray,
    edge: np.ndarray | bool = False,
) -> EchoTable:  # fmt: skip
    """The column gamma / (4 cos(angle)) of echoes that are alone, with relative errors (m,); edge: they may not be."""
    alone = echoes.alone(len(block))
    rho = np.where(alone & ~light.bound & ~np.asarray(edge), radiometry.diffuse_reflectance(light.gamma, angle), np.nan)
    steep = angle >= radiometry.STEEPEST
    more = (
        (NoData.UNSETTLED, light.bound), (NoData.SHARED_PULSE, ~alone), (NoData.NO_ANGLE, np.isnan(angle)),
        (NoData.TOO_STEEP, steep), (NoData.EDGE, edge),
    )  # fmt: skip
    return add_column(echoes, name, rho, relative, *light.cases, *more)
