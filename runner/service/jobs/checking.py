"""Checks of what is submitted, in child processes with limits on time and memory.

A check imports the environment; neither its code nor its memory belongs in the server.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, TypeVarTuple

from runner.config import ExperimentConfig, from_text
from runner.config.document import Document, Problem, read_yaml
from runner.config.loading import MAX_BYTES
from runner.config.problems import problems_at, refuse
from runner.config.sections import RunTable
from runner.environments.loading import load_mdp
from runner.errors import ConfigError, RunnerError
from runner.execution.estimate import estimate, step_limit
from runner.execution.initial_tables import resolve_initial_q
from runner.replay.trust import require_listed
from runner.service.errors import Busy
from runner.service.jobs.store import CheckedJob
from runner.service.processes import ProcessPool
from runner.sweep import state, sweeps_in
from runner.sweep.loading import from_text as sweep_from_text
from runner.sweep.search import Search, require_optuna
from runner.util.humanize import size
from runner.util.processes import OutOfMemory, ProcessDied, TimedOut

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
        ConfigError: it cannot be used; a line for each problem, with line, column and key.
    """
    document = read_yaml(text, source)
    is_sweep = isinstance(document.value, Mapping) and not document.value.keys().isdisjoint(SWEEP_KEYS)
    check = _check_sweep if is_sweep else _check_config
    checked = check(text, source, document, recordings)
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
        return await self.call(source, _check_as_config_errors, text, source, self._recordings)

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


def _check_as_config_errors(text: str, source: str, recordings: Path) -> CheckedJob:
    """Return the meaning of a text; every other error becomes a `ConfigError`, whose cause stays behind."""
    try:
        return check(text, source, recordings)
    except ConfigError as error:
        raise ConfigError(str(error), error.problems) from error
    except RunnerError as error:
        raise ConfigError(f"{source}: {error}") from error
