"""Texts of pictures that fit: shortened to the room that they have, and labels that cover nothing.

All modules that draw use it. Texts are measured with the renderer, not estimated from the number of letters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from wavebatch.files.figure_file import plain_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLACES = (
    (6, 5), (6, -5), (-6, 5), (-6, -5), (0, 7), (0, -7), (10, 0), (-10, 0), (6, 15), (-6, 15), (0, 18), (6, -15),
    (-6, -15), (0, -18), (16, 8), (-16, 8), (6, 26), (-6, 26), (0, 30), (6, 38), (-6, 38), (0, 42), (22, 20), (-22, 20),
)  # fmt: skip
"""Offsets of labels from their points [typographic points], the best first."""

_LEAST_LETTERS = 8
"""Texts are not shortened below this."""

_TOUCHING = 1e-6
"""Area that rounding leaves [pixels]."""


def text_width(figure: Figure, text: str, size: float, weight: str = "normal") -> float:
    """Width of a line of text [inches]; size: of the font [points]."""
    from matplotlib.font_manager import FontProperties

    font = FontProperties(size=size, weight=weight)
    return figure.canvas.get_renderer().get_text_width_height_descent(text, font, False)[0] / figure.dpi


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


def place_labels(
    axes: Axes, labels: Sequence[tuple[str, float, float]], *, keep: bool = False, **look: Any
) -> list[Any]:
    """Writes each label next to its point, at the first place where it covers no point and no other label.

    A label for which there is no such place in the axes is left out: what lies on another text cannot be read. keep:
    write it where it covers least. The layout must be final; `Figure.draw_without_rendering` makes it so. look: of the
    text. Returns the labels.
    """
    from matplotlib.transforms import Bbox

    legend = axes.get_legend()
    taken = [legend.get_window_extent()] if legend else []
    dot = 4 * axes.figure.dpi / 72
    for _, x, y in labels:
        x, y = axes.transData.transform((x, y))
        taken.append(Bbox.from_extents(x - dot, y - dot, x + dot, y + dot))
    frame, written = axes.get_window_extent(), []
    for text, x, y in labels:
        note = axes.annotate(text, (x, y), textcoords="offset points", xytext=(6, 5), annotation_clip=False, **look)
        note.set_in_layout(False)
        covered = [_cover(_move(note, place), taken, frame) for place in PLACES]
        best = covered.index(min(covered))
        if covered[best] > _TOUCHING and not keep:
            note.remove()
            continue
        taken.append(_move(note, PLACES[best]))
        written.append(note)
    return written


def _cover(box: Any, taken: Sequence[Any], frame: Any) -> float:
    """Area of a label that covers other things or lies outside of the axes [pixels]."""
    return sum(_overlap(box, other) for other in taken) + box.width * box.height - _overlap(box, frame)


def _move(note: Any, place: tuple[float, float]) -> Any:
    """Puts a label at an offset [points] from its point, on the side to which the offset goes; returns its box."""
    note.set_position(place)
    note.set_ha("left" if place[0] > 0 else "right" if place[0] < 0 else "center")
    note.set_va("bottom" if place[1] > 0 else "top" if place[1] < 0 else "center")
    return note.get_window_extent()


def _overlap(a: Any, b: Any) -> float:
    """Area that two boxes share [pixels]."""
    both = a.intersection(a, b)
    return both.width * both.height if both else 0.0


def space_ticks(axis: Any, length: float, each: float) -> None:
    """Places as many ticks as fit, or two, or one; length: of the axis, each: room of a tick [inches]."""
    if length >= 2 * each:
        axis.get_major_locator().set_params(nbins=int(min(length / each, 8)))
    else:
        axis.set_ticks(_round_places(*axis.get_view_interval(), 2 if length >= each else 1))
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
