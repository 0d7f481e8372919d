"""From YAML, or from Python values, to an `ExperimentConfig`; all problems are reported at once.

text -> document (plain values and their places) -> overrides -> ExperimentFile -> ExperimentConfig
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path as FilePath
from typing import Any, Final

from pydantic import ValidationError

from runner.config.document import MAX_DEPTH, Document, Path, Place, Problem, position_in, read_yaml, value_at
from runner.config.model import (
    EXPLORATION,
    LEARNERS,
    SECTION_OF,
    ExperimentConfig,
    ExperimentFile,
    Rewards,
    SeedRange,
    Tables,
)
from runner.config.schema import found, problems_in, refuse, schema_at
from runner.config.sections import ConfigSection, RecordingSection
from runner.config.shipped import config_path, suggestion
from runner.errors import ConfigError, shortened
from runner.util.humanize import size
from runner.util.packing import Packing
from runner.util.values import NAME_EXPECTED, NAME_PATTERN, Json, JsonView

MAX_BYTES: Final = 1 << 20
"""The largest file that is read; a configuration of a thousand lines is a twentieth of it."""
_MAX_SHOWN: Final = 80
_RIVALS: Final = {"seed": ("seeds",), "seeds": ("seed",), "mode": ("tables", "rewards")}
"""Keys that an override of another key replaces."""


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
        source: the file's name, for messages and as the default name of the experiment.

    Raises:
        ConfigError: as for `load`.
    """
    stem = FilePath(source).stem
    document = read_yaml(text, source)
    if document.value is None and not document.problems:
        raise ConfigError(f"{source}:1:1: the file is empty, expected at least `episodes`")
    if isinstance(document.value, Mapping) and {"base", "parameters"} <= document.value.keys():
        raise ConfigError(
            f"{source}: found a sweep, expected an experiment: `dualtaxi sweep run {source}` runs it."
        )
    return experiment_in(document, overrides, stem, named_by=f"the file's name, {stem!r},")


def from_mapping(
    values: Mapping[str, object], overrides: Sequence[str] = (), *, name: str = "experiment"
) -> ExperimentConfig:
    """Return the experiment that plain Python values describe, with the keys of a YAML file.

    Args:
        values: the contents of a file, or what `ExperimentConfig.to_mapping` returned; not changed.
        overrides: as for `load`.
        name: the name of the experiment if `values` has none.

    Raises:
        ConfigError: The values do not describe an experiment; a line for each problem.
    """
    if "made_by" in values:
        raise ConfigError(
            f"found a run made by {values['made_by']}: it was recorded from a training loop outside of this "
            "project, which alone can repeat it. It can be viewed, compared, verified and exported, but not "
            "run again, and its tables are not known."
        )
    return experiment_in(Document(values), overrides, name, named_by=repr(name))


def packing_from(values: Mapping[str, object]) -> RecordingSection:
    """Return the section `recording` of a configuration with these values."""
    try:
        return RecordingSection.model_validate(dict(values))
    except ValidationError as error:
        problems = problems_in(error, values, schema_at(("recording",)))
        raise refuse(problems, Document(values)) from None


def recorded_packing(config: JsonView) -> Packing:
    """Return how a recording was packed, by its configuration.

    Raises:
        ConfigError: the configuration has values that are not possible.
    """
    section = config.get("recording")
    names = [option.name for option in fields(Packing)]
    parts = {key: section[key] for key in names if key in section} if isinstance(section, Mapping) else {}
    return packing_from(parts).packing


