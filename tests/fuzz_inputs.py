"""What the fuzzer damages: a sound input of every kind, and the commands that read it."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from commands import run_command
from pulse_files import Pulse, PulseFile, Sampling, bell
from strips import vlr

from wavebatch.files.las.header import ExtraRecord, build_dtype
from wavebatch.stages.chain import effective, load_profile
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.strip import StripOptions

FAST = "--profile fast -q"

_STRIP = f"""
run {{input}} -o {{out}} {FAST}
run {{input}} -o {{out}} {FAST} --format las
run {{input}} -o {{out}} --points returns --keep-packets -q
run {{input}} -o {{out}} --profile accurate --names riegl --no-data nan
run {{input}} -o {{out}} --columns +incidence_angle_normals,+range -q --profile fast
run {{input}} -o {{out}} --calibration {{base}}/cal.toml -q
run {{input}} -o {{out}} --where echo_width>4.5 --drop-flags WEAK --classes 0,1 --profile fast -v
run {{input}} -o {{out}} --las-version keep --resume --json --profile fast
run {{input}} {{base}}/other.las -o {{out}} --survey flight --report {{out}}/all.json -q
run {{input}} -o {{out}} --dry-run --json
run {{input}} -o {{out}} --tolerance 5cm --system {{base}}/system.toml --force
info {{input}}
info {{input}} -v --json
check {{input}}
check {{input}} --strict --json --direction away
check {{input}} --headerless
survey {{input}} -o {{out}}/a.toml
survey {{input}} --divergence 0.5 --angles {{out}}/a.csv
survey {{input}} {{base}}/other.las --chain {{out}}/a.toml --json
compare {{input}} {{input}}
compare --strip {{input}} fast balanced --limit 60 --json
compare {{base}}/cloud.laz {{input}} -o {{out}}/a.csv
stats {{input}} -o {{out}}/a.csv
stats {{input}} --area 5 --json --where z>0
slice {{input}} -o {{out}}/a.csv -q
slice {{input}} -o {{out}}/a.geojson --geojson-crs keep --cube {{out}}/a.npz -q
synthesize {{input}} -o {{out}}/a.las -q
synthesize {{input}} -o {{out}}/a.laz --external --bits 16 --noise 1 -q
voxelize {{input}} -o {{out}}/a.npz --size 0.5
voxelize {{input}} -o {{out}}/a.laz --size 1 --method wiener --profiles {{out}}/b.npz --all-crossed -q
calibrate {{input}} --targets {{base}}/targets.csv -o {{out}}/a.toml --flight-height 500 --report {{out}}/a.json
plot waveform {{input}} -o {{out}}/a.svg --profile fast -q --random 2
plot waveform {{input}} -o {{out}}/a.csv --echoes --profile fast
grid {{input}} --statistic density --size 5 -o {{out}}/a.tif
"""
_CLOUD = """
info {input}
info {input} --json
stats {input} --area 2 -o {out}/a.csv
stats {input} --where "echo_width > 4 and not amplitude < 20"
compare {input} {base}/strip.las
compare {base}/cloud.laz {input} --json
compare {input} --truth {base}/truth.npz
synthesize {input} -o {out}/a.las -q
synthesize {input} -o {out}/a.las --intensity reflectance --sensor-height 900 -q
check {input}
grid {input} --column amplitude --column z --statistic median --size 1 -o {out}/a.tif
grid {input} --column echo_width --statistic std -o {out}/a.tif -q --drop-flags WEAK
plot histogram {input} --column amplitude --by number_of_returns -o {out}/a.svg --json
plot histogram {input} --column echo_flags -o {out}/a.png
plot map {input} --column echo_width -o {out}/a.png
plot section {input} -o {out}/a.svg --width 5
plot profile {input} -o {out}/a.svg
"""

_VENDOR = """
run {input} -o {out} --energy Energy --calibration {base}/cal.toml --profile fast
run {input} -o {out} --where Deviation>=3 --columns +range --profile fast -q
run {input} -o {out} --points returns --where Energy<2 --no-data nan --profile fast -q
run {input} -o {out} --trajectory {base}/degrees.txt --profile fast -q
run {input} -o {out} --polygon {base}/polygons.geojson --las-version 1.4 --profile fast -q
slice {input} -o {out}/a.geojson -q
stats {input} --polygon {base}/polygons.geojson -o {out}/a.csv
grid {input} --column Energy --column Deviation --size 5 -o {out}/a.tif
plot histogram {input} --column Deviation -o {out}/a.png
"""
_CARRIED = """
grid {input} --column Energy --column Deviation --statistic mean --size 5 -o {out}/a.tif
stats {input} --polygon {base}/polygons.geojson --where "Energy > 1 or Deviation < 3"
compare {input} {base}/carried.las
info {input} -v --json
synthesize {input} -o {out}/a.las -q
plot map {input} --column Deviation -o {out}/a.png
"""

_TEXTS = {
    "chain.toml": """
