"""Charts for pages and for print: lines with bands, dots, bars and text.

The SVG of a page is written directly, because loading Matplotlib takes longer than all that a page computes;
its colours are variables of the page, so that it is readable in the light and in the dark. Matplotlib paints
the same marks as PNG and PDF. Lengths are points, from the upper left corner.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from types import ModuleType
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np

from runner.analysis.axes import round_width
from runner.drawing import palette
from runner.errors import RunnerError
from runner.util.arrays import Floats
from runner.util.extras import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.transforms import Transform


TEXT: Final = 8.5
SMALL: Final = 7.5
_PAINTS: Final = {
    palette.INK: "currentColor",
    **{colour: f"var(--line-{i}, {colour})" for i, colour in enumerate(palette.SERIES)},
}
"""Colours that a page replaces by its own, which are others in the dark."""
DASHES: Final = ("", "6 2.2", "1.6 1.8", "7.5 1.5 1.5 1.5")
_POINTS_PER_UNIT: Final = 4
"""Points of a line that are closer along x than 1 / _POINTS_PER_UNIT are drawn as their range."""
MARKERS: Final = (
    ("m-{r},0a{r},{r} 0 1 0 {d},0a{r},{r} 0 1 0 -{d},0", "o"),
    ("m-{r},-{r}h{d}v{d}h-{d}z", "s"),
    ("m0,-{r}l{r},{d}h-{d}z", "^"),
    ("m0,-{r}l{r},{r}l-{r},{r}l-{r},-{r}z", "D"),
    ("m0,{r}l{r},-{d}h-{d}z", "v"),
    ("m-{r},0h{d}m-{r},-{r}v{d}", "+"),
    ("m-{r},-{r}l{d},{d}m0,-{d}l-{d},{d}", "x"),
)
"""Relative SVG path and Matplotlib's name of each marker."""
_GRID: Final = {"stroke": palette.INK, "width": 0.5, "opacity": 0.15}

SUFFIXES: Final = (".png", ".svg", ".pdf")
_DPI: Final = 160


@dataclass(frozen=True)
class Scale:
    """Maps values from `low` to `high` to places from `start` to `end`."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    @classmethod
    def around(cls, values: Floats, start: float, end: float, log: bool = False) -> Scale:
        """Return a scale on which the finite ones of values have a margin on both sides."""
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        if log:
            factor = (high / low) ** 0.05 if high > low else 2.0
            return cls(low / factor, high * factor, start, end, log=True)
        margin = 0.05 * (high - low) or 0.05 * abs(high) or 0.05
        return cls(low - margin, high + margin, start, end)

    def __call__(self, values: Floats) -> Floats:
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
        step = round_width((self.high - self.low) / 5 or 1.0)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [round(i * step, 12) if step < 1 else i * step for i in range(first, last + 1)]


@dataclass(frozen=True)
class ChartShape:
    """A polygon if it is filled, else a line, through points [n, 2]."""

    points: Floats
    fill: str = ""
    stroke: str = ""
    width: float = 1.0
    dash: int = 0
    opacity: float = 1.0
    is_curve: bool = False


@dataclass(frozen=True)
class Markers:
    """A marker at each of some points [n, 2]."""

    points: Floats
    marker: int
    radius: float
    fill: str
    stroke: str
    opacity: float


@dataclass(frozen=True)
class Text:
    """A line of text whose baseline starts, is centred (`middle`) or ends at a point."""

    x: float
    y: float
    text: str
    anchor: str = "start"
    size: float = TEXT
    bold: bool = False
    angle: float = 0.0
    """Degrees, clockwise."""
    colour: str = palette.INK
    halo: bool = False


@dataclass(frozen=True)
class Cells:
    """Filled rectangles [n, 4]: x and y of the upper left corner, width and height."""

    points: Floats
    fill: str


Mark = ChartShape | Markers | Cells | Text


@dataclass
class Canvas:
    """A drawing: marks on a plane of a width and a height, with a description for screen readers."""

    width: float
    height: float
    title: str
    marks: list[Mark] = field(default_factory=list)

    def text(self, x: float, y: float, text: str, anchor: str = "start", **style: Any) -> None:
        """Write a line of text; the style has the other fields of `Text`."""
        self.marks.append(Text(x, y, text, anchor, **style))

    def shape(self, points: Sequence[Sequence[float]] | Floats, **style: Any) -> None:
        """Draw a line or a polygon; the style has the other fields of `ChartShape`."""
        self.marks.append(ChartShape(np.asarray(points, np.float64), **style))

    def cells(self, rectangles: Floats, fill: str) -> None:
        """Fill rectangles [n, 4]: x and y of the upper left corner, width and height."""
        self.marks.append(Cells(rectangles, fill))

    def notes(self, lines: Sequence[str]) -> None:
        """Write small lines of text at the bottom."""
        for number, line in enumerate(lines):
            self.text(10, self.height - 10 * (len(lines) - number) + 2, line, size=SMALL)

    def place(self, other: Canvas, x: float, y: float) -> None:
        """Draw everything of another canvas with its corner at a point."""
        for mark in other.marks:
            if isinstance(mark, Text):
                self.marks.append(replace(mark, x=mark.x + x, y=mark.y + y))
            else:
                shift = (x, y, 0.0, 0.0) if isinstance(mark, Cells) else (x, y)
                self.marks.append(replace(mark, points=mark.points + np.array(shift)))

    def svg(self, for_page: bool = True) -> str:
        """Return the `<svg>` element; one for a page has the page's colours."""
        paints = _PAINTS if for_page else {}
        size = "" if for_page else f' xmlns="http://www.w3.org/2000/svg" width="{self.width:g}pt"'
        return (
            f'<svg{size} role="img" aria-label="{escape(self.title)}" viewBox="0 0 {self.width:g} '
            f'{self.height:g}" font-family="\'DejaVu Sans\',sans-serif" font-size="{TEXT}" '
            f'fill="{paints.get(palette.INK, palette.INK)}">'
            f"{''.join(_svg_of(mark, paints) for mark in self.marks)}</svg>"
        )


