"""Batches: the same bytes for any jobs and blocks, failures that stay alone, resume."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from batch_tools import make_job, read_cloud, run_one
from commands import refuses
from writer_tools import read_provenance

from wavebatch.batch.job import choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import LEAST_MEMORY, plan_memory, run_batch
from wavebatch.batch.strip_task import StripTask
from wavebatch.batch.unit import prepare_strip
from wavebatch.core.errors import ConfigError, InputError


def _report(folder, stem):
    return json.loads((folder / f"{stem}.report.json").read_text())


def _stable(document):
    """The report without what depends on how the run went."""
    return {key: value for key, value in document.items() if key != "timing"}


def _files(folder):
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.fixture(scope="module")
def reference(wide_strip, tmp_path_factory):
    """The wide strip in this process with blocks of the usual size."""
    folder = tmp_path_factory.mktemp("reference")
    outcome = run_one(wide_strip, folder)
    assert outcome.error is None
    return folder


@pytest.mark.quick_cases("3-5000")
@pytest.mark.parametrize(("jobs", "block_size"), [(1, 777), (3, 5000)])
def test_same_bytes_for_any_jobs_and_block_size(wide_strip, reference, tmp_path, jobs, block_size):
    outcome = run_one(wide_strip, tmp_path, batch={"jobs": jobs, "block_size": block_size})
    assert outcome.error is None
    assert (tmp_path / "wide.laz").read_bytes() == (reference / "wide.laz").read_bytes()
    assert _stable(_report(tmp_path, "wide")) == _stable(_report(reference, "wide"))
    assert _files(tmp_path) == ["wide.laz", "wide.report.json"]


@pytest.mark.slow
@pytest.mark.parametrize(("profile", "points"), [("accurate", "echoes"), ("balanced", "returns")])
def test_real_strips_give_the_same_bytes_for_any_block_size(riegl, leica, tmp_path, profile, points):
    for strip in (riegl, leica):
        for name, block_size in (("a", None), ("b", 333)):
            folder = tmp_path / name
            outcome = run_one(strip, folder, profile=profile, points=points, batch={"block_size": block_size})
            assert outcome.error is None
        name = f"{strip.stem}.laz"
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_shuffled_strip_has_the_same_accounts_as_the_ordered_one(wide_strip, reference, edit_points, tmp_path):
    order = np.random.default_rng(1)
    shuffled = edit_points(wide_strip, tmp_path / "wide.las", lambda points: points[order.permutation(len(points))])
    for points in ("echoes", "returns"):
        outcome = run_one(shuffled, tmp_path / points, points=points)
        assert outcome.error is None
        found = outcome.report
        expected = _report(reference, "wide")["counts"]
        for name in ("points_in", "points_with_waveform", "waveforms", "points_without_waveform"):
            assert found.count(name) == expected[name], name
        for name in ("echoes", "matched_returns", "unmatched_returns", "no_echo_returns"):
            assert found.count(name) == pytest.approx(expected[name], rel=2e-3), name


def test_all_real_returns_are_accounted_for(riegl, leica, tmp_path):
    for strip, points, packets in ((riegl, 2535, 2375), (leica, 999, 999)):
        counts = run_one(strip, tmp_path).report
        assert counts.count("points_in") == points
        assert counts.count("waveforms") == packets
        cloud, _ = read_cloud(tmp_path / f"{strip.stem}.laz")
        assert len(cloud) == counts.count("points_out")


def test_report_and_provenance_say_how_the_cloud_was_made(riegl, tmp_path):
    run_one(riegl, tmp_path, columns="+echo_time")
    document = _report(tmp_path, riegl.stem)
    assert document["schema"] == "wavebatch.strip-report/1"
    assert document["input"]["file"] == riegl.name
    assert document["input"]["size"] == riegl.stat().st_size
    assert document["input"]["packets"]["size"] == riegl.with_suffix(".wdp").stat().st_size
    assert 'stage = "decompose.closed_form"' in document["chain"] and "steps = 2" in document["chain"]
    assert document["strip"]["direction"]["sign"] == "toward"
    assert document["strip"]["system"]["sigma_ref_ns"] == pytest.approx(1.9, abs=0.2)
    assert document["output"]["size"] == (tmp_path / f"{riegl.stem}.laz").stat().st_size
    assert document["output"]["columns"]["echo_time"] == "echo_time"
    timing = document["timing"]
    for kind in ("processor", "wall"):
        assert {"scan", "survey", "decompose.closed_form", "write"} <= set(timing[f"{kind}_seconds"])
        assert timing[f"total_{kind}_seconds"] == pytest.approx(sum(timing[f"{kind}_seconds"].values()), abs=1e-4)
    assert timing["waveforms_per_processor_second"] > 0
    made = read_provenance(tmp_path / f"{riegl.stem}.laz")[-1]
    for key in ("chain", "input", "options", "version", "system", "direction"):
        expected = document.get(key, document["strip"].get(key))
        assert made[key] == expected, key


def test_one_bad_strip_does_not_stop_the_others(tiny_strip, tmp_path):
    broken = tmp_path / "broken.las"
    broken.write_bytes(tiny_strip.read_bytes()[:1000])
    jobs = [make_job(broken), make_job(tmp_path / "none.las"), make_job(tiny_strip)]
    events = []
    result = run_batch(jobs, RunOptions(tmp_path / "out", jobs=2), events.append)
    assert [outcome.status for outcome in result.outcomes] == ["failed", "failed", "written"]
    assert result.failed == 2
    for outcome in result.outcomes[:2]:
        assert isinstance(outcome.error, InputError) and "\n" not in str(outcome.error)
    assert _files(tmp_path / "out") == ["tiny.laz", "tiny.report.json"]
    assert {event["event"] for event in events} == {"start", "unit", "written", "failed"}
    summary = result.to_json()
    assert [strip["status"] for strip in summary["strips"]] == ["failed", "failed", "written"]
    assert summary["counts"]["points_in"] == result.outcomes[2].report.count("points_in")
    json.dumps(summary)


def test_existing_outputs_are_refused_replaced_or_kept(tiny_strip, tmp_path):
    assert run_one(tiny_strip, tmp_path).status == "written"
    cloud = tmp_path / "tiny.laz"
    before = (cloud.read_bytes(), cloud.stat().st_mtime_ns)
    refused = run_one(tiny_strip, tmp_path)
    assert refused.status == "failed" and "--overwrite" in str(refused.error)
    kept = run_one(tiny_strip, tmp_path, batch={"resume": True})
    assert kept.status == "skipped" and kept.report.count("points_in") > 0
    assert (cloud.read_bytes(), cloud.stat().st_mtime_ns) == before
    assert run_one(tiny_strip, tmp_path, batch={"overwrite": True}).status == "written"
    assert cloud.read_bytes() == before[0] and cloud.stat().st_mtime_ns != before[1]


def test_an_orphaned_report_is_refused_too(tiny_strip, tmp_path):
    run_one(tiny_strip, tmp_path)
    (tmp_path / "tiny.laz").unlink()
    assert run_one(tiny_strip, tmp_path).status == "failed"
    assert run_one(tiny_strip, tmp_path, batch={"resume": True}).status == "written"


@pytest.mark.parametrize("change", ["input", "chain", "options", "cloud", "no report"])
def test_resume_does_again_what_is_not_the_same(tiny_strip, tmp_path, change):
    strip = tmp_path / "in" / "tiny.las"
    strip.parent.mkdir()
    shutil.copyfile(tiny_strip, strip)
    folder = tmp_path / "out"
    assert run_one(strip, folder).status == "written"
    counts, cloud, options = folder / "tiny.report.json", folder / "tiny.laz", {}
    if change == "input":
        content = bytearray(strip.read_bytes())
        content[-1] ^= 1
        strip.write_bytes(content)
    elif change == "chain":
        options["profile"] = "balanced"
    elif change == "options":
        options["columns"] = "+echo_time"
    elif change == "cloud":
        cloud.write_bytes(cloud.read_bytes()[:-1])
    else:
        counts.unlink()
    assert run_one(strip, folder, batch={"resume": True}, **options).status == "written"
    assert run_one(strip, folder, batch={"resume": True}, **options).status == "skipped"
    assert _files(folder) == ["tiny.laz", "tiny.report.json"]


def test_a_failure_while_writing_leaves_nothing(tiny_strip, tmp_path):
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        outcome = run_one(tiny_strip, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert outcome.status == "failed" and "File too large" in str(outcome.error)
    assert _files(tmp_path) == []


def test_an_account_that_does_not_add_up_is_a_failure_not_a_cloud(tiny_strip, tmp_path, monkeypatch):
    from wavebatch.batch import counts

    real = counts.RunReport.of_echoes.__func__

    def lose_one(cls, per_waveform, amplitude, sigma):
        return real(cls, per_waveform[1:], amplitude, sigma)

    monkeypatch.setattr(counts.RunReport, "of_echoes", classmethod(lose_one))
    outcome = run_one(tiny_strip, tmp_path)
    assert outcome.status == "failed" and "waveforms is" in str(outcome.error)
    assert _files(tmp_path) == []


def test_a_strip_that_changes_while_it_is_read_is_not_written(tiny_strip, tmp_path):
    strip = tmp_path / "tiny.las"
    shutil.copyfile(tiny_strip, strip)
    task = StripTask(make_job(strip), RunOptions(tmp_path), alone=False)
    assert task.start(jobs=1) is None
    from wavebatch.batch.workers.processes import Workers

    with Workers(1) as workers:
        while not task.is_complete:
            task.submit(workers)
            task.take()
    strip.write_bytes(strip.read_bytes() + b"more")
    refuses(InputError, "changed while it was read", task.finish)
    task.drop()
    assert _files(tmp_path) == ["tiny.las"]


def test_memory_decides_jobs_and_blocks():
    assert plan_memory(4, None) == (4, None)
    assert plan_memory(4, 8 << 30) == (4, None)
    jobs, block_size = plan_memory(4, 3 * LEAST_MEMORY)
    assert jobs == 2 and block_size is not None
    assert plan_memory(1, LEAST_MEMORY)[0] == 1
    assert plan_memory(8, LEAST_MEMORY)[0] == 1
    refuses(ConfigError, "too little", plan_memory, 1, LEAST_MEMORY - 1)


def test_columns_are_chosen_and_added():
    chain = make_job("x.las").chain
    usual = choose_columns(chain)
    assert usual[-1] == "echo_flags" and "echo_time" not in usual and "x" not in usual
    assert choose_columns(chain, "+echo_time") == (*usual, "echo_time")
    assert choose_columns(chain, "echo_width, amplitude") == ("echo_width", "amplitude")
    assert choose_columns(chain, "echo_width,+echo_time") == ("echo_width", "echo_time")
    refuses(ConfigError, "did you mean 'amplitude'", choose_columns, chain, "amplitud")
    refuses(ConfigError, r"write \+amplitude to add it too", choose_columns, chain, "+echo_time,amplitude")
    refuses(ConfigError, r"does not compute 'energy'; add stage attribute\.energy", choose_columns, chain, "+energy")


def test_a_chain_without_positions_is_refused():
    import dataclasses

    chain = make_job("x.las").chain
    refuses(ConfigError, r"attribute\.position", choose_columns, dataclasses.replace(chain, steps=chain.steps[:3]))


def test_a_prepared_strip_travels_between_processes(tiny_strip):
    import pickle

    prepared = prepare_strip(make_job(tiny_strip))
    again = pickle.loads(pickle.dumps(prepared))
    assert again.system == prepared.system and again.layout.dtype == prepared.layout.dtype
    assert again.job.options == RunOptions(profile="fast") and again.job.columns == prepared.job.columns
    prepared.scan.close()
