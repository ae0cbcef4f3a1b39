"""`info` and `check`: what they say of good strips, bad strips and chain files, and their exit codes."""

import json
import struct

import numpy as np
import pytest
from commands import run_command as run
from commands import succeed
from strips import descriptor, make_raw
from writer_tools import data_file

from wavebatch.files.las.header import read_header
from wavebatch.surveying.inspect_strip import check_file
from wavebatch.tools.file_facts import describe_file

pytestmark = pytest.mark.kept_surveys

RIEGL = "riegl-q680i/100429_152240_2535pt_UTM.las"


def test_info_of_the_riegl_pair():
    facts = describe_file(data_file(RIEGL))
    assert (facts["points"], facts["points_with_waveform"], facts["share_with_waveform"]) == (2535, 2535, 1.0)
    assert (facts["las_version"], facts["point_format"], facts["compressed"]) == ("1.4", 9, False)
    assert facts["packets"]["count"] == 2375
    assert facts["packets"]["where"] == "external"
    assert facts["packets"]["descriptors_unused"] == 98
    assert [d["samples"] for d in facts["packets"]["descriptors"]] == [60, 120]
    assert facts["samples"]["lengths"] == [60, 120] and facts["samples"]["largest"] == 248
    assert facts["extra_dimensions"] == ["Amplitude", "Pulse width"]
    assert facts["vectors"]["direction"] == "toward"
    assert facts["crs"].startswith("PROJCS")
    assert facts["warnings"] == facts["problems"] == []
    json.dumps(facts, allow_nan=False)


def test_info_of_a_strip_that_cannot_be_processed_still_tells_what_it_holds(tmp_path):
    raw = make_raw()
    raw.packets = b""
    path = raw.write(tmp_path / "a.las")
    facts = describe_file(path)
    assert facts["points_broken"] == facts["points"]
    assert facts["problems"][0].startswith("no packet can be used")
    assert facts["samples"]["least"] is None
    json.dumps(facts, allow_nan=False)
    result = run("info", path)
    assert result.exit_code == 1 and "problem           no packet can be used" in result.stdout
    assert result.stderr.startswith(f"error: {path}: no packet can be used")


def test_check_of_clean_files_is_0():
    result = succeed("check", data_file(RIEGL), data_file("leica-als/simple1_3_full_internal.las"))
    assert result.stdout.count(": ok (") == 2
    assert "note: points lie outside the bounds" in result.stdout


def make_bad(tmp_path):
    raw = make_raw(60, most_returns=1)
    raw.points["wavepacket_offset"][3] = 2**64 - 1
    raw.points["wavepacket_index"][4:6] = 9
    raw.points["wavepacket_size"][7] = 16
    raw.points["x_t"][8] = np.nan
    raw.head = None
    return raw.write(tmp_path / "bad.las")


def test_check_gives_every_problem_a_line_with_its_place(tmp_path):
    path = make_bad(tmp_path)
    lines = run("check", path).stdout.splitlines()
    for text in (
        "1 point (first: point 3) with a packet past the end of the waveform data",
        "2 points (first: point 4) with a descriptor that the header does not have",
        "1 point (first: point 8) with an impossible return location or packet vector",
        "1 point with packets of fewer samples than their descriptor gives",
    ):
        assert sum(text in line for line in lines) == 1, text
    assert all(line.startswith(f"{path}: ") for line in lines)


def test_info_says_a_problem_once():
    result = run("info", data_file("no-packets/pdrf9-1.5.laz"))
    assert result.exit_code == 1 and result.stdout.count("compression of LAS 1.5") == 1


def test_check_counts_points_without_a_possible_time(tmp_path):
    raw = make_raw(60, most_returns=1)
    raw.points["gps_time"][:4] = np.nan, np.inf, 1e300, -1e11
    result = succeed("check", raw.write(tmp_path / "a.las"))
    assert "note: 4 points without a possible GPS time: neither their pulses nor ranges can be known" in result.stdout
    assert "GPS time" not in succeed("check", make_raw(60).write(tmp_path / "b.las")).stdout


def test_check_as_json_and_several_files(tmp_path):
    good = make_raw().write(tmp_path / "good.las")
    result = run("check", good, make_bad(tmp_path), tmp_path / "none.las", "--json")
    assert result.exit_code == 1
    found = json.loads(result.stdout)
    assert [entry["clean"] for entry in found] == [True, False, False]
    assert "No such file" in found[2]["problems"][0]


def test_check_reports_directions_and_obeys_the_option(tmp_path):
    raw = make_raw(most_returns=1)
    raw.points["z_t"][::2] *= -1
    path = raw.write(tmp_path / "a.las")
    assert any("--direction" in line for line in check_file(path).problems)
    assert not any("is not clear" in line for line in check_file(path, direction="away").problems)


def test_descriptors_of_unlike_gains_are_named(tmp_path):
    """Half the amplitudes of a strip were twice as large as the others of the same ground in silence."""
    raw = make_raw()
    raw.points["wavepacket_index"][::2] += 1
    for gain, named in ((1.0, False), (-1.0, False), (1.0005, False), (2.0, True)):
        raw.vlrs = [descriptor(1), descriptor(2, gain=gain)]
        path = raw.write(tmp_path / f"{gain}.las")
        assert ("note: descriptors have gains of 1, 2 V per count" in run("check", path).stdout) == named
        done = run("run", path, "-o", tmp_path / "out", "--profile", "fast", "--overwrite")
        assert done.exit_code == 0 and ("amplitudes and energies are in counts of each" in done.stderr) == named
        done = run("voxelize", path, "--size", 1, "--iterations", 1, "-o", tmp_path / "v.npz", "--overwrite")
        assert done.exit_code == 0 and ("amplitudes and energies are in counts of each" in done.stderr) == named


