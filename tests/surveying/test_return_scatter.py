"""How exactly returns were placed, and that errors of places and ranges hold it: traced strips with noise on points."""

import json

import footprints
import numpy as np
import pytest
from commands import run_command, succeed
from footprints import EAST, NORTH, Flight, Plane, match, roofs, write_strip

import wavebatch as wb
from wavebatch.core.echoes import EchoFlag
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.measuring.return_scatter import ReturnScatter, _measure, _sample, measure_returns

pytestmark = pytest.mark.kept_surveys

TOWN = [*roofs([0, 20, 38, 55]), Plane(0.25)]
HILL = [Plane(slope=(np.tan(np.radians(22.0)), 0.1))]
def measure(path):
    with StripReader(path) as reader, reader.scan() as scan:
        return measure_returns(reader, scan, wb.survey(path).system)


def share_within(folder, planes, flight, seed):
    """Of places along the ray within range_err, and of ranges within range_error."""
    truth = write_strip(folder / "strip.las", planes, flight, 6000, seed)
    chain = folder / "chain.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.adaptive", "attribute.position", "attribute.range")
    chain.write_text("".join(f'[[chain]]\nstage = "{stage}"\n' for stage in stages))
    wb.run(folder / "strip.las", folder / "out", chain=chain, columns="range,range_err,range_error")
    cloud = wb.read_cloud(folder / "out" / "strip.laz")
    rows = match(cloud["gps_time"], truth)
    origin, ray = footprints._fly(flight, np.arange(6000) / flight.rate)
    place = np.stack([cloud[name] for name in "xyz"], axis=1) - (origin[rows] + [EAST, NORTH, 0.0])
    # A pulse whose footprint lies on two planes has two echoes, and one place that is true.
    known = truth.pure[rows] & np.isfinite(cloud["range_err"]) & np.isfinite(cloud["range"])
    along = np.abs((place * ray[rows]).sum(axis=1) - truth.range[rows])[known]
    away = np.abs(cloud["range"] - truth.range[rows])[known]
    assert known.mean() > 0.9
    return np.mean(along <= cloud["range_err"][known]), np.mean(away <= cloud["range_error"][known])


@pytest.mark.parametrize(
    ("planes", "flight", "seed"),
    [
        (TOWN, Flight(), 11),
        pytest.param(TOWN, Flight(point_error=0.02, height=900.0, light=3e8), 12, marks=pytest.mark.slow),
        pytest.param(TOWN, Flight(point_error=0.005, height=300.0, half_angle=25.0), 13, marks=pytest.mark.slow),
        pytest.param(HILL, Flight(point_error=0.03), 14, marks=pytest.mark.slow),
        pytest.param(HILL, Flight(spacing=1.0, point_error=0.01), 15, marks=pytest.mark.slow),
    ],
)
def test_two_of_three_places_and_ranges_are_within_their_errors(tmp_path, planes, flight, seed):
    places, ranges = share_within(tmp_path, planes, flight, seed)
    assert 0.60 < places < 0.80
    assert 0.60 < ranges < 0.80


@pytest.mark.quick_cases("0.05")
@pytest.mark.parametrize("scatter", [0.005, 0.05])
def test_the_scatter_of_points_is_measured(tmp_path, scatter):
    write_strip(tmp_path / "a.las", TOWN, Flight(point_error=scatter), 6000, 3)
    found = measure(tmp_path / "a.las")
    assert found.scatter == pytest.approx(scatter, rel=0.15)
    assert found.phase == pytest.approx(scatter, rel=0.15)  # these locations have no phase


@pytest.mark.parametrize("values", [None, 21])
def test_rounded_coordinates_are_in_the_scatter(tmp_path, edit_points, values):
    """Locations knew returns to 1 mm, whose coordinates are multiples of half a metre; values: a raster of so few."""

    def round_places(points):
        points["Y"] = 500 * (np.arange(len(points)) % values if values else np.round(points["Y"] / 500.0))
        return points

    write_strip(tmp_path / "a.las", TOWN, Flight(point_error=0.005), 3000, 3)
    found = measure(edit_points(tmp_path / "a.las", tmp_path / "b.las", round_places))
    rounding = found.scatter == pytest.approx(0.5 / 12.0**0.5)
    assert rounding == (found.source == "rounding") == (values is None), found


