"""Export of strips: packets as the specification has them, and waveforms as arrays."""

import json

import numpy as np
import pytest
from commands import run_command
from naive_wdz import pack_strip

from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import check_file
from wavebatch.tools.export_strip import USER_ID, export_strip
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.strip import StripOptions


def _blocks(path):
    with StripReader(path) as reader, reader.scan() as scan:
        for block in reader.all_blocks(scan, 999):
            for row in range(len(block)):
                yield int(block.point[row]), (block.samples[row].tolist(), block.origin[row], block.direction[row])


def _same(one, other):
    ours, theirs = dict(_blocks(one)), dict(_blocks(other))
    assert ours.keys() <= theirs.keys() and len(ours) > 100
    for point, (samples, origin, direction) in ours.items():
        assert samples == theirs[point][0]
        assert np.allclose(origin, theirs[point][1], atol=1e-4) and np.allclose(direction, theirs[point][2], atol=1e-7)
    return len(ours)


@pytest.mark.parametrize("point_format", [4, 9])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_vectors_away_from_the_sensor_are_turned(tmp_path, point_format, suffix):
    options = StripOptions(toward=False, point_format=point_format, internal=True)
    simulate_strip("urban", tmp_path / "a.las", pulses=400, seed=3, options=options)
    found = export_strip(tmp_path / "a.las", tmp_path / f"b{suffix}")
    assert any("pointed away" in line for line in found.repaired) and found.points > 400
    assert _same(tmp_path / f"b{suffix}", tmp_path / "a.las") == found.waveforms
    checked = check_file(tmp_path / f"b{suffix}")
    assert not checked.problems and not checked.notes
    with StripReader(tmp_path / f"b{suffix}") as reader, reader.scan() as scan:
        assert scan.vectors.direction == "toward" and not reader.facts.packets.internal
        record = next(vlr for vlr in reader.facts.header.vlrs if vlr.user == USER_ID.decode())
        assert json.loads(record.payload)["repaired"] == list(found.repaired)


def test_compressed_and_damaged_packets_and_all_fields(riegl, tmp_path):
    for suffix in (".las", ".wdp"):
        (tmp_path / f"plain{suffix}").write_bytes(riegl.with_suffix(suffix).read_bytes())
    packed = pack_strip(tmp_path / "plain.las", tmp_path / "packed.las")
    wdz = packed.with_suffix(".wdz")
    wdz.write_bytes(wdz.read_bytes()[:-2000])
    found = export_strip(packed, tmp_path / "out.las")
    assert {"packets were compressed"} < set(found.repaired) and any("cannot be used" in x for x in found.repaired)
    assert _same(tmp_path / "out.las", riegl) == found.waveforms < 2375
    with StripReader(riegl) as old, StripReader(tmp_path / "out.las") as new:
        before, after = old.read_points(0, 2535), new.read_points(0, 2535)
        same = [name for name in before.dtype.names if not name.startswith("wavepacket") and name not in
                ("return_point_wave_location", "x_t", "y_t", "z_t")]  # fmt: skip
        assert all(np.array_equal(before[name], after[name]) for name in same)
        assert np.all(after["wavepacket_size"][after["wavepacket_index"] == 0] == 0)
        assert new.facts.crs == old.facts.crs
    assert check_file(tmp_path / "out.las").problems == ()


def test_arrays_hold_what_the_strip_holds(riegl, tmp_path):
    found = export_strip(riegl, tmp_path / "w.npz")
    with np.load(tmp_path / "w.npz") as arrays:
        values = dict(arrays)
    expected = dict(_blocks(riegl))
    assert len(values["point"]) == found.waveforms == len(expected) == 2375
    for row in range(0, 2375, 7):
        first, count = int(values["first"][row]), int(values["count"][row])
        samples, origin, direction = expected[int(values["point"][row])]
        assert values["samples"][first : first + count].tolist() == samples
        assert np.array_equal(values["origin"][row], origin) and np.array_equal(values["direction"][row], direction)
    assert len(values["return_point"]) == 2535 and values["return_waveform"].max() == 2374
    row = values["return_waveform"]
    place = values["origin"][row] + values["return_time"][:, None] * values["direction"][row]
    assert np.median(np.abs(place - values["return_xyz"])) < 0.001
    assert values["samples"].dtype == np.uint16 and json.loads(str(values["meta"]))["export"]["file"] == riegl.name
    assert "UTM" in str(values["crs"])


def test_several_strips_and_a_bad_one(tiny_strip, tmp_path):
    (tmp_path / "bad.las").write_bytes(b"LASF" + bytes(400))
    done = run_command("export", tiny_strip, tmp_path / "bad.las", "-o", tmp_path / "o")
    assert done.exit_code == 1 and done.stderr.count("error:") == 1
    assert sorted(path.suffix for path in (tmp_path / "o").iterdir()) == [".las", ".wdp"]
    again = run_command("export", tiny_strip, "-o", tmp_path / "o")
    assert again.exit_code == 1 and "exists already" in again.stderr
