"""Attacks on commands that run: signals to the process, to all of its group, and to its workers, at random instants.

`make attack RUNS=1000 SEED=1` runs it. Each attack starts a command as a user does, disturbs it once, and checks what
docs/reliability.md promises: the exit code, no hang, no temporary file, no process that stays, nothing half done; and
that the same command, run again (`run` with --resume), ends with the same bytes as one that was never disturbed.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from child_signals import give_children_default_signals
from commands import succeed

import wavebatch
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.strip import StripOptions

LONGEST = 300.0
"""Seconds after which a command hangs; undisturbed ones take one or two."""

STAY = 60.0
"""Seconds that other processes of the session have to end after the command."""

RUN = "run {base}/strips -o {out} -q"
COMMANDS = {
    "run, 1 job": f"{RUN} --profile fast",
    "run, 2 jobs": f"{RUN} --profile fast --jobs 2",
    "run, 3 jobs": f"{RUN} --jobs 3",
    "run, flight": f"{RUN} --survey flight --jobs 2",
    "run, neighbours": f"{RUN} --columns +incidence_angle_normals --calibration {{base}}/cal.toml --jobs 2",
    "run, neighbours, 1 job": f"{RUN} --columns +incidence_angle_normals --format las",
    "run, packets": f"{RUN} --points returns --keep-packets --profile fast",
    "run, report": f"{RUN} --profile fast --report {{out}}/all.json --format las",
    "simulate": "simulate urban -o {out}/a.laz --truth {out}/a.npz --pulses 8000 -q",
    "synthesize": "synthesize {base}/strips/a.las -o {out}/a.laz --external -q",
    "slice": "slice {base}/strips -o {out} -q",
    "voxelize": "voxelize {base}/strips/a.las -o {out}/a.npz --size 0.5 --profiles {out}/b.npz -q",
    "stats": "stats {base}/strips -o {out}/a.csv --area 5",
    "grid": "grid {base}/strips/a.las --statistic density --size 2 -o {out}/a.tif -q",
    "survey": "survey {base}/strips/a.las -o {out}/a.toml --chain {out}/b.toml",
    "calibrate": "calibrate {base}/strips/a.las --targets {base}/targets.csv -o {out}/a.toml --flight-height 500",
    "plot": "plot histogram {base}/strips/a.las --column intensity -o {out}/a.svg -q",
}
"""What is attacked; {base}: a folder with inputs, {out}: an empty one."""

SIGNALS: dict[str, tuple[int, ...]] = {
    "INT": (signal.SIGINT,), "TERM": (signal.SIGTERM,), "HUP": (signal.SIGHUP,), "KILL": (signal.SIGKILL,),
    "XCPU": (signal.SIGXCPU,), "INT INT": (signal.SIGINT, signal.SIGINT), "INT KILL": (signal.SIGINT, signal.SIGKILL),
    "TERM INT TERM": (signal.SIGTERM, signal.SIGINT, signal.SIGTERM),
}  # fmt: skip
WORKERS = ("worker KILL", "worker STOP CONT", "worker STOP INT", "worker STOP KILL")
ATTACKS = (*SIGNALS, "group INT", "group TERM", *WORKERS)


_PACKAGE = os.path.dirname(wavebatch.__file__) + os.sep


class Attack(NamedTuple):
    """One disturbance of one command."""

    name: str
    """Of the command."""
    kind: str
    share: float
    """When, as a share of the time that the undisturbed command takes."""


class Attacker:
    """Runs attacks in a folder; `attack` returns what is wrong, or an empty text."""

    longest, stay = LONGEST, STAY

    def __init__(self, folder: Path) -> None:
        self.base, self._folder = folder / "base", folder
        self.base.mkdir()
        in_child(self._build)
        self.sound: dict[str, dict[str, object]] = {}
        """Contents of the undisturbed outputs."""
        self.seconds: dict[str, float] = {}
        self.ended: collections.Counter[tuple[str, int | str]] = collections.Counter()
        """How attacked commands ended, by attack and exit code."""

    def _build(self) -> None:
        strips = self.base / "strips"
        strips.mkdir()
        for name, options in (
            ("a.las", StripOptions()), ("b.laz", StripOptions(version="1.4", point_format=9)),
            ("c.las", StripOptions(internal=False)), ("d.las", StripOptions()),
        ):  # fmt: skip
            simulate_strip("urban", strips / name, pulses=400, seed=ord(name[0]), options=options)
        (self.base / "cal.toml").write_text(
            'schema = "wavebatch.calibration/1"\nconstant = 2.0e-8\nrelative_error = 0.05\nattenuation_db_km = 0.22\n'
            'divergence_mrad = 0.5\nstrip = "a.las"\n'
        )
        import laspy

        (x, y, _), (x1, y1, _) = (lambda h: (h.mins, h.maxs))(laspy.read(strips / "a.las").header)
        row = f"all,0.3,20,{x:.2f},{y:.2f},{x1 - x + y1 - y + 10:.2f}"
        (self.base / "targets.csv").write_text(f"name,reflectance,incidence,x,y,radius\n{row}\n")

    def draw(self, rng: random.Random) -> Attack:
        """Return a random attack; `run` is drawn more often than the others."""
        name = rng.choice([name for name in COMMANDS for _ in range(2 if name.startswith("run") else 1)])
        kinds = [kind for kind in ATTACKS if "--jobs" in COMMANDS[name] or not kind.startswith("worker")]
        return Attack(name, rng.choice(kinds), rng.choice([rng.random(), 1.15 * rng.random(), 0.2 * rng.random()]))

    def attack(self, attack: Attack) -> str:
        """Run an attack and return what is wrong, on one line."""
        self._learn(attack.name)
        out, temporary = self._folder / "out", self._folder / "tmp"
        _empty(out), _empty(temporary)
        process = self._start(attack.name, out, temporary)
        try:
            is_ready, code, said = self._disturb(process, attack)
        finally:
            left = self._end(process)
        begun = not has_not_begun(is_ready, code, said)
        self.ended[attack.kind, code if begun else "before Python has begun"] += 1
        return (
            self._judge_end(attack, is_ready, code, said)
            or (f"processes stay: {left}" if left else "")
            or self._judge_files(attack, code, out, temporary)
            or self._judge_again(attack.name, out)
        )

    def _learn(self, name: str) -> None:
        """What the undisturbed command gives, and how long it takes."""
        if name in self.sound:
            return
        out, temporary = self._folder / "undisturbed", self._folder / "tmp"
        _empty(out), _empty(temporary)
        start = time.monotonic()
        process = self._start(name, out, temporary)
        said = process.communicate(timeout=self.longest)[0]
        assert process.returncode == 0, said
        self.sound[name], self.seconds[name] = _contents(out), time.monotonic() - start

    def _start(self, name: str, out: Path, temporary: Path) -> subprocess.Popen:
        env = {**os.environ, "TMPDIR": str(temporary), "PYTHONFAULTHANDLER": "1"}
        return subprocess.Popen(
            self._words(name, out), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, start_new_session=True, preexec_fn=_listen, env=env,
        )  # fmt: skip

    def _words(self, name: str, out: Path) -> list[str]:
        words = [word.format(base=self.base, out=out) for word in shlex.split(COMMANDS[name])]
        return [sys.executable, "-m", "wavebatch", *words]

    def _disturb(self, process: subprocess.Popen, attack: Attack) -> tuple[bool, int | str, str]:
        """Send the signals; whether the process had begun, and its exit code or "hangs", and stderr."""
        time.sleep(attack.share * self.seconds[attack.name])
        is_ready = handles_signals(process.pid)
        target, _, rest = attack.kind.partition(" ")
        with contextlib.suppress(ProcessLookupError):
            if target == "worker":
                self._disturb_worker(process.pid, rest.split())
            elif target == "group":
                os.killpg(process.pid, getattr(signal, f"SIG{rest}"))
            else:
                for number in SIGNALS[attack.kind]:
                    process.send_signal(number)
                    time.sleep(random.random() * 0.01)
        try:
            said = process.communicate(timeout=self.longest)[1]
        except subprocess.TimeoutExpired:
            return is_ready, "hangs", _stacks(process)
        return is_ready, process.returncode, said

    def _disturb_worker(self, parent: int, actions: list[str]) -> None:
        workers = [pid for pid in list_children(parent) if "spawn_main" in command_line(pid)]
        if actions == ["STOP", "KILL"]:  # one that is stopped while Python starts in it cannot be woken
            workers = [pid for pid in workers if has_signal(pid, "SigIgn", signal.SIGINT)]
        if not workers:
            return
        worker = random.choice(workers)
        os.kill(worker, getattr(signal, f"SIG{actions[0]}"))
        for action in actions[1:]:
            time.sleep(random.random() * 0.3)
            os.kill(worker if action == "CONT" else parent, getattr(signal, f"SIG{action}"))

    def _end(self, process: subprocess.Popen) -> list[str]:
        """Wait until all processes of the session are gone; those that stay are killed and returned."""
        deadline = time.monotonic() + self.stay
        while (left := _session(process.pid)) and time.monotonic() < deadline:
            time.sleep(0.01)
        found = [command_line(pid) for pid in left]
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.kill()
        process.wait()
        process.stderr.close()
        return found

    def _judge_end(self, attack: Attack, is_ready: bool, code: int | str, said: str) -> str:
        """The exit code and stderr."""
        if code == "hangs":
            return f"hangs for more than {self.longest:.0f} s: {said}"
        if has_not_begun(is_ready, code, said):
            return ""
        killed = "KILL" in attack.kind and not attack.kind.startswith("worker K")
        allowed = {0, -signal.SIGKILL} if killed else {0, 130}
        if "INT KILL" in attack.kind:
            allowed.add(130)
        if attack.kind in ("worker KILL", "worker STOP CONT"):
            allowed = {0}
        if code not in allowed:
            return f"exit code {code}: {said[-300:]}"
        if "this is a bug" in said or ("Traceback" in said and not _lost_its_parent(code, said)):
            return f"says {said[-300:]}"
        if code == 130 and "interrupted" not in "".join(said.splitlines()[-1:]):
            return f"the last line is not `interrupted`: {said[-300:]}"
        return ""

    def _judge_files(self, attack: Attack, code: int | str, out: Path, temporary: Path) -> str:
        """What lies in the folders: only whole outputs, and after `kill -9` temporary files."""
        found, sound = _contents(out), self.sound[attack.name]
        if code != -signal.SIGKILL:
            if any(name.startswith(".") for name in found):
                return f"leaves {sorted(found)}"
            if os.listdir(temporary):
                return f"leaves in TMPDIR: {os.listdir(temporary)}"
        whole = {name: content for name, content in found.items() if not name.startswith(".")}
        for name, content in whole.items():
            if name == "all.json" and "run" in attack.name and content != sound[name]:
                continue  # a report says which strips are interrupted
            if name not in sound or content != sound[name]:
                return f"{name} is not that of an undisturbed command"
        if code == 0 and whole.keys() != sound.keys():
            return f"exit code 0, but {sorted(sound.keys() - whole.keys())} are missing"
        for name in whole:
            base = name.removesuffix(".report.json")
            if base != name and not {f"{base}.laz", f"{base}.las"} & set(whole):
                return f"{name} without its cloud"
        return ""

    def _judge_again(self, name: str, out: Path) -> str:
        """The same command again ends as if nothing had happened."""
        again = ["--resume", "--jobs", "1"] if name.startswith("run") else ["--overwrite"]

        def work() -> None:
            succeed(*self._words(name, out)[3:], *again)

        try:
            in_child(work)
        except AssertionError as error:
            return f"cannot be run again: {error}"
        found, sound = _contents(out), self.sound[name]
        different = [key for key in sorted(found.keys() | sound.keys())
                     if key != "all.json" and found.get(key) != sound.get(key)]  # it says what is new  # fmt: skip
        return f"run again: other bytes in {different}" if different else ""


def in_child(work: Callable[[], object]) -> None:
    """Run this in a forked process; raises AssertionError with its stderr if it fails."""
    source, target = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            os.close(source)
            work()
            os._exit(0)
        except BaseException:
            os.write(target, traceback.format_exc().encode()[-3000:])
        finally:
            os._exit(1)
    os.close(target)
    with os.fdopen(source, errors="replace") as file:
        said = file.read()
    if os.waitpid(pid, 0)[1]:
        raise AssertionError(said)


def _listen() -> None:
    """In the new process: a shell lets its background jobs, such as this program, ignore Ctrl-C."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()


