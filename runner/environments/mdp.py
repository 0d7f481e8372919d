"""A tabular environment as arrays, with a scene by which its states are drawn.

It is all that the runner knows of the environment. Neither an environment nor a recording of one can be
trusted: `check_mdp` checks all of it, so that code that uses it need not check again.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Annotated, Any, Final, NotRequired, TypedDict

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from runner.errors import EnvironmentNotUsable, RecordingError
from runner.util.arrays import Array, Flags, Floats, Ints, Ints32, Records
from runner.util.stored import mistake_in_words
from runner.util.values import MAX_TEXT, JsonView, is_text, is_whole

MAX_CELLS: Final = 2**15 - 1
"""Cells are numbered in int16."""
_Count = Annotated[int, Meta(ge=1, le=MAX_CELLS)]
_Cell = Annotated[Sequence[Annotated[int, Meta(ge=0)]], Meta(min_length=2, max_length=2)]
"""Row and column."""
_Label = Annotated[str, Meta(min_length=1, max_length=MAX_TEXT)]


class Landmark(TypedDict):
    """A cell that is marked."""

    name: _Label
    cell: _Cell
    colour: Annotated[str, Meta(pattern=r"^#[0-9A-Fa-f]{6}\Z")]
    """Such as `#009E73`."""
    label: NotRequired[_Label | None]
    kind: NotRequired[_Label | None]
    """`hazard` or `goal`, or any other word."""


class Thing(TypedDict):
    """What is somewhere in every state."""

    name: _Label
    label: _Label
    kind: _Label
    """`mover`, `goal`, or any other word."""
    agent: NotRequired[_Label | None]
    """The agent that moves it."""
    colour: NotRequired[_Label | None]


class SceneAction(TypedDict):
    """An action of each agent."""

    name: _Label
    move: NotRequired[
        Annotated[
            Sequence[Annotated[int, Meta(ge=-MAX_CELLS, le=MAX_CELLS)]], Meta(min_length=2, max_length=2)
        ]
        | None
    ]
    """Rows and columns; None for an action that is no move."""


class SceneDescription(TypedDict):
    """How the states of an environment are drawn, as it describes them and as recordings store it."""

    rows: _Count
    columns: _Count
    walls: Sequence[Annotated[Sequence[_Cell], Meta(min_length=2, max_length=2)]]
    """Pairs of cells with a wall between them."""
    landmarks: Sequence[Landmark]
    things: Sequence[Thing]
    actions: Sequence[SceneAction]


_KEYS: Final = SceneDescription.__required_keys__


def scene_mistake(
    scene: object, cells: NDArray[np.int16] | None, carriers: NDArray[np.int8] | None, states: int
) -> str | None:
    """Return the first mistake of a scene and its arrays; None if there is none.

    Args:
        cells: the cell of each thing in each state, [S, things].
        carriers: which thing carries it, or -1, [S, things].
    """
    if scene is None:
        return None if cells is None and carriers is None else "the scene's arrays need a scene; found none"
    if not isinstance(scene, Mapping) or not set(scene) >= _KEYS:
        keys = ", ".join(sorted(map(str, scene))) if isinstance(scene, Mapping) else f"{scene!r}"
        return f"a scene must have {', '.join(sorted(_KEYS))}; found {keys:.100}"
    try:  # as it is recorded: JSON has no sets, whose order may change
        checked = msgspec.convert(json.loads(json.dumps(dict(scene))), SceneDescription)
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        return f"the scene: {mistake_in_words(error, scene)}"
    things = len(checked["things"])
    last_cell = checked["rows"] * checked["columns"] - 1
    return (
        _content_mistake(checked)
        or _array_mistake("cells", cells, np.int16, (states, things), (0, last_cell))
        or _array_mistake("carriers", carriers, np.int8, (states, things), (-1, things - 1))
    )


def _content_mistake(scene: SceneDescription) -> str | None:
    """Return the first mistake of a scene with values of the right types."""
    rows, columns = scene["rows"], scene["columns"]
    if rows * columns > MAX_CELLS:
        return f"a scene has at most {MAX_CELLS:,} cells; found {rows:,} rows and {columns:,} columns"
    for cell in (*chain(*scene["walls"]), *(mark["cell"] for mark in scene["landmarks"])):
        if cell[0] >= rows or cell[1] >= columns:
            return f"each of the scene's cells is within {rows} rows and {columns} columns; found {cell}"
    for part in (*scene["landmarks"], *scene["things"], *scene["actions"]):
        for text in part.values():
            if isinstance(text, str) and not text.isprintable():
                return f"each of the scene's texts must be printable; found {text!r}"
    return None


def _array_mistake(
    name: str,
    array: NDArray[np.int16 | np.int8] | None,
    kind: type[np.int16 | np.int8],
    shape: tuple[int, int],
    bounds: tuple[int, int],
) -> str | None:
    if array is None:
        return None
    if array.dtype != kind or array.shape != shape:
        return f"scene_{name} must be {np.dtype(kind)} {shape}; found {array.dtype} {array.shape}"
    if array.size and not bounds[0] <= int(array.min()) <= int(array.max()) <= bounds[1]:
        return f"scene_{name} must be from {bounds[0]} to {bounds[1]}; found {array.min()} to {array.max()}"
    return None


Indices = NDArray[np.integer[Any]]
"""Numbers of states or actions, as recorded in one integer type or another."""

MAX_EVENTS = 31
MAX_AGENTS = 31
MAX_ARRAYS_BYTES = 128 << 20
"""Limit of all arrays of an environment, within which a recording of it can be read."""
_BATCH_OUTCOMES = 1 << 20
"""Outcomes that are compared at a time, so that memory grows with neither steps nor outcomes."""
_DTYPES = {
    "next_state": np.int32,
    "probability": np.float64,
    "rewards": np.float64,
    "terminated": np.bool_,
    "events": np.uint32,
    "start": np.float64,
}


class Transitions(TypedDict):
    """The arrays of an environment's outcomes, as `Mdp` has them."""

    next_state: Ints32
    probability: Floats
    rewards: Floats
    terminated: Flags
    events: NDArray[np.uint32]


