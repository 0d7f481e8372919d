"""Why a Q-value is what it is: the recorded rewards and the initial values that it is a weighted sum of.

    found = runner.why(run, state=300, action="north + south")
    for step in found.steps:
        print(step.at, step.reward, step.weight, step.contribution)

An update is linear in the tables once it is known which of their values it takes, and the recording
determines that. So the sum is exact: it is the value, but for the rounding of both.

The recorded steps are replayed once, and what decides the weights of each update goes into a temporary file.
That file is then read from its end, which gives the weights: see `learning.ledger`. So memory does not grow
with the run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from runner.analysis.episodes import EpisodeRef, StepLike
from runner.analysis.sections import Answer, Figure, Grid, Section
from runner.archive.places import opened
from runner.drawing import svg
from runner.drawing.svg_maps import Move, moves_map
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import (
    actions_in_words,
    events_in_words,
    exploration_in_words,
    joint_action,
    numbered_actions,
    own_action,
    spoken,
    state_of,
    states_in_words,
)
from runner.errors import ConfigError, MissingExtra, RecordingError, RunnerError, StorageError, nearest
from runner.execution.estimate import free_bytes
from runner.export.notebook import HEIGHT
from runner.export.reports.rendering import framed, page_style, partials
from runner.learning.algorithms import ALGORITHMS
from runner.learning.ledger import SHARE, UPDATE, Ledger, spread
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import last_step
from runner.replay.tables import TableReplay
from runner.runs.run import Run
from runner.util.arrays import Array, Floats, Records
from runner.util.files import storage_errors
from runner.util.humanize import size
from runner.util.processes import Report
from runner.util.values import Json

LIMIT: Final = 10
"""Steps that are listed by default."""
MAX_LIMIT: Final = 100_000
"""The most steps of an answer."""
_MAX_KINDS: Final = 100
"""Kinds of rewards of an answer; further ones are summed."""
_MAX_ROWS: Final = 12
"""Kinds of rewards in a table; further ones are summed."""
_STRETCHES: Final = 20
"""The most stretches of equally many episodes by which weights are summed."""
STEPS_AT_ONCE: Final = 1 << 18
_ROUNDING: Final = 1e-6
"""The largest difference from the table's value that is taken for rounding, as a share of what is added."""
_EXPLANATION: Final = (
    "This is a decomposition along the path that training took, not a counterfactual: `dualtaxi branch` "
    "shows what would have happened after another action or with other settings."
)
_KEY: Final = (
    "An arrow is as wide as the weight of all steps that made this move; a ring stands for staying in the "
    "cell, as after a move into a wall, or a pickup. Things are drawn where they are in the value's state."
)
_POLICY_NOTE: Final = (
    "WoLF-PHC acts by a policy, which is no such sum: its moves have a fixed size. This is the Q-value that "
    "tells the policy where to move."
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


def why(
    run: Run | Recording,
    *,
    state: int | str | None = None,
    action: int | str | None = None,
    agent: str | None = None,
    at: StepLike | None = None,
    limit: int = LIMIT,
    report: Report = lambda _: None,
) -> Why:
    """Return where a Q-value of a run comes from.

    Args:
        run: a run that was trained here, with its steps, or its open recording.
        state: the number of the state, or its name; by default that of the step `at`.
        action: the learner's own action, or the joint one of a joint table: its number, or its name such as
            `north + east`; by default the one taken at the step `at`.
        agent: the learner; required where there are several.
        at: the step before which the value is explained: `EPISODE:T` or `step:N` of training, or
            `eval:N:TRIAL:T`; by default after all of training.
        limit: the most steps to list, up to 100,000; 0 for that many.
        report: called with the number of steps read so far.

    Raises:
        ConfigError: there is no such state, action or agent, or the limit is too high.
        RecordingError: there is no such step, the steps were not recorded, or the recording is damaged.
        RunnerError: the run was recorded from a loop, or its algorithm has no Q-values or moves them in a way
            that cannot be followed.
        StorageError: the folder of temporary files cannot be written.
    """
    with opened(run) as recording:
        recording.require_job(
            "`why`",
            "`dualtaxi values` shows what a loop's checkpoint expects along a recorded episode.",
        )
        step = None if at is None else EpisodeRef.parse(at).resolved(recording)
        if refusal := why_refusal(recording):
            raise RunnerError(refusal)
        if not 0 <= limit <= MAX_LIMIT:
            raise ConfigError(f"limit: found {limit}, expected 0 to {MAX_LIMIT:,}.")
        mdp = recording.mdp
        is_joint = len(recording.agents) < len(mdp.agents)
        cell = _cell(recording, state, action, _learner(recording, agent), step)
        names = actions_in_words(mdp) if is_joint else numbered_actions(mdp)[cell.learner]
        stop = last_step(recording) if step is None else _steps_before(recording, step)
        weights = _weights_of(recording, cell, stop, limit or MAX_LIMIT, report)
        ledger = weights.ledger
        rewarded = ValuePart(*(float(total) for total in ledger.episodes.sum(axis=0)))
        initial = ValuePart(
            float(ledger.weights.sum()), float((ledger.weights * weights.initial_values).sum())
        )
        total = rewarded.contribution + initial.contribution
        _require_rounding(recording, weights, total)
        moves = tuple(_moves(mdp, ledger.outcomes, "" if is_joint else mdp.agents[cell.learner]))
        return Why(
            run_id=recording.run_id,
            agent=recording.agents[cell.learner],
            state=cell.state,
            state_in_words=str(states_in_words(mdp)[cell.state]),
            action=cell.action,
            action_in_words=str(names[cell.action]),
            step=stop,
            value=weights.value,
            total=total,
            counted=weights.counted,
            rewarded=rewarded,
            initial=initial,
            rewards=tuple(_by_reward(mdp, ledger.outcomes, cell.learner, len(recording.agents))),
            episodes=tuple(
                EpisodesPart(
                    weight,
                    contribution,
                    k * weights.stretch,
                    min((k + 1) * weights.stretch, weights.last_episode + 1),
                )
                for k, (weight, contribution) in enumerate(ledger.episodes.tolist())
            ),
            steps=tuple(_steps(recording, weights.largest, cell.learner)),
            moves=moves,
            note=_POLICY_NOTE if ALGORITHMS[recording.config["algorithm"]].draws_actions else "",
            picture=_picture(mdp, cell.state, moves),
        )


def _require_rounding(recording: Recording, weights: _Weights, total: float) -> None:
    """Check that a sum is the table's value, but for rounding in what was added.

    Raises:
        RunnerError: it is not: the algorithm's update cannot be followed.
    """
    rewarded = np.abs(weights.largest["contribution"]).sum()
    initial = np.abs(weights.ledger.weights * weights.initial_values).sum()
    if abs(total - weights.value) > _ROUNDING * (abs(weights.value) + float(rewarded + initial)):
        raise RunnerError(
            f"the parts of this value add up to {total:.9g}, but the table has {weights.value:.9g}. `why` "
            "follows algorithms in which a step moves a value by a share of its distance to the target, and "
            f"{recording.config['algorithm']} does not; choose a run of another one, such as q_learning."
        )


def why_refusal(recording: Recording) -> str:
    """Return why the Q-values of a job cannot be explained; empty if they can."""
    algorithm = recording.config["algorithm"]
    if algorithm == "random":
        return "Random agents learn no Q-values; choose a run of another algorithm."
    if ALGORITHMS[algorithm].remember:
        return (
            f"`why` cannot follow {algorithm}, where a step changes the values of earlier steps; choose a "
            "run of an algorithm where a step changes only its own value, such as q_learning."
        )
    return ""


def _cell(
    recording: Recording,
    state: int | str | None,
    action: int | str | None,
    learner: int,
    at: EpisodeRef | None,
) -> _Cell:
    """Return the place of the value of a state and an action, by default those of a step.

    Raises:
        ConfigError: one of them is missing, and no step is given.
    """
    mdp = recording.mdp
    is_joint = len(recording.agents) < len(recording.mdp.agents)
    if state is None or action is None:
        if at is None:
            raise ConfigError("found no state or no action, expected both, or a step to take them from.")
        (block,) = at.steps_in(recording).rows(at.t, at.t + 1)
        mdp.check_steps(block, str(recording.path), schema.PHASE_NAMES[at.phase])
        taken = block[0]
        taken_action = taken["action"] if is_joint else mdp.own_actions[taken["action"], learner]
        state = str(taken["state"]) if state is None else state
        action = str(taken_action) if action is None else action
    number = joint_action(mdp, str(action)) if is_joint else own_action(mdp, learner, str(action))
    return _Cell(learner, state_of(mdp, str(state)), number)


def _learner(recording: Recording, agent: str | None) -> int:
    """Return the number of the learner with a name, or of the only one."""
    learners = recording.agents
    if agent is None and len(learners) == 1:
        return 0
    names = [name for name in learners if agent in (name, spoken(name))]
    if not names:
        given_agent = "no agent" if agent is None else f"the agent {agent[:60]!r}"
        raise ConfigError(
            f"agent: found {given_agent}, expected {' or '.join(learners)}, whose Q-table has the value."
            f"{nearest(agent or '', learners)}"
        )
    return learners.index(names[0])


def _steps_before(recording: Recording, at: EpisodeRef) -> int:
    """Return the training steps that the tables at a step have learned from."""
    if at.after is not None:
        return at.evaluation_in(recording).train_step
    return at.steps_in(recording, with_end=True).first + at.t


def _by_reward(mdp: Mdp, outcomes: Floats, learner: int, learners: int) -> Iterator[RewardPart]:
    """Yield the parts of a Q-value by kind of reward."""
    at = np.unravel_index(np.flatnonzero(outcomes), mdp.next_state.shape)
    kinds = np.stack([mdp.rewards_of(learners)[(*at, learner)], mdp.events[at]], axis=1)
    parts = sorted(
        (
            RewardPart(weight, weight * reward, reward, events_in_words(mdp, int(events)))
            for (reward, events), weight in _summed(kinds, outcomes[outcomes != 0])
        ),
        key=lambda part: (-abs(part.contribution), -part.weight),
    )
    yield from parts[:_MAX_KINDS]
    if rest := parts[_MAX_KINDS:]:
        yield RewardPart(sum(part.weight for part in rest), sum(part.contribution for part in rest), None, "")


def _steps(recording: Recording, largest: Records, learner: int) -> Iterator[StepPart]:
    """Yield the steps of some shares, in their order."""
    mdp = recording.mdp
    states, actions = states_in_words(mdp), actions_in_words(mdp)
    records = {}
    for step in sorted(largest["step"].tolist()):  # each chunk is read once, and not kept
        records[step] = next(recording.train.steps.blocks(step, step + 1))[0].copy()
    for share in largest:
        record = records[int(share["step"])]
        fields = ["state", "action", "next_state", "episode", "t", "explored"]
        state, action, next_state, episode, t, explored = record[fields].tolist()
        yield StepPart(
            weight=float(share["weight"]),
            contribution=float(share["contribution"]),
            at=str(EpisodeRef(episode, t)),
            step=int(share["step"]),
            episode=episode,
            state=state,
            state_in_words=str(states[state]),
            action=action,
            action_in_words=str(actions[action]),
            next_state=next_state,
            reward=float(record["rewards"][learner]),
            events=events_in_words(mdp, int(events_of(mdp, record.reshape(1))[0])),
            explored=exploration_in_words(explored, recording.agents),
            distance=float(share["distance"]),
        )


def _moves(mdp: Mdp, outcomes: Floats, agent: str) -> Iterator[Move]:
    """Yield the weight of the moves of an agent, or of all agents if it is empty, thing by thing."""
    if mdp.scene is None or mdp.scene_cells is None:
        return
    seen_outcomes = np.flatnonzero(outcomes)
    state, action, k = np.unravel_index(seen_outcomes, mdp.next_state.shape)
    next_state = mdp.next_state[state, action, k]
    for number, thing in enumerate(mdp.scene["things"]):
        if thing["kind"] == "mover" and (not agent or thing.get("agent") in (None, agent)):
            cells = np.stack([mdp.scene_cells[state, number], mdp.scene_cells[next_state, number]], axis=1)
            for (start, stop), weight in _summed(cells, outcomes[seen_outcomes]):
                yield Move(number, start, stop, weight)


def _summed(rows: Array, weights: Floats) -> Iterator[tuple[Any, float]]:
    """Return each distinct row with the sum of its weights."""
    distinct, row_of = np.unique(rows, axis=0, return_inverse=True)
    return zip(distinct.tolist(), np.bincount(row_of.reshape(-1), weights).tolist(), strict=True)


def _picture(mdp: Mdp, state: int, moves: Sequence[Move]) -> str:
    """Return the moves on the grid, with the things as they are in a state; empty without a scene."""
    drawing = svg.drawing_of(mdp)
    if drawing is None or mdp.scene is None:
        return ""
    positions = drawing.places(mdp, np.array([state]))[0]
    return moves_map(mdp.scene, moves, positions, "The moves by which the value was learned, by weight")


# --- weights of rewards and initial values ------------------------------------------------------------


class _Cell(NamedTuple):
    """The place of a Q-value."""

    learner: int
    state: int
    action: int


@dataclass(frozen=True, eq=False)
class _Weights:
    """The weights of a Q-value."""

    value: float
    """The Q-value in the replayed table."""
    initial_values: Floats
    """[tables, S * width]."""
    ledger: Ledger
    """The weights of the initial values, and of the rewards by outcome and by stretch of episodes."""
    stretch: int
    """Episodes of a stretch."""
    last_episode: int
    """The episode of the last step."""
    counted: int
    """Number of steps whose rewards have a weight."""
    largest: Records
    """[limit] of `SHARE`: the steps that add or take most, these first."""


def _weights_of(recording: Recording, cell: _Cell, stop: int, limit: int, report: Report) -> _Weights:
    """Return the weights of a Q-value after a number of training steps of a job that learns.

    `limit` is the most steps in `_Weights.largest`; `report` is called with the number of steps read so far.

    Raises:
        StorageError: the temporary file cannot be written.
    """
    replay = TableReplay(recording)
    learner = replay.learner
    model = replay.learner.model
    tables = learner.algorithm.tables if learner.algorithm.is_double else ("q",)
    initial_values = np.stack([replay.named_tables[cell.learner][name].reshape(-1) for name in tables])
    advice = "set TMPDIR to a folder with more space"
    free = free_bytes(Path(tempfile.gettempdir()))
    if stop * UPDATE.itemsize > free:
        raise StorageError(
            f"{tempfile.gettempdir()}: has {size(free)} free, and {size(stop * UPDATE.itemsize)} are needed "
            f"for a temporary file; {advice}."
        )
    with storage_errors("a temporary file", advice), tempfile.TemporaryFile() as spool:
        episode = 0
        for updates in _updates(recording, replay, cell.learner, stop):
            spool.write(updates.view(np.uint8).data)
            episode = int(updates["episode"][-1])
            report(replay.step)
        stretch = episode // _STRETCHES + 1
        ledger = Ledger(
            np.zeros_like(initial_values),
            np.zeros_like(initial_values),
            np.zeros(len(model.next_state)),
            np.zeros((episode // stretch + 1, 2)),
        )
        ledger.weights[:, cell.state * model.width[cell.learner] + cell.action] = 1 / len(tables)
        counted = 0
        largest = np.empty(0, SHARE)
        shares = np.empty(min(stop, STEPS_AT_ONCE), SHARE)
        for start in reversed(range(0, stop, STEPS_AT_ONCE)):
            updates = np.empty(min(STEPS_AT_ONCE, stop - start), UPDATE)
            spool.seek(start * UPDATE.itemsize)
            spool.readinto(updates.view(np.uint8).data)
            end = start + len(updates)
            while end > start:  # from branch to branch: each changes the rules
                segment = learner.segment_at(end - 1)
                first = max(segment.start, start)
                filled = spread(
                    model,
                    segment.rules,
                    cell.learner,
                    first,
                    updates[first - start : end - start],
                    ledger,
                    stretch,
                    shares,
                )
                counted += filled
                added = shares[:filled]
                largest = np.concatenate([largest, added[added["contribution"] != 0]])
                order = np.lexsort((largest["step"], -np.abs(largest["contribution"])))
                largest = largest[order[:limit]]
                end = first
    return _Weights(
        value=float(replay.tables[cell.learner][cell.state, cell.action]),
        initial_values=initial_values,
        ledger=ledger,
        stretch=stretch,
        last_episode=episode,
        counted=counted,
        largest=largest,
    )


def _updates(recording: Recording, replay: TableReplay, learner: int, stop: int) -> Iterator[Records]:
    """Yield what decides the weights of a learner's updates up to a step, in parts of `STEPS_AT_ONCE`.

    Raises:
        RecordingError: the numbers of the steps' episodes decrease; compiled code uses them as indices.
    """
    episode = 0
    while replay.step < stop:
        first = replay.step
        updates = replay.updates(min(first + STEPS_AT_ONCE, stop), learner)
        episodes = updates["episode"]
        if episodes[0] < episode or (episodes[1:] < episodes[:-1]).any():
            raise RecordingError(
                f"{recording.path}: found decreasing numbers of episodes from training step {first} on; "
                "`dualtaxi verify` checks the whole recording."
            )
        episode = episodes[-1]
        yield updates


# --- as text ------------------------------------------------------------------------------------------


def _parts_of(answer: Why) -> list[Section]:
    all_weight = answer.rewarded.weight + answer.initial.weight

    def cells(part: ValuePart) -> tuple[str, str, str]:
        share = 100 * part.weight / all_weight if all_weight else 0.0
        return f"{part.contribution:+.4g}", f"{part.weight:.4g}", f"{share:.3g} %"

    columns = ("adds", "weight", "of all weight")
    sums = [
        (f"rewards of {answer.counted:,} of {answer.step:,} steps", *cells(answer.rewarded)),
        ("initial values", *cells(answer.initial)),
        ("sum", f"{answer.total:.9g}", f"{all_weight:.4g}", ""),
    ]
    rest = answer.rewards[_MAX_ROWS:]
    rewards = [
        ("other rewards" if part.reward is None else f"{part.reward:+g}", part.events or "none", *cells(part))
        for part in answer.rewards[:_MAX_ROWS]
    ]
    if rest:
        others = ValuePart(sum(part.weight for part in rest), sum(part.contribution for part in rest))
        rewards.append((f"{len(rest)} other kinds", "", *cells(others)))
    off = "It equals the table's value."
    if answer.total != answer.value:
        off = f"It differs from the table's value by {abs(answer.total - answer.value):.1g}, by rounding."
    largest = Section("The steps that add or take most", ["No reward adds to the value or takes from it."])
    if answer.steps:
        headings = ("step", "state", "action", "reward", *columns, "steps away")
        links = [EpisodeRef.parse(part.at).replay for part in answer.steps]
        steps = [_step(part, cells(part)) for part in answer.steps]
        largest = Section(largest.title, [], [Grid(headings, steps, links=links)])
    episodes = [part for part in answer.episodes if part.weight or part.contribution]
    without = len(answer.episodes) - len(episodes)
    left_out = (
        f"{without:,} of {len(answer.episodes):,} stretches of episodes have no weight and are left out."
    )
    sections = [
        Section(
            "The sum",
            [off, _EXPLANATION, *([answer.note] if answer.note else [])],
            [Grid(("", *columns), sums)],
            figures=[Figure(answer.picture, _KEY)] if answer.picture else [],
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
