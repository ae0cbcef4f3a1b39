"""The command line: parse, one library call, print. A command's module is imported when the command is used."""

from __future__ import annotations

import importlib

import click

from wavebatch import __version__
from wavebatch.cli.messages import NearestGroup

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("wavebatch.cli.run:run", "Strips in, enriched point clouds out: the main job."),
    "info": ("wavebatch.cli.inspect:info", "What a strip holds: points, packets, descriptors, samples."),
    "check": ("wavebatch.cli.inspect:check", "Problems of strips and chain files, one line each."),
    "survey": ("wavebatch.cli.survey:survey", "What sensor and scene of a strip are, and the chain they need."),
    "stages": ("wavebatch.cli.stages:stages", "The algorithms: all of them, or one with its parameters."),
    "simulate": ("wavebatch.cli.simulate:simulate", "A strip with known echoes."),
    "compare": ("wavebatch.cli.compare:compare", "Two results or chains on one strip, or a result with the truth."),
    "stats": ("wavebatch.cli.stats:stats", "Return numbers, separations and flags of point clouds."),
    "synthesize": ("wavebatch.cli.simulate:synthesize", "Waveforms modelled from discrete returns."),
    "slice": ("wavebatch.cli.slice:slice_", "Straight surface lines in the scan lines of a strip."),
    "voxelize": ("wavebatch.cli.voxelize:voxelize", "What came back from every voxel of a 3D grid."),
    "plot": ("wavebatch.cli.plot:plot", "Pictures of waveforms with their fit, histograms and maps."),
    "calibrate": ("wavebatch.cli.calibrate:calibrate", "The calibration constant, from targets of known reflectance."),
    "bench": ("wavebatch.cli.bench:bench", "Error against run time of chains on simulated truth."),
}
"""Per command: where it is, `module:function`, and the line that the list of commands shows for it."""


class LazyGroup(NearestGroup):
    """A group that lists its commands from COMMANDS and imports only the one that is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of COMMANDS."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command, imported now; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        module, _, function = COMMANDS[cmd_name][0].partition(":")
        return getattr(importlib.import_module(module), function)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands, without importing any of them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="wavebatch", message="%(prog)s %(version)s")
def main() -> None:
    """Decomposes full-waveform lidar strips: LAS/LAZ wave packets in, enriched point clouds out.

    `wavebatch COMMAND --help` explains a command.
    """
