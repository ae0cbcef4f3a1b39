"""One HTML page of the five papers: our figures beside the papers' numbers, and pictures made by commands.

`make papers` calls it. It runs the scripts of this folder, which print their tables, then draws pictures of a simulated
forest and of a roof with `wavebatch`, and writes one file that needs no network. The papers' own pictures are not in
it. The exit code is 1 where a script or a command fails; the page then says which.
"""

from __future__ import annotations

import argparse
import base64
import importlib.util
import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from table import HEADS

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.tools.sheets.page import check_page, render, section, text, write_page
from wavebatch.tools.sheets.sheet import Cell, Code, Note, SheetPart, Table

FOLDER = Path(__file__).resolve().parent


LONG = 8
"""Tables with more rows are folded."""


@dataclass(frozen=True)
class Picture:
    """A picture that a command makes, or a function of `figures`."""

    caption: str
    command: str
    """Words after `wavebatch`, the file to write is added with `-o`; or the name of the function."""
    option: str = "-o"
    """Option that takes the file; empty for functions."""


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
    Paper("s0_wagner", "Wagner, Roncat, Melzer, Ullrich (2007)", "1, 2, 3, 5", (
        Picture("Figure 1: ground and roofs of a village as voxels of 1 m, with the energy that came back from each.",
                "draw_voxels", ""),
        Picture("Figure 2: a waveform as a sum of Gaussians: samples, echoes and residual.",
                f"plot waveform forest.laz --packet 19 {_WAVES} --show detector"),
        Picture("Figures 3 and 5: the square difference to a reference pulse of the waveform's height (ASDF), with "
                "the paper's rule of 30 %: the bars are the depth that a minimum needs.",
                "plot waveform forest.laz --packet 19 --show asdf --chain asdf.toml"),
        Picture("Echoes of the forest from the side.", "plot section out/forest.laz --column amplitude --aspect 3"),
    )),
    Paper("s1_wang", "Wang, Wang, Tseng", "1, 4, 5", (
        Picture("Figure 5: the five cases without noise (dashed: their echoes), and the echoes that the B3 "
                "wavelet finds at three scales.", "draw_cases", ""),
        Picture("Figures 1a and 1b: two echoes 5 ns apart, and the coefficients of the wavelet at these scales.",
                "draw_coefficients", ""),
        Picture("Figure 4: noise of the last samples of 60 waveforms, and the threshold of three standard deviations.",
                "draw_noise", ""),
        Picture("A skewed pulse (kappa 0.1) and its fit by `decompose.skewed`: the model follows the falling edge.",
                "plot waveform skewed.laz --packet 40:42 --times all --echoes --chain skewed.toml"),
    )),
    Paper("s2_jutzi", "Jutzi, Stilla (2005)", "6, 8", (
        Picture("The waveform deconvolved with the system pulse: the signal of the surfaces along the ray.",
                "plot waveform forest.laz --packet 17:21 --profile balanced --show deconvolved"),
        Picture("Figure 6: slices of the data cube of a village: x across the scan lines, y one scan line over a row "
                "of roofs, t one time, at which the roofs are missing in the ground.",
                "plot cube cube.npz --x 980 --y 5 --t 154.5"),
        Picture("Figure 8: straight segments of the ground and of the roofs in all scan lines, in plan and in 3D.",
                "slice village.laz --most 60", "--overview"),
        Picture("Length of the segments per height: the ground at 120 m, flat roofs at 124 m, slopes above.",
                "plot profile segments.csv --column length --log"),
    )),
    Paper("s3_rhomberg_kauert", "Rhomberg-Kauert, Poeppl, Pfennigbauer, Mandlburger (2024)", "2, 3, 4, 5, 6", (
        Picture("Figures 2A and 2B: echoes of planes of 0 to 75 degrees, of the pulse h as printed and of Carlsson's.",
                "draw_fan", ""),
        Picture("Figure 3: the width of the echo by angle, of both pulses, with widths that were fitted to planes of "
                "400,000 rays (bars: their spread at A/sn 100).",
                "draw_widths", ""),
        Picture("Figure 6B: angles from widths by angles from the normals of surfaces, and the histogram of "
                "their differences.", "draw_angles", ""),
        Picture("Echo widths in plan: roofs of 0 to 60 degrees on level ground.",
                "plot map out/village.laz --column echo_width --statistic median --size 2"),
        Picture("Figure 4: angles of incidence from the normals of surfaces, in plan.",
                "plot map out/village.laz --column incidence_angle_normals --statistic median --size 2"),
        Picture("Figure 5: angles of incidence from these widths.",
                "plot map out/village.laz --column incidence_angle --statistic median --size 2"),
        Picture("Echo widths from the side, across a row of roofs.",
                "plot section out/village.laz --column echo_width --line 500006,5399890,500006,5400110 --width 3"),
        Picture("Which width means which angle, and how sure that is.",
                "survey village.laz --divergence 1.1", "--angles"),
        Picture("Figure 6A: angles on the roofs from widths, with their mean.",
                "plot histogram out/village.laz --column incidence_angle --where 'z > 123.5'"),
        Picture("Figure 6A: the same from the normals of surfaces; roofs of 60 degrees give few.",
                "plot histogram out/village.laz --column incidence_angle_normals --where 'z > 123.5'"),
    )),
    Paper("s4_ussyshkin", "Ussyshkin, Theriault (2011)", "1, 2a, 2b, 4, 6, 7a, 7b", (
        Picture("Figure 1: pulses with four returns by receivers with dead zones of 2.14 m and 1.54 m, the least "
                "distances that the paper names, with waveforms that `synthesize` models from them.",
                "draw_old_records", ""),
        Picture("Figures 2a and 7a, 2b and 7b: pulses with four returns over trees of 6 m and with three over corn, "
                "and the waveforms that `synthesize` models from them.",
                "draw_record", ""),
        Picture("Figure 6: a return as the peak of a Gaussian, as `synthesize` models it.", "draw_peak", ""),
        Picture("Figure 4: the same trees of 20 m by a receiver with a dead zone of 0.65 m and by one of 2 "
                "m, and their returns by height.", "draw_canopy", ""),
        Picture("Amplitudes by the number of returns of the pulse.",
                "plot histogram out/forest.laz --column amplitude --by number_of_returns"),
        Picture("Amplitudes by return number.", "plot histogram out/forest.laz --column amplitude --by return_number"),
        Picture("Returns of the vendor and echoes of the waveforms per height.",
                "plot profile forest.laz out/forest.laz --each --size 1"),
        Picture("Density of the echoes of the village.", "plot map out/village.laz --statistic density --size 2"),
    )),
)  # fmt: skip
"""Every paper with its pictures. The chains and strips that the commands name are made by `prepare`."""

