"""What a live view sends at once; apart from both ends, because training does not load Rerun."""

from __future__ import annotations

from typing import Any, NamedTuple


class Piece(NamedTuple):
    """What is shown at once."""

    kind: str
    """`steps` or `metrics`."""
    phase: str
    time: int
    """Steps of both phases executed, the first of these included; for metrics, all until then."""
    episode: int
    """Of training, at that time."""
    content: Any
    """Records of steps, or one mapping of metrics."""
