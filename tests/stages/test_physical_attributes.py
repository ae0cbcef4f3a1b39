"""Attributes of echoes: positions, deviation from the pulse, energies, angles, reflectances, and their errors."""

from dataclasses import replace

import numpy as np
import pytest
from commands import refuses
from helpers_scenes import make_block

from wavebatch.core.echoes import EchoFlag, EchoTable, NoData, count_reasons
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Noise, Radiometry, ReceiverNoise, ReturnTable, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.kernels.physics.incidence import spread_of_angle
from wavebatch.kernels.physics.radiometry import receive_power
from wavebatch.stages import pulse_tables
from wavebatch.stages.attribute.basic import position
from wavebatch.stages.attribute.radiometry import echo_light, hide_values
from wavebatch.stages.chain import STAGES, Chain, Solved, Step, load_profile, parse_chain
from wavebatch.stages.pulse_tables import describe_fitted, pulse_shape, shape_limits
from wavebatch.surveying.flat_ground import SLOPE, predict_angles

SYSTEM = SystemPulse(
    1.2,
    noise=ReceiverNoise(baseline=12.0, std=1.0),
    radiometry=Radiometry(divergence=1.1, constant=2.6e-8, attenuation=0.22),
)
BEAM = 1e-3 * SYSTEM.radiometry.divergence
NAMES = ("range", "backscatter_coefficient", "cross_section", "level_reflectance", "incidence_angle")
COLUMNS = [name for stage in NAMES for name in STAGES[f"attribute.{stage}"].makes]
KNOWN = set(COLUMNS) - {"range_error"}
"""Without an error of the sensor's position."""


def whole_pulse(shape, limits, main):
    """Amplitude, time and sigma of the whole pulse (m, 3) from those of its main component."""
    return describe_fitted(shape, limits, main, np.ones_like(main), np.zeros((len(main), 2)))[0]


def run(block, echoes, system, *names, **parameters):
    noise = Noise(np.full(len(block), 12, np.float32), np.ones(len(block), np.float32))
    for name in names:
        echoes = STAGES[f"attribute.{name}"].function(block, noise, system, echoes, **parameters.get(name, {}))
    return echoes