_VILLAGE = """[[chain]]
stage = "noise.pooled"
[[chain]]
stage = "detect.maximum"
[[chain]]
stage = "decompose.adaptive"
[[chain]]
stage = "attribute.echo_width"
[[chain]]
stage = "attribute.position"
[[chain]]
stage = "attribute.incidence_angle_normals"
[[chain]]
stage = "attribute.incidence_angle"
divergence = 1.1
"""

_SKEWED = """[[chain]]
stage = "noise.pooled"
[[chain]]
stage = "detect.maximum"
[[chain]]
stage = "decompose.skewed"
[[chain]]
stage = "attribute.amplitude"
[[chain]]
stage = "attribute.echo_width"
[[chain]]
stage = "attribute.position"
"""

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
    (folder / "skewed.toml").write_text(_SKEWED)
    (folder / "village.toml").write_text(_VILLAGE)
    more = ["--pulses", str(pulses), "--seed", str(seed)]
    # Scan lines have 2,000 pulses: the maps and the cube need many lines.
    many = ["--pulses", str(24 * pulses), "--seed", str(seed)]
    commands = [
        ["simulate", "forest", "-o", "forest.laz", *more], ["simulate", "village", "-o", "village.laz", *many],
        ["simulate", "forest", "-o", "skewed.laz", "--pulse", "skewed", *more],
        ["run", "forest.laz", "-o", "out", "--profile", "balanced", "-q"],
        ["run", "village.laz", "-o", "out", "--chain", "village.toml", "-q"],
        ["voxelize", "village.laz", "--size", "1", "-o", "voxels.laz", "-q"],
        ["slice", "village.laz", "--most", "60", "--cube", "cube.npz", "-o", "segments.csv", "-q"],
    ]  # fmt: skip
    return [f"wavebatch {' '.join(words)}: {error}" for words in commands if (error := run_command(words, folder))]


