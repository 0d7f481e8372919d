"""The algorithms in plain Python: what the compiled kernel must equal to the last bit.

Written from the sources, slow and obvious: Sutton and Barto's pseudo-code, one step after the other
through the arrays of the `Mdp`. Nothing is imported from the kernel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from tests.runner.learning.plain_draws import (
    EVALUATION_ACTION,
    EVALUATION_OUTCOME,
    EVALUATION_START,
    EXPLORATION,
    INITIAL_Q,
    OUTCOME,
    POLICY,
    START,
    UPDATE,
    below,
    coin,
    draw,
    key,
    pick,
    splitmix64,
    uniform,
)
from tests.runner.learning.plain_schedules import value_of


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
        self.tables = self._of_states(0.0)
        self.doubles = [self._of_states(0.0), self._of_states(0.0)]
        self.policies = [[[1.0 / width] * width for _ in range(mdp.states)] for width in self.widths]
        self.averages = [[[1.0 / width] * width for _ in range(mdp.states)] for width in self.widths]
        self.visits = [[0] * mdp.states for _ in self.widths]
        self.chosen: tuple[int, int] | None = None  # by SARSA, for the step to come
        self.traces: list[dict[tuple[int, int], float]] = [{} for _ in self.widths]
        self._fill_tables()
        self.starts = [(s, p) for s, p in enumerate(mdp.start.tolist()) if p > 0]
        self.training, self.evaluation = Phase(), Phase()

    def _of_states(self, value: float) -> list[list[list[float]]]:
        """Return a table a learner, filled with a value."""
        return [[[value] * width for _ in range(self.mdp.states)] for width in self.widths]

    def _fill_tables(self) -> None:
        double = self.config.algorithm == "double_q_learning"
        start, stream, index = self.config.initial_q, key(self.seed, INITIAL_Q, 0), 0
        for tables in self.doubles if double else [self.tables]:
            for table in tables:
                for row in table:
                    for action in range(len(row)):
                        if isinstance(start, int | float):
                            row[action] = start
                        else:
                            low, high = start.random.low, start.random.high
                            row[action] = low + (high - low) * uniform(splitmix64(stream, index))
                        index += 1
        if double:
            for i, table in enumerate(self.tables):
                for state, row in enumerate(table):
                    for action in range(len(row)):
                        row[action] = self._mean(i, state, action)

    def _mean(self, i: int, state: int, action: int) -> float:
        return (self.doubles[0][i][state][action] + self.doubles[1][i][state][action]) / 2

    def named_tables(self, i: int) -> dict[str, list[list[float]]]:
        """Return all that learner i holds, by name."""
        held = {"q": self.tables[i]}
        if self.config.algorithm == "double_q_learning":
            held |= {"q_1": self.doubles[0][i], "q_2": self.doubles[1][i]}
        if self.config.algorithm == "wolf_phc":
            visits = [[float(count)] for count in self.visits[i]]
            held |= {"policy": self.policies[i], "average_policy": self.averages[i], "visits": visits}
        return held

    def epsilon(self, episode: int, step: int) -> float:
        """Return the probability of exploring."""
        if not self.learns:
            return 1.0
        epsilon = value_of(self.config.epsilon, episode, step)
        return 1.0 - epsilon if self.config.quirks.epsilon_exploits else epsilon

    def train(self, until_episode: int, until_step: int) -> None:
        """Run training episodes until that many episodes or steps are done."""
        config, phase = self.config, self.training
        while len(phase.episodes) < until_episode and len(phase.steps) < until_step:
            episode, t = len(phase.episodes), len(phase.begun)
            state = phase.steps[-1].next_state if t else self._start(START, episode)
            if self.chosen is None or t == 0:
                action, explored = self._epsilon_greedy(state, episode, t, len(phase.steps))
            else:
                action, explored = self.chosen
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
            if self.config.algorithm == "wolf_phc":
                own = [
                    pick(
                        list(enumerate(self.policies[i][state])),
                        uniform(draw(self.seed, EVALUATION_ACTION, trial, t * self.learners + i)),
                    )
                    for i in range(self.learners)
                ]
                action, explored = self._joint(own), 0
            elif self.learns:
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

    def _unexploring(self, i: int, state: int, episode: int, t: int) -> int:
        if self.config.algorithm != "wolf_phc":
            return self._greedy(i, state)
        u = uniform(draw(self.seed, POLICY, episode, t * self.learners + i))
        return pick(list(enumerate(self.policies[i][state])), u)

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
        actions = [self._unexploring(i, state, episode, t) for i in range(self.learners)]
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
        quirks, learn_value = self.config.quirks, getattr(self, f"_{self.config.algorithm}")
        own = self._own(step.action)
        self.chosen = None
        if self.config.algorithm in ("sarsa", "sarsa_lambda"):
            self.chosen = self._epsilon_greedy(step.next_state, step.episode, step.t + 1, step.step + 1)
        if step.terminated and not quirks.bootstrap_after_termination:
            discount = None  # the next state does not count
        for i in range(self.learners):
            learn_value(step, i, own[0 if quirks.second_table_uses_first_action else i], step_size, discount)

    def _q_learning(self, step: Step, i: int, action: int, step_size: float, discount: float | None) -> None:
        """Sutton and Barto, section 6.5."""
        td_target = step.rewards[i]
        if discount is not None:
            td_target += discount * max(self.tables[i][step.next_state])
        self._towards(self.tables[i][step.state], action, td_target, step_size)

    def _sarsa(self, step: Step, i: int, action: int, step_size: float, discount: float | None) -> None:
        """Sutton and Barto, section 6.4; the next action is chosen by the tables before this update."""
        td_target = step.rewards[i]
        if discount is not None:
            assert self.chosen is not None
            td_target += discount * self.tables[i][step.next_state][self._own(self.chosen[0])[i]]
        self._towards(self.tables[i][step.state], action, td_target, step_size)

    def _expected_sarsa(
        self, step: Step, i: int, action: int, step_size: float, discount: float | None
    ) -> None:
        """Sutton and Barto, section 6.6."""
        td_target, row = step.rewards[i], self.tables[i][step.next_state]
        if discount is not None:
            epsilon = self.epsilon(step.episode, step.step + 1)
            total = 0.0
            for value in row:
                total += value
            td_target += discount * (epsilon * (total / len(row)) + (1.0 - epsilon) * max(row))
        self._towards(self.tables[i][step.state], action, td_target, step_size)

    def _double_q_learning(
        self, step: Step, i: int, action: int, step_size: float, discount: float | None
    ) -> None:
        """Sutton and Barto, section 6.7; van Hasselt 2010, algorithm 1."""
        one, other = self.doubles[0][i], self.doubles[1][i]
        if coin(draw(self.seed, UPDATE, step.episode, step.t * self.learners + i)) >= 0.5:
            one, other = other, one
        td_target, following = step.rewards[i], one[step.next_state]
        if discount is not None:
            td_target += discount * other[step.next_state][following.index(max(following))]
        self._towards(one[step.state], action, td_target, step_size)
        self.tables[i][step.state][action] = self._mean(i, step.state, action)

    def _hysteretic_q_learning(
        self, step: Step, i: int, action: int, step_size: float, discount: float | None
    ) -> None:
        """Matignon, Laurent and Le Fort-Piat 2007, equation 6."""
        td_target, row = step.rewards[i], self.tables[i][step.state]
        if discount is not None:
            td_target += discount * max(self.tables[i][step.next_state])
        delta = td_target - row[action]
        rises = delta >= 0
        decrease = value_of(self.config.hysteretic.decrease, step.episode, step.step)
        row[action] = row[action] + (step_size if rises else decrease) * delta

    def _wolf_phc(self, step: Step, i: int, action: int, step_size: float, discount: float | None) -> None:
        """Bowling and Veloso 2002, table 5: the value, the average policy, the policy."""
        self._q_learning(step, i, action, step_size, discount)
        s, n, wolf = step.state, self.widths[i], self.config.wolf_phc
        q, policy, average = self.tables[i][s], self.policies[i][s], self.averages[i][s]
        self.visits[i][s] += 1
        for a in range(n):
            average[a] = average[a] + (policy[a] - average[a]) / self.visits[i][s]
        worth = usual = 0.0
        for a in range(n):
            worth += policy[a] * q[a]
            usual += average[a] * q[a]
        delta = value_of(wolf.win if worth > usual else wolf.lose, step.episode, step.step)
        greedy, gained = self._greedy(i, s), 0.0
        for a in range(n):
            if a != greedy:
                lost = min(policy[a], delta / (n - 1))
                policy[a] = policy[a] - lost
                gained += lost
        policy[greedy] = policy[greedy] + gained

    def _sarsa_lambda(
        self, step: Step, i: int, action: int, step_size: float, discount: float | None
    ) -> None:
        """Sutton and Barto, section 12.7, for a table, with replacing traces."""
        if step.t == 0:
            self.traces[i] = {}
        decay = value_of(self.config.discount, step.episode, step.step)
        decay *= value_of(self.config.sarsa_lambda.trace_decay, step.episode, step.step)
        traces = {cell: trace * decay for cell, trace in self.traces[i].items()}
        traces[step.state, action] = 1.0
        self.traces[i] = {cell: trace for cell, trace in traces.items() if trace > 0.0}
        td_target = step.rewards[i]
        if discount is not None:
            assert self.chosen is not None
            td_target += discount * self.tables[i][step.next_state][self._own(self.chosen[0])[i]]
        delta = td_target - self.tables[i][step.state][action]
        for (state, own), trace in self.traces[i].items():
            self.tables[i][state][own] = self.tables[i][state][own] + step_size * delta * trace

    def _n_step_q_learning(
        self, step: Step, i: int, action: int, step_size: float, discount: float | None
    ) -> None:
        """Sutton and Barto, section 7.1, with the greatest value of the state after the last reward."""
        n, gamma = self.config.n_step.n, value_of(self.config.discount, step.episode, step.step)
        last = [*(seen for seen, _ in self.training.begun), step][-n:]
        bootstrap = max(self.tables[i][step.next_state]) if discount is not None else 0.0
        returns = []  # from each of the last steps on
        for k in range(len(last)):
            total = bootstrap
            for later in reversed(last[k:]):
                total = later.rewards[i] + gamma * total
            returns.append(total)
        learned = range(len(last) if step.terminated or step.truncated else len(last) - n + 1)
        for k in reversed(learned):
            self._towards(self.tables[i][last[k].state], self._own(last[k].action)[i], returns[k], step_size)

    def _towards(self, row: list[float], action: int, td_target: float, step_size: float) -> None:
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

    def training_metrics(self) -> dict[str, Any]:
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
