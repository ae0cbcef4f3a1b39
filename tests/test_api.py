"""The public API: `import wavebatch as wb` from a strip to a cloud, lazily, typed, and the same as the commands."""

import ast
import importlib.util
import inspect
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
from commands import refuses, run_command

import wavebatch as wb
from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import StageError
from wavebatch.stages.chain import list_profiles
from wavebatch.surveying.systems.figures import describe_figures
from wavebatch.tools.simulate import simulate_strip

PACKAGE = Path(wb.__file__).parent
FUNCTIONS = ("open_strip", "survey", "load_chain", "auto_chain", "run", "read_cloud")


def _python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    return done.stdout.strip()


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """Two small simulated strips."""
    folder = tmp_path_factory.mktemp("strips")
    for number, scene in enumerate(("urban", "forest")):
        simulate_strip(scene, folder / f"{scene}.las", pulses=1500, seed=number)
    return [folder / "urban.las", folder / "forest.las"]


@pytest.fixture(scope="module")
def clouds(strips, tmp_path_factory):
    """Folder of the clouds of the two strips, and the result of the run."""
    out = tmp_path_factory.mktemp("clouds")
    return out, wb.run(strips, out, chain="accurate", columns="+echo_time")


# The package


def test_import_loads_neither_numpy_nor_laspy():
    code = "import sys, wavebatch; print([name for name in sys.modules if name.split('.')[0] in %r])"
    heavy = ("numpy", "scipy", "laspy", "lazrs", "click", "tqdm")
    assert _python(code % (heavy,)) == "[]"


def test_every_public_name_can_be_had_and_is_listed():
    assert set(wb.__all__) == set(dir(wb)) == {*wb._HOMES, "__version__"}
    for name in wb.__all__:
        assert getattr(wb, name) is not None
    space: dict = {}
    exec("from wavebatch import *", space)
    assert set(wb.__all__) <= space.keys()


def test_type_checkers_see_the_names_that_python_finds():
    assert (PACKAGE / "py.typed").exists()
    tree = ast.parse((PACKAGE / "__init__.py").read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If) and node.test.id == "TYPE_CHECKING")
    typed = {
        alias.asname or alias.name: (f"wavebatch.{wb._HOMES[alias.asname or alias.name]}", alias.name)
        for node in block.body
        for alias in node.names
    }
    assert typed == {name: (f"wavebatch.{home}", name) for name, home in wb._HOMES.items()}


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'wavebatch' has no attribute 'nothing'"):
        _ = wb.nothing


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_documented(name):
    doc = inspect.getdoc(getattr(wb, name))
    assert "Parameters\n----------" in doc and "Returns\n-------" in doc
    for parameter in inspect.signature(getattr(wb, name)).parameters:
        assert f"\n{parameter} : " in doc, parameter


# A strip


def test_a_strip_tells_what_it_holds(strips):
    with wb.open_strip(strips[0]) as strip:
        assert strip.facts.path == strips[0]
        assert strip.crs is None
        assert [type(one) for one in strip.digitizers.values()] == [wb.Digitizer]
        blocks = list(strip.blocks(size=400))
        assert len(strip) == sum(len(block) for block in blocks)
        assert "urban.las" in repr(strip)
    assert len(blocks) > 2 and all(0 < len(block) <= 400 for block in blocks)
    for block in blocks:
        n, s = block.samples.shape
        assert n == len(block) and s == block.digitizer.n_samples and block.samples.dtype.kind == "u"
        assert block.spacing == 1.0
        assert block.gps_time.shape == (n,) and block.origin.shape == block.direction.shape == (n, 3)
    with pytest.raises(ValueError, match="size must be at least 1, got 0"), wb.open_strip(strips[0]) as strip:
        next(strip.blocks(0))


