"""Comparison of clouds with each other and with the truth, and of chains on a strip."""

import csv
import json
import tracemalloc
from dataclasses import replace

import laspy
import naive
import numpy as np
import pytest
from commands import refuses, run_command, succeed
from writer_tools import number_returns, write_points

from wavebatch.cli.compare import HEAD, list_rows
from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.units import AIR_SPEED
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.cloud_reader import CLOUD_DTYPE, CloudReader
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.decompose.models import fitted_pulse, rebuild_waveforms
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.tools.compare_chains import Contender, FitQuality, find_contender, match_sides, measure_fit
from wavebatch.tools.pairing import Differences, compare_clouds, compare_truth
from wavebatch.tools.sheets.sheet import format_csv
from wavebatch.tools.simulate import PULSES, SCENES, Recording, StripOptions, TruthReader, simulate_strip
from wavebatch.tools.simulate.render import paint_echoes

CORNER = np.array([500_000.0, 5_400_000.0, 0.0])


def write_cloud(path, gps_time, xyz, *, scale=1e-4, point_format=6, names=None, **columns):
    """A plain cloud with float extra bytes, NaN for no data, and echo_flags where given."""
    columns = {(names or {}).get(name, name): np.asarray(values) for name, values in columns.items()}
    how = {"scale": scale, "offsets": CORNER, "point_format": point_format}
    how["extra"] = [(name, values.dtype) for name, values in columns.items()]
    write_points(path, xyz, **how, **({} if gps_time is None else {"gps_time": gps_time}), **columns)


def make_pulses(n=300, seed=0):
    """Pulses with 1 to 3 echoes 2 m and more apart along slanted rays: times, positions, unit vectors."""
    rng = np.random.default_rng(seed)
    pulse, number, _ = number_returns(rng.integers(1, 4, n))
    ray = np.stack([rng.uniform(-0.3, 0.3, n), rng.uniform(-0.3, 0.3, n), -np.ones(n)], axis=1)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    start = np.array([500_100.0, 5_400_100.0, 150.0]) + np.stack([np.arange(n), np.zeros(n), np.zeros(n)], axis=1)
    along = 2.5 * (number - 1) + rng.uniform(0, 0.4, len(pulse))
    return pulse, 3e8 + 1e-5 * pulse, start[pulse] + along[:, None] * ray[pulse], ray[pulse]


def test_many_points_without_a_time_are_matched_in_bounded_memory(tmp_path):
    _, times, xyz, _ = make_pulses(2000)
    rng = np.random.default_rng(2)
    loose = xyz[0] + rng.uniform(0, [2000, 2000, 0.01], (20_000, 3))
    every, place = np.append(times, np.zeros(20_000)), np.concatenate([xyz, loose])
    write_cloud(tmp_path / "a.las", every, place)
    write_cloud(tmp_path / "b.las", every[:-500], place[:-500])
    tracemalloc.start()
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las")
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert result.matched_by == "gps_time" and (result.missed, result.extra) == (0, 500)
    crowded = np.zeros(5000), np.full((5000, 3), xyz[0])
    write_cloud(tmp_path / "a.las", np.append(times, crowded[0]), np.concatenate([xyz, crowded[1]]))
    refuses(InputError, "without a valid GPS time", compare_clouds, tmp_path / "a.las", tmp_path / "a.las")


@pytest.mark.parametrize("held", [400_000, 100])
def test_time_zero_is_one_pulse_whatever_its_sign(tmp_path, held):
    _, times, xyz, _ = make_pulses()
    times -= times[0]
    write_cloud(tmp_path / "a.las", times, xyz)
    write_cloud(tmp_path / "b.las", np.where(times == 0, -0.0, times), xyz)
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las", in_memory=held)
    assert result.matched_by == "gps_time" and result.missed == result.extra == 0


def test_points_passed_through_are_no_echoes(tmp_path):
    _, times, xyz, _ = make_pulses()
    flags = np.zeros(len(times), "u2")
    flags[:3] = [EchoFlag.NO_WAVEFORM, EchoFlag.BROKEN_PACKET | EchoFlag.WEAK, EchoFlag.NO_ECHO]
    flags[3] = EchoFlag.WEAK
    write_cloud(tmp_path / "a.las", times, xyz, echo_flags=flags)
    write_cloud(tmp_path / "b.las", times, xyz)
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las")
    assert result.echoes_a == len(times) - 3
    assert result.missed == 3


