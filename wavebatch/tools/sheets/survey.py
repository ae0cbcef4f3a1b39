"""What a survey found, as a sheet: `wavebatch survey` prints it, and it is on the pages of `survey` and `run`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from wavebatch.core.units import FWHM_PER_SIGMA, count, format_measure
from wavebatch.surveying import Survey
from wavebatch.surveying.systems.shown import name_model
from wavebatch.tools.sheets.sheet import Cell, Code, Fact, Later, Note, Part, Picture, Sheet, Table, list_facts

NOISE_KINDS = {
    "quiet": "quiet samples",
    "quiet_pulse": "quiet samples, as a pulse sees it",
    "outside": "outside of echoes",
    "outside_pulse": "outside, as a pulse sees it",
    "core": "left by fits in strong echoes",
    "weak_echoes": "left by fits in weak echoes",
}
"""Names of the ways in which noise is measured; as a pulse sees it: noise of its amplitude, as that of one sample."""

MOST_DRAWN = 6
"""Strips of a flight whose waveforms are on a page."""


def survey_sheet(survey: Survey, document: Mapping[str, Any]) -> Sheet:
    """The sheet of a survey; document: what `survey --json` prints, or its `decisions` alone for the page of a run."""
    rows = [["needed" if one["needed"] else "left out", one["part"], one["reason"]] for one in document["decisions"]]
    decisions = Table(("decisions", "part of the chain", "reason"), rows)
    chosen = [decisions] if rows else [Note("The survey did not choose the chain: the user gave it.")]
    facts = [*_list_strip(survey, document), *_list_noise(survey), *_list_pulse(survey, document), *_list_scene(survey)]
    return Sheet("Survey", [*facts, Later(partial(_draw, survey)), Sheet("Decisions", chosen)])


def list_doubts(document: Mapping[str, Any]) -> list[Note]:
    """What is doubtful, also of single strips of a flight."""
    strips = [f"{strip['strip']}: {one['text']}" for strip in document.get("strips", ()) for one in strip["warnings"]]
    return [Note(words, "warning") for words in (*strips, *(one["text"] for one in document["warnings"]))]


def _list_strip(survey: Survey, document: Mapping[str, Any]) -> Iterator[Part]:
    figures = survey.figures
    if "points" in document:
        size = f"{count(document['points'], 'point')}, {count(document['packets'], 'packet')}"
        strips = document.get("strips")
        if strips is None:
            yield Fact("strip", f"{document['strip']}: {size}")
        else:
            yield Fact("strips", f"{sum(one['fits'] for one in strips)} of {len(strips)} belong together: {size}")
            odd = [f"{one['strip']}: does not belong to them: {one['reason']}" for one in strips if not one["fits"]]
            yield from (Note(f"  {words}") for words in odd)
    yield Fact("surveyed", count(survey.waveforms, "waveform") if survey.waveforms else "not known")
    if figures.samples:
        yield Fact("samples", figures.samples)
    if figures.least_count is not None and figures.largest_count is not None:
        yield Fact("ADC range", f"counts {round(figures.least_count)} to {round(figures.largest_count)}")
    if "direction" in document:
        yield Fact("vectors", f"{document['direction']['sign']} the sensor: {document['direction']['evidence']}")


def _list_noise(survey: Survey) -> Iterator[Part]:
    noise, strong = survey.system.noise, survey.figures.amplitude_99
    yield Fact("baseline", f"{noise.baseline:.3f} DN, +-{noise.baseline_spread:.3f} DN between waveforms")
    yield Fact("noise", f"{noise.std:.3f} DN for thresholds and errors" + (", chosen from" if noise.by_kind else ""))
    for kind, value in noise.by_kind.items():
        known = f"{value:.3f} DN" if value > 0 else "not known: too few samples"
        yield Fact(f"  {NOISE_KINDS.get(kind, kind.replace('_', ' '))}", known)
    grown = "" if strong is None else f", {noise.gain * strong:.2f} DN2 at {strong:.0f} DN"
    yield Fact("signal noise", f"variance grows by {noise.gain:.4f} DN2 per DN{grown}" if noise.gain > 0 else "none")


def _list_pulse(survey: Survey, document: Mapping[str, Any]) -> Iterator[Part]:
    system, figures = survey.system, survey.figures
    width = f"s_ref {system.sigma_ref:.4f} ns, full width at half maximum {system.sigma_ref * FWHM_PER_SIGMA:.3f} ns"
    yield Fact("system pulse", f"{name_model(system)}; {width}")
    yield Table(("Gaussians: weight", "delay ns", "sigma ns"), system.components, (".4f", ".3f", ".3f"))
    if figures.sent_fwhm_ns is not None:
        width = f"full width at half maximum {figures.sent_fwhm_ns:.3f} ns, as import found it"
        yield Fact("outgoing pulses", width)
    like = document.get("looks_like")
    if like is not None:
        taken = f"{like['sensor']}: its shipped pulse is used"
        yield Fact("sensor", taken if like["taken"] else like["sentence"])
    heads = ("pulses tried", "nats per waveform", "full width ns", "change", "echoes each", "longer by errors")
    rows = [(one.name, one.nats, one.fwhm_ns, one.change, one.echoes_per_waveform,
             Cell("chosen" if one.chosen else f"{one.longer_by:.1f}", one.longer_by)) for one in survey.candidates]
    # The fewest nats describe a waveform best; the change is that of the pulse from shot to shot.
    yield Table(heads, rows, ("", ".2f", ".3f", ".1%", ".3f", ""))
    if figures.false_in_noise_share is not None:
        shares = figures.false_in_noise_share, figures.false_by_misfit_share
        noise, misfit = (f"{100 * share:.2g}" for share in shares)
        words = f"of 100 echoes about {noise} noise (in quiet); beside 100 strong ones about {misfit} of misfit"
        yield Fact("false echoes", words)
    yield Fact("kappa", f"{figures.kappa:z.4f}" if figures.kappa is not None else "not known")
    yield Fact("ringing", f"{100 * system.ringing:.2f} % of the amplitude at most")
    yield Fact("acceptance", f"one more echo must lower chi2 by {system.acceptance:g}")
    if system.misfit:
        yield Fact("misfit", f"{100 * system.misfit:.2g} % of the amplitude; residuals below it add no echo")
    if figures.divergence_seen_mrad is not None:
        seen = format_measure(figures.divergence_seen_mrad, figures.divergence_seen_error_mrad)
        words = "mrad by the widths of echoes over the slopes of their surfaces, if these are plane"
        yield Fact("beam", f"{seen} {words}")
    for index, one in system.digitizers.items():
        noise = f"baseline {one.noise.baseline:.3f} DN, noise {one.noise.std:.3f} DN"
        yield Fact(f"digitizer {index}", f"{noise}; {name_model(one)}; s_ref {one.sigma_ref:.4f} ns")


def _list_scene(survey: Survey) -> Iterator[Part]:
    """Saturation, and what the waveforms hold; figures that an old file lacks are left out."""
    system, figures = survey.system, survey.figures
    clipped = "none found"
    if system.saturation is not None:
        share = figures.saturated_share
        often = "" if share is None else f", in {100 * share:.2f} % of the waveforms"
        clipped = f"at {system.saturation:.0f} DN{often}"
    yield Fact("saturation", clipped)
    kinds = {"empty": figures.empty_share, "single": figures.single_share, "overlapped": figures.overlapped_share}
    shares = [f"{100 * share:.2f} % {kind}" for kind, share in kinds.items() if share is not None]
    if shares and figures.echoes_per_waveform is not None:
        yield Fact("waveforms", f"{', '.join(shares)}; {figures.echoes_per_waveform:.3f} echoes each")
    yield from list_facts(figures)
    if figures.system_width_share is not None:
        share = 100 * figures.system_width_share
        yield Fact("widths", f"{share:.1f} % of the clear echoes have the width of the system pulse")


def _draw(survey: Survey) -> Iterator[Picture]:
    """The pulses, and what the waveforms hold."""
    from wavebatch.tools.plots.charts import chart_pulse, draw_counts

    system, found, spacing = survey.system, survey.figures, survey.figures.spacing_ns or 1.0
    yield from chart_pulse(system, spacing)
    for index, one in system.digitizers.items():
        yield from chart_pulse(one, spacing, f"Pulse of digitizer {index}")
    shares = {"empty": found.empty_share, "single": found.single_share, "overlapped": found.overlapped_share}
    if None not in shares.values():
        counts = {name: round(value * survey.waveforms) for name, value in shares.items()}
        counts["several apart"] = survey.waveforms - sum(counts.values())
        yield from draw_counts(counts, title="Waveforms of the survey", label="echoes in them")


def write_survey_page(
    target: Path, survey: Survey, document: Mapping[str, Any], strips: Sequence[Path], **reading: Any
) -> None:
    """Write the page of a survey.

    document: as `survey --json` prints it. strips: those that were surveyed. reading: direction and headerless.
    """
    from wavebatch.tools.sheets.page import write_page

    title = f"wavebatch survey: {strips[0].name if len(strips) == 1 else f'{len(strips)} strips'}"
    write_page(target, title, _page_parts(survey, document, strips, reading))


def _page_parts(
    survey: Survey, document: Mapping[str, Any], strips: Sequence[Path], reading: Mapping[str, Any]
) -> Iterator[Part]:
    from wavebatch.surveying.auto_chain import choose_chain
    from wavebatch.tools.plots.charts import draw_waveforms

    yield from list_doubts(document)
    if "strips" in document:
        rows = [[one["strip"], "belongs to the others" if one["fits"] else "does not belong to them",
                 one.get("reason") or ""] for one in document["strips"]]  # fmt: skip
        failed = [Note(f"{path}: cannot be surveyed", "warning") for path in document["failed"]]
        yield Sheet("Strips", [Table(("strip", "", "reason"), rows, sortable=True), *failed])
    yield survey_sheet(survey, document)
    chain = choose_chain(survey)
    for strip in strips[:MOST_DRAWN]:
        draw = partial(draw_waveforms, strip, chain, survey.system, chain.name, **reading)
        yield Sheet(strip.name, [Later(draw, "waveforms")])
    if len(strips) > MOST_DRAWN:
        yield Note(f"Waveforms of the first {MOST_DRAWN} of {len(strips)} strips are drawn.")
    paths = (Fact(f"strip {n + 1}", path) for n, path in enumerate(strips))
    chain_text = Sheet("Chain that the strip needs", [Code(document["chain"])])
    yield Sheet("Provenance", [Fact("wavebatch", document["version"]), *paths, chain_text])
