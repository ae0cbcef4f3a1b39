"""No text of any picture lies on another one or leaves the picture: their boxes are measured."""

import itertools
from dataclasses import replace

import laspy
import numpy as np
import pytest
from commands import run_command, succeed
from plot_tools import PULSE, make_chain, simulate, write_cloud

from wavebatch.files import figure_file
from wavebatch.files.figure_file import fit_parts, fit_text, open_picture, set_layout, text_width
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.tools.plots.draw_waveform import draw_waveform_panels
from wavebatch.tools.plots.waveform import build_views

matplotlib = pytest.importorskip("matplotlib")
Figure = pytest.importorskip("matplotlib.figure").Figure
LONG = "a_very_long_name_of_a_strip_as_flight_campaigns_give_them_" * 3 + ".las"


def run_plot(*words):
    return run_command("plot", *words)


@pytest.fixture
def texts(monkeypatch):
    """The texts of every picture that is written: (its number, text, box [pixels], box of the picture)."""
    found, written = [], itertools.count(1)
    save = Figure.savefig

    def measure(figure, file, **options):
        save(figure, file, **options)
        drawn, name = [], f"picture {next(written)}"
        with monkeypatch.context() as patch:
            draw = matplotlib.text.Text.draw
            record = lambda text, renderer: (drawn.append(text), draw(text, renderer))  # noqa: E731
            patch.setattr(matplotlib.text.Text, "draw", record)
            figure.draw_without_rendering()
        for text in dict.fromkeys(drawn):
            if text.get_visible() and text.get_text().strip():
                found.append((name, text.get_text(), text.get_window_extent(), figure.bbox))

    monkeypatch.setattr(Figure, "savefig", measure)
    return found


def check(texts):
    assert texts
    wrong = []
    for number, (name, text, box, page) in enumerate(texts):
        inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= page.x1 + 1 and box.y1 <= page.y1 + 1
        if not inside:
            wrong.append(f"{name}: {text!r} leaves the picture")
        for other_name, other, other_box, _ in texts[number + 1 :]:
            if name != other_name:
                continue
            both = box.intersection(box, other_box)
            touching = both is not None and both.width > 1.0 and both.height > 1.5
            if touching:
                wrong.append(f"{name}: {text!r} lies on {other!r}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "show"), [(1, None), (1, "asdf"), (4, None), (4, "deconvolved")])
def test_waveforms_with_crowded_echoes(texts, tmp_path, number, show):
    echoes = [(100.0, 30.0, 2.0), (80.0, 36.0, 2.0), (60.0, 42.0, 2.0), (50.0, 47.5, 2.0), (20.0, 60.0, 2.0)]
    block = simulate(PulseShape(), echoes, n=number, s=120)
    views = build_views(block, make_chain("decompose.gaussian"), PULSE, range(number), show)
    assert len(views[0].echoes) >= 4
    flagged = [replace(view, echoes=replace(view.echoes, flags=np.full(len(view.echoes), 0x7FFF, np.uint16)))
               for view in views]  # fmt: skip
    for name, each in (("plain", views), ("flagged", flagged)):
        draw_waveform_panels(each, tmp_path / f"{name}.png", strip=LONG, chain="auto: detect.maximum " * 8, table=True)
    check(texts)


@pytest.mark.slow
def test_histograms_maps_sections_and_profiles(texts, tmp_path):
    rng = np.random.default_rng(1)
    value = rng.normal(50, 10, 3000).astype("f4")
    cloud = write_cloud(tmp_path / LONG[-120:], n=3000, amplitude=(value, None, None, "peak above the baseline [DN]"))
    flags = (rng.integers(0, 2**15, 3000).astype("u2"), None, None, "bits")
    marked = write_cloud(tmp_path / "f.las", n=3000, echo_flags=flags)
    for number, words in enumerate((
        ["histogram", cloud, "--column", "amplitude"], ["histogram", cloud, "--column", "amplitude", "--log"],
        ["histogram", cloud, marked, "--column", "z", "--each"], ["histogram", marked, "--column", "echo_flags"],
        ["histogram", cloud, "--column", "z", "--by", "return_number"],
        ["map", cloud, "--column", "amplitude"], ["map", cloud, "--statistic", "density", "--size", "5"],
        ["section", cloud, "--column", "amplitude"], ["section", cloud, "--aspect", "5"],
        ["profile", cloud], ["profile", cloud, marked, "--each"], ["profile", cloud, "--column", "amplitude"],
    )):  # fmt: skip
        succeed("plot", *words, "-o", tmp_path / f"{number}-{words[0]}.png")
    check(texts)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(2.0, 700.0), (700.0, 2.0), (0.5, 0.5)])
