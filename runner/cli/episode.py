"""A recorded episode, step by step: as JSON, and as frames for the terminal."""

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
        recording: the open recording; it may be closed afterwards.
        phase: `train` or `eval`.
        number: the episode of the phase, counted from 0.
        title: the first line of each frame.

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
        """Yield each step as JSON, with numbers and names."""
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
        totals = np.zeros(len(self._agents))
        yield self._frame(0, int(self._records[0]["state"]), ["", "the start", ""])
        for i, step in enumerate(self.steps()):
            totals += self._records[i]["rewards"]
            explored = " (explored)" if step["explored"] else ""
            rewards = _joined(list(step["rewards"].values()))
            events = [event_in_words(name) for name in step["events"]]
            events += ["the end"] if step["terminated"] else ["the step limit"] if step["truncated"] else []
            lines = [
                f"{step['action_in_words']}{explored}",
                f"reward {rewards}, so far {_joined(totals.tolist())}",
                ", ".join(events),
            ]
            yield self._frame(i + 1, step["next_state"], lines)

    def _frame(self, count: int, state: int, lines: list[str]) -> Text:
        from rich.text import Text

        frame = Text.assemble((self._title, "bold"), f"\nstep {count:,} of {len(self._records):,}\n\n")
        mdp = self._mdp
        if self._drawing is not None and mdp.scene_cells is not None:
            cells = mdp.scene_cells[state]
            carriers = np.full(len(cells), -1) if mdp.scene_carriers is None else mdp.scene_carriers[state]
            frame.append(self._drawing.draw(cells.tolist(), carriers.tolist()))
            frame.append(f"\n{self._drawing.legend}\n\n", style="dim")
        frame.append("\n".join([self._states[state], *lines]))
        return frame


def _joined(rewards: list[float]) -> str:
    """Return rewards as text: `-4`, or `-2 / -2` of several agents."""
    return " / ".join(number(reward, 0 if reward == round(reward) else 2) for reward in rewards)