Amount = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class EnvironmentDescription(TypedDict):
    """The fields of an `Mdp` that are not arrays, as JSON can hold them."""

    env_id: str
    kwargs: JsonView
    step_limit: Amount
    agents: Sequence[str]
    action_counts: Sequence[Amount]
    event_names: Sequence[str]
    success_events: Sequence[str]
    penalty_below: float | None
    """None for no penalties."""
    scene: SceneDescription | None


@dataclass(frozen=True, eq=False)
class Mdp:
    """A Markov decision process: S states, J joint actions, at most K outcomes a pair, R reward columns."""

    env_id: str
    kwargs: JsonView
    next_state: Ints32
    """[S, J, K]."""
    probability: Floats
    """[S, J, K]; 0 where a pair has fewer outcomes; these come last."""
    rewards: Floats
    """[S, J, K, R]; R is 1 if all agents share the reward, or the number of agents."""
    terminated: Flags
    """[S, J, K]."""
    events: NDArray[np.uint32]
    """[S, J, K]: bit i is `event_names[i]`."""
    start: Floats
    """[S]: probability that an episode starts there."""
    step_limit: int
    """Steps after which an episode is truncated; 0 for never."""
    agents: tuple[str, ...]
    action_counts: tuple[int, ...]
    """Actions of each agent; a joint action has them as digits, the first agent's the most significant."""
    event_names: tuple[str, ...] = ()
    success_events: tuple[str, ...] = ()
    penalty_below: float = -np.inf
    """A step whose summed reward is lower counts as a penalty."""
    scene: SceneDescription | None = None
    scene_cells: NDArray[np.int16] | None = None
    """[S, things]: the cell of each thing, row * columns + column."""
    scene_carriers: NDArray[np.int8] | None = None
    """[S, things]: the thing that carries it, or -1."""

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.next_state)

    @property
    def joint_actions(self) -> int:
        """Number of joint actions."""
        return int(self.next_state.shape[1])

    @cached_property
    def own_actions(self) -> Ints:
        """[J, agents]: each agent's part of every joint action."""
        joint = np.arange(self.joint_actions)
        return np.stack(np.unravel_index(joint, self.action_counts), axis=1).astype(np.int64)

    @cached_property
    def carriers(self) -> NDArray[np.int8]:
        """[S, things]: the thing that carries each thing of the scene, -1 for none."""
        if self.scene_carriers is not None:
            return self.scene_carriers
        assert self.scene_cells is not None
        return np.full(self.scene_cells.shape, -1, np.int8)

    @property
    def success_mask(self) -> int:
        """The bits of `events` that mean success; 0 if the environment names none."""
        return sum(1 << self.event_names.index(name) for name in self.success_events)

    @property
    def summed_rewards(self) -> Floats:
        """[S, J, K]: the reward of all agents together."""
        return np.asarray(self.rewards.sum(axis=-1))

    def outcomes_to(self, state: Indices, action: Indices, next_state: Indices) -> Flags:
        """Return which outcomes of steps, [N] each, lead to their next states: [N, K]; none if unknown."""
        exists = (state >= 0) & (state < self.states) & (action >= 0) & (action < self.joint_actions)
        at = np.where(exists, state, 0), np.where(exists, action, 0)
        leads = (self.next_state[at] == next_state[:, np.newaxis]) & (self.probability[at] > 0)
        return np.asarray(leads & exists[:, np.newaxis])

    def check_steps(self, block: Records, where: str, phase: str = "training") -> None:
        """Refuse steps with a state or an action that it does not have: they are used as indices.

        Raises:
            RecordingError: there is such a step.
        """
        bounds = {"state": self.states, "next_state": self.states, "action": self.joint_actions}
        for name, bound in bounds.items():
            if (largest := int(block[name].max())) >= bound:
                step = int(block["step"][int(block[name].argmax())])
                raise RecordingError(
                    f"{where}: found {name} {largest} in {phase} step {step}, expected less than {bound}; "
                    "`dualtaxi verify` checks the whole recording."
                )

    def rewards_of(self, learners: int) -> Floats:
        """Return rewards as [S, J, K, learners]: their own where there are several, else the shared one."""
        if self.rewards.shape[-1] in (learners, 1):
            return np.broadcast_to(self.rewards, (*self.rewards.shape[:-1], learners))
        raise EnvironmentNotUsable(
            f"{self.env_id} rewards {self.rewards.shape[-1]} agents individually, but there is one table for "
            "all: set `rewards: team`, or `tables: per_agent`."
        )

    def description(self) -> EnvironmentDescription:
        """Return all fields that are not arrays, as JSON can hold them."""
        return {
            "env_id": self.env_id,
            "kwargs": dict(self.kwargs),
            "step_limit": self.step_limit,
            "agents": list(self.agents),
            "action_counts": list(self.action_counts),
            "event_names": list(self.event_names),
            "success_events": list(self.success_events),
            "penalty_below": None if np.isinf(self.penalty_below) else self.penalty_below,
            "scene": None if self.scene is None else SceneDescription(**self.scene),
        }

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by field name."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if isinstance(value, np.ndarray)}