@pytest.mark.parametrize("times_are", ["missing", "zero", "of another day"])
def test_without_useful_times_nearest_neighbours_are_matched(tmp_path, times_are):
    _, times, xyz, ray = make_pulses(3000)
    given = {"missing": None, "zero": np.zeros(len(times)), "of another day": times + 86400}[times_are]
    write_cloud(tmp_path / "a.las", given, xyz + 0.3 * AIR_SPEED * ray, point_format=0 if given is None else 6)
    write_cloud(tmp_path / "b.las", times[:-20], xyz[:-20])
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las", in_memory=1500)
    assert result.matched_by == "position"
    # Rays cross here and there: a handful of points have a stranger as their nearest neighbour.
    assert len(times) - 20 >= result.matched > len(times) - 25
    assert (result.echoes_a, result.echoes_b) == (len(times), len(times) - 20)
    assert result.differences["time"].median == pytest.approx(0.3, abs=1e-3)
    assert result.pulses == 0
    assert np.isnan(result.exact_count)


def test_times_that_formats_round_differently_match_by_position(tmp_path):
    _, times, xyz, ray = make_pulses(3000)
    rounded = np.where(np.arange(len(times)) < 5, times, times + 0.25e-6)
    write_cloud(tmp_path / "a.las", rounded, xyz + 0.3 * AIR_SPEED * ray)
    write_cloud(tmp_path / "b.las", times, xyz)
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las")
    assert result.matched_by == "position" and result.matched > len(times) - 10
    write_cloud(tmp_path / "c.las", times[: len(times) // 2], xyz[: len(times) // 2])
    for pair in (("b", "c"), ("c", "b")):
        half = compare_clouds(*(tmp_path / f"{name}.las" for name in pair))
        assert half.matched_by == "gps_time" and half.matched == len(times) // 2


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """A strip, its truth, and a cloud made of the truth with errors at the bound, all reported rightly."""
    folder = tmp_path_factory.mktemp("strip")
    options = StripOptions(point_format=9, without_waveform=0.02)
    simulate_strip("mixed", folder / "s.laz", pulses=4000, seed=3, truth=folder / "t.npz", options=options)
    with TruthReader(folder / "t.npz") as reader, np.load(folder / "t.npz") as whole:
        noise, truth = reader.meta["noise_std"], dict(whole)
    rng = np.random.default_rng(4)
    sigma = truth["sigma"].astype(float)
    bounds = crlb(truth["amplitude"], sigma, noise, 1.0)
    error = [bound * rng.standard_normal(len(sigma)) for bound in bounds]
    xyz = np.stack([truth[k] for k in "xyz"], axis=1)
    xyz[:, 2] -= error[0] * AIR_SPEED
    write_cloud(
        folder / "a.las",
        truth["gps_time"],
        xyz,
        echo_time=(truth["time"] + error[0]).astype("f4"),
        amplitude=(truth["amplitude"] + error[1]).astype("f4"),
        echo_width=(2.3548 * (sigma + error[2])).astype("f4"),
        amplitude_err=bounds[1].astype("f4"),
        echo_width_err=(2.3548 * bounds[2]).astype("f4"),
        range_err=(AIR_SPEED * bounds[0]).astype("f4"),
    )
    return folder, truth


def test_errors_against_truth_are_in_units_of_the_bound(strip):
    folder, truth = strip
    result = compare_truth(folder / "a.las", folder / "t.npz")
    assert result.completeness > 0.999
    assert result.exact_count == 1.0
    isolated = result.errors["isolated"]
    assert isolated["time"].number == truth["isolated"].sum()
    assert result.errors["overlapped"]["time"].number == pytest.approx(truth["overlapped"].sum(), abs=5)
    for name in ("time", "echo_time", "amplitude", "sigma"):
        assert isolated[name].rms_per_bound == pytest.approx(1.0, abs=0.05)
        assert isolated[name].calibration == pytest.approx(1.0, abs=0.05)
        assert abs(isolated[name].bias) < 0.1 * isolated[name].rmse


def test_true_widths_are_of_all_lobes(tmp_path):
    """`run` gives full widths; that of the main lobe alone made right ones 10 errors off."""
    scene = replace(SCENES["flat"], recording=Recording(pulse=PULSES["leica"]))
    simulate_strip(scene, tmp_path / "s.las", pulses=300, seed=3, truth=tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as truth:
        n, recording = len(truth["sigma"]), Recording(n_samples=4000, spacing=0.02, pulse=PULSES["leica"])
        y = paint_echoes(recording, n, np.arange(n), np.full(n, 40.0), np.ones(n), truth["sigma"].astype(float))
        width = (0.02 * np.count_nonzero(y > 0.5 * y.max(axis=1)[:, None], axis=1)).astype("f4")
        xyz = np.stack([truth[k] for k in "xyz"], axis=1)
        write_cloud(tmp_path / "a.las", truth["gps_time"], xyz, echo_width=width)
    found = compare_truth(tmp_path / "a.las", tmp_path / "t.npz").differences["echo_width"]
    assert found.number == n and width.min() > 7.6 and found.rms < 0.02


def test_vendor_returns_against_truth_and_against_the_result(strip):
    folder, truth = strip
    vendor = compare_truth(folder / "s.laz", folder / "t.npz")
    assert vendor.correctness == 1.0
    assert 0.8 < vendor.completeness < 0.95
    assert vendor.differences["time"].rms < 0.005
    assert set(vendor.differences) == {"time"}
    assert vendor.errors["all"]["echo_time"].number == 0
    both = compare_clouds(folder / "a.las", folder / "s.laz")
    assert both.missed <= 3
    assert both.extra == pytest.approx(vendor.missed, abs=5)
    assert abs(both.differences["time"].median) < 0.01
    parts = compare_truth(folder / "s.laz", folder / "t.npz", in_memory=500)
    assert parts.matched == vendor.matched
    assert parts.errors["isolated"]["time"].number == truth["isolated"].sum()


def test_empty_packets_count_as_pulses(tmp_path):
    simulate_strip("empty", tmp_path / "s.las", pulses=1000, seed=3, truth=tmp_path / "t.npz")
    write_cloud(tmp_path / "none.las", np.zeros(0), np.zeros((0, 3)))
    result = compare_truth(tmp_path / "none.las", tmp_path / "t.npz")
    with TruthReader(tmp_path / "t.npz") as reader:
        assert result.pulses == reader.meta["packets"]
    assert result.exact_count == pytest.approx(0.8, abs=0.04)
    assert result.counts_a == {0: result.pulses}
    assert result.completeness == 0
    assert np.isnan(result.correctness)
    vendor = compare_truth(tmp_path / "s.las", tmp_path / "t.npz")
    assert vendor.extra == pytest.approx(result.counts_b[0], abs=10)


def test_lag_follows_the_stored_vector_of_either_sign():
    a, b = np.zeros(3, CLOUD_DTYPE), np.zeros(3, CLOUD_DTYPE)
    a["xyz"] = [[0, 3, -4], [0, 3, -4], [0, 0, 2]]
    b["ray"][:2] = [[0, -0.6e-4, 0.8e-4], [0, 0.6e-4, -0.8e-4]]
    for some, lag in ((slice(0, 1), 5), (slice(1, 2), 5), (slice(2, 3), -2)):
        one, other = Differences(), Differences()
        one.add(a[some], b[some])
        other.add(b[some], a[some])
        assert one.sums["time"][1] * AIR_SPEED == pytest.approx(lag) == -other.sums["time"][1] * AIR_SPEED


def test_many_pairs_are_thinned_evenly():
    rng = np.random.default_rng(5)
    whole = Differences(1000)
    heights = rng.standard_normal(20_000)
    for part in np.array_split(heights, 37):
        a, b = np.zeros(len(part), CLOUD_DTYPE), np.zeros(len(part), CLOUD_DTYPE)
        a["xyz"][:, 2] = -part
        a["amplitude"] = np.nan
        whole.add(a, b)
    spread = whole.spreads()["time"]
    assert spread.number == 20_000
    assert spread.rms == pytest.approx(np.sqrt((heights**2).mean()) / AIR_SPEED)
    assert spread.median == pytest.approx(0, abs=0.15 / AIR_SPEED)
    assert spread.nmad == pytest.approx(1 / AIR_SPEED, rel=0.12)
    assert "amplitude" not in whole.spreads()


def test_columns_of_other_styles_and_collisions_are_understood(tmp_path):
    _, times, xyz, _ = make_pulses(20)
    values = np.full(len(times), 4.25, "f4")
    for name in ("EchoWidth", "wb echo_width"):
        write_cloud(tmp_path / "a.las", times, xyz, names={"echo_width": name}, echo_width=values)
        with CloudReader(tmp_path / "a.las") as reader:
            assert reader.columns == ("echo_width",)
            assert next(reader.read_pieces())["echo_width"] == pytest.approx(values)
    extra = [("pulse width", "u2", 0, 0.1), ("Amplitude", "u2", None, 0.01, "dB")]
    write_points(tmp_path / "b.las", xyz[:2] - CORNER, extra=extra, **{"pulse width": [4.2, 0.0]})
    with CloudReader(tmp_path / "b.las") as reader:
        assert reader.columns == ("echo_width",)
        rows = next(reader.read_pieces())
    assert rows["echo_width"][0] == pytest.approx(4.2)
    assert np.isnan(rows["echo_width"][1])
    assert np.isnan(rows["amplitude"]).all()


def test_clouds_are_read_in_pieces_and_twice(tmp_path):
    _, times, xyz, _ = make_pulses(100)
    write_cloud(tmp_path / "a.laz", times, xyz)
    with CloudReader(tmp_path / "a.laz") as reader:
        for _ in range(2):
            pieces = list(reader.read_pieces(33))
            assert max(map(len, pieces)) == 33
            assert np.array_equal(np.concatenate(pieces)["gps_time"], times)
            assert np.allclose(np.concatenate(pieces)["xyz"], xyz, atol=1e-4)


@pytest.mark.parametrize("by", ["time", "place"])
def test_missed_and_extra_are_broken_down_as_a_loop_does_it(tmp_path, by):
    pulse, times, xyz, ray = make_pulses(2000, seed=6)
    rng = np.random.default_rng(7)
    _, number, total = number_returns(np.bincount(pulse))
    times = times if by == "time" else np.zeros(len(times))
    keep = rng.random(len(times)) < 0.8
    moved = xyz.copy()
    far = rng.random(len(times)) < 0.05
    moved[far] += 1.03 * AIR_SPEED * ray[far]
    flags = np.where(far, EchoFlag.WEAK | EchoFlag.OVERLAPPED, np.where(rng.random(len(times)) < 0.3, 32, 0))
    amplitude = np.exp(rng.uniform(-1, 6, len(times))).astype("f4")
    amplitude[:9] = np.nan
    kinds = rng.choice([1, 2, 5, 64], len(times))
    write_cloud(tmp_path / "a.las", times[keep], moved[keep], echo_flags=flags[keep].astype("u2"))
    write_cloud(tmp_path / "b.las", times, xyz, amplitude=amplitude)
    for name, these in (("a.las", keep), ("b.las", np.ones(len(keep), bool))):
        cloud = laspy.read(tmp_path / name)
        cloud.return_number, cloud.number_of_returns = number[these], total[these]
        cloud.intensity = np.full(these.sum(), 9)
        cloud.classification = kinds[these]
        cloud.write(tmp_path / name)
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las", in_memory=900)
    missed, extra = far | ~keep, far & keep
    naive = {"return": {}, "amplitude": {}, "flag": {}, "class": {}}
    names = {1: "1 unclassified", 2: "2 ground", 5: "5 high vegetation", 64: "64"}
    for echo in range(len(times)):
        classes = {"return": f"{number[echo]} of {total[echo]}", "class": names[kinds[echo]]}
        if not np.isnan(amplitude[echo]):
            n = int(np.floor(np.log2(amplitude[echo])))
            classes["amplitude"] = "below 1" if n < 0 else f"{2**n}-{2 ** (n + 1)}"
        for kind, name in classes.items():
            old = naive[kind].get(name, (0, 0))
            naive[kind][name] = (old[0] + int(missed[echo]), old[1] + 1)
    assert (result.missed, result.extra) == (missed.sum(), extra.sum())
    assert result.missed_by["return"] == naive["return"]
    assert result.missed_by["amplitude"] == naive["amplitude"]
    assert result.missed_by["class"] == naive["class"]
    assert set(result.missed_by) == {"return", "class", "amplitude", *(["pulse"] if by == "time" else [])}
    of = keep & ~far & (flags == 32)
    weak = {"WEAK": (extra.sum(), extra.sum() + of.sum()), "OVERLAPPED": (extra.sum(), extra.sum())}
    assert result.extra_by["flag"] == {**weak, "none": (0, (keep & (flags == 0)).sum())}
    assert result.extra_by["intensity"] == {"8-16": (extra.sum(), keep.sum())}
    if by == "time":
        found = np.bincount(pulse[keep], minlength=2000)[pulse] > 0
        assert result.counts_b == dict(enumerate(np.bincount(np.bincount(pulse)).tolist()[1:], 1))
        assert result.missed_by["pulse"] == {
            "nothing of the other side": ((missed & ~found).sum(), (~found).sum()),
            "other echoes of the other side": ((missed & found).sum(), found.sum()),
        }
    back = compare_clouds(tmp_path / "b.las", tmp_path / "a.las")
    assert (back.extra_by, back.missed_by) == (result.missed_by, result.extra_by)
    both = 2 * result.matched / (result.echoes_a + result.echoes_b)
    assert result.identical == pytest.approx(both) and result.to_json()["identical"] == result.identical
    assert result.gain == pytest.approx(keep.sum() / len(times) - 1)


def _set_fields(path, **fields):
    cloud = laspy.read(path)
    for name, values in fields.items():
        cloud[name] = values
    cloud.write(path)


@pytest.mark.parametrize("point_format", [1, 6])
@pytest.mark.parametrize("classified", ["a", "b", "both"])
def test_differences_by_class_and_by_number_of_echoes(tmp_path, classified, point_format):
    """Each class has its own shift; the classes of b count, and those of a only where b has none."""
    pulse, times, xyz, ray = make_pulses(1500, seed=3)
    kinds = np.random.default_rng(4).choice([1, 2, 6], len(times))
    total = np.bincount(pulse)[pulse]
    shift = 0.1 * kinds + 0.01 * total
    place = xyz + (shift * AIR_SPEED)[:, None] * ray
    for name, where in (("a", place), ("b", xyz)):
        write_cloud(tmp_path / f"{name}.las", times, where)
        _set_fields(tmp_path / f"{name}.las", number_of_returns=total, return_number=np.ones(len(times), int))
        if point_format == 1:
            cloud = laspy.convert(laspy.read(tmp_path / f"{name}.las"), point_format_id=1, file_version="1.2")
            cloud.synthetic = np.ones(len(times), int)  # a flag in the byte of the class
            cloud.write(tmp_path / f"{name}.las")
        if classified in (name, "both"):
            # Where both have classes, those of a are wrong on purpose.
            _set_fields(
                tmp_path / f"{name}.las",
                classification=np.full(len(kinds), 9) if (name, classified) == ("a", "both") else kinds,
            )
    result = compare_clouds(tmp_path / "a.las", tmp_path / "b.las")
    assert list(result.differences_by) == ["class", "echoes"]
    names = {1: "1 unclassified", 2: "2 ground", 6: "6 building"}
    for kind, values, titles in (("class", kinds, names), ("echoes", total, {1: "1", 2: "2", 3: "3"})):
        groups = result.differences_by[kind]
        assert list(groups) == list(titles.values())
        for value, title in titles.items():
            lag, found = shift[values == value], groups[title]["time"]
            assert found.number == len(lag)
            assert (found.median, found.mean) == pytest.approx((np.median(lag), lag.mean()), abs=2e-3)
            assert found.rms == pytest.approx(np.sqrt(np.mean(lag**2)), abs=2e-3)
    document = result.to_json()["differences_by"]
    assert document["class"]["2 ground"]["time"]["number"] == (kinds == 2).sum()


def test_clouds_without_classes_have_no_table_of_them(tmp_path):
    _, times, xyz, _ = make_pulses(50)
    write_cloud(tmp_path / "a.las", times, xyz)
    result = compare_clouds(tmp_path / "a.las", tmp_path / "a.las")
    assert "class" not in result.differences_by and "class" not in result.missed_by


def run(*words):
    return run_command("compare", *words)


def read(path):
    with path.open(newline="") as file:
        return {tuple(row[name] for name in HEAD[:5]): row["value"] for row in csv.DictReader(file)}


def test_rows_are_the_figures_of_the_document(tmp_path, tiny_strip):
    target = tmp_path / "t.csv"
    result = succeed("compare", "fast", "balanced", "--strip", tiny_strip, "--limit", 200, "-o", target, "--json")
    found, document = read(target), json.loads(result.stdout)
    between = document
    assert float(found["all", "", "", "", "completeness"]) == pytest.approx(between["completeness"])
    for number, pulses in between["counts_a"].items():
        assert int(found["echoes per pulse", "A", "", number, "pulses"]) == pulses
    for kind, classes in between["missed_by"].items():
        for name, (alone, of) in classes.items():
            assert int(found["missed", "B", kind, name, "echoes"]) == alone
            assert float(found["missed", "B", kind, name, "share"]) == pytest.approx(alone / of)
    for side in "ab":
        title = f"all, {side.upper()} and the vendor's returns"
        assert int(found[title, "", "", "", "matched"]) == document["vendor"][side]["matched"]
    for name, spread in between["differences"].items():
        assert float(found["differences", "", "", name, "rms"] or "nan") == pytest.approx(
            float("nan") if spread["rms"] is None else spread["rms"], nan_ok=True
        )
    assert set(between["differences_by"]["echoes"]) >= {"1", "2"}
    for group, quantities in between["differences_by"]["echoes"].items():
        for quantity, spread in quantities.items():
            rows = {
                key[4]: value
                for key, value in found.items()
                if key[:4] == ("differences by echoes", "", group, quantity)
            }
            assert int(rows["number"]) == spread["number"]
            assert float(rows["mean"]) == pytest.approx(spread["mean"])
    assert not any("(" in value for value in found.values())


def test_no_data_is_an_empty_cell():
    document = {"gain": float("nan"), "errors": {"all": {"time": {"bias": None, "number": 3}}}}
    text = format_csv(HEAD, list_rows(document))
    assert text.splitlines()[1:] == ["all,,,,gain,", "errors,,all,time,bias,", "errors,,all,time,number,3"]


def make_chain(detector, decomposer, **parameters):
    steps = (Step(STAGES["noise.pooled"]), Step(STAGES[f"detect.{detector}"], parameters))
    return Chain((*steps, Step(STAGES[f"decompose.{decomposer}"])), f"{detector}+{decomposer}")


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A strip of 900 pulses, and the clouds of two profiles."""
    folder = tmp_path_factory.mktemp("mixed")
    call("simulate", "mixed", "-o", folder / "s.las", "--pulses", 900, "--seed", 5, "--spacing", 0.8, "--samples", 100)
    for profile in ("fast", "accurate"):
        call("run", folder / "s.las", "-o", folder / profile, "--profile", profile, "-q")
    return folder


def call(*arguments, code=0):
    result = run_command(*arguments)
    assert result.exit_code == code, result.output
    return result


def pair_naively(a, b, tolerance):
    """Greedy pairs of times, nearest first."""
    every = sorted((abs(x - y), j, i) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= tolerance)
    pairs, used_a, used_b = [], set(), set()
    for _, j, i in every:
        if i not in used_a and j not in used_b:
            pairs.append((i, j))
            used_a.add(i)
            used_b.add(j)
    return pairs


def test_two_chains_as_a_loop_over_waveforms_finds_it(mixed):
    sides = find_contender("fast"), find_contender("accurate")
    result = match_sides(mixed / "s.las", *sides)
    with StripReader(mixed / "s.las") as reader, reader.scan() as scan:
        system = survey_blocks(read_sample(reader, scan)).system
        ((block, _),) = list(reader.read_blocks(reader.read_unit(0, scan), 5000, owned_only=True))
    a, b = (side.chain.run(block, system) for side in sides)
    differences, exact, counts = [], 0, ({}, {})
    for w in range(len(block)):
        times = [table.time[table.waveform == w] for table in (a, b)]
        differences += [times[0][i] - times[1][j] for i, j in pair_naively(*times, 1.0)]
        exact += len(times[0]) == len(times[1])
        for side in (0, 1):
            counts[side][len(times[side])] = counts[side].get(len(times[side]), 0) + 1
    between = result.between
    assert between.matched_by == "waveform" and result.waveforms == between.pulses == len(block)
    assert (between.matched, between.missed, between.extra) == (
        len(differences), len(b) - len(differences), len(a) - len(differences)
    )  # fmt: skip
    assert between.exact_count == exact / len(block)
    assert (between.counts_a, between.counts_b) == tuple(dict(sorted(one.items())) for one in counts)
    assert "echo_time" not in between.differences  # would be the same figures
    spread = between.differences["time"]
    assert spread.median == pytest.approx(np.median(differences), abs=1e-9)
    assert spread.rms == pytest.approx(np.sqrt(np.mean(np.square(differences))), rel=1e-9)
    nmad = 1.4826 * np.median(np.abs(differences - np.median(differences)))
    assert spread.nmad == pytest.approx(nmad, rel=1e-6)
    assert between.gain == pytest.approx(len(a) / len(b) - 1)
    assert result.returns == len(block.returns)
    assert abs(result.vendor["b"].differences["amplitude"].median) < 3, "of the nearest samples"
    parts = match_sides(mixed / "s.las", *sides, block_size=97)
    assert parts.between.differences["time"].rms == pytest.approx(spread.rms, rel=1e-12)
    assert parts.vendor["b"].missed_by == result.vendor["b"].missed_by
    assert parts.fit["a"]["multi"].median == result.fit["a"]["multi"].median
    assert parts.fit["b"]["all"].mean == pytest.approx(result.fit["b"]["all"].mean, rel=1e-12)


def test_a_chain_and_its_own_cloud_are_identical(mixed):
    cloud = mixed / "accurate" / "s.laz"
    for sides in (("accurate", str(cloud)), (str(cloud), "accurate")):
        result = match_sides(mixed / "s.las", *map(find_contender, sides))
        assert result.between.matched_by == "gps_time"
        assert (result.between.missed, result.between.extra) == (0, 0)
        assert result.between.differences["echo_width"].rms < 1e-6
        chain, other = ("a", "b") if sides[0] == "accurate" else ("b", "a")
        assert result.fit[other] == {} and result.fit[chain]["all"].waveforms > 600
        assert set(result.vendor) == {chain}


def test_a_part_of_the_strip_and_a_saved_survey(mixed, tmp_path):
    call("survey", mixed / "s.las", "-o", tmp_path / "system.toml")
    text = call("compare", "--strip", mixed / "s.las", "fast", "auto", "--limit", 200, "--system",
                tmp_path / "system.toml", "--json").stdout  # fmt: skip
    document = json.loads(text)
    assert document["waveforms"] == document["pulses"] == 200
    assert document["fit"]["a"]["both"]["mean"] > 0 and document["vendor"]["b"]["missed"] >= 0
    assert document["b"] == "auto" and "NaN" not in text


def test_text_has_every_table(mixed):
    out = " ".join(call("compare", "--strip", mixed / "s.las", "fast", mixed / "accurate" / "s.laz").stdout.split())
    for words in ("identical, of all", "more points", "missed, of B's", "extra, of A's", "return 1 of 2", "flag ",
                  "/waveform", "mean E0", "A single", "B no-data"):  # fmt: skip
        assert words in out, words
    call("compare", "--strip", mixed / "s.las", "fast", "accurate", "--min-completeness", 1.0, code=1)


@pytest.mark.slow
def test_what_the_readme_says_of_the_real_strip(riegl):
    """The after-pulse of nearly every echo is a second maximum: the ASDF passes over it, the pulse explains it."""
    chains = {
        "maxima": make_chain("maximum", "gaussian"),
        "asdf": make_chain("asdf", "asdf_only"),
        "adaptive": make_chain("maximum", "adaptive"),
    }
    one = match_sides(riegl, *(Contender(name, chains[name]) for name in ("maxima", "asdf")))
    two = match_sides(riegl, *(Contender(name, chains[name]) for name in ("maxima", "adaptive")))
    assert one.between.counts_a[2] > 0.55 * 2375 and one.between.counts_b[1] > 0.9 * 2375
    for result in (one, two):
        number, of = result.between.extra_by["flag"]["RINGING_SUSPECT"]
        assert number > 0.97 * of and number > 0.75 * result.between.extra
        assert result.between.completeness > 0.9 and result.between.differences["time"].nmad < 0.02
    assert two.vendor["b"].missed < one.vendor["a"].missed < one.vendor["b"].missed
    assert two.fit["b"]["all"].median < two.fit["a"]["all"].median < 0.5 * one.fit["b"]["all"].median
    assert (one.waveforms, one.returns) == (2375, 2535)
    assert two.vendor["b"].completeness > 0.99 and 0.03 < two.vendor["b"].gain < 0.12
    refuses(InputError, "", match_sides, riegl, Contender("auto"), find_contender(str(riegl.with_suffix(".wdp"))))


FINE = 100.0


def record(y, std):
    block = WaveformBlock.from_samples(np.rint(2000 + FINE * y).astype(np.uint16))
    return block, Noise(np.full(len(y), 2000, np.float32), np.full(len(y), FINE * std, np.float32))


def decompose(name, block, noise, system, **parameters):
    step = Step(STAGES[f"decompose.{name}"], parameters)
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    return step, step.stage.function(block, noise, system, candidates, **parameters)


def test_every_decomposer_says_what_it_fits():
    steps = [Step(stage) for stage in STAGES.values() if stage.kind == "decompose"]
    unfitted = {step.stage.name for step in steps if fitted_pulse(step, SystemPulse(2.0), 1.0) is None}
    assert unfitted == {"decompose.none"}


def test_what_was_not_fitted_is_no_data():
    x = np.arange(80.0)
    block, noise = record(100 * naive.pulse(x, 30.0, 2.0)[None], std=0.05)
    step, found = decompose("none", block, noise, SystemPulse(2.0))
    assert len(found) and rebuild_waveforms(block, SystemPulse(2.0), step, found) is None
    misfit, floor = measure_fit(block, noise, SystemPulse(2.0), step, found)
    assert np.isnan(misfit).all() and np.isnan(floor).all()
    quality = FitQuality()
    quality.add(misfit, floor, found.count(1), np.ones(1, bool))
    assert quality.result() == {}


def test_as_a_loop_does_it(rng):
    """Waveforms with 0 to 3 Gaussian echoes, some clipped: E, E0, means and medians of the classes."""
    n, s, top = 300, 64, 255
    count = rng.integers(0, 4, n)
    waveform = np.repeat(np.arange(n), count)
    time, amplitude, sigma = (rng.uniform(*ends, len(waveform)) for ends in ((5, 59), (10, 300), (1.5, 3)))
    order = np.lexsort((time, waveform))
    echoes = EchoTable.build(waveform[order], time[order], amplitude[order], sigma[order])
    baseline, std = rng.uniform(1, 12, n).astype("f4"), rng.uniform(0.5, 2, n).astype("f4")
    missing = rng.random((n, s)) < 0.05
    x = np.arange(float(s))
    samples = np.zeros((n, s), np.uint8)
    naive_e, naive_floor = np.full(n, np.nan), np.full(n, np.nan)
    for w in range(n):
        mine = np.flatnonzero(waveform == w)
        f = sum((amplitude[m] * naive.pulse(x, time[m], sigma[m]) for m in mine), np.zeros(s))
        samples[w] = np.clip(np.rint(baseline[w] + f + std[w] * rng.standard_normal(s)), 0, top)
        used = (samples[w] < top) & (samples[w] > 0) & ~missing[w]
        if len(mine):
            naive_e[w] = ((f - (samples[w] - float(baseline[w])))[used] ** 2).sum() / (f[used] ** 2).sum()
            naive_floor[w] = used.sum() * float(std[w]) ** 2 / (f[used] ** 2).sum()
    assert (samples == top).any() and (samples == 0).any()
    block = replace(WaveformBlock.from_samples(samples), missing=missing)
    step = Step(STAGES["decompose.gaussian"])
    system = SystemPulse(2.0, noise=ReceiverNoise(baseline=10.0))  # far above 0, where samples are cut off
    misfit, floor = measure_fit(block, Noise(baseline, std), system, step, echoes)
    np.testing.assert_allclose(misfit, naive_e, rtol=1e-4)
    np.testing.assert_allclose(floor, naive_floor, rtol=1e-5)
    quality, both = FitQuality(), (count > 0) & (rng.random(n) < 0.5)
    for part in np.array_split(np.arange(n), 7):
        quality.add(misfit[part], floor[part], count[part], both[part])
    found = quality.result()
    for name, rows in (("all", count > 0), ("single", count == 1), ("multi", count > 1), ("both", both)):
        assert found[name].waveforms == rows.sum()
        assert found[name].mean == pytest.approx(naive_e[rows].mean(), rel=1e-4)
        assert found[name].median == pytest.approx(np.median(naive_e[rows]), rel=1e-4)
        assert found[name].floor_mean == pytest.approx(naive_floor[rows].mean(), rel=1e-4)
        assert found[name].floor_median == pytest.approx(np.median(naive_floor[rows]), rel=1e-4)


def test_the_floor_is_that_of_single_samples_where_noise_is_coloured():
    """Thresholds use what noise does to a pulse: E0 was .116 on a strip whose fits leave .024."""
    block, noise = record(100 * naive.pulse(np.arange(60.0), 30.0, 2.0)[None], std=1.0)
    echo = EchoTable.build(np.zeros(1), np.array([30.0]), np.array([100 * FINE]), np.array([2.0]))
    step = Step(STAGES["decompose.gaussian"])
    plain = measure_fit(block, noise, SystemPulse(2.0, noise=ReceiverNoise(std=1.6)), step, echo)[1]
    system = SystemPulse(2.0, noise=ReceiverNoise(std=1.6, by_kind={"quiet": 0.8}))
    coloured = measure_fit(block, noise, system, step, echo)[1]
    assert coloured == pytest.approx(plain / 4, rel=1e-5)


def test_floor_of_the_specification():
    """0.00159 for 60 samples, amplitude over noise 100, sigma 2.123."""
    block, noise = record(100 * naive.pulse(np.arange(60.0), 30.0, 2.123)[None], std=1.0)
    echo = EchoTable.build(np.zeros(1), np.array([30.0]), np.array([100 * FINE]), np.array([2.123]))
    misfit, floor = measure_fit(block, noise, SystemPulse(2.123), Step(STAGES["decompose.gaussian"]), echo)
    assert floor[0] == pytest.approx(0.00159, abs=1e-5)
    assert misfit[0] < 1e-6
