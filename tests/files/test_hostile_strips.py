"""Any byte may be wrong: a seeded storm of damage, and every strip either reads or gets one InputError line."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strips import make_raw

from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import check_file

KINDS = [(4, True, ".las"), (9, False, ".las"), (5, False, ".laz"), (10, True, ".laz")]


def read_or_refuse(path):
    """Reads everything there is, or sees one line; what is counted adds up."""
    try:
        with StripReader(path) as reader, reader.scan() as scan:
            assert scan.points == scan.with_waveform + scan.without_waveform + scan.broken
            read = 0
            for number in range(reader.unit_count()):
                unit = reader.read_unit(number, scan)
                for block, _ in reader.read_blocks(unit, 64, True):
                    read += len(block)
                    assert np.isfinite(block.origin).all() and np.isfinite(block.direction).all()
                    assert np.isfinite(block.returns.time).all()
            assert read == scan.packets
    except InputError as error:
        assert str(error).startswith(str(path.parent)) and "\n" not in str(error)
        assert not check_file(path).is_clean
        return False
    return True


@pytest.mark.parametrize(("point_format", "internal", "suffix"), KINDS)
@pytest.mark.parametrize("where", ["header", "anywhere", "cut"])
def test_damaged_strips_read_or_are_refused(tmp_path, point_format, internal, suffix, where):
    rng = random.Random(f"{point_format} {where}")
    path = make_raw(30, point_format=point_format, internal=internal).write(tmp_path / f"a{suffix}")
    whole = path.read_bytes()
    front = int.from_bytes(whole[96:100], "little")
    outcomes = []
    for _ in range(40):
        data = bytearray(whole)
        if where == "cut":
            del data[rng.randrange(len(data)) :]
        for _ in range(0 if where == "cut" else rng.choice([1, 2, 5, 20])):
            at = rng.randrange(front + 8 if where == "header" else len(data))
            width = rng.choice([1, 1, 2, 4, 8])
            data[at : at + width] = rng.choice([b"\xff" * width, bytes(width), rng.randbytes(width)])
        path.write_bytes(data)
        outcomes.append(read_or_refuse(path))
    assert False in outcomes, "no damage was noticed"


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


def test_a_damaged_wdp_never_hurts(tmp_path):
    rng = random.Random(4)
    path = make_raw(30, internal=False).write(tmp_path / "a.las")
    beside = path.with_suffix(".wdp")
    whole = beside.read_bytes()
    for _ in range(60):
        data = bytearray(whole)
        data[rng.randrange(60)] = rng.randrange(256)
        beside.write_bytes(data[: rng.choice([len(data), rng.randrange(len(data))])])
        read_or_refuse(path)