def test_maps_of_any_shape(texts, tmp_path, shape):
    path = write_cloud(tmp_path / "c.las", n=2000)
    las = laspy.read(path)
    rng = np.random.default_rng(2)
    las.x, las.y = 548_340.12 + rng.uniform(0, shape[0], 2000), 5_389_930.7 + rng.uniform(0, shape[1], 2000)
    las.write(path)
    assert run_plot("map", path, "--column", "intensity", "-o", tmp_path / "m.png").exit_code == 0
    assert run_plot("section", path, "-o", tmp_path / "s.png").exit_code == 0
    check(texts)


@pytest.mark.slow
def test_slices_and_cubes(texts, tmp_path, riegl):
    words = ["slice", riegl, "--lines", "0:6", "--shortest", "10", "--png", tmp_path / "a.png"]
    words += ["--overview", tmp_path / "b.png", "--cube", tmp_path / "c.npz"]
    succeed(*words)
    assert run_plot("cube", tmp_path / "c.npz", "-o", tmp_path / "c.png").exit_code == 0
    check(texts)
    assert any(riegl.name in text for name, text, *_ in texts if name == "picture 1"), "the strip is named"


@pytest.mark.slow
def test_axes_in_metres_have_equal_scales(tmp_path, riegl, monkeypatch):
    kept = []
    save = Figure.savefig
    keep = lambda figure, *rest, **options: (kept.append(figure), save(figure, *rest, **options))  # noqa: E731
    monkeypatch.setattr(Figure, "savefig", keep)
    run_command("slice", riegl, "--lines", "2", "--png", tmp_path / "a.png")
    run_plot("section", riegl, "-o", tmp_path / "s.png")
    run_plot("map", riegl, "--column", "z", "-o", tmp_path / "m.png")
    assert len(kept) == 3
    for figure in kept:
        axes = figure.axes[0]
        box, (x0, x1), (y0, y1) = axes.get_window_extent(), axes.get_xlim(), axes.get_ylim()
        assert box.width / (x1 - x0) == pytest.approx(box.height / (y1 - y0), rel=0.01)


@pytest.mark.quick_cases("True")
@pytest.mark.parametrize("compress", [False, True])
def test_axes_lie_at_round_places(tmp_path, compress):
    """The solver of the layout gives other last digits in each run, and ids of clip paths follow from them."""
    drawn = set()
    for _ in range(3):
        with open_picture(tmp_path / "p.svg", (8.6, 6.0), overwrite=True) as figure:
            if compress:
                set_layout(figure, compress=True)
            for axes in figure.subplots(3, 2).ravel():
                axes.set_ylabel("signal [DN]\nof it")
            figure.colorbar(axes.imshow([[1.0, 2.0]]), ax=axes)
        for axes in figure.axes:
            bounds = axes.get_position(original=True).bounds
            assert bounds == pytest.approx([round(value, 6) for value in bounds], rel=0, abs=1e-12)
        drawn.add((tmp_path / "p.svg").read_bytes())
    assert len(drawn) == 1


def test_texts_are_shortened_to_their_room(tmp_path):
    with open_picture(tmp_path / "t.png", (4, 3)) as figure:
        for text in ("short", LONG):
            fitted = fit_text(figure, text, 2.0, size=10)
            assert text_width(figure, fitted, 10) <= 2.0 and (fitted == text or "..." in fitted)
        lines = fit_parts(figure, ["one part", "another part", LONG], 2.0, size=10).split("\n")
        assert len(lines) == 2 and all(text_width(figure, line, 10) <= 2.0 for line in lines)


@pytest.mark.parametrize(
    ("low", "high", "most", "expected"),
    [
        (112.0, 145.0, 2, [120, 140]), (112.0, 145.0, 1, [120]), (-0.3, 0.2, 2, [-0.2, 0.2]),
        (350.1, 350.2, 1, [350.15]), (5.0, 5.0, 2, [5.0]), (0.0, 1.0, 2, [0, 1.0]),
    ],
)  # fmt: skip
def test_short_axes_have_one_or_two_round_ticks(low, high, most, expected):
    assert figure_file._round_places(low, high, most) == pytest.approx(expected)


def test_short_axes_always_have_a_tick_inside():
    rng = np.random.default_rng(0)
    for low, span in zip(rng.normal(0, 1000, 2000), 10.0 ** rng.uniform(-4, 4, 2000), strict=True):
        for most in (1, 2):
            places = figure_file._round_places(low, low + span, most)
            assert 1 <= len(places) <= most and all(low - 1e-9 <= place <= low + span + 1e-9 for place in places)
