"""Chain files: what is taken, what is refused and with which words."""

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.chain import (
    STAGES,
    Chain,
    effective,
    list_profiles,
    load_chain_file,
    load_profile,
    parse_chain,
    stage,
)

GOOD = """
[[chain]]
stage = "noise.pooled"
[[chain]]
stage = "detect.maximum"
threshold = 5
[[chain]]
stage = "decompose.closed_form"
steps = 3
[[chain]]
stage = "attribute.position"
"""


def test_values_are_kept_and_integers_become_numbers():
    chain = parse_chain(GOOD, "here")
    assert [step.stage.name for step in chain.steps] == [
        "noise.pooled", "detect.maximum", "decompose.closed_form", "attribute.position"
    ]  # fmt: skip
    threshold = chain.steps[1].parameters["threshold"]
    assert threshold == 5.0 and isinstance(threshold, float)
    assert chain.steps[2].parameters == {"steps": 3}


def test_effective_text_names_every_parameter_and_reads_back_the_same():
    chain = parse_chain(GOOD, "here")
    text = effective(chain)
    again = parse_chain(text, "there")
    assert [step.effective() for step in again.steps] == [step.effective() for step in chain.steps]
    assert effective(again) == text
    for step in chain.steps:
        for name in step.stage.parameters:
            assert f"\n{name} = " in text


@pytest.mark.parametrize("name", list_profiles())
def test_shipped_profiles_load_and_read_back(name):
    chain = load_profile(name)
    assert isinstance(chain, Chain)
    assert effective(parse_chain(effective(chain), name)) == effective(chain)


def _wrong(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (_wrong("detect.maximum", "detect.maximun"), ["[[chain]] 2", "detect.maximun", "'detect.maximum'?"]),
        (_wrong("threshold", "treshold"), ["[[chain]] 2 (detect.maximum)", "'treshold'", "'threshold'?"]),
        (_wrong("= 5", '= "5"'), ["threshold must be a number", "'5'"]),
        (_wrong("= 5", "= true"), ["threshold must be a number", "True"]),
        (_wrong("= 5", "= inf"), ["threshold must be a finite number"]),
        (_wrong("= 5", "= -5"), ["(detect.maximum): threshold must lie between 0 and 1e+06, it is -5.0"]),
        (_wrong("= 3", "= 3.0"), ["steps must be an integer", "3.0"]),
        (_wrong("= 3", "= 101"), ["steps must lie between 0 and 100, it is 101"]),
        (_wrong('stage = "noise.pooled"', "guard = 3.0"), ["[[chain]] 1", "key 'stage' is missing"]),
        (_wrong('"noise.pooled"', "7"), ["[[chain]] 1", "stage must be a string"]),
        (_wrong("= 5", "= "), ["not valid TOML", "line 6"]),
        ("[chain]\nstage = 'noise.pooled'", ["[[chain]]"]),
        ("[chain]\nstage = 'noise.pooled'\n[chain]\n", ["not valid TOML", "several times is written [[name]]"]),
        ("[[chian]]\nstage = 'noise.pooled'", ["'chian'", "'chain'?"]),
        ("jobs = 3\n" + GOOD, ["'jobs'"]),
        ("", ["needs one noise"]),
        (_wrong("noise.pooled", "detect.maximum"), ["needs one noise", "detect, detect, decompose"]),
    ],
)
def test_wrong_chains_are_refused_in_one_line_that_says_where(tmp_path, text, words):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_chain_file(path)
    message = str(caught.value)
    assert "\n" not in message and "wrong.toml" in message
    for word in words:
        assert word in message


@pytest.mark.parametrize("name", sorted(STAGES))
def test_every_number_has_a_range_that_holds_its_default(name):
    for parameter in STAGES[name].parameters.values():
        if parameter.choices is None and not isinstance(parameter.default, bool | str):
            low, high = parameter.range
            assert low <= parameter.default <= high, parameter.name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('"detect.constant_fraction"\nfraction = 0.0', "fraction must lie between 0 and 1, got 0"),
        ('"detect.wavelet"\nscale = 40.0', "scale is the level of the b3 wavelet, at most 15, it is 40"),
    ],
)
def test_values_that_only_the_stage_knows_to_be_wrong_are_no_bugs(text, message):
    chain = parse_chain(_wrong('"detect.maximum"\nthreshold = 5', text), "x")
    block = WaveformBlock.from_samples(np.full((2, 40), 12, np.uint8))
    refuses(ConfigError, message, chain.run, block, SystemPulse(2.0))


def test_choices_are_checked():
    from typing import Literal

    from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock

    def pick(block: WaveformBlock, system: SystemPulse, *, kind: Literal["a", "b"] = "a") -> Noise:
        """Noise.

        Parameters
        ----------
        kind : {"a", "b"}
            Which.
        """

    stage("noise")(pick)
    try:
        with pytest.raises(ConfigError, match='kind must be one of "a", "b", it is "c"'):
            parse_chain('[[chain]]\nstage = "noise.pick"\nkind = "c"\n', "x")
    finally:
        del STAGES["noise.pick"]