def _swap_axes(points):
    points["X"], points["Y"] = points["Y"].copy(), points["X"].copy()


def _lift(points):
    points["Z"] += 300_000


@pytest.mark.quick_cases("_swap_axes-0.2")
@pytest.mark.parametrize(("change", "share"), [(_swap_axes, 0.2), (_lift, 1.0)])
def test_points_far_outside_the_bounds_of_the_header_are_named(tmp_path, tiny_strip, edit_points, change, share):
    """A stretch with swapped axes, or 300 m too high, was decomposed without a word."""

    def change_some(points):
        some = points[: int(share * len(points))].copy()
        change(some)
        points[: len(some)] = some

    path, out = edit_points(tiny_strip, tmp_path / "a.las", change_some), tmp_path / "out"
    done = run("run", path, "-o", out, "--profile", "fast", "--quiet")
    assert f"warning: {int(share * read_header(path).point_count)} points outside the bounds that the" in done.stderr
    assert "units" in [one["code"] for one in json.loads((out / "a.report.json").read_text())["warnings"]]
    assert run("check", path).exit_code == 1
    for command, target in (("export", "b.las"), ("slice", "a.csv"), ("voxelize", "a.npz")):
        more = ("--size", 50, "--iterations", 1) if command == "voxelize" else ()
        assert "outside the bounds" in run(command, path, "-o", tmp_path / target, *more).stderr, command


def test_bounds_that_are_off_by_little_or_in_another_unit_are_no_damage(tmp_path, tiny_strip):
    """Rounded to metres, of heights above another datum, missing, or Leica's: the stored integers."""
    header = read_header(tiny_strip)
    shift = np.array([0.9, 0.0, 0.9 * (header.maxs[2] - header.mins[2])])
    stored = [(np.array(ends) - header.offsets) / header.scales for ends in (header.mins, header.maxs)]
    for number, (low, high) in enumerate([(header.mins + shift, header.maxs + shift), (np.zeros(3), np.zeros(3)),
                                          (1000 * stored[0], 1000 * stored[1])]):  # fmt: skip
        content = bytearray(tiny_strip.read_bytes())
        content[179:227] = struct.pack("<6d", *np.column_stack([high, low]).ravel())
        path = tmp_path / f"{number}.las"
        path.write_bytes(content)
        assert read_header(path).mins == tuple(low)
        assert "outside the bounds" not in run("run", path, "-o", tmp_path, "--profile", "fast").stderr, number


def test_packets_longer_than_their_descriptor_are_named(tmp_path):
    """Half of every waveform was passed over in silence; words that are filled up are no samples."""
    for stated, bytes_more, named in ((16, 0, True), (32, 0, False), (32, 7, False), (32, 8, True)):
        raw = make_raw(n_samples=32)
        raw.vlrs = [descriptor(1, samples=stated)]
        raw.points["wavepacket_size"] += bytes_more
        path = raw.write(tmp_path / f"{stated}-{bytes_more}.las")
        done = run("run", path, "-o", tmp_path / "out", "--profile", "fast", "--overwrite", "-q")
        assert ("40 packets longer than the descriptor gives" in done.stderr) == named, (stated, bytes_more)
        assert run("run", path, "-o", tmp_path / "again", "--fail-on", "lost-samples").exit_code == 3 * named


def test_check_notes_do_no_harm_unless_strict(tmp_path):
    raw = make_raw()
    raw.vlrs = [descriptor(1, gain=0.0)]
    path = raw.write(tmp_path / "a.las")
    result = succeed("check", path)
    assert "note: descriptor 1 has gain 0" in result.stdout
    assert "note: counts by return in the header are wrong (return 1: 0, counted: 40)" in result.stdout
    assert run("check", path, "--strict").exit_code == 1


def test_check_takes_chain_files(tmp_path):
    good, bad, missing = tmp_path / "good.toml", tmp_path / "bad.toml", tmp_path / "none.toml"
    bad.write_text('[[chain]]\nstage = "detect.nothing"\n')
    stages = ("noise.pooled", "detect.maximum", "decompose.gaussian")
    good.write_text("".join(f'[[chain]]\nstage = "{stage}"\n' for stage in stages))
    assert "note: has no stage attribute.position, which `run` needs" in succeed("check", good).stdout
    assert "needs" in run("run", data_file(RIEGL), "-o", tmp_path / "o", "--chain", good).stderr
    good.write_text(good.read_text() + '[[chain]]\nstage = "attribute.position"\n')
    assert succeed("check", good).stdout == f"{good}: ok (4 stages)\n"
    result = run("check", bad)
    assert result.exit_code == 1
    assert len(result.stdout.splitlines()) == 1 and "detect.nothing" in result.stdout
    assert run("check", missing).exit_code == 1


def test_packets_of_another_strip_are_a_problem(tmp_path):
    """They fit by size; only the echoes show it. Own packets, of any sensor, match."""
    for scene in ("urban", "mixed"):
        run("simulate", scene, "-o", tmp_path / f"{scene}.las", "--pulses", 300, "--external", "-q")
    for name in ("urban", "mixed"):
        assert check_file(tmp_path / f"{name}.las").problems == ()
    (tmp_path / "mixed.wdp").replace(tmp_path / "urban.wdp")
    (problem,) = check_file(tmp_path / "urban.las").problems
    assert "urban.wdp belongs to another strip: in a sample of" in problem
    assert check_file(data_file(RIEGL)).problems == ()
