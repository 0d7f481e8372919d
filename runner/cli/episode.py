"""A recorded episode of any run, step by step: as JSON, and as frames for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from runner.analysis.contents import Step, require_steps
from runner.drawing.text import TextDrawing
from runner.environments.mdp import events_of
from runner.environments.naming import actions_in_words, states_in_words
from runner.export.pictures import PictureMoment, moments_of
from runner.export.values import plain_value, step_actions_in_words, value_in_words
from runner.recording.spaces import least_number
from runner.replay.recorded import reset_of
from runner.replay.steps import transitions_of
from runner.util.humanize import number
from runner.util.jsonable import as_json
from runner.util.values import Json

if TYPE_CHECKING:
    from rich.text import Text

    from runner.analysis.episodes import EpisodeRef
    from runner.recording.reader import Recording
    from runner.recording.spaces import Value


class ShownEpisode:
    """One episode of an open recording from step `at.t` on; the title is the first line of each frame.

    Raises:
        NotInRecording: the episode ends before that step.
    """

    def __init__(self, recording: Recording, at: EpisodeRef, title: str) -> None:
        require_steps(recording, "show", may_redo=True)
        self._recording = recording
        self._phase = at.phase
        self._number = at.number_in(recording)
        self._length = len(at.steps_in(recording, with_end=True))
        self._first = at.t
        self._title = title

    def steps(self) -> Iterator[dict[str, object]]:
        """Yield each step as JSON: with names where the environment's table has them.

        The first step of a loop's episode has the seed and the options of its reset.
        """
        recording = self._recording
        agents = self._recording.agents
        describe = _named(recording) if recording.tabular else _valued(recording, self._phase)
        reset = reset_of(recording, self._phase, self._number)
        for row in islice(transitions_of(recording, self._phase, self._number), self._first, None):
            yield {
                "t": int(row["t"]),
                **({"reset": reset.arguments} if reset is not None and not row["t"] else {}),
                **describe(row),
                "rewards": dict(zip(agents, as_json(np.asarray(row["rewards"])), strict=True)),
                "terminated": bool(row["terminated"]),
                "truncated": bool(row["truncated"]),
            }

    def frames(self) -> Iterator[Text]:
        """Yield a frame of the state before the first step, and one after each step."""
        from rich.text import Text

        draw = _state_drawer(self._recording)
        reset = reset_of(self._recording, self._phase, self._number)
        start = "the start" + (
            f", reset with {reset.in_words}" if reset is not None and reset.in_words else ""
        )
        moments = moments_of(self._recording, self._phase, self._number)
        for moment in islice(moments, self._first, None):
            step = f"\nstep {moment.t:,} of {self._length:,}\n\n"
            yield Text.assemble(
                (self._title, "bold"), step, draw(moment.observation), _in_words(moment) or start
            )


def _in_words(moment: PictureMoment) -> str:
    if not moment.action:
        return ""
    return (
        f"{moment.action}\nreward {_joined(moment.rewards)}, so far {_joined(moment.returns)}\n"
        + ", ".join(filter(None, [moment.events, moment.ended]))
    )


def _state_drawer(recording: Recording) -> Callable[[Value | None], Text]:
    """Return a function that draws the state of an observation, or puts the observation into words."""
    from rich.text import Text

    if not recording.tabular:
        what = "state " if recording.has_states else ""
        return lambda value: Text(
            "the first observation was lost\n" if value is None else f"{what}{value_in_words(value)}\n"
        )
    mdp = recording.mdp
    first = least_number(recording.spaces["observation"])
    names = states_in_words(mdp)
    drawing = TextDrawing(mdp.scene) if mdp.scene is not None else None

    def drawn(value: Value) -> Text:
        state = int(value) - first
        text = Text()
        if drawing is not None and mdp.scene_cells is not None:
            text.append(drawing.draw(mdp.scene_cells[state].tolist(), mdp.carriers[state].tolist()))
            text.append(f"\n{drawing.legend}\n\n", style="dim")
        return text.append(f"{names[state]}\n")

    return drawn


def _named(recording: Recording) -> Callable[[Step], dict[str, object]]:
    """Return a function that gives the states, action and events of a step with their names."""
    mdp, agents = recording.mdp, recording.agents
    states, actions = states_in_words(mdp), actions_in_words(mdp)
    words = {"state": states, "action": actions, "next_state": states}

    def describe(row: Step) -> dict[str, object]:
        step = np.asarray(row).reshape(1)
        mdp.check_steps(step, str(recording.path), "recorded")
        events = int(events_of(mdp, step)[0])
        explored = int(row["explored"])
        description: dict[str, object] = {}
        for name, names in words.items():
            description |= {name: int(row[name]), f"{name}_in_words": names[int(row[name])]}
        return description | {
            "events": [name for bit, name in enumerate(mdp.event_names) if events >> bit & 1],
            "explored": [agent for i, agent in enumerate(agents) if explored >> i & 1],
        }

    return describe


def _valued(recording: Recording, phase: str) -> Callable[[Step], dict[str, object]]:
    """Return a function that gives the action of a step, by name where it has one, and the observation."""
    agents = recording.agents if len(recording.agents) > 1 else ("",)
    in_words = step_actions_in_words(recording, phase)
    has_names = [agent for agent in agents if recording.phase(phase).action_names(agent)]

    def describe(row: Step) -> dict[str, object]:
        if recording.has_states:
            description: Json = {name: int(row[name]) for name in ("state", "action", "next_state")}
        else:
            description = {name: as_json(plain_value(row[name])) for name in ("action", "next_observation")}
        if agents != ("",):
            description["acted"] = [agent for i, agent in enumerate(agents) if int(row["acted"]) >> i & 1]
        words_by_agent = {agent: words for agent, words in in_words(row).items() if agent in has_names}
        return description | (
            {"action_in_words": words_by_agent.get("", words_by_agent)} if words_by_agent else {}
        )

    return describe


def _joined(rewards: Sequence[float]) -> str:
    """Return rewards as text: `-4`, or `-2 / -2` of several agents."""
    return " / ".join(number(reward, 0 if reward % 1 == 0 else 2) for reward in rewards)
