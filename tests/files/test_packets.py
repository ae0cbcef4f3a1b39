"""Packets: which can be used, which way vectors point, whose packets they are; strips of damaged bytes."""

import itertools
import json
import random
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from commands import refuses, run_command, succeed
from hypothesis import given
from hypothesis import strategies as st
from strips import TOWARD, assert_same, descriptor, make_raw, read_all, read_plainly, record_head, refused, vlr
from writer_tools import data_file

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.strip.packet_check import DirectionTally, decide_direction, is_strange
from wavebatch.files.strip.packets import PacketFile, PacketPlace
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.scanner import ScanSizes


def plain_of(raw, bits=8, samples=32):
    return read_plainly(raw.points, bytes(60) + raw.packets, {1: (bits, samples)})


def assert_read(path, raw, **options):
    assert_same(read_all(path, **options), plain_of(raw))


def test_upper_case_wdp_is_found(tmp_path):
    raw = make_raw(internal=False)
    path = raw.write(tmp_path / "a.las")
    path.with_suffix(".wdp").rename(tmp_path / "a.WDP")
    assert_read(path, raw)


@pytest.mark.parametrize(
    ("made", "head", "start", "said"),
    [
        ({"internal": False}, record_head(0, reserved=0xAABB), None, ""),
        ({"internal": False}, record_head(0), None, ""),
        ({"internal": False}, record_head(0, user=b"LAS_Spec"), None, ""),
        ({"internal": False}, record_head(2**63), None, "claims 9223372036854775808 bytes"),
        ({"point_format": 9}, None, 0, "found as an EVLR"),
        ({}, record_head(100, user=b"LAS_Spec", reserved=0xAABB), None, "claims 100 bytes, 1280 are there"),
    ],
    ids=["as RIEGL", "no length", "another user", "a length that lies", "a lost pointer", "a length that is too small"],
)
def test_packets_are_read_behind_headers_of_the_field(tmp_path, made, head, start, said):
    """To the end of the file, whatever length they claim, which is said."""
    raw = make_raw(**made)
    raw.head, raw.waveform_start = head, start
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        warnings = reader.facts.warnings
    assert said in warnings[0] if said else warnings == ()


def test_lastools_cross_check_block_is_skipped_by_the_offsets(tmp_path):
    raw = make_raw(internal=False, first_offset=92)
    block = b"LAStools waveform 1" + bytes(3) + struct.pack("<HHBBH", 1, 1, 0, 8, 32)
    raw.packets = block.ljust(32, b"\0") + raw.packets[32:]
    raw.head = record_head(0, reserved=0xAABB)
    assert_read(raw.write(tmp_path / "a.las"), raw)


def test_headerless_wdp_is_refused_unless_forced(tmp_path):
    raw = make_raw(internal=False)
    raw.head = b""
    path = raw.write(tmp_path / "a.las")
    refused(path, "does not begin with the 60-byte header.*--headerless")
    assert_read(path, raw, headerless=True)
    with StripReader(path, headerless=True) as reader:
        assert (reader.facts.packets.base, reader.facts.packets.start) == (-60, 0)
    raw.head = None
    assert_read(raw.write(tmp_path / "good.las"), raw, headerless=True)


def test_headerless_wdp_whose_offsets_count_from_zero(tmp_path):
    raw = make_raw(internal=False)
    raw.head = b""
    raw.points["wavepacket_offset"] -= 60
    path = raw.write(tmp_path / "a.las")
    found = read_all(path, headerless=True)
    plain = read_plainly(raw.points, raw.packets, {1: (8, 32)})
    assert found.keys() == plain.keys()
    assert all((found[key][0] == plain[key][0]).all() for key in plain)


def test_compression_of_a_descriptor_that_nobody_uses_does_no_harm(tmp_path):
    raw = make_raw()
    raw.vlrs.append(descriptor(2, compression=1))
    assert_read(raw.write(tmp_path / "a.las"), raw)


