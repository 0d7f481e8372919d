"""A run's episodes as a Minari dataset: what libraries for offline reinforcement learning read."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import MissingExtra, RecordingError
from runner.recording import schema
from runner.recording.reader import Recording

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
    try:
        import h5py  # noqa: F401
        import minari  # noqa: F401
    except ImportError as error:
        raise MissingExtra("Minari", "minari", "export minari") from error


def dataset_id(recording: Recording) -> str:
    """Return the name of a run's dataset: NAME-RUN-v0, with what Minari allows in names."""
    return re.sub(r"[^\w-]", "_", f"{recording.run['name']}-{recording.run['run_id']}-v0")


def write_dataset(
    recording: Recording,
    folder: Path,
    phase: str,
    ranges: Ranges = (),
    report: Callable[[int], None] = lambda _: None,
) -> Written:
    """Write whole episodes into the folder of a dataset.

    An observation is a state, an action the joint action, a reward the sum over the learners; where there
    are several, `infos["rewards"]` has theirs, [steps + 1, learners], the first row 0 as of a reset.

    Args:
        recording: whose.
        folder: the dataset's, empty.
        phase: `train` or `eval`.
        ranges: of episodes, the second number not included, None for the end; all if there are none.
        report: called with the episodes written so far.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
        OSError: the folder cannot be written.
    """
    import minari
    from gymnasium.spaces import Discrete
    from minari.dataset.minari_storage import MinariStorage

    mdp, folder = recording.mdp, folder.absolute()  # Minari looks for a relative one within itself
    wanted = _checked(recording, phase, ranges)
    observations, actions = Discrete(mdp.states), Discrete(mdp.joint_actions)
    spec, notes = _spec(recording, observations, actions)
    (folder / "data").mkdir()
    storage = MinariStorage.new(folder / "data", observations, actions, spec, data_format="hdf5")
    told = {"dataset_id": dataset_id(recording), "minari_version": minari.__version__}
    storage.update_metadata(told | _told(recording, phase))
    counts = [0, 0]

    def buffers() -> Iterator[Any]:
        for steps in episodes_of(recording, phase, wanted):
            counts[0] += 1
            counts[1] += len(steps)
            report(counts[0])
            yield _buffer(steps, counts[0] - 1)

    made = buffers()
    for first in made:  # so many at a time: what HDF5 keeps of a file goes when it is closed
        storage.update_episodes(chain([first], islice(made, _AT_ONCE - 1)))
    if phase == "train" and recording.count(schema.TRAIN_STEP) > _ended_steps(recording) and not ranges:
        notes.append("The last training episode never ended; it is left out.")
    return Written(counts[0], counts[1], tuple(notes))


def episodes_of(recording: Recording, phase: str, ranges: Ranges) -> Iterator[NDArray[np.void]]:
    """Yield the steps of each episode that ended, as one array each, a block of the file at a time."""
    for start, stop in ranges:
        rest = np.empty(0, recording.dtypes[schema.PHASES[phase][0]])
        for block in recording.blocks_of_episodes(phase, start, stop):
            steps = np.concatenate([rest, block])
            ends = np.flatnonzero(steps["terminated"] | steps["truncated"]) + 1
            *whole, rest = np.split(steps, ends)
            yield from whole


def _checked(recording: Recording, phase: str, ranges: Ranges) -> Ranges:
    ended = recording.count(schema.PHASES[phase][1])
    for start, stop in ranges:
        if not start < (ended if stop is None else stop) <= ended:
            raise RecordingError(
                f"{recording.path}: found no {phase} episodes {start}:{'' if stop is None else stop}; "
                f"there are {ended:,}, from 0. Ranges are START:STOP, STOP not included."
            )
    return ranges or ((0, None),)


def _buffer(steps: NDArray[np.void], number: int) -> Any:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    rewards = steps["rewards"]
    own = np.concatenate([np.zeros((1, rewards.shape[1])), rewards])
    return EpisodeBuffer(
        id=number,
        observations=np.append(steps["state"], steps["next_state"][-1:]).astype(np.int64),
        actions=steps["action"].astype(np.int64),
        rewards=rewards.sum(axis=1),
        terminations=steps["terminated"].copy(),
        truncations=steps["truncated"].copy(),
        infos={"rewards": own} if rewards.shape[1] > 1 else None,
    )


def _told(recording: Recording, phase: str) -> dict[str, Any]:
    run = recording.run
    digest = recording.result.get("content_digest", "none: it was interrupted")
    return {
        "algorithm_name": str(recording.config["algorithm"]),
        "description": f"The {phase} episodes of the dualtaxi run {run['run_id']} ({run['name']}, seed "
        f"{run['seed']}), content digest {digest}. Observations are states, actions joint actions.",
    }


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


def _ended_steps(recording: Recording) -> int:
    ended = recording.count(schema.TRAIN_EPISODE)
    last = recording.episodes("train", max(ended - 1, 0), ended)
    return int(last[0]["last_step"]) + 1 if len(last) else 0
