"""One HTML page of the five papers: our figures beside the papers' numbers, and pictures made by commands.

`make papers` calls it. It runs the scripts of this folder, which print their tables, then draws pictures of a simulated
forest and of a roof with `wavebatch`, and writes one file that needs no network. The papers' own pictures are not in
it. The exit code is 1 where a script or a command fails; the page then says which.
"""

from __future__ import annotations

import argparse
import base64
import html
import importlib.util
import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from table import HEADS

FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Picture:
    """A picture that a command makes."""

    caption: str
    command: str
    """Words after `wavebatch`; the file to write is added with `-o`."""
    option: str = "-o"
    """Option that takes the file."""


@dataclass(frozen=True)
class Paper:
    """A paper: its script, and pictures of what its figures are about."""

    script: str
    title: str
    figures: str
    """Numbers of the paper's figures that the pictures stand for."""
    pictures: tuple[Picture, ...]


_WAVES = "--profile balanced --echoes"

PAPERS = (
    Paper("s0_wagner", "Wagner, Roncat, Melzer, Ullrich (2007)", "1, 3, 5", (
        Picture("A waveform with its echoes: samples, fitted Gaussians and residual.",
                f"plot waveform forest.laz --packet 19 {_WAVES} --show detector"),
        Picture("The square difference to a reference pulse of the waveform's height (ASDF), with the paper's rule of "
                "30 %: the bars are the depth that a minimum needs.",
                "plot waveform forest.laz --packet 19 --show asdf --chain asdf.toml"),
        Picture("Echoes of the forest from the side.", "plot section out/forest.laz --column amplitude --aspect 3"),
    )),
    Paper("s1_wang", "Wang, Wang, Tseng", "1b, 5", (
        Picture("A skewed pulse (kappa 0.23) and its fit: the model follows the falling edge.",
                "plot waveform leica.laz --packet 40:42 --times all --echoes"),
        Picture("Coefficients of the B3-spline wavelet, in which echoes are searched, with the threshold.",
                "plot waveform forest.laz --packet 17:21 --profile balanced --show wavelet"),
    )),
    Paper("s2_jutzi", "Jutzi, Stilla", "6, 8", (
        Picture("The waveform deconvolved with the system pulse: the signal of the surfaces along the ray.",
                "plot waveform forest.laz --packet 17:21 --profile balanced --show deconvolved"),
        Picture("Slices of the data cube of an urban scene: x, y and t.", "plot cube cube.npz"),
        Picture("Straight segments of surfaces in all its scan lines, in plan and in 3D.",
                "slice urban.laz --lines 0:40", "--overview"),
    )),
    Paper("s3_rhomberg_kauert", "Rhomberg-Kauert et al. (2024)", "3, 4, 5, 6", (
        Picture("Echo widths in plan.", "plot map out/urban.laz --column echo_width --statistic median --size 2"),
        Picture("Echo widths from the side.", "plot section out/urban.laz --column echo_width --width 4"),
        Picture("Echo widths by the number of returns of their pulse, with means.",
                "plot histogram out/urban.laz out/forest.laz --column echo_width --each"),
    )),
    Paper("s4_ussyshkin", "Ussyshkin, Theriault (2010)", "1, 2, 4, 6, 7", (
        Picture("Amplitudes by the number of returns of the pulse.",
                "plot histogram out/forest.laz --column amplitude --by number_of_returns"),
        Picture("Amplitudes by return number.", "plot histogram out/forest.laz --column amplitude --by return_number"),
        Picture("Returns of the vendor and of the waveforms per height.",
                "plot profile forest.laz out/forest.laz --each --size 1"),
        Picture("Density of the returns of the urban strip.", "plot map out/urban.laz --statistic density --size 2"),
    )),
)  # fmt: skip
"""Every paper with its pictures. The chains and strips that the commands name are made by `prepare`."""

_ASDF = """[[chain]]
stage = "noise.pooled"
[[chain]]
stage = "detect.asdf"
rule = "paper"
[[chain]]
stage = "decompose.gaussian"
[[chain]]
stage = "attribute.amplitude"
[[chain]]
stage = "attribute.position"
"""


def run_command(words: Sequence[str], folder: Path) -> str:
    """Runs `wavebatch`; the error, or an empty text."""
    done = subprocess.run([sys.executable, "-m", "wavebatch", *words], cwd=folder, capture_output=True, text=True)
    return "" if done.returncode == 0 else (done.stderr.strip() or f"exit code {done.returncode}")


def prepare(folder: Path, pulses: int, seed: int) -> list[str]:
    """Simulates the strips of the pictures and makes their clouds; the errors."""
    (folder / "asdf.toml").write_text(_ASDF)
    more = ["--pulses", str(pulses), "--seed", str(seed)]
    # Scan lines have some 2,500 pulses: the maps and the cube need many lines.
    many = ["--pulses", str(12 * pulses), "--seed", str(seed)]
    commands = [
        ["simulate", "forest", "-o", "forest.laz", *more], ["simulate", "urban", "-o", "urban.laz", *many],
        ["simulate", "forest", "-o", "leica.laz", "--pulse", "leica", *more],
        ["run", "forest.laz", "urban.laz", "-o", "out", "--profile", "balanced", "-q"],
        ["slice", "urban.laz", "--lines", "0:40", "--cube", "cube.npz", "-q"],
    ]  # fmt: skip
    return [f"wavebatch {' '.join(words)}: {error}" for words in commands if (error := run_command(words, folder))]


