"""Rows of clouds: who owns what, return numbers, what is passed through, and columns of other packages."""

import dataclasses
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from batch_tools import make_job, read_cloud, run_one
from commands import refuses, run_command
from packet_strips import render, write_recorded

import wavebatch as wb
from wavebatch.batch import output_rows
from wavebatch.batch.options import OPTIONS, RunOptions
from wavebatch.batch.output_rows import UnitEchoes, _find_copies, assemble_echoes, assemble_returns, gather_echoes
from wavebatch.batch.run import run_batch
from wavebatch.batch.unit import CHUNK_POINTS, Packing, pack_chunk, pack_rows, prepare_strip
from wavebatch.core.echoes import COLUMNS, PASSED_THROUGH, Column, EchoFlag, EchoTable
from wavebatch.core.errors import OF_FILES, StageError
from wavebatch.files.disk.temp_store import spool_rows
from wavebatch.files.las.header import build_dtype, split_numbers
from wavebatch.files.strip.reader import PacketTable, StripReader
from wavebatch.kernels.geometry.group_returns import LONGEST_PULSE
from wavebatch.stages.chain import STAGES, load_profile
from wavebatch.surveying.calibration import needs_sensor, with_columns
from wavebatch.tools.simulate import StripOptions, simulate_strip


def _spoil(points):
    """Marks every record, takes away, breaks and shuffles some."""
    rng = np.random.default_rng(5)
    n = len(points)
    points["point_source_id"] = np.arange(n)
    points["wavepacket_index"][rng.integers(0, n, 12)] = 0
    points["wavepacket_size"][rng.integers(0, n, 5)] = 0
    points["wavepacket_offset"][rng.integers(0, n, 7)] = 2**40
    half = n // 2
    points[half:] = points[half:][rng.permutation(n - half)]
    points["point_source_id"] = np.arange(n)
    return points


@pytest.fixture(scope="module")
def spoilt(tiny_strip, edit_points, tmp_path_factory):
    return edit_points(tiny_strip, tmp_path_factory.mktemp("spoilt") / "spoilt.las", _spoil)


@pytest.fixture(scope="module")
def looped(spoilt):
    """What a loop finds of the strip: points, echoes and members by owner, flags, rows of echoes mode, header."""
    points, echoes, members, flags, header = _read_packets(spoilt)
    rows = _expect_rows(points, echoes, members, flags, header.scales, header.offsets)
    return points, echoes, members, flags, rows, header


def _read_unit(path, **options):
    """The first unit of a strip, what was prepared for it, and each block with its packets and echoes."""
    prepared = prepare_strip(make_job(path, **options))
    with StripReader(path) as reader:
        unit = reader.read_unit(0, prepared.scan)
        blocks = reader.read_blocks(unit, 100, owned_only=options.get("points") != "returns")
        found = [(block, index, prepared.job.chain.run(block, prepared.system)) for block, index in blocks]
    prepared.scan.close()
    return prepared, unit, found


def _read_packets(path):
    """Per packet, by its first point: the echoes, and the points in it."""
    prepared = prepare_strip(make_job(path))
    echoes, members, flags, points = {}, {}, {}, []
    with StripReader(path) as reader:
        for number in range(prepared.units):
            unit = reader.read_unit(number, prepared.scan)
            points.append(unit.points)
            flags.update({unit.start + k: flag for k, flag in enumerate(unit.point_flags.tolist())})
            for block, _ in reader.read_blocks(unit, 100, owned_only=True):
                table = prepared.job.chain.run(block, prepared.system)
                for row, owner in enumerate(block.point.tolist()):
                    mine = np.flatnonzero(table.waveform == row)
                    a = table.attributes
                    echoes[owner] = [
                        {"time": table.time[k], "xyz": [a[c][k] for c in "xyz"], "point": int(a["point"][k]),
                         "amplitude": a["amplitude"][k], "flags": int(table.flags[k]), "ray": block.direction[row],
                         "reach": table.sigma[k] * np.linalg.norm(block.direction[row])}
                        for k in mine
                    ]  # fmt: skip
                    members[owner] = {
                        int(p): float(t)
                        for p, t in zip(
                            block.returns.point[block.returns.waveform == row],
                            block.returns.time[block.returns.waveform == row],
                            strict=True,
                        )
                    }
    prepared.scan.close()
    return np.concatenate(points), echoes, members, flags, prepared.facts.header


