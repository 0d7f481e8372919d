"""Reading everything that a file may hold, in every way there is; the small recordings to begin from."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from runner.config import from_mapping
from runner.environments.naming import action_names, states_in_words
from runner.errors import RunnerError
from runner.recording import schema
from runner.recording.description import recorded_facts
from runner.recording.integrity import check_integrity
from runner.recording.reader import Recording, open_recording
from tests.runner.recording.making import LAKE, make_run

TINY: dict[str, Any] = {
    "name": "tiny",
    "mode": "competitive",
    "env": {"kwargs": {"map": ["+---+", "|A:B|", "+---+"], "max_episode_steps": 5}},
    "episodes": 1,
    "evaluation": {"every": 1, "trials": 1},
    "log": {"every_steps": 3},
    "snapshots": {"every": None},
}
"""Two learners and a dozen events, in a recording of some 10 KB."""
TINY_LAKE = LAKE | {
    "episodes": 1,
    "evaluation": {"every": 1, "trials": 1},
    "log": {"every_steps": 5},
    "snapshots": {"every": None},
}
PACKINGS: list[dict[str, Any]] = [
    {"compression": "zstd"},
    {"compression": "lz4"},
    {"compression": "none"},
    {"compression": "zstd", "index": "chunk"},
]


def small_recordings(folder: Path) -> dict[str, bytes]:
    """Return small recordings by name: packed in each way, of two environments, finished and cut off."""
    found = {}
    for made_of in (TINY, TINY_LAKE):
        for k, packing in enumerate(PACKINGS):
            data = make_run(folder, made_of, recording=packing).recording.read_bytes()
            found[f"{made_of['name']}-{k}"] = data
            found[f"{made_of['name']}-{k}-cut"] = data[: len(data) * 2 // 3]
    return found


def read_everything(path: Path) -> bool:
    """Read a file in every way; return whether it was opened, raise only what is no `RunnerError`."""
    with contextlib.suppress(RunnerError):
        check_integrity(path)
    try:
        recording = open_recording(path)
    except RunnerError:
        return False
    with recording:
        for part in (read_description, read_environment, *(reader_of(topic) for topic in schema.JOB_TOPICS)):
            with contextlib.suppress(RunnerError):
                part(recording)
        for part in (read_measures, read_episodes, read_snapshots):
            with contextlib.suppress(RunnerError):
                part(recording)
    return True


def read_description(recording: Recording) -> None:
    """Read the recording's description of its run."""
    recorded_facts(recording)
    assert isinstance(recording.provenance, dict)
    assert isinstance(recording.lost, dict)
    from_mapping(recording.config)


def read_environment(recording: Recording) -> None:
    """Read the environment and describe its states and actions."""
    mdp = recording.mdp
    states_in_words(mdp)
    action_names(mdp)


def reader_of(topic: schema.Topic) -> Any:
    """Return what reads all messages of a topic."""

    def read(recording: Recording) -> None:
        messages = sum(1 for _ in recording.table(topic).messages())
        assert recording.table(topic).count() >= 0
        if topic in schema.BLOCK_TOPICS:
            assert sum(len(block) for block in recording.table(topic).blocks()) <= max(messages, 1) << 32

    return read


def read_measures(recording: Recording) -> None:
    """Read the metrics of both phases."""
    recording.train.all_metrics()
    recording.eval.all_metrics()


def read_episodes(recording: Recording) -> None:
    """Read the first and the last episode of both phases."""
    for phase in schema.PHASES:
        for episode in (0, recording.phase(phase).episodes.count()):
            with contextlib.suppress(RunnerError):
                recording.phase(phase).episode_steps(episode)
        for blocks in (
            recording.phase(phase).steps_of_episodes(0, 1),
            recording.phase(phase).steps.rows(range(10**9, 10**12)),
        ):
            with contextlib.suppress(RunnerError):
                for _ in blocks:
                    pass


def read_snapshots(recording: Recording) -> None:
    """Read the snapshots, all of them and those around a step."""
    for _ in recording.snapshots():
        pass
    for _ in recording.snapshots(step=5):
        pass
