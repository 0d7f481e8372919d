"""A run's episodes as a Minari dataset: what libraries for offline reinforcement learning read."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.export.contents import whole_ranges
from runner.export.minari_loops import Episode, loop_episodes
from runner.recording import schema
from runner.recording.gym_spaces import restore_space
from runner.recording.reader import Recording
from runner.recording.run_file import run_title
from runner.util.extras import require

if TYPE_CHECKING:
    import gymnasium

Ranges = tuple[tuple[int, int | None], ...]
_AT_ONCE: Final = 500
OURS: Final = ("data/main_data.hdf5", "data/metadata.json")


@dataclass(frozen=True)
class Written:
    """What came of an export."""

    episodes: int
    steps: int
    notes: tuple[str, ...]
    """What is not in it."""


def require_packages() -> None:
    """Raise an error that says what is missing, if Minari or its storage is not installed.

    Raises:
        MissingExtra: it is not.
    """
    require("h5py", "minari", extra="minari", purpose="export minari")


def dataset_id(recording: Recording) -> str:
    """Return the name of a run's dataset: NAME-RUN-v0, with what Minari allows in names."""
    return re.sub(r"[^\w-]", "_", f"{recording.name}-{recording.run_id}-v0")


def write_dataset(
    recording: Recording,
    folder: Path,
    phase: str,
    ranges: Ranges = (),
    report: Callable[[int], None] = lambda _: None,
) -> Written:
    """Write whole episodes into the folder of a dataset.

    Of a job an observation is a state, an action the joint action; of a loop both are what they were. A
    reward is the sum over the learners; where there are several, `infos["rewards"]` has theirs,
    [steps + 1, learners], the first row 0 as of a reset, and in a loop `infos["acted"]` who took part.

    Args:
        recording: whose.
        folder: the dataset's, empty.
        phase: `train` or `eval`.
        ranges: of episodes, the second number not included, None for the end; all if there are none.
        report: called with the episodes written so far.

    Raises:
        RecordingError: there is no such episode, Minari cannot store it, or the recording is damaged.
        OSError: the folder cannot be written.
    """
    import minari
    from minari.dataset.minari_storage import MinariStorage

    folder = folder.absolute()  # Minari looks for a relative one within itself
    ended = recording.count(recording.topic(f"/{phase}/episode"))
    wanted = tuple(whole_ranges(ranges, ended, phase, str(recording.path))) or ((0, None),)
    observations, actions, spec, notes = _spaces(recording)
    (folder / "data").mkdir()
    storage = MinariStorage.new(
        folder / "data", observations, actions, spec, data_format="hdf5", jpeg_encoding=False
    )
    told = {"dataset_id": dataset_id(recording), "minari_version": minari.__version__}
    storage.update_metadata(told | _told(recording, phase))
    counts = [0, 0, 0]

    def buffers() -> Iterator[Any]:
        for buffer, abandoned in _buffers(recording, phase, wanted):
            counts[0] += 1
            counts[1] += len(buffer.rewards)
            counts[2] += abandoned
            report(counts[0])
            yield replace(buffer, id=counts[0] - 1)

    made = buffers()
    for first in made:  # so many at a time: what HDF5 keeps of a file goes when it is closed
        try:
            storage.update_episodes(chain([first], islice(made, _AT_ONCE - 1)))
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"{recording.path}: {phase} episode {counts[0] - 1} cannot be stored by Minari ({error})."
            ) from error
    if not counts[0]:
        raise RecordingError(f"{recording.path}: found no {phase} episode that ended, expected one at least.")
    return Written(counts[0], counts[1], (*notes, *_missing(recording, phase, ranges, counts)))


def _buffers(recording: Recording, phase: str, ranges: Ranges) -> Iterator[tuple[Any, bool]]:
    """Yield each episode as Minari takes it, and whether it was reset before its end."""
    if recording.is_job:
        yield from ((_buffer(steps), False) for steps in episodes_of(recording, phase, ranges))
        return
    yield from (
        (_loop_buffer(episode), episode.abandoned) for episode in loop_episodes(recording, phase, ranges)
    )


