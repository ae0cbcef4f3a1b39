"""Whole output files: read back with lazrs and LASzip, byte by byte where bytes must be kept."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from struct import pack

import laspy
import numpy as np
import pytest
from commands import refuses
from writer_tools import (
    BACKENDS,
    data_file,
    facts_of,
    plan_output,
    read_provenance,
    read_raw,
    write_source,
    write_strip,
)

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import CloudReader, ColumnReader, read_cloud
from wavebatch.files.cloud.column_names import STYLES
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.las.header import WKT_ID, ExtraRecord, Vlr, build_wkt, find_evlrs, read_header

RIEGL = "riegl-q680i/100429_152240_2535pt_UTM.las"
LEICA = "leica-als/simple1_3_full_internal.las"
YELLOWSCAN = "no-packets/fullwave.laz"
COLUMNS = ["amplitude", "echo_width", "range", "echo_flags"]
NOT_KEPT = (("LASF_Spec", 4), "laszip encoded", "wavebatch")
UTM_KEYS, OTHER_KEYS = (
    Vlr(b"LASF_Projection", 34735, pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, code)) for code in (32633, 31468)
)


def make_rows(layout, points, seed=0):
    rng = np.random.default_rng(seed)
    n = len(points)
    columns = {name: rng.normal(50, 10, n) for name in COLUMNS[:-1]}
    columns["amplitude"][rng.random(n) < 0.1] = np.nan
    columns["echo_flags"] = rng.integers(0, 65536, n).astype(np.uint16)
    return layout.rows(points, columns=columns, matched=rng.random(n) < 0.8)


def write(layout, target, rows, *, provenance=None, size=None, **options):
    with CloudWriter(layout, target, provenance=provenance or {}, **options) as cloud:
        for at in range(0, len(rows), size or max(1, len(rows))):
            cloud.write(rows[at : at + (size or len(rows))])
        cloud.commit()
    return cloud


def copy(source, target, given, columns=(), *, values=None, provenance=None, size=None, **plan):
    """Points with columns, random ones or the given values, in a cloud as the source asks for it: layout and rows."""
    layout = plan_output(source, columns, **plan)
    rows = make_rows(layout, given) if columns and values is None else layout.rows(given, columns=values or {})
    write(layout, target, rows, provenance=provenance, size=size)
    return layout, rows


def payloads(path, *left_out):
    return [v for v in read_header(path).vlrs if (v.user, v.record_id) not in left_out and v.user not in left_out]


def check_truth(path, rows):
    """Header and extra-byte records say what the rows are."""
    header = read_header(path)
    assert header.point_count == len(rows)
    with laspy.open(path, laz_backend=laspy.LazBackend.Laszip, read_evlrs=False) as reader:
        seen = reader.header
        record = laspy.PackedPointRecord(rows, seen.point_format)
    numbers = np.array(record["return_number"])
    expected = [np.count_nonzero(numbers == number) for number in range(1, 16)]
    limit = 5 if header.version < (1, 4) else 15
    assert list(seen.number_of_points_by_return[:limit]) == expected[:limit]
    for axis, name in enumerate("XYZ"):
        bounds = [value * seen.scales[axis] + seen.offsets[axis] for value in (rows[name].min(), rows[name].max())]
        np.testing.assert_allclose([seen.mins[axis], seen.maxs[axis]], bounds, rtol=0, atol=1e-9)
    for struct in seen.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs if seen.point_format.num_extra_bytes else ():
        if struct.data_type == 0:
            continue
        values = rows[struct.format_name()].reshape(len(rows), -1)
        for element in range(values.shape[1]):
            column = values[:, element]
            if struct.no_data is not None:
                column = column[column != struct.no_data[element]]
            if column.dtype.kind == "f":
                column = column[np.isfinite(column)]
            assert struct._raw_min()[element] == column.min() and struct._raw_max()[element] == column.max()


@pytest.mark.parametrize("name", [
    RIEGL, LEICA, YELLOWSCAN, "no-packets/pdrf5-1.3.laz", "no-packets/pdrf10-1.4.laz", "no-packets/pdrf9-1.5.laz",
])  # fmt: skip
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_real_files_come_back_by_both_readers(tmp_path, name, suffix):
    path, target = data_file(name), tmp_path / f"out{suffix}"
    layout, rows = copy(path, target, read_raw(path, laspy.LazBackend.Laszip), COLUMNS)
    for backend in BACKENDS:
        assert read_raw(target, backend).tobytes() == rows.tobytes()
    check_truth(target, rows)
    before, after = read_header(path), read_header(target)
    assert after.version == max(before.version, (1, 4)) and after.creation == before.creation
    assert after.version < (1, 5) or after.gps_range == (rows["gps_time"].max(), rows["gps_time"].min())
    assert after.point_format == {4: 6, 5: 7, 9: 6, 10: 8}[before.point_format] and after.global_encoding & 16
    assert after.global_encoding & 0b110 == 0 and after.waveform_start == 0 and after.evlr_count == 0
    assert after.system_identifier.strip(b"\0") == b"MODIFICATION"
    assert after.generating_software.strip(b"\0") == f"wavebatch {__version__}".encode()
    kept = [v for v in payloads(path, *NOT_KEPT) if not 100 <= v.record_id <= 355]
    # Leica's file has GeoTIFF keys only, and RIEGL's a WKT that gives metres for degrees.
    added = [] if layout.wkt is None else [build_wkt(layout.wkt)]
    kept = [v for v in kept if not (added and v.record_id == WKT_ID)]
    assert [v.encode() for v in (*kept, *added)] == [v.encode() for v in payloads(target, *NOT_KEPT)]
    assert sorted(os.listdir(tmp_path)) == [target.name]


GEOTIFF, WKT_RECORD = Vlr(b"LASF_Projection", 34735, bytes(8)), Vlr(b"LASF_Projection", 2112, b"PROJCRS\0")


@pytest.mark.parametrize(
    ("las_version", "made", "vlrs", "expected"),
    [
        ("1.4", 4, [], ((1, 4), 6, 16)),
        ("1.4", 4, [build_wkt("PROJCS[]")], ((1, 4), 6, 16)),
        ("1.4", 4, [UTM_KEYS], ((1, 4), 6, 16)),
        ("1.4", 4, [OTHER_KEYS], ((1, 4), 1, 0)),
        ("1.3", 4, [OTHER_KEYS], ((1, 3), 1, 0)),
        ("keep", 4, [OTHER_KEYS], ((1, 3), 1, 0)),
        ("keep", 4, [OTHER_KEYS, "bit"], ((1, 3), 1, 0)),
        ("keep", 4, [UTM_KEYS, "six"], ((1, 4), 6, 16)),
        ("1.4", 9, [GEOTIFF], ((1, 4), 6, 0)),
        ("1.4", 9, [GEOTIFF, WKT_RECORD], ((1, 4), 6, 16)),
        ("1.4", 9, [GEOTIFF, "extended"], ((1, 4), 6, 16)),
    ],
)
def test_version_format_and_legacy_fields_agree(tmp_path, las_version, made, vlrs, expected):
    """Legacy counts are zero in point formats 6 to 10 (PDAL, copclib), and the WKT bit says which CRS record counts."""
    evlrs = [(b"LASF_Projection", 2112, b"PROJCRS\0")] * ("extended" in vlrs)
    bit = 16 * ("bit" in vlrs)
    wanted = 6 if "six" in vlrs else None
    vlrs = [vlr for vlr in vlrs if vlr not in ("extended", "bit", "six")]
    points = write_source(
        tmp_path / "a.las", made, (1, 3) if made == 4 else (1, 4), vlrs=vlrs, evlrs=evlrs, global_encoding=bit
    )
    plan = {"las_version": las_version, "point_format": wanted}
    layout, _ = copy(tmp_path / "a.las", tmp_path / "b.laz", points, COLUMNS, **plan)
    header = read_header(tmp_path / "b.laz")
    assert (header.version, header.point_format, header.global_encoding & 16) == expected
    legacy, modern = header.counts
    assert legacy == (0 if header.point_format >= 6 else 200) and modern == (200 if header.version >= (1, 4) else 0)
    assert (vlrs == [UTM_KEYS]) == (layout.wkt is not None)
    with laspy.open(tmp_path / "b.laz") as reader:
        assert set(layout.extra_fields) == set(reader.header.point_format.extra_dimension_names)
        if layout.wkt:
            assert reader.header.vlrs.get_by_id("LASF_Projection", (2112,))[0].string.startswith(
                'PROJCS["WGS 84 / UTM zone 33N"'
            )


def test_what_las_1_3_cannot_hold_is_refused(tmp_path):
    write_source(tmp_path / "nine.las", 9, (1, 4))
    line = "nine.las: --las-version 1.3 has no point format 6: .*; leave --las-version out: points of format 9"
    refuses(ConfigError, line, plan_output, tmp_path / "nine.las", [], las_version="1.3")
    with pytest.raises(ConfigError, match="contradicts --point-format 6: its last format is 5; leave --las-v"):
        plan_output(tmp_path / "nine.las", [], las_version="1.3", point_format=6)
    write_source(tmp_path / "evlr.las", 4, (1, 4), evlrs=[(b"me", 7, b"x")])
    refuses(InputError, "evlr.las: has extended records", plan_output, tmp_path / "evlr.las", [], las_version="1.3")
    write_source(tmp_path / "wkt.las", 4, (1, 4), vlrs=[build_wkt("PROJCS[]")])
    refuses(InputError, "wkt.las: its CRS is given as WKT", plan_output, tmp_path / "wkt.las", [], las_version="1.3")


def test_columns_are_found_by_the_account_of_the_run(tmp_path):
    """Vendors use the names of every style: only the account says which column is wavebatch's."""
    records = [ExtraRecord.build("Pulse width", "u2", "[ns]", scale=0.1), ExtraRecord.build("Reflectance", "f4", "dB")]
    points = write_source(tmp_path / "a.las", 9, (1, 4), records=records)
    values = {"echo_width": np.linspace(3.0, 9.0, 200), "reflectance": np.linspace(0.1, 0.5, 200)}
    for style in STYLES:
        copy(tmp_path / "a.las", tmp_path / f"{style}.las", points, list(values), values=values, names=style)
        with CloudReader(tmp_path / f"{style}.las") as reader:
            np.testing.assert_allclose(next(reader.read_pieces())["echo_width"], values["echo_width"], atol=0.051)
        with ColumnReader(tmp_path / f"{style}.las", "reflectance") as reader:
            found = next(reader.read_pieces())["values"][:, 0]
            in_db = reader.facts[0].unit == "dB"
        expected = 10 * np.log10(values["reflectance"]) if in_db else values["reflectance"]
        np.testing.assert_allclose(found, expected, atol=0.0051)
        assert in_db == (style in ("riegl", "pdal"))
        cloud = read_cloud(tmp_path / f"{style}.las")
        np.testing.assert_allclose(cloud["echo_width"], values["echo_width"], atol=0.051)
        # RIEGL and ASPRS write widths as scaled integers, which no-data makes NaN.
        assert cloud.dtype["echo_width"] == (np.float64 if style in ("asprs", "riegl") else np.float32)


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[1]", b'{"columns": 3}', b'{"columns": {"amplitude": ["x"]}}'])
def test_accounts_of_any_bytes_are_no_accounts(tmp_path, payload):
    records = [ExtraRecord.build("amplitude", "f4", "[DN]", no_data=-9999)]
    points = write_source(tmp_path / "a.las", 6, (1, 4), records=records, vlrs=[Vlr(b"wavebatch", 1, payload)])
    with CloudReader(tmp_path / "a.las") as reader:
        np.testing.assert_array_equal(next(reader.read_pieces())["amplitude"], points["amplitude"])


