"""One run's learner: the kernel with its arrays, and measures of them at any moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from runner.config import ExperimentConfig
from runner.config.model import SECTION_OF
from runner.config.sections import RandomTable
from runner.environments.mdp import Mdp
from runner.environments.naming import agent_of, own_action
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.learning import kernel
from runner.learning.algorithms import ALGORITHMS, Memory, Rules, Tables
from runner.learning.kernel import Tally
from runner.learning.model import Model, build_model
from runner.learning.schedules import compile_schedule, schedule_value
from runner.util.arrays import Floats, Ints, Ints32, Records

NEVER: Final = 2**62
"""A step that no training reaches."""
CHOSEN: Final = np.empty(0, np.int32)
"""As `Segment.replacement`: agents take the actions that they choose."""

NamedTables = Mapping[str, Floats]
"""The tables of one learner: its Q-table as `q`, and the other `tables` of its algorithm by name."""


class Segment(NamedTuple):
    """Training steps under the same settings, from a branch, or the beginning, up to the next branch."""

    start: int
    """The first step."""
    stop: int
    """The step after the last one."""
    rules: Rules
    replacement: Ints32
    """[J]: the joint action that is taken at `start` instead of each one chosen; empty to take the chosen."""


class Learner:
    """Tables, cursors and tallies of one job; `train` and `evaluate` fill blocks of records.

    Args:
        initial: tables of each learner to start from instead of `config.initial_q`, as of `named_tables`.
    """

    def __init__(
        self, config: ExperimentConfig, mdp: Mdp, seed: int, initial: Sequence[NamedTables] | None = None
    ) -> None:
        self.config = config
        self.mdp = mdp
        self.seed = np.uint64(seed)
        self.model: Model = build_model(mdp, config.tables)
        self.agents = ("agency",) if config.tables == "joint" and len(mdp.agents) > 1 else mdp.agents
        self._segments = _segments(config, mdp)
        self._cursor = np.zeros(1, kernel.CURSOR)
        _check_fit(config, mdp, self.model)
        self.algorithm = ALGORITHMS[config.algorithm]
        self.kinds = kinds_of(config)
        sizes = [width * mdp.states for width in self.model.width]
        capacity = self.algorithm.capacity(self.rules.algorithm, max(sizes))
        self.tables = _tables(sizes, mdp.states, self.kinds, capacity)
        self.set_tables(initial)
        log = config.log
        self._tally = _tally(self.model, log.window if log else 1, log.episodes if log else 50)
        self._eval_tally = _tally(self.model, 1, 1)
        self._eval_cursor = np.zeros(1, kernel.CURSOR)
        self.trial_actions = np.zeros(mdp.states, np.int32)
        """The joint action of each state in the present evaluation, [S], or how it is drawn: see `kernel`."""
        self._start = _trial_start(config, mdp)
        self._success = np.array([name in mdp.success_events for name in mdp.event_names], dtype=np.bool_)

    @property
    def rules(self) -> Rules:
        """The switches and schedules of the next training step."""
        return self.segment_at(self.step).rules

    def segment_at(self, step: int) -> Segment:
        """Return the segment of training that a step belongs to."""
        return next(segment for segment in reversed(self._segments) if segment.start <= step)

    @property
    def step(self) -> int:
        """Training steps taken."""
        return int(self._cursor["step"][0])

    @property
    def episode(self) -> int:
        """Training episodes done."""
        return int(self._cursor["episode"][0])

    def table(self, i: int) -> Floats:
        """Return learner i's Q-table as it is now, [S, width]: a view.

        These are the values that greedy actions follow; of Double Q-learning the mean of both tables.
        """
        return self._of(i, self.tables.q)

    def named_tables(self, i: int) -> NamedTables:
        """Return all tables of learner i as they are now, [S, width] each and visits [S, 1]: views."""
        tables: dict[str, Floats] = {"q": self.table(i)}
        for name, array in zip(self.kinds[1:], self.tables.extra, strict=False):
            tables[name] = self._of(i, array)
        if "visits" in self.kinds:
            tables["visits"] = self.tables.visits[i][:, np.newaxis]
        return tables

    def snapshot(self) -> list[Floats]:
        """Return all tables as a snapshot numbers them, those of one kind together: views."""
        return [self.named_tables(i)[name] for name in self.kinds for i in range(len(self.agents))]

    def _of(self, i: int, array: Floats) -> Floats:
        start, width = int(self.tables.offset[i]), int(self.model.width[i])
        return array[start : start + self.mdp.states * width].reshape(-1, width)

    def train(
        self, steps: Records, episodes: Records, until_episode: int, until_step: int
    ) -> tuple[int, int]:
        """Train until a block is full, or an episode or step is reached; return (steps, episodes) filled.

        A branch on the way fills a block too.
        """
        segment = self.segment_at(self.step)
        replacement = segment.replacement if segment.start == self.step else CHOSEN
        ends = kernel.Ends.of(episodes)
        filled, ended = kernel.train(
            self._cursor,
            self.seed,
            self.model,
            self.tables,
            segment.rules,
            self._tally,
            steps[:1] if len(replacement) else steps,
            ends,
            until_episode,
            min(until_step, segment.stop),
            replacement,
        )
        ends.put(episodes, ended)
        self._mark_success(episodes[:ended])
        return filled, ended

    def begin_evaluation(self, trial: int | None = None) -> None:
        """Fix the policy to evaluate: greedy in the present tables, the learned one, or random.

        The next trial is number `trial`, counted over the run; by default the one after the last.
        """
        if trial is not None:
            self._eval_cursor["episode"] = trial
        if not self.rules.learns or self.algorithm.draws_actions:
            self.trial_actions.fill(kernel.DRAWN if self.rules.learns else -1)
            return
        self.trial_actions[:] = (self.tables.greedy.T * np.array(self.model.stride)).sum(axis=1)

    @property
    def policy(self) -> Ints32 | list[Floats]:
        """The policy of the present evaluation.

        The joint action of each state, [S]; of an algorithm that draws its actions one array a learner,
        [S, width]: the probability of each of its own actions.
        """
        if not self.rules.learns:
            return [np.full((self.mdp.states, width), 1 / width) for width in self.model.width]
        if self.algorithm.draws_actions:
            policies = [self.named_tables(i)["policy"] for i in range(len(self.agents))]
            return [policy / policy.sum(axis=1, keepdims=True) for policy in policies]
        return self.trial_actions

    def evaluate(self, steps: Records, episodes: Records, until_episode: int) -> tuple[int, int]:
        """Play trials until a block is full or trial `until_episode` (counted over the run) is reached."""
        ends = kernel.Ends.of(episodes)
        filled, ended = kernel.evaluate(
            self._eval_cursor,
            self.seed,
            self.model,
            self.tables,
            self.trial_actions,
            self._eval_tally,
            steps,
            ends,
            until_episode,
            self._start,
        )
        ends.put(episodes, ended)
        self._mark_success(episodes[:ended])
        return filled, ended

    def training_metrics(self, of_tables: Mapping[str, Callable[[Floats], float]]) -> dict[str, object]:
        """Return the measures of training at this moment, named as in the recording's metrics.

        They have the summed rewards of the last steps, ascending, and how often each came.

        Args:
            of_tables: by name, what is computed from each learner's table, [states, actions].
        """
        window = self._tally.recent_outcomes[: min(self.step, len(self._tally.recent_outcomes))]
        by_class = np.bincount(window, minlength=len(self.model.rewards))
        rewards, where = self._distinct_rewards
        counts = np.bincount(where, weights=by_class, minlength=len(rewards)).astype(np.int64)
        seen = counts > 0
        lengths = self._tally.recent_lengths[: min(self.episode, len(self._tally.recent_lengths))]
        tables = [self.table(i) for i in range(len(self.agents))]
        epsilon = float(schedule_value(self.rules.epsilon, self.episode, self.step))
        return {
            "step": self.step,
            "episode": self.episode,
            "mean_length": float(lengths.mean()) if len(lengths) else float("nan"),
            "rewards": rewards[seen].tolist(),
            "reward_counts": counts[seen].tolist(),
            **{name: list(map(measure, tables)) for name, measure in of_tables.items()},
            "epsilon": 1.0 - epsilon if self.rules.epsilon_exploits else epsilon,
            "step_size": float(schedule_value(self.rules.step_size, self.episode, self.step)),
            "discount": float(schedule_value(self.rules.discount, self.episode, self.step)),
        }

    @cached_property
    def _distinct_rewards(self) -> tuple[Floats, Ints]:
        """The summed rewards, ascending, and for each outcome class which it is; a shared one counts once."""
        shared = self.mdp.rewards.shape[-1] == 1
        summed = self.model.rewards[:, 0] if shared else self.model.rewards.sum(axis=1)
        rewards, where = np.unique(summed, return_inverse=True)
        return rewards, where

    def _mark_success(self, episodes: Records) -> None:
        if self._success.any():
            episodes["success"] = episodes["events"][:, self._success].any(axis=1)

    def set_tables(self, initial: Sequence[NamedTables] | None) -> None:
        """Set the tables of each learner; None for those that the configuration begins with.

        What `initial` leaves out follows from its `q`: both tables of Double Q-learning are equal to it, and
        a policy of WoLF-PHC is uniform.
        """
        double = self.algorithm.is_double
        if initial is None:
            self._fill(self.tables.extra.reshape(-1) if double else self.tables.q)
        for i in range(len(self.agents)):
            given = {} if initial is None else initial[i]
            for name, array in self.named_tables(i).items():
                if name in given:
                    array[:] = given[name]
                elif name == "visits":
                    array[:] = 0.0
                elif name in ("policy", "average_policy"):
                    array[:] = 1.0 / array.shape[1]
                elif "q" in given:
                    array[:] = given["q"]
        if double:
            self.tables.q[:] = 0.5 * (self.tables.extra[0] + self.tables.extra[1])
        for i in range(len(self.model.width)):
            self.tables.greedy[i] = self.table(i).argmax(axis=1)
            self.tables.value[i] = self.table(i).max(axis=1)

    def _fill(self, cells: Floats) -> None:
        """Fill cells with the configured initial values; 0 where it names another run's tables."""
        start = self.config.initial_q
        if isinstance(start, RandomTable):
            kernel.fill_random(cells, self.seed, start.random.low, start.random.high)
        else:
            cells[:] = start if isinstance(start, int | float) else 0.0


