"""Other programs' readers see every column of our clouds: copc.js with laz-perf, copclib, loaders.gl and LASzip.

Each reads the file with its own code and is compared with laspy. `make readers` installs them; a test is skipped with
the reason where its reader is missing.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import laspy
import like_pdal
import numpy as np
import pytest
from batch_tools import run_one
from commands import succeed

import wavebatch as wb
from wavebatch.core.echoes import COLUMNS
from wavebatch.files.cloud.column_names import style_columns
from wavebatch.files.las.header import read_header

SCRIPTS = Path(__file__).parent / "readers"
STYLES = ("wavebatch", "pdal", "opals", "asprs", "riegl")
FIELDS = {
    "Intensity": "intensity", "ReturnNumber": "return_number", "NumberOfReturns": "number_of_returns",
    "Synthetic": "synthetic", "KeyPoint": "key_point", "Withheld": "withheld", "Overlap": "overlap",
    "ScannerChannel": "scanner_channel", "ScanDirectionFlag": "scan_direction_flag",
    "EdgeOfFlightLine": "edge_of_flight_line", "Classification": "classification", "UserData": "user_data",
    "PointSourceId": "point_source_id", "GpsTime": "gps_time", "Red": "red", "Green": "green", "Blue": "blue",
    "Infrared": "nir",
}  # fmt: skip
"""laspy's names of what copc.js reads."""

CASES = {
    **{f"riegl {style}.laz": {"names": style} for style in STYLES},
    **{f"leica {style}.laz": {"names": style} for style in STYLES},
    "riegl wavebatch.las": {"format": "las"},
    "leica 1.3.las": {"format": "las", "las_version": "1.3"},
    "colour7.laz": {}, "colour8.laz": {}, "colour8.las": {"format": "las"}, "riegl nan.laz": {"no_data": "nan"},
}  # fmt: skip


@pytest.fixture(scope="session")
def make_cloud(request, tmp_path_factory):
    """The cloud of a case of CASES, made once."""
    made = {}

    def make(case):
        if case not in made:
            folder = tmp_path_factory.mktemp("cloud")
            if case.startswith("colour"):
                strip = _make_colours(folder, {"7": "5", "8": "10"}[case[6]], request.getfixturevalue("edit_points"))
            else:
                strip = request.getfixturevalue(case.split()[0])
            outcome = run_one(strip, folder / "out", profile="balanced", **CASES[case])
            assert outcome.error is None, outcome.error
            (made[case],) = (path for path in (folder / "out").iterdir() if path.suffix in (".las", ".laz"))
        return made[case]

    return make


def _make_colours(folder, point_format, edit):
    """A strip of this point format with random colours."""
    words = ["simulate", "urban", "--pulses", "300", "--point-format", point_format, "-o", str(folder / "grey.las")]
    succeed(*words)

    def paint(points):
        for name in {"red", "green", "blue", "nir"} & set(points.dtype.names):
            points[name] = np.random.default_rng(1).integers(0, 65536, len(points))
        return points

    return edit(folder / "grey.las", folder / "strip.las", paint)


def _node(script, path, target, *packages):
    """What a script of node writes; skipped without node or a package."""
    modules = Path(os.environ.get("WAVEBATCH_NODE_MODULES", Path(sys.prefix) / "npm" / "node_modules"))
    missing = [name for name in packages if not (modules / name).is_dir()]
    if shutil.which("node") is None or missing:
        pytest.skip(f"not installed: {'node' if not missing else ', '.join(missing)} (make readers)")
    done = subprocess.run(["node", str(SCRIPTS / script), str(path), str(target)], capture_output=True, text=True,
                          env={**os.environ, "NODE_PATH": str(modules)}, timeout=300)  # fmt: skip
    assert done.returncode == 0 and target.exists(), done.stderr[-2000:]
    return json.loads(target.read_text())


