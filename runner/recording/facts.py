"""What a recording says of its run and environment, checked: anyone may have written the file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final

from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.mdp import MAX_AGENTS, MAX_ARRAYS_BYTES, MAX_EVENTS, Mdp, from_parts
from runner.recording import schema
from runner.recording.arrays import unpack_array
from runner.recording.contents import MAX_METADATA_BYTES
from runner.recording.index import Index

_FACTS: Final = {
    **dict.fromkeys(("run_id", "name", "job", "created", "agents")),
    "seed": 2**64 - 1,
    "learners": MAX_AGENTS,
    "events": MAX_EVENTS,
}
"""What every recording says of its run; of a number, the largest it can be."""


def check_facts(run: Mapping[str, str], index: Index, path: str) -> None:
    """Refuse a file that is of another version, or does not say what every recording says.

    Raises:
        RecordingError: it is one.
    """
    topics = {topic.channel: topic.name for topic in schema.TOPICS}
    for number, channel in index.channels.items():
        if topics.get(number) != channel.topic:
            raise RecordingError(
                f"{path}: found channel {number} for {channel.topic!r}, "
                f"expected {topics.get(number)!r}: not written by dualtaxi."
            )
    check_run(run, path)


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
            raise RecordingError(f"{path}: is damaged: of its run it says that {name} is {said!r}.")


def json_object(text: str | bytes | None, what: str) -> dict[str, Any]:
    """Return the JSON object in a text.

    Raises:
        RecordingError: it holds none, or is too long; `what` is named.
    """
    try:
        if text is None or len(text) > MAX_METADATA_BYTES:
            raise ValueError("none, or too long")
        return dict(json.loads(text))
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


def environment_of(description: dict[str, Any], attachment: Callable[[str], bytes], path: str) -> Mdp:
    """Return the environment that a recording describes.

    Args:
        description: what `environment.json` says.
        attachment: gives an attachment by its name.
        path: of the recording, for errors.

    Raises:
        RecordingError: an array is missing, damaged or too large.
        EnvironmentNotUsable: the parts contradict each other.
    """
    names = description.pop("arrays", None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RecordingError(f"{path}: environment.json does not name the environment's arrays.")
    arrays: dict[str, NDArray[Any]] = {}
    for name in names:
        data = attachment(f"environment/{name}.npy.zst")
        room = MAX_ARRAYS_BYTES - sum(array.nbytes for array in arrays.values())
        arrays[name] = unpack_array(data, room, f"{path}: environment/{name}")
    return from_parts(description, arrays)