def test_a_strip_that_is_none_is_one_line(tmp_path):
    (tmp_path / "no.las").write_bytes(b"LASF")
    with pytest.raises(wb.InputError) as caught:
        wb.open_strip(tmp_path / "no.las")
    assert "no.las" in str(caught.value) and "\n" not in str(caught.value)


def test_from_strip_to_echoes(strips):
    with wb.open_strip(strips[0]) as strip:
        survey = wb.survey(strip)
        assert isinstance(survey.system, wb.SystemPulse) and survey.decisions
        for chain in (wb.auto_chain(survey), wb.load_chain("accurate")):
            echoes = [chain.run(block, survey.system) for block in strip.blocks()]
            again = [chain.run(block, survey.system) for block in strip.blocks(size=100)]
            assert isinstance(echoes[0], wb.EchoTable)
            for name in ("time", "amplitude", "sigma", "flags"):
                whole, parts = (np.concatenate([getattr(t, name) for t in tables]) for tables in (echoes, again))
                np.testing.assert_array_equal(whole, parts)


def test_echoes_become_a_structured_array(strips):
    with wb.open_strip(strips[0]) as strip:
        survey = wb.survey(strip)
        echoes = wb.load_chain("accurate").run(next(strip.blocks()), survey.system)
    rows = echoes.to_numpy()
    assert len(rows) == len(echoes) > 1000
    for name in ("waveform", "time", "amplitude", "sigma", "time_err", "flags"):
        np.testing.assert_array_equal(rows[name], getattr(echoes, name))
    assert {"echo_width", "x", "y", "z"} <= set(rows.dtype.names)
    np.testing.assert_array_equal(rows["echo_width"], echoes.attributes["echo_width"])


def test_a_prompt_shows_a_few_lines(strips):
    with wb.open_strip(strips[0]) as strip:
        survey = wb.survey(strip)
        chain = wb.auto_chain(survey)
        block = next(strip.blocks())
        echoes = chain.run(block, survey.system)
        assert len(repr(strip.facts)) < 2000 and "point_format=" in repr(strip.facts)
    for value, words in (
        (block, (f"{len(block)} waveforms of {block.samples.shape[1]} samples",)),
        (survey.system, ("Gaussian", f"{survey.system.noise.std:.3f} DN")),
        (survey, (f"{survey.waveforms} waveforms", f"{survey.system.noise.std:.3f} DN", "Gaussian")),
        (chain, ("noise.pooled", "detect.maximum")),
        (echoes, (f"{len(echoes)} echoes", "amplitude", "range_err")),
    ):
        text = repr(value)
        assert len(text.splitlines()) < 12 and len(text) < 600, text
        assert all(word in text for word in words), text
    page = ElementTree.fromstring(survey._repr_html_())
    cells = {row.find("th").text: row.find("td").text for row in page.iter("tr")}
    assert f"{survey.system.noise.std:.3f} DN" in cells["noise"] and "Gaussian" in cells["system pulse"]
    pulse = [float(point.split(",")[1]) for point in page.find(".//polyline").get("points").split()]
    assert min(pulse) == pytest.approx(2.0, abs=0.2) and pulse[0] == pytest.approx(142.0, abs=0.5)  # peak, and level


def test_echoes_become_a_frame(strips, monkeypatch):
    with wb.open_strip(strips[0]) as strip:
        echoes = wb.load_chain("fast").run(next(strip.blocks()), wb.survey(strip).system)
    if importlib.util.find_spec("pandas") is not None:
        frame = echoes.to_frame()
        assert tuple(frame.columns) == echoes.to_numpy().dtype.names and len(frame) == len(echoes)
        np.testing.assert_array_equal(frame["amplitude"], echoes.amplitude)
    monkeypatch.setitem(sys.modules, "pandas", None)
    refuses(wb.StageError, "a DataFrame needs pandas: .*pip.* install .*pandas.*; or use to_numpy", echoes.to_frame)


