"""Fuzzing: damaged inputs of every kind through every command that reads them, each case in a process of its own.

`make fuzz MINUTES=10 SEED=1` runs it. What breaks a promise is made as small as possible and kept as one line of
`tests/fuzz_regressions.jsonl`: the kind of input, the command, and the edits of the sound input, which code builds
again. `tests/test_fuzz.py` replays these lines.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from click.testing import CliRunner

from wavebatch.cli import main
from wavebatch.stages.chain_file import effective, load_profile
from wavebatch.tools.simulate import simulate_strip

KEPT = Path(__file__).with_name("fuzz_regressions.jsonl")
MOST_SECONDS, MOST_MEMORY = 10, 1 << 30
"""Per case; memory is what the process takes at most, with Python and NumPy."""


class Case(NamedTuple):
    """A damaged input and the command that reads it."""

    kind: str
    command: int
    """Index into the commands of this kind."""
    edits: list[list]
    """Of the sound input: ["set", place, hex], ["insert", place, hex, times], ["delete", place, bytes]."""


FAST = ["--profile", "fast", "-q"]
_STRIP_COMMANDS: list[list[str]] = [
    ["run", "{input}", "-o", "{out}", *FAST],
    ["run", "{input}", "-o", "{out}", "--points", "returns", "--keep-packets", "-q"],
    ["info", "{input}"],
    ["check", "{input}"],
    ["survey", "{input}", "-o", "{out}/a.toml"],
    ["compare", "{input}", "{input}"],
    ["stats", "{input}", "-o", "{out}/a.csv"],
    ["slice", "{input}", "-o", "{out}/a.csv", "-q"],
    ["synthesize", "{input}", "-o", "{out}/a.las", "-q"],
    ["voxelize", "{input}", "-o", "{out}/a.npz", "--size", "0.5"],
]
COMMANDS: dict[str, list[list[str]]] = {
    "strip.las": _STRIP_COMMANDS,
    "packed.laz": _STRIP_COMMANDS,
    "beside.wdp": [[part.replace("{input}", "{base}/beside.las") for part in words] for words in _STRIP_COMMANDS],
    "cloud.laz": [
        ["stats", "{input}"], ["compare", "{input}", "{base}/strip.las"], ["compare", "{base}/cloud.laz", "{input}"],
        ["compare", "{input}", "--truth", "{base}/truth.npz"], ["synthesize", "{input}", "-o", "{out}/a.las", "-q"],
    ],
    "chain.toml": [["check", "{input}"], ["run", "{base}/strip.las", "-o", "{out}", "--chain", "{input}", "-q"]],
    "system.toml": [["run", "{base}/strip.las", "-o", "{out}", "--system", "{input}", *FAST]],
    "cal.toml": [["run", "{base}/strip.las", "-o", "{out}", "--calibration", "{input}", *FAST]],
    "trajectory.txt": [
        ["run", "{base}/strip.las", "-o", "{out}", "--trajectory", "{input}", "-q"],
        ["run", "{base}/strip.las", "-o", "{out}", "--trajectory", "{input}", "--lever-arm", "1,0,2", "-q"],
    ],
    "trajectory.sbet": [
        ["run", "{base}/strip.las", "-o", "{out}", "--trajectory", "{input}", "--crs", "EPSG:32632", "-q"]
    ],
    "targets.geojson": [
        ["calibrate", "{base}/strip.las", "--targets", "{input}", "-o", "{out}/c.toml", "--flight-height", "500"]
    ],
    "targets.csv": [
        ["calibrate", "{base}/strip.las", "--targets", "{input}", "-o", "{out}/c.toml", "--flight-height", "500"]
    ],
    "polygons.geojson": [["stats", "{base}/cloud.laz", "--polygons", "{input}", "-o", "{out}/a.csv"]],
    "list.txt": [["run", "@{input}", "-o", "{out}", *FAST], ["stats", "@{input}"]],
    "strip.report.json": [["run", "{base}/strip.las", "-o", "{resumed}", "--profile", "fast", "-q", "--resume"]],
    "truth.npz": [["compare", "{base}/cloud.laz", "--truth", "{input}"]],
}  # fmt: skip
"""Per kind of input. {input}: the damaged file, {base}: the folder of the sound ones, {out}: an empty folder,
{resumed}: a folder with a finished cloud and the damaged report."""


def build_inputs(base: Path) -> None:
    """Write a sound input of every kind; the same bytes each time."""
    for name, internal in (("strip.las", True), ("packed.laz", True), ("beside.las", False)):
        from wavebatch.tools.simulate import StripOptions

        truth = base / "truth.npz" if name == "strip.las" else None
        options = StripOptions(internal=internal, version="1.4", point_format=9) if name == "packed.laz" else None
        options = options or StripOptions(internal=internal)
        simulate_strip("urban", base / name, pulses=120, seed=1, truth=truth, options=options)
    (base / "chain.toml").write_text(effective(load_profile("accurate")))
    _sound("survey", base / "strip.las", "-o", base / "system.toml")
    _sound("run", base / "strip.las", "-o", base / "done", *FAST)
    (base / "strip.report.json").write_bytes((base / "done" / "strip.report.json").read_bytes())
    (base / "cloud.laz").write_bytes((base / "done" / "strip.laz").read_bytes())
    import laspy
    import numpy as np

    cloud = laspy.read(base / "cloud.laz")
    (x0, y0, _), (x1, y1, _) = cloud.header.mins, cloud.header.maxs
    x0, x1, y0, y1 = x0 - 5, x1 + 5, y0 - 5, y1 + 5  # footprints lie wholly inside
    corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    shape = {"type": "Polygon", "coordinates": [corners]}
    feature = {"type": "Feature", "properties": {"reflectance": 0.3, "name": "all", "incidence": 20}, "geometry": shape}
    document = json.dumps({"type": "FeatureCollection", "features": [feature]})
    (base / "targets.geojson").write_text(document)
    (base / "polygons.geojson").write_text(document)
    radius = x1 - x0 + y1 - y0
    heading = "name,reflectance,incidence,x,y,radius"
    (base / "targets.csv").write_text(f"{heading}\nall,0.3,20,{x0:.2f},{y0:.2f},{radius:.2f}\n")
    times = [float(cloud.gps_time.min()) + k for k in range(-2, 4)]
    ray = laspy.read(base / "strip.las")
    toward = np.stack([ray["x_t"], ray["y_t"], ray["z_t"]], axis=1).astype(float)
    ray, toward = ray[toward[:, 2] > 0], toward[toward[:, 2] > 0]
    sensor = (ray.xyz + toward / toward[:, 2:] * (800 - ray.xyz[:, 2:])).mean(axis=0)
    x, y, z = (float(value) for value in sensor)  # of flights that are simulated: 800 m high, 60 m/s to the east
    lines = [f"{t!r},{x + 60 * (t - times[2]):.3f},{y:.3f},{z:.3f},0,0,90" for t in times]
    (base / "trajectory.txt").write_text("\n".join(["time,x,y,z,roll,pitch,heading", *lines]) + "\n")
    (base / "trajectory.sbet").write_bytes(_sbet(times))
    (base / "list.txt").write_text("# strips\nstrip.las\nbeside.las\n")
    (base / "cal.toml").write_text(
        'schema = "wavebatch.calibration/1"\nconstant = 2.0e-8\nrelative_error = 0.05\nattenuation_db_km = 0.22\n'
        'divergence_mrad = 0.5\nstrip = "a.las"\n'
    )


def _sbet(times: list[float]) -> bytes:
    import numpy as np

    from wavebatch.files.trajectory_file import SBET_RECORD

    records = np.zeros(len(times), SBET_RECORD)
    records["time"], records["latitude"], records["longitude"], records["height"] = times, 0.84, 0.157, 800
    return records.tobytes()


def _sound(*command: object) -> None:
    done = CliRunner().invoke(main, list(map(str, command)))
    assert done.exit_code == 0, done.output


def apply_edits(data: bytes, edits: list[list]) -> bytes:
    """Return the damaged bytes."""
    data = bytearray(data)
    for name, place, what, *times in edits:
        if name == "set":
            data[place : place + len(what) // 2] = bytes.fromhex(what)
        elif name == "insert":
            data[place:place] = bytes.fromhex(what) * times[0]
        else:
            del data[place : place + what]
    return bytes(data)


_NUMBERS = [
    b"0", b"-1", b"1e308", b"-1e308", b"1e-320", b"nan", b"inf", b"1" + b"0" * 400, b"9" * 5000, b"0x" + b"f" * 2000,
    b"true", b'"x"', b"[]", b"{}", b"null", b"9007199254740993", b"-0.0", b"1e400", b"18446744073709551616",
]  # fmt: skip
_ODD = [
    b"\0", b"\xff", b"\x1b[31m", b"\n", b"\r", b'"', b"'", b"[", b"{", b"]", b"}", b",", b".", b"=", b"#", b"\\",
    b"\xe2\x80\xae", b"a.", b"[[", b'"""', b"@", b"*", b"\xf0\x9f\x98\x80", b"-", b" ",
]  # fmt: skip


