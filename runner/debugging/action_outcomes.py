"""Where the actions at a step lead, and what each is worth: as JSON, tables and pictures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from html import escape
from typing import Final

import numpy as np

from runner.analysis.contents import END_WORDS
from runner.analysis.sections import Answer, Figure, Grid, Section
from runner.drawing import svg, svg_maps
from runner.drawing.palette import ink_on, ramp_colour
from runner.environments.mdp import Mdp
from runner.environments.naming import numbered_actions, spoken
from runner.util.humanize import number, sentence
from runner.util.values import Json, finite

_CELL: Final = (116, 44)
"""Width and height of a cell of the matrix."""
_HEAD: Final = (96, 60)
"""Width and height of its headings."""
_OF_MATRIX: Final = (
    "The exact value of each joint action if the policy acts from there on. The recorded one has a frame."
)
_OF_TABLE: Final = (
    "Return and length are those of the whole episode. Policy: how likely it takes the action. Learned: the "
    "Q-value. Value: the exact discounted return from here on under that policy; optimal: if all act "
    "optimally after the action, together. Regret: how much more the best action is worth."
)


@dataclass(frozen=True)
class Outcome:
    """Where an episode led, from its beginning to its end."""

    returns: tuple[float, ...]
    """The sum of each learner's rewards."""
    length: int
    end: str
    """A key of `END_WORDS`."""


@dataclass(frozen=True)
class ActionOutcome(Outcome):
    """Where an action leads, and what it is worth."""

    action: int
    """The number of the joint action."""
    name: str
    is_recorded: bool
    probability: float
    """With which the policy takes it in this state."""
    learned: tuple[float, ...]
    """Its Q-value in each learner's table; empty if nothing is learned."""
    values: tuple[float | None, ...]
    """Its exact value for each learner if the policy acts from there on; None with a discount of 1."""
    optimal_value: float | None
    """Its exact value for all together if they act optimally from there on; None with a discount of 1."""
    regret: float | None
    """By how much `optimal_value` is below that of the best action."""


