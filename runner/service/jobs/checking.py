"""Checks of what is submitted, in child processes with limits on time and memory.

A check imports the environment; neither its code nor its memory belongs in the server.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVarTuple

from pydantic import BaseModel, Field, StrictFloat, StrictInt, StrictStr

from runner.analysis.episodes import EpisodeRef
from runner.config import ExperimentConfig, from_mapping, from_text
from runner.config.document import Document, Problem, read_yaml
from runner.config.loading import MAX_BYTES
from runner.config.schema import problems_at, refuse
from runner.config.sections import RunTable
from runner.debugging.explain import (
    DEFAULT_SEEDS,
    Question,
    ask,
    check_metric,
)
from runner.environments.gym_types import Space
from runner.environments.loading import load_mdp
from runner.errors import CannotRedo, ConfigError, RecordingError, RunnerError
from runner.execution.branching import OF_THE_WHOLE, branch_job, branch_name
from runner.execution.estimate import estimate, step_limit
from runner.execution.session import resolve_initial_q
from runner.export.values import acted, actions_at
from runner.loops.actions import parsed_action
from runner.recording.gym_spaces import restore_space
from runner.recording.reader import Recording, open_recording
from runner.recording.spaces import Description
from runner.replay.makers import why_not_rerun
from runner.replay.trust import require_listed
from runner.runs.run import Run
from runner.service.errors import Busy, expecting
from runner.service.jobs.store import CheckedJob
from runner.service.processes import ProcessPool
from runner.sweep import state, sweeps_in
from runner.sweep.model import from_text as sweep_from_text
from runner.sweep.trials import Search, require_optuna
from runner.util.humanize import size
from runner.util.jsonable import as_json
from runner.util.processes import OutOfMemory, ProcessDied, TimedOut
from runner.util.values import checked_run_name

Args = TypeVarTuple("Args")
PROCESSES: Final = 2
"""Checks that run at the same time."""
CHECK_SECONDS: Final = 30.0
MEMORY_BYTES: Final = 10**9
"""Memory limit of a check; the arrays of an environment may have 134 MB."""
QUEUE_SECONDS: Final = 30.0
"""Time until a check that has not begun is refused."""
DEFAULT_SOURCE: Final = "job.yaml"
"""The name of a text that was submitted without one."""
MAX_RUNS: Final = 10_000
SWEEP_KEYS: Final = ("base", "parameters", "strategy")
"""A file with one of these keys is a sweep."""


def check(text: str, source: str, recordings: Path) -> CheckedJob:
    """Return the meaning of the text of a YAML file, a configuration or a sweep.

    `source` is the file's name, for messages and as the default name of the job.

    Raises:
        ConfigError: it cannot be used; a line for each problem, with line, column and key. Its own cause may
            be any error; it stays in the process of the check.
    """
    try:
        document = read_yaml(text, source)
        is_sweep = isinstance(document.value, Mapping) and not document.value.keys().isdisjoint(SWEEP_KEYS)
        checked = (_check_sweep if is_sweep else _check_config)(text, source, document, recordings)
    except ConfigError as error:
        raise ConfigError(str(error), error.problems) from error
    except RunnerError as error:
        raise ConfigError(f"{source}: {error}") from error
    if checked.runs > MAX_RUNS:
        raise ConfigError(f"{source}: makes {checked.runs:,} runs, expected at most {MAX_RUNS:,} in a job.")
    return checked


def _check_config(text: str, source: str, document: Document, recordings: Path) -> CheckedJob:
    config = from_text(text, source)
    with problems_at(("env",), document, RunnerError):
        require_listed(config.env.id, config.env.kwargs)
        load_mdp(config.env.id, config.env.kwargs, config.rewards)
    with problems_at(("initial_q",), document, RunnerError):
        refuse_path(config)
        config = resolve_initial_q(config, recordings)
    limit, seeds = step_limit(config), len(config.seeds)
    size = estimate(config, limit).typical_bytes * seeds if limit else 0
    return CheckedJob("config", config.name, seeds, size, config.to_mapping(), config.seeds)


def _check_sweep(text: str, source: str, document: Document, recordings: Path) -> CheckedJob:
    require_optuna()

    def require_run(config: ExperimentConfig) -> None:
        refuse_path(config)
        resolve_initial_q(config, recordings)

    checks = {
        "env": lambda config: require_listed(config.env.id, config.env.kwargs),
        "initial_q": require_run,
    }
    sweep = state.with_resolved_tables(sweep_from_text(text, source, checks), recordings)
    values = sweep.to_mapping()
    runs = Search(sweep).trials * len(sweep.seeds)
    if sweep.name in sweeps_in(recordings):
        before = state.read_sweep(sweep.name, recordings).to_mapping()
        if differing := ", ".join(key for key, _, _ in state.differences(before, values)):
            message = f"a sweep {sweep.name!r} is here already, and differs in {differing}; rename this one"
            raise refuse([Problem(("name",), message)], document)
    return CheckedJob("sweep", sweep.name, runs, 0, values)


def refuse_path(config: ExperimentConfig) -> None:
    """Refuse an initial Q-table that is named by the path of its recording."""
    start = config.initial_q
    if isinstance(start, RunTable) and is_path(start.run):
        raise ConfigError(
            f"found the path {start.run!r} of a Q-table, expected the id or name of a run here."
        )


def is_path(name: str) -> bool:
    """Return whether a run or configuration is named by the path of a file."""
    return "/" in name or "\\" in name or name.endswith((".mcap", ".yaml", ".yml"))


class JobChecker:
    """Checks texts in a few child processes; thread-safe."""

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._pool = ProcessPool(PROCESSES, CHECK_SECONDS, MEMORY_BYTES)
        self.close = self._pool.close

    async def check(self, text: str, source: str = DEFAULT_SOURCE) -> CheckedJob:
        """Return the meaning of a text, without blocking a thread of the server; see the function `check`.

        Raises:
            ConfigError: as for `check`, or it is too large, or its check took too much time or memory.
        """
        if len(text) > MAX_BYTES or len(text.encode()) > MAX_BYTES:
            raise ConfigError(
                f"{source}: larger than {size(MAX_BYTES)}, expected a configuration of a few kilobytes"
            )
        return await self.call(source, check, text, source, self._recordings)

    async def call(self, source: str, function: Callable[[*Args], CheckedJob], *args: *Args) -> CheckedJob:
        """Return the job that a function returns in a child process; `source` begins the messages."""
        future = self._pool.submit(CHECK_SECONDS, function, *args)
        waiting = asyncio.wrap_future(future)
        done, _ = await asyncio.wait({waiting}, timeout=QUEUE_SECONDS)
        if not done and future.cancel():
            raise Busy
        try:
            return await waiting
        except TimedOut:
            message = f"took longer than {CHECK_SECONDS:g} s to check; is env.kwargs sound?"
        except OutOfMemory:
            message = f"its environment needs more than {size(MEMORY_BYTES)} of memory to be made."
        except ProcessDied:
            message = "its environment ended the process that was checking it."
        raise ConfigError(f"{source}: {message}")


Action = StrictStr | StrictInt | StrictFloat | list[StrictInt | StrictFloat]
"""An action in JSON: a name, a number, or the numbers of an array."""


class BranchQuestion(BaseModel, extra="forbid", frozen=True):
    """A change of a recorded step; the fields are the arguments of `runner.branch`."""

    at: Annotated[str | int, expecting("a step such as 120:5, or its number in training")] = Field(
        description="The first step that may differ: `EPISODE:T`; of training also `step:N` or its number; "
        "of an evaluation of a loop `eval:N:TRIAL:T`."
    )
    action: Annotated[
        Action | dict[str, Action] | None,
        expecting("a number or a name, numbers in a list, or a mapping from agents to these"),
    ] = Field(
        default=None,
        description="A joint action, or one by agent; names or numbers, of a loop also a list of numbers. "
        "Null: as recorded.",
    )
    overrides: Annotated[
        tuple[str, ...], expecting('a list of KEY=VALUE, such as ["epsilon=0.5", "step_size=0.1"]')
    ] = Field(default=(), description="Of training: `KEY=VALUE` each, as for `--set`.")
    episodes: int | None = Field(default=None, description="Of training: episodes in all.")
    policy: Literal["recorded", "random", "constant"] = Field(
        default="recorded", description="Of a loop: what acts after the step."
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Of a loop: the seed of the random policy.")
    name: str | None = Field(default=None, description="Name of the new run; `NAME.branch` by default.")


def check_branch(run: Run, question: BranchQuestion) -> CheckedJob:
    """Return the job of a branch of a run; the environment of a loop is not made."""
    from runner.debugging.branch import MAX_STEPS, branches_training, default_name  # slow to import

    at = EpisodeRef.parse(question.at)
    changes = question.overrides, question.episodes, question.policy, question.seed
    is_trained = branches_training(run, at, *changes, MAX_STEPS)
    with open_recording(run.recording) as recording:
        if is_trained:
            action: Any = question.action
            job, where = branch_job(recording, at, action, question.overrides, question.episodes)
            _require_change(recording, job.config, where)
            limit = recording.mdp.step_limit
            size = estimate(job.config, limit).typical_bytes if limit else 0
            name = branch_name(run, question.name)
            config = job.config
            return CheckedJob("branch", name, 1, size, config.to_mapping(), config.seeds)
        step = at.resolved(recording)
        step.steps_in(recording)
        if reason := why_not_rerun(recording):
            raise CannotRedo(reason)
        name = checked_run_name(question.name) or default_name(recording)
        _check_action(recording, step, question)
    values = {"run": run.run_id, **question.model_dump(mode="json"), "at": str(step)}
    return CheckedJob("episode", name, 1, 0, values, (0,))


def _require_change(recording: Recording, branch: ExperimentConfig, at: EpisodeRef) -> None:
    """Refuse a branch of training that repeats its parent."""
    change = branch.branches[-1]
    parent = from_mapping(recording.config)
    recorded: Mapping[str, str] = {}
    with contextlib.suppress(RecordingError):  # no steps were recorded
        recorded = actions_at(recording, at)
    is_of_whole = any(getattr(branch, key) != getattr(parent, key) for key in OF_THE_WHOLE)
    if not change.settings.given and change.actions.items() <= recorded.items() and not is_of_whole:
        raise ConfigError(
            f"nothing is changed: found the recorded actions at {at}, and the settings of run "
            f"{recording.run_id}; expected another action, other settings (overrides) or more episodes."
        )


def _check_action(recording: Recording, at: EpisodeRef, question: BranchQuestion) -> None:
    """Check an action of a loop, so far as the recording describes its space, and that it changes something.

    In a game, the agents that act at a step are known when it is played.
    """
    action = question.action
    is_recorded = question.action is None
    space = None if len(recording.agents) > 1 else known_space(recording.spaces["action"])
    if space is not None and action is not None:
        names = recording.phase(at.phase).action_names()
        parsed = parsed_action(space, action, space.sample(), names)
        with contextlib.suppress(RecordingError):  # the step is lost, which is reported when it is played
            step = recording.phase(at.phase).episode(at.number_in(recording)).one(at.t)
            is_recorded = as_json(parsed) == as_json(acted(recording, step))
    if is_recorded and question.policy == "recorded":
        raise ConfigError(
            f"nothing is changed: found the recorded action at {at}, and the recorded actions after it; "
            "expected another action, or other actions after it (policy: random or constant)."
        )


def known_space(description: Description) -> Space | None:
    """Return the space that a recording describes; None if Gymnasium has no such space."""
    try:
        return restore_space(description)
    except (AssertionError, LookupError, TypeError, ValueError, OverflowError):
        return None


class ExplainQuestion(BaseModel, extra="forbid", frozen=True):
    """What is to be explained; the fields are the arguments of `runner.explain`."""

    a: str = Field(description="A run here, or the name of a shipped configuration.")
    b: str = Field(description="Another.")
    metric: str | None = Field(default=None, description="A metric of evaluations.")
    at: int | None = Field(default=None, description="Training episodes; the end of each by default.")
    seeds: int = DEFAULT_SEEDS
    workers: int | None = Field(default=None, ge=1, description="Of the server; default: all of them.")

    def resolved(self, recordings: Path) -> Question:
        """Return the question with its runs and configurations read; none may be the path of a file."""
        return ask(
            self.a,
            self.b,
            metric=self.metric,
            at=self.at,
            seeds=self.seeds,
            recordings=recordings,
            require=refuse_path,
        )


def check_explanation(given: ExplainQuestion, recordings: Path) -> CheckedJob:
    """Return the job of an explanation, with runs by their ids."""
    for name, source in (("a", given.a), ("b", given.b)):
        if is_path(source):
            raise ConfigError(
                f"{name}: found the path {source!r}, expected a run here or a shipped configuration."
            )
    question = given.resolved(recordings)
    check_metric(question)
    runs = question.mixtures[1] * given.seeds
    if runs > MAX_RUNS:
        raise ConfigError(f"seeds: makes {runs:,} runs, expected at most {MAX_RUNS:,} in a job.")
    sides = {"a": question.a.run_id or question.a.name, "b": question.b.run_id or question.b.name}
    return CheckedJob("explain", question.name, runs, 0, given.model_dump() | sides)
