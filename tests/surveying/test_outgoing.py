"""The pulse that was sent against the pulse that echoes show: which is taken, and energies without being asked for."""

from dataclasses import replace

import numpy as np
import pytest
from commands import refuses
from strips import voxel_job

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Digitizer, LevelWidths, SystemPulse, WaveformBlock
from wavebatch.files.las.header import ExtraRecord
from wavebatch.files.pulse_energy import PulseEnergy, find_pulse_energy
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.signal.outgoing import find_reference, measure_outgoing
from wavebatch.stages.attribute.radiometry import normalize_amplitude
from wavebatch.surveying import Survey
from wavebatch.surveying.matching.strip_energies import take_energies
from wavebatch.surveying.outgoing import compare_outgoing, learn_shape, save_outgoing
from wavebatch.surveying.systems.figures import Figures
from wavebatch.surveying.systems.survey_result import SavedSurvey, format_survey
from wavebatch.tools.voxels.strip import VoxelOptions, voxelize_strip


def _samples(rng, number, sigma, tail=0.0):
    """Outgoing pulses of 4 samples of noise each, with a tail of this share."""
    centre = 12 + rng.uniform(-0.5, 0.5, number)
    lag = np.arange(48) - centre[:, None]
    clean = np.exp(-0.5 * (lag / sigma) ** 2) + tail * (lag > 0) * np.exp(-np.maximum(lag, 0) / (3 * sigma))
    return np.clip(np.round(6 + 170 * clean + rng.normal(0, 0.7, clean.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.2, 2.0, 4.0])
@pytest.mark.parametrize("tail", [0.0, 0.1])
def test_the_stacked_pulse_is_as_wide_as_what_was_sent(rng, sigma, tail):
    samples = _samples(rng, 800, sigma, tail)
    shape = learn_shape(samples, 0.5, find_reference(samples))
    lag = np.linspace(-40, 40, 80_001)
    pulse = np.exp(-0.5 * (lag / sigma) ** 2) + tail * (lag > 0) * np.exp(-np.maximum(lag, 0) / (3 * sigma))
    above = lag[pulse > 0.5 * pulse.max()]
    assert shape.fwhm == pytest.approx(0.5 * (above[-1] - above[0]), rel=0.03)


def test_recordings_without_a_pulse_have_no_energy(rng):
    noise = np.round(6 + rng.normal(0, 0.7, (200, 48))).astype(np.uint8)
    assert find_reference(noise) is None
    samples = _samples(rng, 200, 2.0)
    reference = find_reference(samples)
    found = measure_outgoing(np.concatenate([samples, noise]), reference)
    assert np.isfinite(found.energy[:200]).all() and np.isnan(found.energy[200:]).all()
    assert learn_shape(noise, 1.0, reference) is None
    assert measure_outgoing(samples[:, :1], reference).energy.shape == (200,)  # one sample each


@pytest.fixture
def sent(tmp_path, rng):
    """Writes the system file of outgoing pulses beside strip.las."""
    samples = _samples(rng, 400, 2.0)
    shape = learn_shape(samples, 1.0, find_reference(samples))

    def write(same_receiver=True, **scatter):
        reference = find_reference(samples)
        saved = save_outgoing(shape, reference, 1.0, 8, "a.pls", {}, same_receiver=same_receiver, **scatter)
        (tmp_path / "strip.system.toml").write_text(format_survey(saved))
        return tmp_path / "strip.las", shape.fwhm

    return write


def _echoes(fwhm, learned=True):
    figures = Figures(misfit_gaussians={1: 0.01} if learned else {})
    return Survey(SystemPulse(fwhm / FWHM_PER_SIGMA, components=((1.0, 0.0, 1.0), (0.1, 3.0, 1.0))), 500, figures)


@pytest.mark.parametrize(
    ("ratio", "learned", "same", "taken", "reason"),
    [(1.01, True, True, False, "both agree"), (1.4, True, True, True, "targets widened"),
     (1.1, True, False, True, "targets widened"), (1.4, True, False, False, "receiver is slower"),
     (0.9, True, True, False, "echoes are narrower"), (1.3, False, False, True, "too few echoes")],
)  # fmt: skip
def test_the_pulse_that_is_taken_and_why(sent, ratio, learned, same, taken, reason):
    strip, fwhm = sent(same)
    before = _echoes(ratio * fwhm, learned)
    found = compare_outgoing(before, strip)
    decision = found.decisions[-1]
    assert decision.needed == taken and reason in decision.reason
    width = fwhm if taken else ratio * fwhm
    assert found.system.sigma_ref * FWHM_PER_SIGMA == pytest.approx(width)
    assert (found.system.components == before.system.components) != taken
    assert found.figures.sent_fwhm_ns == pytest.approx(fwhm)
    # A survey that is saved under the same name is not taken for outgoing pulses.
    strip.with_suffix(".system.toml").write_text(format_survey(SavedSurvey(found)))
    assert compare_outgoing(before, strip) is before


def test_pulses_of_various_widths_are_in_the_errors_of_normalized_amplitudes(sent):
    """Of one energy, a wider pulse is lower: 5 % of it left half of the amplitudes beyond their error."""
    strip, fwhm = sent(width_scatter=0.05)
    two = _echoes(1.3 * fwhm)
    two = replace(two, system=replace(two.system, digitizers={
        2: replace(two.system, sigma_ref=2.0), 3: replace(two.system, widths=LevelWidths(scatter=0.9)),
    }))  # fmt: skip
    found = compare_outgoing(two, strip).system
    assert found.sigma_ref * FWHM_PER_SIGMA == pytest.approx(fwhm)  # the outgoing pulse is taken
    for one in (found, found.digitizers[2]):
        assert one.widths.scatter == pytest.approx(0.05 * one.sigma_ref)
    assert found.digitizers[3].widths.scatter == 0.9  # its echoes scatter by more
    block = WaveformBlock.from_samples(np.zeros((1, 60), np.uint8), spacing=1.0)
    waveform, time, amplitude, width = np.zeros(1, int), np.full(1, 30.0), np.full(1, 50.0), np.full(1, found.sigma_ref)
    echoes = EchoTable.build(waveform, time, amplitude, width, amplitude_err=np.ones(1))
    echoes = echoes.with_attributes(x=np.zeros(1), y=np.zeros(1), z=np.zeros(1))
    block = replace(block, sensor=np.array([[0.0, 0.0, 1000.0]]), origin=np.zeros((1, 3)), direction=np.zeros((1, 3)))
    plain, scattered = (
        normalize_amplitude(block, replace(found, widths=one), echoes, 1000.0)[1][0]
        for one in (LevelWidths(), found.widths)
    )
    assert scattered**2 - plain**2 == pytest.approx(0.05**2)


def test_without_a_file_of_outgoing_pulses_nothing_changes(tmp_path, sent):
    before = _echoes(4.0)
    assert compare_outgoing(before, tmp_path / "other.las") is before
    strip, _ = sent()
    strip.with_suffix(".system.toml").write_text("x = ")
    refuses(ConfigError, r"strip\.system\.toml", compare_outgoing, before, strip)


def _strip(path, energies, light=None):
    records = [ExtraRecord.build("pulse_energy", "f4", ""), ExtraRecord.build("pulse_energy_err", "f4", "")]
    n, time = len(energies), np.arange(60)
    writer = FullwaveWriter(path, point_format=9, internal=True, digitizers=[Digitizer(1, 8, 60, 1.0)],
                            extra_bytes=records)  # fmt: skip
    height = 100 * (np.nan_to_num(energies, nan=1.0) if light is None else light)
    samples = np.round(5 + height[:, None] * np.exp(-0.5 * ((time - 20) / 2.0) ** 2)).astype(np.uint8)
    with writer:
        points = np.zeros(n, writer.dtype)
        points["wavepacket_offset"] = writer.write_packets(samples, 1)
        points["wavepacket_index"], points["wavepacket_size"] = 1, 60
        points["gps_time"], points["X"] = np.arange(n) * 1e-5, np.arange(n) * 300 + 150
        points["bit_fields"], points["z_t"] = 0x11, 0.000149896
        points["return_point_wave_location"] = 20_000
        points["pulse_energy"], points["pulse_energy_err"] = 3 * energies, 0.03
        writer.write_points(points)
        writer.commit()
    return path


@pytest.fixture
def strip(tmp_path, rng):
    """Pulses of various energies, a tenth of them unknown."""
    energies = np.round(1 + 0.2 * rng.standard_normal(400), 4).clip(0.4, 1.8)
    energies[::10] = np.nan
    return _strip(tmp_path / "s.las", energies), energies


def _filled(path, request, brighter=None, missed=0.0):
    with StripReader(path) as reader, reader.scan() as scan:
        energy = find_pulse_energy(reader, scan, request)
        if brighter is not None:  # the mean of the calibration over that of the strip
            energy = replace(energy, reference=brighter * energy.mean, missed=missed)
        blocks = [
            block if energy is None else energy.fill(block, unit)
            for unit in reader.read_units(scan)
            for block, _ in reader.read_blocks(unit, 128, owned_only=True)
        ]
    if energy is None:
        assert all(block.pulse_energy is None for block in blocks)
        return None
    return (np.concatenate([getattr(block, name) for block in blocks]) for name in ("pulse_energy", "pulse_energy_err"))


def test_the_column_of_an_import_is_used_without_being_asked_for(strip):
    path, energies = strip
    energy, error = _filled(path, None)
    known, mean = np.isfinite(energies), np.nanmean(energies)
    assert np.allclose(energy[known], energies[known] / mean, atol=1e-6) and np.allclose(error[known], 0.01 / mean)
    # An unknown one counts as it would without the column: mean energy, known to what it varies by.
    assert np.all(energy[~known] == 1) and np.allclose(error[~known], np.nanstd(energies) / mean)
    # Under a calibration of pulses twice as strong it counts half, and so does its error.
    half, doubt = _filled(path, None, brighter=2.0)
    assert np.allclose(half, energy / 2) and np.allclose(doubt, error / 2)
    _, doubt = _filled(path, None, brighter=1.0, missed=0.1)
    assert np.allclose(doubt, np.hypot(error, 0.1 * energy))
    assert [PulseEnergy("", mean=3.0, reference=one).level for one in (None, 2.0)] == [1.0, 1.5]
    assert _filled(path, "none") is None
    energy, _ = _filled(path, "pulse_energy")
    assert np.isnan(energy[~known]).all()


def test_a_column_that_knows_few_pulses_is_not_used_unless_asked_for(tmp_path):
    path = _strip(tmp_path / "s.las", np.r_[np.ones(10), np.full(90, np.nan)])
    assert _filled(path, None) is None
    with StripReader(path) as reader, reader.scan() as scan:
        (said,) = take_energies(reader, scan, None).notes
    assert "fewer than 20 of the sampled pulses have one" in said
    refuses(OSError, "--energy pulse_energy knows 10 of 100", _filled, path, "pulse_energy")
    few = _strip(tmp_path / "few.las", np.ones(10))
    with StripReader(few) as reader, reader.scan() as scan:
        assert find_pulse_energy(reader, scan, None) is not None  # all that there are


@pytest.mark.parametrize("known", [0.96, 0.4, 0.05])
def test_pulses_whose_energy_is_clipped_have_an_error_by_their_light(tmp_path, rng, known):
    """The strong ones are not known. Beyond a half, or below 200 compared ones, no error held what they are more."""
    energies = 1 + 0.1 * rng.standard_normal(8000)
    sent = np.where(energies > np.quantile(energies, known), np.nan, energies)
    with StripReader(_strip(tmp_path / "s.las", sent, energies)) as reader, reader.scan() as scan:
        found = take_energies(reader, scan, None)
    off = np.abs(energies[np.isnan(sent)] / np.nanmean(sent) - 1)
    assert 0.45 < np.mean(off < found.energy.fills) < 0.95 and "count as of mean energy" in found.notes[0]
    # --energy pulse_energy, which gives the others no data, must know half of them.
    assert ("--energy pulse_energy gives them no values" in found.notes[0]) == (known > 0.5)


@pytest.mark.slow
def test_voxels_are_divided_by_the_energies(strip, tmp_path):
    path, energies = strip
    sums = {}
    for energy in (None, "none"):
        voxelize_strip(voxel_job(path, energy=energy), tmp_path / f"{energy}.npz", VoxelOptions(size=0.3))
        with np.load(tmp_path / f"{energy}.npz") as found:
            column = found["index"][:, 0]
            sums[energy] = np.bincount(column - column.min(), found["energy"])
    known = np.isfinite(energies)
    spread = {energy: values[: len(known)][known].std() / values[known].mean() for energy, values in sums.items()}
    assert spread[None] < 0.03 < 0.15 < spread["none"]
