"""Whatever is wrong with an option, a file or a key is one line on stderr, an exit code, and nothing is written.

A row: the command, its exit code, words of the line (those on both sides of ` .. ` in this order), and texts of files
that only this row needs. Refusals that leave something, or need a scene of their own, stand beside what they belong to.
"""

import json
import math
import os
import re
import shlex
import shutil
import sys

import numpy as np
import pytest
from commands import run_command
from plot_tools import write_cloud
from strips import make_raw

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Above, Range, declared_options
from wavebatch.stages.chain import effective, load_profile
from wavebatch.surveying.calibrating.calibration_files import format_calibration
from wavebatch.surveying.calibration import Calibration
from wavebatch.tools.plots.waveform import MOST_IN_PICTURE
from wavebatch.tools.raster import ForestOptions
from wavebatch.tools.scan_slices import Segment, SliceOptions
from wavebatch.tools.simulate import DiscreteReceiver, Recording, StripOptions, simulate_strip
from wavebatch.tools.simulate.returns import Radar, SynthesisOptions
from wavebatch.tools.slice_output import SegmentWriter
from wavebatch.tools.voxels.rays import Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions

RUN, SURVEY, SLICE = "run strip.las -o out", "survey strip.las", "slice strip.las"
VOXELS, WAVEFORM = "voxelize strip.las -o v.npz --size 1", "plot waveform strip.las -o p.png"
HISTOGRAM, MAP, PROFILE = "plot histogram cloud.laz -o p.png", "plot map cloud.laz -o p.png", "plot profile -o p.png"
SECTION = "plot section cloud.laz -o p.png"
GRID, FOREST = "grid cloud.laz -o x.tif", "grid forest.npz -o x.tif --forest"
CALIBRATE, COMPARE = "calibrate strip.las -o c.toml --targets", "compare strip.las"
CHAINS, RETURNS = "compare --strip strip.las", "synthesize shares.las -o s.las"
RADAR = f"{RETURNS} --intensity reflectance --sensor-height 1200"
EXCLUDED, AGAIN = "exclude each other", "; make it again with `wavebatch slice`"
NO_SEGMENTS = f"holds no segments .. {AGAIN}"
TOO_FEW = 'schema = "wavebatch.calibration/1"\n'
ONE = f"{TOO_FEW}constant = 1e-8\nrelative_error = 0.1\n"
RING = [[0, 0], [1, 1], [2, 2]]


def _chain(*stages, last="radius = 2.5"):
    return "".join(f'[[chain]]\nstage = "{stage}"\n' for stage in stages) + last


BASIC = ("noise.pooled", "detect.maximum", "decompose.gaussian", "attribute.position")
NORMALS = "attribute.incidence_angle_normals"


def _polygon(*rings, kind="Polygon"):
    return json.dumps({"features": [{"geometry": {"type": kind, "coordinates": rings}}]})