def _contents(folder: Path) -> dict[str, object]:
    """Bytes by name; reports without their times."""
    found: dict[str, object] = {}
    for path in folder.iterdir():
        if path.name.endswith(".json"):
            found[path.name] = _without_times(json.loads(path.read_text()))
        else:
            found[path.name] = path.read_bytes() if path.is_file() else None
    return found


def _without_times(value: object) -> object:
    if isinstance(value, dict):
        return {k: _without_times(v) for k, v in value.items() if k not in ("timing", "seconds", "status", "command")}
    return [_without_times(one) for one in value] if isinstance(value, list) else value


def handles_signals(pid: int) -> bool:
    """Whether the program has begun: from then on no signal may be lost."""
    return has_signal(pid, "SigCgt", signal.SIGTERM)


def has_signal(pid: int, name: str, number: int) -> bool:
    """Whether a signal is among those that a process catches (name SigCgt) or ignores (SigIgn); True if it is gone."""
    lines = read_process(pid, "status").decode().splitlines()
    signals = [int(line.split()[1], 16) for line in lines if line.startswith(name)]
    return not signals or bool(signals[0] >> (number - 1) & 1)


def read_process(pid: int | str, name: str) -> bytes:
    """What Linux says of a process; nothing if it is gone."""
    try:
        return Path(f"/proc/{pid}/{name}").read_bytes()
    except OSError:
        return b""


