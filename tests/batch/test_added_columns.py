"""Columns that no shipped chain computes, and flight heights that the strip does not need."""

import numpy as np
import pytest
from commands import run_command

import wavebatch as wb
from wavebatch.batch.options import OPTIONS
from wavebatch.core.echoes import COLUMNS
from wavebatch.stages.chain import STAGES, load_profile
from wavebatch.surveying.calibration import needs_sensor, with_columns

MADE = sorted({name for stage in STAGES.values() if stage.kind == "attribute" for name in stage.makes} & COLUMNS.keys())


@pytest.mark.parametrize("column", [name for name in MADE if COLUMNS[name].extra_bytes])
def test_every_column_that_a_stage_makes_can_be_asked_for(column):
    chain = load_profile("fast")
    if column.startswith("skew"):  # of decomposers that no shipped chain has
        with pytest.raises(wb.ConfigError, match="put decompose.skewed .* and add stage attribute.skew, .* false"):
            with_columns(chain, [column])
        assert "skew needs a chain file" in OPTIONS["columns"].words.help
        return
    full = with_columns(chain, [column])
    assert column in full.makes  # and Chain has checked that what its stages need comes before them
    assert with_columns(full, [column]) is full


def test_nothing_is_found_for_columns_without_a_stage():
    chain = load_profile("fast")
    assert with_columns(chain, ["echo_time", "echo_flags", "nothing"]) is chain


@pytest.mark.parametrize("chain", [None, "auto", "fast", "accurate"])
@pytest.mark.parametrize("columns", ["+range,+energy", "amplitude,range,energy"])
def test_shipped_chains_get_the_stages(tiny_strip, tmp_path, chain, columns):
    result = wb.run(tiny_strip, tmp_path, chain=chain, columns=columns)
    assert not result.failed
    cloud = wb.read_cloud(tmp_path / f"{tiny_strip.stem}.laz")
    known = np.isfinite(cloud["amplitude"])
    assert known.any() and np.isfinite(cloud["energy"][known]).all() and np.isfinite(cloud["range"][known]).any()
    assert ("echo_width" in cloud.dtype.names) == columns.startswith("+")


def test_a_column_that_was_asked_for_and_has_no_value_is_a_warning(tiny_strip, tmp_path):
    result = wb.run(tiny_strip, tmp_path, chain="fast", columns="+cross_section,+incidence_angle")
    warnings = {one.text.split(":")[0]: one for one in result.outcomes[0].report.warnings if one.code == "no-value"}
    assert sorted(warnings) == ["cross_section", "incidence_angle"] and all(one.is_loud for one in warnings.values())
    assert "not calibrated; give --calibration" in warnings["cross_section"].text
    assert "`wavebatch survey STRIP --divergence MRAD -o SYSTEM.toml`" in warnings["incidence_angle"].text
    assert not [line for line in result.outcomes[0].report.remarks if "none of" in line]
    words = ("run", tiny_strip, "-o", tmp_path, "--overwrite", "-q", "--profile", "fast", "--fail-on", "no-value")
    for columns, code in (("+cross_section", 3), ("+cross_section_err", 3), ("+range", 0)):
        assert run_command(*words, "--columns", columns).exit_code == code


@pytest.mark.parametrize("column", ["range", "relative_backscatter", "relative_reflectance", "cross_section"])
def test_added_stages_get_the_position_of_the_sensor(column):
    chain = load_profile("fast")
    assert needs_sensor(with_columns(chain, [column]))


def test_a_chain_of_the_user_stays_as_it_is(tiny_strip, tmp_path):
    with pytest.raises(wb.ConfigError, match=r"does not compute 'range'; add stage attribute\.range to it"):
        wb.run(tiny_strip, tmp_path, chain=load_profile("fast"), columns="+range")


def test_a_flight_height_is_used_named_or_refused(tiny_strip, tmp_path):
    def run(height, folder):
        result = wb.run(tiny_strip, tmp_path / folder, chain="fast", columns="+range", flight_height=height)
        return result.outcomes[0]

    known = run(None, "none")
    seen = known.report
    outcome = run(800.0, "near")
    assert outcome.error is None
    (line,) = [line for line in outcome.report.remarks if "--flight-height" in line]
    assert line.startswith("--flight-height 800 m is not used: positions are from the strip's direction vectors: ")
    assert not [line for line in seen.remarks if "--flight-height" in line]
    for height in (80, 8000):
        error = run(height, "far").error
        assert f"--flight-height {height} m contradicts the strip: by its direction vectors" in str(error)
    with pytest.raises(wb.ConfigError, match="--trajectory and --flight-height exclude each other"):
        wb.run(tiny_strip, tmp_path / "both", columns="+range", trajectory=tiny_strip, flight_height=800.0)