def read_text(file: FilePath) -> str:
    """Return the text of a file.

    Raises:
        ConfigError: it cannot be read, is too large, or is not UTF-8.
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
    if file.suffix == ".py":
        raise ConfigError(
            f"{file}: found a Python file, expected a YAML file; `python {file}` runs a script."
        )
    if len(content) > MAX_BYTES:
        raise ConfigError(
            f"{file}: larger than {size(MAX_BYTES)}, expected a configuration of a few kilobytes"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: error.start]
        byte = content[error.start]
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
    put(document, [_parse(text) for text in overrides])
    file = None
    problems = document.problems
    try:
        file = ExperimentFile.model_validate(dict(document.value))
    except ValidationError as error:
        problems = [*problems, *problems_in(error, document.value)]
    unusable = {problem.path[0] for problem in problems if problem.path}
    usable = {key: value for key, value in document.value.items() if key not in unusable}
    problems = [*problems, *_contradictions(usable)]
    if file and file.name is None and not re.fullmatch(NAME_PATTERN, name):
        problems.append(Problem(("name",), f"missing, and {named_by} cannot be it: expected {NAME_EXPECTED}"))
    if file is None or problems:
        raise refuse(problems, document)
    resolved = _resolved(file, name)
    try:
        return ExperimentConfig.model_validate(resolved)
    except ValidationError as error:
        raise refuse(problems_in(error, resolved), document) from None


def _contradictions(given: JsonView) -> list[Problem]:
    """Return the problems of keys that are valid alone and contradict each other."""
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


def _resolved(file: ExperimentFile, name: str) -> dict[str, object]:
    """Return the values of the resolved experiment, without the shorthands of `file`."""
    values = {key: getattr(file, key) for key in ExperimentConfig.model_fields}
    values["name"] = file.name or name
    values["tables"], values["rewards"] = _learners(file)
    values["exploration"] = file.exploration or EXPLORATION[values["tables"]]
    for key, section in SECTION_OF.items():
        if values[key] is None:
            del values[key]
            if file.algorithm == section.algorithm:
                values[key] = section()
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


# --- overrides ----------------------------------------------------------------------------------------


def put(document: Document, values: Sequence[tuple[tuple[str, ...], Document]]) -> None:
    """Put values at paths of `document`, whose value must be a mapping; each brings its own places.

    A key on the way that holds something else than a mapping becomes one. A section that the document does
    not mention starts from its default, so that only the value named is changed.
    """
    assigned: set[str] = set()
    for path, read in values:
        assigned.add(path[0])
        rivals = _RIVALS.get(path[0], ())
        if path == ("algorithm",):  # the sections of all others
            rivals = tuple(key for key, section in SECTION_OF.items() if section.algorithm != read.value)
        for rival in rivals:
            if rival not in assigned:
                document.value = {key: kept for key, kept in document.value.items() if key != rival}
                document.problems = _without(document.problems, (rival,))
        for length in range(1, len(path)):
            if not isinstance(value_at(document.value, path[:length]), Mapping | list | tuple):
                start = {} if path[0] in document.value else _default(path[0])
                place = {here: place for here, place in read.places.items() if not here}
                _assign(document, path[:length], Document(start, place))
        _assign(document, path, read)


def _parse(text: str) -> tuple[tuple[str, ...], Document]:
    excerpt = shortened(text, _MAX_SHOWN)
    source = excerpt if excerpt.isprintable() else repr(excerpt)
    key, separator, value = text.partition("=")
    path = tuple(key.strip().split("."))
    if not separator or not all(path):
        raise ConfigError(f"{source}: expected KEY=VALUE, such as epsilon=0.2 or evaluation.trials=50")
    if len(path) > MAX_DEPTH:
        raise ConfigError(f"{source}: expected a key of at most {MAX_DEPTH} parts")
    read = read_yaml(value, source, lines=False)
    read.places[()] = Place(source)
    return path, read


def _assign(document: Document, path: tuple[str, ...], read: Document) -> None:
    for old in [place for place in document.places if place[: len(path)] == path]:
        del document.places[old]
    document.value = _with(document.value, path, read.value)
    document.places |= {(*path, *below): place for below, place in read.places.items()}
    document.problems = _without(document.problems, path)
    document.problems += [problem._replace(path=(*path, *problem.path)) for problem in read.problems]


def _without(problems: list[Problem], path: Path) -> list[Problem]:
    """Return the problems except those of the value at `path`; problems of the text itself stay."""
    return [problem for problem in problems if problem.place or problem.path[: len(path)] != path]


def _with(value: object, path: Path, new: object) -> Any:
    """Return `value` with `new` at `path`; only mappings and lists on the path are copied."""
    if not path:
        return new
    key = path[0]
    below = path[1:]
    if isinstance(value, list | tuple) and (at := position_in(value, key)) is not None:
        return [*value[:at], _with(value[at], below, new), *value[at + 1 :]]
    mapping = dict(value) if isinstance(value, Mapping) else {}
    return {**mapping, key: _with(mapping.get(key), below, new)}


def _default(key: str) -> Json:
    field = ExperimentFile.model_fields.get(key)
    default = field.default if field else None
    return default.model_dump(mode="json", exclude_unset=True) if isinstance(default, ConfigSection) else {}
