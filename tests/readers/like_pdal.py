"""Reads LAS by the rules of PDAL's `readers.las`, which cannot be installed here; `tests/test_readers.py` uses it.

Each rule names the function of PDAL that has it (repository PDAL/PDAL, io/LasReader.cpp and io/private/las/). Nothing
of wavebatch is used: a rule that wavebatch misunderstands must show here.
"""

import re
import struct

import laspy
import numpy as np

BASE = {0: 20, 1: 28, 2: 26, 3: 34, 6: 30, 7: 36, 8: 38}
"""Bytes of the point formats that it reads; others are refused (las::baseCount, LasReader::initializeLocal)."""

TYPES = [None, "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]
"""Extra bytes (Utils.cpp, lastypes); codes above 10 are arrays of two or three."""

FIELDS = (
    "X", "Y", "Z", "Intensity", "ReturnNumber", "NumberOfReturns", "ScanDirectionFlag", "EdgeOfFlightLine",
    "Classification", "Synthetic", "KeyPoint", "Withheld", "Overlap", "ScanAngleRank", "UserData", "PointSourceId",
    "GpsTime", "ScanChannel", "Red", "Green", "Blue", "Infrared",
)  # fmt: skip
"""Dimensions of LAS (las::pdrfDims). An extra dimension of such a name, in any case, would be written over it."""


def read(path):
    """Header, WKT and columns; a rule that is broken is an AssertionError."""
    content = path.read_bytes()
    header = _read_header(content)
    records = _read_records(content, header)
    wkt = None
    if header["encoding"] & 16 or not any(one[:2] == ("LASF_Projection", 34735) for one in records):
        texts = [data for user, number, data in records if (user, number) == ("LASF_Projection", 2112)]
        wkt = texts[0].split(b"\0")[0].decode() if texts else None  # Srs::init, srsFromWkt
    return header, wkt, _read_columns(path, content, header, records)


def _read_header(content):
    """Header::fill and Header::validate."""
    assert content[:4] == b"LASF"
    names = ("size", "offset", "records", "format", "length", "legacy")
    header = dict(zip(names, struct.unpack_from("<HIIBHI", content, 94), strict=True))
    header["version"], header["encoding"] = tuple(content[24:26]), struct.unpack_from("<H", content, 6)[0]
    header["legacy_returns"] = struct.unpack_from("<5I", content, 111)
    header["scale"], header["shift"] = struct.unpack_from("<3d", content, 131), struct.unpack_from("<3d", content, 155)
    assert header["version"] <= (1, 4)
    header["compressed"], header["format"] = bool(header["format"] & 0x80), header["format"] & 0x3F
    assert header["format"] in BASE and header["length"] >= BASE[header["format"]]
    header["count"], header["returns"] = header["legacy"], header["legacy_returns"]
    if header["version"] >= (1, 4):
        header["evlr_start"], header["evlrs"], header["count"] = struct.unpack_from("<QIQ", content, 235)
        header["returns"] = struct.unpack_from("<15Q", content, 255)
    assert header["offset"] <= len(content)
    assert header["compressed"] or header["offset"] + header["count"] * header["length"] <= len(content)
    return header


def _read_records(content, header):
    """LasReader::initializeLocal: records end before the points, extended ones before the end of the file."""
    found, place = [], header["size"]
    for _ in range(header["records"]):
        user, number, length = struct.unpack_from("<2x16sHH", content, place)
        assert place + 54 + length <= header["offset"], "size too large -- flows into point data"
        found.append((user.split(b"\0")[0].decode(), number, content[place + 54 : place + 54 + length]))
        place += 54 + length
    place = header.get("evlr_start") or 0
    for _ in range(header.get("evlrs", 0) if place else 0):
        user, number, length = struct.unpack_from("<2x16sHQ", content, place)
        assert place + 60 + length <= len(content), "size too large -- exceeds file size"
        found.append((user.split(b"\0")[0].decode(), number, content[place + 60 : place + 60 + length]))
        place += 60 + length
    return found


def _list_extra(records, header):
    """LasReader::readExtraBytesVlr, ExtraBytesIf::readFrom and LasReader::addDimensions: name, type, scale, offset."""
    data = next((data for user, number, data in records if (user, number) == ("LASF_Spec", 4)), b"")
    assert len(data) % 192 == 0, "Bad size for extra bytes VLR"
    found = []
    for start in range(0, len(data), 192):
        kind, options, name = struct.unpack_from("<2xBB32s", data, start)
        scale, shift = (struct.unpack_from("<d", data, start + place)[0] for place in (112, 136))
        assert 1 <= kind <= 10, "an undocumented type has no name in PDAL"
        fixed = re.sub(r"[^A-Za-z0-9_]", "_", name.split(b"\0")[0].decode())  # Dimension::fixName
        fixed = fixed if fixed[:1].isalpha() else "x" + fixed
        found.append((fixed, "<" + TYPES[kind], scale if options & 8 else 1.0, shift if options & 16 else 0.0))
    size = sum(np.dtype(kind).itemsize for _, kind, _, _ in found)
    assert size <= header["length"] - BASE[header["format"]], "Extra byte specification exceeds point length"
    names = [name.lower() for name, *_ in found]
    assert len(set(names)) == len(names), "two columns of one name: the second is written over the first"
    assert not set(names) & {name.lower() for name in FIELDS}
    return found


def _read_columns(path, content, header, records):
    """LasReader::loadPointV10, loadPointV14 and loadExtraDims. Points of LAZ are decompressed by laszip."""
    if header["compressed"]:
        raw = laspy.read(path, laz_backend=laspy.LazBackend.Laszip).points.array.tobytes()
    else:
        raw = content[header["offset"] : header["offset"] + header["count"] * header["length"]]
    rows = np.frombuffer(raw, np.uint8).reshape(header["count"], header["length"])

    def take(place, kind):
        return np.ascontiguousarray(rows[:, place : place + np.dtype(kind).itemsize]).view(kind)[:, 0]

    columns = {name: take(4 * axis, "<i4") * header["scale"][axis] + header["shift"][axis]
               for axis, name in enumerate("XYZ")}  # fmt: skip
    columns["Intensity"], bits, modern = take(12, "<u2"), rows[:, 14], header["format"] >= 6
    columns["ReturnNumber"] = bits & (15 if modern else 7)
    columns["NumberOfReturns"] = bits >> 4 if modern else bits >> 3 & 7
    columns["Classification"] = rows[:, 16] if modern else rows[:, 15] & 31
    columns["GpsTime"] = take(22 if modern else 20, "<f8")
    place = BASE[header["format"]]
    for name, kind, scale, shift in _list_extra(records, header):
        values = take(place, kind)
        columns[name] = values if (scale, shift) == (1.0, 0.0) else values * scale + shift
        place += np.dtype(kind).itemsize
    return columns
