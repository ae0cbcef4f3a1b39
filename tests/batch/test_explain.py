"""What a report says of a strip as a whole: waveforms without echoes, returns that lie elsewhere."""

import json

import numpy as np
import pytest
from batch_tools import run_one

from wavebatch.files.las.header import read_header


def remarks(strip, folder):
    assert run_one(strip, folder).status == "written"
    return json.loads((folder / f"{strip.stem}.report.json").read_text())["remarks"]


def change_packets(source, target, change):
    """A copy of an internal 8-bit strip with the samples behind the waveform record's header changed."""
    content = np.frombuffer(source.read_bytes(), np.uint8).copy()
    start = read_header(source).waveform_start + 60
    content[start:] = change(content[start:])
    target.write_bytes(content.tobytes())
    return target


def test_a_plain_strip_has_none(tiny_strip, tmp_path):
    assert remarks(tiny_strip, tmp_path) == []


@pytest.mark.parametrize("factor", [0.0, 1e-3], ids=["none", "ns for ps"])
def test_return_locations_that_are_not_those_of_echoes_are_doubted(tiny_strip, tmp_path, edit_points, factor):
    def change(points):
        points["return_point_wave_location"] *= factor
        return points

    (line,) = remarks(edit_points(tiny_strip, tmp_path / "bad.las", change), tmp_path)
    assert "returns lie where their packet has an echo" in line and "picoseconds" in line


def test_inverted_and_empty_waveforms_are_told(tiny_strip, tmp_path):
    inverted = change_packets(tiny_strip, tmp_path / "down.las", lambda samples: 255 - samples)
    (line,) = remarks(inverted, tmp_path)
    assert "the signal goes down, its counts are mirrored" in line
    constant = change_packets(tiny_strip, tmp_path / "flat.las", lambda samples: 0 * samples + 12)
    (line,) = remarks(constant, tmp_path)
    assert "holds an echo: nothing rises" in line
