"""Small charts as SVG elements for pages: lines with bands, dots, and shares stacked on each other.

They are written directly, because loading Matplotlib and drawing with it takes longer than everything else
that these pages compute. Colours are variables of the page, and ink is its text colour, so that a chart is
readable in the light and in the dark.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.naming import spoken
from runner.export.plots.figure import number_on_axis
from runner.export.plots.metrics import Curve, Panel
from runner.recording.metrics import SHARES

Values = NDArray[np.float64]

TEXT: Final = 8.5
"""Size of the text, in units of the drawing, which is shown about 1.2 times as large."""
SMALL: Final = 7.5
_LETTER: Final = 0.56
"""Width of an average letter by the size of the text."""
_DASHES: Final = ("", "6 2.2", "1.6 1.8", "7.5 1.5 1.5 1.5")
_STEPS_A_UNIT: Final = 4
"""Points of a line that are closer to each other along x than 1 / _STEPS_A_UNIT are drawn as their range."""

_MARKERS: Final[tuple[str, ...]] = (
    "m-{r},0a{r},{r} 0 1 0 {d},0a{r},{r} 0 1 0 -{d},0",
    "m-{r},-{r}h{d}v{d}h-{d}z",
    "m0,-{r}l{r},{d}h-{d}z",
    "m0,-{r}l{r},{r}l-{r},{r}l-{r},-{r}z",
    "m0,{r}l{r},-{d}h-{d}z",
    "m-{r},0h{d}m-{r},-{r}v{d}",
    "m-{r},-{r}l{d},{d}m0,-{d}l-{d},{d}",
)
"""Relative paths: circle, square, triangle up, diamond, triangle down, plus and cross."""


@dataclass(frozen=True)
class Scale:
    """Maps values from `low` to `high` to places from `start` to `end`."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, values: Values) -> Values:
        """Return the places of values."""
        low, high = self.low, self.high
        if self.log:
            values, low, high = np.log(values), math.log(low), math.log(high)
        return np.asarray(self.start + (values - low) / ((high - low) or 1.0) * (self.end - self.start))

    def at(self, value: float) -> float:
        """Return the place of a value."""
        return float(self(np.array(value)))

    @property
    def ticks(self) -> list[float]:
        """About five round values inside."""
        if self.log:
            return _log_ticks(self.low, self.high)
        step = _round_step((self.high - self.low) / 5)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [round(i * step, 12) if step < 1 else i * step for i in range(first, last + 1)]


class Chart:
    """A drawing with axes, to which marks are added.

    Args:
        x: from left to right.
        y: from bottom to top.
        width: of the drawing.
        height: of the drawing.
        title: what readers of the page hear.
    """

    def __init__(self, x: Scale, y: Scale, width: float, height: float, title: str) -> None:
        self.x, self.y, self._width, self._height, self._title = x, y, width, height, title
        self._parts: list[str] = []

    def element(self) -> str:
        """Return the `<svg>` element."""
        return (
            f'<svg role="img" aria-label="{escape(self._title)}" viewBox="0 0 {self._width:g} '
            f'{self._height:g}" font-family="\'DejaVu Sans\',sans-serif" font-size="{TEXT}" '
            f'fill="currentColor">{"".join(self._parts)}</svg>'
        )

    def text(self, x: float, y: float, text: str, anchor: str = "start", **attributes: Any) -> None:
        """Write a line of text whose baseline begins, is centred, or ends at a place."""
        place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{_written(attributes)}'
        self.add(f"<text {place}>{escape(text)}</text>")

    def path(self, d: str, **attributes: Any) -> None:
        """Draw a path."""
        self.add(f'<path d="{d}"{_written(attributes)}/>')

    def add(self, element: str) -> None:
        """Add an element."""
        self._parts.append(element)

    def frame(self, title: str, title_y: float, x_label: str, y_labels: Sequence[str]) -> None:
        """Draw title and names of the axes, and the axes themselves without ticks."""
        x, y = self.x, self.y
        self.text(x.start, title_y, title, font_size=9.5, font_weight="bold")
        self.path(f"M{x.start:.1f},{y.end:.1f}V{y.start:.1f}H{x.end:.1f}", fill="none", stroke="currentColor")
        if x_label:
            self.text((x.start + x.end) / 2, self._height - 5, x_label, "middle")
        middle = (y.start + y.end) / 2
        for number, label in enumerate(y_labels):
            at = 9 + 10 * number
            self.text(at, middle, label, "middle", transform=f"rotate(-90 {at} {middle:.1f})")

    def x_ticks(self, labels: Sequence[tuple[float, str]], slanted: bool = False) -> None:
        """Draw grid lines and labels along x."""
        top, bottom = self.y.end, self.y.start
        for value, label in labels:
            at = self.x.at(value)
            self._grid_line(f"M{at:.1f},{top:.1f}V{bottom:.1f}")
            self.path(f"M{at:.1f},{bottom:.1f}v3", stroke="currentColor")
            if slanted:
                turn = f"rotate(-20 {at:.1f} {bottom + 10:.1f})"
                self.text(at + 6, bottom + 10, label, "end", font_size=8, transform=turn)
            else:
                self.text(at, bottom + 11.5, label, "middle", font_size=8)

    def y_ticks(self, labels: Sequence[tuple[float, str]]) -> None:
        """Draw grid lines and labels along y."""
        left, right = self.x.start, self.x.end
        for value, label in labels:
            at = self.y.at(value)
            self._grid_line(f"M{left:.1f},{at:.1f}H{right:.1f}")
            self.path(f"M{left:.1f},{at:.1f}h-3", stroke="currentColor")
            self.text(left - 5, at + 3, label, "end", font_size=8)

    def line(self, x: Values, y: Values, colour: str, dash: int = 0, **attributes: Any) -> None:
        """Draw a line through points; `dash` is a kind of line."""
        style: dict[str, Any] = {"stroke_width": 1.5, "stroke_linejoin": "round"} | _dashed(dash)
        d = "M" + "L".join(f"{a:.1f},{b:.1f}" for a, b in zip(*_drawn(self.x(x), self.y(y)), strict=True))
        self.path(d, **({"fill": "none", "stroke": colour} | style | attributes))

    def band(self, x: Values, low: Values, high: Values, colour: str, **attributes: Any) -> None:
        """Fill the area between two lines."""
        there, back = _drawn(self.x(x), self.y(low)), _drawn(self.x(x), self.y(high))
        points = [*zip(*there, strict=True), *reversed(list(zip(*back, strict=True)))]
        self.path("M" + "L".join(f"{a:.1f},{b:.1f}" for a, b in points) + "z", fill=colour, **attributes)

    def markers(
        self, x: Values, y: Values, colour: str, marker: int, radius: float, **attributes: Any
    ) -> None:
        """Draw a marker at each point."""
        if not len(x):
            return
        shape = _MARKERS[marker % len(_MARKERS)].format(r=f"{radius:g}", d=f"{2 * radius:g}")
        places = zip(self.x(x), self.y(y), strict=True)
        d = "".join(f"M{a:.1f},{b:.1f}{shape}" for a, b in places)
        self.path(d, **({"fill": colour, "stroke": colour} | attributes))

    def _grid_line(self, d: str) -> None:
        self.path(d, stroke="currentColor", stroke_width=0.5, opacity=0.15)


