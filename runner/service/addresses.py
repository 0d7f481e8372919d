"""Addresses of pages, and of steps of episodes in them.

A step is a parsed step reference: (episode, t), or (training episodes before an evaluation, trial, t).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode


@dataclass(frozen=True)
class Paging:
    """The links below a long table."""

    page: int
    """From 1."""
    rows: int
    """Rows of the whole table."""
    rows_per_page: int
    address: str
    """Address of the first page."""

    @property
    def pages(self) -> int:
        """Number of pages."""
        return max(1, math.ceil(self.rows / self.rows_per_page))

    @property
    def previous(self) -> str:
        """Address of the page before; empty on the first one."""
        return self._address(self.page - 1) if self.page > 1 else ""

    @property
    def next(self) -> str:
        """Address of the next page; empty on the last one."""
        return self._address(self.page + 1) if self.page < self.pages else ""

    def _address(self, page: int) -> str:
        if page == 1:
            return self.address
        return f"{self.address}{'&' if '?' in self.address else '?'}page={page}"


def link(path: str, values: Mapping[str, Any]) -> str:
    """Return an address with a query of the values that are not empty."""
    query = [(key, value) for key, value in values.items() if value not in ("", None, [], ())]
    return f"{path}?{urlencode(query, doseq=True)}" if query else path


def after_step(step: Sequence[int]) -> tuple[int, ...]:
    """Return the frame after a step, which shows its outcome."""
    return (*step[:-1], step[-1] + 1)


def episode_path(step: Sequence[int]) -> str:
    """Return the address of a step's episode, below that of its run's replay."""
    return "/".join(["train" if len(step) == 2 else "eval", *map(str, step[:-1])])


def replay_address(run_id: str, step: Sequence[int]) -> str:
    """Return the page of the replay at the frame after a step."""
    return f"/runs/{run_id}/replay/{episode_path(step)}?t={after_step(step)[-1]}"


def episode_in_words(step: Sequence[int]) -> str:
    """Return the name of a step's episode."""
    if len(step) == 2:
        return f"Training episode {step[0]:,}"
    return f"Trial {step[1]} of the evaluation after {step[0]:,} episodes"
