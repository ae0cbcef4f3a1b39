"""Everything that is measured for a release: `make bench` runs it, and names its options.

    PYTHONPATH=tests python -m bench.release -o DIR [--scene NAME...] [--large]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.cases import Case, list_cases
from bench.peers import measure_peers
from bench.promises import format_promises, judge
from bench.stability import FAILURES, measure_stability
from bench.stability_tables import format_stability
from bench.system import measure_system

from wavebatch.surveying.choose_chain import choose_chain
from wavebatch.tools.api import AUTO
from wavebatch.tools.bench import command
from wavebatch.tools.sheets.sheet import list_lines

SCENES = ("mixed", "open", "forest", "empty")

STABILITY_WAVEFORMS, STABILITY_SURVEY = 900, 3072
"""Waveforms per stiff case, and per survey: every receiver is surveyed several times."""


def measure_release(
    options: command.BenchOptions, cases: Sequence[Case], large: bool, progress: command.BenchProgress
) -> dict[str, Any]:
    """The document of `run_bench` with rows of other decomposers, `stability`, `system` and `promises`."""
    document = command.run_bench(options, progress, lambda scene, groups: measure_peers(scene, groups, progress))
    document["failure_kinds"] = FAILURES
    document["stability"] = measure_cases(options, cases, progress)
    pulses = 2 * max(options.pulses, 1000)
    document["system"] = measure_system(options.seed, pulses=pulses, large=large, progress=progress)
    document["promises"] = judge(document)
    return document


def measure_cases(
    options: command.BenchOptions, cases: Sequence[Case], progress: command.BenchProgress,
    waveforms: int = STABILITY_WAVEFORMS,
) -> list[dict[str, Any]]:
    """The stiff cases by all chains of the options."""
    methods = command.list_methods() if options.all_methods else {}
    measured = command.load_chains(options.chains) | methods
    return measure_stability(
        lambda survey: {**measured, AUTO: choose_chain(survey)},
        waveforms,
        min(STABILITY_SURVEY, options.waveforms),
        options.seed,
        cases=cases,
        methods=methods,
        progress=progress,
    )


def format_release(document: dict[str, Any]) -> str:
    """All tables."""
    tables = ["\n".join(list_lines(command.bench_sheet(document)))]
    tables += [format_stability(document["stability"]), format_promises(document["promises"])]
    return "\n\n".join(tables)


def read_options(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for bench.json, bench.txt and plots")
    parser.add_argument("--scene", action="append", help=f"default: {', '.join(SCENES)}; may be repeated")
    parser.add_argument("--hazard", action="append", default=[], help="only the stiff cases of this hazard, e.g. H5")
    parser.add_argument("--waveforms", type=int, default=65_536, help="per scene")
    parser.add_argument("--pulses", type=int, default=50_000, help="of the strips that are timed from file to file")
    parser.add_argument("--repeat", type=int, default=3, help="repetitions of the timing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--all-methods", action="store_true", help="every detector and every decomposer too")
    parser.add_argument("--large", action="store_true", help="measure memory with 10^7 pulses too")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> None:
    """Measures, prints the tables and writes the files."""
    given = read_options(words)
    options = command.BenchOptions(
        scenes=tuple(given.scene or SCENES),
        all_methods=given.all_methods,
        seed=given.seed,
        waveforms=given.waveforms,
        repeats=given.repeat,
        pulses=given.pulses,
    )
    progress = (lambda text: print(text, file=sys.stderr)) if sys.stderr.isatty() else (lambda text: None)
    document = measure_release(options, list_cases(given.hazard), given.large, progress)
    text = format_release(document)
    print(text)
    for line in command.write_outputs(document, text, given.output):
        print(line, file=sys.stderr)


if __name__ == "__main__":
    main()
