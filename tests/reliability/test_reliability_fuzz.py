"""The reader and hostile files, a few hundred of them; `make fuzz` tries a million, guided by coverage."""

from __future__ import annotations

import contextlib
import random
import re
import struct
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runner.errors import RecordingError, RunnerError
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from tests.reliability.hostile import (
    ATTACHMENT,
    CHUNK,
    METADATA,
    Record,
    attachment_body,
    chunk_body,
    join,
    metadata_body,
    mutate,
    split,
)
from tests.reliability.reading import read_everything, small_recordings

MEGABYTE = 1 << 20
MOST_MEMORY = 267.0
"""200 MB, and a chunk of 64 MiB."""
ROOT = Path(__file__).parents[2]
linux = pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    return small_recordings(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="session")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("hostile") / "hostile.mcap"


@pytest.fixture(scope="module")
def peak_of():
    """Return a function: the most memory that reading a file in every way takes at once, in MB."""
    command = [sys.executable, "-W", "error", "-m", "tests.reliability.peak"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, cwd=ROOT, text=True, **pipes) as reader:

        def peak(path):
            print(path, file=reader.stdin, flush=True)
            line = reader.stdout.readline()
            assert re.fullmatch(r"[\d.]+ [\d.]+\n", line), line + reader.stdout.read()
            return float(line.split()[1])

        yield peak


@given(seed=st.integers(0, 2**32), name=st.integers(0, 15), data=st.data())
@settings(max_examples=150, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
def test_a_hostile_file_is_read_or_refused(seed, name, data, recordings, path):
    rng = random.Random(seed)
    path.write_bytes(mutate(recordings[sorted(recordings)[name]], rng, lambda part: _noise(part, rng)))
    read_everything(path)


@given(seed=st.integers(0, 2**32), name=st.integers(0, 15))
@settings(max_examples=50, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
def test_a_hostile_file_is_repaired_or_refused(seed, name, recordings, path):
    rng = random.Random(seed)
    path.write_bytes(mutate(recordings[sorted(recordings)[name]], rng, lambda part: _noise(part, rng)))
    try:
        repair(path)
    except RunnerError:
        return
    assert not path.with_suffix(".repairing").exists()
    with open_recording(path) as recording:
        for topic in schema.JOB_TOPICS:
            recording.table(topic).count()


def _noise(part: bytes, rng: random.Random) -> bytes:
    """Return the bytes with a few of them changed, left out or repeated."""
    changed = bytearray(part or b"\0")
    for _ in range(rng.choice((1, 1, 4))):
        at = rng.randrange(len(changed))
        match rng.randrange(4):
            case 0:
                del changed[at : at + rng.randrange(9)]
            case 1:
                changed[at:at] = changed[at : at + rng.randrange(40)]
            case _:
                changed[at] = rng.randrange(256)
        changed = changed or bytearray(1)
    return bytes(changed)


def test_a_chunk_that_ends_within_a_record_is_refused(recordings, path):
    path.write_bytes(with_chunks(recordings["tiny-0"], [chunk_body(steps_of_zeros(999)[:-1], "zstd")], False))
    with open_recording(path) as recording:
        for read in (
            lambda: recording.train.steps.first_from("episode", 1),
            lambda: list(recording.train.steps.rows()),
            lambda: list(recording.train.steps.blocks()),
            recording.train.steps.count,
        ):
            with pytest.raises(RecordingError, match="not a multiple"):
                read()


# --- files made to exhaust ------------------------------------------------------------------------------


def with_chunks(data: bytes, bodies: list[bytes], finished: bool) -> bytes:
    """Return the recording with these chunks instead of its own, and no indexes behind them."""
    kept = [record for record in split(data) if record.opcode not in (CHUNK, 7)]
    return join(kept + [Record(CHUNK, body) for body in bodies], finished)


def steps_of_zeros(size: int) -> bytes:
    """Return equal messages of training steps with about this size."""
    one = blank_records(schema.TRAIN_STEP, layout_of("job", 2, 0).message(schema.TRAIN_STEP), 1).tobytes()
    return one * (size // len(one))


def message(topic: schema.Topic, payload: bytes) -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + len(payload), topic.channel, 0, 0, 0) + payload


BOMBS = {
    "chunks of 60 MB each": lambda: [chunk_body(steps_of_zeros(60 * MEGABYTE), "zstd")] * 4,
    "more unpacked than a thousand times the file": lambda: [chunk_body(bytes(64 * MEGABYTE), "zstd")] * 40,
    "messages of nothing": lambda: [chunk_body(message(schema.EVAL_METRICS_TOPIC, b"") * 400_000, "zstd")],
    "one message of 40 MB": lambda: [
        chunk_body(message(schema.TRAIN_METRICS_TOPIC, b"\x22" + bytes(40 * MEGABYTE)), "zstd")
    ],
    "chunks of nothing": lambda: [bytes(16) + struct.pack("<Q", 31) + bytes(16)] * 250_000,
    "a chunk that repeats itself": lambda: [
        chunk_body(b"", "", size=60 * MEGABYTE)[:-8]
        + struct.pack("<Q", len(zstandard.compress(bytes(2**28))))
        + zstandard.compress(bytes(2**28))
    ],
}
"""The chunks of each, made when a test needs them."""


@linux
@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("bomb", BOMBS)
def test_recordings_made_to_exhaust_memory_do_not(bomb, finished, recordings, path, peak_of):
    path.write_bytes(with_chunks(recordings["tiny-0"], BOMBS[bomb](), finished))
    assert peak_of(path) < MOST_MEMORY


def replaced(data: bytes, opcode: int, name: str, body: bytes) -> bytes:
    """Return the recording with another body for the metadata or attachment of a name."""
    at = 0 if opcode == METADATA else 16
    head = struct.pack("<I", len(name)) + name.encode()
    records = split(data)
    (place,) = [
        k
        for k, record in enumerate(records)
        if record.opcode == opcode and record.body[at : at + len(head)] == head
    ]
    records[place].body = body
    return join(records)


REWARDS = "environment/rewards.npy.zst"
ARRAY = b"\x93NUMPY\x01\x00\x80\x00"
HUGE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 9999999999), }".ljust(127) + b"\n"
DESCRIPTIONS = {
    "deeply nested": (METADATA, "config", lambda: described("[" * 10**6)),
    "config of 60 MB": (METADATA, "config", lambda: described("[[]," * 15 * MEGABYTE)),
    "a million entries": (
        METADATA,
        "provenance",
        lambda: metadata_body("provenance", {str(k): "" for k in range(10**6)}),
    ),
    "a scene of 50 MB": (
        ATTACHMENT,
        "environment.json",
        lambda: attachment_body("environment.json", b'{"scene": [' + b"{}," * 17 * MEGABYTE),
    ),
    "an array that is not what it says": (
        ATTACHMENT,
        REWARDS,
        lambda: attachment_body(REWARDS, zstandard.compress(ARRAY + b"x" * 128 + bytes(2**28))),
    ),
    "an array as large as can be said": (
        ATTACHMENT,
        REWARDS,
        lambda: attachment_body(REWARDS, zstandard.compress(ARRAY + HUGE)),
    ),
}
"""What each replaces, and a function that makes its body."""


