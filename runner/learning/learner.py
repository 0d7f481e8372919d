"""One run's learner: the kernel with its arrays, and what can be said of them at any moment."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.config import ExperimentConfig
from runner.config.model import RandomTable
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.learning import kernel
from runner.learning.kernel import Rules, Tables, Tally
from runner.learning.model import Model, build_model
from runner.learning.schedules import compile_schedule, schedule_value
from runner.mdp import Mdp


class Learner:
    """Tables, cursors and tallies of one job; `train` and `evaluate` fill blocks of records.

    Args:
        config: the experiment.
        mdp: its environment.
        seed: fixes every draw.
        initial: tables to start from instead of `config.initial_q`, a float64 [S, width] a learner.
    """

    def __init__(
        self, config: ExperimentConfig, mdp: Mdp, seed: int, initial: list[NDArray[np.float64]] | None = None
    ) -> None:
        self.config = config
        self.mdp = mdp
        self.seed = np.uint64(seed)
        self.model: Model = build_model(mdp, config.tables)
        self.agents = ("agency",) if config.tables == "joint" and len(mdp.agents) > 1 else mdp.agents
        self.rules = rules_of(config)
        _check_fit(config, mdp, self.model)
        self.tables = _tables(self.model, mdp.states)
        self.set_tables(initial)
        log = config.log
        self._tally = _tally(self.model, log.window if log else 1, log.episodes if log else 50)
        self._eval_tally = _tally(self.model, 1, 1)
        self._cursor = np.zeros(1, kernel.CURSOR).view(np.recarray)
        self._eval_cursor = np.zeros(1, kernel.CURSOR).view(np.recarray)
        self._policy = np.zeros(mdp.states, np.int32)
        self._start = _trial_start(config, mdp)
        self._success = np.array([name in mdp.success_events for name in mdp.event_names], dtype=np.bool_)

    @property
    def step(self) -> int:
        """Training steps taken."""
        return int(self._cursor.step[0])

    @property
    def episode(self) -> int:
        """Training episodes done."""
        return int(self._cursor.episode[0])

    def table(self, i: int) -> NDArray[np.float64]:
        """Return learner i's Q-table as it is now, [S, width]: a view."""
        start, width = int(self.tables.offset[i]), int(self.model.width[i])
        return self.tables.q[start : start + self.mdp.states * width].reshape(-1, width)

    def train(
        self, steps: NDArray[np.void], episodes: NDArray[np.void], until_episode: int, until_step: int
    ) -> tuple[int, int]:
        """Train until a block is full, or an episode or step is reached; return (steps, episodes) filled."""
        filled, ended = kernel.train(
            self._cursor,
            self.seed,
            self.model,
            self.tables,
            self.rules,
            self._tally,
            steps,
            episodes,
            until_episode,
            until_step,
        )
        self._mark_success(episodes[:ended])
        return filled, ended

    def begin_evaluation(self) -> None:
        """Fix the policy to be evaluated: greedy in the tables as they are, or random."""
        if not self.rules.learns:
            self._policy.fill(-1)
            return
        self._policy[:] = (self.tables.greedy.T * np.array(self.model.stride)).sum(axis=1)

    @property
    def policy(self) -> NDArray[np.int32]:
        """The joint action of each state, [S], in the evaluation that was begun; -1 for a random one."""
        return self._policy

    def evaluate(
        self, steps: NDArray[np.void], episodes: NDArray[np.void], until_episode: int
    ) -> tuple[int, int]:
        """Play trials until a block is full or trial `until_episode` (counted over the run) is reached."""
        filled, ended = kernel.evaluate(
            self._eval_cursor,
            self.seed,
            self.model,
            self._policy,
            self._eval_tally,
            steps,
            episodes,
            until_episode,
            self._start,
        )
        self._mark_success(episodes[:ended])
        return filled, ended

    def training_side(self) -> dict[str, Any]:
        """Return the measures of training at this moment, named as in the recording's metrics."""
        rewards, counts = self._reward_distribution()
        lengths = self._tally.recent_lengths[: min(self.episode, len(self._tally.recent_lengths))]
        tables = [self.table(i) for i in range(len(self.agents))]
        zero_cells = [int(table.size - np.count_nonzero(table)) for table in tables]
        epsilon = float(schedule_value(self.rules.epsilon, self.episode, self.step))
        return {
            "step": self.step,
            "episode": self.episode,
            "mean_length": float(lengths.mean()) if len(lengths) else float("nan"),
            "rewards": rewards,
            "reward_counts": counts,
            "zero_cells": zero_cells,
            "percent_filled": [
                100.0 * (table.size - zero) / table.size
                for table, zero in zip(tables, zero_cells, strict=True)
            ],
            "epsilon": 1.0 - epsilon if self.rules.epsilon_exploits else epsilon,
            "step_size": float(schedule_value(self.rules.step_size, self.episode, self.step)),
            "discount": float(schedule_value(self.rules.discount, self.episode, self.step)),
        }

    def _reward_distribution(self) -> tuple[list[float], list[int]]:
        """Return the summed rewards of the last steps, ascending, and how often each came."""
        window = self._tally.recent_outcomes[: min(self.step, len(self._tally.recent_outcomes))]
        by_class = np.bincount(window, minlength=len(self.model.rewards))
        summed = self._team_rewards()
        rewards, where = np.unique(summed, return_inverse=True)
        counts = np.bincount(where, weights=by_class, minlength=len(rewards)).astype(np.int64)
        seen = counts > 0
        return rewards[seen].tolist(), counts[seen].tolist()

    def _team_rewards(self) -> NDArray[np.float64]:
        """Return the summed reward of each outcome class, [C]; a shared reward counts once."""
        shared = self.mdp.rewards.shape[-1] == 1
        return self.model.rewards[:, 0] if shared else self.model.rewards.sum(axis=1)

    def _mark_success(self, episodes: NDArray[np.void]) -> None:
        if self._success.any():
            episodes["success"] = episodes["events"][:, self._success].any(axis=1)

    def set_tables(self, initial: list[NDArray[np.float64]] | None) -> None:
        """Set the tables, one [S, width] a learner; None for those that the configuration begins with."""
        start = self.config.initial_q
        if initial is not None:
            self.tables.q[:] = np.concatenate([table.reshape(-1) for table in initial])
        elif isinstance(start, RandomTable):
            kernel.fill_random(self.tables.q, self.seed, start.random.low, start.random.high)
        elif isinstance(start, int | float):
            self.tables.q[:] = start
        for i in range(len(self.model.width)):
            self.tables.greedy[i] = self.table(i).argmax(axis=1)
            self.tables.value[i] = self.table(i).max(axis=1)


def _trial_start(config: ExperimentConfig, mdp: Mdp) -> int:
    """Return where trials start, as the kernel wants it."""
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
    return Rules(
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


def _check_fit(config: ExperimentConfig, mdp: Mdp, model: Model) -> None:
    """Refuse an experiment that this environment would make go wrong, or go on for ever."""
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


def _tables(model: Model, states: int) -> Tables:
    sizes = [width * states for width in model.width]
    learners = len(sizes)
    return Tables(
        q=np.zeros(sum(sizes)),
        offset=tuple(sum(sizes[:i]) for i in range(learners)),
        greedy=np.zeros((learners, states), np.int32),
        value=np.zeros((learners, states)),
    )


def _tally(model: Model, window: int, episodes: int) -> Tally:
    return Tally(
        returns=np.zeros(len(model.width)),
        event_classes=np.zeros(len(model.event_mask), np.int64),
        recent_outcomes=np.zeros(window, np.int32),
        recent_lengths=np.zeros(episodes, np.int64),
    )
