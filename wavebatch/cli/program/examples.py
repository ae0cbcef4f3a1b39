"""Examples of every command, and the groups of options: for --help, the manual pages and the page Commands.

`tests/cli/test_program.py` parses every example, and checks that every command has one.
"""

from __future__ import annotations

from wavebatch.batch.options import AIR, CHAIN, OUTPUT, READING, RUNNING, WHICH

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "run": (
        ("wavebatch run strip.las -o clouds", "one strip; the chain is chosen by a survey of it"),
        ("wavebatch run strips/ -o clouds --survey flight --jobs 0 --html run.html",
         "a flight on all processors, with a report page"),
        ("wavebatch run strips/ -o clouds --resume", "go on after an interruption"),
        ("wavebatch run strip.las -o clouds --trajectory flight.txt --columns +range",
         "with a trajectory, and the range as a column"),
        ("wavebatch run strip.las -o clouds --dry-run", "show chain, columns and sizes; write nothing"),
    ),
    "info": (("wavebatch info strip.las", "points, packets, descriptors and samples"),),
    "check": (
        ("wavebatch check strip.las mychain.toml", "one line per problem; exit code 1 if there is any"),
    ),
    "survey": (
        ("wavebatch survey strip.las", "noise, pulse and scene, and which chain the strip needs"),
        ("wavebatch survey strip.las -o system.toml --chain chain.toml", "save both for `run --system` and `--chain`"),
    ),
    "import": (
        ("wavebatch import flight.pls -o flight.las", "flight.las and flight.wdp, and flight.system.toml"),
        ("wavebatch import archive/ -o strips --resume", "all files of a folder; go on after an interruption"),
    ),
    "export": (
        ("wavebatch export strip.las -o repaired.laz", "packets as the LAS specification has them"),
        ("wavebatch export strip.las -o strip.npz", "waveforms with their geometry as arrays"),
    ),
    "stages": (
        ("wavebatch stages", "list all algorithms"),
        ("wavebatch stages decompose.adaptive", "one with parameters, units, source and a TOML example"),
    ),
    "simulate": (
        ("wavebatch simulate forest -o forest.laz --pulses 50000 --truth truth.npz", "a strip with known echoes"),
    ),
    "compare": (
        ("wavebatch compare clouds/strip.laz strip.las", "a cloud with the vendor's returns"),
        ("wavebatch compare --strip strip.las fast accurate", "two chains on the waveforms of a strip"),
        ("wavebatch compare clouds/strip.laz --truth truth.npz --min-completeness 0.95",
         "with the truth; exit code 1 below 95 %"),
    ),
    "stats": (("wavebatch stats clouds/*.laz", "return numbers, separations and flags of clouds"),),
    "synthesize": (
        ("wavebatch synthesize cloud.laz -o strip.las", "waveforms from the returns of a cloud"),
        ("wavebatch synthesize cloud.laz -o strip.las --intensity reflectance --sensor-height 1200 --shares equal",
         "by the lidar equation, with partial footprints"),
    ),
    "slice": (("wavebatch slice strip.las -o lines.csv", "straight surface lines in the scan lines"),),
    "voxelize": (("wavebatch voxelize strip.las --size 1 -o voxels.npz", "cross sections in voxels of 1 m"),),
    "plot": (),
    "plot waveform": (
        ("wavebatch plot waveform strip.las -o fits.png", "six waveforms, spread over the strip"),
        ("wavebatch plot waveform strip.las -o bad.svg --flags NOT_CONVERGED,AT_BOUND", "fits to look at"),
        ("wavebatch plot waveform strip.las -o sheet.png --random 100 --sheet", "a sheet of 100 random waveforms"),
    ),
    "plot histogram": (
        ('wavebatch plot histogram clouds/*.laz --column z --where "classification == 2" -o ground.png', "ground only"),
        ("wavebatch plot histogram clouds/*.laz --column echo_width -o widths.png", "widths of all clouds"),
    ),
    "plot map": (
        ("wavebatch plot map clouds/ --column amplitude --size 1 -o map.png", "mean amplitude in cells of 1 m"),
    ),
    "plot section": (
        ("wavebatch plot section clouds/ --width 2 --column echo_width -o side.png",
         "2 m wide, along the longer extent"),
    ),
    "plot profile": (
        ("wavebatch plot profile voxels.npz --column energy -o heights.png", "energy by height"),
        ("wavebatch plot profile lines.csv --column length -o lines.png", "length of surface lines by height"),
    ),
    "plot cube": (
        ("wavebatch plot cube cube.npz --y 3 --t 250 -o slices.png", "scan line 3, and all pulses at 250 ns"),
    ),
    "grid": (
        ("wavebatch grid clouds/ --column amplitude --column echo_width --statistic median --size 1 -o x.tif",
         "two bands for GIS"),
        ("wavebatch grid clouds/ --statistic density --size 5 -o density.tif", "points per square metre"),
        ("wavebatch grid clouds/ --column z --statistic max --where 'classification != 7' -o top.tif",
         "without points of noise"),
    ),
    "calibrate": (
        ("wavebatch calibrate strip.las --targets targets.csv --divergence 0.5 -o cal.toml",
         "for `run --calibration cal.toml`"),
        ("wavebatch calibrate *.laz --targets targets.csv --scan-angle --html cal.html -o cal.toml",
         "with light that falls across the swath"),
    ),
    "bench": (
        ("wavebatch bench strip.las -o bench", "all shipped chains on echoes like those of the strip"),
        ("wavebatch bench --scene open --tolerance 0.02m", "the cheapest chain with 2 cm of range error"),
    ),
}  # fmt: skip
"""Per command: a line to type, and what it is for."""

GROUPS: dict[str, tuple[str, ...]] = {
    "Options": ("grid columns", "slice most"),
    READING: ("grid crs",),
    CHAIN: ("waveforms", "divergence"),
    AIR: ("reflectance_error", "scan_angle"),
    WHICH: ("flags", "packets", "point_numbers", "times", "most", "random", "limit"),
    OUTPUT: ("html_file", "report", "as_json"),
    RUNNING: ("dry_run", "fail_on", "progress", "verbose", "quiet", "log_path", "log_level", "config", "debug", "help"),
}
"""Names of options under a heading of --help, besides those of RunOptions. Others come first, under Options.

With the command in front where the name means something else in others."""

FEWEST = 8
"""Pages with fewer options than this have no groups."""

MANY, USUAL, ALSO_USUAL = 40, "Options that most runs need", ("html_file",)
"""Pages with more options than MANY begin with those that RunOptions calls usual, and these."""
