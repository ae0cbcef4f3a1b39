"""Stages and chains: a stage is a plain function, a chain is the ordered list of stages that a block runs through."""

from __future__ import annotations

import inspect
import time
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError, StageError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock

KINDS: dict[str, tuple[tuple[str, ...], type]] = {
    "noise": (("block", "system"), Noise),
    "detect": (("block", "noise", "system"), EchoTable),
    "decompose": (("block", "noise", "system", "echoes"), EchoTable),
    "attribute": (("block", "noise", "system", "echoes"), EchoTable),
}
"""Per kind of stage: its data arguments, in order, and what it returns. Chains hold the kinds in this order."""


_MANY = 1e6
RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("threshold", "t_diff", "significance", "acceptance"), (0.0, _MANY)),
    **dict.fromkeys(("gate_residual", "gate_hermite", "tolerance"), (0.0, _MANY)),
    **dict.fromkeys(("fraction", "similarity", "reference_error"), (0.0, 1.0)),
    **dict.fromkeys(("max_iterations", "max_echoes"), (1, 1000)),
    **dict.fromkeys(("scale", "width_prior", "guard", "duration"), (0.0, 100.0)),
    **dict.fromkeys(("level", "limit"), (0.1, _MANY)),
    "iterations": (1, 10_000),
    "steps": (0, 100),
    "reach": (0.5, 20.0),
    "kappa": (-1.0, 1.0),
    "samples": (2, 65_535),
    "divergence": (0.0, 100.0),
    "max_error": (1e-3, 180.0),
    "radius": (1e-3, 1000.0),
    "min_points": (4, 10_000),
}
"""Least and largest value of numeric parameters by name, which means the same in every stage."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One keyword argument of a stage: its key in the chain file."""

    name: str
    types: tuple[type, ...]
    default: Any
    meaning: str
    choices: tuple[Any, ...] | None = None
    range: tuple[float, float] | None = None
    """Least and largest value; None where it is no number."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A registered algorithm."""

    name: str
    """`kind.function`, as in the chain file."""
    kind: str
    function: Callable[..., Any]
    parameters: Mapping[str, Parameter]
    makes: tuple[str, ...] = ()
    """Names of the attribute columns that the stage adds."""
    needs: tuple[str, ...] = ()
    """Names of the attribute columns that must be there before."""
    second_pass: Callable[..., Any] | None = None
    """Kernel that fills the stage's columns once all points of the strip are there; the stage itself, which sees one
    block only, makes no-data and the columns `ray_x`, `ray_y`, `ray_z`.

    It is called with points (n, 3) [m], rays (n, 3), kernels.normals.Surroundings and the stage's parameters, of which
    `radius` [m] is how far away points matter; it returns values of the columns, and a kernels.normals.Gap each."""

    @property
    def summary(self) -> str:
        """First line of the docstring: what comes out."""
        return (inspect.getdoc(self.function) or "").splitlines()[0]


STAGES: dict[str, Stage] = {}
"""Every registered stage by name; filled when `wavebatch.stages` is imported."""


def stage(
    kind: str,
    *,
    makes: tuple[str, ...] = (),
    needs: tuple[str, ...] = (),
    second_pass: Callable[..., Any] | None = None,
) -> Callable:
    """Decorator that registers a function as stage `kind.<function name>` and checks its signature."""
    if kind not in KINDS:
        raise StageError(f"stage kind {kind!r} is not one of {', '.join(KINDS)}")

    def register(function: Callable) -> Callable:
        name = f"{kind}.{function.__name__}"
        if name in STAGES:
            raise StageError(f"stage {name} is registered twice")
        parameters = _read_parameters(name, kind, function)
        if second_pass is not None and "radius" not in parameters:
            raise StageError(f"stage {name} has a second pass, but no parameter radius")
        STAGES[name] = Stage(name, kind, function, parameters, makes, needs, second_pass)
        return function

    return register


