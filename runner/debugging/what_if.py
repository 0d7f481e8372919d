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
from dataclasses import dataclass
from typing import Final

import numpy as np

from runner.analysis.contents import ending_of, require_steps
from runner.analysis.episodes import EpisodeRef, StepLike
from runner.archive.places import opened
from runner.debugging.action_outcomes import ActionOutcome, Outcome, WhatIf
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import actions_in_words, agent_of, joint_action, own_action, states_in_words
from runner.export.reports.playback import Playback, tabular_playback
from runner.learning import kernel
from runner.learning.algorithms import POLICY, QLearning
from runner.learning.kernel import Tally
from runner.learning.learner import CHOSEN, NEVER, Learner
from runner.learning.schedules import compile_schedule, schedule_value
from runner.planning.evaluation import action_values, joint_probabilities, policy_values
from runner.planning.optimum import optimal_values
from runner.recording import schema
from runner.recording.layout import blank_records
from runner.recording.reader import Recording
from runner.replay.steps import episode_blocks, steps_of
from runner.replay.tables import TableReplay
from runner.runs.run import Run
from runner.util.arrays import Floats, Records
from runner.util.humanize import counted
from runner.util.values import finite

# --- the episode played on ----------------------------------------------------------------------------


class Continuation:
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
        # Without learning all others act alike; SARSA would expect that its next action is chosen already.
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
            own = [np.eye(n)[learner.tables.greedy[i]] for i, n in enumerate(width)]
        else:
            own = policy
        if self._rules.independent:
            return joint_probabilities(
                [epsilon / n + (1 - epsilon) * table for n, table in zip(width, own, strict=True)]
            )
        joint = joint_probabilities(own)
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
        tables = self._learner.tables
        if action is not None:  # greedy agents that prefer it take it
            state = int(self._step["state"])
            own = learner.model.own_action[action]
            rules = rules._replace(epsilon=compile_schedule(0.0), epsilon_exploits=False)
            tables = tables._replace(greedy=tables.greedy.copy(), extra=tables.extra.copy())
            tables.greedy[:, state] = own
            if self._draws_actions:
                for offset, width, choice in zip(tables.offset, learner.model.width, own, strict=True):
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
        policy = self._learner.trial_actions
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


# --- the branches of a step ---------------------------------------------------------------------------

ALL: Final = "all"
"""Stands for every joint action."""
MAX_STEPS: Final = 100_000
"""Steps that an action is played on for where the environment has no step limit."""
MAX_ACTIONS: Final = 256
"""Actions that are played on; of more, those of the highest value."""


@dataclass(frozen=True)
class Branched:
    """The episode to which an action leads."""

    at: EpisodeRef
    """The recorded step."""
    steps: Records
    """Those up to the branch as they were recorded, then those played."""
    outcome: Outcome
    tables: list[Floats]
    """The Q-tables of each learner that the branch was played with, [S, actions]; empty if there are none."""


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
    for i, own in enumerate(mdp.own_actions.T):
        values = [own_action(mdp, i, value) for name, _, value in pairs if agent_of(mdp, name) == i]
        allowed[:, i] = np.isin(own, values) if values else True
    chosen: list[int] = np.flatnonzero(allowed.all(axis=1)).tolist()
    return chosen


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
    shown = branch.steps[first : first + limit]
    if not len(shown):
        raise branch.at.no_step(recording, len(branch.steps), first, "this branch of ")
    values = tuple(table[shown["state"]] for table in branch.tables)
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
        self._read_episode()
        trained_episode = at.episode
        trained_step = int(self._step["step"])
        if at.after is not None:
            trained_episode = at.after
            trained_step = at.evaluation_in(recording).train_step
        self._tables = TableReplay(recording, trained_step)
        self._playing = Continuation(
            self._tables.learner, self._step, trained_episode, trained_step, at.after is not None
        )

    def _read_episode(self) -> None:
        """Read the step, what came before it, and where the episode led."""
        recording = self._recording
        phase = self._at.phase
        episode = self._number
        t = self._at.t
        length = len(self._at.steps_in(recording))
        self._returns = np.zeros(len(recording.agents))
        self._succeeded = False
        done = 0
        returns = self._returns
        for block in episode_blocks(recording, phase, episode):
            self._mdp.check_steps(block, str(recording.path), schema.PHASE_NAMES[phase])
            before = block[: max(0, t - done)]
            self._returns = _summed(self._returns, before)
            self._succeeded |= self._has_success(before)
            if done <= t < done + len(block):
                self._step = block[t - done].copy()
            returns = _summed(returns, block)
            done += len(block)
        self._recorded = Outcome(tuple(returns.tolist()), length, ending_of(recording, phase, episode))

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
        blocks = [
            blank_records(topic, recording.layout.message(topic), count).view(np.recarray)
            for topic, count in zip(schema.PHASES[phase], (limit, 1), strict=True)
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
        own = self._tables.learner.model.own_action  # [J, learners]
        columns = [table[state, own[:, i]].tolist() for i, table in enumerate(self._tables.tables)]
        return list(zip(*columns, strict=True))

    def _exact_values(self, state: int, policy: Floats) -> tuple[Floats, Floats]:
        """Return the values of each joint action under the policy, [J, learners], and the optimum, [J]."""
        mdp = self._mdp
        learners = len(self._recording.agents)
        discount = self._playing.discount
        if discount >= 1:
            return np.full((mdp.joint_actions, learners), np.nan), np.full(mdp.joint_actions, np.nan)
        own = policy_values(mdp, policy, learners, discount)
        best = optimal_values(mdp, discount)[:, np.newaxis]
        return (
            action_values(mdp, state, own, mdp.rewards_of(learners), discount),
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
