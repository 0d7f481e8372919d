"""A run's episodes as a Minari dataset, which libraries for offline reinforcement learning read."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from runner.analysis.contents import whole_ranges
from runner.errors import NotInRecording, RecordingError
from runner.export.values import acted, first_observed, observed
from runner.recording.gym_spaces import restore_space
from runner.recording.reader import Recording
from runner.recording.spaces import Description, Value
from runner.replay.recorded import reset_of
from runner.replay.trust import require_listed, trusting
from runner.runs.trust_marks import environment_of_job
from runner.util.arrays import Array, Flags, Floats
from runner.util.extras import require
from runner.util.values import Ranges

PATTERNS: Final = ("data/main_data.hdf5", "data/metadata.json")
_BATCH: Final = 500
"""Episodes written at a time: HDF5 frees the memory it uses for a file when that is closed."""

MAX_EPISODE_BYTES: Final = 1 << 30
"""The limit of one episode, which Minari needs in memory."""


@dataclass
class Written:
    """The result of an export."""

    episodes: int = 0
    steps: int = 0
    abandoned: int = 0
    """Episodes that were reset before their end."""
    notes: tuple[str, ...] = ()
    """What is missing or different from the recording."""


def require_packages() -> None:
    """Check that Minari and its storage are installed."""
    require("h5py", "minari", extra="minari", purpose="export minari")


def dataset_id(recording: Recording) -> str:
    """Return the name of a run's dataset: NAME-RUN-v0, with the characters that Minari allows."""
    return re.sub(r"[^\w-]", "_", f"{recording.name}-{recording.run_id}-v0")


def write_dataset(
    recording: Recording,
    folder: Path,
    phase: str,
    ranges: Ranges,
    report: Callable[[int], None],
) -> Written:
    """Write whole episodes into the empty folder of a dataset.

    For a job an observation is a state, an action the joint action; for a loop both are as they were. A
    reward is the sum over the learners; with several, `infos["rewards"]` has each, [steps + 1, learners],
    where the first row is 0 as of a reset, and in a loop `infos["acted"]` has which of them took part.
    `report` is called with the number of episodes written so far.

    Raises:
        RecordingError: there is no such episode, Minari cannot store it, or the recording is damaged.
    """
    import minari
    from minari.dataset.minari_storage import MinariStorage

    folder = folder.absolute()  # Minari takes a relative one as relative to itself
    ended = recording.phase(phase).episodes.count()
    whole = tuple(whole_ranges(ranges, ended, phase, str(recording.path))) or ((0, None),)
    observations, actions = _spaces(recording)
    spec, notes = _environment_spec(recording, observations, actions)
    (folder / "data").mkdir()
    storage = MinariStorage.new(
        folder / "data", observations, actions, spec, data_format="hdf5", jpeg_encoding=False
    )
    storage.update_metadata(
        {"dataset_id": dataset_id(recording), "minari_version": minari.__version__}
        | _description(recording, phase)
    )
    written = Written()
    number = 0

    def buffers() -> Iterator[object]:
        nonlocal number
        for episode in episodes_in(recording, phase, whole):
            number = episode.number
            yield _buffer(episode, written.episodes)
            written.episodes += 1
            written.steps += len(episode.rewards)
            written.abandoned += episode.is_abandoned
            report(written.episodes)

    remaining = buffers()
    for first in remaining:
        try:
            storage.update_episodes(chain([first], islice(remaining, _BATCH - 1)))
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"{recording.path}: {phase} episode {number} cannot be stored by Minari ({error})."
            ) from error
    if not written.episodes:
        raise RecordingError(f"{recording.path}: found no {phase} episode that ended, expected at least one.")
    written.notes = (*notes, *_missing(recording, phase, not ranges, written))
    return written


def _missing(recording: Recording, phase: str, is_all: bool, written: Written) -> list[str]:
    """Return what a dataset lacks or has otherwise than recorded, a sentence each."""
    notes = []
    ended, steps = (
        table.count() for table in (recording.phase(phase).episodes, recording.phase(phase).steps)
    )
    if written.abandoned:
        notes.append(
            f"{written.abandoned:,} episodes were reset before their end; "
            "their last step is marked as truncated."
        )
    if is_all and written.episodes < ended:
        lost = ended - written.episodes
        notes.append(f"{lost:,} episodes are left out, as steps or resets of them are missing.")
    elif is_all and recording.environments > 1:
        notes.append("Episodes that never ended are left out.")
    elif is_all and written.steps < steps:
        name = "training" if phase == "train" else "eval"
        notes.append(f"The last {name} episode never ended; it is left out.")
    return notes


def _buffer(episode: MinariEpisode, number: int) -> object:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    truncated = episode.truncated.copy()
    truncated[-1] |= episode.is_abandoned
    infos = None
    if episode.rewards.shape[1] > 1:
        infos = {"rewards": _with_reset(episode.rewards)}
        infos |= {} if episode.acted is None else {"acted": _with_reset(episode.acted)}
    return EpisodeBuffer(
        id=number,
        seed=episode.seed,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards.sum(axis=1),
        terminations=episode.terminated.copy(),
        truncations=truncated,
        infos=infos,
    )


