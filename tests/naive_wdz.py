"""Slow twin of kernels/c/wdz.h, both ways: the range coder of LAZ with its models, in plain Python.

From the public description of LAZ and Said (2004). `tests/kernels/test_wdz.py` holds its decoder against lazrs.
"""

import numpy as np
from strips import descriptor

from wavebatch.files.las.header import EVLR_HEADER_SIZE, read_header
from wavebatch.files.strip.reader import StripReader

FULL = 0xFFFFFFFF


class Model:
    """Frequencies of symbols."""

    def __init__(self, symbols):
        self.count, self.total, self.cycle = [1] * symbols, 0, symbols
        self.update()
        self.left = self.cycle = (symbols + 6) >> 1

    def update(self):
        self.total += self.cycle
        if self.total > 1 << 15:
            self.count = [(count + 1) >> 1 for count in self.count]
            self.total = sum(self.count)
        scale, total = 0x80000000 // self.total, 0
        self.start = []
        for count in self.count:
            self.start.append((scale * total) >> 16)
            total += count
        self.left = self.cycle = min((5 * self.cycle) >> 2, (len(self.count) + 6) << 3)

    def seen(self, symbol):
        self.count[symbol] += 1
        self.left -= 1
        if not self.left:
            self.update()


class Bit:
    """The same of a single bit."""

    def __init__(self):
        self.zeros, self.trials, self.chance, self.cycle, self.left = 1, 2, 1 << 12, 4, 4

    def seen(self, bit):
        self.zeros += not bit
        self.left -= 1
        if self.left:
            return
        self.trials += self.cycle
        if self.trials > 1 << 13:
            self.trials, self.zeros = (self.trials + 1) >> 1, (self.zeros + 1) >> 1
            self.trials += self.zeros == self.trials
        self.chance = (self.zeros * (0x80000000 // self.trials)) >> 18
        self.left = self.cycle = min((5 * self.cycle) >> 2, 64)


class Encoder:
    """Writes symbols into bytes."""

    def __init__(self):
        self.base, self.length, self.out = 0, FULL, bytearray()

    def _settle(self):
        if self.base > FULL:  # carry
            self.base &= FULL
            at = len(self.out) - 1
            while self.out[at] == 0xFF:
                self.out[at] = 0
                at -= 1
            self.out[at] += 1
        while self.length < 1 << 24:
            self.out.append(self.base >> 24)
            self.base = (self.base << 8) & FULL
            self.length = (self.length << 8) & FULL

    def symbol(self, model, symbol):
        step = self.length >> 15
        low = model.start[symbol] * step
        last = symbol == len(model.count) - 1
        self.length = (self.length if last else model.start[symbol + 1] * step) - low
        self.base += low
        self._settle()
        model.seen(symbol)

    def bit(self, model, bit):
        at = model.chance * (self.length >> 13)
        self.base, self.length = (self.base + at, self.length - at) if bit else (self.base, at)
        self._settle()
        model.seen(bit)

    def plain(self, bits, value):
        self.length >>= bits
        self.base += value * self.length
        self._settle()

    def done(self):
        more = self.length > 1 << 25
        self.base += (1 << 24) if more else (1 << 23)
        self.length = (1 << 23) if more else (1 << 15)
        self._settle()
        return bytes(self.out) + bytes(3 if more else 2)


class Decoder:
    """Reads them back."""

    def __init__(self, data):
        self.data, self.at = data, 4
        self.value, self.length = int.from_bytes(data[:4], "big"), FULL

    def _settle(self):
        while self.length < 1 << 24:
            self.value = (self.value << 8 | self.data[self.at]) & FULL
            self.at += 1
            self.length = (self.length << 8) & FULL

    def symbol(self, model):
        whole, step = self.length, self.length >> 15
        symbol = max(k for k, start in enumerate(model.start) if start * step <= self.value)
        last = symbol == len(model.count) - 1
        low = model.start[symbol] * step
        self.length = (whole if last else model.start[symbol + 1] * step) - low
        self.value -= low
        self._settle()
        model.seen(symbol)
        return symbol

    def bit(self, model):
        at = model.chance * (self.length >> 13)
        bit = int(self.value >= at)
        self.value, self.length = (self.value - at, self.length - at) if bit else (self.value, at)
        self._settle()
        model.seen(bit)
        return bit

    def plain(self, bits):
        if bits > 19:
            low = self.plain(16)
            return self.plain(bits - 16) << 16 | low
        self.length >>= bits
        value = self.value // self.length
        self.value -= value * self.length
        self._settle()
        return value


class Differences:
    """Models of differences of numbers of so many bits; contexts: several models of the number of bits."""

    def __init__(self, bits, contexts=1):
        self.bits, self.range = bits, 1 << bits
        self.number = [Model(bits + 1) for _ in range(contexts)]
        self.zero_one = Bit()
        self.place = [None, *(Model(1 << min(k, 8)) for k in range(1, bits + 1))]

    def encode(self, encoder, before, value):
        c = value - before
        half = self.range // 2
        c += self.range if c < -half else -self.range if c > half - 1 else 0
        k = (-c if c <= 0 else c - 1).bit_length()
        encoder.symbol(self.number[0], k)
        if not k:
            encoder.bit(self.zero_one, c)
            return
        c = c + (1 << k) - 1 if c < 0 else c - 1
        rest = max(k - 8, 0)
        encoder.symbol(self.place[k], c >> rest)
        if rest:
            encoder.plain(rest, c & ((1 << rest) - 1))

    def decode(self, decoder, before, context=0):
        k = decoder.symbol(self.number[context])
        if not k:
            c = decoder.bit(self.zero_one)
        elif k == 32:
            c = -(1 << 31)
        else:
            rest = max(k - 8, 0)
            c = decoder.symbol(self.place[k])
            c = c << rest | decoder.plain(rest) if rest else c
            c = c + 1 if c >= 1 << (k - 1) else c - (1 << k) + 1
        return (before + c) % self.range


def compress(samples, bits):
    """A packet of LAStools: descriptor compression 1."""
    encoder, differences = Encoder(), Differences(bits)
    values = [int(value) for value in samples]
    for before, value in zip(values[:-1], values[1:], strict=True):
        differences.encode(encoder, before, value)
    return values[0].to_bytes(bits // 8, "little") + encoder.done()


def pack_strip(source, target, mixed=False):
    """The strip with its packets as LAStools compresses them; mixed: descriptor 1 stays as it is."""
    data, header = bytearray(source.read_bytes()), read_header(source)
    with StripReader(source) as reader:
        points = reader.read_points(0, header.point_count).copy()
        digitizers = reader.facts.digitizers
    old = source.with_suffix(".wdp").read_bytes()
    out, moved = bytearray(old[:EVLR_HEADER_SIZE]) + b"LAStools waveform 260101" + b"\0\0", {}
    for row in range(len(points)):
        index, at = int(points["wavepacket_index"][row]), int(points["wavepacket_offset"][row])
        if index and (index, at) not in moved:
            bits, size = digitizers[index].bits, int(points["wavepacket_size"][row])
            samples = np.frombuffer(old, f"<u{bits // 8}", size // (bits // 8), at)
            packet = old[at : at + size] if mixed and index == 1 else compress(samples, bits)
            moved[index, at] = len(out), len(packet)
            out += packet
        if index:
            points["wavepacket_offset"][row], points["wavepacket_size"][row] = moved[index, at]
    for digitizer in digitizers.values():
        if digitizer.n_samples and not (mixed and digitizer.index == 1):
            plain = descriptor(digitizer.index)[:20]  # its user id and number
            at = bytes(data).index(plain[2:]) - 2
            data[at + 54 + 1] = 1
    start = header.offset_to_points
    data[start : start + points.nbytes] = points.tobytes()
    target.write_bytes(data)
    target.with_suffix(".wdz").write_bytes(out)
    return target