def step_counts(
    mdp: Mdp, rewards: Floats, state: Indices, action: Indices, next_state: Indices
) -> tuple[Ints, Flags]:
    """Return events and penalties of steps, [N, events + 1], and which rewards the table excludes, [N].

    A step has the events of the outcome that leads to its next state, of several that with its reward. Its
    reward is excluded if outcomes lead there and none of them pays it.
    """
    likely = mdp.outcomes_to(state, action, next_state)
    is_possible = likely.any(axis=1)
    at = np.where(is_possible, state, 0), np.where(is_possible, action, 0)
    paid = likely & (mdp.rewards[at].sum(axis=-1) == rewards[:, np.newaxis])
    counts = np.zeros((len(rewards), len(mdp.event_names) + 1), np.int64)
    counts[:, -1] = rewards < mdp.penalty_below
    if mdp.event_names:
        outcome = np.argmax(likely * 2 + paid, axis=1)
        events = np.where(is_possible, mdp.events[*at, outcome], np.uint32(0))
        names = np.arange(len(mdp.event_names), dtype=np.uint32)
        counts[:, :-1] = (events[:, np.newaxis] >> names) & 1
    return counts, is_possible & ~paid.any(axis=1)


def events_of(mdp: Mdp, steps: Records) -> NDArray[np.uint32]:
    """Return the events of recorded steps, a bit mask each; none where the table has no such outcome.

    A record holds where a step led, not which outcome it took: that is one with its next state; of several
    one that ends as it did, and that pays what it did.
    """
    masks = np.zeros(len(steps), np.uint32)
    if not mdp.event_names:
        return masks
    learners = steps["rewards"].shape[1]
    shared = learners if mdp.rewards.shape[-1] == 1 else 1  # every learner was paid the shared reward
    batch = max(1, _BATCH_OUTCOMES // mdp.next_state.shape[2])
    for start in range(0, len(steps), batch):
        some = steps[start : start + batch]
        at = some["state"].astype(np.int64), some["action"].astype(np.int64)
        likely = mdp.outcomes_to(*at, some["next_state"])
        outcome = np.zeros(len(some), np.int64)
        if likely.shape[1] > 1:
            ends = mdp.terminated[at] == some["terminated"][:, np.newaxis]
            paid = some["rewards"].sum(axis=-1)[:, np.newaxis]
            pays = np.isclose(mdp.rewards[at].sum(axis=-1) * shared, paid)
            outcome = np.argmax(likely * 4 + (likely & ends) * 2 + (likely & pays), axis=1)
        masks[start : start + batch] = np.where(likely.any(axis=1), mdp.events[*at, outcome], np.uint32(0))
    return masks


def from_parts(description: EnvironmentDescription, arrays: Mapping[str, NDArray[Any]]) -> Mdp:
    """Return the Mdp that `description()` and `arrays()` came from, checked like a new one.

    Raises:
        EnvironmentNotUsable: they do not describe an environment.
    """
    try:
        penalty = description["penalty_below"]
        mdp = Mdp(
            env_id=description["env_id"],
            kwargs=description["kwargs"],
            step_limit=description["step_limit"],
            agents=tuple(description["agents"]),
            action_counts=tuple(description["action_counts"]),
            event_names=tuple(description["event_names"]),
            success_events=tuple(description["success_events"]),
            penalty_below=-np.inf if penalty is None else penalty,
            scene=description["scene"],
            **arrays,
        )
        check_mdp(mdp)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, RecursionError) as error:
        raise EnvironmentNotUsable(f"the description of the environment is invalid: {error!r}") from error
    return mdp