class Chart(Canvas):
    """A canvas with axes: `x` from left to right, `y` from bottom to top."""

    def __init__(self, x: Scale, y: Scale, width: float, height: float, title: str) -> None:
        super().__init__(width, height, title)
        self.x = x
        self.y = y

    def frame(self, title: str, title_y: float, x_label: str = "", y_labels: Sequence[str] = ()) -> None:
        """Draw the title, the axes without ticks, and their labels."""
        x, y = self.x, self.y
        self.text(x.start, title_y, title, size=9.5, bold=True)
        self.shape([(x.start, y.end), (x.start, y.start), (x.end, y.start)], stroke=palette.INK)
        if x_label:
            self.text((x.start + x.end) / 2, self.height - 5, x_label, "middle")
        for number, label in enumerate(y_labels):
            self.text(9 + 10 * number, (y.start + y.end) / 2, label, "middle", angle=-90)

    def x_ticks(self, labels: Iterable[tuple[float, str]] | None = None, slanted: bool = False) -> None:
        """Draw grid lines and labels along x, by default of about five round values."""
        top, bottom = self.y.end, self.y.start
        for value, label in labelled(self.x.ticks) if labels is None else labels:
            at = self.x.at(value)
            self.shape([(at, top), (at, bottom)], **_GRID)
            self.shape([(at, bottom), (at, bottom + 3)], stroke=palette.INK)
            if slanted:
                self.text(at + 6, bottom + 10, label, "end", size=8, angle=-20)
            else:
                self.text(at, bottom + 11.5, label, "middle", size=8)

    def y_ticks(self, labels: Iterable[tuple[float, str]] | None = None) -> None:
        """Draw grid lines and labels along y, by default of about five round values."""
        left, right = self.x.start, self.x.end
        for value, label in labelled(self.y.ticks) if labels is None else labels:
            at = self.y.at(value)
            self.shape([(left, at), (right, at)], **_GRID)
            self.shape([(left, at), (left - 3, at)], stroke=palette.INK)
            self.text(left - 5, at + 3, label, "end", size=8)

    def line(
        self, x: Floats, y: Floats, colour: str, dash: int = 0, width: float = 1.5, **style: object
    ) -> None:
        """Draw a line through points; `dash` is the number of a pattern of dashes."""
        points = np.column_stack(_thinned(self.x(x), self.y(y)))
        self.shape(points, stroke=colour, dash=dash, width=width, is_curve=True, **style)

    def band(self, x: Floats, low: Floats, high: Floats, fill: str, **style: object) -> None:
        """Fill the area between two lines."""
        lower, upper = (np.column_stack(_thinned(self.x(x), self.y(edge))) for edge in (low, high))
        self.shape(np.concatenate([lower, upper[::-1]]), fill=fill, **style)

    def markers(
        self,
        x: Floats,
        y: Floats,
        colour: str,
        marker: int,
        radius: float,
        opacity: float = 1.0,
        hollow: bool = False,
        edge: str = "",
    ) -> None:
        """Draw a marker at each point."""
        if len(x):
            points = np.column_stack([self.x(x), self.y(y)])
            fill = "" if hollow else colour
            self.marks.append(Markers(points, marker, radius, fill, edge or colour, opacity))

    def marked_line(
        self, x: Floats, y: Floats, number: int, dash: int = 0, at: tuple[Floats, Floats] | None = None
    ) -> None:
        """Draw a line in a series' colour with about eight of its markers, at other points if given."""
        self.line(x, y, series_colour(number), dash)
        marked_x, marked_y = at or (x, y)
        every = slice(None, None, max(len(marked_x) // 8, 1))
        self.markers(marked_x[every], marked_y[every], series_colour(number), series_marker(number), 1.7)


def series_colour(number: int) -> str:
    """Return the colour of a line."""
    return palette.SERIES[number % len(palette.SERIES)]


def series_marker(number: int) -> int:
    """Return the marker of a line; a line that repeats the colour of another one has another marker."""
    return number + number // len(palette.SERIES)


def number_on_axis(value: float) -> str:
    """Return a number as an axis shows it: `20,000`, `0.5`, `2.5M`."""
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}"
    return f"{value / 1e6:g}M" if abs(value) >= 1e6 else text


def labelled(ticks: Sequence[float], short: bool = False) -> list[tuple[float, str]]:
    """Return ticks with their labels; short ones are `20k` for 20,000."""
    return [
        (tick, f"{number_on_axis(tick / 1e3)}k" if short and 1e3 <= abs(tick) < 1e6 else number_on_axis(tick))
        for tick in ticks
    ]


def _svg_of(mark: Mark, paints: dict[str, str]) -> str:
    if isinstance(mark, Text):
        attributes = {
            "font-size": f"{mark.size:g}" if mark.size != TEXT else "",
            "font-weight": "bold" if mark.bold else "",
            "transform": f"rotate({mark.angle:g} {mark.x:.1f} {mark.y:.1f})" if mark.angle else "",
            "fill": paints.get(mark.colour, mark.colour) if mark.colour != palette.INK else "",
        }
        if mark.halo:
            paper = f"var(--paper, {palette.WHITE})" if paints else palette.WHITE
            attributes |= {"paint-order": "stroke", "stroke": paper, "stroke-width": "3"}
        place = f'x="{mark.x:.1f}" y="{mark.y:.1f}" text-anchor="{mark.anchor}"{_written(attributes)}'
        return f"<text {place}>{escape(mark.text)}</text>"
    if isinstance(mark, Cells):
        d = "".join(f"M{x:.2f},{y:.2f}h{w:.2f}v{h:.2f}h{-w:.2f}z" for x, y, w, h in mark.points.tolist())
        return f'<path d="{d}" fill="{mark.fill}" shape-rendering="crispEdges"/>'
    attributes = {
        "fill": paints.get(mark.fill, mark.fill) or "none",
        "stroke": paints.get(mark.stroke, mark.stroke),
        "opacity": f"{mark.opacity:g}" if mark.opacity != 1 else "",
    }
    if isinstance(mark, ChartShape):
        d = "M" + "L".join(f"{x:.1f},{y:.1f}" for x, y in mark.points.tolist()) + ("z" if mark.fill else "")
        attributes["stroke-width"] = f"{mark.width:g}" if mark.stroke and mark.width != 1 else ""
        attributes["stroke-dasharray"] = DASHES[mark.dash % len(DASHES)]
        attributes["stroke-linejoin"] = "round" if mark.is_curve else ""
    else:
        pattern, _ = MARKERS[mark.marker % len(MARKERS)]
        shape = pattern.format(r=f"{mark.radius:g}", d=f"{2 * mark.radius:g}")
        d = "".join(f"M{x:.1f},{y:.1f}{shape}" for x, y in mark.points.tolist())
    return f'<path d="{d}"{_written(attributes)}/>'


def _written(attributes: dict[str, str]) -> str:
    return "".join(f' {name}="{value}"' for name, value in attributes.items() if value)


def _thinned(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Keep the first, lowest, highest and last of the points at one place along x, which draw the same."""
    if len(x) < 8 * _POINTS_PER_UNIT:
        return x, y
    column = np.rint(x * _POINTS_PER_UNIT).astype(np.int64)
    starts = np.flatnonzero(np.diff(column, prepend=column[0] - 1))
    kept: list[int] = []
    for start, stop in itertools.pairwise([*starts.tolist(), len(x)]):
        inside = y[start:stop]
        kept += sorted({start, start + int(inside.argmin()), start + int(inside.argmax()), stop - 1})
    return x[kept], y[kept]


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten; where there are fewer than two of them, their multiples, or else even steps."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    tens = [10.0**power for power in range(first, last + 1)]
    inside = [tick for tick in tens if low <= tick <= high]
    if len(inside) >= 2:
        return inside[:: math.ceil(len(inside) / 6)]
    finer = [round(ten * digit, 12) for ten in tens for digit in (1, 2, 5)]
    inside = [tick for tick in finer if low <= tick <= high]
    return inside if len(inside) >= 2 else Scale(low, high, 0, 1).ticks


def check_suffix(path: Path) -> None:
    """Check that a file can be written as what its suffix says.

    Raises:
        RunnerError: the suffix is not in `SUFFIXES`.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RunnerError(f"{path}: found the ending {path.suffix!r}, expected one of {', '.join(SUFFIXES)}.")
    if suffix != ".svg":
        require("matplotlib", extra="plots", purpose="a plot")


def save(canvas: Canvas, path: Path) -> None:
    """Write a canvas to a file, in the format of its suffix."""
    if path.suffix.lower() == ".svg":
        path.write_bytes(svg_file(canvas))
    else:
        write_image(canvas, path, path.suffix.lower()[1:])


def svg_file(canvas: Canvas) -> bytes:
    """Return a canvas as an SVG file."""
    return ('<?xml version="1.0" encoding="utf-8"?>\n' + canvas.svg(for_page=False)).encode()


def write_image(canvas: Canvas, target: Path | IO[bytes], form: str, dpi: int = _DPI) -> None:
    """Write a canvas as `png` or `pdf`."""
    parts = ("figure", "lines", "patches", "patheffects", "transforms")
    modules = [f"matplotlib.{part}" for part in parts]
    mpl = require("matplotlib", *modules, extra="plots", purpose="a plot")
    metadata = {"CreationDate": None} if form == "pdf" else None
    with mpl.rc_context({"pdf.fonttype": 42, "font.sans-serif": ["DejaVu Sans"]}):
        figure = mpl.figure.Figure(figsize=(canvas.width / 72, canvas.height / 72))
        points = mpl.transforms.Affine2D().scale(1 / 72, -1 / 72).translate(0, canvas.height / 72)
        transform = points + figure.dpi_scale_trans
        for mark in canvas.marks:
            _add_to_figure(mpl, figure, mark, transform)
        figure.savefig(target, format=form, dpi=dpi, metadata=metadata)


def _add_to_figure(mpl: ModuleType, figure: Figure, mark: Mark, transform: Transform) -> None:
    if isinstance(mark, Text):
        halo = mpl.patheffects.withStroke(linewidth=3, foreground=palette.WHITE)
        figure.text(
            mark.x,
            mark.y,
            mark.text,
            transform=transform,
            fontsize=mark.size,
            fontweight="bold" if mark.bold else "normal",
            color=mark.colour,
            ha={"start": "left", "middle": "center", "end": "right"}[mark.anchor],
            va="baseline",
            rotation=-mark.angle,
            rotation_mode="anchor",
            parse_math=False,
            path_effects=[halo] if mark.halo else None,
        )
        return
    if isinstance(mark, Cells):
        for x, y, width, height in mark.points.tolist():
            rectangle = mpl.patches.Rectangle((x, y), width, height, facecolor=mark.fill, linewidth=0)
            rectangle.set_transform(transform)
            figure.add_artist(rectangle)
        return
    style: dict[str, object] = {"alpha": mark.opacity, "transform": transform}
    if isinstance(mark, ChartShape) and mark.fill:
        edge = {"edgecolor": mark.stroke or "none", "linewidth": mark.width}
        figure.add_artist(mpl.patches.Polygon(mark.points, facecolor=mark.fill, **edge, **style))
        return
    if isinstance(mark, ChartShape):
        dashes = [float(length) / mark.width for length in DASHES[mark.dash % len(DASHES)].split()]
        style |= {"color": mark.stroke, "linewidth": mark.width, "linestyle": (0, dashes) if dashes else "-"}
    else:
        style |= {"marker": MARKERS[mark.marker % len(MARKERS)][1], "markersize": 2 * mark.radius}
        style |= {"linestyle": "", "markerfacecolor": mark.fill or "none", "markeredgecolor": mark.stroke}
    figure.add_artist(mpl.lines.Line2D(*mark.points.T, **style))
