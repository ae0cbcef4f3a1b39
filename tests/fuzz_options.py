"""Random values of options, arguments and variables of every command, for `tests/fuzzing.py`.

Options and their types come from the commands themselves, so that a new option is tried without a line here.
"""

from __future__ import annotations

import random
import shlex
from collections.abc import Iterator

import click
from fuzz_damage import _damage_text, apply_edits

from wavebatch.batch.options import EXCLUSIVE
from wavebatch.cli import COMMANDS, main
from wavebatch.cli.options import OutputPath

SOUND = {
    "run": "run {base}/strip.las -o {out} --profile fast", "info": "info {base}/strip.las",
    "check": "check {base}/strip.las {base}/chain.toml", "survey": "survey {base}/strip.las -o {out}/a.toml",
    "stages": "stages", "simulate": "simulate flat -o {out}/a.laz --pulses 50",
    "compare": "compare {base}/cloud.laz {base}/strip.las", "stats": "stats {base}/cloud.laz",
    "synthesize": "synthesize {base}/cloud.laz -o {out}/a.las", "slice": "slice {base}/strip.las -o {out}/a.csv",
    "voxelize": "voxelize {base}/strip.las -o {out}/a.npz --size 1",
    "grid": "grid {base}/cloud.laz --column z -o {out}/a.tif",
    "calibrate": "calibrate {base}/strip.las --targets {base}/targets.csv -o {out}/a.toml --flight-height 500",
    "bench": "bench --scene flat --waveforms 100 --pulses 0 --repeat 1 -o {out}",
    "import": "import {base}/strip.pls -o {out}/a.las", "export": "export {base}/strip.las -o {out}/a.las",
    "plot waveform": "plot waveform {base}/strip.las -o {out}/a.csv --echoes --profile fast",
    "plot histogram": "plot histogram {base}/cloud.laz --column amplitude -o {out}/a.svg",
    "plot map": "plot map {base}/cloud.laz --column amplitude -o {out}/a.png",
    "plot section": "plot section {base}/cloud.laz -o {out}/a.png",
    "plot profile": "plot profile {base}/voxels.npz -o {out}/a.png",
    "plot cube": "plot cube {base}/cube.npz -o {out}/a.png",
}  # fmt: skip
"""A call of every command that gives 0."""

WEIGHTS = {"plot": 0.2, "bench": 0.05, "voxelize": 0.5, "calibrate": 0.5, "stages": 0.2}

_INTEGERS = ["0", "-1", "1", "2", "3", "7", "64", "255", "256", "65535", "65536", "2147483648", "9223372036854775808",
             "1" + "0" * 400, "1.5", "nan", "", " ", "1e3", "0x10", "٣", "1_000", "+5", "--", "one"]  # fmt: skip
_FEW = ["0", "-1", "1", "2", "60", "", "nan", "1e3", "one", "1.5"]
_FLOATS = ["0", "-0.0", "-1", "1", "0.5", "2", "1e-9", "1e-300", "1e9", "1e300", "-1e300", "nan", "inf", "-inf",
           "1e400",
           "", " ", "1,5", "x", "1e", "0x1p3", "100", "1000", "٣", "1_0", "9" * 400]  # fmt: skip
_TEXTS = {
    "where": 'number_of_returns == 2 and not (classification == 7 or echo_width >= 8.5) or "amplitude" < -1e3',
    "bbox": "300000,5000000,300100,5000100", "columns": "+range,+amplitude", "column": "amplitude", "classes": "2,6-9",
    "drop_flags": "RINGING_SUSPECT,WEAK", "flags": "SATURATED,WEAK", "lever_arm": "0.1,-0.2,0.5", "crs": "EPSG:32632",
    "lines": "0:3", "packets": "0:3", "shown": "0:20", "limits": "0:100", "memory": "2G", "tolerance": "0.02m",
    "profile": "accurate", "line": "300000,5000000,300100,5000100", "energy": "intensity", "by": "number_of_returns",
    "fail_on": "pulse-guess,lost-packets", "show": "detector", "scenes": "forest", "widths": "echo_width",
    "shares": "equal",
}  # fmt: skip
_PLACES = [
    "{out}", "{out}/x", "{out}/x.las", "{out}/x.laz", "{out}/x.csv", "{out}/x.npz", "{out}/x.toml", "{out}/x.tif",
    "{out}/x.html", "{out}/x.json", "{out}/x.svg", "{out}/none/x.laz", "{folder}/loop", "{folder}/loop/x.laz",
    "{folder}/dangling", "{folder}/pipe", "{folder}/full", "{folder}/null", "{folder}/zero", "", ".", "-", "~",
    "x" * 300 + ".laz", "a/" * 3000, "{out}/\udcff.laz", "{out}/\x1b[31m\n.laz", "{out}/größe 点.laz",
    "@{base}/list.txt", "@{folder}/pipe", "@{folder}/zero", "@", "*", "{out}/*.las", "[", "{base}/*.toml",
    "/proc/self/cmdline",
    "{folder}/zero.las", "{folder}/pipe.las", "{folder}/folder.las", "/dev/stdin", "{base}/none.las",
]  # fmt: skip
_READ = ["{base}", "{base}/strip.las", "{base}/cloud.laz", "{base}/truth.npz", "{base}/cal.toml", "{base}/system.toml",
         "{base}/chain.toml", "{base}/targets.csv", "{base}/trajectory.txt", "{base}/beside.wdp", "{base}/cube.npz",
         "{base}/voxels.npz", "{base}/polygons.geojson", "{base}/strip.pls"]  # fmt: skip