def draw(pictures: Sequence[Picture], folder: Path, seed: int) -> Iterator[tuple[Picture, bytes | None, str]]:
    """Draws pictures; each with its bytes, or with the error."""
    for number, picture in enumerate(pictures):
        target = folder / f"p{number}.png"
        if picture.option:
            error = run_command([*shlex.split(picture.command), picture.option, target.name, "--overwrite"], folder)
        else:
            error = draw_figure(picture.command, folder, seed, target)
        yield picture, None if error else target.read_bytes(), error


def draw_figure(name: str, folder: Path, seed: int, target: Path) -> str:
    """Calls a function of `figures`; the error, or an empty text."""
    import figures

    try:
        getattr(figures, name)(folder, seed, target)
    except (ConfigError, InputError, OSError) as error:
        return str(error)
    return ""


def measure(script: str, number: int | None, seed: int, folder: Path) -> tuple[list[dict], bool]:
    """Runs a script, which prints its tables; the tables, and whether all figures are accepted."""
    target = folder / f"{script}.json"
    words = [sys.executable, f"{FOLDER / script}.py", "--seed", str(seed), "--json", str(target)]
    code = subprocess.run([*words, *(["--number", str(number)] if number else [])], check=False).returncode
    return (json.loads(target.read_text("utf-8")) if target.exists() else []), code == 0


