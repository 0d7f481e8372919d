"""What is submitted, checked before it is queued: by child processes with limits on time and memory.

A check imports the environment, whose code and memory have no place in the server.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from runner.config import from_text
from runner.config.document import Document, Problem, read_yaml
from runner.config.loading import MAX_BYTES
from runner.config.problems import refuse
from runner.errors import ConfigError, RunnerError
from runner.service.jobs.queue import Kind
from runner.service.processes import ProcessPool, busy
from runner.util.processes import OutOfMemory, ProcessDied, TimedOut

PROCESSES: Final = 2
"""Texts that are checked at the same time."""
CHECK_SECONDS: Final = 30.0
MEMORY_BYTES: Final = 1 << 30
"""Of the check of an environment, whose arrays may have 128 MiB."""
PATIENCE_SECONDS: Final = 30.0
"""Time until a check that had no turn is refused."""
IDLE_SECONDS: Final = 60.0
"""After which an idle process is ended: what it has loaded takes memory."""
MAX_RUNS: Final = 10_000
SWEEP_KEYS: Final = ("base", "parameters", "strategy")
"""A file that has one of them is a sweep."""


@dataclass(frozen=True)
class Checked:
    """What a submitted text means."""

    kind: Kind
    name: str
    runs: int
    bytes: int
    """About what its recordings will take; 0 if nobody knows."""
    values: dict[str, Any]
    """The configuration, or the sweep, every value present."""


def check(text: str, source: str, recordings: Path) -> Checked:
    """Return what the text of a configuration or a sweep means.

    Args:
        text: of a YAML file.
        source: the file's name, for messages; it names what has no name of its own.
        recordings: the folder that runs would go to.

    Raises:
        ConfigError: it cannot be used; a line for each problem, with line, column and key.
    """
    document = read_yaml(text, source)
    is_sweep = isinstance(document.value, Mapping) and not document.value.keys().isdisjoint(SWEEP_KEYS)
    checked = (_sweep if is_sweep else _config)(text, source, document, recordings)
    if checked.runs > MAX_RUNS:
        raise ConfigError(f"{source}: makes {checked.runs:,} runs, expected at most {MAX_RUNS:,} in a job.")
    return checked


def _config(text: str, source: str, document: Document, recordings: Path) -> Checked:
    from runner.environments.loading import load_mdp
    from runner.execution.estimate import estimate, step_limit
    from runner.execution.initial_tables import settled

    config = from_text(text, source)
    _refuse_paths({("initial_q",): document.value.get("initial_q")}, document)
    with _told_at(("env",), document):
        load_mdp(config.env.id, config.env.kwargs, config.rewards)
    with _told_at(("initial_q",), document):
        config = settled(config, recordings)
    limit, seeds = step_limit(config), len(config.seeds)
    size = estimate(config, limit).typical_bytes * seeds if limit else 0
    return Checked("config", config.name, seeds, size, config.to_mapping())


@contextlib.contextmanager
def _told_at(key: tuple[str, ...], document: Document) -> Iterator[None]:
    """Tell what goes wrong here at the line of a key."""
    try:
        yield
    except RunnerError as error:
        raise refuse([Problem(key, str(error))], document) from None


def _sweep(text: str, source: str, document: Document, recordings: Path) -> Checked:
    from runner.sweep import state
    from runner.sweep.loading import from_text as sweep_in
    from runner.sweep.names import sweeps_in
    from runner.sweep.search import Search, require_optuna

    require_optuna()
    sweep = sweep_in(text, source)
    base, parameters = document.value["base"], document.value["parameters"]
    told: dict[tuple[str | int, ...], Any] = {("base", "initial_q"): base.get("initial_q")}
    for path, choices in parameters.items():
        if path.split(".")[0] == "initial_q" and isinstance(choices, list):
            told |= {("parameters", path, i): choice for i, choice in enumerate(choices)}
    _refuse_paths(told, document)
    values, runs = sweep.to_mapping(), Search(sweep.file).trials * len(sweep.seeds)
    if sweep.name in sweeps_in(recordings):
        before = state.read_sweep(sweep.name, recordings).to_mapping()
        if differing := ", ".join(key for key, _, _ in state.differences(before, values)):
            message = (
                f"a sweep {sweep.name!r} is here already, and differs in {differing}; name this otherwise"
            )
            raise refuse([Problem(("name",), message)], document)
    return Checked("sweep", sweep.name, runs, 0, values)


def _refuse_paths(starts: Mapping[tuple[str | int, ...], Any], document: Document) -> None:
    """Refuse to begin with the table of a recording that is named by its path.

    Raises:
        ConfigError: one is.
    """
    problems = []
    for where, start in starts.items():
        run = start.get("run") if isinstance(start, Mapping) else start
        if isinstance(run, str) and ("/" in run or "\\" in run or run.endswith(".mcap")):
            place = (*where, "run") if isinstance(start, Mapping) else where
            problems.append(Problem(place, f"found the path {run!r}, expected the id or name of a run here"))
    if problems:
        raise refuse(problems, document)


class Checker:
    """Checks texts in a few child processes; may be used by any thread.

    Args:
        recordings: the folder that runs would go to.
    """

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._pool = ProcessPool(PROCESSES, CHECK_SECONDS, MEMORY_BYTES, IDLE_SECONDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the processes."""
        self._pool.close()

    async def check(self, text: str, source: str) -> Checked:
        """Return what a text means, without holding a thread of the server; see the function `check`.

        Raises:
            ConfigError: besides, it is too large, or its check took too long or too much memory.
            Busy: others were being checked all the time.
        """
        future = self._submitted(text, source)
        waiting = asyncio.wrap_future(future)
        done, _ = await asyncio.wait({waiting}, timeout=PATIENCE_SECONDS)
        if not done and future.cancel():
            raise busy()
        with _blamed(source):
            return await waiting

    def check_now(self, text: str, source: str) -> Checked:
        """Return what a text means, for a thread that may wait; errors as for `check`."""
        with _blamed(source):
            return self._submitted(text, source).result()

    def _submitted(self, text: str, source: str) -> Future[Checked]:
        if len(text) > MAX_BYTES or len(text.encode()) > MAX_BYTES:
            raise ConfigError(f"{source}: larger than 1 MiB, expected a configuration of a few kilobytes")
        return self._pool.submit(_check, text, source, self._recordings)


@contextlib.contextmanager
def _blamed(source: str) -> Iterator[None]:
    """Raise as a mistake of the text that its check exceeded a limit, or ended its process."""
    try:
        yield
    except TimedOut:
        message = f"took longer than {CHECK_SECONDS:g} s to check; is env.kwargs sound?"
    except OutOfMemory:
        message = f"its environment needs more than {MEMORY_BYTES / (1 << 30):g} GiB of memory to be made."
    except ProcessDied:
        message = "its environment ended the process that was checking it."
    else:
        return
    raise ConfigError(f"{source}: {message}")


def _check(text: str, source: str, recordings: Path) -> Checked:
    """Return what a text means; every other error becomes a `ConfigError`, which can be pickled."""
    try:
        return check(text, source, recordings)
    except ConfigError as error:
        raise ConfigError(str(error), error.problems) from error
    except RunnerError as error:
        raise ConfigError(f"{source}: {error}") from error