def _lost_its_parent(code: int | str, said: str) -> bool:
    """Whether Python, while it started in a worker, says that the program was killed."""
    return code == -signal.SIGKILL and f'File "{_PACKAGE}' not in said


def has_not_begun(is_ready: bool, code: int | str, said: str) -> bool:
    """Whether a signal came while Python itself started: it dies of it, or says where in its own modules it was."""
    if is_ready or not isinstance(code, int):
        return False
    return code < 0 or (code == 1 and "KeyboardInterrupt" in said and f'File "{_PACKAGE}' not in said)


def list_children(pid: int) -> list[int]:
    return [int(word) for word in read_process(pid, f"task/{pid}/children").split()]


def command_line(pid: int) -> str:
    return read_process(pid, "cmdline").replace(b"\0", b" ").decode(errors="replace")[:200]


def _stacks(process: subprocess.Popen) -> str:
    """The processes that hang, and where the threads of the first one are, as faulthandler writes it."""
    others = [pid for pid in _session(process.pid) if pid != process.pid]
    said = "; ".join(map(command_line, others))
    for pid in others:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.send_signal(signal.SIGABRT)
    with contextlib.suppress(subprocess.TimeoutExpired):
        said += process.communicate(timeout=10)[1][-3000:]
    return said


def _session(number: int) -> list[int]:
    """Living processes of a session."""
    found = []
    for name in filter(str.isdigit, os.listdir("/proc")):
        state, _, _, session = (read_process(name, "stat").rpartition(b")")[2].split() or [b"X"] * 4)[:4]
        if session == b"%d" % number and state not in b"ZX":
            found.append(int(name))
    return found


def attack_all(folder: Path, runs: int, seed: int, minutes: float = 1e9) -> Iterator[tuple[Attack, str]]:
    """Run so many attacks, or so long, or until Ctrl-C; yield those that break a promise, then say how all ended."""
    attacker, rng = Attacker(folder), random.Random(seed)
    end = time.monotonic() + 60 * minutes
    with contextlib.suppress(KeyboardInterrupt):
        for _ in range(runs):
            if time.monotonic() > end:
                break
            attack = attacker.draw(rng)
            why = attacker.attack(attack)
            if why:
                yield attack, why
    print(f"{sum(attacker.ended.values())} attacks with seed {seed}")
    for (kind, code), number in sorted(attacker.ended.items(), key=str):
        print(f"{kind:20} exit code {code!s:25} {number:6}")


def _start() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so long")
    options = parser.parse_args()
    give_children_default_signals()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        for attack, why in attack_all(Path(folder), options.runs, options.seed, options.minutes):
            failures += 1
            print(f"{attack.name}, {attack.kind}, at {attack.share:.3f} of its time: {why}", flush=True)
    print(f"{failures} failures")
    return failures > 0


if __name__ == "__main__":
    sys.exit(_start())
