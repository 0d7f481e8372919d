"""TorchRL: environments and collectors that are recorded, and a `Logger` that logs into the recording.

env = runner.integrations.torchrl.record(env)                          # GymEnv, with any transforms
for data in runner.integrations.torchrl.recorded(collector): ...       # any other environment
logger = runner.integrations.torchrl.Logger("ppo")
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from typing import Any, Final, Unpack

from gymnasium.vector import VectorEnv

from runner.errors import ConfigError
from runner.integrations.libraries import Workers, require_tested
from runner.integrations.script import end_with_scripts
from runner.integrations.shapes import logs
from runner.integrations.tensorboard import SummaryWriter
from runner.loops.batches import RecordedBatches, record_batches
from runner.loops.env import record as record_env
from runner.loops.media import film_of, histogram_of
from runner.loops.options import RunOptions
from runner.loops.recorded import Recorded
from runner.loops.vector import record_vector
from runner.util.jsonable import as_mapping

require_tested("torchrl", "torchrl", ("0.14", "0.14"))

import torch  # noqa: E402
from torchrl.data import Categorical, OneHot  # noqa: E402
from torchrl.envs import GymWrapper, TransformedEnv  # noqa: E402
from torchrl.record.loggers import Logger as _Logger  # noqa: E402

_WHY_NOT_MADE: Final = (
    "its steps were recorded as a collector of TorchRL yielded them; those of Gymnasium environments can be "
    "reproduced if these are recorded: runner.integrations.torchrl.record(env)"
)


def record(env: Any, recordings: str | os.PathLike[str] | None = None, **options: Any) -> Any:
    """Record the Gymnasium environment inside of TorchRL's, and return TorchRL's.

    Its actions, observations and rewards are recorded as they are before TorchRL's transforms, with seeds, so
    that the run can be reproduced. The run ends when the environment is closed, as a collector does at its
    end, and what logs into it too, such as a `Logger`.

    Args:
        env: a `GymEnv` or `GymWrapper`, with or without transforms, that this process steps.
        recordings: the recordings folder or a server, as for `runner.record`.
        options: the others of `runner.record`, or of `runner.record_vector` for several environments.

    Raises:
        ConfigError: it is another environment, or recorded already, or an argument cannot be used.
        EnvironmentNotUsable: a space cannot be recorded.
        StorageError: the recordings folder cannot be written.
    """
    wrapper = _without_transforms(env)
    if not isinstance(wrapper, GymWrapper):
        raise ConfigError(
            f"found {type(wrapper).__name__}, expected GymEnv or GymWrapper. Steps of other environments are "
            "recorded where they are collected: for data in runner.integrations.torchrl.recorded(collector)"
        )
    if isinstance(wrapper._env, Recorded):
        raise ConfigError("found an environment that is recorded already, expected one that is not")
    recorder: Any = record_vector if isinstance(wrapper._env, VectorEnv) else record_env
    wrapper._env = recorder(wrapper._env, recordings, **options)
    wrapper._env.close = partial(_close, wrapper._env)
    return env


def _without_transforms(env: Any) -> Any:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _close(recorded: Recorded, **arguments: object) -> None:
    """Close an environment: a collector does it before it yields the last batch, whose losses follow."""
    recorded.env.close(**arguments)
    end_with_scripts(recorded)


class Recording(Workers):
    """Records the environments that a `ParallelEnv` or the workers of a `Multi` collector make, as one run.

    recording = runner.integrations.torchrl.Recording(lambda: GymEnv("CartPole-v1"), name="ppo")
    env = ParallelEnv(4, recording.train)
    """

    record = staticmethod(record)

    @staticmethod
    def inside(env: Any) -> Recorded:
        """Return the recorded environment inside of TorchRL's."""
        return _without_transforms(env)._env  # type: ignore[no-any-return]


