"""Picture files: matplotlib (extra `plot`) asked for late, the house style, the same bytes for the same figure."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import Draft, refuse_existing, reporting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": "wavebatch"},
    ".svg": {"Creator": "wavebatch", "Date": None},
    ".pdf": {"Creator": "wavebatch", "Producer": None, "CreationDate": None},
}
"""Per kind of picture what stands in it about its making: no dates, no versions."""

_STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.labelsize": 9.5,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "font.size": 9.5,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "wavebatch",
    # A dollar sign in a file's name starts no formula.
    "text.parse_math": False,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
}


def check_picture(target: Path, *, overwrite: bool) -> None:
    """Raises ConfigError where `target` is no kind of picture or matplotlib is missing, InputError where it exists."""
    if target.suffix.lower() not in _METADATA:
        raise ConfigError(f"{target}: pictures are written as {', '.join(_METADATA)}; name one of these")
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(f"{target}: pictures need matplotlib: pip install 'wavebatch[plot]'")
    if not overwrite:
        refuse_existing(target)


@contextlib.contextmanager
def open_picture(
    target: Path, size: tuple[float, float], *, overwrite: bool = False, dpi: float = 150
) -> Iterator[Figure]:
    """A figure of `size` inches; what is drawn in the `with` block is written to `target` and published at its end.

    The suffix says which kind. The bytes depend on what is drawn, not on the user's matplotlibrc, screen or clock.
    Raises as `check_picture` does, and InputError where the file cannot be written.
    """
    check_picture(target, overwrite=overwrite)
    # In cron, with no home to write to, matplotlib would talk about its cache on stderr.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(f"{target}: matplotlib cannot be imported, install it anew: {error}") from error

    kept = {name: value for name, value in matplotlib.rcParamsDefault.items() if name not in _UNTOUCHED}
    with matplotlib.rc_context({**kept, **_STYLE}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        figure = Figure(figsize=size, dpi=dpi, layout="constrained")
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(w_pad=0.1, h_pad=0.08)
        yield figure
        _save(figure, target, overwrite)


_UNTOUCHED = ("backend", "backend_fallback", "interactive", "toolbar", "timezone", "webagg.port")
"""Settings of matplotlib that are not of a figure's looks."""


def _save(figure: Figure, target: Path, overwrite: bool) -> None:
    suffix = target.suffix.lower()
    draft = Draft(target, overwrite=overwrite)
    try:
        with reporting(target):
            figure.savefig(draft.file, format=suffix[1:], metadata=_METADATA[suffix])
        draft.publish()
    finally:
        draft.discard()


def plain_text(text: str, most: int = 80) -> str:
    """Text from a file for a picture: printable, on one line, its middle left out where it is longer than `most`."""
    text = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    if len(text) <= most:
        return text
    head = (most - 3) // 2
    return f"{text[:head]}...{text[len(text) - (most - 3 - head):]}"
