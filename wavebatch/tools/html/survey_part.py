"""What a survey found, as sections of a page: figures, pulse, noise, decisions. For the pages of `survey` and `run`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.toml_file import format_toml
from wavebatch.surveying.system_file import SYSTEM_SCHEMA, parse_survey
from wavebatch.tools.html.charts import draw_counts, draw_pulse, figures
from wavebatch.tools.html.markup import facts, paragraph, significant, table


def read_system(described: Mapping[str, Any], figures: Mapping[str, float]) -> SystemPulse:
    """The pulse of a report's `system`, each number to the last bit."""
    document = {"schema": SYSTEM_SCHEMA, "version": "", "waveforms": 0, "system": dict(described)}
    return parse_survey(format_toml({**document, "figures": dict(figures)}), "report").survey.system


def draw_survey(system: SystemPulse, found: Mapping[str, float], waveforms: int) -> str:
    """Figures, pulses and shares of a survey."""
    spacing = found.get("spacing_ns", 1.0)
    pulses = [draw_pulse(system, spacing)]
    pulses += [draw_pulse(one, spacing, f"Pulse of digitizer {index}") for index, one in system.digitizers.items()]
    shares = [(name, found.get(f"{name}_share")) for name in ("empty", "single", "overlapped")]
    if all(value is not None for _, value in shares):
        counts = {name: round(float(value or 0) * waveforms) for name, value in shares}
        counts["several apart"] = waveforms - sum(counts.values())
        pulses.append(draw_counts(counts, title="Waveforms of the survey", label="echoes in them"))
    components = [list(map(significant, component)) for component in system.components]
    learned = table(["weight", "delay ns", "sigma ns"], components, caption="Gaussians of the learned pulse")
    misfits = [(_name_model(name.removeprefix("misfit_")), significant(value, 3))
               for name, value in sorted(found.items()) if name.startswith("misfit_")]  # fmt: skip
    tried = table(["pulse model", "misfit, share of the amplitude"], misfits, caption="Models that were tried")
    return "\n".join(
        [facts(_list_figures(system, found, waveforms)), figures(pulses), learned if components else "",
         tried if misfits else ""]
    )  # fmt: skip


def _list_figures(system: SystemPulse, found: Mapping[str, float], waveforms: int) -> Iterable[tuple[str, str]]:
    yield "surveyed", f"{waveforms:,} waveforms" if waveforms else "not known"
    if {"n_samples", "bits", "spacing_ns"} <= found.keys():
        yield "samples", f"{found['n_samples']:.0f} of {found['bits']:.0f} bits, {found['spacing_ns']:g} ns apart"
    yield "baseline", f"{system.baseline:.3f} \u00b1 {system.baseline_spread:.3f} DN between waveforms"
    yield "noise", f"{system.noise_std:.3f} DN"
    gain = system.noise_gain
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
    if "echoes_per_waveform" in found:
        yield "echoes per waveform", f"{found['echoes_per_waveform']:.3f}"
    if "amplitude_99" in found:
        yield "amplitudes", f"99 % below {found['amplitude_99']:.1f} DN"


def list_decisions(decisions: Iterable[Mapping[str, Any]]) -> str:
    """A row per part of a chain: needed or left out, and why."""
    rows = [["needed" if one["needed"] else "left out", one["part"], one["reason"]] for one in decisions]
    if not rows:
        return paragraph("The survey did not choose the chain: the user gave it.")
    return table(["", "part of the chain", "reason"], rows)


def _name_model(key: str) -> str:
    """A pulse model in words, from its key in the figures of a survey."""
    words = key.replace("_", " ").replace("gaussian", "Gaussian")
    return "1 Gaussian" if words == "1 Gaussians" else words
