"""What a page plays of an episode, in one form for every recording; as JSON can hold it.

Frame k is the state after k steps, with the step that led there and the Q-values of the next choice. So an
episode of T steps has T + 1 frames. Texts that repeat are stored once, with the index of each frame's text.

Of a loop's episode only what the page shows is kept in memory: not the other steps, and no images.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.contents import ENDINGS, ending_of, require_steps
from runner.analysis.episodes import EpisodeRef
from runner.drawing import svg
from runner.environments.mdp import events_of
from runner.environments.naming import (
    actions_in_words,
    agent_actions,
    agent_actions_in_words,
    event_in_words,
    exploration_in_words,
    numbered_actions,
    spoken,
    states_in_words,
)
from runner.errors import RecordingError, shortened
from runner.export.values import (
    first_observed,
    is_image,
    names_in,
    number_names,
    observed,
    part_of,
    step_actions_in_words,
)
from runner.recording import schema
from runner.recording.environment import observation_names
from runner.recording.extras import filled
from runner.recording.reader import Recording
from runner.recording.spaces import Leaf, leaves_of
from runner.replay.recorded import reset_of
from runner.replay.steps import steps_of, whole_steps
from runner.replay.tables import TableReplay, tables_at
from runner.util.arrays import Array, Floats, Ints, Records
from runner.util.humanize import capitalised, counted
from runner.util.values import Json

MAX_STEPS: Final = 1000
"""Steps of an episode that a page shows; the page says so where an episode has more."""
MAX_VALUES: Final = 6
"""Q-values of a state that a page shows: the highest, and that of the action taken."""
_MAX_SERIES: Final = 32
"""The most numbers of an observation that a page shows, shared by all agents."""
_LEAST_SERIES: Final = 20
"""The least share of an agent, however many there are."""
_MAX_LETTERS: Final = 200
"""Letters of an action, a text or an array."""
_MAX_LOGGED: Final = 5000
"""Logged values that a page shows."""
_NEAR: Final = 1000
"""Logged values are shown from this many steps of the run before the part to as many after it."""
_MAX_LOGGED_LETTERS: Final = 300
"""Letters of a logged name or text."""

Value = float | int | str | None
"""A number; NaN and infinities as text; None where it is unknown."""
QValues = tuple[Floats, ...]
"""For each learner the Q-values in the states of T steps, [T, actions]; empty if they are unknown."""
Values = NDArray[Any] | list[Any]
"""Values of a space, of one size or not."""
Column = Array | list[str]
"""A part of a value at each of T steps: numbers [T, n], or texts."""


@dataclass(frozen=True)
class Words:
    """The texts of frames, or of steps."""

    agent: str
    """The agent; empty for all together."""
    name: str
    values: list[str]
    """The different texts."""
    at: list[int]
    """The index of each text."""


@dataclass(frozen=True)
class PlayerSeries:
    """A number at each frame."""

    agent: str
    """The agent; empty for all together."""
    kind: str
    """The group in which a page shows it, such as `observation`."""
    name: str
    values: list[Value]


@dataclass(frozen=True)
class Logged:
    """The values logged under a name near a part."""

    name: str
    at: list[int]
    """The number of steps of the run before each, as in `Playback.time`."""
    values: list[Value]


@dataclass(frozen=True)
class PlayerGrid:
    """The places of the things of a scene."""

    places: list[list[int]]
    """For each state: x, y (hundredths of a cell) and size (percent) of each thing."""
    at: list[int]
    """The index of each frame's state."""


