"""Time of tasks: of a processor and by the clock, each for itself."""

import time

from wavebatch.core.process import Seconds


def test_waiting_is_no_time_of_a_processor(monkeypatch):
    processor, wall = iter([10.0, 10.5]), iter([100.0, 103.0])
    monkeypatch.setattr(time, "process_time", lambda: next(processor))
    monkeypatch.setattr(time, "perf_counter", lambda: next(wall))
    start = Seconds.now()
    assert Seconds.now() - start == Seconds(0.5, 3.0)
    assert Seconds(0.5, 3.0) + Seconds(1.0, 1.0) == Seconds(1.5, 4.0)