def _with_reset(values: Array) -> Array:
    """Return the values of steps after a zero for the reset."""
    return np.concatenate([np.zeros_like(values[:1]), values])


def _description(recording: Recording, phase: str) -> dict[str, str]:
    digest = recording.result.content_digest or f"none ({recording.status})"
    meaning = (
        "Observations are states, actions joint actions."
        if recording.can_train_again
        else "Recorded from a loop."
    )
    text = (
        f"The {phase} episodes of the dualtaxi run {recording.run_id} ({recording.title}), "
        f"content digest {digest}. {meaning}"
    )
    algorithm = {"algorithm_name": str(recording.config["algorithm"])} if recording.can_train_again else {}
    return {"description": text, **algorithm}


def _spaces(recording: Recording) -> tuple[object, object]:
    try:
        return restore_space(recording.spaces["observation"]), restore_space(recording.spaces["action"])
    except (AssertionError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RecordingError(
            f"{recording.path}: describes spaces that Gymnasium does not have ({error})."
        ) from error


def _environment_spec(
    recording: Recording, observations: object, actions: object
) -> tuple[object, list[str]]:
    """Return the specification of the environment; None and a note if it cannot be made here."""
    env_id, kwargs = recording.environment["env_id"], recording.environment["kwargs"]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            maker = environment_of_job(recording.config) if recording.can_train_again else recording.maker
            with trusting(recording.path, maker) as is_trusted:
                if not is_trusted:
                    require_listed(env_id, kwargs)
                env = gymnasium.make(env_id, **kwargs)
                env.close()
    except Exception as error:  # an environment may raise anything
        return None, [f"{env_id} cannot be made here ({error}); the dataset does not specify it."]
    if (env.observation_space, env.action_space) == (observations, actions):
        return env.spec, []
    return None, [
        f"{env_id} has other spaces than the {observations} and {actions} of the steps; "
        "the dataset does not specify it."
    ]


@dataclass(frozen=True)
class MinariEpisode:
    """The T steps of an episode that ended; observations and actions are nested as their spaces."""

    number: int
    """Its number in the phase."""
    observations: Value
    """T + 1 of them."""
    actions: Value
    rewards: Floats
    """[T, agents]."""
    terminated: Flags
    truncated: Flags
    acted: NDArray[np.uint32] | None = None
    """[T]: bit i, whether agent i took part; None where all always do."""
    seed: int | None = None
    """The seed of its reset, if it had one."""

    @property
    def is_abandoned(self) -> bool:
        """Whether it was reset before its end."""
        return not (self.terminated[-1] or self.truncated[-1])


def episodes_in(recording: Recording, phase: str, ranges: Ranges) -> Iterator[MinariEpisode]:
    """Yield the episodes of a phase that ended, in these ranges.

    An episode is left out if a repair lost steps of it or the observation of its reset.
    """
    records = recording.phase(phase).episodes
    blocks = (block for start, stop in ranges for block in records.blocks(start, stop))
    for number in sorted({number for block in blocks for number in block["episode"].tolist()}):
        episode = None
        with contextlib.suppress(NotInRecording):  # its last steps were lost
            episode = _episode(recording, phase, number)
        if episode is not None:
            yield episode


def _episode(recording: Recording, phase: str, number: int) -> MinariEpisode | None:
    """Return an episode; None if steps of it, or the observation of its reset, were lost."""
    episode = recording.phase(phase).episode(number)
    if len(episode) * episode.table.row_dtype.itemsize > MAX_EPISODE_BYTES:
        raise RecordingError(
            f"{recording.path}: episode {number} has more than {MAX_EPISODE_BYTES:,} bytes, "
            "which Minari would hold at once; choose others by --episodes, or export parquet."
        )
    blocks = list(episode.rows())
    if sum(map(len, blocks)) != len(episode):
        return None
    steps = np.concatenate(blocks)
    first = first_observed(recording, phase, number, steps[0])
    if first is None:
        return None
    reset = reset_of(recording, phase, number)
    seed = None if reset is None or reset.given.large_seed is not None else reset.seed
    after, actions = observed(recording, steps), acted(recording, steps)
    seen, done = (recording.spaces[name] for name in ("observation", "action"))
    if isinstance(after, list):
        after = [first, *after]
    else:
        after = np.concatenate([np.array([first], after.dtype), after])
    fields = {"rewards", "terminated", "truncated", "acted"} & {*(steps.dtype.names or ())}
    outcomes: dict[str, Any] = {name: steps[name].copy() for name in fields}
    return MinariEpisode(number, _nested(seen, after), _nested(done, actions), seed=seed, **outcomes)


def _nested(description: Description, values: NDArray[Any] | list[Value]) -> Value:
    """Return records, or single values, as dictionaries and tuples of arrays and lists of texts."""

    def part(key: str | int) -> NDArray[Any] | list[Value]:
        return [value[key] for value in values] if isinstance(values, list) else values[str(key)]

    if description["type"] == "Dict":
        return {name: _nested(space, part(name)) for name, space in description["spaces"].items()}
    if description["type"] == "Tuple":
        return tuple(_nested(space, part(i)) for i, space in enumerate(description["spaces"]))
    return values if description["type"] == "Text" else np.ascontiguousarray(values)