def colour_of_line(number: int) -> str:
    """Return the colour of a line as pages have it: lighter in the dark."""
    return f"var(--line-{number % len(palette.SERIES)}, {palette.SERIES[number % len(palette.SERIES)]})"


def labelled(ticks: Sequence[float], shortened: bool = False) -> list[tuple[float, str]]:
    """Return ticks with their labels; `20k` for 20,000 where there is little room."""
    if not shortened:
        return [(tick, number_on_axis(tick)) for tick in ticks]
    return [
        (tick, f"{number_on_axis(tick / 1e3)}k" if 0 < abs(tick) < 1e6 else number_on_axis(tick))
        for tick in ticks
    ]


# --- panels of learning curves ------------------------------------------------------------------------


def is_wide(panel: Panel) -> bool:
    """Return whether a panel takes a whole row: it has a legend of many lines."""
    return panel.metric == SHARES


def panel_svgs(panels: Sequence[Panel], groups: int) -> list[dict[str, Any]]:
    """Return panels as pages take them: title, SVG, and whether it is wide."""
    return [
        {"title": panel.title, "svg": panel_svg(panel, groups), "wide": is_wide(panel)} for panel in panels
    ]


def panel_svg(panel: Panel, groups: int) -> str:
    """Return a panel as an SVG element: curves of groups of runs over training episodes.

    Groups differ in colour and marker, the lines of a group in their dashes. Percent goes from 0 to 100, and
    what cannot be negative begins at zero.
    """
    width, height = (576.0, 180.0) if is_wide(panel) else (288.0, 180.0)
    last = max(float(curve.episodes.max()) for curve in panel.curves) or 1.0
    x = Scale(0.0, last * 1.02, 50.0, 461.0 if is_wide(panel) else 280.0)
    y = _y_scale(panel)
    chart = Chart(x, y, width, height, f"{panel.title} over training episodes")
    has_legend = len(panel.lines) > 1 and not is_wide(panel)
    largest = max(float(np.abs([curve.low, curve.high]).max()) for curve in panel.curves)
    if is_wide(panel):
        _draw_shares(chart, panel)
    chart.x_ticks(labelled([tick for tick in x.ticks if tick == int(tick)]))
    chart.y_ticks(labelled(range(0, 101, 20) if panel.percent else y.ticks, largest >= 10_000))
    chart.frame(panel.title, 14.0 if has_legend else 25.0, "training episodes", [panel.unit])
    if is_wide(panel):
        return chart.element()
    if not panel.percent and not panel.at_least_zero:
        chart.path(f"M{x.start:.1f},{y.at(0):.1f}H{x.end:.1f}", stroke="currentColor", stroke_width=0.6)
    for curve in panel.curves:
        _draw_curve(chart, panel, curve, groups)
    if has_legend:
        _draw_legend(chart, panel, groups)
    return chart.element()


