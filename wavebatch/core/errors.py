"""The three errors of wavebatch; each is also the builtin error that a caller would expect.

All rooms raise them; the command line prints them as one line. Any other exception is a bug.
"""


class ConfigError(ValueError):
    """A chain file, option or parameter is wrong; nothing has been started."""


class InputError(OSError):
    """A file cannot be read as what it claims to be, or an output cannot be written."""


class StageError(RuntimeError):
    """A stage broke its contract while a block ran through it: a bug, which is never hidden."""
