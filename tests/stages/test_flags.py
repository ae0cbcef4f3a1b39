"""Flags and neighbours of echoes against loops over pairs: what is weak, cut, faint beside another one, or the same."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.neighbours import Finishing, finish_echoes
from wavebatch.kernels.library import Samples
from wavebatch.stages.decompose.merge import OVERLAP, TWINS, UNRESOLVED
from wavebatch.stages.flags import find_unexplained, flag_echoes, leave_beside, misfit_factor, unexplained, unproven
from wavebatch.stages.pulse_tables import floor_level

OVERLAPPED = int(EchoFlag.OVERLAPPED)
ERRORS = "time_err", "amplitude_err", "sigma_err", "relative_energy_err"
S, N = 60, 120


@pytest.fixture
def table(rng):
    """Up to five echoes in each of 120 waveforms, many of them close, with errors and some flags."""
    number = rng.integers(0, 6, N)
    m = number.sum()
    time = rng.uniform(0, S - 1, m)
    close = rng.random(m) < 0.5
    time[1:][close[1:]] = time[:-1][close[1:]] + rng.uniform(0, 4, close[1:].sum())
    sigma = rng.uniform(1.3, 4, m)
    return EchoTable.build(
        np.repeat(np.arange(N), number), np.clip(time, 0, S - 1), 4 * 10 ** rng.uniform(0, 2.2, m), sigma,
        time_err=rng.uniform(0.05, 6, m), amplitude_err=rng.uniform(0.5, 4, m), sigma_err=rng.uniform(0.05, 0.4, m),
        relative_energy_err=rng.uniform(0.01, 0.1, m), flags=rng.choice([0, OVERLAPPED], m, p=[0.3, 0.7]),
    )  # fmt: skip


def finish(table, factors=None, missing=None, **steps):
    """The table after some of the steps, with the rows that are left and how errors grew."""
    columns, ones = {name: values.copy() for name, values in table.columns().items()}, np.ones(N, np.float32)
    samples = Samples(np.zeros((N, S), np.uint8), ones, ones, missing)
    columns, row, grown = finish_echoes(columns, np.arange(len(table)), samples, Finishing(**steps), factors)
    return EchoTable(**columns), row, grown


def cover(table, system):
    steps = {"unexplained": unexplained(system, 0.5), "others": leave_beside(system)}
    return finish(table, **steps)[0]


def pairs(table):
    """(echo, other echo of the same waveform, time from the other one to it)."""
    for i in range(len(table)):
        for j in range(len(table)):
            if i != j and table.waveform[i] == table.waveform[j]:
                yield i, j, table.time[i] - table.time[j]


def test_flags_are_those_of_a_loop(table, rng):
    samples = np.clip(rng.normal(20, 2, (N, S)), 0, 255)
    for w, time, sigma in zip(table.waveform, table.time, table.sigma, strict=True):
        samples[w] += 300 * (rng.random() < 0.3) * np.exp(-0.5 * ((np.arange(S) - time) / sigma) ** 2)
    missing = np.zeros((N, S), bool)
    missing[::3, 25:33] = True
    samples[missing] = 255  # which is no light
    block = WaveformBlock.from_samples(np.clip(np.rint(samples), 0, 255).astype(np.uint8))
    block = replace(block, missing=missing)
    strong = rng.random(len(table)) < 0.15
    amplitude = np.where(strong, rng.uniform(1400, 1900, len(table)), table.amplitude)
    table = replace(table, amplitude=amplitude.astype(np.float32))
    noise = Noise(np.full(N, 20, np.float32), rng.uniform(0.8, 3, N).astype(np.float32))
    system = SystemPulse(2.0, noise=ReceiverNoise(baseline=20.0, std=1.0), saturation=255.0, ringing=0.1)
    found = flag_echoes(block, noise, system, replace(table, flags=np.zeros(len(table), np.uint16)))
    expected = []
    for i in range(len(table)):
        w, t, a, s = table.waveform[i], table.time[i], table.amplitude[i], table.sigma[i]
        near = [abs(k - t) <= 1.5 * s and not missing[w, k] for k in range(S)]
        clipped = any(block.samples[w, k] >= 255 for k in range(S) if near[k])
        cut = min(t, S - 1 - t) < s or (w % 3 == 0 and max(24 - t, t - 33) < s)
        flags = {
            EchoFlag.WEAK: a < 5 * noise.std[w],
            EchoFlag.NEAR_EDGE: cut,
            EchoFlag.NARROW: s + 3 * table.sigma_err[i] < 2.0 and s < 0.93 * 2.0,
            EchoFlag.SATURATED: clipped,
            EchoFlag.AMPLITUDE_UNRELIABLE: clipped and 0.15 * a > 255 - 20,
        }  # fmt: skip
        expected.append(sum(int(flag) for flag, holds in flags.items() if holds))
    for i, j, lag in pairs(table):
        if 4.0 <= lag <= 24.0 and table.amplitude[i] < 0.12 * table.amplitude[j]:
            expected[i] |= int(EchoFlag.RINGING_SUSPECT)
    assert found.flags.tolist() == expected
    for flag in EchoFlag.WEAK, EchoFlag.NEAR_EDGE, EchoFlag.NARROW, EchoFlag.RINGING_SUSPECT, EchoFlag.SATURATED:
        assert 0 < np.count_nonzero(found.flags & int(flag)) < len(table), flag
    assert 0 < np.count_nonzero(found.flags & int(EchoFlag.AMPLITUDE_UNRELIABLE)) < np.count_nonzero(strong)


def test_memory_for_saturated_echoes_grows_with_the_samples():
    """A table of echoes by samples would have 6e8 values."""
    s, m = 65_535, 10_000
    block = WaveformBlock.from_samples(np.where(np.arange(s) % 13 < 3, 255, 10).astype(np.uint8)[None])
    table = EchoTable.build(np.zeros(m, int), 1.0 + 6.5 * np.arange(m), np.full(m, 200.0), np.full(m, 2.0))
    noise = Noise(np.full(1, 10, np.float32), np.ones(1, np.float32))
    tracemalloc.start()
    found = flag_echoes(block, noise, SystemPulse(2.0, saturation=255.0), table)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    saturated = (found.flags & int(EchoFlag.SATURATED)) != 0
    assert saturated[::2].all() and not saturated[1::2].any()
    assert peak < 100 * (s + m)


def test_echoes_that_an_error_of_the_pulse_explains_are_dropped_as_by_a_loop(table, rng):
    faint = rng.random(len(table)) < 0.4
    table = replace(table, amplitude=np.where(faint, 0.02 * table.amplitude, table.amplitude).astype(np.float32))
    learned = SystemPulse(2.0, components=((0.1, 6.0, 1.0),), tail_misfit=((-2.0, 0.01), (0.0, 0.02), (2.0, 0.05)))
    gaussian = SystemPulse(2.0, tail_misfit=((-6.0, 0.05), (-2.0, 0.05)))
    for system, top in ((learned, np.inf), (learned, 300.0), (gaussian, 300.0)):
        lags, shares = np.array(system.tail_misfit).T
        dropped = set()
        for i, j, lag in pairs(table):
            share = 0.02 if system.components and abs(lag) <= max(4 * 2.0, 6.0 + 3 * 1.0) else 0.0
            if system.components and table.amplitude[j] >= top:
                share = max(share, 0.005)
            least = share * table.amplitude[j]
            if np.abs(lag - lags).min() <= 0.6 * 2.0 or lags[0] < lag < lags[-1]:
                tail = np.interp(lag, lags, shares) * table.amplitude[j]
                least = max(least, 1.5 * tail, tail + 2 * table.amplitude_err[i])
            if table.amplitude[i] < least:
                dropped.add(i)
        kept = finish(table, unproven=unproven(system, top))[0]
        left = [i for i in range(len(table)) if i not in dropped]
        np.testing.assert_array_equal(kept.time, table.time[left])
        assert 10 < len(dropped) < len(table) // 2


def test_all_of_a_long_ringing_is_of_the_echo_before_it():
    """Its far parts are explained by the strong echo, though more of them lie between than neighbours are looked at."""
    time, height = 10 + 4.0 * np.arange(12), np.r_[5000, np.full(11, 10.0)]
    lags = tuple((lag, 0.0018) for lag in (time - 10)[1:].tolist())
    table = EchoTable.build(np.zeros(12, int), time, height, np.full(12, 2.0), amplitude_err=np.full(12, 0.5))
    rest, _, _ = finish(table, unproven=unproven(SystemPulse(2.0, tail_misfit=lags)))
    assert rest.time.tolist() == [10.0]


@pytest.mark.parametrize(
    ("misfit", "beside"), [(0.05, ()), (0.0, ((-8.0, 0.5), (6.0, 3.0), (8.0, 2.0))), (0.05, ((8.0, 5.0),))]
)
def test_what_is_left_beside_echoes_is_in_the_errors_of_others_as_by_a_loop(table, misfit, beside):
    noise = ReceiverNoise(std=1.3)
    system = SystemPulse(2.0, misfit=misfit, beside=beside, noise=noise)
    found = cover(table, system)
    variance = np.zeros(len(table))
    for i, j, lag in pairs(table):
        more = np.interp(lag, *np.array(beside).T) if beside and abs(lag) < 21 and table.amplitude[j] > 26 else 0.0
        core = 0.34 * misfit * table.amplitude[j] / 1.3 if abs(lag) < 8.0 else 0.0
        variance[i] = max(variance[i], more + core**2 * np.sqrt(np.pi) * 2.0 / 0.5)
    for name in ERRORS:
        np.testing.assert_allclose(getattr(found, name), getattr(table, name) * np.sqrt(1 + variance), rtol=1e-5)
    assert variance.max() > 2
    np.testing.assert_allclose(misfit_factor(table, system, 0.5), np.sqrt(1 + variance), rtol=1e-5)
    same = cover(table, SystemPulse(2.0))
    assert all((getattr(same, name) == getattr(table, name)).all() for name in ERRORS)


@pytest.mark.parametrize("misfit", [0.0, 0.05])
def test_errors_grow_where_a_fit_misses_its_samples(table, rng, misfit):
    table = replace(table, residual=rng.uniform(0.7, 6, len(table)).astype(np.float32))
    system = SystemPulse(2.0, misfit=misfit, noise=ReceiverNoise(std=1.3))
    factor = missed(table, misfit)
    np.testing.assert_allclose(find_unexplained(table, system, 0.5), factor, rtol=1e-5)
    sure, found = cover(replace(table, residual=np.ones_like(table.residual)), system), cover(table, system)
    for name in ERRORS:
        np.testing.assert_allclose(getattr(found, name), getattr(sure, name) * np.sqrt(factor), rtol=1e-5)
    assert 0.2 < np.mean(factor > 1) < 0.9


def missed(table, misfit):
    """chi2 per sample of each echo over what is expected, 1 where chance explains it."""
    samples, factor = 8 * 2.0 / 0.5, np.ones(len(table))
    for i in range(len(table)):
        own = np.flatnonzero(table.waveform == table.waveform[i])
        energy = sum(table.amplitude[j] ** 2 * table.sigma[j] for j in own) * np.sqrt(np.pi) / 0.5 / 1.3**2
        chi2 = table.residual[i] ** 2 / (1 + misfit**2 * energy / samples)
        factor[i] = chi2 if chi2 > 1 + 4 * np.sqrt(2 / samples) else 1.0
    return factor


def test_colour_and_misfits_of_echoes_that_are_left_are_given_by_their_rows(table, rng):
    system = SystemPulse(2.0, misfit=0.05, noise=ReceiverNoise(std=1.3))
    factors = rng.uniform(0.5, 1.5, (len(table), 4))
    found, row, grown = finish(
        table, factors, twins=TWINS, overlap=OVERLAP, unresolved=UNRESOLVED, unexplained=unexplained(system, 0.5),
        others=True,
    )  # fmt: skip
    before = finish(table, twins=TWINS, overlap=OVERLAP, unresolved=UNRESOLVED)[0]
    assert len(found) == len(row) < len(table) and (np.diff(row) > 0).all()
    expected = np.minimum(factors[row, 0], 1.0) * found.amplitude_err / before.amplitude_err
    np.testing.assert_allclose(grown, expected, rtol=1e-6)


def test_echoes_are_sorted_and_those_of_one_place_keep_their_order(table, rng):
    table = replace(table, time=np.round(table.time, 0))
    mixed = table.take(np.argsort(np.arange(len(table)) + rng.integers(0, 9, len(table)), kind="stable"))
    order = np.lexsort((mixed.time, mixed.waveform))
    found, row, _ = finish(mixed, sort=True)
    assert row.tolist() == order.tolist() != list(range(len(table)))
    for name, values in mixed.take(order).columns().items():
        np.testing.assert_array_equal(getattr(found, name), values)


def test_echoes_inside_of_gaps_are_left_out(table):
    missing = np.zeros((N, S), bool)
    missing[::3, 25:33] = missing[1::3, :4] = missing[1::3, 40:] = missing[2::9, 57:] = True
    missing[2::9, 20:22] = missing[2::9, 23:30] = True
    missing[5::9] = True
    left = []
    for i in range(len(table)):
        gaps, k, away = missing[table.waveform[i]], 0, np.inf
        while k < S:
            end = k
            while end < S and gaps[end]:
                end += 1
            if end > k:
                away = min(away, max(k - 1 - table.time[i], table.time[i] - end))
            k = end + 1
        if away >= -max(0.5 * table.sigma[i], 1.0):
            left.append(i)
    found, row, _ = finish(table, missing=missing, gaps=1.0)
    assert row.tolist() == left
    np.testing.assert_array_equal(found.relative_energy_err, table.relative_energy_err[left])
    assert len(table) // 2 < len(left) < len(table) - 30


def test_the_weaker_of_two_echoes_in_one_place_is_dropped(table):
    table = replace(table, time=np.round(table.time, 1))
    table = table.take(np.lexsort((table.time, table.waveform)))
    dropped = set()
    for i in range(len(table) - 1):
        same = table.waveform[i] == table.waveform[i + 1]
        near = table.time[i + 1] - table.time[i] < 0.1 * min(table.sigma[i], table.sigma[i + 1])
        if same and near and not table.flags[i] & table.flags[i + 1] & OVERLAPPED:
            dropped.add(i if table.amplitude[i] < table.amplitude[i + 1] else i + 1)
    left = [i for i in range(len(table)) if i not in dropped]
    np.testing.assert_array_equal(finish(table, twins=TWINS)[0].amplitude, table.amplitude[left])
    assert dropped


def test_pairs_that_are_not_resolved_become_one_with_their_moments(table):
    """One pair after the other from the left, again and again; the area, mean and variance of the light stay."""
    table = replace(table, time_err=6 * table.time_err, flags=np.where(table.time < 50, OVERLAPPED, table.flags))
    table = table.take(np.lexsort((table.time, table.waveform)))
    names = ("waveform", "time", "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err", "flags")
    columns = {name: getattr(table, name).tolist() for name in names}
    echoes = [{name: columns[name][i] for name in names} for i in range(len(table))]
    merged = True
    while merged:
        merged, left, i = False, [], 0
        while i < len(echoes):
            if i + 1 < len(echoes) and _unresolved(echoes[i], echoes[i + 1]):
                left.append(_merge(echoes[i], echoes[i + 1]))
                merged, i = True, i + 2
            else:
                left.append(echoes[i])
                i += 1
        echoes = sorted(left, key=lambda echo: (echo["waveform"], echo["time"]))
    found = finish(table, overlap=OVERLAP, unresolved=UNRESOLVED)[0]
    assert len(found) == len(echoes) < len(table) - 40
    for name in names:
        np.testing.assert_allclose(getattr(found, name), [echo[name] for echo in echoes], rtol=2e-5, err_msg=name)


def _unresolved(a, b):
    gap = b["time"] - a["time"]
    together = a["flags"] & b["flags"] & OVERLAPPED and a["waveform"] == b["waveform"]
    return together and gap < 2 * min(a["sigma"], b["sigma"]) and gap < 0.25 * np.hypot(a["time_err"], b["time_err"])


def _merge(a, b):
    both = (a, b)
    area = sum(e["amplitude"] * e["sigma"] for e in both)
    time = sum(e["amplitude"] * e["sigma"] * e["time"] for e in both) / area
    square = sum(e["amplitude"] * e["sigma"] * (e["sigma"] ** 2 + e["time"] ** 2) for e in both) / area
    sigma = np.sqrt(square - time**2)
    return {
        "waveform": a["waveform"], "time": time, "amplitude": area / sigma, "sigma": sigma,
        "time_err": min(a["time_err"], b["time_err"]), "sigma_err": min(a["sigma_err"], b["sigma_err"]),
        "amplitude_err": min(e["amplitude_err"] / e["amplitude"] for e in both) * area / sigma,
        "flags": a["flags"] | b["flags"] | int(EchoFlag.MERGED),
    }  # fmt: skip


def test_an_echo_whose_companions_are_gone_is_not_overlapped():
    overlapped, merged = int(EchoFlag.OVERLAPPED), int(EchoFlag.MERGED)
    waveform = np.array([0, 1, 1, 2, 3, 3])
    flags = np.array([overlapped, overlapped, overlapped, overlapped | merged, 0, overlapped | 1])
    one = np.ones(6)
    table = EchoTable.build(waveform, np.arange(6.0), one, one, flags=flags)
    found = finish(table, lone=True)[0]
    assert found.flags.tolist() == [0, overlapped, overlapped, overlapped | merged, 0, 1]
    assert len(finish(EchoTable.empty(), lone=True)[0]) == 0


def test_echoes_of_no_waveform_are_refused(table):
    block = WaveformBlock.from_samples(np.zeros((N - 1, S), np.uint8))
    noise = Noise(np.zeros(N - 1, np.float32), np.ones(N - 1, np.float32))
    last = replace(table, waveform=np.maximum(table.waveform, N - 1))
    refuses(ValueError, "lies in no waveform", flag_echoes, block, noise, SystemPulse(2.0), last)


def test_columns_and_factors_that_do_not_fit_are_refused(table):
    columns, row, ones = table.columns(), np.arange(len(table)), np.ones(N, np.float32)
    samples, none = Samples(np.zeros((N, S), np.uint8), ones, ones), Finishing()
    with pytest.raises(ValueError, match="more than one level"):
        finish_echoes(columns, row, samples._replace(baseline=np.ones((N, S), np.float32)), none)
    refuses(ValueError, "differ in length", finish_echoes, columns | {"sigma": table.sigma[1:]}, row, samples, none)
    refuses(ValueError, "differ in length", finish_echoes, columns, row[1:], samples, none)
    covering = Finishing(unexplained=unexplained(SystemPulse(2.0), 0.5))
    for factors in np.ones((len(table) - 1, 4)), np.ones((len(table), 3)):
        refuses(ValueError, "no factors", finish_echoes, columns, row, samples, covering, factors)
    refuses(ValueError, "how errors grow", finish_echoes, columns, row, samples, none, np.ones((len(table), 4)))


@pytest.mark.parametrize(("baseline", "spread", "floor"), [(2.9, 0.0, -np.inf), (3.1, 0.0, 0.0), (4.0, 1.0, -np.inf)])
def test_count_0_is_a_floor_where_noise_does_not_reach_it(baseline, spread, floor):
    noise = ReceiverNoise(std=2.0, baseline=baseline, baseline_spread=spread, by_kind={"quiet": 1.0})
    assert floor_level(SystemPulse(2.0, noise=noise)) == floor
