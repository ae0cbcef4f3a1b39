"""Incidence angles from the points around an echo: the check for angles from echo widths."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.geometry.normals import measure_normals
from wavebatch.stages.chain import Range, stage


@stage(
    "attribute",
    makes=("incidence_angle_normals", "incidence_angle_normals_err"),
    needs=("x", "y", "z"),
    second_pass=measure_normals,
)
def incidence_angle_normals(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    radius: Annotated[float, Range(0.0, 1000.0)] = 1.5,
    min_points: Annotated[int, Range(4, 10_000)] = 8,
    max_error: Annotated[float, Range(1e-3, 180.0)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Angle between the packet's ray and the normal of the plane of the points around each echo [deg]; its error.

    `run` computes it in a second pass, when all points of the strip are there; a block alone gives no-data. The plane
    is fitted to all points within the radius that are not outliers. It needs neither sensor nor divergence.

    No-data where there are fewer than min_points, or only two scan lines of them (any two lines are in a plane); where
    the points form no plane (plants: less than 60 % of them in it, thicker than a fifth of its width, or the echo not
    in it) or clearly two (a ridge, a valley or a step close by); where the angle exceeds 80 degrees (one sweep of the
    scanner over plants makes a plane that contains its rays); and where its error exceeds max_error. The error includes
    the change that two planes instead of one would make.

    Parameters
    ----------
    radius : float
        Radius of the neighbourhood [m]; three times the distance between points is a good start. 0: `run` chooses 1.5
        or as much more as the distance between the points of the strip asks for, 12 at most.
    min_points : int
        Least number of points in the neighbourhood, and in the plane.
    max_error : float
        Largest standard deviation of an angle that is written [deg].

    References
    ----------
    Rhomberg-Kauert et al. (2024), comparison of Fig. 6; docs/algorithms.md 1.4.
    """
    if not (radius == 0 or 1e-3 <= radius <= 1e3) or min_points < 4 or not max_error > 0:
        raise ConfigError("radius must be 0 or lie in 0.001 to 1000 m, min_points be 4 at least, max_error above 0")
    none = np.full(len(echoes), np.nan, np.float32)
    return echoes.with_attributes(incidence_angle_normals=none, incidence_angle_normals_err=none)
