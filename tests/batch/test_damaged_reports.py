"""--resume and damaged reports: whatever is wrong with one, the cloud is made anew; no altered figure is believed."""

import json
import math

import pytest
from batch_tools import run_one

from wavebatch.batch.report_file import _sum_up
from wavebatch.tools.simulate import simulate_strip


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("done")
    simulate_strip("flat", folder / "a.las", pulses=100, seed=1)
    run_one(folder / "a.las", folder / "out")
    return folder


def _alter(value, *keys):
    def alter(document):
        place = document
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        return document

    return alter


BY_HAND = (
    _alter(7, "counts", "echoes"),
    _alter("0" * 64, "checksum"),
    lambda document: [document],
    lambda document: {key: value for key, value in document.items() if key != "checksum"},
)
BY_ANOTHER_PROGRAM = (
    _alter(math.inf, "counts", "echoes"),
    _alter(3, "counts", "no_data"),
    _alter(None, "quality"),
    _alter("other.laz", "output", "file"),
    _alter(1, "output", "size"),
    _alter("9.9", "version"),
    _alter("wavebatch.strip-report/0", "schema"),
)
"""Their checksum is right."""


@pytest.mark.parametrize(
    ("alter", "is_right"), [*((one, False) for one in BY_HAND), *((one, True) for one in BY_ANOTHER_PROGRAM)]
)
def test_a_report_that_was_altered_is_made_anew(done, alter, is_right):
    path = done / "out" / "a.report.json"
    sound = path.read_bytes()
    document = alter(json.loads(sound))
    if is_right:
        document["checksum"] = _sum_up(document)
    path.write_text(json.dumps(document, indent=2))
    outcome = run_one(done / "a.las", done / "out", batch={"resume": True})
    assert outcome.status == "written"
    assert json.loads(path.read_text())["checksum"] == json.loads(sound)["checksum"]


@pytest.mark.parametrize("data", [b"", b"[" * 100_000, b"\xff", b"null"])
def test_a_report_that_is_no_report_is_made_anew(done, data):
    (done / "out" / "a.report.json").write_bytes(data)
    assert run_one(done / "a.las", done / "out", batch={"resume": True}).status == "written"