def _find_pulse(points, leads, place):
    """The pulse of each point that owns a packet or has none: of equal time, and on one line."""
    times = points["gps_time"].tolist()
    rays = -np.stack([points[axis].astype(float) for axis in ("x_t", "y_t", "z_t")], axis=1)
    pulse = list(range(len(times)))
    for time in set(times) - {0.0}:
        if times.count(time) >= LONGEST_PULSE:
            continue
        group = [i for i in leads if times[i] == time]
        owners, heads = [i for i in group if leads[i]], []
        for i in group:
            pulse[i] = group[0]
            ray = rays[i if leads[i] else owners[0]] if owners else None
            for head, line in heads:
                off = np.subtract(place(i), place(head))
                off -= line * (off @ line) / (line @ line)
                if np.linalg.norm(off) < 0.1 and np.linalg.norm(ray - line) < 1e-4 * np.linalg.norm(line):
                    pulse[i] = head
                    break
            else:
                if owners:
                    pulse[i] = i
                    heads.append((i, ray))
    return pulse


def _expect_rows(points, echoes, members, flags, scales, offsets):
    """The rows of echoes mode, one dictionary each."""
    rows = []

    def place(i):
        return [points[axis][i] * s + o for axis, s, o in zip("XYZ", scales, offsets, strict=True)]

    leads = {i: i in echoes for i in range(len(points)) if flags[i] or i in echoes}
    pulse = _find_pulse(points, leads, place)

    for i in range(len(points)):
        if flags[i]:
            row = {"source": i, "xyz": place(i), "flags": flags[i], "amplitude": None, "ray": None}
            rows.append({**row, "pulse": pulse[i]})
        elif i in echoes:
            group = []
            for echo in echoes[i]:
                near = min(members[i], key=lambda p: (abs(members[i][p] - echo["time"]), members[i][p]))
                source = echo["point"] if echo["point"] >= 0 else near
                flag = echo["flags"] | (EchoFlag.ADDED if echo["point"] < 0 else 0)
                group.append({**echo, "source": source, "flags": int(flag), "pulse": pulse[i]})
            ray = group[0]["ray"] if group else None
            for p in set(members[i]) - {echo["point"] for echo in echoes[i]}:
                group.append({"source": p, "xyz": place(p), "flags": int(EchoFlag.NO_ECHO), "amplitude": None,
                              "ray": ray, "pulse": pulse[i], "time": members[i][p]})  # fmt: skip
            rows += sorted(group, key=lambda row: (row["time"], row["source"]))
    # Points without a packet are the added echoes of their pulse that lie there, the nearest first.
    added, alone = (
        [k for k, row in enumerate(rows) if row["flags"] & flag] for flag in (EchoFlag.ADDED, EchoFlag.NO_WAVEFORM)
    )
    pairs = [(np.linalg.norm(np.subtract(rows[k]["xyz"], rows[j]["xyz"])), k, j)
             for k in added for j in alone if rows[k]["pulse"] == rows[j]["pulse"]]  # fmt: skip
    joined = set()
    for off, k, j in sorted(pairs):
        if off <= rows[k]["reach"] and not {k, j} & joined:
            joined |= {k, j}
            rows[k] |= {"source": rows[j]["source"], "flags": rows[k]["flags"] & ~EchoFlag.ADDED}
    return [row for k, row in enumerate(rows) if k not in joined & set(alone)]


def _expect_numbers(rows, echoes, members, points):
    owner_ray = {}
    for owner in echoes:
        for echo in echoes[owner]:
            owner_ray[owner] = echo["ray"]
    by_pulse = defaultdict(list)
    for k, row in enumerate(rows):
        by_pulse[row["pulse"]].append(k)
    numbers = {}
    for group in by_pulse.values():
        ray = next((rows[k]["ray"] for k in group if rows[k]["ray"] is not None), None)
        along = {k: 0.0 if ray is None else float(np.dot(rows[k]["xyz"], ray)) for k in group}
        for k in group:
            ahead = sum(along[other] < along[k] for other in group)
            numbers[k] = (ahead + 1, len(group)) if ray is not None else None
    return numbers


