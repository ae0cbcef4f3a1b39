"""Injects echoes into real strips and counts those that are found: `make bench-real STRIP=...`.

    PYTHONPATH=tests python -m bench.real STRIP... -o DIR [--seed N]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.real.measure import measure_real
from bench.real.report import format_report, write_report

from wavebatch.core.errors import InputError


def main(words: Sequence[str] | None = None) -> int:
    """Measure strip after strip; one that cannot be measured is a line on stderr, and the others go on."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("strips", type=Path, nargs="+", metavar="STRIP")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for real-STRIP.json, .txt and .png")
    parser.add_argument("--seed", type=int, default=0, help="of the injections")
    given = parser.parse_args(words)
    progress = (lambda text: print(text, file=sys.stderr)) if sys.stderr.isatty() else (lambda text: None)
    failed = 0
    for path in given.strips:
        try:
            for report in measure_real(path, seed=given.seed, say=progress):
                print(format_report(report) + "\n")
                print(write_report(report, given.output), file=sys.stderr)
        except InputError as error:
            failed = 1
            print(f"error: {error}", file=sys.stderr)
    return failed


if __name__ == "__main__":
    sys.exit(main())
