"""Stages and chains: what the decorator refuses, the order of kinds, needs and makes, and a stage that fails."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.echoes import COLUMNS, Column, EchoTable
from wavebatch.core.errors import ConfigError, StageError
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.column_names import Naming, WrittenColumn
from wavebatch.files.las.header import ExtraRecord
from wavebatch.stages import chain as chain_module
from wavebatch.stages.chain import STAGES, Chain, Range, Step, list_profiles, load_profile, stage

SYSTEM = SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, std=1.0))


@pytest.fixture(autouse=True)
def own_stages():
    """Stages and columns that a test registers are gone after it."""
    known = [(table, set(table)) for table in (STAGES, COLUMNS)]
    yield
    for table, names in known:
        for name in table.keys() - names:
            del table[name]


def block(n=3):
    samples = 12 + 80 * np.exp(-0.5 * ((np.arange(48) - 20.3) / 2) ** 2)
    return WaveformBlock.from_samples(np.rint(np.tile(samples, (n, 1))).astype(np.uint8), first=700)


def steps(*names):
    return tuple(Step(STAGES[name]) for name in names)


BASE = ("noise.pooled", "detect.maximum", "decompose.gaussian")


def test_a_stage_is_known_by_kind_and_name_with_its_schema():
    @stage("detect")
    def invented(
        block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: Annotated[float, Range(1, 9)] = 3.0
    ) -> EchoTable:
        """Echoes of a test.

        They are invented.

        Parameters
        ----------
        level : float
            Least height,
            in noise standard deviations.

        References
        ----------
        None.
        """
        return EchoTable.empty()

    made = chain_module.STAGES["detect.invented"]
    assert made.kind == "detect"
    assert made.summary == "Echoes of a test."
    parameter = made.parameters["level"]
    assert parameter.default == 3.0
    assert parameter.types == (float,)
    assert parameter.range == (1, 9)
    assert parameter.meaning == "Least height, in noise standard deviations."
    assert made.text == "Echoes of a test.\n\nThey are invented.\n\nReferences: None."
    assert made.function is invented


def no_default(block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float) -> EchoTable:
    """Echoes.

    Parameters
    ----------
    level : float
        Least height.
    """


def no_meaning(block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float = 1.0) -> EchoTable:
    """Echoes."""


def other_parameter(block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float = 1.0) -> EchoTable:
    """Echoes.

    Parameters
    ----------
    block : WaveformBlock
        The waveforms.
    levels : float
        Least height.

    level: least height.
    """


def empty_entry(block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float = 1.0) -> EchoTable:
    """Echoes.

    Parameters
    ----------
    level : float
    """


def wrong_order(noise: Noise, block: WaveformBlock, system: SystemPulse) -> EchoTable:
    """Echoes."""


def wrong_return(block: WaveformBlock, noise: Noise, system: SystemPulse) -> Noise:
    """Echoes."""


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (no_default, "parameter level needs a default"),
        (no_meaning, "an entry under Parameters"),
        (other_parameter, "parameter level needs a default and an entry"),
        (empty_entry, "parameter level needs a default and an entry"),
        (wrong_order, "a detect stage takes"),
        (wrong_return, "annotated to return EchoTable"),
    ],
)
def test_the_decorator_refuses_functions_that_are_no_stage(function, words):
    with pytest.raises(StageError, match=words) as caught:
        stage("detect")(function)
    assert f"detect.{function.__name__}" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert f"detect.{function.__name__}" not in chain_module.STAGES


def test_the_decorator_refuses_unknown_kinds_and_second_names():
    refuses(StageError, "'filter' is not one of noise, detect, decompose, attribute", stage, "filter")
    refuses(StageError, "noise.pooled is registered twice", stage("noise"), STAGES["noise.pooled"].function)


@pytest.mark.parametrize(
    "names",
    [
        (),
        BASE[:1],
        BASE[:2],
        (BASE[1], BASE[0], BASE[2]),
        (*BASE, "noise.tail"),
        (*BASE, "decompose.none"),
        ("noise.pooled", "noise.tail", *BASE[1:]),
        (*BASE[:2], "attribute.amplitude", BASE[2]),
        ("attribute.amplitude", *BASE),
    ],
)
def test_kinds_must_come_in_order(names):
    with pytest.raises(ConfigError, match="one noise, one detect and one decompose stage") as caught:
        Chain(steps(*names), "mine.toml")
    assert str(caught.value).startswith("chain mine.toml: ")
    assert "\n" not in str(caught.value)


def test_attributes_run_in_the_order_given():
    chain = Chain(steps(*BASE, "attribute.echo_width", "attribute.amplitude"))
    assert chain.makes == ("echo_width", "echo_width_err", "amplitude", "amplitude_err")
    assert list(chain.run(block(), SYSTEM).attributes) == list(chain.makes)


@pytest.fixture
def dependent():
    """A pair of attribute stages, of which the second needs the first's column."""

    @stage("attribute", makes=("energy",))
    def first(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
        """A column."""
        return echoes.with_attributes(energy=echoes.amplitude)

    @stage("attribute", makes=("twice",), needs=("energy",))
    def second(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
        """Twice the column."""
        return echoes.with_attributes(twice=2 * echoes.attributes["energy"])

    return tuple(Step(chain_module.STAGES[f"attribute.{name}"]) for name in ("first", "second"))


def test_a_stage_that_needs_a_column_comes_after_the_one_that_makes_it(dependent):
    first, second = dependent
    table = Chain((*steps(*BASE), first, second)).run(block(), SYSTEM)
    np.testing.assert_array_equal(table.attributes["twice"], 2 * table.amplitude)
    for wrong in ((second,), (second, first)):
        with pytest.raises(ConfigError, match="attribute.second needs energy; put the stage that makes it before"):
            Chain((*steps(*BASE), *wrong))


def test_stages_share_parameters_with_defaults_and_meanings():
    @dataclass(frozen=True)
    class Wide:
        """Shared.

        Parameters
        ----------
        width : float
            Of something [ns].
        """

        width: Annotated[float, Range(0.0, 9.0)] = 1.0

    @dataclass(frozen=True)
    class Long(Wide):
        """Shared too.

        Parameters
        ----------
        length : int
            Of something else.
        """

        length: int = 2

    @stage("attribute", makes=("energy",), shares=Long(length=5))
    def sharing(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, **options: float
                ) -> EchoTable:  # fmt: skip
        """A column."""
        return echoes.with_attributes(energy=np.full(len(echoes), options.get("width", 7.0)))

    made = chain_module.STAGES["attribute.sharing"]
    assert {name: (one.default, one.meaning) for name, one in made.parameters.items()} == {
        "width": (1.0, "Of something [ns]."), "length": (5, "Of something else.")}  # fmt: skip
    assert made.parameters["width"].range == Range(0.0, 9.0)
    table = Chain((*steps(*BASE), Step(made, {"width": 3.0}))).run(block(), SYSTEM)
    assert (table.attributes["energy"] == 3.0).all()


@pytest.mark.parametrize("first", ["attribute.incidence_angle_normals", "attribute.of_neighbours"])
def test_two_stages_with_a_second_pass_are_refused(first):
    """Only the last of them ran; the other's column was no-data without a word."""

    @stage("attribute", makes=("energy",), second_pass=lambda *_, **__: None)
    def of_neighbours(
        block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *, radius: float = 1.0
    ) -> EchoTable:
        """A column.

        Parameters
        ----------
        radius : float
            Of the neighbourhood [m].
        """

    both = (first, "attribute.incidence_angle_normals")
    names = (*BASE, "attribute.position", *both)
    with pytest.raises(ConfigError, match=f"{both[0]} and {both[1]} both need a second pass .* keep one of them"):
        Chain(tuple(Step(chain_module.STAGES[name]) for name in names), "mine.toml")
    one = Chain(tuple(Step(chain_module.STAGES[name]) for name in names[:-1]))
    assert one.second_step.stage.name == first


def test_a_stage_can_declare_a_new_column():
    roughness = Column("roughness", "f4", "m", "of the surface")

    def rough(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
        """A column."""

    stage("attribute", makes=(roughness,))(rough)
    assert chain_module.STAGES["attribute.rough"].makes == ("roughness",)
    assert COLUMNS["roughness"] is roughness
    rough.__name__ = "rougher"
    with pytest.raises(StageError, match="attribute.rougher declares column roughness, which there is already"):
        stage("attribute", makes=(roughness,))(rough)


def test_parameters_reach_the_stage_and_the_effective_ones_name_all():
    quiet = Step(STAGES["detect.maximum"], {"threshold": 1e6})
    assert len(Chain((Step(STAGES["noise.pooled"]), quiet, Step(STAGES["decompose.none"]))).run(block(), SYSTEM)) == 0
    step = Step(STAGES["noise.pooled"], {"guard": 5.0})
    assert step.effective() == {"guard": 5.0, "limit": STAGES["noise.pooled"].parameters["limit"].default}


@pytest.mark.parametrize(
    "failure",
    [ValueError("bad"), IndexError("out"), ZeroDivisionError("zero"), np.linalg.LinAlgError("singular"), SystemExit(7)],
)
def test_a_stage_that_fails_names_itself_and_the_waveforms_in_one_line(failure):
    @stage("decompose")
    def broken(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
        """Never anything."""
        raise failure

    chain = Chain((*steps(*BASE[:2]), Step(chain_module.STAGES["decompose.broken"])))
    with pytest.raises(StageError) as caught:
        chain.run(block(), SYSTEM)
    message = str(caught.value)
    assert message.startswith("stage decompose.broken failed on the 3 waveforms from point 700: ")
    assert type(failure).__name__ in message
    assert str(failure) in message
    assert "\n" not in message
    assert caught.value.__cause__ is failure


@pytest.mark.parametrize(
    ("give", "said"),
    [(lambda echoes, name: None, "returned NoneType in place of EchoTable"), (lambda echoes, name: echoes, "no column"),
     (lambda echoes, name: echoes.with_attributes(**{name: np.zeros((len(echoes), 2))}), "no column"),
     (lambda echoes, name: echoes.with_attributes(**{name: np.full(len(echoes), "x")}), "no column"),
     (lambda echoes, name: echoes.with_attributes(**{name: np.multiply(echoes.amplitude, 2, echoes.amplitude)}),
      "read-only")],
)  # fmt: skip
def test_a_stage_that_breaks_its_promise_is_named(give, said):
    """The column was no-data, or its first part, for every echo, in silence; or another column changed with it."""

    @stage("attribute", makes=(Column("promised", "f4", "-", "nothing"),))
    def broken(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
        """Not what it says."""
        return give(echoes, "promised")

    with pytest.raises(StageError, match=f"^stage attribute.broken .*{said}"):
        Chain((*steps(*BASE), Step(chain_module.STAGES["attribute.broken"]))).run(block(), SYSTEM)


def test_integers_of_a_column_are_kept_within_its_type_and_have_a_no_data_that_fits():
    """9999 in a byte was 15, and the no-data of -9999 was 241, which no record declares."""
    with pytest.raises(StageError, match=r"attribute.bytes: small \(u1\) cannot hold its no_data -9999"):

        @stage("attribute", makes=(Column("small", "u1", "-", "a byte"),))
        def bytes(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
            """Never run."""

    record = ExtraRecord.build("small", "u1", "a byte", no_data=255)
    values = WrittenColumn("small", record, Naming("small")).encode(np.array([0, 9999, -7, 255]))
    assert values.dtype == np.uint8 and values.tolist() == [0, 254, 0, 255]  # 255: of a point without an echo


def test_time_is_kept_per_stage_and_added_up():
    chain = load_profile("fast")
    timing = {}
    chain.run(block(), SYSTEM, timing)
    once = dict(timing)
    assert list(timing) == [step.stage.name for step in chain.steps]
    assert all(min(seconds.processor, seconds.wall) >= 0 for seconds in timing.values())
    chain.run(block(), SYSTEM, timing)
    assert all((timing[name] - once[name]).wall >= 0 for name in once)


@pytest.mark.parametrize("profile", list_profiles())
def test_shipped_chains_find_a_plain_echo(profile):
    table = load_profile(profile).run(block(), SYSTEM)
    assert table.waveform.tolist() == [0, 1, 2]
    np.testing.assert_allclose(table.time, 20.3, atol=0.02)
    np.testing.assert_allclose(table.amplitude, 80, atol=1)
    np.testing.assert_allclose(table.sigma, 2, atol=0.02)


def test_a_value_that_a_stage_refuses_is_the_chain_files_fault():
    steps = [("noise.tail", {"samples": 1}), ("detect.maximum", {}), ("decompose.none", {})]
    chain = Chain(tuple(Step(STAGES[name], values) for name, values in steps), name="mine.toml")
    block = WaveformBlock.from_samples(np.full((3, 20), 9, np.uint8))
    with pytest.raises(ConfigError, match=r"chain mine\.toml: noise\.tail: samples must be at least 2, got 1"):
        chain.run(block, SystemPulse(2.0))
