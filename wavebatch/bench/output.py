"""The files of a benchmark: JSON, text and plots."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wavebatch.bench.plot import can_plot, plot_scene
from wavebatch.files.disk.publish import reporting


def write_outputs(document: Mapping[str, Any], text: str, folder: Path) -> list[str]:
    """Writes bench.json, bench.txt and a PNG per scene, replacing old ones; returns what to tell.

    Without matplotlib there are no plots, and a line says how to get them. Raises InputError where it cannot write.
    """
    with reporting(folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "bench.json").write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", "utf-8")
        (folder / "bench.txt").write_text(text + "\n", "utf-8")
        written = ["bench.json", "bench.txt"]
        if can_plot():
            for section in document["scenes"]:
                name = f"bench-{Path(section['scene']).stem}.png"
                plot_scene(section, folder / name)
                written.append(name)
    lines = [f"{folder}: {', '.join(written)}"]
    if not can_plot():
        lines.append("no plot without matplotlib: pip install 'wavebatch[plot]'")
    return lines