def _trial_start(config: ExperimentConfig, mdp: Mdp) -> int:
    """Return the kernel's code of where trials start."""
    start = config.evaluation.start if config.evaluation else "random"
    if isinstance(start, str):
        return kernel.START_EACH if start == "each" else kernel.START_RANDOM
    if start >= mdp.states:
        raise ConfigError(f"evaluation.start: found state {start}, expected one of 0 to {mdp.states - 1}.")
    return start


def rules_of(config: ExperimentConfig) -> Rules:
    """Return the kernel's switches and schedules of an experiment."""
    learns = config.algorithm != "random"
    step_size, discount = compile_schedule(config.step_size), compile_schedule(config.discount)
    epsilon = compile_schedule(config.epsilon if learns else 1.0)
    sections = (
        getattr(config, key)
        for key, section_info in SECTION_OF.items()
        if section_info.algorithm == config.algorithm
    )
    settings = {key: compile_schedule(value) for section in sections if section for key, value in section}
    return Rules(
        algorithm=ALGORITHMS[config.algorithm].settings(**settings),
        step_size=step_size,
        discount=discount,
        epsilon=epsilon,
        by_step=any(bool(schedule[1]) for schedule in (step_size, discount, epsilon)),
        learns=learns,
        independent=config.exploration == "independent",
        epsilon_exploits=config.quirks.epsilon_exploits and learns,
        first_action_for_all=config.quirks.second_table_uses_first_action,
        bootstrap_after_termination=config.quirks.bootstrap_after_termination,
    )


