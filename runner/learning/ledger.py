"""The ledger of a Q-value: the weights of the rewards and initial values that it is the sum of.

A new value of an update is a weighted sum: 1 - rate of the old value, rate of the reward, and rate * discount
of the values that the target has of the next state. So every Q-value is a weighted sum of the rewards of the
steps before it and of the initial values. `kernel.replay` notes of each update what decides these weights,
such as which action was greedy, and `spread` finds them from the last step to the first (the adjoint, or
reverse mode, of the updates): each update passes the weight of the value that it changed on to what it was
made of.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from runner.learning.algorithms import Rules, expects, exploring, rate
from runner.learning.compiling import inlined, loop
from runner.learning.model import Model
from runner.learning.schedules import schedule_value
from runner.util.arrays import Floats, Records

UPDATE: Final = np.dtype([("outcome", "<u4"), ("bootstrapped", "<i4"), ("episode", "<i8"), ("second", "?")])
"""What decides the weights of a learner's update: the outcome of the step, as an index of `Model.next_state`,
its episode, and what `algorithms.learn` returns."""
SHARE: Final = np.dtype([("step", "<i8"), ("weight", "<f8"), ("distance", "<f8"), ("contribution", "<f8")])
"""A step and the weight of its reward; how many steps lie between the states of the Q-value and of the step,
on average over the ways by which the reward came; and what the reward adds to the Q-value."""
UNKNOWN_OUTCOME: Final = 2**32 - 1
"""The outcome of a step that the environment cannot have."""


class Ledger(NamedTuple):
    """What the weight of one Q-value was spread over so far, from its moment backwards.

    T tables of the learner: 2 of Double Q-learning, else 1.
    """

    weights: Floats
    """[T, S * width]: how much of each value of the tables at this step the Q-value has."""
    distances: Floats
    """[T, S * width]: these weights times the mean number of steps between that state and the Q-value's."""
    outcomes: Floats
    """[outcomes]: how much of the rewards of steps with this outcome it has."""
    episodes: Floats
    """[stretches, 2]: how much of the rewards in a stretch of episodes it has, and what these add to it."""


@inlined
def outcome_of(model: Model, record: np.record, i: int) -> int:
    """Return which outcome a recorded step had; of several that learner i cannot tell apart, the first."""
    outcomes = model.cumulative.shape[1]
    pair = np.int64(record.state) * len(model.own_action) + np.int64(record.action)
    for k in range(outcomes):
        if k > 0 and model.cumulative[pair, k - 1] >= 1.0:
            break
        outcome = pair * outcomes + k
        kind = model.outcome_class[outcome]
        if (
            model.next_state[outcome] == record.next_state
            and model.terminated[kind] == record.terminated
            and model.rewards[kind, i] == record.rewards[i]
        ):
            return outcome
    return UNKNOWN_OUTCOME


@loop
def spread(
    model: Model,
    rules: Rules,
    i: int,
    first: int,
    updates: Records,
    ledger: Ledger,
    stretch: int,
    shares: Records,
) -> int:
    """Spread the weights of learner i's values over the updates of a block, from the last to the first.

    Return how many of the steps' rewards have a weight.

    Args:
        rules: of the run at these steps.
        updates: of the steps, [N].
        ledger: as it is after these steps; it is moved to before them.
        stretch: episodes of a stretch.
        shares: [N] of `SHARE`, filled with the steps whose rewards have a weight, the last ones first.
    """
    is_double = len(ledger.weights) > 1
    width = model.width[i]
    joint_actions, outcomes = len(model.own_action), model.cumulative.shape[1]
    filled = 0
    for k in range(len(updates) - 1, -1, -1):
        update = updates[k]
        pair = np.int64(update.outcome) // outcomes
        state, action = pair // joint_actions, pair % joint_actions
        cell_action = np.int64(model.own_action[action, 0 if rules.first_action_for_all else i])
        cell = state * width + cell_action
        learned = np.int64(is_double and update.second)
        other = 1 - learned if is_double else learned
        weight = ledger.weights[learned, cell]
        if weight == 0.0:
            continue
        distance = ledger.distances[learned, cell]
        episode, step = update.episode, first + k
        step_size = schedule_value(rules.step_size, episode, step)
        target_weight = rate(rules, episode, step, step_size, update.second)

        # The reward.
        share = shares[filled]
        filled += 1
        share.step = step
        share.weight = weight * target_weight
        share.distance = distance / weight
        share.contribution = share.weight * model.rewards[model.outcome_class[update.outcome], i]
        ledger.outcomes[update.outcome] += share.weight
        ledger.episodes[episode // stretch, 0] += share.weight
        ledger.episodes[episode // stretch, 1] += share.contribution

        # The old value, and the values of the next state.
        ledger.weights[learned, cell] = weight * (1.0 - target_weight)
        ledger.distances[learned, cell] = distance * (1.0 - target_weight)
        if update.bootstrapped < 0:
            continue
        passed = target_weight * schedule_value(rules.discount, episode, step)
        next_row = np.int64(model.next_state[update.outcome]) * width
        greedy = passed
        if expects(rules):
            epsilon = exploring(rules, episode, step + 1)
            for next_action in range(width):
                ledger.weights[other, next_row + next_action] += passed * epsilon / width * weight
                ledger.distances[other, next_row + next_action] += (
                    passed * epsilon / width * (distance + weight)
                )
            greedy = passed * (1.0 - epsilon)
        ledger.weights[other, next_row + update.bootstrapped] += greedy * weight
        ledger.distances[other, next_row + update.bootstrapped] += greedy * (distance + weight)
    return filled
