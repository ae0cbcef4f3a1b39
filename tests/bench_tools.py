"""The bench without processes of its own, for tests that do not look at its times."""


class _Here:
    """In place of a worker process: it makes the calls in this one."""

    def call(self, function, *arguments):
        return function(*arguments)

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass


def time_here(patch):
    """Let the bench time chains in this process; `patch` is a pytest.MonkeyPatch."""
    for module in ("wavebatch.tools.bench.command", "bench.peers"):
        patch.setattr(f"{module}.Worker", _Here)
