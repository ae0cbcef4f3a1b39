"""Charts as inline SVG: axes with round ticks, lines, bars, points and pictures. Colours come from page.css.

`charts` builds the figures of the pages with it. Before you change it: the drawing area is a nested <svg>, which cuts
what lies outside of the axes, so that no curve can cover labels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from wavebatch.tools.html.markup import text

MARGIN = (58.0, 14.0, 26.0, 44.0)
"""Left, right, top and bottom of the drawing area."""

MOST_TICKS = 6


def round_ticks(low: float, high: float, most: int = MOST_TICKS) -> list[float]:
    """Round numbers from low to high: multiples of 1, 2 or 5 times a power of ten."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low] if math.isfinite(low) else []
    power = 10.0 ** math.floor(math.log10(span / most))
    step = next(factor * power for factor in (1, 2, 5, 10) if span / (factor * power) <= most)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 12 - math.floor(math.log10(step))) for number in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten from low to high, with 2 and 5 times them where there are few."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    factors = (1, 2, 5) if last - first <= 3 else (1,)
    every = max(1, (last - first) // MOST_TICKS)
    found = [factor * 10.0**power for power in range(first, last + 1, every) for factor in factors]
    return [tick for tick in found if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]


def tick_label(value: float) -> str:
    """The number of a tick, short."""
    if value and (abs(value) >= 1e7 or abs(value) < 1e-4):
        return f"{value:.0e}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")
    return f"{value:,.10g}"


