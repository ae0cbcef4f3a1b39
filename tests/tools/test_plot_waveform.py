"""Pictures of waveforms with their fits, and the signals that detectors search."""

import csv
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from commands import refuses, run_command, succeed
from plot_tools import PULSE, make_chain, simulate
from scipy.optimize import curve_fit
from strips import make_raw

import wavebatch as wb
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.files.strip.reader import StripReader
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.signal.filters import find_minima, keep_prominent
from wavebatch.stages.chain import STAGES, Step, load_profile, parse_chain
from wavebatch.stages.noise import pooled
from wavebatch.surveying import survey_block
from wavebatch.tools.compare_chains import ChainRun, measure_fit
from wavebatch.tools.plots import waveform
from wavebatch.tools.plots.charts import measure_view_residuals
from wavebatch.tools.plots.draw_waveform import _draw_panels, draw_waveform_panels, draw_waveform_sheet
from wavebatch.tools.plots.waveform import build_views, choose_step, see_block

KAPPA = 0.15


def run(*words):
    return run_command("plot", "waveform", *words)


def test_residuals_are_those_of_the_cleaned_samples():
    """The noise stage ran again on the raw samples: residuals of sloping baselines were 3.6 times the noise."""
    rng = np.random.default_rng(8)
    at = np.arange(120)
    time, height = rng.uniform(40, 60, (1000, 1)), rng.uniform(6, 100, (1000, 1))
    slope = 0.08 * rng.standard_normal((1000, 1))
    exact = 40 + slope * (at - 59.5) + height * np.exp(-0.125 * (at - time) ** 2)
    counts = np.clip(np.rint(exact + 0.7 * rng.standard_normal((1000, 120))), 0, 255).astype(np.uint8)
    block = WaveformBlock.from_samples(counts)
    system, chain = survey_block(block).system, load_profile("accurate")
    chain = replace(chain, steps=chain.steps[:3])
    assert system.defects.slope_spread > 0.05
    views = waveform.build_views(block, chain, system, range(1000))
    residual = np.array([np.sqrt(np.nanmean(view.residual**2)) for view in views])
    assert np.median(residual) == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(measure_view_residuals(block, chain, system), residual, rtol=1e-3)
    found = ChainRun(chain, system, 1.0)
    solved = found.find(block)
    misfit, floor = measure_fit(solved.block, solved.noise, solved.system, chain.steps[2], solved.echoes)
    assert np.nanmedian(misfit / floor) == pytest.approx(1.0, abs=0.2)


def gaussian(time, amplitude, centre, width):
    return amplitude * np.exp(-0.5 * ((time - centre) / width) ** 2)


# The log-normal as printed has the skew of its origin, whatever the pulse is: tests/stages/test_stages_contract.py.
OTHERS = ("decompose.none", "decompose.log_normal")


@pytest.mark.parametrize("name", [name for name in STAGES if name.startswith("decompose.") and name not in OTHERS])
def test_curves_are_the_fit_of_every_decomposer(name):
    shape, system, parameters = PulseShape(), PULSE, {}
    if name == "decompose.skewed":
        shape, system = PulseShape(kappa=KAPPA), replace(PULSE, kappa=KAPPA)
    elif name == "decompose.reference":
        system, parameters = replace(PULSE, components=((1.0, 0.0, 2.0), (0.03, 8.0, 2.0))), {"model": "stretched"}
        shape = PulseShape(components=((0.03, 8.0, 0.0),))
    block = simulate(shape, [(100.0, 30.3, 2.0)])
    views = waveform.build_views(block, make_chain(name, **parameters), system, range(len(block)))
    assert len(views) == 20
    worst = {"decompose.asdf_only": 4.0, "decompose.asdf_mixed": 4.0}.get(name, 1.25)
    for view in views:
        assert len(view.echoes) == 1 and len(view.curves) == 1 and len(view.total) == len(view.fine)
        near = np.abs(view.time - 30) <= 5
        assert np.sqrt(np.mean(view.residual[near] ** 2)) < worst + 0.6
        curve = view.curves[0]
        assert np.abs(np.delete(view.total, np.r_[curve.part])).max() < 1e-4 * curve.height.max()
        top = curve.height.max()
        assert top == pytest.approx(float(view.echoes.amplitude[0]), rel=0.01)
        # The datum of a pulse is the centre of the Gaussian that fits it best.
        (_, centre, _), _ = curve_fit(gaussian, view.fine[curve.part], curve.height, (top, 30, 2))
        assert centre == pytest.approx(float(view.echoes.time[0]), abs=0.1)
    rms = np.sqrt(np.mean([np.mean(view.residual[np.abs(view.time - 30) <= 5] ** 2) for view in views]))
    assert rms < worst