@pytest.mark.parametrize(("encoding", "given"), [(0, "no place"), (6, "two places")])
def test_neither_or_both_places_fall_back_and_say_so(tmp_path, encoding, given):
    raw = make_raw()
    raw.encoding = encoding
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert f"gives {given} of the packets" in reader.facts.warnings[0]
        assert "read from the record in the file" in reader.facts.warnings[0]
    raw = make_raw(internal=False)
    raw.encoding = encoding
    path = raw.write(tmp_path / "b.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert "read from b.wdp" in reader.facts.warnings[0]
    path.with_suffix(".wdp").unlink()
    refused(path, "neither in the file nor next to it: put b.wdp")


def test_packets_in_the_file_are_read_where_the_header_says_wdp(tmp_path):
    raw = make_raw(point_format=9)
    raw.encoding = 4
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        (line,) = reader.facts.warnings
    assert "gives a wrong place of the packets" in line and "read from the record in the file" in line


def test_records_behind_the_packets_are_no_packets(tmp_path):
    raw = make_raw(point_format=9, most_returns=1)
    raw.behind = record_head(500, user=b"other", record_id=7) + bytes(500)
    path = raw.write(tmp_path / "a.las")
    data = bytearray(path.read_bytes())
    data[243:247] = struct.pack("<I", 2)
    path.write_bytes(data)
    with StripReader(path) as reader:
        facts = reader.facts
        assert facts.packets.end - facts.packets.start == len(raw.packets)
        assert facts.warnings == ()
    assert_read(path, raw)


COMPRESSED = [descriptor(1, compression=2)]


@pytest.mark.parametrize(("changes", "said"), [
    ({"internal": False, "wdp": None}, "packets are missing: put a.wdp next to the strip"),
    ({"internal": False, "wdp": "folder"}, "packets are missing: a.wdp is no file"),
    ({"internal": False, "wdp": b""}, "does not begin with"),
    ({"vlrs": COMPRESSED}, "compressed.*laszip -i a.las"),
    ({"vlrs": [*COMPRESSED, descriptor(2)]}, "compressed.*laszip -i a.las"),
    ({"vlrs": [descriptor(1), vlr(b"lascompatible", 22204, bytes(156))]}, "compatibility mode"),
    # Of 32 bytes, but 32 samples of 12 bits have 48 or 64.
    ({"vlrs": [descriptor(1, bits=12, samples=32)]},
     "no packet can be used.*neither whole bytes nor packed samples.*with 8, 16 or 32 bits"),
    *(({"waveform_start": start}, "record") for start in (1, 300, 10**6, 2**63, 2**64 - 1)),
    ({"head": record_head(0, record_id=1234)}, "no waveform record at byte"),
])  # fmt: skip
def test_packets_that_cannot_be_read_are_refused(tmp_path, changes, said):
    raw = make_raw(internal=changes.get("internal", True))
    for name, value in changes.items():
        setattr(raw, name, value)
    path = raw.write(tmp_path / "a.las")
    beside = path.with_suffix(".wdp")
    if changes.get("wdp") == b"":
        beside.write_bytes(b"")
    elif "wdp" in changes:
        beside.unlink()
        if changes["wdp"]:
            beside.mkdir()
    refused(path, said)


def test_descriptor_oddities_are_told(tmp_path):
    raw = make_raw()
    raw.vlrs += [descriptor(1, samples=8), vlr(b"LASF_Spec", 101, b"short"), descriptor(255)]
    raw.vlrs.append(vlr(b"Other", 100, bytes(26)))
    with StripReader(raw.write(tmp_path / "a.las")) as reader:
        assert sorted(reader.facts.digitizers) == [1, 255]
        assert reader.facts.digitizers[1].n_samples == 32
        assert [text.split(" ")[1] for text in reader.facts.warnings] == ["1", "2"]


@pytest.mark.parametrize("value", [1e300, -1e300, np.inf, np.nan])
@pytest.mark.parametrize("name", ["gain", "offset"])
def test_volts_that_no_digitizer_has_are_told_and_count_as_not_given(tmp_path, name, value):
    raw = make_raw()
    raw.vlrs = [descriptor(1, **{"gain": 0.01, "offset": -0.5, name: value})]
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        digitizer = reader.facts.digitizers[1]
        assert {"gain": digitizer.gain, "offset": digitizer.offset} == {"gain": 0.01, "offset": -0.5, name: 0.0}
        (warning,) = reader.facts.warnings
        assert warning.startswith(f"descriptor 1 has {name} {value:g} V")


def test_the_truncated_leica_file_gets_one_line():
    refused(data_file("no-packets/simple1_3.las"), "no packet can be used: 999 of 999 points")


def _packet_file(tmp_path, size, seed=0, **sizes):
    data = np.random.default_rng(seed).integers(0, 256, size, dtype=np.uint8)
    path = tmp_path / "p.wdp"
    path.write_bytes(data.tobytes())
    return PacketFile(PacketPlace(path, False, 0, 0, size), **sizes), data


@pytest.mark.parametrize("kind", ["contiguous", "shuffled", "repeated", "sparse", "overlapping", "one", "none"])
def test_every_pattern_of_offsets_fetches_the_same_bytes(tmp_path, kind):
    file, data = _packet_file(tmp_path, 100_000, span=1000, gap=200)
    rng = np.random.default_rng(1)
    offsets = {
        "contiguous": np.arange(60, 6000, 20),
        "shuffled": rng.permutation(np.arange(60, 6000, 20)),
        "repeated": np.repeat(np.arange(60, 6000, 20), 3),
        "sparse": rng.integers(0, 99_900, 40),
        "overlapping": np.arange(100, 400, 3),
        "one": np.array([99_980]),
        "none": np.array([], int),
    }[kind].astype(np.uint64)
    samples = file.read(offsets, 10, 16)
    expected = [data[int(at) : int(at) + 20].view("<u2") for at in offsets]
    np.testing.assert_array_equal(samples, np.array(expected, "<u2").reshape(-1, 10))
    assert samples.dtype == "<u2" and not samples.flags.writeable
    file.close()


def test_sparse_packets_do_not_read_what_lies_between(tmp_path):
    """By the bytes that the process reads, as the system counts them."""
    file, _ = _packet_file(tmp_path, 1_000_000, span=1000)
    before = _bytes_read()
    file.read(np.arange(0, 1_000_000, 50_000, dtype=np.uint64), 20, 8)
    assert 20 * 20 <= _bytes_read() - before < 5000
    file.close()


def _bytes_read():
    """By this process so far, with those of this function."""
    with open("/proc/self/io") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("rchar"))