def test_survey_takes_a_path_and_says_what_the_command_says(strips):
    survey = wb.survey(strips[0], waveforms=500)
    assert survey.waveforms == 500
    result = run_command("survey", strips[0], "--waveforms", "500", "--json")
    told = json.loads(result.stdout)
    assert told["waveforms"] == 500 and told["figures"] == describe_figures(survey.figures)
    assert told["decisions"] == [
        {"part": one.part, "needed": one.needed, "reason": one.reason} for one in survey.decisions
    ]


def test_waveforms_of_arrays_are_surveyed_and_decomposed(rng):
    centre, height = rng.uniform(20, 60, 2000), rng.uniform(20, 200, 2000)
    signal = height[:, None] * np.exp(-0.5 * ((np.arange(80) - centre[:, None]) / 2.3) ** 2)
    block = wb.WaveformBlock.from_samples(np.rint(12 + signal + rng.normal(0, 1, signal.shape)).astype(np.uint8))
    survey = wb.survey(block)
    assert survey == wb.survey([block]) and survey.waveforms == 2000
    swapped = wb.WaveformBlock.from_samples(block.samples.astype(">u2"), bits=8, spacing=np.float32(1))
    assert wb.survey(swapped).system == survey.system
    halves = [wb.WaveformBlock.from_samples(half, spacing=spacing)
              for half, spacing in zip(np.split(block.samples, 2), (0.3, 0.1 * 3), strict=True)]  # fmt: skip
    assert wb.survey(halves).waveforms == 2000
    assert survey.system.sigma_ref == pytest.approx(2.3, rel=0.01)
    echoes = wb.auto_chain(survey).run(block, survey.system)
    assert np.array_equal(echoes.waveform, np.arange(2000))
    assert np.array_equal(wb.auto_chain(survey).run(swapped, survey.system).time, echoes.time)
    assert np.abs(echoes.time - centre).max() < 0.5
    refuses(wb.ConfigError, "needs the points of a strip", wb.survey, [block], divergence=0.5)
    for option, values in {"waveforms": (0, -1, "10", 1.5), "divergence": (-1, 0, np.nan, "0.5")}.items():
        for value in values:
            refuses(wb.ConfigError, f"{option}: must .* got {value!r}", wb.survey, block, **{option: value})
    for bits in (0, 99, "8"):
        refuses(StageError, "bits must be a whole number from 1 to 32", wb.WaveformBlock.from_samples, block.samples,
                bits=bits)  # fmt: skip
    for nothing in ([], [block.rows(slice(0))]):
        refuses(wb.InputError, "hold no waveform", wb.survey, nothing)
    for other in (block.samples, [block.samples], None):
        refuses(wb.ConfigError, "give a strip, its path, or blocks of waveforms", wb.survey, other)


def test_a_strip_without_waveforms_cannot_be_surveyed(strips, tmp_path, edit_points):
    bare = edit_points(strips[0], tmp_path / "bare.las", wavepacket_index=0)
    refuses(wb.InputError, "holds no waveform", wb.survey, bare)


# Chains


def test_chains_come_by_name_or_path(tmp_path):
    for name in list_profiles():
        assert wb.load_chain(name).name == f"profile {name}"
    path = tmp_path / "mine.toml"
    stages = ("noise.pooled", "detect.maximum", "decompose.none")
    path.write_text("".join(f'[[chain]]\nstage = "{stage}"\n' for stage in stages))
    assert [step.stage.name for step in wb.load_chain(path).steps][2] == "decompose.none"
    assert len(wb.load_chain(str(path)).steps) == 3
    refuses(wb.ConfigError, "profile 'acurate' does not exist; did you mean 'accurate'", wb.load_chain, "acurate")
    refuses(wb.ConfigError, "none.toml: chain file cannot be read", wb.load_chain, "none.toml")
    refuses(wb.ConfigError, "auto_chain: give a Survey, .* not a dict", wb.auto_chain, {})


# A run


