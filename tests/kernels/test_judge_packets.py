"""Packets judged in C as by a loop in Python, and arrays that C must not see."""

import numpy as np
import pytest
from commands import refuses
from naive_packets import judge_packet

from wavebatch.core.units import HALF_C, PS_PER_NS
from wavebatch.files.las.header import STANDARD_DTYPES
from wavebatch.files.strip.packet_check import MAX_LOCATION, RANGE_RATIO, Reason
from wavebatch.kernels.packets import FIELDS, Geometry, PacketRules, judge_packets

NAMES = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", "x_t", "y_t", "z_t")
UNIT = PS_PER_NS / HALF_C
DATA = (60, 5000)
KINDS = {
    1: (True, True, False, False, 1, 32, -1),
    2: (True, True, True, False, 2, 32, 48),
    3: (True, True, False, True, 1, 32, -1),
    4: (True, False, False, False, 1, 0, -1),
    200: (True, True, False, False, 4, 8, -1),
}
"""Of a descriptor: known, good, odd, packs, width, samples, bytes of packed samples."""


def rules_of(kinds):
    columns = [np.zeros(256, bool) for _ in range(4)]
    columns += [np.ones(256, np.int64), np.zeros(256, np.int64), np.full(256, -1, np.int64)]
    for index, values in kinds.items():
        for column, value in zip(columns, values, strict=True):
            column[index] = value
    return PacketRules(*columns, *DATA)


def draw_points(rng, n):
    points = np.zeros(n, STANDARD_DTYPES[4])
    points["wavepacket_index"] = rng.choice([0, 1, 2, 3, 4, 9, 200], n)
    points["wavepacket_size"] = rng.choice([0, 1, 3, 31, 32, 40, 48, 64, 2**32 - 1], n)
    offsets = [0, 59, 60, 1000, 4952, 4968, 4969, 5000, 2**63, 2**64 - 1]
    points["wavepacket_offset"] = rng.choice(np.array(offsets, np.uint64), n)
    locations = [0, -50, 5e4, 2e9, np.inf, np.nan]
    points["return_point_wave_location"] = rng.choice(locations, n, p=[0.1, 0.2, 0.4, 0.1, 0.1, 0.1])
    for axis in ("x_t", "y_t", "z_t"):
        points[axis] = rng.choice([0, 1e-5, -1.5e-4, 3.0, np.inf, np.nan], n, p=[0.3, 0.2, 0.3, 0.1, 0.05, 0.05])
    return points


def fields_of(points):
    return dict(zip(FIELDS, (points[name] for name in NAMES), strict=True))


@pytest.mark.parametrize("form", ["stored", "range"])
def test_packets_are_judged_as_by_a_loop(rng, form):
    points = draw_points(rng, 20_000)
    geometry = Geometry(form == "range", UNIT, RANGE_RATIO, MAX_LOCATION)
    reason, n_samples, keys, short, packed = judge_packets(fields_of(points), rules_of(KINDS), geometry)
    twins = [judge_packet(point, KINDS, form, UNIT, DATA) for point in points]
    assert reason.tolist() == [twin[0] for twin in twins]
    assert n_samples.tolist() == [0 if twin[0] else twin[1] for twin in twins]
    assert packed.tolist() == [twin[2] for twin in twins]
    full = [KINDS.get(int(index), (0,) * 7)[5] for index in points["wavepacket_index"]]
    assert short.tolist() == [not twin[0] and twin[1] < most for twin, most in zip(twins, full, strict=True)]
    key = [(int(p["wavepacket_offset"]) << 8 & 2**64 - 1) | int(p["wavepacket_index"]) for p in points]
    assert keys.tolist() == key
    assert set(reason.tolist()) == set(Reason) - {Reason.OVERFULL, Reason.DAMAGED, Reason.AT_LIMIT}


def test_arrays_of_other_types_and_records_are_refused(rng):
    points, rules = draw_points(rng, 4), rules_of(KINDS)
    geometry = Geometry(False, UNIT, RANGE_RATIO, MAX_LOCATION)
    wide, apart, few = points["wavepacket_size"].astype("<u8"), points["x_t"].copy(), points["y_t"][:3]
    for change in ({"size": wide}, {"x": apart}, {"y": few}):
        refuses(ValueError, "must be of type", judge_packets, fields_of(points) | change, rules, geometry)
    with pytest.raises(ValueError, match="256 rows"):
        judge_packets(fields_of(points), rules._replace(good=rules.good[:5].copy()), geometry)
