"""How curves are drawn: lines of single runs, exponential means, logarithmic axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from runner.analysis.groups import Panel
from runner.errors import RunnerError
from runner.recording.metrics import SHARES
from runner.util.arrays import Flags, Floats
from runner.util.humanize import listed


@dataclass(frozen=True)
class CurveStyle:
    """How curves are drawn."""

    lines: bool = False
    """Whether each run of a curve is drawn as a thin line too."""
    smooth: float = 0.0
    """Memory of the exponential mean that is drawn, in percent of the axis; 0 for the values themselves."""
    log_x: bool = False
    """Whether the horizontal axis is logarithmic; points at 0 are left out."""
    log_y: bool = False
    """Whether the vertical axes are logarithmic; points at 0 or below are left out."""

    def __post_init__(self) -> None:
        """Raise RunnerError if `smooth` is no percentage."""
        if not 0 <= self.smooth <= 100:
            raise RunnerError(
                f"smooth: found {self.smooth}, expected a percentage of the axis from 0 to 100."
            )


PLAIN: Final = CurveStyle()


def style_of(panel: Panel, style: CurveStyle) -> CurveStyle:
    """Return the style in which a panel can be drawn.

    An axis without positive values stays linear, and so do shares, which are drawn on top of each other.
    """
    log_x = style.log_x and panel.last > 0
    positive = any(
        ((curve.middle > 0) & (curve.places > 0 if log_x else True)).any() for curve in panel.curves
    )
    return replace(style, log_x=log_x, log_y=style.log_y and positive and panel.metric != SHARES)


def visible(places: Floats, values: Floats, style: CurveStyle) -> Flags:
    """Return which points have a place on the axes of a style, bool [n]."""
    is_visible = ~np.isnan(values)
    if style.log_x:
        is_visible &= places > 0
    if style.log_y:
        is_visible &= values > 0
    return is_visible


def not_drawn(panels: Sequence[Panel], style: CurveStyle) -> str:
    """Return a sentence on what logarithmic axes leave out, and which axes stay linear; empty if nothing."""
    left_out, linear = [], []
    for panel in panels:
        own = style_of(panel, style)
        count = sum(int((~visible(curve.places, curve.middle, own)).sum()) for curve in panel.curves)
        if count:
            left_out.append(f"“{panel.title}” ({count:,})")
        if style.log_y and not own.log_y and panel.metric != SHARES:
            linear.append(f"“{panel.title}”")
    parts = []
    if left_out:
        parts.append(f"points at 0 or below are left out of {listed(left_out)}")
    if linear:
        parts.append(f"no value is positive in {listed(linear)}, so the axis is linear")
    return f" On logarithmic axes {'; '.join(parts)}." if parts else ""
