"""Replays side by side, which one slider moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from runner.drawing import svg
from runner.export.encoded import picture_note
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
    has_pictures: bool = False
    """Whether pictures are fetched."""
    note: str = ""
    """Why there is no picture, or no better one."""
    offset: int = 0
    """The common step at which the episode begins."""
    address: str = ""
    """Address of the page of its replay alone."""
    episode: str = ""
    """Path of the episode below the run's replays, where another one may follow it."""


def panel_of(
    recording: Recording, phase: str, source: str, label: str, number: int | None = None, **more: Any
) -> Panel:
    """Return the replay of an episode of a phase, whose data has the address `source`."""
    drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
    has_pictures, note = picture_note(recording, phase)
    scene = "" if drawing is None else drawing.frame(None, f"The grid of {label}", style="")
    return Panel(label, number, source, f"{source}/pictures", scene, has_pictures, note, **more)
