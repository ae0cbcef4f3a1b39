"""One picture of many waveforms of a strip, with fit, residual and echoes, to look at what a judge calls wrong.

`python tests/judging/sheets.py STRIP.las -o sheet.png --root CHECKOUT`; with the truth where STRIP.npz has it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from checkouts import find_function, run_in

COLUMNS = 4


def draw_sheet(path: Path, output: Path, number: int, packets: Sequence[int]) -> None:
    """Waveforms spread over a strip, or those of some packets (rows of their points), as a PNG file."""
    import matplotlib

    import wavebatch as wb

    matplotlib.use("Agg")
    from matplotlib import pyplot

    truth = dict(np.load(path.with_suffix(".npz"))) if path.with_suffix(".npz").exists() else None
    subtract, drawn = find_function("subtract_echoes"), []
    with wb.open_strip(path) as strip:
        survey = wb.survey(strip)
        chain = wb.auto_chain(survey)
        for block in strip.blocks():
            echoes = chain.run(block, survey.system)
            rest = subtract(block, survey.system.of(block), echoes)
            lit = np.unique(echoes.waveform)
            rows = np.flatnonzero(np.isin(block.point, packets)) if len(packets) else lit
            drawn += [(block, row, rest[row], echoes, echoes.waveform == row) for row in rows]
    drawn = [drawn[i] for i in np.unique(np.linspace(0, len(drawn) - 1, min(number, len(drawn))).astype(int))]
    lines = -(-len(drawn) // COLUMNS)
    figure, axes = pyplot.subplots(lines, COLUMNS, figsize=(5 * COLUMNS, 2.6 * lines), squeeze=False)
    for axis, (block, row, rest, echoes, own) in zip(axes.flat, drawn, strict=False):
        samples, point = block.samples[row].astype(float), int(block.point[row])
        x = np.arange(len(samples)) * block.spacing
        axis.plot(x, samples, "k.", ms=3)
        axis.plot(x, samples - rest, "C0", lw=1)
        axis.plot(x, rest + samples.min() - 0.15 * np.ptp(samples), "C3", lw=0.7)
        for time, amplitude in zip(echoes.time[own], echoes.amplitude[own], strict=True):
            axis.plot([time, time], [samples.min(), samples.min() + amplitude], "C0", lw=0.8)
        if truth is not None:
            here = truth["packet"] == point
            axis.plot(truth["time"][here] * block.spacing, samples.min() + truth["amplitude"][here], "C2v", ms=5)
        axis.set_title(f"packet {point}: {own.sum()} echoes", fontsize=8)
        axis.tick_params(labelsize=6)
    for axis in axes.flat[len(drawn) :]:
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(output, dpi=70)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("strip", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[2], help="checkout that decomposes")
    parser.add_argument("--number", type=int, default=24, help="of waveforms")
    parser.add_argument("--packets", default="", help="as 3,17: these, by the rows of their first points")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.child:
        chosen = [int(one) for one in given.packets.split(",") if one]
        draw_sheet(given.strip, given.output, given.number, chosen)
        return 0
    options = ["-o", str(given.output), "--number", str(given.number), "--packets", given.packets]
    list(run_in(given.root.resolve(), Path(__file__), [str(given.strip), *options]))
    return 0 if given.output.exists() else 1


if __name__ == "__main__":
    sys.exit(main())
