"""Runs: outputs, jobs, memory, order, resume; of a flight with one survey; of chosen points."""

import hashlib
import json
import re
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
from batch_tools import make_job, read_cloud, read_outputs, run_one
from commands import fail, refuses, run_command, succeed
from helpers_scenes import make_scene
from writer_tools import read_provenance

import wavebatch as wb
from wavebatch.batch.counts import LEFT_OUT
from wavebatch.batch.job import choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import LEAST_MEMORY, plan_memory, run_batch
from wavebatch.batch.strip_task import StripTask
from wavebatch.batch.unit import prepare_strip
from wavebatch.core.condition import parse_condition
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.surveying.systems.survey_result import format_survey, load_survey
from wavebatch.tools.simulate import find_pulse, simulate_strip


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


def test_kept_packets_have_the_place_of_each_echo(tiny_strip, tmp_path):
    run_one(tiny_strip, tmp_path, columns="+echo_time", keep_packets=True)
    points, _ = read_cloud(tmp_path / "tiny.laz")
    known = points["echo_time"] != -9999
    places = points["return_point_wave_location"][known]
    assert known.sum() > 100 and places == pytest.approx(1000 * points["echo_time"][known], abs=1)


def test_small_strips_are_worked_on_beside_each_other(tiny_strip, tmp_path):
    names, events = ("a.las", "b.las", "c.las"), []
    jobs = [make_job(shutil.copy(tiny_strip, tmp_path / name)) for name in names]
    run_batch(jobs, RunOptions(tmp_path / "out", jobs=2), events.append)
    assert [event["event"] for event in events[:2]] == ["start", "start"]


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