def _missing(recording: Recording, phase: str, ranges: Ranges, counts: Sequence[int]) -> list[str]:
    """Return what is not in a dataset, or otherwise than recorded, a sentence each."""
    said = []
    ended, steps = (recording.count(recording.topic(f"/{phase}/{name}")) for name in ("episode", "step"))
    if counts[2]:
        said.append(
            f"{counts[2]:,} episodes were reset before their end; their last step is marked as truncated."
        )
    if not ranges and counts[0] < ended:
        said.append(f"{ended - counts[0]:,} episodes are left out, as steps or resets of them are missing.")
    elif not ranges and counts[1] < steps and recording.environments == 1:
        said.append(
            f"The last {'training' if phase == 'train' else 'eval'} episode never ended; it is left out."
        )
    elif not ranges and recording.environments > 1:
        said.append("Episodes that never ended are left out.")
    return said


def episodes_of(recording: Recording, phase: str, ranges: Ranges) -> Iterator[NDArray[np.void]]:
    """Yield the steps of each episode that ended, as one array each, a block of the file at a time."""
    for start, stop in ranges:
        rest = np.empty(0, recording.dtypes[schema.PHASES[phase][0]])
        for block in recording.blocks_of_episodes(phase, start, stop):
            steps = np.concatenate([rest, block])
            ends = np.flatnonzero(steps["terminated"] | steps["truncated"]) + 1
            *whole, rest = np.split(steps, ends)
            yield from whole


def _buffer(steps: NDArray[np.void]) -> Any:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    rewards = steps["rewards"]
    return EpisodeBuffer(
        observations=np.append(steps["state"], steps["next_state"][-1:]).astype(np.int64),
        actions=steps["action"].astype(np.int64),
        rewards=rewards.sum(axis=1),
        terminations=steps["terminated"].copy(),
        truncations=steps["truncated"].copy(),
        infos={"rewards": _after_reset(rewards)} if rewards.shape[1] > 1 else None,
    )


def _loop_buffer(episode: Episode) -> Any:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    truncated = episode.truncated.copy()
    truncated[-1] |= episode.abandoned
    several = episode.rewards.shape[1] > 1
    own = {"rewards": _after_reset(episode.rewards), "acted": _after_reset(episode.acted)}
    return EpisodeBuffer(
        seed=episode.seed,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards.sum(axis=1),
        terminations=episode.terminated,
        truncations=truncated,
        infos=own if several else None,
    )


def _after_reset(values: NDArray[Any]) -> NDArray[Any]:
    """Return what came of steps behind the nothing that came of the reset."""
    return np.concatenate([np.zeros_like(values[:1]), values])


def _told(recording: Recording, phase: str) -> dict[str, Any]:
    run, config = recording.run, recording.config
    digest = recording.result.content_digest or f"none ({recording.status})"
    job = recording.is_job
    what = "Observations are states, actions joint actions." if job else "Recorded from a loop."
    told = {
        "description": f"The {phase} episodes of the dualtaxi run {run['run_id']} "
        f"({run_title(recording.name, recording.seed)}), content digest {digest}. {what}",
    }
    return told | ({"algorithm_name": str(config["algorithm"])} if job else {})


def _spaces(recording: Recording) -> tuple[Any, Any, Any, list[str]]:
    """Return both spaces, what makes the environment again, if that can be done, and what to say."""
    from gymnasium.spaces import Discrete

    if recording.is_job:
        observations: Any = Discrete(recording.mdp.states)
        actions: Any = Discrete(recording.mdp.joint_actions)
    else:
        try:
            observations, actions = (
                restore_space(recording.spaces[name]) for name in ("observation", "action")
            )
        except (AssertionError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise RecordingError(
                f"{recording.path}: describes spaces that Gymnasium has not ({error})."
            ) from error
    spec, notes = _spec(recording, observations, actions)
    return observations, actions, spec, notes


def _spec(
    recording: Recording, observations: gymnasium.Space[Any], actions: gymnasium.Space[Any]
) -> tuple[Any, list[str]]:
    """Return what makes the environment again, if that can be done; else what to say."""
    import gymnasium

    said = recording.environment
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = gymnasium.make(said["env_id"], **said["kwargs"])
            made.close()
    except Exception as error:  # an environment may raise anything
        return None, [f"{said['env_id']} cannot be made here ({error}); the dataset does not specify it."]
    if (made.observation_space, made.action_space) != (observations, actions):
        return None, [
            f"{said['env_id']} has other spaces than the {observations} and {actions} of the steps; "
            "the dataset does not specify it."
        ]
    return made.spec, []
