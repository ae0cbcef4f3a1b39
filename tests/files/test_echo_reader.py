"""Clouds of any LAS or LAZ kind: read as laspy reads them, and whatever is damaged is one line, never a crash."""

import json
import random
import struct

import laspy
import numpy as np
import pytest
from strips import make_raw
from writer_tools import write_points

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import CLOUD_DTYPE, RETURN_DTYPE, CloudReader, ColumnReader, read_cloud


def write_cloud(path, point_format, n=300, extra=()):
    """A cloud of random points; extra: names of f4 dimensions."""
    rng = np.random.default_rng(point_format)
    xyz = [5.0, 6.0, 7.0] + 0.01 * rng.integers(-1000, 1000, (n, 3))
    return write_points(path, xyz, point_format=point_format, scale=0.01, offsets=(5, 6, 7),
                        extra=[(name, "f4") for name in extra],
                        intensity=rng.integers(0, 65535, n), **{name: rng.random(n) for name in extra})  # fmt: skip


def read_all(path):
    """Everything that the commands read of a cloud, or None where it is refused with one line."""
    try:
        rows = []
        for dtype in (CLOUD_DTYPE, RETURN_DTYPE):
            with CloudReader(path, dtype) as cloud:
                rows.append([row for piece in cloud.read_pieces(100) for row in piece])
    except InputError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)
        return None
    return rows


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_clouds_of_every_format_without_waveforms_are_read(tmp_path, point_format, suffix):
    path = tmp_path / f"a{suffix}"
    cloud = write_cloud(path, point_format, extra=("amplitude",))
    with CloudReader(path) as reader:
        assert reader.columns == ("amplitude",) and reader.has_gps_time == (point_format not in (0, 2))
        pieces = list(reader.read_pieces(70))
    rows = np.concatenate(pieces)
    assert [len(piece) for piece in pieces] == [70, 70, 70, 70, 20]
    assert np.allclose(rows["xyz"], np.stack([cloud.x, cloud.y, cloud.z], axis=1), atol=1e-9)
    assert np.array_equal(rows["amplitude"], cloud.points.array["amplitude"])
    assert np.array_equal(rows["intensity"], cloud.points.array["intensity"])


def test_extra_bytes_that_are_no_column_of_that_name_are_left_alone(tmp_path):
    """A vector called amplitude, flags that are numbers, a scale that is none: no data, no warning."""
    extra = [("amplitude", "3f4"), ("echo_flags", "f4"), ("pulse width", "u2", None, 1e308), ("range_err", "f8")]
    raw = [("echo_flags", [np.nan, 1e30, -1]), ("pulse width", 5), ("range_err", [1e300, np.inf, 0.25])]
    write_points(tmp_path / "a.las", np.zeros((3, 3)), extra=extra, raw=raw)
    with CloudReader(tmp_path / "a.las") as reader:
        assert reader.columns == ("echo_width", "range_err")
        (rows,) = reader.read_pieces()
    assert not rows["flags"].any() and np.isnan(rows["amplitude"]).all() and np.isnan(rows["echo_width"]).all()
    assert np.array_equal(rows["range_err"], np.float32([np.nan, np.nan, 0.25]), equal_nan=True)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_packet_vectors_that_are_no_numbers_are_none(tmp_path, value):
    raw = make_raw(100, point_format=10)
    raw.points["y_t"][::3] = value
    with CloudReader(raw.write(tmp_path / "a.las")) as reader:
        (rows,) = reader.read_pieces()
    damaged = ~np.isfinite(raw.points["y_t"][raw.points["wavepacket_index"] != 0])
    assert damaged.any() and not rows["ray"][damaged].any() and rows["ray"][~damaged].all()


def write_renamed(path, types, columns):
    """A cloud with an account of the run that names `columns`, whose extra bytes are of `types`."""
    account = laspy.VLR("wavebatch", 1, record_data=json.dumps({"columns": columns}).encode())
    write_points(path, np.zeros((4, 3)), extra=types.items(), vlrs=[account], raw=[(name, 2) for name in types])
    return path


ARRAYS = ("2f4", "3u2", "2f8")


@pytest.mark.parametrize("kind", ARRAYS)
def test_no_reader_takes_several_numbers_for_a_column_that_the_account_names(tmp_path, kind):
    """Other programs store what they like under the names of the account; a KeyError or a broadcast would follow."""
    names = ("amplitude", "echo_width", "amplitude_err", "range_err", "incidence_angle", "reflectance", "echo_flags")
    types = dict.fromkeys(names, kind) | {"echo_time": "f4"}
    path = write_renamed(tmp_path / "a.las", types, {name: name for name in types} | {"not_known": "echo_time"})
    for dtype in (CLOUD_DTYPE, RETURN_DTYPE):
        with CloudReader(path, dtype) as cloud:
            (rows,) = cloud.read_pieces()
            assert len(rows) == 4 and set(cloud.written) <= {"echo_time", "not_known"}
    assert "echo_time" in read_cloud(path).dtype.names
    with ColumnReader(path, "echo_time") as cloud:
        (rows,) = cloud.read_pieces()
        assert (rows["values"] == 2).all()
    for name in ("amplitude", "echo_flags", "not_known"):
        with pytest.raises(ConfigError, match=f"has no column {name!r}"):
            ColumnReader(path, name)


def _damage(rng, whole, points_at):
    data = bytearray(whole)
    for _ in range(rng.choice([1, 2, 5])):
        at = rng.randrange(len(data)) if rng.random() < 0.5 else rng.randrange(points_at + 100)
        width = rng.choice([1, 2, 4, 8])
        data[at : at + width] = rng.choice([b"\xff" * width, bytes(width), rng.randbytes(width)])
    return data[: rng.randrange(len(data))] if rng.random() < 0.1 else data


@pytest.mark.parametrize("name", ["1.laz", "3.las", "6.laz", "8.las", "10.laz"])
def test_damaged_clouds_read_or_are_refused(tmp_path, name):
    rng = random.Random(name)
    path = tmp_path / name
    if path.stem == "10":
        make_raw(100, point_format=10).write(path)
    else:
        write_cloud(path, int(path.stem), extra=("amplitude", "echo_flags"))
    whole = path.read_bytes()
    outcomes = []
    for _ in range(60):
        path.write_bytes(_damage(rng, whole, int.from_bytes(whole[96:100], "little")))
        outcomes.append(read_all(path) is None)
    assert True in outcomes and False in outcomes


def test_numbers_of_points_that_no_file_could_hold_are_refused_at_once(tmp_path):
    path = tmp_path / "a.laz"
    write_cloud(path, 6)
    data = bytearray(path.read_bytes())
    data[247:255] = struct.pack("<Q", 2**40)
    path.write_bytes(data)
    with pytest.raises(InputError, match="claims 1099511627776 points"):
        CloudReader(path)


def test_flags_of_the_account_that_are_no_unsigned_integers_are_no_flags(tmp_path):
    names = {"amplitude": "f4", "echo_flags": "f4"}
    path = write_renamed(tmp_path / "a.las", names, {name: name for name in names})
    with CloudReader(path) as cloud:
        (rows,) = cloud.read_pieces()
    assert set(cloud.written) == {"amplitude"} and (rows["amplitude"] == 2).all() and not rows["flags"].any()
