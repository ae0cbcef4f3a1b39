"""Fill between two recordings of a packet, and before the first: no samples for anything that reads waveforms.

Packets that are filled up with zeros behind what was recorded.

Packed samples, inverted waveforms, and samples of a strip that do not depend on the order of its points.
"""

import json
import struct
from dataclasses import replace

import laspy
import numpy as np
import pytest
from batch_tools import run_one
from commands import run_command, succeed
from helpers_scenes import simulated
from strips import descriptor, make_raw, read_all

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.files.las.header import read_header
from wavebatch.files.strip.packet_check import packed_bytes
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.signal.runs import gap_distance
from wavebatch.kernels.signal.signal import LEAST_LEVEL, find_fill, quiet_fill, recorded_lengths
from wavebatch.stages.chain import STAGES, load_profile
from wavebatch.stages.noise import pooled, tail
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.tools.compare_chains import measure_fit
from wavebatch.tools.plots.waveform import build_views
from wavebatch.tools.scan_slices import _shape
from wavebatch.tools.simulate import StripOptions, simulate_strip
from wavebatch.tools.voxels.rays import Deconvolution, deconvolve_block

DETECTORS = sorted(name for name, stage in STAGES.items() if name.startswith("detect."))
DECOMPOSERS = sorted(name for name in STAGES if name.startswith("decompose.") and name != "decompose.none")
GAP = slice(30, 54)


def spell(text):
    """Counts from "12x20 0x8": so many of each."""
    pairs = [part.split("x") for part in text.split()]
    return np.concatenate([np.full(int(number), int(count), np.uint8) for count, number in pairs])