SCENES = {"forest": (), "urban": (), "slope": (), "canopy.gemini-24": (), "empty": ("--noise", "15")}
REAL = (
    "riegl-q680i/100429_152240_2535pt_UTM", "geolas/geolas1", "lvis/lvis1", "neon/neon_harv_a", "optech/optech_a",
)  # fmt: skip


def find_stranger(strip: Path) -> str:
    with StripReader(strip) as reader, reader.scan(tolerant=True) as scan:
        return scan.stranger


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """A strip of each scene, of one sensor, with packets beside it."""
    folder = tmp_path_factory.mktemp("strips")
    made = {scene: folder / f"{scene}.las" for scene in SCENES}
    for seed, (scene, path) in enumerate(made.items()):
        options = ["--pulses", "600", "--external", "-q", "--seed", str(seed), *SCENES[scene]]
        assert run_command("simulate", scene, "-o", path, *options).exit_code == 0
    return made


def swap(points: Path, packets: Path, folder: Path) -> Path:
    shutil.copy(points, folder / "s.las")
    shutil.copy(packets.with_suffix(".wdp"), folder / "s.wdp")
    return folder / "s.las"


def test_packets_of_another_strip_of_the_sensor_are_known(strips, tmp_path):
    names = [name for name in strips if name != "empty"]
    for points, other in itertools.product(names, names):
        strip = swap(strips[points], strips[other], tmp_path)
        assert bool(find_stranger(strip)) == (points != other), (points, other)
    strip = swap(strips["forest"], strips["urban"], tmp_path)
    with pytest.raises(InputError, match=r"s\.wdp belongs to another strip: .*--force"), StripReader(strip) as reader:
        reader.scan()
    with StripReader(strip) as reader, reader.scan(force=True) as scan:
        assert scan.stranger and not scan.problems


def test_packets_of_another_sensor_are_known(tmp_path):
    files = {name: data_file(f"{name}.las") for name in REAL}
    for points, other in itertools.product(REAL, REAL):
        strip = swap(files[points], files[other], tmp_path)
        assert bool(find_stranger(strip)) == (points != other), (points, other)