def _segments(config: ExperimentConfig, mdp: Mdp) -> list[Segment]:
    """Return the segments of an experiment's training, in order."""
    starts = sorted({0, *(branch.step for branch in config.branches)})
    return [
        Segment(start, stop, rules_of(config.from_step(start)), _replacement(config, mdp, start))
        for start, stop in zip(starts, [*starts[1:], NEVER], strict=True)
    ]


def _replacement(config: ExperimentConfig, mdp: Mdp, step: int) -> Ints32:
    """Return the joint action to take instead of each one, [J], where branches set it; else empty."""
    actions_by_agent = {
        agent: action
        for branch in config.branches
        if branch.step == step
        for agent, action in branch.actions.items()
    }
    if not actions_by_agent:
        return CHOSEN
    actions = mdp.own_actions.copy()
    for agent, action in actions_by_agent.items():
        number = agent_of(mdp, agent)
        actions[:, number] = own_action(mdp, number, action)
    replacement: Ints32 = np.ravel_multi_index(tuple(actions.T), mdp.action_counts).astype(np.int32)
    return replacement


def kinds_of(config: ExperimentConfig) -> tuple[str, ...]:
    """Return the names of each learner's tables in an experiment, in the order of a snapshot."""
    return ("q", *ALGORITHMS[config.algorithm].tables)


