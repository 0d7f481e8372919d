"""Replays side by side, which one slider moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from runner.drawing import svg
from runner.export.encoded import why_no_pictures
from runner.recording.reader import Recording


@dataclass(frozen=True)
class Panel:
    """One of the replays."""

    label: str
    number: int | None
    """Number of its colour, if it has one."""
    source: str
    """Address of the episode's data."""
    pictures: str
    """Address of its pictures."""
    scene: str
    """The grid, as SVG, whose things the script moves; empty without a scene."""
    why_no_pictures: str = ""
    offset: int = 0
    """The common step at which the episode begins."""
    address: str = ""
    """Address of the page of its replay alone."""

    @property
    def has_pictures(self) -> bool:
        """Whether pictures are fetched."""
        return not (self.scene or self.why_no_pictures)

    @property
    def note(self) -> str:
        """Why there is no picture, as a sentence."""
        return f"There is no picture: {self.why_no_pictures}" if self.why_no_pictures else ""


def panel_of(recording: Recording, source: str, label: str, number: int | None = None, **more: Any) -> Panel:
    """Return the replay of an episode, whose data has the address `source`."""
    drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
    why = "" if drawing else why_no_pictures(recording)
    scene = "" if drawing is None else drawing.frame(None, f"The grid of {label}", style="")
    return Panel(label, number, source, f"{source}/pictures", scene, why, **more)
