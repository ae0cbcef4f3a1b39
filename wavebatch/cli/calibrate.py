"""`wavebatch calibrate`: the calibration constant from targets of known reflectance.

Only reads options and prints; the work is in `wavebatch.surveying.calibrating.calibrate_flight`.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.batch.options import RunOptions
from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, format_json, talk, tell
from wavebatch.files.disk.publish import protecting, refuse_input
from wavebatch.files.text_file import write_text
from wavebatch.surveying.calibrating.strip_echoes import CalibrationOptions
from wavebatch.tools.sheets.sheet import list_lines


@click.command()
@click.argument("strips", nargs=-1, required=True, type=shared.INPUT, metavar="STRIP...")
@shared.declared("recursive")
@shared.file_option("--targets",
                    text="Targets: GeoJSON polygons with the property reflectance, in WGS 84, in the CRS that the file "
                    "names, or in the coordinates of the strips; or CSV with reflectance and x, y, radius or vertices, "
                    "in the coordinates of the strips only.")
@shared.output_option("Calibration file to write.", "CAL.toml")
@shared.options_of(CalibrationOptions)
@shared.output_option("Also write constants, drifts and overlaps of the strips as JSON.", "FILE", "--report",
                      required=False)
@shared.chain_options
@shared.system_option
@shared.declared("energy")
@shared.sensor_options
@shared.declared("direction")
@shared.where_option("Use only pulses with a return (a point of the strips)")
@shared.html_option
@shared.common_options("overwrite", "json")
def calibrate(strips: tuple[Path, ...], targets: Path | None, output: Path, **options: Any) -> None:
    """Find the calibration constants of STRIPs over targets of known reflectance, for `wavebatch run --calibration`.

    STRIP is a LAS or LAZ file with waveforms, a glob, a folder, or @list.txt with one of these per line. Each channel
    (digitizer, or scanner channel of the points) gets its own constant.

    It uses echoes that are alone in their waveform, lie on the plane of a target, and have their whole footprint inside
    its outline. The incidence angle comes from that plane, unless the target file gives it. Unusable targets are
    rejected, with the reason. Pulse and chain are chosen as `wavebatch run` chooses them.

    Without targets, --from-column takes the sensor vendor's own reflectances; the spread says how well they agree.

    Several strips of a flight are calibrated together: flat places where strips or channels overlap tie those without
    a target to those with one. Each strip gets its constant, its drift, and their errors.

    Exit code: 0 done, 1 the strips or their targets give no constant, 2 wrong usage.

    Examples:
      # for `run --calibration cal.toml`
      wavebatch calibrate strip.las --targets targets.csv --divergence 0.5 -o cal.toml
      # with light that falls across the swath
      wavebatch calibrate *.laz --targets targets.csv --scan-angle --html cal.html -o cal.toml
    """  # fmt: skip
    from wavebatch.files.cloud.point_filter import PointFilter
    from wavebatch.surveying.calibrating.calibrate_flight import calibrate_flight
    from wavebatch.surveying.calibrating.calibration_files import format_calibration, load_targets
    from wavebatch.tools.api import find_request, read_sensor
    from wavebatch.tools.cells import doubt_clouds
    from wavebatch.tools.sheets.survey import calibration_page, calibration_sheet

    if (targets is None) == (options["column"] is None):
        raise click.UsageError("give --targets FILE, or --from-column NAME, and not both")
    paths = shared.find_inputs(strips, options)
    html_file, report, overwrite = options["html_file"], options["report"], options["overwrite"]
    with protecting(paths):  # a folder or a list among STRIPs holds inputs too
        for target in filter(None, (output, report, html_file)):
            refuse_input(target)
    shared.check_html(html_file)
    asked = shared.from_options(RunOptions, options)
    chain, request = find_request(asked)  # pulse and chain are chosen as `wavebatch run` chooses them
    how = shared.from_options(CalibrationOptions, options, sensor=read_sensor(asked), chain=chain, request=request,
                              selection=PointFilter(where=options["where"]))  # fmt: skip
    flight = calibrate_flight(paths, load_targets(targets) if targets else [], how)
    found = flight.calibration
    write_text(output, format_calibration(found), overwrite=overwrite)
    figures = {
        "schema": "wavebatch.calibration-report/1",
        **found.describe(),
        "strips": [asdict(row) for row in found.strips],
        "targets": [asdict(row) for row in found.targets],
        "pairs": [asdict(row) for row in flight.pairs],
        "cell_m": flight.cell,
        "warnings": list(found.notes),
    }
    if report is not None:
        write_text(report, format_json(figures) + "\n", overwrite=overwrite)
    answer(figures)
    talk(*(f"warning: {note}" for note in (*found.notes, *doubt_clouds(paths))))
    for line in list_lines(calibration_sheet(flight)):
        tell(line)
    tell(f"{output}: written")
    shared.write_html(html_file, found.strip or "strips", calibration_page(flight))
