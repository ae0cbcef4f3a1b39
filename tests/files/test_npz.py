"""Columns as .npz files: what NumPy reads back, the same bytes every time, and nothing left behind."""

import numpy as np
import pytest

from wavebatch.core.errors import InputError
from wavebatch.files.disk.npz import NpzWriter


def write(target, parts, **options):
    with NpzWriter(target, {"place": np.dtype(("<i4", (3,))), "value": "<f4"}, **options) as writer:
        for place, value in parts:
            writer.add({"place": place, "value": value})
        writer.publish({"size": 0.5, "text": "päper"})


def test_numpy_reads_what_was_added(tmp_path, rng):
    parts = [(rng.integers(-9, 9, (n, 3)), rng.normal(size=n)) for n in (4, 0, 300)]
    for name in ("a.npz", "b.npz"):
        write(tmp_path / name, parts)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz") as file:
        assert np.array_equal(file["place"], np.concatenate([place for place, _ in parts]))
        assert np.array_equal(file["value"], np.concatenate([value for _, value in parts]).astype("f4"))
        assert file["place"].dtype == "<i4" and file["size"] == 0.5 and str(file["text"]) == "päper"
    write(tmp_path / "c.npz", [])
    with np.load(tmp_path / "c.npz") as file:
        assert file["place"].shape == (0, 3) and file["value"].shape == (0,)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz", "c.npz"]


def test_nothing_is_left_of_what_fails(tmp_path):
    with pytest.raises(InputError, match="make the folder first"):
        NpzWriter(tmp_path / "gone" / "a.npz", {"value": "f4"})
    (tmp_path / "a.npz").write_text("old")
    with pytest.raises(InputError, match="exists already"):
        NpzWriter(tmp_path / "a.npz", {"value": "f4"})
    writer = NpzWriter(tmp_path / "b.npz", {"value": "f4"})
    writer.add({"value": np.zeros(3)})
    writer.close()
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
    write(tmp_path / "a.npz", [], overwrite=True)
    assert (tmp_path / "a.npz").read_bytes()[:2] == b"PK"
