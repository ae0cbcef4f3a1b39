"""One PulseWaves file as a LAS 1.4 strip of point format 9, with what its outgoing pulses say; `wavebatch import`.

Two passes: the first reads everything and learns, the second writes. Memory holds one piece of the file. The strip, its
packets and its system file appear together or not at all.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from wavebatch import __version__
from wavebatch.core.errors import InputError
from wavebatch.core.schema import option
from wavebatch.files.disk.publish import Draft, refuse_existing, reporting
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.las.header import Vlr, read_header
from wavebatch.files.pulsewaves_file import RETURNING, PulseHeader, PulseReader, read_pulse_header
from wavebatch.files.strip.writer import FullwaveWriter
from wavebatch.surveying.outgoing import SYSTEM_SUFFIX, save_outgoing
from wavebatch.surveying.system_file import format_survey
from wavebatch.tools.archives.channels import decode
from wavebatch.tools.archives.first_pass import Outgoing, Plan, make_plan
from wavebatch.tools.archives.frame import Frame, find_frame
from wavebatch.tools.archives.points import Counts, build_points, list_extra_bytes

SUFFIXES = (".pls",)
USER_ID = b"wavebatch_import"
"""User id of the record in a strip that says what it was imported from."""


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """How files are imported."""

    returns: Literal["strongest", "detect"] = option(
        "strongest", "strongest: one point per recorded segment, at its strongest sample; detect: one at each maximum "
        "that stands out of the noise.",
    )  # fmt: skip
    internal: bool = option(
        False, "Store packets in the strip or in a .wdp file beside it.", opposite="external", unset="external"
    )
    overwrite: bool = False
    resume: bool = option(False, "Skip files whose strip is there and up to date.")

    def describe(self) -> dict[str, Any]:
        """Return what changes the strip."""
        return {"internal": self.internal, "returns": self.returns}


@dataclass(frozen=True, slots=True)
class ImportSummary:
    """What was made of a file."""

    file: str
    output: str
    pulses: int
    skipped: bool = False
    """The strip was there already and is up to date."""
    points: int = 0
    packets: int = 0
    descriptors: int = 0
    without_returns: int = 0
    replaced: int = 0
    covered: int = 0
    outgoing: dict[str, float] | None = None
    """Of the outgoing pulses: fwhm_ns, energy_scatter, energy_error, width_scatter (relative), unknown pulses."""
    system_file: str | None = None
    notes: tuple[str, ...] = field(default=())


def import_file(
    path: Path, target: Path, options: ImportOptions, progress: Callable[[int], Any] = lambda pulses: None
) -> ImportSummary:
    """Import a PulseWaves file.

    Parameters
    ----------
    path : Path
        The .pls, with its .wvs beside it.
    target : Path
        The strip to write; its suffix selects LAS or LAZ.
    options : ImportOptions
    progress : callable
        Called with numbers of pulses that were written.

    Returns
    -------
    ImportSummary

    Raises
    ------
    InputError
        Where the file cannot be read to its end, or the strip cannot be written; nothing is left behind.
    """
    header = read_pulse_header(path)
    source = {"file": path.name, **take_fingerprint(path, header.waves)}
    account = {"import": source, "options": options.describe(), "version": __version__}
    state = _find_state(target, account)
    if options.resume and state == "same":
        return ImportSummary(str(path), str(target), header.count, skipped=True)
    # A killed import may have left the packets of a strip that never appeared.
    overwrite = options.overwrite or (options.resume and state != "other")
    refuse_existing(target, overwrite)
    with PulseReader(header) as reader:
        plan, frame = make_plan(reader), find_frame(reader)
        counts = Counts()
        with _open_writer(target, header, plan, frame, options, account, overwrite) as writer:
            system = _draft_system(writer, path, plan, source, overwrite)
            for piece in reader.pieces():
                points = build_points(
                    frame.place(piece), plan, writer, header, counts, detect=options.returns == "detect"
                )
                writer.write_points(points)
                progress(len(piece.pulses))
            writer.commit()
    return ImportSummary(
        str(path), str(target), header.count, points=counts.points, packets=counts.packets,
        descriptors=len({one.index for one in plan.digitizers.values()}), without_returns=counts.without_returns,
        replaced=counts.replaced, covered=counts.covered, outgoing=_describe_outgoing(plan.outgoing, counts),
        system_file=None if system is None else str(system), notes=(*frame.notes, *_note(header, plan, counts)),
    )  # fmt: skip


def _find_state(target: Path, account: dict[str, Any]) -> str:
    """`same`: the strip of this import is there; `mine`: that of another import, or none; `other`: another file."""
    if not target.exists():
        return "mine"
    try:
        records = [vlr for vlr in read_header(target).vlrs if vlr.user_id.rstrip(b"\0") == USER_ID]
        found = json.loads(records[0].payload) if records else None
    except (InputError, ValueError):
        return "other"
    if found is None:
        return "other"
    return "same" if found == account else "mine"


def _open_writer(
    target: Path, header: PulseHeader, plan: Plan, frame: Frame, options: ImportOptions, account: dict, overwrite: bool
) -> FullwaveWriter:
    by_index = {one.index: one for one in plan.digitizers.values()}
    digitizers = [by_index[index] for index in sorted(by_index)]
    record = Vlr(USER_ID, 1, json.dumps(account, sort_keys=True).encode(), b"what the strip was imported from")
    return FullwaveWriter(
        target, point_format=9, internal=options.internal, digitizers=digitizers,
        scales=frame.scales, offsets=frame.offsets, wkt=frame.wkt, extra_bytes=list_extra_bytes(plan),
        records=(*frame.records, record), overwrite=overwrite, week=plan.week, system=header.system,
        source=header.source & 0xFFFF,
    )  # fmt: skip


def _draft_system(
    writer: FullwaveWriter, path: Path, plan: Plan, source: dict[str, Any], overwrite: bool
) -> Path | None:
    """Puts the system file beside the strip, where the outgoing pulses have a shape; returns its name."""
    sent = plan.outgoing
    if sent is None or sent.shape is None:
        return None
    channel, bits, spacing, _ = decode(sent.kind)
    saved = save_outgoing(
        sent.shape, sent.reference, spacing, bits, path.name, source,
        same_receiver=channel == plan.primary, energy_scatter=sent.scatter, energy_error=sent.error,
        width_scatter=sent.width_scatter,
    )  # fmt: skip
    draft = Draft(writer.target.with_suffix(SYSTEM_SUFFIX), overwrite=overwrite)
    writer.drafts.insert(0, draft)
    with reporting(draft.target):
        draft.file.write(format_survey(saved).encode())
    return draft.target


def _describe_outgoing(sent: Outgoing | None, counts: Counts) -> dict[str, float] | None:
    if sent is None:
        return None
    return {
        "fwhm_ns": float("nan") if sent.shape is None else sent.shape.fwhm,
        "energy_scatter": sent.scatter,
        "energy_error": sent.error,
        "width_scatter": sent.width_scatter,
        "unknown": counts.unknown_energy,
    }


def _note(header: PulseHeader, plan: Plan, counts: Counts) -> list[str]:
    notes = []
    if plan.one_time:
        notes.append("all pulses have the same time; they get times 0.1 ms apart")
    if plan.unknown:
        names = ", ".join(map(str, plan.unknown))
        notes.append(f"channel {names}: its gain over channel {plan.primary} is unknown; all of its segments are kept")
    for channel, ratio in plan.ratios.items():
        notes.append(
            f"channel {channel} is {ratio:.2f} times less sensitive than channel {plan.primary}: its counts are "
            f"multiplied by that, and it stands for {counts.replaced} segments that saturate channel {plan.primary}"
        )
    if counts.without_returns:
        notes.append(f"{counts.without_returns} pulses have no returning segment, and so no point")
    kinds = {s.kind for one in header.descriptors.values() for s in one.samplings}
    if plan.outgoing is None and kinds - {RETURNING}:
        notes.append("its recordings of outgoing pulses show no pulse")
    return notes
