"""Charts as files: SVG directly, PNG and PDF by Matplotlib."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import IO, TYPE_CHECKING, Final

from runner.drawing import palette
from runner.errors import RunnerError
from runner.export.plots.chart import DASHES, MARKERS, Canvas, Cells, ChartShape, Mark, Text
from runner.util.extras import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.transforms import Transform

SUFFIXES: Final = (".png", ".svg", ".pdf")
_DPI: Final = 160


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
            own = mpl.patches.Rectangle((x, y), width, height, facecolor=mark.fill, linewidth=0)
            own.set_transform(transform)
            figure.add_artist(own)
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
