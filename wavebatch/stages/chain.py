"""Stages and chains: a stage is a plain function, a chain is the ordered list of stages that a block runs through.

The decorator `stage` registers functions; chain files name them. The signature of a stage is its schema in the chain
file: every keyword argument is a key, its annotation gives type and range, its default the value when left out.
`parse_chain` makes a checked Chain of TOML text, `effective` a text that names every parameter.

Stages of other installed packages are found through the entry-point group `wavebatch.stages`: an entry point names a
module that registers its stages with `@wavebatch.stage` when it is imported. Nothing is imported before a chain names
an unknown stage or the stages are listed, so that plugins cost nothing when none is used.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import COLUMNS, SUFFIX, Column, EchoTable
from wavebatch.core.errors import ConfigError, StageError, nearest
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.process import Seconds
from wavebatch.core.schema import Range, read_hint
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.text_file import read_text
from wavebatch.files.toml_file import TomlTable, check_range, check_type, format_toml, format_toml_value, parse_toml
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.stages.clean import clean_block

KINDS: dict[str, tuple[tuple[str, ...], type]] = {
    "noise": (("block", "system"), Noise),
    "detect": (("block", "noise", "system"), EchoTable),
    "decompose": (("block", "noise", "system", "echoes"), EchoTable),
    "attribute": (("block", "noise", "system", "echoes"), EchoTable),
}
"""Per kind of stage: its data arguments, in order, and what it returns. Chains hold the kinds in this order."""

Needs = tuple[str, ...] | Callable[[Mapping[str, Any]], tuple[str, ...]]

_SECTION = r"(?m)^(\w[\w ]*)\n-{3,}$"
_ENTRY = r"(?m)^(\w+)(?: :.*)?$"
"""Heading of a section of a numpydoc docstring, and of a parameter in it."""


@frozen
class Parameter:
    """One keyword argument of a stage: a key of its table in the chain file."""

    name: str
    types: tuple[type, ...]
    default: Any
    meaning: str
    choices: tuple[Any, ...] | None = None
    range: Range | None = None


@frozen
class Stage:
    """A registered algorithm."""

    name: str
    """`kind.function`, as in the chain file."""
    kind: str
    function: Callable[..., Any]
    parameters: Mapping[str, Parameter]
    makes: tuple[str, ...] = ()
    """Names of the attribute columns that the stage adds."""
    needs: Needs = ()
    """Names of the attribute columns that earlier stages must have added, or a function of the stage's parameters that
    returns them."""
    second_pass: Callable[..., Any] | None = None
    """Kernel that computes the stage's columns from all points of the strip. The stage sees one block only, so it fills
    its columns with no-data; stages that need them run again once they are known.

    The kernel gets points (n, 3) [m], rays (n, 3), kernels.geometry.normals.Surroundings and the stage's parameters,
    where `radius` [m] is the largest distance at which a point matters. It returns the columns' values and a
    kernels.geometry.normals.Gap for each point."""
    fits: Callable[[SystemPulse, Mapping[str, Any]], SystemPulse] | None = None
    """Of a decomposer: the strip's system with the pulse that it fits, from system and parameters. Attribute stages get
    it, so that widths and areas are read as what they are. None: the survey's pulse."""
    shape: Callable[[SystemPulse, float, Mapping[str, Any]], PulseShape | None] | None = None
    """Of a decomposer: the pulse by which its echoes are drawn, from system, spacing [ns] and parameters; None where
    nothing is fitted. Without this function it is the pulse of the system that `fits` returns. Echoes whose skew or
    exponent was fitted carry it as a column."""
    check: Callable[[Step, Chain, SystemPulse | None], str] | None = None
    """What is wrong with this stage in a chain and for a strip (None before the strip is known); empty if nothing."""
    searches: tuple[str, Callable[..., Any]] | None = None
    """Of a detector: the kind of signal in which it searches, by which `plot waveform --show` names it, or empty, and
    the function that gives this signal as `stages.detect.direct.Searched`. It takes what the stage takes."""

    @property
    def summary(self) -> str:
        """First line of the docstring."""
        return self.text.splitlines()[0]

    @property
    def text(self) -> str:
        """The docstring without its parameters; further sections follow as `Title: text`."""
        prose, sections = _split_docstring(self.function)
        rest = [f"{title}: {body}" for title, body in sections.items() if title not in ("Parameters", "Returns")]
        return "\n\n".join([prose, *rest])