@pytest.mark.quick_cases("riegl wavebatch.laz", "leica asprs.laz", "leica riegl.laz", "colour*")
@pytest.mark.parametrize("case", [case for case in CASES if "1.3" not in case])  # it refuses LAS 1.3
def test_copc_js_reads_every_column(make_cloud, tmp_path, case):
    path = make_cloud(case)
    found = _node("copc_js.cjs", path, tmp_path / "found.json", "copc", "laz-perf")
    las, header = laspy.read(path), found["header"]
    count = len(las.points)
    assert header["pointCount"] == count > 50 and header["pointDataRecordFormat"] == las.point_format.id
    assert header["pointDataRecordLength"] == las.point_format.size
    by_return = np.bincount(np.asarray(las.return_number), minlength=16)[1:]
    np.testing.assert_array_equal(header["pointCountByReturn"], by_return[: len(header["pointCountByReturn"])])
    columns = {name: np.array(values) for name, values in found["columns"].items()}
    for axis, name in enumerate("XYZ"):
        np.testing.assert_allclose(columns.pop(name), np.asarray(getattr(las, name.lower())), rtol=0, atol=1e-6)
        assert header["min"][axis] == pytest.approx(las.header.mins[axis]), name
    angle = columns.pop("ScanAngle")
    modern = las.point_format.id >= 6
    np.testing.assert_allclose(angle, np.asarray(las.scan_angle) * 0.006 if modern else las.scan_angle_rank, atol=1e-4)
    extra = [one.name for one in las.point_format.extra_dimensions]
    assert [one["name"] for one in found["extra"]] == extra and len(extra) >= 6
    for name, values in columns.items():
        field = name if name in extra else FIELDS[name]
        wanted = las.points.array[field] if field in las.points.array.dtype.names else np.asarray(las[field])
        np.testing.assert_array_equal(values.astype(wanted.dtype), wanted, err_msg=name)
    assert set(extra) <= set(columns) and (found["wkt"] is not None or "colour" in case)


def test_copc_js_reads_the_no_data_value_of_every_column(make_cloud, tmp_path):
    found = _node("copc_js.cjs", make_cloud("riegl wavebatch.laz"), tmp_path / "found.json", "copc", "laz-perf")
    declared = {one["name"]: one.get("nodata") for one in found["extra"]}
    for name in ("echo_width", "echo_width_err", "wb_amplitude", "amplitude_err", "range_err"):
        assert declared[name] == -9999
        values = np.array(found["columns"][name])
        assert ((values == -9999) | (values >= 0)).all() and (values == -9999).any()
    assert declared["echo_flags"] is None
    for one in found["extra"]:  # least and largest are of values, not of no-data
        values = np.array(found["columns"][one["name"]])
        values = values[values != one.get("nodata")]
        assert (one["min"], one["max"]) == (pytest.approx(values.min()), pytest.approx(values.max()))


@pytest.mark.parametrize("case", CASES)
def test_pdal_would_read_every_column(make_cloud, case):
    """By PDAL's own rules, see `readers/like_pdal.py`: header, records, CRS, names and values."""
    pytest.importorskip("laszip", reason="laszip is not installed")
    path = make_cloud(case)
    header, wkt, columns = like_pdal.read(path)
    las = laspy.read(path)
    count = len(las.points)
    assert header["count"] == count and sum(header["returns"]) == count
    if header["format"] >= 6:  # Header::setPointCount: the old fields are 0, and the WKT bit is set
        assert header["legacy"] == 0 == sum(header["legacy_returns"]) and header["encoding"] & 16
    else:
        assert header["legacy"] == count == sum(header["legacy_returns"])
    assert wkt == (_wkt(path) if header["version"] == (1, 4) else None)
    names = {"ReturnNumber": "return_number", "NumberOfReturns": "number_of_returns"}
    for name, values in columns.items():
        field = next((one.name for one in las.point_format.extra_dimensions if _fix(one.name) == name), None)
        field = field or names.get(name) or {"GpsTime": "gps_time"}.get(name) or name.lower()
        np.testing.assert_allclose(values, np.asarray(las[field] if field not in "xyz" else getattr(las, field)),
                                   rtol=1e-9, atol=1e-9, err_msg=name)  # fmt: skip
    assert len(columns) == 8 + len(list(las.point_format.extra_dimensions))


def _fix(name):
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def test_no_column_of_ours_has_a_name_that_pdal_joins_with_another():
    """PDAL joins names that differ in case only, and turns signs into `_`: `echo width` would be `echo_width`."""
    taken = {name.lower() for name in like_pdal.FIELDS}
    for style in STYLES:
        fixed = [_fix(one.record.name).lower() for one in style_columns(list(COLUMNS), style, [])]
        assert len(set(fixed)) == len(fixed) > 20 and not taken & set(fixed), style
    vendor = ["echo width", "Echo-Width2", "ECHO_WIDTH_ERR", "amplitude.err", "range/err", "wb_echo width"]
    written = style_columns(["echo_width", "echo_width_err", "amplitude_err", "range_err"], "wavebatch", vendor)
    fixed = [_fix(one.record.name).lower() for one in written]
    assert fixed == ["wb2_echo_width", "wb_echo_width_err", "wb_amplitude_err", "wb_range_err"]
    assert not set(fixed) & {_fix(name).lower() for name in vendor}


