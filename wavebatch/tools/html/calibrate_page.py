"""The page of `wavebatch calibrate --html`: the constant, its targets and channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from wavebatch import __version__
from wavebatch.surveying.calibration import Calibration, format_calibration
from wavebatch.tools.html import markup
from wavebatch.tools.html.drawing.charts import draw_values, figures
from wavebatch.tools.html.page import write_page


def write_calibrate_page(target: Path, found: Calibration, notes: Sequence[str] = ()) -> None:
    """Write the page of a calibration; notes: what the command says about it."""
    write_page(target, f"wavebatch calibrate: {found.strip}", _parts(found, notes))


def _parts(found: Calibration, notes: Sequence[str]) -> Iterator[str]:
    rows = {
        "constant": f"{found.constant:.6g} +- {100 * found.relative_error:.1f} %, 1/(m2 DN ns)",
        "attenuation of the air": f"{found.attenuation:g} dB/km one way",
        "divergence": "not given" if found.divergence is None else f"{found.divergence:g} mrad",
        "conditions": found.conditions,
    }
    yield markup.section("Summary", markup.facts(rows), markup.bullets(notes, "warning"))
    targets = [[one.name, one.reflectance, one.echoes, one.constant,
                None if one.spread is None else 100 * one.spread, one.incidence_deg,
                "used" if one.constant is not None else "too few echoes, left out"]
               for one in found.targets]  # fmt: skip
    head = ["target", "reflectance", "echoes", "constant", "spread %", "incidence deg", ""]
    used = [one for one in found.targets if one.constant is not None]
    charts = []
    if used:
        errors = [one.constant * (one.spread or 0.0) for one in used if one.constant is not None]
        charts.append(draw_values([one.name for one in used], [one.constant or 0.0 for one in used], errors,
                                  title="Constant of each target, with the spread of its echoes",
                                  label="1/(m2 DN ns)"))  # fmt: skip
    yield markup.section("Targets", markup.table(head, targets, sortable=True), figures(charts))
    if found.channels:
        channels = [[one.digitizer, one.scanner, one.echoes, one.constant, 100 * one.relative_error, 100 * one.spread]
                    for one in found.channels]  # fmt: skip
        head = ["digitizer", "scanner channel", "echoes", "constant", "error %", "spread %"]
        yield markup.section("Channels", markup.table(head, channels))
    provenance = {"wavebatch": __version__, "strip": found.strip, "date of the strip": found.date}
    yield markup.section("Provenance", markup.facts(provenance), markup.code(format_calibration(found)))