def test_every_row_of_echoes_mode_is_what_a_loop_makes(spoilt, looped, tmp_path):
    outcome = run_one(spoilt, tmp_path, format="las")
    assert outcome.error is None
    points, echoes, members, flags, expected, header = looped
    found, xyz = read_cloud(tmp_path / "spoilt.las")
    assert len(found) == len(expected)
    assert found["point_source_id"].tolist() == [row["source"] for row in expected]
    assert found["echo_flags"].tolist() == [row["flags"] for row in expected]
    assert np.abs(xyz - np.array([row["xyz"] for row in expected])).max() <= 0.5 * max(header.scales) + 1e-9
    amplitude = [-9999.0 if row["amplitude"] is None else row["amplitude"] for row in expected]
    assert found["amplitude"].tolist() == amplitude
    numbers = _expect_numbers(expected, echoes, members, points)
    bits = found["bit_fields"]
    for k, number in numbers.items():
        if number is not None:
            assert (bits[k] & 15, bits[k] >> 4) == number, k
        elif not echoes.get(expected[k]["source"], None) and expected[k]["flags"] == EchoFlag.NO_WAVEFORM:
            given = points["bit_fields"][expected[k]["source"]]
            assert (bits[k] & 15, bits[k] >> 4) == (given & 7, given >> 3 & 7)
    kinds = {row["flags"] for row in expected if row["amplitude"] is None}
    assert kinds == {EchoFlag.NO_WAVEFORM, EchoFlag.BROKEN_PACKET, EchoFlag.NO_ECHO}
    assert any(len(group) > 1 for group in members.values())


def test_returns_mode_keeps_every_point_and_adds_the_matching_echo(spoilt, looped, tmp_path):
    outcome = run_one(spoilt, tmp_path, points="returns", format="las")
    assert outcome.error is None
    points, _, _, flags, rows, _ = looped
    found, _ = read_cloud(tmp_path / "spoilt.las")
    for name in ("X", "Y", "Z", "gps_time", "intensity", "point_source_id", "user_data"):
        assert (found[name] == points[name]).all(), name
    assert all(np.array_equal(a, b) for a, b in zip(split_numbers(found), split_numbers(points), strict=True))
    matched = {row["source"]: row for row in rows
               if row["amplitude"] is not None and not row["flags"] & EchoFlag.ADDED}  # fmt: skip
    assert any(flags[i] for i in matched)
    for i in range(len(points)):
        if i in matched:
            assert found["amplitude"][i] == matched[i]["amplitude"]
            assert found["echo_flags"][i] == matched[i]["flags"]
        else:
            assert found["amplitude"][i] == -9999.0
            assert found["echo_flags"][i] == (flags[i] or EchoFlag.NO_ECHO)
    counts = outcome.report
    assert counts.count("points_out") == counts.count("points_in") == len(points)
    assert counts.count("matched_returns") == len(matched)


@pytest.mark.parametrize("points", ["echoes", "returns"])
@pytest.mark.parametrize(("no_data", "empty"), [(None, 0), (250.0, 250)])
def test_integer_columns_are_written_too(spoilt, monkeypatch, points, no_data, empty):
    """They came out as 0 in every row once, because only floats were taken along."""
    monkeypatch.setitem(COLUMNS, "amplitude", Column("amplitude", "u1", "-", "number of the echo", no_data))
    prepared, unit, found = _read_unit(spoilt, points=points)
    echoes = gather_echoes(unit, found)
    number = (np.arange(len(echoes.table)) % 200 + 1).astype(np.uint8)
    echoes = dataclasses.replace(echoes, table=echoes.table.with_attributes(amplitude=number))
    rows = (assemble_echoes if points == "echoes" else assemble_returns)(unit, echoes, prepared.layout).rows
    is_echo = (rows["echo_flags"] & PASSED_THROUGH) == 0
    kept = number if points == "echoes" else number[echoes.table.attributes["point"] >= 0]
    assert rows["amplitude"].dtype == np.uint8
    more = list(rows["amplitude"][is_echo])  # in returns mode also those of points without a packet of their own
    for value in kept:
        more.remove(value)
    alone = unit.point_flags[rows["point_source_id"][is_echo]] > 0
    assert len(more) == (np.count_nonzero(alone) if points == "returns" else 0)
    assert np.count_nonzero(~is_echo) > 10 and (rows["amplitude"][~is_echo] == empty).all()