def test_view_against_a_plain_sum_of_gaussians():
    block = simulate(PulseShape(), [(100.0, 30.3, 2.0), (60.0, 37.0, 2.5)])
    system = replace(PULSE, noise=replace(PULSE.noise, gain=0.05))
    chain = make_chain("decompose.gaussian")
    whole = chain.run(block, system)
    for row, view in enumerate(waveform.build_views(block, chain, system, range(len(block)))):
        mine = whole.take(np.flatnonzero(whole.waveform == row))
        for name in ("time", "amplitude", "sigma", "flags", "time_err"):
            assert np.array_equal(getattr(view.echoes, name), getattr(mine, name))
        assert np.array_equal(view.samples, block.samples[row]) and view.std == 1.0
        model = np.zeros(80)
        for a, t, w in zip(mine.amplitude, mine.time, mine.sigma, strict=True):
            model += float(a) * np.exp(-0.5 * ((view.time - t) / float(w)) ** 2)
        noise = np.sqrt(1.0 + 0.05 * model)
        assert view.residual == pytest.approx((view.samples - view.baseline - model) / noise, abs=1e-4)
        assert view.fit[::8] == pytest.approx(view.baseline + model, abs=1e-4)
        assert np.array_equal(view.fine[::8], view.time)


def test_clipped_samples_count_only_where_the_fit_lies_below():
    block = simulate(PulseShape(), [(400.0, 30.3, 2.0)], n=1)
    (view,) = waveform.build_views(block, make_chain("decompose.gaussian"), PULSE, [0])
    assert view.clipped.sum() >= 3 and np.array_equal(view.clipped, block.samples[0] == 255)
    assert np.isnan(view.residual[view.clipped]).any()
    assert np.isfinite(view.residual[~view.clipped]).all()
    assert view.echoes.flags[0] & EchoFlag.SATURATED


def test_views_of_a_strip_are_what_a_run_gives(tiny_strip):
    chain = load_profile("balanced")
    wanted = waveform.Wanted(packets=((5, 8), (300, 301), (6, 7)), points=(0, 400), times=())
    found = {}
    for points in (50_000, 37):
        with StripReader(tiny_strip, unit_points=points) as reader, reader.scan() as scan:
            places = waveform.find_places(reader, scan, wanted, None)
            found[points] = waveform.read_views(reader, scan, places, chain, PULSE)
            blocks = [
                (block.rows(slice(row, row + 1)), int(block.point[row]))
                for number in range(reader.unit_count())
                for block, _ in reader.read_blocks(reader.read_unit(number, scan), 64, True)
                for row in range(len(block))
            ]
    blocks.sort(key=lambda pair: pair[1])
    one, other = found.values()
    assert [view.packet for view in one][:4] == [5, 6, 7, 300]
    assert [view.point for view in one] == [view.point for view in other]
    assert one[4].point == 0 and 400 in blocks[one[5].packet][0].returns.point
    for view, twin in zip(one, other, strict=True):
        block, point = blocks[view.packet]
        assert point == view.point == twin.point and view.gps_time == block.gps_time[0]
        assert np.array_equal(view.samples, block.samples[0]) and np.array_equal(twin.samples, view.samples)
        assert np.array_equal(view.returns, block.returns.time)
        table = chain.run(block, PULSE)
        assert np.array_equal(view.echoes.time, table.time) and np.array_equal(twin.echoes.time, table.time)