@pytest.mark.parametrize(("wrong", "late"), [(1.0, 10.0), (0.1, -15.0)], ids=["all", "some"])
def test_locations_that_are_wrong_are_in_the_errors_of_their_echoes(tmp_path, edit_points, wrong, late):
    """10 ns too late in all packets, or 0 in a tenth: echoes were 1.5 to 3 m off with errors of 1 mm."""

    def delay(points):
        rows = np.random.default_rng(1).random(len(points)) < wrong
        points["return_point_wave_location"] += 1e3 * late * rows.astype("f4")
        return points

    write_strip(tmp_path / "a.las", TOWN, Flight(point_error=0.005), 3000, 3)
    strip = edit_points(tmp_path / "a.las", tmp_path / "b.las", delay)
    succeed("run", strip, "-o", tmp_path / "out", "--profile", "fast", "--columns", "range_err,echo_flags")
    cloud = wb.read_cloud(tmp_path / "out" / "b.laz")
    lost = (cloud["echo_flags"] & EchoFlag.UNANCHORED) != 0
    assert lost.sum() > 0.8 * wrong * 3000
    assert np.median(cloud["range_err"][lost]) == pytest.approx(0.15 * abs(late), rel=0.05)
    assert wrong == 1.0 or np.nanmedian(cloud["range_err"][~lost]) < 0.01


def test_scatter_and_phase_are_printed_and_in_the_report(tiny_strip, tmp_path):
    done = run_command("run", tiny_strip, "-o", tmp_path, "-v", "--profile", "fast")
    found = json.loads((tmp_path / f"{tiny_strip.stem}.report.json").read_text())["strip"]["sensor"]["returns"]
    assert found["from"] in ("neighbours", "pairs of returns", "locations") and 0.03 < found["phase_m"] < 0.07
    said = f"returns were placed to {found['scatter_m']:.3f} m, by {found['from']}; an echo without a return is off by"
    assert f"{said} {found['phase_m']:.3f} m" in done.stderr


@pytest.mark.parametrize("ratio", [0.3, 0.6, 2.0])
@pytest.mark.parametrize("number", [40, 400])
def test_few_residuals_never_say_that_returns_are_exact(rng, ratio, number):
    """Of strips with 40 residuals and large errors of fits, 40 % had a scatter of 0."""
    found = np.empty(300)
    for i in range(len(found)):
        fits = 0.01 * np.exp(0.5 * rng.standard_normal(number))
        off = np.hypot(0.01 * ratio * 1.5**0.5, fits) * rng.standard_normal(number)
        found[i] = _measure(np.stack([off, np.full(number, 1.5), fits]))
    assert np.mean(found < 0.2 * 0.01 * ratio) < 0.05
    assert 0.95 < np.sqrt(np.mean(found**2)) / (0.01 * ratio) < (2.2 if ratio < 0.5 and number < 100 else 1.5)
    # A clear echo: its fit has a fifth of the usual error.
    off = np.hypot(0.01 * ratio, 0.002) * rng.standard_normal(len(found))
    assert 0.6 < np.mean(np.abs(off) < np.hypot(found, 0.002)) < 0.86


@pytest.mark.slow
def test_real_strips(riegl, leica):
    assert measure(riegl).scatter < 0.012
    assert measure(leica) == ReturnScatter(
        pytest.approx(0.0045, abs=0.002), pytest.approx(0.045, abs=0.005), "locations"
    )


def test_the_order_of_packets_does_not_decide(riegl, tmp_path):
    """Exported, RIEGL had 43 pairs of returns among the packets looked at in place of 15, and less than half the error.
    """
    succeed("export", riegl, "-o", tmp_path / "a.las")
    found = measure(tmp_path / "a.las")
    assert (found.scatter, found.source) == (pytest.approx(0.007, abs=5e-4), "neighbours")


def test_without_enough_echoes_a_scatter_is_assumed(tmp_path):
    write_strip(tmp_path / "a.las", TOWN, Flight(light=1e3), 400, 3)
    assert measure(tmp_path / "a.las").source == "assumed"
    assert measure(tmp_path / "a.las").scatter == 0.02


def test_no_packet_of_a_small_strip_counts_twice(tmp_path):
    """Four runs of packets overlapped on a strip of 200: pairs of returns counted up to four times."""
    write_strip(tmp_path / "a.las", TOWN, Flight(point_error=0.01), 200, 3)
    with StripReader(tmp_path / "a.las") as reader, reader.scan() as scan:
        parts = list(_sample(reader, scan, wb.survey(tmp_path / "a.las").system))
    for kind in zip(*parts, strict=True):
        residuals = np.concatenate(kind, axis=-1)
        assert residuals.shape == np.unique(residuals, axis=-1).shape


def test_a_phase_of_the_pulse_is_no_scatter(tiny_strip):
    """Locations of simulated returns are up to half a sample off, their points are true."""
    found = measure(tiny_strip)
    assert found.scatter < 0.005 and 0.03 < found.phase < 0.07
