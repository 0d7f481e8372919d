"""A Q-value as the sum of what it was made of: for Python, as text, and as HTML for pages and notebooks."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from html import escape
from typing import Final

from runner.analysis.episodes import EpisodeRef
from runner.analysis.sections import Answer, Figure, Grid, Section
from runner.drawing.svg_maps import Move
from runner.environments.naming import spoken
from runner.errors import MissingExtra
from runner.export.reports.rendering import framed, page_style, partials
from runner.util.values import Json

EXPLANATION: Final = (
    "This is a decomposition along the path that training took, not a counterfactual: `dualtaxi branch` "
    "shows what would have happened after another action or with other settings."
)
MAX_ROWS: Final = 12
"""Kinds of rewards that are shown."""
HEIGHT: Final = 760
"""Height of a notebook's frame in pixels."""
KEY: Final = (
    "An arrow is as wide as the weight of all steps that made this move; a ring stands for staying in the "
    "cell, as after a move into a wall, or a pickup. Things are drawn where they are in the value's state."
)


@dataclass(frozen=True)
class ValuePart:
    """A part of a Q-value."""

    weight: float
    """The sum of the weights of its rewards or initial values."""
    contribution: float
    """What it adds to the Q-value: each reward or initial value, times its weight."""


@dataclass(frozen=True)
class RewardPart(ValuePart):
    """What rewards of one kind add to a Q-value."""

    reward: float | None
    """None for all kinds that are not named."""
    events: str
    """What happened in these steps; may be empty."""


@dataclass(frozen=True)
class EpisodesPart(ValuePart):
    """What the rewards of a stretch of episodes add to a Q-value."""

    start: int
    stop: int
    """The episode after the last one."""


@dataclass(frozen=True)
class StepPart(ValuePart):
    """What the reward of one step adds to a Q-value."""

    at: str
    """The step as a reference, `EPISODE:T`."""
    step: int
    """Its number in training."""
    episode: int
    state: int
    state_in_words: str
    action: int
    """The joint action."""
    action_in_words: str
    next_state: int
    reward: float
    """The learner's own."""
    events: str
    explored: str
    """Which learners explored; may be empty."""
    distance: float
    """Steps from the state of the Q-value to this one, on average over the ways by which the reward came."""


@dataclass(frozen=True)
class Why(Answer):
    """A Q-value as a sum."""

    run_id: str
    agent: str
    """The learner whose table it is in."""
    state: int
    state_in_words: str
    action: int
    action_in_words: str
    step: int
    """Training steps that the table has learned from."""
    value: float
    """The Q-value in the table."""
    total: float
    """The sum of all contributions."""
    counted: int
    """Number of steps whose rewards have a weight."""
    rewarded: ValuePart
    """All rewards."""
    initial: ValuePart
    """The initial values."""
    rewards: tuple[RewardPart, ...]
    """The parts by kind of reward, those that add or take most first."""
    episodes: tuple[EpisodesPart, ...]
    """The parts by stretches of equally many episodes, in order."""
    steps: tuple[StepPart, ...]
    """The steps that add or take most, these first."""
    moves: tuple[Move, ...]
    """Where the things that the learner moves went, by weight; empty without a scene."""
    note: str
    """What the sum does not explain of the run's algorithm; may be empty."""
    picture: str = field(repr=False)
    """The moves on the grid, as SVG; empty without a scene."""

    def as_json(self) -> Json:
        """Return all fields but the picture as JSON can hold them."""
        fields = asdict(self) | {"moves": [move._asdict() for move in self.moves]}
        del fields["picture"]
        return fields

    @property
    def step_to_look_at(self) -> EpisodeRef | None:
        """The step that adds or takes most."""
        return EpisodeRef.parse(self.steps[0].at) if self.steps else None

    def sections(self) -> list[Section]:
        """Return the value, and all parts of the sum."""
        return [Section("The value", facts=self._facts), *_parts_of(self)]

    @property
    def _facts(self) -> dict[str, str]:
        """The run, the state, the action and the value as text, by name."""
        return {
            "run": self.run_id,
            "state": f"{self.state}: {self.state_in_words}",
            "action": f"{self.action}: {self.action_in_words}, of {spoken(self.agent)}",
            "value": f"{self.value:.9g} after {self.step:,} training steps",
        }

    def _repr_html_(self) -> str:
        """Return the sum in a frame of its own; the value alone if packages are missing."""
        try:
            page = f"<style>{page_style()}</style><main>{partials().answer(self.sections())}</main>"
        except MissingExtra as error:
            facts = "; ".join(f"{name} {text}" for name, text in self._facts.items())
            return f"<p>{escape(facts)}</p><p>{escape(str(error))}</p>"
        title = f"Why the value of action {self.action_in_words} in state {self.state} is {self.value:.4g}"
        return framed(title, page, HEIGHT)


