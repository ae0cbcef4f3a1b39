"""The attacker of `tests/attacking.py`: it sees what it looks for, and some attacks break no promise."""

import os
import re
import signal
import sys
import textwrap
import time

import attacking
import pytest
from attacking import Attack, Attacker

import wavebatch

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="looks at processes through /proc")


@pytest.fixture(scope="module")
def attacker(tmp_path_factory):
    return Attacker(tmp_path_factory.mktemp("attack"))


class Planted(Attacker):
    """Runs a program in place of `survey`; undisturbed it would write `a.toml`."""

    def __init__(self, like, code):
        self.__dict__.update(like.__dict__, sound={"survey": {"a.toml": b"whole"}}, seconds={"survey": 0.0}, code=code)

    def _words(self, name, out):
        program = f"""
            import os, pathlib, signal, subprocess, sys, time
            out = pathlib.Path(sys.argv[-1]); out.mkdir(exist_ok=True)
            signal.signal(signal.SIGTERM, lambda *_: None)
            sys.exit = lambda code: (sys.stderr.flush(), os._exit(code))  # Python dies of a signal as it ends
            {self.code}
        """
        return [sys.executable, "-c", textwrap.dedent(program), "spawn_main", str(out)]

    def _start(self, *places):
        """The process, once it does not die of the signal: on a busy machine that takes a while."""
        process, deadline = super()._start(*places), time.monotonic() + 300
        while process.poll() is None and not attacking._handles_signals(process.pid):
            assert time.monotonic() < deadline, "the program does not begin"
            time.sleep(0.01)
        return process


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("sys.exit(7)", "exit code 7"),
        ("time.sleep(60), time.sleep(60)", "hangs"),
        ("(out / 'a.toml').write_text('who'); sys.exit(130)", "not `interrupted`"),
        ("(out / 'a.toml').write_text('who'); print('interrupted', file=sys.stderr); sys.exit(130)", "is not that of"),
        ("(out / '.x.tmp').write_text(''); print('interrupted', file=sys.stderr); sys.exit(130)", "leaves"),
        ("print('interrupted', file=sys.stderr); open(os.environ['TMPDIR'] + '/x', 'w'); sys.exit(130)", "in TMPDIR"),
        ("sys.exit(0)", "missing"),
        ("subprocess.Popen(['sleep', '60'], stderr=subprocess.DEVNULL); (out / 'a.toml').write_text('whole')", "stay"),
        ("(out / 'a.toml').write_text('whole')", "cannot be run again|other bytes"),
    ],
)
def test_the_attacker_sees_every_kind_of_failure(attacker, code, why):
    planted = Planted(attacker, code)
    planted.longest = 3.0 if why == "hangs" else attacker.longest
    planted.stay = 1.0 if why == "stay" else attacker.stay
    assert re.search(why, planted.attack(Attack("survey", "TERM", 0.3)))


_OWN = 'Traceback (most recent call last):\n  File "<frozen abc>", line 48, in <module>\nKeyboardInterrupt\n'
_OURS = _OWN.replace("<frozen abc>", os.path.join(os.path.dirname(wavebatch.__file__), "core", "memory.py"))


@pytest.mark.parametrize(
    ("is_ready", "code", "said", "expected"),
    [
        (False, -2, "", True),
        (False, 1, _OWN, True),
        (False, 1, _OURS, False),
        (False, 1, "error: no", False),
        (False, 0, "", False),
        (False, "hangs", "", False),
        (True, 1, _OWN, False),
        (True, -2, "", False),
    ],
)
def test_only_what_python_says_before_our_code_runs_is_no_failure(attacker, is_ready, code, said, expected):
    assert attacking.has_not_begun(is_ready, code, said) is expected
    if not expected and code not in (0, "hangs"):
        assert attacker._judge_end(Attack("run, 1 job", "INT", 0.1), is_ready, code, said)


@pytest.mark.parametrize(("code", "said", "fails"), [(-9, _OWN, False), (-9, _OURS, True), (130, _OWN, True)])
def test_python_may_say_that_the_parent_of_a_new_worker_was_killed(attacker, code, said, fails):
    assert bool(attacker._judge_end(Attack("run, flight", "INT KILL", 0.1), True, code, said)) is fails


@pytest.mark.slow
def test_attacks_break_no_promise(tmp_path):
    seed = int(os.environ.get("FUZZ_SEED", "1"))
    assert list(attacking.attack_all(tmp_path, 25, seed)) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", attacking.ATTACKS)
def test_every_kind_of_attack_on_a_batch(attacker, kind):
    for name, share in (("run, neighbours", 0.7), ("run, flight", 0.5)):
        assert attacker.attack(Attack(name, kind, share)) == ""


def test_attacks_are_those_of_the_document():
    assert {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL} == set().union(*attacking.SIGNALS.values())
