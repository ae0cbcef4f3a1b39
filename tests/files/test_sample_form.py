"""Packed samples, inverted waveforms, and samples of a strip that do not depend on the order of its points."""

import json

import numpy as np
import pytest
from batch_tools import run_one
from commands import run_command
from strips import descriptor, make_raw, read_all

from wavebatch.files.las.header import read_header
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.sample_form import packed_bytes, unpack_samples
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.tools.simulate import StripOptions, simulate_strip


def pack(samples, bits, little):
    """Bytes of samples (n, s) one behind the other, bit by bit."""
    n, s = samples.shape
    order = np.arange(bits) if little else np.arange(bits)[::-1]
    stream = ((samples[:, :, None] >> order) & 1).astype(np.uint8).reshape(n, s * bits)
    return np.packbits(stream, axis=1, bitorder="little" if little else "big")


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("little", [False, True])
@pytest.mark.parametrize("s", [1, 7, 32])
def test_unpacked_samples_are_those_that_were_packed(rng, bits, little, s):
    samples = rng.integers(0, 1 << bits, (20, s))
    rows = pack(samples, bits, little)
    assert rows.shape[1] == packed_bytes(s, bits)
    found = unpack_samples(rows, s, bits, little)
    assert found.dtype == np.uint16 and np.array_equal(found, samples)


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


def mirror(source, target):
    content = np.frombuffer(source.read_bytes(), np.uint8).copy()
    start = read_header(source).waveform_start + 60
    content[start:] = 255 - content[start:]
    target.write_bytes(content.tobytes())
    return target


@pytest.fixture(scope="module")
def upright(tmp_path_factory):
    path = tmp_path_factory.mktemp("form") / "up.las"
    simulate_strip("mixed", path, pulses=2500, seed=3, options=StripOptions(point_format=4))
    return path


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


def test_noise_and_uniform_counts_are_not_inverted(tmp_path):
    with StripReader(make_raw(200).write(tmp_path / "a.las")) as reader, reader.scan() as scan:
        assert not scan.forms


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