def draw(pictures: Sequence[Picture], folder: Path) -> Iterator[tuple[Picture, bytes | None, str]]:
    """Draws pictures; each with its bytes, or with the error."""
    for number, picture in enumerate(pictures):
        target = folder / f"p{number}.png"
        error = run_command([*shlex.split(picture.command), picture.option, target.name, "--overwrite"], folder)
        yield picture, None if error else target.read_bytes(), error


def measure(script: str, number: int | None, seed: int, folder: Path) -> tuple[list[dict], bool]:
    """Runs a script, which prints its tables; the tables, and whether all figures are accepted."""
    target = folder / f"{script}.json"
    words = [sys.executable, f"{FOLDER / script}.py", "--seed", str(seed), "--json", str(target)]
    code = subprocess.run([*words, *(["--number", str(number)] if number else [])], check=False).returncode
    return (json.loads(target.read_text("utf-8")) if target.exists() else []), code == 0


def format_table(table: dict) -> str:
    """A table as HTML; text of a script as it is."""
    if "text" in table:
        return f"<pre>{html.escape(table['text'])}</pre>"
    head = "".join(f"<th>{html.escape(name)}</th>" for name in [table["title"], *HEADS[1:]])
    rows = []
    for row in table["rows"]:
        kind = ' class="fail"' if row[-1] == "FAIL" else ""
        rows.append(f"<tr{kind}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def format_picture(picture: Picture, image: bytes | None, error: str) -> str:
    """A picture with its caption and its command."""
    command = html.escape(f"wavebatch {picture.command} {picture.option} picture.png")
    text = f"<figcaption>{html.escape(picture.caption)}<br><code>{command}</code></figcaption>"
    if image is None:
        return f'<figure><p class="fail">not drawn: {html.escape(error)}</p>{text}</figure>'
    data = base64.b64encode(image).decode()
    return f'<figure><img alt="{html.escape(picture.caption)}" src="data:image/png;base64,{data}">{text}</figure>'


STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .7rem; border-bottom: 1px solid #8885; text-align: right; }
th:first-child, td:first-child { text-align: left; }
.fail { color: #c33; font-weight: bold; }
figure { margin: 1.5rem 0; } img { max-width: 100%; background: #fff; border-radius: 4px; }
figcaption { font-size: .9em; } code { font-size: .85em; overflow-wrap: anywhere; }
@media print { figure { break-inside: avoid; } }
"""


def build(number: int | None, pulses: int, seed: int) -> tuple[str, bool]:
    """The page, and whether all went well."""
    drawing = importlib.util.find_spec("matplotlib") is not None
    parts, fine = [], True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        errors = prepare(folder, pulses, seed) if drawing else []
        for paper in PAPERS:
            print(f"== {paper.script}", flush=True)
            tables, accepted = measure(paper.script, number, seed, folder)
            drawn = list(draw(paper.pictures, folder)) if drawing else []
            fine &= accepted and bool(tables) and not any(error for _, _, error in drawn)
            parts.append(f"<h2>{html.escape(paper.title)}</h2>")
            parts += map(format_table, tables)
            if drawn:
                parts.append(f"<p>In place of the paper's figures {paper.figures}, on simulated strips:</p>")
            parts += [format_picture(*one) for one in drawn]
    notes = [f'<p class="fail">{html.escape(error)}</p>' for error in errors]
    if not drawing:
        notes.append("<p>No pictures: matplotlib is not installed (pip install matplotlib).</p>")
    intro = (
        "<p>Every figure with the paper's value, that of a simulation by other code from the same description (spec), "
        f"ours, and the band that is accepted. Seed {seed}. The papers' data and pictures are not used.</p>"
    )
    head = f'<meta charset="utf-8"><title>The papers, reproduced</title><style>{STYLE}</style>'
    body = "\n".join(["<h1>The papers, reproduced</h1>", intro, *notes, *parts])
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>\n', fine and not errors


def main() -> int:
    """Reads the options and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("papers.html"), help="page to write")
    parser.add_argument("--seed", type=int, default=0, help="of all simulations (default 0)")
    parser.add_argument("--number", type=int, help="waveforms per script (default: each script's)")
    parser.add_argument("--pulses", type=int, default=5000, help="pulses of the strips in the pictures (default 5000)")
    options = parser.parse_args()
    page, fine = build(options.number, options.pulses, options.seed)
    options.output.write_text(page, "utf-8")
    print(f"{options.output}: written" + ("" if fine else "; it names what failed"))
    return 0 if fine else 1


if __name__ == "__main__":
    raise SystemExit(main())
