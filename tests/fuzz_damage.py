"""Edits that damage a sound input, and how they are drawn: by the fields of the format, so that they reach inside.

Random bytes are mostly refused by the first check. So most edits of binary files set one field of the header, of a
VLR, of a descriptor or of points to a value that a reader may not expect, and most edits of texts replace one token.
`tests/fuzzing.py` draws and applies them. An edit is plain data, so that it can be kept as JSON.
"""

from __future__ import annotations

import io
import itertools
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping

from wavebatch.files.las.header import STANDARD_DTYPES

Edit = list
"""One of

- ["swap", place, bytes, hex, times]: bytes from a place on are replaced by those in hex, so many times
- ["every", place, step, count, hex]: bytes of `count` records of `step` bytes are overwritten
- ["take", kind]: all is replaced by the sound input of another kind
- ["member", name, edit]: of a file in a .npz, which is packed again, so that its checksum is right.
"""


def apply_edits(data: bytes, edits: list[Edit], sound: Mapping[str, bytes] | None = None) -> bytes:
    """Return the damaged bytes; sound: inputs by kind, for "take"."""
    damaged = bytearray(data)
    for name, place, *rest in edits:
        if name == "swap":
            length, new, times = rest
            damaged[place : place + length] = bytes.fromhex(new) * times
        elif name == "every":
            step, count, new = rest
            for at in range(place, min(place + step * count, len(damaged)), step):
                damaged[at : at + len(new) // 2] = bytes.fromhex(new)
        elif name == "take":
            damaged[:] = (sound or {})[place]
        else:
            damaged[:] = _repack(bytes(damaged), place, rest[0])
    return bytes(damaged)


def _repack(data: bytes, name: str, edit: Edit) -> bytes:
    packed = io.BytesIO()
    broken = zipfile.BadZipFile, zipfile.LargeZipFile, OSError, EOFError, ValueError, NotImplementedError, zlib.error
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
            for member in old.namelist():
                content = old.read(member)
                new.writestr(zipfile.ZipInfo(member), apply_edits(content, [edit]) if member == name else content)
    except broken:
        return data  # an earlier edit has damaged the file
    return packed.getvalue()


# ---------------------------------------------------------------------------------------------------- drawing

_NUMBERS = [
    b"0", b"-1", b"1", b"2", b"1e308", b"-1e308", b"1e-320", b"1e-9", b"1e9", b"1e16", b"nan", b"inf", b"-inf",
    b"1" + b"0" * 400, b"9" * 5000, b"0x" + b"f" * 2000, b"true", b'"x"', b'""', b"[]", b"[[]]", b"{}", b"null",
    b"9007199254740993", b"-0.0", b"1e400", b"18446744073709551616", b"2147483648", b"-2147483649", b"65536", b"256",
    b"0.5", b"1e5", b"[1, 2]", b"[nan]", b"1979-05-27", b"{a = 1}",
]  # fmt: skip
_ODD = [
    b"\0", b"\xff", b"\x1b[31m", b"\n", b"\r", b'"', b"'", b"[", b"{", b"]", b"}", b",", b".", b"=", b"#", b"\\",
    b"\xe2\x80\xae", b"a.", b"[[", b'"""', b"@", b"*", b"\xf0\x9f\x98\x80", b"-", b" ", b"\t", b"\xef\xbb\xbf",
    b"\xed\xa0\x80", b"NaN", b"Infinity", b"\\ud800", b"\\u0000", b"x" * 300, b"/", b"../", b"~",
]  # fmt: skip
_TOKEN = re.compile(rb"\"[^\"\n]{0,80}\"|[A-Za-z_][A-Za-z0-9_.-]*|[-+0-9.eE]+")
_BINARY = (".las", ".laz", ".wdp", ".sbet", ".npz")


def damage(sound: Mapping[str, bytes], kind: str, rng: random.Random) -> list[Edit]:
    """Return random edits of the sound input of a kind."""
    data = sound[kind]
    if rng.random() < 0.01:
        return [["take", rng.choice(sorted(sound))]]
    texts = list(find_texts(data)) if kind.endswith((".las", ".laz")) else []
    if texts and rng.random() < 0.1:
        return [_damage_record(data, *rng.choice(texts), rng) for _ in range(rng.choice([1, 1, 2, 5]))]
    if kind.endswith(".npz"):
        make = _damage_npz
    else:
        make = _damage_bytes if kind.endswith(_BINARY) else _damage_text
    fields = list_fields(data, kind)
    return [make(data, fields, rng) for _ in range(rng.choice([1, 1, 1, 2, 3, 5, 20]))]


def _damage_bytes(data: bytes, fields: list[tuple[int, str, int, int]], rng: random.Random) -> Edit:
    if fields and rng.random() < 0.8:
        return _damage_field(data, *rng.choice(fields), rng)
    at = rng.randrange(700 if rng.random() < 0.5 and len(data) > 700 else max(len(data), 1))
    width, many = rng.choice([1, 2, 4, 8]), rng.choice([100, 1000, 10_000])
    some = rng.choice([b"\0", b"\xff", b"\x80", b"\x7f", rng.randbytes(7)])
    values = [b"\xff" * width, bytes(width), rng.randbytes(width), bytes(width - 1) + b"\x80", b"\0" * 6 + b"\xf8\x7f"]
    value = rng.choice(values)
    return _swap(at, rng, [
        (1, len(data), b"", 1), (1, rng.choice([1, 4, 60]), b"", 1), (1, 0, rng.randbytes(4), rng.choice([1, 15])),
        (1, many, some, many // len(some)), (6, len(value), value, 1),
    ])  # fmt: skip


def _swap(place: int, rng: random.Random, ways: list[tuple[float, int, bytes, int]]) -> Edit:
    """One of some swaps at a place; ways: how often it is drawn, bytes that go, bytes that come, and how many times."""
    _, length, new, times = rng.choices(ways, [often for often, *_ in ways])[0]
    return ["swap", place, length, new.hex(), times]


def _damage_field(data: bytes, place: int, form: str, step: int, count: int, rng: random.Random) -> Edit:
    """One field, or the field of some or all of `count` records of `step` bytes."""
    size = struct.calcsize("<" + form)
    k = rng.randrange(count)
    value = odd_value(data[place + k * step : place + k * step + size], form, rng).hex()
    if count == 1 or rng.random() < 0.4:
        return ["swap", place + k * step, size, value, 1]
    stride = rng.choice([1, 1, 2, 7])
    return ["every", place, step * stride, count // stride, value]


def odd_value(now: bytes, form: str, rng: random.Random) -> bytes:
    """Return bytes for a field of this form (as `struct` has it), often near a limit or near what it holds."""
    size = struct.calcsize("<" + form)
    now = now.ljust(size, b"\0")
    if form.endswith("s"):
        texts = [b"", b"\xff" * size, b"\x1b[2J", b"a" * size, rng.randbytes(size), now[::-1], b"LASF_Spec", b"\0a"]
        return rng.choice(texts)[:size].ljust(size, b"\0")
    if form in "fd":
        value = struct.unpack("<" + form, now)[0]
        values = [0.0, -0.0, float("nan"), float("inf"), float("-inf"), 1e-38, 3e38, -3e38, 1e-9, 1.0, -1.0, 1e6]
        values += [value * factor for factor in (-1, 2, 0.5, 1000, 1e-3, 1.001)]
        values += [5e-324, 1e300, -1e300] if form == "d" else []
        try:
            return struct.pack("<" + form, rng.choice(values))
        except (OverflowError, ValueError):
            return b"\xff" * size
    bits = 8 * size
    value = int.from_bytes(now, "little")
    values = [0, 1, 2, 3, 255, 1 << (bits - 1), (1 << (bits - 1)) - 1, (1 << bits) - 1, (1 << bits) - 2]
    values += [value + 1, value - 1, 2 * value, value // 2, value ^ (1 << rng.randrange(bits)), rng.getrandbits(bits)]
    values += [rng.randrange(300), 1 << rng.randrange(bits), value + 8, value - 8, value + 60]
    return (rng.choice(values) % (1 << bits)).to_bytes(size, "little")


def find_texts(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield place and bytes of the records that hold text: the account of the run, and the CRS."""
    for place, user, number, length in _list_records(data):
        if user == b"wavebatch" or user == b"LASF_Projection" and number in (2112, 34737):
            yield place, length


def _damage_record(data: bytes, place: int, length: int, rng: random.Random) -> Edit:
    """One token of a text is another one that is not longer, filled up with blanks."""
    text = data[place : place + length]
    tokens = [match.span() for match in _TOKEN.finditer(text)]
    start, end = rng.choice(tokens)
    others = [text[slice(*rng.choice(tokens))] for _ in range(20)]
    fitting = [value for value in [*_NUMBERS, *_ODD, *others] if len(value) <= end - start]
    return ["swap", place + start, end - start, rng.choice(fitting).ljust(end - start).hex(), 1]


def _list_records(data: bytes) -> Iterator[tuple[int, bytes, int, int]]:
    """Yield place of the content, user, number and bytes of each VLR."""
    at, count = struct.unpack_from("<H", data, 94)[0], struct.unpack_from("<I", data, 100)[0]
    for _ in range(count):
        number, length = struct.unpack_from("<HH", data, at + 18)
        yield at + 54, data[at + 2 : at + 18].rstrip(b"\0"), number, length
        at += 54 + length


def _damage_npz(data: bytes, fields: list, rng: random.Random) -> Edit:
    if rng.random() < 0.2:
        return _damage_bytes(data, [], rng)
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        name = rng.choice(file.namelist())
        content = file.read(name)
    head = 10 + int.from_bytes(content[8:10], "little")
    choice = rng.random()
    if choice < 0.35:  # the text that says type, order and shape
        return ["member", name, _damage_text(content[10:head], [], rng, offset=10)]
    if choice < 0.9 and len(content) > head:
        form = {"f8": "d", "f4": "f", "i8": "q", "i4": "i", "u4": "I", "u2": "H", "i2": "h"}.get(
            next(iter(re.findall(r"'[<|]([a-z][0-9])'", content[:head].decode("latin-1"))), ""), "B"
        )
        step = struct.calcsize("<" + form)
        count = max((len(content) - head) // step, 1)
        return ["member", name, _damage_field(content, head, form, step, count, rng)]
    return ["member", name, _damage_bytes(content, [], rng)]


def _damage_text(data: bytes, fields: list, rng: random.Random, offset: int = 0) -> Edit:
    at, size = rng.randrange(max(len(data), 1)), max(len(data), 1)
    start, end = rng.choice([match.span() for match in _TOKEN.finditer(data)] or [(at, at + 1)])
    ends = list(itertools.accumulate(map(len, data.splitlines(keepends=True)), initial=0))
    lines = list(itertools.pairwise(ends)) or [(0, len(data))]
    (first, last), odd = rng.choice(lines), rng.choice(_ODD)
    other = data[slice(*rng.choice([match.span() for match in _TOKEN.finditer(data)] or [(0, 1)]))]
    part = data[at : at + rng.choice([5, 50, 500])]
    often, place, length, new, times = rng.choices(ways := [
        (45, start, end - start, rng.choice([*_NUMBERS, *_ODD, other, other, other]), 1),
        (10, first, last - first, b"", 1), (7, rng.choice(lines)[0], 0, data[first:last], rng.choice([1, 3, 100])),
        (10, at, rng.choice([1, 5, 40, size]), b"", 1), (6, at, 0, odd, rng.choice([500, 5000, 100_000])),
        (7, rng.randrange(size), 0, part, rng.choice([1, 3])), (10, at, 0, odd, 1), (5, at, len(odd), odd, 1),
    ], [way[0] for way in ways])[0]  # fmt: skip
    return ["swap", place + offset, length, new.hex(), times]


# ----------------------------------------------------------------------------------------------------- fields


def list_fields(data: bytes, kind: str) -> list[tuple[int, str, int, int]]:
    """Return place, form, step and count of the fields of a binary file; header and descriptors several times."""
    if kind.endswith((".las", ".laz")):
        return list(_las_fields(data))
    if kind.endswith(".wdp"):
        return [*_fields("H16sHQ"), (60, "B", 1, len(data) - 60)]
    if kind.endswith(".sbet"):
        return _fields("17d", 0, 136, len(data) // 136)
    return []


def _fields(layout: str, at: int = 0, step: int = 0, count: int = 1) -> list[tuple[int, str, int, int]]:
    """The fields of a structure, written as for `struct`; step and count: of equal structures in a row."""
    found = []
    for number, letter in re.findall(r"(\d*)([a-zA-Z])", layout):
        forms = [number + letter] if letter in "sx" else [letter] * int(number or 1)
        for form in forms:
            found += [] if letter == "x" else [(at, form, step, count)]
            at += struct.calcsize("<" + form)
    return found


_HEADER = "4x2H16s2B32s32s4xH2IBHI5I12dQ"
_DESCRIPTOR, _EXTRA, _LASZIP = "2B2I2d", "2x2B32s4xQ16xd16xd16xd16xd16x32s", "2H2BH2I2qH"


def _las_fields(data: bytes) -> Iterator[tuple[int, str, int, int]]:
    def read(place: int, form: str) -> int:
        return struct.unpack_from("<" + form, data, place)[0]

    yield from _fields(_HEADER + "QI16Q" * (data[25] >= 4)) * 2
    for place, user, number, size in _list_records(data):
        yield from _vlr_fields(place, user, number, size)
    points, length, point_format = read(96, "I"), read(105, "H"), data[104]
    count = read(247, "Q") if data[25] >= 4 else read(107, "I")
    if point_format & 0x80:
        table = read(points, "q")
        yield from [(points, "q", 0, 1), (table, "I", 0, 1), (table + 4, "I", 0, 1)] * 3
        yield from [(points + 8, "B", 1, max(table - points - 8, 1))] * 10
        yield (table + 8, "B", 1, max(len(data) - table - 8, 1))
    else:
        known = STANDARD_DTYPES[point_format]
        for name, (dtype, place, *_) in known.fields.items():
            often = 4 if name.startswith("wavepacket") or name in ("x_t", "y_t", "z_t") else 2
            yield from [(points + place, {"<u8": "Q"}.get(dtype.str, dtype.char), length, count)] * often
        yield from [(points + place, "f", length, count) for place in range(known.itemsize, length - 3, 4)]
    packets = read(227, "Q")
    if packets and packets + 60 < len(data):
        rest = len(data) - packets
        yield from _fields("H16sHQ", packets)
        yield from [(packets + 60, "B", 1, rest - 60), (packets + 60, "H", 2, rest // 2 - 30)]


def _vlr_fields(body: int, user: bytes, number: int, length: int) -> Iterator[tuple[int, str, int, int]]:
    yield from _fields("H16sHH32s", body - 54)
    if user == b"LASF_Spec" and 100 <= number <= 354:
        yield from _fields(_DESCRIPTOR, body) * 4
    elif user == b"LASF_Spec" and number == 4:
        yield from _fields(_EXTRA, body, 192, length // 192) * 2
    elif user == b"laszip encoded":
        yield from _fields(_LASZIP, body) * 2
        yield from _fields("3H", body + 34, 6, max((length - 34) // 6, 1)) * 2
    elif user == b"LASF_Projection" and number in (34735, 34736):
        form, size = ("H", 2) if number == 34735 else ("d", 8)
        yield from [(body, form, size, length // size)] * 4
    elif length:
        yield (body, "B", 1, length)