def damage(data: bytes, kind: str, rng: random.Random) -> list[list]:
    """Return random edits of a sound input."""
    is_text = not kind.endswith((".las", ".laz", ".wdp", ".sbet", ".npz"))
    make = _damage_text if is_text else _damage_bytes
    return [make(data, rng) for _ in range(rng.choice([1, 1, 2, 5, 20]))]


def _damage_bytes(data: bytes, rng: random.Random) -> list:
    at = rng.randrange(700 if rng.random() < 0.5 and len(data) > 700 else len(data))
    choice = rng.random()
    if choice < 0.05:
        return ["delete", at, len(data)]
    if choice < 0.1:
        return ["delete", at, rng.choice([1, 4, 60])]
    if choice < 0.15:
        return ["insert", at, rng.randbytes(rng.choice([1, 4])).hex(), rng.choice([1, 15])]
    width = rng.choice([1, 2, 4, 8])
    values = [b"\xff" * width, bytes(width), rng.randbytes(width), bytes(width - 1) + b"\x80", b"\0" * 6 + b"\xf8\x7f"]
    return ["set", at, rng.choice(values).hex()]


def _damage_text(data: bytes, rng: random.Random) -> list:
    at, choice = rng.randrange(len(data)), rng.random()
    digits = [place for place in range(len(data)) if data[place : place + 1].isdigit()]
    if choice < 0.35 and digits:
        at = rng.choice(digits)
        return ["set", at, rng.choice(_NUMBERS[:7]).hex()] if choice < 0.1 else [
            "insert", at, rng.choice(_NUMBERS).hex(), 1]  # fmt: skip
    if choice < 0.5:
        return ["delete", at, rng.choice([1, 5, 40, len(data)])]
    if choice < 0.6:
        return ["insert", at, rng.choice(_ODD).hex(), rng.choice([500, 5000, 100_000])]
    if choice < 0.7:
        part = data[at : at + rng.choice([5, 50, 500])]
        return ["insert", rng.randrange(len(data)), part.hex(), rng.choice([1, 3])]
    return [rng.choice(["insert", "set"]), at, rng.choice(_ODD).hex(), 1]


