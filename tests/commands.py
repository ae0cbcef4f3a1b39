"""Commands of the command line, run in the process of the tests; commands and calls that must be refused."""

import re
from collections.abc import Callable
from typing import Any

import pytest
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


def fail(code: int, words: str, *command: object, **options: Any) -> Result:
    """Run `wavebatch` as `run_command` does; it must end with this exit code and say these words on stderr."""
    done = run_command(*command, **options)
    assert done.exit_code == code and words in done.stderr, done.output
    return done


def refuses(kind: type[Exception], words: str, function: Callable, *arguments: Any, **options: Any) -> None:
    """The call must raise an error of this kind, in one line in which the regular expression is found."""
    with pytest.raises(kind) as caught:
        function(*arguments, **options)
    said = str(caught.value)
    assert re.search(words, said) and "\n" not in said, said
