"""The last lines of `make demo`: what was found, where it is, and what to do next."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path


def main(folder: Path) -> None:
    """Prints three lines; draws a waveform if matplotlib is installed."""
    found = json.loads((folder / "compare.json").read_text("utf-8"))
    look = f"Open {folder}/out/forest.laz in CloudCompare or QGIS and colour it by amplitude or echo_width"
    if importlib.util.find_spec("matplotlib"):
        picture = folder / "waveform.png"
        command = [sys.executable, "-m", "wavebatch", "plot", "waveform", folder / "forest.laz", "-o", picture]
        subprocess.run([*command, "--random", "1", "--seed", "4", "--overwrite", "--quiet"], check=True)
        look += f"; {picture} shows one waveform with its echoes"
    print(
        f"\nIn a simulated forest wavebatch found {found['completeness']:.0%} of the true echoes, and "
        f"{found['correctness']:.0%} of what it found is true (most missed echoes are too close to another one).\n"
        f"{look}.\n"
        "Next, with a strip of yours: wavebatch run STRIP.las -o clouds --html clouds.html    (docs/index.md is a tour)"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
