"""A .wdp of another strip is refused where that is certain, and own packets never are."""

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from writer_tools import data_file

from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import StripReader

SCENES = {"forest": (), "urban": (), "slope": (), "canopy.gemini-24": (), "empty": ("--noise", "15")}
REAL = (
    "riegl-q680i/100429_152240_2535pt_UTM", "geolas/geolas1", "lvis/lvis1", "neon/neon_harv_a", "optech/optech_a",
)  # fmt: skip


def find_stranger(strip: Path) -> str:
    with StripReader(strip) as reader, reader.scan(tolerant=True) as scan:
        return scan.stranger


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """A strip of each scene, of one sensor, with packets beside it."""
    folder = tmp_path_factory.mktemp("strips")
    made = {scene: folder / f"{scene}.las" for scene in SCENES}
    for seed, (scene, path) in enumerate(made.items()):
        options = ["--pulses", "600", "--external", "-q", "--seed", str(seed), *SCENES[scene]]
        assert run_command("simulate", scene, "-o", path, *options).exit_code == 0
    return made


def swap(points: Path, packets: Path, folder: Path) -> Path:
    shutil.copy(points, folder / "s.las")
    shutil.copy(packets.with_suffix(".wdp"), folder / "s.wdp")
    return folder / "s.las"


def test_packets_of_another_strip_of_the_sensor_are_known(strips, tmp_path):
    names = [name for name in strips if name != "empty"]
    for points, packets in itertools.product(names, names):
        strip = swap(strips[points], strips[packets], tmp_path)
        assert bool(find_stranger(strip)) == (points != packets), (points, packets)
    strip = swap(strips["forest"], strips["urban"], tmp_path)
    with pytest.raises(InputError, match=r"s\.wdp belongs to another strip: .*--force"), StripReader(strip) as reader:
        reader.scan()
    with StripReader(strip) as reader, reader.scan(force=True) as scan:
        assert scan.stranger and not scan.problems


def test_packets_of_another_sensor_are_known(tmp_path):
    files = {name: data_file(f"{name}.las") for name in REAL}
    for points, packets in itertools.product(REAL, REAL):
        strip = swap(files[points], files[packets], tmp_path)
        assert bool(find_stranger(strip)) == (points != packets), (points, packets)


def change(points: np.ndarray, how: str) -> np.ndarray:
    locations = points["return_point_wave_location"]
    if how == "zero":
        locations[:] = 0
    elif how == "nanoseconds":
        locations[:] = locations / 1000
    elif how == "shifted":
        locations[:] = locations + 20_000
    elif how == "random, but as strong":
        locations[:] = np.random.default_rng(0).uniform(0, 60_000, len(points))
    elif how == "without intensity":
        points["intensity"] = 0
    elif how == "nothing to go by":
        points["intensity"], locations[:] = 0, 30_000
    return points


@pytest.mark.parametrize("how", [
    "as it is", "zero", "nanoseconds", "shifted", "random, but as strong", "without intensity", "nothing to go by",
])  # fmt: skip
def test_own_packets_are_never_refused(strips, tmp_path, edit_points, how):
    for name, path in strips.items():
        if name == "empty" and how.startswith("random"):
            continue  # no witness is left: noise hides how strong the echoes are
        strip = edit_points(path, tmp_path / f"{name}.las", lambda points: change(points, how))
        shutil.copy(path.with_suffix(".wdp"), strip.with_suffix(".wdp"))
        assert not find_stranger(strip), name


def test_own_packets_of_the_weakest_returns_alone_are_not_refused(strips, tmp_path, edit_points):
    """Only the ground of a high canopy, say: its echoes are the lowest of their packets."""

    def weaken(points):
        order = np.lexsort((points["intensity"], points["wavepacket_offset"]))
        weakest = order[np.unique(points["wavepacket_offset"][order], return_index=True)[1]]
        others = np.setdiff1d(np.arange(len(points)), weakest)
        points["wavepacket_index"][others] = points["wavepacket_size"][others] = 0
        return points

    for name in ("forest", "canopy.gemini-24"):
        strip = edit_points(strips[name], tmp_path / f"{name}.las", weaken)
        shutil.copy(strips[name].with_suffix(".wdp"), strip.with_suffix(".wdp"))
        assert not find_stranger(strip), name


def test_few_packets_prove_nothing(strips, tmp_path, edit_points):
    def keep_few(points):
        points["wavepacket_size"][40:] = 0
        return points

    strip = edit_points(strips["forest"], tmp_path / "few.las", keep_few)
    shutil.copy(strips["urban"].with_suffix(".wdp"), strip.with_suffix(".wdp"))
    assert not find_stranger(strip)
