"""`python -m wavebatch`, and the program `wavebatch`.

Before you change it: it must import almost nothing before `guard`, so that Ctrl-C during the imports ends as usual.
"""

from wavebatch.core.interrupts import guard


def main() -> None:
    """Run the command line."""
    guard(_run)


def _run() -> None:
    import os

    from wavebatch.core.memory import ONE_THREAD

    for name in ONE_THREAD:  # before NumPy is imported; what the user has set stays
        os.environ.setdefault(name, "1")
    from wavebatch.cli import main

    main.main()


if __name__ == "__main__":
    main()
