"""The chain that a survey chooses loses nothing against the accurate one, and says what it leaves out and why."""

from dataclasses import replace

import laspy
import numpy as np
import pytest
from helpers_scenes import make_block, make_scene
from scoring import score

import wavebatch
from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import load_profile, parse_chain
from wavebatch.surveying import Decision, Survey, survey_block
from wavebatch.surveying.choose_chain import LOST, chain_text, choose_chain, decide, widest_chain
from wavebatch.surveying.systems.figures import Figures
from wavebatch.tools.simulate import find_pulse, simulate_strip
from wavebatch.tools.simulate.render import PulseModel

OPEN_FIGURES = Figures(empty_share=0.2, overlapped_share=0.0005)
DECISIONS = (
    Decision("sum of Gaussians", False, "a simpler pulse reaches the noise"),
    Decision("growth of fits", False, "says the survey"),
    Decision("width prior", False, "says the survey"),
    Decision("echo width", True, "the system pulse is 2.00 samples wide (limit 0.85)"),
    Decision("incidence angle", False, "99 % of the clear echoes have the width of the system pulse"),
)


def _survey(decisions=DECISIONS, waveforms=8000, **figures) -> Survey:
    return Survey(SystemPulse(sigma_ref=2.0), waveforms, replace(OPEN_FIGURES, **figures), decisions)


def _stages(chain) -> list[str]:
    return [step.stage.name for step in chain.steps]


def _grows(survey: Survey) -> bool:
    return choose_chain(survey).steps[2].effective()["max_echoes"] > 1


def test_an_open_scene_gets_one_fit_per_maximum_and_reads_why():
    survey = _survey()
    assert _stages(choose_chain(survey)) == [
        "noise.pooled", "detect.maximum", "decompose.adaptive", "attribute.amplitude", "attribute.echo_width",
        "attribute.position",
    ]  # fmt: skip
    assert not _grows(survey)
    comments = [line for line in chain_text(survey).splitlines() if line.startswith("# ")]
    for part in ("sum of Gaussians", "growth of fits", "incidence angle"):
        assert any(line.startswith(f"# {part}: no: ") for line in comments)
    assert any(line.startswith("# width prior: yes: ") for line in comments)
    out = [decision.part for decision in decide(survey) if not decision.needed]
    assert out == ["sum of Gaussians", "growth of fits", "incidence angle"]


@pytest.mark.parametrize(
    ("survey", "grows"),
    [
        (_survey(overlapped_share=0.0), False),
        (_survey(overlapped_share=LOST), True),
        (_survey(overlapped_share=0.003, empty_share=0.0), False),
        (_survey(overlapped_share=0.003, empty_share=0.8), True),  # of the echoes there, many overlap
        (_survey(overlapped_share=0.0, waveforms=300), True),  # too few to be sure
        (_survey(overlapped_share=0.0, waveforms=1000), True),  # as one pair among them
        (_survey(overlapped_share=0.001, waveforms=1000), True),
        (_survey(overlapped_share=0.0, empty_share=1.0), True),
        (_survey(decisions=()), True),
        (replace(_survey(), figures=Figures()), True),
        (replace(_survey(), waveforms=0, figures=Figures(), decisions=()), True),
    ],
)
def test_fits_stop_growing_only_where_next_to_nothing_overlaps(survey, grows):
    assert _grows(survey) is grows
    decision = next(decision for decision in decide(survey) if decision.part == "growth of fits")
    assert decision.needed is grows and decision.reason


def test_a_share_of_a_small_sample_is_at_most_all():
    reasons = [decision.reason for decision in decide(_survey(overlapped_share=0.8, empty_share=0.0, waveforms=5))]
    assert any("at most 100.00 % by this sample" in reason for reason in reasons)


def test_no_widths_of_an_undersampled_pulse():
    decisions = (*DECISIONS[:3], Decision("echo width", False, "the system pulse is 0.64 samples wide (limit 0.85)"))
    survey = _survey(decisions)
    chain = choose_chain(survey)
    assert "attribute.echo_width" not in _stages(chain)
    assert "# echo width: no: the system pulse is 0.64" in chain_text(survey)


def test_columns_that_the_chosen_chain_leaves_out_are_not_written(tmp_path):
    simulate_strip(make_scene("flat", pulse=PulseModel(0.6)), tmp_path / "s.las", pulses=1000)
    wavebatch.run(tmp_path / "s.las", tmp_path / "out")
    columns = [*laspy.read(tmp_path / "out" / "s.laz").point_format.extra_dimension_names]
    assert columns == ["amplitude", "amplitude_err", "range_err", "echo_flags"]


def test_a_reason_of_several_lines_stays_one_comment():
    decisions = (Decision("growth of fits", False, ""), Decision("sum of Gaussians", False, "a\n[[chain]]"))
    text = chain_text(_survey(decisions))
    assert "# sum of Gaussians: no: a [[chain]]" in text
    assert parse_chain(text, "x").steps[2].stage.name == "decompose.adaptive"


def test_the_widest_chain_computes_what_accurate_does():
    assert set(widest_chain().makes) == set(load_profile("accurate").makes)
    assert widest_chain().steps[2].effective() == load_profile("accurate").steps[2].effective()


@pytest.mark.quick_cases("forest")
@pytest.mark.parametrize(
    ("scene", "grows"),
    [
        (make_scene("flat"), False),
        (make_scene("flat", pulse=find_pulse("skewed")), False),
        (make_scene("flat", pulse=find_pulse("riegl"), n_samples=100), False),
        (make_scene("urban"), True),
        (make_scene("forest"), True),
        (make_scene("empty"), True),
    ],
    ids=["flat", "flat skewed", "flat riegl", "urban", "forest", "empty"],
)
def test_nothing_is_lost_against_the_accurate_chain(scene, grows):
    survey = survey_block(make_block(scene, 6000, seed=1)[0])
    block, truth = make_block(scene, 8000, seed=2)
    noise = scene.recording.recorded_noise
    auto, accurate = (
        score(chain.run(block, survey.system), truth, len(block), noise_std=noise)
        for chain in (choose_chain(survey), load_profile("accurate"))
    )
    assert _grows(survey) is grows
    assert auto.completeness >= accurate.completeness - 0.001
    assert auto.correctness >= accurate.correctness - 0.001
    assert auto.exact_count >= accurate.exact_count - 0.001
    assert auto.errors["all"]["time"].rmse <= 1.02 * accurate.errors["all"]["time"].rmse


def test_the_choice_depends_on_nothing_but_the_survey():
    block = make_block("flat", 3000, seed=3)[0]
    first, again = survey_block(block), survey_block(block.rows(np.arange(len(block))))
    assert chain_text(first) == chain_text(again)


def test_angles_that_the_widths_allow_are_named_with_what_they_need():
    """The beam's divergence is in no strip, so that no survey alone can add the stage."""
    survey = Survey(SystemPulse(2.0), 8000, decisions=(Decision("incidence angle", True, "60 % are wider"),))
    text = chain_text(survey)
    assert "# incidence angle: not in this chain: it needs the divergence of the beam" in text
    assert "attribute.incidence_angle" not in [step.stage.name for step in parse_chain(text, "c").steps]
    assert "incidence angle" not in chain_text(Survey(SystemPulse(2.0), 8000))
