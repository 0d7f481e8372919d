"""What a recording says of its run and environment, checked: anyone may have written the file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final

from numpy.typing import NDArray

from runner.environments.mdp import MAX_AGENTS, MAX_ARRAYS_BYTES, MAX_EVENTS, Mdp, from_parts
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.arrays import unpack_array
from runner.recording.blocks import Sizes, block_counts
from runner.recording.index import Index
from runner.recording.run_file import MAX_DEPTH, is_too_deep
from runner.recording.scan import MAX_METADATA_BYTES
from runner.recording.schema import Topic
from runner.recording.spaces import dtype_of, leaves_of
from runner.util.values import without_surrogates

_FACTS: Final = {
    **dict.fromkeys(("run_id", "name", "job", "created", "agents")),
    "seed": 2**64 - 1,
    "learners": MAX_AGENTS,
    "events": MAX_EVENTS,
}
"""What every recording says of its run; of a number, the largest it can be."""

NEEDED: Final = frozenset({"run", "config", "provenance"})
"""The metadata records without which nothing is known of a recording's messages."""


def check_facts(run: Mapping[str, str], index: Index, path: str) -> None:
    """Refuse a file that is of another version, or does not say what every recording says.

    Raises:
        RecordingError: it is one.
    """
    check_run(run, path)
    topics = {topic.channel: topic.name for topic in schema.KINDS[kind_of(run)]}
    for number, channel in index.channels.items():
        if topics.get(number) != channel.topic:
            raise RecordingError(
                f"{path}: found channel {number} for {channel.topic!r}, "
                f"expected {topics.get(number)!r}: not written by dualtaxi."
            )


def check_run(run: Mapping[str, str], path: str) -> None:
    """Refuse what is not said of a run of our version.

    Raises:
        RecordingError: something is missing, or makes no sense.
    """
    version = run.get("format_version", "?")
    if version != str(schema.FORMAT_VERSION):
        raise RecordingError(
            f"{path}: found a recording of version {version}, expected {schema.FORMAT_VERSION}: "
            "it takes another version of dualtaxi to read it."
        )
    for name, most in _FACTS.items():
        said = run.get(name, "")
        if not said or (most and not (said.isdecimal() and len(said) <= 20 and int(said) <= most)):
            raise _senseless(name, said, path)
    if not _are_names(run["agents"], int(run["learners"])):
        raise _senseless("agents", run["agents"], path)
    if kind_of(run) not in schema.KINDS:
        raise RecordingError(
            f"{path}: found a recording of the kind {run['kind']!r}, expected {', '.join(schema.KINDS)}."
        )
    environments = run.get("environments", "1")
    if not (environments.isdecimal() and len(environments) <= 7 and int(environments) > 0):
        raise _senseless("environments", environments, path)


def _senseless(name: str, said: str, path: str) -> RecordingError:
    return RecordingError(f"{path}: is damaged: of its run it says that {name} is {said[:200]!r}.")


def _are_names(agents: str, learners: int) -> bool:
    """Return whether a text lists a name for each learner."""
    try:
        names = json.loads(agents)
    except (ValueError, RecursionError):
        return False
    known = isinstance(names, list) and all(isinstance(name, str | int) for name in names)
    return known and len(names) == learners


def kind_of(run: Mapping[str, str]) -> str:
    """Return which of `schema.KINDS` a recording is, by its metadata record `run`."""
    return run.get("kind", "job")


def spaces_of(run: Mapping[str, str], path: str) -> dict[str, Any]:
    """Return the descriptions of the spaces, `observation` and `action`, that a loop's recording has.

    Raises:
        RecordingError: they are missing, or describe no spaces.
    """
    spaces = json_object(run.get("spaces"), f"{path}: the spaces of its run")
    for name in ("observation", "action"):
        leaves_of(spaces.get(name), f"{path}: the {name} space")
    return spaces


def sizes_of(run: Mapping[str, str], path: str) -> dict[Topic, Sizes]:
    """Return what `record_dtype` must know of each fixed-width topic of a recording.

    Raises:
        RecordingError: its spaces are not described.
    """
    learners, events, kind = int(run["learners"]), int(run["events"]), kind_of(run)
    action = observation = None
    if kind in ("step", "transition"):
        spaces = spaces_of(run, path)
        action, observation = (
            dtype_of(spaces[name], f"{path}: the {name} space") for name in ("action", "observation")
        )
        if action is None or observation is None:
            raise RecordingError(f"{path}: has a space of variable width, expected fixed ones in its kind.")
    return {
        topic: block_counts(topic, learners, events, action, observation)
        for topic in schema.KINDS[kind]
        if topic in schema.ALL_BLOCK_TOPICS
    }


def json_object(text: str | bytes | None, what: str) -> dict[str, Any]:
    """Return the JSON object in a text.

    Raises:
        RecordingError: it holds none, or is too long; `what` is named.
    """
    try:
        if text is None or len(text) > MAX_METADATA_BYTES:
            raise ValueError("none, or too long")
        found = dict(without_surrogates(json.loads(text), text))
        if is_too_deep(found):
            raise ValueError(f"it is nested more than {MAX_DEPTH} deep")
        return found
    except (TypeError, ValueError, RecursionError) as error:
        raise RecordingError(f"{what} holds no JSON object ({error}).") from error


def holes(repair: Mapping[str, Any], path: str) -> dict[str, list[list[int]]]:
    """Return what a repair says was lost: topic to [first, behind the last] numbers, in order.

    Raises:
        RecordingError: it does not say it so.
    """
    lost = repair.get("lost")
    if not isinstance(lost, dict) or not all(map(_are_holes, lost.values())):
        raise RecordingError(f"{path}: the metadata 'repair' does not say what was lost.")
    return lost


def _are_holes(found: Any) -> bool:
    if not isinstance(found, list) or not all(isinstance(hole, list) and len(hole) == 2 for hole in found):
        return False
    numbers = [number for hole in found for number in hole]
    whole = all(type(number) is int and 0 <= number < 2**62 for number in numbers)
    return whole and numbers == sorted(numbers)


def environment_said(text: bytes, path: str) -> dict[str, Any]:
    """Return what `environment.json` says.

    Raises:
        RecordingError: it does not name the environment's arrays and events.
    """
    said = json_object(text, f"{path}: environment.json")
    for key in ("arrays", "event_names", "success_events"):
        names = said.get(key)
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise RecordingError(f"{path}: environment.json does not name the environment's {key}.")
    return said


def environment_of(description: Mapping[str, Any], attachment: Callable[[str], bytes], path: str) -> Mdp:
    """Return the environment that a recording describes.

    Args:
        description: what `environment_said` found.
        attachment: gives an attachment by its name.
        path: of the recording, for errors.

    Raises:
        RecordingError: an array is missing, damaged or too large.
        EnvironmentNotUsable: the parts contradict each other.
    """
    if not description["arrays"]:
        raise RecordingError(
            f"{path}: has no transition table of {description.get('env_id')}, which is not tabular: it was "
            "recorded from a loop over it; `dualtaxi view` shows what was recorded."
        )
    arrays: dict[str, NDArray[Any]] = {}
    for name in description["arrays"]:
        data = attachment(f"environment/{name}.npy.zst")
        room = MAX_ARRAYS_BYTES - sum(array.nbytes for array in arrays.values())
        arrays[name] = unpack_array(data, room, f"{path}: environment/{name}")
    return from_parts(description, arrays)