@dataclass(frozen=True, eq=False)
class WhatIf(Answer):
    """The actions at a step of an episode, and where each leads."""

    run_id: str
    at: str
    """The step, as a reference."""
    title: str
    """The name of the episode."""
    state: int
    state_in_words: str
    tables_step: int
    """Training steps that the tables have learned from."""
    learners: tuple[str, ...]
    policy: str
    """What acts from the step on, in words."""
    epsilon: float
    discount: float
    recorded: Outcome
    """Where the episode led."""
    actions: tuple[ActionOutcome, ...]
    """Those of the highest value first, summed over learners."""
    left_out: int
    """Number of further actions, of lower value, that were not played."""
    notes: tuple[str, ...]
    """What a reader must know about these figures, a sentence each."""
    mdp: Mdp = field(repr=False)
    """The environment; not a part of the JSON."""

    def as_json(self) -> Json:
        """Return all fields but the environment as JSON can hold them."""
        fields: Json = finite({name: value for name, value in vars(self).items() if name != "mdp"})
        return fields

    @property
    def facts(self) -> dict[str, str]:
        """The step, and what is known of it, as text by name."""
        recorded = self.recorded
        returns = " and ".join(map(_short, recorded.returns))
        return {
            "step": f"{self.at}, {self.title}",
            "state": f"{self.state}: {self.state_in_words}",
            "policy": f"{self.policy}, after {self.tables_step:,} training steps",
            "recorded": f"return {returns}, {recorded.length:,} steps, {END_WORDS[recorded.end]}",
            "discount": f"{self.discount:g}, of the exact values",
        }

    @property
    def grid(self) -> Grid:
        """The actions as a table of text."""
        several = len(self.learners) > 1
        own = [f" {spoken(learner)}" if several else "" for learner in self.learners]
        headings = (
            "action",
            *(f"return{who}" for who in own),
            "length",
            "end",
            "policy",
            *(f"learned{who}" for who in own if self.actions[0].learned),
            *(f"value{who}" for who in own),
            "optimal",
            "regret",
        )
        rows = [
            (
                f"{row.name}{' (recorded)' if row.is_recorded else ''}",
                *map(_short, row.returns),
                f"{row.length:,}",
                END_WORDS[row.end],
                f"{100 * row.probability:.3g} %",
                *(number(value, 3) for value in (*row.learned, *row.values, row.optimal_value, row.regret)),
            )
            for row in self.actions
        ]
        return Grid(headings, rows)

    def picture(self, style: str = svg.STYLE) -> str:
        """Return the grid in the state of the step, as SVG; empty without a scene.

        The style is CSS of the picture; empty if the page has it.
        """
        drawing = svg.drawing_of(self.mdp)
        if drawing is None:
            return ""
        places = drawing.places(self.mdp, np.array([self.state]))
        return drawing.frame(places[0], f"The state of the step: {self.state_in_words}", style=style)

    def matrix(self, base: str = "") -> str:
        """Return the actions of two agents as a matrix, as SVG; empty for other environments.

        The first agent's actions are the rows. A cell has the exact values of its joint action, or its
        returns where there are none, and the colour of their sum. It links to the page of the action if
        `base`, the address of the run, is given.
        """
        mdp = self.mdp
        if len(mdp.agents) != 2 or len(self.actions) < mdp.joint_actions:
            return ""
        shown = {
            row.action: row.returns if None in row.values else [value or 0.0 for value in row.values]
            for row in self.actions
        }
        totals = np.array([sum(shown[action]) for action in range(mdp.joint_actions)])
        levels = svg_maps.levels_of(totals, float(totals.min()), float(totals.max()))
        rows, columns = numbered_actions(mdp)
        first, second = map(spoken, mdp.agents)
        parts = [
            _text(_HEAD[0] + _CELL[0] * len(columns) / 2, 20, second, bold=True),
            _text(6, _HEAD[1] - 10, first, anchor="start", bold=True),
        ]
        parts += [
            _text(_HEAD[0] + _CELL[0] * (i + 0.5), _HEAD[1] - 10, name) for i, name in enumerate(columns)
        ]
        parts += [
            _text(6, _HEAD[1] + _CELL[1] * (i + 0.5) + 5, name, anchor="start") for i, name in enumerate(rows)
        ]
        for row in self.actions:
            i, j = divmod(row.action, len(columns))
            x = _HEAD[0] + j * _CELL[0]
            y = _HEAD[1] + i * _CELL[1]
            colour = ramp_colour(levels[row.action])
            edge = ' stroke="currentColor" stroke-width="4"' if row.is_recorded else ""
            values = " / ".join(number(value, 1) for value in shown[row.action])
            cell = (
                f'<rect x="{x + 2}" y="{y + 2}" width="{_CELL[0] - 4}" height="{_CELL[1] - 4}" '
                f'fill="{colour}"{edge}/>' + _text(x + _CELL[0] / 2, y + 27, values, ink_on(colour))
            )
            title = (
                f"<title>{escape(row.name)}: {escape(END_WORDS[row.end])} after {row.length:,} steps</title>"
            )
            link = f'a href="{escape(base + self._page(row))}"' if base else "g"
            parts.append(f"<{link}>{title}{cell}</{link[0]}>")
        width, height = _HEAD[0] + _CELL[0] * len(columns), _HEAD[1] + _CELL[1] * len(rows)
        label = f"The value of each action of {first} (rows) and {second} (columns)"
        drawn = svg.picture(width + 4, height + 4, label, "".join(parts))
        return drawn.replace('role="img"', 'role="group"', 1) if base else drawn

    def _page(self, row: ActionOutcome) -> str:
        return f"what-if/{self.at}/{row.action}"

    def sections(self, base: str = "") -> list[Section]:
        """Return what people see: the step, its pictures, and where each action leads.

        With `base`, the address of the run, the pictures have links and the style of a page, which shows the
        notes itself.
        """
        drawn = (
            Figure(self.picture("" if base else svg.STYLE)),
            Figure(self.matrix(base), _OF_MATRIX, is_wide=True),
        )
        figures = [figure for figure in drawn if figure.svg]
        notes = [] if base else list(map(sentence, self.notes))
        grid = replace(self.grid, links=list(map(self._page, self.actions)))
        return [
            Section("The step", facts=self.facts),
            Section("", notes, figures=figures, layout="split matrix"),
            Section("Where each action leads", [_OF_TABLE], [grid]),
        ]


def _short(value: float) -> str:
    return number(value, 0 if value % 1 == 0 else 2)


def _text(
    x: float, y: float, text: str, colour: str = "currentColor", anchor: str = "middle", bold: bool = False
) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{colour}" font-size="15" '
        f'font-family="DejaVu Sans, sans-serif"{weight}>{escape(text)}</text>'
    )
