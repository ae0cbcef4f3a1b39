"""The lookup table of a sensor: which echo width means which incidence angle, and how sure that is.

`wavebatch survey --angles` writes it as .csv or draws it. The widths go through the functions of stage
attribute.incidence_angle, so that the table is what a run writes for surfaces that fill the beam.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy  # parts of it load when they are first asked for

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.publish import check_target
from wavebatch.files.figure_file import check_picture, open_picture, plain_text, set_head
from wavebatch.files.text_file import write_text
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.physics.incidence import angle_of_spread, spread_of_angle
from wavebatch.stages.attribute.incidence_angle import added_variance
from wavebatch.surveying.angle_limits import REFERENCE_ERROR
from wavebatch.tools.plots.draw_cloud import SERIES
from wavebatch.tools.sheets.sheet import format_csv

ANGLES = np.arange(0.0, 81.0)
"""Angles of the table [deg]."""

DRAWN = (1.0, 0.25, 4.0)
"""Amplitudes over that of the table for which a picture has errors."""

_DRAWS = 2000
"""Measured widths, evenly drawn from their law, from which the error of an angle is computed."""

_WIDEST, _FINE = 40.0, 20_000
"""Largest width that is tried [system widths], and number of widths."""


@frozen(eq=False)
class AngleTable:
    """Widths by angle at one distance and amplitude; NaN where no width means the angle."""

    distance: float
    """Sensor to echo [m]."""
    divergence: float
    """Full angle of the beam between the 1/e^2 points [mrad]."""
    amplitude: float
    """Of the echoes whose errors are given [DN]."""
    angle: np.ndarray
    """f8 (a,) [deg]."""
    spread: np.ndarray
    """What the surface adds to the pulse, as a standard deviation, f8 (a,) [ns]."""
    width: np.ndarray
    """Column echo_width, f8 (a,) [ns]."""
    error: np.ndarray
    """Root mean square error of the angle that a run gives one echo of a surface with this angle, f8 (a,) [deg]."""


def tabulate_angles(
    system: SystemPulse, spacing: float, distance: float, divergence: float, amplitude: float
) -> AngleTable:
    """The table of a system; amplitude: of the echoes for whose noise errors are given [DN]."""
    beam = 1e-3 * divergence
    spread = spread_of_angle(np.radians(ANGLES), distance, divergence=beam)
    tried = np.linspace(0.3, _WIDEST, _FINE) * system.sigma_ref
    variance, _ = _add_variance(system, spacing, tried, np.zeros(_FINE))
    sigma = np.interp(spread**2, variance, tried, left=np.nan, right=np.nan)
    bound = np.array([bound_time(max(amplitude, 1e-3), max(one, 1e-6), system.noise.std, spacing)
                      for one in np.nan_to_num(sigma, nan=1.0)])  # fmt: skip
    variance, variance_err = _add_variance(system, spacing, sigma, bound)
    error = _expect_error(variance, variance_err, distance, beam)
    width = FWHM_PER_SIGMA * sigma
    return AngleTable(distance, divergence, amplitude, ANGLES, spread, width, np.where(np.isnan(sigma), np.nan, error))


def _expect_error(variance: np.ndarray, variance_err: np.ndarray, distance: float, beam: float) -> np.ndarray:
    """Root mean square error of the angles of many echoes of each surface [deg].

    The error column of a run belongs to one measured width: over the widths it jumps near 0, where half of the echoes
    are read as 0. What a surface gives on average does not.
    """
    normal = np.sqrt(2.0) * scipy.special.erfinv(np.arange(-_DRAWS + 1, _DRAWS, 2) / _DRAWS)
    measured = variance[:, None] + variance_err[:, None] * normal
    angle = angle_of_spread(np.sqrt(np.maximum(measured, 0.0)), distance, beam)
    return np.degrees(np.sqrt(np.mean((angle - np.radians(ANGLES)[:, None]) ** 2, axis=1)))


def _add_variance(
    system: SystemPulse, spacing: float, sigma: np.ndarray, sigma_err: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Variance that a surface added to echoes of these widths, as the stage computes it [ns2]."""
    block = WaveformBlock.from_samples(np.zeros((1, 2), np.uint8), bits=8, spacing=spacing)
    zero = np.zeros(len(sigma))
    echoes = EchoTable.build(zero.astype(int), zero, zero + 1.0, sigma, sigma_err=sigma_err)
    return added_variance(block, system, echoes, "system", REFERENCE_ERROR)


def check_angles(target: Path, *, overwrite: bool) -> None:
    """Raises ConfigError or InputError if the table cannot be written there."""
    if target.suffix.lower() == ".csv":
        check_target(target, overwrite=overwrite)
    else:
        check_picture(target, overwrite=overwrite)


def write_angles(
    target: Path,
    system: SystemPulse,
    *,
    spacing: float,
    distance: float | None,
    amplitude: float,
    strip: str = "",
    overwrite: bool = False,
) -> None:
    """Writes the table of a strip as .csv, or draws it; strip: its name, for the title.

    Raises ConfigError where the beam is not known, InputError where the sensor's position is not known or no width of
    this system means an angle.
    """
    if not system.radiometry.divergence:
        raise ConfigError(f"--angles {target}: the beam is not known; give --divergence")
    if distance is None:
        raise InputError(f"--angles {target}: the distance of the sensor is not known, so no width means an angle")
    if math.isinf(system.widths.error or 0.0):
        raise InputError(f"--angles {target}: the strip does not show which width a surface has that faces the sensor")
    beam = system.radiometry.divergence
    tables = [tabulate_angles(system, spacing, distance, beam, part * amplitude) for part in DRAWN]
    if target.suffix.lower() == ".csv":
        write_text(target, format_angles(tables[0]), overwrite=overwrite)
    else:
        draw_angles(tables, target, strip=strip, overwrite=overwrite)


def format_angles(found: AngleTable) -> str:
    """The table as CSV; empty cells are no data."""
    head = ("angle_deg", "spread_ns", "echo_width_ns", "angle_err_deg", "distance_m", "divergence_mrad",
            "amplitude_DN")  # fmt: skip
    same = map(float, (found.distance, found.divergence, found.amplitude))
    columns = (found.angle, found.spread, found.width, found.error, *(np.full(len(found.angle), one) for one in same))
    return format_csv(head, zip(*columns, strict=True), digits=6)


def draw_angles(tables: Sequence[AngleTable], target: Path, *, strip: str = "", overwrite: bool = False) -> None:
    """Writes a picture of the angles, and of their errors for echoes of each table's amplitude.

    Raises as figure_file.open_picture does.
    """
    found = tables[0]
    with open_picture(target, (7.0, 6.0), overwrite=overwrite) as figure:
        axes, errors = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        axes.plot(found.width, found.angle, color=SERIES[0], linewidth=1.5)
        axes.set(ylim=(0, 90), ylabel="incidence angle [deg]")
        for one, color in zip(tables, SERIES, strict=False):
            errors.plot(one.width, one.error, color=color, linewidth=1.2, label=f"echoes of {one.amplitude:.0f} DN")
        errors.set_yscale("log")
        errors.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        errors.set(xlabel="echo_width [ns]", ylabel="rms error [deg]")
        parts = [plain_text(strip), f"{found.distance:.0f} m, {found.divergence:g} mrad"]
        set_head(figure, [part for part in parts if part], size=10.5)
        errors.legend(loc="upper right")