def _read_parameters(name: str, kind: str, function: Callable) -> dict[str, Parameter]:
    signature = inspect.signature(function)
    hints = typing.get_type_hints(function)
    data = tuple(p.name for p in signature.parameters.values() if p.kind is not p.KEYWORD_ONLY)
    if data != KINDS[kind][0]:
        raise StageError(f"stage {name} takes {data}, a {kind} stage takes {KINDS[kind][0]}")
    if hints.get("return") is not KINDS[kind][1]:
        raise StageError(f"stage {name} must be annotated to return {KINDS[kind][1].__name__}")
    meanings = _read_meanings(inspect.getdoc(function) or "")
    parameters = {}
    for parameter in signature.parameters.values():
        if parameter.kind is not parameter.KEYWORD_ONLY:
            continue
        if parameter.default is parameter.empty or parameter.name not in meanings:
            raise StageError(f"stage {name}: parameter {parameter.name} needs a default and a line in the docstring")
        kinds, choices = _read_hint(hints[parameter.name])
        limits = RANGES.get(parameter.name) if {int, float} & set(kinds) and choices is None else None
        parameters[parameter.name] = Parameter(
            parameter.name, kinds, parameter.default, meanings[parameter.name], choices, limits
        )
    return parameters


def _read_hint(hint: Any) -> tuple[tuple[type, ...], tuple[Any, ...] | None]:
    if typing.get_origin(hint) is typing.Literal:
        choices = typing.get_args(hint)
        return tuple({type(choice) for choice in choices}), choices
    if isinstance(hint, types.UnionType):
        return tuple(typing.get_args(hint)), None
    return (hint,), None


def _read_meanings(docstring: str) -> dict[str, str]:
    """`name: meaning` paragraphs of a docstring; a meaning runs until a blank line or the next name."""
    meanings: dict[str, str] = {}
    current = None
    for line in docstring.splitlines()[1:]:
        head, colon, rest = line.partition(":")
        if colon and head.isidentifier():
            current = head
            meanings[current] = rest.strip()
        elif not line.strip():
            current = None
        elif current:
            meanings[current] += " " + line.strip()
    return meanings


@dataclass(frozen=True, slots=True)
class Step:
    """One stage of a chain with its parameters; those not named keep the stage's defaults."""

    stage: Stage
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def effective(self) -> dict[str, Any]:
        """Every parameter with the value that will be used."""
        return {**{name: p.default for name, p in self.stage.parameters.items()}, **self.parameters}


@dataclass(frozen=True, slots=True)
class Chain:
    """Checked, ordered steps: one noise stage, one detector, one decomposer, then any attributes."""

    steps: tuple[Step, ...]
    name: str = ""

    def __post_init__(self) -> None:
        kinds = [step.stage.kind for step in self.steps]
        if kinds[:3] != ["noise", "detect", "decompose"] or any(kind != "attribute" for kind in kinds[3:]):
            raise ConfigError(
                f"chain {self.name or '(unnamed)'}: needs one noise, one detect and one decompose stage, then "
                f"attribute stages, in this order; it has {', '.join(kinds) or 'nothing'}"
            )
        have: set[str] = set()
        for step in self.steps:
            missing = [column for column in step.stage.needs if column not in have]
            if missing:
                raise ConfigError(
                    f"chain {self.name or '(unnamed)'}: {step.stage.name} needs {', '.join(missing)}; "
                    "put the stage that makes it before"
                )
            have.update(step.stage.makes)

    @property
    def makes(self) -> tuple[str, ...]:
        """Attribute columns that the chain computes, in order."""
        return tuple(dict.fromkeys(name for step in self.steps for name in step.stage.makes))

    @property
    def second_step(self) -> Step | None:
        """The last step that needs a second pass over the strip's points; None where no step does."""
        return next((step for step in reversed(self.steps) if step.stage.second_pass is not None), None)

    def run(
        self, block: WaveformBlock, system: SystemPulse, timing: dict[str, float] | None = None
    ) -> EchoTable:
        """Echoes of the block; seconds spent in each stage are added to `timing`."""
        data: dict[str, Any] = {"block": block, "system": system.of(block)}
        slot = {"noise": "noise", "detect": "echoes", "decompose": "echoes", "attribute": "echoes"}
        for step in self.steps:
            start = time.perf_counter()
            arguments = [data[name] for name in KINDS[step.stage.kind][0]]
            try:
                result = step.stage.function(*arguments, **step.parameters)
            except ConfigError as error:
                raise ConfigError(f"chain {self.name or '(unnamed)'}: {step.stage.name}: {error}") from error
            except (ArithmeticError, IndexError, KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
                raise StageError(
                    f"stage {step.stage.name} failed on the {len(block)} waveforms from point {block.first}: "
                    f"{type(error).__name__}: {error}; this is a bug, please report it with the strip"
                ) from error
            data[slot[step.stage.kind]] = result
            if timing is not None:
                timing[step.stage.name] = timing.get(step.stage.name, 0.0) + time.perf_counter() - start
        return data["echoes"]