def test_pulses_are_found_by_time_and_flag(tiny_strip):
    chain = load_profile("fast")
    with StripReader(tiny_strip) as reader, reader.scan() as scan:
        tables = []
        for block, _ in reader.read_blocks(reader.read_unit(0, scan), 64, True):
            tables.append((block, chain.run(block, PULSE)))
        times = np.concatenate([block.gps_time for block, _ in tables])
        asked = float(times[17] + 0.3 * np.diff(np.sort(times)).min())
        (place,) = waveform.find_places(reader, scan, waveform.Wanted(times=(asked,)), None)
        (view,) = waveform.read_views(reader, scan, [place], chain, PULSE)
        assert view.gps_time == times[17]
        refuses(ConfigError, "nearest is", waveform.find_places, reader, scan, waveform.Wanted(times=(5.0,)), None)
        bits = np.bitwise_or.reduce(np.concatenate([table.flags for _, table in tables]))
        assert bits
        flagged = sorted(
            int(block.point[row])
            for block, table in tables
            for row in np.unique(table.waveform[(table.flags & bits) != 0])
        )
        wanted = waveform.Wanted(selection=PointFilter(flags=int(bits)), most=4)
        places = waveform.find_places(reader, scan, wanted, lambda block: chain.run(block, PULSE))
        assert [view.point for view in waveform.read_views(reader, scan, places, chain, PULSE)] == flagged[:4]
        with pytest.raises(InputError, match="no echo"):
            waveform.find_places(reader, scan, wanted, lambda block: chain.run(block, PULSE).take(np.empty(0, int)))


def test_without_a_wish_a_few_are_spread_over_the_strip(tiny_strip):
    with StripReader(tiny_strip) as reader, reader.scan() as scan:
        places = waveform.find_places(reader, scan, waveform.Wanted(most=5), None)
        assert [place.packet for place in places] == np.linspace(0, scan.packets - 1, 5).round().astype(int).tolist()


def test_strips_without_waveforms(tmp_path, riegl, data):
    raw = make_raw(4)
    raw.points["wavepacket_index"] = 0
    nothing = raw.write(tmp_path / "nothing.las")
    mixed = make_raw(4)
    mixed.points["wavepacket_index"][0] = 0
    mixed = mixed.write(tmp_path / "mixed.las")
    for path, words in (
        (nothing, ()), (mixed, ("--point", 0)), (tmp_path / "none.las", ()), (data / "no-packets/simple1_3.las", ()),
    ):  # fmt: skip
        result = run(path, "-o", tmp_path / "p.png", *words)
        assert result.exit_code in (1, 2) and result.stderr.count("\n") == 1, result.output
        assert "wave" in result.stderr or "packet" in result.stderr or "none.las" in result.stderr
        assert not (tmp_path / "p.png").exists()


@pytest.mark.quick_cases("1")
@pytest.mark.parametrize("samples", [1, 2, 8])
def test_short_waveforms_can_be_drawn(tmp_path, samples):
    strip = make_raw(5, n_samples=samples).write(tmp_path / "short.las")
    succeed("plot", "waveform", strip, "-o", tmp_path / "p.png", "--packet", 2, "--profile", "fast")


def test_pictures_say_what_they_show_with_the_same_bytes_each_time(tiny_strip, tmp_path):
    words = (tiny_strip, "-o", tmp_path / "p.svg", "--packet", 3, "--overwrite")
    assert run(*words).exit_code == 0
    first = (tmp_path / "p.svg").read_bytes()
    assert run(*words, "-q").output == "" and (tmp_path / "p.svg").read_bytes() == first
    text = first.decode()
    parts = ("tiny.las", "auto: detect.maximum, decompose", "packet 3", "GPS time", "signal [DN]", "[noise std]")
    for part in (*parts, "amplitude [DN]"):
        assert part in text, part
    assert "time after the first sample [ns]" in text and "returns of the file" in text


