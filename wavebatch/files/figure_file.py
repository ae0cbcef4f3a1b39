"""Pictures drawn with matplotlib (optional extra `plot`): one style, and equal bytes for equal figures.

All plots are written through `open_picture`; pages hold the SVG of `open_svg`. matplotlib is imported only when a
picture is drawn, because it takes longer to import than many commands take to run.

Texts that fit are shortened to the room that they have: measured with the renderer, not estimated from the number of
letters.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import io
import logging
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavebatch.core.errors import ConfigError, advise_install
from wavebatch.files.disk.publish import Draft, check_target, reporting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": "wavebatch"},
    ".svg": {"Creator": "wavebatch", "Date": None},
    ".pdf": {"Creator": "wavebatch", "Producer": None, "CreationDate": None},
}
"""Metadata of each kind of picture: no dates and no versions, so that equal figures give equal bytes."""

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
    # A dollar sign in a file name must not start a formula.
    "text.parse_math": False,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
}


def check_picture(target: Path, *, overwrite: bool) -> None:
    """Raise ConfigError for an unknown suffix or if matplotlib is missing, InputError if the file exists."""
    if target.suffix.lower() not in _METADATA:
        raise ConfigError(f"{target}: unknown kind of picture; use {', '.join(_METADATA)}")
    if not has_matplotlib():
        raise ConfigError(f"{target}: pictures need matplotlib: {advise_install('matplotlib')}")
    check_target(target, overwrite=overwrite)


@contextlib.contextmanager
def open_picture(
    target: Path, size: tuple[float, float], *, overwrite: bool = False, dpi: float = 150
) -> Iterator[Figure]:
    """Give a figure of `size` inches to the `with` block and write it to `target` at the end of the block.

    The suffix selects the kind of picture. The user's matplotlibrc, screen and clock have no effect.
    Raises as `check_picture` does, and InputError if the file cannot be written.
    """
    check_picture(target, overwrite=overwrite)
    with _style(str(target)):
        figure = _new_figure(size, dpi)
        set_layout(figure, w_pad=0.1, h_pad=0.08)
        yield figure
        suffix = target.suffix.lower()
        with Draft(target, overwrite=overwrite) as draft:
            with reporting(target):
                figure.savefig(draft.file, format=suffix[1:], metadata=_METADATA[suffix])
            draft.publish()


def set_layout(figure: Figure, **options: Any) -> None:
    """Let matplotlib's constrained layout place the axes, at places that are the same in each run.

    options: of ConstrainedLayoutEngine. Its solver goes by addresses in memory: places of two runs differ in their last
    digits, and so would the ids of clip paths in an SVG. They are rounded to a millionth of the figure.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    class Layout(ConstrainedLayoutEngine):
        def execute(self, fig: Figure) -> Any:
            """Places the axes."""
            found = super().execute(fig)
            every: Any = fig.axes
            for axes in every:
                for which in ("original", "active"):
                    bounds = axes.get_position(original=which == "original").bounds
                    axes._set_position([round(value, 6) for value in bounds], which=which)
            return found

    figure.set_layout_engine(Layout(**options))


@contextlib.contextmanager
def open_svg(size: tuple[float, float]) -> Iterator[tuple[Figure, list[str]]]:
    """Give a figure of `size` inches and a list to the `with` block, which gets the SVG at the end of the block.

    For the many pictures inside of pages: no layout is computed, and places have a tenth of a point.
    """
    with _style("the page", {"font.sans-serif": ["DejaVu Sans", "Verdana"]}):
        figure, drawn = _new_figure(size, 72), list[str]()
        yield figure, drawn
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
        text = buffer.getvalue()
        text = text[text.index("<svg") :].replace("\n", " ")
        # Places stand in attributes; labels of ticks keep their digits.
        drawn.append(_ATTRIBUTE.sub(lambda found: _FINE.sub(r"\1", found[0]), text))


def has_matplotlib() -> bool:
    """Return whether pictures can be drawn (extra `plot`)."""
    return importlib.util.find_spec("matplotlib") is not None


_ATTRIBUTE, _FINE = re.compile(r'="[^"]*"'), re.compile(r"(\d+\.\d)\d+")