STAGES: dict[str, Stage] = {}
"""Every registered stage by name; filled when `wavebatch.stages` is imported, and by plugins."""


def stage(
    kind: str,
    *,
    makes: tuple[str | Column, ...] = (),
    needs: Needs = (),
    second_pass: Callable[..., Any] | None = None,
    fits: Callable[[SystemPulse, Mapping[str, Any]], SystemPulse] | None = None,
    shape: Callable[[SystemPulse, float, Mapping[str, Any]], PulseShape | None] | None = None,
    check: Callable[[Step, Chain, SystemPulse | None], str] | None = None,
    searches: tuple[str, Callable[..., Any]] | None = None,
    shares: Any = None,
) -> Callable[[Callable], Callable]:
    """Register the decorated function as stage `kind.<function name>`.

    Parameters
    ----------
    kind : {"noise", "detect", "decompose", "attribute"}
        Decides the data arguments and the result: see KINDS.
    makes : tuple of str or Column
        Attribute columns that the stage adds. A Column declares a new one, so that `run` can write it.
    needs : tuple of str, or function of the parameters
        Attribute columns that earlier stages must have added.
    second_pass, fits, shape, check, searches : optional
        See `Stage`.
    shares : dataclass instance, optional
        Parameters that stages share: its fields with their annotations, its values as defaults, its docstring for their
        meaning. The function takes them as `**options`.

    Returns
    -------
    callable
        A decorator that returns the function unchanged.

    Raises
    ------
    StageError
        For a wrong signature, a parameter without default or description, and a name that is taken.
    """
    if kind not in KINDS:
        raise StageError(f"stage kind {kind!r} is not one of {', '.join(KINDS)}")

    def register(function: Callable) -> Callable:
        name = f"{kind}.{function.__name__}"
        if name in STAGES:
            raise StageError(f"stage {name} is registered twice")
        parameters = _Signature(name, kind, function, shares)
        if not function.__module__.startswith("wavebatch."):
            len(parameters)  # ours are read once a chain has them: all take a tenth of a small run, and a test does so
        if second_pass is not None and "radius" not in parameters:
            raise StageError(f"stage {name} has a second pass, but no parameter radius")
        new = {column.name: column for column in makes if isinstance(column, Column)}
        if taken := new.keys() & COLUMNS.keys():
            raise StageError(f"stage {name} declares column {min(taken)}, which there is already")
        for one in new.values():
            limits = np.iinfo(one.dtype) if np.dtype(one.dtype).kind in "iu" else None
            if limits and one.no_data is not None and not limits.min <= one.no_data <= limits.max:
                raise StageError(f"stage {name}: {one.name} ({one.dtype}) cannot hold its no_data {one.no_data:g}")
        COLUMNS.update(new)
        names = tuple(column.name if isinstance(column, Column) else column for column in makes)
        STAGES[name] = Stage(name, kind, function, parameters, names, needs, second_pass, fits, shape, check, searches)
        return function

    return register


