"""`wavebatch compare`: two clouds, two chains, or one of them with the vendor's returns or the truth.

Reads options and checks thresholds; figures come from `wavebatch.tools.pairing` and `compare_chains`, their
sheet from `tools.sheets`.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import print_result, talk, tell
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.disk.publish import check_target
from wavebatch.files.text_file import write_text
from wavebatch.tools.pairing import Comparison, compare_clouds, compare_truth
from wavebatch.tools.sheets.compare import comparison_sheet, format_comparison, write_compare_page

if TYPE_CHECKING:
    from wavebatch.tools.compare_chains import Matchup

EXIT_VIOLATED = 1
"""A threshold was not met."""

FEW_COMMON = 0.5
"""Share of the fewer echoes in common below which two results may be of two strips: chains share far more."""

_SHARE = {"type": click.FloatRange(0.0, 1.0), "metavar": "SHARE"}
_TIME = {"type": click.FloatRange(0.0), "metavar": "NS"}


@click.command()
@click.argument("a", type=shared.INPUT)
@click.argument("b", type=shared.INPUT, required=False)
@shared.file_option("--truth", text="Compare A with this truth of a simulated strip, instead of B.")
@shared.file_option("--strip", metavar="STRIP", text="Run A and B on the waveforms of this strip; A and B are then "
                    "chain files, fast, balanced, accurate or auto.")
@shared.system_option
@click.option("--limit", type=click.IntRange(1), metavar="N",
              help="With --strip: use about N waveforms, spread over the strip, instead of all.")
@shared.where_option("Compare at the points of both clouds, or at those of A with --truth (all true echoes count)")
@click.option("--within", type=float, metavar="NS",
              help="Largest time difference of the same echo [ns].  [default: 1; with --truth: 1.5]")
@click.option("--min-completeness", **_SHARE, help="Least share of B's echoes that A has.")
@click.option("--min-correctness", **_SHARE, help="Least share of A's echoes that B has.")
@click.option("--min-exact", **_SHARE, help="Least share of pulses with the same number of echoes in A and B.")
@click.option("--max-median", **_TIME, help="Largest absolute median of the time differences [ns].")
@click.option("--max-rmse", **_TIME, help="Largest root mean square of the time differences [ns].")
@click.option("--max-nmad", **_TIME, help="Largest robust spread of the time differences [ns].")
@shared.html_option
@shared.output_option("Write all figures as a table, one per row.", "FILE.csv", required=False)
@shared.common_options("overwrite", "json", failure=2)
def compare(
    a: Path,
    b: Path | None,
    strip: Path | None,
    truth: Path | None,
    html_file: Path | None,
    as_json: bool,
    output: Path | None,
    overwrite: bool,
    **options: Any,
) -> None:
    """Compare the echoes of cloud A with those of B: another cloud, or the strip with the vendor's returns.

    Two echoes of a pulse are the same if their times differ by at most --within. Points that were passed through
    without an echo are ignored.

    With --strip, A and B are chains. They run on the strip and are compared waveform by waveform: with each other, with
    the vendor's returns, and by their goodness of fit. One of them may be a cloud. Without B, A is compared with the
    vendor's returns.

    Exit code: 0 done, 1 a threshold (--min-..., --max-...) is not met, 2 wrong usage or a file cannot be read.

    Examples:
      # a cloud with the vendor's returns
      wavebatch compare clouds/strip.laz strip.las
      # two chains on the waveforms of a strip
      wavebatch compare --strip strip.las fast accurate
      # with the truth; exit code 1 below 95 %
      wavebatch compare clouds/strip.laz --truth truth.npz --min-completeness 0.95
    """  # fmt: skip
    shared.check_html(html_file)
    if output is not None:
        check_target(output, overwrite=overwrite)
    result = _match(a, b, strip, options) if strip else _compare(a, b, truth, options)
    between = result.between if strip else result
    if output is not None:
        write_text(output, format_comparison(result.to_json()), overwrite=overwrite)
    print_result(as_json, result.to_json(), comparison_sheet(result), "chains" if strip else "")
    fewer = min(between.echoes_a, between.echoes_b)
    if fewer and between.matched <= fewer * (FEW_COMMON if options["within"] is None else 0.0):
        common = f"{between.matched} of {fewer} echoes" if between.matched else "no echo"
        talk(
            f"warning: A and B have {common} in common; are they results of one strip, in one CRS? "
            "Positions of two formats may differ: try a larger --within"
        )
    broken = _check_thresholds(between, options)
    if html_file is not None:
        write_compare_page(html_file, result, broken)
        tell(f"{html_file}: written")
    for line in broken:
        talk(line)
    if broken:
        sys.exit(EXIT_VIOLATED)


def _compare(a: Path, b: Path | None, truth: Path | None, options: dict) -> Comparison:
    if (b is None) == (truth is None):
        raise click.UsageError("give either B or --truth FILE.npz")
    for side in (a, b):
        if side is not None and _is_chain(side):
            raise click.UsageError(f"{side} is a chain; give the strip to run it on with --strip STRIP")
    if b is not None and b.suffix.lower() == ".npz":
        raise click.UsageError(f"{b} looks like a truth file; give it with --truth")
    how = {} if options["within"] is None else {"tolerance_ns": options["within"]}
    how["chosen"] = PointFilter(where=options["where"])
    return compare_truth(a, truth, **how) if truth else compare_clouds(a, b, **how)


def _is_chain(side: Path) -> bool:
    from wavebatch.tools.compare_chains import find_contender

    return side.suffix.lower() == ".toml" or (not side.is_file() and not find_contender(str(side)).is_cloud)


def _match(a: Path, b: Path | None, strip: Path, options: dict) -> Matchup:
    from wavebatch.core.errors import nearest
    from wavebatch.surveying.choose_chain import COSTS
    from wavebatch.surveying.system_file import load_survey
    from wavebatch.tools.api import AUTO
    from wavebatch.tools.compare_chains import find_contender, match_sides

    saved = None if options["system"] is None else load_survey(options["system"])
    sides = [None if side is None else find_contender(str(side)) for side in (a, b)]
    for side in sides:
        if side is not None and side.is_cloud and not Path(side.name).exists():
            chain = nearest(side.name, [AUTO, *COSTS])
            raise click.UsageError(f"{side.name}: is neither a file nor a shipped chain; {chain}")
    more = {"survey": saved and saved.survey, "force": options["force"], "limit": options["limit"]}
    more |= {} if options["within"] is None else {"tolerance_ns": options["within"]}
    return match_sides(strip, *sides, **more)


def _check_thresholds(result: Comparison, options: dict) -> list[str]:
    """A line per threshold that is not met; NaN meets none."""
    time = result.differences.get("time")
    figures = {
        "min_completeness": result.completeness,
        "min_correctness": result.correctness,
        "min_exact": result.exact_count,
        "max_median": abs(time.median) if time else math.nan,
        "max_rmse": time.rms if time else math.nan,
        "max_nmad": time.nmad if time else math.nan,
    }
    lines = []
    for name, figure in figures.items():
        limit = options[name]
        if limit is None:
            continue
        fine = figure >= limit if name.startswith("min") else figure <= limit
        if not fine:
            lines.append(f"threshold --{name.replace('_', '-')} {limit:g} is not met: {result.a} has {figure:.6g}")
    return lines