class Fuzzer:
    """Runs cases in a folder; `run` returns what is wrong with one, or an empty text."""

    def __init__(self, folder: Path) -> None:
        self.base, self._folder = folder / "base", folder
        self.last: dict = {}
        """What the last command did."""
        self.base.mkdir()
        build_inputs(self.base)
        self.sound = {kind: (self.base / kind).read_bytes() for kind in COMMANDS}

    def draw(self, rng: random.Random) -> Case:
        """Return a random case."""
        kind = rng.choice(sorted(COMMANDS))
        return Case(kind, rng.randrange(len(COMMANDS[kind])), damage(self.sound[kind], kind, rng))

    def run(self, case: Case) -> str:
        """Run a case in a process of its own and return what is wrong, on one line."""
        out = self._folder / "case"
        _remove(out)
        words, expect = self._prepare(case, out)
        report = out / "result.json"
        pid = os.fork()
        if not pid:
            _run_case(words, report)
        start = time.monotonic()
        while True:
            ended, status, usage = os.wait4(pid, os.WNOHANG)
            if ended:
                break
            if time.monotonic() - start > MOST_SECONDS:
                os.kill(pid, signal.SIGKILL)
                os.wait4(pid, 0)
                return f"ran for more than {MOST_SECONDS} s"
            time.sleep(0.002)
        if status or not report.exists():
            return f"the process ended with status {status}"
        if usage.ru_maxrss << 10 > MOST_MEMORY:
            return f"took {usage.ru_maxrss >> 10} MB"
        self.last = json.loads(report.read_text())
        return _judge(self.last, out / "out", expect)

    def _prepare(self, case: Case, out: Path) -> tuple[list[str], set[str]]:
        """The command with the damaged input in place, and the names that its folder holds before."""
        (out / "out").mkdir(parents=True)
        data = apply_edits(self.sound[case.kind], case.edits)
        base, places = self.base, {"out": out / "out", "resumed": out / "out", "base": self.base}
        if case.kind == "strip.report.json":
            (out / "out" / "strip.laz").write_bytes((base / "done" / "strip.laz").read_bytes())
            places["input"] = out / "out" / case.kind
        elif case.kind in ("beside.wdp", "list.txt"):
            places["base"] = out
            for name in ("beside.las", "strip.las"):
                (out / name).write_bytes((base / name).read_bytes())
            places["input"] = out / case.kind
            (out / "beside.wdp").write_bytes((base / "beside.wdp").read_bytes())
        else:
            places["input"] = out / case.kind
        places["input"].write_bytes(data)
        words = [word.format(**places) for word in COMMANDS[case.kind][case.command]]
        return words, {path.name for path in (out / "out").iterdir()}

    def shrink(self, case: Case) -> Case:
        """Return the case without the edits that do not matter."""
        edits = list(case.edits)
        for edit in list(edits):
            fewer = [other for other in edits if other is not edit]
            if fewer and self.run(case._replace(edits=fewer)):
                edits = fewer
        return case._replace(edits=edits)


