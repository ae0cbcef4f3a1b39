"""A strip that several processes scan in parts: the scan is that of one process, for any parts and order of points."""

import dataclasses
import itertools
import pickle

import numpy as np
import pytest

from wavebatch.core.errors import InputError
from wavebatch.files.disk.temp_store import Spool
from wavebatch.files.strip import scanner
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.scanner import ScanSizes
from wavebatch.tools.simulate import simulate_strip

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
