"""Slow twin of kernels/c/packets.h: the rules for one packet after the other, as docs/las-waveforms.md has them."""

import math

from wavebatch.files.strip.packet_check import MAX_LOCATION, RANGE_RATIO, Reason


def judge_packet(point, kinds, form, unit, data):
    """Reason, samples and whether they are packed; kinds: index -> known, good, odd, packs, width, samples, packed."""
    index, size, offset = int(point["wavepacket_index"]), int(point["wavepacket_size"]), int(point["wavepacket_offset"])
    known, good, odd, packs, width, most, gapless = kinds.get(index, (False, False, False, False, 1, 0, -1))
    packed = size == gapless and not packs
    samples = min(most, size // width)
    if packs:
        samples = most if size > width else 0
    elif packed:
        samples = most
    length = math.sqrt(sum(float(point[axis]) ** 2 for axis in ("x_t", "y_t", "z_t"))) * unit
    location = abs(float(point["return_point_wave_location"]))
    if form == "range":
        length = length / location if location else math.inf
    last = offset + (size if packed or packs else samples * width)
    if not index or not size:
        reason = Reason.NO_WAVEFORM
    elif not known:
        reason = Reason.NO_DESCRIPTOR
    elif not good:
        reason = Reason.BAD_DESCRIPTOR
    elif odd and samples < most:
        reason = Reason.PACKED
    elif samples == 0:
        reason = Reason.EMPTY
    elif offset < data[0]:
        reason = Reason.OUTSIDE
    elif last > data[1]:
        reason = Reason.CUT
    elif not (0 < length <= RANGE_RATIO and location <= MAX_LOCATION):
        reason = Reason.NO_GEOMETRY
    else:
        reason = Reason.USABLE
    return reason, samples, packed
