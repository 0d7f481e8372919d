"""Reading a sweep file; all problems are reported at once, with line and key."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from runner.config import ConfigError, ExperimentConfig, load
from runner.config.document import Document, Place, Problem, read_yaml, write_yaml
from runner.config.loading import experiment_in, put, read_text
from runner.config.model import SECTION_OF
from runner.config.schema import Schema, found, problems_at, problems_in, refuse, without_references
from runner.config.shipped import config_path
from runner.errors import RunnerError
from runner.sweep.model import Sweep, SweepFile, samples_of

MAX_NAME: Final = 50
"""The longest name of a sweep, which is part of a tag of its runs."""
_LEARNERS: Final = {"mode", "tables", "rewards"}
_MAX_COMBINATIONS: Final = 64
"""Maximum number of combinations tried to find values that are valid together."""
Checks = Mapping[str, Callable[[ExperimentConfig], object]]
"""By key of a configuration, such as `env`, a function that may refuse its value by a `RunnerError`."""
NO_CHECKS: Final[Checks] = {}


def load_sweep(path: str | os.PathLike[str], name: str | None = None, checks: Checks = NO_CHECKS) -> Sweep:
    """Return the sweep that a YAML file describes, or a shipped one such as `modes`.

    The name replaces the one in the file, or the file's own without its ending. The `ConfigError` of a bad
    file has a line for each problem, with file, line, column and key; `checks` as for `from_text`.
    """
    file = config_path(path)
    document = read_yaml(read_text(file), str(file))
    return _checked(_sweep(document, name, file.stem, file.parent), document, checks)


def from_text(text: str, source: str, checks: Checks = NO_CHECKS) -> Sweep:
    """Return the sweep that the text of a file describes, which cannot name another file as its base.

    `source` is the file's name, for messages and as the default name of the sweep; errors as of `load_sweep`.
    The checks are called with the base, and with experiments before their environments are made.
    """
    document = read_yaml(text, source)
    return _checked(_sweep(document, None, Path(source).stem, None), document, checks)


def from_values(values: Mapping[str, object]) -> Sweep:
    """Return the sweep that plain values describe, as `Sweep.to_mapping` returns them.

    Its parameters were checked when it was loaded; no environment is made to check them again.
    """
    return _sweep(Document(dict(values)), None, "sweep", Path())


def self_contained_text(path: str | os.PathLike[str]) -> str:
    """Return the text of an experiment or a sweep, with a base that is another file written out."""
    text = read_text(Path(path))
    values = read_yaml(text, str(path)).value
    if isinstance(values, Mapping) and isinstance(values.get("base"), str):
        return write_yaml(load_sweep(path).to_mapping())
    return text


@cache
def _schema() -> Schema:
    return without_references(SweepFile.model_json_schema())


def _sweep(document: Document, name: str | None, stem: str, folder: Path | None) -> Sweep:
    if not isinstance(document.value, Mapping):
        problem = Problem(
            (), f"found {found(document.value)}, expected keys and values, such as base and trials"
        )
        raise refuse([*document.problems, problem], document)
    if "base" not in document.value and "episodes" in document.value:
        message = "found an experiment, expected a sweep: `dualtaxi run` runs it"
        raise refuse([Problem((), message)], document)
    try:
        file = SweepFile.model_validate(dict(document.value))
        problems = document.problems
    except ValidationError as error:
        problems = [*document.problems, *problems_in(error, document.value, _schema())]
    if problems:
        errors = [refuse(problems, document)]
        if isinstance(document.value.get("base"), Mapping):
            try:
                experiment_in(_part(document, "base"), (), stem, named_by=repr(stem))
            except ConfigError as error:
                errors.append(error)
        raise _combined(errors)
    sweep_name = name or file.name or stem
    if len(sweep_name) > MAX_NAME:
        message = f"found {len(sweep_name)} characters, expected at most {MAX_NAME}: runs carry it"
        raise refuse([Problem(("name",), message)], Document(name) if name else document)
    base, values = _base(file, document, sweep_name, folder)
    resolved = file.model_copy(update={"name": sweep_name, "base": values})
    return Sweep(sweep_name, resolved, base)


def _combined(errors: Sequence[ConfigError]) -> ConfigError:
    """Return one error with the lines and problems of several, each once."""
    lines = dict.fromkeys(line for error in errors for line in str(error).split("\n"))
    problems = dict.fromkeys(problem for error in errors for problem in error.problems)
    return ConfigError("\n".join(lines), tuple(problems))


def _base(
    file: SweepFile, document: Document, name: str, folder: Path | None
) -> tuple[ExperimentConfig, dict[str, object]]:
    """Return the base with the sweep's name, seeds and recording, and the values that trials start from."""
    if isinstance(file.base, str):
        if folder is None:
            message = f"found the path {file.base!r}, expected the configuration itself: there is no folder"
            raise refuse([Problem(("base",), message)], document)
        path = folder / file.base
        with problems_at(("base",), document, ConfigError):
            text = read_text(path)
        load(path)  # reports every problem at its place in that file
        within = read_yaml(text, str(path))
    else:
        within = _part(document, "base")
    seeds = file.model_dump(mode="json")["seeds"]
    places = _places(document.places, "recording")
    recorded = {key: Document(value, _places(places, key)) for key, value in file.recording.items()}
    put(
        within,
        [
            (("name",), Document(name)),
            (("seeds",), Document(seeds, _places(document.places, "seeds"))),
            *((("recording", key), value) for key, value in recorded.items()),
        ],
    )
    base = experiment_in(within, (), name, named_by=repr(name))
    return base, _start_of_trials(base, given=within.value, parameters=file.parameters)


