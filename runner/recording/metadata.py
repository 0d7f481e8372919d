"""The description of a run and its environment in a recording: written, and read back with checks.

Anyone may have written a file that is read.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from io import BytesIO
from itertools import chain
from typing import Annotated, Final, TypedDict, cast

import numpy as np
import zstandard
from msgspec import Meta

from runner.environments.mdp import (
    MAX_AGENTS,
    MAX_ARRAYS_BYTES,
    MAX_EVENTS,
    EnvironmentDescription,
    Mdp,
    from_parts,
    scene_mistake,
)
from runner.errors import OtherVersion, RecordingError
from runner.recording import schema
from runner.recording.index import Index, beginning_of, channel_of
from runner.recording.layout import Layout, layout_of
from runner.recording.maker import MAKER_RECORD, EnvironmentMaker
from runner.recording.records import MAX_METADATA_BYTES
from runner.recording.spaces import leaves_of
from runner.recording.writer import RecordingFile, writing
from runner.util.arrays import Array
from runner.util.stored import Count, stored_as
from runner.util.values import MAX_JSON_DEPTH, Json, JsonView, is_too_deep, without_surrogates

REQUIRED_RECORDS: Final = frozenset({"run", "config", "provenance"})
"""The metadata records without which a recording's messages cannot be interpreted."""
RECORDING_STOPPED: Final = "recording stopped at step "
"""The beginning of the error of a loop that went on when recording failed."""
_PACKAGE: Final = "package."
_PACKAGES: Final = "packages"
"""The entry of the provenance with the versions of all packages: JSON, in zstd, in Base64."""
_MAX_PACKAGES_BYTES: Final = 1 << 20
_MAX_WINDOW: Final = 1 << 23
"""The most memory that zstd may take to unpack a text."""
_OF_SPACES: Final = ("dualtaxi.Step", "dualtaxi.Reset")
"""The messages whose fields follow from the spaces of the run."""
_RUN_TEXTS: Final = ("run_id", "name", "job", "created", "agents")
_RUN_COUNTS: Final = {"seed": 2**64 - 1, "learners": MAX_AGENTS, "events": MAX_EVENTS}
"""The numbers that every metadata record `run` has, and the largest possible value of each."""

LostRanges = dict[str, list[list[int]]]
"""Topic -> ranges (first, stop) of the numbers of messages."""
Attachments = Mapping[str, tuple[str, bytes]]
"""Name -> media type and content."""


class RecordedEnvironment(EnvironmentDescription):
    """The contents of `environment.json`."""

    arrays: Sequence[str]
    """The names of the arrays, each an attachment; empty without a transition table."""


# --- the run ------------------------------------------------------------------------------------------


def run_metadata(
    run_id: str, name: str, seed: int | None, job: str, created: str, agents: Sequence[str], events: int
) -> dict[str, str]:
    """Return the entries of the metadata record `run` that every recording has.

    Args:
        seed: its job's seed; None for a loop without one.
        job: the identity of its job.
        agents: the learners: one reward each.
        events: number of event counters of an episode.
    """
    return {
        "format_version": str(schema.FORMAT_VERSION),
        "run_id": run_id,
        "name": name,
        "seed": str(seed or 0),
        "job": job,
        "created": created,
        "agents": json.dumps(agents),
        "learners": str(len(agents)),
        "events": str(events),
        **({"seeded": "false"} if seed is None else {}),
    }


def check_file(layout: Layout, index: Index, path: str) -> None:
    """Check that a file has the schemas and channels of a layout.

    Raises:
        RecordingError: it has another schema or channel.
    """
    expected = beginning_of(layout)
    topics = {channel.id: channel for channel in expected.channels}
    if schema.TRAIN_EXTRA in layout.topics:
        topics |= {
            number: channel_of(topic)
            for number in index.channels
            if (topic := schema.TOPIC_OF.get(number)) is not None and topic.message is schema.EXTRA
        }
    for number in sorted(topics.keys() | index.channels.keys()):
        found = index.channels.get(number)
        channel = topics.get(number)
        if found != channel:
            raise RecordingError(
                f"{path}: found channel {number} for {found and found.topic!r}, "
                f"expected {channel and channel.topic!r}: not written by dualtaxi."
            )
    for message in expected.schemas:
        if index.schemas.get(message.id) != message and message.name in _OF_SPACES:
            raise RecordingError(
                f"{path}: found a schema of {message.name} that does not follow from the spaces of its run: "
                "not written by dualtaxi."
            )


