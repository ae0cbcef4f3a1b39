"""The report file beside a cloud: what it says, and whether the cloud beside it is still the one asked for."""

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
from wavebatch.batch.unit import Prepared, StripJob
from wavebatch.core.no_data import without_nan
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.text_file import write_text
from wavebatch.stages.chain_file import effective
from wavebatch.surveying.choose_chain import describe_choice, describe_survey
from wavebatch.surveying.system_file import format_survey

STRIP_SCHEMA = "wavebatch.strip-report/1"
BATCH_SCHEMA = "wavebatch.batch-report/1"


def cloud_path(job: StripJob, folder: Path) -> Path:
    """Where the cloud of a strip goes."""
    return folder / f"{job.path.stem}.{job.options.format}"


def report_path(job: StripJob, folder: Path) -> Path:
    """Where its report goes; that it is there says that the cloud is complete."""
    return folder / f"{job.path.stem}.report.json"


def describe_job(job: StripJob, fingerprint: Mapping[str, Any]) -> dict[str, Any]:
    """All that decides what is written: two runs for which this is equal write the same cloud."""
    saved, sensor = job.request.system, job.sensor
    trajectory = None if sensor.trajectory is None else take_fingerprint(sensor.trajectory)
    return {
        "version": __version__,
        "input": {"file": job.path.name, **fingerprint},
        "options": asdict(job.options),
        "request": {
            "chain": job.request.describe(job.chain) or effective(job.chain),
            "system": None if saved is None else hashlib.sha256(format_survey(saved).encode()).hexdigest(),
            "sensor": {
                "trajectory": trajectory,
                "crs": sensor.crs,
                "lever_arm": None if sensor.lever_arm is None else list(sensor.lever_arm),
                "height": sensor.height,
            },
            "calibration": None if job.calibration is None else job.calibration.describe(),
        },
    }


def describe_strip(prepared: Prepared, described: Mapping[str, Any]) -> dict[str, Any]:
    """What scan and survey say of the strip. described: from `describe_job`."""
    scan = prepared.scan
    fingerprint = {name: value for name, value in described["input"].items() if name != "file"}
    return {
        "direction": {
            "sign": scan.direction,
            "evidence": scan.direction_evidence,
            "vector_ratio": without_nan(scan.vector_ratio),
        },
        "sensor": prepared.sensor.describe(),
        **describe_survey(prepared.choice, prepared.job.request, fingerprint),
    }


def describe_chain(prepared: Prepared) -> dict[str, Any]:
    """The chain as it is used, and how it was chosen."""
    chosen = describe_choice(prepared.choice, prepared.job.request)
    return {"chain": effective(prepared.job.chain), "choice": chosen}


def build_document(
    prepared: Prepared, described: Mapping[str, Any], report: RunReport, cloud: Path, dropped: Mapping[str, str]
) -> dict[str, Any]:
    """The report of a strip whose cloud is written; everything but `timing` is the same for every run.

    described: from `describe_job`. dropped: records of the input that the cloud does not have, and why.
    """
    facts, layout = prepared.facts, prepared.layout
    lost = {**layout.dropped, **dropped}
    return {
        "schema": STRIP_SCHEMA,
        **described,
        **describe_chain(prepared),
        "strip": {
            "las_version": facts.version,
            "point_format": facts.point_format,
            "points": facts.point_count,
            "packets": {
                "file": facts.packet_file.name if facts.packet_file else None,
                "internal": facts.internal,
                "bytes": facts.packet_end - facts.packet_start,
            },
            **describe_strip(prepared, described),
        },
        "output": {
            "file": cloud.name,
            "size": cloud.stat().st_size,
            "point_format": layout.point_format,
            "columns": {written.column: written.record.name for written in layout.written},
            "not_computed": explain_absence(prepared),
        },
        **report.to_json(),
        "warnings": [*facts.warnings, *prepared.scan.warnings, *(f"{name}: {why}" for name, why in lost.items())],
        "timing": {**build_timing(report), **_tell_saving(prepared)},
    }


def _tell_saving(prepared: Prepared) -> dict[str, Any]:
    """What leaving parts out saves: microseconds per waveform of the survey's sample, as the preparation took them."""
    seconds = prepared.choice.seconds
    if not seconds:
        return {}
    return {"microseconds_per_waveform": {name: round(1e6 * value, 3) for name, value in seconds.items()}}


def build_timing(report: RunReport) -> dict[str, Any]:
    """Seconds by what they were spent on, and waveforms per second of all of them together."""
    total = sum(report.timing.values())
    seconds = {name: round(value, 6) for name, value in report.timing.items()}
    rate = round(report.count("waveforms") / total) if total > 0 else None
    return {"seconds": seconds, "process_seconds": round(total, 6), "waveforms_per_process_second": rate}


def write_json(path: Path, document: Mapping[str, Any], *, overwrite: bool) -> None:
    """The document as a file that appears whole or not at all."""
    text = json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False)
    # Names of files that are not UTF-8 become JSON's own escapes.
    write_text(path, text.encode(errors="backslashreplace").decode() + "\n", overwrite=overwrite)


def read_current(job: StripJob, folder: Path, described: Mapping[str, Any]) -> RunReport | None:
    """The report of a cloud in `folder` that is complete and just what this run would write; None otherwise."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        document = json.loads(report_path(job, folder).read_text("utf-8"))
        cloud = cloud_path(job, folder)
        same = document["schema"] == STRIP_SCHEMA and all(
            document[key] == json.loads(json.dumps(value)) for key, value in described.items()
        )
        if same and document["output"]["file"] == cloud.name and document["output"]["size"] == cloud.stat().st_size:
            return RunReport.from_json(document)
    return None