def name_tables(tables: Sequence[Floats], kinds: tuple[str, ...]) -> list[NamedTables]:
    """Return the tables of a whole snapshot by learner and name."""
    learners = len(tables) // len(kinds)
    return [{name: tables[k * learners + i] for k, name in enumerate(kinds)} for i in range(learners)]


def _check_fit(config: ExperimentConfig, mdp: Mdp, model: Model) -> None:
    """Refuse an experiment that would fail, or never end, in this environment."""
    if config.quirks.second_table_uses_first_action and len(set(model.width)) > 1:
        # The kernel would write outside a row.
        raise EnvironmentNotUsable(
            "quirks.second_table_uses_first_action needs agents with equally many actions, found "
            f"{' and '.join(map(str, model.width))}: leave the quirk out."
        )
    if config.evaluation is not None and mdp.step_limit == 0:
        raise EnvironmentNotUsable(
            f"environment {mdp.env_id!r} has no step limit, so that a greedy trial may never end: set one "
            "(`env.kwargs.max_episode_steps: 200`), or leave evaluation out (`evaluation: null`)."
        )


def _tables(sizes: list[int], states: int, kinds: tuple[str, ...], capacity: int) -> Tables:
    learners = len(sizes)
    return Tables(
        q=np.zeros(sum(sizes)),
        offset=tuple(sum(sizes[:i]) for i in range(learners)),
        greedy=np.zeros((learners, states), np.int32),
        value=np.zeros((learners, states)),
        extra=np.zeros((2 if len(kinds) > 1 else 0, sum(sizes))),
        visits=np.zeros((learners if "visits" in kinds else 0, states)),
        memory=Memory(
            count=np.zeros(learners, np.int64),
            cells=np.zeros((learners, capacity), np.int64),
            numbers=np.zeros((learners, capacity)),
        ),
    )


def _tally(model: Model, window: int, episodes: int) -> Tally:
    return Tally(
        returns=np.zeros(len(model.width)),
        event_classes=np.zeros(len(model.event_mask), np.int64),
        recent_outcomes=np.zeros(window, np.int32),
        recent_lengths=np.zeros(episodes, np.int64),
    )