def test_run_writes_what_the_command_writes(strips, clouds, tmp_path):
    out, result = clouds
    assert isinstance(result, wb.BatchResult) and result.failed == 0
    assert [outcome.status for outcome in result.outcomes] == ["written", "written"]
    command = ["run", *map(str, strips), "-o", str(tmp_path), "--profile", "accurate", "--columns", "+echo_time", "-q"]
    assert run_command(*command).exit_code == 0
    for strip in strips:
        cloud = f"{strip.stem}.laz"
        assert (out / cloud).read_bytes() == (tmp_path / cloud).read_bytes()
        one, two = (json.loads((folder / f"{strip.stem}.report.json").read_text()) for folder in (out, tmp_path))
        assert {**one, "timing": None} == {**two, "timing": None}


def test_run_takes_one_strip_a_chain_and_an_event_handler(strips, tmp_path):
    events: list = []
    result = wb.run(strips[0], tmp_path / "new", chain=wb.load_chain("fast"), format="las", on_event=events.append)
    assert result.failed == 0 and (tmp_path / "new" / "urban.las").exists()
    assert [events[0]["event"], events[-1]["event"]] == ["start", "written"]
    again = wb.run(strips[0], tmp_path / "new", chain=wb.load_chain("fast"), format="las", resume=True)
    assert again.outcomes[0].status == "skipped"


def test_a_run_with_a_survey_is_the_run_that_makes_it(strips, tmp_path):
    survey = wb.survey(strips[0])
    for out, options in (("a", {"system": survey}), ("b", {})):
        assert wb.run(strips[0], tmp_path / out, chain="accurate", **options).failed == 0
    a, b = (wb.read_cloud(tmp_path / out / "urban.laz") for out in "ab")
    for name in a.dtype.names:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_run_chooses_the_chain_by_default(strips, tmp_path):
    wb.run(strips[0], tmp_path)
    report = json.loads((tmp_path / "urban.report.json").read_text())
    assert report["choice"]["by"] == "auto"