def test_records_are_kept_to_the_byte(tmp_path):
    vlrs = [
        Vlr(b"LASF_Spec", 100, bytes(26), b"descriptor"),
        Vlr(b"caf\xe9", 1, b"not UTF-8", b"d\0rubbish behind", 0xAABB),
        Vlr(b"LASF_Spec", 0, bytes(range(256)), b"classes"),
        Vlr(b"copc", 1, bytes(160)),
        Vlr(b"LASF_Projection", 2112, b"WKT without final NUL"),
        Vlr(b"empty", 65535, b""),
        Vlr(b"LAS_Spec", 101, bytes(26), b"Leica's spelling"),
        Vlr(b"long", 2, bytes(65535)),
    ]
    points = write_source(tmp_path / "a.laz", 9, (1, 4), vlrs=vlrs, padding=b"\xdd\xcc", project_id=bytes(range(16)),
                          user_bytes=b"mine")  # fmt: skip
    for suffix in (".las", ".laz"):
        copy(tmp_path / "a.laz", tmp_path / f"out{suffix}", points, COLUMNS)
        header = read_header(tmp_path / f"out{suffix}")
        assert (header.padding, header.project_id, header.user_bytes) == (b"\xdd\xcc", bytes(range(16)), b"mine")
        # laspy opens no file with ids that are not UTF-8.
        shown = [dataclasses.replace(vlr, user_id=vlr.user_id.replace(b"\xe9", b"?")) for vlr in vlrs]
        expected = [vlr.encode() for vlr in shown if vlr.record_id not in (100, 101) and vlr.user != "copc"]
        assert [vlr.encode() for vlr in header.vlrs][: len(expected)] == expected
        users = [vlr.user for vlr in header.vlrs[len(expected) :]]
        assert users == ["wavebatch", "LASF_Spec", "laszip encoded"][: 3 if suffix == ".laz" else 2]


