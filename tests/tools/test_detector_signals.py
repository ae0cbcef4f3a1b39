"""`plot waveform --show`: the signal that is drawn is the one in which the stage finds its echoes."""

import numpy as np
import pytest
from commands import run_command
from plot_tools import PULSE, make_chain, simulate

from wavebatch.core.errors import ConfigError
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.signal.filters import find_minima, keep_prominent
from wavebatch.stages.chain import STAGES, Step
from wavebatch.stages.noise import pooled
from wavebatch.tools.plots.waveform import build_views, choose_step, see_block

SIGNALS = sorted({stage.searches[0] for stage in STAGES.values() if stage.searches and stage.searches[0]})


def run(*words):
    return run_command("plot", "waveform", *words)


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
    with pytest.raises(ConfigError, match="must be one of detector, asdf"):
        choose_step(chain, "spline")
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