def recorded(
    collector: Any,
    recordings: str | os.PathLike[str] | None = None,
    **options: Unpack[RunOptions],
) -> Iterator[Any]:
    """Yield what a collector yields, and record its steps.

        for data in runner.integrations.torchrl.recorded(collector, name="ppo"):

    The observations are those after TorchRL's transforms; several of them are recorded as a `Dict`. One-hot
    actions are recorded as numbers. The run ends with the iteration, also by `break`. It cannot be
    reproduced: what a reset draws depends on generators of PyTorch, which are not recorded.

    Args:
        collector: a collector that steps its environments, also several of them, in this process.
        recordings: as for `runner.record`.
        options: the arguments that `runner.record` has too, except those of infos and frames; `steps` may be
            "all" or "none".

    Raises:
        ConfigError: the collector is of another kind, or an argument cannot be used.
        StorageError: the recordings folder cannot be written.
    """
    env = getattr(collector, "env", None)
    if env is None:
        raise ConfigError(
            f"found {type(collector).__name__}, expected a collector whose environments are in this process"
        )
    if getattr(collector, "split_trajs", False):
        raise ConfigError("found a collector with split_trajs=True, expected split_trajs=False")
    if options.get("steps") == "actions":
        raise ConfigError(
            'steps: found "actions", expected "all": what a collector yields cannot be made again from its '
            "actions. The steps of Gymnasium environments can: record these before the collector is made, by "
            'env = runner.integrations.torchrl.record(env, steps="actions")'
        )
    spec = env.action_spec_unbatched
    rec = record_batches(
        _name_of(env),
        recordings,
        action_space=spec.space if isinstance(spec, OneHot | Categorical) else None,
        autoreset_mode="SameStep",
        **options,
    )
    rec.why_not_made = _WHY_NOT_MADE
    return _recorded(collector, env, rec)


def _recorded(collector: Any, env: Any, rec: RecordedBatches) -> Iterator[Any]:
    with rec:
        for data in collector:
            _record_batch(rec, data, getattr(collector, "_carrier", None), env)
            yield data


def _record_batch(rec: RecordedBatches, data: Any, carrier: Any, env: Any) -> None:
    """Record the steps of a batch, [*environments, time]; the carrier has the observations that follow."""
    number = env.batch_size.numel()
    data = data.reshape(number, -1).transpose(0, 1)
    after = data["next"]
    done = data["next", "done"]
    keys = list(env.observation_spec.keys(include_nested=True, leaves_only=True))
    finals = after.select(*keys)
    last = finals[-1:]
    if carrier is not None:  # its observations are those after a reset, if the episode ended
        last = last.update(carrier.select(*keys, strict=False).reshape(1, number))
    actions = data[env.action_key]
    if isinstance(env.action_spec_unbatched, OneHot):
        actions = actions.long().argmax(-1)
    terminated = after.get("terminated", done)
    truncated = after.get("truncated", done & ~terminated)
    rec.batch(
        _by_name(torch.cat([data.select(*keys), last])),
        actions,
        after["reward"].squeeze(-1),
        terminated[..., 0],
        truncated[..., 0],
        final_observations=_by_name(finals),
    )


def _by_name(observations: Any) -> object:
    """Return the only observation, or all by name."""
    by_name = dict(observations.flatten_keys("/").items())
    return by_name if len(by_name) > 1 else next(iter(by_name.values()))


def _name_of(env: object) -> str:
    """Return the name of an environment, or of the first of several, without transforms."""
    inside = _without_transforms(env)
    while several := vars(inside).get("_envs"):
        inside = _without_transforms(several[0])
    name = getattr(inside, "env_name", None)
    return name if isinstance(name, str) and name else type(inside).__name__


class Logger(_Logger):  # type: ignore[misc]
    """A logger of TorchRL whose values go into the recording.

    The recording is the one that the script makes by `record`, `recorded` or `runner.record`, or a recording
    of the Gymnasium environment that it resets first. A script that steps none gets a run for the values.

    Args:
        exp_name: the name of the run, if the script does not record one itself.
        log_dir: the recordings folder, if the script does not record one itself.
    """

    def __init__(self, exp_name: str, log_dir: str | os.PathLike[str] | None = None) -> None:
        super().__init__(exp_name, log_dir)

    def _create_experiment(self) -> SummaryWriter:
        writer = SummaryWriter(recordings=self.log_dir)
        self.script = writer.script
        self.script.name = self.exp_name
        return writer

    log_histogram = logs("log_histogram", histogram_of, "name data step")
    log_video = logs("log_video", film_of, "name video step", dataformats="NTCHW", fps=30)

    def log_scalar(self, name: str, value: object, step: int | None = None) -> None:
        """Log a number."""
        self.experiment.add_scalar(name, value, step)

    def log_str(self, name: str, value: object, step: int | None = None) -> None:
        """Log a text."""
        self.experiment.add_text(name, value, step)

    def log_hparams(self, cfg: object) -> None:
        """Record settings."""
        self.experiment.add_hparams(as_mapping(cfg) or {"config": str(cfg)}, {})

    def __repr__(self) -> str:
        return f"Logger({self.exp_name!r})"
