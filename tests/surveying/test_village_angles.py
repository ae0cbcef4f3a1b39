"""Incidence angles from echo widths against those from surface normals, in one cloud of the simulated village."""

import laspy
import numpy as np
import pytest

from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.stages.chain import parse_chain
from wavebatch.surveying.sensor import SensorRequest
from wavebatch.tools.simulate import simulate_strip

CHAIN = "".join(
    f'[[chain]]\nstage = "{name}"\n'
    for name in ("noise.pooled", "detect.maximum", "decompose.adaptive", "attribute.position",
                 "attribute.incidence_angle", "attribute.incidence_angle_normals")
).replace('incidence_angle"\n', 'incidence_angle"\ndivergence = 1.1\n') + "radius = 2.5\n"  # fmt: skip


def read_angles(cloud, name):
    """Angles and their errors [deg], NaN for no data."""
    columns = (np.array(cloud[column]) for column in (name, f"{name}_err"))
    return [np.where(values == -9999, np.nan, values) for values in columns]


@pytest.mark.slow
def test_both_kinds_of_angle_agree(tmp_path):
    simulate_strip("village", tmp_path / "village.las", pulses=6000, seed=4)
    chain = parse_chain(CHAIN, "test")
    options, written = RunOptions(format="las"), choose_columns(chain, "+echo_flags")
    job = StripJob(tmp_path / "village.las", chain, options, written, sensor=SensorRequest(height=640.0))
    outcome = run_batch([job], RunOptions(tmp_path / "both")).outcomes[0]
    assert outcome.error is None, outcome.error
    cloud = laspy.read(tmp_path / "both" / "village.las")
    widths, widths_err = read_angles(cloud, "incidence_angle")
    normals, normals_err = read_angles(cloud, "incidence_angle_normals")
    off = widths - normals
    known = np.isfinite(off)
    assert known.sum() > 3000 and abs(off[known].mean()) < 2.0
    assert np.abs(off[known]).mean() < 2.5 and np.median(np.abs(off[known])) < 2.0
    assert 0.4 < (np.abs(off) <= np.hypot(widths_err, normals_err))[known].mean() < 0.85
