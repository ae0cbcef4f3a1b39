"""The energies of a strip's pulses beside those of its calibration, and what the strip's own light says of both.

`prepare` and `strip_echoes` call `take_energies` once per strip. What a strip lacks against its calibration goes into
the errors: the scatter of energies that are not logged, a log that drifts alone, two lasers without a mark.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import even_places, known_median, robust_std
from wavebatch.core.units import MEDIAN_ERROR
from wavebatch.files.pulse_energy import COLUMN, LEAST_KNOWN, LEAST_SHARE, PulseEnergy, find_column, find_pulse_energy
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.kernels.physics.radiometry import judge_energies
from wavebatch.surveying.calibration import CHANGE_CHANCE, Calibration
from wavebatch.surveying.matching.setting import (
    BORDER,
    CELLS,
    LEAST_CELLS,
    QUANTILES,
    SCANNERS,
    compare_scenes,
    cut_cells,
    find_growth_in_cells,
    take_off_level,
    weigh_alike,
)

OTHER_UNIT = 3.0
"""Ratio of mean energies from which a log is in another unit: lasers lose a half of their energy at most."""

NEIGHBOURS, MOST_SAMPLES, BLOCK = 16384, 4_000_000, 2048
"""Neighbouring pulses whose light is compared: some 20 scan lines of usual sensors; samples that they have at most, and
waveforms that are read at a time."""

MEMORIES, SURE, HELD = (16, 64, 256, 1024), 3.0, 2.0
"""Pulses before and after one, whose light shows a receiver that follows it; errors from which it does (real strips and
sound scenes stay below 2); and by how much its gain varies more than these show: 1 to 3 times in simulated strips."""

SAME_TOP, SURFACES = 0.84, 0.6
"""Share of the packets whose one brightest sample is the same number where each packet was scaled, which noise does not
leave: one, since two are the same also where even ground is weak or clipped; and by how much surfaces of one strip
differ in brightness: real and simulated ones by 0.1 to 0.9 (robust standard deviation of the logarithm)."""

LEAST_APART, SURE_TURNS, ALIKE_TURNS, CYCLES = 0.04, 6.0, 0.7, 4
"""Light takes turns where that of two lasers differs by more than the first (logarithm), and by so many errors in cells
of either size: the strongest period counts, so that sound scenes reach 4, rows of plants 5.3, and 12 in one size;
by how much as in larger cells it does in smaller ones, where ground that swings gradually shows half; and fewest
periods that show it."""

BESIDE_STEP, LEAST_LINES, SHORT_LINE, MOST_OFF = 3, 16, 16, 0.05
"""Pulses in the means on both sides of a step of light at one place of all scan lines; fewest lines that show it;
fewest pulses of a line, in such means; and share of a line by which its middle may be off even time (median)."""

SURE_STEP, OTHER_STEPS, LEAST_STEP, MOST_STEP, PARTS = 4.0, 2.0, 0.08, 0.7, 3
"""Lasers take turns where the step is larger than the first times its error; than the second times the steps at all
other places, as of fields along the flight; and between the next two (logarithm): ground that swings within 10 m bends
by 0.05, and surfaces differ by more than a factor of 2, which two lasers do not. Each of so many parts of the lines
must show half of it. Of 320 simulated sound strips 2 had one without the first condition, and none of 800 with it."""

PAIR, OF_GROUND, OF_LIGHT = 2, 0.6, 0.5
"""Mean number of pulses in the small cells that show whether a log is that of echoes: two of its values in one cell
differ by less than this share of what others as far apart in time do (0.1 to 0.25, 0.6 over even ground; logs of lasers
0.8 to 1), and light over it varies by less than this share of what light does (0.03 to 0.45; logs of lasers 0.7 to 1,
less over even ground)."""

LEAST_COMPARED = 200
"""Pulses that show either."""

PLACES, OF_PLACE, LEAST_PLACES, SMOOTH = 32, 128, 8, 5
"""Places along the strip at which slow changes of the log are compared with light, pulses at each, and the fewest; and
places in the mean that stands for slow changes."""

LEAST_SAID, STUCK = 0.01, 0.9
"""Smaller errors are not named; and the scatter of a log over that of the calibration's from which it does not stand
still: samples of one laser's pulses agree within some per cent."""


