"""What made a cloud, from its provenance, and the command that makes it again.

`file_facts` shows it. Before you change it: it may come from any program, so nothing in it is certain.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

from wavebatch.batch.job import RunOptions


def describe_provenance(run: Mapping[str, Any]) -> dict[str, Any]:
    """What made a cloud: version, command, chain, input; what the provenance does not hold is None."""
    options, request, source = (_table(run.get(name)) for name in ("options", "request", "input"))
    return {
        "version": run.get("wavebatch"),
        "command": _name_command(options, request, source),
        "input": source.get("file"),
        "chain": run.get("chain"),
        "chosen_by": _table(run.get("choice")).get("by"),
        "columns": _table(run.get("columns")),
    }


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _name_command(options: Mapping[str, Any], request: Mapping[str, Any], source: Mapping[str, Any]) -> str:
    """A command that makes this cloud, where the files that it names are at hand."""
    parts = ["wavebatch run", _quote(source.get("file", "STRIP")), "-o DIR"]
    by = str(request.get("chain", ""))
    if by.startswith("tolerance"):
        parts.append(f"--tolerance {by.removeprefix('tolerance ').replace(' ', '')}")
    elif by != "auto":
        parts.append("--chain CHAIN.toml")
    parts += _name_inputs(request)
    for field in fields(RunOptions):
        value = options.get(field.name, field.default)
        if field.name == "columns":
            continue  # the columns that were written are listed by themselves
        if value != field.default:
            name = f"--{field.name.replace('_', '-')}"
            parts.append(name if value is True else f"{name} {value}")
    return " ".join([*parts, *_name_selection(_table(request.get("selection")))])


def _name_inputs(request: Mapping[str, Any]) -> Iterator[str]:
    """Options for files, the sensor's position and the air."""
    sensor = _table(request.get("sensor"))
    trajectory, energy = _table(sensor.get("trajectory")), request.get("pulse_energy")
    if trajectory:
        yield "--trajectory FILE"
    if sensor.get("lever_arm"):
        yield f"--lever-arm {_join(sensor['lever_arm'])}"
    if sensor.get("crs"):
        yield f"--crs {_quote(sensor['crs'])}"
    if sensor.get("height"):
        yield f"--flight-height {sensor['height']}"
    if request.get("survey") == "flight":
        yield "--survey flight"
    elif request.get("system"):
        yield "--system SYSTEM.toml"
    if request.get("calibration"):
        yield "--calibration CAL.toml"
    if isinstance(request.get("attenuation_db_km"), list):
        numbers = request["attenuation_db_km"]
        names = ("--attenuation", "--attenuation-error")
        yield " ".join(f"{name} {number}" for name, number in zip(names, numbers, strict=False))
    if energy:
        yield f"--energy {'FILE' if isinstance(energy, dict) else _quote(energy)}"


def _name_selection(selection: Mapping[str, Any]) -> Iterator[str]:
    """Options that choose the points that are written."""
    polygon = _table(selection.get("polygon"))
    if selection.get("where"):
        yield f"--where {_quote(selection['where'])}"
    for name in ("drop_flags", "classes", "bbox"):
        if selection.get(name):
            yield f"--{name.replace('_', '-')} {_join(selection[name])}"
    if polygon:
        yield f"--polygon {_quote(polygon.get('file', 'FILE'))}"


def _join(values: Any) -> str:
    return ",".join(map(str, values)) if isinstance(values, list) else _quote(values)


def _quote(value: Any) -> str:
    return shlex.quote(str(value))
