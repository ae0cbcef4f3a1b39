"""Files that version 0.1 wrote are read to the last bit, and written again as they were."""

import json
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from wavebatch.batch.counts import RunReport
from wavebatch.batch.report_file import _sum_up as sum_up
from wavebatch.stages.chain import effective, load_chain_file
from wavebatch.surveying.calibrating.calibration_files import format_calibration, load_calibration
from wavebatch.surveying.systems.survey_result import format_survey, load_survey

FOLDER = Path(__file__).parent / "written_files"
"""Written by commit 53e1b4c0 from simulated strips (stiff, village, a flight of three), and two with every key."""

READ = json.loads((FOLDER / "read.json").read_text())
"""What that commit read from them: fields by name, floats to the last bit. Of the chain: with defaults of today."""


def plain(value):
    """Plain values for JSON, which keeps every float; keys of mappings as text."""
    if is_dataclass(value):
        return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return list(map(plain, value))
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def read_written(path):
    """What the readers of wavebatch make of a file, as plain values."""
    if path.name.endswith(".report.json"):
        return plain(RunReport.from_json(json.loads(path.read_text())))
    if path.name.endswith(".system.toml"):
        return plain(load_survey(path))
    if path.name.endswith(".calibration.toml"):
        found = load_calibration(path)
        return {"read": plain(found), "described": plain(found.describe())}
    return effective(load_chain_file(path))


def check_within(expected, found):
    """All that was read then is read now; fields that are new since then are not asked for."""
    if isinstance(expected, dict):
        assert expected.keys() <= found.keys()
        for key, value in expected.items():
            check_within(value, found[key])
    else:
        assert found == expected


@pytest.mark.parametrize("name", READ)
def test_a_written_file_is_read_to_the_last_bit(name):
    check_within(READ[name], json.loads(json.dumps(read_written(FOLDER / name))))


@pytest.mark.parametrize("name", [name for name in READ if name.endswith(".system.toml")])
def test_a_system_file_is_written_again_line_for_line(name):
    again = iter(format_survey(load_survey(FOLDER / name)).splitlines())
    assert all(line in again for line in (FOLDER / name).read_text().splitlines())


@pytest.mark.parametrize("name", [name for name in READ if name.endswith(".calibration.toml")])
def test_a_calibration_is_written_again_but_for_what_only_documents_it(name):
    again = iter(format_calibration(load_calibration(FOLDER / name)).splitlines())
    assert all(line in again for line in (FOLDER / name).read_text().partition("\n[[target]]")[0].splitlines())


def test_the_counts_of_a_report_are_written_again():
    document = json.loads((FOLDER / "stiff.report.json").read_text())
    again = RunReport.from_json(document).to_json()
    assert again == {name: document[name] for name in again}
    assert sum_up(document) == document["checksum"]
