"""Strips with compressed packets (.wdz of LAStools): read in place, damaged packets flagged."""

import numpy as np
import pytest
from click.testing import CliRunner
from naive_wdz import compress
from strips import descriptor

from wavebatch.cli import main
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import InputError
from wavebatch.files.las.header import EVLR_HEADER_SIZE, read_header
from wavebatch.files.strip.reader import StripReader


def pack_strip(source, target, mixed=False):
    """The strip with its packets as LAStools compresses them; mixed: descriptor 1 stays as it is."""
    data, header = bytearray(source.read_bytes()), read_header(source)
    with StripReader(source) as reader:
        points = reader.read_points(0, header.point_count).copy()
        digitizers = reader.facts.digitizers
    old = source.with_suffix(".wdp").read_bytes()
    out, moved = bytearray(old[:EVLR_HEADER_SIZE]) + b"LAStools waveform 260101" + b"\0\0", {}
    for row in range(len(points)):
        index, at = int(points["wavepacket_index"][row]), int(points["wavepacket_offset"][row])
        if index and (index, at) not in moved:
            bits, size = digitizers[index].bits, int(points["wavepacket_size"][row])
            samples = np.frombuffer(old, f"<u{bits // 8}", size // (bits // 8), at)
            packet = old[at : at + size] if mixed and index == 1 else compress(samples, bits)
            moved[index, at] = len(out), len(packet)
            out += packet
        if index:
            points["wavepacket_offset"][row], points["wavepacket_size"][row] = moved[index, at]
    for digitizer in digitizers.values():
        if digitizer.n_samples and not (mixed and digitizer.index == 1):
            plain = descriptor(digitizer.index)[:20]  # its user id and number
            at = bytes(data).index(plain[2:]) - 2
            data[at + 54 + 1] = 1
    start = header.offset_to_points
    data[start : start + points.nbytes] = points.tobytes()
    target.write_bytes(data)
    target.with_suffix(".wdz").write_bytes(out)
    return target


@pytest.fixture
def plain(riegl, tmp_path):
    """A copy of the RIEGL strip that may be changed."""
    for suffix in (".las", ".wdp"):
        (tmp_path / f"plain{suffix}").write_bytes(riegl.with_suffix(suffix).read_bytes())
    return tmp_path / "plain.las"


def _read(path):
    with StripReader(path) as reader, reader.scan() as scan:
        blocks = list(reader.all_blocks(scan, 512))
        return {int(b.point[row]): b.samples[row].tolist() for b in blocks for row in range(len(b))}, scan


@pytest.mark.parametrize("mixed", [False, True])
def test_compressed_packets_hold_the_same_samples(plain, tmp_path, mixed):
    packed = pack_strip(plain, tmp_path / "packed.las", mixed)
    expected, _ = _read(plain)
    found, scan = _read(packed)
    assert found == expected and scan.broken == 0 and scan.short == 0
    assert packed.with_suffix(".wdz").stat().st_size < 0.6 * plain.with_suffix(".wdp").stat().st_size or mixed


def test_damaged_packets_are_flagged_and_the_others_read(plain, tmp_path, rng):
    packed = pack_strip(plain, tmp_path / "packed.las")
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


def test_a_cut_wdz_keeps_what_is_there(plain, tmp_path):
    packed = pack_strip(plain, tmp_path / "packed.las")
    wdz = packed.with_suffix(".wdz")
    wdz.write_bytes(wdz.read_bytes()[:-2000])
    found, scan = _read(packed)
    assert 0 < scan.broken < 200 and len(found) > 2000


def test_a_run_of_both_gives_the_same_points(plain, tmp_path):
    packed = pack_strip(plain, tmp_path / "packed.las")
    clouds = []
    for path in (plain, packed):
        words = ["run", str(path), "-o", str(tmp_path / "out"), "--profile", "fast", "--keep-packets"]
        done = CliRunner().invoke(main, [*words, "--format", "las", "-q"])
        assert done.exit_code == 0, done.output
        with StripReader(tmp_path / "out" / path.name) as reader:
            clouds.append(reader.read_points(0, reader.facts.header.point_count))
    ours, theirs = clouds
    same = [name for name in ours.dtype.names if not name.startswith("wavepacket")]
    assert len(ours) == len(theirs) and all(np.array_equal(ours[name], theirs[name]) for name in same)
    kept, _ = _read(tmp_path / "out" / "packed.las")  # compressed packets stay compressed
    assert kept and (tmp_path / "out" / "packed.wdz").exists()


def test_a_missing_or_contradicting_wdz_is_named(plain, tmp_path):
    packed = pack_strip(plain, tmp_path / "packed.las")
    packed.with_suffix(".wdz").rename(tmp_path / "other.wdz")
    with pytest.raises(InputError, match=r"put packed\.wdz next to the strip"):
        StripReader(packed)
    (tmp_path / "other.wdz").rename(plain.with_suffix(".wdz"))
    plain.with_suffix(".wdp").unlink()
    with pytest.raises(InputError, match="its descriptors say that they are not compressed"):
        StripReader(plain)