@pytest.mark.parametrize(
    ("suffix", "start"), [(".png", b"\x89PNG"), pytest.param(".pdf", b"%PDF", marks=pytest.mark.slow)]
)
def test_several_waveforms_and_other_kinds_of_file(tiny_strip, tmp_path, suffix, start):
    target = tmp_path / f"p{suffix}"
    result = run(tiny_strip, "-o", target, "--packet", "0:2", "--point", 20, "--profile", "fast", "--times", "0:40")
    assert result.exit_code == 0 and "3 waveforms" in result.stderr, result.output
    assert target.read_bytes().startswith(start)


def test_a_chain_that_fits_nothing_is_drawn_without_a_fit(tiny_strip, tmp_path):
    chain = tmp_path / "none.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.none", "attribute.amplitude", "attribute.position")
    chain.write_text("".join(f'[[chain]]\nstage = "{stage}"\n' for stage in stages))
    parse_chain(chain.read_text(), "none")
    succeed("plot", "waveform", tiny_strip, "-o", tmp_path / "p.svg", "--packet", 3, "--chain", chain)
    assert "this chain fits no pulse" in (tmp_path / "p.svg").read_text("utf-8")


@pytest.mark.slow
def test_no_display_and_no_home_are_needed(tiny_strip, tmp_path):
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MPLCONFIGDIR")}
    environment |= {"HOME": str(tmp_path / "nowhere"), "MPLBACKEND": "TkAgg"}
    command = [sys.executable, "-m", "wavebatch", "plot", "waveform", str(tiny_strip), "-o", "p.png", "-q"]
    command += ["--packet", "3", "--profile", "fast"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_the_signal_is_shown_and_the_whole_on_request(tiny_strip):
    block = simulate(PulseShape(), [(100.0, 30.3, 2.0), (50.0, 45.0, 2.0)], s=400)
    for view in waveform.build_views(block, make_chain("decompose.gaussian"), PULSE, range(20)):
        low, high = view.span
        assert 0 <= low < 25 and 50 < high < 100
        seen = view.time[view.samples > view.level + 5 * view.std]
        assert low < seen.min() and seen.max() < high
    quiet = simulate(PulseShape(), [], s=100, n=1)
    (view,) = waveform.build_views(quiet, make_chain("decompose.gaussian"), PULSE, [0])
    assert len(view.echoes) or view.span == (-0.5, 99.5)


@pytest.mark.quick_cases("100000.0", "inf", "nan")
@pytest.mark.parametrize("error", [20.0, 1e5, 1e30, np.inf, np.nan])
def test_no_error_bar_presses_the_waveform_into_a_line(tmp_path, error):
    block = simulate(PulseShape(), [(100.0, 30.3, 2.0)], n=1)
    (view,) = waveform.build_views(block, make_chain("decompose.gaussian"), PULSE, [0])
    table = replace(view.echoes, amplitude_err=np.array([error], np.float32))
    with open_picture(tmp_path / "e.png", (6, 5), overwrite=True) as figure:
        panels = _draw_panels(figure, figure.add_gridspec(1, 1)[0], replace(view, echoes=table), view.span,
                              small=False, room=5.0)  # fmt: skip
    low, high = panels[0].get_ylim()
    assert 100 < high - low < 400


def test_echoes_are_listed_and_written(tiny_strip, tmp_path):
    target = tmp_path / "e.csv"
    result = run(tiny_strip, "-o", target, "--packet", "0:30", "--profile", "balanced")
    assert result.exit_code == 2 and f"{waveform.MOST_IN_PICTURE} fit" in result.stderr
    assert run(tiny_strip, "-o", target, "--packet", "0:20", "--profile", "balanced").exit_code == 0
    with StripReader(tiny_strip) as reader, reader.scan() as scan:
        places = waveform.find_places(reader, scan, waveform.Wanted(packets=((0, 20),)), None)
        views = waveform.read_views(reader, scan, places, load_profile("balanced"), PULSE)
    rows = list(csv.DictReader(target.read_text().splitlines()))
    assert [int(row["packet"]) for row in rows if row["echo"] in ("", "1")] == list(range(20))
    found = [row for row in rows if row["echo"]]
    assert len(found) > 15 and len(rows[0]) == len(set(rows[0]))
    for row in found:
        view = views[int(row["packet"])]
        assert int(row["point"]) == view.point
        near = np.argmin(np.abs(view.echoes.time - float(row["echo_time [ns]"])))
        assert float(row["echo_time [ns]"]) == pytest.approx(float(view.echoes.time[near]), abs=0.5)
        assert float(row["echo_width [ns]"]) > 0 and float(row["amplitude_err [DN]"]) > 0
        # The distance from the sensor, which simulated vectors give.
        assert 100 < float(row["range [m]"]) < 10_000
    text = waveform.list_echoes(views, most=3)
    assert "more: -o FILE.csv" in text and "packet" in text.split("\n")[0]
    errors = [view.echoes.amplitude * 1e-6 for view in views]
    long = [replace(view, echoes=replace(view.echoes, amplitude_err=e)) for view, e in zip(views, errors, strict=True)]
    lines = waveform.list_echoes([*long[:2], *views[2:]]).split("\n")
    assert len({line.rindex("  ") for line in lines}) == 1, "flags start in one column"


def test_real_waveforms(riegl, leica, tmp_path):
    chain = load_profile("accurate")
    with StripReader(riegl) as reader, reader.scan() as scan:
        (place,) = waveform.find_places(reader, scan, waveform.Wanted(points=(514,)), None)
        views, unit = waveform.read_views(reader, scan, [place], chain, PULSE), reader.read_unit(place.unit, scan)
        assert views[0].packet == 475 and unit.packet_of_point[514 - unit.start] == place.row
        assert views[0].samples.max() == pytest.approx(183, abs=20)
    assert run(leica, "-o", tmp_path / "l.png", "--most", 1).exit_code == 0


def test_long_texts_lose_their_middle():
    assert plain_text("a" * 100, 21) == "a" * 9 + "..." + "a" * 9
    assert plain_text(" a\n\x00 b\t") == "a b" and plain_text("abc", 3) == "abc"


@pytest.mark.slow
def test_random_packets_are_those_of_their_seed_and_fit_on_a_sheet(tiny_strip, tmp_path):
    with StripReader(tiny_strip) as reader, reader.scan() as scan:
        random = [waveform.Wanted(random=40, seed=seed, sheet=True) for seed in (1, 1, 2)]
        drawn = [[place.packet for place in waveform.find_places(reader, scan, one, None)] for one in random]
        assert drawn[0] == drawn[1] == sorted(set(drawn[0])) and len(drawn[0]) == 40 and drawn[0] != drawn[2]
        assert len(waveform.find_places(reader, scan, waveform.Wanted(packets=((0, 60),), sheet=True), None)) == 60
        with pytest.raises(ConfigError, match=f"{waveform.MOST_IN_PICTURE} fit"):
            waveform.find_places(reader, scan, waveform.Wanted(random=40), None)
        # As many as a sheet holds.
        assert len(waveform.find_places(reader, scan, waveform.Wanted(sheet=True), None)) == 100
        refuses(ConfigError, "100 with --sheet", waveform.find_places, reader, scan, waveform.Wanted(most=30), None)
    target = tmp_path / "sheet.svg"
    words = (tiny_strip, "-o", target, "--random", 9, "--seed", 1, "--sheet", "--profile", "fast", "--overwrite")
    result = run(*words)
    assert result.exit_code == 0 and "9 waveforms" in result.stderr, result.output
    first = target.read_bytes()
    assert first.decode().count("packet ") == 9 and "returns of the file" in first.decode()
    assert run(*words).exit_code == 0 and target.read_bytes() == first


def test_titles_name_every_flag_of_many_echoes(tmp_path):
    peaks = [(100.0, 20.3 + 8 * k, 2.0) for k in range(3)]
    (view,) = waveform.build_views(simulate(PulseShape(), peaks, n=1), make_chain("decompose.gaussian"), PULSE, [0])
    view.echoes.flags[:] = int(EchoFlag.SATURATED | EchoFlag.OVERLAPPED | EchoFlag.AMPLITUDE_UNRELIABLE)
    draw_waveform_panels([view] * 3, tmp_path / "w.svg", strip="s", chain="c")
    text = (tmp_path / "w.svg").read_text("utf-8")
    for name in ("SATURATED", "OVERLAPPED", "AMPLITUDE_UNRELIABLE"):
        assert text.count(f"{name} 1,2") == 3


def test_a_sheet_shows_waveforms_without_echo_and_saturated_ones(tmp_path):
    views = waveform.build_views(
        simulate(PulseShape(), [(400.0, 30.3, 2.0)], n=2), make_chain("decompose.gaussian"), PULSE, [0, 1]
    )
    quiet = simulate(PulseShape(), [(0.1, 30.3, 2.0)], n=1)
    views += waveform.build_views(quiet, make_chain("decompose.none"), PULSE, [2])
    draw_waveform_sheet(views, tmp_path / "s.svg", strip="a.las", chain="test")
    text = (tmp_path / "s.svg").read_text("utf-8")
    assert "SATURATED" in text and "no echo" in text and "3 waveforms" in text


def test_waveforms_are_those_with_an_echo_that_meets_a_condition(tiny_strip):
    chain = load_profile("balanced")
    chosen = PointFilter.build(where="number_of_returns >= 2 and not echo_width > 5 and not flag(WEAK)")
    with StripReader(tiny_strip) as reader, reader.scan() as scan:
        wanted = waveform.Wanted(selection=chosen, most=4)
        places = waveform.find_places(reader, scan, wanted, lambda block: chain.run(block, PULSE))
        every = [waveform.Place(unit.number, row, -1) for unit in reader.read_units(scan)
                 for row in np.flatnonzero(unit.packets.owned)[:400].tolist()]  # fmt: skip
        meets = []
        for place, view in zip(every, waveform.read_views(reader, scan, every, chain, PULSE), strict=True):
            good = (view.echoes.attributes["echo_width"] <= 5) & ((view.echoes.flags & EchoFlag.WEAK) == 0)
            if len(view.echoes) >= 2 and good.any():
                meets.append((place.unit, place.row))
    assert len(places) == 4 and [(place.unit, place.row) for place in places] == meets[:4]


def test_a_listed_range_has_the_error_of_the_sensor_too(tiny_strip):
    with StripReader(tiny_strip) as reader, reader.scan() as scan:
        places = waveform.find_places(reader, scan, waveform.Wanted(packets=((0, 5),)), None)
        chain, fill, error = waveform.add_ranges(load_profile("balanced"), reader, scan)
        assert 0.001 < error < 0.02
        views = waveform.read_views(reader, scan, places, chain, PULSE.with_radiometry(sensor_error=0.3), None, fill)
    places = [line.split("\N{PLUS-MINUS SIGN}")[-1].split()[0] for line in waveform.list_echoes(views).splitlines()[1:]]
    assert places and all(float(place) == pytest.approx(0.3, rel=0.1) for place in places)


def test_a_table_has_the_values_and_errors_of_the_cloud(tmp_path, leica):
    """The scatter of the vendor's returns was not in the errors of places: they were half of those of the run."""
    succeed("plot", "waveform", leica, "--packet", "0:9", "-o", tmp_path / "e.csv")
    succeed("run", leica, "-o", tmp_path, "--columns", "+echo_time,+range,+range_error", "--quiet")
    names = "echo_time", "amplitude", "echo_width", "range_err", "range", "range_error"
    cloud = np.stack([wb.read_cloud(tmp_path / f"{leica.stem}.laz")[name] for name in names], axis=1)
    for row in csv.DictReader((tmp_path / "e.csv").read_text().splitlines()):
        given = {name.split(" ")[0]: value for name, value in row.items()}
        values = np.array([float(given[name]) for name in names])
        assert (np.abs(cloud - values) <= 1e-5 * values).all(axis=1).any()


SIGNALS = sorted({stage.searches[0] for stage in STAGES.values() if stage.searches and stage.searches[0]})


BLOCK = simulate(PulseShape(), [(60.0, 25.3, 2.0), (6.0, 45.0, 2.0)], n=60)


def see(name, **parameters):
    return see_block(BLOCK, pooled(BLOCK, PULSE), PULSE, Step(STAGES[name], parameters))


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("detect.maximum", {}), ("detect.maximum", {"threshold": 8.0}), ("detect.matched_filter", {}),
        ("detect.wavelet", {}), ("detect.wavelet", {"wavelet": "mexican_hat"}),
        ("detect.correlation", {"similarity": 0.0}),
        ("detect.correlation", {"reference": "gaussian", "similarity": 0.0}),
    ],
)  # fmt: skip
def test_echoes_are_the_maxima_above_the_threshold(name, parameters):
    for signal in see(name, **parameters):
        values = signal.values
        inner = values[1:-1]
        peak = 1 + np.flatnonzero((inner > values[:-2]) & (inner >= values[2:]) & (inner > signal.least))
        found = signal.found.time / BLOCK.spacing
        assert len(found) == len(peak)
        assert np.abs(found - signal.time[peak] / BLOCK.spacing).max(initial=0) < 1.01


