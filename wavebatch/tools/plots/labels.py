"""Texts of pictures that fit: shortened to the room that they have.

All modules that draw use it. Texts are measured with the renderer, not estimated from the number of letters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from wavebatch.files.figure_file import plain_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST_LETTERS = 8
"""Texts are not shortened below this."""


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
