"""PulseWaves files: header, descriptors and segments, and files that are cut or lie."""

import itertools
import struct

import numpy as np
import pytest
from commands import refuses
from pulse_files import Pulse, PulseFile, Sampling, bell

from wavebatch.core.errors import InputError
from wavebatch.files.pulsewaves_file import PulseReader, read_pulse_header

VARIED = (
    Sampling(kind=1, duration_bits=32, scale=0.25, length_bits=8),
    Sampling(channel=1, duration_bits=16, scale=0.5, offset=100.0, segment_bits=8, bits=16, spacing=2.0),
    Sampling(channel=2, duration_bits=0, offset=7.0, length_bits=0, samples=5, segments=2, bits=32),
)


def _write(tmp_path, rng, number=40, **more):
    """Pulses of one descriptor with all that may vary, and of another with nothing that does."""
    pulses = []
    for index in range(number):
        if index % 3 == 2:
            pulses.append(Pulse([[(0, rng.integers(0, 255, 6))], [(0, rng.integers(0, 255, 9))]], descriptor=9))
            continue
        sent = [(int(rng.integers(-99, 99)), rng.integers(0, 255, int(rng.integers(3, 20))))]
        near = [(int(rng.integers(0, 999)), rng.integers(0, 65535, int(rng.integers(0, 30)))) for _ in range(index % 4)]
        far = [(0, rng.integers(0, 2**32 - 1, 5)) for _ in range(2)]
        pulses.append(Pulse([sent, near, far], time=index))
    fixed = (Sampling(kind=1, duration_bits=0, length_bits=0, samples=6, size=0),  # shorter than its fields
             Sampling(duration_bits=0, length_bits=0, samples=9, size=0))  # fmt: skip
    file = PulseFile({1: VARIED, 9: fixed}, pulses, extra=3, **more)
    return file, file.write(tmp_path / "a.pls")


def _read(path, **sizes):
    with PulseReader(read_pulse_header(path), **sizes) as reader:
        for piece in reader.pieces():
            yield from _list_segments(piece)


def _list_segments(piece):
    segments = piece.segments
    for row in range(len(segments)):
        samples = piece.samples(np.array([row]))[0].tolist() if segments.length[row] else []
        yield (piece.first + int(segments.pulse[row]), int(segments.channel[row]), float(segments.start[row]), samples)


def _expected(file):
    for number, pulse in enumerate(file.pulses):
        for sampling, segments in zip(file.descriptors[pulse.descriptor], pulse.waves, strict=True):
            for duration, samples in segments:
                start = sampling.offset + (sampling.scale * duration if sampling.duration_bits else 0.0)
                yield number, sampling.channel, start, np.asarray(samples).tolist()


@pytest.mark.parametrize("step", [1, 7, 50_000])
def test_every_segment_comes_as_it_was_written(tmp_path, rng, step):
    file, path = _write(tmp_path, rng)
    assert list(_read(path, pulses=step)) == list(_expected(file))


def test_pulses_need_not_lie_in_the_order_of_their_waves(tmp_path, rng):
    file, path = _write(tmp_path, rng)
    data = bytearray(path.read_bytes())
    start = read_pulse_header(path).start
    records = [data[start + 48 * k : start + 48 * k + 48] for k in range(40)]
    data[start : start + 48 * 40] = b"".join(records[::-1])
    path.write_bytes(data)
    turned = [(39 - pulse, *rest) for pulse, *rest in _read(path, size=200)]
    assert sorted(turned, key=lambda row: row[0]) == list(_expected(file))


def test_descriptors_and_keys_may_stand_behind_the_pulses(tmp_path, rng):
    file, path = _write(tmp_path, rng, appended=[("PulseWaves_Proj", 34735, b"\1\0" * 4), ("else", 3, b"xyz")])
    header = read_pulse_header(path)
    assert [(vlr.record_id, vlr.payload) for vlr in header.projection] == [(34735, b"\1\0" * 4)]
    assert header.source == 7 and header.system == "a sensor" and sorted(header.descriptors) == [1, 9]
    assert list(_read(path)) == list(_expected(file))


@pytest.mark.parametrize("left", [0, 10, 59, 60, 61, 200, -1])
def test_cut_waves_are_one_line(tmp_path, rng, left):
    _, path = _write(tmp_path, rng)
    waves = path.with_suffix(".wvs")
    waves.write_bytes(waves.read_bytes()[: left if left >= 0 else -1])
    refuses(InputError, r"PulseWavesWaves|are not inside the file", list, _read(path))


def test_cut_pulses_are_one_line(tmp_path, rng):
    _, path = _write(tmp_path, rng)
    data = path.read_bytes()
    for left in [0, 10, 100, 351, 352, 400, 900, len(data) - 97]:
        path.write_bytes(data[:left])
        with pytest.raises(InputError) as caught:
            list(_read(path))
        assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))


@pytest.mark.quick_cases("0")
@pytest.mark.parametrize("seed", range(3))
def test_changed_bytes_are_read_or_are_one_line(tmp_path, seed):
    rng = np.random.default_rng(seed)
    _, path = _write(tmp_path, rng, number=9)
    whole = {name: path.with_suffix(name).read_bytes() for name in (".pls", ".wvs")}
    for _ in range(150):
        for name, data in whole.items():
            data = bytearray(data)
            for at in rng.integers(0, len(data), rng.integers(1, 4)):
                data[at] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
            path.with_suffix(name).write_bytes(data)
        try:
            for _ in itertools.islice(_read(path), 10_000):
                pass
        except InputError as error:
            assert "\n" not in str(error)


def _set(path, at, form, value):
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, at, value)
    path.write_bytes(data)


def test_what_wavebatch_does_not_read_says_what_to_do(tmp_path, rng):
    _, path = _write(tmp_path, rng)
    _set(path, 204, "<I", 1)
    refuses(InputError, r"compressed PulseWaves .* pulsezip -i a.pls", read_pulse_header, path)
    _, path = _write(tmp_path, rng)
    path.with_suffix(".wvs").rename(path.with_suffix(".wvz"))
    refuses(InputError, "pulsezip", read_pulse_header, path)
    path.with_suffix(".wvz").unlink()
    refuses(InputError, r"put a\.wvs next to it", read_pulse_header, path)


@pytest.mark.parametrize(
    "sampling",
    [Sampling(bits=12), Sampling(length_bits=0, samples=1 << 20), Sampling(segments=999), Sampling(duration_bits=24),
     Sampling(spacing=float("nan")), Sampling(scale=float("inf")), Sampling(spacing=0.0)],
    ids=str,
)  # fmt: skip
def test_samplings_that_no_sensor_has_are_refused(tmp_path, sampling):
    path = PulseFile({1: [sampling]}, []).write(tmp_path / "a.pls")
    refuses(InputError, "descriptor 1", read_pulse_header, path)


def test_more_segments_than_a_sensor_has_are_damage(tmp_path):
    sampling = Sampling(segment_bits=16, duration_bits=0, length_bits=0, samples=0)
    file = PulseFile({1: [sampling]}, [Pulse([[(0, [])] * 300])])
    refuses(InputError, "pulse 0", list, _read(file.write(tmp_path / "a.pls")))


def test_a_pulse_without_its_descriptor_is_named(tmp_path):
    file = PulseFile({1: [Sampling()]}, [Pulse([[(0, bell(9, 4, 9, 1))]]), Pulse([], descriptor=5)])
    refuses(InputError, "pulse 1 refers to descriptor 5", list, _read(file.write(tmp_path / "a.pls")))
