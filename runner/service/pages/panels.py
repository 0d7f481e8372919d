"""Replays side by side, which one slider moves."""

from __future__ import annotations

from dataclasses import dataclass


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

    @property
    def has_pictures(self) -> bool:
        """Whether pictures are fetched."""
        return not (self.scene or self.why_no_pictures)

    @property
    def note(self) -> str:
        """Why there is no picture, as a sentence."""
        return f"There is no picture: {self.why_no_pictures}" if self.why_no_pictures else ""
