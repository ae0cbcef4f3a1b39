"""Commands of the command line, run in the process of the tests."""

from typing import Any

from click.testing import CliRunner, Result

from wavebatch.cli import main


def run_command(*words: object, **options: Any) -> Result:
    """Run `wavebatch` with these words; options: of click's `invoke`."""
    return CliRunner().invoke(main, list(map(str, words)), **options)


def succeed(*words: object, **options: Any) -> Result:
    """Run `wavebatch` as `run_command` does; it must end with exit code 0."""
    done = run_command(*words, **options)
    assert done.exit_code == 0, done.output
    return done