def check_run(run: Mapping[str, str], path: str) -> None:
    """Refuse a metadata record `run` of another version, or without all entries with possible values.

    Raises:
        RecordingError: it is not.
    """
    version = run.get("format_version", "?")
    if version != str(schema.FORMAT_VERSION):
        raise OtherVersion(
            f"{path}: found a recording of version {version}, expected {schema.FORMAT_VERSION}: "
            "it takes another version of dualtaxi to read it."
        )

    def require(name: str, is_valid: bool) -> None:
        if not is_valid:
            raise RecordingError(f"{path}: is damaged: its run has {name} {run.get(name, '')[:200]!r}.")

    for name in _RUN_TEXTS:
        require(name, bool(run.get(name)))
    for name, limit in _RUN_COUNTS.items():
        require(name, _is_count(run.get(name, ""), limit))
    require("agents", _are_names(run["agents"], int(run["learners"])))
    if kind_of(run) not in schema.KINDS:
        raise RecordingError(
            f"{path}: found a recording of the kind {run['kind']!r}, expected {', '.join(schema.KINDS)}."
        )
    environments = run.get("environments", "1")
    require("environments", _is_count(environments, 10**7 - 1) and int(environments) > 0)


def _is_count(text: str, limit: int) -> bool:
    return text.isdecimal() and len(text) <= 20 and int(text) <= limit


def _are_names(text: str, count: int) -> bool:
    try:
        names = json.loads(text)
    except (ValueError, RecursionError):
        return False
    return isinstance(names, list) and len(names) == count and all(isinstance(n, str | int) for n in names)


def kind_of(run: Mapping[str, str]) -> str:
    """Return which of `schema.KINDS` a recording is, by its metadata record `run`."""
    return run.get("kind", "job")


def spaces_of(run: Mapping[str, str], path: str) -> Json:
    """Return the descriptions of the spaces, `observation` and `action`, that a loop's recording has."""
    spaces = json_object(run.get("spaces"), f"{path}: the spaces of its run")
    for name in ("observation", "action"):
        leaves_of(spaces.get(name), f"{path}: the {name} space")
    return spaces


def layout_of_run(run: Mapping[str, str], path: str) -> Layout:
    """Return the layout of the messages of a recording.

    Raises:
        RecordingError: it is of another version, or its metadata record `run` is damaged.
    """
    check_run(run, path)
    if schema.TRAIN_RESET in schema.KINDS[kind_of(run)]:  # it observes a value of a space
        spaces_of(run, path)
    learners, events = int(run["learners"]), int(run["events"])
    return layout_of(kind_of(run), learners, events, run.get("spaces", ""), "environments" in run)


def json_object(text: str | bytes | None, what: str) -> dict[str, object]:
    """Return the JSON object in a text.

    Raises:
        RecordingError: it holds none, is too long or nested too deeply; the message names `what`.
    """
    try:
        if text is None or len(text) > MAX_METADATA_BYTES:
            raise ValueError("it is missing, or too long")
        value = dict(without_surrogates(json.loads(text), text))
        if is_too_deep(value):
            raise ValueError(f"it is nested more than {MAX_JSON_DEPTH} deep")
        return value
    except (TypeError, ValueError, RecursionError) as error:
        raise RecordingError(f"{what} holds no JSON object ({error}).") from error


def unpacked(data: bytes, max_bytes: int) -> bytes:
    """Return a text that zstd packed, or its first `max_bytes` bytes.

    Raises:
        zstandard.ZstdError: it is damaged.
    """
    with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data) as stream:
        return stream.read(max_bytes)


class _Repair(TypedDict):
    """What a repair could not save."""

    lost: dict[str, list[Annotated[list[Count], Meta(min_length=2, max_length=2)]]]


