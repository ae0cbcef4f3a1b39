import errno

import numpy as np
import pytest

from wavebatch.core.errors import InputError
from wavebatch.files.disk.temp_store import MOST_BUCKETS, Spool, count_buckets, spread_keys, spread_times, time_keys

ROW = np.dtype([("gps_time", "<f8"), ("number", "<i4")])


@pytest.mark.parametrize("number", [1, 2, 7])
def test_buckets_give_every_row_back_in_order_and_pulses_whole(rng, number):
    rows = np.zeros(1000, ROW)
    rows["gps_time"], rows["number"] = rng.integers(0, 200, 1000) * 0.25, np.arange(1000)
    seen = []
    with Spool(number, ROW) as buckets:
        for part in np.array_split(rows, 9):
            buckets.append(spread_times(part["gps_time"], number), part)
        for bucket in range(number):
            got = buckets.read(bucket)
            assert (np.diff(got["number"]) > 0).all()
            seen.append(got)
    found = np.concatenate(seen)
    assert np.array_equal(np.sort(found["number"]), rows["number"])
    assert np.array_equal(rows["gps_time"][found["number"]], found["gps_time"])
    times = [set(part["gps_time"].tolist()) for part in seen]
    assert sum(map(len, times)) == len(set.union(*times))


def test_times_that_are_equal_have_equal_keys():
    keys = time_keys(np.array([0.0, -0.0, 1.5, 1.5]))
    assert keys[0] == keys[1] and keys[2] == keys[3] and keys[0] != keys[2]


def test_keys_spread_evenly_even_if_they_are_regular():
    for keys in (np.arange(72_000), np.arange(72_000) << 12, time_keys(np.arange(72_000) * 1e-5).astype(np.int64)):
        count = np.bincount(spread_keys(keys.astype(np.uint64), 72), minlength=72)
        assert count.min() > 700 and count.max() < 1300


def test_number_of_buckets():
    assert [count_buckets(rows, 100) for rows in (0, 1, 100, 101, 10**9)] == [1, 1, 1, 2, MOST_BUCKETS]


def test_no_room_for_buckets_is_one_line(monkeypatch):
    def full(*args, **options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("wavebatch.files.disk.temp_store.make_folder", full)
    monkeypatch.setattr("wavebatch.files.disk.temp_store.SPOOL_MEMORY", 1)
    with pytest.raises(InputError, match="No space left on device.*TMPDIR"), Spool(2, ROW) as buckets:
        buckets.append(spread_times(np.zeros(3), 2), np.zeros(3, ROW))
