"""Units, blocks and samples of strips, and the scan of a strip in parts."""

import dataclasses
import itertools
import os
import pickle

import numpy as np
import pytest
from commands import refuses
from strips import assert_same, descriptor, make_raw, read_all, read_plainly
from writer_tools import data_file, read_raw

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.publish import protecting, refuse_input
from wavebatch.files.disk.temp_store import Spool
from wavebatch.files.strip import scanner
from wavebatch.files.strip.packet_check import Reason
from wavebatch.files.strip.reader import LONG_SAMPLES, StripReader
from wavebatch.files.strip.scanner import ScanSizes
from wavebatch.tools.simulate import simulate_strip

RIEGL = "riegl-q680i/100429_152240_2535pt_UTM.las"
LEICA = "leica-als/simple1_3_full_internal.las"


@pytest.mark.parametrize(("declared", "bits"), [(5, 8), (10, 16), (12, 16), (24, 32)])
def test_samples_of_odd_bits_in_whole_bytes_are_read(tmp_path, declared, bits):
    """The packet's size tells them from packed ones; counts may use more bits than the descriptor says."""
    raw = make_raw(bits=bits)
    plain = read_plainly(raw.points, bytes(60) + raw.packets, {1: (bits, 32)})
    raw.vlrs = [descriptor(1, bits=declared, samples=32)]
    path = raw.write(tmp_path / "a.las")
    assert_same(read_all(path), plain)
    with StripReader(path) as reader, reader.scan() as scan:
        blocks = list(reader.sample_blocks(scan, 10))
    assert {block.digitizer.bits for block in blocks} == {bits}


@pytest.mark.parametrize(("point_format", "minor"), [(4, 3), (4, 4), (5, 3), (5, 4), (9, 4), (9, 5), (10, 4)])
@pytest.mark.parametrize("internal", [True, False])
@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_every_kind_of_strip_gives_the_samples_in_its_bytes(tmp_path, point_format, minor, internal, bits, suffix):
    raw = make_raw(point_format=point_format, minor=minor, internal=internal, bits=bits)
    path = raw.write(tmp_path / f"a{suffix}")
    assert_same(read_all(path), read_plainly(raw.points, bytes(60) + raw.packets, {1: (bits, 32)}))


@pytest.mark.parametrize(("name", "packets"), [(RIEGL, 2375), (LEICA, 999)])
@pytest.mark.parametrize("unit_points", [50_000, 100])
def test_real_files_give_every_packet_once(name, packets, unit_points):
    path = data_file(name)
    points = read_raw(path)
    with StripReader(path, unit_points=unit_points) as reader:
        facts = reader.facts
        kinds = {i: (d.bits, d.n_samples) for i, d in facts.digitizers.items()}
        data = facts.packets.file.read_bytes()[facts.packets.base :]
        with reader.scan() as scan:
            assert scan.packets == packets
            assert scan.with_waveform == len(points)
            assert scan.vectors.direction == "toward"
            assert abs(scan.vectors.ratio - 0.9997) < 2e-4
    assert_same(read_all(path, size=100, unit_points=unit_points), read_plainly(points, data, kinds))


def _shuffled(tmp_path, points, order):
    source = data_file(RIEGL)
    with StripReader(source) as reader:
        start = source.read_bytes()[: source.stat().st_size - points.nbytes]
        wdp = reader.facts.packets.file.read_bytes()
    path = tmp_path / "s.las"
    path.write_bytes(start + points[order].tobytes())
    path.with_suffix(".wdp").write_bytes(wdp)
    return path


