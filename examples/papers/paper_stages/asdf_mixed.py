"""An ASDF with a fit only where detectors disagree: the shortcut of Wagner et al. (docs/algorithms.md 1.1)."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np

from wavebatch import EchoTable, Noise, SystemPulse, WaveformBlock, stage
from wavebatch.stages.chain import Range
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.decompose.loops import asdf_only, need_asdf
from wavebatch.stages.decompose.merge import join_tables
from wavebatch.stages.decompose.solve import fit_gaussian
from wavebatch.stages.detect.maximum import maximum


@stage("decompose", fits=fit_gaussian, check=need_asdf)
def asdf_mixed(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    describe: Literal["samples", "detector"] = "samples",
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
) -> EchoTable:  # fmt: skip
    """Echoes as `decompose.asdf_only` has them where `detect.maximum` agrees with the detector, else fitted Gaussians.

    They disagree where their numbers of echoes differ, or a time.

    Parameters
    ----------
    describe : {"samples", "detector"}
        As for `decompose.asdf_only`.
    tolerance : float
        Largest distance in time of echoes that agree [widths of the system pulse].

    References
    ----------
    Wagner et al. (2007); docs/algorithms.md 1.1.
    """
    quick = asdf_only(block, noise, system, echoes, describe=describe)
    maxima = maximum(block, noise, system)
    differ = _disagree(len(block), maxima, quick, tolerance * system.sigma_ref)
    rows = np.flatnonzero(differ)
    chosen = maxima.take(np.flatnonzero(differ[maxima.waveform]))
    chosen = replace(chosen, waveform=np.searchsorted(rows, chosen.waveform).astype(np.int32))
    fitted = gaussian(block.rows(rows), noise.rows(rows), system, chosen)
    agreed = quick.take(np.flatnonzero(~differ[quick.waveform]))
    return join_tables(agreed, replace(fitted, waveform=rows[fitted.waveform].astype(np.int32)))


def _disagree(n: int, first: EchoTable, second: EchoTable, tolerance: float) -> np.ndarray:
    """Find waveforms in which two tables have different numbers of echoes, or one at a different time."""
    differ = first.count(n) != second.count(n)
    a, b = (table.take(np.flatnonzero(~differ[table.waveform])) for table in (first, second))
    differ[a.waveform[np.abs(a.time - b.time) > tolerance]] = True
    return differ
