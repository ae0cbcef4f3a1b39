"""Where packets are looked for, what is refused, and how samples are fetched."""

import struct

import numpy as np
import pytest
from strips import descriptor, make_raw, read_all, read_plainly, record_head, vlr
from writer_tools import data_file

from wavebatch.core.errors import InputError
from wavebatch.files.strip import packets
from wavebatch.files.strip.packets import PacketFile, PacketPlace
from wavebatch.files.strip.reader import StripReader


def refused(path, pattern, **options):
    with pytest.raises(InputError, match=pattern) as caught, StripReader(path, **options) as reader:
        reader.scan()
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text
    return text


def plain_of(raw, bits=8, samples=32):
    return read_plainly(raw.points, bytes(60) + raw.packets, {1: (bits, samples)})


def assert_read(path, raw, **options):
    found = read_all(path, **options)
    plain = plain_of(raw)
    assert found.keys() == plain.keys()
    for key, (samples, members) in plain.items():
        np.testing.assert_array_equal(found[key][0], samples)
        assert found[key][1] == members


def test_a_missing_wdp_is_named(tmp_path):
    path = make_raw(internal=False).write(tmp_path / "a.las")
    path.with_suffix(".wdp").unlink()
    assert "put a.wdp next to the strip" in refused(path, "packets are missing")


def test_upper_case_wdp_is_found(tmp_path):
    raw = make_raw(internal=False)
    path = raw.write(tmp_path / "a.las")
    path.with_suffix(".wdp").rename(tmp_path / "a.WDP")
    assert_read(path, raw)


@pytest.mark.parametrize("head", [
    record_head(0, reserved=0xAABB),
    record_head(0),
    record_head(0, user=b"LAS_Spec"),
])  # fmt: skip
def test_wdp_headers_in_the_field_are_taken(tmp_path, head):
    raw = make_raw(internal=False)
    raw.head = head
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert reader.facts.warnings == ()


def test_a_wdp_whose_length_lies_is_read_to_its_end_and_said_so(tmp_path):
    raw = make_raw(internal=False)
    raw.head = record_head(2**63)
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert "claims 9223372036854775808 bytes" in reader.facts.warnings[0]


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
    assert "--headerless" in refused(path, "does not begin with the 60-byte header")
    assert_read(path, raw, headerless=True)
    with StripReader(path, headerless=True) as reader:
        assert (reader.facts.packets.base, reader.facts.packets.start) == (-60, 0)


def test_headerless_wdp_whose_offsets_count_from_zero(tmp_path):
    raw = make_raw(internal=False)
    raw.head = b""
    raw.points["wavepacket_offset"] -= 60
    path = raw.write(tmp_path / "a.las")
    found = read_all(path, headerless=True)
    plain = read_plainly(raw.points, raw.packets, {1: (8, 32)})
    assert found.keys() == plain.keys()
    assert all((found[key][0] == plain[key][0]).all() for key in plain)


def test_forcing_headerless_does_not_hurt_a_good_wdp(tmp_path):
    raw = make_raw(internal=False)
    assert_read(raw.write(tmp_path / "a.las"), raw, headerless=True)


def test_an_empty_wdp_is_refused(tmp_path):
    path = make_raw(internal=False).write(tmp_path / "a.las")
    path.with_suffix(".wdp").write_bytes(b"")
    refused(path, "does not begin with")


def test_compressed_packets_are_refused_with_what_to_run(tmp_path):
    raw = make_raw()
    raw.vlrs = [descriptor(1, compression=2)]
    assert "laszip -i a.las" in refused(raw.write(tmp_path / "a.las"), "compressed")
    raw.vlrs = [descriptor(1, compression=2), descriptor(2)]
    assert "laszip -i b.las" in refused(raw.write(tmp_path / "b.las"), "compressed")


def test_compression_of_a_descriptor_that_nobody_uses_does_no_harm(tmp_path):
    raw = make_raw()
    raw.vlrs.append(descriptor(2, compression=1))
    assert_read(raw.write(tmp_path / "a.las"), raw)


def test_compatibility_mode_is_refused(tmp_path):
    raw = make_raw()
    raw.vlrs.append(vlr(b"lascompatible", 22204, bytes(156)))
    refused(raw.write(tmp_path / "a.las"), "compatibility mode")


def test_bits_that_cannot_be_read_are_refused(tmp_path):
    raw = make_raw()  # of 32 bytes, but 32 samples of 12 bits have 48 or 64
    raw.vlrs = [descriptor(1, bits=12, samples=32)]
    message = "no packet can be used.*neither whole bytes nor packed samples.*with 8, 16 or 32 bits"
    refused(raw.write(tmp_path / "a.las"), message)


def test_both_places_at_once_are_refused(tmp_path):
    raw = make_raw()
    raw.encoding = 6
    refused(raw.write(tmp_path / "a.las"), "bits 1 and 2")


def test_neither_place_falls_back_and_says_so(tmp_path):
    raw = make_raw()
    raw.encoding = 0
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert "read from the record in the file" in reader.facts.warnings[0]
    raw = make_raw(internal=False)
    raw.encoding = 0
    path = raw.write(tmp_path / "b.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert "read from b.wdp" in reader.facts.warnings[0]
    path.with_suffix(".wdp").unlink()
    refused(path, "neither in the file nor next to it: put b.wdp")


def test_a_lost_pointer_is_found_among_the_evlrs(tmp_path):
    raw = make_raw(point_format=9)
    raw.waveform_start = 0
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert "found as an EVLR" in reader.facts.warnings[0]


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


def test_a_1_3_record_that_claims_too_little_is_read_to_the_end_of_the_file(tmp_path):
    raw = make_raw()
    raw.head = record_head(100, user=b"LAS_Spec", reserved=0xAABB)
    path = raw.write(tmp_path / "a.las")
    assert_read(path, raw)
    with StripReader(path) as reader:
        assert "claims 100 bytes, 1280 are there" in reader.facts.warnings[0]


@pytest.mark.parametrize("start", [1, 300, 10**6, 2**63, 2**64 - 1])
def test_a_wrong_pointer_is_refused(tmp_path, start):
    raw = make_raw()
    raw.waveform_start = start
    refused(raw.write(tmp_path / "a.las"), "record")


def test_a_pointer_at_something_else_is_refused(tmp_path):
    raw = make_raw()
    raw.head = record_head(0, record_id=1234)
    refused(raw.write(tmp_path / "a.las"), "no waveform record at byte")


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


@pytest.mark.parametrize("name", ["fullwave", "pdrf10-1.4", "pdrf4-1.3", "pdrf5-1.3", "pdrf9-1.4", "pdrf9-1.5"])
def test_strips_without_packets_get_one_line(name):
    refused(data_file(f"no-packets/{name}.laz"), "packets")


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


def test_a_block_of_huge_waveforms_is_kept_small():
    assert packets.block_rows(4096, 65_536, 32) * 65_536 * 4 <= packets.BLOCK_BYTES
    assert packets.block_rows(4096, 100, 8) == 4096