def _run_case(words: list[str], report: Path) -> None:
    """In the forked process: run the command, with warnings as errors, and write what it did."""
    try:
        warnings.simplefilter("error")
        done = CliRunner().invoke(main, words)
        is_bug = not isinstance(done.exception, SystemExit | None)
        error = "".join(traceback.format_exception(done.exception)) if is_bug else ""
        found = {"code": done.exit_code, "out": done.stdout[-5000:], "err": done.stderr[-5000:], "error": error}
        report.write_text(json.dumps(found))
        os._exit(0)
    finally:
        os._exit(99)


def _judge(done: dict, out: Path, before: set[str]) -> str:
    """What is wrong with the end of a command."""
    code, said = done["code"], done["err"]
    left = {path.name for path in out.iterdir()}
    if done["error"]:
        return "traceback: " + " ".join(done["error"].split())[-300:]
    if code not in (0, 1, 2, 3, 4):
        return f"exit code {code}"
    for word in ("this is a bug", "Traceback", "Warning", "not enough memory"):
        if word in said or word in done["out"]:
            return f"says {word}: {' '.join(said.split())[:300]}"
    if any(c < " " and c != "\n" or c == "\x7f" for c in said):
        return f"control characters: {said[:200]!r}"
    if code and not said.strip() and not done["out"].strip():
        return "fails without a word"
    if any(name.startswith(".") for name in left):
        return f"leaves {sorted(left)}"
    if code in (1, 2, 4) and left - before:
        return f"exit code {code}, but leaves {sorted(left - before)}: {said[:200]}"
    reports = {name.removesuffix(".report.json") for name in left - before if name.endswith(".report.json")}
    if any(f"{name}.laz" not in left for name in reports):
        return f"a report without its cloud: {sorted(left)}"
    return ""


def _remove(folder: Path) -> None:
    for path in sorted(folder.rglob("*"), reverse=True) if folder.exists() else ():
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    if folder.exists():
        folder.rmdir()


def fuzz(
    folder: Path, seconds: float, seed: int, *, tell: Callable[[str], object] = print
) -> Iterator[tuple[Case, str]]:
    """Run random cases for so many seconds; yield the failing ones, made small, each reason once."""
    fuzzer, rng = Fuzzer(folder), random.Random(seed)
    end, number, seen = time.monotonic() + seconds, 0, set()
    while time.monotonic() < end:
        case = fuzzer.draw(rng)
        why = fuzzer.run(case)
        number += 1
        key = (case.kind, case.command, re.sub(r"[\d\W]+", " ", why)[:40])
        if why and key not in seen:
            seen.add(key)
            yield fuzzer.shrink(case), why
    tell(f"{number} cases with seed {seed}, {len(seen)} kinds of failure")


def load_kept(path: Path = KEPT) -> list[Case]:
    """Return the cases that failed once."""
    lines = path.read_text().splitlines() if path.exists() else []
    return [Case(*json.loads(line)[:3]) for line in lines]


def _start() -> int:
    import tempfile

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        for case, why in fuzz(Path(folder), 60 * options.minutes, options.seed):
            failures += 1
            print(f"{case.kind}: {' '.join(COMMANDS[case.kind][case.command])}: {why}", flush=True)
            with open(KEPT, "a") as file:
                file.write(json.dumps([*case, re.sub(r"/\S*/", "", why)[:100]]) + "\n")
    return failures > 0


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    sys.exit(_start())