@pytest.mark.parametrize("rule", ["paper", "absolute"])
def test_asdf_has_minima_as_deep_as_the_bars(rule):
    for signal in see("detect.asdf", rule=rule):
        minima = find_minima(np.ascontiguousarray(signal.values[None]))
        kept = minima.row[keep_prominent(minima, np.array([signal.least]))]
        at = np.interp(signal.found.time, signal.time, np.arange(len(signal.time)))
        near = np.abs(at[:, None] - kept[None])
        assert (near.min(axis=1) < 1.6).all(), "every echo lies at a minimum that is deep enough"
        if rule == "paper":
            assert len(kept) == len(at)


def test_spikes_have_sums_above_the_threshold():
    for signal in see("detect.richardson_lucy"):
        assert np.interp(signal.found.time, signal.time, signal.second).min(initial=np.inf) > 0.95 * signal.least
        assert signal.values.sum() == pytest.approx(66, rel=0.25)
        assert (signal.second >= signal.values - 1e-3).all()


@pytest.mark.parametrize("name", ["detect.center_of_gravity", "detect.sustained_threshold"])
def test_runs_above_the_level_hold_the_echoes(name):
    found = 0
    for signal in see(name):
        at = np.rint(signal.found.time / BLOCK.spacing).astype(int)
        assert (signal.values[at] > signal.least).all()
        found += len(at)
    assert found