def lost_ranges(repair: Mapping[str, object], path: str) -> LostRanges:
    """Return the messages that a repair could not save: by topic, ranges (first, stop) of their numbers.

    Raises:
        RecordingError: the metadata record has no such ranges.
    """
    where = f"{path}: the metadata 'repair' does not say what was lost"
    lost = stored_as(_Repair, repair, where)["lost"]
    for topic, ranges in lost.items():
        numbers = list(chain(*ranges))
        if numbers != sorted(numbers):
            raise RecordingError(f"{where}: found ranges of {topic[:100]} that are not in order.")
    return lost


# --- the environment ----------------------------------------------------------------------------------


def environment_attachments(description: JsonView, arrays: Mapping[str, Array]) -> Attachments:
    """Return the attachments that describe an environment: its description, and its arrays if it has any."""
    text = json.dumps({**description, "arrays": sorted(arrays)}, indent=1, sort_keys=True)
    return {"environment.json": ("application/json", text.encode())} | {
        f"environment/{name}.npy.zst": ("application/zstd", pack_array(arrays[name]))
        for name in sorted(arrays)
    }


def environment_description(text: bytes, path: str) -> RecordedEnvironment:
    """Return the description in `environment.json`.

    Raises:
        RecordingError: a value is missing or impossible.
    """
    where = f"{path}: environment.json"
    description = {"scene": None} | json_object(text, where)
    stored_as(RecordedEnvironment, description, where)
    mistake = scene_mistake(description["scene"], None, None, 0)
    if mistake is not None:
        raise RecordingError(f"{where}: {mistake}.")
    return cast(RecordedEnvironment, description)  # as it was written, to be compared


def environment_of(description: RecordedEnvironment, attachment: Callable[[str], bytes], path: str) -> Mdp:
    """Return the environment that a recording describes.

    Raises:
        RecordingError: an array is missing, damaged or too large.
    """
    if not description["arrays"]:
        raise RecordingError(
            f"{path}: has no transition table of {description['env_id']}, which is not tabular: it was "
            "recorded from a loop over it; `dualtaxi view` shows what was recorded."
        )
    arrays: dict[str, Array] = {}
    for name in description["arrays"]:
        data = attachment(f"environment/{name}.npy.zst")
        budget = MAX_ARRAYS_BYTES - sum(array.nbytes for array in arrays.values())
        arrays[name] = unpack_array(data, budget, f"{path}: environment/{name}")
    return from_parts(description, arrays)


# --- the provenance -----------------------------------------------------------------------------------


def packed_provenance(provenance: Mapping[str, str]) -> dict[str, str]:
    """Return the entries of the metadata record: the versions of packages, one each in it, in one of them."""
    packages = {key: text for key, text in provenance.items() if key.startswith(_PACKAGE)}
    others = {key: text for key, text in provenance.items() if key not in packages}
    return others | ({_PACKAGES: _packed_packages(tuple(packages.items()))} if packages else {})


@lru_cache(4)
def _packed_packages(packages: tuple[tuple[str, str], ...]) -> str:
    text = json.dumps({key.removeprefix(_PACKAGE): version for key, version in packages})
    return base64.b64encode(zstandard.ZstdCompressor(level=19).compress(text.encode())).decode()


def unpacked_provenance(entries: Mapping[str, str], path: str) -> dict[str, str]:
    """Return the provenance in the entries of its record.

    Raises:
        RecordingError: the versions of packages are damaged.
    """
    others = dict(entries)
    what = f"{path}: the packages of its provenance"
    try:
        data = base64.b64decode(others.pop(_PACKAGES, ""), validate=True)
        text = unpacked(data, _MAX_PACKAGES_BYTES)
    except (ValueError, zstandard.ZstdError) as error:
        raise RecordingError(f"{what} are damaged ({error}).") from error
    for name, version in (json_object(text, what) if data else {}).items():
        if not isinstance(version, str):
            raise RecordingError(f"{what} are damaged: found {version!r}, expected the version of {name}.")
        others[f"{_PACKAGE}{name}"] = version
    return others


# --- the file -----------------------------------------------------------------------------------------