def check_mdp(mdp: Mdp) -> None:
    """Refuse parts that contradict each other: neither environments nor recordings can be trusted.

    Each expectation relies on those before it.
    """
    with np.errstate(all="ignore"):
        for expectations in (_description_checks(mdp), _array_checks(mdp)):
            for expectation, holds, found in expectations:
                if not holds:
                    raise EnvironmentNotUsable(
                        f"environment {mdp.env_id!r}: {expectation}; found {_in_words(found)}."
                    )
    mistake = scene_mistake(mdp.scene, mdp.scene_cells, mdp.scene_carriers, mdp.states)
    if mistake is not None:
        raise EnvironmentNotUsable(f"environment {mdp.env_id!r}: {mistake}.")


def _description_checks(mdp: Mdp) -> Iterator[tuple[str, bool, object]]:
    """Yield expectations of all fields but the arrays: their text, whether they hold, and the value found."""
    agents, counts, events = mdp.agents, mdp.action_counts, mdp.event_names
    yield "an id must be text", is_text(mdp.env_id), mdp.env_id
    yield "kwargs must be a mapping", isinstance(mdp.kwargs, Mapping), mdp.kwargs
    yield f"1 to {MAX_AGENTS} agents", 1 <= len(agents) <= MAX_AGENTS, len(agents)
    yield "an agent has a name", all(map(is_text, agents)), agents
    yield "each agent needs a number of actions", len(agents) == len(counts), counts
    yield "each agent needs at least one action", all(is_whole(n, 1, 2**31) for n in counts), counts
    yield f"at most {MAX_EVENTS} events", len(events) <= MAX_EVENTS, len(events)
    yield "an event has a name of its own", _distinct(events), events
    successes = mdp.success_events
    are_events = _distinct(successes) and set(successes) <= set(events)
    yield f"success events must be some of the events {events}", are_events, successes
    penalty = mdp.penalty_below
    yield "penalty_below must be a number", isinstance(penalty, int | float), penalty
    limit = mdp.step_limit
    yield "the step limit must be a number from 0", is_whole(limit, 0, 2**31 - 1), limit


