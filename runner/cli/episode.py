"""A recorded episode of any run, step by step: as JSON, and as frames for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from runner.drawing.text import Drawing
from runner.environments.mdp import events_of
from runner.environments.naming import actions_in_words, states_in_words
from runner.export.contents import ENDINGS, Step, ending_of
from runner.export.pictures import describer
from runner.export.values import action_in_words, plain_value, value_in_words
from runner.replay.steps import check_steps, reset_of, transitions_of
from runner.util.humanize import number
from runner.util.jsonable import as_json
from runner.util.values import Json

if TYPE_CHECKING:
    from rich.text import Text

    from runner.export.episodes import EpisodePlace
    from runner.export.pictures import Pictures
    from runner.recording.reader import Recording

_MAX_NUMBERS: Final = 32
"""Larger arrays of an observation are not written out."""


@dataclass(frozen=True)
class Frame:
    """What a terminal shows of a step."""

    above: Text
    below: Text
    picture: bytes = b""
    """A PNG between the texts; empty if there is none."""


class Episode:
    """One episode of an open recording, read as it is needed; the title is the first line of each frame."""

    def __init__(self, recording: Recording, choice: EpisodePlace, title: str) -> None:
        self._recording, self._phase, self._number = recording, choice.phase, choice.number
        self._length = len(recording.episode_span(choice.phase, choice.number))
        self._title = title

    def steps(self) -> Iterator[dict[str, object]]:
        """Yield each step as JSON: with names where the environment's table has them."""
        recording, agents = self._recording, self._recording.agents
        describe = _named(recording) if recording.tabular else _valued(recording, self._phase)
        for row in transitions_of(recording, self._phase, self._number):
            yield {
                "t": int(row["t"]),
                **describe(row),
                "rewards": dict(zip(agents, as_json(np.asarray(row["rewards"])), strict=True)),
                "terminated": bool(row["terminated"]),
                "truncated": bool(row["truncated"]),
            }

    def frames(self) -> Iterator[Frame]:
        """Yield a frame of the first state, and one after each step, in text alone."""
        from rich.text import Text

        recording, phase, episode = self._recording, self._phase, self._number
        show, describe = _state_drawer(recording, phase, episode), describer(recording, phase)
        returns = np.zeros(len(recording.agents))
        for t, row in enumerate(transitions_of(recording, phase, episode), 1):
            if t == 1:
                yield Frame(self._above(0) + show(row, is_first=True), Text("the start"))
            action, events = describe(row)
            rewards = np.asarray(row["rewards"], np.float64)
            with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
                returns += rewards
            ended = ENDINGS[ending_of(recording, phase, episode)] if t == self._length else ""
            below = _below(action, rewards.tolist(), returns.tolist(), events, ended)
            yield Frame(self._above(t) + show(row, is_first=False), below)

    def illustrated(self, pictures: Pictures) -> Iterator[Frame]:
        """Yield a frame for each picture of the episode."""
        from runner.drawing.raster import image_bytes

        for picture in pictures:
            below = _below(picture.action, picture.rewards, picture.returns, picture.events, picture.ended)
            if picture.note:
                below.append(f"\n{picture.note}")
            yield Frame(self._above(picture.t), below, image_bytes(picture.pixels, "png"))

    def _above(self, t: int) -> Text:
        from rich.text import Text

        return Text.assemble((self._title, "bold"), f"\nstep {t:,} of {self._length:,}\n\n")


def _below(action: str, rewards: Sequence[float], returns: Sequence[float], events: str, ended: str) -> Text:
    from rich.text import Text

    if not action:
        return Text("the start\n\n")
    return Text(
        f"{action}\nreward {_joined(rewards)}, so far {_joined(returns)}\n"
        + ", ".join(filter(None, [events, ended]))
    )


def _state_drawer(recording: Recording, phase: str, episode: int) -> Callable[..., Text]:
    """Return a function that draws the state before or after a step, or puts it into words."""
    from rich.text import Text

    if not recording.tabular:
        reset = reset_of(recording, phase, episode)

        def words(row: Step, is_first: bool) -> Text:
            if recording.kind == "step":
                return Text(f"state {row['state' if is_first else 'next_state']}\n")
            if not is_first:
                return Text(f"{value_in_words(row['next_observation'])}\n")
            first = (
                "the first observation was lost" if reset is None else value_in_words(reset["observation"])
            )
            return Text(f"{first}\n")

        return words
    mdp = recording.mdp
    names, drawing = states_in_words(mdp), Drawing(mdp.scene) if mdp.scene is not None else None

    def drawn(row: Step, is_first: bool) -> Text:
        check_steps(np.asarray(row).reshape(1), mdp, str(recording.path), "recorded")
        state, text = int(row["state" if is_first else "next_state"]), Text()
        if drawing is not None and mdp.scene_cells is not None:
            cells = mdp.scene_cells[state]
            carriers = np.full(len(cells), -1) if mdp.scene_carriers is None else mdp.scene_carriers[state]
            text.append(drawing.draw(cells.tolist(), carriers.tolist()))
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
        check_steps(step, mdp, str(recording.path), "recorded")
        events, explored = int(events_of(mdp, step)[0]), int(row["explored"])
        found: dict[str, object] = {}
        for name, names in words.items():
            found |= {name: int(row[name]), f"{name}_in_words": names[int(row[name])]}
        return found | {
            "events": [name for bit, name in enumerate(mdp.event_names) if events >> bit & 1],
            "explored": [agent for i, agent in enumerate(agents) if explored >> i & 1],
        }

    return describe


def _valued(recording: Recording, phase: str) -> Callable[[Step], dict[str, object]]:
    """Return a function that gives the action of a step, by name where it has one, and the observation."""
    agents = recording.agents if len(recording.agents) > 1 else ("",)
    words = {
        agent: action_in_words(recording, phase, agent)
        for agent in agents
        if recording.action_names(phase, agent)
    }

    def describe(row: Step) -> dict[str, object]:
        if recording.kind == "step":
            found: Json = {name: int(row[name]) for name in ("state", "action", "next_state")}
        else:
            found = {name: as_json(plain_value(row[name])) for name in ("action", "next_observation")}
        if agents != ("",):
            found["acted"] = [agent for i, agent in enumerate(agents) if int(row["acted"]) >> i & 1]
            own = {agent: words[agent](row["action"][agent]) for agent in found["acted"] if agent in words}
            return found | ({"action_in_words": own} if own else {})
        return found | ({"action_in_words": words[""](row["action"])} if words else {})

    return describe


def _joined(rewards: Sequence[float]) -> str:
    """Return rewards as text: `-4`, or `-2 / -2` of several agents."""
    return " / ".join(number(reward, 0 if reward % 1 == 0 else 2) for reward in rewards)