def test_extended_records_are_copied_and_what_is_not_is_said(tmp_path):
    evlrs = [
        (b"mine", 5, os.urandom(5_000_000)),
        (b"copc", 1000, b"hierarchy"),
        (b"LASF_Spec", 4, bytes(192)),
        (b"LASF_Spec", 65535, b"packets"),
        (b"last", 6, b""),
    ]
    path = tmp_path / "a.las"
    points = write_source(path, 9, (1, 4), evlrs=evlrs)
    layout = plan_output(path, [])
    for suffix in (".las", ".laz"):
        target = tmp_path / f"out{suffix}"
        cloud = write(layout, target, layout.rows(points))
        assert set(cloud.dropped) == {"EVLR copc 1000", "EVLR LASF_Spec 4"}
        found, missing = find_evlrs(target, read_header(target))
        assert [(e.user, e.record_id, e.length) for e in found] == [("mine", 5, 5_000_000), ("last", 6, 0)]
        assert missing == 0
        data = target.read_bytes()
        assert data[found[0].start + 60 :][:5_000_000] == evlrs[0][2]
        assert laspy.read(target).evlrs[0].record_data == evlrs[0][2]
    with open(path, "r+b") as file:
        file.seek(243)
        file.write(b"\xff\xff\xff\xff")
    with CloudWriter(plan_output(path, []), tmp_path / "b.las", provenance={}) as cloud:
        assert "4294967290 EVLRs" in cloud.dropped


