"""Sums by key: the same whatever was spilled, and in bounded memory."""

import pickle
from contextlib import closing

import numpy as np
import pytest

from wavebatch.core.errors import InputError
from wavebatch.files.disk import temp_store

resource = pytest.importorskip("resource", reason="limits of POSIX systems")

ROW = np.dtype([("gps_time", "<f8"), ("number", "<i4")])


@pytest.mark.parametrize("number", [1, 2, 7])
def test_buckets_give_every_row_back_in_order_and_pulses_whole(rng, number):
    rows = np.zeros(1000, ROW)
    rows["gps_time"], rows["number"] = rng.integers(0, 200, 1000) * 0.25, np.arange(1000)
    seen = []
    with temp_store.Spool(number, ROW) as buckets:
        for part in np.array_split(rows, 9):
            buckets.append(temp_store.spread_keys(temp_store.time_keys(part["gps_time"]), number), part)
        for bucket in range(number):
            got = buckets.read(bucket)
            assert (np.diff(got["number"]) > 0).all()
            seen.append(got)
    found = np.concatenate(seen)
    assert np.array_equal(np.sort(found["number"]), rows["number"])
    assert np.array_equal(rows["gps_time"][found["number"]], found["gps_time"])
    times = [set(part["gps_time"].tolist()) for part in seen]
    assert sum(map(len, times)) == len(set.union(*times))


def slow_sums(parts):
    sums = {}
    for key, value in parts:
        for one, row in zip(key.tolist(), value.tolist(), strict=True):
            sums[one] = [a + b for a, b in zip(sums.get(one, [0] * len(row)), row, strict=True)]
    return sums


def draw_parts(seed, spread, number=40):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 200, number)
    return [
        (rng.integers(0, spread, n).astype(np.uint64) << np.uint64(40), rng.integers(-9, 2**40, (n, 3))) for n in sizes
    ]


@pytest.mark.parametrize("held", [3, 300, 100_000])
@pytest.mark.parametrize("spread", [1, 30, 100_000])
@pytest.mark.parametrize(("seed", "each"), [(1, 100_000), (2, 50), (3, 1)])
def test_sums_are_those_of_a_dictionary(held, spread, seed, each):
    parts = draw_parts(seed, spread, 40 if held > 3 else 6)
    borders = np.sort(np.concatenate([key for key, _ in parts]))[each // 2 :: each]
    with temp_store.KeyedSums(3, borders, in_memory=held) as sums:
        for key, value in parts:
            sums.add(key, value)
        pieces = list(sums.pieces())
        assert bool(sums._rows.path) == (held < 1000 and min(spread, 3000) * len(parts) > held)
    keys = np.concatenate([key for key, _ in pieces])
    values = np.concatenate([value for _, value in pieces])
    expected = slow_sums(parts)
    assert keys.tolist() == sorted(expected)
    assert values.tolist() == [expected[key] for key in keys.tolist()]


def test_a_piece_has_the_keys_between_two_borders():
    parts = draw_parts(5, 2**23, 100)
    borders = np.arange(1, 64, dtype=np.uint64) << np.uint64(57)
    with temp_store.KeyedSums(3, borders, in_memory=400) as sums:
        for key, value in parts:
            sums.add(key, value)
        first = [int(key[0]) >> 57 for key, _ in sums.pieces()]
        last = [int(key[-1]) >> 57 for key, _ in sums.pieces()]
    assert first == last == list(range(64))


def test_keys_that_come_again_and_again_are_summed_some_at_a_time(monkeypatch):
    """A strip that is sorted by class has rows of all voxels in each batch: 420 MB more for each 500,000 pulses."""
    plain, most = temp_store._sum, []
    monkeypatch.setattr(temp_store, "_sum", lambda key, value: most.append(len(key)) or plain(key, value))
    key, value = np.arange(300, dtype=np.uint64), np.ones((300, 3), np.int64)
    with temp_store.KeyedSums(3, np.empty(0, np.uint64), in_memory=400) as sums:
        for _ in range(100):
            sums.add(key, value)
        ((_, total),) = sums.pieces()
    assert (total == 100).all() and max(most) < 2000


def test_without_a_place_sums_say_so(no_place):
    none = np.empty(0, np.uint64)
    with temp_store.KeyedSums(3, none, in_memory=10) as sums, pytest.raises(InputError, match="TMPDIR"):
        for key, value in draw_parts(4, 1000):
            sums.add(key, value)


def test_a_disk_that_is_full_for_a_moment_doubles_nothing():
    """The first pickling finds no room for its entries; the second writes them once."""
    spool = temp_store.Spool(3, np.dtype("i8"))
    numbers = np.arange(400_000)
    spool.append(numbers % 3, numbers)
    spool.seal()

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        whole = pickle.loads(pickle.dumps(spool))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with closing(spool):
        copy = pickle.loads(pickle.dumps(spool))
        for bucket in range(3):
            np.testing.assert_array_equal(whole.read(bucket), numbers[bucket::3])
            np.testing.assert_array_equal(copy.read(bucket), numbers[bucket::3])


def test_a_store_gives_its_rows_back_in_pieces_that_do_not_overlap(tmp_path):
    rows = np.zeros(10, ROW)
    rows["number"] = np.arange(10)
    with closing(temp_store.RowStore(tmp_path / "a.laz", ROW)) as store:
        store.add(rows)
        assert [part["number"].tolist() for part in store.pieces(4)] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