class _Signature(Mapping[str, Parameter]):
    """The parameters of a stage, read from its function when they are first asked for; pickled as a dict."""

    def __init__(self, *source: Any) -> None:
        self._source = source

    @cached_property
    def _parameters(self) -> dict[str, Parameter]:
        name, kind, function, shares = self._source
        given = inspect.signature(function).parameters.values()
        data = tuple(p.name for p in given if p.kind not in (p.KEYWORD_ONLY, p.VAR_KEYWORD))
        if data != KINDS[kind][0]:
            raise StageError(f"stage {name} takes {data}, a {kind} stage takes {KINDS[kind][0]}")
        if typing.get_type_hints(function).get("return") is not KINDS[kind][1]:
            raise StageError(f"stage {name} must be annotated to return {KINDS[kind][1].__name__}")
        defaults = {p.name: p.default for p in given if p.kind is p.KEYWORD_ONLY}
        parameters = _declare(name, function, defaults)
        if shares is not None:
            values = dataclasses.asdict(shares)
            for one in type(shares).__mro__[:-1]:
                parameters |= _declare(name, one, {key: values[key] for key in one.__annotations__})
        return parameters

    def __getitem__(self, name: str) -> Parameter:
        return self._parameters[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def __reduce__(self) -> tuple[type[dict], tuple[dict[str, Parameter]]]:
        return dict, (self._parameters,)


def _declare(name: str, source: Callable | type, defaults: Mapping[str, Any]) -> dict[str, Parameter]:
    """Parameters from the annotations and the docstring of a function or dataclass."""
    hints = typing.get_type_hints(source, include_extras=True)
    _, *entries = re.split(_ENTRY, _split_docstring(source)[1].get("Parameters", ""))
    meanings = {head: " ".join(text.split()) for head, text in zip(entries[::2], entries[1::2], strict=True)}
    parameters = {}
    for key, default in defaults.items():
        # `python -OO` has no docstrings: then parameters have no meaning, but chains run.
        if default is inspect.Parameter.empty or not (meanings.get(key) or sys.flags.optimize > 1):
            raise StageError(f"stage {name}: parameter {key} needs a default and an entry under Parameters")
        kinds, choices, limits = read_hint(hints[key])
        parameters[key] = Parameter(key, kinds, default, meanings.get(key, ""), choices, limits)
    return parameters


def _split_docstring(function: Callable | type) -> tuple[str, dict[str, str]]:
    """Text before the first section of a numpydoc docstring, and the text of each section."""
    prose, *rest = re.split(_SECTION, inspect.getdoc(function) or "")
    return prose.strip(), {title: body.strip("\n") for title, body in zip(rest[::2], rest[1::2], strict=True)}


@frozen
class Step:
    """One stage of a chain with the parameters that the chain sets; all others keep their defaults."""

    stage: Stage
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def effective(self) -> dict[str, Any]:
        """Every parameter with the value that will be used."""
        return {**{name: p.default for name, p in self.stage.parameters.items()}, **self.parameters}

    def fit_system(self, system: SystemPulse) -> SystemPulse:
        """Return the strip's system with the pulse that this decomposer fits."""
        return system if self.stage.fits is None else self.stage.fits(system, self.effective())

    @property
    def needs(self) -> tuple[str, ...]:
        """Attribute columns that earlier stages must have added."""
        return self.stage.needs(self.effective()) if callable(self.stage.needs) else self.stage.needs


class Solved(NamedTuple):
    """The echoes of a block, and what the stages found them in."""

    block: WaveformBlock
    """Without the strip's defects: slopes, patterns, spikes, transients."""
    noise: Noise
    """Of that block."""
    system: SystemPulse
    """Of the block's digitizer."""
    echoes: EchoTable

    def without_samples(self) -> Solved:
        """Leave the samples out."""
        empty = np.empty((len(self.block), 0), self.block.samples.dtype)
        block = replace(self.block, samples=empty, missing=None)
        return self._replace(block=block, noise=replace(self.noise, of_sample=None))


@frozen
class Chain:
    """Checked, ordered steps: one noise stage, one detector, one decomposer, then any attributes."""

    steps: tuple[Step, ...]
    name: str = ""

    def __post_init__(self) -> None:
        """Check the order of the stages and the columns that they need."""
        kinds = [step.stage.kind for step in self.steps]
        if kinds[:3] != ["noise", "detect", "decompose"] or any(kind != "attribute" for kind in kinds[3:]):
            raise ConfigError(
                f"chain {self.name or '(unnamed)'}: needs one noise, one detect and one decompose stage, then "
                f"attribute stages, in this order; it has {', '.join(kinds) or 'nothing'}"
            )
        second = [step.stage.name for step in self.steps if step.stage.second_pass is not None]
        if len(second) > 1:
            raise ConfigError(
                f"chain {self.name or '(unnamed)'}: {' and '.join(second)} both need a second pass over the points, a "
                "run makes only one; keep one of them"
            )
        have: set[str] = set()
        for step in self.steps:
            missing = [column for column in step.needs if column not in have]
            if missing:
                raise ConfigError(
                    f"chain {self.name or '(unnamed)'}: {step.stage.name} needs {', '.join(missing)}; "
                    "put the stage that makes it before"
                )
            have.update(step.stage.makes)
        self.check(None)

    @property
    def decomposer(self) -> Step:
        """The step that fits echoes."""
        return self.steps[2]

    def check(self, system: SystemPulse | None) -> None:
        """Ask every stage whether it works in this chain.

        Parameters
        ----------
        system : SystemPulse or None
            Pulse and noise of the strip; None before they are known.

        Raises
        ------
        ConfigError
            Where stages do not belong together.
        """
        for step in self.steps:
            if step.stage.check is not None and (wrong := step.stage.check(step, self, system)):
                raise ConfigError(f"chain {self.name or '(unnamed)'}: {step.stage.name}: {wrong}")

    def __repr__(self) -> str:
        """A line per step, with the parameters that the chain sets."""
        lines = [f"<Chain {self.name or '(unnamed)'}>"]
        for step in self.steps:
            given = ", ".join(f"{name}={value!r}" for name, value in step.parameters.items())
            lines.append(f"  {step.stage.name:30}{given}".rstrip())
        return "\n".join(lines)

    @property
    def makes(self) -> tuple[str, ...]:
        """Attribute columns that the chain computes, in order."""
        return tuple(dict.fromkeys(name for step in self.steps for name in step.stage.makes))

    @property
    def second_step(self) -> Step | None:
        """The step that needs a second pass over the strip's points; None where no step does."""
        return next((step for step in self.steps if step.stage.second_pass is not None), None)

    @property
    def after_second(self) -> tuple[Step, ...]:
        """The steps that need the columns of the second pass, or of another such step, in order."""
        made = set() if self.second_step is None else set(self.second_step.stage.makes)
        found = []
        for step in self.steps:
            if not made.isdisjoint(step.needs):
                found.append(step)
                made.update(step.stage.makes)
        return tuple(found)

    def run(self, block: WaveformBlock, system: SystemPulse, timing: dict[str, Seconds] | None = None) -> EchoTable:
        """Find and describe the echoes of a block.

        Parameters
        ----------
        block : WaveformBlock
            n waveforms of one digitizer and one length.
        system : SystemPulse
            Pulse and noise of the strip, from its survey.
        timing : dict, optional
            Time spent in each stage is added here, by the stage's name.

        Returns
        -------
        EchoTable
            Echoes sorted by waveform, then time, with the columns of the attribute stages. `range_err` is that of the
            fit; how exactly a vendor placed the returns is in that of `wavebatch.run` only.

        Raises
        ------
        ConfigError
            Where a stage refuses a parameter's value, or does not work with this strip's pulse.
        StageError
            Where a stage fails: a bug.
        """
        return self.solve(block, system, timing).echoes

    def solve(self, block: WaveformBlock, system: SystemPulse, timing: dict[str, Seconds] | None = None) -> Solved:
        """Find the echoes of a block, and keep what they were found in: for residuals and pictures.

        Parameters
        ----------
        block, system, timing
            As for `run`.

        Returns
        -------
        Solved
        """
        cleaned, noise, system = self.estimate_noise(block, system, timing)
        found = Solved(cleaned, noise, system, EchoTable.empty())
        for step in self.steps[1:]:
            found = found._replace(echoes=self._call(step, self._data(found, step), timing))
        return found

    def keep_needed(self, solved: Solved) -> Solved:
        """Leave all out that stages after the second pass do not see: samples, returns, columns they do not need."""
        second = () if self.second_step is None else self.second_step.stage.makes
        needed = {name for step in self.after_second for name in step.needs} - set(second)
        others = {name for step in self.steps[3:] for name in step.stage.makes} - needed
        kept = {name: values for name, values in solved.echoes.attributes.items()
                if name.removesuffix(SUFFIX) not in others}  # fmt: skip
        small = solved.without_samples()
        return small._replace(block=replace(small.block, returns=None), echoes=replace(small.echoes, attributes=kept))

    def solve_again(self, solved: Solved, timing: dict[str, Seconds] | None = None) -> EchoTable:
        """Run the stages again that need the columns of the second pass, once the echoes have them.

        Parameters
        ----------
        solved : Solved
            From `keep_needed`, its echoes with the columns of the second pass.
        timing
            As for `run`.

        Returns
        -------
        EchoTable
        """
        for step in self.after_second:
            solved = solved._replace(echoes=self._call(step, self._data(solved, step), timing))
        return solved.echoes

    def _data(self, solved: Solved, step: Step) -> dict[str, Any]:
        """The data of a step; attribute stages get the system with the pulse that the decomposer fitted."""
        system = solved.system
        if step.stage.kind == "attribute":
            fitted = self.decomposer.fit_system(system)
            other = (fitted.components, fitted.kappa) != (system.components, system.kappa)
            system = replace(fitted, other_pulse=other)
        return {**solved._asdict(), "system": system}

    def estimate_noise(
        self, block: WaveformBlock, system: SystemPulse, timing: dict[str, Seconds] | None = None
    ) -> tuple[WaveformBlock, Noise, SystemPulse]:
        """Return the block without the strip's defects, its noise, and the system of its digitizer."""
        if not (isinstance(block, WaveformBlock) and isinstance(system, SystemPulse)):
            given = f"{type(block).__name__} and {type(system).__name__}"
            raise TypeError(f"a chain runs with a WaveformBlock and a SystemPulse, such as survey.system, not {given}")
        if not 0 < system.noise.std < np.inf:
            raise ConfigError(f"noise.std of a SystemPulse must be above 0 counts, got {system.noise.std}")
        system = system.of(block)
        self.check(system)
        cleaned = clean_block(block, system)
        return cleaned, self._call(self.steps[0], {"block": cleaned, "system": system}, timing), system

    def _call(self, step: Step, data: Mapping[str, Any], timing: dict[str, Seconds] | None) -> Any:
        """The result of a stage."""
        start, block = Seconds.now(), data["block"]
        echoes: EchoTable = data.get("echoes", EchoTable.empty())
        for values in (*echoes.columns().values(), *echoes.attributes.values()):  # a plug-in may write in place
            values.flags.writeable = False
        try:
            result = step.stage.function(*(data[name] for name in KINDS[step.stage.kind][0]), **step.parameters)
        except ConfigError as error:
            raise ConfigError(f"chain {self.name or '(unnamed)'}: {step.stage.name}: {error}") from error
        except (ArithmeticError, AttributeError, LookupError, SystemExit, TypeError, ValueError) as error:
            raise StageError(
                f"stage {step.stage.name} failed on the {len(block)} waveforms from point {block.first}: "
                f"{type(error).__name__}: {error}; this is a bug, please report it with the strip"
            ) from error
        kind = KINDS[step.stage.kind][1]
        if not isinstance(result, kind):
            raise StageError(f"stage {step.stage.name} returned {type(result).__name__} in place of {kind.__name__}")
        for column in step.stage.makes:
            values = np.asarray(getattr(result, "attributes", {}).get(column))
            if values.ndim != 1 or values.dtype.kind not in "biuf":
                raise StageError(f"stage {step.stage.name} gave no column {column} with a number for each echo")
        if timing is not None:
            timing[step.stage.name] = timing.get(step.stage.name, Seconds()) + (Seconds.now() - start)
        return result


GROUP = "wavebatch.stages"


@functools.cache
def load_plugins() -> tuple[str, ...]:
    """Import all plugins, once per process.

    Returns
    -------
    tuple of str
        One line for each plugin that cannot be imported; stages that it had registered before are removed.
    """
    from importlib.metadata import entry_points  # 20 ms that only chains with plugins need

    failures = []
    for point in entry_points(group=GROUP):
        before = set(STAGES)
        try:
            point.load()
        except (Exception, SystemExit) as error:
            for name in STAGES.keys() - before:
                del STAGES[name]
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            failures.append(f"plugin {point.name} ({point.value}) cannot be imported: {reason}")
    return tuple(failures)


_SHIPPED = Path(__file__).with_name("profiles")


def list_profiles() -> list[str]:
    """Return the names of the shipped chains, sorted."""
    return sorted(file.name.removesuffix(".toml") for file in _SHIPPED.iterdir() if file.name.endswith(".toml"))


def load_profile(name: str) -> Chain:
    """Load a shipped chain.

    Parameters
    ----------
    name : str
        A name of `list_profiles`.

    Returns
    -------
    Chain
        The checked chain.

    Raises
    ------
    ConfigError
        For an unknown name.
    """
    if name not in list_profiles():
        raise ConfigError(f"profile {name!r} does not exist; {nearest(name, list_profiles())}")
    return parse_chain((_SHIPPED / f"{name}.toml").read_text("utf-8"), f"profile {name}")


def load_chain_file(path: Path | str) -> Chain:
    """Load the chain of a TOML file.

    Parameters
    ----------
    path : path or str
        The file.

    Returns
    -------
    Chain
        The checked chain.

    Raises
    ------
    ConfigError
        Where the file or the chain is wrong; names file, table, key and the nearest known word.
    """
    if str(path) in ("auto", *list_profiles()) and not Path(path).exists():
        raise ConfigError(f"--chain {path}: there is no such file; the shipped chain is --profile {path}")
    return parse_chain(read_text(path, "chain file"), str(path))


def parse_chain(text: str, name: str) -> Chain:
    """Read a chain from TOML text.

    Parameters
    ----------
    text : str
        [[chain]] tables.
    name : str
        Name of the chain; every error message starts with it.

    Returns
    -------
    Chain
        The checked chain.

    Raises
    ------
    ConfigError
        Where the chain is wrong.
    """
    document = parse_toml(text, name)
    document.check_kind("chain")
    document.check_keys(["chain"])
    steps = tuple(map(_read_step, document.tables("chain")))
    return Chain(steps, name)


def effective(chain: Chain) -> str:
    """Write a chain as TOML text with every parameter as it will be used; `parse_chain` reads it back.

    Parameters
    ----------
    chain : Chain
        Any chain.

    Returns
    -------
    str
        [[chain]] tables.
    """
    return "\n".join(format_step(step.stage.name, step.effective()) for step in chain.steps)


def format_step(stage: str, parameters: Mapping[str, Any]) -> str:
    """Write one [[chain]] table as TOML text; parameters that are None are left out.

    Parameters
    ----------
    stage : str
        Name of the stage.
    parameters : mapping
        Values by name.

    Returns
    -------
    str
        The table.
    """
    return format_toml({"chain": [{"stage": stage, **parameters}]}).lstrip()


def _read_step(table: TomlTable) -> Step:
    table.check_keys(table.values, ["stage"], 'name one, for example stage = "detect.maximum"')
    name = table.get("stage", str)
    if name not in STAGES:
        failures = load_plugins()
        if name not in STAGES:
            kind = f"{name.partition('.')[0]}."
            same = [known for known in STAGES if known.startswith(kind)]
            advice = nearest(name, same or STAGES)
            if not same and advice.startswith("known"):
                advice = f"names begin with {', '.join(f'{one}.' for one in KINDS)}; `wavebatch stages` lists them"
            raise ConfigError("; ".join([f"{table.where}: unknown stage {name!r}", advice, *failures]))
    stage, where = STAGES[name], f"{table.where} ({name})"
    TomlTable(table.values, where).check_keys(["stage", *stage.parameters])
    values = {}
    for key in table.values:
        if key == "stage":
            continue
        parameter, place = stage.parameters[key], f"{where}: {key}"
        value = values[key] = check_type(table.values[key], parameter.types, place)
        if parameter.choices is not None and value not in parameter.choices:
            choices = ", ".join(map(format_toml_value, parameter.choices))
            if parameter.range is None or isinstance(value, str):
                number = "" if parameter.range is None else " or a number"
                raise ConfigError(f"{place} must be one of {choices}{number}, it is {format_toml_value(value)}")
        if parameter.range is not None and not isinstance(value, str):
            check_range(value, *parameter.range, place)
    return Step(stage, values)
