"""A strip as users see it from Python: headers, waveforms block by block, its survey, and the chain that it needs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from wavebatch.core.errors import ConfigError, InputError, nearest
from wavebatch.core.waveforms import Digitizer, WaveformBlock
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.strip.packets import StripFacts
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.scanner import StripScan
from wavebatch.stages import chain_file
from wavebatch.stages.chain import Chain
from wavebatch.surveying.choose_chain import choose_chain, decide, read_sample
from wavebatch.surveying.flat_ground import survey_angles
from wavebatch.surveying.systems.saved_check import with_look
from wavebatch.surveying.systems.survey_result import Survey

AUTO = "auto"
"""In place of a chain's name: the survey of each strip chooses the chain."""


def load_chain(name: Path | str) -> Chain:
    """Load a shipped chain by its name, or a chain file by its path.

    Parameters
    ----------
    name : path or str
        "fast", "balanced", "accurate" or another shipped chain, or the path of a TOML file. Text without a folder and
        a suffix is a name.

    Returns
    -------
    Chain
        The checked chain. `chain.run(block, system)` gives the echoes of a block.

    Raises
    ------
    ConfigError
        Where there is no such chain or it is wrong; names file, table, key and the nearest known word.
    """
    known = chain_file.list_profiles()
    if isinstance(name, Path) or Path(name).name != name or Path(name).suffix:
        return chain_file.load_chain_file(name)
    if name not in known:
        raise ConfigError(f"profile {name!r} does not exist; {nearest(name, [AUTO, *known])}")
    return chain_file.load_profile(name)


def auto_chain(survey: Survey) -> Chain:
    """Choose the cheapest chain that loses nothing on the surveyed strip.

    Parameters
    ----------
    survey : Survey
        Result of `survey`; its `decisions` give the reason for every part that is left out.

    Returns
    -------
    Chain
        The chain that `run` would choose for this strip.
    """
    return choose_chain(survey)


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
        """
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
    strip: Strip | Path | str,
    *,
    waveforms: int | None = None,
    divergence: float | None = None,
    find_divergence: bool = False,
) -> Survey:
    """Measure sensor and scene on a sample of the strip: noise, system pulse, saturation, overlapping echoes.

    Parameters
    ----------
    strip : Strip, path or str
        The strip, opened with `open_strip`, or its path.
    waveforms : int, optional
        Waveforms to look at, spread over the strip; 8192 by default, fewer where they are long.
    divergence : float, optional
        Full angle of the beam between the 1/e^2 points [mrad]. With it the survey also says whether echo widths tell
        incidence angles.
    find_divergence : bool
        Also look for the beam's divergence in the widths of echoes from surfaces of known slope: the figures
        `divergence_seen_mrad` and `divergence_seen_error_mrad`, where they tell.

    Returns
    -------
    Survey
        `.system` is the SystemPulse for `Chain.run`; `.decisions` say which parts of a chain the strip needs, and why.

    Raises
    ------
    InputError
        Where the strip cannot be read or holds no waveform.
    """
    from wavebatch.surveying.outgoing import compare_outgoing  # a run with a saved system needs neither
    from wavebatch.surveying.survey import survey_blocks

    if not isinstance(strip, Strip):
        with open_strip(strip) as opened:
            return survey(opened, waveforms=waveforms, divergence=divergence, find_divergence=find_divergence)
    sample = read_sample(strip.reader, strip.scan, waveforms)
    if not sample:
        path = strip.facts.path
        raise InputError(f"{path}: holds no waveform to be surveyed; `wavebatch check` says what it holds")
    found = with_look(compare_outgoing(survey_blocks(sample), strip.facts.path), sample)
    if divergence is not None:
        found = survey_angles(strip.reader, strip.scan, found, divergence)
    elif find_divergence:
        with contextlib.suppress(InputError):  # coordinates that are not in metres
            found = survey_angles(strip.reader, strip.scan, found, None)
    chosen = decide(found)
    parts = {decision.part for decision in chosen}
    # What the scene needs but no chain has without further files follows the decisions of the chosen chain.
    others = (decision for decision in found.decisions if decision.part not in parts)
    return replace(found, decisions=(*chosen, *others))