def _parts_of(found: Why) -> list[Section]:
    whole = found.rewarded.weight + found.initial.weight

    def cells(part: ValuePart) -> tuple[str, str, str]:
        share = 100 * part.weight / whole if whole else 0.0
        return f"{part.contribution:+.4g}", f"{part.weight:.4g}", f"{share:.3g} %"

    columns = ("adds", "weight", "of all weight")
    sums = [
        (f"rewards of {found.counted:,} of {found.step:,} steps", *cells(found.rewarded)),
        ("initial values", *cells(found.initial)),
        ("sum", f"{found.total:.9g}", f"{whole:.4g}", ""),
    ]
    rest = found.rewards[MAX_ROWS:]
    rewards = [
        ("other rewards" if part.reward is None else f"{part.reward:+g}", part.events or "none", *cells(part))
        for part in found.rewards[:MAX_ROWS]
    ]
    if rest:
        others = ValuePart(sum(part.weight for part in rest), sum(part.contribution for part in rest))
        rewards.append((f"{len(rest)} other kinds", "", *cells(others)))
    off = "It equals the table's value."
    if found.total != found.value:
        off = f"It differs from the table's value by {abs(found.total - found.value):.1g}, by rounding."
    largest = Section("The steps that add or take most", ["No reward adds to the value or takes from it."])
    if found.steps:
        headings = ("step", "state", "action", "reward", *columns, "steps away")
        links = [EpisodeRef.parse(part.at).replay for part in found.steps]
        steps = [_step(part, cells(part)) for part in found.steps]
        largest = Section(largest.title, [], [Grid(headings, steps, links=links)])
    episodes = [part for part in found.episodes if part.weight or part.contribution]
    without = len(found.episodes) - len(episodes)
    left_out = (
        f"{without:,} of {len(found.episodes):,} stretches of episodes have no weight and are left out."
    )
    sections = [
        Section(
            "The sum",
            [off, EXPLANATION, *([found.note] if found.note else [])],
            [Grid(("", *columns), sums)],
            figures=[Figure(found.picture, KEY)] if found.picture else [],
            layout="split",
        ),
        largest,
    ]
    if rewards:
        sections.append(Section("By reward", [], [Grid(("reward", "events", *columns), rewards)]))
    if episodes:
        by_episode = Grid(("episodes", *columns), [(_episodes(part), *cells(part)) for part in episodes])
        sections.append(Section("By episode", [left_out] if without else [], [by_episode]))
    return sections


def _episodes(part: EpisodesPart) -> str:
    return f"{part.start:,}" if part.stop == part.start + 1 else f"{part.start:,} to {part.stop - 1:,}"


def _step(part: StepPart, cells: tuple[str, str, str]) -> tuple[str, ...]:
    action = f"{part.action_in_words} ({part.explored})" if part.explored else part.action_in_words
    reward = f"{part.reward:+g}, {part.events}" if part.events else f"{part.reward:+g}"
    return part.at, f"{part.state}: {part.state_in_words}", action, reward, *cells, f"{part.distance:.1f}"