def _start_of_trials(
    base: ExperimentConfig, given: Mapping[str, object], parameters: Mapping[str, object]
) -> dict[str, object]:
    """Return the base as plain values, without the defaults that depend on a parameter of the sweep.

    The default of `exploration` depends on the learners, and the section of an algorithm on the algorithm:
    where these are searched over, each trial gets the default for its values.
    """
    values = base.to_mapping()
    followers = {"exploration": _LEARNERS} | {key: {"algorithm"} for key in SECTION_OF}
    for key, leaders in followers.items():
        if key not in given and leaders & set(parameters):
            values.pop(key, None)
    return values


def _part(document: Document, key: str) -> Document:
    """Return the part of a document under a key, with its places."""
    return Document(document.value.get(key), _places(document.places, key))


def _places(places: Mapping[tuple[str, ...], Place], key: str) -> dict[tuple[str, ...], Place]:
    return {where[1:]: place for where, place in places.items() if where[:1] == (key,)}


def _checked(sweep: Sweep, document: Document, checks: Checks) -> Sweep:
    """Return the sweep; try every bound and choice of each parameter, with values of the others that fit."""
    from runner.environments.loading import load_mdp

    for key, check in checks.items():
        with problems_at(("base", key), document, RunnerError):
            check(sweep.base)
    if not any(path.split(".")[0] == "env" for path in sweep.file.parameters):
        with problems_at(("base", "env", "id"), document, RunnerError):
            load_mdp(sweep.base.env.id, sweep.base.env.kwargs, sweep.base.rewards)
    errors = []
    for path, parameter in sweep.file.parameters.items():
        for number, sample in enumerate(samples_of(parameter)):
            try:
                experiment = _valid_experiment(sweep, path, sample, document)
                if number == 0 or path.split(".")[0] in ("env", "initial_q"):
                    with problems_at(("parameters", path, number), document, RunnerError):
                        for check in checks.values():
                            check(experiment)
                        load_mdp(experiment.env.id, experiment.env.kwargs, experiment.rewards)
            except ConfigError as error:
                errors.append(error)
    if errors:
        raise _combined(errors)
    return sweep


def _valid_experiment(sweep: Sweep, path: str, sample: object, document: Document) -> ExperimentConfig:
    """Return an experiment with a value of a parameter, and the first values of the others valid with it."""
    samples = {
        key: [sample] if key == path else samples_of(sweep_values)
        for key, sweep_values in sweep.file.parameters.items()
    }
    problem = None
    for values in itertools.islice(itertools.product(*samples.values()), _MAX_COMBINATIONS):
        try:
            return _experiment(sweep, dict(zip(samples, values, strict=True)), document)
        except ConfigError as error:
            problem = problem or error
    assert problem is not None
    raise problem


def _experiment(sweep: Sweep, values: Mapping[str, object], document: Document) -> ExperimentConfig:
    """Return the base with values; errors name the places of the parameters."""
    within = Document(sweep.start_of_trials)
    places = {path: document.place(("parameters", path)) for path in values}
    put(
        within,
        [
            (tuple(path.split(".")), Document(value, {(): place} if (place := places[path]) else {}))
            for path, value in sweep.applicable(values).items()
        ],
    )
    return experiment_in(within, (), sweep.name, named_by=repr(sweep.name))
