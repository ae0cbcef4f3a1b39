"""--resume and damaged reports: whatever is wrong with one, the cloud is made anew; no altered figure is believed."""

import json

import pytest
from batch_tools import run_one

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


@pytest.mark.parametrize(
    "alter",
    [
        _alter(7, "counts", "echoes"),
        _alter(["all is well"], "remarks"),
        _alter(10**400, "counts", "echoes"),
        _alter(3, "counts", "no_data"),
        _alter(None, "quality"),
        _alter("other.laz", "output", "file"),
        _alter("0" * 64, "checksum"),
        lambda document: [document],
        lambda document: {key: value for key, value in document.items() if key != "checksum"},
    ],
)
def test_a_report_that_was_altered_is_made_anew(done, alter):
    path = done / "out" / "a.report.json"
    sound = path.read_bytes()
    path.write_text(json.dumps(alter(json.loads(sound)), indent=2))
    outcome = run_one(done / "a.las", done / "out", batch={"resume": True})
    assert outcome.status == "written"
    assert json.loads(path.read_text())["checksum"] == json.loads(sound)["checksum"]


@pytest.mark.parametrize("data", [b"", b"[" * 100_000, b"\xff", b"null"])
def test_a_report_that_is_no_report_is_made_anew(done, data):
    (done / "out" / "a.report.json").write_bytes(data)
    assert run_one(done / "a.las", done / "out", batch={"resume": True}).status == "written"
