"""Packets that are filled up with zeros behind what was recorded."""

import json
import struct

import laspy
import numpy as np
import pytest
from commands import run_command

from wavebatch.core.echoes import EchoFlag
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.signal.signal import LEAST_LEVEL, LEAST_PADDING, LEAST_RECORDED, recorded_lengths
from wavebatch.tools.simulate import StripOptions, simulate_strip


def naive_length(waveform):
    end = len(waveform)
    while end and waveform[end - 1] == 0:
        end -= 1
    real = waveform[:end].tolist()
    padded = len(waveform) - end >= LEAST_PADDING and end >= LEAST_RECORDED and min(real) >= LEAST_LEVEL
    return end if padded else len(waveform)


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
def test_only_zeros_below_a_level_that_never_reaches_them_are_padding(rng, dtype):
    samples = (12 + rng.normal(0, 2, (300, 48))).clip(0).astype(dtype)
    samples[100:200] = (rng.normal(0, 2, (100, 48))).clip(0).astype(dtype)
    for row, end in enumerate(rng.integers(0, 49, 300)):
        samples[row, end:] = 0
    expected = [naive_length(row) for row in samples]
    assert recorded_lengths(samples).tolist() == expected
    assert sum(length < 48 for length in expected[:100]) > 30 and set(expected[100:200]) == {48}
    for short in (np.zeros((3, 48), dtype), samples[:, :20], samples[:0], samples[:, :1]):
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
    result = run_command("run", padded, "-o", tmp_path, "--points", "returns", "-q")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "padded.report.json").read_text("utf-8"))
    recorded = laspy.read(padded).return_point_wave_location / 1000 < ends - 8
    found = (laspy.read(tmp_path / "padded.laz").echo_flags & int(EchoFlag.NO_ECHO)) == 0
    assert 0.5 < recorded.mean() < 1 and found[recorded].mean() > 0.98
    assert report["counts"]["added_echoes"] < 0.15 * report["counts"]["echoes"]