@pytest.mark.parametrize("case", [case for case in CASES if case.endswith(".laz")])
def test_copclib_reads_headers_points_and_extra_bytes(make_cloud, case):
    copclib = pytest.importorskip("copclib", reason="copclib is not installed (make readers)")
    path = make_cloud(case)
    reader, las = copclib.LazReader(str(path)), laspy.read(path)
    header = reader.laz_config.las_header
    assert (header.point_format_id, header.point_count) == (las.point_format.id, len(las.points))
    assert header.EbByteSize() == las.point_format.num_extra_bytes
    points = reader.GetPoints()
    assert len(points) == len(las.points)
    record = las.points.array
    raw = record.view(np.uint8).reshape(len(record), -1)[:, -header.EbByteSize() :]
    for row in range(0, len(points), 7):
        point = points[row]
        assert bytes(byte % 256 for byte in map(_number, point.extra_bytes)) == raw[row].tobytes()
        assert (point.x, point.y, point.z) == pytest.approx((las.x[row], las.y[row], las.z[row]), abs=1e-6)
        assert (point.gps_time, point.return_number) == (las.gps_time[row], las.return_number[row])
        assert (point.number_of_returns, point.intensity) == (las.number_of_returns[row], las.intensity[row])


def _number(byte):
    return byte if isinstance(byte, int) else ord(byte)


def _wkt(path):
    found = [vlr for vlr in read_header(path).vlrs if vlr.record_id == 2112 and vlr.user == "LASF_Projection"]
    return found[0].payload.split(b"\0")[0].decode() if found else None


@pytest.mark.parametrize("case", ["riegl wavebatch.laz", "leica pdal.laz", "colour8.laz"])
def test_a_copc_file_of_copclib_is_a_cloud_like_any(make_cloud, tmp_path, case):
    """The documented last step: our commands read columns, flags and counts of the COPC file as of the cloud."""
    copclib = pytest.importorskip("copclib", reason="copclib is not installed (make readers)")
    path, target = make_cloud(case), tmp_path / "cloud.copc.laz"
    source = copclib.LazReader(str(path))
    config = source.laz_config
    header = config.las_header
    # Its own `config.wkt` begins 6 bytes late: it takes the record for an extended one, whose head is longer.
    writer = copclib.FileWriter(str(target), copclib.CopcConfigWriter(
        header.point_format_id, header.scale, header.offset, _wkt(path) or "", config.extra_bytes_vlr))  # fmt: skip
    writer.AddNode(copclib.VoxelKey(0, 0, 0, 0), source.GetPoints())
    writer.Close()
    wanted, found = wb.read_cloud(path), wb.read_cloud(target)
    for name in ("x", "y", "z", "gps_time", "echo_width", "echo_flags"):
        np.testing.assert_allclose(found[name], wanted[name], rtol=0, atol=1e-6, err_msg=name)
    documents = []
    for one in (path, target):
        result = succeed("stats", one, "--json")
        documents.append({**json.loads(result.stdout)["total"], "cloud": ""})
    assert documents[0] == documents[1]


@pytest.mark.parametrize(
    "case", ["riegl wavebatch.laz", "leica pdal.laz", "riegl wavebatch.las", "colour7.laz", "leica 1.3.las"]
)
def test_loaders_gl_reads_positions_and_classes(make_cloud, tmp_path, case):
    path = make_cloud(case)
    found = _node("loaders_gl.cjs", path, tmp_path / "found.json", "@loaders.gl/core", "@loaders.gl/las")
    las = laspy.read(path)
    places = np.array(found["POSITION"]).reshape(-1, 3)
    np.testing.assert_allclose(places, np.stack([las.x, las.y, las.z], axis=1), rtol=0, atol=1e-6)
    for name in ("intensity", "classification"):
        np.testing.assert_array_equal(found[name], np.asarray(las[name]))


@pytest.mark.parametrize("case", ["riegl wavebatch.laz", "riegl nan.laz", "leica riegl.laz", "colour8.laz"])
def test_laszip_decodes_the_same_bytes(make_cloud, case):
    pytest.importorskip("laszip", reason="laszip is not installed")
    path = make_cloud(case)
    backends = (laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip)
    one, other = (laspy.read(path, laz_backend=backend) for backend in backends)
    assert one.points.array.tobytes() == other.points.array.tobytes()
