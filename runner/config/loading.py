"""From YAML, or from Python values, to an `ExperimentConfig`; whatever is wrong is told at once.

text -> document (plain values and their places) -> overrides -> ExperimentFile -> ExperimentConfig
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

from pydantic import ValidationError

from runner.config.document import Document, Place, Problem, read_yaml
from runner.config.file import ExperimentFile, SeedRange
from runner.config.model import (
    EXPLORATION,
    LEARNERS,
    OWN_SECTIONS,
    ExperimentConfig,
    Rewards,
    Tables,
)
from runner.config.overrides import override
from runner.config.problems import found, problems_in, refuse
from runner.config.sections import Recording
from runner.config.shipped import config_path, suggestion
from runner.errors import ConfigError
from runner.util.values import NAME_EXPECTED, NAME_PATTERN

MAX_BYTES = 1 << 20
"""The largest file that is read; a configuration of a thousand lines is a twentieth of it."""


def load(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> ExperimentConfig:
    """Return the experiment that a YAML file describes.

    Args:
        path: The file, or the name of a shipped experiment such as `quick`; the file's name without the
            ending names the experiment, unless it says another.
        overrides: `KEY=VALUE` each, as given to `--set`: the value is YAML, the key a path such as
            `evaluation.trials`. Later ones win.

    Raises:
        ConfigError: The file cannot be read, or does not describe an experiment. The message has a
            line for each problem, with file, line, column and key.
    """
    file = config_path(path)
    return from_text(read_text(file), os.fspath(file), overrides)


def from_text(text: str, source: str, overrides: Sequence[str] = ()) -> ExperimentConfig:
    """Return the experiment that the text of a file describes.

    Args:
        text: what stands in the file.
        source: the file's name, for messages; without its ending it names the experiment, as for `load`.
        overrides: as for `load`.

    Raises:
        ConfigError: as for `load`.
    """
    stem, document = FilePath(source).stem, read_yaml(text, source)
    if document.value is None and not document.problems:
        raise ConfigError(f"{source}:1:1: the file is empty, expected at least `episodes`")
    if isinstance(document.value, Mapping) and {"base", "parameters"} <= document.value.keys():
        raise ConfigError(
            f"{source}: found a sweep, expected an experiment: `dualtaxi sweep {source}` runs it."
        )
    return experiment_in(document, overrides, stem, named_by=f"the file's name, {stem!r},")


def from_mapping(
    values: Mapping[str, Any], overrides: Sequence[str] = (), *, name: str = "experiment"
) -> ExperimentConfig:
    """Return the experiment that plain Python values describe, under the keys of a YAML file.

    Args:
        values: What a file would say, or what `ExperimentConfig.to_mapping` returned; not changed.
        overrides: As for `load`.
        name: What the experiment is called when `values` has no name.

    Raises:
        ConfigError: The values do not describe an experiment; a line for each problem.
    """
    if "made_by" in values:
        raise ConfigError(
            f"found a run made by {values['made_by']}: it was recorded from somebody's own training loop, "
            "which alone can do it again. It can be looked at, compared, checked and exported, not redone, "
            "and no table is known of it."
        )
    return experiment_in(Document(values), overrides, name, named_by=repr(name))


def packing_from(values: Mapping[str, Any]) -> Recording:
    """Return how a recording is packed, as the `recording` section of a configuration says it.

    Raises:
        ConfigError: there is no such option, or a value is out of its bounds.
    """
    if not values:
        return Recording()
    try:
        return from_mapping({"episodes": 1, "recording": dict(values)}).recording
    except ConfigError as error:
        parts = (problem.message for problem in error.problems)
        keys = (problem.path.removeprefix("recording.") for problem in error.problems)
        lines = "\n".join(f"{key}: {part}" for key, part in zip(keys, parts, strict=True))
        raise ConfigError(lines or str(error), error.problems) from None


def read_text(file: FilePath) -> str:
    """Return what stands in a file.

    Raises:
        ConfigError: it cannot be read, is too large, or is no text.
    """
    try:
        with file.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file.{suggestion(file)}") from None
    except IsADirectoryError:
        raise ConfigError(f"{file}: found a directory, expected a YAML file") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{file}: larger than 1 MiB, expected a configuration of a few kilobytes")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before, byte = content[: error.start], content[error.start]
        place = Place(str(file), before.count(b"\n") + 1, error.start - before.rfind(b"\n"))
        raise ConfigError(f"{place}: found the byte 0x{byte:02x}, expected text in UTF-8") from None


def experiment_in(
    document: Document, overrides: Sequence[str], name: str, *, named_by: str
) -> ExperimentConfig:
    """Return the experiment that a document describes; arguments and errors as for `load`."""
    if not isinstance(document.value, Mapping):
        problem = Problem(
            (), f"found {found(document.value)}, expected keys and values, such as episodes: 1000"
        )
        raise refuse([*document.problems, problem], document)
    override(document, overrides)
    file, problems = _validated(document.value)
    problems = [*document.problems, *problems]
    unusable = {problem.path[0] for problem in problems if problem.path}
    problems += _contradictions({key: given for key, given in document.value.items() if key not in unusable})
    if file and file.name is None and not re.fullmatch(NAME_PATTERN, name):
        problems.append(Problem(("name",), f"missing, and {named_by} cannot be it: expected {NAME_EXPECTED}"))
    if file is None or problems:
        raise refuse(problems, document)
    resolved = _resolved(file, name)
    try:
        return ExperimentConfig.model_validate(resolved)
    except ValidationError as error:
        raise refuse(problems_in(error, resolved), document) from None


def _validated(values: Mapping[str, Any]) -> tuple[ExperimentFile | None, list[Problem]]:
    try:
        return ExperimentFile.model_validate(dict(values)), []
    except ValidationError as error:
        return None, problems_in(error, values)


def _contradictions(given: Mapping[str, Any]) -> list[Problem]:
    """Return where keys of which each is sound say different things."""
    problems = []
    mode = given.get("mode")
    if mode is not None:
        tables, rewards = LEARNERS[mode]
        means = f"mode: {mode} means tables: {tables} and rewards: {rewards}. Remove `mode`, or this key"
        for key, meant in (("tables", tables), ("rewards", rewards)):
            if given.get(key) not in (None, meant):
                problems.append(Problem((key,), f"found {given[key]!r}, but {means}"))
    if given.get("seed") is not None and given.get("seeds") is not None:
        problems.append(Problem(("seeds",), "given together with `seed`, expected one of them"))
    return problems


def _resolved(file: ExperimentFile, name: str) -> dict[str, Any]:
    """Return the values of the resolved experiment, with the shorthands of `file` spelled out."""
    values = {key: getattr(file, key) for key in ExperimentConfig.model_fields}
    values["name"] = file.name or name
    values["tables"], values["rewards"] = _learners(file)
    values["exploration"] = file.exploration or EXPLORATION[values["tables"]]
    for key, (algorithm, usual) in OWN_SECTIONS.items():
        if file.algorithm == algorithm and values[key] is None:
            values[key] = usual
    if isinstance(file.seeds, SeedRange):
        values["seeds"] = tuple(range(file.seeds.first, file.seeds.first + file.seeds.count))
    elif file.seeds is None:
        values["seeds"] = (file.seed or 0,)
    return values


def _learners(file: ExperimentFile) -> tuple[Tables, Rewards]:
    if file.mode:
        return LEARNERS[file.mode]
    if file.tables and file.rewards:
        return file.tables, file.rewards
    given = file.tables or file.rewards or "joint"
    return next(pair for pair in LEARNERS.values() if given in pair)
