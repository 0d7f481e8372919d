"""Tabular Q-learning in plain Python: what the compiled kernel must equal to the last bit.

Written from the specification, slow and obvious: Sutton and Barto's pseudo-code, SplitMix64 in Python
integers, one step after the other through the arrays of the `Mdp`. Nothing is imported from the kernel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

START, EXPLORATION, OUTCOME, UPDATE = range(4)
EVALUATION_START, EVALUATION_OUTCOME, EVALUATION_ACTION, INITIAL_Q = range(4, 8)

BITS_64 = 2**64 - 1


def splitmix64(state: int, index: int) -> int:
    """Return output number `index`, from 0, of the generator that starts at `state`."""
    z = (state + (index + 1) * 0x9E3779B97F4A7C15) & BITS_64
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 & BITS_64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB & BITS_64
    return z ^ (z >> 31)


def key(seed: int, stream: int, episode: int) -> int:
    """Return a generator's state: seed, stream and episode mixed in, one after the other."""
    state = 0
    for part in (seed, stream, episode):
        state = splitmix64((state + part) & BITS_64, 0)
    return state


def draw(seed: int, stream: int, episode: int, index: int) -> int:
    """Return 64 random bits."""
    return splitmix64(key(seed, stream, episode), index)


def uniform(bits: int) -> float:
    """Return a number in [0, 1) of the upper 53 bits."""
    return (bits >> 11) / 2**53


def coin(bits: int) -> float:
    """Return a number in [0, 1) of the upper 32 bits."""
    return (bits >> 32) / 2**32


def below(bits: int, n: int) -> int:
    """Return a whole number below n of the lower 32 bits."""
    return (bits % 2**32) * n // 2**32


def pick(chances: list[tuple[int, float]], u: float) -> int:
    """Return the first of (item, probability) at which the running sum of probabilities exceeds u."""
    total = 0.0
    for item, probability in chances:
        total += probability
        if u < total:
            return item
    return chances[-1][0]


def value_of(schedule: Any, episode: int, step: int) -> float:
    """Return a constant's or schedule's value, by + - * / alone."""
    if isinstance(schedule, int | float):
        return float(schedule)
    n = step if schedule.by == "step" else episode
    if schedule.schedule == "linear":
        value = line(n, (0, schedule.start), (schedule.over, schedule.end))
    elif schedule.schedule == "exponential":
        value = schedule.start * power(schedule.factor, n)
    else:
        value = schedule.points[-1][1]
        for before, after in zip(schedule.points, schedule.points[1:], strict=False):
            if before[0] <= n < after[0]:
                value = line(n, before, after)
    return max(value, schedule.floor)


def line(n: int, first: tuple[int, float], last: tuple[int, float]) -> float:
    """Return the height at n of the line between two points (x, y); y of the last one from there on."""
    if n >= last[0]:
        return last[1]
    return first[1] + (last[1] - first[1]) * ((n - first[0]) / (last[0] - first[0]))


def power(base: float, n: int) -> float:
    """Return base ** n by repeated squaring."""
    result = 1.0
    for bit in reversed(bin(n)[2:]):
        if bit == "1":
            result *= base
        base *= base
    return result


class Step(NamedTuple):
    """One environment step."""

    step: int
    episode: int
    t: int
    state: int
    action: int
    next_state: int
    rewards: list[float]
    terminated: bool
    truncated: bool
    explored: int


class Episode(NamedTuple):
    """One whole episode."""

    episode: int
    last_step: int
    length: int
    penalties: int
    returns: list[float]
    events: list[int]
    success: bool
    terminated: bool
    truncated: bool