def test_echoes_of_several_blocks_are_in_the_order_of_their_packets(spoilt):
    """Blocks of several digitizers, or of several lengths, have the packets of a unit in turn."""
    prepared, unit, found = _read_unit(spoilt)
    cuts = slice(0, None, 2), slice(1, None, 2)
    parts = [(block.rows(cut), index[cut]) for block, index, _ in found for cut in cuts]
    halves = [(block, index, prepared.job.chain.run(block, prepared.system)) for block, index in parts]
    whole, mixed = gather_echoes(unit, found), gather_echoes(unit, halves)
    assert len(whole.table) > 100 and (np.diff(whole.table.waveform) >= 0).all()
    for name in ("waveform", "time", "amplitude"):
        np.testing.assert_array_equal(getattr(mixed.table, name), getattr(whole.table, name))
    np.testing.assert_array_equal(mixed.nearest, whole.nearest)
    # Descriptors that differ in length only are those of one digitizer, two of one length are two channels.
    number = 1 + (np.arange(len(whole.read)) % 2).astype(np.uint8)
    unit = dataclasses.replace(unit, packets=dataclasses.replace(unit.packets, digitizer=number))
    for more, gain, joined in ((16, 1.0, True), (0, 1.0, False), (16, 2.0, False)):
        others = []
        for place, (block, index, table) in enumerate(halves):
            own = block.digitizer
            own = dataclasses.replace(own, index=2, n_samples=own.n_samples + more, gain=gain) if place % 2 else own
            others.append((dataclasses.replace(block, digitizer=own), index, table))
        assert np.array_equal(gather_echoes(unit, others).digitizer, np.ones_like(number) if joined else number)


def test_points_without_a_location_come_first_of_their_packet(tiny_strip):
    """The reader calls them broken today; if one got a packet, NaN would put it behind the echoes, or anywhere."""
    prepared, unit, found = _read_unit(tiny_strip)
    echoes = gather_echoes(unit, found)
    added = echoes.table.with_attributes(point=np.full(len(echoes.table), -1))  # so that all points have no echo
    points = np.array(unit.points)
    points["point_source_id"] = np.arange(len(points))
    points["return_point_wave_location"] = np.nan
    unit = dataclasses.replace(unit, points=points)
    rows = assemble_echoes(unit, dataclasses.replace(echoes, table=added), prepared.layout).rows
    packet = unit.packet_of_point[rows["point_source_id"]]
    of_several = 0
    for number in np.unique(packet[packet >= 0]):
        members = rows[packet == number]
        is_point = (members["echo_flags"] & EchoFlag.NO_ECHO) > 0
        given = np.flatnonzero(unit.packet_of_point == number)
        assert members["point_source_id"][: len(given)].tolist() == given.tolist()
        assert is_point[: len(given)].all() and not is_point[len(given) :].any()
        of_several += len(given) > 1 and len(members) > len(given)
    assert of_several > 5


def test_counts_are_those_of_a_loop(spoilt, looped, tmp_path):
    report = run_one(spoilt, tmp_path).report
    points, echoes, members, flags, rows, _ = looped
    without = sum(row["flags"] == EchoFlag.NO_WAVEFORM for row in rows)
    joined = sum(flag == EchoFlag.NO_WAVEFORM for flag in flags.values()) - without
    found = {owner: group for owner, group in echoes.items() if group}
    matched = sum(echo["point"] >= 0 for group in found.values() for echo in group)
    expected = {
        "points_in": len(points),
        "points_with_waveform": sum(flag == 0 for flag in flags.values()) + joined,
        "points_without_waveform": without,
        "points_broken": sum(flag == EchoFlag.BROKEN_PACKET for flag in flags.values()),
        "waveforms": len(echoes),
        "echoes": sum(len(group) for group in found.values()),
        "matched_returns": matched + joined,
        "no_echo_returns": sum(len(members[owner]) for owner in echoes if not echoes[owner]),
        "unmatched_returns": sum(len(members[owner]) for owner in found) - matched,
        "added_echoes": sum(echo["point"] < 0 for group in found.values() for echo in group) - joined,
    }
    for name, number in expected.items():
        assert report.count(name) == number, name


@pytest.mark.parametrize("points", ["echoes", "returns"])
def test_counts_do_not_depend_on_the_units(edit_points, tmp_path, points):
    """Units read packets of each other, also echoes that are no return; each counts in one of them."""

    def change(rows):
        number, total = split_numbers(rows)
        alone = (number == 2) & (total > 2)
        rows["wavepacket_index"][alone], rows["gps_time"][alone] = 0, 0.0  # pulses are found within a unit
        return rows[np.random.default_rng(1).permutation(len(rows))]

    simulate_strip("forest", tmp_path / "a.las", pulses=400, seed=2)
    strip, counts = edit_points(tmp_path / "a.las", tmp_path / "b.las", change), []
    for unit_points in (None, 100):
        job = dataclasses.replace(make_job(strip, points=points), unit_points=unit_points)
        (outcome,) = run_batch([job], RunOptions(tmp_path / str(unit_points))).outcomes
        assert outcome.error is None
        counts.append(outcome.report.counts)
    assert counts[0] == counts[1]


