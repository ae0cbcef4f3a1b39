"""`wavebatch compare`: two clouds, two chains, or one of them with the vendor's returns or the truth.

Reads options and checks thresholds; figures come from `wavebatch.tools.pairing` and `compare_chains`. The result is a
sheet, which is printed and written as a page, and a CSV with one row per figure.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch import __version__
from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, talk
from wavebatch.core.units import count
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.text_file import write_text
from wavebatch.tools.cells import doubt_clouds
from wavebatch.tools.pairing import Comparison, compare_clouds, compare_truth
from wavebatch.tools.sheets.sheet import Fact, Later, Note, Picture, Sheet, SheetPart, Table, format_csv, sum_table

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
def compare(a: Path, b: Path | None, strip: Path | None, output: Path | None, **options: Any) -> None:
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
    shared.check_html(options["html_file"])
    result: Matchup | Comparison
    if strip:
        from wavebatch.core.errors import nearest
        from wavebatch.surveying.choose_chain import COSTS
        from wavebatch.surveying.systems.survey_result import load_survey
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
        matchup = match_sides(strip, *sides, **more)
        result, between, chains = matchup, matchup.between, _list_match(matchup)
    else:
        result = between = _compare(a, b, options)
        chains = iter(())
    if output is not None:
        write_text(output, format_csv(HEAD, list_rows(result.to_json())), overwrite=options["overwrite"])
    parts = [*_list_parts(between), *chains]
    answer(result.to_json(), Sheet("compare", parts), "chains" if strip else "")
    talk(*(f"warning: {line}" for line in doubt_clouds([Path(side) for side in (a, b, strip) if side])))
    fewer = min(between.echoes_a, between.echoes_b)
    if fewer and between.matched <= fewer * (FEW_COMMON if options["within"] is None else 0.0):
        common = f"{between.matched} of {fewer} echoes" if between.matched else "no echo"
        talk(
            f"warning: A and B have {common} in common; are they results of one strip, in one CRS? "
            "Positions of two formats may differ: try a larger --within"
        )
    time = between.differences.get("time")
    figures = {
        "min_completeness": between.completeness,
        "min_correctness": between.correctness,
        "min_exact": between.exact_count,
        "max_median": abs(time.median) if time else math.nan,
        "max_rmse": time.rms if time else math.nan,
        "max_nmad": time.nmad if time else math.nan,
    }
    broken = []  # a line per threshold that is not met; NaN meets none
    for name, figure in figures.items():
        limit = options[name]
        if limit is None:
            continue
        fine = figure >= limit if name.startswith("min") else figure <= limit
        if not fine:
            broken.append(f"threshold --{name.replace('_', '-')} {limit:g} is not met: {between.a} has {figure:.6g}")
    names = " with ".join(Path(side).name for side in (between.a, between.b) if side)
    warnings = (Note(words, "warning") for words in broken)
    shared.write_html(options["html_file"], names, [*warnings, *parts, Fact("wavebatch", __version__)])
    for line in broken:
        talk(line)
    if broken:
        sys.exit(EXIT_VIOLATED)


def _compare(a: Path, b: Path | None, options: dict) -> Comparison:
    truth = options["truth"]
    if (b is None) == (truth is None):
        raise click.UsageError("give either B or --truth FILE.npz")
    from wavebatch.tools.compare_chains import find_contender

    for side in filter(None, (a, b)):
        if side.suffix.lower() == ".toml" or (not side.is_file() and not find_contender(str(side)).is_cloud):
            raise click.UsageError(f"{side} is a chain; give the strip to run it on with --strip STRIP")
    if b is not None and b.suffix.lower() == ".npz":
        raise click.UsageError(f"{b} looks like a truth file; give it with --truth")
    how = {} if options["within"] is None else {"tolerance_ns": options["within"]}
    how["selection"] = PointFilter(where=options["where"])
    return compare_truth(a, truth, **how) if truth else compare_clouds(a, b, **how)


_UNITS = {"time": "time ns", "echo_time": "echo_time ns", "amplitude": "amplitude DN", "echo_width": "width ns"}
_SPREAD = ("number", "median", "mean", "rms", "nmad")
"""What the tables show of a difference."""


def _list_parts(one: Comparison) -> Iterator[SheetPart]:
    """How many echoes both sides have, their differences, and the classes of echoes without a partner."""
    yield Later(partial(_draw, one))
    yield from (Fact("A", one.a), Fact("B", one.b))
    yield Fact("matched by", f"{one.matched_by}, within {one.tolerance_ns:g} ns")
    if one.left_out_a or one.left_out_b:
        yield Fact("left out", f"A {one.left_out_a}   B {one.left_out_b}   by --where")
    yield from (Fact("echoes of A", one.echoes_a), Fact("echoes of B", one.echoes_b), Fact("identical", one.matched))
    yield from (Fact("missed", one.missed), Fact("extra", one.extra))
    yield from (Fact("completeness", one.completeness, ".4f"), Fact("correctness", one.correctness, ".4f"))
    yield Fact("identical, of all", one.identical, ".2%")
    yield Fact("more points in A", one.gain, "+.2%")
    if one.pulses:
        yield Fact("exact count", one.exact_count, ".4f")
        yield Fact("pulses", one.pulses)
    numbers = sorted({*one.counts_a, *one.counts_b}) if one.pulses else ()
    rows = [(str(n), one.counts_a.get(n, 0), one.counts_b.get(n, 0)) for n in numbers]
    sides = (("echoes of A", one.echoes_a, one.extra, "extra"), ("echoes of B", one.echoes_b, one.missed, "missed"))
    sums = sum_table((title, whole, f"{one.matched:,} identical + {rest:,} {name}", one.matched + rest == whole)
                     for title, whole, rest, name in sides)  # fmt: skip
    yield Sheet("Echoes per pulse", [Table(("echoes per pulse", "A", "B"), rows), Later(lambda: [sums])])
    # Differences of the echoes of both sides, also by class and by number of echoes where there are several.
    spread = lambda of: tuple(getattr(of, name) for name in _SPREAD)  # noqa: E731
    rows = [(_UNITS[name], *spread(of)) for name, of in one.differences.items()]
    tables = [Table(("A - B", *_SPREAD), rows, ".4f")]
    for kind, groups in one.differences_by.items():
        rows = [(group if kind == "class" else f"{group} of the pulse", _UNITS[name], *spread(of))
                for group, quantities in groups.items() for name, of in quantities.items()]  # fmt: skip
        if len(groups) > 1:
            tables.append(Table((f"A - B by {kind}", "", *_SPREAD), rows, ".4f", sortable=True))
    yield Sheet("Differences", tables)
    if one.errors:
        head = ("against truth", "", "number", "bias", "rmse", "rms/bound", "nmad/bound", "rms/_err", "nmad/_err")
        rows = [(kind, name, of.number, of.bias, of.rmse, of.rms_per_bound, of.nmad_per_bound, of.calibration,
                 of.calibration_nmad)
                for kind, each in one.errors.items() for name, of in each.items() if of.number]  # fmt: skip
        words = "time: of positions, which the strip's returns anchor; `run --columns +echo_time` adds that of the fits"
        notes = [] if "echo_time" in one.differences else [Note(words)]
        yield Sheet("Errors against the truth", [Table(head, rows, ".4f", sortable=True), *notes])
    for title, classes_by in (("missed, of B's", one.missed_by), ("extra, of A's", one.extra_by)):
        rows = [(kind, str(name), alone, of, alone / of)
                for kind, classes in classes_by.items() for name, (alone, of) in classes.items() if alone]  # fmt: skip
        if rows and one.matched:  # else all lines would say 100 %
            head = (title, "", "number", "of", "share")
            yield Sheet(f"Echoes {title}", [Table(head, rows, ".2%", sortable=True)])


def _draw(one: Comparison) -> Iterator[Picture]:
    from wavebatch.tools.plots.charts import draw_counts

    found = {"in both": one.matched, "only in A": one.extra, "only in B": one.missed}
    yield from draw_counts(found, title="Echoes", label="")
    for side, counts in (("A", one.counts_a), ("B", one.counts_b)) if one.pulses else ():
        shown = {str(number): counts.get(number, 0) for number in range(min(max(counts, default=0), 16) + 1)}
        yield from draw_counts(shown, title=f"Echoes per pulse, {side}", label="echoes")


def _list_match(result: Matchup) -> Iterator[Sheet]:
    """The tables that only chains have: points per waveform and per return, and the goodness of fit."""
    found = f"{count(result.waveforms, 'waveform')}, {count(result.returns, 'return')} of the vendor"
    sizes = (result.waveforms, result.returns)
    rows = [(side.upper(), one.echoes_a, *(one.echoes_a / of if of else math.nan for of in sizes), one.matched,
             one.missed, one.extra) for side, one in result.vendor.items()]  # fmt: skip
    head = ("with the returns", "echoes", "/waveform", "/return", "identical", "missed", "extra")
    yield Sheet("With the vendor's returns", [Fact("strip", f"{result.strip}: {found}"), Table(head, rows, ".4f")])
    rows = [(f"{side.upper()} {name}", fit.waveforms, fit.mean, fit.median, fit.floor_mean, fit.floor_median)
            for side, classes in result.fit.items() for name, fit in classes.items() if fit.waveforms]  # fmt: skip
    head = ("goodness of fit", "waveforms", "mean E", "median E", "mean E0", "median E0")
    clouds = [side.upper() for side, classes in result.fit.items() if not classes]
    notes = [Note(f"{side} no-data: a cloud does not hold the fitted model") for side in clouds]
    words = "E = |f - y|^2 / |f|^2 of model f and waveform y; E0 is the E that noise alone gives"
    yield Sheet("Goodness of fit", [Table(head, rows, ".6f"), *notes, Note(words)])


HEAD = ("table", "side", "class", "name", "figure", "value")
"""Columns: e.g. `missed`, `B`, `return`, `1 of 2`, `share`, `0.012`."""

_TABLES = {"missed_by": ("missed", "B"), "extra_by": ("extra", "A")}

Row = tuple[str, str, str, str, str, Any]


def list_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    """The figures of a comparison; document: of `Comparison.to_json`, or of `Matchup.to_json`."""
    for name, value in document.items():
        if name in _TABLES:
            # Echoes without a partner: by return number, amplitude, flags, and other echoes of their pulse.
            title, side = _TABLES[name]
            for kind, classes in value.items():
                for each, (alone, of) in classes.items():
                    for figure, number in (("echoes", alone), ("of", of), ("share", alone / of if of else math.nan)):
                        yield title, side, kind, str(each), figure, number
        elif name in ("counts_a", "counts_b"):
            for number, pulses in value.items():
                yield "echoes per pulse", name[-1].upper(), "", str(number), "pulses", pulses
        elif name == "differences_by":
            for kind, groups in value.items():
                yield from _list_nested(f"differences by {kind}", groups)
        elif name == "vendor":
            for side, one in value.items():
                # Each side is compared with the vendor's returns: the tables are those of a comparison again.
                for table, part, *rest in list_rows(one):
                    yield f"{table}, {side.upper()} and the vendor's returns", {"B": "vendor"}.get(part, part), *rest
        elif isinstance(value, Mapping):
            yield from _list_nested(name, value)
        elif not isinstance(value, list | tuple):
            yield "all", "", "", "", name, value


def _list_nested(table: str, values: Mapping[str, Any], *path: str) -> Iterator[Row]:
    """Tables of any depth: differences, errors against the truth, goodness of fit."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _list_nested(table, value, *path, str(name))
        elif not isinstance(value, list | tuple):
            # The first part is the side where there are sides, the last one the name.
            side = path[0].upper() if path and path[0] in ("a", "b") else ""
            rest = path[1:] if side else path
            yield table, side, " ".join(rest[:-1]), rest[-1] if rest else "", str(name), value