def _y_scale(panel: Panel) -> Scale:
    low = min(float(curve.low.min()) for curve in panel.curves)
    high = max(float(curve.high.max()) for curve in panel.curves)
    if panel.percent:
        low, high = 0.0, 100.0 if panel.metric == SHARES else 103.0
    elif panel.at_least_zero:
        low, high = 0.0, high * 1.06 or 1.0
    else:
        low, high = min(low, 0.0), max(high, 0.0)
        low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    return Scale(low, high, 146.0, 32.0)


def _draw_curve(chart: Chart, panel: Panel, curve: Curve, groups: int) -> None:
    line = panel.lines.index(curve.line)
    number = line if groups == 1 and len(panel.lines) > 1 else curve.group
    colour = colour_of_line(number)
    if (curve.high > curve.low).any():
        chart.band(curve.episodes, curve.low, curve.high, colour, opacity=0.2)
    chart.line(curve.episodes, curve.median, colour, line)
    every = slice(None, None, max(len(curve.episodes) // 8, 1))
    marker = number + number // len(palette.SERIES)
    chart.markers(curve.episodes[every], curve.median[every], colour, marker, 1.7)


def _draw_legend(chart: Chart, panel: Panel, groups: int) -> None:
    """Name the lines of a panel above it; groups are named once for all panels."""
    at, y = chart.x.start, chart.y.end - 8
    for number, name in enumerate(spoken(line) or "all" for line in panel.lines):
        colour = colour_of_line(number) if groups == 1 else "currentColor"
        chart.path(f"M{at:.1f},{y:.1f}h18", stroke=colour, stroke_width=1.5, **_dashed(number))
        chart.text(at + 22, y + 2.8, name, font_size=SMALL)
        at += 32 + len(name) * SMALL * _LETTER


def _draw_shares(chart: Chart, panel: Panel) -> None:
    """Draw shares of a whole on top of each other, the lowest reward darkest and at the bottom."""
    episodes = panel.curves[0].episodes
    bottom = np.zeros_like(panel.curves[0].median)
    colours = palette.ramp_colours(len(panel.curves))
    for curve, colour in zip(panel.curves, colours, strict=True):
        top = bottom + np.interp(episodes, curve.episodes, curve.median)
        chart.band(episodes, bottom, top, colour, stroke="#ffffff", stroke_width=0.3)
        bottom = top
    left = chart.x.end + 10
    chart.text(left, chart.y.end + 4, "reward of a step", font_size=8)
    rows = math.ceil(len(colours) / (2 if len(colours) > 8 else 1))
    entries = reversed(list(zip(panel.curves, colours, strict=True)))
    for number, (curve, colour) in enumerate(entries):
        column, row = divmod(number, rows)
        x, y = left + 50 * column, chart.y.end + 10 + 104 / max(rows, 8) * row
        chart.add(f'<rect x="{x:.1f}" y="{y:.1f}" width="14" height="7" fill="{colour}"/>')
        chart.text(x + 18, y + 6.5, curve.line, font_size=SMALL)


# --- inside -------------------------------------------------------------------------------------------


def _drawn(x: Values, y: Values) -> tuple[Values, Values]:
    """Return points that draw the same line: of those at one place along x, first, lowest, highest, last."""
    if len(x) < 8 * _STEPS_A_UNIT:
        return x, y
    column = np.rint(x * _STEPS_A_UNIT).astype(np.int64)
    starts = np.flatnonzero(np.diff(column, prepend=column[0] - 1))
    kept: list[int] = []
    for start, stop in itertools.pairwise([*starts.tolist(), len(x)]):
        inside = y[start:stop]
        kept += sorted({start, start + int(inside.argmin()), start + int(inside.argmax()), stop - 1})
    return x[kept], y[kept]


def _round_step(width: float) -> float:
    """Return the smallest of 1, 2, 5, 10, 20, ... that is at least a width."""
    magnitude = 10.0 ** math.floor(math.log10(width)) if width > 0 else 1.0
    return next(step * magnitude for step in (1, 2, 5, 10) if step * magnitude >= width * (1 - 1e-9))


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten, or where there are fewer than two of them, their multiples as well."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    tens = [10.0**power for power in range(first, last + 1)]
    inside = [tick for tick in tens if low <= tick <= high]
    if len(inside) >= 2:
        return inside[:: math.ceil(len(inside) / 6)]
    finer = [round(ten * digit, 12) for ten in tens for digit in (1, 2, 5)]
    inside = [tick for tick in finer if low <= tick <= high]
    return inside if len(inside) >= 2 else [low, high]


def _dashed(number: int) -> dict[str, str]:
    """Return the attributes of a kind of line; the first one is solid."""
    dash = _DASHES[number % len(_DASHES)]
    return {"stroke_dasharray": dash} if dash else {}


def _written(attributes: dict[str, Any]) -> str:
    return "".join(f' {name.replace("_", "-")}="{value}"' for name, value in attributes.items())
