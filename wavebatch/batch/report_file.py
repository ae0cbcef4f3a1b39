"""The report file next to a cloud: its contents, its remarks, and the check of --resume whether a cloud is up to date.

`strip_task` writes it after the cloud, so its presence means that the cloud is complete. It calls `find_warnings` and
`find_remarks` once all rows of a strip are counted: columns without any value, with cause and remedy, and doubtful
waveforms.
Before you change it: everything but `timing` must be the same for every run of the same input and options.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.batch.counts import AMPLITUDE_BINS, LEFT_OUT, RunReport
from wavebatch.batch.job import StripJob, split_columns
from wavebatch.batch.options import OPTIONS, SAME_CLOUD
from wavebatch.batch.unit import Prepared
from wavebatch.core.echoes import REASONS, EchoFlag, NoData, without_nan
from wavebatch.core.errors import StripWarning
from wavebatch.core.process import Seconds
from wavebatch.files.cloud.column_names import describe_roundings
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.stages.chain import effective
from wavebatch.stages.decompose.fit import loop_model
from wavebatch.surveying.choose_chain import describe_choice, describe_survey
from wavebatch.surveying.flat_ground import AngleOutlook, angle_parameters, predict_angles
from wavebatch.surveying.inspect_strip import LEAST_MATCHED, doubt_files, doubt_packets, name_gains
from wavebatch.surveying.sensor import plain
from wavebatch.surveying.systems.known_systems import doubt_survey
from wavebatch.surveying.systems.survey_result import SavedSurvey, format_survey

STRIP_SCHEMA = "wavebatch.strip-report/1"
MOST_REPORT = 64 << 20
"""Most bytes of a report that are read; 255 digitizers take less than one."""
REQUESTED = (
    "chain", "profile", "tolerance", "system", "force", "survey", "calibration", "trajectory", "lever_arm", "crs",
    "flight_height", "attenuation", "attenuation_error", "visibility", "wavelength", "energy", "where", "drop_flags",
    "classes", "bbox", "polygon", "columns",
)  # fmt: skip
"""Options of a run that `describe_job` describes by what they lead to, for example a file by its contents. All others
that may change a cloud are described by their values."""
BATCH_SCHEMA = "wavebatch.batch-report/1"


def cloud_path(job: StripJob, folder: Path) -> Path:
    """Return the path of a strip's cloud."""
    return folder / f"{job.path.stem}.{job.options.format}"


def report_path(job: StripJob, folder: Path) -> Path:
    """Return the path of a strip's report."""
    return folder / f"{job.path.stem}.report.json"


_hashed: list[tuple[SavedSurvey, str]] = []
"""A survey and its checksum, once for the strips that share it: that of a flight names all of them."""


def describe_job(job: StripJob, fingerprint: Mapping[str, Any]) -> dict[str, Any]:
    """Describe all that decides the output: two runs with equal descriptions write the same cloud.

    Parameters
    ----------
    job : StripJob
    fingerprint : mapping
        Of the strip, from `take_fingerprint`.

    Returns
    -------
    dict
        Plain values: version, input, options, request.
    """
    saved, sensor = job.request.system, job.sensor
    trajectory = None if sensor.trajectory is None else take_fingerprint(sensor.trajectory)
    energy = job.energy if job.energy_file is None else take_fingerprint(job.energy_file)
    if saved is not None and not (_hashed and _hashed[0][0] is saved):
        _hashed[:] = [(saved, hashlib.sha256(format_survey(saved).encode()).hexdigest())]
    # The hash is that of the flight's survey also for a strip that does not belong to it: another survey may take it.
    flight = {"survey": "flight"} if job.request.flight else {}
    return {
        "version": __version__,
        "input": {"file": job.path.name, **fingerprint},
        "options": {name: getattr(job.options, name) for name in OPTIONS if name not in (*SAME_CLOUD, *REQUESTED)}
        | {"columns": list(job.columns)},
        "request": {
            "chain": job.request.describe() or effective(job.chain),
            "system": None if saved is None else _hashed[0][1],
            "sensor": {**asdict(sensor), "trajectory": trajectory},
            "calibration": None if job.calibration is None else job.calibration.describe(),
            "attenuation_db_km": None if job.attenuation is None else list(job.attenuation),
            "pulse_energy": energy,
            **flight,
            **({"selection": job.selection.describe()} if job.selection else {}),
        },
    }