class Axis:
    """One axis: from values to places."""

    def __init__(
        self, low: float, high: float, log: bool = False, names: Sequence[tuple[float, str]] | None = None
    ) -> None:
        if log:
            low, high = max(low, 1e-300), max(high, 1e-300)
        if not high > low:
            low, high = (low / 2, high * 2) if log else (low - 0.5, high + 0.5)
        self.low, self.high, self.log = float(low), float(high), log
        self._names = names

    def place(self, values: np.ndarray | float) -> np.ndarray:
        """Share of the way from low to high."""
        values = np.asarray(values, np.float64)
        if not self.log:
            return (values - self.low) / (self.high - self.low)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(values / self.low) / math.log(self.high / self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Values with their labels: the given names, or round numbers."""
        if self._names is not None:
            return list(self._names)
        ticks = log_ticks(self.low, self.high) if self.log else round_ticks(self.low, self.high)
        return [(tick, tick_label(tick)) for tick in ticks]


class Chart:
    """A chart; marks are drawn in the order of the calls. Colours are numbers 0 to 5, or "x" for grey."""

    def __init__(
        self, x: Axis, y: Axis, *, title: str, labels: tuple[str, str] = ("", ""), size: tuple[int, int] = (420, 270),
        small: bool = False,
    ) -> None:  # fmt: skip
        self._x, self._y, self._title, self._labels = x, y, title, labels
        left, right, top, bottom = (40.0, 8.0, 22.0, 22.0) if small else MARGIN
        self._left, self._top = left, top
        self._size = size
        self.width, self.height = size[0] - left - right, size[1] - top - bottom
        self._marks: list[str] = []
        self._legend: list[tuple[str, int | str]] = []

    def _place(self, x: np.ndarray | float, y: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        px, py = self._x.place(x) * self.width, (1 - self._y.place(y)) * self.height
        # Far outside is as good as a little outside, and keeps numbers short.
        return np.clip(px, -1e4, 1e4), np.clip(py, -1e4, 1e4)

    def line(self, x: np.ndarray, y: np.ndarray, color: int | str, *, kind: str = "", name: str = "") -> None:
        """A line through points; it is broken where a value is not finite. name: entry of the legend."""
        px, py = self._place(x, y)
        path, pen = [], False
        for one, other in zip(px.tolist(), py.tolist(), strict=True):
            fine = math.isfinite(one) and math.isfinite(other)
            if fine:
                path.append(f"{'L' if pen else 'M'}{one:.1f} {other:.1f}")
            pen = fine
        self._marks.append(f'<path class="line s{color} {kind}" d="{"".join(path)}"/>')
        if name:
            self._legend.append((name, color))

    def bars(self, edges: np.ndarray, heights: np.ndarray, color: int | str, names: Sequence[str] = ()) -> None:
        """Bars between edges (b + 1,) from the bottom of the chart; names: shown where the mouse rests."""
        left, base = self._place(np.asarray(edges), np.full(len(edges), self._y.low))
        top = self._place(np.asarray(edges)[:-1], heights)[1]
        for number, height in enumerate(heights):
            if not height > 0:
                continue
            wide, high = max(left[number + 1] - left[number] - 0.5, 0.5), max(base[number] - top[number], 0.6)
            tip = f"<title>{text(names[number])}</title>" if names else ""
            box = f'x="{left[number]:.1f}" y="{base[number] - high:.1f}" width="{wide:.1f}" height="{high:.1f}"'
            self._marks.append(f'<rect class="f{color}" {box}>{tip}</rect>')

    def points(self, x: np.ndarray, y: np.ndarray, color: int | str, *, radius: float = 3.0, names: Sequence[str] = (),
               name: str = "") -> None:  # fmt: skip
        """A dot per point."""
        px, py = self._place(np.atleast_1d(x), np.atleast_1d(y))
        for number, (one, other) in enumerate(zip(px.tolist(), py.tolist(), strict=True)):
            if math.isfinite(one) and math.isfinite(other):
                tip = f"<title>{text(names[number])}</title>" if names else ""
                dot = f'cx="{one:.1f}" cy="{other:.1f}" r="{radius:g}"'
                self._marks.append(f'<circle class="f{color}" {dot}>{tip}</circle>')
        if name:
            self._legend.append((name, color))

    def band(self, low: float, high: float, color: int | str) -> None:
        """A horizontal band."""
        _, (bottom, top) = self._place(np.zeros(2) + self._x.low, np.array([low, high]))
        box = f'x="0" y="{top:.1f}" width="{self.width:.1f}" height="{max(bottom - top, 0.5):.1f}"'
        self._marks.append(f'<rect class="f{color} band" {box}/>')

    def upright(self, x: Iterable[float], color: int | str, kind: str = "dash") -> None:
        """Lines from bottom to top at these places."""
        for one in np.atleast_1d(self._x.place(np.array(list(x)))) * self.width:
            if math.isfinite(one):
                self._marks.append(f'<path class="line thin s{color} {kind}" d="M{one:.1f} 0V{self.height:.1f}"/>')

    def label(self, x: float, y: float, words: str, color: int | str = "x") -> None:
        """A word beside a point."""
        px, py = self._place(x, y)
        right = px > self.width * 0.7
        place = f'x="{px + (-6 if right else 6):.1f}" y="{py - 5:.1f}" text-anchor="{"end" if right else "start"}"'
        self._marks.append(f'<text class="f{color}" {place}>{text(words)}</text>')

    def image(self, address: str) -> None:
        """A picture that fills the drawing area."""
        box = f'width="{self.width:.1f}" height="{self.height:.1f}"'
        self._marks.append(f'<image {box} preserveAspectRatio="none" href="{address}"/>')

    def render(self) -> str:
        """The chart as an <svg> element."""
        wide, high = self._size
        parts = [f'<text class="title" x="{self._left:.0f}" y="15">{text(self._title)}</text>' if self._title else ""]
        parts += [*self._draw_ticks(), *self._draw_labels()]
        inner = "".join(self._marks)
        box = f'x="{self._left:g}" y="{self._top:g}" width="{self.width:.1f}" height="{self.height:.1f}"'
        frame = f"<svg {box}>{inner}</svg>"
        axes = f'<path class="axis" d="M{self._left:g} {self._top:g}v{self.height:.1f}h{self.width:.1f}"/>'
        name = text(self._title or self._labels[1])
        head = f'<svg class="chart" viewBox="0 0 {wide} {high}" role="img" aria-label="{name}">'
        return f"{head}{''.join(parts)}{frame}{axes}{self._draw_legend()}</svg>"

    def _draw_ticks(self) -> Iterable[str]:
        bottom = self._top + self.height
        spread = 0.0
        for tick, words in self._x.ticks():
            px = self._left + float(self._x.place(tick)) * self.width
            if px - 3.4 * len(words) < spread:  # it would touch the label before it
                continue
            spread = px + 3.4 * len(words) + 6
            yield f'<path class="grid" d="M{px:.1f} {self._top:g}V{bottom:.1f}"/>'
            yield f'<text x="{px:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{text(words)}</text>'
        for tick, words in self._y.ticks():
            py = self._top + (1 - float(self._y.place(tick))) * self.height
            yield f'<path class="grid" d="M{self._left:g} {py:.1f}h{self.width:.1f}"/>'
            yield f'<text x="{self._left - 5:g}" y="{py + 4:.1f}" text-anchor="end">{text(words)}</text>'

    def _draw_labels(self) -> Iterable[str]:
        x, y = self._labels
        if x:
            place = f'x="{self._left + self.width:.1f}" y="{self._size[1] - 8}" text-anchor="end"'
            yield f"<text {place}>{text(x)}</text>"
        if y:
            middle = self._top + self.height / 2
            place = f'transform="translate(12 {middle:.1f}) rotate(-90)" text-anchor="middle"'
            yield f"<text {place}>{text(y)}</text>"

    def _draw_legend(self) -> str:
        parts = []
        for number, (name, color) in enumerate(self._legend):
            y = self._top + 12 + 15 * number
            x = self._left + self.width - 8
            parts.append(f'<text class="f{color}" x="{x:.1f}" y="{y:.1f}" text-anchor="end">{text(name)}</text>')
        return "".join(parts)
