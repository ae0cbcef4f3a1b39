"""`wavebatch calibrate`: the calibration constant from targets of known reflectance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import debug_option, report_errors, talk
from wavebatch.cli.options import direction_option, overwrite_option, read_sensor, sensor_options, system_option

LEAST_DOUBT = 0.03
"""Relative error of a target, at least: constants that differ by six times this or its stated error are told."""


@click.command()
@click.argument("strip", type=click.Path(path_type=Path))
@click.option("--targets", required=True, type=click.Path(path_type=Path), metavar="FILE",
              help="GeoJSON polygons with reflectance, or CSV with reflectance and x, y, radius or vertices.")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), metavar="CAL.toml", help="The result.")
@sensor_options
@system_option
@click.option("--attenuation", type=click.FloatRange(0.0, 100.0), default=0.22, show_default=True, metavar="DB/KM",
              help="Of the air, one way.")
@click.option("--divergence", type=click.FloatRange(0.001, 100.0), metavar="MRAD",
              help="Full angle of the beam between the 1/e^2 points; cross sections need it.")
@click.option("--reflectance-error", type=click.FloatRange(0.0, 1.0), default=0.03, show_default=True, metavar="SHARE",
              help="Standard deviation of the targets' reflectances, relative.")
@direction_option
@overwrite_option
@debug_option
@report_errors()
def calibrate(
    strip: Path,
    targets: Path,
    output: Path,
    system_file: Path | None,
    attenuation: float,
    divergence: float | None,
    reflectance_error: float,
    direction: str,
    overwrite: bool,
    debug: bool,
    **options: Any,
) -> None:
    """The calibration constant of a strip over targets of known reflectance, for `wavebatch run --calibration`.

    Only echoes that are alone in their waveform and lie on a target count; angles come from each target's own plane,
    unless its file gives an incidence. Where several channels (digitizers, or scanner channels of the points) saw
    targets, each gets a constant of its own, and all others that of all together. Exit code: 0, 1 where the strip or
    its targets give no constant, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.files.disk.publish import refuse_existing
    from wavebatch.files.text_file import write_text
    from wavebatch.surveying.calibration import format_calibration
    from wavebatch.surveying.system_file import load_survey
    from wavebatch.surveying.targets import calibrate_strip, load_targets

    sensor = read_sensor(options)
    if not overwrite:
        refuse_existing(output)
    found = calibrate_strip(
        strip,
        load_targets(targets),
        sensor=sensor,
        system=load_survey(system_file).survey.system if system_file else None,
        attenuation=attenuation,
        divergence=divergence,
        reflectance_error=reflectance_error,
        direction=direction,
    )
    write_text(output, format_calibration(found), overwrite=overwrite)
    for target in found.targets:
        said = f"constant {target['constant']:.4g}, spread {100 * target['spread']:.1f} %, incidence " \
            f"{target['incidence_deg']:.1f} deg" if "constant" in target else "too few, left out"  # fmt: skip
        talk(f"{target['name']}: reflectance {target['reflectance']:g}, {target['echoes']} echoes, {said}")
    constants = [target["constant"] for target in found.targets if "constant" in target]
    ratio = max(constants) / min(constants)
    if ratio > 1 + 6 * max(reflectance_error, LEAST_DOUBT) and not found.channels:  # channels may differ
        talk(f"note: constants of the targets differ by a factor of {ratio:.2f}: check reflectances and coordinates")
    for channel in found.channels:
        error, spread = 100 * channel["relative_error"], 100 * channel["spread"]
        numbers = f"constant {channel['constant']:.4g} +- {error:.1f} %, spread {spread:.1f} %"
        where = f"digitizer {channel['digitizer']}, scanner channel {channel['scanner']}"
        talk(f"{where}: {channel['echoes']} echoes, {numbers}")
    talk(f"{output}: constant {found.constant:.6g} +- {100 * found.relative_error:.1f} %; {found.conditions}")
