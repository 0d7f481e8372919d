"""An episode played on from one of its steps with the tables of that moment: the same draws, no learning."""

from __future__ import annotations

import math

import numpy as np

from runner.learning import kernel
from runner.learning.algorithms import POLICY, QLearning
from runner.learning.kernel import Tally
from runner.learning.learner import CHOSEN, NEVER, Learner
from runner.learning.schedules import compile_schedule, schedule_value
from runner.planning.evaluation import joint_probabilities
from runner.util.arrays import Floats, Records


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
