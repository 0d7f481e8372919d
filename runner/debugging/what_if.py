"""What if another action had been taken? Each joint action at a recorded step, played on without learning.

    found = runner.what_if(run, at="eval:3000:17:5")
    for action in found.actions:
        print(action.name, action.returns, action.length, action.end, action.values, action.regret)

The tables are those of that moment and the draws those of the episode, so the recorded action of a trial
leads exactly where it did. The exact value of each action follows from the environment's arrays.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Final

import numpy as np

from runner.analysis.contents import END_WORDS, ending_of, require_steps
from runner.analysis.episodes import EpisodeRef, StepLike
from runner.analysis.sections import Answer, Figure, Grid, Section
from runner.archive.places import opened
from runner.drawing import svg, svg_maps
from runner.drawing.palette import ink_on, ramp_colour
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import (
    actions_in_words,
    agent_of,
    joint_action,
    numbered_actions,
    own_action,
    spoken,
    states_in_words,
)
from runner.export.reports.playback import Playback, tabular_playback
from runner.learning import kernel
from runner.learning.algorithms import POLICY, QLearning
from runner.learning.kernel import Tally
from runner.learning.learner import CHOSEN, NEVER, Learner
from runner.learning.schedules import compile_schedule, schedule_value
from runner.planning.exact import action_values, joint_probabilities, optimal_values, policy_values
from runner.recording import schema
from runner.recording.layout import blank_records
from runner.recording.reader import Recording
from runner.replay.steps import episode_blocks, steps_of
from runner.replay.tables import TableReplay
from runner.runs.run import Run
from runner.util.arrays import Floats, Records
from runner.util.humanize import counted, number, sentence
from runner.util.values import Json, finite

ALL: Final = "all"
"""Stands for every joint action."""
MAX_STEPS: Final = 100_000
"""Steps that an action is played on for where the environment has no step limit."""
MAX_ACTIONS: Final = 256
"""Actions that are played on; of more, those of the highest value."""
_CELL: Final = (116, 44)
"""Width and height of a cell of the matrix."""
_HEAD: Final = (96, 60)
"""Width and height of its headings."""
_MATRIX_CAPTION: Final = (
    "The exact value of each joint action if the policy acts from there on. The recorded one has a frame."
)
_TABLE_EXPLANATION: Final = (
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
    """The probability that the policy takes it in this state."""
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
    """Where the recorded episode led."""
    actions: tuple[ActionOutcome, ...]
    """The highest value first, summed over learners."""
    left_out: int
    """Number of further actions, of lower value, that were not played."""
    notes: tuple[str, ...]
    """What a reader must know about these figures, a sentence each."""
    mdp: Mdp = field(repr=False)
    """The environment; not part of the JSON."""

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
        suffixes = [f" {spoken(learner)}" if several else "" for learner in self.learners]
        headings = (
            "action",
            *(f"return{suffix}" for suffix in suffixes),
            "length",
            "end",
            "policy",
            *(f"learned{suffix}" for suffix in suffixes if self.actions[0].learned),
            *(f"value{suffix}" for suffix in suffixes),
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

        `style` is the CSS of the picture; empty if the page has it.
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
        values_of = {
            row.action: row.returns if None in row.values else [value or 0.0 for value in row.values]
            for row in self.actions
        }
        totals = np.array([sum(values_of[action]) for action in range(mdp.joint_actions)])
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
            values = " / ".join(number(value, 1) for value in values_of[row.action])
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
            Figure(self.matrix(base), _MATRIX_CAPTION, is_wide=True),
        )
        figures = [figure for figure in drawn if figure.picture]
        notes = [] if base else list(map(sentence, self.notes))
        grid = replace(self.grid, links=list(map(self._page, self.actions)))
        return [
            Section("The step", facts=self.facts),
            Section("", notes, figures=figures, layout="split matrix"),
            Section("Where each action leads", [_TABLE_EXPLANATION], [grid]),
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


def what_if(run: Run | Recording, *, at: StepLike, actions: Sequence[str | int] = ()) -> WhatIf:
    """Return where each joint action at a step of a job's episode leads, or some of them.

    Args:
        run: a run that was trained here, with its steps, or its open recording.
        at: the step: `EPISODE:T` or `step:N` of training, or `eval:N:TRIAL:T`.
        actions: numbers or names of joint actions, such as `north + east`, or `AGENT=VALUE` each: those in
            which these agents act so; all if there are none. Of more than 256, those of the highest exact
            value are played (the learned one with a discount of 1), and the recorded one.

    Raises:
        ConfigError: there is no such action or agent.
        RecordingError: there is no such episode or step, its steps were not recorded, or it is damaged.
        RunnerError: the run was recorded from a loop.
    """
    with opened(run) as recording:
        return _Branches(recording, at).compare(_chosen(recording.mdp, list(map(str, actions))))


def _chosen(mdp: Mdp, actions: list[str]) -> Iterable[int]:
    """Return the joint actions with these numbers or names, or in which agents act as `AGENT=VALUE` says."""
    if not actions or ALL in actions:
        return range(mdp.joint_actions)
    pairs = [text.partition("=") for text in actions]
    if not all(equals for _, equals, _ in pairs):
        return dict.fromkeys(joint_action(mdp, text) for text in actions)
    allowed = np.ones(mdp.own_actions.shape, bool)  # [J, agents]
    for i, agent_actions in enumerate(mdp.own_actions.T):
        values = [own_action(mdp, i, value) for name, _, value in pairs if agent_of(mdp, name) == i]
        allowed[:, i] = np.isin(agent_actions, values) if values else True
    numbers: list[int] = np.flatnonzero(allowed.all(axis=1)).tolist()
    return numbers


# --- the branches of a step ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Branched:
    """The episode to which an action leads."""

    at: EpisodeRef
    """The recorded step."""
    steps: Records
    """The recorded steps up to the branch, then the steps played."""
    outcome: Outcome
    tables: list[Floats]
    """The Q-tables of each learner that the branch was played with, [S, actions]; empty if there are none."""


def branched(recording: Recording, at: StepLike, action: str | int) -> Branched:
    """Return the whole episode to which an action leads; errors as for `what_if`."""
    return _Branches(recording, at).episode(joint_action(recording.mdp, str(action)))


def branch_playback(
    recording: Recording, at: StepLike, action: str | int, limit: int, first: int
) -> Playback:
    """Return what a page plays of the episode to which a joint action leads: at most `limit` steps.

    They begin with step `first`; errors as for `what_if`.
    """
    branch = branched(recording, at, action)
    steps = branch.steps[first : first + limit]
    if not len(steps):
        raise branch.at.no_step(recording, len(branch.steps), first, "this branch of ")
    values = tuple(table[steps["state"]] for table in branch.tables)
    return tabular_playback(recording, branch.at, branch.steps, branch.outcome.end, values, first, limit)


class _Branches:
    """The branches of one step of a recorded episode of a job."""

    def __init__(self, recording: Recording, reference: StepLike) -> None:
        recording.require_job(
            "`what_if`", "`dualtaxi branch` and runner.branch() play a loop on with one action."
        )
        require_steps(recording, "branch")
        at = EpisodeRef.parse(reference).resolved(recording)
        self._recording = recording
        self._at = at
        self._mdp = recording.mdp
        self._number = at.number_in(recording)
        length = len(at.steps_in(recording))
        returns = self._returns = np.zeros(len(recording.agents))
        self._succeeded = False
        done = 0
        for block in episode_blocks(recording, at.phase, self._number):
            self._mdp.check_steps(block, str(recording.path), schema.PHASE_NAMES[at.phase])
            before = block[: max(0, at.t - done)]
            self._returns = _summed(self._returns, before)
            self._succeeded |= self._has_success(before)
            if done <= at.t < done + len(block):
                self._step = block[at.t - done].copy()
            returns = _summed(returns, block)
            done += len(block)
        end = ending_of(recording, at.phase, self._number)
        self._recorded = Outcome(tuple(returns.tolist()), length, end)
        trained_episode = at.episode
        trained_step = int(self._step["step"])
        if at.after is not None:
            trained_episode = at.after
            trained_step = at.evaluation_in(recording).train_step
        self._tables = TableReplay(recording, trained_step)
        self._playing = _Continuation(
            self._tables.learner, self._step, trained_episode, trained_step, at.after is not None
        )

    @property
    def _learns(self) -> bool:
        return self._tables.learner.rules.learns

    def _has_success(self, steps: Records) -> bool:
        return len(steps) > 0 and bool((events_of(self._mdp, steps) & self._mdp.success_mask).any())

    def episode(self, action: int) -> Branched:
        """Return the whole episode to which an action leads."""
        before = steps_of(self._recording, self._at.phase, self._number)[: self._at.t]
        steps, outcome = self._play(action)
        tables = self._tables.tables if self._learns else []
        return Branched(self._at, np.concatenate([before, steps]), outcome, tables)

    def _play(self, action: int) -> tuple[Records, Outcome]:
        """Return the steps from an action on, and where the whole episode leads."""
        recording = self._recording
        phase = self._at.phase
        t = self._at.t
        limit = self._mdp.step_limit - t if self._mdp.step_limit else MAX_STEPS
        topics = schema.topics_of(phase)
        blocks = [
            blank_records(topic, recording.layout.message(topic), count).view(np.recarray)
            for topic, count in ((topics.steps, limit), (topics.episodes, 1))
        ]
        steps: Records = blocks[0][: self._playing.play(action, *blocks)]
        times = self._step["log_time"] + np.arange(len(steps), dtype=np.uint64) * schema.STEP_NANOSECONDS
        steps["log_time"] = times
        steps["publish_time"] = times
        if action == int(self._step["action"]):
            steps[0]["explored"] = self._step["explored"]
        end = next((end for end in ("terminated", "truncated") if steps[-1][end]), "stopped")
        if self._succeeded or self._has_success(steps):
            end = "success"
        returns = tuple(_summed(self._returns, steps).tolist())
        return steps, Outcome(returns, t + len(steps), end)

    def compare(self, actions: Iterable[int]) -> WhatIf:
        """Return where each of some joint actions leads."""
        recording, mdp, playing = self._recording, self._mdp, self._playing
        state, recorded = int(self._step["state"]), int(self._step["action"])
        names = actions_in_words(mdp)
        probabilities = playing.policy
        learned = self._learned(state)
        values, optimal = self._exact_values(state, probabilities)
        worth = list(map(sum, learned)) if playing.discount >= 1 else values.sum(axis=1).tolist()
        ranked = sorted(set(actions), key=lambda action: (action != recorded, -worth[action], action))
        rows = [
            ActionOutcome(
                **vars(self._play(action)[1]),
                action=action,
                name=str(names[action]),
                is_recorded=action == recorded,
                probability=float(probabilities[state, action]),
                learned=learned[action],
                values=tuple(map(finite, values[action].tolist())),
                optimal_value=finite(float(optimal[action])),
                regret=finite(float(optimal.max() - optimal[action])),
            )
            for action in ranked[:MAX_ACTIONS]
        ]
        return WhatIf(
            run_id=recording.run_id,
            at=str(self._at),
            title=self._at.title,
            state=state,
            state_in_words=str(states_in_words(mdp)[state]),
            tables_step=self._tables.step,
            learners=recording.agents,
            policy=playing.policy_in_words,
            epsilon=playing.epsilon,
            discount=playing.discount,
            recorded=self._recorded,
            actions=tuple(sorted(rows, key=_rank)),
            left_out=len(ranked) - len(rows),
            notes=tuple(self._notes(rows, len(ranked) - len(rows))),
            mdp=mdp,
        )

    def _learned(self, state: int) -> list[tuple[float, ...]]:
        """Return the Q-values of each joint action in a state; empty tuples where nothing is learned."""
        if not self._learns:
            return [()] * self._mdp.joint_actions
        actions = self._tables.learner.model.own_action  # [J, learners]
        columns = [table[state, actions[:, i]].tolist() for i, table in enumerate(self._tables.tables)]
        return list(zip(*columns, strict=True))

    def _exact_values(self, state: int, policy: Floats) -> tuple[Floats, Floats]:
        """Return the values of each joint action under the policy, [J, learners], and the optimum, [J]."""
        mdp = self._mdp
        learners = len(self._recording.agents)
        discount = self._playing.discount
        if discount >= 1:
            return np.full((mdp.joint_actions, learners), np.nan), np.full(mdp.joint_actions, np.nan)
        values = policy_values(mdp, policy, learners, discount)
        best = optimal_values(mdp, discount)[:, np.newaxis]
        return (
            action_values(mdp, state, values, mdp.rewards_of(learners), discount),
            action_values(mdp, state, best, mdp.summed_rewards[..., np.newaxis], discount)[:, 0],
        )

    def _notes(self, rows: Sequence[ActionOutcome], left_out: int) -> Iterator[str]:
        """Yield what a reader must know about these figures, a sentence each."""
        if left_out:
            yield f"{counted(left_out, 'joint action')} of lower value left out; name some to see them"
        if self._at.after is None:
            yield (
                "nothing is learned after the step, so even the recorded action may lead elsewhere than it "
                "did, because training went on"
            )
        if self._playing.discount >= 1:
            yield "there are no exact values: with a discount of 1 a process without end has none"
        if any(row.end == "stopped" for row in rows):
            yield f"episodes that were not over after {MAX_STEPS:,} more steps were not played to their end"


def _summed(returns: Floats, steps: Records) -> Floats:
    """Return returns after more steps, added one by one, as the kernel does: equal to the last bit."""
    return np.asarray(np.cumsum(np.vstack([returns, steps["rewards"]]), axis=0)[-1])


def _rank(row: ActionOutcome) -> tuple[float, float, float, int]:
    """Return the key that sorts actions: by value, return and probability, the highest first."""
    value = sum(value for value in row.values if value is not None)
    return -round(value, 9), -sum(row.returns), -row.probability, row.action


# --- the episode played on ----------------------------------------------------------------------------


class _Continuation:
    """An episode played on from a recorded step, by the kernels that record episodes.

    The learner has the tables of that moment, which do not change. Schedules are read at a training episode
    and a training step.
    """

    def __init__(
        self, learner: Learner, step: Records, trained_episode: int, trained_step: int, is_trial: bool
    ) -> None:
        self._learner = learner
        self._step = step
        self._is_trial = is_trial
        self._trained = trained_episode, trained_step
        learner.begin_evaluation()
        rules = learner.segment_at(trained_step).rules
        self._settings = rules
        self._draws_actions = learner.algorithm.draws_actions
        # Without learning all other algorithms act alike; SARSA would take its next action as chosen already.
        algorithm = rules.algorithm if self._draws_actions else QLearning()
        self._rules = rules._replace(learns=False, algorithm=algorithm)

    @property
    def discount(self) -> float:
        """The discount at the moment."""
        return self._scheduled(self._settings.discount)

    @property
    def epsilon(self) -> float:
        """The probability of exploring at the moment; 1 of random agents."""
        rules = self._settings
        if self._is_trial:
            return 0.0 if rules.learns else 1.0
        epsilon = self._scheduled(rules.epsilon)
        return 1.0 - epsilon if rules.epsilon_exploits else epsilon

    @property
    def policy_in_words(self) -> str:
        """What acts from the moment on."""
        if not self._settings.learns:
            return "random"
        policy = "drawn from the learned policies" if self._draws_actions else "greedy"
        return policy if self._is_trial else f"{policy}, exploring with probability {self.epsilon:g}"

    @property
    def policy(self) -> Floats:
        """The probability of each joint action in each state, [S, J], with the epsilon of the moment."""
        learner, epsilon = self._learner, self.epsilon
        width = learner.model.width
        policy = learner.policy
        if isinstance(policy, np.ndarray):
            policies = [np.eye(n)[learner.tables.greedy[i]] for i, n in enumerate(width)]
        else:
            policies = policy
        if self._rules.independent:
            return joint_probabilities(
                [epsilon / n + (1 - epsilon) * table for n, table in zip(width, policies, strict=True)]
            )
        joint = joint_probabilities(policies)
        return epsilon / math.prod(width) + (1 - epsilon) * joint

    def play(self, action: int, steps: Records, episodes: Records) -> int:
        """Take a joint action, play on until the episode ends or `steps` is full, and return the steps taken.

        The action is taken whatever the policy would choose. `steps` are step records of the phase, filled;
        `episodes` is one episode record of the phase, overwritten.
        """
        learner = self._learner
        cursor = np.zeros(1, kernel.CURSOR)
        for name in ("step", "episode", "t", "state"):
            cursor[name] = self._step[name]
        tally = Tally(
            np.zeros(len(learner.agents)),
            np.zeros(len(learner.model.event_mask), np.int64),
            np.zeros(1, np.int32),
            np.zeros(1, np.int64),
        )
        play = self._evaluate if self._is_trial else self._train
        ends = kernel.Ends.of(episodes)
        filled, ended = play(action, cursor, tally, steps[:1], ends)
        if not ended and len(steps) > 1:
            more, ended = play(None, cursor, tally, steps[1:], ends)
            filled += more
        ends.put(episodes, ended)
        return int(filled)

    def _train(
        self, action: int | None, cursor: Records, tally: Tally, steps: Records, ends: kernel.Ends
    ) -> tuple[int, int]:
        learner = self._learner
        rules = self._rules
        tables = learner.tables
        if action is not None:  # greedy agents that prefer it take it
            state = int(self._step["state"])
            choices = learner.model.own_action[action]
            rules = rules._replace(epsilon=compile_schedule(0.0), epsilon_exploits=False)
            tables = tables._replace(greedy=tables.greedy.copy(), extra=tables.extra.copy())
            tables.greedy[:, state] = choices
            if self._draws_actions:
                for offset, width, choice in zip(tables.offset, learner.model.width, choices, strict=True):
                    row = tables.extra[POLICY, offset + state * width :][:width]
                    row[:] = np.arange(width) == choice
        fixed = (learner.seed, learner.model, tables, rules)
        until = int(self._step["episode"]) + 1
        filled, ended = kernel.train(cursor, *fixed, tally, steps, ends, until, NEVER, CHOSEN)
        return filled, ended

    def _evaluate(
        self, action: int | None, cursor: Records, tally: Tally, steps: Records, ends: kernel.Ends
    ) -> tuple[int, int]:
        learner = self._learner
        policy = learner.trial_actions
        state = int(self._step["state"])
        until = int(self._step["episode"]) + 1
        if action is not None:
            policy = policy.copy()
            policy[state] = action
        fixed = (learner.seed, learner.model, learner.tables, policy)
        filled, ended = kernel.evaluate(cursor, *fixed, tally, steps, ends, until, state)
        return filled, ended

    def _scheduled(self, schedule: Floats) -> float:
        return float(schedule_value(schedule, *self._trained))
