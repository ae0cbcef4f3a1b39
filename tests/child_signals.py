"""Signals that processes started by the tests must not inherit.

`nohup make test &` and some CI start everything with SIGINT or SIGHUP ignored. A child inherits that, and wavebatch
rightly leaves an ignored signal alone: a test that interrupts a child would then wait for nothing. A signal with a
handler is reset to its default in a child, so an ignored one gets a handler that does nothing.
Called by conftest, by the fuzzer and by the attacker.
"""

import signal


def give_children_default_signals():
    """Signals that this process ignores stay without effect here, and have their default effect in its children."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