@frozen
class StripEnergies:
    """What is known of the energies of a strip's pulses."""

    energy: PulseEnergy | None
    """None where nothing is."""
    shot_error: float = 0.0
    """Scatter from shot to shot that the calibration's energies held and the strip's do not, relative."""
    growth: float = 0.0
    """Error of the strip's level, relative."""
    notes: tuple[str, ...] = ()

    def widen(self, calibration: Calibration) -> Calibration:
        """Return a calibration with these errors."""
        rows = (replace(row, shot_energy=math.hypot(row.shot_energy, self.shot_error)) for row in calibration.channels)
        return replace(calibration, channels=tuple(rows)).widened(self.growth)

    def describe(self) -> dict[str, Any]:
        """Return the fields of a Calibration that say what it was measured with."""
        sent = self.energy
        if sent is None:
            return {}
        mean, names = sent.reference or sent.mean, {"energy_source": sent.source, "energy_unit": sent.unit}
        return {"energy_mean": mean, "energy_spread": sent.shots, **names}


def take_energies(
    reader: StripReader, scan: StripScan, request: str | None, calibration: Calibration | None = None
) -> StripEnergies:
    """Find the energies of a strip's pulses, and compare them with its light and its calibration.

    Parameters
    ----------
    reader : StripReader
    scan : StripScan
    request : str or None
        As `find_pulse_energy`.
    calibration : Calibration, optional
        That the strip runs with, or of the strip that was calibrated before it in one flight.

    Returns
    -------
    StripEnergies
        Energies count relative to the mean of the calibration, or of the strip where the calibration has none.

    Raises
    ------
    InputError
        Where the energies cannot be read, contradict the strip's light, or are in another unit than the calibration's.

    Notes
    -----
    docs/algorithms.md 5.2.
    """
    energy, notes = find_pulse_energy(reader, scan, request), []
    pulses = np.empty((7, 0))
    if reader.unit_count():  # the middle of the strip
        unit = reader.read_unit(reader.unit_count() // 2, scan)
        rows = np.flatnonzero(unit.packets.owned)[:NEIGHBOURS]
        pulses = _join(reader, unit, rows[np.cumsum(unit.packets.n_samples[rows]) <= MOST_SAMPLES], energy)
    growth = noise = 0.0
    if energy is not None and request is not None:
        doubt, noise = judge_energies(pulses[1], pulses[2])
        if _is_of_echoes(pulses):
            doubt = "they are alike where the ground is, as amplitudes of echoes are, not energies of emitted pulses"
        if doubt:
            raise InputError(
                f"{reader.facts.path}: --energy {energy.source} contradicts the strip: {doubt}; check its times, or "
                "leave it out"
            )
        growth = _compare_drift(_read_places(reader, scan, energy), energy.shots)
        if growth > LEAST_SAID:
            notes.append(
                f"--energy {energy.source}: its slow changes along the strip are not proved by the strip's brightness: "
                f"the error of the constant grows by {100 * growth:.1f} %"
            )
    elif energy is None and request is None and find_column(reader, COLUMN) is not None:
        notes.append(
            f"{COLUMN}: fewer than {LEAST_KNOWN} of the sampled pulses have one, so that none counts: what energies "
            "vary from shot to shot is in amplitudes, and not in their errors"
        )
    elif energy is not None and energy.known < 1.0:
        chance = CHANGE_CHANCE if calibration is None else calibration.change_chance
        places = _read_places(reader, scan, replace(energy, fills=None))
        more, alone = _compare_unknown(np.concatenate([np.empty((7, 0)), *places], axis=1), chance)
        energy = replace(energy, fills=math.hypot(energy.fills or 0.0, more))
        found = f"by their light beside that of the others, {100 * more:.1f} % of error hold it"
        others = (
            f"{alone:.0%} of all are not compared, because their digitizer has too few of known energy, and their "
            "error holds only how the known energies vary"
        )
        said = [text for text, told in ((found, more > LEAST_SAID), (others, alone > LEAST_SAID)) if told]
        if said:
            remedy = f"; --energy {energy.source} gives them no values" if energy.known >= LEAST_SHARE else ""
            notes.append(
                f"{energy.source}: {1.0 - energy.known:.0%} of the pulses have none and count as of mean energy: "
                f"{'; '.join(said)}{remedy}"
            )
    follows, apart, period = _find_gains(pulses)
    if follows:
        notes.append(
            "the gain of the receiver follows the light of the last pulses, or packets were scaled one by one: light "
            f"varies by it: {100 * follows:.0f} % of error of calibrated values, and none of amplitudes, though both "
            "may be off by more; give the gain of each pulse as --energy"
        )
        growth = math.hypot(growth, follows)
    if apart:
        notes.append(
            f"light alternates by a factor of {math.exp(-apart):.2f} within about {period} pulses of a channel, as of "
            f"two lasers or gains without a mark: {100 * math.expm1(apart):.0f} % of error of calibrated values; give "
            "--energy"
        )
        growth = math.hypot(growth, math.expm1(apart))  # any target may be that of one of them
    # An error of the log from shot to shot that was not in the calibration's.
    measured = max((row.shot_energy for row in calibration.channels), default=0.0) if calibration else 0.0
    noise, lacks = math.sqrt(max(noise * energy.shots**2 - measured**2, 0.0)) if energy else 0.0, 0.0
    if calibration is not None:
        known = calibration.energy_mean
        if energy is not None and known is not None:
            ratio = energy.mean / known
            if max(ratio, 1 / ratio) > OTHER_UNIT:
                raise InputError(
                    f"{reader.facts.path}: the mean energy of its pulses is {energy.mean:.4g} ({energy.source}), that "
                    f"of the calibration {known:.4g} {calibration.energy_unit} ({calibration.energy_source}): another "
                    "unit? Then give the calibration's mean in this unit as energy_mean in CAL.toml, or leave "
                    "energies out with --energy none"
                )
            energy = replace(energy, reference=known)
        lacks, note = _compare(energy, calibration)
        notes += [note] if note else []
    if energy is None:
        return StripEnergies(None, lacks, growth, tuple(notes))
    return StripEnergies(replace(energy, missed=math.hypot(lacks, noise)), 0.0, growth, tuple(notes))


def _is_of_echoes(pulses: np.ndarray) -> bool:
    """Whether a log holds the light of echoes: emitted pulses do not know what they will hit; pulses: as `_join`."""
    with np.errstate(invalid="ignore", divide="ignore"):
        pulses = np.concatenate([np.log(pulses[1:3]), pulses[5:]])[:, pulses[3] == pulses[3, :1]]
    light, sent, *place = pulses[:, np.isfinite(pulses).all(axis=0)]
    if len(sent) < LEAST_COMPARED:
        return False
    *_, first, cell, count = cut_cells(np.stack(place), PAIR)
    last = len(cell) - 1 - np.unique(cell[::-1], return_index=True)[1]
    first, last = first[count > 1], last[count > 1]
    if len(first) < LEAST_CELLS:
        return False
    # Earlier and later ones: a laser that fades moves their differences, too.
    later = (np.stack([last + step, last - step]) % len(sent) for step in (0, *MEMORIES[:3]))
    near, *others = (np.median(np.abs(sent[first] - sent[rows])) for rows in later)
    return bool(near < OF_GROUND * max(others) and robust_std(light - sent) < OF_LIGHT * robust_std(light))


def _find_gains(pulses: np.ndarray) -> tuple[float, float, int]:
    """By how much a gain varies that follows the light of the last pulses, or of each, relative; by how much light
    takes turns (logarithm), and after how many pulses; 0 where none is seen; pulses: as `_join`.

    Within small cells of the ground, light is compared with that of the pulses before over that of those after: a scene
    has no direction in time, a receiver has. Lasers take turns after a whole number of pulses, while the pulses of a
    cell are of several scan lines.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        found, turns, light = 0.0, (0.0, 0), pulses[1] / pulses[2]
    for channel in np.unique(pulses[3]):
        own = (pulses[3] == channel) & (light > 0.0) & np.isfinite(light + pulses[[0, 5, 6]]).all(axis=0)
        seen, top, place = light[own], pulses[4, own] / pulses[2, own], pulses[5:, own]
        if len(seen) <= LEAST_COMPARED:
            continue
        if np.median(top) and np.mean(top == np.median(top)) > SAME_TOP:
            found = SURFACES
        whole = np.cumsum(np.append(0.0, seen))
        for size in (memory for memory in MEMORIES if len(seen) > 4 * memory):
            near = whole[size:] - whole[:-size]
            before, after = np.log(near[: -size - 1]), np.log(near[size + 1 :])
            here = np.log(seen[size:-size]), place[:, size:-size]
            for error, slope in islice(find_growth_in_cells(before - after, *here), 1):
                gain = HELD * -2.0 * slope * float(np.std(before))
                found = max(found, gain * (slope < -SURE * error))
        step = np.diff(pulses[0, own])
        usual = float(np.median(step[step > 0.0])) if (step > 0.0).any() else np.inf
        number = np.append(0, np.cumsum(np.minimum(np.rint(step / usual), NEIGHBOURS))).astype(np.int64)
        early = number < 4 * NEIGHBOURS
        number, bright, place = number[early], np.log(seen[early]), place[:, early]
        periods = np.arange(2, number[-1] // CYCLES)
        if not len(periods):
            continue
        *_, cell, count = cut_cells(place, CELLS[1])
        rest = bright - (np.bincount(cell, bright) / count)[cell]
        rest = np.clip(rest, -BORDER * robust_std(rest), BORDER * robust_std(rest))
        lines = np.fft.rfft(np.bincount(number, rest), 8 * NEIGHBOURS)
        rows = np.rint(8 * NEIGHBOURS / periods).astype(np.int64)
        best = int(np.argmax(np.abs(lines[rows])))
        turn = np.sign(np.cos(2.0 * np.pi * number / periods[best] + np.angle(lines[rows[best]])) + 1e-9)
        shown = list(find_growth_in_cells(turn, bright, place))
        least, most = (choose((slope for _, slope in shown), default=0.0) for choose in (min, max))
        if least > ALIKE_TURNS * most and all(slope > SURE_TURNS * error for error, slope in shown):
            turns = max(turns, (2.0 * least, int(periods[best])))
        turns = max(turns, _find_steps(number, bright, place))
    return found, *(turns if turns[0] > LEAST_APART else (0.0, 0))


def _find_steps(number: np.ndarray, bright: np.ndarray, place: np.ndarray) -> tuple[float, int]:
    """By how much light (logarithm) steps up and down at the same places of all scan lines, and the pulses of a line; 0
    where it does not; number: of pulses (n,), in order; place: east and north, f8 (2, n).

    Lasers that take turns two or four times in a line see each place once: no cell of the ground shows them.
    """
    m, nothing = BESIDE_STEP, (0.0, 0)
    time, aside = number - number.mean(), place - place.mean(axis=1, keepdims=True)
    aside = aside - np.outer(aside @ time / (time @ time), time)
    across = np.linalg.eigh(aside @ aside.T)[1][:, 1] @ aside
    middle = number[np.flatnonzero((across[:-1] < 0.0) & (across[1:] >= 0.0))].astype(np.float64)
    if len(middle) <= LEAST_LINES:
        return nothing
    line = np.cumsum(np.append(0.0, np.rint(np.diff(middle) / np.median(np.diff(middle)))))
    size, start = np.polyfit(line, middle, 1).tolist()
    if size < SHORT_LINE * m or np.median(np.abs(middle - start - size * line)) > MOST_OFF * size:
        return nothing
    # A row for each line; its end goes on in the next one.
    row, column = (one.astype(np.int64) for one in divmod(number - start, size))
    n, row = round(size), row - row.min()
    table = np.full((2, row.max() + 1, n + 4 * m + 3), np.nan)
    table[:, row, column] = bright, across
    table[:, :-1, n:] = table[:, 1:, : 4 * m + 3]
    mean = np.lib.stride_tricks.sliding_window_view(table, m, axis=2).mean(axis=3)
    far, before, after, beyond = (mean[:, :, at : at + n] for at in (0, m, 2 * m + 1, 3 * m + 1))
    jump = np.abs(known_median((after - before)[1], 0))
    # Less what slopes do; and where the mirror turns, pulses in a row lie on other ground.
    steps = (after - before)[0] - (m + 1) / (2 * m) * (beyond - after + before - far)[0]
    level = np.where(jump < 2.0 * known_median(jump, 0), known_median(steps, 0), np.nan)
    level[np.convolve(np.isnan(level), np.ones(4 * m + 1), "same") > 0.5] = np.nan
    found = nothing
    for blocks in (2, 4):
        turn, places = np.arange(blocks)[:, None], np.arange(int(size / blocks))
        at, sign = np.rint(places + turn * size / blocks).astype(np.int64) % n, (-1.0) ** turn
        seen = sign * level[at]
        whole = np.nan_to_num(known_median(seen, 0))
        alike = np.fmin.reduce(seen * np.sign(whole), axis=0) > 0.5 * np.abs(whole)
        best = int(np.argmax(np.abs(whole) * alike))
        own = known_median(np.where(np.isnan(seen[:, best]), np.nan, (sign * steps.T[at[:, best]]).T), 1)
        own = own[np.isfinite(own)]
        if len(own) < LEAST_LINES:
            continue
        step, scatter = float(np.median(own)), robust_std(own)
        rest = np.clip(own - step, -BORDER * scatter, BORDER * scatter)
        error = MEDIAN_ERROR * scatter * (weigh_alike(rest) / len(own)) ** 0.5
        apart = np.abs(places - best)
        other = np.abs(whole[np.minimum(apart, size / blocks - apart) > 2 * m + 1]).max()
        least = min(float(np.median(part)) / step for part in np.array_split(own, PARTS)) if step else 0.0
        if max(SURE_STEP * error, OTHER_STEPS * other, LEAST_STEP) < abs(step) < MOST_STEP and least > 0.5:
            found = max(found, (abs(step), round(size)))
    return found


def _compare(energy: PulseEnergy | None, calibration: Calibration) -> tuple[float, str]:
    """Scatter of the energy from shot to shot that nothing of the strip tells, relative: what the calibration had
    beyond that of the strip's own log, so that a log that stands still proves nothing; and the line about it."""
    own, scatter, source = energy.shots if energy else 0.0, calibration.energy_spread, calibration.energy_source
    if calibration.energy_mean is None:
        if energy is None:
            return 0.0, ""
        scatter = max((row.shot_energy for row in calibration.channels), default=0.0)
        return math.sqrt(max(scatter**2 - own**2, 0.0)), (
            f"calibration: measured without the energies of the pulses, this strip has them ({energy.source}): they "
            "count relative to their mean, which may be another than that of the calibration's strip"
        )
    lacks = math.sqrt(max(scatter**2 - own**2, 0.0))
    if energy is None:
        return lacks, (
            f"calibration: measured with the energy of each pulse ({source}), this strip has none: its pulses scatter "
            f"by {100 * lacks:.1f} % from shot to shot, which is in the error"
        )
    line = (
        f"--energy {energy.source}: its values scatter by {100 * own:.1f} % from shot to shot, those of the "
        f"calibration by {100 * scatter:.1f} %: is the log stuck? The rest is in the error"
    )
    return lacks, line if lacks > LEAST_SAID and own < STUCK * scatter else ""


def _join(reader: StripReader, unit: Unit, rows: np.ndarray, energy: PulseEnergy | None) -> np.ndarray:
    """Time, light, energy (1 where nothing is known), channel, brightest sample (0 where several are), its east and
    north of waveforms in the order of time, f8 (7, n)."""
    parts = [np.empty((7, 0))]
    for block, _ in reader.read_rows(unit, rows, BLOCK):
        given = None if energy is None else energy.fill(block, unit).pulse_energy
        sent = np.ones(len(block)) if given is None else given
        channel = np.full(len(block), SCANNERS * block.digitizer.index)
        channel += 0 if block.scanner is None else block.scanner
        above, top = np.nan_to_num(take_off_level(block)), block.samples.max(axis=1)
        alone = (block.samples == top[:, None]).sum(axis=1) == 1
        place = (block.origin + block.direction * (block.spacing * np.argmax(above, axis=1))[:, None]).T[:2]
        parts.append(np.stack([block.gps_time, above.sum(axis=1), sent, channel, top * alone, *place]))
    joined = np.concatenate(parts, axis=1)
    return joined[:, np.argsort(joined[0], kind="stable")]


def _read_places(reader: StripReader, scan: StripScan, energy: PulseEnergy) -> list[np.ndarray]:
    """Waveforms at places along the strip, each as `_join`."""
    found = []
    numbers = even_places(reader.unit_count(), PLACES).tolist()
    for number in numbers:
        unit = reader.read_unit(number, scan)
        for part in np.array_split(np.flatnonzero(unit.packets.owned), -(-PLACES // len(numbers))):
            found.append(_join(reader, unit, part[even_places(len(part), OF_PLACE)], energy))
    return found


def _compare_unknown(pulses: np.ndarray, chance: float) -> tuple[float, float]:
    """Error of pulses of unknown energy by their light beside that of the others of their digitizer, relative, and the
    share of pulses that are of unknown energy and have no others there; pulses: as `_join`."""
    with np.errstate(invalid="ignore", divide="ignore"):
        unknown, light = np.isnan(pulses[2]), np.log(pulses[1] / np.nan_to_num(pulses[2], nan=1.0))
    shown, alone = np.isfinite(light), 0
    # Counts of two digitizers have nothing in common, so each is taken relative to its own pulses of known energy.
    for channel in np.unique(pulses[3]):
        own = pulses[3] == channel
        known = light[own & shown & ~unknown]
        if len(known) < LEAST_KNOWN:
            alone += int(np.count_nonzero(own & unknown))
            shown &= ~own
        else:
            light[own] -= np.median(known)
    share = alone / max(len(light), 1)
    parts = [light[rows & shown] for rows in (unknown, ~unknown)]
    if min(map(len, parts)) < LEAST_KNOWN:
        return 0.0, share
    change = compare_scenes(*(np.quantile(part, QUANTILES) for part in parts), chance=chance)
    # All of it: known and unknown pulses are of one scene, and what cannot be measured is no average pulse.
    return math.expm1(max(change.error, abs(change.shift))), share


def _compare_drift(places: list[np.ndarray], shots: float) -> float:
    """Error by slow changes of the log that the strip's brightness does not follow, relative; places: as `_join`;
    shots: scatter of the log from shot to shot, relative."""
    found: list[np.ndarray] = []
    every = [np.empty((4, 0))]
    for pulses in places:
        with np.errstate(invalid="ignore", divide="ignore"):
            both = np.log(pulses[1:3])
        good = np.isfinite(both).all(axis=0) & np.isfinite(pulses[5:]).all(axis=0)
        if good.any():
            every.append(np.stack([np.full(good.sum(), len(found)), both[0, good] - both[1, good], *pulses[5:, good]]))
            found.append(np.median(both[:, good], axis=1))
    light, sent = np.array(found).T if found else np.empty((2, 0))
    if len(sent) < LEAST_PLACES:
        return 0.0
    sent, light = sent - sent.mean(), light - light.mean()
    # Medians of OF_PLACE pulses scatter by themselves: only what is beyond that is slow.
    slow = math.sqrt(max(float(np.mean(sent**2)) - 1.57 * shots**2 / OF_PLACE, 0.0))
    if not slow:
        return 0.0
    slope = float(sent @ light / (sent @ sent))
    rest = light - slope * sent
    # A field's border in the middle of the strip looks like a drift: parts beside each other are of one field.
    error = weigh_alike(rest) * math.sqrt(float(rest @ rest) / (len(sent) - 2) / float(sent @ sent))
    # Or in cells of the ground, by means of several places: medians have what the light of their shots has, and where a
    # smooth curve leaves the steps of the log, light seems to follow it.
    number, rest, *place = np.concatenate(every, axis=1)
    steady = np.convolve(np.pad(sent, SMOOTH // 2, mode="edge"), np.full(SMOOTH, 1 / SMOOTH), "valid")
    steady = steady[number.astype(np.int64)]
    error, slope = min([(error, slope), *find_growth_in_cells(steady, rest + steady, np.stack(place))])
    return slow * min(math.hypot(1.0 - slope, error), 1.0)