@contextlib.contextmanager
def _style(target: str, more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """matplotlib with our settings, and some more."""
    # Without a home folder (cron) matplotlib would write about its cache on stderr.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        import matplotlib
        import matplotlib.backends.backend_agg  # also where a half of an installation is missing
    except ImportError as error:
        raise ConfigError(f"{target}: matplotlib cannot be imported; install it again: {error}") from error
    with matplotlib.rc_context(), warnings.catch_warnings():
        style: Any = matplotlib.rcParams
        dict.update(style, _read_style())  # checked once: a page has many pictures
        style.update(more or {})
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


@functools.cache
def _read_style() -> Any:
    """All settings that change the look of a figure."""
    import matplotlib

    kept = {name: value for name, value in matplotlib.rcParamsDefault.items() if name not in _UNTOUCHED}
    return matplotlib.RcParams({**kept, **_STYLE})


def _new_figure(size: tuple[float, float], dpi: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


_UNTOUCHED = ("backend", "backend_fallback", "interactive", "toolbar", "timezone", "webagg.port")
"""Settings of matplotlib that do not change the look of a figure; setting them would touch the user's backend."""


def plain_text(text: str, most: int = 80) -> str:
    """Return text from a file for use in a picture: printable, on one line, shortened in the middle to `most`."""
    text = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    if len(text) <= most:
        return text
    head = (most - 3) // 2
    return f"{text[:head]}...{text[len(text) - (most - 3 - head):]}"


_LEAST_LETTERS = 8
"""Texts are not shortened below this."""


def text_width(figure: Figure, text: str, size: float, weight: str = "normal") -> float:
    """Width of a line of text [inches]; size: of the font [points]."""
    from matplotlib.font_manager import FontProperties

    font = FontProperties(size=size, weight=weight)
    canvas: Any = figure.canvas
    return canvas.get_renderer().get_text_width_height_descent(text, font, False)[0] / figure.dpi


def fit_text(figure: Figure, text: str, inches: float, *, size: float, weight: str = "normal") -> str:
    """The text, with lines that are too long for the room shortened in the middle."""
    lines = []
    for line in text.split("\n"):
        if text_width(figure, line, size, weight) <= inches:
            lines.append(line)
            continue
        low, high = _LEAST_LETTERS, max(len(line), _LEAST_LETTERS + 1)
        while high - low > 1:
            most = (low + high) // 2
            fits = text_width(figure, plain_text(line, most), size, weight) <= inches
            low, high = (most, high) if fits else (low, most)
        lines.append(plain_text(line, low))
    return "\n".join(lines)


def fit_parts(figure: Figure, parts: Sequence[str], inches: float, *, size: float, weight: str = "normal") -> str:
    """Parts of a title on as few lines as they need; a part that is longer than a line is shortened."""
    lines: list[str] = []
    for part in parts:
        joined = f"{lines[-1]}   {part}" if lines else part
        if lines and text_width(figure, joined, size, weight) <= inches:
            lines[-1] = joined
        else:
            lines.append(fit_text(figure, part, inches, size=size, weight=weight))
    return "\n".join(lines)


def set_head(figure: Figure, parts: Sequence[str], *, size: float = 10.0, **look: Any) -> None:
    """Writes the parts of a title above all panels, to the left, as wide as the figure."""
    text = fit_parts(figure, parts, figure.get_figwidth() - 0.2, size=size, **look)
    figure.suptitle(text, x=0.01, ha="left", fontsize=size, **look)


def space_ticks(axis: Any, length: float, each: float) -> None:
    """Places as many ticks as fit, or two, or one; length: of the axis, each: room of a tick [inches]."""
    if length >= 2 * each:
        axis.get_major_locator().set_params(nbins=int(min(length / each, 8)))
    else:
        low, high = axis.get_view_interval()
        axis.set_ticks(_round_places(low, high, 2 if length >= each else 1))
    axis.set_major_formatter(lambda value, _: f"{value:.10g}")


def _round_places(low: float, high: float, most: int) -> list[float]:
    """One or two round numbers between the ends of an axis that is too short for more."""
    if not high > low:
        return [low]
    room = 0.8 * (high - low)
    power = 10.0 ** math.floor(math.log10(room))
    step = max(factor * power for factor in (1, 2, 5) if factor * power <= room)
    places = [step * number for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    if most == 1 or len(places) < 2:
        return [min(places, key=lambda place: abs(place - 0.5 * (low + high)))]
    return [places[0], places[-1]]
