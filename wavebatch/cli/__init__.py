"""The command line: one module per command; it reads options, calls the library once and prints.

`wavebatch.__main__` calls `main`. Modules of commands are imported only when their command is used, so that
`wavebatch --help` stays fast: a new command needs an entry in COMMANDS, no import here.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import NearestGroup
from wavebatch.core.interrupts import guard
from wavebatch.core.process import importing

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("wavebatch.cli.run:run", "Decompose strips into enriched point clouds: the main job."),
    "info": ("wavebatch.cli.inspect:info", "Show points, packets, descriptors and samples of a strip."),
    "check": ("wavebatch.cli.inspect:check", "Check strips and chain files; one line per problem."),
    "survey": ("wavebatch.cli.survey:survey", "Measure noise, pulse and scene of a strip; choose its chain."),
    "import": ("wavebatch.cli.strips:import_", "Make strips of PulseWaves files."),
    "export": ("wavebatch.cli.strips:export", "Write strips for other programs: repaired LAS, or arrays."),
    "stages": ("wavebatch.cli.inspect:stages", "List the algorithms, or explain one with its parameters."),
    "simulate": ("wavebatch.cli.strips:simulate", "Simulate a strip with known echoes."),
    "compare": ("wavebatch.cli.compare:compare", "Compare clouds or chains with each other, returns or truth."),
    "stats": ("wavebatch.cli.clouds:stats", "Count return numbers, separations and flags of clouds."),
    "synthesize": ("wavebatch.cli.strips:synthesize", "Model waveforms from the discrete returns of a cloud."),
    "slice": ("wavebatch.cli.geometry:slice_", "Find straight surface lines in the scan lines of a strip."),
    "voxelize": ("wavebatch.cli.geometry:voxelize", "Deconvolve waveforms into the voxels of a 3D grid."),
    "plot": ("wavebatch.cli.plot:plot", "Draw waveforms with their fit, histograms and maps."),
    "grid": ("wavebatch.cli.clouds:grid", "Write columns of clouds as a GeoTIFF."),
    "calibrate": ("wavebatch.cli.calibrate:calibrate", "Find the calibration constant from known reflectances."),
    "bench": ("wavebatch.cli.bench:bench", "Measure error and run time of chains on simulated truth."),
}
"""Per command: its `module:function`, and its line in the list of commands."""


class LazyGroup(NearestGroup):
    """A group that takes its commands from COMMANDS and imports only the one that is called."""

    def __call__(self, *args: Any, **options: Any) -> None:
        """Runs the program; tests call `main` instead, which leaves the signals alone."""
        guard(lambda: self.main(*args, **options))

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of COMMANDS."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Imports the command; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        module, _, function = COMMANDS[cmd_name][0].partition(":")
        from wavebatch.cli.command import dress

        with importing():
            home = importlib.import_module(module)
        return dress(getattr(home, function), cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


def _print_version(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        import platform
        from importlib import metadata

        from wavebatch import __version__
        from wavebatch.cli.command import LIBRARIES

        lines = [f"wavebatch {__version__}", f"Python {platform.python_version()}"]
        for name in LIBRARIES:  # none of them is imported for it
            try:
                lines.append(f"{name} {metadata.version(name)}")
            except metadata.PackageNotFoundError:
                lines.append(f"{name} is not installed")
        click.echo("\n".join(lines))
        context.exit()


def _write_man_pages(context: click.Context, parameter: click.Parameter, folder: Path | None) -> None:
    if folder is not None and not context.resilient_parsing:
        from wavebatch.cli.command import write_man_pages
        from wavebatch.cli.messages import report_errors, talk

        pages = report_errors(write_man_pages)(main, folder)
        talk(f"{folder}: {len(pages)} manual pages written")
        context.exit()


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version,
              help="Print the versions of wavebatch, Python and the libraries.")
@click.option("--man-pages", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", is_eager=True,
              expose_value=False, callback=_write_man_pages, help="Write the manual pages into DIR.")
def main() -> None:
    """Decompose full-waveform lidar strips: LAS/LAZ wave packets in, enriched point clouds out.

    `wavebatch COMMAND --help` explains a command, with examples.

    Defaults of options can be given by variables (WAVEBATCH_JOBS=4, or for one command WAVEBATCH_RUN_JOBS=4) and in
    a settings file (a table per command: [run] with jobs = 4): only in that of --config FILE or WAVEBATCH_CONFIG, if
    given; else in wavebatch.toml beside the inputs, which can change numbers only, and in that in the folder for
    settings of the user. Options on the command line count first, then variables, then files in this order.
    """  # fmt: skip