def test_slopes_fall_through_zero_and_curvatures_are_above_the_noise_at_echoes():
    for signal in see("detect.zero_crossing"):
        at = np.interp(signal.found.time, signal.time, np.arange(len(signal.time)))
        before, after = signal.values[np.floor(at).astype(int)], signal.values[np.ceil(at).astype(int)]
        assert len(at) and (before >= 0).all() and (after <= 0).all() and np.isnan(signal.least)
    for signal in see("detect.zero_crossing", derivative="second"):
        assert len(signal.found) and (np.interp(signal.found.time, signal.time, signal.values) > 0).all()


def test_the_chains_own_detector_keeps_its_parameters():
    chain = make_chain("decompose.gaussian")
    assert choose_step(chain, "detector") is chain.steps[1]
    assert choose_step(chain, "asdf").stage.name == "detect.asdf"
    refuses(ConfigError, "must be one of detector, asdf", choose_step, chain, "spline")
    (view,) = build_views(BLOCK.rows(slice(0, 1)), chain, PULSE, [0], "wavelet")
    assert view.seen.stage == "detect.wavelet, which the chain does not use"
    (view,) = build_views(BLOCK.rows(slice(0, 1)), chain, PULSE, [0], "detector")
    assert view.seen.stage == "detect.maximum"


@pytest.mark.quick_cases("detector", "wavelet")
@pytest.mark.parametrize("show", ["detector", *SIGNALS])
def test_pictures_have_the_signal_and_its_rule(tiny_strip, tmp_path, show):
    result = run(tiny_strip, "-o", tmp_path / "p.svg", "--packet", 3, "--show", show, "--profile", "fast")
    assert result.exit_code == 0, result.output
    text = (tmp_path / "p.svg").read_text("utf-8")
    assert "found by the detector" in text and "std" in text
    assert ("which the chain does not use" in text) == (show != "detector")