def format_table(table: dict) -> str:
    """A table as HTML; text of a script as it is."""
    if "text" in table:
        return render(Code(table["text"]))
    head = f'<th scope="col">{text(table["title"])}</th>'
    head += "".join(f'<th scope="col" class="n">{text(name)}</th>' for name in HEADS[1:])
    rows = []
    for name, *cells in table["rows"]:
        texts = [f'<span class="mark">{cell}</span>' if cell == "FAIL" else text(cell) for cell in cells]
        values = "".join(f'<td class="n">{one}</td>' for one in texts)
        rows.append(f"<tr><td>{text(name)}</td>{values}</tr>")
    body = "\n".join(rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>'


def fold(table: dict) -> str:
    """A table as HTML; a long one is folded, unless a figure of it is not accepted."""
    rows, shown = table.get("rows", ()), format_table(table)
    if len(rows) <= LONG:
        return shown
    missed = sum(row[-1] == "FAIL" for row in rows)
    title = f"{table['title']}: {len(rows)} figures" + (f", {missed} not accepted" if missed else "")
    opened = " open" if missed else ""
    return f"<details{opened}><summary>{text(title)}</summary>\n{shown}\n</details>"


def format_picture(picture: Picture, image: bytes | None, error: str) -> str:
    """A picture with its caption and its command."""
    ours = f"wavebatch {picture.command} {picture.option} picture.png"
    command = text(ours if picture.option else f"{picture.command} in examples/papers/figures.py")
    caption = text(picture.caption)
    below = f"<figcaption>{caption}<br><code>{command}</code></figcaption>"
    if image is None:
        return f'<figure class="wide">{render(Note(f"not drawn: {error}", "warning"))}{below}</figure>'
    data = base64.b64encode(image).decode()
    shown = f'<img class="picture" alt="{caption}" src="data:image/png;base64,{data}">'
    return f'<figure class="wide">{shown}{below}</figure>'


def read_notes() -> dict[str, list[str]]:
    """The paragraphs of README.md about each script, without its table."""
    parts = re.split(r"(?m)^## `python examples/papers/(\w+)\.py`$", (FOLDER / "README.md").read_text("utf-8"))
    notes = {}
    for script, words in zip(parts[1::2], parts[2::2], strict=True):
        paragraphs = [" ".join(one.split()) for one in words.split("\n\n") if not one.lstrip().startswith("|")]
        # The first one begins with the authors, who stand in the heading.
        first, *rest = [one.replace("`", "") for one in paragraphs if one]
        lead = first.split(": ", 1)[-1]
        notes[script] = [lead[:1].upper() + lead[1:], *rest]
    return notes


def count_accepted(tables: Sequence[dict]) -> tuple[int, int]:
    """How many figures have a band, and how many of these lie in theirs."""
    verdicts = [row[-1] for table in tables for row in table.get("rows", ())]
    return verdicts.count("ok") + verdicts.count("FAIL"), verdicts.count("ok")


def build(number: int | None, pulses: int, seed: int) -> tuple[list[SheetPart | str], bool]:
    """The parts of the page, and whether all went well."""
    drawing = importlib.util.find_spec("matplotlib") is not None
    parts, rows, notes, fine = [], [], read_notes(), True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        errors = prepare(folder, pulses, seed) if drawing else []
        for paper in PAPERS:
            print(f"== {paper.script}", flush=True)
            tables, accepted = measure(paper.script, number, seed, folder)
            drawn = list(draw(paper.pictures, folder, seed)) if drawing else []
            failed = sum(bool(error) for _, _, error in drawn)
            fine &= accepted and bool(tables) and not failed
            banded, inside = count_accepted(tables)
            mark = paper.script
            link = Cell(paper.title, link=mark)
            rows.append([link, banded, inside, len(drawn) - failed])
            inner = []
            if drawn:
                inner.append(render(Note(f"In place of the paper's figures {paper.figures}, on simulated strips:")))
            inner += [format_picture(*one) for one in drawn]
            inner += [render(Note(one)) for one in notes.get(paper.script, ())]
            inner += [fold(table) for table in tables]
            if not tables:
                inner.append(render(Note(f"{paper.script}.py printed no table; run it to see why", "warning")))
            parts.append(section(paper.title, *inner, mark=mark))
    if not drawing:
        errors = ["no pictures: matplotlib is not installed (pip install matplotlib)"]
    intro = (
        "Every figure with the paper's value, that of a simulation by other code from the same description (spec), "
        f"ours, and the band that is accepted; a dash where there is none. Seed {seed}. The papers' data and pictures "
        "are not used: a figure can agree by chance."
    )
    head = ("paper", "figures with a band", "of these accepted", "pictures")
    front = [Note(intro), *(Note(error, "warning") for error in errors), Table(head, rows)]
    return [*front, *parts], fine and not (drawing and errors)


def main(words: Sequence[str] | None = None) -> int:
    """Reads the options, those of the command line where no words are given, and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("papers.html"), help="page to write")
    parser.add_argument("--seed", type=int, default=0, help="of all simulations (default 0)")
    parser.add_argument("--number", type=int, help="waveforms per script (default: each script's)")
    parser.add_argument("--pulses", type=int, default=5000, help="pulses of the strips in the pictures (default 5000)")
    options = parser.parse_args(words)
    check_page(options.output)
    parts, fine = build(options.number, options.pulses, options.seed)
    write_page(options.output, "The papers, reproduced", parts)
    print(f"{options.output}: written" + ("" if fine else "; it names what failed"))
    return 0 if fine else 1


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except (ConfigError, InputError) as error:
        raise SystemExit(f"error: {error}") from error