def test_provenance_is_json_that_keeps_the_history(tmp_path):
    path = tmp_path / "a.las"
    points = write_source(path, 9, (1, 4), system_identifier=b"LMS-Q680i", generating_software=b"RiPROCESS")
    layout = plan_output(path, [])
    write(layout, tmp_path / "b.las", layout.rows(points), provenance={"input": "a.las", "n": np.int64(3)})
    (account,) = read_provenance(tmp_path / "b.las")
    assert account["input"] == "a.las" and account["n"] == 3 and account["wavebatch"] == __version__
    assert account["input_header"] == {"system_identifier": "LMS-Q680i", "generating_software": "RiPROCESS"}
    again = plan_output(tmp_path / "b.las", [])
    write(again, tmp_path / "c.las", again.rows(read_raw(tmp_path / "b.las")), provenance={"input": Path("b.las")})
    assert [account["input"] for account in read_provenance(tmp_path / "c.las")] == ["a.las", "b.las"]
    vlrs = [vlr for vlr in read_header(tmp_path / "c.las").vlrs if vlr.user == "wavebatch"]
    assert [vlr.record_id for vlr in vlrs] == [1, 2]
    assert json.dumps(json.loads(vlrs[0].payload), sort_keys=True, separators=(",", ":")).encode() == vlrs[0].payload
    assert read_provenance(path) == []
    with pytest.raises(ConfigError, match="provenance takes .* a VLR holds at most 65535"):
        CloudWriter(layout, tmp_path / "d.las", provenance={f"k{i}": i for i in range(10_000)})


