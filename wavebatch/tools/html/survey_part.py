"""What a survey found, as sections of a page: figures, pulse, noise, decisions. For the pages of `survey` and `run`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.files.toml_file import format_toml
from wavebatch.surveying import Survey
from wavebatch.surveying.system_file import SYSTEM_SCHEMA, parse_survey
from wavebatch.tools.html.charts import chart_pulse, draw_counts, figures
from wavebatch.tools.html.markup import facts, paragraph, significant, table


def read_survey(strip: Mapping[str, Any]) -> Survey:
    """The survey of a report's `strip`, each number to the last bit."""
    system, survey = strip["system"], strip["survey"]
    found = {"waveforms": survey["waveforms"], "figures": survey["figures"]}
    return parse_survey(format_toml({"schema": SYSTEM_SCHEMA, "system": system, **found}), "report").survey


def draw_survey(survey: Survey) -> str:
    """Figures, pulses and shares of a survey."""
    system, found, waveforms = survey.system, survey.figures, survey.waveforms
    spacing = found.spacing_ns or 1.0
    pulses = [chart_pulse(system, spacing)]
    pulses += [chart_pulse(one, spacing, f"Pulse of digitizer {index}") for index, one in system.digitizers.items()]
    shares = {"empty": found.empty_share, "single": found.single_share, "overlapped": found.overlapped_share}
    if None not in shares.values():
        counts = {name: round(value * waveforms) for name, value in shares.items()}
        counts["several apart"] = waveforms - sum(counts.values())
        pulses.append(draw_counts(counts, title="Waveforms of the survey", label="echoes in them"))
    components = [list(map(significant, component)) for component in system.components]
    learned = table(["weight", "delay ns", "sigma ns"], components, caption="Gaussians of the learned pulse")
    rows = [(one.name, significant(one.fwhm_ns, 4), f"{100 * one.change:.1f} %", significant(one.nats, 5),
             significant(one.echoes_per_waveform, 4), "chosen" if one.chosen else f"{one.longer_by:.1f}")
            for one in survey.candidates]  # fmt: skip
    names = ["pulse", "full width ns", "change from shot to shot", "nats per waveform", "echoes", "longer by, errors"]
    tried = table(names, rows, caption="Pulses that were tried: the fewest nats describe a waveform best")
    return "\n".join(
        [facts(_list_figures(survey)), figures(pulses), learned if components else "",
         tried if rows else ""]
    )  # fmt: skip


def _list_figures(survey: Survey) -> Iterable[tuple[str, str]]:
    system, found = survey.system, survey.figures
    yield "surveyed", f"{survey.waveforms:,} waveforms" if survey.waveforms else "not known"
    if found.samples:
        yield "samples", found.samples
    yield "baseline", f"{system.noise.baseline:.3f} \u00b1 {system.noise.baseline_spread:.3f} DN between waveforms"
    yield "noise", f"{system.noise.std:.3f} DN"
    gain = system.noise.gain
    yield "signal noise", f"variance grows by {gain:.4f} DN2 per DN" if gain > 0 else "none"
    width = system.sigma_ref * FWHM_PER_SIGMA
    model = f"learned, {len(system.components)} Gaussians" if system.components else "Gaussian"
    if not system.components and system.kappa:
        model = f"skewed, kappa {system.kappa:.4f}"
    yield "system pulse", f"{model}; full width at half maximum {width:.3f} ns"
    yield "ringing", f"{100 * system.ringing:.2f} % of the amplitude at most"
    yield "acceptance", f"one more echo must lower chi2 by {system.acceptance:g}"
    level = system.saturation
    yield "saturation", "none found" if level is None else f"at {level:.0f} DN"
    if found.echoes_per_waveform is not None:
        yield "echoes per waveform", f"{found.echoes_per_waveform:.3f}"
    if found.amplitude_99 is not None:
        yield "amplitudes", f"99 % below {found.amplitude_99:.1f} DN"


def list_decisions(decisions: Iterable[Mapping[str, Any]]) -> str:
    """A row per part of a chain: needed or left out, and why."""
    rows = [["needed" if one["needed"] else "left out", one["part"], one["reason"]] for one in decisions]
    if not rows:
        return paragraph("The survey did not choose the chain: the user gave it.")
    return table(["", "part of the chain", "reason"], rows)
