"""`python -m wavebatch`, and the program `wavebatch`.

Before you change it: it must import almost nothing before `guard`, so that Ctrl-C during the imports ends as usual.
"""

from wavebatch.core.interrupts import guard


def main() -> None:
    """Run the command line."""
    guard(_run)


def _run() -> None:
    import os
    import sys

    # The null device where stdin, stdout or stderr are closed, as daemons and `2>&-` do. Else the first file that is
    # opened would get their number, and the messages of a library would go into it. As stdout it can only be read, so
    # that a result for which there is no place is an error, as on a full disk.
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDONLY if number == 1 else os.O_RDWR)  # the lowest number that is free: this one
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            setattr(sys, name, open(number, mode, errors="backslashreplace", closefd=False))  # noqa: SIM115
    from wavebatch.core.process import ONE_THREAD, importing, keep_freed_memory

    keep_freed_memory()  # a survey makes and frees 150 MB of arrays
    for name in ONE_THREAD:  # before NumPy is imported; what the user has set stays
        os.environ.setdefault(name, "1")
    with importing():
        from wavebatch.cli import main

    main.main()


if __name__ == "__main__":
    main()