@pytest.mark.quick_cases("random-300", "halves-64")
@pytest.mark.parametrize("window", [16_384, 300, 64])
@pytest.mark.parametrize("order", ["reversed", "by return", "random", "halves"])
def test_packets_and_returns_do_not_depend_on_the_order_of_points(tmp_path, order, window):
    """Far sharing goes through the disk; the window is made so small that it must."""
    points = read_raw(data_file(RIEGL))
    orders = {
        "reversed": np.arange(len(points))[::-1],
        "by return": np.argsort(points["bit_fields"] & 15, kind="stable"),
        "random": np.random.default_rng(3).permutation(len(points)),
        "halves": np.argsort(np.arange(len(points)) % 2, kind="stable"),
    }
    path = _shuffled(tmp_path, points, orders[order])
    kinds = {1: (16, 60), 2: (16, 120)}
    plain = read_plainly(points[orders[order]], path.with_suffix(".wdp").read_bytes(), kinds)
    small = {"unit_points": 128, "sizes": ScanSizes(window=window, bins=64, keys=500, spooled=100)}
    assert_same(read_all(path, size=50, **small), plain)
    assert_same(read_all(path, size=50, owned_only=False, **small), plain)
    with StripReader(path, **small) as reader, reader.scan() as scan:
        assert (scan.packets, scan.with_waveform) == (2375, 2535)
        spans = [members[-1] - members[0] for _, members in plain.values()]
        assert scan.reach == max(spans)
        assert scan.vectors.direction == "toward"
        spooled = scan.context.path
        assert spooled.exists()
    assert not spooled.exists()


def test_units_take_every_point_once_and_cut_no_pulse(tmp_path):
    raw = make_raw(400)
    with StripReader(raw.write(tmp_path / "a.las"), unit_points=64) as reader, reader.scan() as scan:
        units = [reader.read_unit(number, scan) for number in range(reader.unit_count())]
        assert np.concatenate([unit.points for unit in units]).tobytes() == raw.points.tobytes()
        assert [unit.start for unit in units] == scan.borders[:-1].tolist()
        for before, after in zip(units[:-1], units[1:], strict=True):
            assert before.points["gps_time"][-1] != after.points["gps_time"][0]
        assert any(unit.start % 64 for unit in units)
        assert sum(int(unit.packets.owned.sum()) for unit in units) == 400


def test_a_border_cuts_runs_that_are_not_pulses(tmp_path):
    raw = make_raw(100)
    raw.points["gps_time"] = 0
    with StripReader(raw.write(tmp_path / "a.las"), unit_points=64) as reader, reader.scan() as scan:
        assert scan.borders[:-1].tolist() == list(range(0, len(raw.points), 64))
    assert len(read_all(tmp_path / "a.las", unit_points=64)) == 100


@pytest.mark.parametrize(("length", "border"), [(63, 95), (64, 64)])
def test_a_run_of_63_points_may_be_a_pulse(tmp_path, length, border):
    raw = make_raw(100, most_returns=1)
    raw.points["gps_time"] = np.arange(100)
    raw.points["gps_time"][32 : 32 + length] = 32
    with StripReader(raw.write(tmp_path / "a.las"), unit_points=64) as reader, reader.scan() as scan:
        assert scan.borders.tolist() == [0, border, 100]


def test_unusable_packets_are_flagged_and_the_rest_is_read(tmp_path):
    raw = make_raw(40, most_returns=1)
    p = raw.points
    end = 60 + len(raw.packets)
    p["wavepacket_index"][0] = 0
    p["wavepacket_size"][1] = 0
    p["wavepacket_offset"][2] = end - 31
    p["wavepacket_offset"][3] = 59
    p["wavepacket_offset"][4] = 2**64 - 10
    p["wavepacket_offset"][5] = 2**63 + 60
    p["wavepacket_index"][6] = 2
    p["return_point_wave_location"][7] = np.nan
    p["x_t"][8] = np.inf
    p["x_t"][9] = p["y_t"][9] = p["z_t"][9] = 0
    p["wavepacket_index"][10] = 3
    raw.vlrs.append(descriptor(3, samples=0, spacing=0))
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        unit = reader.read_unit(0, scan)
        expected = [EchoFlag.NO_WAVEFORM] * 2 + [EchoFlag.BROKEN_PACKET] * 9 + [0] * 29
        assert unit.point_flags.tolist() == [int(flag) for flag in expected]
        assert unit.packet_of_point.tolist() == [-1] * 11 + list(range(29))
        assert (scan.with_waveform, scan.without_waveform, scan.broken) == (29, 2, 9)
        assert scan.packets == 29
        assert sum(count for count, _ in scan.reasons.values()) == 9
        assert len(scan.warnings) == 5
        assert [len(block) for block, _ in reader.read_blocks(unit, 100, True)] == [29]


