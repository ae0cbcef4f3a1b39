"""Report pages of --html: whole, closed to the network, numbers equal to the JSON, and shown by a real browser."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
import types
from xml.etree import ElementTree

import numpy as np
import pytest
from commands import run_command
from html_tools import Page

from wavebatch.core.errors import ConfigError
from wavebatch.surveying.calibrating.adjust_flight import PairOverlap
from wavebatch.surveying.calibrating.calibrate_flight import FlightCalibration
from wavebatch.surveying.calibration import Calibration, StripConstant, TargetResult
from wavebatch.tools.plots.charts import chart, draw_histogram, draw_values, merge_bins
from wavebatch.tools.sheets import page
from wavebatch.tools.sheets.run import FIGURES, count_tables, find_outliers
from wavebatch.tools.sheets.sheet import Code, Table
from wavebatch.tools.sheets.survey import calibration_page


def _run(*arguments, code=0):
    result = run_command(*arguments, catch_exceptions=False)
    assert result.exit_code == code, result.stderr
    return result


@pytest.fixture(scope="module")
def flight(tiny_strip, tmp_path_factory):
    """A folder with the page of a run over two good strips and a broken one, and its summary."""
    folder = tmp_path_factory.mktemp("html")
    (folder / "in").mkdir()
    for name in ("a <b>&\"1'.las", "second.las"):
        shutil.copy(tiny_strip, folder / "in" / name)
    (folder / "in" / "broken.las").write_bytes(tiny_strip.read_bytes()[:300])
    _run("run", folder / "in", "-o", folder / "out", "--html", folder / "run.html", "--report", folder / "run.json",
         code=3)  # fmt: skip
    return folder


def test_the_page_of_a_run_has_every_part_and_its_counts_are_those_of_the_report(flight):
    shown, report = Page(flight / "run.html").check(), json.loads((flight / "run.json").read_text())
    wanted = ["Summary", "Failed strips", "Strips", "Counts", "Survey", "Decisions", "Echoes", "Columns of the cloud",
              "Maps", "Flags", "Provenance"]  # fmt: skip
    assert [name for name in wanted if name not in shown.headings] == []
    for name in ("points_in", "waveforms", "echoes", "matched_returns", "added_echoes", "points_out"):
        assert shown.row(name)[1] == f"{report['counts'][name]:,}"
    assert "does not add up" not in shown.text and shown.text.count("adds up") == 7 * 3
    assert shown.text.count("broken.las") >= 2
    assert "a <b>&\"1'.las" in shown.text  # shown as it is, never as markup
    assert "<b>&" not in shown.source


@pytest.mark.slow
def test_a_page_is_the_same_for_the_same_result(flight, tmp_path):
    again = tmp_path / "again.html"
    _run("run", flight / "in", "-o", flight / "out", "--resume", "--html", again, code=3)
    times = r"(?s)<h4>Time</h4>.*?</section>|<section id=.run.>.*?</section>|\n<p>2 of the strips[^<]*</p>"
    first, second = (
        re.sub(times, "", path.read_text()).replace("skipped", "written") for path in (flight / "run.html", again)
    )
    assert first.splitlines() == second.splitlines()


def test_pages_of_survey_and_compare(flight, tiny_strip, tmp_path):
    cloud = flight / "out" / "second.laz"
    found = _run("survey", tiny_strip, "--html", tmp_path / "s.html", "--json")
    shown, document = Page(tmp_path / "s.html").check(), json.loads(found.stdout)
    assert shown.row("noise")[1].startswith(f"{document['system']['noise_std_dn']:.3f} DN")
    assert {"Random waveforms", "Worst fits"} <= set(shown.headings)
    assert all(one["reason"] in shown.text for one in document["decisions"])
    assert 'alt="System pulse"' in shown.source
    digits = [part.lstrip("-0.").replace(".", "").replace(",", "") for row in shown.rows for part in row
              if part.replace(",", "").replace(".", "").lstrip("-").isdigit() and "." in part]  # fmt: skip
    assert digits and max(map(len, digits)) <= 5 and "1 gaussians" not in shown.text
    found = _run("compare", cloud, tiny_strip, "--html", tmp_path / "c.html", "--json")
    shown, document = Page(tmp_path / "c.html").check(), json.loads(found.stdout)
    assert shown.row("identical")[1] == f"{document['matched']:,}" and "does not add up" not in shown.text
    _run("compare", "--strip", tiny_strip, "fast", "accurate", "--html", tmp_path / "m.html")
    assert "Goodness of fit" in Page(tmp_path / "m.html").check().headings


def test_the_page_of_a_flight_names_strips_that_do_not_belong(tiny_strip, tmp_path):
    shutil.copy(tiny_strip, tmp_path / "a.las")
    shutil.copy(tiny_strip, tmp_path / "b.las")
    _run("survey", tmp_path, "--html", tmp_path / "s.html")
    shown = Page(tmp_path / "s.html").check()
    assert "Strips" in shown.headings and shown.text.count("belongs to the others") == 2


@pytest.mark.slow
def test_the_page_of_a_benchmark(timed_here, tmp_path):
    found = _run("bench", "--scene", "open", "--waveforms", 600, "--pulses", 0,
                 "--repeat", 1, "--json", "--html", tmp_path / "b.html")  # fmt: skip
    shown, document = Page(tmp_path / "b.html").check(), json.loads(found.stdout)
    for row in document["scenes"][0]["rows"]:
        share = 100 * row["figures"]["completeness"]["value"]
        assert any(one[0] == row["name"] and f"{share:.2f}" in one[1] for one in shown.rows)


def test_the_page_of_a_calibration(tmp_path):
    targets = (TargetResult("roof <i>", 0.3, 50, 2e-9, 0.1, 12.0), TargetResult("lake", 0.02, 1, refused="too few"))
    strips = tuple(StripConstant(f"{n}.las", "", 1, 0, 2e-9, 0.05, 0.01 * n, 0.02, 9) for n in range(3))
    found = Calibration(2e-9, 0.05, strip="s.las", date="2026-01-02", targets=targets, strips=strips,
                        notes=("constants differ",))  # fmt: skip
    pairs = (PairOverlap("0.las", "1.las", 40, 1.1, 1.01, 0.02, 0.003, 0.01),)
    page.write_page(tmp_path / "c.html", "calibrate", calibration_page(FlightCalibration(found, pairs)))
    shown = Page(tmp_path / "c.html").check()
    assert "0.las / 1.las" in shown.text and shown.row("roof <i>")[2] == "50" and shown.row("lake")[-1] == "too few"
    assert "1: 0.las 1/0, 2: 1.las 1/0, 3: 2.las 1/0" in shown.text
    assert "constants differ" in shown.text and shown.row("day of the flight")[1] == "not in the strip"


def test_counts_that_do_not_add_up_are_marked(flight):
    counts = json.loads((flight / "run.json").read_text())["counts"]
    draw_sums = lambda counts: page.render(count_tables(counts, "echoes")[1])  # noqa: E731
    assert "does not add up" not in draw_sums(counts)
    assert draw_sums({**counts, "echoes": counts["echoes"] + 1}).count("does not add up") == 2


@pytest.mark.slow
@pytest.mark.parametrize("points", ["echoes", "returns"])
def test_the_sums_of_a_page_hold_with_points_left_out(points, tiny_strip, tmp_path):
    for name in ("a.las", "b.las"):
        shutil.copy(tiny_strip, tmp_path / name)
    _run("run", tmp_path, "-o", tmp_path / "out", "--points", points, "--where", "amplitude > 60",
         "--html", tmp_path / "r.html", "--report", tmp_path / "r.json")  # fmt: skip
    shown, counts = Page(tmp_path / "r.html").check(), json.loads((tmp_path / "r.json").read_text())["counts"]
    left = counts["left_out"]["where"]
    assert left and "does not add up" not in shown.text
    assert shown.row("left out: where")[1] == f"{left:,}"
    assert f"- {left:,} left out: where" in shown.text


@pytest.mark.parametrize(
    ("name", "words"),
    [("no/such/r.html", "does not exist; make it first"), ("out/second.laz", "must end in .html"),
     ("notes.html", "is no report of wavebatch")],
)  # fmt: skip
def test_a_page_replaces_only_a_page(flight, name, words):
    (flight / "notes.html").write_text("mine")
    result = _run("run", flight / "in" / "second.las", "-o", flight / "out", "--resume", "--html", flight / name,
                  code=2)  # fmt: skip
    assert words in result.stderr and result.stderr.count("\n") == 1
    assert (flight / "notes.html").read_text() == "mine"


def test_a_page_that_cannot_be_drawn_hides_neither_clouds_nor_survey(tiny_strip, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", types.ModuleType("matplotlib"))
    result = _run("run", tiny_strip, "-o", tmp_path / "out", "--html", tmp_path / "r.html", code=1)
    assert "error: --html: ValueError" in result.stderr and (tmp_path / "out" / "tiny.laz").exists()
    result = run_command("survey", tiny_strip, "--html", tmp_path / "s.html")
    assert result.exit_code == 1 and "ValueError" in result.stderr and "decisions" in result.stdout


def test_outliers_are_far_from_the_others_and_few_strips_have_none():
    usual = [{"noise": 1.0 + 0.01 * n, "echoes": 1.2, "pulse": 4.0} for n in range(8)]
    assert not any(find_outliers(usual, [""] * 8)) and set(usual[0]) < set(FIGURES)
    assert not any(find_outliers([{"noise": 1.0 + 0.1 * n} for n in range(8)], [""] * 8)), "all of them differ"
    marked = find_outliers([*usual, {"noise": 2.0, "echoes": float("nan"), "pulse": 4.01}], [""] * 9)
    assert [sorted(one) for one in marked] == [[]] * 8 + [["noise"]]
    assert "usual is 1.04" in marked[-1]["noise"]
    assert not any(find_outliers([{"noise": 1.0}, {"noise": 50.0}], ["", ""]))


def read_svg(figure):
    """The SVG of a figure, which is XML, and its texts."""
    svg = figure[0].svg
    return svg, [
        "".join(one.itertext()).strip() for one in ElementTree.fromstring(svg).iter() if one.tag.endswith("}text")
    ]


def test_a_chart_keeps_words_of_files_as_they_are():
    drawn = chart("<x> $a$", ("&", '"'), lambda axes: axes.plot([0, 1], [1.0, 2.0], label="<n>"), "<c>")
    svg, words = read_svg(drawn)
    shown = page.render(drawn[0])
    assert "<x> $a$" in words and "&" in words and "&lt;c&gt;" in shown and 'alt="&lt;x&gt; $a$"' in shown
    assert not re.search("nan|inf", svg)


def test_equal_pictures_are_equal_bytes():
    one, other = (draw_values(["a", "b"], [1.0, 2.0], [0.1, 0.2], title="t", label="l") for _ in range(2))
    assert one == other


def test_values_of_zero_have_an_axis_without_a_power_of_ten():
    _, words = read_svg(draw_values(["only"], [0.0], [0.0], title="Drift", label="%"))
    assert "%" in words and not any("e-" in word for word in words)


@pytest.mark.parametrize("values", [[6.012e-9, 6.033e-9], [0.9991, 1.0004], [5e7, 5.1e7], [2.0], [0.0]])
def test_ticks_differ_from_each_other(values):
    errors = [0.001 * abs(value) for value in values]
    _, words = read_svg(draw_values(["n"] * len(values), values, errors, title="t", label="l"))
    ticks = [one for one in words if re.fullmatch(r"[\u2212-]?[\d.]+", one)][len(values) :]
    assert len(ticks) == len(set(ticks)) > 1


def test_a_histogram_counts_what_it_leaves_out(rng):
    values = np.append(rng.normal(0, 1, 9990), np.full(10, 90.0))
    edges = np.linspace(-100, 100, 20_001)
    counts = np.histogram(values, edges)[0]
    borders, merged = merge_bins(edges, counts)
    assert len(merged) <= 60 and len(borders) == len(merged) + 1 and -5 < borders[0] < borders[-1] < 5
    drawn = draw_histogram(edges, counts, title="t", label="m", beyond=7)
    left = int(re.search(r"([\d,]+) of them outside", drawn[0].words)[1])
    assert merged.sum() + left == 10_007 and left <= 10 + 7 + 10
    assert draw_histogram(edges, np.zeros(20_000, np.int64), title="t", label="m") == []
    assert draw_values(["a"], [0.0], [float("nan")], title="t", label="l")


def test_a_page_without_matplotlib_has_its_tables_and_says_how_to_get_pictures(tiny_strip, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, find=importlib.util.find_spec: (
        None if name == "matplotlib" else find(name)))  # fmt: skip
    _run("run", tiny_strip, "-o", tmp_path / "out", "--html", tmp_path / "r.html")
    shown = Page(tmp_path / "r.html").check()
    assert "need matplotlib: " in shown.text and "Counts" in shown.headings and "<img" not in shown.source


def test_outliers_are_those_of_a_sensor():
    one, other = ({"noise": 1.0, "pulse": 4.0} for _ in range(2))
    strips, sensors = [one] * 6 + [{**other, "noise": 9.0}] * 6, ["8 bits, 1 ns"] * 6 + ["16 bits, 2 ns"] * 6
    assert not any(find_outliers(strips, sensors)) and any(find_outliers(strips[:7], ["same"] * 7))


def test_the_page_of_many_strips_is_an_index(tiny_strip, tmp_path):
    for number in range(6):
        shutil.copy(tiny_strip, tmp_path / f"s{number:02}.las")
    _run("run", tmp_path, "-o", tmp_path / "out", "--survey", "flight", "--html", tmp_path / "r.html")
    shown = Page(tmp_path / "r.html").check()
    assert [row[0] for row in shown.rows if row[0].endswith(".las")] == [f"s{number:02}.las" for number in range(6)]
    assert shown.source.count('<section id="strip-') == 1 and "--resume --html" in shown.text
    assert len(shown.source) < 1_000_000


def test_text_of_any_kind_is_escaped(tmp_path):
    words = "</script><script>alert(1)</script>\x00\x1b[31m\udcff\n\"'"
    page.write_page(tmp_path / "p.html", words, [Table([words], [[words]]), Code(words)])
    shown = Page(tmp_path / "p.html").check()
    assert sum(tag == "script" for tag, _ in shown.elements) == 1 and "\x1b" not in shown.source
    with pytest.raises(ConfigError, match="is no report"):
        (tmp_path / "x").write_text("<html>")
        page.write_page(tmp_path / "x", "t", [])


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.mark.skipif(BROWSER is None, reason="no headless browser is installed")
def test_a_real_browser_shows_the_page_sorts_its_table_and_complains_about_nothing(flight, tmp_path):
    source = (flight / "run.html").read_text()
    # The page's rules allow its own script only; the test's script needs a door.
    probe = (
        "<script>const t = document.querySelector('table.sortable'); const heads = [...t.tHead.rows[0].cells];"
        "const at = heads.findIndex((head) => head.textContent == 'points in'); heads[at].firstChild.click();"
        "const v = () => [...t.tBodies[0].rows].map((r) => r.cells[at].textContent).join('|');"
        "const up = v(); heads[at].firstChild.click();"
        "const side = getComputedStyle(heads[at]).textAlign;"
        "document.title = 'SORTED ' + up + ' THEN ' + v() + ' HEAD ' + side + ' WIDTH ' +"
        " [...document.querySelectorAll('figure img')].every((s) => s.getBoundingClientRect().height > 50);</script>"
    )
    opened = re.sub(r"script-src '[^']+'", "script-src 'unsafe-inline'", source).replace("</body>", f"{probe}</body>")
    (tmp_path / "run.html").write_text(opened)
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
               f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr", "--dump-dom"]  # fmt: skip
    for path in (flight / "run.html", tmp_path / "run.html"):
        shown = subprocess.run([*command, path.as_uri()], capture_output=True, text=True, timeout=300)
        assert shown.returncode == 0 and "CONSOLE" not in shown.stderr, shown.stderr
    sums = json.loads((flight / "run.json").read_text())["strips"]
    points = f"{sums[0]['counts']['points_in'] or sums[1]['counts']['points_in']:,}"
    title = re.search(r"<title>(.*?)</title>", shown.stdout)[1]
    assert title == f"SORTED {points}|{points}|\u2013 THEN {points}|{points}|\u2013 HEAD right WIDTH true"
