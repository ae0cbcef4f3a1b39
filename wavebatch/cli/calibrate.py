"""`wavebatch calibrate`: the calibration constant from targets of known reflectance.

Only reads options and prints; the work is in `wavebatch.surveying.targets`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import count, talk

LEAST_DOUBT = 0.03
"""Smallest relative error that a target is credited with: constants of targets that differ by more than six times
this, or six times the stated error, give a note."""


@click.command()
@shared.strip_argument
@shared.file_option("--targets", required=True, text="Targets: GeoJSON polygons with the property reflectance, or CSV "
                    "with reflectance and x, y, radius or vertices.")
@shared.output_option("Calibration file to write.", "CAL.toml")
@click.option("--reflectance-error", type=click.FloatRange(0.0, 1.0), default=0.03, show_default=True, metavar="SHARE",
              help="Relative standard deviation of the reflectances of the targets.")
@click.option("--attenuation", type=click.FloatRange(0.0, 100.0), default=0.22, show_default=True, metavar="DB/KM",
              help="Attenuation of the air, one way [dB/km].")
@click.option("--divergence", type=click.FloatRange(0.001, 100.0), metavar="MRAD",
              help="Full angle of the beam between the 1/e^2 points [mrad]; cross sections need it.")
@shared.system_option
@shared.sensor_options
@shared.direction_option
@shared.common_options("overwrite")
def calibrate(strip: Path, targets: Path, output: Path, overwrite: bool, **options: Any) -> None:
    """Find the calibration constant of a strip over targets of known reflectance, for `wavebatch run --calibration`.

    Used are echoes that are alone in their waveform and lie on a target. The incidence angle comes from the plane of
    each target, unless the target file gives it. If several channels (digitizers, or scanner channels of the points)
    saw targets, each gets its own constant; other channels get the constant of all together.

    Exit code: 0 done, 1 the strip or its targets give no constant, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.files.disk.publish import refuse_existing
    from wavebatch.files.text_file import write_text
    from wavebatch.surveying.calibration import format_calibration
    from wavebatch.surveying.targets import calibrate_strip, load_targets

    sensor = shared.read_sensor(options)
    refuse_existing(output, overwrite)
    loaded, saved = load_targets(targets), shared.read_system(options)
    names = ("attenuation", "divergence", "reflectance_error", "direction")
    figures = {name: options[name] for name in names}
    known = saved and saved.survey
    found = calibrate_strip(strip, loaded, sensor=sensor, survey=known, force=options["force"], **figures)
    write_text(output, format_calibration(found), overwrite=overwrite)
    for target in found.targets:
        result = "too few, left out"
        if target.constant is not None:
            numbers = f"constant {target.constant:.4g}, spread {100 * target.spread:.1f} %"
            result = f"{numbers}, incidence {target.incidence_deg:.1f} deg"
        talk(f"{target.name}: reflectance {target.reflectance:g}, {count(target.echoes, 'echo')}, {result}")
    constants = [target.constant for target in found.targets if target.constant is not None]
    ratio = max(constants) / min(constants)
    # Channels may have different constants, so that their targets may differ too.
    if ratio > 1 + 6 * max(options["reflectance_error"], LEAST_DOUBT) and not found.channels:
        talk(f"note: constants of the targets differ by a factor of {ratio:.2f}: check reflectances and coordinates")
    for channel in found.channels:
        error, spread = 100 * channel.relative_error, 100 * channel.spread
        numbers = f"constant {channel.constant:.4g} +- {error:.1f} %, spread {spread:.1f} %"
        where = f"digitizer {channel.digitizer}, scanner channel {channel.scanner}"
        talk(f"{where}: {count(channel.echoes, 'echo')}, {numbers}")
    talk(f"{output}: constant {found.constant:.6g} +- {100 * found.relative_error:.1f} %; {found.conditions}")