check {input}
run {base}/strip.las -o {out} --chain {input} -q
run {base}/strip.las -o {out} --chain {input} --dry-run
compare --strip {base}/strip.las {input} fast --limit 50
calibrate {base}/strip.las --targets {base}/targets.csv -o {out}/a.toml --chain {input}
""",
    "system.toml": f"""
run {{base}}/strip.las -o {{out}} --system {{input}} {FAST}
run {{base}}/strip.las -o {{out}} --system {{input}} --force -q
voxelize {{base}}/strip.las -o {{out}}/a.npz --size 1 --system {{input}}
compare --strip {{base}}/strip.las fast balanced --system {{input}} --limit 50
plot waveform {{base}}/strip.las -o {{out}}/a.csv --echoes --system {{input}}
""",
    "flight.system.toml": "run {base}/strip.las -o {resumed} --profile fast --survey flight --resume",
    "cal.toml": f"""
run {{base}}/strip.las -o {{out}} --calibration {{input}} {FAST}
voxelize {{base}}/strip.las -o {{out}}/a.npz --size 1 --calibration {{input}}
""",
    "calibrated.toml": f"run {{base}}/strip.las -o {{out}} --calibration {{input}} {FAST}",
    "trajectory.txt": """
run {base}/strip.las -o {out} --trajectory {input} -q
run {base}/strip.las -o {out} --trajectory {input} --lever-arm 1,0,2 -q --profile fast --columns +incidence_angle
calibrate {base}/strip.las --targets {base}/targets.csv -o {out}/a.toml --trajectory {input}
voxelize {base}/strip.las -o {out}/a.npz --size 1 --calibration {base}/cal.toml --trajectory {input}
""",
    "degrees.txt": "run {base}/strip.las -o {out} --trajectory {input} --crs EPSG:32632 -q",
    "energy.txt": "run {base}/strip.las -o {out} --energy {input} --calibration {base}/cal.toml --profile fast",
    "targets.geojson": """
calibrate {base}/strip.las --targets {input} -o {out}/c.toml --flight-height 500
calibrate {base}/strip.las {base}/other.las --targets {input} -o {out}/c.toml --flight-height 500
""",
    "targets.csv": "calibrate {base}/strip.las --targets {input} -o {out}/c.toml --flight-height 500",
    "polygons.geojson": f"""
stats {{base}}/cloud.laz --polygon {{input}} -o {{out}}/a.csv
run {{base}}/strip.las -o {{out}} --polygon {{input}} {FAST}
""",
    "list.txt": f"""
run @{{input}} -o {{out}} {FAST}
stats @{{input}}
check @{{input}}
info @{{input}} --json
""",
    "strip.report.json": """
run {base}/strip.las -o {resumed} --profile fast -q --resume
info {resumed}/strip.laz
""",
    "settings.toml": """
run {base}/strip.las -o {out} -q
stats --config {input} {base}/strip.las
slice --config {input} {base}/strip.las -o {out}/a.csv
voxelize --config {input} {base}/strip.las -o {out}/a.npz --size 1
""",
}
_ARRAYS = {
    "truth.npz": """
compare {base}/cloud.laz --truth {input}
compare {base}/cloud.laz --truth {input} --json --within 3
""",
    "voxels.npz": """
plot section {input} -o {out}/a.svg
plot profile {input} -o {out}/a.png
""",
    "cube.npz": """
plot cube {input} -o {out}/a.png
plot cube {input} --x 1 --t 5 -o {out}/a.svg
""",
    "trajectory.sbet": """