def change(points: np.ndarray, how: str) -> np.ndarray:
    locations = points["return_point_wave_location"]
    if how == "zero":
        locations[:] = 0
    elif how == "nanoseconds":
        locations[:] = locations / 1000
    elif how == "shifted":
        locations[:] = locations + 20_000
    elif how == "random, but as strong":
        locations[:] = np.random.default_rng(0).uniform(0, 60_000, len(points))
    elif how == "without intensity":
        points["intensity"] = 0
    elif how == "nothing to go by":
        points["intensity"], locations[:] = 0, 30_000
    return points


@pytest.mark.parametrize("how", [
    "as it is", "zero", "nanoseconds", "shifted", "random, but as strong", "without intensity", "nothing to go by",
])  # fmt: skip
def test_own_packets_are_never_refused(strips, tmp_path, edit_points, how):
    for name, path in strips.items():
        if name == "empty" and how.startswith("random"):
            continue  # no witness is left: noise hides how strong the echoes are
        strip = edit_points(path, tmp_path / f"{name}.las", lambda points: change(points, how))
        shutil.copy(path.with_suffix(".wdp"), strip.with_suffix(".wdp"))
        assert not find_stranger(strip), name


def test_own_packets_of_the_weakest_returns_alone_are_not_refused(strips, tmp_path, edit_points):
    """Only the ground of a high canopy, say: its echoes are the lowest of their packets."""

    def weaken(points):
        order = np.lexsort((points["intensity"], points["wavepacket_offset"]))
        weakest = order[np.unique(points["wavepacket_offset"][order], return_index=True)[1]]
        others = np.setdiff1d(np.arange(len(points)), weakest)
        points["wavepacket_index"][others] = points["wavepacket_size"][others] = 0

    for name in ("forest", "canopy.gemini-24"):
        strip = edit_points(strips[name], tmp_path / f"{name}.las", weaken)
        shutil.copy(strips[name].with_suffix(".wdp"), strip.with_suffix(".wdp"))
        assert not find_stranger(strip), name


def test_few_packets_prove_nothing(strips, tmp_path, edit_points):
    def keep_few(points):
        points["wavepacket_size"][40:] = 0

    strip = edit_points(strips["forest"], tmp_path / "few.las", keep_few)
    shutil.copy(strips["urban"].with_suffix(".wdp"), strip.with_suffix(".wdp"))
    assert not find_stranger(strip)