def test_packets_shorter_than_the_descriptor_come_by_length(tmp_path):
    raw = make_raw(40, most_returns=1)
    raw.points["wavepacket_size"][::2] = 20
    raw.points["wavepacket_size"][1] = 31
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        unit = reader.read_unit(0, scan)
        shapes = [block.samples.shape for block, _ in reader.read_blocks(unit, 100, True)]
        assert shapes == [(20, 20), (1, 31), (19, 32)]
        assert scan.short == 21
    assert_same(read_all(tmp_path / "a.las"), read_plainly(raw.points, bytes(60) + raw.packets, {1: (8, 32)}))


def test_a_packet_longer_than_the_descriptor_is_cut_to_it(tmp_path):
    raw = make_raw(10, most_returns=1)
    raw.points["wavepacket_size"] = 2**32 - 1
    assert all(len(samples) == 32 for samples, *_ in read_all(raw.write(tmp_path / "a.las")).values())


def test_equal_offsets_of_two_descriptors_are_two_packets(tmp_path):
    raw = make_raw(10, most_returns=1)
    raw.points = np.repeat(raw.points, 2)
    raw.points["wavepacket_index"][1::2] = 2
    raw.vlrs.append(descriptor(2, samples=16))
    found = read_all(raw.write(tmp_path / "a.las"))
    assert_same(found, read_plainly(raw.points, bytes(60) + raw.packets, {1: (8, 32), 2: (8, 16)}))
    assert len(found) == 20


def test_too_many_points_on_one_packet_are_broken_wherever_they_are(tmp_path):
    raw = make_raw(1000, most_returns=1)
    bad = np.arange(0, 1000, 25)
    raw.points["wavepacket_offset"][bad] = 60
    raw.points["wavepacket_size"][bad[3]] = 0  # has none
    raw.write(tmp_path / "a.las")
    for sizes in (ScanSizes(), ScanSizes(window=64)):
        with StripReader(tmp_path / "a.las", unit_points=64, sizes=sizes) as reader, reader.scan() as scan:
            assert (scan.broken, scan.without_waveform, scan.with_waveform, scan.packets) == (39, 1, 960, 960)
            assert scan.reasons == {Reason.OVERFULL: (39, 0)}
            flags = np.concatenate([reader.read_unit(n, scan).point_flags for n in range(reader.unit_count())])
            assert np.flatnonzero(flags).tolist() == bad.tolist()
            assert reader.read_unit(3, scan).context.size == 0


def test_offsets_beyond_4_gib(tmp_path):
    raw = make_raw(20, internal=False, most_returns=2)
    far = 5 * 2**32
    path = raw.write(tmp_path / "a.las")
    with open(path.with_suffix(".wdp"), "r+b") as file:
        file.seek(far)
        file.write(raw.packets)
    raw.points["wavepacket_offset"][::2] += far - 60
    (path.parent / "b").mkdir()
    os.replace(path.with_suffix(".wdp"), tmp_path / "b" / "a.wdp")
    raw.packets = b""
    moved = raw.write(tmp_path / "a.las")
    os.replace(moved, tmp_path / "b" / "a.las")
    found = read_all(tmp_path / "b" / "a.las")
    with open(tmp_path / "b" / "a.wdp", "rb") as file:
        for (_, offset), (samples, *_) in found.items():
            file.seek(offset)
            assert file.read(32) == samples.tobytes()
    assert any(offset > 2**32 for _, offset in found)
    assert any(offset < 2**32 for _, offset in found)


