"""The attacker of `tests/attacking.py`: it sees what it looks for, and some attacks break no promise."""

import os
import re
import sys
import textwrap

import attacking
import pytest
from attacking import Attack, Attacker
from batch_tools import wait_until

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
        process = super()._start(*places)
        wait_until(lambda: process.poll() is not None or attacking.handles_signals(process.pid))
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


@pytest.mark.slow
def test_attacks_break_no_promise(tmp_path):
    seed = int(os.environ.get("FUZZ_SEED", "1"))
    assert list(attacking.attack_all(tmp_path, 25, seed)) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", attacking.ATTACKS)
def test_every_kind_of_attack_on_a_batch(attacker, kind):
    for name, share in (("run, neighbours", 0.7), ("run, flight", 0.5)):
        assert attacker.attack(Attack(name, kind, share)) == ""