def fly(*arguments):
    return run_command("run", *arguments)


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """Three strips of a flight, and one whose level is another."""
    folder = tmp_path_factory.mktemp("strips")
    for number, (name, scene, baseline) in enumerate(
        [("a", "flat", 12.0), ("b", "urban", 12.0), ("c", "flat", 12.0), ("odd", "flat", 14.0)]
    ):
        recording = {"pulse": find_pulse("riegl"), "n_samples": 100, "baseline": baseline}
        simulate_strip(make_scene(scene, **recording), folder / f"{name}.las", pulses=700, seed=number)
    return {path.stem: path for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def flown(strips, tmp_path_factory):
    """Clouds of a, b and the odd one with one survey, and what was said."""
    folder = tmp_path_factory.mktemp("flown")
    result = succeed("run", *(strips[name] for name in ("a", "b", "odd")), "-o", folder, "--survey", "flight")
    return folder, result


def test_all_strips_have_the_pulse_of_the_flight(strips, flown):
    folder, result = flown
    saved = load_survey(folder / "flight.system.toml")
    assert saved.strip == "2 strips" and len(saved.fingerprint["strips"]) == 2
    for name in ("a", "b"):
        document = _report(folder, name)
        assert document["strip"]["system"]["sigma_ref_ns"] == saved.survey.system.sigma_ref
        source = document["strip"]["survey"]
        assert source["from"] == "flight" and source["strips"] == 2
        assert source["flight"] == {"fits": True, "reason": None}
        expected = hashlib.sha256(format_survey(saved).encode()).hexdigest()
        assert document["request"]["system"] == expected and document["request"]["survey"] == "flight"
        assert len(read_cloud(folder / f"{name}.laz")[0]) == document["counts"]["points_out"]


def test_a_strip_that_does_not_fit_is_named_once_and_gets_its_own_survey(strips, flown):
    folder, result = flown
    lines = [line for line in result.stderr.splitlines() if "does not belong to the flight" in line]
    assert len(lines) == 1 and "odd.las" in lines[0] and "its level is 14." in lines[0]
    document = _report(folder, "odd")
    assert document["strip"]["survey"]["from"] == "strip"
    assert document["strip"]["survey"]["flight"]["fits"] is False
    assert document["strip"]["survey"]["flight"]["reason"] in document["remarks"][0]
    assert document["strip"]["system"]["baseline_dn"] == pytest.approx(14.0, abs=0.5)


def test_resume_takes_the_kept_survey_also_for_later_strips(strips, flown, tmp_path):
    folder, _ = flown
    before = read_outputs(folder)
    result = fly(*(strips[name] for name in ("a", "b", "odd", "c")), "-o", folder, "--survey", "flight", "--resume")
    assert result.exit_code == 0 and result.stderr.count("skipped") == 3
    after = read_outputs(folder)
    assert {name: after[name] for name in before} == before
    assert _report(folder, "c")["request"] == _report(folder, "a")["request"]
    fail(4, "exists already", "run", strips["c"], "-o", folder, "--survey", "flight")


@pytest.mark.slow
def test_the_order_and_the_jobs_do_not_matter(strips, flown, tmp_path):
    folder, _ = flown
    succeed("run", *(strips[name] for name in ("odd", "b", "a")), "-o", tmp_path, "--survey", "flight", "--jobs", 2)
    expected = read_outputs(folder).items()
    assert read_outputs(tmp_path) == {name: content for name, content in expected if not name.startswith("c.")}


def test_a_changed_survey_is_not_trusted_in_silence(strips, tmp_path):
    assert fly(strips["a"], strips["b"], "-o", tmp_path, "--survey", "flight").exit_code == 0
    path = tmp_path / "flight.system.toml"
    text = path.read_text()
    path.write_text(re.sub("acceptance = .*", "acceptance = 20.0", text))
    result = fly(strips["a"], "-o", tmp_path, "--survey", "flight", "--resume")
    assert result.exit_code == 0 and "skipped" not in result.stderr
    assert _report(tmp_path, "a")["strip"]["system"]["acceptance"] == 20.0
    assert _report(tmp_path, "b")["strip"]["system"]["acceptance"] == 15.0
    path.write_text(text.split("[figures]")[0])
    broken = fly(strips["a"], "-o", tmp_path, "--survey", "flight", "--resume")
    assert broken.exit_code == 2 and "holds no survey of a flight" in broken.stderr and broken.stderr.count("\n") == 1
    path.write_text(text[:500])
    cut = fly(strips["a"], "-o", tmp_path, "--survey", "flight", "--resume")
    assert cut.exit_code == 2 and cut.stderr.startswith(f"error: {path}: not valid TOML: ")
    assert cut.stderr.endswith("; remove it: then the strips are surveyed again\n")
    again = fly(strips["a"], strips["b"], "-o", tmp_path, "--survey", "flight", "--overwrite")
    assert again.exit_code == 0 and path.read_text() == text


def test_a_dry_run_writes_nothing_and_knows_what_is_done(strips, flown, tmp_path):
    folder, _ = flown
    done = fly(strips["a"], "-o", folder, "--survey", "flight", "--resume", "--dry-run")
    assert done.exit_code == 0 and ": skip " in done.stdout
    new = fly(strips["a"], "-o", tmp_path / "new", "--survey", "flight", "--dry-run")
    assert new.exit_code == 0 and ": write " in new.stdout and not (tmp_path / "new").exists()


def test_a_gain_that_no_digitizer_has_does_not_stop_the_flight(strips, tmp_path):
    data = bytearray(strips["a"].read_bytes())
    place = data.index(b"LASF_Spec\0") + 52  # body of the first descriptor
    assert data[place] == 8 and data.count(b"LASF_Spec\0") >= 1
    data[place + 10 : place + 18] = np.float64(1e300).tobytes()
    (tmp_path / "a.las").write_bytes(data)
    result = fly(tmp_path / "a.las", "-o", tmp_path / "out", "--survey", "flight", "--profile", "fast")
    assert result.exit_code == 0 and "descriptor 1 has gain 1e+300 V" in result.stderr
    load_survey(tmp_path / "out" / "flight.system.toml")


def test_a_survey_that_could_not_be_read_again_is_not_written(strips, tmp_path, monkeypatch):
    monkeypatch.setattr("wavebatch.batch.run.format_survey", lambda saved: format_survey(saved) + "\n[unknown]\n")
    result = fly(strips["a"], "-o", tmp_path / "out", "--survey", "flight", "--profile", "fast")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert list((tmp_path / "out").iterdir()) == []


def test_a_survey_of_which_no_cloud_comes_is_not_kept(strips, flown, tmp_path):
    """The next run may be of other strips, and would take it."""
    wrong = ("--survey", "flight", "--where", "nonsense > 3", "--profile", "fast")
    result = fly(strips["a"], strips["b"], "-o", tmp_path / "out", *wrong)
    assert result.exit_code == 2 and not (tmp_path / "out").exists()
    folder, before = flown[0], read_outputs(flown[0])
    assert fly(strips["c"], "-o", folder, *wrong).exit_code in (2, 4) and read_outputs(folder) == before


def test_a_survey_of_an_interrupted_run_is_kept_for_the_next(strips, tmp_path):
    def interrupt(event):
        if event["event"] == "start":
            raise KeyboardInterrupt

    refuses(KeyboardInterrupt, "", wb.run, strips["a"], tmp_path, survey="flight", chain="fast", on_event=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["flight.system.toml"]


def test_a_batch_whose_surveys_agree_says_so_in_its_report_and_with_v(strips, tmp_path):
    report = tmp_path / "batch.json"
    quiet = fly(strips["a"], strips["c"], "-o", tmp_path / "1", "--report", report)
    assert "--survey flight" not in quiet.stderr and "--survey flight" in json.loads(report.read_text())["advice"]
    told = fly(strips["a"], strips["c"], "-o", tmp_path / "2", "-v")
    assert told.stderr.count("--survey flight") == 1
    apart = fly(strips["a"], strips["odd"], "-o", tmp_path / "3", "-v", "--report", report)
    assert "--survey flight" not in apart.stderr and "advice" not in json.loads(report.read_text())


def run_chosen(strip, folder, **options):
    """The records of the cloud of a run, its report, and the result."""
    result = wb.run(strip, folder, **{"chain": "balanced", **options})
    assert not result.failed, result.outcomes[0].error
    (path,) = [path for path in folder.iterdir() if path.suffix in (".laz", ".las")]
    report = json.loads((folder / f"{path.stem}.report.json").read_text())
    return laspy.read(path), report


@pytest.fixture(scope="module")
def full(riegl, tmp_path_factory):
    """All points of the strip, as records."""
    return run_chosen(riegl, tmp_path_factory.mktemp("full"))


def _bits(las):
    return np.asarray(las["echo_flags"])


def _box(las):
    """A box around the middle half."""
    (west, south), (east, north) = (np.quantile(np.c_[las.x, las.y], q, axis=0) for q in (0.2, 0.8))
    return (float(west), float(south), float(east), float(north))


def _check_sums(report, written):
    counts = report["counts"]
    left = counts["left_out"]
    assert set(left) == set(LEFT_OUT)
    assert counts["points_out"] == written
    assert written + sum(left.values()) == counts["echoes"] + sum(counts["passed_through"].values())


def _area(path, box):
    west, south, east, north = box
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


def test_points_on_the_edge_of_a_box_are_in_it(riegl, full, tmp_path):
    las, _ = full
    x, y = np.asarray(las.x), np.asarray(las.y)
    some, report = run_chosen(riegl, tmp_path, bbox=(x.min(), y.min(), x.max(), y.max()))
    assert len(some.points) == len(las.points) and report["counts"]["left_out"]["bbox"] == 0


def test_each_option_writes_points_of_the_full_run_and_counts_the_others(riegl, full, tmp_path):
    las, whole = full
    box = _box(las)
    width, x, y = np.asarray(las["echo_width"]), np.asarray(las.x), np.asarray(las.y)
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    first = int(np.asarray(las.classification)[0])
    cases = {
        "where": (
            "echo_width < 4.5 and return_number == 1",
            (width < 4.5) & (width != -9999) & (las.return_number == 1),
        ),
        "bbox": (box, inside),
        "polygon": (_area(tmp_path / "a.geojson", box), inside),
        "classes": ([first, 77], np.asarray(las.classification) == first),
    }
    for name, (value, chosen) in cases.items():
        some, report = run_chosen(riegl, tmp_path / name, **{name: value})
        if name == "polygon":  # points on the border may be on either side
            assert abs(len(some.points) - chosen.sum()) < 5
        else:
            np.testing.assert_array_equal(some.points.array, las.points.array[np.asarray(chosen)])
            assert report["counts"]["left_out"][name] == np.count_nonzero(~np.asarray(chosen))
        _check_sums(report, len(some.points))
        written = {flag.name: int(np.count_nonzero(_bits(some) & flag)) for flag in EchoFlag}
        assert report["counts"]["flags"] == written
        for same in ("echoes", "waveforms", "points_in", "no_data", "passed_through"):
            assert report["counts"][same] == whole["counts"][same]


def test_a_point_counts_for_the_first_reason_that_leaves_it_out(riegl, full, tmp_path):
    las, _ = full
    box = _box(las)
    some, report = run_chosen(riegl, tmp_path, where="z < 0", bbox=box, drop_flags="weak")
    weak = (_bits(las) & EchoFlag.WEAK) > 0
    # As numbers: laspy compares its views by rounded record values, in which a point beyond a border may lie on it.
    x, y = np.asarray(las.x), np.asarray(las.y)
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    expected = {"drop_flags": weak.sum(), "bbox": (~weak & ~inside).sum(), "where": (~weak & inside).sum()}
    assert {name: n for name, n in report["counts"]["left_out"].items() if n} == expected
    assert len(some.points) == 0
    assert any("no point is written" in one["text"] for one in report["warnings"])
    _check_sums(report, 0)


def test_dropped_flags_are_no_echoes_of_their_pulse(riegl, full, tmp_path):
    las, _ = full
    some, report = run_chosen(riegl, tmp_path, drop_flags="OVERLAPPED,WEAK")
    kept = (_bits(las) & (EchoFlag.OVERLAPPED | EchoFlag.WEAK)) == 0
    assert 0 < report["counts"]["left_out"]["drop_flags"] == np.count_nonzero(~kept)
    for name in ("X", "Y", "Z", "echo_width", "gps_time"):
        np.testing.assert_array_equal(some.points.array[name], las.points.array[name][kept])
    # The numbers of a pulse count from 1 without a gap, up to the number of its points that are left.
    known = _whole_times(las)
    for time in known:
        rows = np.asarray(some.gps_time) == time
        numbers = np.sort(np.asarray(some.return_number)[rows])
        np.testing.assert_array_equal(numbers, np.arange(len(numbers)) + 1)
        assert set(np.asarray(some.number_of_returns)[rows]) <= {len(numbers)}
    renumbered = np.asarray(las.number_of_returns)[kept] != np.asarray(some.number_of_returns)
    assert renumbered.sum() > 10


def _whole_times(las):
    """Times of pulses with as many points as they say; points far apart in the file are different pulses."""
    times, pulse, size = np.unique(np.asarray(las.gps_time), return_inverse=True, return_counts=True)
    wrong = np.unique(pulse[size[pulse] != np.asarray(las.number_of_returns)])
    return np.delete(times, wrong)


def test_where_sees_the_numbers_without_dropped_echoes(riegl, full, tmp_path):
    some, _ = run_chosen(riegl, tmp_path, drop_flags="OVERLAPPED", where="number_of_returns == 1")
    assert len(some.points) and set(np.asarray(some.number_of_returns)) == {1}
    times, sizes = np.unique(np.asarray(some.gps_time), return_counts=True)
    assert sizes[np.isin(times, _whole_times(full[0]))].max() == 1


@pytest.mark.parametrize("names", ["wavebatch", "riegl", "asprs"])
def test_columns_that_are_not_written_or_in_other_units_decide_all_the_same(riegl, full, tmp_path, names):
    las, _ = full
    where = "echo_width < 4.5 and amplitude >= 100"
    some, _ = run_chosen(riegl, tmp_path, where=where, names=names, columns="amplitude")
    chosen = find_keep_mask(las, where)
    np.testing.assert_array_equal(some.points.array["Z"], las.points.array["Z"][chosen])
    assert "echo_width" not in some.point_format.dimension_names


def find_keep_mask(las, text):
    condition = parse_condition(text)
    values = {}
    for name in condition.columns:
        stored = f"wb_{name}" if f"wb_{name}" in las.point_format.dimension_names else name
        values[name] = np.where(np.asarray(las[stored]) == -9999, np.nan, las[stored])
    return condition.choose(values)


def test_columns_of_a_second_pass_decide_after_it(riegl, tmp_path):
    """Normals are those of all points; selection comes after them."""
    columns = "+incidence_angle_normals"
    las, _ = run_chosen(riegl, tmp_path / "all", columns=columns)
    chosen = find_keep_mask(las, "incidence_angle_normals < 20")
    assert 0 < chosen.sum() < len(chosen)
    for name, more in (("a", {"columns": columns}), ("b", {"columns": "amplitude"})):
        some, report = run_chosen(riegl, tmp_path / name, where="incidence_angle_normals < 20", **more)
        np.testing.assert_array_equal(some.points.array["Z"], las.points.array["Z"][chosen])
        assert report["counts"]["left_out"]["where"] == np.count_nonzero(~chosen)
        last = np.asarray(las.return_number) == np.asarray(las.number_of_returns)
        lost = int(np.count_nonzero(last & ~chosen))
        assert report["quality"]["last_echoes_left_out"] == lost
        told = [line for line in report["remarks"] if f"--where: {lost} of the {np.count_nonzero(~chosen)}" in line]
        assert len(told) == (lost > 0)
        _check_sums(report, int(chosen.sum()))
    first, _ = run_chosen(riegl, tmp_path / "c", where="incidence_angle_normals < 20", columns=columns)
    np.testing.assert_array_equal(first["incidence_angle_normals"], las["incidence_angle_normals"][chosen])


def test_resume_redoes_a_cloud_of_another_selection(riegl, tmp_path):
    area = _area(tmp_path / "a.geojson", (0.0, 0.0, 1e7, 1e7))

    def status(**options):
        return wb.run(riegl, tmp_path / "out", chain="fast", resume=True, **options).outcomes[0].status

    assert status(where="z > 0") == "written"
    assert status(where="z > 0") == "skipped"
    assert status(where="z > 1") == "written"
    assert status() == "written"
    assert status(polygon=area) == "written"
    assert status(polygon=area) == "skipped"
    _area(area, (0.0, 0.0, 2e7, 1e7))
    assert status(polygon=area) == "written"


def test_the_summary_says_what_is_left_out(riegl, tmp_path):
    words = ["run", str(riegl), "-o", str(tmp_path), "--profile", "fast", "--where", "z > 1e6", "--drop-flags", "WEAK"]
    result = succeed(*words)
    assert "-> 0 points; left out: " in result.output and " by --drop-flags, " in result.output
    assert "no point is written" in run_command(*words, "--overwrite", "--quiet").output


def test_the_workers_of_a_cluster_need_not_see_the_polygons(tiny_strip, tmp_path, monkeypatch):
    """They are read before anything starts, and may lie on this machine alone; files of the work must be there."""

    def refuse(address, folder, files):
        seen.extend(files)
        raise ConfigError("stop")

    seen = []
    monkeypatch.setattr("wavebatch.batch.workers.dask_cluster.Cluster", refuse)
    path, energy = tmp_path / "path.txt", tmp_path / "energy.txt"
    path.write_text("time x y z\n0 0 0 900\n1 9 9 900\n")
    energy.write_text("time energy\n0 1\n1 1\n")
    with pytest.raises(ConfigError, match="stop"):
        wb.run(tiny_strip, tmp_path, polygon=_area(tmp_path / "a.json", (0, 0, 1, 1)), energy=energy,
               trajectory=path, scheduler="tcp://there:8786")  # fmt: skip
    assert sorted(seen) == sorted([tiny_strip, path, energy])


@pytest.mark.parametrize(
    ("names", "where"),
    [("wavebatch", "echo_width < 4.5"), ("riegl", "'Echo Width' < 4.65"), ("pdal", "AMPLITUDE > 30 and z > 0")],
)
def test_conditions_of_a_cloud_read_as_those_of_its_run(full, riegl, tmp_path, names, where):
    """One grammar and one resolution of names: `stats --where` takes what `run --where` would have written."""
    some, _ = run_chosen(riegl, tmp_path / "some", where=where, names=names)
    run_chosen(riegl, tmp_path / "all", names=names)
    path = next((tmp_path / "all").glob("*.laz"))
    with CloudReader(path) as reader:
        keep = reader.plan(PointFilter.build(where=where))
    raw = laspy.read(path).points.array
    assert 0 < len(some.points) == np.count_nonzero(keep.test(raw, len(raw)) == 0)
