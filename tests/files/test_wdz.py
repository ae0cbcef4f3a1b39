"""Strips with compressed packets (.wdz of LAStools): read in place, damaged packets flagged."""

import numpy as np
import pytest
from commands import refuses, succeed
from naive_wdz import pack_strip

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import StripReader


def _copy(strip, target):
    """A copy of a strip and its packets that may be changed."""
    for path in strip.parent.glob(f"{strip.stem}.[lw][ad][spz]"):
        target.with_suffix(path.suffix).write_bytes(path.read_bytes())
    return target


@pytest.fixture(scope="module")
def packed_once(riegl, tmp_path_factory):
    """The RIEGL strip with compressed packets: the encoder of the tests is slow."""
    folder = tmp_path_factory.mktemp("packed")
    return pack_strip(_copy(riegl, folder / "plain.las"), folder / "packed.las")


@pytest.fixture
def packed(packed_once, tmp_path):
    return _copy(packed_once, tmp_path / "packed.las")


@pytest.fixture
def plain(riegl, tmp_path):
    return _copy(riegl, tmp_path / "plain.las")


def _read(path):
    with StripReader(path) as reader, reader.scan() as scan:
        blocks = list(reader.all_blocks(scan, 512))
        return {int(b.point[row]): b.samples[row].tolist() for b in blocks for row in range(len(b))}, scan


@pytest.mark.parametrize("mixed", [False, True])
def test_compressed_packets_hold_the_same_samples(plain, packed, tmp_path, mixed):
    packed = pack_strip(plain, tmp_path / "mixed.las", mixed) if mixed else packed
    expected, _ = _read(plain)
    found, scan = _read(packed)
    assert found == expected and scan.broken == 0 and scan.short == 0
    assert packed.with_suffix(".wdz").stat().st_size < 0.6 * plain.with_suffix(".wdp").stat().st_size or mixed


def test_damaged_packets_are_flagged_and_the_others_read(packed, rng):
    expected, _ = _read(packed)
    wdz = packed.with_suffix(".wdz")
    data = bytearray(wdz.read_bytes())
    data[5000:9000] = rng.integers(0, 256, 4000).astype(np.uint8).tobytes()
    wdz.write_bytes(data)
    found, scan = _read(packed)
    assert 0 < scan.broken < 200 and len(found) > 2000
    assert any("damaged" in warning for warning in scan.warnings)
    assert sum(expected[point] != samples for point, samples in found.items()) < 100
    with StripReader(packed) as reader, reader.scan() as again:
        flags = np.concatenate([unit.point_flags for unit in reader.read_units(again)])
    assert np.count_nonzero(flags & int(EchoFlag.BROKEN_PACKET)) == scan.broken


def test_a_run_of_both_gives_the_same_points(plain, packed, tmp_path):
    clouds = []
    for path in (plain, packed):
        words = ["run", str(path), "-o", str(tmp_path / "out"), "--profile", "fast", "--keep-packets"]
        succeed(*words, "--format", "las", "-q")
        with StripReader(tmp_path / "out" / path.name) as reader:
            clouds.append(reader.read_points(0, reader.facts.header.point_count))
    ours, theirs = clouds
    same = [name for name in ours.dtype.names if not name.startswith("wavepacket")]
    assert len(ours) == len(theirs) and all(np.array_equal(ours[name], theirs[name]) for name in same)
    kept, _ = _read(tmp_path / "out" / "packed.las")  # compressed packets stay compressed
    assert kept and (tmp_path / "out" / "packed.wdz").exists()


def test_a_missing_or_contradicting_wdz_is_named(plain, packed, tmp_path):
    packed.with_suffix(".wdz").rename(tmp_path / "other.wdz")
    refuses(InputError, r"put packed\.wdz next to the strip", StripReader, packed)
    (tmp_path / "other.wdz").rename(plain.with_suffix(".wdz"))
    plain.with_suffix(".wdp").unlink()
    refuses(InputError, "its descriptors say that they are not compressed", StripReader, plain)