@dataclass(frozen=True)
class Playback:
    """A part of an episode: T steps and T + 1 frames."""

    title: str
    description: str
    length: int
    """Steps of the whole episode."""
    first: int
    """The step with which this part begins."""
    end: str
    """How the episode ended, as text; empty if it did not."""
    agents: list[str]
    """The learners, each with its own reward."""
    before: list[Value]
    """The sum of each agent's earlier rewards; empty at the beginning."""
    reward: list[list[Value]]
    """For each step the reward of each agent."""
    actions: list[Words]
    """The actions of all agents together, or of each; a text for each step."""
    texts: list[Words]
    """Parts of states or observations that are texts, for each frame."""
    time: list[int]
    """The number of steps of the run before each frame, in training and evaluation together."""
    series: list[PlayerSeries] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What is left out, a sentence each."""
    logged: list[Logged] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    """The names of the environment's events."""
    event: list[int] = field(default_factory=list)
    """For each step, bit i: the i-th of the events occurred."""
    explored: list[int] = field(default_factory=list)
    """For each step, bit i: the i-th agent's part of the action was chosen at random."""
    choices: list[list[str]] = field(default_factory=list)
    """The names of the actions of each Q-table."""
    values: list[Json] = field(default_factory=list)
    """For each Q-table the highest values before each step, and that of the action taken."""
    grid: PlayerGrid | None = None
    trail: int = svg.TRAIL
    """The number of places that a trail joins."""

    def as_json(self) -> dict[str, object]:
        """Return its fields, and as `facts` what a page lists for each frame."""
        return asdict(self) | {"facts": [asdict(fact) for fact in self._facts()]}

    def _facts(self) -> Iterator[Words]:
        """Yield what is known of frames besides `texts`, of each agent or all together; empty for none."""
        rewards = np.array([self.before or [0] * len(self.agents), *self.reward], np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            returns = rewards.cumsum(axis=0).round(4)
        explored = [
            exploration_in_words(mask, self.agents) for mask in self.explored or [0] * len(self.reward)
        ]
        ways = [f" ({text}: chosen at random)" if text else "" for text in explored]
        for action in self.actions:
            numbers = [i for i, agent in enumerate(self.agents) if spoken(action.agent) in ("", agent)]
            names = [self.agents[i] for i in numbers]
            taken = [action.values[i] + way for i, way in zip(action.at, ways, strict=True)]
            yield _words(
                action.agent, "last action", ["" if self.first else "none yet: the episode begins", *taken]
            )
            yield _words(action.agent, "reward", ["", *(_signed(names, row) for row in rewards[1:, numbers])])
            if self.events:
                events = [
                    ", ".join(name for i, name in enumerate(self.events) if mask >> i & 1) or "none"
                    for mask in self.event
                ]
                yield _words(action.agent, "events", ["", *events])
            yield _words(action.agent, "return so far", [_signed(names, row) for row in returns[:, numbers]])


def playback_of(recording: Recording, at: EpisodeRef, limit: int = MAX_STEPS, first: int = 0) -> Playback:
    """Return what a page plays of an episode, ended or not: at most `limit` steps from step `first` on."""
    require_steps(recording, "show", may_redo=True)
    with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
        if not recording.tabular:
            return _loop_playback(recording, at, limit, first)
        number = at.number_in(recording)
        steps = steps_of(recording, at.phase, number)
        part = steps[first : first + limit]
        if not len(part):
            raise at.no_step(recording, len(steps), max(first, at.t))
        recording.mdp.check_steps(part, str(recording.path))
        values = _values(recording, part, at)
        ended = ending_of(recording, at.phase, number)
        return tabular_playback(recording, at, steps, ended, values, first, limit)


def titled(playback: Playback, names: Sequence[str]) -> Playback:
    """Return what a page plays, its title after the reasons for showing it: `Best trial: trial 3 of ...`.

    Its description says so if not all steps are there.
    """
    names_text = " and ".join(names)
    title = playback.title
    length = len(playback.reward)
    part = "" if length == playback.length else f" The first {length:,} steps are shown."
    return replace(
        playback,
        title=f"{capitalised(names_text)}: {title[0].lower()}{title[1:]}",
        description=playback.description + part,
    )


# --- jobs ---------------------------------------------------------------------------------------------


def tabular_playback(
    recording: Recording,
    at: EpisodeRef,
    steps: Records,
    ended: str,
    values: QValues,
    first: int,
    limit: int,
) -> Playback:
    """Return what a page plays of an episode whose states and actions the environment's table names.

    Of all its `steps`, which the environment can have, at most `limit` are shown, from step `first` on; the
    values are those of the steps shown. `ended` is a key of `ENDINGS`.
    """
    mdp = recording.mdp
    agents = recording.agents
    drawing = svg.drawing_of(recording.mdp)
    part = steps[first : first + limit]
    distinct, state_of = np.unique(np.append(part["state"], part["next_state"][-1]), return_inverse=True)
    grid = None
    if drawing is not None:
        grid = PlayerGrid(
            drawing.places(mdp, distinct).reshape(len(distinct), -1).tolist(), state_of.tolist()
        )
    states = [str(word) for word in states_in_words(mdp)[distinct]]
    named = agent_actions_in_words(mdp)
    actions = part["action"].tolist()
    taken = [actions] * len(values)
    if len(values) > 1:  # each learner has a table of its own actions
        taken = [
            list(actions_of_agent)
            for actions_of_agent in zip(*(agent_actions(mdp, action) for action in actions), strict=True)
        ]
    time = _frame_times((part["log_time"] // schema.STEP_NANOSECONDS).astype(np.int64))
    before = steps["rewards"][:first].sum(axis=0).tolist() if first else []
    return Playback(
        title=at.heading,
        description=_outcome_in_words(len(steps), ended, float(steps["rewards"].sum())),
        length=len(steps),
        first=first,
        end=ENDINGS[ended],
        agents=[spoken(agent) for agent in agents],
        before=[_short(value) for value in before],
        reward=_short_rows(part["rewards"]),
        actions=[_words("", "action", [named[action] for action in actions])],
        texts=[Words("", "state", states, state_of.tolist())],
        time=time,
        logged=_logged_near(recording, at.phase, time),
        events=[event_in_words(name) for name in mdp.event_names],
        event=events_of(mdp, part).tolist(),
        explored=part["explored"].tolist(),
        choices=[actions_in_words(mdp).tolist()] if len(agents) == 1 else numbered_actions(mdp),
        values=[_highest(*table) for table in zip(values, taken, strict=True)],
        grid=grid,
    )


def _values(recording: Recording, steps: Records, at: EpisodeRef) -> QValues:
    """Return each learner's Q-values in the states of an episode's steps; those of a trial do not change."""
    if not recording.has_tables:
        return ()
    try:
        if at.after is not None:
            tables = tables_at(recording, at.evaluation_in(recording).train_step)
            return tuple(table[steps["state"]] for table in tables)
        first = int(steps["step"][0])
        replay = TableReplay(recording, first)
        widths = [table.shape[1] for table in replay.tables]
        rows = replay.rows(first + len(steps))
    except RecordingError:
        return ()
    return tuple(rows[:, i, :width] for i, width in enumerate(widths))


def _highest(values: Floats, taken: list[int]) -> dict[str, object]:
    """Return the highest Q-values of each step, [action, value] pairs, and the action taken."""
    rows: dict[tuple[tuple[int, Value], ...], int] = {}
    row_of: list[int] = []
    for row, action in zip(values, taken, strict=True):
        best = np.argsort(-row, kind="stable")[:MAX_VALUES].tolist()
        choices = best if action in best else [*best[:-1], action]
        if len(row) <= MAX_VALUES:
            choices = sorted(choices)
        pairs = tuple((int(choice), _short(float(row[choice]))) for choice in choices)
        row_of.append(rows.setdefault(pairs, len(rows)))
    return {
        "rows": list(rows),
        "row": row_of,
        "taken": [int(action) for action in taken],
        "of": values.shape[1],
    }


# --- loops --------------------------------------------------------------------------------------------


def _loop_playback(recording: Recording, at: EpisodeRef, limit: int, first: int) -> Playback:
    """Return what a page plays of an episode: at most `limit` steps from step `first` on."""
    phase, number = recording.phase(at.phase), at.number_in(recording)
    length = len(episode := phase.episode(number))
    if not 0 <= first < length:
        raise at.no_step(recording, length, max(first, at.t))
    parts, notes = _shown_parts(recording)
    in_words = step_actions_in_words(recording, at.phase)
    agents = recording.agents if len(recording.agents) > 1 else ("",)
    before = np.zeros(len(recording.agents))
    rewards = [np.empty((0, len(before)))]
    numbers = [np.empty(0, np.int64)]
    log_times = [np.empty(0, np.int64)]
    actions: list[dict[str, str]] = []
    observations: list[list[Column]] = []
    reset = reset_of(recording, at.phase, number)
    for steps in _steps(recording, at.phase, number, first + limit):
        is_start = not first and not log_times[1:]
        if is_start and (value := first_observed(recording, at.phase, number, steps[0])) is not None:
            values: Values = [value] if phase.steps.dtype is None else np.array([value])
            observations.append([part.column(values) for part in parts])
        paid = steps["rewards"].astype(np.float64)
        earlier, seen = np.searchsorted(steps["t"], [first, first - 1]).tolist()
        before += paid[:earlier].sum(axis=0)
        window = steps[earlier:]
        rewards.append(paid[earlier:])
        log_times.append(window["log_time"].astype(np.int64))
        numbers.append(window["step"])
        actions += map(in_words, window)
        if seen < len(steps):
            after = observed(recording, steps[seen:])
            observations.append([part.column(after) for part in parts])
    reward = np.concatenate(rewards)
    if len(reward) != min(limit, length - first):
        raise RecordingError(f"{recording.path}: steps of this part of the episode were lost.")
    frames = _frame_times(np.concatenate(log_times) // schema.STEP_NANOSECONDS)
    ended = ending_of(recording, at.phase, number)
    total = None
    if len(records := phase.episodes.array(number, number + 1)):  # none if the file was cut off
        total = float(records["returns"].sum())
    elif first + limit >= length:
        total = float(before.sum() + reward.sum())
    begun = f" Reset with {reset.in_words}." if reset is not None and reset.in_words else ""
    texts, series = _frames(parts, observations, len(frames))
    extra_texts, extra_series = _extras(recording, at.phase, np.concatenate(numbers), notes)
    return Playback(
        title=at.heading + (f", in environment {episode.environment}" if recording.environments > 1 else ""),
        description=_outcome_in_words(length, ended, total) + begun,
        length=length,
        first=first,
        end=ENDINGS[ended],
        agents=[spoken(agent) for agent in recording.agents],
        before=[_short(value) for value in before.tolist()] if first else [],
        reward=_short_rows(reward),
        actions=[
            _words(agent, "action", (shortened(words.get(agent, "–"), _MAX_LETTERS) for words in actions))
            for agent in agents
        ],
        texts=[*texts, *extra_texts],
        time=frames,
        series=[*series, *extra_series],
        notes=notes,
        logged=_logged_near(recording, at.phase, frames),
    )


def _steps(recording: Recording, phase: str, episode: int, stop: int) -> Iterator[Records]:
    """Yield the steps of an episode to before t = `stop`, some at a time."""
    if not recording.phase(phase).steps.are_actions:
        yield from recording.phase(phase).episode(episode).rows(0, stop)
        return
    yield whole_steps(recording, phase, episode)[:stop]


@dataclass(frozen=True)
class _ShownPart:
    """A part of a space, and what is shown of it."""

    agent: str
    """The agent that it is of; empty where there is only one."""
    names: tuple[str, ...]
    """The names of its numbers, or of its text."""
    leaf: Leaf

    def column(self, values: Values) -> Column:
        """Return this part of T values."""
        if isinstance(values, list):
            parts = [part_of(value, self.leaf) for value in values]
            if self.leaf.dtype is None:
                return [shortened(text, _MAX_LETTERS) for text in parts]
        else:
            parts = part_of(values, self.leaf)
        return np.asarray(parts).reshape(len(parts), -1)[:, : len(self.names)].copy()


def _shown_parts(recording: Recording) -> tuple[list[_ShownPart], list[str]]:
    """Return what is shown of the observations, and a sentence on each thing that is not."""
    agents = recording.agents if len(recording.agents) > 1 else ()
    leaves = leaves_of(recording.spaces["observation"], f"{recording.path}: the observation space")
    parts = []
    notes = []
    unseen = 0
    known = observation_names(recording)
    left = max(_MAX_SERIES // len(agents), _LEAST_SERIES) if agents else _MAX_SERIES
    budget: defaultdict[str, int] = defaultdict(lambda: left)
    for leaf in leaves:
        agent = leaf.path[0] if leaf.path and leaf.path[0] in agents else ""
        skip = 1 if agent else 0
        name = ".".join(leaf.path[skip:])
        if leaf.dtype is None:
            parts.append(_ShownPart(agent, (name,), leaf))
            continue
        shape = leaf.dtype.shape
        count = math.prod(leaf.dtype.shape)
        if len(shape) > 1 and count > left:
            what = "an image" if is_image(leaf) else "an array"
            notes.append(f"{' '.join(filter(None, (agent, name))) or 'observation'}: {what}, {_sizes(shape)}")
            continue
        taken = min(count, budget[agent])
        budget[agent] -= taken
        unseen += count - taken
        names = tuple(islice(number_names(leaf, "", skip, known), taken))
        if names:
            parts.append(_ShownPart(agent, names, leaf))
    if unseen:
        notes.append(f"{unseen:,} more numbers of each observation are in the recording")
    return parts, notes


def _sizes(shape: tuple[int, ...]) -> str:
    return " × ".join(map(str, shape))


def _frames(
    parts: Sequence[_ShownPart], observations: Sequence[Sequence[Column]], frames: int
) -> tuple[list[Words], list[PlayerSeries]]:
    """Return the texts and the numbers of frames.

    The observations are columns of each part, without the first frame's if it is unknown.
    """
    texts, series = [], []
    for i, part in enumerate(parts):
        columns = [observation[i] for observation in observations]
        if part.leaf.dtype is None:
            column_texts = [text for column in columns for text in column]
            unknown = [""] * (frames - len(column_texts))
            texts.append(_words(part.agent, part.names[0] or "observation", unknown + column_texts))
            continue
        numbers = np.concatenate(columns).astype(np.float64)
        for name, series_values in zip(part.names, numbers.T.tolist(), strict=True):
            values: list[Value] = [None] * (frames - len(series_values)) + [*map(_short, series_values)]
            series.append(PlayerSeries(part.agent, "observation", name or "observation", values))
    return texts, series


def _extras(
    recording: Recording, phase: str, steps: Ints, notes: list[str]
) -> tuple[list[Words], list[PlayerSeries]]:
    """Return the values that the loop recorded with these steps, each at the frame before its step.

    Texts and arrays of varying length are words, all others series of numbers.
    """
    texts, series = [], []
    agents = recording.agents if len(recording.agents) > 1 else ()
    extras = recording.phase(phase).extras
    by_name = extras.at(steps) if extras else {}
    for name, values in by_name.items():
        agent = next((candidate for candidate in agents if name.startswith(f"{candidate}/")), "")
        if values.dtype.hasobject:
            cells = [_shortened(value) for value in filled(values).tolist()]
            texts.append(_words(agent, name.removeprefix(f"{agent}/"), [*cells, ""]))
            continue
        shape = values.shape[1:]
        columns = values.reshape(len(steps), -1)
        if columns.shape[1] > _MAX_SERIES:
            notes.append(f"{name}: {_sizes(shape)} numbers with each step")
            continue
        for label, column in zip(names_in(name.removeprefix(f"{agent}/"), shape), columns.T, strict=True):
            numbers = [None if value is None else _short(value) for value in column.tolist()]
            series.append(PlayerSeries(agent, "extras", label, [*numbers, None]))
    return texts, series


def _shortened(value: Any) -> str:
    """Return the beginning of a text or of an array; nothing for None."""
    if value is None or isinstance(value, str):
        return shortened(value or "", _MAX_LETTERS)
    return shortened(str(value[:_MAX_LETTERS].tolist()), _MAX_LETTERS)


# --- parts of both ------------------------------------------------------------------------------------


def _logged_near(recording: Recording, phase: str, time: Sequence[int]) -> list[Logged]:
    """Return what was logged near frames: a loop's numbers and texts, or a job's reports of training.

    `time` is that of the frames, as `Playback.time`; values logged in another phase than theirs are marked.
    """
    tick = schema.STEP_NANOSECONDS
    times = range(max(0, time[0] - _NEAR) * tick, (time[-1] + _NEAR) * tick + 1)
    entries: Iterator[tuple[str, int, Value]]
    if recording.eval.has_metrics:
        entries = (
            (name.replace("_", " "), report["log_time"], _short(report[name]))
            for report in recording.train.metrics.decoded(times=times)
            for name in ("epsilon", "step_size", "mean_length")
        )
    else:
        scalars = (
            (
                scalar["name"] if scalar["phase"] == phase else f"{scalar['name']} ({scalar['phase']})",
                scalar["log_time"],
                _short(scalar["value"]),
            )
            for scalar in recording.table(schema.SCALAR_TOPIC).decoded(times=times)
        )
        texts = (
            (text["name"], text["log_time"], text["message"][:_MAX_LOGGED_LETTERS])
            for text in recording.table(schema.LOG_TOPIC).decoded(times=times)
        )
        entries = islice(chain(scalars, texts), _MAX_LOGGED)
    by_name: dict[str, Logged] = {}
    for name, log_time, value in entries:
        logged = by_name.setdefault(name[:_MAX_LOGGED_LETTERS], Logged(name[:_MAX_LOGGED_LETTERS], [], []))
        logged.at.append(log_time // tick)
        logged.values.append(value)
    return list(by_name.values())


def _frame_times(after: Ints) -> list[int]:
    """Return the number of steps of the run before each of T + 1 frames, from those after T steps."""
    return [int(after[0]) - 1, *after.tolist()]


def _outcome_in_words(length: int, ended: str, total: float | None) -> str:
    """Return length, end and return of an episode as text; a return of None is unknown."""
    rewards = "" if total is None else f" Rewards sum to {total:,g}."
    return f"{counted(length, 'step')}, {ENDINGS[ended]}.{rewards}"


def _words(agent: str, name: str, texts: Iterable[str]) -> Words:
    """Return texts with each different one stored once."""
    numbers: dict[str, int] = {}
    at = [numbers.setdefault(text, len(numbers)) for text in texts]
    return Words(agent, name, list(numbers), at)


def _signed(names: Sequence[str], values: Floats) -> str:
    """Return the rewards of agents as text, without the name where there is one only."""
    texts = [
        f"{'+' * (value > 0)}{value:.10g}" if math.isfinite(value) else str(_short(value))
        for value in values.tolist()
    ]
    return ", ".join(map("{} {}".format, names, texts)) if len(names) > 1 else "".join(texts)


def _short(value: float) -> Value:
    """Round a number to five significant digits; NaN and infinities are texts."""
    if not np.isfinite(value):
        return "NaN" if np.isnan(value) else "inf" if value > 0 else "-inf"
    rounded = float(f"{value:.5g}")
    return int(rounded) if rounded == int(rounded) else rounded


def _short_rows(rows: Array) -> list[list[Value]]:
    """Round the numbers of rows."""
    return [[_short(value) for value in row] for row in rows.tolist()]
