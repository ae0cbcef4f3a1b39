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
from collections.abc import Iterator, Mapping

Edit = list
"""One of

- ["set", place, hex], ["every", place, step, count, hex], ["fill", place, bytes, hex]: bytes are overwritten
- ["insert", place, hex, times], ["delete", place, bytes], ["swap", place, bytes, hex]
- ["take", kind]: all is replaced by the sound input of another kind
- ["member", name, edit]: of a file in a .npz, which is packed again, so that its checksum is right.
"""


def apply_edits(data: bytes, edits: list[Edit], sound: Mapping[str, bytes] | None = None) -> bytes:
    """Return the damaged bytes; sound: inputs by kind, for "take"."""
    damaged = bytearray(data)
    for edit in edits:
        _apply(damaged, edit, sound or {})
    return bytes(damaged)


def _apply(data: bytearray, edit: Edit, sound: Mapping[str, bytes]) -> None:
    name, place, *rest = edit
    if name == "set":
        _put(data, place, rest[0])
    elif name == "every":
        for k in range(rest[1]):
            _put(data, place + k * rest[0], rest[2])
    elif name == "fill":
        pattern = bytes.fromhex(rest[1])
        end = min(place + rest[0], len(data))
        data[place:end] = (pattern * ((end - place) // len(pattern) + 1))[: max(end - place, 0)]
    elif name == "insert":
        data[place:place] = bytes.fromhex(rest[0]) * rest[1]
    elif name == "delete":
        del data[place : place + rest[0]]
    elif name == "swap":
        data[place : place + rest[0]] = bytes.fromhex(rest[1])
    elif name == "take":
        data[:] = sound[place]
    else:
        data[:] = _repack(bytes(data), place, rest[0])


def _put(data: bytearray, place: int, what: str) -> None:
    if place <= len(data):
        data[place : place + len(what) // 2] = bytes.fromhex(what)


def _repack(data: bytes, name: str, edit: Edit) -> bytes:
    packed = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
            for member in old.namelist():
                content = old.read(member)
                new.writestr(zipfile.ZipInfo(member), apply_edits(content, [edit]) if member == name else content)
    except (
        zipfile.BadZipFile,
        zipfile.LargeZipFile,
        OSError,
        EOFError,
        ValueError,
        NotImplementedError,
        zipfile.zlib.error,
    ):
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
    choice = rng.random()
    if choice < 0.1:
        return ["delete", at, len(data)]
    if choice < 0.2:
        return ["delete", at, rng.choice([1, 4, 60])]
    if choice < 0.3:
        return ["insert", at, rng.randbytes(rng.choice([1, 4])).hex(), rng.choice([1, 15])]
    if choice < 0.4:
        return [
            "fill",
            at,
            rng.choice([100, 1000, 10_000]),
            rng.choice(["00", "ff", "80", "7f", rng.randbytes(7).hex()]),
        ]
    width = rng.choice([1, 2, 4, 8])
    values = [b"\xff" * width, bytes(width), rng.randbytes(width), bytes(width - 1) + b"\x80", b"\0" * 6 + b"\xf8\x7f"]
    return ["set", at, rng.choice(values).hex()]


def _damage_field(data: bytes, place: int, form: str, step: int, count: int, rng: random.Random) -> Edit:
    """One field, or the field of some or all of `count` records of `step` bytes."""
    size = struct.calcsize("<" + form)
    k = rng.randrange(count)
    value = odd_value(data[place + k * step : place + k * step + size], form, rng).hex()
    if count == 1 or rng.random() < 0.4:
        return ["set", place + k * step, value]
    stride = rng.choice([1, 1, 2, 7])
    return ["every", place, step * stride, count // stride, value]


def odd_value(now: bytes, form: str, rng: random.Random) -> bytes:
    """Return bytes for a field of this form (as `struct` has it), often near a limit or near what it holds."""
    size = struct.calcsize("<" + form)
    now = now.ljust(size, b"\0")
    if form.endswith("s"):
        texts = [
            b"",
            b"\xff" * size,
            b"\x1b[2J",
            b"a" * size,
            rng.randbytes(size),
            now[::-1],
            b"LASF_Spec",
            b"\0" + now,
        ]
        return rng.choice(texts)[:size].ljust(size, b"\0")
    if form in "fd":
        value = struct.unpack("<" + form, now)[0]
        values = [0.0, -0.0, float("nan"), float("inf"), float("-inf"), 1e-38, 3e38, -3e38, 1e-9, 1.0, -1.0, 1e6]
        values += [value * factor for factor in (-1, 2, 0.5, 1000, 1e-3, 1.001)] + [5e-324, 1e300, -1e300] * (
            form == "d"
        )
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
    return ["set", place + start, rng.choice(fitting).ljust(end - start).hex()]


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
    at, choice = rng.randrange(max(len(data), 1)), rng.random()
    tokens = [match.span() for match in _TOKEN.finditer(data)]
    ends = list(itertools.accumulate(map(len, data.splitlines(keepends=True)), initial=0))
    lines = list(itertools.pairwise(ends)) or [(0, len(data))]
    if choice < 0.45 and tokens:
        start, end = rng.choice(tokens)
        other = data[slice(*rng.choice(tokens))]
        return ["swap", start + offset, end - start, rng.choice([*_NUMBERS, *_ODD, other, other, other]).hex()]
    if choice < 0.55:
        start, end = rng.choice(lines)
        return ["delete", start + offset, end - start]
    if choice < 0.62:
        start, end = rng.choice(lines)
        return ["insert", rng.choice(lines)[0] + offset, data[start:end].hex(), rng.choice([1, 3, 100])]
    if choice < 0.72:
        return ["delete", at + offset, rng.choice([1, 5, 40, len(data)])]
    if choice < 0.78:
        return ["insert", at + offset, rng.choice(_ODD).hex(), rng.choice([500, 5000, 100_000])]
    if choice < 0.85:
        part = data[at : at + rng.choice([5, 50, 500])]
        return ["insert", rng.randrange(max(len(data), 1)) + offset, part.hex(), rng.choice([1, 3])]
    if choice < 0.95:
        return ["insert", at + offset, rng.choice(_ODD).hex(), 1]
    return ["set", at + offset, rng.choice(_ODD).hex()]


# ----------------------------------------------------------------------------------------------------- fields


def list_fields(data: bytes, kind: str) -> list[tuple[int, str, int, int]]:
    """Return place, form, step and count of the fields of a binary file; header and descriptors several times."""
    if kind.endswith((".las", ".laz")):
        return list(_las_fields(data))
    if kind.endswith(".wdp"):
        return [(0, "H", 0, 1), (2, "16s", 0, 1), (18, "H", 0, 1), (20, "Q", 0, 1), (60, "B", 1, len(data) - 60)]
    if kind.endswith(".sbet"):
        return [(8 * k, "d", 136, len(data) // 136) for k in range(17)]
    return []


_HEADER = [
    (4, "H"), (6, "H"), (8, "16s"), (24, "B"), (25, "B"), (26, "32s"), (58, "32s"), (94, "H"), (96, "I"), (100, "I"),
    (104, "B"), (105, "H"), (107, "I"),
    *((111 + 4 * k, "I") for k in range(5)), *((131 + 8 * k, "d") for k in range(12)),
    (227, "Q"),
]  # fmt: skip
_HEADER_14 = [(235, "Q"), (243, "I"), (247, "Q"), *((255 + 8 * k, "Q") for k in range(15))]
_DESCRIPTOR = [(0, "B"), (1, "B"), (2, "I"), (6, "I"), (10, "d"), (18, "d")]
_EXTRA = [
    (2, "B"),
    (3, "B"),
    (4, "32s"),
    (40, "d"),
    (40, "Q"),
    (64, "d"),
    (88, "d"),
    (112, "d"),
    (136, "d"),
    (160, "32s"),
]
_LASZIP = [(0, "H"), (2, "H"), (4, "B"), (5, "B"), (6, "H"), (8, "I"), (12, "I"), (16, "q"), (24, "q"), (32, "H")]
_OLD_POINT = [(0, "i"), (4, "i"), (8, "i"), (12, "H"), (14, "B"), (15, "B"), (16, "b"), (17, "B"), (18, "H"), (20, "d")]
_NEW_POINT = [(0, "i"), (4, "i"), (8, "i"), (12, "H"), (14, "B"), (15, "B"), (16, "B"), (17, "B"), (18, "h"), (20, "H"),
              (22, "d")]  # fmt: skip
_WAVE = [(0, "B"), (1, "Q"), (9, "I"), (13, "f"), (17, "f"), (21, "f"), (25, "f")]
_WAVES_AT = {4: 28, 5: 34, 9: 30, 10: 38}


def _las_fields(data: bytes) -> Iterator[tuple[int, str, int, int]]:
    def read(place: int, form: str) -> int:
        return struct.unpack_from("<" + form, data, place)[0]

    header = [*_HEADER, *(_HEADER_14 if data[25] >= 4 else [])]
    yield from [(place, form, 0, 1) for place, form in header] * 2
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
        fields = _OLD_POINT if point_format < 6 else _NEW_POINT
        waves = _WAVES_AT.get(point_format)
        fields = fields + [(waves + place, form) for place, form in _WAVE] * 2 if waves else fields
        yield from [(points + place, form, length, count) for place, form in fields] * 2
        end = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}[point_format]
        yield from [(points + place, "f", length, count) for place in range(end, length - 3, 4)]
    packets = read(227, "Q")
    if packets and packets + 60 < len(data):
        yield from [(packets + place, form, 0, 1) for place, form in ((0, "H"), (2, "16s"), (18, "H"), (20, "Q"))]
        yield from [
            (packets + 60, "B", 1, len(data) - packets - 60),
            (packets + 60, "H", 2, (len(data) - packets) // 2 - 30),
        ]


def _vlr_fields(body: int, user: bytes, number: int, length: int) -> Iterator[tuple[int, str, int, int]]:
    head = body - 54
    yield from [(head + place, form, 0, 1) for place, form in ((0, "H"), (2, "16s"), (18, "H"), (20, "H"), (22, "32s"))]
    if user == b"LASF_Spec" and 100 <= number <= 354:
        yield from [(body + place, form, 0, 1) for place, form in _DESCRIPTOR] * 4
    elif user == b"LASF_Spec" and number == 4:
        yield from [(body + place, form, 192, length // 192) for place, form in _EXTRA] * 2
    elif user == b"laszip encoded":
        yield from [(body + place, form, 0, 1) for place, form in _LASZIP] * 2
        yield from [(body + 34 + place, "H", 6, max((length - 34) // 6, 1)) for place in (0, 2, 4)] * 2
    elif user == b"LASF_Projection" and number == 34735:
        yield from [(body, "H", 2, length // 2)] * 4
    elif user == b"LASF_Projection" and number == 34736:
        yield from [(body, "d", 8, length // 8)] * 2
    elif length:
        yield (body, "B", 1, length)
