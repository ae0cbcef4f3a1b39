"""A strip as users open and survey it; its problems, for `wavebatch check`; what its packets show, for `info` too.

`Strip`, `open_strip` and `survey` are names of the public API: commands that only survey import no part of a run.
`check` compares the header's claims with the points, which wavebatch itself does not use. Before you change it: an
error in a file is a finding here, never an exception.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import without_nan
from wavebatch.core.errors import ConfigError, InputError, StripWarning
from wavebatch.core.frozen import frozen
from wavebatch.core.units import count
from wavebatch.core.waveforms import Digitizer, WaveformBlock
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.las.header import LasHeader, read_header
from wavebatch.files.las.write_points import Statistics
from wavebatch.files.strip.reader import StripFacts, StripReader, StripScan
from wavebatch.files.strip.scanner import describe_oddities

TYPE_CHECKING = False
if TYPE_CHECKING:
    from wavebatch.surveying.systems.survey_result import Survey

_SAMPLED = 4096
"""Waveforms of which extremes are read."""

_MATCHED = 1024
"""Waveforms whose echoes are compared with the returns."""

LARGEST_TIME = 1e10
"""No GPS time is later [s]: three centuries."""

LEAST_RETURNS, LEAST_MATCHED, MOST_FOREIGN = 20, 0.7, 0.5
"""Returns in waveforms with echoes, and share of them that an echo should match: below it the packets are doubted. Own
packets match .92 to 1.00 of them (real strips), or .74 where a tenth of the simulated ones is weaker than the noise;
those of another strip .1 to .4, so that with the last share or more some of the packets are the strip's.
"""


@frozen
class Findings:
    """The result of `check` for one file; `problems` and `notes` are lines without the file's name."""

    file: str
    problems: tuple[str, ...]
    """Reasons why the file, or part of it, cannot be processed correctly."""
    notes: tuple[str, ...]
    """Deviations from the format that do no harm here."""
    summary: str = ""

    @property
    def is_clean(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def to_json(self) -> dict[str, Any]:
        """Return the findings as plain values."""
        return {"clean": self.is_clean, **without_nan(asdict(self))}


def check_file(path: Path | str, *, direction: str = "auto", headerless: bool = False) -> Findings:
    """Check a strip, or a chain file (`.toml`); errors become findings, they are not raised.

    Parameters
    ----------
    path : path
    direction : str
        Where packet vectors point: auto, toward or away.
    headerless : bool
        Accept a .wdp file without its 60-byte header.

    Returns
    -------
    Findings
    """
    path = Path(path)
    if path.suffix.lower() == ".toml":
        from wavebatch.stages.chain import load_chain_file  # stages and survey: half of the start of `info`

        try:
            chain = load_chain_file(path)
        except (ConfigError, InputError) as error:
            return Findings(str(path), (_without_name(path, error),), ())
        need = "has no stage attribute.position, which `run` needs; `compare` and `bench` do without"
        return Findings(str(path), (), (need,) * ("x" not in chain.makes), f"{len(chain.steps)} stages")
    try:
        with (
            StripReader(path, direction=direction, headerless=headerless) as reader,
            reader.scan(tolerant=True) as scan,
        ):
            if scan.broken and not scan.with_waveform:
                return Findings(str(path), scan.problems[:1], ())
            from wavebatch.surveying.sensor import judge_scale  # as the survey in `_match_returns`, not for `info`

            facts = reader.facts
            problems = [*scan.problems, *scan.warnings, *facts.warnings]
            try:
                describe_samples(reader, scan)
                problems += judge_scale(reader, scan)
            except InputError as error:
                problems.append(_without_name(path, error))
            else:
                problems += () if scan.stranger else doubt_packets(facts, *_match_returns(reader, scan))
            notes = [
                f"descriptor {index} has gain 0; counts are used as they are"
                for index in scan.by_descriptor
                if index in facts.digitizers and facts.digitizers[index].gain == 0
            ]
            if not scan.with_waveform + scan.broken:
                notes.append("no point has a waveform; every point would be passed through")
            notes += [*name_gains(facts, scan), *scan.notes, *audit_header(reader, scan)]
            counts = (scan.points, "point"), (scan.packets, "packet")
            summary = ", ".join(f"{n} {name}{'s' * (n != 1)}" for n, name in counts)
            if scan.packets:
                summary += f", vectors {scan.vectors.direction} the sensor"
            return Findings(str(path), tuple(problems), tuple(notes), summary)
    except (OSError, ConfigError, MemoryError) as error:  # the other files are still checked
        return Findings(str(path), (_without_name(path, error),), ())


def audit_header(reader: StripReader, scan: StripScan) -> Iterator[str]:
    """Yield a line for each count or bound of the header that the points contradict, and for points without a time."""
    facts = reader.facts
    claimed = read_header(facts.path)
    true = LasHeader(claimed.version, claimed.point_format, claimed.point_length, claimed.scales, claimed.offsets)
    statistics, timeless = Statistics(facts.dtype, ()), 0
    for start, stop in zip(scan.borders[:-1].tolist(), scan.borders[1:].tolist(), strict=True):
        points = reader.read_points(start, stop)
        statistics.add(points)
        timeless += int(np.count_nonzero(~(np.abs(points["gps_time"]) < LARGEST_TIME)))
    statistics.fill(true)
    if not true.point_count:
        return
    if timeless:
        yield f"{count(timeless, 'point')} without a possible GPS time: neither their pulses nor ranges can be known"
    known = 15 if claimed.version >= (1, 4) else 5
    if claimed.by_return[:known] != true.by_return[:known]:
        pairs = zip(claimed.by_return, true.by_return, strict=False)
        number, (wrong, right) = next((k, pair) for k, pair in enumerate(pairs, 1) if pair[0] != pair[1])
        yield f"counts by return in the header are wrong (return {number}: {wrong}, counted: {right})"
    slack = 1.5 * np.abs(claimed.scales)
    outside = (np.array(true.mins) < np.array(claimed.mins) - slack) | (np.array(true.maxs) > claimed.maxs + slack)
    if not np.all(~outside):
        axes = ", ".join(np.array(list("xyz"))[outside].tolist())
        yield f"points lie outside the bounds that the header claims ({axes})"


def describe_samples(reader: StripReader, scan: StripScan) -> dict[str, Any]:
    """Extremes of waveforms spread over the strip; of none where no packet can be used."""
    rows = []
    for block in reader.sample_blocks(scan, _SAMPLED) if scan.with_waveform else ():
        at_limit = (block.samples == block.digitizer.max_count).any(axis=1)
        extremes = int(block.samples.min()), int(block.samples.max())
        gaps = 0 if block.missing is None else int(block.missing.any(axis=1).sum())
        rows.append((len(block), *extremes, int(np.count_nonzero(at_limit)), gaps, block.samples.shape[1]))
    columns: Any = zip(*rows, strict=True) if rows else ((),) * 6
    numbers, least, largest, limited, with_gaps, lengths = columns
    return {
        "waveforms_read": sum(numbers),
        "least": min(least, default=None),
        "largest": max(largest, default=None),
        "waveforms_at_limit": sum(limited),
        "waveforms_with_gaps": sum(with_gaps),
        "lengths": sorted(set(lengths)),
    }


def _without_name(path: Path, error: Exception) -> str:
    """The error's line without the file's name in front, which the caller shows."""
    return " ".join(str(error).split()).removeprefix(f"{path}: ")


SAME_GAIN = 1e-3
"""Relative difference up to which gains are the same: amplitudes have larger errors."""


def name_gains(facts: StripFacts, scan: StripScan) -> Iterator[str]:
    """Say that counts of several descriptors do not compare, where these have other gains."""
    used = [digitizer for index, digitizer in facts.digitizers.items() if index in scan.by_descriptor]
    gains = sorted({abs(digitizer.gain) for digitizer in used} - {0.0})
    if gains and gains[-1] > (1 + SAME_GAIN) * gains[0]:
        yield (
            f"descriptors have gains of {', '.join(f'{gain:g}' for gain in gains)} V per count: amplitudes and "
            "energies are in counts of each, and do not compare; `calibrate` gives each scanner channel its constant"
        )


def doubt_files(facts: StripFacts, scan: StripScan) -> Iterator[StripWarning]:
    """What is odd about the files of a strip that can be processed."""
    for line in facts.warnings:
        yield StripWarning("lost-points" if line in facts.unread else "header", line)
    losses = tuple(describe_oddities(scan.reasons, 0))  # points whose packets cannot be used
    for line in scan.warnings:
        yield StripWarning("lost-packets" if line in losses else scan.doubts.get(line, "packets"), line)


def doubt_packets(facts: StripFacts, matched: int, returns: int) -> Iterator[str]:
    """Say that packets do not belong to the points, if too few returns in waveforms with echoes match an echo."""
    if returns >= LEAST_RETURNS and matched < LEAST_MATCHED * returns:
        file, own = facts.packets.file, facts.packets.internal or matched >= MOST_FOREIGN * returns
        other = "" if file is None or own else f"{file.name} belongs to another strip, or "
        yield (
            f"only {matched} of {returns} returns lie where their packet has an echo: {other}the return locations "
            "(which should be picoseconds after the first sample) are wrong, and so are the positions of added echoes; "
            "or points stand in the file twice"
        )


def _match_returns(reader: StripReader, scan: StripScan) -> tuple[int, int]:
    """How many returns match an echo, and how many are in waveforms with echoes, in a sample of the strip."""
    blocks = list(reader.sample_blocks(scan, _MATCHED)) if scan.with_waveform else []
    if not blocks:
        return 0, 0
    from wavebatch.stages.chain import load_profile
    from wavebatch.surveying.survey import survey_blocks

    system, chain = survey_blocks(blocks, learn=False).system, load_profile("accurate")
    matched = returns = 0
    for block in blocks:
        echoes = chain.run(block, system)
        if block.returns is not None:
            matched += int(np.count_nonzero(echoes.attributes["point"] >= 0))
            returns += int(np.count_nonzero(np.isin(block.returns.waveform, echoes.waveform)))
    return matched, returns


BLOCK_SIZE = 16_384
"""Waveforms of a block by default: above some 4,000 the speed hardly changes, memory does (80 samples: about 10 MB)."""


class Strip(Closing):
    """An open full-waveform strip. A context manager; make one with `open_strip`.

    `len(strip)` is the number of waveforms, each counted once however many points share it. The first use of `len`,
    `scan` or `blocks` reads all point records once.

    Attributes
    ----------
    reader : StripReader
        Reads points and packets unit by unit.
    """

    def __init__(self, reader: StripReader) -> None:
        self.reader = reader
        self._scan: StripScan | None = None
        self._closed = False

    def __len__(self) -> int:
        """Return the number of waveforms."""
        return self.scan.packets

    def __repr__(self) -> str:
        """Return path and number of points."""
        return f"<Strip {self.facts.path}: {self.facts.header.point_count} points>"

    @property
    def facts(self) -> StripFacts:
        """What the headers say: path, point format, point count, scales, offsets, digitizers, ..."""
        return self.reader.facts

    @property
    def digitizers(self) -> Mapping[int, Digitizer]:
        """How samples were made, by the index of the wave packet descriptor."""
        return self.reader.facts.digitizers

    @property
    def crs(self) -> str | None:
        """Coordinate reference system as the file has it (WKT or GeoTIFF keys as text); None without one."""
        return self.reader.facts.crs

    @property
    def scan(self) -> StripScan:
        """Result of one pass over all point records, made on first use.

        Raises
        ------
        InputError
            Where the strip cannot be processed: no packet can be read, vectors point nowhere, ...
        ValueError
            Where the strip is closed.
        """
        if self._closed:
            raise ValueError(f"{self.facts.path} is closed: use it inside its `with`, or open it again")
        if self._scan is None:
            self._scan = self.reader.scan()
        return self._scan

    def blocks(self, size: int | None = None) -> Iterator[WaveformBlock]:
        """Every waveform of the strip once, in blocks of one digitizer and one length.

        Parameters
        ----------
        size : int, optional
            Most waveforms of a block; 16384 by default. The echoes do not depend on it.

        Yields
        ------
        WaveformBlock
            n waveforms of s samples, in the order of the file within each digitizer.
        """
        if size is not None and size < 1:
            raise ValueError(f"size must be at least 1, got {size}")
        yield from self.reader.all_blocks(self.scan, size or BLOCK_SIZE)

    def close(self) -> None:
        """Close the files and remove temporary ones. Harmless twice."""
        self._closed = True
        if self._scan is not None:
            self._scan.close()
            self._scan = None
        self.reader.close()


def open_strip(path: Path | str, *, direction: str = "auto", headerless: bool = False) -> Strip:
    """Open a LAS or LAZ strip with waveforms; only headers are read.

    Parameters
    ----------
    path : path or str
        File of point format 4, 5, 9 or 10; external packets lie in a .wdp file of the same name.
    direction : {"auto", "toward", "away"}
        Where packet vectors point, seen from the target; "auto" lets the file decide.
    headerless : bool
        Accept a .wdp file without its 60-byte header.

    Returns
    -------
    Strip
        Close it, or use it in a `with` statement.

    Raises
    ------
    InputError
        Where the file is not what it claims to be; one line with the reason.
    """
    return Strip(StripReader(path, direction=direction, headerless=headerless))


def survey(
    strip: Strip | Path | str | WaveformBlock | Iterable[WaveformBlock],
    *,
    waveforms: int | None = None,
    divergence: float | None = None,
    find_divergence: bool = False,
    for_checks: bool = True,
) -> Survey:
    """Measure sensor and scene on a sample of the strip: noise, system pulse, saturation, overlapping echoes.

    Parameters
    ----------
    strip : Strip, path, str, WaveformBlock or iterable of WaveformBlock
        The strip, opened with `open_strip`, or its path; or waveforms of yours (`WaveformBlock.from_samples`), which
        are all looked at.
    waveforms : int, optional
        Waveforms to look at, spread over the strip; 8192 by default, fewer where they are long.
    divergence : float, optional
        Full angle of the beam between the 1/e^2 points [mrad]. With it the survey also says whether echo widths tell
        incidence angles.
    find_divergence : bool
        Also look for the beam's divergence in the widths of echoes from surfaces of known slope: the figures
        `divergence_seen_mrad` and `divergence_seen_error_mrad`, where they tell.
    for_checks : bool
        Also measure by what a saved survey knows other strips of the sensor, and what neighbours that are not found add
        to errors: a seventh of the time, and nothing that is printed.

    Returns
    -------
    Survey
        `.system` is the SystemPulse for `Chain.run`; `.decisions` say which parts of a chain the strip needs, and why.

    Raises
    ------
    InputError
        Where the strip cannot be read or holds no waveform.
    ConfigError
        Where it is neither a strip nor waveforms, or an option cannot be, or needs points that it does not have.
    """
    if not (waveforms is None or isinstance(waveforms, int | np.integer) and waveforms >= 1):
        raise ConfigError(f"waveforms: must be a whole number from 1 on, got {waveforms!r}")
    if not (divergence is None or isinstance(divergence, int | float | np.number) and 0.001 <= divergence <= 100):
        raise ConfigError(f"divergence: must lie from 0.001 to 100 mrad, got {divergence!r}")
    from wavebatch.surveying.choose_chain import read_sample  # `info` needs none of these
    from wavebatch.surveying.flat_ground import survey_angles
    from wavebatch.surveying.look import join_digitizers, with_look
    from wavebatch.surveying.outgoing import compare_outgoing
    from wavebatch.surveying.survey import survey_blocks

    if isinstance(strip, Path | str):
        with open_strip(strip) as opened:
            return survey(
                opened, waveforms=waveforms, divergence=divergence, find_divergence=find_divergence,
                for_checks=for_checks,
            )  # fmt: skip
    if not isinstance(strip, Strip):
        if divergence is not None or find_divergence:
            raise ConfigError("divergence: needs the points of a strip; leave it out for waveforms of your own")
        sample = list(strip) if isinstance(strip, Iterable) else [strip]
        if not all(isinstance(block, WaveformBlock) for block in sample):
            raise ConfigError("survey: give a strip, its path, or blocks of waveforms by `WaveformBlock.from_samples`")
        digitizers = [block.digitizer for block in sample]
        known = {one.index: one for one in digitizers}
        pairs = [(one, known[one.index]) for one in digitizers]
        if not all(a.bits == b.bits and math.isclose(a.spacing, b.spacing, rel_tol=1e-6) for a, b in pairs):
            raise ConfigError("survey: the spacing or the bits of blocks of one digitizer differ; survey them apart")
        if not any(map(len, sample)):
            raise InputError("these blocks hold no waveform to be surveyed")
        return _with_decisions(with_look(survey_blocks(sample), sample))
    sample = read_sample(strip.reader, strip.scan, waveforms)
    if not sample:
        path = strip.facts.path
        raise InputError(f"{path}: holds no waveform to be surveyed; `wavebatch check` says what it holds")
    found = compare_outgoing(survey_blocks(sample, errors=for_checks), strip.facts.path)
    if for_checks:
        found = with_look(found, join_digitizers(sample))
    if divergence is not None:
        found = survey_angles(strip.reader, strip.scan, found, divergence)
    elif find_divergence:
        with contextlib.suppress(InputError):  # coordinates that are not in metres
            found = survey_angles(strip.reader, strip.scan, found, None)
    return _with_decisions(found)


def _with_decisions(found: Survey) -> Survey:
    """The survey with the decisions of the chain that `choose_chain` chooses by it."""
    from wavebatch.surveying.choose_chain import decide

    chosen = decide(found)
    parts = {decision.part for decision in chosen}
    # What the scene needs but no chain has without further files follows the decisions of the chosen chain.
    others = (decision for decision in found.decisions if decision.part not in parts)
    return replace(found, decisions=(*chosen, *others))