@pytest.mark.parametrize(("location", "intensity"), [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
def test_any_tie_of_returns_to_packets_makes_them_own(rng, location, intensity):
    """Also one that is upside down."""
    height, where = rng.uniform(50, 100, 300), rng.uniform(0, 50, 300)
    place = location * where if location else rng.uniform(0, 50, 300)
    light = intensity * height if intensity else rng.uniform(0, 50, 300)
    table = np.column_stack([height, where, place, light, *rng.uniform(0.1, 0.5, (2, 300)), *np.ones((2, 300))])
    assert is_strange(table) == (not location and not intensity)


@pytest.mark.quick_cases("urban")
@pytest.mark.parametrize("scene", ["forest", "urban", "slope", "canopy.gemini-24"])
def test_packets_of_a_stretch_that_are_not_theirs_are_named(strips, tmp_path, scene):
    """A part of a .wdp that was written twice, or without one packet: 14 % of a strip were wrong without a word."""
    strip = swap(strips[scene], strips[scene], tmp_path)
    assert not scan_of(strip).doubts
    content = (tmp_path / "s.wdp").read_bytes()
    with StripReader(strip) as reader, reader.scan() as scan:
        points = reader.read_points(0, scan.points)
    first, last = (int(points["wavepacket_offset"][int(share * len(points))]) for share in (0.4, 0.7))
    size = int(points["wavepacket_size"].max())
    moved = content[first + size : last] + content[first : first + size]
    (tmp_path / "s.wdp").write_bytes(content[:first] + moved + content[last:])
    scan = scan_of(strip)
    (line,) = scan.doubts
    low, high = map(int, re.search(r"s\.wdp: packets of points around (\d+) to (\d+) are not theirs", line).groups())
    assert 0.3 * len(points) < low < 0.5 * len(points) and 0.6 * len(points) < high < 0.8 * len(points)
    assert not scan.stranger and line in scan.warnings
    for command, target in (("run", "out"), ("export", "a.las"), ("slice", "a.csv"), ("voxelize", "a.npz")):
        more = ["--size", "5", "--iterations", "1"] if command == "voxelize" else ["-q"]
        assert "are not theirs" in succeed(command, strip, "-o", tmp_path / target, *more).stderr
    report = json.loads((tmp_path / "out" / "s.report.json").read_text())
    assert "foreign-packets" in [one["code"] for one in report["warnings"]]


def scan_of(path, **options):
    with StripReader(path, **options) as reader, reader.scan() as scan:
        return scan


def test_stretches_apart_are_named_one_by_one(strips, tmp_path):
    """From the first to the last one were named: the packets between them are right."""
    strip = swap(strips["forest"], strips["forest"], tmp_path)
    content = bytearray((tmp_path / "s.wdp").read_bytes())
    with StripReader(strip) as reader, reader.scan() as scan:
        points = reader.read_points(0, scan.points)
    size = int(points["wavepacket_size"].max())
    for share in (0.1, 0.6):
        first, last = (int(points["wavepacket_offset"][int(part * len(points))]) for part in (share, share + 0.25))
        content[first:last] = content[first + 5 * size : last] + content[first : first + 5 * size]
    (tmp_path / "s.wdp").write_bytes(content)
    (line,) = scan_of(strip).doubts
    low, high, again, end = (int(found) / len(points) for found in re.search(
        r"around (\d+) to (\d+), (\d+) to (\d+) are not theirs", line).groups())  # fmt: skip
    assert 0.05 < low < 0.2 < high < 0.4 and 0.55 < again < 0.7 < end < 0.9


@pytest.mark.parametrize("toward", [True, False])
@pytest.mark.parametrize("most_returns", [1, 3])
def test_either_sign_gives_the_same_rays(tmp_path, toward, most_returns):
    raw = make_raw(toward=toward, most_returns=most_returns)
    path = raw.write(tmp_path / "a.las")
    scan = scan_of(path)
    assert scan.vectors.direction == ("toward" if toward else "away")
    assert scan.vectors.ratio == pytest.approx(np.linalg.norm(TOWARD) * 1000 / 0.149896229)
    assert scan.warnings == ()
    for _, _, origin, direction in read_all(path).values():
        assert origin[2] == pytest.approx(500, abs=2e-3)
        np.testing.assert_allclose(direction, -1000 * TOWARD, rtol=1e-6)


def test_witnesses_that_contradict_each_other_are_refused_unless_overridden(tmp_path):
    """The pulses go up: shared packets say toward, heights say away."""
    raw = make_raw()
    raw.scales = (0.001, 0.001, -0.001)
    turn_z = raw.points["z_t"]
    turn_z *= -1
    path = raw.write(tmp_path / "a.las")
    refuses(InputError, r"a\.las: packet vectors contradict each other: .*pass --direction", scan_of, path)
    scan = scan_of(path, direction="toward")
    assert (scan.vectors.direction, scan.problems) == ("toward", ())
    assert "--direction toward overrides" in scan.warnings[0]
    assert scan_of(path, direction="away").vectors.direction == "away"


@pytest.mark.parametrize("units", [None, 7])
def test_points_that_are_stored_twice_are_named(tmp_path, units):
    """Their copies were written as returns without an echo, and no line said it."""
    raw = make_raw()
    path = raw.write(tmp_path / "a.las")
    assert not any("stored twice" in line for line in scan_of(path).warnings)
    rows = np.sort(np.r_[np.arange(len(raw.points)), np.arange(0, len(raw.points), 10)])
    pairs = len(rows) - 40
    raw.points = raw.points[rows]
    with StripReader(raw.write(tmp_path / "b.las"), unit_points=units) as reader:
        warnings = reader.scan().warnings
    said = f"of {pairs} pairs of points with one packet that were looked at, {pairs - len(set(rows)) + 40} have one"
    assert any(line.startswith(said) for line in warnings), warnings


@pytest.mark.parametrize(("pairs", "problems"), [(2, 0), (3, 1)])
def test_fewer_than_three_pairs_do_not_contradict_heights(pairs, problems):
    tally = DirectionTally("stored", pairs=[0, pairs], heights=[50, 0], ratios=[np.ones(50)])
    found = decide_direction(tally, "auto")
    assert len(found.problems) == problems and (problems or found.direction == "toward")


def test_vectors_that_say_nothing_are_refused_unless_overridden(tmp_path):
    raw = make_raw(most_returns=1)
    raw.points["z_t"][::2] *= -1
    path = raw.write(tmp_path / "a.las")
    refuses(InputError, "is not clear.*--direction toward or away", scan_of, path)
    assert scan_of(path, direction="away").vectors.direction == "away"


def test_a_given_direction_that_the_file_denies_is_used_and_said(tmp_path):
    path = make_raw().write(tmp_path / "a.las")
    scan = scan_of(path, direction="away")
    assert scan.vectors.direction == "away"
    assert "overrides the evidence of the file" in scan.warnings[0]
    assert scan_of(path, direction="toward").warnings == ()


def test_an_unknown_direction_is_a_config_error(tmp_path):
    refuses(ConfigError, "'up'.*auto, toward, away", StripReader, make_raw().write(tmp_path / "a.las"), direction="up")


@pytest.mark.parametrize("factor", [0.5, 0.965, 1.1, 30.0])
def test_odd_lengths_are_used_as_stored_and_said(tmp_path, factor):
    raw = make_raw(most_returns=1)
    for name in ("x_t", "y_t", "z_t"):
        raw.points[name] *= np.float32(factor)
    path = raw.write(tmp_path / "a.las")
    scan = scan_of(path)
    assert scan.vectors.form == "stored"
    # Yellowscan's are 3.5 % short.
    said = "times c/2 long (usual: 0.96 to 1.00), as unit vectors are"
    assert said in scan.warnings[0] if factor != 0.965 else scan.warnings == ()
    assert list(scan.doubts.values()) == ["units"] * (factor != 0.965)
    direction = next(iter(read_all(path).values()))[3]
    np.testing.assert_allclose(direction, -1000 * TOWARD * factor, rtol=1e-5)


@pytest.mark.parametrize(("spacing", "said"), [(1, "0.001 ns apart"), (250, ""), (10**6, "1000 ns apart")])
def test_a_spacing_in_another_unit_than_picoseconds_is_said(tmp_path, spacing, said):
    raw = make_raw()
    raw.vlrs = [descriptor(1, samples=32, spacing=spacing)]
    doubts = scan_of(raw.write(tmp_path / "a.las")).doubts
    assert list(doubts.values()) == ["units"] * bool(said) and all(said in line for line in doubts)


@pytest.mark.parametrize(("divisor", "code"), [(1, []), (2, ["lost-samples"]), (4, [])])
def test_sizes_in_samples_are_said(tmp_path, divisor, code):
    """Half of each waveform was not read, and --quiet hid it. Recordings of half of the longest length are sound."""
    raw = make_raw(bits=16)
    raw.points["wavepacket_size"] //= divisor
    assert list(scan_of(raw.write(tmp_path / "a.las")).doubts.values()) == code
    raw.points["wavepacket_offset"] //= divisor
    assert "lost-samples" not in scan_of(raw.write(tmp_path / "b.las")).doubts.values()  # a quarter is in mid sample


@pytest.mark.parametrize("time", [0.0, np.nan, 7.0, None])
def test_packets_of_one_ray_that_no_time_ties_are_said(tmp_path, time):
    """With a packet for each return, each echo was written once per packet, in silence."""
    raw = make_raw(200)
    raw.packets *= 3
    size, number = len(raw.packets) // 3, raw.points["bit_fields"].astype(np.uint64) - np.uint64(1)
    raw.points["wavepacket_offset"] += number * np.uint64(size)
    if time is not None:
        raw.points["gps_time"] = time
    doubts = scan_of(raw.write(tmp_path / "a.las")).doubts
    assert list(doubts.values()) == ["repeated"] * (time is not None)
    copies = np.count_nonzero(number[: -64])
    assert time is None or next(iter(doubts)).startswith(f"{copies} of {len(number) - 64} points that were looked at")


@pytest.mark.parametrize("most_returns", [1, 3])
def test_vectors_as_long_as_the_path_are_divided_by_minus_the_location(tmp_path, most_returns):
    raw = make_raw(most_returns=most_returns)
    for name in ("x_t", "y_t", "z_t"):
        raw.points[name] *= -raw.points["return_point_wave_location"]
    path = raw.write(tmp_path / "a.las")
    scan = scan_of(path)
    assert (scan.vectors.form, scan.vectors.direction) == ("range", "toward")
    assert scan.vectors.ratio == pytest.approx(0.9997, abs=0.01)
    assert "divided by minus the return location" in scan.warnings[0]
    for _, _, origin, direction in read_all(path).values():
        assert origin[2] == pytest.approx(500, abs=2e-3)
        np.testing.assert_allclose(direction, -1000 * TOWARD, rtol=1e-5)


@pytest.mark.parametrize(("packets", "most_returns", "direction"), [(60, 3, "away"), (300, 2, "toward")])
def test_returns_of_a_packet_vote_where_heights_say_nothing(tmp_path, packets, most_returns, direction):
    """Also where they meet only far apart: no two returns of a packet lie in one unit or window."""
    raw = make_raw(packets, most_returns=most_returns)
    pulse = np.round((raw.points["gps_time"] - 1000) * 1e5).astype(int)
    start = np.stack([pulse * 0.5, 0 * pulse, 0 * pulse + 500.0], axis=1)
    vector = np.where((pulse % 2 == 0)[:, None], TOWARD, -TOWARD)
    xyz = start - raw.points["return_point_wave_location"][:, None].astype(float) * vector
    for axis, name in enumerate("XYZ"):
        raw.points[name] = np.rint(xyz[:, axis] / 0.001)
        raw.points[("x_t", "y_t", "z_t")[axis]] = vector[:, axis] * (1 if direction == "toward" else -1)
    if direction == "toward":
        raw.points = raw.points[np.argsort(raw.points["bit_fields"], kind="stable")]
    assert scan_of(raw.write(tmp_path / "a.las"), sizes=ScanSizes(window=64)).vectors.direction == direction


@given(st.lists(st.tuples(st.integers(0, 39), st.integers(0, 28), st.binary(min_size=1, max_size=8)), max_size=20))
def test_points_may_say_anything_about_their_packets(tmp_path, damage):
    """Packet fields of points are overwritten at will: whatever they say, all other points keep their samples."""
    raw = make_raw(40, most_returns=1)
    table = raw.points.view(np.uint8).reshape(40, 57)
    for row, at, data in damage:
        piece = np.frombuffer(data, np.uint8)[: 57 - 28 - at]
        table[row, 28 + at : 28 + at + len(piece)] = piece
    touched = {row for row, _, _ in damage}
    path = raw.write(tmp_path / "a.las")
    with StripReader(path, direction="toward") as reader:
        try:
            scan = reader.scan()
        except InputError as error:
            assert len(touched) > 15, error
            return
        unit = reader.read_unit(0, scan)
        assert not unit.point_flags[sorted(set(range(40)) - touched)].any()
        seen = np.concatenate([np.empty(0, int), *(block.point for block, _ in reader.read_blocks(unit, 100, True))])
        assert len(seen) == len(set(seen.tolist())) == scan.packets


@pytest.mark.quick_cases("10-.laz")
@pytest.mark.parametrize(("point_format", "suffix"), [(4, ".las"), (10, ".laz"), (9, ".las")])
def test_geometry_of_damaged_strips_is_finite(tmp_path, point_format, suffix):
    """What the fuzzer does not see: rays and returns of every packet that is still read."""
    rng = random.Random(point_format)
    path = make_raw(30, point_format=point_format, internal=point_format != 9).write(tmp_path / f"a{suffix}")
    whole, read = path.read_bytes(), 0
    for _ in range(80):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 2, 5, 20])):
            at, width = rng.randrange(len(data)), rng.choice([1, 2, 4, 8])
            data[at : at + width] = rng.choice([b"\xff" * width, bytes(width), rng.randbytes(width)])
        path.write_bytes(data)
        try:
            with StripReader(path) as reader, reader.scan() as scan:
                for number in range(reader.unit_count()):
                    for block, _ in reader.read_blocks(reader.read_unit(number, scan), 64, True):
                        read += len(block)
                        for values in (block.origin, block.direction, block.returns.time):
                            assert np.isfinite(values).all()
        except InputError as error:
            assert "\n" not in str(error)
    assert read > 300
