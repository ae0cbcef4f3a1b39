"""PulseWaves into strips, and strips into repaired ones or arrays."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import fail, refuses, run_command, succeed
from naive_wdz import pack_strip
from pulse_files import Pulse, PulseFile, Sampling, bell

import wavebatch as wb
from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import check_file
from wavebatch.surveying.systems.survey_result import load_survey
from wavebatch.tools.export_strip import USER_ID, export_strip
from wavebatch.tools.import_file import ImportOptions, import_file, project_utm
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.strip import StripOptions

SENT, ECHO = Sampling(kind=1, channel=3, scale=0.01), Sampling(scale=0.5, duration_bits=32)
C = 0.149896
"""Metres per ns, one way, of the pulses here."""


def _make(tmp_path, pulses, samplings=(SENT, ECHO), name="a.pls", **more):
    return PulseFile({1: samplings}, pulses, **more).write(tmp_path / name)


def _flight(rng, number=200, fwhm=4.0, energies=None):
    """Pulses with their outgoing pulse, each at its phase, and a ground echo 1000 ns and 10 samples after it."""
    sigma = fwhm / 2.3548
    energies = np.ones(number) if energies is None else energies
    for index in range(number):
        phase = rng.uniform(-0.5, 0.5)
        sent = (-1000, np.round(bell(32, 10 + phase, 0, sigma) + rng.normal(0, 0.5, 32) + 0.5
                                + 180 * energies[index] * np.exp(-0.5 * ((np.arange(32) - 10 - phase) / sigma) ** 2)))
        echo = (2000, np.round(4 + 120 * energies[index] * np.exp(-0.5 * ((np.arange(50) - 10 - phase) / sigma) ** 2)
                               + rng.normal(0, 0.6, 50)))
        yield Pulse([[(sent[0], np.maximum(sent[1], 0))], [(echo[0], np.maximum(echo[1], 0))]],
                    time=400_000_000_000 + 10 * index, bits=index % 16, intensity=index % 250, classification=index % 7)


def _points(path):
    with StripReader(path) as reader:
        return reader.facts, reader.read_points(0, reader.facts.header.point_count), _xyz(reader)


def _xyz(reader):
    points, header = reader.read_points(0, reader.facts.header.point_count), reader.facts.header
    return np.stack([points[axis] * header.scales[k] + header.offsets[k] for k, axis in enumerate("XYZ")], axis=1)


def _blocks(path):
    with StripReader(path) as reader, reader.scan() as scan:
        return list(reader.all_blocks(scan, 4096))


@pytest.mark.parametrize("internal", [False, True])
def test_fields_positions_and_packets_come_through(tmp_path, rng, internal):
    pulses = list(_flight(rng))
    path = _make(tmp_path, pulses)
    found = import_file(path, tmp_path / "o.las", ImportOptions(internal=internal))
    assert (found.points, found.packets, found.descriptors) == (200, 200, 1)
    assert (tmp_path / "o.wdp").exists() != internal
    facts, points, xyz = _points(tmp_path / "o.las")
    assert facts.header.point_format == 9 and not facts.header.global_encoding & 1  # seconds of the week
    assert np.allclose(points["gps_time"], [p.time * 1e-6 for p in pulses], atol=1e-9)
    for name, values in (("intensity", [p.intensity for p in pulses]),
                         ("classification", [p.classification for p in pulses]),
                         ("mirror_facet", [p.bits >> 2 for p in pulses]), ("point_source_id", 7)):  # fmt: skip
        assert np.all(points[name] == values)
    flags = points["classification_flags"]
    assert np.all(flags >> 7 == [p.bits & 1 for p in pulses])
    assert np.all((flags >> 6) & 1 == [(p.bits >> 1) & 1 for p in pulses])
    assert np.all(points["bit_fields"] == 0x11)
    # The phase of the outgoing pulse is taken off: all echoes lie in one plane, where the samples lie 7 cm apart.
    height = 1000.0 - (1000 + 10) * C
    assert abs(xyz[:, 2].mean() - height) < 0.02 and xyz[:, 2].std() < 0.01
    blocks = _blocks(tmp_path / "o.las")
    samples = np.concatenate([block.samples for block in blocks])
    assert np.array_equal(samples, [p.waves[1][0][1] for p in pulses])
    away = np.concatenate([block.direction for block in blocks])
    assert np.allclose(away, [0, 0, -C], atol=1e-6)


def test_bytes_do_not_depend_on_the_pieces(tmp_path, rng):
    path = _make(tmp_path, list(_flight(rng)))
    import_file(path, tmp_path / "o.las", ImportOptions())
    import_file(path, tmp_path / "p.las", ImportOptions(), pulses=17)
    assert (tmp_path / "o.las").read_bytes() == (tmp_path / "p.las").read_bytes()
    assert (tmp_path / "o.system.toml").read_bytes() == (tmp_path / "p.system.toml").read_bytes()


@pytest.mark.parametrize("fwhm", [3.5, 6.0, 9.0])
def test_energies_and_pulse_are_those_that_were_sent(tmp_path, rng, fwhm):
    energies = 1 + 0.05 * rng.standard_normal(400)
    path = _make(tmp_path, list(_flight(rng, 400, fwhm, energies)))
    found = import_file(path, tmp_path / "o.las", ImportOptions())
    _, points, _ = _points(tmp_path / "o.las")
    for name in ("pulse_energy", "pulse_amplitude"):
        error = points[name] - energies / energies.mean()
        assert error.std() < 1.3 * points[f"{name}_err"].mean() < 0.03, name
    assert found.outgoing["energy_scatter"] == pytest.approx(energies.std(), abs=0.004)
    saved = load_survey(tmp_path / "o.system.toml").survey
    assert saved.figures.outgoing_fwhm_ns == pytest.approx(fwhm, rel=0.02)
    assert saved.system.sigma_ref * 2.35482 == pytest.approx(fwhm, rel=0.02)
    shown = run_command("survey", tmp_path / "o.las").output
    width = saved.figures.outgoing_fwhm_ns
    assert f"outgoing pulses   full width at half maximum {width:.3f} ns, as import found it" in shown


def _sent(rng, number, height, noise, top=255):
    """Pulses of energies that vary by a tenth over level ground, each at its phase."""
    energies = 1 + 0.1 * rng.standard_normal(number)
    for index, energy in enumerate(energies):
        late = np.arange(50) - 10 - rng.uniform(-0.5, 0.5)
        bell = energy * np.exp(-0.5 * (late / 1.7) ** 2)
        sent = np.clip(np.round(5 + height * bell[:32] + rng.normal(0, noise, 32)), 0, top)
        echo = np.maximum(np.round(4 + 120 * bell + rng.normal(0, 0.6, 50)), 0)
        time, x = 400_000_000_000 + 100 * index, 6 * index
        yield Pulse([[(-1000, sent)], [(2000, echo)]], time, (x, 0, 1_000_000), (x, 0, 1_000_000 - 149_896))


def _run(tmp_path, *options):
    done = succeed("run", tmp_path / "o.las", "-o", tmp_path / "out", *options)
    return wb.read_cloud(tmp_path / "out" / "o.laz"), done.output


def _compare_lost(tmp_path):
    """Relative error that normalized amplitudes without an energy have in addition, and what the run said."""
    cloud, said = _run(tmp_path, "--columns", "+amplitude_normalized,+amplitude_normalized_err", "--flight-height", 151)
    error = cloud["amplitude_normalized_err"] / cloud["amplitude_normalized"]
    lost = np.isnan(cloud["pulse_energy"])
    return np.sqrt(np.median(error[lost]) ** 2 - np.median(error[~lost]) ** 2), said


def test_clipped_outgoing_pulses_have_a_time_but_no_energy(tmp_path, rng):
    pulses = list(_sent(rng, 800, 245, 0.5))
    clipped = np.array([pulse.waves[0][0][1].max() == 255 for pulse in pulses])
    found = import_file(_make(tmp_path, pulses), tmp_path / "o.las", ImportOptions())
    assert 250 < np.count_nonzero(clipped) == found.outgoing["unknown"] < 400
    assert any(note.startswith(f"{np.count_nonzero(clipped)} outgoing pulses are clipped") for note in found.notes)
    _, points, xyz = _points(tmp_path / "o.las")
    assert np.array_equal(np.isnan(points["pulse_energy"]), clipped)
    assert xyz[clipped, 2].std() < 0.006 and abs(xyz[clipped, 2].mean() - xyz[~clipped, 2].mean()) < 0.002
    # Without a calibration too, what they lack is in the errors and in a line.
    error, said = _compare_lost(tmp_path)
    assert "of the pulses have none and count as of mean energy" in said and error > 0.1


def test_pulses_of_another_digitizer_are_counted_apart_and_not_compared(tmp_path, rng):
    """Their counts were compared with those of the others: 15436 % of error held what is another scale."""
    pulses = list(_sent(rng, 800, 180, 0.5))
    for pulse in pulses[::4]:
        pulse.descriptor, pulse.waves = 2, [[(at, 200 * samples)] for ((at, samples),) in pulse.waves]
    kinds = {1: (SENT, ECHO), 2: (replace(SENT, bits=16), replace(ECHO, bits=16))}
    found = import_file(PulseFile(kinds, pulses).write(tmp_path / "a.pls"), tmp_path / "o.las", ImportOptions())
    assert (found.outgoing["unknown"], found.outgoing["other_kind"]) == (0, 200)
    (note,) = [note for note in found.notes if "outgoing pulses" in note]
    assert note.startswith("200 outgoing pulses are recorded with another channel, bits or spacing")
    error, said = _compare_lost(tmp_path)
    assert "25% of all are not compared" in said and "of error hold it" not in said
    assert error == pytest.approx(0.1, abs=0.03)


def test_outgoing_pulses_that_are_cut_have_an_error_that_holds(tmp_path, rng):
    pulses = list(_sent(rng, 400, 180, 0.5))
    for pulse in pulses:
        pulse.waves[0][0] = (-1000, pulse.waves[0][0][1][:13])
    import_file(_make(tmp_path, pulses), tmp_path / "o.las", ImportOptions())
    _, points, _ = _points(tmp_path / "o.las")
    energies = [pulse.waves[1][0][1].max() - 4 for pulse in pulses]
    off = points["pulse_energy"] - energies / np.mean(energies)
    assert 0.02 < off.std() < points["pulse_energy_err"].mean()


def test_errors_of_ranges_hold_when_a_weak_outgoing_pulse_was_sent(tmp_path, rng):
    import_file(_make(tmp_path, list(_sent(rng, 500, 15, 1.0))), tmp_path / "o.las", ImportOptions())
    cloud, _ = _run(tmp_path)
    off = cloud["z"] - np.median(cloud["z"])
    assert 0.02 < off.std() < 1.25 * np.median(cloud["range_err"]) < 0.06


def test_segments_of_a_pulse_are_returns_in_order(tmp_path):
    sampling = replace(ECHO, segment_bits=8)
    waves = [(9000, bell(40, 9, 50, 2)), (2000, bell(60, 30, 80, 2)), (4000, bell(40, 9, 20, 2))]
    path = _make(tmp_path, [Pulse([waves]), Pulse([[]]), Pulse([waves[:1]])], (sampling,))
    found = import_file(path, tmp_path / "o.las", ImportOptions())
    assert (found.points, found.without_returns, found.descriptors, found.outgoing) == (4, 1, 2, None)
    _, points, xyz = _points(tmp_path / "o.las")
    assert (points["bit_fields"] & 15).tolist() == [1, 2, 3, 1] and (points["bit_fields"] >> 4).tolist() == [3, 3, 3, 1]
    assert np.allclose(xyz[:, 2], 1000 - C * np.array([1030, 2009, 4509, 4509]), atol=0.002)
    assert points["intensity"].tolist() == [82, 22, 52, 52]  # the file has none: the largest counts
    assert "pulse_energy" not in points.dtype.names and not (tmp_path / "o.system.toml").exists()


def test_detected_returns_lie_at_every_echo(tmp_path):
    two = np.maximum(bell(60, 15, 90, 2), bell(60, 35, 60, 2))
    path = _make(tmp_path, [Pulse([[(2000, two)]])], (ECHO,))
    import_file(path, tmp_path / "o.las", ImportOptions(returns="detect"))
    _, points, xyz = _points(tmp_path / "o.las")
    assert np.allclose(xyz[:, 2], 1000 - C * np.array([1015, 1035]), atol=0.02)
    assert len(set(points["wavepacket_offset"].tolist())) == 1


def test_the_insensitive_channel_stands_for_saturated_segments(tmp_path, rng):
    other = replace(ECHO, channel=1, segment_bits=8)
    heights = np.linspace(30, 600, 60)
    pulses = []
    for height in heights:
        strong = np.minimum(bell(50, 12, height, 2), 255)
        weak = bell(50, 11.5, height / 4, 2)
        pulses.append(Pulse([[(2000, strong)], [(2001, weak)] if height > 90 else []]))
    path = _make(tmp_path, pulses, (ECHO, other))
    found = import_file(path, tmp_path / "o.las", ImportOptions())
    over = int((heights > 0.8 * 255).sum())
    assert found.points == 60 and abs(found.replaced - over) <= 1
    assert found.replaced + found.covered == np.count_nonzero(heights > 90)
    _, points, xyz = _points(tmp_path / "o.las")
    assert len(set(points["wavepacket_index"].tolist())) == 2
    assert np.allclose(xyz[:, 2], 1000 - C * 1012, atol=0.02)
    tops = {int(block.point[row]): int(block.samples[row].max()) for block in _blocks(tmp_path / "o.las")
            for row in range(len(block))}  # fmt: skip
    assert np.allclose([tops[k] for k in range(60)], heights + 2, rtol=0.06, atol=3)


def test_channels_of_unknown_gain_are_all_kept(tmp_path):
    others = [replace(ECHO, channel=k) for k in (1, 2)]
    pulses = [Pulse([[(2000, bell(50, 12, 90, 2))] for _ in range(3)]) for _ in range(9)]
    found = import_file(_make(tmp_path, pulses, (ECHO, *others)), tmp_path / "o.las", ImportOptions())
    assert found.points == found.packets == 27 and found.covered == found.replaced == 0 and found.descriptors == 3
    assert any("all of its segments are kept" in note for note in found.notes)


def test_lengths_beyond_the_descriptors_of_las_are_padded(tmp_path, rng):
    pulses = [Pulse([[(2000, bell(20 + k, 9, 90, 2, level=3))]]) for k in range(300)]
    found = import_file(_make(tmp_path, pulses, (ECHO,)), tmp_path / "o.las", ImportOptions())
    assert found.descriptors == 151
    samples = {int(b.point[r]): b.samples[r] for b in _blocks(tmp_path / "o.las") for r in range(len(b))}
    for k in (0, 1, 150, 299):
        assert samples[k][: 20 + k].tolist() == pulses[k].waves[0][0][1].tolist()


def test_degrees_become_utm_and_standard_time_that_of_las(tmp_path):
    keys = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 2, 2048, 0, 1, 4326, 3072, 0, 1, 0)
    pulse = Pulse([[(2000, bell(40, 10, 90, 2))]], time=5_000_000, anchor=(90_000_000, -450_000_000, 1_000_000),
                  target=(90_000_000, -450_000_000, 850_104))  # fmt: skip
    path = _make(tmp_path, [pulse], (ECHO,), scales=(1e-7, 1e-7, 0.001), offsets=(0.0,) * 3, time=(1e-6, 1.2e9),
                 records=[("PulseWaves_Proj", 34735, keys)])  # fmt: skip
    found = import_file(path, tmp_path / "o.las", ImportOptions())
    assert "UTM zone 32S (EPSG:32732)" in found.notes[0]
    facts, points, xyz = _points(tmp_path / "o.las")
    # On the central meridian; the northing of 45 degrees south is 10,000,000 - 0.9996 x 4,984,944.378 m.
    assert np.allclose(xyz[0], [500_000, 10_000_000 - 0.9996 * 4_984_944.378, 1000 - 1010 * C], atol=0.01)
    assert facts.header.global_encoding & 1 and points["gps_time"][0] == pytest.approx(2e8 + 5)
    assert "32732" in facts.crs


@pytest.mark.parametrize("offset", [-44e6, 2.1e8])
def test_adjusted_times_stay_so(tmp_path, offset):
    """Read as standard GPS time, a flight of 2010 or 2018 would be of before 1987."""
    path = _make(tmp_path, [Pulse([[(2000, bell(40, 10, 90, 2))]], time=0)], (ECHO,), time=(1e-6, offset))
    assert any("adjusted" in note for note in import_file(path, tmp_path / "o.las", ImportOptions()).notes)
    facts, points, _ = _points(tmp_path / "o.las")
    assert facts.header.global_encoding & 1 and points["gps_time"][0] == offset


def test_geocentric_coordinates_stay_so(tmp_path):
    keys = struct.pack("<8H", 1, 1, 0, 1, 1024, 0, 1, 3)
    place = (4_201_000_000, 168_000_000, 1_780_000_000)
    pulse = Pulse([[(2000, bell(40, 10, 90, 2))]], anchor=tuple(v - 2**31 + 1000 for v in place),
                  target=tuple(v - 2**31 + 1000 - 100_000 for v in place))  # fmt: skip
    path = _make(tmp_path, [pulse], (ECHO,), offsets=(2_147_482.648,) * 3,
                 records=[("PulseWaves_Proj", 34735, keys)])  # fmt: skip
    found = import_file(path, tmp_path / "o.las", ImportOptions())
    assert "geocentric and stay so" in found.notes[0]
    assert np.allclose(_points(tmp_path / "o.las")[2][0], [v / 1000 - 101.0 for v in place], atol=0.01)


def test_utm_agrees_with_a_published_point():
    # Paris, Eiffel Tower: 48.8583 N, 2.2945 E is 31N 448251.9 m E, 5411943.8 m N (WGS 84, public converters).
    ((east, north, _),) = project_utm(np.array([[2.2945, 48.8583, 0.0]]), 31, south=False)
    assert abs(east - 448251.9) < 1 and abs(north - 5411943.8) < 2


def test_pulses_without_time_get_one(tmp_path):
    pulses = [Pulse([[(2000, bell(40, 10, 90, 2))]]) for _ in range(80)]
    found = import_file(_make(tmp_path, pulses, (ECHO,)), tmp_path / "o.las", ImportOptions())
    assert any("same time" in note for note in found.notes)
    assert np.allclose(np.diff(_points(tmp_path / "o.las")[1]["gps_time"]), 1e-4)


def test_waves_of_another_file_are_named(tmp_path, rng):
    """Nothing in a .wvs says which .pls it belongs to."""
    path = _make(tmp_path, list(_flight(rng)))
    assert not any("another file" in note for note in import_file(path, tmp_path / "a.las", ImportOptions()).notes)
    with path.with_suffix(".wvs").open("ab") as waves:
        waves.write(bytes(9))
    size = path.with_suffix(".wvs").stat().st_size
    (note,) = [one for one in import_file(path, tmp_path / "b.las", ImportOptions()).notes if "another file" in one]
    assert note.startswith(f"warning: its pulses use {size - 9} of the {size} bytes of {path.stem}.wvs")


def test_a_cut_file_leaves_nothing_behind(tmp_path, rng):
    path = _make(tmp_path, list(_flight(rng)))
    waves = path.with_suffix(".wvs")
    waves.write_bytes(waves.read_bytes()[:-5])
    before = sorted(tmp_path.iterdir())
    refuses(InputError, "pulse 199", import_file, path, tmp_path / "o.las", ImportOptions())
    assert sorted(tmp_path.iterdir()) == before


def _invoke(*words):
    return run_command("import", *words, prog_name="wavebatch")


def test_a_batch_goes_on_after_a_bad_file_and_resumes(tmp_path, rng):
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    for name in ("a.pls", "b.pls"):
        _make(source, list(_flight(rng, 60)), name=name)
    (source / "bad.pls").write_bytes(b"PulseWavesPulse\0" + bytes(500))
    done = _invoke(source, "-o", out)
    assert done.exit_code == 3 and done.stderr.count("error:") == 1 and "bad.pls" in done.stderr
    kept = (out / "a.las").stat().st_mtime_ns
    (out / "b.las").unlink()  # as a killed import may leave it: packets without their strip
    again = _invoke(source / "a.pls", source / "b.pls", "-o", out, "--resume", "--json")
    assert again.exit_code == 0 and (out / "a.las").stat().st_mtime_ns == kept and (out / "b.las").exists()
    assert '"skipped": true' in again.stdout and '"skipped": false' in again.stdout
    refused = _invoke(source / "a.pls", "-o", out)
    assert refused.exit_code == 4 and "exists already" in refused.stderr
    (out / "a.las").write_bytes(b"something else")
    assert _invoke(source / "a.pls", "-o", out, "--resume").exit_code == 4
    assert _invoke(source / "a.pls", "-o", out, "--internal", "--overwrite").exit_code == 0


@pytest.mark.parametrize(
    ("name", "points", "fwhm"),
    [("riegl-q680i/100429_152240_2535pt_UTM", 2378, 4.55), ("geolas/geolas_example1", 1000, 4.05),
     ("lvis/lvis_example1", 1000, 6.68)],
)  # fmt: skip
def test_outgoing_pulses_of_real_files(data, tmp_path, name, points, fwhm):
    found = import_file(data / f"{name}.pls", tmp_path / "o.las", ImportOptions())
    assert found.points == points and found.outgoing["fwhm_ns"] == pytest.approx(fwhm, rel=0.05)


def test_the_riegl_file_holds_the_packets_of_its_strip(data, riegl, tmp_path):
    """Pulse by pulse: the samples of the low-power channel are those of the LAS file, and lie in the same place."""
    path = Path(tmp_path / "o.las")
    import_file(data / "riegl-q680i/100429_152240_2535pt_UTM.pls", path, ImportOptions())
    ours, theirs = _by_pulse(path), _by_pulse(riegl)
    same, apart = 0, []
    for pulse, packets in theirs.items():
        for samples, place in packets:
            match = [where for other, where in ours.get(pulse, ()) if np.array_equal(other, samples)]
            same += bool(match)
            apart += [float(np.linalg.norm(match[0] - place))] if match else []
    # 14 strong segments are those of the high-power channel here.
    assert sum(map(len, theirs.values())) - same <= 14
    # The LAS file counts from the outgoing pulse's centre, an import from the clock: half a sample, 7.5 cm.
    assert max(apart) < 0.09


def _by_pulse(path):
    """Samples and position of sample 0 of the packets, by pulse."""
    found = {}
    for block in _blocks(path):
        for row in range(len(block)):
            pulse = round(float(block.gps_time[row]) * 1e6)
            found.setdefault(pulse, []).append((block.samples[row].astype(int), block.origin[row]))
    return found


def test_few_outgoing_pulses_have_an_energy_but_no_width(tmp_path, rng):
    path = _make(tmp_path, list(_flight(rng, number=1)))
    done = run_command("import", path)
    assert done.exit_code == 0 and "nan" not in done.output and "1 points" not in done.output, done.output


@pytest.mark.parametrize(("code", "stays"), [(31467, True), (32633, False)])
def test_a_crs_that_stays_in_geotiff_keys_is_named(tmp_path, rng, code, stays):
    """Gauss-Krueger is no UTM zone."""
    keys = struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, code)
    path = _make(tmp_path, list(_flight(rng, number=3)), appended=[("PulseWaves_Proj", 34735, keys)])
    notes = import_file(path, tmp_path / "o.las", ImportOptions()).notes
    assert any("the CRS stays as GeoTIFF keys" in note for note in notes) is stays
    assert stays or f'"{code}"' in _points(tmp_path / "o.las")[0].crs


def _list_rows(path):
    with StripReader(path) as reader, reader.scan() as scan:
        for block in reader.all_blocks(scan, 999):
            for row in range(len(block)):
                yield int(block.point[row]), (block.samples[row].tolist(), block.origin[row], block.direction[row])


def _same(one, other):
    ours, theirs = dict(_list_rows(one)), dict(_list_rows(other))
    assert ours.keys() <= theirs.keys() and len(ours) > 100
    for point, (samples, origin, direction) in ours.items():
        assert samples == theirs[point][0]
        assert np.allclose(origin, theirs[point][1], atol=1e-4) and np.allclose(direction, theirs[point][2], atol=1e-7)
    return len(ours)


@pytest.mark.parametrize("point_format", [4, 9])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_vectors_away_from_the_sensor_are_turned(tmp_path, point_format, suffix):
    options = StripOptions(toward=False, point_format=point_format, internal=True)
    simulate_strip("urban", tmp_path / "a.las", pulses=400, seed=3, options=options)
    found = export_strip(tmp_path / "a.las", tmp_path / f"b{suffix}")
    assert any("pointed away" in line for line in found.repaired) and found.points > 400
    assert _same(tmp_path / f"b{suffix}", tmp_path / "a.las") == found.waveforms
    checked = check_file(tmp_path / f"b{suffix}")
    assert not checked.problems and not checked.notes
    with StripReader(tmp_path / f"b{suffix}") as reader, reader.scan() as scan:
        assert scan.vectors.direction == "toward" and not reader.facts.packets.internal
        record = next(vlr for vlr in reader.facts.header.vlrs if vlr.user == USER_ID.decode())
        assert json.loads(record.payload)["repaired"] == list(found.repaired)


def test_compressed_and_damaged_packets_and_all_fields(riegl, tmp_path):
    for suffix in (".las", ".wdp"):
        (tmp_path / f"plain{suffix}").write_bytes(riegl.with_suffix(suffix).read_bytes())
    packed = pack_strip(tmp_path / "plain.las", tmp_path / "packed.las")
    wdz = packed.with_suffix(".wdz")
    wdz.write_bytes(wdz.read_bytes()[:-2000])
    found = export_strip(packed, tmp_path / "out.las")
    assert {"packets were compressed"} < set(found.repaired) and any("cannot be used" in x for x in found.repaired)
    assert _same(tmp_path / "out.las", riegl) == found.waveforms < 2375
    with StripReader(riegl) as old, StripReader(tmp_path / "out.las") as new:
        before, after = old.read_points(0, 2535), new.read_points(0, 2535)
        same = [name for name in before.dtype.names if not name.startswith("wavepacket") and name not in
                ("return_point_wave_location", "x_t", "y_t", "z_t")]  # fmt: skip
        assert all(np.array_equal(before[name], after[name]) for name in same)
        assert np.all(after["wavepacket_size"][after["wavepacket_index"] == 0] == 0)
        assert new.facts.crs == old.facts.crs
    assert check_file(tmp_path / "out.las").problems == ()


def test_arrays_hold_what_the_strip_holds(riegl, tmp_path):
    found = export_strip(riegl, tmp_path / "w.npz")
    with np.load(tmp_path / "w.npz") as arrays:
        values = dict(arrays)
    expected = dict(_list_rows(riegl))
    assert len(values["point"]) == found.waveforms == len(expected) == 2375
    for row in range(0, 2375, 7):
        first, count = int(values["first"][row]), int(values["count"][row])
        samples, origin, direction = expected[int(values["point"][row])]
        assert values["samples"][first : first + count].tolist() == samples
        assert np.array_equal(values["origin"][row], origin) and np.array_equal(values["direction"][row], direction)
    assert len(values["return_point"]) == 2535 and values["return_waveform"].max() == 2374
    row = values["return_waveform"]
    place = values["origin"][row] + values["return_time"][:, None] * values["direction"][row]
    assert np.median(np.abs(place - values["return_xyz"])) < 0.001
    assert values["samples"].dtype == np.uint16 and json.loads(str(values["meta"]))["export"]["file"] == riegl.name
    assert "UTM" in str(values["crs"])


def test_several_strips_and_a_bad_one(tiny_strip, tmp_path):
    (tmp_path / "bad.las").write_bytes(b"LASF" + bytes(400))
    done = run_command("export", tiny_strip, tmp_path / "bad.las", "-o", tmp_path / "o")
    assert done.exit_code == 1 and done.stderr.count("error:") == 1
    assert sorted(path.suffix for path in (tmp_path / "o").iterdir()) == [".las", ".wdp"]
    fail(1, "exists already", "export", tiny_strip, "-o", tmp_path / "o")