def test_a_strip_that_fails_is_in_the_result(strips, tmp_path):
    bad = tmp_path / "bad.las"
    bad.write_bytes(b"LASF")
    result = wb.run([bad, strips[0]], tmp_path / "out", chain="fast")
    assert result.failed == 1
    assert isinstance(result.outcomes[0].error, wb.InputError) and result.outcomes[1].status == "written"
    refuses(wb.InputError, r"bad.las: .* \(1 of 2 strips have no cloud\)$", result.raise_for_failures)
    wb.run(strips[0], tmp_path / "good", chain="fast").raise_for_failures()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"chain": "balance"}, "did you mean 'balanced'"),
        ({"columns": "+echo_tim"}, "did you mean 'echo_time'"),
        ({"chain": "fast", "tolerance": 0.02}, "exclude each other"),
        ({"memory": 1000}, "too little"),
        ({"columns": ["+echo_time"]}, r"--columns \['\+echo_time'\]: must be text or None"),
        ({"overwrite": "no"}, "must be True or False"),
        ({"jobs": "4"}, "must be a whole number"),
        ({"bbox": "1,2,3,4"}, "must be a tuple or None"),
        ({"classes": (2, "6")}, r"--classes \(2, '6'\): '6' must be a whole number"),
        ({"classes": [2.5]}, r"--classes \[2.5\]: 2.5 must be a whole number"),
        ({"bbox": (0, 0, "a", 1)}, "'a' must be a number"),
        ({"where": 3}, "--where 3: must be Condition or text or None"),
        ({"chain": 3}, "--chain 3: must be Chain or a path or text or None"),
        ({"system": {}}, "--system {}: must be Survey or a path or text or None"),
        ({"chain": "fast", "flight_height": 800.0}, None),
        ({"chain": "fast", "bbox": np.array([-1e9, -1e9, 1e9, 1e9]), "classes": np.arange(256, dtype=np.uint8),
          "overwrite": np.True_, "point_format": np.int64(6), "flight_height": np.float32(800.0)}, None),
    ],
)
def test_wrong_options_start_nothing(strips, tmp_path, options, words):
    if words is None:
        assert wb.run(strips[0], tmp_path / "out", **options).failed == 0
        return
    refuses(wb.ConfigError, words, wb.run, strips[0], tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_a_pulse_made_by_hand_needs_parts_of_the_right_type():
    with pytest.raises(TypeError, match=r"noise of SystemPulse must be a .*waveforms.ReceiverNoise, got 3\.0"):
        wb.SystemPulse(2.0, noise=3.0)


def test_wrong_use_is_said_in_the_words_of_the_user(strips, tmp_path):
    with wb.open_strip(strips[0]) as strip:
        survey, block = wb.survey(strip), next(strip.blocks())
    refuses(TypeError, "such as survey.system, not WaveformBlock and Survey", wb.load_chain("fast").run, block, survey)
    silent = replace(survey.system, noise=wb.ReceiverNoise(std=0.0))
    with pytest.raises(wb.ConfigError, match=r"noise.std of a SystemPulse must be above 0 counts, got 0.0"):
        wb.load_chain("fast").run(block, silent)
    assert "1 failed: none.las: cannot be read" in repr(wb.run("none.las", tmp_path))
    refuses(ValueError, "is closed: use it inside its `with`", next, strip.blocks())
    with pytest.raises(wb.ConfigError, match=r"--output .*out\.laz: this is a folder.* such as .*out$"):
        wb.run(strips[0], tmp_path / "out.laz")
    for given, empty in (((strips[0], ""), "--output: the name"), (("", tmp_path), "the name of a file")):
        refuses(wb.ConfigError, f"^{empty} is empty$", wb.run, *given)
    refuses(wb.StageError, r"got float64 .*round them", wb.WaveformBlock.from_samples, np.zeros((2, 8)))
    with pytest.raises(wb.StageError, match="spacing must be above 0 ns, got 0"):
        wb.WaveformBlock.from_samples(np.zeros((2, 8), np.uint8), spacing=0)
    counts = np.ones((2, 8), np.uint8)
    refuses(wb.StageError, "spacing must be above 0 ns, got '1'", wb.WaveformBlock.from_samples, counts, spacing="1")
    for odd in (np.zeros((2, 0), np.uint8), np.zeros((2, 8), np.uint64)):
        refuses(wb.StageError, r"unsigned integers \(n, s\) of up to 32 bits", wb.WaveformBlock.from_samples, odd)
    masked = np.ma.array(counts, mask=counts > 0)
    refuses(wb.StageError, "its mask would be ignored", wb.WaveformBlock.from_samples, masked)
    blocks = [wb.WaveformBlock.from_samples(counts, spacing=spacing) for spacing in (1, 2)]
    refuses(wb.ConfigError, "blocks of one digitizer differ; survey them apart", wb.survey, blocks)
    table = type("Table", (), {"mask": lambda self: None, "__array__": lambda self, *_args, **_kinds: counts})()
    assert wb.WaveformBlock.from_samples(table).samples.tolist() == counts.tolist()
    np.testing.assert_array_equal(wb.read_cloud(strips[0], "z")["z"], wb.read_cloud(strips[0], ["z"])["z"])


def test_an_option_that_does_not_exist_is_a_type_error(strips, tmp_path):
    refuses(TypeError, "has no option job; did you mean 'jobs'", wb.run, strips[0], tmp_path, job=4)


# A cloud


def test_read_cloud_gives_every_column_by_name(clouds):
    out, _ = clouds
    cloud = wb.read_cloud(out / "urban.laz")
    with laspy.open(out / "urban.laz") as reader:
        points = reader.read()
    np.testing.assert_array_equal(cloud["x"], np.asarray(points.x))
    for name in points.point_format.standard_dimension_names:
        if name not in ("X", "Y", "Z"):
            unit = 0.006 if name == "scan_angle" else 1  # counts of 0.006 degrees
            np.testing.assert_array_equal(cloud[name], np.asarray(points[name]) * unit)
    for name in points.point_format.extra_dimension_names:
        assert name in COLUMNS
        stored = np.asarray(points[name])
        assert cloud.dtype[name] == stored.dtype
        expected = stored if name == "echo_flags" else np.where(stored == -9999, np.nan, stored)
        np.testing.assert_array_equal(cloud[name], expected)
    assert cloud.dtype["echo_flags"] == np.uint16
    passed = (cloud["echo_flags"] & int(wb.EchoFlag.NO_WAVEFORM)) != 0
    assert passed.any() and np.isnan(cloud["amplitude"][passed]).all() and np.isfinite(cloud["amplitude"]).any()


def test_read_cloud_reads_only_what_is_asked_for(clouds):
    cloud = wb.read_cloud(clouds[0] / "urban.laz", ["z", "echo_width", "scan_angle_rank"])
    assert cloud.dtype.names == ("z", "echo_width", "scan_angle_rank")
    np.testing.assert_array_equal(
        cloud["scan_angle_rank"], wb.read_cloud(clouds[0] / "urban.laz", ["scan_angle"])["scan_angle"]
    )
    with pytest.raises(wb.ConfigError, match="has no column 'echo_wdth'; did you mean 'echo_width'"):
        wb.read_cloud(clouds[0] / "urban.laz", ["echo_wdth"])
    refuses(wb.InputError, "nothing.laz", wb.read_cloud, clouds[0] / "nothing.laz")
    refuses(wb.ConfigError, "columns: 1 is no name", wb.read_cloud, clouds[0] / "urban.laz", [1])
    given = (name for name in ("z", "echo_width"))  # it had no column at all
    assert wb.read_cloud(clouds[0] / "urban.laz", given).dtype.names == ("z", "echo_width")


@pytest.mark.parametrize(("names", "provenance"), [("wavebatch", True), ("wavebatch", False), ("asprs", True)])
def test_what_laspy_writes_again_has_no_numbers_for_no_data(strips, tmp_path, names, provenance):
    """laspy drops the declarations where it adds a dimension: amplitudes of -9999 were in means and histograms."""
    wb.run(strips[0], tmp_path, chain="fast", names=names)
    cloud = laspy.read(tmp_path / "urban.laz")
    cloud.add_extra_dim(laspy.ExtraBytesParams("above_ground", np.float32))
    if not provenance:
        cloud.header.vlrs = [vlr for vlr in cloud.header.vlrs if vlr.user_id != "wavebatch"]
    cloud.write(tmp_path / "more.laz")
    assert all(one.no_data is None for one in cloud.point_format.extra_dimensions)
    wanted, found = (wb.read_cloud(tmp_path / name) for name in ("urban.laz", "more.laz"))
    assert np.isnan(found["amplitude"]).any()
    for column in wanted.dtype.names:
        np.testing.assert_array_equal(found[column], wanted[column])


# Real data


def test_the_riegl_strip_end_to_end(riegl, tmp_path):
    with wb.open_strip(riegl) as strip:
        survey = wb.survey(strip)
        assert survey.system.components
        chain = wb.auto_chain(survey)
        block = next(strip.blocks(size=2000))
        echoes = chain.run(block, survey.system)
        assert 0.9 * len(block) < len(echoes) < 2 * len(block)
        waveforms = len(strip)
    result = wb.run(riegl, tmp_path)
    assert result.failed == 0 and result.report.to_json()["counts"]["waveforms"] == waveforms
    cloud = wb.read_cloud(tmp_path / f"{riegl.stem}.laz")
    assert len(cloud) == result.report.to_json()["counts"]["points_out"]
    assert np.nanmedian(cloud["echo_width"]) == pytest.approx(2.3548 * survey.system.sigma_ref, rel=0.2)