def test_a_strip_without_points_and_one_without_waveforms(tmp_path):
    raw = make_raw(5)
    raw.points = raw.points[:0]
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        assert (reader.unit_count(), scan.points, scan.packets) == (0, 0, 0)
        assert list(reader.sample_blocks(scan, 10)) == []
    raw = make_raw(5)
    raw.points["wavepacket_index"] = 0
    with StripReader(raw.write(tmp_path / "b.las")) as reader, reader.scan() as scan:
        unit = reader.read_unit(0, scan)
        assert (unit.point_flags == EchoFlag.NO_WAVEFORM).all()
        assert len(unit.packets) == 0
        assert list(reader.read_blocks(unit, 10, True)) == []


@pytest.mark.parametrize("case", ["kept", "beyond the limit", "no room"])
def test_compressed_points_are_decoded_once(tmp_path, request, case):
    """But those beyond a limit, and where there is no room for a temporary file."""
    sizes = ScanSizes(spooled=1, kept_bytes=150 * 57 if case == "beyond the limit" else 1 << 20)
    if case == "no room":
        request.getfixturevalue("no_place")
    raw = make_raw(200, most_returns=1)
    plain, path = raw.write(tmp_path / "a.las"), raw.write(tmp_path / "b.laz")
    readers = StripReader(plain, unit_points=64), StripReader(path, unit_points=64, sizes=sizes)
    with readers[0] as one, readers[1] as two, one.scan() as expected, two.scan() as scan:
        if case == "kept":
            path.write_bytes(path.read_bytes()[: two.facts.header.offset_to_points].ljust(path.stat().st_size, b"\0"))
        for number in range(one.unit_count()):
            units = one.read_unit(number, expected), two.read_unit(number, scan)
            assert len({unit.points.tobytes() for unit in units}) == 1
    count = scan.decoded.count
    assert {"kept": count == 200, "no room": count == 0}.get(case, 0 < count < 200)