def described(text: str) -> bytes:
    """Return the body of a configuration with this text."""
    return metadata_body("config", {"json": text})


@linux
@pytest.mark.parametrize("kind", DESCRIPTIONS)
def test_a_description_made_to_exhaust_memory_does_not(kind, recordings, path, peak_of):
    opcode, name, make_body = DESCRIPTIONS[kind]
    path.write_bytes(replaced(recordings["tiny-0"], opcode, name, make_body()))
    assert peak_of(path) < MOST_MEMORY


HEADERS = {
    "open brackets": b"(" * 5000,
    "signs that nest": b"-" * 9000 + b"1",
    "an empty type": b"{'descr': ('<f8',), 'fortran_order': False, 'shape': (0,), }",
    "numbers of Python 2": b"{'descr': '<f8', 'fortran_order': False, 'shape': (0L,), }",
    "objects": b"{'descr': '|O', 'fortran_order': False, 'shape': (0,), }",
}


@pytest.mark.parametrize("kind", HEADERS)
def test_an_array_whose_header_is_no_description_of_numbers_is_refused(kind, recordings, path):
    header = HEADERS[kind] + b"\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    body = attachment_body(REWARDS, zstandard.compress(array))
    path.write_bytes(replaced(recordings["tiny-0"], ATTACHMENT, REWARDS, body))
    with open_recording(path) as recording, pytest.raises(RecordingError, match=r"found no .* of numbers"):
        _ = recording.mdp


# --- files made to take for ever --------------------------------------------------------------------------


@pytest.mark.timeout(60)
def test_a_search_for_chunks_among_what_looks_like_them_ends(recordings, path):
    """Each of half a million places declares a chunk of all that follows."""
    size = 40 * MEGABYTE
    looks = struct.pack("<BQQQQII", 6, 0, 0, 0, 0, 1, 0)
    rubbish = bytearray(looks * (size // len(looks)))
    for at in range(0, len(rubbish), len(looks)):
        body = len(rubbish) - at - 9
        struct.pack_into("<Q", rubbish, at + 1, body)
        if at + len(looks) + 8 <= len(rubbish):
            struct.pack_into("<Q", rubbish, at + 9 + 16, body - 40)
    path.write_bytes(recordings["tiny-0"][:6000] + rubbish)
    with pytest.raises(RecordingError):
        repair(path)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("filler", [b"\6", b"\7", b"\0"])
def test_a_file_of_one_byte_repeated_is_done_with_at_once(filler, recordings, path):
    path.write_bytes(recordings["tiny-0"][:6000] + filler * (20 * MEGABYTE))
    read_everything(path)
    with contextlib.suppress(RunnerError):
        repair(path)