def test_return_numbers_beyond_the_point_format_are_cut_and_flagged(tiny_strip, edit_points, tmp_path):
    def join(points):
        for name in (*"XYZ", "x_t", "y_t", "z_t"):  # on one line
            points[name][:20] = points[name][0]
        points["gps_time"][:20] = 77.25
        points["gps_time"][20:] = np.arange(len(points) - 20) + 100.0
        return points

    path = edit_points(tiny_strip, tmp_path / "joined.las", join)
    assert run_one(path, tmp_path / "out", format="las", las_version="keep").error is None
    found, _ = read_cloud(tmp_path / "out" / "joined.las")
    limit = (found["echo_flags"] & EchoFlag.RETURN_LIMIT) > 0
    same = found["gps_time"] == 77.25
    assert np.count_nonzero(limit & same) == np.count_nonzero(same) - 7
    assert not limit[~same].any()
    assert (found["bit_fields"][limit] & 7 == 7).all()
    assert run_one(path, tmp_path / "six", format="las").error is None
    found, _ = read_cloud(tmp_path / "six" / "joined.las")
    cut = np.count_nonzero(found["echo_flags"] & EchoFlag.RETURN_LIMIT)
    assert cut == np.count_nonzero(found["gps_time"] == 77.25) - 15


@pytest.mark.parametrize("how", ["scanner", "one line", "rounded", "sorted"])
def test_packets_of_equal_time_are_one_pulse_where_they_lie_on_one_line(edit_points, tmp_path, how):
    """Lasers that fire together, and pulses of a rounded time, became one pulse; packets far apart several. Where each
    return of a pulse has a packet, echoes were written once for each of them."""

    def change(rows):
        pulse = np.unique(rows["gps_time"], return_inverse=True)[1]
        if how == "sorted":  # a packet for each return of a pulse, one sample after that of the return before
            later = split_numbers(rows)[0] - 1
            rows["wavepacket_offset"] += later
            rows["return_point_wave_location"] -= 1000.0 * later
            return rows[np.argsort(later, kind="stable")]
        each = 10 if how == "rounded" else 2
        rows["gps_time"] = 300_000_000.0 + pulse // each
        if how != "rounded":
            rows["classification_flags"] = pulse % each << 4
        if how == "one line":  # each second pulse runs along the ray of the one before
            one = np.unique(pulse // each, return_index=True)[1][pulse // each]
            later = (rows["return_point_wave_location"] - rows["return_point_wave_location"][one]).astype(float)
            for axis, vector in zip("XYZ", ("x_t", "y_t", "z_t"), strict=True):
                rows[vector] = rows[vector][one]
                rows[axis] = rows[axis][one] - np.rint(1000 * later * rows[vector])
        return rows

    simulate_strip("forest", tmp_path / "a.las", pulses=600, seed=2, options=StripOptions(point_format=9))
    assert run_one(tmp_path / "a.las", tmp_path / "right", format="las").error is None
    strip = edit_points(tmp_path / "a.las", tmp_path / "b.las", change)
    done = run_one(strip, tmp_path / "out", format="las")
    assert done.error is None
    (right, _), (found, _) = (read_cloud(tmp_path / name) for name in ("right/a.las", "out/b.las"))
    (number, total), (first, most) = split_numbers(found), split_numbers(right)
    if how == "sorted":  # echoes at the end of a packet are found in some of them only
        np.testing.assert_allclose(np.bincount(number), np.bincount(first), atol=8)
        np.testing.assert_allclose(np.bincount(total), np.bincount(most), atol=16)
        copied = done.report.copied_echoes
        assert copied > len(right) / 2 and any(f" {copied} echoes" in line for line in done.report.remarks)
        returns = run_one(strip, tmp_path / "returns", points="returns").report
        assert (returns.count("echoes"), returns.copied_echoes) == (done.report.count("echoes"), copied)
    else:
        np.testing.assert_array_equal(np.bincount(number), np.bincount(first))
        np.testing.assert_array_equal(np.bincount(total), np.bincount(most))


@pytest.mark.parametrize("which", ["first", "last"])
def test_a_return_without_a_packet_takes_its_echo_from_another_packet_of_its_pulse(edit_points, tmp_path, which):
    """Some strips have a packet for one return of a pulse only. The others were in the cloud twice, as points without a
    waveform and as added echoes: half as many points again as there should be."""

    def change(rows):
        number, total = split_numbers(rows)
        for name in ("wavepacket_index", "wavepacket_offset", "wavepacket_size"):
            rows[name][number > 1 if which == "first" else number < total] = 0
        rows["point_source_id"] = np.arange(len(rows))
        return rows

    simulate_strip("forest", tmp_path / "a.las", pulses=600, seed=2)
    right = run_one(tmp_path / "a.las", tmp_path / "right").report
    strip = edit_points(tmp_path / "a.las", tmp_path / "b.las", change)
    done = run_one(strip, tmp_path / "out")
    assert done.error is None
    for name in ("echoes", "added_echoes", "matched_returns", "points_out"):
        assert abs(done.report.count(name) - right.count(name)) <= 0.01 * right.count("points_in"), name
    cloud, _ = read_cloud(tmp_path / "out/b.laz")
    added = (cloud["echo_flags"] & EchoFlag.ADDED) != 0
    np.testing.assert_array_equal(np.sort(cloud["point_source_id"][~added]), np.arange(right.count("points_in")))
    returns = run_one(strip, tmp_path / "returns", points="returns").report
    for name in ("echoes", "points_with_waveform", "matched_returns"):
        assert returns.count(name) == done.report.count(name)


def test_copies_of_copies_and_echoes_of_other_pulses_decide_nothing():
    """Of each pulse three packets, an echo in each; the first has a return. Beside a copy a true echo was a copy too,
    and narrow ones hid the copies behind them, except where another pulse of the unit had many."""
    time, sigma = np.array([0.0, 1.5, 3.0, 0.0, 0.6, 1.0]), np.array([2.0, 2.0, 2.0, 2.0, 0.1, 2.0])
    point = np.array([0, -1, -1, 3, -1, -1])
    table = EchoTable.build(np.arange(6), time, np.ones(6), sigma, attributes={"point": point})
    digitizer = np.ones(6, np.uint8)
    rays = UnitEchoes(table, point, np.ones(6, bool), np.tile([0.0, 0.0, -0.15], (6, 1)), np.zeros((6, 3)), digitizer)
    whole = np.arange(6), np.ones(6, bool)
    packets = PacketTable(digitizer, *(np.arange(6),) * 3, *whole, np.ones(6, bool))
    copied = _find_copies(SimpleNamespace(packets=packets, start=0), rays, np.array([0, 0, 0, 3, 3, 3]))
    assert copied.tolist() == [False, True, False, False, False, True]
    digitizer[1::3] = 2  # two receivers of a pulse: each echo of either counts
    copied = _find_copies(SimpleNamespace(packets=packets, start=0), rays, np.array([0, 0, 0, 3, 3, 3]))
    assert copied.tolist() == [False] * 5 + [True]


def test_descriptors_that_differ_in_length_only_are_one_digitizer(tmp_path):
    """A window for each return, with a descriptor for each length: each echo of overlapping windows was in the cloud
    once per window (11 to 17 % of all points)."""
    rng = np.random.default_rng(4)
    echoes = np.stack([np.repeat(np.arange(300.0), 2), np.tile([110.0, 108.5], 300), rng.uniform(80, 600, 600)], 1)
    begin, place = 115.0 + rng.uniform(0, 0.15, 300), rng.uniform(0, 20, (300, 2))
    windows = [[(10, 73), (10, 105)]] * 300
    # Of the points of both windows, the first return of one and the second of the other.
    path = write_recorded(tmp_path / "a.las", render(echoes, begin, 128, rng), begin, place, echoes, windows,
                          order=lambda number, _: np.arange(number).reshape(-1, 4)[:, [0, 3]].ravel())  # fmt: skip
    done = run_one(path, tmp_path / "out")
    assert done.error is None and done.report.count("points_in") == 600
    assert done.report.copied_echoes == done.report.count("points_out") == 600


@pytest.mark.parametrize(("flags", "copied"), [((4, 0), (1, 0)), ((0, 4), (0, 1)), ((4, 4), (0, 0)), ((0, 0), (0, 0))])
def test_an_echo_that_one_packet_cuts_is_that_of_another(flags, copied):
    """Fitted at the end of its packet, it stayed beside the echo that the other packet shows whole, 2.5 widths away."""
    table = EchoTable.build(np.arange(2), np.array([0.0, 5.0]), np.ones(2), np.full(2, 2.0), flags=np.uint16(flags),
                            attributes={"point": np.array([-1, -1])})  # fmt: skip
    rays = UnitEchoes(table, table.attributes["point"], np.ones(2, bool), np.tile([0.0, 0.0, -0.15], (2, 1)),
                      np.zeros((2, 3)), np.ones(2, np.uint8))  # fmt: skip
    packets = PacketTable(np.ones(2, np.uint8), *(np.arange(2),) * 3, np.arange(2), *np.ones((2, 2), bool))
    found = _find_copies(SimpleNamespace(packets=packets, start=0), rays, np.zeros(2, np.int64))
    assert found.tolist() == list(map(bool, copied))


def test_points_that_are_stored_twice_do_not_count_as_returns(edit_points, tmp_path):
    """Overlapping tiles that were merged: pulses of two returns had four."""

    def change(rows):
        rows[-100:] = rows[:100]
        return rows

    simulate_strip("forest", tmp_path / "a.las", pulses=400, seed=2)
    strip = edit_points(tmp_path / "a.las", tmp_path / "b.las", change)
    clouds = []
    for name in ("a", "b"):
        assert run_one(tmp_path / f"{name}.las", tmp_path / name, format="las").error is None
        clouds.append(read_cloud(tmp_path / name / f"{name}.las")[0])
    twice = np.unique(read_cloud(strip)[0]["gps_time"][:98])
    right, found = (cloud[np.isin(cloud["gps_time"], twice)] for cloud in clouds)
    passed = (found["echo_flags"] & PASSED_THROUGH) > 0
    assert np.count_nonzero(passed) > 95 and len(found) - len(right) > 95
    numbers = [np.stack(split_numbers(rows[rows["amplitude"] > 0])) for rows in (right, found)]
    np.testing.assert_array_equal(*(np.bincount(100 * total + number) for number, total in numbers))


def test_a_packet_read_twice_or_not_at_all_is_a_bug_not_a_cloud(tiny_strip):
    prepared, unit, results = _read_unit(tiny_strip)
    refuses(StageError, "exactly once", gather_echoes, unit, results[1:])
    refuses(StageError, "exactly once", gather_echoes, unit, [*results, results[0]])
    echoes = gather_echoes(unit, results)
    doubled = echoes.table.attributes["point"].copy()
    matched = np.flatnonzero(doubled >= 0)
    doubled[matched[1]] = doubled[matched[0]]
    wrong = dataclasses.replace(echoes, table=echoes.table.with_attributes(point=doubled))
    refuses(StageError, "one to one", assemble_returns, unit, wrong, prepared.layout)


def test_the_last_chunk_holds_the_rows_that_are_left_be_it_one():
    packing = Packing()
    assert packing.is_empty and not packing.has_chunk(last=True)
    packing.add(SimpleNamespace(count=CHUNK_POINTS + 1))
    assert packing.has_chunk(last=False)
    packing.next_chunk()
    assert not packing.has_chunk(last=False) and packing.has_chunk(last=True)
    assert [part[1:] for part in packing.next_chunk()] == [(CHUNK_POINTS, CHUNK_POINTS + 1)]


def test_a_chunk_has_the_rows_of_a_unit_that_are_its_own():
    rows = np.zeros(10, build_dtype(6, ()))
    rows["X"] = np.arange(10)
    rows = spool_rows(rows)
    ((cut, _), (whole, _)) = (pack_chunk(Path("a.laz"), [(rows, *span)], 6) for span in ((3, 7), (0, 10)))
    (right,) = pack_rows(Path("a.laz"), rows.read(0)[3:7], 6)
    assert cut.data.tobytes() == right.data.tobytes()
    assert (cut.points, whole.points) == (4, 10)


MADE = sorted({name for stage in STAGES.values() if stage.kind == "attribute" for name in stage.makes} & COLUMNS.keys())


@pytest.mark.parametrize("column", [name for name in MADE if COLUMNS[name].extra_bytes])
def test_every_column_that_a_stage_makes_can_be_asked_for(column):
    chain = load_profile("fast")
    if column.startswith("skew"):  # of decomposers that no shipped chain has
        with pytest.raises(wb.ConfigError, match="put decompose.skewed .* and add stage attribute.skew, .* false"):
            with_columns(chain, [column])
        assert "skew needs a chain file" in OPTIONS["columns"].words.help
        return
    full = with_columns(chain, [column])
    assert column in full.makes  # and Chain has checked that what its stages need comes before them
    assert with_columns(full, [column]) is full


def test_nothing_is_found_for_columns_without_a_stage():
    chain = load_profile("fast")
    assert with_columns(chain, ["echo_time", "echo_flags", "nothing"]) is chain


@pytest.mark.parametrize("chain", [None, "auto", "fast", "accurate"])
@pytest.mark.parametrize("columns", ["+range,+energy", "amplitude,range,energy"])
def test_shipped_chains_get_the_stages(tiny_strip, tmp_path, chain, columns):
    result = wb.run(tiny_strip, tmp_path, chain=chain, columns=columns)
    assert not result.failed
    cloud = wb.read_cloud(tmp_path / f"{tiny_strip.stem}.laz")
    known = np.isfinite(cloud["amplitude"])
    assert known.any() and np.isfinite(cloud["energy"][known]).all() and np.isfinite(cloud["range"][known]).any()
    assert ("echo_width" in cloud.dtype.names) == columns.startswith("+")


def test_a_column_that_was_asked_for_and_has_no_value_is_a_warning(tiny_strip, tmp_path):
    result = wb.run(tiny_strip, tmp_path, chain="fast", columns="+cross_section,+incidence_angle")
    warnings = {one.text.split(":")[0]: one for one in result.outcomes[0].report.warnings if one.code == "no-value"}
    assert sorted(warnings) == ["cross_section", "incidence_angle"]
    assert not {one.code for one in warnings.values()} & {*OF_FILES}
    assert "not calibrated; give --calibration" in warnings["cross_section"].text
    assert "`wavebatch survey STRIP --divergence MRAD -o SYSTEM.toml`" in warnings["incidence_angle"].text
    assert not [line for line in result.outcomes[0].report.remarks if "none of" in line]
    words = ("run", tiny_strip, "-o", tmp_path, "--overwrite", "-q", "--profile", "fast", "--fail-on", "no-value")
    for columns, code in (("+cross_section", 3), ("+cross_section_err", 3), ("+range", 0)):
        assert run_command(*words, "--columns", columns).exit_code == code


@pytest.mark.parametrize("column", ["range", "relative_backscatter", "relative_reflectance", "cross_section"])
def test_added_stages_get_the_position_of_the_sensor(column):
    chain = load_profile("fast")
    assert needs_sensor(with_columns(chain, [column]))


def test_a_chain_of_the_user_stays_as_it_is(tiny_strip, tmp_path):
    with pytest.raises(wb.ConfigError, match=r"does not compute 'range'; add stage attribute\.range to it"):
        wb.run(tiny_strip, tmp_path, chain=load_profile("fast"), columns="+range")


def test_a_flight_height_is_used_named_or_refused(tiny_strip, tmp_path):
    def run(height, folder):
        result = wb.run(tiny_strip, tmp_path / folder, chain="fast", columns="+range", flight_height=height)
        return result.outcomes[0]

    known = run(None, "none")
    seen = known.report
    outcome = run(800.0, "near")
    assert outcome.error is None
    (line,) = [line for line in outcome.report.remarks if "--flight-height" in line]
    assert line.startswith("--flight-height 800 m is not used: positions are from the strip's direction vectors: ")
    assert not [line for line in seen.remarks if "--flight-height" in line]
    for height in (80, 8000):
        error = run(height, "far").error
        assert f"--flight-height {height} m contradicts the strip: by its direction vectors" in str(error)
    with pytest.raises(wb.ConfigError, match="--trajectory and --flight-height exclude each other"):
        wb.run(tiny_strip, tmp_path / "both", columns="+range", trajectory=tiny_strip, flight_height=800.0)


def test_echoes_of_two_packets_of_a_pulse_share_it(monkeypatch):
    """A packet for each return: of two pulses each, one apart, one with copies of an echo; and of another digitizer."""
    monkeypatch.setattr(output_rows, "_find_pulses", lambda *_: np.array([0, 0, 2, 2, 4, 4]))
    table = EchoTable.build(np.arange(6), np.array([0.0, 9.0, 0.0, 1.0, 0.0, 9.0]), np.ones(6), np.full(6, 2.0))
    digitizer = np.array([1, 1, 1, 1, 1, 2], np.uint8)
    rays = UnitEchoes(table, table.waveform, np.ones(6, bool), np.tile([0.0, 0.0, -0.15], (6, 1)), np.zeros((6, 3)),
                      digitizer)  # fmt: skip
    packets = PacketTable(digitizer, *(np.arange(6),) * 3, np.arange(6), *np.ones((2, 6), bool))
    unit = SimpleNamespace(packets=packets, start=0)
    assert output_rows.find_shared(unit, rays, None).tolist() == [True, True, False, False, False, False]
    packets.owned[1] = False
    assert not output_rows.find_shared(unit, rays, None).any()