def test_what_a_record_cannot_hold_is_left_out_and_named(tmp_path):
    points = write_source(tmp_path / "a.las", 9, (1, 4))
    provenance = {"long": list(range(20_000)), "table": {"longer": "x" * 90_000, "short": "y"}, "input": "a.las"}
    copy(tmp_path / "a.las", tmp_path / "b.las", points, provenance=provenance)
    (account,) = read_provenance(tmp_path / "b.las")
    assert account["input"] == "a.las" and account["long"] is None
    assert account["table"] is None and set(account["left_out"]["sha256"]) == {"long", "table"}


def test_odd_extra_bytes_survive_in_returns(tmp_path):
    records = [
        ExtraRecord(bytes([0, 0, 29, 0]) + b"normal".ljust(188, b"\0")),
        ExtraRecord(bytes([0, 0, 13, 0]) + b"pair".ljust(188, b"\0")),
        ExtraRecord.undocumented("ExtraBytes", 7),
    ]
    path = tmp_path / "a.las"
    points = write_source(path, 9, (1, 4), records=records)
    _, rows = copy(path, tmp_path / "out.laz", points, COLUMNS, points="returns")
    for backend in BACKENDS:
        seen = read_raw(tmp_path / "out.laz", backend)
        assert seen.tobytes() == rows.tobytes()
    for name in ("normal", "pair", "ExtraBytes"):
        assert seen[name].tobytes() == points[name].tobytes()
    check_truth(tmp_path / "out.laz", rows)


# --- packets kept -----------------------------------------------------------------------------------------------


def packets_of(path, points):
    """The bytes of every point's packet, found by the header alone."""
    header = read_header(path)
    file = path.with_suffix(".wdp") if header.global_encoding & 4 else path
    data, base = file.read_bytes(), 0 if header.global_encoding & 4 else header.waveform_start
    places = zip(points["wavepacket_offset"].astype(int) + base, points["wavepacket_size"].astype(int), strict=True)
    return [data[at : at + size] for at, size in places]


