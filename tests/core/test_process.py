"""Time of tasks: of a processor and by the clock, each for itself."""

import time

from wavebatch.core.process import Seconds


def test_waiting_is_no_time_of_a_processor():
    start = Seconds.now()
    time.sleep(0.1)
    spent = Seconds.now() - start
    assert 0 <= spent.processor < 0.1 <= spent.wall
    assert Seconds(0.5, 3.0) + Seconds(1.0, 1.0) == Seconds(1.5, 4.0)
