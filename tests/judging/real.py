"""Judges a survey on the real strips: `python tests/judging/real.py --help`.

Beside a reference fit of its own (reference_fit.py) it judges by what needs no truth: mirrored residuals, parts of a
strip, injected echoes (injections.py). Beside the public API only `subtract_echoes` is used, wherever it is.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from checkouts import FWHM_PER_SIGMA, find_doubts, find_function, flatten, format_table, read_lines, run_in, timed
from injections import classify, format_classes, inject
from reference_fit import Fitter, Waveform
from strangers import match
from strip_parts import list_packets, without_sensor, write_part

STRIPS = {
    "riegl": ("riegl-q680i/100429_152240_2535pt_UTM.las", 4.55, "riegl-q680i", None),
    "leica": ("leica-als/simple1_3_full_internal.las", None, "leica-als", None),
    "geolas": ("geolas/geolas1.las", 4.05, "geolas-q560", None),
    "lvis": ("lvis/lvis1.las", 6.68, "nasa-lvis", "nasa-lvis.toml"),
    "neon": ("neon/neon_harv_a.las", 15.1, "neon-gemini", "impulse_return.csv"),
    "optech": ("optech/optech_a.las", 14.07, None, None),
}
"""File, FWHM of the outgoing pulse [ns], name of the sensor's shipped file, and the pulse of the reference fit; without
the last it is stacked from lone echoes. A strip that is given by its path is one without all these."""

REFERENCE = 250
"""Packets that the reference fit decomposes."""
STRONG, SPLIT, BESIDE = 20.0, 0.05, 30.0
"""Noises of a main echo; least share of it that a further echo within one width has; noises of a main echo beside which
mirrored ones are counted, within two widths."""
LIFT = 64
"""Counts that mirrored waveforms are lifted by, so that no mirrored noise falls below 0."""
FIFTY = 50


class Decomposed:
    """A strip that is open, with its blocks; decomposes them with any survey."""

    def __init__(self, strip: Any) -> None:
        self.blocks = list(strip.blocks())
        self.spacing = self.blocks[0].spacing
        self.points = np.sort(np.concatenate([block.point for block in self.blocks]))

    def run(self, survey: Any, blocks: list[Any] | None = None, system: Any = None) -> list[Any]:
        """Echo tables of the blocks."""
        import wavebatch as wb

        chain = wb.auto_chain(survey)
        return [chain.run(block, system or survey.system) for block in blocks or self.blocks]

    def flat(self, tables: list[Any]) -> dict[str, np.ndarray]:
        """All echoes, times in samples."""
        found = flatten(self.blocks, tables)
        return found | {name: found[name] / self.spacing for name in ("time", "time_err", "sigma")}

    def count(self, tables: list[Any]) -> np.ndarray:
        """Echoes of each packet, in the order of `points`."""
        packets = self.flat(tables)["packet"].astype(int)
        return np.bincount(np.searchsorted(self.points, packets), minlength=len(self.points))


def find_strip(name: str, data: Path) -> tuple[Path, float | None, str | None, str | None]:
    """Path of a strip and what is known of it, by its name in STRIPS or by its path."""
    path, *known = STRIPS.get(name, (Path(name).resolve(), None, None, None))
    return data / path, *known


def lift_system(system: Any) -> Any:
    """The system of waveforms that are LIFT counts higher."""
    noise = replace(system.noise, baseline=system.noise.baseline + LIFT)
    limit = None if system.saturation is None else system.saturation + LIFT
    others = {index: lift_system(other) for index, other in system.digitizers.items()}
    return replace(system, noise=noise, saturation=limit, digitizers=others)


def mirror(strip: Decomposed, survey: Any, tables: list[Any], fwhm: float, noise: float) -> dict[str, float]:
    """Echoes of waveforms whose residuals are turned over, where no echo was found: per 100 quiet or strong ones."""
    subtract, blocks = find_function("subtract_echoes"), []
    for block, echoes in zip(strip.blocks, tables, strict=True):
        rest = np.nan_to_num(subtract(block, survey.system.of(block), echoes))
        turned = np.clip(np.rint(block.samples - 2 * rest + LIFT), 0, 65535).astype(np.uint16)
        blocks.append(replace(block, samples=turned, digitizer=replace(block.digitizer, bits=16)))
    system = survey.system
    if system.saturation is None:
        system = replace(system, saturation=float(strip.blocks[0].digitizer.max_count))
    turned = strip.flat(strip.run(survey, blocks, lift_system(system)))
    found = strip.flat(tables)
    near = {"packet": found["packet"], "time": found["time"], "fwhm": np.full(len(found["time"]), fwhm)}
    _, extra = match(near, turned, fwhm)
    packet, time = turned["packet"][extra], turned["time"][extra]
    strong = found["amplitude"] > BESIDE * noise
    mains = strong & (found["amplitude"] == _largest(found))
    beside, alone = _near(packet, time, found, mains, 2 * fwhm), ~_near(packet, time, found, None, 3 * fwhm)
    return {
        "quiet_false": 100 * alone.sum() / max(len(found["time"]), 1),
        "beside_false": 100 * beside.sum() / max(mains.sum(), 1), "strong": int(mains.sum()),
    }  # fmt: skip


def _largest(found: dict[str, np.ndarray]) -> np.ndarray:
    """Amplitude of the largest echo of each echo's packet."""
    _, row = np.unique(found["packet"], return_inverse=True)
    largest = np.zeros(row.max(initial=-1) + 1)
    np.maximum.at(largest, row, found["amplitude"])
    return largest[row]