@pytest.mark.parametrize(("text", "runs"), [
    ("12x20 0x8 12x20", [(20, 28)]), ("12x20 0x7 12x20", []), ("0x10 12x30", [(0, 10)]), ("12x30 0x10", [(30, 40)]),
    ("12x20 0x8 12x16 0x9 12x20", [(20, 28), (44, 53)]),
    # Too little is recorded on one side of one run: none of the waveform is sure.
    ("12x15 0x8 12x20", []), ("12x16 0x8 12x20", [(16, 24)]), ("12x20 0x8 12x15", []), ("12x20 0x8 12x15 0x9", []),
    ("12x20 0x8 12x20 0x8 12x15", []),
    # Not within one sample from zero to three quarters of the level; and at half of the edges quite.
    ("12x19 9x1 0x8 12x20", [(20, 28)]), ("12x19 8x1 0x8 12x20", []), ("12x20 0x8 90x4 12x20", [(20, 28)]),
    ("12x19 9x1 0x8 9x1 12x20", []), ("12x19 9x1 0x8 12x18 9x1 0x8 12x20", [(20, 28), (47, 55)]),
    ("12x20 0x8 9x1 12x17 9x1 0x8 9x1 12x17 9x1 0x8 12x20", []),
    ("102x20 100x3 102x3 80x1 0x8 80x1 102x3 100x3 102x20", []),
    ("20x8 16x8 0x8 15x1 20x20", [(16, 24)]), ("20x16 0x8 14x1 20x20", []),
    # Another sample near zero, beside a level far from it and beside a low, steady one with few zeros.
    ("12x20 2x1 12x17 0x8 12x20", []), ("12x20 3x1 12x17 0x8 12x20", [(38, 46)]),
    ("6x10 2x1 6x16 0x8 6x20", []), ("5x10 2x1 5x16 0x8 5x20", [(27, 35)]), ("2x20 0x8 2x20", [(20, 28)]),
    ("2x10 0x4 2x16 0x8 2x10 2x6", [(30, 38)]), ("2x10 0x5 2x16 0x8 2x10 2x6", []),
    ("2x10 6x3 2x7 0x8 2x20", []), ("2x10 5x3 2x7 0x8 2x20", [(20, 28)]), ("2x10 9x2 2x8 0x8 2x20", [(20, 28)]),
    ("2x100 0x4 2x1 0x4 2x1 0x4 2x2 0x8 2x40", []), ("2x20 0x8 2x15", []), ("2x20 0x8", [(20, 28)]),
    ("2x15 0x8 2x20", []),
    # From the largest count nearly to the level within one sample.
    ("12x20 255x8 12x20", [(20, 28)]), ("12x20 255x7 12x20", []), ("255x9 12x30", [(0, 9)]), ("12x15 255x8 12x20", []),
    ("12x19 27x1 255x8 12x20", [(20, 28)]), ("12x19 28x1 255x8 12x20", []),
    ("12x20 255x8 12x16 0x8", [(20, 28), (44, 52)]),
    ("120x19 127x1 255x8 120x20", [(20, 28)]), ("120x19 128x1 255x8 120x20", []),
    ("12x20 254x8 12x20", []), ("0x60", []), ("255x60", []),
])  # fmt: skip
def test_fill_is_what_a_waveform_steps_to_within_a_sample(text, runs):
    samples = spell(text)
    expected = np.zeros(len(samples), bool)
    for start, end in runs:
        expected[start:end] = True
    for dtype, top in ((np.uint8, 255), (np.uint16, 65_535)):
        counts = np.where(samples == 255, top, samples).astype(dtype)
        if dtype == np.uint16 and 255 in samples:
            counts = np.where(counts == top, top, counts * 257).astype(dtype)
        found = find_fill(np.stack([counts, np.full_like(counts, 90)]), top)
        assert (found is None) == (not runs)
        if runs:
            assert np.array_equal(found[0], expected) and not found[1].any()
            quiet = quiet_fill(counts[None], expected[None])[0]
            assert np.array_equal(quiet[~expected], counts[~expected])
            assert (quiet[expected] == np.sort(counts[~expected])[(~expected).sum() // 4]).all()


def test_clipped_echoes_and_waveforms_cut_at_a_threshold_are_no_fill():
    time = np.arange(120)
    for width in (1.5, 2.0, 4.0, 8.0):
        for amplitude in np.geomspace(300, 1e5, 12):
            for centre in np.arange(60, 61, 0.1):
                pulse = amplitude * np.exp(-0.5 * ((time - centre) / width) ** 2)
                clipped = np.rint(12 + pulse).clip(0, 255).astype(np.uint8)[None]
                assert find_fill(clipped, 255) is None
                assert find_fill(255 - clipped, 255) is None
                for level in (3, 8):
                    cut = np.where(pulse < level, 0, pulse).clip(0, 255).astype(np.uint8)[None]
                    assert find_fill(cut, 255) is None
    assert find_fill(np.full((3, 60), 255, np.uint8), 255) is None
    assert find_fill(np.zeros((3, 60), np.uint8), 255) is None


def cut(source, target, fill, shift=0):
    """A copy of a strip of 80 samples of 8 bits with fill in GAP, and another level after it."""
    content = np.frombuffer(source.read_bytes(), np.uint8).copy()
    packets = content[read_header(source).waveform_start + 60 :].reshape(-1, 80)
    packets[:, GAP] = fill
    packets[:, GAP.stop :] = np.clip(packets[:, GAP.stop :].astype(int) + shift, 0, 255)
    target.write_bytes(content.tobytes())
    return target


whole = simulated("whole.las", "mixed", pulses=5000, seed=21, options=StripOptions(point_format=4))


def read_block(path):
    with StripReader(path) as reader, reader.scan() as scan:
        assert not scan.notes
        (block,) = reader.sample_blocks(scan, 5000, 5000)
        return block, survey_blocks(read_sample(reader, scan)).system


@pytest.mark.slow
@pytest.mark.quick_cases("255")
@pytest.mark.parametrize("fill", [0, 255])
def test_readers_mark_fill_and_put_quiet_counts_there(whole, tmp_path, fill):
    plain, _ = read_block(whole)
    block, _ = read_block(cut(whole, tmp_path / "cut.las", fill))
    assert plain.missing is None
    known = block.missing.any(axis=1)
    # Waveforms whose recordings end within an echo are not sure to be seen for the largest count.
    assert known.mean() > (0.99 if fill == 0 else 0.65)
    assert (block.missing[known] == (np.arange(80) // GAP.stop == 0) & (np.arange(80) >= GAP.start)).all()
    recorded = ~block.missing[known]
    assert np.array_equal(block.samples[known][recorded], plain.samples[known][recorded])
    assert block.samples[known][:, GAP].max() < 200 and block.samples[known][:, GAP].min() >= LEAST_LEVEL
    assert not block.samples.flags.writeable and np.array_equal(block.rows(slice(3, 9)).missing, block.missing[3:9])


_KNOWN = {}


def two_levels(whole, tmp_path, shift=0):
    """Waveforms without and with a gap; the survey of the first and of the second. Read once per level."""
    if shift not in _KNOWN:
        plain, system = read_block(whole)
        block, found = read_block(cut(whole, tmp_path / f"cut{shift}.las", 0, shift))
        rows = np.flatnonzero(block.missing.any(axis=1))
        _KNOWN[shift] = plain.rows(rows), block.rows(rows), system, found
    return _KNOWN[shift]


def away_from_gap(block, table, widths):
    distance = np.maximum(GAP.start - 1 - table.time / block.spacing, table.time / block.spacing - GAP.stop)
    return table.take(np.flatnonzero(distance > widths))


@pytest.mark.quick_cases("0-detect.[!a]*")
@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("shift", [0, 7])
def test_detectors_find_nothing_in_gaps_and_at_their_edges(whole, tmp_path, name, shift):
    plain, block, system, _ = two_levels(whole, tmp_path, shift)
    function = STAGES[name].function
    # Waveforms without signal in and around the gap must have no candidates there.
    before = function(plain, pooled(plain, system), system)
    after = function(block, pooled(block, system), system)
    ref = system.sigma_ref / block.spacing
    near = np.zeros(len(block), bool)
    low, high = GAP.start - 4 * ref, GAP.stop + 4 * ref
    signal = plain.samples - pooled(plain, system).level
    around = slice(int(low - 6), int(high + 6))
    near |= (signal[:, around] > 4.5 * system.noise.std).any(axis=1)
    position = after.time / block.spacing
    inside = (position > low) & (position < high) & ~near[after.waveform]
    assert np.count_nonzero(~near) > 150
    # Noise alone has candidates for some detectors; edges of the gap must not add to them.
    position = before.time / block.spacing
    noise = (position > low) & (position < high) & ~near[before.waveform]
    assert np.count_nonzero(inside) <= np.count_nonzero(noise) + 2
    assert (gap_distance(block.missing, after.waveform, after.time / block.spacing) > -1.01).all()
    # Far from the gap both find the same.
    first, second = away_from_gap(plain, before, 8 * ref), away_from_gap(block, after, 8 * ref)
    assert abs(len(first) - len(second)) <= 0.03 * len(first)


@pytest.mark.slow
@pytest.mark.quick_cases("7-decompose.adaptive", "7-decompose.gaussian", "0-decompose.[!alg]*", "0-decompose.asdf_only")
@pytest.mark.parametrize("name", DECOMPOSERS)
@pytest.mark.parametrize("shift", [0, 7])
def test_decomposers_find_the_same_echoes_as_without_a_gap(whole, tmp_path, name, shift):
    plain, block, system, _ = two_levels(whole, tmp_path, shift)
    tables = []
    for one in (plain, block):
        noise = pooled(one, system)
        candidates = STAGES["detect.maximum"].function(one, noise, system)
        tables.append(STAGES[name].function(one, noise, system, candidates))
    position = tables[1].time / block.spacing
    width = tables[1].sigma / block.spacing
    distance = gap_distance(block.missing, tables[1].waveform, position)
    # Between two recorded samples an echo is known, however narrow it is.
    assert (distance >= -np.maximum(0.5 * width, 1.0) - 1e-3).all() or name == "decompose.asdf_only"
    close = distance < width
    flagged = (tables[1].flags & int(EchoFlag.NEAR_EDGE)) != 0
    assert flagged[close].all()
    far = [away_from_gap(one, table, 16) for one, table in zip((plain, block), tables, strict=True)]
    assert abs(len(far[0]) - len(far[1])) <= 0.02 * len(far[0]) and len(far[0]) > 500
    number = [table.count(len(block)) for table in far]
    alike = number[0] == number[1]
    assert alike.mean() > 0.97
    one, other = (table.take(np.flatnonzero(alike[table.waveform])) for table in far)
    for name in ("time", "amplitude", "sigma"):
        change = np.abs(getattr(one, name) - getattr(other, name)) / getattr(one, f"{name}_err")
        # With a level of its own a short recording has the error of a few quiet samples.
        usual, large = (0.25, 0.5) if shift == 0 else (0.4, 1.5)
        assert np.nanquantile(change, 0.5) < usual and np.nanquantile(change, 0.9) < large


@pytest.mark.slow
def test_recordings_of_different_level_have_their_own_baseline(whole, tmp_path):
    for shift in (0, 7):
        plain, block, system, found = two_levels(whole, tmp_path, shift)
        noise = pooled(block, system)
        if shift == 0:
            assert noise.of_sample is None or (noise.of_sample != noise.baseline[:, None]).any(axis=1).mean() < 0.01
            continue
        error = noise.level - pooled(plain, system).level
        for part, true in ((slice(0, GAP.start), 0), (slice(GAP.stop, 80), 7)):
            off = np.abs(error[:, part].mean(axis=1) - true)
            # Where an echo fills a recording its level is that of its lowest samples.
            assert np.median(off) < 0.4 and np.quantile(off, 0.9) < 2.5
        assert np.array_equal(noise.rows(np.arange(5)).level, noise.level[:5])
        # Where an echo fills a recording its level is off, which counts as noise (docs/algorithms.md 9).
        assert 0.9 * system.noise.std < found.noise.std < 2.5 * system.noise.std
        assert found.sigma_ref == pytest.approx(system.sigma_ref, rel=0.03)


def test_the_tail_is_that_of_recorded_samples():
    rng = np.random.default_rng(1)
    samples = np.rint(20 + rng.normal(0, 2, (50, 60))).astype(np.uint8)
    block = WaveformBlock.from_samples(samples)
    longer = WaveformBlock.from_samples(np.pad(samples, ((0, 0), (0, 20)), constant_values=90))
    longer = replace(longer, missing=np.arange(80) >= np.full((50, 1), 60))
    system = SystemPulse(sigma_ref=2.0, noise=ReceiverNoise(std=0.5))
    one, other = tail(block, system), tail(longer, system)
    assert np.allclose(one.baseline, other.baseline) and np.allclose(one.std, other.std)


def test_tools_leave_gaps_out(whole, tmp_path):
    plain, block, system, _ = two_levels(whole, tmp_path)
    chain = load_profile("balanced")
    profiles = deconvolve_block(block, system, Deconvolution())
    assert not profiles.value[block.missing].any() and profiles.seen.mean() > 0.3
    values = _shape(block)[1]["value"].reshape(len(block), -1)
    assert np.isnan(values[block.missing]).all() and not np.isnan(values[~block.missing]).any()
    views = build_views(block.rows(slice(0, 40)), chain, system, list(range(40)))
    for view in views:
        assert np.array_equal(np.isnan(view.samples), block.missing[0]) and np.isnan(view.residual[GAP]).all()
        assert np.isnan(view.fit).any() and view.level.shape == view.samples.shape
    noise, echoes = pooled(block, system), chain.run(block, system)
    misfit, floor = measure_fit(block, noise, system, chain.steps[2], echoes)
    full = measure_fit(plain, pooled(plain, system), system, chain.steps[2], chain.run(plain, system))
    assert np.nanmedian(misfit / floor) == pytest.approx(np.nanmedian(full[0] / full[1]), rel=0.2)


@pytest.mark.slow
def test_a_strip_with_gaps_runs_and_pictures_show_them(whole, tmp_path):
    strip = cut(whole, tmp_path / "gaps.las", 0, 7)
    assert run_one(strip, tmp_path).status == "written"
    report = json.loads((tmp_path / "gaps.report.json").read_text("utf-8"))
    assert report["counts"]["echoes"] > 1500
    for options in ([], ["--sheet"]):
        target = tmp_path / f"a{len(options)}.png"
        arguments = ["plot", "waveform", str(strip), "--random", "2", "-o", str(target), *options]
        succeed(*arguments)
    text = run_command("info", strip).stdout
    assert "with fill between recordings" in text


@pytest.mark.parametrize(("number", "apart"), [(8, True), (9, False)])
def test_waveforms_of_many_recordings_keep_one_level(number, apart):
    """Each recording is looked at in the length of the waveform: thousands of them would take all memory."""
    length = 20
    level = np.where(np.arange(number) == 1, 40.0, 12.0).repeat(length)
    samples = np.random.default_rng(2).normal(level, 1.0, (5, number * length)).round().astype(np.uint8)
    missing = np.broadcast_to(np.arange(number * length) % length < 4, samples.shape)
    block = replace(WaveformBlock.from_samples(samples), missing=missing)
    noise = pooled(block, SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, std=1.0)))
    assert (noise.of_sample is not None) == apart


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
def test_only_zeros_below_a_level_that_never_reaches_them_are_padding(dtype):
    lengths = {"12x40 0x8": 40, "12x41 0x7": 48, "12x16 0x32": 16, "12x15 0x33": 48, "12x20 3x1 12x19 0x8": 40,
               "12x20 2x1 12x19 0x8": 48, "12x48": 48, "0x48": 48, "0x8 12x40": 48,
               "12x30 0x8 12x2 0x8": 48}  # fmt: skip
    samples = np.stack([spell(text) for text in lengths]).astype(dtype)
    assert recorded_lengths(samples).tolist() == list(lengths.values())
    for short in (samples[:, -20:], samples[:0], samples[:, :1]):
        assert (recorded_lengths(short) == short.shape[1]).all()


def pad(source, target, end):
    """A copy of a strip whose packets (of bytes) are zero from sample end(n) on; recorded samples of each point's."""
    content = bytearray(source.read_bytes())
    (start,) = struct.unpack_from("<Q", content, 227)
    with StripReader(source) as reader:
        scan = reader.scan()
        unit = reader.read_unit(0, scan)
        scan.close()
    packets, ends = unit.packets, end(len(unit.packets))
    for offset, number, stop in zip(packets.offset.tolist(), packets.n_samples.tolist(), ends.tolist(), strict=True):
        content[start + offset + stop : start + offset + number] = bytes(number - stop)
    target.write_bytes(content)
    return np.append(ends, 0)[unit.packet_of_point]


@pytest.mark.quick_cases("one length")
@pytest.mark.parametrize("kind", ["one length", "many lengths"])
def test_padded_strips_lose_nothing_of_what_was_recorded(tmp_path, kind):
    whole, padded = tmp_path / "whole.las", tmp_path / "padded.las"
    simulate_strip("mixed", whole, pulses=3000, seed=11, options=StripOptions(point_format=4))
    rng = np.random.default_rng(12)
    ends = pad(whole, padded, lambda n: np.full(n, 64) if kind == "one length" else rng.integers(50, 81, n))
    succeed("run", padded, "-o", tmp_path, "--points", "returns", "-q")
    report = json.loads((tmp_path / "padded.report.json").read_text("utf-8"))
    recorded = laspy.read(padded).return_point_wave_location / 1000 < ends - 8
    found = (laspy.read(tmp_path / "padded.laz").echo_flags & int(EchoFlag.NO_ECHO)) == 0
    assert 0.5 < recorded.mean() < 1 and found[recorded].mean() > 0.98
    assert report["counts"]["added_echoes"] < 0.15 * report["counts"]["echoes"]


def pack(samples, bits, little):
    """Bytes of samples (n, s) one behind the other, bit by bit."""
    n, s = samples.shape
    order = np.arange(bits) if little else np.arange(bits)[::-1]
    stream = ((samples[:, :, None] >> order) & 1).astype(np.uint8).reshape(n, s * bits)
    return np.packbits(stream, axis=1, bitorder="little" if little else "big")


def smooth_counts(rng, n, s, bits):
    time = rng.uniform(10, s - 10, (n, 1))
    pulse = 0.7 * (1 << bits) * np.exp(-0.5 * ((np.arange(s) - time) / 2.5) ** 2)
    return np.rint(0.05 * (1 << bits) + pulse + rng.normal(0, 2, (n, s))).astype(np.int64)


def packed_strip(path, rng, bits, little, s=41):
    raw = make_raw(60, n_samples=s, bits=16)
    samples = smooth_counts(rng, 60, s, bits)
    rows = pack(samples, bits, little)
    width = rows.shape[1]
    raw.points["wavepacket_offset"] = 60 + (raw.points["wavepacket_offset"] - 60) // (2 * s) * width
    raw.points["wavepacket_size"] = width
    raw.packets = rows.tobytes()
    raw.vlrs = [descriptor(1, bits=bits, samples=s)]
    return raw.write(path), samples


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("little", [False, True])
def test_packed_strips_are_read_in_the_order_that_is_smoother(tmp_path, rng, bits, little):
    path, samples = packed_strip(tmp_path / "a.las", rng, bits, little)
    found = read_all(path)
    for (_, offset), (values, *_) in found.items():
        assert np.array_equal(values, samples[(offset - 60) // packed_bytes(41, bits)])
    with StripReader(path) as reader, reader.scan() as scan:
        (block,) = reader.sample_blocks(scan, 100)
        assert block.digitizer.bits == bits and block.samples.dtype == np.uint16
        assert f"packed, {'lowest' if little else 'highest'} bit first" in scan.notes[0]
    for command in ("info", "check"):
        assert f"samples of {bits} bits are packed" in run_command(command, path).stdout


@pytest.mark.parametrize(
    ("bits", "kind", "level", "scale", "said"),
    [(16, ">u2", 0, 3, "bytes in the other order"), (32, ">u4", 0, 1000, "bytes in the other order"),
     (32, "<f4", 0, 1e-3, "floating-point"), (32, "<f4", 200, 1, "floating-point"), (32, "<u4", 0, 1 << 20, ""),
     (32, "<u4", 900, 1 << 20, ""), (16, "<u2", 0, 16, ""), (16, "<u2", 0, 256, "")],
)  # fmt: skip
def test_samples_that_are_no_unsigned_integers_are_said(tmp_path, rng, bits, kind, level, scale, said):
    """Not counts that were shifted up, with a mark of clipped ones, or that are as large as the bits of floats."""
    raw, counts = make_raw(60, n_samples=40, bits=bits), level + smooth_counts(rng, 60, 40, 8)
    clipped = (counts > 194) & (scale == 256)
    raw.packets = np.where(clipped, 65_535, counts * scale).astype(kind).tobytes()
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        assert [code for line, code in scan.doubts.items() if "seem to" in line] == ["packets"] * bool(said)
        assert said in " ".join(scan.warnings)


@pytest.mark.parametrize("count", [0, 2, 40, 255])
@pytest.mark.parametrize("place", [slice(10), slice(-10, None)])
def test_fill_with_other_counts_is_said(tmp_path, rng, count, place):
    """Of a forest that was filled up with 20 over a level of 12 half of the echoes were false, in silence."""
    raw, samples = make_raw(60, n_samples=60), smooth_counts(rng, 60, 60, 8)
    raw.packets = samples.astype("u1").tobytes()
    samples[::2, place] = count
    raw.packets = samples.astype("u1").tobytes()
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        doubts = scan.doubts
    assert list(doubts.values()) == ["packets"] * (count not in (0, 255))
    assert all(f"30 of 60 packets that were looked at begin or end with equal counts of {count}," in k for k in doubts)


def test_a_threshold_is_no_fill(tmp_path, rng):
    """Where samples below a threshold have one count, echoes at an end of their packet step from it, too."""
    raw, samples = make_raw(90, n_samples=60), smooth_counts(rng, 90, 60, 8)
    samples[samples < 20] = 12
    samples[::3] = np.where(np.arange(60) < 40, 12, np.arange(60))
    raw.packets = samples.astype("u1").tobytes()
    with StripReader(raw.write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        assert scan.doubts == {}


def mirror(source, target):
    content = np.frombuffer(source.read_bytes(), np.uint8).copy()
    start = read_header(source).waveform_start + 60
    content[start:] = 255 - content[start:]
    target.write_bytes(content.tobytes())
    return target


upright = simulated("up.las", "mixed", pulses=2500, seed=3, options=StripOptions(point_format=4))


def test_inverted_waveforms_give_the_echoes_of_upright_ones(upright, tmp_path):
    down = mirror(upright, tmp_path / "down.las")
    with StripReader(upright) as one, one.scan() as a, StripReader(down) as two, two.scan() as b:
        assert not a.forms and b.forms[1].inverted and "the signal goes down" in b.notes[0]
        (first,), (second,) = one.sample_blocks(a, 500), two.sample_blocks(b, 500)
        assert np.array_equal(first.samples, second.samples)
        assert second.digitizer.inverted and second.digitizer.gain == -first.digitizer.gain
        volts = first.digitizer.offset + first.digitizer.gain * 255 - first.digitizer.gain * 0
        assert second.digitizer.offset == pytest.approx(volts)
        assert survey_blocks(read_sample(two, b)).figures.inverted == 1.0
    reports = []
    for strip in (upright, down):
        assert run_one(strip, tmp_path).status == "written"
        reports.append(json.loads((tmp_path / f"{strip.stem}.report.json").read_text("utf-8")))
    assert reports[0]["counts"] == reports[1]["counts"] and reports[1]["counts"]["echoes"] > 2000
    assert any("the signal goes down" in line for line in reports[1]["remarks"])
    text = run_command("survey", down).stdout
    assert "inverted waveforms" in text
    info = json.loads(run_command("info", down, "--json").stdout)
    assert info["packets"]["descriptors"][0]["inverted"] is True and not info["warnings"]


def test_a_negative_gain_alone_means_inverted_unless_the_counts_go_up(upright, tmp_path):
    raw = make_raw(10, most_returns=1)
    raw.packets = np.full(320, 200, np.uint8).tobytes()
    raw.vlrs = [descriptor(1, gain=-0.5)]
    with StripReader(raw.write(tmp_path / "flat.las")) as reader, reader.scan() as scan:
        (block,) = reader.sample_blocks(scan, 10)
        assert (block.samples == 55).all() and "its gain is negative" in scan.notes[0]

    content = upright.read_bytes()
    at = content.index(np.float64(1.0).tobytes(), content.index(b"wave packet descriptor"))
    changed = tmp_path / "negative.las"
    changed.write_bytes(content[:at] + np.float64(-1.0).tobytes() + content[at + 8 :])
    with StripReader(changed) as reader, reader.scan() as scan:
        assert reader.facts.digitizers[1].gain == -1.0
        assert not scan.forms[1].inverted and "go up" in scan.notes[0]


def test_shuffled_points_give_the_same_sample_and_survey(upright, tmp_path, edit_points):
    shuffled = edit_points(upright, tmp_path / "s.las", lambda p: p[np.random.default_rng(5).permutation(len(p))])
    surveys, samples = [], []
    for path in (upright, shuffled):
        with StripReader(path) as reader, reader.scan() as scan:
            blocks = list(reader.sample_blocks(scan, 700))
            samples.append(np.concatenate([block.samples for block in blocks]))
            surveys.append(survey_blocks(read_sample(reader, scan, 700)))
    assert np.array_equal(*samples)
    assert surveys[0].figures == surveys[1].figures and surveys[0].system == surveys[1].system