def describe_strip_result(prepared: Prepared, described: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the results of scan and survey as plain values; `described` is from `describe_job`."""
    vectors = prepared.scan.vectors
    ratio = without_nan(vectors.ratio)
    fingerprint = {name: value for name, value in described["input"].items() if name != "file"}
    seen = describe_survey(prepared.choice, prepared.job.request, fingerprint)
    if prepared.job.request.flight:
        seen["survey"]["flight"] = {"fits": not prepared.stranger, "reason": prepared.stranger or None}
    # Attenuation that the columns of light use, its error, and where it comes from.
    air, job = prepared.system.radiometry, prepared.job
    source = "the default, for which there is no source" if job.calibration is None else "the calibration"
    source = source if job.attenuation is None else "--attenuation or --visibility"
    return {
        "direction": {"sign": vectors.direction, "evidence": vectors.evidence, "vector_ratio": ratio},
        "sensor": prepared.sensor.describe(),
        "air": {"attenuation_db_km": air.attenuation, "error_db_km": air.attenuation_error, "from": source},
        "pulse_energy": None if prepared.pulse_energy is None else prepared.pulse_energy.describe(),
        "calibration": None if prepared.job.calibration is None else prepared.job.calibration.describe(),
        **seen,
    }


def describe_chain(prepared: Prepared) -> dict[str, Any]:
    """Describe the chain as it is used, and how it was chosen."""
    chosen = describe_choice(prepared.choice, prepared.job.request)
    return {"chain": effective(prepared.job.chain), "choice": chosen}


def build_document(
    prepared: Prepared,
    described: Mapping[str, Any],
    report: RunReport,
    cloud: Path,
    size: int,
) -> dict[str, Any]:
    """Build the report of a strip whose cloud is complete.

    Parameters
    ----------
    prepared : Prepared
    described : mapping
        From `describe_job`.
    report : RunReport
    cloud : Path
    size : int
        Of the cloud [bytes].

    Returns
    -------
    dict
        Plain values for JSON; all but `timing` is the same for every run.
    """
    facts, layout = prepared.facts, prepared.layout
    job, known = prepared.job, prepared.system.radiometry
    lacks = {NoData.NOT_CALIBRATED: known.constant is None, NoData.NO_DIVERGENCE: known.divergence is None}
    not_computed = {}
    for column, needs in _NEEDS.items():
        if column not in job.chain.makes:
            reason = next((REASONS[need][0] for need in needs if lacks[need]), None)
            not_computed[column] = reason or f"the chain has no stage attribute.{column}"
    packets, file, stored = facts.packets, facts.packets.file, facts.packets.end - facts.packets.start
    found = {
        "schema": STRIP_SCHEMA,
        "status": "incomplete" if report.is_incomplete else "complete",
        **described,
        **describe_chain(prepared),
        "strip": {
            "las_version": facts.version,
            "point_format": facts.header.point_format,
            "points": facts.header.point_count,
            "packets": {"file": file.name if file else None, "internal": packets.internal, "bytes": stored},
            **describe_strip_result(prepared, described),
        },
        "command": job.options.command(job.path.name),
        "output": {
            "file": cloud.name,
            "size": size,
            "las_version": "{}.{}".format(*layout.version),
            "point_format": layout.point_format,
            "kept_extra_bytes": [carried.record.name for carried in layout.carried],
            "copied_to_added_echoes": dict.fromkeys(layout.copied, report.count("added_echoes")),
            "columns": {written.column: written.record.name for written in layout.written},
            "not_computed": not_computed,
        },
        **report.to_json(),
    }
    return {**found, "checksum": _sum_up(found), "timing": build_timing(report)}


def _sum_up(document: Mapping[str, Any]) -> str:
    """The checksum of a report without its timing: --resume believes no figure that was altered."""
    figures = {key: value for key, value in document.items() if key not in ("timing", "checksum")}
    # As it is read again: text keys, lists. Without indents, which take 20 times as long.
    return hashlib.sha256(json.dumps(json.loads(json.dumps(figures)), sort_keys=True).encode()).hexdigest()


def build_timing(report: RunReport) -> dict[str, Any]:
    """Return processor and wall time by task, rounded, their sums, and waveforms per second of a processor."""
    total = sum(report.timing.values(), Seconds())
    by_task = {
        f"{kind}_seconds": {name: round(getattr(seconds, kind), 6) for name, seconds in report.timing.items()}
        for kind in ("processor", "wall")
    }
    rate = round(report.count("waveforms") / total.processor) if total.processor > 0 else None
    sums = {f"total_{kind}_seconds": round(getattr(total, kind), 6) for kind in ("processor", "wall")}
    return {**by_task, **sums, "waveforms_per_processor_second": rate}


def format_report(document: Mapping[str, Any]) -> str:
    """Return the text of a JSON file."""
    text = json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False)
    # Bytes of file names that are not UTF-8 are lone surrogates in Python; JSON can escape them.
    return text.encode(errors="backslashreplace").decode() + "\n"


def read_current(job: StripJob, folder: Path, described: Mapping[str, Any]) -> tuple[RunReport | None, str]:
    """Read the report of a cloud that is complete and equal to what this run would write.

    Parameters
    ----------
    job : StripJob
    folder : Path
        Of the outputs.
    described : mapping
        From `describe_job`.

    Returns
    -------
    report : RunReport or None
        None where the cloud must be made.
    why : str
        Why it must be made though there is a report; else empty.
    """
    why = ""
    # Whatever is wrong with a report, the cloud is made anew.
    wrong = (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError)
    with contextlib.suppress(*wrong):
        with open(report_path(job, folder), "rb") as file:
            why = "its report is damaged"
            document = json.loads(file.read(MOST_REPORT))
        if document["checksum"] != _sum_up(document):
            return None, why
        asked = {"schema": STRIP_SCHEMA, **json.loads(json.dumps(described))}
        changed = list(_list_changes(asked, {key: document.get(key) for key in asked}))
        if changed:
            return None, f"changed since: {', '.join(changed)}"
        why, cloud, output = "its cloud is missing or damaged", cloud_path(job, folder), document["output"]
        if output["file"] == cloud.name and output["size"] == cloud.stat().st_size:
            return RunReport.from_json(document), ""
    return None, why


def _list_changes(new: Mapping[str, Any], old: Mapping[str, Any]) -> Iterator[str]:
    """Names of the values that differ; of the input, whose hash says nothing to a reader, only that it does."""
    for key in {**new, **old}:
        one, other = new.get(key, ...), old.get(key, ...)
        if isinstance(one, dict) and isinstance(other, dict) and key != "input":
            yield from _list_changes(one, other)
        elif one != other:
            yield key


_ANGLE = "incidence_angle"

LEAST_JUDGED = 20
"""Fewer waveforms, or returns in waveforms with echoes, are too few for a remark."""

MOST_FAILED = 0.2
"""Share of echoes whose fit did not converge, or ended at a bound, that is far above usual: of a chain that suits a
strip 6 % at most (17 to 22 % on four of 300 simulated ones); 21 % in fog, 24 % where a receiver recovers slowly from
clipped echoes, 35 % on a RIEGL and 80 % on a Leica strip of Gaussians in place of the learned pulse."""

MOST_CUT = 0.08
"""Share of echoes at the edge of their packet that a user must know of: 6 % in packets that are cut to their signal
(NEON), 0 to 2 % on other real strips; 9 to 14 % where haze begins a fifth of the packets, all of it false."""

MOST_ON_GROUND = 0.01
"""Share of added echoes from which points that are all ground are said to have lost the others: of simulated bare
ground it is .0014."""

INVERTED = 5.0
"""Signals are inverted where counts reach this many times further below the baseline than above it."""

_NEEDS: dict[str, tuple[NoData, ...]] = {
    "range": (),
    "backscatter_coefficient": (NoData.NOT_CALIBRATED,),
    "cross_section": (NoData.NOT_CALIBRATED, NoData.NO_DIVERGENCE),
    "reflectance": (NoData.NOT_CALIBRATED,),
    "level_reflectance": (NoData.NOT_CALIBRATED,),
    _ANGLE: (NoData.NO_DIVERGENCE,),
}
"""Physical columns, and what each needs besides the sensor's position."""

FASTEST = 120.0
"""Speed of a sensor above which its coordinates are doubted [m/s]: survey aircraft fly at 40 to 100, in feet 130 up."""

JETS = 5000.0
"""Height of a sensor above the points from which a speed beyond FASTEST is believed where a CRS says metres [m]."""

MOST_ABOVE_ONE = 0.03
"""Share of the reflectances above 1 from which a warning is printed."""

UNSEEN_TURN = 0.05
"""Angle from which a remark says that vectors which are turned against the points would not show [deg]: the best planes
through points are known to a tenth of a degree."""

MOST_GAPS = 3
"""Most gaps of a trajectory that a remark lists."""


def find_remarks(prepared: Prepared, report: RunReport) -> tuple[tuple[str, ...], list[str]]:
    """Find what a user should know about a strip that is written.

    Parameters
    ----------
    prepared : Prepared
    report : RunReport
        Of the whole strip.

    Returns
    -------
    remarks : tuple of str
        One line each: a column that no echo has, with the commonest reason and its remedy; angles that the beam can
        hardly measure; a trajectory that contradicts the vectors, or
        that does not cover the strip; changes of energy that nothing shows.
    missed : list of str
        The same of columns that --columns names, for `find_warnings`.
    """
    lines = [*prepared.scan.notes, *name_gains(prepared.facts, prepared.scan)]
    lines += filter(None, [prepared.sensor.doubt()])
    lines += prepared.job.calibration.notes if prepared.job.calibration else ()
    lines += _remark_sensor(prepared, report.no_data)
    system = prepared.system
    errors = {"hidden_light": "amplitudes and energies", "hidden_width": "widths"}
    lacks = [name for name in errors if system.hidden and not getattr(system, name)]
    if lacks:
        lines.append(
            f"--system: an earlier version made this file, without {' and '.join(lacks)}: errors of "
            f"{', and of '.join(errors[name] for name in lacks)} may be too small where echoes hide others; "
            "make it again with `wavebatch survey -o`"
        )
    # The pulse that a residual loop takes from the survey where the chain names none.
    step = prepared.job.chain.decomposer
    if step.effective().get("model") == "auto":
        fitted = loop_model(prepared.system, "auto")
        lines.append(f'{step.stage.name} fits the pulse of the survey: model = "{fitted}"')
    # A threshold of the residual loop that lies below the noise, which the stage takes in its place.
    if step.stage.name == "decompose.residual_loop":
        given, survey = step.effective(), prepared.choice.survey
        noise = survey.system.noise.std
        unit = {"count": 1.0, "amplitude": survey.figures.amplitude_50 or 0.0}.get(given["t_unit"], 0.0)
        if 0 < unit * given["t_diff"] < noise:
            lines.append(
                f"decompose.residual_loop: t_diff = {given['t_diff']:g} (unit {given['t_unit']}) lies below the noise "
                f"of {noise:.2f} DN and was raised to it"
            )
    last, lost = report.last_left_out, report.left_out.get("where", 0)
    if last:
        lines.append(f"--where: {last} of the {lost} points that it leaves out are the last echo of their pulse, often "
                     "the ground: return numbers stay those of the whole pulse")  # fmt: skip
    cut, written = report.flags.get("NEAR_EDGE", 0), report.count("points_out") - sum(report.passed_through.values())
    if written >= LEAST_JUDGED and cut > MOST_CUT * written:
        lines.append(
            f"{cut} of {written} echoes ({100 * cut / written:.0f} %) are NEAR_EDGE: packets begin or end on them, so "
            "widths are less sure, and haze at the start of packets looks like such echoes; draw some with "
            "`wavebatch plot waveform --flags`, or leave them out with --drop-flags NEAR_EDGE"
        )
    if report.copied_echoes:
        lines.append(f"packets of a pulse overlap: {report.copied_echoes} echoes that another of them has do not count")
    layout, added = prepared.layout, report.flags.get("ADDED", 0)  # those that are written
    lines += [*layout.notes, *describe_roundings(layout.written)]
    if added and layout.copied:
        lines.append(
            f"{', '.join(layout.copied)}: kept; {added} added echoes have the value of the nearest return of their "
            "packet, because no value is free for no-data"
        )
    marked = []
    for one in layout.carried:
        if not (one.copied or layout.whole or one.record.no_data is None) and math.isfinite(one.record.no_data[0]):
            scale, offset = one.record.scaling or (1.0, 0.0)  # a program that takes it for a value scales it
            marked.append(f"{one.record.name} {one.record.no_data[0] * scale + offset:g}")
    if added and marked:
        lines.append(
            f"{', '.join(marked)}: what {added} added echoes have for no-data; PDAL and QGIS take it for a "
            "value: leave these points out before a mean (flag ADDED)"
        )
    few, missed = _explain_columns(prepared, report)
    return (*lines, *few), missed


def _remark_sensor(prepared: Prepared, no_data: Mapping[str, Mapping[str, int]]) -> Iterator[str]:
    """Say where there is no position of the sensor, and what is odd about it."""
    sensor, facts = prepared.sensor, dict(prepared.sensor.facts)
    # Echoes at times for which there is no position of the sensor, while others have one.
    missing = {column: counts.get(NoData.NO_SENSOR.name, 0) for column, counts in no_data.items()}
    columns = [name for name, number in sorted(missing.items()) if 0 < number < sum(no_data[name].values())]
    if columns:
        worst = max(columns, key=lambda name: missing[name])
        reason, remedy = "rays from which the sensor's position follows are missing there", "give --trajectory"
        if sensor.kind == "trajectory":
            gaps = facts.get("gaps_s", [])
            times = [f"{begin:.2f} to {end:.2f} s" for begin, end in gaps[:MOST_GAPS]]
            times += [f"{len(gaps) - MOST_GAPS} more"] * (len(gaps) > MOST_GAPS)
            reason, remedy = f"{facts['file']} has no position there", "give a trajectory that covers the strip"
            if times:
                reason += f" ({100 * (1 - facts['share_covered']):.2g} % of the strip's time: {', '.join(times)})"
        number, total = missing[worst], sum(no_data[worst].values())
        yield f"{', '.join(columns)}: {number} of {total} echoes have none: {reason}; {remedy}"
    # An aircraft that is too fast: its strip may be in feet without saying so.
    named = any(unit.horizontal is not None for unit in prepared.facts.units)
    fast = sensor.kind != "trajectory" and facts.get("speed_m_s", 0.0) > FASTEST
    if fast and not (named and facts.get("height_m", 0.0) > JETS):
        yield (
            f"range: if coordinates are in metres, the sensor flies at {facts['speed_m_s']:.0f} m/s, "
            f"{facts['height_m']:.0f} m above the points, whatever a CRS says: are they in feet? Then ranges are "
            "3.28 times too long: project the strip to metres"
        )
    height = prepared.job.sensor.height
    if height is not None and sensor.height is None:
        seen = facts.get("height_m")
        where = f": {seen:.0f} m above the points" if seen else ""
        yield f"--flight-height {height:g} m is not used: positions are from the strip's {sensor.kind}{where}"
    unseen = 0.0 if sensor.kind == "trajectory" else facts.get("turned_error_deg", 0.0)
    second = prepared.second_step
    if second is not None and "incidence_angle_normals" in second.stage.makes and unseen > UNSEEN_TURN:
        yield (
            "incidence_angle_normals: this strip does not show well whether its packet vectors are turned against the "
            f"points: the errors hold {plain(sensor.turned, 1)} degrees of it; --trajectory would show it"
        )


def _explain_columns(prepared: Prepared, report: RunReport) -> tuple[list[str], list[str]]:
    """Why columns have no value, or few: lines for remarks, and those for warnings: --columns names their column."""
    lines: list[str] = []
    missed: list[str] = []
    # Who asks for the error of a column alone misses the column too.
    asked = {entry.removeprefix("+").removesuffix("_err") for entry in split_columns(prepared.job.options.columns)}
    wanted = {name.removesuffix("_err") for name in (*prepared.job.columns, *prepared.needed)}
    for column, counts in sorted(report.no_data.items()):
        if column not in wanted:
            continue
        known, total = counts.get(NoData.KNOWN.name, 0), sum(counts.values())
        outlook = _look_out(prepared, report) if column == _ANGLE else None
        if total and not known:
            first = max(NoData, key=lambda reason: (counts.get(reason.name, 0), -reason))
            meaning, remedy = REASONS[first]
            share = f"{counts[first.name]} of them: " if counts[first.name] < total else ""
            if outlook is not None and first in (NoData.UNCERTAIN, NoData.SHORT_PULSE, NoData.TOO_STEEP):
                meaning = f"{meaning}: {outlook.reason}"
            (missed if column in asked else lines).append(
                f"{column}: none of {total} echoes has one; {share}{meaning}; {remedy}"
            )
        elif total and outlook is not None and not outlook.possible:
            remedy = REASONS[NoData.UNCERTAIN][1]
            lines.append(f"{column}: {known} of {total} echoes have one, the widest: {outlook.reason}; {remedy}")
    return lines, missed


def find_warnings(
    prepared: Prepared, report: RunReport, missed: Sequence[str], dropped: Mapping[str, str]
) -> tuple[StripWarning, ...]:
    """Find what makes results of a strip doubtful.

    Parameters
    ----------
    prepared : Prepared
    report : RunReport
        Of the whole strip.
    missed : sequence of str
        From `find_remarks`.
    dropped : mapping of str to str
        Records of the input that the cloud does not have, and why.

    Returns
    -------
    tuple of StripWarning
        What makes results wrong comes first: a forced survey of another sensor, a selection that leaves nothing, a
        strip without any waveform or echo, packets that do not fit the returns, a pulse that is a guess, a chain that
        does not fit the strip's pulse. Then what the files, the calibration and the records of the input have.
    """
    choice, echoes, warn = prepared.choice, report.count("echoes"), StripWarning.of
    found: list[StripWarning] = []
    if prepared.forced:
        line = f"the survey given by --system is of another sensor, or this is a hillside: {prepared.forced}"
        if prepared.job.request.force:
            line = f"--force: the survey given by --system is not of this sensor: {prepared.forced}"
        found += warn("forced-system", [line])
    left_out = sum(report.left_out.values())
    if left_out and not report.count("points_out"):
        reasons = ", ".join(f"{n} {LEFT_OUT[name]}" for name, n in report.left_out.items() if n)
        place = prepared.selection.filter.describe_extent(prepared.facts.header)
        line = f"no point is written: of {left_out}, {reasons}{place and '; ' + place}"
        found += warn("nothing-selected", [line])
    points, waveforms, nothing = report.count("points_in"), report.count("waveforms"), ""
    if not points:
        nothing = "the strip has no points, so its cloud has none; if it should have some, get the file again"
    elif not waveforms:
        nothing = f"none of {points} points has a waveform: all are written unchanged, without attributes"
    elif waveforms >= LEAST_JUDGED and not echoes:
        figures, noise = choice.survey.figures, prepared.system.noise
        down = 0.0 if figures.least_count is None else noise.baseline - figures.least_count
        up = 0.0 if figures.largest_count is None else figures.largest_count - noise.baseline
        reason = "nothing rises far enough above the noise"
        if down > INVERTED * max(up, noise.std):
            reason = f"the signal falls from {noise.baseline:.0f} to {noise.baseline - down:.0f} DN: it is inverted"
        nothing = f"none of {waveforms} waveforms holds an echo: {reason}"
        nothing += "; `wavebatch survey` shows what the strip records"
    found += warn("empty", filter(None, [nothing]))
    # Packets of another strip, by --force, and return locations that fit no echo.
    if prepared.scan.stranger:
        found += warn("foreign-packets", [f"--force: {prepared.scan.stranger}"])
    else:
        matched = report.count("matched_returns")
        lines = [*doubt_packets(prepared.facts, matched, matched + report.count("unmatched_returns"))]
        if not lines and report.strayed_returns and "foreign-packets" not in prepared.scan.doubts.values():
            lines = [
                f"about {report.strayed_returns} returns, in stretches of the strip, lie where their packets have no "
                "echo, the others do: their return locations or packets are wrong, or they are means of two surfaces, "
                "or stand in the file twice; echoes there may be off by more than range_err"
            ]
        found += warn("foreign-packets", lines)
    # A vendor gives no intensity to a pulse without an echo.
    unseen = report.unseen_returns
    seen = unseen + report.count("matched_returns") + report.count("unmatched_returns")
    if echoes and seen >= LEAST_JUDGED and unseen > (1.0 - LEAST_MATCHED) * seen:
        line = (
            f"{unseen} of {seen} returns with an intensity have packets without an echo: they are too weak, or those "
            f"of another channel, or the noise of {prepared.system.noise.std:.3g} DN is too high, as where packets are "
            "too short to show it beside their echoes, or the threshold of the chain is; draw some with `wavebatch "
            "plot waveform`, or give --system, a survey of a longer strip of this sensor"
        )
        found += warn("noise-guess", [line])
    found += doubt_survey(choice.survey.system, choice.survey.figures, choice.survey.waveforms) if echoes else ()
    # Flags of failed fits that far more echoes have than usual.
    written = report.count("points_out") - sum(report.passed_through.values())
    for flag in (EchoFlag.NOT_CONVERGED, EchoFlag.AT_BOUND):
        number = report.flags.get(str(flag.name), 0)
        if not choice.doubted and written >= LEAST_JUDGED and number > MOST_FAILED * written:
            auto = prepared.job.request.describe() is not None
            remedy = "draw some with `wavebatch plot waveform --flags`" if auto else "use --profile auto"
            line = (
                f"{number} of {written} echoes ({100 * number / written:.0f} %) are {flag.name}, far more than usual: "
                f"their errors cannot be trusted; {remedy}, or leave them out with --drop-flags {flag.name}"
            )
            found += warn("failed-fits", [line])
    # More reflectances above 1 than metal, signs and wet roofs explain.
    known = max(report.no_data.get(name, {}).get(NoData.KNOWN.name, 0) for name in ("level_reflectance", "reflectance"))
    if report.above_one > MOST_ABOVE_ONE * known > 0:
        line = (
            f"{min(100 * report.above_one / known, 100):.0f} % of the reflectances exceed 1, that of a white matt "
            "surface: the calibration is of another sensor or setting, a target's reflectance is wrong, or coordinates "
            "are not in metres"
        )
        found += warn("reflectance", [line])
    if choice.doubted and echoes:
        share, (_, best) = choice.false_share, choice.predictions
        line = (
            f"{choice.chain.name or 'this chain'}: does not fit this strip's pulse, which is no plain Gaussian: about "
            f"{round(share * echoes)} of its {echoes} echoes are false ({100 * share:.0f} % in a trial with the "
            f"survey's pulse, {100 * best.false_share:.1f} % for profile {best.name}); use --profile auto"
        )
        found += warn("false-echoes", [line])
    # Points of one class may be those that a filter kept; their packets have all echoes of the pulse.
    added = report.flags.get("ADDED", 0)
    if report.ground_points == points and added >= LEAST_JUDGED and added > MOST_ON_GROUND * written:
        line = (
            f"all {points} points are ground (class 2), and so {added} added echoes have this class, though they may "
            "be plants or buildings that were taken out: classify the cloud anew, or leave them out with --drop-flags "
            "ADDED"
        )
        found += warn("ground", [line])
    found += warn("no-value", missed)
    found += [*doubt_files(prepared.facts, prepared.scan), *prepared.doubts]
    return (*found, *warn("dropped-records", map(": ".join, dropped.items())))


def _look_out(prepared: Prepared, report: RunReport) -> AngleOutlook | None:
    """How good angles from widths are on the strip; None where distance or divergence is unknown."""
    parameters = angle_parameters(prepared.job.chain) or {}
    divergence = parameters.get("divergence") or prepared.system.radiometry.divergence
    distance = prepared.sensor.distance
    amplitude = AMPLITUDE_BINS.quantile(report.amplitude, 0.5)
    spacing = prepared.choice.survey.figures.spacing_ns
    if not (divergence and distance and amplitude and spacing):
        return None
    return predict_angles(prepared.system, spacing, distance, divergence, amplitude, parameters["max_error"])