def write_description(
    file: RecordingFile,
    run: Mapping[str, str],
    config: JsonView,
    provenance: Mapping[str, str],
    environment: Attachments,
    maker: EnvironmentMaker | None = None,
) -> None:
    """Write what makes a recording self-contained; `maker` is how a loop's environment was made."""
    with writing(file):
        file.begin(beginning_of(layout_of_run(run, str(file.path))))
        file.add_metadata("run", run)
        file.add_metadata("config", _json_entry(config))
        file.add_metadata("provenance", packed_provenance(provenance))
        if maker is not None:
            file.add_metadata(MAKER_RECORD, maker.to_metadata())
        for name, (media_type, data) in environment.items():
            file.add_attachment(name, media_type, data)


def write_maker(file: RecordingFile, phase: str, maker: EnvironmentMaker) -> None:
    """Write how the environment of a phase was made, if it has one of its own."""
    with writing(file):
        file.add_metadata(f"{MAKER_RECORD}/{phase}", maker.to_metadata())


def write_result(
    file: RecordingFile, status: str, result: Mapping[str, object], *, synced: bool = True
) -> None:
    """Write how the run ended, the index and the summary; `synced` is as for `RecordingFile.finish`."""
    with writing(file):
        file.finish(_json_entry({"status": status, **result}), synced=synced)


def _json_entry(value: Mapping[str, object]) -> dict[str, str]:
    return {"json": json.dumps(value, sort_keys=True)}


# --- arrays -------------------------------------------------------------------------------------------

_MAX_ARRAY_WINDOW: Final = 1 << 27
"""The most memory that zstd may take to unpack an array."""
_PREFIX: Final = b"\x93NUMPY\x01\x00"
"""Magic and version, before the length of the header in two bytes."""
_MAX_HEADER_BYTES: Final = 1024
_HEADER: Final = re.compile(
    rb"\{'descr': '([<|][biuf][1248])', 'fortran_order': (False|True), "
    rb"'shape': \(((?:\d{1,10}, ?){0,7}(?:\d{1,10})?)\), \} *\n"
)


def pack_array(array: Array) -> bytes:
    """Return an array as a `.npy` file, compressed with zstd."""
    buffer = BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return zstandard.ZstdCompressor(level=9).compress(buffer.getvalue())


def unpack_array(data: bytes, max_bytes: int, where: str) -> Array:
    """Return the array in a compressed `.npy` file; never unpickles or takes more memory than it declares.

    Raises:
        RecordingError: it holds no array, or one of more than `max_bytes`.
    """
    try:
        with zstandard.ZstdDecompressor(max_window_size=_MAX_ARRAY_WINDOW).stream_reader(data) as stream:
            return _read_array(stream, max_bytes, where)
    except (zstandard.ZstdError, ValueError, TypeError) as error:
        raise RecordingError(f"{where}: holds no array ({error}).") from error


def _read_array(stream: zstandard.ZstdDecompressionReader, max_bytes: int, where: str) -> Array:
    """Return the array in a `.npy` file of version 1.0, whose header is text in a fixed form.

    NumPy's own reader parses the header as Python, which a hostile one makes fail in many ways.
    """
    prefix = stream.read(len(_PREFIX))
    length = int.from_bytes(stream.read(2), "little")
    header = _HEADER.fullmatch(stream.read(min(length, _MAX_HEADER_BYTES)))
    if prefix != _PREFIX or header is None:
        raise RecordingError(f"{where}: found no `.npy` file of numbers, version 1.0.")
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(n) for n in header[3].split(b",") if n.strip())
    size = math.prod(shape) * dtype.itemsize
    if size > max_bytes:
        raise RecordingError(
            f"{where}: found an array of {size:,} bytes, expected {max_bytes:,} at most: the arrays of an "
            f"environment may take {MAX_ARRAYS_BYTES:,}."
        )
    flat = np.empty(math.prod(shape), dtype)
    target = flat.view(np.uint8).data
    filled = 0
    while filled < size and (more := stream.readinto(target[filled:])):
        filled += more
    if filled != size or stream.read(1):
        raise RecordingError(f"{where}: found an array of another size than the {size} bytes it declares.")
    return flat.reshape(shape, order="F" if header[2] == b"True" else "C")