_WRITTEN = [place for place in _PLACES if "{base}" not in place]
"""Outputs may replace other files, but not the sound inputs of all cases."""

_NEVER = ("debug", "scheduler", "all_methods")
"""Print tracebacks, wait for a network, or take minutes by design."""

_MANY = ("pulses", "waveforms", "repeats", "iterations", "n_samples")
"""A large number makes more work, as it should."""


def list_commands() -> Iterator[tuple[str, click.Command]]:
    """Yield every command with its full name."""
    for name in COMMANDS:
        command = main.get_command(None, name)
        if isinstance(command, click.Group):
            for inner, one in command.commands.items():
                yield f"{name} {inner}", one
        else:
            yield name, command


class Options:
    """Draws command lines."""

    def __init__(self) -> None:
        self._commands = dict(list_commands())
        assert set(self._commands) == set(SOUND), "a new command needs a line in SOUND"
        names = {one.name for command in self._commands.values() for one in command.params}
        assert not {*_TEXTS, *_NEVER, *_MANY} - names, "no option has this name"
        self._weights = [WEIGHTS.get(name.split()[0], 1.0) for name in self._commands]

    def draw(self, rng: random.Random) -> tuple[str, dict[str, str]]:
        """Return a command line and variables."""
        name = rng.choices(list(self._commands), self._weights)[0]
        words, variables = shlex.split(SOUND[name]), {}
        options = [
            one for one in self._commands[name].params if isinstance(one, click.Option) and one.name not in _NEVER
        ]
        if rng.random() < 0.15 and len(words) > len(name.split()):
            place = rng.randrange(len(name.split()), len(words))
            words[place] = rng.choice(_WRITTEN if words[place - 1] == "-o" else [*_PLACES, *_READ])
        for option in rng.sample(options, min(rng.choice([1, 1, 2, 3, 5]), len(options))):
            words = self._drop_rivals(words, name, option)
            value = (draw_value(option, rng) or "").replace("\0", "") if not option.is_flag else None
            if value is not None and rng.random() < 0.12:
                words_of = max(option.opts, key=len).removeprefix("--").upper().replace("-", "_")
                prefix = rng.choice(["", name.upper().replace(" ", "_") + "_"])
                variables[f"WAVEBATCH_{prefix}{words_of}"] = value
            else:
                words.append(rng.choice([*option.opts, *option.secondary_opts]))
                words += [] if value is None else [value]
        if name == "import" and not {"-o", "--output"} & set(words):  # it would write beside the sound inputs
            words += ["-o", "{out}/a.las"]
        return shlex.join(words), variables


    def _drop_rivals(self, words: list[str], name: str, option: click.Option) -> list[str]:
        """The words without options that this one excludes: else it would always be refused."""
        for one in self._commands[name].params:
            if one is not option and any({one.name, option.name} <= set(rivals) for rivals in EXCLUSIVE):
                for place in reversed([place for place, word in enumerate(words) if word in one.opts]):
                    words = words[:place] + words[place + (1 if one.is_flag else 2) :]
        return words


def draw_value(option: click.Option, rng: random.Random) -> str | None:
    """Return a value for an option, None for a flag."""
    kind, name = option.type, option.name or ""
    if option.is_flag:
        return None
    if rng.random() < 0.03:
        return rng.choice(
            ["x" * 100_000, "(" * 10_000, "\x1b[31m", "\udcff", "a\nb", "'", '"', "%s", "{0}", "../" * 20]
        )
    if isinstance(kind, click.Choice):
        return rng.choice([*map(str, kind.choices), *map(str, kind.choices), "x", "", str(kind.choices[0]).upper()])
    if name == "jobs":  # processes take seconds to start, and time in them is not seen
        return rng.choice(["-1", "1", "2", "", "nan", "1.5", "one"])
    if name in _MANY:
        return rng.choice(_FEW)
    if isinstance(kind, OutputPath):
        return rng.choice(_WRITTEN)
    if isinstance(kind, click.Path):
        return rng.choice([*_PLACES, *_READ, *_READ])
    if name in _TEXTS:
        text = _TEXTS[name].encode()
        for _ in range(rng.choice([0, 1, 1, 2, 4])):
            text = apply_edits(text, [_damage_text(text, [], rng)])
        return text[:100_000].decode(errors="surrogateescape")  # the system takes 128 kB
    if isinstance(kind, click.types.IntParamType):
        return rng.choice(_INTEGERS)
    if isinstance(kind, click.types.FloatParamType):
        return rng.choice(_FLOATS)
    return rng.choice([*_FLOATS, *_INTEGERS, *_PLACES, "a,b", "1:2", "x=1", "amplitude"])
