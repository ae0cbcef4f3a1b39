"""Decompose full-waveform lidar strips into point clouds with the physical attributes of every echo.

The names below are the public API. Each is imported when it is first used, so that `import wavebatch` takes
milliseconds.

Examples
--------
>>> import wavebatch as wb
>>> with wb.open_strip("strip.las") as strip:  # doctest: +SKIP
...     survey = wb.survey(strip)
...     chain = wb.load_chain("accurate")
...     for block in strip.blocks():
...         echoes = chain.run(block, survey.system)
>>> result = wb.run(["a.las", "b.las"], "clouds", jobs=4)  # doctest: +SKIP
>>> cloud = wb.read_cloud("clouds/a.laz")  # doctest: +SKIP
"""

from __future__ import annotations

TYPE_CHECKING = False  # not from typing: Ctrl-C must find this import done (core/interrupts.py)
if TYPE_CHECKING:
    from wavebatch.batch.options import RunOptions
    from wavebatch.batch.run import BatchResult, Outcome
    from wavebatch.core.echoes import COLUMNS, Column, EchoFlag, EchoTable
    from wavebatch.core.errors import ConfigError, InputError, StageError
    from wavebatch.core.waveforms import Digitizer, Noise, ReceiverNoise, ReturnTable, SystemPulse, WaveformBlock
    from wavebatch.files.cloud.cloud_reader import read_cloud
    from wavebatch.stages.chain import Chain, Range, Step, stage
    from wavebatch.surveying.inspect_strip import Strip, open_strip, survey
    from wavebatch.surveying.systems.survey_result import Decision, Survey
    from wavebatch.tools.api import auto_chain, load_chain, run

__version__ = "0.1.0"

_MODULES = {
    "batch.run": ("BatchResult", "Outcome"),
    "core.echoes": ("COLUMNS", "Column", "EchoFlag", "EchoTable"),
    "core.errors": ("ConfigError", "InputError", "StageError"),
    "core.waveforms": ("Digitizer", "Noise", "ReceiverNoise", "ReturnTable", "SystemPulse", "WaveformBlock"),
    "files.cloud.cloud_reader": ("read_cloud",),
    "stages.chain": ("Chain", "Range", "Step", "stage"),
    "batch.options": ("RunOptions",),
    "surveying.systems.survey_result": ("Decision", "Survey"),
    "surveying.inspect_strip": ("Strip", "open_strip", "survey"),
    "tools.api": ("auto_chain", "load_chain", "run"),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "COLUMNS",
    "BatchResult",
    "Chain",
    "Column",
    "ConfigError",
    "Decision",
    "Digitizer",
    "EchoFlag",
    "EchoTable",
    "InputError",
    "Noise",
    "Outcome",
    "Range",
    "ReceiverNoise",
    "ReturnTable",
    "RunOptions",
    "StageError",
    "Step",
    "Strip",
    "Survey",
    "SystemPulse",
    "WaveformBlock",
    "__version__",
    "auto_chain",
    "load_chain",
    "open_strip",
    "read_cloud",
    "run",
    "stage",
    "survey",
]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