def make(degrees, snr=100.0, height=640.0, per_waveform=1, seed=1):
    """Block and fitted echoes on planes that the ray strikes at `degrees` (n,), with errors at the bound."""
    rng = np.random.default_rng(seed)
    n = len(degrees)
    sigma = np.hypot(SYSTEM.sigma_ref, spread_of_angle(np.radians(degrees), height, BEAM))
    amplitude = np.full(n, snr) * np.cos(np.radians(degrees)) * SYSTEM.sigma_ref / sigma
    errors = crlb(amplitude, sigma, 1.0, 1.0)
    block = WaveformBlock.from_samples(np.zeros((n // per_waveform, 8), np.uint8))
    sensor = np.array([5e5, 5.4e6, 120.0]) + rng.uniform(-100, 100, (len(block), 3)) * [1, 1, 0] + [0, 0, height]
    block = replace(block, sensor=sensor)
    draw = rng.multivariate_normal(np.zeros(2), [[1, -1 / np.sqrt(3)], [-1 / np.sqrt(3), 1]], n).T
    waveform = np.arange(n) // per_waveform
    echoes = EchoTable.build(
        waveform, np.arange(n) % per_waveform * 20.0, amplitude + errors[1] * draw[0], sigma + errors[2] * draw[1],
        time_err=errors[0], amplitude_err=errors[1], sigma_err=errors[2],
    )  # fmt: skip
    xyz = sensor[waveform] - [0, 0, height]
    echoes = echoes.with_attributes(x=xyz[:, 0], y=xyz[:, 1], z=xyz[:, 2], range_err=(errors[0] * HALF_C).astype("f4"))
    return block, echoes, amplitude * sigma


def test_backscatter_and_range():
    block, echoes, energy = make(np.full(4000, 20.0))
    done = run(block, echoes, SYSTEM, "range", "backscatter_coefficient", "cross_section").attributes
    assert done["range"] == pytest.approx(640.0, abs=1e-4)
    gamma = 2.6e-8 * 640.0**2 * energy / 10 ** (-2 * 640 * 0.22 / 10_000)
    off = done["backscatter_coefficient"] - gamma
    assert np.median(np.abs(off) / gamma) < 0.03
    assert np.mean(np.abs(off) < done["backscatter_coefficient_err"]) == pytest.approx(0.683, abs=0.03)
    section = gamma * np.pi / 4 * (1.1e-3 * 640) ** 2
    assert np.median(done["cross_section"] / section) == pytest.approx(1.0, abs=0.003)


@pytest.mark.parametrize(
    ("system", "gamma", "section"),
    [
        (SYSTEM.with_radiometry(sensor_error=6.4, attenuation=0.0), 0.02, 0.04),
        (SYSTEM.with_radiometry(constant_error=0.03, attenuation=0.0), 0.03, 0.03),
        (SYSTEM.with_radiometry(shot_error=0.05), 0.05, 0.05),
        (SYSTEM.with_radiometry(divergence_error=0.1), 0.0, 0.2),
        (SYSTEM.with_radiometry(attenuation_error=0.1), 2e-4 * 640 * 0.1 * np.log(10), 2e-4 * 640 * 0.1 * np.log(10)),
    ],
    ids=["position", "constant", "energy from shot to shot", "divergence", "air"],
)
def test_what_is_uncertain_for_all_echoes_is_in_the_error(system, gamma, section):
    block, echoes, _ = make(np.full(10, 20.0), snr=1e6)
    done = run(block, echoes, system, "backscatter_coefficient", "cross_section").attributes
    for name, error in (("backscatter_coefficient", gamma), ("cross_section", section)):
        assert done[f"{name}_err"] / done[name] == pytest.approx(error, rel=0.01, abs=1e-4)


def test_reflectance_by_normals_waits_for_the_second_pass():
    block, echoes, _ = make(np.full(50, 30.0), snr=3000.0)
    done = run(block, echoes, SYSTEM, "backscatter_coefficient", "incidence_angle_normals", "reflectance")
    assert np.isnan(done.attributes["reflectance"]).all()
    assert reasons(done)["reflectance"] == {"NO_ANGLE": 50}
    gamma = done.attributes["backscatter_coefficient"]
    assert done.attributes["facing_reflectance"] == pytest.approx(gamma / 4)
    angle, error = np.full(50, 60.0, np.float32), np.full(50, 1.0, np.float32)
    angle[0] = np.nan
    names = ("backscatter_coefficient", "incidence_angle_normals", "reflectance")
    chain = Chain((*load_profile("fast").steps, *(Step(STAGES[f"attribute.{name}"]) for name in names)))
    noise = Noise(np.full(len(block), 12, np.float32), np.ones(len(block), np.float32))
    kept = chain.keep_needed(Solved(block, noise, SYSTEM, done))
    assert not kept.block.samples.size and set(kept.echoes.attributes) == {"x", "y", "z", "range_err"}
    full = chain.solve_again(kept._replace(echoes=kept.echoes.with_attributes(
        incidence_angle_normals=angle, incidence_angle_normals_err=error)))  # fmt: skip
    assert reasons(full)["reflectance"] == {"NO_ANGLE": 1, "KNOWN": 49}
    full = full.attributes
    assert np.isnan(full["reflectance"][0])
    assert full["reflectance"][1:] == pytest.approx(gamma[1:] / 2, rel=1e-6)
    relative = done.attributes["backscatter_coefficient_err"] / gamma
    expected = np.hypot(relative, np.tan(np.pi / 3) * np.radians(1.0))[1:]
    assert full["reflectance_err"][1:] / full["reflectance"][1:] == pytest.approx(expected, rel=1e-5)


def test_a_reflectance_without_a_stage_for_its_angle_is_refused():
    steps = [*load_profile("fast").steps, Step(STAGES["attribute.reflectance"])]
    with pytest.raises(ConfigError, match="attribute.reflectance needs incidence_angle_normals, .*put the stage"):
        Chain(tuple(steps), "mine")
    with pytest.raises(ConfigError, match="needs incidence_angle, incidence_angle_err"):
        Chain((*steps[:-1], Step(STAGES["attribute.reflectance"], {"surface": "echo"})), "mine")


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_the_error_of_a_level_reflectance_is_what_unknown_slopes_do(tilt):
    """Surfaces of 30 degrees in any direction, struck at `tilt` to the vertical: root mean square of the deviation."""
    block, echoes, _ = make(np.full(4, 30.0), snr=1e6)
    ray = np.array([0.0, np.sin(np.radians(tilt)), -np.cos(np.radians(tilt))])
    slanting = replace(block, direction=np.tile(ray, (4, 1)) * HALF_C)
    done = run(slanting, echoes, SYSTEM, "level_reflectance").attributes
    turn = np.linspace(0.0, 2 * np.pi, 3601)
    slope = np.radians(30.0)
    normal = [np.sin(slope) * np.cos(turn), np.sin(slope) * np.sin(turn), np.full(len(turn), np.cos(slope))]
    facing = -(ray[1] * normal[1] + ray[2] * normal[2])
    expected = np.sqrt(np.mean((np.cos(np.radians(tilt)) / facing - 1.0) ** 2))
    assert done["level_reflectance_err"] / done["level_reflectance"] == pytest.approx(expected, rel=0.01)
    exact = run(slanting, echoes, SYSTEM, "level_reflectance", level_reflectance={"slope": 0.0}).attributes
    assert (exact["level_reflectance_err"] < 1e-3 * exact["level_reflectance"]).all()


@pytest.mark.parametrize(
    ("system", "known"),
    [
        (SYSTEM.with_radiometry(constant=None), {"range", "incidence_angle", "incidence_angle_err"}),
        (SYSTEM.with_radiometry(divergence=None), {name for name in KNOWN if not name.startswith(("cross", "incid"))}),
        (replace(SYSTEM, sigma_ref=0.64), KNOWN - {"incidence_angle", "incidence_angle_err"}),
        (SYSTEM, KNOWN),
        (SYSTEM.with_radiometry(sensor_error=0.1), set(COLUMNS)),
    ],
    ids=["no calibration", "no divergence", "pulse too short for the sampling", "no position error", "everything"],
)
def test_what_is_not_known_is_no_data(system, known):
    block, echoes, _ = make(np.full(50, 30.0), snr=500.0)
    done = run(block, echoes, system, *NAMES).attributes
    for name in COLUMNS:
        assert done[name].dtype == np.float32
        assert np.isfinite(done[name]).all() if name in known else np.isnan(done[name]).all(), name


def test_light_of_fits_at_a_bound_is_an_estimate_for_sums_and_no_reflectance():
    block, echoes, _ = make(np.full(3, 30.0))
    echoes = echoes.with_flags(EchoFlag.AT_BOUND, np.array([True, False, False]))
    done = run(block, echoes, SYSTEM, "backscatter_coefficient", "cross_section", "level_reflectance")
    for name in ("backscatter_coefficient", "cross_section", "level_reflectance"):
        assert np.isnan(done.attributes[name]).tolist() == ["reflectance" in name, False, False]
        relative = done.attributes[f"{name}_err"] / done.attributes[name]
        assert "reflectance" in name or (relative[0] > 0.5 and relative[1] < 0.1)
        bound = {"KNOWN": 2, "UNSETTLED": 1} if "reflectance" in name else {"KNOWN": 3}
        assert reasons(done)[name] == bound


def test_modes_agree_where_they_should():
    block, echoes, _ = make(np.full(400, 45.0), snr=2000.0)
    angle = {
        mode: np.median(run(block, echoes, SYSTEM, "incidence_angle", incidence_angle={"mode": mode})
                        .attributes["incidence_angle"])
        for mode in ("system", "pulse", "paper")
    }  # fmt: skip
    assert angle["system"] == pytest.approx(45.0, abs=0.2)
    assert angle["pulse"] == pytest.approx(45.0, abs=3.0)
    assert angle["paper"] > 60.0


def reasons(echoes):
    return count_reasons(echoes.attributes)


@pytest.mark.parametrize(
    ("system", "sensor", "column", "reason"),
    [
        (SYSTEM, False, "range", NoData.NO_SENSOR),
        (SYSTEM, False, "incidence_angle", NoData.NO_SENSOR),
        (SYSTEM.with_radiometry(constant=None), True, "level_reflectance", NoData.NOT_CALIBRATED),
        (replace(SYSTEM, widths=replace(SYSTEM.widths, error=np.inf)), True, "incidence_angle", NoData.NO_LEVEL),
        (SYSTEM.with_radiometry(constant=None, divergence=None), True, "cross_section", NoData.NOT_CALIBRATED),
        (SYSTEM.with_radiometry(divergence=None), True, "cross_section", NoData.NO_DIVERGENCE),
        (SYSTEM.with_radiometry(divergence=None), True, "incidence_angle", NoData.NO_DIVERGENCE),
        (replace(SYSTEM, sigma_ref=0.6), True, "incidence_angle", NoData.SHORT_PULSE),
        (SYSTEM.with_radiometry(divergence=0.01), True, "incidence_angle", NoData.UNCERTAIN),
    ],
)
def test_every_missing_value_has_a_reason(system, sensor, column, reason):
    block, echoes, _ = make(np.zeros(50), snr=50.0)
    echoes = replace(echoes, sigma=np.full(50, system.sigma_ref, np.float32))
    if not sensor:
        block = replace(block, sensor=None)
    done = run(block, echoes, system, *NAMES)
    assert reasons(done)[column] == {reason.name: 50}


def test_echoes_that_are_far_too_narrow_are_flagged():
    block, echoes, _ = make(np.zeros(3))
    width = np.float32(SYSTEM.sigma_ref) * np.array([0.999, 0.99, 0.9], np.float32)
    echoes = replace(echoes, sigma=width, sigma_err=np.full(3, 0.012, np.float32))
    done = run(block, echoes, SYSTEM, "incidence_angle")
    assert ((done.flags & np.uint16(EchoFlag.NARROW)) != 0).tolist() == [False, False, True]
    assert done.attributes["incidence_angle"].tolist() == [0.0, 0.0, 0.0]


def test_reasons_of_single_echoes():
    block, echoes, _ = make(np.full(12, 30.0), snr=300.0)
    marks = (EchoFlag.SATURATED | EchoFlag.AMPLITUDE_UNRELIABLE, EchoFlag.NEAR_EDGE, EchoFlag.NOT_CONVERGED,
             EchoFlag.AT_BOUND, EchoFlag.MERGED)  # fmt: skip
    for row, flag in enumerate(marks):
        echoes = echoes.with_flags(flag, np.arange(12) == row)
    echoes = replace(echoes, sigma=np.where(np.arange(12) == 5, np.float32(40.0), echoes.sigma))
    told = reasons(run(block, echoes, SYSTEM, "incidence_angle", "cross_section", "level_reflectance"))
    angles = {"KNOWN": 6, "OVERLAPPED": 1, "SATURATED": 1, "CUT": 1, "UNSETTLED": 2, "TOO_STEEP": 1}
    assert told["incidence_angle"] == angles
    assert told["cross_section"] == {"KNOWN": 11, "SATURATED": 1}
    assert told["level_reflectance"] == {"KNOWN": 10, "SATURATED": 1, "UNSETTLED": 1}


def test_relative_columns_become_absolute_with_the_constant():
    block, echoes, _ = make(np.full(20, 30.0), snr=300.0)
    angles = run(block, echoes, SYSTEM, "incidence_angle")
    bare = SYSTEM.with_radiometry(constant=None, divergence=None, channels={(1, 0): (5.2e-8, 0.0)})
    area = np.pi / 4 * BEAM**2
    names = {"backscatter": "backscatter_coefficient", "cross_section": "cross_section", "reflectance": "reflectance"}
    by_echo = {"reflectance": {"surface": "echo"}, "relative_reflectance": {"surface": "echo"}}
    for name, other in names.items():
        relative = run(block, angles, bare, f"relative_{name}", **by_echo).attributes
        absolute = run(block, angles, SYSTEM, other, **by_echo).attributes
        for end in ("", "_err"):
            scaled = 2.6e-8 * (area if name == "cross_section" else 1.0) * relative[f"relative_{name}{end}"]
            assert scaled == pytest.approx(absolute[f"{other}{end}"], rel=1e-5)


def test_channels_have_constants_of_their_own():
    block, echoes, _ = make(np.full(20, 30.0), snr=300.0)
    one = run(block, echoes, SYSTEM, "backscatter_coefficient").attributes["backscatter_coefficient"]
    channels = {(1, 0): (5.2e-8, 0.0), (1, 2): (7.8e-8, 0.1), (2, 0): (1.0, 0.0)}
    system = SYSTEM.with_radiometry(channels=channels)
    two = run(block, echoes, system, "backscatter_coefficient").attributes["backscatter_coefficient"]
    assert two == pytest.approx(2 * one, rel=1e-6)
    mixed = replace(block, scanner=np.arange(20, dtype=np.uint8) % 4)
    done = run(mixed, echoes, system, "backscatter_coefficient").attributes["backscatter_coefficient"]
    # Scanner channels 1 and 3 have none of their own: they get that of all together.
    assert done == pytest.approx(np.array([2, 1, 3, 1])[mixed.scanner] * one, rel=1e-6)
    assert mixed.rows(slice(4, 9)).scanner.tolist() == [0, 1, 2, 3, 0]


def test_the_outlook_is_the_error_that_echoes_then_have():
    block, echoes, _ = make(np.full(500, SLOPE), snr=200.0)
    outlook = predict_angles(SYSTEM, 1.0, 640.0, 1.1, float(np.median(echoes.amplitude)))
    done = run(block, echoes, SYSTEM, "incidence_angle").attributes
    assert outlook.error == pytest.approx(np.median(done["incidence_angle_err"]), rel=0.05)
    assert outlook.possible and "640 m" in outlook.reason
    assert not predict_angles(SYSTEM, 1.0, 640.0, 0.05, 50.0).possible
    short = predict_angles(SYSTEM, 2.0, 640.0, 1.1, 50.0)
    assert not short.possible and "0.60 samples wide" in short.reason


@pytest.mark.parametrize("degrees", [0.0, 40.0, 65.0])
def test_slopes_keep_the_energy_of_a_learned_pulse(degrees):
    """Amplitude times width of the main lobe grows by 6 %; the integral of the pulse does not."""
    system = replace(SYSTEM, sigma_ref=1.21, components=((1.0, 0.0, 1.2), (0.3, 2.2, 1.5), (0.1, 6.0, 2.5)))
    shape, limits = pulse_shape(system, 1.0), shape_limits(system, 1.0)
    wide = np.hypot(limits.ref, spread_of_angle(np.radians(degrees), 640.0, 1.1e-3))
    assert wide < limits.high
    whole = whole_pulse(shape, limits, np.array([[100.0 / wide, 20.0, wide]]))
    facing = whole_pulse(shape, limits, np.array([[100.0 / limits.ref, 20.0, limits.ref]]))
    amplitude, time, sigma = whole.T
    echoes = EchoTable.build(np.zeros(1), time, amplitude, sigma)
    block = WaveformBlock.from_samples(np.zeros((1, 8), np.uint8))
    assert echo_light(block, system, echoes) == pytest.approx(facing[0, 0] * facing[0, 2], rel=1e-3)
    at = np.arange(-60.0, 120.0, 0.05)
    pulse = evaluate_pulse(shape, at, np.array([20.0]), np.array([wide]))[0] * 100.0 / wide
    done = run(block, echoes, system, "energy").attributes
    assert done["energy"] == pytest.approx(pulse.sum() * 0.05, rel=2e-3)


@pytest.mark.parametrize("reference", [400.0, 1000.0])
def test_a_normalized_amplitude_is_that_at_the_reference_range(reference):
    """Level targets at 500 and 900 m, by the lidar equation: the same height at the reference, with or without air."""
    for attenuation in (0.0, 0.5):
        system = SYSTEM.with_radiometry(constant=None, attenuation=attenuation)
        found = []
        for height in (500.0, 900.0):
            power = receive_power(np.ones(1), np.array([height]), transmitted=1e16, aperture=0.1, divergence=1e-3,
                                  efficiency=1.0, attenuation=attenuation)  # fmt: skip
            # A target that fills the beam: its cross section grows with the square of the range.
            block, echoes, _ = make(np.zeros(40), snr=float(power[0]) * height**2, height=height)
            echoes = replace(echoes, amplitude=np.full(40, float(power[0]) * height**2, np.float32))
            given = {"reference_range": reference}
            done = run(block, echoes, system, "amplitude_normalized", "amplitude_normalized_db",
                       amplitude_normalized=given, amplitude_normalized_db=given).attributes  # fmt: skip
            found.append(done["amplitude_normalized"])
            assert done["amplitude_normalized_db"] == pytest.approx(10 * np.log10(found[-1]), rel=1e-5)
            share = done["amplitude_normalized_err"] / found[-1]
            assert done["amplitude_normalized_db_err"] == pytest.approx(10 / np.log(10) * share, rel=1e-4)
        assert found[0] == pytest.approx(found[1], rel=1e-4)
        at = receive_power(np.ones(1), np.array([reference]), transmitted=1e16, aperture=0.1, divergence=1e-3,
                           efficiency=1.0, attenuation=attenuation)  # fmt: skip
        assert found[0] == pytest.approx(at[0] * reference**2, rel=1e-4)


def test_the_error_of_the_air_counts_over_the_way_to_the_reference():
    """Air without an error is known to a half."""
    block, echoes, _ = make(np.zeros(4), snr=1e6)
    unsure = SYSTEM.with_radiometry(attenuation_error=0.1)
    for system, error, reference, way in ((unsure, 0.1, 640, 0), (unsure, 0.1, 1640, 1000), (SYSTEM, 0.11, 1000, 360)):
        given = {"reference_range": float(reference)}
        done = run(block, echoes, system, "amplitude_normalized", amplitude_normalized=given).attributes
        relative = done["amplitude_normalized_err"] / done["amplitude_normalized"]
        assert relative == pytest.approx(2e-4 * way * error * np.log(10), rel=0.01, abs=1e-4)


def test_the_energy_of_each_pulse_is_divided_out():
    block, echoes, _ = make(np.full(40, 20.0), snr=1e5)
    energy = np.linspace(0.7, 1.3, 40)
    energy[3] = np.nan
    brighter = replace(echoes, amplitude=(echoes.amplitude * np.nan_to_num(energy, nan=1.0)).astype(np.float32))
    names = ("backscatter_coefficient", "amplitude_normalized")
    plain = run(block, echoes, SYSTEM, *names).attributes
    known = SYSTEM.with_radiometry(shot_error=0.2, attenuation_error=1e-6)  # 0 takes the air as known to a half
    done = run(replace(block, pulse_energy=energy), brighter, known, *names)
    for name in names:
        values = done.attributes[name]
        assert np.flatnonzero(np.isnan(values)).tolist() == [3]
        assert reasons(done)[name] == {"KNOWN": 39, "NO_PULSE_ENERGY": 1}
        there = np.isfinite(values)
        assert values[there] == pytest.approx(plain[name][there], rel=1e-5)
        # What is known of each shot is no scatter from shot to shot.
        assert (done.attributes[f"{name}_err"][there] < 0.02 * values[there]).all()
    measured = replace(block, pulse_energy=energy, pulse_energy_err=np.full(40, 0.05))
    again = run(measured, brighter, known, *names)
    for name in names:
        without, relative = (one.attributes[f"{name}_err"] / one.attributes[name] for one in (done, again))
        assert np.sqrt(relative**2 - without**2)[there] == pytest.approx(0.05 / energy[there], rel=0.01)


LEARNED = replace(SYSTEM, sigma_ref=1.35, components=((1.0, 0.0, 1.2), (0.2, 2.5, 1.8)))
SKEWED = replace(SYSTEM, kappa=0.15)


def chain_of(decomposer, mode, **parameters):
    extra = "".join(f"{name} = {value!r}\n" for name, value in parameters.items())
    return parse_chain(
        f'[[chain]]\nstage = "noise.pooled"\n[[chain]]\nstage = "detect.maximum"\n'
        f'[[chain]]\nstage = "decompose.{decomposer}"\n{extra}'
        f'[[chain]]\nstage = "attribute.position"\n[[chain]]\nstage = "attribute.incidence_angle"\nmode = "{mode}"\n'
        "max_error = 60.0\n",
        "c",
    )


def planes(system, degrees, n=800, height=640.0, seed=3):
    """Waveforms of planes that rays strike at an angle, with the system's own pulse broadened by them; noise 1."""
    rng = np.random.default_rng(seed)
    shape, limits = pulse_shape(system, 1.0), shape_limits(system, 1.0)
    width = np.hypot(limits.ref, spread_of_angle(np.radians(degrees), height, 1e-3 * system.radiometry.divergence))
    x, time = np.arange(120.0), 45 + rng.uniform(-0.5, 0.5, n)
    pulse = evaluate_pulse(shape, np.tile(x, (n, 1)), time[:, None], np.full((n, 1), width))[0]
    counts = np.rint(12 + 150 * pulse * limits.ref / width + rng.standard_normal(pulse.shape))
    block = WaveformBlock.from_samples(np.clip(counts, 0, 65535).astype(np.uint16))
    return replace(block, sensor=block.origin + [0, 0, height - 45 * HALF_C])


@pytest.mark.parametrize(
    ("decomposer", "mode", "system", "right"),
    [
        ("adaptive", "system", SYSTEM, True),
        ("gaussian", "system", SYSTEM, True),
        ("adaptive", "system", LEARNED, True),
        ("reference", "system", LEARNED, True),
        ("gaussian", "system", LEARNED, False),
        ("closed_form", "system", LEARNED, False),
        ("skewed", "system", replace(LEARNED, skew=0.2), False),
        ("skewed", "system", SKEWED, True),
        ("gaussian", "system", SKEWED, False),
        ("adaptive", "pulse", SYSTEM, True),
        ("gaussian", "pulse", replace(SYSTEM, skew=0.48), True),
        ("gaussian", "pulse", replace(SYSTEM, skew=0.0), False),  # the strip's pulse is a Gaussian, not t^2 exp(-t)
        ("adaptive", "pulse", LEARNED, False),
        ("adaptive", "paper", SKEWED, False),
    ],
)
def test_modes_and_decomposers_that_do_not_belong_together_say_nothing(decomposer, mode, system, right):
    """Widths of Gaussians compared with another pulse gave angles 2 to 3 degrees off, a quarter within their errors."""
    block = planes(system, 40.0)
    found = chain_of(decomposer, mode).run(block, system)
    angle = found.attributes["incidence_angle"]
    codes = found.attributes["incidence_angle_reason"]
    if not right:
        assert np.isnan(angle).all() and (codes == NoData.OTHER_PULSE).all()
        return
    assert not (codes == NoData.OTHER_PULSE).any() and np.isfinite(angle).mean() > 0.9
    if mode == "system":
        off, error = angle - 40.0, found.attributes["incidence_angle_err"]
        assert abs(np.nanmedian(off)) < 0.15
        assert np.mean(np.abs(off[np.isfinite(off)]) < error[np.isfinite(off)]) == pytest.approx(0.68, abs=0.06)


def test_widths_with_a_skew_per_echo_are_refused_before_a_run():
    refuses(ConfigError, "decompose.adaptive", chain_of, "skewed", "system", kappa="free")


@pytest.mark.parametrize("system", [SYSTEM, LEARNED], ids=["gaussian", "learned"])
@pytest.mark.parametrize("decomposer", ["adaptive", "reference"])
def test_steep_slopes_have_angles_where_the_box_of_widths_lets_them(system, decomposer):
    """70 degrees, 1500 m, 1.1 mrad: six widths of the pulse; all end at the bound of four but those of `adaptive`."""
    block = planes(system, 70.0, height=1500.0)
    usual = chain_of(decomposer, "system").run(block, system)
    strongest = usual.amplitude > 20
    lost = np.isnan(usual.attributes["incidence_angle"][strongest]).mean()
    assert lost > 0.9 if decomposer == "reference" else lost < 0.05
    found = chain_of(decomposer, "system", most_width=12.0).run(block, system)
    off = found.attributes["incidence_angle"] - 70.0
    known = np.isfinite(off)
    assert known.mean() > 0.85
    assert abs(np.median(off[known])) < 0.3
    error = found.attributes["incidence_angle_err"][known]
    assert np.mean(np.abs(off[known]) < error) == pytest.approx(0.68, abs=0.08)


@pytest.mark.parametrize("kappa", [0.0, 0.2, 0.4])
def test_the_light_of_a_skewed_echo_is_its_integral_over_that_of_a_facing_surface(kappa):
    """Skew adds area: a strip's skew counts for all of its echoes alike, that of one echo only as it differs."""
    block = WaveformBlock.from_samples(np.zeros((1, 80), np.uint8), bits=8, spacing=0.5)
    system = replace(SYSTEM, kappa=kappa)
    time = np.linspace(-40.0, 120.0, 400_001)

    def area(skew):
        inside = 1.0 + skew * time / 3.0
        level = np.log(np.maximum(inside, 1e-300)) / skew if skew else time / 3.0
        return np.sum(np.where(inside > 0, np.exp(-0.5 * level**2), 0.0))

    plain = EchoTable.build([0], [20.0], [50.0], [3.0])
    assert echo_light(block, system, plain) == pytest.approx([150.0], rel=1e-6)
    for skew in (0.1, 0.5):
        own = plain.with_attributes(skew=np.array([skew], np.float32))
        assert echo_light(block, system, own) == pytest.approx([150.0 * area(skew) / area(kappa)], rel=2e-4)


@pytest.mark.parametrize("power", [1.4, 2.0, 3.0])
def test_the_light_of_a_generalized_echo_is_its_integral(power):
    """exp(-|z|^p / 2) with the same width at half height: its area over that of the Gaussian."""
    block = WaveformBlock.from_samples(np.zeros((1, 80), np.uint8), bits=8, spacing=0.5)
    time = np.linspace(-300.0, 300.0, 600_001)
    half = 3.0 * np.sqrt(2.0 * np.log(2.0))
    unit = half / (2.0 * np.log(2.0)) ** (1.0 / power)
    area = np.sum(np.exp(-0.5 * np.abs(time / unit) ** power)) / np.sum(np.exp(-0.5 * (time / 3.0) ** 2))
    echoes = EchoTable.build([0], [20.0], [50.0], [3.0]).with_attributes(power=np.array([power], np.float32))
    assert echo_light(block, SYSTEM, echoes) == pytest.approx([150.0 * area], rel=2e-4)


def test_only_echoes_alone_have_a_reflectance_and_an_angle():
    """Several targets share the light of a pulse: none says how much of it the others had."""
    block, echoes, _ = make(np.full(40, 30.0), per_waveform=2)
    done = run(block, echoes, SYSTEM, *NAMES).attributes
    for name in ("level_reflectance", "level_reflectance_err", "incidence_angle"):
        assert np.isnan(done[name]).all(), name
    assert (done["level_reflectance_reason"] == NoData.SHARED_PULSE).all() and np.isfinite(done["cross_section"]).all()
    done = run(block, echoes, SYSTEM, "incidence_angle", incidence_angle={"alone": False}).attributes
    assert np.isfinite(done["incidence_angle"]).all()


def test_level_reflectances_at_edges_are_left_out_with_the_reason():
    """Those that are no data already keep their reason."""
    name = "level_reflectance"
    columns = {name: [0.3, 0.4, np.nan, 0.5], f"{name}_err": [0.01, 0.02, np.nan, 0.03]}
    columns = {key: np.array(values, np.float32) for key, values in columns.items()}
    columns[f"{name}_reason"] = np.array([0, 0, NoData.TOO_STEEP, 0], np.uint8)
    table = EchoTable.build(np.arange(4), np.full(4, 5.0), np.full(4, 9.0), np.ones(4)).with_attributes(
        edge=np.array([True, False, True, True]), **columns
    )
    found = hide_values(table, name, table.attributes["edge"], NoData.EDGE).attributes
    assert found[f"{name}_reason"].tolist() == [NoData.EDGE, 0, NoData.TOO_STEEP, NoData.EDGE]
    for key in (name, f"{name}_err"):
        assert np.isnan(found[key]).tolist() == [True, False, True, True] and found[key][1] == columns[key][1]


ERROR = 0.02
"""Of the fitted times [ns]."""


def place(times, locations, aside=0.0, length=1.0, **errors):
    """x and range_err of echoes at `times` in one packet whose returns lie at `locations` [ns along the ray], the last
    one `aside` [ns] of it."""
    block = WaveformBlock.from_samples(np.zeros((1, 80), np.uint8))
    k, direction = len(locations), np.array([[length * HALF_C, 0.0, 0.0]])
    xyz = block.origin + np.array(locations, float)[:, None] * direction
    xyz[-1, 2] += aside * HALF_C
    returns = ReturnTable(np.zeros(k, np.int32), np.array(locations, float), np.arange(k), xyz)
    block = replace(block, returns=returns, direction=direction)
    n = len(times)
    echoes = EchoTable.build(np.zeros(n), np.array(times), np.full(n, 50.0), np.full(n, 2.0),
                             time_err=np.full(n, ERROR))  # fmt: skip
    system = SystemPulse(2.0).with_radiometry(**errors)
    done = position(block, Noise(np.zeros(1, "f4"), np.ones(1, "f4")), system, echoes)
    return (done.attributes["x"] - block.origin[0, 0]) / HALF_C, done.attributes["range_err"] / HALF_C


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_returns_that_contradict_each_other_widen_the_error(shift):
    # The vendor gave one return for what the fit sees as a later centre: one of the two places must be wrong.
    at, error = place([20.0, 40.0], [20.0, 40.0 - shift])
    assert at == pytest.approx([20.0 - shift / 2, 40.0 - shift / 2], abs=1e-3)
    assert error == pytest.approx(np.hypot(ERROR, shift / 2), rel=1e-3)


def test_an_added_echo_has_the_error_of_its_packet():
    at, error = place([20.0, 40.0, 60.0], [20.0, 39.0])
    assert at[2] == pytest.approx(59.5, abs=1e-3) and error[2] == pytest.approx(np.hypot(ERROR, 0.5), rel=1e-3)


@pytest.mark.parametrize("locations", [[19.6], [19.6, 39.61], [19.6, 39.6, 59.59]])
def test_returns_that_agree_within_their_errors_leave_the_error_of_the_fit(locations):
    _, error = place([20.0, 40.0, 60.0][: len(locations)], locations)
    assert error == pytest.approx(ERROR, rel=1e-3)


@pytest.mark.parametrize(("aside", "held"), [(5.0, 5.0), (0.9, 0.0)])
def test_returns_off_the_ray_are_in_the_errors_of_their_echoes(aside, held):
    """Vendors bend rays at water; a location may be rounded to a sample, which is no bend."""
    at, error = place([20.0, 40.0, 60.0], [20.0, 40.0], aside=aside)
    assert at == pytest.approx([20.0, 40.0, 60.0], abs=1e-3)
    assert error == pytest.approx([ERROR, np.hypot(ERROR, held), np.hypot(ERROR, held)], rel=1e-3)
    assert place([20.0], [20.0], aside=5.0)[1] == pytest.approx(ERROR, rel=1e-3)


def test_returns_have_their_scatter_and_echoes_without_one_the_phase_or_how_far_it_is():
    errors = {"returns": 0.03 * HALF_C, "phase": 4.0 * HALF_C}
    cases = (([19.6], 0.03), ([19.6, 39.6], 0.03), ([19.6, 38.6], 0.5), ([43.2], 4.0), ([99.0], 59.0), ([0, 8.0], 12.0))
    for locations, other in cases:
        _, error = place([20.0, 40.0], locations, **errors)
        assert error == pytest.approx(np.hypot(ERROR, other), rel=1e-3)


@pytest.mark.parametrize(("phase", "held"), [(0.29, 2.0), (0.9, 0.03), (0.0, 0.03)])
def test_an_offset_that_is_no_phase_is_in_the_error(phase, held):
    """A vendor's one return in the middle of two surfaces .7 m apart: both were .35 m off, with errors of 1 mm."""
    at, error = place([20.0, 24.0], [22.0], returns=0.03 * HALF_C, phase=phase * HALF_C)
    assert abs(at[0] - 20.0) == pytest.approx(2.0, abs=1e-3)
    assert error == pytest.approx(np.hypot(ERROR, held), rel=1e-3)


@pytest.mark.parametrize("length", [0.9997, 1.0, 0.97, 1.03])
def test_vectors_of_a_wrong_length_are_in_the_errors_of_echoes_far_from_returns(length):
    """An echo 8 m below the only return was .24 m off, with an error of 1 mm; below 1.02 without a word."""
    _, error = place([20.0, 60.0], [20.0], length=length)
    missed = 40.0 * max(abs(length - 1.0), abs(length - 0.9997)) * (abs(length - 1.0) > 0.001)
    assert error == pytest.approx([ERROR * length, np.hypot(ERROR * length, missed)], rel=1e-3)


@pytest.mark.parametrize("lone", [0, 1])
def test_a_packet_without_a_return_takes_no_other_packets_time(lone):
    """Its place counts from its origin: so does the error of a vector of a wrong length."""
    block = WaveformBlock.from_samples(np.zeros((2, 80), np.uint8))
    returns = ReturnTable(np.array([1 - lone], np.int32), np.array([20.0]), np.zeros(1, int), block.origin[:1])
    block = replace(block, returns=returns, direction=np.array([[1.03 * HALF_C, 0.0, 0.0]] * 2))
    echoes = EchoTable.build(np.arange(2.0), np.full(2, 20.0), np.full(2, 50.0), np.full(2, 2.0),
                             time_err=np.full(2, ERROR))  # fmt: skip
    done = position(block, Noise(np.zeros(2, "f4"), np.ones(2, "f4")), SystemPulse(2.0).with_radiometry(), echoes)
    error = done.attributes["range_err"] / HALF_C
    assert error[lone] == pytest.approx(np.hypot(ERROR * 1.03, 20.0 * 0.0303), rel=1e-3)
    assert error[1 - lone] == pytest.approx(ERROR * 1.03, rel=1e-3)


SYSTEMS = {
    "gaussian": SystemPulse(2.0),
    "learned": SystemPulse(2.0, components=((1.0, 0.0, 2.0), (0.1, 5.0, 2.2))),
}


def deviate_slowly(block, noise, system, echoes):
    """Every echo on its own, in double precision: residual of the whole waveform, two projections."""
    s = block.samples.shape[1]
    x = np.arange(s, dtype=float)
    shape, limits = pulse_tables.pulse_shape(system, 1.0), pulse_tables.shape_limits(system, 1.0)
    whole = np.stack([echoes.amplitude, echoes.time, echoes.sigma], axis=1).astype(float)
    lobes = [(1.0, 0.0, 0.0), *shape.components]
    values = []
    for row in range(len(echoes)):
        waveform = echoes.waveform[row]
        residual = block.samples[waveform] - float(noise.baseline[waveform])
        for amplitude, time, width in pulse_tables.model_parameters(shape, limits, whole)[echoes.waveform == waveform]:
            for weight, delay, extra in lobes:
                wide = np.sqrt(width**2 + extra)
                height = amplitude * weight * width / wide
                residual = residual - height * np.exp(-0.5 * ((x - time - delay) / wide) ** 2)
        amplitude, time, sigma = whole[row]
        reach = min(int(np.ceil(5 * sigma)), s)
        near = np.abs(x - np.rint(time)) <= reach
        z = (x[near] - time) / sigma
        total = 0.0
        for direction in (8 * z**3 - 12 * z, 16 * z**4 - 48 * z**2 + 12):
            direction = direction * np.exp(-0.5 * z * z)
            total += (direction @ residual[near]) ** 2 / (direction @ direction)
        std = float(noise.std[waveform])
        values.append(np.sqrt(total) / std / (amplitude / std * np.sqrt(sigma)))
    return np.array(values)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("scene", ["urban", "forest", "stiff.edge"])
def test_deviation_is_that_of_a_plain_loop(scene, name):
    system = SYSTEMS[name]
    block, truth = make_block(scene, 120, seed=3)
    noise = Noise(np.full(len(block), 12.2, np.float32), np.full(len(block), 1.1, np.float32))
    found = STAGES["attribute.pulse_deviation"].function(block, noise, system, truth).attributes["pulse_deviation"]
    assert found == pytest.approx(deviate_slowly(block, noise, system, truth), rel=1e-3, abs=1e-5)
