"""How well chains find the simulated echoes: groups of waveforms with their truth, and the figures over all groups.

`command` and tests/bench make groups and add what a chain found to AccuracyTally. Each group has one seed and survey,
because the survey of a strip is a source of error too. The error of a figure is that of the difference of two runs with
other seeds, because that is what a reader compares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoTable, without_nan
from wavebatch.core.frozen import frozen
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.signal import SMOOTH_GAIN
from wavebatch.stages.score import ISOLATED, QUANTITIES, find_isolated_echoes, list_pairs, match_echoes
from wavebatch.surveying import survey_block
from wavebatch.surveying.systems.survey_result import Survey
from wavebatch.tools.simulate import Scene, simulate_blocks
from wavebatch.tools.simulate.render import Recording, full_sigma, paint_echoes

NOTHING = float("nan")

SURVEY_SCATTER = 0.05
"""Relative scatter of an rms error between strips that differ only in their survey, measured on 16 strips with a
learned pulse. At least this much is assumed, because a few groups can miss it by chance."""

OUTLIER = 10.0
"""Error of the worst echo of another run, in units of the root mean square."""


@frozen
class Estimate:
    """A value and its error: the standard error of the difference between two runs that differ in their seed.

    That is 1.41 times the standard error of the value, which is the larger of two estimates: from the scatter of single
    waveforms, and from the scatter of the groups, which are simulated and surveyed separately.
    """

    value: float = NOTHING
    error: float = NOTHING

    def to_json(self) -> dict[str, Any]:
        """Value and error; None where there were no data."""
        return without_nan(asdict(self))


def share_figure(part: np.ndarray, whole: np.ndarray, group: np.ndarray) -> Estimate:
    """Sum of `part` over that of `whole`, counts per waveform (n,) in groups (n,), as a figure.

    Shares near 0 or 1 keep the error that two counts more or less would make (Agresti and Coull 1998).
    """
    total = float(whole.sum())
    if not total:
        return Estimate()
    value = float(part.sum()) / total
    error = _standard_error((part - value * whole) / total, group)
    drawn = (total * value + 2) / (total + 4)
    return Estimate(value, float(np.sqrt(2) * max(error, np.sqrt(drawn * (1 - drawn) / (total + 4)))))


def root_mean_square(values: np.ndarray, waveform: np.ndarray, group: np.ndarray) -> Estimate:
    """Root mean square of values (m,) of echoes of the given waveforms (m,), unique over all groups, as a figure.

    The error includes the scatter of surveys, and one more echo OUTLIER times as bad as the others.
    """
    if len(values) < 2:
        return Estimate()
    squares = np.square(values.astype(np.float64))
    mean = float(squares.mean())
    if not mean:
        return Estimate(0.0, 0.0)
    influence = (squares - mean) / (2 * np.sqrt(mean) * len(squares))
    _, place, where = np.unique(waveform, return_index=True, return_inverse=True)
    per_waveform = np.bincount(where, influence)
    error = _standard_error(per_waveform, group[place])
    rare = np.sqrt(mean) * (np.sqrt(1 + OUTLIER**2 / len(squares)) - 1)
    surveys = SURVEY_SCATTER * np.sqrt(mean / len(np.unique(group)))
    return Estimate(float(np.sqrt(mean)), float(np.hypot(np.sqrt(2) * max(error, surveys), rare)))


def _standard_error(influence: np.ndarray, group: np.ndarray) -> float:
    """Standard error of an estimate from the contribution of each independent waveform, (n,)."""
    single = float(np.sqrt(np.square(influence).sum()))
    sums = np.bincount(group, influence)[np.unique(group)]
    g = len(sums)
    if g < 4:
        return single
    # The scatter of few groups is itself uncertain: the standard deviation of Student's t with g - 1 degrees.
    return max(single, float(np.sqrt(g / (g - 3) * np.square(sums).sum())))


def median_range(values: list[float]) -> dict[str, Any]:
    """Median, least, most and number of repeated measurements; None without any."""
    found = [float(measure(values)) if values else None for measure in (np.median, min, max)]
    return {**dict(zip(("median", "min", "max"), found, strict=True)), "repeats": len(values)}


def find_front(costs: Sequence[Sequence[float | None]]) -> np.ndarray:
    """Pareto front: True for the rows of costs (n, k) that no other row beats.

    A row beats another if it is as good in all columns and better in one. Rows with an unknown cost (None or NaN) are
    never on the front.
    """
    values = np.array(costs, np.float64)
    known = np.isfinite(values).all(axis=1)
    no_worse = (values[:, None, :] <= values[None, :, :]).all(axis=2)
    better = (values[:, None, :] < values[None, :, :]).any(axis=2)
    return known & ~(no_worse & better & known[:, None]).any(axis=0)


def choose_cheapest(rows: Sequence[Mapping], tolerance_cm: float) -> Mapping | None:
    """The row of least time per waveform whose isolated echoes, their error added, meet the tolerance; None if none.

    rows: as in the document of the benchmark.
    """
    good = []
    for row in rows:
        error = row["figures"]["rmse_isolated_cm"]
        known = row["kernels"]["median"] is not None and error["value"] is not None
        if known and error["value"] + (error["error"] or 0) <= tolerance_cm:
            good.append(row)
    return min(good, key=lambda row: (row["kernels"]["median"], row["name"]), default=None)


_STEP = 0.02
"""Step of the numeric derivatives, in widths of the system pulse."""


def smoothed_power(color: np.ndarray | int) -> np.ndarray | float:
    """Variance of noise smoothed by [1 2 1], over that of its samples; color: as Recording.color."""
    first, second = color / (color + 1), color * (color - 1) / ((color + 1) * (color + 2))
    return 6 + 8 * first + 2 * second


def find_bounds(recording: Recording, truth: EchoTable, n: int) -> np.ndarray:
    """Cramer-Rao bounds of time [ns], amplitude [DN] and sigma [ns] of every true echo, (m, 3).

    All echoes of a waveform are estimated together, the baseline is known; clipped samples have no weight, noise grows
    with the signal. truth: as tools.simulate gives it; the bounds are those of the widths of `make_groups`, infinite
    where the samples do not determine them. Source: inverse Fisher matrix, derivatives of the painted pulse by central
    differences.
    """
    if not len(truth):
        return np.empty((0, 3))
    # Derivatives of each echo alone by time, amplitude and sigma, (m, 3, s).
    each = np.arange(len(truth))
    amplitude, sigma = truth.amplitude.astype(np.float64), truth.sigma.astype(np.float64)
    paint = partial(paint_echoes, recording, len(truth), each)
    step = _STEP * recording.pulse.sigma
    echo = paint(truth.time, amplitude, sigma)
    later, earlier = (paint(truth.time + away, amplitude, sigma) for away in (step, -step))
    by_time = (later - earlier) / (2 * step)
    wider, narrower = sigma + step, sigma - step
    grown = full_sigma(recording.pulse, wider) - full_sigma(recording.pulse, narrower)
    broad, sharp = (paint(truth.time, amplitude, width) for width in (wider, narrower))
    by_sigma = (broad - sharp) / np.maximum(grown, 1e-9)[:, None]
    columns = np.stack([by_time, echo / amplitude[:, None], by_sigma], axis=1).astype(np.float64)
    # Samples count by their inverse standard deviation; clipped ones do not.
    signal = np.zeros((n, recording.n_samples))
    np.add.at(signal, truth.waveform, echo)
    # White noise that disturbs an echo as much as the recorded noise. Coloured noise: std of the [1 2 1]/4-smoothed
    # samples over the gain for white noise (docs/algorithms.md H11).
    smoothed = np.sqrt(smoothed_power(recording.color) / 16) / SMOOTH_GAIN
    noise = float(np.hypot(recording.noise_std * smoothed, QUANTISATION_STD))
    variance = noise**2 + recording.noise_gain * np.maximum(signal, 0)
    weight = np.where(signal + recording.baseline < recording.clip, 1 / np.sqrt(variance), 0.0)
    columns *= weight[truth.waveform][:, None, :]
    bounds = np.full((len(truth), 3), np.inf)
    count = truth.count(n)
    first = np.cumsum(count) - count
    for k in np.unique(count[count > 0]):
        rows = first[count == k][:, None] + np.arange(k)
        # Standard deviations from weighted derivatives (g, p, s).
        part = columns[rows].reshape(len(rows), 3 * k, -1)
        scale = np.sqrt(np.square(part).sum(axis=2))
        part = part / np.where(scale > 0, scale, 1.0)[:, :, None]
        values, vectors = np.linalg.eigh(part @ part.transpose(0, 2, 1))
        # Scaled columns: the diagonal is 1, so that eigenvalues show how well the parameters can be separated.
        values = np.where(values > 1e-11, values, np.nan)
        variance = (np.square(vectors) / values[:, None, :]).sum(axis=2)
        known = ~np.isnan(variance) & (scale > 0)
        error = np.sqrt(np.where(known, variance, 1.0)) / np.where(scale > 0, scale, 1.0)
        bounds[rows] = np.where(known, error, np.inf).reshape(len(rows), k, 3)
    return bounds


CLEAR_SNR = 10.0
"""Signal to noise from which the error of an echo is compared with its bound."""

GROSS = 10.0
"""Errors above this many bounds are gross: they are counted, but left out of error/bound."""

SCENE_GROUPS = 8
"""Groups of a scene; each has one survey, like the strips of a project."""

CM_PER_NS = 100 * HALF_C


@frozen(eq=False)
class Group:
    """Waveforms of one seed, their truth, and their survey."""

    number: int
    block: WaveformBlock
    truth: EchoTable
    """In the terms of found echoes, see `make_groups`."""
    isolated: np.ndarray
    """Echoes without a close neighbour, bool (m,)."""
    bounds: np.ndarray
    """Cramer-Rao bounds of time, amplitude and sigma, (m, 3)."""
    survey: Survey
    clear: np.ndarray
    """Echoes strong enough to compare their error with the bound, bool (m,)."""

    @property
    def system(self) -> SystemPulse:
        """The system pulse of the survey."""
        return self.survey.system

    def cut(self, n: int) -> Group:
        """The first n waveforms."""
        m = int(np.searchsorted(self.truth.waveform, n))
        columns = {name: getattr(self, name)[:m] for name in ("isolated", "bounds", "clear")}
        return replace(self, block=self.block.rows(slice(0, n)), truth=self.truth.take(np.arange(m)), **columns)


def derive_seed(*numbers: int) -> int:
    """A seed that depends on all of the numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def make_groups(
    scene: Scene, waveforms: int, seed: int, progress: Callable[[str], None] = lambda text: None
) -> list[Group]:
    """`waveforms` waveforms of the scene in SCENE_GROUPS groups, each with another seed and survey."""
    size = max(waveforms // SCENE_GROUPS, 1)
    groups = []
    for place in range(SCENE_GROUPS):
        progress(f"{scene.name}: simulating and surveying, group {place + 1} of {SCENE_GROUPS}")
        ((block, truth),) = simulate_blocks(scene, size, seed=derive_seed(seed, place), size=size)
        groups.append(make_group(scene, place, block, truth, survey_block(block)))
    return groups


def make_group(
    scene: Scene, number: int, block: WaveformBlock, truth: EchoTable, survey: Survey, *, clear: float = CLEAR_SNR
) -> Group:
    """The group of a simulated block and its survey; clear: signal to noise from which echoes are compared.

    Simulation gives the sigma of the main lobe; decomposers report that of the whole pulse. So the truth of the group
    has, as sigma, the full width at half maximum over 2.354820. For a Gaussian they are equal.
    """
    recording = scene.recording
    sigma = full_sigma(recording.pulse, truth.sigma.astype(np.float64))
    return Group(
        number=number,
        block=block,
        truth=replace(truth, sigma=sigma.astype(np.float32)),
        isolated=find_isolated_echoes(truth),
        bounds=find_bounds(recording, truth, len(block)),
        survey=survey,
        clear=truth.amplitude >= clear * recording.recorded_noise,
    )


def find_hidden(truth: EchoTable, matched: np.ndarray) -> np.ndarray:
    """Which true echoes (m,) have a neighbour within ISOLATED widths that was not found, so that one echo holds both.

    matched: the true echoes that were found, bool (m,).
    """
    seen, lost = np.flatnonzero(matched), np.flatnonzero(~matched)
    sigma = truth.sigma.astype(np.float64)
    reach = ISOLATED * sigma.max(initial=0.0)
    row, other = list_pairs(truth.waveform[seen], truth.time[seen], truth.waveform[lost], truth.time[lost], reach)
    row, other = seen[row], lost[other]
    near = np.abs(truth.time[row] - truth.time[other]) < ISOLATED * np.maximum(sigma[row], sigma[other])
    hidden = np.zeros(len(truth), bool)
    hidden[row[near]] = True
    return hidden


@dataclass(slots=True)
class AccuracyTally:
    """Collects the echoes found in groups; `figures` summarises them."""

    waveforms: int = 0
    """Number of waveforms added."""
    _waveforms: list[dict[str, np.ndarray]] = field(default_factory=list)
    _echoes: list[dict[str, np.ndarray]] = field(default_factory=list)

    def add(self, group: Group, found: EchoTable) -> None:
        """Adds the echoes found in the waveforms of a group: with echo_width, if they have it, as 2.354820 sigma."""
        if "echo_width" in found.attributes:
            factor, ends = np.float32(1 / FWHM_PER_SIGMA), ("", "_err")
            found = replace(found, **{f"sigma{end}": found.attributes[f"echo_width{end}"] * factor for end in ends})
        n, truth = len(group.block), group.truth
        match = match_echoes(found, truth)
        matched = np.zeros(len(truth), bool)
        matched[match.truth] = True
        counts = {"true": truth.count(n), "found": found.count(n), "group": np.full(n, group.number)}
        counts["matched"] = np.bincount(truth.waveform[matched], minlength=n)
        for kind, rows in (("isolated", group.isolated), ("overlapped", ~group.isolated)):
            counts[kind] = np.bincount(truth.waveform[rows], minlength=n)
            counts[f"{kind}_matched"] = np.bincount(truth.waveform[rows & matched], minlength=n)
        self._waveforms.append(counts)
        part = {
            "waveform": truth.waveform[match.truth].astype(np.int64) + self.waveforms,
            "group": np.full(len(match.truth), group.number),
            "isolated": group.isolated[match.truth],
            "clear": group.clear[match.truth],
            "flagged": (found.flags[match.found] & np.uint16(UNCLEAN)) != 0,
            "hidden": find_hidden(truth, matched)[match.truth],
        }
        for place, name in enumerate(QUANTITIES):
            error = getattr(found, name)[match.found].astype(np.float64) - getattr(truth, name)[match.truth]
            reported = getattr(found, f"{name}_err")[match.found].astype(np.float64)
            part[name] = error
            part[f"{name}_ratio"] = error / group.bounds[match.truth, place]
            part[f"{name}_scaled"] = error / np.where(reported > 0, reported, np.nan)
        self._echoes.append(part)
        self.waveforms += n

    def figures(self) -> dict[str, Estimate]:
        """Every figure by name: shares as fractions, lengths in cm of range, the others without unit."""
        w, e = ({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
                for parts in (self._waveforms, self._echoes))  # fmt: skip
        group, true, found = w["group"], w["true"], w["found"]
        one, none = true == 1, true == 0
        figures = {
            "completeness": share_figure(w["matched"], true, group),
            "correctness": share_figure(w["matched"], found * true.any(), group),
            "exact_count": share_figure(found == true, np.ones(len(true)), group),
            "false_splits": share_figure(one & (found > 1), one, group),
            "false_alarms": share_figure(none & (found > 0), none, group),
            "found_isolated": share_figure(w["isolated_matched"], w["isolated"], group),
            "found_overlapped": share_figure(w["overlapped_matched"], w["overlapped"], group),
            "wrong": share_figure(true + found - 2 * w["matched"], (true + found) * true.any(), group),
        }
        every = np.ones(len(e["time"]), bool)
        for kind, rows in (("all", every), ("isolated", e["isolated"]), ("overlapped", ~e["isolated"])):
            found_ns = _spread(e, "time", rows)
            figures[f"rmse_{kind}_cm"] = Estimate(found_ns.value * CM_PER_NS, found_ns.error * CM_PER_NS)
            if kind == "all":
                continue
            clear = rows & e["clear"]
            ratios = np.stack([e[f"{name}_ratio"] for name in QUANTITIES])
            gross = np.abs(ratios).max(axis=0) > GROSS
            figures[f"gross_{kind}"] = share_figure(clear & gross, clear, e["group"])
            for name in QUANTITIES:
                figures[f"{name}_ratio_{kind}"] = _spread(e, f"{name}_ratio", clear & ~gross)
                known = np.isfinite(e[f"{name}_scaled"])
                figures[f"{name}_calibration_{kind}"] = _spread(e, f"{name}_scaled", clear & ~gross & known)
        known = e["clear"] & np.isfinite(e["time_scaled"])
        figures["hidden"] = share_figure(known & e["hidden"], known, e["group"])
        for kind in ("flagged", "hidden"):
            for name, rows in ((kind, e[kind]), (f"not_{kind}", ~e[kind])):
                figures[f"time_calibration_{name}"] = _spread(e, "time_scaled", known & rows)
        return figures


def _spread(echoes: Mapping[str, np.ndarray], name: str, rows: np.ndarray) -> Estimate:
    return root_mean_square(echoes[name][rows], echoes["waveform"][rows], echoes["group"][rows])
