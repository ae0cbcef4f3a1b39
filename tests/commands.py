"""Commands of the command line, run in the process of the tests."""

from typing import Any

from click.testing import CliRunner, Result

from wavebatch.cli import main


def run_command(*words: object, **options: Any) -> Result:
    """Run `wavebatch` with these words; options: of click's `invoke`."""
    return CliRunner().invoke(main, list(map(str, words)), **options)
