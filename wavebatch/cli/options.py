"""Options that several commands have: each is declared here once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what exists.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Say nothing unless something fails.")
headerless_option = click.option("--headerless", is_flag=True, help="Take a .wdp that lacks its 60-byte header.")
direction_option = click.option(
    "--direction",
    type=click.Choice(["auto", "toward", "away"]),
    default="auto",
    show_default=True,
    help="Where packet vectors point: decided from the file, or toward or away from the sensor.",
)
system_option = click.option(
    "--system",
    "system_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A saved survey (of `wavebatch survey -o`) in place of one of the strip.",
)


def json_option(text: str = "Print JSON.") -> Callable:
    """`--json`, the parameter `as_json`; text: what is printed."""
    return click.option("--json", "as_json", is_flag=True, help=text)
