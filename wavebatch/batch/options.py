"""The options of a run: one declaration each, for the command, the Python function and the documentation.

`cli.options` makes click's options of the fields of RunOptions, `tools.api` the keywords of `wavebatch.run`. Before
you change it: this module is imported for `--help`, so it imports nothing that takes time.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Range, check_options, declared_options, option, typed

if TYPE_CHECKING:
    from wavebatch.core.condition import Condition
    from wavebatch.stages.chain import Chain
    from wavebatch.surveying.systems.survey_result import Survey

CHAIN, READING, SENSOR, AIR = "Chain and pulse", "Reading", "Position of the sensor", "Air and light"
WHICH, OUTPUT, SPEED, RUNNING = "Which points", "Output", "Speed and memory", "How it runs"
HEADINGS = (CHAIN, READING, SENSOR, AIR, WHICH, OUTPUT, SPEED, RUNNING)
"""Groups of options in this order in every --help."""


EXCLUSIVE = (
    ("chain", "profile", "tolerance"), ("overwrite", "resume"), ("quiet", "verbose"), ("scheduler", "jobs"),
    ("scheduler", "memory"), ("attenuation", "visibility"),
    ("attenuation", "wavelength"), ("trajectory", "flight_height"), ("forest", "statistic"), ("forest", "columns"),
    ("strip", "truth"), ("strip", "where"), ("sheet", "show"), ("sheet", "table"),
    *((one, other) for one in ("flags", "where", "most", "random") for other in ("packets", "point_numbers", "times")),
    *(("random", one) for one in ("flags", "where", "most")),
)  # fmt: skip
"""Options that exclude each other. One in wavebatch.toml replaces those that come from a weaker source."""
REMEDIES: dict[tuple[str, ...], str] = {
    ("strip", "truth"): "`wavebatch bench` compares chains with a truth",
    ("strip", "where"): "`wavebatch run` both chains, then compare the clouds with --where",
}
"""What gives the user both of two options that exclude each other."""

NEEDS = {
    "lever_arm": ("trajectory",), "crs": ("trajectory",), "wavelength": ("visibility",),
    "attenuation_error": ("attenuation", "visibility"), "seed": ("random",),
    "leaf_projection": ("forest",), "layer": ("forest",),
    "limit": ("strip",), "system": ("strip",), "force": ("strip",),
}  # fmt: skip
"""Options that are of no use without one of others."""


MOST_JOBS = 1024
"""Most processes: more is a slip of the finger, and would stop the machine."""

SAME_CLOUD = ("output", "recursive", "jobs", "scheduler", "memory", "block_size", "overwrite", "resume")
"""Options that do not change a cloud; --resume makes clouds anew where any other option has changed."""


def check_together(
    given: Mapping[str, Any], known: Collection[str], spelled: Callable[[str], str] = typed
) -> None:
    """Raise ConfigError for two options that exclude each other, and for one without the option that it needs.

    Parameters
    ----------
    given : mapping
        Its keys are the names of the options that the user gave.
    known : collection of str
        Names of the options that there are: another command may have one without those that it needs in `run`.
    spelled : callable
        Gives an option as it is typed from its name.
    """
    for rivals in EXCLUSIVE:
        names = [spelled(name) for name in rivals if name in given]
        if len(names) > 1:
            remedy = REMEDIES.get(rivals, "give one of them")
            raise ConfigError(f"{names[0]} and {names[1]} exclude each other; {remedy}")
    if "system" in given and given.get("survey") == "flight":
        raise ConfigError("--system and --survey flight exclude each other; give one of them")
    for name, needed in NEEDS.items():
        if not set(known) & set(needed):
            continue
        if name in given and not any(one in given for one in needed):
            others = " or ".join(map(spelled, needed))
            raise ConfigError(f"{spelled(name)} is of no use without {others}; give that too, or leave it out")


@frozen
class RunOptions:
    """All that can be asked of a run besides the strips; each field is an option of `wavebatch run`."""

    output: Path | str = option(
        Path(), "Folder for clouds and reports; created if it does not exist.", OUTPUT, "DIR", short="o", usual=True
    )
    chain: Chain | Path | str | None = option(
        None, "Run the chain of this chain file (TOML).", CHAIN, "FILE", short="c"
    )
    profile: str | None = option(
        None, "Run a shipped chain; auto surveys the strip and chooses the cheapest chain that suits it.",
        CHAIN, "auto|fast|balanced|accurate", unset="auto", usual=True,
    )  # fmt: skip
    tolerance: float | None = option(
        None, "For each strip, choose the cheapest shipped chain whose predicted range error is at most this, e.g. "
        "0.02m.", CHAIN, "LENGTH",
    )  # fmt: skip
    system: Survey | Path | str | None = option(
        None, "Use this saved survey (`wavebatch survey -o FILE`) instead of surveying the strip.", CHAIN, "FILE"
    )
    force: bool = option(
        False, "Use the survey of --system also where bits, noise or echo width of the strip contradict it, and a .wdp "
        "also where its packets are those of another strip.", CHAIN
    )
    survey: Literal["each", "flight"] = option(
        "each", "Survey each strip alone, or all strips once: kept as DIR/flight.system.toml, used again with "
        "--resume and for later strips; a strip that does not fit it is named and surveyed alone.", CHAIN,
    )  # fmt: skip
    calibration: Path | str | None = option(
        None, "Calibration file of `wavebatch calibrate`: adds calibrated columns; cross sections need its divergence.",
        CHAIN, "FILE", usual=True,
    )  # fmt: skip
    direction: Literal["auto", "toward", "away"] = option(
        "auto", "Direction of the packet vectors: toward or away from the sensor; auto finds it from the file.", READING
    )
    headerless: bool = option(False, "Read a .wdp file that lacks its 60-byte header.", READING)
    recursive: bool = option(False, "Also take the files in subfolders, but not of links to folders.", READING)
    trajectory: Path | str | None = option(
        None, "Trajectory of the sensor: text with columns time, x, y, z, or SBET. Without it the sensor position is "
        "estimated from the packet vectors.", SENSOR, "FILE", usual=True,
    )  # fmt: skip
    lever_arm: tuple[float, float, float] | None = option(
        None, "Offset from trajectory to scanner: forward, right, down [m].", SENSOR, "X,Y,Z"
    )
    crs: str | None = option(None, "CRS of the strip, e.g. EPSG:32632; for a trajectory in degrees.", SENSOR, "CRS")
    flight_height: Annotated[float | None, Range(1.0, 100_000.0)] = option(
        None, "Flight height above ground [m], used if the packet vectors do not give the position; not with "
        "--trajectory.", SENSOR, "M",
    )  # fmt: skip
    attenuation: Annotated[float | None, Range(0.0, 100.0)] = option(
        None, "Attenuation of the air during the flight, one way [dB/km].", AIR, "DB_KM",
        unset="that of --calibration, else 0.22",
    )  # fmt: skip
    attenuation_error: Annotated[float | None, Range(0.0, 100.0)] = option(
        None, "Standard deviation of the attenuation [dB/km]: goes into the errors.", AIR, "DB_KM", unset="0"
    )
    visibility: Annotated[float | None, Range(0.5, 400.0)] = option(
        None, "Meteorological visibility during the flight [km], in place of --attenuation.", AIR, "KM"
    )
    wavelength: Annotated[float | None, Range(300.0, 2500.0)] = option(
        None, "Wavelength of the laser [nm], for --visibility.", AIR, "NM", unset="1064"
    )
    energy: Path | str | None = option(
        None, "Energy of each emitted pulse, which backscatter and normalized amplitudes are divided by: an extra byte "
        "of the strips, or a text file with columns time (GPS time of the points) and energy; none: not divided.",
        AIR, "COLUMN|FILE|none", unset="the extra byte pulse_energy, where it is there",
    )  # fmt: skip
    where: Condition | str | None = option(
        None, "Write only points that meet this, e.g. \"number_of_returns == 2 and not (classification == 7 or "
        "echo_width >= 8)\"; points without data in a column meet nothing on it.", WHICH, "CONDITION", usual=True,
    )  # fmt: skip
    drop_flags: str | None = option(
        None, "Leave out points with one of these flags, e.g. RINGING_SUSPECT,WEAK; return numbers are counted "
        "without them.", WHICH, "NAMES",
    )  # fmt: skip
    classes: tuple[int, ...] | None = option(None, "Write only points of these classes, e.g. 2,6.", WHICH, "LIST")
    bbox: tuple[float, float, float, float] | None = option(
        None, "Write only points of this part: west, south, east, north, in the coordinates of the strips.", WHICH,
        "W,S,E,N",
    )  # fmt: skip
    polygon: Path | str | None = option(
        None, "Write only points inside these polygons, in WGS 84, in the CRS that the file names, or in the "
        "coordinates of the strips.", WHICH, "FILE.geojson",
    )  # fmt: skip
    points: Literal["echoes", "returns"] = option(
        "echoes", "Write one point per echo, or the input points with the attributes of their echoes.", OUTPUT
    )
    columns: str | None = option(
        None, "a,b writes only these columns; +a,+b adds them to the usual ones. The automatic chain and the shipped "
        "ones get the stages that make them; skew needs a chain file.", OUTPUT, "LIST", usual=True,
    )  # fmt: skip
    names: Literal["wavebatch", "asprs", "riegl", "pdal", "opals"] = option(
        "wavebatch", "Naming scheme for names and units of the extra bytes.", OUTPUT
    )
    format: Literal["laz", "las"] = option("laz", "File format of the clouds.", OUTPUT)
    point_format: Annotated[int | None, Range(0, 10)] = option(
        None, "LAS point format of the clouds.", OUTPUT, "0-10", unset="6, or 7 or 8 where the strip has colours"
    )
    las_version: Literal["1.4", "1.3", "keep"] = option(
        "1.4", "LAS version of the clouds. PDAL and QGIS read extra bytes only from LAS 1.4; keep: that of the strip, "
        "with its point format.", OUTPUT,
    )  # fmt: skip
    no_data: Literal["-9999", "nan"] = option(
        "-9999", "What floating-point columns hold where an echo has no value; declared in the cloud.", OUTPUT
    )
    strict: bool = option(
        False, "Fail where extra bytes of the strip have no free value to mark added echoes; these get the value of "
        "the nearest return otherwise.", RUNNING,
    )  # fmt: skip
    keep_packets: bool = option(
        False, "Copy the waveforms too: point format and packets stay as they are.", OUTPUT
    )
    jobs: Annotated[int, Range(0, MOST_JOBS)] = option(
        1, "Processes; 0: one per processor. The result does not depend on it.", SPEED, "N", usual=True
    )
    scheduler: str | None = option(
        None, "Use the workers of this dask cluster instead of --jobs, e.g. tcp://10.0.0.1:8786. They must see strips "
        "and DIR under the same paths, and have the same wavebatch.", SPEED, "ADDRESS",
    )  # fmt: skip
    memory: int | None = option(None, "Most memory of all processes together, e.g. 2G.", SPEED, "SIZE")
    block_size: Annotated[int | None, Range(1, float("inf"))] = option(
        None, "Waveforms processed at once. The result does not depend on it.", SPEED, "N", unset="by their length"
    )
    overwrite: bool = option(False, "Replace existing files.", OUTPUT, usual=True)
    resume: bool = option(
        False, "Skip strips whose output is complete and up to date; redo the others.", RUNNING, usual=True
    )
    on_event: Callable[[dict[str, Any]], None] | None = None
    """Of `wavebatch.run` only; jobs do not carry it to other processes."""

    @property
    def folder(self) -> Path:
        """Of the clouds."""
        return Path(self.output)

    def check(self) -> None:
        """Raise ConfigError for options that exclude or need each other, and for values that they do not take."""
        check_together(self.given(), OPTIONS)
        check_options(self)
        if self.scheduler is not None and not self.scheduler.strip():
            raise ConfigError("--scheduler: the address is empty; leave it out to work on this machine")

    def given(self) -> dict[str, Any]:
        """Return the options that differ from their defaults."""
        values = {name: getattr(self, name) for name in OPTIONS}
        return {
            name: value
            for name, value in values.items()
            if value is not OPTIONS[name].default and (OPTIONS[name].default is None or value != OPTIONS[name].default)
        }

    def command(self, strip: str) -> str:
        """Return the command that makes the cloud of a strip again; files have their names without folders."""
        parts = ["wavebatch run", shlex.quote(strip), "-o DIR"]
        for name, value in self.given().items():
            if name in SAME_CLOUD:
                continue
            shipped = isinstance(value, str) and Path(value).name == value and not Path(value).suffix
            option = typed("profile" if name == "chain" and shipped else name)
            parts.append(option if value is True else f"{option} {shlex.quote(_text(name, value))}")
        return " ".join(parts)


def _text(name: str, value: Any) -> str:
    """A value as it is typed."""
    if isinstance(value, tuple | list):
        return ",".join(f"{one:.15g}" for one in value)
    if name == "where":
        return getattr(value, "text", value)
    if not isinstance(value, str | Path):
        return {"chain": "CHAIN.toml", "system": "SYSTEM.toml", "tolerance": f"{value}m"}.get(name, str(value))
    return Path(value).name if Path in OPTIONS[name].kinds else str(value)


OPTIONS = declared_options(RunOptions)


def describe_options() -> str:
    """Return the options as the section Parameters of a docstring."""
    lines = []
    for one in [one for one in fields(RunOptions)[1:] if one.name in OPTIONS]:  # the output is no keyword
        words = OPTIONS[one.name].words
        text = re.sub(r"--([a-z][a-z-]+)", lambda found: f"`{found[1].replace('-', '_')}`", words.help)
        default = words.unset or ("" if one.default in (None, False) else repr(one.default))
        kind = re.sub(r"^Annotated\[(.*?), Range.*\]$", r"\1", str(one.type))
        lines += [f"{one.name} : {kind}", f"    {text}" + (f" Default: {default}." if default else "")]
    return "\n".join(lines)