run {base}/strip.las -o {out} --trajectory {input} --crs EPSG:32632 -q
calibrate {base}/strip.las --targets {base}/targets.csv -o {out}/a.toml --trajectory {input} --crs EPSG:32632
""",
}


def _split(lines: str) -> list[str]:
    return [line for line in lines.splitlines() if line]


COMMANDS: dict[str, list[str]] = {
    "strip.las": _split(_STRIP),
    "ten.las": _split(_STRIP),
    "packed.laz": _split(_STRIP),
    "beside.las": [*_split(_STRIP)],
    "beside.wdp": [line.replace("{input}", "{folder}/beside.las") for line in _split(_STRIP)],
    "vendor.las": [*_split(_VENDOR), *_split(_STRIP)],
    "cloud.laz": _split(_CLOUD),
    "cloud.las": _split(_CLOUD),
    "carried.las": [*_split(_CARRIED), *_split(_CLOUD)],
    **{kind: _split(lines) for kind, lines in (_TEXTS | _ARRAYS).items()},
}
"""Per kind of input. {input}: the damaged file, {base}: the folder of the sound ones, {folder}: that of the damaged
one, {out}: an empty folder, {resumed}: a folder with a finished cloud and the damaged file."""

IN_RESUMED = ("strip.report.json", "flight.system.toml")
"""Kinds that lie in the output folder of an earlier run."""

BESIDE = {"beside.wdp": ("beside.las",), "beside.las": ("beside.wdp",),
          "list.txt": ("strip.las", "beside.las", "beside.wdp"),
          "settings.toml": ("strip.las",)}  # fmt: skip
"""Sound files in the folder of the damaged one."""

SLOW = {"plot": 0.25, "voxelize": 0.4, "calibrate": 0.5, "run @": 0.3}
"""How often commands that start so are drawn, next to 1 for the others."""


def build_inputs(base: Path) -> None:
    """Write a sound input of every kind; the same bytes each time."""
    options = {
        "strip.las": StripOptions(), "packed.laz": StripOptions(version="1.4", point_format=9),
        "ten.las": StripOptions(version="1.4", point_format=10),
        "beside.las": StripOptions(internal=False, point_format=5),
    }  # fmt: skip
    for name, chosen in options.items():
        simulate_strip("urban", base / name, pulses=120, seed=1, truth=base / f"{name}.npz", options=chosen)
        (base / f"{name}.npz").rename(base / "truth.npz")
    simulate_strip("urban", base / "other.las", pulses=60, seed=2)
    _write_vendor(base / "strip.las", base / "vendor.las")
    (base / "chain.toml").write_text(effective(load_profile("accurate")))
    _sound("survey", base / "strip.las", "-o", base / "system.toml")
    (base / "flight.system.toml").write_bytes((base / "system.toml").read_bytes())
    _write_texts(base)
    _sound("run", base / "strip.las", "-o", base / "done", *FAST.split())
    (base / "strip.report.json").write_bytes((base / "done" / "strip.report.json").read_bytes())
    rich = ["--columns", "+incidence_angle_normals,+range", "--calibration", base / "cal.toml"]
    for suffix in ("laz", "las"):
        _sound("run", base / "strip.las", "-o", base / f"rich-{suffix}", "--format", suffix, *rich)
        (base / f"cloud.{suffix}").write_bytes((base / f"rich-{suffix}" / f"strip.{suffix}").read_bytes())
    _sound("run", base / "vendor.las", "-o", base / "carried", "--format", "las", *rich)
    (base / "carried.las").write_bytes((base / "carried" / "vendor.las").read_bytes())
    _sound("voxelize", base / "strip.las", "-o", base / "voxels.npz", "--size", "2")
    _sound("slice", base / "strip.las", "--cube", base / "cube.npz", "--lines", "0:2")
    _write_places(base)
    echoes = [Pulse([[(2000, bell(50, 10 + 0.1 * i, 90, 2.0))]], time=10 * i) for i in range(60)]
    PulseFile({1: (Sampling(scale=0.5, duration_bits=32),)}, echoes).write(base / "strip.pls")
    target = ["--targets", base / "targets.csv", "-o", base / "calibrated.toml"]
    _sound("calibrate", base / "strip.las", *target)


def _write_vendor(strip: Path, target: Path) -> None:
    """A LAS 1.3 strip again, with GeoTIFF keys and with extra bytes: a scaled one, one with no data, arrays."""
    records = [
        ExtraRecord.build("Energy", "u2", "of the pulse [uJ]", scale=0.01),
        ExtraRecord.build("Deviation", "i2", "of the pulse's shape", no_data=-1),
        ExtraRecord.undocumented("Bytes", 3),
    ]
    pair = bytearray(ExtraRecord.build("Pair", "f4", "an array of two").data)
    pair[2] += 10
    records.append(ExtraRecord(bytes(pair)))
    keys = [(1024, 0, 1, 1), (1026, 34737, 6, 0), (2057, 34736, 1, 0), (3072, 0, 1, 25832), (3076, 0, 1, 9001)]
    new = [
        vlr(b"LASF_Projection", 34735, np.array([(1, 1, 0, len(keys)), *keys], "<u2").tobytes()),
        vlr(b"LASF_Projection", 34736, np.float64(6378137.0).tobytes()),
        vlr(b"LASF_Projection", 34737, b"metre|"),
        vlr(b"LASF_Spec", 4, b"".join(record.data for record in records)),
    ]
    data = bytearray(strip.read_bytes())
    start, count, length, number, packets = (
        struct.unpack_from(form, data, place)[0]
        for form, place in (("<I", 96), ("<I", 100), ("<H", 105), ("<I", 107), ("<Q", 227))
    )
    old = np.frombuffer(data[start : start + number * length], f"V{length}")
    points = np.zeros(number, build_dtype(data[104], records))
    assert points.dtype.itemsize == length + 15
    points.view(np.uint8).reshape(number, -1)[:, :length] = old.view(np.uint8).reshape(number, -1)
    points["Energy"], points["Deviation"], points["Pair"] = 100 + np.arange(number) % 7, np.arange(number) % 5 - 1, 0.5
    more, longer = sum(map(len, new)), number * 15
    for form, place, value in (("<I", 96, start + more), ("<I", 100, count + len(new)), ("<H", 105, length + 15),
                               ("<Q", 227, packets + more + longer)):  # fmt: skip
        struct.pack_into(form, data, place, value)
    target.write_bytes(b"".join([data[:start], *new, points.tobytes(), data[start + number * length :]]))


def _sound(*command: object) -> None:
    done = run_command(*command)
    assert done.exit_code == 0, (command, done.output)


def _write_texts(base: Path) -> None:
    (base / "list.txt").write_text("# strips\nstrip.las\nbeside.las\n")
    (base / "cal.toml").write_text(
        'schema = "wavebatch.calibration/1"\nconstant = 2.0e-8\nrelative_error = 0.05\nattenuation_db_km = 0.22\n'
        'divergence_mrad = 0.5\nstrip = "a.las"\n'
    )
    (base / "settings.toml").write_text(
        '[run]\nprofile = "fast"\nclasses = [0, 1, 2]\nno-data = "nan"\n'
        'where = "amplitude > 3"\n\n[slice]\nsigma = 2.5\nlines = "0:2"\n\n[voxelize]\nmethod = "gold"\n'
        "iterations = 3\n"
        '\n[stats]\narea = "5"\n'
    )


def _write_places(base: Path) -> None:
    """Targets, polygons and trajectories, which must lie where the strip does."""
    import laspy

    cloud = laspy.read(base / "cloud.laz")
    (x0, y0, _), (x1, y1, _) = cloud.header.mins, cloud.header.maxs
    x0, x1, y0, y1 = x0 - 5, x1 + 5, y0 - 5, y1 + 5  # footprints lie wholly inside
    corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    shape = {"type": "Polygon", "coordinates": [corners]}
    feature = {"type": "Feature", "properties": {"reflectance": 0.3, "name": "all", "incidence": 20}, "geometry": shape}
    document = json.dumps({"type": "FeatureCollection", "features": [feature]})
    (base / "targets.geojson").write_text(document)
    (base / "polygons.geojson").write_text(document)
    radius = x1 - x0 + y1 - y0
    heading = "name,reflectance,incidence,x,y,radius"
    (base / "targets.csv").write_text(f"{heading}\nall,0.3,20,{x0:.2f},{y0:.2f},{radius:.2f}\n")
    times = [float(cloud.gps_time.min()) + k for k in range(-2, 4)]
    (base / "energy.txt").write_text("time energy\n" + "".join(f"{t!r} {1 + k / 50}\n" for k, t in enumerate(times)))
    ray = laspy.read(base / "strip.las")
    toward = np.stack([ray["x_t"], ray["y_t"], ray["z_t"]], axis=1).astype(float)
    ray, toward = ray[toward[:, 2] > 0], toward[toward[:, 2] > 0]
    sensor = (ray.xyz + toward / toward[:, 2:] * (800 - ray.xyz[:, 2:])).mean(axis=0)
    x, y, z = (float(value) for value in sensor)  # of flights that are simulated: 800 m high, 60 m/s to the east
    lines = [f"{t!r},{x + 60 * (t - times[2]):.3f},{y:.3f},{z:.3f},0,0,90" for t in times]
    (base / "trajectory.txt").write_text("\n".join(["time,x,y,z,roll,pitch,heading", *lines]) + "\n")
    lines = [f"{t!r} 48.{k} 9.{k} 800" for k, t in enumerate(times)]
    (base / "degrees.txt").write_text("\n".join(["time latitude longitude height", *lines]) + "\n")
    (base / "trajectory.sbet").write_bytes(_sbet(times))


def _sbet(times: list[float]) -> bytes:
    from wavebatch.files.trajectory_file import SBET_RECORD

    records = np.zeros(len(times), SBET_RECORD)
    records["time"], records["latitude"], records["longitude"], records["height"] = times, 0.84, 0.157, 800
    return records.tobytes()


def weight(command: str) -> float:
    """Return how often a command is drawn."""
    return next((value for start, value in SLOW.items() if command.startswith(start)), 1.0)


def read_sound(base: Path) -> Iterator[tuple[str, bytes]]:
    """Yield every kind and its bytes."""
    for kind in COMMANDS:
        yield kind, (base / kind).read_bytes()


assert os.sep == "/"  # commands are split as a shell does
