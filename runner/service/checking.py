"""What is submitted, checked before it is queued: by a process of its own, which may be ended.

A check imports the environment, whose code and memory have no place in the server.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from runner.config import from_text
from runner.config.document import Document, Problem, read_yaml
from runner.config.loading import MAX_BYTES
from runner.config.problems import refuse
from runner.errors import ConfigError, RunnerError
from runner.service.queue import Kind

CHECK_SECONDS: Final = 30.0
IDLE_SECONDS: Final = 60.0
"""After which the process ends: what it has loaded takes memory."""
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
    from runner.environments import load_mdp
    from runner.estimate import estimate, step_limit
    from runner.origin import settled

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
    if sweep.name in state.sweeps_in(recordings):
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
    """A process that checks one text at a time, started when it is needed; it may be called by any thread.

    Args:
        recordings: the folder that runs would go to.
    """

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._context = multiprocessing.get_context("spawn")
        self._lock = threading.Lock()
        self._process: Any = None
        self._pipe: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            self._pipe.close()
            self._process.kill()
            self._process.join()
            self._process = None

    def check(self, text: str, source: str) -> Checked:
        """Return what a text means; arguments and errors as for the function `check`.

        Raises:
            ConfigError: besides, it is too large, or checking it takes too long.
        """
        if len(text) > MAX_BYTES or len(text.encode()) > MAX_BYTES:
            raise ConfigError(f"{source}: larger than 1 MiB, expected a configuration of a few kilobytes")
        with self._lock:
            answer = self._ask(text, source)
        if isinstance(answer, RunnerError):
            raise answer
        return answer

    def _ask(self, text: str, source: str) -> Checked | RunnerError:
        """Return what the process answers; one that does not is ended."""
        with contextlib.suppress(OSError, EOFError):
            if self._process is None or not self._process.is_alive():
                self._start()
            self._pipe.send((text, source))
            if self._pipe.poll(CHECK_SECONDS):
                answer: Checked | RunnerError = self._pipe.recv()
                return answer
            self.close()
            return ConfigError(
                f"{source}: took longer than {CHECK_SECONDS:g} s to check; is env.kwargs sound?"
            )
        self.close()
        return ConfigError(f"{source}: its environment ended the process that was checking it.")

    def _start(self) -> None:
        self.close()
        self._pipe, theirs = self._context.Pipe()
        self._process = self._context.Process(
            target=_serve, args=(theirs, self._recordings), name="checker", daemon=True
        )
        self._process.start()
        theirs.close()


def _serve(pipe: Any, recordings: Path) -> None:
    """Check what comes through a pipe, until it is closed; the process's main function."""
    from runner.service.doing.process import leave_signals

    leave_signals()
    with contextlib.suppress(EOFError, OSError):
        for text, source in _coming(pipe):
            try:
                pipe.send(check(text, source, recordings))
            except ConfigError as error:
                pipe.send(ConfigError(str(error), error.problems))
            except RunnerError as error:
                pipe.send(ConfigError(f"{source}: {error}"))


def _coming(pipe: Any) -> Iterator[tuple[str, str]]:
    while pipe.poll(IDLE_SECONDS):
        yield pipe.recv()