def _near(
    packet: np.ndarray, time: np.ndarray, found: dict[str, np.ndarray], which: np.ndarray | None, reach: float
) -> np.ndarray:
    """Whether one of the chosen echoes lies within `reach` of the same packet."""
    rows = np.arange(len(found["time"])) if which is None else np.flatnonzero(which)
    at = np.sort(found["packet"][rows] * 1e6 + found["time"][rows])
    return np.searchsorted(at, packet * 1e6 + time + reach) > np.searchsorted(at, packet * 1e6 + time - reach)


def measure_splits(found: dict[str, np.ndarray], fwhm: float, noise: float) -> float:
    """Share of main echoes with a further echo within one width [%]."""
    largest = _largest(found)
    mains = np.flatnonzero((found["amplitude"] == largest) & (found["amplitude"] > STRONG * noise))
    further = (found["amplitude"] >= SPLIT * largest) & (found["amplitude"] < largest)
    split = _near(found["packet"][mains], found["time"][mains], found, further, fwhm)
    return float(100 * split.mean()) if len(mains) else float("nan")


def refer(name: str, strip: Decomposed, data: Path, cache: Path) -> dict[str, np.ndarray]:
    """The reference fit of a strip, made once: echoes, the packets that it looked at, pulse and noise."""
    path, _, _, known = find_strip(name, data)
    label = name if name in STRIPS else f"{path.stem}-{zlib.crc32(path.read_bytes()):08x}"
    file = cache / f"reference-{label}.npz"
    if not file.exists():
        if known:
            root = Path(__file__).parents[2] if known.endswith(".toml") else data
            known = next(root.rglob(known))
        waveforms = []
        for block in strip.blocks:
            limit = block.digitizer.max_count
            for row, point in enumerate(block.point):
                missing = np.zeros(block.samples.shape[1], bool) if block.missing is None else block.missing[row]
                waveforms.append(Waveform(int(point), block.samples[row].astype(float),
                                          ~missing & (block.samples[row] < limit)))  # fmt: skip
        waveforms.sort(key=lambda one: one.packet)
        fitter = Fitter(waveforms, known)
        chosen = waveforms[:: max(len(waveforms) // REFERENCE, 1)]
        fits = [(one.packet, *echo) for one in chosen for echo in fitter.fit(one)[0]]
        columns = np.array(fits).T
        cache.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part.npz")
        np.savez_compressed(
            part, packet=columns[0], time=columns[1], amplitude=columns[2], variance=columns[3],
            packets=[one.packet for one in chosen], lag=fitter.pulse.lag, pulse=fitter.pulse.table[0],
            fwhm_of_pulse=fitter.pulse.fwhm, noise=np.sqrt(fitter.covariance[0]), misfit=fitter.misfit,
            covariance=fitter.covariance,
        )  # fmt: skip
        part.rename(file)
    with np.load(file) as kept:
        return dict(kept)


def compare_reference(found: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Shares [%] of the reference's echoes that were found, of found echoes that it has, of packets with all alike."""
    fwhm, packets = float(reference["fwhm_of_pulse"]), reference["packets"]
    here = np.isin(found["packet"], packets)
    found = {name: found[name][here] for name in ("packet", "time", "amplitude")}
    truth = {name: reference[name] for name in ("packet", "time", "amplitude")}
    truth["fwhm"] = np.full(len(truth["time"]), fwhm)
    nearest, _ = match(truth, found, fwhm)
    strong = (nearest >= 0) & (truth["amplitude"] > STRONG * reference["noise"])
    shift = np.median(found["time"][nearest[strong]] - truth["time"][strong]) if strong.any() else 0.0
    found["time"] = found["time"] - shift
    nearest, _ = match(truth, found, fwhm)
    back, _ = match(found | {"fwhm": np.full(len(found["time"]), fwhm)}, truth, fwhm)
    # Each is the nearest of the other: of the halves of a split echo one is right.
    pair = (nearest >= 0) & (back[nearest] == np.arange(len(nearest)))
    right = (back >= 0) & (nearest[back] == np.arange(len(back)))
    wrong = np.union1d(truth["packet"][~pair], found["packet"][~right])
    exact = ~np.isin(packets, wrong)
    return {"complete": 100 * pair.mean(), "correct": 100 * right.mean(), "exact": 100 * exact.mean()}


def survey_parts(path: Path, strip: Decomposed, counts: np.ndarray, folder: Path) -> dict[str, Any]:
    """Surveys of halves, tiles and fifties by themselves, and what they change: shares of packets [%]."""
    import wavebatch as wb

    rank = list_packets(path)
    number = rank.max() + 1

    def look(name: str, keep: np.ndarray) -> tuple[np.ndarray, Any, Path]:
        part = write_part(path, keep, folder / f"{name}.las")
        survey = wb.survey(part)
        return strip.count(strip.run(survey)), survey, part

    def differ(one: np.ndarray, other: np.ndarray) -> float:
        return float(100 * np.mean(one != other))

    even, odd = (look(f"turn{i}", rank % 2 == i)[0] for i in range(2))
    first, last = (look(f"half{i}", rank * 2 // number == i)[0] for i in range(2))
    point_rank = np.zeros(len(strip.points), int)
    point_rank[:] = rank[strip.points]
    tiles = np.zeros(len(counts), bool)
    for i in range(4):
        own = point_rank * 4 // number == i
        tiles[own] = (look(f"tile{i}", rank * 4 // number == i)[0] != counts)[own]
    fifties = []
    for i, keep in enumerate((rank < FIFTY, abs(rank - number // 2) < FIFTY // 2, rank % max(number // FIFTY, 1) == 0)):
        changed, survey, part = look(f"fifty{i}", keep)
        fifties.append({"ratio": float(changed.sum() / max(counts.sum(), 1)), "differ": differ(changed, counts),
                        "said": bool(find_doubts(part, survey, folder / "clouds")[0])})  # fmt: skip
    return {"even_odd": differ(even, odd), "first_last": differ(first, last), "tiles": float(100 * tiles.mean()),
            "fifties": fifties}  # fmt: skip


def judge(name: str, data: Path, cache: Path, *, brief: bool, classes: int | None = None) -> dict[str, Any]:
    """All figures of one strip with the wavebatch that can be imported; brief: without parts, mirror and injections.

    classes: seed of the injections whose shares are told by class; without one there are none.
    """
    import wavebatch as wb

    path, outgoing, *_ = find_strip(name, data)
    with wb.open_strip(path) as opened, tempfile.TemporaryDirectory() as folder:
        strip = Decomposed(opened)
        reference = refer(name, strip, data, cache)
        survey, survey_s = timed(wb.survey, opened)
        tables, decompose_s = timed(strip.run, survey)
        found, counts = strip.flat(tables), strip.count(tables)
        doubts, run_s = find_doubts(path, survey, Path(folder) / "clouds")
        fwhm, noise = float(reference["fwhm_of_pulse"]), float(reference["noise"])
        clipped = (found["flags"] & 8) != 0
        result = {
            "strip": name if name in STRIPS else path.stem, "survey_s": survey_s, "run_s": run_s,
            "decompose_s": decompose_s, "doubts": doubts, "fwhm": float(survey.system.sigma_ref) * FWHM_PER_SIGMA,
            "outgoing": outgoing, "counts": counts.tolist(),
            "reference_fwhm": fwhm * strip.spacing, "per_packet": float(counts.mean()),
            "unsure": 100 * float(np.mean((found["amplitude_err"] > found["amplitude"])[~clipped])),
            "splits": measure_splits(found, fwhm, noise), **compare_reference(found, reference),
        }  # fmt: skip
        if classes is not None:
            result["classes"] = format_classes(classify(strip, survey, tables, reference, classes))
        if brief:
            return result
        parts = (
            (mirror, (strip, survey, tables, fwhm, noise)), (inject, (strip, survey, tables, reference)),
            (survey_parts, (path, strip, counts, Path(folder))),
        )  # fmt: skip
        for part, values in parts:
            try:
                result |= part(*values)
            except Exception as error:  # a part that fails is a result
                result.setdefault("errors", []).append(f"{type(error).__name__}: {error}")
        return result


COLUMNS = {
    "survey s": "survey_s", "run s": "run_s", "FWHM ns": "fwhm", "outgoing": "outgoing", "stacked": "reference_fwhm",
    "echoes": "per_packet", "complete": "complete", "correct": "correct", "exact": "exact", "split %": "splits",
    "err > a %": "unsure", "false quiet": "quiet_false", "false beside": "beside_false", "strong": "strong",
    "even-odd": "even_odd", "first-last": "first_last", "tiles": "tiles",
}  # fmt: skip
INJECTED = {name: name for name in ("injected", "found_near", "found_far", "t_near", "t_far", "a_near", "a_far")}


def tabulate(results: list[dict[str, Any]], older: list[dict[str, Any]]) -> str:
    """Tables of all figures, of injections and of small parts; the older result below each row."""
    before = {one["strip"]: one for one in older}
    both = [(label, one) for now in results for label, one in ((now["strip"], now), ("  before", before.get(
        now["strip"]))) if one]  # fmt: skip
    texts = []
    for columns in (COLUMNS, INJECTED):
        rows = [[label, *(one.get(key) for key in columns.values())] for label, one in both]
        texts.append(format_table([["strip", *columns], *rows]))
    rows = [["strip", "ratio, % changed, said: first 50, middle 50, spread 50", "known sensor hidden", "says"]]
    for label, one in both:
        fifties = "; ".join(f"{part['ratio']:.2f} {part['differ']:.0f}{' said' if part['said'] else ''}"
                            for part in one.get("fifties", []))  # fmt: skip
        out = one.get("left_out")
        text = "-" if not out else (
            f"FWHM {out['fwhm']:.2f}, {out['changed']:.0f} % changed, {out['per_packet']:.2f} echoes, "
            f"{out['complete']:.1f}/{out['correct']:.1f}/{out['exact']:.1f}{' said' if out['doubts'] else ''}"
        )  # fmt: skip
        rows.append([label, fifties, text, " | ".join([*one["doubts"], *one.get("errors", [])])[:150] or "-"])
    texts.append(format_table(rows))
    texts += [f"{one['strip']}: injected echoes\n{one['classes']}" for one in results if "classes" in one]
    return "\n\n".join(texts)


def main(arguments: Sequence[str] | None = None) -> int:
    beside = Path(__file__).parents[3]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[2], help="checkout to judge")
    parser.add_argument("--strips", default=",".join(STRIPS), help="names, as riegl,optech, or paths")
    parser.add_argument("--data", type=Path, default=os.environ.get("WAVEBATCH_DATA", beside / "shared" / "data"))
    parser.add_argument("--cache", type=Path, default=beside / "strangers", help="folder that keeps the reference fits")
    parser.add_argument("-o", "--output", type=Path, help="JSON lines; replaced")
    parser.add_argument("--compare", type=Path, help="JSON lines of another checkout")
    parser.add_argument("--brief", action="store_true", help="without parts, mirrored residuals and injections")
    parser.add_argument("--classes", type=int, metavar="SEED", help="also injected echoes by height and separation")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.child:
        try:
            result = judge(given.strips, given.data, given.cache, brief=given.brief, classes=given.classes)
        except (OSError, ValueError) as error:  # also of what wavebatch refuses
            print(f"error: {error}", file=sys.stderr)
            return 1
        print(json.dumps(result), flush=True)
        return 0
    root, results = given.root.resolve(), []
    names = [name for name in re.split("[ ,]+", given.strips) if name]
    if not names:
        parser.error("no strips: give their names or paths (make bench-real STRIP=...)")
    for name in names:
        options = ["--data", str(given.data), "--cache", str(given.cache), "--strips", name]
        brief = ["--brief"] if given.brief else []
        classes = [] if given.classes is None else ["--classes", str(given.classes)]
        for result in run_in(root, Path(__file__), [*options, *brief, *classes]):
            sensor = find_strip(name, given.data)[2]
            if sensor:
                with tempfile.TemporaryDirectory() as folder:
                    hidden = without_sensor(root, sensor, Path(folder))
                    for out in run_in(hidden, Path(__file__), [*options, "--brief"]):
                        changed = np.mean(np.array(out.pop("counts")) != np.array(result["counts"]))
                        result["left_out"] = out | {"changed": 100 * float(changed)}
            results.append(result)
            print(f"{name}: {result['survey_s']:.1f} s", file=sys.stderr)
            if given.output:
                given.output.write_text("".join(json.dumps(one) + "\n" for one in results))
    print(tabulate(results, read_lines(given.compare) if given.compare else []))
    return int(len(results) < len(names))


if __name__ == "__main__":
    sys.exit(main())
