"""A recorded episode, step by step: in words, and as frames to be drawn."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from runner.drawing.text import Drawing
from runner.environments.mdp import events_of
from runner.environments.naming import actions_in_words, event_in_words, states_in_words
from runner.util.humanize import number

if TYPE_CHECKING:
    from rich.text import Text

    from runner.recording.reader import Recording


class Episode:
    """One episode of a recording, read whole: it has at most as many steps as the step limit.

    Args:
        recording: where it is; may be closed afterwards.
        phase: `train` or `eval`.
        number: which one of the phase, counted from 0.
        title: what it is called in the frames.

    Raises:
        RecordingError: there is no such episode, or the recording holds no steps.
    """

    def __init__(self, recording: Recording, phase: str, number: int, title: str) -> None:
        self._mdp = recording.mdp
        self._records = recording.episode_steps(phase, number)
        self._events = events_of(self._mdp, self._records)
        self._agents = recording.agents
        self._title = title
        self._drawing = Drawing(self._mdp.scene) if self._mdp.scene is not None else None
        self._states, self._actions = states_in_words(self._mdp), actions_in_words(self._mdp)

    def steps(self) -> Iterator[dict[str, Any]]:
        """Yield each step as JSON can hold it, numbers and words."""
        for record, events in zip(self._records, self._events.tolist(), strict=True):
            state, action, next_state = (int(record[name]) for name in ("state", "action", "next_state"))
            yield {
                "t": int(record["t"]),
                "state": state,
                "state_in_words": self._states[state],
                "action": action,
                "action_in_words": self._actions[action],
                "next_state": next_state,
                "next_state_in_words": self._states[next_state],
                "rewards": dict(zip(self._agents, record["rewards"].tolist(), strict=True)),
                "events": [name for bit, name in enumerate(self._mdp.event_names) if events >> bit & 1],
                "explored": [
                    agent for i, agent in enumerate(self._agents) if int(record["explored"]) >> i & 1
                ],
                "terminated": bool(record["terminated"]),
                "truncated": bool(record["truncated"]),
            }

    def frames(self) -> Iterator[Text]:
        """Yield a frame of the first state, and one after each step."""
        first = int(self._records[0]["state"])
        totals = np.zeros(len(self._agents))
        yield self._frame(0, first, ["", "the start", ""])
        for i, step in enumerate(self.steps()):
            totals += self._records[i]["rewards"]
            yield self._frame(i + 1, step["next_state"], self._said(step, totals))

    def _frame(self, count: int, state: int, said: list[str]) -> Text:
        from rich.text import Text

        frame = Text.assemble((self._title, "bold"), f"\nstep {count:,} of {len(self._records):,}\n\n")
        mdp = self._mdp
        if self._drawing is not None and mdp.scene_cells is not None:
            cells = mdp.scene_cells[state]
            carriers = np.full(len(cells), -1) if mdp.scene_carriers is None else mdp.scene_carriers[state]
            frame.append(self._drawing.draw(cells.tolist(), carriers.tolist()))
            frame.append(f"\n{self._drawing.legend}\n\n", style="dim")
        frame.append("\n".join([self._states[state], *said]))
        return frame

    def _said(self, step: dict[str, Any], totals: Any) -> list[str]:
        """Return what is said of a step: action, rewards, and what happened."""
        chosen = " (explored)" if step["explored"] else ""
        rewards = list(step["rewards"].values())
        paid = f"reward {_figures(rewards)}, so far {_figures(totals.tolist())}"
        happened = [event_in_words(name) for name in step["events"]]
        happened += ["the end"] if step["terminated"] else ["the step limit"] if step["truncated"] else []
        return [f"{step['action_in_words']}{chosen}", paid, ", ".join(happened)]


def _figures(values: list[float]) -> str:
    """Return rewards: `-4`, or `-2 / -2` where each agent has its own."""
    return " / ".join(number(value, 0 if value == round(value) else 2) for value in values)