@pytest.mark.parametrize(
    ("point_format", "version", "new"),
    [(4, "1.3", None), (5, "1.3", None), (4, "1.3", 9), (5, "1.4", 10), (9, "1.4", None), (10, "1.5", None)],
)
@pytest.mark.parametrize("internal", [True, False])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_kept_packets_in_every_format(tmp_path, point_format, version, new, internal, suffix):
    path = tmp_path / "a.laz"
    points = write_strip(path, point_format=point_format, version=version, internal=internal)
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / f"a{suffix}"
    layout, rows = copy(path, target, points, ["amplitude"], values={}, packets=facts_of(path), point_format=new)
    assert (layout.version, layout.point_format) == (max((1, 4), read_header(path).version), new or point_format)
    for backend in BACKENDS:
        assert read_raw(target, backend).tobytes() == rows.tobytes()
    assert packets_of(target, rows) == packets_of(path, points)
    header = read_header(target)
    found, missing = find_evlrs(target, header)
    assert missing == 0 and len(found) == (internal and header.version >= (1, 4))
    assert not found or (found[0].start, found[0].record_id) == (header.waveform_start, 65535)


def test_a_file_without_header_gets_one_and_offsets_follow(tmp_path):
    path = tmp_path / "a.las"
    points = write_strip(path, internal=False)
    before = packets_of(path, points)
    facts, end = facts_of(path), (tmp_path / "a.wdp").stat().st_size - 60
    facts = dataclasses.replace(facts, packets=dataclasses.replace(facts.packets, start=0, base=0, end=end))
    (tmp_path / "a.wdp").write_bytes((tmp_path / "a.wdp").read_bytes()[60:])
    points["wavepacket_offset"] -= np.uint64(60)
    points["wavepacket_index"][3] = 0
    (tmp_path / "out").mkdir()
    copy(path, tmp_path / "out" / "a.las", points, packets=facts)
    seen = read_raw(tmp_path / "out" / "a.las")
    assert seen["wavepacket_offset"][3] == points["wavepacket_offset"][3]
    after = packets_of(tmp_path / "out" / "a.las", seen)
    assert after[:3] + after[4:] == before[:3] + before[4:]


def multi_channel(path):
    points = write_strip(path, n=100)
    points["classification_flags"] = (points["classification_flags"] & 0b11001111) | ((np.arange(100) % 3) << 4)
    return points


def test_several_scanner_channels_with_packets_are_refused_as_laz(tmp_path):
    points = multi_channel(tmp_path / "a.las")
    layout = plan_output(tmp_path / "a.las", [], packets=facts_of(tmp_path / "a.las"))
    rows = layout.rows(points)
    with (
        pytest.raises(InputError, match=r"out.laz: points of several scanner channels .*; write LAS"),
        CloudWriter(layout, tmp_path / "out.laz", provenance={}) as cloud,
    ):
        cloud.write(rows)
        cloud.commit()
    assert os.listdir(tmp_path) == ["a.las"]
    one = rows[::3].copy()
    write(layout, tmp_path / "one.laz", one)  # a single channel is fine, whichever it is
    for backend in BACKENDS:
        assert read_raw(tmp_path / "one.laz", backend).tobytes() == one.tobytes()
    write(layout, tmp_path / "las.las", rows)
    assert read_raw(tmp_path / "las.las").tobytes() == rows.tobytes()


def test_packets_that_are_not_there(tmp_path):
    write_source(tmp_path / "a.las", 9, (1, 4))
    with pytest.raises(InputError, match="a.las: has no packets to keep; leave --keep-packets out"):
        plan_output(tmp_path / "a.las", [], packets=facts_of(tmp_path / "a.las"))
    points = write_strip(tmp_path / "c.las", internal=False)
    layout = plan_output(tmp_path / "c.las", [], packets=facts_of(tmp_path / "c.las"))
    (tmp_path / "c.wdp").write_bytes(b"cut")
    refuses(InputError, "ends .* bytes too early", write, layout, tmp_path / "d.las", layout.rows(points))
    assert not (tmp_path / "d.las").exists() and not list(tmp_path.glob(".wavebatch*"))