class Phase:
    """Training's or evaluation's steps and episodes so far."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.episodes: list[Episode] = []
        self.begun: list[tuple[Step, int]] = []  # the current episode's steps, and which outcome each had


class Twin:
    """One job, in plain Python."""

    def __init__(self, config: Any, mdp: Any, seed: int) -> None:
        self.config, self.mdp, self.seed = config, mdp, seed
        joint = config.tables == "joint"
        self.widths = [mdp.joint_actions] if joint else list(mdp.action_counts)
        self.learners = len(self.widths)
        self.learns = config.algorithm != "random"
        self.tables = [[[0.0] * width for _ in range(mdp.states)] for width in self.widths]
        self._fill_tables()
        self.starts = [(s, p) for s, p in enumerate(mdp.start.tolist()) if p > 0]
        self.training, self.evaluation = Phase(), Phase()

    def _fill_tables(self) -> None:
        start, stream, index = self.config.initial_q, key(self.seed, INITIAL_Q, 0), 0
        for table in self.tables:
            for row in table:
                for action in range(len(row)):
                    if isinstance(start, int | float):
                        row[action] = start
                    else:
                        low, high = start.random.low, start.random.high
                        row[action] = low + (high - low) * uniform(splitmix64(stream, index))
                    index += 1

    def epsilon(self, episode: int, step: int) -> float:
        """Return the probability of exploring."""
        if not self.learns:
            return 1.0
        epsilon = value_of(self.config.epsilon, episode, step)
        return 1.0 - epsilon if self.config.quirks.epsilon_exploits else epsilon

    def train(self, until_episode: int, until_step: int) -> None:
        """Run episodes of Q-learning until that many episodes or steps are done."""
        config, phase = self.config, self.training
        while len(phase.episodes) < until_episode and len(phase.steps) < until_step:
            episode, t = len(phase.episodes), len(phase.begun)
            state = phase.steps[-1].next_state if t else self._start(START, episode)
            action, explored = self._epsilon_greedy(state, episode, t, len(phase.steps))
            step, outcome = self._move(phase, OUTCOME, episode, t, state, action, explored)
            if self.learns:
                step_size = value_of(config.step_size, episode, step.step)
                discount = value_of(config.discount, episode, step.step)
                self._learn(step, step_size, discount)
            self._record(phase, step, outcome)

    def evaluate(self, trials: int) -> None:
        """Play greedy trials (or random ones, for the random algorithm); training is left alone."""
        phase = self.evaluation
        until = len(phase.episodes) + trials
        while len(phase.episodes) < until:
            trial, t = len(phase.episodes), len(phase.begun)
            state = phase.steps[-1].next_state if t else self._trial_start(trial)
            if self.learns:
                action, explored = self._joint([self._greedy(i, state) for i in range(self.learners)]), 0
            else:
                bits = draw(self.seed, EVALUATION_ACTION, trial, t)
                action, explored = below(bits, self.mdp.joint_actions), 2**self.learners - 1
            step, outcome = self._move(phase, EVALUATION_OUTCOME, trial, t, state, action, explored)
            self._record(phase, step, outcome)

    def _start(self, stream: int, episode: int) -> int:
        return pick(self.starts, uniform(draw(self.seed, stream, episode, 0)))

    def _trial_start(self, trial: int) -> int:
        start = self.config.evaluation.start
        if start == "each":
            return self.starts[trial % len(self.starts)][0]
        return self._start(EVALUATION_START, trial) if start == "random" else start

    def _greedy(self, i: int, state: int) -> int:
        row = self.tables[i][state]
        return row.index(max(row))

    def _joint(self, actions: list[int]) -> int:
        joint = 0
        for action, width in zip(actions, self.widths, strict=True):
            joint = joint * width + action
        return joint

    def _own(self, joint: int) -> list[int]:
        actions = []
        for width in reversed(self.widths):
            joint, action = divmod(joint, width)
            actions.insert(0, action)
        return actions

    def _epsilon_greedy(self, state: int, episode: int, t: int, step: int) -> tuple[int, int]:
        """Return the joint action, and who explored (bit i: learner i)."""
        epsilon = self.epsilon(episode, step)
        actions = [self._greedy(i, state) for i in range(self.learners)]
        if self.config.exploration == "shared":
            bits = draw(self.seed, EXPLORATION, episode, t)
            if coin(bits) < epsilon:
                return below(bits, self.mdp.joint_actions), 2**self.learners - 1
            return self._joint(actions), 0
        explored = 0
        for i, width in enumerate(self.widths):
            bits = draw(self.seed, EXPLORATION, episode, t * self.learners + i)
            if coin(bits) < epsilon:
                actions[i] = below(bits, width)
                explored += 2**i
        return self._joint(actions), explored

    def _move(
        self, phase: Phase, stream: int, episode: int, t: int, state: int, action: int, explored: int
    ) -> tuple[Step, int]:
        """Return the step that the environment answers the action with, and which outcome it was."""
        mdp = self.mdp
        chances = [(k, p) for k, p in enumerate(mdp.probability[state, action].tolist()) if p > 0]
        k = pick(chances, uniform(draw(self.seed, stream, episode, t)))
        paid = mdp.rewards[state, action, k].tolist()
        step = Step(
            step=len(phase.steps),
            episode=episode,
            t=t,
            state=state,
            action=action,
            next_state=int(mdp.next_state[state, action, k]),
            rewards=paid if len(paid) == self.learners else paid * self.learners,
            terminated=bool(mdp.terminated[state, action, k]),
            truncated=t + 1 == mdp.step_limit,
            explored=explored,
        )
        return step, k

    def _learn(self, step: Step, step_size: float, discount: float) -> None:
        quirks = self.config.quirks
        own = self._own(step.action)
        for i, table in enumerate(self.tables):
            td_target = step.rewards[i]
            if not step.terminated or quirks.bootstrap_after_termination:
                td_target += discount * max(table[step.next_state])
            row, action = table[step.state], own[0 if quirks.second_table_uses_first_action else i]
            row[action] = row[action] + step_size * (td_target - row[action])

    def _record(self, phase: Phase, step: Step, outcome: int) -> None:
        phase.steps.append(step)
        phase.begun.append((step, outcome))
        if step.terminated or step.truncated:
            phase.episodes.append(self._episode(phase.begun))
            phase.begun = []

    def _episode(self, steps: list[tuple[Step, int]]) -> Episode:
        mdp, last = self.mdp, steps[-1][0]
        masks = [int(mdp.events[step.state, step.action, k]) for step, k in steps]
        summed = [sum(mdp.rewards[step.state, step.action, k].tolist()) for step, k in steps]
        events = [sum(mask >> i & 1 for mask in masks) for i in range(len(mdp.event_names))]
        returns = [0.0] * self.learners
        for step, _ in steps:
            returns = [so_far + reward for so_far, reward in zip(returns, step.rewards, strict=True)]
        return Episode(
            episode=last.episode,
            last_step=last.step,
            length=len(steps),
            penalties=sum(reward < mdp.penalty_below for reward in summed),
            returns=returns,
            events=events,
            success=any(events[mdp.event_names.index(name)] for name in mdp.success_events),
            terminated=last.terminated,
            truncated=last.truncated,
        )

    def team_reward(self, step: Step) -> float:
        """Return a step's summed reward; one that all agents share counts once."""
        return step.rewards[0] if self.mdp.rewards.shape[-1] == 1 else sum(step.rewards)

    def training_side(self) -> dict[str, Any]:
        """Return the measures of training at this moment."""
        steps, episodes, log = self.training.steps, self.training.episodes, self.config.log
        recent = [self.team_reward(step) for step in steps[-log.window :]]
        lengths = [episode.length for episode in episodes[-log.episodes :]]
        zeros = [sum(cell == 0 for row in table for cell in row) for table in self.tables]
        sizes = [len(table) * len(table[0]) for table in self.tables]
        now = len(episodes), len(steps)
        return {
            "step": len(steps),
            "episode": len(episodes),
            "mean_length": sum(lengths) / len(lengths) if lengths else None,
            "rewards": sorted(set(recent)),
            "reward_counts": [recent.count(reward) for reward in sorted(set(recent))],
            "zero_cells": zeros,
            "percent_filled": [100 * (n - zero) / n for n, zero in zip(sizes, zeros, strict=True)],
            "epsilon": self.epsilon(*now),
            "step_size": value_of(self.config.step_size, *now),
            "discount": value_of(self.config.discount, *now),
        }
