"""`wavebatch info` shows what strips hold, `check` what is wrong with them and with chains, `stages` the algorithms.

Only prints; the facts come from `tools.file_facts` and `surveying.inspect_strip`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete, complete_files
from wavebatch.cli.messages import answer, print_sheet, print_text, printable, talk
from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.units import count
from wavebatch.tools.file_facts import describe_file
from wavebatch.tools.sheets.sheet import Fact, Note, Sheet, SheetPart

if TYPE_CHECKING:
    from wavebatch.stages.chain import Parameter, Stage


_SHOWN = 20
"""Classes or sources of points that are printed; --json has more."""

_LONG = 100
"""Characters of a CRS that are printed."""

EXIT_PROBLEMS, EXIT_UNREADABLE = 1, 1
"""`check` found problems; `info` could not read a file."""


@click.command()
@shared.strips_argument
@shared.strip_options
@click.option("-v", "--verbose", is_flag=True,
              help="Also survey the strip: its pulse, and the known sensor that it looks like.")
@shared.common_options("json")
def info(strips: tuple[str, ...], direction: str, headerless: bool, **options: Any) -> None:
    """Show header, points, wave packets, descriptors and sample values of strips, and how clouds were made.

    STRIP is a LAS or LAZ file of any version, with or without waveforms, a glob, a folder, or @list.txt with one of
    these per line. Reads all points and a few thousand waveforms. Of a cloud that wavebatch wrote it shows command,
    chain, version and counts. --json prints one object for one file, else a list of them.

    Exit code: 0 done, 1 a file or its packets cannot be read (the others, and its points, are shown), 2 wrong usage.

    Examples:
      # points, packets, descriptors and samples
      wavebatch info strip.las
    """
    paths, lost = shared.find_inputs(strips, options), 0

    def show(path: Path) -> dict[str, Any]:
        facts = describe_file(path, direction=direction, headerless=headerless)
        if options["verbose"] and facts.get("packets", {}).get("count") and not facts["problems"]:
            from wavebatch.core.units import FWHM_PER_SIGMA
            from wavebatch.surveying.inspect_strip import open_strip, survey
            from wavebatch.surveying.systems.known_systems import find_likeness

            with open_strip(path, direction=direction, headerless=headerless) as strip:
                found = survey(strip)
            like = find_likeness(found.system, found.figures.spacing_ns)
            facts["pulse"] = {
                "full_width_ns": FWHM_PER_SIGMA * found.system.sigma_ref,
                "noise_dn": found.system.noise.std,
                "sensor": like and like.known.sensor,
                "difference": like and like.difference,
                "sentence": like.describe() if like else "this strip's pulse looks like that of no known sensor",
            }
        if not options["as_json"]:
            sheet = Sheet(facts["file"], list(_list_parts(facts)))
            print_sheet(sheet if path == paths[0] else Sheet("info", [sheet]))  # an empty line between two
        if facts["problems"] and not facts.get("points_with_waveform"):  # points are shown, packets cannot be
            nonlocal lost
            lost += 1
            talk(f"error: {path}: {facts['problems'][0]}")
        return facts

    results, failed = shared.for_each(paths, show, debug=options["debug"])
    answer(results[0] if len(paths) == 1 else results)
    sys.exit(EXIT_UNREADABLE if failed or lost else 0)


@click.command()
@click.argument("files", nargs=-1, required=True, type=shared.INPUT, metavar="STRIP_OR_CHAIN...",
                shell_complete=complete_files)
@shared.declared("recursive")
@shared.strip_options
@click.option("--strict", is_flag=True, help="Count notes as problems.")
@shared.common_options("json")
def check(files: tuple[Path, ...], direction: str, headerless: bool, **options: Any) -> None:
    """Check strips and chain files (.toml); print one line per problem, with its place and what to do.

    STRIP is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. Notes are oddities that
    wavebatch can read.

    Exit code: 0 no problems, 1 problems found, 2 wrong usage.

    Examples:
      # one line per problem; exit code 1 if there is any
      wavebatch check strip.las mychain.toml
    """
    from wavebatch.surveying.inspect_strip import check_file  # imports all stages

    clean, results = True, []
    for path in shared.find_inputs(files, options):
        found = check_file(path, direction=direction, headerless=headerless)
        clean &= found.is_clean and not (options["strict"] and found.notes)
        results.append(found.to_json())
        if options["as_json"]:
            continue
        for line in found.problems:
            print_text(printable(f"{found.file}: {line}"))
        for line in found.notes:
            print_text(printable(f"{found.file}: note: {line}"))
        if found.is_clean:
            print_text(printable(f"{found.file}: ok ({found.summary})"))
    answer(results)
    sys.exit(0 if clean else EXIT_PROBLEMS)


def _list_parts(facts: dict[str, Any]) -> Iterator[SheetPart]:
    """Header, points, packets and records of a file."""
    kind = "LAZ" if facts["compressed"] else "LAS"
    yield Fact("file", f"{facts['file']} ({facts['bytes']} bytes)")
    yield Fact("format", f"{kind} {facts['las_version']}, point format {facts['point_format']}")
    made = [facts["system_identifier"], facts["generating_software"], facts["created"]]
    yield Fact("made by", ", ".join(part for part in made if part) or "not said")
    for run in facts["provenance"]:
        yield Fact("command", f"{run['command']}  (wavebatch {run['version']})")
        stages = [line.split('"')[1] for line in str(run["chain"] or "").splitlines() if line.startswith("stage =")]
        if stages:
            yield Fact("chain", f"{', '.join(stages)}; chosen by {run['chosen_by']}")
        columns = [name if name == stored else f"{name} as {stored}" for name, stored in run["columns"].items()]
        if columns:
            yield Fact("columns", ", ".join(columns))
    crs = " ".join((facts["crs"] or "none").split())
    yield Fact("CRS", crs if len(crs) <= _LONG else crs[: _LONG - 3] + "...")
    yield Fact("coordinates", facts["coordinates"])
    # Number, flags, extent, times, returns and classes of the points
    yield Fact("points", facts["points"])
    if "counts" in facts:
        counts = facts["counts"]
        words = f"{counts['echoes']}, added {counts['added']}, passed through {counts['passed_through']}"
        yield Fact("echoes", words)
        yield Fact("flags", ", ".join(f"{name} {number}" for name, number in counts["flags"].items()) or "none")
    bounds, time = facts.get("bounds"), facts.get("gps_time")
    for axis, name in enumerate("xyz") if bounds else ():
        step, given = facts["scales"][axis], facts["header_bounds"]
        low, high = bounds["least"][axis], bounds["largest"][axis]
        ends = [math.nan if end is None else end for end in (given["least"][axis], given["largest"][axis])]
        right = max(abs(ends[0] - low), abs(ends[1] - high)) <= 1.5 * abs(step)  # False for NaN
        said = "" if right else f"; the header says {ends[0]:.12g} to {ends[1]:.12g}"
        yield Fact(name, f"{low:.12g} to {high:.12g}, steps of {step:g}{said}")
    if time:
        dates = f", {' to '.join(time['dates_gps'])} GPS" if "dates_gps" in time else ""
        yield Fact("GPS time", f"{time['least']:.16g} to {time['largest']:.16g} s, {time['kind']}{dates}")
    for key, name in (("returns", "return number"), ("numbers_of_returns", "of returns"), ("classes", "classes"),
                      ("point_sources", "sources")):  # fmt: skip
        if facts.get(key):
            pairs = [f"{k}: {n}" for k, n in facts[key].items()]
            more = f" and {len(pairs) - _SHOWN} more" if len(pairs) > _SHOWN else ""
            yield Fact(name, f"{', '.join(pairs[:_SHOWN])}{more}")
    if facts.get("scan_angle_deg"):
        yield Fact("scan angle", "{:g} to {:g} degrees".format(*facts["scan_angle_deg"]))
        yield Fact("intensity", "{:g} to {:g}".format(*facts["intensity"]))
    if "packets" in facts:
        packets, samples, vectors = facts["packets"], facts["samples"], facts["vectors"]
        share, ratio = facts["share_with_waveform"], vectors["length_over_half_c"]
        yield Fact("with waveform", f"{facts['points_with_waveform']}" + ("" if share is None else f" ({share:.1%})"))
        yield Fact("without", f"{facts['points_without_waveform']}, broken {facts['points_broken']}")
        yield Fact("packets", f"{packets['count']} in {packets['file'] or 'no file'} ({packets['bytes']} bytes)")
        for one in packets["descriptors"]:
            words = f"{one['samples']} samples of {one['bits']} bits, {one['spacing_ns']:g} ns apart"
            yield Fact(f"descriptor {one['index']}", f"{words}; {count(one['points'], 'point')}")
        if packets["descriptors_unused"]:
            yield Fact("descriptors", f"{packets['descriptors_unused']} more, which no point uses")
        if samples["waveforms_read"]:
            lengths = ", ".join(map(str, samples["lengths"][:8])) + (" ..." if len(samples["lengths"]) > 8 else "")
            read, limited = (count(samples[name], "waveform") for name in ("waveforms_read", "waveforms_at_limit"))
            values = f"{samples['least']} to {samples['largest']}"
            yield Fact("samples", f"{values} in {read} of {lengths} samples; {limited} at the limit")
            if samples["waveforms_with_gaps"]:
                gaps = count(samples["waveforms_with_gaps"], "waveform")
                yield Fact("gaps", f"{gaps} with fill between recordings, which is no sample")
        yield Fact("vectors", f"{vectors['direction']} the sensor: {vectors['evidence']}")
        if ratio is not None:
            divided = " (once divided)" if vectors["form"] == "range" else ""
            yield Fact("vector length", f"{ratio:.4f} of c/2{divided}")
        if "pulse" in facts:
            pulse = facts["pulse"]
            width = f"{pulse['full_width_ns']:.3g} ns at half maximum, noise {pulse['noise_dn']:.3g} DN"
            yield Fact("pulse", f"{width}; {pulse['sentence']}")
    # Extra bytes and records; descriptors of packets have a line already
    for one in facts["extra_bytes"]:
        scale = "" if one["scale"] is None else f", scale {one['scale']:g}"
        empty = "" if one["no_data"] is None else f", no-data {' '.join(one['no_data'])}"
        yield Fact("extra bytes", f"{one['name']} ({one['type']}{scale}{empty}) {one['description']}".rstrip())
    for one in facts["records"]:
        if not (one["user"].startswith("LAS") and 100 <= one["id"] < 356):
            words = f"{one['user']} {one['id']}: {one['bytes']} bytes {one['description']}"
            yield Fact("EVLR" if one["extended"] else "VLR", words.rstrip())
    for kind in ("note", "warning", "problem"):
        yield from (Note(words, kind) for words in facts[f"{kind}s"])


@click.command()
@click.argument("name", required=False, shell_complete=complete("stages"))
@shared.common_options("json")
def stages(name: str | None, **options: Any) -> None:
    """List the algorithms that a chain can use, those of one kind, or explain the one called NAME.

    Kinds are noise, detect, decompose and attribute.

    The explanation has its parameters with units and ranges, its source, and an example for a chain file.

    Exit code: 0 done, 2 no stage has this name.

    Examples:
      # list all algorithms
      wavebatch stages
      # one with parameters, units, source and a TOML example
      wavebatch stages decompose.adaptive
    """
    from wavebatch.core.echoes import COLUMNS
    from wavebatch.stages.chain import KINDS, STAGES, load_plugins

    talk(*(f"warning: {line}" for line in (load_plugins() if name not in STAGES else ())))
    kind = name if name in KINDS else None
    if name is not None and name not in STAGES and kind is None:
        hint = nearest(name, STAGES)
        raise ConfigError(f"no stage {name!r}; {hint if '?' in hint else '`wavebatch stages` lists them'}")
    order = list(KINDS)
    chosen = sorted(STAGES.values(), key=lambda s: (order.index(s.kind), s.name))
    chosen = [stage for stage in chosen if name in (None, stage.name, stage.kind)]
    width = max(len(stage.name) for stage in chosen)
    if name is not None and kind is None:
        only = STAGES[name]
        described = _describe(only)
        parts = [f"{only.name}\n\n{described['text']}"]
        if only.makes:
            known = [COLUMNS[made] for made in only.makes if made in COLUMNS]
            parts.append("Makes:\n" + "\n".join(f"  {c.name} [{c.unit}]: {c.meaning}" for c in known))
        if described["needs"]:
            parts.append(f"Needs: {', '.join(described['needs'])}")
        lines = []
        for key, p in described["parameters"].items():
            limits = f", {p['range'][0]:g} to {p['range'][1]:g}" if p["range"] else ""
            lines.append(f"  {key} ({p['type']}{limits}, default {p['default']}): {p['meaning']}")
        if lines:
            parts.append("Parameters:\n" + "\n".join(lines))
        parts.append("In a chain file:\n\n" + described["example"].rstrip())
        lines = ["\n\n".join(parts)]
    else:
        lines = [f"{stage.name:<{width}}  {stage.summary}" for stage in chosen]
    answer([_describe(stage) for stage in chosen], Sheet("stages", list(map(Note, lines))))


def _types(parameter: Parameter) -> str:
    words = {int: "integer", float: "number", bool: "true or false", str: "string", type(None): "nothing"}
    if parameter.choices:
        number = ["number"] if float in parameter.types else []
        return " or ".join([*map(repr, parameter.choices), *number])
    return " or ".join(words.get(kind, kind.__name__) for kind in parameter.types)


def _describe(stage: Stage) -> dict[str, Any]:
    """The document of a stage for --json."""
    from wavebatch.stages.chain import Step, format_step

    parameters = {
        name: {"type": _types(one), "default": one.default, "range": one.range, "meaning": one.meaning}
        for name, one in stage.parameters.items()
    }
    return {
        "name": stage.name,
        "kind": stage.kind,
        "text": stage.text,
        "makes": list(stage.makes),
        "needs": list(Step(stage).needs),
        "parameters": parameters,
        "example": format_step(stage.name, {name: one["default"] for name, one in parameters.items()}),
    }
