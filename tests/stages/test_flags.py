"""Flags that depend on what became of the other echoes of a fit."""

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.stages.flags import clear_lone


def test_an_echo_whose_companions_are_gone_is_not_overlapped():
    overlapped, merged = int(EchoFlag.OVERLAPPED), int(EchoFlag.MERGED)
    waveform = np.array([0, 1, 1, 2, 3, 3])
    flags = np.array([overlapped, overlapped, overlapped, overlapped | merged, 0, overlapped | 1])
    one = np.ones(6)
    table = EchoTable.build(waveform, np.arange(6.0), one, one, flags=flags)
    assert clear_lone(table).flags.tolist() == [0, overlapped, overlapped, overlapped | merged, 0, 1]
    assert table.flags.tolist() == flags.tolist()
    assert len(clear_lone(EchoTable.empty())) == 0
