"""What many tests need: a seeded generator, the real files, tiny strips."""

import fnmatch
import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import kept_surveys
import numpy as np
import pytest
from bench_tools import time_here
from child_signals import give_children_default_signals
from hypothesis import HealthCheck, settings

from wavebatch.files.disk.temp_store import use_scratch
from wavebatch.tools.simulate import simulate_strip

give_children_default_signals()


def pytest_configure(config):
    """The fast tests share surveys and draw fewer examples; examples are the same in every run, however slow."""
    fast = config.option.markexpr == "not slow"
    if fast:
        kept_surveys.install(config)
    unhurried = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    examples = 40 if fast else 200
    settings.register_profile("wavebatch", derandomize=True, deadline=None, max_examples=examples,
                              suppress_health_check=unhurried)  # fmt: skip
    settings.load_profile("wavebatch")


LONG = (
    "test_fuzz.py", "test_processor.py", "test_kill.py", "test_wdz.py", "test_village.py",
    "test_signed_physics.py", "test_processes.py", "test_dask_cluster.py", "test_signals.py", "test_neighbour_pass.py",
)  # fmt: skip
"""Files of few tests that take long: started last, they would keep one process busy while the others have ended."""


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """All cases but those that `quick_cases` names are slow; processes of xdist get the long files first."""
    config.quick_cases = named = Counter()
    for item in items:
        if quick := item.get_closest_marker("quick_cases"):
            fits = {name: fnmatch.fnmatchcase(item.callspec.id, name) for name in quick.args}
            named.update({(item.nodeid.split("[")[0], name): fit for name, fit in fits.items()})
            if not any(fits.values()):
                item.add_marker("slow")
    yield
    if hasattr(config, "workerinput"):
        number = Counter(item.path for item in items)
        items.sort(key=lambda item: (item.path.name not in LONG, -number[item.path], item.path))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Tests of surveys make their own, unless they have the mark."""
    kept_surveys.active = "surveying" not in item.path.parts or item.get_closest_marker("kept_surveys") is not None


@pytest.fixture
def rng():
    """The same random numbers in every run."""
    return np.random.default_rng(20261121)


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the real files; the test is skipped where they are not there."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("WAVEBATCH_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"real files are not at {folder}; set WAVEBATCH_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def riegl(data) -> Path:
    """RIEGL Q680i, point format 9, packets in a .wdp."""
    return data / "riegl-q680i" / "100429_152240_2535pt_UTM.las"


@pytest.fixture(scope="session")
def leica(data) -> Path:
    """Leica ALS, point format 4, packets in the file."""
    return data / "leica-als" / "simple1_3_full_internal.las"


@pytest.fixture(scope="session")
def tiny_strip(tmp_path_factory) -> Path:
    """400 pulses of an urban scene, some without a waveform."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.las"
    simulate_strip("urban", path, pulses=400, seed=3)
    return path


@pytest.fixture(scope="session")
def wide_strip(tmp_path_factory) -> Path:
    """More points than fit in one work unit."""
    path = tmp_path_factory.mktemp("wide") / "wide.las"
    simulate_strip("urban", path, pulses=56_000, seed=4)
    return path


@pytest.fixture(scope="session")
def edit_points() -> Callable[..., Path]:
    """`edit_points(source, target, change, **fields)`: a copy of a LAS file whose points have these fields.

    change: alters the records it is given, or returns others.
    """
    from wavebatch.files.las.header import STANDARD_DTYPES, read_header

    def edit(source: Path, target: Path, change: Callable[[np.ndarray], np.ndarray | None] | None = None, **fields):
        header = read_header(source)
        assert not header.compressed and header.point_length == STANDARD_DTYPES[header.point_format].itemsize
        content = bytearray(source.read_bytes())
        start, end = header.offset_to_points, header.offset_to_points + header.point_count * header.point_length
        points = np.frombuffer(bytes(content[start:end]), STANDARD_DTYPES[header.point_format]).copy()
        for name, values in fields.items():
            points[name] = values
        changed = None if change is None else change(points)
        changed = points if changed is None else changed
        assert changed.shape == points.shape and changed.dtype == points.dtype
        content[start:end] = changed.tobytes()
        target.write_bytes(content)
        return target

    return edit


@pytest.fixture
def no_place(tmp_path) -> Iterator[Path]:
    """Temporary files can nowhere be made: the folder for them is not there."""
    use_scratch(tmp_path / "missing")
    yield tmp_path / "missing"
    use_scratch(None)


@pytest.fixture
def timed_here(monkeypatch):
    """The bench times chains in this process: starting one for each takes a second, and no test looks at the times."""
    time_here(monkeypatch)