def test_a_killed_publication_of_two_files_can_be_finished(tmp_path):
    points = write_strip(tmp_path / "a.las", internal=False)
    layout = plan_output(tmp_path / "a.las", [], packets=facts_of(tmp_path / "a.las"))
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / "a.las"
    write(layout, target, layout.rows(points))
    target.unlink()  # killed after the .wdp, before the cloud
    write(layout, target, layout.rows(points))
    target.unlink()
    target.with_suffix(".wdp").write_bytes(b"somebody else's")
    refuses(InputError, "a.wdp: exists already", write, layout, target, layout.rows(points))
    assert os.listdir(tmp_path / "out") == ["a.wdp"]
    write(layout, target, layout.rows(points), overwrite=True)
    assert packets_of(target, points) == packets_of(tmp_path / "a.las", points)


# --- whole or not at all ----------------------------------------------------------------------------------------


REMEDY = "free space or choose another output folder"
FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from wavebatch.core.errors import InputError
from wavebatch.files.cloud.writer import plan_output
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.strip.reader import StripReader
source, target = map(Path, sys.argv[1:3])
with StripReader(source) as reader:
    facts = reader.facts
layout = plan_output(facts, ["amplitude"], packets=facts if target.stem == "keep" else None)
rows = layout.rows(np.frombuffer(np.random.default_rng(0).bytes(60000 * 59), dtype="V59").view(
    np.dtype([("a", "V59")])).view(__import__("wavebatch.files.las.header", fromlist="x").STANDARD_DTYPES[9]))
rows["classification_flags"] &= 0b11001111
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
try:
    with CloudWriter(layout, target, provenance={}) as cloud:
        cloud.write(rows)
        cloud.write(rows)
        cloud.commit()
except InputError as error:
    print(error)
"""


@pytest.mark.parametrize("name", ["out.las", "out.laz", "keep.laz"])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, name):
    write_strip(tmp_path / "a.las")
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / name
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", FULL_DISK, str(tmp_path / "a.las"), str(target)],
        capture_output=True, text=True, cwd=Path(__file__).resolve().parents[2], timeout=300,
    )  # fmt: skip
    assert run.stderr == "" and run.returncode == 0
    lines = run.stdout.splitlines()
    assert len(lines) == 1 and lines[0] == f"{target}: cannot be written: File too large; {REMEDY}", lines
    assert os.listdir(tmp_path / "out") == []


def test_more_points_than_an_old_header_counts(tmp_path):
    points = write_source(tmp_path / "a.las", 4, (1, 3))
    layout = plan_output(tmp_path / "a.las", [], las_version="1.3")
    with CloudWriter(layout, tmp_path / "out.las", provenance={}) as cloud:
        cloud.statistics.count = 2**32 - 100
        with pytest.raises(InputError, match="LAS 1.3 holds at most 4294967295 points; use --las-version 1.4"):
            cloud.write(layout.rows(points))


def test_records_whose_ids_are_no_text_do_not_keep_laspy_from_opening_the_cloud(tmp_path):
    path = tmp_path / "a.las"
    points = write_source(path, 9, (1, 4), evlrs=[(b"caf\xe9", 9, b"z")])
    layout = plan_output(path, [])
    layout.source.header.vlrs.append(Vlr(b"caf\xe9", 7, b"x", b"\xff\xfe text"))
    layout.source.header.vlrs.append(Vlr("é".encode(), 8, b"y", b"fine\0\xff"))
    cloud = write(layout, tmp_path / "b.las", layout.rows(points))
    header = read_header(tmp_path / "b.las")
    found = {vlr.record_id: vlr for vlr in header.vlrs}
    assert [evlr.user for evlr in find_evlrs(tmp_path / "b.las", header)[0]] == ["caf?"]
    assert found[7].user_id.rstrip(b"\0") == b"caf?" and found[7].description.rstrip(b"\0") == b"?? text"
    assert found[8].user_id.rstrip(b"\0") == "é".encode() and found[8].payload == b"y"
    assert list(cloud.dropped) == ["VLR caf? 7"]
    with laspy.open(tmp_path / "b.las") as reader:
        assert len(reader.header.vlrs) >= 2