USAGE = [
    ("--nope", 2, "no such option '--nope'; see `wavebatch --help`"),
    ("rnu", 2, "no command 'rnu'; did you mean 'run'? see `wavebatch --help`"),
    ("plot mpa", 2, "no command 'mpa'; did you mean 'map'? see `wavebatch plot --help`"),
    ("plot histgram cloud.laz", 2, "did you mean 'histogram'?"),
    ("run a.las", 2, "missing option '-o' / '--output'; see `wavebatch run --help`"),
    ("run a.las -o d --crs", 2, "option '--crs' requires an argument; see `wavebatch run --help`\n"),
    ("check", 2, "error: "),
    ("stages decomposer", 2, "did you mean"),
    ("stages detect.maximun", 2, "did you mean 'detect.maximum'"),
    ("stages xyzzy", 2, "; `wavebatch stages` lists them\n"),
    ("export strip.las -o x.shp", 2, "x.shp: an output's name must end in .las, .laz or .npz\n"),
    *((f"{words} --seed -1", 2, f"invalid value for '--seed': -1 is not in the range x>=0; see `wavebatch {command}")
      for command, words in (("bench", "bench"), ("simulate", "simulate flat -o a.las"),
                             ("synthesize", "synthesize a.las -o b.las"))),
    *((f"{words} {value}", 2, "is not") for value in ("nan", "inf", "-inf", "1e999") for words in (
        f"{RUN} --attenuation", "plot section a -o x --aspect", "simulate flat -o x --noise", "stats a.las --area")),
    *((f"stats strip.las --area {value}", 2, "must be above 0") for value in ("0", "-3")),
    ("stats strip.las --area 1e-5", 2, "too small for these coordinates"),
    *((f"info {path} --log-file {log}", 2, why) for path, log, why in (
        ("strip.las", "strip.las", "is no log"), ("strip.las", "no/x.log", "cannot be written"))),
]  # fmt: skip
RUNS = [
    (f"{RUN} --profile balance", 2, "did you mean 'balanced'"),
    (f"{RUN} --profile autp", 2, "did you mean 'auto'"),
    (f"{RUN} --columns +echo_tim", 2, "did you mean 'echo_time'"),
    (f"{RUN} --columns +range,-amplitude", 2, "'-amplitude': a column cannot be taken away; list all that are wanted"),
    (f"{RUN} --columns ''", 2, "--columns: names no column; leave it out for the usual ones"),
    (f"{RUN} --chain none.toml", 2, "none.toml: chain file cannot be read"),
    (f"{RUN} --chain fast", 2, "there is no such file; the shipped chain is --profile fast"),
    (f"{RUN} --chain auto", 2, "the shipped chain is --profile auto"),
    (f"{RUN} --chain a.toml --profile fast", 2, EXCLUDED),
    (f"{RUN} --overwrite --resume", 2, "--overwrite and --resume exclude each other"),
    (f"{RUN} -q -v", 2, EXCLUDED),
    (f"{RUN} --attenuation 0 --visibility 9", 2, "--attenuation and --visibility exclude"),
    (f"{RUN} --profile fast --visibility 9", 2, "--visibility: chain profile fast computes nothing from it"),
    (f"{RUN} --survey flight --system system.toml", 2, EXCLUDED),
    (f"{RUN} --memory 12M", 2, "too little"),
    (f"{RUN} --memory 10", 2, "10 bytes is too little, one job needs 350 MB; write for example 500M"),
    (f"{RUN} --memory many", 2, "is not a size"),
    (f"{RUN} --report none/batch.json", 2, "folder none does not exist; make it first"),
    (f"{RUN} --report - --progress json", 2, "stdout"),
    (f"{RUN} --json --report -", 2, "would both write to stdout"),
    (f"{RUN} --json --progress json", 2, "would both write to stdout; leave one out"),
    *((f"{RUN} --config s.toml", 2, f"s.toml: {name}: the name is empty; remove the line",
       {"s.toml": f"[run]\n{name} = ''\n"}) for name in ("output", "system")),
    (f"{RUN} --config s.toml", 2, "'PDAL' is not one of .. 'opals' (s.toml); see `",
     {"s.toml": "[run]\nnames='PDAL'\n"}),
    *((words, 2, "the name is empty; is a variable of the shell not set?") for words in (
        "run '' -o out", "run strip.las -o ''", f"{RUN} --chain ''", f"{RUN} --polygon=", "stats ''",
        "compare strip.las ''", "check ''")),
    ("run strip.las -o out.laz", 2, "out.laz: this is a folder, which gets .. give a name such as out"),
    (f"{RUN} --jobs -1", 2, "--jobs"),
    (f"{RUN} --jobs 0.5", 2, "'0.5' is no whole number"),
    (f"{RUN} --jobs 100000", 2, "100000 is not in the range 0<=x<=1024"),
    (f"{RUN} --flight-height high", 2, "'high' is no number"),
    (f"{RUN} --points echos", 2, "--points"),
    (f"{RUN} --nothing", 2, "--nothing"),
    (f"{RUN} none*.las", 2, "matches no .las or .laz file"),
    ("run strip.las twin/strip.las -o out", 2, "both outputs would be named strip; .. for clouds, without strips\n"),
    ("run strip.las -o strip.las", 2, "'strip.las' is a file, not a folder"),
    ("run bad.las -o out --survey flight", 4, "bad.las"),
    (f"{RUN} --tolerance 2", 2, "'2' is no length"),
    (f"{RUN} --tolerance -2cm", 2, "is no length"),
    (f"{RUN} --tolerance 2cm --profile fast", 2, EXCLUDED),
    (f"{RUN} --tolerance 2cm --chain x.toml", 2, EXCLUDED),
    (f"{RUN} --system none.toml", 2, "none.toml: system file cannot be read"),
    (f"{RUN} --calibration none.toml", 2, "none.toml: calibration file cannot be read"),
    (f"{RUN} other.las --trajectory none.txt", 2, "none.txt: trajectory cannot be read: No such file"),
    (f"{RUN} --lever-arm 1,2", 2, "invalid value for '--lever-arm': '1,2' is not X,Y,Z"),
    (f"{RUN} --lever-arm 1,2,3", 2, "--lever-arm is of no use without --trajectory"),
    (f"{RUN} -c c.toml --flight-height 800", 2, "--flight-height: chain .. give --columns +range, or add stage",
     {"c.toml": _chain(*BASIC, last="")}),
    *((f"{RUN} --scheduler tcp://a:1 {option} {value}", 2, f"--scheduler and {option} exclude each other")
      for option, value in (("--jobs", 2), ("--jobs", 0), ("--memory", "2G"))),
    (f"{RUN} --scheduler ''", 2, "--scheduler: the address is empty"),
    (f"{RUN} --scheduler ' '", 2, "--scheduler: the address is empty"),
    (f"{RUN} --where 'ecko_width < 5'", 2, "--where: character 1: .. no column 'ecko_width'; did you mean 'echo_w"),
    (f"{RUN} --where 'amp > 3'", 2, "no column 'amp'; did you mean 'amplitude'?"),
    (f"{RUN} --where 'z <'", 2, "--where: character 4: a column or a number is missing"),
    (f"{RUN} --drop-flags RINGING", 2, "--drop-flags: flag 'RINGING' does not exist; did you mean 'RINGING_SUSPECT'"),
    (f"{RUN} --classes 2,x", 2, "'2,x' is no list of numbers"),
    (f"{RUN} --classes 2,300", 2, "--classes: .. must be numbers from 0 to 255"),
    (f"{RUN} --bbox 1,2,3", 2, "is not WEST,SOUTH,EAST,NORTH"),
    (f"{RUN} --bbox 5,2,3,9", 2, "--bbox: 5,2,3,9 must be .. west < east"),
    *((f"{command} --bbox 500000,500900,5400200,5400300", 2,
       "the order must be west, south, east, north; .. give 500000,5400200,500900,5400300")
      for command in (RUN, "plot map strip.las --column z -o p.png", "grid strip.las --column z --size 5 -o x.tif")),
    (f"{RUN} --polygon none.geojson", 2, "none.geojson"),
    (f"{RUN} --chain fast.toml --where 'incidence_angle_normals < 5'", 2, "does not compute it; add stage",
     {"fast.toml": effective(load_profile("fast"))}),
    *((f"{RUN} --{option} {path}", 2, f"{path}: this is {kind}, not {wanted}: give it as --{right}")
      for right, path, kind in (("chain", "chain.toml", "a chain file"), ("system", "system.toml", "a survey"),
                                ("calibration", "cal.toml", "a calibration"))
      for option, wanted in (("chain", "a chain file"), ("system", "a survey"), ("calibration", "a calibration"))
      if option != right),
    *((f"{RUN} -c c.toml", 2, words, {"c.toml": f'[[chain]]\nstage = "{stage}"\n'}) for stage, words in (
        ("detect.qqqqqqqqqqqqqqqq", "known are detect."),
        ("xyz", "names begin with noise., detect., decompose., attribute.; `wavebatch stages` lists them"))),
    *((f"{RUN} -c c.toml", 2, f"({NORMALS}): {words}", {"c.toml": _chain(*BASIC, NORMALS, last=line)})
      for line, words in (
        ("radius = -1.0", "radius must lie between 0 and 1000"), ("radius = 1e9", "radius must lie between 0 and 1000"),
        ("min_points = 3", "min_points must lie between 4 and 10000"),
        ("max_error = 0.0", "max_error must lie between 0.001 and 180"))),
]  # fmt: skip
FILES = [
    ("info list.txt", 1, "if it is a list of files, write @list.txt", {"list.txt": "strip.las\n"}),
    ("info strip.wdp", 1, "it has the packets of strip.las: give that file", {"strip.wdp": "\0" * 100}),
    ("run strip.pls -o out", 4, "it is PulseWaves: `wavebatch import strip.pls` makes a strip of it, or give strip.las",
     {"strip.pls": "PulseWavesPulse\0" + "\0" * 300}),
    ("info p.plz", 1, "`pulsezip -i p.plz -o p.pls` .. then `wavebatch import p.pls`",
     {"p.plz": "PulseWavesPulse\0" + "\0" * 300}),
    ("import a.wvs -o x.las", 4, "; give the a.pls that it belongs to\n", {"a.wvs": "PulseWavesWaves"}),
    ("stats t.npz", 1, "t.npz: not a LAS or LAZ file .. it is a file of arrays, as `voxelize`", {"t.npz": "PK\3\4"}),
    ("import strip.las -o x.las", 4, "it is LAS or LAZ, which `wavebatch run` reads\n"),
    *((f"{words} run/strip.laz", 1, "4, 5, 9 or 10; `wavebatch info` and `stats` read a cloud that wavebatch wrote\n")
      for words in ("survey", "voxelize --size 1 -o v.npz")),
    ("survey shares.las", 1, "4, 5, 9 or 10; `wavebatch info` and `stats` read clouds\n"),
    *((f"info {name}", 1, "it is a compressed file or an archive .. unpack it", {name: begin + "\0" * 400})
      for name, begin in (("s.las.gz", "\x1f\udc8b\b"), ("s.zip", "PK\3\4"), ("s.7z", "7z\udcbc\udcaf'"))),
    ("info e.las", 1, "it is empty", {"e.las": ""}),
    ("info e.las", 1, "e.las: not a LAS or LAZ file (it does not begin with LASF)\n", {"e.las": "nothing"}),
    ("bench none.las", 1, "none.las"),
    (f"{SURVEY} -o system.json", 2, "'system.json' must end in .toml; .. such as system.toml;"),
    (f"{SURVEY} --chain chain.json", 2, "such as chain.toml;"),
    *((f"{words} x.txt", 2, f"'x.txt' must end in .{end}; choose another name, such as x.{end};") for words, end in (
        ("stats cloud.laz -o", "csv"), ("compare cloud.laz cloud.laz -o", "csv"), (f"{RUN} --html", "html"),
        ("simulate flat -o s.laz --truth", "npz"))),
    *((f"{words} empty", 2, "no .las or .laz file; --recursive takes those of") for words in ("check", "stats")),
    ("import empty", 2, "the folder holds no .pls file; --recursive"),
    *((f"{words.format(name)}", 1, name, {"x.las": "no strip"}) for name in ("x.las", "none.las") for words in (
        "voxelize {} -o v.npz --size 1", f"{HISTOGRAM} --column z {{}}", f"{MAP} --column z {{}}")),
    ("compare strip.las none.las", 2, "none.las"), ("compare cloud.laz broken.laz", 2, "broken.laz"),
    ("compare strip.las x.las", 2, "x.las", {"x.las": "no cloud"}),
    *((f"{RUN} --profile fast --trajectory t.csv", 4, f"t.csv: .. {words}", {"t.csv": text}) for text, words in (
        ("time,x,y,z\n1,2,3,4\n2,3,4,5\n", "do not overlap on any clock"),
        ("time,x,y,z\nonly,words,here,now\n", "no line of numbers, such as 12.5, follows the header in line 1"),
        ("time,x,y,z\n1,2,3,4\n", "1 usable positions"),
        ("time,x,y,z\n3e14,2,3,4\n4e14,2,3,4\n", "with different times in seconds (up to 1e+12)"),
        ("time,lat,lon,h\n1,48,11,500\n2,48,11,500\n", "in degrees, but the strip has no CRS"))),
    *((f"{RUN} --trajectory t.csv", 2, f"t.csv: .. {words}", {"t.csv": text}) for text, words in (
        ("1,2,3,4\n5,6,7,8\n", "no line names the columns"), ("time,x,y\n1,2,3\n", "no line names the columns"),
        ("\n\n", "neither text nor SBET"), ("\0\1\2", "neither text nor SBET"))),
    # A wrong option is named before outputs that exist.
    ("run strip.las -o . --profile fast --where foo>1", 2, "there is no column 'foo'", {"strip.laz": "old"}),
    *((f"{CALIBRATE} t.csv", 2, f"t.csv: .. {words}", {"t.csv": text}) for text, words in (
        ("reflectance,x,y,radius\n0.2,1,2,-4\n", "target 1: the outline needs three corners, or a radius above 0"),
        ("reflectance,x,y,radius\n20,1,2,4\n", "reflectance must lie in 1e-06 to 1.5, not in per cent; it is 20"),
        ("reflectance;x;y;radius\n0,2;1;2;4\n", "it has reflectance;x;y;radius; a target .. CSV has commas between"),
        ("name,x\n", "no target in it"), ("reflectance,x,y\n0.2,1,2\n", "target 1: radius is missing"),
        ("x,y,radius\n1,2,3\n", "target 1: reflectance is missing"),
        (_polygon(RING), "target 1: reflectance is missing, it has vertices; a target has reflectance\n"),
        ("reflectance,x,y,radius\nhalf,1,2,3\n", "target 1: not numbers"),
        ("reflectance,x,y,radius,incidence\n0.2,1,2,3,89\n", "incidence must lie in 0 to 85"),
        ("reflectance,vertices\n0.2,1 2 3\n", "target 1: not numbers"), ('{"features": 3}', "not GeoJSON"),
        (_polygon(RING, RING), "2 rings; make every part a target, without holes"),
        (_polygon(1, 2, kind="Point"), "is a Point"), ("{", "not GeoJSON"))),
    *((f"{RUN} --calibration k.toml", 2, f"k.toml: .. {words}", {"k.toml": text}) for text, words in (
        ("x = ", "not valid TOML"), (f"{TOO_FEW}constnt = 1.0", "unknown key 'constnt'; did you mean 'constant'"),
        ('schema = "other"', "schema is 'other'"), (TOO_FEW, "key 'constant' is missing"),
        (f'{TOO_FEW}constant = "a"\nrelative_error = 1', "constant must be a number"),
        (f"{TOO_FEW}constant = 0\nrelative_error = 1", "must lie between 1e-30 and"),
        (f"{ONE}section_constant = 1e-15", "no div"),
        (f"{ONE}divergence_mrad = 1\nsection_constant = 8e-15", "but there is 7.853981633974"),
        (f"{ONE}[[channel]]\ndigitizer = 1.5\n{ONE[len(TOO_FEW):]}", "digitizer must be an integer, it is 1.5"),
        (f"{ONE}[[channel]]\ndigitizer = 1\nscanner = 4\n{ONE[len(TOO_FEW):]}", "scanner must lie between 0 and 3"),
        (f"{ONE}[[channel]]\ndigitizer = 0\n{ONE[len(TOO_FEW):]}", "must lie between 1 and 255"),
        (f"{ONE}[[channel]]\ndigitizer = 1\nrelative_error = 0.1", "key 'constant' is missing"),
        (f"{ONE}[[channel]]\ndigitizer = 1\nconstant = 1e-8\nerror = 0.1", "unknown key 'error'"),
        (ONE + 2 * f"[[channel]]\ndigitizer = 1\n{ONE[len(TOO_FEW):]}",
         "2: digitizer 1 with scanner channel 0 has two tables"))),
    *(("stats strip.las --polygon p.json", 2, f"p.json: .. {words}", {"p.json": text}) for text, words in (
        ("{", "no JSON at line 1, column 2"), ('{"features": 3}', 'needs "features"'),
        ('{"features": [3]}', "feature 1: not GeoJSON of a polygon"), ('{"features": []}', "holds no polygon"),
        (_polygon(1, 2, kind="Point"), "feature 1 is a Point"), (_polygon(), "has no ring"),
        (_polygon([["x", 1]]), "feature 1: not GeoJSON"), (_polygon([[0], *RING[1:]]), "feature 1: not GeoJSON"),
        (_polygon([]), "no corner"), (_polygon(RING[:2]), "three corners"),
        (_polygon([[0, 0], [1, 1], [float("nan"), 2]]), "finite"), ("[" * 100_000, "list of polygons"))),
]  # fmt: skip
SETTINGS = [
    *(("run set -o out --dry-run", 2, words, {"set/wavebatch.toml": text}) for text, words in (
        ("[run]\njbos = 3\n", "has no option 'jbos'; did you mean 'jobs'?"),
        ("[run]\nconfig = 'x.toml'\n", "has no option 'config'"), ("run = 3\n", "must be a table"),
        ("[runn]\ncolumns = 'range'\n", "there is no command 'runn' to give options to, as in [run]; did you mean"),
        ("columns = 'range'\n", "there is no command 'columns'"), ("[run.range]\n", "has no option 'range'"),
        *((f"[run]\nprofile = {value}\n", "must not set profile so")
          for value in ("'../c.toml'", "'c.toml'", '"\\u001b[2Jfast"')),
        (f"[run]\ncolumns = '{'x' * 5000}'\n", "must not set columns so"),
        (f"[run]\n{'x' * 5000} = 1\n", "has no option 'xxx"), ('[run]\ncolumns = "\\u001b[2J"\n', "\\x1b[2J"),
        ('[run]\nattenuation = "much"\n', "invalid value for '--attenuation'"),
        # A log in the shell's profile would run the text of an error at the next login.
        ('[run]\ncolumns = "+amplitude_error,$(touch pwned) #"\nlog-file = ".bash_profile"\n', "must not set"),
        *((text, "wavebatch.toml") for text in (
            "[run\n", "a = " + "9" * 5000, "a." * 5000 + "a = 1", "a = " + "[" * 5000, "a = [")))),
    ("import a.pls -o a.las", 2, "must not set resume so",
     {"wavebatch.toml": "[import]\nresume = true\n", "a.pls": ""}),
    ("stats set twin", 2, "different settings",
     dict.fromkeys(("set/wavebatch.toml", "twin/wavebatch.toml"), '[stats]\nwhere = "z > 0"\n')),
]  # fmt: skip
TOOLS = [
    ("simulate forrest -o s.las", 2, "did you mean 'forest'"), ("simulate opne -o s.las", 2, "did you mean 'open'?"),
    ("simulate flat -o s.las --rho 0.3", 2, "rho must be"), ("simulate flat -o s.las --kappa 3", 2, "kappa"),
    ("simulate flat -o s.las --pulses 0", 2, "at least one pulse"), ("simulate flat -o none/s.las", 1, "folder"),
    ("simulate flat -o s.las --las-version 1.3 --point-format 9", 2, "1.3"),
    ("simulate flat -o s.las --baseline 255", 2, "baseline must lie"),
    ("simulate flat -o s.las --sensor discrete --external", 2, "--external is about packets"),
    ("simulate canopy.corn -o s.las --dead-zone 1", 2, "--dead-zone"),
    ("simulate canopy.corn -o s.las --sensor discrete --truth t.npz", 2, "--truth"),
    ("simulate canopy.corn -o s.las --sensor discrete --dead-zone -1", 2, "--dead-zone"),
    ("bench --scene opne", 2, "did you mean 'open'?"), ("bench a.las b.las", 2, "one strip at a time"),
    ("bench --waveforms 0", 2, "--waveforms': 0 is not in the range"), ("bench --tolerance 2", 2, "no length"),
    ("bench missing.toml", 2, "cannot be read"),
    (f"{COMPARE}", 2, "--truth"), (f"{COMPARE} other.las --truth truth.npz", 2, "--truth"),
    (f"{COMPARE} truth.npz", 2, "--truth"), (f"{COMPARE} --truth other.las", 2, "no truth file"),
    (f"{COMPARE} other.las --within -1", 2, "tolerance"),
    (f"{COMPARE} strip.las --within 1e9", 2, "tolerance 1e+09 ns (--within): must be above 0 and below 1e6"),
    (f"{COMPARE} other.las --min-exact 95", 2, "invalid value for '--min-exact': 95.0 is not in"),
    ("compare fast accurate", 2, "--strip STRIP"), ("compare none.toml strip.las", 2, "--strip STRIP"),
    (f"{COMPARE} strip.las --limit 5", 2, "--limit is of no use without --strip"),
    (f"{COMPARE} strip.las --system x.toml", 2, "--system is of no use without --strip"),
    (f"{CHAINS} fats", 2, "fats: is neither a file nor a shipped chain; did you mean 'fast'?"),
    (f"{CHAINS} fast --truth truth.npz", 2, "--strip and --truth exclude each other; `wavebatch bench` compares"),
    (f"{CHAINS} fast run/strip.laz --limit 5", 2, "leave --limit out"),
    (f"{CHAINS} run/strip.laz", 2, "without --strip"), (f"{CHAINS} run/strip.laz cloud.laz", 2, "without --strip"),
    (f"{CHAINS} fast none.toml", 2, "none.toml"), (f"{CHAINS} fast none.las", 2, "none.las"),
    ("compare fast accurate --strip none.las", 2, "none.las"),
    ("compare fast accurate --strip run/strip.laz", 2, "strip.laz"),
    (f"{CHAINS} fast accurate --within 0", 2, "tolerance"), (f"{CHAINS} fast --where 'z > 0'", 2, "--where"),
    *((f"{words} --where 'z = 5'", 2, "--where: character 3: write == for '='") for words in (
        "stats cloud.laz", f"{HISTOGRAM} --column z", f"{MAP} --column z", "compare cloud.laz cloud.laz", VOXELS)),
    ("stats strip.las --where echo_width<5", 2, "`wavebatch run` writes echo_width into clouds, and this is none"),
    (f"{SURVEY} --divergence 0.5 --angles a.csv", 1, "which width a surface has that faces the sensor"),
    (f"{SURVEY} other.las --divergence 0.5 --angles a.csv", 2, "is for one strip"),
    (f"{CALIBRATE} t.csv --chain c --profile auto", 2, "--chain and --profile exclude each other"),
    ("calibrate strip.las --targets t.csv -o cal.csv", 2, "such as cal.toml"),
    (f"{CALIBRATE} t.csv --lever-arm 1,2,3", 2, "--lever-arm is of no use without --trajectory"),
    (f"{CALIBRATE} t.csv --attenuation .1 --wavelength 532", 2, EXCLUDED),
    ("calibrate strip.las -o c.toml", 2, "give --targets FILE, or --from-column NAME"),
    (SLICE, 2, "give -o for the segments, --png or --overview for a picture, or --cube; see `wavebatch slice --help`"),
    (f"{SLICE} --lines 3:1", 2, "invalid value for '--lines': '3:1' is empty; END is the number"),
    (f"{SLICE} -o s.csv --lines a", 2, "--lines"), (f"{SLICE} --png s.png --lines 99", 1, "--lines"),
    (f"{SLICE} -o s.csv --geojson-crs keep", 2, "--geojson-crs keep is of no use without -o FILE"),
    (f"{SLICE} -o s.txt", 2, ".csv or .geojson"), (f"{SLICE} --cube c.txt", 2, "c.txt"),
    (f"{SLICE} -o s.csv --std 0", 2, "not in the range x>0"),
    ("voxelize strip.las -o v.npz", 2, "--size"), ("voxelize strip.las --size 1", 2, "--output"),
    ("voxelize strip.las --size 0 -o v.npz", 2, "not in the range 0<x"),
    ("voxelize strip.las --size nan -o v.npz", 2, "'--size': nan"),
    ("voxelize strip.las --size 1e-7 -o v.npz", 2, "too small .. take .. m or more"),
    ("voxelize strip.las --size .001 -o v.npz", 2, "below a hundredth .. take 0.0015 m or more"),
    ("voxelize strip.las --size 1 -o v.tif", 2, ".npz, .las or .laz"), (f"{SURVEY} -o none/s.toml", 1, "none"),
    *((f"voxelize strip.las --size 1 -o none/{name}", 1, "make the folder first") for name in ("v.npz", "v.las")),
    (f"{VOXELS} --profiles p.csv", 2, ".npz"), (f"{VOXELS} --profiles v.npz", 2, "two outputs have this name"),
    (f"{VOXELS} --profiles none/p.npz", 1, "none"), (f"{VOXELS} --snr 5", 2, "--snr needs --method wiener"),
    (f"{VOXELS} --method wiener --iterations 5", 2, "has no --iterations"),
    (f"{VOXELS} --flight-height 500", 2, "of no use without --calibration"),
    (f"{VOXELS} --trajectory t.txt", 2, "of no use without --calibration"),
    (f"{VOXELS} --trajectory t --flight-height 9", 2, "--trajectory and --flight-height"),
    (f"{VOXELS} --calibration none.toml --crs EPSG:25832", 2, "--trajectory"),
    (f"{VOXELS} --calibration none.toml", 2, "cannot be read"), (f"{VOXELS} --system none.toml", 2, "cannot be read"),
    (f"{VOXELS} --calibration cal.toml", 2, "divergence"),
    (f"{RADAR} --shares percent", 1, "holds 40, which is no share"), (f"{RADAR} --shares minus", 1, "holds -0.1"),
    (f"{RADAR} --shares share", 2, "is in [%], needed is [-]"),
    (f"{RADAR} --widths w", 2, "is in [ps], needed is [ns]"),
    (f"{RADAR} --shares footprnt", 2, "did you mean 'footprint'"),
    (f"{RADAR} --widths nothing", 2, "has no column 'nothing'"),
    (f"{RETURNS} --shares footprint", 2, "need --intensity reflectance"),
    *((f"{words}{gain}", 2, why) for gain in ("", " --gain 0.05") for words, why in (
        *((f"{RETURNS} --widths {name}", "is the LAS field") for name in (
            "intensity", "classification", "'Point Source ID'", "return_number", "user_data")),
        (f"{RADAR} --shares scan_direction_flag", "LAS field scan_direction_flag"),
        (f"{RETURNS} --widths many", "60 of 100 values are outside of 1.2 to 118 ns"))),
    (f"{RETURNS} --intensity reflectance", 2, "--sensor-height"),
    (f"{RETURNS} --power 3", 2, "need --intensity reflectance"),
    (f"{RETURNS} --width 0", 2, "--width"), (f"{RETURNS} --width 0.5", 2, "too short"),
    ("synthesize shares.las -o t.txt", 2, "t.txt"),
]  # fmt: skip
PICTURES = [
    *(("plot waveform strip.las -o w.csv " + words, 2, f"{words.split()[0]} is for pictures")
      for words in ("--sheet", "--show detector", "--times all")),
    (f"{WAVEFORM} --chain c --profile fast", 2, "--chain and --profile exclude each other"),
    (f"{WAVEFORM} --seed 3", 2, "--seed is of no use without --random"),
    (f"{WAVEFORM} --packet 3 --most 2", 2, "--most and --packet exclude each other"),
    (f"{WAVEFORM} --times 5000:6000", 2, "no sample lies there; the waveforms end at"),
    (f"{WAVEFORM} --times 5", 2, "LOW:HIGH"), (f"{WAVEFORM} --profile fastt", 2, "did you mean 'fast'"),
    (f"{WAVEFORM} --packet 99999", 2, "there is no packet 99999; packets are 0 to"),
    (f"{WAVEFORM} --packet 5:3", 2, "'5:3' is empty; END is the number after the last one"),
    (f"{WAVEFORM} --packet x", 2, "neither a number nor FIRST:END"),
    (f"{WAVEFORM} --packet 0:{MOST_IN_PICTURE + 1}", 2, f"{MOST_IN_PICTURE} fit"),
    (f"{WAVEFORM} --random 3 --packet 2", 2, "--random and --packet exclude each other"),
    (f"{WAVEFORM} --point 99999", 2, "there is no point 99999"),
    (f"{WAVEFORM} --gps-time 3", 2, "no pulse lies within"),
    (f"{WAVEFORM} --flags SATURATED --packet 3", 2, "--flags"),
    (f"{WAVEFORM} --flags SATURATD", 2, "did you mean 'SATURATED'"),
    (f"{WAVEFORM} --where amplitude>1 --point 3", 2, "--where and --point exclude each other"),
    (f"{WAVEFORM} --random 3 --most 2", 2, "--random and --most exclude each other"),
    (f"{WAVEFORM} --sheet --echoes", 2, "--sheet and --echoes exclude each other"),
    (f"{WAVEFORM} --where amplitud>1", 2, "did you mean 'amplitude'"),
    (f"{WAVEFORM} --where amplitude>1e6", 1, "no echo meets"), (f"{WAVEFORM} --chain none.toml", 2, "none.toml"),
    (f"{WAVEFORM} --show asdff", 2, "must be one of"), (f"{WAVEFORM} --sheet --show asdf", 2, "--show"),
    *((f"{words} {more}", code, why) for words in (HISTOGRAM, MAP) for more, code, why in (
        ("--column amplitud", 2, "did you mean 'amplitude'? Columns of the file: amplitude, echo_flags"),
        ("--column qqqqqq", 2, "known are amplitude"), ("--column amp", 2, "did you mean 'amplitude'? Columns"),
        ("--column intensity --flags WEEK", 2, "did you mean 'WEAK'"),
        ("--column intensity --flags NO_WAVEFORM", 1, "1000 of 1000 points are left out by their flags"))),
    (f"{PROFILE} cloud.laz --statistic mean", 2, "needs a --column; --statistic count needs none"),
    *((f"plot {kind} {cloud} -o p.png --column {column}", code, why) for kind in ("histogram", "map")
      for cloud, column, code, why in (
        ("none.laz", "z", 1, "none.laz"), ("broken.laz", "z", 1, "broken.laz"),
        ("hollow.las", "z", 1, "holds no points"),
        ("blank.las", "amplitude", 1, "9 have no data in amplitude"),
        ("blank.las", "intensity --flags WEAK", 2, "no column echo_flags"))),
    ("plot histogram cloud.laz --column z -o p.gif", 2, ".png, .svg, .pdf"),
    (f"{HISTOGRAM} --column z --range 5:1", 2, "does not go up"),
    (f"{HISTOGRAM} --column z --range nan:1", 2, "does not go up"),
    (f"{HISTOGRAM} --column z --range 0:inf", 2, "does not go up"),
    (f"{HISTOGRAM} --column echo_flags --bins 3", 2, "--bins"), (MAP, 2, "needs a --column"),
    (f"{MAP} --column echo_flags", 2, "cloud.laz: echo_flags are bits, which have no mean; count"),
    (f"{MAP} --column z --bbox 1,2,3", 2, "WEST,SOUTH,EAST,NORTH"),
    (f"{MAP} --column z --bbox 1,0,0,1", 2, "west < east"),
    (f"{MAP} --column z --size 1e-4", 2, "too many to draw; cells of .. m will do"),
    (f"{MAP} --column z --size 0", 2, "at least"), (f"{MAP} --column z --statistic mode", 2, "mean .. median"),
    ("plot map strip.las --column echowidth -o m.png", 2, "`wavebatch run` writes echo_width into clouds"),
    (f"{SECTION} --line 1,2,3", 2, "X0,Y0,X1,Y1"), (f"{SECTION} --line 1,2,1,2", 2, "two different points"),
    (f"{SECTION} --line 0,0,1,1", 1, "of 1000 points lies within"), (f"{SECTION} --width 0", 2, "above 0"),
    (f"{SECTION} --where z<-99", 1, "1000 of 1000 points are left out by --where"),
    (f"{SECTION} voxels.npz", 2, "drawn alone"), ("plot section s.csv -o p.png", 2, "segments have no side view"),
    ("plot section @l.txt -o p.png", 2, "segments have no side view", {"l.txt": "s.csv\n"}),
    ("plot section voxels.npz -o p.png --column reflectance", 2, "has no column"),
    ("plot section voxels.npz -o p.png --flags WEAK", 2, "no echo_flags"),
    ("plot section cube.npz -o p.png", 1, "holds no voxels"), ("plot cube voxels.npz -o p.png", 1, "holds no cube"),
    (f"{PROFILE} cloud.laz --size -1", 2, "above 0"), (f"{PROFILE} cloud.laz --size 1e-9", 2, "more than 5000 bins"),
    (f"{PROFILE} cloud.laz --statistic sum", 2, "needs a --column"),
    (f"{PROFILE} s.csv cloud.laz", 2, "without clouds"), (f"{PROFILE} s.csv --where z<3", 2, "--where selects points"),
    (f"{PROFILE} s.csv --flags WEAK", 2, "--flags selects points"), (f"{PROFILE} s.csv --column lenght", 2, "'length'"),
    (f"{PROFILE} s.csv --statistic mean", 2, "needs a --column"), (f"{PROFILE} head.csv", 1, "holds no segment"),
    (f"{PROFILE} other.csv", 1, f"'z1' is missing .. {AGAIN}", {"other.csv": "a,b\n1,2\n"}),
    (f"{PROFILE} word.csv", 1, NO_SEGMENTS), (f"{PROFILE} nan.csv", 1, f"segment 1 holds .. {AGAIN}"),
    (f"{PROFILE} none.csv", 1, "none.csv: cannot be read: No such file"),
    (f"{PROFILE} x*.csv", 2, "x*.csv: matches no .las, .laz, .csv or .geojson file"),
    (f"{PROFILE} folder.csv", 2, "the folder holds no"),
    *((f"{PROFILE} a.geojson", 1, NO_SEGMENTS, {"a.geojson": text}) for text in (
        "{", "[1]", "[" * 100_000,
        '{"features": [{"properties": {}, "geometry": {"coordinates": [[1, 2], [3, 4]]}}]}')),
]  # fmt: skip
RASTERS = [
    (GRID, 2, "needs a --column"), (f"{GRID} --column amplitud", 2, "did you mean 'amplitude'"),
    ("grid cloud.laz --column z -o x.png", 2, "such as x.tif"),
    (f"{GRID} --column z --size 0", 2, "not in the range 0<x"),
    (f"{GRID} --column z --crs EPSG:4978", 2, "geocentric"),
    (f"{GRID} --column z --crs EPSG:0", 2, "write the code of a CRS"),
    (f"{GRID} --statistic count --crs EPSG:99999", 2, "; write the code of a CRS, e.g. EPSG:32632\n"),
    (f"{GRID} --column z --no-data 1e39", 2, "float32"),
    (f"{GRID} --statistic count --no-data 1", 2, "choose another with --no-data"),
    ("grid blank.las --statistic count --flags WEAK -o x.tif", 2, "has no column echo_flags"),
    (f"{FOREST} --column share", 2, "--forest and --column exclude each other"),
    (f"{FOREST} --statistic max", 2, EXCLUDED),
    (f"{GRID} --layer 2 --column z", 2, "--layer is of no use without --forest"),
    ("grid run/strip.laz --column cross_section -o x.tif", 2,
     "writes cross_section into clouds: add --columns +cross_section"),
]  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with one sound file of each kind, and some that are not."""
    folder = tmp_path_factory.mktemp("refusals")
    simulate_strip("urban", folder / "strip.las", pulses=400, seed=3, truth=folder / "truth.npz")
    for name in ("other.las", "set/strip.las", "twin/strip.las"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(folder / "strip.las", folder / name)
    for words in (("survey", folder / "strip.las", "-o", folder / "system.toml", "--chain", folder / "chain.toml"),
                  ("run", folder / "strip.las", "-o", folder / "run", "--profile", "fast", "-q")):  # fmt: skip
        assert run_command(*words).exit_code == 0
    (folder / "cal.toml").write_text(format_calibration(Calibration(2.5e-8, 0.03)))
    (folder / "bad.las").write_bytes(b"LASF")
    (folder / "empty").mkdir()
    rng = np.random.default_rng(5)
    amplitude, flags = rng.gamma(2.0, 30.0, 1000).astype("f4"), rng.choice([0, 8, 16], 1000).astype("u2")
    write_cloud(folder / "cloud.laz", n=1000, amplitude=(amplitude, None, None, "peak above the baseline [DN]"),
                echo_flags=(flags, None, None, "flags: docs/columns.md [bits]"))  # fmt: skip
    write_cloud(folder / "hollow.las", n=0)
    nothing = (np.full(9, -1, "f4"), np.array([-1.0]), None, "peak [DN]")
    write_cloud(folder / "blank.las", n=9, amplitude=nothing)
    (folder / "broken.laz").write_bytes((folder / "cloud.laz").read_bytes()[:3000])
    columns = {"percent[-]": 40.0, "share[%]": 0.4, "minus[-]": -0.1, "w[ps]": 4000.0, "footprint[-]": 0.9,
               "many[ns]": 5.0}  # fmt: skip
    stored = {name.split("[")[0]: (np.full(100, value, "f4"), None, None, name) for name, value in columns.items()}
    stored["many"][0][:60] = 4000.0
    write_cloud(folder / "shares.las", n=100, **stored)
    index, energy = rng.integers(0, 40, (300, 3)).astype(np.int32), rng.uniform(0, 100, 300).astype("f4")
    np.savez(folder / "voxels.npz", index=index, energy=energy, origin=np.zeros(3), size=0.5, crs="", meta="{}")
    np.savez(folder / "cube.npz", values=np.zeros((2, 2, 2)))
    with SegmentWriter(folder / "s.csv", overwrite=True) as writer:
        writer.write([Segment(0, 0, (0.0, 0.0, 1.0), (1.0, 1.0, 2.0), ((0, 0), (1, 1)), length=1.0, slope=0.0,
                              residual=0.1, pulses=5, first_pulse=0, last_pulse=4, first_point=0, theta=0.0, rho=0.0,
                              weight=2.0)])  # fmt: skip
        writer.commit()
    head, row = (folder / "s.csv").read_text().splitlines()
    (folder / "head.csv").write_text(f"{head}\n")
    for name in ("word", "nan"):
        values = row.split(",")
        values[4] = name
        (folder / f"{name}.csv").write_text(f"{head}\n{','.join(values)}\n")
    (folder / "folder.csv").mkdir()
    return folder


def _list_files(folder, *, folders):
    found = (path for path in folder.rglob("*") if folders or not path.is_dir())
    return {(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in found}


def _refuse(folder, command, code, words):
    """Run a command in the folder and see that it is refused as it must be."""
    for start, package in (("plot", "matplotlib"), ("grid", "rasterio")):
        if command.startswith(start):
            pytest.importorskip(package)
    is_begun = code == 4 or "--where" in command or "order" in words  # a run that reads a strip has made its folder
    before = _list_files(folder, folders=not is_begun)
    done = run_command(*shlex.split(command), prog_name="wavebatch")
    assert done.exit_code == code and done.stdout == "", done.output
    lines = [line for line in done.stderr.splitlines() if not line.startswith("settings: ")]
    assert len(lines) == 1 and len(lines[0]) < 2000 and lines[0].startswith("error: "), done.stderr
    assert re.search(".*".join(map(re.escape, words.split(" .. "))), done.stderr), done.stderr
    for word in ("a bug", "Error:", "object", "\x1b"):
        assert word not in done.stderr, done.stderr
    assert _list_files(folder, folders=not is_begun) == before


@pytest.mark.parametrize("row", USAGE + RUNS + FILES + SETTINGS + TOOLS + PICTURES + RASTERS, ids=lambda row: row[0])
def test_what_is_wrong_is_one_line_an_exit_code_and_no_file(place, monkeypatch, row):
    command, code, words, *texts = row
    monkeypatch.chdir(place)
    made = {place / name: text for one in texts for name, text in one.items()}
    try:
        for path, text in made.items():
            path.write_text(text, "utf-8", "surrogateescape")
        _refuse(place, command, code, words)
    finally:
        for path in made:
            path.unlink()


@pytest.mark.parametrize(
    ("command", "name", "code"),
    [
        (f"{RUN} --profile fast", "out/strip.laz", 4), (f"{SURVEY} -o s.toml", "s.toml", 1),
        (f"{SURVEY} -o s.toml --chain c.toml", "c.toml", 1),
        *((f"simulate flat -o s.las --pulses 20 {more}", name, 1) for more, name in (
            ("", "s.las"), ("--external", "s.wdp"), ("--truth t.npz", "t.npz"), ("--sensor discrete", "s.las"))),
        (VOXELS, "v.npz", 1), ("voxelize strip.las -o v.las --size 1 --profiles p.npz", "p.npz", 1),
        (f"{SLICE} -o s.csv --lines 0:2", "s.csv", 1), (f"{SLICE} --cube c.npz --lines 0:2", "c.npz", 1),
        ("synthesize cloud.laz -o s.las", "s.las", 1), ("export strip.las -o x.npz", "x.npz", 1),
        ("stats cloud.laz -o s.csv", "s.csv", 1), (f"{CHAINS} fast balanced -o s.csv", "s.csv", 2),
        (f"{WAVEFORM[:-3]}csv --echoes --profile fast", "p.csv", 1), (f"{HISTOGRAM} --column z", "p.png", 1),
        (f"{GRID} --column z", "x.tif", 1),
    ],
)  # fmt: skip
def test_an_existing_file_is_kept_without_overwrite(place, monkeypatch, command, name, code):
    monkeypatch.chdir(place)
    before = set(place.rglob("*"))
    try:
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).write_text("old")
        _refuse(place, command, code, f"{name}: .. --overwrite")
        done = run_command(*shlex.split(command), "--overwrite")
        assert done.exit_code == 0 and (place / name).read_bytes() != b"old", done.output
    finally:
        for path in sorted(set(place.rglob("*")) - before, reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()


OPTIONS = {
    SliceOptions: {}, VoxelOptions: {"size": 1.0}, Deconvolution: {}, Recording: {}, StripOptions: {},
    ForestOptions: {}, DiscreteReceiver: {}, Radar: {"height": 900.0}, SynthesisOptions: {},
}  # fmt: skip
"""What must be given to each."""


@pytest.mark.parametrize("kind", OPTIONS, ids=lambda kind: kind.__name__)
def test_python_is_refused_what_the_command_line_is(kind):
    """NaN, values just beyond the limits, and those that would overflow."""
    assert kind(**OPTIONS[kind])
    for name, one in declared_options(kind).items():
        wrong = ["?", -1] if one.choices else []
        if one.limits:
            low, high = one.limits
            wrong = [math.nan, -math.inf, low - 1.0, *([low] if isinstance(one.limits, Above) else [])]
            wrong += [math.inf, 1e300, 10**400, high + max(1.0, 1e-9 * high)] if high < math.inf else []
        for value in wrong:
            with pytest.raises(ConfigError, match="^--[a-z-]+ [^:]+: (must lie (from|above) |choose |must be a whole)"):
                kind(**{**OPTIONS[kind], name: value})


def test_limits_with_and_without_their_least_value_differ():
    """Python 3.11.2 gave the limits of one option to another: `voxelize` had a traceback with an unknown variable."""
    low, above = Range(0.0, 1.0), Above(0.0, 1.0)
    assert low != above and above != low and above == Above(0.0, 1.0) and len({low, above}) == 2
    assert not (low == above or above == low or above != Above(0.0, 1.0))


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX systems")
@pytest.mark.quick_cases("*chain fifo*", "*log-file*", "*trajectory*", "*zero*", "*lost*")  # the others wait 2 s each
@pytest.mark.parametrize(
    ("command", "code", "words"),
    [
        *((f"{RUN} --profile fast {option} fifo", 2, "fifo: .. nothing writes into this pipe")
          for option in ("--system", "--calibration", "--polygon")),
        (f"{RUN} --chain fifo", 2, "fifo: .. nothing writes into this pipe"),
        (f"{RUN} --profile fast --log-file fifo", 2, "is a pipe; choose a file"),
        (f"{RUN} --profile fast --trajectory fifo", 2, "is a folder, a pipe or a device; give a file"),
        (f"{RUN} --chain /dev/zero", 2, "device"), ("run @/dev/zero -o out", 2, "device"),
        ("info /dev/zero", 1, "device"), (f"{RUN} --trajectory /dev/zero", 2, "device"),
        ("stats strip.las --polygon /dev/zero", 2, "device"), ("survey lost.las", 1, "packets are missing"),
    ],
)  # fmt: skip
def test_what_would_be_read_for_ever_is_refused(tmp_path, monkeypatch, command, code, words):
    """A pipe without another end, a device that never ends."""
    monkeypatch.chdir(tmp_path)
    make_raw(60).write(tmp_path / "strip.las")
    make_raw(60, internal=False).write(tmp_path / "lost.las").with_suffix(".wdp").unlink()
    for name in ("fifo", "lost.wdp"):
        os.mkfifo(tmp_path / name)
    _refuse(tmp_path, command, code, words)


@pytest.mark.parametrize(("command", "code"), [("run", 4), ("survey", 1), ("voxelize --size 1", 1), ("check", 1)])
def test_files_without_packets_are_one_line(data, tmp_path, monkeypatch, command, code):
    monkeypatch.chdir(tmp_path)
    paths = sorted((data / "no-packets").glob("*.la?"))
    assert len(paths) >= 7
    for path in paths:
        if command == "check":
            done = run_command(command, path)
            assert done.exit_code == 1 and re.fullmatch(f"{path}: .*\n", done.stdout)
        else:
            out = {"run": "out", "survey": "s.toml"}.get(command, "v.npz")
            _refuse(tmp_path, f"{command} {path} -o {out}", code, path.name)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (f"{HISTOGRAM} --column z", "pictures need matplotlib: .. pip install .. 'matplotlib>=3.8'"),
        (f"{GRID} --column z", "pip install .. 'rasterio>=1.3'"),
        (f"{RUN} --scheduler tcp://a:1", "pip install .. 'distributed>="),
    ],
)
def test_a_package_that_is_missing_says_what_to_install(place, monkeypatch, command, words):
    monkeypatch.chdir(place)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    _refuse(place, command, 2, words)