def _array_checks(mdp: Mdp) -> Iterator[tuple[str, bool, object]]:
    """Yield expectations of the arrays: their text, whether they hold, and the value found."""
    for name, kind in _DTYPES.items():
        array = getattr(mdp, name)
        is_valid = isinstance(array, np.ndarray) and array.dtype == kind
        yield f"{name} must be an array of {np.dtype(kind)}", is_valid, array
    shape = mdp.next_state.shape
    size = sum(array.nbytes for array in mdp.arrays().values())
    limit = f"its arrays may take {MAX_ARRAYS_BYTES:,} bytes, to be recorded"
    yield limit, size <= MAX_ARRAYS_BYTES, f"{size:,}"
    three = mdp.next_state.ndim == 3 and mdp.next_state.size > 0
    yield "next_state must have three axes", three, mdp.next_state
    states = f"next_state must name states, 0 to {shape[0] - 1}"
    within = 0 <= int(mdp.next_state.min()) <= int(mdp.next_state.max()) < shape[0]
    yield states, within, lambda: _range(mdp.next_state)
    others = {name: getattr(mdp, name).shape for name in ("probability", "terminated", "events")}
    alike = all(other == shape for other in others.values())
    yield f"shapes must agree with next_state's, {shape}", alike, others
    stray = mdp.events >> np.uint32(len(mdp.event_names))
    bits = f"events must have no other bits than the {len(mdp.event_names)} that have names"
    yield bits, not stray.any(), lambda: hex(int(mdp.events.max()))
    adds = mdp.rewards.ndim == 4 and mdp.rewards.shape[:-1] == shape
    yield f"rewards must add one axis to next_state's, {shape}", adds, mdp.rewards
    has_valid_width = mdp.rewards.shape[-1] in (1, len(mdp.agents))
    yield (
        f"rewards must be 1, or one for each of the {len(mdp.agents)} agents",
        has_valid_width,
        mdp.rewards.shape[-1],
    )
    finite = np.isfinite(mdp.rewards)
    yield "rewards must be finite", bool(finite.all()), lambda: str(mdp.rewards[~finite][0])
    sums = "probabilities of a pair must be from 0 on and add up to 1"
    yield sums, _sums_to_one(mdp.probability), lambda: _sums(mdp.probability)
    distribution = mdp.start.shape == shape[:1] and _sums_to_one(mdp.start)
    start = f"start must be a distribution over the {shape[0]} states"
    yield start, distribution, lambda: _sums(mdp.start) if mdp.start.shape == shape[:1] else mdp.start
    joint = math.prod(mdp.action_counts)
    yield f"the agents' actions must make the {shape[1]} joint actions", joint == shape[1], joint
    arrays = [name for name in mdp.arrays() if name.startswith("scene_")]
    yield "a scene has cells and carriers, or neither", len(arrays) != 1, arrays


def _in_words(found: object) -> str:
    """Return a value, or the result of a function, for a message: arrays by type and shape."""
    if callable(found):
        found = found()
    if isinstance(found, np.ndarray):
        return f"an array of {found.dtype}, shape {found.shape}"
    if isinstance(found, str):
        return found[:100]
    return f"{found!r:.100}"


def _range(values: Array) -> str:
    return f"{values.min()} to {values.max()}"


def _sums(probability: Floats) -> str:
    """Return a text of the lowest value and the sums along the last axis."""
    return f"values from {probability.min():g} on, sums {_range(probability.sum(axis=-1))}"


def _distinct(names: tuple[object, ...]) -> bool:
    return all(map(is_text, names)) and len(set(names)) == len(names)


def _sums_to_one(probability: Floats) -> bool:
    """Return whether the last axis adds up to 1, as well as decimal fractions can."""
    total = np.asarray(probability.sum(axis=-1))
    return bool(probability.min() >= 0 and total.min() >= 1 - 1e-5 and total.max() <= 1 + 1e-5)