def test_long_records_make_smaller_units(tmp_path):
    with StripReader(make_raw(200).write(tmp_path / "a.las"), unit_bytes=57 * 100) as reader:
        assert reader.unit_count() == -(-reader.facts.header.point_count // 100)


def test_a_file_that_shrinks_while_it_is_read_is_an_input_error(tmp_path):
    raw = make_raw(50, internal=False)
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        unit = reader.read_unit(0, scan)
        os.truncate(tmp_path / "a.wdp", 100)
        refuses(InputError, r"a\.wdp: packets cannot be read", list, reader.read_blocks(unit, 10, True))
        os.truncate(tmp_path / "a.las", 400)
        refuses(InputError, r"a\.las: points 0 to", reader.read_unit, 0, scan)


def test_scanner_channels_come_with_their_waveforms(tmp_path):
    raw = make_raw(12, point_format=9, most_returns=1)
    raw.points["classification_flags"] = (np.arange(12) % 4) << 4 | 3
    with StripReader(raw.write(tmp_path / "s.las")) as reader, reader.scan() as scan:
        blocks = [block for block, _ in reader.read_blocks(reader.read_unit(0, scan), 5, owned_only=True)]
    assert np.concatenate([block.scanner for block in blocks]).tolist() == [0, 1, 2, 3] * 3
    with StripReader(make_raw(3).write(tmp_path / "old.las")) as reader, reader.scan() as scan:
        block, _ = next(iter(reader.read_blocks(reader.read_unit(0, scan), 5, owned_only=True)))
    assert block.scanner is None


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_link_to_a_strip_finds_the_packets_beside_its_target(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "links").mkdir()
    strip = make_raw(60, internal=False).write(tmp_path / "real" / "a strip.las")
    link = tmp_path / "links" / "b.las"
    link.symlink_to(strip)
    with StripReader(link) as reader:
        assert reader.facts.packets.file == strip.with_suffix(".wdp").resolve()
    other = link.with_suffix(".wdp")
    other.write_bytes(strip.with_suffix(".wdp").read_bytes())
    with StripReader(link) as reader:  # those beside the link count first
        assert reader.facts.packets.file == other
    with protecting([link]), pytest.raises(ConfigError, match="replace this input"):
        refuse_input(strip.with_suffix(".wdp"))


def test_a_sample_has_a_bounded_number_of_samples_of_long_waveforms(tmp_path):
    path = make_raw(40, n_samples=10_000, most_returns=1).write(tmp_path / "a.las")
    with StripReader(path) as reader, reader.scan() as scan:
        taken = [row for block in reader.sample_blocks(scan, 1000) for row in block.point.tolist()]
        assert len(taken) == LONG_SAMPLES // 10_000 and taken[0] == 0 and taken[-1] == 39
        every = reader.sample_blocks(scan, 1000, long_samples=40 * 10_000)
        assert sum(len(block) for block in every) == 40


def test_long_waveforms_do_not_take_the_place_of_short_ones(tmp_path):
    raw = make_raw(200, n_samples=4000, most_returns=1)
    raw.points["wavepacket_size"][20:] = 50
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        blocks = list(reader.sample_blocks(scan, 1000, long_samples=8000))
    lengths = [block.samples.shape[1] for block in blocks for _ in range(len(block))]
    assert lengths.count(50) == 180 and lengths.count(4000) == 2


def test_packets_that_overlap_many_times_are_refused(tmp_path):
    raw = make_raw(40, n_samples=32, most_returns=1)
    raw.points["wavepacket_offset"] = 60 + 10 * np.arange(40)
    raw.packets = raw.packets[: 10 * 39 + 32]
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        assert scan.packets == 40
    raw.points["wavepacket_offset"] = 60 + 2 * np.arange(40)
    raw.packets = raw.packets[: 2 * 39 + 32]
    said = "packets overlap: they claim 1,280 bytes of 110"
    with StripReader(raw.write(tmp_path / "b.las")) as reader, pytest.raises(InputError, match=said):
        reader.scan()


UNIT = 700


def open_strip(path, **sizes):
    return StripReader(path, unit_points=UNIT, sizes=ScanSizes(**{"window": 200, "part_units": 1, **sizes}))


@pytest.fixture(scope="module", params=["las", "laz"])
def strip(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / f"a.{request.param}"
    simulate_strip("forest", path, pulses=2500, seed=4)
    return path


def scan(path, edges=None):
    """The scan of one process, or of one for all units between two edges each, which send it pickled."""
    with open_strip(path) as reader:
        if edges is None:
            return reader.scan(tolerant=True)
        parts = [reader.scan_units(*run) for run in itertools.pairwise(edges)]
        for _ in range(2):  # they go through the process that writes
            parts = pickle.loads(pickle.dumps(parts))
        return reader.scan(tolerant=True, parts=parts)


def contents(found):
    """All that a scan holds, as plain values."""
    values = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
    units = len(found.borders) - 1
    for name, value in values.items():
        if isinstance(value, Spool):
            entries = [value.read(unit) for unit in range(units)]
            if name == "context":
                entries = [scanner.unique_entries(part) for part in entries]
            values[name] = [part.tobytes() for part in entries]
        elif isinstance(value, np.ndarray):
            values[name] = value.tolist()
    return values


def check(path):
    with open_strip(path) as reader:
        units = reader.unit_count()
    with scan(path) as whole:
        expected = contents(whole)
    assert units >= 6
    for edges in (range(units + 1), [0, 1, units], [0, units - 1, units], [0, 3, 4, units], [0, units]):
        with scan(path, edges) as parts:
            assert contents(parts) == expected
    return expected


def test_parts_give_the_scan_of_one_process(strip):
    assert check(strip)["with_waveform"]


def test_what_is_kept_until_the_end_does_not_grow_with_the_units(strip, monkeypatch):
    """512 packets and 256 votes of each unit took 80 MB of a strip of 10^8 waveforms; fewer decide the same."""
    decided, kept = [], []
    for many in (256, 2):
        monkeypatch.setattr(scanner, "MANY_UNITS", many)
        with open_strip(strip) as reader, reader.scan_units(0, reader.unit_count()) as part:
            kept.append((sum(len(keys) for keys, *_ in part.sample), sum(map(len, part.votes.ratios))))
        with open_strip(strip) as reader, reader.scan(tolerant=True) as found:
            decided.append((found.vectors.direction, found.forms))
    assert decided[0] == decided[1]
    assert kept[0][0] > 1.8 * kept[1][0] and kept[0][1] > 1.8 * kept[1][1]
    assert 500 < kept[1][0] <= 2 * 512 and 100 < kept[1][1] <= 4 * 256


@pytest.mark.parametrize("distance", [30, 150, 10**6])
def test_parts_of_shuffled_points_too(tmp_path, edit_points, distance):
    """Returns of a packet lie in several units: within the window, and anywhere in the strip."""
    draw = np.random.default_rng(2)
    simulate_strip("forest", tmp_path / "a.las", pulses=2500, seed=4)

    def move(points):
        moved = points[np.argsort(np.arange(len(points)) + draw.uniform(0, distance, len(points)))]
        moved["wavepacket_index"][5::300] = 9  # no descriptor; the first of all parts is named
        return moved

    edit_points(tmp_path / "a.las", tmp_path / "b.las", move)
    assert any(check(tmp_path / "b.las")["context"])


def test_packets_whose_points_lie_further_apart_than_the_window_are_suspect():
    near = scanner.NearSharing(0, 1024, Spool(2, np.dtype("u1")), ScanSizes(window=10, bins=1))
    for index, is_suspect in (([0, 4, 9], False), ([10], True)):
        keys, own = np.arange(len(index), dtype=np.uint64) << np.uint64(8), np.ones(len(index), bool)
        near.add(keys, np.array(index), np.zeros(len(index), int), own, lambda rows: np.empty(len(rows), "u1"))
        assert near.suspects()[0] == is_suspect


def test_parts_of_a_scan_are_joined_from_the_first_to_the_last_point_of_each_bin():
    parts = [scanner.NearSharing(0, 1024, Spool(2, np.dtype("u1")), ScanSizes(window=10, bins=1)) for _ in range(2)]
    for near, index in zip(parts, (0, 10), strict=True):
        key, own = np.zeros(1, np.uint64), np.ones(1, bool)
        near.add(key, np.array([index]), np.zeros(1, int), own, lambda rows: np.empty(len(rows), "u1"))
        assert not near.suspects()[0]
    parts[0].join(parts[1])
    assert parts[0].suspects()[0]


def test_a_part_of_few_points_before_a_border_is_not_cut_off(strip):
    with open_strip(strip) as reader:
        units = reader.unit_count()
        assert reader.cut_scan(3) == [(0, units // 3), (units // 3, 2 * units // 3), (2 * units // 3, units)]
    with open_strip(strip, part_units=4) as reader:
        assert len(reader.cut_scan(1000)) == units // 4
    for window, parts in ((UNIT - 64, 3), (UNIT - 63, 1), (UNIT, 1)):  # of the window and a run of points
        with open_strip(strip, window=window) as reader:
            assert len(reader.cut_scan(3)) == parts


def test_a_strip_without_points_is_one_part():
    assert scanner.cut_scan(0, 50_000, 8) == [(0, 0)]


def test_parts_of_a_damaged_strip_fail_with_the_line_of_one_process(strip):
    """Wherever the damage is: the first part that fails names the same points."""
    content = strip.read_bytes()
    with open_strip(strip) as reader:
        units, start = reader.unit_count(), reader.facts.header.offset_to_points
    bad = strip.with_name("bad" + strip.suffix)
    if strip.suffix == ".las":
        bad.write_bytes(content[: start + (len(content) - start) // 2])
    else:
        wrong = bytes(255 - byte for byte in content[start + 40 : start + 4000])
        bad.write_bytes(content[: start + 40] + wrong + content[start + 4000 :])
    lines = []
    for edges in None, range(units + 1), [0, 2, units]:
        try:
            scan(bad, edges).close()
            lines.append("")
        except InputError as error:
            lines.append(str(error))
    assert len(set(lines)) == 1 and "\n" not in lines[0]
