"""`wavebatch calibrate`: the calibration constant from targets of known reflectance.

Only reads options and prints; the work is in `wavebatch.surveying.targets`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import count, talk
from wavebatch.core.errors import ConfigError

if TYPE_CHECKING:
    from wavebatch.surveying.calibration import ChannelConstant, TargetResult
    from wavebatch.surveying.targets import CalibrationOptions


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
@shared.chain_options
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
    from wavebatch.surveying.calibrating.calibration_file import format_calibration
    from wavebatch.surveying.calibrating.target_file import load_targets
    from wavebatch.surveying.targets import calibrate_strip

    refuse_existing(output, overwrite)
    found = calibrate_strip(strip, load_targets(targets), _read_options(options))
    write_text(output, format_calibration(found), overwrite=overwrite)
    for line in [*map(_describe_target, found.targets), *map(_describe_channel, found.channels)]:
        talk(line)
    for note in found.notes:
        talk(f"warning: {note}")
    talk(f"{output}: constant {found.constant:.6g} +- {100 * found.relative_error:.1f} %; {found.conditions}")


def _read_options(options: dict[str, Any]) -> CalibrationOptions:
    """How to measure; pulse and chain are chosen as `wavebatch run` chooses them."""
    from wavebatch.surveying.targets import CalibrationOptions
    from wavebatch.tools.api.run import find_request

    if options["chain_file"] is not None and options["profile"] is not None:
        raise ConfigError("--chain and --profile exclude each other; give one of them")
    chain, request = find_request(options["chain_file"] or options["profile"], system=options["system_file"])
    names = ("attenuation", "divergence", "reflectance_error", "direction")
    figures = {name: options[name] for name in names}
    return CalibrationOptions(sensor=shared.read_sensor(options), chain=chain, request=request, **figures)


def _describe_target(target: TargetResult) -> str:
    if target.constant is None:
        return f"{target.name}: reflectance {target.reflectance:g}, refused: {target.refused}"
    return (
        f"{target.name}: reflectance {target.reflectance:g}, {count(target.echoes, 'echo')}, constant "
        f"{target.constant:.4g}, spread {100 * target.spread:.1f} %, incidence {target.incidence_deg:.1f} +- "
        f"{target.incidence_error_deg:.1f} deg"
    )


def _describe_channel(channel: ChannelConstant) -> str:
    return (
        f"digitizer {channel.digitizer}, scanner channel {channel.scanner}: {count(channel.echoes, 'echo')}, constant "
        f"{channel.constant:.4g} +- {100 * channel.relative_error:.1f} %, spread {100 * channel.spread:.1f} %, "
        f"from shot to shot {100 * channel.shot_energy:.1f} %"
    )
