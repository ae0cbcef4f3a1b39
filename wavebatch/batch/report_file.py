"""The report file next to a cloud: its contents, and the check of --resume whether a cloud is up to date.

`strip_task` writes it after the cloud, so its presence means that the cloud is complete.
Before you change it: everything but `timing` must be the same for every run of the same input and options.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.batch.counts import RunReport
from wavebatch.batch.explain import explain_absence
from wavebatch.batch.job import StripJob
from wavebatch.batch.unit import Prepared
from wavebatch.core.no_data import without_nan
from wavebatch.core.process import Seconds
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.text_file import write_text
from wavebatch.stages.chain_file import effective
from wavebatch.surveying.choose_chain import describe_choice, describe_survey
from wavebatch.surveying.system_file import format_survey

STRIP_SCHEMA = "wavebatch.strip-report/1"
MOST_REPORT = 64 << 20
"""Most bytes of a report that are read; 255 digitizers take less than one."""
WRITING = (
    "direction", "headerless", "points", "format", "point_format", "las_version", "names", "no_data", "strict",
    "keep_packets",
)  # fmt: skip
"""Options of a run that decide the output by their values; those that name files are in a report's `request`."""
BATCH_SCHEMA = "wavebatch.batch-report/1"


def cloud_path(job: StripJob, folder: Path) -> Path:
    """Return the path of a strip's cloud."""
    return folder / f"{job.path.stem}.{job.options.format}"


def report_path(job: StripJob, folder: Path) -> Path:
    """Return the path of a strip's report."""
    return folder / f"{job.path.stem}.report.json"


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
    # The hash is that of the flight's survey also for a strip that does not belong to it: another survey may take it.
    flight = {"survey": "flight"} if job.request.flight else {}
    return {
        "version": __version__,
        "input": {"file": job.path.name, **fingerprint},
        "options": {name: getattr(job.options, name) for name in WRITING} | {"columns": list(job.columns)},
        "request": {
            "chain": job.request.describe(job.chain) or effective(job.chain),
            "system": None if saved is None else hashlib.sha256(format_survey(saved).encode()).hexdigest(),
            "sensor": {**asdict(sensor), "trajectory": trajectory},
            "calibration": None if job.calibration is None else job.calibration.describe(),
            "attenuation_db_km": None if job.attenuation is None else list(job.attenuation),
            "pulse_energy": energy,
            **flight,
            **({"selection": job.chosen.describe()} if job.chosen else {}),
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
    return {
        "direction": {"sign": vectors.direction, "evidence": vectors.evidence, "vector_ratio": ratio},
        "sensor": prepared.sensor.describe(),
        "air": _describe_air(prepared),
        "pulse_energy": None if prepared.pulse_energy is None else prepared.pulse_energy.describe(),
        "calibration": None if prepared.job.calibration is None else prepared.job.calibration.describe(),
        **seen,
    }


def _describe_air(prepared: Prepared) -> dict[str, Any]:
    """Attenuation that the columns of light use, its error, and where it comes from."""
    job, system = prepared.job, prepared.system
    given = "the default, for which there is no source" if job.calibration is None else "the calibration"
    source = given if job.attenuation is None else "--attenuation or --visibility"
    air = system.radiometry
    return {"attenuation_db_km": air.attenuation, "error_db_km": air.attenuation_error, "from": source}


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
    job = prepared.job
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
            "not_computed": explain_absence(prepared),
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


def write_json(path: Path, document: Mapping[str, Any], *, overwrite: bool) -> None:
    """Write a JSON file, whole or not at all; raises InputError where it exists or cannot be written."""
    write_text(path, format_report(document), overwrite=overwrite)


def format_report(document: Mapping[str, Any]) -> str:
    """Return the text of a JSON file."""
    text = json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False)
    # Bytes of file names that are not UTF-8 are lone surrogates in Python; JSON can escape them.
    return text.encode(errors="backslashreplace").decode() + "\n"


def read_current(job: StripJob, folder: Path, described: Mapping[str, Any]) -> RunReport | None:
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
    RunReport or None
        None where the cloud must be made.
    """
    # Whatever is wrong with a report, the cloud is made anew.
    wrong = (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError)
    with contextlib.suppress(*wrong):
        with open(report_path(job, folder), "rb") as file:
            document = json.loads(file.read(MOST_REPORT))
        if document["checksum"] != _sum_up(document):
            return None
        cloud = cloud_path(job, folder)
        same = document["schema"] == STRIP_SCHEMA and all(
            document[key] == json.loads(json.dumps(value)) for key, value in described.items()
        )
        if same and document["output"]["file"] == cloud.name and document["output"]["size"] == cloud.stat().st_size:
            return RunReport.from_json(document)
    return None
